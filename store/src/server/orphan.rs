//! What one daemon leaves to the next of an item that no program writes: the segment's own two files, and a label that
//! says what those do not.
//!
//! ```text
//! data, ctl   as the last writer has made them: nothing is copied, and seals keep their sizes
//! label       version, name, schema, program, writer of record; sealed against every write
//! ```
//!
//! The epoch stays what it was. A living writer that took the item over before the daemon died has a later one, so it
//! comes back to its item whatever was kept, and readers keep their places.

use std::fmt;
use std::fs::File;
use std::io::Write as _;
use std::os::fd::{AsFd, OwnedFd};
use std::os::unix::fs::FileExt as _;
use std::sync::Arc;

use ddx_wire::{Epoch, ItemName, WriterState, codec};
use rustix::fs::{MemfdFlags, SealFlags};
use serde::{Deserialize, Serialize};

use crate::control::{MESSAGE_MAX_BYTES, Refusal};
use crate::error::Error;

/// An item of this host that no program writes, with all that it takes to go on with it.
#[derive(Clone, Debug)]
pub struct Orphan {
    pub(super) epoch: Epoch,
    pub(super) label: Label,
    pub(super) data: Arc<OwnedFd>,
    pub(super) ctl: Arc<OwnedFd>,
}

/// What is to outlive the daemon, and what is not any more.
#[derive(Clone, Debug)]
pub enum Keep {
    /// This item.
    Hold(Orphan),
    /// The item that was held with this epoch has another writer, or is gone.
    Release(Epoch),
}

/// What the segment does not say.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Label {
    version: u32,
    pub(super) name: ItemName,
    pub(super) schema: String,
    pub(super) program: String,
    pub(super) writer: WriterState,
}

impl Orphan {
    /// Reads back what [`Orphan::files`] gave for `epoch`, in any order. Judges the label here; the segment is judged by
    /// the server that it is given to.
    pub fn from_files(epoch: Epoch, files: Vec<OwnedFd>) -> Result<Self, Refusal> {
        let [mut label, mut data, mut ctl] = [None, None, None];
        for file in files {
            let seals = rustix::fs::fcntl_get_seals(&file)
                .map_err(|_| Refusal::Segment("not a file that can be sealed".to_owned()))?;
            let place = if seals.contains(SealFlags::WRITE) {
                &mut label
            } else if seals.contains(SealFlags::FUTURE_WRITE) {
                &mut data
            } else {
                &mut ctl
            };
            *place = Some(file);
        }
        let (Some(label), Some(data), Some(ctl)) = (label, data, ctl) else {
            return Err(Refusal::Segment(
                "not a label, data and ctl, each with its seals".to_owned(),
            ));
        };
        Ok(Self {
            epoch,
            label: Label::from_file(label)?,
            data: Arc::new(data),
            ctl: Arc::new(ctl),
        })
    }

    /// The files to keep. Fails when the system gives no memory or descriptors.
    pub fn files(&self) -> Result<[Arc<OwnedFd>; 3], Error> {
        let label = Arc::new(self.label.to_file()?);
        Ok([label, Arc::clone(&self.data), Arc::clone(&self.ctl)])
    }

    /// The item.
    pub fn name(&self) -> &ItemName {
        &self.label.name
    }

    /// The epoch of its last writer: no other orphan of this host has it.
    pub fn epoch(&self) -> Epoch {
        self.epoch
    }
}

impl fmt::Display for Keep {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Hold(orphan) => write!(f, "hold `{}`", orphan.name()),
            Self::Release(epoch) => write!(f, "release epoch {}", epoch.0),
        }
    }
}

impl Label {
    pub(super) fn new(name: ItemName, schema: &str, program: &str, writer: WriterState) -> Self {
        Self {
            version: VERSION,
            name,
            schema: schema.to_owned(),
            program: program.to_owned(),
            writer,
        }
    }

    fn to_file(&self) -> Result<OwnedFd, Error> {
        let mut bytes = Vec::new();
        codec::encode(self, &mut bytes).map_err(|e| Error::Protocol(e.to_string()))?;
        let flags = MemfdFlags::CLOEXEC | MemfdFlags::ALLOW_SEALING;
        let fd =
            rustix::fs::memfd_create(c"ddx-label", flags).map_err(Error::os("make a label"))?;
        let mut file = File::from(fd);
        file.write_all(&bytes).map_err(Error::os("write a label"))?;
        rustix::fs::fcntl_add_seals(&file, SEALS | SealFlags::SEAL)
            .map_err(Error::os("seal a label"))?;
        Ok(file.into())
    }

    fn from_file(file: OwnedFd) -> Result<Self, Refusal> {
        let bad = |fault: String| Refusal::Segment(format!("label refused: {fault}"));
        let seals = rustix::fs::fcntl_get_seals(file.as_fd()).map_err(|e| bad(e.to_string()))?;
        if !seals.contains(SEALS) {
            return Err(bad("not sealed as it must be".to_owned()));
        }
        let file = File::from(file);
        let len = file.metadata().map_err(|e| bad(e.to_string()))?.len();
        let len = usize::try_from(len).unwrap_or(usize::MAX);
        if len > MESSAGE_MAX_BYTES {
            return Err(bad(format!("{len} bytes, {MESSAGE_MAX_BYTES} allowed")));
        }
        let mut bytes = vec![0; len];
        file.read_exact_at(&mut bytes, 0)
            .map_err(|e| bad(e.to_string()))?;
        let label: Self = codec::decode(&bytes).map_err(|e| bad(e.to_string()))?;
        if label.version != VERSION {
            return Err(bad(format!(
                "version {} instead of {VERSION}",
                label.version
            )));
        }
        Ok(label)
    }
}

/// Version of the label; another one is refused.
const VERSION: u32 = 1;

/// What a label is protected by: it can be read once and be believed to stay so.
const SEALS: SealFlags = SealFlags::WRITE
    .union(SealFlags::SHRINK)
    .union(SealFlags::GROW);
