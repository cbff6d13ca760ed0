//! What can be wrong with pictures, names and files.

use std::io;

use thiserror::Error;

use crate::format::PixelFormat;

/// A picture, a name or a file that cannot be.
#[derive(Debug, Error)]
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
    /// No format has this name.
    #[error("`{0}` is no pixel format (hint: one of {all})", all = names())]
    Format(String),
    /// The spelling belongs to views of an item.
    #[error("`{0}` names a view: `@` inside a chunk is reserved")]
    View(String),
    /// A frame has a few fields.
    #[error("a frame has 1 to 8 fields, not {0}")]
    Fields(usize),
    /// A field's name is unlike the others', and short.
    #[error("`{0}` cannot name a field: 1 to 24 bytes, unlike the others")]
    FieldName(String),
    /// The length of a frame is told in 32 bits.
    #[error("a frame of {0} bytes is too large")]
    TooLarge(usize),
    /// The memory is not as long as the frame.
    #[error("a frame of {size} bytes does not fit {capacity} bytes of memory")]
    Capacity {
        /// Bytes of the frame.
        size: usize,
        /// Bytes that there are.
        capacity: usize,
    },
    /// A sample is no frame.
    #[error("this is no frame: {0}")]
    Frame(&'static str),
    /// The fields of a frame make no common picture.
    #[error(
        "its fields differ in format, width or colours, so that they make no common picture (hint: take one of them)"
    )]
    Stacked,
    /// Alternate rows make no two pictures of one size.
    #[error("{height} rows make no two pictures of one size (hint: a multiple of {step} does)")]
    Rows {
        /// Rows of the picture.
        height: u32,
        /// What they should be a multiple of.
        step: u32,
    },
    /// A frame is not like those before it.
    #[error("the size or format of the frames has changed")]
    Changed,
    /// Nothing came.
    #[error("it is empty")]
    Empty,
    /// Something else than a Y4M file.
    #[error(
        "it is not a Y4M file but {0} (hint: ffmpeg -i FILE -f yuv4mpegpipe - | ddx video load -)"
    )]
    Foreign(&'static str),
    /// A header that cannot be read.
    #[error("it is no proper Y4M file: {0}")]
    Y4m(String),
    /// Chroma as no format here has it.
    #[error("its chroma `C{0}` is not known (hint: ffmpeg -i FILE -pix_fmt yuv420p OTHER.y4m)")]
    Chroma(String),
    /// The file ends in the middle of a frame.
    #[error("it ends in the middle of frame {0}")]
    Truncated(u64),
    /// Something else stands where a frame should begin.
    #[error("it is damaged: frame {0} does not begin with `FRAME`")]
    NoFrame(u64),
    /// No kind of picture file has names that end so.
    #[error("`{0}` is no kind of picture (hint: ppm, png, jpg or tiff)")]
    Picture(String),
    /// A kind of picture file that does not take the picture.
    #[error("it cannot be written so: {0}")]
    Encode(String),
    /// The input cannot be read.
    #[error("reading it: {0}")]
    Read(#[source] io::Error),
    /// The output cannot be written.
    #[error("writing it: {0}")]
    Write(#[source] io::Error),
}

fn names() -> String {
    PixelFormat::ALL.map(PixelFormat::name).join(", ")
}
