//! The networked half of a daemon: the catalog, its two sockets, and what its events mean to the store and the threads.

use std::collections::BTreeMap;
use std::io;
use std::net::{Ipv4Addr, SocketAddr, SocketAddrV4, ToSocketAddrs};
use std::sync::Arc;
use std::time::Duration;

use anyhow::Context;
use ddx_catalog::delivery::{ReceiverConfig, ReceiverCounters, Route};
use ddx_catalog::{Catalog, Config as CatalogConfig, Dest, Event, beacon_group, sample_group};
use ddx_store::server::{Event as StoreEvent, Handle, RemoteItem};
use ddx_store::{ReaderOptions, Schema, Store, WriterOptions};
use ddx_wire::seal::{DomainKey, Purpose, Sealer};
use ddx_wire::{Contract, Delivery, HostId, HostName, ItemDescription, ItemName, StreamId, Tag};
use socket2::SockRef;
use tokio::io::Interest;
use tokio::net::{UdpSocket, UnixStream};
use tokio::time::sleep;

use super::Config;
use crate::data::board::Board;
use crate::data::mailbox::{self, mailbox};
use crate::data::rx::{self, MirrorId, Rx};
use crate::data::tx::{self, Tx};
use crate::data::{Traffic, count};
use crate::identity::{Identity, random};
use crate::net::{self, Channel, Interface, Members, Outlets, Sockets, Watch};

/// Notices from the receiving thread that wait at most, of 900 B at most: 3.5 MiB. One more costs an acknowledgement that a
/// renewal makes good, and is counted.
const NOTICES: usize = 4096;
/// Datagrams taken from one socket before the loop looks at anything else.
const DATAGRAMS_PER_TURN: usize = 64;
/// Samples that a mirror holds where each one is wanted.
const EVERY_DEPTH: u32 = 1_024;
/// Most samples that a mirror holds, whatever its owner's ring does, and bytes that these may take.
const MIRROR_DEPTH: u32 = 16_384;
const MIRROR_BYTES: u32 = 64 << 20;
/// Samples of one item that the sending thread may hold in place, beyond the two of every reader.
const TX_PINS: u32 = 6;
/// Larger than any control datagram.
const CONTROL_BUFFER_BYTES: usize = 2048;

/// What joins the catalog to the operating system.
pub(super) struct Network {
    catalog: Catalog,
    store: Store,
    handle: Handle,
    control: UdpSocket,
    beacon: Option<UdpSocket>,
    beacon_to: SocketAddr,
    watch: Watch,
    /// Names or addresses of the interfaces to use; empty for all.
    wanted: Vec<String>,
    interfaces: Vec<Interface>,
    beacon_members: Option<Members>,
    group_members: Members,
    outlets: Outlets,
    control_addrs: Vec<SocketAddr>,
    data_port: u16,
    receive_buffer_bytes: usize,
    tx: Tx,
    tx_store: Store,
    rx: Rx,
    notices: mailbox::Receiver<rx::Notice>,
    notified: UnixStream,
    traffic: Arc<Traffic>,
    board: Arc<Board>,
    control_traffic: Traffic,
    received: ReceiverCounters,
    host: HostName,
    /// Texts of the schemas of this host's items.
    schemas: BTreeMap<ItemName, String>,
    /// Items of other hosts. Until it is known which of two hosts keeps a prefix, both may show one name.
    remote: BTreeMap<(ItemName, HostId), RemoteItem>,
    remote_changed: bool,
    mirrors: BTreeMap<ItemName, Mirror>,
    last_mirror: u64,
    /// Mirrors that the receiving thread still holds, and what waits for the item to be free.
    closing: BTreeMap<MirrorId, ItemName>,
    awaited: BTreeMap<ItemName, Expected>,
    reincarnate: Option<u32>,
}

/// A stream that is to be mirrored.
struct Expected {
    stream: (Tag, StreamId),
    description: ItemDescription,
    contract: Contract,
}

struct Mirror {
    id: MirrorId,
    description: ItemDescription,
    stream: Option<(Tag, StreamId)>,
    contract: Contract,
}

impl Mirror {
    /// Whether samples of an item that is so described have room in it.
    fn fits(&self, description: &ItemDescription) -> bool {
        self.description.schema_hash == description.schema_hash
            && self.description.capacity_bytes == description.capacity_bytes
            && self.description.depth == description.depth
    }
}

impl Network {
    /// Opens the sockets, starts the two data threads, and makes the catalog.
    pub(super) fn start(
        config: &Config,
        identity: Identity,
        key: &DomainKey,
        handle: &Handle,
    ) -> anyhow::Result<Self> {
        let beacon_to = beacon_group(config.domain);
        net::check(&config.interfaces)?;
        let sockets = Sockets::open(
            config.control_port,
            config.data_port,
            v4(beacon_to).filter(|_group| config.beacon),
            sample_group(config.domain, 0).port(),
        )?;
        // Before the first look, so that nothing changes in between.
        let watch = Watch::start();
        let interfaces =
            net::interfaces(&config.interfaces).context("listing the network interfaces")?;
        let control_addrs = control_addrs(&interfaces, sockets.control.local_addr()?.port());
        say(&interfaces);
        let group_members = Members::new(sockets.group.try_clone()?, &interfaces);
        let mut beacon_members = None;
        if let (Some(socket), Some(group)) = (&sockets.beacon, v4(beacon_to)) {
            let members = beacon_members.insert(Members::new(socket.try_clone()?, &interfaces));
            members.join(*group.ip());
        }
        let outlets = Outlets::default();
        outlets.follow(&interfaces);
        let data_port = sockets.data.local_addr()?.port();
        let receive_buffer_bytes = net::receive_buffer_bytes(&sockets.data)?;
        let seeds = config
            .join
            .iter()
            .map(|seed| endpoint(seed, beacon_to.port()))
            .collect::<anyhow::Result<Vec<_>>>()?
            .concat();
        let catalog = Catalog::new(
            CatalogConfig {
                domain: config.domain,
                host: config.host.clone(),
                id: identity.id,
                incarnation: identity.incarnation,
                key: key.clone(),
                control_addrs: control_addrs.clone(),
                data_port,
                seeds,
                beacon: config.beacon,
                multicast: config.multicast,
                prefix_since: ddx_store::now(),
            },
            u64::from_le_bytes(random()?),
            ddx_store::now(),
        );

        let traffic = Arc::new(Traffic::default());
        let board = Arc::new(Board::default());
        let (notify, notices) = mailbox(NOTICES).context("making the queue of the control loop")?;
        let tx_store = handle
            .connect()
            .context("connecting the sending thread to the store")?;
        let sealer = Sealer::new(key, identity.id, identity.incarnation, Purpose::Data);
        let receiver = ReceiverConfig::new(sealer.sender(), key.id());
        let tx = Tx::start(
            Channel::new(sockets.data.try_clone()?)?.with_outlets(outlets.clone()),
            &tx_store,
            sealer,
            (Arc::clone(&traffic), Arc::clone(&board)),
            config.spin,
        )?;
        let rx = Rx::start(
            sockets.data,
            sockets.group,
            receiver,
            notify,
            (Arc::clone(&traffic), Arc::clone(&board)),
            config.spin,
        )?;
        Ok(Self {
            catalog,
            store: handle
                .connect()
                .context("connecting the control loop to the store")?,
            handle: handle.clone(),
            control: UdpSocket::from_std(sockets.control)?,
            beacon: sockets.beacon.map(UdpSocket::from_std).transpose()?,
            beacon_to,
            watch,
            wanted: config.interfaces.clone(),
            interfaces,
            beacon_members,
            group_members,
            outlets,
            control_addrs,
            data_port,
            receive_buffer_bytes,
            tx,
            tx_store,
            rx,
            notified: UnixStream::from_std(notices.signal()?)?,
            notices,
            traffic,
            board,
            control_traffic: Traffic::default(),
            received: ReceiverCounters::default(),
            host: config.host.clone(),
            schemas: BTreeMap::new(),
            remote: BTreeMap::new(),
            remote_changed: false,
            mirrors: BTreeMap::new(),
            last_mirror: 0,
            closing: BTreeMap::new(),
            awaited: BTreeMap::new(),
            reincarnate: None,
        })
    }

    /// Waits for one thing to happen and does what it asks. Returns the ordinal to go above when another life of this
    /// host was found in the domain.
    pub(super) async fn turn(&mut self) -> anyhow::Result<Option<u32>> {
        let wait = self
            .catalog
            .poll_timeout()
            .map(|(at, _why)| at.since(ddx_store::now()));
        tokio::select! {
            ready = self.control.readable() => ready?,
            ready = readable(self.beacon.as_ref()) => ready?,
            ready = self.notified.readable() => ready?,
            () = self.watch.changed() => self.follow_interfaces(),
            () = sleep(wait.unwrap_or_default()), if wait.is_some() => self.catalog.handle_timeout(ddx_store::now()),
        }
        self.receive();
        self.take_notices()?;
        self.settle()?;
        Ok(self.reincarnate.take())
    }

    /// Does what the store's news ask of the network.
    pub(super) fn handle_store(&mut self, event: StoreEvent) -> anyhow::Result<()> {
        let now = ddx_store::now();
        match event {
            StoreEvent::Announced {
                description,
                schema,
            } => {
                self.schemas.insert(description.name.clone(), schema);
                self.announce(description);
            }
            StoreEvent::Changed { description } => self.announce(description),
            StoreEvent::Withdrawn { name } => {
                self.schemas.remove(&name);
                self.catalog.withdraw(&name, now);
            }
            StoreEvent::Wanted { name, contract } => {
                if let Err(error) = self.catalog.subscribe(name, contract, now) {
                    tracing::warn!(%error, "item not subscribed");
                }
            }
            StoreEvent::Unwanted { name } => {
                self.catalog.unsubscribe(&name, now);
                self.drop_mirror(&name)?;
            }
        }
        self.settle()
    }

    /// Goes on with the interfaces that there are now.
    fn follow_interfaces(&mut self) {
        let interfaces = match net::interfaces(&self.wanted) {
            Ok(interfaces) => interfaces,
            Err(error) => {
                tracing::warn!(%error, "the network interfaces cannot be listed");
                return;
            }
        };
        if interfaces == self.interfaces {
            return;
        }
        say(&interfaces);
        self.group_members.follow(&interfaces);
        if let Some(members) = &mut self.beacon_members {
            members.follow(&interfaces);
        }
        self.outlets.follow(&interfaces);
        self.interfaces = interfaces;
        if let Ok(at) = self.control.local_addr() {
            self.control_addrs = control_addrs(&self.interfaces, at.port());
            self.catalog
                .set_control_addrs(&self.control_addrs, ddx_store::now());
        }
    }

    /// Tells the other hosts of an item of this one. Administrative items are each host's own.
    fn announce(&mut self, description: ItemDescription) {
        let Some(schema) = self
            .schemas
            .get(&description.name)
            .filter(|_| description.name.is_under(&self.host))
        else {
            return;
        };
        let name = description.name.clone();
        if let Err(error) = self.catalog.announce(description, schema, ddx_store::now()) {
            tracing::warn!(item = %name, %error, "item not announced to other hosts");
        }
    }

    /// Says goodbye and ends the threads.
    pub(super) fn stop(mut self) {
        self.catalog.leave(ddx_store::now());
        self.transmit();
        self.tx.stop();
        self.rx.stop();
    }

    pub(super) fn control_addrs(&self) -> &[SocketAddr] {
        &self.control_addrs
    }

    pub(super) fn data_port(&self) -> u16 {
        self.data_port
    }

    /// What the kernel granted to the socket of unicast samples, which may be less than was asked.
    pub(super) fn receive_buffer_bytes(&self) -> usize {
        self.receive_buffer_bytes
    }

    pub(super) fn catalog(&self) -> &Catalog {
        &self.catalog
    }

    pub(super) fn traffic(&self) -> [&Traffic; 2] {
        [&self.control_traffic, &self.traffic]
    }

    /// What the data threads have counted.
    pub(super) fn board(&self) -> &Board {
        &self.board
    }

    pub(super) fn received(&self) -> &ReceiverCounters {
        &self.received
    }

    /// Hands the names of other hosts' items to the store, if they changed. Cheap otherwise.
    pub(super) fn publish_remote(&mut self) {
        if std::mem::take(&mut self.remote_changed) {
            let items = self.remote.values().cloned().collect();
            if let Err(error) = self.handle.set_remote(items) {
                tracing::error!(%error, "listings do not show other hosts");
            }
        }
    }

    /// Takes what has arrived, within a bound, before effects are drained.
    fn receive(&mut self) {
        let Self {
            catalog,
            control,
            beacon,
            control_traffic,
            ..
        } = self;
        let mut buffer = [0; CONTROL_BUFFER_BYTES];
        let sockets = [(Some(&*control), false), (beacon.as_ref(), true)];
        for (socket, is_beacon) in sockets
            .into_iter()
            .filter_map(|(socket, is_beacon)| Some((socket?, is_beacon)))
        {
            for _turn in 0..DATAGRAMS_PER_TURN {
                match socket.try_recv_from(&mut buffer) {
                    Ok((len, from)) => {
                        count(&control_traffic.received_datagrams, 1);
                        count(&control_traffic.received_bytes, len);
                        let Some(datagram) = buffer.get_mut(..len) else {
                            continue;
                        };
                        if is_beacon {
                            catalog.handle_beacon(from, datagram, ddx_store::now());
                        } else {
                            catalog.handle_datagram(from, datagram, ddx_store::now());
                        }
                    }
                    Err(e) if e.kind() == io::ErrorKind::WouldBlock => break,
                    // An unreachable peer's ICMP answer comes back as an error of a later call.
                    Err(error) => tracing::debug!(%error, "receiving control datagrams"),
                }
            }
        }
    }

    fn take_notices(&mut self) -> anyhow::Result<()> {
        // Tells the runtime that the descriptor was emptied; the queue itself is what counts.
        self.notified
            .try_io(Interest::READABLE, || {
                Err::<(), _>(io::ErrorKind::WouldBlock.into())
            })
            .ok();
        for notice in self.notices.drain() {
            match notice {
                rx::Notice::Holds {
                    tag,
                    stream,
                    epoch,
                    seq,
                    quiet,
                } => {
                    self.catalog
                        .holds(tag, stream, epoch, seq, quiet, ddx_store::now());
                }
                rx::Notice::OnGroup { tag, stream } => {
                    self.catalog.heard_on_group(tag, stream, ddx_store::now());
                }
                rx::Notice::Report(tag, report) => {
                    self.catalog.report(tag, report, ddx_store::now());
                }
                rx::Notice::Nack(tag, nack) => self.catalog.nack(tag, nack, ddx_store::now()),
                rx::Notice::Closed(mirror) => self.mirror_closed(mirror)?,
                rx::Notice::Counters(counters) => self.received = *counters,
            }
        }
        Ok(())
    }

    /// Drains all effects of the last mutation.
    fn settle(&mut self) -> anyhow::Result<()> {
        self.transmit();
        while let Some(event) = self.catalog.poll_event() {
            self.handle_event(event)?;
        }
        self.transmit();
        self.publish_remote();
        Ok(())
    }

    fn transmit(&mut self) {
        let mut datagram = Vec::new();
        loop {
            datagram.clear();
            let Some(transmit) = self.catalog.poll_transmit(&mut datagram) else {
                return;
            };
            match transmit.to {
                Dest::Addr(to) => self.send(to, None, &datagram),
                Dest::Beacon => {
                    for (index, interface) in self.interfaces.iter().enumerate() {
                        // Once for each interface, whatever the number of its addresses.
                        let before = self.interfaces.iter().take(index);
                        if before.into_iter().all(|i| i.index != interface.index) {
                            self.send(self.beacon_to, Some(interface.address), &datagram);
                        }
                    }
                }
            }
        }
    }

    fn send(&self, to: SocketAddr, from: Option<Ipv4Addr>, datagram: &[u8]) {
        let chosen = from.map_or(Ok(()), |from| {
            SockRef::from(&self.control).set_multicast_if_v4(&from)
        });
        match chosen.and_then(|()| self.control.try_send_to(datagram, to)) {
            Ok(bytes) => {
                count(&self.control_traffic.sent_datagrams, 1);
                count(&self.control_traffic.sent_bytes, bytes);
            }
            Err(error) => {
                count(&self.control_traffic.unsent_datagrams, 1);
                tracing::debug!(%to, %error, "sending a control datagram");
            }
        }
    }

    fn handle_event(&mut self, event: Event) -> anyhow::Result<()> {
        match event {
            Event::HostUp { name, addr, .. } => {
                tracing::info!(host = %name, %addr, "host up");
            }
            Event::HostUnreachable { host } => {
                tracing::info!(host = %self.host_name(host), "host unreachable");
            }
            Event::HostDown { host } => tracing::info!(host = %self.host_name(host), "host down"),
            Event::HostLeft { host } => tracing::info!(host = %self.host_name(host), "host left"),
            Event::PrefixConflict { host, shown_as } => {
                tracing::warn!(host = %host, shown_as, "two hosts hold one prefix\nhint: start one of them with another --host");
            }
            Event::Reincarnate { ordinal } => self.reincarnate = Some(ordinal),
            Event::ItemKnown {
                host,
                name,
                description,
                schema_text,
            } => {
                // Two hosts may hold one prefix: the store knows each item by the name that this host shows.
                let item = RemoteItem {
                    host: self.host_name(host),
                    description: ItemDescription {
                        name: name.clone(),
                        ..description
                    },
                    schema: schema_text,
                };
                let description = item.description.clone();
                self.remote.insert((name.clone(), host), item);
                self.remote_changed = true;
                // A new writer may write larger samples, in the stream that flows already.
                if let Some(expected) = self.awaited.get_mut(&name) {
                    expected.description = description;
                } else if let Some(mirror) = self.mirrors.get(&name)
                    && !mirror.fits(&description)
                    && let Some(stream) = mirror.stream
                {
                    let contract = mirror.contract;
                    self.expect_stream(stream, &name, description, contract)?;
                }
            }
            Event::ItemGone { host, name } => {
                self.remote_changed |= self.remote.remove(&(name.clone(), host)).is_some();
                if self.remote_named(&name).next().is_none() {
                    self.drop_mirror(&name)?;
                }
            }
            Event::Session { tag, opener, .. } => {
                self.rx.order(rx::Order::Session { tag, opener })?;
            }
            Event::SessionClosed { tag } => self.rx.order(rx::Order::DropSession(tag))?,
            Event::OpenStream {
                stream,
                name,
                route,
            } => self.open_stream(stream, &name, route)?,
            Event::UpdateStream { stream, route } => {
                self.follow_route(stream, &route);
                self.tx.order(tx::Order::Update { stream, route })?;
            }
            Event::CloseStream { stream } => {
                self.outlets.route(stream, None, std::iter::empty());
                self.tx.order(tx::Order::Close(stream))?;
            }
            Event::Held {
                stream,
                tag,
                epoch,
                seq,
            } => {
                self.tx.order(tx::Order::Held {
                    stream,
                    tag,
                    epoch,
                    seq,
                })?;
            }
            Event::Report { tag, report } => self.tx.order(tx::Order::Report { tag, report })?,
            Event::Nack { tag, nack } => self.tx.order(tx::Order::Nack { tag, nack })?,
            Event::Expect {
                tag,
                stream,
                name,
                description,
                contract,
            } => self.expect_stream((tag, stream), &name, description, contract)?,
            Event::Forget { tag, stream } => {
                for mirror in self
                    .mirrors
                    .values_mut()
                    .filter(|m| m.stream == Some((tag, stream)))
                {
                    mirror.stream = None;
                }
                self.awaited
                    .retain(|_name, expected| expected.stream != (tag, stream));
                self.rx.order(rx::Order::Forget { tag, stream })?;
            }
            Event::JoinGroup(group) => {
                if let Some(group) = v4(group) {
                    self.group_members.join(*group.ip());
                }
            }
            Event::LeaveGroup(group) => {
                if let Some(group) = v4(group) {
                    self.group_members.leave(*group.ip());
                }
            }
            Event::Clock { tag, offset } => {
                // The bound is half the round trip and some drift, so that twice the bound covers the round trip.
                let time = Duration::from_nanos(offset.bound_ns.saturating_mul(2));
                self.tx.order(tx::Order::RoundTrip { tag, time })?;
                self.rx.order(rx::Order::RoundTrip { tag, time })?;
                self.rx.order(rx::Order::Clock { tag, offset })?;
            }
        }
        Ok(())
    }

    fn open_stream(
        &mut self,
        stream: StreamId,
        name: &ItemName,
        route: Route,
    ) -> anyhow::Result<()> {
        // Large samples are held in place while their fragments leave, perhaps one for each path.
        let options = ReaderOptions {
            pins: TX_PINS,
            ..ReaderOptions::default()
        };
        let reader = match self.tx_store.raw_reader(name.as_str(), None, options) {
            Ok(reader) => reader,
            Err(error) => {
                tracing::warn!(item = %name, %error, "item cannot be read to be sent");
                return Ok(());
            }
        };
        self.follow_route(stream, &route);
        self.tx.order(tx::Order::Open {
            stream,
            route,
            reader: Box::new(reader),
        })
    }

    fn follow_route(&self, stream: StreamId, route: &Route) {
        let members = route.readers.iter();
        let members = members.filter(|reader| reader.via.group().is_some());
        let group = members.clone().find_map(|reader| reader.via.group());
        self.outlets
            .route(stream, group, members.map(|reader| reader.addr));
    }

    /// Makes ready for the samples of a stream: a mirror in the store, and the order to write it.
    fn expect_stream(
        &mut self,
        (tag, stream): (Tag, StreamId),
        name: &ItemName,
        description: ItemDescription,
        contract: Contract,
    ) -> anyhow::Result<()> {
        let mirror = self.mirrors.get(name);
        if mirror.is_some_and(|mirror| !mirror.fits(&description)) {
            self.drop_mirror(name)?;
        }
        if self.closing.values().any(|closing| closing == name) {
            let expected = Expected {
                stream: (tag, stream),
                description,
                contract,
            };
            self.awaited.insert(name.clone(), expected);
            return Ok(());
        }
        let id = match self.mirrors.get_mut(name) {
            Some(mirror) => {
                mirror.stream = Some((tag, stream));
                mirror.contract = contract;
                mirror.id
            }
            None => match self.open_mirror(name, description, contract, (tag, stream)) {
                Ok(id) => id,
                Err(error) => {
                    tracing::warn!(item = %name, error = %format!("{error:#}"), "item cannot be mirrored");
                    return Ok(());
                }
            },
        };
        self.rx.order(rx::Order::Expect {
            tag,
            stream,
            contract,
            mirror: id,
        })
    }

    fn open_mirror(
        &mut self,
        name: &ItemName,
        description: ItemDescription,
        contract: Contract,
        stream: (Tag, StreamId),
    ) -> anyhow::Result<MirrorId> {
        let text = self
            .remote_named(name)
            .find(|item| item.description.schema_hash == description.schema_hash)
            .map(|item| item.schema.as_ref())
            .context("its schema is not known")?;
        let schema = Schema::parse(text).context("its owner's schema")?;
        anyhow::ensure!(
            schema.hash() == description.schema_hash,
            "its owner's schema is not the one announced"
        );
        let default = WriterOptions::default();
        // What waits for its readers at its owner's waits for those of this host too; and where each sample is wanted, what
        // comes in a burst of repairs.
        let depth = match contract.delivery {
            Delivery::Latest => description.depth,
            Delivery::Every | Delivery::EveryFromRing => description.depth.max(EVERY_DEPTH),
        };
        let fits = MIRROR_BYTES / description.capacity_bytes.max(1);
        let options = WriterOptions {
            capacity_bytes: Some(description.capacity_bytes),
            depth: depth.min(fits).clamp(default.depth, MIRROR_DEPTH),
            ..default
        };
        let writer = self.store.raw_writer(name.as_str(), &schema, options)?;
        self.last_mirror += 1;
        let id = MirrorId(self.last_mirror);
        self.rx.order(rx::Order::Mirror { mirror: id, writer })?;
        self.mirrors.insert(
            name.clone(),
            Mirror {
                id,
                description,
                stream: Some(stream),
                contract,
            },
        );
        Ok(id)
    }

    /// Goes on with what waited for a mirror's end.
    fn mirror_closed(&mut self, mirror: MirrorId) -> anyhow::Result<()> {
        let Some(name) = self.closing.remove(&mirror) else {
            return Ok(());
        };
        match self.awaited.remove(&name) {
            Some(Expected {
                stream,
                description,
                contract,
            }) => self.expect_stream(stream, &name, description, contract),
            None => Ok(()),
        }
    }

    fn drop_mirror(&mut self, name: &ItemName) -> anyhow::Result<()> {
        self.awaited.remove(name);
        let Some(mirror) = self.mirrors.remove(name) else {
            return Ok(());
        };
        self.closing.insert(mirror.id, name.clone());
        self.rx.order(rx::Order::DropMirror(mirror.id))
    }

    /// What the hosts that show this name say of it.
    fn remote_named(&self, name: &ItemName) -> impl Iterator<Item = &RemoteItem> {
        let first = (name.clone(), HostId([0; 16]));
        let last = (name.clone(), HostId([u8::MAX; 16]));
        self.remote.range(first..=last).map(|(_, item)| item)
    }

    fn host_name(&self, host: HostId) -> HostName {
        self.catalog
            .host_name(host)
            .cloned()
            .unwrap_or_else(|| HostName::sanitised(&host.short()))
    }
}

async fn readable(socket: Option<&UdpSocket>) -> io::Result<()> {
    match socket {
        Some(socket) => socket.readable().await,
        None => std::future::pending().await,
    }
}

/// The addresses at which the control socket is reached.
fn control_addrs(interfaces: &[Interface], port: u16) -> Vec<SocketAddr> {
    let addrs = interfaces.iter();
    addrs
        .map(|interface| SocketAddr::from((interface.address, port)))
        .collect()
}

/// Tells people which interfaces are in use.
fn say(interfaces: &[Interface]) {
    if interfaces.is_empty() {
        tracing::warn!("no network interface is up with an IPv4 address: waiting for one");
        return;
    }
    let all = interfaces.iter();
    let all: Vec<String> = all.map(|i| format!("{} ({})", i.name, i.address)).collect();
    tracing::info!(interfaces = %all.join(", "), "network");
}

fn v4(addr: SocketAddr) -> Option<SocketAddrV4> {
    match addr {
        SocketAddr::V4(addr) => Some(addr),
        SocketAddr::V6(_) => None,
    }
}

/// Resolves an endpoint such as `udp/192.168.1.7:7447`. The transport may be left out, and so may the port: it is then
/// `port`, where each daemon of the domain listens for greetings.
fn endpoint(text: &str, port: u16) -> anyhow::Result<Vec<SocketAddr>> {
    let address = match text.split_once('/') {
        Some(("udp", address)) => address,
        Some((transport, _)) => {
            anyhow::bail!(
                "endpoint `{text}`: transport `{transport}` is not known\nhint: write `udp/host:port`"
            )
        }
        None => text,
    };
    let found = if address.contains(':') {
        address.to_socket_addrs()
    } else {
        (address, port).to_socket_addrs()
    };
    let found: Vec<SocketAddr> = found
        .with_context(|| format!("endpoint `{text}`\nhint: write `udp/host:port`"))?
        .filter(SocketAddr::is_ipv4)
        .collect();
    anyhow::ensure!(!found.is_empty(), "endpoint `{text}` has no IPv4 address");
    Ok(found)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_endpoint_is_a_transport_an_address_and_perhaps_a_port() {
        for text in [
            "udp/127.0.0.1:7400",
            "127.0.0.1:7400",
            "udp/127.0.0.1",
            "127.0.0.1",
        ] {
            assert_eq!(
                endpoint(text, 7400).unwrap(),
                ["127.0.0.1:7400".parse().unwrap()],
                "{text}"
            );
        }
    }

    #[test]
    fn a_bad_endpoint_is_named() {
        let error = format!("{:#}", endpoint("quic/127.0.0.1:7", 7400).unwrap_err());
        assert!(
            error.contains("`quic`") && error.contains("hint:"),
            "{error}"
        );
        let error = format!(
            "{:#}",
            endpoint("udp/127.0.0.1:notaport", 7400).unwrap_err()
        );
        assert!(error.contains("`udp/127.0.0.1:notaport`"), "{error}");
    }
}
