//! What the audience sees: the live table of base, what crossed the link, and how long each recovery took.

use std::collections::BTreeMap;
use std::thread;
use std::time::{Duration, Instant};

use anyhow::Context as _;
use ddx_store::{ReaderOptions, Store, Wait, wait_any};
use ddx_wire::{Pattern, Time};
use serde_json::{Value, json};

use super::stage::Stage;
use crate::cli::interrupt::Interrupt;
use crate::cli::output::Output;
use crate::cli::render::{self, Table};
use crate::cli::subscription::Subscription;

/// The show that base sees.
pub(super) struct Show<'a> {
    out: &'a mut Output,
    interrupt: Interrupt,
    base: Store,
    meter: Meter,
    items: BTreeMap<String, Option<Subscription>>,
    act: (&'static str, &'static str),
    /// When the last act began that items must recover from.
    began: Time,
    recoveries: Vec<Recovery>,
    crossed: Crossed,
    told: Instant,
}

/// Bytes of samples that robot1 sent, over its lives.
struct Meter {
    counters: Option<Subscription>,
    former_lives: u64,
    newest: Option<u64>,
}

/// Bytes on the link until base read, and until it looked at the video.
#[derive(Default)]
struct Crossed {
    samples_unread: Option<u64>,
    samples_unseen: Option<u64>,
    link_unread: Option<u64>,
    link: Option<u64>,
}

/// How long it took until every item was fresh again.
struct Recovery {
    after: &'static str,
    took: Option<Duration>,
}

impl<'a> Show<'a> {
    /// Waits until base knows the items of robot1, without reading any.
    pub(super) fn new(
        out: &'a mut Output,
        stage: &Stage,
        interrupt: Interrupt,
    ) -> anyhow::Result<Self> {
        let base = stage.base.store()?;
        let deadline = Instant::now() + PATIENCE;
        let pattern = Pattern::parse("robot1/**", base.host())?;
        let items = loop {
            let entries = base.list(&pattern)?;
            if entries.len() >= ITEMS {
                // What a stream is made of is written once, and is not to be fresh again.
                break entries
                    .into_iter()
                    .map(|entry| (entry.name.to_string(), None))
                    .filter(|(name, _)| !name.ends_with("/info"))
                    .collect();
            }
            if Instant::now() >= deadline || interrupt.is_raised() {
                anyhow::bail!(
                    "base knows {} of the {ITEMS} items of robot1 after {PATIENCE:?}",
                    entries.len()
                );
            }
            thread::sleep(SLICE);
        };
        Ok(Self {
            out,
            interrupt,
            base,
            meter: Meter::new(stage)?,
            items,
            act: ("", ""),
            began: ddx_store::now(),
            recoveries: Vec::new(),
            crossed: Crossed::default(),
            told: Instant::now(),
        })
    }

    /// Announces an act.
    pub(super) fn enter(&mut self, key: &'static str, text: &'static str) -> anyhow::Result<()> {
        self.act = (key, text);
        self.began = ddx_store::now();
        if matches!(key, "healed" | "restarted") {
            self.recoveries.push(Recovery {
                after: key,
                took: None,
            });
        }
        self.out.either(
            &json!({ "event": "act", "act": key, "text": text }),
            &format!("--- {text}"),
        )
    }

    /// Opens a reader on each of these items.
    pub(super) fn subscribe(&mut self, which: impl Fn(&str) -> bool) -> anyhow::Result<()> {
        if self.crossed.samples_unread.is_none() {
            self.crossed.samples_unread = self.meter.total();
            self.crossed.link_unread = self.crossed.link;
        } else {
            self.crossed.samples_unseen = self.meter.total();
        }
        for (name, subscription) in self.items.iter_mut().filter(|(name, _)| which(name)) {
            *subscription = Some(Subscription::open(
                &self.base,
                name,
                ReaderOptions::default(),
            )?);
        }
        Ok(())
    }

    /// Keeps what robot1 counted so far, because it is about to forget.
    pub(super) fn robot_dies(&mut self) {
        self.meter.former_lives = self.meter.total().unwrap_or(0);
        self.meter.newest = None;
        self.meter.counters = None;
    }

    /// Reads robot1's counters again.
    pub(super) fn robot_lives(&mut self, stage: &Stage) -> anyhow::Result<()> {
        self.meter.counters = Some(open_counters(stage)?);
        Ok(())
    }

    /// Shows what happens for `length`.
    pub(super) fn play(&mut self, stage: &Stage, length: Duration) -> anyhow::Result<()> {
        let end = Instant::now() + length;
        while Instant::now() < end && !self.interrupt.is_raised() {
            self.meter.read()?;
            self.crossed.link = stage.link_bytes().or(self.crossed.link);
            self.wait()?;
            for subscription in self.items.values_mut().flatten() {
                while subscription.next(Duration::ZERO)?.is_some() {}
            }
            self.note_recovery();
            self.tell(false)?;
        }
        self.tell(true)
    }

    /// Prints the summary. Returns whether samples came and every recovery was complete.
    pub(super) fn finish(self) -> anyhow::Result<bool> {
        let sum =
            |count: fn(&Subscription) -> u64| self.items.values().flatten().map(count).sum::<u64>();
        let received = sum(Subscription::received);
        let missed = sum(Subscription::missed);
        let left_out = sum(Subscription::left_out);
        let recovered = received > 0
            && self
                .recoveries
                .iter()
                .all(|recovery| recovery.took.is_some());
        let samples = self.meter.total();
        if self.out.json {
            let recoveries = self
                .recoveries
                .iter()
                .map(|r| (r.after.to_owned(), json!(r.took.map(|t| t.as_secs_f64()))));
            self.out.object(&json!({
                "event": "summary",
                "items": self.items.len(),
                "received": received,
                "missed": missed,
                "left_out": left_out,
                "sample_bytes_before_reading": self.crossed.samples_unread,
                "sample_bytes_before_looking": self.crossed.samples_unseen,
                "sample_bytes": samples,
                "link_bytes_before_reading": self.crossed.link_unread,
                "link_bytes": self.crossed.link,
                "recovered_s": recoveries.collect::<serde_json::Map<String, Value>>(),
                "recovered": recovered,
            }))?;
            return Ok(recovered);
        }
        self.out.line("--- summary")?;
        self.out.line(&format!("samples   {received} received, {missed} missed, {left_out} not sent while the link was down"))?;
        self.out
            .line(&format!("crossed   {}", self.crossed.text(samples)))?;
        for recovery in &self.recoveries {
            let took = recovery.took.map_or_else(
                || "not every item came back".to_owned(),
                |took| format!("all items fresh after {}", render::duration(took)),
            );
            self.out.line(&format!("{:<9} {took}", recovery.after))?;
        }
        Ok(recovered)
    }

    fn wait(&mut self) -> anyhow::Result<()> {
        let mut readers: Vec<&mut dyn Wait> = self
            .items
            .values_mut()
            .flatten()
            .map(|subscription| -> &mut dyn Wait { subscription.reader() })
            .collect();
        if readers.is_empty() {
            thread::sleep(SLICE);
        } else {
            wait_any(&mut readers, SLICE)?;
        }
        Ok(())
    }

    fn note_recovery(&mut self) {
        let began = self.began;
        let fresh = |subscription: &Subscription| {
            subscription
                .newest()
                .is_some_and(|seen| seen.meta.receive.unwrap_or(seen.meta.publish) > began)
        };
        if let Some(recovery) = self.recoveries.last_mut()
            && recovery.took.is_none()
            && self.items.values().flatten().all(fresh)
        {
            recovery.took = Some(ddx_store::now().since(began));
        }
    }

    /// Draws the table, or tells its rows: on a terminal often, else each second and at the end of an act.
    fn tell(&mut self, last: bool) -> anyhow::Result<()> {
        let every = if self.out.terminal {
            DRAW_EVERY
        } else {
            TELL_EVERY
        };
        if self.told.elapsed() < every && !last {
            return Ok(());
        }
        self.told = Instant::now();
        let now = ddx_store::now();
        if self.out.json {
            for (name, subscription) in &self.items {
                let mut object = match subscription {
                    Some(subscription) => subscription.object(now),
                    None => json!({ "name": name }),
                };
                object["event"] = json!("item");
                object["act"] = json!(self.act.0);
                self.out.object(&object)?;
            }
            return self.out.object(&json!({
                "event": "link",
                "act": self.act.0,
                "sample_bytes": self.meter.total(),
                "link_bytes": self.crossed.link,
            }));
        }
        let lines = self.lines(now);
        if self.out.terminal {
            return self
                .out
                .redraw(&lines)
                .and_then(|()| if last { self.out.line("") } else { Ok(()) });
        }
        // A log holds the end of each act; every second of it would be read by nobody.
        if last {
            for line in &lines {
                self.out.line(line)?;
            }
        }
        Ok(())
    }

    fn lines(&self, now: Time) -> Vec<String> {
        let mut table = Table::new(&["NAME", "RATE", "AGE", "MISSED", "VALUE"]);
        for (name, subscription) in &self.items {
            let unknown = || "?".to_owned();
            let newest = subscription.as_ref().and_then(Subscription::newest);
            table.row(vec![
                name.clone(),
                render::rate(subscription.as_ref().and_then(|s| s.rate(now))),
                newest.map_or_else(unknown, |seen| seen.age(now)),
                subscription
                    .as_ref()
                    .map_or_else(unknown, |s| s.missed().to_string()),
                newest.map_or_else(
                    || {
                        if subscription.is_some() {
                            "?"
                        } else {
                            "not read"
                        }
                        .to_owned()
                    },
                    |seen| render::value(&seen.value, VALUE_WIDTH),
                ),
            ]);
        }
        let mut lines = table.lines();
        lines.push(format!(
            "crossed the link: samples {}; everything {}",
            self.crossed.text(self.meter.total()),
            known(self.crossed.link),
        ));
        lines
    }
}

impl Crossed {
    /// How many bytes of samples crossed in each part of the show, of so many until now.
    fn text(&self, now: Option<u64>) -> String {
        let (unread, unseen) = (self.samples_unread, self.samples_unseen);
        let between = |from: Option<u64>, to: Option<u64>| {
            known(from.zip(to).map(|(from, to)| to.saturating_sub(from)))
        };
        let mut text = format!("{} before base read", known(unread.or(now)));
        if unread.is_some() {
            let read = between(unread, unseen.or(now));
            text.push_str(&format!(", {read} before it looked at the video"));
        }
        if unseen.is_some() {
            text.push_str(&format!(", {} since", between(unseen, now)));
        }
        text
    }
}

impl Meter {
    fn new(stage: &Stage) -> anyhow::Result<Self> {
        Ok(Self {
            counters: Some(open_counters(stage)?),
            former_lives: 0,
            newest: None,
        })
    }

    fn read(&mut self) -> anyhow::Result<()> {
        if let Some(counters) = &mut self.counters {
            while let Some(seen) = counters.next(Duration::ZERO)? {
                self.newest = seen.value[SAMPLE_BYTES].as_u64().or(self.newest);
            }
        }
        Ok(())
    }

    fn total(&self) -> Option<u64> {
        self.newest
            .map(|newest| self.former_lives + newest)
            .or_else(|| (self.former_lives > 0).then_some(self.former_lives))
    }
}

fn open_counters(stage: &Stage) -> anyhow::Result<Subscription> {
    Subscription::open(
        &stage.robot.store()?,
        "@/counters",
        ReaderOptions::default(),
    )
    .context("read the counters of robot1")
}

fn known(bytes: Option<u64>) -> String {
    bytes.map_or_else(|| "?".to_owned(), render::bytes)
}

/// The counter of robot1's bytes on its data socket.
const SAMPLE_BYTES: &str = "data_sent_bytes";
/// Items of robot1: four of the receiver, three of the machine, three of the video.
const ITEMS: usize = 10;
/// Longest wait for base to know them.
const PATIENCE: Duration = Duration::from_secs(10);
const SLICE: Duration = Duration::from_millis(50);
const DRAW_EVERY: Duration = Duration::from_millis(200);
const TELL_EVERY: Duration = Duration::from_secs(1);
const VALUE_WIDTH: usize = 60;
