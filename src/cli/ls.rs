//! `ddx ls`: the items, here and on other hosts.

use ddx_store::ItemEntry;
use ddx_wire::{Time, WriterState};
use serde_json::{Value, json};

use super::render::{Table, span};
use super::{Context, pattern};
use crate::error::{Exit, Outcome};

/// Which items.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Names to list; `*` is one chunk, `**` any number [default: `**`]
    pattern: Option<String>,
}

/// Runs the verb.
pub(crate) fn run(context: &mut Context, args: &Args) -> Outcome {
    let store = context.store("ls")?;
    let pattern = pattern(&store, args.pattern.as_deref())?;
    let entries = store.list(&pattern)?;
    let now = ddx_store::now();
    if context.out.json {
        for entry in &entries {
            context.out.object(&object(entry, now))?;
        }
        return Ok(Exit::Done);
    }
    let mut table = Table::new(&["NAME", "TYPE", "WRITER", "READERS", "WRITTEN"]);
    for entry in &entries {
        table.row(vec![
            entry.name.to_string(),
            known(&entry.schema_name),
            writer(entry),
            entry.readers.to_string(),
            entry.last_publish.map_or_else(
                || "?".to_owned(),
                |at| format!("{} ago", span(elapsed_ns(at, now))),
            ),
        ]);
    }
    for line in table.lines() {
        context.out.line(&line)?;
    }
    Ok(Exit::Done)
}

/// Who writes the item, in a few words.
pub(crate) fn writer(entry: &ItemEntry) -> String {
    match (entry.writer, entry.pid) {
        (Some(WriterState::Live), Some(pid)) => format!("{} ({pid})", entry.program),
        (Some(WriterState::Live), None) => entry.program.clone(),
        (Some(WriterState::Orphaned), _) => "none".to_owned(),
        (Some(WriterState::Daemon), _) => "daemon".to_owned(),
        (None, _) => "?".to_owned(),
    }
}

/// One entry for programs.
pub(crate) fn object(entry: &ItemEntry, now: Time) -> Value {
    json!({
        "name": entry.name.as_str(),
        "host": entry.host.as_str(),
        "type": entry.schema_name,
        "schema_hash": entry.schema_hash.to_string(),
        "writer": entry.writer.map(state),
        "program": entry.program,
        "pid": entry.pid,
        "readers": entry.readers,
        "written_ns_ago": entry.last_publish.map(|at| elapsed_ns(at, now)),
        "capacity_bytes": entry.capacity_bytes,
    })
}

fn state(writer: WriterState) -> &'static str {
    match writer {
        WriterState::Live => "live",
        WriterState::Orphaned => "orphaned",
        WriterState::Daemon => "daemon",
    }
}

/// Nanoseconds from `at` to `now`.
pub(crate) fn elapsed_ns(at: Time, now: Time) -> u64 {
    now.0.saturating_sub(at.0)
}

fn known(text: &str) -> String {
    if text.is_empty() { "?" } else { text }.to_owned()
}
