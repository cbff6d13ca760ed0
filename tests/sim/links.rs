//! A host with a link profile: what the link does is what the profile says, and the promises hold over it.

use std::time::Duration;

use ddx_rig::link::Profile;
use ddx_rig::sim::{Setup, Sim};
use ddx_wire::{Contract, ItemName};

use super::{check, ensure, millis, secs, seeds};

/// Hosts that met on a quiet network, of which all but the first read the first one's item and then get a profile.
fn reading(seed: u64, readers: usize, profile: &str) -> (Sim, ItemName) {
    let mut sim = Sim::new(Setup::lan(seed, readers + 1, 0.0));
    let item = sim.announce(0, "gps");
    sim.run_for(secs(2));
    for reader in 1..=readers {
        sim.subscribe(reader, &item, Contract::default());
    }
    sim.run_for(secs(1));
    let text = format!("{profile} --seed {seed}");
    let profile = Profile::parse(&text).unwrap();
    for reader in 1..=readers {
        sim.set_profile(reader, 0, &profile);
    }
    (sim, item)
}

fn write(sim: &mut Sim, item: &ItemName, samples: usize, period: Duration, len: usize) {
    for _ in 0..samples {
        sim.write(0, item, len);
        sim.run_for(period);
    }
}

fn all_hold_the_newest(sim: &Sim, item: &ItemName, readers: usize) -> bool {
    (1..=readers).all(|reader| sim.host(reader).held(item) == sim.host(0).newest(item))
}

#[test]
fn the_last_value_arrives_over_every_profile() {
    let test = "links::the_last_value_arrives_over_every_profile";
    seeds::run(test, 0..40, |seed| {
        for name in Profile::names() {
            let (mut sim, item) = reading(seed, 2, name);
            write(&mut sim, &item, 50, millis(40), 200);
            // A value, a report and a repeat over the longest way.
            let arrived = sim.run_until(secs(3), |sim| all_hold_the_newest(sim, &item, 2));
            ensure(arrived, || format!("not over {name} within 3 s"))?;
            check(&sim).map_err(|text| format!("{name}: {text}"))?;
        }
        Ok(())
    });
}

#[test]
fn no_more_arrives_than_the_rate_carries_and_each_way_has_its_own() {
    let test = "links::no_more_arrives_than_the_rate_carries_and_each_way_has_its_own";
    seeds::run(test, 0..20, |seed| {
        let (mut sim, item) = reading(seed, 1, "802.11b-200k --loss 0% --up-rate none");
        let before = sim.books(1, 0);
        write(&mut sim, &item, 3_000, millis(1), 1_000);
        let after = sim.books(1, 0);
        let bits = (after.down.carried_bytes - before.down.carried_bytes) * 8;
        // Three seconds, a full queue and the frame in transmission.
        let most = 200_000 * 31 / 10 + 1_100 * 8;
        ensure((most / 2..=most).contains(&bits), || format!("{bits} bits"))?;
        // The link becomes 5,000 times slower at once, and the sender learns it from what the full queue drops.
        ensure(
            after.down.queue_full > 50 && after.up.queue_full == 0,
            || format!("{after:?}"),
        )?;
        let arrived = sim.run_until(secs(2), |sim| all_hold_the_newest(sim, &item, 1));
        ensure(arrived, || "the last value did not arrive".to_owned())?;
        check(&sim)
    });
}

#[test]
fn the_same_profile_loses_the_same_and_each_receiver_on_its_own() {
    let run = |seed| {
        let (mut sim, item) = reading(seed, 2, "wifi-multicast-broken");
        write(&mut sim, &item, 300, millis(10), 200);
        (sim.books(1, 0), sim.books(2, 0))
    };

    assert_eq!(run(1), run(1));
    assert_ne!(run(1), run(2));
    let (first, second) = run(1);
    assert!(
        first.down.lost > 0 && second.down.lost > 0,
        "{first:?} {second:?}"
    );
    assert_ne!(first.down.lost, second.down.lost);
}

#[test]
fn a_value_takes_at_least_the_delay_of_both_ends() {
    let mut sim = Sim::new(Setup::lan(1, 2, 0.0));
    let item = sim.announce(0, "gps");
    sim.run_for(secs(2));
    sim.subscribe(1, &item, Contract::default());
    sim.run_for(secs(1));
    let quiet = |delay| Profile::parse(&format!("lan --delay {delay}")).unwrap();
    sim.set_profile(0, 0, &quiet("70 ms"));
    sim.set_profile(1, 0, &quiet("30 ms"));
    let start = sim.now();

    sim.write(0, &item, 100);
    let came = sim.run_until(secs(1), |sim| all_hold_the_newest(sim, &item, 1));

    let took = sim.now() - start;
    assert!(
        came && took >= millis(100) && took < millis(102),
        "{took:?}"
    );
}
