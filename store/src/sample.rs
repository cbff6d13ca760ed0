//! What a reader is given: values with their origin, ages, and exact counts of what it missed.

use std::fmt;
use std::time::Duration;

use ddx_wire::{Epoch, Seq, Time};

use crate::segment::Stamp;

/// A value and where it comes from.
#[derive(Clone, Debug, PartialEq)]
pub struct Sample<T> {
    /// The value.
    pub value: T,
    /// Where it comes from.
    pub meta: Meta,
}

/// Where a sample comes from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Meta {
    /// Position in the segment that it was read from, contiguous from 1.
    pub pos: u64,
    /// Epoch of that segment. It differs from [`Meta::epoch`] in mirrors and for the value that a new writer found.
    pub segment: Epoch,
    /// Tenure of the writer that made it.
    pub epoch: Epoch,
    /// Its number within the epoch, from 1.
    pub seq: Seq,
    /// Samples of the epoch so far that were left out on their way to this host, because nobody here asked for them, or
    /// because the link is slower than the writer.
    pub filtered: u64,
    /// Samples of the epoch so far that gave way to newer ones in their writer's ring before they could be sent.
    pub overwritten: u64,
    /// When its content was true.
    pub capture: Time,
    /// When its writer published it.
    pub publish: Time,
    /// When it reached this host; none for an item of this host.
    pub receive: Option<Time>,
    /// How far off `capture` and `publish` may be on this host's clock, nanoseconds; none is exact, `u64::MAX` unknown.
    pub bound_ns: Option<u64>,
    /// Whether the item has no living writer.
    pub orphaned: bool,
}

/// How old a sample is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Age {
    /// Time since its capture, nanoseconds.
    pub ns: u64,
    /// How far off that may be, nanoseconds; none when the clocks have not been compared.
    pub bound: Option<u64>,
}

/// How far a reader has got: what [`crate::RawReader::after_into`] goes on from. A default cursor is before everything.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Cursor {
    /// Epoch of the last sample.
    pub epoch: Epoch,
    /// Number of the last sample.
    pub seq: Seq,
    /// Samples of the epoch that were filtered up to it.
    pub filtered: u64,
    /// Samples of the epoch that were overwritten at their host up to it.
    pub overwritten: u64,
    /// Epoch of the segment that it was read from.
    pub segment: Epoch,
    /// Its position there.
    pub pos: u64,
}

/// Samples that a reader did not get, by cause.
///
/// Of an item of another host the causes are told apart exactly where each sample is wanted
/// ([`Delivery::Every`](ddx_wire::Delivery::Every)): `overwritten` is what the writer's ring or the one of this host's mirror
/// let go, `filtered` what the contract's greatest age kept back, and `lost` what the network lost for good. Where the newest
/// is enough, what the source leaves out for whatever reason is `filtered`, and what came too late to be newer is `lost`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Missed {
    /// Were in a ring, and gave way to newer ones: here before they were read, or at their host before they were sent.
    pub overwritten: u64,
    /// Were left out because of what was asked for, at the source or here, or because the link is slower than the writer.
    pub filtered: u64,
    /// Never reached this host.
    pub lost: u64,
}

/// What follows a cursor.
#[derive(Clone, Debug, PartialEq)]
pub struct After<T> {
    /// The oldest sample after the cursor that is still there; none when there is nothing newer yet.
    pub sample: Option<Sample<T>>,
    /// What lay between the cursor and that sample.
    pub missed: Missed,
}

impl Meta {
    #[inline]
    pub(crate) fn new(stamp: &Stamp, segment: Epoch, orphaned: bool) -> Self {
        let origin = stamp.origin;
        Self {
            pos: stamp.pos,
            segment,
            epoch: origin.epoch,
            seq: origin.seq,
            filtered: origin.filtered,
            overwritten: origin.overwritten,
            capture: origin.capture,
            publish: origin.publish,
            receive: origin.receive,
            bound_ns: origin.bound_ns,
            orphaned,
        }
    }

    /// How old the sample is at `now`, by its capture time.
    pub fn age(&self, now: Time) -> Age {
        let bound = match self.bound_ns {
            None => Some(0),
            Some(u64::MAX) => None,
            bound => bound,
        };
        Age {
            ns: nanoseconds(now.since(self.capture)),
            bound,
        }
    }

    /// The cursor just behind this sample.
    #[inline]
    pub fn cursor(&self) -> Cursor {
        Cursor {
            epoch: self.epoch,
            seq: self.seq,
            filtered: self.filtered,
            overwritten: self.overwritten,
            segment: self.segment,
            pos: self.pos,
        }
    }
}

impl fmt::Display for Age {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.bound {
            None => f.write_str("?"),
            Some(0) => write!(f, "{:.1?}", Duration::from_nanos(self.ns)),
            Some(bound) => {
                let (age, bound) = (Duration::from_nanos(self.ns), Duration::from_nanos(bound));
                write!(f, "{age:.1?} ± {bound:.1?}")
            }
        }
    }
}

impl Cursor {
    /// Whether a sample of this origin is newer than all that the cursor stands for.
    #[inline]
    pub(crate) fn is_before(&self, epoch: Epoch, seq: Seq) -> bool {
        (epoch, seq) > (self.epoch, self.seq)
    }

    /// What lies between the cursor and the sample `meta`, the next one that could be read.
    pub(crate) fn missed_until(&self, meta: &Meta) -> Missed {
        let same_epoch = self.epoch == meta.epoch;
        // An epoch begins at 1, with nothing filtered: of the end of the former one nobody can tell.
        let (seq, filtered, gone) = if same_epoch {
            (self.seq.0, self.filtered, self.overwritten)
        } else {
            (0, 0, 0)
        };
        let gap = meta.seq.0.saturating_sub(seq).saturating_sub(1);
        let filtered = meta.filtered.saturating_sub(filtered).min(gap);
        let gone = meta.overwritten.saturating_sub(gone);
        let in_segment = if self.segment == meta.segment {
            self.pos
        } else {
            0
        };
        let passed = meta.pos.saturating_sub(in_segment).saturating_sub(1);
        let overwritten = match meta.receive {
            // Whatever this host's writer published was in the ring.
            None => gap - filtered,
            Some(_) => passed.saturating_add(gone).min(gap - filtered),
        };
        Missed {
            overwritten,
            filtered,
            lost: gap - filtered - overwritten,
        }
    }
}

impl Missed {
    /// All of them.
    pub fn total(&self) -> u64 {
        self.overwritten
            .saturating_add(self.filtered)
            .saturating_add(self.lost)
    }

    pub(crate) fn add(&mut self, other: Self) {
        self.overwritten = self.overwritten.saturating_add(other.overwritten);
        self.filtered = self.filtered.saturating_add(other.filtered);
        self.lost = self.lost.saturating_add(other.lost);
    }
}

fn nanoseconds(span: Duration) -> u64 {
    u64::try_from(span.as_nanos()).unwrap_or(u64::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn meta(pos: u64, seq: u64, filtered: u64, receive: Option<Time>) -> Meta {
        Meta {
            pos,
            segment: Epoch(9),
            epoch: Epoch(5),
            seq: Seq(seq),
            filtered,
            overwritten: 0,
            capture: Time(100),
            publish: Time(110),
            receive,
            bound_ns: None,
            orphaned: false,
        }
    }

    #[test]
    fn neighbours_have_nothing_between_them() {
        let first = meta(3, 3, 0, None);
        let missed = first.cursor().missed_until(&meta(4, 4, 0, None));
        assert_eq!(missed, Missed::default());
    }

    #[test]
    fn a_gap_in_a_local_ring_was_overwritten() {
        let missed = meta(3, 3, 0, None)
            .cursor()
            .missed_until(&meta(10, 10, 0, None));
        assert_eq!(
            missed,
            Missed {
                overwritten: 6,
                filtered: 0,
                lost: 0
            }
        );
    }

    #[test]
    fn a_mirror_tells_overwritten_filtered_and_lost_apart() {
        let before = meta(3, 10, 4, Some(Time(1))).cursor();
        // 19 numbers between: 7 filtered at the source, 3 overwritten there, 2 passed through the ring here, the others
        // never came.
        let missed = before.missed_until(&Meta {
            overwritten: 3,
            ..meta(6, 30, 11, Some(Time(2)))
        });
        assert_eq!(
            missed,
            Missed {
                overwritten: 5,
                filtered: 7,
                lost: 7
            }
        );
    }

    #[test]
    fn a_new_epoch_counts_from_its_beginning() {
        let mut before = meta(3, 10, 4, None).cursor();
        before.epoch = Epoch(4);
        before.segment = Epoch(8);
        let missed = before.missed_until(&meta(5, 4, 0, None));
        assert_eq!(
            missed,
            Missed {
                overwritten: 3,
                filtered: 0,
                lost: 0
            }
        );
    }

    #[test]
    fn an_unknown_bound_is_no_number() {
        let mut sample = meta(1, 1, 0, Some(Time(105)));
        assert_eq!(
            sample.age(Time(150)),
            Age {
                ns: 50,
                bound: Some(0)
            }
        );
        sample.bound_ns = Some(u64::MAX);
        assert_eq!(sample.age(Time(50)), Age { ns: 0, bound: None });
    }

    #[test]
    fn an_age_reads_as_people_say_it() {
        let said = |ns, bound| Age { ns, bound }.to_string();
        assert_eq!(said(51_300_000, Some(498_000)), "51.3ms ± 498.0µs");
        assert_eq!(said(51_300_000, Some(0)), "51.3ms");
        assert_eq!(said(0, None), "?");
    }
}
