//! Floods: each queue stays within its budget and counts what it has no room for.

use ddx_wire::message::Lacks;
use ddx_wire::sample::{Place, Preamble, Record};

use super::*;

const BUDGET_BYTES: usize = 10_000;

/// Seals records as the sender does, each in a datagram of its own.
struct Peer {
    sealer: Sealer,
    number: u32,
}

impl Peer {
    fn datagram(&mut self, meta: SampleMeta, gone: Option<u64>) -> Vec<u8> {
        let payload = gone.map(|count| (count - 1).to_le_bytes());
        let record = Record {
            stream: STREAM,
            repeat: false,
            gone: gone.is_some(),
            meta,
            fragment: None,
            payload: payload.as_ref().map_or(&[][..], |bytes| bytes),
        };
        self.number += 1;
        let preamble = Preamble {
            path: 40,
            number: self.number,
            sent_us: 0,
            is_probe: false,
            is_limited: false,
        };
        let mut datagram = vec![0; HEADER_BYTES];
        datagram.extend_from_slice(&preamble.to_bytes());
        record.encode(Place::First, &mut datagram).unwrap();
        let sealed = self.sealer.seal(Lane::Values, STREAM, &mut datagram, 0);
        sealed.unwrap();
        datagram
    }
}

fn peer() -> Peer {
    Peer {
        sealer: data_sealer(),
        number: 0,
    }
}

/// A receiver with a small budget, of a stream of which each sample is wanted.
fn small_receiver() -> Receiver {
    let mut receiver = Receiver::new(ReceiverConfig {
        budget_bytes: BUDGET_BYTES,
        ..ReceiverConfig::new(READER, domain().id())
    });
    let opener = Opener::new(&domain(), HOST, LIFE, Purpose::Data);
    receiver.session(sender_tag(), opener);
    receiver.listen(sender_tag(), STREAM, &every(), Time(0));
    receiver
}

#[test]
fn empty_samples_that_wait_for_an_earlier_one_are_few() {
    let (mut receiver, mut peer) = (small_receiver(), peer());
    let mut most = 0;
    for seq in (1..2_000).filter(|seq| *seq != 2) {
        let datagram = peer.datagram(meta(1, seq), None);
        most = most.max(feed(&mut receiver, &[datagram], Time(0)).len());
    }
    // They all come at once when the wait is over.
    assert!((2..=BUDGET_BYTES / 100).contains(&most), "{most}");
    let books = receiver.books(sender_tag(), STREAM).unwrap();
    assert_eq!((books.delivered, books.link_lost), (1_998, 1), "{books:?}");
}

#[test]
fn news_of_samples_that_are_gone_are_few_and_the_others_are_counted() {
    let (mut receiver, mut peer) = (small_receiver(), peer());
    let first = peer.datagram(meta(1, 1), None);
    feed(&mut receiver, &[first], Time(0));
    for seq in 1..=2_000 {
        let datagram = peer.datagram(meta(1, 10 * seq), Some(1));
        feed(&mut receiver, &[datagram], Time(0));
    }
    let kept = 2_000 - receiver.counters().dropped_gone;
    let fit = u64::try_from(BUDGET_BYTES / 100).unwrap();
    assert!((10..=fit).contains(&kept), "{kept}");
    // What has room once more is noted.
    receiver.forget(sender_tag(), STREAM);
    receiver.listen(sender_tag(), STREAM, &every(), Time(0));
    for (seq, gone) in [(5, None), (8, Some(1)), (9, None), (6, Some(1)), (7, None)] {
        let datagram = peer.datagram(meta(1, seq), gone);
        feed(&mut receiver, &[datagram], Time(0));
    }
    let books = receiver.books(sender_tag(), STREAM).unwrap();
    assert_eq!((books.delivered, books.overwritten), (3, 2), "{books:?}");
    assert_eq!(receiver.counters().dropped_gone, 2_000 - kept);
}

#[test]
fn requests_that_nobody_collects_are_few_and_the_others_are_counted() {
    let (mut receiver, mut peer) = (small_receiver(), peer());
    let datagrams: Vec<_> = (0..70)
        .map(|n| peer.datagram(meta(1, 1 + 2 * n), None))
        .collect();
    feed(&mut receiver, &datagrams, Time(0));
    for ms in 1..6_000 {
        receiver.handle_timeout(Time(0) + ms * MS);
    }
    let dropped = receiver.counters().dropped_nacks;
    let events = std::iter::from_fn(|| receiver.poll_event());
    let nacks = events.filter(|event| matches!(event, ReceiverEvent::Nack(..)));
    assert_eq!(nacks.count(), 256);
    assert!(dropped > 0);
}

#[test]
fn requests_for_repair_are_few_and_the_others_are_counted() {
    let mut sender = sender(Via::Unicast, 1);
    let mut route = route(Via::Unicast, 1);
    route.contract = every();
    sender.update(STREAM, &route, Time(0));
    for first in 0..1_000 {
        let nack = NackEntry {
            stream: STREAM,
            epoch: Epoch(1),
            seq: Seq(1 + 2 * first),
            lacks: Lacks::Samples(1),
        };
        sender.handle_nack(READER, &nack, Time(0));
    }
    assert_eq!(sender.counters().dropped_requests, 1_000 - 256);
}

#[test]
fn news_of_samples_too_old_to_be_sent_are_few_and_the_others_are_counted() {
    let mut sender = sender(Via::Unicast, 1);
    let mut route = route(Via::Unicast, 1);
    route.contract = Contract {
        max_age_ms: Some(1),
        ..every()
    };
    sender.update(STREAM, &route, Time(0));
    let now = Time(0) + 1_000 * MS;
    let fresh = SampleMeta {
        capture: now,
        ..meta(1, 1)
    };
    sender.write(STREAM, &fresh, &vec![0; 10], now);
    for seq in 2..100_000 {
        sender.write(STREAM, &meta(1, seq), &vec![0; 10], now);
    }
    let dropped = sender.counters().dropped_records;
    let mut bytes = 0;
    let mut at = now;
    while let Some(next) = {
        bytes += drain(&mut sender)
            .iter()
            .map(|(_, d)| d.len())
            .sum::<usize>();
        sender.poll_timeout()
    } {
        if next.1 != TimerName::Pace {
            break;
        }
        at = at.max(next.0);
        sender.handle_timeout(at);
    }
    assert!(bytes <= 5 << 18, "{bytes} bytes waited");
    assert!(dropped > 10_000, "{dropped}");
}

#[test]
fn readers_of_a_stream_beyond_the_limit_are_counted() {
    let mut sender = sender(Via::Unicast, 1);
    sender.update(STREAM, &route(Via::Unicast, 1_030), Time(0));
    assert_eq!(sender.counters().refused_readers, 6);
}

#[test]
fn datagrams_of_a_group_are_as_long_as_each_member_gets() {
    let mut sender = sender(Via::Group(group()), 3);
    let mut now = Time(0);
    let mut number = 0;
    let mut tell = |sender: &mut Sender<Vec<u8>>, member: u16, longest: u16| {
        now = now + 100 * MS;
        number += 100;
        let report = ReportEntry {
            path: 4,
            highest: number,
            received: number,
            bytes: number * 1_000,
            delay_us: 500,
            at_us: number * 1_000,
            longest,
            share: 1_000,
        };
        sender.handle_report(reader(member, Via::Unicast).tag, &report, now);
        let path = sender.paths().find(|path| path.to == group()).unwrap();
        path.datagram_bytes
    };
    assert_eq!(tell(&mut sender, 0, 1_200), 1_200);
    assert_eq!(tell(&mut sender, 1, 1_200), 1_200);
    assert_eq!(tell(&mut sender, 0, 1_472), 1_200);
    assert_eq!(tell(&mut sender, 1, 1_472), 1_472);
    // Who comes now has got short ones only, and perhaps gets no others.
    assert_eq!(tell(&mut sender, 2, 600), 1_200);
    assert_eq!(tell(&mut sender, 1, 1_472), 1_200);
    assert_eq!(tell(&mut sender, 2, 1_472), 1_472);
}
