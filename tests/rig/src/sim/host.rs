//! One simulated host: the real machines, driven as the daemon drives them, over a model store.
//!
//! The control plane and the two data planes tell each other things by queues, as the daemon's threads do; what waits in
//! them waits up to [`super::Setup::lag`].

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::net::SocketAddr;
use std::time::Duration;

use ddx_catalog::delivery::{Books, PathStatus, ReceiverEvent, Route, SentBooks, SourceBooks};
use ddx_catalog::{Catalog, Config, Dest, Event};
use ddx_wire::message::{NackEntry, ReportEntry};
use ddx_wire::seal::{DomainKey, Opener, Purpose, Sealer};
use ddx_wire::{
    ClockOffset, Contract, Epoch, HostId, HostName, ItemDescription, ItemName, SchemaHash, Seq,
    StreamId, Tag, Time, WriterState,
};

use super::rx::{Mirror, MirrorId, Rx, Told};
use super::store::Store;
use super::tx::{Counts, Tx};
use crate::random::Random;

/// One simulated host.
pub struct Host {
    /// Its control plane; `None` while it is off.
    pub catalog: Option<Catalog>,
    /// Its name.
    pub name: HostName,
    /// Items of other hosts that its driver was told of.
    pub known: BTreeMap<ItemName, ItemDescription>,
    /// Streams that its driver was told to send.
    pub open: BTreeMap<StreamId, (ItemName, Route)>,
    /// Streams that its driver was told to expect.
    pub expected: BTreeMap<(Tag, StreamId), ItemName>,
    /// Groups that its driver was told to join.
    pub joined: BTreeSet<SocketAddr>,
    /// What its programs read.
    pub wanted: BTreeMap<ItemName, Contract>,
    /// Whether its network passes multicast samples on.
    pub hears_groups: bool,
    pub(super) id: HostId,
    pub(super) clock: HostClock,
    /// When it is to be woken, virtual time.
    pub(super) wake: u64,
    pub(super) out: Outgoing,
    /// The machines of the data plane, while it is on.
    pub(super) data: Option<Data>,
    /// What is left of the counts of earlier lives.
    pub(super) broken: Vec<String>,
}

/// What a host wants to be carried or noted.
#[derive(Default)]
pub(super) struct Outgoing {
    pub(super) control: Vec<(Dest, Vec<u8>)>,
    pub(super) samples: Vec<(SocketAddr, Vec<u8>)>,
    pub(super) events: Vec<Event>,
    pub(super) clocks: Vec<(Tag, ClockOffset)>,
}

/// The boot clock of a host.
#[derive(Clone, Copy, Debug)]
pub(super) struct HostClock {
    pub(super) start: u64,
    pub(super) drift_ppm: i64,
}

/// An instant, as it is and as the host sees it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Moment {
    pub(super) truth: u64,
    pub(super) local: Time,
}

pub(super) struct Data {
    pub(super) store: Store,
    pub(super) tx: Tx,
    pub(super) rx: Rx,
    ordinal: u32,
    mirrors: BTreeMap<ItemName, (MirrorId, Option<(Tag, StreamId)>)>,
    last_mirror: u64,
    orders: Mailbox<Order>,
    notices: Mailbox<ReceiverEvent>,
}

/// A queue between two threads: what is put in comes out later, in order.
struct Mailbox<T> {
    lag: u64,
    random: Random,
    queue: VecDeque<(u64, T)>,
}

#[expect(
    clippy::large_enum_variant,
    reason = "the one large order, a session, is rare"
)]
enum Order {
    Open(StreamId, ItemName, Route, u64),
    Update(StreamId, Route),
    Close(StreamId),
    Held(StreamId, Tag, Epoch, Seq),
    Session(Tag, Opener),
    DropSession(Tag),
    Mirror(MirrorId, ItemName),
    DropMirror(MirrorId),
    Expect((Tag, StreamId), Contract, MirrorId),
    Report(Tag, ReportEntry),
    Nack(Tag, NackEntry),
    Forget(Tag, StreamId),
    Clock(Tag, ClockOffset),
}

impl HostClock {
    /// What it shows at an instant of virtual time.
    pub(super) fn at(self, truth: u64) -> Time {
        let drift = i128::from(truth) * i128::from(self.drift_ppm) / 1_000_000;
        let local = i128::from(self.start) + i128::from(truth) + drift;
        Time(u64::try_from(local).unwrap_or(0))
    }

    pub(super) fn moment(self, truth: u64) -> Moment {
        let local = self.at(truth);
        Moment { truth, local }
    }
}

impl<T> Mailbox<T> {
    fn new(lag: Duration, seed: u64) -> Self {
        Self {
            lag: super::nanos(lag),
            random: Random::new(seed),
            queue: VecDeque::new(),
        }
    }

    fn put(&mut self, thing: T, now: u64) {
        let at = now + self.random.below(self.lag + 1);
        let last = self.queue.back().map_or(0, |(at, _)| *at);
        self.queue.push_back((at.max(last), thing));
    }

    fn take(&mut self, now: u64) -> Option<T> {
        self.next().filter(|at| *at <= now)?;
        self.queue.pop_front().map(|(_, thing)| thing)
    }

    fn next(&self) -> Option<u64> {
        self.queue.front().map(|(at, _)| *at)
    }
}

impl Host {
    pub(super) fn new(name: HostName, id: HostId, clock: HostClock) -> Self {
        Self {
            catalog: None,
            name,
            known: BTreeMap::new(),
            open: BTreeMap::new(),
            expected: BTreeMap::new(),
            joined: BTreeSet::new(),
            wanted: BTreeMap::new(),
            hears_groups: true,
            id,
            clock,
            wake: u64::MAX,
            out: Outgoing::default(),
            data: None,
            broken: Vec::new(),
        }
    }

    /// Begins a life.
    pub(super) fn start(&mut self, config: Config, lag: Duration, seed: u64, now: Moment) {
        self.stop();
        let sealer = Sealer::new(&config.key, config.id, config.incarnation, Purpose::Data);
        let own = sealer.sender();
        self.data = Some(Data {
            store: Store::default(),
            tx: Tx::new(sealer, now.local),
            rx: Rx::new(own, config.key.id(), self.clock),
            ordinal: config.incarnation.ordinal,
            mirrors: BTreeMap::new(),
            last_mirror: 0,
            orders: Mailbox::new(lag, seed ^ 1),
            notices: Mailbox::new(lag, seed ^ 2),
        });
        self.catalog = Some(Catalog::new(config, seed, now.local));
    }

    /// Ends a life without a word.
    pub(super) fn stop(&mut self) {
        if let Some(data) = &mut self.data {
            self.broken.append(&mut data.rx.broken);
        }
        self.catalog = None;
        self.data = None;
        self.known.clear();
        self.open.clear();
        self.expected.clear();
        self.joined.clear();
        self.wanted.clear();
        self.out = Outgoing::default();
        self.wake = u64::MAX;
    }

    /// The newest sample that a program here reads of an item of another host.
    pub fn held(&self, name: &ItemName) -> Option<(Epoch, Seq)> {
        let data = self.data.as_ref()?;
        let (mirror, _) = data.mirrors.get(name)?;
        let newest = data.rx.mirrors.get(mirror)?.newest;
        (newest.1 > Seq(0)).then_some(newest)
    }

    /// The newest sample of an item of this host.
    pub fn newest(&self, name: &ItemName) -> Option<(Epoch, Seq)> {
        let meta = self.data.as_ref()?.store.get(name)?.current()?.meta;
        Some((meta.epoch, meta.seq))
    }

    /// What this life has sent.
    pub fn sent(&self) -> Counts {
        self.data
            .as_ref()
            .map(|data| data.tx.counts)
            .unwrap_or_default()
    }

    /// Samples that this life has shown to its programs, and how many of them with a known age.
    pub fn shown(&self) -> (u64, u64) {
        let shown = |data: &Data| (data.rx.shown_samples, data.rx.known_ages);
        self.data.as_ref().map(shown).unwrap_or_default()
    }

    /// Data datagrams that this life opened.
    pub fn copies(&self) -> u64 {
        let opened = |data: &Data| data.rx.receiver.counters().datagrams;
        self.data.as_ref().map_or(0, opened)
    }

    /// Samples lost on the link, over all streams that are expected now.
    pub fn link_lost(&self) -> u64 {
        let lost = |data: &Data| data.rx.books().map(|books| books.link_lost).sum();
        self.data.as_ref().map_or(0, lost)
    }

    /// What its sender knows of each destination.
    pub fn paths(&self) -> Vec<PathStatus> {
        let paths = |data: &Data| data.tx.sender.paths().collect();
        self.data.as_ref().map(paths).unwrap_or_default()
    }

    /// The books of each stream that it reads.
    pub fn books(&self) -> Vec<Books> {
        let books = |data: &Data| data.rx.books().collect();
        self.data.as_ref().map(books).unwrap_or_default()
    }

    /// What a reader of an item of another host was told, and what all streams that brought it have counted.
    pub fn told(&self, name: &ItemName) -> Option<(Told, Books)> {
        let data = self.data.as_ref()?;
        let (mirror, _) = data.mirrors.get(name)?;
        let told = data.rx.mirrors.get(mirror)?.told;
        Some((told, data.rx.books_of(*mirror)?))
    }

    /// The books of a stream that it reads.
    pub fn books_of(&self, tag: Tag, stream: StreamId) -> Option<Books> {
        self.data.as_ref()?.rx.receiver.books(tag, stream)
    }

    /// What became of the samples of each stream that it sends, before any way.
    pub fn source_books(&self) -> Vec<(StreamId, SourceBooks)> {
        let books = |data: &Data| data.tx.sender.source_books().collect();
        self.data.as_ref().map(books).unwrap_or_default()
    }

    /// What became of them on each way.
    pub fn sent_books(&self) -> Vec<(StreamId, SocketAddr, SentBooks)> {
        let books = |data: &Data| data.tx.sender.sent_books().collect();
        self.data.as_ref().map(books).unwrap_or_default()
    }

    pub(super) fn open_writer(&mut self, name: &ItemName, now: Moment) {
        let (Some(data), Some(catalog)) = (&mut self.data, &mut self.catalog) else {
            return;
        };
        let description = ItemDescription {
            name: name.clone(),
            schema_hash: SchemaHash([1; 16]),
            capacity_bytes: 65_536,
            depth: 8,
            epoch: data.store.open_writer(name, data.ordinal),
            writer: WriterState::Live,
            program: "sim".to_owned(),
        };
        catalog
            .announce(description, "u64", now.local)
            .expect("the directory has room");
    }

    pub(super) fn handle_sample(&mut self, bytes: &mut [u8], by_group: bool, now: Moment) {
        if let Some(data) = &mut self.data {
            data.rx.handle_datagram(bytes, by_group, now.local);
        }
    }

    pub(super) fn subscribe(&mut self, name: &ItemName, contract: Contract, now: Moment) {
        let Some(catalog) = &mut self.catalog else {
            return;
        };
        self.wanted.insert(name.clone(), contract);
        catalog
            .subscribe(name.clone(), contract, now.local)
            .expect("there is room");
    }

    pub(super) fn unsubscribe(&mut self, name: &ItemName, now: Moment) {
        let (Some(data), Some(catalog)) = (&mut self.data, &mut self.catalog) else {
            return;
        };
        self.wanted.remove(name);
        catalog.unsubscribe(name, now.local);
        data.rx.reader_closed(name);
        data.drop_mirror(name, now);
    }

    /// Does what is due.
    pub(super) fn handle_timeout(&mut self, now: Moment) {
        if let Some(catalog) = &mut self.catalog {
            catalog.handle_timeout(now.local);
        }
    }

    /// Drains all effects of the last mutation, until nothing is left to do now.
    pub(super) fn settle(&mut self, now: Moment) {
        let (Some(mut catalog), Some(mut data)) = (self.catalog.take(), self.data.take()) else {
            return;
        };
        loop {
            let mut bytes = Vec::new();
            while let Some(transmit) = catalog.poll_transmit(&mut bytes) {
                self.out
                    .control
                    .push((transmit.to, std::mem::take(&mut bytes)));
            }
            while let Some(event) = catalog.poll_event() {
                self.handle_event(event, &mut data, now);
            }
            while let Some(order) = data.orders.take(now.truth) {
                data.obey(order, now.local);
            }
            data.tx.work(&data.store, now.local, &mut self.out.samples);
            data.rx.handle_timeout(now.local);
            while let Some(event) = data.rx.receiver.poll_event() {
                data.notices.put(event, now.truth);
            }
            let mut noticed = false;
            while let Some(notice) = data.notices.take(now.truth) {
                noticed = true;
                match notice {
                    ReceiverEvent::Quiet {
                        tag,
                        stream,
                        epoch,
                        seq,
                    } => catalog.holds(tag, stream, epoch, seq, true, now.local),
                    ReceiverEvent::Flows {
                        tag,
                        stream,
                        epoch,
                        seq,
                    } => catalog.holds(tag, stream, epoch, seq, false, now.local),
                    ReceiverEvent::OnGroup { tag, stream } => {
                        catalog.heard_on_group(tag, stream, now.local);
                    }
                    ReceiverEvent::Report(tag, report) => catalog.report(tag, report, now.local),
                    ReceiverEvent::Nack(tag, nack) => catalog.nack(tag, nack, now.local),
                }
            }
            if !noticed {
                break;
            }
        }
        self.broken.append(&mut data.rx.broken);
        self.catalog = Some(catalog);
        self.data = Some(data);
    }

    /// When to wake it: on its own clock, and in virtual time.
    pub(super) fn poll_timeout(&self) -> (Option<Time>, Option<u64>) {
        let (Some(catalog), Some(data)) = (&self.catalog, &self.data) else {
            return (None, None);
        };
        let catalog = catalog.poll_timeout().map(|(at, _)| at);
        let receiver = data.rx.receiver.poll_timeout().map(|(at, _)| at);
        let local = [catalog, data.tx.poll_timeout(), receiver];
        let queues = [data.orders.next(), data.notices.next()];
        (
            local.into_iter().flatten().min(),
            queues.into_iter().flatten().min(),
        )
    }

    fn handle_event(&mut self, event: Event, data: &mut Data, now: Moment) {
        let order = match event {
            Event::ItemKnown {
                name, description, ..
            } => {
                self.known.insert(name, description);
                return;
            }
            Event::ItemGone { name, .. } => {
                self.known.remove(&name);
                data.drop_mirror(&name, now);
                return;
            }
            Event::OpenStream {
                stream,
                name,
                route,
            } => {
                self.open.insert(stream, (name.clone(), route.clone()));
                let Some(item) = data.store.get(&name) else {
                    return;
                };
                Order::Open(stream, name, route, item.last_pos())
            }
            Event::UpdateStream { stream, route } => {
                if let Some((_, known)) = self.open.get_mut(&stream) {
                    *known = route.clone();
                }
                Order::Update(stream, route)
            }
            Event::CloseStream { stream } => {
                self.open.remove(&stream);
                Order::Close(stream)
            }
            Event::Held {
                stream,
                tag,
                epoch,
                seq,
            } => Order::Held(stream, tag, epoch, seq),
            Event::Expect {
                tag,
                stream,
                name,
                contract,
                ..
            } => {
                self.expected.insert((tag, stream), name.clone());
                let mirror = data.mirror(&name, (tag, stream), now);
                Order::Expect((tag, stream), contract, mirror)
            }
            Event::Forget { tag, stream } => {
                self.expected.remove(&(tag, stream));
                for (_, current) in data.mirrors.values_mut() {
                    current.take_if(|current| *current == (tag, stream));
                }
                Order::Forget(tag, stream)
            }
            Event::Report { tag, report } => Order::Report(tag, report),
            Event::Nack { tag, nack } => Order::Nack(tag, nack),
            Event::Session { tag, opener, .. } => Order::Session(tag, opener),
            Event::SessionClosed { tag } => Order::DropSession(tag),
            Event::JoinGroup(group) => {
                self.joined.insert(group);
                return;
            }
            Event::LeaveGroup(group) => {
                self.joined.remove(&group);
                return;
            }
            Event::Clock { tag, offset } => {
                self.out.clocks.push((tag, offset));
                Order::Clock(tag, offset)
            }
            Event::HostUp { .. }
            | Event::HostUnreachable { .. }
            | Event::HostDown { .. }
            | Event::HostLeft { .. }
            | Event::PrefixConflict { .. }
            | Event::Reincarnate { .. } => {
                self.out.events.push(event);
                return;
            }
        };
        data.orders.put(order, now.truth);
    }
}

impl Data {
    fn obey(&mut self, order: Order, now: Time) {
        match order {
            Order::Open(stream, item, route, seen) => self.tx.open(stream, item, &route, seen, now),
            Order::Update(stream, route) => self.tx.update(stream, &route, now),
            Order::Close(stream) => self.tx.close(stream),
            Order::Held(stream, tag, epoch, seq) => {
                self.tx.sender.held(stream, tag, epoch, seq, now);
            }
            Order::Session(tag, opener) => self.rx.receiver.session(tag, opener),
            Order::DropSession(tag) => self.rx.drop_session(tag),
            Order::Mirror(id, name) => {
                self.rx.mirrors.insert(id, Mirror::new(name));
            }
            Order::DropMirror(id) => self.rx.drop_mirror(id),
            Order::Expect(at, contract, mirror) => self.rx.expect(at, &contract, mirror, now),
            Order::Report(tag, report) => self.tx.sender.handle_report(tag, &report, now),
            Order::Nack(tag, nack) => self.tx.sender.handle_nack(tag, &nack, now),
            Order::Forget(tag, stream) => self.rx.forget(tag, stream),
            Order::Clock(tag, offset) => {
                let time = Duration::from_nanos(offset.bound_ns.saturating_mul(2));
                self.tx.sender.round_trip(tag, time);
                self.rx.receiver.round_trip(tag, time);
                self.rx.set_clock(tag, offset, now);
            }
        }
    }

    fn mirror(&mut self, name: &ItemName, stream: (Tag, StreamId), now: Moment) -> MirrorId {
        if let Some((id, current)) = self.mirrors.get_mut(name) {
            *current = Some(stream);
            return *id;
        }
        self.last_mirror += 1;
        let id = MirrorId(self.last_mirror);
        self.mirrors.insert(name.clone(), (id, Some(stream)));
        self.orders.put(Order::Mirror(id, name.clone()), now.truth);
        id
    }

    fn drop_mirror(&mut self, name: &ItemName, now: Moment) {
        if let Some((id, _)) = self.mirrors.remove(name) {
            self.orders.put(Order::DropMirror(id), now.truth);
        }
    }
}

/// The key of every simulated domain.
pub(super) fn key() -> DomainKey {
    DomainKey::from_bytes([9; 32])
}
