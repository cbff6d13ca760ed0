//! What shares a link: items of unlike priority, commands beside bulk, viewers of unlike links, a group that loses.
//!
//! `--nocapture` prints the figures.

use std::collections::BTreeMap;
use std::time::Duration;

use ddx_catalog::delivery::Via;
use ddx_rig::link::Profile;
use ddx_rig::sim::{Link, Setup, Sim};
use ddx_wire::{Contract, Epoch, ItemName, Priority, Seq};

use super::{check, millis, secs};

/// Hosts on links that do nothing but what a profile says.
fn quiet(seed: u64, hosts: usize) -> Sim {
    Sim::new(Setup {
        link: STILL,
        ..Setup::lan(seed, hosts, 0.0)
    })
}

const STILL: Link = Link {
    loss: 0.0,
    duplicates: 0.0,
    delay: Duration::ZERO,
    jitter: Duration::ZERO,
};

fn profile(text: &str) -> Profile {
    Profile::parse(text).unwrap()
}

fn with_priority(priority: Priority) -> Contract {
    Contract {
        priority,
        ..Contract::default()
    }
}

/// An item of host 0 that is written steadily.
struct Source {
    name: ItemName,
    len: usize,
    period: Duration,
    next: Duration,
    /// When each sample was written.
    written: BTreeMap<(Epoch, Seq), Duration>,
}

/// How old what a reader holds is, each millisecond, and how much of it was new.
#[derive(Clone, Debug, Default)]
struct Seen {
    ages: Vec<Duration>,
    samples: u64,
    last: Option<(Epoch, Seq)>,
    /// From the write of a sample to the first sight of it.
    latencies: Vec<Duration>,
}

struct Play {
    sim: Sim,
    sources: Vec<Source>,
    /// By source and reader.
    seen: BTreeMap<(usize, usize), Seen>,
    /// Wait for the transmitter of host 1's link, each millisecond.
    backlogs: Vec<Duration>,
}

impl Play {
    fn new(sim: Sim) -> Self {
        Self {
            sim,
            sources: Vec::new(),
            seen: BTreeMap::new(),
            backlogs: Vec::new(),
        }
    }

    fn source(&mut self, rest: &str, len: usize, period: Duration) -> usize {
        let name = self.sim.announce(0, rest);
        self.sources.push(Source {
            name,
            len,
            period,
            // Not all at one instant.
            next: self.sim.now()
                + period
                    .mul_f64(0.137)
                    .mul_f64(self.sources.len() as f64 % 7.0),
            written: BTreeMap::new(),
        });
        self.sources.len() - 1
    }

    fn read(&mut self, source: usize, reader: usize, contract: Contract) {
        let name = self.sources[source].name.clone();
        self.sim.subscribe(reader, &name, contract);
        self.seen.insert((source, reader), Seen::default());
    }

    fn forget(&mut self) {
        self.backlogs.clear();
        for seen in self.seen.values_mut() {
            *seen = Seen {
                last: seen.last,
                ..Seen::default()
            };
        }
    }

    /// Writes and watches.
    fn run_for(&mut self, span: Duration) {
        let end = self.sim.now() + span;
        while self.sim.now() < end {
            let now = self.sim.now();
            for source in &mut self.sources {
                while source.next <= now {
                    source.next += source.period;
                    if let Some(at) = self.sim.write(0, &source.name, source.len) {
                        source.written.insert(at, now);
                    }
                }
            }
            let next = self.sources.iter().map(|source| source.next).min();
            let tick = now + millis(1);
            let until = next.map_or(tick, |next| next.min(tick));
            self.sim.run_for(until - now);
            self.watch();
        }
    }

    fn watch(&mut self) {
        let now = self.sim.now();
        self.backlogs.push(self.sim.backlog(1, 0));
        for ((source, reader), seen) in &mut self.seen {
            let source = &self.sources[*source];
            let held = self.sim.host(*reader).held(&source.name);
            let Some(written) = held.and_then(|held| source.written.get(&held)) else {
                continue;
            };
            seen.ages.push(now - *written);
            if held != seen.last {
                (seen.last, seen.samples) = (held, seen.samples + 1);
                seen.latencies.push(now - *written);
            }
        }
    }
}

impl Seen {
    fn mean_age(&self) -> f64 {
        let sum: Duration = self.ages.iter().sum();
        ms(sum) / f64::from(u32::try_from(self.ages.len().max(1)).unwrap())
    }

    fn age(&self, percent: usize) -> Duration {
        quantile(&self.ages, percent)
    }
}

fn quantile(all: &[Duration], percent: usize) -> Duration {
    let mut all = all.to_vec();
    all.sort();
    let at = (all.len() * percent / 100).min(all.len().saturating_sub(1));
    all.get(at).copied().unwrap_or_default()
}

fn ms(span: Duration) -> f64 {
    span.as_secs_f64() * 1e3
}

#[test]
fn a_link_of_200_kbit_keeps_each_item_as_fresh_as_its_priority_says() {
    let mut play = Play::new(quiet(1, 2));
    let slow = profile("802.11b-200k --seed 3");
    play.sim.set_profile(1, 0, &slow);
    let priorities = [
        Priority::Background,
        Priority::Low,
        Priority::Normal,
        Priority::High,
    ];
    // 40 items of 1,000 B at 15.6 Hz are 5 Mbit/s.
    for item in 0..40 {
        let source = play.source(&format!("i{item}"), 1_000, millis(64));
        play.read(source, 1, with_priority(priorities[item % 4]));
    }
    let command = play.source("stop", 64, millis(503));
    play.read(command, 1, with_priority(Priority::Command));
    play.run_for(secs(20));
    play.forget();
    let before = play.sim.books(1, 0).down;
    play.run_for(secs(60));
    let after = play.sim.books(1, 0).down;
    let carried = (after.carried_bytes - before.carried_bytes) * 8 / 60;
    let full = after.queue_full - before.queue_full;
    println!(
        "carried {carried} bit/s, wait of 99 % {:.1} ms, {full} dropped by the queue",
        ms(quantile(&play.backlogs, 99))
    );
    let mut rates = Vec::new();
    for (at, priority) in priorities.iter().enumerate() {
        let of = (at..40).step_by(4).map(|source| &play.seen[&(source, 1)]);
        let samples: Vec<u64> = of.clone().map(|seen| seen.samples).collect();
        let age: f64 = of.map(Seen::mean_age).sum::<f64>() / 10.0;
        println!("{priority:?}: samples {samples:?}, mean age {age:.0} ms");
        rates.push(samples.iter().sum::<u64>() * 16 / u64::from(priority.weight()));
    }
    let seen = &play.seen[&(command, 1)];
    println!(
        "command: {} samples, median {:.1}, 90 % {:.1}, longest {:.1} ms",
        seen.latencies.len(),
        ms(quantile(&seen.latencies, 50)),
        ms(quantile(&seen.latencies, 90)),
        ms(quantile(&seen.latencies, 100))
    );
    println!("shares per weight {rates:?}");
    let (least, most) = (rates.iter().min().unwrap(), rates.iter().max().unwrap());
    assert!(4 * most <= 5 * least, "not in proportion: {rates:?}");
    assert!(carried > 160_000, "{carried} bit/s");
    assert!(quantile(&play.backlogs, 99) < millis(90));
    assert_eq!(full, 0, "dropped by the queue");
    // A datagram in transmission, 20 ms of delay and jitter, and its own time. Who is lost is repeated later.
    assert!(quantile(&seen.latencies, 90) < millis(49 + 20 + 7));

    let fast = profile("wifi-good --seed 3");
    play.sim.set_profile(1, 0, &fast);
    play.run_for(secs(2));
    let before = play.sim.books(1, 0).down;
    play.forget();
    play.run_for(secs(1));
    let after = play.sim.books(1, 0).down;
    let wanted = (after.carried_bytes - before.carried_bytes) * 8;
    println!("two seconds after the link got fast: {wanted} bit/s carried");
    assert!(wanted > 5_000_000, "{wanted} bit/s");
    play.run_for(secs(10));
    play.sim.set_profile(1, 0, &slow);
    play.run_for(secs(2));
    play.forget();
    let before = play.sim.books(1, 0).down;
    play.run_for(secs(5));
    let after = play.sim.books(1, 0).down;
    println!(
        "two seconds after it got slow: wait of 99 % {:.1} ms, {} dropped",
        ms(quantile(&play.backlogs, 99)),
        after.queue_full - before.queue_full
    );
    assert!(quantile(&play.backlogs, 99) < millis(100));
    assert!(after.queue_full - before.queue_full <= 3);
    check(&play.sim).unwrap();
}

#[test]
fn a_command_waits_for_one_batch_of_bulk() {
    let run = |bulk: bool| {
        let mut sim = quiet(4, 2);
        sim.set_profile(1, 0, &profile("lan --rate \"100 Mbit/s\" --seed 3"));
        let command = sim.announce(0, "stop");
        let cam = sim.announce(0, "cam");
        sim.subscribe(1, &command, with_priority(Priority::Command));
        sim.subscribe(1, &cam, Contract::default());
        sim.run_for(secs(3));
        for _ in 0..3 {
            sim.write(0, &cam, 6 << 20);
            sim.run_for(secs(1));
        }
        let mut delays = Vec::new();
        if bulk {
            sim.write(0, &cam, 6 << 20);
        }
        for _ in 0..60 {
            sim.run_for(Duration::from_micros(7_300));
            let start = sim.now();
            let written = sim.write(0, &command, 64);
            while sim.host(1).held(&command) != written {
                sim.run_for(Duration::from_micros(5));
            }
            delays.push(sim.now() - start);
        }
        delays
    };
    let (alone, beside) = (run(false), run(true));
    for share in [0, 50, 90, 99] {
        println!(
            "{share}: alone {:?}, beside bulk {:?}",
            quantile(&alone, share),
            quantile(&beside, share)
        );
    }
    // A batch is what the rate sends in 200 us. While a higher rate is tried, a little more piles up.
    let batch = Duration::from_micros(200);
    assert!(quantile(&beside, 90) <= quantile(&alone, 90) + batch);
    assert!(quantile(&beside, 100) <= quantile(&alone, 100) + millis(1));
}

fn viewers(slow: bool, contract: Contract) -> (Seen, Seen) {
    let mut play = Play::new(quiet(7, 3));
    play.sim
        .set_profile(1, 0, &profile("wifi-good --loss 0% --seed 3"));
    play.sim.set_profile(
        2,
        0,
        &profile("lan --rate \"1 Mbit/s\" --delay \"10 ms\" --seed 4"),
    );
    let source = play.source("cam", 20_000, millis(20));
    play.read(source, 1, Contract::default());
    if slow {
        play.read(source, 2, contract);
    }
    play.run_for(secs(20));
    play.forget();
    play.run_for(secs(30));
    let seen = |reader| {
        play.seen
            .get(&(source, reader))
            .cloned()
            .unwrap_or_default()
    };
    (seen(1), seen(2))
}

#[test]
fn a_slow_viewer_changes_nothing_for_a_fast_one() {
    let (alone, _) = viewers(false, Contract::default());
    println!(
        "alone: {} samples, p50 {:?} p99 age {:?}",
        alone.samples,
        alone.age(50),
        alone.age(99)
    );
    for contract in [Contract::default(), Contract::at_most_hz(30.0).unwrap()] {
        let (beside, slow) = viewers(true, contract);
        println!(
            "{contract}: {} samples, p50 {:?} p99 age {:?}",
            beside.samples,
            beside.age(50),
            beside.age(99)
        );
        println!(
            "the slow one: {} samples, p99 age {:?}",
            slow.samples,
            slow.age(99)
        );
        assert!(beside.samples * 100 >= alone.samples * 98, "{contract}");
        assert!(beside.age(99) <= alone.age(99) + millis(5), "{contract}");
        // 1 Mbit/s carries 5.6 of them a second.
        assert!(slow.samples > 100, "{contract}: {}", slow.samples);
    }
}

#[test]
fn a_group_that_loses_is_left_and_found_again() {
    let mut play = Play::new(quiet(9, 3));
    for reader in [1, 2] {
        play.sim
            .set_profile(reader, 0, &profile(&format!("wifi-good --seed {reader}")));
    }
    let source = play.source("cam", 1_000, millis(10));
    play.read(source, 1, Contract::default());
    play.read(source, 2, Contract::default());
    let ways = |sim: &Sim| -> Vec<Via> {
        let routes = sim.host(0).open.values();
        routes
            .flat_map(|(_, route)| route.readers.iter().map(|reader| reader.via))
            .collect()
    };
    let all_by = |sim: &Sim, group: bool| {
        let ways = ways(sim);
        ways.len() == 2
            && ways.iter().all(|via| match via {
                Via::Group(_) => group,
                Via::Unicast => !group,
                Via::Both(_) => false,
            })
    };
    play.run_for(secs(20));
    println!("good: {:?}", ways(&play.sim));
    for reader in [1, 2] {
        play.sim.set_profile(
            reader,
            0,
            &profile(&format!("wifi-multicast-broken --seed {reader}")),
        );
    }
    let start = play.sim.now();
    while !all_by(&play.sim, false) && play.sim.now() < start + secs(20) {
        play.run_for(millis(10));
    }
    println!("by unicast after {:?}", play.sim.now() - start);
    assert!(play.sim.now() < start + secs(2));
    play.forget();
    play.run_for(secs(30));
    let goodput = |play: &Play| -> Vec<u64> {
        [1, 2]
            .map(|reader| play.seen[&(source, reader)].samples)
            .to_vec()
    };
    println!("in 30 s broken: {:?} of 3000", goodput(&play));
    assert!(goodput(&play).iter().all(|samples| *samples > 2_850));
    for reader in [1, 2] {
        play.sim
            .set_profile(reader, 0, &profile(&format!("wifi-good --seed {reader}")));
    }
    let start = play.sim.now();
    while !all_by(&play.sim, true) && play.sim.now() < start + secs(120) {
        play.run_for(millis(10));
    }
    println!("by group after {:?}", play.sim.now() - start);
    // The trials that failed, after 5, 10 and 20 s, make the next one wait up to 40 s.
    assert!(play.sim.now() < start + secs(45));
    check(&play.sim).unwrap();
}

/// More than the links carry, to two readers.
#[test]
fn broken_multicast_costs_no_more_than_a_tenth_of_what_unicast_carries() {
    let carried = [true, false].map(|multicast| {
        let mut sim = Sim::new(Setup {
            multicast,
            link: STILL,
            ..Setup::lan(9, 3, 0.0)
        });
        for reader in [1, 2] {
            let broken = format!("wifi-multicast-broken --seed {reader}");
            sim.set_profile(reader, 0, &profile(&broken));
        }
        let mut play = Play::new(sim);
        let source = play.source("cam", 8_000, millis(1));
        for reader in [1, 2] {
            play.read(source, reader, Contract::default());
        }
        play.run_for(secs(10));
        play.forget();
        // Trials of the group, and what these cost, are in it.
        play.run_for(secs(60));
        let samples = [1, 2].map(|reader| play.seen[&(source, reader)].samples);
        println!("multicast {multicast}: {samples:?} of 60000");
        check(&play.sim).unwrap();
        samples.into_iter().min().unwrap()
    });
    assert!(carried[0] * 10 >= carried[1] * 9, "{carried:?}");
    assert!(carried[1] * 8_000 * 8 / 60 > 30_000_000, "{carried:?}");
}

/// Robots that send to one ground station cannot see each other.
#[test]
fn senders_that_fill_one_link_share_it() {
    for seed in 0..10 {
        let mut sim = quiet(seed, 5);
        let slow = format!("lan --rate \"2 Mbit/s\" --delay \"20 ms\" --seed {seed}");
        sim.set_profile(0, 0, &profile(&slow));
        let lens = [1_100, 5_000, 40_000, 48];
        let names: Vec<_> = (1..5).map(|host| sim.announce(host, "x")).collect();
        let mut received = [0; 4];
        let mut held = [None; 4];
        for (at, name) in names.iter().enumerate() {
            sim.subscribe(0, name, Contract::default());
            let end = if at < 3 { secs(3) } else { secs(10) };
            let start = sim.now();
            while sim.now() < start + end {
                for (host, name) in names.iter().enumerate() {
                    // The last one wants little, 10 kB/s.
                    sim.write(host + 1, name, lens[host]);
                    let newest = sim.host(0).held(name);
                    if at == 3 && newest != held[host] && sim.now() > start + secs(4) {
                        received[host] += lens[host] / 6;
                    }
                    held[host] = newest;
                }
                sim.run_for(millis(5));
            }
        }
        println!("seed {seed}: {received:?} B/s");
        let (least, most) = (
            received[..3].iter().min().unwrap(),
            received[..3].iter().max().unwrap(),
        );
        assert!(2 * least > *most, "seed {seed}: {received:?}");
        assert!(
            received.iter().sum::<usize>() > 170_000,
            "seed {seed}: {received:?}"
        );
        assert!(received[3] > 4_000, "seed {seed}: {received:?}");
        check(&sim).unwrap();
    }
}
