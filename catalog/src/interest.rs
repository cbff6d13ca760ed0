//! What this host wants of others: subscriptions, renewals that say what is held, and goodbyes.
//!
//! A subscription waits until its item is known, is asked for until it is granted, and is then renewed each second, all
//! that one owner sends in one datagram. A change of contract is a new interest with a new number, so that a late datagram
//! about the old one cannot harm it.

use std::collections::{BTreeMap, BTreeSet};
use std::net::SocketAddr;
use std::time::Duration;

use ddx_wire::message::{AckEntry, GrantEntry, Message, Reception, RenewEntry, SubscribeEntry};
use ddx_wire::{Contract, Epoch, ItemDescription, ItemName, Seq, StreamId, Tag, Time};

use self::farewells::Farewells;
use crate::error::Error;
use crate::event::Event;
use crate::outbox::Outbox;

mod farewells;

const RENEW_PERIOD: Duration = Duration::from_secs(1);
/// What is unanswered is said again after this, twice this, and so on up to eight times this.
const RETRY: Duration = Duration::from_millis(50);
/// So often; then the other host is thought away, and tried each second. At a loss of one in three, fewer fast tries
/// in a row would fail now and then, and with them the lease.
const RETRIES: u32 = 16;
const RETRY_SLOW: Duration = Duration::from_secs(1);
/// Acks of several streams that fall quiet together travel together.
const ACK_AFTER: Duration = Duration::from_millis(20);
/// A path that was seen to work is reported after this, together with its neighbours.
const CONFIRM_AFTER: Duration = Duration::from_millis(5);
/// A group is silent when samples arrive for so long, and none by it.
const SILENT_AFTER: Duration = Duration::from_millis(500);
/// Entries of one renewal, ack or goodbye: they take at most 27 bytes each.
const ENTRIES_MAX: usize = 40;
/// Bytes of names in one request, which leave room for the rest of its entries.
const ASK_BYTES: usize = 1_000;
const ASK_ENTRY_BYTES: usize = 36;
/// Items that this host wants. One takes 1,500 B at most, of which its name is the most: 24 MiB.
const SUBSCRIPTIONS_MAX: usize = 16_384;

#[derive(Default)]
pub(crate) struct Interest {
    wants: BTreeMap<ItemName, Want>,
    name_of: BTreeMap<u32, ItemName>,
    streams: BTreeMap<(Tag, StreamId), ItemName>,
    links: BTreeMap<Tag, Link>,
    groups: BTreeMap<SocketAddr, usize>,
    farewells: Farewells,
    last_number: u32,
}

struct Want {
    number: u32,
    contract: Contract,
    phase: Phase,
    epoch: Epoch,
    seq: Seq,
}

enum Phase {
    /// No owner is known.
    Pending,
    Asked {
        owner: Tag,
        name: ItemName,
        next: Time,
        tries: u32,
    },
    Granted {
        owner: Tag,
        name: ItemName,
        stream: StreamId,
        group: Option<SocketAddr>,
        arrives: bool,
        /// Since when samples arrive by any path, after the group was granted.
        flows: Option<Time>,
        since: Time,
        left_group: Option<SocketAddr>,
    },
}

/// What goes to one owner.
struct Link {
    next_renewal: Time,
    /// When the last renewal was sent, and how many since the last answer to one.
    sent: Time,
    unanswered: u32,
    acks: BTreeSet<StreamId>,
    next_ack: Option<Time>,
}

/// A stream that this host receives, for listings.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct StreamIn {
    /// Name under which the item was subscribed.
    pub name: ItemName,
    /// The sending host, once the owner is known.
    pub tag: Option<Tag>,
    /// Its number for the stream, once granted.
    pub stream: Option<StreamId>,
    /// What was asked.
    pub contract: Contract,
    /// The group that was joined for it.
    pub group: Option<SocketAddr>,
    /// Whether samples arrive by that group.
    pub arrives: bool,
    /// Since when it comes this way.
    pub since: Option<Time>,
    /// The group that it came by, or was to come by, before its owner gave that up.
    pub left_group: Option<SocketAddr>,
}

impl Interest {
    /// Begins or changes a subscription. `owner` is the life and the owner's own name for the item, when it is known.
    pub(crate) fn subscribe(
        &mut self,
        name: ItemName,
        contract: Contract,
        owner: Option<(Tag, ItemName)>,
        now: Time,
        out: &mut Outbox,
    ) -> Result<(), Error> {
        let (mut epoch, mut seq) = (Epoch(0), Seq(0));
        if let Some(want) = self.wants.get(&name) {
            if want.contract == contract {
                return Ok(());
            }
            (epoch, seq) = (want.epoch, want.seq);
            self.unsubscribe(&name, now, out);
        } else if self.wants.len() >= SUBSCRIPTIONS_MAX {
            return Err(Error::TooManySubscriptions {
                name,
                limit: SUBSCRIPTIONS_MAX,
            });
        }
        self.last_number = self.last_number.wrapping_add(1);
        let number = self.last_number;
        let phase = Phase::asked(owner, now);
        self.name_of.insert(number, name.clone());
        self.wants.insert(
            name,
            Want {
                number,
                contract,
                phase,
                epoch,
                seq,
            },
        );
        Ok(())
    }

    /// Ends a subscription. `false` when there was none.
    pub(crate) fn unsubscribe(&mut self, name: &ItemName, now: Time, out: &mut Outbox) -> bool {
        let Some(want) = self.wants.remove(name) else {
            return false;
        };
        self.name_of.remove(&want.number);
        if let Some(owner) = want.phase.owner() {
            out.send(owner, &Message::Unsubscribe(vec![want.number]));
            self.farewells.repeat(owner, want.number, now);
        }
        self.release(&want.phase, out);
        true
    }

    /// Follows an item that appeared, moved or went.
    pub(crate) fn resolve(
        &mut self,
        name: &ItemName,
        owner: Option<(Tag, ItemName)>,
        now: Time,
        out: &mut Outbox,
    ) {
        let Some(want) = self.wants.get_mut(name) else {
            return;
        };
        let same = match (&want.phase, &owner) {
            (Phase::Pending, None) => true,
            (
                Phase::Asked {
                    owner: tag, name, ..
                }
                | Phase::Granted {
                    owner: tag, name, ..
                },
                Some((new_tag, new_name)),
            ) => (tag, name) == (new_tag, new_name),
            (Phase::Pending, Some(_)) | (Phase::Asked { .. } | Phase::Granted { .. }, None) => {
                false
            }
        };
        if same {
            return;
        }
        let before = std::mem::replace(&mut want.phase, Phase::asked(owner, now));
        self.release(&before, out);
    }

    /// Takes in what an owner granted. `describe` finds what is known of an item.
    pub(crate) fn handle_grant(
        &mut self,
        from: Tag,
        entries: &[GrantEntry],
        describe: impl Fn(&ItemName) -> Option<ItemDescription>,
        now: Time,
        out: &mut Outbox,
    ) {
        for entry in entries {
            let Some(name) = self.name_of.get(&entry.want) else {
                continue;
            };
            let Some(want) = self.wants.get_mut(name) else {
                continue;
            };
            if want.phase.owner() != Some(from) {
                continue;
            }
            let Some(stream) = entry.stream else {
                // The owner does not have the item yet, or any longer: its directory will say, meanwhile ask slowly.
                if let Phase::Asked { next, .. } = &mut want.phase {
                    *next = now + RETRY_SLOW;
                }
                continue;
            };
            if let Phase::Granted {
                stream: known,
                group,
                ..
            } = &want.phase
                && (*known, *group) == (stream, entry.group)
            {
                continue;
            }
            let Some(description) = describe(name) else {
                continue;
            };
            let Some(own_name) = want.phase.name() else {
                continue;
            };
            let (name, contract) = (name.clone(), want.contract);
            let left_group = match &want.phase {
                Phase::Granted {
                    group, left_group, ..
                } => group.or(*left_group).filter(|_| entry.group.is_none()),
                Phase::Pending | Phase::Asked { .. } => None,
            };
            let granted = Phase::Granted {
                owner: from,
                name: own_name,
                stream,
                group: entry.group,
                arrives: false,
                flows: None,
                since: now,
                left_group,
            };
            let before = std::mem::replace(&mut want.phase, granted);
            let same = matches!(before, Phase::Granted { stream: known, .. } if known == stream);
            if let Some(group) = entry.group {
                self.join(group, out);
            }
            if let Phase::Granted {
                group: Some(group), ..
            } = before
            {
                self.part(group, out);
            }
            if !same {
                if let Phase::Granted { stream, .. } = before {
                    self.streams.remove(&(from, stream));
                    out.event(Event::Forget { tag: from, stream });
                }
                self.streams.insert((from, stream), name.clone());
                out.event(Event::Expect {
                    tag: from,
                    stream,
                    name,
                    description,
                    contract,
                });
            }
            let soon = if entry.group.is_some() {
                now
            } else {
                now + RENEW_PERIOD
            };
            let link = self.link(from, now);
            link.next_renewal = link.next_renewal.min(soon);
            link.unanswered = 0;
        }
    }

    /// Takes in the answer to a renewal: interests that the owner does not know are asked for again.
    pub(crate) fn handle_renewed(
        &mut self,
        from: Tag,
        echo: Time,
        unknown: &[u32],
        now: Time,
        out: &mut Outbox,
    ) {
        // The answer to an earlier renewal does not say that the last one arrived.
        if let Some(link) = self.links.get_mut(&from)
            && link.unanswered > 0
            && link.sent == echo
        {
            link.unanswered = 0;
            link.next_renewal = echo + RENEW_PERIOD;
        }
        for number in unknown {
            let want = self
                .name_of
                .get(number)
                .and_then(|name| self.wants.get_mut(name));
            let Some(want) = want.filter(|want| want.phase.owner() == Some(from)) else {
                continue;
            };
            if matches!(want.phase, Phase::Granted { .. }) {
                let owner = want.phase.name().map(|name| (from, name));
                let before = std::mem::replace(&mut want.phase, Phase::asked(owner, now));
                self.release(&before, out);
            }
        }
    }

    /// Notes what is held of a stream; `quiet` asks for an ack soon.
    pub(crate) fn holds(
        &mut self,
        from: Tag,
        stream: StreamId,
        (epoch, seq): (Epoch, Seq),
        quiet: bool,
        now: Time,
    ) {
        let name = self.streams.get(&(from, stream));
        let Some(want) = name.and_then(|name| self.wants.get_mut(name)) else {
            return;
        };
        let mut begins = false;
        if (epoch, seq) > (want.epoch, want.seq) {
            (want.epoch, want.seq) = (epoch, seq);
            if let Phase::Granted {
                group: Some(_),
                arrives: false,
                flows,
                ..
            } = &mut want.phase
            {
                begins = flows.is_none();
                flows.get_or_insert(now);
            }
        }
        if begins {
            // In time to say that none came by the group.
            let link = self.link(from, now);
            link.next_renewal = link.next_renewal.min(now + SILENT_AFTER);
        }
        if quiet {
            let link = self.link(from, now);
            link.acks.insert(stream);
            link.next_ack.get_or_insert(now + ACK_AFTER);
        }
    }

    /// Notes that samples of a stream arrive by its group.
    pub(crate) fn heard_on_group(&mut self, from: Tag, stream: StreamId, now: Time) {
        let name = self.streams.get(&(from, stream));
        if let Some(want) = name.and_then(|name| self.wants.get_mut(name))
            && let Phase::Granted {
                group: Some(_),
                arrives,
                ..
            } = &mut want.phase
            && !*arrives
        {
            *arrives = true;
            let link = self.link(from, now);
            link.next_renewal = link.next_renewal.min(now + CONFIRM_AFTER);
            link.unanswered = 0;
        }
    }

    /// Says at once what is held, to an owner that was silent for a while.
    pub(crate) fn renew_now(&mut self, owner: Tag, now: Time) {
        if let Some(link) = self.links.get_mut(&owner) {
            link.next_renewal = now;
            link.unanswered = 0;
        }
        for want in self.wants.values_mut() {
            if let Phase::Asked {
                owner: tag,
                next,
                tries,
                ..
            } = &mut want.phase
                && *tag == owner
            {
                (*next, *tries) = (now, 0);
            }
        }
    }

    /// Forgets a life that ended: what it sent waits for another owner.
    pub(crate) fn drop_owner(&mut self, owner: Tag, out: &mut Outbox) {
        self.links.remove(&owner);
        self.farewells.drop_owner(owner);
        let mut released = Vec::new();
        for want in self.wants.values_mut() {
            if want.phase.owner() == Some(owner) {
                released.push(std::mem::replace(&mut want.phase, Phase::Pending));
            }
        }
        for phase in released {
            self.release(&phase, out);
        }
    }

    /// Goodbyes that are not said again, because too many wait for that.
    pub(crate) fn dropped(&self) -> u64 {
        self.farewells.dropped
    }

    /// Whether this host reads something of that life.
    pub(crate) fn reads(&self, owner: Tag) -> bool {
        self.links.contains_key(&owner)
    }

    pub(crate) fn names(&self) -> impl Iterator<Item = &ItemName> {
        self.wants.keys()
    }

    pub(crate) fn streams(&self) -> impl Iterator<Item = StreamIn> {
        self.wants.iter().map(|(name, want)| {
            let asked = StreamIn {
                name: name.clone(),
                tag: want.phase.owner(),
                stream: None,
                contract: want.contract,
                group: None,
                arrives: false,
                since: None,
                left_group: None,
            };
            match &want.phase {
                Phase::Granted {
                    stream,
                    group,
                    arrives,
                    since,
                    left_group,
                    ..
                } => StreamIn {
                    stream: Some(*stream),
                    group: *group,
                    arrives: *arrives,
                    since: Some(*since),
                    left_group: *left_group,
                    ..asked
                },
                Phase::Pending | Phase::Asked { .. } => asked,
            }
        })
    }

    pub(crate) fn poll_timeout(&self) -> Option<Time> {
        let asks = self.wants.values().filter_map(|want| match &want.phase {
            Phase::Asked { next, .. } => Some(*next),
            Phase::Pending | Phase::Granted { .. } => None,
        });
        let links = self.links.values().map(|link| {
            link.next_ack
                .map_or(link.next_renewal, |ack| ack.min(link.next_renewal))
        });
        asks.chain(links).chain(self.farewells.poll_timeout()).min()
    }

    /// Sends what is due; the owners that were sent a renewal.
    pub(crate) fn handle_timeout(&mut self, now: Time, out: &mut Outbox) -> Vec<Tag> {
        self.farewells.handle_timeout(now, out);
        self.ask(now, out);
        let mut renewed = Vec::new();
        for (owner, link) in &mut self.links {
            if link.next_ack.is_some_and(|at| at <= now) {
                link.next_ack = None;
                let entries: Vec<_> = std::mem::take(&mut link.acks)
                    .into_iter()
                    .filter_map(|stream| {
                        let want = self.wants.get(self.streams.get(&(*owner, stream))?)?;
                        Some(AckEntry {
                            stream,
                            epoch: want.epoch,
                            seq: want.seq,
                        })
                    })
                    .collect();
                for entries in entries.chunks(ENTRIES_MAX) {
                    out.send(*owner, &Message::Ack(entries.to_vec()));
                }
            }
            if link.next_renewal <= now {
                link.next_renewal = now + retry_after(link.unanswered);
                link.unanswered = link.unanswered.saturating_add(1);
                link.sent = now;
                renewed.push(*owner);
            }
        }
        renewed.retain(|owner| {
            let entries = self.renewal(*owner, now);
            for entries in entries.chunks(ENTRIES_MAX) {
                out.send(
                    *owner,
                    &Message::Renew {
                        sent: now,
                        entries: entries.to_vec(),
                    },
                );
            }
            if entries.is_empty() {
                self.links.remove(owner);
            }
            !entries.is_empty()
        });
        renewed
    }

    fn renewal(&self, owner: Tag, now: Time) -> Vec<RenewEntry> {
        let from = (owner, StreamId(0));
        let to = (owner, StreamId(u32::MAX));
        self.streams
            .range(from..=to)
            .filter_map(|(_, name)| {
                let want = self.wants.get(name)?;
                let Phase::Granted {
                    group,
                    arrives,
                    flows,
                    ..
                } = &want.phase
                else {
                    return None;
                };
                let reception = match flows {
                    _ if *arrives => Reception::Arrives,
                    Some(since) if now.since(*since) >= SILENT_AFTER => Reception::Silent,
                    Some(_) | None => Reception::Unknown,
                };
                Some(RenewEntry {
                    want: want.number,
                    epoch: want.epoch,
                    seq: want.seq,
                    joined: group.is_some(),
                    reception,
                })
            })
            .collect()
    }

    fn ask(&mut self, now: Time, out: &mut Outbox) {
        let mut requests: BTreeMap<Tag, (Vec<SubscribeEntry>, usize)> = BTreeMap::new();
        for want in self.wants.values_mut() {
            let Phase::Asked {
                owner,
                name,
                next,
                tries,
            } = &mut want.phase
            else {
                continue;
            };
            if *next > now {
                continue;
            }
            *next = now + retry_after(*tries);
            *tries = tries.saturating_add(1);
            let (entries, bytes) = requests.entry(*owner).or_default();
            let more = name.as_str().len() + ASK_ENTRY_BYTES;
            if *bytes + more > ASK_BYTES {
                out.send(*owner, &Message::Subscribe(std::mem::take(entries)));
                *bytes = 0;
            }
            *bytes += more;
            entries.push(SubscribeEntry {
                want: want.number,
                name: name.clone(),
                contract: want.contract,
                epoch: want.epoch,
                seq: want.seq,
            });
        }
        for (owner, (entries, _)) in requests {
            out.send(owner, &Message::Subscribe(entries));
        }
    }

    fn link(&mut self, owner: Tag, now: Time) -> &mut Link {
        self.links.entry(owner).or_insert_with(|| Link {
            next_renewal: now + RENEW_PERIOD,
            sent: now,
            unanswered: 0,
            acks: BTreeSet::new(),
            next_ack: None,
        })
    }

    fn release(&mut self, phase: &Phase, out: &mut Outbox) {
        if let Phase::Granted {
            owner,
            stream,
            group,
            ..
        } = phase
        {
            self.streams.remove(&(*owner, *stream));
            out.event(Event::Forget {
                tag: *owner,
                stream: *stream,
            });
            if let Some(group) = group {
                self.part(*group, out);
            }
        }
    }

    fn join(&mut self, group: SocketAddr, out: &mut Outbox) {
        let count = self.groups.entry(group).or_default();
        *count += 1;
        if *count == 1 {
            out.event(Event::JoinGroup(group));
        }
    }

    fn part(&mut self, group: SocketAddr, out: &mut Outbox) {
        let Some(count) = self.groups.get_mut(&group) else {
            return;
        };
        *count -= 1;
        if *count == 0 {
            self.groups.remove(&group);
            out.event(Event::LeaveGroup(group));
        }
    }
}

impl Phase {
    fn asked(owner: Option<(Tag, ItemName)>, now: Time) -> Self {
        match owner {
            Some((owner, name)) => Self::Asked {
                owner,
                name,
                next: now,
                tries: 0,
            },
            None => Self::Pending,
        }
    }

    fn owner(&self) -> Option<Tag> {
        match self {
            Self::Pending => None,
            Self::Asked { owner, .. } | Self::Granted { owner, .. } => Some(*owner),
        }
    }

    /// The owner's own name for the item.
    fn name(&self) -> Option<ItemName> {
        match self {
            Self::Pending => None,
            Self::Asked { name, .. } | Self::Granted { name, .. } => Some(name.clone()),
        }
    }
}

/// How long to wait for an answer after so many tries without one.
fn retry_after(tries: u32) -> Duration {
    if tries < RETRIES {
        RETRY * 2_u32.pow(tries.min(3))
    } else {
        RETRY_SLOW
    }
}

#[cfg(test)]
mod tests {
    use ddx_wire::{HostName, SchemaHash, WriterState};

    use super::farewells::FAREWELLS;
    use super::*;

    const OWNER: Tag = Tag(7);
    const STREAM: StreamId = StreamId(3);

    fn item() -> ItemName {
        ItemName::parse("gps", &HostName::parse("r").unwrap()).unwrap()
    }

    fn describe(name: &ItemName) -> ItemDescription {
        ItemDescription {
            name: name.clone(),
            schema_hash: SchemaHash([1; 16]),
            capacity_bytes: 8,
            depth: 8,
            epoch: Epoch(1),
            writer: WriterState::Live,
            program: String::new(),
        }
    }

    fn granted(out: &mut Outbox) -> Interest {
        let mut interest = Interest::default();
        let owner = Some((OWNER, item()));
        interest
            .subscribe(item(), Contract::default(), owner, Time(0), out)
            .unwrap();
        interest.handle_timeout(Time(0), out);
        let grant = GrantEntry {
            want: 1,
            stream: Some(STREAM),
            group: None,
        };
        interest.handle_grant(OWNER, &[grant], |name| Some(describe(name)), Time(1), out);
        interest
    }

    fn drain(out: &mut Outbox) -> (usize, Vec<Event>) {
        let sent = std::iter::from_fn(|| out.pop()).count();
        (sent, std::iter::from_fn(|| out.pop_event()).collect())
    }

    #[test]
    fn a_grant_is_expected_once_and_a_goodbye_is_said_three_times() {
        let mut out = Outbox::default();
        let mut interest = granted(&mut out);
        let (_, events) = drain(&mut out);
        assert!(matches!(events.as_slice(), [Event::Expect { stream, .. }] if *stream == STREAM));
        assert!(interest.unsubscribe(&item(), Time(2), &mut out));
        interest.handle_timeout(Time(2) + FAREWELLS[0], &mut out);
        interest.handle_timeout(Time(2) + FAREWELLS[1], &mut out);
        let (sent, events) = drain(&mut out);
        assert_eq!(sent, 3);
        assert!(matches!(events.as_slice(), [Event::Forget { .. }]));
    }

    #[test]
    fn an_unknown_interest_is_asked_for_again() {
        let mut out = Outbox::default();
        let mut interest = granted(&mut out);
        drain(&mut out);
        interest.handle_renewed(OWNER, Time(2), &[1], Time(2), &mut out);
        assert_eq!(interest.poll_timeout(), Some(Time(2)));
        interest.handle_timeout(Time(2), &mut out);
        assert_eq!(drain(&mut out).0, 1);
        assert_eq!(interest.streams().next().unwrap().stream, None);
    }

    #[test]
    fn acks_wait_for_one_another_and_a_stranger_cannot_grant() {
        let mut out = Outbox::default();
        let mut interest = granted(&mut out);
        drain(&mut out);
        interest.holds(OWNER, STREAM, (Epoch(1), Seq(9)), true, Time(5));
        assert_eq!(interest.poll_timeout(), Some(Time(5) + ACK_AFTER));
        interest.handle_timeout(Time(5) + ACK_AFTER, &mut out);
        assert_eq!(drain(&mut out).0, 1);
        let grant = GrantEntry {
            want: 1,
            stream: Some(StreamId(9)),
            group: None,
        };
        interest.handle_grant(
            Tag(8),
            &[grant],
            |name| Some(describe(name)),
            Time(6),
            &mut out,
        );
        assert!(drain(&mut out).1.is_empty());
    }
}
