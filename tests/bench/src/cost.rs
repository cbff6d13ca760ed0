//! What others cost on one host: readers their writer, and a daemon its host.

use anyhow::{Context, Result};
use ddx_store::Store;

use crate::bench::Bench;
use crate::contender::{Copies, CopiesReader};
use crate::floor::WORDS;
use crate::pair::cpu_ns_each;
use crate::programs::Daemon;
use crate::stats::Contest;
use crate::table::Row;

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
    let turn = |writer: &mut Copies| {
        Ok(vec![cpu_ns_each(count, |turn| {
            writer.write(&[turn; WORDS])
        })?])
    };
    let mut of_many = || turn(&mut many.0);
    let mut of_alone = || turn(&mut alone.0);
    let contest = Contest::run(bench.rounds(), &mut [&mut of_many, &mut of_alone])?;
    let mut of_eight = || turn(&mut eight.0);
    let contest_eight = Contest::run(
        bench.rounds(),
        &mut [&mut of_eight, &mut || turn(&mut alone.0)],
    )?;
    let mut of_stalled = || turn(&mut stalled);
    let contest_stalled = Contest::run(
        bench.rounds(),
        &mut [&mut of_stalled, &mut || turn(&mut alone.0)],
    )?;
    drop(held);
    for (what, contest) in [
        ("write 64 B, 8 readers open", &contest_eight),
        ("write 64 B, 32 readers open", &contest),
        (
            "write 64 B, one reader holds 2 samples for ever",
            &contest_stalled,
        ),
    ] {
        bench.table.contest(
            what.to_owned(),
            ("ns", 1.0),
            (contest, 0),
            Some(("1 reader", 1)),
            None,
            "no copy: 1x",
        );
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
    let maps = std::fs::read_to_string(format!("/proc/{}/smaps", daemon.pid()))
        .context("reading the daemon's maps")?;
    let (dirty, text) = private_dirty_and_text(&maps);
    for (what, bytes, budget) in [
        (
            "daemon with 100 items: private dirty + text",
            dirty + text,
            "10 MB",
        ),
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
            [_, rights, _, _, _, path] if rights.starts_with("r-xp") => {
                is_text = path.starts_with('/');
            }
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

        assert_eq!(
            private_dirty_and_text(maps),
            (24.0 * 1024.0, 100.0 * 1024.0)
        );
    }
}
