//! The command line as a shell sees it: the real program, its output and its exit codes, against a daemon without a key.

#![expect(
    clippy::unwrap_used,
    reason = "a helper of a test fails the test, as the test itself would"
)]

use std::fs::{self, File};
use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::sync::atomic::{AtomicU32, Ordering};

use ddx_video::y4m::Reader;
use serde_json::{Value, json};

const LOG: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/deploy/data/gps.nmea");
const CLIP: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/deploy/data/bunny.y4m");

/// A directory that goes with the test.
struct Dir(PathBuf);

/// A running `ddx up` with its directory.
struct Daemon {
    child: Child,
    ready: String,
    dir: Dir,
}

/// A program that is killed when the test ends.
struct Background(Child);

#[test]
fn help_fits_one_screen() {
    let help = ddx(&["--help"]);

    assert_eq!(code(&help), 0);
    let text = text(&help.stdout);
    assert!(text.lines().count() <= 24, "{text}");
    assert!(
        text.lines().all(|line| line.chars().count() <= 80),
        "{text}"
    );
}

#[test]
fn bad_arguments_exit_with_2() {
    let dir = Dir::new();
    let config = dir.0.join("ddx.toml");
    fs::write(&config, "domian = 3\n").unwrap();
    let config = config.to_str().unwrap();

    for (arguments, expected) in [
        (&["fly"][..], "unrecognized subcommand 'fly'"),
        (&["up", "--host", "a/b"], "--host `a/b`"),
        (
            &["up", "--config", "/nonexistent.toml"],
            "`/nonexistent.toml`",
        ),
        (&["up", "--config", config], "hint: did you mean `domain`?"),
        (&["get", "x", "--timeout", "5"], "`5` has no unit"),
        (&["watch", "--rate", "0"], "out of range"),
        (
            &["source", "nmea", "x", "--rate", "fast"],
            "`fast` is not a factor",
        ),
    ] {
        let refused = ddx(arguments);
        let said = text(&refused.stderr);
        assert_eq!(code(&refused), 2, "{arguments:?}: {said}");
        assert!(said.contains(expected), "{arguments:?}: {said}");
        assert!(refused.stdout.is_empty(), "{arguments:?}");
    }
}

#[test]
fn an_environment_variable_that_makes_no_sense_is_named() {
    let refused = command(&["up", "--config", "/dev/null"])
        .env("DDX_DOMAIN", "lots")
        .output()
        .unwrap();

    assert_eq!(code(&refused), 2);
    assert_eq!(
        text(&refused.stderr),
        "error: DDX_DOMAIN: `lots` is not a whole number\n"
    );
}

#[test]
fn a_socket_that_cannot_be_made_is_named() {
    let dir = Dir::new();
    let file = dir.0.join("file");
    fs::write(&file, "").unwrap();
    let socket = file.join("ddx.sock");

    let refused = ddx(&[
        "up",
        "--config",
        "/dev/null",
        "--host",
        "h",
        "--socket",
        socket.to_str().unwrap(),
    ]);

    assert_eq!(code(&refused), 1);
    let said = text(&refused.stderr);
    assert!(said.contains(file.to_str().unwrap()), "{said}");
}

#[test]
fn a_key_that_is_missing_or_broken_is_named() {
    let dir = Dir::new();
    let broken = dir.0.join("key");
    fs::write(&broken, "secret\n").unwrap();

    for (file, expected) in [
        ("/nonexistent/key", "hint: `ddx key new > /nonexistent/key`"),
        (broken.to_str().unwrap(), "holds no domain key"),
    ] {
        let refused = ddx(&["up", "--config", "/dev/null", "--host", "h", "--key", file]);
        let said = text(&refused.stderr);
        assert_eq!(code(&refused), 1, "{said}");
        assert!(said.contains(expected), "{said}");
        assert!(!said.contains("secret"), "{said}");
    }
}

#[test]
fn a_key_is_one_line_of_hex() {
    let made = ddx(&["key", "new"]);

    assert_eq!(code(&made), 0);
    let key = text(&made.stdout);
    assert_eq!(key.trim_end().len(), 64);
    assert!(
        key.ends_with('\n') && key.trim_end().bytes().all(|b| b.is_ascii_hexdigit()),
        "{key}"
    );
}

#[test]
fn the_daemon_says_ready_and_ends_cleanly_on_sigterm() {
    let mut daemon = Daemon::start(&[]);
    let socket = daemon.socket();

    assert!(
        daemon
            .ready
            .starts_with("ready: host robot1 in domain 0 at "),
        "{}",
        daemon.ready
    );
    assert!(
        daemon.ready.trim_end().ends_with("; no key, no network"),
        "{}",
        daemon.ready
    );
    assert!(socket.exists());
    let second = daemon.ddx(&["up", "--config", "/dev/null", "--host", "robot1"]);
    assert_eq!(code(&second), 1);
    assert!(
        text(&second.stderr).contains(&daemon.child.id().to_string()),
        "{}",
        text(&second.stderr)
    );

    let killed = Command::new("kill")
        .arg(daemon.child.id().to_string())
        .status()
        .unwrap();
    assert!(killed.success());
    assert_eq!(daemon.child.wait().unwrap().code(), Some(0));
}

#[test]
fn what_is_put_can_be_got_listed_explained_and_removed() {
    let daemon = Daemon::start(&[]);

    let untyped = daemon.ddx(&["put", "speed", "1.5"]);
    assert_eq!(code(&untyped), 1);
    assert!(
        text(&untyped.stderr).contains("hint: a new item needs a type"),
        "{}",
        text(&untyped.stderr)
    );
    assert_eq!(
        code(&daemon.ddx(&["put", "speed", "1.5", "--type", "f64"])),
        0
    );
    assert_eq!(code(&daemon.ddx(&["put", "speed", "-2.5"])), 0);
    assert_eq!(code(&daemon.ddx(&["put", "speed", "fast"])), 2);
    let misfit = daemon.ddx(&["put", "count", "1.5", "--type", "u64"]);
    assert_eq!(code(&misfit), 2);
    assert!(
        text(&misfit.stderr).contains("`1.5` is not a value of `count`"),
        "{}",
        text(&misfit.stderr)
    );

    let got = daemon.json(&["get", "speed"]);
    assert_eq!(got["value"], json!(-2.5));
    assert_eq!(got["bound_ns"], json!(0));
    assert!(got["age_ns"].is_u64(), "{got}");
    let listed = daemon.json(&["ls"]);
    assert_eq!(listed["name"], json!("robot1/speed"));
    assert_eq!(listed["writer"], json!("daemon"));
    assert_eq!(
        daemon.json(&["topic", "list"])["name"],
        json!("robot1/speed")
    );
    let known = daemon.json(&["info", "speed"]);
    assert!(known["schema"].as_str().unwrap().contains("f64"), "{known}");
    assert_eq!(
        daemon.json(&["why", "speed"])["reason"],
        json!("reader-gone")
    );

    assert_eq!(code(&daemon.ddx(&["rm", "speed"])), 0);
    assert!(daemon.ddx(&["--json", "ls"]).stdout.is_empty());
    let gone = daemon.ddx(&["get", "speed", "--timeout", "50 ms"]);
    assert_eq!(code(&gone), 1);
    assert!(
        text(&gone.stderr).contains("this host has no item `robot1/speed`"),
        "{}",
        text(&gone.stderr)
    );
}

#[test]
fn the_doctor_is_content_with_a_daemon_and_says_how_to_get_one() {
    let mut daemon = Daemon::start(&[]);
    let socket = daemon.socket();

    let checked = daemon.ddx(&["doctor"]);
    let said = text(&checked.stdout);
    assert_eq!(code(&checked), 0, "{said}");
    let pid = daemon.child.id();
    assert!(
        said.lines().next().unwrap().ends_with(&format!(
            " with pid {pid} serves host robot1 in domain 0 at {}",
            socket.display()
        )),
        "{said}"
    );
    assert!(said.ends_with("\nall is well\n"), "{said}");
    let alone = daemon.ddx(&["doctor", "multicast"]);
    assert_eq!(code(&alone), 1);
    assert!(
        text(&alone.stderr).contains("hint: `ddx key new > FILE`"),
        "{}",
        text(&alone.stderr)
    );

    daemon.child.kill().unwrap();
    daemon.child.wait().unwrap();
    let checked = daemon.ddx(&["--json", "doctor"]);
    assert_eq!(code(&checked), 1);
    let found: Vec<Value> = text(&checked.stdout)
        .lines()
        .map(|line| serde_json::from_str(line).unwrap())
        .collect();
    assert_eq!(
        (&found[0]["level"], &found[0]["hint"]),
        (&json!("fail"), &json!("start one with `ddx up`"))
    );
    assert!(
        found.iter().any(|found| found["check"] == "memory"),
        "what needs no daemon is checked: {found:?}"
    );
}

#[test]
fn why_tells_a_missing_name_from_a_missing_key() {
    let daemon = Daemon::start(&[]);
    daemon.json(&["put", "speed", "1", "--type", "u64"]);

    let near = daemon.json(&["why", "sped"]);
    assert_eq!(near["reason"], json!("no-such-name"));
    assert_eq!(near["hint"], json!("did you mean `robot1/speed`?"));
    let foreign = daemon.json(&["why", "base/speed"]);
    assert_eq!(foreign["reason"], json!("no-key"));
    assert_eq!(code(&daemon.ddx(&["why", "a//b"])), 2);
}

#[test]
fn a_gps_log_becomes_typed_items_and_is_watched() {
    let daemon = Daemon::start(&[]);
    let _source = daemon.background(&[
        "source", "nmea", LOG, "--name", "gps", "--rate", "100", "--loop",
    ]);

    let fix = daemon.json(&["get", "./gps/fix", "--timeout", "5 s"]);
    assert!(
        (50.0..60.0).contains(&fix["value"]["latitude"].as_f64().unwrap()),
        "{fix}"
    );
    let watched = daemon.ddx(&[
        "--json",
        "watch",
        "robot1/gps/fix",
        "--count",
        "3",
        "--seconds",
        "10",
    ]);
    assert_eq!(code(&watched), 0, "{}", text(&watched.stderr));
    let lines: Vec<Value> = text(&watched.stdout)
        .lines()
        .map(|line| serde_json::from_str(line).unwrap())
        .collect();
    assert_eq!(lines.len(), 3);
    assert!(
        lines
            .iter()
            .all(|line| line["name"] == json!("robot1/gps/fix"))
    );
    let rate = daemon.json(&["hz", "./gps/fix", "--count", "1"]);
    assert!(rate["samples"].as_u64().unwrap() > 0, "{rate}");
    let names = text(&daemon.ddx(&["ls", "./gps/*"]).stdout);
    for leaf in ["course", "fix", "satellites", "speed"] {
        assert!(names.contains(&format!("robot1/gps/{leaf} ")), "{names}");
    }
    let info = text(&daemon.ddx(&["info", "./gps/fix"]).stdout);
    assert!(info.contains("latitude: f64 @8 unit \"deg\""), "{info}");
}

#[test]
fn a_log_with_bad_lines_is_done_with_loss_and_a_foreign_file_is_refused() {
    let daemon = Daemon::start(&[]);
    let broken = daemon.dir.0.join("broken.nmea");
    let lines: Vec<_> = fs::read_to_string(LOG)
        .unwrap()
        .lines()
        .take(11)
        .map(str::to_owned)
        .collect();
    fs::write(&broken, format!("{}\n$GPGGA,cut off", lines.join("\n"))).unwrap();
    let foreign = daemon.dir.0.join("foreign");
    fs::write(&foreign, "not a log\n").unwrap();

    let played = daemon.ddx(&[
        "--json",
        "source",
        "nmea",
        broken.to_str().unwrap(),
        "--rate",
        "1000",
    ]);
    assert_eq!(code(&played), 3, "{}", text(&played.stderr));
    let summary: Value = serde_json::from_slice(&played.stdout).unwrap();
    assert_eq!(summary["bad_lines"], json!(1));
    let refused = daemon.ddx(&["source", "nmea", foreign.to_str().unwrap()]);
    assert_eq!(code(&refused), 1);
    assert!(
        text(&refused.stderr).contains("is no NMEA 0183 log"),
        "{}",
        text(&refused.stderr)
    );
    let missing = daemon.ddx(&["source", "nmea", "/nonexistent.log"]);
    assert_eq!(code(&missing), 1);
    assert!(
        text(&missing.stderr).contains("`/nonexistent.log`"),
        "{}",
        text(&missing.stderr)
    );
}

#[test]
fn this_machine_is_a_source() {
    let daemon = Daemon::start(&[]);
    let _source = daemon.background(&["source", "system", "--name", "sys", "--rate", "10"]);

    let memory = daemon.json(&["get", "./sys/memory", "--timeout", "5 s"]);

    assert!(
        memory["value"]["total"].as_u64().unwrap() > 1 << 20,
        "{memory}"
    );
    let held = daemon.ddx(&["put", "./sys/memory", r#"{"total":1,"available":1}"#]);
    assert_eq!(code(&held), 1);
    let said = text(&held.stderr);
    assert!(said.contains("is written by `ddx source system`"), "{said}");
}

#[test]
fn a_writer_that_is_gone_leaves_its_value_and_why_says_so() {
    let daemon = Daemon::start(&[]);
    let source = daemon.background(&["source", "system", "--name", "sys", "--rate", "10"]);
    daemon.json(&["get", "./sys/load", "--timeout", "5 s"]);

    drop(source);

    let verdict = daemon.json(&["why", "./sys/load"]);
    assert_eq!(verdict["reason"], json!("no-writer"), "{verdict}");
    assert_eq!(daemon.json(&["get", "./sys/load"])["orphaned"], json!(true));
}

#[test]
fn no_daemon_is_an_error_with_a_hint() {
    let dir = Dir::new();
    let socket = dir.0.join("none.sock");

    let refused = ddx(&["--socket", socket.to_str().unwrap(), "ls"]);

    assert_eq!(code(&refused), 1);
    let said = text(&refused.stderr);
    assert!(said.contains(socket.to_str().unwrap()), "{said}");
    assert!(said.contains("hint: start one with `ddx up`"), "{said}");
}

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
    let info = ddx_video::frame::FrameInfo::default();
    while reader.next_mark().unwrap().is_some() {
        reader.layout().write_header(&mut bytes, &info).unwrap();
        reader.read_planes(&mut bytes).unwrap();
        let frame = ddx_video::frame::Frame::parse(&bytes).unwrap();
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

impl Dir {
    fn new() -> Self {
        static COUNT: AtomicU32 = AtomicU32::new(0);
        let name = format!(
            "ddx-cli-{}-{}",
            std::process::id(),
            COUNT.fetch_add(1, Ordering::Relaxed)
        );
        let path = std::env::temp_dir().join(name);
        fs::create_dir(&path).unwrap();
        Self(path)
    }
}

impl Drop for Dir {
    fn drop(&mut self) {
        fs::remove_dir_all(&self.0).unwrap();
    }
}

impl Daemon {
    /// Starts host `robot1` and waits until it is ready.
    fn start(arguments: &[&str]) -> Self {
        let dir = Dir::new();
        let mut child = command(&[
            "up",
            "--config",
            "/dev/null",
            "--host",
            "robot1",
            "--socket",
        ])
        .arg(dir.0.join("ddx.sock"))
        .args(arguments)
        .env("DDX_STATE_DIR", &dir.0)
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
        let mut ready = String::new();
        BufReader::new(child.stdout.take().unwrap())
            .read_line(&mut ready)
            .unwrap();
        assert!(!ready.is_empty(), "the daemon did not start");
        Self { child, ready, dir }
    }

    fn socket(&self) -> PathBuf {
        self.dir.0.join("ddx.sock")
    }

    fn ddx(&self, arguments: &[&str]) -> Output {
        command(arguments)
            .env("DDX_SOCKET", self.socket())
            .output()
            .unwrap()
    }

    /// The one object that a verb prints.
    fn json(&self, arguments: &[&str]) -> Value {
        let output = self.ddx(&[&["--json"], arguments].concat());
        assert_eq!(code(&output), 0, "{arguments:?}: {}", text(&output.stderr));
        serde_json::from_slice(&output.stdout)
            .unwrap_or_else(|e| panic!("{arguments:?}: {e}: {}", text(&output.stdout)))
    }

    fn background(&self, arguments: &[&str]) -> Background {
        Background(
            command(arguments)
                .env("DDX_SOCKET", self.socket())
                .spawn()
                .unwrap(),
        )
    }
}

impl Drop for Daemon {
    fn drop(&mut self) {
        end(&mut self.child);
    }
}

impl Drop for Background {
    fn drop(&mut self) {
        end(&mut self.0);
    }
}

fn end(child: &mut Child) {
    // Fails only when it has ended.
    let _ended = child.kill();
    child.wait().unwrap();
}

fn command(arguments: &[&str]) -> Command {
    let mut command = Command::new(Path::new(env!("CARGO_BIN_EXE_ddx")));
    command
        .args(arguments)
        .stdin(Stdio::null())
        .env_remove("RUST_LOG");
    for (name, _) in std::env::vars().filter(|(name, _)| name.starts_with("DDX_")) {
        command.env_remove(name);
    }
    command
}

fn ddx(arguments: &[&str]) -> Output {
    command(arguments).output().unwrap()
}

fn code(output: &Output) -> i32 {
    output.status.code().unwrap()
}

fn lossy(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8(bytes.to_vec()).unwrap()
}
