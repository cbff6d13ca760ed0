//! What a reader asks of the host that owns an item.

use serde::{Deserialize, Serialize};

/// What a reader asks of the source: at most so many samples, the newest first.
#[derive(
    Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize,
)]
pub struct Contract {
    /// Greatest rate in thousandths of a hertz; `None` takes each sample as it comes.
    pub max_rate_mhz: Option<u32>,
}

impl Contract {
    /// A contract of at most `rate` samples a second; `None` unless `rate` is finite and at least 0.001 Hz.
    pub fn at_most_hz(rate: f64) -> Option<Self> {
        let mhz = (rate * 1000.0).round();
        if !mhz.is_finite() || mhz < 1.0 {
            return None;
        }
        #[expect(
            clippy::as_conversions,
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "a float-to-integer `as` saturates, and the value is positive"
        )]
        let max_rate_mhz = Some(mhz as u32);
        Some(Self { max_rate_mhz })
    }

    /// The weakest contract that satisfies both: the faster rate.
    #[must_use]
    pub fn union(self, other: Self) -> Self {
        let max_rate_mhz = self
            .max_rate_mhz
            .zip(other.max_rate_mhz)
            .map(|(a, b)| a.max(b));
        Self { max_rate_mhz }
    }

    /// Least time between two samples, nanoseconds; zero without a rate.
    pub fn interval_ns(self) -> u64 {
        self.max_rate_mhz.map_or(0, |mhz| {
            1_000_000_000_000_u64
                .checked_div(u64::from(mhz))
                .unwrap_or(u64::MAX)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn union_is_the_faster_and_unlimited_wins() {
        let slow = Contract::at_most_hz(1.0).unwrap();
        let fast = Contract::at_most_hz(20.0).unwrap();
        assert_eq!(slow.union(fast), fast);
        assert_eq!(slow.union(Contract::default()), Contract::default());
        assert_eq!(fast.interval_ns(), 50_000_000);
    }

    #[test]
    fn nonsense_rates_are_no_contract() {
        for rate in [0.0, -1.0, f64::NAN, f64::INFINITY, 0.0001] {
            assert_eq!(Contract::at_most_hz(rate), None, "{rate}");
        }
    }
}
