//! Nothing is sent until somebody reads, then once, and no longer than somebody reads. The switch is the witness.

use std::time::{Duration, Instant};

use crate::program::{Order, Program};
use crate::site::{PATIENCE, SAMPLES, Site, report};

#[test]
fn nothing_is_sent_while_nobody_reads() {
    let Some(site) = Site::new(&["robot1", "base"]) else {
        return;
    };
    let mut robot = site.program("robot1");
    let mut local = site.program("robot1");
    robot.open_writers("robot1/imu", 4);
    local.open_readers("robot1/imu", 4);
    site.wait_listed("base", "robot1/imu/3", true);
    let before = site.counters();

    robot.ask(&write(1, 1_000, 1_000));

    // A reader on the writer's own host had everything.
    local.read(1_000, PATIENCE);
    let counted = site.counters().since(&before);
    assert_eq!(counted.udp_total(SAMPLES).from.packets, 0);
    assert!(
        counted.link("robot1").from.packets > 0,
        "the hosts did talk: {counted:#?}"
    );
}

#[test]
fn each_sample_is_sent_once_however_many_hosts_read_it() {
    let readers = ["base1", "base2", "base3", "base4"];
    let Some(site) = Site::new(&["robot1", "base1", "base2", "base3", "base4", "idle"]) else {
        return;
    };
    let mut robot = site.program("robot1");
    robot.open_writers("robot1/imu", 1);
    robot.write(1);
    site.wait_listed("base4", "robot1/imu/0", true);
    let mut programs: Vec<Program> = Vec::new();
    let before_all = site.counters();
    let mut value = 1;
    for (count, path) in [(1, "unicast"), (2, "multicast"), (4, "multicast")] {
        while programs.len() < count {
            let mut program = site.program(readers[programs.len()]);
            program.open_readers("robot1/imu", 1);
            programs.push(program);
        }
        // Samples must flow for a group to be confirmed.
        robot.tell(&write(value + 1, 200, 5_000));
        value += 200;
        robot.answer(PATIENCE);
        site.wait_path("robot1", "robot1/imu", path, count);
        let mut left_out = 0;
        for program in &mut programs {
            let (_, books) = program.read(value, PATIENCE);
            left_out = books[0].filtered;
        }
        site.wait_quiet("robot1");
        let before = site.counters();

        robot.ask(&write(value + 1, SAMPLE_COUNT, 5_000));
        value += SAMPLE_COUNT;

        let mut sent = SAMPLE_COUNT;
        for program in &mut programs {
            let (_, books) = program.read(value, PATIENCE);
            assert_eq!(books[0].lost, 0, "{books:?}");
            // On a busy machine the ring may overtake the daemon: what it never saw it does not send.
            sent = SAMPLE_COUNT + left_out - books[0].filtered;
        }
        let counted = site.counters().since(&before);
        let from = |host| counted.udp(SAMPLES, host).from.packets;
        assert!(sent > SAMPLE_COUNT / 2, "{sent} is too few to tell");
        assert_eq!(from("robot1"), sent, "{count} hosts read by {path}");
        assert_eq!(
            counted.udp_total(SAMPLES).from.packets,
            sent,
            "and nobody else sent anything"
        );
        for reader in &readers[..count] {
            assert_eq!(counted.udp(SAMPLES, reader).to.packets, sent, "to {reader}");
        }
    }
    let counted = site.counters().since(&before_all);
    assert_eq!(
        counted.udp(SAMPLES, "idle").to.packets,
        0,
        "the switch keeps samples from those who did not ask"
    );
}

#[test]
fn sending_stops_at_once_when_the_last_reader_closes_or_is_killed() {
    let Some(site) = Site::new(&["robot1", "base"]) else {
        return;
    };
    let mut robot = site.program("robot1");
    robot.open_writers("robot1/imu", 1);
    robot.write(1);
    site.wait_listed("base", "robot1/imu/0", true);
    let mut reader = site.program("base");
    robot.tell(&write(2, 4_000, 1_000));

    reader.open_readers("robot1/imu", 1);
    reader.read(500, PATIENCE);
    let closed = Instant::now();
    reader.ask(&Order::CloseReaders);
    assert_stops(&site, &robot, "a close", closed, STOP_WITHIN);

    reader.open_readers("robot1/imu", 1);
    reader.read(2_000, PATIENCE);
    let killed = Instant::now();
    reader.kill();
    assert_stops(&site, &robot, "a kill", killed, STOP_WITHIN);
}

#[test]
fn sending_stops_within_the_lease_when_the_reading_host_vanishes() {
    let Some(mut site) = Site::new(&["robot1", "base"]) else {
        return;
    };
    let mut robot = site.program("robot1");
    robot.open_writers("robot1/imu", 1);
    robot.write(1);
    site.wait_listed("base", "robot1/imu/0", true);
    let mut reader = site.program("base");
    reader.open_readers("robot1/imu", 1);
    reader.read(1, PATIENCE);
    robot.tell(&write(2, 12_000, 1_000));
    reader.read(100, PATIENCE);

    let cut = Instant::now();
    site.lab.host("base").cut().unwrap();
    // The last renewal may have been sent just before.
    assert_stops(&site, &robot, "a cut", cut, LEASE + STOP_WITHIN);

    site.lab.host("base").heal().unwrap();
    let (_, books) = reader.read(6_000, PATIENCE);
    assert_eq!(books[0].backwards, 0, "{books:?}");
    let killed = Instant::now();
    site.kill("base");
    assert_stops(
        &site,
        &robot,
        "a kill of the daemon",
        killed,
        LEASE + STOP_WITHIN,
    );
}

/// Checks that `robot1` soon sends nothing more, although it goes on writing.
#[track_caller]
fn assert_stops(site: &Site, robot: &Program, event: &str, since: Instant, within: Duration) {
    let stopped = site.sends_until("robot1", since, QUIET);
    report(&format!("sending stopped after {event}"), stopped);
    assert!(robot.is_busy(), "the writer ended too early to tell");
    assert!(stopped < within, "after {event}: {stopped:?}");
}

/// Values of a size that no two share a datagram.
fn write(first: u64, count: u64, period_us: u64) -> Order {
    Order::Write {
        first,
        count,
        period_us,
        bytes: 1_000,
    }
}

const SAMPLE_COUNT: u64 = 300;
/// As promised.
const STOP_WITHIN: Duration = Duration::from_millis(100);
const LEASE: Duration = Duration::from_secs(3);
/// Samples come each millisecond: silence for so long is the end.
const QUIET: Duration = Duration::from_millis(300);
