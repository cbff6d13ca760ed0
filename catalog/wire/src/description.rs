//! What a host tells the others about one of its items.

use std::fmt;

use serde::{Deserialize, Serialize};

use crate::{Epoch, ItemName};

/// Identity of a schema: the first 16 bytes of a SHA-256 over names, types, offsets and encoding.
#[derive(Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct SchemaHash(pub [u8; 16]);

/// Who writes an item now.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum WriterState {
    /// A living program holds the lease.
    Live,
    /// The last writer is gone; the last value stays.
    Orphaned,
    /// The daemon is writer of record of a value that was put.
    Daemon,
}

/// One entry of a host's directory.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ItemDescription {
    /// The item's name, under its host's prefix.
    pub name: ItemName,
    /// Hash of its schema, whose text travels apart.
    pub schema_hash: SchemaHash,
    /// Largest payload, bytes.
    pub capacity_bytes: u32,
    /// Samples that its ring holds.
    pub depth: u32,
    /// Tenure of the present or last writer.
    pub epoch: Epoch,
    /// Who writes it.
    pub writer: WriterState,
    /// Name of the program that holds or last held the lease, at most 64 bytes.
    pub program: String,
}

impl ItemDescription {
    /// Longest program name that a description carries, bytes.
    pub const PROGRAM_MAX_BYTES: usize = 64;
}

impl fmt::Display for SchemaHash {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.iter().try_for_each(|b| write!(f, "{b:02x}"))
    }
}

impl fmt::Debug for SchemaHash {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "SchemaHash({self})")
    }
}
