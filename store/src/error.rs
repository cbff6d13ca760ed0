//! Why a call of the store fails.

use std::io;
use std::path::PathBuf;

use thiserror::Error;

use crate::control::Refusal;
use crate::schema::SchemaError;

/// Why a call of the store fails.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum Error {
    /// The daemon refused, and says why.
    #[error(transparent)]
    Refused(#[from] Refusal),
    /// No daemon answers at this socket.
    #[error("no daemon answers at `{}`; hint: start one with `ddx up`", path.display())]
    NoDaemon {
        /// The socket.
        path: PathBuf,
        /// What the last attempt said.
        source: io::Error,
    },
    /// No socket was found.
    #[error("no daemon runs here: no socket below `{}`; hint: start one with `ddx up`, or set DDX_SOCKET", dir.display())]
    NoSocket {
        /// Where sockets are looked for.
        dir: PathBuf,
    },
    /// More than one daemon runs here.
    #[error(
        "several daemons run here; hint: set DDX_SOCKET to one of {}",
        list(sockets)
    )]
    ManySockets {
        /// Their sockets.
        sockets: Vec<PathBuf>,
    },
    /// Another daemon serves this socket.
    #[error("socket `{}` is served by a daemon with pid {holder}", path.display())]
    Served {
        /// The socket.
        path: PathBuf,
        /// What the holder wrote into the lock: its pid.
        holder: String,
    },
    /// The daemon did not answer in time.
    #[error("the daemon did not answer within {0} ms")]
    Timeout(u64),
    /// The daemon is gone, and the call needs it.
    #[error("the daemon is gone")]
    Gone,
    /// The daemon speaks another language.
    #[error("unexpected message from the daemon: {0}")]
    Protocol(String),
    /// The handle was made before a fork.
    #[error("the handle was opened before a fork; hint: open the store anew in the child process")]
    Forked,
    /// The payload does not fit the item.
    #[error("payload of {len} bytes is longer than the item's capacity of {capacity}")]
    TooLong {
        /// Length of the payload, bytes.
        len: usize,
        /// The item's capacity, bytes.
        capacity: usize,
    },
    /// All of the reader's pins are in use.
    #[error(
        "no pin is left: the reader holds {0} samples; hint: drop a guard, or open it with more pins"
    )]
    NoPin(u32),
    /// A value does not fit its schema.
    #[error(transparent)]
    Schema(#[from] SchemaError),
    /// Shared memory that another process handed over is not as it must be.
    #[error("segment refused: {0}")]
    Segment(String),
    /// An argument that cannot be.
    #[error("{0}")]
    Argument(String),
    /// The system refused.
    #[error("{what}")]
    Os {
        /// What was tried.
        what: String,
        /// What the system said.
        source: io::Error,
    },
}

impl Error {
    /// Adds what was tried to an error of the system: for `map_err`.
    pub(crate) fn os<E: Into<io::Error>>(what: impl Into<String>) -> impl FnOnce(E) -> Self {
        let what = what.into();
        move |source| Self::Os {
            what,
            source: source.into(),
        }
    }
}

fn list(paths: &[PathBuf]) -> String {
    let shown: Vec<_> = paths
        .iter()
        .map(|path| format!("`{}`", path.display()))
        .collect();
    shown.join(", ")
}
