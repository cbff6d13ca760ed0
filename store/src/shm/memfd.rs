//! Sealed anonymous files as memory, and sleeping on words in them.

use std::ffi::CStr;
use std::os::fd::{AsRawFd, FromRawFd, OwnedFd};
use std::ptr::NonNull;
use std::time::Duration;

use super::{Backing, Map, ShmError, fork, os_error};
use crate::layout::LINE;

/// Seals of a data file: its size is fixed, and only the mapping made before sealing can write it.
pub const DATA_SEALS: i32 =
    libc::F_SEAL_SHRINK | libc::F_SEAL_GROW | libc::F_SEAL_FUTURE_WRITE | libc::F_SEAL_SEAL;
/// Seals of a file that all who hold it may write: its size is fixed.
pub const CTL_SEALS: i32 = libc::F_SEAL_SHRINK | libc::F_SEAL_GROW | libc::F_SEAL_SEAL;

/// Bytes of a daemon's lock: a page.
pub const LOCK_LEN: usize = 4096;

/// What a mapping allows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Access {
    /// Loads only; a store is a fault.
    ReadOnly,
    /// Loads and stores.
    ReadWrite,
}

/// Makes a file of `len` zero bytes, a positive multiple of [`LINE`], and maps it for writing. Pages are taken as
/// they are touched. `name` shows in `/proc` only.
pub fn create(name: &CStr, len: usize) -> Result<(Map, OwnedFd), ShmError> {
    let flags = libc::MFD_CLOEXEC | libc::MFD_ALLOW_SEALING;
    // SAFETY: `name` is a terminated string that lives through the call.
    let fd = unsafe { libc::memfd_create(name.as_ptr(), flags) };
    if fd < 0 {
        return Err(os_error("create a memfd"));
    }
    // SAFETY: the descriptor is new and belongs to nobody else.
    let fd = unsafe { OwnedFd::from_raw_fd(fd) };
    let size = libc::off_t::try_from(len).map_err(|_| ShmError::Size {
        what: "new",
        found: len,
    })?;
    // SAFETY: the descriptor is open, and nothing maps it yet.
    if unsafe { libc::ftruncate(fd.as_raw_fd(), size) } != 0 {
        return Err(os_error("size a memfd"));
    }
    let map = map_file(&fd, len, Access::ReadWrite)?;
    Ok((map, fd))
}

/// Adds seals, which nobody can take away again.
pub fn seal(fd: &OwnedFd, seals: i32) -> Result<(), ShmError> {
    // SAFETY: the descriptor is open; the call reads an integer.
    if unsafe { libc::fcntl(fd.as_raw_fd(), libc::F_ADD_SEALS, seals) } != 0 {
        return Err(os_error("seal a memfd"));
    }
    Ok(())
}

/// Maps a file that another process has made. Refuses one without `needed` seals, which keep it from changing size
/// under the mapping, and one whose size cannot be that of a segment. `what` names it in errors.
pub fn map(fd: &OwnedFd, what: &'static str, needed: i32, access: Access) -> Result<Map, ShmError> {
    // SAFETY: the descriptor is open; the call takes no pointer.
    let found = unsafe { libc::fcntl(fd.as_raw_fd(), libc::F_GET_SEALS) };
    if found < 0 || found & needed != needed {
        return Err(ShmError::Seals {
            what,
            found,
            needed,
        });
    }
    // Asked only after the seals, which hold the size still.
    let len = file_size(fd)?;
    if len == 0 || !len.is_multiple_of(LINE) {
        return Err(ShmError::Size { what, found: len });
    }
    map_file(fd, len, access)
}

/// Maps the first page of a daemon's lock, read-only. It cannot be sealed, having a name: this trusts the daemon, who
/// alone may write it, never to shrink it.
pub fn map_lock(fd: &OwnedFd) -> Result<Map, ShmError> {
    let found = file_size(fd)?;
    if found < LOCK_LEN {
        return Err(ShmError::Size {
            what: "lock",
            found,
        });
    }
    map_file(fd, LOCK_LEN, Access::ReadOnly)
}

fn file_size(fd: &OwnedFd) -> Result<usize, ShmError> {
    // SAFETY: `stat` is plain integers, for which zeros are valid.
    let mut stat: libc::stat = unsafe { std::mem::zeroed() };
    // SAFETY: the descriptor is open, and `stat` is valid for writing.
    if unsafe { libc::fstat(fd.as_raw_fd(), &raw mut stat) } != 0 {
        return Err(os_error("stat a segment"));
    }
    Ok(usize::try_from(stat.st_size).unwrap_or(0))
}

fn map_file(fd: &OwnedFd, len: usize, access: Access) -> Result<Map, ShmError> {
    let protection = match access {
        Access::ReadOnly => libc::PROT_READ,
        Access::ReadWrite => libc::PROT_READ | libc::PROT_WRITE,
    };
    // SAFETY: a new mapping at an address of the kernel's choice; the descriptor is open, and the file has `len` bytes.
    let base = unsafe {
        libc::mmap(
            std::ptr::null_mut(),
            len,
            protection,
            libc::MAP_SHARED,
            fd.as_raw_fd(),
            0,
        )
    };
    let Some(base) = NonNull::new(base.cast::<u8>()).filter(|_| base != libc::MAP_FAILED) else {
        return Err(os_error("map a segment"));
    };
    let map = Map {
        base,
        len,
        backing: Backing::Memfd {
            generation: fork::generation(),
        },
    };
    // SAFETY: the range is the mapping made above.
    if unsafe { libc::madvise(base.as_ptr().cast(), len, libc::MADV_DONTFORK) } != 0 {
        return Err(os_error("keep a segment from forked children"));
    }
    Ok(map)
}

pub(super) fn unmap(base: NonNull<u8>, len: usize) {
    // SAFETY: `map_file` made this mapping in this process, and the map that owned it is being dropped.
    unsafe { libc::munmap(base.as_ptr().cast(), len) };
}

pub(super) fn futex_wait(word: *mut u32, seen: u32, timeout: Duration) {
    let wait = libc::timespec {
        tv_sec: libc::time_t::try_from(timeout.as_secs()).unwrap_or(libc::time_t::MAX),
        tv_nsec: libc::c_long::from(i32::try_from(timeout.subsec_nanos()).unwrap_or(0)),
    };
    // SAFETY: `word` is an aligned word inside a live map, and `wait` lives through the call. The outcome does not
    // matter: the caller looks for itself.
    unsafe {
        libc::syscall(
            libc::SYS_futex,
            word,
            libc::FUTEX_WAIT,
            seen,
            &raw const wait,
        )
    };
}

pub(super) fn futex_wake(word: *mut u32) {
    // SAFETY: `word` is an aligned word inside a live map; the kernel only uses its address.
    unsafe { libc::syscall(libc::SYS_futex, word, libc::FUTEX_WAKE, i32::MAX) };
}
