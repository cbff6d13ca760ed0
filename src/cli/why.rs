//! `ddx why`: one sentence on why a reader of an item gets nothing or too little, or that all is well.
//!
//! It walks writer, store, contract, path, link and reader. What is missing altogether is seen at once; for all else it looks
//! on for a second.

mod flow;
#[cfg(test)]
mod tests;

use ddx_store::{Description, Error, Refusal, Store};
use ddx_wire::{ItemName, Pattern, WriterState};
use serde_json::json;

use self::flow::{Flow, Step};
use super::books::Books;
use super::ls::elapsed_ns;
use super::render::span;
use super::{Context, state};
use crate::config::nearest;
use crate::error::{Exit, Hint as _, Outcome};

/// Which item.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Name of the item
    name: String,
    /// Say what was found at each step
    #[arg(short, long)]
    verbose: bool,
}

/// The answer.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Verdict {
    /// One word for programs.
    pub(crate) reason: Reason,
    /// One sentence for people.
    pub(crate) sentence: String,
    /// What to do about it.
    pub(crate) hint: Option<String>,
    /// What was found on the way of a sample, as far as it got.
    pub(crate) steps: Vec<Step>,
}

/// Why a reader gets nothing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Reason {
    /// It should get everything.
    Fine,
    NoSuchName,
    NoWriter,
    HostUnreachable,
    NothingWritten,
    SchemaMismatch,
    NoKey,
    /// Other hosts are there, and seal with another key.
    OtherKey,
    ReaderGone,
    /// The contract keeps all of it back.
    Contract,
    /// It comes by unicast, because multicast does not work.
    NoMulticast,
    /// The link carries less than what is wanted of it.
    SlowLink,
    /// Too much is lost on the way.
    Loss,
    /// A reader takes less than what comes.
    SlowReader,
}

/// All that the verdict rests on.
#[derive(Debug)]
struct Facts<'a> {
    name: &'a ItemName,
    /// Whether the name lies under this host's prefix or is administrative.
    local: bool,
    item: Option<&'a Description>,
    key: bool,
    hosts: &'a [state::Host],
    /// Names that exist, to guess what was meant.
    others: &'a [String],
    now_ns: u64,
    /// Whether another host reads it from here.
    read_elsewhere: bool,
    /// Datagrams that were sealed with another key.
    foreign: u64,
}

/// Runs the verb.
pub(crate) fn run(context: &mut Context, args: &Args) -> Outcome {
    let store = context.store("why")?;
    let verdict = explain(&store, &args.name)?;
    let object = json!({
        "name": args.name,
        "reason": verdict.reason.word(),
        "sentence": verdict.sentence,
        "hint": verdict.hint,
        "steps": verdict.steps.iter().map(Step::object).collect::<Vec<_>>(),
    });
    context.out.either(&object, &verdict.sentence)?;
    if context.out.json {
        return Ok(Exit::Done);
    }
    if let Some(hint) = &verdict.hint {
        context.out.line(&format!("hint: {hint}"))?;
    }
    if args.verbose {
        for step in &verdict.steps {
            context.out.line(&step.line())?;
        }
    }
    Ok(Exit::Done)
}

/// Finds out why a reader of `name` gets nothing.
pub(crate) fn explain(store: &Store, name: &str) -> Result<Verdict, crate::error::Failure> {
    let name = ItemName::parse(name, store.host()).arguments()?;
    let item = match store.describe(name.as_str()) {
        Ok(item) => Some(item),
        Err(Error::Refused(Refusal::Absent(_))) => None,
        Err(error) => return Err(error.into()),
    };
    let others: Vec<String> = store
        .list(&Pattern::everything())?
        .into_iter()
        .map(|entry| entry.name.to_string())
        .collect();
    let ways = state::ways(store, &name)?;
    let missing = verdict(&Facts {
        local: name.is_under(store.host()) || name.is_admin(),
        name: &name,
        item: item.as_ref(),
        key: state::own(store)?.key,
        hosts: &state::hosts(store)?,
        others: &others,
        now_ns: ddx_store::now().0,
        foreign: state::foreign(store)?,
        read_elsewhere: ways.iter().any(|way| way.is_out),
    });
    let (Reason::Fine, Some(item)) = (missing.reason, item) else {
        return Ok(missing);
    };
    let mut books = Books::open(store)?;
    let pattern = Pattern::parse(name.as_str(), store.host()).arguments()?;
    let before = books.take(&pattern)?;
    books.wait()?;
    let after = books.take(&pattern)?;
    let rates = after.rates(&before);
    let flow = Flow {
        name: &name,
        item: &item,
        own: name.is_under(store.host()),
        ways: &ways,
        rows: after.rows.iter().zip(rates).collect(),
        now_ns: ddx_store::now().0,
    };
    Ok(flow.judge(missing))
}

fn verdict(facts: &Facts<'_>) -> Verdict {
    let host = facts
        .hosts
        .iter()
        .find(|host| host.host == facts.name.prefix());
    if !facts.local && !facts.key {
        let sentence = format!(
            "this host has no key, so that it does not see `{}`",
            facts.name.prefix()
        );
        return Verdict::new(Reason::NoKey, sentence)
            .hint("`ddx up --key FILE`, with the same file on each host");
    }
    if let Some(host) = host
        && host.state != "up"
        && !facts.local
    {
        return unreachable(host, facts);
    }
    let Some(item) = facts.item.filter(|item| item.entry.writer.is_some()) else {
        return absent(host, facts);
    };
    present(item, facts)
}

fn unreachable(host: &state::Host, facts: &Facts<'_>) -> Verdict {
    let since = host
        .since
        .map(|since| span(facts.now_ns.saturating_sub(since)));
    let sentence = match (host.state.as_str(), since) {
        ("left", Some(since)) => format!("host `{}` left {since} ago", host.host),
        ("left", None) => format!("host `{}` left", host.host),
        (state, Some(since)) => format!("host `{}` has been {state} for {since}", host.host),
        (state, None) => format!("host `{}` is {state}", host.host),
    };
    Verdict::new(Reason::HostUnreachable, sentence).hint("`ddx host ls` shows all hosts")
}

fn absent(host: Option<&state::Host>, facts: &Facts<'_>) -> Verdict {
    let owner = facts.name.prefix();
    let sentence = if facts.local {
        format!("this host has no item `{}`", facts.name)
    } else if host.is_some() {
        format!("host `{owner}` is up and has no item `{}`", facts.name)
    } else if facts.foreign > 0 {
        let sentence = format!(
            "no host `{owner}` is known, and {} datagrams came that are sealed with another key",
            facts.foreign
        );
        return Verdict::new(Reason::OtherKey, sentence)
            .hint("give each host the same key file: `ddx up --key FILE`");
    } else {
        format!("no host `{owner}` is known")
    };
    let close = nearest(
        facts.name.as_str(),
        facts
            .others
            .iter()
            .map(String::as_str)
            .filter(|other| *other != facts.name.as_str()),
    );
    let verdict = Verdict::new(Reason::NoSuchName, sentence);
    match close {
        Some(close) => verdict.hint(format!("did you mean `{close}`?")),
        None => verdict.hint("`ddx ls` lists all items, `ddx host ls` all hosts"),
    }
}

fn present(item: &Description, facts: &Facts<'_>) -> Verdict {
    let (name, program) = (facts.name, &item.entry.program);
    if let Some(reader) = item.readers.iter().find(|reader| reader.refused.is_some()) {
        let difference = reader.refused.as_deref().unwrap_or_default();
        let sentence = format!(
            "`{}` (pid {}) was refused: {difference}",
            reader.program, reader.pid
        );
        return Verdict::new(Reason::SchemaMismatch, sentence)
            .hint(format!("`ddx info {name}` shows the item's schema"));
    }
    // Of another host's item this host has the samples only once a reader is bound to its mirror.
    let would_show = facts.local || item.readers.iter().any(|reader| reader.bound);
    let picky = item
        .readers
        .iter()
        .find(|reader| reader.contract.max_age_ms.is_some());
    if item.published == 0
        && would_show
        && !facts.local
        && let Some(reader) = picky
    {
        // It may be written all the time: what is too old does not leave its host.
        let sentence = format!(
            "nothing of `{name}` has come, and `{}` (pid {}) takes only what is at most {} ms old",
            reader.program,
            reader.pid,
            reader.contract.max_age_ms.unwrap_or_default()
        );
        return Verdict::new(Reason::Contract, sentence).hint(format!(
            "`ddx why {name}` on `{}` says whether what is written there is older",
            name.prefix()
        ));
    }
    if item.published == 0 && would_show {
        let sentence = format!("`{program}` has opened `{name}` and written nothing yet");
        return Verdict::new(Reason::NothingWritten, sentence);
    }
    let keeper = match item.entry.writer {
        Some(WriterState::Daemon) => "the daemon keeps it".to_owned(),
        Some(WriterState::Live | WriterState::Orphaned) | None => format!("`{program}` writes it"),
    };
    let age = item.entry.last_publish.map_or_else(String::new, |at| {
        let ago = span(elapsed_ns(at, ddx_wire::Time(facts.now_ns)));
        format!(", the last value {ago} ago")
    });
    if item.entry.writer == Some(WriterState::Orphaned) {
        let sentence = format!("`{name}` has no writer: `{program}` is gone{age}");
        return Verdict::new(Reason::NoWriter, sentence);
    }
    if item.entry.readers == 0 && !facts.read_elsewhere {
        let sentence = format!("nobody on this host reads `{name}`; {keeper}{age}");
        return Verdict::new(Reason::ReaderGone, sentence);
    }
    let readers = item.entry.readers;
    let sentence = format!("all is well with `{name}`: {keeper}{age}; {readers} read it here");
    Verdict::new(Reason::Fine, sentence)
}

impl Verdict {
    fn new(reason: Reason, sentence: String) -> Self {
        Self {
            reason,
            sentence,
            hint: None,
            steps: Vec::new(),
        }
    }

    fn hint(self, hint: impl Into<String>) -> Self {
        Self {
            hint: Some(hint.into()),
            ..self
        }
    }
}

impl Reason {
    fn word(self) -> &'static str {
        match self {
            Self::Fine => "fine",
            Self::NoSuchName => "no-such-name",
            Self::NoWriter => "no-writer",
            Self::HostUnreachable => "host-unreachable",
            Self::NothingWritten => "nothing-written",
            Self::SchemaMismatch => "schema-mismatch",
            Self::NoKey => "no-key",
            Self::OtherKey => "other-key",
            Self::ReaderGone => "reader-gone",
            Self::Contract => "contract",
            Self::NoMulticast => "no-multicast",
            Self::SlowLink => "slow-link",
            Self::Loss => "loss",
            Self::SlowReader => "slow-reader",
        }
    }
}
