//! What the daemon says of itself: the items under `@/`, as the verbs read them. Fields that a verb does not use are not
//! named here, and what is missing is unknown.

use std::time::Duration;

use ddx_store::{ReaderOptions, Store};
use serde::Deserialize;
use serde_json::Value;

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

/// `@/self`.
#[derive(Clone, Debug, Default, Deserialize, PartialEq)]
pub(crate) struct Own {
    /// Whether the daemon has a domain key.
    #[serde(default)]
    pub(crate) key: bool,
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

/// What the daemon says of its own host.
pub(crate) fn own(store: &Store) -> anyhow::Result<Own> {
    let listed = read(store, "@/self")?.unwrap_or_default();
    Ok(serde_json::from_value(listed).unwrap_or_default())
}

/// How long to wait for an item that a running daemon has from its start.
const PATIENCE: Duration = Duration::from_millis(500);
