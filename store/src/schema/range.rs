//! Ranges that a person may put, with bounds that stay exact.

use std::fmt;

/// The least and the greatest value that a person may put, both included, either of them optional.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Range {
    /// Least value.
    pub low: Option<Number>,
    /// Greatest value.
    pub high: Option<Number>,
}

/// An exact bound: integers beyond 2^53 do not pass through a float.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Number {
    /// An integer of any scalar type.
    Integer(i128),
    /// A finite float.
    Float(f64),
}

impl Range {
    /// Reads `low..high`, `low..` or `..high`; both ends belong to it.
    pub fn parse(text: &str) -> Option<Self> {
        let (low, high) = text.split_once("..")?;
        let end = |text: &str| match text {
            "" => Some(None),
            digits => Number::parse(digits).map(Some),
        };
        let (low, high) = (end(low)?, end(high)?);
        (low.is_some() || high.is_some()).then_some(Self { low, high })
    }

    /// Whether `value` lies within; NaN never does.
    pub fn contains(&self, value: Number) -> bool {
        self.low.is_none_or(|low| low.at_most(value))
            && self.high.is_none_or(|high| value.at_most(high))
    }
}

impl Number {
    fn parse(text: &str) -> Option<Self> {
        let digits = text.strip_prefix('-').unwrap_or(text);
        if !digits.starts_with(|c: char| c.is_ascii_digit()) {
            return None;
        }
        if digits.bytes().all(|b| b.is_ascii_digit()) {
            return text.parse().ok().map(Self::Integer);
        }
        let float: f64 = text.parse().ok()?;
        float.is_finite().then_some(Self::Float(float))
    }

    pub(super) fn at_most(self, other: Self) -> bool {
        match (self, other) {
            (Self::Integer(a), Self::Integer(b)) => a <= b,
            (a, b) => a.as_float() <= b.as_float(),
        }
    }

    fn as_float(self) -> f64 {
        match self {
            Self::Integer(integer) => integer as f64,
            Self::Float(float) => float,
        }
    }
}

impl fmt::Display for Range {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if let Some(low) = self.low {
            write!(f, "{low}")?;
        }
        f.write_str("..")?;
        self.high.map_or(Ok(()), |high| write!(f, "{high}"))
    }
}

impl fmt::Display for Number {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Integer(integer) => write!(f, "{integer}"),
            Self::Float(float) => write!(f, "{float:?}"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_range_keeps_integers_exact_and_includes_its_ends() {
        let range = Range::parse("-1..18446744073709551614").unwrap();

        let within = |value: u64| range.contains(Number::Integer(i128::from(value)));
        assert!(within(u64::MAX - 1));
        assert!(!within(u64::MAX));
        assert!(range.contains(Number::Float(-1.0)));
        assert!(!range.contains(Number::Float(-1.5)));
        assert!(!range.contains(Number::Float(f64::NAN)));
    }

    #[test]
    fn what_is_no_range_is_not_read() {
        for text in [
            "", "..", "1", "1..x", "1...2", "inf..", "..1e999", "--1..2", "+1..2",
        ] {
            assert_eq!(Range::parse(text), None, "{text}");
        }
        assert_eq!(Range::parse("0.5..1e3").unwrap().to_string(), "0.5..1000.0");
    }
}
