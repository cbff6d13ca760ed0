//! Values with their units, as people write them: `200 kbit/s`, `15 ms`, `33 %`, `64 KiB`.

use std::time::Duration;

use super::{BitsPerSecond, Queue};

const RATES: &[(&str, f64)] = &[
    ("bit/s", 1.0),
    ("kbit/s", 1e3),
    ("Mbit/s", 1e6),
    ("Gbit/s", 1e9),
];
const TIMES: &[(&str, f64)] = &[("ns", 1.0), ("us", 1e3), ("ms", 1e6), ("s", 1e9)];
const SIZES: &[(&str, f64)] = &[
    ("B", 1.0),
    ("kB", 1e3),
    ("KiB", 1024.0),
    ("MB", 1e6),
    ("MiB", 1_048_576.0),
];
const SHARES: &[(&str, f64)] = &[("%", 0.01)];

/// What can be wrong with a value: what was expected.
pub(super) type Expected = &'static str;

pub(super) fn rate(text: &str) -> Result<Option<BitsPerSecond>, Expected> {
    let expected = "a rate above zero such as `200 kbit/s`, or `none`";
    if text == "none" {
        return Ok(None);
    }
    match whole(text, RATES) {
        Some(rate) if rate > 0 => Ok(Some(BitsPerSecond(rate))),
        _ => Err(expected),
    }
}

pub(super) fn time(text: &str) -> Result<Duration, Expected> {
    let nanos = whole(text, TIMES).ok_or("a time such as `15 ms`")?;
    Ok(Duration::from_nanos(nanos))
}

pub(super) fn size(text: &str) -> Result<usize, Expected> {
    let size = whole(text, SIZES).and_then(|size| usize::try_from(size).ok());
    size.ok_or("a size such as `1400 B`")
}

/// A share from 0 to 1.
pub(super) fn share(text: &str) -> Result<f64, Expected> {
    let share = scaled(text, SHARES).filter(|share| (0.0..=1.0).contains(share));
    share.ok_or("a share such as `33 %`")
}

pub(super) fn queue(text: &str) -> Result<Queue, Expected> {
    let by_time = time(text).map(Queue::Time);
    by_time
        .or_else(|_| size(text).map(Queue::Bytes))
        .map_err(|_| "a time such as `100 ms` or a size such as `64 KiB`")
}

/// A mean number of frames, which has no unit.
pub(super) fn burst(text: &str) -> Result<f64, Expected> {
    let burst = text
        .parse()
        .ok()
        .filter(|burst| (1.0..=1e6).contains(burst));
    burst.ok_or("a mean number of frames, from 1, such as `4`")
}

pub(super) fn seed(text: &str) -> Result<u64, Expected> {
    text.parse().map_err(|_| "a whole number")
}

fn whole(text: &str, units: &[(&str, f64)]) -> Option<u64> {
    let value = scaled(text, units)?.round();
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "whole, not negative, and far below 2^64"
    )]
    (0.0..1e18).contains(&value).then_some(value as u64)
}

fn scaled(text: &str, units: &[(&str, f64)]) -> Option<f64> {
    let digits = text.find(|c: char| !c.is_ascii_digit() && c != '.')?;
    let (number, unit) = text.split_at(digits);
    let (_, factor) = units.iter().find(|(name, _)| *name == unit.trim_start())?;
    Some(number.parse::<f64>().ok()? * factor)
}
