//! Sender and receiver over a link that loses, delays and doubles, in virtual time.

use super::*;

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
    sender: Sender<Vec<u8>>,
    receiver: Receiver,
    fates: Vec<Fate>,
    sent: usize,
    flying: BTreeMap<(Time, usize), Vec<u8>>,
    acks: BTreeMap<(Time, usize), ReceiverEvent>,
    present: (u64, u64, usize),
    got: Vec<(Epoch, Seq)>,
}

impl World {
    fn new(fates: Vec<Fate>, via: Via) -> Self {
        Self {
            now: Time(0),
            sender: sender(via, 1),
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
        loop {
            while let Some(SenderEvent::Fetch(fetch)) = self.sender.poll_event() {
                let (epoch, seq, len) = self.present;
                let found = (meta(epoch, seq), payload(epoch, seq, len));
                let found = (seq > 0).then_some((&found.0, &found.1));
                self.sender.fetched(&fetch, found, self.now);
            }
            self.sender.flush(self.now);
            if !self.fly() {
                break;
            }
        }
        self.take();
    }

    /// Puts on the link what the sender has to send. Whether that was anything.
    fn fly(&mut self) -> bool {
        let datagrams = drain(&mut self.sender);
        let any = !datagrams.is_empty();
        for (_, datagram) in datagrams {
            if datagram.len() > 1_200 {
                // The link is one for short datagrams.
                continue;
            }
            let (fate, id) = self.next_fate();
            for copy in 0..fate.copies {
                let delay = Duration::from_micros(fate.delay_us + u64::from(copy) * 40);
                if !fate.lost {
                    let at = (self.now + delay, id * 2 + usize::from(copy));
                    self.flying.insert(at, datagram.clone());
                }
            }
        }
        any
    }

    fn take(&mut self) {
        while let Some(sample) = self.receiver.poll_sample() {
            let (epoch, seq) = (sample.meta.epoch, sample.meta.seq);
            let whole = payload(epoch.0, seq.0, sample.payload.len());
            assert_eq!(sample.payload, whole, "torn sample");
            assert!(self.got.last() < Some(&(epoch, seq)), "out of order");
            self.got.push((epoch, seq));
        }
        while let Some(event) = self.receiver.poll_event() {
            let (fate, id) = self.next_fate();
            if fate.lost {
                continue;
            }
            let at = self.now + Duration::from_micros(fate.delay_us);
            match event {
                // The control side may wait 20 ms for other confirmations.
                ReceiverEvent::Quiet { .. } => self.acks.insert((at + 20 * MS, id), event),
                ReceiverEvent::Nack(..) | ReceiverEvent::Report(..) => {
                    self.acks.insert((at, id), event)
                }
                ReceiverEvent::Flows { .. } | ReceiverEvent::OnGroup { .. } => None,
            };
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
                match entry.remove() {
                    ReceiverEvent::Quiet { epoch, seq, .. } => {
                        self.sender.held(STREAM, READER, epoch, seq, self.now);
                    }
                    ReceiverEvent::Nack(_, nack) => {
                        self.sender.handle_nack(READER, &nack, self.now);
                    }
                    ReceiverEvent::Report(_, report) => {
                        self.sender.handle_report(READER, &report, self.now);
                    }
                    ReceiverEvent::Flows { .. } | ReceiverEvent::OnGroup { .. } => {}
                }
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
        let mut world = World::new(vec![fate], Via::Unicast);
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
        let via = if both { Via::Both(group()) } else { Via::Unicast };
        // A link that loses everything is a partition: some datagrams of the cycle get through.
        prop_assume!(fates.iter().filter(|fate| !fate.lost).count() * 2 > fates.len());
        let mut world = World::new(fates, via);
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
