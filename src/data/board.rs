//! What the two data threads have counted, for the control loop to show.
//!
//! Each thread puts up all of its books at one moment, between two of its steps, so that each of them balances however much
//! is on its way.

use std::net::SocketAddr;
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use ddx_catalog::delivery::{Books, PathStatus, SenderCounters, SentBooks, SourceBooks};
use ddx_wire::{StreamId, Tag, Time};

/// How often a thread that has something to do puts up its books.
pub(crate) const PERIOD: Duration = Duration::from_millis(500);

/// The newest books of both threads.
#[derive(Debug, Default)]
pub(crate) struct Board {
    outward: Mutex<Outward>,
    inward: Mutex<Inward>,
    sent: Mutex<SenderCounters>,
}

/// What the sending thread has counted.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct Outward {
    /// When it last was otherwise.
    pub(crate) at: Time,
    pub(crate) sources: Vec<(StreamId, SourceBooks)>,
    pub(crate) sent: Vec<(StreamId, SocketAddr, SentBooks)>,
    pub(crate) paths: Vec<PathStatus>,
}

/// What the receiving thread has counted.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct Inward {
    /// When it last was otherwise.
    pub(crate) at: Time,
    pub(crate) streams: Vec<(Tag, StreamId, Books, Mirrored)>,
}

/// What became of the samples that a stream delivered.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Mirrored {
    /// Written to the mirror.
    pub(crate) written: u64,
    /// Not newer than what the mirror held, which another stream had brought.
    pub(crate) stale: u64,
    /// Not taken by the mirror's segment, or without a mirror.
    pub(crate) refused: u64,
    /// Payload bytes of those that were written.
    pub(crate) bytes: u64,
}

impl Board {
    /// Puts up what the sending thread has counted.
    pub(crate) fn put_outward(&self, outward: Outward) {
        put(&self.outward, outward, |books| &mut books.at);
    }

    /// Puts up what the receiving thread has counted.
    pub(crate) fn put_inward(&self, inward: Inward) {
        put(&self.inward, inward, |books| &mut books.at);
    }

    /// Puts up what the sender has done. These are not books: they move also when nothing new is sent.
    pub(crate) fn put_sent(&self, sent: SenderCounters) {
        *self.sent.lock().unwrap_or_else(PoisonError::into_inner) = sent;
    }

    pub(crate) fn sent(&self) -> SenderCounters {
        get(&self.sent)
    }

    pub(crate) fn outward(&self) -> Outward {
        get(&self.outward)
    }

    pub(crate) fn inward(&self) -> Inward {
        get(&self.inward)
    }
}

/// Replaces books that changed. Those that did not keep their time, so that nothing at rest looks as if it moved.
fn put<T: PartialEq>(place: &Mutex<T>, mut fresh: T, at: impl Fn(&mut T) -> &mut Time) {
    // Books are replaced whole, so a panic elsewhere leaves them sound.
    let mut held = place.lock().unwrap_or_else(PoisonError::into_inner);
    let now = std::mem::replace(at(&mut fresh), *at(&mut held));
    if *held != fresh {
        *at(&mut fresh) = now;
        *held = fresh;
    }
}

fn get<T: Clone>(place: &Mutex<T>) -> T {
    let held = place.lock().unwrap_or_else(PoisonError::into_inner);
    held.clone()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn books_at_rest_keep_their_time() {
        let board = Board::default();
        let books = |at: u64, written: u64| Inward {
            at: Time(at),
            streams: vec![(
                Tag(1),
                StreamId(2),
                Books::default(),
                Mirrored {
                    written,
                    ..Mirrored::default()
                },
            )],
        };
        for (at, written, shown) in [(1, 5, 1), (2, 5, 1), (3, 6, 3), (4, 6, 3)] {
            board.put_inward(books(at, written));
            assert_eq!(board.inward(), books(shown, written));
        }
    }
}
