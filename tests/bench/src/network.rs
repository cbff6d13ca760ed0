//! The lines between hosts, in network namespaces on one switch.

use std::process::Command;
use std::thread;
use std::time::Duration;

use anyhow::Result;
use ddx_rig::lab::{self, Host, Lab, Process};

use crate::bench::Bench;
use crate::programs::{Programs, figures};
use crate::stats::{Contest, median, p50_p99};
use crate::table::Row;

const US: (&str, f64) = ("us", 1e3);
/// Where hosts keep the key, and what the relay shares.
const KEY: &str = "/run/ddx.key";
const SHARED: &str = "/dev/shm/relay";
const UDP_PORT: u16 = 7001;
const RELAY_PORT: u16 = 7002;
const ITEMS: usize = 100;
/// Longer than anything here takes.
pub(crate) const PATIENCE: Duration = Duration::from_secs(60);

/// `hosts`: 64 bytes from a writer on one host to a blocked reader on another.
pub(crate) fn hosts(bench: &mut Bench) -> Result<()> {
    between_hosts(bench, "host to host 64 B", false, "1.25x relay")
}

/// `spin`: the same with daemons that poll.
pub(crate) fn spin(bench: &mut Bench) -> Result<()> {
    between_hosts(bench, "host to host 64 B, --spin", true, "1.5x bare UDP")
}

fn between_hosts(bench: &mut Bench, what: &str, spin: bool, budget: &'static str) -> Result<()> {
    let Some(lab) = lab::require(&["a", "b"]) else {
        return Ok(());
    };
    let _daemons = start_daemons(&lab, &bench.programs, spin)?;
    let count = bench.scale(300, 2_000).to_string();
    let (a, b) = (lab.host("a"), lab.host("b"));
    let programs = &bench.programs;
    // The sink comes first: a datagram to a port that nobody has bound comes back to its source as an error.
    let flow = |from: &[&str], to: &[&str]| -> Result<Vec<f64>> {
        let sink = play(b, programs, &[&["sink", &count], to].concat())?;
        sink.wait_line(|line| line == "ready", PATIENCE)?;
        let _source = play(a, programs, &[&["source"], from].concat())?;
        sink.wait_line(|line| line == "end", PATIENCE)?;
        Ok(p50_p99(figures(&sink.output())))
    };
    let mut ours = || flow(&["ddx", "stamp"], &["ddx", "a/stamp"]);
    let mut relay = || {
        let relay_in = play(b, programs, &["relay-in", &RELAY_PORT.to_string(), SHARED])?;
        relay_in.wait_line(|line| line == "ready", PATIENCE)?;
        let _relay_out = play(
            a,
            programs,
            &[
                "relay-out",
                SHARED,
                &format!("{}:{RELAY_PORT}", b.address()),
            ],
        )?;
        flow(&["futex", SHARED], &["futex", SHARED])
    };
    let mut udp = || {
        let at = format!("{}:{UDP_PORT}", b.address());
        flow(&["udp", &at], &["udp", &at])
    };
    let rounds = bench.scale(1, 5);
    let contest = Contest::run(rounds, &mut [&mut ours, &mut relay, &mut udp])?;
    for (figure, quantile) in ["p50", "p99"].into_iter().enumerate() {
        bench.table.contest(
            format!("{what}, {quantile}"),
            US,
            (&contest, figure),
            Some(("bare relay", 1)),
            Some(("bare UDP", 2)),
            if figure == 0 { budget } else { "" },
        );
    }
    Ok(())
}

/// `idle`: what hosts say to one another while nobody reads on another host.
pub(crate) fn idle(bench: &mut Bench) -> Result<()> {
    let names: Vec<String> = (0..bench.scale(3, 10))
        .map(|host| format!("h{host}"))
        .collect();
    let names: Vec<&str> = names.iter().map(String::as_str).collect();
    for hosts in [&names[..2], &names[..]] {
        let Some(lab) = lab::require(hosts) else {
            return Ok(());
        };
        let _daemons = start_daemons(&lab, &bench.programs, false)?;
        let items = play(
            lab.host("h0"),
            &bench.programs,
            &["items", &ITEMS.to_string()],
        )?;
        items.wait_line(|line| line == "ready", PATIENCE)?;
        // Until all know all; what is measured then is what never ends.
        thread::sleep(bench.scale(Duration::from_secs(1), Duration::from_secs(10)));
        let before = lab.counters()?;
        let span = bench.scale(Duration::from_secs(1), Duration::from_secs(10));
        thread::sleep(span);
        let sent = lab.counters()?.since(&before);
        let each = hosts
            .iter()
            .map(|host| sent.link(host).from.bytes as f64 / span.as_secs_f64());
        let mean = each.sum::<f64>() / hosts.len() as f64;
        bench.table.push(Row {
            what: format!(
                "idle, {ITEMS} items on one of {} hosts, each host sends",
                hosts.len()
            ),
            unit: "B/s",
            ddx: mean,
            floor: None,
            peer: None,
            budget: "600 at 10 hosts",
        });
    }
    Ok(())
}

/// `cold`: the first value on another host when everything starts at once.
pub(crate) fn cold(bench: &mut Bench) -> Result<()> {
    let mut firsts = Vec::new();
    for _ in 0..bench.scale(1, 9) {
        let Some(lab) = lab::require(&["a", "b"]) else {
            return Ok(());
        };
        let (a, b) = (lab.host("a"), lab.host("b"));
        give_key(&lab, &bench.programs)?;
        let mut programs = Vec::new();
        for host in lab.hosts() {
            programs.push(start_daemon(host, &bench.programs, false)?);
        }
        programs.push(play(a, &bench.programs, &["source", "ddx", "stamp"])?);
        let first = play(b, &bench.programs, &["first", "a/stamp"])?;
        let line = first.wait_line(|line| line.parse::<f64>().is_ok(), PATIENCE)?;
        firsts.extend(figures::<f64>(&line));
    }
    bench.table.push(Row {
        what: "first sample after a cold start, from the reader's opening".to_owned(),
        unit: "ms",
        ddx: median(firsts.into_iter()) / 1e6,
        floor: None,
        peer: None,
        budget: "100 ms",
    });
    Ok(())
}

/// Gives all hosts one key.
fn give_key(lab: &Lab, programs: &Programs) -> Result<()> {
    let output = Command::new(&programs.ddx).args(["key", "new"]).output()?;
    let key = String::from_utf8(output.stdout)?;
    for host in lab.hosts() {
        host.shell(&format!("echo {} >{KEY}", key.trim()))?;
    }
    Ok(())
}

/// Starts a daemon on each host and waits until they serve.
pub(crate) fn start_daemons(lab: &Lab, programs: &Programs, spin: bool) -> Result<Vec<Process>> {
    give_key(lab, programs)?;
    let mut daemons = Vec::new();
    for host in lab.hosts() {
        daemons.push(start_daemon(host, programs, spin)?);
    }
    for daemon in &daemons {
        daemon.wait_line(|line| line.starts_with("ready"), PATIENCE)?;
    }
    Ok(daemons)
}

fn start_daemon(host: Host<'_>, programs: &Programs, spin: bool) -> Result<Process> {
    let mut command = Command::new(&programs.ddx);
    command
        .args(["up", "--key", KEY])
        .env("DDX_SPIN", if spin { "true" } else { "false" });
    Ok(host.spawn(&command)?)
}

pub(crate) fn play(host: Host<'_>, programs: &Programs, part: &[&str]) -> Result<Process> {
    Ok(host.spawn(Command::new(&programs.own).arg("role").args(part))?)
}
