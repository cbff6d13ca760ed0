//! The main job in one command: what `ddx demo` shows, and that it ends by itself and leaves nothing behind.

#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::fs;
use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::net::TcpStream;
use std::path::PathBuf;
use std::process::{Command, Output, Stdio};

use serde_json::Value;

/// A directory of its own for each show, so that what it leaves behind is seen.
struct Dir(PathBuf);

impl Dir {
    fn new(name: &str) -> Self {
        let dir = std::env::temp_dir().join(format!("ddx-lab-demo-{name}-{}", std::process::id()));
        fs::create_dir_all(&dir).unwrap();
        Self(dir)
    }
}

impl Drop for Dir {
    fn drop(&mut self) {
        fs::remove_dir_all(&self.0).unwrap();
    }
}

fn demo(dir: &Dir, arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_ddx"))
        .arg("demo")
        .args(arguments)
        .env("TMPDIR", &dir.0)
        .output()
        .unwrap()
}

fn summary(shown: &Output) -> Value {
    let errors = String::from_utf8_lossy(&shown.stderr);
    assert_eq!(shown.status.code(), Some(0), "{errors}");
    let lines: Vec<Value> = String::from_utf8_lossy(&shown.stdout)
        .lines()
        .map(|line| serde_json::from_str(line).unwrap())
        .collect();
    lines.last().unwrap().clone()
}

#[test]
fn the_show_sends_nothing_unread_and_recovers_twice() {
    let dir = Dir::new("whole");

    let summary = summary(&demo(&dir, &["--json", "--seconds", "12"]));

    assert_eq!(summary["event"], "summary");
    // The three of the video without what it is made of.
    assert_eq!(summary["items"], 9);
    assert_eq!(summary["sample_bytes_before_reading"], 0);
    let bytes = |key: &str| summary[key].as_u64().unwrap();
    let (unseen, all) = (bytes("sample_bytes_before_looking"), bytes("sample_bytes"));
    assert!(unseen > 0 && all > 20 * unseen, "{summary}");
    assert_eq!(summary["recovered"], true, "{summary}");
    assert_eq!(
        summary["recovered_s"].as_object().unwrap().len(),
        2,
        "{summary}"
    );
    assert_eq!(fs::read_dir(&dir.0).unwrap().count(), 0);
}

#[test]
fn a_short_show_leaves_the_failures_out() {
    let dir = Dir::new("short");

    let shown = demo(&dir, &["--json", "--seconds", "3"]);

    let summary = summary(&shown);
    assert!(summary["received"].as_u64().unwrap() > 0, "{summary}");
    assert!(
        summary["recovered_s"].as_object().unwrap().is_empty(),
        "{summary}"
    );
    assert!(String::from_utf8_lossy(&shown.stderr).contains("--seconds 12"));
}

#[test]
fn a_browser_outside_sees_the_video_as_base_does() {
    let dir = Dir::new("served");
    let mut demo = Command::new(env!("CARGO_BIN_EXE_ddx"))
        .args(["demo", "--json", "--serve"])
        .env("TMPDIR", &dir.0)
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut lines = BufReader::new(demo.stdout.take().unwrap()).lines();
    let url = loop {
        let said: Value = serde_json::from_str(&lines.next().unwrap().unwrap()).unwrap();
        if said["event"] == "served" {
            break said["url"].as_str().unwrap().to_owned();
        }
    };
    let address = url.split('/').nth(2).unwrap();
    let mut server = TcpStream::connect(address).unwrap();
    let request = "GET /snap.png?name=robot1/cam HTTP/1.1";
    write!(
        server,
        "{request}\r\nHost: {address}\r\nConnection: close\r\n\r\n"
    )
    .unwrap();
    let mut answer = Vec::new();
    server.read_to_end(&mut answer).unwrap();
    let pid = demo.id().to_string();
    let ended = Command::new("kill").args(["-TERM", &pid]).status().unwrap();
    assert!(ended.success());
    assert_eq!(demo.wait().unwrap().code(), Some(0));

    assert!(
        answer.starts_with(b"HTTP/1.1 200"),
        "{}",
        String::from_utf8_lossy(&answer)
    );
    assert!(answer.windows(4).any(|part| part == b"\x89PNG"));
    assert_eq!(fs::read_dir(&dir.0).unwrap().count(), 0);
}
