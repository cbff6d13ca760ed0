//! The daemon's own state as items under `@/`, JSON each, written once a second when it changed.
//!
//! | item | what it holds |
//! |---|---|
//! | `@/self` | this host: name, id, domain, whether there is a key, addresses, ports, what the system granted |
//! | `@/hosts` | the other hosts: name, id, state, address in use, round trip, loss, all paths, since when; when multicast last passed from and to each |
//! | `@/routes` | streams out and in: item, peers, path, group, contract; for each peer which way, since when, and why |
//! | `@/books` | what became of each sample, by stream and hop |
//! | `@/clock` | offset and bound of each other host's clock, nanoseconds |
//! | `@/counters` | name to count: datagrams, bytes, drops by reason |

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::sync::atomic::{AtomicU64, Ordering};

use anyhow::Context as _;
use ddx_catalog::delivery::{Route, Via};
use ddx_catalog::{Choice, HostState, HostStatus, PathStatus, Shuns, StreamIn, StreamOut};
use ddx_store::server::Handle;
use ddx_store::{RawWriter, Schema, Store, WriterOptions};
use ddx_wire::seal::Refused;
use ddx_wire::{ItemName, Tag};
use rustix::process::{Resource, getrlimit};
use serde_json::{Map, Value, json};

use super::books::books;
use super::network::Network;
use super::{Config, Ready};
use crate::data::Traffic;
use crate::identity::Identity;

/// Smallest capacity of a state item, bytes. One that outgrows its capacity is opened anew with twice what it needs.
const CAPACITY_BYTES: usize = 4096;
/// Samples that a state item keeps.
const DEPTH: u32 = 2;

/// Writes the items under `@/`, and what descriptions of items say of their way.
pub(super) struct Publisher {
    store: Store,
    handle: Handle,
    notes: BTreeMap<ItemName, String>,
    own: Value,
    items: BTreeMap<&'static str, Item>,
}

struct Item {
    writer: RawWriter,
    written: Vec<u8>,
}

impl Publisher {
    pub(super) fn new(
        handle: &Handle,
        identity: Identity,
        ready: &Ready,
        config: &Config,
        network: Option<&Network>,
    ) -> anyhow::Result<Self> {
        let store = handle
            .connect()
            .context("connecting the daemon's own state to the store")?;
        let own = json!({
            "host": ready.host.as_str(),
            "id": identity.id.to_string(),
            "ordinal": identity.incarnation.ordinal,
            "domain": ready.domain.0,
            "key": ready.data_port.is_some(),
            "socket": ready.socket,
            "control": ready.control,
            "data_port": ready.data_port,
            "beacon": config.beacon,
            "receive_buffer_bytes": network.map(Network::receive_buffer_bytes),
            "pid": std::process::id(),
            "files_max": getrlimit(Resource::Nofile).current,
            "version": env!("CARGO_PKG_VERSION"),
        });
        Ok(Self {
            store,
            handle: handle.clone(),
            notes: BTreeMap::new(),
            own,
            items: BTreeMap::new(),
        })
    }

    /// Writes what changed since the last time.
    pub(super) fn publish(&mut self, network: Option<&Network>) {
        let mut own = self.own.clone();
        if let Some(network) = network {
            own["control"] = json!(network.control_addrs());
        }
        self.write("@/self", &own);
        let hosts = network.map(|n| n.catalog().hosts()).unwrap_or_default();
        self.write("@/hosts", &hosts.iter().map(host).collect());
        self.write("@/clock", &hosts.iter().filter_map(clock).collect());
        self.write(
            "@/routes",
            &network.map_or_else(|| json!([]), |network| routes(network, &hosts)),
        );
        self.write(
            "@/books",
            &network.map_or_else(
                || json!({ "rows": [], "left_off": 0 }),
                |network| books(network, &hosts),
            ),
        );
        self.write("@/counters", &self.counters(network));
        let notes = network
            .map(|network| notes(network, &hosts))
            .unwrap_or_default();
        if notes != self.notes {
            if let Err(error) = self.handle.set_notes(notes.clone()) {
                tracing::warn!(%error, "descriptions do not show the path of items");
            }
            self.notes = notes;
        }
    }

    fn counters(&self, network: Option<&Network>) -> Value {
        let mut counters = network.map(counters).unwrap_or_default();
        // The server is gone only when the daemon stops.
        let store = self.handle.counters().unwrap_or_default();
        for (what, count) in [
            ("bad_messages", store.bad_messages),
            ("bad_segments", store.bad_segments),
            ("overflows", store.overflows),
            ("quota_refusals", store.quota_refusals),
            ("turned_away", store.turned_away),
            ("unkept", store.unkept),
        ] {
            counters.insert(format!("store_{what}"), count.into());
        }
        counters.into()
    }

    fn write(&mut self, name: &'static str, value: &Value) {
        let bytes = value.to_string().into_bytes();
        if self
            .items
            .get(name)
            .is_some_and(|item| item.written == bytes)
        {
            return;
        }
        if let Err(error) = self.try_write(name, bytes) {
            tracing::warn!(item = name, error = %format!("{error:#}"), "the daemon's state cannot be shown");
        }
    }

    fn try_write(&mut self, name: &'static str, bytes: Vec<u8>) -> anyhow::Result<()> {
        let fits = |item: &Item| {
            usize::try_from(item.writer.capacity_bytes()).is_ok_and(|cap| cap >= bytes.len())
        };
        if !self.items.get(name).is_some_and(fits) {
            self.items.remove(name);
            let capacity = bytes.len().saturating_mul(2).max(CAPACITY_BYTES);
            let options = WriterOptions {
                depth: DEPTH,
                capacity_bytes: Some(u32::try_from(capacity)?),
                ..WriterOptions::default()
            };
            let writer = self.store.raw_writer(name, &Schema::json(), options)?;
            self.items.insert(
                name,
                Item {
                    writer,
                    written: Vec::new(),
                },
            );
        }
        if let Some(item) = self.items.get_mut(name) {
            item.writer.write(&bytes)?;
            item.written = bytes;
        }
        Ok(())
    }
}

fn host(status: &HostStatus) -> Value {
    let state = match status.state {
        HostState::Up => "up",
        HostState::Unreachable => "unreachable",
        HostState::Down => "down",
        HostState::Left => "left",
    };
    json!({
        "host": status.shown_as,
        "id": status.host.to_string(),
        "state": state,
        "addr": status.addr,
        "rtt_us": status.rtt.map(|rtt| rtt.as_micros()),
        "loss_percent": used(status).map(loss_percent),
        "paths": status.paths.iter().map(path_to).collect::<Vec<_>>(),
        "since": status.since.0,
        "multicast_in": status.beacon_heard.map(|at| at.0),
        "multicast_out": status.beacon_answered.map(|at| at.0),
    })
}

/// The path in use, if it is measured.
fn used(status: &HostStatus) -> Option<&PathStatus> {
    status
        .paths
        .iter()
        .find(|path| path.used && path.rtt.is_some())
}

fn loss_percent(path: &PathStatus) -> f64 {
    f64::from(path.loss_permille) / 10.0
}

fn path_to(path: &PathStatus) -> Value {
    json!({
        "addr": path.addr,
        "used": path.used,
        "rtt_us": path.rtt.map(|rtt| rtt.as_micros()),
        "loss_percent": path.rtt.map(|_measured| loss_percent(path)),
    })
}

fn clock(status: &HostStatus) -> Option<Value> {
    let clock = status.clock?;
    Some(
        json!({ "host": status.shown_as, "offset_ns": clock.offset_ns, "bound_ns": clock.bound_ns }),
    )
}

fn routes(network: &Network, hosts: &[HostStatus]) -> Value {
    let out = network.catalog().streams_out().into_iter().map(|stream| {
        let (path, group) = path(&stream.route);
        json!({
            "name": stream.name.as_str(),
            "direction": "out",
            "stream": stream.stream.0,
            "peers": peers(&stream, hosts),
            "path": path,
            "group": group,
            "contract": stream.route.contract.to_string(),
            "ways": ways_out(&stream, hosts),
        })
    });
    let into = network.catalog().streams_in().into_iter().map(|stream| {
        json!({
            "name": stream.name.as_str(),
            "direction": "in",
            "stream": stream.stream.map(|id| id.0),
            "peers": stream.tag.map(|tag| name_of(tag, hosts)).into_iter().collect::<Vec<_>>(),
            "path": stream.stream.map(|_granted| path_in(&stream)),
            "group": stream.group,
            "contract": stream.contract.to_string(),
            "ways": stream.since.map(|since| json!([{
                "peer": stream.tag.map(|tag| name_of(tag, hosts)),
                "via": path_in(&stream),
                "since": since.0,
                "left_group": stream.left_group,
            }])),
        })
    });
    out.chain(into).collect()
}

/// Which way each reading host is served, since when, and why not by the group where that was tried.
fn ways_out(stream: &StreamOut, hosts: &[HostStatus]) -> Vec<Value> {
    let readers = stream.route.readers.iter().zip(&stream.choices);
    let way = readers.map(|(reader, choice)| {
        json!({
            "peer": name_of(reader.tag, hosts),
            "via": match reader.via {
                Via::Unicast => "unicast",
                Via::Group(_) => "multicast",
                Via::Both(_) => "both",
            },
            "since": choice.since.0,
            "unicast_loss_percent": percent(choice.unicast_loss),
            "multicast_loss_percent": choice.group_loss.map(percent),
            "shuns": shuns(choice),
        })
    });
    way.collect()
}

fn shuns(choice: &Choice) -> Option<Value> {
    Some(match choice.shuns? {
        Shuns::Silent => json!({ "why": "silent" }),
        Shuns::Loses { group, unicast } => json!({
            "why": "loses",
            "multicast_loss_percent": percent(group),
            "unicast_loss_percent": percent(unicast),
        }),
    })
}

fn percent(share: f64) -> f64 {
    (share * 1000.0).round() / 10.0
}

/// One line for each item that travels: by which path, to or from whom.
fn notes(network: &Network, hosts: &[HostStatus]) -> BTreeMap<ItemName, String> {
    let mut notes: BTreeMap<ItemName, String> = BTreeMap::new();
    for stream in network.catalog().streams_out() {
        let line = format!("{}, {}", ways(&stream, hosts), stream.route.contract);
        let note = notes.entry(stream.name).or_default();
        if !note.is_empty() {
            note.push_str("; ");
        }
        note.push_str(&line);
    }
    for stream in network.catalog().streams_in() {
        let line = match (stream.tag, stream.stream) {
            (Some(tag), Some(_)) => format!("{} from {}", path_in(&stream), name_of(tag, hosts)),
            (Some(tag), None) => format!(
                "asked of {}, which has not answered yet",
                name_of(tag, hosts)
            ),
            (None, _) => "wanted, and no host has it".to_owned(),
        };
        notes.insert(stream.name, line);
    }
    notes
}

/// How a stream goes out, in one word, and the group that it uses.
fn path(route: &Route) -> (&'static str, Option<SocketAddr>) {
    let group = route.readers.iter().find_map(|reader| reader.via.group());
    let path = if route.is_by_unicast() {
        "unicast"
    } else if route.is_by_group() {
        "multicast"
    } else {
        "both"
    };
    (path, group)
}

/// To whom a stream goes by which way.
fn ways(stream: &StreamOut, hosts: &[HostStatus]) -> String {
    let mut ways: BTreeMap<String, Vec<String>> = BTreeMap::new();
    for reader in &stream.route.readers {
        let way = match reader.via {
            Via::Unicast => "unicast".to_owned(),
            Via::Group(group) => format!("multicast {group}"),
            Via::Both(group) => format!("both unicast and multicast {group}"),
        };
        ways.entry(way)
            .or_default()
            .push(name_of(reader.tag, hosts));
    }
    let ways: Vec<_> = ways
        .into_iter()
        .map(|(way, names)| format!("{way} to {}", names.join(", ")))
        .collect();
    ways.join(" and ")
}

fn path_in(stream: &StreamIn) -> &'static str {
    if stream.arrives {
        "multicast"
    } else {
        "unicast"
    }
}

fn peers(stream: &StreamOut, hosts: &[HostStatus]) -> Vec<String> {
    stream
        .route
        .readers
        .iter()
        .map(|reader| name_of(reader.tag, hosts))
        .collect()
}

pub(super) fn name_of(tag: Tag, hosts: &[HostStatus]) -> String {
    hosts
        .iter()
        .find(|host| host.tag == tag)
        .map_or_else(|| "?".to_owned(), |host| host.shown_as.clone())
}

fn counters(network: &Network) -> Map<String, Value> {
    let mut counters = Map::new();
    let mut add = |name: String, count: u64| {
        counters.insert(name, count.into());
    };
    for (socket, traffic) in ["control", "data"].into_iter().zip(network.traffic()) {
        for (what, counter) in named(traffic) {
            add(format!("{socket}_{what}"), counter.load(Ordering::Relaxed));
        }
    }
    let control = network.catalog().counters();
    for (what, count) in [
        ("strangers", control.strangers),
        ("stale_responses", control.stale_responses),
        ("stale_lives", control.stale_lives),
        ("over_limit", control.over_limit),
        ("membership_refused", control.membership_refused),
        ("directory_full", control.directory_full),
    ] {
        add(format!("control_{what}"), count);
    }
    for (reason, count) in control.refused.iter() {
        add(format!("control_{}", refused(reason)), count);
    }
    for (reason, count) in network.received().refused.iter() {
        add(format!("data_{}", refused(reason)), count);
    }
    let (received, sent) = (network.received(), network.board().sent());
    for (what, count) in [
        ("unwanted_records", received.unwanted_records),
        ("refused_streams", received.refused_streams),
        ("dropped_nacks", received.dropped_nacks),
        ("dropped_gone", received.dropped_gone),
        ("unreported_datagrams", received.unreported_datagrams),
        ("unsent_streams", sent.refused_streams),
        ("unsent_readers", sent.refused_readers),
        ("dropped_requests", sent.dropped_requests),
        ("dropped_records", sent.dropped_records),
    ] {
        add(format!("data_{what}"), count);
    }
    counters
}

/// Name of the counter of a reason to drop datagrams: one word, for programs that read it.
fn refused(reason: Refused) -> String {
    format!("refused_{reason}").replace(' ', "_")
}

fn named(traffic: &Traffic) -> [(&'static str, &AtomicU64); 8] {
    [
        ("sent_datagrams", &traffic.sent_datagrams),
        ("sent_bytes", &traffic.sent_bytes),
        ("received_datagrams", &traffic.received_datagrams),
        ("received_bytes", &traffic.received_bytes),
        ("unsent_datagrams", &traffic.unsent_datagrams),
        ("stale_samples", &traffic.stale_samples),
        ("refused_samples", &traffic.refused_samples),
        ("untold_notices", &traffic.untold_notices),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_reason_to_drop_a_datagram_has_a_counter_of_one_word() {
        let names = Refused::ALL.map(refused);

        assert_eq!(
            names,
            [
                "refused_truncated",
                "refused_other_protocol_version",
                "refused_foreign_domain",
                "refused_own_datagram",
                "refused_unknown_sender",
                "refused_wrong_lane",
                "refused_unwanted_stream",
                "refused_replayed",
                "refused_forged",
                "refused_malformed",
            ]
        );
    }
}
