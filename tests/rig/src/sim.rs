//! A domain of many hosts in one thread under virtual time: the control planes are real, the network and the clocks are not.
//!
//! Everything is a function of the seed. Each host has a boot clock with its own start and drift; datagrams are lost,
//! delayed, reordered, duplicated and cut off by partitions. Samples are modelled, not sealed: [`Sim::publish`] gives each
//! reading host the sample by every path that its stream has and that host can hear.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet, BinaryHeap};
use std::net::SocketAddr;
use std::time::Duration;

use ddx_catalog::delivery::{Path, Route};
use ddx_catalog::{Catalog, Config, Dest, Event};
use ddx_wire::seal::DomainKey;
use ddx_wire::{
    Contract, DomainId, Epoch, HostId, HostName, Incarnation, ItemDescription, ItemName,
    SchemaHash, Seq, StreamId, Tag, Time, WriterState,
};

/// What the network does to a datagram.
#[derive(Clone, Copy, Debug)]
pub struct Link {
    /// Share of datagrams that are lost.
    pub loss: f64,
    /// Share of datagrams that arrive twice.
    pub duplicates: f64,
    /// Least time on the way.
    pub delay: Duration,
    /// Further time on the way, at most; more than the spacing of datagrams reorders them.
    pub jitter: Duration,
}

/// What a simulation is made of.
#[derive(Clone, Debug)]
pub struct Setup {
    /// Decides everything that is left to chance.
    pub seed: u64,
    /// Number of hosts.
    pub hosts: usize,
    /// The network.
    pub link: Link,
    /// Whether beacons reach everybody; else all hosts have the first as a seed.
    pub beacon: bool,
    /// Greatest drift of a clock, parts per million, either way.
    pub drift_ppm: u32,
}

/// The simulation.
pub struct Sim {
    setup: Setup,
    now: u64,
    random: u64,
    count: u64,
    queue: BinaryHeap<Reverse<(u64, u64, Action)>>,
    hosts: Vec<Host>,
    /// Hosts hear each other only within one group.
    groups: Vec<usize>,
    /// What the hosts told their drivers, with the time; clocks and what is held are left out.
    pub log: Vec<(Duration, usize, Event)>,
    /// Datagrams that were handed to hosts.
    pub delivered: u64,
    /// Bytes of all datagrams that hosts sent; a beacon counts once.
    pub sent_bytes: u64,
    /// Clock estimates that did not contain the truth.
    pub clock_errors: u64,
    /// Clock estimates in all.
    pub clock_estimates: u64,
}

/// One simulated host.
pub struct Host {
    /// Its control plane; `None` while it is off.
    pub catalog: Option<Catalog>,
    /// Its name.
    pub name: HostName,
    /// Items of other hosts that its driver was told of.
    pub known: BTreeMap<ItemName, ItemDescription>,
    /// Streams that its driver was told to send.
    pub open: BTreeMap<StreamId, (ItemName, Route)>,
    /// Streams that its driver was told to expect.
    pub expected: BTreeMap<(Tag, StreamId), ItemName>,
    /// What its readers hold.
    pub held: BTreeMap<ItemName, (Epoch, Seq)>,
    /// Groups that its driver was told to join.
    pub joined: BTreeSet<SocketAddr>,
    /// Whether its network passes multicast samples on.
    pub hears_groups: bool,
    /// Copies of samples that reached it.
    pub copies: u64,
    id: HostId,
    addr: SocketAddr,
    clock_start: u64,
    drift_ppm: i64,
    wake: u64,
}

#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Action {
    Wake(usize),
    Deliver {
        to: usize,
        from: usize,
        bytes: Vec<u8>,
    },
}

impl Link {
    /// A quiet local network that loses this share of datagrams.
    pub fn lan(loss: f64) -> Self {
        Self {
            loss,
            duplicates: 0.01,
            delay: Duration::from_micros(100),
            jitter: Duration::from_micros(400),
        }
    }
}

impl Setup {
    /// Hosts on a local network, met by beacon, with the drift of ordinary crystals.
    pub fn lan(seed: u64, hosts: usize, loss: f64) -> Self {
        Self {
            seed,
            hosts,
            link: Link::lan(loss),
            beacon: true,
            drift_ppm: 90,
        }
    }
}

impl Sim {
    /// Starts all hosts within the first ten milliseconds.
    pub fn new(setup: Setup) -> Self {
        let mut sim = Self {
            now: 0,
            random: setup.seed,
            count: 0,
            queue: BinaryHeap::new(),
            hosts: Vec::new(),
            groups: vec![0; setup.hosts],
            log: Vec::new(),
            delivered: 0,
            sent_bytes: 0,
            clock_errors: 0,
            clock_estimates: 0,
            setup,
        };
        for index in 0..sim.setup.hosts {
            let spread = u64::from(sim.setup.drift_ppm) * 2 + 1;
            let drift = i64::try_from(sim.below(spread)).unwrap_or(0);
            let (high, low) = (index / 250, index % 250 + 1);
            let host = Host {
                catalog: None,
                name: HostName::parse(&format!("h{index}"))
                    .expect("a letter and digits are a name"),
                known: BTreeMap::new(),
                open: BTreeMap::new(),
                expected: BTreeMap::new(),
                held: BTreeMap::new(),
                joined: BTreeSet::new(),
                hears_groups: true,
                copies: 0,
                id: HostId((u128::try_from(index).unwrap_or(0) + 1).to_be_bytes()),
                addr: format!("10.0.{high}.{low}:7000")
                    .parse()
                    .expect("an address"),
                clock_start: sim.below(1_000_000_000_000_000),
                drift_ppm: drift - i64::from(sim.setup.drift_ppm),
                wake: u64::MAX,
            };
            sim.hosts.push(host);
        }
        for index in 0..sim.setup.hosts {
            let ordinal = 1;
            sim.start(index, ordinal);
        }
        sim
    }

    /// Starts a host anew, as a life with this ordinal.
    pub fn start(&mut self, index: usize, ordinal: u32) {
        let random = self.next();
        let seed = self.next();
        let now = self.local(index);
        let first = self.hosts.first().map(|host| host.addr);
        let host = &mut self.hosts[index];
        let config = Config {
            domain: DomainId(3),
            host: host.name.clone(),
            id: host.id,
            incarnation: Incarnation { ordinal, random },
            key: DomainKey::from_bytes([9; 32]),
            control_addrs: vec![host.addr],
            data_port: 7001,
            seeds: first
                .filter(|_| !self.setup.beacon && index > 0)
                .into_iter()
                .collect(),
            beacon: self.setup.beacon,
            multicast: true,
            prefix_since: now,
        };
        host.catalog = Some(Catalog::new(config, seed, now));
        host.known.clear();
        host.open.clear();
        host.expected.clear();
        host.held.clear();
        host.joined.clear();
        host.wake = u64::MAX;
        let late = self.below(10_000_000);
        self.push(self.now + late, Action::Wake(index));
    }

    /// Gives a host another name. Only before its next start does that mean anything to others.
    pub fn rename(&mut self, index: usize, name: &str) {
        self.hosts[index].name = HostName::parse(name).expect("the caller passes a host name");
    }

    /// Switches a host off, without a word.
    pub fn kill(&mut self, index: usize) {
        self.hosts[index].catalog = None;
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
        let host = &self.hosts[index];
        let drift = i128::from(self.now) * i128::from(host.drift_ppm) / 1_000_000;
        let local = i128::from(host.clock_start) + i128::from(self.now) + drift;
        Time(u64::try_from(local).unwrap_or(0))
    }

    /// Splits the network: hosts hear each other only within one group.
    pub fn cut(&mut self, group_of: impl Fn(usize) -> usize) {
        self.groups = (0..self.hosts.len()).map(group_of).collect();
    }

    /// Ends a split.
    pub fn heal(&mut self) {
        self.cut(|_| 0);
    }

    /// Changes the network for datagrams that are sent from now on.
    pub fn set_link(&mut self, link: Link) {
        self.setup.link = link;
    }

    /// Announces an item of a host under its prefix.
    pub fn announce(&mut self, index: usize, rest: &str) -> ItemName {
        let name = ItemName::parse(&format!("./{rest}"), &self.hosts[index].name)
            .expect("the caller passes a name");
        let description = ItemDescription {
            name: name.clone(),
            schema_hash: SchemaHash([1; 16]),
            capacity_bytes: 8,
            epoch: Epoch::new(1, 1),
            writer: WriterState::Live,
            program: "sim".to_owned(),
        };
        self.command(index, |catalog, now| {
            catalog
                .announce(description, "u64", now)
                .expect("the directory has room");
        });
        name
    }

    /// Subscribes a host to an item.
    pub fn subscribe(&mut self, index: usize, name: &ItemName, contract: Contract) {
        self.command(index, |catalog, now| {
            catalog
                .subscribe(name.clone(), contract, now)
                .expect("there is room");
        });
    }

    /// Calls a host's control plane, then does what it asks for.
    pub fn command(&mut self, index: usize, act: impl FnOnce(&mut Catalog, Time)) {
        let now = self.local(index);
        if let Some(catalog) = &mut self.hosts[index].catalog {
            act(catalog, now);
        }
        self.drain(index);
    }

    /// Publishes a sample of an item: each reading host gets it by the paths of its stream, unless it is lost or cut off.
    pub fn publish(&mut self, index: usize, name: &ItemName, epoch: Epoch, seq: Seq) {
        let Some(tag) = self.hosts[index].catalog.as_ref().map(Catalog::tag) else {
            return;
        };
        let open = self.hosts[index].open.iter();
        let routes: Vec<_> = open
            .filter(|(_, (item, _))| item == name)
            .map(|(stream, (_, route))| (*stream, route.clone()))
            .collect();
        for (stream, route) in routes {
            let (unicast, group) = match route.path {
                Path::Unicast => (true, None),
                Path::Both(group) => (true, Some(group)),
                Path::Multicast(group) => (false, Some(group)),
            };
            for to in 0..self.hosts.len() {
                let host = &self.hosts[to];
                if to == index || !host.expected.contains_key(&(tag, stream)) {
                    continue;
                }
                let listed = route.readers.iter().any(|r| r.addr.ip() == host.addr.ip());
                let joined = group.is_some_and(|g| host.hears_groups && host.joined.contains(&g));
                let reachable = self.groups[index] == self.groups[to];
                for by_group in [false, true] {
                    let sent = if by_group { joined } else { unicast && listed };
                    if sent && reachable && !self.chance(self.setup.link.loss) {
                        self.arrive(to, tag, stream, name, (epoch, seq), by_group);
                    }
                }
            }
        }
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
        loop {
            if self.now >= next_check {
                if holds(self) {
                    return true;
                }
                next_check = self.now + 1_000_000;
            }
            let due = self
                .queue
                .peek()
                .is_some_and(|Reverse((at, _, _))| *at <= end);
            let next = if due { self.queue.pop() } else { None };
            let Some(Reverse((at, _, action))) = next else {
                self.now = end;
                return holds(self);
            };
            self.now = self.now.max(at);
            match action {
                Action::Wake(index) => {
                    if self.hosts[index].wake <= self.now {
                        self.hosts[index].wake = u64::MAX;
                    }
                    self.command(index, |catalog, now| {
                        catalog.handle_timeout(now);
                    });
                }
                Action::Deliver {
                    to,
                    from,
                    mut bytes,
                } => {
                    if self.groups[from] == self.groups[to] && self.hosts[to].catalog.is_some() {
                        self.delivered += 1;
                        let addr = self.hosts[from].addr;
                        self.command(to, |catalog, now| {
                            catalog.handle_datagram(addr, &mut bytes, now);
                        });
                    }
                }
            }
        }
    }

    fn arrive(
        &mut self,
        to: usize,
        tag: Tag,
        stream: StreamId,
        name: &ItemName,
        sample: (Epoch, Seq),
        by_group: bool,
    ) {
        let host = &mut self.hosts[to];
        host.copies += 1;
        let held = host.held.entry(name.clone()).or_default();
        *held = (*held).max(sample);
        let (epoch, seq) = *held;
        self.command(to, |catalog, now| {
            if by_group {
                catalog.heard_on_group(tag, stream, now);
            }
            catalog.holds(tag, stream, epoch, seq, true, now);
        });
    }

    /// Sends and notes what a host left, and sets its alarm.
    fn drain(&mut self, index: usize) {
        let Some(mut catalog) = self.hosts[index].catalog.take() else {
            return;
        };
        let mut bytes = Vec::new();
        while let Some(transmit) = catalog.poll_transmit(&mut bytes) {
            self.sent_bytes += u64::try_from(bytes.len()).unwrap_or(0);
            match transmit.to {
                Dest::Addr(addr) => {
                    if let Some(to) = self.hosts.iter().position(|host| host.addr == addr) {
                        self.post(index, to, &bytes);
                    }
                }
                Dest::Beacon => {
                    for to in (0..self.hosts.len()).filter(|to| *to != index) {
                        self.post(index, to, &bytes);
                    }
                }
            }
            bytes.clear();
        }
        while let Some(event) = catalog.poll_event() {
            self.note(index, event);
        }
        if let Some((at, _)) = catalog.poll_timeout() {
            let wait = at.since(self.local(index)).as_nanos();
            // A slow clock reaches the instant later than the difference says.
            let wait = u64::try_from(wait).unwrap_or(u64::MAX / 4);
            let wake = self.now.saturating_add(wait + wait / 5_000);
            if wake < self.hosts[index].wake {
                self.hosts[index].wake = wake;
                self.push(wake, Action::Wake(index));
            }
        }
        self.hosts[index].catalog = Some(catalog);
    }

    fn note(&mut self, index: usize, event: Event) {
        let host = &mut self.hosts[index];
        match &event {
            Event::ItemKnown {
                name, description, ..
            } => {
                host.known.insert(name.clone(), description.clone());
            }
            Event::ItemGone { name, .. } => {
                host.known.remove(name);
            }
            Event::OpenStream {
                stream,
                name,
                route,
            } => {
                host.open.insert(*stream, (name.clone(), route.clone()));
            }
            Event::UpdateStream { stream, route } => {
                if let Some((_, known)) = host.open.get_mut(stream) {
                    *known = route.clone();
                }
            }
            Event::CloseStream { stream } => {
                host.open.remove(stream);
            }
            Event::Expect {
                tag, stream, name, ..
            } => {
                host.expected.insert((*tag, *stream), name.clone());
            }
            Event::Forget { tag, stream } => {
                host.expected.remove(&(*tag, *stream));
            }
            Event::JoinGroup(group) => {
                host.joined.insert(*group);
            }
            Event::LeaveGroup(group) => {
                host.joined.remove(group);
            }
            Event::Clock { tag, offset } => {
                let other = self.hosts.iter().position(|host| {
                    host.catalog
                        .as_ref()
                        .is_some_and(|catalog| catalog.tag() == *tag)
                });
                if let Some(other) = other {
                    let truth = i128::from(self.local(other).0) - i128::from(self.local(index).0);
                    let error = truth.abs_diff(i128::from(offset.offset_ns));
                    self.clock_estimates += 1;
                    self.clock_errors += u64::from(error > u128::from(offset.bound_ns));
                }
                return;
            }
            Event::Held { .. } => return,
            Event::HostUp { .. }
            | Event::HostUnreachable { .. }
            | Event::HostDown { .. }
            | Event::HostLeft { .. }
            | Event::PrefixConflict { .. }
            | Event::Reincarnate { .. }
            | Event::Session { .. }
            | Event::SessionClosed { .. } => {}
        }
        let now = self.now();
        self.log.push((now, index, event));
    }

    fn post(&mut self, from: usize, to: usize, bytes: &[u8]) {
        if self.groups[from] != self.groups[to] {
            return;
        }
        let copies = 1 + u8::from(self.chance(self.setup.link.duplicates));
        for _ in 0..copies {
            if self.chance(self.setup.link.loss) {
                continue;
            }
            let jitter = self.below(nanos(self.setup.link.jitter).max(1));
            let at = self.now + nanos(self.setup.link.delay) + jitter;
            let bytes = bytes.to_vec();
            self.push(at, Action::Deliver { to, from, bytes });
        }
    }

    fn push(&mut self, at: u64, action: Action) {
        self.count += 1;
        self.queue.push(Reverse((at, self.count, action)));
    }

    fn next(&mut self) -> u64 {
        self.random = self.random.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let z = (self.random ^ (self.random >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    fn below(&mut self, bound: u64) -> u64 {
        self.next().checked_rem(bound).unwrap_or(0)
    }

    fn chance(&mut self, share: f64) -> bool {
        let draw = u32::try_from(self.next() >> 32).unwrap_or(0);
        f64::from(draw) < share * f64::from(u32::MAX)
    }
}

fn nanos(span: Duration) -> u64 {
    u64::try_from(span.as_nanos()).unwrap_or(u64::MAX / 4)
}
