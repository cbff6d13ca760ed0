//! Samples of all sizes over every link profile: whole, in a time that the link explains, with books that balance.
//!
//! `--nocapture` prints a table. The reading host has the profile; the writing host's link is quiet, so that the figures
//! of the table in [`Profile`] hold for the path.

use std::time::Duration;

use ddx_catalog::delivery::Books;
use ddx_rig::link::{Loss, Profile};
use ddx_rig::sim::{Link, Setup, Sim};
use ddx_wire::{Contract, Delivery, ItemName};

use super::{check, millis, secs};

const SIZES: [usize; 7] = [1, 7_900, 8_000, 8_100, 64_000, 1_000_000, 6 << 20];

/// Two hosts; the reader's link is that of a profile.
struct Play {
    sim: Sim,
    item: ItemName,
    path: Path,
}

/// How long a sample may take.
#[derive(Clone, Copy, Debug)]
struct Bounds {
    /// At the rate of the link and with its loss, if nothing else took time.
    least: Duration,
    /// In every second case.
    usual: Duration,
    /// In any case, also the first on a path of which nothing is known.
    worst: Duration,
}

/// What a profile lets one expect.
#[derive(Clone, Copy)]
struct Path {
    rate: f64,
    loss: Loss,
    round_trip: Duration,
}

impl Path {
    fn of(profile: &Profile) -> Self {
        let down = profile.down;
        Self {
            #[expect(clippy::cast_precision_loss, reason = "rates are far below 2^53")]
            rate: down.rate.map_or(1e12, |rate| rate.0 as f64),
            loss: down.loss,
            round_trip: down.delay + down.jitter + profile.up.delay + profile.up.jitter,
        }
    }

    /// What a sample of this size may take.
    ///
    /// It leaves in datagrams of 1,228 B, of which 1,092 B are payload, each as often as it is lost and once more: that is
    /// the least. Each round of repair halves the rest at worst at one third lost, and takes a round trip, the pause after
    /// which what is missing is asked for, and the time that a full datagram takes. A small sample that is lost as a
    /// whole is repeated 130 ms and a round trip (at least 50 ms) after it was sent, and then each 60 ms.
    fn bounds(&self, len: usize) -> Bounds {
        let datagrams = u32::try_from(len.max(1).div_ceil(1_092)).unwrap();
        let one = Duration::from_secs_f64(1_228.0 * 8.0 / self.rate);
        let least = one * datagrams;
        let least = Duration::from_secs_f64(least.as_secs_f64() / (1.0 - self.loss.share));
        let round = self.round_trip + millis(30) + 2 * one;
        let rounds = if self.loss.share > 0.0 {
            // Until less than one in a thousand samples lacks anything.
            let rounds = (f64::from(datagrams) * 1_000.0).ln() / (1.0 / self.loss.share).ln();
            rounds * self.loss.burst
        } else {
            0.0
        };
        let repair = Duration::from_secs_f64(round.as_secs_f64() * rounds);
        // A path that was never used is taken for one of 100 Mbit/s.
        let guess = Duration::from_secs_f64(f64::from(datagrams) * 1_200.0 / 12.5e6);
        let again = millis(130) + self.round_trip.max(millis(50)) + millis(60) * 4;
        Bounds {
            least,
            usual: least * 5 / 4 + round + repair / 2 + guess,
            worst: least * 2 + round + repair + guess + again,
        }
    }
}

impl Play {
    fn new(seed: u64, profile: &Profile, delivery: Delivery) -> Self {
        let mut sim = two_hosts(seed, profile);
        let item = sim.announce(0, "cam");
        let contract = Contract {
            delivery,
            ..Contract::default()
        };
        sim.subscribe(1, &item, contract);
        // Long enough to meet, to subscribe, and for the round trip to be known.
        sim.run_for(secs(15));
        Self {
            sim,
            item,
            path: Path::of(profile),
        }
    }

    /// Writes a sample, and waits for it as long as it may take.
    fn one(&mut self, len: usize, bounds: &Bounds) -> Duration {
        let start = self.sim.now();
        let written = self.sim.write(0, &self.item, len);
        let item = self.item.clone();
        let held = |sim: &Sim| sim.host(1).held(&item) == written;
        let came = self.sim.run_until(bounds.worst, held);
        assert!(came, "{len} B not within {:?}", bounds.worst);
        self.sim.now() - start
    }

    fn books(&self) -> Books {
        self.sim
            .host(1)
            .books()
            .first()
            .copied()
            .unwrap_or_default()
    }
}

/// Two hosts, of which the second's link is that of a profile, and the first one's is quiet.
pub(crate) fn two_hosts(seed: u64, profile: &Profile) -> Sim {
    let quiet = Link {
        loss: 0.0,
        duplicates: 0.0,
        delay: Duration::ZERO,
        jitter: Duration::ZERO,
    };
    let mut sim = Sim::new(Setup {
        link: quiet,
        ..Setup::lan(seed, 2, 0.0)
    });
    sim.set_profile(1, 0, profile);
    sim
}

fn ms(span: Duration) -> f64 {
    span.as_secs_f64() * 1e3
}

#[test]
fn the_newest_of_all_sizes_arrives_in_time_over_every_profile() {
    for name in Profile::names() {
        for len in SIZES {
            println!("{}", newest(name, len));
        }
    }
    println!("{}", newest("lan", 64 << 20));
}

/// One sample on a path that was never used, then more, each when the one before is there.
fn newest(name: &str, len: usize) -> String {
    let profile = Profile::parse(&format!("{name} --seed 5")).unwrap();
    let mut play = Play::new(1, &profile, Delivery::Latest);
    let bounds = play.path.bounds(len);
    // Small ones by number, so that their half does not hang on the luck of two.
    let count = if len > 100_000 { 5 } else { 25 };
    let cold = play.one(len, &bounds);
    let mut times: Vec<_> = (0..count).map(|_| play.one(len, &bounds)).collect();
    times.sort();
    let usual = times[count / 2];
    let line = format!(
        "{name:22} {len:8} B: least {:9.1} ms, first {:9.1}, then {:9.1} to {:9.1} ms",
        ms(bounds.least),
        ms(cold),
        ms(usual),
        ms(times[count - 1]),
    );
    assert!(usual <= bounds.usual, "{name} {len}: {times:?}, {bounds:?}");
    check(&play.sim).unwrap();
    line
}

#[test]
fn every_sample_of_all_sizes_is_delivered_in_order_or_accounted_for_over_every_profile() {
    for name in Profile::names() {
        for len in SIZES {
            println!("{}", every(name, len));
        }
    }
}

/// A burst of more samples than the ring holds, or a few large ones: each is delivered, or was overwritten there.
fn every(name: &str, len: usize) -> String {
    let profile = Profile::parse(&format!("{name} --seed 6")).unwrap();
    let mut play = Play::new(2, &profile, Delivery::Every);
    let bounds = play.path.bounds(len);
    // The books begin with the first that is delivered.
    play.one(len, &bounds);
    let before = play.books();
    let count = if len > 100_000 { 3 } else { 12 };
    let start = play.sim.now();
    for _ in 0..count {
        play.sim.write(0, &play.item, len);
        play.sim.run_for(millis(5));
    }
    let wait = bounds.worst * count;
    let (item, count) = (play.item.clone(), u64::from(count));
    let came = play.sim.run_until(wait, |sim| {
        sim.host(1).held(&item) == sim.host(0).newest(&item)
    });
    let took = play.sim.now() - start;
    let after = play.books();
    let delivered = after.delivered - before.delivered;
    let overwritten = after.overwritten - before.overwritten;
    let line = format!(
        "{name:22} {len:8} B: {delivered} of {count} delivered, {overwritten} overwritten, in {:9.1} ms",
        ms(took)
    );
    assert!(came, "{name} {len}: {after:?} after {took:?}");
    assert_eq!(delivered + overwritten, count, "{name} {len}: {after:?}");
    assert_eq!(
        after.expected - before.expected,
        count,
        "{name} {len}: {after:?}"
    );
    assert_eq!(after.link_lost, before.link_lost, "{name} {len}: {after:?}");
    // Eight are in the ring when the last is written.
    assert!(delivered >= count.min(8), "{name} {len}: {after:?}");
    // A sample that was a quarter of an hour under way is older than its bound says, by the drift of the clocks.
    let broken: Vec<_> = play
        .sim
        .broken
        .iter()
        .filter(|(_, _, text)| !text.starts_with("age of"))
        .collect();
    assert!(broken.is_empty(), "{name} {len}: {broken:?}");
    line
}
