//! What the facts mean: one function for each check, none of which looks at anything itself.

use super::facts::{Daemon, Facts, Interface};
use super::{Finding, counters, others};
use crate::cli::render::bytes;
use crate::net::RECEIVE_BUFFER_BYTES;

/// How this host becomes one of several.
pub(super) const JOIN: &str =
    "`ddx key new > FILE`, copy it to each host, then `ddx up --key FILE` on each";

/// All findings, in the order in which they are shown.
pub(super) fn all(facts: &Facts) -> Vec<Finding> {
    let mut found = vec![daemon(facts)];
    found.extend(directory(facts));
    found.extend(key(facts));
    found.push(kernel(facts));
    found.push(memory(facts));
    found.push(files(facts));
    if facts.is_networked() {
        found.push(offload(facts));
        found.push(buffers(facts));
        found.push(memberships(facts));
        found.extend(interfaces(facts));
    }
    if let Ok(daemon) = facts.daemon.as_ref() {
        found.extend(drops(daemon, facts));
        found.extend(counters::judge(daemon));
        found.extend(others::judge(daemon));
    }
    found
}

fn daemon(facts: &Facts) -> Finding {
    match &facts.daemon {
        Ok(daemon) => {
            let pid = daemon
                .own
                .pid
                .map_or_else(String::new, |pid| format!(" with pid {pid}"));
            Finding::ok(
                "daemon",
                format!(
                    "ddx {}{pid} serves host {} in domain {} at {}",
                    daemon.own.version,
                    daemon.host,
                    daemon.domain,
                    daemon.socket.display()
                ),
            )
        }
        Err(silence) => Finding::fail(
            "daemon",
            format!("{}; what follows needs none", silence.reason),
            silence
                .hint
                .clone()
                .unwrap_or_else(|| "start one with `ddx up`".to_owned()),
        ),
    }
}

/// Only where there is something to say: sockets to choose from, or no place for one.
fn directory(facts: &Facts) -> Option<Finding> {
    let dir = facts.directory.display();
    if facts.sockets.len() > 1 {
        let all: Vec<String> = facts
            .sockets
            .iter()
            .map(|s| s.display().to_string())
            .collect();
        return Some(Finding::ok(
            "sockets",
            format!(
                "{} daemons serve this machine, choose by --socket or DDX_SOCKET: {}",
                all.len(),
                all.join(", ")
            ),
        ));
    }
    match &facts.daemon {
        Ok(_) => None,
        Err(_) if facts.directory_writable => Some(Finding::ok(
            "sockets",
            format!("{dir} can be written, a daemon would make its socket there"),
        )),
        Err(_) => Some(Finding::warn(
            "sockets",
            format!(
                "{dir} cannot be written by this user, so that `ddx up` cannot make its socket there"
            ),
            format!(
                "`sudo install -d -o $USER {dir}`, or set XDG_RUNTIME_DIR, or choose another place by `ddx up --socket PATH`"
            ),
        )),
    }
}

fn key(facts: &Facts) -> Option<Finding> {
    let daemon = facts.daemon.as_ref().ok()?;
    Some(if daemon.own.key {
        Finding::ok(
            "key",
            "the daemon has one, and speaks to hosts that have the same",
        )
    } else {
        // Not a fault: a host alone is whole.
        Finding {
            hint: Some(format!("to see other hosts: {JOIN}")),
            ..Finding::ok(
                "key",
                "none: this host serves itself only, and opens no socket on any network",
            )
        }
    })
}

fn kernel(facts: &Facts) -> Finding {
    let system = &facts.system;
    let cores = match system.cores {
        1 => "1 core".to_owned(),
        cores => format!("{cores} cores"),
    };
    let deaths = match version(&system.release) {
        Some(version) if version < PEER_PIDFD => {
            "; before Linux 6.5 a dead writer whose child holds its socket counts as living"
        }
        Some(_) | None => "",
    };
    Finding::ok(
        "kernel",
        format!("Linux {}, {cores}{deaths}", system.release),
    )
}

fn memory(facts: &Facts) -> Finding {
    match &facts.system.memory {
        Ok(()) => Finding::ok("memory", "can be shared and sealed (memfd)"),
        Err(error) => Finding::fail(
            "memory",
            format!("cannot be shared and sealed (memfd): {error}"),
            "Linux 5.1 or later is needed; in a container, allow `memfd_create` and `fcntl` in its seccomp profile",
        ),
    }
}

fn files(facts: &Facts) -> Finding {
    let (soft, hard) = facts.system.files;
    // The daemon raises its soft limit to the hard one when it starts.
    let most = match &facts.daemon {
        Ok(daemon) => daemon.own.files_max,
        Err(_) => hard,
    };
    let count =
        |files: Option<u64>| files.map_or_else(|| "any number of".to_owned(), |n| n.to_string());
    let text = format!(
        "the daemon may open {} files, two for each item; a program started here {}",
        count(most),
        count(soft)
    );
    match most {
        Some(most) if most < FILES_LEAST => Finding::warn(
            "files",
            text,
            "`sudo prlimit --nofile=65536 --pid $$` in the shell before `ddx up`; under systemd `LimitNOFILE=65536`, as in deploy/ddx.service",
        ),
        Some(_) | None => Finding::ok("files", text),
    }
}

fn offload(facts: &Facts) -> Finding {
    match &facts.system.offload {
        Ok(offload) if offload.sent > 1 && offload.received > 1 => Finding::ok(
            "offload",
            format!(
                "{} datagrams in one call to send (UDP GSO), {} to receive (GRO)",
                offload.sent, offload.received
            ),
        ),
        Ok(offload) => {
            let missing = match (offload.sent > 1, offload.received > 1) {
                (false, false) => "GSO and GRO",
                (false, true) => "GSO",
                (true, _) => "GRO",
            };
            Finding::warn(
                "offload",
                format!("no UDP {missing}: each datagram costs a call, some ten times the work"),
                "Linux 5.0 or later has both",
            )
        }
        Err(error) => Finding::fail(
            "offload",
            format!("no UDP socket can be opened: {error}"),
            "in a container or unit, allow AF_INET (`RestrictAddressFamilies=`)",
        ),
    }
}

fn buffers(facts: &Facts) -> Finding {
    let system = &facts.system;
    let asked = u64::try_from(RECEIVE_BUFFER_BYTES).unwrap_or(u64::MAX);
    let granted = facts
        .daemon
        .as_ref()
        .ok()
        .and_then(|d| d.own.receive_buffer_bytes);
    let limit = |limit: Option<u64>| limit.map_or_else(|| "?".to_owned(), bytes);
    let limits = format!(
        "net.core.rmem_max is {}, wmem_max {}",
        limit(system.rmem_max),
        limit(system.wmem_max)
    );
    let Some(has) = granted.or(system.rmem_max) else {
        let text = format!("how much may wait to be received is not known here: {limits}");
        return Finding::ok("buffers", text);
    };
    if has >= asked {
        return Finding::ok(
            "buffers",
            format!(
                "{} may wait to be received, as asked; {limits}",
                bytes(asked)
            ),
        );
    }
    let text = format!(
        "only {} of {} may wait to be received, so that bursts are lost; {limits}",
        bytes(has),
        bytes(asked)
    );
    let restart = "restart the daemon";
    if granted.is_some() && system.rmem_max.is_some_and(|max| max >= asked) {
        return Finding::warn(
            "buffers",
            text,
            format!("{restart}: the limit was raised after its start"),
        );
    }
    Finding::warn(
        "buffers",
        text,
        format!(
            "`sudo sysctl -w net.core.rmem_max={RMEM_MAX}`, then {restart}; deploy/ddx.sysctl in /etc/sysctl.d/60-ddx.conf keeps it"
        ),
    )
}

fn memberships(facts: &Facts) -> Finding {
    let interfaces = facts.used().len().max(1);
    let needed = u64::from(ddx_catalog::SAMPLE_GROUPS)
        .saturating_mul(u64::try_from(interfaces).unwrap_or(u64::MAX));
    let of = match interfaces {
        1 => "1 interface".to_owned(),
        several => format!("{several} interfaces"),
    };
    match facts.system.memberships_max {
        None => Finding::ok(
            "groups",
            format!("up to {needed} are joined on {of}; the limit is not known here"),
        ),
        Some(max) if max >= needed => Finding::ok(
            "groups",
            format!("up to {needed} are joined on {of}, net.ipv4.igmp_max_memberships is {max}"),
        ),
        Some(max) => Finding::warn(
            "groups",
            format!(
                "up to {needed} are joined on {of}, but net.ipv4.igmp_max_memberships is {max}: the rest comes by unicast, or not"
            ),
            "`sudo sysctl -w net.ipv4.igmp_max_memberships=256`, then restart the daemon; deploy/ddx.sysctl in /etc/sysctl.d/60-ddx.conf keeps it",
        ),
    }
}

fn interfaces(facts: &Facts) -> Vec<Finding> {
    let used = facts.used();
    let mut found: Vec<Finding> = used.iter().flat_map(|used| interface(used)).collect();
    if let Ok(daemon) = &facts.daemon {
        for at in &daemon.own.control {
            if !used.iter().any(|interface| at.ip() == interface.address) {
                found.push(Finding::warn(
                    "interface",
                    format!(
                        "the daemon uses {}, which no interface has any more",
                        at.ip()
                    ),
                    "restart the daemon once the interface is up: `ip -brief address`",
                ));
            }
        }
    }
    if found.is_empty() || used.iter().any(|interface| interface.loopback) {
        found.push(Finding::warn(
            "interface",
            "none but the loopback: no other machine can be reached",
            "`ip -brief address` shows what is up; the daemon uses what `--iface` names, else each but the loopback",
        ));
    }
    found
}

fn interface(interface: &Interface) -> Vec<Finding> {
    let Interface { name, address, .. } = interface;
    let mtu = interface
        .mtu
        .map_or_else(|| "?".to_owned(), |mtu| mtu.to_string());
    let says = |what: &str| format!("{address}, MTU {mtu}, {what}");
    let mut found = Vec::new();
    if interface.up {
        if interface.mtu.is_some_and(|mtu| mtu < MTU_LEAST) {
            let what = format!("less than {MTU_LEAST}: each full datagram travels in pieces");
            let hint = format!("`sudo ip link set {name} mtu {MTU_LEAST}`, or more");
            found.push(Finding::warn("interface", says(&what), hint));
        }
        // The loopback never says that it can, and does.
        if interface.multicast == Some(false) && !interface.loopback {
            let hint = format!(
                "`sudo ip link set {name} multicast on`; a VPN often carries none: then `ddx up --join udp/ADDRESS`"
            );
            found.push(Finding::warn("interface", says("without multicast"), hint));
        }
    } else {
        let hint = format!("`sudo ip link set {name} up`; if it is up: its cable or radio");
        found.push(Finding::warn(
            "interface",
            says("down: nothing passes"),
            hint,
        ));
    }
    if found.is_empty() {
        let what = match interface.multicast {
            Some(true) => "up, with multicast",
            Some(false) | None => "up",
        };
        found.push(Finding::ok("interface", says(what)));
    }
    found.into_iter().map(|found| found.of(name)).collect()
}

fn drops(daemon: &Daemon, facts: &Facts) -> Vec<Finding> {
    let domain = ddx_wire::DomainId(daemon.domain);
    let sockets = [
        ("samples by unicast", daemon.own.data_port),
        (
            "samples by multicast",
            Some(ddx_catalog::sample_group(domain, 0).port()),
        ),
        (
            "control",
            daemon.own.control.first().map(std::net::SocketAddr::port),
        ),
        ("beacons", Some(ddx_catalog::beacon_group(domain).port())),
    ];
    let mut found = Vec::new();
    for (what, port) in sockets.into_iter().filter(|_| daemon.own.key) {
        let dropped = port
            .and_then(|port| facts.drops.get(&port))
            .copied()
            .unwrap_or(0);
        if let (Some(port), true) = (port, dropped > 0) {
            found.push(
                Finding::warn(
                    "drops",
                    format!("{dropped} datagrams were lost because the buffer of UDP port {port} was full"),
                    "the machine is too busy, or the buffers are too small: see `buffers`; `top -H` shows whether `ddx-rx` gets a core",
                )
                .of(what),
            );
        }
    }
    found
}

/// The first two numbers of a kernel's release.
fn version(release: &str) -> Option<(u32, u32)> {
    let mut numbers = release.split(|c: char| !c.is_ascii_digit());
    Some((numbers.next()?.parse().ok()?, numbers.next()?.parse().ok()?))
}

/// The first Linux with `SO_PEERPIDFD`.
const PEER_PIDFD: (u32, u32) = (6, 5);
/// Files below which a daemon is soon full: 2,048 items.
const FILES_LEAST: u64 = 4_096;
/// As in `deploy/ddx.sysctl`.
const RMEM_MAX: u64 = 8_388_608;
/// A full datagram and the headers of UDP and IP.
const MTU_LEAST: u64 = 1_228;
