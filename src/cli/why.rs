//! `ddx why`: one sentence on why a reader of an item gets nothing, or that all is well.

use ddx_store::{Description, Error, Refusal, Store};
use ddx_wire::{ItemName, Pattern, WriterState};
use serde_json::json;

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
    ReaderGone,
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
    });
    context.out.either(&object, &verdict.sentence)?;
    if let (false, Some(hint)) = (context.out.json, verdict.hint) {
        context.out.line(&format!("hint: {hint}"))?;
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
    Ok(verdict(&Facts {
        local: name.is_under(store.host()) || name.is_admin(),
        name: &name,
        item: item.as_ref(),
        key: state::own(store)?.key,
        hosts: &state::hosts(store)?,
        others: &others,
        now_ns: ddx_store::now().0,
    }))
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
    if item.entry.readers == 0 {
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
            Self::ReaderGone => "reader-gone",
        }
    }
}

#[cfg(test)]
mod tests {
    use ddx_store::{ItemEntry, ReaderEntry};
    use ddx_wire::{Contract, Epoch, HostName, SchemaHash, Time};

    use super::*;

    const NOW_NS: u64 = 10_000_000_000;

    fn item(writer: WriterState) -> Description {
        let host = HostName::parse("robot1").unwrap();
        Description {
            entry: ItemEntry {
                name: ItemName::parse("robot1/gps/fix", &host).unwrap(),
                host,
                schema_name: "Fix".to_owned(),
                schema_hash: SchemaHash::default(),
                writer: Some(writer),
                program: "gpsd".to_owned(),
                pid: None,
                readers: 1,
                last_publish: Some(Time(NOW_NS - 2_000_000_000)),
                capacity_bytes: 64,
            },
            schema: String::new(),
            epoch: Epoch(1),
            published: 7,
            newest: None,
            depth: 8,
            readers: Vec::new(),
            note: String::new(),
        }
    }

    fn host(state: &str) -> state::Host {
        state::Host {
            host: "robot1".to_owned(),
            id: String::new(),
            state: state.to_owned(),
            addr: None,
            rtt_us: None,
            loss_percent: None,
            paths: Vec::new(),
            since: Some(NOW_NS - 4_000_000_000),
        }
    }

    fn ask(key: bool, hosts: &[state::Host], item: Option<&Description>) -> Verdict {
        let base = HostName::parse("base").unwrap();
        verdict(&Facts {
            name: &ItemName::parse("robot1/gps/fix", &base).unwrap(),
            local: false,
            item,
            key,
            hosts,
            others: &["robot1/gps/fox".to_owned()],
            now_ns: NOW_NS,
        })
    }

    #[test]
    fn each_reason_has_its_sentence() {
        let live = item(WriterState::Live);
        let mut silent = item(WriterState::Live);
        silent.published = 0;
        silent.entry.last_publish = None;
        silent.readers.push(ReaderEntry {
            program: "map".to_owned(),
            pid: 7,
            contract: Contract::default(),
            bound: true,
            refused: None,
            books: None,
        });
        let orphaned = item(WriterState::Orphaned);
        let mut unread = item(WriterState::Live);
        unread.entry.readers = 0;
        let mut refused = item(WriterState::Live);
        refused.readers.push(ReaderEntry {
            program: "map".to_owned(),
            pid: 7,
            contract: Contract::default(),
            bound: false,
            refused: Some("field `latitude` is f32, f64 expected".to_owned()),
            books: None,
        });
        let up = [host("up")];

        for (verdict, reason, sentence) in [
            (
                ask(false, &[], None),
                Reason::NoKey,
                "this host has no key, so that it does not see `robot1`",
            ),
            (
                ask(true, &[], None),
                Reason::NoSuchName,
                "no host `robot1` is known",
            ),
            (
                ask(true, &up, None),
                Reason::NoSuchName,
                "host `robot1` is up and has no item `robot1/gps/fix`",
            ),
            (
                ask(true, &[host("unreachable")], Some(&live)),
                Reason::HostUnreachable,
                "host `robot1` has been unreachable for 4.00 s",
            ),
            (
                ask(true, &[host("left")], Some(&live)),
                Reason::HostUnreachable,
                "host `robot1` left 4.00 s ago",
            ),
            (
                ask(true, &up, Some(&silent)),
                Reason::NothingWritten,
                "`gpsd` has opened `robot1/gps/fix` and written nothing yet",
            ),
            (
                ask(true, &up, Some(&orphaned)),
                Reason::NoWriter,
                "`robot1/gps/fix` has no writer: `gpsd` is gone, the last value 2.00 s ago",
            ),
            (
                ask(true, &up, Some(&refused)),
                Reason::SchemaMismatch,
                "`map` (pid 7) was refused: field `latitude` is f32, f64 expected",
            ),
            (
                ask(true, &up, Some(&unread)),
                Reason::ReaderGone,
                "nobody on this host reads `robot1/gps/fix`; `gpsd` writes it, the last value 2.00 s ago",
            ),
            (
                ask(true, &up, Some(&live)),
                Reason::Fine,
                "all is well with `robot1/gps/fix`: `gpsd` writes it, the last value 2.00 s ago; 1 read it here",
            ),
        ] {
            assert_eq!(verdict.reason, reason, "{sentence}");
            assert_eq!(verdict.sentence, sentence);
        }
    }

    #[test]
    fn a_name_that_is_almost_right_is_guessed() {
        let verdict = ask(true, &[host("up")], None);

        assert_eq!(
            verdict.hint.as_deref(),
            Some("did you mean `robot1/gps/fox`?")
        );
    }
}
