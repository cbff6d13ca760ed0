//! `ddx doctor`: looks at the host, the socket, buffers and limits, the other hosts, multicast and clocks, and says what to
//! do about what it finds.
//!
//! All facts are gathered first (`facts.rs`), then judged by pure functions (`judge.rs`, `others.rs`, `counters.rs`), so that each
//! judgement has a test.

mod counters;
mod facts;
mod judge;
mod multicast;
mod others;
#[cfg(test)]
mod tests;

use serde_json::{Value, json};

use self::facts::Facts;
use super::Context;
use crate::error::{Exit, Outcome};

/// What to look at.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    #[command(subcommand)]
    what: Option<What>,
}

/// One thing to look at closely.
#[derive(Debug, clap::Subcommand)]
enum What {
    /// Show between which hosts multicast passes, and in which direction
    Multicast(multicast::Args),
}

/// What one check found: one line, and one more when there is something to do.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Finding {
    level: Level,
    /// One word for programs.
    check: &'static str,
    /// Of which host, interface or counter, where there may be several.
    subject: String,
    /// What was looked at, and the figure.
    text: String,
    /// What to do about it.
    hint: Option<String>,
}

/// How bad it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Level {
    Ok,
    /// Something works less well than it could, or not with everybody.
    Warn,
    /// Nothing works before this is mended.
    Fail,
}

/// Runs the verb.
pub(crate) fn run(context: &mut Context, args: &Args) -> Outcome {
    if let Some(What::Multicast(args)) = &args.what {
        return multicast::run(context, args);
    }
    let findings = judge::all(&Facts::gather(context.socket.as_deref()));
    if context.out.json {
        for finding in &findings {
            context.out.object(&finding.object())?;
        }
    } else {
        for line in lines(&findings) {
            context.out.line(&line)?;
        }
    }
    Ok(exit(findings.iter().all(|found| found.level == Level::Ok)))
}

fn exit(all_well: bool) -> Exit {
    if all_well { Exit::Done } else { Exit::Failed }
}

fn lines(findings: &[Finding]) -> Vec<String> {
    let names: Vec<String> = findings
        .iter()
        .map(|found| format!("{} {}", found.check, found.subject))
        .map(|name| name.trim_end().to_owned())
        .collect();
    // A long name does not push all others aside.
    let widths = names.iter().map(|name| name.chars().count());
    let width = widths.filter(|width| *width <= WIDTH_MOST).max();
    let width = width.unwrap_or_default();
    let mut lines = Vec::new();
    for (found, name) in findings.iter().zip(&names) {
        let level = found.level.word();
        lines.push(format!("{level:<4}  {name:<width$}  {}", found.text));
        if let Some(hint) = &found.hint {
            lines.push(format!("      hint: {hint}"));
        }
    }
    let count = |level| findings.iter().filter(|f| f.level == level).count();
    let better = match count(Level::Warn) {
        0 => None,
        1 => Some("1 thing could be better".to_owned()),
        several => Some(format!("{several} things could be better")),
    };
    let failed = match count(Level::Fail) {
        0 => None,
        1 => Some("1 check failed".to_owned()),
        several => Some(format!("{several} checks failed")),
    };
    let sum: Vec<String> = failed.into_iter().chain(better).collect();
    lines.push(if sum.is_empty() {
        "all is well".to_owned()
    } else {
        sum.join(", ")
    });
    lines
}

impl Finding {
    fn new(level: Level, check: &'static str, text: impl Into<String>) -> Self {
        Self {
            level,
            check,
            subject: String::new(),
            text: text.into(),
            hint: None,
        }
    }

    fn ok(check: &'static str, text: impl Into<String>) -> Self {
        Self::new(Level::Ok, check, text)
    }

    fn warn(check: &'static str, text: impl Into<String>, hint: impl Into<String>) -> Self {
        Self {
            hint: Some(hint.into()),
            ..Self::new(Level::Warn, check, text)
        }
    }

    fn fail(check: &'static str, text: impl Into<String>, hint: impl Into<String>) -> Self {
        Self {
            hint: Some(hint.into()),
            ..Self::new(Level::Fail, check, text)
        }
    }

    fn of(self, subject: impl Into<String>) -> Self {
        Self {
            subject: subject.into(),
            ..self
        }
    }

    fn object(&self) -> Value {
        json!({
            "level": self.level.word(),
            "check": self.check,
            "subject": Some(&self.subject).filter(|subject| !subject.is_empty()),
            "text": self.text,
            "hint": self.hint,
        })
    }
}

impl Level {
    fn word(self) -> &'static str {
        match self {
            Self::Ok => "ok",
            Self::Warn => "warn",
            Self::Fail => "fail",
        }
    }
}

/// Longest name in the column of names.
const WIDTH_MOST: usize = 24;
