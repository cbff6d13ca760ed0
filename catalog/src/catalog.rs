//! The composition: one host's control plane, and how its parts tell each other what happened.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::net::SocketAddr;
use std::time::Duration;

use ddx_wire::message::{Message, NackEntry, ReportEntry};
use ddx_wire::seal::{Header, Lane, Refused};
use ddx_wire::{
    ClockOffset, Contract, Epoch, HostId, HostName, Incarnation, ItemDescription, ItemName,
    Pattern, Seq, StreamId, Tag, Time,
};

use crate::clock::Clock;
use crate::config::Config;
use crate::counters::Counters;
use crate::directory::{Directory, RemoteItem};
use crate::error::Error;
use crate::event::Event;
use crate::hosts::{HostState, Hosts, Task};
use crate::interest::{Interest, StreamIn};
use crate::membership::{Entry, Membership};
use crate::outbox::{Dest, Outbox};
use crate::paths::PathStatus;
use crate::prefix::{self, Holder};
use crate::rng::Rng;
use crate::session::Sessions;
use crate::streams::{StreamOut, Streams};

mod beacon;
mod handle;

/// A host of which something came so recently is not probed by membership: a little more than the pause between two digests.
const SIGN_OF_LIFE: Duration = Duration::from_millis(1_700);
/// Membership datagrams that wait for a session with their destination, of at most 1,100 B each: 275 KiB.
const WAITING_MAX: usize = 256;

/// The control plane of one host.
///
/// # Example
///
/// ```
/// use ddx_catalog::{Catalog, Config, Dest};
/// use ddx_wire::seal::DomainKey;
/// use ddx_wire::{DomainId, HostId, HostName, Incarnation, Time};
///
/// let mut catalog = Catalog::new(
///     Config {
///         domain: DomainId(0),
///         host: HostName::parse("robot1").unwrap(),
///         id: HostId([1; 16]),
///         incarnation: Incarnation { ordinal: 1, random: 7 },
///         key: DomainKey::from_bytes([2; 32]),
///         control_addrs: vec!["10.0.0.1:7400".parse().unwrap()],
///         data_port: 7401,
///         seeds: Vec::new(),
///         beacon: true,
///         multicast: true,
///         prefix_since: Time(0),
///     },
///     42,
///     Time(1),
/// );
/// catalog.handle_timeout(Time(1));
/// let mut datagram = Vec::new();
/// let transmit = catalog.poll_transmit(&mut datagram).unwrap();
/// assert_eq!(transmit.to, Dest::Beacon);
/// ```
pub struct Catalog {
    host: HostName,
    id: HostId,
    prefix_since: Time,
    now: Time,
    rng: Rng,
    sessions: Sessions,
    membership: Membership,
    hosts: Hosts,
    directory: Directory,
    interest: Interest,
    streams: Streams,
    clocks: BTreeMap<Tag, Clock>,
    /// Membership datagrams for hosts that are being challenged.
    waiting: VecDeque<(Tag, Vec<u8>)>,
    next_stranger: Time,
    lost_prefix: Option<String>,
    superseded: u32,
    left: bool,
    counters: Counters,
    out: Outbox,
}

/// A datagram to send from the control socket: the bytes are in the buffer that was passed to `poll_transmit`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Transmit {
    /// Where to.
    pub to: Dest,
}

/// Which part of the control plane a deadline belongs to.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum TimerName {
    /// Beacons, greetings of seeds, challenges.
    Session,
    /// Probes of the paths to hosts with several addresses.
    Paths,
    /// The membership protocol.
    Membership,
    /// A look at all hosts.
    Hosts,
    /// Digests, pulls, deltas, schema texts.
    Directory,
    /// Requests, renewals, acks, goodbyes.
    Interest,
    /// Leases and trials of paths.
    Streams,
}

/// One other host, for listings.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct HostStatus {
    /// The host.
    pub host: HostId,
    /// Its name.
    pub name: HostName,
    /// Prefix under which its items appear here.
    pub shown_as: String,
    /// Which life of it.
    pub incarnation: Incarnation,
    /// Short name of that life.
    pub tag: Tag,
    /// Its control address that is in use.
    pub addr: SocketAddr,
    /// All its addresses, and how they answer; none without a session.
    pub paths: Vec<PathStatus>,
    /// Whether it has proved itself, so that more than hearsay is known.
    pub session: bool,
    /// How it appears from here.
    pub state: HostState,
    /// Since when it is in that state.
    pub since: Time,
    /// When it was last heard.
    pub heard: Time,
    /// Smoothed round trip to the address in use if that is probed, else the shortest recent one.
    pub rtt: Option<Duration>,
    /// Its boot clock minus this host's.
    pub clock: Option<ClockOffset>,
    /// When its beacon last came here by multicast. They come each 8 to 8.5 s, unless it sends none.
    pub beacon_heard: Option<Time>,
    /// When it last said that this host's beacon came there by multicast. In a domain of more than a few it says so of a
    /// share of them.
    pub beacon_answered: Option<Time>,
}

impl Catalog {
    /// Makes the control plane of a host. What it does is a function of the configuration, the seed and what it is told.
    pub fn new(config: Config, seed: u64, now: Time) -> Self {
        let mut rng = Rng::new(seed);
        let contact = config
            .control_addrs
            .first()
            .map(|addr| (config.host.clone(), *addr));
        let me = Entry {
            host: config.id,
            incarnation: config.incarnation,
            rejoin: 0,
            contact,
        };
        Self {
            sessions: Sessions::new(&config, now),
            membership: Membership::new(me, rng.next()),
            hosts: Hosts::default(),
            directory: Directory::new(),
            interest: Interest::default(),
            streams: Streams::new(config.domain, config.multicast),
            clocks: BTreeMap::new(),
            waiting: VecDeque::new(),
            next_stranger: now,
            lost_prefix: None,
            superseded: 0,
            left: false,
            counters: Counters::default(),
            out: Outbox::default(),
            host: config.host,
            id: config.id,
            prefix_since: config.prefix_since,
            now,
            rng,
        }
    }

    /// Takes in a datagram from the control socket. Bad ones are counted and dropped.
    pub fn handle_datagram(&mut self, from: SocketAddr, datagram: &mut [u8], now: Time) {
        self.handle(from, datagram, false, now);
    }

    /// The same from the beacon socket, where what every host sends to all arrives by multicast.
    pub fn handle_beacon(&mut self, from: SocketAddr, datagram: &mut [u8], now: Time) {
        self.handle(from, datagram, true, now);
    }

    fn handle(&mut self, from: SocketAddr, datagram: &mut [u8], beacon: bool, now: Time) {
        self.now = now;
        self.counters.received += 1;
        self.counters.received_bytes += u64::try_from(datagram.len()).unwrap_or(u64::MAX);
        if self.left {
            return;
        }
        let handled = match Header::parse(datagram) {
            Err(refused) => Err(refused),
            Ok(header) if self.sessions.is_own(&header) => Err(Refused::Own),
            Ok(header) => match header.lane {
                Lane::Hello => self.handle_greeting(from, datagram, beacon, now),
                Lane::Control => self.handle_control(from, header.sender, datagram, now),
                Lane::Commands | Lane::Values | Lane::Bulk => Err(Refused::Lane),
            },
        };
        if let Err(refused) = handled {
            self.counters.refused.count(refused);
        }
        self.settle(now);
    }

    /// Does what is due.
    pub fn handle_timeout(&mut self, now: Time) {
        self.now = now;
        if self.left {
            return;
        }
        while let Some((_, name)) = self.poll_timeout().filter(|(at, _)| *at <= now) {
            match name {
                TimerName::Session => {
                    self.sessions
                        .set_state(self.directory.version(), self.membership.rejoin());
                    self.sessions
                        .handle_timeout(now, &mut self.rng, &mut self.out);
                }
                TimerName::Paths => {
                    let (interest, streams) = (&self.interest, &self.streams);
                    let busy = |tag| interest.reads(tag) || streams.serves(tag);
                    self.sessions.paths.handle_timeout(now, busy, &mut self.out);
                }
                TimerName::Membership => self.membership.handle_timeout(now),
                TimerName::Hosts => self.watch(now),
                TimerName::Directory => {
                    let up = self.up();
                    let (sessions, hosts) = (&self.sessions, &self.hosts);
                    let age = |tag| beacon::age_s(hosts.get(sessions.get(tag)?.host)?, now);
                    self.directory
                        .handle_timeout(now, &up, age, &mut self.rng, &mut self.out);
                }
                TimerName::Interest => {
                    for owner in self.interest.handle_timeout(now, &mut self.out) {
                        self.tell_clock(owner, now);
                    }
                }
                TimerName::Streams => self.streams.handle_timeout(now, &mut self.out),
            }
            self.settle(now);
        }
    }

    /// Has these control addresses from now on, the best first; perhaps none for a while. All hosts are told at once.
    pub fn set_control_addrs(&mut self, addrs: &[SocketAddr], now: Time) {
        self.now = now;
        if self.left {
            return;
        }
        self.sessions.set_control_addrs(addrs, now);
        // What was measured says nothing of the ways from here that are left.
        self.sessions.paths.refresh(now, &mut self.out);
        self.settle(now);
    }

    /// Adds an item of this host to the directory, or changes its description.
    ///
    /// # Errors
    /// The description or the schema text is too long to travel, or the directory is full.
    pub fn announce(
        &mut self,
        description: ItemDescription,
        schema_text: &str,
        now: Time,
    ) -> Result<(), Error> {
        self.now = now;
        let announced = self.directory.announce(description, schema_text, now);
        self.count_refused(announced)
    }

    /// Removes an item of this host from the directory. Its streams end.
    pub fn withdraw(&mut self, name: &ItemName, now: Time) {
        self.now = now;
        if self.directory.withdraw(name, now) {
            self.streams.drop_item(name, &mut self.out);
        }
    }

    /// Wants an item of another host, under the name that this host shows; waits for it when it is not known yet.
    /// A subscription to the same name changes its contract.
    ///
    /// # Errors
    /// Too many items are subscribed.
    pub fn subscribe(
        &mut self,
        name: ItemName,
        contract: Contract,
        now: Time,
    ) -> Result<(), Error> {
        self.now = now;
        let owner = self.owner(&name);
        let subscribed = self
            .interest
            .subscribe(name, contract, owner, now, &mut self.out);
        self.count_refused(subscribed)
    }

    /// Ends a subscription.
    pub fn unsubscribe(&mut self, name: &ItemName, now: Time) {
        self.now = now;
        self.interest.unsubscribe(name, now, &mut self.out);
    }

    /// Notes the newest sample that this host holds of a stream. `quiet` says that none came for a while, and that the
    /// sender should know within 20 ms what is held.
    pub fn holds(
        &mut self,
        tag: Tag,
        stream: StreamId,
        epoch: Epoch,
        seq: Seq,
        quiet: bool,
        now: Time,
    ) {
        self.now = now;
        self.interest.holds(tag, stream, (epoch, seq), quiet, now);
    }

    /// Notes that a sample of a stream arrived by multicast. Call it for the first one after each
    /// [`Event::JoinGroup`]; more calls are cheap and do nothing.
    pub fn heard_on_group(&mut self, tag: Tag, stream: StreamId, now: Time) {
        self.now = now;
        self.interest.heard_on_group(tag, stream, now);
    }

    /// Tells a sender how its datagrams arrive.
    pub fn report(&mut self, tag: Tag, report: ReportEntry, now: Time) {
        self.now = now;
        self.out.send(tag, &Message::Report(vec![report]));
    }

    /// Asks a sender for what is missing.
    pub fn nack(&mut self, tag: Tag, nack: NackEntry, now: Time) {
        self.now = now;
        self.out.send(tag, &Message::Nack(vec![nack]));
    }

    /// Says goodbye to all. What [`Catalog::poll_transmit`] yields afterwards is the last of it.
    pub fn leave(&mut self, now: Time) {
        self.now = now;
        self.membership.leave(now);
        self.settle(now);
        let all: Vec<Tag> = self.sessions.iter().map(|(tag, _)| tag).collect();
        for _ in 0..2 {
            // Said twice, because nobody is left to say it again.
            for tag in &all {
                self.out.send(*tag, &Message::Leave);
            }
        }
        self.left = true;
    }

    /// Writes the next datagram to the end of `buffer`.
    pub fn poll_transmit(&mut self, buffer: &mut Vec<u8>) -> Option<Transmit> {
        while let Some(outgoing) = self.out.pop() {
            let start = buffer.len();
            if let Some(to) = self.sessions.seal(&outgoing, buffer) {
                self.counters.sent += 1;
                let bytes = buffer.len() - start;
                self.counters.sent_bytes += u64::try_from(bytes).unwrap_or(u64::MAX);
                return Some(Transmit { to });
            }
        }
        None
    }

    /// The next event.
    pub fn poll_event(&mut self) -> Option<Event> {
        self.out.pop_event()
    }

    /// When to call [`Catalog::handle_timeout`], and for which part.
    pub fn poll_timeout(&self) -> Option<(Time, TimerName)> {
        if self.left {
            return None;
        }
        [
            (self.sessions.poll_timeout(), TimerName::Session),
            (self.sessions.paths.poll_timeout(), TimerName::Paths),
            (self.membership.poll_timeout(), TimerName::Membership),
            (self.hosts.poll_timeout(), TimerName::Hosts),
            (self.directory.poll_timeout(), TimerName::Directory),
            (self.interest.poll_timeout(), TimerName::Interest),
            (self.streams.poll_timeout(), TimerName::Streams),
        ]
        .into_iter()
        .filter_map(|(at, name)| Some((at?, name)))
        .min()
    }

    /// Short name of this life of the host.
    pub fn tag(&self) -> Tag {
        self.sessions.tag()
    }

    /// The other hosts.
    pub fn hosts(&self) -> Vec<HostStatus> {
        let shown = self.prefixes().0;
        self.hosts
            .iter()
            .map(|(id, host)| {
                let clock = self.clocks.get(&host.tag);
                let paths = self.sessions.paths.status(host.tag);
                let used = paths.iter().find(|path| path.used);
                let rtt = clock.and_then(Clock::rtt_ns).map(Duration::from_nanos);
                HostStatus {
                    host: id,
                    name: host.name.clone(),
                    shown_as: shown
                        .get(&id)
                        .cloned()
                        .unwrap_or_else(|| host.name.to_string()),
                    incarnation: host.entry.incarnation,
                    tag: host.tag,
                    addr: used.map_or(host.addr, |path| path.addr),
                    session: self.sessions.get(host.tag).is_some(),
                    state: host.state,
                    since: host.since,
                    heard: host.heard,
                    rtt: used.and_then(|path| path.rtt).or(rtt),
                    paths,
                    clock: clock.and_then(|clock| clock.estimate(self.now)),
                    beacon_heard: host.beacon_heard,
                    beacon_answered: host.beacon_answered,
                }
            })
            .collect()
    }

    /// The name of a host, while that is known.
    pub fn host_name(&self, host: HostId) -> Option<&HostName> {
        self.hosts.get(host).map(|host| &host.name)
    }

    /// Items of other hosts whose names fit.
    pub fn items(&self, pattern: &Pattern) -> Vec<RemoteItem> {
        self.directory.items(pattern).collect()
    }

    /// Streams that this host receives, or waits for.
    pub fn streams_in(&self) -> Vec<StreamIn> {
        self.interest.streams().collect()
    }

    /// Streams that this host sends.
    pub fn streams_out(&self) -> Vec<StreamOut> {
        self.streams.iter().collect()
    }

    /// What is known now about the clock of a life of a host.
    pub fn clock(&self, tag: Tag, now: Time) -> Option<ClockOffset> {
        self.clocks.get(&tag)?.estimate(now)
    }

    /// What was counted since the start.
    pub fn counters(&self) -> Counters {
        let dropped = [
            self.out.dropped,
            self.membership.dropped(),
            self.hosts.dropped,
            self.sessions.paths.dropped,
            self.directory.unanswered(),
            self.interest.dropped(),
        ];
        Counters {
            over_limit: dropped
                .into_iter()
                .fold(self.counters.over_limit, u64::saturating_add),
            directory_full: self.directory.dropped(),
            ..self.counters
        }
    }

    fn count_refused(&mut self, done: Result<(), Error>) -> Result<(), Error> {
        self.counters.over_limit += u64::from(done.is_err());
        done
    }

    /// Passes on what one part left for another.
    fn settle(&mut self, now: Time) {
        while let Some(rumour) = self.membership.poll_rumour() {
            if let Some(ended) = self.hosts.rumour(rumour, now, &mut self.out) {
                self.end_life(ended, now);
            }
        }
        while let Some((to, bytes)) = self.membership.poll_send() {
            let tag = to.tag();
            let host = self.hosts.get(to.host).filter(|host| host.tag == tag);
            let is_heard = host.is_some_and(|host| now.since(host.heard) < SIGN_OF_LIFE);
            if self.sessions.get(tag).is_some() {
                if is_heard && self.membership.answer(&to, &bytes, now) {
                    continue;
                }
                self.out.send(tag, &Message::Swim(bytes));
                continue;
            }
            let addr = to.contact.map(|(_, addr)| addr);
            let addr = addr.or_else(|| self.hosts.get(to.host).map(|host| host.addr));
            let Some(addr) = addr else {
                continue;
            };
            let asked = self
                .sessions
                .challenge(tag, addr, now, &mut self.rng, &mut self.out);
            let is_full = self.waiting.len() >= WAITING_MAX;
            self.counters.over_limit += u64::from(is_full || !asked);
            if asked {
                if is_full {
                    self.waiting.pop_front();
                }
                self.waiting.push_back((tag, bytes));
            }
        }
        while let Some(tag) = self.sessions.paths.poll_moved() {
            if let Some(at) = handle::reader_addr(&self.sessions, tag) {
                self.streams.moved(tag, at, now, &mut self.out);
            }
            // So that the owner learns what is held, and sends by the new path what was missed.
            self.interest.renew_now(tag, now);
        }
        while let Some(name) = self.directory.poll_changed() {
            let owner = self.owner(&name);
            self.interest.resolve(&name, owner, now, &mut self.out);
        }
    }

    fn watch(&mut self, now: Time) {
        let suspects: BTreeSet<HostId> = self.membership.suspects().collect();
        let (interest, streams) = (&self.interest, &self.streams);
        let busy = |tag| interest.reads(tag) || streams.serves(tag);
        let version = self.directory.version();
        self.sessions.set_state(version, self.membership.rejoin());
        for task in self
            .hosts
            .handle_timeout(now, &suspects, busy, &mut self.out)
        {
            match task {
                Task::Revive(entry) => self.membership.revive(entry, now),
                Task::Ask(host) => {
                    let Some(host) = self.hosts.get(host) else {
                        continue;
                    };
                    if let Some(addr) = self.sessions.paths.addr(host.tag) {
                        self.out.send(host.tag, &Message::Ping { version });
                        self.sessions.paths.ask(host.tag, now, &mut self.out);
                        if host.state != HostState::Up {
                            // Another life of it may be there by now.
                            self.sessions
                                .hello(Dest::Addr(addr), false, now, &mut self.out);
                        }
                    } else {
                        let (tag, addr) = (host.tag, host.addr);
                        self.sessions
                            .challenge(tag, addr, now, &mut self.rng, &mut self.out);
                    }
                }
            }
        }
        let down = self
            .hosts
            .iter()
            .filter(|(_, host)| host.state == HostState::Down);
        let down: Vec<Tag> = down.map(|(_, host)| host.tag).collect();
        for tag in down {
            self.streams.drop_reader(tag, now, &mut self.out);
        }
    }

    /// Exchanges at once what two hosts missed of each other.
    fn welcome_back(&mut self, host: HostId, tag: Tag, now: Time) {
        self.interest.renew_now(tag, now);
        let wanted: Vec<ItemName> = self.interest.names().cloned().collect();
        for name in wanted {
            let owner = self.owner(&name);
            if owner.as_ref().is_some_and(|(owner, _)| *owner == tag) {
                self.interest.resolve(&name, owner, now, &mut self.out);
            }
        }
        let version = self.directory.version();
        self.out.send(tag, &Message::Ping { version });
        let summary = self.directory.summary(tag, &mut self.rng);
        self.out.send(tag, &summary);
        let waiting = std::mem::take(&mut self.waiting);
        for (to, bytes) in waiting {
            if to == tag {
                self.out.send(tag, &Message::Swim(bytes));
            } else if self.sessions.get(to).is_none() {
                self.waiting.push_back((to, bytes));
            }
        }
        tracing::debug!(%host, "host is back");
    }

    /// Challenges hosts that are known by hearsay only.
    fn meet(&mut self, strangers: &[Tag], now: Time) {
        for tag in strangers {
            let host = self.hosts.iter().find(|(_, host)| host.tag == *tag);
            if let Some((_, host)) = host
                && host.state == HostState::Up
            {
                let addr = host.addr;
                self.sessions
                    .challenge(*tag, addr, now, &mut self.rng, &mut self.out);
            }
        }
    }

    /// Drops everything that depends on a life of a host that is over.
    fn end_life(&mut self, tag: Tag, now: Time) {
        if self.sessions.get(tag).is_some() {
            self.sessions.close(tag);
            self.out.event(Event::SessionClosed { tag });
        }
        self.clocks.remove(&tag);
        self.interest.drop_owner(tag, &mut self.out);
        self.streams.drop_reader(tag, now, &mut self.out);
    }

    fn owner(&self, shown: &ItemName) -> Option<(Tag, ItemName)> {
        let (host, description) = self.directory.find(shown)?;
        let tag = self.sessions.tag_of(host)?;
        Some((tag, description.name.clone()))
    }

    /// The hosts that answer now.
    fn up(&self) -> Vec<Tag> {
        self.sessions
            .iter()
            .filter(|(_, session)| {
                self.hosts
                    .get(session.host)
                    .is_some_and(|host| host.state == HostState::Up)
            })
            .map(|(tag, _)| tag)
            .collect()
    }

    fn tell_clock(&mut self, tag: Tag, now: Time) {
        if let Some(offset) = self.clock(tag, now) {
            self.out.event(Event::Clock { tag, offset });
        }
    }

    fn prefixes(&self) -> (BTreeMap<HostId, String>, Option<String>) {
        let me = Holder {
            id: self.id,
            name: self.host.clone(),
            since_ns: i128::from(self.prefix_since.0),
        };
        let others: Vec<Holder> = self
            .hosts
            .iter()
            .filter(|(_, host)| host.state != HostState::Left)
            .filter_map(|(id, host)| {
                Some(Holder {
                    id,
                    name: host.name.clone(),
                    since_ns: host.prefix_since_ns?,
                })
            })
            .collect();
        prefix::resolve(&me, &others)
    }

    fn refresh_prefixes(&mut self) {
        let (shown, lost) = self.prefixes();
        for host in self.directory.set_prefixes(&shown, &mut self.out) {
            let shown_as = shown.get(&host).cloned();
            let name = self.hosts.get(host).map(|host| host.name.to_string());
            if let Some(shown_as) = shown_as.or(name) {
                self.out.event(Event::PrefixConflict { host, shown_as });
            }
        }
        if lost != self.lost_prefix {
            self.lost_prefix.clone_from(&lost);
            let shown_as = lost.unwrap_or_else(|| self.host.to_string());
            self.out.event(Event::PrefixConflict {
                host: self.id,
                shown_as,
            });
        }
    }
}
