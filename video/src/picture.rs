//! Single pictures as files: PPM, PNG, JPEG, TIFF.

use std::io::{Cursor, Write as _};
use std::str::FromStr;

use crate::Error;
use crate::convert::Rgb;

/// What a picture is written as.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PictureFormat {
    /// Portable pixmap (P6): a short header and the bytes.
    Ppm,
    /// Without loss, compressed.
    Png,
    /// With loss, at a quality of 1 to 100.
    Jpeg {
        /// 90 is hard to tell from the original.
        quality: u8,
    },
    /// Without loss, not compressed.
    Tiff,
}

impl FromStr for PictureFormat {
    type Err = Error;

    /// Takes what a file's name ends with.
    fn from_str(extension: &str) -> Result<Self, Error> {
        match extension.to_ascii_lowercase().as_str() {
            "ppm" => Ok(Self::Ppm),
            "png" => Ok(Self::Png),
            "jpg" | "jpeg" => Ok(Self::Jpeg { quality: 90 }),
            "tif" | "tiff" => Ok(Self::Tiff),
            _ => Err(Error::Picture(extension.to_owned())),
        }
    }
}

/// The bytes of a picture's file.
///
/// # Errors
/// [`Error::Encode`] when the format does not take it, as JPEG beyond 65,535 pixels a side.
pub fn encode(rgb: &Rgb, format: PictureFormat) -> Result<Vec<u8>, Error> {
    let failed = |error: String| Error::Encode(error);
    let (width, height) = (rgb.width, rgb.height);
    match format {
        PictureFormat::Ppm => {
            let mut file = format!("P6\n{width} {height}\n255\n").into_bytes();
            file.extend_from_slice(&rgb.bytes);
            Ok(file)
        }
        PictureFormat::Png => {
            let mut file = Vec::new();
            let mut encoder = png::Encoder::new(&mut file, width, height);
            encoder.set_color(png::ColorType::Rgb);
            encoder.set_depth(png::BitDepth::Eight);
            // The other levels take thirty times as long for a tenth less.
            encoder.set_compression(png::Compression::Fast);
            let mut writer = encoder.write_header().map_err(|e| failed(e.to_string()))?;
            writer
                .write_image_data(&rgb.bytes)
                .and_then(|()| writer.finish())
                .map_err(|e| failed(e.to_string()))?;
            Ok(file)
        }
        PictureFormat::Jpeg { quality } => {
            let sides = (u16::try_from(width), u16::try_from(height));
            let (Ok(width), Ok(height)) = sides else {
                return Err(failed("JPEG has at most 65,535 pixels a side".to_owned()));
            };
            let mut file = Vec::new();
            jpeg_encoder::Encoder::new(&mut file, quality.clamp(1, 100))
                .encode(&rgb.bytes, width, height, jpeg_encoder::ColorType::Rgb)
                .map_err(|e| failed(e.to_string()))?;
            Ok(file)
        }
        PictureFormat::Tiff => {
            let mut file = Cursor::new(Vec::new());
            tiff::encoder::TiffEncoder::new(&mut file)
                .and_then(|mut encoder| {
                    encoder.write_image::<tiff::encoder::colortype::RGB8>(width, height, &rgb.bytes)
                })
                .map_err(|e| failed(e.to_string()))?;
            file.flush().map_err(Error::Write)?;
            Ok(file.into_inner())
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn picture() -> Rgb {
        Rgb {
            width: 5,
            height: 3,
            bytes: (0..45).collect(),
        }
    }

    #[test]
    fn what_is_written_without_loss_is_read_back() {
        let rgb = picture();
        let ppm = encode(&rgb, PictureFormat::Ppm).unwrap();
        assert_eq!(ppm, [b"P6\n5 3\n255\n".as_slice(), &rgb.bytes].concat());

        let file = encode(&rgb, PictureFormat::Png).unwrap();
        let mut reader = png::Decoder::new(Cursor::new(file)).read_info().unwrap();
        let mut read = vec![0; reader.output_buffer_size().unwrap()];
        let info = reader.next_frame(&mut read).unwrap();
        assert_eq!((info.width, info.height, &read), (5, 3, &rgb.bytes));

        let file = encode(&rgb, PictureFormat::Tiff).unwrap();
        let mut reader = tiff::decoder::Decoder::new(Cursor::new(file)).unwrap();
        assert_eq!(reader.dimensions().unwrap(), (5, 3));
        let tiff::decoder::DecodingResult::U8(read) = reader.read_image().unwrap() else {
            panic!("other samples than were written");
        };
        assert_eq!(read, rgb.bytes);
    }

    #[test]
    fn jpeg_says_what_it_is_and_what_it_cannot() {
        let jpeg = PictureFormat::Jpeg { quality: 90 };
        let file = encode(&picture(), jpeg).unwrap();
        assert!(file.starts_with(&[0xff, 0xd8]) && file.ends_with(&[0xff, 0xd9]));
        let wide = Rgb {
            width: 70_000,
            height: 1,
            bytes: vec![0; 210_000],
        };
        let error = encode(&wide, jpeg).unwrap_err().to_string();
        assert!(error.contains("65,535"), "{error}");
        let error = "gif".parse::<PictureFormat>().unwrap_err().to_string();
        assert!(error.contains("ppm, png, jpg or tiff"), "{error}");
    }
}
