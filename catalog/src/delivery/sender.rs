//! The sending half: one machine for all streams that leave this host.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::net::SocketAddr;
use std::time::Duration;

use ddx_wire::sample::{MAX_SAMPLE_BYTES, Record, SampleMeta};
use ddx_wire::seal::{Lane, MAX_DATAGRAM_BYTES, Sealer};
use ddx_wire::{Epoch, Seq, StreamId, Tag, Time};

use super::deadlines::Deadlines;
use super::outbox::Outbox;
use super::pace::Pace;
use super::{Due, Path, ReaderHost, Route, SenderEvent, TimerName, Transmit, key};

/// Limits of a [`Sender`].
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SenderConfig {
    /// Greatest datagram, header and seal included, bytes.
    pub datagram_bytes: usize,
    /// Most datagrams in one transmit, at most 64: what one segmented send of the driver's socket takes.
    pub segments_max: usize,
    /// How long a datagram may wait for company when the driver does not [`Sender::flush`].
    pub coalesce: Duration,
    /// Rate over all destinations, bytes per second; `None` leaves pacing to the link.
    pub pace_bytes_per_second: Option<u64>,
    /// Most bytes that wait to be sent; samples beyond are dropped and counted, and repaired as last values.
    pub queue_bytes: usize,
    /// Most streams open at a time.
    pub max_streams: usize,
}

/// Sends samples to the hosts that read them, each once, and repeats the last one until it is confirmed.
#[derive(Debug)]
pub struct Sender {
    config: SenderConfig,
    sealer: Sealer,
    streams: BTreeMap<StreamId, Stream>,
    outbox: Outbox,
    pace: Pace,
    round_trips: BTreeMap<Tag, Duration>,
    repeats: Deadlines<StreamId>,
    events: VecDeque<(StreamId, Tag)>,
    counters: SenderCounters,
    now: Time,
}

/// What a [`Sender`] has done.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SenderCounters {
    /// Datagrams handed to the driver.
    pub datagrams: u64,
    /// Their bytes, headers and seals included.
    pub bytes: u64,
    /// Streams not opened because there were too many: their readers get nothing.
    pub refused_streams: u64,
}

/// What a [`Sender`] has done for one stream.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct StreamCounters {
    /// Samples queued for sending, each counted once however many hosts read.
    pub sent: u64,
    /// Copies of a sample that found no room in the queue: the link is slower than the stream.
    pub queue_dropped: u64,
    /// Samples over 64 KiB, which are not sent.
    pub too_large: u64,
    /// Repeats queued: growth beyond one for each new reader means loss.
    pub repeats: u64,
}

#[derive(Debug)]
struct Stream {
    interval: Duration,
    next_due: Time,
    readers: Vec<Reader>,
    destinations: Vec<SocketAddr>,
    newest: Option<(Epoch, Seq)>,
    counters: StreamCounters,
}

#[derive(Debug)]
struct Reader {
    host: ReaderHost,
    sent: Option<(Epoch, Seq)>,
    sent_at: Time,
    held: Option<(Epoch, Seq)>,
    repeats: u32,
    repeat_asked_at: Option<Time>,
    /// A [`SenderEvent::Repeat`] for it waits in the queue of events.
    wanting: bool,
}

impl Sender {
    /// Makes a sender without streams. `sealer` is the data sealer of this incarnation.
    pub fn new(config: SenderConfig, sealer: Sealer, now: Time) -> Self {
        Self {
            outbox: Outbox::new(&config),
            pace: Pace::new(config.pace_bytes_per_second, now),
            config,
            sealer,
            streams: BTreeMap::new(),
            round_trips: BTreeMap::new(),
            repeats: Deadlines::new(),
            events: VecDeque::new(),
            counters: SenderCounters::default(),
            now,
        }
    }

    /// Opens a stream, and asks for its present value for every reader. An open stream is updated.
    ///
    /// A stream over the limit is not opened, and counted.
    pub fn open(&mut self, id: StreamId, route: Route, now: Time) {
        if !self.streams.contains_key(&id) && self.streams.len() >= self.config.max_streams {
            self.counters.refused_streams += 1;
            return;
        }
        let stream = self.streams.entry(id).or_insert_with(|| Stream {
            interval: Duration::ZERO,
            next_due: now,
            readers: Vec::new(),
            destinations: Vec::new(),
            newest: None,
            counters: StreamCounters::default(),
        });
        stream.reroute(route, now);
        for reader in &mut stream.readers {
            if reader.sent.is_none() && reader.repeat_asked_at.is_none() {
                reader.wanting = true;
                reader.repeat_asked_at = Some(now);
                self.events.push_back((id, reader.host.tag));
            }
        }
        self.outbox.prune();
    }

    /// Changes an open stream's route; readers that stay keep their state, new ones are sent the present value.
    pub fn update(&mut self, id: StreamId, route: Route, now: Time) {
        if self.streams.contains_key(&id) {
            self.open(id, route, now);
        }
    }

    /// Closes a stream; what is queued already still leaves.
    pub fn close(&mut self, id: StreamId) {
        self.streams.remove(&id);
        self.repeats.clear(id);
        self.events.retain(|(stream, _)| *stream != id);
        let tags: BTreeSet<Tag> = self.streams.values().flat_map(Stream::tags).collect();
        self.round_trips.retain(|tag, _| tags.contains(tag));
        self.outbox.prune();
    }

    /// Tells when the stream's contract admits its next sample. A stream that is not open is due at once.
    pub fn due(&self, id: StreamId, now: Time) -> Due {
        match self.streams.get(&id) {
            Some(stream) if stream.next_due > now => Due::At(stream.next_due),
            Some(_) | None => Due::Now,
        }
    }

    /// Queues a sample for every reader. One that is not newer than the last is ignored.
    ///
    /// The driver keeps the contract by asking [`Sender::due`] first, and counts what it leaves out in `meta.filtered`.
    /// One over 64 KiB is dropped and counted, and one of a stream that is not open is ignored.
    pub fn write(&mut self, id: StreamId, meta: &SampleMeta, payload: &[u8], now: Time) {
        self.now = now;
        let Some(stream) = self.streams.get_mut(&id) else {
            return;
        };
        if !stream.admits(payload) {
            return;
        }
        let newest = Some(key(meta));
        if newest <= stream.newest {
            return;
        }
        stream.newest = newest;
        stream.counters.sent += 1;
        stream.advance_due(now);
        let record = record(id, meta, payload, false);
        let lane = if self.outbox.fragments(payload.len()) {
            Lane::Bulk
        } else {
            Lane::Values
        };
        for to in &stream.destinations {
            if self.outbox.push(lane, *to, &record, now).is_err() {
                stream.counters.queue_dropped += 1;
            }
        }
        for reader in &mut stream.readers {
            reader.sent = newest;
            reader.sent_at = now;
            reader.repeats = 0;
            // The value that the reader wanted is on its way.
            reader.wanting = false;
        }
        if !stream.readers.is_empty() {
            self.repeats.set_if_idle(id, now + REPEAT_FIRST);
        }
    }

    /// Queues the stream's present value for one reader, as [`SenderEvent::Repeat`] asked.
    /// Ignored if the stream or the reader is gone meanwhile.
    pub fn repeat(&mut self, id: StreamId, to: Tag, meta: &SampleMeta, payload: &[u8], now: Time) {
        self.now = now;
        let Some(stream) = self.streams.get_mut(&id) else {
            return;
        };
        if !stream.admits(payload) {
            return;
        }
        let Some(reader) = stream.readers.iter_mut().find(|r| r.host.tag == to) else {
            return;
        };
        let record = record(id, meta, payload, true);
        stream.counters.repeats += 1;
        let pushed = self
            .outbox
            .push(Lane::Commands, reader.host.addr, &record, now);
        if pushed.is_err() {
            stream.counters.queue_dropped += 1;
        }
        if Some(key(meta)) > reader.sent {
            reader.sent = Some(key(meta));
            reader.sent_at = now;
            reader.repeats = 0;
        }
        self.repeats.set_if_idle(id, now + REPEAT_NEXT);
    }

    /// Learns what a reader holds, from its confirmation or its renewal.
    pub fn held(&mut self, id: StreamId, tag: Tag, epoch: Epoch, seq: Seq, now: Time) {
        self.now = now;
        let first = self.first_repeat_after(tag);
        let Some(stream) = self.streams.get_mut(&id) else {
            return;
        };
        let Some(reader) = stream.readers.iter_mut().find(|r| r.host.tag == tag) else {
            return;
        };
        reader.held = reader.held.max(Some((epoch, seq)));
        let overdue = now >= reader.sent_at + first
            && reader
                .repeat_asked_at
                .is_none_or(|asked| now >= asked + REPEAT_NEXT);
        if reader.is_behind() && overdue && !reader.wanting {
            // It is there, perhaps again: one repeat might be lost, or a fragment of it.
            reader.repeats = reader.repeats.min(REPEAT_LIMIT - REPEATS_AGAIN);
            reader.wanting = true;
            reader.repeat_asked_at = Some(now);
            self.events.push_back((id, tag));
        }
    }

    /// Learns the round-trip time to a host: repeats to it wait that much longer for its confirmation.
    ///
    /// Until told, 50 ms are assumed. Ignored for a host that reads nothing.
    pub fn round_trip(&mut self, tag: Tag, time: Duration) {
        if self
            .streams
            .values()
            .flat_map(Stream::tags)
            .any(|t| t == tag)
        {
            self.round_trips.insert(tag, time.min(ROUND_TRIP_MAX));
        }
    }

    /// Lets coalesced datagrams go: the driver has no more samples in hand.
    pub fn flush(&mut self, now: Time) {
        self.now = now;
        self.outbox.close_all();
    }

    /// Does what has come due.
    pub fn handle_timeout(&mut self, now: Time) {
        self.now = now;
        let waited = self.outbox.open_since().map(|t| t + self.config.coalesce);
        if waited.is_some_and(|at| at <= now) {
            self.outbox.close_all();
        }
        while let Some(id) = self.repeats.pop(now) {
            self.ask_repeats(id, now);
        }
    }

    /// Replaces `out` by the next datagrams to send; `None` when there are none, or the pace forbids.
    pub fn poll_transmit(&mut self, out: &mut Vec<u8>) -> Option<Transmit> {
        if self.pace.blocked_until(self.now).is_some() {
            return None;
        }
        let limit = self.pace.batch_bytes();
        let transmit = self.outbox.pop(&mut self.sealer, limit, out)?;
        self.pace.spend(out.len(), self.now);
        let segment = transmit.segment.map_or(out.len(), usize::from);
        self.counters.datagrams += out.len().div_ceil(segment) as u64;
        self.counters.bytes += out.len() as u64;
        Some(transmit)
    }

    /// When and why to call [`Sender::handle_timeout`].
    pub fn poll_timeout(&self) -> Option<(Time, TimerName)> {
        let coalesce = self.outbox.open_since().map(|t| t + self.config.coalesce);
        let pace = self
            .outbox
            .is_ready()
            .then(|| self.pace.blocked_until(self.now).unwrap_or(self.now));
        let repeat = self.repeats.first();
        [
            coalesce.map(|at| (at, TimerName::Coalesce)),
            pace.map(|at| (at, TimerName::Pace)),
            repeat.map(|at| (at, TimerName::Repeat)),
        ]
        .into_iter()
        .flatten()
        .min_by_key(|(at, _)| *at)
    }

    /// The next request to the driver.
    pub fn poll_event(&mut self) -> Option<SenderEvent> {
        while let Some((stream, to)) = self.events.pop_front() {
            let readers = self.streams.get_mut(&stream).map(|s| &mut s.readers);
            let reader = readers.and_then(|r| r.iter_mut().find(|r| r.host.tag == to));
            if reader.is_some_and(|reader| std::mem::take(&mut reader.wanting)) {
                return Some(SenderEvent::Repeat { stream, to });
            }
        }
        None
    }

    /// Totals since the start.
    pub fn counters(&self) -> SenderCounters {
        self.counters
    }

    /// Totals of an open stream.
    pub fn stream_counters(&self, id: StreamId) -> Option<StreamCounters> {
        self.streams.get(&id).map(|stream| stream.counters)
    }

    fn ask_repeats(&mut self, id: StreamId, now: Time) {
        let Some(stream) = self.streams.get_mut(&id) else {
            return;
        };
        let mut next: Option<Time> = None;
        for reader in &mut stream.readers {
            if !reader.is_behind() || reader.repeats >= REPEAT_LIMIT {
                continue;
            }
            let round_trip = self.round_trips.get(&reader.host.tag);
            let first = REPEAT_FIRST + round_trip.copied().unwrap_or(ROUND_TRIP_UNKNOWN);
            let mut at = reader.sent_at + first;
            if let Some(asked) = reader.repeat_asked_at {
                at = at.max(asked + REPEAT_NEXT);
            }
            if at <= now {
                reader.repeats += 1;
                reader.repeat_asked_at = Some(now);
                at = now + REPEAT_NEXT;
                if !reader.wanting {
                    reader.wanting = true;
                    self.events.push_back((id, reader.host.tag));
                }
            }
            next = Some(next.map_or(at, |other| other.min(at)));
        }
        if let Some(at) = next {
            self.repeats.set(id, at);
        }
    }

    fn first_repeat_after(&self, tag: Tag) -> Duration {
        let round_trip = self.round_trips.get(&tag).copied();
        REPEAT_FIRST + round_trip.unwrap_or(ROUND_TRIP_UNKNOWN)
    }
}

impl Stream {
    fn reroute(&mut self, route: Route, now: Time) {
        self.interval = Duration::from_nanos(route.contract.interval_ns());
        self.next_due = self.next_due.min(now + self.interval);
        let mut old = std::mem::take(&mut self.readers);
        for host in route.readers.into_iter().take(MAX_READERS) {
            let kept = old.iter().position(|reader| reader.host.tag == host.tag);
            let reader = kept.map_or_else(|| Reader::new(host, now), |at| old.swap_remove(at));
            self.readers.push(Reader { host, ..reader });
        }
        let unicast = self.readers.iter().map(|reader| reader.host.addr);
        let addresses: BTreeSet<SocketAddr> = match route.path {
            Path::Unicast => unicast.collect(),
            Path::Multicast(group) => BTreeSet::from([group]),
            Path::Both(group) => unicast.chain([group]).collect(),
        };
        self.destinations = addresses.into_iter().collect();
    }

    /// Tells whether a sample fits the protocol, and counts one that does not.
    fn admits(&mut self, payload: &[u8]) -> bool {
        let fits = payload.len() <= MAX_SAMPLE_BYTES;
        if !fits {
            self.counters.too_large += 1;
        }
        fits
    }

    fn advance_due(&mut self, now: Time) {
        // A source at just the contract's rate may be late once and on time again; more than one interval is no credit.
        let base = if now.since(self.next_due) < self.interval {
            self.next_due
        } else {
            now
        };
        self.next_due = base + self.interval;
    }

    fn tags(&self) -> impl Iterator<Item = Tag> + '_ {
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
            wanting: false,
        }
    }

    fn is_behind(&self) -> bool {
        self.held < self.sent
    }
}

impl Default for SenderConfig {
    fn default() -> Self {
        Self {
            datagram_bytes: MAX_DATAGRAM_BYTES,
            segments_max: 64,
            coalesce: Duration::ZERO,
            pace_bytes_per_second: None,
            queue_bytes: 4 << 20,
            max_streams: 16_384,
        }
    }
}

fn record<'a>(stream: StreamId, meta: &SampleMeta, payload: &'a [u8], repeat: bool) -> Record<'a> {
    Record {
        stream,
        repeat,
        meta: *meta,
        fragment: None,
        payload,
    }
}

/// `PROTOCOL.md#acks-and-repeats`: a reader confirms 100 ms after the last sample, in a packet that may wait 20 ms for
/// others; 10 ms more are for the two schedulers. The round trip comes on top.
const REPEAT_FIRST: Duration = Duration::from_millis(130);
/// Time between repeats: sixteen of them within a second.
const REPEAT_NEXT: Duration = Duration::from_millis(60);
/// Repeats before the reader's renewals, once a second, take over.
const REPEAT_LIMIT: u32 = 15;
/// Repeats for each renewal of a reader that is still behind.
const REPEATS_AGAIN: u32 = 8;
/// Assumed until measured: more than a LAN or a fair radio link takes.
const ROUND_TRIP_UNKNOWN: Duration = Duration::from_millis(50);
/// A peer that answers ever more slowly must not put repeats off for ever.
const ROUND_TRIP_MAX: Duration = Duration::from_secs(1);
/// Reading hosts of one stream.
const MAX_READERS: usize = 1_024;
