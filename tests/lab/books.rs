//! Each sample is accounted for on each hop, and a reader is told exactly what it missed and why.

use std::process::Command;

use ddx_rig::link::Profile;
use serde_json::Value;

use crate::program::{Asked, Book, Order};
use crate::site::{PATIENCE, Site, wait};

const EVERY: Asked = Asked {
    every: true,
    rate_hz: None,
    max_age_ms: None,
    priority: ddx_wire::Priority::Normal,
};

#[test]
fn a_reader_of_every_sample_is_told_exactly_what_the_source_let_go_and_what_was_lost() {
    let Some(site) = Site::new(&["robot1", "base"]) else {
        return;
    };
    let (mut robot, mut reader) = site.imu(1, EVERY);
    // 8 Mbit/s into a link of 2 Mbit/s that loses one in ten, from a ring of 8.
    let link = Profile::parse("lan --rate \"2 Mbit/s\" --loss 10%").unwrap();
    site.lab.host("base").set_link(&link).unwrap();

    robot.tell(&Order::Write {
        first: 1,
        count: SAMPLES,
        period_us: 1_000,
        bytes: 1_000,
    });
    reader.tell_read(SAMPLES, PATIENCE);
    // Books of one moment balance in the midst of it all.
    for host in ["robot1", "base"] {
        let (code, said) = stat(&site, host, &["stat", "--check"]);
        assert_eq!(code, Some(0), "{host}: {said:?}");
    }
    robot.answer(PATIENCE);
    let (_, books) = reader.read_told(PATIENCE + PATIENCE);

    let book = books[0];
    assert_eq!(book.total(), 1 + SAMPLES, "{book:?}");
    assert_eq!(
        (book.lost, book.filtered, book.backwards),
        (0, 0, 0),
        "{book:?}"
    );
    assert!(
        book.overwritten > SAMPLES / 4 && book.delivered > SAMPLES / 10,
        "{book:?}"
    );
    balanced_at_rest(&site, book);
}

#[test]
fn a_reader_of_every_sample_is_told_what_its_contract_kept_back() {
    let Some(site) = Site::new(&["robot1", "base"]) else {
        return;
    };
    let asked = Asked {
        max_age_ms: Some(200),
        ..EVERY
    };
    let (mut robot, mut reader) = site.imu(1, asked);
    for block in 0..5 {
        let first = 1 + 20 * block;
        robot.ask(&Order::Write {
            first,
            count: 10,
            period_us: 5_000,
            bytes: 100,
        });
        robot.ask(&Order::WriteAged {
            first: first + 10,
            count: 10,
            period_us: 5_000,
            age_ms: 1_000,
        });
    }
    robot.write(101);
    let (_, books) = reader.read(101, PATIENCE);

    let book = books[0];
    let missed = (book.overwritten, book.filtered, book.lost);
    assert_eq!((book.delivered, missed), (52, (0, 50, 0)), "{book:?}");
    balanced_at_rest(&site, book);
}

#[test]
fn a_partition_costs_a_reader_of_every_sample_what_the_ring_let_go_and_nothing_else() {
    let Some(site) = Site::new(&["robot1", "base"]) else {
        return;
    };
    let (mut robot, mut reader) = site.imu(1, EVERY);
    site.lab.host("base").cut().unwrap();
    site.wait_state("robot1", "base", "unreachable");
    let written = |first, count| Order::Write {
        first,
        count,
        period_us: 1_000,
        bytes: 100,
    };
    robot.ask(&written(1, 50));
    // Its lease has lapsed, so that another stream goes on where this one ended.
    wait("robot1 to end the stream", PATIENCE, || {
        let routes = site.ddx("robot1", &["get", "@/routes"]);
        match routes[0]["value"].as_array().is_some_and(Vec::is_empty) {
            true => Ok(()),
            false => Err(format!("{routes:?}")),
        }
    });
    site.lab.host("base").heal().unwrap();
    let (_, books) = reader.read(50, PATIENCE);

    // Nobody here had asked for it meanwhile, but the reader wants each: eight are still in the ring.
    let book = books[0];
    let missed = (book.overwritten, book.filtered, book.lost);
    assert_eq!((book.delivered, missed), (9, (42, 0, 0)), "{book:?}");
}

#[test]
fn books_that_were_tampered_with_are_named_by_item_and_hop() {
    let Some(site) = Site::new(&["robot1", "base"]) else {
        return;
    };
    let (mut robot, mut reader) = site.imu(2, Asked::default());
    robot.write(1);
    reader.read(1, PATIENCE);
    let (_, mut rows) = settled(&site, "base");
    let lost = rows
        .iter()
        .position(|row| row["name"] == "robot1/imu/1" && row["hop"] == "link to mirror");
    let row = &mut rows[lost.unwrap()];
    // A counter that was not counted up.
    row["delivered"] = (row["delivered"].as_u64().unwrap() - 1).into();
    let text: Vec<String> = rows.iter().map(Value::to_string).collect();
    let host = site.lab.host("base");
    host.shell(&format!(
        "cat >/run/books <<'END'\n{}\nEND",
        text.join("\n")
    ))
    .unwrap();

    let (code, said) = stat(
        &site,
        "base",
        &["stat", "--check", "--snapshot", "/run/books"],
    );
    assert_eq!(code, Some(3), "{said:?}");
    let place = (said[0]["name"].as_str(), said[0]["hop"].as_str());
    assert_eq!(place, (Some("robot1/imu/1"), Some("link to mirror")));
    let sentence = said[0]["sentence"].as_str().unwrap();
    assert!(
        sentence.contains("2 samples by their numbers, 1 accounted for"),
        "{sentence}"
    );
    assert_eq!(said[1]["unbalanced"], 1, "{said:?}");
}

/// At rest, what the reader was told is what the hops of its host say, and all books balance.
fn balanced_at_rest(site: &Site, book: Book) {
    let (mirror, rows) = settled(site, "base");
    let reader = rows
        .iter()
        .find(|row| row["hop"] == "mirror to reader")
        .unwrap();
    let told =
        ["delivered", "overwritten", "filtered", "lost"].map(|what| reader[what].as_u64().unwrap());
    assert_eq!(
        told,
        [book.delivered, book.overwritten, book.filtered, book.lost]
    );
    assert_eq!(mirror["filtered"], book.filtered, "{mirror}");
    assert_eq!(mirror["lost"], book.lost, "{mirror}");
    for host in ["robot1", "base"] {
        let (code, said) = stat(site, host, &["stat", "--check"]);
        assert_eq!(code, Some(0), "{host}: {said:?}");
    }
}

/// The rows of a host once the link has delivered what the mirror's reader has seen, and that of the link.
fn settled(site: &Site, host: &str) -> (Value, Vec<Value>) {
    let mut found = None;
    wait("the books to be at rest", PATIENCE, || {
        let (_, rows) = stat(site, host, &["stat"]);
        let of = |hop: &str| rows.iter().find(|row| row["hop"] == hop).cloned();
        match (of("link to mirror"), of("mirror to reader")) {
            (Some(link), Some(reader)) if link["expected"] == reader["expected"] => {
                found = Some((link, rows));
                Ok(())
            }
            _ => Err(format!("{rows:?}")),
        }
    });
    found.unwrap()
}

/// The exit code of `ddx --json` in a host, and the objects that it prints.
fn stat(site: &Site, host: &str, arguments: &[&str]) -> (Option<i32>, Vec<Value>) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_ddx"));
    command.arg("--json").args(arguments);
    let output = site.lab.host(host).exec(&command).unwrap();
    let lines = output.stdout.lines();
    let objects = lines.map(|line| serde_json::from_str(line).unwrap());
    (output.status.code(), objects.collect())
}

/// Two seconds of them.
const SAMPLES: u64 = 2_000;
