//! Large samples cross emulated links whole and soon.

use std::thread;
use std::time::Duration;

use ddx_rig::link::{BitsPerSecond, Profile};
use ddx_wire::Delivery;

use crate::program::{Asked, Order};
use crate::site::{PATIENCE, SAMPLES, Site, row};

#[test]
fn samples_of_every_size_cross_a_lan_whole() {
    let sizes = [SIZES, &[6 << 20]].concat();
    cross(None, &DELIVERIES, &sizes);
    cross(Some("lan"), &DELIVERIES, &sizes);
}

#[test]
fn samples_of_every_size_cross_a_bad_radio_link_whole() {
    cross_side_by_side("wifi-bad");
}

#[test]
fn samples_of_every_size_cross_a_mobile_network_whole() {
    cross_side_by_side("lte");
}

/// A slow link leaves the machine idle: each delivery has one of its own, at the same time.
fn cross_side_by_side(profile: &str) {
    thread::scope(|scope| {
        for delivery in DELIVERIES {
            scope.spawn(move || cross(Some(profile), &[delivery], SIZES));
        }
    });
}

/// Sends samples of each size, one after another, to a reader behind a link, and judges how long they took.
fn cross(profile: Option<&str>, deliveries: &[Delivery], sizes: &[usize]) {
    let Some(site) = Site::new(&["robot1", "base"]) else {
        return;
    };
    let profile = profile.map(|profile| site.link("base", profile));
    let name = profile
        .as_ref()
        .map_or("none".to_owned(), Profile::to_string);
    row("link          delivery       bytes   first    p50    max  bound, ms");
    for &delivery in deliveries {
        for &bytes in sizes {
            let times = send(&site, delivery, bytes);
            let bound = bound(profile.as_ref(), bytes);
            let mut sorted = times.clone();
            sorted.sort();
            let (median, worst) = (sorted[sorted.len() / 2], sorted[sorted.len() - 1]);
            let ms = |time: Duration| time.as_secs_f64() * 1e3;
            row(&format!(
                "{name:<13} {:<9} {bytes:>10} {:>7.1} {:>6.1} {:>6.1} {:>6.0}",
                format!("{delivery:?}").to_lowercase(),
                ms(times[0]),
                ms(median),
                ms(worst),
                ms(bound),
            ));
            assert!(
                worst < bound,
                "{name}, {delivery:?}, {bytes} bytes: {times:?}"
            );
        }
    }
    row(&format!(
        "{name}: {} frames overran the wire",
        site.lab.host("base").overruns()
    ));
}

/// Writes some samples, each when the one before is there; returns how long each took.
fn send(site: &Site, delivery: Delivery, bytes: usize) -> Vec<Duration> {
    let mut robot = site.program("robot1");
    let mut reader = site.program("base");
    let prefix = format!("robot1/{delivery:?}/{bytes}");
    robot.open_large_writers(&prefix, 1, u32::try_from(bytes).unwrap());
    let asked = Asked {
        every: delivery == Delivery::Every,
        ..Asked::default()
    };
    robot.write(0);
    reader.open_readers_as(&prefix, 1, asked);
    reader.read(0, PATIENCE);
    let before = site.counters();
    let count = if bytes < 1_000_000 { 9 } else { 4 };
    let mut times = Vec::new();
    let mut books = Vec::new();
    for value in 1..=count {
        let order = Order::Write {
            first: value,
            count: 1,
            period_us: 0,
            bytes,
        };
        robot.ask(&order);
        reader.ask(&Order::Forget);
        (_, books) = reader.read(value, PATIENCE);
        times.push(books[0].ages.max);
    }
    let book = &books[0];
    assert_eq!(
        (book.delivered, book.lost, book.backwards, book.damaged),
        (count + 1, 0, 0, 0),
        "{bytes} bytes: {book:?}"
    );
    // A run of segments is counted as datagrams.
    let sent = site.counters().since(&before).udp(SAMPLES, "robot1").from;
    assert!(
        sent.bytes <= sent.packets * 1_500,
        "{bytes} bytes: {sent:?}"
    );
    times
}

/// When a sample should be there: its time at the rate with what loss costs, some round trips for repairs, all of it
/// three times over, and the slices of a busy machine. A burst of loss ends with the datagrams that it takes: while one
/// sample waits, these are requests and repeats, at least 60 ms apart.
fn bound(profile: Option<&Profile>, bytes: usize) -> Duration {
    let (rate, loss, way) = profile.map_or((MACHINE, 0.0, Duration::ZERO), |profile| {
        let BitsPerSecond(rate) = profile.down.rate.unwrap();
        let rate = f64::from(u32::try_from(rate).unwrap()).min(MACHINE);
        let way = profile.down.delay + profile.down.jitter;
        (rate, profile.down.loss.share, way)
    });
    let bits = f64::from(u32::try_from(bytes).unwrap()) * 8.0;
    let ideal = Duration::from_secs_f64(bits / rate / (1.0 - loss));
    let burst = profile.map_or(0.0, |profile| profile.down.loss.burst.max(1.0) - 1.0);
    3 * (ideal + 4 * way + Duration::from_millis(100)) + Duration::from_millis(300).mul_f64(burst)
}

/// What the wire carries beside other work, bits per second.
const MACHINE: f64 = 100e6;
const DELIVERIES: [Delivery; 2] = [Delivery::Latest, Delivery::Every];
const SIZES: &[usize] = &[7_900, 8_000, 8_100, 64_000, 1_000_000];
