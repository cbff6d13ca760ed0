//! `ddx video split`: pictures of alternate lines become the two fields of another stream.

use ddx_store::{Delivery, RawGuard, Store};
use ddx_video::split::Split;
use serde_json::json;

use super::super::Context;
use super::super::interrupt::{Interrupt, SLICE};
use super::Quiet;
use crate::error::{Exit, Failure, Outcome};
use crate::video::{StreamReader, StreamWriter, frame};

/// Which stream, into which.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Name of the item whose pictures have the lines of two in turn: two cameras on one signal, or television
    name: String,
    /// Name of the item that is written
    #[arg(long, value_name = "NAME", default_value = "split")]
    to: String,
    /// What the field of the lines 0, 2, 4 and so on is called, and that of the others
    #[arg(
        long,
        value_name = "NAMES",
        value_delimiter = ',',
        default_value = "left,right"
    )]
    fields: Vec<String>,
    /// Stop after so many frames
    #[arg(long, value_name = "K")]
    frames: Option<u64>,
}

/// The stream that is made, of frames of one layout.
struct Made {
    split: Split,
    stream: StreamWriter,
}

/// Runs the verb. Without `--frames` it ends when it is interrupted.
///
/// From the first frame on the source is read only while somebody reads what is made of it.
pub(crate) fn run(context: &mut Context, args: &Args) -> Outcome {
    let [upper, lower] = args.fields.as_slice() else {
        return Err(Failure::arguments(format!(
            "--fields takes 2 names, not {}",
            args.fields.len()
        )));
    };
    let names = [upper.as_str(), lower.as_str()];
    let interrupt = Interrupt::listen(context.tethered)?;
    let store = context.store("video split")?;
    let open = || StreamReader::open(&store, &args.name, Delivery::Latest, None);
    let mut source = Some(open()?);
    let (mut made, mut frames, mut quiet): (Option<Made>, u64, _) = (None, 0, Quiet::default());
    while !interrupt.is_raised() && args.frames.is_none_or(|most| frames < most) {
        if made.as_ref().is_some_and(|made| made.stream.readers() == 0) {
            source = None;
            interrupt.sleep_until(ddx_store::now() + SLICE);
            continue;
        }
        let reader = match &mut source {
            Some(reader) => reader,
            None => source.insert(open()?),
        };
        let Some(guard) = reader.frames().next_pinned(SLICE)? else {
            if made.is_none() {
                quiet.look(reader.name());
            }
            continue;
        };
        let mut present = match made.take() {
            Some(made) if made.takes(&guard)? => made,
            former => {
                // Its lease is free before the next is taken.
                drop(former);
                Made::open(&store, args, names, &guard)?
            }
        };
        present.publish(&guard)?;
        made = Some(present);
        frames += 1;
    }
    context.out.either(
        &json!({ "frames": frames }),
        &format!("{frames} frames taken apart"),
    )?;
    Ok(Exit::Done)
}

impl Made {
    fn open(
        store: &Store,
        args: &Args,
        names: [&str; 2],
        guard: &RawGuard,
    ) -> Result<Self, Failure> {
        let split = Split::new(&frame(guard)?.layout(), names)
            .map_err(|fault| Failure::new(format!("`{}`: {fault}", args.name)))?;
        let from = format!("split of {}", args.name);
        let stream = StreamWriter::open(store, &args.to, split.layout().clone(), &from)?;
        Ok(Self { split, stream })
    }

    /// Whether a frame is like the first one.
    fn takes(&self, guard: &RawGuard) -> Result<bool, Failure> {
        Ok(self.split.fits(&frame(guard)?))
    }

    fn publish(&mut self, guard: &RawGuard) -> Result<(), Failure> {
        let frame = frame(guard)?;
        let split = &self.split;
        self.stream.publish(0, |_, bytes| {
            split.write(&frame, bytes)?;
            Ok(Some((*frame.info(), guard.meta().capture)))
        })?;
        Ok(())
    }
}
