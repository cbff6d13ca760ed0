//! Items that no program writes outlive a killed daemon with the service manager. A stand-in plays the manager: it holds
//! the files that the real program gives it, and starts the next one with them.
#![expect(
    clippy::unwrap_used,
    reason = "a helper that cannot go on fails its test"
)]

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::{BufRead as _, BufReader, IoSliceMut, Write as _};
use std::mem::MaybeUninit;
use std::os::fd::{AsRawFd as _, OwnedFd};
use std::os::unix::net::UnixDatagram;
use std::path::PathBuf;
use std::process::{Child, Command, Output, Stdio};
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::{Duration, Instant};

use ddx_store::Store;
use rustix::fs::{MemfdFlags, SealFlags};
use rustix::io::FdFlags;
use rustix::net::{RecvAncillaryBuffer, RecvAncillaryMessage, RecvFlags};
use serde_json::{Value, json};

/// Longest wait for what must come.
const PATIENCE: Duration = Duration::from_secs(20);

#[test]
fn orphans_and_put_values_outlive_a_killed_daemon() {
    let mut manager = Manager::new();
    let mut daemon = manager.start();
    daemon.done(&["put", "limit", "7", "--type", "u64"]);
    daemon.done(&["put", "limit", "8", "--type", "u64"]);
    let store = daemon.store();
    let mut writer = store.writer::<u64>("speed").unwrap();
    writer.write(&41).unwrap();
    writer.write(&42).unwrap();
    drop(writer);
    // The first value that was put has made way for the second.
    manager.wait_for("both items, and only their last values", |manager| {
        manager.held.len() == 2 && manager.released == 1
    });
    let before = [daemon.sample("limit"), daemon.sample("speed")];

    daemon.kill();
    daemon = manager.start();

    assert_eq!([daemon.sample("limit"), daemon.sample("speed")], before);
    assert_eq!((&before[0][0], &before[1][0]), (&json!(8), &json!(42)));
    let info = daemon.json(&["info", "speed"]);
    assert_eq!(info["writer"], "orphaned", "{info}");
    assert_eq!(daemon.json(&["info", "limit"])["writer"], "daemon");
    assert!(info["schema"].as_str().unwrap().contains("u64"), "{info}");
}

#[test]
fn a_reader_that_stayed_sees_the_orphan_go_on_with_its_next_writer() {
    let mut manager = Manager::new();
    let mut daemon = manager.start();
    let store = daemon.store();
    let mut reader = store.reader::<u64>("n").unwrap();
    store.writer::<u64>("n").unwrap().write(&1).unwrap();
    assert_eq!(reader.next(PATIENCE).unwrap().unwrap().value, 1);
    manager.wait_for("the orphan", |manager| manager.held.len() == 1);

    daemon.kill();
    daemon = manager.start();
    let mut writer = daemon.store().writer::<u64>("n").unwrap();
    manager.wait_for("it was taken over", |manager| manager.held.is_empty());
    writer.write(&2).unwrap();

    assert_eq!(reader.next(PATIENCE).unwrap().unwrap().value, 2);
}

#[test]
fn what_is_removed_or_written_again_is_no_longer_held() {
    let mut manager = Manager::new();
    let mut daemon = manager.start();
    for name in ["a", "b", "c"] {
        daemon.done(&["put", name, "1", "--type", "u64"]);
    }
    manager.wait_for("three items", |manager| manager.held.len() == 3);
    daemon.kill();
    daemon = manager.start();

    daemon.done(&["rm", "a"]);
    let _writer = daemon.store().writer::<u64>("b").unwrap();
    manager.wait_for("one item", |manager| manager.held.len() == 1);

    daemon.kill();
    daemon = manager.start();
    let listed = daemon.done(&["ls"]);
    assert!(!listed.contains("robot1/a"), "{listed}");
    assert!(listed.contains("robot1/c"), "{listed}");
}

#[test]
fn bad_files_are_dropped_by_name_and_the_good_ones_come_back() {
    let mut manager = Manager::new();
    let mut daemon = manager.start();
    daemon.done(&["put", "good", "1", "--type", "u64"]);
    daemon.done(&["put", "bad", "2", "--type", "u64"]);
    manager.wait_for("two items", |manager| manager.held.len() == 2);
    daemon.kill();
    let mut entries = manager.held.keys().cloned();
    let (good, bad) = (entries.next().unwrap(), entries.next().unwrap());
    let fixed = SealFlags::SHRINK | SealFlags::GROW | SealFlags::SEAL;
    let (label, data) = (fixed | SealFlags::WRITE, fixed | SealFlags::FUTURE_WRITE);
    let dup = |at: usize| manager.held[&good][at].try_clone().unwrap();
    let directory = || OwnedFd::from(File::open("/").unwrap());
    let lies: BTreeMap<&str, Vec<OwnedFd>> = BTreeMap::from([
        ("stored", vec![file(b"?", fixed)]),
        ("f00", vec![directory()]),
        ("f01", vec![dup(0), dup(1)]),
        ("f02", vec![dup(0), dup(1), directory()]),
        ("f03", vec![file(&[7; 99], label), dup(1), dup(2)]),
        ("f04", vec![file(&[7; 1 << 20], label), dup(1), dup(2)]),
        ("f05", vec![dup(0), file(&[0; 128], data), dup(2)]),
        ("f06", vec![dup(0), dup(1), file(&[0; 100], fixed)]),
        ("f07", vec![dup(0), dup(1), dup(2)]),
        (
            "f08",
            vec![dup(0), dup(1), file(&[0; 8192], SealFlags::SEAL)],
        ),
    ]);
    let names: Vec<_> = lies.keys().map(|name| (*name).to_owned()).collect();
    for (name, files) in lies {
        manager.held.insert(name.to_owned(), files);
    }
    // One of three is missing, as when the manager's store was full.
    manager.held.get_mut(&bad).unwrap().pop();

    daemon = manager.start();

    manager.wait_for("all bad ones are released", |manager| {
        manager.held.len() == 1 && manager.held.contains_key(&good)
    });
    assert_eq!(daemon.sample("good")[0], json!(1));
    let listed = daemon.done(&["ls"]);
    assert!(!listed.contains("robot1/bad"), "{listed}");
    let log = daemon.kill();
    for name in ["stored", "f00", "f01", "f02", "f03", "f04", &bad] {
        assert!(log.contains(&format!("entry=\"{name}\"")), "{name}: {log}");
    }
    let refused = log.matches("dropped what").count();
    assert_eq!(refused, names.len() + 1, "{log}");
}

#[test]
fn files_that_are_passed_to_another_process_are_left_alone() {
    let mut manager = Manager::new();
    let mut daemon = manager.start();
    daemon.done(&["put", "n", "1", "--type", "u64"]);
    manager.wait_for("the item", |manager| manager.held.len() == 1);
    daemon.kill();

    daemon = manager.start_as("1");

    let listed = daemon.done(&["ls"]);
    assert!(!listed.contains("robot1/n"), "{listed}");
}

/// A file of these bytes, sealed.
fn file(bytes: &[u8], seals: SealFlags) -> OwnedFd {
    let flags = MemfdFlags::CLOEXEC | MemfdFlags::ALLOW_SEALING;
    let mut file = File::from(rustix::fs::memfd_create(c"bad", flags).unwrap());
    file.write_all(bytes).unwrap();
    rustix::fs::fcntl_add_seals(&file, seals).unwrap();
    file.into()
}

/// Plays the service manager.
struct Manager {
    dir: PathBuf,
    socket: UnixDatagram,
    held: BTreeMap<String, Vec<OwnedFd>>,
    /// Entries that were there when they were released.
    released: usize,
}

/// A running `ddx up`.
struct Daemon {
    child: Child,
    socket: PathBuf,
    log: PathBuf,
}

impl Manager {
    fn new() -> Self {
        static COUNT: AtomicU32 = AtomicU32::new(0);
        let count = COUNT.fetch_add(1, Ordering::Relaxed);
        let dir = std::env::temp_dir().join(format!("ddx-fds-{}-{count}", std::process::id()));
        fs::create_dir(&dir).unwrap();
        let socket = UnixDatagram::bind(dir.join("notify")).unwrap();
        socket.set_read_timeout(Some(PATIENCE)).unwrap();
        Self {
            dir,
            socket,
            held: BTreeMap::new(),
            released: 0,
        }
    }

    fn start(&self) -> Daemon {
        self.start_as("$$")
    }

    /// Starts a daemon with all files that are held, meant for the process `pid`, and waits until it serves.
    fn start_as(&self, pid: &str) -> Daemon {
        let held = self.held.iter();
        // The last is passed first: a manager promises no order.
        let passed: Vec<_> = held
            .flat_map(|(name, files)| files.iter().rev().map(move |file| (name.as_str(), file)))
            .collect();
        let names: Vec<_> = passed.iter().map(|(name, _)| *name).collect();
        let log = self.dir.join("log");
        // Numbers that none below is given to in the child.
        let high: Vec<_> = passed
            .iter()
            .map(|(_, file)| rustix::io::fcntl_dupfd_cloexec(file, 300).unwrap())
            .collect();
        let mut script = format!("export LISTEN_PID={pid}; ");
        for (number, file) in (3..).zip(&high) {
            rustix::io::fcntl_setfd(file, FdFlags::empty()).unwrap();
            let from = file.as_raw_fd();
            script += &format!("exec {number}<&{from}; exec {from}<&-; ");
        }
        // Only the shell knows its process, which is the daemon's after `exec`.
        let mut command = Command::new("bash");
        command
            .args(["-c", &format!("{script}exec \"$0\" \"$@\"")])
            .arg(env!("CARGO_BIN_EXE_ddx"))
            .args(["up", "--config", "/dev/null", "--host", "robot1"])
            .env_remove("RUST_LOG")
            .env("NO_COLOR", "1")
            .env("DDX_SOCKET", self.dir.join("ddx.sock"))
            .env("DDX_STATE_DIR", &self.dir)
            .env("NOTIFY_SOCKET", self.dir.join("notify"))
            .env("LISTEN_FDS", passed.len().to_string())
            .env("LISTEN_FDNAMES", names.join(":"))
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(File::create(&log).unwrap());
        let mut child = command.spawn().unwrap();
        let mut ready = String::new();
        BufReader::new(child.stdout.take().unwrap())
            .read_line(&mut ready)
            .unwrap();
        let socket = self.dir.join("ddx.sock");
        let daemon = Daemon { child, socket, log };
        assert!(ready.starts_with("ready"), "{}", daemon.said());
        daemon
    }

    /// Does what it is told until `holds`.
    fn wait_for(&mut self, what: &str, holds: impl Fn(&Self) -> bool) {
        let end = Instant::now() + PATIENCE;
        while !holds(self) {
            assert!(Instant::now() < end, "{what}: not within {PATIENCE:?}");
            let mut bytes = [0; 4096];
            let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(16))];
            let mut beside = RecvAncillaryBuffer::new(&mut space);
            let mut into = [IoSliceMut::new(&mut bytes)];
            let flags = RecvFlags::CMSG_CLOEXEC;
            let received = rustix::net::recvmsg(&self.socket, &mut into, &mut beside, flags)
                .unwrap_or_else(|e| panic!("{what}: {e}"));
            let mut files = Vec::new();
            for message in beside.drain() {
                if let RecvAncillaryMessage::ScmRights(rights) = message {
                    files.extend(rights);
                }
            }
            self.hear(&String::from_utf8_lossy(&bytes[..received.bytes]), files);
        }
    }

    fn hear(&mut self, message: &str, files: Vec<OwnedFd>) {
        let fields: BTreeMap<_, _> = message
            .lines()
            .filter_map(|line| line.split_once('='))
            .collect();
        let name = fields.get("FDNAME").copied().unwrap_or("stored");
        if fields.contains_key("FDSTORE") {
            self.held.entry(name.to_owned()).or_default().extend(files);
        }
        if fields.contains_key("FDSTOREREMOVE") && self.held.remove(name).is_some() {
            self.released += 1;
        }
    }
}

impl Drop for Manager {
    fn drop(&mut self) {
        fs::remove_dir_all(&self.dir).unwrap();
    }
}

impl Daemon {
    fn store(&self) -> Store {
        Store::options().socket(&self.socket).open().unwrap()
    }

    /// Kills it without a warning, and returns what it has logged.
    fn kill(&mut self) -> String {
        self.child.kill().unwrap();
        self.child.wait().unwrap();
        self.said()
    }

    fn said(&self) -> String {
        fs::read_to_string(&self.log).unwrap()
    }

    fn ddx(&self, arguments: &[&str]) -> Output {
        Command::new(env!("CARGO_BIN_EXE_ddx"))
            .args(arguments)
            .env("DDX_SOCKET", &self.socket)
            .output()
            .unwrap()
    }

    fn done(&self, arguments: &[&str]) -> String {
        let output = self.ddx(arguments);
        let said = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(0), "{arguments:?}: {said}");
        String::from_utf8(output.stdout).unwrap()
    }

    fn json(&self, arguments: &[&str]) -> Value {
        serde_json::from_str(&self.done(&[&["--json"], arguments].concat())).unwrap()
    }

    /// The last value, when it was captured, and the writer's epoch.
    fn sample(&self, name: &str) -> [Value; 3] {
        let sample = self.json(&["get", name]);
        ["value", "capture_ns", "epoch"].map(|field| sample[field].clone())
    }
}

impl Drop for Daemon {
    fn drop(&mut self) {
        // Fails only when it has ended.
        let _ended = self.child.kill();
        self.child.wait().unwrap();
    }
}
