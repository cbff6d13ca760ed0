//! How a run of the program ends, and what it says when it failed.
//!
//! A verb returns `Result<Exit, Failure>`; `cli::main` prints the failure and is the one place that turns either into an
//! exit code.

use std::fmt;
use std::process::ExitCode;

/// How a run ends.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Exit {
    /// Done.
    Done,
    /// Not done.
    Failed,
    /// What was asked makes no sense.
    BadArguments,
    /// Done, but part of the input or output was lost; the run has said what.
    DoneWithLoss,
}

/// Why a verb failed, with what a person can do about it.
#[derive(Debug)]
pub struct Failure {
    exit: Exit,
    error: anyhow::Error,
    hint: Option<String>,
}

/// What a verb returns.
pub type Outcome = Result<Exit, Failure>;

/// Adds a hint to whatever fails.
pub trait Hint<T> {
    /// Says what a person can do about the failure.
    fn hint(self, hint: impl FnOnce() -> String) -> Result<T, Failure>;

    /// Marks the failure as one of the arguments: exit code 2.
    fn arguments(self) -> Result<T, Failure>;
}

impl Failure {
    /// A run that failed for `reason`.
    pub fn new(reason: impl fmt::Display + fmt::Debug + Send + Sync + 'static) -> Self {
        anyhow::Error::msg(reason).into()
    }

    /// Arguments that make no sense: exit code 2.
    pub fn arguments(reason: impl fmt::Display + fmt::Debug + Send + Sync + 'static) -> Self {
        Self {
            exit: Exit::BadArguments,
            ..Self::new(reason)
        }
    }

    /// Says what a person can do about it.
    #[must_use]
    pub fn with_hint(mut self, hint: impl Into<String>) -> Self {
        self.hint = Some(hint.into());
        self
    }

    /// Says what was being done.
    #[must_use]
    pub fn context(self, what: impl fmt::Display + Send + Sync + 'static) -> Self {
        Self {
            error: self.error.context(what),
            ..self
        }
    }

    /// The exit that the failure asks for.
    pub fn exit(&self) -> Exit {
        self.exit
    }

    /// The error with its chain of causes.
    pub fn error(&self) -> &anyhow::Error {
        &self.error
    }
}

impl fmt::Display for Failure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        // A library puts its hint behind its own sentence; the causes belong between the two.
        let mut own = None;
        let mut sentences = Vec::new();
        for cause in self.error.chain() {
            let text = cause.to_string();
            let (sentence, hint) = match text.split_once("hint: ") {
                Some((sentence, hint)) => (sentence, Some(hint.to_owned())),
                None => (text.as_str(), None),
            };
            own = own.or(hint);
            let sentence = sentence.trim_end_matches(['\n', ' ', ';', ',']).to_owned();
            // A transparent error repeats its cause.
            if sentences.last() != Some(&sentence) {
                sentences.push(sentence);
            }
        }
        write!(f, "error: {}", sentences.join(": "))?;
        match self.hint.as_deref().or(own.as_deref()) {
            Some(hint) => write!(f, "\nhint: {hint}"),
            None => Ok(()),
        }
    }
}

impl<E: Into<anyhow::Error>> From<E> for Failure {
    fn from(error: E) -> Self {
        Self {
            exit: Exit::Failed,
            error: error.into(),
            hint: None,
        }
    }
}

impl<T, E: Into<Failure>> Hint<T> for Result<T, E> {
    fn hint(self, hint: impl FnOnce() -> String) -> Result<T, Failure> {
        self.map_err(|error| error.into().with_hint(hint()))
    }

    fn arguments(self) -> Result<T, Failure> {
        self.map_err(|error| Failure {
            exit: Exit::BadArguments,
            ..error.into()
        })
    }
}

impl From<Exit> for ExitCode {
    fn from(exit: Exit) -> Self {
        Self::from(match exit {
            Exit::Done => 0,
            Exit::Failed => 1,
            Exit::BadArguments => 2,
            Exit::DoneWithLoss => 3,
        })
    }
}

#[cfg(test)]
mod tests {
    use anyhow::Context as _;

    use super::*;

    #[test]
    fn a_failure_prints_its_causes_in_one_line_and_the_hint_last() {
        let refused = Err::<(), _>(std::io::Error::other("disk full")).context("write `a.log`");

        let failure = refused.hint(|| "free some space".to_owned()).unwrap_err();

        assert_eq!(
            failure.to_string(),
            "error: write `a.log`: disk full\nhint: free some space"
        );
        assert_eq!(failure.exit(), Exit::Failed);
    }

    #[test]
    fn the_hint_of_a_library_moves_to_its_own_line() {
        let failure = Failure::new("`a/b` is not under `robot1`; hint: `./a/b`");

        assert_eq!(
            failure.to_string(),
            "error: `a/b` is not under `robot1`\nhint: `./a/b`"
        );
    }
}
