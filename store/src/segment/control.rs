//! The daemon's side of a segment: judging what a writer sent, telling its readers what became of it, and clearing
//! up after dead ones.

use std::os::fd::OwnedFd;
use std::sync::Arc;

use ddx_wire::Epoch;

use super::{HeapSegment, ReaderBooks, SegmentError, Stamp, State};
use crate::layout::{self, Header, MAX_PINS, Shape, Spec};
use crate::notify::Bells;
use crate::ring::{
    Words, cell_books, load_stamp, peek, slot_is_intact, waiting_bells, waiting_now,
};
use crate::shm::{Map, ShmError, memfd};
use crate::sync::Ordering;

/// A segment as the daemon maps it. It never writes samples.
#[derive(Debug)]
pub struct SegmentControl {
    data: Arc<Map>,
    ctl: Arc<Map>,
    shape: Shape,
}

impl SegmentControl {
    /// Maps and judges a segment that a writer has sent: seals, sizes, header.
    pub fn map(data: &OwnedFd, ctl: &OwnedFd) -> Result<Self, SegmentError> {
        let (data, ctl) = map_both(data, ctl)?;
        Self::over(Arc::new(data), Arc::new(ctl))
    }

    /// The same for a segment on the heap.
    pub fn heap(segment: &HeapSegment) -> Result<Self, SegmentError> {
        Self::over(Arc::clone(&segment.data), Arc::clone(&segment.ctl))
    }

    fn over(data: Arc<Map>, ctl: Arc<Map>) -> Result<Self, SegmentError> {
        let shape = shape(&data, &ctl)?;
        Ok(Self { data, ctl, shape })
    }

    /// The sizes the writer has made it with.
    pub fn spec(&self) -> Spec {
        self.shape.spec()
    }

    /// Epoch of the segment.
    pub fn epoch(&self) -> Epoch {
        Epoch(self.shape.epoch())
    }

    /// Bytes of address space of both files.
    pub fn size_bytes(&self) -> usize {
        self.shape.data_len().saturating_add(self.shape.ctl_len())
    }

    /// Position of the newest sample; 0 before the first.
    pub fn head_pos(&self) -> u64 {
        crate::ring::head(&*self.data)
    }

    /// What is stored beside the newest sample. `None` before the first, or when a living writer overtook the look.
    pub fn newest(&self) -> Option<Stamp> {
        let (slot, stamp) = self.peek()?;
        slot_is_intact(&*self.data, &self.shape, slot, stamp.pos).then_some(stamp)
    }

    /// What the reader in a cell says that it has read; `None` when it is just saying something else.
    pub fn reader_books(&self, cell: u32) -> Option<ReaderBooks> {
        // A reader at full speed changes its books between two looks, but not between all of them.
        const TRIES: u32 = 10;
        if cell >= self.shape.spec().cells {
            return None;
        }
        (0..TRIES).find_map(|_| ReaderBooks::from_words(&cell_books(&*self.ctl, &self.shape, cell)))
    }

    /// A bit for each cell whose reader has taken its seat, by the readers' own word.
    pub fn open_cells(&self) -> u64 {
        self.ctl.load(layout::OPEN, Ordering::Relaxed)
    }

    /// What became of the segment.
    pub fn state(&self) -> State {
        State::from_word(self.ctl.load(layout::STATE, Ordering::Relaxed))
    }

    /// Adds what is set in `state`, and wakes all who wait.
    pub fn set_state(&self, state: State, bells: &Bells) {
        self.ctl
            .fetch_or(layout::STATE, state.to_word(), Ordering::Relaxed);
        self.ring_waiting(bells);
    }

    /// Takes away what is set in `state`; nobody waits for that.
    pub fn clear_state(&self, state: State) {
        self.ctl
            .fetch_and(layout::STATE, !state.to_word(), Ordering::Relaxed);
    }

    /// Wakes all who wait for this item.
    pub fn ring_waiting(&self, bells: &Bells) {
        let waiting = waiting_now(&*self.ctl);
        waiting_bells(&*self.ctl, &self.shape, waiting, |bell| bells.ring(bell));
    }

    /// Frees the cell of a reader that is gone, with its pins.
    ///
    /// The caller knows that the reader's process is dead or has let go of every pin: pins cleared under a living
    /// guard let the writer overwrite what it holds (which the guard can tell).
    pub fn clear_cell(&self, cell: u32) {
        if cell >= self.shape.spec().cells {
            return;
        }
        crate::ring::clear_cell(&*self.ctl, &self.shape, cell);
    }

    /// Copies the newest sample without a pin, as from a segment whose writer is gone. `None` when there is none, or
    /// when a writer that does live overtook every try.
    pub fn copy_newest(&self, payload: &mut Vec<u8>) -> Option<Stamp> {
        // The segment of a dead writer is at rest: the first try succeeds.
        const TRIES: u32 = 100;
        (0..TRIES).find_map(|_| {
            let (slot, stamp) = self.peek()?;
            let offset = self.shape.payload_offset(slot);
            self.data.copy_out(offset, stamp.len, payload);
            slot_is_intact(&*self.data, &self.shape, slot, stamp.pos).then_some(stamp)
        })
    }

    /// The newest sample's slot and stamp, which are to be asked whether they are intact.
    fn peek(&self) -> Option<(u16, Stamp)> {
        let head = self.head_pos();
        // In a ring of depth 1 the next sample has its place before it is the newest; a writer that was killed there
        // leaves it so.
        let (slot, pos) = [head, head.saturating_add(1)]
            .into_iter()
            .find_map(|pos| Some((peek(&*self.data, &self.shape, pos).ok()?, pos)))?;
        let words = load_stamp(&*self.data, &self.shape, slot);
        let len = usize::try_from(words[0]).ok()?;
        (len <= self.shape.capacity()).then(|| (slot, Stamp::from_words(pos, len, &words)))
    }
}

/// Maps both files of a segment as everybody but its writer does.
pub(super) fn map_both(data: &OwnedFd, ctl: &OwnedFd) -> Result<(Map, Map), ShmError> {
    use memfd::{Access, CTL_SEALS, DATA_SEALS, map};
    let data = map(data, "data", DATA_SEALS, Access::ReadOnly)?;
    let ctl = map(ctl, "ctl", CTL_SEALS, Access::ReadWrite)?;
    Ok((data, ctl))
}

/// Copies the header out once and judges it against the mapped sizes.
pub(super) fn shape(data: &Map, ctl: &Map) -> Result<Shape, SegmentError> {
    if data.len() < Header::WORDS * layout::WORD {
        return Err(ShmError::Size {
            what: "data",
            found: data.len(),
        }
        .into());
    }
    let header = Header(std::array::from_fn(|at| data.load(at, Ordering::Relaxed)));
    Ok(header.check(data.len(), ctl.len())?)
}

const _: () = assert!(MAX_PINS < 32, "a seat keeps its pins in the bits of a u32");
