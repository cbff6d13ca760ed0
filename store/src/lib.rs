//! Named typed items in the shared memory of one host.

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
pub use control::{Description, ItemEntry, ReaderEntry, Refusal, SCHEMA_MAX_BYTES};
pub use error::Error;
pub use quota::{Limit, Quotas};
pub use reader::{From, Guard, RawGuard, RawReader, Reader, ReaderOptions};
pub use sample::{After, Age, Cursor, Meta, Missed, Sample};
pub use segment::Origin;
pub use store::{Options, Store};
pub use wait::{Wait, wait_any};
pub use waitset::{WaitKey, WaitSet, Waker};
pub use writer::{Loan, RawLoan, RawWriter, Writer, WriterOptions};

pub mod item;
pub mod schema;

pub use ddx_derive::Item;
pub use item::{Item, Plain, Typed};
pub use schema::{Encoding, Schema, SchemaError};
