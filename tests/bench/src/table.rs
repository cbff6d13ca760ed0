//! The table of figures.

use serde_json::{Value, json};

use crate::stats::Contest;

/// All that was measured.
#[derive(Default)]
pub(crate) struct Table {
    rows: Vec<Row>,
}

/// One figure of ours beside others.
pub(crate) struct Row {
    /// What was measured.
    pub(crate) what: String,
    /// Unit of all figures of the row.
    pub(crate) unit: &'static str,
    /// Ours.
    pub(crate) ddx: f64,
    /// What no design can beat.
    pub(crate) floor: Option<Beside>,
    /// What others have built.
    pub(crate) peer: Option<Beside>,
    /// What was promised.
    pub(crate) budget: &'static str,
}

/// Another's figure.
pub(crate) struct Beside {
    name: &'static str,
    figure: f64,
    /// Ours over theirs.
    ratio: f64,
}

/// A contender beside ours: its name and its place in the contest.
pub(crate) type Other = (&'static str, usize);

impl Table {
    /// Adds a row.
    pub(crate) fn push(&mut self, row: Row) {
        self.rows.push(row);
    }

    /// Adds a row from a contest, in which ours came first; `scale` is what one unit is in units of the figures.
    pub(crate) fn contest(
        &mut self,
        what: String,
        (unit, scale): (&'static str, f64),
        (contest, figure): (&Contest, usize),
        floor: Option<Other>,
        peer: Option<Other>,
        budget: &'static str,
    ) {
        let beside = |(name, place): Other| Beside {
            name,
            figure: contest.figure(place, figure) / scale,
            ratio: contest.ratio(place, figure),
        };
        self.push(Row {
            what,
            unit,
            ddx: contest.figure(0, figure) / scale,
            floor: floor.map(beside),
            peer: peer.map(beside),
            budget,
        });
    }

    /// Whether each row has a figure.
    pub(crate) fn is_complete(&self) -> bool {
        self.rows.iter().all(|row| row.ddx.is_finite())
    }

    /// The table for programs: one object for each row.
    pub(crate) fn to_json(&self) -> Value {
        let beside = |beside: &Option<Beside>| {
            beside
                .as_ref()
                .map(|b| json!({ "name": b.name, "figure": b.figure, "ratio": b.ratio }))
        };
        self.rows
            .iter()
            .map(|row| {
                json!({
                    "what": row.what,
                    "unit": row.unit,
                    "ddx": row.ddx,
                    "floor": beside(&row.floor),
                    "peer": beside(&row.peer),
                    "budget": row.budget,
                })
            })
            .collect()
    }

    /// The table for people.
    pub(crate) fn to_text(&self) -> String {
        let head = [
            "what", "unit", "ddx", "floor", "ratio", "peer", "ratio", "budget",
        ]
        .map(str::to_owned);
        let lines: Vec<[String; 8]> = std::iter::once(head)
            .chain(self.rows.iter().map(Row::cells))
            .collect();
        let widths: [usize; 8] = std::array::from_fn(|column| {
            lines
                .iter()
                .map(|line| line[column].chars().count())
                .max()
                .unwrap_or(0)
        });
        let mut text = String::new();
        for line in lines {
            for (cell, width) in line.iter().zip(widths) {
                text.push_str(&format!("{cell:width$}  "));
            }
            text.truncate(text.trim_end().len());
            text.push('\n');
        }
        text
    }
}

impl Row {
    fn cells(&self) -> [String; 8] {
        let [floor, floor_ratio] = cells_of(self.floor.as_ref());
        let [peer, peer_ratio] = cells_of(self.peer.as_ref());
        [
            self.what.clone(),
            self.unit.to_owned(),
            number(self.ddx),
            floor,
            floor_ratio,
            peer,
            peer_ratio,
            self.budget.to_owned(),
        ]
    }
}

fn cells_of(beside: Option<&Beside>) -> [String; 2] {
    beside.map_or(["-".to_owned(), "-".to_owned()], |b| {
        [
            format!("{} {}", b.name, number(b.figure)),
            format!("{:.2}", b.ratio),
        ]
    })
}

/// Three digits or so.
fn number(figure: f64) -> String {
    let digits = if figure.abs() < 10.0 {
        2
    } else {
        usize::from(figure.abs() < 100.0)
    };
    format!("{figure:.digits$}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_line_up_and_what_was_not_measured_is_a_dash() {
        let mut table = Table::default();
        let contest = Contest::run(
            1,
            &mut [&mut || Ok(vec![2_500.0]), &mut || Ok(vec![2_000.0])],
        )
        .unwrap();
        table.contest(
            "wake".to_owned(),
            ("us", 1e3),
            (&contest, 0),
            Some(("futex", 1)),
            None,
            "1.25x",
        );

        assert_eq!(
            table.to_text(),
            "what  unit  ddx   floor       ratio  peer  ratio  budget\n\
             wake  us    2.50  futex 2.00  1.25   -     -      1.25x\n"
        );
    }

    #[test]
    fn a_row_without_a_figure_is_no_figure() {
        let mut table = Table::default();
        table.contest(
            "x".to_owned(),
            ("us", 1.0),
            (&Contest::run(0, &mut []).unwrap(), 0),
            None,
            None,
            "",
        );

        assert!(!table.is_complete());
    }
}
