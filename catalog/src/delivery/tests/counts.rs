//! What a sender says was left out is what it left out.

use super::*;

/// Of one reader under a contract: the sender, with the first samples of its stream sent and taken.
fn begun(contract: Contract) -> Sender<Vec<u8>> {
    let mut sender = Sender::new(SenderConfig::default(), data_sealer(), Time(0));
    let mut route = route(Via::Unicast, 1);
    route.contract = contract;
    sender.open(STREAM, &route, Time(0));
    sender
}

#[test]
fn of_a_new_stream_what_follows_the_present_value_is_not_left_out() {
    let mut sender = begun(Contract::default());
    let mut receiver = receiver();
    let present = (meta(1, 5), payload(1, 5, 10));
    while let Some(SenderEvent::Fetch(fetch)) = sender.poll_event() {
        sender.fetched(&fetch, Some((&present.0, &present.1)), Time(0));
    }
    sender.flush(Time(0));
    let first: Vec<_> = drain(&mut sender).into_iter().map(|(_, d)| d).collect();
    assert_eq!(feed(&mut receiver, &first, Time(0)).len(), 1);
    // The sixth is lost on the link, which the seventh shows.
    write(&mut sender, 6, 10, Time(0) + 10 * MS);
    let last = write(&mut sender, 7, 10, Time(0) + 20 * MS);
    feed(&mut receiver, &last, Time(0));
    let books = receiver.books(sender_tag(), STREAM).unwrap();
    assert_eq!((books.filtered, books.link_lost), (0, 1), "{books:?}");
}

#[test]
fn what_is_too_old_while_its_way_is_full_is_not_left_out_by_the_way() {
    let mut sender = begun(Contract {
        max_age_ms: Some(100),
        ..Contract::default()
    });
    while let Some(SenderEvent::Fetch(fetch)) = sender.poll_event() {
        sender.fetched(&fetch, None, Time(0));
    }
    let now = Time(0) + 1_000 * MS;
    let fresh = |seq| SampleMeta {
        capture: now,
        ..meta(1, seq)
    };
    let payload = vec![0; 64];
    let offered = (1..10_000).find(|seq| !sender.write(STREAM, &fresh(*seq), &payload, now));
    let full = offered.unwrap();
    sender.write(STREAM, &meta(1, full + 1), &payload, now);
    sender.write(STREAM, &fresh(full + 2), &payload, now);

    let later = now + 50 * MS;
    sender.flush(now);
    drain(&mut sender);
    sender.handle_timeout(later);
    drain(&mut sender);
    while let Some(SenderEvent::Fetch(fetch)) = sender.poll_event() {
        sender.fetched(&fetch, Some((&fresh(full + 2), &payload)), later);
    }
    let (_, source) = sender.source_books().next().unwrap();
    let (_, _, way) = sender.sent_books().next().unwrap();
    assert_eq!((source.expired, way.filtered), (1, 1), "{source:?} {way:?}");
    assert_eq!(way.queue_dropped, 1, "{way:?}");
}
