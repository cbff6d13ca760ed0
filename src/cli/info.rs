//! `ddx info`: one item in full.

use ddx_store::{Description, ReaderEntry};
use ddx_wire::HostName;
use serde_json::{Value, json};

use super::Context;
use super::ls::{elapsed_ns, object, writer};
use super::render::{Table, bytes, span};
use crate::error::{Exit, Hint as _, Outcome};

/// Which item.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Name of the item
    name: String,
}

/// Runs the verb.
pub(crate) fn run(context: &mut Context, args: &Args) -> Outcome {
    let store = context.store("info")?;
    let item = store.describe(&args.name).hint(|| {
        format!(
            "`ddx why {}` says more, `ddx ls` lists what there is",
            args.name
        )
    })?;
    if context.out.json {
        let mut all = object(&item.entry, ddx_store::now());
        if let Some(fields) = all.as_object_mut() {
            fields.insert("schema".to_owned(), json!(item.schema));
            fields.insert("epoch".to_owned(), json!(item.epoch.0));
            fields.insert("published".to_owned(), json!(item.published));
            fields.insert(
                "reader_list".to_owned(),
                item.readers.iter().map(reader_object).collect(),
            );
            fields.insert("path".to_owned(), json!(item.note));
        }
        context.out.object(&all)?;
        return Ok(Exit::Done);
    }
    for line in lines(&item, store.host()) {
        context.out.line(&line)?;
    }
    Ok(Exit::Done)
}

fn lines(item: &Description, own: &HostName) -> Vec<String> {
    let entry = &item.entry;
    let written = entry.last_publish.map_or_else(
        || "?".to_owned(),
        |at| format!("{} ago", span(elapsed_ns(at, ddx_store::now()))),
    );
    let path = match (item.note.as_str(), entry.host == *own) {
        ("", true) => "local: no other host reads it",
        ("", false) => "none: nobody on this host reads it, so nothing is sent",
        (note, _) => note,
    };
    let mut lines = vec![
        format!("name      {}", entry.name),
        format!("host      {}", entry.host),
        format!("writer    {}", writer(entry)),
        format!(
            "written   {written}; {} samples in epoch {}",
            item.published, item.epoch.0
        ),
        format!(
            "capacity  {} a sample",
            bytes(u64::from(entry.capacity_bytes))
        ),
        format!("path      {path}"),
    ];
    if item.readers.is_empty() {
        lines.push("readers   none on this host".to_owned());
    } else {
        let mut table = Table::new(&["readers ", "PROGRAM", "PID", "CONTRACT", "STATE"]);
        for reader in &item.readers {
            table.row(vec![
                String::new(),
                reader.program.clone(),
                reader.pid.to_string(),
                reader.contract.to_string(),
                state(reader),
            ]);
        }
        lines.extend(table.lines());
    }
    lines.push(String::new());
    lines.extend(item.schema.lines().map(str::to_owned));
    lines
}

fn state(reader: &ReaderEntry) -> String {
    match (&reader.refused, reader.bound) {
        (Some(reason), _) => format!("refused: {reason}"),
        (None, true) => "reads".to_owned(),
        (None, false) => "waits for the item".to_owned(),
    }
}

fn reader_object(reader: &ReaderEntry) -> Value {
    json!({
        "program": reader.program,
        "pid": reader.pid,
        "contract": reader.contract.to_string(),
        "bound": reader.bound,
        "refused": reader.refused,
    })
}
