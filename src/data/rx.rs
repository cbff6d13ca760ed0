//! The thread that receives samples: sockets in, mirrors out.

use std::borrow::Cow;
use std::collections::{HashMap, VecDeque};
use std::net::UdpSocket;
use std::os::fd::{AsFd, BorrowedFd};
use std::sync::Arc;
use std::thread::{self, JoinHandle};
use std::time::Duration;

use anyhow::Context;
use ddx_catalog::delivery::{
    Held, Passed, Received, Receiver, ReceiverConfig, ReceiverCounters, ReceiverEvent,
};
use ddx_store::{Origin, RawWriter};
use ddx_wire::message::{NackEntry, ReportEntry};
use ddx_wire::seal::Opener;
use ddx_wire::{ClockOffset, Contract, Epoch, Seq, StreamId, Tag, Time};
use rustix::event::{PollFd, PollFlags, Timespec, poll};

use super::board::{self, Board, Inward, Mirrored};
use super::{Traffic, count, mailbox};
use crate::net::Channel;

/// Orders that wait for the thread at most, of 2 KiB at most and taken at the next wake-up: 8 MiB. While they are so many
/// the control loop waits.
const ORDERS: usize = 4096;
/// How long the control loop waits for a data thread: it takes its orders between two batches.
const PATIENCE: Duration = Duration::from_secs(1);
/// Longest sleep, so that counters stay fresh.
const SLEEP_MAX: Duration = Duration::from_secs(1);
/// Which of the two sockets is the one of multicast samples.
const GROUP: usize = 1;
/// Of a large sample so much is copied at a time: some 30 us.
const PIECE_BYTES: usize = 128 << 10;
/// Batches taken from one socket before the other gets its turn.
const BATCHES_PER_TURN: usize = 8;

/// Number of a mirror, given by the control loop.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub(crate) struct MirrorId(pub(crate) u64);

/// What the control loop asks of the thread.
pub(crate) enum Order {
    /// Open what that life of a host seals.
    Session { tag: Tag, opener: Opener },
    /// Accept nothing more from it.
    DropSession(Tag),
    /// Write samples of some stream here.
    Mirror { mirror: MirrorId, writer: RawWriter },
    /// Close a mirror, which removes it.
    DropMirror(MirrorId),
    /// Samples of that stream belong to that mirror.
    Expect {
        tag: Tag,
        stream: StreamId,
        contract: Contract,
        mirror: MirrorId,
    },
    /// How long a sender's answers take.
    RoundTrip { tag: Tag, time: Duration },
    /// A stream is over.
    Forget { tag: Tag, stream: StreamId },
    /// A peer's clock against ours.
    Clock { tag: Tag, offset: ClockOffset },
    /// End the thread.
    Stop,
}

/// What the thread tells the control loop.
pub(crate) enum Notice {
    /// What is held of a stream; to be acknowledged soon if it fell quiet.
    Holds {
        tag: Tag,
        stream: StreamId,
        epoch: Epoch,
        seq: Seq,
        quiet: bool,
    },
    /// Samples of a stream arrive by multicast.
    OnGroup { tag: Tag, stream: StreamId },
    /// How a sender's datagrams arrive.
    Report(Tag, ReportEntry),
    /// What is missing.
    Nack(Tag, NackEntry),
    /// A mirror is closed: its item may be mirrored anew.
    Closed(MirrorId),
    /// The receiver's counters, once a second while something arrives.
    Counters(Box<ReceiverCounters>),
}

/// The running thread.
pub(crate) struct Rx {
    orders: mailbox::Sender<Order>,
    thread: JoinHandle<()>,
}

struct State {
    channels: [Channel; 2],
    receiver: Receiver,
    inbound: Inbound,
    notices: mailbox::Sender<Notice>,
    /// Mirrors whose end has not been told yet.
    closed: VecDeque<MirrorId>,
    told: Time,
    board: Arc<Board>,
    shown: Time,
    spin: bool,
}

/// Where samples go.
struct Inbound {
    mirrors: HashMap<MirrorId, Mirror>,
    streams: HashMap<(Tag, StreamId), Stream>,
    /// What is known of the senders' clocks, and since when.
    clocks: HashMap<Tag, (ClockOffset, Time)>,
    /// Mirrors that a large sample is copied to.
    copying: Vec<MirrorId>,
    traffic: Arc<Traffic>,
}

/// What is expected of a sender.
struct Stream {
    mirror: MirrorId,
    counts: Mirrored,
}

struct Mirror {
    writer: RawWriter,
    newest: (Epoch, Seq),
    /// Who sent that.
    from: Option<Tag>,
    /// Samples of the epoch that the source did not send: what a reader here cannot know otherwise.
    passed: Passed,
    copying: Option<Copying>,
}

/// A large sample on its way into the store, a piece at a time: others do not wait for it.
struct Copying {
    payload: Vec<u8>,
    copied: usize,
    origin: Origin,
}

/// Samples of one stream that come one after the other: what they have in common.
struct Run<'a> {
    of: (Tag, StreamId),
    to: MirrorId,
    mirror: Option<&'a mut Mirror>,
    counts: &'a mut Mirrored,
    clock: Option<ClockOffset>,
}

impl Rx {
    /// Starts the thread on the socket of unicast samples and the one of multicast samples.
    pub(crate) fn start(
        data: UdpSocket,
        group: UdpSocket,
        config: ReceiverConfig,
        notices: mailbox::Sender<Notice>,
        (traffic, board): (Arc<Traffic>, Arc<Board>),
        spin: bool,
    ) -> anyhow::Result<Self> {
        let (orders, inbox) =
            mailbox::mailbox(ORDERS).context("making the queue of the receiving thread")?;
        let sockets = [data.try_clone()?, group.try_clone()?];
        let now = ddx_store::now();
        let mut state = State {
            channels: [Channel::new(data)?, Channel::new(group)?],
            receiver: Receiver::new(config),
            inbound: Inbound {
                mirrors: HashMap::new(),
                streams: HashMap::new(),
                clocks: HashMap::new(),
                copying: Vec::new(),
                traffic,
            },
            notices,
            closed: VecDeque::new(),
            told: now,
            board,
            shown: now,
            spin,
        };
        let thread = thread::Builder::new()
            .name("ddx-rx".to_owned())
            .spawn(move || state.run(&sockets, &inbox))
            .context("starting the receiving thread")?;
        Ok(Self { orders, thread })
    }

    /// Gives an order. Blocks while the thread is far behind, at most [`PATIENCE`]; then it hangs, which is the error.
    pub(crate) fn order(&self, order: Order) -> anyhow::Result<()> {
        self.orders
            .send_within(order, PATIENCE)
            .map_err(|_order| anyhow::anyhow!("the receiving thread has {ORDERS} orders waiting"))
    }

    /// Ends the thread and waits for it.
    pub(crate) fn stop(self) {
        if self.order(Order::Stop).is_ok() && self.thread.join().is_err() {
            tracing::error!("the receiving thread panicked");
        }
    }
}

impl State {
    fn run(&mut self, sockets: &[UdpSocket; 2], inbox: &mailbox::Receiver<Order>) {
        let mut ready = [true; 2];
        loop {
            for order in inbox.drain() {
                if matches!(order, Order::Stop) {
                    return;
                }
                self.obey(order);
            }
            let mut arrived = 0;
            for (index, ready) in ready.into_iter().enumerate() {
                if ready {
                    arrived += self.receive(index);
                }
            }
            let now = ddx_store::now();
            self.receiver.handle_timeout(now);
            self.inbound.take(&mut self.receiver, now);
            self.inbound.copy();
            self.report(now);
            if !self.spin {
                ready = self.sleep([sockets[0].as_fd(), sockets[1].as_fd(), inbox.as_fd()], now);
            } else if arrived == 0 {
                // Where there are fewer cores than threads that spin, the others get their turn.
                thread::yield_now();
            }
        }
    }

    /// Sleeps until something is there, and says which of the sockets has something.
    fn sleep(&self, fds: [BorrowedFd<'_>; 3], now: Time) -> [bool; 2] {
        let due = self.receiver.poll_timeout().map(|(at, _why)| at.since(now));
        let span = match self.inbound.copying.is_empty() {
            true => due.map_or(SLEEP_MAX, |span| span.min(SLEEP_MAX)),
            false => Duration::ZERO,
        };
        let span = Timespec {
            tv_sec: i64::try_from(span.as_secs()).unwrap_or(1),
            tv_nsec: span.subsec_nanos().into(),
        };
        let mut fds = fds.map(|fd| PollFd::from_borrowed_fd(fd, PollFlags::IN));
        match poll(&mut fds, Some(&span)) {
            Ok(_) => [0, 1].map(|socket| !fds[socket].revents().is_empty()),
            // A signal: look at all.
            Err(_) => [true; 2],
        }
    }

    /// Takes what one socket has, up to a bound, so that neither socket nor the orders starve. Returns how many datagrams.
    fn receive(&mut self, index: usize) -> usize {
        let Self {
            channels,
            receiver,
            inbound,
            ..
        } = self;
        let mut total = 0;
        for _turn in 0..BATCHES_PER_TURN {
            let taken = channels[index].receive(|_from, datagram| {
                count(&inbound.traffic.received_datagrams, 1);
                count(&inbound.traffic.received_bytes, datagram.len());
                let now = ddx_store::now();
                receiver.handle_datagram(datagram, index == GROUP, now);
                inbound.take(receiver, now);
            });
            match taken {
                Ok(batch) => {
                    total += batch.datagrams;
                    if !batch.full {
                        break;
                    }
                }
                Err(error) => {
                    tracing::debug!(%error, "receiving samples");
                    break;
                }
            }
        }
        total
    }

    fn obey(&mut self, order: Order) {
        match order {
            Order::Session { tag, opener } => self.receiver.session(tag, opener),
            Order::DropSession(tag) => {
                self.receiver.drop_session(tag);
                self.inbound.clocks.remove(&tag);
                self.inbound
                    .streams
                    .retain(|(sender, _stream), _mirror| *sender != tag);
            }
            Order::Mirror { mirror, writer } => {
                self.inbound.mirrors.insert(
                    mirror,
                    Mirror {
                        writer,
                        newest: Default::default(),
                        from: None,
                        passed: Passed::default(),
                        copying: None,
                    },
                );
            }
            Order::DropMirror(mirror) => {
                self.inbound.mirrors.remove(&mirror);
                self.inbound
                    .streams
                    .retain(|_key, stream| stream.mirror != mirror);
                self.closed.push_back(mirror);
            }
            Order::RoundTrip { tag, time } => self.receiver.round_trip(tag, time),
            Order::Expect {
                tag,
                stream,
                contract,
                mirror,
            } => {
                let now = ddx_store::now();
                let held = self.inbound.mirrors.get(&mirror);
                let held = held.and_then(Mirror::held);
                self.receiver.resume(tag, stream, &contract, held, now);
                let fresh = Stream {
                    mirror,
                    counts: Mirrored::default(),
                };
                let known = self.inbound.streams.entry((tag, stream));
                known.or_insert(fresh).mirror = mirror;
                self.inbound.take(&mut self.receiver, now);
            }
            Order::Forget { tag, stream } => {
                self.receiver.forget(tag, stream);
                self.inbound.streams.remove(&(tag, stream));
            }
            Order::Clock { tag, offset } => {
                self.inbound.clocks.insert(tag, (offset, ddx_store::now()));
            }
            Order::Stop => {}
        }
    }

    fn report(&mut self, now: Time) {
        while let Some(event) = self.receiver.poll_event() {
            let notice = match event {
                ReceiverEvent::Quiet {
                    tag,
                    stream,
                    epoch,
                    seq,
                } => Notice::Holds {
                    tag,
                    stream,
                    epoch,
                    seq,
                    quiet: true,
                },
                ReceiverEvent::Flows {
                    tag,
                    stream,
                    epoch,
                    seq,
                } => Notice::Holds {
                    tag,
                    stream,
                    epoch,
                    seq,
                    quiet: false,
                },
                ReceiverEvent::OnGroup { tag, stream } => Notice::OnGroup { tag, stream },
                ReceiverEvent::Report(tag, report) => Notice::Report(tag, report),
                ReceiverEvent::Nack(tag, nack) => Notice::Nack(tag, nack),
            };
            // A full queue costs one acknowledgement, which the next renewal makes good.
            if self.notices.send(notice).is_err() {
                count(&self.inbound.traffic.untold_notices, 1);
            }
        }
        while let Some(mirror) = self.closed.front()
            && self.notices.send(Notice::Closed(*mirror)).is_ok()
        {
            self.closed.pop_front();
        }
        if now.since(self.shown) >= board::PERIOD {
            self.shown = now;
            self.board.put_inward(self.books(now));
        }
        if now.since(self.told) >= SLEEP_MAX {
            self.told = now;
            self.notices
                .send(Notice::Counters(Box::new(self.receiver.counters())))
                .ok();
        }
    }
}

impl State {
    fn books(&self, now: Time) -> Inward {
        let known = &self.inbound.streams;
        let streams = self.receiver.all_books().map(|((tag, stream), books)| {
            let counts = known.get(&(tag, stream)).map(|stream| stream.counts);
            (tag, stream, books, counts.unwrap_or_default())
        });
        Inward {
            at: now,
            streams: streams.collect(),
        }
    }
}

impl Inbound {
    /// Writes to the mirrors what the receiver has whole.
    fn take(&mut self, receiver: &mut Receiver, now: Time) {
        let Self {
            mirrors,
            streams,
            clocks,
            copying,
            traffic,
        } = self;
        let mut run: Option<Run<'_>> = None;
        while let Some(sample) = receiver.poll_sample() {
            let at = (sample.tag, sample.stream);
            if run.as_ref().is_none_or(|run| run.of != at) {
                run = streams.get_mut(&at).map(|stream| Run {
                    of: at,
                    to: stream.mirror,
                    mirror: mirrors.get_mut(&stream.mirror),
                    counts: &mut stream.counts,
                    // Nothing may have renewed it since the last stream ended.
                    clock: clocks
                        .get(&sample.tag)
                        .map(|(clock, told)| clock.aged(now.since(*told))),
                });
            }
            let Some(run) = &mut run else {
                continue;
            };
            let Some(mirror) = &mut run.mirror else {
                run.counts.refused += 1;
                continue;
            };
            let len = sample.payload.len();
            let fate = mirror.take(sample, run.clock.as_ref(), now);
            if mirror.copying.is_some() && !copying.contains(&run.to) {
                copying.push(run.to);
            }
            match fate {
                Fate::Written => {
                    run.counts.written += 1;
                    run.counts.bytes += len as u64;
                }
                Fate::Stale => {
                    run.counts.stale += 1;
                    count(&traffic.stale_samples, 1);
                }
                Fate::Refused => {
                    run.counts.refused += 1;
                    count(&traffic.refused_samples, 1);
                }
            }
        }
    }
}

impl Inbound {
    /// Copies a piece of each large sample that is on its way into the store.
    fn copy(&mut self) {
        let mirrors = &mut self.mirrors;
        self.copying.retain(|id| {
            let mirror = mirrors.get_mut(id);
            mirror.is_some_and(|mirror| mirror.copy(PIECE_BYTES))
        });
    }
}

impl Mirror {
    /// Copies up to so many bytes of the large sample on its way. Whether more is left.
    fn copy(&mut self, most: usize) -> bool {
        let Some(copying) = &mut self.copying else {
            return false;
        };
        let rest = &copying.payload[copying.copied..];
        let piece = &rest[..rest.len().min(most)];
        self.writer.fill(copying.copied, piece);
        copying.copied += piece.len();
        if copying.copied < copying.payload.len() {
            return true;
        }
        self.writer.finish(&copying.origin);
        self.copying = None;
        false
    }

    /// What another stream of the item goes on from.
    fn held(&self) -> Option<Held> {
        let newest = self.newest;
        self.from.map(|from| Held { from, newest })
    }

    fn take(&mut self, sample: Received<'_>, clock: Option<&ClockOffset>, now: Time) -> Fate {
        let meta = &sample.meta;
        if (meta.epoch, meta.seq) <= self.newest {
            return Fate::Stale;
        }
        // Those before come first.
        self.copy(usize::MAX);
        let passed = self.passed_until(&sample);
        // Without a measured clock the owner's instants say nothing here: the age is unknown, and says so.
        let local = |at: Time| clock.map_or(now, |clock| clock.to_local(at).min(now));
        let origin = Origin {
            epoch: meta.epoch,
            seq: meta.seq,
            filtered: passed.filtered,
            overwritten: passed.overwritten,
            capture: local(meta.capture),
            publish: local(meta.publish),
            receive: Some(now),
            bound_ns: Some(clock.map_or(u64::MAX, |clock| clock.bound_ns)),
        };
        let newest = (meta.epoch, meta.seq);
        let taken = match sample.payload {
            Cow::Owned(payload) if payload.len() > PIECE_BYTES => {
                let copied = 0;
                self.writer.begin(payload.len()).map(|()| {
                    self.copying = Some(Copying {
                        payload,
                        copied,
                        origin,
                    });
                })
            }
            payload @ (Cow::Borrowed(_) | Cow::Owned(_)) => {
                self.writer.write_with(&payload, &origin).map(|_seq| ())
            }
        };
        match taken {
            Ok(()) => {
                self.newest = newest;
                (self.from, self.passed) = (Some(sample.tag), passed);
                Fate::Written
            }
            Err(error) => {
                tracing::debug!(%error, "sample not mirrored");
                // What lay before it counts all the same.
                self.passed = passed;
                Fate::Refused
            }
        }
    }

    /// Samples of the epoch that the source did not send, up to this one.
    fn passed_until(&self, sample: &Received<'_>) -> Passed {
        let (meta, more) = (&sample.meta, sample.passed);
        match self.newest {
            // Nobody here asked for what was before.
            (Epoch(0), _) => Passed {
                filtered: meta.seq.0.saturating_sub(1),
                overwritten: 0,
            },
            (epoch, _) if epoch == meta.epoch => Passed {
                filtered: self.passed.filtered.saturating_add(more.filtered),
                overwritten: self.passed.overwritten.saturating_add(more.overwritten),
            },
            _ => more,
        }
    }
}

/// What became of a sample at its mirror.
enum Fate {
    Written,
    Stale,
    Refused,
}
