//! Mapped memory that other processes can write, and its twin on the heap.
//!
//! Invariants of [`Map`], on which every unsafe block here and above leans:
//! 1. `base` points to `len` readable bytes, initialised (as zeros, or by somebody), until the map is dropped; for a
//!    memfd its seals forbid that the file shrinks. In a forked child a mapped memfd is absent, so holders compare
//!    [`fork::generation`] before each use.
//! 2. `base` is aligned to [`LINE`](crate::layout::LINE) and `len` is a multiple of it.
//! 3. Words are reached as atomics only, payloads through raw pointers only, each after a check of its bounds.
//!    No reference is formed to anything else in here.
#![warn(
    clippy::arithmetic_side_effects,
    clippy::indexing_slicing,
    clippy::as_conversions
)]
#![expect(unsafe_code, reason = "the home of mapped memory")]

pub mod fork;
pub mod heap;
pub mod memfd;

use std::io;
use std::ptr::NonNull;
use std::sync::atomic::AtomicU64;
use std::time::Duration;

use thiserror::Error;

use crate::layout::WORD;
use crate::ring::Words;
use crate::sync::Ordering;

/// A range of memory, shared or not.
#[derive(Debug)]
pub struct Map {
    base: NonNull<u8>,
    len: usize,
    backing: Backing,
}

/// Who gives the memory back, and how.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Backing {
    /// In a process of this generation; in a forked child the range is no longer ours.
    Memfd {
        generation: u64,
    },
    Heap,
}

/// Why memory cannot be had.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ShmError {
    /// The system refused.
    #[error("cannot {what}")]
    Os {
        /// The call, in words.
        what: &'static str,
        /// Its error.
        source: io::Error,
    },
    /// A file that was handed over is not protected as it must be.
    #[error(
        "the {what} segment is not sealed as it must be (seals {found:#x}, needed {needed:#x})"
    )]
    Seals {
        /// Which file.
        what: &'static str,
        /// Its seals.
        found: i32,
        /// Those it must have.
        needed: i32,
    },
    /// A file that was handed over has an impossible size.
    #[error("the {what} segment has an impossible size of {found} bytes")]
    Size {
        /// Which file.
        what: &'static str,
        /// Its size.
        found: usize,
    },
}

// SAFETY: a `Map` owns its range, and nothing about that is tied to a thread.
unsafe impl Send for Map {}
// SAFETY: shared use goes through atomics, or through raw pointers whose users answer for it (invariant 3).
unsafe impl Sync for Map {}

impl Map {
    /// Bytes of the range.
    #[expect(clippy::len_without_is_empty, reason = "an empty map cannot be made")]
    pub fn len(&self) -> usize {
        self.len
    }

    /// The word at index `at`. Panics outside the range, which no checked [`crate::layout::Shape`] asks for.
    #[inline]
    fn word(&self, at: usize) -> &AtomicU64 {
        let offset = at.checked_mul(WORD).filter(|offset| *offset < self.len);
        let offset = offset.expect("a checked shape has its words inside the map");
        // SAFETY: `offset` is below `len`, so the result lies in the same range (invariant 1).
        let word = unsafe { self.base.add(offset) }.cast::<AtomicU64>();
        // SAFETY: the range is valid while `self` is; `base` is aligned to 128 and `offset` to 8, and `len` is a
        // multiple of 8, so a whole aligned word is there; all processes touch words as atomics only (invariant 3).
        unsafe { word.as_ref() }
    }

    /// Where `len` bytes at `offset` begin. Panics outside the range, which no checked [`crate::layout::Shape`] asks
    /// for.
    #[inline]
    pub fn bytes(&self, offset: usize, len: usize) -> NonNull<u8> {
        let end = offset.checked_add(len).filter(|end| *end <= self.len);
        assert!(
            end.is_some(),
            "a checked shape has its slots inside the map"
        );
        // SAFETY: `offset` is at most `len`, so the result lies in the same range or at its end (invariant 1).
        unsafe { self.base.add(offset) }
    }

    /// Copies `len` bytes at `offset` out, replacing the content of `out`. The bytes may be torn if their writer
    /// does not leave them alone; the caller finds out by other means.
    #[inline]
    pub fn copy_out(&self, offset: usize, len: usize, out: &mut Vec<u8>) {
        out.clear();
        out.reserve(len);
        let from = self.bytes(offset, len).as_ptr();
        // SAFETY: `from` is readable for `len` bytes (checked by `bytes`), `out` writable for as many (reserved above),
        // and a vector of this process does not overlap the map.
        unsafe { std::ptr::copy_nonoverlapping(from, out.as_mut_ptr(), len) };
        // SAFETY: the first `len` bytes of `out` were written above, within its capacity.
        unsafe { out.set_len(len) };
    }

    /// Copies `len` bytes at `offset` out like [`Map::copy_out`], while their writer may be changing them: word by word, by
    /// relaxed loads. `offset` is a multiple of a word, and the last word may reach beyond the bytes asked for.
    #[inline]
    pub fn copy_words_out(&self, offset: usize, len: usize, out: &mut Vec<u8>) {
        let words = len.div_ceil(WORD);
        let whole = words.saturating_mul(WORD);
        out.clear();
        out.reserve(whole);
        let from = self.bytes(offset, whole).cast::<AtomicU64>();
        assert!(from.is_aligned(), "payloads begin at a line");
        let to = out.as_mut_ptr().cast::<[u8; WORD]>();
        for at in 0..words {
            // SAFETY: word `at` ends at most `whole` bytes behind `from`, which `bytes` has found to be in the range.
            let from = unsafe { from.add(at) };
            // SAFETY: as in `word`: an aligned word of the range, touched here as an atomic.
            let word = unsafe { from.as_ref() }.load(Ordering::Relaxed);
            // SAFETY: word `at` ends at most `whole` bytes behind `to`, which has room for as many (reserved above).
            let to = unsafe { to.add(at) };
            // SAFETY: `to` is valid for writing so many bytes, which need no alignment.
            unsafe { to.write(word.to_le_bytes()) };
        }
        // SAFETY: `len` is at most `whole`, and so many bytes of `out` were written above, within its capacity.
        unsafe { out.set_len(len) };
    }

    /// Whether other mappings of the same memory may exist. If not, the slices of its writer forbid reading beside them.
    pub fn is_shared(&self) -> bool {
        self.backing != Backing::Heap
    }

    /// Sleeps while the low half of the word at `at` equals `seen`, at most `timeout`. May return early.
    pub fn sleep(&self, at: usize, seen: u32, timeout: Duration) {
        memfd::futex_wait(self.low_half(at), seen, timeout);
    }

    /// Wakes all who sleep on the word at `at`, in any process.
    pub fn wake(&self, at: usize) {
        memfd::futex_wake(self.low_half(at));
    }

    /// The half of a word that the kernel compares: the low one comes first, as all hosts are little-endian.
    fn low_half(&self, at: usize) -> *mut u32 {
        self.word(at).as_ptr().cast::<u32>()
    }
}

impl Words for Map {
    #[inline]
    fn load(&self, at: usize, order: Ordering) -> u64 {
        self.word(at).load(order)
    }
    #[inline]
    fn store(&self, at: usize, value: u64, order: Ordering) {
        self.word(at).store(value, order);
    }
    #[inline]
    fn fetch_add(&self, at: usize, value: u64, order: Ordering) -> u64 {
        self.word(at).fetch_add(value, order)
    }
    #[inline]
    fn fetch_and(&self, at: usize, value: u64, order: Ordering) -> u64 {
        self.word(at).fetch_and(value, order)
    }
    #[inline]
    fn fetch_or(&self, at: usize, value: u64, order: Ordering) -> u64 {
        self.word(at).fetch_or(value, order)
    }
    #[inline]
    fn load_run<const N: usize>(&self, first: usize) -> [u64; N] {
        let offset = first.saturating_mul(WORD);
        let len = N.saturating_mul(WORD);
        let run = self.bytes(offset, len).cast::<AtomicU64>();
        std::array::from_fn(|at| {
            // SAFETY: `at` is below `N`, and `bytes` has found so many words to be in the range.
            let word = unsafe { run.add(at) };
            // SAFETY: as in `word`: `offset` is a multiple of a word, so this is an aligned word of the range.
            unsafe { word.as_ref() }.load(Ordering::Relaxed)
        })
    }
    #[inline]
    fn store_run<const N: usize>(&self, first: usize, values: &[u64; N]) {
        let offset = first.saturating_mul(WORD);
        let len = N.saturating_mul(WORD);
        let run = self.bytes(offset, len).cast::<AtomicU64>();
        for (at, value) in values.iter().enumerate() {
            // SAFETY: `at` is below `N`, and `bytes` has found so many words to be in the range.
            let word = unsafe { run.add(at) };
            // SAFETY: as in `word`: `offset` is a multiple of a word, so this is an aligned word of the range.
            unsafe { word.as_ref() }.store(*value, Ordering::Relaxed);
        }
    }
}

impl Drop for Map {
    fn drop(&mut self) {
        match self.backing {
            Backing::Memfd { generation } if !fork::is_past(generation) => {
                memfd::unmap(self.base, self.len);
            }
            Backing::Memfd { .. } => {}
            Backing::Heap => heap::free(self.base, self.len),
        }
    }
}

fn os_error(what: &'static str) -> ShmError {
    ShmError::Os {
        what,
        source: io::Error::last_os_error(),
    }
}
