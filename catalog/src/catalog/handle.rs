//! What arrives: greetings, then messages of those who have a session, each passed to the part that it is for.

use std::net::SocketAddr;
use std::time::Duration;

use ddx_wire::message::{CONTROL_ADDRS_MAX, Greeting, Introduction, Message};
use ddx_wire::seal::Refused;
use ddx_wire::{HostId, ItemName, Tag, Time, codec};

use super::Catalog;
use crate::event::Event;
use crate::membership::Entry;
use crate::outbox::Dest;
use crate::session::{Greeted, Sessions};
use crate::streams::ReaderAddr;

/// Pause between greetings of those who send without a session: they may be many, and forged.
const STRANGER_PAUSE: Duration = Duration::from_millis(20);

impl Catalog {
    pub(super) fn handle_greeting(
        &mut self,
        from: SocketAddr,
        datagram: &mut [u8],
        beacon: bool,
        now: Time,
    ) -> Result<(), Refused> {
        let greeting = self.sessions.open_greeting(datagram)?;
        // Seeds are greeted at the same port by unicast, and say so.
        if let Greeting::Hello {
            from,
            directed: false,
        } = &greeting
            && beacon
        {
            self.note_beacon(Tag::of(from.host, from.incarnation), now);
        }
        let host = match &greeting {
            Greeting::Hello { from, .. }
            | Greeting::Challenge { from, .. }
            | Greeting::Response { from, .. } => from.host,
            Greeting::Stale { from, .. } => *from,
        };
        let highest = self.hosts.highest(host);
        self.sessions
            .set_state(self.directory.version(), self.membership.rejoin());
        let (rng, out) = (&mut self.rng, &mut self.out);
        match self
            .sessions
            .handle_greeting(from, greeting, highest, now, rng, out)
        {
            Greeted::Nothing => {}
            Greeted::Answered {
                from,
                addr,
                exchange,
                fresh,
            } => {
                self.handle_answer(&from, addr, exchange, fresh, now);
            }
            Greeted::Superseded { ordinal } => {
                if ordinal > self.superseded {
                    self.superseded = ordinal;
                    self.out.event(Event::Reincarnate { ordinal });
                }
            }
            Greeted::StaleResponse => self.counters.stale_responses += 1,
            Greeted::StaleLife => self.counters.stale_lives += 1,
            Greeted::OverLimit => self.counters.over_limit += 1,
        }
        Ok(())
    }

    fn handle_answer(
        &mut self,
        from: &Introduction,
        addr: SocketAddr,
        (sent, at): (Time, Time),
        fresh: bool,
        now: Time,
    ) {
        let tag = Tag::of(from.host, from.incarnation);
        let Some(arrival) = self.hosts.arrived(from, addr, now, &mut self.out) else {
            self.sessions.close(tag);
            return;
        };
        if let Some(ended) = arrival.ended {
            self.end_life(ended, now);
        }
        if fresh {
            let host = from.host;
            let opener = self.sessions.data_opener(host, from.incarnation);
            self.out.event(Event::Session { tag, host, opener });
            let contact = Some((from.name.clone(), addr));
            let entry = Entry {
                host,
                incarnation: from.incarnation,
                rejoin: from.rejoin,
                contact,
            };
            self.membership.join(entry, now);
        }
        self.clocks.entry(tag).or_default().measure(sent, at, now);
        self.tell_clock(tag, now);
        self.directory
            .follow(from.host, tag, &from.name, from.version, now, &mut self.out);
        self.refresh_prefixes();
        if fresh || arrival.returned {
            self.welcome_back(from.host, tag, now);
        }
    }

    pub(super) fn handle_control(
        &mut self,
        from: SocketAddr,
        sender: Tag,
        datagram: &mut [u8],
        now: Time,
    ) -> Result<(), Refused> {
        let Some(host) = self.sessions.get(sender).map(|session| session.host) else {
            // Perhaps it has a session with us, and its proof was lost on the way here.
            self.counters.strangers += 1;
            if now >= self.next_stranger {
                self.next_stranger = now + STRANGER_PAUSE;
                self.sessions
                    .hello(Dest::Addr(from), true, now, &mut self.out);
            }
            return Err(Refused::UnknownSender);
        };
        let plaintext = self.sessions.open(sender, datagram)?;
        let message: Result<Message, _> = codec::decode(plaintext);
        // A host that moved, or whose NAT did, is followed to where its authentic and fresh datagrams come from.
        self.sessions.paths.heard(sender, from, now, &mut self.out);
        let message = message.map_err(|_| Refused::Malformed)?;
        if self.hosts.heard(host, now, &mut self.out) {
            self.welcome_back(host, sender, now);
        }
        self.handle_message((host, sender, from), message, now)
    }

    fn handle_message(
        &mut self,
        (host, tag, from): (HostId, Tag, SocketAddr),
        message: Message,
        now: Time,
    ) -> Result<(), Refused> {
        let out = &mut self.out;
        match message {
            Message::Swim(bytes) => {
                let from = self.hosts.get(host).filter(|host| host.tag == tag);
                let from = from.map(|host| host.entry.clone());
                if !from.is_some_and(|from| self.membership.handle_datagram(&from, &bytes, now)) {
                    self.counters.membership_refused += 1;
                }
            }
            Message::Ping { version } => {
                self.directory.note_version(host, tag, version, now, out);
                out.send(
                    tag,
                    &Message::Pong {
                        version: self.directory.version(),
                    },
                );
            }
            Message::Pong { version } => self.directory.note_version(host, tag, version, now, out),
            Message::Digest {
                version,
                beacon_age_s,
                others,
            } => {
                self.directory.note_version(host, tag, version, now, out);
                let me = self.sessions.tag();
                let strangers = self.directory.handle_digest(tag, me, &others, now, out);
                self.note_answer(host, beacon_age_s, now);
                self.meet(&strangers, now);
            }
            Message::Pull(ranges) => self.directory.handle_pull(tag, ranges, now),
            Message::Delta(delta) => {
                if !self.directory.handle_delta(host, tag, delta, now, out) {
                    return Err(Refused::Malformed);
                }
            }
            Message::SchemaRequest { hash, missing } => {
                self.directory
                    .handle_schema_request(tag, hash, missing, now);
            }
            Message::SchemaPart(part) => self.directory.handle_schema_part(part, now, out),
            Message::Subscribe(entries) => {
                let Some(at) = reader_addr(&self.sessions, tag) else {
                    return Ok(());
                };
                let directory = &self.directory;
                let exists = |name: &ItemName| directory.own(name).is_some();
                let refused = self
                    .streams
                    .handle_subscribe(tag, at, entries, exists, now, out);
                self.counters.over_limit += refused;
            }
            Message::Grant(entries) => {
                let directory = &self.directory;
                let describe = |name: &ItemName| directory.find(name).map(|(_, d)| d.clone());
                self.interest
                    .handle_grant(tag, &entries, describe, now, out);
            }
            Message::Unsubscribe(wants) => self.streams.handle_unsubscribe(tag, &wants, now, out),
            Message::Renew { sent, entries } => {
                let Some(at) = reader_addr(&self.sessions, tag) else {
                    return Ok(());
                };
                let unknown = self.streams.handle_renew(tag, at, &entries, now, out);
                out.send(
                    tag,
                    &Message::Renewed {
                        echo: sent,
                        at: now,
                        unknown,
                    },
                );
            }
            Message::Renewed { echo, at, unknown } => {
                self.clocks.entry(tag).or_default().measure(echo, at, now);
                self.interest.handle_renewed(tag, echo, &unknown, now, out);
                self.tell_clock(tag, now);
            }
            Message::Ack(entries) => self.streams.handle_ack(tag, &entries, out),
            Message::Report(reports) => {
                self.streams.handle_report(tag, &reports, now, out);
                for report in reports {
                    out.offer(Event::Report { tag, report });
                }
            }
            Message::Nack(nacks) => {
                for nack in nacks {
                    out.offer(Event::Nack { tag, nack });
                }
            }
            Message::Probe { nonce } => out.send_by(tag, from, &Message::Probed { nonce }),
            Message::Probed { nonce } => self.sessions.paths.answered(tag, nonce, now),
            Message::Addresses {
                revision,
                control_addrs,
            } => {
                if control_addrs.len() > CONTROL_ADDRS_MAX {
                    return Err(Refused::Malformed);
                }
                let news = (revision, control_addrs.as_slice());
                self.sessions.paths.announced(tag, from, news, now, out);
            }
            Message::Leave => {
                self.hosts.left(host, now, &mut self.out);
                self.end_life(tag, now);
                self.directory.forget(host, &mut self.out);
                self.refresh_prefixes();
            }
        }
        Ok(())
    }
}

pub(super) fn reader_addr(sessions: &Sessions, tag: Tag) -> Option<ReaderAddr> {
    let session = sessions.get(tag)?;
    Some(ReaderAddr {
        data: sessions.data_addr(tag)?,
        multicast: session.multicast,
    })
}
