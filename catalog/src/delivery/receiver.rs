//! The receiving half: one machine for all streams that this host reads.

use std::collections::{BTreeMap, VecDeque};
use std::ops::Range;
use std::time::Duration;

use ddx_wire::sample::{Record, Records, SampleMeta};
use ddx_wire::seal::{Header, KeyId, MIXED_STREAMS, Opener, Refused, RefusedCounts};
use ddx_wire::{Epoch, Seq, StreamId, Tag, Time};

use super::books::{Books, Failure, Ledger, Standing};
use super::deadlines::Deadlines;
use super::early::Early;
use super::reassembly::Reassembly;
use super::{Received, ReceiverEvent, TimerName};

/// Identity and limits of a [`Receiver`].
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ReceiverConfig {
    /// This host's own tag, whose datagrams come back by multicast.
    pub own: Tag,
    /// The domain key's public id.
    pub key: KeyId,
    /// Most bytes of incomplete samples, and again of whole ones that the driver has not taken.
    pub budget_bytes: usize,
    /// Most streams expected at a time.
    pub max_streams: usize,
}

/// Opens datagrams and hands out the samples that are newer than all before, stream by stream.
#[derive(Debug)]
pub struct Receiver {
    config: ReceiverConfig,
    sessions: BTreeMap<Tag, Opener>,
    streams: BTreeMap<(Tag, StreamId), Stream>,
    reassembly: Reassembly,
    early: Early,
    quiet: Deadlines<(Tag, StreamId)>,
    events: VecDeque<(Tag, StreamId)>,
    on_group: VecDeque<(Tag, StreamId)>,
    /// Payloads of the samples in `ready`, back to back.
    inbox: Vec<u8>,
    ready: VecDeque<Ready>,
    counters: ReceiverCounters,
}

/// What a [`Receiver`] has seen, beside the books of each stream.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ReceiverCounters {
    /// Datagrams opened.
    pub datagrams: u64,
    /// Their bytes, headers and seals included.
    pub bytes: u64,
    /// Datagrams dropped, by reason.
    pub refused: RefusedCounts,
    /// Records of streams that nobody here reads: by multicast beside others, or by unicast after the last reader left.
    pub unwanted_records: u64,
    /// Streams not expected because there were too many: their readers get nothing.
    pub refused_streams: u64,
}

#[derive(Debug, Default)]
struct Stream {
    ledger: Ledger,
    last_new: Time,
    /// When it was last told that this stream arrives by multicast.
    told_on_group: Option<Time>,
    /// What waits for it in the queue of events.
    telling: Option<Telling>,
    /// When it was last told what is held.
    told_held: Time,
}

/// Why it is told what is held of a stream.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Telling {
    Flows,
    Quiet,
}

#[derive(Debug)]
struct Ready {
    tag: Tag,
    stream: StreamId,
    meta: SampleMeta,
    payload: Range<usize>,
}

impl Receiver {
    /// Makes a receiver that knows no sender.
    pub fn new(config: ReceiverConfig) -> Self {
        Self {
            reassembly: Reassembly::new(config.budget_bytes),
            config,
            early: Early::default(),
            sessions: BTreeMap::new(),
            streams: BTreeMap::new(),
            quiet: Deadlines::new(),
            events: VecDeque::new(),
            on_group: VecDeque::new(),
            inbox: Vec::new(),
            ready: VecDeque::new(),
            counters: ReceiverCounters::default(),
        }
    }

    /// Accepts data of a sender that answered a challenge. A session that exists is kept, and so its replay window.
    pub fn session(&mut self, tag: Tag, opener: Opener) {
        self.sessions.entry(tag).or_insert(opener);
    }

    /// Accepts no more data of a sender. What its streams hold is kept until [`Receiver::forget`].
    pub fn drop_session(&mut self, tag: Tag) {
        self.sessions.remove(&tag);
    }

    /// Expects a stream of a sender, and takes what came of it in the last second, before it was expected. One over the
    /// limit is not expected, and counted.
    pub fn listen(&mut self, tag: Tag, stream: StreamId, now: Time) {
        let known = self.streams.contains_key(&(tag, stream));
        if !known && self.streams.len() >= self.config.max_streams {
            self.counters.refused_streams += 1;
            return;
        }
        self.streams.entry((tag, stream)).or_default();
        if self.ready.is_empty() {
            self.inbox.clear();
        }
        for bytes in self.early.take(tag, stream, now) {
            for record in Records::new(&bytes).map_while(Result::ok) {
                self.take(tag, &record, false, now);
            }
        }
    }

    /// Expects a stream no more, and forgets its order and its books.
    pub fn forget(&mut self, tag: Tag, stream: StreamId) {
        self.streams.remove(&(tag, stream));
        self.quiet.clear((tag, stream));
        self.reassembly.forget(tag, stream);
    }

    /// Takes a datagram from the network, by multicast or not. Never fails: what is not to be used is counted.
    pub fn handle_datagram(&mut self, datagram: &mut [u8], by_group: bool, now: Time) {
        if self.ready.is_empty() {
            self.inbox.clear();
        }
        let len = datagram.len() as u64;
        match self.accept(datagram, by_group, now) {
            Ok(()) => {
                self.counters.datagrams += 1;
                self.counters.bytes += len;
            }
            Err(reason) => self.counters.refused.count(reason),
        }
    }

    /// Does what has come due.
    pub fn handle_timeout(&mut self, now: Time) {
        while let Some((tag, id, meta)) = self.reassembly.expire(now) {
            if let Some(stream) = self.streams.get_mut(&(tag, id)) {
                stream.ledger.fail(&meta, Failure::Expired);
            }
        }
        while let Some((tag, id)) = self.quiet.pop(now) {
            let Some(stream) = self.streams.get_mut(&(tag, id)) else {
                continue;
            };
            let at = stream.last_new + QUIET;
            if at <= now {
                stream.tell(Telling::Quiet, (tag, id), now, &mut self.events);
                continue;
            }
            self.quiet.set((tag, id), at);
            if now.since(stream.told_held) >= FLOWS_PERIOD {
                stream.tell(Telling::Flows, (tag, id), now, &mut self.events);
            }
        }
    }

    /// The next sample, in order of arrival; of each stream only ever newer ones.
    pub fn poll_sample(&mut self) -> Option<Received<'_>> {
        let ready = self.ready.pop_front()?;
        Some(Received {
            tag: ready.tag,
            stream: ready.stream,
            meta: ready.meta,
            payload: self.inbox.get(ready.payload)?,
        })
    }

    /// The next thing to tell a sender.
    pub fn poll_event(&mut self) -> Option<ReceiverEvent> {
        if let Some((tag, stream)) = self.on_group.pop_front() {
            return Some(ReceiverEvent::OnGroup { tag, stream });
        }
        while let Some((tag, id)) = self.events.pop_front() {
            let Some(stream) = self.streams.get_mut(&(tag, id)) else {
                continue;
            };
            let telling = stream.telling.take();
            if let (Some(telling), Some((epoch, seq))) = (telling, stream.ledger.newest()) {
                let stream = id;
                return Some(match telling {
                    Telling::Quiet => ReceiverEvent::Quiet {
                        tag,
                        stream,
                        epoch,
                        seq,
                    },
                    Telling::Flows => ReceiverEvent::Flows {
                        tag,
                        stream,
                        epoch,
                        seq,
                    },
                });
            }
        }
        None
    }

    /// When and why to call [`Receiver::handle_timeout`].
    pub fn poll_timeout(&self) -> Option<(Time, TimerName)> {
        let quiet = self.quiet.first().map(|at| (at, TimerName::Quiet));
        let reassembly = self.reassembly.deadline();
        let reassembly = reassembly.map(|at| (at, TimerName::Reassembly));
        quiet
            .into_iter()
            .chain(reassembly)
            .min_by_key(|(at, _)| *at)
    }

    /// Epoch and number of the newest sample of a stream, for renewals.
    pub fn newest(&self, tag: Tag, stream: StreamId) -> Option<(Epoch, Seq)> {
        self.streams.get(&(tag, stream))?.ledger.newest()
    }

    /// The books of an expected stream.
    pub fn books(&self, tag: Tag, stream: StreamId) -> Option<Books> {
        let stream = self.streams.get(&(tag, stream))?;
        Some(stream.ledger.books())
    }

    /// Totals since the start.
    pub fn counters(&self) -> ReceiverCounters {
        self.counters
    }

    fn accept(&mut self, datagram: &mut [u8], by_group: bool, now: Time) -> Result<(), Refused> {
        let header = Header::parse(datagram)?;
        if header.key != self.config.key {
            return Err(Refused::Foreign);
        }
        if header.sender == self.config.own {
            return Err(Refused::Own);
        }
        let tag = header.sender;
        let session = self.sessions.get_mut(&tag).ok_or(Refused::UnknownSender)?;
        // Streams hash into few groups, so many multicast datagrams are for others: they cost no decryption.
        let single = header.stream != MIXED_STREAMS;
        if single && by_group && !self.streams.contains_key(&(tag, header.stream)) {
            return Err(Refused::Unwanted);
        }
        let plaintext: &[u8] = session.open(datagram)?.plaintext;
        if plaintext.is_empty() {
            return Err(Refused::Malformed);
        }
        for record in Records::new(plaintext) {
            let record = record.map_err(|_| Refused::Malformed)?;
            if single && record.stream != header.stream {
                return Err(Refused::Malformed);
            }
            self.take(tag, &record, by_group, now);
        }
        Ok(())
    }

    fn take(&mut self, tag: Tag, record: &Record<'_>, by_group: bool, now: Time) {
        let Some(stream) = self.streams.get_mut(&(tag, record.stream)) else {
            if by_group {
                self.counters.unwanted_records += 1;
            } else {
                self.counters.unwanted_records += self.early.keep(tag, record, now);
            }
            return;
        };
        // Also for what came by unicast before: the sender wants to know which way works.
        if by_group
            && stream
                .told_on_group
                .is_none_or(|told| now.since(told) >= ON_GROUP_PERIOD)
        {
            stream.told_on_group = Some(now);
            self.on_group.push_back((tag, record.stream));
        }
        match stream.ledger.judge(&record.meta) {
            Standing::Newer => {}
            Standing::Again => {
                // The sender repeats what is held already: its confirmation was lost.
                if record.repeat {
                    let key = (tag, record.stream);
                    stream.tell(Telling::Quiet, key, now, &mut self.events);
                }
                return;
            }
            Standing::Old => return,
        }
        let Some(fragment) = record.fragment else {
            self.deliver(tag, record, &record.meta, record.payload, now);
            return;
        };
        let step = self.reassembly.insert(tag, record, fragment, now);
        if let Some((meta, failure)) = step.failed {
            stream.ledger.fail(&meta, failure);
        }
        if let Some((meta, payload)) = step.whole {
            self.deliver(tag, record, &meta, &payload, now);
        }
    }

    /// Queues a whole sample that is newer than all before.
    fn deliver(
        &mut self,
        tag: Tag,
        record: &Record<'_>,
        meta: &SampleMeta,
        payload: &[u8],
        now: Time,
    ) {
        let id = record.stream;
        let Some(stream) = self.streams.get_mut(&(tag, id)) else {
            return;
        };
        let start = self.inbox.len();
        let waiting = start + self.ready.len() * size_of::<Ready>();
        if waiting + payload.len() > self.config.budget_bytes {
            stream.ledger.fail(meta, Failure::OverBudget);
            return;
        }
        if let Some(pending) = self.reassembly.pass(tag, id, meta) {
            stream.ledger.fail(&pending, Failure::Expired);
        }
        stream.ledger.deliver(meta);
        stream.last_new = now;
        self.inbox.extend_from_slice(payload);
        self.ready.push_back(Ready {
            tag,
            stream: id,
            meta: *meta,
            payload: start..self.inbox.len(),
        });
        if record.repeat {
            // The sender waits for this confirmation with its next repeat.
            stream.tell(Telling::Quiet, (tag, id), now, &mut self.events);
        } else {
            self.quiet.set_if_idle((tag, id), now + QUIET);
        }
    }
}

impl Stream {
    fn tell(
        &mut self,
        why: Telling,
        key: (Tag, StreamId),
        now: Time,
        events: &mut VecDeque<(Tag, StreamId)>,
    ) {
        self.told_held = now;
        if self.telling.is_none() {
            events.push_back(key);
        }
        self.telling = self.telling.max(Some(why));
    }
}

impl ReceiverConfig {
    /// The default limits for the host with this tag, in the domain of this key.
    pub fn new(own: Tag, key: KeyId) -> Self {
        Self {
            own,
            key,
            budget_bytes: 8 << 20,
            max_streams: 16_384,
        }
    }
}

/// Arrival by multicast is told again so often: a path may have changed meanwhile.
const ON_GROUP_PERIOD: Duration = Duration::from_millis(200);

/// What is held of a stream that never falls quiet is told so often: in time for each renewal.
const FLOWS_PERIOD: Duration = Duration::from_millis(500);

/// `PROTOCOL.md#acks-and-repeats`: a stream is quiet 100 ms after its last new sample.
const QUIET: Duration = Duration::from_millis(100);
