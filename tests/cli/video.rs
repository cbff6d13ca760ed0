//! The verbs of video, each against a daemon of its own.

use std::fs::{self, File};
use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::net::TcpStream;
use std::path::Path;
use std::process::{Command, Stdio};

use ddx_video::frame::{Frame, FrameInfo};
use ddx_video::y4m::Reader;
use serde_json::Value;

use crate::{Background, Daemon, Dir, code, command, lossy, text};

const CLIP: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/deploy/data/bunny.y4m");

#[test]
fn a_video_that_is_played_is_recorded_bit_for_bit() {
    let daemon = Daemon::start(&[]);
    let (played, recorded) = (daemon.dir.0.join("a.y4m"), daemon.dir.0.join("b.y4m"));
    fs::write(&played, video(10)).unwrap();
    let (played, recorded) = (played.to_str().unwrap(), recorded.to_str().unwrap());

    let save = &[
        "video", "save", "cam", "--output", recorded, "--frames", "10",
    ];
    let mut saving = daemon.background(save);
    let loaded = daemon.json(&["video", "load", played, "--name", "cam", "--lockstep"]);
    let saved = saving.0.wait().unwrap();

    assert_eq!(loaded["frames"], 10);
    assert_eq!(saved.code(), Some(0));
    assert_eq!(fs::read(recorded).unwrap(), fs::read(played).unwrap());
    let counter = daemon.json(&["get", "robot1/cam/counter"]);
    assert_eq!(counter["value"]["sequence"], 10, "{counter}");
    let info = daemon.json(&["get", "robot1/cam/info"]);
    assert_eq!(info["value"]["fields"][0]["format"], "I420", "{info}");
}

#[test]
fn a_film_from_ffmpeg_is_recorded_bit_for_bit() {
    let daemon = Daemon::start(&[]);
    let recorded = daemon.dir.0.join("b.y4m");
    let save = ["video", "save", "film", "--frames", "26", "--output"];
    let mut saving = daemon.background(&[&save[..], &[recorded.to_str().unwrap()]].concat());
    daemon.json(&["video", "load", CLIP, "--name", "film", "--lockstep"]);

    assert_eq!(saving.0.wait().unwrap().code(), Some(0));
    let frames = |path: &Path| {
        let mut reader = Reader::new(BufReader::new(File::open(path).unwrap())).unwrap();
        let mut frame = vec![0; reader.layout().size_bytes()];
        let mut frames = Vec::new();
        while reader.next_mark().unwrap().is_some() {
            reader.read_planes(&mut frame).unwrap();
            frames.push(frame.clone());
        }
        (reader.layout().clone(), frames)
    };
    let (played, recorded) = (frames(Path::new(CLIP)), frames(&recorded));
    assert_eq!(played.1.len(), 26);
    // What is said of the picture, such as the range of its luma, too.
    assert!(played == recorded, "{:?} {:?}", played.0, recorded.0);
}

#[test]
fn a_recording_begins_with_what_is_played_and_not_with_what_was_played() {
    let daemon = Daemon::start(&[]);
    let (played, recorded) = (daemon.dir.0.join("a.y4m"), daemon.dir.0.join("b.y4m"));
    fs::write(&played, video(5)).unwrap();
    let (played, recorded) = (played.to_str().unwrap(), recorded.to_str().unwrap());
    let load = ["video", "load", played, "--name", "cam"];
    daemon.json(&[&load[..], &["--rate", "1 kHz"]].concat());

    let save = [
        "video", "save", "cam", "--output", recorded, "--frames", "5",
    ];
    let mut saving = daemon.background(&save);
    daemon.json(&[&load[..], &["--lockstep"]].concat());

    assert_eq!(saving.0.wait().unwrap().code(), Some(0));
    assert_eq!(fs::read(recorded).unwrap(), fs::read(played).unwrap());
}

#[test]
fn at_the_end_of_a_video_nobody_is_waited_for() {
    let daemon = Daemon::start(&[]);
    let path = daemon.dir.0.join("a.y4m");
    fs::write(&path, video(0)).unwrap();
    let path = path.to_str().unwrap();

    let loaded = daemon.json(&["video", "load", path, "--lockstep"]);

    assert_eq!(loaded["frames"], 0);
}

#[test]
fn a_video_is_played_as_recorded_at_a_rate_and_step_by_step() {
    let daemon = Daemon::start(&[]);
    let path = daemon.dir.0.join("a.y4m");
    fs::write(&path, video(5)).unwrap();
    let path = path.to_str().unwrap();

    let load = &["video", "load", path, "--name", "cam"];
    let interval = daemon.json(&[&load[..], &["--from", "2", "--to", "4"]].concat());
    assert_eq!(interval["frames"], 3);
    let fast = daemon.json(&[&load[..], &["--rate", "1 kHz"]].concat());
    assert_eq!(fast["frames"], 5);

    let mut stepping = command(&[&load[..], &["--step", "--from", "2"]].concat())
        .env("DDX_SOCKET", daemon.socket())
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let mut commands = stepping.stdin.take().unwrap();
    commands.write_all(b"\n\np\n5\n\n1\nwhat\nq\n").unwrap();
    let stepped = stepping.wait_with_output().unwrap();
    let said = text(&stepped.stderr);
    let said: Vec<&str> = said.lines().collect();
    assert_eq!(
        said,
        [
            "frame 2",
            "frame 3",
            "frame 4",
            "frame 3",
            "frame 5",
            "there is no frame 6",
            "frame 1 is not among those that are played",
            "`what` is no command: an empty line, p, q or a number",
        ]
    );
    assert_eq!(code(&stepped), 0);
}

#[test]
fn a_video_that_is_looped_keeps_its_rate() {
    let daemon = Daemon::start(&[]);
    let path = daemon.dir.0.join("a.y4m");
    fs::write(&path, video(5)).unwrap();
    let load = ["video", "load", path.to_str().unwrap(), "--name", "cam"];
    let _playing = daemon.background(&[&load[..], &["--rate", "50 Hz", "--loop"]].concat());

    let measured = daemon.json(&["hz", "cam", "--count", "1"]);

    // A round of five frames takes as long as five of them, and not four.
    let rate = measured["rate_hz"].as_f64().unwrap();
    assert!(rate < 55.0, "{measured}");
}

#[test]
fn the_present_frame_is_a_picture_and_the_stream_is_known() {
    let daemon = Daemon::start(&[]);
    let pattern = ["video", "pattern", "--name", "cam", "--size", "64x64"];
    let _camera = daemon.background(&pattern);
    let path = |extension: &str| daemon.dir.0.join(format!("a.{extension}"));
    for (extension, magic) in [
        ("ppm", b"P6\n64 64\n255\n".as_slice()),
        ("png", b"\x89PNG\r\n"),
        ("jpg", &[0xff, 0xd8, 0xff]),
        ("tiff", b"II*\0"),
    ] {
        let path = path(extension);
        let snap = ["video", "snap", "cam", "--output", path.to_str().unwrap()];
        let snapped = daemon.json(&snap);
        assert_eq!(snapped["width"], 64, "{snapped}");
        assert!(fs::read(path).unwrap().starts_with(magic), "{extension}");
    }
    for (arguments, expected) in [
        (["--output", "a.gif"], "`gif` is no kind of picture"),
        (["--output", "/nonexistent/a.png"], "/nonexistent/a.png"),
    ] {
        let refused = daemon.ddx(&[&["video", "snap", "cam"], &arguments[..]].concat());
        let said = text(&refused.stderr);
        assert_ne!(code(&refused), 0);
        assert!(said.contains(expected), "{said}");
    }

    let measured = daemon.json(&["hz", "cam", "--count", "1"]);
    assert_eq!(measured["fields"], "64x64 I420", "{measured}");
    let info = daemon.json(&["info", "cam"]);
    assert_eq!(info["stream"]["source"], "pattern", "{info}");
    let view = ["video", "view", "cam", "--size", "20x12", "--frames", "2"];
    let seen = daemon.ddx(&view);
    assert_eq!(code(&seen), 0, "{}", text(&seen.stderr));
    // Ten rows of twenty cells, twice.
    assert_eq!(text(&seen.stdout).matches('▀').count(), 2 * 10 * 20);
    let seen = daemon.ddx(&["video", "view", "cam"]);
    assert_eq!(code(&seen), 2);
    assert!(text(&seen.stderr).contains("is no terminal"));
}

#[test]
fn streams_do_not_notice_who_stalls_or_dies_beside_them() {
    let daemon = Daemon::start(&[]);
    let pattern = |name: &str, fields: &str| {
        let size = ["--size", "64x64", "--rate", "25"];
        let verb = ["video", "pattern", "--name", name, "--fields", fields];
        daemon.background(&[&verb[..], &size].concat())
    };
    let names = ["a", "b", "c", "d", "e"];
    let _cameras = names.map(|name| pattern(name, "picture"));
    let _pairs = ["stereo", "other"].map(|name| pattern(name, "left,range,right"));
    // One that is killed, one that reads no further, and a source that is killed.
    let killed = daemon.background(&["video", "save", "a", "--output", "/dev/null"]);
    let stalled = daemon.background(&["video", "save", "stereo", "--output", "/dev/null"]);
    let view = ["video", "view", "a", "--size", "9x9"];
    let mut viewer = command(&view)
        .env("DDX_SOCKET", daemon.socket())
        .stdout(Stdio::piped())
        .spawn()
        .map(Background)
        .unwrap();
    let source = pattern("dies", "picture");
    daemon.json(&["get", "robot1/dies/counter"]);
    let stop = ["-STOP", &stalled.0.id().to_string()];
    assert!(Command::new("kill").args(stop).status().unwrap().success());
    drop((killed, source));

    let saving: Vec<_> = names
        .iter()
        .chain(&["stereo", "other"])
        .map(|name| {
            let path = daemon.dir.0.join(format!("{name}.y4m"));
            let output = ["--output", path.to_str().unwrap(), "--frames", "25"];
            daemon.background(&[&["video", "save", name], &output[..]].concat())
        })
        .collect();
    for mut saved in saving {
        // 3 would say that frames were missed.
        assert_eq!(saved.0.wait().unwrap().code(), Some(0));
    }

    assert_eq!(viewer.0.try_wait().unwrap(), None);
    drop(viewer);
    let stereo = fs::read(daemon.dir.0.join("stereo.y4m")).unwrap();
    let mut reader = Reader::new(stereo.as_slice()).unwrap();
    assert_eq!(reader.layout().fields().len(), 3);
    let mut bytes = vec![0; reader.layout().size_bytes()];
    let info = FrameInfo::default();
    while reader.next_mark().unwrap().is_some() {
        reader.layout().write_header(&mut bytes, &info).unwrap();
        reader.read_planes(&mut bytes).unwrap();
        let frame = Frame::parse(&bytes).unwrap();
        let stamps: Vec<_> = frame
            .fields()
            .map(|field| ddx_video::pattern::read(&field).unwrap())
            .collect();
        assert!(stamps.iter().all(|stamp| *stamp == stamps[0]));
    }
}

#[test]
fn the_example_of_a_camera_a_viewer_and_a_recording_works() {
    let dir = Dir::new();
    let example = concat!(env!("CARGO_MANIFEST_DIR"), "/deploy/examples/camera");
    let ddx = Path::new(env!("CARGO_BIN_EXE_ddx")).parent().unwrap();
    let path = std::env::var("PATH").unwrap();
    let ran = Command::new(example)
        .arg(&dir.0)
        .env("PATH", format!("{}:{path}", ddx.display()))
        .stdin(Stdio::null())
        .output()
        .unwrap();

    let said = lossy(&ran.stdout);
    assert_eq!(code(&ran), 0, "{said}{}", lossy(&ran.stderr));
    assert!(said.contains("352x288 I420"), "{said}");
    assert!(said.contains("10 frames"), "{said}");
    let recorded = fs::read(dir.0.join("video.y4m")).unwrap();
    assert!(recorded.starts_with(b"YUV4MPEG2 W352 H288"));
}

#[test]
fn lines_of_two_cameras_are_taken_apart() {
    let daemon = Daemon::start(&[]);
    let (played, recorded) = (daemon.dir.0.join("a.y4m"), daemon.dir.0.join("b.y4m"));
    fs::write(&played, video(10)).unwrap();
    let (played, recorded) = (played.to_str().unwrap(), recorded.to_str().unwrap());
    let looped = ["video", "load", played, "--name", "signal", "--loop"];
    let _camera = daemon.background(&[&looped[..], &["--rate", "50 Hz"]].concat());
    let _split = daemon.background(&["video", "split", "signal", "--to", "pair"]);

    let save = [
        "video", "save", "pair", "--output", recorded, "--frames", "5",
    ];
    let saved = daemon.json(&save);

    assert_eq!(saved["frames"], 5, "{saved}");
    let about = daemon.json(&["get", "robot1/pair/info"]);
    let fields = &about["value"]["fields"];
    assert_eq!(fields[0]["name"], "left", "{about}");
    assert_eq!(fields[1]["height"], 4, "{about}");
    // The lines 0, 2, 4, 6 and then 1, 3, 5, 7 of some frame that was played.
    let frames = |path: &str| {
        let mut reader = Reader::new(BufReader::new(File::open(path).unwrap())).unwrap();
        let mut all = Vec::new();
        let mut bytes = vec![0; reader.layout().size_bytes()];
        let layout = reader.layout().clone();
        layout
            .write_header(&mut bytes, &FrameInfo::default())
            .unwrap();
        while reader.next_mark().unwrap().is_some() {
            reader.read_planes(&mut bytes).unwrap();
            let frame = Frame::parse(&bytes).unwrap();
            let luma = frame.fields().map(|field| field.plane(0).unwrap());
            let rows = luma.flat_map(|plane| plane.rows().map(<[u8]>::to_vec));
            all.push(rows.collect::<Vec<_>>());
        }
        all
    };
    let sources = frames(played);
    for rows in frames(recorded) {
        let woven = (0..8).map(|line| rows[line / 2 + 4 * (line % 2)].clone());
        assert!(sources.contains(&woven.collect()), "{rows:?}");
    }
    let odd = daemon.ddx(&["video", "split", "signal", "--fields", "one"]);
    assert_eq!(code(&odd), 2, "{}", text(&odd.stderr));
}

#[test]
fn a_browser_is_shown_streams_and_the_page_of_a_stranger_is_not() {
    let daemon = Daemon::start(&[]);
    let pattern = ["video", "pattern", "--name", "cam", "--size", "64x64"];
    let _camera = daemon.background(&pattern);
    let serve = ["--json", "video", "serve", "--listen", "127.0.0.1:0"];
    let mut server = command(&serve)
        .env("DDX_SOCKET", daemon.socket())
        .stdout(Stdio::piped())
        .spawn()
        .map(Background)
        .unwrap();
    let mut line = String::new();
    BufReader::new(server.0.stdout.take().unwrap())
        .read_line(&mut line)
        .unwrap();
    let said: Value = serde_json::from_str(&line).unwrap();
    let url = said["url"].as_str().unwrap();
    let address = url.trim_start_matches("http://").trim_end_matches('/');
    let ask = |path: &str, host: &str| {
        let mut server = TcpStream::connect(address).unwrap();
        write!(
            server,
            "GET {path} HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\r\n"
        )
        .unwrap();
        server
    };
    let whole = |path: &str, host: &str| {
        let mut answer = Vec::new();
        ask(path, host).read_to_end(&mut answer).unwrap();
        answer
    };
    let has = |answer: &[u8], part: &[u8]| answer.windows(part.len()).any(|seen| seen == part);

    assert!(has(&whole("/", address), b"<!doctype html>"));
    // It waits for the first frame.
    let png = whole("/snap.png?name=robot1/cam", address);
    assert!(has(&png, b"image/png") && has(&png, b"\x89PNG"));
    let streams = whole("/streams", address);
    assert!(has(&streams, b"robot1/cam"), "{}", lossy(&streams));
    for (path, expected) in [
        ("/snap.png", b"HTTP/1.1 400".as_slice()),
        ("/movie?name=robot1/cam&rate=0", b"HTTP/1.1 400"),
        ("/snap.png?name=robot1/cam&field=x", b"HTTP/1.1 404"),
        ("/nothing", b"HTTP/1.1 404"),
    ] {
        let refused = whole(path, address);
        assert!(refused.starts_with(expected), "{}", lossy(&refused));
    }
    let strange = whole("/streams", "evil.example");
    assert!(strange.starts_with(b"HTTP/1.1 403"), "{}", lossy(&strange));

    let mut movie = BufReader::new(ask("/movie?name=robot1/cam", address));
    let mut frames = 0;
    while frames < 3 {
        let mut line = Vec::new();
        assert_ne!(movie.read_until(b'\n', &mut line).unwrap(), 0);
        frames += usize::from(line == b"--ddx-frame\r\n");
    }
    let readers = || {
        let info = daemon.json(&["info", "cam"]);
        info["reader_list"].as_array().unwrap().len()
    };
    assert_eq!(readers(), 1);
    drop(movie);
    // A movie that nobody looks at any more reads no more.
    while readers() > 0 {}
}

#[test]
fn each_kind_of_bad_video_file_is_named() {
    let daemon = Daemon::start(&[]);
    let file = |name: &str, content: &[u8]| {
        let path = daemon.dir.0.join(name);
        fs::write(&path, content).unwrap();
        path.to_str().unwrap().to_owned()
    };
    let good = video(3);
    let truncated = file("truncated.y4m", &good[..good.len() - 1]);
    for (path, expected) in [
        ("/nonexistent.y4m", "No such file"),
        ("/", "is a directory"),
        (&file("empty.y4m", b""), "it is empty"),
        (&file("film.mp4", b"\0\0\0\x20ftypisom"), "an MP4 file"),
        (
            &file("short.y4m", b"YUV4MPEG2 W1"),
            "first line does not end",
        ),
        (&file("wide.y4m", b"YUV4MPEG2 W0 H1\n"), "0x1 pixels"),
        (&truncated, "in the middle of frame 3"),
    ] {
        let refused = daemon.ddx(&["video", "load", path, "--rate", "1 kHz"]);
        let said = text(&refused.stderr);
        assert_eq!(code(&refused), 1, "{path}: {said}");
        assert!(said.contains(expected) && said.contains(path), "{said}");
    }
}

/// A file of pictures of 16x8, of which each byte differs from the one before, and each frame from the last.
fn video(frames: u8) -> Vec<u8> {
    let mut file = b"YUV4MPEG2 W16 H8 F30:1 Ip A0:0 C420mpeg2 XCOLORRANGE=LIMITED\n".to_vec();
    for frame in 1..=frames {
        let ns = u64::from(frame - 1) * 10_000_000;
        file.extend(format!("FRAME XDDX_NS={ns} XDDX_SEQ={frame}\n").bytes());
        file.extend((0..192).map(|at: u8| at.wrapping_mul(3).wrapping_add(frame)));
    }
    file
}
