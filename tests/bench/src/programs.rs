//! The programs that the bench runs: `ddx`, the peers, and itself in a role.

use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

use anyhow::{Context, Result, bail};
use ddx_store::Store;

/// Where the programs are.
pub(crate) struct Programs {
    /// The daemon and command line.
    pub(crate) ddx: PathBuf,
    /// This program.
    pub(crate) own: PathBuf,
    /// iceoryx2 behind the arguments of `tests/bench/peers`; none when it is not built.
    peers: Option<PathBuf>,
}

/// A daemon without a network, for the local lines. Dropped, it is killed, and its directory removed.
pub(crate) struct Daemon {
    child: Child,
    dir: PathBuf,
}

impl Programs {
    /// Finds `ddx` beside this program, and builds the peers where `with_peers` asks for it.
    pub(crate) fn find(with_peers: bool) -> Result<Self> {
        let own = std::env::current_exe().context("finding this program")?;
        let target = own
            .ancestors()
            .nth(2)
            .context("this program lies in no target directory")?;
        let ddx = own.with_file_name("ddx");
        if !ddx.exists() {
            bail!(
                "`{}` is missing\nhint: cargo build --release --workspace",
                ddx.display()
            );
        }
        let peers_target = target.join("peers");
        let peers = peers_target.join("release/ddx-bench-peers");
        let manifest = Path::new(env!("CARGO_MANIFEST_DIR")).join("peers/Cargo.toml");
        if with_peers && let Err(error) = cargo(&manifest, &peers_target) {
            eprintln!(
                "!!!! NO PEER: iceoryx2 cannot be built here, its columns stay empty: {error:#}"
            );
        } else if !peers.exists() {
            eprintln!(
                "!!!! NO PEER: iceoryx2 is not built, its columns stay empty (a run without --smoke builds it)"
            );
        }
        Ok(Self {
            ddx,
            own,
            peers: Some(peers).filter(|path| path.exists()),
        })
    }

    /// Whether there is a peer to compare with.
    pub(crate) fn has_peer(&self) -> bool {
        self.peers.is_some()
    }

    /// The peer's program in a part.
    pub(crate) fn peer_command(&self, part: &str) -> Result<Command> {
        let mut command = Command::new(self.peers.as_ref().context("no peer is built")?);
        command.arg(part);
        Ok(command)
    }

    /// What the peer measured: the figures that it prints, one a line.
    pub(crate) fn peer<T: std::str::FromStr>(&self, arguments: &[&str]) -> Result<Vec<T>> {
        let peers = self.peers.as_ref().context("no peer is built")?;
        let output = Command::new(peers)
            .args(arguments)
            .output()
            .context("starting the peer")?;
        if !output.status.success() {
            bail!(
                "the peer failed at {arguments:?}: {}",
                String::from_utf8_lossy(&output.stderr)
            );
        }
        Ok(figures(&String::from_utf8_lossy(&output.stdout)))
    }
}

/// The figures among the lines of a program's output.
pub(crate) fn figures<T: std::str::FromStr>(output: &str) -> Vec<T> {
    output
        .lines()
        .filter_map(|line| line.parse().ok())
        .collect()
}

impl Daemon {
    /// Starts `ddx up` with a socket in a directory of its own.
    pub(crate) fn start(programs: &Programs) -> Result<Self> {
        let dir = std::env::temp_dir().join(format!("ddx-bench-{}", std::process::id()));
        std::fs::create_dir_all(&dir).with_context(|| format!("making `{}`", dir.display()))?;
        let child = Command::new(&programs.ddx)
            .args(["up", "--host", "bench", "--socket"])
            .arg(dir.join("ddx.sock"))
            .env("DDX_STATE_DIR", &dir)
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .spawn()
            .with_context(|| format!("starting `{}`", programs.ddx.display()))?;
        Ok(Self { child, dir })
    }

    /// Its socket.
    pub(crate) fn socket(&self) -> PathBuf {
        self.dir.join("ddx.sock")
    }

    /// A connection to it.
    pub(crate) fn store(&self) -> Result<Store> {
        Store::options()
            .socket(self.socket())
            .open()
            .context("opening the store")
    }

    /// Its process.
    pub(crate) fn pid(&self) -> u32 {
        self.child.id()
    }
}

impl Drop for Daemon {
    fn drop(&mut self) {
        // A daemon that is gone already needs no kill, and a directory that cannot be removed is the system's to clear.
        self.child.kill().ok();
        self.child.wait().ok();
        std::fs::remove_dir_all(&self.dir).ok();
    }
}

fn cargo(manifest: &Path, target: &Path) -> Result<()> {
    let mut command = Command::new(std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into()));
    command
        .args([
            "build",
            "--release",
            "--locked",
            "--quiet",
            "--manifest-path",
        ])
        .arg(manifest);
    command.arg("--target-dir").arg(target);
    let status = command.status().context("starting cargo")?;
    if !status.success() {
        bail!("`{command:?}` ended with {status}");
    }
    Ok(())
}
