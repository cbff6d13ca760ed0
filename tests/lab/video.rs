//! Video crosses a link bit for bit, and only while somebody looks.

use std::fs::{self, File};
use std::io::BufReader;
use std::process::Command;
use std::time::Duration;

use ddx_rig::lab::{Counters, Loss, Process};
use ddx_video::y4m::Reader;

use crate::site::{PATIENCE, SAMPLES, Site, row, wait};

#[test]
fn video_arrives_bit_for_bit_however_many_datagrams_are_lost() {
    let Some(mut site) = Site::new(&["robot1", "base"]) else {
        return;
    };
    row("picture          loss %   frames   sent/picture bytes");
    for (size, frames, rate) in [
        (FILM, 13, "15 Hz"),
        ("640x480", 30, "30 Hz"),
        ("1080p", 30, "30 Hz"),
    ] {
        // Some pass before the reader's wish is known on the robot.
        if size == FILM {
            let path = path_of(&mut site, "robot1", "a.y4m");
            fs::copy(CLIP, path).unwrap();
        } else {
            record(&site, size, 2 * frames);
        }
        for percent in [0, 1, 5] {
            let loss = Loss {
                to_percent: percent,
                ..Loss::default()
            };
            site.lab.host("base").set_loss(loss).unwrap();
            crosses(&mut site, &format!("{size:<14} {percent:>8}"), frames, rate);
        }
        site.lab.host("base").set_loss(Loss::default()).unwrap();
    }
    // What is lost comes a round trip of 20 ms later, and what the link carries is known later than the first frames come: somebody
    // looks before.
    record(&site, "640x480", 150);
    for percent in [1, 5] {
        site.link("base", &format!("lan --delay 10ms --loss {percent}%"));
        let load = "video load /run/a.y4m --name again --rate '30 Hz'";
        let mut loading = background(&site, "robot1", load);
        let look = "video save robot1/again --output /run/before.y4m";
        let mut looking = background(&site, "base", look);
        let seen = path_of(&mut site, "base", "before.y4m");
        wait("a second of video", PATIENCE, || {
            let written = fs::metadata(&seen).map_or(0, |file| file.len());
            (written > SECOND_BYTES)
                .then_some(())
                .ok_or(format!("{written} bytes"))
        });
        let what = format!("640x480, 20 ms {percent:>8}");
        let saving = save(&site, 30);
        compare(&mut site, saving, &what, 30);
        looking.terminate(PATIENCE).unwrap();
        loading.terminate(PATIENCE).unwrap();
    }
}

/// Plays the recording on the robot and records it on base.
fn crosses(site: &mut Site, what: &str, frames: usize, rate: &str) {
    let saving = save(site, frames);
    let load = format!("video load /run/a.y4m --name again --rate '{rate}'");
    let mut loading = background(site, "robot1", &load);
    compare(site, saving, what, frames);
    loading.terminate(PATIENCE).unwrap();
}

fn save(site: &Site, frames: usize) -> (Process, Counters) {
    let before = site.counters();
    let save = format!("video save robot1/again --output /run/b.y4m --frames {frames}");
    (background(site, "base", &save), before)
}

/// What is recorded is frame by frame, bit by bit what was played.
fn compare(site: &mut Site, (mut saving, before): (Process, Counters), what: &str, frames: usize) {
    let status = saving.wait(RECORDED).unwrap();
    assert!(status.success(), "{} {}", saving.output(), saving.errors());
    let sent = site.counters().since(&before);
    let played = frames_of(site, "robot1", "a.y4m");

    let saved = frames_of(site, "base", "b.y4m");
    assert_eq!(saved.len(), frames);
    let mut bytes = 0;
    for ((number, frame), expected) in saved.iter().zip(saved[0].0..) {
        assert_eq!(*number, expected, "{what}");
        let same = played
            .iter()
            .any(|other| *other == (*number, frame.clone()));
        assert!(same, "frame {number} of {what} is another");
        bytes += frame.len();
    }
    let sent = f64::from(u32::try_from(sent.udp(SAMPLES, "robot1").from.bytes).unwrap());
    let per_byte = sent / f64::from(u32::try_from(bytes).unwrap());
    row(&format!("{what} {frames:>8} {per_byte:>13.3}"));
}

#[test]
fn video_is_sent_only_while_somebody_looks() {
    let Some(site) = Site::new(&["robot1", "base"]) else {
        return;
    };
    let mut camera = background(&site, "robot1", "video pattern --name cam --size qvga");
    site.wait_listed("base", "robot1/cam", true);
    let before = site.counters();
    // Two seconds of video on its own host.
    site.ddx("robot1", &["hz", "robot1/cam", "--count", "2"]);
    let sent = |before| {
        site.counters()
            .since(before)
            .udp(SAMPLES, "robot1")
            .from
            .bytes
    };
    assert_eq!(sent(&before), 0);

    let seen = site.ddx("base", &["hz", "robot1/cam", "--count", "2"]);
    let rate = seen[1]["rate_hz"].as_f64().unwrap();
    assert!((25.0..35.0).contains(&rate), "{seen:?}");
    assert_eq!(seen[1]["fields"], "320x240 I420", "{seen:?}");
    assert!(sent(&before) > 30 * 320 * 240, "{seen:?}");
    let about = &site.ddx("base", &["info", "robot1/cam"])[0]["stream"];
    assert_eq!(about["source"], "pattern", "{about}");

    site.wait_quiet("robot1");
    camera.terminate(PATIENCE).unwrap();
}

/// Makes `/run/a.y4m` on the robot.
fn record(site: &Site, size: &str, frames: usize) {
    let pattern = format!("video pattern --name cam --size {size} --rate 30");
    let mut camera = background(site, "robot1", &pattern);
    let frames = frames.to_string();
    let save = ["video", "save", "cam", "--output", "/run/a.y4m", "--frames"];
    let saved = site.ddx("robot1", &[&save[..], &[&frames]].concat());
    assert_eq!(saved[0]["missed"], 0, "{saved:?}");
    camera.terminate(PATIENCE).unwrap();
}

fn background(site: &Site, host: &str, line: &str) -> Process {
    let mut command = Command::new("sh");
    let ddx = env!("CARGO_BIN_EXE_ddx");
    command.args(["-c", &format!("exec {ddx} --json {line}")]);
    site.lab.host(host).spawn(&command).unwrap()
}

/// A file in a host's `/run`.
fn path_of(site: &mut Site, host: &str, file: &str) -> String {
    format!("/proc/{}/root/run/{file}", site.pid(host))
}

/// The frames of such a file, with their numbers at their source, or from 1 where it does not say.
fn frames_of(site: &mut Site, host: &str, file: &str) -> Vec<(u64, Vec<u8>)> {
    let path = path_of(site, host, file);
    let mut reader = Reader::new(BufReader::new(File::open(path).unwrap())).unwrap();
    let mut frames = Vec::new();
    let mut frame = vec![0; reader.layout().size_bytes()];
    for number in 1.. {
        let Some(mark) = reader.next_mark().unwrap() else {
            break;
        };
        reader.read_planes(&mut frame).unwrap();
        frames.push((mark.sequence.unwrap_or(number), frame.clone()));
    }
    frames
}

/// A real one, of 26 frames, beside the pattern.
const FILM: &str = "film";
const CLIP: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/deploy/data/bunny.y4m");
/// A second of 640x480, 30 frames of 4:2:0.
const SECOND_BYTES: u64 = 30 * 640 * 480 * 3 / 2;
const RECORDED: Duration = Duration::from_secs(30);
