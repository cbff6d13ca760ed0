//! The books balance: on each hop the fates of samples add up to their numbers, the hops agree with one another, and a reader
//! is told what became of each sample that it did not get, over random hosts, contracts, samples and faults.

use std::collections::BTreeSet;
use std::time::Duration;

use ddx_catalog::delivery::{Books, SentBooks, Via};
use ddx_rig::link::Profile;
use ddx_rig::sim::{Host, Link, Random, Setup, Sim, Told};
use ddx_wire::{Contract, Delivery, ItemName, Priority, Seq};

use super::fleet::{Fleet, Source};
use super::{check, ensure, millis, secs, seeds};

/// A scenario on its way.
struct Play {
    random: Random,
    fleet: Fleet,
    networks: usize,
    link: Link,
    /// A few, so that readers share streams.
    contracts: [Contract; 3],
    /// Readers that have wanted each sample since they were opened.
    every: BTreeSet<(usize, ItemName)>,
    /// No fault happens and no datagram is lost.
    calm: bool,
    /// No datagram is lost, but hosts and writers come and go.
    whole: bool,
    /// Some links are slow.
    limited: bool,
}

#[test]
fn on_each_hop_the_fates_of_samples_add_up_and_readers_are_told_them() {
    let test = "books::on_each_hop_the_fates_of_samples_add_up_and_readers_are_told_them";
    seeds::run(test, 0..seeds::count(300), |seed| {
        let mut play = Play::new(seed);
        play.run()
            .map_err(|text| format!("{}: {text}", play.describe()))
    });
}

impl Play {
    fn new(seed: u64) -> Self {
        let mut random = Random::new(seed ^ 0xb00c_0000);
        let hosts = 2 + random.index(5);
        let networks = 1 + random.index(2);
        let loss = random.pick(&[0.0, 0.0, 0.0, 0.02, 0.1, 0.3]);
        let calm = loss == 0.0 && random.chance(0.5);
        let whole = loss == 0.0 && (calm || random.chance(0.5));
        let chaos = |random: &mut Random, most: &[u64]| {
            let micros = if whole { 0 } else { random.pick(most) };
            Duration::from_micros(micros)
        };
        let link = Link {
            loss,
            duplicates: if calm {
                0.0
            } else {
                random.pick(&[0.0, 0.02, 0.2])
            },
            delay: Duration::from_micros(random.below(4_000)),
            // The first sample of a writer may overtake the last of the one before.
            jitter: chaos(&mut random, &[0, 300, 4_000, 12_000]),
        };
        let mut sim = Sim::new(Setup {
            seed,
            hosts,
            link,
            networks,
            beacon: random.chance(0.7),
            multicast: true,
            drift_ppm: u32::try_from(random.below(100)).unwrap(),
            lag: chaos(&mut random, &[0, 200, 1_500]),
        });
        let limited = !whole && loss < 0.05 && random.chance(0.4);
        if limited {
            for host in 0..hosts {
                let profile = random.pick(&[
                    "wifi-good",
                    "wifi-multicast-broken",
                    "lte --delay \"15 ms\"",
                    "lan --rate \"5 Mbit/s\" --loss 10%",
                    "lan --rate \"2 Mbit/s\" --delay \"20 ms\"",
                ]);
                let profile = Profile::parse(&format!("{profile} --seed {seed}")).unwrap();
                sim.set_profile(host, random.index(networks), &profile);
            }
        }
        let mut play = Self {
            fleet: Fleet::new(sim, hosts),
            networks,
            link,
            contracts: [
                contract(&mut random),
                contract(&mut random),
                contract(&mut random),
            ],
            every: BTreeSet::new(),
            calm,
            whole,
            limited,
            random,
        };
        for _ in 0..2 + play.random.below(4) {
            play.add_source();
        }
        for _ in 0..hosts + 2 {
            play.change_reader();
        }
        play
    }

    fn add_source(&mut self) {
        let host = self.random.index(self.fleet.on.len());
        let rest = format!("i{}", self.fleet.sources.len());
        let name = self.fleet.sim.announce(host, &rest);
        let most = self.random.pick(&[48, 1_100, 1_300, 8_000, 30_000]);
        let mut len = || 48 + self.random.index(most);
        let lens = vec![len(), len(), len()];
        let least = if most > 4_000 { 60 } else { 4 };
        self.fleet.sources.push(Source {
            host,
            rest,
            name,
            period: millis(least + self.random.below(100)),
            lens,
            next: self.fleet.sim.now(),
        });
    }

    fn run(&mut self) -> Result<(), String> {
        self.run_for(secs(3))?;
        for _ in 0..3 + self.random.below(5) {
            if !self.calm {
                self.disturb();
            }
            if self.random.chance(0.3) {
                self.change_reader();
            }
            let span = millis(20 + self.random.below(700));
            self.run_for(span)?;
        }
        self.repair();
        self.run_for(secs(4))?;
        // What is lost at last is repeated, and what lacks is repaired or given up: after 5 s, or 16 round trips.
        self.fleet.sim.run_for(secs(9));
        for writer in 0..self.fleet.on.len() {
            self.balanced(writer)?;
        }
        for reader in 0..self.fleet.on.len() {
            self.told(reader)?;
        }
        check(&self.fleet.sim)
    }

    /// Lets time pass while programs write. The books of each moment balance.
    fn run_for(&mut self, span: Duration) -> Result<(), String> {
        let end = self.fleet.sim.now() + span;
        while let Some(source) = self.fleet.next_write(end) {
            let Source {
                host, name, lens, ..
            } = &self.fleet.sources[source];
            let len = self.random.pick(lens);
            self.fleet.sim.write(*host, name, len);
            accounted(&self.fleet.sim, *host)?;
        }
        Ok(())
    }

    /// Some host opens, changes or closes a reader.
    fn change_reader(&mut self) {
        let reader = self.random.index(self.fleet.on.len());
        let source = self.random.index(self.fleet.sources.len());
        let (host, name) = (
            self.fleet.sources[source].host,
            self.fleet.sources[source].name.clone(),
        );
        if host == reader || !self.fleet.on[reader] {
            return;
        }
        let is_open = self.fleet.sim.host(reader).wanted.contains_key(&name);
        let at = (reader, name.clone());
        if self.random.chance(0.8) {
            let contract = self.random.pick(&self.contracts);
            match contract.delivery {
                Delivery::Latest => self.every.remove(&at),
                Delivery::Every | Delivery::EveryFromRing => !is_open && self.every.insert(at),
            };
            self.fleet.sim.subscribe(reader, &name, contract);
        } else {
            self.every.remove(&at);
            self.fleet.sim.unsubscribe(reader, &name);
        }
    }

    fn disturb(&mut self) {
        let (host, network) = (
            self.random.index(self.fleet.on.len()),
            self.random.index(self.networks),
        );
        let fault = match self.random.below(10) {
            // Of these no datagram is lost.
            _ if self.whole => self.random.pick(&[0, 1, 1, 5, 5, 9]),
            fault => fault,
        };
        match fault {
            0 if self.fleet.on[host] => {
                self.every.retain(|(reader, _)| *reader != host);
                self.fleet.kill(host);
            }
            0 | 1 => self.restart(host),
            2 => self.fleet.cut(&mut self.random),
            3 => self.fleet.sim.heal(),
            4 => self.fleet.sim.host_mut(host).hears_groups ^= true,
            5 => {
                let source = self.random.index(self.fleet.sources.len());
                self.fleet.replace_writer(source);
            }
            6 if self.networks > 1 => {
                let silent = self.random.chance(0.5);
                self.fleet.sim.silence(host, network, silent);
            }
            7 => {
                let loss = self.random.pick(&[0.0, 0.05, 0.3]);
                let link = Link { loss, ..self.link };
                self.fleet.sim.set_link(link);
            }
            _ => {}
        }
    }

    /// The readers of a host go with its life.
    fn restart(&mut self, host: usize) {
        self.every.retain(|(reader, _)| *reader != host);
        self.fleet.restart(host);
    }

    /// Undoes all disturbances but deaf networks, which are none.
    fn repair(&mut self) {
        self.fleet.repair();
        for host in 0..self.fleet.on.len() {
            for network in 0..self.networks {
                self.fleet.sim.silence(host, network, false);
            }
        }
        for _ in 0..self.fleet.on.len() {
            self.change_reader();
        }
    }

    /// At rest: what a host sends, before and behind each way, and what its readers say of the same way.
    fn balanced(&self, writer: usize) -> Result<(), String> {
        accounted(&self.fleet.sim, writer)?;
        let host = self.fleet.sim.host(writer);
        let tag = host.catalog.as_ref().unwrap().tag();
        let sources = host.source_books();
        for (id, to, sent) in host.sent_books() {
            let Some((name, route)) = host.open.get(&id) else {
                continue;
            };
            let place = || format!("host {writer}, `{name}` to {to}, {}", route.contract);
            // What is too old to be sent may be left where it is until the next comes.
            let may_wait = route.contract.max_age_ms.is_some();
            ensure(!sent.waiting || may_wait, || {
                format!("{}: waits at rest", place())
            })?;
            let source = sources.iter().find(|(other, _)| *other == id);
            let source = source.map(|(_, books)| *books).unwrap_or_default();
            let is_latest = route.contract.delivery == Delivery::Latest;
            if is_latest && sent.expected == source.expected {
                // One that a new reader got at once may be one that the rate leaves out for the others.
                let kept = source.expected - source.delivered;
                let is_limited = route.contract.interval_ns() > 0;
                ensure(
                    sent.filtered == kept || (is_limited && sent.filtered < kept),
                    || format!("{}: {sent:?} and at the source {source:?}", place()),
                )?;
            }
            // A reader that was served this way alone, and saw all of it.
            let by = |via: Via, addr| match via {
                Via::Unicast => addr == to,
                Via::Group(group) => group == to,
                Via::Both(_) => false,
            };
            let ways = host.sent_books();
            let ways = ways
                .iter()
                .filter(|(other, _, b)| *other == id && b.expected > 0);
            if ways.count() != 1 {
                continue;
            }
            for reader in route.readers.iter().filter(|r| by(r.via, r.addr)) {
                let hosts = (0..self.fleet.on.len()).map(|index| self.fleet.sim.host(index));
                let is_reader = |host: &&Host| {
                    let catalog = host.catalog.as_ref();
                    catalog.is_some_and(|catalog| catalog.tag() == reader.tag)
                };
                let reader = hosts.into_iter().find(is_reader);
                let got = reader.and_then(|host| host.books_of(tag, id));
                let told = reader.and_then(|host| host.told(name));
                let told = told.filter(|(told, _)| told.lives == 1);
                let all = told.map(|(_, all)| all);
                // Where another stream came before, or another life, they count from another sample on.
                if let Some(got) = got.filter(|got| Some(*got) == all)
                    && got.expected == sent.expected
                {
                    agree(&sent, &got, &route.contract)
                        .map_err(|text| format!("{}: {text}", place()))?;
                }
            }
        }
        Ok(())
    }

    /// At rest: what the readers of a host were told.
    fn told(&self, reader: usize) -> Result<(), String> {
        let host = self.fleet.sim.host(reader);
        for (name, contract) in &host.wanted {
            let source = self.fleet.sources.iter().find(|s| s.name == *name).unwrap();
            let newest = self.fleet.sim.host(source.host).newest(name);
            let Some((told, books)) = host.told(name).filter(|(told, _)| told.delivered > 0) else {
                continue;
            };
            let place =
                || format!("host {reader} reads `{name}`, {contract}: told {told:?}, {books:?}");
            let is_every = self.every.contains(&(reader, name.clone()));
            // Under a greatest age the last may be kept back.
            if contract.max_age_ms.is_none() && contract.interval_ns() == 0 {
                ensure(host.held(name) == newest, || {
                    format!("{}: {:?} held of {newest:?}", place(), host.held(name))
                })?;
            }
            adds_up(&told, &books).map_err(|text| format!("{}: {text}", place()))?;
            let (epoch, Seq(last)) = newest.unwrap_or_default();
            if host.held(name) == newest && told.first.0 == epoch {
                let written = last + 1 - told.first.1.0;
                ensure(told.expected == written, || {
                    format!("{}: of {written} written", place())
                })?;
            }
            // What is lost is asked for, until there is another ring; on a slow link its reader gives up in the end.
            let is_repaired = is_every && !self.limited && told.first.0 == epoch;
            if self.whole || is_repaired {
                ensure(told.lost == 0, || format!("{}: lost", place()))?;
            }
            ensure(told.lives > 1 || told.stale == 0, || {
                format!("{}: brought twice", place())
            })?;
        }
        Ok(())
    }

    fn describe(&self) -> String {
        format!(
            "{} hosts on {} networks, {:?}, calm {}, whole {}, limited {}, at {:?}",
            self.fleet.on.len(),
            self.networks,
            self.link,
            self.calm,
            self.whole,
            self.limited,
            self.fleet.sim.now()
        )
    }
}

/// Anything that a reader may ask.
fn contract(random: &mut Random) -> Contract {
    let delivery = [Delivery::Latest, Delivery::Every, Delivery::EveryFromRing];
    let priority = [
        Priority::Background,
        Priority::Low,
        Priority::Normal,
        Priority::High,
        Priority::Command,
    ];
    Contract {
        max_rate_mhz: random.pick(&[None, None, Some(2_000), Some(15_000)]),
        max_age_ms: random.pick(&[None, None, None, Some(3), Some(40), Some(400)]),
        delivery: random.pick(&delivery),
        priority: random.pick(&priority),
    }
}

/// At any moment: each of the books of what a host sends adds up.
fn accounted(sim: &Sim, host: usize) -> Result<(), String> {
    for (id, books) in sim.host(host).source_books() {
        ensure(books.accounted() == books.expected, || {
            format!("host {host}, source of {id:?}: {books:?}")
        })?;
    }
    for (id, to, books) in sim.host(host).sent_books() {
        ensure(books.accounted() == books.expected, || {
            format!("host {host}, {id:?} to {to}: {books:?}")
        })?;
    }
    Ok(())
}

/// The two ends of a link, about the same samples: what left arrived, or was lost; what did not leave is known there.
fn agree(sent: &SentBooks, got: &Books, contract: &Contract) -> Result<(), String> {
    let text = || format!("sent {sent:?}, got {got:?}");
    let kept = sent.filtered + sent.queue_dropped + sent.expired + sent.overwritten;
    let (gone, arrived) = (got.overwritten + got.filtered, got.delivered + lost(got));
    let as_told = if contract.delivery != Delivery::Latest {
        // What was sent and lost may be gone, or too old, before it is asked for again; and after some seconds a reader that
        // was not told gives up.
        gone >= kept || got.link_lost > 0
    } else if contract.interval_ns() > 0 {
        // What a new reader got out of turn may be one that the rate leaves out, as it is told if that is lost.
        gone >= kept
    } else {
        gone == kept
    };
    ensure(as_told, text)?;
    ensure(gone + arrived == kept + sent.delivered, text)
}

/// What a reader was told, and what the streams that brought it counted.
fn adds_up(told: &Told, books: &Books) -> Result<(), String> {
    let all = told.delivered + told.overwritten + told.filtered + told.lost;
    ensure(all == told.expected, || "does not add up".to_owned())?;
    // A life that comes later begins with what it had when it was asked.
    let same = told.lives == 1 && told.stale == 0;
    let of_books = [books.expected, books.delivered, books.overwritten];
    let of_told = [told.expected, told.delivered, told.overwritten];
    // What it was told to be left out may have been sent, and come late.
    let late = told.filtered.checked_sub(books.filtered);
    let alike = of_books == of_told && late.is_some_and(|late| late <= books.late);
    ensure(!same || alike, || "is not what the link counted".to_owned())
}

/// What did not reach a reader in time, for whatever reason.
fn lost(books: &Books) -> u64 {
    books.late + books.link_lost + books.expired + books.over_budget + books.undecodable
}
