//! What the daemon knows of the other hosts means: whether they answer, how well their clocks are known, whether two have
//! one name, and whether multicast passes.

use super::Finding;
use super::facts::{Daemon, Host};
use super::multicast::{self, Passes, Way};
use crate::cli::render::span;

/// All findings about other hosts.
pub(super) fn judge(daemon: &Daemon) -> Vec<Finding> {
    let mut found = hosts(daemon);
    found.extend(clocks(daemon));
    found.extend(prefixes(daemon));
    found.extend(passes(daemon));
    found
}

/// Where to look when no other host is seen.
pub(super) fn meet(domain: u16) -> String {
    format!(
        "the others need the same key and `--domain {domain}`; where multicast is blocked, name one: `ddx up --join udp/ADDRESS`"
    )
}

fn hosts(daemon: &Daemon) -> Vec<Finding> {
    if daemon.hosts.is_empty() && daemon.own.key {
        return vec![Finding::warn(
            "hosts",
            "no other host is known",
            meet(daemon.domain),
        )];
    }
    daemon
        .hosts
        .iter()
        .map(|other| host(daemon, other))
        .collect()
}

fn host(daemon: &Daemon, host: &Host) -> Finding {
    let state = &host.state;
    let lasts = span(daemon.now_ns.saturating_sub(host.since));
    if state == "left" {
        return Finding::ok("host", format!("left {lasts} ago")).of(&host.host);
    }
    let at = host
        .addr
        .map_or_else(|| "?".to_owned(), |at| at.to_string());
    if state != "up" {
        let ping = host
            .addr
            .map_or_else(|| "?".to_owned(), |at| at.ip().to_string());
        return Finding::warn(
            "host",
            format!("{state} for {lasts}, last at {at}"),
            format!("`ping {ping}`, then `ddx doctor` there"),
        )
        .of(&host.host);
    }
    let rtt = host
        .rtt_us
        .map_or_else(|| "?".to_owned(), |us| span(us.saturating_mul(1_000)));
    let clock = daemon.clocks.get(&host.host).map_or_else(
        || "?".to_owned(),
        |clock| {
            let sign = if clock.offset_ns < 0 { "-" } else { "+" };
            let offset = span(clock.offset_ns.unsigned_abs());
            let bound = span(clock.bound_ns);
            let idle = if clock.bound_ns > BOUND_MOST_NS && !is_slow(host) {
                ", growing while nothing is read from it"
            } else {
                ""
            };
            format!("{sign}{offset} ± {bound}{idle}")
        },
    );
    Finding::ok(
        "host",
        format!("up for {lasts} at {at}, round trip {rtt}, its boot clock {clock}"),
    )
    .of(&host.host)
}

/// Clocks that no exchange could tell well. One of a host from which nothing is read is told worse from second to second,
/// and harms nobody.
fn clocks(daemon: &Daemon) -> Vec<Finding> {
    let mut found = Vec::new();
    for host in daemon
        .hosts
        .iter()
        .filter(|h| h.state == "up" && is_slow(h))
    {
        if let Some(clock) = daemon.clocks.get(&host.host)
            && clock.bound_ns > BOUND_MOST_NS
        {
            found.push(
                Finding::warn(
                    "clock",
                    format!(
                        "the ages of its samples are known to ± {} only",
                        span(clock.bound_ns)
                    ),
                    "the bound is half the shortest round trip: look at the link; on Wi-Fi `sudo iw dev IFACE set power_save off` on both",
                )
                .of(&host.host),
            );
        }
    }
    found
}

/// Whether the shortest round trip alone makes the clock coarse.
fn is_slow(host: &Host) -> bool {
    let half_ns = host.rtt_us.unwrap_or(0).saturating_mul(500);
    half_ns.saturating_add(BOUND_SLACK_NS) > BOUND_MOST_NS
}

fn prefixes(daemon: &Daemon) -> Vec<Finding> {
    let doubles = daemon
        .hosts
        .iter()
        .filter_map(|host| Some((&host.host, host.host.split_once('~')?.0)));
    doubles
        .map(|(shown, name)| {
            Finding::warn(
                "prefix",
                format!(
                    "two hosts are called {name}; the items of this one are under `{shown}/` here"
                ),
                "start one of them under another name: `ddx up --host NAME`",
            )
            .of(shown)
        })
        .collect()
}

fn passes(daemon: &Daemon) -> Option<Finding> {
    let ways = multicast::ways(daemon);
    let told: Vec<&Way> = ways
        .iter()
        .filter(|way| matches!(way.passes, Passes::Yes { .. } | Passes::No { .. }))
        .collect();
    if told.is_empty() {
        return None;
    }
    let blocked: Vec<String> = told
        .iter()
        .filter(|way| matches!(way.passes, Passes::No { .. }))
        .map(|way| format!("{} to {}", way.from, way.to))
        .collect();
    Some(if !blocked.is_empty() {
        Finding::warn(
            "multicast",
            format!("does not pass from {}", blocked.join(", ")),
            "`ddx doctor multicast` says more",
        )
    } else if told.len() == ways.len() {
        Finding::ok("multicast", "passes from and to each host")
    } else {
        let text = format!(
            "passes in {} of {} directions, the others are not known yet",
            told.len(),
            ways.len()
        );
        Finding::ok("multicast", text)
    })
}

/// A coarser clock is worth a word: control loops begin to care.
const BOUND_MOST_NS: u64 = 10_000_000;
/// What drift adds to the bound of a clock that is measured each second.
const BOUND_SLACK_NS: u64 = 500_000;
