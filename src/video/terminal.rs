//! Pictures on a terminal: two pixels in each cell, or as they are where the terminal takes the graphics protocol of kitty.

use std::fmt::Write as _;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use ddx_video::Error;
use ddx_video::convert::Rgb;
use ddx_video::scale::{fitting, scale};

/// How a terminal shows pictures.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Graphics {
    /// The upper half of a cell in one colour, the lower half in another.
    Blocks,
    /// Pixels, as <https://sw.kovidgoyal.net/kitty/graphics-protocol/> has it.
    Kitty,
}

/// A terminal's room for a picture, in cells.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Room {
    pub(crate) columns: u32,
    pub(crate) rows: u32,
}

/// What to write to a terminal so that the picture stands at its top left, as large as it fits. The cursor is below it then.
pub(crate) fn draw(rgb: &Rgb, room: Room, graphics: Graphics) -> Result<String, Error> {
    // A cell is about twice as high as it is wide.
    let most = (room.columns.max(1), room.rows.max(1).saturating_mul(2));
    let (width, height) = fitting((rgb.width, rgb.height), most);
    let rows = height.div_ceil(2);
    let mut text = "\x1b[H".to_owned();
    match graphics {
        Graphics::Blocks => blocks(&scale(rgb, width, height)?, &mut text),
        Graphics::Kitty => {
            let (w, h) = fitting((rgb.width, rgb.height), PIXELS_MAX);
            let small = (w < rgb.width).then(|| scale(rgb, w, h)).transpose()?;
            kitty(small.as_ref().unwrap_or(rgb), width, rows, &mut text);
        }
    }
    Ok(text)
}

fn blocks(rgb: &Rgb, text: &mut String) {
    let width = usize::try_from(rgb.width).unwrap_or(usize::MAX);
    let (pixels, _) = rgb.bytes.as_chunks::<3>();
    let rows: Vec<_> = pixels.chunks(width).collect();
    for pair in rows.chunks(2) {
        let mut before = None;
        for (x, upper) in pair[0].iter().enumerate() {
            let lower = pair.get(1).map(|row| row[x]);
            if before != Some((*upper, lower)) {
                before = Some((*upper, lower));
                let [r, g, b] = *upper;
                // Writing to a string cannot fail.
                let _ = write!(text, "\x1b[38;2;{r};{g};{b}m");
                let _ = match lower {
                    Some([r, g, b]) => write!(text, "\x1b[48;2;{r};{g};{b}m"),
                    None => write!(text, "\x1b[49m"),
                };
            }
            text.push('▀');
        }
        text.push_str("\x1b[0m\x1b[K\r\n");
    }
}

fn kitty(rgb: &Rgb, columns: u32, rows: u32, text: &mut String) {
    let coded = STANDARD.encode(&rgb.bytes);
    let (width, height) = (rgb.width, rgb.height);
    let mut control =
        format!("a=T,f=24,s={width},v={height},c={columns},r={rows},i=1,p=1,q=2,C=1,");
    let mut rest = coded.as_str();
    loop {
        let (piece, left) = rest.split_at(rest.len().min(PIECE_MAX));
        rest = left;
        let more = u8::from(!rest.is_empty());
        let _ = write!(text, "\x1b_G{control}m={more};{piece}\x1b\\");
        control.clear();
        if more == 0 {
            break;
        }
    }
    let _ = write!(text, "\x1b[{}H", rows + 1);
}

/// Pixels that are sent at most: a terminal scales them itself.
const PIXELS_MAX: (u32, u32) = (640, 640);
/// Bytes of one command of the protocol.
const PIECE_MAX: usize = 4_096;

#[cfg(test)]
mod tests {
    use super::*;

    const ROOM: Room = Room {
        columns: 80,
        rows: 24,
    };

    fn two_by_three() -> Rgb {
        Rgb {
            width: 2,
            height: 3,
            bytes: (0..18).collect(),
        }
    }

    #[test]
    fn a_cell_shows_the_pixel_above_and_the_one_below() {
        let mut text = String::new();
        blocks(&two_by_three(), &mut text);
        assert_eq!(
            text,
            "\x1b[38;2;0;1;2m\x1b[48;2;6;7;8m▀\x1b[38;2;3;4;5m\x1b[48;2;9;10;11m▀\x1b[0m\x1b[K\r\n\
             \x1b[38;2;12;13;14m\x1b[49m▀\x1b[38;2;15;16;17m\x1b[49m▀\x1b[0m\x1b[K\r\n"
        );
    }

    #[test]
    fn a_picture_fills_the_room_and_no_more() {
        let rgb = Rgb {
            width: 640,
            height: 480,
            bytes: vec![9; 640 * 480 * 3],
        };
        let text = draw(&rgb, ROOM, Graphics::Blocks).unwrap();
        let lines: Vec<_> = text.split("\r\n").collect();
        assert_eq!(lines.len() - 1, 24);
        assert!(
            lines[..24]
                .iter()
                .all(|line| line.matches('▀').count() == 64)
        );
        // Cells alike are not coloured again.
        assert_eq!(lines[1].matches("\x1b[38").count(), 1);
    }

    #[test]
    fn kitty_gets_pixels_in_pieces() {
        let rgb = Rgb {
            width: 64,
            height: 48,
            bytes: vec![7; 64 * 48 * 3],
        };
        let text = draw(&rgb, ROOM, Graphics::Kitty).unwrap();
        let pieces: Vec<_> = text.split("\x1b_G").skip(1).collect();
        assert!(pieces[0].starts_with("a=T,f=24,s=64,v=48,c=64,r=24,"));
        assert!(pieces[..2].iter().all(|piece| piece.contains("m=1;")));
        assert!(pieces[2].contains("m=0;") && text.ends_with("\x1b[25H"));
        let coded: String = pieces
            .iter()
            .map(|piece| {
                piece
                    .split_once(';')
                    .unwrap()
                    .1
                    .split('\x1b')
                    .next()
                    .unwrap()
            })
            .collect();
        assert_eq!(STANDARD.decode(coded).unwrap(), rgb.bytes);
    }
}
