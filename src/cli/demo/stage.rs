//! The stage of the demo: two hosts as real processes, the ground that they stand on, and the link between them.
//!
//! Every child ends when its standard input closes, and so with this process, however that ends: the daemons and sources
//! are tethered, and the `cat` that holds a namespace reads to the end. A namespace goes with its last process.

use std::ffi::OsString;
use std::fs;
use std::io::{BufRead as _, BufReader, Write as _};
use std::os::unix::fs::{DirBuilderExt as _, OpenOptionsExt as _};
use std::os::unix::process::CommandExt as _;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::thread;
use std::time::{Duration, Instant};

use anyhow::{Context as _, bail, ensure};
use ddx_store::Store;
use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;

use crate::cli::key;

/// Two hosts and what lies between them.
#[derive(Debug)]
pub(super) struct Stage {
    pub(super) robot: Actor,
    pub(super) base: Actor,
    pub(super) ground: Ground,
    // Last: it is removed after the processes that use it have ended.
    dir: Dir,
}

/// Where the hosts live.
#[derive(Debug)]
pub(super) enum Ground {
    /// Each in a network namespace of its own, with a cable between them.
    Namespaces,
    /// Both on the loopback, because namespaces cannot be had.
    Loopback {
        /// What was refused.
        reason: String,
    },
}

/// One host: a daemon and its programs.
#[derive(Debug)]
pub(super) struct Actor {
    name: &'static str,
    socket: PathBuf,
    state: PathBuf,
    log: PathBuf,
    holder: Option<Reaped>,
    daemon: Option<Reaped>,
    programs: Vec<Reaped>,
}

/// A child that is killed and reaped when it is dropped.
#[derive(Debug)]
struct Reaped(Child);

#[derive(Debug)]
struct Dir(PathBuf);

/// Where a plain user may not make namespaces, makes a user namespace in which it may, and starts over in it. Returns
/// where that is not needed or not allowed.
pub(super) fn enter_user_namespace() {
    let marked = std::env::var_os(INSIDE).is_some();
    if marked || rustix::process::geteuid().is_root() {
        return;
    }
    let unshare = || {
        let mut command = Command::new("unshare");
        command.args(["--user", "--map-root-user", "--net", "--"]);
        command
    };
    let allowed = unshare()
        .arg("true")
        .stderr(Stdio::null())
        .status()
        .is_ok_and(|status| status.success());
    if allowed && let Ok(program) = std::env::current_exe() {
        let failed = unshare()
            .arg(program)
            .args(std::env::args_os().skip(1))
            .env(INSIDE, "1")
            .exec();
        tracing::debug!(error = %failed, "no user namespace");
    }
}

impl Stage {
    /// Lays the cable and starts both daemons, which share a key of their own.
    pub(super) fn build() -> anyhow::Result<Self> {
        let dir = Dir::create()?;
        write(&dir.0.join("key"), key::text()?.as_bytes())?;
        write(&dir.0.join("gps.nmea"), LOG)?;
        write(&dir.0.join("bunny.y4m"), CLIP)?;
        let (mut robot, mut base) = (Actor::new("robot1", &dir.0), Actor::new("base", &dir.0));
        let ground = match lay_cable(&mut robot, &mut base) {
            Ok(()) => Ground::Namespaces,
            Err(refusal) => {
                (robot.holder, base.holder) = (None, None);
                Ground::Loopback {
                    reason: format!("{refusal:#}"),
                }
            }
        };
        let mut stage = Self {
            robot,
            base,
            ground,
            dir,
        };
        let seed = stage.start_robot()?;
        let join = stage.on_loopback().then_some(seed).flatten();
        stage
            .base
            .start_daemon(&stage.dir.0, stage.on_loopback(), join.as_deref())?;
        Ok(stage)
    }

    /// Starts the robot's daemon and its sources. Returns where its daemon can be asked.
    pub(super) fn start_robot(&mut self) -> anyhow::Result<Option<String>> {
        let seed = self
            .robot
            .start_daemon(&self.dir.0, self.on_loopback(), None)?;
        let log = self.dir.0.join("gps.nmea");
        let nmea = ["source", "nmea", "--name", "gps", "--rate", "10", "--loop"];
        self.robot
            .start_program(nmea.map(OsString::from).into_iter().chain([log.into()]))?;
        let system = ["source", "system", "--name", "sys", "--rate", "10"];
        self.robot.start_program(system.map(OsString::from))?;
        let clip = self.dir.0.join("bunny.y4m");
        let video = ["video", "load", "--name", "cam", "--loop"];
        self.robot
            .start_program(video.map(OsString::from).into_iter().chain([clip.into()]))?;
        Ok(seed)
    }

    /// Serves what base sees to a browser, which is outside of its namespace. Returns where.
    pub(super) fn start_server(&mut self) -> anyhow::Result<String> {
        let program = std::env::current_exe().context("find this program")?;
        let mut command = self.base.prepared(Command::new(program))?;
        command.args(["video", "serve", "--listen", SERVED]);
        let (child, line) = first_line(command.stdout(Stdio::piped()))?;
        let Ok(ready) = serde_json::from_str::<Value>(&line) else {
            bail!("nothing is served: {}", self.base.last_words());
        };
        self.base.programs.push(child);
        let url = ready["url"].as_str().unwrap_or_default();
        Ok(format!("{url}#robot1%2Fcam"))
    }

    /// Kills all of the robot's processes at once, without a warning.
    pub(super) fn kill_robot(&mut self) {
        self.robot.daemon = None;
        self.robot.programs.clear();
    }

    /// Cuts the link, or, on the loopback, stops the robot's daemon in its tracks.
    pub(super) fn cut(&self) -> anyhow::Result<()> {
        match &self.ground {
            Ground::Namespaces => self.robot.ip("link set link0 down"),
            Ground::Loopback { .. } => self.robot.signal(Signal::STOP),
        }
    }

    /// Undoes [`Stage::cut`].
    pub(super) fn heal(&self) -> anyhow::Result<()> {
        match &self.ground {
            Ground::Namespaces => self.robot.ip("link set link0 up"),
            Ground::Loopback { .. } => self.robot.signal(Signal::CONT),
        }
    }

    /// All bytes that crossed the cable so far; `None` on the loopback, which others use too.
    pub(super) fn link_bytes(&self) -> Option<u64> {
        let holder = self.robot.holder.as_ref()?.0.id();
        let text = fs::read_to_string(format!("/proc/{holder}/net/dev")).ok()?;
        let counters = text
            .lines()
            .find_map(|line| line.trim().strip_prefix("link0:"))?;
        let at = |index| counters.split_whitespace().nth(index)?.parse::<u64>().ok();
        Some(at(0)? + at(8)?)
    }

    fn on_loopback(&self) -> bool {
        matches!(self.ground, Ground::Loopback { .. })
    }
}

impl Actor {
    fn new(name: &'static str, dir: &Path) -> Self {
        Self {
            name,
            socket: dir.join(format!("{name}.sock")),
            state: dir.join(name),
            log: dir.join(format!("{name}.log")),
            holder: None,
            daemon: None,
            programs: Vec::new(),
        }
    }

    /// The socket of the host's daemon.
    pub(super) fn socket(&self) -> &Path {
        &self.socket
    }

    /// Connects to the host's daemon, as a program on that host would.
    pub(super) fn store(&self) -> anyhow::Result<Store> {
        Ok(Store::options()
            .socket(&self.socket)
            .program("ddx demo")
            .open()?)
    }

    /// A command on this host.
    fn command(&self, program: impl Into<OsString>) -> Command {
        match &self.holder {
            None => Command::new(program.into()),
            Some(holder) => {
                let mut command = Command::new("nsenter");
                let pid = holder.0.id().to_string();
                command
                    .args(["--net", "--target", &pid, "--"])
                    .arg(program.into());
                command
            }
        }
    }

    fn ddx(&self) -> anyhow::Result<Command> {
        let program = std::env::current_exe().context("find this program")?;
        self.prepared(self.command(program))
    }

    /// Tells a `ddx` whose daemon is its own.
    fn prepared(&self, mut command: Command) -> anyhow::Result<Command> {
        for (name, _) in std::env::vars_os() {
            if name.to_string_lossy().starts_with("DDX_") || name == "NOTIFY_SOCKET" {
                command.env_remove(name);
            }
        }
        let log = fs::File::options()
            .create(true)
            .append(true)
            .open(&self.log)?;
        command
            .args(["--tethered", "--json", "--socket"])
            .arg(&self.socket)
            .env("DDX_STATE_DIR", &self.state)
            .stdin(Stdio::piped())
            .stderr(log);
        Ok(command)
    }

    /// Starts the daemon and waits until it is ready. Returns the first address at which others can ask it.
    fn start_daemon(
        &mut self,
        dir: &Path,
        loopback: bool,
        join: Option<&str>,
    ) -> anyhow::Result<Option<String>> {
        let mut command = self.ddx()?;
        command.args(["up", "--config", "/dev/null", "--host", self.name, "--key"]);
        command.arg(dir.join("key"));
        command.args(["--iface", if loopback { "lo" } else { "link0" }]);
        if let Some(address) = join {
            command.args(["--join", &format!("udp/{address}")]);
        }
        let (child, line) = first_line(command.stdout(Stdio::piped()))?;
        let Ok(ready) = serde_json::from_str::<Value>(&line) else {
            bail!("host {} did not start: {}", self.name, self.last_words());
        };
        self.daemon = Some(child);
        let address = ready["control"].get(0).and_then(Value::as_str);
        Ok(address.map(str::to_owned))
    }

    fn start_program(
        &mut self,
        arguments: impl IntoIterator<Item = OsString>,
    ) -> anyhow::Result<()> {
        let mut command = self.ddx()?;
        let child = command.args(arguments).stdout(Stdio::null()).spawn();
        self.programs
            .push(Reaped(child.context("start `ddx source`")?));
        Ok(())
    }

    /// Runs `ip` on this host.
    fn ip(&self, arguments: &str) -> anyhow::Result<()> {
        run(self.command("ip").args(arguments.split_whitespace()))
    }

    /// The kernel takes its time to notice that the other end is up.
    fn await_carrier(&self) -> anyhow::Result<()> {
        let deadline = Instant::now() + PATIENCE;
        loop {
            let shown = self
                .command("ip")
                .args(["-oneline", "link", "show", "link0"])
                .output()?;
            if String::from_utf8_lossy(&shown.stdout).contains("state UP") {
                return Ok(());
            }
            ensure!(
                Instant::now() < deadline,
                "the cable of {} has no carrier",
                self.name
            );
            thread::sleep(Duration::from_millis(5));
        }
    }

    fn signal(&self, signal: Signal) -> anyhow::Result<()> {
        if let Some(daemon) = &self.daemon {
            kill_process(Pid::from_child(&daemon.0), signal)?;
        }
        Ok(())
    }

    fn last_words(&self) -> String {
        let text = fs::read_to_string(&self.log).unwrap_or_default();
        let error = text
            .lines()
            .rev()
            .find_map(|line| line.strip_prefix("error: "));
        error.unwrap_or("it said nothing").to_owned()
    }
}

/// Starts a program and waits for the first line that it prints.
fn first_line(command: &mut Command) -> anyhow::Result<(Reaped, String)> {
    let mut child = Reaped(command.spawn().context("start `ddx`")?);
    let mut line = String::new();
    if let Some(stdout) = child.0.stdout.take() {
        BufReader::new(stdout).read_line(&mut line)?;
    }
    Ok((child, line))
}

/// Gives each host a namespace and joins the two by a virtual cable.
fn lay_cable(robot: &mut Actor, base: &mut Actor) -> anyhow::Result<()> {
    let (left, right) = (hold_namespace()?, hold_namespace()?);
    let (left_pid, right_pid) = (left.0.id().to_string(), right.0.id().to_string());
    robot.holder = Some(left);
    base.holder = Some(right);
    run(Command::new("ip").args([
        "link", "add", "link0", "netns", &left_pid, "type", "veth", "peer", "name", "link0",
        "netns", &right_pid,
    ]))?;
    for (actor, address) in [(&*robot, "10.77.0.1/24"), (&*base, "10.77.0.2/24")] {
        actor.ip("link set lo up")?;
        actor.ip(&format!("address add {address} dev link0"))?;
        actor.ip("link set link0 up")?;
    }
    robot.await_carrier()?;
    base.await_carrier()
}

/// Starts a process that keeps a new network namespace alive until this process ends.
fn hold_namespace() -> anyhow::Result<Reaped> {
    let own = fs::read_link("/proc/self/ns/net")?;
    let mut command = Command::new("unshare");
    command
        .args(["--net", "--", "cat"])
        .stdin(Stdio::piped())
        .stdout(Stdio::null())
        .stderr(Stdio::null());
    let mut holder = Reaped(command.spawn().context("`unshare --net`")?);
    let path = format!("/proc/{}/ns/net", holder.0.id());
    let deadline = Instant::now() + PATIENCE;
    while fs::read_link(&path).is_ok_and(|namespace| namespace == own) {
        ensure!(
            holder.0.try_wait()?.is_none(),
            "`unshare --net` is not permitted"
        );
        ensure!(Instant::now() < deadline, "`unshare --net` takes too long");
        thread::sleep(Duration::from_millis(2));
    }
    ensure!(
        holder.0.try_wait()?.is_none(),
        "`unshare --net` is not permitted"
    );
    Ok(holder)
}

fn run(command: &mut Command) -> anyhow::Result<()> {
    let what = format!("`{}`", command.get_program().to_string_lossy());
    let output = command
        .stdin(Stdio::null())
        .output()
        .with_context(|| what.clone())?;
    if !output.status.success() {
        bail!("{what}: {}", String::from_utf8_lossy(&output.stderr).trim());
    }
    Ok(())
}

fn write(path: &Path, contents: &[u8]) -> anyhow::Result<()> {
    fs::File::options()
        .write(true)
        .create_new(true)
        .mode(0o600)
        .open(path)
        .and_then(|mut file| file.write_all(contents))
        .with_context(|| format!("write `{}`", path.display()))
}

impl Dir {
    fn create() -> anyhow::Result<Self> {
        let path = std::env::temp_dir().join(format!("ddx-demo-{}", std::process::id()));
        fs::DirBuilder::new()
            .mode(0o700)
            .create(&path)
            .with_context(|| format!("create `{}`", path.display()))?;
        Ok(Self(path))
    }
}

impl Drop for Dir {
    fn drop(&mut self) {
        if let Err(error) = fs::remove_dir_all(&self.0) {
            tracing::warn!(path = %self.0.display(), %error, "not removed");
        }
    }
}

impl Drop for Reaped {
    fn drop(&mut self) {
        // Fails only when it has ended, which is what is wanted.
        let _ended = self.0.kill();
        let _reaped = self.0.wait();
    }
}

/// Set in the user namespace, so that it is entered once.
const INSIDE: &str = "DDX_DEMO_INSIDE";
const PATIENCE: Duration = Duration::from_secs(2);
/// Where a browser sees what base sees; whichever port is free, so that two shows do not meet.
const SERVED: &str = "127.0.0.1:0";
/// The real log of a GPS receiver; see `deploy/data/NOTICE`. What is played is in the program, which runs without a
/// checkout too.
const LOG: &[u8] = include_bytes!("../../../deploy/data/gps.nmea");
/// A real film; see the same.
const CLIP: &[u8] = include_bytes!("../../../deploy/data/bunny.y4m");

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_directory_goes_when_the_stage_does() {
        let dir = Dir::create().unwrap();
        let path = dir.0.clone();
        write(&path.join("key"), b"x").unwrap();

        assert!(write(&path.join("key"), b"y").is_err());
        drop(dir);
        assert!(!path.exists());
    }

    #[test]
    fn a_command_that_fails_is_named_with_what_it_said() {
        let refusal = run(Command::new("ls").arg("/nonexistent"))
            .unwrap_err()
            .to_string();

        assert!(
            refusal.starts_with("`ls`: ") && refusal.contains("/nonexistent"),
            "{refusal}"
        );
    }
}
