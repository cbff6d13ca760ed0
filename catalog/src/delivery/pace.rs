//! Spreads the bytes of one path over time.

use std::time::Duration;

use ddx_wire::Time;

/// Admits batches so that their bytes keep to a rate.
#[derive(Debug)]
pub(super) struct Pace {
    /// When the last batch has left, at the paced rate.
    free_at: Time,
    used: Used,
    asked: Time,
    /// When the rate last held something back.
    limited_at: Option<Time>,
}

/// How a path was used for a while.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Used {
    /// Whether the rate held anything back.
    pub(super) limited: bool,
    /// How long nothing left.
    pub(super) idle: Duration,
}

impl Pace {
    pub(super) fn new(now: Time) -> Self {
        Self {
            free_at: now,
            used: Used::default(),
            asked: now,
            limited_at: None,
        }
    }

    /// Tells when the next batch may go, if that is later than `now`. Call it only with something to send.
    pub(super) fn blocked_until(&mut self, now: Time) -> Option<Time> {
        let blocked = self.free_at > now;
        if blocked {
            self.used.limited = true;
            self.limited_at = Some(now);
        }
        blocked.then_some(self.free_at)
    }

    /// Whether the rate held something back of late.
    pub(super) fn is_limited(&self, now: Time) -> bool {
        self.limited_at
            .is_some_and(|at| now.since(at) < LIMITED_LASTS)
    }

    /// Notes that a batch goes now, at `rate` bytes per second.
    pub(super) fn spend(&mut self, bytes: usize, rate: u64, now: Time) {
        let span = span_of(bytes, rate);
        self.used.idle += self.idle(now);
        // A thread that woke late may catch up on one burst, not on its whole idle time.
        self.free_at = self.free_at.max(now - BURST) + span;
    }

    /// How it was used since this was last called.
    pub(super) fn take_used(&mut self, now: Time) -> Used {
        self.used.idle += self.idle(now);
        self.asked = now;
        std::mem::take(&mut self.used)
    }

    /// Time since it was last asked that was left unused, and that cannot be caught up on.
    fn idle(&self, now: Time) -> Duration {
        now.since((self.free_at + BURST).max(self.asked))
    }
}

/// How long bytes take at a rate, in bytes per second.
pub(super) fn span_of(bytes: usize, rate: u64) -> Duration {
    let span = (bytes as u128) * NANOS / u128::from(rate.max(1));
    Duration::from_nanos(u64::try_from(span).unwrap_or(u64::MAX))
}

/// Greatest batch at a rate, bytes: what it sends in 200 us. One datagram may always go.
pub(super) fn batch_bytes(rate: u64) -> usize {
    let bytes = u128::from(rate) * BURST.as_nanos() / NANOS;
    usize::try_from(bytes).unwrap_or(usize::MAX)
}

/// `PROTOCOL.md#limits`: a batch is at most what the paced rate sends in 200 us.
const BURST: Duration = Duration::from_micros(200);
/// How long it counts that something was held back.
const LIMITED_LASTS: Duration = Duration::from_millis(200);
const NANOS: u128 = 1_000_000_000;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keeps_to_the_rate_after_one_burst() {
        let rate = 10_000_000;
        let mut pace = Pace::new(Time(0));
        assert_eq!(batch_bytes(rate), 2_000);
        let mut now = Time(1_000_000);
        let mut sent = 0;
        while now < Time(101_000_000) {
            if pace.blocked_until(now).is_none() {
                pace.spend(2_000, rate, now);
                sent += 2_000;
            }
            now = now + Duration::from_micros(10);
        }
        assert!((1_000_000..=1_004_000).contains(&sent), "{sent}");
        let used = pace.take_used(now);
        assert!(
            used.limited && used.idle < Duration::from_micros(1_100),
            "{used:?}"
        );
        let later = now + Duration::from_secs(1);
        let idle = Used {
            limited: false,
            idle: later.since(pace.free_at + BURST),
        };
        assert_eq!(pace.take_used(later), idle);
    }
}
