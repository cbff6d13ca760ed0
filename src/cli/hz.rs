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
    /// Of a stream of video: the numbers of the first and the last frame at their source, and what the last one is.
    frames: Option<(u64, u64, String)>,
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
                intervals.note_frame(&seen.value);
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

    fn note_frame(&mut self, value: &Value) {
        let Some((frame, fields)) = value["frame"].as_u64().zip(value["fields"].as_array()) else {
            return;
        };
        let fields: Vec<_> = fields.iter().filter_map(Value::as_str).collect();
        let first = self.frames.take().map_or(frame, |(first, ..)| first);
        self.frames = Some((first, frame, fields.join(" + ")));
    }

    fn bounds(&self) -> Option<(u64, u64)> {
        Some((*self.ns.iter().min()?, *self.ns.iter().max()?))
    }

    fn text(&self, missed: u64) -> String {
        match self.bounds() {
            Some((least, most)) => {
                let mut text = format!(
                    "{}   interval {} to {}   {} samples   {missed} missed",
                    rate(self.rate()),
                    span(least),
                    span(most),
                    self.ns.len(),
                );
                if let Some((first, last, fields)) = &self.frames {
                    text.push_str(&format!("   frames {first} to {last}, {fields}"));
                }
                text
            }
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
            "first_frame": self.frames.as_ref().map(|(first, ..)| first),
            "last_frame": self.frames.as_ref().map(|(_, last, _)| last),
            "fields": self.frames.as_ref().map(|(.., fields)| fields),
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
            ..Intervals::default()
        };

        assert_eq!(
            intervals.text(1),
            "10.0 Hz   interval 90.0 ms to 110 ms   2 samples   1 missed"
        );
        let mut of_frames = intervals;
        for frame in [7, 9] {
            of_frames.note_frame(&json!({ "frame": frame, "fields": ["640x480 I420"] }));
        }
        assert!(
            of_frames
                .text(1)
                .ends_with("1 missed   frames 7 to 9, 640x480 I420")
        );
        assert_eq!(Intervals::default().text(0), "nothing in the last second");
    }
}
