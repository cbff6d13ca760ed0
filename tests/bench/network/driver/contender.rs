//! Who is measured, and how each is started.

use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::{Context, Result, bail};

/// One way to carry samples.
#[derive(Debug)]
pub(crate) struct Contender {
    /// As in the table and on the command line.
    pub(crate) name: &'static str,
    /// Its program, below the directory of the peers; none for this program itself.
    program: Option<&'static str>,
    /// Words before `pub` or `sub`.
    words: &'static [&'static str],
    /// Whether it is asked to deliver every sample.
    reliable: bool,
    /// Whether it is measured only on request.
    pub(crate) is_extra: bool,
    /// Whether what it sends is sealed.
    sealed: bool,
    /// Whether each host needs a daemon, which is `ddx up`.
    pub(crate) has_daemon: bool,
    /// Whether the daemon's threads never sleep.
    pub(crate) spins: bool,
    /// Whether nobody is compared with it: what no design can beat, or what takes whole cores.
    pub(crate) is_floor: bool,
}

/// Where the programs are.
pub(crate) struct Build {
    /// The daemon.
    pub(crate) ddx: PathBuf,
    /// The target directory.
    pub(crate) target: PathBuf,
    own: PathBuf,
    peers: PathBuf,
}

/// What the goals are about.
pub(crate) const DDX: &str = "ddx";

const PLAIN: Contender = Contender {
    name: "",
    program: None,
    words: &[],
    reliable: false,
    is_extra: false,
    sealed: false,
    has_daemon: false,
    spins: false,
    is_floor: false,
};

/// All, in the order of the table.
pub(crate) const CONTENDERS: &[Contender] = &[
    Contender {
        name: DDX,
        words: &["program", "ddx"],
        sealed: true,
        has_daemon: true,
        ..PLAIN
    },
    Contender {
        name: "ddx-spin",
        words: &["program", "ddx"],
        sealed: true,
        has_daemon: true,
        spins: true,
        is_floor: true,
        ..PLAIN
    },
    Contender {
        name: "ddx-every",
        words: &["program", "ddx"],
        sealed: true,
        has_daemon: true,
        reliable: true,
        is_extra: true,
        ..PLAIN
    },
    Contender {
        name: "bare-udp",
        words: &["program", "udp"],
        is_floor: true,
        ..PLAIN
    },
    Contender {
        name: "zenoh-tcp",
        program: Some("zenoh/release/ddx-bench-zenoh"),
        ..PLAIN
    },
    Contender {
        name: "zenoh-tls",
        program: Some("zenoh/release/ddx-bench-zenoh"),
        is_extra: true,
        sealed: true,
        ..PLAIN
    },
    Contender {
        name: "zenoh-quic",
        program: Some("zenoh/release/ddx-bench-zenoh"),
        words: &["quic"],
        sealed: true,
        ..PLAIN
    },
    Contender {
        name: "lcm",
        program: Some("lcm"),
        ..PLAIN
    },
    Contender {
        name: "ecal-python",
        program: Some("ecal"),
        ..PLAIN
    },
    Contender {
        name: "cyclonedds",
        program: Some("cyclonedds"),
        ..PLAIN
    },
    Contender {
        name: "cyclonedds-reliable",
        program: Some("cyclonedds"),
        reliable: true,
        is_extra: true,
        ..PLAIN
    },
    Contender {
        name: "fastdds",
        program: Some("fastdds"),
        ..PLAIN
    },
    Contender {
        name: "fastdds-reliable",
        program: Some("fastdds"),
        reliable: true,
        is_extra: true,
        ..PLAIN
    },
];

impl Contender {
    /// Whether nothing of others is needed.
    pub(crate) fn is_own(&self) -> bool {
        self.program.is_none() && !self.reliable && !self.spins
    }

    /// The command of one of its programs, up to `pub` or `sub`.
    pub(crate) fn command(&self, build: &Build, role: &str) -> Command {
        let mut command = Command::new(self.path(build));
        command.args(self.words).arg(role);
        if self.reliable {
            command.arg("--reliable");
        }
        if self.sealed && self.program.is_some() {
            command.arg("--tls").arg(build.peers.join("tls"));
        }
        command
    }

    fn path(&self, build: &Build) -> PathBuf {
        self.program
            .map_or_else(|| build.own.clone(), |program| build.peers.join(program))
    }
}

impl Build {
    /// Finds `ddx` beside this program and the peers below the target directory.
    pub(crate) fn find(peers: Option<PathBuf>) -> Result<Self> {
        let own = std::env::current_exe().context("finding this program")?;
        let target = own
            .ancestors()
            .nth(2)
            .context("this program lies in no target directory")?
            .to_owned();
        let ddx = own.with_file_name("ddx");
        if !ddx.exists() {
            bail!(
                "`{}` is missing\nhint: cargo build --release --workspace",
                ddx.display()
            );
        }
        let peers = peers.unwrap_or_else(|| target.join("network"));
        let peers = std::path::absolute(peers).context("finding the peers")?;
        Ok(Self {
            ddx,
            target,
            own,
            peers,
        })
    }

    /// What is missing for this contender.
    pub(crate) fn missing(&self, contender: &Contender) -> Option<PathBuf> {
        let is_there = |path: &Path| path.exists();
        Some(contender.path(self)).filter(|path| !is_there(path))
    }
}
