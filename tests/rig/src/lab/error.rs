//! Why a laboratory could not be built, or a step in it failed.

use std::error;
use std::fmt;
use std::io;
use std::time::Duration;

/// Says what failed in a lab, with the facts that a person needs to mend it.
#[derive(Debug)]
#[non_exhaustive]
pub enum Error {
    /// This machine lacks something that a lab is made of; each line names one thing and how to get it.
    Missing(Vec<String>),
    /// A host list or an option that no lab can be built from.
    Invalid(String),
    /// A command of the lab itself failed.
    Step {
        /// What was being done.
        step: String,
        /// What the command said.
        detail: String,
    },
    /// A program did not do in time what it was waited for.
    TimedOut {
        /// What was waited for.
        what: String,
        /// For how long.
        waited: Duration,
        /// The last lines that the program wrote.
        output: String,
    },
    /// The operating system refused a call of the rig.
    Io {
        /// What was being done.
        step: String,
        /// What the system said.
        source: io::Error,
    },
}

impl Error {
    pub(crate) fn io(step: impl Into<String>) -> impl FnOnce(io::Error) -> Self {
        let step = step.into();
        move |source| Self::Io { step, source }
    }

    pub(crate) fn step(step: impl Into<String>, detail: impl Into<String>) -> Self {
        Self::Step {
            step: step.into(),
            detail: detail.into(),
        }
    }
}

impl fmt::Display for Error {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Missing(things) => write!(f, "no lab on this machine: {}", things.join("; ")),
            Self::Invalid(what) => write!(f, "{what}"),
            Self::Step { step, detail } => write!(f, "{step} failed: {}", detail.trim_end()),
            Self::TimedOut {
                what,
                waited,
                output,
            } => {
                write!(
                    f,
                    "waited {waited:?} for {what}; the last output was:\n{output}"
                )
            }
            Self::Io { step, source } => write!(f, "{step} failed: {source}"),
        }
    }
}

impl error::Error for Error {
    fn source(&self) -> Option<&(dyn error::Error + 'static)> {
        match self {
            Self::Io { source, .. } => Some(source),
            Self::Missing(_) | Self::Invalid(_) | Self::Step { .. } | Self::TimedOut { .. } => None,
        }
    }
}
