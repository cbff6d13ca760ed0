//! Who has what, who wants it: membership, directory, interest, delivery, clocks; no I/O.
//!
//! A [`Catalog`] is the whole control plane of one host as a pure machine: datagrams, commands and the time go in,
//! datagrams and [`Event`]s come out. The machines in [`delivery`] carry the samples that its events call for. Neither
//! reads a clock, draws randomness or opens anything, so a domain of many hosts runs in one thread under virtual time.
//!
//! What travels is in `PROTOCOL.md`. How the parts lean on each other:
//!
//! ```text
//! session     greetings, challenges, keys         the door: nothing below sees a stranger
//! paths       addresses, probes                   which address of a host to use
//! membership  SWIM, by the foca crate             rumours about hosts
//! hosts       up, unreachable, down, left         what is believed of them
//! directory   items, digests, deltas, schemas     who has what
//! interest    subscriptions, renewals             what this host wants
//! streams     leases, groups                      what others want of it
//! clock       offset and bound of each host       how old a remote sample is
//! ```
//!
//! The rule of the driver: one call that changes something, then drain [`Catalog::poll_transmit`] and
//! [`Catalog::poll_event`], then sleep until [`Catalog::poll_timeout`] or the next datagram.

mod catalog;
mod clock;
mod config;
mod counters;
pub mod delivery;
mod directory;
mod error;
mod event;
mod hosts;
mod interest;
mod membership;
mod outbox;
mod paths;
mod prefix;
mod rng;
mod session;
mod streams;

pub use catalog::{Catalog, HostStatus, TimerName, Transmit};
pub use config::{
    BEACON_PORT_BASE, Config, SAMPLE_GROUP_PORT_BASE, SAMPLE_GROUPS, beacon_group, sample_group,
};
pub use counters::Counters;
pub use directory::RemoteItem;
pub use error::Error;
pub use event::Event;
pub use hosts::HostState;
pub use interest::StreamIn;
pub use outbox::Dest;
pub use paths::PathStatus;
pub use streams::{Choice, Shuns, StreamOut};
