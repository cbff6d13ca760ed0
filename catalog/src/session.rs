//! First contact: beacons, greetings, challenges, and the keys of the hosts that answered.
//!
//! A greeting can be recorded and replayed by anybody, so it triggers a challenge and nothing else. A session exists once
//! that life of the other host has repeated our nonce, and lasts as long as that life is not known to be over: the replay
//! windows inside it must not be forgotten while its keys can still be used.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::time::Duration;

use ddx_wire::message::{CONTROL_ADDRS_MAX, Greeting, Introduction, Message};
use ddx_wire::seal::{
    self, DomainKey, Header, Lane, MIXED_STREAMS, Opener, Purpose, Refused, Sealer,
};
use ddx_wire::{HostId, Incarnation, Tag, Time, codec};

use crate::config::Config;
use crate::outbox::{Dest, Outbox, Outgoing, Target};
use crate::paths::Paths;
use crate::rng::Rng;

/// Beacons come fast at first, so that a domain meets within a round trip, then slowly, for those who were deaf. When two
/// hosts start together, the first beacon of each is lost in a switch that snoops: it learns of a new member some 10 ms
/// late. At a loss of one in three, one start in thousands is heard by none of the first eight.
const BEACON_START: [Duration; 7] = [
    Duration::from_millis(15),
    Duration::from_millis(30),
    Duration::from_millis(60),
    Duration::from_millis(200),
    Duration::from_millis(700),
    Duration::from_secs(1),
    Duration::from_secs(1),
];
/// Who is alone looks out for others more often: those that have company answer it.
const BEACON_PERIOD_ALONE: Duration = Duration::from_secs(2);
const BEACON_PERIOD: Duration = Duration::from_secs(8);
const SEED_PERIOD: Duration = Duration::from_millis(500);
/// News of this host's addresses are said again after these pauses, in case they were lost.
const NEWS_AGAIN: [Duration; 3] = [
    Duration::from_millis(100),
    Duration::from_millis(300),
    Duration::from_secs(1),
];
const CHALLENGE_RETRY: Duration = Duration::from_millis(100);
const CHALLENGE_TRIES: u32 = 10;
/// Handshakes under way, of 100 B each: 25 KiB.
const PENDING_MAX: usize = 256;
/// Lives of hosts with which this host can hold sessions at one time. One takes 3 KiB at most, with its paths and the
/// replay window of each lane: 12 MiB, and as much again on the receiving thread.
const SESSIONS_MAX: usize = 4_096;
/// Up to this many sessions each stranger's beacon is answered; beyond, a share of them, and the rest is met on demand.
const EAGER_SESSIONS: usize = 32;

/// One life of another host that proved itself.
pub(crate) struct Session {
    pub(crate) host: HostId,
    pub(crate) data_port: u16,
    pub(crate) multicast: bool,
    opener: Opener,
}

/// What a greeting led to.
pub(crate) enum Greeted {
    /// Nothing to tell.
    Nothing,
    /// A host answered our challenge, now or again.
    Answered {
        from: Introduction,
        addr: SocketAddr,
        /// When our challenge was sent, and what the other clock showed when it arrived.
        exchange: (Time, Time),
        fresh: bool,
    },
    /// A later life of this host was seen.
    Superseded { ordinal: u32 },
    /// A challenge or response that fits nothing.
    StaleResponse,
    /// An earlier life of a known host speaks.
    StaleLife,
    /// A limit was reached.
    OverLimit,
}

pub(crate) struct Sessions {
    key: DomainKey,
    me: Introduction,
    prefix_since: Time,
    tag: Tag,
    hello: Sealer,
    control: Sealer,
    pending: BTreeMap<Tag, Pending>,
    live: BTreeMap<Tag, Session>,
    pub(crate) paths: Paths,
    tag_of: BTreeMap<HostId, Tag>,
    seeds: Vec<SocketAddr>,
    next_seed: Option<Time>,
    next_beacon: Option<Time>,
    beacons: usize,
    /// How often this host's addresses changed, and when to say so next.
    revision: u64,
    next_news: Option<Time>,
    news: usize,
}

struct Pending {
    nonce: u64,
    addr: SocketAddr,
    sent: Time,
    tries: u32,
    next: Time,
}

impl Sessions {
    pub(crate) fn new(config: &Config, now: Time) -> Self {
        let control_addrs = config.control_addrs.iter().copied().take(CONTROL_ADDRS_MAX);
        let sealer = |purpose| Sealer::new(&config.key, config.id, config.incarnation, purpose);
        Self {
            me: Introduction {
                host: config.id,
                incarnation: config.incarnation,
                name: config.host.clone(),
                control_addrs: control_addrs.collect(),
                data_port: config.data_port,
                rejoin: 0,
                prefix_age_ns: 0,
                version: 0,
                multicast: config.multicast,
            },
            prefix_since: config.prefix_since,
            tag: Tag::of(config.id, config.incarnation),
            hello: sealer(Purpose::Hello),
            control: sealer(Purpose::Control),
            key: config.key.clone(),
            pending: BTreeMap::new(),
            live: BTreeMap::new(),
            paths: Paths::default(),
            tag_of: BTreeMap::new(),
            seeds: config.seeds.clone(),
            next_seed: (!config.seeds.is_empty()).then_some(now),
            next_beacon: config.beacon.then_some(now),
            beacons: 0,
            revision: 0,
            next_news: None,
            news: 0,
        }
    }

    pub(crate) fn tag(&self) -> Tag {
        self.tag
    }

    pub(crate) fn get(&self, tag: Tag) -> Option<&Session> {
        self.live.get(&tag)
    }

    /// The present life of a host, when it has a session.
    pub(crate) fn tag_of(&self, host: HostId) -> Option<Tag> {
        self.tag_of.get(&host).copied()
    }

    pub(crate) fn iter(&self) -> impl Iterator<Item = (Tag, &Session)> {
        self.live.iter().map(|(tag, session)| (*tag, session))
    }

    /// What introductions say from now on.
    pub(crate) fn set_state(&mut self, version: u64, rejoin: u32) {
        self.me.version = version;
        self.me.rejoin = rejoin;
    }

    /// Has this host's addresses from now on, and tells everybody.
    pub(crate) fn set_control_addrs(&mut self, addrs: &[SocketAddr], now: Time) {
        self.me.control_addrs = addrs.iter().copied().take(CONTROL_ADDRS_MAX).collect();
        self.revision += 1;
        (self.next_news, self.news) = (Some(now), 0);
        self.beacons = 0;
        for next in [&mut self.next_beacon, &mut self.next_seed] {
            *next = next.map(|_| now);
        }
    }

    /// Where a host receives unicast samples: at the address in use.
    pub(crate) fn data_addr(&self, tag: Tag) -> Option<SocketAddr> {
        let session = self.live.get(&tag)?;
        let addr = self.paths.addr(tag)?;
        Some(SocketAddr::new(addr.ip(), session.data_port))
    }

    /// The key material for samples of one life of a host.
    pub(crate) fn data_opener(&self, host: HostId, incarnation: Incarnation) -> Opener {
        Opener::new(&self.key, host, incarnation, Purpose::Data)
    }

    /// Ends the session with a life that is over.
    pub(crate) fn close(&mut self, tag: Tag) {
        self.paths.forget(tag);
        if let Some(session) = self.live.remove(&tag)
            && self.tag_of.get(&session.host) == Some(&tag)
        {
            self.tag_of.remove(&session.host);
        }
    }

    /// Opens a control datagram of a session and returns its plaintext.
    pub(crate) fn open<'a>(
        &mut self,
        sender: Tag,
        datagram: &'a mut [u8],
    ) -> Result<&'a [u8], Refused> {
        let session = self.live.get_mut(&sender).ok_or(Refused::UnknownSender)?;
        Ok(session.opener.open(datagram)?.plaintext)
    }

    /// Opens a greeting, whose sender must be who it says.
    pub(crate) fn open_greeting(&self, datagram: &mut [u8]) -> Result<Greeting, Refused> {
        let opened = seal::open_hello(&self.key, datagram)?;
        let greeting: Greeting = codec::decode(opened.plaintext).map_err(|_| Refused::Malformed)?;
        let (host, incarnation) = match &greeting {
            Greeting::Hello { from, .. }
            | Greeting::Challenge { from, .. }
            | Greeting::Response { from, .. } => {
                if from.control_addrs.len() > CONTROL_ADDRS_MAX {
                    return Err(Refused::Malformed);
                }
                (from.host, from.incarnation)
            }
            Greeting::Stale {
                from, incarnation, ..
            } => (*from, *incarnation),
        };
        if Tag::of(host, incarnation) != opened.header.sender {
            return Err(Refused::Malformed);
        }
        Ok(greeting)
    }

    /// Answers a greeting. `highest` is the latest life known of the host that speaks.
    pub(crate) fn handle_greeting(
        &mut self,
        addr: SocketAddr,
        greeting: Greeting,
        highest: Option<Incarnation>,
        now: Time,
        rng: &mut Rng,
        out: &mut Outbox,
    ) -> Greeted {
        let from = match &greeting {
            Greeting::Hello { from, .. }
            | Greeting::Challenge { from, .. }
            | Greeting::Response { from, .. } => from,
            Greeting::Stale { to, ordinal, .. } => {
                return if *to == self.tag && *ordinal >= self.me.incarnation.ordinal {
                    Greeted::Superseded { ordinal: *ordinal }
                } else {
                    Greeted::Nothing
                };
            }
        };
        if from.host == self.me.host {
            let other = from.incarnation != self.me.incarnation;
            return if other && from.incarnation.ordinal >= self.me.incarnation.ordinal {
                Greeted::Superseded {
                    ordinal: from.incarnation.ordinal,
                }
            } else {
                Greeted::Nothing
            };
        }
        let sender = Tag::of(from.host, from.incarnation);
        if let Some(highest) = highest
            && highest != from.incarnation
            && highest.ordinal >= from.incarnation.ordinal
        {
            let stale = Greeting::Stale {
                to: sender,
                from: self.me.host,
                incarnation: self.me.incarnation,
                ordinal: highest.ordinal,
            };
            out.greet(Dest::Addr(addr), &stale);
            return Greeted::StaleLife;
        }
        match greeting {
            Greeting::Hello { directed, .. } => {
                self.handle_hello(sender, addr, directed, now, rng, out)
            }
            Greeting::Challenge {
                to, nonce, sent, ..
            } if to == self.tag => self.respond(sender, addr, (nonce, sent), now, rng, out),
            Greeting::Response {
                to,
                nonce,
                echo,
                at,
                challenge,
                from,
            } if to == self.tag => {
                let known = self.pending.get(&sender).is_some_and(|p| p.nonce == nonce);
                if !known || echo > now {
                    return Greeted::StaleResponse;
                }
                let Some(fresh) = self.establish(sender, &from, addr, now, out) else {
                    return Greeted::OverLimit;
                };
                if let Some(nonce) = challenge {
                    // The echo of a nested challenge is the response that carried it.
                    self.respond(sender, addr, (nonce, at), now, rng, out);
                }
                Greeted::Answered {
                    from,
                    addr,
                    exchange: (echo, at),
                    fresh,
                }
            }
            Greeting::Challenge { .. } | Greeting::Response { .. } | Greeting::Stale { .. } => {
                Greeted::StaleResponse
            }
        }
    }

    /// Asks a life of a host to prove itself, unless that is under way. `false` when too many are.
    pub(crate) fn challenge(
        &mut self,
        to: Tag,
        addr: SocketAddr,
        now: Time,
        rng: &mut Rng,
        out: &mut Outbox,
    ) -> bool {
        let room = self.pending.len() < PENDING_MAX;
        let fresh = !self.pending.contains_key(&to);
        if fresh && !room {
            return false;
        }
        let pending = self.pending.entry(to).or_insert_with(|| Pending {
            nonce: rng.next(),
            addr,
            sent: now,
            tries: 0,
            next: now,
        });
        if pending.next <= now {
            pending.addr = addr;
            pending.sent = now;
            pending.next = now + CHALLENGE_RETRY * 2_u32.pow(pending.tries.min(2));
            pending.tries += 1;
            let challenge = Greeting::Challenge {
                from: self.introduction(now),
                to,
                nonce: self.pending.get(&to).map_or(0, |p| p.nonce),
                sent: now,
            };
            out.greet(Dest::Addr(addr), &challenge);
        }
        true
    }

    /// Greets an address where a host is, or was, or should be.
    pub(crate) fn hello(&self, to: Dest, directed: bool, now: Time, out: &mut Outbox) {
        let from = self.introduction(now);
        out.greet(to, &Greeting::Hello { from, directed });
    }

    pub(crate) fn poll_timeout(&self) -> Option<Time> {
        let pending = self.pending.values().map(|p| p.next).min();
        [self.next_seed, self.next_beacon, self.next_news, pending]
            .into_iter()
            .flatten()
            .min()
    }

    pub(crate) fn handle_timeout(&mut self, now: Time, rng: &mut Rng, out: &mut Outbox) {
        if self.next_beacon.is_some_and(|at| at <= now) {
            self.hello(Dest::Beacon, false, now, out);
            let jitter = Duration::from_millis(u64::try_from(rng.below(500)).unwrap_or(0));
            let period = match self.live.is_empty() {
                true => BEACON_PERIOD_ALONE,
                false => BEACON_PERIOD,
            };
            let pause = BEACON_START.get(self.beacons).copied();
            let pause = pause.unwrap_or(period + jitter);
            self.beacons = self.beacons.saturating_add(1);
            self.next_beacon = Some(now + pause);
        }
        if self.next_seed.is_some_and(|at| at <= now) {
            for seed in &self.seeds {
                if !self.paths.knows(*seed) {
                    self.hello(Dest::Addr(*seed), true, now, out);
                }
            }
            self.next_seed = Some(now + SEED_PERIOD);
        }
        if self.next_news.is_some_and(|at| at <= now) {
            self.next_news = NEWS_AGAIN.get(self.news).map(|pause| now + *pause);
            self.news += 1;
            self.tell_addresses(out);
        }
        self.pending
            .retain(|_, p| p.tries < CHALLENGE_TRIES || p.next > now);
        let due: Vec<_> = self.pending.iter().filter(|(_, p)| p.next <= now).collect();
        let due: Vec<_> = due.into_iter().map(|(tag, p)| (*tag, p.addr)).collect();
        for (tag, addr) in due {
            self.challenge(tag, addr, now, rng, out);
        }
    }

    /// Seals one datagram at the end of `buffer` and says where it goes; `None` when its session is over.
    pub(crate) fn seal(&mut self, outgoing: &Outgoing, buffer: &mut Vec<u8>) -> Option<Dest> {
        let (dest, sealer, lane) = match outgoing.target {
            Target::Greeting(dest) => (dest, &mut self.hello, Lane::Hello),
            Target::Session(tag) => {
                let addr = self.paths.addr(tag)?;
                (Dest::Addr(addr), &mut self.control, Lane::Control)
            }
            Target::Path(tag, addr) => {
                self.live.get(&tag)?;
                (Dest::Addr(addr), &mut self.control, Lane::Control)
            }
        };
        let start = buffer.len();
        buffer.extend_from_slice(&outgoing.bytes);
        if sealer.seal(lane, MIXED_STREAMS, buffer, start).is_err() {
            buffer.truncate(start);
            return None;
        }
        Some(dest)
    }

    /// Whether a datagram carries this host's own tag, as multicast returns it.
    pub(crate) fn is_own(&self, header: &Header) -> bool {
        header.sender == self.tag
    }

    fn handle_hello(
        &mut self,
        sender: Tag,
        addr: SocketAddr,
        directed: bool,
        now: Time,
        rng: &mut Rng,
        out: &mut Outbox,
    ) -> Greeted {
        let known = self.live.contains_key(&sender) && !self.paths.is_strange(sender, addr, now);
        let crowded =
            self.live.len() >= EAGER_SESSIONS && rng.below(self.live.len()) >= EAGER_SESSIONS / 2;
        if !directed && (known || crowded) {
            return Greeted::Nothing;
        }
        if self.challenge(sender, addr, now, rng, out) {
            Greeted::Nothing
        } else {
            Greeted::OverLimit
        }
    }

    fn respond(
        &mut self,
        to: Tag,
        addr: SocketAddr,
        (nonce, echo): (u64, Time),
        now: Time,
        rng: &mut Rng,
        out: &mut Outbox,
    ) -> Greeted {
        let mut challenge = None;
        if !self.live.contains_key(&to) {
            if self.pending.len() >= PENDING_MAX && !self.pending.contains_key(&to) {
                return Greeted::OverLimit;
            }
            let pending = self.pending.entry(to).or_insert_with(|| Pending {
                nonce: rng.next(),
                addr,
                sent: now,
                tries: 0,
                next: now,
            });
            pending.sent = now;
            pending.next = now + CHALLENGE_RETRY;
            pending.tries += 1;
            challenge = Some(pending.nonce);
        }
        let from = self.introduction(now);
        let response = Greeting::Response {
            from,
            to,
            nonce,
            echo,
            at: now,
            challenge,
        };
        out.greet(Dest::Addr(addr), &response);
        Greeted::Nothing
    }

    /// Accepts a life that proved itself; says whether it is new, or `None` when there is no room for it.
    fn establish(
        &mut self,
        tag: Tag,
        from: &Introduction,
        addr: SocketAddr,
        now: Time,
        out: &mut Outbox,
    ) -> Option<bool> {
        self.pending.remove(&tag);
        if self.live.contains_key(&tag) {
            self.paths.heard(tag, addr, now, out);
            return Some(false);
        }
        if self.live.len() >= SESSIONS_MAX {
            return None;
        }
        let opener = Opener::new(&self.key, from.host, from.incarnation, Purpose::Control);
        let session = Session {
            host: from.host,
            data_port: from.data_port,
            multicast: from.multicast,
            opener,
        };
        self.live.insert(tag, session);
        self.paths.met(tag, addr, &from.control_addrs, now, out);
        self.tag_of.insert(from.host, tag);
        Some(true)
    }

    /// Says to each host, by each path, where this one is now. Without an address nobody would hear it.
    fn tell_addresses(&self, out: &mut Outbox) {
        if self.me.control_addrs.is_empty() {
            return;
        }
        let news = Message::Addresses {
            revision: self.revision,
            control_addrs: self.me.control_addrs.clone(),
        };
        for tag in self.live.keys() {
            for addr in self.paths.addrs(*tag) {
                out.send_by(*tag, addr, &news);
            }
        }
    }

    fn introduction(&self, now: Time) -> Introduction {
        let age = now.since(self.prefix_since).as_nanos();
        Introduction {
            prefix_age_ns: u64::try_from(age).unwrap_or(u64::MAX),
            ..self.me.clone()
        }
    }
}
