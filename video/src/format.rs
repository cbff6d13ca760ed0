//! Pixel formats: which planes a picture has, and how its rows lie in them.

use std::fmt;
use std::str::FromStr;

use crate::Error;

/// How the components of a picture are laid out in memory, 8 bits each unless the name says otherwise.
///
/// Where chroma is subsampled, odd sizes round it up: a picture of 3x3 pixels in [`PixelFormat::I420`] has chroma planes of
/// 2x2.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[non_exhaustive]
pub enum PixelFormat {
    /// Planar Y, U, V; chroma at half width and half height. The default.
    #[default]
    I420,
    /// Planar Y, then interleaved U and V at half width and half height.
    Nv12,
    /// Packed Y U Y V; chroma at half width.
    Yuyv,
    /// Packed U Y V Y; chroma at half width.
    Uyvy,
    /// Planar Y, U, V; chroma at half width.
    I422,
    /// Planar Y, U, V at full size.
    I444,
    /// Planar Y, U, V; chroma at a quarter of the width.
    I411,
    /// Luma only.
    Grey8,
    /// One component of 16 bits, little endian: luma, or depth in the unit that its source names.
    Grey16,
    /// Interleaved red, green, blue.
    Rgb24,
    /// Interleaved blue, green, red.
    Bgr24,
    /// Interleaved red, green, blue, opacity.
    Rgba,
    /// Interleaved hue (256 steps to the circle), saturation (of HSV), luma Y.
    Hsy,
}

/// One plane of a picture, without padding.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct PlaneSize {
    /// Bytes of a row.
    pub row_bytes: u32,
    /// Rows.
    pub rows: u32,
}

/// Most planes that a format has.
pub const PLANES_MAX: usize = 3;

impl PixelFormat {
    /// All formats.
    pub const ALL: [Self; 13] = [
        Self::I420,
        Self::Nv12,
        Self::Yuyv,
        Self::Uyvy,
        Self::I422,
        Self::I444,
        Self::I411,
        Self::Grey8,
        Self::Grey16,
        Self::Rgb24,
        Self::Bgr24,
        Self::Rgba,
        Self::Hsy,
    ];

    /// The name by which users give it.
    pub fn name(self) -> &'static str {
        match self {
            Self::I420 => "I420",
            Self::Nv12 => "NV12",
            Self::Yuyv => "YUYV",
            Self::Uyvy => "UYVY",
            Self::I422 => "422P",
            Self::I444 => "444P",
            Self::I411 => "411P",
            Self::Grey8 => "GREY8",
            Self::Grey16 => "GREY16",
            Self::Rgb24 => "RGB24",
            Self::Bgr24 => "BGR24",
            Self::Rgba => "RGBA",
            Self::Hsy => "HSY",
        }
    }

    /// The planes of a picture of this many pixels.
    ///
    /// # Errors
    /// [`Error::Size`] when a side is zero, or the picture takes more than 4 GiB.
    pub fn planes(self, width: u32, height: u32) -> Result<Planes, Error> {
        let error = Error::Size { width, height };
        if width == 0 || height == 0 {
            return Err(error);
        }
        let full = (Some(width), height);
        let chroma = |across: u32, down: u32| (Some(width.div_ceil(across)), height.div_ceil(down));
        let times = |(row, rows): (Option<u32>, u32), bytes: u32| {
            (row.and_then(|row| row.checked_mul(bytes)), rows)
        };
        let none = (Some(0), 0);
        let planes = match self {
            Self::I420 => [full, chroma(2, 2), chroma(2, 2)],
            Self::Nv12 => [full, times(chroma(2, 2), 2), none],
            Self::Yuyv | Self::Uyvy => [times(chroma(2, 1), 4), none, none],
            Self::I422 => [full, chroma(2, 1), chroma(2, 1)],
            Self::I444 => [full, full, full],
            Self::I411 => [full, chroma(4, 1), chroma(4, 1)],
            Self::Grey8 => [full, none, none],
            Self::Grey16 => [times(full, 2), none, none],
            Self::Rgb24 | Self::Bgr24 | Self::Hsy => [times(full, 3), none, none],
            Self::Rgba => [times(full, 4), none, none],
        };
        let mut sizes = Planes::default();
        for (row, rows) in planes.into_iter().take_while(|(_, rows)| *rows > 0) {
            let Some(row_bytes) = row else {
                return Err(error);
            };
            sizes.all[sizes.count] = PlaneSize { row_bytes, rows };
            sizes.count += 1;
        }
        match sizes.total() {
            Some(_) => Ok(sizes),
            None => Err(error),
        }
    }

    /// Bytes of a picture without padding.
    ///
    /// # Errors
    /// As [`PixelFormat::planes`].
    pub fn picture_bytes(self, width: u32, height: u32) -> Result<u32, Error> {
        let planes = self.planes(width, height)?;
        planes.total().ok_or(Error::Size { width, height })
    }
}

/// The planes of a picture.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Planes {
    all: [PlaneSize; PLANES_MAX],
    count: usize,
}

impl Planes {
    /// The planes, in the order of their components.
    pub fn as_slice(&self) -> &[PlaneSize] {
        &self.all[..self.count]
    }

    fn total(&self) -> Option<u32> {
        self.as_slice().iter().try_fold(0_u32, |sum, plane| {
            sum.checked_add(plane.row_bytes.checked_mul(plane.rows)?)
        })
    }
}

impl fmt::Display for PixelFormat {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.name())
    }
}

impl FromStr for PixelFormat {
    type Err = Error;

    /// Takes the names of [`PixelFormat::name`] in any case.
    fn from_str(text: &str) -> Result<Self, Error> {
        let mut all = Self::ALL.into_iter();
        all.find(|format| format.name().eq_ignore_ascii_case(text))
            .ok_or_else(|| Error::Format(text.to_owned()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn odd_sizes_round_chroma_up() {
        let bytes = |format: PixelFormat| format.picture_bytes(5, 3).unwrap();
        let all = PixelFormat::ALL.map(bytes);
        let of_5x3 = [
            15 + 2 * 3 * 2,
            15 + 6 * 2,
            12 * 3,
            12 * 3,
            15 + 2 * 3 * 3,
            45,
            15 + 2 * 2 * 3,
            15,
            30,
            45,
            45,
            60,
            45,
        ];
        assert_eq!(all, of_5x3);
        assert_eq!(PixelFormat::I420.picture_bytes(640, 480).unwrap(), 460_800);
    }

    #[test]
    fn impossible_sizes_are_errors() {
        for format in PixelFormat::ALL {
            for (width, height) in [(0, 480), (640, 0), (u32::MAX, 2), (u32::MAX, u32::MAX)] {
                let error = format.picture_bytes(width, height).unwrap_err();
                assert!(matches!(error, Error::Size { .. }), "{format}: {error}");
            }
        }
    }

    #[test]
    fn names_are_read_back() {
        for format in PixelFormat::ALL {
            let read: PixelFormat = format.name().to_lowercase().parse().unwrap();
            assert_eq!(read, format);
        }
        let error = "H264".parse::<PixelFormat>().unwrap_err();
        assert!(error.to_string().contains("I420, NV12"), "{error}");
    }
}
