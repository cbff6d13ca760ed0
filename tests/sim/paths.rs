//! Hosts with several addresses, or with another one than before: samples flow on, and no reader notices.

use std::time::Duration;

use ddx_catalog::{Event, HostState};
use ddx_rig::sim::{Random, Setup, Sim};
use ddx_wire::{Contract, ItemName};

use super::{check, ensure, millis, secs, seeds};

/// As promised.
const FLOWS_WITHIN: Duration = Duration::from_secs(1);
/// What is told need not be found out.
const TOLD_WITHIN: Duration = Duration::from_millis(300);
const PERIOD: Duration = Duration::from_millis(10);

/// Host 0 writes an item, and the others read it, on so many networks.
struct Play {
    sim: Sim,
    item: ItemName,
    readers: usize,
}

impl Play {
    fn new(seed: u64, networks: usize, readers: usize, loss: f64) -> Self {
        let mut sim = Sim::new(Setup {
            networks,
            ..Setup::lan(seed, readers + 1, loss)
        });
        let item = sim.announce(0, "gps");
        for reader in 1..=readers {
            sim.subscribe(reader, &item, Contract::default());
        }
        let mut play = Self { sim, item, readers };
        // Long enough for paths to be measured and a group to be confirmed.
        play.write_for(secs(4));
        play
    }

    fn write_for(&mut self, span: Duration) {
        let end = self.sim.now() + span;
        while self.sim.now() < end {
            self.sim.write(0, &self.item, 200);
            self.sim.run_for(PERIOD);
        }
    }

    /// How long until every reader has something that is written from now on; `None` if not within three seconds.
    fn gap(&mut self) -> Option<Duration> {
        let start = self.sim.now();
        let first = self.sim.write(0, &self.item, 200)?;
        while self.sim.now() < start + secs(3) {
            let held = |reader| self.sim.host(reader).held(&self.item);
            if (1..=self.readers).all(|reader| held(reader) >= Some(first)) {
                return Some(self.sim.now() - start);
            }
            self.sim.run_for(PERIOD);
            self.sim.write(0, &self.item, 200);
        }
        None
    }

    /// Does something to the network; samples must then flow again within this, as if nothing had happened.
    fn survives(
        &mut self,
        what: &str,
        within: Duration,
        act: impl FnOnce(&mut Sim),
    ) -> Result<(), String> {
        let before = self.seen();
        act(&mut self.sim);
        let gap = self.gap();
        ensure(gap.is_some_and(|gap| gap < within), || {
            format!("{what}: samples flow again after {gap:?}")
        })?;
        self.write_for(secs(4));
        ensure(self.seen() == before, || {
            format!("{what}: {:?} was {before:?}", self.seen())
        })?;
        let lost = self.sim.log.iter().find(|(_, _, event)| {
            matches!(
                event,
                Event::HostUnreachable { .. } | Event::HostDown { .. }
            )
        });
        ensure(lost.is_none(), || {
            format!("{what}: a host was lost at {:?}", lost.map(|lost| lost.0))
        })?;
        check(&self.sim)
    }

    /// What a reader would notice: another epoch, or another stream.
    fn seen(&self) -> Vec<String> {
        let seen = (1..=self.readers).map(|reader| {
            let host = self.sim.host(reader);
            let epoch = host.held(&self.item).map(|(epoch, _)| epoch);
            format!("{epoch:?} {:?}", host.expected)
        });
        seen.collect()
    }
}

#[test]
fn samples_flow_on_within_a_second_when_one_of_two_networks_falls_silent() {
    let test = "paths::samples_flow_on_within_a_second_when_one_of_two_networks_falls_silent";
    seeds::run(test, 0..1_000, |seed| {
        let mut random = Random::new(seed);
        let readers = 1 + usize::try_from(random.below(2)).unwrap();
        let mut play = Play::new(seed, 2, readers, random.pick(&[0.0, 0.0, 0.02]));
        // At any time between two probes.
        play.write_for(millis(random.below(600)));
        for _turn in 0..2 {
            let (from, to) = random.pick(&[(0, 1), (1, 0)]);
            let used = play.sim.network(from, to);
            let used = used.ok_or("the hosts do not know each other")?;
            let host = random.pick(&[0, 1]);
            play.survives("a silent network", FLOWS_WITHIN, |sim| {
                sim.silence(host, used, true);
            })?;
            for (one, other) in [(0, 1), (1, 0)] {
                ensure(play.sim.network(one, other) == Some(1 - used), || {
                    format!("host {one} still sends to {other} on network {used}")
                })?;
            }
            play.sim.silence(host, used, false);
            // Until it is found again.
            play.write_for(secs(6));
        }
        Ok(())
    });
}

#[test]
fn an_interface_that_goes_down_is_left_at_once() {
    let test = "paths::an_interface_that_goes_down_is_left_at_once";
    seeds::run(test, 0..300, |seed| {
        let mut random = Random::new(seed);
        let readers = 1 + usize::try_from(random.below(2)).unwrap();
        let mut play = Play::new(seed, 2, readers, 0.0);
        for _turn in 0..2 {
            let (host, network) = (random.pick(&[0, 1]), random.pick(&[0, 1]));
            play.survives("an interface down", TOLD_WITHIN, |sim| {
                sim.plug(host, network, false);
            })?;
            play.survives("an interface up", TOLD_WITHIN, |sim| {
                sim.plug(host, network, true);
            })?;
        }
        Ok(())
    });
}

#[test]
fn a_host_is_itself_at_another_address() {
    let test = "paths::a_host_is_itself_at_another_address";
    seeds::run(test, 0..300, |seed| {
        let mut random = Random::new(seed);
        let readers = 1 + usize::try_from(random.below(2)).unwrap();
        let mut play = Play::new(seed, 1, readers, 0.0);
        for _turn in 0..3 {
            // Two at a time find each other by their beacons.
            let movers = random.pick(&[&[0][..], &[1], &[0, 1]]);
            play.survives("another address", FLOWS_WITHIN, |sim| {
                for host in movers {
                    sim.readdress(*host, 0);
                }
            })?;
        }
        Ok(())
    });
}

#[test]
fn a_host_that_starts_without_an_address_waits_for_one() {
    let test = "paths::a_host_that_starts_without_an_address_waits_for_one";
    seeds::run(test, 0..100, |seed| {
        let mut sim = Sim::new(Setup::lan(seed, 2, 0.0));
        sim.plug(1, 0, false);
        sim.start(1, 2);
        let item = sim.announce(0, "gps");
        sim.write(0, &item, 200);
        sim.subscribe(1, &item, Contract::default());
        sim.run_for(secs(30));
        sim.write(0, &item, 200);
        ensure(sim.host(1).held(&item).is_none(), || {
            "it has no address".to_owned()
        })?;
        sim.plug(1, 0, true);
        let reads = sim.run_until(FLOWS_WITHIN, |sim| sim.host(1).held(&item).is_some());
        ensure(reads, || "nothing came with the address".to_owned())?;
        check(&sim)
    });
}

#[test]
fn a_second_address_costs_little_while_nobody_reads() {
    let test = "paths::a_second_address_costs_little_while_nobody_reads";
    seeds::run(test, 0..3, |seed| {
        let hosts = 10;
        let mut sim = Sim::new(Setup {
            networks: 2,
            ..Setup::lan(seed, hosts, 0.0)
        });
        for host in 0..hosts {
            for item in 0..10 {
                sim.announce(host, &format!("item{item}"));
            }
        }
        sim.run_for(secs(20));
        let before = sim.sent_bytes;
        sim.run_for(secs(60));
        let rate = (sim.sent_bytes - before) / 60 / 10;
        println!(
            "{hosts} idle hosts on two networks: {rate} B/s sent by each, without UDP and IP headers"
        );
        let up = (0..hosts).all(|host| {
            let known = sim.host(host).catalog.as_ref().map(|c| c.hosts());
            known.is_some_and(|all| all.iter().all(|h| h.state == HostState::Up))
        });
        ensure(up && rate <= 600, || {
            format!("{rate} B/s for each host, all up: {up}")
        })
    });
}
