//! `ddx video v4l2`: a camera, captured only while somebody reads.

use std::thread;

use serde_json::json;

use super::super::Context;
use super::super::interrupt::Interrupt;
use super::super::output::note;
use super::super::render::Table;
use super::{SLICE, size};
use crate::error::{Exit, Failure, Outcome};
use crate::units;
use crate::video::StreamWriter;
use crate::video::camera::{Capture, Turn, Wanted};
use crate::video::v4l2::Socket;

/// Which camera, and how.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Number, file, or name below /dev/v4l/by-id
    device: String,
    /// Name of the item
    #[arg(long, default_value = "video")]
    name: String,
    /// Width and height, or a name such as cif; the camera gives the nearest that it has
    #[arg(long, value_name = "SIZE", default_value = "640x480", value_parser = size)]
    size: (u32, u32),
    /// Pixel format, such as YUYV [default: the first that it has of I420, NV12, YUYV, UYVY and others]
    #[arg(long, value_name = "FORMAT", value_parser = pixels)]
    format: Option<ddx_video::PixelFormat>,
    /// Frames a second that the camera is asked for [default: its own]
    #[arg(long, value_name = "RATE", value_parser = units::rate)]
    rate: Option<f64>,
    /// Publish one of so many
    #[arg(long, value_name = "N", default_value_t = 1)]
    divide: u64,
    /// A setting, as `gain=10`; may be given several times
    #[arg(long, value_name = "NAME=VALUE", value_parser = setting)]
    set: Vec<(String, i32)>,
    /// List its formats and settings
    #[arg(long)]
    list: bool,
}

/// Runs the verb. It ends when it is interrupted.
pub(crate) fn run(context: &mut Context, args: &Args) -> Outcome {
    let socket = Socket::new(&args.device);
    let path = socket.path().display().to_string();
    let named = |failure: Failure| failure.context(format!("`{path}`"));
    if args.list {
        return list(context, &socket).map_err(named);
    }
    let interrupt = Interrupt::listen(context.tethered)?;
    let wanted = Wanted {
        format: args.format,
        size: Some(args.size),
        rate: args.rate,
    };
    let mut capture =
        Capture::open(socket, wanted, args.set.clone(), args.divide).map_err(named)?;
    let store = context.store("video v4l2")?;
    let layout = capture.mode().layout()?;
    let stream = StreamWriter::open(&store, &args.name, layout, &path)?;
    let mut sink = (stream, path.as_str());
    while !interrupt.is_raised() {
        match capture.turn(&mut sink, SLICE).map_err(named)? {
            Turn::Captured => {}
            Turn::Idle(span) => thread::sleep(span),
            Turn::Gone(why) => note(&format!("`{path}` is gone: {why}")),
            Turn::Back => note(&format!("`{path}` is back")),
        }
    }
    let (frames, damaged) = capture.counts();
    context.out.either(
        &json!({ "frames": frames, "damaged": damaged }),
        &format!("{frames} frames, {damaged} came damaged"),
    )?;
    Ok(Exit::Done)
}

fn list(context: &mut Context, socket: &Socket) -> Outcome {
    let (name, formats, controls) = socket.describe()?;
    if context.out.json {
        let controls = controls.iter().map(|control| {
            json!({ "name": control.name, "value": control.value, "least": control.least,
                "most": control.most, "default": control.default })
        });
        let controls: Vec<_> = controls.collect();
        let all = json!({ "camera": name, "formats": formats, "controls": controls });
        context.out.object(&all)?;
        return Ok(Exit::Done);
    }
    context.out.line(&format!("camera    {name}"))?;
    for format in formats {
        context.out.line(&format!("format    {format}"))?;
    }
    let mut table = Table::new(&["SETTING", "VALUE", "LEAST", "MOST", "DEFAULT"]);
    for control in controls {
        let numbers = [control.value, control.least, control.most, control.default];
        let numbers = numbers.iter().map(ToString::to_string);
        table.row([control.name].into_iter().chain(numbers).collect());
    }
    for line in table.lines() {
        context.out.line(&line)?;
    }
    Ok(Exit::Done)
}

fn pixels(text: &str) -> Result<ddx_video::PixelFormat, String> {
    text.parse()
        .map_err(|fault: ddx_video::Error| fault.to_string())
}

fn setting(text: &str) -> Result<(String, i32), String> {
    let parts = text.split_once('=');
    parts
        .and_then(|(name, value)| Some((name.trim().to_owned(), value.trim().parse().ok()?)))
        .ok_or_else(|| format!("`{text}` is no setting: write one as `gain=10`"))
}
