//! A lab whose hosts run daemons of one domain, and what scenarios look at.

use std::collections::BTreeMap;
use std::process::Command;
use std::time::{Duration, Instant};

use ddx_rig::lab::{self, Counters, Lab, Process};
use ddx_rig::link::Profile;
use serde_json::Value;

use crate::program::{Asked, Program};

/// UDP port of every daemon's samples: all that a host sends leaves from it.
pub(crate) const DATA_PORT: u16 = 7450;
/// Name under which the switch counts datagrams from or to that port or the port of the groups.
pub(crate) const SAMPLES: &str = "samples";
/// Beyond this, what should happen within a second or two does not happen.
pub(crate) const PATIENCE: Duration = Duration::from_secs(10);

/// A lab and its daemons; dropped, all end.
#[derive(Debug)]
pub(crate) struct Site {
    daemons: BTreeMap<String, Process>,
    pub(crate) lab: Lab,
}

impl Site {
    /// Builds a lab with a key in each host and starts no daemon yet; none where no lab can be had.
    pub(crate) fn bare(hosts: &[&str]) -> Option<Self> {
        let lab = lab::require(hosts)?;
        lab.watch_udp(SAMPLES, &[DATA_PORT, ddx_catalog::SAMPLE_GROUP_PORT_BASE])
            .unwrap();
        for host in lab.hosts() {
            let files =
                format!("echo {KEY} >/run/key; echo 'data_port = {DATA_PORT}' >/run/ddx.toml");
            host.shell(&files).unwrap();
        }
        Some(Self {
            daemons: BTreeMap::new(),
            lab,
        })
    }

    /// The same with a daemon in each host, of which every one sees all others.
    pub(crate) fn new(hosts: &[&str]) -> Option<Self> {
        let mut site = Self::bare(hosts)?;
        for host in hosts {
            site.up(host, &["--key", "/run/key"]);
        }
        for host in hosts {
            for other in hosts.iter().filter(|other| *other != host) {
                site.wait_state(host, other, "up");
            }
        }
        Some(site)
    }

    /// Starts the daemon of a host and waits until it is ready; returns what it said then.
    pub(crate) fn up(&mut self, host: &str, arguments: &[&str]) -> Value {
        let mut command = Command::new(DDX);
        command
            .args(["--json", "up", "--config", "/run/ddx.toml", "--host", host])
            .args(arguments);
        let daemon = self.lab.host(host).spawn(&command).unwrap();
        let line = daemon
            .wait_line(|line| line.starts_with('{'), PATIENCE)
            .unwrap();
        self.daemons.insert(host.to_owned(), daemon);
        serde_json::from_str(&line).unwrap()
    }

    /// Ends a daemon by `SIGTERM`.
    pub(crate) fn terminate(&mut self, host: &str) {
        let mut daemon = self.daemons.remove(host).unwrap();
        let status = daemon.terminate(PATIENCE).unwrap();
        assert!(status.success(), "{status}: {}", daemon.errors());
    }

    /// Ends a daemon by `SIGKILL`.
    pub(crate) fn kill(&mut self, host: &str) {
        self.daemons.remove(host).unwrap().kill().unwrap();
    }

    /// The process id, on this machine, of a host's daemon.
    pub(crate) fn pid(&mut self, host: &str) -> u32 {
        self.daemons.get_mut(host).unwrap().pid().unwrap()
    }

    /// Starts a program in a host.
    pub(crate) fn program(&self, host: &str) -> Program {
        Program::start(self.lab.host(host))
    }

    /// Starts a writer of `robot1/imu/0` and up in `robot1` and a reader of all of them in `base`, which has the first
    /// value, 0, of each.
    #[track_caller]
    pub(crate) fn imu(&self, items: usize, asked: Asked) -> (Program, Program) {
        let (mut robot, mut reader) = (self.program("robot1"), self.program("base"));
        robot.open_writers("robot1/imu", items);
        robot.write(0);
        reader.open_readers_as("robot1/imu", items, asked);
        reader.read(0, PATIENCE);
        (robot, reader)
    }

    /// Runs `ddx --json` in a host and returns the objects that it prints.
    #[track_caller]
    pub(crate) fn ddx(&self, host: &str, arguments: &[&str]) -> Vec<Value> {
        let mut command = Command::new(DDX);
        command.arg("--json").args(arguments);
        let output = self.lab.host(host).exec(&command).unwrap();
        assert!(
            output.status.success(),
            "{arguments:?} on {host}: {}",
            output.stderr
        );
        output
            .stdout
            .lines()
            .map(|line| serde_json::from_str(line).unwrap())
            .collect()
    }

    /// What `host` says of the state of another, if it knows it.
    pub(crate) fn state(&self, host: &str, other: &str) -> Option<String> {
        let hosts = self.ddx(host, &["host", "ls"]);
        let entry = hosts.iter().find(|entry| entry["host"] == other)?;
        entry["state"].as_str().map(str::to_owned)
    }

    /// Waits until `host ls` of `host` shows another in a state.
    #[track_caller]
    pub(crate) fn wait_state(&self, host: &str, other: &str, state: &str) -> Duration {
        let what = format!("{host} to see {other} {state}");
        wait(&what, PATIENCE, || match self.state(host, other) {
            Some(seen) if seen == state => Ok(()),
            seen => Err(format!("{seen:?}")),
        })
    }

    /// Waits until `ls` of `host` lists that item, or no longer does.
    #[track_caller]
    pub(crate) fn wait_listed(&self, host: &str, item: &str, listed: bool) {
        let what = format!("{host} to list {item}: {listed}");
        wait(&what, PATIENCE, || match self.ddx(host, &["ls", item]) {
            entries if entries.is_empty() != listed => Ok(()),
            entries => Err(format!("{entries:?}")),
        });
    }

    /// Waits until `host` sends an item below `prefix` to so many hosts by this path.
    #[track_caller]
    pub(crate) fn wait_path(&self, host: &str, prefix: &str, path: &str, readers: usize) {
        self.wait_path_within(host, prefix, (path, readers), PATIENCE);
    }

    /// The same by a deadline.
    #[track_caller]
    pub(crate) fn wait_path_within(
        &self,
        host: &str,
        prefix: &str,
        (path, readers): (&str, usize),
        deadline: Duration,
    ) {
        let what = format!("{host} to send {prefix} by {path} to {readers}");
        wait(&what, deadline, || {
            let routes = self.ddx(host, &["get", "@/routes"]);
            let routes = routes[0]["value"].as_array().cloned().unwrap_or_default();
            let is_settled = routes.iter().any(|route| {
                let is_ours = route["name"]
                    .as_str()
                    .is_some_and(|name| name.starts_with(prefix));
                let peers = route["peers"].as_array().map_or(0, Vec::len);
                is_ours && route["path"] == path && peers == readers
            });
            if is_settled {
                Ok(())
            } else {
                Err(format!("{routes:?}"))
            }
        });
    }

    /// Emulates the link of a host from now on.
    #[track_caller]
    pub(crate) fn link(&self, host: &str, profile: &str) -> Profile {
        let profile = Profile::parse(profile).unwrap();
        self.lab.host(host).set_link(&profile).unwrap();
        profile
    }

    /// What the switch has counted so far.
    pub(crate) fn counters(&self) -> Counters {
        self.lab.counters().unwrap()
    }

    /// Waits until `host` has sent no sample for longer than anything is repeated after its last one.
    #[track_caller]
    pub(crate) fn wait_quiet(&self, host: &str) {
        self.sends_until(host, Instant::now(), REPEATS_END);
    }

    /// Follows what `host` sends until nothing was sent for `quiet`; returns how long after `since` the last datagram was.
    #[track_caller]
    pub(crate) fn sends_until(&self, host: &str, since: Instant, quiet: Duration) -> Duration {
        let sent = |counters: &Counters| counters.udp(SAMPLES, host).from.packets;
        let mut last = (sent(&self.counters()), Instant::now());
        while last.1.elapsed() < quiet {
            let seen = sent(&self.counters());
            if seen != last.0 {
                last = (seen, Instant::now());
            }
            assert!(
                since.elapsed() < PATIENCE,
                "{host} still sends after {PATIENCE:?}"
            );
        }
        last.1.duration_since(since)
    }
}

/// Looks again and again until `look` is content; returns how long that took.
#[track_caller]
pub(crate) fn wait(
    what: &str,
    deadline: Duration,
    mut look: impl FnMut() -> Result<(), String>,
) -> Duration {
    let start = Instant::now();
    loop {
        let Err(seen) = look() else {
            return start.elapsed();
        };
        assert!(
            start.elapsed() < deadline,
            "no {what} within {deadline:?}; last seen: {seen}"
        );
    }
}

/// What a measurement came to, for those who run a test with its output.
#[expect(
    clippy::print_stderr,
    reason = "figures for people; nothing reads them"
)]
pub(crate) fn report(what: &str, figure: Duration) {
    eprintln!("{what}: {figure:.1?}");
}

/// A row of figures, for the same.
#[expect(
    clippy::print_stderr,
    reason = "figures for people; nothing reads them"
)]
pub(crate) fn row(line: &str) {
    eprintln!("{line}");
}

/// Longer than a reader takes to confirm and a sender to repeat.
const REPEATS_END: Duration = Duration::from_millis(300);
const DDX: &str = env!("CARGO_BIN_EXE_ddx");
const KEY: &str = "00112233445566778899aabbccddeeff00112233445566778899aabbccddeeff";
