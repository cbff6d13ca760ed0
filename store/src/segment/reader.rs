//! A reader's side of a segment: pins, copies, and showing itself as waiting.

use std::ptr::NonNull;
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering::Acquire, Ordering::Release};

use ddx_wire::Epoch;
use thiserror::Error;

use super::control::map_both;
use super::{Bell, HeapSegment, ReaderBooks, Seat, SegmentError, SegmentFds, Stamp, State};
use crate::layout::{self, MAX_PINS, Spec};
use crate::ring::{Miss, RingReader, STAMP_WORDS, Words, glance, load_stamp};
use crate::shm::{Map, fork};
use crate::sync::Ordering;

/// One seated reader of a segment. Cheap to clone; the clones share the seat and its pins.
///
/// The cell is free for another reader only once every clone and every [`Pin`] is gone, so whoever grants cells is
/// told then, not before.
#[derive(Clone, Debug)]
pub struct SegmentReader {
    seated: Arc<Seated>,
}

#[derive(Debug)]
struct Seated {
    ring: RingReader<Arc<Map>>,
    /// A bit for each pin in use by this process.
    taken: AtomicU32,
    pins: u32,
    generation: u64,
}

/// A sample held in place. The writer leaves its slot alone until this is dropped, unless it is forced by lies in
/// `ctl`, which [`SegmentReader::still_intact`] detects.
#[derive(Debug)]
pub struct Pin {
    seated: Arc<Seated>,
    pin: u32,
    slot: u16,
    stamp: Stamp,
}

/// Copies samples for one call of a reader: small ones without a pin, as long as not several of these copies were overtaken
/// by the writer, which a pin then prevents; large ones always with a pin.
#[derive(Debug)]
pub struct Copier<'a> {
    payload: &'a mut Vec<u8>,
    pos: u64,
    len: usize,
    words: [u64; STAMP_WORDS],
    /// Copies without a pin that are still to be tried.
    glances: u32,
}

/// Why a position cannot be read.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Error)]
#[non_exhaustive]
pub enum PinError {
    /// Newer samples have taken its place in the ring.
    #[error("the sample was overwritten")]
    Overwritten,
    /// It has not been published.
    #[error("the sample is not published yet")]
    NotYet,
    /// The reader holds as many samples as it was granted.
    #[error("every pin of this reader is in use; drop a guard or open it with more pins")]
    NoPin,
    /// The writer's words contradict one another.
    #[error("the segment is corrupt: its writer has broken the protocol")]
    Corrupt,
    /// The handle was made before this process was forked.
    #[error("the reader belongs to the process that was forked; open the item anew")]
    Forked,
}

impl SegmentReader {
    /// Maps a segment that its writer has made, and takes the seat. Refuses files that are not sealed, headers that
    /// do not fit their files, and a seat outside the segment.
    pub fn map(fds: &SegmentFds, seat: Seat) -> Result<Self, SegmentError> {
        let (data, ctl) = map_both(&fds.data, &fds.ctl)?;
        Self::over(Arc::new(data), Arc::new(ctl), seat)
    }

    /// Takes a seat in a segment on the heap.
    pub fn heap(segment: &HeapSegment, seat: Seat) -> Result<Self, SegmentError> {
        Self::over(Arc::clone(&segment.data), Arc::clone(&segment.ctl), seat)
    }

    fn over(data: Arc<Map>, ctl: Arc<Map>, seat: Seat) -> Result<Self, SegmentError> {
        let shape = super::control::shape(&data, &ctl)?;
        if seat.cell >= shape.spec().cells || !(1..=MAX_PINS).contains(&seat.pins) {
            return Err(SegmentError::Seat {
                cell: seat.cell,
                pins: seat.pins,
            });
        }
        let ring = RingReader::new(data, ctl, shape, seat.cell, seat.pins, seat.bell);
        Ok(Self {
            seated: Arc::new(Seated {
                ring,
                taken: AtomicU32::new(0),
                pins: seat.pins,
                generation: fork::generation(),
            }),
        })
    }

    /// Position of the newest sample; 0 before the first, and in a forked process.
    #[inline]
    pub fn head_pos(&self) -> u64 {
        if self.seated.is_forked() {
            return 0;
        }
        self.seated.ring.head()
    }

    /// Samples the ring holds.
    pub fn depth(&self) -> u64 {
        self.seated.ring.shape().depth()
    }

    /// The sizes the writer has made it with.
    pub fn spec(&self) -> Spec {
        self.seated.ring.shape().spec()
    }

    /// Epoch of the segment.
    #[inline]
    pub fn epoch(&self) -> Epoch {
        Epoch(self.seated.ring.shape().epoch())
    }

    /// Samples that may be held at one time.
    pub fn pins(&self) -> u32 {
        self.seated.pins
    }

    /// Holds the sample at `pos` in place.
    pub fn pin(&self, pos: u64) -> Result<Pin, PinError> {
        let pin = self.seated.take()?;
        match self.seated.hold(pin, pos) {
            Ok((slot, len, words)) => Ok(Pin {
                seated: Arc::clone(&self.seated),
                pin,
                slot,
                stamp: Stamp::from_words(pos, len, &words),
            }),
            Err(error) => {
                self.seated.release(pin);
                Err(error)
            }
        }
    }

    /// Holds the newest sample; [`PinError::NotYet`] before the first. Tries again while the writer overtakes it.
    pub fn pin_newest(&self) -> Result<Pin, PinError> {
        self.newest(|pos| self.pin(pos))
    }

    /// Copies the sample at `pos`, replacing the content of `payload`, which allocates only to grow. On an error
    /// the content is unspecified.
    pub fn copy(&self, pos: u64, payload: &mut Vec<u8>) -> Result<Stamp, PinError> {
        let mut copier = Copier::new(payload);
        copier.copy(self, pos)?;
        Ok(copier.stamp())
    }

    /// Copies the newest sample; [`PinError::NotYet`] before the first. Tries again while the writer overtakes it.
    pub fn copy_newest(&self, payload: &mut Vec<u8>) -> Result<Stamp, PinError> {
        let mut copier = Copier::new(payload);
        copier.copy_newest(self)?;
        Ok(copier.stamp())
    }

    /// Reads the newest sample; tries again while the writer overtakes it.
    pub(crate) fn newest<T>(
        &self,
        mut read: impl FnMut(u64) -> Result<T, PinError>,
    ) -> Result<T, PinError> {
        // A ring of depth 1 under a writer at full speed overtakes a reader a few times in a row, never this often.
        const TRIES: u32 = 1000;
        for _ in 0..TRIES {
            if self.seated.is_forked() {
                return Err(PinError::Forked);
            }
            let head = self.seated.ring.head();
            match read(head) {
                Err(PinError::Overwritten) => std::hint::spin_loop(),
                other => return other,
            }
            // In a ring of depth 1 the next sample has its place before it is the newest; a writer that was killed
            // there leaves it so.
            if let Ok(next) = read(head.saturating_add(1)) {
                return Ok(next);
            }
        }
        Err(PinError::Overwritten)
    }

    /// True while the pinned bytes are those of its sample. Asked after the bytes were used, it vouches for them.
    pub fn still_intact(&self, pin: &Pin) -> bool {
        pin.is_intact()
    }

    /// What became of the segment.
    #[inline]
    pub fn state(&self) -> State {
        if self.seated.is_forked() {
            return State::default();
        }
        let ctl = self.seated.ring.ctl();
        State::from_word(ctl.load(layout::STATE, Ordering::Relaxed))
    }

    /// Shows this reader as waiting, or no longer. To be followed by [`crate::notify::Bells::arm`] and a last look
    /// at [`SegmentReader::head_pos`] and [`SegmentReader::state`] before sleeping.
    pub fn set_waiting(&self, waiting: bool) {
        if !self.seated.is_forked() {
            self.seated.ring.set_waiting(waiting);
        }
    }

    /// Shows the daemon what this reader has read.
    #[inline]
    pub fn set_books(&self, books: &ReaderBooks) {
        if !self.seated.is_forked() {
            self.seated.ring.set_books(&books.to_words());
        }
    }

    /// Changes what the writer rings, as after a restart of the daemon.
    pub fn set_bell(&self, bell: Bell) {
        if !self.seated.is_forked() {
            self.seated.ring.set_bell(bell);
        }
    }
}

impl<'a> Copier<'a> {
    /// Replaces the content of `payload` by each copy; it allocates only to grow.
    #[inline]
    pub fn new(payload: &'a mut Vec<u8>) -> Self {
        Self {
            payload,
            pos: 0,
            len: 0,
            words: [0; STAMP_WORDS],
            glances: GLANCES,
        }
    }

    /// Copies the sample at `pos`. On an error the content of the payload is unspecified.
    #[inline]
    pub fn copy(&mut self, segment: &SegmentReader, pos: u64) -> Result<(), PinError> {
        let seated = &segment.seated;
        if self.glances == 0 {
            return self.copy_pinned(seated, pos);
        }
        match self.glance(seated, pos) {
            Ok(true) => Ok(()),
            Ok(false) => self.copy_pinned(seated, pos),
            Err(error) => {
                self.glances -= u32::from(error == PinError::Overwritten);
                Err(error)
            }
        }
    }

    /// Copies the sample at `pos` if it is small enough to be copied without a pin; whether it was.
    #[inline]
    pub fn copy_small(&mut self, segment: &SegmentReader, pos: u64) -> Result<bool, PinError> {
        self.glance(&segment.seated, pos)
    }

    /// Copies the newest sample like [`SegmentReader::copy_newest`].
    #[inline]
    pub fn copy_newest(&mut self, segment: &SegmentReader) -> Result<(), PinError> {
        match self.glance(&segment.seated, segment.head_pos()) {
            Ok(true) => Ok(()),
            Ok(false) | Err(_) => self.copy_newest_patiently(segment),
        }
    }

    /// What is stored beside the payload of the last copy. Made here rather than by the copy, because it costs as much to
    /// move as to make.
    #[inline]
    pub fn stamp(&self) -> Stamp {
        Stamp::from_words(self.pos, self.len, &self.words)
    }

    /// The bytes of the last copy.
    #[inline]
    pub fn payload(&self) -> &[u8] {
        self.payload
    }

    #[cold]
    fn copy_newest_patiently(&mut self, segment: &SegmentReader) -> Result<(), PinError> {
        segment.newest(|pos| self.copy(segment, pos))
    }

    /// Copies without a pin; false when the sample is too large for that.
    #[inline(always)]
    fn glance(&mut self, seated: &Seated, pos: u64) -> Result<bool, PinError> {
        if seated.is_forked() {
            return Err(PinError::Forked);
        }
        let (data, shape) = (seated.ring.data(), seated.ring.shape());
        if !data.is_shared() {
            return Ok(false);
        }
        let most = GLANCED_BYTES.min(shape.capacity());
        self.pos = pos;
        let copied = glance(data, shape, pos, |slot| {
            self.words = load_stamp(data, shape, slot);
            let len = usize::try_from(self.words[0]).unwrap_or(usize::MAX);
            if len > most {
                return false;
            }
            self.len = len;
            data.copy_words_out(shape.payload_offset(slot), len, self.payload);
            true
        })?;
        Ok(copied)
    }

    #[inline(never)]
    fn copy_pinned(&mut self, seated: &Seated, pos: u64) -> Result<(), PinError> {
        match seated.take() {
            Ok(pin) => {
                let copied = self.copy_with(seated, pin, pos);
                seated.release(pin);
                copied
            }
            // Guards hold them all: what can do without a pin goes on without.
            Err(PinError::NoPin) => match self.glance(seated, pos)? {
                true => Ok(()),
                false => Err(PinError::NoPin),
            },
            Err(error) => Err(error),
        }
    }

    fn copy_with(&mut self, seated: &Seated, pin: u32, pos: u64) -> Result<(), PinError> {
        let (slot, len, words) = seated.hold(pin, pos)?;
        seated.copy_out(slot, len, self.payload);
        if !seated.ring.intact(slot, pos) {
            return Err(PinError::Overwritten);
        }
        (self.pos, self.len, self.words) = (pos, len, words);
        Ok(())
    }
}

impl Seated {
    #[inline]
    fn is_forked(&self) -> bool {
        fork::is_past(self.generation)
    }

    /// Finds an unused pin of the seat.
    fn take(&self) -> Result<u32, PinError> {
        if self.is_forked() {
            return Err(PinError::Forked);
        }
        // Acquire: pairs with the Release in `release`, so that one word's stores by two threads stay in order.
        let mut taken = self.taken.load(Acquire);
        loop {
            let pin = taken.trailing_ones();
            if pin >= self.pins {
                return Err(PinError::NoPin);
            }
            match self
                .taken
                .compare_exchange_weak(taken, taken | 1 << pin, Acquire, Acquire)
            {
                Ok(_) => return Ok(pin),
                Err(now) => taken = now,
            }
        }
    }

    /// Clears the pin word and lets the next caller have it.
    fn release(&self, pin: u32) {
        if self.is_forked() {
            return;
        }
        self.ring.unpin(pin);
        // Release: pairs with the Acquire in `take`.
        self.taken.fetch_and(!(1 << pin), Release);
    }

    /// Pins `pos` and copies out what is stored beside its payload, of which the length is judged.
    fn hold(&self, pin: u32, pos: u64) -> Result<(u16, usize, [u64; STAMP_WORDS]), PinError> {
        let slot = self.ring.pin(pin, pos)?;
        let words = self.ring.stamp(slot);
        if !self.ring.intact(slot, pos) {
            return Err(PinError::Overwritten);
        }
        let len = usize::try_from(words[0])
            .ok()
            .filter(|len| *len <= self.ring.shape().capacity())
            .ok_or(PinError::Corrupt)?;
        Ok((slot, len, words))
    }

    fn payload(&self, slot: u16, len: usize) -> NonNull<u8> {
        let offset = self.ring.shape().payload_offset(slot);
        self.ring.data().bytes(offset, len)
    }

    fn copy_out(&self, slot: u16, len: usize, payload: &mut Vec<u8>) {
        let offset = self.ring.shape().payload_offset(slot);
        self.ring.data().copy_out(offset, len, payload);
    }
}

impl From<Miss> for PinError {
    fn from(miss: Miss) -> Self {
        match miss {
            Miss::Overwritten => Self::Overwritten,
            Miss::NotYet => Self::NotYet,
            Miss::Corrupt => Self::Corrupt,
        }
    }
}

impl Drop for Seated {
    fn drop(&mut self) {
        if !self.is_forked() {
            self.ring.leave();
        }
    }
}

impl Pin {
    /// What is stored beside the payload, as it was copied out when the pin was taken.
    pub fn stamp(&self) -> &Stamp {
        &self.stamp
    }

    /// Where the payload begins, aligned to 128 bytes, inside a mapping that lives as long as the pin; there are
    /// `stamp().len` bytes of it. Dangling after a fork.
    pub fn as_ptr(&self) -> *const u8 {
        self.seated.payload(self.slot, self.stamp.len).as_ptr()
    }

    /// The payload in place; empty after a fork.
    ///
    /// This trusts the writer of the item: one that breaks the protocol, or is forced by a co-reader's lies, can
    /// change the bytes under the slice. [`Pin::is_intact`] tells afterwards whether that happened.
    #[expect(
        unsafe_code,
        reason = "the one place that forms a reference to a pinned payload"
    )]
    pub fn bytes(&self) -> &[u8] {
        if self.seated.is_forked() {
            return &[];
        }
        // SAFETY: `Map::bytes` has checked that the range is inside the mapping, which `seated` keeps alive; all of it
        // is initialised, because mappings begin as zeros. Nobody writes a pinned slot as long as its writer keeps to
        // the protocol; bytes are valid under every pattern. A hostile writer is the exception that the design states.
        unsafe { std::slice::from_raw_parts(self.as_ptr(), self.stamp.len) }
    }

    /// Copies the payload, replacing the content of `payload`; then false if it was overwritten meanwhile.
    pub fn copy_to(&self, payload: &mut Vec<u8>) -> bool {
        if self.seated.is_forked() {
            return false;
        }
        self.seated.copy_out(self.slot, self.stamp.len, payload);
        self.is_intact()
    }

    /// True while the bytes are those of this sample. Asked after they were used, it vouches for them.
    pub fn is_intact(&self) -> bool {
        !self.seated.is_forked() && self.seated.ring.intact(self.slot, self.stamp.pos)
    }
}

impl Drop for Pin {
    fn drop(&mut self) {
        self.seated.release(self.pin);
    }
}

/// Copies without a pin that one call tries. Each takes a fraction of the time in which a writer comes round to the same slot
/// at full speed, so a second one already means that the reader was interrupted in the first.
const GLANCES: u32 = 4;

/// Largest payload that is copied without a pin, bytes. Words one by one are slower than a block: from here on they would cost
/// more than the pin does.
const GLANCED_BYTES: usize = 1024;
