//! Descriptors that come as bare numbers, by calls that have no safe wrapper.
#![expect(unsafe_code, reason = "a bare number becomes an owned descriptor")]

use std::os::fd::{AsFd, AsRawFd, FromRawFd, OwnedFd, RawFd};

/// What the kernel says of the process at the other end of a socket.
#[derive(Debug)]
pub(crate) enum PeerProcess {
    /// A descriptor that becomes readable when the process ends.
    Watched(OwnedFd),
    /// It has ended already.
    Ended,
    /// Nothing: Linux can say it since 6.5, and while there are descriptors left.
    Unknown,
}

/// The process that made the connection. Unlike its pid, the answer never means a later process of the same number.
pub(crate) fn peer_process(socket: impl AsFd) -> PeerProcess {
    const LEN: libc::socklen_t = 4;
    const { assert!(size_of::<RawFd>() == 4, "LEN is the size of a descriptor") };
    let mut found: RawFd = -1;
    let mut len = LEN;
    // SAFETY: the socket is open; `found` has room for the `len` bytes that are announced, and both live through the
    // call.
    let failed = unsafe {
        libc::getsockopt(
            socket.as_fd().as_raw_fd(),
            libc::SOL_SOCKET,
            libc::SO_PEERPIDFD,
            (&raw mut found).cast(),
            &raw mut len,
        )
    };
    if failed == 0 && found >= 0 {
        // SAFETY: the call has made this descriptor, close-on-exec, for its caller alone.
        return PeerProcess::Watched(unsafe { OwnedFd::from_raw_fd(found) });
    }
    match std::io::Error::last_os_error().raw_os_error() {
        // Kernels say one or the other of a process that is gone.
        Some(libc::ESRCH | libc::EINVAL) => PeerProcess::Ended,
        Some(_) | None => PeerProcess::Unknown,
    }
}
