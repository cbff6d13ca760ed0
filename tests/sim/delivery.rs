//! The last value arrives; nothing is sent twice, too often, to nobody or too large.

use std::time::Duration;

use ddx_catalog::delivery::Via;
use ddx_rig::sim::{Counts, Link, Setup, Sim};
use ddx_wire::{Contract, ItemName};

use super::{check, ensure, millis, secs, seeds};

/// A network without chance, and one host whose item the others read.
fn exact(seed: u64, readers: usize, contract: Contract) -> (Sim, ItemName) {
    let link = Link {
        duplicates: 0.0,
        jitter: Duration::ZERO,
        ..Link::lan(0.0)
    };
    let mut sim = Sim::new(Setup {
        link,
        ..Setup::lan(seed, readers + 1, 0.0)
    });
    let item = sim.announce(0, "gps");
    sim.run_for(secs(2));
    for reader in 1..=readers {
        sim.subscribe(reader, &item, contract);
    }
    sim.run_for(secs(1));
    (sim, item)
}

fn write(sim: &mut Sim, item: &ItemName, samples: usize, period: Duration, len: usize) {
    for _ in 0..samples {
        sim.write(0, item, len);
        sim.run_for(period);
    }
}

/// What host 0 sends while something happens.
fn sent(sim: &mut Sim, act: impl FnOnce(&mut Sim)) -> Counts {
    let before = sim.host(0).sent();
    act(sim);
    let after = sim.host(0).sent();
    Counts {
        writes: after.writes - before.writes,
        repeats: after.repeats - before.repeats,
        datagrams: after.datagrams - before.datagrams,
        bytes: after.bytes - before.bytes,
    }
}

/// How the readers of the one stream are served, in the order of their hosts' tags.
fn path(sim: &Sim) -> Vec<&'static str> {
    let readers = sim.host(0).open.values().next();
    let readers = readers.map(|(_, route)| route.readers.as_slice());
    let mut ways: Vec<_> = readers
        .unwrap_or_default()
        .iter()
        .map(|reader| match reader.via {
            Via::Unicast => "unicast",
            Via::Group(_) => "group",
            Via::Both(_) => "both",
        })
        .collect();
    ways.dedup();
    ways
}

#[test]
fn each_sample_is_sent_once_however_many_read() {
    let test = "delivery::each_sample_is_sent_once_however_many_read";
    seeds::run(test, 0..40, |seed| {
        let readers = 1 + usize::try_from(seed % 4).unwrap();
        let (mut sim, item) = exact(seed, readers, Contract::default());
        // Enough for the group to be confirmed.
        write(&mut sim, &item, 100, millis(10), 200);
        let path = path(&sim);
        let right = if readers == 1 {
            path == ["unicast"]
        } else {
            path == ["group"]
        };
        ensure(right, || {
            format!("{readers} readers are served by {path:?}")
        })?;
        let counts = sent(&mut sim, |sim| {
            write(sim, &item, 300, millis(10), 200);
            sim.run_for(secs(3));
        });
        let wanted = (300, 0, 300);
        let got = (counts.writes, counts.repeats, counts.datagrams);
        ensure(got == wanted, || format!("{readers} readers: {counts:?}"))?;
        for reader in 1..=readers {
            let (newest, held) = (sim.host(0).newest(&item), sim.host(reader).held(&item));
            ensure(newest == held, || format!("host {reader} holds {held:?}"))?;
        }
        check(&sim)
    });
}

#[test]
fn two_readers_get_both_paths_until_the_group_is_confirmed() {
    let test = "delivery::two_readers_get_both_paths_until_the_group_is_confirmed";
    seeds::run(test, 0..40, |seed| {
        let (mut sim, item) = exact(seed, 2, Contract::default());
        ensure(path(&sim) == ["both"], || {
            format!("before the first sample: {:?}", path(&sim))
        })?;
        let first = sent(&mut sim, |sim| {
            sim.write(0, &item, 200);
        });
        ensure(first.datagrams == 3, || format!("by both: {first:?}"))?;
        write(&mut sim, &item, 50, millis(20), 200);
        ensure(path(&sim) == ["group"], || {
            format!("after a second of samples: {:?}", path(&sim))
        })?;
        // A deaf reader brings unicast back, and no reader notices.
        sim.host_mut(2).hears_groups = false;
        sim.unsubscribe(2, &item);
        sim.run_for(millis(50));
        sim.subscribe(2, &item, Contract::default());
        write(&mut sim, &item, 200, millis(20), 200);
        ensure(path(&sim) == ["unicast"], || {
            format!("one is deaf: {:?}", path(&sim))
        })?;
        for reader in 1..3 {
            let held = sim.host(reader).held(&item);
            ensure(held == sim.host(0).newest(&item), || {
                format!("host {reader} holds {held:?}")
            })?;
        }
        check(&sim)
    });
}

#[test]
fn a_rate_is_kept_at_the_source_and_the_last_value_still_comes() {
    let test = "delivery::a_rate_is_kept_at_the_source_and_the_last_value_still_comes";
    seeds::run(test, 0..40, |seed| {
        let (mut sim, item) = exact(seed, 1, Contract::at_most_hz(10.0).unwrap());
        let counts = sent(&mut sim, |sim| {
            write(sim, &item, 1_000, millis(5), 200);
        });
        ensure((50..=52).contains(&counts.writes), || {
            format!("10 Hz for 5 s: {counts:?}")
        })?;
        sim.run_for(millis(150));
        let held = sim.host(1).held(&item);
        ensure(held == sim.host(0).newest(&item), || {
            format!("holds {held:?}")
        })?;
        check(&sim)
    });
}

#[test]
fn sending_ends_with_the_last_reader() {
    let test = "delivery::sending_ends_with_the_last_reader";
    seeds::run(test, 0..40, |seed| {
        let (mut sim, item) = exact(seed, 2, Contract::default());
        write(&mut sim, &item, 50, millis(10), 200);
        sim.unsubscribe(1, &item);
        sim.unsubscribe(2, &item);
        sim.run_for(millis(5));
        let closed = sent(&mut sim, |sim| write(sim, &item, 100, millis(10), 200));
        ensure(closed.datagrams == 0, || {
            format!("after a close: {closed:?}")
        })?;
        sim.subscribe(1, &item, Contract::default());
        write(&mut sim, &item, 50, millis(10), 200);
        sim.kill(1);
        write(&mut sim, &item, 330, millis(10), 200);
        let lapsed = sent(&mut sim, |sim| write(sim, &item, 100, millis(10), 200));
        ensure(lapsed.datagrams == 0, || {
            format!("after the lease: {lapsed:?}")
        })?;
        check(&sim)
    });
}

#[test]
fn the_last_value_arrives_at_one_third_loss() {
    let test = "delivery::the_last_value_arrives_at_one_third_loss";
    seeds::run(test, 0..300, |seed| {
        let len = [60, 1_100, 5_000, 20_000][usize::try_from(seed % 4).unwrap()];
        let mut sim = Sim::new(Setup::lan(seed, 3, 0.33));
        let item = sim.announce(0, "gps");
        sim.subscribe(1, &item, Contract::default());
        sim.subscribe(2, &item, Contract::default());
        let ready = |sim: &Sim| (1..3).all(|reader| sim.host(reader).expected.len() == 1);
        ensure(sim.run_until(secs(15), ready), || {
            "not subscribed".to_owned()
        })?;
        write(&mut sim, &item, 40, millis(10 + seed % 90), len);
        let arrived = sim.run_until(secs(1), |sim| {
            (1..3).all(|reader| sim.host(reader).held(&item) == sim.host(0).newest(&item))
        });
        ensure(arrived, || format!("{len} bytes did not arrive within 1 s"))?;
        check(&sim)
    });
}
