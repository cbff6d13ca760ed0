//! The command line as a shell sees it: the real program, its output and its exit codes, against a daemon without a key.

#![expect(
    clippy::unwrap_used,
    reason = "a helper of a test fails the test, as the test itself would"
)]

use std::fs;
use std::io::{BufRead as _, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::sync::atomic::{AtomicU32, Ordering};

use serde_json::{Value, json};

mod video;

const LOG: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/deploy/data/gps.nmea");

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
