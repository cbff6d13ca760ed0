//! `ddx video pattern`: a moving picture that carries its number and its capture time.

use std::time::Duration;

use ddx_video::frame::FrameInfo;
use ddx_video::pattern::Pattern;
use serde_json::json;

use super::super::Context;
use super::super::interrupt::Interrupt;
use super::{late, size};
use crate::error::{Exit, Hint as _, Outcome};
use crate::units;
use crate::video::StreamWriter;
use crate::video::play::Schedule;

/// What picture, how often.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Name of the item
    #[arg(long, default_value = "video")]
    name: String,
    /// Width and height, or a name such as cif
    #[arg(long, value_name = "SIZE", default_value = "640x480", value_parser = size)]
    size: (u32, u32),
    /// Names of the pictures of one instant that each frame holds
    #[arg(
        long,
        value_name = "NAMES",
        value_delimiter = ',',
        default_value = "picture"
    )]
    fields: Vec<String>,
    /// Frames a second
    #[arg(long, value_name = "RATE", default_value = "30 Hz", value_parser = units::rate)]
    rate: f64,
    /// Stop after so many frames
    #[arg(long, value_name = "K")]
    frames: Option<u64>,
}

/// Runs the verb. Without `--frames` it ends when it is interrupted.
pub(crate) fn run(context: &mut Context, args: &Args) -> Outcome {
    let (width, height) = args.size;
    let fields: Vec<&str> = args.fields.iter().map(String::as_str).collect();
    let pattern = Pattern::new(width, height, &fields)
        .hint(|| "at least 64x64, and 1 to 8 fields".to_owned())
        .arguments()?;
    let interrupt = Interrupt::listen(context.tethered)?;
    let store = context.store("video pattern")?;
    let layout = pattern.layout().clone();
    let mut stream = StreamWriter::open(&store, &args.name, layout, "pattern")?;
    let mut schedule = Schedule::new(ddx_store::now(), Duration::ZERO);
    let mut frames = 0_u64;
    while args.frames.is_none_or(|most| frames < most) {
        let at = u32::try_from(frames).map_or(Duration::MAX, |n| {
            Duration::from_secs_f64(f64::from(n) / args.rate)
        });
        let due = schedule.due(at);
        if !interrupt.sleep_until(due) {
            break;
        }
        frames += 1;
        stream.publish(0, |_, bytes| {
            let now = ddx_store::now();
            schedule.note(due, now);
            let info = FrameInfo {
                sequence: frames,
                capture_ns: now.0,
                ..FrameInfo::default()
            };
            pattern.draw(bytes, &info)?;
            Ok(Some((info, now)))
        })?;
    }
    let lateness = schedule.lateness();
    context.out.either(
        &json!({ "frames": frames, "late_p50_ns": lateness.p50.as_nanos(), "late_p99_ns": lateness.p99.as_nanos() }),
        &format!("{frames} frames, {}", late(&lateness)),
    )?;
    Ok(Exit::Done)
}
