//! Spreads a sender's bytes over time.

use std::time::Duration;

use ddx_wire::Time;

/// Admits batches so that their bytes keep to a rate.
#[derive(Debug)]
pub(super) struct Pace {
    bytes_per_second: Option<u64>,
    /// When the last batch has left, at the paced rate.
    free_at: Time,
}

impl Pace {
    pub(super) fn new(bytes_per_second: Option<u64>, now: Time) -> Self {
        Self {
            bytes_per_second: bytes_per_second.map(|rate| rate.max(1)),
            free_at: now,
        }
    }

    /// Tells when the next batch may go, if that is later than `now`.
    pub(super) fn blocked_until(&self, now: Time) -> Option<Time> {
        (self.bytes_per_second.is_some() && self.free_at > now).then_some(self.free_at)
    }

    /// Greatest next batch, bytes: what the rate sends in [`BURST`]. One datagram may always go.
    pub(super) fn batch_bytes(&self) -> usize {
        self.bytes_per_second.map_or(usize::MAX, |rate| {
            let bytes = u128::from(rate) * BURST.as_nanos() / NANOS;
            usize::try_from(bytes).unwrap_or(usize::MAX)
        })
    }

    /// Notes that a batch goes now.
    pub(super) fn spend(&mut self, bytes: usize, now: Time) {
        if let Some(rate) = self.bytes_per_second {
            let span = (bytes as u128) * NANOS / u128::from(rate);
            let span = Duration::from_nanos(u64::try_from(span).unwrap_or(u64::MAX));
            // A thread that woke late may catch up on one burst, not on its whole idle time.
            self.free_at = self.free_at.max(now - BURST) + span;
        }
    }
}

/// `PROTOCOL.md#limits`: a batch is at most what the paced rate sends in 200 us.
const BURST: Duration = Duration::from_micros(200);
const NANOS: u128 = 1_000_000_000;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keeps_to_the_rate_after_one_burst() {
        let mut pace = Pace::new(Some(10_000_000), Time(0));
        assert_eq!(pace.batch_bytes(), 2_000);
        let mut now = Time(1_000_000);
        let mut sent = 0;
        while now < Time(101_000_000) {
            if pace.blocked_until(now).is_none() {
                pace.spend(2_000, now);
                sent += 2_000;
            }
            now = now + Duration::from_micros(10);
        }
        assert!((1_000_000..=1_004_000).contains(&sent), "{sent}");
    }

    #[test]
    fn no_rate_never_blocks() {
        let mut pace = Pace::new(None, Time(0));
        pace.spend(usize::MAX, Time(0));
        assert_eq!(pace.blocked_until(Time(0)), None);
    }
}
