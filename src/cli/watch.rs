//! `ddx watch`: values as they change, with age and losses. A table on a terminal, else one line for each sample.

use std::collections::BTreeMap;
use std::thread;
use std::time::{Duration, Instant};

use ddx_store::{ReaderOptions, Store, Wait, wait_any};
use ddx_wire::{Delivery, Pattern, Priority};

use super::render::{self, Table};
use super::subscription::Subscription;
use super::{Context, pattern};
use crate::error::{Exit, Failure, Outcome};
use crate::units;

/// Which items, how often, and for how long.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Names to watch; `*` is one chunk, `**` any number [default: `**`]
    pattern: Option<String>,
    /// Most samples a second of each item [default: 1 Hz for items of other hosts, all for those of this one]
    #[arg(long, value_name = "RATE", value_parser = units::rate)]
    rate: Option<f64>,
    /// Ask other hosts for every sample that their rings hold, in order, not only for the newest
    #[arg(long, conflicts_with = "rate")]
    every: bool,
    /// Ask other hosts for no sample older than this
    #[arg(long, value_name = "AGE", value_parser = units::span)]
    max_age: Option<Duration>,
    /// Share of a link that cannot carry all: background, low, normal, high or command
    #[arg(long, value_name = "P", value_parser = priority, default_value = "normal")]
    priority: Priority,
    /// Stop after so many samples
    #[arg(long, value_name = "N")]
    count: Option<u64>,
    /// Stop after so many seconds
    #[arg(long, value_name = "S")]
    seconds: Option<u32>,
}

/// The items that match, each with its reader.
struct Watch<'a> {
    store: &'a Store,
    pattern: Pattern,
    options: ReaderOptions,
    open: BTreeMap<String, Subscription>,
}

/// Runs the verb. Without `--count` and `--seconds` it ends when it is interrupted.
pub(crate) fn run(context: &mut Context, args: &Args) -> Outcome {
    let store = context.store("watch")?;
    let mut watch = Watch {
        store: &store,
        pattern: pattern(&store, args.pattern.as_deref())?,
        options: ReaderOptions {
            rate: args.rate,
            max_age: args.max_age,
            delivery: if args.every {
                Delivery::Every
            } else {
                Delivery::Latest
            },
            priority: args.priority,
            ..ReaderOptions::default()
        },
        open: BTreeMap::new(),
    };
    let end = args
        .seconds
        .map(|seconds| Instant::now() + Duration::from_secs(u64::from(seconds)));
    let (mut listed, mut drawn) = (None::<Instant>, None::<Instant>);
    let mut seen = 0;
    while end.is_none_or(|end| Instant::now() < end) && args.count.is_none_or(|count| seen < count)
    {
        if listed.is_none_or(|at| at.elapsed() >= LIST_EVERY) {
            watch.refresh()?;
            listed = Some(Instant::now());
        }
        watch.wait(SLICE)?;
        let left = args.count.map_or(u64::MAX, |count| count - seen);
        seen += watch.take(context, left)?;
        if context.out.terminal && drawn.is_none_or(|at| at.elapsed() >= DRAW_EVERY) {
            context.out.redraw(&watch.table().lines())?;
            drawn = Some(Instant::now());
        }
    }
    if seen > 0 {
        return Ok(Exit::Done);
    }
    let name = args.pattern.as_deref().unwrap_or("**");
    Err(Failure::new(format!("no sample of `{name}` came"))
        .with_hint(format!("`ddx ls '{name}'` and `ddx why NAME` say why")))
}

/// A priority by its name.
fn priority(text: &str) -> Result<Priority, String> {
    match text {
        "background" => Ok(Priority::Background),
        "low" => Ok(Priority::Low),
        "normal" => Ok(Priority::Normal),
        "high" => Ok(Priority::High),
        "command" => Ok(Priority::Command),
        other => Err(format!(
            "`{other}` is no priority: background, low, normal, high, command"
        )),
    }
}

impl Watch<'_> {
    /// Opens readers for items that are new, and drops those of items that are gone.
    fn refresh(&mut self) -> Result<(), Failure> {
        let literal = self.pattern.literal();
        let entries = self.store.list(&self.pattern)?;
        self.open.retain(|name, _| {
            literal
                .as_ref()
                .is_some_and(|literal| literal.as_str() == name)
                || entries.iter().any(|entry| entry.name.as_str() == name)
        });
        let names = entries.into_iter().map(|entry| entry.name).chain(literal);
        for name in names {
            if !self.open.contains_key(name.as_str()) {
                let local = name.is_under(self.store.host()) || name.is_admin();
                let mut options = self.options;
                if !local && options.delivery == Delivery::Latest {
                    options.rate = options.rate.or(Some(REMOTE_RATE_HZ));
                }
                let subscription = Subscription::open(self.store, name.as_str(), options)?;
                self.open.insert(name.to_string(), subscription);
            }
        }
        Ok(())
    }

    fn wait(&mut self, timeout: Duration) -> Result<(), Failure> {
        let mut readers: Vec<&mut dyn Wait> = self
            .open
            .values_mut()
            .map(|subscription| -> &mut dyn Wait { subscription.reader() })
            .collect();
        if readers.is_empty() {
            thread::sleep(timeout);
        } else {
            wait_any(&mut readers, timeout)?;
        }
        Ok(())
    }

    /// Takes what is there, at most one sample of each item; on a terminal the table shows it later.
    fn take(&mut self, context: &mut Context, most: u64) -> anyhow::Result<u64> {
        let mut taken = 0;
        for subscription in self.open.values_mut() {
            if taken >= most {
                break;
            }
            if subscription.next(Duration::ZERO)?.is_some() {
                taken += 1;
                if !context.out.terminal {
                    let now = ddx_store::now();
                    context
                        .out
                        .either(&subscription.object(now), &line(subscription))?;
                }
            }
        }
        Ok(taken)
    }

    fn table(&self) -> Table {
        let now = ddx_store::now();
        let mut table = Table::new(&["NAME", "RATE", "AGE", "MISSED", "VALUE"]);
        for (name, subscription) in &self.open {
            let unknown = || "?".to_owned();
            let newest = subscription.newest();
            table.row(vec![
                name.clone(),
                render::rate(subscription.rate(now)),
                newest.map_or_else(unknown, |seen| seen.age(now)),
                subscription.missed().to_string(),
                newest.map_or_else(unknown, |seen| render::value(&seen.value, VALUE_WIDTH)),
            ]);
        }
        table
    }
}

fn line(subscription: &Subscription) -> String {
    let now = ddx_store::now();
    let (value, age) = subscription.newest().map_or_else(Default::default, |seen| {
        (render::value(&seen.value, usize::MAX), seen.age(now))
    });
    format!(
        "{}   {value}   {age}   {} missed",
        subscription.name(),
        subscription.missed()
    )
}

/// What a viewer asks of another host, unless told: enough for a person, little for the link.
const REMOTE_RATE_HZ: f64 = 1.0;
/// How often new items are looked for.
const LIST_EVERY: Duration = Duration::from_secs(1);
/// How often a terminal is redrawn: faster is not read.
const DRAW_EVERY: Duration = Duration::from_millis(200);
const SLICE: Duration = Duration::from_millis(100);
const VALUE_WIDTH: usize = 120;
