//! Named typed items in the shared memory of one host, and in its mirrors of other hosts' items.
//!
//! A program opens the [`Store`] of its host's daemon and asks it for a [`Writer`] or a [`Reader`] by name. From then on
//! samples go through shared memory alone: a write never waits for a reader, a read never touches a socket, and both go
//! on when the daemon is dead. A reader on another host's item is the subscription: the daemon has it sent, and the
//! samples appear here.
//!
//! ```
//! use std::time::Duration;
//!
//! use ddx_store::server::Config;
//! use ddx_store::{Item, Store};
//! use ddx_wire::HostName;
//!
//! #[derive(Item, Clone, Copy, Debug, PartialEq)]
//! #[repr(C)]
//! struct Pose {
//!     #[ddx(unit = "m")]
//!     x: f64,
//!     #[ddx(unit = "m")]
//!     y: f64,
//! }
//!
//! # fn main() -> Result<(), ddx_store::Error> {
//! // A program on a host with a daemon says `Store::open()?`; this one brings its own.
//! let (store, mut server) = Store::embedded(Config::new(HostName::sanitised("robot1")))?;
//! let stop = std::sync::atomic::AtomicBool::new(false);
//! std::thread::scope(|scope| {
//!     scope.spawn(|| server.run(&stop));
//!     let mut writer = store.writer::<Pose>("pose")?;
//!     let mut reader = store.reader::<Pose>("robot1/pose")?;
//!     writer.write(&Pose { x: 1.0, y: 2.0 })?;
//!     let sample = reader.next(Duration::from_secs(1))?;
//!     assert_eq!(sample.as_ref().map(|sample| sample.value), Some(Pose { x: 1.0, y: 2.0 }));
//!     if let Some(sample) = sample {
//!         println!("{} old", sample.meta.age(ddx_store::now()));
//!     }
//!     stop.store(true, std::sync::atomic::Ordering::Relaxed);
//!     Ok(())
//! })
//! # }
//! ```
//!
//! | to read | call |
//! |---|---|
//! | the present value, at once | [`Reader::current`] |
//! | what is newer than all seen, with a deadline | [`Reader::next`], or [`wait_any`] over many readers |
//! | what follows a place, with exact counts of what was missed | [`Reader::after`] |
//! | in place, without a copy | [`Reader::current_pinned`], [`Reader::next_pinned`] |
//!
//! What crosses a process is laid out in [`layout`]; the protocol on it is [`ring`]'s, and loom checks it.

/// The examples of the README, which must compile.
#[cfg(doctest)]
#[doc = include_str!("../../README.md")]
pub struct Readme;

// The memory protocol: public for the models, contract tests and benches, not for applications.
#[doc(hidden)]
pub mod layout;
#[doc(hidden)]
pub mod notify;
#[doc(hidden)]
pub mod ring;
#[doc(hidden)]
pub mod segment;
#[doc(hidden)]
pub mod shm;
#[doc(hidden)]
pub mod sync;

mod clock;
mod connection;
#[doc(hidden)]
pub mod control;
mod crash;
mod descriptor;
mod error;
mod life;
mod quota;
mod reader;
mod recovery;
mod sample;
pub mod server;
mod socket;
mod store;
mod wait;
mod waitset;
mod writer;

pub use clock::now;
pub use control::{Description, ItemEntry, Newest, ReaderEntry, Refusal, SCHEMA_MAX_BYTES};
pub use error::Error;
pub use quota::{Limit, Quotas};
pub use reader::{From, Guard, RawGuard, RawReader, Reader, ReaderOptions, Taken};
pub use sample::{After, Age, Cursor, Meta, Missed, Sample};
pub use segment::{Origin, ReaderBooks};
pub use store::{Options, Store};
pub use wait::{Wait, wait_any};
pub use waitset::{WaitKey, WaitSet, Waker};
pub use writer::{Loan, RawLoan, RawWriter, Writer, WriterOptions};

pub mod item;
pub mod schema;

pub use ddx_derive::Item;
pub use ddx_wire::{Delivery, Priority};
pub use item::{Item, Plain, Typed};
pub use schema::{Encoding, Schema, SchemaError};
