//! `ddx video load`: a Y4M file, or what a pipe brings, into an item.

use std::fs::File;
use std::io::{self, BufRead, BufReader, Seek as _, SeekFrom};
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, RecvTimeoutError, sync_channel};
use std::thread;
use std::time::Duration;

use ddx_video::frame::{CaptureClock, FrameInfo};
use ddx_video::y4m::{Mark, Reader};
use ddx_wire::Time;
use serde_json::json;

use super::super::Context;
use super::super::interrupt::Interrupt;
use super::super::output::note;
use super::{SLICE, late};
use crate::error::{Exit, Failure, Outcome};
use crate::units;
use crate::video::StreamWriter;
use crate::video::play::{Lateness, Schedule};

/// Which file, and how to play it.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// A Y4M file; `-` is standard input
    file: PathBuf,
    /// Name of the item
    #[arg(long, default_value = "video")]
    name: String,
    /// Frames a second, in place of the recorded times
    #[arg(long, value_name = "RATE", value_parser = units::rate)]
    rate: Option<f64>,
    /// Publish a frame when all readers have read the one before
    #[arg(long, conflicts_with_all = ["rate", "step"])]
    lockstep: bool,
    /// Publish a frame for each line of standard input: empty for the next one, `p` for the one before, a number, `q`
    #[arg(long, conflicts_with = "rate")]
    step: bool,
    /// Begin with this frame, from 1
    #[arg(long, value_name = "FRAME", default_value_t = 1)]
    from: u64,
    /// End behind this one
    #[arg(long, value_name = "FRAME")]
    to: Option<u64>,
    /// Start again at the end
    #[arg(long = "loop")]
    looped: bool,
}

/// A file that may be read again from any frame, or a pipe.
trait Input: BufRead + Send {
    /// Where it stands, if it can be moved.
    fn place(&mut self) -> Option<u64>;
    /// Moves it.
    fn go(&mut self, to: u64) -> io::Result<()>;
}

struct Pipe<R>(R);

struct Player {
    reader: Reader<Box<dyn Input>>,
    stream: StreamWriter,
    /// Where the line of each frame that was reached begins.
    places: Vec<Option<u64>>,
    /// The frame that comes next, from 1.
    next: u64,
    published: u64,
    schedule: Option<Schedule>,
    /// When the frame that was published last has been shown for as long as it should be, in the recording's time.
    ends: Duration,
}

/// Runs the verb.
pub(crate) fn run(context: &mut Context, args: &Args) -> Outcome {
    let path = args.file.display().to_string();
    let is_pipe = args.file == Path::new("-");
    if is_pipe && (args.step || args.looped) {
        return Err(
            Failure::arguments("a pipe cannot be stepped through or looped")
                .with_hint("write it to a file first"),
        );
    }
    if args.to.is_some_and(|to| to < args.from) || args.from == 0 {
        return Err(Failure::arguments(
            "frames are counted from 1, and `--to` is not before `--from`",
        ));
    }
    let interrupt = Interrupt::listen(context.tethered)?;
    let named = |failure: Failure| failure.context(format!("`{path}`"));
    let input = open(&args.file, is_pipe).map_err(named)?;
    let reader = Reader::new(input).map_err(Failure::from).map_err(named)?;
    if let Some(loss) = reader.left_out() {
        note(&format!("`{path}`: {loss}"));
    }
    let store = context.store("video load")?;
    let stream = StreamWriter::open(&store, &args.name, reader.layout().clone(), &path)?;
    let mut player = Player {
        reader,
        stream,
        places: Vec::new(),
        next: 1,
        published: 0,
        schedule: None,
        ends: Duration::ZERO,
    };
    let played = if args.step {
        player.step(args, &interrupt)
    } else {
        player.play(args, &interrupt)
    };
    played.map_err(named)?;
    let (published, lateness) = (player.published, player.schedule.map(Schedule::lateness));
    let ns =
        |of: fn(&Lateness) -> Duration| lateness.as_ref().map(|lateness| of(lateness).as_nanos());
    let text = match &lateness {
        Some(lateness) => format!("{published} frames, {}", late(lateness)),
        None => format!("{published} frames"),
    };
    context.out.either(
        &json!({ "frames": published, "late_p50_ns": ns(|l| l.p50), "late_p99_ns": ns(|l| l.p99) }),
        &text,
    )?;
    Ok(Exit::Done)
}

fn open(path: &Path, is_pipe: bool) -> Result<Box<dyn Input>, Failure> {
    if is_pipe {
        return Ok(Box::new(Pipe(BufReader::with_capacity(
            BUFFER_BYTES,
            io::stdin(),
        ))));
    }
    let file = File::open(path)?;
    let kind = file.metadata()?.file_type();
    if kind.is_dir() {
        return Err(Failure::new("it is a directory"));
    }
    if kind.is_file() {
        return Ok(Box::new(BufReader::with_capacity(BUFFER_BYTES, file)));
    }
    Ok(Box::new(Pipe(BufReader::with_capacity(BUFFER_BYTES, file))))
}

impl Player {
    fn play(&mut self, args: &Args, interrupt: &Interrupt) -> Result<(), Failure> {
        loop {
            // The last frame of the round before has its time, too.
            let ended = self.schedule.take();
            let begins = ended.map(|schedule| schedule.due(self.ends));
            self.skip_to(args.from)?;
            while args.to.is_none_or(|to| self.next <= to) {
                // Nobody reads any more who has what they wanted: at the end there is nothing to wait for.
                if args.lockstep && !self.reader.is_at_end()? && !self.is_awaited(interrupt) {
                    return Ok(());
                }
                let pace = |at: Duration, schedule: &mut Option<Schedule>| {
                    if args.lockstep {
                        return Some(ddx_store::now());
                    }
                    let now = ddx_store::now();
                    let begins = begins.map_or(now, |begins| begins.max(now));
                    let schedule = schedule.get_or_insert_with(|| Schedule::new(begins, at));
                    let due = schedule.due(at);
                    let goes_on = interrupt.sleep_until(due);
                    let now = ddx_store::now();
                    schedule.note(due, now);
                    goes_on.then_some(now)
                };
                if !self.publish(args.rate, pace)? {
                    break;
                }
                if interrupt.is_raised() {
                    return Ok(());
                }
            }
            if !args.looped || interrupt.is_raised() {
                return Ok(());
            }
            self.go(args.from)?;
        }
    }

    /// Publishes a frame for each command.
    fn step(&mut self, args: &Args, interrupt: &Interrupt) -> Result<(), Failure> {
        self.skip_to(args.from)?;
        let commands = commands()?;
        let mut current = args.from;
        let mut is_first = true;
        loop {
            if !is_first {
                let Some(line) = wait(&commands, interrupt) else {
                    return Ok(());
                };
                let to = match line.trim() {
                    "" | "n" => current + 1,
                    "p" => current.saturating_sub(1),
                    "q" => return Ok(()),
                    word => match word.parse() {
                        Ok(frame) => frame,
                        Err(_) => {
                            note(&format!(
                                "`{word}` is no command: an empty line, p, q or a number"
                            ));
                            continue;
                        }
                    },
                };
                if to < args.from || args.to.is_some_and(|last| to > last) {
                    note(&format!("frame {to} is not among those that are played"));
                    continue;
                }
                current = to;
            }
            is_first = false;
            if !self.go(current)? || !self.publish(args.rate, |_, _| Some(ddx_store::now()))? {
                note(&format!("there is no frame {current}"));
                current = self.next.saturating_sub(1);
                continue;
            }
            note(&format!("frame {current}"));
        }
    }

    /// Waits until somebody reads, and all who do have read the newest frame; false when the program should end first.
    fn is_awaited(&self, interrupt: &Interrupt) -> bool {
        let mut pause = Duration::from_micros(20);
        while self.stream.readers() == 0 || !self.stream.is_consumed() {
            if interrupt.is_raised() {
                return false;
            }
            thread::sleep(pause);
            pause = (pause * 2).min(Duration::from_millis(2));
        }
        true
    }

    /// Reads the line before the next frame; `None` at the end.
    fn mark(&mut self) -> Result<Option<Mark>, Failure> {
        let place = self.reader.input_mut().place();
        let index = usize::try_from(self.next - 1).unwrap_or(usize::MAX);
        if index == self.places.len() {
            self.places.push(place);
        }
        let mark = self.reader.next_mark()?;
        self.next += 1;
        Ok(mark)
    }

    /// Publishes the next frame; false at the end, or when `pace`, which is told its time and waits for it, says so.
    fn publish(
        &mut self,
        rate: Option<f64>,
        pace: impl FnOnce(Duration, &mut Option<Schedule>) -> Option<Time>,
    ) -> Result<bool, Failure> {
        let number = self.next;
        let Some(mark) = self.mark()? else {
            self.next = number;
            return Ok(false);
        };
        let recorded = self.reader.header().rate;
        let per_second = recorded.map_or(UNKNOWN_RATE, |(over, under)| {
            f64::from(over) / f64::from(under)
        });
        let by_rate = |rate: f64| {
            let index = u32::try_from(number - 1).unwrap_or(u32::MAX);
            Duration::from_secs_f64(f64::from(index) / rate)
        };
        let original = mark
            .time_ns
            .map_or_else(|| by_rate(per_second), Duration::from_nanos);
        let at = rate.map_or(original, by_rate);
        self.ends = at + Duration::from_secs_f64(1.0 / rate.unwrap_or(per_second));
        let info = FrameInfo {
            sequence: mark.sequence.unwrap_or(number),
            capture_ns: u64::try_from(original.as_nanos()).unwrap_or(u64::MAX),
            clock: CaptureClock::Recording,
            ..FrameInfo::default()
        };
        let (reader, schedule) = (&mut self.reader, &mut self.schedule);
        let published = self.stream.publish(0, |layout, bytes| {
            layout.write_header(bytes, &info)?;
            reader.read_planes(bytes)?;
            Ok(pace(at, schedule).map(|now| (info, now)))
        })?;
        self.published += u64::from(published.is_some());
        Ok(published.is_some())
    }

    /// Reads on until the next frame is this one.
    fn skip_to(&mut self, frame: u64) -> Result<(), Failure> {
        let mut scratch = vec![0; self.stream.layout().size_bytes()];
        while self.next < frame && self.mark()?.is_some() {
            self.reader.read_planes(&mut scratch)?;
        }
        Ok(())
    }

    /// Moves the file so that the next frame is this one; false when there is none.
    fn go(&mut self, frame: u64) -> Result<bool, Failure> {
        let index = usize::try_from(frame.saturating_sub(1)).unwrap_or(usize::MAX);
        if let Some(Some(place)) = self.places.get(index) {
            self.reader.input_mut().go(*place)?;
            self.reader.moved_to(frame);
            self.next = frame;
        }
        self.skip_to(frame)?;
        Ok(self.next == frame)
    }
}

impl Input for BufReader<File> {
    fn place(&mut self) -> Option<u64> {
        self.stream_position().ok()
    }

    fn go(&mut self, to: u64) -> io::Result<()> {
        self.seek(SeekFrom::Start(to)).map(|_| ())
    }
}

impl<R: BufRead + Send> Input for Pipe<R> {
    fn place(&mut self) -> Option<u64> {
        None
    }

    fn go(&mut self, _to: u64) -> io::Result<()> {
        Err(io::ErrorKind::NotSeekable.into())
    }
}

impl<R: BufRead> io::Read for Pipe<R> {
    fn read(&mut self, into: &mut [u8]) -> io::Result<usize> {
        self.0.read(into)
    }
}

impl<R: BufRead> BufRead for Pipe<R> {
    fn fill_buf(&mut self) -> io::Result<&[u8]> {
        self.0.fill_buf()
    }

    fn consume(&mut self, amount: usize) {
        self.0.consume(amount);
    }
}

/// The lines of standard input, read by a thread of its own: waiting for them must not keep an interrupt out.
fn commands() -> Result<Receiver<String>, Failure> {
    let (lines, commands) = sync_channel(1);
    thread::Builder::new()
        .name("commands".to_owned())
        .spawn(move || {
            for line in io::stdin().lines() {
                let Ok(line) = line else { return };
                if lines.send(line).is_err() {
                    return;
                }
            }
        })?;
    Ok(commands)
}

/// The next command; `None` at their end or when the program should end.
fn wait(commands: &Receiver<String>, interrupt: &Interrupt) -> Option<String> {
    loop {
        match commands.recv_timeout(SLICE) {
            Ok(line) => return Some(line),
            Err(RecvTimeoutError::Timeout) if !interrupt.is_raised() => {}
            Err(_) => return None,
        }
    }
}

/// Where a file does not say: that of PAL.
const UNKNOWN_RATE: f64 = 25.0;
const BUFFER_BYTES: usize = 1 << 20;
