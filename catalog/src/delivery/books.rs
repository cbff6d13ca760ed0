//! What became of each sample of one stream: at its source, on each way out, and at its receiver.

use ddx_wire::sample::SampleMeta;
use ddx_wire::{Epoch, Seq};

use super::order::Why;
use super::{Passed, key};

/// Counts of one stream. `expected` is the sum of all from `delivered` to `filtered`; the rest tell of copies.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Books {
    /// Samples from the first delivered one to the newest, over all epochs.
    pub expected: u64,
    /// Handed to the driver.
    pub delivered: u64,
    /// Arrived after a newer one was delivered.
    pub late: u64,
    /// Never arrived.
    pub link_lost: u64,
    /// Arrived in part, and were given up at the deadline or for a newer one.
    pub expired: u64,
    /// Found no room in the byte budget.
    pub over_budget: u64,
    /// Fragments that contradict one another.
    pub undecodable: u64,
    /// Left out by the source, as the contract asks or because the link is slower than the stream.
    pub filtered: u64,
    /// Gave way to newer ones in the writer's ring before they could be sent, or sent again.
    pub overwritten: u64,
    /// Further copies of samples or fragments accounted for already, or from before the first delivered sample.
    pub duplicates: u64,
    /// Samples or fragments of an epoch that is over.
    pub old_epoch: u64,
}

/// What became of the samples of one stream at their source, before any way. `expected` is the sum of all others but
/// `bytes`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SourceBooks {
    /// Samples from the first one that was offered to the newest, over all epochs, by their numbers.
    pub expected: u64,
    /// Offered to every way of the stream, or passed over while none of them had room.
    pub delivered: u64,
    /// Left out because the contract asks for fewer.
    pub rate_limited: u64,
    /// Gave way to newer ones in the writer's ring before they were read.
    pub overwritten: u64,
    /// Older than the contract allows.
    pub expired: u64,
    /// Over 64 MiB.
    pub too_large: u64,
    /// Payload bytes of those that were offered, or refused.
    pub bytes: u64,
}

/// What became of the samples of one stream on one way out. `expected` is the sum of all others but `bytes`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SentBooks {
    /// Samples from the first one that went out to the newest, over all epochs, by their numbers.
    pub expected: u64,
    /// Sent; each counted once, however often it was repeated.
    pub delivered: u64,
    /// Left out for every way, as the books of the source say in full.
    pub filtered: u64,
    /// Left out here, because this way is slower than the stream.
    pub queue_dropped: u64,
    /// Where each sample is wanted: gave way to newer ones in the writer's ring before they were sent.
    pub overwritten: u64,
    /// Where each sample is wanted: older than the contract allows when their turn came.
    pub expired: u64,
    /// Payload bytes of what was sent, repeats included.
    pub bytes: u64,
    /// Whether something newer waits in the store until this way has room.
    pub waiting: bool,
}

/// What became of a sample that arrived and was not delivered.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Failure {
    Expired,
    OverBudget,
    Undecodable,
}

/// How a sample that arrives stands to those delivered before.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Standing {
    /// Newer than all: to be delivered.
    Newer,
    /// The newest again.
    Again,
    /// Older: not to be delivered, and counted.
    Old,
}

/// Keeps the [`Books`] of a stream, and its order: the newest sample delivered.
#[derive(Debug, Default)]
pub(super) struct Ledger {
    books: Books,
    newest: Option<Newest>,
    /// Samples newer than the newest that failed; a repeat may still deliver them. Sorted, at most [`FAILURES`].
    failed: Vec<(Epoch, Seq, Failure)>,
    /// Samples before the next that the source says were overwritten, and left out.
    gone: u64,
    left_out: u64,
}

#[derive(Clone, Copy, Debug)]
struct Newest {
    epoch: Epoch,
    seq: Seq,
    filtered: u64,
    /// It came by another stream: of this one what lies before the next was not asked, and so is left out by its source,
    /// however many it counts itself.
    is_unasked: bool,
    /// Bit `n` tells whether the sample `n` before the newest is accounted for otherwise than as lost.
    settled: u64,
}

impl Ledger {
    /// Goes on after a sample that was delivered by another stream of the item: what lies behind it counts. Where each is
    /// wanted it is asked for.
    pub(super) fn resume(&mut self, epoch: Epoch, seq: Seq, is_every: bool) {
        self.newest = Some(Newest {
            epoch,
            seq,
            filtered: 0,
            is_unasked: !is_every,
            settled: u64::MAX,
        });
    }

    pub(super) fn books(&self) -> Books {
        self.books
    }

    /// Epoch and number of the newest sample delivered.
    pub(super) fn newest(&self) -> Option<(Epoch, Seq)> {
        self.newest.map(|newest| (newest.epoch, newest.seq))
    }

    /// Judges a sample or fragment; counts it unless it is newer.
    pub(super) fn judge(&mut self, meta: &SampleMeta) -> Standing {
        let Some(newest) = &mut self.newest else {
            return Standing::Newer;
        };
        if key(meta) > (newest.epoch, newest.seq) {
            return Standing::Newer;
        }
        if meta.epoch < newest.epoch {
            self.books.old_epoch += 1;
            return Standing::Old;
        }
        let behind = newest.seq.0.saturating_sub(meta.seq.0);
        let bit = 1_u64.checked_shl(u32::try_from(behind).unwrap_or(u32::MAX));
        match bit {
            Some(bit) if newest.settled & bit == 0 => {
                newest.settled |= bit;
                self.books.late += 1;
                self.books.unlose();
            }
            Some(_) | None => self.books.duplicates += 1,
        }
        if behind == 0 {
            if std::mem::take(&mut newest.is_unasked) {
                newest.filtered = meta.filtered;
            }
            Standing::Again
        } else {
            Standing::Old
        }
    }

    /// Accounts for a sample that is [`Standing::Newer`] and is delivered now.
    /// Returns what its source did not send of those before it.
    pub(super) fn deliver(&mut self, meta: &SampleMeta) -> Passed {
        let (skipped, filtered, settled) = match self.newest {
            // What came before the first sample was never asked for, so it cannot be missed.
            None => (0, 0, u64::MAX),
            Some(last) if last.epoch == meta.epoch => {
                let ahead = meta.seq.0.saturating_sub(last.seq.0);
                let shift = u32::try_from(ahead).unwrap_or(u32::MAX);
                (
                    ahead.saturating_sub(1),
                    meta.filtered.saturating_sub(last.filtered),
                    last.settled.checked_shl(shift).unwrap_or(0) | 1,
                )
            }
            Some(_) => (meta.seq.0.saturating_sub(1), meta.filtered, 1),
        };
        let filtered = match self.newest {
            Some(last) if last.is_unasked => skipped,
            Some(_) | None => filtered,
        };
        let left_out = std::mem::take(&mut self.left_out);
        let filtered = filtered.saturating_add(left_out).min(skipped);
        // What failed before the first sample lies outside the range that the books are about.
        if self.newest.is_none() {
            self.failed
                .retain(|(epoch, seq, _)| (*epoch, *seq) > key(meta));
        }
        let books = &mut self.books;
        let filtered_before = books.filtered;
        books.expected = books.expected.saturating_add(skipped).saturating_add(1);
        books.delivered += 1;
        books.filtered = books.filtered.saturating_add(filtered);
        let gone = std::mem::take(&mut self.gone).min(skipped - filtered);
        books.overwritten = books.overwritten.saturating_add(gone);
        let mut lost = skipped - filtered - gone;
        books.link_lost = books.link_lost.saturating_add(lost);
        // What the source told of one by one is accounted for, also if a part of it had come.
        let is_told = left_out > 0 || gone > 0;
        let mut newest = Newest {
            epoch: meta.epoch,
            seq: meta.seq,
            filtered: meta.filtered,
            is_unasked: false,
            settled,
        };
        if is_told && lost == 0 {
            // A copy of one of these that comes later changes nothing.
            let ahead = u32::try_from(skipped)
                .ok()
                .and_then(|n| 1_u64.checked_shl(n + 1));
            newest.settled |= ahead.map_or(u64::MAX, |bit| bit - 1);
        }
        self.failed.retain(|(epoch, seq, failure)| {
            let passed = (*epoch, *seq) < key(meta);
            if passed && *epoch == meta.epoch {
                if lost > 0 || !is_told {
                    lost = lost.saturating_sub(1);
                    let count = match failure {
                        Failure::Expired => &mut books.expired,
                        Failure::OverBudget => &mut books.over_budget,
                        Failure::Undecodable => &mut books.undecodable,
                    };
                    *count += 1;
                    books.unlose();
                }
                let behind = u32::try_from(meta.seq.0 - seq.0).unwrap_or(u32::MAX);
                newest.settled |= 1_u64.checked_shl(behind).unwrap_or(0);
            }
            (*epoch, *seq) > key(meta)
        });
        self.newest = Some(newest);
        Passed {
            overwritten: gone,
            // Without those of which parts arrived.
            filtered: self.books.filtered.saturating_sub(filtered_before),
        }
    }

    /// Notes that so many samples before the next one cannot be had.
    pub(super) fn gone(&mut self, count: u64, why: Why) {
        let counted = match why {
            Why::Overwritten => &mut self.gone,
            Why::LeftOut => &mut self.left_out,
        };
        *counted = counted.saturating_add(count);
    }

    /// Counts a further copy of a sample that is here and not delivered yet.
    pub(super) fn duplicate(&mut self) {
        self.books.duplicates += 1;
    }

    /// Notes that a [`Standing::Newer`] sample was dropped. It is booked once a newer one is delivered.
    pub(super) fn fail(&mut self, meta: &SampleMeta, failure: Failure) {
        if Some(key(meta)) <= self.newest() {
            return;
        }
        let found = self
            .failed
            .binary_search_by_key(&key(meta), |(epoch, seq, _)| (*epoch, *seq));
        match found {
            Ok(at) => {
                if let Some(entry) = self.failed.get_mut(at) {
                    entry.2 = failure;
                }
            }
            Err(at) if self.failed.len() < FAILURES => {
                self.failed.insert(at, (meta.epoch, meta.seq, failure));
            }
            // With the list full the sample is booked as lost on the link.
            Err(_) => {}
        }
    }
}

impl SourceBooks {
    /// Samples that are accounted for.
    pub fn accounted(&self) -> u64 {
        sum([
            self.delivered,
            self.rate_limited,
            self.overwritten,
            self.expired,
            self.too_large,
        ])
    }
}

impl SentBooks {
    /// Samples that are accounted for.
    pub fn accounted(&self) -> u64 {
        sum([
            self.delivered,
            self.filtered,
            self.queue_dropped,
            self.overwritten,
            self.expired,
        ])
    }
}

impl Books {
    /// Tells whether every expected sample is accounted for.
    pub fn balanced(&self) -> bool {
        self.accounted() == self.expected
    }

    /// Samples that are accounted for.
    pub fn accounted(&self) -> u64 {
        sum([
            self.delivered,
            self.late,
            self.link_lost,
            self.expired,
            self.over_budget,
            self.undecodable,
            self.filtered,
            self.overwritten,
        ])
    }

    /// Takes back a sample that was booked as missing, since its fate is known now.
    fn unlose(&mut self) {
        if self.link_lost > 0 {
            self.link_lost -= 1;
        } else if self.filtered > 0 {
            // The source said that it left the sample out, and sent it.
            self.filtered -= 1;
        } else {
            self.expected += 1;
        }
    }
}

fn sum<const N: usize>(counts: [u64; N]) -> u64 {
    counts.into_iter().fold(0, u64::saturating_add)
}

/// Failed samples of a stream remembered until a newer one is delivered.
const FAILURES: usize = 64;

#[cfg(test)]
mod tests {
    use super::*;

    fn meta(epoch: u64, seq: u64, filtered: u64) -> SampleMeta {
        SampleMeta {
            epoch: Epoch(epoch),
            seq: Seq(seq),
            filtered,
            ..SampleMeta::default()
        }
    }

    fn after(samples: &[(u64, u64, u64)]) -> Ledger {
        let mut ledger = Ledger::default();
        for (epoch, seq, filtered) in samples {
            let meta = meta(*epoch, *seq, *filtered);
            if ledger.judge(&meta) == Standing::Newer {
                ledger.deliver(&meta);
            }
        }
        assert!(ledger.books().balanced(), "{:?}", ledger.books());
        ledger
    }

    #[test]
    fn gap_is_lost_unless_filtered() {
        let books = after(&[(1, 10, 5), (1, 20, 12)]).books();
        assert_eq!(books.expected, 11);
        assert_eq!(
            (books.delivered, books.filtered, books.link_lost),
            (2, 7, 2)
        );
    }

    #[test]
    fn overtaken_sample_is_late_once_then_duplicate() {
        let books = after(&[(1, 1, 0), (1, 3, 0), (1, 2, 0), (1, 2, 0), (1, 3, 0)]).books();
        assert_eq!((books.delivered, books.late, books.link_lost), (2, 1, 0));
        assert_eq!(books.duplicates, 2);
    }

    #[test]
    fn before_the_first_is_no_loss() {
        let books = after(&[(1, 9, 0), (1, 8, 0)]).books();
        assert_eq!((books.expected, books.duplicates), (1, 1));
    }

    #[test]
    fn new_epoch_counts_from_one_and_the_old_one_never_shows() {
        let ledger = after(&[(1, 9, 0), (2, 3, 1), (1, 10, 0)]);
        let books = ledger.books();
        assert_eq!(ledger.newest(), Some((Epoch(2), Seq(3))));
        assert_eq!((books.expected, books.link_lost, books.filtered), (4, 1, 1));
        assert_eq!(books.old_epoch, 1);
    }

    #[test]
    fn failure_is_booked_when_passed_and_forgotten_when_repaired() {
        let mut ledger = after(&[(1, 1, 0)]);
        ledger.fail(&meta(1, 2, 0), Failure::Expired);
        ledger.fail(&meta(1, 3, 0), Failure::OverBudget);
        ledger.deliver(&meta(1, 3, 0));
        let books = ledger.books();
        assert_eq!(
            (books.expired, books.over_budget, books.link_lost),
            (1, 0, 0)
        );
        assert!(books.balanced());
        assert_eq!(ledger.judge(&meta(1, 2, 0)), Standing::Old);
        assert_eq!(ledger.books().duplicates, 1);
    }

    #[test]
    fn failure_before_the_first_is_outside_the_range() {
        let mut ledger = Ledger::default();
        ledger.fail(&meta(1, 4, 0), Failure::Expired);
        ledger.deliver(&meta(1, 6, 0));
        let books = ledger.books();
        assert_eq!((books.expected, books.delivered, books.expired), (1, 1, 0));
    }

    #[test]
    fn failure_ahead_is_kept_until_it_is_passed() {
        let mut ledger = after(&[(1, 1, 0)]);
        ledger.fail(&meta(1, 3, 0), Failure::Undecodable);
        ledger.deliver(&meta(1, 2, 0));
        assert_eq!(ledger.books().undecodable, 0);
        ledger.deliver(&meta(1, 4, 0));
        assert_eq!(ledger.books().undecodable, 1);
        assert!(ledger.books().balanced());
    }

    #[test]
    fn what_the_source_let_go_is_not_lost_on_the_link() {
        let mut ledger = after(&[(1, 1, 0)]);
        ledger.gone(3, Why::Overwritten);
        let passed = ledger.deliver(&meta(1, 6, 0));
        assert_eq!((passed.overwritten, passed.filtered), (3, 0));
        ledger.gone(9, Why::Overwritten);
        let passed = ledger.deliver(&meta(1, 7, 0));
        assert_eq!((passed.overwritten, passed.filtered), (0, 0));
        ledger.gone(2, Why::LeftOut);
        ledger.gone(1, Why::Overwritten);
        let passed = ledger.deliver(&meta(1, 12, 0));
        assert_eq!((passed.overwritten, passed.filtered), (1, 2));
        let books = ledger.books();
        let missing = (books.overwritten, books.filtered, books.link_lost);
        assert_eq!(missing, (4, 2, 2));
        assert!(books.balanced());
    }

    #[test]
    fn a_stream_that_goes_on_for_another_counts_what_lies_between() {
        let mut ledger = Ledger::default();
        ledger.resume(Epoch(1), Seq(10), false);
        assert_eq!(ledger.judge(&meta(1, 10, 9)), Standing::Again);
        // Its first sample says that all before were left out, as of a new stream they were.
        let passed = ledger.deliver(&meta(1, 15, 14));
        assert_eq!(passed.filtered, 4);
        let passed = ledger.deliver(&meta(1, 17, 14));
        assert_eq!(passed.filtered, 0);
        let books = ledger.books();
        assert_eq!((books.expected, books.delivered), (7, 2));
        assert_eq!((books.filtered, books.link_lost), (4, 1));
        assert!(books.balanced());
    }

    #[test]
    fn what_lies_before_the_first_of_a_stream_that_others_read_was_not_asked_of_it() {
        for (epoch, missed) in [(1, 4), (2, 14)] {
            for (is_every, filtered) in [(false, missed), (true, 0)] {
                let mut ledger = Ledger::default();
                ledger.resume(Epoch(1), Seq(10), is_every);
                // It left out none for those.
                assert_eq!(ledger.deliver(&meta(epoch, 15, 0)).filtered, filtered);
                assert_eq!(ledger.deliver(&meta(epoch, 17, 0)).filtered, 0);
                let books = ledger.books();
                assert_eq!(books.link_lost, missed - filtered + 1, "{books:?}");
            }
        }
    }

    #[test]
    fn what_came_in_part_is_not_told_to_be_left_out() {
        let mut ledger = after(&[(1, 1, 0)]);
        ledger.fail(&meta(1, 2, 0), Failure::Expired);
        ledger.fail(&meta(1, 3, 0), Failure::Expired);
        assert_eq!(ledger.deliver(&meta(1, 4, 1)).filtered, 0);
        let books = ledger.books();
        assert_eq!((books.expired, books.filtered), (2, 0), "{books:?}");
    }

    #[test]
    fn a_stream_that_begins_with_what_is_held_counts_from_there() {
        let mut ledger = Ledger::default();
        ledger.resume(Epoch(1), Seq(10), false);
        assert_eq!(ledger.judge(&meta(1, 10, 9)), Standing::Again);
        // The contract left one out.
        assert_eq!(ledger.deliver(&meta(1, 12, 10)).filtered, 1);
        let books = ledger.books();
        assert_eq!((books.filtered, books.link_lost), (1, 0), "{books:?}");
    }

    #[test]
    fn hostile_numbers_stay_balanced() {
        let books = after(&[(0, 1, u64::MAX), (0, u64::MAX, 0), (1, 1, u64::MAX)]).books();
        assert_eq!(books.delivered, 3);
    }
}
