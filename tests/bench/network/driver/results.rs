//! All figures, and their medians.

use std::collections::BTreeMap;

use serde_json::{Value, json};

use crate::plan::{Cell, Plan};

/// What was measured in one cell in one round.
#[derive(Clone, Debug)]
pub(crate) struct Reading {
    /// Why this size is not carried.
    pub(crate) refused: Option<String>,
    /// Latency one way, from before the sample was filled.
    pub(crate) p50_us: f64,
    pub(crate) p99_us: f64,
    /// Samples that each subscriber got, none twice.
    pub(crate) per_second: f64,
    /// The same of all subscribers, by what all programs and daemons had of the processors.
    pub(crate) per_cpu_second: f64,
    pub(crate) cpu_us_each: f64,
    /// Of the samples that were written: the rest was lost or overwritten by newer ones.
    pub(crate) got_percent: f64,
    /// Bytes that all hosts sent, by samples that all subscribers got.
    pub(crate) wire_bytes_each: f64,
    pub(crate) duplicates: f64,
}

/// What is measured apart from cells.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Once {
    IdleBytes,
    UnreadBytes,
    FirstMs,
    ResumeMs,
}

/// A figure of a cell.
pub(crate) type Figure = fn(&Reading) -> f64;

/// All that was measured.
#[derive(Default)]
pub(crate) struct Results {
    /// Rounds that were completed.
    pub(crate) rounds: usize,
    cells: BTreeMap<(&'static str, Cell), Vec<Reading>>,
    once: BTreeMap<(&'static str, Once), Vec<f64>>,
}

impl Once {
    pub(crate) const ALL: [Self; 4] = [
        Self::IdleBytes,
        Self::UnreadBytes,
        Self::FirstMs,
        Self::ResumeMs,
    ];

    /// Its column's head.
    pub(crate) fn head(self) -> &'static str {
        match self {
            Self::IdleBytes => "100 items idle, B/s",
            Self::UnreadBytes => "100 items at 10 Hz unread, B/s",
            Self::FirstMs => "start to first sample, ms",
            Self::ResumeMs => "resume after 5 s cut, ms",
        }
    }
}

impl Results {
    pub(crate) fn add(&mut self, contender: &'static str, cell: Cell, reading: Reading) {
        let key = (contender, cell);
        self.cells.entry(key).or_default().push(reading);
    }

    pub(crate) fn add_once(&mut self, contender: &'static str, once: Once, figure: f64) {
        self.once.entry((contender, once)).or_default().push(figure);
    }

    /// Median over the rounds; not a number where nothing was measured, or this size is not carried.
    pub(crate) fn figure(&self, contender: &'static str, cell: Cell, figure: Figure) -> f64 {
        if !self.carries(contender, cell) {
            return f64::NAN;
        }
        let readings = self.cells.get(&(contender, cell));
        median(readings.into_iter().flatten().map(figure))
    }

    /// Median of what is measured apart from cells.
    pub(crate) fn once(&self, contender: &'static str, once: Once) -> f64 {
        let figures = self.once.get(&(contender, once));
        median(figures.into_iter().flatten().copied())
    }

    /// Whether a contender carries samples of this size at all: some arrive while nothing is lost.
    fn carries(&self, contender: &'static str, cell: Cell) -> bool {
        let whole = Cell {
            loss_percent: 0,
            ..cell
        };
        let readings = self.cells.get(&(contender, whole));
        readings
            .into_iter()
            .flatten()
            .any(|reading| reading.refused.is_none() && reading.per_second > 0.0)
    }

    /// Whether a contender that took part has a figure for its smallest samples everywhere.
    pub(crate) fn has_all(&self, contender: &'static str, plan: &Plan) -> bool {
        let took_part = self.cells.keys().any(|(name, _)| *name == contender);
        let smallest = plan.sizes.iter().min();
        let mut cells = plan.cells.iter();
        !took_part
            || cells.all(|cell| {
                Some(&cell.size) != smallest
                    || self.figure(contender, *cell, |reading| reading.per_second) > 0.0
            })
    }

    /// All of it for programs.
    pub(crate) fn to_json(&self) -> Value {
        let cells = self.cells.iter().flat_map(|((contender, cell), readings)| {
            readings.iter().enumerate().map(move |(round, reading)| {
                json!({
                    "contender": contender,
                    "subscribers": cell.subscribers,
                    "loss_percent": cell.loss_percent,
                    "size": cell.size,
                    "rate": cell.rate(),
                    "round": round,
                    "refused": reading.refused,
                    "p50_us": reading.p50_us,
                    "p99_us": reading.p99_us,
                    "per_second": reading.per_second,
                    "per_cpu_second": reading.per_cpu_second,
                    "cpu_us_each": reading.cpu_us_each,
                    "got_percent": reading.got_percent,
                    "wire_bytes_each": reading.wire_bytes_each,
                    "duplicates": reading.duplicates,
                })
            })
        });
        let once = self.once.iter().map(
            |((contender, once), figures)| json!({ "contender": contender, "what": once.head(), "figures": figures }),
        );
        json!({ "rounds": self.rounds, "cells": cells.collect::<Vec<_>>(), "once": once.collect::<Vec<_>>() })
    }
}

/// The middle of those values that are numbers, or the mean of the two in the middle.
fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.filter(|value| value.is_finite()).collect();
    values.sort_unstable_by(f64::total_cmp);
    let above = values.len() / 2;
    let below = above - usize::from(above > 0 && values.len().is_multiple_of(2));
    match (values.get(below), values.get(above)) {
        (Some(below), Some(above)) => below.midpoint(*above),
        _ => f64::NAN,
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::plan::Pace;

    pub(crate) fn cell(loss_percent: u8) -> Cell {
        Cell {
            subscribers: 1,
            loss_percent,
            size: 64,
            pace: Pace::Max,
        }
    }

    pub(crate) fn reading(per_second: f64) -> Reading {
        Reading {
            refused: None,
            p50_us: 10.0,
            p99_us: 20.0,
            per_second,
            per_cpu_second: per_second,
            cpu_us_each: 1.0,
            got_percent: 100.0,
            wire_bytes_each: 100.0,
            duplicates: 0.0,
        }
    }

    #[test]
    fn a_size_that_is_not_carried_has_no_figure_and_one_that_is_lost_has_zero() {
        let mut results = Results::default();
        results.add("x", cell(33), reading(0.0));
        assert!(results.figure("x", cell(33), |r| r.per_second).is_nan());

        results.add("x", cell(0), reading(5.0));

        assert_eq!(results.figure("x", cell(33), |r| r.per_second), 0.0);
    }

    #[test]
    fn the_median_passes_over_what_is_no_number() {
        assert_eq!(median([f64::NAN, 3.0, 1.0, 2.0].into_iter()), 2.0);
        assert_eq!(median([4.0, 1.0, 2.0, 9.0].into_iter()), 3.0);
        assert!(median(std::iter::empty()).is_nan());
    }
}
