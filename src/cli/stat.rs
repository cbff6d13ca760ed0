//! `ddx stat`: what became of each sample, one line for each item and hop; `--check` says whether the books balance.

use std::fs;
use std::path::PathBuf;

use anyhow::Context as _;
use serde_json::{Value, json};

use super::books::{Books, Rates, Row, Snapshot};
use super::render::{Table, bytes, rate};
use super::{Context, pattern};
use crate::error::{Exit, Failure, Outcome};

/// Which items, and whether to judge.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Names to look at; `*` is one chunk, `**` any number [default: `**`]
    pattern: Option<String>,
    /// Say which books do not balance, and then exit with 3
    #[arg(long)]
    check: bool,
    /// Look at books that `ddx --json stat` printed, not at this host's
    #[arg(long, value_name = "FILE")]
    snapshot: Option<PathBuf>,
}

/// A row that does not balance.
#[derive(Debug, PartialEq, Eq)]
struct Fault {
    name: String,
    hop: String,
    sentence: String,
    sums: (u64, u64),
}

/// Runs the verb.
pub(crate) fn run(context: &mut Context, args: &Args) -> Outcome {
    let (snapshot, rates) = match &args.snapshot {
        Some(file) => {
            let snapshot = recorded(file)?;
            let rates = vec![Rates::default(); snapshot.rows.len()];
            (snapshot, rates)
        }
        None => {
            let store = context.store("stat")?;
            let pattern = pattern(&store, args.pattern.as_deref())?;
            let mut books = Books::open(&store)?;
            let before = books.take(&pattern)?;
            if args.check {
                let rates = Vec::new();
                (before, rates)
            } else {
                books.wait()?;
                let after = books.take(&pattern)?;
                let rates = after.rates(&before);
                (after, rates)
            }
        }
    };
    if args.check {
        return check(context, &snapshot);
    }
    if context.out.json {
        for (row, rates) in snapshot.rows.iter().zip(&rates) {
            context.out.object(&object(row, rates)?)?;
        }
    } else {
        for line in table(&snapshot, &rates).lines() {
            context.out.line(&line)?;
        }
    }
    left_off(context, &snapshot)?;
    Ok(Exit::Done)
}

fn check(context: &mut Context, snapshot: &Snapshot) -> Outcome {
    let faults = faults(&snapshot.rows);
    for fault in &faults {
        let (expected, accounted) = fault.sums;
        let object = json!({
            "name": fault.name,
            "hop": fault.hop,
            "expected": expected,
            "accounted": accounted,
            "sentence": fault.sentence,
        });
        context.out.either(&object, &fault.sentence)?;
    }
    let checked = snapshot.rows.len();
    let summary = json!({ "checked": checked, "unbalanced": faults.len() });
    if faults.is_empty() {
        let text = format!("all {checked} books balance");
        context.out.either(&summary, &text)?;
        left_off(context, snapshot)?;
        return Ok(Exit::Done);
    }
    let text = format!("{} of {checked} books do not balance", faults.len());
    context.out.either(&summary, &text)?;
    Ok(Exit::DoneWithLoss)
}

fn faults(rows: &[Row]) -> Vec<Fault> {
    let found = rows.iter().filter_map(|row| {
        let (what, expected, accounted) = row.imbalance()?;
        let (name, hop) = (row.name.clone(), row.hop.clone());
        let sentence = format!(
            "`{name}` does not balance from {hop} ({}): {expected} {what}, {accounted} accounted for",
            row.peers.join(", ")
        );
        Some(Fault {
            name,
            hop,
            sentence,
            sums: (expected, accounted),
        })
    });
    found.collect()
}

fn recorded(file: &PathBuf) -> Result<Snapshot, Failure> {
    let what = || format!("reading the books in `{}`", file.display());
    let text = fs::read_to_string(file).with_context(what)?;
    let rows = text.lines().filter(|line| !line.trim().is_empty());
    let rows: Result<Vec<Row>, _> = rows.map(serde_json::from_str).collect();
    Ok(Snapshot {
        rows: rows.with_context(what)?,
        left_off: 0,
    })
}

fn left_off(context: &mut Context, snapshot: &Snapshot) -> anyhow::Result<()> {
    if snapshot.left_off > 0 && !context.out.json {
        let text = format!("{} more rows are not shown", snapshot.left_off);
        context.out.line(&text)?;
    }
    Ok(())
}

fn object(row: &Row, rates: &Rates) -> anyhow::Result<Value> {
    let mut object = serde_json::to_value(row).context("writing a row")?;
    object["accounted"] = json!(row.accounted());
    object["unknown"] = json!(unknown(row));
    object["per_second"] = json!({
        "expected": rates.expected,
        "delivered": rates.delivered,
        "overwritten": rates.overwritten,
        "filtered": rates.filtered,
        "queue_dropped": rates.queue_dropped,
        "lost": rates.lost,
        "bytes": rates.bytes,
    });
    Ok(object)
}

/// Samples whose fate nobody has written down.
fn unknown(row: &Row) -> u64 {
    row.expected.saturating_sub(row.accounted())
}

/// Fates that befell nobody have no column.
fn table(snapshot: &Snapshot, rates: &[Rates]) -> Table {
    let counts = |row: &Row| {
        let mut counts = row.fates.named().to_vec();
        counts.push(("unknown", unknown(row)));
        counts
    };
    let befell = |at: usize| snapshot.rows.iter().any(|row| counts(row)[at].1 > 0);
    let shown: Vec<usize> = (0..=Row::default().fates.named().len())
        .filter(|at| *at == 0 || befell(*at))
        .collect();
    let names: Vec<String> = counts(&Row::default())
        .into_iter()
        .map(|(name, _)| name.to_uppercase())
        .collect();
    let mut head = vec!["NAME", "HOP", "WITH", "RATE", "BYTES/S"];
    head.extend(shown.iter().map(|at| names[*at].as_str()));
    let mut table = Table::new(&head);
    for (row, rates) in snapshot.rows.iter().zip(rates) {
        let mut cells = vec![
            row.name.clone(),
            row.hop.clone(),
            with(row),
            rate(Some(rates.delivered)),
            match row.bytes {
                0 => "-".to_owned(),
                _ => bytes(whole(rates.bytes)),
            },
        ];
        let counts = counts(row);
        cells.extend(shown.iter().map(|at| counts[*at].1.to_string()));
        table.row(cells);
    }
    table
}

fn with(row: &Row) -> String {
    let peers = row.peers.join(", ");
    match &row.via {
        Some(via) => format!("{peers} by {via}"),
        None => peers,
    }
}

fn whole(rate: f64) -> u64 {
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "a rate is not negative, and a conversion saturates"
    )]
    let whole = rate as u64;
    whole
}

#[cfg(test)]
mod tests {
    use super::super::books::Fates;
    use super::*;

    fn row() -> Row {
        Row {
            name: "robot1/imu".to_owned(),
            hop: "link to mirror".to_owned(),
            peers: vec!["robot1".to_owned()],
            expected: 100,
            fates: Fates {
                delivered: 90,
                overwritten: 2,
                filtered: 3,
                lost: 4,
                late: 1,
                ..Fates::default()
            },
            written: Some(88),
            stale: 1,
            refused: 1,
            ..Row::default()
        }
    }

    #[test]
    fn books_that_balance_are_no_fault() {
        assert_eq!(faults(&[row(), Row::default()]), []);
    }

    #[test]
    fn each_count_that_is_dropped_is_found_with_item_and_hop() {
        let broken: [fn(&mut Row); 7] = [
            |row| row.expected += 1,
            |row| row.fates.delivered -= 1,
            |row| row.fates.overwritten -= 1,
            |row| row.fates.filtered -= 1,
            |row| row.fates.lost += 1,
            |row| row.written = Some(89),
            |row| row.stale = 0,
        ];
        for (at, break_it) in broken.into_iter().enumerate() {
            let mut wrong = row();
            break_it(&mut wrong);
            let found = faults(&[row(), wrong, row()]);
            assert_eq!(found.len(), 1, "{at}");
            let fault = &found[0];
            let place = (fault.name.as_str(), fault.hop.as_str());
            assert_eq!(place, ("robot1/imu", "link to mirror"), "{at}");
        }
        let mut wrong = row();
        wrong.fates.lost = 1;
        assert_eq!(
            faults(&[wrong])[0].sentence,
            "`robot1/imu` does not balance from link to mirror (robot1): 100 samples by their numbers, 97 accounted for"
        );
    }

    #[test]
    fn a_row_is_read_as_it_was_printed() {
        let printed = object(&row(), &Rates::default()).unwrap();
        let read: Row = serde_json::from_value(printed).unwrap();
        assert_eq!(read, row());
    }

    #[test]
    fn a_table_has_a_column_for_each_fate_that_befell_somebody() {
        let snapshot = Snapshot {
            rows: vec![row()],
            left_off: 0,
        };
        let lines = table(&snapshot, &[Rates::default()]).lines();
        let head: Vec<&str> = lines[0].split_whitespace().collect();
        assert_eq!(
            head,
            [
                "NAME",
                "HOP",
                "WITH",
                "RATE",
                "BYTES/S",
                "DELIVERED",
                "OVERWRITTEN",
                "FILTERED",
                "LOST",
                "LATE"
            ]
        );
    }
}
