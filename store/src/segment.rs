//! One item's memory as its writer, its readers and the daemon hold it: the ring protocol of [`crate::ring`] over
//! mapped segments, with payloads.
//!
//! ```text
//! SegmentWriter --- SegmentFds (data, ctl) --- SegmentReader   maps data read-only and ctl read-write
//!                                         \--- SegmentControl  the daemon's: the same maps, no seat
//! ```
//!
//! Guards keep the mappings alive, so a segment that was superseded stays readable for as long as it is held. Every
//! handle remembers the process that made it: its mappings are absent after a fork, so all calls then report that
//! instead of touching memory ([`crate::shm::fork`]).

mod books;
mod control;
mod reader;
mod writer;

use std::io;
use std::os::fd::OwnedFd;
use std::sync::Arc;

use ddx_wire::{Epoch, Seq, Time};
use thiserror::Error;

pub use self::books::ReaderBooks;
pub use self::control::SegmentControl;
pub use self::reader::{Copier, Pin, PinError, SegmentReader};
pub use self::writer::{LoanError, SegmentWriter, Slot};
pub use crate::layout::{LayoutError, Spec};
pub use crate::notify::Bell;
use crate::ring::STAMP_WORDS;
use crate::shm::{Map, ShmError};

/// The two files of a segment, as they are handed over.
#[derive(Debug)]
pub struct SegmentFds {
    /// Samples; sealed so that only the mapping of its writer can change it.
    pub data: OwnedFd,
    /// Pins, waiting readers and state; writable for all who hold it.
    pub ctl: OwnedFd,
}

/// A segment on the heap of one process: the twin of [`SegmentFds`] for tests.
#[derive(Clone, Debug)]
pub struct HeapSegment {
    data: Arc<Map>,
    ctl: Arc<Map>,
}

/// Where a sample comes from; travels with it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Origin {
    /// Tenure of the writer that made it.
    pub epoch: Epoch,
    /// Its number within the epoch, from 1.
    pub seq: Seq,
    /// Samples of the epoch so far that were filtered on their way here.
    pub filtered: u64,
    /// Samples of the epoch so far that gave way to newer ones before they left their host.
    pub overwritten: u64,
    /// When its content was true.
    pub capture: Time,
    /// When its writer published it.
    pub publish: Time,
    /// When it reached this host, for a sample of another.
    pub receive: Option<Time>,
    /// How far off the above may be on this host's clock, nanoseconds. `None` is exact (a local sample), `u64::MAX`
    /// unknown.
    pub bound_ns: Option<u64>,
}

/// What is stored beside a payload.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Stamp {
    /// Position in this segment: contiguous, from 1.
    pub pos: u64,
    /// Bytes of the payload.
    pub len: usize,
    /// Where the sample comes from.
    pub origin: Origin,
}

/// A reader's place in a segment, as the daemon grants it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Seat {
    /// Index of its cell.
    pub cell: u32,
    /// Samples it may hold at one time: [`crate::layout::BASE_PINS`] and what was granted from the item's pool.
    pub pins: u32,
    /// What the writer rings when this reader waits.
    pub bell: Bell,
}

/// What became of a segment. All three are hints: whoever holds `ctl` can set them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct State {
    /// A newer segment of the item exists; ask the daemon.
    pub superseded: bool,
    /// The writer is gone; the last value stays.
    pub orphaned: bool,
    /// The item was removed.
    pub removed: bool,
}

/// Why a segment cannot be made or mapped.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum SegmentError {
    /// Its figures are outside the limits, or its header lies.
    #[error(transparent)]
    Layout(#[from] LayoutError),
    /// The memory cannot be had, or is not sealed as it must be.
    #[error(transparent)]
    Shm(#[from] ShmError),
    /// The cell or its pins lie outside the segment.
    #[error("cell {cell} with {pins} pins does not exist in this segment")]
    Seat {
        /// Index of the cell.
        cell: u32,
        /// Pins asked for.
        pins: u32,
    },
}

impl SegmentFds {
    /// Duplicates both descriptors. Fails when the process has no more.
    pub fn try_clone(&self) -> io::Result<Self> {
        Ok(Self {
            data: self.data.try_clone()?,
            ctl: self.ctl.try_clone()?,
        })
    }
}

impl Origin {
    #[inline]
    fn to_words(self, len: u64) -> [u64; STAMP_WORDS] {
        [
            len,
            self.epoch.0,
            self.seq.0,
            self.filtered,
            self.capture.0,
            self.publish.0,
            self.receive.map_or(0, |time| time.0),
            // One up, so that 0 is "exact"; the largest stays "unknown".
            self.bound_ns.map_or(0, |bound| bound.saturating_add(1)),
            self.overwritten,
        ]
    }
}

impl Stamp {
    #[inline]
    fn from_words(pos: u64, len: usize, words: &[u64; STAMP_WORDS]) -> Self {
        let [
            _,
            epoch,
            seq,
            filtered,
            capture,
            publish,
            receive,
            bound,
            overwritten,
        ] = *words;
        let origin = Origin {
            epoch: Epoch(epoch),
            seq: Seq(seq),
            filtered,
            overwritten,
            capture: Time(capture),
            publish: Time(publish),
            receive: (receive != 0).then_some(Time(receive)),
            bound_ns: match bound {
                0 => None,
                u64::MAX => Some(u64::MAX),
                bound => Some(bound - 1),
            },
        };
        Self { pos, len, origin }
    }
}

impl State {
    const SUPERSEDED: u64 = 1;
    const ORPHANED: u64 = 2;
    const REMOVED: u64 = 4;

    #[inline]
    fn from_word(word: u64) -> Self {
        Self {
            superseded: word & Self::SUPERSEDED != 0,
            orphaned: word & Self::ORPHANED != 0,
            removed: word & Self::REMOVED != 0,
        }
    }

    fn to_word(self) -> u64 {
        let bit = |is_set: bool, bit: u64| if is_set { bit } else { 0 };
        bit(self.superseded, Self::SUPERSEDED)
            | bit(self.orphaned, Self::ORPHANED)
            | bit(self.removed, Self::REMOVED)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_origin_survives_the_header() {
        let local = Origin {
            epoch: Epoch(1 << 40),
            seq: Seq(9),
            filtered: 3,
            overwritten: 2,
            capture: Time(100),
            publish: Time(200),
            receive: None,
            bound_ns: None,
        };
        for origin in [
            local,
            Origin {
                receive: Some(Time(7)),
                bound_ns: Some(0),
                ..local
            },
            Origin {
                receive: Some(Time(7)),
                bound_ns: Some(5_000),
                ..local
            },
            Origin {
                receive: Some(Time(7)),
                bound_ns: Some(u64::MAX),
                ..local
            },
        ] {
            let stamp = Stamp::from_words(4, 64, &origin.to_words(64));
            assert_eq!(
                stamp,
                Stamp {
                    pos: 4,
                    len: 64,
                    origin
                }
            );
        }
    }

    #[test]
    fn a_state_survives_its_word() {
        for word in 0..8 {
            assert_eq!(State::from_word(word).to_word(), word);
        }
        assert_eq!(State::from_word(!7), State::default());
    }
}
