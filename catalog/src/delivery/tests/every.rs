//! Where each sample is wanted, each that does not arrive is told with its cause.

use std::collections::BTreeSet;

use super::*;

/// A ring of eight, a link that loses one in four both ways, and samples that are too old when they are written.
struct Run {
    random: u64,
    delivered: BTreeSet<u64>,
    passed: Passed,
    books: Books,
    sent: SentBooks,
}

const WRITTEN: u64 = 120;
const DEPTH: u64 = 8;
const MAX_AGE_MS: u32 = 200;

fn is_old(seq: u64) -> bool {
    seq % 5 == 3
}

fn run(seed: u64, pause: u64) -> Run {
    let contract = Contract {
        max_age_ms: Some(MAX_AGE_MS),
        ..every()
    };
    let mut sender = Sender::new(SenderConfig::default(), data_sealer(), Time(0));
    let mut route = route(Via::Unicast, 1);
    route.contract = contract;
    sender.open(STREAM, &route, Time(0));
    let mut receiver = receiver();
    receiver.forget(sender_tag(), STREAM);
    // The samples before the first were held of another stream.
    let held = Held {
        from: sender_tag(),
        newest: (Epoch(1), Seq(0)),
    };
    receiver.resume(sender_tag(), STREAM, &contract, Some(held), Time(0));
    let mut run = Run {
        random: seed,
        delivered: BTreeSet::new(),
        passed: Passed::default(),
        books: Books::default(),
        sent: SentBooks::default(),
    };
    let (start, mut written) = (Time(0) + 10_000 * MS, 0);
    let mut now = start;
    let sample = |seq: u64| {
        // When each was written follows from its number; what is old was true long before.
        let at = start + MS * u32::try_from(seq * pause).unwrap();
        let age = if is_old(seq) { 1_000 } else { 0 };
        let meta = SampleMeta {
            capture: Time(at.0 - age * 1_000_000),
            ..meta(1, seq)
        };
        (
            meta,
            payload(1, seq, if seq.is_multiple_of(7) { 4_000 } else { 100 }),
        )
    };
    while run.delivered.last() < Some(&WRITTEN) {
        assert!(now < start + 8_000 * MS, "seed {seed}: {:?}", run.delivered);
        now = now + MS;
        sender.handle_timeout(now);
        receiver.handle_timeout(now);
        // It goes on until one of the last has come: what is lost at the end may be too old when it is sent again.
        while now >= start + MS * u32::try_from((written + 1) * pause).unwrap() {
            written += 1;
            // The thread that reads the store misses some.
            if run.draw(10) > 0 {
                let (meta, payload) = sample(written);
                sender.write(STREAM, &meta, &payload, now);
            }
        }
        sender.flush(now);
        let mut fetched = 0;
        while let Some(SenderEvent::Fetch(fetch)) = sender.poll_event() {
            fetched += 1;
            assert!(fetched < 1_000, "seed {seed}: {fetch:?}");
            let from = match fetch.want {
                Want::Newest => written,
                Want::After(_, seq) => seq.0 + 1,
                Want::At(_, seq) => seq.0,
            };
            let from = from.max((written + 1).saturating_sub(DEPTH)).max(1);
            let found = sample(from);
            let found = (from <= written).then_some((&found.0, &found.1));
            sender.fetched(&fetch, found, now);
        }
        for (_, mut datagram) in drain(&mut sender) {
            if datagram.len() <= 1_200 && run.draw(4) > 0 {
                receiver.handle_datagram(&mut datagram, false, now);
            }
        }
        while let Some(sample) = receiver.poll_sample() {
            run.delivered.insert(sample.meta.seq.0);
            run.passed.overwritten += sample.passed.overwritten;
            run.passed.filtered += sample.passed.filtered;
        }
        while let Some(event) = receiver.poll_event() {
            let arrives = run.draw(4) > 0;
            if !arrives {
                continue;
            }
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
    run.books = receiver.books(sender_tag(), STREAM).unwrap();
    run.sent = sender.sent_books().next().unwrap().2;
    run
}

impl Run {
    /// A number below `most`.
    fn draw(&mut self, most: u64) -> u64 {
        self.random = self
            .random
            .wrapping_mul(0x5851_f42d_4c95_7f2d)
            .wrapping_add(1);
        (self.random >> 33) % most
    }
}

#[test]
fn each_sample_is_delivered_overwritten_or_left_out_and_the_reader_is_told_which() {
    let mut causes = Passed::default();
    for seed in 0..30 {
        // From far more than the ring survives to what it keeps with ease.
        let run = run(seed, 1 + seed % 20);
        let books = run.books;
        let last = *run.delivered.last().unwrap();
        let lacks = (1..=last).filter(|seq| !run.delivered.contains(seq));
        let lacks = u64::try_from(lacks.count()).unwrap();
        let told = (books.overwritten, books.filtered, books.link_lost);
        assert_eq!(told.0 + told.1 + told.2, lacks, "seed {seed}: {books:?}");
        assert_eq!(books.link_lost, 0, "seed {seed}: {books:?}");
        assert_eq!(
            (run.passed.overwritten, run.passed.filtered),
            (told.0, told.1),
            "seed {seed}"
        );
        let old = u64::try_from((1..=last).filter(|seq| is_old(*seq)).count()).unwrap();
        assert!(books.filtered <= old, "seed {seed}: {books:?}");
        assert!(run.delivered.iter().all(|seq| !is_old(*seq)), "seed {seed}");
        assert!(books.balanced(), "seed {seed}: {books:?}");
        assert_eq!(
            run.sent.accounted(),
            run.sent.expected,
            "seed {seed}: {:?}",
            run.sent
        );
        causes.overwritten += told.0;
        causes.filtered += told.1;
    }
    assert!(
        causes.overwritten > 200 && causes.filtered > 200,
        "{causes:?}"
    );
}
