//! Where the parts of the control plane leave what is to be sent and told.

use std::collections::VecDeque;
use std::net::SocketAddr;

use ddx_wire::Tag;
use ddx_wire::codec;
use ddx_wire::message::{BODY_MAX_BYTES, Greeting, Message};
use ddx_wire::seal::HEADER_BYTES;

use crate::event::Event;

/// Datagrams that may wait to be sent, of at most 1,250 B each: 10 MiB. A driver drains after each step, so only a flood
/// gets here.
const QUEUE_MAX: usize = 8_192;

/// Events that may wait when one comes which says nothing that will not be said again: 12 MiB at most. The others are
/// bounded by the tables that they tell of.
const OFFERS_MAX: usize = 8_192;

/// Destination of a datagram.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Dest {
    /// One address, from the control socket.
    Addr(SocketAddr),
    /// The domain's beacon group, from the control socket too, so that answers arrive there.
    Beacon,
}

#[derive(Clone, Copy, Debug)]
pub(crate) enum Target {
    Greeting(Dest),
    Session(Tag),
    /// A session, by one of its paths.
    Path(Tag, SocketAddr),
}

#[derive(Debug)]
pub(crate) struct Outgoing {
    pub(crate) target: Target,
    /// Room for a header, then the message.
    pub(crate) bytes: Vec<u8>,
}

#[derive(Default)]
pub(crate) struct Outbox {
    queue: VecDeque<Outgoing>,
    events: VecDeque<Event>,
    /// Messages that could not be queued or written, and events that had no room.
    pub(crate) dropped: u64,
}

impl Outbox {
    pub(crate) fn send(&mut self, to: Tag, message: &Message) {
        let mut bytes = vec![0; HEADER_BYTES];
        let fits = codec::encode(message, &mut bytes).is_ok();
        self.push(Target::Session(to), bytes, fits);
    }

    /// Sends to one address of a host, which need not be the one in use.
    pub(crate) fn send_by(&mut self, to: Tag, addr: SocketAddr, message: &Message) {
        let mut bytes = vec![0; HEADER_BYTES];
        let fits = codec::encode(message, &mut bytes).is_ok();
        self.push(Target::Path(to, addr), bytes, fits);
    }

    pub(crate) fn greet(&mut self, to: Dest, greeting: &Greeting) {
        let mut bytes = vec![0; HEADER_BYTES];
        let fits = codec::encode(greeting, &mut bytes).is_ok();
        self.push(Target::Greeting(to), bytes, fits);
    }

    pub(crate) fn event(&mut self, event: Event) {
        self.events.push_back(event);
    }

    /// The same for an event that its host will repeat if it is lost.
    pub(crate) fn offer(&mut self, event: Event) {
        if self.events.len() >= OFFERS_MAX {
            self.dropped = self.dropped.saturating_add(1);
            return;
        }
        self.events.push_back(event);
    }

    pub(crate) fn pop(&mut self) -> Option<Outgoing> {
        self.queue.pop_front()
    }

    pub(crate) fn pop_event(&mut self) -> Option<Event> {
        self.events.pop_front()
    }

    fn push(&mut self, target: Target, bytes: Vec<u8>, fits: bool) {
        if !fits || bytes.len() > HEADER_BYTES + BODY_MAX_BYTES || self.queue.len() >= QUEUE_MAX {
            self.dropped = self.dropped.saturating_add(1);
            return;
        }
        self.queue.push_back(Outgoing { target, bytes });
    }
}

#[cfg(test)]
mod tests {
    use ddx_wire::message::{Lacks, NackEntry};
    use ddx_wire::{Epoch, Seq, StreamId};

    use super::*;

    #[test]
    fn what_waits_to_be_sent_and_told_is_little_and_the_rest_is_counted() {
        let mut out = Outbox::default();
        for nonce in 0..10_000 {
            out.send(Tag(1), &Message::Probe { nonce });
        }
        assert_eq!((out.queue.len(), out.dropped), (QUEUE_MAX, 10_000 - 8_192));
        for _ in 0..10_000 {
            let nack = NackEntry {
                stream: StreamId(1),
                epoch: Epoch(1),
                seq: Seq(1),
                lacks: Lacks::Samples(1),
            };
            out.offer(Event::Nack { tag: Tag(1), nack });
        }
        assert_eq!(out.events.len(), OFFERS_MAX);
        assert_eq!(out.dropped, 2 * (10_000 - 8_192));
        // What nobody repeats is told all the same.
        let stream = StreamId(1);
        out.event(Event::CloseStream { stream });
        assert_eq!(out.events.len(), OFFERS_MAX + 1);
        assert!(OFFERS_MAX * size_of::<Event>() <= 12 << 20);
    }
}
