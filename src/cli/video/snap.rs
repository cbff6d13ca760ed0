//! `ddx video snap`: the present frame as a picture.

use std::fs;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use anyhow::Context as _;
use ddx_store::Delivery;
use ddx_video::convert::to_rgb;
use ddx_video::picture::{PictureFormat, encode};
use serde_json::json;

use super::super::Context;
use super::super::interrupt::Interrupt;
use super::super::render::bytes;
use super::field;
use crate::error::{Exit, Failure, Hint as _, Outcome};
use crate::units;
use crate::video::{StreamReader, frame};

/// Which stream, where to.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Name of the item
    name: String,
    /// The file; its name ends with ppm, png, jpg or tiff
    #[arg(long, short, value_name = "FILE")]
    output: PathBuf,
    /// The field, where a frame has several [default: the first]
    #[arg(long, value_name = "NAME")]
    field: Option<String>,
    /// How long to wait for a frame
    #[arg(long, value_name = "TIME", default_value = "5 s", value_parser = units::span)]
    timeout: Duration,
}

/// Runs the verb.
pub(crate) fn run(context: &mut Context, args: &Args) -> Outcome {
    let extension = args.output.extension().unwrap_or_default();
    let format: PictureFormat = extension.to_string_lossy().parse().arguments()?;
    let interrupt = Interrupt::listen(context.tethered)?;
    let store = context.store("video snap")?;
    let mut stream = StreamReader::open(&store, &args.name, Delivery::Latest, None)?;
    let deadline = Instant::now() + args.timeout;
    let guard = loop {
        if let Some(guard) = stream.frames().next_pinned(super::SLICE)? {
            break guard;
        }
        if interrupt.is_raised() || Instant::now() >= deadline {
            let name = stream.name();
            return Err(Failure::new(format!("no frame of `{name}` came"))
                .with_hint(format!("`ddx why {name}` says why")));
        }
    };
    let frame = frame(&guard)?;
    let field = field(&frame, args.field.as_deref())?;
    let file = encode(&to_rgb(&field)?, format)?;
    let path = args.output.display();
    fs::write(&args.output, &file).with_context(|| format!("cannot write `{path}`"))?;
    let info = frame.info();
    context.out.either(
        &json!({ "frame": info.sequence, "width": field.info.width, "height": field.info.height, "bytes": file.len() }),
        &format!(
            "frame {}, {}, to `{path}`, {}",
            info.sequence,
            field.info,
            bytes(u64::try_from(file.len()).unwrap_or(u64::MAX))
        ),
    )?;
    Ok(Exit::Done)
}
