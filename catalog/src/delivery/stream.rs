//! One stream that leaves this host: its contract, its readers, and what became of its samples.

use std::collections::BTreeSet;
use std::net::SocketAddr;
use std::time::Duration;

use ddx_wire::sample::{MAX_SAMPLE_BYTES, SampleMeta};
use ddx_wire::{Contract, Delivery, Epoch, Seq, Tag, Time};

use super::books::SourceBooks;
use super::sender::StreamCounters;
use super::{ReaderHost, Route, key};

#[derive(Debug)]
pub(super) struct Stream {
    pub(super) contract: Contract,
    /// Samples of the newest one's epoch that were offered to no path.
    pub(super) filtered: u64,
    pub(super) next_due: Time,
    pub(super) readers: Vec<Reader>,
    pub(super) destinations: Vec<SocketAddr>,
    pub(super) newest: Option<(Epoch, Seq)>,
    /// The present value that new readers got before any sample was offered: from it they count what is left out.
    pub(super) present: Option<(Epoch, Seq)>,
    pub(super) expired: Option<(Epoch, Seq)>,
    pub(super) counters: StreamCounters,
    pub(super) books: SourceBooks,
    /// Newest sample that was offered, whatever became of it.
    pub(super) offered: Option<(Epoch, Seq)>,
    /// Whether no way had room for the newest: what the driver does not offer meanwhile, each way leaves out for itself.
    pub(super) full: bool,
}

#[derive(Debug)]
pub(super) struct Reader {
    pub(super) host: ReaderHost,
    pub(super) sent: Option<(Epoch, Seq)>,
    pub(super) sent_at: Time,
    pub(super) held: Option<(Epoch, Seq)>,
    pub(super) repeats: u32,
    pub(super) repeat_asked_at: Option<Time>,
    /// What it lacked when it last asked, and how often it asked for that.
    pub(super) asked: Option<((Epoch, Seq), u32)>,
}

impl Stream {
    /// Follows a route. How many of its readers are beyond the limit, and left out.
    pub(super) fn reroute(&mut self, route: &Route, now: Time) -> u64 {
        self.contract = route.contract;
        self.next_due = self.next_due.min(now + self.interval());
        let mut old = std::mem::take(&mut self.readers);
        for host in route.readers.iter().take(MAX_READERS) {
            let kept = old.iter().position(|reader| reader.host.tag == host.tag);
            let reader = kept.map_or_else(|| Reader::new(*host, now), |at| old.swap_remove(at));
            self.readers.push(Reader {
                host: *host,
                ..reader
            });
        }
        let destinations: BTreeSet<SocketAddr> = self
            .readers
            .iter()
            .flat_map(|reader| reader.host.destinations())
            .collect();
        self.destinations = destinations.into_iter().collect();
        u64::try_from(route.readers.len().saturating_sub(MAX_READERS)).unwrap_or(u64::MAX)
    }

    /// Tells whether a sample fits the protocol and the contract, and counts one that does not.
    pub(super) fn admits(&mut self, meta: &SampleMeta, payload: &[u8], now: Time) -> bool {
        if payload.len() > MAX_SAMPLE_BYTES {
            self.counters.too_large += 1;
            return false;
        }
        let max_age = self.contract.max_age_ms;
        let max_age = max_age.map(|ms| Duration::from_millis(ms.into()));
        if max_age.is_some_and(|age| now.since(meta.capture) > age) {
            if self.expired < Some(key(meta)) {
                self.expired = Some(key(meta));
                self.counters.expired += 1;
            }
            return false;
        }
        true
    }

    /// Enters a sample that is offered, and those before it that were not.
    pub(super) fn account(&mut self, meta: &SampleMeta, payload: &[u8], admitted: bool) {
        let Some(ahead) = ahead(self.offered, key(meta)) else {
            return;
        };
        self.offered = Some(key(meta));
        let left_to_ways = self.leaves_out_by_way();
        let books = &mut self.books;
        books.expected = books.expected.saturating_add(ahead);
        let missed = if left_to_ways {
            &mut books.delivered
        } else if self.contract.interval_ns() > 0 {
            &mut books.rate_limited
        } else {
            &mut books.overwritten
        };
        *missed = missed.saturating_add(ahead.saturating_sub(1));
        let fate = match admitted {
            true => &mut books.delivered,
            false if payload.len() > MAX_SAMPLE_BYTES => &mut books.too_large,
            false => &mut books.expired,
        };
        *fate += 1;
        let is_next = self.newest.is_some_and(|(epoch, _)| epoch == meta.epoch);
        if !admitted && left_to_ways && is_next {
            // No way leaves this one out for itself.
            self.filtered = self.filtered.saturating_add(1);
        }
        let books = &mut self.books;
        books.bytes = books.bytes.saturating_add(payload.len() as u64);
    }

    /// Takes note of a sample that goes out, and completes it by how many of its epoch were offered to no path.
    pub(super) fn advance(&mut self, meta: &SampleMeta) -> SampleMeta {
        let meta = self.complete(meta);
        if Some(key(&meta)) > self.newest {
            self.filtered = meta.filtered;
            self.newest = Some(key(&meta));
        }
        meta
    }

    /// The same for one that goes out of turn, perhaps before the contract lets it go to all.
    pub(super) fn complete(&self, meta: &SampleMeta) -> SampleMeta {
        let (epoch, Seq(seq)) = key(meta);
        let filtered = match self.newest.or(self.present) {
            // What is left out of these is told one by one.
            _ if self.contract.delivery != Delivery::Latest => 0,
            Some((last, _)) if last == epoch && self.leaves_out_by_way() => self.filtered,
            Some((last, Seq(from))) if last == epoch => {
                let skipped = seq.saturating_sub(from).saturating_sub(1);
                self.filtered.saturating_add(skipped)
            }
            Some(_) | None => seq,
        };
        SampleMeta {
            filtered: filtered.min(seq.saturating_sub(1)),
            ..*meta
        }
    }

    /// Takes note of a sample that goes out of turn: the first of the stream, if there was none.
    pub(super) fn begin(&mut self, meta: &SampleMeta) {
        if self.newest.or(self.present).is_none() {
            (self.present, self.filtered) = (Some(key(meta)), meta.filtered);
        }
    }

    /// Whether a sample that is not offered now is one for which no way had room, rather than one that the contract or the
    /// ring left out.
    fn leaves_out_by_way(&self) -> bool {
        self.full && self.contract.delivery == Delivery::Latest && self.contract.interval_ns() == 0
    }

    pub(super) fn advance_due(&mut self, now: Time) {
        let interval = self.interval();
        // A source at just the contract's rate may be late once and on time again; more than one interval is no credit.
        let base = if now.since(self.next_due) < interval {
            self.next_due
        } else {
            now
        };
        self.next_due = base + interval;
    }

    pub(super) fn interval(&self) -> Duration {
        Duration::from_nanos(self.contract.interval_ns())
    }

    pub(super) fn tags(&self) -> impl Iterator<Item = Tag> + '_ {
        self.readers.iter().map(|reader| reader.host.tag)
    }
}

impl Reader {
    fn new(host: ReaderHost, now: Time) -> Self {
        Self {
            host,
            sent: None,
            sent_at: now,
            held: None,
            repeats: 0,
            repeat_asked_at: None,
            asked: None,
        }
    }

    pub(super) fn is_behind(&self) -> bool {
        self.held < self.sent
    }
}

/// How many samples come after the last one up to this; none if it is not newer. Before the first nothing is missed.
fn ahead(last: Option<(Epoch, Seq)>, (epoch, Seq(seq)): (Epoch, Seq)) -> Option<u64> {
    match last {
        None => Some(1),
        Some((before, _)) if before < epoch => Some(seq),
        Some((before, Seq(last))) => seq.checked_sub(last).filter(|n| before == epoch && *n > 0),
    }
}

/// Reading hosts of one stream.
const MAX_READERS: usize = 1_024;
