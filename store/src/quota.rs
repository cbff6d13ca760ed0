//! How much one client of the daemon may hold and ask, and the words that name an exhausted limit.

use std::fmt;
use std::time::Duration;

use ddx_wire::Time;
use serde::{Deserialize, Serialize};

/// What one client may use of its daemon. Exhaustion refuses the request that went over, by name and numbers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Quotas {
    /// Clients connected at one time, all programs together.
    pub clients: u32,
    /// Items that one client writes at one time.
    pub items: u32,
    /// Bytes of shared memory behind the items that one client writes. This counts room, of which only what was written
    /// takes up memory: an item of 6 MiB with 64 seats for readers has room for 146 samples and mostly uses a few.
    pub bytes: u64,
    /// Readers that one client holds open.
    pub cells: u32,
    /// File descriptors that the daemon keeps for one client.
    pub fds: u32,
    /// Requests of one client in a second, on average over the last second.
    pub messages_per_second: u32,
    /// Answers and notices that may wait for one client which does not collect them.
    pub queued_replies: u32,
}

/// A limit that a client reached.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[non_exhaustive]
pub enum Limit {
    /// [`Quotas::clients`].
    Clients,
    /// [`Quotas::items`].
    Items,
    /// [`Quotas::bytes`].
    Bytes,
    /// [`Quotas::cells`].
    Cells,
    /// [`Quotas::fds`].
    Fds,
    /// [`Quotas::messages_per_second`].
    MessageRate,
    /// [`Quotas::queued_replies`].
    QueuedReplies,
    /// Readers of one item: its writer made so many cells.
    Readers,
    /// Pins that an item's writer shares out among its readers.
    Pins,
}

/// Requests of one client against its rate: a bucket that holds one second's worth.
#[derive(Debug)]
pub(crate) struct Bucket {
    per_second: u32,
    /// Thousand-millionths of a request that may still be made.
    credit: u64,
    filled: Time,
}

impl Default for Quotas {
    fn default() -> Self {
        Self {
            clients: 1024,
            items: 4096,
            bytes: 64 << 30,
            cells: 16_384,
            fds: 8192,
            messages_per_second: 20_000,
            queued_replies: 4096,
        }
    }
}

impl fmt::Display for Limit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Clients => "clients of this daemon",
            Self::Items => "items written by this client",
            Self::Bytes => "bytes of shared memory of this client",
            Self::Cells => "readers held by this client",
            Self::Fds => "file descriptors kept for this client",
            Self::MessageRate => "requests per second of this client",
            Self::QueuedReplies => "answers that this client has not collected",
            Self::Readers => "readers of this item",
            Self::Pins => "pins of this item",
        })
    }
}

impl Bucket {
    pub(crate) fn new(per_second: u32, now: Time) -> Self {
        Self {
            per_second,
            credit: u64::from(per_second) * SECOND_NS,
            filled: now,
        }
    }

    /// Takes one request out; false when the rate is exhausted.
    pub(crate) fn take(&mut self, now: Time) -> bool {
        let full = u64::from(self.per_second) * SECOND_NS;
        let waited = now.since(self.filled).min(Duration::from_secs(1));
        let earned =
            u64::try_from(waited.as_nanos()).unwrap_or(SECOND_NS) * u64::from(self.per_second);
        self.credit = self.credit.saturating_add(earned).min(full);
        self.filled = now;
        match self.credit.checked_sub(SECOND_NS) {
            Some(left) => {
                self.credit = left;
                true
            }
            None => false,
        }
    }
}

const SECOND_NS: u64 = 1_000_000_000;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bucket_allows_a_second_at_once_then_the_rate() {
        let mut bucket = Bucket::new(10, Time(0));
        assert_eq!((0..20).filter(|_| bucket.take(Time(0))).count(), 10);
        assert!(!bucket.take(Time(99_000_000)));
        assert!(bucket.take(Time(200_000_000)));
    }

    #[test]
    fn bucket_does_not_save_up_more_than_a_second() {
        let mut bucket = Bucket::new(3, Time(0));
        let later = Time(60 * SECOND_NS);
        assert_eq!((0..20).filter(|_| bucket.take(later)).count(), 3);
    }
}
