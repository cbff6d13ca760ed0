//! Whatever a seed thinks up: hosts, items, readers, links, cuts, restarts; each sample is judged as it passes.

use std::collections::BTreeSet;
use std::time::Duration;

use ddx_rig::link::Profile;
use ddx_rig::sim::{Link, Random, Setup, Sim};
use ddx_wire::{Contract, ItemName};

use super::fleet::{Fleet, Source};
use super::{check, ensure, millis, secs, seeds};

/// A scenario on its way.
struct Play {
    seed: u64,
    random: Random,
    fleet: Fleet,
    loss: f64,
    /// What the slowest link carries, bits per second, where links are limited at all.
    rate: Option<u64>,
    /// Nothing but writing and reading: counts are exact.
    calm: bool,
}

#[test]
fn promises_hold_whatever_happens() {
    let test = "chance::promises_hold_whatever_happens";
    seeds::run(test, 0..seeds::count(1_000), play);
}

fn play(seed: u64) -> Result<(), String> {
    let mut play = Play::new(seed);
    play.run_for(secs(3));
    let steps = 8 + play.random.below(12);
    for _ in 0..steps {
        if !play.calm {
            play.disturb();
        }
        play.change_reader();
        let span = millis(20 + play.random.below(900));
        play.run_for(span);
    }
    play.repair();
    play.run_for(secs(6));
    play.ends_with_the_newest("after the last write")?;
    play.exact()?;
    if !play.calm {
        play.fleet.cut(&mut play.random);
        let span = millis(200 + play.random.below(13_000));
        play.run_for(span);
        play.fleet.sim.heal();
        // Hosts that lost each other meet anew first: at high loss that takes several tries.
        play.fleet.sim.run_for(if play.loss > 0.1 {
            secs(5)
        } else {
            Duration::ZERO
        });
        play.ends_with_the_newest("after the heal")?;
    }
    play.silence()?;
    check(&play.fleet.sim).map_err(|text| format!("{}: {text}", play.describe()))
}

impl Play {
    fn new(seed: u64) -> Self {
        let mut random = Random::new(seed ^ 0xc0ff_ee00);
        let hosts = 2 + random.index(4);
        let loss = random.pick(&[0.0, 0.0, 0.02, 0.1, 0.2, 0.33]);
        let calm = loss == 0.0 && random.chance(0.6);
        let link = Link {
            loss,
            duplicates: if calm {
                0.0
            } else {
                random.pick(&[0.0, 0.02, 0.2])
            },
            delay: Duration::from_micros(random.below(4_000)),
            // What is overtaken while its path changes counts as lost.
            jitter: if calm {
                Duration::ZERO
            } else {
                Duration::from_micros(random.pick(&[0, 300, 4_000, 12_000]))
            },
        };
        let setup = Setup {
            seed,
            hosts,
            link,
            networks: 1,
            beacon: random.chance(0.7),
            multicast: true,
            drift_ppm: u32::try_from(random.below(100)).unwrap(),
            lag: if calm {
                Duration::ZERO
            } else {
                Duration::from_micros(random.below(1_500))
            },
        };
        let mut sim = Sim::new(setup);
        let rate = (!calm && loss < 0.05 && random.chance(0.4))
            .then(|| Self::limit_links(&mut sim, hosts, seed, &mut random));
        let mut play = Self {
            seed,
            fleet: Fleet::new(sim, hosts),
            loss,
            rate,
            calm,
            random,
        };
        for host in 0..hosts {
            for item in 0..1 + play.random.below(3) {
                let rest = format!("i{item}");
                let name = play.fleet.sim.announce(host, &rest);
                let period = millis(play.random.pick(&[5, 20, 50, 110, 700]));
                let len = play
                    .random
                    .pick(&[48, 200, 1_100, 1_200, 5_000, 5_000, 40_000]);
                play.fleet.sources.push(Source {
                    host,
                    rest,
                    name,
                    period: if len > 10_000 {
                        period.max(millis(100))
                    } else {
                        period
                    },
                    lens: vec![len],
                    next: play.fleet.sim.now(),
                });
            }
        }
        for _ in 0..hosts * 3 {
            play.change_reader();
        }
        play
    }

    /// Gives each host a link that is limited, or bursty, or both. Returns the rate of the slowest.
    fn limit_links(sim: &mut Sim, hosts: usize, seed: u64, random: &mut Random) -> u64 {
        let mut least = u64::MAX;
        for host in 0..hosts {
            let (mbit, profile) = random.pick(&[
                (50, "wifi-good"),
                (10, "wifi-bad --delay \"5 ms\" --jitter \"5 ms\""),
                (50, "wifi-multicast-broken"),
                (3, "lte --delay \"15 ms\""),
                (5, "lan --rate \"5 Mbit/s\" --loss 10%"),
                (2, "lan --rate \"2 Mbit/s\" --delay \"20 ms\""),
            ]);
            least = least.min(mbit * 1_000_000);
            let profile = Profile::parse(&format!("{profile} --seed {seed}")).unwrap();
            sim.set_profile(host, 0, &profile);
        }
        least
    }

    /// How long the newest of all that is read takes on the slowest link, of which a path that shares it with others has
    /// an eighth at worst.
    fn crossing(&self) -> Duration {
        let Some(rate) = self.rate else {
            return Duration::ZERO;
        };
        let wanted =
            (0..self.fleet.on.len()).flat_map(|reader| self.fleet.sim.host(reader).wanted.keys());
        let lens = wanted.filter_map(|name| {
            let source = self
                .fleet
                .sources
                .iter()
                .find(|source| source.name == *name);
            source.map(|source| source.lens[0])
        });
        let bits = u64::try_from(lens.sum::<usize>() * 8).unwrap();
        millis(8 * bits * 1_000 / rate)
    }

    fn describe(&self) -> String {
        format!(
            "{} hosts, loss {}, rate {:?}, calm {}, at {:?}",
            self.fleet.on.len(),
            self.loss,
            self.rate,
            self.calm,
            self.fleet.sim.now()
        )
    }

    /// Lets time pass while programs write.
    fn run_for(&mut self, span: Duration) {
        let end = self.fleet.sim.now() + span;
        while let Some(source) = self.fleet.next_write(end) {
            let Source {
                host, name, lens, ..
            } = &self.fleet.sources[source];
            self.fleet.sim.write(*host, name, lens[0]);
        }
    }

    fn contract(&mut self) -> Contract {
        let rate = self.random.pick(&[0.0, 0.0, 0.0, 1.0, 7.0, 30.0]);
        Contract::at_most_hz(rate).unwrap_or_default()
    }

    /// Some host opens, changes or closes a reader.
    fn change_reader(&mut self) {
        let reader = self.random.index(self.fleet.on.len());
        let source = self.random.index(self.fleet.sources.len());
        let source = &self.fleet.sources[source];
        let name = source.name.clone();
        if source.host == reader {
            return;
        }
        if self.random.chance(0.75) {
            let contract = self.contract();
            self.fleet.sim.subscribe(reader, &name, contract);
        } else {
            self.fleet.sim.unsubscribe(reader, &name);
        }
    }

    fn disturb(&mut self) {
        let host = self.random.index(self.fleet.on.len());
        match self.random.below(9) {
            0 if self.fleet.on[host] => self.fleet.kill(host),
            0 | 1 => self.fleet.restart(host),
            2 => self.fleet.cut(&mut self.random),
            3 | 4 => self.fleet.sim.heal(),
            5 => self.fleet.sim.host_mut(host).hears_groups ^= true,
            6 => {
                let source = self.random.index(self.fleet.sources.len());
                let Source {
                    host, name, lens, ..
                } = &self.fleet.sources[source];
                // The last of one writer and the first of the next may overtake each other.
                self.fleet.sim.write(*host, name, lens[0]);
                self.fleet.replace_writer(source);
                self.fleet.sources[source].next = self.fleet.sim.now();
            }
            7 => {
                let source = self.random.index(self.fleet.sources.len());
                let Source { host, name, .. } = &self.fleet.sources[source];
                self.fleet.sim.withdraw(*host, name);
            }
            _ => {}
        }
    }

    /// Undoes all disturbances but deaf networks, which are none.
    fn repair(&mut self) {
        self.fleet.repair();
        for source in 0..self.fleet.sources.len() {
            let Source { host, name, .. } = &self.fleet.sources[source];
            if self.fleet.sim.host(*host).newest(name).is_none() {
                self.fleet.replace_writer(source);
            }
        }
        for _ in 0..self.fleet.on.len() {
            self.change_reader();
        }
    }

    /// One second after now, without writes, every reader holds the newest value. Where links are limited, a path that
    /// had little of one first finds that it is alone there now, and the value takes its time to cross.
    fn ends_with_the_newest(&mut self, when: &str) -> Result<(), String> {
        let start = self.fleet.sim.now();
        let found = self.rate.map_or(Duration::ZERO, |_| secs(1));
        self.fleet.sim.run_for(secs(1) + found + self.crossing());
        for reader in 0..self.fleet.on.len() {
            for (name, contract) in &self.fleet.sim.host(reader).wanted {
                let mut sources = self.fleet.sources.iter();
                let Source { host, lens, .. } = sources.find(|s| s.name == *name).unwrap();
                let newest = self.fleet.sim.host(*host).newest(name);
                let held = self.fleet.sim.host(reader).held(name);
                // Under a contract the newest may have to wait for its turn.
                if held != newest && contract.max_rate_mhz.is_none_or(|mhz| mhz > 5_000) {
                    return Err(format!(
                        "{}: host {reader} holds {held:?} of `{name}`, {lens:?} bytes, {when} at {start:?}, which is at {newest:?}",
                        self.describe()
                    ));
                }
            }
        }
        Ok(())
    }

    /// Without loss nothing is lost, and nothing but first values is repeated.
    fn exact(&self) -> Result<(), String> {
        if !self.calm {
            return Ok(());
        }
        for index in 0..self.fleet.on.len() {
            let host = self.fleet.sim.host(index);
            let lost = host.link_lost();
            ensure(lost == 0, || format!("{}: {lost} lost", self.describe()))?;
        }
        Ok(())
    }

    /// When the last reader closes, sending ends.
    fn silence(&mut self) -> Result<(), String> {
        for reader in 0..self.fleet.on.len() {
            let names: BTreeSet<ItemName> =
                self.fleet.sim.host(reader).wanted.keys().cloned().collect();
            for name in names {
                self.fleet.sim.unsubscribe(reader, &name);
            }
        }
        // Without loss a goodbye arrives; else it is said three times, and the lease ends what nobody heard.
        let limit = if self.loss == 0.0 && self.rate.is_none() {
            millis(100)
        } else {
            millis(3_400)
        };
        self.fleet.sim.run_for(limit);
        let before: u64 = (0..self.fleet.on.len())
            .map(|i| self.fleet.sim.host(i).sent().datagrams)
            .sum();
        self.run_for(secs(1));
        let after: u64 = (0..self.fleet.on.len())
            .map(|i| self.fleet.sim.host(i).sent().datagrams)
            .sum();
        ensure(before == after, || {
            format!(
                "{}: {} data datagrams for nobody (seed {})",
                self.describe(),
                after - before,
                self.seed
            )
        })
    }
}
