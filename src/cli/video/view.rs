//! `ddx video view`: a stream on the terminal.

use std::env;
use std::io;

use ddx_store::Delivery;
use ddx_video::convert::to_rgb;
use rustix::termios::tcgetwinsize;
use serde_json::json;

use super::super::Context;
use super::super::interrupt::Interrupt;
use super::super::render::clip;
use super::{Quiet, SLICE, field};
use crate::error::{Exit, Failure, Outcome};
use crate::units;
use crate::video::terminal::{Graphics, Room, draw};
use crate::video::{StreamReader, frame};

/// Which stream, and how.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Name of the item
    name: String,
    /// The field, where a frame has several [default: the first]
    #[arg(long, value_name = "NAME")]
    field: Option<String>,
    /// Most frames a second, asked of other hosts too
    #[arg(long, value_name = "RATE", default_value = "10 Hz", value_parser = units::rate)]
    rate: f64,
    /// Columns and rows of the picture [default: the terminal's]
    #[arg(long, value_name = "SIZE", value_parser = super::size)]
    size: Option<(u32, u32)>,
    /// `blocks` or `kitty` [default: what the terminal is known to take]
    #[arg(long, value_name = "HOW", value_parser = graphics)]
    graphics: Option<Graphics>,
    /// Stop after so many frames
    #[arg(long, value_name = "K")]
    frames: Option<u64>,
}

/// Runs the verb. Without `--frames` it ends when it is interrupted.
pub(crate) fn run(context: &mut Context, args: &Args) -> Outcome {
    if !context.out.terminal && args.size.is_none() {
        return Err(Failure::arguments("standard output is no terminal")
            .with_hint("`ddx video snap` makes a picture; `--size 80x24` draws to anything"));
    }
    let graphics = args.graphics.unwrap_or_else(usual);
    let interrupt = Interrupt::listen(context.tethered)?;
    let store = context.store("video view")?;
    let mut stream = StreamReader::open(&store, &args.name, Delivery::Latest, Some(args.rate))?;
    let (mut quiet, mut shown) = (Quiet::default(), 0);
    context.out.raw(OPEN)?;
    let result = loop {
        if interrupt.is_raised() || args.frames.is_some_and(|most| shown >= most) {
            break Ok(());
        }
        let guard = match stream.frames().next_pinned(SLICE) {
            Ok(Some(guard)) => guard,
            Ok(None) => {
                if shown == 0 {
                    quiet.look(stream.name());
                }
                continue;
            }
            Err(error) => break Err(error.into()),
        };
        match show(context, args, graphics, &guard, stream.name().as_str()) {
            Ok(()) => shown += 1,
            Err(failure) => break Err(failure),
        }
    };
    context.out.raw(CLOSE)?;
    result?;
    if context.out.json {
        context.out.object(&json!({ "frames": shown }))?;
    }
    Ok(Exit::Done)
}

fn show(
    context: &mut Context,
    args: &Args,
    graphics: Graphics,
    guard: &ddx_store::RawGuard,
    name: &str,
) -> Result<(), Failure> {
    let frame = frame(guard)?;
    let field = field(&frame, args.field.as_deref())?;
    let info = frame.info();
    let room = room(args.size);
    let mut text = draw(&to_rgb(&field)?, room, graphics)?;
    let age = ddx_store::now().since(guard.meta().publish);
    let line = format!(
        "{name} #{} {} age {} ms",
        info.sequence,
        field.info,
        age.as_millis()
    );
    let columns = usize::try_from(room.columns).unwrap_or(usize::MAX);
    text.push_str(&clip(&line, columns));
    text.push_str("\x1b[K\x1b[J\r\n");
    Ok(context.out.raw(&text)?)
}

/// The terminal's cells but for two lines: one of text, one for the cursor.
fn room(size: Option<(u32, u32)>) -> Room {
    let (columns, rows) = size.unwrap_or_else(|| {
        tcgetwinsize(io::stdout()).map_or(USUAL, |size| {
            (u32::from(size.ws_col), u32::from(size.ws_row))
        })
    });
    Room {
        columns,
        rows: rows.saturating_sub(2),
    }
}

/// Terminals that take pixels say who they are.
fn usual() -> Graphics {
    let is = |name: &str, part: &str| env::var(name).is_ok_and(|value| value.contains(part));
    if env::var_os("KITTY_WINDOW_ID").is_some()
        || is("TERM", "kitty")
        || is("TERM", "ghostty")
        || is("TERM_PROGRAM", "WezTerm")
    {
        Graphics::Kitty
    } else {
        Graphics::Blocks
    }
}

fn graphics(text: &str) -> Result<Graphics, String> {
    match text {
        "blocks" => Ok(Graphics::Blocks),
        "kitty" => Ok(Graphics::Kitty),
        other => Err(format!("`{other}` is neither blocks nor kitty")),
    }
}

/// A screen of its own, without a cursor.
const OPEN: &str = "\x1b[?1049h\x1b[?25l\x1b[2J";
const CLOSE: &str = "\x1b[?25h\x1b[?1049l";
const USUAL: (u32, u32) = (80, 24);
