//! A sender and receivers over a virtual link: what must hold whatever the link does.

use std::collections::BTreeMap;
use std::time::Duration;

use ddx_wire::seal::{DomainKey, HEADER_BYTES, Lane, Opener, Purpose, Refused, Sealer};
use ddx_wire::{HostId, Incarnation};
use proptest::prelude::*;

use super::*;

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

fn route(path: Path, readers: u16) -> Route {
    let reader = |n: u16| ReaderHost {
        tag: Tag(READER.0 + u64::from(n)),
        addr: address(n),
    };
    Route {
        contract: Contract::default(),
        readers: (0..readers).map(reader).collect(),
        path,
    }
}

fn sender(path: Path, readers: u16) -> Sender {
    let mut sender = Sender::new(SenderConfig::default(), data_sealer(), Time(0));
    sender.open(STREAM, route(path, readers), Time(0));
    while sender.poll_event().is_some() {}
    sender
}

fn receiver() -> Receiver {
    let mut receiver = Receiver::new(ReceiverConfig::new(READER, domain().id()));
    let opener = Opener::new(&domain(), HOST, LIFE, Purpose::Data);
    receiver.session(sender_tag(), opener);
    receiver.listen(sender_tag(), STREAM, Time(0));
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
fn drain(sender: &mut Sender) -> Vec<(SocketAddr, Vec<u8>)> {
    let mut buffer = Vec::new();
    let mut datagrams = Vec::new();
    while let Some(transmit) = sender.poll_transmit(&mut buffer) {
        let segment = transmit.segment.map_or(buffer.len(), usize::from);
        let chunks = buffer.chunks(segment);
        datagrams.extend(chunks.map(|chunk| (transmit.to, chunk.to_vec())));
    }
    datagrams
}

fn write(sender: &mut Sender, seq: u64, len: usize, now: Time) -> Vec<Vec<u8>> {
    let payload = payload(1, seq, len);
    sender.write(STREAM, &meta(1, seq), &payload, now);
    sender.flush(now);
    drain(sender).into_iter().map(|(_, bytes)| bytes).collect()
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
fn samples_of_one_destination_share_a_datagram() {
    let mut sender = sender(Path::Unicast, 1);
    for seq in 1..=30 {
        sender.write(STREAM, &meta(1, seq), &[0; 64], Time(0));
    }
    sender.flush(Time(0));
    let mut buffer = Vec::new();
    let transmit = sender.poll_transmit(&mut buffer).unwrap();
    // 10 records of 112 bytes fit 1,200 with the overhead of 40, so 30 are three equal datagrams in one batch.
    assert_eq!(transmit.segment, Some(1_160));
    assert_eq!(buffer.len(), 3 * 1_160);
    assert_eq!(sender.poll_transmit(&mut buffer), None);
    assert_eq!(sender.counters().datagrams, 3);
}

#[test]
fn batch_keeps_to_the_segments_that_the_socket_takes() {
    let config = SenderConfig {
        segments_max: 1,
        ..SenderConfig::default()
    };
    let mut sender = Sender::new(config, data_sealer(), Time(0));
    sender.open(STREAM, route(Path::Unicast, 1), Time(0));
    sender.write(STREAM, &meta(1, 1), &[0; 5_000], Time(0));
    let mut buffer = Vec::new();
    let mut transmits = 0;
    while let Some(transmit) = sender.poll_transmit(&mut buffer) {
        assert_eq!(transmit.segment, None);
        transmits += 1;
    }
    assert_eq!(transmits, 5);
}

#[test]
fn nothing_leaves_before_flush_or_the_coalescing_time() {
    let config = SenderConfig {
        coalesce: MS,
        ..SenderConfig::default()
    };
    let mut sender = Sender::new(config, data_sealer(), Time(0));
    sender.open(STREAM, route(Path::Unicast, 1), Time(0));
    sender.write(STREAM, &meta(1, 1), b"x", Time(5));
    assert!(drain(&mut sender).is_empty());
    let due = Time(5) + MS;
    assert_eq!(sender.poll_timeout(), Some((due, TimerName::Coalesce)));
    sender.handle_timeout(due);
    assert_eq!(drain(&mut sender).len(), 1);
}

#[test]
fn each_path_sends_its_copies() {
    for (path, expected) in [
        (Path::Unicast, vec![address(0), address(1)]),
        (Path::Multicast(group()), vec![group()]),
        (Path::Both(group()), vec![address(0), address(1), group()]),
    ] {
        let mut sender = sender(path, 2);
        sender.write(STREAM, &meta(1, 1), b"x", Time(0));
        sender.flush(Time(0));
        let to: Vec<_> = drain(&mut sender).into_iter().map(|(to, _)| to).collect();
        assert_eq!(to, expected);
    }
}

#[test]
fn second_copy_is_dropped_and_counted() {
    let mut sender = sender(Path::Both(group()), 1);
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
    let mut sender = sender(Path::Unicast, 1);
    let mut receiver = receiver();
    let other = StreamId(STREAM.0 + 1);
    let route = route(Path::Unicast, 1);
    sender.open(other, route, Time(0));
    receiver.listen(sender_tag(), other, Time(0));
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
    let mut sender = sender(Path::Unicast, 1);
    assert_eq!(write(&mut sender, 2, 10, Time(0)).len(), 1);
    for seq in [2, 1] {
        assert_eq!(write(&mut sender, seq, 10, Time(0)).len(), 0);
    }
}

#[test]
fn what_is_held_of_a_stream_that_is_never_quiet_is_told_twice_a_second() {
    let mut sender = sender(Path::Unicast, 1);
    let mut receiver = receiver();
    let mut told = Vec::new();
    for seq in 1..=200 {
        let now = Time(0) + 10 * MS * u32::try_from(seq).unwrap();
        let datagrams = write(&mut sender, seq, 10, now);
        feed(&mut receiver, &datagrams, now);
        receiver.handle_timeout(now);
        told.extend(std::iter::from_fn(|| receiver.poll_event()));
    }
    let flows = |event: &ReceiverEvent| matches!(event, ReceiverEvent::Flows { .. });
    assert!(told.iter().all(flows), "{told:?}");
    assert!((3..=4).contains(&told.len()), "{told:?}");
}

#[test]
fn repeat_is_confirmed_at_once_even_when_held_already() {
    let mut sender = sender(Path::Unicast, 1);
    let mut receiver = receiver();
    let datagrams = write(&mut sender, 1, 10, Time(0));
    feed(&mut receiver, &datagrams, Time(0));
    assert_eq!(receiver.poll_event(), None);
    sender.repeat(STREAM, READER, &meta(1, 1), &payload(1, 1, 10), Time(0));
    sender.flush(Time(0));
    let repeats: Vec<_> = drain(&mut sender).into_iter().map(|(_, d)| d).collect();
    assert!(feed(&mut receiver, &repeats, Time(0)).is_empty());
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
fn large_sample_is_fragmented_and_batched() {
    let mut sender = sender(Path::Unicast, 1);
    let mut receiver = receiver();
    let datagrams = write(&mut sender, 1, 65_536, Time(0));
    assert_eq!(datagrams.len(), 65_536_usize.div_ceil(1_104));
    assert!(datagrams.iter().all(|d| d.len() <= 1_200));
    let got = feed(&mut receiver, &datagrams, Time(0));
    assert_eq!(got, [(Epoch(1), Seq(1), 65_536)]);
    sender.write(STREAM, &meta(1, 2), &[0; 65_537], Time(0));
    sender.flush(Time(0));
    assert!(drain(&mut sender).is_empty());
    assert_eq!(sender.stream_counters(STREAM).unwrap().too_large, 1);
}

#[test]
fn repairs_leave_before_values_and_values_before_bulk() {
    let mut sender = sender(Path::Unicast, 1);
    for (seq, len) in [(1, 5_000), (2, 10)] {
        sender.write(STREAM, &meta(1, seq), &vec![0; len], Time(0));
    }
    sender.repeat(STREAM, READER, &meta(1, 2), b"x", Time(0));
    sender.flush(Time(0));
    let lanes: Vec<_> = drain(&mut sender).iter().map(|(_, d)| d[1]).collect();
    let [commands, values, bulk] = [Lane::Commands, Lane::Values, Lane::Bulk].map(Lane::to_byte);
    assert_eq!(lanes[..3], [commands, values, bulk]);
}

#[test]
fn contract_is_kept_at_the_source() {
    let mut sender = Sender::new(SenderConfig::default(), data_sealer(), Time(0));
    let mut route = route(Path::Unicast, 1);
    route.contract = Contract::at_most_hz(10.0).unwrap();
    sender.open(STREAM, route, Time(0));
    let mut sent = 0;
    for seq in 1..=1_000 {
        let now = Time(0) + MS * u32::try_from(seq).unwrap();
        if sender.due(STREAM, now) == Due::Now {
            sender.write(STREAM, &meta(1, seq), b"x", now);
            sent += 1;
        }
    }
    // The first at once, then ten a second.
    assert_eq!(sent, 11);
    assert!(matches!(sender.due(STREAM, Time(0)), Due::At(_)));
}

#[test]
fn queue_over_budget_drops_and_counts() {
    let config = SenderConfig {
        queue_bytes: 10_000,
        ..SenderConfig::default()
    };
    let mut sender = Sender::new(config, data_sealer(), Time(0));
    sender.open(STREAM, route(Path::Unicast, 1), Time(0));
    for seq in 1..=3 {
        let payload = vec![0; 5_000];
        sender.write(STREAM, &meta(1, seq), &payload, Time(0));
    }
    assert_eq!(sender.stream_counters(STREAM).unwrap().queue_dropped, 2);
    drain(&mut sender);
    let payload = vec![0; 5_000];
    sender.write(STREAM, &meta(1, 4), &payload, Time(0));
    assert_eq!(sender.stream_counters(STREAM).unwrap().queue_dropped, 2);
}

#[test]
fn new_reader_is_sent_the_present_value_once() {
    let mut sender = sender(Path::Multicast(group()), 1);
    sender.update(STREAM, route(Path::Multicast(group()), 2), Time(0));
    let to = Tag(READER.0 + 1);
    let stream = STREAM;
    assert_eq!(
        sender.poll_event(),
        Some(SenderEvent::Repeat { stream, to })
    );
    assert_eq!(sender.poll_event(), None);
    sender.repeat(STREAM, to, &meta(1, 9), b"x", Time(0));
    sender.flush(Time(0));
    let destinations: Vec<_> = drain(&mut sender).into_iter().map(|(to, _)| to).collect();
    assert_eq!(destinations, [address(1)]);
}

#[test]
fn unconfirmed_value_is_repeated_fifteen_times_then_at_each_renewal() {
    let mut sender = sender(Path::Unicast, 1);
    write(&mut sender, 1, 10, Time(0));
    let mut asked = Vec::new();
    while let Some((at, _)) = sender.poll_timeout() {
        sender.handle_timeout(at);
        while sender.poll_event().is_some() {
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
fn only_the_senders_datagrams_are_opened() {
    let mut sender = sender(Path::Unicast, 1);
    let datagram = write(&mut sender, 1, 10, Time(0)).remove(0);
    let reason = |config: ReceiverConfig, session: bool, expect: bool| {
        let mut receiver = Receiver::new(config);
        if session {
            let opener = Opener::new(&domain(), HOST, LIFE, Purpose::Data);
            receiver.session(sender_tag(), opener);
        }
        if expect {
            receiver.listen(sender_tag(), STREAM, Time(0));
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
    let mut sender = sender(Path::Unicast, 1);
    let mut datagram = write(&mut sender, 1, 10, Time(0)).remove(0);
    let mut receiver = Receiver::new(ReceiverConfig::new(READER, domain().id()));
    let opener = Opener::new(&domain(), HOST, LIFE, Purpose::Data);
    receiver.session(sender_tag(), opener);
    let mut by_group = datagram.clone();
    receiver.handle_datagram(&mut datagram, false, Time(0));
    assert_eq!(receiver.poll_sample(), None);
    receiver.listen(sender_tag(), STREAM, Time(0) + MS);
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
        receiver.listen(Tag(1), StreamId(stream), Time(0));
    }
    assert_eq!(receiver.counters().refused_streams, 1);
    let config = SenderConfig {
        max_streams: 1,
        ..SenderConfig::default()
    };
    let mut sender = Sender::new(config, data_sealer(), Time(0));
    for stream in [1, 1, 2] {
        sender.open(StreamId(stream), route(Path::Unicast, 1), Time(0));
    }
    assert_eq!(sender.counters().refused_streams, 1);
}

#[test]
fn paced_sender_keeps_its_rate() {
    let config = SenderConfig {
        pace_bytes_per_second: Some(1_200_000),
        ..SenderConfig::default()
    };
    let mut sender = Sender::new(config, data_sealer(), Time(0));
    sender.open(STREAM, route(Path::Unicast, 1), Time(0));
    let payload = vec![0; 60_000];
    sender.write(STREAM, &meta(1, 1), &payload, Time(0));
    let mut bytes = 0;
    let mut buffer = Vec::new();
    let mut now = Time(0);
    while bytes < 60_000 {
        while sender.poll_transmit(&mut buffer).is_some() {
            assert!(
                buffer.len() <= 1_200,
                "a batch is one datagram at this rate"
            );
            bytes += buffer.len();
        }
        now = sender.poll_timeout().unwrap().0.max(now);
        sender.handle_timeout(now);
    }
    assert!(
        (48..=56).contains(&now.since(Time(0)).as_millis()),
        "{now:?}"
    );
}

/// What a link does to one datagram.
#[derive(Clone, Debug)]
struct Fate {
    lost: bool,
    copies: u8,
    delay_us: u64,
}

fn fate(loss_percent: u8, spread_us: u64) -> impl Strategy<Value = Fate> {
    (0..100_u8, 0..20_u8, 0..=spread_us).prop_map(move |(loss, copy, delay_us)| Fate {
        lost: loss < loss_percent,
        copies: if copy == 0 { 2 } else { 1 },
        delay_us,
    })
}

/// One sender and one receiver over a link that follows `fates` in turn, in virtual time.
struct World {
    now: Time,
    sender: Sender,
    receiver: Receiver,
    fates: Vec<Fate>,
    sent: usize,
    flying: BTreeMap<(Time, usize), Vec<u8>>,
    acks: BTreeMap<(Time, usize), (Epoch, Seq)>,
    present: (u64, u64, usize),
    got: Vec<(Epoch, Seq)>,
}

impl World {
    fn new(fates: Vec<Fate>, path: Path) -> Self {
        Self {
            now: Time(0),
            sender: sender(path, 1),
            receiver: receiver(),
            fates,
            sent: 0,
            flying: BTreeMap::new(),
            acks: BTreeMap::new(),
            present: (0, 0, 0),
            got: Vec::new(),
        }
    }

    fn next_fate(&mut self) -> (Fate, usize) {
        let fate = self.fates[self.sent % self.fates.len()].clone();
        self.sent += 1;
        (fate, self.sent)
    }

    fn write(&mut self, epoch: u64, seq: u64, len: usize) {
        self.present = (epoch, seq, len);
        let bytes = payload(epoch, seq, len);
        self.sender
            .write(STREAM, &meta(epoch, seq), &bytes, self.now);
        self.settle();
    }

    /// Drains both machines until neither has anything to do at this instant.
    fn settle(&mut self) {
        while let Some(SenderEvent::Repeat { stream, to }) = self.sender.poll_event() {
            let (epoch, seq, len) = self.present;
            let bytes = payload(epoch, seq, len);
            self.sender
                .repeat(stream, to, &meta(epoch, seq), &bytes, self.now);
        }
        self.sender.flush(self.now);
        for (_, datagram) in drain(&mut self.sender) {
            let (fate, id) = self.next_fate();
            for copy in 0..fate.copies {
                let delay = Duration::from_micros(fate.delay_us + u64::from(copy) * 40);
                if !fate.lost {
                    let at = (self.now + delay, id * 2 + usize::from(copy));
                    self.flying.insert(at, datagram.clone());
                }
            }
        }
        while let Some(sample) = self.receiver.poll_sample() {
            let (epoch, seq) = (sample.meta.epoch, sample.meta.seq);
            let whole = payload(epoch.0, seq.0, sample.payload.len());
            assert_eq!(sample.payload, whole, "torn sample");
            assert!(self.got.last() < Some(&(epoch, seq)), "out of order");
            self.got.push((epoch, seq));
        }
        while let Some(event) = self.receiver.poll_event() {
            let ReceiverEvent::Quiet { epoch, seq, .. } = event else {
                continue;
            };
            let (fate, id) = self.next_fate();
            if !fate.lost {
                let delay = Duration::from_micros(fate.delay_us);
                // The control side may wait 20 ms for other confirmations.
                self.acks
                    .insert((self.now + 20 * MS + delay, id), (epoch, seq));
            }
        }
    }

    fn run_until(&mut self, end: Time) {
        loop {
            let next = [
                self.flying.keys().next().map(|(at, _)| *at),
                self.acks.keys().next().map(|(at, _)| *at),
                self.sender.poll_timeout().map(|(at, _)| at),
                self.receiver.poll_timeout().map(|(at, _)| at),
            ];
            let next = next.into_iter().flatten().min();
            let Some(next) = next.filter(|at| *at <= end) else {
                break;
            };
            self.now = self.now.max(next);
            while let Some(entry) = self.flying.first_entry()
                && entry.key().0 <= self.now
            {
                let mut datagram = entry.remove();
                self.receiver
                    .handle_datagram(&mut datagram, false, self.now);
            }
            while let Some(entry) = self.acks.first_entry()
                && entry.key().0 <= self.now
            {
                let (epoch, seq) = entry.remove();
                self.sender.held(STREAM, READER, epoch, seq, self.now);
            }
            self.sender.handle_timeout(self.now);
            self.receiver.handle_timeout(self.now);
            self.settle();
        }
        self.now = end;
    }

    /// Three seconds with the renewals that the control side sends each second.
    fn run_out(&mut self) {
        for _ in 0..3 {
            let end = self.now + 1_000 * MS;
            self.run_until(end);
            let newest = self.receiver.newest(sender_tag(), STREAM);
            let (epoch, seq) = newest.unwrap_or_default();
            self.sender.held(STREAM, READER, epoch, seq, self.now);
            self.settle();
        }
    }
}

#[test]
fn clean_link_carries_each_sample_once() {
    for gap_ms in [1, 90, 120, 400] {
        let fate = Fate {
            lost: false,
            copies: 1,
            delay_us: 10_000,
        };
        let mut world = World::new(vec![fate], Path::Unicast);
        for seq in 1..=10 {
            world.write(1, seq, 100);
            world.run_until(world.now + MS * gap_ms);
        }
        world.run_out();
        let counters = world.sender.stream_counters(STREAM).unwrap();
        assert_eq!((counters.sent, counters.repeats), (10, 0), "{gap_ms} ms");
        assert_eq!(world.got.len(), 10);
    }
}

proptest! {
    #[test]
    fn whatever_the_link_does_the_last_value_arrives_and_the_books_balance(
        fates in prop::collection::vec(fate(33, 20_000), 50..400),
        writes in prop::collection::vec((0..150_u64, 1..9_000_usize, 0..12_u8), 1..40),
        both in any::<bool>(),
    ) {
        let path = if both { Path::Both(group()) } else { Path::Unicast };
        // A link that loses everything is a partition: some datagrams of the cycle get through.
        prop_assume!(fates.iter().filter(|fate| !fate.lost).count() * 2 > fates.len());
        let mut world = World::new(fates, path);
        let (mut epoch, mut seq) = (1, 0);
        for (gap_ms, len, change) in writes {
            if change == 0 {
                (epoch, seq) = (epoch + 1, 0);
            }
            seq += 1;
            // Most values are small; some need several fragments.
            let len = if change < 9 { len % 100 } else { len };
            world.write(epoch, seq, len);
            world.run_until(world.now + Duration::from_millis(gap_ms));
        }
        world.run_out();
        prop_assert_eq!(world.got.last(), Some(&(Epoch(epoch), Seq(seq))));
        let books = world.receiver.books(sender_tag(), STREAM).unwrap();
        prop_assert!(books.balanced(), "{:?}", books);
        prop_assert_eq!(books.delivered, world.got.len() as u64);
    }

    #[test]
    fn arbitrary_plaintext_never_panics(
        plaintexts in prop::collection::vec(prop::collection::vec(any::<u8>(), 0..120), 1..20),
    ) {
        let mut receiver = receiver();
        let mut sealer = data_sealer();
        for plaintext in plaintexts {
            let mut datagram = vec![0; HEADER_BYTES];
            datagram.extend_from_slice(&plaintext);
            sealer.seal(Lane::Values, MIXED, &mut datagram, 0).unwrap();
            receiver.handle_datagram(&mut datagram, false, Time(0));
            while receiver.poll_sample().is_some() {}
        }
        receiver.handle_timeout(Time(u64::MAX));
    }
}

const MIXED: StreamId = StreamId(0);
