//! `ddx info`: one item in full.

use std::time::Duration;

use ddx_store::{Description, ReaderEntry, ReaderOptions, Store};
use ddx_wire::{HostName, Pattern};
use serde_json::{Value, json};

use super::books::Books;
use super::ls::{elapsed_ns, object, writer};
use super::render::{Table, bytes, span};
use super::subscription::Subscription;
use super::{Context, state};
use crate::error::{Exit, Hint as _, Outcome};
use crate::video;

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
            fields.insert("ways".to_owned(), json!(travels(&store, &item)?));
            fields.insert("stream".to_owned(), stream(&store, &item)?);
        }
        context.out.object(&all)?;
        return Ok(Exit::Done);
    }
    let about = stream(&store, &item)?;
    for line in lines(&item, store.host(), &travels(&store, &item)?) {
        context.out.line(&line)?;
    }
    for line in stream_lines(&about) {
        context.out.line(&line)?;
    }
    Ok(Exit::Done)
}

/// What `NAME/info` says of a stream of video; null of other items, and where nothing is heard of it.
fn stream(store: &Store, item: &Description) -> anyhow::Result<Value> {
    if item.entry.schema_hash != video::schema()?.hash() {
        return Ok(Value::Null);
    }
    let name = format!("{}/info", item.entry.name);
    let mut about = Subscription::open(store, &name, ReaderOptions::default())?;
    let seen = about.first(PATIENCE)?;
    Ok(seen.map_or(Value::Null, |seen| seen.value.clone()))
}

fn stream_lines(about: &Value) -> Vec<String> {
    let text = |value: &Value| value.as_str().unwrap_or("?").to_owned();
    let mut lines = Vec::new();
    if about.is_null() {
        return lines;
    }
    lines.push(format!("source    {}", text(&about["source"])));
    for field in about["fields"].as_array().into_iter().flatten() {
        lines.push(format!(
            "field     {}: {}x{} {}, captured as {}, {} range, {}, {} siting, {}",
            text(&field["name"]),
            field["width"],
            field["height"],
            text(&field["format"]),
            text(&field["native"]),
            text(&field["range"]).to_lowercase(),
            text(&field["matrix"]),
            text(&field["siting"]).to_lowercase(),
            text(&field["scan"]).to_lowercase(),
        ));
    }
    let parameters = about["parameters"].as_object();
    for (name, value) in parameters.into_iter().flatten() {
        lines.push(format!(
            "parameter {name} = {value}, from frame {}",
            about["from_frame"]
        ));
    }
    lines
}

/// Each way of the item between this host and another: which, since when and why, and what its link carries.
fn travels(store: &Store, item: &Description) -> anyhow::Result<Vec<String>> {
    let now = ddx_store::now().0;
    let ways = state::ways(store, &item.entry.name)?;
    let mut texts: Vec<String> = ways.iter().map(|way| way.text(now)).collect();
    if texts.is_empty() {
        return Ok(texts);
    }
    let pattern = item.entry.name.as_str();
    let pattern = Pattern::parse(pattern, store.host())?;
    for row in Books::open(store)?.take(&pattern)?.rows {
        if let Some(link) = row.link {
            texts.push(format!(
                "link to {}: {}/s, queue {}, loss {:.1} %, {} sent, {} left out",
                row.peers.join(", "),
                bytes(link.bytes_per_second),
                span(link.queue_us.saturating_mul(1_000)),
                link.loss_percent,
                row.fates.delivered,
                row.accounted() - row.fates.delivered
            ));
        }
    }
    Ok(texts)
}

fn lines(item: &Description, own: &HostName, travels: &[String]) -> Vec<String> {
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
    lines.extend(travels.iter().map(|text| format!("          {text}")));
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
                condition(reader),
            ]);
        }
        lines.extend(table.lines());
    }
    lines.push(String::new());
    lines.extend(item.schema.lines().map(str::to_owned));
    lines
}

fn condition(reader: &ReaderEntry) -> String {
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

/// How long it may take until another host has told what its stream is.
const PATIENCE: Duration = Duration::from_secs(1);
