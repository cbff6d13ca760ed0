//! The receiving half: one machine for all streams that this host reads.

use std::borrow::Cow;
use std::collections::{BTreeMap, VecDeque};
use std::ops::Range;
use std::time::Duration;

use ddx_wire::message::{Lacks, NACK_PARTS_MAX, NackEntry, ReportEntry};
use ddx_wire::sample::{Record, Records, SampleMeta};
use ddx_wire::seal::{Header, KeyId, MIXED_STREAMS, Opener, Refused, RefusedCounts};
use ddx_wire::{Contract, Delivery, Epoch, Seq, StreamId, Tag, Time};

use super::books::{Books, Failure, Ledger, Standing};
use super::deadlines::Deadlines;
use super::early::Early;
use super::order::{Next, Order, Why, cost, is_later_epoch};
use super::reassembly::{Due, Place, Reassembly, Rules};
use super::reception::Reception;
use super::{Held, Passed, Received, ReceiverEvent, TimerName, key};

/// Identity and limits of a [`Receiver`].
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ReceiverConfig {
    /// This host's own tag, whose datagrams come back by multicast.
    pub own: Tag,
    /// The domain key's public id.
    pub key: KeyId,
    /// Most bytes of incomplete samples, again of whole ones that the driver has not taken, and again of those that wait
    /// for an earlier one, each with what it takes beside its payload.
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
    reception: Reception,
    quiet: Deadlines<(Tag, StreamId)>,
    /// Streams whose order has something to ask for.
    gaps: Deadlines<(Tag, StreamId)>,
    round_trips: BTreeMap<Tag, Duration>,
    events: VecDeque<(Tag, StreamId)>,
    on_group: VecDeque<(Tag, StreamId)>,
    reports: VecDeque<(Tag, ReportEntry)>,
    nacks: VecDeque<(Tag, NackEntry)>,
    /// Payloads of the small samples in `ready`, back to back.
    inbox: Vec<u8>,
    ready_bytes: usize,
    ordered_bytes: usize,
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
    /// Requests for what is missing that found no room to wait in: they are made again later. Growth means that very much
    /// is lost, or that the driver does not collect them.
    pub dropped_nacks: u64,
    /// Records about samples that are gone, for which the byte budget had no room: what they tell is asked for again.
    pub dropped_gone: u64,
    /// Datagrams of more paths of one sender than are reported. An honest one has not so many.
    pub unreported_datagrams: u64,
}

#[derive(Debug, Default)]
struct Stream {
    ledger: Ledger,
    /// Where each sample is wanted.
    order: Option<Order>,
    /// Whether its samples came by multicast of late, so that other receivers may ask for the same.
    by_group: bool,
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
    payload: Payload,
    passed: Passed,
}

#[derive(Debug)]
enum Payload {
    Inbox(Range<usize>),
    Large(Vec<u8>),
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
            reception: Reception::new(),
            quiet: Deadlines::new(),
            gaps: Deadlines::new(),
            round_trips: BTreeMap::new(),
            events: VecDeque::new(),
            on_group: VecDeque::new(),
            reports: VecDeque::new(),
            nacks: VecDeque::new(),
            inbox: Vec::new(),
            ready_bytes: 0,
            ordered_bytes: 0,
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
        self.round_trips.remove(&tag);
        self.reception.forget(tag);
    }

    /// Learns the round-trip time to a sender: what is missing is asked for again after that. Until told, 50 ms are assumed.
    pub fn round_trip(&mut self, tag: Tag, time: Duration) {
        if self.sessions.contains_key(&tag) {
            self.round_trips.insert(tag, time.min(ROUND_TRIP_MAX));
        }
    }

    /// Expects a stream of a sender under a contract, and takes what came of it in the last second, before it was expected.
    /// One over the limit is not expected, and counted.
    pub fn listen(&mut self, tag: Tag, stream: StreamId, contract: &Contract, now: Time) {
        self.resume(tag, stream, contract, None, now);
    }

    /// The same where samples of the item are here already: it goes on with what follows the newest of them. Of another
    /// life of the owner than that one's all is new, from its beginning. Returns after which sample it goes on, if any.
    pub fn resume(
        &mut self,
        tag: Tag,
        stream: StreamId,
        contract: &Contract,
        held: Option<Held>,
        now: Time,
    ) -> Option<(Epoch, Seq)> {
        let after = held.map(|held| match held.from == tag {
            true => held.newest,
            false => (Epoch(0), Seq(0)),
        });
        let known = self.streams.contains_key(&(tag, stream));
        if !known && self.streams.len() >= self.config.max_streams {
            self.counters.refused_streams += 1;
            return after;
        }
        self.streams.entry((tag, stream)).or_insert_with(|| {
            let mut fresh = Stream {
                order: match contract.delivery {
                    Delivery::Latest => None,
                    Delivery::Every => Some(Order::new(false)),
                    Delivery::EveryFromRing => Some(Order::new(true)),
                },
                ..Stream::default()
            };
            if let Some((epoch, seq)) = after {
                fresh.ledger.resume(epoch, seq, fresh.order.is_some());
                if let Some(order) = &mut fresh.order {
                    order.resume(epoch, seq);
                }
            }
            fresh
        });
        if self.ready.is_empty() {
            self.inbox.clear();
        }
        for bytes in self.early.take(tag, stream, now) {
            for record in Records::new(&bytes).map_while(Result::ok) {
                self.take(tag, &record, false, now);
            }
        }
        after
    }

    /// Expects a stream no more, and forgets its order and its books.
    pub fn forget(&mut self, tag: Tag, stream: StreamId) {
        let order = self.streams.remove(&(tag, stream)).and_then(|s| s.order);
        self.ordered_bytes -= order.map_or(0, |order| order.held_bytes());
        self.gaps.clear((tag, stream));
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
        while let Some((place, due)) = self.reassembly.due(now) {
            match due {
                Due::Expired(meta) => {
                    if let Some(stream) = self.streams.get_mut(&(place.tag, place.stream)) {
                        stream.ledger.fail(&meta, Failure::Expired);
                    }
                }
                Due::Ask(parts) => self.ask_parts(&place, &parts),
            }
        }
        while let Some((tag, id)) = self.gaps.pop(now) {
            self.ask_samples(tag, id, now);
        }
        while let Some(report) = self.reception.report(now) {
            self.reports.push_back(report);
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
        let payload = match ready.payload {
            Payload::Inbox(range) => {
                self.ready_bytes -= range.len();
                Cow::Borrowed(self.inbox.get(range)?)
            }
            Payload::Large(bytes) => {
                self.ready_bytes -= bytes.len();
                Cow::Owned(bytes)
            }
        };
        Some(Received {
            tag: ready.tag,
            stream: ready.stream,
            meta: ready.meta,
            payload,
            passed: ready.passed,
        })
    }

    /// The next thing to tell a sender.
    pub fn poll_event(&mut self) -> Option<ReceiverEvent> {
        if let Some((tag, stream)) = self.on_group.pop_front() {
            return Some(ReceiverEvent::OnGroup { tag, stream });
        }
        if let Some((tag, nack)) = self.nacks.pop_front() {
            return Some(ReceiverEvent::Nack(tag, nack));
        }
        if let Some((tag, report)) = self.reports.pop_front() {
            return Some(ReceiverEvent::Report(tag, report));
        }
        while let Some((tag, id)) = self.events.pop_front() {
            let Some(stream) = self.streams.get_mut(&(tag, id)) else {
                continue;
            };
            let telling = stream.telling.take();
            if let (Some(telling), Some((epoch, seq))) = (telling, stream.newest()) {
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
        let order = self.gaps.first().map(|at| (at, TimerName::Order));
        let report = self.reception.deadline();
        let report = report.map(|at| (at, TimerName::Report));
        [quiet, reassembly, order, report]
            .into_iter()
            .flatten()
            .min_by_key(|(at, _)| *at)
    }

    /// Epoch and number of the newest sample of a stream, for renewals.
    pub fn newest(&self, tag: Tag, stream: StreamId) -> Option<(Epoch, Seq)> {
        self.streams.get(&(tag, stream))?.newest()
    }

    /// The books of an expected stream.
    pub fn books(&self, tag: Tag, stream: StreamId) -> Option<Books> {
        let stream = self.streams.get(&(tag, stream))?;
        Some(stream.ledger.books())
    }

    /// The books of every expected stream.
    pub fn all_books(&self) -> impl Iterator<Item = ((Tag, StreamId), Books)> {
        self.streams
            .iter()
            .map(|(key, stream)| (*key, stream.ledger.books()))
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
        let len = datagram.len();
        let plaintext: &[u8] = session.open(datagram)?.plaintext;
        let stream = single.then_some(header.stream);
        let (preamble, records) = Records::open(plaintext, stream).ok_or(Refused::Malformed)?;
        if !self.reception.note(tag, &preamble, len, now) {
            self.counters.unreported_datagrams += 1;
        }
        for record in records {
            let record = record.map_err(|_| Refused::Malformed)?;
            if single && record.stream != header.stream {
                return Err(Refused::Malformed);
            }
            self.take(tag, &record, by_group, now);
        }
        Ok(())
    }

    fn take(&mut self, tag: Tag, record: &Record<'_>, by_group: bool, now: Time) {
        let id = record.stream;
        let round_trip = self.round_trip_of(tag);
        let Some(stream) = self.streams.get_mut(&(tag, id)) else {
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
            self.on_group.push_back((tag, id));
        }
        stream.by_group = by_group || (stream.by_group && record.repeat);
        let patience = patience(self.config.own, record, stream.by_group);
        if record.gone {
            if let (Some(order), Some(count)) = (&mut stream.order, record.gone_count()) {
                if self.ordered_bytes + cost(0) > self.config.budget_bytes {
                    self.counters.dropped_gone += 1;
                    return;
                }
                let meta = &record.meta;
                let span = (Seq(meta.seq.0 - count + 1), meta.seq);
                let why = match meta.filtered {
                    0 => Why::Overwritten,
                    _ => Why::LeftOut,
                };
                let before = order.held_bytes();
                order.gone(meta.epoch, span, why, patience, now);
                self.ordered_bytes = self.ordered_bytes - before + order.held_bytes();
                self.settle(tag, id, now);
            }
            return;
        }
        match stream.ledger.judge(&record.meta) {
            Standing::Newer => {}
            Standing::Again => {
                // The sender repeats what is held already: its confirmation was lost.
                if record.repeat {
                    let key = (tag, id);
                    stream.tell(Telling::Quiet, key, now, &mut self.events);
                }
                return;
            }
            Standing::Old => return,
        }
        if let Some(order) = &stream.order
            && !order.lacks(&record.meta)
        {
            stream.ledger.duplicate();
            if record.repeat {
                stream.tell(Telling::Quiet, (tag, id), now, &mut self.events);
            }
            return;
        }
        let Some(fragment) = record.fragment else {
            self.whole(
                tag,
                record,
                &record.meta,
                Cow::Borrowed(record.payload),
                now,
            );
            return;
        };
        let depth = if stream.order.is_some() {
            PARTIALS_EVERY
        } else {
            PARTIALS
        };
        let rules = Rules {
            depth,
            in_order: stream.order.is_some(),
            round_trip,
            patience,
        };
        let step = self.reassembly.insert(tag, record, fragment, rules, now);
        if let Some((meta, failure)) = step.failed {
            stream.ledger.fail(&meta, failure);
        }
        if let Some((meta, payload)) = step.whole {
            self.whole(tag, record, &meta, Cow::Owned(payload), now);
        }
    }

    /// Takes a whole sample that is not here yet.
    fn whole(
        &mut self,
        tag: Tag,
        record: &Record<'_>,
        meta: &SampleMeta,
        payload: Cow<'_, [u8]>,
        now: Time,
    ) {
        let id = record.stream;
        let Some(stream) = self.streams.get_mut(&(tag, id)) else {
            return;
        };
        if stream.order.is_none() {
            self.deliver(tag, id, meta, payload, now);
        } else {
            self.sort(tag, record, meta, payload, now);
        }
        let Some(stream) = self.streams.get_mut(&(tag, id)) else {
            return;
        };
        stream.last_new = now;
        if record.repeat {
            // The sender waits for this confirmation with its next repeat.
            stream.tell(Telling::Quiet, (tag, id), now, &mut self.events);
        } else {
            self.quiet.set_if_idle((tag, id), now + QUIET);
        }
    }

    /// Puts a sample in its place of the order.
    fn sort(
        &mut self,
        tag: Tag,
        record: &Record<'_>,
        meta: &SampleMeta,
        payload: Cow<'_, [u8]>,
        now: Time,
    ) {
        let id = record.stream;
        if self.ordered_bytes + cost(payload.len()) > self.config.budget_bytes {
            // Room is made by giving up what is missing before those that are here.
            self.skip_gap(tag, id, now);
        }
        let Some(stream) = self.streams.get_mut(&(tag, id)) else {
            return;
        };
        if self.ordered_bytes + cost(payload.len()) > self.config.budget_bytes {
            stream.ledger.fail(meta, Failure::OverBudget);
            return;
        }
        if stream
            .order
            .as_ref()
            .is_some_and(|order| is_later_epoch(order, meta))
        {
            // What is missing of the former epoch went with its ring.
            self.skip_gap(tag, id, now);
        }
        let Some(stream) = self.streams.get_mut(&(tag, id)) else {
            return;
        };
        let wait = REORDERING + patience(self.config.own, record, stream.by_group);
        if let Some(order) = &mut stream.order {
            let before = order.held_bytes();
            order.insert(*meta, payload.into_owned(), wait, now);
            self.ordered_bytes = self.ordered_bytes - before + order.held_bytes();
        }
        self.settle(tag, id, now);
    }

    /// Delivers what is in order, passing over what is missing, until nothing is held back.
    fn skip_gap(&mut self, tag: Tag, id: StreamId, now: Time) {
        loop {
            let Some(order) = self.order(tag, id) else {
                return;
            };
            if order.held_bytes() == 0 {
                return;
            }
            order.skip_gap();
            self.settle(tag, id, now);
        }
    }

    /// Delivers what is in order now, and notes when to ask for what is not.
    fn settle(&mut self, tag: Tag, id: StreamId, now: Time) {
        loop {
            let Some(order) = self.order(tag, id) else {
                return;
            };
            let before = order.held_bytes();
            let next = order.poll();
            let (after, deadline) = (order.held_bytes(), order.deadline());
            self.ordered_bytes = self.ordered_bytes - before + after;
            match next {
                Some(Next::Sample(meta, payload)) => {
                    self.deliver(tag, id, &meta, Cow::Owned(payload), now);
                }
                Some(Next::Gone(count, why)) => {
                    if let Some(stream) = self.streams.get_mut(&(tag, id)) {
                        stream.ledger.gone(count, why);
                    }
                }
                None => {
                    match deadline {
                        Some(at) => self.gaps.set((tag, id), at),
                        None => self.gaps.clear((tag, id)),
                    }
                    return;
                }
            }
        }
    }

    /// Queues a whole sample that is newer than all before.
    fn deliver(
        &mut self,
        tag: Tag,
        id: StreamId,
        meta: &SampleMeta,
        payload: Cow<'_, [u8]>,
        _now: Time,
    ) {
        let Some(stream) = self.streams.get_mut(&(tag, id)) else {
            return;
        };
        let waiting = self.ready_bytes + self.ready.len() * size_of::<Ready>();
        if waiting + payload.len() > self.config.budget_bytes {
            stream.ledger.fail(meta, Failure::OverBudget);
            return;
        }
        if stream.order.is_none() {
            while let Some(pending) = self.reassembly.pass(tag, id, meta) {
                if key(&pending) < key(meta) {
                    stream.ledger.fail(&pending, Failure::Expired);
                }
            }
        }
        let passed = stream.ledger.deliver(meta);
        self.ready_bytes += payload.len();
        let payload = match payload {
            Cow::Owned(bytes) => Payload::Large(bytes),
            Cow::Borrowed(bytes) => {
                let start = self.inbox.len();
                self.inbox.extend_from_slice(bytes);
                Payload::Inbox(start..self.inbox.len())
            }
        };
        self.ready.push_back(Ready {
            tag,
            stream: id,
            meta: *meta,
            payload,
            passed,
        });
    }

    fn ask_parts(&mut self, place: &Place, parts: &[(u32, u32)]) {
        for parts in parts.chunks(NACK_PARTS_MAX) {
            let nack = NackEntry {
                stream: place.stream,
                epoch: place.epoch,
                seq: place.seq,
                lacks: Lacks::Parts(parts.to_vec()),
            };
            self.push_nack(place.tag, nack);
        }
    }

    fn ask_samples(&mut self, tag: Tag, id: StreamId, now: Time) {
        let round_trip = self.round_trip_of(tag);
        let missing = self.order(tag, id).and_then(|order| order.missing());
        let comes = missing.is_some_and(|(epoch, seq)| {
            let stream = id;
            self.reassembly.has(&Place {
                tag,
                stream,
                epoch,
                seq,
            })
        });
        let Some(order) = self.order(tag, id) else {
            return;
        };
        let (asks, over) = order.due(comes, round_trip, REORDERING, now);
        if over {
            order.skip_gap();
        }
        self.settle(tag, id, now);
        for ask in asks {
            let place = Place {
                tag,
                stream: id,
                epoch: ask.epoch,
                seq: ask.first,
            };
            // A sample that has begun to arrive asks for itself.
            if ask.count == 1 && self.reassembly.has(&place) {
                continue;
            }
            let nack = NackEntry {
                stream: id,
                epoch: ask.epoch,
                seq: ask.first,
                lacks: Lacks::Samples(ask.count),
            };
            self.push_nack(tag, nack);
        }
    }

    fn push_nack(&mut self, tag: Tag, nack: NackEntry) {
        if self.nacks.len() < NACKS {
            self.nacks.push_back((tag, nack));
        } else {
            self.counters.dropped_nacks += 1;
        }
    }

    fn order(&mut self, tag: Tag, id: StreamId) -> Option<&mut Order> {
        self.streams.get_mut(&(tag, id))?.order.as_mut()
    }

    fn round_trip_of(&self, tag: Tag) -> Duration {
        self.round_trips
            .get(&tag)
            .copied()
            .unwrap_or(ROUND_TRIP_UNKNOWN)
    }
}

/// How long this receiver waits before it asks for what others of a group may lack too: each another span.
fn patience(own: Tag, record: &Record<'_>, by_group: bool) -> Duration {
    if !by_group {
        return Duration::ZERO;
    }
    let mixed = (own.0 ^ record.meta.seq.0).wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 32;
    PATIENCE_UNIT * u32::try_from(mixed % 16).unwrap_or_default()
}

impl Stream {
    /// Newest sample that is here, though earlier ones may be missing.
    fn newest(&self) -> Option<(Epoch, Seq)> {
        let ordered = self.order.as_ref().and_then(Order::newest);
        ordered.max(self.ledger.newest())
    }

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
            budget_bytes: 160 << 20,
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

/// What took another way may come so much later: not asked for yet.
const REORDERING: Duration = Duration::from_millis(5);
/// Receivers of a group ask up to 15 of these apart.
const PATIENCE_UNIT: Duration = Duration::from_micros(700);
/// Incomplete samples of a stream: the one that comes, and the one before, whose repair is on its way.
const PARTIALS: usize = 2;
/// The same where each sample is wanted.
const PARTIALS_EVERY: usize = 8;
/// Requests that wait to be sent, of at most 900 B each: 225 KiB. What is not asked for now is asked for later.
const NACKS: usize = 256;
/// Assumed until measured.
const ROUND_TRIP_UNKNOWN: Duration = Duration::from_millis(50);
/// A sender that answers ever more slowly must not put requests off for ever.
const ROUND_TRIP_MAX: Duration = Duration::from_secs(2);
