//! Files of uncompressed video: YUV4MPEG2, as mjpegtools' `yuv4mpeg(5)` describes it and ffmpeg reads and writes it.
//!
//! Components are kept bit for bit. What the format has no word for stands in parameters of its own, which others ignore:
//!
//! | parameter | where | |
//! |---|---|---|
//! | `XDDX_FORMAT=NV12` | stream | the pixel format that the planes of the file were taken from |
//! | `XDDX_FIELDS=left:480,right:480` | stream | fields that are stacked in the file's picture, with their heights |
//! | `XDDX_MATRIX=709` | stream | the matrix, unless it is BT.601 |
//! | `XDDX_NS=40000000` | frame | nanoseconds since the first frame |
//! | `XDDX_SEQ=2` | frame | number of the frame at its source |
//!
//! A format that interleaves components is stored as planes: NV12 as `C420`, YUYV and UYVY as `C422`, RGB24, BGR24 and HSY as
//! `C444`, RGBA as `C444alpha`. Of RGB and HSY other players show the wrong colours.

use std::io::{self, BufRead, Write};

use crate::Error;
use crate::components::{components, fill, rows};
use crate::format::PixelFormat;
use crate::frame::{Colour, FieldInfo, FieldSpec, Frame, Layout, Matrix, Range, Scan, Siting};

/// What holds for all frames of a file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Header {
    /// Fields, from the top, alike but for their names and heights.
    pub fields: Vec<(String, u32)>,
    /// Pixels in a row.
    pub width: u32,
    /// How the components lie in frames made of the file.
    pub format: PixelFormat,
    /// What the numbers mean.
    pub colour: Colour,
    /// Which lines belong together.
    pub scan: Scan,
    /// Frames per second, as a fraction, where it is known.
    pub rate: Option<(u32, u32)>,
    /// Width to height of a pixel, as a fraction, where it is known.
    pub aspect: Option<(u32, u32)>,
}

/// What is told of one frame.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Mark {
    /// Nanoseconds since the first frame.
    pub time_ns: Option<u64>,
    /// Its number at its source.
    pub sequence: Option<u64>,
}

/// Reads frames from a stream of bytes.
#[derive(Debug)]
pub struct Reader<R> {
    input: R,
    header: Header,
    coded: Coded,
    layout: Layout,
    frames: u64,
    row: Vec<u8>,
    /// Components of more than 8 bits, as they are in the file.
    wide: Vec<u8>,
}

/// What a file has that frames here have not.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Coded {
    /// Bits of a component, in two bytes when more than 8.
    bits: u32,
    /// Opacity behind the other components.
    has_opacity: bool,
}

/// Writes frames to a stream of bytes.
#[derive(Debug)]
pub struct Writer<W> {
    output: W,
    header: Header,
    row: Vec<u8>,
}

impl Header {
    /// The header of a file for frames of this layout.
    ///
    /// # Errors
    /// [`Error::Stacked`] when the fields are not alike: then they have no common picture.
    pub fn of(layout: &Layout, rate: Option<(u32, u32)>) -> Result<Self, Error> {
        let fields = layout.fields();
        let first = &fields[0];
        let is_alike = |field: &FieldInfo| {
            let (a, b) = (field.spec(), first.spec());
            (a.format, a.width, a.colour, a.scan) == (b.format, b.width, b.colour, b.scan)
        };
        // Chroma of an odd field would not lie below that of the one above.
        let halves = matches!(first.format, PixelFormat::I420 | PixelFormat::Nv12);
        let down = if halves { 2 } else { 1 };
        let is_even = fields.len() == 1 || fields.iter().all(|f| f.height.is_multiple_of(down));
        if !is_even || !fields.iter().all(is_alike) {
            return Err(Error::Stacked);
        }
        let named = fields.iter().map(|f| (f.name().to_owned(), f.height));
        Ok(Self {
            fields: named.collect(),
            width: first.width,
            format: first.format,
            colour: first.colour,
            scan: first.scan,
            rate,
            aspect: None,
        })
    }

    /// The layout of its frames.
    ///
    /// # Errors
    /// As [`Layout::new`].
    pub fn layout(&self) -> Result<Layout, Error> {
        let fields = self.fields.iter().map(|(name, height)| FieldSpec {
            colour: self.colour,
            scan: self.scan,
            ..FieldSpec::new(name, self.format, self.width, *height)
        });
        Layout::new(&fields.collect::<Vec<_>>())
    }

    /// Rows of the file's picture: of all fields.
    pub fn height(&self) -> u32 {
        self.fields.iter().map(|(_, height)| height).sum()
    }

    fn line(&self) -> String {
        let mut line = format!("YUV4MPEG2 W{} H{}", self.width, self.height());
        let fraction = |letter: char, of: Option<(u32, u32)>| {
            let (over, under) = of.unwrap_or_default();
            format!(" {letter}{over}:{under}")
        };
        line += &fraction('F', self.rate);
        line += match self.scan {
            Scan::Progressive => " Ip",
            Scan::TopFirst => " It",
            Scan::BottomFirst => " Ib",
        };
        line += &fraction('A', self.aspect);
        line += " C";
        line += match (self.format, self.colour.siting) {
            (PixelFormat::I420 | PixelFormat::Nv12, Siting::Left) => "420mpeg2",
            (PixelFormat::I420 | PixelFormat::Nv12, Siting::Centre) => "420jpeg",
            (PixelFormat::I420 | PixelFormat::Nv12, Siting::TopLeft) => "420paldv",
            _ => tag_of(self.format),
        };
        if self.format == PixelFormat::I411 {
            // Older programs look for this one.
            line += " XYSCSS=411";
        }
        line += match self.colour.range {
            Range::Limited => " XCOLORRANGE=LIMITED",
            Range::Full => " XCOLORRANGE=FULL",
        };
        if self.colour.matrix == Matrix::Bt709 {
            line += " XDDX_MATRIX=709";
        }
        if format_of_tag(tag_of(self.format)).is_none_or(|(format, _)| format != self.format) {
            line += &format!(" XDDX_FORMAT={}", self.format);
        }
        let plain = [(FIELD.to_owned(), self.height())];
        if self.fields != plain {
            let fields = self
                .fields
                .iter()
                .map(|(name, h)| format!("{}:{h}", quoted(name)));
            line += &format!(" XDDX_FIELDS={}", fields.collect::<Vec<_>>().join(","));
        }
        line.push('\n');
        line
    }

    fn parse(line: &str) -> Result<(Self, Coded), Error> {
        let mut words = line.split(' ');
        if words.next() != Some(MAGIC) {
            return Err(Error::Y4m("it does not begin with `YUV4MPEG2 `".to_owned()));
        }
        let (mut width, mut height, mut fields) = (0, 0, None);
        let (mut tag, mut own, mut scss) = (None, None, None);
        let mut colour = Colour::default();
        let (mut scan, mut rate, mut aspect) = (Scan::Progressive, None, None);
        for word in words.filter(|word| !word.is_empty()) {
            let bad = || Error::Y4m(format!("`{word}` in its header cannot be read"));
            let mut chars = word.chars();
            let letter = chars.next();
            let value = chars.as_str();
            match letter {
                Some('W') => width = value.parse().map_err(|_| bad())?,
                Some('H') => height = value.parse().map_err(|_| bad())?,
                Some('F') => rate = fraction(value).ok_or_else(bad)?,
                Some('A') => aspect = fraction(value).ok_or_else(bad)?,
                Some('I') => {
                    scan = match value {
                        "p" | "?" | "" => Scan::Progressive,
                        "t" | "m" => Scan::TopFirst,
                        "b" => Scan::BottomFirst,
                        _ => return Err(bad()),
                    }
                }
                Some('C') => tag = Some(value),
                Some('X') => match value.split_once('=') {
                    Some(("YSCSS", value)) => scss = Some(value),
                    Some(("COLORRANGE", "FULL")) => colour.range = Range::Full,
                    Some(("DDX_MATRIX", "709")) => colour.matrix = Matrix::Bt709,
                    Some(("DDX_FORMAT", value)) => own = Some(value.parse()?),
                    Some(("DDX_FIELDS", value)) => fields = Some(stacked(value).ok_or_else(bad)?),
                    // Somebody else's.
                    _ => {}
                },
                _ => return Err(bad()),
            }
        }
        let tag = tag.unwrap_or(match scss {
            Some("411") => "411",
            Some("422") => "422",
            Some("444") => "444",
            Some(_) | None => "420jpeg",
        });
        let (format, coded) = format_of_tag(tag).ok_or_else(|| Error::Chroma(tag.to_owned()))?;
        colour.siting = match tag {
            "420jpeg" | "420" => Siting::Centre,
            "420paldv" => Siting::TopLeft,
            _ => Siting::Left,
        };
        let mut coded = coded;
        let format = match own {
            Some(PixelFormat::Rgba) if tag == tag_of(PixelFormat::Rgba) => {
                coded.has_opacity = false;
                PixelFormat::Rgba
            }
            Some(own) if format_of_tag(tag_of(own)) == Some((format, coded)) => own,
            Some(own) => {
                let why = format!("its header says {own} and `C{tag}`, which do not go together");
                return Err(Error::Y4m(why));
            }
            None => format,
        };
        let fields = fields.unwrap_or_else(|| vec![(FIELD.to_owned(), height)]);
        let sum = fields
            .iter()
            .try_fold(0_u32, |sum, (_, h)| sum.checked_add(*h));
        if sum != Some(height) {
            return Err(Error::Y4m(
                "its fields are not as high as its picture".to_owned(),
            ));
        }
        let header = Self {
            fields,
            width,
            format,
            colour,
            scan,
            rate,
            aspect,
        };
        header.layout()?;
        format.planes(width, height)?;
        Ok((header, coded))
    }
}

impl<R: BufRead> Reader<R> {
    /// Reads the header.
    ///
    /// # Errors
    /// [`Error::Empty`] when nothing comes at all, [`Error::Foreign`] for something else than Y4M, [`Error::Y4m`] for a header
    /// that cannot be read, [`Error::Chroma`] for pixels that no format has, [`Error::Read`] of the input.
    pub fn new(mut input: R) -> Result<Self, Error> {
        let line = match line_of(&mut input, HEADER_MAX)? {
            Line::End => return Err(Error::Empty),
            Line::Whole(line) if line.starts_with(MAGIC.as_bytes()) => line,
            Line::Part(start) if start.starts_with(MAGIC.as_bytes()) => {
                return Err(Error::Y4m("its first line does not end".to_owned()));
            }
            Line::Whole(start) | Line::Part(start) => {
                return Err(Error::Foreign(looks_like(&start)));
            }
        };
        let text = String::from_utf8(line);
        let text = text.map_err(|_| Error::Y4m("its header is not text".to_owned()))?;
        let (header, coded) = Header::parse(&text)?;
        Ok(Self {
            input,
            layout: header.layout()?,
            header,
            coded,
            frames: 0,
            row: Vec::new(),
            wide: Vec::new(),
        })
    }

    /// What the file has that its frames here have not, if anything.
    pub fn left_out(&self) -> Option<String> {
        let Coded { bits, has_opacity } = self.coded;
        match (bits, has_opacity) {
            (8, false) => None,
            (8, true) => Some("its opacity is left out".to_owned()),
            _ => Some(format!("its components of {bits} bits are rounded to 8")),
        }
    }

    /// What holds for all frames.
    pub fn header(&self) -> &Header {
        &self.header
    }

    /// The layout of the frames.
    pub fn layout(&self) -> &Layout {
        &self.layout
    }

    /// Whether no frame follows.
    ///
    /// # Errors
    /// [`Error::Read`].
    pub fn is_at_end(&mut self) -> Result<bool, Error> {
        match self.input.fill_buf() {
            Ok(bytes) => Ok(bytes.is_empty()),
            Err(error) if error.kind() == io::ErrorKind::Interrupted => Ok(false),
            Err(error) => Err(Error::Read(error)),
        }
    }

    /// Reads the line before the next frame; `None` at the end of the file. The frame's planes follow, by
    /// [`Reader::read_planes`].
    ///
    /// # Errors
    /// [`Error::Truncated`] and [`Error::NoFrame`], which name the frame; [`Error::Read`].
    pub fn next_mark(&mut self) -> Result<Option<Mark>, Error> {
        self.frames += 1;
        let line = match line_of(&mut self.input, HEADER_MAX)? {
            Line::End => return Ok(None),
            Line::Whole(line) => line,
            Line::Part(start) if start.len() < HEADER_MAX => {
                return Err(Error::Truncated(self.frames));
            }
            Line::Part(_) => return Err(Error::NoFrame(self.frames)),
        };
        let text = std::str::from_utf8(&line).unwrap_or_default();
        let mut words = text.split(' ');
        if words.next() != Some("FRAME") {
            return Err(Error::NoFrame(self.frames));
        }
        let mut mark = Mark::default();
        for word in words {
            match word.split_once('=') {
                Some(("XDDX_NS", value)) => mark.time_ns = value.parse().ok(),
                Some(("XDDX_SEQ", value)) => mark.sequence = value.parse().ok(),
                _ => {}
            }
        }
        Ok(Some(mark))
    }

    /// Reads the planes of a frame into its place in `frame`, which is as long as the layout says.
    ///
    /// # Errors
    /// [`Error::Truncated`] names the frame; [`Error::Read`].
    ///
    /// # Panics
    /// When `frame` is too short.
    pub fn read_planes(&mut self, frame: &mut [u8]) -> Result<(), Error> {
        let width = usize::try_from(self.header.width).unwrap_or(usize::MAX);
        for component in components(self.header.format) {
            for field in 0..self.layout.fields().len() {
                let mut planes = self.layout.planes_mut(frame, field);
                let plane = &mut planes[component.plane];
                let (input, wide) = (&mut self.input, &mut self.wide);
                let (bits, frame) = (self.coded.bits, self.frames);
                fill(plane, *component, width, &mut self.row, |bytes| {
                    if bits == 8 {
                        return exactly(input, bytes, frame);
                    }
                    wide.resize(2 * bytes.len(), 0);
                    exactly(input, wide, frame)?;
                    let (words, _) = wide.as_chunks::<2>();
                    for (byte, word) in bytes.iter_mut().zip(words) {
                        *byte = rounded(u16::from_le_bytes(*word), bits);
                    }
                    Ok(())
                })?;
            }
        }
        if self.coded.has_opacity {
            let height = usize::try_from(self.header.height()).unwrap_or(usize::MAX);
            self.row.resize(width, 0);
            for _ in 0..height {
                exactly(&mut self.input, &mut self.row, self.frames)?;
            }
        }
        Ok(())
    }

    /// The input, behind what was read.
    pub fn input_mut(&mut self) -> &mut R {
        &mut self.input
    }

    /// Says that the input was moved to the line of a frame, from 1.
    pub fn moved_to(&mut self, frame: u64) {
        self.frames = frame.saturating_sub(1);
    }
}

impl<W: Write> Writer<W> {
    /// Writes the header.
    ///
    /// # Errors
    /// [`Error::Write`] of the output.
    pub fn new(mut output: W, header: Header) -> Result<Self, Error> {
        output
            .write_all(header.line().as_bytes())
            .map_err(Error::Write)?;
        Ok(Self {
            output,
            header,
            row: Vec::new(),
        })
    }

    /// Writes a frame. On an error part of it may have been written.
    ///
    /// # Errors
    /// [`Error::Changed`] when it is not laid out as the header says, [`Error::Write`] of the output.
    pub fn write(&mut self, frame: &Frame<'_>, mark: Mark) -> Result<(), Error> {
        let fields = frame.fields();
        let mut wanted = self.header.fields.iter();
        let is_alike = |(name, height): &(String, u32), info: &FieldInfo| {
            let has = (info.format, info.width, info.height, info.name());
            has == (self.header.format, self.header.width, *height, name)
        };
        if fields.len() != self.header.fields.len()
            || !frame
                .fields()
                .all(|field| wanted.next().is_some_and(|w| is_alike(w, &field.info)))
        {
            return Err(Error::Changed);
        }
        let mut line = "FRAME".to_owned();
        if let Some(time_ns) = mark.time_ns {
            line += &format!(" XDDX_NS={time_ns}");
        }
        if let Some(sequence) = mark.sequence {
            line += &format!(" XDDX_SEQ={sequence}");
        }
        line.push('\n');
        let output = &mut self.output;
        output.write_all(line.as_bytes()).map_err(Error::Write)?;
        for component in components(self.header.format) {
            for field in frame.fields() {
                rows(&field, *component, &mut self.row, |row| {
                    output.write_all(row)
                })
                .map_err(Error::Write)?;
            }
        }
        Ok(())
    }

    /// What the frames are written to.
    pub fn output_mut(&mut self) -> &mut W {
        &mut self.output
    }

    /// The same, with an end of writing.
    pub fn into_output(self) -> W {
        self.output
    }
}

fn exactly(input: &mut impl io::Read, bytes: &mut [u8], frame: u64) -> Result<(), Error> {
    input.read_exact(bytes).map_err(|error| {
        if error.kind() == io::ErrorKind::UnexpectedEof {
            Error::Truncated(frame)
        } else {
            Error::Read(error)
        }
    })
}

/// The nearest of 8 bits.
fn rounded(value: u16, bits: u32) -> u8 {
    let half = 1 << (bits - 9);
    let nearest = (u32::from(value) + half) >> (bits - 8);
    u8::try_from(nearest).unwrap_or(u8::MAX)
}

enum Line {
    End,
    Whole(Vec<u8>),
    /// It ends, or is longer than may be.
    Part(Vec<u8>),
}

/// Reads a line of at most so many bytes, without its end.
fn line_of(input: &mut impl BufRead, most: usize) -> Result<Line, Error> {
    let mut line = Vec::new();
    let limit = u64::try_from(most).unwrap_or(u64::MAX);
    let mut limited = io::Read::take(input, limit);
    limited.read_until(b'\n', &mut line).map_err(Error::Read)?;
    Ok(match line.pop() {
        None => Line::End,
        Some(b'\n') => Line::Whole(line),
        Some(last) => {
            line.push(last);
            Line::Part(line)
        }
    })
}

/// What a file is that is not one of these, by how it begins.
fn looks_like(start: &[u8]) -> &'static str {
    let begins = |with: &[u8]| start.starts_with(with);
    let is_mp4 = start.get(4..8) == Some(b"ftyp");
    match start {
        _ if is_mp4 => "an MP4 file",
        _ if begins(b"\x1a\x45\xdf\xa3") => "a Matroska or WebM file",
        _ if begins(b"RIFF") => "an AVI or WAV file",
        _ if begins(b"\x89PNG") => "a PNG picture",
        _ if begins(b"\xff\xd8\xff") => "a JPEG picture",
        _ if begins(b"\0\0\0\x01") || begins(b"\0\0\x01") => "a coded stream without a container",
        _ if begins(b"YUV4MPEG") => "an older form of Y4M",
        _ => "something else",
    }
}

/// A fraction of which 0 over 0 is unknown: `Some(None)`.
fn fraction(text: &str) -> Option<Option<(u32, u32)>> {
    let (over, under) = text.split_once(':')?;
    let (over, under) = (over.parse().ok()?, under.parse().ok()?);
    Some((over > 0 && under > 0).then_some((over, under)))
}

/// Names and heights of fields.
fn stacked(text: &str) -> Option<Vec<(String, u32)>> {
    let fields = text.split(',').map(|field| {
        let (name, height) = field.rsplit_once(':')?;
        Some((unquoted(name)?, height.parse().ok()?))
    });
    fields.collect()
}

/// What separates words and fields is written as `%` and two hexadecimal digits.
fn quoted(name: &str) -> String {
    let mut quoted = String::new();
    for byte in name.bytes() {
        match byte {
            b' ' | b',' | b':' | b'%' | b'=' | 0..0x20 | 0x7f.. => {
                quoted += &format!("%{byte:02x}");
            }
            byte => quoted.push(char::from(byte)),
        }
    }
    quoted
}

fn unquoted(text: &str) -> Option<String> {
    let mut bytes = Vec::new();
    let mut rest = text.bytes();
    while let Some(byte) = rest.next() {
        if byte != b'%' {
            bytes.push(byte);
            continue;
        }
        let digits = [rest.next()?, rest.next()?];
        let digits = std::str::from_utf8(&digits).ok()?;
        bytes.push(u8::from_str_radix(digits, 16).ok()?);
    }
    String::from_utf8(bytes).ok()
}

/// The chroma tag of a format; of those with chroma in both directions the one for its usual siting.
fn tag_of(format: PixelFormat) -> &'static str {
    match format {
        PixelFormat::I420 | PixelFormat::Nv12 => "420mpeg2",
        PixelFormat::Yuyv | PixelFormat::Uyvy | PixelFormat::I422 => "422",
        PixelFormat::I444 | PixelFormat::Rgb24 | PixelFormat::Bgr24 | PixelFormat::Hsy => "444",
        PixelFormat::I411 => "411",
        PixelFormat::Grey8 => "mono",
        PixelFormat::Grey16 => "mono16",
        PixelFormat::Rgba => "444alpha",
    }
}

/// The format that a tag stands for when nothing else is said, and what it has beside.
fn format_of_tag(tag: &str) -> Option<(PixelFormat, Coded)> {
    let plain = Coded {
        bits: 8,
        has_opacity: false,
    };
    let format = match tag {
        "420" | "420jpeg" | "420mpeg2" | "420paldv" => PixelFormat::I420,
        "422" => PixelFormat::I422,
        "444" => PixelFormat::I444,
        "411" => PixelFormat::I411,
        "mono" => PixelFormat::Grey8,
        "mono9" | "mono10" | "mono12" | "mono14" | "mono16" => PixelFormat::Grey16,
        "444alpha" => {
            let coded = Coded {
                has_opacity: true,
                ..plain
            };
            return Some((PixelFormat::I444, coded));
        }
        _ => {
            let (planes, bits) = tag.split_once('p')?;
            let (format, _) =
                format_of_tag(planes).filter(|(format, _)| *format != PixelFormat::Grey8)?;
            let bits = bits.parse().ok().filter(|bits| (9..=16).contains(bits))?;
            return Some((format, Coded { bits, ..plain }));
        }
    };
    Some((format, plain))
}

const MAGIC: &str = "YUV4MPEG2";
/// The name of the only field of a file that names none.
pub const FIELD: &str = "picture";
/// Longest line before a frame or the first one.
const HEADER_MAX: usize = 4_096;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fingerprint;
    use crate::frame::FrameInfo;

    fn layout(format: PixelFormat) -> Layout {
        Layout::new(&[FieldSpec::new(FIELD, format, 7, 5)]).unwrap()
    }

    /// A frame in which each byte of a component is another one.
    fn frame(layout: &Layout, seed: u8) -> Vec<u8> {
        let mut bytes = vec![0; layout.size_bytes()];
        let info = FrameInfo {
            sequence: seed.into(),
            ..FrameInfo::default()
        };
        layout.write_header(&mut bytes, &info).unwrap();
        let mut next = seed;
        for field in 0..layout.fields().len() {
            for plane in layout.planes_mut(&mut bytes, field) {
                for byte in plane.bytes {
                    next = next.wrapping_mul(5).wrapping_add(3);
                    *byte = next;
                }
            }
        }
        bytes
    }

    fn saved(layout: &Layout, frames: &[Vec<u8>]) -> Vec<u8> {
        let header = Header::of(layout, Some((30, 1))).unwrap();
        let mut writer = Writer::new(Vec::new(), header).unwrap();
        for (index, bytes) in (0_u64..).zip(frames) {
            let mark = Mark {
                time_ns: Some(index * 40_000_000),
                sequence: Some(index + 1),
            };
            writer.write(&Frame::parse(bytes).unwrap(), mark).unwrap();
        }
        writer.output
    }

    type Loaded = (Header, Vec<(Mark, Vec<u8>)>);

    fn loaded(file: &[u8]) -> Result<Loaded, Error> {
        let mut reader = Reader::new(file)?;
        let mut frames = Vec::new();
        while let Some(mark) = reader.next_mark()? {
            let mut bytes = vec![0; reader.layout().size_bytes()];
            let layout = reader.layout().clone();
            layout.write_header(&mut bytes, &FrameInfo::default())?;
            reader.read_planes(&mut bytes)?;
            frames.push((mark, bytes));
        }
        Ok((reader.header().clone(), frames))
    }

    fn prints(bytes: &[u8]) -> Vec<u64> {
        let frame = Frame::parse(bytes).unwrap();
        frame.fields().map(|field| fingerprint(&field)).collect()
    }

    #[test]
    fn each_format_is_saved_and_loaded_bit_for_bit() {
        for format in PixelFormat::ALL {
            let layout = layout(format);
            let frames = [frame(&layout, 1), frame(&layout, 2)];
            let file = saved(&layout, &frames);
            let (header, again) = loaded(&file).unwrap();
            assert_eq!(
                (header.format, header.width, header.height()),
                (format, 7, 5)
            );
            assert_eq!(again.len(), 2, "{format}");
            for (index, (mark, bytes)) in (0_u64..).zip(&again) {
                assert_eq!(mark.time_ns, Some(index * 40_000_000));
                assert_eq!(mark.sequence, Some(index + 1));
                let place = usize::try_from(index).unwrap();
                assert_eq!(prints(bytes), prints(&frames[place]), "{format}");
            }
            let again: Vec<Vec<u8>> = again.into_iter().map(|(_, bytes)| bytes).collect();
            assert_eq!(saved(&layout, &again), file, "{format}");
        }
    }

    #[test]
    fn stacked_fields_keep_their_names_and_colours() {
        let spec = |name, height| FieldSpec {
            colour: Colour {
                range: Range::Full,
                matrix: Matrix::Bt709,
                siting: Siting::TopLeft,
            },
            scan: Scan::TopFirst,
            ..FieldSpec::new(name, PixelFormat::I420, 7, height)
        };
        let layout = Layout::new(&[spec("left eye", 4), spec("50%,r:ight", 6)]).unwrap();
        let bytes = frame(&layout, 9);
        let file = saved(&layout, std::slice::from_ref(&bytes));
        let (header, again) = loaded(&file).unwrap();
        assert_eq!(header.layout().unwrap(), layout);
        assert_eq!(prints(&again[0].1), prints(&bytes));
        // Others see one picture: its luma is that of both, one below the other.
        let line = file.iter().position(|byte| *byte == b'\n').unwrap();
        let text = std::str::from_utf8(&file[..line]).unwrap();
        assert!(
            text.starts_with("YUV4MPEG2 W7 H10 F30:1 It A0:0 C420paldv "),
            "{text}"
        );

        let odd = Layout::new(&[spec("a", 3), spec("b", 4)]).unwrap();
        assert!(matches!(Header::of(&odd, None), Err(Error::Stacked)));
    }

    #[test]
    fn what_others_write_is_read() {
        let ffmpeg = b"YUV4MPEG2 W4 H2 F30000:1001 Ip A1:1 C420mpeg2 XYSCSS=420MPEG2 XCOLORRANGE=LIMITED\nFRAME\nabcdefghijklFRAME Ip\nabcdefghijkl";
        let (header, frames) = loaded(ffmpeg).unwrap();
        assert_eq!(header.rate, Some((30_000, 1_001)));
        assert_eq!(header.aspect, Some((1, 1)));
        assert_eq!(frames.len(), 2);
        assert_eq!(frames[0].0, Mark::default());
        let frame = Frame::parse(&frames[1].1).unwrap();
        let planes: Vec<&[u8]> = frame.first().planes().map(|plane| plane.bytes).collect();
        assert_eq!(planes, [&b"abcdefgh"[..], b"ij", b"kl"]);

        // Without a tag it is 4:2:0, or what older programs say.
        let (header, _) = loaded(b"YUV4MPEG2 H2 W4\n").unwrap();
        assert_eq!(header.colour.siting, Siting::Centre);
        let (header, _) = loaded(b"YUV4MPEG2 W4 H2 XYSCSS=411\n").unwrap();
        assert_eq!(header.format, PixelFormat::I411);
    }

    #[test]
    fn deeper_components_are_rounded_and_opacity_is_left_out_with_a_word() {
        let deep =
            b"YUV4MPEG2 W2 H1 C444p10\nFRAME\n\x00\x00\x02\x00\x01\x02\xff\x03\xfd\x03\xfe\x03";
        let mut reader = Reader::new(&deep[..]).unwrap();
        assert!(reader.left_out().unwrap().contains("10 bits"));
        reader.next_mark().unwrap().unwrap();
        let layout = reader.layout().clone();
        let mut bytes = vec![0; layout.size_bytes()];
        layout
            .write_header(&mut bytes, &FrameInfo::default())
            .unwrap();
        reader.read_planes(&mut bytes).unwrap();
        let frame = Frame::parse(&bytes).unwrap();
        let planes: Vec<&[u8]> = frame.first().planes().map(|plane| plane.bytes).collect();
        assert_eq!(planes, [&[0, 1][..], &[128, 255], &[255, 255]]);

        let alpha = b"YUV4MPEG2 W2 H1 C444alpha\nFRAME\nabcdefghFRAME\nABCDEFGH";
        assert!(
            Reader::new(&alpha[..])
                .unwrap()
                .left_out()
                .unwrap()
                .contains("opacity")
        );
        let (header, frames) = loaded(alpha).unwrap();
        assert_eq!((header.format, frames.len()), (PixelFormat::I444, 2));
    }

    #[test]
    fn each_kind_of_bad_file_has_its_own_error() {
        let error = |file: &[u8]| loaded(file).unwrap_err();
        assert!(matches!(error(b""), Error::Empty));
        assert!(matches!(
            error(b"\0\0\0\x20ftypisom"),
            Error::Foreign("an MP4 file")
        ));
        assert!(matches!(error(b"\x1a\x45\xdf\xa3"), Error::Foreign(_)));
        assert!(matches!(error(&[b'Y'; 9_000]), Error::Foreign(_)));
        for header in [
            "YUV4MPEG2 W0 H2",
            "YUV4MPEG2 W4",
            "YUV4MPEG2 Wx H2",
            "YUV4MPEG2 W4 H2 F25",
            "YUV4MPEG2 W4 H2 Q1",
            "YUV4MPEG2 W4 H2 XDDX_FIELDS=a:3",
            "YUV4MPEG2 W4 H2 XDDX_FORMAT=RGB24",
            "YUV4MPEG2 W99999999 H99999999",
            "YUV4MPEG2 W4 H2 C410",
            "YUV4MPEG2 W4 H2 C420p17",
        ] {
            let error = error(format!("{header}\n").as_bytes());
            let is_named = matches!(error, Error::Y4m(_) | Error::Size { .. } | Error::Chroma(_));
            assert!(is_named, "{header}: {error}");
        }
        let good = b"YUV4MPEG2 W4 H2\nFRAME\nabcdefghijklFRAME\nabcdefghijkl";
        let first = 16 + 6 + 12;
        for len in first + 1..good.len() {
            assert!(matches!(error(&good[..len]), Error::Truncated(2)), "{len}");
        }
        let mut damaged = good.to_vec();
        damaged[first] = b'f';
        assert!(matches!(error(&damaged), Error::NoFrame(2)));
        // A line without an end is not read to its end.
        let endless = [&good[..first], &[b'x'; 10_000]].concat();
        assert!(matches!(error(&endless), Error::NoFrame(2)));
    }
}
