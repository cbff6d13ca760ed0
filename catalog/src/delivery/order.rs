//! Puts the samples of one stream in order where each is wanted: holds back those that came too early, and says which to
//! ask for.

use std::collections::BTreeMap;
use std::time::Duration;

use ddx_wire::sample::SampleMeta;
use ddx_wire::{Epoch, Seq, Time};

use super::key;

/// The order of one stream of one epoch.
#[derive(Debug)]
pub(super) struct Order {
    from_ring: bool,
    epoch: Epoch,
    /// The next sample to deliver; none before the first came.
    next: Option<Seq>,
    held: BTreeMap<Seq, Held>,
    held_bytes: usize,
    /// When something last came, and how long what is missing then may still take.
    last: (Time, Duration),
    /// When to ask for what is missing.
    ask_at: Option<Time>,
    /// Since when the present gap is there, and how often it was asked for.
    gap_since: Time,
    asked: u32,
}

#[derive(Debug)]
enum Held {
    Sample(SampleMeta, Vec<u8>),
    /// This one and those up to it, from the key on, cannot be had any more.
    Gone(Seq, Why),
}

/// What comes next.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Next {
    /// This sample.
    Sample(SampleMeta, Vec<u8>),
    /// So many samples cannot be had any more.
    Gone(u64, Why),
}

/// Why samples cannot be had.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Why {
    /// Newer ones took their place in the writer's ring.
    Overwritten,
    /// The contract keeps them back: they are too old.
    LeftOut,
}

/// What to ask for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Ask {
    pub(super) epoch: Epoch,
    pub(super) first: Seq,
    pub(super) count: u32,
}

impl Order {
    /// `from_ring` asks for what lies before the first sample that comes.
    pub(super) fn new(from_ring: bool) -> Self {
        Self {
            from_ring,
            epoch: Epoch(0),
            next: None,
            held: BTreeMap::new(),
            held_bytes: 0,
            last: (Time(0), Duration::ZERO),
            ask_at: None,
            gap_since: Time(0),
            asked: 0,
        }
    }

    /// Goes on after a sample that was delivered by another stream of the item.
    pub(super) fn resume(&mut self, epoch: Epoch, after: Seq) {
        (self.epoch, self.next) = (epoch, Some(Seq(after.0.saturating_add(1))));
    }

    /// Newest sample that is here, delivered or held back.
    pub(super) fn newest(&self) -> Option<(Epoch, Seq)> {
        let held = self.held.last_key_value().map(|(seq, held)| match held {
            Held::Sample(..) => *seq,
            Held::Gone(last, _) => *last,
        });
        let delivered = self.next.map(|next| Seq(next.0.saturating_sub(1)));
        let newest = held.into_iter().chain(delivered).max()?;
        Some((self.epoch, newest))
    }

    /// Whether a sample is neither delivered nor here.
    pub(super) fn lacks(&self, meta: &SampleMeta) -> bool {
        match self.next {
            None => true,
            Some(_) if meta.epoch > self.epoch => true,
            Some(next) => {
                meta.epoch == self.epoch && meta.seq >= next && self.known_until(meta.seq).is_none()
            }
        }
    }

    /// Bytes held back, with what each entry takes beside its payload: nothing is held where there are none.
    pub(super) fn held_bytes(&self) -> usize {
        self.held_bytes
    }

    /// Takes a sample that is lacking.
    pub(super) fn insert(&mut self, meta: SampleMeta, payload: Vec<u8>, wait: Duration, now: Time) {
        self.begin(meta.epoch, meta.seq);
        self.held_bytes += cost(payload.len());
        self.held.insert(meta.seq, Held::Sample(meta, payload));
        self.last = (now, wait);
    }

    /// Notes that the samples from `first` to `last` cannot be had any more.
    pub(super) fn gone(
        &mut self,
        epoch: Epoch,
        (first, last): (Seq, Seq),
        why: Why,
        wait: Duration,
        now: Time,
    ) {
        let Some(next) = self.next.filter(|_| epoch == self.epoch) else {
            return;
        };
        let mut first = first.max(next);
        // Of what is known already nothing new is told, by a record that took its time.
        while let Some(known) = self.known_until(first) {
            first = Seq(known.0.saturating_add(1));
        }
        // What is here already is not gone.
        let until = self.held.range(first..).next().map(|(seq, _)| *seq);
        let last = until.map_or(last, |seq| last.min(Seq(seq.0 - 1)));
        if first <= last {
            self.held_bytes += cost(0);
            self.held.insert(first, Held::Gone(last, why));
        }
        self.last = (now, wait);
    }

    /// The next in order, if it is here.
    pub(super) fn poll(&mut self) -> Option<Next> {
        let next = self.next?;
        let (at, held) = self.held.pop_first()?;
        if at != next {
            self.held.insert(at, held);
            if self.ask_at.is_none() {
                let (last, wait) = self.last;
                (self.gap_since, self.ask_at) = (last, Some(last + wait));
            }
            return None;
        }
        // What is missing after it, if anything, is another gap.
        (self.ask_at, self.asked) = (None, 0);
        match held {
            Held::Sample(meta, payload) => {
                self.held_bytes -= cost(payload.len());
                self.next = Some(Seq(at.0.saturating_add(1)));
                Some(Next::Sample(meta, payload))
            }
            Held::Gone(last, why) => {
                self.held_bytes -= cost(0);
                self.next = Some(Seq(last.0.saturating_add(1)));
                Some(Next::Gone(last.0 - at.0 + 1, why))
            }
        }
    }

    /// Gives up what is missing before the samples that are held back: it takes too long, or too much is held.
    pub(super) fn skip_gap(&mut self) {
        if let (Some(_), Some((first, _))) = (self.next, self.held.first_key_value()) {
            self.next = Some(*first);
        }
        self.ask_at = None;
    }

    pub(super) fn deadline(&self) -> Option<Time> {
        self.ask_at
    }

    /// The first sample that is missing, if later ones are here.
    pub(super) fn missing(&self) -> Option<(Epoch, Seq)> {
        let next = self.next.filter(|_| !self.held.is_empty())?;
        Some((self.epoch, next))
    }

    /// What to ask for at its deadline; the flag tells that it was asked for long enough. What `comes` already is waited
    /// for.
    pub(super) fn due(
        &mut self,
        comes: bool,
        round_trip: Duration,
        wait: Duration,
        now: Time,
    ) -> (Vec<Ask>, bool) {
        self.ask_at = None;
        let gaps = self.gaps();
        if gaps.is_empty() {
            return (gaps, false);
        }
        if !comes && now.since(self.gap_since) >= GIVE_UP.max(16 * round_trip) {
            return (Vec::new(), true);
        }
        let backoff = 1 << self.asked.min(3);
        self.asked += 1;
        self.ask_at = Some(now + (round_trip + AGAIN) * backoff + wait);
        (gaps, false)
    }

    /// The last of the samples that are held, or known to be gone, together with this one; none if it is neither.
    fn known_until(&self, seq: Seq) -> Option<Seq> {
        let (at, held) = self.held.range(..=seq).next_back()?;
        let last = match held {
            Held::Sample(..) => *at,
            Held::Gone(last, _) => *last,
        };
        (last >= seq).then_some(last)
    }

    fn gaps(&self) -> Vec<Ask> {
        let Some(mut next) = self.next else {
            return Vec::new();
        };
        let mut gaps = Vec::new();
        for (seq, held) in &self.held {
            if *seq > next {
                let count = u32::try_from(seq.0 - next.0).unwrap_or(u32::MAX);
                gaps.push(Ask {
                    epoch: self.epoch,
                    first: next,
                    count,
                });
                if gaps.len() == GAPS {
                    break;
                }
            }
            let last = match held {
                Held::Sample(..) => *seq,
                Held::Gone(last, _) => *last,
            };
            next = Seq(last.0.saturating_add(1));
        }
        gaps
    }

    /// Begins with the first sample, and anew with each epoch: what is missing of the former one is over.
    fn begin(&mut self, epoch: Epoch, first: Seq) {
        if self.next.is_some() && epoch == self.epoch {
            return;
        }
        let is_first = self.next.is_none();
        self.epoch = epoch;
        self.held.clear();
        self.held_bytes = 0;
        self.next = Some(if is_first && !self.from_ring {
            first
        } else {
            Seq(1)
        });
        (self.ask_at, self.asked) = (None, 0);
    }
}

/// What holding back a payload of `len` bytes takes, or with 0 the news that samples are gone.
pub(super) fn cost(len: usize) -> usize {
    len + ENTRY_BYTES
}

/// Whether `meta` begins a later epoch than `order` is in.
pub(super) fn is_later_epoch(order: &Order, meta: &SampleMeta) -> bool {
    order.next.is_some() && key(meta).0 > order.epoch
}

/// What is asked for comes at the sender's pace.
const AGAIN: Duration = Duration::from_millis(10);
/// `PROTOCOL.md#every-sample`: a sample is asked for during 5 s, or 16 round trips.
const GIVE_UP: Duration = Duration::from_secs(5);
/// What an entry takes beside its payload, so that many empty ones count too.
const ENTRY_BYTES: usize = 128;
/// Gaps asked for at one time.
const GAPS: usize = 32;

#[cfg(test)]
mod tests {
    use super::*;

    const WAIT: Duration = Duration::from_millis(5);
    const RTT: Duration = Duration::from_millis(20);

    fn meta(epoch: u64, seq: u64) -> SampleMeta {
        SampleMeta {
            epoch: Epoch(epoch),
            seq: Seq(seq),
            ..SampleMeta::default()
        }
    }

    fn insert(order: &mut Order, epoch: u64, seq: u64) {
        let meta = meta(epoch, seq);
        if order.lacks(&meta) {
            order.insert(meta, vec![0; 8], WAIT, Time(0));
        }
    }

    fn drain(order: &mut Order) -> Vec<u64> {
        let next = std::iter::from_fn(|| order.poll());
        next.map(|next| match next {
            Next::Sample(meta, _) => meta.seq.0,
            Next::Gone(count, _) => 1_000 + count,
        })
        .collect()
    }

    #[test]
    fn what_came_early_waits_for_what_is_missing() {
        let mut order = Order::new(false);
        for seq in [5, 7, 9, 7] {
            insert(&mut order, 1, seq);
        }
        assert_eq!(drain(&mut order), [5]);
        assert_eq!(order.newest(), Some((Epoch(1), Seq(9))));
        let (asks, over) = order.due(false, RTT, WAIT, order.deadline().unwrap());
        let firsts: Vec<_> = asks.iter().map(|ask| (ask.first.0, ask.count)).collect();
        assert_eq!((firsts, over), (vec![(6, 1), (8, 1)], false));
        insert(&mut order, 1, 8);
        assert_eq!(drain(&mut order), []);
        insert(&mut order, 1, 6);
        assert_eq!(drain(&mut order), [6, 7, 8, 9]);
        assert_eq!((order.held_bytes(), order.gaps().len()), (0, 0));
    }

    #[test]
    fn what_is_gone_is_passed_over() {
        let mut order = Order::new(true);
        insert(&mut order, 1, 4);
        assert_eq!(drain(&mut order), []);
        let (asks, _) = order.due(false, RTT, WAIT, order.deadline().unwrap());
        assert_eq!((asks[0].first.0, asks[0].count), (1, 3));
        order.gone(Epoch(1), (Seq(1), Seq(2)), Why::Overwritten, WAIT, Time(0));
        insert(&mut order, 1, 3);
        assert_eq!(drain(&mut order), [1_002, 3, 4]);
        // A claim about what is here, or was delivered, changes nothing.
        insert(&mut order, 1, 6);
        order.gone(Epoch(1), (Seq(1), Seq(9)), Why::LeftOut, WAIT, Time(0));
        assert_eq!(drain(&mut order), [1_001, 6]);
    }

    #[test]
    fn what_is_told_twice_or_comes_after_it_was_told_is_passed_over_once() {
        let mut order = Order::new(false);
        insert(&mut order, 1, 1);
        assert_eq!(drain(&mut order), [1]);
        let gone = |order: &mut Order, first, last| {
            let span = (Seq(first), Seq(last));
            order.gone(Epoch(1), span, Why::Overwritten, WAIT, Time(0));
        };
        // Held back by the second; told in pieces that overlap, and one of them arrives after all.
        gone(&mut order, 3, 5);
        gone(&mut order, 4, 7);
        gone(&mut order, 3, 9);
        assert!(!order.lacks(&meta(1, 6)));
        insert(&mut order, 1, 6);
        insert(&mut order, 1, 10);
        assert_eq!(drain(&mut order), []);
        let (asks, _) = order.due(false, RTT, WAIT, order.deadline().unwrap());
        let asked: Vec<_> = asks.iter().map(|ask| (ask.first.0, ask.count)).collect();
        assert_eq!(asked, [(2, 1)]);
        insert(&mut order, 1, 2);
        assert_eq!(drain(&mut order), [2, 1_003, 1_002, 1_002, 10]);
        assert_eq!((order.held_bytes(), order.gaps().len()), (0, 0));
    }

    #[test]
    fn a_gap_is_given_up_in_the_end() {
        let mut order = Order::new(false);
        insert(&mut order, 1, 1);
        insert(&mut order, 1, 3);
        assert_eq!(drain(&mut order), [1]);
        let mut asked = 0;
        while let Some(at) = order.deadline() {
            let (asks, over) = order.due(false, RTT, WAIT, at);
            asked += asks.len();
            if over {
                assert!(at.since(Time(0)) >= GIVE_UP);
                order.skip_gap();
            }
        }
        assert!(asked > 10, "{asked}");
        assert_eq!(drain(&mut order), [3]);
    }

    #[test]
    fn an_epoch_begins_at_one() {
        let mut order = Order::new(false);
        insert(&mut order, 1, 7);
        drain(&mut order);
        assert!(is_later_epoch(&order, &meta(2, 3)));
        insert(&mut order, 2, 3);
        assert_eq!(order.gaps()[0].first, Seq(1));
        assert!(!order.lacks(&meta(1, 8)));
        insert(&mut order, 2, 1);
        insert(&mut order, 2, 2);
        assert_eq!(drain(&mut order), [1, 2, 3]);
    }
}
