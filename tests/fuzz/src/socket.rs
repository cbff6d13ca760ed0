//! A host's daemon as its programs see it: the registry, fed by clients that lie, with the segments that they make.
//!
//! One client is honest: it writes `keep` and reads it. Whatever the others send, nothing panics, each answer fits one
//! message, the honest client is never cut off, its item stays as it was, and when the others are gone, nothing of theirs
//! is wanted any more.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::fs::File;
use std::os::fd::OwnedFd;
use std::os::unix::fs::FileExt as _;
use std::sync::Arc;
use std::time::Duration;

use ddx_store::Quotas;
use ddx_store::control::{
    HeldCell, MESSAGE_MAX_BYTES, Notice, Purpose, Reply, Request, ToClient, ToDaemon, VERSION,
};
use ddx_store::notify::Bells;
use ddx_store::segment::{Origin, SegmentFds, SegmentWriter, Spec};
use ddx_store::server::registry::{ClientId, Effect, Event, Identity, Registry, RemoteItem};
use ddx_wire::{
    Contract, Epoch, HostName, ItemDescription, ItemName, SchemaHash, Seq, Time, WriterState,
};
use rustix::event::{EventfdFlags, eventfd};
use rustix::fs::{MemfdFlags, SealFlags, fcntl_add_seals, memfd_create};

use crate::Input;

/// Acts of a play. More would only make each run slower.
const ACTS: usize = 200;
/// Connections of liars that a play may make.
const LIARS: usize = 4;
/// Segments that a play may scribble over after the daemon has them.
const SCRIBBLED: usize = 4;

const KEEP: &str = "keep";
const U64: &str = "schema u64 plain u64\n";
const NAMES: [&str; 8] = [
    "a",
    "./b/c",
    "keep",
    "host/keep",
    "base/x",
    "base/y",
    "@/self",
    "/a//",
];
const SCHEMAS: [&str; 4] = [
    U64,
    "schema P plain struct size 16 {\n  a: u64 @0\n  b: f32 @8\n  c: u32 @12\n}\n",
    "schema P bincode struct {\n  a: string\n  b: [u8]\n}\n",
    "schema P plain struct size 8 {\n  a: u64 @8\n}\n",
];

/// Plays `data`; panics when something does not hold.
pub fn run(data: &[u8]) {
    let mut input = Input::new(data);
    let mut world = World::new();
    for _ in 0..ACTS {
        let Some(act) = input.step() else {
            break;
        };
        world.act(act, &mut input);
        world.settle();
    }
    world.end();
}

struct World {
    now: Time,
    registry: Registry,
    honest: ClientId,
    /// Of the honest item.
    writer: Option<SegmentWriter>,
    kept_epoch: Epoch,
    liars: Vec<ClientId>,
    /// Epoch that a client was given last, which its next segment must have.
    granted: BTreeMap<ClientId, Epoch>,
    /// Memory that liars share with others: their own `ctl`, those that they read by, the bells.
    scribbled: VecDeque<OwnedFd>,
    /// Answers to the honest client.
    answers: VecDeque<Reply>,
    wanted: BTreeSet<ItemName>,
    announced: BTreeSet<ItemName>,
    serial: u32,
}

impl World {
    fn new() -> Self {
        let identity = Identity {
            host: host(),
            domain: 0,
            ordinal: 2,
            quotas: Quotas {
                clients: 4,
                items: 6,
                bytes: 1 << 20,
                cells: 12,
                fds: 16,
                messages_per_second: 100,
                queued_replies: 64,
            },
        };
        let (bells, bells_fd) = Bells::create().expect("memory for bells");
        let now = Time(1_000_000_000);
        let mut registry = Registry::new(identity, Arc::new(bells), Arc::new(bells_fd));
        let honest = registry
            .connect(1, false, now)
            .expect("the first client has room");
        let mut world = Self {
            now,
            registry,
            honest,
            writer: None,
            kept_epoch: Epoch::default(),
            liars: Vec::new(),
            granted: BTreeMap::new(),
            scribbled: VecDeque::new(),
            answers: VecDeque::new(),
            wanted: BTreeSet::new(),
            announced: BTreeSet::new(),
            serial: 0,
        };
        world.keep();
        world
    }

    /// The honest client writes its item.
    fn keep(&mut self) {
        let program = "honest".to_owned();
        self.ask(
            Request::Hello {
                version: VERSION,
                program,
            },
            Vec::new(),
        );
        let open = Request::OpenWriter {
            handle: 1,
            name: KEEP.to_owned(),
            schema: U64.to_owned(),
            purpose: Purpose::Write,
        };
        let Reply::Writer { epoch, .. } = self.ask(open, Vec::new()) else {
            panic!("no lease");
        };
        let (writer, fds) = segment(small(), epoch);
        let done = self.ask(Request::Commit { handle: 1 }, vec![fds.data, fds.ctl]);
        assert_eq!(done, Reply::Done);
        self.writer = Some(writer);
        self.kept_epoch = epoch;
    }

    fn act(&mut self, act: u8, input: &mut Input<'_>) {
        match act % 10 {
            0 => self.connect(input),
            1 => {
                let (liar, fds) = (self.liar(input), self.descriptors(input));
                self.say(liar, input.chunk(), fds);
            }
            2..=5 => {
                let liar = self.liar(input);
                let fds = self.descriptors(input);
                let message = ToDaemon {
                    serial: input.word(),
                    request: request(input),
                };
                self.say(liar, &message.encode().expect("requests encode"), fds);
            }
            6 => {
                let at = usize::from(input.byte());
                if at < self.liars.len() {
                    self.registry.disconnect(self.liars.remove(at));
                }
            }
            7 => self.now = self.now + Duration::from_millis(input.number()),
            8 => self.scribble(input),
            _ => match input.byte() % 3 {
                0 => {
                    let liar = self.liar(input);
                    self.registry.handle_oversized(liar);
                }
                1 => self
                    .registry
                    .set_remote((0..input.byte() % 8).map(|_| remote(input)).collect()),
                _ => {
                    let name = ItemName::parse("base/x", &host()).expect("it is a name");
                    self.registry
                        .set_notes([(name, "by unicast".to_owned())].into());
                }
            },
        }
    }

    fn connect(&mut self, input: &mut Input<'_>) {
        if self.liars.len() >= LIARS {
            return;
        }
        // Refused when there are too many, which the honest client must not feel.
        let Ok(liar) = self.registry.connect(2, false, self.now) else {
            return;
        };
        self.liars.push(liar);
        if input.flag() {
            let program = String::from_utf8_lossy(input.chunk()).into_owned();
            let request = Request::Hello {
                version: VERSION,
                program,
            };
            let hello = ToDaemon { serial: 0, request };
            self.say(liar, &hello.encode().expect("requests encode"), Vec::new());
        }
    }

    /// One of the liars, who may be gone or never have been there.
    fn liar(&self, input: &mut Input<'_>) -> ClientId {
        let at = usize::from(input.byte());
        self.liars.get(at).copied().unwrap_or(ClientId(u64::MAX))
    }

    fn say(&mut self, client: ClientId, bytes: &[u8], fds: Vec<OwnedFd>) {
        self.registry.handle(client, bytes, fds, self.now);
        self.settle();
    }

    fn ask(&mut self, request: Request, fds: Vec<OwnedFd>) -> Reply {
        self.serial += 1;
        self.now = self.now + Duration::from_secs(1);
        let message = ToDaemon {
            serial: self.serial,
            request,
        };
        let bytes = message.encode().expect("requests encode");
        self.say(self.honest, &bytes, fds);
        self.answers.pop_back().expect("each request is answered")
    }

    /// What goes beside a message: segments, good and bad, and what is none.
    fn descriptors(&mut self, input: &mut Input<'_>) -> Vec<OwnedFd> {
        let kind = input.byte();
        if kind < 128 {
            return Vec::new();
        }
        let epoch = match input.byte() {
            0..200 => self.granted.values().last().copied().unwrap_or_default(),
            _ => Epoch(input.number()),
        };
        let spec = Spec {
            capacity_bytes: u32::from(input.byte()),
            depth: u32::from(input.byte() % 8) + 1,
            cells: u32::from(input.byte() % 64) + 1,
            pool: u32::from(input.byte() % 16),
        };
        let (_writer, fds) = segment(spec, epoch);
        match kind % 6 {
            0 | 1 => {
                self.share(&fds.ctl);
                vec![fds.data, fds.ctl]
            }
            2 => vec![damaged(&fds.data, input), fds.ctl],
            3 => vec![fds.ctl, fds.data],
            4 => vec![fds.data],
            _ => {
                let flags = EventfdFlags::CLOEXEC;
                vec![eventfd(0, flags).expect("an event counter"), fds.data]
            }
        }
    }

    fn share(&mut self, memory: &OwnedFd) {
        self.scribbled.extend(memory.try_clone());
        if self.scribbled.len() > SCRIBBLED {
            self.scribbled.pop_front();
        }
    }

    fn scribble(&mut self, input: &mut Input<'_>) {
        let at = usize::from(input.byte());
        if let Some(ctl) = self.scribbled.get(at) {
            let ctl = File::from(ctl.try_clone().expect("a descriptor"));
            let (offset, word) = (u64::from(input.short()), input.number());
            // Fails beyond the end of the file, which is sealed.
            let _beyond = ctl.write_at(&word.to_le_bytes(), offset & !7);
        }
    }

    /// Does what the registry wants done, and looks at it.
    fn settle(&mut self) {
        while let Some(effect) = self.registry.poll_effect() {
            match effect {
                Effect::Send {
                    client,
                    message,
                    fds,
                } => self.deliver(client, message, &fds),
                Effect::Disconnect { client } => {
                    assert_ne!(client, self.honest, "the honest client was cut off");
                    self.liars.retain(|liar| *liar != client);
                }
                Effect::Event(event) => self.hear(event),
                // What a service manager would keep: there is none.
                Effect::Keep(_) => {}
            }
        }
    }

    fn deliver(&mut self, client: ClientId, message: ToClient, fds: &[Arc<OwnedFd>]) {
        let len = message.encode().expect("answers encode").len();
        assert!(
            len <= MESSAGE_MAX_BYTES,
            "an answer of {len} bytes: {message:?}"
        );
        assert!(fds.len() <= 2, "{} descriptors", fds.len());
        if let Some(writable) = fds.last().filter(|_| client != self.honest) {
            self.share(writable);
        }
        match message {
            ToClient::Reply { reply, .. } => {
                if let Reply::Writer { epoch, .. } = &reply {
                    self.granted.insert(client, *epoch);
                }
                if client == self.honest {
                    self.answers.push_back(reply);
                }
            }
            ToClient::Notice { notice, .. } => {
                let closing = matches!(notice, Notice::Closing(_));
                assert!(!closing || client != self.honest, "{notice:?}");
            }
        }
    }

    fn hear(&mut self, event: Event) {
        match event {
            Event::Announced { description, .. } => {
                self.announced.insert(description.name);
            }
            Event::Changed { description } => {
                assert!(
                    self.announced.contains(&description.name),
                    "{description:?}"
                );
            }
            Event::Withdrawn { name } => {
                assert!(self.announced.remove(&name), "`{name}` was not there");
                assert_ne!(name.as_str(), "host/keep");
            }
            Event::Wanted { name, .. } => {
                self.wanted.insert(name);
            }
            Event::Unwanted { name } => {
                assert!(self.wanted.remove(&name), "`{name}` was not wanted");
            }
        }
    }

    fn end(&mut self) {
        let writer = self.writer.as_mut().expect("the honest client has one");
        let slot = writer.loan(8).expect("nobody can starve a writer");
        let published = writer.publish(slot, &Origin::default());
        let describe = Request::Describe {
            name: KEEP.to_owned(),
        };
        let Reply::Description(description) = self.ask(describe, Vec::new()) else {
            panic!("the honest item is gone");
        };
        assert_eq!(
            (description.epoch, description.schema.as_str()),
            (self.kept_epoch, U64)
        );
        assert_eq!(description.entry.writer, Some(WriterState::Live));
        assert_eq!(description.published, published);
        let mut after = String::new();
        let mut listed = BTreeSet::new();
        loop {
            let Reply::Entries { entries, more } = self.ask(Request::List { after }, Vec::new())
            else {
                panic!("no listing");
            };
            after = entries
                .last()
                .map_or_else(String::new, |entry| entry.name.to_string());
            for entry in entries {
                assert!(
                    listed.insert(entry.name.clone()),
                    "`{}` is listed twice",
                    entry.name
                );
            }
            if !more {
                break;
            }
        }
        assert!(listed.iter().any(|name| name.as_str() == "host/keep"));
        for liar in std::mem::take(&mut self.liars) {
            self.registry.disconnect(liar);
        }
        self.settle();
        assert_eq!(self.wanted, BTreeSet::new(), "wanted by nobody");
        assert_eq!(self.registry.client_count(), 1);
    }
}

fn request(input: &mut Input<'_>) -> Request {
    let handle = input.word();
    match input.byte() % 9 {
        0 | 1 => Request::OpenWriter {
            handle,
            name: text(input, &NAMES),
            schema: text(input, &SCHEMAS),
            purpose: input.pick(&[Purpose::Write, Purpose::Put]),
        },
        2 => Request::Commit { handle },
        3 => Request::Resume {
            handle,
            name: text(input, &NAMES),
            schema: text(input, &SCHEMAS),
        },
        4 => Request::OpenReader {
            handle,
            name: text(input, &NAMES),
            schema: input.flag().then(|| text(input, &SCHEMAS)),
            pins: input.word(),
            contract: Contract {
                max_rate_mhz: input.flag().then(|| input.word()),
                max_age_ms: input.flag().then(|| input.word()),
                ..Contract::default()
            },
            held: input.flag().then(|| HeldCell {
                epoch: Epoch(input.number()),
                cell: input.word(),
                pins: input.word(),
            }),
        },
        5 => Request::Close { handle },
        6 => Request::List {
            after: text(input, &NAMES),
        },
        7 => Request::Describe {
            name: text(input, &NAMES),
        },
        _ => Request::Remove {
            name: text(input, &NAMES),
        },
    }
}

/// One of `known`, or anything, perhaps repeated until it is long.
fn text(input: &mut Input<'_>, known: &[&str]) -> String {
    match input.byte() {
        0..200 => input.pick(known).to_owned(),
        200..250 => String::from_utf8_lossy(input.chunk()).into_owned(),
        _ => {
            let times = usize::from(input.byte());
            String::from_utf8_lossy(input.chunk()).repeat(times)
        }
    }
}

fn remote(input: &mut Input<'_>) -> RemoteItem {
    let name = text(input, &NAMES);
    let name = ItemName::parse(&name, &host())
        .ok()
        .filter(|name| name.prefix() != "host");
    let name = name.unwrap_or_else(|| ItemName::parse("base/x", &host()).expect("it is a name"));
    RemoteItem {
        host: HostName::sanitised(name.prefix()),
        description: ItemDescription {
            name,
            schema_hash: SchemaHash([1; 16]),
            capacity_bytes: input.word(),
            depth: input.word(),
            epoch: Epoch(input.number()),
            writer: WriterState::Live,
            program: String::from_utf8_lossy(input.bytes(64)).into_owned(),
        },
        schema: text(input, &SCHEMAS).into(),
    }
}

fn host() -> HostName {
    HostName::parse("host").expect("it is a name")
}

fn small() -> Spec {
    Spec {
        capacity_bytes: 8,
        depth: 4,
        cells: 8,
        pool: 4,
    }
}

/// A good segment with one sample.
fn segment(spec: Spec, epoch: Epoch) -> (SegmentWriter, SegmentFds) {
    let (mut writer, fds) = SegmentWriter::create(spec, epoch).expect("memory for a segment");
    if let Ok(slot) = writer.loan(0) {
        let origin = Origin {
            epoch,
            seq: Seq(1),
            ..Origin::default()
        };
        writer.publish(slot, &origin);
    }
    (writer, fds)
}

/// The same file with some words changed, or of another size, or without its seals.
fn damaged(data: &OwnedFd, input: &mut Input<'_>) -> OwnedFd {
    let data = File::from(data.try_clone().expect("a descriptor"));
    let mut head = [0; 512];
    let found = data.read_at(&mut head, 0).expect("a memfd can be read");
    let flags = MemfdFlags::CLOEXEC | MemfdFlags::ALLOW_SEALING;
    let copy = File::from(memfd_create("damaged", flags).expect("memory for a segment"));
    copy.write_all_at(&head[..found], 0)
        .expect("a memfd can be written");
    let len = match input.byte() {
        0..200 => data.metadata().expect("a memfd has a size").len(),
        _ => input.number() % (1 << 24),
    };
    copy.set_len(len).expect("a memfd has any size");
    for _ in 0..input.byte() % 4 {
        let (offset, word) = (u64::from(input.byte()) * 8, input.number());
        if offset + 8 <= len {
            copy.write_all_at(&word.to_le_bytes(), offset)
                .expect("a memfd can be written");
        }
    }
    if input.byte() < 200 {
        let seals = SealFlags::SHRINK | SealFlags::GROW | SealFlags::FUTURE_WRITE | SealFlags::SEAL;
        fcntl_add_seals(&copy, seals).expect("a new file takes seals");
    }
    copy.into()
}
