//! Moving pictures for tests, each of which carries its number and its capture time where lossy coding and scaling leave them
//! readable.
//!
//! The upper half is a grid of 16 by 8 cells, each black or white, read from the left and from the top. The first two are
//! white and black, so that a reader knows what these look like; then come six zeros, 32 bits of the frame's number, 64 bits
//! of time (nanoseconds, of the clock that the writer chose) and 24 bits by which a misread grid is told, high bits first.
//! The lower half is colours under a bar that moves by a sixteenth of the width each second.

use crate::Error;
use crate::components::components;
use crate::format::PixelFormat;
use crate::frame::{Field, FieldSpec, FrameInfo, Layout, PlaneMut};

/// What a picture carries.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Stamp {
    /// The frame's number; its lower 32 bits.
    pub sequence: u32,
    /// When it was captured, ns.
    pub time_ns: u64,
}

/// Draws the pictures of one stream, in I420.
#[derive(Clone, Debug)]
pub struct Pattern {
    layout: Layout,
    /// The lower half, without the bar.
    ground: [Vec<u8>; 3],
}

impl Pattern {
    /// A stream of frames with pictures of one size, one of each name.
    ///
    /// # Errors
    /// [`Error::Size`] below 64x64 pixels, where the cells would be too small to be read back, and for what no frame can be;
    /// [`Error::Fields`] and [`Error::FieldName`].
    pub fn new(width: u32, height: u32, fields: &[&str]) -> Result<Self, Error> {
        if width < SIDE_MIN || height < SIDE_MIN {
            return Err(Error::Size { width, height });
        }
        let specs = fields
            .iter()
            .map(|name| FieldSpec::new(name, PixelFormat::I420, width, height));
        let layout = Layout::new(&specs.collect::<Vec<_>>())?;
        let mut frame = vec![0; layout.size_bytes()];
        let mut planes = layout.planes_mut(&mut frame, 0).into_iter();
        let ground = std::array::from_fn(|component| {
            planes
                .next()
                .map_or_else(Vec::new, |plane| ground(component, &plane))
        });
        Ok(Self { layout, ground })
    }

    /// The layout of its frames.
    pub fn layout(&self) -> &Layout {
        &self.layout
    }

    /// Draws a frame with this header, which is stamped with its capture time.
    ///
    /// # Errors
    /// [`Error::Capacity`] when `frame` is not as long as the layout says.
    pub fn draw(&self, frame: &mut [u8], info: &FrameInfo) -> Result<(), Error> {
        self.layout.write_header(frame, info)?;
        let (low, _) = halves(info.sequence);
        let cells = encode(Stamp {
            sequence: low,
            time_ns: info.capture_ns,
        });
        for field in 0..self.layout.fields().len() {
            self.draw_field(self.layout.planes_mut(frame, field), &cells, info);
        }
        Ok(())
    }

    fn draw_field(&self, planes: Vec<PlaneMut<'_>>, cells: &[bool; GRID_CELLS], info: &FrameInfo) {
        let planes = planes.into_iter().zip(&self.ground);
        for (component, (mut plane, ground)) in planes.enumerate() {
            let upper = upper_rows(plane.rows);
            let luma = component == 0;
            for row in 0..upper {
                let of = row * GRID_ROWS / upper;
                if luma && row > 0 && (row - 1) * GRID_ROWS / upper == of {
                    // As the row above.
                    let from = (row - 1) * plane.stride;
                    let (end, to) = (from + plane.row_bytes, row * plane.stride);
                    plane.bytes.copy_within(from..end, to);
                    continue;
                }
                let bytes = plane.row(row);
                if !luma {
                    bytes.fill(GREY);
                    continue;
                }
                let width = bytes.len();
                for (x, byte) in bytes.iter_mut().enumerate() {
                    let is_white = cells[of * GRID_COLUMNS + x * GRID_COLUMNS / width];
                    *byte = if is_white { WHITE } else { BLACK };
                }
            }
            let len = plane.row_bytes;
            for row in upper..plane.rows {
                let from = (row - upper) * len;
                plane.row(row).copy_from_slice(&ground[from..from + len]);
            }
            bar(&mut plane, upper, component, info.capture_ns);
        }
    }
}

/// Reads what a picture carries, from its luma: that of the pattern, or of what became of it on the way. `None` where it cannot
/// be told.
pub fn read(field: &Field<'_>) -> Option<Stamp> {
    let format = field.info.format;
    // Of green there is most in it.
    let is_rgb = matches!(
        format,
        PixelFormat::Rgb24 | PixelFormat::Bgr24 | PixelFormat::Rgba
    );
    let luma = match (is_rgb, format == PixelFormat::Hsy) {
        (true, _) => 1,
        (false, true) => 2,
        (false, false) => 0,
    };
    if format == PixelFormat::Grey16 {
        return None;
    }
    let component = components(field.info.format).get(luma)?;
    let plane = field.plane(component.plane)?;
    let width = usize::try_from(field.info.width).ok()?;
    let (first, step) = component.place();
    let upper = upper_rows(plane.rows);
    if width < GRID_COLUMNS * 2 || upper < GRID_ROWS * 2 {
        return None;
    }
    let mut means = [0_u32; GRID_CELLS];
    for (cell, mean) in means.iter_mut().enumerate() {
        // The inner half of each side: edges are where coding errs.
        let inner = |at: usize, of: usize, len: usize| {
            let (from, to) = (at * len / of, (at + 1) * len / of);
            let margin = (to - from) / 4;
            from + margin..(to - margin).max(from + margin + 1)
        };
        let (mut sum, mut count) = (0_u32, 0_u32);
        for y in inner(cell / GRID_COLUMNS, GRID_ROWS, upper) {
            for x in inner(cell % GRID_COLUMNS, GRID_COLUMNS, width) {
                sum += u32::from(*plane.bytes.get(y * plane.stride + first + x * step)?);
                count += 1;
            }
        }
        *mean = sum / count;
    }
    let (white, black) = (means[0], means[1]);
    if white < black + 32 {
        return None;
    }
    let middle = u32::midpoint(white, black);
    decode(&means.map(|mean| mean > middle))
}

fn encode(stamp: Stamp) -> [bool; GRID_CELLS] {
    let mut cells = [false; GRID_CELLS];
    cells[0] = true;
    let check = u64::from(check(stamp));
    let parts = [
        (u64::from(stamp.sequence), 32),
        (stamp.time_ns, 64),
        (check, CHECK_BITS),
    ];
    let bits = parts
        .into_iter()
        .flat_map(|(value, bits)| (0..bits).rev().map(move |bit| value >> bit & 1 == 1));
    for (cell, bit) in cells[HEAD..].iter_mut().zip(bits) {
        *cell = bit;
    }
    cells
}

fn decode(cells: &[bool; GRID_CELLS]) -> Option<Stamp> {
    let value = |cells: &[bool]| {
        let bits = cells.iter();
        bits.fold(0_u64, |value, bit| value << 1 | u64::from(*bit))
    };
    let (head, rest) = cells.split_at(HEAD);
    let (sequence, rest) = rest.split_at(32);
    let (time, told) = rest.split_at(64);
    let stamp = Stamp {
        sequence: u32::try_from(value(sequence)).ok()?,
        time_ns: value(time),
    };
    let is_whole = value(head) == 1 << (HEAD - 1) && value(told) == u64::from(check(stamp));
    is_whole.then_some(stamp)
}

/// 24 bits of a product in which each bit of both words tells.
fn check(stamp: Stamp) -> u32 {
    let mixed = stamp.time_ns ^ u64::from(stamp.sequence).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    let mixed = (mixed ^ mixed >> 32).wrapping_mul(0xd6e8_feb8_6659_fd93);
    let (low, high) = halves(mixed ^ mixed >> 29);
    (low ^ high) >> (32 - CHECK_BITS)
}

fn halves(value: u64) -> (u32, u32) {
    let [a, b, c, d, e, f, g, h] = value.to_le_bytes();
    (
        u32::from_le_bytes([a, b, c, d]),
        u32::from_le_bytes([e, f, g, h]),
    )
}

/// The rows of a plane that the grid takes.
fn upper_rows(rows: usize) -> usize {
    rows / 2
}

/// Colours and shades below the grid: of luma a ramp, of chroma one to the right and one down.
fn ground(component: usize, plane: &PlaneMut<'_>) -> Vec<u8> {
    let rows = plane.rows - upper_rows(plane.rows);
    let mut bytes = Vec::with_capacity(rows * plane.row_bytes);
    for y in 0..rows {
        for x in 0..plane.row_bytes {
            let (across, down) = (x * 224 / plane.row_bytes, y * 224 / rows);
            let value = match component {
                0 => 40 + (across + down) / 3,
                1 => 16 + across,
                _ => 16 + down,
            };
            bytes.push(u8::try_from(value).unwrap_or(u8::MAX));
        }
    }
    bytes
}

/// A white bar whose place follows from the time.
fn bar(plane: &mut PlaneMut<'_>, upper: usize, component: usize, time_ns: u64) {
    let len = plane.row_bytes;
    let turn = usize::try_from(time_ns / 1_000_000 % 16_000).unwrap_or_default();
    let from = turn * len / 16_000;
    let to = (from + len / 32 + 1).min(len);
    let value = if component == 0 { WHITE } else { GREY };
    for row in upper..plane.rows {
        plane.row(row)[from..to].fill(value);
    }
}

const GRID_COLUMNS: usize = 16;
const GRID_ROWS: usize = 8;
const GRID_CELLS: usize = GRID_COLUMNS * GRID_ROWS;
/// Cells before the number.
const HEAD: usize = 8;
const CHECK_BITS: u32 = 24;
const SIDE_MIN: u32 = 64;
/// Of limited range.
const WHITE: u8 = 235;
const BLACK: u8 = 16;
/// Chroma without colour.
const GREY: u8 = 128;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frame::Frame;

    fn info(sequence: u64, capture_ns: u64) -> FrameInfo {
        FrameInfo {
            sequence,
            capture_ns,
            ..FrameInfo::default()
        }
    }

    fn drawn(width: u32, height: u32, info: &FrameInfo) -> Vec<u8> {
        let pattern = Pattern::new(width, height, &["picture"]).unwrap();
        let mut bytes = vec![0; pattern.layout().size_bytes()];
        pattern.draw(&mut bytes, info).unwrap();
        bytes
    }

    #[test]
    fn each_field_carries_the_stamp() {
        let pattern = Pattern::new(65, 67, &["left", "right"]).unwrap();
        let mut bytes = vec![0; pattern.layout().size_bytes()];
        pattern.draw(&mut bytes, &info(5, 6)).unwrap();
        let frame = Frame::parse(&bytes).unwrap();
        let stamps: Vec<_> = frame.fields().map(|field| read(&field).unwrap()).collect();
        assert_eq!(stamps.len(), 2);
        assert!(stamps.iter().all(|s| (s.sequence, s.time_ns) == (5, 6)));
        assert!(Pattern::new(64, 64, &["left", "left"]).is_err());
    }

    #[test]
    fn the_stamp_is_read_back_at_each_size() {
        for (width, height) in [(64, 64), (65, 67), (320, 240), (641, 479), (1920, 1080)] {
            for stamp in [(0, 0), (1, u64::MAX), (u32::MAX, 1_234_567_890_123_456)] {
                let bytes = drawn(width, height, &info(stamp.0.into(), stamp.1));
                let frame = Frame::parse(&bytes).unwrap();
                let read = read(&frame.first()).unwrap();
                assert_eq!((read.sequence, read.time_ns), stamp, "{width}x{height}");
            }
        }
    }

    #[test]
    fn noise_is_survived_and_what_is_misread_is_told() {
        let mut state = 1_u64;
        let mut random = || {
            state = state
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1);
            i32::try_from(state >> 57).unwrap() - 64
        };
        let mut bytes = drawn(320, 240, &info(77, 1 << 50));
        let header = 192;
        for byte in &mut bytes[header..] {
            let noisy = i32::from(*byte) + random();
            *byte = u8::try_from(noisy.clamp(0, 255)).unwrap();
        }
        let frame = Frame::parse(&bytes).unwrap();
        let stamp = read(&frame.first()).unwrap();
        assert_eq!((stamp.sequence, stamp.time_ns), (77, 1 << 50));

        let cells = encode(stamp);
        for at in 0..GRID_CELLS {
            let mut other = cells;
            other[at] ^= true;
            assert_eq!(decode(&other), None, "{at}");
        }
        let mut grey = drawn(320, 240, &info(1, 1));
        grey[header..].fill(0);
        assert_eq!(read(&Frame::parse(&grey).unwrap().first()), None);
    }

    #[test]
    fn the_picture_moves() {
        let a = drawn(320, 240, &info(1, 0));
        let b = drawn(320, 240, &info(1, 1_000_000_000));
        let lower = |bytes: &[u8]| bytes[192 + 320 * 150..192 + 320 * 151].to_vec();
        assert_ne!(lower(&a), lower(&b));
        assert!(Pattern::new(63, 64, &["picture"]).is_err());
    }
}
