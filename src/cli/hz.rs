//! `ddx hz`: how often an item is written, measured by its own publish times.

use std::time::{Duration, Instant};

use serde_json::{Value, json};

use ddx_store::ReaderOptions;

use super::Context;
use super::render::{rate, span};
use super::subscription::Subscription;
use crate::error::{Exit, Failure, Outcome};

/// Which item, and for how long.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Name of the item
    name: String,
    /// Stop after so many reports, one each second
    #[arg(long, value_name = "N")]
    count: Option<u32>,
}

/// Intervals between samples.
#[derive(Debug, Default)]
struct Intervals {
    ns: Vec<u64>,
}

/// Runs the verb. Without `--count` it ends when it is interrupted.
pub(crate) fn run(context: &mut Context, args: &Args) -> Outcome {
    let store = context.store("hz")?;
    let mut subscription = Subscription::open(&store, &args.name, ReaderOptions::default())?;
    let mut reports = 0;
    let mut last = None;
    let mut seen_any = false;
    while args.count.is_none_or(|count| reports < count) {
        let mut intervals = Intervals::default();
        let missed = subscription.missed();
        let end = Instant::now() + WINDOW;
        loop {
            let left = end.saturating_duration_since(Instant::now());
            if left.is_zero() {
                break;
            }
            if let Some(seen) = subscription.next(left)? {
                let publish = seen.meta.publish.0;
                if let Some(last) = last.replace(publish) {
                    intervals.ns.push(publish.saturating_sub(last));
                }
                seen_any = true;
            }
        }
        let missed = subscription.missed() - missed;
        context.out.either(
            &intervals.object(&args.name, missed),
            &intervals.text(missed),
        )?;
        reports += 1;
    }
    if seen_any {
        Ok(Exit::Done)
    } else {
        Err(Failure::new(format!("no sample of `{}` came", args.name))
            .with_hint(format!("`ddx why {}` says why", args.name)))
    }
}

impl Intervals {
    /// Mean rate, hertz; `None` without an interval.
    fn rate(&self) -> Option<f64> {
        let count = u32::try_from(self.ns.len())
            .ok()
            .filter(|count| *count > 0)?;
        let total = Duration::from_nanos(self.ns.iter().sum()).as_secs_f64();
        (total > 0.0).then(|| f64::from(count) / total)
    }

    fn bounds(&self) -> Option<(u64, u64)> {
        Some((*self.ns.iter().min()?, *self.ns.iter().max()?))
    }

    fn text(&self, missed: u64) -> String {
        match self.bounds() {
            Some((least, most)) => format!(
                "{}   interval {} to {}   {} samples   {missed} missed",
                rate(self.rate()),
                span(least),
                span(most),
                self.ns.len(),
            ),
            None => "nothing in the last second".to_owned(),
        }
    }

    fn object(&self, name: &str, missed: u64) -> Value {
        let bounds = self.bounds();
        json!({
            "name": name,
            "rate_hz": self.rate(),
            "interval_min_ns": bounds.map(|(least, _)| least),
            "interval_max_ns": bounds.map(|(_, most)| most),
            "samples": self.ns.len(),
            "missed": missed,
        })
    }
}

/// One report each.
const WINDOW: Duration = Duration::from_secs(1);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_rate_is_the_mean_and_the_bounds_are_kept() {
        let intervals = Intervals {
            ns: vec![90_000_000, 110_000_000],
        };

        assert_eq!(
            intervals.text(1),
            "10.0 Hz   interval 90.0 ms to 110 ms   2 samples   1 missed"
        );
        assert_eq!(Intervals::default().text(0), "nothing in the last second");
    }
}
