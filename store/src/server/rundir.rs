//! Where sockets lie, and who may serve one: `<run>/ddx/<domain>/<host>.sock`, with a lock beside it.

use std::fs::{self, File, OpenOptions, Permissions};
use std::io;
use std::os::fd::OwnedFd;
use std::os::unix::fs::{FileExt, OpenOptionsExt, PermissionsExt};
use std::path::{Path, PathBuf};

use ddx_wire::HostName;
use rustix::fs::{Access, FlockOperation};

use crate::error::Error;
use crate::life::{LIFE_OFFSET, LOCK_BYTES};
use crate::socket;

/// The right to serve one socket: held as long as its lock.
#[derive(Debug)]
pub(super) struct Claim {
    path: PathBuf,
    lock: File,
}

/// The directory of all domains: below `/run` where that can be written or has one, else below `$XDG_RUNTIME_DIR`.
pub fn run_dir() -> PathBuf {
    let system = PathBuf::from("/run/ddx");
    let is_ours = rustix::fs::access("/run", Access::WRITE_OK).is_ok() || system.is_dir();
    match std::env::var_os("XDG_RUNTIME_DIR") {
        Some(user) if !is_ours => Path::new(&user).join("ddx"),
        Some(_) | None => system,
    }
}

/// The socket of `host` in `domain`.
pub fn socket_path(host: &HostName, domain: u16) -> PathBuf {
    run_dir()
        .join(domain.to_string())
        .join(format!("{host}.sock"))
}

impl Claim {
    /// Takes the lock beside `path`. Fails when a living daemon holds it.
    pub(super) fn take(path: &Path) -> Result<Self, Error> {
        let shown = path.display();
        if let Some(dir) = path.parent() {
            fs::create_dir_all(dir).map_err(Error::os(format!(
                "make the directory `{}`; {ELSEWHERE}",
                dir.display()
            )))?;
        }
        let lock = OpenOptions::new()
            .read(true)
            .write(true)
            .create(true)
            .truncate(false)
            .mode(0o644)
            .open(path.with_extension("lock"))
            .map_err(Error::os(format!(
                "open the lock beside `{shown}`; {ELSEWHERE}"
            )))?;
        if rustix::fs::flock(&lock, FlockOperation::NonBlockingLockExclusive).is_err() {
            let mut holder = [0; HOLDER_BYTES];
            // Best effort: the message is clear without it.
            let _unread = lock.read_at(&mut holder, 0);
            return Err(Error::Served {
                path: path.to_owned(),
                holder: String::from_utf8_lossy(&holder)
                    .trim_matches(['\0', ' ', '\n'])
                    .to_owned(),
            });
        }
        let holder = format!("{:<1$}\n", std::process::id(), HOLDER_BYTES - 1);
        // Programs have it mapped: it grows, and never shrinks.
        lock.metadata()
            .and_then(|found| lock.set_len(found.len().max(LOCK_BYTES)))
            .and_then(|()| lock.write_all_at(holder.as_bytes(), 0))
            .map_err(Error::os(format!("write the lock beside `{shown}`")))?;
        Ok(Self {
            path: path.to_owned(),
            lock,
        })
    }

    /// Listens at the path, in place of what a dead daemon left there.
    pub(super) fn listen(&self) -> Result<OwnedFd, Error> {
        let listen = || {
            match fs::remove_file(&self.path) {
                Err(e) if e.kind() != io::ErrorKind::NotFound => return Err(e),
                Ok(()) | Err(_) => {}
            }
            let listener = socket::listen(&self.path)?;
            // Who may pass the directory may connect: programs run as other users than the daemon.
            fs::set_permissions(&self.path, Permissions::from_mode(0o666))?;
            self.count_life()?;
            Ok(listener)
        };
        listen().map_err(Error::os::<io::Error>(format!(
            "listen at `{}`",
            self.path.display()
        )))
    }
}

impl Claim {
    /// Shows all who have mapped the lock that there is a new daemon. Said last: who sees it can connect.
    fn count_life(&self) -> io::Result<()> {
        let mut life = [0; 8];
        self.lock.read_exact_at(&mut life, LIFE_OFFSET)?;
        let life = u64::from_le_bytes(life).wrapping_add(1);
        self.lock.write_all_at(&life.to_le_bytes(), LIFE_OFFSET)
    }
}

impl Drop for Claim {
    fn drop(&mut self) {
        // The lock stays: removing it would let two daemons hold different files of one name.
        let _gone = fs::remove_file(&self.path);
    }
}

/// What a person can do about a directory that cannot be written.
const ELSEWHERE: &str = "hint: choose another socket by --socket or DDX_SOCKET";

/// Bytes for the pid of the daemon, as text, at the start of the lock.
const HOLDER_BYTES: usize = 16;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_second_claim_is_refused_and_names_the_holder() {
        let dir = std::env::temp_dir().join(format!("ddx-claim-{}", std::process::id()));
        let path = dir.join("0/h.sock");
        let first = Claim::take(&path).unwrap();
        let listener = first.listen().unwrap();

        let refused = Claim::take(&path).unwrap_err().to_string();
        assert!(
            refused.contains(&std::process::id().to_string()),
            "{refused}"
        );

        drop((first, listener));
        assert!(!path.exists());
        let second = Claim::take(&path).unwrap();
        drop(second);
        fs::remove_dir_all(dir).unwrap();
    }

    #[test]
    fn a_stale_socket_is_taken_over() {
        let dir = std::env::temp_dir().join(format!("ddx-stale-{}", std::process::id()));
        let path = dir.join("h.sock");
        fs::create_dir_all(&dir).unwrap();
        drop(socket::listen(&path).unwrap());
        assert!(path.exists());

        let claim = Claim::take(&path).unwrap();
        let _listener = claim.listen().unwrap();
        assert!(socket::connect(&path).is_ok());

        drop(claim);
        fs::remove_dir_all(dir).unwrap();
    }
}
