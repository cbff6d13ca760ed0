//! Pictures: what a pixel format is and how many bytes a picture takes.
//!
//! A video item is an ordinary item whose samples are frames. This room will hold the frame's layout, conversions,
//! codecs and the sender and receiver machines; today it holds what each of them rests on, and it reserves the spelling
//! of views (`cam@320x240,rgb,10Hz`) by keeping `@` out of the middle of a chunk of a video item's name.

use ddx_wire::ItemName;
use thiserror::Error;

/// How the planes of a picture are laid out in memory, 8 bits a component.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[non_exhaustive]
pub enum PixelFormat {
    /// Planar luma, then both chroma planes at half width and half height. The default.
    I420,
    /// Luma only.
    Grey8,
    /// Interleaved red, green, blue.
    Rgb24,
}

/// A picture or a name that cannot be.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[non_exhaustive]
pub enum Error {
    /// A picture has at least one pixel and its bytes can be counted.
    #[error("a picture of {width}x{height} pixels cannot be")]
    Size {
        /// Pixels in a row.
        width: u32,
        /// Rows.
        height: u32,
    },
    /// The spelling belongs to views of an item.
    #[error("`{0}` names a view: `@` inside a chunk is reserved")]
    View(String),
}

impl PixelFormat {
    /// Bytes of a picture without padding. Odd sizes round the chroma planes up.
    ///
    /// # Errors
    /// [`Error::Size`] when a side is zero or the bytes do not fit a `u32`.
    pub fn picture_bytes(self, width: u32, height: u32) -> Result<u32, Error> {
        let bytes = match self {
            Self::I420 => plane(width, height)
                .zip(plane(width.div_ceil(2), height.div_ceil(2)))
                .and_then(|(luma, chroma)| luma.checked_add(chroma.checked_mul(2)?)),
            Self::Grey8 => plane(width, height),
            Self::Rgb24 => plane(width, height).and_then(|pixels| pixels.checked_mul(3)),
        };
        bytes
            .filter(|&bytes| bytes > 0)
            .ok_or(Error::Size { width, height })
    }
}

/// Refuses the name of a video item that could be mistaken for a view of another.
///
/// # Errors
/// [`Error::View`] when a chunk has `@` elsewhere than at its beginning.
pub fn check_item_name(name: &ItemName) -> Result<(), Error> {
    let view = name
        .as_str()
        .split('/')
        .any(|chunk| chunk.rfind('@').is_some_and(|at| at > 0));
    if view {
        Err(Error::View(name.as_str().to_owned()))
    } else {
        Ok(())
    }
}

fn plane(width: u32, height: u32) -> Option<u32> {
    width.checked_mul(height)
}

#[cfg(test)]
mod tests {
    use ddx_wire::HostName;

    use super::*;

    #[test]
    fn odd_sizes_round_chroma_up() {
        assert_eq!(PixelFormat::I420.picture_bytes(640, 480), Ok(460_800));
        assert_eq!(PixelFormat::I420.picture_bytes(3, 3), Ok(9 + 2 * 4));
        assert_eq!(PixelFormat::Rgb24.picture_bytes(3, 1), Ok(9));
    }

    #[test]
    fn impossible_sizes_are_errors() {
        for (width, height) in [(0, 480), (640, 0), (u32::MAX, 2)] {
            assert_eq!(
                PixelFormat::Grey8.picture_bytes(width, height),
                Err(Error::Size { width, height })
            );
        }
    }

    #[test]
    fn the_spelling_of_views_is_reserved() {
        let host = HostName::sanitised("robot1");
        let name = |text: &str| ItemName::parse(text, &host).unwrap();
        assert_eq!(check_item_name(&name("front/cam")), Ok(()));
        assert!(matches!(
            check_item_name(&name("front/cam@320x240,rgb")),
            Err(Error::View(_))
        ));
    }
}
