//! The lines of one host: writing, waking, polling, large values, many readers, memory.

use std::process::Command;

use anyhow::{Context, Result};
use ddx_store::Store;

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
    let mut ours = || Ok(vec![cpu_ns_each(count, |turn| writer.write(&[turn; WORDS]))?]);
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
    let peer = bench.programs.has_peer().then_some(("iceoryx2 blackboard", 2));
    bench.table.contest(
        "write 64 B, nobody waiting".to_owned(),
        NS,
        (&contest, 0),
        Some(("copy + 2 fences", 1)),
        peer,
        "2x floor",
    );
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
        command.args(["-f", "-c", "-U", "calls", "--"]).arg(&bench.programs.own).args(["role", "writes"]);
        command.arg(daemon.socket()).arg(writes);
        let Ok(output) = command.output() else {
            eprintln!("!!!! NOT PROVEN: system calls are counted by `strace`, which is missing");
            return Ok(None);
        };
        let report = String::from_utf8_lossy(&output.stderr).into_owned();
        let total = report.lines().filter_map(|line| line.trim().parse::<f64>().ok()).next_back();
        Ok(Some(total.with_context(|| format!("strace counted nothing: {report}"))?))
    };
    // The first run makes what the daemon keeps, so that the two that count do the same.
    calls_in("1")?;
    let without = calls_in("1")?;
    let with = calls_in("1000001")?;
    Ok(with.zip(without).map(|(with, without)| with - without))
}

/// `wake`: a blocked reader gets 64 bytes.
pub(crate) fn wake(bench: &mut Bench) -> Result<()> {
    for (cores, place) in [(Cores::One, "one core"), (Cores::Two, "two cores")] {
        converse(bench, "wake-up 64 B", (cores, place), true, ["1.25x floor", ""])?;
    }
    Ok(())
}

/// `poll`: a reader that never sleeps gets 64 bytes, and what one look costs.
pub(crate) fn poll(bench: &mut Bench) -> Result<()> {
    converse(bench, "polled hand-over 64 B", (Cores::Two, "two cores"), false, ["1x iceoryx2", ""])?;
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
    let peer = bench.programs.has_peer().then_some(("iceoryx2 blackboard", 2));
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
    let mut floor_near = Side { to: FloorWriter(there), from: FloorReader::new(back, blocks) };
    let mut floor_far = Side { to: FloorWriter(back), from: FloorReader::new(there, blocks) };
    let programs = &bench.programs;
    let core_count = if cores == Cores::One { "1" } else { "2" };
    let verb = if blocks { "wake" } else { "poll" };
    let mut ours = || Ok(p50_p99(ping_pong(count, cores, || near.lend(), || far.lend())?));
    let mut bare = || Ok(p50_p99(ping_pong(count, cores, || floor_near.lend(), || floor_far.lend())?));
    let mut peer = || Ok(p50_p99(programs.peer(&[verb, &count.to_string(), core_count])?));
    let mut turns: Vec<Turn<'_>> = vec![&mut ours, &mut bare];
    if programs.has_peer() {
        turns.push(&mut peer);
    }
    let contest = Contest::run(bench.rounds(), &mut turns)?;
    let floor = if blocks { "bare futex" } else { "bare seqlock" };
    let peer = if blocks { "iceoryx2 pub/sub" } else { "iceoryx2 blackboard" };
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
    let mut ours = || Ok(p50_p99(ping_pong(count, Cores::One, || near.lend(), || far.lend())?));
    let mut small = || Ok(p50_p99(ping_pong(count, Cores::One, || small_near.lend(), || small_far.lend())?));
    let mut peer = || Ok(p50_p99(programs.peer(&["large", &count.to_string(), "1"])?));
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

/// `readers`: what the writer pays for readers that look now and then, and for one that holds its samples for ever.
pub(crate) fn readers(bench: &mut Bench) -> Result<()> {
    let daemon = Daemon::start(&bench.programs)?;
    let store = daemon.store()?;
    let count: u32 = bench.scale(2_000, 200_000);
    let mut alone = with_readers(&store, "readers-1", 1)?;
    let mut eight = with_readers(&store, "readers-8", 8)?;
    let mut many = with_readers(&store, "readers-32", 32)?;
    let mut stalled = Copies::open(&store, "stalled")?;
    stalled.write(&[0; WORDS])?;
    let mut holder = store.reader::<[u64; WORDS]>("stalled")?;
    let held = [holder.current_pinned()?, holder.current_pinned()?];
    let turn = |writer: &mut Copies| Ok(vec![cpu_ns_each(count, |turn| writer.write(&[turn; WORDS]))?]);
    let mut of_many = || turn(&mut many.0);
    let mut of_alone = || turn(&mut alone.0);
    let contest = Contest::run(bench.rounds(), &mut [&mut of_many, &mut of_alone])?;
    let mut of_eight = || turn(&mut eight.0);
    let contest_eight = Contest::run(bench.rounds(), &mut [&mut of_eight, &mut || turn(&mut alone.0)])?;
    let mut of_stalled = || turn(&mut stalled);
    let contest_stalled = Contest::run(bench.rounds(), &mut [&mut of_stalled, &mut || turn(&mut alone.0)])?;
    drop(held);
    for (what, contest) in [
        ("write 64 B, 8 readers open", &contest_eight),
        ("write 64 B, 32 readers open", &contest),
        ("write 64 B, one reader holds 2 samples for ever", &contest_stalled),
    ] {
        bench.table.contest(what.to_owned(), NS, (contest, 0), Some(("1 reader", 1)), None, "no copy: 1x");
    }
    Ok(())
}

/// A writer and its readers, each of which has read once.
fn with_readers(store: &Store, name: &str, count: usize) -> Result<(Copies, Vec<CopiesReader>)> {
    let mut writer = Copies::open(store, name)?;
    writer.write(&[0; WORDS])?;
    let mut readers = Vec::new();
    for _ in 0..count {
        let mut reader = CopiesReader::open(store, name, false)?;
        reader.value()?;
        readers.push(reader);
    }
    Ok((writer, readers))
}

/// `memory`: what a daemon takes for itself once it serves 100 items.
pub(crate) fn memory(bench: &mut Bench) -> Result<()> {
    const ITEMS: usize = 100;
    let daemon = Daemon::start(&bench.programs)?;
    let store = daemon.store()?;
    let mut writers = Vec::new();
    for item in 0..ITEMS {
        let mut writer = Copies::open(&store, &format!("memory-{item}"))?;
        writer.write(&[0; WORDS])?;
        writers.push(writer);
    }
    let maps = std::fs::read_to_string(format!("/proc/{}/smaps", daemon.pid())).context("reading the daemon's maps")?;
    let (dirty, text) = private_dirty_and_text(&maps);
    for (what, bytes, budget) in [
        ("daemon with 100 items: private dirty + text", dirty + text, "10 MB"),
        ("of which text", text, ""),
    ] {
        bench.table.push(Row {
            what: what.to_owned(),
            unit: "MB",
            ddx: bytes / 1e6,
            floor: None,
            peer: None,
            budget,
        });
    }
    Ok(())
}

/// Sums the private dirty bytes of all maps, and the resident ones of executable files.
fn private_dirty_and_text(maps: &str) -> (f64, f64) {
    let (mut dirty, mut text, mut is_text) = (0.0, 0.0, false);
    for line in maps.lines() {
        let words: Vec<&str> = line.split_whitespace().collect();
        match words.as_slice() {
            [_, rights, _, _, _, path] if rights.starts_with("r-xp") => is_text = path.starts_with('/'),
            [_, rights, ..] if rights.len() == 4 && rights.ends_with(['p', 's']) => is_text = false,
            ["Private_Dirty:", kib, "kB"] => dirty += kib.parse().unwrap_or(0.0) * 1024.0,
            ["Rss:", kib, "kB"] if is_text => text += kib.parse().unwrap_or(0.0) * 1024.0,
            _ => {}
        }
    }
    (dirty, text)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn text_is_what_is_resident_of_executable_files_and_dirty_is_summed_over_all() {
        let maps = "00400000-00500000 r--p 00000000 fe:00 12 /usr/bin/ddx\nRss: 8 kB\nPrivate_Dirty: 0 kB\n\
                    00500000-00600000 r-xp 00000000 fe:00 12 /usr/bin/ddx\nRss: 100 kB\nPrivate_Dirty: 4 kB\n\
                    00600000-00700000 rw-p 00000000 00:00 0\nRss: 50 kB\nPrivate_Dirty: 20 kB\n\
                    7ffd0000-7ffd1000 r-xp 00000000 00:00 0 [vdso]\nRss: 4 kB\nPrivate_Dirty: 0 kB\n";

        assert_eq!(private_dirty_and_text(maps), (24.0 * 1024.0, 100.0 * 1024.0));
    }
}
