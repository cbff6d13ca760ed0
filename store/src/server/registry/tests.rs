//! The registry without sockets: messages in, effects out.

use ddx_wire::{SchemaHash, WriterState};

use super::*;
use crate::control::{MESSAGE_MAX_BYTES, Purpose};
use crate::segment::{SegmentFds, SegmentWriter, Spec};
use crate::server::Orphan;

struct Bench {
    registry: Registry,
    serial: u32,
}

impl Bench {
    fn new(quotas: Quotas) -> Self {
        Self::in_life(3, quotas)
    }

    fn in_life(ordinal: u32, quotas: Quotas) -> Self {
        let (bells, fd) = Bells::create().unwrap();
        let identity = Identity {
            host: HostName::parse("host").unwrap(),
            domain: 0,
            ordinal,
            quotas,
        };
        Self {
            registry: Registry::new(identity, Arc::new(bells), Arc::new(fd)),
            serial: 0,
        }
    }

    fn client(&mut self) -> ClientId {
        let client = self.registry.connect(7, false, Time(0)).unwrap();
        let program = "p".to_owned();
        let hello = self.ask(
            client,
            Request::Hello {
                version: VERSION,
                program,
            },
            vec![],
        );
        assert!(matches!(hello, Reply::Hello { .. }));
        client
    }

    /// The answer; what else the request has caused stays queued.
    fn ask(&mut self, client: ClientId, request: Request, fds: Vec<OwnedFd>) -> Reply {
        self.serial += 1;
        let serial = self.serial;
        let bytes = ToDaemon { serial, request }.encode().unwrap();
        self.registry.handle(client, &bytes, fds, Time(0));
        let at = self.registry.effects.iter().position(|effect| {
            matches!(effect, Effect::Send { message: ToClient::Reply { serial: of, .. }, .. } if *of == serial)
        });
        match self.registry.effects.remove(at.unwrap()) {
            Some(Effect::Send {
                message: ToClient::Reply { reply, .. },
                ..
            }) => reply,
            other => panic!("{other:?}"),
        }
    }

    fn open_writer(&mut self, client: ClientId, handle: u32) -> Reply {
        let schema = Schema::scalar("u64").unwrap().text().to_owned();
        let request = Request::OpenWriter {
            handle,
            name: "n".to_owned(),
            schema,
            purpose: Purpose::Write,
        };
        self.ask(client, request, vec![])
    }

    fn commit(&mut self, client: ClientId, handle: u32, epoch: Epoch) -> Reply {
        let (_, SegmentFds { data, ctl }) = SegmentWriter::create(SPEC, epoch).unwrap();
        self.ask(client, Request::Commit { handle }, vec![data, ctl])
    }

    fn open_reader(&mut self, client: ClientId, handle: u32) -> Reply {
        let request = Request::OpenReader {
            handle,
            name: "n".to_owned(),
            schema: None,
            pins: 0,
            contract: Contract::default(),
            held: None,
        };
        self.ask(client, request, vec![])
    }

    /// What the keeper was told, in order.
    fn kept(&mut self) -> Vec<Keep> {
        std::iter::from_fn(|| self.registry.poll_effect())
            .filter_map(|effect| match effect {
                Effect::Keep(keep) => Some(keep),
                Effect::Send { .. } | Effect::Disconnect { .. } | Effect::Event(_) => None,
            })
            .collect()
    }

    fn notices(&mut self) -> Vec<(ClientId, u32, Notice)> {
        std::iter::from_fn(|| self.registry.poll_effect())
            .filter_map(|effect| match effect {
                Effect::Send {
                    client,
                    message: ToClient::Notice { handle, notice },
                    ..
                } => Some((client, handle, notice)),
                Effect::Send { .. }
                | Effect::Disconnect { .. }
                | Effect::Event(_)
                | Effect::Keep(_) => None,
            })
            .collect()
    }
}

const SPEC: Spec = Spec {
    capacity_bytes: 8,
    depth: 2,
    cells: 2,
    pool: 0,
};

fn epoch_of(reply: &Reply) -> Epoch {
    let Reply::Writer { epoch, .. } = reply else {
        panic!("{reply:?}");
    };
    *epoch
}

#[test]
fn a_reader_that_came_first_is_bound_when_the_segment_arrives() {
    let mut bench = Bench::new(Quotas::default());
    let (writer, reader) = (bench.client(), bench.client());
    let waits = bench.open_reader(reader, 5);
    assert!(matches!(waits, Reply::Reader { binding: None, .. }));

    let granted = bench.open_writer(writer, 1);
    assert!(bench.notices().is_empty());
    assert_eq!(bench.commit(writer, 1, epoch_of(&granted)), Reply::Done);

    let notices = bench.notices();
    assert!(
        matches!(&notices[..], [(to, 5, Notice::Bound(binding))] if *to == reader && binding.epoch == epoch_of(&granted))
    );
}

#[test]
fn every_writer_has_a_later_epoch_and_a_death_frees_the_lease() {
    let mut bench = Bench::new(Quotas::default());
    let (first, second) = (bench.client(), bench.client());
    let former = epoch_of(&bench.open_writer(first, 1));
    assert!(matches!(
        bench.open_writer(second, 1),
        Reply::Refused(Refusal::Held { pid: 7, .. })
    ));

    bench.registry.disconnect(first);

    assert_eq!(former, Epoch::new(3, 1));
    assert!(epoch_of(&bench.open_writer(second, 1)) > former);
}

#[test]
fn a_segment_of_another_epoch_is_refused() {
    let mut bench = Bench::new(Quotas::default());
    let writer = bench.client();
    bench.open_writer(writer, 1);

    let refused = bench.commit(writer, 1, Epoch::new(9, 9));

    assert!(matches!(refused, Reply::Refused(Refusal::Segment(_))));
    assert_eq!(bench.registry.counters().bad_segments, 1);
}

#[test]
fn a_client_that_dies_leaves_no_trace_but_its_value() {
    let mut bench = Bench::new(Quotas::default());
    let (writer, reader) = (bench.client(), bench.client());
    let granted = bench.open_writer(writer, 1);
    bench.commit(writer, 1, epoch_of(&granted));
    bench.open_reader(reader, 1);
    bench.open_reader(reader, 2);

    bench.registry.disconnect(reader);
    bench.registry.disconnect(writer);

    assert_eq!(bench.registry.client_count(), 0);
    let item = bench.registry.items.values().next().unwrap();
    assert!(item.lease.is_none() && item.readers.is_empty() && item.tenure.is_some());
}

#[test]
fn any_bytes_are_an_answer_or_the_end_of_the_connection() {
    let mut bench = Bench::new(Quotas::default());
    for first in 0..=255 {
        let client = bench.client();
        bench.registry.handle(client, &[first; 9], vec![], Time(0));
        let told = std::iter::from_fn(|| bench.registry.poll_effect()).count();
        assert!(told > 0, "{first} was ignored");
        bench.registry.disconnect(client);
    }
}

#[test]
fn a_description_fits_one_message_whatever_others_have_said() {
    let mut bench = Bench::new(Quotas::default());
    let (writer, reader) = (bench.client(), bench.client());
    let nested = |innermost: &str| {
        let depth = 14;
        let open = format!("{}: struct {{ ", "f".repeat(120)).repeat(depth);
        let close = " }".repeat(depth);
        format!("schema P bincode struct {{ {open}x: {innermost}{close} }}")
    };
    for handle in 0..64 {
        let request = Request::OpenReader {
            handle,
            name: "n".to_owned(),
            schema: Some(nested("u16")),
            pins: 0,
            contract: Contract::default(),
            held: None,
        };
        assert!(matches!(
            bench.ask(reader, request, vec![]),
            Reply::Reader { .. }
        ));
    }
    let lease = Request::OpenWriter {
        handle: 1,
        name: "n".to_owned(),
        schema: nested("u8"),
        purpose: Purpose::Write,
    };
    let epoch = epoch_of(&bench.ask(writer, lease, vec![]));
    assert_eq!(bench.commit(writer, 1, epoch), Reply::Done);
    let far = ItemName::parse("base/x", &HostName::parse("host").unwrap()).unwrap();
    bench
        .registry
        .set_notes([(far.clone(), "é".repeat(40_000))].into());
    bench.registry.set_remote(vec![RemoteItem {
        host: HostName::parse("base").unwrap(),
        description: ItemDescription {
            name: far,
            schema_hash: SchemaHash::default(),
            capacity_bytes: 8,
            depth: 8,
            epoch: Epoch(1),
            writer: WriterState::Live,
            program: "p".to_owned(),
        },
        schema: Schema::raw("far", "json", &"x".repeat(60_000))
            .unwrap()
            .text()
            .into(),
    }]);

    for (name, refused) in [("n", 64), ("base/x", 0)] {
        let request = Request::Describe {
            name: name.to_owned(),
        };
        let reply = bench.ask(writer, request, vec![]);
        let Reply::Description(description) = &reply else {
            panic!("{reply:?}");
        };
        let readers = &description.readers;
        assert_eq!(
            readers
                .iter()
                .filter(|reader| reader.refused.is_some())
                .count(),
            refused
        );
        let len = ToClient::Reply { serial: 1, reply }.encode().unwrap().len();
        assert!(len <= MESSAGE_MAX_BYTES, "`{name}`: {len} bytes");
    }
}

/// The orphan of `n` that a registry of life 3 has told its keeper of, and that registry.
fn orphan() -> (Bench, Orphan) {
    let mut bench = Bench::new(Quotas::default());
    let client = bench.client();
    let epoch = epoch_of(&bench.open_writer(client, 1));
    bench.commit(client, 1, epoch);
    bench.registry.disconnect(client);
    let [Keep::Hold(orphan)] = &bench.kept()[..] else {
        panic!("not one orphan");
    };
    let orphan = orphan.clone();
    (bench, orphan)
}

#[test]
fn an_orphan_comes_back_in_the_next_life_under_its_own_epoch() {
    let (_, orphan) = orphan();
    let files = orphan.files().unwrap();
    let again = files.iter().rev().map(|file| file.try_clone().unwrap());
    let read = Orphan::from_files(orphan.epoch(), again.collect()).unwrap();

    let mut next = Bench::in_life(4, Quotas::default());
    next.registry.restore(read).unwrap();

    let name = ItemName::parse("host/n", &next.registry.identity.host).unwrap();
    let item = next.registry.describe(&name).unwrap();
    assert_eq!(item.entry.writer, Some(WriterState::Orphaned));
    assert_eq!(
        (item.epoch, item.entry.program.as_str()),
        (orphan.epoch(), "p")
    );
    assert_eq!(next.registry.orphans().len(), 1);
    let reader = next.client();
    let bound = next.open_reader(reader, 1);
    assert!(
        matches!(
            bound,
            Reply::Reader {
                binding: Some(_),
                ..
            }
        ),
        "{bound:?}"
    );
}

#[test]
fn an_orphan_gives_way_to_a_writer_that_took_over_before_the_daemon_died() {
    let (_, orphan) = orphan();
    let mut next = Bench::in_life(4, Quotas::default());
    let old = orphan.epoch();
    next.registry.restore(orphan).unwrap();

    let client = next.client();
    let later = Epoch(old.0 + 1);
    let (_, SegmentFds { data, ctl }) = SegmentWriter::create(SPEC, later).unwrap();
    let request = Request::Resume {
        handle: 1,
        name: "host/n".to_owned(),
        schema: Schema::scalar("u64").unwrap().text().to_owned(),
    };
    let resumed = next.ask(client, request, vec![data, ctl]);

    assert_eq!(resumed, Reply::Done);
    let kept = next.kept();
    assert!(
        matches!(kept[..], [Keep::Release(epoch)] if epoch == old),
        "{kept:?}"
    );
}

#[test]
fn what_was_removed_stays_so_and_its_keeper_is_told() {
    let (mut bench, orphan) = orphan();
    let client = bench.client();
    let name = "n".to_owned();

    bench.ask(client, Request::Remove { name }, vec![]);

    let kept = bench.kept();
    assert!(
        matches!(kept[..], [Keep::Release(epoch)] if epoch == orphan.epoch()),
        "{kept:?}"
    );
    let refused = Bench::in_life(4, Quotas::default())
        .registry
        .restore(orphan);
    assert!(
        refused
            .unwrap_err()
            .to_string()
            .contains("taken over or removed")
    );
}

#[test]
fn an_orphan_that_does_not_fit_is_refused_by_its_fault() {
    let (mut bench, orphan) = orphan();
    let mut next = Bench::in_life(4, Quotas::default());
    let mut refusal = |change: &dyn Fn(&mut Orphan)| {
        let mut bad = orphan.clone();
        change(&mut bad);
        next.registry.restore(bad).unwrap_err().to_string()
    };
    let foreign = ItemName::parse("other/n", &bench.registry.identity.host).unwrap();

    let said = refusal(&|bad| bad.label.name = foreign.clone());
    assert!(said.contains("not under this host's prefix"), "{said}");
    let said = refusal(&|bad| bad.label.schema = "nonsense".to_owned());
    assert!(said.contains("schema"), "{said}");
    let said = refusal(&|bad| bad.label.writer = WriterState::Live);
    assert!(said.contains("a program writes it"), "{said}");
    let said = refusal(&|bad| bad.epoch = Epoch(1));
    assert!(said.contains("another epoch"), "{said}");
    let said = refusal(&|bad| std::mem::swap(&mut bad.data, &mut bad.ctl));
    assert!(said.contains("not sealed"), "{said}");
    assert!(next.registry.items.is_empty());
    next.registry.restore(orphan.clone()).unwrap();
    let twice = next.registry.restore(orphan.clone()).unwrap_err();
    assert!(twice.to_string().contains("a later value"), "{twice}");
    let same_life = bench.registry.restore(orphan).unwrap_err();
    assert!(same_life.to_string().contains("later life"), "{same_life}");
}
