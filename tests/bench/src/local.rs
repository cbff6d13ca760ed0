//! The lines of one writer and one reader on one host: writing, waking, polling, large values.

use std::process::Command;

use anyhow::{Context, Result};

use crate::bench::Bench;
use crate::contender::{Copies, CopiesReader, copies, loans};
use crate::floor::{CopyAndFences, FloorReader, FloorWriter, Shared, WORDS};
use crate::pair::{Cores, Side, cpu_ns_each, ping_pong};
use crate::programs::Daemon;
use crate::stats::{Contest, Turn, p50_p99};
use crate::table::Row;

const NS: (&str, f64) = ("ns", 1.0);
const US: (&str, f64) = ("us", 1e3);
/// Words of a value of 6 MiB, a frame of 1080p in three colours.
const LARGE_WORDS: usize = 6 * 1024 * 1024 / 8;
const PEER: &str = "iceoryx2";

/// `write`: a value of 64 bytes that nobody waits for.
pub(crate) fn write(bench: &mut Bench) -> Result<()> {
    let daemon = Daemon::start(&bench.programs)?;
    let store = daemon.store()?;
    let count: u32 = bench.scale(2_000, 200_000);
    let mut writer = Copies::open(&store, "write")?;
    let mut floor = CopyAndFences::default();
    let programs = &bench.programs;
    let mut turns: Vec<Turn<'_>> = Vec::new();
    let mut ours = || {
        Ok(vec![cpu_ns_each(count, |turn| {
            writer.write(&[turn; WORDS])
        })?])
    };
    let mut bare = || {
        Ok(vec![cpu_ns_each(count, |turn| {
            floor.write(turn, &[turn; WORDS]);
            Ok(())
        })?])
    };
    let mut peer = || programs.peer(&["write", &count.to_string()]);
    turns.push(&mut ours);
    turns.push(&mut bare);
    if programs.has_peer() {
        turns.push(&mut peer);
    }
    let contest = Contest::run(bench.rounds(), &mut turns)?;
    let peer = bench
        .programs
        .has_peer()
        .then_some(("iceoryx2 blackboard", 2));
    bench.table.contest(
        "write 64 B, nobody waiting".to_owned(),
        NS,
        (&contest, 0),
        Some(("copy + 2 fences", 1)),
        peer,
        "2x floor",
    );
    bench.table.push(Row {
        what: "of which the clock, read for the sample's time".to_owned(),
        unit: "ns",
        ddx: cpu_ns_each(count, |_| {
            std::hint::black_box(ddx_store::now());
            Ok(())
        })?,
        floor: None,
        peer: None,
        budget: "",
    });
    if let Some(calls) = system_calls_of_writes(bench, &daemon)? {
        bench.table.push(Row {
            what: "system calls in 1,000,000 such writes".to_owned(),
            unit: "calls",
            ddx: calls,
            floor: None,
            peer: None,
            budget: "0",
        });
    }
    Ok(())
}

/// How many system calls a million writes make: what `strace` counts for a run with them, less one without.
fn system_calls_of_writes(bench: &Bench, daemon: &Daemon) -> Result<Option<f64>> {
    let calls_in = |writes: &str| -> Result<Option<f64>> {
        let mut command = Command::new("strace");
        command
            .args(["-f", "-c", "-U", "calls", "--"])
            .arg(&bench.programs.own)
            .args(["role", "writes"]);
        command.arg(daemon.socket()).arg(writes);
        let Ok(output) = command.output() else {
            eprintln!("!!!! NOT PROVEN: system calls are counted by `strace`, which is missing");
            return Ok(None);
        };
        let report = String::from_utf8_lossy(&output.stderr).into_owned();
        let total = report
            .lines()
            .find_map(|line| line.trim().strip_suffix(" total")?.parse::<f64>().ok());
        Ok(Some(total.with_context(|| {
            format!("strace counted nothing: {report}")
        })?))
    };
    // The least of three: what a connection costs varies with how soon the daemon answers.
    let least_in = |writes: &str| -> Result<Option<f64>> {
        let calls: Option<Vec<f64>> = (0..3).map(|_| calls_in(writes)).collect::<Result<_>>()?;
        Ok(calls.and_then(|calls| calls.into_iter().min_by(f64::total_cmp)))
    };
    // The first run makes the item, whose last value the others begin with.
    calls_in("1")?;
    let without = least_in("1")?;
    let with = least_in("1000001")?;
    Ok(with.zip(without).map(|(with, without)| with - without))
}

/// `wake`: a blocked reader gets 64 bytes.
pub(crate) fn wake(bench: &mut Bench) -> Result<()> {
    for (cores, place) in [(Cores::One, "one core"), (Cores::Two, "two cores")] {
        converse(
            bench,
            "wake-up 64 B",
            (cores, place),
            true,
            ["1.25x floor", ""],
        )?;
    }
    Ok(())
}

/// `poll`: a reader that never sleeps gets 64 bytes, and what one look costs.
pub(crate) fn poll(bench: &mut Bench) -> Result<()> {
    converse(
        bench,
        "polled hand-over 64 B",
        (Cores::Two, "two cores"),
        false,
        ["1x iceoryx2", ""],
    )?;
    let daemon = Daemon::start(&bench.programs)?;
    let store = daemon.store()?;
    let count: u32 = bench.scale(2_000, 200_000);
    let mut writer = Copies::open(&store, "poll")?;
    writer.write(&[1; WORDS])?;
    let mut reader = CopiesReader::open(&store, "poll", false)?;
    let shared = Shared::anonymous()?;
    FloorWriter(shared).write(&[1; WORDS])?;
    let floor = FloorReader::new(shared, false);
    let programs = &bench.programs;
    let mut ours = || {
        Ok(vec![cpu_ns_each(count, |_| {
            std::hint::black_box(reader.value()?);
            Ok(())
        })?])
    };
    let mut bare = || {
        Ok(vec![cpu_ns_each(count, |_| {
            std::hint::black_box(floor.value());
            Ok(())
        })?])
    };
    let mut peer = || programs.peer(&["read", &count.to_string()]);
    let mut turns: Vec<Turn<'_>> = vec![&mut ours, &mut bare];
    if programs.has_peer() {
        turns.push(&mut peer);
    }
    let contest = Contest::run(bench.rounds(), &mut turns)?;
    let peer = bench
        .programs
        .has_peer()
        .then_some(("iceoryx2 blackboard", 2));
    bench.table.contest(
        "read 64 B, a copy of the newest".to_owned(),
        NS,
        (&contest, 0),
        Some(("bare seqlock", 1)),
        peer,
        "1x iceoryx2",
    );
    Ok(())
}

/// A conversation of ours, of the floor and of the peer: two rows, of the halves and of the slowest hundredth.
fn converse(
    bench: &mut Bench,
    what: &str,
    (cores, place): (Cores, &str),
    blocks: bool,
    budgets: [&'static str; 2],
) -> Result<()> {
    let daemon = Daemon::start(&bench.programs)?;
    let stores = [daemon.store()?, daemon.store()?];
    let count = bench.scale(200, 20_000);
    let [mut near, mut far] = copies(&stores, "converse", blocks)?;
    let [there, back] = [Shared::anonymous()?, Shared::anonymous()?];
    let mut floor_near = Side {
        to: FloorWriter(there),
        from: FloorReader::new(back, blocks),
    };
    let mut floor_far = Side {
        to: FloorWriter(back),
        from: FloorReader::new(there, blocks),
    };
    let programs = &bench.programs;
    let core_count = if cores == Cores::One { "1" } else { "2" };
    let verb = if blocks { "wake" } else { "poll" };
    let mut ours = || {
        Ok(p50_p99(ping_pong(
            count,
            cores,
            || Ok(near.lend()),
            || Ok(far.lend()),
        )?))
    };
    let mut bare = || {
        Ok(p50_p99(ping_pong(
            count,
            cores,
            || Ok(floor_near.lend()),
            || Ok(floor_far.lend()),
        )?))
    };
    let mut peer = || {
        Ok(p50_p99(programs.peer(&[
            verb,
            &count.to_string(),
            core_count,
        ])?))
    };
    let mut turns: Vec<Turn<'_>> = vec![&mut ours, &mut bare];
    if programs.has_peer() {
        turns.push(&mut peer);
    }
    let contest = Contest::run(bench.rounds(), &mut turns)?;
    let floor = if blocks { "bare futex" } else { "bare seqlock" };
    let peer = if blocks {
        "iceoryx2 pub/sub"
    } else {
        "iceoryx2 blackboard"
    };
    let peer = bench.programs.has_peer().then_some((peer, 2));
    for (figure, quantile) in ["p50", "p99"].into_iter().enumerate() {
        bench.table.contest(
            format!("{what}, {place}, {quantile}"),
            US,
            (&contest, figure),
            Some((floor, 1)),
            peer,
            budgets[figure],
        );
    }
    Ok(())
}

/// `large`: 6 MiB from a loan to a pinned read, beside 64 bytes by the same way.
pub(crate) fn large(bench: &mut Bench) -> Result<()> {
    let daemon = Daemon::start(&bench.programs)?;
    let stores = [daemon.store()?, daemon.store()?];
    let count = bench.scale(100, 5_000);
    let [mut near, mut far] = loans::<LARGE_WORDS>(&stores, "large")?;
    let [mut small_near, mut small_far] = loans::<WORDS>(&stores, "small")?;
    let programs = &bench.programs;
    let mut ours = || {
        Ok(p50_p99(ping_pong(
            count,
            Cores::One,
            || Ok(near.lend()),
            || Ok(far.lend()),
        )?))
    };
    let mut small = || {
        Ok(p50_p99(ping_pong(
            count,
            Cores::One,
            || Ok(small_near.lend()),
            || Ok(small_far.lend()),
        )?))
    };
    let mut peer = || {
        Ok(p50_p99(programs.peer(&[
            "large",
            &count.to_string(),
            "1",
        ])?))
    };
    let mut turns: Vec<Turn<'_>> = vec![&mut ours, &mut small];
    if programs.has_peer() {
        turns.push(&mut peer);
    }
    let contest = Contest::run(bench.rounds(), &mut turns)?;
    let peer = bench.programs.has_peer().then_some((PEER, 2));
    bench.table.contest(
        "6 MiB, loan to pinned read, one core, p50".to_owned(),
        US,
        (&contest, 0),
        Some(("the same with 64 B", 1)),
        peer,
        "flat: 1x",
    );
    Ok(())
}
