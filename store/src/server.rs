//! The daemon's side of the store: it grants names and cells, hands segments over, and clears up after the dead.
//!
//! ```text
//! programs --- socket ---+
//! Handle::connect -------+--- Server::run (a thread of the caller) --- Registry (pure)
//! Handle, commands ------+            |
//!                                     +--- Handle::events: what other hosts should hear
//! ```
//!
//! Samples never pass through here.

pub mod registry;

mod orphan;
mod poll;
mod rundir;

use std::collections::BTreeMap;
use std::os::fd::OwnedFd;
use std::path::PathBuf;
use std::sync::mpsc::{self, Receiver, Sender, SyncSender};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use ddx_wire::{HostName, ItemName};
use rustix::event::EventfdFlags;

pub use self::orphan::{Keep, Orphan};
use self::poll::Peer;
use self::registry::{ClientId, Identity, Registry};
pub use self::registry::{Counters, Event, RemoteItem};
use self::rundir::Claim;
pub use self::rundir::{run_dir, socket_path};
use crate::connection::Connection;
use crate::control::Refusal;
pub use crate::descriptor::passed_files;
use crate::error::Error;
use crate::notify::Bells;
use crate::quota::Quotas;
use crate::{Store, socket};

/// What a daemon serves, and where.
#[derive(Clone, Debug)]
pub struct Config {
    /// The socket; none serves [`Handle::connect`] alone.
    pub socket: Option<PathBuf>,
    /// Name of this host: the prefix of its items.
    pub host: HostName,
    /// Number of the domain.
    pub domain: u16,
    /// Number of this life of the daemon, larger than all before: the upper half of its epochs.
    pub ordinal: u32,
    /// Limits on each client.
    pub quotas: Quotas,
}

/// The daemon's side of one host and domain. Does nothing unless [`Server::run`] runs.
#[derive(Debug)]
pub struct Server {
    /// Held for its lock.
    _claim: Option<Claim>,
    listener: Option<OwnedFd>,
    registry: Registry,
    peers: BTreeMap<ClientId, Peer>,
    commands: Receiver<Command>,
    handle: Handle,
    events: Option<SyncSender<Event>>,
    keeper: Option<SyncSender<Keep>>,
    /// Events that found the channel full; programs wait until it has taken them. At most those of one turn, and of what
    /// the daemon itself does meanwhile.
    held_back: Vec<Event>,
    accept_pause: bool,
}

/// What other threads use to talk to a running [`Server`].
#[derive(Clone, Debug)]
pub struct Handle {
    /// Grows by what waits for an answer, and by one [`Command::Show`] for each half of `shown`.
    commands: Sender<Command>,
    shown: Arc<Mutex<Shown>>,
    wake: Arc<OwnedFd>,
}

/// What listings show, where the server has not taken it yet: a later one takes the place of an earlier one, so that they
/// do not pile up before a server that is slower.
#[derive(Debug, Default)]
struct Shown {
    remote: Option<Vec<RemoteItem>>,
    notes: Option<BTreeMap<ItemName, String>>,
}

/// What a [`Handle`] asks of its server.
#[derive(Debug)]
enum Command {
    Adopt { socket: OwnedFd, privileged: bool },
    Show,
    Subscribe(SyncSender<Event>),
    Counters(SyncSender<Counters>),
}

impl Config {
    /// A host named `host` in domain 0 without a socket, in its first life, with the default limits.
    pub fn new(host: HostName) -> Self {
        Self {
            socket: None,
            host,
            domain: 0,
            ordinal: 1,
            quotas: Quotas::default(),
        }
    }
}

impl Server {
    /// Claims the socket, taking over one that a dead daemon has left. Fails when a living one serves it, and names
    /// that one's process.
    pub fn bind(config: Config) -> Result<Self, Error> {
        let claim = config.socket.as_deref().map(Claim::take).transpose()?;
        let listener = claim.as_ref().map(Claim::listen).transpose()?;
        let (bells, bells_fd) = Bells::create().map_err(|e| Error::Segment(e.to_string()))?;
        let identity = Identity {
            host: config.host,
            domain: config.domain,
            ordinal: config.ordinal,
            quotas: config.quotas,
        };
        let (sender, commands) = mpsc::channel();
        let flags = EventfdFlags::CLOEXEC | EventfdFlags::NONBLOCK;
        let wake = rustix::event::eventfd(0, flags).map_err(Error::os("make an event counter"))?;
        Ok(Self {
            _claim: claim,
            listener,
            registry: Registry::new(identity, Arc::new(bells), Arc::new(bells_fd)),
            peers: BTreeMap::new(),
            commands,
            handle: Handle {
                commands: sender,
                shown: Arc::default(),
                wake: Arc::new(wake),
            },
            events: None,
            keeper: None,
            held_back: Vec::new(),
            accept_pause: false,
        })
    }

    /// What other threads talk to this server by.
    pub fn handle(&self) -> Handle {
        self.handle.clone()
    }

    /// Tells of the items that no program writes, from now on, so that somebody keeps them while there is no daemon. What
    /// the channel has no room for is not kept.
    pub fn keep_orphans(&mut self, keeper: SyncSender<Keep>) {
        self.keeper = Some(keeper);
    }

    /// The items of this host that no program writes, for the next server.
    pub fn orphans(&self) -> Vec<Orphan> {
        self.registry.orphans()
    }

    /// Takes an item back that a former server left, before anybody is served. Its readers and its writer, should there
    /// be one, come back to it by themselves.
    pub fn restore(&mut self, orphan: Orphan) -> Result<(), Refusal> {
        self.registry.restore(orphan)
    }

    /// A connection of this process that is greeted already, although nobody runs the server yet.
    pub(crate) fn adopt_own(&mut self) -> Result<Connection, Error> {
        let (ours, theirs) = socket::pair().map_err(Error::os("make a socket pair"))?;
        self.adopt(ours, None, false);
        Connection::over_pair(theirs, || self.turn(Duration::ZERO))
    }
}

impl Handle {
    /// Opens a store inside this process, which may write any name. Blocks until the server has answered, at most 5 s:
    /// not to be called on the thread that runs it.
    pub fn connect(&self) -> Result<Store, Error> {
        let (ours, theirs) = socket::pair().map_err(Error::os("make a socket pair"))?;
        self.command(Command::Adopt {
            socket: ours,
            privileged: true,
        })?;
        let connection = Connection::over_pair(theirs, || Ok(()))?;
        Ok(Store::over(connection))
    }

    /// Replaces what listings and descriptions show of other hosts.
    pub fn set_remote(&self, items: Vec<RemoteItem>) -> Result<(), Error> {
        let before = self.shown().remote.replace(items);
        self.show(before.is_some())
    }

    /// Replaces what descriptions say of each item's way here.
    pub fn set_notes(&self, notes: BTreeMap<ItemName, String>) -> Result<(), Error> {
        let before = self.shown().notes.replace(notes);
        self.show(before.is_some())
    }

    /// What happens from now on. The channel holds 1,024 events; while it is full, programs wait, but stores that were opened
    /// by [`Handle::connect`] are answered. A later call takes the place of an earlier one.
    pub fn events(&self) -> Result<Receiver<Event>, Error> {
        let (sender, receiver) = mpsc::sync_channel(EVENTS);
        self.command(Command::Subscribe(sender))?;
        Ok(receiver)
    }

    /// What went wrong so far. Blocks until the server has answered.
    pub fn counters(&self) -> Result<Counters, Error> {
        let (sender, receiver) = mpsc::sync_channel(1);
        self.command(Command::Counters(sender))?;
        receiver.recv().map_err(|_| Error::Gone)
    }

    /// Makes [`Server::run`] look at its `stop` flag now.
    pub fn wake(&self) {
        // Fails only when the counter is full: then the server is woken anyway.
        let _full = rustix::io::write(&self.wake, &1_u64.to_ne_bytes());
    }

    fn shown(&self) -> MutexGuard<'_, Shown> {
        // Each half is replaced whole, so a panic elsewhere leaves it sound.
        self.shown.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn take_shown(&self) -> Shown {
        std::mem::take(&mut *self.shown())
    }

    /// Has the server take what is shown, unless it was told and has not yet.
    fn show(&self, is_told: bool) -> Result<(), Error> {
        if is_told {
            return Ok(());
        }
        self.command(Command::Show)
    }

    fn command(&self, command: Command) -> Result<(), Error> {
        self.commands.send(command).map_err(|_| Error::Gone)?;
        self.wake();
        Ok(())
    }
}

/// Events that may wait for the daemon: enough for all items of a client that dies. One has 1 KiB and perhaps the text of a
/// schema, so that these are 65 MiB at worst.
const EVENTS: usize = 1024;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_shown_does_not_pile_up_before_a_server_that_is_slow() {
        let host = HostName::parse("h").unwrap();
        let mut server = Server::bind(Config::new(host)).unwrap();
        let handle = server.handle();
        for _ in 0..1_000 {
            handle.set_remote(Vec::new()).unwrap();
            handle.set_notes(BTreeMap::new()).unwrap();
        }
        assert_eq!(server.commands.try_iter().count(), 2);
        // The latest is taken, and then there is a next.
        let shown = server.handle.take_shown();
        assert!(shown.remote.is_some() && shown.notes.is_some());
        handle.set_remote(Vec::new()).unwrap();
        assert_eq!(server.commands.try_iter().count(), 1);
        server.turn(Duration::ZERO).unwrap();
    }
}
