//! What video costs: on one host beside iceoryx2 and GStreamer's shared memory, between hosts beside GStreamer's RTP, and how well a
//! recording keeps its times.

use std::fs;
use std::io::{BufRead, BufReader};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail};
use ddx_rig::lab::{self, Host, Process};
use ddx_store::{RawReader, ReaderOptions, Schema, Store, WriterOptions};

use crate::bench::Bench;
use crate::frames;
use crate::network::{PATIENCE, play, start_daemons};
use crate::programs::{Daemon, Programs, figures};
use crate::stats::{Contest, Turn, median};
use crate::table::Row;

const US: (&str, f64) = ("us", 1e3);
const ICEORYX: &str = "iceoryx2";
const SHM: &str = "shmsink";
const RTP: &str = "rtpvrawpay";
/// Readers of a stream at most, here.
const READERS: u32 = 12;
const RTP_PORT: u16 = 7_003;
/// Longest datagrams of an Ethernet of 1,500 bytes.
const RTP_MTU: usize = 1_472;

/// A stream of frames of 4:2:0.
#[derive(Clone, Copy)]
struct Stream {
    width: usize,
    height: usize,
    rate: u32,
}

const VGA: Stream = Stream {
    width: 640,
    height: 480,
    rate: 30,
};
const FULL_HD: Stream = Stream {
    width: 1920,
    height: 1080,
    rate: 30,
};
const FULL_HD_60: Stream = Stream {
    rate: 60,
    ..FULL_HD
};

impl Stream {
    fn bytes(self) -> usize {
        self.width * self.height * 3 / 2
    }

    fn name(self) -> String {
        format!("{}x{} {}/s", self.width, self.height, self.rate)
    }

    fn frames(self, seconds: u32) -> u32 {
        self.rate * seconds
    }

    /// How GStreamer knows it.
    fn caps(self) -> String {
        let Self {
            width,
            height,
            rate,
        } = self;
        format!("video/x-raw,format=I420,width={width},height={height},framerate={rate}/1")
    }

    /// GStreamer's source of it. What it draws is cheap, and drawn alike where nothing is done with it.
    fn drawn(self, frames: u32) -> String {
        format!(
            "videotestsrc is-live=true pattern=black num-buffers={frames} ! {}",
            self.caps()
        )
    }
}

/// Publishes frames, each copied into its place as from a driver's buffer.
pub(crate) fn feed(store: &Store, name: &str, bytes: usize, rate: u32, count: u32) -> Result<()> {
    let options = WriterOptions {
        max_readers: READERS,
        capacity_bytes: Some(u32::try_from(bytes)?),
        ..WriterOptions::default()
    };
    let mut writer = store.raw_writer(name, &Schema::bytes(), options)?;
    let frame = vec![128; bytes];
    frames::feed(rate, count, || {
        let mut loan = writer.loan(bytes)?;
        loan.as_mut_slice().copy_from_slice(&frame);
        loan.publish()?;
        Ok(())
    })
}

/// Looks at frames in their place. Prints at last how many of them were missed.
pub(crate) fn view(store: &Store, name: &str, bytes: usize, count: u32) -> Result<()> {
    let mut reader = store.raw_reader(name, None, ReaderOptions::default())?;
    let (mut last, mut missed) = (None, 0);
    frames::view(count, || {
        let seq = next(&mut reader, bytes)?;
        missed += last.map_or(0, |last| seq.saturating_sub(last + 1));
        last = Some(seq);
        Ok(())
    })?;
    println!("{missed}");
    Ok(())
}

/// The number of the next frame.
fn next(reader: &mut RawReader, bytes: usize) -> Result<u64> {
    let frame = reader.next_pinned(PATIENCE)?.context("no frame in time")?;
    if frame.bytes().len() != bytes {
        bail!(
            "a frame of {} bytes in place of {bytes}",
            frame.bytes().len()
        );
    }
    Ok(frame.meta().seq.0)
}

/// `video`: what a stream costs its source and each of its readers.
pub(crate) fn video(bench: &mut Bench) -> Result<()> {
    let seconds = bench.scale(1, 4);
    for (stream, readers) in [(VGA, 0), (VGA, 1), (VGA, 10), (FULL_HD_60, 1)] {
        let daemon = Daemon::start(&bench.programs)?;
        let count = stream.frames(seconds);
        let programs = &bench.programs;
        let mut ours = || local(programs, Some(&daemon), stream, readers, count);
        let mut peer = || local(programs, None, stream, readers, count);
        let mut turns: Vec<Turn<'_>> = vec![&mut ours];
        if programs.has_peer() {
            turns.push(&mut peer);
        }
        let contest = Contest::run(bench.scale(1, 5), &mut turns)?;
        let peer = bench.programs.has_peer().then_some((ICEORYX, 1));
        let of = match readers {
            0 => "nobody reads".to_owned(),
            1 => "1 reader".to_owned(),
            _ => format!("{readers} readers"),
        };
        for (figure, who) in ["source", "each reader"].into_iter().enumerate() {
            if figure == 0 || readers > 0 {
                let what = format!("{}, {of}: {who}, CPU for a frame", stream.name());
                bench
                    .table
                    .contest(what, US, (&contest, figure), None, peer, "");
            }
        }
    }
    if has_gstreamer("shmsink") {
        let count = VGA.frames(seconds);
        let mut ours = Vec::new();
        let mut theirs = Vec::new();
        for _ in 0..bench.scale(1, 5) {
            let daemon = Daemon::start(&bench.programs)?;
            ours.push(local(&bench.programs, Some(&daemon), VGA, 1, count)?);
            theirs.push(shared_memory(VGA, count)?);
        }
        let contest = Contest::of(ours.into_iter().zip(theirs));
        for (figure, who) in ["source", "each reader"].into_iter().enumerate() {
            let what = format!("{}, 1 reader: {who}, CPU for a frame", VGA.name());
            let peer = Some((SHM, 1));
            bench
                .table
                .contest(what, US, (&contest, figure), None, peer, "");
        }
    }
    Ok(())
}

/// Processor time for a frame, nanoseconds: of the source, and of a reader (the mean of all). With a daemon ours, without iceoryx2.
fn local(
    programs: &Programs,
    daemon: Option<&Daemon>,
    stream: Stream,
    readers: usize,
    count: u32,
) -> Result<Vec<f64>> {
    let name = format!("frames-{}", std::process::id());
    let start = |part: &str, words: &[&str]| -> Result<Playing> {
        let mut command = match daemon {
            Some(daemon) => {
                let mut command = Command::new(&programs.own);
                command.args(["role", part, "--socket"]);
                command.arg(daemon.socket());
                command
            }
            None => programs.peer_command(part)?,
        };
        Playing::start(command.arg(&name).args(words))
    };
    let (bytes, rate, frames) = (
        stream.bytes().to_string(),
        stream.rate.to_string(),
        count.to_string(),
    );
    let source_of = ["frames-out", &bytes, &rate, &frames];
    let mut source = start(source_of[0], &source_of[1..])?;
    let view = count.saturating_sub(count / 4).max(1).to_string();
    let mut viewers = Vec::new();
    for _ in 0..readers {
        viewers.push(start("frames-in", &[&bytes, &view])?);
    }
    let mut each = Vec::new();
    for viewer in &mut viewers {
        each.push(viewer.figure()?);
    }
    let mean = each.iter().sum::<f64>() / each.len().max(1) as f64;
    Ok(vec![source.figure()?, mean])
}

/// A program that prints figures. Dropped, it is killed.
struct Playing {
    child: Child,
    output: BufReader<std::process::ChildStdout>,
}

impl Playing {
    fn start(command: &mut Command) -> Result<Self> {
        let mut child = command
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .spawn()
            .with_context(|| format!("starting {command:?}"))?;
        let output = child.stdout.take().context("its output is a pipe")?;
        Ok(Self {
            child,
            output: BufReader::new(output),
        })
    }

    /// The next figure that it prints.
    fn figure(&mut self) -> Result<f64> {
        loop {
            let mut line = String::new();
            if self.output.read_line(&mut line)? == 0 {
                bail!("a program ended without a figure");
            }
            if let Ok(figure) = line.trim().parse() {
                return Ok(figure);
            }
        }
    }
}

impl Drop for Playing {
    fn drop(&mut self) {
        // One that has ended needs no kill.
        self.child.kill().ok();
        self.child.wait().ok();
    }
}

/// The same for GStreamer, from one process to another: what the source takes beyond drawing.
fn shared_memory(stream: Stream, count: u32) -> Result<Vec<f64>> {
    let socket = std::env::temp_dir().join(format!("ddx-bench-shm-{}", std::process::id()));
    fs::remove_file(&socket).ok();
    let at = socket.display();
    let drawn = stream.drawn(count);
    let alone = pipeline(&format!("{drawn} ! fakesink"), None).output()?;
    // 8 frames, as many as the ring of ddx holds.
    let size = 8 * stream.bytes();
    let source = pipeline(
        &format!(
            "{drawn} ! shmsink socket-path={at} shm-size={size} sync=false wait-for-connection=true"
        ),
        None,
    )
    .stderr(Stdio::piped())
    .spawn()?;
    let until = Instant::now() + PATIENCE;
    while !socket.exists() {
        if Instant::now() > until {
            bail!("shmsink made no socket");
        }
        std::thread::yield_now();
    }
    let span = Duration::from_secs((count / stream.rate).into()) + Duration::from_secs(2);
    let viewer = pipeline(
        &format!(
            "shmsrc socket-path={at} is-live=true ! {} ! fakesink sync=false",
            stream.caps()
        ),
        Some(span),
    )
    .stderr(Stdio::piped())
    .spawn()?;
    let (source, viewer) = (source.wait_with_output()?, viewer.wait_with_output()?);
    let spent = |errors: &[u8]| cpu_seconds(&String::from_utf8_lossy(errors));
    let frames = f64::from(count);
    Ok(vec![
        (spent(&source.stderr)? - spent(&alone.stderr)?) / frames * 1e9,
        spent(&viewer.stderr)? / frames * 1e9,
    ])
}

/// `raw`: what a stream of full frames costs the daemons of two hosts.
pub(crate) fn raw(bench: &mut Bench) -> Result<()> {
    let Some(lab) = lab::require(&["a", "b"]) else {
        return Ok(());
    };
    let mut daemons = start_daemons(&lab, &bench.programs, false)?;
    let count = FULL_HD.frames(bench.scale(1, 5));
    let (a, b) = (lab.host("a"), lab.host("b"));
    let programs = &bench.programs;
    let mut missed = Vec::new();
    let mut ours = || {
        let (cost, lost) = between(programs, &mut daemons, a, b, count)?;
        missed.push(lost);
        Ok(cost)
    };
    let mut rtp = || by_rtp(a, b, count);
    let mut turns: Vec<Turn<'_>> = vec![&mut ours];
    let has_peer = has_gstreamer("rtpvrawpay");
    if has_peer {
        turns.push(&mut rtp);
    }
    let contest = Contest::run(bench.scale(1, 3), &mut turns)?;
    for (figure, who) in ["sending", "receiving"].into_iter().enumerate() {
        bench.table.contest(
            format!("{} between hosts: {who}, CPU for a frame", FULL_HD.name()),
            US,
            (&contest, figure),
            None,
            has_peer.then_some((RTP, 1)),
            "a third of rtpvrawpay",
        );
    }
    bench.table.push(Row {
        what: format!("of {count} frames, missed by the reader"),
        unit: "frames",
        ddx: median(missed.into_iter()),
        floor: None,
        peer: None,
        budget: "0",
    });
    Ok(())
}

/// Processor time of the sending and of the receiving daemon for a frame, nanoseconds, and how many frames were missed.
fn between(
    programs: &Programs,
    daemons: &mut [Process],
    a: Host<'_>,
    b: Host<'_>,
    count: u32,
) -> Result<(Vec<f64>, f64)> {
    let (bytes, rate, frames) = (
        FULL_HD.bytes().to_string(),
        FULL_HD.rate.to_string(),
        count.to_string(),
    );
    let _source = play(a, programs, &["frames-out", "raw", &bytes, &rate, &frames])?;
    let viewer = play(b, programs, &["frames-in", "a/raw", &bytes, &frames])?;
    viewer.wait_line(|line| line == "ready", PATIENCE)?;
    let mut spent = |place: usize| -> Result<f64> { cpu_of(daemons[place].pid()?) };
    let before = [spent(0)?, spent(1)?];
    let is_figure = |line: &str| line.parse::<f64>().is_ok();
    viewer.wait_line(is_figure, PATIENCE)?;
    let after = [spent(0)?, spent(1)?];
    let missed: Vec<f64> = figures(&viewer.wait_line(is_figure, PATIENCE)?);
    let missed = missed.first().copied().unwrap_or(f64::NAN);
    // What was missed was sent, or should have been.
    let sent = f64::from(count) + missed;
    let each = |place: usize| (after[place] - before[place]) / sent * 1e9;
    Ok((vec![each(0), each(1)], missed))
}

/// The same for GStreamer: its sender beyond drawing, its receiver as it is.
fn by_rtp(a: Host<'_>, b: Host<'_>, count: u32) -> Result<Vec<f64>> {
    let drawn = FULL_HD.drawn(count);
    let alone = a.exec(&pipeline(&format!("{drawn} ! fakesink"), None))?;
    let span = Duration::from_secs((count / FULL_HD.rate).into()) + Duration::from_secs(3);
    let (width, height) = (FULL_HD.width, FULL_HD.height);
    let receiver = b.spawn(&pipeline(
        &format!(
            "udpsrc port={RTP_PORT} buffer-size=8388608 caps=\"application/x-rtp,media=video,clock-rate=90000,encoding-name=RAW,\
             sampling=YCbCr-4:2:0,depth=(string)8,width=(string){width},height=(string){height},payload=96\" \
             ! rtpvrawdepay ! fakesink"
        ),
        Some(span),
    ))?;
    let sender = a.exec(&pipeline(
        &format!(
            "{drawn} ! rtpvrawpay mtu={RTP_MTU} ! udpsink host={} port={RTP_PORT} buffer-size=8388608",
            b.address()
        ),
        None,
    ))?;
    let mut receiver = receiver;
    receiver.wait(PATIENCE)?;
    let frames = f64::from(count);
    Ok(vec![
        (cpu_seconds(&sender.stderr)? - cpu_seconds(&alone.stderr)?) / frames * 1e9,
        cpu_seconds(&receiver.errors())? / frames * 1e9,
    ])
}

/// A pipeline of GStreamer, ended after a while if that is told, whose processor time is the last line of its errors.
fn pipeline(elements: &str, span: Option<Duration>) -> Command {
    let ended = span.map_or_else(String::new, |span| {
        format!("timeout -s INT {} ", span.as_secs())
    });
    let mut command = Command::new("bash");
    command.arg("-c").arg(format!(
        "TIMEFORMAT='%U %S'; time {ended}gst-launch-1.0 -q {}",
        elements.replace('!', "'!'")
    ));
    command.stdin(Stdio::null()).stdout(Stdio::null());
    command
}

/// What such a pipeline took: user and system, seconds.
fn cpu_seconds(errors: &str) -> Result<f64> {
    let times = errors.lines().rev().find_map(|line| {
        let (user, system) = line.split_once(' ')?;
        Some(user.parse::<f64>().ok()? + system.parse::<f64>().ok()?)
    });
    times.with_context(|| format!("GStreamer failed: {errors}"))
}

fn has_gstreamer(element: &str) -> bool {
    let inspected = Command::new("gst-inspect-1.0")
        .arg(element)
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .status();
    let is_there = inspected.is_ok_and(|status| status.success());
    if !is_there {
        eprintln!(
            "!!!! NO PEER: GStreamer's {element} is missing (hint: apt-get install gstreamer1.0-tools gstreamer1.0-plugins-good \
             gstreamer1.0-plugins-bad)"
        );
    }
    is_there
}

/// Processor time of all threads of a process, seconds. The kernel tells it in hundredths.
fn cpu_of(pid: u32) -> Result<f64> {
    let stat = fs::read_to_string(format!("/proc/{pid}/stat"))?;
    // The name before the last parenthesis may hold anything.
    let rest = stat.rsplit_once(") ").map_or("", |(_, rest)| rest);
    let ticks: Vec<f64> = rest
        .split(' ')
        .skip(11)
        .take(2)
        .filter_map(|word| word.parse().ok())
        .collect();
    if ticks.len() < 2 {
        bail!("`/proc/{pid}/stat` is not as proc(5) has it: {stat}");
    }
    Ok(ticks.iter().sum::<f64>() / 100.0)
}

/// `replay`: how far from its time each frame of a recording is published.
pub(crate) fn replay(bench: &mut Bench) -> Result<()> {
    const RATE: u32 = 100;
    let daemon = Daemon::start(&bench.programs)?;
    let store = daemon.store()?;
    let frames: u64 = bench.scale(30, 500);
    let path = std::env::temp_dir().join(format!("ddx-bench-{}.y4m", std::process::id()));
    let mut file = format!("YUV4MPEG2 W320 H240 F{RATE}:1 Ip A1:1 C420jpeg\n").into_bytes();
    for _ in 0..frames {
        file.extend_from_slice(b"FRAME\n");
        file.resize(file.len() + 320 * 240 * 3 / 2, 128);
    }
    fs::write(&path, file)?;
    let mut reader = store.raw_reader("replay", None, ReaderOptions::default())?;
    let mut command = Command::new(&bench.programs.ddx);
    command
        .args(["video", "load", "--name", "replay", "--socket"])
        .arg(daemon.socket())
        .arg(&path)
        .stdin(Stdio::null())
        .stdout(Stdio::null());
    let mut player = command.spawn().context("starting `ddx video load`")?;
    let mut errors = Vec::new();
    let mut first = None;
    let period_ns = 1_000_000_000 / u64::from(RATE);
    loop {
        let frame = reader.next_pinned(PATIENCE)?.context("no frame in time")?;
        let (at, number) = (frame.meta().publish.0, frame.meta().seq.0);
        let (began, from) = *first.get_or_insert((at, number));
        errors.push(at.abs_diff(began + (number - from) * period_ns));
        if number >= frames {
            break;
        }
    }
    player.kill().ok();
    player.wait()?;
    fs::remove_file(&path)?;
    let quantiles = crate::stats::p50_p99(errors);
    for (figure, quantile) in ["p50", "p99"].into_iter().enumerate() {
        bench.table.push(Row {
            what: format!(
                "replay of a recording at {RATE}/s: a frame's distance from its time, {quantile}"
            ),
            unit: "us",
            ddx: quantiles[figure] / 1e3,
            floor: None,
            peer: None,
            budget: "",
        });
    }
    Ok(())
}
