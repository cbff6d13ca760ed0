//! Carrying samples between hosts: what the sending and the receiving thread decide, without a socket or a clock.
//!
//! A [`Sender`] coalesces small samples into datagrams, cuts large ones into fragments, keeps contracts at the source and
//! each path below the rate at which it fills, and repeats what a host lacks. A [`Receiver`] opens, reassembles, orders,
//! deduplicates and keeps the books of each stream. Both are driven alike: one mutation, then drain `poll_event`,
//! `poll_transmit` or `poll_sample`, then sleep until `poll_timeout`. The wire format is in `catalog/PROTOCOL.md`.
//!
//! Next to nothing is queued: the store keeps the samples, and a path that has room asks for the one that it needs next.
//!
//! ```text
//! sender      streams, readers, repeats of the last value
//! path        one destination: rate, lanes, turns        receiver    streams, sessions
//! congestion  the rate, from reports                     reception   reports
//! flow        one stream on one path                     order       each sample, in order
//! transfer    one large sample in fragments              reassembly  fragments, and what is missing
//! queue       datagrams that are about to leave          books       what became of each sample
//! ```

use std::borrow::Cow;
use std::net::SocketAddr;
use std::time::Duration;

use ddx_wire::message::{NackEntry, ReportEntry};
pub use ddx_wire::sample::SampleMeta;
use ddx_wire::{Contract, Epoch, Seq, StreamId, Tag, Time};

mod books;
mod cauchy;
mod congestion;
mod deadlines;
mod early;
mod flow;
mod order;
mod pace;
mod parity;
mod path;
mod queue;
mod reassembly;
mod receiver;
mod reception;
mod reporter;
mod sender;
mod shares;
mod stream;
mod transfer;

pub use books::{Books, SentBooks, SourceBooks};
pub use receiver::{Receiver, ReceiverConfig, ReceiverCounters};
pub(crate) use reporter::Progress;
pub use sender::{Sender, SenderConfig, SenderCounters, StreamCounters};

/// Where a stream goes and how often.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Route {
    /// Union of what the readers ask.
    pub contract: Contract,
    /// The hosts that read the stream, and which way each is served. Those beyond 1,024 are left out.
    pub readers: Vec<ReaderHost>,
}

/// A host that reads a stream.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ReaderHost {
    /// Its incarnation.
    pub tag: Tag,
    /// Its data port.
    pub addr: SocketAddr,
    /// Which way it is served.
    pub via: Via,
}

/// The way of a stream to one reading host.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Via {
    /// A copy of its own.
    Unicast,
    /// One copy to this group, for all that take this way.
    Group(SocketAddr),
    /// Both, until the reader confirms the group; it drops the second copy.
    Both(SocketAddr),
}

/// What a [`Sender`] wants read from the store.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Fetch {
    /// The stream.
    pub stream: StreamId,
    /// The destination that has room for it.
    pub to: SocketAddr,
    /// Which sample.
    pub want: Want,
    /// Whether it was sent before.
    pub again: bool,
}

/// Which sample of an item is wanted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Want {
    /// The newest.
    Newest,
    /// The oldest that is still there and newer than this one.
    After(Epoch, Seq),
    /// This one, or the oldest after it that is still there.
    At(Epoch, Seq),
}

/// What is known of a destination, for listings.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PathStatus {
    /// The destination.
    pub to: SocketAddr,
    /// Rate that it is believed to carry.
    pub bytes_per_second: u64,
    /// How much longer datagrams take than the fastest of late.
    pub queue: Duration,
    /// Share of datagrams lost at the last report, thousandths.
    pub loss_permille: u16,
    /// Longest datagram that is known to get through, bytes.
    pub datagram_bytes: usize,
    /// Streams that wait for their turn.
    pub waiting: usize,
}

/// When a stream's contract admits its next sample.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Due {
    /// At once.
    Now,
    /// Not before this instant; the newest sample then is the one to send.
    At(Time),
}

/// Datagrams to send: the bytes are in the buffer that was passed to `poll_transmit`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Transmit {
    /// Destination of all of them.
    pub to: SocketAddr,
    /// Length of each but the last, which may be shorter; `None` when the buffer is one datagram.
    pub segment: Option<u16>,
}

/// What a [`Sender`] asks of its driver.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SenderEvent {
    /// Read this from the store, and pass it to [`Sender::fetched`].
    Fetch(Fetch),
}

/// What a [`Receiver`] tells its driver.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ReceiverEvent {
    /// Tell the sender what is held: the stream went quiet, or a repeat came.
    Quiet {
        /// The sender.
        tag: Tag,
        /// The stream.
        stream: StreamId,
        /// Epoch of the newest sample held.
        epoch: Epoch,
        /// Number of the newest sample held.
        seq: Seq,
    },
    /// New samples keep coming: the next renewal can say what is held and which way works.
    Flows {
        /// The sender.
        tag: Tag,
        /// The stream.
        stream: StreamId,
        /// Epoch of the newest sample held.
        epoch: Epoch,
        /// Number of the newest sample held.
        seq: Seq,
    },
    /// Samples of the stream arrive by multicast.
    OnGroup {
        /// The sender.
        tag: Tag,
        /// The stream.
        stream: StreamId,
    },
    /// Tell the sender how its datagrams arrive.
    Report(Tag, ReportEntry),
    /// Tell the sender what is missing.
    Nack(Tag, NackEntry),
}

/// A sample that arrived whole, newer than any delivered before it on its stream.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Received<'a> {
    /// The sender.
    pub tag: Tag,
    /// The stream.
    pub stream: StreamId,
    /// What is known of it; times are of the sender's clock.
    pub meta: SampleMeta,
    /// Its bytes: those of a sample that came in fragments are the driver's.
    pub payload: Cow<'a, [u8]>,
    /// What became at the source of the samples between this one and the one before; the others were lost.
    pub passed: Passed,
}

/// What is here of an item already, when another stream of it begins.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Held {
    /// Who sent the newest sample.
    pub from: Tag,
    /// Its epoch and number.
    pub newest: (Epoch, Seq),
}

/// Samples that a source did not send, by cause. Each of a stream lies before some sample that was delivered.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Passed {
    /// Gave way to newer ones in the writer's ring.
    pub overwritten: u64,
    /// Were left out because of the contract, or because the link is slower than the stream.
    pub filtered: u64,
}

/// Why a machine wants to be called again.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TimerName {
    /// The rate of a path admits its next batch.
    Pace,
    /// A reader has not confirmed the last value.
    Repeat,
    /// A stream may have gone quiet.
    Quiet,
    /// Fragments are asked for, or an incomplete sample is given up.
    Reassembly,
    /// Samples are asked for, or given up.
    Order,
    /// A sender is told how its datagrams arrive.
    Report,
}

impl Via {
    /// The group, if it is used.
    pub fn group(self) -> Option<SocketAddr> {
        match self {
            Self::Unicast => None,
            Self::Group(group) | Self::Both(group) => Some(group),
        }
    }
}

impl Route {
    /// Whether one copy to a group serves all.
    pub fn is_by_group(&self) -> bool {
        let mut vias = self.readers.iter().map(|reader| reader.via);
        !self.readers.is_empty() && vias.all(|via| matches!(via, Via::Group(_)))
    }

    /// Whether each reader gets a copy of its own, and no group any.
    pub fn is_by_unicast(&self) -> bool {
        let mut vias = self.readers.iter().map(|reader| reader.via);
        vias.all(|via| via == Via::Unicast)
    }
}

impl ReaderHost {
    /// Where samples go for it.
    fn destinations(&self) -> impl Iterator<Item = SocketAddr> {
        let unicast = match self.via {
            Via::Unicast | Via::Both(_) => Some(self.addr),
            Via::Group(_) => None,
        };
        unicast.into_iter().chain(self.via.group())
    }

    /// Whether what goes to `to` is meant for it too.
    fn is_reached_by(&self, to: SocketAddr) -> bool {
        self.addr == to || self.destinations().any(|destination| destination == to)
    }
}

/// The number of a group's path, from 1; `None` for an address of one host. Every host of a domain numbers them alike.
pub(crate) fn group_number(to: SocketAddr) -> Option<u16> {
    let SocketAddr::V4(to) = to else {
        return None;
    };
    let last = to.ip().octets()[3];
    to.ip().is_multicast().then_some(u16::from(last % 16) + 1)
}

/// Order of samples within a stream: by epoch, then by number.
fn key(meta: &SampleMeta) -> (Epoch, Seq) {
    (meta.epoch, meta.seq)
}

#[cfg(test)]
mod tests;
