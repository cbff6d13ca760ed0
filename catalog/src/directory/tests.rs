use ddx_wire::message::Change;
use ddx_wire::{Epoch, WriterState};

use super::*;

const OWNER: HostId = HostId([4; 16]);
const LIFE: Tag = Tag(4);

fn description(rest: &str) -> ItemDescription {
    ItemDescription {
        name: ItemName::parse(rest, &HostName::parse("r").unwrap()).unwrap(),
        schema_hash: SchemaHash([1; 16]),
        capacity_bytes: 8,
        depth: 8,
        epoch: Epoch(1),
        writer: WriterState::Live,
        program: "p".to_owned(),
    }
}

fn following(out: &mut Outbox) -> Directory {
    let mut directory = Directory::new();
    let name = HostName::parse("r").unwrap();
    directory.follow(OWNER, LIFE, &name, 0, Time(0), out);
    directory
}

fn delta(from: u64, changes: &[(u64, &str)], version: u64) -> Delta {
    let to = changes.last().map_or(from, |(version, _)| *version);
    let change = |(version, name): &(u64, &str)| Change {
        version: *version,
        item: ItemState::Announced(description(name)),
    };
    Delta {
        range: Range { from, to },
        version,
        changes: changes.iter().map(change).collect(),
    }
}

fn have(directory: &Directory) -> u64 {
    directory.remotes[&OWNER].have
}

#[test]
fn deltas_in_any_order_meet_and_a_gap_is_asked_for() {
    let out = &mut Outbox::default();
    let mut directory = following(out);
    assert!(directory.handle_delta(OWNER, LIFE, delta(4, &[(6, "c")], 6), Time(1), out));
    assert_eq!(have(&directory), 0);
    let due = directory.poll_timeout();
    assert!(due.is_some_and(|at| at <= Time(1) + PULL_QUIET), "{due:?}");
    let first = delta(0, &[(1, "a"), (4, "b")], 6);
    assert!(directory.handle_delta(OWNER, LIFE, first.clone(), Time(2), out));
    assert_eq!(have(&directory), 6);
    assert!(
        directory.handle_delta(OWNER, LIFE, first, Time(3), out),
        "idempotent"
    );
    assert_eq!(have(&directory), 6);
}

#[test]
fn an_item_is_shown_once_its_schema_is_there() {
    let out = &mut Outbox::default();
    let mut directory = following(out);
    directory.handle_delta(OWNER, LIFE, delta(0, &[(1, "a")], 1), Time(1), out);
    assert!(out.pop_event().is_none());
    let part = SchemaPart {
        hash: SchemaHash([1; 16]),
        index: 0,
        count: 1,
        bytes: b"u64".to_vec(),
    };
    directory.handle_schema_part(part, Time(2), out);
    let known = out.pop_event();
    assert!(matches!(known, Some(Event::ItemKnown { schema_text, .. }) if &*schema_text == "u64"));
}

#[test]
fn changes_outside_their_range_or_prefix_are_refused() {
    let out = &mut Outbox::default();
    let mut directory = following(out);
    let mut lie = delta(0, &[(1, "a")], 1);
    lie.range.to = 0;
    assert!(!directory.handle_delta(OWNER, LIFE, lie, Time(1), out));
    let foreign = delta(0, &[(1, "other/a")], 1);
    assert!(!directory.handle_delta(OWNER, LIFE, foreign, Time(1), out));
    assert!(!directory.handle_delta(OWNER, Tag(9), delta(0, &[], 0), Time(1), out));
}

#[test]
fn what_cannot_travel_is_refused_by_name() {
    let mut directory = Directory::new();
    let long = "x".repeat(70_000);
    let error = directory
        .announce(description("a"), &long, Time(0))
        .unwrap_err();
    assert!(
        error
            .to_string()
            .contains("schema of `r/a` takes 70000 bytes")
    );
    let mut wordy = description("a");
    wordy.program = "p".repeat(600);
    let error = directory.announce(wordy, "u64", Time(0)).unwrap_err();
    assert!(matches!(error, Error::DescriptionTooLong { .. }));
}

#[test]
fn a_full_directory_refuses_own_items_by_name_and_counts_those_of_others() {
    let out = &mut Outbox::default();
    let mut directory = following(out);
    let names: Vec<String> = (0..=ITEMS_MAX).map(|number| number.to_string()).collect();
    for name in &names[..ITEMS_MAX] {
        directory
            .announce(description(name), "u64", Time(0))
            .unwrap();
    }

    let refused = directory.announce(description("more"), "u64", Time(0));
    let changes: Vec<(u64, &str)> = (1..).zip(names.iter().map(String::as_str)).collect();
    let all = delta(0, &changes, u64::try_from(changes.len()).unwrap());
    assert!(directory.handle_delta(OWNER, LIFE, all, Time(1), out));

    assert_eq!(
        refused.unwrap_err().to_string(),
        "directory is full: 65536 items; `r/more` was not announced"
    );
    assert_eq!(directory.remotes[&OWNER].items.len(), ITEMS_MAX);
    assert_eq!(directory.dropped(), 1);
}

#[test]
fn what_the_items_of_others_take_is_counted_and_given_back() {
    let out = &mut Outbox::default();
    let mut directory = following(out);
    let changes = [(1, "a"), (2, "b"), (3, "c")];
    directory.handle_delta(OWNER, LIFE, delta(0, &changes, 3), Time(1), out);
    let three = directory.remote_bytes;
    assert_eq!(three, 3 * (ITEM_BYTES + 4 * 3 + 1));
    let withdrawn = Delta {
        range: Range { from: 3, to: 4 },
        version: 4,
        changes: vec![Change {
            version: 4,
            item: ItemState::Withdrawn(description("b").name),
        }],
    };
    directory.handle_delta(OWNER, LIFE, withdrawn, Time(2), out);
    assert_eq!(
        directory.remote_bytes,
        three - 1,
        "a tombstone has no program"
    );

    // A flood fills it, and what has no room is counted.
    directory.remote_bytes += REMOTE_BYTES_MAX - three - ITEM_BYTES;
    let flood = delta(4, &[(5, "d"), (6, "e")], 6);
    directory.handle_delta(OWNER, LIFE, flood, Time(3), out);
    assert_eq!(
        (directory.dropped(), directory.remotes[&OWNER].items.len()),
        (2, 3)
    );
    directory.remote_bytes -= REMOTE_BYTES_MAX - three - ITEM_BYTES;

    // Of a later life only what it has itself stays.
    let (name, later) = (HostName::parse("r").unwrap(), Tag(5));
    directory.follow(OWNER, later, &name, 1, Time(4), out);
    directory.handle_delta(OWNER, later, delta(0, &[(1, "x")], 1), Time(5), out);
    assert_eq!(directory.remote_bytes, ITEM_BYTES + 4 * 3 + 1);
    directory.forget(OWNER, out);
    assert_eq!(directory.remote_bytes, 0);
}

#[test]
fn schemas_of_this_host_go_with_their_last_item_and_take_so_many_bytes_at_most() {
    let mut directory = Directory::new();
    let text = "x".repeat(60_000);
    let with = |name: &str, number: u32| {
        let mut hash = [0; 16];
        hash[..4].copy_from_slice(&number.to_le_bytes());
        ItemDescription {
            schema_hash: SchemaHash(hash),
            ..description(name)
        }
    };
    // One program that changes its mind ever again.
    for number in 0..2_000 {
        directory
            .announce(with("a", number), &text, Time(0))
            .unwrap();
    }
    directory.withdraw(&description("a").name, Time(0));

    let announced = (0..2_000).map(|number| {
        let description = with(&number.to_string(), number);
        directory.announce(description, &text, Time(0))
    });
    let refused: Vec<Error> = announced.filter_map(Result::err).collect();
    assert_eq!(refused.len(), 2_000 - (64 << 20) / 60_000);
    assert!(matches!(refused[0], Error::SchemasFull { .. }));
}

#[test]
fn what_one_host_is_owed_is_little_and_the_rest_is_counted() {
    let mut directory = Directory::new();
    for number in 0..100_u8 {
        let description = ItemDescription {
            schema_hash: SchemaHash([number; 16]),
            ..description(&number.to_string())
        };
        directory.announce(description, "u64", Time(0)).unwrap();
    }
    for number in 0..100 {
        directory.handle_schema_request(LIFE, SchemaHash([number; 16]), 1, Time(1));
    }
    assert_eq!(directory.unanswered(), 100 - 64);
    let ranges = (0..50).map(|from| Range { from, to: from + 1 });
    directory.handle_pull(LIFE, ranges.collect(), Time(1));
    assert_eq!(directory.unanswered(), 100 - 64 + 50 - 32);
}
