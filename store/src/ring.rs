//! The protocol by which one writer and many readers share slots without locks.
//!
//! The writer fills a slot, names it in the ring at `pos % depth`, and moves the head. A reader marks a pin with the
//! slot that the ring names, and looks again: if the ring still names it, no writer takes the slot until the pin is
//! cleared. A slot that newer samples have pushed out of the ring is *retired*; when the writer needs slots, it scans
//! the pins once for all retired ones and takes back those that nobody holds.
//!
//! Why a pinned slot is never rewritten: the writer pushes the slot out of the ring, then fences (in the same
//! [`RingWriter::publish`]), and scans the pins at some later loan; the reader pins, fences, and then looks at the
//! ring. Of two full fences one comes first. If the reader's does, the scan sees the pin; if the writer's does, the
//! reader sees the slot gone.
//!
//! Who only copies a few bytes needs no pin, and looks at the slot's header instead: its position is voided before the slot
//! is written again, so a copy after which the position is still there is whole ([`glance`]). A writer can overtake such a
//! copy, but not a pin.
//!
//! The pins of readers that keep their quota cannot exhaust the slots ([`crate::layout::SPARE`]). If they do, somebody
//! lies, and the writer takes the oldest retired slot all the same. A pinned read finds that out by the header too.
//!
//! Generic over [`Words`], so that the same code runs over mapped memory, the heap, and loom.

use std::collections::VecDeque;
use std::sync::Arc;

use crate::crash;
use crate::layout::{self, LINE_WORDS, MAX_PINS, Shape};
use crate::notify::Bell;
use crate::sync::{Ordering, Site, fence, order};

/// Words beside a slot's position: length, epoch, sequence, filtered, capture, publish, receive, bound, overwritten.
pub const STAMP_WORDS: usize = 9;
/// Words of a reader's books in its cell; all zeros before it has read anything.
pub const BOOK_WORDS: usize = 7;

/// Retired slots that are gathered before pins are scanned for them, where fresh slots allow. A scan touches a line
/// or two for each open cell; eight writes share it, and the slots in use still fit the cache.
const BATCH: usize = 8;

/// The number of a cell's pins stands above its bell in one word.
const SEAT_PINS_SHIFT: u32 = 32;

const SLOT_BITS: u32 = 16;
const SLOT_MASK: u64 = 0xffff;
/// A ring entry that names no slot; also more than the number of slots can be.
const NO_SLOT: u16 = u16::MAX;

/// Atomic words at fixed places: the memory that the protocol runs on. Places come from a checked [`Shape`].
pub trait Words {
    /// Loads the word at `at`.
    fn load(&self, at: usize, order: Ordering) -> u64;
    /// Stores the word at `at`.
    fn store(&self, at: usize, value: u64, order: Ordering);
    /// Adds to the word at `at`, wrapping, and returns what it was.
    fn fetch_add(&self, at: usize, value: u64, order: Ordering) -> u64;
    /// Clears the bits of the word at `at` that are 0 in `value` and returns what it was.
    fn fetch_and(&self, at: usize, value: u64, order: Ordering) -> u64;
    /// Sets bits of the word at `at` and returns what it was.
    fn fetch_or(&self, at: usize, value: u64, order: Ordering) -> u64;
    /// Loads neighbouring words from `first` on, relaxed.
    fn load_run<const N: usize>(&self, first: usize) -> [u64; N] {
        std::array::from_fn(|at| self.load(first + at, Ordering::Relaxed))
    }
    /// Stores neighbouring words from `first` on, relaxed.
    fn store_run<const N: usize>(&self, first: usize, values: &[u64; N]) {
        for (at, value) in values.iter().enumerate() {
            self.store(first + at, *value, Ordering::Relaxed);
        }
    }
}

impl<W: Words> Words for Arc<W> {
    #[inline]
    fn load(&self, at: usize, order: Ordering) -> u64 {
        (**self).load(at, order)
    }
    #[inline]
    fn store(&self, at: usize, value: u64, order: Ordering) {
        (**self).store(at, value, order);
    }
    fn fetch_add(&self, at: usize, value: u64, order: Ordering) -> u64 {
        (**self).fetch_add(at, value, order)
    }
    fn fetch_and(&self, at: usize, value: u64, order: Ordering) -> u64 {
        (**self).fetch_and(at, value, order)
    }
    fn fetch_or(&self, at: usize, value: u64, order: Ordering) -> u64 {
        (**self).fetch_or(at, value, order)
    }
    #[inline]
    fn load_run<const N: usize>(&self, first: usize) -> [u64; N] {
        (**self).load_run(first)
    }
    #[inline]
    fn store_run<const N: usize>(&self, first: usize, values: &[u64; N]) {
        (**self).store_run(first, values);
    }
}

/// The writer's half.
#[derive(Debug)]
pub struct RingWriter<W> {
    data: W,
    ctl: W,
    shape: Shape,
    /// The slot at each place of the ring: the writer's own copy, which nobody else can change.
    named: Vec<u16>,
    /// Slots that may be written; the last was used most recently and is still in the cache.
    free: Vec<u16>,
    /// First slot that was never used.
    fresh: u16,
    /// Slots pushed out of the ring and not yet known to be free, oldest first.
    retired: VecDeque<u16>,
    /// Retired slots at which a scan is worth its price.
    scan_at: usize,
    /// Scratch of the scan: a bit for each slot.
    pinned: Vec<u64>,
    pos: u64,
    forced: u64,
}

/// The outcome of [`RingWriter::publish`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Published {
    /// Position of the sample, from 1. 48 bits: enough for nine years of a sample each microsecond.
    pub pos: u64,
    /// Cells that were waiting.
    pub waiting: u64,
}

/// A reader's half: one cell.
#[derive(Debug)]
pub struct RingReader<W> {
    data: W,
    ctl: W,
    shape: Shape,
    cell: u32,
    pins: u32,
}

/// Why a position is not there.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Miss {
    /// The ring names a newer sample in its place.
    Overwritten,
    /// The ring names an older sample, or none.
    NotYet,
    /// The ring names a slot that does not exist.
    Corrupt,
}

impl<W: Words> RingWriter<W> {
    /// Takes over zeroed memory of the given shape.
    pub fn new(data: W, ctl: W, shape: Shape) -> Self {
        let slots = usize::from(shape.slots());
        Self {
            data,
            ctl,
            shape,
            named: vec![NO_SLOT; shape.ring_len()],
            free: Vec::with_capacity(slots),
            fresh: 0,
            retired: VecDeque::with_capacity(slots),
            scan_at: BATCH,
            pinned: vec![0; slots.div_ceil(64)],
            pos: 0,
            forced: 0,
        }
    }

    /// Takes a slot to write, voided. `None` when all slots outside the ring are on loan.
    #[inline(always)]
    pub fn loan(&mut self) -> Option<u16> {
        let slot = self.take()?;
        self.data
            .store(self.shape.slot_word(slot), 0, Ordering::Relaxed);
        // Release: pairs with the acquire fence in `slot_is_intact`.
        fence(Site::VoidFence);
        crash::point("publish.voided");
        Some(slot)
    }

    #[inline]
    fn take(&mut self) -> Option<u16> {
        match self.free.pop() {
            Some(slot) => Some(slot),
            None => self.find(),
        }
    }

    #[inline(never)]
    fn find(&mut self) -> Option<u16> {
        let no_fresh = self.fresh == self.shape.slots();
        if no_fresh || self.retired.len() >= self.scan_at {
            self.scan();
            if let Some(slot) = self.free.pop() {
                return Some(slot);
            }
        }
        if !no_fresh {
            self.fresh += 1;
            return Some(self.fresh - 1);
        }
        let slot = self.retired.pop_front()?;
        self.forced += 1;
        Some(slot)
    }

    /// Moves every retired slot that nobody pins to the free ones.
    fn scan(&mut self) {
        // No fence here: the one in `publish` lies between the push out of the ring and this.
        self.pinned.fill(0);
        // Acquire: pairs with the Release in `clear_cell`, whose pins are not looked at.
        let mut open = self.ctl.load(layout::OPEN, order(Site::PinScan));
        while open != 0 {
            let cell = open.trailing_zeros();
            open &= open - 1;
            if cell >= self.shape.spec().cells {
                break;
            }
            // Relaxed: like the open bit, it was stored before the fence of the cell's first pin.
            let seat = self.ctl.load(self.shape.bell_word(cell), Ordering::Relaxed);
            for pin in 0..seat_pins(seat) {
                // Acquire: pairs with the Release in `set_pin`.
                let word = self
                    .ctl
                    .load(self.shape.pin_word(cell, pin), order(Site::PinScan));
                // Words of other processes: what names no slot pins none.
                if let Ok(slot) = usize::try_from(word.wrapping_sub(1))
                    && let Some(bits) = self.pinned.get_mut(slot / 64)
                {
                    *bits |= 1 << (slot % 64);
                }
            }
        }
        for _ in 0..self.retired.len() {
            let Some(slot) = self.retired.pop_front() else {
                break;
            };
            let place = usize::from(slot);
            if self.pinned[place / 64] & 1 << (place % 64) == 0 {
                self.free.push(slot);
            } else {
                self.retired.push_back(slot);
            }
        }
        self.scan_at = self.retired.len() + BATCH;
    }

    /// Makes a loaned slot the newest sample. The caller rings the bells of the cells that wait.
    #[inline(always)]
    pub fn publish(&mut self, slot: u16, stamp: &[u64; STAMP_WORDS]) -> Published {
        let pos = self.pos + 1;
        self.pos = pos;
        let header = self.shape.slot_word(slot);
        self.data.store_run(header + 1, stamp);
        self.data.store(header, pos, Ordering::Relaxed);
        crash::point("publish.stamped");

        let index = self.shape.ring_index(pos);
        let entry = (pos << SLOT_BITS) | u64::from(slot);
        // Release: pairs with the fences in `RingReader::pin` and `peek`.
        self.data
            .store(self.shape.ring_word(index), entry, order(Site::RingStore));
        crash::point("publish.linked");
        // Release: pairs with the Acquire in `head`.
        self.data.store(layout::HEAD, pos, order(Site::HeadStore));
        crash::point("publish.head");
        // SeqCst: pairs with the fences in `RingReader::pin` and `notify::arm`.
        fence(Site::PublishFence);

        let old = std::mem::replace(&mut self.named[index], slot);
        if old != NO_SLOT {
            self.retired.push_back(old);
        }
        Published {
            pos,
            waiting: self.ctl.load(layout::WAITING, Ordering::Relaxed),
        }
    }

    /// Gives a loaned slot back unpublished.
    pub fn discard(&mut self, slot: u16) {
        self.free.push(slot);
    }

    /// Calls `ring` with the bell of each cell in `waiting`.
    pub fn waiting_bells(&self, waiting: u64, ring: impl FnMut(Bell)) {
        waiting_bells(&self.ctl, &self.shape, waiting, ring);
    }

    /// Samples published so far.
    pub fn published(&self) -> u64 {
        self.pos
    }

    /// Slots taken although a pin named them.
    pub fn forced(&self) -> u64 {
        self.forced
    }

    /// Sizes and places.
    #[inline]
    pub fn shape(&self) -> &Shape {
        &self.shape
    }

    /// The memory of samples.
    #[inline]
    pub fn data(&self) -> &W {
        &self.data
    }

    /// The memory of pins.
    #[inline]
    pub fn ctl(&self) -> &W {
        &self.ctl
    }
}

impl<W: Words> RingReader<W> {
    /// Takes the cell, which nobody else uses, with its first `pins` pins, and shows it to the writer.
    pub fn new(data: W, ctl: W, shape: Shape, cell: u32, pins: u32, bell: Bell) -> Self {
        let reader = Self {
            data,
            ctl,
            shape,
            cell,
            pins,
        };
        reader.set_bell(bell);
        // Relaxed: the fence of each pin also stands behind this, so a scan that must see the pin sees the cell open.
        reader
            .ctl
            .fetch_or(layout::OPEN, 1 << cell, Ordering::Relaxed);
        reader
    }

    /// Newest position, 0 before the first.
    #[inline]
    pub fn head(&self) -> u64 {
        head(&self.data)
    }

    /// Pins the sample at `pos` with this cell's pin number `pin`, which is not in use, and returns its slot. After a
    /// miss the pin is clear.
    pub fn pin(&self, pin: u32, pos: u64) -> Result<u16, Miss> {
        let (slot, entry) = locate(&self.data, &self.shape, pos)?;
        set_pin(&self.ctl, &self.shape, self.cell, pin, u64::from(slot) + 1);
        crash::point("pin.set");
        // SeqCst: pairs with the fence in `RingWriter::publish`, and with its Release of the ring's entry.
        fence(Site::PinFence);
        let again = self.shape.ring_word(self.shape.ring_index(pos));
        if self.data.load(again, Ordering::Relaxed) == entry {
            crash::point("pin.checked");
            return Ok(slot);
        }
        self.unpin(pin);
        Err(Miss::Overwritten)
    }

    /// Clears a pin.
    pub fn unpin(&self, pin: u32) {
        set_pin(&self.ctl, &self.shape, self.cell, pin, 0);
        crash::point("pin.cleared");
    }

    /// The words beside the position of a pinned slot. They are those of its sample if [`RingReader::intact`] says
    /// so afterwards.
    pub fn stamp(&self, slot: u16) -> [u64; STAMP_WORDS] {
        load_stamp(&self.data, &self.shape, slot)
    }

    /// Whether everything read from the slot so far was of the sample at `pos`.
    pub fn intact(&self, slot: u16, pos: u64) -> bool {
        slot_is_intact(&self.data, &self.shape, slot, pos)
    }

    /// Shows the cell as waiting or not.
    pub fn set_waiting(&self, waiting: bool) {
        // Relaxed: the fence in `notify::arm` stands behind this.
        if waiting {
            self.ctl
                .fetch_or(layout::WAITING, 1 << self.cell, Ordering::Relaxed);
        } else {
            self.ctl
                .fetch_and(layout::WAITING, !(1 << self.cell), Ordering::Relaxed);
        }
    }

    /// Sets the word that names this cell's bell, and tells the scan how many pins to look at.
    pub fn set_bell(&self, bell: Bell) {
        let seat = (u64::from(self.pins) << SEAT_PINS_SHIFT) | bell.to_word();
        self.ctl
            .store(self.shape.bell_word(self.cell), seat, Ordering::Relaxed);
    }

    /// Shows the daemon what this reader has read.
    #[inline]
    pub fn set_books(&self, books: &[u64; BOOK_WORDS]) {
        self.ctl.store_run(self.shape.books_word(self.cell), books);
    }

    /// Gives the cell up.
    pub fn leave(&self) {
        clear_cell(&self.ctl, &self.shape, self.cell);
    }

    /// Sizes and places.
    #[inline]
    pub fn shape(&self) -> &Shape {
        &self.shape
    }

    /// The memory of samples.
    #[inline]
    pub fn data(&self) -> &W {
        &self.data
    }

    /// The memory of pins.
    #[inline]
    pub fn ctl(&self) -> &W {
        &self.ctl
    }
}

/// Newest position, 0 before the first.
#[inline]
pub fn head<W: Words>(data: &W) -> u64 {
    // Acquire: pairs with the Release in `RingWriter::publish`.
    data.load(layout::HEAD, order(Site::HeadLoad))
}

/// Reads the sample at `pos` without a pin: `read` copies what it wants of the slot, by relaxed loads, and its outcome is
/// given only if all of that was of the sample. [`Miss::Overwritten`] is final: the sample has left the ring.
#[inline]
pub fn glance<W: Words, T>(
    data: &W,
    shape: &Shape,
    pos: u64,
    read: impl FnOnce(u16) -> T,
) -> Result<T, Miss> {
    let slot = peek(data, shape, pos)?;
    let read = read(slot);
    // A slot is voided only after a newer sample has taken its place in the ring.
    if slot_is_intact(data, shape, slot, pos) {
        Ok(read)
    } else {
        Err(Miss::Overwritten)
    }
}

/// Finds the slot of `pos` for a reader without a pin, who has to ask afterwards whether it was intact.
#[inline]
pub fn peek<W: Words>(data: &W, shape: &Shape, pos: u64) -> Result<u16, Miss> {
    let (slot, _) = locate(data, shape, pos)?;
    // Acquire: pairs with the Release of the ring's entry in `RingWriter::publish`.
    fence(Site::PeekFence);
    Ok(slot)
}

/// The cells that wait, for who has just changed something that they wait for.
pub fn waiting_now<W: Words>(ctl: &W) -> u64 {
    // SeqCst: pairs with the fence in `notify::arm`.
    fence(Site::StateFence);
    ctl.load(layout::WAITING, Ordering::Relaxed)
}

/// Finds the slot of `pos`, and the ring's entry that names it. Callers fence before they look into the slot.
#[inline]
fn locate<W: Words>(data: &W, shape: &Shape, pos: u64) -> Result<(u16, u64), Miss> {
    let at = shape.ring_word(shape.ring_index(pos));
    let entry = data.load(at, Ordering::Relaxed);
    let named = entry >> SLOT_BITS;
    if pos == 0 || named < pos {
        return Err(Miss::NotYet);
    }
    if named > pos {
        return Err(Miss::Overwritten);
    }
    match u16::try_from(entry & SLOT_MASK) {
        Ok(slot) if slot < shape.slots() => Ok((slot, entry)),
        _ => Err(Miss::Corrupt),
    }
}

/// The words beside a slot's position.
#[inline]
pub fn load_stamp<W: Words>(data: &W, shape: &Shape, slot: u16) -> [u64; STAMP_WORDS] {
    data.load_run(shape.slot_word(slot) + 1)
}

/// Whether everything read from the slot so far was of the sample at `pos`.
#[inline]
pub fn slot_is_intact<W: Words>(data: &W, shape: &Shape, slot: u16, pos: u64) -> bool {
    // Acquire: pairs with the release fence in `RingWriter::loan`.
    fence(Site::IntactFence);
    data.load(shape.slot_word(slot), Ordering::Relaxed) == pos
}

/// Calls `ring` with the bell of each cell in `waiting`, a mask that anybody may have written.
pub fn waiting_bells<W: Words>(ctl: &W, shape: &Shape, waiting: u64, mut ring: impl FnMut(Bell)) {
    let mut left = waiting;
    while left != 0 {
        let cell = left.trailing_zeros();
        left &= left - 1;
        if cell < shape.spec().cells {
            ring(Bell::from_word(
                ctl.load(shape.bell_word(cell), Ordering::Relaxed),
            ));
        }
    }
}

/// Clears the pins of a cell and shows it neither open nor waiting.
pub fn clear_cell<W: Words>(ctl: &W, shape: &Shape, cell: u32) {
    ctl.fetch_and(layout::WAITING, !(1 << cell), Ordering::Relaxed);
    for pin in 0..MAX_PINS {
        if ctl.load(shape.pin_word(cell, pin), Ordering::Relaxed) != 0 {
            set_pin(ctl, shape, cell, pin, 0);
        }
    }
    let books = shape.books_word(cell);
    // The last of them is zero only while all are.
    if ctl.load(books + BOOK_WORDS - 1, Ordering::Relaxed) != 0 {
        ctl.store_run(books, &[0; BOOK_WORDS]);
    }
    // Release: pairs with the Acquire in `RingWriter::scan`, which does not look at the pins of a closed cell.
    ctl.fetch_and(layout::OPEN, !(1 << cell), order(Site::PinStore));
}

/// What the reader in a cell says that it has read; words of another process, perhaps of two moments.
pub fn cell_books<W: Words>(ctl: &W, shape: &Shape, cell: u32) -> [u64; BOOK_WORDS] {
    ctl.load_run(shape.books_word(cell))
}

/// Pins of a cell by its word, which anybody may have written.
fn seat_pins(seat: u64) -> u32 {
    u32::try_from(seat >> SEAT_PINS_SHIFT).map_or(MAX_PINS, |pins| pins.min(MAX_PINS))
}

fn set_pin<W: Words>(ctl: &W, shape: &Shape, cell: u32, pin: u32, value: u64) {
    // Release: pairs with the Acquire in `RingWriter::scan`.
    ctl.store(shape.pin_word(cell, pin), value, order(Site::PinStore));
}

const _: () = assert!(STAMP_WORDS < LINE_WORDS, "a slot's header is one line");
const _: () = assert!(
    MAX_PINS as usize + 1 == LINE_WORDS,
    "the first line of a cell: its bell and its pins"
);
const _: () = assert!(BOOK_WORDS <= LINE_WORDS, "the second line of a cell");
