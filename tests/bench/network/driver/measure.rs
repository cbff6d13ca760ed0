//! What is asked of one contender in one round.

use std::thread;
use std::time::Duration;

use anyhow::{Context, Result};

use crate::contender::{Build, Contender};
use crate::plan::{Cell, Pace, Plan};
use crate::program::now_ns;
use crate::results::{Once, Reading, Results};
use crate::session::{Opening, Order, Outcome, Session, number};

/// One contender's turn.
pub(crate) struct Measure<'a> {
    pub(crate) contender: &'static Contender,
    pub(crate) build: &'a Build,
    pub(crate) plan: &'a Plan,
    pub(crate) results: &'a mut Results,
}

impl Measure<'_> {
    /// Measures all that one round has; false where no lab can be had.
    pub(crate) fn round(&mut self) -> bool {
        for subscribers in self.plan.fans() {
            if !self.cells(subscribers) {
                return false;
            }
        }
        true
    }

    /// Measures what is measured once.
    pub(crate) fn once(&mut self) {
        let idle = self.idle();
        self.note(idle, "idle");
        if let Some(cut) = self.plan.cut {
            let resume = self.resume(cut);
            self.note(resume, "resume");
        }
    }

    /// All cells with so many subscribers. A contender that fails in one is started anew for the next, a few times.
    fn cells(&mut self, subscribers: usize) -> bool {
        let cells = self.plan.cells.iter();
        let cells: Vec<Cell> = cells
            .filter(|cell| cell.subscribers == subscribers)
            .copied()
            .collect();
        let mut session = None;
        let mut failures = 0;
        for cell in cells {
            if failures > FAILURES_MAX {
                break;
            }
            let measured = self.cell(&mut session, &cell);
            match measured {
                Ok(Some(reading)) => self.results.add(self.contender.name, cell, reading),
                Ok(None) => return false,
                Err(error) => {
                    self.note(Err(error), &format!("{cell:?}"));
                    session = None;
                    failures += 1;
                }
            }
        }
        true
    }

    fn cell(&mut self, session: &mut Option<Session>, cell: &Cell) -> Result<Option<Reading>> {
        let session = match session {
            Some(session) => session,
            None => {
                let Some(mut opened) = self.open(cell.subscribers, [1, 1])? else {
                    return Ok(None);
                };
                let first = opened.wait_first(self.plan.sizes[0])?;
                if cell.subscribers == 1 {
                    self.results.add_once(
                        self.contender.name,
                        Once::FirstMs,
                        first.as_secs_f64() * 1e3,
                    );
                }
                session.insert(opened)
            }
        };
        session.set_loss(cell.loss_percent)?;
        if session.is_behind {
            session.settle(self.plan.sizes[0])?;
        }
        let mut order = Order {
            size: cell.size,
            rate: cell.rate(),
            warm: self.plan.warm,
            span: self.plan.span_of(cell),
            grace: self.plan.grace,
        };
        let mut best = reading(&session.run(&order)?, order.span, cell.pace);
        // Who writes much faster than samples travel wastes a processor on what is overwritten or lost: a second try at little
        // more than what arrived may do better.
        let expected = f64::from(100 - cell.loss_percent);
        if cell.pace == Pace::Max && best.per_second > 0.0 && best.got_percent < 0.9 * expected {
            session.settle(self.plan.sizes[0])?;
            order.rate = Some(OVER * best.per_second);
            let paced = reading(&session.run(&order)?, order.span, cell.pace);
            best.per_second = best.per_second.max(paced.per_second);
            best.per_cpu_second = best.per_cpu_second.max(paced.per_cpu_second);
        }
        session.is_behind = cell.pace == Pace::Max;
        Ok(Some(best))
    }

    /// What hosts say while nobody reads: nothing written, and each item written ten times a second.
    fn idle(&mut self) -> Result<()> {
        let Some(mut session) = self.open(1, [IDLE_ITEMS, 0])? else {
            return Ok(());
        };
        session.wait_ready()?;
        let order = |rate: f64, span: Duration| Order {
            size: self.plan.sizes[0],
            rate: Some(rate),
            warm: Duration::ZERO,
            span,
            grace: Duration::ZERO,
        };
        // Every item has a value.
        session.publish(&order(1_000.0, Duration::from_millis(150)))?;
        thread::sleep(self.plan.settle);
        let idle = session.watch(self.plan.idle)?;
        session.publish(&order(1_000.0, self.plan.idle + Duration::from_secs(1)))?;
        thread::sleep(Duration::from_millis(500));
        let unread = session.watch(self.plan.idle)?;
        for (once, hosts) in [(Once::IdleBytes, idle), (Once::UnreadBytes, unread)] {
            let of_publisher = hosts.first().copied().unwrap_or(f64::NAN);
            self.results
                .add_once(self.contender.name, once, of_publisher);
        }
        Ok(())
    }

    /// How long after a cut link is whole again the next sample comes, at 50 a second.
    fn resume(&mut self, cut: Duration) -> Result<()> {
        let Some(mut session) = self.open(1, [1, 1])? else {
            return Ok(());
        };
        session.wait_first(self.plan.sizes[0])?;
        let order = Order {
            size: self.plan.sizes[0],
            rate: Some(50.0),
            warm: Duration::ZERO,
            span: BEFORE_CUT + cut + AFTER_CUT,
            grace: Duration::ZERO,
        };
        let mut healed = 0;
        let outcome = session.run_while(&order, |session| {
            let host = session.lab.host("b1");
            thread::sleep(BEFORE_CUT);
            host.cut()?;
            thread::sleep(cut);
            healed = now_ns();
            Ok(host.heal()?)
        })?;
        let subscriber = outcome
            .subscribers
            .first()
            .context("there is a subscriber")?;
        let resumed = number(subscriber, "gap_end_ns") - healed as f64;
        // Without a sample after the cut the longest gap ended before it.
        let resumed_ms = if resumed > 0.0 {
            resumed / 1e6
        } else {
            f64::NAN
        };
        self.results
            .add_once(self.contender.name, Once::ResumeMs, resumed_ms);
        Ok(())
    }

    fn open(&self, subscribers: usize, items: [usize; 2]) -> Result<Option<Session>> {
        let opening = Opening {
            subscribers,
            items,
            sizes: &self.plan.sizes,
        };
        Session::start(self.contender, self.build, &opening)
    }

    /// A contender's failure is a dash in the table, and a line here.
    fn note(&self, done: Result<()>, what: &str) {
        if let Err(error) = done {
            eprintln!("!!!! NO FIGURE: {}, {what}: {error:#}", self.contender.name);
        }
    }
}

fn reading(outcome: &Outcome, span: Duration, pace: Pace) -> Reading {
    let subscribers = outcome.subscribers.len() as f64;
    let sum = |key: &str| -> f64 {
        let each = outcome.subscribers.iter();
        each.map(|subscriber| number(subscriber, key)).sum()
    };
    let (sent, arrived) = (number(&outcome.publisher, "sent"), sum("arrived"));
    let (p50, p99) = (sum("p50_ns") / subscribers, sum("p99_ns") / subscribers);
    // A steady beat is judged by what was sent within the span, the greatest rate by what arrived within it.
    let got = match pace {
        Pace::Steady => sum("delivered"),
        Pace::Max => arrived,
    };
    let or_none = |figure: f64| if got > 0.0 { figure } else { f64::NAN };
    Reading {
        refused: outcome.publisher["refused"].as_str().map(str::to_owned),
        p50_us: or_none(p50 / 1e3),
        p99_us: or_none(p99 / 1e3),
        per_second: arrived / subscribers / span.as_secs_f64(),
        per_cpu_second: or_none(arrived / (outcome.cpu_ns / 1e9)),
        cpu_us_each: or_none(outcome.cpu_ns / 1e3 / arrived),
        got_percent: (100.0 * got / subscribers / sent).min(100.0),
        wire_bytes_each: or_none(
            outcome.wire_bytes as f64 / outcome.span.as_secs_f64() * span.as_secs_f64() / arrived,
        ),
        duplicates: sum("duplicates"),
    }
}

/// How much faster than samples have travelled a second try writes them.
const OVER: f64 = 1.1;
/// Items that nobody reads.
const IDLE_ITEMS: usize = 100;
const BEFORE_CUT: Duration = Duration::from_millis(500);
/// Who has not come back by then does not.
const AFTER_CUT: Duration = Duration::from_secs(5);
const FAILURES_MAX: usize = 3;
