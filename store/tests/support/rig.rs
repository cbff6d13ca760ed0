//! What the tests of whole processes share: daemons in threads and in processes, children, conditions with deadlines.

use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use ddx_store::server::{Config, Handle, Server};
use ddx_store::{Quotas, Store};
use ddx_wire::HostName;

/// Longer than anything here may take: a test that waits so long has failed.
pub const LONG: Duration = Duration::from_secs(10);
/// Not at all.
pub const NONE: Duration = Duration::ZERO;

/// A daemon on a thread of this process, in a directory of its own.
pub struct Daemon {
    dir: Dir,
    handle: Handle,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

/// A directory that is removed with everything in it.
pub struct Dir(PathBuf);

/// A process that is killed when the test lets go of it.
pub struct Process {
    child: Child,
    lines: BufReader<std::process::ChildStdout>,
}

impl Daemon {
    pub fn start(quotas: Quotas) -> Self {
        let dir = Dir::new();
        let mut server = Server::bind(config(&dir.socket(), quotas)).unwrap();
        let handle = server.handle();
        let stop = Arc::new(AtomicBool::new(false));
        let stopped = Arc::clone(&stop);
        let thread = std::thread::spawn(move || server.run(&stopped).unwrap());
        Self {
            dir,
            handle,
            stop,
            thread: Some(thread),
        }
    }

    pub fn store(&self) -> Store {
        open(&self.socket())
    }

    pub fn socket(&self) -> PathBuf {
        self.dir.socket()
    }

    pub fn handle(&self) -> &Handle {
        &self.handle
    }
}

impl Drop for Daemon {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        self.handle.wake();
        if let Some(thread) = self.thread.take() {
            thread.join().unwrap();
        }
    }
}

impl Dir {
    pub fn new() -> Self {
        static COUNT: AtomicU32 = AtomicU32::new(0);
        let count = COUNT.fetch_add(1, Ordering::Relaxed);
        let dir = std::env::temp_dir().join(format!("ddx-test-{}-{count}", std::process::id()));
        std::fs::create_dir_all(&dir).unwrap();
        Self(dir)
    }

    pub fn socket(&self) -> PathBuf {
        self.0.join("host.sock")
    }
}

impl Drop for Dir {
    fn drop(&mut self) {
        std::fs::remove_dir_all(&self.0).ok();
    }
}

impl Process {
    /// Runs this test binary again in a role, at the daemon of `socket`.
    pub fn start(role: &str, socket: &Path, env: &[(&str, &str)]) -> Self {
        let mut command = Command::new(std::env::current_exe().unwrap());
        command
            .args(["--exact", "role", "--nocapture", "--test-threads=1"])
            .env("DDX_ROLE", role)
            .env("DDX_SOCKET", socket)
            .envs(env.iter().copied())
            .stdout(Stdio::piped())
            .stderr(Stdio::null());
        let mut child = command.spawn().unwrap();
        let lines = BufReader::new(child.stdout.take().unwrap());
        Self { child, lines }
    }

    /// Reads what the process prints until a line begins with `word`, and returns the rest of that line.
    pub fn wait_for(&mut self, word: &str) -> String {
        loop {
            let mut line = String::new();
            let read = self.lines.read_line(&mut line).unwrap();
            assert!(read > 0, "the process has ended without `{word}`");
            // The harness prints the name of the test in front of the first line.
            if let Some((_, rest)) = line.trim_end().split_once(&format!("!{word}")) {
                return rest.trim().to_owned();
            }
        }
    }

    pub fn kill(&mut self) {
        self.child.kill().unwrap();
        self.child.wait().unwrap();
    }

    /// Waits for the end of the process, and says which signal has ended it.
    pub fn wait_signal(&mut self) -> Option<i32> {
        std::os::unix::process::ExitStatusExt::signal(&self.child.wait().unwrap())
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        self.child.kill().ok();
        self.child.wait().ok();
    }
}

pub fn config(socket: &Path, quotas: Quotas) -> Config {
    Config {
        socket: Some(socket.to_owned()),
        quotas,
        ..Config::new(HostName::parse("host").unwrap())
    }
}

pub fn open(socket: &Path) -> Store {
    Store::options().socket(socket).open().unwrap()
}

/// The role that this process was started in, and its daemon; none in the test itself.
pub fn role() -> Option<(String, PathBuf)> {
    let role = std::env::var("DDX_ROLE").ok()?;
    let socket = std::env::var_os("DDX_SOCKET")?;
    Some((role, PathBuf::from(socket)))
}

/// Serves until killed.
pub fn serve(socket: &Path, ordinal: u32) {
    let config = Config {
        ordinal,
        ..config(socket, Quotas::default())
    };
    let mut server = Server::bind(config).unwrap();
    println!("!ready");
    server.run(&AtomicBool::new(false)).unwrap();
}

/// Waits until `holds`, at most [`LONG`].
pub fn until(what: &str, mut holds: impl FnMut() -> bool) {
    let start = Instant::now();
    while !holds() {
        assert!(start.elapsed() < LONG, "never: {what}");
        std::thread::yield_now();
    }
}
