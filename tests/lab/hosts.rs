//! Hosts join, leave, die, are cut off, and come back; a host without a network is whole.

use std::time::{Duration, Instant};

use crate::program::Order;
use crate::site::{DATA_PORT, PATIENCE, Site, report};

#[test]
fn a_robot_joins_leaves_is_killed_and_comes_back() {
    let Some(mut site) = Site::bare(&["robot1", "base"]) else {
        return;
    };
    site.up("base", KEY);
    let mut reader = site.program("base");
    reader.open_readers("robot1/imu", 1);

    // Joins: the reader was there first.
    site.up("robot1", KEY);
    let mut robot = site.program("robot1");
    robot.open_writers("robot1/imu", 1);
    robot.open_writers("robot1/unread", 1);
    robot.write(10);
    reader.read(10, PATIENCE);
    site.wait_state("base", "robot1", "up");
    site.wait_listed("base", "robot1/unread/0", true);

    // Leaves: at once, because it says so. Only whoever reads keeps what he has.
    site.terminate("robot1");
    robot.kill();
    let left = site.wait_state("base", "robot1", "left");
    report("a robot that left was seen to", left);
    site.wait_listed("base", "robot1/unread/0", false);
    let kept = site.ddx("base", &["ls", "robot1/imu/0"]);
    assert_eq!(kept[0]["writer"], "orphaned", "{kept:?}");

    // Comes back with a program that starts anew.
    site.up("robot1", KEY);
    let mut robot = site.program("robot1");
    robot.open_writers("robot1/imu", 1);
    let written = robot.write(20);
    let (read, _) = reader.read(20, PATIENCE);
    report("a robot that came back was read after", span(written, read));
    site.wait_state("base", "robot1", "up");

    // Is killed: silence shows, and the value stays.
    site.kill("robot1");
    robot.kill();
    let unreachable = site.wait_state("base", "robot1", "unreachable");
    report("a robot that was killed was seen unreachable", unreachable);
    assert!(unreachable < UNREACHABLE_WITHIN, "{unreachable:?}");
    let kept = site.ddx("base", &["get", "robot1/imu/0"]);
    assert_eq!(kept[0]["seq"], 1, "{kept:?}");

    // Comes back: it must not take what its former life left for new.
    site.up("robot1", KEY);
    let mut robot = site.program("robot1");
    robot.open_writers("robot1/imu", 1);
    robot.write(30);
    let (_, books) = reader.read(30, PATIENCE);
    site.wait_state("base", "robot1", "up");
    assert_eq!(
        books[0].backwards, 0,
        "an old value showed as new: {books:?}"
    );
    assert_eq!(
        (books[0].delivered, books[0].lost, books[0].newest),
        (3, 0, Some(30)),
        "{books:?}"
    );
}

#[test]
fn a_daemon_that_is_killed_and_started_again_serves_the_programs_that_went_on() {
    let Some(mut site) = Site::new(&["robot1", "base"]) else {
        return;
    };
    let (mut robot, mut reader) = (site.program("robot1"), site.program("base"));
    robot.open_writers("robot1/imu", 1);
    reader.open_readers("robot1/imu", 1);
    robot.write(1);
    reader.read(1, PATIENCE);

    for (host, value) in [("robot1", 3), ("base", 5)] {
        site.kill(host);
        robot.write(value - 1);
        site.up(host, KEY);

        // A program that writes notices the new daemon when it writes.
        let written = robot.write(value);
        let (read, books) = reader.read(value, PATIENCE);
        report(
            &format!("after the daemon of {host} was started again a value was read in"),
            span(written, read),
        );
        assert_eq!(
            (books[0].backwards, books[0].newest),
            (0, Some(value)),
            "{books:?}"
        );
    }
}

#[test]
fn a_partition_of_ten_seconds_heals_within_one() {
    let Some(site) = Site::new(&["robot1", "base", "tablet"]) else {
        return;
    };
    // The kernel looks for a neighbour that it lost once a second, which is no delay of ours.
    for host in site.lab.hosts() {
        host.shell("echo 50 >/proc/sys/net/ipv4/neigh/eth0/retrans_time_ms")
            .unwrap();
    }
    let mut robot = site.program("robot1");
    robot.open_writers("robot1/imu", 10);
    robot.write(1);
    let mut readers = ["base", "tablet"].map(|host| {
        let mut reader = site.program(host);
        reader.open_readers("robot1/imu", 10);
        reader.read(1, PATIENCE);
        reader
    });

    site.lab.host("robot1").cut().unwrap();
    let order = Order::Write {
        first: 2,
        count: 100,
        period_us: 100_000,
        bytes: 64,
    };
    robot.tell(&order);
    robot.answer(PARTITION + PATIENCE);
    let state = site.state("base", "robot1");
    for reader in &mut readers {
        reader.tell_read(101, PATIENCE);
    }
    let healed = ddx_store::now().0;
    site.lab.host("robot1").heal().unwrap();

    for reader in &mut readers {
        let (read, books) = reader.read_told(PATIENCE + PATIENCE);
        let after = span(healed, read);
        report("after a partition all newest values were read in", after);
        assert!(after < HEALED_WITHIN, "{after:?}");
        assert!(books.iter().all(|book| book.backwards == 0), "{books:?}");
    }
    assert_ne!(state.as_deref(), Some("up"), "the partition was seen");
    site.wait_state("base", "robot1", "up");
}

#[test]
fn programs_of_one_host_go_on_without_daemon_and_network() {
    let Some(mut site) = Site::new(&["robot1", "base"]) else {
        return;
    };
    let (mut writer, mut reader) = (site.program("robot1"), site.program("robot1"));
    writer.open_writers("robot1/imu", 3);
    reader.open_readers("robot1/imu", 3);
    writer.write(1);
    reader.read(1, PATIENCE);

    site.lab.host("robot1").cut().unwrap();
    site.kill("robot1");
    let start = Instant::now();
    for value in 2..100 {
        writer.write(value);
        let (_, books) = reader.read(value, PATIENCE);
        assert_eq!(
            books.iter().map(|book| book.delivered).sum::<u64>(),
            3 * value,
            "{books:?}"
        );
    }
    report(
        "98 values through a host without daemon and network",
        start.elapsed(),
    );
}

#[test]
fn without_a_key_nothing_is_sent_or_listened_to() {
    let Some(mut site) = Site::bare(&["robot1", "base"]) else {
        return;
    };
    let before = site.counters();

    let ready = site.up("robot1", &[]);
    let sockets = site.lab.host("robot1").shell(SOCKETS).unwrap();
    let (mut writer, mut reader) = (site.program("robot1"), site.program("robot1"));
    writer.open_writers("robot1/imu", 1);
    reader.open_readers("base/imu", 1);
    reader.open_readers("robot1/imu", 1);
    writer.write(1);
    let hosts = site.ddx("robot1", &["host", "ls"]);
    // With a key the same daemon does talk, at once: the switch would have seen the other.
    let counted = site.counters().since(&before);
    site.terminate("robot1");
    site.up("robot1", KEY);
    let with_key = site.lab.host("robot1").shell(SOCKETS).unwrap();
    let waited = site
        .lab
        .wait_counters("a beacon", &before, PATIENCE, |now| {
            now.link("robot1").from.packets > 0
        });

    assert!(
        ready["data_port"].is_null() && ready["control"].as_array().unwrap().is_empty(),
        "{ready}"
    );
    assert_eq!(sockets, "", "a socket was open");
    assert!(hosts.is_empty(), "{hosts:?}");
    assert_eq!(counted.link("robot1").from.packets, 0, "{counted:#?}");
    assert!(
        with_key.contains(&format!(":{DATA_PORT:04X} ")),
        "{with_key}"
    );
    waited.unwrap();
}

fn span(from_ns: u64, to_ns: u64) -> Duration {
    Duration::from_nanos(to_ns.saturating_sub(from_ns))
}

const KEY: &[&str] = &["--key", "/run/key"];
/// The rows of every kind of IP socket, without the heads of their tables.
const SOCKETS: &str = "cd /proc/net; for t in udp tcp raw udplite packet icmp udp6 tcp6 raw6; do [ ! -e $t ] || tail -n +2 $t; done";
const PARTITION: Duration = Duration::from_secs(10);
/// As promised.
const HEALED_WITHIN: Duration = Duration::from_secs(1);
/// Three seconds of silence, the period of the daemon's own state, and a look.
const UNREACHABLE_WITHIN: Duration = Duration::from_millis(4_500);
