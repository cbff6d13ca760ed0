//! One host as the network sees it: its catalog, its receiver and its sender, fed by strangers and by members who lie.
//!
//! Members hold the key and answer challenges, so whatever they say gets behind the seal. What must hold in spite of it:
//! nothing panics, each datagram is counted once, the books of each stream balance, samples of a stream only ever get
//! newer, deadlines pass, and nothing leaves that is longer than a datagram.

use std::collections::BTreeMap;
use std::net::{Ipv4Addr, SocketAddr};
use std::time::Duration;

use ddx_catalog::delivery::{
    Receiver, ReceiverConfig, ReceiverEvent, SampleMeta, Sender, SenderConfig, SenderEvent,
};
use ddx_catalog::{Catalog, Config, Dest, Event};
use ddx_wire::message::{
    AckEntry, Change, Delta, DigestEntry, GrantEntry, Greeting, Introduction, ItemState, Message,
    Range, Reception, RenewEntry, SchemaPart, SubscribeEntry,
};
use ddx_wire::sample::{Fragment, Place, Preamble, Record};
use ddx_wire::seal::{
    self, DomainKey, HEADER_BYTES, Lane, MAX_DATAGRAM_BYTES, MIXED_STREAMS, Purpose, Sealer,
};
use ddx_wire::{
    Contract, Delivery, DomainId, Epoch, HostId, HostName, Incarnation, ItemDescription, ItemName,
    Pattern, SchemaHash, Seq, StreamId, Tag, Time, WriterState, codec,
};

use crate::Input;

/// Acts of a play. More would only make each run slower.
const ACTS: usize = 400;
/// Small, so that a play can fill it.
const BUDGET_BYTES: usize = 200_000;
const MAX_STREAMS: usize = 8;
/// The longest datagram that is tried.
const JUMBO_BYTES: usize = 8_972;
/// More than any one act may cause: each datagram in is answered by few.
const MAX_TRANSMITS: usize = 20_000;

const HOSTS: [&str; 4] = ["base", "robot1", "robot2", "host"];
const NAMES: [&str; 6] = [
    "base/gps",
    "base/cam",
    "robot1/gps",
    "robot2/gps",
    "host/own",
    "host/other",
];

/// Plays `data`; panics when something does not hold.
pub fn run(data: &[u8]) {
    let mut input = Input::new(data);
    let mut world = World::new();
    world.meet(0);
    for _ in 0..ACTS {
        let Some(act) = input.step() else {
            break;
        };
        world.act(act, &mut input);
        world.check();
    }
    world.end();
}

struct World {
    now: Time,
    catalog: Catalog,
    receiver: Receiver,
    sender: Sender<Vec<u8>>,
    members: Vec<Member>,
    /// What was said last: to be said again, in part or damaged.
    last: Vec<u8>,
    fed: u64,
    fed_samples: u64,
    /// Streams that the receiver expects, with the newest sample handed out of each.
    expected: BTreeMap<(Tag, StreamId), Option<(Epoch, Seq)>>,
    open: BTreeMap<StreamId, Seq>,
}

/// A host with the key.
struct Member {
    host: HostId,
    incarnation: Incarnation,
    name: HostName,
    addr: SocketAddr,
    hello: Sealer,
    control: Sealer,
    data: Sealer,
}

impl World {
    fn new() -> Self {
        let now = Time(1_000_000_000_000);
        let id = HostId([9; 16]);
        let incarnation = Incarnation {
            ordinal: 3,
            random: 7,
        };
        let config = Config {
            domain: DomainId(0),
            host: host_name("host"),
            id,
            incarnation,
            key: key(),
            control_addrs: vec![address(9)],
            data_port: 7401,
            seeds: Vec::new(),
            beacon: true,
            multicast: true,
            prefix_since: Time(0),
        };
        let own = Tag::of(id, incarnation);
        let receiver = ReceiverConfig {
            budget_bytes: BUDGET_BYTES,
            max_streams: MAX_STREAMS,
            ..ReceiverConfig::new(own, key().id())
        };
        let sealer = Sealer::new(&key(), id, incarnation, Purpose::Data);
        let mut world = Self {
            now,
            catalog: Catalog::new(config, 1, now),
            receiver: Receiver::new(receiver),
            sender: Sender::new(SenderConfig::default(), sealer, now),
            members: (0..4).map(member).collect(),
            last: Vec::new(),
            fed: 0,
            fed_samples: 0,
            expected: BTreeMap::new(),
            open: BTreeMap::new(),
        };
        for name in ["host/own", "base/gps"] {
            world.application(0, name);
            world.application(2, name);
        }
        world
    }

    fn act(&mut self, act: u8, input: &mut Input<'_>) {
        match act % 16 {
            0 => {
                let from = address(input.byte());
                self.hear(from, input.chunk().to_vec());
            }
            1 => self.hear_samples(input.chunk().to_vec(), input),
            2 => {
                let plaintext = input.chunk();
                self.say(input.byte(), Lane::Control, plaintext);
            }
            3 => {
                let plaintext = input.chunk();
                self.say(input.byte(), Lane::Hello, plaintext);
            }
            4 => {
                let (message, from) = (message(input), input.byte());
                self.say(from, Lane::Control, &encoded(&message));
            }
            5 => {
                let from = input.byte();
                let greeting = self.greeting(from, input);
                self.say(from, Lane::Hello, &encoded(&greeting));
            }
            6 => {
                let plaintext = records(input);
                self.send(input.byte(), &plaintext, input);
            }
            7 => {
                let plaintext = input.chunk();
                self.send(input.byte(), plaintext, input);
            }
            8 => self.wait(Duration::from_millis(u64::from(input.short()))),
            9 => self.wait(Duration::from_secs(u64::from(input.short()))),
            10 => self.collect(),
            11 => {
                let verb = input.byte();
                self.application(verb, input.pick(&NAMES));
            }
            12 => {
                let again = self.last.clone();
                self.hear(address(input.byte()), again.clone());
                self.hear_samples(again, input);
            }
            13 => {
                let mut damaged = self.last.clone();
                damaged.truncate(damaged.len().saturating_sub(usize::from(input.byte() % 64)));
                if let Some(byte) = damaged.get_mut(usize::from(input.byte())) {
                    *byte ^= input.byte();
                }
                self.hear(address(0), damaged.clone());
                self.hear_samples(damaged, input);
            }
            14 => self.hold(input),
            _ => self.write(input),
        }
    }

    /// A member introduces itself and answers the challenge.
    fn meet(&mut self, who: u8) {
        let from = self.introduction(who, 0);
        let hello = Greeting::Hello {
            from,
            directed: true,
        };
        self.say(who, Lane::Hello, &encoded(&hello));
    }

    /// A datagram arrives at the control socket.
    fn hear(&mut self, from: SocketAddr, mut datagram: Vec<u8>) {
        self.last.clone_from(&datagram);
        self.fed += 1;
        self.catalog.handle_datagram(from, &mut datagram, self.now);
        self.settle();
    }

    /// A datagram arrives at the data socket.
    fn hear_samples(&mut self, mut datagram: Vec<u8>, input: &mut Input<'_>) {
        self.last.clone_from(&datagram);
        self.fed_samples += 1;
        self.receiver
            .handle_datagram(&mut datagram, input.flag(), self.now);
        self.settle_samples();
    }

    fn say(&mut self, who: u8, lane: Lane, plaintext: &[u8]) {
        let at = usize::from(who) % self.members.len();
        let member = &mut self.members[at];
        let sealer = match lane {
            Lane::Hello => &mut member.hello,
            Lane::Control | Lane::Commands | Lane::Values | Lane::Bulk => &mut member.control,
        };
        let datagram = sealed(sealer, lane, MIXED_STREAMS, plaintext);
        let from = member.addr;
        self.hear(from, datagram);
    }

    fn send(&mut self, who: u8, plaintext: &[u8], input: &mut Input<'_>) {
        let at = usize::from(who) % self.members.len();
        let lane = input.pick(&[Lane::Values, Lane::Commands, Lane::Bulk]);
        let stream = StreamId(input.word());
        let datagram = sealed(&mut self.members[at].data, lane, stream, plaintext);
        self.hear_samples(datagram, input);
    }

    fn introduction(&self, who: u8, version: u64) -> Introduction {
        let member = &self.members[usize::from(who) % self.members.len()];
        Introduction {
            host: member.host,
            incarnation: member.incarnation,
            name: member.name.clone(),
            control_addrs: vec![member.addr],
            data_port: 7401,
            rejoin: 0,
            prefix_age_ns: 1,
            version,
            multicast: true,
        }
    }

    fn greeting(&self, who: u8, input: &mut Input<'_>) -> Greeting {
        let mut from = self.introduction(who, input.number());
        from.rejoin = input.word();
        from.prefix_age_ns = input.number();
        from.multicast = input.flag();
        from.data_port = input.short();
        if input.flag() {
            from.name = host_name(input.pick(&HOSTS));
        }
        let (to, nonce) = (self.catalog.tag(), input.number());
        let (echo, at) = (Time(input.number()), Time(input.number()));
        match input.byte() % 4 {
            0 => Greeting::Hello {
                from,
                directed: input.flag(),
            },
            1 => Greeting::Challenge {
                from,
                to,
                nonce,
                sent: at,
            },
            2 => {
                let challenge = input.flag().then_some(nonce);
                Greeting::Response {
                    from,
                    to,
                    nonce,
                    echo,
                    at,
                    challenge,
                }
            }
            _ => {
                let (host, incarnation) = (from.host, from.incarnation);
                Greeting::Stale {
                    to,
                    from: host,
                    incarnation,
                    ordinal: input.word(),
                }
            }
        }
    }

    fn application(&mut self, verb: u8, name: &str) {
        let name = item_name(name);
        match verb % 5 {
            0 => {
                let described = description(&name, Epoch::new(3, 1));
                // Fails when the description is too long, which these are not, or the directory is full.
                let _full = self
                    .catalog
                    .announce(described, "schema u64 plain u64\n", self.now);
            }
            1 => self.catalog.withdraw(&name, self.now),
            2 => {
                let _full = self.catalog.subscribe(name, Contract::default(), self.now);
            }
            3 => self.catalog.unsubscribe(&name, self.now),
            _ => {
                let contract = Contract {
                    max_rate_mhz: Some(10_000),
                    ..Contract::default()
                };
                let _full = self.catalog.subscribe(name, contract, self.now);
            }
        }
        self.settle();
    }

    /// The data plane tells the catalog what it holds.
    fn hold(&mut self, input: &mut Input<'_>) {
        let tag = self.members[usize::from(input.byte()) % self.members.len()].tag();
        let stream = StreamId(input.word());
        let (epoch, seq) = (Epoch(input.number()), Seq(input.number()));
        self.catalog
            .holds(tag, stream, epoch, seq, input.flag(), self.now);
        self.catalog.heard_on_group(tag, stream, self.now);
        self.settle();
    }

    /// A program of this host writes what others read.
    fn write(&mut self, input: &mut Input<'_>) {
        let payload = vec![7; usize::from(input.short())];
        let streams: Vec<StreamId> = self.open.keys().copied().collect();
        for stream in streams {
            let meta = self.next(stream);
            self.sender.write(stream, &meta, &payload, self.now);
        }
        self.sender.flush(self.now);
        self.settle_sending();
    }

    fn next(&mut self, stream: StreamId) -> SampleMeta {
        let seq = self.open.entry(stream).or_default();
        seq.0 += 1;
        SampleMeta {
            epoch: Epoch::new(3, 1),
            seq: *seq,
            filtered: 0,
            capture: self.now,
            publish: self.now,
        }
    }

    fn wait(&mut self, span: Duration) {
        self.now = self.now + span;
        self.catalog.handle_timeout(self.now);
        let late = self
            .catalog
            .poll_timeout()
            .filter(|(at, _)| *at <= self.now);
        assert_eq!(
            late.map(|(_, name)| name),
            None,
            "a deadline of the catalog does not pass"
        );
        self.settle();
        self.receiver.handle_timeout(self.now);
        self.settle_samples();
        self.sender.handle_timeout(self.now);
        self.settle_sending();
    }

    /// Takes what the catalog has to send and to tell.
    fn settle(&mut self) {
        let mut answers = Vec::new();
        for count in 0.. {
            assert!(count < MAX_TRANSMITS, "one act sends without end");
            let mut datagram = Vec::new();
            let Some(transmit) = self.catalog.poll_transmit(&mut datagram) else {
                break;
            };
            assert!(
                datagram.len() <= MAX_DATAGRAM_BYTES,
                "{} bytes leave",
                datagram.len()
            );
            if let Dest::Addr(to) = transmit.to {
                answers.extend(self.answer(to, &mut datagram));
            }
        }
        while let Some(event) = self.catalog.poll_event() {
            self.follow(event);
        }
        self.settle_sending();
        for (who, response) in answers {
            self.say(who, Lane::Hello, &encoded(&response));
        }
    }

    /// What the member at `to` answers: only challenges, which let it in.
    fn answer(&self, to: SocketAddr, datagram: &mut [u8]) -> Option<(u8, Greeting)> {
        let opened = seal::open_hello(&key(), datagram).ok()?;
        let greeting: Greeting = codec::decode(opened.plaintext).expect("own greetings decode");
        let Greeting::Challenge {
            to: meant,
            nonce,
            sent,
            ..
        } = greeting
        else {
            return None;
        };
        let who = self
            .members
            .iter()
            .position(|m| m.tag() == meant && m.addr == to)?;
        let who = u8::try_from(who).ok()?;
        let response = Greeting::Response {
            from: self.introduction(who, 1),
            to: self.catalog.tag(),
            nonce,
            echo: sent,
            at: Time(5),
            challenge: None,
        };
        Some((who, response))
    }

    fn follow(&mut self, event: Event) {
        match event {
            Event::Session { tag, opener, .. } => self.receiver.session(tag, opener),
            Event::SessionClosed { tag } => self.receiver.drop_session(tag),
            Event::Expect {
                tag,
                stream,
                contract,
                ..
            } => {
                self.receiver.listen(tag, stream, &contract, self.now);
                if self.receiver.books(tag, stream).is_some() {
                    self.expected.entry((tag, stream)).or_default();
                }
                self.settle_samples();
            }
            Event::Forget { tag, stream } => {
                self.receiver.forget(tag, stream);
                self.expected.remove(&(tag, stream));
            }
            Event::OpenStream { stream, route, .. } => {
                self.open.entry(stream).or_default();
                self.sender.open(stream, &route, self.now);
            }
            Event::UpdateStream { stream, route } => self.sender.update(stream, &route, self.now),
            Event::CloseStream { stream } => {
                self.open.remove(&stream);
                self.sender.close(stream);
            }
            Event::Held {
                stream,
                tag,
                epoch,
                seq,
            } => {
                self.sender.held(stream, tag, epoch, seq, self.now);
            }
            Event::Report { tag, report } => {
                self.sender.handle_report(tag, &report, self.now);
            }
            Event::Nack { tag, nack } => self.sender.handle_nack(tag, &nack, self.now),
            Event::Clock { offset, .. } => {
                let _anywhere = offset.to_local(Time(u64::MAX));
            }
            Event::HostUp { .. }
            | Event::HostUnreachable { .. }
            | Event::HostDown { .. }
            | Event::HostLeft { .. }
            | Event::PrefixConflict { .. }
            | Event::Reincarnate { .. }
            | Event::ItemKnown { .. }
            | Event::ItemGone { .. }
            | Event::JoinGroup(_)
            | Event::LeaveGroup(_) => {}
        }
    }

    fn settle_samples(&mut self) {
        for count in 0.. {
            assert!(count < MAX_TRANSMITS, "one act tells without end");
            match self.receiver.poll_event() {
                Some(ReceiverEvent::Quiet {
                    tag,
                    stream,
                    epoch,
                    seq,
                }) => {
                    self.catalog.holds(tag, stream, epoch, seq, true, self.now);
                }
                Some(ReceiverEvent::Flows {
                    tag,
                    stream,
                    epoch,
                    seq,
                }) => {
                    self.catalog.holds(tag, stream, epoch, seq, false, self.now);
                }
                Some(ReceiverEvent::OnGroup { tag, stream }) => {
                    self.catalog.heard_on_group(tag, stream, self.now);
                }
                Some(ReceiverEvent::Report(tag, report)) => {
                    self.catalog.report(tag, report, self.now);
                }
                Some(ReceiverEvent::Nack(tag, nack)) => self.catalog.nack(tag, nack, self.now),
                None => break,
            }
        }
        self.settle();
    }

    fn settle_sending(&mut self) {
        for count in 0.. {
            assert!(count < MAX_TRANSMITS, "one act repeats without end");
            let Some(SenderEvent::Fetch(fetch)) = self.sender.poll_event() else {
                break;
            };
            let meta = self.next(fetch.stream);
            let payload = b"present".to_vec();
            self.sender
                .fetched(&fetch, Some((&meta, &payload)), self.now);
        }
        let mut batch = Vec::new();
        for count in 0.. {
            assert!(count < MAX_TRANSMITS, "one act sends samples without end");
            batch.clear();
            let Some(transmit) = self.sender.poll_transmit(&mut batch) else {
                break;
            };
            let longest = transmit.segment.map_or(batch.len(), usize::from);
            assert!(longest <= JUMBO_BYTES, "{longest} bytes leave");
        }
    }

    /// The driver takes the samples that are ready.
    fn collect(&mut self) {
        let mut bytes = 0;
        while let Some(sample) = self.receiver.poll_sample() {
            bytes += sample.payload.len();
            let at = (sample.meta.epoch, sample.meta.seq);
            if let Some(newest) = self.expected.get_mut(&(sample.tag, sample.stream)) {
                assert!(*newest < Some(at), "{at:?} after {newest:?}");
                *newest = Some(at);
            }
        }
        assert!(bytes <= BUDGET_BYTES, "{bytes} bytes waited");
    }

    fn check(&self) {
        assert!(self.expected.len() <= MAX_STREAMS);
        for (tag, stream) in self.expected.keys() {
            let books = self.receiver.books(*tag, *stream).expect("it is expected");
            let sum = [
                books.delivered,
                books.late,
                books.link_lost,
                books.expired,
                books.over_budget,
                books.undecodable,
                books.filtered,
            ];
            // Numbers of a liar may add up to more than a count can hold.
            let sum = sum.into_iter().fold(0, u64::saturating_add);
            assert_eq!(books.expected, sum, "{books:?}");
        }
    }

    fn end(&mut self) {
        self.collect();
        let counters = self.catalog.counters();
        assert_eq!(counters.received, self.fed);
        let refused: u64 = counters.refused.iter().map(|(_, count)| count).sum();
        assert!(refused <= self.fed);
        let counters = self.receiver.counters();
        let refused: u64 = counters.refused.iter().map(|(_, count)| count).sum();
        assert_eq!(counters.datagrams + refused, self.fed_samples);
        assert!(self.catalog.hosts().len() <= self.members.len());
        let shown = self.catalog.items(&Pattern::everything());
        assert!(
            shown.iter().all(|item| item.host != HostId([9; 16])),
            "a host learnt of itself"
        );
        self.catalog.leave(self.now);
        self.settle();
    }
}

impl Member {
    fn tag(&self) -> Tag {
        Tag::of(self.host, self.incarnation)
    }
}

/// Two members share a host in two lives, and two share a name.
fn member(number: u8) -> Member {
    let host = HostId([[1, 2, 2, 4][usize::from(number)]; 16]);
    let incarnation = Incarnation {
        ordinal: u32::from(number),
        random: u64::from(number),
    };
    let sealer = |purpose| Sealer::new(&key(), host, incarnation, purpose);
    Member {
        host,
        incarnation,
        name: host_name(["base", "robot1", "robot1", "base"][usize::from(number)]),
        addr: address(number),
        hello: sealer(Purpose::Hello),
        control: sealer(Purpose::Control),
        data: sealer(Purpose::Data),
    }
}

fn message(input: &mut Input<'_>) -> Message {
    let count = usize::from(input.byte() % 8);
    match input.byte() % 18 {
        0 => Message::Swim(input.chunk().to_vec()),
        1 => Message::Ping {
            version: input.number(),
        },
        2 => Message::Pong {
            version: input.number(),
        },
        3 => {
            let (version, age) = (input.number(), input.byte());
            let entry = |_| DigestEntry {
                tag: member(input.byte() % 4).tag(),
                version: input.number(),
            };
            Message::Digest {
                version,
                beacon_age_s: (age % 4 > 0).then_some(age),
                others: (0..count).map(entry).collect(),
            }
        }
        4 => Message::Pull((0..count).map(|_| range(input)).collect()),
        5 => Message::Delta(Delta {
            range: range(input),
            version: input.number(),
            changes: (0..count).map(|_| change(input)).collect(),
        }),
        6 => Message::SchemaRequest {
            hash: hash(input),
            missing: input.number(),
        },
        7 => Message::SchemaPart(SchemaPart {
            hash: hash(input),
            index: input.byte(),
            count: input.byte(),
            bytes: input.chunk().to_vec(),
        }),
        8 => {
            let entry = |_| SubscribeEntry {
                want: input.word(),
                name: item_name(input.pick(&NAMES)),
                contract: Contract {
                    max_rate_mhz: input.flag().then(|| input.word()),
                    max_age_ms: input.flag().then(|| input.word()),
                    delivery: input.pick(&[
                        Delivery::Latest,
                        Delivery::Every,
                        Delivery::EveryFromRing,
                    ]),
                    ..Contract::default()
                },
                epoch: Epoch(input.number()),
                seq: Seq(input.number()),
            };
            Message::Subscribe((0..count).map(entry).collect())
        }
        9 => {
            let entry = |_| GrantEntry {
                want: input.word(),
                stream: input.flag().then(|| StreamId(input.word())),
                group: input.flag().then(|| address(input.byte())),
            };
            Message::Grant((0..count).map(entry).collect())
        }
        10 => Message::Unsubscribe((0..count).map(|_| input.word()).collect()),
        11 => {
            let sent = Time(input.number());
            let entry = |_| RenewEntry {
                want: input.word(),
                epoch: Epoch(input.number()),
                seq: Seq(input.number()),
                joined: input.flag(),
                reception: input.pick(&[Reception::Unknown, Reception::Arrives, Reception::Silent]),
            };
            Message::Renew {
                sent,
                entries: (0..count).map(entry).collect(),
            }
        }
        12 => Message::Renewed {
            echo: Time(input.number()),
            at: Time(input.number()),
            unknown: (0..count).map(|_| input.word()).collect(),
        },
        13 => {
            let entry = |_| AckEntry {
                stream: StreamId(input.word()),
                epoch: Epoch(input.number()),
                seq: Seq(input.number()),
            };
            Message::Ack((0..count).map(entry).collect())
        }
        14 => Message::Leave,
        15 => Message::Probe {
            nonce: input.number(),
        },
        16 => Message::Probed {
            nonce: input.number(),
        },
        _ => Message::Addresses {
            revision: input.number(),
            control_addrs: (0..count).map(|_| address(input.byte())).collect(),
        },
    }
}

fn range(input: &mut Input<'_>) -> Range {
    Range {
        from: input.number(),
        to: input.number(),
    }
}

fn change(input: &mut Input<'_>) -> Change {
    let version = input.number();
    let name = item_name(input.pick(&NAMES));
    let item = match input.byte() % 3 {
        0 => ItemState::Withdrawn(name),
        _ => ItemState::Announced(ItemDescription {
            schema_hash: hash(input),
            capacity_bytes: input.word(),
            depth: input.word(),
            ..description(&name, Epoch(input.number()))
        }),
    };
    Change { version, item }
}

fn hash(input: &mut Input<'_>) -> SchemaHash {
    SchemaHash([input.byte() % 4; 16])
}

/// The preamble and the records of one data datagram: good ones, and what follows them.
fn records(input: &mut Input<'_>) -> Vec<u8> {
    let preamble = Preamble {
        path: input.short() % 40,
        number: input.word(),
        sent_us: input.word(),
        is_probe: false,
        is_limited: true,
    };
    let mut plaintext = preamble.to_bytes().to_vec();
    for _ in 0..=input.byte() % 4 {
        let stream = StreamId(input.word());
        let repeat = input.flag();
        let meta = SampleMeta {
            epoch: Epoch(input.number()),
            seq: Seq(input.number()),
            filtered: input.number(),
            capture: Time(input.number()),
            publish: Time(input.number()),
        };
        let fragment = input.flag().then(|| Fragment {
            total: u32::from(input.short()),
            offset: u32::from(input.short()),
            parities: input.byte(),
        });
        let gone = input.flag();
        let payload = input.chunk();
        // Fails for what no record may say; bytes that are no record come by act 7.
        let _unsaid = Record {
            stream,
            repeat,
            gone,
            meta,
            fragment,
            payload,
        }
        .encode(Place::First, &mut plaintext);
    }
    plaintext
}

fn description(name: &ItemName, epoch: Epoch) -> ItemDescription {
    ItemDescription {
        name: name.clone(),
        schema_hash: SchemaHash([1; 16]),
        capacity_bytes: 8,
        depth: 8,
        epoch,
        writer: WriterState::Live,
        program: "fuzz".to_owned(),
    }
}

fn sealed(sealer: &mut Sealer, lane: Lane, stream: StreamId, plaintext: &[u8]) -> Vec<u8> {
    let mut datagram = vec![0; HEADER_BYTES];
    datagram.extend_from_slice(plaintext);
    sealer
        .seal(lane, stream, &mut datagram, 0)
        .expect("a play is shorter than the counters");
    datagram
}

fn encoded<T: serde::Serialize>(value: &T) -> Vec<u8> {
    let mut bytes = Vec::new();
    codec::encode(value, &mut bytes).expect("messages encode");
    bytes
}

fn key() -> DomainKey {
    DomainKey::from_bytes([5; 32])
}

fn address(number: u8) -> SocketAddr {
    SocketAddr::from((Ipv4Addr::new(10, 0, 0, number), 7400))
}

fn host_name(text: &str) -> HostName {
    HostName::parse(text).expect("it is a name")
}

fn item_name(text: &str) -> ItemName {
    ItemName::parse(text, &host_name("host")).expect("it is a name")
}
