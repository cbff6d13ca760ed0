//! The layout of a frame: what the samples of a video item are made of, on each host and between hosts.
//!
//! All numbers are little endian. A frame begins with a header of 64 bytes, followed by one record of 128 bytes for each
//! field, followed by the planes. A field is a picture of its own; those of one frame are of one instant.
//!
//! | header | bytes | |
//! |---|---|---|
//! | 0 | 4 | `DDXF` |
//! | 4 | 2 | version, 1 |
//! | 6 | 2 | fields, 1 to 8 |
//! | 8 | 8 | sequence number of the frame at its source, from 1 |
//! | 16 | 8 | capture time, ns, by the source's clock |
//! | 24 | 8 | exposure, ns; 0 is unknown |
//! | 32 | 1 | that clock: 0 the host's, 1 the recording's (0 is its first frame), 2 UTC |
//! | 33 | 3 | 0 |
//! | 36 | 4 | flags: 1 key frame of a source that has such, 2 incomplete, 4 concealed |
//! | 40 | 4 | bytes of the whole frame |
//! | 44 | 20 | 0 |
//!
//! | record | bytes | |
//! |---|---|---|
//! | 0 | 24 | name, UTF-8, filled with zeros |
//! | 24 | 1 | pixel format, as numbered below |
//! | 25 | 1 | pixel format in which it was captured: converting adds no information |
//! | 26 | 1 | range: 0 limited (16-235), 1 full |
//! | 27 | 1 | matrix: 0 BT.601, 1 BT.709 |
//! | 28 | 1 | siting of chroma: 0 left, 1 centre, 2 top left |
//! | 29 | 1 | scan: 0 progressive, 1 top line first, 2 bottom line first |
//! | 30 | 2 | 0 |
//! | 32 | 4 + 4 | width and height, pixels |
//! | 40 | 8 | sequence number of the frame that it was made from; the frame's own unless derived |
//! | 48 | 8 | capture time, ns, by the same clock |
//! | 56 | 3 * 8 | planes: offset in the frame, and bytes from row to row |
//! | 80 | 48 | 0 |
//!
//! What is 0 here is ignored by readers, so that a later source may use it.

use std::fmt;

use crate::Error;
use crate::format::{PLANES_MAX, PixelFormat, PlaneSize};

/// Most fields of a frame.
pub const FIELDS_MAX: usize = 8;
/// Longest name of a field, bytes.
pub const FIELD_NAME_MAX: usize = 24;

const MAGIC: [u8; 4] = *b"DDXF";
const VERSION: u16 = 1;
const HEADER_BYTES: usize = 64;
const RECORD_BYTES: usize = 128;
/// Planes begin at a cache line.
const ALIGN: usize = 64;

/// How the numbers of a picture mean colours.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Colour {
    /// Which numbers are black and white.
    pub range: Range,
    /// How luma and chroma follow from red, green and blue.
    pub matrix: Matrix,
    /// Where chroma samples lie.
    pub siting: Siting,
}

/// Which numbers are black and white.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Range {
    /// Luma 16 to 235, chroma 16 to 240, of 8 bits.
    #[default]
    Limited,
    /// 0 to 255.
    Full,
}

/// How luma and chroma follow from red, green and blue.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Matrix {
    /// ITU-R BT.601.
    #[default]
    Bt601,
    /// ITU-R BT.709.
    Bt709,
}

/// Where chroma samples lie that stand for several pixels.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Siting {
    /// Level with the left pixel, between the rows (MPEG-2, H.264).
    #[default]
    Left,
    /// In the middle of the pixels (JPEG, MPEG-1).
    Centre,
    /// On the upper left pixel (DV, BT.2020).
    TopLeft,
}

/// Which lines were captured together.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Scan {
    /// All.
    #[default]
    Progressive,
    /// Every second one; the upper ones first.
    TopFirst,
    /// Every second one; the lower ones first.
    BottomFirst,
}

/// By which clock a source tells its capture times.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum CaptureClock {
    /// The monotonic clock of the host where it was captured.
    #[default]
    Host,
    /// The time since the first frame of a recording.
    Recording,
    /// UTC, since 1970.
    Utc,
}

/// What holds for a whole frame.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct FrameInfo {
    /// Number of the frame at its source, from 1.
    pub sequence: u64,
    /// When it was captured, ns.
    pub capture_ns: u64,
    /// By which clock.
    pub clock: CaptureClock,
    /// How long it was exposed, ns; 0 where unknown.
    pub exposure_ns: u64,
    /// What a receiver must know.
    pub flags: Flags,
}

/// What a receiver must know of a frame.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Flags {
    /// Decodes without others.
    pub key: bool,
    /// Some of it never arrived.
    pub incomplete: bool,
    /// What was missing was made up.
    pub concealed: bool,
}

/// What holds for a field of each frame of a stream.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FieldSpec<'a> {
    /// Its name, of at most [`FIELD_NAME_MAX`] bytes.
    pub name: &'a str,
    /// How its components lie.
    pub format: PixelFormat,
    /// How they did when it was captured.
    pub native: PixelFormat,
    /// Pixels in a row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// What its numbers mean.
    pub colour: Colour,
    /// Which lines belong together.
    pub scan: Scan,
}

/// A field as a frame's header describes it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FieldInfo {
    name: [u8; FIELD_NAME_MAX],
    /// How its components lie.
    pub format: PixelFormat,
    /// How they did when it was captured.
    pub native: PixelFormat,
    /// Pixels in a row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// What its numbers mean.
    pub colour: Colour,
    /// Which lines belong together.
    pub scan: Scan,
    /// Number of the frame that it was made from.
    pub sequence: u64,
    /// When it was captured, ns.
    pub capture_ns: u64,
    planes: [Place; PLANES_MAX],
    count: usize,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Place {
    offset: usize,
    stride: usize,
    size: PlaneSize,
}

/// Where everything lies in the frames of a stream: made once, written into each of them.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Layout {
    fields: Vec<FieldInfo>,
    size_bytes: usize,
}

/// A frame in somebody's memory, checked; nothing is copied but its header.
#[derive(Clone, Debug)]
pub struct Frame<'a> {
    bytes: &'a [u8],
    info: FrameInfo,
    fields: Vec<FieldInfo>,
}

/// One picture of a frame.
#[derive(Clone, Copy, Debug)]
pub struct Field<'a> {
    bytes: &'a [u8],
    /// What it is.
    pub info: FieldInfo,
}

/// The rows of one component, or of several interleaved ones.
#[derive(Clone, Copy, Debug)]
pub struct Plane<'a> {
    /// From the first row's beginning to the last row's end.
    pub bytes: &'a [u8],
    /// Bytes from row to row.
    pub stride: usize,
    /// Bytes of a row.
    pub row_bytes: usize,
    /// Rows.
    pub rows: usize,
}

/// A plane to be filled.
#[derive(Debug)]
pub struct PlaneMut<'a> {
    /// From the first row's beginning to the last row's end.
    pub bytes: &'a mut [u8],
    /// Bytes from row to row.
    pub stride: usize,
    /// Bytes of a row.
    pub row_bytes: usize,
    /// Rows.
    pub rows: usize,
}

impl<'a> FieldSpec<'a> {
    /// A picture of colours that are coded as is usual.
    pub fn new(name: &'a str, format: PixelFormat, width: u32, height: u32) -> Self {
        Self {
            name,
            format,
            native: format,
            width,
            height,
            colour: Colour::default(),
            scan: Scan::Progressive,
        }
    }
}

impl FieldInfo {
    /// Its name.
    pub fn name(&self) -> &str {
        let end = self.name.iter().position(|byte| *byte == 0);
        let name = &self.name[..end.unwrap_or(FIELD_NAME_MAX)];
        std::str::from_utf8(name).unwrap_or_default()
    }

    /// What it was made from.
    pub fn spec(&self) -> FieldSpec<'_> {
        FieldSpec {
            name: self.name(),
            format: self.format,
            native: self.native,
            width: self.width,
            height: self.height,
            colour: self.colour,
            scan: self.scan,
        }
    }

    fn places(&self) -> &[Place] {
        &self.planes[..self.count]
    }
}

impl Layout {
    /// Lays out frames of these fields, rows without padding.
    ///
    /// # Errors
    /// [`Error::Fields`] for none or too many, [`Error::FieldName`] for a name that is empty, too long or given twice,
    /// [`Error::Size`] for a size that cannot be.
    pub fn new(fields: &[FieldSpec<'_>]) -> Result<Self, Error> {
        if fields.is_empty() || fields.len() > FIELDS_MAX {
            return Err(Error::Fields(fields.len()));
        }
        let mut end = HEADER_BYTES + fields.len() * RECORD_BYTES;
        let mut infos: Vec<FieldInfo> = Vec::with_capacity(fields.len());
        for spec in fields {
            let bytes = spec.name.as_bytes();
            let is_known = infos.iter().any(|info| info.name() == spec.name);
            if bytes.is_empty() || bytes.len() > FIELD_NAME_MAX || bytes.contains(&0) || is_known {
                return Err(Error::FieldName(spec.name.to_owned()));
            }
            let (width, height) = (spec.width, spec.height);
            let sizes = spec.format.planes(width, height)?;
            let mut info = FieldInfo {
                name: [0; FIELD_NAME_MAX],
                format: spec.format,
                native: spec.native,
                width,
                height,
                colour: spec.colour,
                scan: spec.scan,
                sequence: 0,
                capture_ns: 0,
                planes: Default::default(),
                count: sizes.as_slice().len(),
            };
            info.name[..bytes.len()].copy_from_slice(bytes);
            for (place, size) in info.planes.iter_mut().zip(sizes.as_slice()) {
                let offset = end.next_multiple_of(ALIGN);
                let stride = bytes_of(size.row_bytes);
                *place = Place {
                    offset,
                    stride,
                    size: *size,
                };
                end = offset + stride * bytes_of(size.rows);
            }
            infos.push(info);
        }
        match u32::try_from(end) {
            Ok(_) => Ok(Self {
                fields: infos,
                size_bytes: end,
            }),
            Err(_) => Err(Error::TooLarge(end)),
        }
    }

    /// Bytes of a frame.
    pub fn size_bytes(&self) -> usize {
        self.size_bytes
    }

    /// The fields.
    pub fn fields(&self) -> &[FieldInfo] {
        &self.fields
    }

    /// Writes the header of a frame whose fields are all of its own instant. `bytes` are the frame's; the planes are left
    /// as they are.
    ///
    /// # Errors
    /// [`Error::Capacity`] when `bytes` are not as many as [`Layout::size_bytes`].
    pub fn write_header(&self, bytes: &mut [u8], info: &FrameInfo) -> Result<(), Error> {
        self.write_derived(bytes, info, &[])
    }

    /// The same for a frame some of whose fields were made from others: of the first fields the number and the capture time
    /// of what each was made from.
    ///
    /// # Errors
    /// As [`Layout::write_header`].
    pub fn write_derived(
        &self,
        bytes: &mut [u8],
        info: &FrameInfo,
        origins: &[(u64, u64)],
    ) -> Result<(), Error> {
        if bytes.len() != self.size_bytes {
            return Err(Error::Capacity {
                size: self.size_bytes,
                capacity: bytes.len(),
            });
        }
        let flag = |is_set: bool, bit: u32| if is_set { bit } else { 0 };
        let Flags {
            key,
            incomplete,
            concealed,
        } = info.flags;
        let mut out = Put { bytes, at: 0 };
        out.put(&MAGIC);
        out.put(&VERSION.to_le_bytes());
        out.put(&count_of(self.fields.len()).to_le_bytes());
        out.put(&info.sequence.to_le_bytes());
        out.put(&info.capture_ns.to_le_bytes());
        out.put(&info.exposure_ns.to_le_bytes());
        out.put(&[info.clock.code(), 0, 0, 0]);
        out.put(&(flag(key, 1) | flag(incomplete, 2) | flag(concealed, 4)).to_le_bytes());
        out.put(&word_of(self.size_bytes).to_le_bytes());
        out.put(&[0; 20]);
        for (index, field) in self.fields.iter().enumerate() {
            let own = (info.sequence, info.capture_ns);
            let (sequence, capture_ns) = origins.get(index).copied().unwrap_or(own);
            let colour = field.colour;
            out.put(&field.name);
            out.put(&[
                code(field.format),
                code(field.native),
                colour.range.code(),
                colour.matrix.code(),
                colour.siting.code(),
                field.scan.code(),
                0,
                0,
            ]);
            out.put(&field.width.to_le_bytes());
            out.put(&field.height.to_le_bytes());
            out.put(&sequence.to_le_bytes());
            out.put(&capture_ns.to_le_bytes());
            for place in &field.planes {
                out.put(&word_of(place.offset).to_le_bytes());
                out.put(&word_of(place.stride).to_le_bytes());
            }
            out.put(&[0; 48]);
        }
        Ok(())
    }

    /// The planes of a field of a frame that has this layout, to be filled.
    ///
    /// # Panics
    /// When the field does not exist or `bytes` are fewer than [`Layout::size_bytes`].
    pub fn planes_mut<'b>(&self, bytes: &'b mut [u8], field: usize) -> Vec<PlaneMut<'b>> {
        let mut planes = Vec::with_capacity(PLANES_MAX);
        let (mut rest, mut taken) = (bytes, 0);
        for place in self.fields[field].places() {
            let (_, from) = rest.split_at_mut(place.offset - taken);
            let (bytes, behind) = from.split_at_mut(place.len());
            (rest, taken) = (behind, place.offset + place.len());
            planes.push(PlaneMut {
                bytes,
                stride: place.stride,
                row_bytes: bytes_of(place.size.row_bytes),
                rows: bytes_of(place.size.rows),
            });
        }
        planes
    }
}

impl<'a> Frame<'a> {
    /// Checks a frame. The header is copied once; the memory of the planes may change at any time, their places not.
    ///
    /// # Errors
    /// [`Error::Frame`], which says what is wrong.
    pub fn parse(bytes: &'a [u8]) -> Result<Self, Error> {
        let mut input = Get { bytes, at: 0 };
        if input.take::<4>()? != MAGIC {
            return Err(Error::Frame("it does not begin with `DDXF`"));
        }
        if u16::from_le_bytes(input.take()?) != VERSION {
            return Err(Error::Frame("its version is not 1"));
        }
        let count = usize::from(u16::from_le_bytes(input.take()?));
        if !(1..=FIELDS_MAX).contains(&count) {
            return Err(Error::Frame("it has no field, or more than 8"));
        }
        let (sequence, capture_ns, exposure_ns) = (input.long()?, input.long()?, input.long()?);
        let [clock, ..] = input.take::<4>()?;
        let flags = input.word()?;
        let info = FrameInfo {
            sequence,
            capture_ns,
            clock: CaptureClock::of(clock)?,
            exposure_ns,
            flags: Flags {
                key: flags & 1 != 0,
                incomplete: flags & 2 != 0,
                concealed: flags & 4 != 0,
            },
        };
        if bytes_of(input.word()?) != bytes.len() {
            return Err(Error::Frame("it is not as long as it says"));
        }
        input.take::<20>()?;
        let mut fields: Vec<FieldInfo> = Vec::with_capacity(count);
        for _ in 0..count {
            let field = FieldInfo::parse(&mut input, bytes.len())?;
            if fields.iter().any(|other| other.name() == field.name()) {
                return Err(Error::Frame("two fields have one name"));
            }
            fields.push(field);
        }
        Ok(Self {
            bytes,
            info,
            fields,
        })
    }

    /// What holds for all of it.
    pub fn info(&self) -> &FrameInfo {
        &self.info
    }

    /// Its pictures, at least one.
    pub fn fields(&self) -> impl ExactSizeIterator<Item = Field<'a>> {
        let bytes = self.bytes;
        self.fields
            .iter()
            .map(move |info| Field { bytes, info: *info })
    }

    /// The first picture: the only one of most frames.
    pub fn first(&self) -> Field<'a> {
        Field {
            bytes: self.bytes,
            info: self.fields[0],
        }
    }

    /// The picture of that name.
    pub fn field(&self, name: &str) -> Option<Field<'a>> {
        self.fields().find(|field| field.info.name() == name)
    }

    /// The layout that it has.
    pub fn layout(&self) -> Layout {
        Layout {
            fields: self.fields.clone(),
            size_bytes: self.bytes.len(),
        }
    }
}

impl<'a> Field<'a> {
    /// Its planes, in the order of their components.
    pub fn planes(&self) -> impl ExactSizeIterator<Item = Plane<'a>> + use<'a> {
        let (bytes, info) = (self.bytes, self.info);
        (0..info.count).map(move |index| {
            let place = info.planes[index];
            Plane {
                bytes: &bytes[place.offset..place.offset + place.len()],
                stride: place.stride,
                row_bytes: bytes_of(place.size.row_bytes),
                rows: bytes_of(place.size.rows),
            }
        })
    }

    /// One of its planes.
    pub fn plane(&self, index: usize) -> Option<Plane<'a>> {
        self.planes().nth(index)
    }
}

impl<'a> Plane<'a> {
    /// Its rows, without padding.
    pub fn rows(&self) -> impl ExactSizeIterator<Item = &'a [u8]> + use<'a> {
        let (bytes, stride, len) = (self.bytes, self.stride, self.row_bytes);
        (0..self.rows).map(move |row| &bytes[row * stride..row * stride + len])
    }
}

impl PlaneMut<'_> {
    /// One row, without padding.
    pub fn row(&mut self, row: usize) -> &mut [u8] {
        &mut self.bytes[row * self.stride..][..self.row_bytes]
    }
}

impl Place {
    /// Bytes from the first row's beginning to the last row's end.
    fn len(&self) -> usize {
        let (rows, row) = (bytes_of(self.size.rows), bytes_of(self.size.row_bytes));
        (rows - 1) * self.stride + row
    }
}

impl FieldInfo {
    fn parse(input: &mut Get<'_>, frame_bytes: usize) -> Result<Self, Error> {
        let name = input.take::<FIELD_NAME_MAX>()?;
        let end = name.iter().position(|byte| *byte == 0);
        let is_filled = name[end.unwrap_or(FIELD_NAME_MAX)..]
            .iter()
            .all(|b| *b == 0);
        let text = std::str::from_utf8(&name[..end.unwrap_or(FIELD_NAME_MAX)]);
        if !is_filled || text.is_err() || text == Ok("") {
            return Err(Error::Frame("a field has no proper name"));
        }
        let [format, native, range, matrix, siting, scan, ..] = input.take::<8>()?;
        let (width, height) = (input.word()?, input.word()?);
        let (sequence, capture_ns) = (input.long()?, input.long()?);
        let format = format_of(format)?;
        let sizes = format
            .planes(width, height)
            .map_err(|_| Error::Frame("a field has a size that cannot be"))?;
        let mut planes = [Place::default(); PLANES_MAX];
        for (index, place) in planes.iter_mut().enumerate() {
            let (offset, stride) = (bytes_of(input.word()?), bytes_of(input.word()?));
            let Some(size) = sizes.as_slice().get(index).copied() else {
                continue;
            };
            let rest = (bytes_of(size.rows) - 1).checked_mul(stride);
            let end = rest.and_then(|rest| {
                rest.checked_add(offset)?
                    .checked_add(bytes_of(size.row_bytes))
            });
            if stride < bytes_of(size.row_bytes) || end.is_none_or(|end| end > frame_bytes) {
                return Err(Error::Frame("a plane does not lie within it"));
            }
            *place = Place {
                offset,
                stride,
                size,
            };
        }
        input.take::<48>()?;
        Ok(Self {
            name,
            format,
            native: format_of(native)?,
            width,
            height,
            colour: Colour {
                range: Range::of(range)?,
                matrix: Matrix::of(matrix)?,
                siting: Siting::of(siting)?,
            },
            scan: Scan::of(scan)?,
            sequence,
            capture_ns,
            planes,
            count: sizes.as_slice().len(),
        })
    }
}

/// Numbers of the variants, as written above.
macro_rules! codes {
    ($name:ident, $what:literal: $($code:literal $variant:ident),+) => {
        impl $name {
            fn code(self) -> u8 {
                match self {
                    $(Self::$variant => $code),+
                }
            }

            fn of(code: u8) -> Result<Self, Error> {
                match code {
                    $($code => Ok(Self::$variant),)+
                    _ => Err(Error::Frame(concat!("its ", $what, " is not known"))),
                }
            }
        }
    };
}

codes!(Range, "range": 0 Limited, 1 Full);
codes!(Matrix, "matrix": 0 Bt601, 1 Bt709);
codes!(Siting, "siting of chroma": 0 Left, 1 Centre, 2 TopLeft);
codes!(Scan, "scan": 0 Progressive, 1 TopFirst, 2 BottomFirst);
codes!(CaptureClock, "clock": 0 Host, 1 Recording, 2 Utc);

/// Pixel formats are numbered from 1, in the order of [`PixelFormat::ALL`].
fn code(format: PixelFormat) -> u8 {
    let at = PixelFormat::ALL.iter().position(|other| *other == format);
    at.and_then(|at| u8::try_from(at + 1).ok())
        .unwrap_or_default()
}

fn format_of(code: u8) -> Result<PixelFormat, Error> {
    let index = usize::from(code).checked_sub(1);
    let format = index.and_then(|index| PixelFormat::ALL.get(index));
    format
        .copied()
        .ok_or(Error::Frame("its pixel format is not known"))
}

fn bytes_of(count: u32) -> usize {
    usize::try_from(count).unwrap_or(usize::MAX)
}

/// Layouts are made of what fits.
fn word_of(bytes: usize) -> u32 {
    u32::try_from(bytes).unwrap_or(u32::MAX)
}

fn count_of(fields: usize) -> u16 {
    u16::try_from(fields).unwrap_or(u16::MAX)
}

struct Put<'a> {
    bytes: &'a mut [u8],
    at: usize,
}

impl Put<'_> {
    fn put(&mut self, part: &[u8]) {
        self.bytes[self.at..self.at + part.len()].copy_from_slice(part);
        self.at += part.len();
    }
}

struct Get<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl Get<'_> {
    fn take<const N: usize>(&mut self) -> Result<[u8; N], Error> {
        let part = self.bytes.get(self.at..self.at + N);
        self.at += N;
        part.and_then(|part| part.try_into().ok())
            .ok_or(Error::Frame("it ends within its header"))
    }

    fn word(&mut self) -> Result<u32, Error> {
        Ok(u32::from_le_bytes(self.take()?))
    }

    fn long(&mut self) -> Result<u64, Error> {
        Ok(u64::from_le_bytes(self.take()?))
    }
}

impl fmt::Display for FieldInfo {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}x{} {}", self.width, self.height, self.format)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn stereo() -> Layout {
        Layout::new(&[
            FieldSpec::new("left", PixelFormat::I420, 5, 3),
            FieldSpec {
                native: PixelFormat::Yuyv,
                colour: Colour {
                    range: Range::Full,
                    matrix: Matrix::Bt709,
                    siting: Siting::TopLeft,
                },
                scan: Scan::BottomFirst,
                ..FieldSpec::new("range", PixelFormat::Grey16, 7, 2)
            },
            FieldSpec::new("right", PixelFormat::I420, 5, 3),
        ])
        .unwrap()
    }

    fn info() -> FrameInfo {
        FrameInfo {
            sequence: 7,
            capture_ns: 1 << 40,
            clock: CaptureClock::Recording,
            exposure_ns: 10_000,
            flags: Flags {
                key: true,
                incomplete: false,
                concealed: true,
            },
        }
    }

    #[test]
    fn what_is_written_is_read_in_place() {
        let layout = stereo();
        let mut bytes = vec![0; layout.size_bytes()];
        let origins = [(7, 1), (5, 2)];
        layout.write_derived(&mut bytes, &info(), &origins).unwrap();
        for field in 0..3_u8 {
            for (index, plane) in layout
                .planes_mut(&mut bytes, field.into())
                .into_iter()
                .enumerate()
            {
                plane.bytes.fill(16 * field + u8::try_from(index).unwrap());
            }
        }

        let frame = Frame::parse(&bytes).unwrap();
        assert_eq!(*frame.info(), info());
        assert_eq!(frame.fields().len(), 3);
        let range = frame.field("range").unwrap();
        assert_eq!(range.info.spec(), layout.fields()[1].spec());
        assert_eq!((range.info.sequence, range.info.capture_ns), (5, 2));
        let right = frame.field("right").unwrap();
        assert_eq!((right.info.sequence, right.info.capture_ns), (7, 1 << 40));
        let chroma = right.plane(2).unwrap();
        assert_eq!((chroma.row_bytes, chroma.rows), (3, 2));
        assert!(chroma.rows().all(|row| row == [34; 3]));
        assert!(right.plane(3).is_none());
        assert_eq!(range.planes().len(), 1);
        assert_eq!(frame.layout().size_bytes(), layout.size_bytes());
    }

    #[test]
    fn what_cannot_be_laid_out_is_an_error() {
        let grey = |name| FieldSpec::new(name, PixelFormat::Grey8, 4, 4);
        assert!(matches!(Layout::new(&[]), Err(Error::Fields(0))));
        let nine = Layout::new(&[grey("a"); 9]);
        assert!(matches!(nine, Err(Error::Fields(9))));
        for name in ["", "a name of more than 24 bytes", "nul\0", "a"] {
            let error = Layout::new(&[grey("a"), grey(name)]).unwrap_err();
            assert!(matches!(error, Error::FieldName(_)), "{error}");
        }
        let huge = FieldSpec::new("a", PixelFormat::Rgba, 32_767, 32_767);
        assert!(Layout::new(&[huge]).is_ok());
        let huge = [huge, FieldSpec { name: "b", ..huge }];
        assert!(matches!(Layout::new(&huge), Err(Error::TooLarge(_))));
        let layout = stereo();
        let mut short = vec![0; layout.size_bytes() - 1];
        let error = layout.write_header(&mut short, &info());
        assert!(matches!(error, Err(Error::Capacity { .. })));
    }

    /// Each byte of the header is set to what it must not be, to what it may be, and to what lies at a limit.
    #[test]
    fn no_header_leads_out_of_the_frame() {
        let layout = stereo();
        let mut good = vec![0; layout.size_bytes()];
        layout.write_header(&mut good, &info()).unwrap();
        let header = HEADER_BYTES + 3 * RECORD_BYTES;
        let mut refused = 0;
        for at in 0..header {
            for value in [0, 1, 2, 3, 0x7f, 0x80, 0xff] {
                let mut bytes = good.clone();
                bytes[at] = value;
                match Frame::parse(&bytes) {
                    Ok(frame) => {
                        let read: usize = frame
                            .fields()
                            .flat_map(|field| field.planes())
                            .flat_map(|plane| plane.rows())
                            .map(<[u8]>::len)
                            .sum();
                        assert!(read > 0);
                    }
                    Err(_) => refused += 1,
                }
            }
        }
        assert!(refused > 300, "{refused}");
        for len in 0..good.len() {
            assert!(Frame::parse(&good[..len]).is_err(), "{len}");
        }
    }
}
