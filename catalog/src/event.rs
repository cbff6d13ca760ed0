//! What the control plane tells its driver: effects as values.

use std::net::SocketAddr;
use std::sync::Arc;

use ddx_wire::message::{NackEntry, ReportEntry};
use ddx_wire::seal::Opener;
use ddx_wire::{
    ClockOffset, Contract, Epoch, HostId, HostName, Incarnation, ItemDescription, ItemName, Seq,
    StreamId, Tag,
};

use crate::delivery::Route;

/// Something that the driver must do or may want to show.
#[expect(
    clippy::large_enum_variant,
    reason = "the one large event, a session, is rare, and events are consumed one by one"
)]
pub enum Event {
    /// A host answers, for the first time or again after [`Event::HostUnreachable`] or [`Event::HostDown`].
    HostUp {
        /// The host.
        host: HostId,
        /// Its name.
        name: HostName,
        /// Which life of it answers.
        incarnation: Incarnation,
        /// Where its control socket is.
        addr: SocketAddr,
    },
    /// Nothing was heard of a host for three seconds. Its values stay.
    HostUnreachable {
        /// The host.
        host: HostId,
    },
    /// Nothing was heard of a host for ten seconds or more. Its items stay listed, its readers are forgotten.
    HostDown {
        /// The host.
        host: HostId,
    },
    /// A host said goodbye. Its items are gone.
    HostLeft {
        /// The host.
        host: HostId,
    },
    /// A host holds the same prefix as another and lost to it, or has it back.
    PrefixConflict {
        /// The host that lost, which may be this one: its local names are unaffected.
        host: HostId,
        /// Prefix under which others see its items now.
        shown_as: String,
    },
    /// Another life of this host took the same or a higher ordinal: start anew with one above `ordinal`.
    Reincarnate {
        /// Highest ordinal that was ever seen for this host.
        ordinal: u32,
    },
    /// An item of another host is known, or its description changed.
    ItemKnown {
        /// Its owner.
        host: HostId,
        /// Name under which this host shows it; differs from `description.name` after a prefix conflict.
        name: ItemName,
        /// What its owner says about it.
        description: ItemDescription,
        /// Text of its schema, as the owner sent it. It is not compared with the hash here.
        schema_text: Arc<str>,
    },
    /// An item of another host is no more.
    ItemGone {
        /// Its owner.
        host: HostId,
        /// Name under which this host showed it.
        name: ItemName,
    },
    /// A host answered a fresh challenge: samples from it may be opened.
    Session {
        /// Short name of that life of the host.
        tag: Tag,
        /// The host.
        host: HostId,
        /// Opens what it seals on the data lane.
        opener: Opener,
    },
    /// A session ended: nothing more is accepted from that life of the host.
    SessionClosed {
        /// Short name of that life of the host.
        tag: Tag,
    },
    /// Send an item of this host: somebody reads it.
    OpenStream {
        /// Number of the stream.
        stream: StreamId,
        /// The item.
        name: ItemName,
        /// To whom, how often and by what path.
        route: Route,
    },
    /// The readers or the path of a stream changed.
    UpdateStream {
        /// Number of the stream.
        stream: StreamId,
        /// To whom, how often and by what path now.
        route: Route,
    },
    /// Nobody reads a stream any longer.
    CloseStream {
        /// Number of the stream.
        stream: StreamId,
    },
    /// A reading host says what it holds of a stream; zero and zero is nothing.
    Held {
        /// Number of the stream.
        stream: StreamId,
        /// The reading host.
        tag: Tag,
        /// Epoch of the newest sample that it holds.
        epoch: Epoch,
        /// Sequence of the newest sample that it holds.
        seq: Seq,
    },
    /// A reading host tells how datagrams reach it.
    Report {
        /// The reading host.
        tag: Tag,
        /// What it says of one path.
        report: ReportEntry,
    },
    /// A reading host lacks something.
    Nack {
        /// The reading host.
        tag: Tag,
        /// What it lacks.
        nack: NackEntry,
    },
    /// Samples of an item that this host subscribed to will arrive on a stream.
    Expect {
        /// The sending host.
        tag: Tag,
        /// Its number for the stream.
        stream: StreamId,
        /// Name under which the item was subscribed.
        name: ItemName,
        /// What its owner says about it.
        description: ItemDescription,
        /// What was asked for.
        contract: Contract,
    },
    /// A stream is over.
    Forget {
        /// The sending host.
        tag: Tag,
        /// Its number for the stream.
        stream: StreamId,
    },
    /// Receive what is sent to a multicast group.
    JoinGroup(SocketAddr),
    /// No stream uses a multicast group any longer.
    LeaveGroup(SocketAddr),
    /// A new estimate of another host's clock, valid until the next one, about one second.
    Clock {
        /// The other host.
        tag: Tag,
        /// Its boot clock minus this host's.
        offset: ClockOffset,
    },
}
