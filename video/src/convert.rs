//! From any pixel format to red, green and blue of 8 bits.
//!
//! Luma and chroma are converted by the crate `yuv`, exact to one code value against the formulas of ITU-R BT.601 and BT.709
//! (a test computes them in floating point). A chroma sample stands for all pixels that it covers, whatever its siting. What
//! that crate lacks is here: 4:1:1, 16 bits, and hue, saturation, luma. Luma darker than black is black.

use yuv::{YuvGrayImage, YuvPlanarImage, YuvRange, YuvStandardMatrix};

use crate::Error;
use crate::components::{components, rows};
use crate::format::PixelFormat;
use crate::frame::{Colour, Field, Matrix, Range};

/// A picture of interleaved red, green and blue, rows without padding.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Rgb {
    /// Pixels in a row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Three for each pixel.
    pub bytes: Vec<u8>,
}

/// Converts a picture of any format. Of 16 bits the upper 8 are shown as grey; opacity is left out.
///
/// # Errors
/// [`Error::Size`] for a picture too large to be converted.
pub fn to_rgb(field: &Field<'_>) -> Result<Rgb, Error> {
    let (width, height) = (field.info.width, field.info.height);
    let error = || Error::Size { width, height };
    let len = usize::try_from(PixelFormat::Rgb24.picture_bytes(width, height)?);
    let mut bytes = vec![0; len.map_err(|_| error())?];
    let mut planes = apart(field);
    let range = match field.info.colour.range {
        Range::Limited => YuvRange::Limited,
        Range::Full => YuvRange::Full,
    };
    let matrix = match field.info.colour.matrix {
        Matrix::Bt601 => YuvStandardMatrix::Bt601,
        Matrix::Bt709 => YuvStandardMatrix::Bt709,
    };
    let (black, _) = luma_range(field.info.colour.range);
    if is_luma(field.info.format) && black > 0.0 {
        // The crate lets some columns be darker than black, and others not.
        for luma in &mut planes[0] {
            *luma = (*luma).max(code(black));
        }
    }
    let stride = width * 3;
    let planar = |chroma_width: u32| YuvPlanarImage {
        y_plane: &planes[0],
        y_stride: width,
        u_plane: &planes[1],
        u_stride: chroma_width,
        v_plane: &planes[2],
        v_stride: chroma_width,
        width,
        height,
    };
    let half = width.div_ceil(2);
    let done = match field.info.format {
        PixelFormat::I420 | PixelFormat::Nv12 => {
            yuv::yuv420_to_rgb(&planar(half), &mut bytes, stride, range, matrix)
        }
        PixelFormat::I422 | PixelFormat::Yuyv | PixelFormat::Uyvy => {
            yuv::yuv422_to_rgb(&planar(half), &mut bytes, stride, range, matrix)
        }
        PixelFormat::I444 | PixelFormat::I411 => {
            yuv::yuv444_to_rgb(&planar(width), &mut bytes, stride, range, matrix)
        }
        PixelFormat::Grey8 => {
            let grey = YuvGrayImage {
                y_plane: &planes[0],
                y_stride: width,
                width,
                height,
            };
            yuv::yuv400_to_rgb(&grey, &mut bytes, stride, range, matrix)
        }
        PixelFormat::Grey16 => {
            let (words, _) = planes[0].as_chunks::<2>();
            for (pixel, [_, high]) in bytes.as_chunks_mut::<3>().0.iter_mut().zip(words) {
                *pixel = [*high; 3];
            }
            Ok(())
        }
        PixelFormat::Rgb24 | PixelFormat::Bgr24 | PixelFormat::Rgba => {
            let pixels = bytes.as_chunks_mut::<3>().0.iter_mut();
            for (at, pixel) in pixels.enumerate() {
                *pixel = [planes[0][at], planes[1][at], planes[2][at]];
            }
            Ok(())
        }
        PixelFormat::Hsy => {
            let pixels = bytes.as_chunks_mut::<3>().0.iter_mut();
            for (at, pixel) in pixels.enumerate() {
                let hsy = [planes[0][at], planes[1][at], planes[2][at]];
                *pixel = hsy_to_rgb(hsy, field.info.colour);
            }
            Ok(())
        }
    };
    match done {
        Ok(()) => Ok(Rgb {
            width,
            height,
            bytes,
        }),
        Err(_) => Err(error()),
    }
}

/// Whether the first component is luma of 8 bits.
fn is_luma(format: PixelFormat) -> bool {
    use PixelFormat::{Grey8, I411, I420, I422, I444, Nv12, Uyvy, Yuyv};
    matches!(
        format,
        I420 | Nv12 | Yuyv | Uyvy | I422 | I444 | I411 | Grey8
    )
}

/// The components, each by itself and rows without padding; chroma of 4:1:1 as often as it has pixels.
fn apart(field: &Field<'_>) -> [Vec<u8>; 3] {
    let mut planes: [Vec<u8>; 3] = Default::default();
    let mut row = Vec::new();
    let width = usize::try_from(field.info.width).unwrap_or(usize::MAX);
    let is_quarter = field.info.format == PixelFormat::I411;
    for (index, component) in components(field.info.format).iter().take(3).enumerate() {
        let plane = &mut planes[index];
        let done = rows(field, *component, &mut row, |bytes| {
            if is_quarter && index > 0 {
                for row in bytes.chunks(width.div_ceil(4)) {
                    let pixels = row.iter().flat_map(|value| [*value; 4]);
                    plane.extend(pixels.take(width));
                }
            } else {
                plane.extend_from_slice(bytes);
            }
            Ok::<(), std::convert::Infallible>(())
        });
        match done {
            Ok(()) => {}
        }
    }
    planes
}

/// The parts of red and blue in luma.
pub(crate) fn luma_parts(matrix: Matrix) -> (f64, f64) {
    match matrix {
        Matrix::Bt601 => (0.299, 0.114),
        Matrix::Bt709 => (0.2126, 0.0722),
    }
}

/// Black, and the numbers from there to white, of luma.
fn luma_range(range: Range) -> (f64, f64) {
    match range {
        Range::Limited => (16.0, 219.0),
        Range::Full => (0.0, 255.0),
    }
}

/// Hue in 256 steps from red by green, saturation as of HSV, and luma as the colours say.
pub fn rgb_to_hsy(rgb: [u8; 3], colour: Colour) -> [u8; 3] {
    let [r, g, b] = rgb.map(f64::from);
    let (most, least) = (r.max(g).max(b), r.min(g).min(b));
    let span = most - least;
    let sixth = if span == 0.0 {
        0.0
    } else if most == r {
        ((g - b) / span).rem_euclid(6.0)
    } else if most == g {
        (b - r) / span + 2.0
    } else {
        (r - g) / span + 4.0
    };
    // A whole turn is no turn.
    let hue = (sixth / 6.0 * 256.0).round() % 256.0;
    let saturation = if most == 0.0 {
        0.0
    } else {
        span / most * 255.0
    };
    let (kr, kb) = luma_parts(colour.matrix);
    let (black, span) = luma_range(colour.range);
    let luma = kr * r + (1.0 - kr - kb) * g + kb * b;
    [hue, saturation, black + luma / 255.0 * span].map(code)
}

/// The colour of this hue and saturation that has the luma; the nearest where there is none.
pub fn hsy_to_rgb(hsy: [u8; 3], colour: Colour) -> [u8; 3] {
    let [hue, saturation, luma] = hsy.map(f64::from);
    let (sixth, saturation) = (hue / 256.0 * 6.0, saturation / 255.0);
    // Of HSV with a value of 1.
    let part = |shift: f64| {
        let at = (sixth + shift).rem_euclid(6.0);
        let full = at.min(4.0 - at).clamp(0.0, 1.0);
        1.0 - saturation * full
    };
    let pure = [part(5.0), part(3.0), part(1.0)];
    let (kr, kb) = luma_parts(colour.matrix);
    let (black, span) = luma_range(colour.range);
    let wanted = ((luma - black) / span).clamp(0.0, 1.0);
    let has = kr * pure[0] + (1.0 - kr - kb) * pure[1] + kb * pure[2];
    pure.map(|part| code(part * wanted / has * 255.0))
}

fn code(value: f64) -> u8 {
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "a float-to-integer `as` saturates"
    )]
    let code = value.round() as u8;
    code
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frame::{FieldSpec, Frame, FrameInfo, Layout};

    /// A picture with noise in all components, at an odd size.
    fn frame(format: PixelFormat, colour: Colour) -> Vec<u8> {
        let spec = FieldSpec {
            colour,
            ..FieldSpec::new("a", format, 37, 11)
        };
        let layout = Layout::new(&[spec]).unwrap();
        let mut bytes = vec![0; layout.size_bytes()];
        layout
            .write_header(&mut bytes, &FrameInfo::default())
            .unwrap();
        let mut state = 9_u32;
        for plane in layout.planes_mut(&mut bytes, 0) {
            for byte in plane.bytes {
                state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                *byte = (state >> 24).try_into().unwrap();
            }
        }
        bytes
    }

    /// ITU-R BT.601 and BT.709, in floating point; darker than black is black.
    fn reference(yuv: [f64; 3], colour: Colour) -> [f64; 3] {
        let (kr, kb) = luma_parts(colour.matrix);
        let (black, span) = luma_range(colour.range);
        let chroma = match colour.range {
            Range::Limited => 224.0,
            Range::Full => 255.0,
        };
        let y = (yuv[0].max(black) - black) / span;
        let [cb, cr] = [yuv[1], yuv[2]].map(|c| (c - 128.0) / chroma);
        let r = y + 2.0 * (1.0 - kr) * cr;
        let b = y + 2.0 * (1.0 - kb) * cb;
        let g = (y - kr * r - kb * b) / (1.0 - kr - kb);
        [r, g, b].map(|part| (part * 255.0).clamp(0.0, 255.0))
    }

    #[test]
    fn each_format_with_chroma_is_converted_within_one_code_value() {
        let formats = [
            (PixelFormat::I420, 2, 2),
            (PixelFormat::Nv12, 2, 2),
            (PixelFormat::I422, 2, 1),
            (PixelFormat::Yuyv, 2, 1),
            (PixelFormat::Uyvy, 2, 1),
            (PixelFormat::I444, 1, 1),
            (PixelFormat::I411, 4, 1),
        ];
        for (format, across, down) in formats {
            for range in [Range::Limited, Range::Full] {
                for matrix in [Matrix::Bt601, Matrix::Bt709] {
                    let colour = Colour {
                        range,
                        matrix,
                        ..Colour::default()
                    };
                    let bytes = frame(format, colour);
                    let frame = Frame::parse(&bytes).unwrap();
                    let field = frame.first();
                    let rgb = to_rgb(&field).unwrap();
                    let mut apart = Vec::new();
                    for component in components(format) {
                        let mut plane = Vec::new();
                        rows(&field, *component, &mut Vec::new(), |row| {
                            plane.extend_from_slice(row);
                            Ok::<(), ()>(())
                        })
                        .unwrap();
                        apart.push(plane);
                    }
                    let mut worst = 0.0_f64;
                    for y in 0..11_usize {
                        for x in 0..37_usize {
                            let chroma = y / down * 37_usize.div_ceil(across) + x / across;
                            let yuv = [apart[0][y * 37 + x], apart[1][chroma], apart[2][chroma]];
                            let exact = reference(yuv.map(f64::from), colour);
                            let got = &rgb.bytes[(y * 37 + x) * 3..][..3];
                            for (got, exact) in got.iter().zip(exact) {
                                worst = worst.max((f64::from(*got) - exact).abs());
                            }
                        }
                    }
                    // Half a code value is rounding.
                    assert!(worst <= 1.5, "{format} {colour:?}: {worst}");
                }
            }
        }
    }

    #[test]
    fn grey_and_interleaved_colours_stay_what_they_are() {
        let full = Colour {
            range: Range::Full,
            ..Colour::default()
        };
        for (format, step, places) in [
            (PixelFormat::Grey8, 1, [0, 0, 0]),
            (PixelFormat::Grey16, 2, [1, 1, 1]),
            (PixelFormat::Rgb24, 3, [0, 1, 2]),
            (PixelFormat::Bgr24, 3, [2, 1, 0]),
            (PixelFormat::Rgba, 4, [0, 1, 2]),
        ] {
            let bytes = frame(format, full);
            let frame = Frame::parse(&bytes).unwrap();
            let plane = frame.first().plane(0).unwrap();
            let rgb = to_rgb(&frame.first()).unwrap();
            for (at, pixel) in rgb.bytes.as_chunks::<3>().0.iter().enumerate() {
                let expected = places.map(|place| plane.bytes[step * at + place]);
                assert_eq!(*pixel, expected, "{format} {at}");
            }
        }
    }

    #[test]
    fn all_hues_go_there_and_back() {
        for matrix in [Matrix::Bt601, Matrix::Bt709] {
            for range in [Range::Limited, Range::Full] {
                let colour = Colour {
                    range,
                    matrix,
                    ..Colour::default()
                };
                // The circle of full colours, in its six parts.
                for value in 0..=255 {
                    for rgb in [
                        [255, value, 0],
                        [value, 255, 0],
                        [0, 255, value],
                        [0, value, 255],
                        [value, 0, 255],
                        [255, 0, value],
                    ] {
                        let hsy = rgb_to_hsy(rgb, colour);
                        let again = rgb_to_hsy(hsy_to_rgb(hsy, colour), colour);
                        let turn = hsy[0].wrapping_sub(again[0]);
                        assert!(
                            turn.min(turn.wrapping_neg()) <= 1,
                            "{rgb:?} {hsy:?} {again:?}"
                        );
                        assert!(hsy[1].abs_diff(again[1]) <= 1, "{rgb:?} {hsy:?} {again:?}");
                        // The hue that it was rounded to may have no colour as light.
                        assert!(hsy[2].abs_diff(again[2]) <= 3, "{rgb:?} {hsy:?} {again:?}");
                    }
                }
            }
        }
        let full = Colour {
            range: Range::Full,
            ..Colour::default()
        };
        // A sixth of the circle is 42.67 steps.
        for (rgb, hue) in [
            ([255, 0, 0], 0),
            ([255, 255, 0], 43),
            ([0, 255, 0], 85),
            ([0, 255, 255], 128),
            ([0, 0, 255], 171),
            ([255, 0, 255], 213),
            ([255, 0, 1], 0),
        ] {
            assert_eq!(rgb_to_hsy(rgb, full)[0], hue, "{rgb:?}");
        }
        assert_eq!(rgb_to_hsy([0; 3], full), [0, 0, 0]);
        assert_eq!(rgb_to_hsy([255; 3], full), [0, 0, 255]);
        assert_eq!(hsy_to_rgb([9, 0, 77], full), [77; 3]);
    }
}
