//! The messages between a program and its daemon, and the limits on them.
//!
//! One datagram of a SOCK_SEQPACKET socket is one message. A program numbers its requests and gets one answer to each,
//! in order; notices come in between. Handles are numbered by the program, so that they survive a restart of the daemon.
//! File descriptors ride beside a message: a segment is always two, `data` then `ctl`.

use ddx_wire::codec::{self, CodecError};
use ddx_wire::{Contract, Epoch, HostName, ItemName, SchemaHash, Seq, Time, WriterState};
use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::quota::Limit;
use crate::segment::ReaderBooks;

/// Version of these messages; another one is refused at the greeting.
pub const VERSION: u32 = 2;

/// Longest message in either direction, bytes.
pub const MESSAGE_MAX_BYTES: usize = 64 * 1024;

/// Most file descriptors beside one message.
pub(crate) const FDS_MAX: usize = 2;

/// Longest schema text that may be registered, bytes: with names and counters it still fits one message.
pub const SCHEMA_MAX_BYTES: usize = 32 * 1024;

/// What a program says to the daemon.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ToDaemon {
    /// Number of the request, which the answer repeats.
    pub serial: u32,
    /// The request.
    pub request: Request,
}

/// What the daemon says to a program.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum ToClient {
    /// The answer to one request.
    Reply {
        /// Number of the request.
        serial: u32,
        /// The answer.
        reply: Reply,
    },
    /// News about a handle that nobody asked for just now.
    Notice {
        /// Number of the handle.
        handle: u32,
        /// The news.
        notice: Notice,
    },
}

/// A request of a program.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum Request {
    /// The greeting, first on each connection.
    Hello {
        /// [`VERSION`].
        version: u32,
        /// Name of the program, for people.
        program: String,
    },
    /// Asks for the lease of an item.
    OpenWriter {
        /// Number of the new handle.
        handle: u32,
        /// Name as the program spells it.
        name: String,
        /// Text of the schema.
        schema: String,
        /// Why the program writes.
        purpose: Purpose,
    },
    /// Hands over the segment that the lease's holder made. Two file descriptors.
    Commit {
        /// Number of the writer's handle.
        handle: u32,
    },
    /// Hands a living writer's segment to a daemon that was started anew. Two file descriptors.
    Resume {
        /// Number of the writer's handle.
        handle: u32,
        /// Name as the former daemon gave it.
        name: String,
        /// Text of the schema.
        schema: String,
    },
    /// Opens a reader on a name that may not exist yet.
    OpenReader {
        /// Number of the new handle.
        handle: u32,
        /// Name as the program spells it.
        name: String,
        /// Text of the schema that the reader expects; none takes any.
        schema: Option<String>,
        /// Pins beyond the two that each reader has.
        pins: u32,
        /// What it asks of the source.
        contract: Contract,
        /// Place in a segment that a former daemon gave, which the reader still uses.
        held: Option<HeldCell>,
    },
    /// Gives a handle back.
    Close {
        /// Number of the handle.
        handle: u32,
    },
    /// Asks for the items after a name, in order, as many as fit.
    List {
        /// Last name of the previous page; empty at first.
        after: String,
    },
    /// Asks for one item in full.
    Describe {
        /// Name as the program spells it.
        name: String,
    },
    /// Removes an item that no program writes.
    Remove {
        /// Name as the program spells it.
        name: String,
    },
}

/// A cell that a reader holds since before the daemon was started anew.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct HeldCell {
    /// Epoch of the segment.
    pub epoch: Epoch,
    /// Number of the cell.
    pub cell: u32,
    /// Pins that it was given.
    pub pins: u32,
}

/// Why a program writes an item.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Purpose {
    /// As its writer, until it closes the handle or dies.
    Write,
    /// To leave one value, of which the daemon is then the writer of record.
    Put,
}

/// An answer of the daemon.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum Reply {
    /// To `Hello`; beside it the bells.
    Hello {
        /// Name of this host.
        host: HostName,
        /// Number of the domain.
        domain: u16,
        /// Which of the bells is this client's.
        bell: u16,
    },
    /// To `OpenWriter`; beside it the item's last segment, if there is one to be seeded from.
    Writer {
        /// The canonical name.
        name: ItemName,
        /// Epoch of the new segment.
        epoch: Epoch,
    },
    /// To `OpenReader`; when bound, the segment is beside it.
    Reader {
        /// The canonical name.
        name: ItemName,
        /// The cell, when the item exists.
        binding: Option<Binding>,
    },
    /// To `List`: one page.
    Entries {
        /// The items, by name.
        entries: Vec<ItemEntry>,
        /// Whether another page follows.
        more: bool,
    },
    /// To `Describe`.
    Description(Box<Description>),
    /// To all else: done.
    Done,
    /// No, and why.
    Refused(Refusal),
}

/// News about a handle.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum Notice {
    /// The reader's item has a new segment, which is beside this.
    Bound(Binding),
    /// The reader's item was removed.
    Removed,
    /// The reader cannot read the new segment, or the writer has lost its lease.
    Refused(Refusal),
    /// The client did something that ends the connection. The handle says nothing.
    Closing(Refusal),
}

/// A reader's place in a segment.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Binding {
    /// The reader's cell.
    pub cell: u32,
    /// Pins that it may set at one time, the two base pins included.
    pub pins: u32,
    /// Which bit of its client's bell is rung for it.
    pub bit: u16,
    /// Epoch of the segment.
    pub epoch: Epoch,
    /// Text of the item's schema.
    pub schema: String,
}

/// Why the daemon refuses a request.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, Error)]
#[non_exhaustive]
pub enum Refusal {
    /// Another program holds the lease.
    #[error("item `{name}` is written by `{program}` (pid {pid})")]
    Held {
        /// The item.
        name: ItemName,
        /// Name of the program that holds the lease.
        program: String,
        /// Its process.
        pid: u32,
    },
    /// The name belongs to another host.
    #[error("item `{name}` is not under this host's prefix `{host}`; hint: write `./{hint}`")]
    ForeignPrefix {
        /// The item.
        name: ItemName,
        /// This host.
        host: HostName,
        /// What to write after `./`.
        hint: String,
    },
    /// An administrative name, which only the daemon writes.
    #[error("item `{0}` is administrative: only the daemon writes it")]
    Administrative(ItemName),
    /// A limit is exhausted.
    #[error("limit reached: {limit}: {wanted} wanted, {max} allowed")]
    Quota {
        /// Which limit.
        limit: Limit,
        /// What the request would bring it to.
        wanted: u64,
        /// The most that is allowed.
        max: u64,
    },
    /// The schemas differ.
    #[error("item `{name}` has another schema: {difference}")]
    Schema {
        /// The item.
        name: ItemName,
        /// The first field that differs, and how.
        difference: String,
    },
    /// The text is not a name.
    #[error("{0}")]
    Name(String),
    /// The text is not a schema.
    #[error("{0}")]
    BadSchema(String),
    /// There is no such item.
    #[error("no item `{0}`")]
    Absent(ItemName),
    /// The segment is not as it must be.
    #[error("segment refused: {0}")]
    Segment(String),
    /// The message is not one, or not now.
    #[error("bad message: {0}")]
    Message(String),
}

/// One line of a listing.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ItemEntry {
    /// The item.
    pub name: ItemName,
    /// The host that owns it.
    pub host: HostName,
    /// Name of its schema; empty while unknown.
    pub schema_name: String,
    /// Hash of its schema; zero while unknown.
    pub schema_hash: SchemaHash,
    /// Who writes it; none when there are only readers that wait for it.
    pub writer: Option<WriterState>,
    /// Name of the program that writes or last wrote it.
    pub program: String,
    /// Process that writes it, when it lives on this host.
    pub pid: Option<u32>,
    /// Open readers on this host.
    pub readers: u32,
    /// When its last sample was published, on this host's clock; none before the first or when not held here.
    pub last_publish: Option<Time>,
    /// Largest payload, bytes.
    pub capacity_bytes: u32,
}

/// One item in full.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Description {
    /// The line of the listing.
    pub entry: ItemEntry,
    /// Text of the schema; empty while unknown, or when another host's is longer than [`SCHEMA_MAX_BYTES`].
    pub schema: String,
    /// Epoch of the present segment, or of the owner's when it is not held here.
    pub epoch: Epoch,
    /// Samples published in the present segment.
    pub published: u64,
    /// The newest of them; none before the first, and while its writer overtakes the look.
    pub newest: Option<Newest>,
    /// Samples that the present segment's ring holds.
    pub depth: u32,
    /// Who reads it on this host.
    pub readers: Vec<ReaderEntry>,
    /// What the daemon says about its way here; empty for an item of this host.
    pub note: String,
}

/// The newest sample of a segment.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Newest {
    /// Its position, counted from 1: as many samples were stored.
    pub pos: u64,
    /// Tenure of the writer that made it.
    pub epoch: Epoch,
    /// Its number within the epoch, by its writer.
    pub seq: Seq,
    /// Bytes of its payload.
    pub bytes: u64,
}

/// One reader of an item.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ReaderEntry {
    /// Name of the program.
    pub program: String,
    /// Its process.
    pub pid: u32,
    /// What it asks of the source.
    pub contract: Contract,
    /// Whether it has a place in the item's segment.
    pub bound: bool,
    /// Why it was refused, if it was.
    pub refused: Option<String>,
    /// What it has read; none without a place, and while it is just reading.
    pub books: Option<ReaderBooks>,
}

impl Binding {
    /// The same, as a reader names it to the next daemon.
    pub(crate) fn held(&self) -> HeldCell {
        HeldCell {
            epoch: self.epoch,
            cell: self.cell,
            pins: self.pins,
        }
    }
}

impl ToDaemon {
    /// Reads a request; anything else is an error that says what is wrong.
    pub fn decode(bytes: &[u8]) -> Result<Self, CodecError> {
        codec::decode(bytes)
    }

    /// Writes the request.
    pub fn encode(&self) -> Result<Vec<u8>, CodecError> {
        let mut bytes = Vec::new();
        codec::encode(self, &mut bytes)?;
        Ok(bytes)
    }
}

impl ToClient {
    /// Reads an answer or a notice.
    pub fn decode(bytes: &[u8]) -> Result<Self, CodecError> {
        codec::decode(bytes)
    }

    /// Writes the answer or notice.
    pub fn encode(&self) -> Result<Vec<u8>, CodecError> {
        let mut bytes = Vec::new();
        codec::encode(self, &mut bytes)?;
        Ok(bytes)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_refused_name_reads_with_its_hint() {
        let host = HostName::parse("robot1").unwrap();
        let refusal = Refusal::ForeignPrefix {
            name: ItemName::parse("base/front/cam", &host).unwrap(),
            hint: "front/cam".to_owned(),
            host,
        };

        assert_eq!(
            refusal.to_string(),
            "item `base/front/cam` is not under this host's prefix `robot1`; hint: write `./front/cam`"
        );
    }

    #[test]
    fn garbage_is_an_error_and_a_request_reads_as_written() {
        let hello = ToDaemon {
            serial: 7,
            request: Request::Hello {
                version: VERSION,
                program: "p".to_owned(),
            },
        };
        let mut bytes = hello.encode().unwrap();

        assert_eq!(ToDaemon::decode(&bytes).unwrap(), hello);
        bytes.push(1);
        assert!(ToDaemon::decode(&bytes).is_err());
        assert!(ToDaemon::decode(&[0xff; 40]).is_err());
    }
}
