//! Pictures of alternate lines taken apart: those of two cameras that share one signal, or the half pictures of television.

use crate::Error;
use crate::format::PixelFormat;
use crate::frame::{FieldInfo, FieldSpec, Frame, Layout, Scan};

/// Takes the first field of each frame of a stream apart: one field of its rows 0, 2, 4 and so on, and one of all others.
#[derive(Clone, Debug)]
pub struct Split {
    from: FieldInfo,
    layout: Layout,
}

impl Split {
    /// Fields of these names will be made from frames of this layout.
    ///
    /// # Errors
    /// [`Error::Rows`] when the rows of the field, or those of its chroma, make no two pictures of one size;
    /// [`Error::FieldName`] for names that cannot be.
    pub fn new(layout: &Layout, names: [&str; 2]) -> Result<Self, Error> {
        let from = layout.fields()[0];
        let step = match from.format {
            // Chroma has half as many rows, which alternate too.
            PixelFormat::I420 | PixelFormat::Nv12 => 4,
            PixelFormat::I422
            | PixelFormat::I411
            | PixelFormat::I444
            | PixelFormat::Yuyv
            | PixelFormat::Uyvy
            | PixelFormat::Grey8
            | PixelFormat::Grey16
            | PixelFormat::Rgb24
            | PixelFormat::Bgr24
            | PixelFormat::Rgba
            | PixelFormat::Hsy => 2,
        };
        if !from.height.is_multiple_of(step) {
            return Err(Error::Rows {
                height: from.height,
                step,
            });
        }
        let halves = names.map(|name| FieldSpec {
            name,
            height: from.height / 2,
            scan: Scan::Progressive,
            ..from.spec()
        });
        Ok(Self {
            from,
            layout: Layout::new(&halves)?,
        })
    }

    /// The layout of what is made.
    pub fn layout(&self) -> &Layout {
        &self.layout
    }

    /// Whether a frame is like those that this was made for.
    pub fn fits(&self, frame: &Frame<'_>) -> bool {
        frame.first().info.spec() == self.from.spec()
    }

    /// Fills `bytes`, header included, with the fields made from `frame`: of its number and its time.
    ///
    /// # Errors
    /// [`Error::Changed`] when the frame is not like those that this was made for.
    ///
    /// # Panics
    /// When `bytes` are fewer than the layout's.
    pub fn write(&self, frame: &Frame<'_>, bytes: &mut [u8]) -> Result<(), Error> {
        if !self.fits(frame) {
            return Err(Error::Changed);
        }
        let field = frame.first();
        self.layout.write_header(bytes, frame.info())?;
        for half in 0..2 {
            let planes = self.layout.planes_mut(bytes, half);
            for (from, mut to) in field.planes().zip(planes) {
                for (row, line) in from.rows().skip(half).step_by(2).enumerate() {
                    to.row(row).copy_from_slice(line);
                }
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frame::FrameInfo;

    /// A frame whose bytes tell the plane, the row and the parity of the row.
    fn interlaced(layout: &Layout, info: &FrameInfo) -> Vec<u8> {
        let mut bytes = vec![0; layout.size_bytes()];
        layout.write_header(&mut bytes, info).unwrap();
        for (index, plane) in layout.planes_mut(&mut bytes, 0).iter_mut().enumerate() {
            for row in 0..plane.rows {
                plane.row(row).fill(mark(index, row));
            }
        }
        bytes
    }

    fn mark(plane: usize, row: usize) -> u8 {
        u8::try_from(64 * plane + row).unwrap()
    }

    #[test]
    fn each_half_has_every_other_row_of_every_plane() {
        let info = FrameInfo {
            sequence: 7,
            capture_ns: 1_000,
            ..FrameInfo::default()
        };
        for format in PixelFormat::ALL {
            let spec = FieldSpec {
                scan: Scan::TopFirst,
                ..FieldSpec::new("signal", format, 10, 12)
            };
            let layout = Layout::new(&[spec]).unwrap();
            let split = Split::new(&layout, ["left", "right"]).unwrap();
            let source = interlaced(&layout, &info);
            let mut made = vec![0; split.layout().size_bytes()];
            split
                .write(&Frame::parse(&source).unwrap(), &mut made)
                .unwrap();

            let frame = Frame::parse(&made).unwrap();
            assert_eq!(*frame.info(), info);
            for (half, name) in ["left", "right"].into_iter().enumerate() {
                let field = frame.field(name).unwrap();
                assert_eq!(field.info.height, 6);
                assert_eq!(field.info.scan, Scan::Progressive);
                for (index, plane) in field.planes().enumerate() {
                    for (row, line) in plane.rows().enumerate() {
                        let expected = mark(index, 2 * row + half);
                        assert!(line.iter().all(|byte| *byte == expected), "{format} {name}");
                    }
                }
            }
        }
    }

    #[test]
    fn rows_that_make_no_two_pictures_are_an_error_and_so_is_another_frame() {
        let layout =
            |format, height| Layout::new(&[FieldSpec::new("signal", format, 8, height)]).unwrap();
        for (format, height) in [(PixelFormat::I420, 6), (PixelFormat::Rgb24, 5)] {
            let refused = Split::new(&layout(format, height), ["a", "b"]);
            assert!(matches!(refused, Err(Error::Rows { .. })), "{format}");
        }
        let grey = layout(PixelFormat::Grey8, 4);
        assert!(matches!(
            Split::new(&grey, ["a", "a"]),
            Err(Error::FieldName(_))
        ));
        let split = Split::new(&grey, ["a", "b"]).unwrap();
        let other = interlaced(&layout(PixelFormat::Grey8, 8), &FrameInfo::default());
        let mut made = vec![0; split.layout().size_bytes()];
        let refused = split.write(&Frame::parse(&other).unwrap(), &mut made);
        assert!(matches!(refused, Err(Error::Changed)));
    }
}
