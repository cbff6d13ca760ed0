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
use crate::sync::{Ordering, Site, fence};

/// Clients that can have a bell: the daemon's limit of connections.
pub const MAX_CLIENTS: u16 = 1024;
/// Dirty bits of a client: as many as fit its line beside the other words, in powers of two.
pub const DIRTY_BITS: u16 = 512;
/// Longest sleep of one call. After it a waiter looks at its daemon's socket, so that no lie in shared memory costs
/// more than this.
pub const MAX_SLICE: Duration = Duration::from_millis(100);

const DIRTY_WORDS: usize = 8;
/// The word of a client's line that waiters sleep on: a count of rings.
pub const RUNG: usize = 0;
/// Threads of the client that are about to sleep, or do.
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

/// What [`Bells::arm`] saw; the sleep ends at once when somebody has rung since.
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
    /// or by a waiter's last look. Enters the kernel only for an armed client.
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
    /// calls [`Bells::wait`] or [`Bells::disarm`].
    pub fn arm(&self, client: u16) -> Seen {
        if fork::is_past(self.generation) {
            return Seen(0);
        }
        Seen(arm(&self.map, line(client)))
    }

    /// Takes back an [`Bells::arm`] that no sleep follows.
    pub fn disarm(&self, client: u16) {
        if !fork::is_past(self.generation) {
            disarm(&self.map, line(client));
        }
    }

    /// Sleeps until the client's bell is rung, `timeout` or [`MAX_SLICE`] has passed, or a signal came; then disarms.
    /// May wake for no reason: the caller looks for itself.
    pub fn wait(&self, client: u16, seen: Seen, timeout: Duration) {
        if fork::is_past(self.generation) {
            return;
        }
        self.map
            .sleep(line(client) + RUNG, seen.0, timeout.min(MAX_SLICE));
        self.disarm(client);
    }

    /// Takes the bits rung since the last call. With several waiting threads in one client, bits may have been
    /// taken by another.
    pub fn take_dirty(&self, client: u16) -> [u64; DIRTY_WORDS] {
        if fork::is_past(self.generation) {
            return [0; DIRTY_WORDS];
        }
        let first = line(client) + DIRTY;
        // A glance first: most words are clean, and a swap would take the line from its writers.
        std::array::from_fn(
            |word| match self.map.load(first + word, Ordering::Relaxed) {
                0 => 0,
                _ => self.map.fetch_and(first + word, 0, Ordering::Relaxed),
            },
        )
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

/// Rings the bell at word `line`: true when somebody may sleep there. Generic for models.
pub fn ring<W: Words>(bells: &W, line: usize, bit: u16) -> bool {
    let word = usize::from(bit / 64) % DIRTY_WORDS;
    bells.fetch_or(line + DIRTY + word, 1 << (bit % 64), Ordering::Relaxed);
    bells.fetch_add(line + RUNG, 1, Ordering::Relaxed);
    // SeqCst: pairs with the fence in `arm`.
    fence(Site::RingFence);
    bells.load(line + ARMED, Ordering::Relaxed) != 0
}

/// Arms the bell at word `line` and returns the count of rings to sleep on, of which the futex compares 32 bits.
/// Generic for models.
pub fn arm<W: Words>(bells: &W, line: usize) -> u32 {
    bells.fetch_add(line + ARMED, 1, Ordering::Relaxed);
    let rung = bells.load(line + RUNG, Ordering::Relaxed);
    // SeqCst: pairs with the fences in `RingWriter::publish`, `ring::waiting_now` and `ring`.
    fence(Site::ArmFence);
    u32::try_from(rung & u64::from(u32::MAX)).unwrap_or(0)
}

fn disarm<W: Words>(bells: &W, line: usize) {
    // Wraps when somebody has zeroed it meanwhile: then the client is woken needlessly until it is reset.
    bells.fetch_add(line + ARMED, u64::MAX, Ordering::Relaxed);
}
