//! Who is in the domain: the SWIM protocol of the `foca` crate, driven by our clock, seed and sessions.
//!
//! What `foca` says is gossip. It spreads the roster of a large domain and raises doubts; whether a host that this one
//! talks to is alive is decided in [`crate::hosts`], where an authentic datagram outweighs any rumour.

use std::collections::{BTreeMap, VecDeque};
use std::fmt;
use std::net::SocketAddr;
use std::num::{NonZeroU8, NonZeroUsize};
use std::time::Duration;

use bytes::{Buf, BufMut};
use ddx_wire::codec::{self, CodecError};
use ddx_wire::{HostId, HostName, Incarnation, Tag, Time};
use foca::{
    Codec, Foca, Header, Member, Message, NoCustomBroadcast, Notification, Runtime, State, Timer,
};
use serde::{Deserialize, Serialize};

use crate::rng::Rng;

/// Greatest datagram of the membership protocol, bytes: leaves room for the message around it.
const PACKET_MAX_BYTES: usize = 1_100;
/// What `foca` writes where it has nothing to tell of others; left out, it reads the same.
const NO_MEMBERS: [u8; 2] = [0; 2];
/// Hosts that it remembers, those that are down included: twice those that this host can talk to. Beyond, what others say
/// of any host is left unread. One takes 400 B at most, with the news of it that are passed on: 3.2 MiB.
const MEMBERS_MAX: usize = 8_192;
/// Timers that may be under way, of 100 B each: 6.3 MiB. The protocol needs a handful for each suspect.
const TIMERS_MAX: usize = 65_536;

/// A host as membership knows it. Equality is that of the life and its entry into the membership.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(crate) struct Entry {
    pub(crate) host: HostId,
    pub(crate) incarnation: Incarnation,
    /// How often this life entered anew, after it was taken for dead.
    pub(crate) rejoin: u32,
    /// Name and address, left out where the receiver knows them: of the destination.
    pub(crate) contact: Option<(HostName, SocketAddr)>,
}

/// What membership believes about a host now.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Rumour {
    Up(Entry),
    Down(Entry),
}

pub(crate) struct Membership {
    foca: Foca<Entry, EntryCodec, Rng, NoCustomBroadcast>,
    effects: Effects,
}

#[derive(Default)]
struct Effects {
    now: Time,
    sends: VecDeque<(Entry, Vec<u8>)>,
    rumours: VecDeque<Rumour>,
    timers: BTreeMap<(Time, u64), Timer<Entry>>,
    count: u64,
    /// Timers, and words of others about hosts, for which there was no room.
    dropped: u64,
}

#[derive(Debug)]
struct EntryCodec;

impl Membership {
    pub(crate) fn new(me: Entry, seed: u64) -> Self {
        Self {
            foca: Foca::new(me, configuration(), Rng::new(seed), EntryCodec),
            effects: Effects::default(),
        }
    }

    /// How often this life re-entered.
    pub(crate) fn rejoin(&self) -> u32 {
        self.foca.identity().rejoin
    }

    /// Takes in a host that proved itself.
    pub(crate) fn join(&mut self, entry: Entry, now: Time) {
        self.effects.now = now;
        let update = std::iter::once(Member::alive(entry.clone()));
        let known = self.foca.apply_many(update, true, &mut self.effects);
        // Announcing tells the roster at once, and tells a host that was taken for dead to enter anew.
        let told = self.foca.announce(entry, &mut self.effects);
        debug_assert!(known.is_ok() && told.is_ok(), "an entry fits a datagram");
    }

    /// Tells a host that membership holds for dead, though it speaks, to enter anew.
    pub(crate) fn revive(&mut self, entry: Entry, now: Time) {
        self.effects.now = now;
        let told = self.foca.announce(entry, &mut self.effects);
        debug_assert!(told.is_ok(), "an entry fits a datagram");
    }

    /// Takes in what a host sent in a session. `false` when it was malformed.
    pub(crate) fn handle_datagram(&mut self, from: &Entry, bytes: &[u8], now: Time) -> bool {
        let Ok((brief, used)) = codec::decode_prefix::<BriefHeader>(bytes) else {
            return false;
        };
        let src = Entry {
            rejoin: brief.from_rejoin,
            ..from.clone()
        };
        let dst = Entry {
            rejoin: brief.to_rejoin,
            ..self.foca.identity().clone()
        };
        let header = Header {
            src,
            src_incarnation: brief.refutations,
            dst,
            message: brief.message.into_foca(),
        };
        self.handle(&header, bytes.get(used..).unwrap_or_default(), now)
    }

    fn handle(&mut self, header: &Header<Entry>, members: &[u8], now: Time) -> bool {
        self.effects.now = now;
        let mut bytes = Vec::with_capacity(256);
        let headed = EntryCodec.encode_header(header, &mut bytes);
        if members.is_empty() || self.foca.iter_membership_state().len() < MEMBERS_MAX {
            bytes.extend_from_slice(members);
        } else {
            self.effects.drop_one();
        }
        headed.is_ok() && self.foca.handle_data(&bytes, &mut self.effects).is_ok()
    }

    /// Answers a probe for a host that is heard anyway, in its place. `false` when there is something to tell it.
    pub(crate) fn answer(&mut self, to: &Entry, bytes: &[u8], now: Time) -> bool {
        let Ok((brief, used)) = codec::decode_prefix::<BriefHeader>(bytes) else {
            return false;
        };
        let WireMessage::Ping(number) = brief.message else {
            return false;
        };
        let member = self.foca.iter_members().find(|member| member.id() == to);
        let Some(member) = member.cloned() else {
            return false;
        };
        if used < bytes.len() || member.state() != State::Alive {
            return false;
        }
        let header = Header {
            src: member.id().clone(),
            src_incarnation: member.incarnation(),
            dst: self.foca.identity().clone(),
            message: Message::Ack(number),
        };
        self.handle(&header, &[], now)
    }

    pub(crate) fn handle_timeout(&mut self, now: Time) {
        self.effects.now = now;
        while let Some(due) = self.effects.timers.first_entry()
            && due.key().0 <= now
        {
            let timer = due.remove();
            // An error here means that a probe was cut short by our own delay; the next one starts anew.
            drop(self.foca.handle_timer(timer, &mut self.effects));
        }
    }

    pub(crate) fn poll_timeout(&self) -> Option<Time> {
        self.effects
            .timers
            .first_key_value()
            .map(|((at, _), _)| *at)
    }

    /// A datagram to pass to a host, inside a session with it.
    pub(crate) fn poll_send(&mut self) -> Option<(Entry, Vec<u8>)> {
        self.effects.sends.pop_front()
    }

    pub(crate) fn poll_rumour(&mut self) -> Option<Rumour> {
        self.effects.rumours.pop_front()
    }

    /// Timers, and words of others about hosts, for which there was no room.
    pub(crate) fn dropped(&self) -> u64 {
        self.effects.dropped
    }

    /// Hosts that membership suspects now.
    pub(crate) fn suspects(&self) -> impl Iterator<Item = HostId> {
        self.foca
            .iter_members()
            .filter(|member| member.state() == State::Suspect)
            .map(|member| member.id().host)
    }

    /// Says goodbye to some, who pass it on.
    pub(crate) fn leave(&mut self, now: Time) {
        self.effects.now = now;
        let left = self.foca.leave_cluster(&mut self.effects);
        debug_assert!(left.is_ok(), "an entry fits a datagram");
    }
}

fn configuration() -> foca::Config {
    foca::Config {
        probe_period: Duration::from_secs(1),
        probe_rtt: Duration::from_millis(350),
        num_indirect_probes: NonZeroUsize::MIN.saturating_add(2),
        max_transmissions: NonZeroU8::MIN.saturating_add(7),
        suspect_to_down_after: Duration::from_millis(1_500),
        remove_down_after: Some(Duration::from_hours(1)),
        max_packet_size: NonZeroUsize::MIN.saturating_add(PACKET_MAX_BYTES - 1),
        notify_down_members: true,
        periodic_announce: Some(foca::PeriodicParams {
            frequency: Duration::from_mins(2),
            num_members: NonZeroUsize::MIN,
        }),
        // Hosts that are down are greeted each 250 ms outside of this protocol.
        periodic_announce_to_down_members: None,
        periodic_gossip: Some(foca::PeriodicParams {
            frequency: Duration::from_millis(200),
            num_members: NonZeroUsize::MIN.saturating_add(1),
        }),
    }
}

impl Entry {
    pub(crate) fn tag(&self) -> Tag {
        Tag::of(self.host, self.incarnation)
    }
}

impl PartialEq for Entry {
    fn eq(&self, other: &Self) -> bool {
        (self.host, self.incarnation, self.rejoin) == (other.host, other.incarnation, other.rejoin)
    }
}

impl Eq for Entry {}

impl foca::Identity for Entry {
    type Addr = HostId;

    fn renew(&self) -> Option<Self> {
        let rejoin = self.rejoin.checked_add(1)?;
        Some(Self {
            rejoin,
            ..self.clone()
        })
    }

    fn addr(&self) -> HostId {
        self.host
    }

    fn win_addr_conflict(&self, other: &Self) -> bool {
        (self.incarnation, self.rejoin) > (other.incarnation, other.rejoin)
    }
}

impl Runtime<Entry> for Effects {
    fn notify(&mut self, notification: Notification<'_, Entry>) {
        let rumour = match notification {
            Notification::MemberUp(entry) | Notification::Rename(_, entry) => {
                Rumour::Up(entry.clone())
            }
            Notification::MemberDown(entry) => Rumour::Down(entry.clone()),
            Notification::Active
            | Notification::Idle
            | Notification::Defunct
            | Notification::Rejoin(_) => return,
        };
        self.rumours.push_back(rumour);
    }

    fn send_to(&mut self, to: Entry, bytes: &[u8]) {
        // What this file has encoded can be decoded.
        if let Ok((header, used)) = codec::decode_prefix::<WireHeader>(bytes) {
            let brief = BriefHeader {
                from_rejoin: header.from.rejoin,
                refutations: header.refutations,
                to_rejoin: header.to.rejoin,
                message: header.message,
            };
            let mut sent = Vec::with_capacity(64);
            if codec::encode(&brief, &mut sent).is_ok() {
                let members = bytes.get(used..).unwrap_or_default();
                if members != NO_MEMBERS {
                    sent.extend_from_slice(members);
                }
                self.sends.push_back((to, sent));
            }
        }
    }

    fn submit_after(&mut self, timer: Timer<Entry>, after: Duration) {
        self.timers.insert((self.now + after, self.count), timer);
        self.count = self.count.wrapping_add(1);
        if self.timers.len() > TIMERS_MAX {
            // The farthest forgets somebody who is down; those that keep the protocol going are near.
            self.timers.pop_last();
            self.drop_one();
        }
    }
}

impl Effects {
    fn drop_one(&mut self) {
        self.dropped = self.dropped.saturating_add(1);
    }
}

#[derive(Serialize, Deserialize)]
struct WireHeader {
    from: Entry,
    refutations: u16,
    to: Entry,
    message: WireMessage,
}

/// The header as it travels: the session that carries it knows both lives.
#[derive(Serialize, Deserialize)]
struct BriefHeader {
    from_rejoin: u32,
    refutations: u16,
    to_rejoin: u32,
    message: WireMessage,
}

#[derive(Serialize, Deserialize)]
enum WireMessage {
    Ping(u8),
    Ack(u8),
    PingReq(Entry, u8),
    IndirectPing(Entry, u8),
    IndirectAck(Entry, u8),
    ForwardedAck(Entry, u8),
    Announce,
    Feed,
    Gossip,
    Broadcast,
    TurnUndead,
}

impl WireMessage {
    fn into_foca(self) -> Message<Entry> {
        match self {
            Self::Ping(n) => Message::Ping(n),
            Self::Ack(n) => Message::Ack(n),
            Self::PingReq(target, probe_number) => Message::PingReq {
                target,
                probe_number,
            },
            Self::IndirectPing(origin, probe_number) => Message::IndirectPing {
                origin,
                probe_number,
            },
            Self::IndirectAck(target, probe_number) => Message::IndirectAck {
                target,
                probe_number,
            },
            Self::ForwardedAck(origin, probe_number) => Message::ForwardedAck {
                origin,
                probe_number,
            },
            Self::Announce => Message::Announce,
            Self::Feed => Message::Feed,
            Self::Gossip => Message::Gossip,
            Self::Broadcast => Message::Broadcast,
            Self::TurnUndead => Message::TurnUndead,
        }
    }
}

#[derive(Serialize, Deserialize)]
struct WireMember {
    entry: Entry,
    refutations: u16,
    state: u8,
}

impl Codec<Entry> for EntryCodec {
    type Error = EntryError;

    fn encode_header(
        &mut self,
        header: &Header<Entry>,
        buf: impl BufMut,
    ) -> Result<(), EntryError> {
        let message = match header.message.clone() {
            Message::Ping(n) => WireMessage::Ping(n),
            Message::Ack(n) => WireMessage::Ack(n),
            Message::PingReq {
                target,
                probe_number,
            } => WireMessage::PingReq(target, probe_number),
            Message::IndirectPing {
                origin,
                probe_number,
            } => WireMessage::IndirectPing(origin, probe_number),
            Message::IndirectAck {
                target,
                probe_number,
            } => WireMessage::IndirectAck(target, probe_number),
            Message::ForwardedAck {
                origin,
                probe_number,
            } => WireMessage::ForwardedAck(origin, probe_number),
            Message::Announce => WireMessage::Announce,
            Message::Feed => WireMessage::Feed,
            Message::Gossip => WireMessage::Gossip,
            Message::Broadcast => WireMessage::Broadcast,
            Message::TurnUndead => WireMessage::TurnUndead,
        };
        let to = Entry {
            contact: None,
            ..header.dst.clone()
        };
        let refutations = header.src_incarnation;
        put(
            &WireHeader {
                from: header.src.clone(),
                refutations,
                to,
                message,
            },
            buf,
        )
    }

    fn decode_header(&mut self, buf: impl Buf) -> Result<Header<Entry>, EntryError> {
        let header: WireHeader = take(buf)?;
        Ok(Header {
            src: header.from,
            src_incarnation: header.refutations,
            dst: header.to,
            message: header.message.into_foca(),
        })
    }

    fn encode_member(
        &mut self,
        member: &Member<Entry>,
        buf: impl BufMut,
    ) -> Result<(), EntryError> {
        let state = match member.state() {
            State::Alive => 0,
            State::Suspect => 1,
            State::Down => 2,
        };
        let entry = member.id().clone();
        put(
            &WireMember {
                entry,
                refutations: member.incarnation(),
                state,
            },
            buf,
        )
    }

    fn decode_member(&mut self, buf: impl Buf) -> Result<Member<Entry>, EntryError> {
        let member: WireMember = take(buf)?;
        let state = match member.state {
            0 => State::Alive,
            1 => State::Suspect,
            2 => State::Down,
            other => return Err(EntryError::State(other)),
        };
        Ok(Member::new(member.entry, member.refutations, state))
    }
}

/// Why an entry cannot be written or read.
#[derive(Debug, thiserror::Error)]
enum EntryError {
    #[error(transparent)]
    Codec(#[from] CodecError),
    #[error("{0} bytes do not fit the datagram")]
    NoRoom(usize),
    #[error("member state {0} does not exist")]
    State(u8),
}

fn put<T: Serialize>(value: &T, mut buf: impl BufMut) -> Result<(), EntryError> {
    let mut bytes = Vec::with_capacity(128);
    codec::encode(value, &mut bytes)?;
    if buf.remaining_mut() < bytes.len() {
        return Err(EntryError::NoRoom(bytes.len()));
    }
    buf.put_slice(&bytes);
    Ok(())
}

fn take<T: for<'de> Deserialize<'de>>(mut buf: impl Buf) -> Result<T, EntryError> {
    let (value, used) = codec::decode_prefix(buf.chunk())?;
    buf.advance(used);
    Ok(value)
}

impl fmt::Debug for Membership {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Membership")
            .field("me", self.foca.identity())
            .finish_non_exhaustive()
    }
}

#[cfg(test)]
mod tests {
    use foca::Identity;

    use super::*;

    fn entry(id: u8) -> Entry {
        Entry {
            host: HostId([id; 16]),
            incarnation: Incarnation {
                ordinal: 1,
                random: 9,
            },
            rejoin: 0,
            contact: Some((
                HostName::parse("robot1").unwrap(),
                "10.0.0.1:7000".parse().unwrap(),
            )),
        }
    }

    #[test]
    fn a_probe_takes_few_bytes() {
        let mut bytes = Vec::new();
        let header = Header {
            src: entry(1),
            src_incarnation: 0,
            dst: entry(2),
            message: Message::Ping(3),
        };
        EntryCodec.encode_header(&header, &mut bytes).unwrap();
        let mut effects = Effects::default();
        effects.send_to(entry(2), &bytes);
        let (_, sent) = effects.sends.pop_front().unwrap();
        assert!(sent.len() <= 5, "{} bytes", sent.len());
        let read = EntryCodec.decode_header(bytes.as_slice()).unwrap();
        assert_eq!(read, header);
        assert_eq!(read.src.contact, header.src.contact);
    }

    fn numbered(n: u32) -> Entry {
        Entry {
            host: HostId(u128::from(n).to_le_bytes()),
            ..entry(1)
        }
    }

    #[test]
    fn a_member_that_speaks_of_ever_more_hosts_is_heard_up_to_a_limit() {
        let mut a = Membership::new(entry(1), 1);
        a.join(entry(2), Time(0));
        let header = Header {
            src: entry(2),
            src_incarnation: 0,
            dst: entry(1),
            message: Message::Gossip,
        };
        let told = 1_000 * 20_u32;
        for first in (0..told).step_by(20) {
            let mut members = 20_u16.to_be_bytes().to_vec();
            for n in first..first + 20 {
                let member = Member::alive(numbered(1_000 + n));
                EntryCodec.encode_member(&member, &mut members).unwrap();
            }
            assert!(a.handle(&header, &members, Time(1)));
            while a.poll_rumour().is_some() {}
        }
        let known = a.foca.iter_membership_state().len();
        assert!((MEMBERS_MAX..MEMBERS_MAX + 20).contains(&known), "{known}");
        assert_eq!(a.dropped(), u64::from(told) / 20 - (known - 1) as u64 / 20);
    }

    #[test]
    fn of_too_many_timers_the_farthest_goes() {
        let mut effects = Effects::default();
        let far = Duration::from_hours(1);
        for n in 0..70_000 {
            effects.submit_after(Timer::RemoveDown(numbered(n)), far);
        }
        effects.submit_after(Timer::PeriodicGossip(0), Duration::from_secs(1));
        assert_eq!(effects.timers.len(), TIMERS_MAX);
        assert_eq!(effects.dropped, 70_001 - 65_536);
        let (_, first) = effects.timers.pop_first().unwrap();
        assert!(matches!(first, Timer::PeriodicGossip(_)));
    }

    #[test]
    fn two_hosts_join_and_one_leaves() {
        let (mut a, mut b) = (Membership::new(entry(1), 1), Membership::new(entry(2), 2));
        a.join(entry(2), Time(0));
        while let Some((_, bytes)) = a.poll_send() {
            assert!(b.handle_datagram(&entry(1), &bytes, Time(1)));
        }
        assert_eq!(a.poll_rumour(), Some(Rumour::Up(entry(2))));
        assert_eq!(b.poll_rumour(), Some(Rumour::Up(entry(1))));
        b.leave(Time(2));
        while let Some((_, bytes)) = b.poll_send() {
            a.handle_datagram(&entry(2), &bytes, Time(3));
        }
        assert_eq!(a.poll_rumour(), Some(Rumour::Down(entry(2))));
    }

    #[test]
    fn who_is_heard_is_not_probed_and_not_suspected() {
        for heard in [true, false] {
            let (mut a, mut b) = (Membership::new(entry(1), 1), Membership::new(entry(2), 2));
            a.join(entry(2), Time(0));
            let mut late = 0;
            for ms in 1..20_000 {
                let now = Time(ms * 1_000_000);
                a.handle_timeout(now);
                while let Some((to, bytes)) = a.poll_send() {
                    // News go all the same, and are answered.
                    if heard && !a.answer(&to, &bytes, now) {
                        late += usize::from(ms > 12_000);
                        b.handle_datagram(&entry(1), &bytes, now);
                    }
                }
                while let Some((_, bytes)) = b.poll_send().filter(|_| heard) {
                    a.handle_datagram(&entry(2), &bytes, now);
                }
            }
            let rumours: Vec<_> = std::iter::from_fn(|| a.poll_rumour()).collect();
            assert_eq!(rumours.contains(&Rumour::Down(entry(2))), !heard);
            assert_eq!(late, 0);
        }
    }

    #[test]
    fn a_new_life_wins_over_any_rejoin_of_the_old_one() {
        let old = Entry {
            rejoin: 7,
            ..entry(1)
        };
        let new = Entry {
            incarnation: Incarnation {
                ordinal: 2,
                random: 1,
            },
            ..entry(1)
        };
        assert!(new.win_addr_conflict(&old));
        assert!(!old.win_addr_conflict(&new));
        assert!(old.renew().unwrap().win_addr_conflict(&old));
    }
}
