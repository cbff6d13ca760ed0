//! Waking: the domain-wide `bells` segment, a line for each client of the daemon.
//!
//! A waiter shows itself (its bit in each item's `waiting` word, then [`Bells::arm`]), looks a last time at what it
//! waits for, and sleeps; a waker changes something, then looks for waiters. Full fences on both sides make sure that
//! one sees the other. Everything in here can be written by everybody: a false value costs a spurious wake, or a
//! missed one that ends with the slice of [`MAX_SLICE`].

use std::os::fd::OwnedFd;
use std::time::Duration;

use crate::layout::{LINE, LINE_WORDS};
use crate::ring::Words;
use crate::shm::{Map, ShmError, fork, heap, memfd};
use crate::sync::{Ordering, Site, fence, order};

/// Clients that can have a bell: the daemon's limit of connections.
pub const MAX_CLIENTS: u16 = 1024;
/// Dirty bits of a client: as many as fit its line beside the other words, in powers of two.
pub const DIRTY_BITS: u16 = 512;
/// Longest sleep of one call. After it a waiter looks at its daemon's socket, so that no lie in shared memory costs
/// more than this.
pub const MAX_SLICE: Duration = Duration::from_millis(100);

const DIRTY_WORDS: usize = 8;
/// The word of a client's line that waiters sleep on: a count of wake-ups.
pub const RUNG: usize = 0;
/// Not 0 while threads of the client may be about to sleep, or sleep: who clears it wakes them all, so that of many rings
/// only the first enters the kernel.
const ARMED: usize = 1;
const DIRTY: usize = 2;

/// What a writer rings for one waiting reader: a client, and the bit that tells the client which of its readers.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Bell {
    /// Index of the client, below [`MAX_CLIENTS`].
    pub client: u16,
    /// Index of the bit, below [`DIRTY_BITS`]; larger ones are folded.
    pub bit: u16,
}

/// What [`Bells::arm`] saw; the sleep ends at once when somebody has been woken since.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Seen(u32);

/// The bells of a domain, mapped.
#[derive(Debug)]
pub struct Bells {
    map: Map,
    generation: u64,
}

impl Bell {
    /// As a word of a cell.
    pub fn to_word(self) -> u64 {
        (u64::from(self.client) << 16) | u64::from(self.bit)
    }

    /// From a word that anybody may have written: folded into the valid range.
    pub fn from_word(word: u64) -> Self {
        let low = |value: u64| u16::try_from(value & 0xffff).unwrap_or(0);
        Self {
            client: low(word >> 16) % MAX_CLIENTS,
            bit: low(word) % DIRTY_BITS,
        }
    }
}

impl Bells {
    /// Makes the bells, as the daemon does, and returns what to hand to clients.
    pub fn create() -> Result<(Self, OwnedFd), ShmError> {
        let (map, fd) = memfd::create(c"ddx-bells", Self::len())?;
        memfd::seal(&fd, memfd::CTL_SEALS)?;
        Ok((Self::over(map), fd))
    }

    /// Maps the bells that the daemon has sent. Refuses a file that is not sealed or has another size.
    pub fn map(fd: &OwnedFd) -> Result<Self, ShmError> {
        let map = memfd::map(fd, "bells", memfd::CTL_SEALS, memfd::Access::ReadWrite)?;
        if map.len() != Self::len() {
            return Err(ShmError::Size {
                what: "bells",
                found: map.len(),
            });
        }
        Ok(Self::over(map))
    }

    /// Makes bells on the heap, for waiters of this process only.
    pub fn heap() -> Result<Self, ShmError> {
        Ok(Self::over(heap::create(Self::len())?))
    }

    fn over(map: Map) -> Self {
        Self {
            map,
            generation: fork::generation(),
        }
    }

    fn len() -> usize {
        usize::from(MAX_CLIENTS) * LINE
    }

    /// Marks the bit dirty and wakes the client if it sleeps. Whatever the caller stored before is seen by the woken
    /// or by a waiter's last look. Enters the kernel only for an armed client, and disarms it.
    pub fn ring(&self, bell: Bell) {
        if fork::is_past(self.generation) {
            return;
        }
        let bell = Bell::from_word(bell.to_word());
        if ring(&self.map, line(bell.client), bell.bit) {
            self.map.wake(line(bell.client) + RUNG);
        }
    }

    /// Announces that the caller is about to sleep. After this it looks once more at everything it waits for, and
    /// calls [`Bells::wait`]; if it does not, the next ring enters the kernel in vain.
    pub fn arm(&self, client: u16) -> Seen {
        if fork::is_past(self.generation) {
            return Seen(0);
        }
        Seen(arm(&self.map, line(client)))
    }

    /// Sleeps until the client's bell is rung, `timeout` or [`MAX_SLICE`] has passed, or a signal came. May
    /// wake for no reason: the caller looks for itself.
    pub fn wait(&self, client: u16, seen: Seen, timeout: Duration) {
        if fork::is_past(self.generation) {
            return;
        }
        self.map
            .sleep(line(client) + RUNG, seen.0, timeout.min(MAX_SLICE));
    }

    /// Takes the bits rung since the last call. With several waiting threads in one client, bits may have been
    /// taken by another.
    pub fn take_dirty(&self, client: u16) -> [u64; DIRTY_WORDS] {
        if fork::is_past(self.generation) {
            return [0; DIRTY_WORDS];
        }
        take_dirty(&self.map, line(client))
    }

    /// Clears a client's line for its next owner.
    pub fn reset(&self, client: u16) {
        if fork::is_past(self.generation) {
            return;
        }
        for word in ARMED..DIRTY + DIRTY_WORDS {
            self.map.store(line(client) + word, 0, Ordering::Relaxed);
        }
    }
}

/// First word of a client's line.
fn line(client: u16) -> usize {
    usize::from(client % MAX_CLIENTS) * LINE_WORDS
}

/// Rings the bell at word `line`: true when those who sleep there are to be woken. Generic for models.
pub fn ring<W: Words>(bells: &W, line: usize, bit: u16) -> bool {
    let word = line + DIRTY + usize::from(bit / 64) % DIRTY_WORDS;
    let mask = 1 << (bit % 64);
    // SeqCst: pairs with the fences in `arm` and `take_dirty`. A bit that is still set will be taken after this, so that
    // whoever takes it sees what the caller stored, and the line stays with its owner.
    fence(Site::RingFence);
    if bells.load(word, Ordering::Relaxed) & mask == 0 {
        bells.fetch_or(word, mask, Ordering::Relaxed);
        // SeqCst: pairs with the fence in `arm`, behind which the bits are taken once more.
        fence(Site::RingFence);
    }
    let armed = line + ARMED;
    let wakes = bells.load(armed, Ordering::Relaxed) != 0
        // Acquire: pairs with the Release in `arm`, whose count was read before it.
        && bells.fetch_and(armed, 0, order(Site::ArmSwap)) != 0;
    if wakes {
        // After the swap: who armed before it and does not sleep yet finds another count, and does not.
        bells.fetch_add(line + RUNG, 1, Ordering::Relaxed);
    }
    wakes
}

/// Arms the bell at word `line` and returns the count to sleep on, of which the futex compares 32 bits. Generic for models.
pub fn arm<W: Words>(bells: &W, line: usize) -> u32 {
    // Read first: the count from after a swap of this arming would be slept on although its wake-up is over.
    let rung = bells.load(line + RUNG, Ordering::Relaxed);
    // Release: pairs with the Acquire in `ring`.
    bells.fetch_or(line + ARMED, 1, order(Site::ArmStore));
    // SeqCst: pairs with the fences in `RingWriter::publish`, `ring::waiting_now` and `ring`.
    fence(Site::ArmFence);
    u32::try_from(rung & u64::from(u32::MAX)).unwrap_or(0)
}

/// Takes the dirty bits at word `line`; what was stored before they were set can be seen after this. Generic for models.
pub fn take_dirty<W: Words>(bells: &W, line: usize) -> [u64; DIRTY_WORDS] {
    let first = line + DIRTY;
    // A glance first: most words are clean, and a swap would take the line from its writers.
    let dirty = std::array::from_fn(|word| match bells.load(first + word, Ordering::Relaxed) {
        0 => 0,
        _ => bells.fetch_and(first + word, 0, Ordering::Relaxed),
    });
    // SeqCst: pairs with the fence in `ring`.
    fence(Site::TakeFence);
    dirty
}
