//! Emulated links in the laboratory: what a profile says is what datagrams meet.

#![expect(
    clippy::unwrap_used,
    reason = "a helper of a test fails the test, as the test itself would"
)]

use std::collections::BTreeSet;
use std::process::Command;
use std::thread;
use std::time::Duration;

use ddx_rig::lab::{self, Host, Lab, Process};
use ddx_rig::link::{Class, Line, Profile};

const PROBE: &str = env!("CARGO_BIN_EXE_lab_probe");
const PATIENCE: Duration = Duration::from_secs(20);
const GROUP: &str = "239.77.0.1";
const PORT: &str = "7003";
/// IP and UDP headers.
const HEADERS: usize = 28;
/// How late a runnable thread may be on a machine with other work.
const SLICE: Duration = Duration::from_millis(12);

/// One datagram that came.
#[derive(Clone, Copy, Debug)]
struct Arrival {
    number: u32,
    delay: Duration,
    at: Duration,
}

/// Most of the time nothing is done but waiting, so the links are tried side by side, each in a lab of its own; but not
/// `lan`, whose flood takes all that the machine has.
#[test]
fn each_profile_delays_loses_and_paces_as_it_says() {
    does_as_it_says("lan");
    thread::scope(|scope| {
        for name in ["wifi-bad", "lte", "lossy-33", "satellite"] {
            scope.spawn(move || does_as_it_says(name));
        }
    });
}

#[expect(
    clippy::print_stdout,
    reason = "figures for people; nothing reads them"
)]
fn does_as_it_says(name: &str) {
    let Some(lab) = lab::require(&["a", "b"]) else {
        return;
    };
    lab.watch_udp("probe", &[7003]).unwrap();
    meet(&lab);
    let profile = Profile::parse(name).unwrap();
    let (up, down) = profile.seeds(1);
    for (from, to, config, seed) in [("a", "b", profile.down, down), ("b", "a", profile.up, up)] {
        lab.host("b").set_link(&profile).unwrap();
        // Far enough apart that jitter does not push them together.
        let interval = config.jitter * 2 + Duration::from_millis(4);
        let came = run(&lab, from, to, 150, interval, 100);

        let expected = survivors(&mut Line::new(config, seed), Class::Unicast, 150);
        assert_eq!(numbers(&came), expected, "{name} to {to}");
        let median = median(&came);
        println!("{name} to {to}: {} of 150 came, p50 {median:?}", came.len());
        // Nothing comes early, the first comes at once, and half of all come within a loaded machine's slice.
        let least = config.delay.saturating_sub(config.jitter);
        let first = came.iter().map(|arrival| arrival.delay).min().unwrap();
        let about = least..=least + config.jitter / 3 + Duration::from_millis(3);
        assert!(about.contains(&first), "{name} to {to}: first {first:?}");
        let about = config.delay - config.jitter / 3..=config.delay + config.jitter / 3 + SLICE;
        assert!(about.contains(&median), "{name} to {to}: p50 {median:?}");

        flood(&lab, name, from, to);
    }
    assert_eq!(lab.host("a").overruns(), 0, "a has no wire");
}

/// Offers two and a half times the rate and sees how fast it comes out.
#[expect(
    clippy::print_stdout,
    reason = "figures for people; nothing reads them"
)]
fn flood(lab: &Lab, name: &str, from: &str, to: &str) {
    // A queue so long that the link never idles when the flooding program has to wait for a core.
    let profile = Profile::new(name, &[("queue", "1 s")]).unwrap();
    lab.host("b").set_link(&profile).unwrap();
    let config = if to == "b" { profile.down } else { profile.up };
    let rate = f64::from(u32::try_from(config.rate.unwrap().0).unwrap());
    // A gigabit is more than the machine can offer through the wire: as much as there is.
    let is_paced = rate < 1e8;
    let (count, bytes) = if is_paced {
        (real_count(rate * 2.5 / (1_200.0 * 8.0)), 1_172)
    } else {
        (60_000, 1_472)
    };
    let interval = if is_paced {
        Duration::from_secs_f64(1_200.0 * 8.0 / (rate * 2.5))
    } else {
        Duration::ZERO
    };
    let books = || {
        let books = lab.host("b").books();
        if to == "b" { books.down } else { books.up }
    };
    let (before, missed) = (books(), lab.host("b").overruns());

    let came = run(lab, from, to, count, interval, bytes);

    let after = books();
    let missed = lab.host("b").overruns() - missed;
    let span = (came.last().unwrap().at - came[0].at).as_secs_f64();
    let sent = u64::try_from(came.len()).unwrap() - 1 + after.lost - before.lost;
    let packet = u64::try_from(bytes + HEADERS).unwrap();
    let found = f64::from(u32::try_from(sent * packet).unwrap()) * 8.0 / span;
    println!(
        "{name} to {to}: flood of {count} left at {:.2} Mbit/s and {:.0} packets/s; {missed} overruns",
        found / 1e6,
        f64::from(u32::try_from(sent).unwrap()) / span
    );
    if is_paced {
        assert!(
            (found / rate - 1.0).abs() < 0.1,
            "{name} to {to}: {found} bit/s"
        );
        assert!(after.queue_full > before.queue_full, "{name}: {after:?}");
    } else {
        assert!(found < rate * 1.1, "{name} to {to}: {found} bit/s");
    }
}

#[test]
fn the_same_seed_loses_the_same_datagrams_in_every_run() {
    let run_once = |texts: &[&str]| -> Option<Vec<BTreeSet<u32>>> {
        let lab = lab::require(&["a", "b"])?;
        lab.watch_udp("probe", &[7003]).unwrap();
        meet(&lab);
        let lost = texts.iter().map(|text| {
            let profile = Profile::parse(text).unwrap();
            lab.host("b").set_link(&profile).unwrap();
            let came = run(&lab, "a", "b", 400, Duration::from_millis(2), 64);
            let (_, seed) = profile.seeds(1);
            let line = &mut Line::new(profile.down, seed);
            assert_eq!(
                numbers(&came),
                survivors(line, Class::Unicast, 400),
                "{text}"
            );
            let came = numbers(&came);
            (0..400).filter(|number| !came.contains(number)).collect()
        });
        Some(lost.collect())
    };
    let texts = [
        "lossy-33 --seed 7",
        "lossy-33 --seed 7 --delay 3ms --jitter 2ms",
        "lossy-33 --seed 8",
        "wifi-bad --seed 7 --delay 3ms",
    ];
    let both = thread::scope(|scope| {
        let other = scope.spawn(|| run_once(&texts));
        (run_once(&texts), other.join().unwrap())
    });
    let (Some(first), Some(second)) = both else {
        return;
    };

    assert_eq!(first, second, "two labs");
    assert_eq!(first[0], first[1], "two delays");
    assert_ne!(first[0], first[2], "two seeds");
    // Five deviations of 400 draws at 0.33 are 47.
    assert!((132 - 47..=132 + 47).contains(&first[0].len()), "{first:?}");
}

#[test]
fn each_receiver_loses_multicast_on_its_own_and_what_is_sent_is_counted_before() {
    let Some(lab) = lab::require(&["source", "member1", "member2"]) else {
        return;
    };
    lab.watch_udp("probe", &[7003]).unwrap();
    let profile =
        Profile::parse("wifi-multicast-broken --multicast-rate none --delay 1ms").unwrap();
    let members = ["member1", "member2"];
    let mut traces = members.map(|name| trace(lab.host(name), &[PORT, GROUP]));
    wait_members(&lab, 2);
    for host in lab.hosts() {
        // In the midst of a membership, which must not lapse.
        host.set_link(&profile).unwrap();
    }
    let before = lab.counters().unwrap();

    let to = format!("{GROUP}:{PORT}");
    probe(lab.host("source"), &["train", &to, "400", "2000", "100"]);

    let lines = |index| {
        let (up, down) = profile.seeds(index);
        (Line::new(profile.up, up), Line::new(profile.down, down))
    };
    let sent = survivors(&mut lines(0).0, Class::Multicast, 400);
    let expected = [1, 2].map(|index| {
        // What the source's own link lost is no frame of the others'.
        let through = survivors(&mut lines(index).1, Class::Multicast, sent.len());
        let through: Vec<usize> = through
            .iter()
            .map(|n| usize::try_from(*n).unwrap())
            .collect();
        let kept = sent
            .iter()
            .enumerate()
            .filter(|(place, _)| through.contains(place));
        kept.map(|(_, number)| *number).collect::<BTreeSet<u32>>()
    });
    let all: usize = expected.iter().map(BTreeSet::len).sum();
    let all = u64::try_from(all).unwrap();
    let counted = lab
        .wait_counters("all multicast", &before, PATIENCE, |counted| {
            counted.udp_total("probe").to.packets >= all
        })
        .unwrap();
    assert_eq!(counted.udp("probe", "source").from.packets, 400);
    assert_eq!(counted.udp("probe", "source").from.bytes, 400 * 128);
    assert_eq!(counted.udp_total("probe").to.packets, all);
    let came = [0, 1].map(|index| numbers(&finish(&mut traces[index])));
    assert_eq!(came, expected);
    assert_ne!(came[0], came[1], "each on its own");
    for came in &came {
        // Five deviations of 400 draws at 0.6 are 49.
        assert!((160 - 49..=160 + 49).contains(&came.len()), "{came:?}");
    }
}

#[test]
fn a_link_changes_under_way_and_a_cut_still_cuts() {
    let Some(lab) = lab::require(&["a", "b"]) else {
        return;
    };
    let (a, b) = (lab.host("a"), lab.host("b"));
    let echo = b.spawn(Command::new(PROBE).args(["echo", "7000"])).unwrap();
    echo.wait_line(|line| line == "ready", PATIENCE).unwrap();
    let ping = || probe(a, &["ping", "10.77.0.2:7000", "5"]);
    assert_eq!(ping(), "answered 5");

    // A ping waits for a tenth of a second.
    b.set_link(&Profile::parse("lan --delay 40 ms").unwrap())
        .unwrap();
    assert_eq!(ping(), "answered 5");
    b.set_link(&Profile::parse("lan --delay 60 ms").unwrap())
        .unwrap();
    assert_eq!(ping(), "answered 0");
    b.set_link(&Profile::parse("lan --mtu 31 B").unwrap())
        .unwrap();
    let before = b.books().down.too_large;
    assert_eq!(ping(), "answered 0");
    // The late answers to the pings before meet a closed port, of which b is told.
    assert!(b.books().down.too_large - before >= 5);
    b.clear_link().unwrap();
    assert_eq!(ping(), "answered 5");
    b.cut().unwrap();
    assert_eq!(ping(), "answered 0");
    b.heal().unwrap();
    assert_eq!(ping(), "answered 5");
}

#[test]
fn a_plain_user_has_the_same_wire() {
    if lab::require(&["a"]).is_none() {
        return;
    }
    let mut command = Command::new("setpriv");
    command.args([
        "--reuid=65534",
        "--regid=65534",
        "--clear-groups",
        PROBE,
        "wire",
    ]);
    let off = std::fs::read_to_string("/proc/sys/user/max_user_namespaces")
        .is_ok_and(|value| value.trim() == "0");
    if off {
        assert!(std::env::var_os("CI").is_none(), "user namespaces are off");
        eprintln!("!!!! SKIPPED, NOTHING PROVEN: user namespaces are off on this machine");
        return;
    }

    let output = command.current_dir("/").output().unwrap();

    let said = String::from_utf8_lossy(&output.stdout).into_owned();
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{said}{errors}");
    assert!(said.contains("rights UserNamespace"), "{said}");
    let words = said.split_whitespace();
    let figures: Vec<u64> = words.filter_map(|word| word.parse().ok()).collect();
    let [answered, took] = figures.as_slice() else {
        panic!("{said}");
    };
    // An answer that a loaded machine has later than after a tenth of a second is none.
    assert!(*answered >= 10, "{said}");
    assert!(*took >= 20 * 40, "20 ms each way, 20 times: {said}");
    assert!(
        errors.contains("user-space wire over AF_PACKET"),
        "{errors}"
    );
}

/// Lets both hosts learn the other's address.
fn meet(lab: &Lab) {
    let echo = lab
        .host("b")
        .spawn(Command::new(PROBE).args(["echo", "7000"]))
        .unwrap();
    echo.wait_line(|line| line == "ready", PATIENCE).unwrap();
    let said = probe(lab.host("a"), &["ping", "10.77.0.2:7000", "1"]);
    assert_eq!(said, "answered 1");
}

/// Sends a train of datagrams and returns what came, once nothing is on the way any more.
fn run(
    lab: &Lab,
    from: &str,
    to: &str,
    count: u32,
    interval: Duration,
    bytes: usize,
) -> Vec<Arrival> {
    let mut trace = trace(lab.host(to), &[PORT]);
    let before = lab.counters().unwrap();
    let gone = || {
        let books = lab.host("b").books();
        let lost = books.up.lost + books.up.queue_full + books.down.lost + books.down.queue_full;
        lost + lab.host("b").overruns()
    };
    let gone_before = gone();
    let words = [
        "train".to_owned(),
        format!("{}:{PORT}", lab.host(to).address()),
        count.to_string(),
        interval.as_micros().to_string(),
        bytes.to_string(),
    ];
    probe(lab.host(from), &words.each_ref().map(String::as_str));
    lab.wait_counters("the train", &before, PATIENCE, |counted| {
        counted.udp("probe", to).to.packets + gone() - gone_before >= u64::from(count)
    })
    .unwrap();
    finish(&mut trace)
}

fn trace(host: Host<'_>, words: &[&str]) -> Process {
    let trace = host
        .spawn(Command::new(PROBE).arg("trace").args(words))
        .unwrap();
    trace.wait_line(|line| line == "ready", PATIENCE).unwrap();
    trace
}

fn finish(trace: &mut Process) -> Vec<Arrival> {
    trace.close_input();
    trace.wait_line(|line| line == "end", PATIENCE).unwrap();
    let lines = trace.output();
    let numbers = lines.lines().filter_map(|line| {
        let words: Vec<u64> = line
            .split(' ')
            .filter_map(|word| word.parse().ok())
            .collect();
        let [number, delay, at] = words.as_slice() else {
            return None;
        };
        Some(Arrival {
            number: u32::try_from(*number).unwrap(),
            delay: Duration::from_nanos(*delay),
            at: Duration::from_nanos(*at),
        })
    });
    numbers.collect()
}

/// The numbers of the frames of one class that chance lets through on a line.
fn survivors(line: &mut Line, class: Class, count: usize) -> BTreeSet<u32> {
    let survives = |number: &u32| {
        // So seldom that no queue fills.
        let now = Duration::from_secs(u64::from(*number));
        line.carry(100, class, now).count() > 0
    };
    (0..u32::try_from(count).unwrap())
        .filter(survives)
        .collect()
}

fn numbers(came: &[Arrival]) -> BTreeSet<u32> {
    came.iter().map(|arrival| arrival.number).collect()
}

fn median(came: &[Arrival]) -> Duration {
    let mut delays: Vec<Duration> = came.iter().map(|arrival| arrival.delay).collect();
    delays.sort();
    delays[delays.len() / 2]
}

#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "a few thousand"
)]
fn real_count(count: f64) -> u32 {
    count as u32
}

/// Waits until the switch knows this many member ports of the group.
fn wait_members(lab: &Lab, ports: usize) {
    let start = std::time::Instant::now();
    loop {
        let members = lab.switch("bridge mdb show dev br0").unwrap();
        if members.matches(GROUP).count() >= ports {
            return;
        }
        assert!(start.elapsed() < PATIENCE, "{ports} members in {members}");
    }
}

fn probe(host: Host<'_>, words: &[&str]) -> String {
    let output = host.exec(Command::new(PROBE).args(words)).unwrap();
    assert!(output.status.success(), "{}", output.stderr);
    output.stdout.trim().to_owned()
}
