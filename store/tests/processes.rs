//! Real processes around one daemon: hand-over, death, restart, forks, waiting.
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

use std::thread;
use std::time::Duration;

use ddx_store::server::Event;
use ddx_store::{
    Cursor, Error, From, ItemEntry, Missed, Origin, Quotas, ReaderOptions, Refusal, Schema, Store,
    Taken, WriterOptions, wait_any,
};
use ddx_wire::{Contract, Epoch, HostName, Pattern, Seq, Time, WriterState};
use rig::{Daemon, Dir, LONG, NONE, Process};

/// The other processes of these tests.
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
        "writer" => write_forever(&rig::open(&socket)),
        "reader" => read_forever(&rig::open(&socket)),
        "parent" => write_and_fork(&rig::open(&socket)),
        other => panic!("no role {other}"),
    }
}

fn write_forever(store: &Store) {
    let mut writer = store.writer::<u64>("n").unwrap();
    for value in 1.. {
        writer.write(&value).unwrap();
        if value == 1 {
            println!("!writing");
        }
        thread::sleep(Duration::from_millis(1));
    }
}

/// Leaves a child that holds the connection open and says nothing.
fn write_and_fork(store: &Store) {
    let mut writer = store.writer::<u64>("n").unwrap();
    writer.write(&1).unwrap();
    #[expect(unsafe_code, reason = "nothing else forks")]
    // SAFETY: the child only sleeps, and ends by `_exit`.
    let child = unsafe { libc::fork() };
    if child == 0 {
        // Its test ends it long before.
        thread::sleep(LONG);
        #[expect(unsafe_code, reason = "the child must not run the harness's exit")]
        // SAFETY: ends the child at once.
        unsafe {
            libc::_exit(0)
        };
    }
    println!("!forked {child}");
    loop {
        thread::park();
    }
}

fn read_forever(store: &Store) {
    let mut reader = store.reader::<u64>("n").unwrap();
    println!("!reading");
    loop {
        if let Some(sample) = reader.next(LONG).unwrap() {
            println!("!value {} {}", sample.value, sample.meta.epoch.0);
        }
    }
}

fn daemon() -> Daemon {
    Daemon::start(Quotas::default())
}

fn entry(store: &Store, name: &str) -> Option<ItemEntry> {
    let all = store.list(&Pattern::everything()).unwrap();
    all.into_iter().find(|entry| entry.name.as_str() == name)
}

#[test]
fn what_is_written_is_read() {
    let daemon = daemon();
    let store = daemon.store();
    let mut reader = store.reader::<u64>("n").unwrap();
    assert_eq!(reader.current().unwrap(), None);

    let mut writer = store.writer::<u64>("n").unwrap();
    assert_eq!(reader.next(NONE).unwrap(), None);
    writer.write(&7).unwrap();
    *writer.loan().unwrap() = 1000;
    let mut loan = writer.loan().unwrap();
    *loan = 8;
    loan.publish().unwrap();

    let first = reader.next(LONG).unwrap().unwrap();
    let second = reader.next_pinned(LONG).unwrap().unwrap();
    assert_eq!((first.value, first.meta.seq), (7, Seq(1)));
    assert_eq!((*second, second.meta().seq), (8, Seq(2)));
    assert_eq!(reader.next(NONE).unwrap(), None);
    assert_eq!(reader.current().unwrap().unwrap().value, 8);
}

#[test]
fn a_second_writer_is_told_who_holds_the_item() {
    let daemon = daemon();
    let first = daemon.store().writer::<u64>("n").unwrap();

    let refused = daemon.store().writer::<u64>("n").unwrap_err();
    let Error::Refused(Refusal::Held { pid, .. }) = refused else {
        panic!("{refused}");
    };
    assert_eq!(pid, std::process::id());

    drop(first);
    daemon.store().writer::<u64>("n").unwrap();
}

#[test]
fn a_dead_writers_item_is_free_at_once_although_its_child_holds_the_connection() {
    let daemon = daemon();
    let store = daemon.store();
    let mut first = Process::start("parent", &daemon.socket(), &[]);
    let child = first.wait_for("forked").parse().unwrap();
    let child = Child(rustix::process::Pid::from_raw(child).unwrap());

    first.kill();
    let second = store.writer::<u64>("n");

    second.unwrap().write(&2).unwrap();
    rustix::process::test_kill_process(child.0).expect("the child holds the connection");
}

/// A grandchild of the test, which ends with it.
struct Child(rustix::process::Pid);

impl Drop for Child {
    fn drop(&mut self) {
        rustix::process::kill_process(self.0, rustix::process::Signal::KILL).ok();
    }
}

#[test]
fn a_reader_learns_exactly_what_was_overwritten() {
    let daemon = daemon();
    let store = daemon.store();
    let options = WriterOptions {
        depth: 4,
        ..WriterOptions::default()
    };
    let mut writer = store.writer_with::<u64>("n", options).unwrap();
    let mut reader = store.reader::<u64>("n").unwrap();
    writer.write(&1).unwrap();
    let first = reader.next(LONG).unwrap().unwrap();
    for value in 2..=10 {
        writer.write(&value).unwrap();
    }

    let after = reader.after(&first.meta.cursor()).unwrap();
    let next = reader.next(LONG).unwrap().unwrap();

    let expected = Missed {
        overwritten: 5,
        ..Missed::default()
    };
    assert_eq!((after.missed, after.sample.unwrap().value), (expected, 7));
    assert_eq!((reader.missed(), next.value), (expected, 7));
    let rest: Vec<u64> = std::iter::from_fn(|| reader.next(NONE).unwrap())
        .map(|sample| sample.value)
        .collect();
    assert_eq!(rest, [8, 9, 10]);
}

#[test]
fn a_reader_may_begin_with_the_ring_or_with_the_newest() {
    let daemon = daemon();
    let store = daemon.store();
    let mut writer = store.writer::<u64>("n").unwrap();
    for value in 1..=3 {
        writer.write(&value).unwrap();
    }
    let options = ReaderOptions {
        from: From::Ring,
        ..ReaderOptions::default()
    };

    let mut all = store.reader_with::<u64>("n", options).unwrap();
    let mut newest = store.reader::<u64>("n").unwrap();

    assert_eq!(all.next(LONG).unwrap().unwrap().value, 1);
    assert_eq!(newest.next(LONG).unwrap().unwrap().value, 3);
    assert_eq!(newest.missed(), Missed::default());
}

#[test]
fn a_rate_gives_the_newest_at_each_turn_and_counts_the_others() {
    let daemon = daemon();
    let store = daemon.store();
    let mut writer = store.writer::<u64>("n").unwrap();
    let options = ReaderOptions {
        rate: Some(20.0),
        ..ReaderOptions::default()
    };
    let mut reader = store.reader_with::<u64>("n", options).unwrap();
    writer.write(&1).unwrap();
    let first = reader.next(LONG).unwrap().unwrap();
    for value in 2..=6 {
        writer.write(&value).unwrap();
    }

    assert_eq!(reader.next(NONE).unwrap(), None);
    let second = reader.next(LONG).unwrap().unwrap();

    assert_eq!((first.value, second.value), (1, 6));
    let expected = Missed {
        filtered: 4,
        ..Missed::default()
    };
    assert_eq!(reader.missed(), expected);
}

#[test]
fn a_blocked_reader_goes_on_when_its_writer_is_killed_and_replaced() {
    let daemon = daemon();
    let mut writer = Process::start("writer", &daemon.socket(), &[]);
    writer.wait_for("writing");
    let store = daemon.store();
    let mut reader = store.reader::<u64>("n").unwrap();
    let before = reader.next(LONG).unwrap().unwrap();
    let waiter = thread::spawn(move || {
        let mut last = before.clone();
        while last.meta.epoch == before.meta.epoch {
            let next = reader
                .next(LONG)
                .unwrap()
                .expect("a sample of the next writer");
            assert!(next.meta.epoch > last.meta.epoch || next.value > last.value);
            last = next;
        }
        (last, reader.missed())
    });

    writer.kill();
    rig::until("the lease is free", || {
        entry(&store, "host/n").unwrap().writer == Some(WriterState::Orphaned)
    });
    let mut second = store.writer::<u64>("n").unwrap();
    second.write(&1_000_000).unwrap();

    let (last, missed) = waiter.join().unwrap();
    assert_eq!((last.value, last.meta.seq), (1_000_000, Seq(1)));
    assert_eq!(missed.lost, 0);
}

#[test]
fn a_new_writer_begins_with_the_last_value() {
    let daemon = daemon();
    let store = daemon.store();
    let mut first = store.writer::<u64>("n").unwrap();
    first.write(&41).unwrap();
    first.write(&42).unwrap();
    drop(first);
    rig::until("orphaned", || {
        store
            .reader::<u64>("n")
            .unwrap()
            .current()
            .unwrap()
            .unwrap()
            .meta
            .orphaned
    });

    let _second = store.writer::<u64>("n").unwrap();

    let sample = store
        .reader::<u64>("n")
        .unwrap()
        .current()
        .unwrap()
        .unwrap();
    assert_eq!((sample.value, sample.meta.seq), (42, Seq(2)));
    assert!(!sample.meta.orphaned);
    assert!(sample.meta.segment > sample.meta.epoch);
}

#[test]
fn all_go_on_when_the_daemon_is_killed_and_started_again() {
    let dir = Dir::new();
    let socket = dir.socket();
    let mut first = Process::start("daemon", &socket, &[("DDX_ORDINAL", "1")]);
    first.wait_for("ready");
    let mut writer = Process::start("writer", &socket, &[]);
    writer.wait_for("writing");
    let mut reader = Process::start("reader", &socket, &[]);
    let value = |line: &str| -> u64 { line.split(' ').next().unwrap().parse().unwrap() };
    let before = value(&reader.wait_for("value"));

    first.kill();
    let without = value(&reader.wait_for("value"));
    let mut again = Process::start("daemon", &socket, &[("DDX_ORDINAL", "2")]);
    again.wait_for("ready");
    let store = rig::open(&socket);
    let mut late = store.reader::<u64>("n").unwrap();

    let sample = late.next(LONG).unwrap().expect("the writer has come back");
    assert!(before < without && without < sample.value);
    rig::until("the old reader has come back", || {
        entry(&store, "host/n").unwrap().readers == 2
    });
    assert_eq!(sample.meta.epoch, Epoch::new(1, 1));
    assert!(value(&reader.wait_for("value")) > without);
}

#[test]
fn a_value_that_was_put_stays_until_a_program_takes_over() {
    let daemon = daemon();
    let store = daemon.store();
    let schema = Schema::scalar("u64").unwrap();
    let mut reader = store.reader::<u64>("n").unwrap();

    store.put("n", &schema, &5_u64.to_le_bytes()).unwrap();
    assert_eq!(reader.next(LONG).unwrap().unwrap().value, 5);
    assert_eq!(
        entry(&store, "host/n").unwrap().writer,
        Some(WriterState::Daemon)
    );
    store.put("n", &schema, &6_u64.to_le_bytes()).unwrap();
    assert_eq!(reader.next(LONG).unwrap().unwrap().value, 6);

    let mut writer = store.writer::<u64>("n").unwrap();
    assert!(store.put("n", &schema, &7_u64.to_le_bytes()).is_err());
    writer.write(&8).unwrap();
    assert_eq!(reader.next(LONG).unwrap().unwrap().value, 8);
}

#[test]
fn a_removed_item_is_gone_for_its_readers_until_it_comes_back() {
    let daemon = daemon();
    let store = daemon.store();
    let mut reader = store.reader::<u64>("n").unwrap();
    let mut writer = store.writer::<u64>("n").unwrap();
    writer.write(&1).unwrap();
    assert!(matches!(
        store.remove("n"),
        Err(Error::Refused(Refusal::Held { .. }))
    ));
    assert_eq!(reader.current().unwrap().unwrap().value, 1);

    drop(writer);
    store.remove("n").unwrap();

    assert_eq!(reader.current().unwrap(), None);
    assert!(matches!(
        store.remove("n"),
        Err(Error::Refused(Refusal::Absent(_)))
    ));
    store.writer::<u64>("n").unwrap().write(&2).unwrap();
    assert_eq!(reader.next(LONG).unwrap().unwrap().value, 2);
}

#[test]
fn a_schema_mismatch_names_the_difference() {
    let daemon = daemon();
    let store = daemon.store();
    let _writer = store.writer::<u64>("n").unwrap();

    let refused = store.reader::<f32>("n").unwrap_err();

    assert!(
        matches!(refused, Error::Refused(Refusal::Schema { .. })),
        "{refused}"
    );
    assert!(refused.to_string().contains("u64"), "{refused}");
}

#[test]
fn a_reader_of_another_type_is_refused_when_the_item_appears() {
    let daemon = daemon();
    let store = daemon.store();
    let mut reader = store.reader::<f32>("n").unwrap();

    let _writer = store.writer::<u64>("n").unwrap();

    rig::until("refused", || reader.current().is_err());
}

#[test]
fn the_first_of_many_readers_to_have_something_is_named() {
    let daemon = daemon();
    let store = daemon.store();
    let mut a = store.reader::<u64>("a").unwrap();
    let mut b = store.reader::<f64>("b").unwrap();
    let writing = daemon.store();
    let writer = thread::spawn(move || {
        let mut writer = writing.writer::<f64>("b").unwrap();
        writer.write(&0.5).unwrap();
        writer
    });

    let found = wait_any(&mut [&mut a, &mut b], LONG).unwrap();

    assert_eq!(found, Some(1));
    assert_eq!(b.next(NONE).unwrap().unwrap().value, 0.5);
    let _writer = writer.join().unwrap();
    let timed_out = wait_any(&mut [&mut a, &mut b], Duration::from_millis(1)).unwrap();
    assert_eq!(timed_out, None);
}

#[test]
fn a_foreign_prefix_is_refused_with_a_hint() {
    let daemon = daemon();

    let refused = daemon
        .store()
        .writer::<u64>("other/n")
        .unwrap_err()
        .to_string();
    let admin = daemon.store().writer::<u64>("@/n").unwrap_err();

    assert!(refused.contains("hint: write `./other/n`"), "{refused}");
    assert!(matches!(admin, Error::Refused(Refusal::Administrative(_))));
}

#[test]
fn interest_in_a_foreign_name_is_told_and_its_mirror_is_read() {
    let daemon = daemon();
    let events = daemon.handle().events().unwrap();
    let inside = daemon.handle().connect().unwrap();
    let next = || events.recv_timeout(LONG).unwrap();
    let host = HostName::parse("host").unwrap();
    let name = ddx_wire::ItemName::parse("base/n", &host).unwrap();

    let options = ReaderOptions {
        rate: Some(5.0),
        ..ReaderOptions::default()
    };
    let store = daemon.store();
    let mut reader = store.reader_with::<u64>("base/n", options).unwrap();
    let slow = Contract::at_most_hz(5.0).unwrap();
    assert_eq!(
        next(),
        Event::Wanted {
            name: name.clone(),
            contract: slow
        }
    );
    let second = store.reader::<u64>("base/n").unwrap();
    assert_eq!(
        next(),
        Event::Wanted {
            name: name.clone(),
            contract: Contract::default()
        }
    );

    let schema = Schema::scalar("u64").unwrap();
    let mut mirror = inside
        .raw_writer("base/n", &schema, WriterOptions::default())
        .unwrap();
    let origin = Origin {
        epoch: Epoch(77),
        seq: Seq(9),
        filtered: 8,
        overwritten: 0,
        capture: Time(1),
        publish: Time(2),
        receive: Some(Time(3)),
        bound_ns: Some(4),
    };
    mirror.write_with(&5_u64.to_le_bytes(), &origin).unwrap();
    let sample = reader.next(LONG).unwrap().unwrap();
    assert_eq!(
        (sample.value, sample.meta.epoch, sample.meta.bound_ns),
        (5, Epoch(77), Some(4))
    );

    drop(second);
    assert_eq!(
        next(),
        Event::Wanted {
            name: name.clone(),
            contract: slow
        }
    );
    drop(reader);
    assert_eq!(next(), Event::Unwanted { name });
    drop(mirror);
    rig::until("the mirror is gone", || entry(&store, "base/n").is_none());
}

#[test]
fn own_items_are_announced_changed_and_withdrawn() {
    let daemon = daemon();
    let events = daemon.handle().events().unwrap();
    let next = || events.recv_timeout(LONG).unwrap();
    let store = daemon.store();

    let writer = store.writer::<u64>("n").unwrap();
    let Event::Announced {
        description,
        schema,
    } = next()
    else {
        panic!("not announced");
    };
    assert_eq!(description.writer, WriterState::Live);
    assert_eq!(schema, Schema::scalar("u64").unwrap().text());
    drop(writer);
    let Event::Changed { description } = next() else {
        panic!("not changed");
    };
    assert_eq!(description.writer, WriterState::Orphaned);
    store.remove("n").unwrap();
    assert!(matches!(next(), Event::Withdrawn { .. }));
}

#[test]
fn while_the_daemon_is_behind_with_news_programs_wait_and_its_own_calls_are_answered() {
    let daemon = daemon();
    let events = daemon.handle().events().unwrap();
    let (store, inside) = (daemon.store(), daemon.handle().connect().unwrap());
    // Three events each, which nobody takes: more than the channel holds.
    let turn = || {
        drop(inside.writer::<u64>("n").unwrap());
        inside.remove("n").unwrap();
    };
    (0..400).for_each(|_| turn());

    thread::scope(|scope| {
        let program = scope.spawn(|| store.writer::<u64>("p").map(drop));
        (0..400).for_each(|_| turn());
        assert!(!program.is_finished(), "it was served before its turn");

        let next = || events.recv_timeout(LONG).unwrap();
        let is_p = |event: &Event| matches!(event, Event::Announced { description, .. } if description.name.as_str() == "host/p");
        let before = (0..).take_while(|_| !is_p(&next())).count();
        assert!(before >= 3 * 800, "{before}");
        program.join().unwrap().unwrap();
    });
}

#[test]
fn a_guard_outlives_its_writer_and_its_segment() {
    let daemon = daemon();
    let store = daemon.store();
    let mut reader = store.reader::<[u64; 512]>("n").unwrap();
    let mut writer = store.writer::<[u64; 512]>("n").unwrap();
    writer.write(&[1; 512]).unwrap();
    let guard = reader.current_pinned().unwrap().unwrap();

    for value in 2..100 {
        writer.write(&[value; 512]).unwrap();
    }
    drop(writer);
    let mut second = store.writer::<[u64; 512]>("n").unwrap();
    second.write(&[7; 512]).unwrap();

    assert_eq!(reader.current().unwrap().unwrap().value, [7; 512]);
    assert!(guard.is_intact());
    assert_eq!(*guard, [1; 512]);
}

#[test]
fn a_reader_out_of_pins_is_told_so() {
    let daemon = daemon();
    let store = daemon.store();
    let mut writer = store.writer::<u64>("n").unwrap();
    let mut reader = store.reader::<u64>("n").unwrap();
    writer.write(&1).unwrap();
    let _first = reader.current_pinned().unwrap();
    let _second = reader.current_pinned().unwrap();

    assert!(matches!(reader.current_pinned(), Err(Error::NoPin(2))));

    let options = ReaderOptions {
        pins: 9,
        ..ReaderOptions::default()
    };
    let refused = store
        .reader_with::<u64>("n", options)
        .unwrap_err()
        .to_string();
    assert!(
        refused.contains("pins of this item: 9 wanted, 8 allowed"),
        "{refused}"
    );
}

#[test]
fn handles_are_of_no_use_after_a_fork() {
    let daemon = daemon();
    let store = daemon.store();
    let mut writer = store.writer::<u64>("n").unwrap();
    let mut reader = store.reader::<u64>("n").unwrap();
    writer.write(&1).unwrap();

    #[expect(unsafe_code, reason = "nothing else forks")]
    // SAFETY: the child uses only handles that check for the fork first, and ends by `_exit`.
    let child = unsafe { libc::fork() };
    if child == 0 {
        let refused = [
            matches!(writer.write(&2), Err(Error::Forked)),
            matches!(reader.current(), Err(Error::Forked)),
            matches!(reader.next(LONG), Err(Error::Forked)),
            matches!(store.describe("n"), Err(Error::Forked)),
        ];
        drop((writer, reader));
        #[expect(unsafe_code, reason = "the child must not run the harness's exit")]
        // SAFETY: ends the child at once.
        unsafe {
            libc::_exit(i32::from(refused.contains(&false)))
        };
    }
    let pid = rustix::process::Pid::from_raw(child).unwrap();
    let (_, status) = rustix::process::waitpid(Some(pid), rustix::process::WaitOptions::empty())
        .unwrap()
        .unwrap();

    assert_eq!(status.exit_status(), Some(0));
    writer.write(&3).unwrap();
    assert_eq!(reader.current().unwrap().unwrap().value, 3);
    assert_eq!(store.describe("n").unwrap().readers.len(), 1);
}

#[test]
fn who_takes_samples_gets_small_ones_as_copies_and_large_ones_in_place() {
    let daemon = Daemon::start(Quotas::default());
    let store = daemon.store();
    let options = WriterOptions {
        capacity_bytes: Some(4_096),
        ..WriterOptions::default()
    };
    let schema = Schema::bytes();
    let mut writer = store.raw_writer("n", &schema, options).unwrap();
    let mut reader = store
        .raw_reader("n", None, ReaderOptions::default())
        .unwrap();
    let (small, large) = ([1; 64], [2; 4_096]);
    writer.write(&small).unwrap();
    writer.write(&large).unwrap();

    let mut payload = Vec::new();
    let first = reader.take_current(&mut payload).unwrap();
    assert!(matches!(&first, Some(Taken::Held(guard)) if *guard.bytes() == large));
    let after = reader.take_after(&Cursor::default(), &mut payload).unwrap();
    assert!(matches!(after, Some(Taken::Copied(meta)) if meta.pos == 1));
    assert_eq!(payload, small);
    writer.write(&small).unwrap();
    payload.clear();
    let next = reader.take_next(&mut payload, LONG).unwrap();
    assert!(matches!(next, Some(Taken::Copied(meta)) if meta.pos == 3));
    assert_eq!(payload, small);
}

#[test]
fn a_sample_that_is_filled_piece_by_piece_shows_when_it_is_whole() {
    let daemon = Daemon::start(Quotas::default());
    let store = daemon.store();
    let options = WriterOptions {
        depth: 2,
        capacity_bytes: Some(8),
        ..WriterOptions::default()
    };
    let schema = Schema::bytes();
    let mut writer = store.raw_writer("n", &schema, options).unwrap();
    let mut reader = store
        .raw_reader("n", None, ReaderOptions::default())
        .unwrap();
    let origin = |seq| Origin {
        epoch: Epoch(7),
        seq: Seq(seq),
        ..Origin::default()
    };
    let mut payload = Vec::new();
    // More often than there are slots: none is lost with what is given up.
    for round in 0..1_000 {
        writer.begin(8).unwrap();
        writer.fill(0, b"given up");
        writer.begin(8).unwrap();
        writer.fill(4, b"eful, and more");
        // Another sample may be written meanwhile.
        writer.write_with(b"early", &origin(2 * round + 1)).unwrap();
        reader.next_into(&mut payload, LONG).unwrap().unwrap();
        assert_eq!(payload, b"early");
        writer.fill(0, b"care");
        writer.fill(usize::MAX, b"nowhere");
        writer.finish(&origin(2 * round + 2));
        let meta = reader.next_into(&mut payload, LONG).unwrap().unwrap();
        assert_eq!(payload, b"careeful");
        assert_eq!((meta.epoch, meta.seq), (Epoch(7), Seq(2 * round + 2)));
    }
    writer.finish(&origin(9_999));
    assert!(writer.begin(9).is_err());
    writer.finish(&origin(9_999));
    assert!(
        reader
            .next_into(&mut payload, Duration::ZERO)
            .unwrap()
            .is_none()
    );
    assert_eq!(writer.forced(), 0);
}

#[test]
fn an_embedded_store_needs_no_socket() {
    let config = ddx_store::server::Config::new(HostName::parse("alone").unwrap());
    let (store, mut server) = Store::embedded(config).unwrap();
    let stop = std::sync::Arc::new(std::sync::atomic::AtomicBool::new(false));
    let stopped = std::sync::Arc::clone(&stop);
    let handle = server.handle();
    let thread = thread::spawn(move || server.run(&stopped));

    let mut writer = store.writer::<u64>("n").unwrap();
    let mut reader = store.reader::<u64>("alone/n").unwrap();
    writer.write(&3).unwrap();
    assert_eq!(reader.next(LONG).unwrap().unwrap().value, 3);

    stop.store(true, std::sync::atomic::Ordering::Relaxed);
    handle.wake();
    thread.join().unwrap().unwrap();
    writer.write(&4).unwrap();
    assert_eq!(reader.next(LONG).unwrap().unwrap().value, 4);
    assert_eq!(
        reader
            .after(&Cursor::default())
            .unwrap()
            .sample
            .unwrap()
            .value,
        3
    );
}
