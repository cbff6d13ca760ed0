//! The writer's side of a segment: loans, publishing, counters.

use std::sync::Arc;

use ddx_wire::Epoch;
use thiserror::Error;

use super::{HeapSegment, Origin, ReaderBooks, SegmentError, SegmentFds, State};
use crate::layout::{self, Header, Shape, Spec};
use crate::notify::Bells;
use crate::ring::{RingWriter, Words, cell_books};
use crate::shm::{Map, fork, heap, memfd};
use crate::sync::Ordering;

/// An item's only writer. Nothing it does blocks, allocates or, with no reader waiting, enters the kernel.
#[derive(Debug)]
pub struct SegmentWriter {
    ring: RingWriter<Arc<Map>>,
    bells: Option<Arc<Bells>>,
    generation: u64,
}

/// Memory for the next sample, taken by [`SegmentWriter::loan`] and given back by publishing or discarding it. A
/// slot that is merely dropped is lost to its segment.
#[derive(Debug, PartialEq, Eq)]
#[must_use = "a slot that is dropped is lost to its segment: publish or discard it"]
pub struct Slot {
    index: u16,
    len: u32,
}

/// Why there is no memory for a sample.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Error)]
#[non_exhaustive]
pub enum LoanError {
    /// The payload does not fit.
    #[error("a payload of {len} bytes exceeds the item's capacity of {capacity}")]
    TooLong {
        /// Bytes asked for.
        len: usize,
        /// Bytes that a sample may have.
        capacity: usize,
    },
    /// All slots outside the ring are on loan.
    #[error("every slot is on loan; publish or discard one first")]
    NoSlot,
    /// The handle was made before this process was forked.
    #[error("the writer belongs to the process that was forked; open the item anew")]
    Forked,
}

impl SegmentWriter {
    /// Makes a segment of two sealed memfds and returns what to hand to the daemon. Fails when a figure is outside
    /// its limits or the system gives no memory or descriptors.
    pub fn create(spec: Spec, epoch: Epoch) -> Result<(Self, SegmentFds), SegmentError> {
        let shape = spec.shape(epoch.0)?;
        let (data, data_fd) = memfd::create(c"ddx-data", shape.data_len())?;
        let (ctl, ctl_fd) = memfd::create(c"ddx-ctl", shape.ctl_len())?;
        let writer = Self::over(shape, Arc::new(data), Arc::new(ctl));
        // Sealed only now: the mapping made above is the last that can write samples.
        memfd::seal(&data_fd, memfd::DATA_SEALS)?;
        memfd::seal(&ctl_fd, memfd::CTL_SEALS)?;
        let fds = SegmentFds {
            data: data_fd,
            ctl: ctl_fd,
        };
        Ok((writer, fds))
    }

    /// Makes the same segment on the heap.
    pub fn heap(spec: Spec, epoch: Epoch) -> Result<(Self, HeapSegment), SegmentError> {
        let shape = spec.shape(epoch.0)?;
        let data = Arc::new(heap::create(shape.data_len())?);
        let ctl = Arc::new(heap::create(shape.ctl_len())?);
        let writer = Self::over(shape, Arc::clone(&data), Arc::clone(&ctl));
        Ok((writer, HeapSegment { data, ctl }))
    }

    fn over(shape: Shape, data: Arc<Map>, ctl: Arc<Map>) -> Self {
        for (at, word) in Header::of(&shape).0.into_iter().enumerate() {
            // Handing over a descriptor, or starting a thread, is what orders this before any reader.
            data.store(at, word, Ordering::Relaxed);
        }
        Self {
            ring: RingWriter::new(data, ctl, shape),
            bells: None,
            generation: fork::generation(),
        }
    }

    /// Sets the bells that [`SegmentWriter::publish`] rings; without them waiting readers notice at the end of
    /// their slice.
    pub fn set_bells(&mut self, bells: Option<Arc<Bells>>) {
        self.bells = bells;
    }

    /// Takes memory for a payload of `len` bytes, with unspecified content. Never blocks: when readers hold more than
    /// they were granted, the oldest sample among those is overwritten, which its holder can tell, and counted.
    #[inline(always)]
    pub fn loan(&mut self, len: usize) -> Result<Slot, LoanError> {
        if fork::is_past(self.generation) {
            return Err(LoanError::Forked);
        }
        let capacity = self.ring.shape().capacity();
        let short = u32::try_from(len).ok().filter(|_| len <= capacity);
        let len = short.ok_or(LoanError::TooLong { len, capacity })?;
        let index = self.ring.loan().ok_or(LoanError::NoSlot)?;
        Ok(Slot { index, len })
    }

    /// The payload of a slot, as far as it was filled.
    #[expect(unsafe_code, reason = "the payload of a loan is read in place")]
    pub fn slot_bytes<'a>(&'a self, slot: &'a Slot) -> &'a [u8] {
        if fork::is_past(self.generation) {
            return &[];
        }
        let offset = self.ring.shape().payload_offset(slot.index);
        let bytes = self.ring.data().bytes(offset, slot.size());
        // SAFETY: as for `slot_bytes_mut`; both borrows are shared, so nobody in this process writes the slot.
        unsafe { std::slice::from_raw_parts(bytes.as_ptr(), slot.size()) }
    }

    /// The payload of a slot, to be filled in place.
    #[inline]
    #[expect(unsafe_code, reason = "the payload of a loan is written in place")]
    pub fn slot_bytes_mut<'a>(&'a mut self, slot: &'a mut Slot) -> &'a mut [u8] {
        if fork::is_past(self.generation) {
            return &mut [];
        }
        let offset = self.ring.shape().payload_offset(slot.index);
        let bytes = self.ring.data().bytes(offset, slot.size());
        // SAFETY: `Map::bytes` has checked that the range is inside the mapping, which this handle keeps alive. Only
        // this writer's mapping can change `data`; the slot is on loan, so no other slice of it exists in this
        // process, and the borrow of `slot` keeps it so. A reader looks at a loaned slot only when it holds it beyond
        // its quota or lies about its pins, and then through raw pointers in another mapping. All bytes are
        // initialised: both kinds of mapping begin as zeros.
        unsafe { std::slice::from_raw_parts_mut(bytes.as_ptr(), slot.size()) }
    }

    /// Makes the slot the item's newest sample and wakes those who wait for it. Returns its position. Enters the
    /// kernel only to wake a sleeping reader.
    #[inline(always)]
    pub fn publish(&mut self, slot: Slot, origin: &Origin) -> u64 {
        if fork::is_past(self.generation) {
            return self.ring.published();
        }
        let stamp = origin.to_words(u64::from(slot.len));
        let published = self.ring.publish(slot.into_index(), &stamp);
        if published.waiting != 0
            && let Some(bells) = &self.bells
        {
            self.ring
                .waiting_bells(published.waiting, |bell| bells.ring(bell));
        }
        published.pos
    }

    /// Gives a slot back unpublished.
    pub fn discard(&mut self, slot: Slot) {
        self.ring.discard(slot.into_index());
    }

    /// Samples published so far, which is also the newest position.
    pub fn published(&self) -> u64 {
        self.ring.published()
    }

    /// Samples overwritten while a reader held them beyond its quota. Growth means that a reader lies or died unseen.
    pub fn forced(&self) -> u64 {
        self.ring.forced()
    }

    /// Readers that have taken their seats, by their own word.
    pub fn readers(&self) -> u32 {
        self.open_cells().count_ones()
    }

    /// Whether each of them says that it has read the newest sample.
    pub fn is_consumed(&self) -> bool {
        let (open, newest) = (self.open_cells(), self.ring.published());
        let cells = (0..self.spec().cells).filter(|cell| open >> cell & 1 == 1);
        let mut books = cells.map(|cell| cell_books(self.ring.ctl(), self.ring.shape(), cell));
        books.all(|words| ReaderBooks::from_words(&words).is_some_and(|books| books.pos >= newest))
    }

    fn open_cells(&self) -> u64 {
        if fork::is_past(self.generation) {
            return 0;
        }
        self.ring.ctl().load(layout::OPEN, Ordering::Relaxed)
    }

    /// What became of the segment; a superseded writer has lost its lease.
    pub fn state(&self) -> State {
        if fork::is_past(self.generation) {
            return State::default();
        }
        State::from_word(self.ring.ctl().load(layout::STATE, Ordering::Relaxed))
    }

    /// The sizes it was made with.
    pub fn spec(&self) -> Spec {
        self.ring.shape().spec()
    }

    /// Epoch of the segment.
    #[inline]
    pub fn epoch(&self) -> Epoch {
        Epoch(self.ring.shape().epoch())
    }
}

impl Slot {
    /// Bytes of the payload.
    #[inline]
    pub fn size(&self) -> usize {
        usize::try_from(self.len).unwrap_or(usize::MAX)
    }

    #[inline]
    fn into_index(self) -> u16 {
        self.index
    }
}
