//! The daemon's loop: sockets in, registry, sockets out. One thread, nothing in it blocks but `poll`.

use std::collections::VecDeque;
use std::os::fd::{AsFd, OwnedFd};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::TrySendError;
use std::time::Duration;

use rustix::event::{PollFd, PollFlags};
use tracing::{debug, warn};

use super::registry::{ClientId, Effect};
use super::{Command, Server, Shown};
use crate::clock;
use crate::control::{Notice, ToClient};
use crate::descriptor::{PeerProcess, peer_process};
use crate::error::Error;
use crate::socket::{self, Incoming};

/// Messages of one client before the others get their turn.
const TURN_MESSAGES: usize = 32;
/// Messages of a dead client that are still read: more than its socket holds, should a child that it left go on sending.
const LAST_MESSAGES: usize = 1024;
/// Connections taken in one turn.
const TURN_ACCEPTS: usize = 64;
/// Longest sleep: how late [`Server::run`] sees a `stop` that nobody woke it for.
const IDLE: Duration = Duration::from_millis(250);
/// Sleep while something outside must get better by itself: no descriptor left, or the daemon behind with events.
const PAUSE: Duration = Duration::from_millis(5);

/// Bytes that may wait for one client, beside the limit on their number.
const QUEUE_BYTES: usize = 4 << 20;

/// What there is to do.
struct Ready {
    sockets: Vec<(ClientId, PollFlags)>,
    /// Clients whose process has ended.
    dead: Vec<ClientId>,
}

/// One connection.
#[derive(Debug)]
pub(super) struct Peer {
    socket: Arc<OwnedFd>,
    /// Readable when the client's process has ended, although somebody that it left may hold the socket open. None for a
    /// client in this process, and where the kernel has none: then the end of the connection says so.
    process: Option<OwnedFd>,
    waiting: VecDeque<Outgoing>,
    waiting_bytes: usize,
    /// The daemon's own, which is answered also while the daemon is behind: else it might wait for itself.
    privileged: bool,
}

#[derive(Debug)]
struct Outgoing {
    bytes: Vec<u8>,
    fds: Vec<Arc<OwnedFd>>,
}

impl Server {
    /// Serves until `stop` is set; blocks. Setting it takes effect within 250 ms, or at once by
    /// [`super::Handle::wake`]. Fails only when the system cannot even wait.
    pub fn run(&mut self, stop: &AtomicBool) -> Result<(), Error> {
        while !stop.load(Ordering::Relaxed) {
            self.turn(IDLE)?;
        }
        Ok(())
    }

    /// Waits for something to do, at most `timeout`, and does it.
    pub(crate) fn turn(&mut self, timeout: Duration) -> Result<(), Error> {
        self.send_held_back();
        let is_behind = !self.held_back.is_empty();
        let timeout = match is_behind || self.accept_pause {
            true => timeout.min(PAUSE),
            false => timeout,
        };
        let ready = self.wait(timeout, is_behind)?;
        self.take_commands();
        if self.listener.is_some() && !is_behind {
            self.accept();
        }
        // The dead first: what the living ask for may be what those held.
        for client in ready.dead {
            self.read_last(client);
        }
        for (client, flags) in ready.sockets {
            if flags.contains(PollFlags::OUT) {
                self.flush(client);
            }
            if flags.intersects(PollFlags::IN | PollFlags::HUP | PollFlags::ERR) {
                self.read(client);
            }
        }
        self.apply();
        Ok(())
    }

    /// Takes a connection in. A client too many is told why and dropped.
    pub(super) fn adopt(&mut self, socket: OwnedFd, process: Option<OwnedFd>, privileged: bool) {
        let Ok(pid) = socket::peer_pid(&socket) else {
            return;
        };
        match self.registry.connect(pid, privileged, clock::now()) {
            Ok(client) => {
                let peer = Peer {
                    socket: Arc::new(socket),
                    process,
                    waiting: VecDeque::new(),
                    waiting_bytes: 0,
                    privileged,
                };
                self.peers.insert(client, peer);
            }
            Err(refusal) => {
                warn!(pid, %refusal, "client turned away");
                let notice = Notice::Closing(refusal);
                if let Ok(bytes) = (ToClient::Notice { handle: 0, notice }).encode() {
                    let _gone = socket::send(&socket, &bytes, &[]);
                }
            }
        }
    }

    fn wait(&self, timeout: Duration, is_behind: bool) -> Result<Ready, Error> {
        let mut fds = vec![PollFd::new(&*self.handle.wake, PollFlags::IN)];
        let listener = self.listener.as_ref().filter(|_| !self.accept_pause);
        fds.extend(listener.map(|listener| PollFd::new(listener, PollFlags::IN)));
        let first = fds.len();
        for peer in self.peers.values() {
            let mut flags = PollFlags::empty();
            flags.set(PollFlags::IN, !is_behind || peer.privileged);
            flags.set(PollFlags::OUT, !peer.waiting.is_empty());
            fds.push(PollFd::new(&*peer.socket, flags));
        }
        // After the sockets: a death that came before a message is seen with it.
        let mut watched = Vec::new();
        for (client, peer) in &self.peers {
            if let Some(process) = peer.process.as_ref().filter(|_| !is_behind) {
                fds.push(PollFd::new(process, PollFlags::IN));
                watched.push(*client);
            }
        }
        let polled = rustix::event::poll(&mut fds, Some(&socket::timespec(timeout)));
        match polled {
            Ok(_) | Err(rustix::io::Errno::INTR) => {}
            Err(e) => return Err(Error::os("wait for clients")(e)),
        }
        let mut count = [0; 8];
        // Fails when nobody has called, which is as good.
        let _none = rustix::io::read(&self.handle.wake, &mut count);
        let mut flags = fds.iter().skip(first).map(PollFd::revents);
        let sockets = self.peers.keys().copied().zip(flags.by_ref());
        let sockets = sockets.filter(|(_, flags)| !flags.is_empty()).collect();
        let dead = watched.into_iter().zip(flags);
        let dead = dead.filter(|(_, flags)| !flags.is_empty());
        Ok(Ready {
            sockets,
            dead: dead.map(|(client, _)| client).collect(),
        })
    }

    fn take_commands(&mut self) {
        while let Ok(command) = self.commands.try_recv() {
            match command {
                Command::Adopt { socket, privileged } => self.adopt(socket, None, privileged),
                Command::Show => {
                    let Shown { remote, notes } = self.handle.take_shown();
                    if let Some(items) = remote {
                        self.registry.set_remote(items);
                    }
                    if let Some(notes) = notes {
                        self.registry.set_notes(notes);
                    }
                }
                Command::Subscribe(events) => self.events = Some(events),
                Command::Counters(to) => {
                    let _gone = to.try_send(self.registry.counters());
                }
            }
        }
    }

    fn accept(&mut self) {
        self.accept_pause = false;
        for _ in 0..TURN_ACCEPTS {
            let Some(listener) = &self.listener else {
                return;
            };
            match socket::accept(listener) {
                Ok(Some(socket)) => match peer_process(&socket) {
                    PeerProcess::Watched(process) => self.adopt(socket, Some(process), false),
                    PeerProcess::Unknown => self.adopt(socket, None, false),
                    // It has been answered nothing, so it holds nothing.
                    PeerProcess::Ended => {}
                },
                Ok(None) => return,
                Err(error) => {
                    warn!(%error, "no connection accepted");
                    self.accept_pause = true;
                    return;
                }
            }
        }
    }

    fn read(&mut self, client: ClientId) {
        for _ in 0..TURN_MESSAGES {
            let Some(peer) = self.peers.get(&client) else {
                return;
            };
            let socket = Arc::clone(&peer.socket);
            match socket::receive(&socket) {
                Ok(Incoming::Message(bytes, fds)) => {
                    self.registry.handle(client, &bytes, fds, clock::now());
                }
                Ok(Incoming::TooLong) => self.registry.handle_oversized(client),
                Ok(Incoming::Empty) => return,
                Ok(Incoming::Closed) => return self.drop_peer(client),
                Err(error) => {
                    debug!(client = client.0, %error, "connection failed");
                    return self.drop_peer(client);
                }
            }
            self.apply();
        }
    }

    /// Takes what a client sent before its process ended, then drops it as if its connection had ended too.
    fn read_last(&mut self, client: ClientId) {
        for _ in 0..LAST_MESSAGES / TURN_MESSAGES {
            self.read(client);
        }
        if self.peers.contains_key(&client) {
            self.drop_peer(client);
        }
    }

    fn drop_peer(&mut self, client: ClientId) {
        self.peers.remove(&client);
        self.registry.disconnect(client);
        self.apply();
    }

    /// Does what the registry wants done.
    fn apply(&mut self) {
        while let Some(effect) = self.registry.poll_effect() {
            match effect {
                Effect::Send {
                    client,
                    message,
                    fds,
                } => self.queue(client, &message, fds),
                Effect::Disconnect { client } => {
                    self.flush(client);
                    self.peers.remove(&client);
                }
                Effect::Keep(keep) => {
                    if let Some(keeper) = &self.keeper
                        && let Err(TrySendError::Full(keep)) = keeper.try_send(keep)
                    {
                        warn!(%keep, "this is not told to whoever keeps it");
                        self.registry.count_unkept();
                    }
                }
                Effect::Event(event) => {
                    debug!(?event, "store");
                    if self.events.is_some() {
                        self.held_back.push(event);
                    }
                }
            }
        }
        self.send_held_back();
    }

    fn queue(&mut self, client: ClientId, message: &ToClient, fds: Vec<Arc<OwnedFd>>) {
        let Some(peer) = self.peers.get_mut(&client) else {
            return;
        };
        let bytes = match message.encode() {
            Ok(bytes) => bytes,
            Err(error) => {
                warn!(%error, "an answer cannot be encoded");
                return;
            }
        };
        peer.waiting_bytes += bytes.len();
        peer.waiting.push_back(Outgoing { bytes, fds });
        let max = self.registry.queue_limit();
        if peer.waiting.len() > max || peer.waiting_bytes > QUEUE_BYTES {
            warn!(
                client = client.0,
                max, "client does not collect its answers: cut off"
            );
            self.peers.remove(&client);
            self.registry.disconnect_overflowed(client);
            return;
        }
        self.flush(client);
    }

    /// Sends what the client's socket takes.
    fn flush(&mut self, client: ClientId) {
        let Some(peer) = self.peers.get_mut(&client) else {
            return;
        };
        while let Some(next) = peer.waiting.front() {
            let fds: Vec<_> = next.fds.iter().map(|fd| fd.as_fd()).collect();
            match socket::send(&peer.socket, &next.bytes, &fds) {
                Ok(true) => {
                    peer.waiting_bytes -= next.bytes.len();
                    peer.waiting.pop_front();
                }
                Ok(false) => return,
                // The reading side reports the death, and then everything is released.
                Err(_) => {
                    peer.waiting_bytes = 0;
                    return peer.waiting.clear();
                }
            }
        }
    }

    fn send_held_back(&mut self) {
        let Some(events) = &self.events else {
            self.held_back.clear();
            return;
        };
        let mut sent = 0;
        for event in &self.held_back {
            match events.try_send(event.clone()) {
                Ok(()) => sent += 1,
                Err(TrySendError::Full(_)) => break,
                Err(TrySendError::Disconnected(_)) => {
                    self.events = None;
                    self.held_back.clear();
                    return;
                }
            }
        }
        self.held_back.drain(..sent);
    }
}
