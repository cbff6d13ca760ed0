//! Everybody learns everything, soon, also after a partition; nobody alive is declared dead; idling is cheap.

use std::time::Duration;

use ddx_catalog::Event;
use ddx_rig::sim::{Setup, Sim};

use super::{check, ensure, millis, secs, seeds};

/// Virtual hours that a pair lives at one third loss, unless `DDX_HOURS` says otherwise.
const HOURS: u64 = 100;

fn converge(seed: u64, loss: f64, within: Duration) -> Result<(), String> {
    let (hosts, items) = (20, 500);
    let mut sim = Sim::new(Setup::lan(seed, hosts, loss));
    for host in 0..hosts {
        for item in 0..items {
            sim.announce(host, &format!("sensors/item{item}"));
        }
    }
    let all = items * (hosts - 1);
    let done = sim.run_until(within, |sim| {
        (0..hosts).all(|i| sim.host(i).known.len() == all)
    });
    let least = (0..hosts).map(|i| sim.host(i).known.len()).min();
    ensure(done, || {
        format!("after {within:?} one knows only {least:?} of {all} items")
    })?;
    check(&sim)
}

#[test]
fn twenty_hosts_learn_ten_thousand_items() {
    let test = "directory::twenty_hosts_learn_ten_thousand_items";
    seeds::run(test, 0..9, |seed| match seed % 3 {
        0 => converge(seed, 0.0, secs(3)),
        1 => converge(seed, 0.1, secs(4)),
        _ => converge(seed, 0.3, secs(8)),
    });
}

#[test]
fn a_living_pair_never_dies_at_one_third_loss() {
    let test = "directory::a_living_pair_never_dies_at_one_third_loss";
    let hours = seeds::number("DDX_HOURS").unwrap_or(HOURS);
    seeds::run(test, 0..hours, |seed| {
        let mut sim = Sim::new(Setup::lan(seed, 2, 0.33));
        sim.run_for(secs(3_600));
        let mut deaths = sim.log.iter();
        let death = deaths.find(|(_, _, event)| matches!(event, Event::HostDown { .. }));
        let when = death.map(|(at, host, _)| (*at, *host));
        ensure(when.is_none(), || format!("false death, seen at {when:?}"))?;
        check(&sim)
    });
}

#[test]
fn what_was_announced_in_a_partition_is_known_soon_after_it() {
    let test = "directory::what_was_announced_in_a_partition_is_known_soon_after_it";
    seeds::run(test, 0..120, |seed| {
        let (hosts, loss, limit) = match seed % 3 {
            0 => (4, 0.0, millis(1_000)),
            1 => (4, 0.1, millis(1_000)),
            _ => (20, 0.0, secs(3)),
        };
        let mut sim = Sim::new(Setup::lan(seed, hosts, loss));
        sim.run_for(secs(5));
        sim.cut(|i| i % 2);
        sim.run_for(millis(500 + seed * 260));
        let items = [sim.announce(0, "meanwhile"), sim.announce(1, "meanwhile")];
        sim.run_for(secs(1));
        sim.heal();
        let healed = sim.now();
        let known = sim.run_until(limit, |sim| {
            (0..hosts).all(|i| {
                let known = &sim.host(i).known;
                (i == 0 || known.contains_key(&items[0]))
                    && (i == 1 || known.contains_key(&items[1]))
            })
        });
        ensure(known, || {
            format!("{hosts} hosts, loss {loss}: not known {limit:?} after the heal at {healed:?}")
        })?;
        check(&sim)
    });
}

#[test]
fn idle_hosts_say_little() {
    for hosts in [2, 10, 20] {
        let mut sim = Sim::new(Setup::lan(5, hosts, 0.0));
        for host in 0..hosts {
            sim.announce(host, "item");
        }
        sim.run_for(secs(10));
        let before = sim.sent_bytes;
        sim.run_for(secs(60));
        let rate = (sim.sent_bytes - before) / 60 / u64::try_from(hosts).unwrap();
        println!("{hosts} idle hosts: {rate} B/s sent by each, without UDP and IP headers");
        assert!(rate < 250, "{hosts} hosts: {rate} B/s each");
        let samples: u64 = (0..hosts).map(|i| sim.host(i).sent().datagrams).sum();
        assert_eq!(samples, 0, "samples were sent, and nobody reads");
    }
}
