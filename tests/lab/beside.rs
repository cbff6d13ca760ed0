//! A slow viewer and bulk change nothing for those beside them.
//!
//! Each is measured in pairs of runs, with and without. Other work on the machine only ever makes things slower, so what
//! one run in several shows is what there is: the least of the times, the greatest of the rates.

use std::time::Duration;

use ddx_wire::Priority;

use crate::program::{Asked, Order, Program};
use crate::site::{PATIENCE, Site, row};

#[test]
fn a_viewer_behind_a_slow_link_changes_nothing_for_a_fast_one_nor_for_the_writer() {
    let Some(site) = Site::new(&["robot1", "fast", "slow"]) else {
        return;
    };
    site.link("fast", "lan --rate 50Mbit/s --delay 1ms");
    site.link("slow", "lan --rate 1Mbit/s --delay 1ms");
    let (mut robot, mut fast) = (site.program("robot1"), site.program("fast"));
    let mut slow = site.program("slow");
    robot.open_large_writers("robot1/view", 1, 8_000);
    robot.write(0);
    fast.open_readers("robot1/view", 1);
    fast.read(0, PATIENCE);

    let (mut without, mut with) = (Best::default(), Best::default());
    row("viewers     read/s   p50 ms   p99 ms   written/s   write p50 us   p99 us   slow/s");
    for _ in 0..ROUNDS {
        without.add(view(&mut robot, &mut fast, None));
        slow.open_readers("robot1/view", 1);
        with.add(view(&mut robot, &mut fast, Some(&mut slow)));
        slow.ask(&Order::CloseReaders);
    }

    assert!(
        with.rate >= 0.95 * without.rate,
        "the fast viewer gets fewer samples: {with:?} against {without:?}"
    );
    assert!(
        with.p99 <= without.p99 * 3 / 2 + Duration::from_millis(2),
        "the fast viewer gets older samples: {with:?} against {without:?}"
    );
    assert!(
        with.write_rate >= 0.95 * without.write_rate,
        "the writer writes less: {with:?} against {without:?}"
    );
    // With few cores the thread that is the wire, and has more to do now, takes the writer's for a moment now and then.
    assert!(
        with.write_p50 <= 2 * without.write_p50 + Duration::from_micros(20)
            && with.write_p99 <= without.write_p99 + Duration::from_millis(1),
        "the writer is slower: {with:?} against {without:?}"
    );
}

/// What waits here waits for the link, not for a core: the kernel is the link, since a thread that is one wants a core for each
/// frame, and the programs that fill and read 6 MiB give way to others.
#[test]
fn commands_pass_large_samples() {
    let Some(site) = Site::new(&["robot1", "base"]) else {
        return;
    };
    let shape = "tc qdisc add dev eth0 root tbf rate 100mbit burst 4kb latency 100ms";
    site.lab.host("robot1").shell(shape).unwrap();
    let (mut pilot, mut actor) = (site.program("robot1"), site.program("base"));
    pilot.open_writers("robot1/command", 1);
    pilot.write(0);
    let [mut camera, mut viewer] =
        ["robot1", "base"].map(|host| Program::start_last(site.lab.host(host)));
    camera.open_large_writers("robot1/cloud", 1, u32::try_from(BULK_BYTES).unwrap());
    camera.write(0);
    viewer.open_readers("robot1/cloud", 1);
    viewer.read(0, PATIENCE);
    let asked = Asked {
        priority: Priority::Command,
        ..Asked::default()
    };
    actor.open_readers_as("robot1/command", 1, asked);
    actor.read(0, PATIENCE);
    let mut bulk = (camera, viewer);
    row("commands      read/s   p50 ms   p99 ms   bulk/s");
    // The path learns its rate and the length of its datagrams.
    command(&mut pilot, &mut actor, Some(&mut bulk));

    let (mut alone, mut beside) = (Best::default(), Best::default());
    for _ in 0..COMMAND_ROUNDS {
        alone.add(command(&mut pilot, &mut actor, None));
        beside.add(command(&mut pilot, &mut actor, Some(&mut bulk)));
    }

    assert!(beside.beside >= 0.5, "no bulk crossed: {beside:?}");
    assert!(
        beside.rate >= 0.95 * alone.rate,
        "commands are left out: {beside:?} against {alone:?}"
    );
    assert!(
        beside.p50 <= alone.p50 + PROMISED && beside.p99 <= alone.p99 + PROMISED,
        "commands wait for bulk: {beside:?} against {alone:?}"
    );
}

/// What one run shows, and the best of several.
#[derive(Clone, Copy, Debug)]
struct Best {
    rate: f64,
    p50: Duration,
    p99: Duration,
    write_rate: f64,
    write_p50: Duration,
    write_p99: Duration,
    /// What the others get in a second.
    beside: f64,
}

impl Default for Best {
    fn default() -> Self {
        Self {
            rate: 0.0,
            p50: Duration::MAX,
            p99: Duration::MAX,
            write_rate: 0.0,
            write_p50: Duration::MAX,
            write_p99: Duration::MAX,
            beside: 0.0,
        }
    }
}

impl Best {
    fn add(&mut self, run: Self) {
        *self = Self {
            rate: self.rate.max(run.rate),
            p50: self.p50.min(run.p50),
            p99: self.p99.min(run.p99),
            write_rate: self.write_rate.max(run.write_rate),
            write_p50: self.write_p50.min(run.write_p50),
            write_p99: self.write_p99.min(run.write_p99),
            beside: self.beside.max(run.beside),
        };
    }
}

/// One run of the fast viewer.
fn view(robot: &mut Program, fast: &mut Program, mut slow: Option<&mut Program>) -> Best {
    for reader in slow.iter_mut() {
        reader.tell_read_for(RUN);
    }
    fast.tell_read_for(RUN);
    let started = ddx_store::now();
    robot.tell(&Order::Write {
        first: 1,
        count: 150,
        period_us: 10_000,
        bytes: 8_000,
    });
    let written = robot.answer(PATIENCE);
    let span = Duration::from_nanos(written.at_ns() - started.0);
    let ages = fast.read_for_told(RUN)[0].ages;
    let others = slow
        .as_mut()
        .map_or(0, |slow| slow.read_for_told(RUN)[0].ages.count);
    let run = Best {
        rate: per_second(ages.count, RUN),
        p50: ages.p50,
        p99: ages.p99,
        write_rate: per_second(150, span),
        write_p50: written.writes().p50,
        write_p99: written.writes().p99,
        beside: per_second(others, RUN),
    };
    row(&format!(
        "{:<11} {:>6.1} {:>8.2} {:>8.2} {:>11.1} {:>14.1} {:>8.1} {:>8.1}",
        if slow.is_some() { "fast, slow" } else { "fast" },
        run.rate,
        ms(run.p50),
        ms(run.p99),
        run.write_rate,
        ms(run.write_p50) * 1e3,
        ms(run.write_p99) * 1e3,
        run.beside
    ));
    run
}

/// One run of commands.
fn command(
    pilot: &mut Program,
    actor: &mut Program,
    mut beside: Option<&mut (Program, Program)>,
) -> Best {
    if let Some((camera, viewer)) = &mut beside {
        viewer.tell_read_for(RUN);
        bulk(camera);
    }
    actor.tell_read_for(RUN);
    pilot.tell(&Order::Write {
        first: 1,
        count: 750,
        period_us: 2_000,
        bytes: 64,
    });
    let ages = actor.read_for_told(RUN)[0].ages;
    pilot.answer(PATIENCE);
    let others = beside.as_mut().map_or(0, |(camera, viewer)| {
        let seen = viewer.read_for_told(RUN)[0].ages.count;
        camera.answer(PATIENCE);
        seen
    });
    let run = Best {
        rate: per_second(ages.count, RUN),
        p50: ages.p50,
        p99: ages.p99,
        beside: per_second(others, RUN),
        ..Best::default()
    };
    row(&format!(
        "{:<12} {:>7.1} {:>8.2} {:>8.2} {:>8.1}",
        if beside.is_some() {
            "beside bulk"
        } else {
            "alone"
        },
        run.rate,
        ms(run.p50),
        ms(run.p99),
        run.beside
    ));
    run
}

/// A large sample each second, which takes half of one at the least: newer ones would only take the place of one that is
/// under way.
fn bulk(camera: &mut Program) {
    camera.tell(&Order::Write {
        first: 1,
        count: 2,
        period_us: 1_000_000,
        bytes: BULK_BYTES,
    });
}

fn per_second(count: u64, span: Duration) -> f64 {
    f64::from(u32::try_from(count).unwrap()) / span.as_secs_f64()
}

fn ms(time: Duration) -> f64 {
    time.as_secs_f64() * 1e3
}

const PROMISED: Duration = Duration::from_millis(1);
const BULK_BYTES: usize = 6 << 20;
const ROUNDS: usize = 3;
const COMMAND_ROUNDS: usize = 4;
/// Longer than what is written in it takes.
const RUN: Duration = Duration::from_secs(2);
