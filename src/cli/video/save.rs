//! `ddx video save`: a stream from now on to a Y4M file, bit for bit.

use std::fs::File;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use anyhow::Context as _;
use ddx_store::{Delivery, Store};
use ddx_video::y4m::{Header, Mark};
use serde_json::json;

use super::super::Context;
use super::super::interrupt::Interrupt;
use super::super::output::note;
use super::super::render::bytes;
use super::{Quiet, SLICE};
use crate::error::{Exit, Failure, Hint as _, Outcome};
use crate::units;
use crate::video::recorder::{Recorder, Refused, Sink};
use crate::video::{StreamReader, frame};

/// Which stream, where to, how much of it.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Name of the item
    name: String,
    /// The file; what is there is replaced
    #[arg(long, short, value_name = "FILE")]
    output: PathBuf,
    /// Stop after so many frames
    #[arg(long, value_name = "K")]
    frames: Option<u64>,
    /// How long the disk may stall without a loss
    #[arg(long, value_name = "TIME", default_value = "3 s", value_parser = units::span)]
    buffer: Duration,
    /// Frames a second that the buffer is made for, and that other players are told
    #[arg(long, value_name = "RATE", default_value = "30 Hz", value_parser = units::rate)]
    rate: f64,
}

/// What was recorded.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Report {
    pub(crate) frames: u64,
    pub(crate) bytes: u64,
    /// Frames that never came to this program.
    pub(crate) missed: u64,
    /// Frames for which the disk was too slow.
    pub(crate) dropped: u64,
}

/// Runs the verb. Without `--frames` it ends when it is interrupted.
pub(crate) fn run(context: &mut Context, args: &Args) -> Outcome {
    let interrupt = Interrupt::listen(context.tethered)?;
    let store = context.store("video save")?;
    let path = args.output.display();
    let file = File::create(&args.output).with_context(|| format!("cannot create `{path}`"))?;
    let report = save(&store, args, &interrupt, file)
        .map_err(|failure| failure.context(format!("recording to `{path}`")))?;
    context.out.either(
        &json!({ "frames": report.frames, "bytes": report.bytes, "missed": report.missed, "dropped": report.dropped }),
        &format!(
            "{} frames, {}; {} missed, {} dropped",
            report.frames,
            bytes(report.bytes),
            report.missed,
            report.dropped
        ),
    )?;
    Ok(match report.missed + report.dropped {
        0 => Exit::Done,
        _ => Exit::DoneWithLoss,
    })
}

fn save(
    store: &Store,
    args: &Args,
    interrupt: &Interrupt,
    sink: impl Sink,
) -> Result<Report, Failure> {
    let opened = ddx_store::now();
    let mut stream = StreamReader::open(store, &args.name, Delivery::Every, None)?;
    let mut sink = Some(sink);
    let mut recorder: Option<Recorder> = None;
    let mut report = Report::default();
    let mut first_ns = None;
    let mut quiet = Quiet::default();
    let started = Instant::now();
    let mut taken = 0;
    while args.frames.is_none_or(|most| taken < most) && !interrupt.is_raised() {
        let Some(guard) = stream.frames().next_pinned(SLICE)? else {
            if taken == 0 {
                quiet.look(stream.name());
            }
            continue;
        };
        if taken == 0 && guard.meta().publish < opened {
            // It may be the last one of a source that has ended long ago.
            continue;
        }
        let frame = frame(&guard)?;
        let info = *frame.info();
        if let Some(sink) = sink.take() {
            let rate = fraction(args.rate);
            let header = Header::of(&frame.layout(), Some(rate))
                .hint(|| "frames of unlike fields cannot be stored in one Y4M file".to_owned())?;
            let room = (args.buffer.as_secs_f64() * args.rate)
                .ceil()
                .clamp(2.0, ROOM_MAX);
            recorder = Some(Recorder::start(
                sink,
                header,
                usize::try_from(units::whole(room))?,
                guard.bytes().len(),
            )?);
        }
        let since = info
            .capture_ns
            .saturating_sub(*first_ns.get_or_insert(info.capture_ns));
        let mark = Mark {
            time_ns: Some(since),
            sequence: Some(info.sequence),
        };
        let now_missed = stream.frames().missed();
        let missed = now_missed.overwritten + now_missed.lost;
        if missed > report.missed {
            let more = missed - report.missed;
            note(&format!(
                "{more} frames before {} never came, after {:.1?}",
                info.sequence,
                started.elapsed()
            ));
            report.missed = missed;
        }
        let Some(recorder) = &recorder else {
            continue;
        };
        match recorder.take(guard.bytes(), mark) {
            Ok(()) => taken += 1,
            Err(Refused::Full) => {
                report.dropped += 1;
                note(&format!(
                    "frame {} dropped after {:.1?}: the disk is too slow (hint: --buffer)",
                    info.sequence,
                    started.elapsed()
                ));
            }
            Err(Refused::Ended) => break,
        }
    }
    if let Some(recorder) = recorder {
        let written = recorder.finish()?;
        (report.frames, report.bytes) = (written.frames, written.bytes);
    }
    Ok(report)
}

/// A rate as others know it: of NTSC's thousand and first parts too.
fn fraction(rate: f64) -> (u32, u32) {
    let thousandths = units::whole(rate * 1_001.0);
    let is_ntsc =
        (rate - rate.round()).abs() > 1e-6 && (rate * 1_001.0 / 1_000.0).fract().abs() < 1e-3;
    let word = |number: u64| u32::try_from(number).unwrap_or(u32::MAX);
    match is_ntsc {
        true => (word(thousandths), 1_001),
        false => {
            let (mut over, mut under) = (units::whole(rate * 1_000.0), 1_000);
            for factor in [2, 2, 2, 5, 5, 5] {
                if over % factor == 0 && under % factor == 0 {
                    (over, under) = (over / factor, under / factor);
                }
            }
            (word(over), word(under))
        }
    }
}

/// Frames that wait at most.
const ROOM_MAX: f64 = 10_000.0;
