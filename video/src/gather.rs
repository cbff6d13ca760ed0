//! Pictures whose planes lie one behind another, as devices and pipes hand them over.

use crate::Error;
use crate::format::PixelFormat;
use crate::frame::Layout;

/// Copies a picture into the place of the first field of `frame`, which is as long as the layout says. In `source` the
/// planes follow one another without a gap; rows of the first are `bytes_per_line` apart, those of planar chroma a half or a
/// quarter of that, as the format's subsampling is (V4L2, "Single-planar format structure").
///
/// # Errors
/// [`Error::Capacity`] when `source` is too short for the picture; nothing is copied then.
///
/// # Panics
/// When `frame` is too short.
pub fn gather(
    layout: &Layout,
    frame: &mut [u8],
    source: &[u8],
    bytes_per_line: usize,
) -> Result<(), Error> {
    let shares = shares(layout.fields()[0].format);
    let mut planes = layout.planes_mut(frame, 0);
    let mut needed = 0;
    for (plane, share) in planes.iter().zip(shares) {
        let stride = bytes_per_line.div_ceil(share).max(plane.row_bytes);
        needed += stride * plane.rows;
    }
    // The last row need not be padded.
    if let Some((plane, share)) = planes.last().zip(shares.get(planes.len() - 1)) {
        let stride = bytes_per_line.div_ceil(*share).max(plane.row_bytes);
        needed -= stride - plane.row_bytes;
    }
    if source.len() < needed {
        return Err(Error::Capacity {
            size: needed,
            capacity: source.len(),
        });
    }
    let mut rest = source;
    for (plane, share) in planes.iter_mut().zip(shares) {
        let stride = bytes_per_line.div_ceil(share).max(plane.row_bytes);
        let (own, behind) = rest.split_at(rest.len().min(stride * plane.rows));
        rest = behind;
        for (row, bytes) in own.chunks(stride).take(plane.rows).enumerate() {
            let len = plane.row_bytes;
            plane.row(row).copy_from_slice(&bytes[..len]);
        }
    }
    Ok(())
}

/// By how much the rows of each plane are shorter than those of the first.
fn shares(format: PixelFormat) -> [usize; 3] {
    match format {
        PixelFormat::I420 | PixelFormat::I422 => [1, 2, 2],
        PixelFormat::I411 => [1, 4, 4],
        PixelFormat::Nv12
        | PixelFormat::Yuyv
        | PixelFormat::Uyvy
        | PixelFormat::I444
        | PixelFormat::Grey8
        | PixelFormat::Grey16
        | PixelFormat::Rgb24
        | PixelFormat::Bgr24
        | PixelFormat::Rgba
        | PixelFormat::Hsy => [1; 3],
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frame::{FieldSpec, Frame, FrameInfo};

    #[test]
    fn padded_rows_of_each_format_are_taken_as_they_are() {
        for format in PixelFormat::ALL {
            let layout = Layout::new(&[FieldSpec::new("a", format, 10, 4)]).unwrap();
            let mut bytes = vec![0; layout.size_bytes()];
            layout
                .write_header(&mut bytes, &FrameInfo::default())
                .unwrap();
            let frame = Frame::parse(&bytes).unwrap();
            let row = frame.first().plane(0).unwrap().row_bytes;
            // Rows that no stride divides evenly but one of four.
            let line = (row + 3).next_multiple_of(4);
            let (mut source, mut expected) = (Vec::new(), Vec::new());
            for (plane, share) in frame.first().planes().zip(shares(format)) {
                let stride = (line / share).max(plane.row_bytes);
                for row in 0..plane.rows {
                    let filled = u8::try_from(10 * expected.len() + row + 1).unwrap();
                    source.extend(vec![filled; plane.row_bytes]);
                    source.extend(vec![255; stride - plane.row_bytes]);
                }
                expected.push(plane.rows);
            }
            gather(&layout, &mut bytes, &source, line).unwrap();
            let frame = Frame::parse(&bytes).unwrap();
            for (at, plane) in frame.first().planes().enumerate() {
                for (row, bytes) in plane.rows().enumerate() {
                    let filled = u8::try_from(10 * at + row + 1).unwrap();
                    assert!(
                        bytes.iter().all(|byte| *byte == filled),
                        "{format} {at} {row}"
                    );
                }
            }
            let short = &source[..source.len() - 4];
            let len = layout.size_bytes();
            let before = bytes.clone();
            if gather(&layout, &mut bytes, short, line).is_err() {
                assert_eq!(bytes, before);
            }
            let none = gather(&layout, &mut vec![0; len], &[], line);
            assert!(matches!(none, Err(Error::Capacity { .. })), "{format}");
        }
    }
}
