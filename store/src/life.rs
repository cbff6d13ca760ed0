//! Learning without a system call that a new daemon has been started: a counter in the lock beside its socket.
//!
//! ```text
//! lock   bytes 0..16     pid of the daemon, as text
//!        bytes 128..136  how many daemons have served this socket, little-endian
//! ```
//!
//! Calls that block look at the socket anyway. A program that only writes would never learn that its items are unknown to
//! the new daemon; one load of this counter per write tells it.

use std::fs::File;
use std::os::fd::OwnedFd;
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};

use crate::layout::{LINE, LINE_WORDS};
use crate::ring::Words;
use crate::shm::{Map, memfd};

/// Bytes of the lock.
pub(crate) const LOCK_BYTES: u64 = 4096;
/// Where the counter lies, bytes.
pub(crate) const LIFE_OFFSET: u64 = 128;

/// The counter beside one socket, mapped.
#[derive(Debug)]
pub(crate) struct Life {
    map: Map,
    seen: AtomicU64,
}

impl Life {
    /// The counter beside the socket at `path`; none where the lock cannot be read or mapped, which costs only that a new
    /// daemon is noticed later.
    pub(crate) fn beside(path: &Path) -> Option<Self> {
        let file = File::open(path.with_extension("lock")).ok()?;
        let map = memfd::map_lock(&OwnedFd::from(file)).ok()?;
        let life = Self {
            map,
            seen: AtomicU64::new(0),
        };
        life.note(life.count());
        Some(life)
    }

    /// Takes a count as known that was read before the connection was made.
    pub(crate) fn note(&self, count: u64) {
        self.seen.store(count, Ordering::Relaxed);
    }

    /// Whether a daemon was started since. Must not be called in a forked child, where the counter is not mapped.
    #[inline]
    pub(crate) fn has_changed(&self) -> bool {
        self.count() != self.seen.load(Ordering::Relaxed)
    }

    /// How many daemons have served the socket.
    #[inline]
    pub(crate) fn count(&self) -> u64 {
        self.map.load(LINE_WORDS, Ordering::Relaxed)
    }
}

const _: () = assert!(
    LINE == 128,
    "the counter is the first word of the second line"
);
