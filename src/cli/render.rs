//! Values, ages, rates and tables as text. What is not known prints `?`.

use std::time::Duration;

use serde_json::Value;

/// An age in nanoseconds with its error bound: `12.3 ms ± 0.4 ms`. A bound of zero is not printed, an unknown one makes
/// the age unknown.
pub(crate) fn age(ns: u64, bound_ns: Option<u64>) -> String {
    match bound_ns {
        None => "?".to_owned(),
        Some(0) => span(ns),
        Some(bound) => format!("{} ± {}", span(ns), span(bound)),
    }
}

/// A span of time with three digits: `870 ns`, `12.3 ms`, `4.05 s`, `2 min 5 s`.
pub(crate) fn span(ns: u64) -> String {
    let seconds = Duration::from_nanos(ns).as_secs_f64();
    if seconds < 1e-6 {
        format!("{ns} ns")
    } else if seconds < 1e-3 {
        format!("{} us", three_digits(seconds * 1e6))
    } else if seconds < 1.0 {
        format!("{} ms", three_digits(seconds * 1e3))
    } else if seconds < 120.0 {
        format!("{} s", three_digits(seconds))
    } else if seconds < 7_200.0 {
        format!("{} min {:.0} s", (seconds / 60.0).floor(), seconds % 60.0)
    } else {
        format!("{:.1} h", seconds / 3_600.0)
    }
}

/// The same of a [`Duration`].
pub(crate) fn duration(span: Duration) -> String {
    self::span(u64::try_from(span.as_nanos()).unwrap_or(u64::MAX))
}

/// A rate: `10.0 Hz`.
pub(crate) fn rate(hertz: Option<f64>) -> String {
    hertz.map_or_else(|| "?".to_owned(), |hz| format!("{} Hz", three_digits(hz)))
}

/// A count of bytes: `512 B`, `1.20 kB`.
pub(crate) fn bytes(count: u64) -> String {
    // Only for display: 53 bits are plenty.
    #[expect(clippy::cast_precision_loss, reason = "three digits are printed")]
    let exact = count as f64;
    if count < 1_000 {
        format!("{count} B")
    } else if exact < 1e6 {
        format!("{} kB", three_digits(exact / 1e3))
    } else if exact < 1e9 {
        format!("{} MB", three_digits(exact / 1e6))
    } else {
        format!("{} GB", three_digits(exact / 1e9))
    }
}

/// A value on one line of at most `width` characters; a struct of one field is that field.
pub(crate) fn value(value: &Value, width: usize) -> String {
    let text = match value {
        Value::Object(fields) => fields
            .iter()
            .map(|(name, field)| format!("{name}={}", short(field)))
            .collect::<Vec<_>>()
            .join(" "),
        Value::String(_) | Value::Null | Value::Bool(_) | Value::Number(_) | Value::Array(_) => {
            short(value)
        }
    };
    clip(&text, width)
}

/// Cuts to `width` characters, the last of which tells that something is missing.
pub(crate) fn clip(text: &str, width: usize) -> String {
    match text.char_indices().nth(width) {
        None => text.to_owned(),
        Some(_) => {
            let mut cut: String = text.chars().take(width.saturating_sub(1)).collect();
            cut.push('…');
            cut
        }
    }
}

/// Rows under headings, each column as wide as it needs to be.
#[derive(Debug)]
pub(crate) struct Table {
    rows: Vec<Vec<String>>,
}

impl Table {
    /// A table with these headings.
    pub(crate) fn new(headings: &[&str]) -> Self {
        Self {
            rows: vec![headings.iter().map(|&heading| heading.to_owned()).collect()],
        }
    }

    /// Adds a row with one cell for each heading.
    pub(crate) fn row(&mut self, cells: Vec<String>) {
        self.rows.push(cells);
    }

    /// The lines, headings first, without blanks at their ends.
    pub(crate) fn lines(&self) -> Vec<String> {
        let columns = self.rows.iter().map(Vec::len).max().unwrap_or(0);
        let widths: Vec<usize> = (0..columns)
            .map(|column| {
                self.rows
                    .iter()
                    .filter_map(|row| row.get(column))
                    .map(|cell| cell.chars().count())
                    .max()
                    .unwrap_or(0)
            })
            .collect();
        self.rows
            .iter()
            .map(|row| {
                let line: String = row
                    .iter()
                    .zip(&widths)
                    .map(|(cell, width)| format!("{cell:<width$}  "))
                    .collect();
                line.trim_end().to_owned()
            })
            .collect()
    }
}

fn three_digits(number: f64) -> String {
    let decimals = if number >= 99.95 {
        0
    } else if number >= 9.995 {
        1
    } else {
        2
    };
    format!("{number:.decimals$}")
}

fn short(value: &Value) -> String {
    match value {
        Value::String(text) => text.clone(),
        Value::Number(number) => match number.as_f64() {
            Some(float) if number.is_f64() && float.abs() >= 1e-3 && float.abs() < 1e9 => {
                let text = format!("{float:.6}");
                text.trim_end_matches('0').trim_end_matches('.').to_owned()
            }
            Some(_) | None => number.to_string(),
        },
        Value::Null | Value::Bool(_) | Value::Array(_) | Value::Object(_) => value.to_string(),
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn an_age_shows_its_bound_and_an_unknown_one_is_a_question_mark() {
        assert_eq!(age(12_345_678, Some(400_000)), "12.3 ms ± 400 us");
        assert_eq!(age(870, Some(0)), "870 ns");
        assert_eq!(age(5, None), "?");
        assert_eq!(rate(None), "?");
    }

    #[test]
    fn spans_and_sizes_keep_three_digits() {
        assert_eq!(span(4_050_000_000), "4.05 s");
        assert_eq!(span(125_000_000_000), "2 min 5 s");
        assert_eq!(bytes(999), "999 B");
        assert_eq!(bytes(1_204), "1.20 kB");
        assert_eq!(bytes(98_700_000), "98.7 MB");
    }

    #[test]
    fn values_fit_the_width() {
        let fix = json!({"latitude": 55.088_849_833_3, "quality": 2});

        assert_eq!(value(&fix, 80), "latitude=55.08885 quality=2");
        assert_eq!(value(&fix, 12), "latitude=55…");
        assert_eq!(value(&json!(7), 80), "7");
    }

    #[test]
    fn columns_align_and_lines_have_no_blank_ends() {
        let mut table = Table::new(&["NAME", "TYPE"]);
        table.row(vec!["robot1/gps/fix".to_owned(), "Fix".to_owned()]);

        assert_eq!(
            table.lines(),
            ["NAME            TYPE", "robot1/gps/fix  Fix"]
        );
    }
}
