//! The programs of one contender at work in a lab of their own.

use std::fs;
use std::process::Command;
use std::thread;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail};
use ddx_rig::lab::{self, Counters, Host, Lab, Loss, Process};
use serde_json::Value;

use crate::PUBLISHER;
use crate::contender::{Build, Contender};
use crate::program::{nanos, now_ns, sleep_until};

/// A publisher, its subscribers, and the daemons that they need. Dropped, all end.
pub(crate) struct Session {
    publisher: Process,
    subscribers: Vec<Process>,
    daemons: Vec<Process>,
    pub(crate) lab: Lab,
    /// Whether what was sent before may still be on its way.
    pub(crate) is_behind: bool,
    names: Vec<String>,
    next_run: u32,
}

/// What programs open.
pub(crate) struct Opening<'a> {
    pub(crate) subscribers: usize,
    /// Items of the publisher and of each subscriber.
    pub(crate) items: [usize; 2],
    pub(crate) sizes: &'a [usize],
}

/// What programs are told to send, and when it counts.
#[derive(Clone, Copy)]
pub(crate) struct Order {
    pub(crate) size: usize,
    /// Samples a second; none is without pause.
    pub(crate) rate: Option<f64>,
    pub(crate) warm: Duration,
    pub(crate) span: Duration,
    pub(crate) grace: Duration,
}

/// What came of an order.
pub(crate) struct Outcome {
    /// The publisher's answer, and that of each subscriber.
    pub(crate) publisher: Value,
    pub(crate) subscribers: Vec<Value>,
    /// What all programs and daemons have had of the processors.
    pub(crate) cpu_ns: f64,
    /// Bytes that all hosts have put on their links.
    pub(crate) wire_bytes: u64,
    /// When counting began, which is within a few milliseconds of what was ordered.
    pub(crate) span: Duration,
}

impl Session {
    /// Starts everything at once; none where no lab can be had.
    pub(crate) fn start(
        contender: &Contender,
        build: &Build,
        opening: &Opening<'_>,
    ) -> Result<Option<Self>> {
        let names: Vec<String> = (0..=opening.subscribers).map(host_name).collect();
        let name_refs: Vec<&str> = names.iter().map(String::as_str).collect();
        let Some(lab) = lab::require(&name_refs) else {
            return Ok(None);
        };
        for host in lab.hosts() {
            host.shell(IP_FRAGMENTS)?;
        }
        let mut daemons = Vec::new();
        if contender.has_daemon {
            let key = Command::new(&build.ddx).args(["key", "new"]).output()?;
            let key = String::from_utf8(key.stdout)?;
            for host in lab.hosts() {
                host.shell(&format!("echo {} >{KEY}", key.trim()))?;
            }
            for host in lab.hosts() {
                let mut daemon = Command::new(&build.ddx);
                daemon.args(["up", "--key", KEY]).env("RUST_LOG", "warn");
                daemon.env("DDX_SPIN", contender.spins.to_string());
                daemons.push(host.spawn(&daemon)?);
            }
        }
        let addresses: Vec<String> = lab.hosts().map(|host| host.address().to_string()).collect();
        let start = |host: Host<'_>, role: &str, items: usize| {
            let sizes: Vec<String> = opening.sizes.iter().map(usize::to_string).collect();
            let mut command = contender.command(build, role);
            command
                .args(["--items", &items.to_string()])
                .args(["--sizes", &sizes.join(",")])
                .args(["--own", &host.address().to_string()])
                .args(["--publisher", &addresses[0]])
                .args(["--subscribers", &addresses[1..].join(",")]);
            host.spawn(&command)
        };
        let publisher = start(lab.host(PUBLISHER), "pub", opening.items[0])?;
        let subscribers = lab
            .hosts()
            .skip(1)
            .map(|host| start(host, "sub", opening.items[1]))
            .collect::<Result<_, _>>()?;
        Ok(Some(Self {
            publisher,
            subscribers,
            daemons,
            lab,
            is_behind: false,
            names,
            next_run: 1,
        }))
    }

    /// Publishes until each subscriber has had a sample; returns how long after the start of the last program the last one
    /// had its first.
    pub(crate) fn wait_first(&mut self, size: usize) -> Result<Duration> {
        let order = Order {
            size,
            rate: Some(FIRST_RATE),
            warm: Duration::ZERO,
            span: Duration::from_millis(200),
            grace: Duration::ZERO,
        };
        let until = Instant::now() + PATIENCE;
        let mut firsts: Vec<Option<u64>> = vec![None; self.subscribers.len()];
        while firsts.iter().any(Option::is_none) {
            if Instant::now() > until {
                let missing = firsts.iter().filter(|first| first.is_none()).count();
                bail!(
                    "{missing} subscribers without a sample within {PATIENCE:?}\n{}",
                    self.errors()
                );
            }
            let run = self.publish(&order)?;
            answer(&self.publisher, &format!("{{\"run\":{run},"), PATIENCE)?;
            for (first, subscriber) in firsts.iter_mut().zip(&self.subscribers) {
                *first = said(subscriber, "first_ns");
            }
        }
        let programs = std::iter::once(&self.publisher).chain(&self.subscribers);
        let started = programs.filter_map(|program| said(program, "started_ns"));
        let first = firsts.into_iter().flatten().max().unwrap_or(0);
        Ok(Duration::from_nanos(
            first.saturating_sub(started.max().unwrap_or(first)),
        ))
    }

    /// Waits until all programs have opened what they should.
    pub(crate) fn wait_ready(&self) -> Result<()> {
        for program in std::iter::once(&self.publisher).chain(&self.subscribers) {
            if said(program, "ready_ns").is_none() {
                answer(program, "{\"ready_ns\":", PATIENCE)?;
            }
        }
        Ok(())
    }

    /// Makes sure that each subscriber gets what is sent now, and no longer what was sent before.
    pub(crate) fn settle(&mut self, size: usize) -> Result<()> {
        let order = Order {
            size,
            rate: Some(SETTLE_RATE),
            warm: Duration::ZERO,
            span: Duration::from_millis(40),
            grace: Duration::from_millis(20),
        };
        let until = Instant::now() + SETTLE_PATIENCE;
        loop {
            let outcome = self.run(&order)?;
            let arrived = outcome.subscribers.iter().map(|sub| number(sub, "arrived"));
            if arrived.fold(f64::INFINITY, f64::min) > 0.0 {
                return Ok(());
            }
            if Instant::now() > until {
                bail!("nothing arrives any more\n{}", self.errors());
            }
        }
    }

    /// Sends as ordered and returns what came of it.
    pub(crate) fn run(&mut self, order: &Order) -> Result<Outcome> {
        self.run_while(order, |_| Ok(()))
    }

    /// The same, while something is done to the lab.
    pub(crate) fn run_while(
        &mut self,
        order: &Order,
        during: impl FnOnce(&Self) -> Result<()>,
    ) -> Result<Outcome> {
        let (run, line, from, until) = self.line(order);
        for program in self.subscribers.iter_mut().chain([&mut self.publisher]) {
            program.write_line(&line)?;
        }
        sleep_until(from);
        let (before, began) = (self.lab.counters()?, Instant::now());
        let cpu_before = self.daemons_cpu_ns()?;
        during(self)?;
        sleep_until(until);
        let cpu = self.daemons_cpu_ns()?.saturating_sub(cpu_before);
        let span = began.elapsed();
        let sent = self.lab.counters()?.since(&before);

        let start = format!("{{\"run\":{run},");
        let patience = order.grace + ANSWER_PATIENCE;
        let publisher = answer(&self.publisher, &start, patience).with_context(|| self.errors())?;
        let subscribers = self
            .subscribers
            .iter()
            .map(|subscriber| answer(subscriber, &start, patience))
            .collect::<Result<Vec<_>>>()?;
        let programs = std::iter::once(&publisher).chain(&subscribers);
        let of_programs: f64 = programs.map(|program| number(program, "cpu_ns")).sum();
        Ok(Outcome {
            cpu_ns: of_programs + cpu as f64,
            wire_bytes: self.wire_bytes(&sent),
            publisher,
            subscribers,
            span,
        })
    }

    /// Bytes that each host put on its link while something else goes on.
    pub(crate) fn watch(&self, span: Duration) -> Result<Vec<f64>> {
        let (before, began) = (self.lab.counters()?, Instant::now());
        thread::sleep(span);
        let sent = self.lab.counters()?.since(&before);
        let seconds = began.elapsed().as_secs_f64();
        let each = self.names.iter();
        Ok(each
            .map(|name| sent.link(name).from.bytes as f64 / seconds)
            .collect())
    }

    /// Tells the publisher alone to send; returns the run.
    pub(crate) fn publish(&mut self, order: &Order) -> Result<u32> {
        let (run, line, ..) = self.line(order);
        self.publisher.write_line(&line)?;
        Ok(run)
    }

    /// Sets the loss on the links of all subscribers.
    pub(crate) fn set_loss(&self, percent: u8) -> Result<()> {
        for host in self.lab.hosts().skip(1) {
            host.set_loss(Loss {
                from_percent: percent,
                to_percent: percent,
            })?;
        }
        Ok(())
    }

    fn line(&mut self, order: &Order) -> (u32, String, u64, u64) {
        let run = self.next_run;
        self.next_run += 1;
        let begin = now_ns() + nanos(LEAD);
        let from = begin + nanos(order.warm);
        let until = from + nanos(order.span);
        let report = until + nanos(order.grace);
        let rate = order.rate.unwrap_or(0.0);
        let line = format!(
            "run {run} {} {rate} {begin} {from} {until} {report}",
            order.size
        );
        (run, line, from, until)
    }

    fn wire_bytes(&self, sent: &Counters) -> u64 {
        let each = self.names.iter();
        each.map(|name| sent.link(name).from.bytes).sum()
    }

    /// What the daemons have had of the processors, from the kernel's books of each thread.
    fn daemons_cpu_ns(&mut self) -> Result<u64> {
        let mut total = 0;
        for daemon in &mut self.daemons {
            let tasks = format!("/proc/{}/task", daemon.pid()?);
            for task in fs::read_dir(&tasks).with_context(|| format!("reading `{tasks}`"))? {
                // A thread that ends meanwhile has no book any more.
                let book = fs::read_to_string(task?.path().join("schedstat")).unwrap_or_default();
                let ran = book.split_whitespace().next();
                total += ran.and_then(|ns| ns.parse::<u64>().ok()).unwrap_or(0);
            }
        }
        Ok(total)
    }

    /// What the programs complained of, for people.
    fn errors(&self) -> String {
        let programs = std::iter::once(&self.publisher)
            .chain(&self.subscribers)
            .chain(&self.daemons);
        let errors: Vec<String> = programs.map(Process::errors).collect();
        let errors = errors.concat();
        let from = errors.len().saturating_sub(ERRORS_MAX);
        errors.get(from..).unwrap_or(&errors).trim_end().to_owned()
    }
}

/// A number in an answer; 0 when it is not there.
pub(crate) fn number(answer: &Value, key: &str) -> f64 {
    answer[key].as_f64().unwrap_or(0.0)
}

/// Name of the publisher's host, or of a subscriber's.
fn host_name(index: usize) -> String {
    if index == 0 {
        PUBLISHER.to_owned()
    } else {
        format!("b{index}")
    }
}

/// Waits for a line that begins so.
fn answer(program: &Process, start: &str, patience: Duration) -> Result<Value> {
    let line = program.wait_line(|line| line.starts_with(start), patience)?;
    serde_json::from_str(&line).with_context(|| format!("`{line}` is no answer"))
}

/// A time that a program has said, if it has.
fn said(program: &Process, key: &str) -> Option<u64> {
    let start = format!("{{\"{key}\":");
    let output = program.output();
    let line = output.lines().find(|line| line.starts_with(&start))?;
    line[start.len()..].trim_end_matches('}').parse().ok()
}

/// What DDS and LCM send in IP fragments leaves the kernel with torsos when one is lost. By default they fill its 4 MiB in a
/// second, and then for half a minute no fragmented datagram gets through; users of DDS are told to raise this.
const IP_FRAGMENTS: &str = "echo 536870912 >/proc/sys/net/ipv4/ipfrag_high_thresh
                            echo 1 >/proc/sys/net/ipv4/ipfrag_time";
/// Where hosts keep the key.
const KEY: &str = "/run/ddx.key";
/// Longer than any contender takes to begin.
const PATIENCE: Duration = Duration::from_secs(20);
/// Programs have had an order by then.
const LEAD: Duration = Duration::from_millis(8);
const ANSWER_PATIENCE: Duration = Duration::from_secs(6);
/// A connection that has seen much loss may first wait out its timer.
const SETTLE_PATIENCE: Duration = Duration::from_secs(3);
const FIRST_RATE: f64 = 200.0;
const SETTLE_RATE: f64 = 500.0;
const ERRORS_MAX: usize = 2_000;
