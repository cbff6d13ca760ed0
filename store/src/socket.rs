//! Datagrams with file descriptors over a SOCK_SEQPACKET socket. Nothing here blocks but [`wait_readable`].

use std::io::{self, IoSlice, IoSliceMut};
use std::mem::MaybeUninit;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::path::Path;
use std::time::Duration;

use rustix::event::{PollFd, PollFlags, Timespec};
use rustix::net::{
    AddressFamily, RecvAncillaryBuffer, RecvAncillaryMessage, RecvFlags, ReturnFlags,
    SendAncillaryBuffer, SendAncillaryMessage, SendFlags, SocketAddrUnix, SocketFlags, SocketType,
};

use crate::control::{FDS_MAX, MESSAGE_MAX_BYTES};

const FLAGS: SocketFlags = SocketFlags::CLOEXEC.union(SocketFlags::NONBLOCK);

/// What came out of a socket.
#[derive(Debug)]
pub(crate) enum Incoming {
    /// A message, with what was beside it.
    Message(Vec<u8>, Vec<OwnedFd>),
    /// Longer than any message, or with more descriptors than any has; it was dropped.
    TooLong,
    /// Nothing now.
    Empty,
    /// The other side is gone.
    Closed,
}

/// A listening socket at `path`, which must not exist.
pub(crate) fn listen(path: &Path) -> io::Result<OwnedFd> {
    let socket = new()?;
    rustix::net::bind(&socket, &SocketAddrUnix::new(path)?)?;
    rustix::net::listen(&socket, 1024)?;
    Ok(socket)
}

/// A connection to the daemon at `path`.
pub(crate) fn connect(path: &Path) -> io::Result<OwnedFd> {
    let socket = new()?;
    rustix::net::connect(&socket, &SocketAddrUnix::new(path)?)?;
    Ok(socket)
}

/// Two ends of one connection.
pub(crate) fn pair() -> io::Result<(OwnedFd, OwnedFd)> {
    let (a, b) = rustix::net::socketpair(AddressFamily::UNIX, SocketType::SEQPACKET, FLAGS, None)?;
    Ok((a, b))
}

/// The next connection that waits, if there is one.
pub(crate) fn accept(listener: impl AsFd) -> io::Result<Option<OwnedFd>> {
    match rustix::net::accept_with(listener, FLAGS) {
        Ok(socket) => Ok(Some(socket)),
        Err(rustix::io::Errno::AGAIN | rustix::io::Errno::CONNABORTED) => Ok(None),
        Err(e) => Err(e.into()),
    }
}

/// Process at the other end, by the kernel's word.
pub(crate) fn peer_pid(socket: impl AsFd) -> io::Result<u32> {
    let credentials = rustix::net::sockopt::socket_peercred(socket)?;
    Ok(u32::try_from(credentials.pid.as_raw_nonzero().get()).unwrap_or_default())
}

/// Sends one message; false when the socket is full.
pub(crate) fn send(socket: impl AsFd, bytes: &[u8], fds: &[BorrowedFd<'_>]) -> io::Result<bool> {
    let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(FDS_MAX))];
    let mut beside = SendAncillaryBuffer::new(&mut space);
    if !fds.is_empty() && !beside.push(SendAncillaryMessage::ScmRights(fds)) {
        return Err(io::ErrorKind::InvalidInput.into());
    }
    let flags = SendFlags::NOSIGNAL | SendFlags::DONTWAIT;
    match rustix::net::sendmsg(socket, &[IoSlice::new(bytes)], &mut beside, flags) {
        Ok(_) => Ok(true),
        Err(rustix::io::Errno::AGAIN) => Ok(false),
        Err(e) => Err(e.into()),
    }
}

/// Takes one message.
pub(crate) fn receive(socket: impl AsFd) -> io::Result<Incoming> {
    let mut bytes = vec![0; MESSAGE_MAX_BYTES];
    let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(FDS_MAX))];
    let mut beside = RecvAncillaryBuffer::new(&mut space);
    let flags = RecvFlags::DONTWAIT | RecvFlags::CMSG_CLOEXEC;
    let received = loop {
        match rustix::net::recvmsg(
            socket.as_fd(),
            &mut [IoSliceMut::new(&mut bytes)],
            &mut beside,
            flags,
        ) {
            Ok(received) => break received,
            Err(rustix::io::Errno::INTR) => {}
            Err(rustix::io::Errno::AGAIN) => return Ok(Incoming::Empty),
            Err(rustix::io::Errno::CONNRESET | rustix::io::Errno::PIPE) => {
                return Ok(Incoming::Closed);
            }
            Err(e) => return Err(e.into()),
        }
    };
    let mut fds = Vec::new();
    for message in beside.drain() {
        if let RecvAncillaryMessage::ScmRights(rights) = message {
            fds.extend(rights);
        }
    }
    if received
        .flags
        .intersects(ReturnFlags::TRUNC | ReturnFlags::CTRUNC)
    {
        return Ok(Incoming::TooLong);
    }
    if received.bytes == 0 {
        return Ok(Incoming::Closed);
    }
    bytes.truncate(received.bytes);
    Ok(Incoming::Message(bytes, fds))
}

/// Blocks until the socket has something to read or is closed, at most `timeout`; false when it has not.
pub(crate) fn wait_readable(socket: impl AsFd, timeout: Duration) -> io::Result<bool> {
    wait(socket, PollFlags::IN, timeout)
}

/// Blocks until the socket takes something or is closed, at most `timeout`; false when it does not.
pub(crate) fn wait_writable(socket: impl AsFd, timeout: Duration) -> io::Result<bool> {
    wait(socket, PollFlags::OUT, timeout)
}

fn wait(socket: impl AsFd, flags: PollFlags, timeout: Duration) -> io::Result<bool> {
    let mut fds = [PollFd::new(&socket, flags)];
    match rustix::event::poll(&mut fds, Some(&timespec(timeout))) {
        Ok(ready) => Ok(ready > 0),
        Err(rustix::io::Errno::INTR) => Ok(false),
        Err(e) => Err(e.into()),
    }
}

/// `span` as the system spells it.
pub(crate) fn timespec(span: Duration) -> Timespec {
    Timespec {
        tv_sec: i64::try_from(span.as_secs()).unwrap_or(i64::MAX),
        tv_nsec: i64::from(span.subsec_nanos()),
    }
}

fn new() -> io::Result<OwnedFd> {
    let socket = rustix::net::socket_with(AddressFamily::UNIX, SocketType::SEQPACKET, FLAGS, None)?;
    Ok(socket)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_message_arrives_whole_with_its_descriptors() {
        let (a, b) = pair().unwrap();
        let (passed, _other) = pair().unwrap();

        assert!(send(&a, b"one", &[passed.as_fd()]).unwrap());
        assert!(send(&a, b"two", &[]).unwrap());

        let Incoming::Message(bytes, fds) = receive(&b).unwrap() else {
            panic!("no message");
        };
        assert_eq!((bytes.as_slice(), fds.len()), (b"one".as_slice(), 1));
        assert!(
            matches!(receive(&b).unwrap(), Incoming::Message(m, f) if m == b"two" && f.is_empty())
        );
        assert!(matches!(receive(&b).unwrap(), Incoming::Empty));
        drop(a);
        assert!(matches!(receive(&b).unwrap(), Incoming::Closed));
    }

    #[test]
    fn too_many_bytes_or_descriptors_are_dropped() {
        let (a, b) = pair().unwrap();

        send(&a, &vec![0; MESSAGE_MAX_BYTES + 1], &[]).unwrap();
        assert!(matches!(receive(&b).unwrap(), Incoming::TooLong));
    }

    #[test]
    fn a_full_socket_says_so() {
        let (a, _b) = pair().unwrap();
        let message = vec![0; 4096];

        assert!((0..10_000).any(|_| !send(&a, &message, &[]).unwrap()));
    }
}
