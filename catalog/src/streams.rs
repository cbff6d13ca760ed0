//! What others want of this host: leases, the streams that serve them, and the path of each stream.
//!
//! One stream serves all readers of one item under one contract. One reading host gets unicast. Two or more are offered a
//! group; each is sent both until it confirms that samples arrive there, and then the group alone. Whoever does not
//! confirm although samples flow, or loses more by the group than by unicast, is served by unicast for a while.

use std::collections::{BTreeMap, BTreeSet};
use std::net::SocketAddr;
use std::time::Duration;

use ddx_wire::message::{
    AckEntry, GrantEntry, Message, Reception, RenewEntry, ReportEntry, SubscribeEntry,
};
use ddx_wire::{Contract, DomainId, ItemName, StreamId, Tag, Time};

use crate::config::{SAMPLE_GROUPS, sample_group};
use crate::delivery::{ReaderHost, Route, Via, group_number};
use crate::event::Event;
use crate::outbox::Outbox;
use crate::streams::quality::Quality;

mod quality;

const LEASE: Duration = Duration::from_secs(3);
const TICK: Duration = Duration::from_millis(250);
/// Pause before a group is tried again after a failed trial.
const TRIAL_PAUSE: Duration = Duration::from_secs(30);
/// The same after a reader moved: long enough for its host to join where it is now.
const MOVED_PAUSE: Duration = Duration::from_secs(1);
/// Leases of all hosts. One takes 1,200 B at most with a stream of its own, of which the item's name is the most: 75 MiB.
const LEASES_MAX: usize = 65_536;
const LEASES_PER_HOST_MAX: usize = 16_384;
/// Entries of one grant: they take at most 34 bytes each, with an IPv6 group.
const GRANTS_MAX: usize = 32;

pub(crate) struct Streams {
    domain: DomainId,
    multicast: bool,
    leases: BTreeMap<(Tag, u32), Lease>,
    streams: BTreeMap<StreamId, Stream>,
    by_item: BTreeMap<(ItemName, Contract), StreamId>,
    quality: BTreeMap<Tag, Quality>,
    last: u32,
    next_tick: Option<Time>,
}

/// Where a reading host receives.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ReaderAddr {
    pub(crate) data: SocketAddr,
    pub(crate) multicast: bool,
}

struct Lease {
    stream: StreamId,
    at: ReaderAddr,
    expires: Time,
    /// Withdrawn; kept until it lapses, so that a late request cannot bring it back.
    closed: bool,
    group: Option<SocketAddr>,
    reception: Reception,
    /// The group is not tried before: it was silent.
    unicast_until: Time,
    /// Since when it is served as it is.
    since: Time,
    /// The last trial of the group brought nothing.
    silent: bool,
}

struct Stream {
    name: ItemName,
    contract: Contract,
    readers: BTreeMap<Tag, u32>,
    route: Option<Route>,
}

/// A stream that this host sends, for listings.
#[derive(Clone, Debug, PartialEq)]
pub struct StreamOut {
    /// Its number.
    pub stream: StreamId,
    /// The item.
    pub name: ItemName,
    /// To whom, how often and by what path.
    pub route: Route,
    /// Why each reader is served as it is, in the order of the route.
    pub choices: Vec<Choice>,
}

/// The figures behind the way of a stream to one reading host.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Choice {
    /// Since when it is served so.
    pub since: Time,
    /// Share of datagrams lost by unicast, 0 where nothing is known.
    pub unicast_loss: f64,
    /// Share of datagrams lost by the item's group, if any came or should have.
    pub group_loss: Option<f64>,
    /// Why the group is not used; none where it is, and where it would serve one reader alone.
    pub shuns: Option<Shuns>,
}

/// Why a reading host is not served by a group.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Shuns {
    /// Samples came by unicast, and none by the group.
    Silent,
    /// It lost more by the group than by unicast: shares of datagrams when it was given up.
    Loses {
        /// By the group.
        group: f64,
        /// By unicast.
        unicast: f64,
    },
}

impl Streams {
    pub(crate) fn new(domain: DomainId, multicast: bool) -> Self {
        Self {
            domain,
            multicast,
            leases: BTreeMap::new(),
            streams: BTreeMap::new(),
            by_item: BTreeMap::new(),
            quality: BTreeMap::new(),
            last: 0,
            next_tick: None,
        }
    }

    /// Takes in requests of a host. The number of those that exceeded a limit.
    pub(crate) fn handle_subscribe(
        &mut self,
        from: Tag,
        at: ReaderAddr,
        entries: Vec<SubscribeEntry>,
        exists: impl Fn(&ItemName) -> bool,
        now: Time,
        out: &mut Outbox,
    ) -> u64 {
        let mut grants = Vec::new();
        let mut refused = 0;
        let mut count = self.leases.range((from, 0)..=(from, u32::MAX)).count();
        for entry in entries {
            let key = (from, entry.want);
            if let Some(lease) = self.leases.get_mut(&key) {
                if !lease.closed {
                    lease.expires = now + LEASE;
                    let (stream, group) = (Some(lease.stream), lease.group);
                    grants.push(GrantEntry {
                        want: entry.want,
                        stream,
                        group,
                    });
                }
                continue;
            }
            if !exists(&entry.name) {
                grants.push(GrantEntry {
                    want: entry.want,
                    stream: None,
                    group: None,
                });
                continue;
            }
            if count >= LEASES_PER_HOST_MAX || self.leases.len() >= LEASES_MAX {
                refused += 1;
                continue;
            }
            count += 1;
            let id = self.stream_for(entry.name, entry.contract);
            let held = (entry.epoch, entry.seq);
            let lease = Lease {
                stream: id,
                at,
                expires: now + LEASE,
                closed: false,
                group: None,
                reception: Reception::Unknown,
                unicast_until: now,
                since: now,
                silent: false,
            };
            self.leases.insert(key, lease);
            if let Some(stream) = self.streams.get_mut(&id)
                && let Some(before) = stream.readers.insert(from, entry.want)
            {
                // The same host asked for the same thing under another number: the newer one counts.
                self.leases.remove(&(from, before));
            }
            self.route(id, now, out);
            out.offer(Event::Held {
                stream: id,
                tag: from,
                epoch: held.0,
                seq: held.1,
            });
            let group = self.leases.get(&key).and_then(|lease| lease.group);
            grants.push(GrantEntry {
                want: entry.want,
                stream: Some(id),
                group,
            });
        }
        for grants in grants.chunks(GRANTS_MAX) {
            out.send(from, &Message::Grant(grants.to_vec()));
        }
        self.next_tick.get_or_insert(now + TICK);
        refused
    }

    /// Takes in goodbyes of a host.
    pub(crate) fn handle_unsubscribe(
        &mut self,
        from: Tag,
        wants: &[u32],
        now: Time,
        out: &mut Outbox,
    ) {
        for want in wants {
            if let Some(lease) = self.leases.get_mut(&(from, *want))
                && !lease.closed
            {
                lease.closed = true;
                lease.expires = now + LEASE;
                let stream = lease.stream;
                if self.leave(stream, from, *want, out) {
                    self.route(stream, now, out);
                }
            }
        }
    }

    /// Takes in a renewal. The interests in it that are not known.
    pub(crate) fn handle_renew(
        &mut self,
        from: Tag,
        at: ReaderAddr,
        entries: &[RenewEntry],
        now: Time,
        out: &mut Outbox,
    ) -> Vec<u32> {
        let mut unknown = Vec::new();
        let mut grants = Vec::new();
        for entry in entries {
            let lease = self
                .leases
                .get_mut(&(from, entry.want))
                .filter(|lease| !lease.closed);
            let Some(lease) = lease else {
                unknown.push(entry.want);
                continue;
            };
            lease.expires = now + LEASE;
            let stream = lease.stream;
            let joined = entry.joined && lease.group.is_some();
            let reception = if joined {
                entry.reception
            } else {
                Reception::Unknown
            };
            let changed = lease.at.data != at.data || lease.reception != reception;
            lease.at = at;
            lease.reception = reception;
            lease.silent &= reception != Reception::Arrives;
            if entry.joined != lease.group.is_some() {
                let (stream, group) = (Some(stream), lease.group);
                grants.push(GrantEntry {
                    want: entry.want,
                    stream,
                    group,
                });
            }
            let (epoch, seq) = (entry.epoch, entry.seq);
            out.offer(Event::Held {
                stream,
                tag: from,
                epoch,
                seq,
            });
            if changed {
                self.route(stream, now, out);
            }
        }
        for grants in grants.chunks(GRANTS_MAX) {
            out.send(from, &Message::Grant(grants.to_vec()));
        }
        unknown
    }

    /// Takes in acks of a host.
    pub(crate) fn handle_ack(&mut self, from: Tag, entries: &[AckEntry], out: &mut Outbox) {
        for entry in entries {
            let stream = self.streams.get(&entry.stream);
            if stream.is_none_or(|stream| !stream.readers.contains_key(&from)) {
                continue;
            }
            out.offer(Event::Held {
                stream: entry.stream,
                tag: from,
                epoch: entry.epoch,
                seq: entry.seq,
            });
        }
    }

    /// Takes in how datagrams reach a host: a group that does not work is given up for it.
    pub(crate) fn handle_report(
        &mut self,
        from: Tag,
        reports: &[ReportEntry],
        now: Time,
        out: &mut Outbox,
    ) {
        if !self.serves(from) {
            return;
        }
        let quality = self.quality.entry(from).or_default();
        let mut turned = false;
        for report in reports {
            turned |= quality.handle_report(report, now);
        }
        if turned {
            let leases = self.leases.range((from, 0)..=(from, u32::MAX));
            let streams: Vec<_> = leases.map(|(_, lease)| lease.stream).collect();
            for stream in streams {
                self.route(stream, now, out);
            }
        }
    }

    /// Sends what a host reads to another address of it from now on.
    ///
    /// Its group may not reach it there: it is served by unicast for a moment, until a new trial has shown that the group
    /// does.
    pub(crate) fn moved(&mut self, reader: Tag, at: ReaderAddr, now: Time, out: &mut Outbox) {
        let leases = self.leases.range_mut((reader, 0)..=(reader, u32::MAX));
        let mut streams = Vec::new();
        for (_, lease) in leases.filter(|(_, lease)| lease.at.data != at.data) {
            lease.at = at;
            lease.unicast_until = lease.unicast_until.max(now + MOVED_PAUSE);
            if !lease.closed {
                streams.push(lease.stream);
            }
        }
        for id in streams {
            self.route(id, now, out);
        }
    }

    /// Forgets what a host wanted.
    pub(crate) fn drop_reader(&mut self, reader: Tag, now: Time, out: &mut Outbox) {
        self.quality.remove(&reader);
        let leases = self.leases.range((reader, 0)..=(reader, u32::MAX));
        let leases: Vec<_> = leases
            .map(|((_, want), lease)| (*want, lease.stream))
            .collect();
        let leases = leases.into_iter();
        self.end(
            leases.map(|(want, stream)| ((reader, want), stream)),
            now,
            out,
        );
    }

    /// Ends the streams of an item that was withdrawn.
    pub(crate) fn drop_item(&mut self, name: &ItemName, out: &mut Outbox) {
        let ended = self
            .streams
            .iter()
            .filter(|(_, stream)| stream.name == *name);
        let ended: Vec<_> = ended.map(|(id, _)| *id).collect();
        for id in ended {
            if let Some(stream) = self.streams.remove(&id) {
                self.by_item.remove(&(stream.name, stream.contract));
                out.event(Event::CloseStream { stream: id });
            }
            self.leases.retain(|_, lease| lease.stream != id);
        }
    }

    /// Whether a host reads something here.
    pub(crate) fn serves(&self, reader: Tag) -> bool {
        self.leases
            .range((reader, 0)..=(reader, u32::MAX))
            .any(|(_, lease)| !lease.closed)
    }

    pub(crate) fn iter(&self) -> impl Iterator<Item = StreamOut> {
        self.streams.iter().filter_map(|(id, stream)| {
            let route = stream.route.clone()?;
            let choices = route
                .readers
                .iter()
                .map(|reader| self.choice(stream, reader));
            Some(StreamOut {
                stream: *id,
                name: stream.name.clone(),
                choices: choices.collect(),
                route,
            })
        })
    }

    pub(crate) fn poll_timeout(&self) -> Option<Time> {
        self.next_tick
    }

    /// Ends leases that lapsed, and tries groups again that failed a while ago.
    pub(crate) fn handle_timeout(&mut self, now: Time, out: &mut Outbox) {
        if self.next_tick.is_none_or(|at| at > now) {
            return;
        }
        let lapsed = self.leases.iter().filter(|(_, lease)| lease.expires <= now);
        let lapsed: Vec<_> = lapsed.map(|(key, lease)| (*key, lease.stream)).collect();
        self.end(lapsed.into_iter(), now, out);
        let tried: Vec<_> = self
            .streams
            .iter()
            .filter(|(_, stream)| stream.readers.len() >= 2)
            .map(|(id, _)| *id)
            .collect();
        for id in tried {
            self.route(id, now, out);
        }
        // A lease ends on time; one that was withdrawn has nothing left to end.
        let held = self.leases.values().filter(|lease| !lease.closed);
        let first = held.map(|lease| lease.expires).min();
        let tick = now + TICK;
        self.next_tick =
            (!self.leases.is_empty()).then(|| first.map_or(tick, |first| first.min(tick)));
    }

    fn stream_for(&mut self, name: ItemName, contract: Contract) -> StreamId {
        let key = (name.clone(), contract);
        if let Some(id) = self.by_item.get(&key) {
            return *id;
        }
        // Zero stands for a mixture of streams. Numbers come round after four thousand million streams.
        self.last = self.last.checked_add(1).unwrap_or(1);
        let id = StreamId(self.last);
        self.by_item.insert(key, id);
        let stream = Stream {
            name,
            contract,
            readers: BTreeMap::new(),
            route: None,
        };
        self.streams.insert(id, stream);
        id
    }

    /// Ends leases. Each stream that goes on gets one new route, however many of its readers left at once.
    fn end(
        &mut self,
        leases: impl Iterator<Item = ((Tag, u32), StreamId)>,
        now: Time,
        out: &mut Outbox,
    ) {
        let mut left = BTreeSet::new();
        for ((reader, want), stream) in leases {
            self.leases.remove(&(reader, want));
            if self.leave(stream, reader, want, out) {
                left.insert(stream);
            }
        }
        for stream in left {
            // It may have ended since with its last reader.
            self.route(stream, now, out);
        }
    }

    /// Removes a reader from a stream, and the stream with its last reader. Whether it goes on without that reader.
    fn leave(&mut self, id: StreamId, reader: Tag, want: u32, out: &mut Outbox) -> bool {
        let Some(stream) = self.streams.get_mut(&id) else {
            return false;
        };
        if stream.readers.get(&reader) != Some(&want) {
            return false;
        }
        stream.readers.remove(&reader);
        if !stream.readers.is_empty() {
            return true;
        }
        if let Some(stream) = self.streams.remove(&id) {
            self.by_item.remove(&(stream.name, stream.contract));
        }
        out.event(Event::CloseStream { stream: id });
        false
    }

    /// Settles the path of a stream, tells the sender, and offers the group to those who do not know of it.
    fn route(&mut self, id: StreamId, now: Time, out: &mut Outbox) {
        let Some(stream) = self.streams.get_mut(&id) else {
            return;
        };
        let group = sample_group(self.domain, group_index(&stream.name));
        let mut members = BTreeMap::new();
        for (tag, want) in &stream.readers {
            let Some(lease) = self.leases.get_mut(&(*tag, *want)) else {
                continue;
            };
            if lease.reception == Reception::Silent {
                lease.unicast_until = now + TRIAL_PAUSE;
                lease.silent = true;
            }
            let works = self.quality.get(tag).zip(group_number(group));
            let works = works.is_none_or(|(quality, number)| quality.admits(number, now));
            let tried = self.multicast && lease.at.multicast && now >= lease.unicast_until && works;
            members.insert(*tag, tried);
        }
        if members.values().filter(|tried| **tried).count() < 2 {
            members.values_mut().for_each(|tried| *tried = false);
        }
        let mut route = Route {
            contract: stream.contract,
            readers: Vec::new(),
        };
        for (tag, want) in &stream.readers {
            let Some(lease) = self.leases.get_mut(&(*tag, *want)) else {
                continue;
            };
            let offered = members
                .get(tag)
                .is_some_and(|tried| *tried)
                .then_some(group);
            if lease.group != offered {
                lease.group = offered;
                (lease.reception, lease.since) = (Reception::Unknown, now);
                let grant = GrantEntry {
                    want: *want,
                    stream: Some(id),
                    group: offered,
                };
                out.send(*tag, &Message::Grant(vec![grant]));
            }
            route.readers.push(ReaderHost {
                tag: *tag,
                addr: lease.at.data,
                via: match offered {
                    None => Via::Unicast,
                    Some(group) if lease.reception == Reception::Arrives => Via::Group(group),
                    Some(group) => Via::Both(group),
                },
            });
        }
        if stream.route.as_ref() != Some(&route) {
            let first = stream.route.is_none();
            stream.route = Some(route.clone());
            out.event(if first {
                Event::OpenStream {
                    stream: id,
                    name: stream.name.clone(),
                    route,
                }
            } else {
                Event::UpdateStream { stream: id, route }
            });
        }
    }

    fn choice(&self, stream: &Stream, reader: &ReaderHost) -> Choice {
        let lease = stream.readers.get(&reader.tag);
        let lease = lease.and_then(|want| self.leases.get(&(reader.tag, *want)));
        let quality = self.quality.get(&reader.tag);
        let number = group_number(sample_group(self.domain, group_index(&stream.name)));
        Choice {
            since: lease.map_or(Time(0), |lease| lease.since),
            unicast_loss: quality.map_or(0.0, Quality::unicast_loss),
            group_loss: quality
                .zip(number)
                .and_then(|(q, number)| q.group_loss(number)),
            shuns: match reader.via {
                Via::Group(_) | Via::Both(_) => None,
                Via::Unicast if stream.readers.len() < 2 => None,
                Via::Unicast if lease.is_some_and(|lease| lease.silent) => Some(Shuns::Silent),
                Via::Unicast => {
                    let losses = quality.zip(number).and_then(|(q, n)| q.shunned(n));
                    losses.map(|(group, unicast)| Shuns::Loses { group, unicast })
                }
            },
        }
    }
}

/// Items spread over the groups by a hash of their names that every host computes alike: FNV-1a.
fn group_index(name: &ItemName) -> u8 {
    let hash = name.as_str().bytes().fold(0x811c_9dc5_u32, |hash, byte| {
        (hash ^ u32::from(byte)).wrapping_mul(0x0100_0193)
    });
    let index = hash % u32::from(SAMPLE_GROUPS);
    u8::try_from(index).unwrap_or(0)
}

#[cfg(test)]
mod tests {
    use ddx_wire::{Epoch, HostName, Seq};

    use super::*;

    const NOW: Time = Time(1_000_000_000);

    fn item() -> ItemName {
        ItemName::parse("gps", &HostName::parse("r").unwrap()).unwrap()
    }

    fn reader(streams: &mut Streams, host: u64, want: u32, at: Time, out: &mut Outbox) {
        let entry = SubscribeEntry {
            want,
            name: item(),
            contract: Contract::default(),
            epoch: Epoch(0),
            seq: Seq(0),
        };
        let addr = ReaderAddr {
            data: "10.0.0.2:5".parse().unwrap(),
            multicast: true,
        };
        streams.handle_subscribe(Tag(host), addr, vec![entry], |_| true, at, out);
    }

    fn renew(streams: &mut Streams, host: u64, want: u32, reception: Reception, at: Time) -> usize {
        let addr = ReaderAddr {
            data: "10.0.0.2:5".parse().unwrap(),
            multicast: true,
        };
        let entry = RenewEntry {
            want,
            epoch: Epoch(1),
            seq: Seq(1),
            joined: true,
            reception,
        };
        let out = &mut Outbox::default();
        streams
            .handle_renew(Tag(host), addr, &[entry], at, out)
            .len()
    }

    fn path(streams: &Streams) -> Vec<&'static str> {
        let stream = streams.iter().next();
        let readers = stream.into_iter().flat_map(|stream| stream.route.readers);
        readers
            .map(|reader| match reader.via {
                Via::Unicast => "unicast",
                Via::Group(_) => "group",
                Via::Both(_) => "both",
            })
            .collect()
    }

    #[test]
    fn the_path_follows_what_readers_report() {
        let (mut streams, mut out) = (Streams::new(DomainId(1), true), Outbox::default());
        reader(&mut streams, 1, 1, NOW, &mut out);
        assert_eq!(path(&streams), ["unicast"]);
        reader(&mut streams, 2, 1, NOW, &mut out);
        assert_eq!(path(&streams), ["both", "both"]);
        renew(&mut streams, 1, 1, Reception::Arrives, NOW);
        assert_eq!(path(&streams), ["group", "both"]);
        renew(&mut streams, 2, 1, Reception::Arrives, NOW);
        assert_eq!(path(&streams), ["group", "group"]);
        renew(&mut streams, 2, 1, Reception::Silent, NOW);
        assert_eq!(path(&streams), ["unicast", "unicast"]);
        let stream = streams.iter().next().unwrap();
        let shuns: Vec<_> = stream.choices.iter().map(|choice| choice.shuns).collect();
        assert_eq!(shuns, [None, Some(Shuns::Silent)]);
        // With a third, the deaf one alone stays on unicast.
        reader(&mut streams, 3, 1, NOW, &mut out);
        assert_eq!(path(&streams), ["both", "unicast", "both"]);
    }

    #[test]
    fn a_withdrawn_interest_is_not_brought_back_by_a_late_request() {
        let (mut streams, mut out) = (Streams::new(DomainId(1), true), Outbox::default());
        reader(&mut streams, 1, 5, NOW, &mut out);
        streams.handle_unsubscribe(Tag(1), &[5], NOW, &mut out);
        assert!(path(&streams).is_empty());
        reader(&mut streams, 1, 5, NOW, &mut out);
        assert!(path(&streams).is_empty());
        assert_eq!(
            renew(&mut streams, 1, 5, Reception::Unknown, NOW),
            1,
            "unknown"
        );
        reader(&mut streams, 1, 6, NOW, &mut out);
        assert_eq!(path(&streams), ["unicast"]);
    }

    #[test]
    fn a_lease_lapses_three_seconds_after_the_last_renewal() {
        let (mut streams, mut out) = (Streams::new(DomainId(1), true), Outbox::default());
        reader(&mut streams, 1, 1, NOW, &mut out);
        let renewed = NOW + Duration::from_millis(1_100);
        renew(&mut streams, 1, 1, Reception::Unknown, renewed);

        let lapses = renewed + LEASE;
        let mut last = NOW;
        while let Some(at) = streams.poll_timeout().filter(|at| *at < lapses) {
            streams.handle_timeout(at, &mut out);
            last = at;
        }

        assert!(lapses.since(last) <= TICK, "it was looked at to the last");
        assert_eq!(path(&streams), ["unicast"]);
        assert_eq!(streams.poll_timeout(), Some(lapses));
        streams.handle_timeout(lapses, &mut out);
        assert!(path(&streams).is_empty());
    }
}
