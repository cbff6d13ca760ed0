//! Datagrams on their way out: one queue for each lane and destination, under one byte budget.
//!
//! A queue keeps its plaintext datagrams back to back in one buffer, so that in steady state nothing is allocated for a
//! sample. They are sealed when they leave.

use std::collections::{BTreeMap, VecDeque};
use std::net::SocketAddr;

use ddx_wire::sample::{FRAGMENT_RECORD_BYTES, Fragment, RECORD_BYTES, Record};
use ddx_wire::seal::{HEADER_BYTES, Lane, MIXED_STREAMS, OVERHEAD_BYTES, SEAL_BYTES, Sealer};
use ddx_wire::{StreamId, Time};

use super::{SenderConfig, Transmit};

/// All queues of a sender.
#[derive(Debug)]
pub(super) struct Outbox {
    datagram_bytes: usize,
    segments_max: usize,
    budget_bytes: usize,
    queued_bytes: usize,
    queues: BTreeMap<(Lane, SocketAddr), Queue>,
    /// Destinations with closed datagrams, in turn, for each lane.
    ready: [VecDeque<SocketAddr>; LANES.len()],
    /// Queues with an open datagram.
    open: Vec<(Lane, SocketAddr)>,
    /// When the first of those was opened.
    open_since: Option<Time>,
}

/// There was no room for the sample in the byte budget.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct Full;

#[derive(Debug, Default)]
struct Queue {
    bytes: Vec<u8>,
    /// Where the first datagram that has not left begins.
    head: usize,
    closed: VecDeque<Closed>,
    open: Option<Open>,
    in_ready: bool,
    in_open: bool,
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
}

impl Outbox {
    pub(super) fn new(config: &SenderConfig) -> Self {
        Self {
            // Room for at least one payload byte of a fragment, whatever the configuration says.
            datagram_bytes: config
                .datagram_bytes
                .max(OVERHEAD_BYTES + FRAGMENT_RECORD_BYTES + 1),
            segments_max: config.segments_max.clamp(1, BATCH_SEGMENTS),
            budget_bytes: config.queue_bytes,
            queued_bytes: 0,
            queues: BTreeMap::new(),
            ready: Default::default(),
            open: Vec::new(),
            open_since: None,
        }
    }

    /// Tells whether a sample of this length is sent in fragments.
    pub(super) fn fragments(&self, len: usize) -> bool {
        OVERHEAD_BYTES + RECORD_BYTES + len > self.datagram_bytes
    }

    /// Queues a whole sample, in as many fragments as it needs. It goes in full or not at all.
    pub(super) fn push(
        &mut self,
        lane: Lane,
        to: SocketAddr,
        sample: &Record<'_>,
        now: Time,
    ) -> Result<(), Full> {
        if !self.fragments(sample.payload.len()) {
            let cost = OVERHEAD_BYTES + sample.encoded_len();
            self.admit(cost)?;
            self.push_record(lane, to, sample, now);
            return Ok(());
        }
        let room = self.datagram_bytes - OVERHEAD_BYTES - FRAGMENT_RECORD_BYTES;
        let count = sample.payload.len().div_ceil(room);
        self.admit(count * (OVERHEAD_BYTES + FRAGMENT_RECORD_BYTES) + sample.payload.len())?;
        let total = u32::try_from(sample.payload.len()).map_err(|_| Full)?;
        let mut offset = 0;
        for payload in sample.payload.chunks(room) {
            let fragment = Some(Fragment { total, offset });
            self.close(lane, to);
            self.push_record(
                lane,
                to,
                &Record {
                    fragment,
                    payload,
                    ..*sample
                },
                now,
            );
            offset += u32::try_from(payload.len()).map_err(|_| Full)?;
        }
        self.close(lane, to);
        Ok(())
    }

    /// Closes every open datagram: they wait for no more company.
    pub(super) fn close_all(&mut self) {
        let mut open = std::mem::take(&mut self.open);
        for (lane, to) in open.drain(..) {
            if let Some(queue) = self.queues.get_mut(&(lane, to)) {
                queue.in_open = false;
            }
            self.close(lane, to);
        }
        // Puts the list's memory back.
        self.open = open;
        self.open_since = None;
    }

    /// When the oldest open datagram was opened.
    pub(super) fn open_since(&self) -> Option<Time> {
        self.open_since
    }

    /// Tells whether a datagram is closed and may leave.
    pub(super) fn is_ready(&self) -> bool {
        self.ready
            .iter()
            .any(|destinations| !destinations.is_empty())
    }

    /// Seals the next batch into `out`: equal datagrams of one lane to one destination, the last perhaps shorter.
    ///
    /// At most as many as the configuration says and `limit_bytes`, but at least one.
    pub(super) fn pop(
        &mut self,
        sealer: &mut Sealer,
        limit_bytes: usize,
        out: &mut Vec<u8>,
    ) -> Option<Transmit> {
        out.clear();
        let lane = LANES.into_iter().zip(&mut self.ready);
        let (lane, ready) = lane.into_iter().find(|(_, ready)| !ready.is_empty())?;
        let to = ready.pop_front()?;
        let queue = self.queues.get_mut(&(lane, to))?;
        let limit = limit_bytes.min(BATCH_BYTES);
        let mut segment = None;
        for _ in 0..self.segments_max {
            let Some(next) = queue.closed.front() else {
                break;
            };
            let len = next.len + SEAL_BYTES;
            let first = *segment.get_or_insert(len);
            if !out.is_empty() && (len > first || out.len() + len > limit) {
                break;
            }
            let start = out.len();
            out.extend_from_slice(queue.bytes.get(queue.head..queue.head + next.len)?);
            if sealer.seal(lane, next.stream, out, start).is_err() {
                // Only a worn-out incarnation cannot seal: it sends nothing more.
                out.truncate(start);
            }
            self.queued_bytes = self.queued_bytes.saturating_sub(len);
            queue.head += next.len;
            queue.closed.pop_front();
            if len < first {
                break;
            }
        }
        queue.compact();
        queue.in_ready = !queue.closed.is_empty();
        if queue.in_ready {
            ready.push_back(to);
        }
        let segment = segment.filter(|first| out.len() > *first);
        let segment = segment.and_then(|first| u16::try_from(first).ok());
        (!out.is_empty()).then_some(Transmit { to, segment })
    }

    /// Gives back the memory of destinations that nothing waits for.
    pub(super) fn prune(&mut self) {
        self.queues
            .retain(|_, queue| queue.open.is_some() || queue.in_open || !queue.closed.is_empty());
    }

    fn admit(&self, bytes: usize) -> Result<(), Full> {
        if self.queued_bytes + bytes > self.budget_bytes {
            return Err(Full);
        }
        Ok(())
    }

    fn push_record(&mut self, lane: Lane, to: SocketAddr, record: &Record<'_>, now: Time) {
        let len = record.encoded_len();
        let queue = self.queues.entry((lane, to)).or_default();
        let full = queue.open.as_ref().is_some_and(|open| {
            queue.bytes.len() - open.start + len + SEAL_BYTES > self.datagram_bytes
        });
        if full {
            self.close(lane, to);
        }
        let queue = self.queues.entry((lane, to)).or_default();
        match &mut queue.open {
            Some(open) if open.stream == record.stream => {}
            Some(open) => open.stream = MIXED_STREAMS,
            None => {
                let start = queue.bytes.len();
                queue.bytes.resize(start + HEADER_BYTES, 0);
                self.queued_bytes += OVERHEAD_BYTES;
                queue.open = Some(Open {
                    start,
                    stream: record.stream,
                });
            }
        }
        if !queue.in_open {
            queue.in_open = true;
            self.open.push((lane, to));
            self.open_since.get_or_insert(now);
        }
        if record.encode(&mut queue.bytes).is_ok() {
            self.queued_bytes += len;
        }
    }

    fn close(&mut self, lane: Lane, to: SocketAddr) {
        let Some(queue) = self.queues.get_mut(&(lane, to)) else {
            return;
        };
        let Some(open) = queue.open.take() else {
            return;
        };
        queue.closed.push_back(Closed {
            len: queue.bytes.len() - open.start,
            stream: open.stream,
        });
        if !queue.in_ready {
            queue.in_ready = true;
            for (each, ready) in LANES.into_iter().zip(&mut self.ready) {
                if each == lane {
                    ready.push_back(to);
                }
            }
        }
    }
}

impl Queue {
    fn compact(&mut self) {
        if self.closed.is_empty() && self.open.is_none() {
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

/// The lanes of samples, most urgent first.
const LANES: [Lane; 3] = [Lane::Commands, Lane::Values, Lane::Bulk];
/// `PROTOCOL.md#limits`: what one segmented send of the kernel takes.
const BATCH_SEGMENTS: usize = 64;
const BATCH_BYTES: usize = 60_000;
/// How much may have left a queue before what waits moves to the front of its buffer.
const COMPACT_BYTES: usize = 65_536;
