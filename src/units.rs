//! Sizes, spans and rates as people write them: a number and its unit. A bare number is refused where a unit is possible.

use std::time::Duration;

/// Parses a size: `64 KiB`, `1 MB`, `512 B`. Bytes.
pub fn size(text: &str) -> Result<u64, String> {
    let (number, unit) = split(text, "a size", "`64 KiB`")?;
    let factor = match unit {
        "B" => 1.0,
        "kB" => 1e3,
        "KiB" => 1024.0,
        "MB" => 1e6,
        "MiB" => 1024.0 * 1024.0,
        "GB" => 1e9,
        "GiB" => 1024.0 * 1024.0 * 1024.0,
        other => return Err(unknown(text, other, "B, kB, KiB, MB, MiB, GB, GiB")),
    };
    Ok(whole(number * factor))
}

/// Parses a span of time: `100 ms`, `2 s`, `250us`.
pub fn span(text: &str) -> Result<Duration, String> {
    let (number, unit) = split(text, "a time", "`2 s`")?;
    let seconds = match unit {
        "ns" => 1e-9,
        "us" => 1e-6,
        "ms" => 1e-3,
        "s" => 1.0,
        "min" => 60.0,
        "h" => 3600.0,
        other => return Err(unknown(text, other, "ns, us, ms, s, min, h")),
    };
    Duration::try_from_secs_f64(number * seconds)
        .map_err(|fault| format!("`{text}` is not a time: {fault}"))
}

/// Parses a rate in hertz: `10 Hz`, `2kHz`, or a bare `10`, for which no other unit is possible.
pub fn rate(text: &str) -> Result<f64, String> {
    let bare = text.trim().parse::<f64>().is_ok();
    let (number, unit) = if bare {
        (text.trim().parse::<f64>().unwrap_or(f64::NAN), "Hz")
    } else {
        split(text, "a rate", "`10 Hz`")?
    };
    let hertz = match unit {
        "mHz" => number / 1e3,
        "Hz" => number,
        "kHz" => number * 1e3,
        other => return Err(unknown(text, other, "mHz, Hz, kHz")),
    };
    if hertz.is_finite() && (0.001..=1e6).contains(&hertz) {
        Ok(hertz)
    } else {
        Err(format!("`{text}` is out of range: 1 mHz to 1000 kHz"))
    }
}

/// Spells a size with the largest binary unit that divides it.
pub fn spell_size(bytes: u64) -> String {
    [("GiB", 1_u64 << 30), ("MiB", 1 << 20), ("KiB", 1 << 10)]
        .into_iter()
        .find(|(_, factor)| bytes >= *factor && bytes.is_multiple_of(*factor))
        .map_or_else(
            || format!("{bytes} B"),
            |(unit, factor)| format!("{} {unit}", bytes / factor),
        )
}

/// Spells a span with the largest unit that divides it.
pub fn spell_span(span: Duration) -> String {
    let ns = span.as_nanos();
    [("s", 1_000_000_000_u128), ("ms", 1_000_000), ("us", 1_000)]
        .into_iter()
        .find(|(_, factor)| ns >= *factor && ns.is_multiple_of(*factor))
        .map_or_else(
            || format!("{ns} ns"),
            |(unit, factor)| format!("{} {unit}", ns / factor),
        )
}

fn split<'a>(text: &'a str, what: &str, example: &str) -> Result<(f64, &'a str), String> {
    let text = text.trim();
    let end = text.find(|c: char| c.is_alphabetic()).unwrap_or(text.len());
    let (number, unit) = text.split_at(end);
    let number = number
        .trim()
        .parse::<f64>()
        .ok()
        .filter(|number| number.is_finite() && *number >= 0.0)
        .ok_or_else(|| format!("`{text}` is not {what}: write one as {example}"))?;
    if unit.is_empty() {
        return Err(format!("`{text}` has no unit: write {what} as {example}"));
    }
    Ok((number, unit))
}

fn unknown(text: &str, unit: &str, known: &str) -> String {
    format!("`{text}` has the unknown unit `{unit}`: known are {known}")
}

/// The whole number nearest to one that is not negative.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "a float-to-integer `as` saturates, and the number is not negative"
)]
pub(crate) fn whole(number: f64) -> u64 {
    number.round() as u64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_with_units_are_read() {
        assert_eq!(size("64 KiB"), Ok(65_536));
        assert_eq!(size("1.5MB"), Ok(1_500_000));
        assert_eq!(span("250us"), Ok(Duration::from_micros(250)));
        assert_eq!(rate("10"), Ok(10.0));
        assert_eq!(rate("2 kHz"), Ok(2_000.0));
    }

    #[test]
    fn bare_numbers_unknown_units_and_nonsense_are_refused_with_an_example() {
        for (refused, expected) in [
            (
                size("64").unwrap_err(),
                "`64` has no unit: write a size as `64 KiB`",
            ),
            (
                span("5").unwrap_err(),
                "`5` has no unit: write a time as `2 s`",
            ),
            (
                span("-5 s").unwrap_err(),
                "`-5 s` is not a time: write one as `2 s`",
            ),
            (
                rate("0").unwrap_err(),
                "`0` is out of range: 1 mHz to 1000 kHz",
            ),
        ] {
            assert_eq!(refused, expected);
        }
        assert!(
            size("4 furlongs")
                .unwrap_err()
                .contains("unknown unit `furlongs`")
        );
    }

    #[test]
    fn what_is_spelled_reads_back() {
        for bytes in [0, 1, 1_200, 65_536, 3 << 30] {
            assert_eq!(size(&spell_size(bytes)), Ok(bytes));
        }
        for span_ns in [1, 1_500, 250_000_000, 3_000_000_000] {
            let value = Duration::from_nanos(span_ns);
            assert_eq!(span(&spell_span(value)), Ok(value));
        }
    }
}
