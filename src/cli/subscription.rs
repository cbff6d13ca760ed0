//! An untyped reader that decodes by the item's schema and keeps count: what `get`, `watch`, `hz` and `demo` share.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use ddx_store::{Meta, RawReader, ReaderOptions, Schema, Store};
use ddx_wire::Time;
use serde_json::{Value, json};

use super::render;
use crate::video;

/// A reader of one item.
#[derive(Debug)]
pub(crate) struct Subscription {
    reader: RawReader,
    payload: Vec<u8>,
    newest: Option<Seen>,
    tally: Tally,
}

/// One sample, decoded.
#[derive(Clone, Debug)]
pub(crate) struct Seen {
    pub(crate) value: Value,
    pub(crate) meta: Meta,
}

/// How many samples came, and how fast.
#[derive(Clone, Debug, Default)]
pub(crate) struct Tally {
    received: u64,
    recent: VecDeque<Time>,
}

impl Subscription {
    /// Opens a reader on `name`.
    pub(crate) fn open(store: &Store, name: &str, options: ReaderOptions) -> anyhow::Result<Self> {
        Ok(Self {
            reader: store.raw_reader(name, None, options)?,
            payload: Vec::new(),
            newest: None,
            tally: Tally::default(),
        })
    }

    /// The item's name.
    pub(crate) fn name(&self) -> &str {
        self.reader.name().as_str()
    }

    /// The reader, to wait on it beside others.
    pub(crate) fn reader(&mut self) -> &mut RawReader {
        &mut self.reader
    }

    /// The newest sample that was seen.
    pub(crate) fn newest(&self) -> Option<&Seen> {
        self.newest.as_ref()
    }

    /// Samples seen.
    pub(crate) fn received(&self) -> u64 {
        self.tally.received
    }

    /// Samples that were written but neither seen nor left out because of the rate that was asked for.
    pub(crate) fn missed(&self) -> u64 {
        let missed = self.reader.missed();
        missed.overwritten + missed.lost
    }

    /// Samples that were left out because of the rate that was asked for, or because nobody on this host read the item.
    pub(crate) fn left_out(&self) -> u64 {
        self.reader.missed().filtered
    }

    /// Samples a second over the last moments; `None` until two were seen, and when none came for long.
    pub(crate) fn rate(&self, now: Time) -> Option<f64> {
        self.tally.rate(now)
    }

    /// Waits for a sample newer than those seen; `None` when there is none after `timeout`.
    pub(crate) fn next(&mut self, timeout: Duration) -> anyhow::Result<Option<&Seen>> {
        let Some(meta) = self.reader.next_into(&mut self.payload, timeout)? else {
            return Ok(None);
        };
        let value = match self.reader.schema() {
            Some(schema) => decode(schema, &self.payload),
            None => Value::Null,
        };
        self.tally.count(meta.publish);
        Ok(Some(self.newest.insert(Seen { value, meta })))
    }

    /// Waits for the first value; `None` when there is none after `timeout`.
    pub(crate) fn first(&mut self, timeout: Duration) -> anyhow::Result<Option<&Seen>> {
        let deadline = Instant::now() + timeout;
        while self.newest.is_none() {
            let left = deadline.saturating_duration_since(Instant::now());
            if self.next(left)?.is_none() && left.is_zero() {
                break;
            }
        }
        Ok(self.newest.as_ref())
    }

    /// What is known now, for programs.
    pub(crate) fn object(&self, now: Time) -> Value {
        let mut object = json!({
            "name": self.name(),
            "received": self.tally.received,
            "missed": self.missed(),
            "left_out": self.left_out(),
            "rate_hz": self.rate(now),
        });
        if let (Some(object), Some(seen)) = (object.as_object_mut(), &self.newest) {
            let age = seen.meta.age(now);
            object.insert("value".to_owned(), seen.value.clone());
            object.insert("epoch".to_owned(), json!(seen.meta.epoch.0));
            object.insert("seq".to_owned(), json!(seen.meta.seq.0));
            object.insert("capture_ns".to_owned(), json!(seen.meta.capture.0));
            object.insert("age_ns".to_owned(), json!(age.bound.map(|_known| age.ns)));
            object.insert("bound_ns".to_owned(), json!(age.bound));
            object.insert("orphaned".to_owned(), json!(seen.meta.orphaned));
        }
        object
    }
}

impl Seen {
    /// The age on this host's clock with its bound, as text.
    pub(crate) fn age(&self, now: Time) -> String {
        let age = self.meta.age(now);
        render::age(age.ns, age.bound)
    }
}

impl Tally {
    fn rate(&self, now: Time) -> Option<f64> {
        let (first, last) = (self.recent.front()?, self.recent.back()?);
        let span = last.since(*first);
        if span.is_zero() || now.since(*last) > STALE {
            return None;
        }
        let intervals = u32::try_from(self.recent.len()).ok()?.saturating_sub(1);
        Some(f64::from(intervals) / span.as_secs_f64())
    }

    fn count(&mut self, publish: Time) {
        self.received += 1;
        if let (Some(rate), Some(last)) = (self.rate(publish), self.recent.back())
            && publish.since(*last).as_secs_f64() > PAUSE / rate
        {
            self.recent.clear();
        }
        if self.recent.len() == RECENT {
            self.recent.pop_front();
        }
        self.recent.push_back(publish);
    }
}

/// A payload that does not fit its schema is shown as the fault that it is; of a frame, what its header says.
fn decode(schema: &Schema, payload: &[u8]) -> Value {
    if video::is_stream(schema) {
        return video::summary(payload);
    }
    schema
        .to_json(payload)
        .unwrap_or_else(|fault| json!({ "undecodable": fault.to_string() }))
}

/// Samples over which a rate is measured.
const RECENT: usize = 32;
/// After so many intervals without a sample the rate is measured anew.
const PAUSE: f64 = 8.0;
/// A rate that nothing has confirmed for this long is not known.
const STALE: Duration = Duration::from_secs(3);

#[cfg(test)]
mod tests {
    use super::*;

    const SECOND: u64 = 1_000_000_000;

    #[test]
    fn a_rate_needs_two_samples_and_goes_stale() {
        let mut tally = Tally::default();
        tally.count(Time(SECOND));
        assert_eq!(tally.rate(Time(SECOND)), None);

        tally.count(Time(SECOND + SECOND / 10));
        let rate = tally.rate(Time(2 * SECOND)).unwrap();
        assert!((rate - 10.0).abs() < 1e-9, "{rate}");
        assert_eq!(tally.rate(Time(9 * SECOND)), None);
    }

    #[test]
    fn a_pause_does_not_count_as_slowness() {
        let mut tally = Tally::default();
        for tenth in [0, 1, 2, 22, 23] {
            tally.count(Time(SECOND + tenth * SECOND / 10));
        }

        let rate = tally.rate(Time(4 * SECOND)).unwrap();
        assert!((rate - 10.0).abs() < 1e-9, "{rate}");
    }
}
