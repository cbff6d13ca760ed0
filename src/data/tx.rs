//! The thread that sends samples: the store in, sockets out.
//!
//! It is an ordinary reader of each item that somebody elsewhere reads, with one bell for all of them. The store keeps
//! the samples, so nothing is queued here: what cannot be sent now is read again when it can.

use std::collections::HashMap;
use std::io;
use std::sync::Arc;
use std::thread::{self, JoinHandle};
use std::time::Duration;

use anyhow::Context;
use ddx_catalog::delivery::{Due, Fetch, Route, Sender, SenderConfig, SenderEvent, Want};
use ddx_store::{Cursor, Meta, RawGuard, RawReader, Store, Taken, WaitKey, WaitSet, Waker};
use ddx_wire::message::{NackEntry, ReportEntry};
use ddx_wire::sample::SampleMeta;
use ddx_wire::seal::Sealer;
use ddx_wire::{Delivery, Epoch, Seq, StreamId, Tag, Time};

use super::board::{self, Board, Outward};
use super::{Traffic, count, mailbox};
use crate::net::Channel;

/// Orders that wait for the thread at most, taken at the next wake-up: 4 MiB, as none but a route of many readers has more
/// than 1 KiB. While they are so many the control loop waits.
const ORDERS: usize = 4096;
/// How long the control loop waits for a data thread: it takes its orders between two batches.
const PATIENCE: Duration = Duration::from_secs(1);
/// Longest sleep.
const SLEEP_MAX: Duration = Duration::from_millis(100);
/// Samples of one item read before the next item gets its turn: of small ones, what fills one segmented send.
const SAMPLES_PER_TURN: usize = 512;
/// A stream that was behind its paths for so long goes on with its newest sample, unless each one is wanted.
const BEHIND_MAX: Duration = Duration::from_millis(20);

/// What the control loop asks of the thread.
pub(crate) enum Order {
    /// Somebody elsewhere reads an item.
    Open {
        stream: StreamId,
        route: Route,
        reader: Box<RawReader>,
    },
    /// Its readers or its path changed.
    Update { stream: StreamId, route: Route },
    /// Nobody reads it any longer.
    Close(StreamId),
    /// What a reading host says that it holds.
    Held {
        stream: StreamId,
        tag: Tag,
        epoch: Epoch,
        seq: Seq,
    },
    /// How long a reading host's answers take.
    RoundTrip { tag: Tag, time: Duration },
    /// How datagrams reach a reading host.
    Report { tag: Tag, report: ReportEntry },
    /// What a reading host lacks.
    Nack { tag: Tag, nack: NackEntry },
    /// End the thread.
    Stop,
}

/// The running thread.
pub(crate) struct Tx {
    orders: mailbox::Sender<Order>,
    waker: Waker,
    thread: JoinHandle<()>,
}

struct State {
    channel: Channel,
    sender: Sender<Payload>,
    set: WaitSet,
    streams: HashMap<StreamId, Stream>,
    by_key: HashMap<WaitKey, StreamId>,
    traffic: Arc<Traffic>,
    board: Arc<Board>,
    shown: Time,
    datagrams: Vec<u8>,
    /// Where small samples are copied to, each in its turn.
    copied: Vec<u8>,
    spin: bool,
}

/// A sample on its way: a small one is copied twice within a call, a large one held in place while its fragments leave.
#[derive(Clone)]
enum Payload {
    Copied(Vec<u8>),
    Held(Arc<RawGuard>),
}

/// One item under one contract, on its way out.
struct Stream {
    key: WaitKey,
    limited: bool,
    is_every: bool,
    newest: (Epoch, Seq),
    /// Where the newest sample lay, from which the places of others follow.
    cursor: Cursor,
    /// When the rate allows the next sample, if one is waiting for that.
    due: Option<Time>,
    /// Since when samples wait in the store that no path had room for.
    behind: Option<Time>,
    /// Whether nothing more is read before a path asks.
    paused: bool,
}

impl Tx {
    /// Starts the thread. `store` is a connection of its own, whose bell the thread sleeps on.
    pub(crate) fn start(
        channel: Channel,
        store: &Store,
        sealer: Sealer,
        (traffic, board): (Arc<Traffic>, Arc<Board>),
        spin: bool,
    ) -> anyhow::Result<Self> {
        let (orders, inbox) =
            mailbox::mailbox(ORDERS).context("making the queue of the sending thread")?;
        let set = WaitSet::new(store);
        let waker = set.waker();
        let config = SenderConfig {
            segments_max: channel.max_segments(),
            ..SenderConfig::default()
        };
        let mut state = State {
            channel,
            sender: Sender::new(config, sealer, ddx_store::now()),
            set,
            streams: HashMap::new(),
            by_key: HashMap::new(),
            traffic,
            board,
            shown: ddx_store::now(),
            datagrams: Vec::new(),
            copied: Vec::new(),
            spin,
        };
        let thread = thread::Builder::new()
            .name("ddx-tx".to_owned())
            .spawn(move || state.run(&inbox))
            .context("starting the sending thread")?;
        Ok(Self {
            orders,
            waker,
            thread,
        })
    }

    /// Gives an order. Blocks while the thread is far behind, at most [`PATIENCE`]; then it hangs, which is the error.
    pub(crate) fn order(&self, order: Order) -> anyhow::Result<()> {
        let sent = self.orders.send_within(order, PATIENCE);
        self.waker.wake();
        sent.map_err(|_order| anyhow::anyhow!("the sending thread has {ORDERS} orders waiting"))
    }

    /// Ends the thread and waits for it.
    pub(crate) fn stop(self) {
        if self.order(Order::Stop).is_ok() && self.thread.join().is_err() {
            tracing::error!("the sending thread panicked");
        }
    }
}

impl State {
    fn run(&mut self, inbox: &mailbox::Receiver<Order>) {
        let mut rung = Vec::new();
        loop {
            for order in inbox.drain() {
                if matches!(order, Order::Stop) {
                    return;
                }
                self.obey(order);
            }
            for key in rung.drain(..) {
                if let Some(&stream) = self.by_key.get(&key) {
                    self.pull(stream);
                }
            }
            let now = ddx_store::now();
            self.pull_due(now);
            self.sender.handle_timeout(now);
            self.send();
            self.show(now);
            let timeout = if self.spin {
                Duration::ZERO
            } else {
                self.sleep_for(ddx_store::now())
            };
            self.set.wait(timeout, &mut rung);
            if self.spin && rung.is_empty() {
                // Where there are fewer cores than threads that spin, the others get their turn.
                thread::yield_now();
            }
        }
    }

    /// Puts up the books, now and then.
    fn show(&mut self, now: Time) {
        if now.since(self.shown) >= board::PERIOD {
            self.shown = now;
            self.board.put_sent(self.sender.counters());
            self.board.put_outward(Outward {
                at: now,
                sources: self.sender.source_books().collect(),
                sent: self.sender.sent_books().collect(),
                paths: self.sender.paths().collect(),
            });
        }
    }

    fn sleep_for(&self, now: Time) -> Duration {
        let machine = self.sender.poll_timeout().map(|(at, _why)| at);
        let rates = self.streams.values().filter_map(|stream| stream.due).min();
        machine
            .into_iter()
            .chain(rates)
            .min()
            .map_or(SLEEP_MAX, |at| at.since(now).min(SLEEP_MAX))
    }

    fn obey(&mut self, order: Order) {
        let now = ddx_store::now();
        match order {
            Order::Open {
                stream,
                route,
                reader,
            } => {
                let limited = route.contract.interval_ns() > 0;
                self.sender.open(stream, &route, now);
                let key = self.set.add(*reader);
                self.by_key.insert(key, stream);
                self.streams.insert(
                    stream,
                    Stream {
                        key,
                        limited,
                        is_every: route.contract.delivery != Delivery::Latest,
                        newest: Default::default(),
                        cursor: Cursor::default(),
                        due: None,
                        behind: None,
                        paused: false,
                    },
                );
            }
            Order::Update { stream, route } => {
                self.sender.update(stream, &route, now);
                self.resume(stream);
            }
            Order::Close(stream) => {
                self.sender.close(stream);
                if let Some(closed) = self.streams.remove(&stream) {
                    self.by_key.remove(&closed.key);
                    self.set.remove(closed.key);
                }
            }
            Order::RoundTrip { tag, time } => self.sender.round_trip(tag, time),
            Order::Report { tag, report } => self.sender.handle_report(tag, &report, now),
            Order::Nack { tag, nack } => self.sender.handle_nack(tag, &nack, now),
            Order::Held {
                stream,
                tag,
                epoch,
                seq,
            } => self.sender.held(stream, tag, epoch, seq, now),
            Order::Stop => {}
        }
    }

    /// Sends what a stream's item has that was not sent yet, as far as its rate and its paths allow.
    fn pull(&mut self, id: StreamId) {
        let Self {
            streams,
            set,
            sender,
            copied,
            ..
        } = self;
        let Some(stream) = streams.get_mut(&id).filter(|stream| !stream.paused) else {
            return;
        };
        let Some(reader) = set.reader(stream.key) else {
            return;
        };
        let mut now = ddx_store::now();
        let overdue = stream.behind.is_some_and(|b| now.since(b) > BEHIND_MAX);
        let mut skips = overdue && !stream.is_every;
        for _turn in 0..SAMPLES_PER_TURN {
            if stream.limited {
                now = ddx_store::now();
                if let Due::At(at) = sender.due(id, now) {
                    stream.due = Some(at);
                    return;
                }
                stream.due = None;
            }
            let read = if stream.limited || std::mem::take(&mut skips) {
                reader.take_current(copied)
            } else {
                reader.take_next(copied, Duration::ZERO)
            };
            match read {
                Ok(Some(taken)) if stream.is_new(taken.meta()) => {
                    let has_room = stream.write(id, taken, sender, copied, now);
                    // One that the contract keeps slow is offered at its rate all the same: what goes is the newest anyway.
                    if !has_room && !stream.limited {
                        stream.behind.get_or_insert(now);
                        stream.paused = true;
                        set.mute(stream.key);
                        return;
                    }
                }
                Ok(Some(_)) if !stream.limited => {}
                Ok(_) => {
                    stream.behind = None;
                    return;
                }
                Err(error) => {
                    tracing::debug!(%error, stream = id.0, "reading an item to send");
                    return;
                }
            }
        }
        // More is waiting: take the next turn at once, after the other items.
        set.mark(stream.key);
    }

    /// Reads on where a stream was left because its paths were full.
    fn resume(&mut self, id: StreamId) {
        if let Some(stream) = self.streams.get_mut(&id)
            && std::mem::take(&mut stream.paused)
        {
            self.set.unmute(stream.key);
            self.pull(id);
        }
    }

    fn pull_due(&mut self, now: Time) {
        let due: Vec<StreamId> = self
            .streams
            .iter()
            .filter(|(_, s)| s.due.is_some_and(|at| at <= now))
            .map(|(&id, _)| id)
            .collect();
        for id in due {
            self.pull(id);
        }
    }

    /// Reads from the store what the paths have room for.
    fn fetch(&mut self) {
        while let Some(SenderEvent::Fetch(fetch)) = self.sender.poll_event() {
            let stream = self.streams.get_mut(&fetch.stream);
            let found = stream.and_then(|stream| {
                let reader = self.set.reader(stream.key)?;
                let taken = stream.find(&fetch, reader, &mut self.copied)?;
                let meta = sample_meta(taken.meta());
                Some((meta, Payload::new(taken, &mut self.copied)))
            });
            let now = ddx_store::now();
            let given = found.as_ref().map(|(meta, payload)| (meta, payload));
            self.sender.fetched(&fetch, given, now);
            if let Some((_, payload)) = found {
                payload.give_back(&mut self.copied);
            }
            self.resume(fetch.stream);
        }
    }

    fn send(&mut self) {
        loop {
            self.fetch();
            self.sender.flush(ddx_store::now());
            let Some(transmit) = self.sender.poll_transmit(&mut self.datagrams) else {
                return;
            };
            let segment = transmit.segment.map(usize::from);
            let datagrams = segment.map_or(1, |size| self.datagrams.len().div_ceil(size.max(1)));
            match self.channel.send(transmit.to, &self.datagrams, segment) {
                Ok(()) => {
                    count(&self.traffic.sent_datagrams, datagrams);
                    count(&self.traffic.sent_bytes, self.datagrams.len());
                }
                Err(error) => {
                    count(&self.traffic.unsent_datagrams, datagrams);
                    if error.kind() != io::ErrorKind::WouldBlock {
                        tracing::debug!(to = %transmit.to, %error, "sending samples");
                    }
                }
            }
        }
    }
}

impl Stream {
    fn is_new(&self, meta: &Meta) -> bool {
        (meta.epoch, meta.seq) > self.newest
    }

    /// Offers a sample to the stream's paths; false when all of them are full.
    fn write(
        &mut self,
        id: StreamId,
        taken: Taken,
        sender: &mut Sender<Payload>,
        copied: &mut Vec<u8>,
        now: Time,
    ) -> bool {
        let meta = sample_meta(taken.meta());
        self.newest = (meta.epoch, meta.seq);
        self.cursor = taken.meta().cursor();
        let payload = Payload::new(taken, copied);
        let has_room = sender.write(id, &meta, &payload, now);
        payload.give_back(copied);
        has_room
    }

    /// The sample that is wanted, while the store has it.
    fn find(
        &mut self,
        fetch: &Fetch,
        reader: &mut RawReader,
        copied: &mut Vec<u8>,
    ) -> Option<Taken> {
        let read = match fetch.want {
            // Who reads on behind it must miss nothing: for these the newest is the last one that was offered.
            Want::Newest if self.is_every && self.newest.1 > Seq(0) => {
                let (epoch, Seq(seq)) = self.newest;
                let before = self.cursor_of(epoch, Seq(seq.saturating_sub(1)));
                reader.take_after(&before, copied)
            }
            Want::Newest => reader.take_current(copied),
            Want::After(epoch, seq) => reader.take_after(&self.cursor_of(epoch, seq), copied),
            Want::At(epoch, Seq(seq)) => {
                let before = self.cursor_of(epoch, Seq(seq.saturating_sub(1)));
                reader.take_after(&before, copied)
            }
        };
        match read {
            Ok(taken) => {
                if let Some(meta) = taken.as_ref().map(Taken::meta)
                    && !self.limited
                    && self.is_new(meta)
                {
                    self.newest = (meta.epoch, meta.seq);
                    self.cursor = meta.cursor();
                }
                taken
            }
            Err(error) => {
                tracing::debug!(%error, stream = fetch.stream.0, "reading an item to send");
                None
            }
        }
    }

    /// Where a sample lies: as many places before the newest one as its number is smaller.
    fn cursor_of(&self, epoch: Epoch, seq: Seq) -> Cursor {
        let near = Cursor {
            epoch,
            seq,
            ..Cursor::default()
        };
        let ahead = self.cursor.seq.0.checked_sub(seq.0);
        match ahead.and_then(|ahead| self.cursor.pos.checked_sub(ahead)) {
            Some(pos) if epoch == self.cursor.epoch => Cursor {
                segment: self.cursor.segment,
                pos,
                ..near
            },
            Some(_) | None => near,
        }
    }
}

impl Payload {
    /// Borrows the buffer of copies until it is given back.
    fn new(taken: Taken, copied: &mut Vec<u8>) -> Self {
        match taken {
            Taken::Copied(_) => Self::Copied(std::mem::take(copied)),
            Taken::Held(guard) => Self::Held(Arc::new(guard)),
        }
    }

    fn give_back(self, copied: &mut Vec<u8>) {
        if let Self::Copied(bytes) = self {
            *copied = bytes;
        }
    }
}

impl AsRef<[u8]> for Payload {
    fn as_ref(&self) -> &[u8] {
        match self {
            Self::Copied(bytes) => bytes,
            Self::Held(guard) => guard.bytes(),
        }
    }
}

/// What is told about a sample. How many were left out before it is the sender's to say.
fn sample_meta(meta: &Meta) -> SampleMeta {
    SampleMeta {
        epoch: meta.epoch,
        seq: meta.seq,
        filtered: 0,
        capture: meta.capture,
        publish: meta.publish,
    }
}
