//! Datagrams of one lane of one path that are about to leave.
//!
//! They lie back to back in one buffer, so that in steady state nothing is allocated for a sample. They are numbered and
//! sealed when they leave.

use std::collections::VecDeque;

use ddx_wire::StreamId;
use ddx_wire::sample::{Last, PADDING, PREAMBLE_BYTES, Place, Preamble, RECORD_BYTES, Record};
use ddx_wire::seal::{HEADER_BYTES, Lane, MIXED_STREAMS, SEAL_BYTES, Sealer};

/// What every data datagram costs beside its records, bytes.
pub(super) const DATAGRAM_OVERHEAD: usize = HEADER_BYTES + PREAMBLE_BYTES + SEAL_BYTES;

#[derive(Debug, Default)]
pub(super) struct Queue {
    bytes: Vec<u8>,
    /// Where the first datagram that has not left begins.
    head: usize,
    closed: VecDeque<Closed>,
    open: Option<Open>,
    dropped: u64,
}

#[derive(Debug)]
struct Closed {
    len: usize,
    stream: StreamId,
}

#[derive(Debug)]
struct Open {
    start: usize,
    stream: StreamId,
    last: Last,
}

/// What bounds one batch.
#[derive(Clone, Copy, Debug)]
pub(super) struct Limit {
    /// Datagrams.
    pub(super) segments: usize,
    /// Bytes; one datagram may always go.
    pub(super) bytes: usize,
}

impl Queue {
    /// Bytes that wait, as they will be on the wire.
    pub(super) fn len(&self) -> usize {
        let datagrams = self.closed.len() + usize::from(self.open.is_some());
        self.bytes.len() - self.head + datagrams * SEAL_BYTES
    }

    pub(super) fn is_empty(&self) -> bool {
        self.closed.is_empty() && self.open.is_none()
    }

    /// Whether a datagram may leave.
    pub(super) fn is_ready(&self) -> bool {
        !self.closed.is_empty()
    }

    /// Whether a record of this length fits the datagram that waits for company.
    pub(super) fn has_company(&self, len: usize, datagram_bytes: usize) -> bool {
        self.open
            .as_ref()
            .is_some_and(|open| self.bytes.len() - open.start + len + SEAL_BYTES <= datagram_bytes)
    }

    /// Records for which there was no room.
    pub(super) fn dropped(&self) -> u64 {
        self.dropped
    }

    /// Adds a record to the open datagram, or to a new one where it does not fit. Beyond [`QUEUE_BYTES`] it is dropped and
    /// counted, as if the link had lost it.
    pub(super) fn push(&mut self, record: &Record<'_>, datagram_bytes: usize) {
        if self.len() + RECORD_BYTES + record.payload.len() > QUEUE_BYTES {
            self.dropped = self.dropped.saturating_add(1);
            return;
        }
        let end = self.bytes.len();
        let fits = |start: usize, bytes: &[u8]| bytes.len() - start + SEAL_BYTES <= datagram_bytes;
        // None of these can fail: what cannot be encoded is refused before it comes here.
        if let Some(open) = &mut self.open {
            record.encode(Place::After(open.last), &mut self.bytes).ok();
            if fits(open.start, &self.bytes) {
                if open.stream != record.stream {
                    open.stream = MIXED_STREAMS;
                }
                open.last = record.last();
                return;
            }
            self.bytes.truncate(end);
            // Only equal datagrams leave in one batch.
            let full = open.start + datagram_bytes - SEAL_BYTES;
            if end < full && full - end <= datagram_bytes / PADDED_SHARE {
                self.bytes.resize(full, PADDING);
            }
            self.close();
        }
        let end = self.bytes.len();
        let head = end + HEADER_BYTES + PREAMBLE_BYTES;
        self.bytes.resize(head, 0);
        record.encode(Place::First, &mut self.bytes).ok();
        self.open = Some(Open {
            start: end,
            stream: record.stream,
            last: record.last(),
        });
        if !fits(end, &self.bytes) {
            self.bytes.truncate(head);
            record.encode(Place::Alone, &mut self.bytes).ok();
            self.close();
        }
    }

    /// Adds a datagram of exactly `len` bytes that carries nothing.
    pub(super) fn push_padding(&mut self, len: usize) {
        self.close();
        let start = self.bytes.len();
        self.bytes.resize(start + len.saturating_sub(SEAL_BYTES), 0);
        self.closed.push_back(Closed {
            len: self.bytes.len() - start,
            stream: MIXED_STREAMS,
        });
    }

    /// The open datagram waits for no more company.
    pub(super) fn close(&mut self) {
        if let Some(open) = self.open.take() {
            self.closed.push_back(Closed {
                len: self.bytes.len() - open.start,
                stream: open.stream,
            });
        }
    }

    /// Seals the next batch into `out`: equal datagrams, the last perhaps shorter. Returns the length of the first, 0 for
    /// none, and counts them in `preamble.number`.
    pub(super) fn pop(
        &mut self,
        lane: Lane,
        sealer: &mut Sealer,
        limit: Limit,
        preamble: &mut Preamble,
        out: &mut Vec<u8>,
    ) -> usize {
        out.clear();
        let mut first = 0;
        for _ in 0..limit.segments {
            let Some(next) = self.closed.front() else {
                break;
            };
            let len = next.len + SEAL_BYTES;
            if !out.is_empty() && (len > first || out.len() + len > limit.bytes) {
                break;
            }
            if first == 0 {
                first = len;
            }
            let start = out.len();
            out.extend_from_slice(
                self.bytes
                    .get(self.head..self.head + next.len)
                    .unwrap_or_default(),
            );
            preamble.number = preamble.number.wrapping_add(1);
            let place = start + HEADER_BYTES;
            if let Some(place) = out.get_mut(place..place + PREAMBLE_BYTES) {
                place.copy_from_slice(&preamble.to_bytes());
            }
            if sealer.seal(lane, next.stream, out, start).is_err() {
                // Only a worn-out incarnation cannot seal: it sends nothing more.
                out.truncate(start);
            }
            self.head += next.len;
            self.closed.pop_front();
            if len < first {
                break;
            }
        }
        self.compact();
        if out.is_empty() { 0 } else { first }
    }

    fn compact(&mut self) {
        if self.is_empty() {
            self.bytes.clear();
            self.head = 0;
        } else if self.head > COMPACT_BYTES {
            self.bytes.drain(..self.head);
            if let Some(open) = &mut self.open {
                open.start -= self.head;
            }
            self.head = 0;
        }
    }
}

/// A datagram is padded by at most this share of its length.
const PADDED_SHARE: usize = 16;
/// Bytes that may wait in one lane. Samples and fragments are only taken while there is less than a quarter of it, so this
/// bounds what tells a reader of samples that it will not get.
const QUEUE_BYTES: usize = 1 << 20;
/// How much may have left a queue before what waits moves to the front of its buffer.
const COMPACT_BYTES: usize = 65_536;
