//! `ddx video`: puts streams of video into the store and takes them out.

mod load;
mod pattern;
mod save;
mod serve;
mod snap;
mod split;
mod v4l2;
mod view;

use std::time::{Duration, Instant};

use ddx_video::frame::{Field, Frame};
use ddx_wire::ItemName;

use super::Context;
use super::interrupt::SLICE;
use super::output::note;
use crate::error::{Failure, Outcome};
use crate::video::play::Lateness;

/// What to do.
#[derive(Debug, clap::Subcommand)]
pub(crate) enum Verb {
    /// Play a Y4M file, or a pipe of ffmpeg, into an item
    Load(load::Args),
    /// Publish a moving picture that carries its number and time
    Pattern(pattern::Args),
    /// Publish a camera while somebody reads
    V4l2(v4l2::Args),
    /// Record a stream to a Y4M file, bit for bit
    Save(save::Args),
    /// Show the streams of the domain in a browser
    Serve(serve::Args),
    /// Save the present frame as a picture
    Snap(snap::Args),
    /// Take pictures of alternate lines apart, into an item whose frames have two fields
    Split(split::Args),
    /// Show a stream in the terminal
    View(view::Args),
}

/// Runs the verb.
pub(crate) fn run(context: &mut Context, verb: &Verb) -> Outcome {
    match verb {
        Verb::Load(args) => load::run(context, args),
        Verb::Pattern(args) => pattern::run(context, args),
        Verb::V4l2(args) => v4l2::run(context, args),
        Verb::Save(args) => save::run(context, args),
        Verb::Serve(args) => serve::run(context, args),
        Verb::Snap(args) => snap::run(context, args),
        Verb::Split(args) => split::run(context, args),
        Verb::View(args) => view::run(context, args),
    }
}

/// Tells once, after a while, that no frame has come yet.
#[derive(Debug)]
struct Quiet {
    tells_at: Option<Instant>,
}

impl Default for Quiet {
    fn default() -> Self {
        Self {
            tells_at: Some(Instant::now() + QUIET),
        }
    }
}

impl Quiet {
    fn look(&mut self, name: &ItemName) {
        if self.tells_at.is_some_and(|at| Instant::now() >= at) {
            self.tells_at = None;
            note(&format!(
                "no frame of `{name}` yet\nhint: `ddx why {name}` says why"
            ));
        }
    }
}

/// After so long without a first frame the user is told.
const QUIET: Duration = Duration::from_secs(2);

/// The field of that name, or the first.
fn field<'a>(frame: &Frame<'a>, name: Option<&str>) -> Result<Field<'a>, Failure> {
    let Some(name) = name else {
        return Ok(frame.first());
    };
    frame.field(name).ok_or_else(|| {
        let names: Vec<_> = frame
            .fields()
            .map(|field| field.info.name().to_owned())
            .collect();
        Failure::arguments(format!("the frame has no field `{name}`"))
            .with_hint(format!("it has {}", names.join(", ")))
    })
}

fn late(lateness: &Lateness) -> String {
    let us = |span: Duration| span.as_micros();
    format!(
        "late by {} us in the median, 99 % within {} us, at most {} us",
        us(lateness.p50),
        us(lateness.p99),
        us(lateness.max)
    )
}

/// `640x480`, or the name of a usual size.
fn size(text: &str) -> Result<(u32, u32), String> {
    let named = SIZES
        .iter()
        .find(|(name, ..)| name.eq_ignore_ascii_case(text));
    if let Some((_, width, height)) = named {
        return Ok((*width, *height));
    }
    let sides = text.split_once('x');
    let sides = sides.and_then(|(width, height)| Some((width.parse().ok()?, height.parse().ok()?)));
    sides.ok_or_else(|| {
        let names: Vec<&str> = SIZES.iter().map(|(name, ..)| *name).collect();
        format!(
            "`{text}` is not a size: write one as `640x480`, or {}",
            names.join(", ")
        )
    })
}

const SIZES: [(&str, u32, u32); 9] = [
    ("sqcif", 128, 96),
    ("qcif", 176, 144),
    ("qvga", 320, 240),
    ("cif", 352, 288),
    ("vga", 640, 480),
    ("pal", 768, 576),
    ("svga", 800, 600),
    ("720p", 1280, 720),
    ("1080p", 1920, 1080),
];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_are_names_or_numbers() {
        assert_eq!(size("CIF"), Ok((352, 288)));
        assert_eq!(size("12x34"), Ok((12, 34)));
        assert!(size("12").unwrap_err().contains("640x480"));
    }
}
