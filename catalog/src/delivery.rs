//! Carrying samples between hosts: what the sending and the receiving thread decide, without a socket or a clock.
//!
//! A [`Sender`] coalesces small samples into datagrams, cuts large ones into fragments, limits rates at the source and
//! repeats the last value to a host that does not confirm it. A [`Receiver`] opens, reassembles, orders, deduplicates and
//! keeps the books of each stream. Both are driven alike: one mutation, then drain `poll_transmit` or `poll_sample`, then
//! `poll_event`, then sleep until `poll_timeout`. The wire format is in `catalog/PROTOCOL.md`.

use std::net::SocketAddr;

pub use ddx_wire::sample::SampleMeta;
use ddx_wire::{Contract, Epoch, Seq, StreamId, Tag, Time};

mod books;
mod deadlines;
mod early;
mod outbox;
mod pace;
mod reassembly;
mod receiver;
mod sender;

pub use books::Books;
pub use receiver::{Receiver, ReceiverConfig, ReceiverCounters};
pub use sender::{Sender, SenderConfig, SenderCounters, StreamCounters};

/// Where a stream goes and how often.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Route {
    /// Union of what the readers ask.
    pub contract: Contract,
    /// The hosts that read the stream. Those beyond 1,024 are left out.
    pub readers: Vec<ReaderHost>,
    /// By which way.
    pub path: Path,
}

/// A host that reads a stream.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ReaderHost {
    /// Its incarnation.
    pub tag: Tag,
    /// Its data port.
    pub addr: SocketAddr,
}

/// The way that a stream takes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Path {
    /// One copy for each reading host.
    Unicast,
    /// One copy to this group for all.
    Multicast(SocketAddr),
    /// Both, until every reader confirms the group; readers drop the second copy.
    Both(SocketAddr),
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
    /// Pass the stream's present value, if it has one, to [`Sender::repeat`].
    Repeat {
        /// The stream.
        stream: StreamId,
        /// The host that lacks it.
        to: Tag,
    },
}

/// What a [`Receiver`] tells its driver.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
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
}

/// A sample that arrived whole, newer than any delivered before it on its stream.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Received<'a> {
    /// The sender.
    pub tag: Tag,
    /// The stream.
    pub stream: StreamId,
    /// What is known of it; times are of the sender's clock.
    pub meta: SampleMeta,
    /// Its bytes.
    pub payload: &'a [u8],
}

/// Why a machine wants to be called again.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TimerName {
    /// A datagram has waited for company long enough.
    Coalesce,
    /// The paced rate admits the next batch.
    Pace,
    /// A reader has not confirmed the last value.
    Repeat,
    /// A stream may have gone quiet.
    Quiet,
    /// An incomplete sample is given up.
    Reassembly,
}

/// Order of samples within a stream: by epoch, then by number.
fn key(meta: &SampleMeta) -> (Epoch, Seq) {
    (meta.epoch, meta.seq)
}

#[cfg(test)]
mod tests;
