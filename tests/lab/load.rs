//! The books balance under load, and the last value arrives under loss.

use std::time::Duration;

use ddx_rig::lab::Loss;

use crate::program::Order;
use crate::site::{PATIENCE, Site, report};

#[test]
fn a_hundred_items_at_a_hundred_hertz_to_three_hosts_are_counted_exactly() {
    let hosts = ["base1", "base2", "base3"];
    let Some(site) = Site::new(&["robot1", "base1", "base2", "base3"]) else {
        return;
    };
    let mut robot = site.program("robot1");
    robot.open_writers("robot1/imu", ITEMS);
    robot.write(0);
    let mut readers = hosts.map(|host| {
        let mut reader = site.program(host);
        reader.open_readers("robot1/imu", ITEMS);
        reader.read(0, PATIENCE);
        reader
    });

    robot.tell(&Order::Write {
        first: 1,
        count: SAMPLES_EACH,
        period_us: 10_000,
        bytes: 64,
    });
    for reader in &mut readers {
        reader.tell_read(SAMPLES_EACH, LOAD);
    }
    let written = robot.answer(LOAD).at_ns();

    for (host, reader) in hosts.iter().zip(&mut readers) {
        let (read, books) = reader.read_told(LOAD);
        let delivered: u64 = books.iter().map(|book| book.delivered).sum();
        let overwritten: u64 = books.iter().map(|book| book.overwritten).sum();
        let filtered: u64 = books.iter().map(|book| book.filtered).sum();
        report(
            &format!(
                "{host}: {delivered} delivered, {overwritten} overwritten, {filtered} filtered; the last after"
            ),
            Duration::from_nanos(read.saturating_sub(written)),
        );
        assert_eq!(books.len(), ITEMS);
        for book in &books {
            // The first sample was there before; each of the others is accounted for.
            assert_eq!(book.total(), 1 + SAMPLES_EACH, "{host}: {book:?}");
            assert_eq!(
                (book.lost, book.backwards, book.newest),
                (0, 0, Some(SAMPLES_EACH)),
                "{host}: {book:?}"
            );
        }
    }
}

#[test]
fn the_last_value_arrives_within_a_second_at_one_packet_in_three_lost() {
    let Some(site) = Site::new(&["robot1", "base1", "base2"]) else {
        return;
    };
    let mut robot = site.program("robot1");
    robot.open_writers("robot1/imu", 1);
    robot.write(0);
    let mut readers = ["base1", "base2"].map(|host| {
        let mut reader = site.program(host);
        reader.open_readers("robot1/imu", 1);
        reader.read(0, PATIENCE);
        reader
    });
    // Both ways of each reading host: samples, confirmations and repeats are lost alike.
    for host in ["base1", "base2"] {
        site.lab
            .host(host)
            .set_loss(Loss {
                from_percent: 33,
                to_percent: 33,
            })
            .unwrap();
    }

    let mut latest = Duration::ZERO;
    for round in 1..=ROUNDS {
        let value = 10 * round;
        robot.ask(&Order::Write {
            first: value - 2,
            count: 2,
            period_us: 10_000,
            bytes: 64,
        });
        let written = robot.write(value);
        for reader in &mut readers {
            reader.tell_read(value, PATIENCE);
        }
        for reader in &mut readers {
            let (read, books) = reader.read_told(PATIENCE + PATIENCE);
            let after = Duration::from_nanos(read.saturating_sub(written));
            latest = latest.max(after);
            assert!(after < LAST_WITHIN, "round {round}: {after:?}");
            assert_eq!(books[0].backwards, 0, "{books:?}");
        }
    }
    report("the latest last value came after", latest);
}

const ITEMS: usize = 100;
/// Ten seconds at 100 Hz.
const SAMPLES_EACH: u64 = 1_000;
const LOAD: Duration = Duration::from_secs(20);
const ROUNDS: u64 = 20;
/// As promised.
const LAST_WITHIN: Duration = Duration::from_secs(1);
