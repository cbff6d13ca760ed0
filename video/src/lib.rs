//! Pictures: pixel formats, the layout of frames, files of them, and what a moving picture of a test shows.
//!
//! A video item is an ordinary item whose samples are [frames](frame). This room is pure: bytes come in and go out, and
//! nothing here knows a store, a host or a clock. Codecs and the machines of video channels will come here. The spelling of
//! views (`cam@320x240,rgb,10Hz`) is reserved by keeping `@` out of the middle of a chunk of a video item's name.

mod components;
pub mod convert;
mod error;
pub mod format;
pub mod frame;
pub mod gather;
pub mod pattern;
pub mod picture;
pub mod scale;
pub mod split;
pub mod y4m;

use ddx_wire::ItemName;

pub use crate::components::fingerprint;
pub use crate::error::Error;
pub use crate::format::PixelFormat;

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

#[cfg(test)]
mod tests {
    use ddx_wire::HostName;

    use super::*;

    #[test]
    fn the_spelling_of_views_is_reserved() {
        let host = HostName::sanitised("robot1");
        let name = |text: &str| ItemName::parse(text, &host).unwrap();
        assert!(check_item_name(&name("front/cam")).is_ok());
        assert!(matches!(
            check_item_name(&name("front/cam@320x240,rgb")),
            Err(Error::View(_))
        ));
    }
}
