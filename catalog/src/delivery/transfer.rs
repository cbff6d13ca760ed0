//! One large sample on its way along one path: which fragments have left, and which are asked for again.

use std::collections::VecDeque;
use std::time::Duration;

use ddx_wire::sample::{Fragment, SampleMeta};
use ddx_wire::{Epoch, Seq, Time};

use super::key;
use super::parity;

/// A sample in fragments, and the payload until nobody needs it any longer.
#[derive(Debug)]
pub(super) struct Transfer<P> {
    meta: SampleMeta,
    payload: P,
    /// Payload bytes of each fragment but the last.
    step: usize,
    /// First fragment that was never sent.
    next: usize,
    /// Fragments to send again, in the order of the requests.
    again: VecDeque<usize>,
    /// When each fragment last left: milliseconds since `begun`, from 1; 0 is never.
    left: Vec<u32>,
    begun: Time,
    again_all: bool,
    parities: Parities,
}

/// What may still be on its way: it left less than a time ago, and none that left later was seen.
#[derive(Clone, Copy, Debug)]
pub(super) struct Flight {
    pub(super) time: Duration,
    /// What left before this has come, or never will.
    pub(super) seen: Option<Time>,
}

/// Fragments that stand in for others.
#[derive(Debug, Default)]
struct Parities {
    count: u8,
    /// How many were sent.
    sent: u8,
    /// Made when the first is due: back to back.
    bytes: Vec<u8>,
    /// When the last left.
    left: Time,
}

impl<P: AsRef<[u8]>> Transfer<P> {
    /// Begins with the first fragment.
    pub(super) fn new(meta: SampleMeta, payload: P, step: usize, now: Time) -> Self {
        let step = step.max(1);
        let count = payload.as_ref().len().div_ceil(step);
        Self {
            meta,
            payload,
            step,
            next: 0,
            again: VecDeque::new(),
            left: vec![0; count],
            begun: now,
            again_all: false,
            parities: Parities::default(),
        }
    }

    /// Sends so many parities after the fragments: how many there are may be read from [`Transfer::fragments`].
    pub(super) fn protect(mut self, parities: u8) -> Self {
        self.parities.count = parities;
        self
    }

    /// Marks all as sent before, and sends only `parts`, offset and length, unless there are none.
    pub(super) fn again(mut self, parts: &[(u32, u32)], now: Time) -> Self {
        self.again_all = true;
        if !parts.is_empty() {
            self.next = self.left.len();
            for (offset, len) in parts {
                self.ask(*offset, *len, Flight::NONE, now);
            }
        }
        self
    }

    /// Whether the sample was sent before.
    pub(super) fn is_again(&self) -> bool {
        self.again_all
    }

    pub(super) fn key(&self) -> (Epoch, Seq) {
        key(&self.meta)
    }

    pub(super) fn meta(&self) -> &SampleMeta {
        &self.meta
    }

    /// Whether fragments wait that were never sent.
    pub(super) fn is_under_way(&self) -> bool {
        self.next < self.left.len() || self.parities.sent < self.parities.count
    }

    /// Whether fragments wait that were asked for.
    pub(super) fn repairs(&self) -> bool {
        !self.again.is_empty()
    }

    /// The next fragment that was never sent, and its bytes.
    pub(super) fn next_fragment(&mut self, now: Time) -> Option<(Fragment, &[u8])> {
        let index = self.next;
        if index >= self.left.len() {
            return self.next_parity(now);
        }
        self.next += 1;
        self.fragment(index, now)
    }

    /// The next fragment that was asked for, and its bytes.
    pub(super) fn next_repair(&mut self, now: Time) -> Option<(Fragment, &[u8])> {
        let index = self.again.pop_front()?;
        self.fragment(index, now)
    }

    /// Queues what is missing of a part, except what is on its way: never sent yet, or in flight.
    pub(super) fn ask(&mut self, offset: u32, len: u32, flight: Flight, now: Time) {
        let (Ok(offset), Ok(len)) = (usize::try_from(offset), usize::try_from(len)) else {
            return;
        };
        let first = offset / self.step;
        let end = offset
            .saturating_add(len)
            .div_ceil(self.step)
            .min(self.next);
        if self.parities.count > 0 && (self.is_under_way() || flight.holds(self.parities.left, now))
        {
            // Perhaps they make up for it.
            return;
        }
        let time = u32::try_from(flight.time.as_millis()).unwrap_or(u32::MAX);
        let landed = self.elapsed(now).saturating_sub(time);
        let seen = flight.seen.map_or(0, |seen| self.elapsed(seen));
        for index in first..end {
            let Some(left) = self.left.get_mut(index) else {
                return;
            };
            if *left == u32::MAX || (*left > landed && *left >= seen) {
                continue;
            }
            // Marked as on its way, so that it is not queued twice.
            *left = u32::MAX;
            self.again.push_back(index);
        }
    }

    /// Queues the last fragment: from it a receiver learns of all that it lacks.
    pub(super) fn ask_last(&mut self) {
        if self.again.is_empty() && !self.left.is_empty() {
            self.again.push_back(self.left.len() - 1);
        }
    }

    fn next_parity(&mut self, now: Time) -> Option<(Fragment, &[u8])> {
        let payload = self.payload.as_ref();
        let parities = &mut self.parities;
        if parities.sent >= parities.count {
            return None;
        }
        if parities.bytes.is_empty() {
            match parity::encode(payload, self.step, parities.count) {
                Some(bytes) => parities.bytes = bytes,
                None => parities.count = 0,
            }
        }
        let at = usize::from(parities.sent) * self.step;
        let bytes = parities.bytes.get(at..at + self.step)?;
        parities.sent += 1;
        parities.left = now;
        let offset = self.left.len() * self.step + at;
        let fragment = Fragment {
            total: u32::try_from(payload.len()).ok()?,
            offset: u32::try_from(offset).ok()?,
            parities: parities.count,
        };
        Some((fragment, bytes))
    }

    fn fragment(&mut self, index: usize, now: Time) -> Option<(Fragment, &[u8])> {
        let elapsed = self.elapsed(now);
        *self.left.get_mut(index)? = elapsed;
        let bytes = self.payload.as_ref();
        let start = index * self.step;
        let end = (start + self.step).min(bytes.len());
        let fragment = Fragment {
            total: u32::try_from(bytes.len()).ok()?,
            offset: u32::try_from(start).ok()?,
            parities: self.parities.count,
        };
        Some((fragment, bytes.get(start..end)?))
    }

    fn elapsed(&self, now: Time) -> u32 {
        let elapsed = u32::try_from(now.since(self.begun).as_millis()).unwrap_or(u32::MAX);
        elapsed.saturating_add(1).min(u32::MAX - 1)
    }
}

impl Flight {
    /// Nothing is.
    const NONE: Self = Self {
        time: Duration::ZERO,
        seen: None,
    };

    fn holds(self, left: Time, now: Time) -> bool {
        now.since(left) < self.time && self.seen.is_none_or(|seen| left >= seen)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const RTT: Duration = Duration::from_millis(10);
    const FLIGHT: Flight = Flight {
        time: RTT,
        seen: None,
    };

    fn offsets(transfer: &mut Transfer<Vec<u8>>, now: Time) -> Vec<u32> {
        std::iter::from_fn(|| transfer.next_repair(now).map(|(f, _)| f.offset)).collect()
    }

    #[test]
    fn all_go_once_and_what_is_asked_for_again() {
        let payload: Vec<u8> = (0..10).collect();
        let mut transfer = Transfer::new(SampleMeta::default(), payload, 4, Time(0));
        let (first, bytes) = transfer.next_fragment(Time(0)).unwrap();
        assert_eq!(
            (first.offset, first.total, bytes),
            (0, 10, &[0, 1, 2, 3][..])
        );
        // What was never sent needs no repair.
        transfer.ask(0, 10, FLIGHT, Time(0) + RTT);
        assert_eq!(offsets(&mut transfer, Time(0) + RTT), [0]);
        transfer.next_fragment(Time(0) + RTT);
        let (last, bytes) = transfer.next_fragment(Time(0) + RTT).unwrap();
        assert_eq!((last.offset, bytes), (8, &[8, 9][..]));
        assert!(!transfer.is_under_way());
        // All of them left less than a round trip ago.
        transfer.ask(0, 10, FLIGHT, Time(0) + RTT + RTT / 2);
        assert!(!transfer.repairs());
        let later = Time(0) + 3 * RTT;
        transfer.ask(5, 1, FLIGHT, later);
        transfer.ask(4, 6, FLIGHT, later);
        assert_eq!(offsets(&mut transfer, later), [4, 8]);
        transfer.ask(0, u32::MAX, FLIGHT, later);
        transfer.ask(u32::MAX, u32::MAX, FLIGHT, later);
        assert_eq!(offsets(&mut transfer, later), [0]);
    }

    #[test]
    fn what_a_later_one_overtook_is_not_waited_for() {
        let mut transfer = Transfer::new(SampleMeta::default(), vec![0; 8], 4, Time(0));
        transfer.next_fragment(Time(0));
        transfer.next_fragment(Time(0) + RTT);
        let now = Time(0) + RTT * 3 / 2;
        let flight = Flight {
            time: 9 * RTT,
            seen: Some(Time(0) + RTT / 2),
        };
        transfer.ask(0, 8, flight, now);
        assert_eq!(offsets(&mut transfer, now), [0]);
    }
}
