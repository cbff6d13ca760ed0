//! The sending half: one machine for all streams that leave this host.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::net::SocketAddr;
use std::time::Duration;

use ddx_wire::message::{Lacks, NackEntry, ReportEntry};
use ddx_wire::sample::SampleMeta;
use ddx_wire::seal::{MAX_DATAGRAM_BYTES, Sealer};
use ddx_wire::{Delivery, Epoch, Seq, StreamId, Tag, Time};

use super::books::{SentBooks, SourceBooks};
use super::deadlines::Deadlines;
use super::path::{Offered, Path, PathLimits};
use super::shares::Shares;
use super::stream::{Reader, Stream};
use super::{
    Due, Fetch, PathStatus, Route, SenderEvent, TimerName, Transmit, Via, group_number, key,
};

/// Limits of a [`Sender`].
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SenderConfig {
    /// Greatest datagram until a longer one was seen to arrive, header and seal included, bytes.
    pub datagram_bytes: usize,
    /// Longest datagram that is tried by unicast, bytes.
    pub datagram_bytes_max: usize,
    /// Most datagrams in one transmit, at most 64: what one segmented send of the driver's socket takes.
    pub segments_max: usize,
    /// Most streams open at a time.
    pub max_streams: usize,
}

/// Sends samples to the hosts that read them, each once for each way that they take, as fast as the way allows, and repeats
/// what was lost.
///
/// `P` holds a payload in place: large samples are kept while their fragments leave.
#[derive(Debug)]
pub struct Sender<P> {
    config: SenderConfig,
    sealer: Sealer,
    streams: BTreeMap<StreamId, Stream>,
    paths: BTreeMap<SocketAddr, Path<P>>,
    numbers: BTreeMap<u16, SocketAddr>,
    last_number: u16,
    /// Datagrams sent so far to groups that are not in use now: their receivers count on.
    left_off: BTreeMap<u16, u32>,
    /// Paths that have something to send, in turn.
    ready: VecDeque<SocketAddr>,
    /// Paths that wait for their rate.
    blocked: Deadlines<SocketAddr>,
    /// Paths that may have something to fetch.
    hungry: BTreeSet<SocketAddr>,
    round_trips: BTreeMap<Tag, Duration>,
    repeats: Deadlines<StreamId>,
    /// What part of this host's own link each path has, as far as its queue tells.
    shares: Shares<SocketAddr>,
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
    /// Readers that were left out of a stream because it has too many, at each change of its route: they get nothing.
    pub refused_readers: u64,
    /// Requests for repair that found no room: they are made again. Growth means that a reading host asks for very much.
    pub dropped_requests: u64,
    /// Records that found no room in the lane of a path, of samples that are too old to be sent: their readers ask for
    /// them again, and are told then. Growth means that one writes old samples faster than a link can tell of them.
    pub dropped_records: u64,
}

/// What a [`Sender`] has done for one stream.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct StreamCounters {
    /// New samples, each counted once however many hosts read.
    pub sent: u64,
    /// Turns at which a path had no room for a new sample: the link is slower than the stream.
    pub deferred: u64,
    /// Samples that were older than the contract allows when their turn came.
    pub expired: u64,
    /// Samples over 64 MiB, which are not sent.
    pub too_large: u64,
    /// Samples sent once more, in full or in part: growth beyond one for each new reader means loss.
    pub repeats: u64,
}

impl<P: AsRef<[u8]> + Clone> Sender<P> {
    /// Makes a sender without streams. `sealer` is the data sealer of this incarnation.
    pub fn new(config: SenderConfig, sealer: Sealer, now: Time) -> Self {
        Self {
            config,
            sealer,
            streams: BTreeMap::new(),
            paths: BTreeMap::new(),
            numbers: BTreeMap::new(),
            last_number: FIRST_UNICAST - 1,
            left_off: BTreeMap::new(),
            ready: VecDeque::new(),
            blocked: Deadlines::new(),
            hungry: BTreeSet::new(),
            round_trips: BTreeMap::new(),
            repeats: Deadlines::new(),
            shares: Shares::new(now),
            counters: SenderCounters::default(),
            now,
        }
    }

    /// Opens a stream, and asks for its present value for every new reader. An open stream is updated: readers that stay
    /// keep their state.
    ///
    /// A stream over the limit is not opened, and counted.
    pub fn open(&mut self, id: StreamId, route: &Route, now: Time) {
        self.now = now;
        if !self.streams.contains_key(&id) && self.streams.len() >= self.config.max_streams {
            self.counters.refused_streams += 1;
            return;
        }
        let stream = self.streams.entry(id).or_insert_with(|| Stream {
            contract: route.contract,
            filtered: 0,
            next_due: now,
            readers: Vec::new(),
            destinations: Vec::new(),
            newest: None,
            present: None,
            expired: None,
            counters: StreamCounters::default(),
            books: SourceBooks::default(),
            offered: None,
            full: false,
        });
        let before = std::mem::take(&mut stream.destinations);
        let alone = |stream: &Stream| -> BTreeMap<SocketAddr, bool> {
            let readers = stream.readers.iter().map(|reader| &reader.host);
            readers
                .map(|host| (host.addr, host.via == Via::Unicast))
                .collect()
        };
        let alone_before = alone(stream);
        let left_out = stream.reroute(route, now);
        let alone_now = alone(stream);
        self.counters.refused_readers += left_out;
        let contract = stream.contract;
        let destinations = stream.destinations.clone();
        let wanting: Vec<SocketAddr> = stream
            .readers
            .iter_mut()
            .filter(|reader| reader.sent.is_none() && reader.repeat_asked_at.is_none())
            .map(|reader| {
                reader.repeat_asked_at = Some(now);
                reader.host.addr
            })
            .collect();
        let newest = stream.newest;
        let progress = before
            .iter()
            .find_map(|to| self.paths.get(to)?.progress(id));
        for to in &destinations {
            let path = self.path(*to);
            path.open(id, contract);
            if let Some(progress) = progress.filter(|_| !before.contains(to)) {
                path.follow(id, progress, newest, now);
                self.hungry.insert(*to);
                enlist(&mut self.ready, &self.blocked, *to);
            }
        }
        for to in before.into_iter().filter(|to| !destinations.contains(to)) {
            if let Some(path) = self.paths.get_mut(&to) {
                path.rest(id);
            }
        }
        for (to, was_alone) in alone_before {
            let Some(path) = self.paths.get_mut(&to) else {
                continue;
            };
            match (was_alone, alone_now.get(&to)) {
                (true, Some(false)) => path.leave(now),
                (false, Some(true)) => path.come_back(now),
                _ => {}
            }
        }
        for to in wanting {
            self.ask_repeat(id, to, None);
        }
        self.prune();
    }

    /// Changes an open stream's route; one that is not open is left alone.
    pub fn update(&mut self, id: StreamId, route: &Route, now: Time) {
        if self.streams.contains_key(&id) {
            self.open(id, route, now);
        }
    }

    /// Closes a stream; what is queued already still leaves.
    pub fn close(&mut self, id: StreamId) {
        self.streams.remove(&id);
        self.repeats.clear(id);
        self.prune();
    }

    /// Tells when the stream's contract admits its next sample. A stream that is not open is due at once.
    pub fn due(&self, id: StreamId, now: Time) -> Due {
        match self.streams.get(&id) {
            Some(stream) if stream.next_due > now => Due::At(stream.next_due),
            Some(_) | None => Due::Now,
        }
    }

    /// Offers a new sample to every path of its stream. One that is not newer than the last is ignored. Returns false when
    /// every path is full, so that it is of no use to offer more before one of them asks.
    ///
    /// A path that is full takes it later, by a [`SenderEvent::Fetch`], or a newer one instead. The driver keeps the
    /// contract's rate by asking [`Sender::due`] first. One over 64 MiB is dropped and counted, and one of a stream that is
    /// not open is ignored.
    pub fn write(&mut self, id: StreamId, meta: &SampleMeta, payload: &P, now: Time) -> bool {
        self.now = now;
        let Some(stream) = self.streams.get_mut(&id) else {
            return true;
        };
        let newest = Some(key(meta));
        if newest <= stream.newest {
            return true;
        }
        let admitted = stream.admits(meta, payload.as_ref(), now);
        stream.account(meta, payload.as_ref(), admitted);
        if !admitted {
            if stream.contract.delivery != Delivery::Latest {
                for to in &stream.destinations {
                    // What waits comes before it, and takes its own turn.
                    if let Some(path) = self.paths.get_mut(to).filter(|path| !path.waits(id)) {
                        let before = path.dropped_records();
                        path.leave_out(id, meta);
                        self.counters.dropped_records += path.dropped_records() - before;
                        enlist(&mut self.ready, &self.blocked, *to);
                    }
                }
            }
            return true;
        }
        let meta = &stream.advance(meta);
        stream.counters.sent += 1;
        stream.advance_due(now);
        let (mut taken, mut refused) = (false, false);
        for to in &stream.destinations {
            let Some(path) = self.paths.get_mut(to) else {
                continue;
            };
            match path.offer(id, meta, payload, now) {
                // Large ones are noted again when they have left in full.
                Offered::Goes | Offered::Begins => {
                    taken = true;
                    note_sent(&mut stream.readers, *to, key(meta), false, now);
                }
                Offered::Waits => {
                    refused = true;
                    stream.counters.deferred += 1;
                    self.hungry.insert(*to);
                }
            }
            if path.has_command() {
                self.blocked.clear(*to);
            }
            enlist(&mut self.ready, &self.blocked, *to);
        }
        if taken {
            self.repeats.set_if_idle(id, now + REPEAT_FIRST);
        }
        stream.full = refused && !taken;
        !stream.full
    }

    /// Takes what a [`SenderEvent::Fetch`] asked for, or that the store has nothing like it.
    ///
    /// Of a stream without a rate, one that is newer than the last that was offered is offered thereby: the driver does not
    /// write it, and the other paths fetch it, or a newer one.
    pub fn fetched(&mut self, fetch: &Fetch, found: Option<(&SampleMeta, &P)>, now: Time) {
        self.now = now;
        let Some(stream) = self.streams.get_mut(&fetch.stream) else {
            return;
        };
        let admitted = found.is_none_or(|(meta, p)| stream.admits(meta, p.as_ref(), now));
        let newest = stream.newest.filter(|_| stream.interval().is_zero());
        let new = found.filter(|(meta, _)| newest.is_some_and(|newest| newest < key(meta)));
        if let Some((meta, payload)) = new {
            stream.account(meta, payload.as_ref(), admitted);
        }
        let found = found.map(|(meta, payload)| match new {
            Some(_) if admitted => (stream.advance(meta), payload),
            Some(_) | None => (stream.complete(meta), payload),
        });
        if let Some((meta, _)) = found.as_ref().filter(|_| admitted) {
            stream.begin(meta);
        }
        if new.is_some() && admitted {
            stream.counters.sent += 1;
            for to in stream.destinations.iter().filter(|to| **to != fetch.to) {
                if let Some(path) = self.paths.get_mut(to) {
                    path.wait(fetch.stream, now);
                    self.hungry.insert(*to);
                }
            }
        }
        if found.is_some() && admitted && fetch.again {
            stream.counters.repeats += 1;
        }
        let newest = stream.newest;
        let Some(path) = self.paths.get_mut(&fetch.to) else {
            return;
        };
        let found = found.as_ref().map(|(meta, payload)| (meta, *payload));
        let before = path.dropped_records();
        let offered = match found {
            Some((meta, _)) if !admitted => {
                path.refused(fetch, meta, newest);
                None
            }
            Some(_) | None => path.fetched(fetch, found, newest, now),
        };
        self.counters.dropped_records += path.dropped_records() - before;
        if path.has_command() {
            self.blocked.clear(fetch.to);
        }
        self.hungry.insert(fetch.to);
        enlist(&mut self.ready, &self.blocked, fetch.to);
        if let (Some(Offered::Goes | Offered::Begins), Some((meta, _))) = (offered, found) {
            self.note_sent(fetch.stream, fetch.to, key(meta), false);
        }
    }

    /// Learns what a reader holds, from its confirmation or its renewal.
    pub fn held(&mut self, id: StreamId, tag: Tag, epoch: Epoch, seq: Seq, now: Time) {
        self.now = now;
        let first = self.first_repeat_after(tag);
        let Some(stream) = self.streams.get_mut(&id) else {
            return;
        };
        let newest = stream.newest;
        let Some(reader) = stream.readers.iter_mut().find(|r| r.host.tag == tag) else {
            return;
        };
        reader.held = reader.held.max(Some((epoch, seq)));
        let overdue = now >= reader.sent_at + first
            && reader
                .repeat_asked_at
                .is_none_or(|asked| now >= asked + REPEAT_NEXT);
        let to = reader.host.addr;
        if reader.is_behind() && overdue {
            // It is there, perhaps again: one repeat might be lost, or a fragment of it.
            reader.repeats = reader.repeats.min(REPEAT_LIMIT - REPEATS_AGAIN);
            reader.repeat_asked_at = Some(now);
            self.ask_repeat(id, to, newest);
        }
        self.release(id);
    }

    /// Takes in how a reader's host receives.
    pub fn handle_report(&mut self, tag: Tag, report: &ReportEntry, now: Time) {
        self.now = now;
        if let Some(to) = self.numbers.get(&report.path)
            && let Some(path) = self.paths.get_mut(to)
        {
            let share = self.shares.of(*to, now);
            path.handle_report(tag, report, share, now);
        }
    }

    /// Takes in what a reader's host lacks.
    pub fn handle_nack(&mut self, tag: Tag, nack: &NackEntry, now: Time) {
        self.now = now;
        let Some(stream) = self.streams.get_mut(&nack.stream) else {
            return;
        };
        let Some(reader) = stream.readers.iter_mut().find(|r| r.host.tag == tag) else {
            return;
        };
        stream.counters.repeats += 1;
        let at = (nack.epoch, nack.seq);
        let (contract, is_newest) = (stream.contract, Some(at) >= stream.newest);
        if reader.asked.is_none_or(|(asked, _)| asked != at) {
            reader.asked = Some((at, 0));
        }
        let times = reader.asked.as_mut().map_or(0, |(_, times)| {
            *times += 1;
            *times
        });
        let to = match reader.host.via {
            // Others of the group may lack the same; but perhaps this one does not hear the group any more.
            Via::Group(group) if times <= GROUP_REPAIRS => group,
            Via::Group(_) => reader.host.addr,
            Via::Unicast | Via::Both(_) => reader.host.addr,
        };
        let path = self.path(to);
        path.open(nack.stream, contract);
        let before = path.dropped_requests(nack.stream);
        let answered = match &nack.lacks {
            Lacks::Samples(count) => {
                path.handle_gap(nack.stream, nack.epoch, nack.seq, *count);
                true
            }
            Lacks::Parts(parts) => path.handle_parts(nack.stream, at, parts, is_newest, now),
        };
        self.counters.dropped_requests += path.dropped_requests(nack.stream) - before;
        self.hungry.insert(to);
        enlist(&mut self.ready, &self.blocked, to);
        if answered
            && let Some(stream) = self.streams.get_mut(&nack.stream)
            && let Some(reader) = stream.readers.iter_mut().find(|r| r.host.tag == tag)
        {
            // It is alive and says itself what it lacks.
            (reader.sent_at, reader.repeats) = (now, 0);
        }
    }

    /// Learns the round-trip time to a host: repeats to it wait that much longer for its confirmation.
    ///
    /// Until told, 50 ms are assumed. Ignored for a host that reads nothing.
    pub fn round_trip(&mut self, tag: Tag, time: Duration) {
        let time = time.min(ROUND_TRIP_MAX);
        let mut readers = self.streams.values().flat_map(|stream| &stream.readers);
        if let Some(reader) = readers.find(|reader| reader.host.tag == tag) {
            let to = reader.host.addr;
            self.round_trips.insert(tag, time);
            if let Some(path) = self.paths.get_mut(&to) {
                path.set_round_trip(time);
            }
        }
    }

    /// Lets coalesced datagrams go: the driver has no more samples in hand.
    pub fn flush(&mut self, now: Time) {
        self.now = now;
        for to in &self.ready {
            if let Some(path) = self.paths.get_mut(to) {
                path.flush(now);
            }
        }
    }

    /// Does what has come due.
    pub fn handle_timeout(&mut self, now: Time) {
        self.now = now;
        while let Some(to) = self.blocked.pop(now) {
            if let Some(path) = self.paths.get_mut(&to) {
                path.flush(now);
                self.ready.push_back(to);
                self.hungry.insert(to);
            }
        }
        while let Some(id) = self.repeats.pop(now) {
            self.ask_repeats(id, now);
        }
    }

    /// Replaces `out` by the next datagrams to send; `None` when there are none, or the rates forbid.
    pub fn poll_transmit(&mut self, out: &mut Vec<u8>) -> Option<Transmit> {
        let to = self.next_path()?;
        let path = self.paths.get_mut(&to)?;
        let transmit = path.poll_transmit(&mut self.sealer, out, self.now);
        let left = path.take_left();
        self.shares
            .note(to, out.len(), path.is_strained(), self.now);
        self.hungry.insert(to);
        enlist(&mut self.ready, &self.blocked, to);
        for (stream, epoch, seq) in left {
            self.note_sent(stream, to, (epoch, seq), true);
        }
        let transmit = transmit?;
        let segment = transmit.segment.map_or(out.len(), usize::from);
        self.counters.datagrams += out.len().div_ceil(segment.max(1)) as u64;
        self.counters.bytes += out.len() as u64;
        Some(transmit)
    }

    /// When and why to call [`Sender::handle_timeout`].
    pub fn poll_timeout(&self) -> Option<(Time, TimerName)> {
        let pace = self.blocked.first().map(|at| (at, TimerName::Pace));
        let repeat = self.repeats.first().map(|at| (at, TimerName::Repeat));
        pace.into_iter().chain(repeat).min_by_key(|(at, _)| *at)
    }

    /// The next request to the driver, who answers it by [`Sender::fetched`] before it asks for another.
    pub fn poll_event(&mut self) -> Option<SenderEvent> {
        while let Some(&to) = self.hungry.first() {
            let fetch = self.paths.get_mut(&to).and_then(|p| p.poll_fetch(self.now));
            match fetch {
                Some(fetch) => return Some(SenderEvent::Fetch(fetch)),
                None => self.hungry.remove(&to),
            };
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

    /// What became of the samples of each open stream before any went out.
    pub fn source_books(&self) -> impl Iterator<Item = (StreamId, SourceBooks)> {
        self.streams.iter().map(|(id, stream)| (*id, stream.books))
    }

    /// What became of the samples of each open stream at each of its destinations.
    pub fn sent_books(&self) -> impl Iterator<Item = (StreamId, SocketAddr, SentBooks)> {
        self.paths
            .iter()
            .flat_map(|(to, path)| path.books().map(|(stream, books)| (stream, *to, books)))
    }

    /// What is known of each destination in use.
    pub fn paths(&self) -> impl Iterator<Item = PathStatus> {
        self.paths.values().map(Path::status)
    }

    fn path(&mut self, to: SocketAddr) -> &mut Path<P> {
        let number = match self.paths.get(&to) {
            Some(path) => path.number(),
            None => group_number(to).unwrap_or_else(|| self.unicast_number()),
        };
        self.numbers.insert(number, to);
        let left_off = self.left_off.remove(&number).unwrap_or_default();
        self.paths.entry(to).or_insert_with(|| {
            let limits = PathLimits {
                // Room for at least one payload byte of a fragment, whatever the configuration says.
                datagram_bytes: self.config.datagram_bytes.max(DATAGRAM_BYTES_MIN),
                datagram_bytes_max: self.config.datagram_bytes_max,
                segments_max: self.config.segments_max.clamp(1, BATCH_SEGMENTS),
            };
            let mut path = Path::new(to, number, limits, self.now);
            path.count_from(left_off);
            let readers = self.streams.values().flat_map(|stream| &stream.readers);
            let at = readers.filter(|reader| reader.host.addr == to);
            let known = at.filter_map(|reader| self.round_trips.get(&reader.host.tag));
            if let Some(time) = known.max() {
                path.set_round_trip(*time);
            }
            path
        })
    }

    fn unicast_number(&mut self) -> u16 {
        loop {
            self.last_number = self.last_number.checked_add(1).unwrap_or(FIRST_UNICAST);
            if !self.numbers.contains_key(&self.last_number) {
                return self.last_number;
            }
        }
    }

    /// The most urgent of the paths whose rate admits something, in turn.
    fn next_path(&mut self) -> Option<SocketAddr> {
        let mut best: Option<(usize, usize)> = None;
        let mut at = 0;
        while let Some(to) = self.ready.get(at).copied() {
            let Some(path) = self.paths.get_mut(&to) else {
                self.ready.remove(at);
                continue;
            };
            let rank = path.rank();
            if rank.is_none() && !path.is_ready() {
                self.ready.remove(at);
                continue;
            }
            if let Some(until) = path.blocked_until(self.now) {
                self.blocked.set(to, until);
                self.ready.remove(at);
                continue;
            }
            let Some(rank) = rank else {
                // What waits for company stays listed until it is flushed.
                at += 1;
                continue;
            };
            if best.is_none_or(|(least, _)| rank < least) {
                best = Some((rank, at));
            }
            at += 1;
        }
        self.ready.remove(best?.1)
    }

    /// A sample leaves by a path: its readers there may confirm it. `in_full` tells that the last fragment of a large one
    /// has left, from when on that can be expected.
    fn note_sent(&mut self, id: StreamId, to: SocketAddr, at: (Epoch, Seq), in_full: bool) {
        let now = self.now;
        let Some(stream) = self.streams.get_mut(&id) else {
            return;
        };
        note_sent(&mut stream.readers, to, at, in_full, now);
        if !stream.readers.is_empty() {
            self.repeats.set_if_idle(id, now + REPEAT_FIRST);
        }
    }

    /// Lets go of large samples that every reader holds.
    fn release(&mut self, id: StreamId) {
        let Some(stream) = self.streams.get(&id) else {
            return;
        };
        let Some(held) = stream
            .readers
            .iter()
            .map(|reader| reader.held)
            .min()
            .flatten()
        else {
            return;
        };
        let unicast = stream.readers.iter().map(|reader| &reader.host.addr);
        for to in stream.destinations.iter().chain(unicast) {
            if let Some(path) = self.paths.get_mut(to) {
                path.release(id, held);
            }
        }
    }

    fn ask_repeat(&mut self, id: StreamId, to: SocketAddr, newest: Option<(Epoch, Seq)>) {
        let Some(contract) = self.streams.get(&id).map(|stream| stream.contract) else {
            return;
        };
        let path = self.path(to);
        path.open(id, contract);
        path.repeat(id, newest);
        self.hungry.insert(to);
        enlist(&mut self.ready, &self.blocked, to);
    }

    fn ask_repeats(&mut self, id: StreamId, now: Time) {
        let Some(stream) = self.streams.get_mut(&id) else {
            return;
        };
        let newest = stream.newest;
        let mut next: Option<Time> = None;
        let mut asked = Vec::new();
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
                asked.push(reader.host.addr);
            }
            next = Some(next.map_or(at, |other| other.min(at)));
        }
        if let Some(at) = next {
            self.repeats.set(id, at);
        }
        for to in asked {
            self.ask_repeat(id, to, newest);
        }
    }

    /// Drops flows and paths that no stream uses.
    fn prune(&mut self) {
        let streams = &self.streams;
        let tags: BTreeSet<Tag> = streams.values().flat_map(Stream::tags).collect();
        self.round_trips.retain(|tag, _| tags.contains(tag));
        let mut used: BTreeMap<SocketAddr, BTreeSet<StreamId>> = BTreeMap::new();
        for (id, stream) in streams {
            let unicast = stream.readers.iter().map(|reader| reader.host.addr);
            for to in stream.destinations.iter().copied().chain(unicast) {
                used.entry(to).or_default().insert(*id);
            }
        }
        self.paths.retain(|to, path| {
            let streams = used.get(to);
            path.keep_readers(&tags);
            path.keep(|id| streams.is_some_and(|streams| streams.contains(&id)));
            let kept = streams.is_some() || !path.is_unused();
            if !kept {
                self.numbers.remove(&path.number());
                if path.number() < FIRST_UNICAST {
                    self.left_off.insert(path.number(), path.datagrams());
                }
                self.blocked.clear(*to);
                self.hungry.remove(to);
            }
            kept
        });
    }

    fn first_repeat_after(&self, tag: Tag) -> Duration {
        let round_trip = self.round_trips.get(&tag).copied();
        REPEAT_FIRST + round_trip.unwrap_or(ROUND_TRIP_UNKNOWN)
    }
}

/// Takes note that those who are reached by a path may confirm a sample from now on.
fn note_sent(readers: &mut [Reader], to: SocketAddr, at: (Epoch, Seq), in_full: bool, now: Time) {
    for reader in readers {
        if !reader.host.is_reached_by(to) {
            continue;
        }
        if Some(at) > reader.sent {
            reader.sent = Some(at);
            (reader.sent_at, reader.repeats) = (now, 0);
        } else if in_full && Some(at) == reader.sent {
            reader.sent_at = now;
        }
    }
}

fn enlist(ready: &mut VecDeque<SocketAddr>, blocked: &Deadlines<SocketAddr>, to: SocketAddr) {
    if !blocked.contains(&to) && !ready.contains(&to) {
        ready.push_back(to);
    }
}

impl Default for SenderConfig {
    fn default() -> Self {
        Self {
            datagram_bytes: MAX_DATAGRAM_BYTES,
            datagram_bytes_max: JUMBO_BYTES,
            segments_max: 64,
            max_streams: 16_384,
        }
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
/// What a jumbo frame of 9,000 bytes carries.
const JUMBO_BYTES: usize = 8_972;
/// `PROTOCOL.md#limits`: what one segmented send of the kernel takes.
const BATCH_SEGMENTS: usize = 64;
/// Shortest limit of a datagram that a configuration may ask for.
const DATAGRAM_BYTES_MIN: usize = 256;
/// Requests of one reader for one sample that are answered by its group.
const GROUP_REPAIRS: u32 = 2;
/// Path numbers below are those of groups.
pub(super) const FIRST_UNICAST: u16 = 32;
