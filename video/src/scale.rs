//! Pictures of another size, by the crate `fast_image_resize`.

use fast_image_resize::images::{Image, ImageRef};
use fast_image_resize::{FilterType, PixelType, ResizeAlg, ResizeOptions, Resizer};

use crate::Error;
use crate::convert::Rgb;

/// The picture at another size. Each new pixel is the mean of what it covers (a triangle filter): nothing that is there
/// disappears between samples.
///
/// # Errors
/// [`Error::Size`] for a size of nothing.
pub fn scale(rgb: &Rgb, width: u32, height: u32) -> Result<Rgb, Error> {
    let failed = |()| Error::Size { width, height };
    if width == 0 || height == 0 {
        return Err(failed(()));
    }
    let source = ImageRef::new(rgb.width, rgb.height, &rgb.bytes, PixelType::U8x3);
    let source = source.map_err(|_| failed(()))?;
    let mut scaled = Image::new(width, height, PixelType::U8x3);
    let options = ResizeOptions::new().resize_alg(ResizeAlg::Convolution(FilterType::Bilinear));
    Resizer::new()
        .resize(&source, &mut scaled, &options)
        .map_err(|_| failed(()))?;
    Ok(Rgb {
        width,
        height,
        bytes: scaled.into_vec(),
    })
}

/// The greatest size of the same shape that fits, of at least one pixel a side.
pub fn fitting((width, height): (u32, u32), (most_width, most_height): (u32, u32)) -> (u32, u32) {
    let (w, h) = (u64::from(width.max(1)), u64::from(height.max(1)));
    let (most_w, most_h) = (u64::from(most_width), u64::from(most_height));
    let side = |long: u64| u32::try_from(long.max(1)).unwrap_or(u32::MAX);
    // Compared without division, since both products fit.
    if w * most_h > h * most_w {
        (side(most_w), side((h * most_w + w / 2) / w))
    } else {
        (side((w * most_h + h / 2) / h), side(most_h))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_picture_keeps_its_shape_and_its_mean() {
        assert_eq!(fitting((640, 480), (80, 48)), (64, 48));
        assert_eq!(fitting((1920, 1080), (80, 80)), (80, 45));
        assert_eq!(fitting((10_000, 1), (80, 48)), (80, 1));

        let bytes: Vec<u8> = (0..64_u8 * 3).flat_map(|byte| [byte; 48]).collect();
        let rgb = Rgb {
            width: 64,
            height: 48,
            bytes,
        };
        let mean = |rgb: &Rgb| {
            let sum: u64 = rgb.bytes.iter().map(|byte| u64::from(*byte)).sum();
            sum / u64::try_from(rgb.bytes.len()).unwrap()
        };
        let small = scale(&rgb, 8, 6).unwrap();
        assert_eq!(small.bytes.len(), 8 * 6 * 3);
        assert!(mean(&small).abs_diff(mean(&rgb)) <= 1);
        assert!(matches!(scale(&rgb, 0, 6), Err(Error::Size { .. })));
    }
}
