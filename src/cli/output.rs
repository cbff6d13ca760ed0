//! Standard output: the one place that writes to it.

use std::io::{self, IsTerminal as _, Write as _};

use serde_json::Value;
use thiserror::Error;

use super::render::clip;

/// Where a verb prints. Each line is written out at once, so that a reader of the pipe sees it.
#[derive(Debug)]
pub(crate) struct Output {
    /// One JSON object per line, for programs.
    pub(crate) json: bool,
    /// Whether a person looks on.
    pub(crate) terminal: bool,
    drawn: usize,
}

/// Standard output has gone away, as when `head` has read enough.
#[derive(Debug, Error)]
#[error("standard output is closed")]
pub(crate) struct Closed;

impl Output {
    /// Standard output, with JSON lines if `json`.
    pub(crate) fn new(json: bool) -> Self {
        Self {
            json,
            terminal: io::stdout().is_terminal() && !json,
            drawn: 0,
        }
    }

    /// Prints one line.
    pub(crate) fn line(&mut self, text: &str) -> anyhow::Result<()> {
        self.drawn = 0;
        self.write(&format!("{text}\n"))
    }

    /// Prints one object on one line.
    pub(crate) fn object(&mut self, value: &Value) -> anyhow::Result<()> {
        self.line(&value.to_string())
    }

    /// Prints `value` for programs, `text` for people.
    pub(crate) fn either(&mut self, value: &Value, text: &str) -> anyhow::Result<()> {
        if self.json {
            self.object(value)
        } else {
            self.line(text)
        }
    }

    /// Replaces the lines that the last call drew. Only for a terminal.
    pub(crate) fn redraw(&mut self, lines: &[String]) -> anyhow::Result<()> {
        let mut text = match self.drawn {
            0 => String::new(),
            drawn => format!("\x1b[{drawn}A"),
        };
        // A line that wraps would be two, and the next drawing would begin too low.
        let width = rustix::termios::tcgetwinsize(io::stdout())
            .map_or(USUAL_COLUMNS, |size| usize::from(size.ws_col).max(1));
        for line in lines {
            text.push_str(&clip(line, width));
            text.push_str("\x1b[K\n");
        }
        text.push_str("\x1b[J");
        self.drawn = lines.len();
        self.write(&text)
    }

    /// Writes what a terminal is to obey.
    pub(crate) fn raw(&mut self, text: &str) -> anyhow::Result<()> {
        self.drawn = 0;
        self.write(text)
    }

    #[expect(
        clippy::unused_self,
        reason = "whoever prints must hold the output, so that nobody prints in between"
    )]
    fn write(&mut self, text: &str) -> anyhow::Result<()> {
        let mut out = io::stdout().lock();
        match out.write_all(text.as_bytes()).and_then(|()| out.flush()) {
            Ok(()) => Ok(()),
            Err(e) if e.kind() == io::ErrorKind::BrokenPipe => Err(Closed.into()),
            Err(e) => Err(anyhow::Error::new(e).context("write to standard output")),
        }
    }
}

/// Says something to the person beside the data: on standard error.
pub(crate) fn note(text: &str) {
    // Nobody is left to tell when standard error is closed.
    let _closed = writeln!(io::stderr().lock(), "{text}");
}

const USUAL_COLUMNS: usize = 80;
