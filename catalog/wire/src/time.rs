//! Instants and clock relations. Ages ride on CLOCK_BOOTTIME, which counts through suspend and never steps.

use std::ops::{Add, Sub};
use std::time::Duration;

use serde::{Deserialize, Serialize};

/// Nanoseconds on one host's CLOCK_BOOTTIME. Comparable only with instants of the same host.
#[derive(
    Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize,
)]
pub struct Time(pub u64);

/// What a peer's clock shows minus what ours shows, and how far off that figure may be.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ClockOffset {
    /// Peer minus local, nanoseconds.
    pub offset_ns: i64,
    /// Greatest error of `offset_ns`, nanoseconds.
    pub bound_ns: u64,
}

impl Time {
    /// Time since `earlier`, or zero when that lies ahead.
    pub fn since(self, earlier: Self) -> Duration {
        Duration::from_nanos(self.0.saturating_sub(earlier.0))
    }
}

impl Add<Duration> for Time {
    type Output = Self;

    fn add(self, span: Duration) -> Self {
        Self(
            self.0
                .saturating_add(u64::try_from(span.as_nanos()).unwrap_or(u64::MAX)),
        )
    }
}

impl Sub<Duration> for Time {
    type Output = Self;

    fn sub(self, span: Duration) -> Self {
        Self(
            self.0
                .saturating_sub(u64::try_from(span.as_nanos()).unwrap_or(u64::MAX)),
        )
    }
}

impl ClockOffset {
    /// Greatest drift of two clocks against one another, as a divisor: 200 parts per million, twice what crystals are
    /// sold with.
    pub const DRIFT_DIVISOR: u64 = 5_000;

    /// The same figure so much later: clocks drift, so its error may have grown.
    #[must_use]
    pub fn aged(self, age: Duration) -> Self {
        let age = u64::try_from(age.as_nanos()).unwrap_or(u64::MAX);
        Self {
            bound_ns: self
                .bound_ns
                .saturating_add(age.div_ceil(Self::DRIFT_DIVISOR)),
            ..self
        }
    }

    /// The instant on our clock that the peer calls `peer`, within [`ClockOffset::bound_ns`].
    pub fn to_local(self, peer: Time) -> Time {
        Time(
            peer.0
                .saturating_add_signed(self.offset_ns.saturating_neg()),
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn offset_maps_peer_to_local() {
        let ahead = ClockOffset {
            offset_ns: 5,
            bound_ns: 1,
        };
        assert_eq!(ahead.to_local(Time(105)), Time(100));
        let behind = ClockOffset {
            offset_ns: -5,
            bound_ns: 1,
        };
        assert_eq!(behind.to_local(Time(95)), Time(100));
    }

    #[test]
    fn bound_grows_with_age() {
        let fresh = ClockOffset {
            offset_ns: 5,
            bound_ns: 100,
        };
        let aged = fresh.aged(Duration::from_secs(1));
        assert_eq!((aged.offset_ns, aged.bound_ns), (5, 200_100));
    }

    #[test]
    fn arithmetic_saturates() {
        assert_eq!(Time(5) - Duration::from_nanos(9), Time(0));
        assert_eq!(Time(u64::MAX) + Duration::from_secs(1), Time(u64::MAX));
        assert_eq!(Time(3).since(Time(8)), Duration::ZERO);
    }
}
