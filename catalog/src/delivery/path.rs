//! One destination: its rate, its lanes, and the streams that share it.
//!
//! Next to nothing is queued here: what the path cannot take now stays in the store, and is read again when it can, the
//! newest first. Streams take turns by weight, counted in bytes.

mod gone;
mod reports;

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::net::SocketAddr;
use std::time::Duration;

use ddx_wire::sample::{FRAGMENT_RECORD_BYTES, Place, Preamble, RECORD_BYTES, Record, SampleMeta};
use ddx_wire::seal::{Lane, Sealer};
use ddx_wire::{Contract, Epoch, Seq, StreamId, Tag, Time};

use super::books::SentBooks;
use super::congestion::{Congestion, QUEUE_LOW_MAX};
use super::flow::{Flow, Progress};
use super::pace::{Pace, batch_bytes, span_of};
use super::parity;
use super::queue::{DATAGRAM_OVERHEAD, Limit, Queue};
use super::reporter::Reporter;
use super::sender::FIRST_UNICAST;
use super::transfer::Transfer;
use super::{Fetch, PathStatus, Transmit, Want};

/// A destination of datagrams.
#[derive(Debug)]
pub(super) struct Path<P> {
    addr: SocketAddr,
    number: u16,
    datagrams: u32,
    datagram_bytes: usize,
    /// What gets through everywhere.
    datagram_bytes_safe: usize,
    datagram_bytes_max: usize,
    segments_max: usize,
    pace: Pace,
    congestion: Congestion,
    /// By rank.
    lanes: [Queue; LANES.len()],
    flows: BTreeMap<StreamId, Flow<P>>,
    /// Flows that want something from the store, by turn.
    hungry: BTreeSet<(u64, StreamId)>,
    /// Flows with fragments that were never sent, by turn.
    sending: BTreeSet<(u64, StreamId)>,
    /// Flows with fragments that are asked for again, by turn.
    repairing: BTreeSet<(u64, StreamId)>,
    /// The turn that was taken last: who was idle begins here.
    turn: u64,
    round_trip: Duration,
    reporters: BTreeMap<Tag, Reporter>,
    /// Number of the newest datagram at some times, the latest last.
    departures: VecDeque<(u32, Time)>,
    unreported_bytes: usize,
    unreported_since: Time,
    probe_at: Time,
    probes: usize,
    /// Who holds what of the streams is known by the sender; large samples that left in full are told to it.
    left: Vec<(StreamId, Epoch, Seq)>,
}

/// What became of a sample that was offered.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Offered {
    /// It is about to leave.
    Goes,
    /// Its first fragments are about to leave; the rest follows.
    Begins,
    /// It stays in the store until the path has room.
    Waits,
}

/// What limits a path.
#[derive(Clone, Copy, Debug)]
pub(super) struct PathLimits {
    pub(super) datagram_bytes: usize,
    pub(super) datagram_bytes_max: usize,
    pub(super) segments_max: usize,
}

impl<P: AsRef<[u8]> + Clone> Path<P> {
    pub(super) fn new(addr: SocketAddr, number: u16, limits: PathLimits, now: Time) -> Self {
        Self {
            addr,
            number,
            datagrams: 0,
            datagram_bytes: limits.datagram_bytes,
            datagram_bytes_safe: limits.datagram_bytes,
            datagram_bytes_max: limits.datagram_bytes_max,
            segments_max: limits.segments_max,
            pace: Pace::new(now),
            congestion: Congestion::new(now),
            lanes: Default::default(),
            flows: BTreeMap::new(),
            hungry: BTreeSet::new(),
            sending: BTreeSet::new(),
            repairing: BTreeSet::new(),
            turn: 0,
            round_trip: Duration::from_millis(50),
            reporters: BTreeMap::new(),
            departures: VecDeque::new(),
            unreported_bytes: 0,
            unreported_since: now,
            probe_at: now,
            probes: 0,
            left: Vec::new(),
        }
    }

    fn is_group(&self) -> bool {
        self.number < FIRST_UNICAST
    }

    pub(super) fn number(&self) -> u16 {
        self.number
    }

    /// Number of the newest datagram.
    pub(super) fn datagrams(&self) -> u32 {
        self.datagrams
    }

    /// Goes on after the datagram of this number.
    pub(super) fn count_from(&mut self, datagrams: u32) {
        self.datagrams = datagrams;
    }

    pub(super) fn set_round_trip(&mut self, round_trip: Duration) {
        self.round_trip = round_trip;
    }

    pub(super) fn status(&self) -> PathStatus {
        PathStatus {
            to: self.addr,
            bytes_per_second: self.congestion.rate(),
            queue: self.congestion.queue(),
            loss_permille: self.congestion.loss_permille(),
            datagram_bytes: self.datagram_bytes,
            waiting: self.hungry.len() + self.sending.len(),
        }
    }

    /// What became here of the samples of each stream.
    pub(super) fn books(&self) -> impl Iterator<Item = (StreamId, SentBooks)> {
        self.flows.iter().map(|(stream, flow)| {
            let waiting = flow.waits.is_some();
            let books = flow.books();
            (*stream, SentBooks { waiting, ..books })
        })
    }

    /// Opens a flow, or changes its contract.
    pub(super) fn open(&mut self, stream: StreamId, contract: Contract) {
        let turn = self.turn;
        self.forget_turns(stream);
        let flow = self.flows.entry(stream);
        flow.or_insert_with(|| Flow::new(contract, turn)).contract = contract;
        self.take_turns(stream);
    }

    /// How far a stream has got here.
    pub(super) fn progress(&self, stream: StreamId) -> Option<Progress> {
        self.flows.get(&stream).map(Flow::progress)
    }

    /// A stream goes on here from where it is elsewhere.
    pub(super) fn follow(
        &mut self,
        stream: StreamId,
        progress: Progress,
        newest: Option<(Epoch, Seq)>,
        now: Time,
    ) {
        self.forget_turns(stream);
        if let Some(flow) = self.flows.get_mut(&stream) {
            flow.follow(progress, newest, now);
        }
        self.take_turns(stream);
    }

    /// A stream takes another way from now on; only repairs still go here.
    pub(super) fn rest(&mut self, stream: StreamId) {
        self.forget_turns(stream);
        if let Some(flow) = self.flows.get_mut(&stream) {
            flow.rest();
        }
        self.take_turns(stream);
    }

    pub(super) fn close(&mut self, stream: StreamId) {
        self.flows.remove(&stream);
        for turns in [&mut self.hungry, &mut self.sending, &mut self.repairing] {
            turns.retain(|(_, id)| *id != stream);
        }
    }

    /// Drops the flows of other streams.
    pub(super) fn keep(&mut self, keep: impl Fn(StreamId) -> bool) {
        let gone = self.flows.keys().copied().filter(|stream| !keep(*stream));
        for stream in gone.collect::<Vec<_>>() {
            self.close(stream);
        }
    }

    /// Whether nobody uses the path any longer, nor waits for what it has.
    pub(super) fn is_unused(&self) -> bool {
        self.flows.is_empty() && self.lanes.iter().all(Queue::is_empty)
    }

    /// Offers a new sample of a stream.
    pub(super) fn offer(
        &mut self,
        stream: StreamId,
        meta: &SampleMeta,
        payload: &P,
        now: Time,
    ) -> Offered {
        let rate = self.congestion.rate();
        let Some(flow) = self.flows.get_mut(&stream) else {
            return Offered::Goes;
        };
        if flow.sent() >= Some((meta.epoch, meta.seq)) {
            // It went to a new reader out of turn.
            return Offered::Goes;
        }
        if flow.waits.is_some() {
            return Offered::Waits;
        }
        if flow.urgent {
            // The value that a new reader wants is on its way with this one.
            self.forget_turns(stream);
            if let Some(flow) = self.flows.get_mut(&stream) {
                flow.urgent = false;
            }
            self.take_turns(stream);
        }
        let Some(flow) = self.flows.get_mut(&stream) else {
            return Offered::Goes;
        };
        let len = payload.as_ref().len();
        let large = self.datagram_bytes < alone_bytes(stream, meta, payload.as_ref());
        let lane = lane_of(flow.is_command(), false);
        let full = if large {
            flow.is_under_way()
        } else {
            let queue = &self.lanes[lane];
            queue.len() >= room(rate) && !queue.has_company(RECORD_BYTES + len, self.datagram_bytes)
        };
        if full {
            // Behind a large one that is on its way it waits for the end of that.
            flow.waits = Some(now);
            self.take_turns(stream);
            // Who fills a path has a use for longer datagrams.
            self.probe(now);
            return Offered::Waits;
        }
        self.admit(stream, meta, payload, None, now)
    }

    /// Takes what a [`Fetch`] brought, or that there is nothing.
    pub(super) fn fetched(
        &mut self,
        fetch: &Fetch,
        found: Option<(&SampleMeta, &P)>,
        newest: Option<(Epoch, Seq)>,
        now: Time,
    ) -> Option<Offered> {
        let stream = fetch.stream;
        self.forget_turns(stream);
        let flow = self.flows.get_mut(&stream)?;
        let mut offered = None;
        if let Want::At(..) = fetch.want {
            let Some(filled) = flow.fill(found.map(|(meta, _)| (meta.epoch, meta.seq))) else {
                self.take_turns(stream);
                return None;
            };
            if filled.gone > 0 {
                let meta = SampleMeta {
                    epoch: filled.epoch,
                    seq: filled.gone_until,
                    ..SampleMeta::default()
                };
                self.push_gone(stream, &meta, filled.gone);
            }
            if filled.wanted
                && let Some((meta, payload)) = found
            {
                offered = Some(self.admit(stream, meta, payload, Some(&filled.parts), now));
            }
        } else if let Some((meta, payload)) = found {
            let at = (meta.epoch, meta.seq);
            if fetch.again {
                offered = Some(self.admit(stream, meta, payload, Some(&[]), now));
            } else if flow.sent() >= Some(at) {
                flow.waits = None;
            } else {
                self.tell_gap(stream, meta);
                offered = Some(self.admit(stream, meta, payload, None, now));
            }
            if let Some(flow) = self.flows.get_mut(&stream)
                && flow.sent() >= newest
            {
                flow.waits = None;
            }
        } else {
            flow.waits = None;
        }
        self.take_turns(stream);
        offered
    }

    /// Takes what a [`Fetch`] brought and the contract keeps back. Where each sample is wanted that is told.
    pub(super) fn refused(
        &mut self,
        fetch: &Fetch,
        meta: &SampleMeta,
        newest: Option<(Epoch, Seq)>,
    ) {
        let stream = fetch.stream;
        self.forget_turns(stream);
        let Some(flow) = self.flows.get_mut(&stream) else {
            return;
        };
        if let Want::At(..) = fetch.want {
            if let Some(filled) = flow.fill(Some((meta.epoch, meta.seq))) {
                if filled.gone > 0 {
                    let gone = SampleMeta {
                        epoch: filled.epoch,
                        seq: filled.gone_until,
                        ..SampleMeta::default()
                    };
                    self.push_gone(stream, &gone, filled.gone);
                }
                if filled.wanted {
                    self.push_left_out(stream, meta);
                }
            }
        } else if !fetch.again && flow.is_every() {
            self.tell_gap(stream, meta);
            self.leave_out(stream, meta);
            if let Some(flow) = self.flows.get_mut(&stream)
                && (flow.sent() >= newest || flow.sent() < Some((meta.epoch, meta.seq)))
            {
                flow.waits = None;
            }
        } else if !fetch.again {
            flow.give_up(fetch.want);
        }
        self.take_turns(stream);
    }

    /// Something newer than what was offered here lies in the store.
    pub(super) fn wait(&mut self, stream: StreamId, now: Time) {
        self.forget_turns(stream);
        if let Some(flow) = self.flows.get_mut(&stream) {
            flow.waits.get_or_insert(now);
        }
        self.take_turns(stream);
    }

    /// Whether samples of a stream wait in the store for their turn.
    pub(super) fn waits(&self, stream: StreamId) -> bool {
        let flow = self.flows.get(&stream);
        flow.is_some_and(|flow| flow.waits.is_some())
    }

    /// A reader here needs the newest sample again.
    pub(super) fn repeat(&mut self, stream: StreamId, newest: Option<(Epoch, Seq)>) {
        self.forget_turns(stream);
        let Some(flow) = self.flows.get_mut(&stream) else {
            return;
        };
        let is_busy = flow.is_busy();
        match newest.and_then(|at| flow.transfer(at)) {
            Some(transfer) if transfer.is_under_way() => {}
            Some(transfer) => transfer.ask_last(),
            // It comes in its turn, and out of turn only behind what is on its way.
            None if is_busy => {}
            None => flow.urgent = true,
        }
        self.take_turns(stream);
    }

    /// A reader lacks samples.
    pub(super) fn handle_gap(&mut self, stream: StreamId, epoch: Epoch, first: Seq, count: u32) {
        self.forget_turns(stream);
        if let Some(flow) = self.flows.get_mut(&stream)
            && flow.is_every()
        {
            flow.add_gap(epoch, first, count, &[]);
        }
        self.take_turns(stream);
    }

    /// A reader lacks parts of a sample. Whether it will get them.
    pub(super) fn handle_parts(
        &mut self,
        stream: StreamId,
        at: (Epoch, Seq),
        parts: &[(u32, u32)],
        is_newest: bool,
        now: Time,
    ) -> bool {
        self.forget_turns(stream);
        let flight = self.flight();
        let mut answered = true;
        if let Some(flow) = self.flows.get_mut(&stream) {
            if let Some(transfer) = flow.transfer(at) {
                for (offset, len) in parts {
                    transfer.ask(*offset, *len, flight, now);
                }
            } else if flow.is_every() || is_newest {
                // It went another way, or long ago.
                flow.add_gap(at.0, at.1, 1, parts);
            } else {
                answered = false;
            }
        }
        self.take_turns(stream);
        answered
    }

    /// Every reader here holds a sample.
    pub(super) fn release(&mut self, stream: StreamId, held: (Epoch, Seq)) {
        if let Some(flow) = self.flows.get_mut(&stream) {
            flow.release(held);
        }
    }

    /// The next thing to read from the store, if there is room for it.
    pub(super) fn poll_fetch(&mut self, now: Time) -> Option<Fetch> {
        let rate = self.congestion.rate();
        let (turn, stream) = *self.hungry.first()?;
        let flow = self.flows.get_mut(&stream)?;
        let lane = lane_of(flow.is_command(), flow.urgent);
        if self.lanes[lane].len() >= room(rate) {
            return None;
        }
        self.hungry.remove(&(turn, stream));
        let (want, again) = flow.fetch(now)?;
        Some(Fetch {
            stream,
            to: self.addr,
            want,
            again,
        })
    }

    /// No datagram waits for company any longer, unless the rate holds it back anyway.
    pub(super) fn flush(&mut self, now: Time) {
        let backlog = self.lanes.iter().any(|queue| !queue.is_empty());
        if backlog && self.pace.blocked_until(now).is_none() {
            self.lanes.iter_mut().for_each(Queue::close);
        }
    }

    /// Whether something could leave, now or once the rate allows.
    pub(super) fn is_ready(&self) -> bool {
        !self.sending.is_empty()
            || !self.repairing.is_empty()
            || self.lanes.iter().any(|queue| !queue.is_empty())
    }

    /// When something can leave, if that is later than `now`.
    pub(super) fn blocked_until(&mut self, now: Time) -> Option<Time> {
        // A command waits for no other datagram of this host; those after it wait longer.
        let ahead = if self.has_command() {
            self.command_ahead()
        } else {
            Duration::ZERO
        };
        self.pace.blocked_until(now + ahead).map(|at| at - ahead)
    }

    /// Whether more piles up on the way than jitter explains.
    pub(super) fn is_strained(&self) -> bool {
        self.congestion.queue() > QUEUE_LOW_MAX
    }

    /// Whether a command is about to leave, which waits for the rate only if there are many.
    pub(super) fn has_command(&self) -> bool {
        self.lanes[COMMANDS].is_ready()
    }

    /// By how much commands may be ahead of the rate: what one datagram takes, of another and of their own.
    fn command_ahead(&self) -> Duration {
        let batch = batch_bytes(self.congestion.rate()).max(self.datagram_bytes);
        span_of(2 * batch, self.congestion.rate())
    }

    /// Most urgent lane that has something, as a rank: 0 is first.
    pub(super) fn rank(&self) -> Option<usize> {
        let queued = self.lanes.iter().position(Queue::is_ready);
        let waiting = if !self.repairing.is_empty() {
            Some(REPEATS)
        } else if !self.sending.is_empty() {
            Some(BULK)
        } else {
            None
        };
        queued.into_iter().chain(waiting).min()
    }

    /// Notes that a group is tried in place of this path, or beside it.
    pub(super) fn leave(&mut self, now: Time) {
        self.congestion.leave(now);
    }

    /// Notes that the group was given up.
    pub(super) fn come_back(&mut self, now: Time) {
        self.congestion.come_back(now);
    }

    /// Seals the next batch into `out`.
    pub(super) fn poll_transmit(
        &mut self,
        sealer: &mut Sealer,
        out: &mut Vec<u8>,
        now: Time,
    ) -> Option<Transmit> {
        let rank = self.rank()?;
        let rate = self.congestion.rate();
        let limit = Limit {
            segments: self.segments_max,
            bytes: batch_bytes(rate).min(BATCH_BYTES),
        };
        if !self.lanes[rank].is_ready() {
            self.cut(rank, limit, now);
        }
        let micros = now.0 / 1_000;
        let mut preamble = Preamble {
            path: self.number,
            number: self.datagrams,
            sent_us: u32::try_from(micros & u64::from(u32::MAX)).unwrap_or_default(),
            is_probe: false,
            is_limited: self.pace.is_limited(now),
        };
        let first = self.lanes[rank].pop(LANES[rank], sealer, limit, &mut preamble, out);
        self.datagrams = preamble.number;
        if first == 0 {
            return None;
        }
        self.note_departure(now);
        self.pace.spend(out.len(), rate, now);
        if self.unreported_bytes == 0 {
            self.unreported_since = now;
        }
        self.unreported_bytes += out.len();
        let silent = self.unreported_bytes > SILENT_BYTES;
        if silent
            && self
                .congestion
                .handle_silence(self.unreported_since, self.round_trip, now)
        {
            // Perhaps the way became one for shorter datagrams.
            self.datagram_bytes = self.datagram_bytes.min(self.datagram_bytes_safe);
        }
        let segment = (out.len() > first)
            .then(|| u16::try_from(first).ok())
            .flatten();
        Some(Transmit {
            to: self.addr,
            segment,
        })
    }

    /// Large samples that left in full since the last call.
    pub(super) fn take_left(&mut self) -> Vec<(StreamId, Epoch, Seq)> {
        std::mem::take(&mut self.left)
    }

    /// Cuts the next fragments into datagrams: a batch of one stream, or what is asked for again.
    fn cut(&mut self, rank: usize, limit: Limit, now: Time) {
        let repairs = rank == REPEATS;
        let turns = if repairs {
            &self.repairing
        } else {
            &self.sending
        };
        let Some(&(_, stream)) = turns.first() else {
            return;
        };
        self.forget_turns(stream);
        let datagram_bytes = self.datagram_bytes;
        if let Some(flow) = self.flows.get_mut(&stream) {
            let queue = &mut self.lanes[rank];
            let wanted = |transfer: &&mut Transfer<P>| match repairs {
                true => transfer.repairs(),
                false => transfer.is_under_way(),
            };
            let mut cut_bytes = 0;
            if let Some(transfer) = flow.transfers.iter_mut().find(wanted) {
                let (meta, again) = (*transfer.meta(), repairs || transfer.is_again());
                for _ in 0..limit.segments {
                    let next = match repairs {
                        true => transfer.next_repair(now),
                        false => transfer.next_fragment(now),
                    };
                    let Some((fragment, payload)) = next else {
                        break;
                    };
                    let record = Record {
                        stream,
                        repeat: again,
                        gone: false,
                        meta,
                        fragment: Some(fragment),
                        payload,
                    };
                    queue.close();
                    queue.push(&record, datagram_bytes);
                    cut_bytes += RECORD_BYTES + payload.len();
                    if queue.len() >= limit.bytes {
                        break;
                    }
                }
                queue.close();
                if !repairs && !transfer.is_under_way() {
                    self.left.push((stream, meta.epoch, meta.seq));
                }
            }
            self.turn = flow.charge(cut_bytes, self.turn);
        }
        self.take_turns(stream);
    }

    /// Queues a sample, or begins with its fragments. `again` holds the parts that are wanted of one that was sent before;
    /// none of them is all.
    fn admit(
        &mut self,
        stream: StreamId,
        meta: &SampleMeta,
        payload: &P,
        again: Option<&[(u32, u32)]>,
        now: Time,
    ) -> Offered {
        self.forget_turns(stream);
        let Some(flow) = self.flows.get_mut(&stream) else {
            return Offered::Goes;
        };
        let filtered = match again {
            Some(_) if flow.sent() >= Some((meta.epoch, meta.seq)) => flow.filtered(meta),
            Some(_) | None => flow.pass(meta),
        };
        let meta = SampleMeta { filtered, ..*meta };
        let bytes = payload.as_ref();
        flow.count_bytes(bytes.len());
        let offered = if self.datagram_bytes < alone_bytes(stream, &meta, bytes) {
            let step = self.datagram_bytes - DATAGRAM_OVERHEAD - FRAGMENT_RECORD_BYTES;
            let parities = parity::Link {
                loss_permille: self.congestion.mean_loss_permille(),
                rate: self.congestion.rate(),
                round_trip: self.round_trip,
            }
            .parities(bytes.len().div_ceil(step.max(1)), step);
            let transfer = Transfer::new(meta, payload.clone(), step, now);
            flow.begin(match again {
                None => transfer.protect(parities),
                Some([]) => transfer.protect(parities).again(&[], now),
                Some(parts) => transfer.again(parts, now),
            });
            Offered::Begins
        } else {
            let record = Record {
                stream,
                repeat: again.is_some(),
                gone: false,
                meta,
                fragment: None,
                payload: bytes,
            };
            let lane = lane_of(flow.is_command(), again.is_some());
            self.turn = flow.charge(RECORD_BYTES + bytes.len(), self.turn);
            self.lanes[lane].push(&record, self.datagram_bytes);
            if lane == COMMANDS {
                self.lanes[lane].close();
            }
            Offered::Goes
        };
        self.take_turns(stream);
        if offered == Offered::Begins {
            self.probe(now);
        }
        offered
    }

    /// Tries, now and then, whether longer datagrams get through to those at the other end.
    fn probe(&mut self, now: Time) {
        if now < self.probe_at {
            return;
        }
        let pause = PROBE_PAUSES.get(self.probes).copied();
        self.probe_at = now + pause.unwrap_or(PROBE_PAUSE);
        self.probes = self.probes.saturating_add(1);
        let longest = match self.is_group() {
            true => ETHERNET_BYTES,
            false => self.datagram_bytes_max,
        };
        let lengths = [ETHERNET_BYTES, longest];
        for len in lengths.map(|len| len.min(self.datagram_bytes_max)) {
            if len <= self.datagram_bytes || span_of(len, self.congestion.rate()) > PROBE_SPAN {
                continue;
            }
            self.lanes[REPEATS].push_padding(len);
        }
    }

    fn forget_turns(&mut self, stream: StreamId) {
        if let Some(flow) = self.flows.get(&stream) {
            let entry = (flow.turn(), stream);
            self.hungry.remove(&entry);
            self.sending.remove(&entry);
            self.repairing.remove(&entry);
        }
    }

    /// Lists a flow where it has something to do, and nowhere else: what heads a list for nothing would hide the others.
    fn take_turns(&mut self, stream: StreamId) {
        self.forget_turns(stream);
        if let Some(flow) = self.flows.get(&stream) {
            let entry = (flow.turn(), stream);
            if flow.wants_fetch() {
                self.hungry.insert(entry);
            }
            if flow.is_under_way() {
                self.sending.insert(entry);
            }
            if flow.repairs() {
                self.repairing.insert(entry);
            }
        }
    }
}

/// Length of the datagram that holds a sample alone.
fn alone_bytes(stream: StreamId, meta: &SampleMeta, payload: &[u8]) -> usize {
    let record = Record {
        stream,
        repeat: false,
        gone: false,
        meta: *meta,
        fragment: None,
        payload,
    };
    DATAGRAM_OVERHEAD + record.encoded_len(Place::Alone)
}

fn lane_of(command: bool, again: bool) -> usize {
    match (command, again) {
        (true, _) => COMMANDS,
        (false, true) => REPEATS,
        (false, false) => VALUES,
    }
}

/// Bytes that may wait in one lane: what the rate sends in 4 ms, and at least the datagram that is being filled.
fn room(rate: u64) -> usize {
    usize::try_from(rate / 250).map_or(ROOM_MAX, |bytes| bytes.clamp(1, ROOM_MAX))
}

/// What is sent, by rank, most urgent first, and its lane on the wire.
const LANES: [Lane; 4] = [Lane::Commands, Lane::Commands, Lane::Values, Lane::Bulk];
const COMMANDS: usize = 0;
const REPEATS: usize = 1;
const VALUES: usize = 2;
const BULK: usize = 3;
/// `PROTOCOL.md#limits`: what one segmented send of the kernel takes.
const BATCH_BYTES: usize = 60_000;
/// `PROTOCOL.md#limits`: bytes queued in one lane of one path.
const ROOM_MAX: usize = 256 << 10;
/// `PROTOCOL.md#limits`: the first length that is tried: what an Ethernet frame of 1,500 bytes carries.
const ETHERNET_BYTES: usize = 1_472;
/// Time between two tries: of the first few one is answered even where a third is lost.
const PROBE_PAUSES: [Duration; 4] = [
    Duration::from_millis(100),
    Duration::from_millis(300),
    Duration::from_secs(1),
    Duration::from_secs(3),
];
const PROBE_PAUSE: Duration = Duration::from_secs(10);
/// A length that takes longer is not tried: on a slow path that costs more than it gains.
const PROBE_SPAN: Duration = Duration::from_millis(10);
/// So much may be sent without a report before their absence means something: receivers report each 2 KiB.
const SILENT_BYTES: usize = 16 << 10;
