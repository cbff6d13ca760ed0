//! What a daemon makes of bad input and of a machine that lacks what it needs: a counted drop or a message with a hint,
//! seen through the real program.
//!
//! What needs no process of its own is tested beside its code: seals and headers in `catalog/wire`, limits of the
//! directory in `catalog`, hostile programs in `store/tests/hostile.rs`.
#![expect(
    clippy::unwrap_used,
    reason = "a helper that cannot go on fails its test"
)]

use std::fs;
use std::io::{BufRead as _, BufReader};
use std::net::{SocketAddr, UdpSocket};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::sync::atomic::{AtomicU32, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use serde_json::Value;

/// Longest wait for what must come.
const PATIENCE: Duration = Duration::from_secs(20);

#[test]
fn hosts_with_different_keys_count_and_never_see_each_other() {
    let a = Daemon::start("a", Some('1'), &[]);
    let b = Daemon::start("b", Some('2'), &["--join", &format!("udp/{}", a.control())]);

    a.wait_for_count("control_refused_foreign_domain");

    assert_eq!(a.item("@/hosts"), serde_json::json!([]));
    assert_eq!(b.item("@/hosts"), serde_json::json!([]));
}

#[test]
fn each_kind_of_bad_datagram_is_counted_by_its_reason() {
    let daemon = Daemon::start("a", Some('1'), &[]);
    let stranger = UdpSocket::bind("127.0.0.1:0").unwrap();

    for (lane, other_version) in [("control", 1_u8), ("data", 9)] {
        let to = if lane == "control" {
            daemon.control()
        } else {
            daemon.data()
        };
        let mut good_head = vec![4, 0];
        good_head.resize(40, 0);
        let mut other = good_head.clone();
        other[0] = other_version;
        let mut no_lane = good_head.clone();
        no_lane[1] = 200;
        for datagram in [&[][..], &good_head[..39], &other, &no_lane] {
            stranger.send_to(datagram, to).unwrap();
        }

        for reason in ["truncated", "other_protocol_version", "wrong_lane"] {
            daemon.wait_for_count(&format!("{lane}_refused_{reason}"));
        }
    }
}

#[test]
fn forged_and_replayed_datagrams_are_counted_and_the_true_ones_arrive() {
    let a = Daemon::start("a", Some('1'), &[]);
    let tampering = UdpSocket::bind("127.0.0.1:0").unwrap();
    let between = tampering.local_addr().unwrap();
    let b = Daemon::start("b", Some('1'), &["--join", &format!("udp/{between}")]);
    let (to_a, to_b) = (a.control(), b.control());
    thread::spawn(move || relay(&tampering, to_a, to_b));

    a.wait_for_count("control_refused_forged");
    a.wait_for_count("control_refused_replayed");

    a.wait_until("`b` is up", |daemon| {
        daemon.item("@/hosts")[0]["state"] == "up"
    });
    b.wait_until("`a` is up", |daemon| {
        daemon.item("@/hosts")[0]["state"] == "up"
    });
}

#[test]
fn two_hosts_with_one_prefix_are_both_listed_and_read() {
    let one = Daemon::start("robot1", Some('1'), &[]);
    let join = format!("udp/{}", one.control());
    let other = Daemon::start("robot1", Some('1'), &["--join", &join]);
    let base = Daemon::start("base", Some('1'), &["--join", &join]);
    for (daemon, value) in [(&one, "1"), (&other, "2")] {
        let put = daemon.ddx(&["put", "n", value, "--type", "u64"]);
        assert_eq!(code(&put), 0, "{}", text(&put.stderr));
    }
    // They came within a second, so that the lower id keeps the prefix.
    let id = |daemon: &Daemon| daemon.item("@/self")["id"].as_str().unwrap().to_owned();
    let (keeper, loser) = if id(&one) < id(&other) {
        (&one, &other)
    } else {
        (&other, &one)
    };
    let moved = format!("robot1~{}/n", &id(loser)[..4]);

    base.wait_until("both items are listed", |daemon| {
        let listed = daemon.ddx(&["ls"]);
        let listed = text(&listed.stdout);
        listed.contains("robot1/n") && listed.contains(&moved)
    });

    assert_eq!(base.item("robot1/n"), keeper.item("n"));
    assert_eq!(base.item(&moved), loser.item("n"));
    assert_ne!(base.item("robot1/n"), base.item(&moved));
}

/// Passes datagrams between two hosts, each once damaged, once whole and once again, until the test's process ends.
fn relay(socket: &UdpSocket, a: SocketAddr, b: SocketAddr) {
    let mut buffer = [0; 2048];
    while let Ok((len, from)) = socket.recv_from(&mut buffer) {
        let to = if from == a { b } else { a };
        let mut damaged = buffer[..len].to_vec();
        damaged[len - 1] ^= 1;
        for datagram in [&damaged[..], &buffer[..len], &buffer[..len]] {
            // Fails when a host has gone, as at the end of the test.
            let _gone = socket.send_to(datagram, to);
        }
    }
}

#[test]
fn a_run_directory_that_cannot_be_written_is_named_with_a_way_out() {
    // Nobody can make files there, not even root.
    for socket in ["/sys/ddx/h.sock", "/sys/h.sock"] {
        let refused = up(&["--host", "h", "--socket", socket]);

        let said = text(&refused.stderr);
        assert_eq!(code(&refused), 1, "{said}");
        assert!(
            said.contains(if socket == "/sys/h.sock" {
                "`/sys/h.sock`"
            } else {
                "`/sys/ddx`"
            }),
            "{said}"
        );
        assert!(
            said.contains("\nhint: choose another socket by --socket or DDX_SOCKET"),
            "{said}"
        );
    }
}

#[test]
fn a_port_that_is_taken_is_named_with_a_way_out() {
    let dir = Dir::new();
    let key = dir.key('1');
    let holder = UdpSocket::bind("0.0.0.0:0").unwrap();
    let port = holder.local_addr().unwrap().port();

    for socket in ["control", "data"] {
        let config = dir.0.join("ddx.toml");
        fs::write(&config, format!("{socket}_port = {port}\n")).unwrap();
        let arguments = [
            "up",
            "--host",
            "h",
            "--iface",
            "lo",
            "--key",
            &key,
            "--config",
            config.to_str().unwrap(),
        ];
        let refused = command(&arguments)
            .env("DDX_SOCKET", dir.0.join("h.sock"))
            .env("DDX_STATE_DIR", &dir.0)
            .output()
            .unwrap();

        let said = text(&refused.stderr);
        assert_eq!(code(&refused), 1, "{said}");
        assert!(
            said.contains(&format!("opening the {socket} socket on UDP port {port}")),
            "{said}"
        );
        assert!(
            said.contains(&format!(
                "\nhint: `{socket}_port = 0` lets the system choose"
            )),
            "{said}"
        );
    }
}

#[test]
fn without_a_network_interface_the_host_serves_itself_and_waits() {
    let may = Command::new("unshare")
        .args(["--map-root-user", "--net", "true"])
        .status();
    if !may.is_ok_and(|status| status.success()) && std::env::var_os("CI").is_none() {
        eprintln!("SKIPPED: a network namespace cannot be made here");
        return;
    }
    let dir = Dir::new();
    let key = dir.key('1');
    let up = |arguments: &[&str]| {
        let mut command = Command::new("unshare");
        command.args([
            "--map-root-user",
            "--net",
            env!("CARGO_BIN_EXE_ddx"),
            "up",
            "--config",
            "/dev/null",
            "--host",
            "h",
        ]);
        command
            .args(arguments)
            .arg("--socket")
            .arg(dir.0.join("h.sock"))
            .env("DDX_STATE_DIR", &dir.0);
        command
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped());
        command
    };

    for wanted in [&[][..], &["--iface", "lo"], &["--iface", "192.0.2.1"]] {
        let arguments = [&["--key", &key], wanted].concat();
        let mut waiting = Background(up(&arguments).spawn().unwrap());
        let ready = first_line(&mut waiting.0);
        assert!(ready.starts_with("ready: host h"), "{ready}");
        assert!(
            ready.contains("once a network interface is up: waiting for one"),
            "{wanted:?}: {ready}"
        );
    }

    // A name that nothing has is a mistake.
    let refused = up(&["--key", &key, "--iface", "wlan7"]).output().unwrap();
    let said = text(&refused.stderr);
    assert_eq!(code(&refused), 1, "{said}");
    assert!(
        said.contains("there is no interface `wlan7`") && said.contains("\nhint: "),
        "{said}"
    );

    let mut alone = Background(up(&[]).spawn().unwrap());
    let ready = first_line(&mut alone.0);
    assert!(ready.starts_with("ready: host h"), "{ready}");
    assert!(ready.contains("no key, no network"), "{ready}");
}

#[test]
fn a_name_that_is_too_long_is_refused_with_the_limit() {
    let daemon = Daemon::start("a", None, &[]);
    let long = "x".repeat(256);
    let host = "h".repeat(256);

    for arguments in [
        &["put", &long, "1", "--type", "u64"][..],
        &["get", &long],
        &["info", &long],
        &["rm", &long],
    ] {
        let refused = daemon.ddx(arguments);
        let said = text(&refused.stderr);
        assert_ne!(code(&refused), 0, "{arguments:?}");
        assert!(said.contains("255"), "{arguments:?}: {said}");
    }
    let refused = up(&["--host", &host]);
    assert_eq!(code(&refused), 2);
    assert!(
        text(&refused.stderr).contains("--host"),
        "{}",
        text(&refused.stderr)
    );
}

#[test]
fn a_type_that_lies_about_its_size_is_refused_by_its_field() {
    let daemon = Daemon::start("a", None, &[]);
    let lie = "schema P plain struct size 8 { a: u64 @8 }";

    let refused = daemon.ddx(&["put", "n", "{\"a\": 1}", "--type", lie]);

    let said = text(&refused.stderr);
    assert_ne!(code(&refused), 0);
    assert!(said.contains("schema `P`"), "{said}");
    assert!(said.contains("`a`") || said.contains("size 8"), "{said}");
}

/// A step of the wall clock cannot touch an age when nothing that makes one reads that clock.
#[test]
fn no_code_that_dates_a_sample_reads_the_wall_clock() {
    const WALL_CLOCK: [&str; 5] = [
        "SystemTime",
        "CLOCK_REALTIME",
        "Utc::now",
        "Local::now",
        "gettimeofday",
    ];
    let mut pending: Vec<PathBuf> = [
        "src",
        "store/src",
        "store/derive/src",
        "catalog/src",
        "catalog/wire/src",
    ]
    .map(|room| Path::new(env!("CARGO_MANIFEST_DIR")).join(room))
    .into();
    let mut files = 0;
    let mut dates_samples = false;
    while let Some(path) = pending.pop() {
        if path.is_dir() {
            pending.extend(
                fs::read_dir(path)
                    .unwrap()
                    .map(|entry| entry.unwrap().path()),
            );
            continue;
        }
        let code = fs::read_to_string(&path).unwrap();
        let found = WALL_CLOCK.iter().find(|word| code.contains(**word));
        assert_eq!(found, None, "{}", path.display());
        files += 1;
        dates_samples |= path.ends_with("store/src/clock.rs") && code.contains("CLOCK_BOOTTIME");
    }
    assert!(files > 50 && dates_samples, "only {files} files were read");
}

/// A directory that goes with the test.
struct Dir(PathBuf);

/// A running `ddx up` on the loopback interface, with its directory.
struct Daemon {
    child: Child,
    ready: Value,
    dir: Dir,
}

/// A program that is killed when the test ends.
struct Background(Child);

impl Dir {
    fn new() -> Self {
        static COUNT: AtomicU32 = AtomicU32::new(0);
        let count = COUNT.fetch_add(1, Ordering::Relaxed);
        let path =
            std::env::temp_dir().join(format!("ddx-bad-input-{}-{count}", std::process::id()));
        fs::create_dir(&path).unwrap();
        Self(path)
    }

    /// Writes a key that is `digit` throughout; returns the path.
    fn key(&self, digit: char) -> String {
        let path = self.0.join("key");
        fs::write(&path, digit.to_string().repeat(64)).unwrap();
        path.to_str().unwrap().to_owned()
    }
}

impl Drop for Dir {
    fn drop(&mut self) {
        fs::remove_dir_all(&self.0).unwrap();
    }
}

impl Daemon {
    /// Starts a host that knows only the hosts it joins, and waits until it is ready.
    fn start(host: &str, key: Option<char>, arguments: &[&str]) -> Self {
        let dir = Dir::new();
        let config = dir.0.join("ddx.toml");
        fs::write(&config, "beacon = false\n").unwrap();
        let mut command = command(&[
            "--json",
            "up",
            "--host",
            host,
            "--iface",
            "lo",
            "--config",
            config.to_str().unwrap(),
        ]);
        if let Some(digit) = key {
            command.args(["--key", &dir.key(digit)]);
        }
        let mut child = command
            .args(arguments)
            .env("DDX_SOCKET", dir.0.join("ddx.sock"))
            .env("DDX_STATE_DIR", &dir.0)
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let ready = serde_json::from_str(&first_line(&mut child)).unwrap();
        Self { child, ready, dir }
    }

    fn control(&self) -> SocketAddr {
        self.ready["control"][0].as_str().unwrap().parse().unwrap()
    }

    fn data(&self) -> SocketAddr {
        let port = self.ready["data_port"].as_u64().unwrap();
        SocketAddr::from(([127, 0, 0, 1], u16::try_from(port).unwrap()))
    }

    fn ddx(&self, arguments: &[&str]) -> Output {
        command(arguments)
            .env("DDX_SOCKET", self.dir.0.join("ddx.sock"))
            .output()
            .unwrap()
    }

    /// The value of an item; null while there is none.
    fn item(&self, name: &str) -> Value {
        let output = self.ddx(&["--json", "get", name]);
        let sample: Value = serde_json::from_slice(&output.stdout).unwrap_or_default();
        sample["value"].clone()
    }

    fn wait_for_count(&self, counter: &str) {
        self.wait_until(counter, |daemon| {
            daemon.item("@/counters")[counter].as_u64() > Some(0)
        });
    }

    fn wait_until(&self, what: &str, holds: impl Fn(&Self) -> bool) {
        let end = Instant::now() + PATIENCE;
        while !holds(self) {
            assert!(
                Instant::now() < end,
                "{what}: not within {PATIENCE:?}; counters {}",
                self.item("@/counters")
            );
        }
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

fn first_line(child: &mut Child) -> String {
    let mut line = String::new();
    BufReader::new(child.stdout.take().unwrap())
        .read_line(&mut line)
        .unwrap();
    line
}

/// Runs a daemon that does not come up.
fn up(arguments: &[&str]) -> Output {
    command(&["up", "--config", "/dev/null"])
        .args(arguments)
        .output()
        .unwrap()
}

fn command(arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_ddx"));
    command
        .args(arguments)
        .stdin(Stdio::null())
        .env_remove("RUST_LOG");
    for (name, _) in std::env::vars().filter(|(name, _)| name.starts_with("DDX_")) {
        command.env_remove(name);
    }
    command
}

fn code(output: &Output) -> i32 {
    output.status.code().unwrap()
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8(bytes.to_vec()).unwrap()
}
