//! `ddx doctor multicast`: between which hosts multicast passes, and in which direction.
//!
//! Every host sends a beacon by multicast each 4 to 4.5 s. This one notes which of them come, and the others answer its own.

use std::net::IpAddr;
use std::thread;
use std::time::{Duration, Instant};

use ddx_catalog::{beacon_group, sample_group};
use ddx_wire::DomainId;
use serde_json::{Value, json};

use super::facts::{self, Daemon, Host};
use super::{Context, exit};
use crate::cli::render::{Table, span};
use crate::error::{Failure, Outcome};

/// How long to listen.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Wait so long for beacons of hosts that came only now; the rest shows at once
    #[arg(long, value_name = "N", default_value_t = 30, value_parser = clap::value_parser!(u64).range(0..=3_600))]
    seconds: u64,
}

/// Whether multicast passes from one host to another.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Way {
    pub(super) from: String,
    pub(super) to: String,
    pub(super) passes: Passes,
}

/// What is known of a way.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Passes {
    Yes {
        ago_ns: u64,
    },
    No {
        /// When it last did.
        ago_ns: Option<u64>,
    },
    /// Too little time has passed to tell.
    NotYet,
    /// It cannot be told, and why.
    Unknown(&'static str),
}

/// Runs the verb.
pub(crate) fn run(context: &mut Context, args: &Args) -> Outcome {
    let store = facts::open(context.socket.as_deref())?;
    let end = Instant::now() + Duration::from_secs(args.seconds);
    let mut daemon = Daemon::ask(&store)?;
    if !daemon.own.key {
        return Err(Failure::new(
            "this host has no key, so that it opens no socket on any network",
        )
        .with_hint(super::judge::JOIN));
    }
    while ways(&daemon).iter().any(|way| way.passes == Passes::NotYet) && Instant::now() < end {
        thread::sleep(LOOK_PERIOD.min(end.saturating_duration_since(Instant::now())));
        daemon = Daemon::ask(&store)?;
    }
    let ways = ways(&daemon);
    if ways.is_empty() {
        return Err(
            Failure::new("no other host is here, so that there is nobody to hear")
                .with_hint(super::others::meet(daemon.domain)),
        );
    }
    if context.out.json {
        for way in &ways {
            context.out.object(&way.object())?;
        }
    } else {
        for line in lines(&daemon, &ways) {
            context.out.line(&line)?;
        }
    }
    Ok(exit(
        ways.iter()
            .all(|way| matches!(way.passes, Passes::Yes { .. })),
    ))
}

/// The ways from each other host to this one, and back.
pub(super) fn ways(daemon: &Daemon) -> Vec<Way> {
    let hosts = || daemon.hosts.iter().filter(|host| host.state != "left");
    // In a larger domain each host takes longer to say what it heard.
    let answered = u64::try_from(daemon.clocks.len().div_ceil(ANSWERED)).unwrap_or(u64::MAX);
    hosts()
        .flat_map(|host| {
            let here = passes(daemon, host, host.multicast_in, 1);
            let there = passes(daemon, host, host.multicast_out, answered.max(1));
            [
                way(&host.host, &daemon.host, here),
                way(&daemon.host, &host.host, there),
            ]
        })
        .collect()
}

fn way(from: &str, to: &str, passes: Passes) -> Way {
    Way {
        from: from.to_owned(),
        to: to.to_owned(),
        passes,
    }
}

fn passes(daemon: &Daemon, host: &Host, last: Option<u64>, patience: u64) -> Passes {
    if !daemon.own.beacon {
        return Passes::Unknown("this host runs with `beacon = false`");
    }
    let ago = |at: u64| daemon.now_ns.saturating_sub(at);
    let patience = PATIENCE_NS.saturating_mul(patience);
    match last.map(ago) {
        _ if host.state != "up" => Passes::Unknown("it does not answer at all"),
        Some(ago_ns) if ago_ns <= patience => Passes::Yes { ago_ns },
        _ if !daemon.clocks.contains_key(&host.host) => {
            Passes::Unknown("known only from what others say")
        }
        ago_ns if ago(host.since) > patience => Passes::No { ago_ns },
        _ => Passes::NotYet,
    }
}

/// What people see.
pub(super) fn lines(daemon: &Daemon, ways: &[Way]) -> Vec<String> {
    let mut table = Table::new(&["FROM", "TO", "MULTICAST"]);
    for way in ways {
        table.row(vec![way.from.clone(), way.to.clone(), way.passes.text()]);
    }
    let mut lines = table.lines();
    let fails = |from: &str, to: &str| {
        ways.iter()
            .any(|way| way.from == from && way.to == to && matches!(way.passes, Passes::No { .. }))
    };
    for host in &daemon.hosts {
        let (other, own) = (host.host.as_str(), daemon.host.as_str());
        let causes = match (fails(other, own), fails(own, other)) {
            (false, false) => continue,
            (true, false) => one_way(daemon, other, own),
            (false, true) => one_way(daemon, own, other),
            (true, true) => neither_way(daemon, host),
        };
        lines.push(format!("hint: {causes}"));
    }
    lines.push(format!(
        "seen from {}: run it on another host for the ways that do not begin or end here",
        daemon.host
    ));
    lines
}

fn one_way(daemon: &Daemon, from: &str, to: &str) -> String {
    format!(
        "{from} is not heard by {to}: its firewall (on {to}: `{}`), then a switch that snoops on IGMP without a querier, \
         or an access point that filters multicast; until then samples go by unicast, once to each host",
        firewall(daemon.domain)
    )
}

fn neither_way(daemon: &Daemon, host: &Host) -> String {
    let at = host
        .addr
        .map_or_else(|| "ADDRESS".to_owned(), |at| ip(at.ip()));
    format!(
        "nothing passes between {} and {}: a firewall (on both: `{}`), an access point that isolates its clients, a switch \
         that snoops on IGMP without a querier, or a VPN or cloud that carries no multicast (then `ddx up --join udp/{at}`); \
         until then samples go by unicast, once to each host",
        daemon.host,
        host.host,
        firewall(daemon.domain)
    )
}

fn ip(ip: IpAddr) -> String {
    ip.to_string()
}

/// Opens the ports of the domain's beacons and of its samples by multicast.
pub(super) fn firewall(domain: u16) -> String {
    let domain = DomainId(domain);
    format!(
        "sudo ufw allow {},{}/udp",
        beacon_group(domain).port(),
        sample_group(domain, 0).port()
    )
}

impl Passes {
    fn text(self) -> String {
        match self {
            Self::Yes { ago_ns } => format!("yes, {} ago", span(ago_ns)),
            Self::No { ago_ns: None } => "no".to_owned(),
            Self::No {
                ago_ns: Some(ago_ns),
            } => format!("no, last {} ago", span(ago_ns)),
            Self::NotYet => "unknown: it came only now, ask again".to_owned(),
            Self::Unknown(why) => format!("unknown: {why}"),
        }
    }

    fn word(self) -> &'static str {
        match self {
            Self::Yes { .. } => "yes",
            Self::No { .. } => "no",
            Self::NotYet | Self::Unknown(_) => "unknown",
        }
    }
}

impl Way {
    fn object(&self) -> Value {
        let ago_ns = match self.passes {
            Passes::Yes { ago_ns } => Some(ago_ns),
            Passes::No { ago_ns } => ago_ns,
            Passes::NotYet | Passes::Unknown(_) => None,
        };
        json!({
            "from": self.from,
            "to": self.to,
            "multicast": self.passes.word(),
            "ago_ns": ago_ns,
            "text": self.passes.text(),
        })
    }
}

/// Three beacons in a row, the digest that tells of the last, and half a second for it to be shown: at a loss of one in ten, one in a
/// thousand such spans has none.
const PATIENCE_NS: u64 = 28_000_000_000;
/// Hosts that get a digest four times in that time; more of them, in a longer one.
const ANSWERED: usize = 4;
/// The daemon's state is written once a second.
const LOOK_PERIOD: Duration = Duration::from_millis(500);
