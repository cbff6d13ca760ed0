//! The main job in one command: what `ddx demo` shows, and that it ends by itself and leaves nothing behind.

#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::fs;
use std::path::PathBuf;
use std::process::{Command, Output};

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
    assert_eq!(summary["items"], 7);
    assert_eq!(summary["sample_bytes_before_reading"], 0);
    assert!(summary["sample_bytes"].as_u64().unwrap() > 0, "{summary}");
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
