//! A sender and receivers over a virtual link: what must hold whatever the link does.

use std::collections::BTreeMap;

use ddx_wire::seal::{DomainKey, HEADER_BYTES, Lane, Opener, Purpose, Refused, Sealer};
use ddx_wire::{Delivery, HostId, Incarnation, Priority};
use proptest::prelude::*;

use super::*;

mod bounds;
mod counts;
mod every;
mod link;

const HOST: HostId = HostId([1; 16]);
const LIFE: Incarnation = Incarnation {
    ordinal: 1,
    random: 2,
};
const STREAM: StreamId = StreamId(7);
const READER: Tag = Tag(500);
const MS: Duration = Duration::from_millis(1);

fn domain() -> DomainKey {
    DomainKey::from_bytes([4; 32])
}

fn data_sealer() -> Sealer {
    Sealer::new(&domain(), HOST, LIFE, Purpose::Data)
}

fn sender_tag() -> Tag {
    Tag::of(HOST, LIFE)
}

fn address(port: u16) -> SocketAddr {
    SocketAddr::from(([10, 0, 0, 1], port))
}

fn group() -> SocketAddr {
    SocketAddr::from(([239, 1, 2, 3], 9))
}

fn reader(n: u16, via: Via) -> ReaderHost {
    ReaderHost {
        tag: Tag(READER.0 + u64::from(n)),
        addr: address(n),
        via,
    }
}

fn route(via: Via, readers: u16) -> Route {
    Route {
        contract: Contract::default(),
        readers: (0..readers).map(|n| reader(n, via)).collect(),
    }
}

fn every() -> Contract {
    Contract {
        delivery: Delivery::Every,
        ..Contract::default()
    }
}

fn sender(via: Via, readers: u16) -> Sender<Vec<u8>> {
    let mut sender = Sender::new(SenderConfig::default(), data_sealer(), Time(0));
    sender.open(STREAM, &route(via, readers), Time(0));
    while let Some(SenderEvent::Fetch(fetch)) = sender.poll_event() {
        sender.fetched(&fetch, None, Time(0));
    }
    sender
}

fn receiver() -> Receiver {
    let mut receiver = Receiver::new(ReceiverConfig::new(READER, domain().id()));
    let opener = Opener::new(&domain(), HOST, LIFE, Purpose::Data);
    receiver.session(sender_tag(), opener);
    receiver.listen(sender_tag(), STREAM, &Contract::default(), Time(0));
    receiver
}

fn meta(epoch: u64, seq: u64) -> SampleMeta {
    SampleMeta {
        epoch: Epoch(epoch),
        seq: Seq(seq),
        publish: Time(seq),
        ..SampleMeta::default()
    }
}

/// A payload that shows a torn or mixed-up sample.
fn payload(epoch: u64, seq: u64, len: usize) -> Vec<u8> {
    let mark = u8::try_from((epoch * 31 + seq) % 251).unwrap();
    vec![mark; len]
}

/// Everything the sender has to send, as (destination, datagram).
fn drain(sender: &mut Sender<Vec<u8>>) -> Vec<(SocketAddr, Vec<u8>)> {
    let mut buffer = Vec::new();
    let mut datagrams = Vec::new();
    while let Some(transmit) = sender.poll_transmit(&mut buffer) {
        let segment = transmit.segment.map_or(buffer.len(), usize::from);
        let chunks = buffer.chunks(segment);
        datagrams.extend(chunks.map(|chunk| (transmit.to, chunk.to_vec())));
    }
    datagrams
}

fn write(sender: &mut Sender<Vec<u8>>, seq: u64, len: usize, now: Time) -> Vec<Vec<u8>> {
    let payload = payload(1, seq, len);
    sender.write(STREAM, &meta(1, seq), &payload, now);
    sender.flush(now);
    let mut datagrams = drain(sender);
    while let Some((at, TimerName::Pace)) = sender.poll_timeout() {
        sender.handle_timeout(at);
        datagrams.extend(drain(sender));
    }
    let bytes = datagrams.into_iter().map(|(_, bytes)| bytes);
    // The link of these tests is one for short datagrams.
    bytes.filter(|datagram| datagram.len() <= 1_200).collect()
}

fn feed(receiver: &mut Receiver, datagrams: &[Vec<u8>], now: Time) -> Vec<(Epoch, Seq, usize)> {
    let mut got = Vec::new();
    for datagram in datagrams {
        receiver.handle_datagram(&mut datagram.clone(), false, now);
        while let Some(sample) = receiver.poll_sample() {
            got.push((sample.meta.epoch, sample.meta.seq, sample.payload.len()));
        }
    }
    got
}

#[test]
fn a_full_path_says_so_and_asks_for_the_next_once_it_has_room() {
    let mut sender = sender(Via::Unicast, 1);
    let now = Time(0) + Duration::from_secs(1);
    let offered = (1..10_000).find(|seq| {
        let payload = payload(1, *seq, 64);
        !sender.write(STREAM, &meta(1, *seq), &payload, now)
    });
    // 4 ms of a path's rate are less than 10,000 samples.
    let refused = offered.unwrap();
    sender.flush(now);
    drain(&mut sender);
    sender.handle_timeout(now + 5 * MS);
    drain(&mut sender);
    let wanted = Fetch {
        stream: STREAM,
        to: address(0),
        want: Want::After(Epoch(1), Seq(refused - 1)),
        again: false,
    };
    assert_eq!(sender.poll_event(), Some(SenderEvent::Fetch(wanted)));
    let found = (meta(1, refused), payload(1, refused, 64));
    sender.fetched(&wanted, Some((&found.0, &found.1)), now + 5 * MS);
    // What the driver passed over meanwhile this way left out, and not the source for all.
    let next = payload(1, refused + 9, 64);
    assert!(sender.write(STREAM, &meta(1, refused + 9), &next, now + 5 * MS));
    let (_, source) = sender.source_books().next().unwrap();
    assert_eq!(
        (source.expected, source.delivered),
        (refused + 9, refused + 9)
    );
    let (_, _, sent) = sender.sent_books().next().unwrap();
    assert_eq!((sent.delivered, sent.queue_dropped), (refused + 1, 8));
}

#[test]
fn what_one_path_fetches_before_it_was_offered_the_others_ask_for() {
    let mut sender = sender(Via::Group(group()), 1);
    write(&mut sender, 1, 10, Time(0));
    sender.update(STREAM, &route(Via::Group(group()), 2), Time(0));
    let Some(SenderEvent::Fetch(fetch)) = sender.poll_event() else {
        panic!("the new reader gets nothing");
    };
    assert_eq!((fetch.to, fetch.want), (address(1), Want::Newest));
    sender.fetched(&fetch, Some((&meta(1, 3), &b"x".to_vec())), Time(0));
    let wanted = Fetch {
        stream: STREAM,
        to: group(),
        want: Want::After(Epoch(1), Seq(1)),
        again: false,
    };
    assert_eq!(sender.poll_event(), Some(SenderEvent::Fetch(wanted)));
}

#[test]
fn samples_of_one_destination_share_a_datagram() {
    let mut sender = sender(Via::Unicast, 1);
    for seq in 1..=32 {
        sender.write(STREAM, &meta(1, seq), &vec![0; 64], Time(0));
    }
    sender.flush(Time(0));
    let mut buffer = Vec::new();
    let transmit = sender.poll_transmit(&mut buffer).unwrap();
    // 16 records, the first of 71 bytes and the others of 68, fit 1,200 with the overhead of 52, so 32 are two datagrams in one
    // batch, of which the first is padded.
    assert_eq!(transmit.segment, Some(1_200));
    assert_eq!(buffer.len(), 1_200 + 52 + 71 + 15 * 68);
    assert_eq!(sender.poll_transmit(&mut buffer), None);
    assert_eq!(sender.counters().datagrams, 2);
}

#[test]
fn what_waits_for_company_while_the_rate_holds_it_back_is_woken_for() {
    let mut sender = sender(Via::Unicast, 1);
    let held_back = (1..100).find(|seq| {
        sender.write(STREAM, &meta(1, *seq), &vec![0; 800], Time(0));
        sender.flush(Time(0));
        drain(&mut sender).is_empty()
    });
    let (at, why) = sender.poll_timeout().unwrap();
    assert_eq!(why, TimerName::Pace, "{held_back:?}");
    sender.handle_timeout(at);
    assert_eq!(drain(&mut sender).len(), 1);
}

#[test]
fn repeat_is_confirmed_at_once_even_when_held_already() {
    let mut sender = sender(Via::Unicast, 1);
    let mut receiver = receiver();
    let datagrams = write(&mut sender, 1, 10, Time(0));
    feed(&mut receiver, &datagrams, Time(0));
    assert_eq!(receiver.poll_event(), None);
    let later = Time(0) + 300 * MS;
    sender.handle_timeout(later);
    let Some(SenderEvent::Fetch(fetch)) = sender.poll_event() else {
        panic!("an unconfirmed value is not repeated");
    };
    assert_eq!((fetch.want, fetch.again), (Want::Newest, true));
    sender.fetched(&fetch, Some((&meta(1, 1), &payload(1, 1, 10))), later);
    sender.flush(later);
    let repeats: Vec<_> = drain(&mut sender).into_iter().map(|(_, d)| d).collect();
    assert!(feed(&mut receiver, &repeats, later).is_empty());
    let quiet = ReceiverEvent::Quiet {
        tag: sender_tag(),
        stream: STREAM,
        epoch: Epoch(1),
        seq: Seq(1),
    };
    assert_eq!(receiver.poll_event(), Some(quiet));
    assert_eq!(receiver.poll_event(), None);
}

#[test]
fn new_reader_is_sent_the_present_value_once() {
    let mut sender = sender(Via::Group(group()), 1);
    sender.update(STREAM, &route(Via::Group(group()), 2), Time(0));
    let Some(SenderEvent::Fetch(fetch)) = sender.poll_event() else {
        panic!("the new reader gets nothing");
    };
    assert_eq!((fetch.to, fetch.want), (address(1), Want::Newest));
    sender.fetched(&fetch, Some((&meta(1, 9), &b"x".to_vec())), Time(0));
    assert_eq!(sender.poll_event(), None);
    sender.flush(Time(0));
    let destinations: Vec<_> = drain(&mut sender).into_iter().map(|(to, _)| to).collect();
    assert_eq!(destinations, [address(1)]);
}

#[test]
fn unconfirmed_value_is_repeated_fifteen_times_then_at_each_renewal() {
    let mut sender = sender(Via::Unicast, 1);
    write(&mut sender, 1, 10, Time(0));
    let mut asked = Vec::new();
    while let Some((at, _)) = sender.poll_timeout() {
        sender.handle_timeout(at);
        while let Some(SenderEvent::Fetch(_)) = sender.poll_event() {
            asked.push(at);
        }
    }
    let first = Time(0) + 180 * MS;
    let expected: Vec<_> = (0..15).map(|n| first + 60 * MS * n).collect();
    assert_eq!(asked, expected);
    let later = Time(0) + 2_000 * MS;
    sender.held(STREAM, READER, Epoch(0), Seq(0), later);
    assert!(sender.poll_event().is_some());
    sender.held(STREAM, READER, Epoch(1), Seq(1), later + 500 * MS);
    sender.held(STREAM, READER, Epoch(0), Seq(0), later + 1_000 * MS);
    assert_eq!(sender.poll_event(), None);
}

#[test]
fn a_sample_over_the_limit_is_counted_and_a_large_one_leaves_at_the_rate() {
    let mut sender = sender(Via::Unicast, 1);
    sender.write(STREAM, &meta(1, 1), &vec![0; (64 << 20) + 1], Time(0));
    assert_eq!(sender.stream_counters(STREAM).unwrap().too_large, 1);
    let mut receiver = receiver();
    sender.write(STREAM, &meta(1, 2), &payload(1, 2, 1 << 20), Time(0));
    let (mut now, mut got, mut bytes) = (Time(0), Vec::new(), 0);
    while got.is_empty() {
        for (_, datagram) in drain(&mut sender) {
            bytes += datagram.len();
            if datagram.len() <= 1_200 {
                got.extend(feed(&mut receiver, &[datagram], now));
            }
        }
        if got.is_empty() {
            now = sender.poll_timeout().unwrap().0.max(now);
            sender.handle_timeout(now);
        }
    }
    assert_eq!(got, [(Epoch(1), Seq(2), 1 << 20)]);
    // 12.5 MB/s until more is known.
    let took = now.since(Time(0)).as_secs_f64();
    let expected = bytes as f64 / 12.5e6;
    assert!(
        (0.95..1.05).contains(&(took / expected)),
        "{took} {expected}"
    );
}

#[test]
fn repairs_and_commands_leave_before_values_and_values_before_bulk() {
    let mut sender = sender(Via::Unicast, 1);
    let command = StreamId(STREAM.0 + 1);
    let mut urgent = route(Via::Unicast, 1);
    urgent.contract.priority = Priority::Command;
    sender.open(command, &urgent, Time(0));
    for (stream, seq, len) in [(STREAM, 1, 5_000), (STREAM, 2, 10), (command, 1, 10)] {
        sender.write(stream, &meta(1, seq), &vec![0; len], Time(0));
    }
    sender.flush(Time(0));
    let mut lanes = Vec::new();
    while lanes.len() < 4 {
        lanes.extend(
            drain(&mut sender)
                .iter()
                .filter(|(_, d)| d.len() <= 1_200)
                .map(|(_, d)| d[1]),
        );
        let now = sender.poll_timeout().unwrap().0;
        sender.handle_timeout(now);
    }
    let [commands, values, bulk] = [Lane::Commands, Lane::Values, Lane::Bulk].map(Lane::to_byte);
    let first = lanes.iter().position(|lane| *lane == commands).unwrap();
    let value = lanes.iter().position(|lane| *lane == values).unwrap();
    assert!(
        first < value && lanes[value + 1..].contains(&bulk),
        "{lanes:?}"
    );
}

#[test]
fn a_command_waits_for_no_bulk_and_many_of_them_wait_for_the_rate() {
    let mut sender = sender(Via::Unicast, 1);
    let command = StreamId(STREAM.0 + 1);
    let mut urgent = route(Via::Unicast, 1);
    urgent.contract.priority = Priority::Command;
    sender.open(command, &urgent, Time(0));
    sender.write(STREAM, &meta(1, 1), &vec![0; 1 << 20], Time(0));
    sender.flush(Time(0));
    drain(&mut sender);
    assert!(drain(&mut sender).is_empty(), "the rate forbids more bulk");
    let mut left = 0;
    for seq in 1..=20 {
        sender.write(command, &meta(1, seq), &vec![0; 1_000], Time(0));
        sender.flush(Time(0));
        let sent = drain(&mut sender);
        assert!(seq > 1 || sent.len() == 1, "the first leaves at once");
        left += sent.len();
    }
    // 200 us of 12.5 MB/s are two of them, and one more batch may be ahead.
    assert!((3..=6).contains(&left), "{left}");
}

#[test]
fn a_full_path_takes_the_newest_when_it_has_room() {
    let mut sender = sender(Via::Unicast, 1);
    // More than waits for a path of 12.5 MB/s: what does not fit stays in the store.
    for seq in 1..=100 {
        sender.write(STREAM, &meta(1, seq), &vec![0; 1_000], Time(0));
    }
    let counters = sender.stream_counters(STREAM).unwrap();
    assert!(counters.deferred > 0, "{counters:?}");
    let mut now = Time(0);
    let mut fetched = Vec::new();
    while fetched.is_empty() && now < Time(0) + 100 * MS {
        sender.flush(now);
        drain(&mut sender);
        while let Some(SenderEvent::Fetch(fetch)) = sender.poll_event() {
            fetched.push(fetch.want);
            sender.fetched(&fetch, Some((&meta(1, 100), &vec![0; 1_000])), now);
        }
        if let Some((at, _)) = sender.poll_timeout() {
            now = at.max(now);
        }
        sender.handle_timeout(now);
    }
    // A burst goes out in order as long as the ring has it.
    assert!(
        matches!(fetched.as_slice(), [Want::After(_, Seq(40..60))]),
        "{fetched:?}"
    );
}

#[test]
fn each_of_many_streams_that_wait_for_a_full_path_gets_its_newest_sample_through() {
    let mut sender = sender(Via::Unicast, 1);
    let streams = (STREAM.0..STREAM.0 + 10).map(StreamId);
    for stream in streams.clone() {
        sender.open(stream, &route(Via::Unicast, 1), Time(0));
    }
    // Nothing is reported, so that the rate falls below what is written; then nothing is written any more.
    let mut sent = BTreeMap::new();
    let mut now = Time(0);
    for seq in 1..=3_000 {
        now = now + MS;
        for stream in streams.clone() {
            if sender.write(stream, &meta(1, seq), &vec![0; 64], now) {
                sent.insert(stream, seq);
            }
            // Whoever confirms all that came does not cause a repeat.
            sender.held(stream, READER, Epoch(1), Seq(seq), now);
        }
        let end = if seq < 3_000 { now } else { now + 1_000 * MS };
        loop {
            while let Some(SenderEvent::Fetch(fetch)) = sender.poll_event() {
                let found = match fetch.want {
                    Want::After(_, Seq(last)) => seq.min(last.max(seq - 8) + 1),
                    Want::Newest | Want::At(..) => seq,
                };
                sent.insert(fetch.stream, found);
                sender.fetched(&fetch, Some((&meta(1, found), &vec![0; 64])), now);
            }
            sender.flush(now);
            if drain(&mut sender).is_empty() {
                let next = sender.poll_timeout().filter(|(at, _)| *at <= end);
                let Some((at, _)) = next else { break };
                now = at.max(now);
                sender.handle_timeout(now);
            }
        }
    }
    assert_eq!(sent, streams.map(|stream| (stream, 3_000)).collect());
}

#[test]
fn what_is_too_old_is_not_sent() {
    let mut sender = Sender::new(SenderConfig::default(), data_sealer(), Time(0));
    let mut route = route(Via::Unicast, 1);
    route.contract.max_age_ms = Some(10);
    sender.open(STREAM, &route, Time(0));
    let fresh = SampleMeta {
        capture: Time(0) + 100 * MS,
        ..meta(1, 1)
    };
    sender.write(STREAM, &fresh, &vec![0; 8], Time(0) + 105 * MS);
    let stale = SampleMeta {
        seq: Seq(2),
        ..fresh
    };
    sender.write(STREAM, &stale, &vec![0; 8], Time(0) + 111 * MS);
    let counters = sender.stream_counters(STREAM).unwrap();
    assert_eq!((counters.sent, counters.expired), (1, 1));
}

#[test]
fn two_readers_of_unlike_paths_do_not_disturb_one_another() {
    // One path is cut: nothing of it is ever reported. The other gets each sample all the same.
    let mut sender = sender(Via::Unicast, 2);
    let mut now = Time(0);
    let mut sent = [0; 2];
    let mut report = ReportEntry {
        path: 32,
        highest: 0,
        received: 0,
        bytes: 0,
        delay_us: 0,
        at_us: 0,
        longest: 1_200,
        share: 1_000,
    };
    for seq in 1..=2_000 {
        now = now + 5 * MS;
        sender.handle_timeout(now);
        sender.write(STREAM, &meta(1, seq), &vec![0; 1_000], now);
        sender.flush(now);
        while let Some(SenderEvent::Fetch(fetch)) = sender.poll_event() {
            sender.fetched(&fetch, Some((&meta(1, seq), &vec![0; 1_000])), now);
        }
        for (to, datagram) in drain(&mut sender) {
            let at = usize::from(to == address(1));
            sent[at] += 1;
            if at == 0 {
                report.highest += 1;
                report.received += 1;
                report.bytes += u32::try_from(datagram.len()).unwrap();
                report.at_us = u32::try_from(now.0 / 1_000).unwrap();
            }
        }
        if seq % 20 == 0 {
            sender.handle_report(READER, &report, now);
        }
    }
    assert!(sent[0] >= 2_000, "{sent:?}");
    let silent = sender.paths().find(|path| path.to == address(1)).unwrap();
    assert!(silent.bytes_per_second <= 60_000, "{silent:?}");
}

#[test]
fn a_member_behind_a_slower_link_does_not_slow_its_group_down() {
    // What the second member tells: a queue that grows and loss; alone, and beside one that is well.
    let rate_with = |others: &[u16]| {
        let mut sender = sender(Via::Group(group()), 2);
        let mut now = Time(0);
        let mut numbers = 0;
        for round in 1..=20_u32 {
            now = now + 50 * MS;
            sender.write(STREAM, &meta(1, u64::from(round)), &vec![0; 8], now);
            drain(&mut sender);
            numbers += 10;
            let well = ReportEntry {
                path: 4,
                highest: numbers,
                received: numbers,
                bytes: numbers * 1_000,
                delay_us: 500,
                at_us: round * 50_000,
                longest: 1_200,
                share: 1_000,
            };
            let badly = ReportEntry {
                received: numbers / 2,
                bytes: numbers * 500,
                delay_us: 500 + round.min(10) * 10_000,
                ..well
            };
            for &other in others {
                sender.handle_report(reader(other, Via::Unicast).tag, &well, now);
            }
            sender.handle_report(reader(1, Via::Unicast).tag, &badly, now);
        }
        let path = sender.paths().find(|path| path.to == group()).unwrap();
        path.bytes_per_second
    };
    assert!(rate_with(&[]) < 1_000_000, "{}", rate_with(&[]));
    assert!(rate_with(&[0]) >= 12_500_000, "{}", rate_with(&[0]));
}

#[test]
fn every_sample_that_the_ring_holds_arrives_in_order() {
    let mut sender = Sender::new(SenderConfig::default(), data_sealer(), Time(0));
    let mut route = route(Via::Unicast, 1);
    route.contract = every();
    sender.open(STREAM, &route, Time(0));
    let mut receiver = receiver();
    receiver.forget(sender_tag(), STREAM);
    receiver.listen(sender_tag(), STREAM, &every(), Time(0));
    while let Some(SenderEvent::Fetch(fetch)) = sender.poll_event() {
        sender.fetched(&fetch, None, Time(0));
    }
    let (mut now, mut got, mut count) = (Time(0), Vec::new(), 0);
    let ring = 1..=40_u64;
    let mut written = 0;
    while now < Time(0) + 3_000 * MS {
        now = now + MS;
        sender.handle_timeout(now);
        receiver.handle_timeout(now);
        if written < 40 {
            written += 1;
            let len = if written % 7 == 0 { 4_000 } else { 100 };
            sender.write(STREAM, &meta(1, written), &payload(1, written, len), now);
        }
        sender.flush(now);
        while let Some(SenderEvent::Fetch(fetch)) = sender.poll_event() {
            // Samples 10 to 12 have left the ring.
            let from = match fetch.want {
                Want::Newest => written,
                Want::After(_, seq) => seq.0 + 1,
                Want::At(_, seq) => seq.0,
            };
            let from = if (10..=12).contains(&from) { 13 } else { from };
            let len = if from % 7 == 0 { 4_000 } else { 100 };
            let found = (meta(1, from), payload(1, from, len));
            let found = ring.contains(&from).then_some((&found.0, &found.1));
            sender.fetched(&fetch, found, now);
        }
        for (_, mut datagram) in drain(&mut sender) {
            count += 1;
            // Every third is lost, and all of the three that leave the ring are.
            if datagram.len() <= 1_200 && count % 3 != 0 && !(10..=12).contains(&written) {
                receiver.handle_datagram(&mut datagram, false, now);
            }
        }
        while let Some(sample) = receiver.poll_sample() {
            got.push(sample.meta.seq.0);
        }
        while let Some(event) = receiver.poll_event() {
            match event {
                ReceiverEvent::Nack(_, nack) => sender.handle_nack(READER, &nack, now),
                ReceiverEvent::Quiet { epoch, seq, .. }
                | ReceiverEvent::Flows { epoch, seq, .. } => {
                    sender.held(STREAM, READER, epoch, seq, now);
                }
                ReceiverEvent::OnGroup { .. } | ReceiverEvent::Report(..) => {}
            }
        }
    }
    let first = got[0];
    let expected: Vec<u64> = (first..=40)
        .filter(|seq| !(10..=12).contains(seq))
        .collect();
    assert_eq!(got, expected);
    let books = receiver.books(sender_tag(), STREAM).unwrap();
    assert_eq!((books.overwritten, books.link_lost), (3, 0), "{books:?}");
    assert!(books.balanced());
}

#[test]
fn each_path_sends_its_copies() {
    for (via, expected) in [
        (Via::Unicast, vec![address(0), address(1)]),
        (Via::Group(group()), vec![group()]),
        (Via::Both(group()), vec![address(0), address(1), group()]),
    ] {
        let mut sender = sender(via, 2);
        sender.write(STREAM, &meta(1, 1), &b"x".to_vec(), Time(0));
        sender.flush(Time(0));
        let to: Vec<_> = drain(&mut sender).into_iter().map(|(to, _)| to).collect();
        assert_eq!(to, expected);
    }
}

#[test]
fn second_copy_is_dropped_and_counted() {
    let mut sender = sender(Via::Both(group()), 1);
    let mut receiver = receiver();
    for len in [10, 5_000] {
        let datagrams = write(&mut sender, len as u64, len, Time(0));
        assert_eq!(feed(&mut receiver, &datagrams, Time(0)).len(), 1);
    }
    let books = receiver.books(sender_tag(), STREAM).unwrap();
    assert_eq!(books.delivered, 2);
    assert!(books.duplicates > 0);
    assert!(books.balanced());
}

#[test]
fn streams_that_share_a_datagram_all_arrive() {
    let mut sender = sender(Via::Unicast, 1);
    let mut receiver = receiver();
    let other = StreamId(STREAM.0 + 1);
    let route = route(Via::Unicast, 1);
    sender.open(other, &route, Time(0));
    receiver.listen(sender_tag(), other, &Contract::default(), Time(0));
    for stream in [STREAM, other] {
        let payload = payload(1, 1, 10);
        sender.write(stream, &meta(1, 1), &payload, Time(0));
    }
    // The values that the new stream's readers were to be sent are on their way.
    assert_eq!(sender.poll_event(), None);
    sender.flush(Time(0));
    let datagrams: Vec<_> = drain(&mut sender).into_iter().map(|(_, d)| d).collect();
    assert_eq!(datagrams.len(), 1);
    assert_eq!(feed(&mut receiver, &datagrams, Time(0)).len(), 2);
}

#[test]
fn sample_written_twice_is_sent_once() {
    let mut sender = sender(Via::Unicast, 1);
    assert_eq!(write(&mut sender, 2, 10, Time(0)).len(), 1);
    for seq in [2, 1] {
        assert_eq!(write(&mut sender, seq, 10, Time(0)).len(), 0);
    }
}

#[test]
fn what_is_held_of_a_stream_that_is_never_quiet_is_told_twice_a_second() {
    let mut sender = sender(Via::Unicast, 1);
    let mut receiver = receiver();
    let mut told = Vec::new();
    for seq in 1..=200 {
        let now = Time(0) + 10 * MS * u32::try_from(seq).unwrap();
        let datagrams = write(&mut sender, seq, 10, now);
        feed(&mut receiver, &datagrams, now);
        receiver.handle_timeout(now);
        told.extend(std::iter::from_fn(|| receiver.poll_event()));
    }
    told.retain(|event| !matches!(event, ReceiverEvent::Report(..)));
    let flows = |event: &ReceiverEvent| matches!(event, ReceiverEvent::Flows { .. });
    assert!(told.iter().all(flows), "{told:?}");
    assert!((3..=4).contains(&told.len()), "{told:?}");
}

#[test]
fn contract_is_kept_at_the_source() {
    let mut sender = Sender::new(SenderConfig::default(), data_sealer(), Time(0));
    let mut route = route(Via::Unicast, 1);
    route.contract = Contract::at_most_hz(10.0).unwrap();
    sender.open(STREAM, &route, Time(0));
    let mut sent = 0;
    for seq in 1..=1_000 {
        let now = Time(0) + MS * u32::try_from(seq).unwrap();
        if sender.due(STREAM, now) == Due::Now {
            sender.write(STREAM, &meta(1, seq), &b"x".to_vec(), now);
            sent += 1;
        }
    }
    // The first at once, then ten a second.
    assert_eq!(sent, 11);
    assert!(matches!(sender.due(STREAM, Time(0)), Due::At(_)));
}

#[test]
fn only_the_senders_datagrams_are_opened() {
    let mut sender = sender(Via::Unicast, 1);
    let datagram = write(&mut sender, 1, 10, Time(0)).remove(0);
    let reason = |config: ReceiverConfig, session: bool, expect: bool| {
        let mut receiver = Receiver::new(config);
        if session {
            let opener = Opener::new(&domain(), HOST, LIFE, Purpose::Data);
            receiver.session(sender_tag(), opener);
        }
        if expect {
            receiver.listen(sender_tag(), STREAM, &Contract::default(), Time(0));
        }
        receiver.handle_datagram(&mut datagram.clone(), false, Time(0));
        let refused = receiver.counters().refused;
        refused
            .iter()
            .find(|(_, n)| *n > 0)
            .map(|(reason, _)| reason)
    };
    let good = ReceiverConfig::new(READER, domain().id());
    let other = DomainKey::from_bytes([5; 32]).id();
    let own = ReceiverConfig::new(sender_tag(), domain().id());
    assert_eq!(reason(good.clone(), true, true), None);
    assert_eq!(reason(good.clone(), true, false), None);
    assert_eq!(reason(good, false, true), Some(Refused::UnknownSender));
    assert_eq!(
        reason(ReceiverConfig::new(READER, other), true, true),
        Some(Refused::Foreign)
    );
    assert_eq!(reason(own, true, true), Some(Refused::Own));
}

#[test]
fn a_value_that_overtakes_the_grant_is_delivered_with_it() {
    let mut sender = sender(Via::Unicast, 1);
    let mut datagram = write(&mut sender, 1, 10, Time(0)).remove(0);
    let mut receiver = Receiver::new(ReceiverConfig::new(READER, domain().id()));
    let opener = Opener::new(&domain(), HOST, LIFE, Purpose::Data);
    receiver.session(sender_tag(), opener);
    let mut by_group = datagram.clone();
    receiver.handle_datagram(&mut datagram, false, Time(0));
    assert_eq!(receiver.poll_sample(), None);
    receiver.listen(sender_tag(), STREAM, &Contract::default(), Time(0) + MS);
    assert_eq!(receiver.poll_sample().map(|s| s.meta.seq), Some(Seq(1)));
    assert_eq!(receiver.counters().unwanted_records, 0);
    // A group carries the streams of others: what nobody here reads is not even opened.
    receiver.forget(sender_tag(), STREAM);
    receiver.handle_datagram(&mut by_group, true, Time(0));
    let refused = receiver.counters().refused;
    assert!(refused.iter().any(|entry| entry == (Refused::Unwanted, 1)));
}

#[test]
fn malformed_records_are_counted() {
    let mut receiver = receiver();
    let mut sealer = data_sealer();
    for plaintext in [&b""[..], b"garbage", &[0xff; 100]] {
        let mut datagram = vec![0; HEADER_BYTES];
        datagram.extend_from_slice(plaintext);
        sealer.seal(Lane::Values, STREAM, &mut datagram, 0).unwrap();
        receiver.handle_datagram(&mut datagram, false, Time(0));
    }
    assert_eq!(receiver.counters().refused.of(Refused::Malformed), 3);
}

#[test]
fn tables_of_streams_are_bounded() {
    let config = ReceiverConfig {
        max_streams: 1,
        ..ReceiverConfig::new(READER, domain().id())
    };
    let mut receiver = Receiver::new(config);
    for stream in [1, 1, 2] {
        receiver.listen(Tag(1), StreamId(stream), &Contract::default(), Time(0));
    }
    assert_eq!(receiver.counters().refused_streams, 1);
    let config = SenderConfig {
        max_streams: 1,
        ..SenderConfig::default()
    };
    let mut sender = Sender::<Vec<u8>>::new(config, data_sealer(), Time(0));
    for stream in [1, 1, 2] {
        sender.open(StreamId(stream), &route(Via::Unicast, 1), Time(0));
    }
    assert_eq!(sender.counters().refused_streams, 1);
}
