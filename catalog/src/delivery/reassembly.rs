//! Fragments to samples, under a byte budget and a deadline; the newest sample of a stream wins.

use std::collections::BTreeMap;
use std::time::Duration;

use ddx_wire::sample::{Fragment, Record, SampleMeta};
use ddx_wire::{StreamId, Tag, Time};

use super::books::Failure;
use super::deadlines::Deadlines;
use super::key;

/// Samples of which some fragments have arrived: at most one for each stream.
#[derive(Debug)]
pub(super) struct Reassembly {
    budget_bytes: usize,
    held_bytes: usize,
    partials: BTreeMap<(Tag, StreamId), Partial>,
    deadlines: Deadlines<(Tag, StreamId)>,
}

/// What a fragment led to.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct Step {
    /// The sample that is whole now.
    pub(super) whole: Option<(SampleMeta, Vec<u8>)>,
    /// A sample that was given up: the stream's earlier one, or the fragment's own.
    pub(super) failed: Option<(SampleMeta, Failure)>,
}

#[derive(Debug)]
struct Partial {
    meta: SampleMeta,
    bytes: Vec<u8>,
    /// Ranges that have arrived: sorted, disjoint, never adjacent.
    ranges: Vec<(usize, usize)>,
}

impl Reassembly {
    pub(super) fn new(budget_bytes: usize) -> Self {
        Self {
            budget_bytes,
            held_bytes: 0,
            partials: BTreeMap::new(),
            deadlines: Deadlines::new(),
        }
    }

    /// Adds a fragment that is newer than what the stream has delivered.
    pub(super) fn insert(
        &mut self,
        tag: Tag,
        record: &Record<'_>,
        fragment: Fragment,
        now: Time,
    ) -> Step {
        let at = (tag, record.stream);
        let mut failed = None;
        match self.partials.get(&at).map(|p| key(&p.meta)) {
            Some(present) if present > key(&record.meta) => {
                return Step::failed(record.meta, Failure::Expired);
            }
            Some(present) if present < key(&record.meta) => {
                failed = self.remove(at).map(|p| (p.meta, Failure::Expired));
            }
            Some(_) | None => {}
        }
        if !self.partials.contains_key(&at) {
            let total = usize::try_from(fragment.total).unwrap_or(usize::MAX);
            if total > self.budget_bytes.saturating_sub(self.held_bytes) {
                // An older sample given up at the same time is left to the books as lost.
                return Step::failed(record.meta, Failure::OverBudget);
            }
            self.held_bytes += total;
            let partial = Partial {
                meta: record.meta,
                bytes: vec![0; total],
                ranges: Vec::new(),
            };
            self.partials.insert(at, partial);
        }
        // Each fragment prolongs it, so that what one repeat lost the next can bring.
        self.deadlines.set(at, now + DEADLINE);
        let added = self
            .partials
            .get_mut(&at)
            .map(|partial| partial.add(fragment, record.payload));
        match added {
            Some(Added::Whole) => Step {
                whole: self.remove(at).map(|partial| (partial.meta, partial.bytes)),
                failed,
            },
            Some(Added::Contradiction) => {
                self.remove(at);
                Step::failed(record.meta, Failure::Undecodable)
            }
            Some(Added::Part) | None => Step {
                whole: None,
                failed,
            },
        }
    }

    /// Gives up the stream's incomplete sample if it is not newer than one that is delivered now.
    pub(super) fn pass(
        &mut self,
        tag: Tag,
        stream: StreamId,
        delivered: &SampleMeta,
    ) -> Option<SampleMeta> {
        let at = (tag, stream);
        let pending = self.partials.get(&at)?.meta;
        if key(&pending) > key(delivered) {
            return None;
        }
        self.remove(at).map(|partial| partial.meta)
    }

    /// Gives up a stream's incomplete sample, if any.
    pub(super) fn forget(&mut self, tag: Tag, stream: StreamId) {
        self.remove((tag, stream));
    }

    pub(super) fn deadline(&self) -> Option<Time> {
        self.deadlines.first()
    }

    /// Gives up one sample whose deadline has come.
    pub(super) fn expire(&mut self, now: Time) -> Option<(Tag, StreamId, SampleMeta)> {
        let (tag, stream) = self.deadlines.pop(now)?;
        let partial = self.remove((tag, stream))?;
        Some((tag, stream, partial.meta))
    }

    fn remove(&mut self, at: (Tag, StreamId)) -> Option<Partial> {
        self.deadlines.clear(at);
        let partial = self.partials.remove(&at)?;
        self.held_bytes -= partial.bytes.len();
        Some(partial)
    }
}

impl Step {
    fn failed(meta: SampleMeta, failure: Failure) -> Self {
        Self {
            whole: None,
            failed: Some((meta, failure)),
        }
    }
}

enum Added {
    Part,
    Whole,
    Contradiction,
}

impl Partial {
    /// Copies a fragment to its place. Fragments repeat or abut; those that overlap in part, or disagree on the length
    /// of the sample, are contradictions.
    fn add(&mut self, fragment: Fragment, payload: &[u8]) -> Added {
        let (Ok(total), Ok(start)) = (
            usize::try_from(fragment.total),
            usize::try_from(fragment.offset),
        ) else {
            return Added::Contradiction;
        };
        if total != self.bytes.len() {
            return Added::Contradiction;
        }
        let end = start + payload.len();
        let next = self.ranges.partition_point(|(_, e)| *e <= start);
        match self.ranges.get(next) {
            Some((s, e)) if *s <= start && end <= *e => return Added::Part,
            Some((s, _)) if *s < end => return Added::Contradiction,
            Some(_) | None => {}
        }
        let Some(place) = self.bytes.get_mut(start..end) else {
            return Added::Contradiction;
        };
        place.copy_from_slice(payload);
        self.ranges.insert(next, (start, end));
        self.merge(next);
        if next > 0 {
            self.merge(next - 1);
        }
        if self.ranges.len() > RANGES {
            return Added::Contradiction;
        }
        if self.ranges.as_slice() == [(0, total)] {
            return Added::Whole;
        }
        Added::Part
    }

    /// Joins range `at` with the one after it if they touch.
    fn merge(&mut self, at: usize) {
        if let (Some((_, end)), Some((start, far))) = (
            self.ranges.get(at).copied(),
            self.ranges.get(at + 1).copied(),
        ) && end == start
        {
            self.ranges.remove(at + 1);
            if let Some(range) = self.ranges.get_mut(at) {
                range.1 = far;
            }
        }
    }
}

/// `PROTOCOL.md#fragments`: an incomplete sample is given up 500 ms after its last fragment.
const DEADLINE: Duration = Duration::from_millis(500);
/// Gaps in a sample: a sample of 64 KiB in fragments of a full datagram has fewer.
const RANGES: usize = 64;

#[cfg(test)]
mod tests {
    use ddx_wire::Seq;

    use super::*;

    const TAG: Tag = Tag(1);
    const STREAM: StreamId = StreamId(2);

    fn meta(seq: u64) -> SampleMeta {
        SampleMeta {
            seq: Seq(seq),
            ..SampleMeta::default()
        }
    }

    fn insert(r: &mut Reassembly, seq: u64, total: u32, offset: u32, payload: &[u8]) -> Step {
        let fragment = Fragment { total, offset };
        let record = Record {
            stream: STREAM,
            repeat: false,
            meta: meta(seq),
            fragment: Some(fragment),
            payload,
        };
        r.insert(TAG, &record, fragment, Time(0))
    }

    #[test]
    fn any_order_and_repeats_make_the_sample() {
        let mut r = Reassembly::new(100);
        for (offset, part) in [(4, b"ef"), (0, b"ab"), (4, b"ef")] {
            assert_eq!(insert(&mut r, 1, 6, offset, part).whole, None);
        }
        let step = insert(&mut r, 1, 6, 2, b"cd");
        assert_eq!(step.whole, Some((meta(1), b"abcdef".to_vec())));
        assert_eq!(r.held_bytes, 0);
        assert_eq!(r.deadline(), None);
    }

    #[test]
    fn newest_wins() {
        let mut r = Reassembly::new(100);
        insert(&mut r, 1, 4, 0, b"ab");
        let step = insert(&mut r, 2, 4, 0, b"AB");
        assert_eq!(step.failed, Some((meta(1), Failure::Expired)));
        let step = insert(&mut r, 1, 4, 2, b"cd");
        assert_eq!(step.failed, Some((meta(1), Failure::Expired)));
        let step = insert(&mut r, 2, 4, 2, b"CD");
        assert_eq!(step.whole, Some((meta(2), b"ABCD".to_vec())));
    }

    #[test]
    fn contradictions_drop_the_sample() {
        for (total, offset, payload) in [(5, 2, &b"cd"[..]), (4, 1, b"xx"), (9, 8, b"x")] {
            let mut r = Reassembly::new(100);
            insert(&mut r, 1, 4, 0, b"ab");
            let step = insert(&mut r, 1, total, offset, payload);
            assert_eq!(step.failed, Some((meta(1), Failure::Undecodable)));
            assert_eq!(r.held_bytes, 0);
        }
    }

    #[test]
    fn budget_refuses_what_does_not_fit() {
        let mut r = Reassembly::new(5);
        let step = insert(&mut r, 1, 6, 0, b"ab");
        assert_eq!(step.failed, Some((meta(1), Failure::OverBudget)));
        assert_eq!(insert(&mut r, 2, 5, 0, b"ab").failed, None);
        assert_eq!(r.held_bytes, 5);
    }

    #[test]
    fn deadline_frees_the_budget() {
        let mut r = Reassembly::new(10);
        insert(&mut r, 1, 6, 0, b"ab");
        let at = r.deadline().unwrap();
        assert_eq!(r.expire(Time(at.0 - 1)), None);
        assert_eq!(r.expire(at), Some((TAG, STREAM, meta(1))));
        assert_eq!(r.held_bytes, 0);
    }
}
