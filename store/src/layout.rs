//! Where everything lies in an item's two segments: the only place that says so.
//!
//! `data` is written by the writer alone, `ctl` by every reader:
//!
//! ```text
//! data   line 0   magic version capacity depth cells pool epoch      fixed at creation
//!        line 1.. head                                               newest position, 0 = none
//!                 ring[depth]                                        position << 16 | slot
//!        slots    slots x { header line | payload, padded to lines }
//! ctl    line 0   state                                              superseded, orphaned, removed
//!        line 1   waiting                                            a bit per cell
//!        line 2   open                                               a bit per cell
//!        line 3.. cells x { pins << 32 | bell, pin x 15              a line
//!                           books }                                  a line, of which only the daemon reads
//! ```
//!
//! All words are u64, little-endian. A header that another process wrote is copied out once and judged as a value;
//! what passes is a [`Shape`], whose offsets lie inside the mapping by construction.
#![warn(
    clippy::arithmetic_side_effects,
    clippy::indexing_slicing,
    clippy::as_conversions
)]

use thiserror::Error;

#[cfg(target_endian = "big")]
compile_error!("segments are little-endian, and so must the host be");

/// Bytes of a line: two cache lines, because adjacent ones are fetched together and would be shared falsely.
pub const LINE: usize = 128;
/// Bytes of a word.
pub const WORD: usize = 8;
/// Words of a line.
pub const LINE_WORDS: usize = 16;

/// First word of every data segment: `ddxring` and a zero.
pub const MAGIC: u64 = u64::from_le_bytes(*b"ddxring\0");
/// Version of this layout; any other is refused.
pub const VERSION: u64 = 3;

/// Largest payload, bytes: keeps sums of a slot's size far from overflow and a typing error from mapping the world.
pub const MAX_CAPACITY: u32 = 1 << 30;
/// Most samples a ring holds. Slot numbers are 16 bits wide; this leaves room for the other slots.
pub const MAX_DEPTH: u32 = 16_384;
/// Most readers of one item on a host: `waiting` and `open` have one bit for each.
pub const MAX_CELLS: u32 = 64;
/// Pins of one cell: what fits its line beside the bell.
pub const MAX_PINS: u32 = 15;
/// Pins that every reader gets: one for a sample that it holds while it takes the next.
pub const BASE_PINS: u32 = 2;
/// Most pins of an item beyond the base: every cell filled.
pub const MAX_POOL: u32 = MAX_CELLS * (MAX_PINS - BASE_PINS);
/// Slots beyond those that the ring and granted pins can occupy: the writer's loan, and one more so that the pinned
/// ones do not force a scan for each write.
pub const SPARE: u32 = 2;
/// Largest data segment, bytes of address space (memory is taken only as slots are touched).
pub const MAX_BYTES: u64 = 1 << 36;

/// Word of the newest position.
pub const HEAD: usize = LINE_WORDS;
/// Behind the head, because whoever has seen a new one looks at the ring next: one line to fetch instead of two.
const FIRST_RING: usize = HEAD + 1;

/// Word of the state bits in `ctl`.
pub const STATE: usize = 0;
/// Word of the waiting mask in `ctl`.
pub const WAITING: usize = LINE_WORDS;
/// Word of the mask of cells in use, in `ctl`.
pub const OPEN: usize = 2 * LINE_WORDS;
const FIRST_CELL: usize = 3 * LINE_WORDS;
/// Words of a cell: what the writer scans, and apart from it what the reader changes with each sample.
const CELL_WORDS: usize = 2 * LINE_WORDS;

/// What a writer asks of its segment.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Spec {
    /// Largest payload, bytes.
    pub capacity_bytes: u32,
    /// Samples the ring holds, at least 1.
    pub depth: u32,
    /// Readers that can be seated, at least 1.
    pub cells: u32,
    /// Pins that may be granted beyond [`BASE_PINS`] for each reader.
    pub pool: u32,
}

/// A checked [`Spec`] with its epoch and sizes. Offsets of rings, slots and cells follow from it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Shape {
    spec: Spec,
    epoch: u64,
    slots: u16,
    first_slot: usize,
    stride: usize,
    data_len: usize,
    ctl_len: usize,
}

/// Why a size was refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Error)]
#[non_exhaustive]
pub enum LayoutError {
    /// A figure lies outside its limits.
    #[error("{what} of {value} is not between {least} and {most}")]
    Limit {
        /// What the figure counts.
        what: &'static str,
        /// The figure.
        value: u64,
        /// Smallest that is allowed.
        least: u64,
        /// Largest that is allowed.
        most: u64,
    },
    /// The segment does not begin as one of ours.
    #[error("not a segment of this program (it begins with {0:#018x})")]
    Magic(u64),
    /// The segment was laid out by another version.
    #[error("segment layout version {0}, and this program knows only version {VERSION}")]
    Version(u64),
    /// The mapping has another size than the header implies.
    #[error("{what} segment of {found} bytes, and its header implies {expected}")]
    Size {
        /// `data` or `ctl`.
        what: &'static str,
        /// Bytes that are there.
        found: usize,
        /// Bytes that the header implies.
        expected: usize,
    },
}

impl Spec {
    /// Checks every figure against its limit and computes the sizes.
    pub fn shape(self, epoch: u64) -> Result<Shape, LayoutError> {
        limit("capacity (bytes)", self.capacity_bytes, 0, MAX_CAPACITY)?;
        limit("ring depth", self.depth, 1, MAX_DEPTH)?;
        limit("number of readers", self.cells, 1, MAX_CELLS)?;
        limit("pin pool", self.pool, 0, MAX_POOL)?;
        let slots = u64::from(self.depth)
            .saturating_add(u64::from(self.cells).saturating_mul(u64::from(BASE_PINS)))
            .saturating_add(u64::from(self.pool))
            .saturating_add(u64::from(SPARE));
        let line = wide(LINE);
        let stride = line.saturating_add(u64::from(self.capacity_bytes).next_multiple_of(line));
        let first_slot = wide(FIRST_RING)
            .saturating_add(u64::from(self.depth))
            .saturating_mul(wide(WORD))
            .next_multiple_of(line);
        let data_len = first_slot.saturating_add(slots.saturating_mul(stride));
        let ctl_len = wide(FIRST_CELL)
            .saturating_mul(wide(WORD))
            .saturating_add(u64::from(self.cells).saturating_mul(wide(CELL_WORDS * WORD)));
        let too_large = |value: u64| LayoutError::Limit {
            what: "segment size (bytes)",
            value,
            least: 0,
            most: MAX_BYTES.min(wide(usize::MAX >> 1)),
        };
        let size = |value: u64| {
            usize::try_from(value)
                .ok()
                .filter(|_| value <= MAX_BYTES.min(wide(usize::MAX >> 1)))
                .ok_or_else(|| too_large(value))
        };
        Ok(Shape {
            spec: self,
            epoch,
            slots: u16::try_from(slots).map_err(|_| too_large(slots))?,
            first_slot: size(first_slot)?,
            stride: size(stride)?,
            data_len: size(data_len)?,
            ctl_len: size(ctl_len)?,
        })
    }
}

/// The first line of a data segment, copied out: nothing of it is believed before [`Header::check`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Header(pub [u64; Self::WORDS]);

impl Header {
    /// Words of the header, from the start of the segment.
    pub const WORDS: usize = 7;

    /// What a writer of `shape` puts there.
    pub fn of(shape: &Shape) -> Self {
        let spec = shape.spec;
        Self([
            MAGIC,
            VERSION,
            u64::from(spec.capacity_bytes),
            u64::from(spec.depth),
            u64::from(spec.cells),
            u64::from(spec.pool),
            shape.epoch,
        ])
    }

    /// Judges the header of a segment whose mappings have the given sizes in bytes.
    pub fn check(self, data_len: usize, ctl_len: usize) -> Result<Shape, LayoutError> {
        let [magic, version, capacity, depth, cells, pool, epoch] = self.0;
        if magic != MAGIC {
            return Err(LayoutError::Magic(magic));
        }
        if version != VERSION {
            return Err(LayoutError::Version(version));
        }
        let shape = Spec {
            capacity_bytes: narrow("capacity (bytes)", capacity, MAX_CAPACITY)?,
            depth: narrow("ring depth", depth, MAX_DEPTH)?,
            cells: narrow("number of readers", cells, MAX_CELLS)?,
            pool: narrow("pin pool", pool, MAX_POOL)?,
        }
        .shape(epoch)?;
        expect_size("data", data_len, shape.data_len)?;
        expect_size("ctl", ctl_len, shape.ctl_len)?;
        Ok(shape)
    }
}

#[expect(
    clippy::arithmetic_side_effects,
    reason = "every term is bounded by the sizes that `Spec::shape` has checked"
)]
impl Shape {
    /// What was asked for.
    pub fn spec(&self) -> Spec {
        self.spec
    }

    /// Epoch of the segment.
    pub fn epoch(&self) -> u64 {
        self.epoch
    }

    /// Largest payload, bytes.
    #[inline]
    pub fn capacity(&self) -> usize {
        clamp(self.spec.capacity_bytes)
    }

    /// Samples the ring holds.
    #[inline]
    pub fn depth(&self) -> u64 {
        u64::from(self.spec.depth)
    }

    /// Places of the ring, as a length.
    pub fn ring_len(&self) -> usize {
        clamp(self.spec.depth)
    }

    /// Slots in all.
    #[inline]
    pub fn slots(&self) -> u16 {
        self.slots
    }

    /// Bytes of the data segment.
    pub fn data_len(&self) -> usize {
        self.data_len
    }

    /// Bytes of the ctl segment.
    pub fn ctl_len(&self) -> usize {
        self.ctl_len
    }

    /// Place of `pos` in the ring, below the depth.
    #[inline]
    pub fn ring_index(&self, pos: u64) -> usize {
        let depth = self.depth();
        // A division costs as much as all else that finds a slot.
        let index = match depth.is_power_of_two() {
            true => pos & (depth - 1),
            false => pos % depth,
        };
        usize::try_from(index).unwrap_or(0)
    }

    /// Word of the ring's entry `index`, which is below the depth.
    #[inline]
    pub fn ring_word(&self, index: usize) -> usize {
        FIRST_RING + index
    }

    /// First word of the header of `slot`, which is below the number of slots.
    #[inline]
    pub fn slot_word(&self, slot: u16) -> usize {
        (self.first_slot + usize::from(slot) * self.stride) / WORD
    }

    /// Byte at which the payload of `slot` begins, a multiple of [`LINE`].
    #[inline]
    pub fn payload_offset(&self, slot: u16) -> usize {
        self.first_slot + usize::from(slot) * self.stride + LINE
    }

    /// Word of the bell of `cell`, which is below the number of cells.
    #[inline]
    pub fn bell_word(&self, cell: u32) -> usize {
        FIRST_CELL + clamp(cell) * CELL_WORDS
    }

    /// First word of the books of `cell`, which is below the number of cells.
    #[inline]
    pub fn books_word(&self, cell: u32) -> usize {
        self.bell_word(cell) + LINE_WORDS
    }

    /// Word of one pin of `cell`; `pin` is below [`MAX_PINS`].
    #[inline]
    pub fn pin_word(&self, cell: u32, pin: u32) -> usize {
        self.bell_word(cell) + 1 + clamp(pin)
    }
}

fn limit(what: &'static str, value: u32, least: u32, most: u32) -> Result<(), LayoutError> {
    if (least..=most).contains(&value) {
        return Ok(());
    }
    Err(LayoutError::Limit {
        what,
        value: u64::from(value),
        least: u64::from(least),
        most: u64::from(most),
    })
}

fn narrow(what: &'static str, value: u64, most: u32) -> Result<u32, LayoutError> {
    u32::try_from(value).map_err(|_| LayoutError::Limit {
        what,
        value,
        least: 0,
        most: u64::from(most),
    })
}

fn expect_size(what: &'static str, found: usize, expected: usize) -> Result<(), LayoutError> {
    if found == expected {
        return Ok(());
    }
    Err(LayoutError::Size {
        what,
        found,
        expected,
    })
}

fn wide(value: usize) -> u64 {
    u64::try_from(value).unwrap_or(u64::MAX)
}

#[inline]
fn clamp(value: u32) -> usize {
    usize::try_from(value).unwrap_or(usize::MAX)
}

#[cfg(test)]
#[expect(
    clippy::indexing_slicing,
    reason = "a test that is out of bounds fails"
)]
mod tests {
    use super::*;

    const SPEC: Spec = Spec {
        capacity_bytes: 100,
        depth: 3,
        cells: 4,
        pool: 5,
    };

    #[test]
    fn nothing_overlaps_and_all_of_it_is_inside() {
        let shape = SPEC.shape(1).unwrap();

        assert_eq!(shape.slots(), 3 + 2 * 4 + 5 + 2);
        assert!(shape.ring_word(2) < shape.slot_word(0));
        for slot in 0..shape.slots() {
            assert_eq!(shape.payload_offset(slot) % LINE, 0);
            assert_eq!(
                shape.slot_word(slot) * WORD + LINE,
                shape.payload_offset(slot)
            );
            assert!(shape.payload_offset(slot) + shape.capacity() <= shape.data_len());
            if slot > 0 {
                assert!(
                    shape.payload_offset(slot - 1) + shape.capacity()
                        <= shape.slot_word(slot) * WORD
                );
            }
        }
        assert_eq!((shape.books_word(3) + LINE_WORDS) * WORD, shape.ctl_len());
        assert_eq!(shape.pin_word(0, MAX_PINS - 1) + 1, shape.books_word(0));
        assert_eq!(shape.books_word(0) + LINE_WORDS, shape.bell_word(1));
    }

    #[test]
    fn a_header_survives_its_check() {
        let shape = SPEC.shape(77).unwrap();
        let checked = Header::of(&shape).check(shape.data_len(), shape.ctl_len());
        assert_eq!(checked, Ok(shape));
    }

    #[test]
    fn each_limit_is_named() {
        let refused = |spec: Spec| spec.shape(1).unwrap_err().to_string();
        assert!(refused(Spec { depth: 0, ..SPEC }).starts_with("ring depth of 0"));
        assert!(
            refused(Spec {
                depth: 16_385,
                ..SPEC
            })
            .contains("between 1 and 16384")
        );
        assert!(refused(Spec { cells: 65, ..SPEC }).starts_with("number of readers"));
        assert!(refused(Spec { cells: 0, ..SPEC }).starts_with("number of readers"));
        assert!(
            refused(Spec {
                pool: u32::MAX,
                ..SPEC
            })
            .starts_with("pin pool")
        );
        assert!(
            refused(Spec {
                capacity_bytes: u32::MAX,
                ..SPEC
            })
            .starts_with("capacity")
        );
        let huge = Spec {
            capacity_bytes: MAX_CAPACITY,
            depth: MAX_DEPTH,
            ..SPEC
        };
        assert!(refused(huge).starts_with("segment size"));
    }

    #[test]
    fn a_lying_header_is_refused() {
        let shape = SPEC.shape(1).unwrap();
        let lie = |word: usize, value: u64| {
            let mut header = Header::of(&shape);
            header.0[word] = value;
            header.check(shape.data_len(), shape.ctl_len())
        };

        assert_eq!(lie(0, 9), Err(LayoutError::Magic(9)));
        assert_eq!(lie(1, VERSION + 1), Err(LayoutError::Version(VERSION + 1)));
        // Capacities up to 128 share one stride; every other figure changes a size.
        for (word, honest) in [(2, 128), (3, 3), (4, 4), (5, 5)] {
            for value in [0, honest + 1, 1 << 20, 1 << 32, u64::MAX] {
                assert!(lie(word, value).is_err(), "word {word} = {value}");
            }
        }
    }

    #[test]
    fn a_mapping_of_another_size_is_refused() {
        let shape = SPEC.shape(1).unwrap();
        let header = Header::of(&shape);
        assert!(header.check(shape.data_len() - 1, shape.ctl_len()).is_err());
        assert!(
            header
                .check(shape.data_len(), shape.ctl_len() + LINE)
                .is_err()
        );
    }
}
