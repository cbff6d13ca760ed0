//! The hosts of the domain as this one sees them: up, unreachable, down, or gone.
//!
//! Any authentic datagram is a sign of life. Silence alone proves nothing in a large domain, where most pairs have nothing to
//! say; so silence of a host that should speak, or a rumour about it, raises a doubt, a doubted host is asked each 125 ms, and
//! only unanswered questions make it unreachable and then down.

use std::collections::BTreeMap;
use std::collections::BTreeSet;
use std::net::SocketAddr;
use std::time::Duration;

use ddx_wire::message::Introduction;
use ddx_wire::{HostId, HostName, Incarnation, Tag, Time};

use crate::event::Event;
use crate::membership::{Entry, Rumour};
use crate::outbox::Outbox;

/// Pause between two looks at all hosts, and between two questions to a doubted one.
const WATCH_PERIOD: Duration = Duration::from_millis(125);
/// Silence of a host, after which it is doubted: one that speaks each second at least, since one of the two reads from the other,
/// and any other of a small domain, which sends a digest each 1.6 s.
const DOUBT_BUSY_AFTER: Duration = Duration::from_millis(1_500);
const DOUBT_AFTER: Duration = Duration::from_millis(1_700);
/// A doubt lasts at least so long before it has consequences: ten questions, all of which a living one at 33 % loss would lose once in
/// 300 doubts.
const DOUBT_LEAST: Duration = Duration::from_millis(1_250);
/// Pause between two questions to hosts that do not answer.
const ABSENT_PERIOD: Duration = Duration::from_millis(250);
const UNREACHABLE_AFTER: Duration = Duration::from_secs(3);
const DOWN_AFTER: Duration = Duration::from_secs(10);
/// A host that is down was asked for at least so long: 28 questions, all of which a living one at 33 % loss would lose once in 10^7.
const DOWN_DOUBT: Duration = Duration::from_secs(7);
/// Up to this many hosts, membership probes each often enough for silence to mean something.
const FEW_HOSTS: usize = 4;
const QUESTIONS_PER_WATCH: usize = 8;
const REVIVE_PERIOD: Duration = Duration::from_secs(1);
/// Hosts that are remembered at one time, departed ones included. One takes 400 B at most: 1.6 MiB.
const HOSTS_MAX: usize = 4_096;

/// How a host appears from here.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum HostState {
    /// It answers, or its neighbours say that it does.
    Up,
    /// Nothing was heard for three seconds or more. Its values stay.
    Unreachable,
    /// Nothing was heard for ten seconds or more.
    Down,
    /// It said goodbye.
    Left,
}

/// One other host.
#[derive(Clone, Debug)]
pub(crate) struct Host {
    pub(crate) entry: Entry,
    pub(crate) tag: Tag,
    pub(crate) name: HostName,
    pub(crate) addr: SocketAddr,
    pub(crate) state: HostState,
    /// Since when it is in this state.
    pub(crate) since: Time,
    /// When it was last heard, or first heard of.
    pub(crate) heard: Time,
    /// Since when it has held its prefix, on this host's clock, which may be before that began.
    pub(crate) prefix_since_ns: Option<i128>,
    /// When its beacon last came here by multicast.
    pub(crate) beacon_heard: Option<Time>,
    /// When it last said that this host's came there.
    pub(crate) beacon_answered: Option<Time>,
    doubted: Option<Time>,
    rumoured_down: bool,
    revived: Time,
}

/// What a look at all hosts asks for.
#[derive(Debug)]
pub(crate) enum Task {
    /// Ask a host of which nothing is heard.
    Ask(HostId),
    /// Tell a host that speaks to enter the membership anew.
    Revive(Entry),
}

/// What became of a host.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct Arrival {
    /// The life that ended with this one's arrival.
    pub(crate) ended: Option<Tag>,
    /// Whether it was not there, or not heard for a while.
    pub(crate) returned: bool,
}

#[derive(Default)]
pub(crate) struct Hosts {
    all: BTreeMap<HostId, Host>,
    next_watch: Option<Time>,
    /// Hosts that were heard of, and had no room.
    pub(crate) dropped: u64,
    /// The last absent host that was asked: they take turns.
    turn: Option<HostId>,
    next_question: Time,
}

impl Hosts {
    pub(crate) fn get(&self, host: HostId) -> Option<&Host> {
        self.all.get(&host)
    }

    pub(crate) fn get_mut(&mut self, host: HostId) -> Option<&mut Host> {
        self.all.get_mut(&host)
    }

    pub(crate) fn iter(&self) -> impl Iterator<Item = (HostId, &Host)> {
        self.all.iter().map(|(id, host)| (*id, host))
    }

    pub(crate) fn highest(&self, host: HostId) -> Option<Incarnation> {
        self.all.get(&host).map(|h| h.entry.incarnation)
    }

    /// Takes in a host that answered our challenge. `None` when there is no room for it.
    pub(crate) fn arrived(
        &mut self,
        from: &Introduction,
        addr: SocketAddr,
        now: Time,
        out: &mut Outbox,
    ) -> Option<Arrival> {
        let entry = Entry {
            host: from.host,
            incarnation: from.incarnation,
            rejoin: from.rejoin,
            contact: Some((from.name.clone(), addr)),
        };
        let ended = self.admit(entry, now, out)?;
        let host = self.all.get_mut(&from.host)?;
        host.prefix_since_ns = Some(i128::from(now.0) - i128::from(from.prefix_age_ns));
        let returned = self.heard(from.host, now, out) || ended.is_some();
        Some(Arrival { ended, returned })
    }

    /// Notes a sign of life. `true` when it ends a doubt or an absence.
    pub(crate) fn heard(&mut self, host: HostId, now: Time, out: &mut Outbox) -> bool {
        let Some(host) = self.all.get_mut(&host) else {
            return false;
        };
        host.heard = now;
        let doubted = host.doubted.take().is_some();
        let was = host.state;
        host.turn(HostState::Up, now, out);
        doubted || was != HostState::Up
    }

    /// Takes in what membership says. The life that ended, when the rumour is about a later one.
    pub(crate) fn rumour(&mut self, rumour: Rumour, now: Time, out: &mut Outbox) -> Option<Tag> {
        match rumour {
            Rumour::Up(entry) => {
                let id = entry.host;
                let ended = self.admit(entry, now, out)?;
                if let Some(host) = self.all.get_mut(&id) {
                    host.rumoured_down = false;
                }
                ended
            }
            Rumour::Down(entry) => {
                if let Some(host) = self.all.get_mut(&entry.host)
                    && host.entry.incarnation == entry.incarnation
                {
                    host.rumoured_down = true;
                }
                None
            }
        }
    }

    /// Notes a goodbye.
    pub(crate) fn left(&mut self, host: HostId, now: Time, out: &mut Outbox) {
        if let Some(host) = self.all.get_mut(&host) {
            host.turn(HostState::Left, now, out);
        }
    }

    pub(crate) fn poll_timeout(&self) -> Option<Time> {
        self.next_watch
    }

    /// Looks at all hosts once they are due. `busy` says whether a host should be heard each second.
    pub(crate) fn handle_timeout(
        &mut self,
        now: Time,
        suspects: &BTreeSet<HostId>,
        busy: impl Fn(Tag) -> bool,
        out: &mut Outbox,
    ) -> Vec<Task> {
        if self.next_watch.is_none_or(|at| at > now) {
            return Vec::new();
        }
        self.next_watch = Some(now + WATCH_PERIOD);
        let few = self.all.len() <= FEW_HOSTS;
        let mut tasks = Vec::new();
        let mut asked = 0;
        for (id, host) in &mut self.all {
            if host.state == HostState::Left {
                continue;
            }
            let silence = now.since(host.heard);
            if host.rumoured_down
                && silence < UNREACHABLE_AFTER
                && now.since(host.revived) >= REVIVE_PERIOD
            {
                host.revived = now;
                tasks.push(Task::Revive(host.entry.clone()));
            }
            let rumoured = host.rumoured_down || suspects.contains(id);
            let doubtful =
                (silence >= DOUBT_AFTER && few) || (silence >= DOUBT_BUSY_AFTER && busy(host.tag));
            if host.doubted.is_none() && (rumoured || doubtful) {
                host.doubted = Some(now);
            }
            let Some(doubted) = host.doubted else {
                continue;
            };
            let doubted = now.since(doubted);
            if host.state == HostState::Up {
                if silence >= UNREACHABLE_AFTER && doubted >= DOUBT_LEAST {
                    host.turn(HostState::Unreachable, now, out);
                } else if asked < QUESTIONS_PER_WATCH {
                    asked += 1;
                    tasks.push(Task::Ask(*id));
                }
            } else if silence >= DOWN_AFTER && doubted >= DOWN_DOUBT {
                host.turn(HostState::Down, now, out);
            }
        }
        if self.next_question <= now
            && let Some(absent) = self.next_absent()
        {
            self.next_question = now + ABSENT_PERIOD;
            self.turn = Some(absent);
            tasks.push(Task::Ask(absent));
        }
        tasks
    }

    fn next_absent(&self) -> Option<HostId> {
        let absent = |host: &Host| matches!(host.state, HostState::Unreachable | HostState::Down);
        let after = self
            .all
            .iter()
            .find(|(id, host)| Some(**id) > self.turn && absent(host));
        after
            .or_else(|| self.all.iter().find(|(_, host)| absent(host)))
            .map(|(id, _)| *id)
    }

    /// Makes or renews the record of a life. The outer `None`: too many hosts, or an earlier life, or no address.
    fn admit(&mut self, entry: Entry, now: Time, out: &mut Outbox) -> Option<Option<Tag>> {
        let (name, addr) = entry.contact.clone()?;
        let tag = entry.tag();
        let id = entry.host;
        let known = self.all.get_mut(&id);
        if let Some(host) = known {
            if host.entry.incarnation > entry.incarnation {
                return None;
            }
            if host.entry.incarnation == entry.incarnation {
                host.entry.rejoin = host.entry.rejoin.max(entry.rejoin);
                return Some(None);
            }
            let ended = host.tag;
            let prefix_since_ns = host.prefix_since_ns;
            *host = Host::new(entry, tag, name, addr, now);
            host.prefix_since_ns = prefix_since_ns;
            host.announce(out);
            return Some(Some(ended));
        }
        if self.all.len() >= HOSTS_MAX {
            let departed = self
                .all
                .iter()
                .find(|(_, host)| host.state == HostState::Left);
            let Some(departed) = departed.map(|(id, _)| *id) else {
                self.dropped = self.dropped.saturating_add(1);
                return None;
            };
            self.all.remove(&departed);
        }
        let host = Host::new(entry, tag, name, addr, now);
        host.announce(out);
        self.all.insert(id, host);
        self.next_watch.get_or_insert(now + WATCH_PERIOD);
        Some(None)
    }
}

impl Host {
    fn new(entry: Entry, tag: Tag, name: HostName, addr: SocketAddr, now: Time) -> Self {
        Self {
            entry,
            tag,
            name,
            addr,
            state: HostState::Up,
            since: now,
            heard: now,
            prefix_since_ns: None,
            beacon_heard: None,
            beacon_answered: None,
            doubted: None,
            rumoured_down: false,
            revived: Time(0),
        }
    }

    fn turn(&mut self, state: HostState, now: Time, out: &mut Outbox) {
        if self.state == state {
            return;
        }
        self.state = state;
        self.since = now;
        let host = self.entry.host;
        match state {
            HostState::Up => self.announce(out),
            HostState::Unreachable => out.event(Event::HostUnreachable { host }),
            HostState::Down => out.event(Event::HostDown { host }),
            HostState::Left => out.event(Event::HostLeft { host }),
        }
    }

    fn announce(&self, out: &mut Outbox) {
        out.event(Event::HostUp {
            host: self.entry.host,
            name: self.name.clone(),
            incarnation: self.entry.incarnation,
            addr: self.addr,
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn introduction(ordinal: u32) -> Introduction {
        Introduction {
            host: HostId([1; 16]),
            incarnation: Incarnation { ordinal, random: 5 },
            name: HostName::parse("r").unwrap(),
            control_addrs: Vec::new(),
            data_port: 1,
            rejoin: 0,
            prefix_age_ns: 0,
            version: 0,
            multicast: true,
        }
    }

    fn arrive(hosts: &mut Hosts, ordinal: u32, at: Time) -> Option<Arrival> {
        let addr = "10.0.0.1:1".parse().unwrap();
        hosts.arrived(&introduction(ordinal), addr, at, &mut Outbox::default())
    }

    fn state(hosts: &Hosts) -> HostState {
        hosts.get(HostId([1; 16])).unwrap().state
    }

    /// Looks at all hosts, as often as is due, for `span`; the questions asked.
    fn watch(hosts: &mut Hosts, from: Time, span: Duration, busy: bool) -> usize {
        let mut asked = 0;
        let mut at = from;
        while at.since(from) < span {
            at = at + WATCH_PERIOD;
            let tasks =
                hosts.handle_timeout(at, &BTreeSet::new(), |_| busy, &mut Outbox::default());
            asked += tasks.len();
        }
        asked
    }

    #[test]
    fn silence_of_a_host_that_should_speak_is_followed_to_the_end() {
        let mut hosts = Hosts::default();
        arrive(&mut hosts, 1, Time(0)).unwrap();
        assert_eq!(watch(&mut hosts, Time(0), Duration::from_secs(1), true), 0);
        assert!(
            watch(
                &mut hosts,
                Time(1_000_000_000),
                Duration::from_secs(1),
                true
            ) > 0
        );
        assert_eq!(state(&hosts), HostState::Up);
        watch(
            &mut hosts,
            Time(2_000_000_000),
            Duration::from_secs(2),
            true,
        );
        assert_eq!(state(&hosts), HostState::Unreachable);
        watch(
            &mut hosts,
            Time(4_000_000_000),
            Duration::from_secs(5),
            true,
        );
        assert_eq!(state(&hosts), HostState::Unreachable);
        watch(
            &mut hosts,
            Time(9_000_000_000),
            Duration::from_secs(2),
            true,
        );
        assert_eq!(state(&hosts), HostState::Down);
        assert!(hosts.heard(
            HostId([1; 16]),
            Time(12_000_000_000),
            &mut Outbox::default()
        ));
        assert_eq!(state(&hosts), HostState::Up);
    }

    #[test]
    fn an_earlier_life_is_not_admitted_and_a_later_one_ends_the_first() {
        let mut hosts = Hosts::default();
        arrive(&mut hosts, 2, Time(0)).unwrap();
        assert_eq!(arrive(&mut hosts, 1, Time(1)), None);
        let ended = arrive(&mut hosts, 3, Time(2)).unwrap().ended;
        let before = introduction(2);
        assert_eq!(ended, Some(Tag::of(before.host, before.incarnation)));
        assert_eq!(hosts.highest(before.host).unwrap().ordinal, 3);
    }

    #[test]
    fn a_full_domain_takes_a_host_only_in_place_of_one_that_left() {
        let mut hosts = Hosts::default();
        let out = &mut Outbox::default();
        let addr = "10.0.0.1:1".parse().unwrap();
        let mut arrive = |hosts: &mut Hosts, number: usize| {
            let mut id = [0; 16];
            id[..8].copy_from_slice(&number.to_le_bytes());
            let from = Introduction {
                host: HostId(id),
                ..introduction(1)
            };
            hosts.arrived(&from, addr, Time(0), out)
        };
        for number in 1..=HOSTS_MAX {
            assert!(arrive(&mut hosts, number).is_some());
        }

        assert_eq!(arrive(&mut hosts, 0), None);
        let first = hosts.iter().next().map(|(id, _)| id).unwrap();
        hosts.left(first, Time(1), &mut Outbox::default());
        assert!(arrive(&mut hosts, 0).is_some());

        assert_eq!(hosts.iter().count(), HOSTS_MAX);
        assert!(hosts.get(first).is_none());
    }
}
