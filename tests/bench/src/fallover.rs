//! How long samples stay away when one of two networks between two hosts dies.

use std::process::Command;
use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use ddx_rig::lab::{self, Lab};
use ddx_store::{Reader, Store};

use crate::bench::Bench;
use crate::floor::WORDS;
use crate::network::{PATIENCE, play, start_daemons};
use crate::programs::figures;
use crate::stats::median;
use crate::table::Row;

/// Until both paths are measured and shown.
const SETTLE: Duration = Duration::from_secs(3);
/// Longer than any fall-over.
const WATCH: Duration = Duration::from_secs(4);

/// `fallover`: the longest pause between two samples while a network falls silent, or an interface goes down.
pub(crate) fn fallover(bench: &mut Bench) -> Result<()> {
    for (what, first, second) in [
        (
            "one of two networks falls silent, longest pause of samples",
            "ip link set p1 nomaster",
            "ip link set secondp1 nomaster",
        ),
        (
            "an interface of the source goes down, longest pause of samples",
            "ip link set eth0 down",
            "ip link set eth1 down",
        ),
    ] {
        let mut pauses = Vec::new();
        for _ in 0..bench.scale(1, 9) {
            let Some(lab) = lab::require(&["a", "b"]) else {
                return Ok(());
            };
            for (host, address) in [("a", "10.78.0.1"), ("b", "10.78.0.2")] {
                lab.host(host).plug("eth1", "second")?;
                lab.host(host).shell(&format!(
                    "ip address add {address}/24 dev eth1; ip link set eth1 up"
                ))?;
            }
            let _daemons = start_daemons(&lab, &bench.programs, false)?;
            let _source = play(lab.host("a"), &bench.programs, &["source", "ddx", "stamp"])?;
            let reader = play(lab.host("b"), &bench.programs, &["pause", "a/stamp"])?;
            reader.wait_line(|line| line == "ready", PATIENCE)?;
            let script = if used(&lab, bench)?.starts_with("10.77.") {
                first
            } else {
                second
            };
            if script.contains("eth") {
                lab.host("a").shell(script)?;
            } else {
                lab.switch(script)?;
            }
            let line = reader.wait_line(|line| line.parse::<f64>().is_ok(), PATIENCE)?;
            pauses.extend(figures::<f64>(&line));
        }
        let longest = pauses.iter().copied().fold(0.0, f64::max);
        for (quantile, pause) in [("median", median(pauses.into_iter())), ("worst", longest)] {
            bench.table.push(Row {
                what: format!("{what}, {quantile}"),
                unit: "ms",
                ddx: pause / 1e6,
                floor: None,
                peer: None,
                budget: "1000 ms",
            });
        }
    }
    Ok(())
}

/// The address to which `a` sends what `b` reads.
fn used(lab: &Lab, bench: &Bench) -> Result<String> {
    let mut command = Command::new(&bench.programs.ddx);
    let listed = lab
        .host("a")
        .exec(command.args(["--json", "host", "ls"]))?
        .stdout;
    let entry: serde_json::Value = serde_json::from_str(listed.trim()).context(listed.clone())?;
    let addr = entry["addr"].as_str().context(listed)?;
    Ok(addr.to_owned())
}

/// Reads an item, and tells the longest time between two of its samples, nanoseconds.
pub(crate) fn pause(name: &str) -> Result<()> {
    let store = Store::open()?;
    let mut reader: Reader<[u64; WORDS]> = store.reader(name)?;
    let mut next = || -> Result<Instant> {
        let sample = reader.next(PATIENCE)?;
        sample.context("no value").map(|_sample| Instant::now())
    };
    let mut last = next()?;
    let settled = last + SETTLE;
    while last < settled {
        last = next()?;
    }
    println!("ready");
    let (end, mut longest) = (last + WATCH, Duration::ZERO);
    while last < end {
        let arrived = next()?;
        longest = longest.max(arrived - last);
        last = arrived;
    }
    println!("{}", longest.as_nanos());
    Ok(())
}
