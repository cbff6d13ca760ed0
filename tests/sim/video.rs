//! Frames of video, each wanted, over a link that loses some of their fragments.

use ddx_rig::link::Profile;
use ddx_wire::{Contract, Delivery};

use super::matrix::two_hosts;
use super::{millis, secs};

#[test]
fn frames_arrive_soon_though_each_loses_some_fragments() {
    println!("delay, ms   loss   p50, ms   p99, ms   worst, ms");
    for (delay_ms, percent, within) in [(0, 5, 60), (10, 1, 90), (10, 5, 100)] {
        let mut times = Vec::new();
        for seed in 0..5 {
            times.extend(frames(seed, delay_ms, percent));
        }
        times.sort_unstable();
        let at = |percent: usize| times[(times.len() - 1) * percent / 100];
        let (p50, p99, worst) = (at(50), at(99), at(100));
        println!("{delay_ms:>9}   {percent:>2} %   {p50:>7}   {p99:>7}   {worst:>9}");
        assert!(
            p99 <= within,
            "p99 {p99} ms at {delay_ms} ms and {percent} %"
        );
    }
}

/// Writes 150 frames of 640x480 at 30 a second, of which a ring holds a quarter of a second: how long each takes, ms.
fn frames(seed: u64, delay_ms: u32, percent: u32) -> Vec<u64> {
    let profile = format!("lan --delay {delay_ms}ms --loss {percent}% --seed {seed}");
    let mut sim = two_hosts(seed, &Profile::parse(&profile).unwrap());
    let item = sim.announce(0, "cam");
    let contract = Contract {
        delivery: Delivery::Every,
        ..Contract::default()
    };
    sim.subscribe(1, &item, contract);
    // Long enough to meet and to subscribe. The first frames find out what the link carries.
    sim.run_for(secs(15));
    let (mut times, mut waiting) = (Vec::new(), Vec::new());
    for frame in 0..170 {
        waiting.push((sim.write(0, &item, 460_992), sim.now(), frame));
        for _ in 0..33 {
            sim.run_for(millis(1));
            let (held, now) = (sim.host(1).held(&item), sim.now());
            waiting.retain(|(written, at, frame)| {
                let is_here = held >= *written;
                if is_here && *frame >= 20 {
                    times.push(u64::try_from((now - *at).as_millis()).unwrap());
                }
                !is_here
            });
        }
    }
    sim.run_for(secs(2));
    let books = sim.host(1).books()[0];
    assert_eq!(
        (books.overwritten, books.link_lost),
        (0, 0),
        "{profile}: {books:?}"
    );
    assert!(times.len() > 140, "{} came", times.len());
    times
}
