//! What the daemon says of itself: the items under `@/`, as the verbs read them. Fields that a verb does not use are not
//! named here, and what is missing is unknown.

use std::time::Duration;

use ddx_store::{ReaderOptions, Store};
use ddx_wire::ItemName;
use serde::Deserialize;
use serde_json::Value;

use super::render::span;
use super::subscription::Subscription;

/// One entry of `@/hosts`.
#[derive(Clone, Debug, Deserialize, PartialEq)]
pub(crate) struct Host {
    pub(crate) host: String,
    #[serde(default)]
    pub(crate) id: String,
    /// `up`, `unreachable`, `down` or `left`.
    pub(crate) state: String,
    #[serde(default)]
    pub(crate) addr: Option<String>,
    /// Round trip, microseconds.
    #[serde(default)]
    pub(crate) rtt_us: Option<u64>,
    /// Share of probes that were not answered; none where there is only one address to use.
    #[serde(default)]
    pub(crate) loss_percent: Option<f64>,
    /// The addresses that were found for it.
    #[serde(default)]
    pub(crate) paths: Vec<serde::de::IgnoredAny>,
    /// Since when it is in this state: nanoseconds on this host's clock.
    #[serde(default)]
    pub(crate) since: Option<u64>,
}

/// One way of an item between this host and another, from `@/routes`.
#[derive(Clone, Debug, Default, Deserialize, PartialEq)]
pub(crate) struct Way {
    /// The host at the other end.
    #[serde(default)]
    pub(crate) peer: Option<String>,
    /// `unicast`, `multicast` or `both`.
    #[serde(default)]
    pub(crate) via: String,
    /// Since when: nanoseconds on this host's clock.
    #[serde(default)]
    pub(crate) since: u64,
    /// Why a way out is not by multicast.
    #[serde(default)]
    pub(crate) shuns: Option<Shuns>,
    /// The group by which it came before.
    #[serde(default)]
    pub(crate) left_group: Option<String>,
    /// Whether it leads out of this host.
    #[serde(skip)]
    pub(crate) is_out: bool,
    /// What is asked.
    #[serde(skip)]
    pub(crate) contract: String,
}

/// Why samples do not go by multicast.
#[derive(Clone, Debug, Default, Deserialize, PartialEq)]
pub(crate) struct Shuns {
    /// `silent` or `loses`.
    pub(crate) why: String,
    #[serde(default)]
    pub(crate) multicast_loss_percent: f64,
    #[serde(default)]
    pub(crate) unicast_loss_percent: f64,
}

/// One entry of `@/routes`.
#[derive(Debug, Deserialize)]
struct Route {
    name: String,
    direction: String,
    contract: String,
    #[serde(default)]
    ways: Option<Vec<Way>>,
}

impl Way {
    /// In words: which way, since when, and why not by multicast where that was tried.
    pub(crate) fn text(&self, now_ns: u64) -> String {
        let peer = self.peer.as_deref().unwrap_or("?");
        let (direction, since) = (
            if self.is_out { "to" } else { "from" },
            span(now_ns.saturating_sub(self.since)),
        );
        let via = match self.via.as_str() {
            "both" => "both unicast and multicast",
            via => via,
        };
        let why = match (&self.shuns, &self.left_group) {
            (Some(shuns), _) if shuns.why == "silent" => ": nothing came by multicast".to_owned(),
            (Some(shuns), _) => format!(
                ": multicast lost {:.1} % of datagrams, unicast {:.1} %",
                shuns.multicast_loss_percent, shuns.unicast_loss_percent
            ),
            (None, Some(group)) => format!(": `{peer}` gave up multicast {group}"),
            (None, None) => String::new(),
        };
        format!("{direction} `{peer}` by {via} for {since}{why}")
    }
}

/// `@/self`.
#[derive(Clone, Debug, Default, Deserialize, PartialEq)]
pub(crate) struct Own {
    /// Whether the daemon has a domain key.
    #[serde(default)]
    pub(crate) key: bool,
    /// Its process.
    #[serde(default)]
    pub(crate) pid: u32,
    /// Addresses at which other hosts reach it.
    #[serde(default)]
    pub(crate) control: Vec<String>,
}

/// Reads one of the daemon's items; `None` when it is not there within a moment.
pub(crate) fn read(store: &Store, name: &str) -> anyhow::Result<Option<Value>> {
    let mut subscription = Subscription::open(store, name, ReaderOptions::default())?;
    let seen = subscription.first(PATIENCE)?;
    Ok(seen.map(|seen| seen.value.clone()))
}

/// The hosts of the domain, this one left out.
pub(crate) fn hosts(store: &Store) -> anyhow::Result<Vec<Host>> {
    let listed = read(store, "@/hosts")?.unwrap_or_default();
    Ok(serde_json::from_value(listed).unwrap_or_default())
}

/// Datagrams that came sealed with the key of another domain.
pub(crate) fn foreign(store: &Store) -> anyhow::Result<u64> {
    let counters = read(store, "@/counters")?.unwrap_or_default();
    let count = |name: &str| counters[name].as_u64().unwrap_or(0);
    Ok(count("control_refused_foreign_domain") + count("data_refused_foreign_domain"))
}

/// The ways of an item, out of this host and into it.
pub(crate) fn ways(store: &Store, name: &ItemName) -> anyhow::Result<Vec<Way>> {
    let listed = read(store, "@/routes")?.unwrap_or_default();
    let routes: Vec<Route> = serde_json::from_value(listed).unwrap_or_default();
    let routes = routes
        .into_iter()
        .filter(|route| route.name == name.as_str());
    let ways = routes.flat_map(|route| {
        let is_out = route.direction == "out";
        let ways = route.ways.unwrap_or_default().into_iter();
        ways.map(move |way| Way {
            is_out,
            contract: route.contract.clone(),
            ..way
        })
    });
    Ok(ways.collect())
}

/// What the daemon says of its own host.
pub(crate) fn own(store: &Store) -> anyhow::Result<Own> {
    let listed = read(store, "@/self")?.unwrap_or_default();
    Ok(serde_json::from_value(listed).unwrap_or_default())
}

/// How long to wait for an item that a running daemon has from its start.
const PATIENCE: Duration = Duration::from_millis(500);
