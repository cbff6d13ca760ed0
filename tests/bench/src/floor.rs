//! What no design can beat: a value behind a sequence counter in shared memory, and one futex.

use std::fs::OpenOptions;
use std::os::fd::{AsFd, BorrowedFd};
use std::path::Path;
use std::ptr::{self, NonNull};
use std::sync::atomic::{AtomicU32, AtomicU64, Ordering, fence};

use anyhow::{Context, Result};
use rustix::fs::{MemfdFlags, ftruncate, memfd_create};
use rustix::io::Errno;
use rustix::mm::{MapFlags, ProtFlags, mmap};
use rustix::thread::futex;

use crate::pair::{Send64, Take64};

/// Words of a value of 64 bytes.
pub(crate) const WORDS: usize = 8;

/// A value of 64 bytes in shared memory, with its sequence counter and its futex.
#[derive(Debug)]
#[repr(C, align(128))]
struct Cell {
    /// Odd while the value is written; also the word that readers sleep on.
    seq: AtomicU32,
    waiting: AtomicU32,
    words: [AtomicU64; WORDS],
}

/// A mapped [`Cell`], mapped as long as the process lives.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Shared {
    cell: &'static Cell,
}

/// The only writer of a cell.
#[derive(Debug)]
pub(crate) struct FloorWriter(pub(crate) Shared);

/// A reader of a cell.
#[derive(Debug)]
pub(crate) struct FloorReader {
    shared: Shared,
    seen: u32,
    blocks: bool,
}

/// A copy of 64 bytes into one of eight slots, and two full fences: what a write needs at least.
#[derive(Debug, Default)]
pub(crate) struct CopyAndFences {
    slots: [[u64; 2 * WORDS]; 8],
}

impl Shared {
    /// Makes a cell that this process shares with itself.
    pub(crate) fn anonymous() -> Result<Self> {
        let file = memfd_create(c"floor", MemfdFlags::CLOEXEC).context("making a memfd")?;
        Self::over(file.as_fd())
    }

    /// Opens a cell that processes of one host share by its path; the first makes it.
    pub(crate) fn open(path: &Path) -> Result<Self> {
        let file = OpenOptions::new()
            .read(true)
            .write(true)
            .create(true)
            .truncate(false)
            .open(path)
            .with_context(|| format!("opening `{}`", path.display()))?;
        Self::over(file.as_fd())
    }

    #[expect(
        unsafe_code,
        reason = "shared memory has no safe door in the standard library"
    )]
    fn over(file: BorrowedFd<'_>) -> Result<Self> {
        ftruncate(file, u64::try_from(size_of::<Cell>())?).context("sizing shared memory")?;
        // SAFETY: a new mapping at an address of the kernel's choice; nothing else is there.
        let start = unsafe {
            mmap(
                ptr::null_mut(),
                size_of::<Cell>(),
                ProtFlags::READ | ProtFlags::WRITE,
                MapFlags::SHARED,
                file,
                0,
            )
        }
        .context("mapping shared memory")?;
        let cell = NonNull::new(start.cast::<Cell>()).context("mapped at zero")?;
        // SAFETY: the mapping is a page, so aligned and large enough; it is never unmapped; the file begins as zeros, and
        // every field is an atomic that any bit pattern suits, so that others may write while this reference lives.
        let cell = unsafe { cell.as_ref() };
        Ok(Self { cell })
    }

    /// Takes the value, unless it is being written.
    fn read(&self) -> Option<(u32, [u64; WORDS])> {
        // Acquire: pairs with the Release in `write`.
        let seq = self.cell.seq.load(Ordering::Acquire);
        let value = std::array::from_fn(|word| self.cell.words[word].load(Ordering::Relaxed));
        fence(Ordering::Acquire);
        (seq.is_multiple_of(2) && self.cell.seq.load(Ordering::Relaxed) == seq)
            .then_some((seq, value))
    }
}

impl FloorWriter {
    /// Writes the value and wakes who waits.
    pub(crate) fn write(&mut self, value: &[u64; WORDS]) -> Result<()> {
        let Cell {
            seq,
            waiting,
            words,
        } = self.0.cell;
        let before = seq.load(Ordering::Relaxed);
        seq.store(before.wrapping_add(1), Ordering::Relaxed);
        fence(Ordering::Release);
        for (word, &part) in words.iter().zip(value) {
            word.store(part, Ordering::Relaxed);
        }
        // Release: pairs with the Acquire in `Shared::read`.
        seq.store(before.wrapping_add(2), Ordering::Release);
        // SeqCst: pairs with the fence in `FloorReader::sleep`.
        fence(Ordering::SeqCst);
        if waiting.load(Ordering::Relaxed) != 0 {
            futex::wake(seq, futex::Flags::empty(), u32::MAX).context("waking")?;
        }
        Ok(())
    }
}

impl FloorReader {
    /// A reader that has seen what is there. It sleeps for news if it `blocks`, else it polls.
    pub(crate) fn new(shared: Shared, blocks: bool) -> Self {
        let seen = shared.cell.seq.load(Ordering::Acquire);
        Self {
            shared,
            seen,
            blocks,
        }
    }

    /// The next value.
    pub(crate) fn next(&mut self) -> Result<[u64; WORDS]> {
        loop {
            match self.shared.read() {
                Some((seq, value)) if seq != self.seen => {
                    self.seen = seq;
                    return Ok(value);
                }
                Some(_) if self.blocks => self.sleep()?,
                Some(_) | None => std::hint::spin_loop(),
            }
        }
    }

    /// The value, new or not.
    pub(crate) fn value(&self) -> [u64; WORDS] {
        loop {
            if let Some((_, value)) = self.shared.read() {
                return value;
            }
        }
    }

    fn sleep(&self) -> Result<()> {
        let Cell { seq, waiting, .. } = self.shared.cell;
        waiting.fetch_add(1, Ordering::Relaxed);
        // SeqCst: pairs with the fence in `FloorWriter::write`.
        fence(Ordering::SeqCst);
        let slept = futex::wait(seq, futex::Flags::empty(), self.seen, None);
        waiting.fetch_sub(1, Ordering::Relaxed);
        match slept {
            Ok(()) | Err(Errno::AGAIN | Errno::INTR) => Ok(()),
            Err(error) => Err(error).context("sleeping"),
        }
    }
}

impl CopyAndFences {
    /// Copies a value.
    pub(crate) fn write(&mut self, turn: u64, value: &[u64; WORDS]) {
        let slot = usize::try_from(turn % 8).unwrap_or(0);
        self.slots[slot][..WORDS].copy_from_slice(std::hint::black_box(value));
        fence(Ordering::SeqCst);
        std::hint::black_box(&mut self.slots);
        fence(Ordering::SeqCst);
    }
}

impl Send64 for FloorWriter {
    fn send(&mut self, stamp: u64) -> Result<()> {
        self.write(&[stamp; WORDS])
    }
}

impl Take64 for FloorReader {
    fn take(&mut self) -> Result<u64> {
        Ok(self.next()?[0])
    }
}
