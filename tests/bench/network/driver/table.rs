//! The table for people, and what it says about the goals.

use crate::contender::{Contender, DDX};
use crate::plan::{Cell, Pace, Plan};
use crate::results::{Figure, Once, Results};

/// A column of the table of cells.
struct Column {
    head: &'static str,
    pace: Pace,
    figure: Figure,
    /// Whether less is better; none for what is only told.
    better: Option<Better>,
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Better {
    Less,
    More,
}

const COLUMNS: [Column; 8] = [
    Column {
        head: "p50 us",
        pace: Pace::Steady,
        figure: |reading| reading.p50_us,
        better: Some(Better::Less),
    },
    Column {
        head: "p99 us",
        pace: Pace::Steady,
        figure: |reading| reading.p99_us,
        better: Some(Better::Less),
    },
    Column {
        head: "got %",
        pace: Pace::Steady,
        figure: |reading| reading.got_percent,
        better: None,
    },
    Column {
        head: "CPU us each",
        pace: Pace::Steady,
        figure: |reading| reading.cpu_us_each,
        better: None,
    },
    Column {
        head: "wire B each",
        pace: Pace::Steady,
        figure: |reading| reading.wire_bytes_each,
        better: None,
    },
    Column {
        head: "most/s",
        pace: Pace::Max,
        figure: |reading| reading.per_second,
        better: Some(Better::More),
    },
    Column {
        head: "per CPU s",
        pace: Pace::Max,
        figure: |reading| reading.per_cpu_second,
        better: Some(Better::More),
    },
    Column {
        head: "missing %",
        pace: Pace::Max,
        figure: |reading| 100.0 - reading.got_percent,
        better: None,
    },
];

/// The whole report, in Markdown.
pub(crate) fn to_text(
    results: &Results,
    contenders: &[&'static Contender],
    plan: &Plan,
    conditions: &str,
) -> String {
    let mut text = format!("{HEADING}\n{conditions}\n{EXPLANATION}\n");
    text.push_str(&markdown(&cell_rows(results, contenders, plan)));
    text.push('\n');
    text.push_str(&markdown(&once_rows(results, contenders)));
    if contenders.iter().any(|contender| contender.name == DDX) {
        text.push_str("\nGoals of ddx that these figures miss:\n");
        let missed = missed_goals(results, contenders, plan);
        for line in &missed {
            text.push_str(&format!("- {line}\n"));
        }
        if missed.is_empty() {
            text.push_str("- none\n");
        }
    }
    text
}

fn cell_rows(
    results: &Results,
    contenders: &[&'static Contender],
    plan: &Plan,
) -> Vec<Vec<String>> {
    let mut head: Vec<String> = ["readers", "loss", "size", "contender"]
        .map(str::to_owned)
        .to_vec();
    for column in &COLUMNS {
        head.push(column.head.to_owned());
        if column.better.is_some() {
            head.push("x best".to_owned());
        }
    }
    let mut rows = vec![head];
    for cell in plan.cells.iter().filter(|cell| cell.pace == Pace::Steady) {
        for contender in contenders {
            let mut row = vec![
                cell.subscribers.to_string(),
                format!("{} %", cell.loss_percent),
                bytes(cell.size),
                contender.name.to_owned(),
            ];
            for column in &COLUMNS {
                let cell = Cell {
                    pace: column.pace,
                    ..*cell
                };
                let figure = results.figure(contender.name, cell, column.figure);
                row.push(number(figure));
                if column.better.is_some() {
                    row.push(number(ratio(results, contenders, cell, column, figure)));
                }
            }
            rows.push(row);
        }
    }
    rows
}

fn once_rows(results: &Results, contenders: &[&'static Contender]) -> Vec<Vec<String>> {
    let mut head = vec!["contender".to_owned()];
    for once in Once::ALL {
        head.extend([once.head().to_owned(), "x best".to_owned()]);
    }
    let mut rows = vec![head];
    for contender in contenders {
        let mut row = vec![contender.name.to_owned()];
        for once in Once::ALL {
            let figure = results.once(contender.name, once);
            let ratio = ratio_once(results, contenders, once, figure);
            row.extend([number(figure), number(ratio)]);
        }
        rows.push(row);
    }
    rows
}

/// How far a figure is from the best of its row: 1 is the best, and more is worse whichever way is better.
fn ratio(
    results: &Results,
    contenders: &[&'static Contender],
    cell: Cell,
    column: &Column,
    figure: f64,
) -> f64 {
    let Some(better) = column.better else {
        return f64::NAN;
    };
    let best = best(contenders, better, |name| {
        results.figure(name, cell, column.figure)
    });
    match better {
        Better::Less => figure / best,
        Better::More => best / figure,
    }
}

/// The same for what is measured once, where less is better; the best may be nothing at all.
fn ratio_once(
    results: &Results,
    contenders: &[&'static Contender],
    once: Once,
    figure: f64,
) -> f64 {
    let best = best(contenders, Better::Less, |name| results.once(name, once));
    if figure == best { 1.0 } else { figure / best }
}

/// The best of all but the floors.
fn best(
    contenders: &[&'static Contender],
    better: Better,
    figure: impl Fn(&'static str) -> f64,
) -> f64 {
    let figures = contenders
        .iter()
        .filter(|contender| !contender.is_floor)
        .map(|contender| figure(contender.name));
    match better {
        Better::Less => figures.fold(f64::NAN, f64::min),
        Better::More => figures.fold(f64::NAN, f64::max),
    }
}

/// The goals: best in latency up to 1400 bytes, in idle bytes and in every row with loss; elsewhere within 1.5 of the best.
fn missed_goals(results: &Results, contenders: &[&'static Contender], plan: &Plan) -> Vec<String> {
    let mut missed = Vec::new();
    for cell in &plan.cells {
        for column in COLUMNS.iter().filter(|column| column.pace == cell.pace) {
            if column.better.is_none() || column.head == "p99 us" {
                continue;
            }
            let is_first_goal =
                cell.loss_percent > 0 || (cell.pace == Pace::Steady && cell.size <= SMALL);
            let goal = if is_first_goal { 1.0 } else { 1.5 };
            let figure = results.figure(DDX, *cell, column.figure);
            let ratio = ratio(results, contenders, *cell, column, figure);
            let what = format!(
                "{}, 1 to {}, {} % loss, {}",
                column.head,
                cell.subscribers,
                cell.loss_percent,
                bytes(cell.size)
            );
            if !ratio.is_finite() {
                missed.push(format!("{what}: no figure"));
            } else if ratio > goal {
                missed.push(format!(
                    "{what}: {} of the best, goal {goal}",
                    number(ratio)
                ));
            }
        }
    }
    for once in [Once::IdleBytes, Once::UnreadBytes] {
        let ratio = ratio_once(results, contenders, once, results.once(DDX, once));
        if ratio > 1.0 || ratio.is_nan() {
            missed.push(format!(
                "{}: {} of the best, goal 1",
                once.head(),
                number(ratio)
            ));
        }
    }
    missed
}

/// Rows as a table that lines up; the first is the head.
fn markdown(rows: &[Vec<String>]) -> String {
    let columns = rows.first().map_or(0, Vec::len);
    let width = |column: usize| {
        let cells = rows.iter().filter_map(|row| row.get(column));
        cells.map(|cell| cell.chars().count()).max().unwrap_or(0)
    };
    let widths: Vec<usize> = (0..columns).map(width).collect();
    let mut text = String::new();
    for (index, row) in rows.iter().enumerate() {
        for (cell, width) in row.iter().zip(&widths) {
            text.push_str(&format!("| {cell:width$} "));
        }
        text.push_str("|\n");
        if index == 0 {
            for width in &widths {
                text.push_str(&format!("|{}", "-".repeat(width + 2)));
            }
            text.push_str("|\n");
        }
    }
    text
}

/// Three digits or so; a dash for what is no number.
fn number(figure: f64) -> String {
    if figure.is_nan() {
        return "-".to_owned();
    }
    match figure.abs() {
        size if size.is_infinite() => "inf".to_owned(),
        size if size >= 1e6 => format!("{:.2} M", figure / 1e6),
        size if size >= 1e4 => format!("{:.1} k", figure / 1e3),
        size if size >= 100.0 => format!("{figure:.0}"),
        size if size >= 10.0 => format!("{figure:.1}"),
        _ => format!("{figure:.2}"),
    }
}

/// A size for people.
pub(crate) fn bytes(size: usize) -> String {
    match size {
        size if size >= 1 << 20 && size.is_multiple_of(1 << 20) => format!("{} MiB", size >> 20),
        size if size >= 1 << 10 && size.is_multiple_of(1 << 10) => format!("{} KiB", size >> 10),
        size => format!("{size} B"),
    }
}

const HEADING: &str = "# ddx between hosts, beside its peers\n";
const EXPLANATION: &str = "\
Steady: 1000 samples a second, 100 of 1 MiB; latency is one way, from before the sample is filled. `got` is what arrived of \
what was written, at most an eighth of a second after the last was.\n\
Most: written without pause, and again at 1.1 of what arrived where much was missing; the better counts. Each reader's \
samples a second, none counted twice, and all readers' samples by the processor time of all programs and daemons. `missing` \
of those was lost, or overwritten by newer ones where a system delivers the newest.\n\
`wire` is what all hosts sent, from the IP header on. Loss strikes each way on each reader's link. `x best` is 1 for the best \
of its row, bare UDP and ddx-spin (whose daemons do not sleep) aside; more is worse. A dash: not carried, or no figure.\n";
/// The goal for latency is the best up to this size.
const SMALL: usize = 1_400;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::contender::CONTENDERS;
    use crate::results::tests::{cell, reading};

    fn of(names: &[&str]) -> Vec<&'static Contender> {
        let known = CONTENDERS.iter();
        known.filter(|known| names.contains(&known.name)).collect()
    }

    #[test]
    fn the_floor_is_nobodys_best() {
        let mut results = Results::default();
        for (name, per_second) in [(DDX, 10.0), ("bare-udp", 90.0), ("lcm", 20.0)] {
            results.add(name, cell(0), reading(per_second));
        }
        let most = &COLUMNS[5];

        let ratio = ratio(
            &results,
            &of(&[DDX, "bare-udp", "lcm"]),
            cell(0),
            most,
            10.0,
        );

        assert_eq!(ratio, 2.0);
    }

    #[test]
    fn more_than_nothing_is_infinitely_more() {
        let mut results = Results::default();
        for (name, bytes) in [(DDX, 400.0), ("lcm", 0.0)] {
            results.add_once(name, Once::IdleBytes, bytes);
        }

        let rows = once_rows(&results, &of(&[DDX, "lcm"]));

        assert_eq!([&rows[1][1], &rows[1][2]], ["400", "inf"]);
        assert_eq!([&rows[2][1], &rows[2][2]], ["0.00", "1.00"]);
    }

    #[test]
    fn a_goal_is_stricter_under_loss() {
        let plan = Plan {
            cells: vec![cell(0), cell(10)],
            ..Plan::full(&[64])
        };
        let mut results = Results::default();
        for loss in [0, 10] {
            results.add(DDX, cell(loss), reading(10.0));
            results.add("lcm", cell(loss), reading(12.0));
        }
        for once in Once::ALL {
            results.add_once(DDX, once, 1.0);
        }

        let missed = missed_goals(&results, &of(&[DDX, "lcm"]), &plan);

        assert_eq!(
            missed,
            [
                "most/s, 1 to 1, 10 % loss, 64 B: 1.20 of the best, goal 1",
                "per CPU s, 1 to 1, 10 % loss, 64 B: 1.20 of the best, goal 1"
            ]
        );
    }

    #[test]
    fn a_table_lines_up() {
        let rows = [["a", "bb"], ["ccc", "d"]].map(|row| row.map(str::to_owned).to_vec());

        assert_eq!(
            markdown(&rows),
            "| a   | bb |\n|-----|----|\n| ccc | d  |\n"
        );
        assert_eq!(
            [1_234_567.0, 12_345.0, 99.94, 1.0, f64::NAN].map(number),
            ["1.23 M", "12.3 k", "99.9", "1.00", "-"]
        );
    }
}
