//! Fragments to samples, under a byte budget and a deadline, and what to ask for again meanwhile.

use std::collections::BTreeMap;
use std::time::Duration;

use ddx_wire::message::NACK_PARTS_MAX;
use ddx_wire::sample::{Fragment, Record, SampleMeta};
use ddx_wire::{Epoch, Seq, StreamId, Tag, Time};

use super::books::Failure;
use super::deadlines::Deadlines;
use super::{key, parity};

/// Samples of which some fragments have arrived: a few of each stream.
#[derive(Debug)]
pub(super) struct Reassembly {
    budget_bytes: usize,
    held_bytes: usize,
    partials: BTreeMap<Place, Partial>,
    deadlines: Deadlines<Place>,
}

/// One sample of one stream.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Place {
    pub(super) tag: Tag,
    pub(super) stream: StreamId,
    pub(super) epoch: Epoch,
    pub(super) seq: Seq,
}

/// How a fragment is to be taken.
#[derive(Clone, Copy, Debug)]
pub(super) struct Rules {
    /// Incomplete samples of the stream that may be held.
    pub(super) depth: usize,
    /// Whether each sample is wanted: the oldest incomplete one comes first, and what has no room now is asked for later.
    pub(super) in_order: bool,
    /// How long an answer of the sender takes.
    pub(super) round_trip: Duration,
    /// How long to wait before asking, so that not all receivers of a group ask at once.
    pub(super) patience: Duration,
}

/// What a fragment led to.
#[derive(Debug, Default, PartialEq, Eq)]
pub(super) struct Step {
    /// The sample that is whole now.
    pub(super) whole: Option<(SampleMeta, Vec<u8>)>,
    /// A sample that was given up: an earlier one of the stream, or the fragment's own.
    pub(super) failed: Option<(SampleMeta, Failure)>,
}

/// What came of a deadline.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Due {
    /// Ask for these parts: offset and length.
    Ask(Vec<(u32, u32)>),
    /// The sample is given up.
    Expired(SampleMeta),
}

#[derive(Debug)]
struct Partial {
    meta: SampleMeta,
    bytes: Vec<u8>,
    /// Ranges that have arrived: sorted, disjoint, never adjacent.
    ranges: Vec<(usize, usize)>,
    /// When the last fragment came.
    last: Time,
    /// Longest fragment but the last: all others have its length. 0 until one of them or a parity came.
    step: usize,
    /// The parities that came, by their numbers, of those that there are.
    parities: BTreeMap<u8, Vec<u8>>,
    parities_of: u8,
    round_trip: Duration,
    patience: Duration,
    /// Requests since the last fragment.
    asked: u32,
    /// Whether what comes now was asked for: the sender is done with it otherwise.
    repaired: bool,
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
        rules: Rules,
        now: Time,
    ) -> Step {
        let place = Place::of(tag, record.stream, &record.meta);
        let mut failed = None;
        if !self.partials.contains_key(&place) {
            let held = self.of(tag, record.stream).map(|(place, _)| *place);
            let held: Vec<Place> = held.collect();
            if held.len() >= rules.depth {
                let given_up = match rules.in_order {
                    true => held.last().filter(|newest| **newest > place),
                    // The newest are worth more.
                    false => held.first().filter(|oldest| **oldest < place),
                };
                match given_up {
                    Some(other) => {
                        failed = self.remove(*other).map(|p| (p.meta, Failure::Expired));
                    }
                    None => return Step::failed(record.meta, Failure::Expired),
                }
            }
            let total = usize::try_from(fragment.total).unwrap_or(usize::MAX);
            let room = self.budget_bytes.saturating_sub(self.held_bytes);
            if total.saturating_add(PARTIAL_BYTES + RANGE_BYTES) > room {
                // An older sample given up at the same time is left to the books as lost.
                return Step::failed(record.meta, Failure::OverBudget);
            }
            self.held_bytes += total + PARTIAL_BYTES;
            let partial = Partial {
                meta: record.meta,
                bytes: vec![0; total],
                ranges: Vec::new(),
                last: now,
                step: 0,
                parities: BTreeMap::new(),
                parities_of: fragment.parities,
                round_trip: rules.round_trip,
                patience: rules.patience,
                asked: 0,
                repaired: false,
            };
            self.partials.insert(place, partial);
        }
        let Some(partial) = self.partials.get_mut(&place) else {
            return Step::default();
        };
        (partial.last, partial.asked) = (now, 0);
        let room = self.budget_bytes.saturating_sub(self.held_bytes);
        let before = partial.held_bytes();
        let added = partial.add(fragment, record.payload, room);
        self.held_bytes = self.held_bytes - before + partial.held_bytes();
        if self.held_bytes > self.budget_bytes && !matches!(added, Added::Whole) {
            // Its ranges alone: fragments that are honest leave few.
            self.remove(place);
            return Step::failed(record.meta, Failure::OverBudget);
        }
        match added {
            Added::Whole => Step {
                whole: self
                    .remove(place)
                    .map(|partial| (partial.meta, partial.bytes)),
                failed,
            },
            Added::Contradiction => {
                self.remove(place);
                Step::failed(record.meta, Failure::Undecodable)
            }
            Added::Part => {
                // A gap is asked for soon, the end of the sample once nothing comes any more. Where parities are to come
                // they may close the gap.
                let soon = now + REORDERING + partial.patience;
                if partial.has_gap() && partial.parities_of == 0 {
                    self.deadlines.set_earlier(place, soon);
                } else if partial.is_sent() {
                    self.deadlines.set(place, soon);
                } else {
                    self.deadlines.set(place, now + partial.tail_wait());
                }
                Step {
                    whole: None,
                    failed,
                }
            }
        }
    }

    /// Gives up a sample of the stream that is not newer than one that is delivered now.
    pub(super) fn pass(
        &mut self,
        tag: Tag,
        stream: StreamId,
        delivered: &SampleMeta,
    ) -> Option<SampleMeta> {
        let oldest = self.of(tag, stream).next().map(|(place, _)| *place)?;
        if (oldest.epoch, oldest.seq) > key(delivered) {
            return None;
        }
        self.remove(oldest).map(|partial| partial.meta)
    }

    /// Gives up a stream's incomplete samples, if any.
    pub(super) fn forget(&mut self, tag: Tag, stream: StreamId) {
        let places: Vec<Place> = self.of(tag, stream).map(|(place, _)| *place).collect();
        for place in places {
            self.remove(place);
        }
    }

    /// Whether some fragments of a sample have arrived.
    pub(super) fn has(&self, place: &Place) -> bool {
        self.partials.contains_key(place)
    }

    /// Bytes of incomplete samples, with what each takes beside its payload.
    #[cfg(test)]
    pub(super) fn held_bytes(&self) -> usize {
        self.held_bytes
    }

    pub(super) fn deadline(&self) -> Option<Time> {
        self.deadlines.first()
    }

    /// Deals with one sample whose deadline has come.
    pub(super) fn due(&mut self, now: Time) -> Option<(Place, Due)> {
        let place = self.deadlines.pop(now)?;
        let partial = self.partials.get_mut(&place)?;
        if now.since(partial.last) >= GIVE_UP.max(8 * partial.round_trip) {
            let meta = partial.meta;
            self.remove(place);
            return Some((place, Due::Expired(meta)));
        }
        let is_quiet = now.since(partial.last) >= partial.tail_wait();
        partial.repaired |= is_quiet || partial.is_sent();
        let parts = partial.missing(is_quiet);
        // The answer takes a round trip, and comes at the sender's pace. A burst of loss ends only when something is sent.
        let backoff = 1 << partial.asked.min(1);
        partial.asked += 1;
        let wait = (partial.round_trip + REORDERING) * backoff + partial.patience;
        self.deadlines.set(place, now + wait);
        Some((place, Due::Ask(parts)))
    }

    fn of(&self, tag: Tag, stream: StreamId) -> impl Iterator<Item = (&Place, &Partial)> {
        let first = Place {
            tag,
            stream,
            epoch: Epoch(0),
            seq: Seq(0),
        };
        let last = Place {
            epoch: Epoch(u64::MAX),
            seq: Seq(u64::MAX),
            ..first
        };
        self.partials.range(first..=last)
    }

    fn remove(&mut self, place: Place) -> Option<Partial> {
        self.deadlines.clear(place);
        let partial = self.partials.remove(&place)?;
        self.held_bytes -= partial.held_bytes();
        Some(partial)
    }
}

impl Place {
    pub(super) fn of(tag: Tag, stream: StreamId, meta: &SampleMeta) -> Self {
        Self {
            tag,
            stream,
            epoch: meta.epoch,
            seq: meta.seq,
        }
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
    fn held_bytes(&self) -> usize {
        let ranges = self.ranges.len() * RANGE_BYTES;
        self.bytes.len() + self.parities.len() * self.step + ranges + PARTIAL_BYTES
    }

    fn has_gap(&self) -> bool {
        self.ranges.len() > 1 || self.ranges.first().is_some_and(|(start, _)| *start > 0)
    }

    /// Whether the last of its parities has come, or what was asked for comes.
    fn is_sent(&self) -> bool {
        let last = self.parities_of.checked_sub(1);
        last.is_some_and(|last| self.repaired || self.parities.contains_key(&last))
    }

    /// How long nothing may come before the rest of the sample is asked for too.
    fn tail_wait(&self) -> Duration {
        TAIL.max(self.round_trip / 2) + self.patience
    }

    /// The parts that lie between those that came, and the rest when `with_tail`. Where there are parities only those with which
    /// it can be restored.
    fn missing(&self, with_tail: bool) -> Vec<(u32, u32)> {
        let mut parts: Vec<(u32, u32)> = Vec::new();
        if let Some(wanted) = self.wanted() {
            for index in wanted {
                let start = index * self.step;
                let len = self.step.min(self.bytes.len() - start);
                let (Ok(offset), Ok(len)) = (u32::try_from(start), u32::try_from(len)) else {
                    break;
                };
                if let Some((from, until)) = parts.last_mut()
                    && *from + *until == offset
                {
                    *until += len;
                } else if parts.len() < PARTS_MAX {
                    parts.push((offset, len));
                }
            }
            return parts;
        }
        let mut from = 0;
        let end = with_tail.then_some((self.bytes.len(), self.bytes.len()));
        for (start, until) in self.ranges.iter().copied().chain(end) {
            let len = start - from;
            if len > 0
                && let (Ok(offset), Ok(len)) = (u32::try_from(from), u32::try_from(len))
            {
                parts.push((offset, len));
            }
            if parts.len() == PARTS_MAX {
                break;
            }
            from = until;
        }
        parts
    }

    /// Whether all bytes of a fragment came, in a sample of `total`.
    fn has(&self, index: usize, total: usize) -> bool {
        let start = index * self.step;
        let end = (start + self.step).min(total);
        let range = self.ranges.partition_point(|(_, e)| *e <= start);
        let range = self.ranges.get(range);
        range.is_some_and(|(s, e)| *s <= start && end <= *e)
    }

    /// How many more fragments or parities it takes; `None` if the sample can have no parities.
    fn lacking(&self) -> Option<usize> {
        let total = self.bytes.len();
        parity::lacking(
            total.div_ceil(self.step.max(1)),
            self.parities_of,
            |index| self.has(index, total),
            |index| self.parity(index).is_some(),
        )
    }

    /// The fragments with which it can be restored; `None` while it is not known to have parities.
    fn wanted(&self) -> Option<Vec<usize>> {
        let total = self.bytes.len();
        if self.parities.is_empty() {
            return None;
        }
        parity::wanted(
            total.div_ceil(self.step.max(1)),
            self.parities_of,
            |index| self.has(index, total),
            |index| self.parity(index).is_some(),
        )
    }

    fn parity(&self, index: usize) -> Option<&[u8]> {
        let index = u8::try_from(index).ok()?;
        self.parities.get(&index).map(Vec::as_slice)
    }

    /// Keeps a parity, if there is room for it.
    fn add_parity(&mut self, parity: u8, of: u8, payload: &[u8], room: usize) -> Added {
        let is_other = of != self.parities_of && !self.parities.is_empty();
        if is_other || (self.step != 0 && self.step != payload.len()) {
            // The sample was sent once more, in another way: these do not go together.
            return Added::Part;
        }
        (self.step, self.parities_of) = (payload.len(), of);
        if self.lacking().is_none() {
            return Added::Contradiction;
        }
        if room >= payload.len() && !self.parities.contains_key(&parity) {
            self.parities.insert(parity, payload.to_vec());
        }
        self.restore()
    }

    /// Restores the sample once enough is here.
    fn restore(&mut self) -> Added {
        let here: usize = self.ranges.iter().map(|(start, end)| end - start).sum();
        let may_do = here + self.parities.len() * self.step >= self.bytes.len();
        if self.parities.is_empty() || !may_do || self.lacking() != Some(0) {
            return Added::Part;
        }
        let mut bytes = std::mem::take(&mut self.bytes);
        let total = bytes.len();
        let is_restored = parity::restore(
            &mut bytes,
            self.step,
            |index| self.has(index, total),
            |index| self.parity(index),
            self.parities_of,
        );
        self.bytes = bytes;
        match is_restored {
            true => Added::Whole,
            false => Added::Contradiction,
        }
    }

    /// Copies a fragment to its place. Fragments repeat or abut; those that overlap in part, or disagree on the length
    /// of the sample, are contradictions.
    fn add(&mut self, fragment: Fragment, payload: &[u8], room: usize) -> Added {
        let (Ok(total), Ok(start)) = (
            usize::try_from(fragment.total),
            usize::try_from(fragment.offset),
        ) else {
            return Added::Contradiction;
        };
        if total != self.bytes.len() {
            return Added::Contradiction;
        }
        if let Some(parity) = fragment.parity(payload.len()) {
            return self.add_parity(parity, fragment.parities, payload, room);
        }
        if !self.parities.is_empty() && payload.len() > self.step {
            return Added::Contradiction;
        }
        let end = start + payload.len();
        if end < total {
            self.step = self.step.max(payload.len());
        }
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
        // Fragments have one length, so that honest ones leave no more gaps than that allows.
        if self.ranges.len() > RANGES.max(total / self.step.max(1)) {
            return Added::Contradiction;
        }
        if self.ranges.as_slice() == [(0, total)] {
            return Added::Whole;
        }
        self.restore()
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

/// What may come late because it took another way: not asked for yet.
const REORDERING: Duration = Duration::from_millis(5);
/// Fragments come at the sender's pace, and may pause while others have their turn.
const TAIL: Duration = Duration::from_millis(25);
/// `PROTOCOL.md#fragments`: an incomplete sample is given up 2 s after its last fragment, or 8 round trips.
const GIVE_UP: Duration = Duration::from_secs(2);
/// Parts asked for at one time: four messages.
const PARTS_MAX: usize = 4 * NACK_PARTS_MAX;
/// What an incomplete sample takes beside its bytes, with its places in the tables, so that many small ones count too.
pub(super) const PARTIAL_BYTES: usize = 512;
/// What one range of it takes.
pub(super) const RANGE_BYTES: usize = size_of::<(usize, usize)>();
/// Gaps that fragments of any length may leave.
const RANGES: usize = 64;

#[cfg(test)]
mod tests {
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
        insert_into(r, STREAM, seq, total, offset, payload)
    }

    fn insert_into(
        r: &mut Reassembly,
        stream: StreamId,
        seq: u64,
        total: u32,
        offset: u32,
        payload: &[u8],
    ) -> Step {
        let fragment = Fragment {
            total,
            offset,
            parities: 0,
        };
        let record = Record {
            stream,
            repeat: false,
            gone: false,
            meta: meta(seq),
            fragment: Some(fragment),
            payload,
        };
        let rules = Rules {
            depth: 1,
            in_order: false,
            round_trip: Duration::from_millis(10),
            patience: Duration::ZERO,
        };
        r.insert(TAG, &record, fragment, rules, Time(0))
    }

    #[test]
    fn any_order_and_repeats_make_the_sample() {
        let mut r = Reassembly::new(4_096);
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
        let mut r = Reassembly::new(4_096);
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
            let mut r = Reassembly::new(4_096);
            insert(&mut r, 1, 4, 0, b"ab");
            let step = insert(&mut r, 1, total, offset, payload);
            assert_eq!(step.failed, Some((meta(1), Failure::Undecodable)));
            assert_eq!(r.held_bytes, 0);
        }
    }

    #[test]
    fn budget_refuses_what_does_not_fit() {
        let mut r = Reassembly::new(PARTIAL_BYTES + RANGE_BYTES + 5);
        let step = insert(&mut r, 1, 6, 0, b"ab");
        assert_eq!(step.failed, Some((meta(1), Failure::OverBudget)));
        assert_eq!(insert(&mut r, 2, 5, 0, b"ab").failed, None);
        assert_eq!(r.held_bytes, r.budget_bytes);
    }

    #[test]
    fn what_samples_take_beside_their_bytes_is_within_the_budget_too() {
        let mut r = Reassembly::new(10 * PARTIAL_BYTES);
        let refused = (0..100).filter(|stream| {
            let step = insert_into(&mut r, StreamId(*stream), 1, 2, 0, b"a");
            step.failed == Some((meta(1), Failure::OverBudget))
        });
        assert_eq!(refused.count(), 91);
        assert!(r.held_bytes <= r.budget_bytes);

        // Of every second byte each leaves a range.
        let mut r = Reassembly::new(PARTIAL_BYTES + 100_000 + 1_000 * RANGE_BYTES);
        let steps = (0..2_000).map(|at| insert(&mut r, 1, 100_000, at * 2, b"a"));
        let failed = steps.filter_map(|step| step.failed).next();
        assert_eq!(failed, Some((meta(1), Failure::OverBudget)));
        assert_eq!((r.held_bytes, r.deadline()), (0, None));
    }

    #[test]
    fn what_is_missing_is_asked_for_and_given_up_in_the_end() {
        let mut r = Reassembly::new(4_096);
        insert(&mut r, 1, 10, 2, b"cd");
        insert(&mut r, 1, 10, 6, b"gh");
        let mut now = r.deadline().unwrap();
        assert_eq!(now, Time(0) + REORDERING);
        let (place, due) = r.due(now).unwrap();
        assert_eq!((place.seq, due), (Seq(1), Due::Ask(vec![(0, 2), (4, 2)])));
        // Later the end is asked for as well.
        let mut asked = 0;
        loop {
            now = r.deadline().unwrap();
            match r.due(now).unwrap().1 {
                Due::Ask(parts) if now.since(Time(0)) >= TAIL => {
                    assert_eq!(parts, [(0, 2), (4, 2), (8, 2)]);
                    asked += 1;
                }
                Due::Ask(_) => {}
                Due::Expired(meta) => break assert_eq!(meta.seq, Seq(1)),
            }
        }
        assert!(
            asked > 3 && now.since(Time(0)) >= GIVE_UP,
            "{asked} {now:?}"
        );
        assert_eq!((r.held_bytes, r.deadline()), (0, None));
    }

    #[test]
    fn many_gaps_of_a_long_sample_are_no_contradiction() {
        let mut r = Reassembly::new(1 << 20);
        for at in 0..500 {
            let step = insert(&mut r, 1, 1_000_000, at * 2_000, &[1; 1_000]);
            assert_eq!(step, Step::default(), "{at}");
        }
        let (_, due) = r.due(r.deadline().unwrap()).unwrap();
        assert_eq!(
            due,
            Due::Ask((0..400).map(|at| (at * 2_000 + 1_000, 1_000)).collect())
        );
    }
}
