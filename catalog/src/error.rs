//! What the application's commands can fail with.

use ddx_wire::ItemName;
use thiserror::Error;

/// A command that the control plane refuses.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[non_exhaustive]
pub enum Error {
    /// The directory of this host holds as many items as it may.
    #[error("directory is full: {limit} items; `{name}` was not announced")]
    DirectoryFull {
        /// The item.
        name: ItemName,
        /// The limit.
        limit: usize,
    },
    /// A description is too long to travel.
    #[error("description of `{name}` takes {bytes} bytes, more than {limit}")]
    DescriptionTooLong {
        /// The item.
        name: ItemName,
        /// Its length as encoded.
        bytes: usize,
        /// The limit.
        limit: usize,
    },
    /// A schema text is too long to travel.
    #[error("schema of `{name}` takes {bytes} bytes, more than {limit}")]
    SchemaTooLong {
        /// The item.
        name: ItemName,
        /// Its length.
        bytes: usize,
        /// The limit.
        limit: usize,
    },
    /// The schema texts of this host's items take as many bytes as they may.
    #[error("schemas of this host are full: {limit} bytes; `{name}` was not announced")]
    SchemasFull {
        /// The item.
        name: ItemName,
        /// The limit, bytes.
        limit: usize,
    },
    /// This host subscribes to as many items as it may.
    #[error("{limit} items are subscribed already; `{name}` was not")]
    TooManySubscriptions {
        /// The item.
        name: ItemName,
        /// The limit.
        limit: usize,
    },
}
