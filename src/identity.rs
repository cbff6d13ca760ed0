//! Who this host is: a random id and the count of its lives, kept on disk.
//!
//! The file `<state>/<domain>/<host>.id` holds two lines, `id <32 hex digits>` and `ordinal <count>`, and is replaced
//! whole at each start. `<state>` is `DDX_STATE_DIR`, else `STATE_DIRECTORY` (systemd), else `/var/lib/ddx`, else
//! `$XDG_STATE_HOME/ddx` or `~/.local/state/ddx`: the first that can be written.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use ddx_wire::{HostId, HostName, Incarnation};
use ring::rand::{SecureRandom, SystemRandom};

/// Identity of one life of one host.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Identity {
    pub(crate) id: HostId,
    pub(crate) incarnation: Incarnation,
}

/// Random bytes from the operating system.
///
/// # Errors
/// Fails when the system has no entropy source.
pub(crate) fn random<const N: usize>() -> anyhow::Result<[u8; N]> {
    let mut bytes = [0; N];
    SystemRandom::new()
        .fill(&mut bytes)
        .map_err(|_unspecified| anyhow::anyhow!("the system gave no random bytes"))?;
    Ok(bytes)
}

impl Identity {
    /// Reads the identity and counts one more life, at least `ordinal_min`. Where nothing can be kept, the identity lasts for this life only,
    /// and a warning says so.
    pub(crate) fn take(host: &HostName, domain: u16, ordinal_min: u32) -> anyhow::Result<Self> {
        for dir in state_dirs() {
            let path = dir.join(domain.to_string()).join(format!("{host}.id"));
            match Self::take_from(&path, ordinal_min) {
                Ok(identity) => return Ok(identity),
                Err(error) => {
                    tracing::debug!(path = %path.display(), %error, "identity cannot be kept here");
                }
            }
        }
        tracing::warn!(%host, "no state directory can be written: this host's identity lasts until it stops");
        Self::fresh(ordinal_min)
    }

    fn take_from(path: &Path, ordinal_min: u32) -> anyhow::Result<Self> {
        let before = match fs::read_to_string(path) {
            Ok(text) => parse(&text),
            Err(e) if e.kind() == io::ErrorKind::NotFound => None,
            Err(e) => return Err(e.into()),
        };
        let fresh = Self::fresh(ordinal_min)?;
        let identity = before.map_or(fresh, |(id, ordinal)| {
            let ordinal = ordinal.saturating_add(1).max(ordinal_min);
            Self {
                id,
                incarnation: Incarnation {
                    ordinal,
                    ..fresh.incarnation
                },
            }
        });
        identity.keep(path)?;
        Ok(identity)
    }

    fn fresh(ordinal_min: u32) -> anyhow::Result<Self> {
        let random = u64::from_le_bytes(random()?);
        Ok(Self {
            id: HostId(self::random()?),
            incarnation: Incarnation {
                ordinal: ordinal_min.max(1),
                random,
            },
        })
    }

    /// Replaces the file by rename, so that a power cut leaves the old or the new one.
    fn keep(&self, path: &Path) -> io::Result<()> {
        if let Some(dir) = path.parent() {
            fs::create_dir_all(dir)?;
        }
        let draft = path.with_extension("id.new");
        fs::write(
            &draft,
            format!("id {}\nordinal {}\n", self.id, self.incarnation.ordinal),
        )?;
        fs::rename(draft, path)
    }
}

fn parse(text: &str) -> Option<(HostId, u32)> {
    let mut lines = text.lines();
    let id = HostId::parse(lines.next()?.strip_prefix("id ")?)?;
    let ordinal = lines.next()?.strip_prefix("ordinal ")?.parse().ok()?;
    Some((id, ordinal))
}

fn state_dirs() -> Vec<PathBuf> {
    let from = |variable: &str| {
        std::env::var_os(variable)
            .filter(|v| !v.is_empty())
            .map(PathBuf::from)
    };
    if let Some(dir) = from("DDX_STATE_DIR") {
        return vec![dir];
    }
    let home = from("HOME").map(|home| home.join(".local/state"));
    [
        from("STATE_DIRECTORY"),
        Some(PathBuf::from("/var/lib/ddx")),
        from("XDG_STATE_HOME").or(home).map(|dir| dir.join("ddx")),
    ]
    .into_iter()
    .flatten()
    .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Dir(PathBuf);

    impl Dir {
        fn new() -> Self {
            let name = u64::from_le_bytes(random().unwrap());
            Self(std::env::temp_dir().join(format!("ddx-identity-{name:016x}")))
        }
    }

    impl Drop for Dir {
        fn drop(&mut self) {
            fs::remove_dir_all(&self.0).unwrap();
        }
    }

    #[test]
    fn the_id_stays_and_lives_are_counted() {
        let dir = Dir::new();
        let path = dir.0.join("0/robot1.id");
        let first = Identity::take_from(&path, 0).unwrap();
        let second = Identity::take_from(&path, 0).unwrap();
        assert_eq!(first.id, second.id);
        assert_eq!(
            (first.incarnation.ordinal, second.incarnation.ordinal),
            (1, 2)
        );
        assert_ne!(first.incarnation.random, second.incarnation.random);
    }

    #[test]
    fn a_broken_file_gives_a_new_identity() {
        let dir = Dir::new();
        fs::create_dir_all(&dir.0).unwrap();
        let path = dir.0.join("x.id");
        fs::write(&path, "id nonsense\n").unwrap();
        assert_eq!(
            Identity::take_from(&path, 0).unwrap().incarnation.ordinal,
            1
        );
    }
}
