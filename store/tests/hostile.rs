//! Clients that break the rules, and many that do not: the others go on, and errors name the limit.
#![expect(
    clippy::unwrap_used,
    clippy::print_stdout,
    reason = "a helper that cannot go on fails its test, and processes of a test talk by lines"
)]
#![expect(
    unreachable_pub,
    dead_code,
    reason = "what the tests of processes share is public in its own module, and each uses a part of it"
)]

#[path = "support/rig.rs"]
mod rig;

use std::io::{IoSlice, IoSliceMut};
use std::mem::MaybeUninit;
use std::os::fd::{AsFd, OwnedFd};
use std::path::Path;
use std::time::Duration;

use ddx_store::control::{self, Binding, Notice, Purpose, Reply, Request, ToClient, ToDaemon};
use ddx_store::{Error, Quotas, Refusal, Schema, Store, WriterOptions};
use rig::{Daemon, LONG, NONE};
use rustix::net::{
    AddressFamily, RecvAncillaryBuffer, RecvAncillaryMessage, RecvFlags, SendAncillaryBuffer,
    SendAncillaryMessage, SendFlags, SocketAddrUnix, SocketType,
};

/// A client that speaks as it likes.
struct Talker {
    socket: OwnedFd,
    serial: u32,
}

impl Talker {
    fn connect(path: &Path) -> Self {
        let socket = rustix::net::socket(AddressFamily::UNIX, SocketType::SEQPACKET, None).unwrap();
        rustix::net::connect(&socket, &SocketAddrUnix::new(path).unwrap()).unwrap();
        rustix::net::sockopt::set_socket_timeout(
            &socket,
            rustix::net::sockopt::Timeout::Recv,
            Some(LONG),
        )
        .unwrap();
        Self { socket, serial: 0 }
    }

    fn greeted(path: &Path) -> Self {
        let mut talker = Self::connect(path);
        let program = "talker".to_owned();
        let reply = talker
            .ask(
                Request::Hello {
                    version: control::VERSION,
                    program,
                },
                &[],
            )
            .0;
        assert!(matches!(reply, Reply::Hello { .. }));
        talker
    }

    fn send(&self, bytes: &[u8], fds: &[&OwnedFd]) {
        let fds: Vec<_> = fds.iter().map(|fd| fd.as_fd()).collect();
        let mut space = [MaybeUninit::uninit(); 64];
        let mut beside = SendAncillaryBuffer::new(&mut space);
        if !fds.is_empty() {
            assert!(beside.push(SendAncillaryMessage::ScmRights(&fds)));
        }
        let slices = [IoSlice::new(bytes)];
        rustix::net::sendmsg(&self.socket, &slices, &mut beside, SendFlags::NOSIGNAL).unwrap();
    }

    /// The next message; none when the daemon has hung up.
    fn receive(&self) -> Option<(ToClient, Vec<OwnedFd>)> {
        let mut bytes = vec![0; 64 * 1024];
        let mut space = [MaybeUninit::uninit(); 64];
        let mut beside = RecvAncillaryBuffer::new(&mut space);
        let slices = &mut [IoSliceMut::new(&mut bytes)];
        let received =
            rustix::net::recvmsg(&self.socket, slices, &mut beside, RecvFlags::empty()).ok()?;
        let mut fds = Vec::new();
        for message in beside.drain() {
            if let RecvAncillaryMessage::ScmRights(rights) = message {
                fds.extend(rights);
            }
        }
        let message = ToClient::decode(bytes.get(..received.bytes)?).ok()?;
        Some((message, fds))
    }

    fn ask(&mut self, request: Request, fds: &[&OwnedFd]) -> (Reply, Vec<OwnedFd>) {
        self.serial += 1;
        let serial = self.serial;
        self.send(&ToDaemon { serial, request }.encode().unwrap(), fds);
        loop {
            match self.receive().expect("an answer") {
                (ToClient::Reply { serial: of, reply }, fds) => {
                    assert_eq!(of, serial);
                    return (reply, fds);
                }
                (ToClient::Notice { .. }, _) => {}
            }
        }
    }

    fn refusal(&mut self, request: Request, fds: &[&OwnedFd]) -> String {
        let Reply::Refused(refusal) = self.ask(request, fds).0 else {
            panic!("not refused");
        };
        refusal.to_string()
    }

    /// The last words of the daemon, which then hangs up.
    fn farewell(&self) -> String {
        let Some((
            ToClient::Notice {
                notice: Notice::Closing(refusal),
                ..
            },
            _,
        )) = self.receive()
        else {
            panic!("no farewell");
        };
        assert!(self.receive().is_none());
        refusal.to_string()
    }
}

fn small() -> Quotas {
    Quotas {
        clients: 40,
        items: 3,
        bytes: 4 << 20,
        cells: 5,
        ..Quotas::default()
    }
}

fn open_writer(handle: u32, name: &str) -> Request {
    Request::OpenWriter {
        handle,
        name: name.to_owned(),
        schema: Schema::scalar("u64").unwrap().text().to_owned(),
        purpose: Purpose::Write,
    }
}

fn open_reader(handle: u32, name: &str) -> Request {
    Request::OpenReader {
        handle,
        name: name.to_owned(),
        schema: None,
        pins: 0,
        contract: ddx_wire::Contract::default(),
        held: None,
    }
}

/// A sample goes from a new writer to a new reader.
fn assert_serves(store: &Store) {
    let mut writer = store.writer::<u64>("probe").unwrap();
    let mut reader = store.reader::<u64>("probe").unwrap();
    let before = reader.current().unwrap().map_or(0, |sample| sample.value);
    writer.write(&(before + 1)).unwrap();
    assert_eq!(reader.current().unwrap().unwrap().value, before + 1);
}

fn refused<T>(result: Result<T, Error>) -> String {
    match result {
        Err(error @ Error::Refused(_)) => error.to_string(),
        Err(other) => panic!("{other}"),
        Ok(_) => panic!("not refused"),
    }
}

#[test]
fn garbage_is_answered_and_ends_the_connection() {
    let daemon = Daemon::start(small());
    let store = daemon.store();
    for garbage in [vec![0xff; 100], vec![7], vec![0; 60_000]] {
        let talker = Talker::connect(&daemon.socket());
        talker.send(&garbage, &[]);
        assert!(talker.farewell().starts_with("bad message"));
    }
    let talker = Talker::connect(&daemon.socket());
    talker.send(&vec![1; 100_000], &[]);
    assert_eq!(talker.farewell(), "bad message: longer than any message");

    assert_eq!(daemon.handle().counters().unwrap().bad_messages, 4);
    assert_serves(&store);
}

#[test]
fn who_does_not_greet_first_is_sent_away() {
    let daemon = Daemon::start(small());
    let talker = Talker::connect(&daemon.socket());
    let request = Request::List {
        after: String::new(),
    };
    talker.send(&ToDaemon { serial: 1, request }.encode().unwrap(), &[]);

    assert_eq!(talker.farewell(), "bad message: no greeting yet");
    assert_serves(&daemon.store());
}

#[test]
fn closing_at_any_step_leaves_nothing_behind() {
    let daemon = Daemon::start(small());
    let store = daemon.store();
    let steps: [fn(&mut Talker); 3] = [
        |_| {},
        |talker| {
            talker.ask(open_writer(1, "n"), &[]);
        },
        |talker| {
            talker.ask(open_reader(1, "n"), &[]);
            talker.ask(open_writer(2, "n"), &[]);
        },
    ];
    for step in steps {
        let mut talker = Talker::greeted(&daemon.socket());
        step(&mut talker);
        drop(talker);
        rig::until("the item is free", || store.describe("n").is_err());
    }
    // Half a message: the kernel delivers datagrams whole, so what is cut is one that does not decode.
    let talker = Talker::greeted(&daemon.socket());
    let whole = ToDaemon {
        serial: 1,
        request: open_writer(1, "n"),
    }
    .encode()
    .unwrap();
    talker.send(whole.get(..whole.len() / 2).unwrap(), &[]);
    drop(talker);

    assert_serves(&store);
}

#[test]
fn a_million_items_stop_at_the_limit() {
    let daemon = Daemon::start(small());
    let greedy = daemon.store();
    let writers: Vec<_> = (0..3)
        .map(|n| greedy.writer::<u64>(&format!("i{n}")).unwrap())
        .collect();

    let message = refused(greedy.writer::<u64>("i4"));

    assert_eq!(
        message,
        "limit reached: items written by this client: 4 wanted, 3 allowed"
    );
    assert_serves(&daemon.store());
    drop(writers);
    greedy.writer::<u64>("i4").unwrap();
}

#[test]
fn memory_and_readers_stop_at_their_limits() {
    let daemon = Daemon::start(small());
    let greedy = daemon.store();
    let options = WriterOptions {
        capacity_bytes: Some(1 << 20),
        ..WriterOptions::default()
    };
    let schema = Schema::bytes();

    let bytes = refused(greedy.raw_writer("big", &schema, options));
    let readers: Vec<_> = (0..5)
        .map(|n| greedy.reader::<u64>(&format!("r{n}")).unwrap())
        .collect();
    let cells = refused(greedy.reader::<u64>("r6"));

    assert!(
        bytes.starts_with("limit reached: bytes of shared memory of this client: "),
        "{bytes}"
    );
    assert_eq!(
        cells,
        "limit reached: readers held by this client: 6 wanted, 5 allowed"
    );
    drop(readers);
    assert_serves(&daemon.store());
}

#[test]
fn an_item_seats_as_many_readers_as_its_writer_allows() {
    let daemon = Daemon::start(Quotas::default());
    let store = daemon.store();
    let options = WriterOptions {
        max_readers: 2,
        ..WriterOptions::default()
    };
    let _writer = store.writer_with::<u64>("n", options).unwrap();
    let first = store.reader::<u64>("n").unwrap();
    let _second = store.reader::<u64>("n").unwrap();

    let message = refused(store.reader::<u64>("n"));
    drop(first);

    assert_eq!(
        message,
        "limit reached: readers of this item: 3 wanted, 2 allowed"
    );
    store.reader::<u64>("n").unwrap();
}

#[test]
fn more_requests_than_the_rate_are_refused() {
    let quotas = Quotas {
        messages_per_second: 10,
        ..Quotas::default()
    };
    let daemon = Daemon::start(quotas);
    let fast = daemon.store();

    let message = (0..100).find_map(|_| {
        fast.describe("n")
            .err()
            .filter(|error| matches!(error, Error::Refused(Refusal::Quota { .. })))
    });

    let message = message.expect("a limit").to_string();
    assert_eq!(
        message,
        "limit reached: requests per second of this client: 11 wanted, 10 allowed"
    );
    assert_serves(&daemon.store());
}

#[test]
fn who_does_not_collect_answers_is_cut_off() {
    let quotas = Quotas {
        queued_replies: 100,
        messages_per_second: 1_000_000,
        ..Quotas::default()
    };
    let daemon = Daemon::start(quotas);
    let talker = Talker::greeted(&daemon.socket());
    let request = Request::Describe {
        name: "n".repeat(200),
    };
    let message = ToDaemon { serial: 1, request }.encode().unwrap();

    rig::until("cut off", || {
        let sent = rustix::net::send(
            &talker.socket,
            &message,
            SendFlags::NOSIGNAL | SendFlags::DONTWAIT,
        );
        matches!(
            sent,
            Err(rustix::io::Errno::PIPE | rustix::io::Errno::CONNRESET)
        )
    });

    assert_eq!(daemon.handle().counters().unwrap().overflows, 1);
    assert_serves(&daemon.store());
}

#[test]
fn one_client_too_many_is_told_so() {
    let quotas = Quotas {
        clients: 2,
        ..Quotas::default()
    };
    let daemon = Daemon::start(quotas);
    let (first, _second) = (daemon.store(), daemon.store());

    let message = refused(Store::options().socket(daemon.socket()).open());

    assert_eq!(
        message,
        "limit reached: clients of this daemon: 3 wanted, 2 allowed"
    );
    assert_serves(&first);
}

#[test]
fn bad_names_and_schemas_are_named() {
    let daemon = Daemon::start(small());
    let store = daemon.store();
    let mut talker = Talker::greeted(&daemon.socket());

    let long = refused(store.writer::<u64>(&"n".repeat(1000)));
    let reserved = refused(store.reader::<u64>("a?b"));
    let mut lie = open_writer(1, "n");
    if let Request::OpenWriter { schema, .. } = &mut lie {
        "schema nonsense".clone_into(schema);
    }
    let schema = talker.refusal(lie, &[]);
    let mut huge = open_writer(1, "n");
    if let Request::OpenWriter { schema, .. } = &mut huge {
        *schema = "x".repeat(40_000);
    }

    assert!(long.contains("is longer than 255"), "{long}");
    assert!(reserved.contains("'?'"), "{reserved}");
    assert!(schema.contains("line 1"), "{schema}");
    assert!(talker.refusal(huge, &[]).contains("longer than 32768"));
    assert_serves(&store);
}

#[test]
fn segments_that_are_not_as_they_must_be_are_refused() {
    let daemon = Daemon::start(small());
    let mut talker = Talker::greeted(&daemon.socket());
    talker.ask(open_writer(1, "n"), &[]);
    let file = rustix::fs::memfd_create("plain", rustix::fs::MemfdFlags::ALLOW_SEALING).unwrap();
    rustix::fs::ftruncate(&file, 1 << 20).unwrap();
    let commit = || Request::Commit { handle: 1 };

    let none = talker.refusal(commit(), &[]);
    let unsealed = talker.refusal(commit(), &[&file, &file]);
    let stranger = talker.refusal(Request::Commit { handle: 9 }, &[&file, &file]);

    assert_eq!(none, "segment refused: two descriptors expected");
    assert!(unsealed.contains("not sealed"), "{unsealed}");
    assert!(stranger.contains("handle 9 is no writer"), "{stranger}");
    assert_eq!(daemon.handle().counters().unwrap().bad_segments, 2);
    assert_serves(&daemon.store());
}

/// Opens a reader by hand, and writes all over its item's `ctl` as long as `go` says.
fn scribble(path: &Path, name: &str, mut go: impl FnMut() -> bool) {
    let mut talker = Talker::greeted(path);
    let (reply, fds) = talker.ask(open_reader(1, name), &[]);
    let Reply::Reader {
        binding: Some(Binding { .. }),
        ..
    } = reply
    else {
        panic!("{reply:?}");
    };
    let ctl = fds.get(1).unwrap();
    let size = usize::try_from(rustix::fs::fstat(ctl).unwrap().st_size).unwrap();
    let mut fill = 0_u8;
    while go() {
        fill = fill.wrapping_add(37);
        // The state words stay: a lie there only makes readers look at their sockets.
        rustix::io::pwrite(ctl, &vec![fill; size - 128], 128).unwrap();
    }
}

#[test]
fn a_scribbling_reader_cannot_stop_the_writer_or_other_items() {
    let daemon = Daemon::start(Quotas::default());
    let store = daemon.store();
    let mut spoilt = store.writer::<[u64; 64]>("spoilt").unwrap();
    let mut good = store.writer::<u64>("good").unwrap();
    let mut good_reader = store.reader::<u64>("good").unwrap();
    let mut co_reader = store.reader::<[u64; 64]>("spoilt").unwrap();
    let mut rounds = 0;

    scribble(&daemon.socket(), "spoilt", || {
        rounds += 1;
        for value in 0..50 {
            spoilt.write(&[rounds * 100 + value; 64]).unwrap();
            good.write(&(rounds * 100 + value)).unwrap();
            assert_eq!(
                good_reader.next(LONG).unwrap().unwrap().value,
                rounds * 100 + value
            );
            if let Some(sample) = co_reader.current().unwrap() {
                assert!(sample.value.iter().all(|v| *v == sample.value[0]), "torn");
            }
        }
        rounds < 200
    });

    assert_serves(&store);
}

#[test]
fn a_reader_that_never_releases_costs_the_others_nothing() {
    let daemon = Daemon::start(Quotas::default());
    let store = daemon.store();
    let options = WriterOptions {
        depth: 2,
        max_readers: 2,
        pins: 0,
        ..WriterOptions::default()
    };
    let mut writer = store.writer_with::<u64>("n", options).unwrap();
    let mut keeper = store.reader::<u64>("n").unwrap();
    let mut reader = store.reader::<u64>("n").unwrap();
    writer.write(&1).unwrap();
    let first = keeper.current_pinned().unwrap().unwrap();
    writer.write(&2).unwrap();
    let second = keeper.current_pinned().unwrap().unwrap();

    for value in 3..10_000 {
        writer.write(&value).unwrap();
        assert_eq!(reader.current().unwrap().unwrap().value, value);
    }

    assert!(first.is_intact() && second.is_intact());
    assert_eq!((*first, *second), (1, 2));
}

#[test]
fn thirty_two_readers_get_every_sample() {
    let daemon = Daemon::start(Quotas::default());
    let store = daemon.store();
    let options = WriterOptions {
        depth: 1024,
        ..WriterOptions::default()
    };
    let mut writer = store.writer_with::<u64>("n", options).unwrap();
    writer.write(&0).unwrap();
    let readers: Vec<_> = (0..32)
        .map(|_| {
            let mut reader = store.reader::<u64>("n").unwrap();
            assert_eq!(reader.next(NONE).unwrap().unwrap().value, 0);
            std::thread::spawn(move || {
                for expected in 1..=1000 {
                    let sample = reader.next(LONG).unwrap().expect("a sample");
                    assert_eq!(sample.value, expected);
                }
                reader.missed().total()
            })
        })
        .collect();

    for value in 1..=1000 {
        writer.write(&value).unwrap();
        if value % 100 == 0 {
            std::thread::sleep(Duration::from_millis(1));
        }
    }

    for reader in readers {
        assert_eq!(reader.join().unwrap(), 0);
    }
}
