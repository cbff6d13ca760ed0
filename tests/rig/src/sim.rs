//! A domain of many hosts in one thread under virtual time: all pure machines are real, what lies between them is not.
//!
//! Everything is a function of the seed. Each host has a boot clock with its own start and drift, a model store, and the
//! real control plane, sender and receiver, driven as the daemon drives them. Datagrams, which are sealed as in earnest,
//! pass a [line](crate::link) to each receiver, a multicast to each member by itself, and are cut off by partitions; a
//! host with a [profile](crate::link::Profile) has a line of its own for what it sends, too.
//! Promises that must hold at every sample are checked as it passes, and [`Sim::broken`] lists those that did not.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BinaryHeap};
use std::net::SocketAddr;
use std::time::Duration;

use ddx_catalog::{Catalog, Config, Dest, Event};
use ddx_wire::seal::MAX_DATAGRAM_BYTES;
use ddx_wire::{
    Contract, DomainId, Epoch, HostId, HostName, Incarnation, ItemName, Seq, Tag, Time,
};

use crate::link::{Books, Class, Profile};

mod host;
mod net;
mod networks;
mod rx;
mod store;
mod tx;

pub use crate::random::Random;
pub use host::Host;
use host::HostClock;
pub use net::Link;
use net::{CONTROL_PORT, DATA_PORT, Net, Target, Way};
use networks::Networks;
pub use rx::Told;
pub use tx::Counts;

/// A lease lasts three seconds and is looked at four times a second; the rest is for queues and slow clocks.
const LEASE_AT_MOST: Duration = Duration::from_millis(3_300);

/// What a simulation is made of.
#[derive(Clone, Debug)]
pub struct Setup {
    /// Decides everything that is left to chance.
    pub seed: u64,
    /// Number of hosts.
    pub hosts: usize,
    /// The network.
    pub link: Link,
    /// How many such networks there are; each host has an address on each.
    pub networks: usize,
    /// Whether beacons reach everybody; else all hosts have the first as a seed.
    pub beacon: bool,
    /// Whether samples may travel by multicast.
    pub multicast: bool,
    /// Greatest drift of a clock, parts per million, either way.
    pub drift_ppm: u32,
    /// How long an order or a notice waits between two threads of a host, at most.
    pub lag: Duration,
}

/// The simulation.
pub struct Sim {
    setup: Setup,
    now: u64,
    random: Random,
    count: u64,
    queue: BinaryHeap<Reverse<(u64, u64, Action)>>,
    net: Net,
    networks: Networks,
    hosts: Vec<Host>,
    tags: BTreeMap<Tag, usize>,
    interest: BTreeMap<ItemName, Interest>,
    /// What became of hosts, as each host saw it, with the time.
    pub log: Vec<(Duration, usize, Event)>,
    /// Promises that were broken, with the time and the host.
    pub broken: Vec<(Duration, usize, String)>,
    /// Datagrams that were handed to hosts.
    pub delivered: u64,
    /// Bytes of all control datagrams that hosts sent; a beacon counts once.
    pub sent_bytes: u64,
    /// Clock estimates that did not contain the truth.
    pub clock_errors: u64,
    /// Clock estimates in all.
    pub clock_estimates: u64,
}

/// Who reads an item, in truth.
#[derive(Default)]
struct Interest {
    readers: usize,
    ended: u64,
}

#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Action {
    Wake(usize),
    /// A datagram has left its sender's line and goes to whoever it is for.
    Switch {
        from: usize,
        network: usize,
        to: Target,
        bytes: Vec<u8>,
    },
    Deliver {
        to: usize,
        from: usize,
        network: usize,
        way: Way,
        bytes: Vec<u8>,
    },
}

impl Setup {
    /// Hosts on a local network, met by beacon, with the drift of ordinary crystals.
    pub fn lan(seed: u64, hosts: usize, loss: f64) -> Self {
        Self {
            seed,
            hosts,
            link: Link::lan(loss),
            networks: 1,
            beacon: true,
            multicast: true,
            drift_ppm: 90,
            lag: Duration::ZERO,
        }
    }
}

impl Sim {
    /// Starts all hosts within the first ten milliseconds.
    pub fn new(setup: Setup) -> Self {
        let mut random = Random::new(setup.seed);
        let chance = Random::new(random.next());
        let net = Net::new(setup.link, chance, setup.hosts, setup.networks);
        let networks = Networks::new(setup.hosts, setup.networks);
        let mut hosts = Vec::new();
        for index in 0..setup.hosts {
            let name = HostName::parse(&format!("h{index}")).expect("letter and digits are a name");
            let id = HostId((u128::try_from(index).unwrap_or(0) + 1).to_be_bytes());
            let spread = u64::from(setup.drift_ppm) * 2 + 1;
            let drift = i64::try_from(random.below(spread)).unwrap_or(0);
            let clock = HostClock {
                start: random.below(1_000_000_000_000_000),
                drift_ppm: drift - i64::from(setup.drift_ppm),
            };
            hosts.push(Host::new(name, id, clock));
        }
        let mut sim = Self {
            setup,
            now: 0,
            random,
            count: 0,
            queue: BinaryHeap::new(),
            net,
            networks,
            hosts,
            tags: BTreeMap::new(),
            interest: BTreeMap::new(),
            log: Vec::new(),
            broken: Vec::new(),
            delivered: 0,
            sent_bytes: 0,
            clock_errors: 0,
            clock_estimates: 0,
        };
        for index in 0..sim.setup.hosts {
            sim.start(index, 1);
        }
        sim
    }

    /// Starts a host anew, with an empty store, as a life with this ordinal.
    pub fn start(&mut self, index: usize, ordinal: u32) {
        self.kill(index);
        let (random, seed) = (self.random.next(), self.random.next());
        let host = &mut self.hosts[index];
        let now = host.clock.moment(self.now);
        let seeds = if self.setup.beacon || index == 0 {
            Vec::new()
        } else {
            self.networks.addresses(0, CONTROL_PORT)
        };
        let config = Config {
            domain: DomainId(3),
            host: host.name.clone(),
            id: host.id,
            incarnation: Incarnation { ordinal, random },
            key: host::key(),
            control_addrs: self.networks.addresses(index, CONTROL_PORT),
            data_port: DATA_PORT,
            seeds,
            beacon: self.setup.beacon,
            multicast: self.setup.multicast,
            prefix_since: now.local,
        };
        self.tags
            .insert(Tag::of(config.id, config.incarnation), index);
        host.start(config, self.setup.lag, seed, now);
        let late = self.random.below(10_000_000);
        self.push(self.now + late, Action::Wake(index));
    }

    /// Gives a host another name. Only before its next start does that mean anything to others.
    pub fn rename(&mut self, index: usize, name: &str) {
        self.hosts[index].name = HostName::parse(name).expect("the caller passes a host name");
    }

    /// Switches a host off, without a word. What its programs read is over.
    pub fn kill(&mut self, index: usize) {
        let wanted: Vec<ItemName> = self.hosts[index].wanted.keys().cloned().collect();
        for name in wanted {
            self.reader_left(&name);
        }
        self.hosts[index].stop();
        self.collect(index);
    }

    /// One host.
    pub fn host(&self, index: usize) -> &Host {
        &self.hosts[index]
    }

    /// One host, to change it.
    pub fn host_mut(&mut self, index: usize) -> &mut Host {
        &mut self.hosts[index]
    }

    /// Virtual time since the start.
    pub fn now(&self) -> Duration {
        Duration::from_nanos(self.now)
    }

    /// What the clock of a host shows.
    pub fn local(&self, index: usize) -> Time {
        self.hosts[index].clock.at(self.now)
    }

    /// Splits the network: hosts hear each other only within one group.
    pub fn cut(&mut self, group_of: impl Fn(usize) -> usize) {
        self.net.cut(group_of);
    }

    /// Ends a split.
    pub fn heal(&mut self) {
        self.net.cut(|_| 0);
    }

    /// Lets nothing pass on the link of a host to a network, or lets it pass again. The host is not told.
    pub fn silence(&mut self, index: usize, network: usize, silent: bool) {
        self.networks.silence(index, network, silent);
    }

    /// Takes a host from a network, or back, as when its interface goes down or up.
    pub fn plug(&mut self, index: usize, network: usize, plugged: bool) {
        self.networks.plug(index, network, plugged);
        self.tell_addresses(index);
    }

    /// Gives a host another address on a network.
    pub fn readdress(&mut self, index: usize, network: usize) {
        self.networks.readdress(index, network);
        self.tell_addresses(index);
    }

    fn tell_addresses(&mut self, index: usize) {
        let addresses = self.networks.addresses(index, CONTROL_PORT);
        self.command(index, |catalog, now| {
            catalog.set_control_addrs(&addresses, now);
        });
    }

    /// The network on which a host sends to another now.
    pub fn network(&self, from: usize, to: usize) -> Option<usize> {
        let hosts = self.hosts[from].catalog.as_ref()?.hosts();
        let peer = hosts.iter().find(|host| host.host == self.hosts[to].id)?;
        Some(self.networks.resolve(peer.addr)?.1)
    }

    /// Changes all networks for datagrams that are sent from now on, also for hosts with a profile.
    pub fn set_link(&mut self, link: Link) {
        self.net.set_all(link);
    }

    /// Gives a host a link of its own to a network, up and down, for datagrams that are sent from now on.
    ///
    /// The same profile means the same drops, as in the laboratory.
    pub fn set_profile(&mut self, index: usize, network: usize, profile: &Profile) {
        self.net.set(index, network, profile);
    }

    /// What became of datagrams on a host's link to a network; up counts since it has a profile.
    pub fn books(&self, index: usize, network: usize) -> Books {
        self.net.books(index, network)
    }

    /// How long a datagram that arrives now at a host's link to a network waits for the transmitter.
    pub fn backlog(&self, index: usize, network: usize) -> Duration {
        self.net.backlog(index, network, self.now())
    }

    /// Opens a writer of an item under a host's prefix: a new item, or a new epoch of one that is there.
    pub fn announce(&mut self, index: usize, rest: &str) -> ItemName {
        let name = ItemName::parse(&format!("./{rest}"), &self.hosts[index].name)
            .expect("the caller passes a name");
        let now = self.moment(index);
        self.hosts[index].open_writer(&name, now);
        self.settle(index);
        name
    }

    /// Removes an item of a host.
    pub fn withdraw(&mut self, index: usize, name: &ItemName) {
        if let Some(data) = &mut self.hosts[index].data {
            data.store.remove(name);
        }
        self.command(index, |catalog, now| catalog.withdraw(name, now));
    }

    /// Writes the next sample of an item, `len` bytes long unless that is too short to tell what it is.
    /// Its order; `None` when the host is off or has no such item.
    pub fn write(&mut self, index: usize, name: &ItemName, len: usize) -> Option<(Epoch, Seq)> {
        let now = self.moment(index);
        let owner = u64::try_from(index).unwrap_or(u64::MAX);
        let data = self.hosts[index].data.as_mut()?;
        let written = data.store.write(name, len, owner, now.truth, now.local);
        self.settle(index);
        written
    }

    /// Opens the first reader of an item on a host, or changes what its readers ask.
    pub fn subscribe(&mut self, index: usize, name: &ItemName, contract: Contract) {
        let now = self.moment(index);
        let host = &mut self.hosts[index];
        if host.catalog.is_some() && !host.wanted.contains_key(name) {
            self.interest.entry(name.clone()).or_default().readers += 1;
        }
        self.hosts[index].subscribe(name, contract, now);
        self.settle(index);
    }

    /// Closes the last reader of an item on a host.
    pub fn unsubscribe(&mut self, index: usize, name: &ItemName) {
        let now = self.moment(index);
        if self.hosts[index].wanted.contains_key(name) {
            self.reader_left(name);
        }
        self.hosts[index].unsubscribe(name, now);
        self.settle(index);
    }

    /// Calls a host's control plane, then does what it asks for.
    pub fn command(&mut self, index: usize, act: impl FnOnce(&mut Catalog, Time)) {
        let now = self.moment(index);
        if let Some(catalog) = &mut self.hosts[index].catalog {
            act(catalog, now.local);
        }
        self.settle(index);
    }

    /// Lets virtual time pass.
    pub fn run_for(&mut self, span: Duration) {
        let end = self.now + nanos(span);
        self.run_to(end, |_| false);
    }

    /// Lets virtual time pass until something holds, which is checked each millisecond. `false` when the deadline came first.
    pub fn run_until(&mut self, within: Duration, holds: impl Fn(&Self) -> bool) -> bool {
        let end = self.now + nanos(within);
        self.run_to(end, holds)
    }

    fn run_to(&mut self, end: u64, holds: impl Fn(&Self) -> bool) -> bool {
        let mut next_check = self.now;
        // Nothing changes between two events, but the next one may be far.
        let mut changed = true;
        loop {
            let next = self.queue.peek().map_or(u64::MAX, |next| next.0.0);
            if changed && next > next_check {
                self.now = self.now.max(next_check.min(end));
                if holds(self) {
                    return true;
                }
                (changed, next_check) = (false, self.now + 1_000_000);
            }
            let next = self.queue.peek_mut();
            let next = next.filter(|next| next.0.0 <= end);
            let Some(Reverse((at, _, action))) =
                next.map(std::collections::binary_heap::PeekMut::pop)
            else {
                self.now = end;
                return holds(self);
            };
            if !changed {
                (changed, next_check) = (true, next_check.max(at));
            }
            self.now = self.now.max(at);
            match action {
                Action::Wake(index) => self.wake(index),
                Action::Switch {
                    from,
                    network,
                    to,
                    bytes,
                } => self.switch((from, network), to, &bytes),
                Action::Deliver {
                    to,
                    from,
                    network,
                    way,
                    bytes,
                } => self.deliver(to, (from, network), way, bytes),
            }
        }
    }

    fn wake(&mut self, index: usize) {
        let now = self.moment(index);
        let host = &mut self.hosts[index];
        if host.wake <= self.now {
            host.wake = u64::MAX;
        }
        host.handle_timeout(now);
        self.settle(index);
    }

    fn deliver(
        &mut self,
        to: usize,
        (from, network): (usize, usize),
        way: Way,
        mut bytes: Vec<u8>,
    ) {
        let now = self.moment(to);
        let host = &mut self.hosts[to];
        let listens = match way {
            Way::Control | Way::Unicast => true,
            Way::Group(group) => host.hears_groups && host.joined.contains(&group),
        };
        let arrives = self.net.reaches(from, to) && self.networks.carries(to, network);
        if !listens || host.catalog.is_none() || !arrives {
            return;
        }
        self.delivered += 1;
        match way {
            Way::Control => {
                if let Some(catalog) = &mut host.catalog {
                    let addr = self.networks.address(from, network, CONTROL_PORT);
                    catalog.handle_datagram(addr, &mut bytes, now.local);
                }
            }
            Way::Unicast => host.handle_sample(&mut bytes, false, now),
            Way::Group(_) => host.handle_sample(&mut bytes, true, now),
        }
        self.settle(to);
    }

    /// Does all that a host has to do now, takes what it left, and sets its alarm.
    fn settle(&mut self, index: usize) {
        let now = self.moment(index);
        self.hosts[index].settle(now);
        self.collect(index);
        let (local, queued) = self.hosts[index].poll_timeout();
        let alarm = local.map(|at| {
            let wait = nanos(at.since(now.local));
            // A slow clock reaches the instant later than the difference says.
            self.now.saturating_add(wait + wait / 5_000)
        });
        if let Some(wake) = alarm.into_iter().chain(queued).min()
            && wake < self.hosts[index].wake
        {
            self.hosts[index].wake = wake;
            self.push(wake, Action::Wake(index));
        }
    }

    /// Carries and notes what a host left.
    fn collect(&mut self, index: usize) {
        let out = std::mem::take(&mut self.hosts[index].out);
        for (to, bytes) in out.control {
            self.sent_bytes += u64::try_from(bytes.len()).unwrap_or(0);
            match to {
                Dest::Addr(to) => self.send_to(index, to, &bytes),
                Dest::Beacon => {
                    for network in 0..self.networks.count() {
                        self.send((index, network), Target::Beacon, &bytes);
                    }
                }
            }
        }
        for (to, bytes) in out.samples {
            self.send_to(index, to, &bytes);
        }
        for (tag, offset) in out.clocks {
            let other = self.tags.get(&tag).map(|other| self.local(*other));
            if let Some(other) = other {
                let truth = i128::from(other.0) - i128::from(self.local(index).0);
                let error = truth.abs_diff(i128::from(offset.offset_ns));
                self.clock_estimates += 1;
                self.clock_errors += u64::from(error > u128::from(offset.bound_ns));
            }
        }
        let now = self.now();
        let events = out.events.into_iter().map(|event| (now, index, event));
        self.log.extend(events);
        let host = &mut self.hosts[index];
        let mut broken = std::mem::take(&mut host.broken);
        let sent = host.data.as_mut();
        for item in sent
            .map(|data| std::mem::take(&mut data.tx.sent))
            .unwrap_or_default()
        {
            let interest = self.interest.get(&item);
            let wanted = interest.is_some_and(|interest| {
                interest.readers > 0 || self.now <= interest.ended + nanos(LEASE_AT_MOST)
            });
            if !wanted {
                broken.push(format!("`{item}` was sent, and nobody reads it"));
            }
        }
        let broken = broken.into_iter().map(|text| (now, index, text));
        self.broken.extend(broken);
    }

    fn send_to(&mut self, from: usize, to: SocketAddr, bytes: &[u8]) {
        if bytes.len() > MAX_DATAGRAM_BYTES {
            let text = format!("a datagram of {} bytes to {to}", bytes.len());
            self.broken.push((self.now(), from, text));
        }
        if to.ip().is_multicast() {
            // The sender hears its own, too, if it is a member: inside of the host, where nothing is lost.
            self.push_delivery(self.now, (from, 0), from, Way::Group(to), bytes);
            for network in 0..self.networks.count() {
                self.send((from, network), Target::Group(to), bytes);
            }
        } else if let Some((first, network)) = self.networks.resolve(to)
            && let Some((to, way)) = net::socket(first)
        {
            self.send((from, network), Target::Host(to, way), bytes);
        }
    }

    fn send(&mut self, (from, network): (usize, usize), to: Target, bytes: &[u8]) {
        if !self.networks.carries(from, network) {
            return;
        }
        let now = self.now();
        let Some(line) = self.net.up(from, network) else {
            return self.switch((from, network), to, bytes);
        };
        for arrival in line.carry(net::packet_bytes(bytes), to.class(), now) {
            let action = Action::Switch {
                from,
                network,
                to,
                bytes: bytes.to_vec(),
            };
            self.push(nanos(arrival), action);
        }
    }

    fn switch(&mut self, (from, network): (usize, usize), to: Target, bytes: &[u8]) {
        let (others, way) = match to {
            Target::Host(host, way) => (host..host + 1, way),
            Target::Beacon => (0..self.hosts.len(), Way::Control),
            Target::Group(group) => (0..self.hosts.len(), Way::Group(group)),
        };
        let now = self.now();
        for other in others {
            let is_itself = other == from && to.class() == Class::Multicast;
            let carries = self.networks.carries(other, network);
            if is_itself || !carries || !self.net.reaches(from, other) {
                continue;
            }
            let line = self.net.down(other, network);
            for arrival in line.carry(net::packet_bytes(bytes), to.class(), now) {
                self.push_delivery(nanos(arrival), (from, network), other, way, bytes);
            }
        }
    }

    fn push_delivery(
        &mut self,
        at: u64,
        (from, network): (usize, usize),
        to: usize,
        way: Way,
        bytes: &[u8],
    ) {
        let action = Action::Deliver {
            to,
            from,
            network,
            way,
            bytes: bytes.to_vec(),
        };
        self.push(at, action);
    }

    fn reader_left(&mut self, name: &ItemName) {
        if let Some(interest) = self.interest.get_mut(name) {
            interest.readers = interest.readers.saturating_sub(1);
            interest.ended = self.now;
        }
    }

    fn moment(&self, index: usize) -> host::Moment {
        self.hosts[index].clock.moment(self.now)
    }

    fn push(&mut self, at: u64, action: Action) {
        self.count += 1;
        self.queue.push(Reverse((at, self.count, action)));
    }
}

fn nanos(span: Duration) -> u64 {
    u64::try_from(span.as_nanos()).unwrap_or(u64::MAX / 4)
}
