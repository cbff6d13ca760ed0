//! The service manager: its notify protocol, in the datagrams of `sd_notify(3)`, and the files that it holds for us.

use std::io::{self, IoSlice};
use std::mem::MaybeUninit;
use std::os::fd::{AsFd as _, OwnedFd};
use std::os::linux::net::SocketAddrExt as _;
use std::os::unix::net::{SocketAddr, UnixDatagram};
use std::sync::Arc;
use std::time::Duration;

use anyhow::Context as _;
use rustix::net::{SendAncillaryBuffer, SendAncillaryMessage, SendFlags};

/// Files of one entry: what one item takes.
pub(crate) const FILES: usize = 3;

/// How long a manager that does not read may hold us up.
const PATIENCE: Duration = Duration::from_secs(5);

/// A way to the service manager that has started this process.
#[derive(Debug)]
pub(crate) struct Manager {
    socket: UnixDatagram,
}

impl Manager {
    /// The manager at `NOTIFY_SOCKET`; none without it.
    pub(crate) fn from_env() -> anyhow::Result<Option<Self>> {
        let Ok(path) = std::env::var("NOTIFY_SOCKET") else {
            return Ok(None);
        };
        let manager =
            Self::at(&path).with_context(|| format!("reach the service manager at `{path}`"))?;
        Ok(Some(manager))
    }

    /// The manager at a path, or at an abstract address that begins with `@`.
    fn at(path: &str) -> io::Result<Self> {
        let address = match path.strip_prefix('@') {
            Some(name) => SocketAddr::from_abstract_name(name)?,
            None => SocketAddr::from_pathname(path)?,
        };
        let socket = UnixDatagram::unbound()?;
        socket.connect_addr(&address)?;
        socket.set_write_timeout(Some(PATIENCE))?;
        Ok(Self { socket })
    }

    /// Says that this service serves.
    pub(crate) fn ready(&self) -> io::Result<()> {
        self.tell("READY=1", &[])
    }

    /// Has the manager hold files until they are released, and pass them to the next process of this service.
    pub(crate) fn hold(&self, name: &str, files: &[Arc<OwnedFd>; FILES]) -> io::Result<()> {
        self.tell(&format!("FDSTORE=1\nFDNAME={name}"), files)
    }

    /// Has the manager forget what it holds under a name.
    pub(crate) fn release(&self, name: &str) -> io::Result<()> {
        self.tell(&format!("FDSTOREREMOVE=1\nFDNAME={name}"), &[])
    }

    fn tell(&self, what: &str, files: &[Arc<OwnedFd>]) -> io::Result<()> {
        let fds: Vec<_> = files.iter().map(|file| file.as_fd()).collect();
        let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(FILES))];
        let mut beside = SendAncillaryBuffer::new(&mut space);
        if !fds.is_empty() && !beside.push(SendAncillaryMessage::ScmRights(&fds)) {
            return Err(io::ErrorKind::InvalidInput.into());
        }
        let what = [IoSlice::new(what.as_bytes())];
        rustix::net::sendmsg(&self.socket, &what, &mut beside, SendFlags::NOSIGNAL)?;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_service_manager_hears_ready_on_an_abstract_socket() {
        let name = format!("ddx-notify-{}", std::process::id());
        let address = SocketAddr::from_abstract_name(&name).unwrap();
        let manager = UnixDatagram::bind_addr(&address).unwrap();

        Manager::at(&format!("@{name}")).unwrap().ready().unwrap();

        let mut heard = [0; 16];
        let len = manager.recv(&mut heard).unwrap();
        assert_eq!(&heard[..len], b"READY=1");
    }
}
