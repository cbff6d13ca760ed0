//! Descriptors that come as bare numbers, by calls that have no safe wrapper.
#![expect(unsafe_code, reason = "a bare number becomes an owned descriptor")]

use std::env;
use std::os::fd::{AsFd, AsRawFd, FromRawFd, OwnedFd, RawFd};
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};

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

/// The files that a service manager has passed to this process, with their names (`LISTEN_FDS`). Whoever asks first gets
/// them.
pub fn passed_files() -> Vec<(String, OwnedFd)> {
    static TAKEN: AtomicBool = AtomicBool::new(false);
    const FIRST: RawFd = 3;
    if TAKEN.swap(true, Relaxed) {
        return Vec::new();
    }
    let is_ours = env::var("LISTEN_PID").is_ok_and(|pid| pid == std::process::id().to_string());
    let count = env::var("LISTEN_FDS").ok().filter(|_| is_ours);
    let count = count.and_then(|count| count.parse().ok()).unwrap_or(0);
    let names = env::var("LISTEN_FDNAMES").unwrap_or_default();
    (FIRST..)
        .zip(names.split(':'))
        .take(count)
        .filter_map(|(number, name)| Some((name.to_owned(), take_inherited(number)?)))
        .collect()
}

/// Owns a descriptor that this process was started with; none if the number is not open, or was opened since.
fn take_inherited(number: RawFd) -> Option<OwnedFd> {
    // SAFETY: takes no pointer; a number that is not open is an error.
    let flags = unsafe { libc::fcntl(number, libc::F_GETFD) };
    if flags < 0 || flags & libc::FD_CLOEXEC != 0 {
        return None;
    }
    // SAFETY: as above.
    if unsafe { libc::fcntl(number, libc::F_SETFD, flags | libc::FD_CLOEXEC) } != 0 {
        return None;
    }
    // SAFETY: the number is open. It came through `exec`, since everything that this program opens is close-on-exec; the
    // service manager says that it is for us; and `passed_files` gives each number once.
    Some(unsafe { OwnedFd::from_raw_fd(number) })
}
