//! Each reason has its sentence.

use ddx_store::{ItemEntry, ReaderEntry};
use ddx_wire::{Contract, Epoch, HostName, SchemaHash, Time};

use super::super::books::{Link, Rates, Row};
use super::*;

const NOW_NS: u64 = 10_000_000_000;

fn item(writer: WriterState) -> Description {
    let host = HostName::parse("robot1").unwrap();
    Description {
        entry: ItemEntry {
            name: ItemName::parse("robot1/gps/fix", &host).unwrap(),
            host,
            schema_name: "Fix".to_owned(),
            schema_hash: SchemaHash::default(),
            writer: Some(writer),
            program: "gpsd".to_owned(),
            pid: None,
            readers: 1,
            last_publish: Some(Time(NOW_NS - 2_000_000_000)),
            capacity_bytes: 64,
        },
        schema: String::new(),
        epoch: Epoch(1),
        published: 7,
        newest: None,
        depth: 8,
        readers: Vec::new(),
        note: String::new(),
    }
}

fn host(state: &str) -> state::Host {
    state::Host {
        host: "robot1".to_owned(),
        id: String::new(),
        state: state.to_owned(),
        addr: None,
        rtt_us: None,
        loss_percent: None,
        paths: Vec::new(),
        since: Some(NOW_NS - 4_000_000_000),
    }
}

fn ask(key: bool, hosts: &[state::Host], item: Option<&Description>) -> Verdict {
    let base = HostName::parse("base").unwrap();
    verdict(&Facts {
        name: &ItemName::parse("robot1/gps/fix", &base).unwrap(),
        local: false,
        item,
        key,
        hosts,
        others: &["robot1/gps/fox".to_owned()],
        now_ns: NOW_NS,
        read_elsewhere: false,
        foreign: 0,
    })
}

#[test]
fn each_reason_has_its_sentence() {
    let live = item(WriterState::Live);
    let mut silent = item(WriterState::Live);
    silent.published = 0;
    silent.entry.last_publish = None;
    silent.readers.push(ReaderEntry {
        program: "map".to_owned(),
        pid: 7,
        contract: Contract::default(),
        bound: true,
        refused: None,
        books: None,
    });
    let orphaned = item(WriterState::Orphaned);
    let mut unread = item(WriterState::Live);
    unread.entry.readers = 0;
    let mut refused = item(WriterState::Live);
    refused.readers.push(ReaderEntry {
        program: "map".to_owned(),
        pid: 7,
        contract: Contract::default(),
        bound: false,
        refused: Some("field `latitude` is f32, f64 expected".to_owned()),
        books: None,
    });
    let up = [host("up")];

    for (verdict, reason, sentence) in [
        (
            ask(false, &[], None),
            Reason::NoKey,
            "this host has no key, so that it does not see `robot1`",
        ),
        (
            ask(true, &[], None),
            Reason::NoSuchName,
            "no host `robot1` is known",
        ),
        (
            ask(true, &up, None),
            Reason::NoSuchName,
            "host `robot1` is up and has no item `robot1/gps/fix`",
        ),
        (
            ask(true, &[host("unreachable")], Some(&live)),
            Reason::HostUnreachable,
            "host `robot1` has been unreachable for 4.00 s",
        ),
        (
            ask(true, &[host("left")], Some(&live)),
            Reason::HostUnreachable,
            "host `robot1` left 4.00 s ago",
        ),
        (
            ask(true, &up, Some(&silent)),
            Reason::NothingWritten,
            "`gpsd` has opened `robot1/gps/fix` and written nothing yet",
        ),
        (
            ask(true, &up, Some(&orphaned)),
            Reason::NoWriter,
            "`robot1/gps/fix` has no writer: `gpsd` is gone, the last value 2.00 s ago",
        ),
        (
            ask(true, &up, Some(&refused)),
            Reason::SchemaMismatch,
            "`map` (pid 7) was refused: field `latitude` is f32, f64 expected",
        ),
        (
            ask(true, &up, Some(&unread)),
            Reason::ReaderGone,
            "nobody on this host reads `robot1/gps/fix`; `gpsd` writes it, the last value 2.00 s ago",
        ),
        (
            ask(true, &up, Some(&live)),
            Reason::Fine,
            "all is well with `robot1/gps/fix`: `gpsd` writes it, the last value 2.00 s ago; 1 read it here",
        ),
    ] {
        assert_eq!(verdict.reason, reason, "{sentence}");
        assert_eq!(verdict.sentence, sentence);
    }
}

#[test]
fn a_name_that_is_almost_right_is_guessed() {
    let verdict = ask(true, &[host("up")], None);

    assert_eq!(
        verdict.hint.as_deref(),
        Some("did you mean `robot1/gps/fox`?")
    );
}

/// What a second of looking on showed: rows with their rates.
fn look(own: bool, rows: &[(Row, Rates)], ways: &[state::Way]) -> Verdict {
    let base = HostName::parse("base").unwrap();
    let mut item = item(WriterState::Live);
    item.readers.push(ReaderEntry {
        program: "map".to_owned(),
        pid: 7,
        contract: Contract::default(),
        bound: true,
        refused: None,
        books: None,
    });
    let flow = Flow {
        name: &ItemName::parse("robot1/gps/fix", &base).unwrap(),
        item: &item,
        own,
        ways,
        rows: rows.iter().map(|(row, rates)| (row, *rates)).collect(),
        now_ns: NOW_NS,
    };
    flow.judge(Verdict::new(Reason::Fine, "all is well".to_owned()))
}

fn row(hop: &str, peer: &str, rates: Rates) -> (Row, Rates) {
    let row = Row {
        hop: hop.to_owned(),
        peers: vec![peer.to_owned()],
        contract: Some("newest".to_owned()),
        ..Row::default()
    };
    (row, rates)
}

#[test]
fn each_step_that_holds_samples_back_has_its_sentence() {
    let full = Rates {
        expected: 100.0,
        delivered: 100.0,
        bytes: 100_000.0,
        ..Rates::default()
    };
    let stream = row("store to stream", "", full);
    let mut old = row(
        "store to stream",
        "",
        Rates {
            delivered: 0.0,
            ..full
        },
    );
    old.0.fates.expired = 300;
    let mut slow = row(
        "store to link",
        "base",
        Rates {
            delivered: 20.0,
            queue_dropped: 80.0,
            bytes: 20_000.0,
            ..full
        },
    );
    slow.0.link = Some(Link {
        bytes_per_second: 21_000,
        ..Link::default()
    });
    let lossy = row(
        "link to mirror",
        "robot1",
        Rates {
            delivered: 75.0,
            lost: 25.0,
            ..full
        },
    );
    let arrives = row("link to mirror", "robot1", full);
    let lazy = Rates {
        delivered: 5.0,
        overwritten: 95.0,
        ..full
    };
    let lazy = row("mirror to reader", "map (7)", lazy);
    let stands = row("mirror to reader", "map (7)", Rates::default());
    let ways = [state::Way {
        peer: Some("base".to_owned()),
        via: "unicast".to_owned(),
        since: NOW_NS - 3_000_000_000,
        shuns: Some(state::Shuns {
            why: "loses".to_owned(),
            multicast_loss_percent: 60.0,
            unicast_loss_percent: 0.5,
        }),
        is_out: true,
        ..state::Way::default()
    }];
    for (verdict, reason, sentence) in [
        (
            look(false, std::slice::from_ref(&arrives), &[]),
            Reason::Fine,
            "all is well",
        ),
        (
            look(true, &[old], &ways),
            Reason::Contract,
            "the contract of `base` (newest) keeps back all of `robot1/gps/fix`: 100 samples a second were older than that when their turn came",
        ),
        (
            look(true, std::slice::from_ref(&stream), &ways),
            Reason::NoMulticast,
            "`robot1/gps/fix` goes to `base` by unicast for 3.00 s: multicast lost 60.0 % of datagrams, unicast 0.5 %",
        ),
        (
            look(true, &[stream, slow], &ways),
            Reason::SlowLink,
            "the link to `base` carries 21.0 kB/s, and `robot1/gps/fix` wants 100 kB/s (newest, normal priority): 80 of 100 samples a second are left out",
        ),
        (
            look(false, &[lossy], &[]),
            Reason::Loss,
            "25.0 % of `robot1/gps/fix` is lost on the way from `robot1`: 25 of 100 samples a second",
        ),
        (
            look(false, &[arrives.clone(), lazy], &[]),
            Reason::SlowReader,
            "map (7) reads `robot1/gps/fix` too slowly: 95 of 100 samples a second were overwritten in the ring of 8 before it read them",
        ),
        (
            look(false, &[arrives, stands], &[]),
            Reason::SlowReader,
            "map (7) has stopped reading `robot1/gps/fix`: 100 samples a second come, and the ring holds 8",
        ),
    ] {
        assert_eq!(
            (verdict.sentence.as_str(), verdict.reason),
            (sentence, reason)
        );
    }
}
