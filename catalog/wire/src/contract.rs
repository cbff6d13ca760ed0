//! What a reader asks of the host that owns an item.

use std::fmt;

use serde::{Deserialize, Serialize};

/// What a reader asks of the source, which keeps to it: nothing more is sent.
#[derive(
    Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize,
)]
pub struct Contract {
    /// Greatest rate in thousandths of a hertz; `None` takes each sample as it comes.
    pub max_rate_mhz: Option<u32>,
    /// Greatest age, since capture, at which a sample is still sent, milliseconds; `None` sends the newest however old.
    pub max_age_ms: Option<u32>,
    /// Whether the newest sample is enough.
    pub delivery: Delivery,
    /// Which items come first where a link cannot carry all.
    pub priority: Priority,
}

/// Which samples a reader wants.
#[derive(
    Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize,
)]
pub enum Delivery {
    /// The newest. On a link without loss each one arrives; what is lost is made good by the next.
    #[default]
    Latest,
    /// Each one that the writer's ring still holds, in order, from the opening of the reader. A rate does not apply.
    Every,
    /// The same, beginning with the oldest that the ring holds when the reader opens.
    EveryFromRing,
}

/// The share of an item where a link cannot carry all that is asked of it.
#[derive(
    Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize,
)]
pub enum Priority {
    /// A quarter of the normal share.
    Background,
    /// Half of the normal share.
    Low,
    /// One share.
    #[default]
    Normal,
    /// Four shares.
    High,
    /// Before all others: small samples that must not wait.
    Command,
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
        Some(Self {
            max_rate_mhz,
            ..Self::default()
        })
    }

    /// The weakest contract that satisfies both: the faster rate, the greater age, the fuller delivery, the higher priority.
    #[must_use]
    pub fn union(self, other: Self) -> Self {
        let larger = |a: Option<u32>, b: Option<u32>| a.zip(b).map(|(a, b)| a.max(b));
        Self {
            max_rate_mhz: larger(self.max_rate_mhz, other.max_rate_mhz),
            max_age_ms: larger(self.max_age_ms, other.max_age_ms),
            delivery: self.delivery.max(other.delivery),
            priority: self.priority.max(other.priority),
        }
    }

    /// Least time between two samples, nanoseconds; zero without a rate, and where each sample is wanted.
    pub fn interval_ns(self) -> u64 {
        if self.delivery != Delivery::Latest {
            return 0;
        }
        self.max_rate_mhz.map_or(0, |mhz| {
            1_000_000_000_000_u64
                .checked_div(u64::from(mhz))
                .unwrap_or(u64::MAX)
        })
    }
}

impl fmt::Display for Contract {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match (self.delivery, self.max_rate_mhz) {
            (Delivery::Latest, None) => f.write_str("newest")?,
            (Delivery::Latest, Some(mhz)) => {
                write!(f, "newest, at most {} Hz", f64::from(mhz) / 1000.0)?;
            }
            (Delivery::Every, _) => f.write_str("every sample")?,
            (Delivery::EveryFromRing, _) => f.write_str("every sample from the ring")?,
        }
        if let Some(age) = self.max_age_ms {
            write!(f, ", at most {age} ms old")?;
        }
        match self.priority {
            Priority::Normal => Ok(()),
            Priority::Background => f.write_str(", background"),
            Priority::Low => f.write_str(", low priority"),
            Priority::High => f.write_str(", high priority"),
            Priority::Command => f.write_str(", command"),
        }
    }
}

impl Priority {
    /// Bytes that an item may send for each byte of an item at [`Priority::Background`].
    pub fn weight(self) -> u32 {
        match self {
            Self::Background => 1,
            Self::Low => 2,
            Self::Normal => 4,
            Self::High | Self::Command => 16,
        }
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
        let each = Contract {
            delivery: Delivery::Every,
            max_age_ms: Some(5),
            ..slow
        };
        assert_eq!(each.interval_ns(), 0);
        let both = each.union(slow);
        assert_eq!((both.delivery, both.max_age_ms), (Delivery::Every, None));
    }

    #[test]
    fn a_contract_is_told_in_words() {
        let contract = Contract {
            max_age_ms: Some(200),
            priority: Priority::High,
            ..Contract::at_most_hz(2.5).unwrap()
        };
        let text = "newest, at most 2.5 Hz, at most 200 ms old, high priority";
        assert_eq!(contract.to_string(), text);
        assert_eq!(Contract::default().to_string(), "newest");
    }

    #[test]
    fn nonsense_rates_are_no_contract() {
        for rate in [0.0, -1.0, f64::NAN, f64::INFINITY, 0.0001] {
            assert_eq!(Contract::at_most_hz(rate), None, "{rate}");
        }
    }
}
