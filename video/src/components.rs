//! Components apart from how a format mixes them: the planes of a file, and what a frame's fingerprint is taken of.

use crate::format::PixelFormat;
use crate::frame::{Field, PlaneMut};

/// Where one component lies: the plane, its first byte in a row, and the bytes from one value to the next.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Component {
    pub(crate) plane: usize,
    first: usize,
    step: usize,
}

const fn whole(plane: usize) -> Component {
    mixed(plane, 0, 1)
}

const fn mixed(plane: usize, first: usize, step: usize) -> Component {
    Component { plane, first, step }
}

/// The components of a format, in the order luma, both chroma, opacity; or red, green, blue, opacity.
pub(crate) fn components(format: PixelFormat) -> &'static [Component] {
    const PLANAR: &[Component] = &[whole(0), whole(1), whole(2)];
    match format {
        PixelFormat::I420 | PixelFormat::I422 | PixelFormat::I444 | PixelFormat::I411 => PLANAR,
        PixelFormat::Nv12 => const { &[whole(0), mixed(1, 0, 2), mixed(1, 1, 2)] },
        PixelFormat::Yuyv => const { &[mixed(0, 0, 2), mixed(0, 1, 4), mixed(0, 3, 4)] },
        PixelFormat::Uyvy => const { &[mixed(0, 1, 2), mixed(0, 0, 4), mixed(0, 2, 4)] },
        PixelFormat::Grey8 | PixelFormat::Grey16 => const { &[whole(0)] },
        PixelFormat::Rgb24 | PixelFormat::Hsy => {
            const { &[mixed(0, 0, 3), mixed(0, 1, 3), mixed(0, 2, 3)] }
        }
        PixelFormat::Bgr24 => const { &[mixed(0, 2, 3), mixed(0, 1, 3), mixed(0, 0, 3)] },
        PixelFormat::Rgba => {
            const {
                &[
                    mixed(0, 0, 4),
                    mixed(0, 1, 4),
                    mixed(0, 2, 4),
                    mixed(0, 3, 4),
                ]
            }
        }
    }
}

impl Component {
    /// Whether its plane holds nothing else.
    pub(crate) fn is_whole(self) -> bool {
        self.step == 1
    }

    /// Its first byte in a row, and the bytes from one value to the next.
    pub(crate) fn place(self) -> (usize, usize) {
        (self.first, self.step)
    }

    /// Bytes of it in a row of a picture so many pixels wide.
    pub(crate) fn len(self, row_bytes: usize, width: usize) -> usize {
        match self.is_whole() {
            true => row_bytes,
            // Packed formats fill the last pair of an odd width.
            false => (row_bytes - self.first).div_ceil(self.step).min(width),
        }
    }

    /// Copies it out of a row.
    fn take(self, row: &[u8], width: usize, into: &mut Vec<u8>) {
        into.clear();
        let values = row[self.first..].iter().step_by(self.step);
        into.extend(values.take(self.len(row.len(), width)));
    }

    /// Copies it into a row; what fills the last pair repeats the last value.
    pub(crate) fn put(self, values: &[u8], row: &mut [u8]) {
        let last = values.last().copied().unwrap_or_default();
        let values = values.iter().copied().chain(std::iter::repeat(last));
        let spots = row[self.first..].iter_mut().step_by(self.step);
        for (spot, value) in spots.zip(values) {
            *spot = value;
        }
    }
}

/// Calls `each` with the rows of each component in turn. `row` is what mixed ones are copied to.
pub(crate) fn rows<E>(
    field: &Field<'_>,
    component: Component,
    row: &mut Vec<u8>,
    mut each: impl FnMut(&[u8]) -> Result<(), E>,
) -> Result<(), E> {
    let Some(plane) = field.plane(component.plane) else {
        return Ok(());
    };
    if component.is_whole() && plane.stride == plane.row_bytes {
        return each(plane.bytes);
    }
    let width = usize::try_from(field.info.width).unwrap_or(usize::MAX);
    for bytes in plane.rows() {
        if component.is_whole() {
            each(bytes)?;
        } else {
            component.take(bytes, width, row);
            each(row)?;
        }
    }
    Ok(())
}

/// A number that two fields share only when all their components are equal, whatever their formats mix or pad: FNV-1a of
/// 64 bits over words of eight bytes. Not for those who would forge it.
pub fn fingerprint(field: &Field<'_>) -> u64 {
    let mut hash = Fingerprint::default();
    let mut row = Vec::new();
    for component in components(field.info.format) {
        let done = rows(field, *component, &mut row, |bytes| {
            hash.add(bytes);
            Ok::<(), std::convert::Infallible>(())
        });
        match done {
            Ok(()) => {}
        }
    }
    hash.end()
}

/// Bytes are gathered to words, so that how they come in pieces makes no difference.
#[derive(Debug)]
struct Fingerprint {
    hash: u64,
    word: u64,
    count: u64,
}

impl Default for Fingerprint {
    fn default() -> Self {
        Self {
            hash: 0xcbf2_9ce4_8422_2325,
            word: 0,
            count: 0,
        }
    }
}

impl Fingerprint {
    fn add(&mut self, mut bytes: &[u8]) {
        while !self.count.is_multiple_of(8)
            && let Some((byte, rest)) = bytes.split_first()
        {
            self.push(*byte);
            bytes = rest;
        }
        let (words, rest) = bytes.as_chunks::<8>();
        for word in words {
            self.mix(u64::from_le_bytes(*word));
            self.count += 8;
        }
        for byte in rest {
            self.push(*byte);
        }
    }

    fn push(&mut self, byte: u8) {
        self.word |= u64::from(byte) << (8 * (self.count % 8));
        self.count += 1;
        if self.count.is_multiple_of(8) {
            let word = std::mem::take(&mut self.word);
            self.mix(word);
        }
    }

    fn mix(&mut self, word: u64) {
        let hash = (self.hash ^ word).wrapping_mul(0x0000_0100_0000_01b3);
        // Of a word's upper half the product alone would show little below.
        self.hash = hash ^ (hash >> 32);
    }

    fn end(mut self) -> u64 {
        let (word, count) = (self.word, self.count);
        self.mix(word);
        self.mix(count);
        self.hash
    }
}

/// Fills a component of a plane, row by row, with what `read` puts into the row it is given.
pub(crate) fn fill<E>(
    plane: &mut PlaneMut<'_>,
    component: Component,
    width: usize,
    row: &mut Vec<u8>,
    mut read: impl FnMut(&mut [u8]) -> Result<(), E>,
) -> Result<(), E> {
    if component.is_whole() && plane.stride == plane.row_bytes {
        return read(plane.bytes);
    }
    row.resize(component.len(plane.row_bytes, width), 0);
    for index in 0..plane.rows {
        let into = plane.row(index);
        if component.is_whole() {
            read(into)?;
        } else {
            read(row)?;
            component.put(row, into);
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frame::{FieldSpec, Frame, FrameInfo, Layout};

    /// Each byte of a component that is read is put back where it was.
    #[test]
    fn components_go_apart_and_together_again() {
        for format in PixelFormat::ALL {
            for width in [1, 2, 5, 8] {
                let spec = FieldSpec::new("a", format, width, 3);
                let layout = Layout::new(&[spec]).unwrap();
                let mut bytes = vec![0; layout.size_bytes()];
                layout
                    .write_header(&mut bytes, &FrameInfo::default())
                    .unwrap();
                let mut next = 0_u8;
                for plane in layout.planes_mut(&mut bytes, 0) {
                    for byte in plane.bytes {
                        next = next.wrapping_add(1);
                        *byte = next;
                    }
                }
                let frame = Frame::parse(&bytes).unwrap();
                let mut apart = Vec::new();
                for component in components(format) {
                    rows(&frame.first(), *component, &mut Vec::new(), |row| {
                        apart.extend_from_slice(row);
                        Ok::<(), ()>(())
                    })
                    .unwrap();
                }
                let mut again = vec![0; layout.size_bytes()];
                layout
                    .write_header(&mut again, &FrameInfo::default())
                    .unwrap();
                let mut from = apart.as_slice();
                for component in components(format) {
                    let mut planes = layout.planes_mut(&mut again, 0);
                    let width = usize::try_from(width).unwrap();
                    let plane = &mut planes[component.plane];
                    fill(plane, *component, width, &mut Vec::new(), |row| {
                        let (values, rest) = from.split_at(row.len());
                        row.copy_from_slice(values);
                        from = rest;
                        Ok::<(), ()>(())
                    })
                    .unwrap();
                }
                assert!(from.is_empty());
                let again = Frame::parse(&again).unwrap();
                assert_eq!(
                    fingerprint(&again.first()),
                    fingerprint(&frame.first()),
                    "{format} {width}"
                );
                let is_filled =
                    format.planes(width, 3).unwrap().as_slice()[0].row_bytes > 2 * width;
                if !(is_filled && width % 2 == 1) {
                    assert_eq!(
                        again
                            .first()
                            .planes()
                            .map(|p| p.bytes.to_vec())
                            .collect::<Vec<_>>(),
                        frame
                            .first()
                            .planes()
                            .map(|p| p.bytes.to_vec())
                            .collect::<Vec<_>>(),
                        "{format} {width}"
                    );
                }
            }
        }
    }

    #[test]
    fn each_byte_counts_and_where_it_comes_does_too() {
        let of = |parts: &[&[u8]]| {
            let mut hash = Fingerprint::default();
            for part in parts {
                hash.add(part);
            }
            hash.end()
        };
        let bytes: Vec<u8> = (0..100).collect();
        let whole = of(&[&bytes]);
        assert_eq!(of(&[&bytes[..3], &bytes[3..60], &bytes[60..]]), whole);
        for at in 0..100 {
            let mut other = bytes.clone();
            other[at] ^= 0x80;
            assert_ne!(of(&[&other]), whole);
        }
        assert_ne!(of(&[&[0; 8]]), of(&[&[0; 9]]));
    }
}
