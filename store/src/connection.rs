//! A program's connection to its daemon: requests and answers, notices for handles, and coming back after a restart.
//!
//! Nothing runs by itself: the socket is looked at by requests, by calls that block, and by handles that know from
//! shared memory that news wait there.

use std::collections::BTreeMap;
use std::io;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use ddx_wire::HostName;

use crate::control::{Binding, Notice, Refusal, Reply, Request, ToClient, ToDaemon, VERSION};
use crate::error::Error;
use crate::life::Life;
use crate::notify::Bells;
use crate::recovery::Registration;
use crate::segment::SegmentFds;
use crate::shm::fork;
use crate::socket::{self, Incoming};

/// How long a request waits for its answer, and an opening store for its daemon.
pub(crate) const TIMEOUT: Duration = Duration::from_secs(5);

/// One connection, shared by a store and all of its handles.
#[derive(Debug)]
pub(crate) struct Connection {
    /// Where to come back to; none for a socket pair.
    path: Option<PathBuf>,
    program: String,
    host: HostName,
    domain: u16,
    fork: u64,
    daemon: Option<Life>,
    /// Counts the daemons that this connection has had: handles look at it to learn of new bells.
    life: AtomicU64,
    /// Apart from the state: who only sleeps and wakes does not wait for somebody's request.
    bells: Mutex<(Arc<Bells>, u16)>,
    state: Mutex<State>,
}

#[derive(Debug)]
pub(crate) struct State {
    pub(crate) socket: Option<OwnedFd>,
    pub(crate) registrations: BTreeMap<u32, Registration>,
    serial: u32,
    last_handle: u32,
    pub(crate) retry_at: Instant,
    pub(crate) backoff: Duration,
}

/// What a handle is told without asking.
#[derive(Debug, Default)]
pub(crate) struct Mailbox {
    has_mail: AtomicBool,
    mail: Mutex<Option<Mail>>,
}

/// News for one handle.
#[derive(Debug)]
pub(crate) enum Mail {
    /// A place in a segment.
    Bound(Binding, SegmentFds),
    /// The item was removed.
    Removed,
    /// A daemon that was started anew does not know the item: what is mapped stays readable.
    Detached,
    /// The handle is of no use until further notice.
    Refused(Refusal),
}

/// The greeting's outcome.
struct Greeted {
    host: HostName,
    domain: u16,
    bell: u16,
    bells: Bells,
}

impl Connection {
    /// Connects to the daemon at `path`; a failed `connect` is reported as it is.
    pub(crate) fn open(path: &Path, program: &str) -> Result<Self, Error> {
        let daemon = Life::beside(path);
        let socket = socket::connect(path).map_err(|source| Error::NoDaemon {
            path: path.to_owned(),
            source,
        })?;
        let greeted = greet(&socket, program, || Ok(()))?;
        let connection = Self::new(Some(path.to_owned()), program, socket, greeted);
        Ok(Self {
            daemon,
            ..connection
        })
    }

    /// Talks over one end of a pair. `turn` lets a server in this thread answer.
    pub(crate) fn over_pair(
        socket: OwnedFd,
        turn: impl FnOnce() -> Result<(), Error>,
    ) -> Result<Self, Error> {
        let program = program_name();
        let greeted = greet(&socket, &program, turn)?;
        Ok(Self::new(None, &program, socket, greeted))
    }

    fn new(path: Option<PathBuf>, program: &str, socket: OwnedFd, greeted: Greeted) -> Self {
        Self {
            path,
            program: program.to_owned(),
            host: greeted.host,
            domain: greeted.domain,
            fork: fork::generation(),
            daemon: None,
            life: AtomicU64::new(1),
            bells: Mutex::new((Arc::new(greeted.bells), greeted.bell)),
            state: Mutex::new(State {
                socket: Some(socket),
                registrations: BTreeMap::new(),
                serial: 0,
                last_handle: 0,
                retry_at: Instant::now(),
                backoff: Duration::ZERO,
            }),
        }
    }

    pub(crate) fn host(&self) -> &HostName {
        &self.host
    }

    pub(crate) fn domain(&self) -> u16 {
        self.domain
    }

    pub(crate) fn path(&self) -> Option<&Path> {
        self.path.as_deref()
    }

    /// Counts this connection's daemons, from 1. A change means new bells.
    #[inline]
    pub(crate) fn life(&self) -> u64 {
        self.life.load(Ordering::Acquire)
    }

    /// The bells, and which of them is ours.
    pub(crate) fn bell(&self) -> (Arc<Bells>, u16) {
        let bells = self.bells.lock().unwrap_or_else(PoisonError::into_inner);
        (Arc::clone(&bells.0), bells.1)
    }

    /// A number for a new handle.
    pub(crate) fn new_handle(&self) -> u32 {
        let mut state = self.lock();
        state.last_handle = state.last_handle.wrapping_add(1);
        state.last_handle
    }

    /// Keeps what a new daemon must be told of a handle, and where its news go.
    pub(crate) fn register(&self, handle: u32, registration: Registration) {
        self.lock().registrations.insert(handle, registration);
    }

    /// Asks the daemon; blocks until it answers, at most 5 s. Comes back to a daemon that was started anew.
    pub(crate) fn request(
        &self,
        request: Request,
        fds: &[BorrowedFd<'_>],
    ) -> Result<(Reply, Vec<OwnedFd>), Error> {
        self.check_fork()?;
        let deadline = Instant::now() + TIMEOUT;
        let mut state = self.lock();
        while state.socket.is_none() {
            self.reconnect(&mut state);
            if state.socket.is_none() {
                if self.path.is_none() || Instant::now() >= deadline {
                    return Err(Error::Gone);
                }
                std::thread::sleep(BACKOFF_MIN);
            }
        }
        state.ask(request, fds, deadline)
    }

    /// Gives a handle back, without waiting for the daemon's word.
    pub(crate) fn close(&self, handle: u32) {
        if self.check_fork().is_err() {
            return;
        }
        let mut state = self.lock();
        state.registrations.remove(&handle);
        let serial = state.next_serial();
        let message = ToDaemon {
            serial,
            request: Request::Close { handle },
        };
        if let (Some(socket), Ok(bytes)) = (&state.socket, message.encode()) {
            // A full socket or a dead daemon: the latter has nothing to give back, the former gets a moment.
            if let Ok(false) = socket::send(socket, &bytes, &[]) {
                let _ready = socket::wait_writable(socket, TIMEOUT);
                let _sent = socket::send(socket, &bytes, &[]);
            }
        }
    }

    /// Hands out what waits in the socket, without blocking.
    pub(crate) fn drain(&self) -> Result<(), Error> {
        self.check_fork()?;
        // Whoever holds the lock is at the socket already.
        if let Ok(mut state) = self.state.try_lock() {
            state.drain();
        }
        Ok(())
    }

    /// Hands out what waits, and comes back to the daemon if it was away: once between two sleeps of a blocking call.
    pub(crate) fn tend(&self) -> Result<(), Error> {
        self.check_fork()?;
        if let Ok(mut state) = self.state.try_lock() {
            state.drain();
            if state.socket.is_none() {
                self.reconnect(&mut state);
            }
        }
        Ok(())
    }

    /// Comes back to a daemon that was started anew, which costs one load as long as there is none.
    #[inline]
    pub(crate) fn follow(&self) -> Result<(), Error> {
        self.check_fork()?;
        match &self.daemon {
            Some(daemon) if daemon.has_changed() => self.tend(),
            Some(_) | None => Ok(()),
        }
    }

    #[inline]
    pub(crate) fn check_fork(&self) -> Result<(), Error> {
        if fork::is_past(self.fork) {
            Err(Error::Forked)
        } else {
            Ok(())
        }
    }

    /// One attempt to come back, unless the last one is too fresh. A pair that is gone stays so.
    fn reconnect(&self, state: &mut State) {
        let Some(path) = &self.path else {
            return;
        };
        if Instant::now() < state.retry_at {
            return;
        }
        let count = self.daemon.as_ref().map(Life::count);
        let attempt = socket::connect(path)
            .map_err(Error::os("connect"))
            .and_then(|socket| {
                let greeted = greet(&socket, &self.program, || Ok(()))?;
                Ok((socket, greeted))
            });
        let Ok((socket, greeted)) = attempt else {
            state.backoff = (state.backoff * 2).clamp(BACKOFF_MIN, BACKOFF_MAX);
            state.retry_at = Instant::now() + state.backoff;
            return;
        };
        if let Some((daemon, count)) = self.daemon.as_ref().zip(count) {
            daemon.note(count);
        }
        state.backoff = Duration::ZERO;
        state.socket = Some(socket);
        *self.bells.lock().unwrap_or_else(PoisonError::into_inner) =
            (Arc::new(greeted.bells), greeted.bell);
        state.register_anew();
        // Release: pairs with the Acquire in `life`: who sees the new life finds the new bells.
        self.life.fetch_add(1, Ordering::Release);
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        // The state is whole between statements: a panic elsewhere does not spoil it.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl State {
    /// Sends one request and waits for its answer; notices that come first are handed out.
    pub(crate) fn ask(
        &mut self,
        request: Request,
        fds: &[BorrowedFd<'_>],
        deadline: Instant,
    ) -> Result<(Reply, Vec<OwnedFd>), Error> {
        let serial = self.next_serial();
        let bytes = ToDaemon { serial, request }
            .encode()
            .map_err(|e| Error::Protocol(e.to_string()))?;
        let socket = self.socket.as_ref().ok_or(Error::Gone)?;
        match send_before(socket, &bytes, fds, deadline) {
            Ok(()) => {}
            Err(error) => {
                self.drain();
                self.socket = None;
                return Err(error);
            }
        }
        loop {
            let socket = self.socket.as_ref().ok_or(Error::Gone)?;
            let Some((message, fds)) = receive_before(socket, deadline)? else {
                self.socket = None;
                return Err(Error::Gone);
            };
            match message {
                ToClient::Reply { serial: of, reply } if of == serial => {
                    if let Reply::Refused(refusal) = reply {
                        return Err(refusal.into());
                    }
                    return Ok((reply, fds));
                }
                // The answer to a request that nobody waits for any more.
                ToClient::Reply { .. } => {}
                ToClient::Notice {
                    notice: Notice::Closing(refusal),
                    ..
                } => {
                    self.socket = None;
                    return Err(refusal.into());
                }
                ToClient::Notice { handle, notice } => self.deliver(handle, notice, fds),
            }
        }
    }

    /// Hands out all notices that have arrived.
    pub(crate) fn drain(&mut self) {
        while let Some(socket) = &self.socket {
            match socket::receive(socket) {
                Ok(Incoming::Message(bytes, fds)) => match ToClient::decode(&bytes) {
                    Ok(ToClient::Notice {
                        notice: Notice::Closing(_),
                        ..
                    })
                    | Err(_) => {
                        self.socket = None;
                    }
                    Ok(ToClient::Notice { handle, notice }) => self.deliver(handle, notice, fds),
                    Ok(ToClient::Reply { .. }) => {}
                },
                Ok(Incoming::Empty) => return,
                Ok(Incoming::TooLong | Incoming::Closed) | Err(_) => self.socket = None,
            }
        }
    }

    fn deliver(&mut self, handle: u32, notice: Notice, fds: Vec<OwnedFd>) {
        let Some(registration) = self.registrations.get_mut(&handle) else {
            return;
        };
        let mail = match notice {
            Notice::Bound(binding) => match segment_fds(fds) {
                Some(fds) => {
                    registration.note_binding(&binding);
                    Mail::Bound(binding, fds)
                }
                None => return,
            },
            Notice::Removed => Mail::Removed,
            Notice::Refused(refusal) => Mail::Refused(refusal),
            Notice::Closing(_) => return,
        };
        registration.mailbox().put(mail);
    }

    fn next_serial(&mut self) -> u32 {
        self.serial = self.serial.wrapping_add(1);
        self.serial
    }
}

impl Mailbox {
    /// Whether there is news: one load.
    #[inline]
    pub(crate) fn has_mail(&self) -> bool {
        self.has_mail.load(Ordering::Acquire)
    }

    /// Replaces what was there: only the last word counts.
    pub(crate) fn put(&self, mail: Mail) {
        let mut last = self.mail.lock().unwrap_or_else(PoisonError::into_inner);
        *last = Some(mail);
        self.has_mail.store(true, Ordering::Release);
    }

    pub(crate) fn take(&self) -> Option<Mail> {
        if !self.has_mail() {
            return None;
        }
        let mut last = self.mail.lock().unwrap_or_else(PoisonError::into_inner);
        self.has_mail.store(false, Ordering::Release);
        last.take()
    }
}

/// A segment's two descriptors, if these are two.
pub(crate) fn segment_fds(fds: Vec<OwnedFd>) -> Option<SegmentFds> {
    let [data, ctl] = <[OwnedFd; 2]>::try_from(fds).ok()?;
    Some(SegmentFds { data, ctl })
}

/// The name of this program, for people.
pub(crate) fn program_name() -> String {
    let path = std::env::args_os().next().map(PathBuf::from);
    path.as_deref().and_then(Path::file_name).map_or_else(
        || "?".to_owned(),
        |name| name.to_string_lossy().into_owned(),
    )
}

fn greet(
    socket: &OwnedFd,
    program: &str,
    turn: impl FnOnce() -> Result<(), Error>,
) -> Result<Greeted, Error> {
    let deadline = Instant::now() + TIMEOUT;
    let hello = ToDaemon {
        serial: 0,
        request: Request::Hello {
            version: VERSION,
            program: program.to_owned(),
        },
    };
    let bytes = hello.encode().map_err(|e| Error::Protocol(e.to_string()))?;
    send_before(socket, &bytes, &[], deadline)?;
    turn()?;
    let (message, fds) = receive_before(socket, deadline)?.ok_or(Error::Gone)?;
    match message {
        ToClient::Reply {
            reply: Reply::Hello { host, domain, bell },
            ..
        } => {
            let fd = fds
                .first()
                .ok_or_else(|| Error::Protocol("a greeting without bells".to_owned()))?;
            let bells = Bells::map(fd).map_err(|e| Error::Segment(e.to_string()))?;
            Ok(Greeted {
                host,
                domain,
                bell,
                bells,
            })
        }
        ToClient::Reply {
            reply: Reply::Refused(refusal),
            ..
        }
        | ToClient::Notice {
            notice: Notice::Closing(refusal),
            ..
        } => Err(refusal.into()),
        other @ (ToClient::Reply { .. } | ToClient::Notice { .. }) => {
            Err(Error::Protocol(format!("{other:?} as a greeting")))
        }
    }
}

fn send_before(
    socket: &OwnedFd,
    bytes: &[u8],
    fds: &[BorrowedFd<'_>],
    deadline: Instant,
) -> Result<(), Error> {
    loop {
        match socket::send(socket, bytes, fds) {
            Ok(true) => return Ok(()),
            Ok(false) => {
                let left = deadline.saturating_duration_since(Instant::now());
                if left.is_zero() {
                    return Err(timed_out());
                }
                socket::wait_writable(socket.as_fd(), left)
                    .map_err(Error::os("wait for the daemon"))?;
            }
            Err(e) if e.kind() == io::ErrorKind::InvalidInput => {
                return Err(Error::os("send to the daemon")(e));
            }
            Err(_) => return Err(Error::Gone),
        }
    }
}

/// The next message; none when the daemon has closed the connection.
fn receive_before(
    socket: &OwnedFd,
    deadline: Instant,
) -> Result<Option<(ToClient, Vec<OwnedFd>)>, Error> {
    loop {
        match socket::receive(socket) {
            Ok(Incoming::Message(bytes, fds)) => {
                let message =
                    ToClient::decode(&bytes).map_err(|e| Error::Protocol(e.to_string()))?;
                return Ok(Some((message, fds)));
            }
            Ok(Incoming::TooLong) => {
                return Err(Error::Protocol("a message that is too long".to_owned()));
            }
            Ok(Incoming::Closed) => return Ok(None),
            Ok(Incoming::Empty) => {
                let left = deadline.saturating_duration_since(Instant::now());
                if left.is_zero() {
                    return Err(timed_out());
                }
                socket::wait_readable(socket.as_fd(), left)
                    .map_err(Error::os("wait for the daemon"))?;
            }
            Err(e) => return Err(Error::os("read from the daemon")(e)),
        }
    }
}

fn timed_out() -> Error {
    Error::Timeout(u64::try_from(TIMEOUT.as_millis()).unwrap_or(u64::MAX))
}

const BACKOFF_MIN: Duration = Duration::from_millis(10);
const BACKOFF_MAX: Duration = Duration::from_secs(1);
