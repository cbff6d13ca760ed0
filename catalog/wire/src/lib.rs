//! The words and messages that hosts exchange, and the names that every room shares.
//!
//! Nothing here opens, waits or reads a clock. Datagrams are sealed ([`seal`]), carry either control messages
//! ([`message`]) or samples ([`sample`]), and are specified in `catalog/PROTOCOL.md`.
#![cfg_attr(
    not(test),
    warn(
        clippy::arithmetic_side_effects,
        clippy::indexing_slicing,
        clippy::as_conversions
    )
)]

pub mod codec;
mod contract;
mod description;
mod header;
mod id;
mod key;
pub mod message;
mod name;
mod replay;
pub mod sample;
pub mod seal;
mod time;

pub use contract::{Contract, Delivery, Priority};
pub use description::{ItemDescription, SchemaHash, WriterState};
pub use id::{DomainId, Epoch, HostId, Incarnation, Seq, StreamId, Tag};
pub use name::{HostName, ItemName, NameError, Pattern, PatternError};
pub use time::{ClockOffset, Time};
