//! What the laboratory promises, shown with the smallest programs.

#![expect(
    clippy::unwrap_used,
    reason = "a helper of a test fails the test, as the test itself would"
)]

use std::collections::BTreeSet;
use std::fs;
use std::io::{BufRead, BufReader};
use std::panic::{self, AssertUnwindSafe};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use ddx_rig::lab::{self, Counters, Host, Loss};

const PROBE: &str = env!("CARGO_BIN_EXE_lab_probe");
const PATIENCE: Duration = Duration::from_secs(10);
const GROUP: &str = "239.77.0.1";

#[test]
fn two_hosts_talk_and_every_datagram_is_counted_on_both_links() {
    let Some(lab) = lab::require(&["a", "b"]) else {
        return;
    };
    let (a, b) = (lab.host("a"), lab.host("b"));
    let echo = b.spawn(Command::new(PROBE).args(["echo", "7000"])).unwrap();
    echo.wait_line(|line| line == "ready", PATIENCE).unwrap();
    lab.watch_udp("echo", &[7000]).unwrap();
    let before = lab.counters().unwrap();

    let said = probe(a, &["ping", "10.77.0.2:7000", "10"]);

    assert_eq!(said, "answered 10");
    let counted = lab.counters().unwrap().since(&before);
    // 4 bytes of payload, 8 of UDP, 20 of IP.
    for traffic in [counted.udp("echo", "a"), counted.udp("echo", "b")] {
        assert_eq!((traffic.from.packets, traffic.to.packets), (10, 10));
        assert_eq!((traffic.from.bytes, traffic.to.bytes), (320, 320));
    }
    assert_eq!(counted.udp_total("echo").from.packets, 20);
    assert!(counted.link("a").from.packets >= 10);
}

#[test]
fn a_host_has_its_own_name_directories_and_address() {
    let Some(lab) = lab::require(&["robot1", "base"]) else {
        return;
    };
    let robot = lab.host("robot1");

    robot
        .shell("touch /run/x /tmp/x /dev/shm/x /var/lib/ddx/x")
        .unwrap();

    assert_eq!(robot.shell("uname -n").unwrap().trim(), "robot1");
    assert_eq!(
        lab.host("base")
            .shell("find /run /tmp /dev/shm /var/lib/ddx -name x")
            .unwrap(),
        ""
    );
    assert!(!Path::new("/var/lib/ddx/x").exists() && !Path::new("/dev/shm/x").exists());
    assert!(
        robot
            .shell("ip -4 address show eth0")
            .unwrap()
            .contains(&robot.address().to_string())
    );
}

#[test]
fn a_cut_link_is_silent_and_a_healed_one_talks_again() {
    let Some(lab) = lab::require(&["a", "b"]) else {
        return;
    };
    let (a, b) = (lab.host("a"), lab.host("b"));
    let echo = b.spawn(Command::new(PROBE).args(["echo", "7000"])).unwrap();
    echo.wait_line(|line| line == "ready", PATIENCE).unwrap();
    assert_eq!(probe(a, &["ping", "10.77.0.2:7000", "2"]), "answered 2");

    b.cut().unwrap();
    let while_cut = probe(a, &["ping", "10.77.0.2:7000", "3"]);
    b.heal().unwrap();
    let after = probe(a, &["ping", "10.77.0.2:7000", "3"]);

    assert_eq!(
        (while_cut.as_str(), after.as_str()),
        ("answered 0", "answered 3")
    );
}

#[test]
fn one_packet_in_three_is_lost_one_way_and_none_the_other() {
    let Some(lab) = lab::require(&["a", "b"]) else {
        return;
    };
    lab.watch_udp("probe", &[7001]).unwrap();
    lab.host("a")
        .set_loss(Loss {
            from_percent: 33,
            to_percent: 0,
        })
        .unwrap();
    let before = lab.counters().unwrap();

    probe(lab.host("a"), &["send", "10.77.0.2:7001", "3000"]);
    probe(lab.host("b"), &["send", "10.77.0.1:7001", "500"]);

    let counted = lab.counters().unwrap().since(&before);
    assert_eq!(
        counted.udp("probe", "a").from.packets,
        3000,
        "what is sent is counted before it is lost"
    );
    // Five standard deviations of 3000 draws at 0.33 are 129: chance fails this once in a million runs.
    let lost = 3000 - counted.udp("probe", "b").to.packets;
    assert!(
        (990 - 129..=990 + 129).contains(&lost),
        "{lost} of 3000 lost"
    );
    assert_eq!(counted.udp("probe", "a").to.packets, 500);
}

#[test]
fn a_run_of_segments_is_fast_and_counted_as_packets() {
    let Some(lab) = lab::require(&["a", "b"]) else {
        return;
    };
    let sink = lab
        .host("b")
        .spawn(Command::new(PROBE).args(["sink", "7005"]))
        .unwrap();
    sink.wait_line(|line| line == "ready", PATIENCE).unwrap();
    let before = lab.counters().unwrap();

    let said = probe(lab.host("a"), &["pour", "10.77.0.2:7005", "50000000"]);

    println!("TCP between two hosts: {said}");
    assert!(said.starts_with("50000000 in "), "{said}");
    let sent = lab.counters().unwrap().since(&before).link("a").from;
    // With the segmentation left to the device, 64 kB would pass the switch as one packet and be lost as one.
    assert!(sent.packets >= 50_000_000 / 1_460, "{sent:?}");
    assert!(sent.bytes <= sent.packets * 1_500, "{sent:?}");
}

#[test]
fn multicast_goes_once_to_each_member_and_to_nobody_else() {
    let Some(lab) = lab::require(&["source", "member1", "member2", "idle"]) else {
        return;
    };
    lab.watch_udp("group", &[7002]).unwrap();
    let mut members: Vec<_> = ["member1", "member2"]
        .into_iter()
        .map(|name| {
            lab.host(name)
                .spawn(Command::new(PROBE).args(["join", GROUP, "7002"]))
                .unwrap()
        })
        .collect();
    for member in &members {
        member.wait_line(|line| line == "joined", PATIENCE).unwrap();
    }
    wait_members(&lab, 2);
    let before = lab.counters().unwrap();

    probe(
        lab.host("source"),
        &["send", &format!("{GROUP}:7002"), "100"],
    );

    let counted = lab.counters().unwrap().since(&before);
    assert_eq!(counted.udp_total("group").from.packets, 100, "sent once");
    assert_eq!(received(&counted), [0, 100, 100, 0]);
    for member in &mut members {
        member.close_input();
        let said = member
            .wait_line(|line| line.starts_with("received"), PATIENCE)
            .unwrap();
        assert_eq!(said, "received 100");
    }
}

#[test]
fn multicast_without_members_is_pruned_from_the_first_moment() {
    let Some(lab) = lab::require(&["source", "idle"]) else {
        return;
    };
    lab.watch_udp("group", &[7002]).unwrap();

    probe(
        lab.host("source"),
        &["send", &format!("{GROUP}:7002"), "50"],
    );

    let counted = lab.counters().unwrap();
    assert_eq!(counted.udp("group", "source").from.packets, 50);
    assert_eq!(counted.udp("group", "idle").to.packets, 0);
}

#[test]
fn a_program_is_read_written_signalled_and_waited_for() {
    let Some(lab) = lab::require(&["a"]) else {
        return;
    };
    let script = "echo started; read word; echo got $word; echo oops >&2; exec sleep 1000";
    let mut program = lab
        .host("a")
        .spawn(Command::new("sh").args(["-c", script]).env("DDX_X", "1"))
        .unwrap();
    program
        .wait_line(|line| line == "started", PATIENCE)
        .unwrap();

    program.write_line("word").unwrap();
    program
        .wait_line(|line| line == "got word", PATIENCE)
        .unwrap();
    let missing = program
        .wait_line(|line| line == "never", Duration::from_millis(20))
        .unwrap_err();
    let status = program.kill().unwrap();

    assert!(missing.to_string().contains("oops"), "{missing}");
    assert_eq!(program.output(), "started\ngot word\n");
    assert_eq!(
        std::os::unix::process::ExitStatusExt::signal(&status),
        Some(9)
    );
    assert!(!program.is_running());
    let refused = lab
        .host("a")
        .exec(Command::new("sh").args(["-c", "exit 3"]))
        .unwrap();
    assert_eq!(refused.status.code(), Some(3));
}

#[test]
fn a_panic_in_a_test_leaves_nothing_behind() {
    let Some(lab) = lab::require(&["a", "b"]) else {
        return;
    };
    let namespaces = BTreeSet::from([
        lab.switch("readlink /proc/self/ns/net")
            .unwrap()
            .trim()
            .to_owned(),
        lab.host("a")
            .shell("readlink /proc/self/ns/net")
            .unwrap()
            .trim()
            .to_owned(),
    ]);
    let init = lab.init_pid();
    assert_eq!(alive(&namespaces), namespaces);

    let result = panic::catch_unwind(AssertUnwindSafe(move || {
        let _program = lab
            .host("a")
            .spawn(Command::new("sleep").arg("1000"))
            .unwrap();
        panic!("as a failing test does");
    }));

    assert!(result.is_err());
    wait_gone(&namespaces, init);
}

#[test]
fn a_killed_test_leaves_nothing_behind() {
    let Some(lab) = lab::require(&["a"]) else {
        return;
    };
    drop(lab);
    let mut holder = Command::new(PROBE);
    killed_holder_leaves_nothing(holder.args(["hold", "a", "b"]), None);
}

#[test]
fn a_plain_user_has_the_same_lab_in_a_user_namespace() {
    let Some(lab) = lab::require(&["a"]) else {
        return;
    };
    if lab.rights() == lab::Rights::UserNamespace {
        // This run is the plain user's already: every other test here has shown it.
        return;
    }
    drop(lab);
    let mut holder = Command::new("setpriv");
    holder.args([
        "--reuid=65534",
        "--regid=65534",
        "--clear-groups",
        PROBE,
        "hold",
        "a",
        "b",
    ]);
    let off = fs::read_to_string("/proc/sys/user/max_user_namespaces")
        .is_ok_and(|value| value.trim() == "0");
    if off {
        assert!(
            std::env::var_os("CI").is_none(),
            "user namespaces are off on this machine"
        );
        eprintln!("!!!! SKIPPED, NOTHING PROVEN: user namespaces are off on this machine");
        return;
    }
    killed_holder_leaves_nothing(&mut holder, Some("rights UserNamespace"));
}

/// Starts a process that holds a lab, kills it, and waits until its processes and namespaces are gone.
fn killed_holder_leaves_nothing(command: &mut Command, must_say: Option<&str>) {
    let mut holder = command
        .current_dir("/")
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let said = read_until_rights(&mut holder);
    let namespaces: BTreeSet<String> = said
        .iter()
        .filter_map(|line| line.strip_prefix("namespace "))
        .map(str::to_owned)
        .collect();
    let init: u32 = said
        .iter()
        .find_map(|line| line.strip_prefix("init "))
        .unwrap()
        .parse()
        .unwrap();
    assert_eq!(namespaces.len(), 5, "{said:?}");
    assert_eq!(
        alive(&namespaces),
        namespaces,
        "all are there before the kill"
    );
    if let Some(line) = must_say {
        assert!(said.iter().any(|said| said == line), "{said:?}");
    }

    holder.kill().unwrap();
    holder.wait().unwrap();

    wait_gone(&namespaces, init);
}

fn read_until_rights(holder: &mut Child) -> Vec<String> {
    let mut said = Vec::new();
    for line in BufReader::new(holder.stdout.take().unwrap()).lines() {
        let line = line.unwrap();
        let is_last = line.starts_with("rights");
        said.push(line);
        if is_last {
            break;
        }
    }
    said
}

/// Returns which of these namespaces some process of this machine is still in.
fn alive(namespaces: &BTreeSet<String>) -> BTreeSet<String> {
    let mut found = BTreeSet::new();
    for entry in fs::read_dir("/proc").unwrap().flatten() {
        for kind in ["net", "mnt"] {
            if let Ok(link) = fs::read_link(entry.path().join("ns").join(kind)) {
                let name = link.to_string_lossy().into_owned();
                if namespaces.contains(&name) {
                    found.insert(name);
                }
            }
        }
    }
    found
}

fn wait_gone(namespaces: &BTreeSet<String>, init: u32) {
    let until = Instant::now() + PATIENCE;
    while !alive(namespaces).is_empty() || Path::new(&format!("/proc/{init}")).exists() {
        assert!(
            Instant::now() < until,
            "still there: {:?}, init {init}",
            alive(namespaces)
        );
        std::thread::yield_now();
    }
}

fn probe(host: Host<'_>, words: &[&str]) -> String {
    let output = host.exec(Command::new(PROBE).args(words)).unwrap();
    assert!(output.status.success(), "{}", output.stderr);
    output.stdout.trim().to_owned()
}

/// Waits until the switch knows this many member ports of the group.
fn wait_members(lab: &lab::Lab, ports: usize) {
    let until = Instant::now() + PATIENCE;
    loop {
        let members = lab.switch("bridge mdb show dev br0").unwrap();
        if members.matches(GROUP).count() >= ports {
            return;
        }
        assert!(
            Instant::now() < until,
            "{ports} members of {GROUP} in {members}"
        );
    }
}

fn received(counted: &Counters) -> Vec<u64> {
    ["source", "member1", "member2", "idle"]
        .map(|host| counted.udp("group", host).to.packets)
        .to_vec()
}
