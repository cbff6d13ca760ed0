//! Whole outputs for given facts, at least one for each check that can be other than well.

use std::collections::BTreeMap;
use std::net::Ipv4Addr;
use std::path::PathBuf;

use super::facts::{Clock, Daemon, Host, Interface, Offload, Own, Silence, System};
use super::*;

const NOW_NS: u64 = 1_000_000_000_000;
const SECOND_NS: u64 = 1_000_000_000;

/// A host that is well, and sees another that is well.
fn well() -> Facts {
    Facts {
        daemon: Ok(Daemon {
            host: "robot1".to_owned(),
            domain: 7,
            socket: "/run/ddx/7/robot1.sock".into(),
            own: Own {
                key: true,
                control: vec!["10.0.0.1:40001".parse().unwrap()],
                data_port: Some(40002),
                beacon: true,
                receive_buffer_bytes: Some(4_194_304),
                files_max: Some(65_536),
                pid: Some(4211),
                version: "0.1.0".to_owned(),
            },
            hosts: vec![other("base")],
            clocks: BTreeMap::from([("base".to_owned(), clock(160_000))]),
            counters: BTreeMap::from([
                ("control_sent_datagrams".to_owned(), 900),
                ("control_strangers".to_owned(), 1),
                ("data_refused_unwanted_stream".to_owned(), 12),
                ("data_refused_forged".to_owned(), 0),
            ]),
            now_ns: NOW_NS,
        }),
        directory: "/run/ddx".into(),
        directory_writable: true,
        sockets: vec!["/run/ddx/7/robot1.sock".into()],
        system: System {
            release: "6.8.0-45-generic".to_owned(),
            cores: 4,
            memory: Ok(()),
            offload: Ok(Offload {
                sent: 64,
                received: 64,
            }),
            rmem_max: Some(8_388_608),
            wmem_max: Some(8_388_608),
            memberships_max: Some(20),
            files: (Some(1024), Some(65_536)),
        },
        interfaces: vec![Interface {
            name: "eth0".to_owned(),
            address: Ipv4Addr::new(10, 0, 0, 1),
            loopback: false,
            up: true,
            multicast: Some(true),
            mtu: Some(1500),
        }],
        drops: BTreeMap::from([(40002, 0), (53, 9)]),
    }
}

fn other(name: &str) -> Host {
    Host {
        host: name.to_owned(),
        state: "up".to_owned(),
        addr: Some("10.0.0.2:40001".parse().unwrap()),
        rtt_us: Some(312),
        since: NOW_NS - 300 * SECOND_NS,
        multicast_in: Some(NOW_NS - 2 * SECOND_NS),
        multicast_out: Some(NOW_NS - 3 * SECOND_NS),
    }
}

fn clock(bound_ns: u64) -> Clock {
    Clock {
        host: "base".to_owned(),
        offset_ns: -1_250_000_000,
        bound_ns,
    }
}

/// What is said of a host that is well but for `change`, without the lines of checks that are well.
#[track_caller]
fn check(change: impl FnOnce(&mut Facts), expected: &[&str]) {
    let mut facts = well();
    change(&mut facts);
    let mut findings = judge::all(&facts);
    findings.retain(|found| found.level != Level::Ok);
    let mut said = lines(&findings);
    said.pop();
    assert_eq!(said, expected);
}

/// The same with a daemon that is well but for `change`.
#[track_caller]
fn check_daemon(change: impl FnOnce(&mut Daemon), expected: &[&str]) {
    check(|facts| change(facts.daemon.as_mut().unwrap()), expected);
}

#[test]
fn a_host_that_is_well_is_told_so_with_its_figures() {
    assert_eq!(
        lines(&judge::all(&well())),
        [
            "ok    daemon          ddx 0.1.0 with pid 4211 serves host robot1 in domain 7 at /run/ddx/7/robot1.sock",
            "ok    key             the daemon has one, and speaks to hosts that have the same",
            "ok    kernel          Linux 6.8.0-45-generic, 4 cores",
            "ok    memory          can be shared and sealed (memfd)",
            "ok    files           the daemon may open 65536 files, two for each item; a program started here 1024",
            "ok    offload         64 datagrams in one call to send (UDP GSO), 64 to receive (GRO)",
            "ok    buffers         4.19 MB may wait to be received, as asked; net.core.rmem_max is 8.39 MB, wmem_max 8.39 MB",
            "ok    groups          up to 16 are joined on 1 interface, net.ipv4.igmp_max_memberships is 20",
            "ok    interface eth0  10.0.0.1, MTU 1500, up, with multicast",
            "ok    host base       up for 5 min 0 s at 10.0.0.2:40001, round trip 312 us, its boot clock -1.25 s ± 160 us",
            "ok    multicast       passes from and to each host",
            "all is well",
        ]
    );
}

#[test]
fn without_a_daemon_what_needs_none_is_still_checked() {
    let mut facts = well();
    facts.daemon = Err(Silence {
        reason: "no daemon runs here: no socket below `/run/ddx`".to_owned(),
        hint: Some("start one with `ddx up`, or set DDX_SOCKET".to_owned()),
    });
    facts.sockets.clear();
    facts.directory_writable = false;

    assert_eq!(
        lines(&judge::all(&facts)),
        [
            "fail  daemon          no daemon runs here: no socket below `/run/ddx`; what follows needs none",
            "      hint: start one with `ddx up`, or set DDX_SOCKET",
            "warn  sockets         /run/ddx cannot be written by this user, so that `ddx up` cannot make its socket there",
            "      hint: `sudo install -d -o $USER /run/ddx`, or set XDG_RUNTIME_DIR, or choose another place by `ddx up --socket PATH`",
            "ok    kernel          Linux 6.8.0-45-generic, 4 cores",
            "ok    memory          can be shared and sealed (memfd)",
            "ok    files           the daemon may open 65536 files, two for each item; a program started here 1024",
            "ok    offload         64 datagrams in one call to send (UDP GSO), 64 to receive (GRO)",
            "ok    buffers         4.19 MB may wait to be received, as asked; net.core.rmem_max is 8.39 MB, wmem_max 8.39 MB",
            "ok    groups          up to 16 are joined on 1 interface, net.ipv4.igmp_max_memberships is 20",
            "ok    interface eth0  10.0.0.1, MTU 1500, up, with multicast",
            "1 check failed, 1 thing could be better",
        ]
    );
}

#[test]
fn without_a_key_nothing_of_the_network_matters() {
    let mut facts = well();
    let daemon = facts.daemon.as_mut().unwrap();
    daemon.own = Own {
        pid: Some(1),
        ..Own::default()
    };
    daemon.hosts.clear();
    facts.system.rmem_max = Some(212_992);
    facts.system.memberships_max = Some(1);
    facts.drops.insert(7407, 5);

    let findings = judge::all(&facts);

    let checks: Vec<&str> = findings.iter().map(|found| found.check).collect();
    assert_eq!(checks, ["daemon", "key", "kernel", "memory", "files"]);
    assert!(findings.iter().all(|found| found.level == Level::Ok));
    let hint = findings[1].hint.as_deref().unwrap();
    assert!(hint.contains("`ddx up --key FILE`"), "{hint}");
}

#[test]
fn several_daemons_are_listed() {
    let mut facts = well();
    facts.sockets.push(PathBuf::from("/run/ddx/7/sim.sock"));

    let said = lines(&judge::all(&facts));

    assert_eq!(
        said[1].split_once("sockets").unwrap().1.trim_start(),
        "2 daemons serve this machine, choose by --socket or DDX_SOCKET: /run/ddx/7/robot1.sock, /run/ddx/7/sim.sock"
    );
}

#[test]
fn what_the_kernel_does_not_grant() {
    check(
        |facts| facts.system.memory = Err("Operation not permitted".to_owned()),
        &[
            "fail  memory  cannot be shared and sealed (memfd): Operation not permitted",
            "      hint: Linux 5.1 or later is needed; in a container, allow `memfd_create` and `fcntl` in its seccomp profile",
        ],
    );
    check_daemon(
        |daemon| daemon.own.files_max = Some(1024),
        &[
            "warn  files  the daemon may open 1024 files, two for each item; a program started here 1024",
            "      hint: `sudo prlimit --nofile=65536 --pid $$` in the shell before `ddx up`; under systemd `LimitNOFILE=65536`, as in deploy/ddx.service",
        ],
    );
    check(
        |facts| {
            facts.system.offload = Ok(Offload {
                sent: 1,
                received: 64,
            });
        },
        &[
            "warn  offload  no UDP GSO: each datagram costs a call, some ten times the work",
            "      hint: Linux 5.0 or later has both",
        ],
    );
    check(
        |facts| facts.system.offload = Err("Address family not supported by protocol".to_owned()),
        &[
            "fail  offload  no UDP socket can be opened: Address family not supported by protocol",
            "      hint: in a container or unit, allow AF_INET (`RestrictAddressFamilies=`)",
        ],
    );
    let mut old = well();
    old.system.release = "5.15.0".to_owned();
    let said = lines(&judge::all(&old));
    assert!(
        said.iter().any(|line| line.ends_with(
            "Linux 5.15.0, 4 cores; before Linux 6.5 a dead writer whose child holds its socket counts as living"
        )),
        "{said:#?}"
    );
}

#[test]
fn buffers_that_are_too_small_tell_a_low_limit_from_an_old_daemon() {
    check(
        |facts| {
            facts.system.rmem_max = Some(212_992);
            facts.daemon.as_mut().unwrap().own.receive_buffer_bytes = Some(212_992);
        },
        &[
            "warn  buffers  only 213 kB of 4.19 MB may wait to be received, so that bursts are lost; net.core.rmem_max is 213 kB, wmem_max 8.39 MB",
            "      hint: `sudo sysctl -w net.core.rmem_max=8388608`, then restart the daemon; deploy/ddx.sysctl in /etc/sysctl.d/60-ddx.conf keeps it",
        ],
    );
    check_daemon(
        |daemon| daemon.own.receive_buffer_bytes = Some(212_992),
        &[
            "warn  buffers  only 213 kB of 4.19 MB may wait to be received, so that bursts are lost; net.core.rmem_max is 8.39 MB, wmem_max 8.39 MB",
            "      hint: restart the daemon: the limit was raised after its start",
        ],
    );
    check(
        |facts| {
            facts.drops.extend([(40002, 17), (7907, 3)]);
        },
        &[
            "warn  drops samples by unicast  17 datagrams were lost because the buffer of UDP port 40002 was full",
            "      hint: the machine is too busy, or the buffers are too small: see `buffers`; `top -H` shows whether `ddx-rx` gets a core",
            "warn  drops samples by multicast  3 datagrams were lost because the buffer of UDP port 7907 was full",
            "      hint: the machine is too busy, or the buffers are too small: see `buffers`; `top -H` shows whether `ddx-rx` gets a core",
        ],
    );
}

#[test]
fn interfaces_that_do_not_carry_what_they_should() {
    check(
        |facts| facts.interfaces[0].up = false,
        &[
            "warn  interface eth0  10.0.0.1, MTU 1500, down: nothing passes",
            "      hint: `sudo ip link set eth0 up`; if it is up: its cable or radio",
        ],
    );
    check(
        |facts| facts.interfaces[0].multicast = Some(false),
        &[
            "warn  interface eth0  10.0.0.1, MTU 1500, without multicast",
            "      hint: `sudo ip link set eth0 multicast on`; a VPN often carries none: then `ddx up --join udp/ADDRESS`",
        ],
    );
    check(
        |facts| facts.interfaces[0].mtu = Some(1200),
        &[
            "warn  interface eth0  10.0.0.1, MTU 1200, less than 1228: each full datagram travels in pieces",
            "      hint: `sudo ip link set eth0 mtu 1228`, or more",
        ],
    );
    check(
        |facts| facts.interfaces[0].loopback = true,
        &[
            "warn  interface  none but the loopback: no other machine can be reached",
            "      hint: `ip -brief address` shows what is up; the daemon uses what `--iface` names, else each but the loopback",
        ],
    );
    check_daemon(
        |daemon| daemon.own.control.push("10.9.9.9:40001".parse().unwrap()),
        &[
            "warn  interface  the daemon uses 10.9.9.9, which no interface has any more",
            "      hint: restart the daemon once the interface is up: `ip -brief address`",
        ],
    );
    check(
        |facts| {
            let second = Interface {
                name: "wlan0".to_owned(),
                address: Ipv4Addr::new(10, 1, 0, 1),
                ..facts.interfaces[0].clone()
            };
            facts.interfaces.push(second);
            let daemon = facts.daemon.as_mut().unwrap();
            daemon.own.control.push("10.1.0.1:40001".parse().unwrap());
        },
        &[
            "warn  groups  up to 32 are joined on 2 interfaces, but net.ipv4.igmp_max_memberships is 20: the rest comes by unicast, or not",
            "      hint: `sudo sysctl -w net.ipv4.igmp_max_memberships=256`, then restart the daemon; deploy/ddx.sysctl in /etc/sysctl.d/60-ddx.conf keeps it",
        ],
    );
}

#[test]
fn hosts_that_do_not_answer_or_are_not_there() {
    check_daemon(
        |daemon| {
            daemon.hosts[0].state = "unreachable".to_owned();
            daemon.hosts[0].since = NOW_NS - 12 * SECOND_NS;
        },
        &[
            "warn  host base  unreachable for 12.0 s, last at 10.0.0.2:40001",
            "      hint: `ping 10.0.0.2`, then `ddx doctor` there",
        ],
    );
    check_daemon(|daemon| daemon.hosts[0].state = "left".to_owned(), &[]);
    check_daemon(
        |daemon| daemon.hosts.clear(),
        &[
            "warn  hosts  no other host is known",
            "      hint: the others need the same key and `--domain 7`; where multicast is blocked, name one: `ddx up --join udp/ADDRESS`",
        ],
    );
    check_daemon(
        |daemon| daemon.hosts.push(other("robot1~4f2a")),
        &[
            "warn  prefix robot1~4f2a  two hosts are called robot1; the items of this one are under `robot1~4f2a/` here",
            "      hint: start one of them under another name: `ddx up --host NAME`",
        ],
    );
}

#[test]
fn a_clock_is_coarse_by_its_link_but_not_for_want_of_readers() {
    check_daemon(
        |daemon| {
            daemon.hosts[0].rtt_us = Some(41_000);
            daemon.clocks.insert("base".to_owned(), clock(20_800_000));
        },
        &[
            "warn  clock base  the ages of its samples are known to ± 20.8 ms only",
            "      hint: the bound is half the shortest round trip: look at the link; on Wi-Fi `sudo iw dev IFACE set power_save off` on both",
        ],
    );
    let mut idle = well();
    let daemon = idle.daemon.as_mut().unwrap();
    daemon.clocks.insert("base".to_owned(), clock(60_400_000));
    let said = lines(&judge::all(&idle));
    assert!(
        said.iter()
            .any(|line| line.ends_with("± 60.4 ms, growing while nothing is read from it")),
        "{said:#?}"
    );
    assert_eq!(said.last().unwrap(), "all is well");
}

#[test]
fn multicast_that_does_not_pass_is_told_by_direction() {
    check_daemon(
        |daemon| daemon.hosts[0].multicast_out = None,
        &[
            "warn  multicast  does not pass from robot1 to base",
            "      hint: `ddx doctor multicast` says more",
        ],
    );
    let mut young = well();
    let host = &mut young.daemon.as_mut().unwrap().hosts[0];
    (host.since, host.multicast_in) = (NOW_NS - SECOND_NS, None);
    let said = lines(&judge::all(&young));
    assert!(
        said.iter().any(|line| line.ends_with("passes in 1 of 2 directions, the others are not known yet")),
        "{said:#?}"
    );
}

#[test]
fn each_counter_that_means_trouble_has_its_meaning() {
    check_daemon(
        |daemon| {
            daemon
                .counters
                .extend([("data_unsent_datagrams".to_owned(), 4)]);
        },
        &[
            "warn  counter data_unsent_datagrams  4 since the daemon started: datagrams that the kernel did not take, because its queue was full or there was no route",
            "      hint: `ip route get 239.255.0.0` and `ip -brief address`; if both are well: more is sent than the link takes",
        ],
    );
    check_daemon(
        |daemon| {
            daemon
                .counters
                .extend([("control_refused_foreign_domain".to_owned(), 40)]);
        },
        &[
            "warn  counter control_refused_foreign_domain  40 since the daemon started: datagrams sealed with another key: another fleet, or a host with an old key, uses this domain's number",
            "      hint: compare the key files (`sha256sum`), or take another number than 7: `ddx up --domain N`",
        ],
    );
    for name in [
        "control_unsent_datagrams",
        "data_stale_samples",
        "data_refused_samples",
        "data_untold_notices",
        "data_refused_streams",
        "control_stale_lives",
        "control_over_limit",
        "control_membership_refused",
        "control_directory_full",
        "control_refused_truncated",
        "control_refused_other_protocol_version",
        "control_refused_wrong_lane",
        "data_refused_replayed",
        "data_refused_forged",
        "control_refused_malformed",
    ] {
        let mut facts = well();
        let daemon = facts.daemon.as_mut().unwrap();
        daemon.counters.insert(name.to_owned(), 1);

        let findings = judge::all(&facts);

        let found: Vec<&Finding> = findings.iter().filter(|f| f.level != Level::Ok).collect();
        assert_eq!(found.len(), 1, "{name}");
        assert_eq!(
            (found[0].check, found[0].subject.as_str()),
            ("counter", name)
        );
    }
}

mod multicast_table {
    use super::multicast::{Passes, lines, ways};
    use super::*;

    /// What is shown of a daemon that sees base and the hosts that `change` adds.
    #[track_caller]
    fn check(change: impl FnOnce(&mut Daemon), expected: &[&str]) {
        let mut daemon = well().daemon.unwrap();
        change(&mut daemon);
        let mut said = lines(&daemon, &ways(&daemon));
        assert_eq!(
            said.pop().unwrap(),
            "seen from robot1: run it on another host for the ways that do not begin or end here"
        );
        assert_eq!(said, expected);
    }

    #[test]
    fn all_ways_that_pass_say_when_they_last_did() {
        check(
            |_| {},
            &[
                "FROM    TO      MULTICAST",
                "base    robot1  yes, 2.00 s ago",
                "robot1  base    yes, 3.00 s ago",
            ],
        );
    }

    #[test]
    fn a_way_that_is_blocked_names_its_causes() {
        check(
            |daemon| daemon.hosts[0].multicast_in = Some(NOW_NS - 60 * SECOND_NS),
            &[
                "FROM    TO      MULTICAST",
                "base    robot1  no, last 60.0 s ago",
                "robot1  base    yes, 3.00 s ago",
                "hint: base is not heard by robot1: its firewall (on robot1: `sudo ufw allow 7407,7907/udp`), then a switch that snoops on IGMP without a querier, or an access point that filters multicast; until then samples go by unicast, once to each host",
            ],
        );
        check(
            |daemon| {
                daemon.hosts[0].multicast_in = None;
                daemon.hosts[0].multicast_out = None;
            },
            &[
                "FROM    TO      MULTICAST",
                "base    robot1  no",
                "robot1  base    no",
                "hint: nothing passes between robot1 and base: a firewall (on both: `sudo ufw allow 7407,7907/udp`), an access point that isolates its clients, a switch that snoops on IGMP without a querier, or a VPN or cloud that carries no multicast (then `ddx up --join udp/10.0.0.2`); until then samples go by unicast, once to each host",
            ],
        );
    }

    #[test]
    fn what_cannot_be_told_is_not_called_blocked() {
        check(
            |daemon| {
                daemon.hosts[0].since = NOW_NS - 5 * SECOND_NS;
                daemon.hosts[0].multicast_in = None;
                daemon.hosts.push(Host {
                    multicast_in: None,
                    multicast_out: None,
                    ..other("hearsay")
                });
                daemon.hosts.push(Host {
                    state: "down".to_owned(),
                    multicast_in: Some(NOW_NS - 9 * SECOND_NS),
                    multicast_out: None,
                    ..other("robot2")
                });
                daemon.hosts.push(Host {
                    state: "left".to_owned(),
                    ..other("robot3")
                });
            },
            &[
                "FROM     TO       MULTICAST",
                "base     robot1   unknown: it came only now, ask again",
                "robot1   base     yes, 3.00 s ago",
                "hearsay  robot1   unknown: known only from what others say",
                "robot1   hearsay  unknown: known only from what others say",
                "robot2   robot1   unknown: it does not answer at all",
                "robot1   robot2   unknown: it does not answer at all",
            ],
        );
        check(
            |daemon| daemon.own.beacon = false,
            &[
                "FROM    TO      MULTICAST",
                "base    robot1  unknown: this host runs with `beacon = false`",
                "robot1  base    unknown: this host runs with `beacon = false`",
            ],
        );
    }

    #[test]
    fn in_a_large_domain_an_answer_may_take_longer() {
        let mut daemon = well().daemon.unwrap();
        for number in 0..19 {
            let host = format!("h{number}");
            daemon.clocks.insert(host, clock(160_000));
        }
        daemon.hosts[0].multicast_out = Some(NOW_NS - 60 * SECOND_NS);
        daemon.hosts[0].multicast_in = Some(NOW_NS - 60 * SECOND_NS);

        let ways = ways(&daemon);

        assert!(matches!(ways[0].passes, Passes::No { .. }), "{ways:?}");
        assert!(matches!(ways[1].passes, Passes::Yes { .. }), "{ways:?}");
    }
}
