//! One stream on one path: what has gone, what waits in the store, and what is on its way.

use std::collections::VecDeque;
use std::time::Duration;

use ddx_wire::sample::SampleMeta;
use ddx_wire::{Contract, Delivery, Epoch, Priority, Seq, Time};

use super::books::SentBooks;
use super::transfer::Transfer;
use super::{Want, key};

#[derive(Debug)]
pub(super) struct Flow<P> {
    pub(super) contract: Contract,
    /// Turns are taken in the order of this: bytes sent, divided by the weight.
    turn: u64,
    progress: Progress,
    /// What became of the samples since the flow was opened.
    books: SentBooks,
    /// Since when something newer waits in the store.
    pub(super) waits: Option<Time>,
    /// A reader needs the newest sample again.
    pub(super) urgent: bool,
    /// Samples that were asked for again, in order.
    gaps: VecDeque<Gap>,
    /// Requests that found no room among these.
    dropped_gaps: u64,
    /// Large samples, the newest last.
    pub(super) transfers: VecDeque<Transfer<P>>,
}

/// How far a flow has got.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Progress {
    /// Newest sample that was sent, or begun.
    newest: Option<SampleMeta>,
    /// Samples of the epoch that were left out here alone.
    left_out: u64,
}

/// Samples of one epoch that a reader lacks.
#[derive(Debug, PartialEq, Eq)]
struct Gap {
    epoch: Epoch,
    first: Seq,
    last: Seq,
    /// Only these parts of the one sample: offset and length.
    parts: Vec<(u32, u32)>,
}

impl<P: AsRef<[u8]>> Flow<P> {
    pub(super) fn new(contract: Contract, turn: u64) -> Self {
        Self {
            contract,
            turn,
            progress: Progress::default(),
            books: SentBooks::default(),
            waits: None,
            urgent: false,
            gaps: VecDeque::new(),
            dropped_gaps: 0,
            transfers: VecDeque::new(),
        }
    }

    pub(super) fn is_every(&self) -> bool {
        self.contract.delivery != Delivery::Latest
    }

    pub(super) fn is_command(&self) -> bool {
        self.contract.priority == Priority::Command
    }

    /// When it is its turn: commands are before all others.
    pub(super) fn turn(&self) -> u64 {
        if self.is_command() { 0 } else { self.turn }
    }

    /// It pays for bytes: the more weight, the less. `now` is the turn that was taken last, where those begin who were idle;
    /// returns the one that is taken now.
    pub(super) fn charge(&mut self, bytes: usize, now: u64) -> u64 {
        if self.is_command() {
            return now;
        }
        let taken = self.turn.max(now);
        let bytes = u64::try_from(bytes).unwrap_or(u64::MAX);
        let weight = u64::from(self.contract.priority.weight().max(1));
        self.turn = taken.saturating_add(bytes.saturating_mul(WEIGHT_UNIT) / weight);
        taken
    }

    /// Whether something must be read from the store.
    pub(super) fn wants_fetch(&self) -> bool {
        let busy = self.is_under_way();
        self.urgent || (!busy && (self.waits.is_some() || !self.gaps.is_empty()))
    }

    pub(super) fn is_under_way(&self) -> bool {
        self.transfers.iter().any(Transfer::is_under_way)
    }

    /// Whether more is on its way to readers that have not got the newest yet.
    pub(super) fn is_busy(&self) -> bool {
        let in_turn = self.waits.is_some() || !self.gaps.is_empty() || self.repairs();
        self.is_under_way() || (self.is_every() && in_turn)
    }

    pub(super) fn repairs(&self) -> bool {
        self.transfers.iter().any(Transfer::repairs)
    }

    /// What to read from the store next.
    ///
    /// The flag tells whether it was sent before.
    pub(super) fn fetch(&mut self, now: Time) -> Option<(Want, bool)> {
        if std::mem::take(&mut self.urgent) {
            return Some((Want::Newest, true));
        }
        if let Some(gap) = self.gaps.front() {
            return Some((Want::At(gap.epoch, gap.first), true));
        }
        let since = self.waits.take()?;
        let want = match self.sent() {
            // A burst goes out in order; on a path that is too slow the newest is worth more.
            Some((epoch, seq)) if self.is_every() || now.since(since) < BURST => {
                Want::After(epoch, seq)
            }
            Some(_) | None => Want::Newest,
        };
        // Still so until the answer says that nothing is left.
        self.waits = Some(since);
        Some((want, false))
    }

    /// Notes that a sample goes out now, and says how many of its epoch were left out before it: for all paths, as `meta`
    /// says, and here, because the path was too slow.
    pub(super) fn pass(&mut self, meta: &SampleMeta) -> u64 {
        if self.sent() >= Some(key(meta)) {
            return self.filtered(meta);
        }
        let (filtered, here) = self.skip(meta);
        self.books.filtered += filtered;
        self.books.delivered += 1;
        if self.is_every() {
            // None is left out on purpose: the ring let it go.
            self.books.overwritten += here;
        } else {
            self.books.queue_dropped += here;
            self.progress.left_out = self.progress.left_out.saturating_add(here);
        }
        self.progress.newest = Some(*meta);
        self.filtered(meta)
    }

    /// Passes over a sample that the contract keeps back, of a stream of which each is wanted; false if it was passed before.
    pub(super) fn leave_out(&mut self, meta: &SampleMeta) -> bool {
        if self.sent().is_none() || self.sent() >= Some(key(meta)) {
            return false;
        }
        let (filtered, here) = self.skip(meta);
        self.books.filtered += filtered;
        self.books.overwritten += here;
        self.books.expired += 1;
        self.progress.newest = Some(*meta);
        true
    }

    /// How many lie between the last sample and this one: those left out for all paths, and the others.
    fn skip(&mut self, meta: &SampleMeta) -> (u64, u64) {
        let (seq, filtered) = match self.progress.newest {
            Some(last) if last.epoch == meta.epoch => (last.seq.0, last.filtered),
            Some(_) => {
                self.progress.left_out = 0;
                (0, 0)
            }
            None => (meta.seq.0.saturating_sub(1), meta.filtered),
        };
        let ahead = meta.seq.0.saturating_sub(seq);
        self.books.expected = self.books.expected.saturating_add(ahead);
        let gap = ahead.saturating_sub(1);
        let filtered = meta.filtered.saturating_sub(filtered).min(gap);
        (filtered, gap - filtered)
    }

    /// What became of the samples since the flow was opened.
    pub(super) fn books(&self) -> SentBooks {
        self.books
    }

    /// Notes the payload of a sample that goes out, again or not.
    pub(super) fn count_bytes(&mut self, bytes: usize) {
        let bytes = u64::try_from(bytes).unwrap_or(u64::MAX);
        self.books.bytes = self.books.bytes.saturating_add(bytes);
    }

    /// The oldest that waits is too old: the newest may still do.
    pub(super) fn give_up(&mut self, want: Want) {
        self.waits = match want {
            Want::After(..) => Some(Time(0)),
            Want::Newest | Want::At(..) => None,
        };
    }

    /// How many were left out so far, for a sample that goes out once more.
    pub(super) fn filtered(&self, meta: &SampleMeta) -> u64 {
        let left_out = meta.filtered.saturating_add(self.progress.left_out);
        left_out.min(meta.seq.0.saturating_sub(1))
    }

    /// Newest sample that was sent here, or begun.
    pub(super) fn sent(&self) -> Option<(Epoch, Seq)> {
        self.progress.newest.as_ref().map(key)
    }

    /// How far it has got, for a flow that goes on elsewhere.
    pub(super) fn progress(&self) -> Progress {
        self.progress
    }

    /// Goes on where another flow of the stream is.
    pub(super) fn follow(&mut self, progress: Progress, newest: Option<(Epoch, Seq)>, now: Time) {
        self.progress = progress;
        let waits = progress.newest.is_some() && self.sent() < newest;
        self.waits = waits.then_some(now);
    }

    /// Its samples go another way from now on.
    pub(super) fn rest(&mut self) {
        self.progress = Progress::default();
        self.waits = None;
    }

    /// Queues samples for repair; those beyond the limit are asked for again by their reader.
    pub(super) fn add_gap(&mut self, epoch: Epoch, first: Seq, count: u32, parts: &[(u32, u32)]) {
        let last = Seq(first.0.saturating_add(u64::from(count.max(1)) - 1));
        let gap = Gap {
            epoch,
            first,
            last,
            parts: parts.to_vec(),
        };
        let known = self.gaps.iter().any(|known| {
            known.epoch == epoch
                && known.first <= first
                && last <= known.last
                && known.parts == gap.parts
        });
        if known {
            return;
        }
        if self.gaps.len() < GAPS {
            self.gaps.push_back(gap);
        } else {
            self.dropped_gaps = self.dropped_gaps.saturating_add(1);
        }
    }

    /// Requests for repair that found no room.
    pub(super) fn dropped_gaps(&self) -> u64 {
        self.dropped_gaps
    }

    /// The store gave `found` for the first sample of the first gap; `None` is nothing newer either. Returns how many
    /// samples are gone before it, the parts that are wanted, and whether it is wanted at all.
    pub(super) fn fill(&mut self, found: Option<(Epoch, Seq)>) -> Option<Filled> {
        let gap = self.gaps.front_mut()?;
        let gone_until = match found {
            Some((epoch, seq)) if epoch == gap.epoch => seq.0.saturating_sub(1).min(gap.last.0),
            Some(_) | None => gap.last.0,
        };
        let gone = (gone_until + 1).saturating_sub(gap.first.0);
        let epoch = gap.epoch;
        let wanted = found.filter(|(at, seq)| *at == epoch && *seq <= gap.last);
        let parts = std::mem::take(&mut gap.parts);
        gap.first = Seq(wanted.map_or(gap.last.0, |(_, seq)| seq.0) + 1);
        if gap.first > gap.last {
            self.gaps.pop_front();
        }
        Some(Filled {
            epoch,
            gone,
            gone_until: Seq(gone_until),
            wanted: wanted.is_some(),
            parts,
        })
    }

    /// Keeps a large sample for its repair, and drops those that nobody waits for any more.
    pub(super) fn begin(&mut self, transfer: Transfer<P>) {
        let kept = if self.is_every() { KEPT_EVERY } else { KEPT };
        while self.transfers.len() >= kept {
            self.transfers.pop_front();
        }
        self.transfers.push_back(transfer);
    }

    /// The transfer of that sample, while it is kept.
    pub(super) fn transfer(&mut self, at: (Epoch, Seq)) -> Option<&mut Transfer<P>> {
        self.transfers
            .iter_mut()
            .find(|transfer| transfer.key() == at)
    }

    /// Drops the samples that every reader holds.
    pub(super) fn release(&mut self, held: (Epoch, Seq)) {
        self.transfers.retain(|transfer| {
            transfer.key() > held || transfer.is_under_way() || transfer.repairs()
        });
    }
}

/// What came of a gap.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct Filled {
    pub(super) epoch: Epoch,
    /// Samples that cannot be had any more, up to `gone_until`.
    pub(super) gone: u64,
    pub(super) gone_until: Seq,
    /// Whether the sample that was found closes the gap, or a part of it.
    pub(super) wanted: bool,
    /// The parts of it that are wanted; none is all.
    pub(super) parts: Vec<(u32, u32)>,
}

/// Keeps the quotient of [`Flow::charge`] exact for all weights.
const WEIGHT_UNIT: u64 = 16;
/// How long the samples of a burst wait their turn before the newest alone counts.
const BURST: Duration = Duration::from_millis(20);
/// Gaps of one stream on one path that wait for repair, of at most 900 B each: 225 KiB.
const GAPS: usize = 256;
/// Large samples kept for repair: the one under way, and the one before.
const KEPT: usize = 2;
/// The same where each sample is wanted.
const KEPT_EVERY: usize = 4;
