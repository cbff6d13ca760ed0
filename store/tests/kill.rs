//! `kill -9` at every named step, and a thousand times at random under load: nobody else notices, nothing is left behind.
#![expect(
    clippy::unwrap_used,
    clippy::print_stdout,
    reason = "a helper that cannot go on fails its test, and processes of a test talk by lines"
)]
#![expect(
    unreachable_pub,
    dead_code,
    reason = "what the tests of processes share is public in its own module, and each uses a part of it"
)]

#[path = "support/rig.rs"]
mod rig;

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::Duration;

use ddx_store::{Error, From, Quotas, ReaderOptions, Store, WriterOptions};
use ddx_wire::Pattern;
use rig::{Daemon, Dir, LONG, Process};

/// A value that shows when half of it is another one's.
type Checked = [u64; 128];

/// One test at a time: the storm counts what its process holds.
static ALONE: Mutex<()> = Mutex::new(());

const KILLS: u64 = 1000;
const AT_LEAST: u64 = 100;

#[test]
fn role() {
    let Some((role, socket)) = rig::role() else {
        return;
    };
    match role.as_str() {
        "daemon" => {
            let ordinal = std::env::var("DDX_ORDINAL").unwrap().parse().unwrap();
            rig::serve(&socket, ordinal);
        }
        "writer" => {
            let mut writer = rig::open(&socket).writer::<Checked>("n").unwrap();
            for value in 1.. {
                writer.write(&checked(value)).unwrap();
            }
        }
        "shallow" => {
            let store = rig::open(&socket);
            let mut writer = store.writer_with("n", shallow()).unwrap();
            for value in 1.. {
                writer.write(&checked(value)).unwrap();
            }
        }
        "reader" => {
            let mut reader = rig::open(&socket).reader::<Checked>("n").unwrap();
            loop {
                assert_whole(&reader.next_pinned(LONG).unwrap().unwrap());
                assert_whole(&reader.current().unwrap().unwrap().value);
            }
        }
        "publisher" => publish_forever(&rig::open(&socket)),
        "pinner" => pin_forever(&rig::open(&socket)),
        "registrar" => register_forever(&rig::open(&socket)),
        other => panic!("no role {other}"),
    }
}

fn shallow() -> WriterOptions {
    WriterOptions {
        depth: 1,
        ..WriterOptions::default()
    }
}

fn publish_forever(store: &Store) {
    println!("!go");
    let mut writer = take_over(store, "victim");
    for value in 1.. {
        let mut loan = writer.loan().unwrap();
        for _ in 0..50 {
            *loan = checked(value);
        }
        loan.publish().unwrap();
    }
}

fn pin_forever(store: &Store) {
    println!("!go");
    let mut reader = store.reader::<Checked>("load").unwrap();
    loop {
        let guard = reader.current_pinned().unwrap().unwrap();
        for _ in 0..20 {
            assert_whole(&guard);
        }
    }
}

fn register_forever(store: &Store) {
    println!("!go");
    loop {
        let _reader = store.reader::<Checked>("load").unwrap();
        let _writer = take_over(store, "registered");
    }
}

fn take_over(store: &Store, name: &str) -> ddx_store::Writer<Checked> {
    loop {
        match store.writer::<Checked>(name) {
            Ok(writer) => return writer,
            Err(Error::Refused(_)) => thread::yield_now(),
            Err(other) => panic!("{other}"),
        }
    }
}

fn checked(seed: u64) -> Checked {
    std::array::from_fn(|at| {
        let at = u64::try_from(at).unwrap_or_default();
        seed ^ at.wrapping_mul(0x9e37_79b9_7f4a_7c15)
    })
}

fn assert_whole(value: &Checked) {
    assert_eq!(*value, checked(value[0]), "torn");
}

/// Kills a process of `role` at `step`, and proves that it died there.
fn die_at(role: &str, step: &str, socket: &Path) {
    let mut victim = Process::start(role, socket, &[("DDX_CRASH_AT", step)]);
    assert_eq!(
        victim.wait_signal(),
        Some(9),
        "`{role}` never reached `{step}`"
    );
}

/// The item can be written and read as if nothing had happened.
fn assert_goes_on(store: &Store, name: &str, value: u64) {
    let mut writer = take_over(store, name);
    let mut reader = store.reader::<Checked>(name).unwrap();
    if let Some(last) = reader.current().unwrap() {
        assert_whole(&last.value);
    }
    writer.write(&checked(value)).unwrap();
    assert_eq!(reader.current().unwrap().unwrap().value, checked(value));
}

#[test]
fn a_writer_may_die_at_every_step() {
    let _alone = ALONE.lock().unwrap_or_else(PoisonError::into_inner);
    let daemon = Daemon::start(Quotas::default());
    let store = daemon.store();
    let mut watcher = store.reader::<Checked>("n").unwrap();
    let mut follower = store.reader::<Checked>("n").unwrap();
    let steps = [
        "register.granted",
        "register.made",
        "register.seeded",
        "register.committed",
        "register.kept",
        "publish.voided",
        "publish.loaned",
        "publish.filled",
        "publish.stamped:3",
        "publish.linked:3",
        "publish.head:3",
        "publish.done:3",
        "publish.stamped:500",
        "publish.linked:500",
        "publish.head:500",
    ];
    for (value, step) in (1_000_000..).zip(steps) {
        die_at("writer", step, &daemon.socket());
        assert_goes_on(&store, "n", value);
        rig::until("the follower gets the newest", || {
            let next = follower.next(LONG).unwrap().unwrap();
            assert_whole(&next.value);
            next.value == checked(value)
        });
        let next = watcher.current().unwrap().unwrap();
        assert_eq!(next.value, checked(value), "after {step}");
    }
}

#[test]
fn a_ring_that_was_left_between_two_words_is_read_to_its_end() {
    let _alone = ALONE.lock().unwrap_or_else(PoisonError::into_inner);
    for role in ["writer", "shallow"] {
        let daemon = Daemon::start(Quotas::default());
        let store = daemon.store();
        let options = ReaderOptions {
            from: From::Ring,
            ..ReaderOptions::default()
        };
        let mut late = store.reader_with::<Checked>("n", options).unwrap();
        let rate = Some(1000.0);
        let options = ReaderOptions {
            rate,
            ..ReaderOptions::default()
        };
        let mut limited = store.reader_with::<Checked>("n", options).unwrap();
        die_at(role, "publish.linked:100", &daemon.socket());

        let last = late.current().unwrap().unwrap();
        let limited = limited.next(LONG).unwrap().unwrap();
        let rest: Vec<_> =
            std::iter::from_fn(|| late.next(Duration::from_millis(5)).unwrap()).collect();
        assert!(last.meta.seq.0 >= 99 && limited == last, "{role}");
        assert!(rest.is_empty(), "{role}: the newest was seen");

        let _next = store.writer::<Checked>("n").unwrap();
        rig::until("seeded", || !late.current().unwrap().unwrap().meta.orphaned);
        assert_eq!(late.current().unwrap().unwrap().value, last.value, "{role}");
    }
}

#[test]
fn a_reader_may_die_at_every_step() {
    let _alone = ALONE.lock().unwrap_or_else(PoisonError::into_inner);
    let daemon = Daemon::start(Quotas::default());
    let store = daemon.store();
    let options = WriterOptions {
        depth: 2,
        max_readers: 2,
        pins: 0,
        ..WriterOptions::default()
    };
    let mut writer = store.writer_with::<Checked>("n", options).unwrap();
    writer.write(&checked(1)).unwrap();
    let steps = [
        "register.reader",
        "register.seated",
        "register.bound",
        "pin.set",
        "pin.checked",
        "pin.held",
        "pin.cleared",
    ];
    for step in steps {
        die_at("reader", step, &daemon.socket());
        rig::until("its cell is free", || {
            store.describe("n").unwrap().readers.is_empty()
        });
        let readers = [
            store.reader::<Checked>("n").unwrap(),
            store.reader("n").unwrap(),
        ];
        for value in 0..100 {
            writer.write(&checked(value)).unwrap();
        }
        drop(readers);
    }
}

#[test]
fn the_daemon_may_die_while_it_hands_over() {
    let _alone = ALONE.lock().unwrap_or_else(PoisonError::into_inner);
    let dir = Dir::new();
    let socket = dir.socket();
    // Told at the first commit of each of two writers.
    let env = [("DDX_ORDINAL", "1"), ("DDX_CRASH_AT", "handover.told:2")];
    let mut first = Process::start("daemon", &socket, &env);
    first.wait_for("ready");
    let store = rig::open(&socket);
    let mut reader = store.reader::<Checked>("n").unwrap();
    let mut writer = store.writer::<Checked>("n").unwrap();
    writer.write(&checked(1)).unwrap();
    drop(writer);

    assert!(store.writer::<Checked>("n").is_err());
    assert_eq!(first.wait_signal(), Some(9));
    assert_whole(&reader.current().unwrap().unwrap().value);
    let mut second = Process::start("daemon", &socket, &[("DDX_ORDINAL", "2")]);
    second.wait_for("ready");

    assert_goes_on(&store, "n", 2);
    rig::until("the old reader follows", || {
        reader.next(Duration::from_millis(10)).unwrap();
        reader.current().unwrap().unwrap().value == checked(2)
    });
}

/// What this process holds: open files, and mapped segments.
fn holdings() -> (usize, usize) {
    let files = fs::read_dir("/proc/self/fd").unwrap().count();
    let maps = fs::read_to_string("/proc/self/maps").unwrap();
    (files, maps.matches("memfd:ddx-").count())
}

#[test]
fn a_thousand_random_kills_under_load_leave_nothing_behind() {
    let _alone = ALONE.lock().unwrap_or_else(PoisonError::into_inner);
    let seed = u64::from(std::process::id());
    println!("seed {seed}");
    let before = holdings();
    let daemon = Daemon::start(Quotas::default());
    let store = daemon.store();
    let stop = Arc::new(AtomicBool::new(false));
    let load = thread::spawn({
        let mut writer = store.writer::<Checked>("load").unwrap();
        writer.write(&checked(0)).unwrap();
        let stop = Arc::clone(&stop);
        move || {
            let mut value = 0;
            while !stop.load(Ordering::Relaxed) {
                value += 1;
                writer.write(&checked(value)).unwrap();
                thread::sleep(Duration::from_micros(200));
            }
            (value, writer)
        }
    });
    let watchers: Vec<_> = ["load", "victim"]
        .into_iter()
        .map(|name| watch(&store, name, &stop))
        .collect();

    let left = AtomicU64::new(KILLS);
    let died = Mutex::new(BTreeMap::<String, u64>::new());
    thread::scope(|scope| {
        for worker in 0..2 {
            let (daemon, left, died) = (&daemon, &left, &died);
            scope.spawn(move || kill_until_done(daemon, seed + worker, left, died));
        }
    });
    stop.store(true, Ordering::Relaxed);
    let (written, writer) = load.join().unwrap();
    let seen: Vec<u64> = watchers
        .into_iter()
        .map(|watcher| watcher.join().unwrap())
        .collect();

    let died = died.into_inner().unwrap();
    let count = |phase: &[&str]| -> u64 {
        let counted = died
            .iter()
            .filter(|(step, _)| phase.contains(&step.as_str()));
        counted.map(|(_, count)| count).sum()
    };
    let loaned = count(&[
        "publish.voided",
        "publish.loaned",
        "publish.filled",
        "publish.stamped",
        "publish.linked",
    ]);
    let pinned = count(&["pin.set", "pin.checked", "pin.held"]);
    let registering = count(&[
        "register.granted",
        "register.made",
        "register.seeded",
        "register.committed",
        "register.reader",
        "register.seated",
    ]);
    println!(
        "{KILLS} kills: {loaned} between loan and publish, {pinned} inside a pin, {registering} inside registration"
    );
    println!("{written} samples under load, {seen:?} seen; {died:?}");
    assert!(loaned >= AT_LEAST && pinned >= AT_LEAST && registering >= AT_LEAST);
    assert!(seen.iter().all(|seen| *seen > 0));
    assert_eq!(writer.forced(), 0, "a dead reader's pin was in the way");

    assert_nothing_is_left(daemon, store, writer, before);
}

fn assert_nothing_is_left(
    daemon: Daemon,
    store: Store,
    writer: ddx_store::Writer<Checked>,
    before: (usize, usize),
) {
    rig::until("every cell is free", || {
        store.describe("load").unwrap().readers.is_empty()
    });
    let seats: Vec<_> = (0..64)
        .map(|_| store.reader::<Checked>("load").unwrap())
        .collect();
    drop((seats, writer));
    assert_goes_on(&store, "victim", 1);
    rig::until("the items are free", || {
        let all = store.list(&Pattern::everything()).unwrap();
        all.iter()
            .all(|item| store.remove(item.name.as_str()).is_ok())
    });
    assert!(store.list(&Pattern::everything()).unwrap().is_empty());
    let mut names: Vec<_> = fs::read_dir(daemon.socket().parent().unwrap())
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .filter(|name| !name.starts_with("trace"))
        .collect();
    names.sort();
    assert_eq!(names, ["host.lock", "host.sock"]);
    drop((store, daemon));
    assert_eq!(holdings(), before, "files, mapped segments");
}

/// Reads an item to the end of the test, and checks each sample.
fn watch(store: &Store, name: &str, stop: &Arc<AtomicBool>) -> thread::JoinHandle<u64> {
    let mut reader = store.reader::<Checked>(name).unwrap();
    let stop = Arc::clone(stop);
    thread::spawn(move || {
        let mut seen = 0;
        while !stop.load(Ordering::Relaxed) {
            if let Some(sample) = reader.next(Duration::from_millis(20)).unwrap() {
                assert_whole(&sample.value);
                seen += 1;
            }
        }
        seen
    })
}

fn kill_until_done(
    daemon: &Daemon,
    seed: u64,
    left: &AtomicU64,
    died: &Mutex<BTreeMap<String, u64>>,
) {
    let mut random = seed | 1;
    let trace = daemon.socket().with_file_name(format!("trace{seed}"));
    while left
        .fetch_update(Ordering::Relaxed, Ordering::Relaxed, |left| {
            left.checked_sub(1)
        })
        .is_ok()
    {
        random ^= random << 13;
        random ^= random >> 7;
        random ^= random << 17;
        // Registering takes a process half of its time, holding a loan or a pin nearly all of it.
        let roles = ["publisher", "pinner", "registrar", "registrar"];
        let role = roles[usize::try_from(random % 4).unwrap()];
        fs::write(&trace, [0; 32]).unwrap();
        let env = [("DDX_CRASH_TRACE", trace.to_str().unwrap())];
        let mut victim = Process::start(role, &daemon.socket(), &env);
        victim.wait_for("go");
        thread::sleep(Duration::from_micros(random / 4 % 8000));
        victim.kill();
        let step = fs::read(&trace).unwrap();
        let step = String::from_utf8_lossy(&step)
            .trim_end_matches('\0')
            .to_owned();
        *died.lock().unwrap().entry(step).or_default() += 1;
    }
}
