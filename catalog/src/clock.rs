//! How another host's clock relates to this one's, with an error bound that holds.
//!
//! Each exchange of four timestamps confines the offset to an interval: the answer was stamped somewhere between our
//! question and its arrival. Intervals widen with age, because clocks drift; the estimate is the intersection of recent ones.

use std::collections::VecDeque;

use ddx_wire::{ClockOffset, Time};

const DRIFT_DIVISOR: u64 = ClockOffset::DRIFT_DIVISOR;
/// How long an estimate is used before the next replaces it, nanoseconds; drift over that time is part of the bound.
const VALID_NS: u64 = 1_250_000_000;
const KEPT: usize = 16;

/// What is known about one other host's clock.
#[derive(Debug, Default)]
pub(crate) struct Clock {
    exchanges: VecDeque<Exchange>,
}

#[derive(Clone, Copy, Debug)]
struct Exchange {
    at: Time,
    low_ns: i128,
    high_ns: i128,
    rtt_ns: u64,
}

impl Clock {
    /// Takes in one exchange: asked at `sent`, stamped `remote` by the other clock, answered at `now`.
    pub(crate) fn measure(&mut self, sent: Time, remote: Time, now: Time) {
        if now < sent {
            return;
        }
        let newest = Exchange {
            at: now,
            low_ns: i128::from(remote.0) - i128::from(now.0),
            high_ns: i128::from(remote.0) - i128::from(sent.0),
            rtt_ns: now.0.saturating_sub(sent.0),
        };
        if self.exchanges.len() == KEPT {
            // The widest goes first, so that a good exchange outlives a burst of slow ones until drift has widened it.
            let widest = self
                .exchanges
                .iter()
                .enumerate()
                .max_by_key(|(_, e)| e.width_at(now))
                .map(|(index, _)| index);
            if let Some(widest) = widest {
                self.exchanges.remove(widest);
            }
        }
        self.exchanges.push_back(newest);
        if self.interval(now).is_none() {
            // Drift beyond the allowance, as after a virtual machine's suspend: what was measured before is void.
            self.exchanges.clear();
            self.exchanges.push_back(newest);
        }
    }

    /// Offset and bound that hold from `now` for a second and a quarter; `None` before the first exchange.
    pub(crate) fn estimate(&self, now: Time) -> Option<ClockOffset> {
        let (low, high) = self.interval(now)?;
        let offset = low.midpoint(high);
        let bound = (high - low) / 2 + 1;
        Some(ClockOffset {
            offset_ns: i64::try_from(offset).ok()?,
            bound_ns: u64::try_from(bound)
                .unwrap_or(u64::MAX)
                .saturating_add(VALID_NS / DRIFT_DIVISOR),
        })
    }

    /// Shortest recent round trip, nanoseconds.
    pub(crate) fn rtt_ns(&self) -> Option<u64> {
        self.exchanges.iter().map(|e| e.rtt_ns).min()
    }

    fn interval(&self, now: Time) -> Option<(i128, i128)> {
        let low = self
            .exchanges
            .iter()
            .map(|e| e.low_ns - e.drift(now))
            .max()?;
        let high = self
            .exchanges
            .iter()
            .map(|e| e.high_ns + e.drift(now))
            .min()?;
        (low <= high).then_some((low, high))
    }
}

impl Exchange {
    fn drift(self, now: Time) -> i128 {
        // The round trip is part of it: its first stamp is that much older.
        let age = now.0.saturating_sub(self.at.0).saturating_add(self.rtt_ns);
        i128::from(age.div_ceil(DRIFT_DIVISOR))
    }

    fn width_at(self, now: Time) -> i128 {
        self.high_ns - self.low_ns + 2 * self.drift(now)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bound_covers_an_asymmetric_path_and_shrinks_with_a_better_exchange() {
        // The other clock is 1,000,000 ahead; all of the delay lies on the way there.
        let mut clock = Clock::default();
        clock.measure(Time(5_000_000), Time(6_900_000), Time(5_900_000));
        let first = clock.estimate(Time(5_900_000)).unwrap();
        assert!(
            first.offset_ns.abs_diff(1_000_000) <= first.bound_ns,
            "{first:?}"
        );
        clock.measure(Time(7_000_000), Time(8_050_000), Time(7_100_000));
        let second = clock.estimate(Time(7_100_000)).unwrap();
        assert!(
            second.offset_ns.abs_diff(1_000_000) <= second.bound_ns,
            "{second:?}"
        );
        assert!(second.bound_ns < first.bound_ns);
        assert_eq!(clock.rtt_ns(), Some(100_000));
    }

    #[test]
    fn bound_grows_with_age_and_nothing_is_known_at_first() {
        let mut clock = Clock::default();
        assert_eq!(clock.estimate(Time(0)), None);
        clock.measure(Time(0), Time(50), Time(100));
        let fresh = clock.estimate(Time(100)).unwrap().bound_ns;
        let stale = clock.estimate(Time(10_000_000_100)).unwrap().bound_ns;
        assert_eq!(stale - fresh, 10_000_000_000 / DRIFT_DIVISOR);
    }

    #[test]
    fn a_jump_of_the_other_clock_voids_what_was_measured_before() {
        let mut clock = Clock::default();
        clock.measure(Time(0), Time(50), Time(100));
        clock.measure(Time(1_000), Time(900_001_050), Time(1_100));
        let offset = clock.estimate(Time(1_100)).unwrap().offset_ns;
        assert_eq!(offset, 900_000_000);
    }
}
