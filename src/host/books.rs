//! `@/books`: what became of each sample that travels, one row for each stream and hop.
//!
//! A row is of one moment, as the thread that counts it saw it, so that it balances however much is on its way: what the
//! numbers of the samples say (`expected`) is what their fates add up to (`accounted`). Of a link, its range is what both ends
//! have seen: from the first sample that was delivered to the newest.

use std::collections::BTreeMap;
use std::net::SocketAddr;

use ddx_catalog::delivery::{Books, PathStatus, SentBooks, SourceBooks};
use ddx_catalog::{HostStatus, StreamOut};
use ddx_wire::{StreamId, Time};
use serde_json::{Value, json};

use super::network::Network;
use super::state::name_of;
use crate::data::board::Mirrored;

/// Rows that are shown; those beyond are counted.
const ROWS_MAX: usize = 4096;

/// The whole item.
pub(super) fn books(network: &Network, hosts: &[HostStatus]) -> Value {
    let mut rows = outward(network, hosts);
    rows.extend(inward(network, hosts));
    let left_off = rows.len().saturating_sub(ROWS_MAX);
    rows.truncate(ROWS_MAX);
    json!({ "rows": rows, "left_off": left_off })
}

fn outward(network: &Network, hosts: &[HostStatus]) -> Vec<Value> {
    let board = network.board().outward();
    let streams = network.catalog().streams_out();
    let streams: BTreeMap<StreamId, &StreamOut> = streams
        .iter()
        .map(|stream| (stream.stream, stream))
        .collect();
    let paths: BTreeMap<SocketAddr, &PathStatus> =
        board.paths.iter().map(|path| (path.to, path)).collect();
    let sources = board.sources.iter().filter_map(|(id, books)| {
        let stream = streams.get(id)?;
        Some(source(stream, books, board.at))
    });
    let sent = board.sent.iter().filter_map(|(id, to, books)| {
        let stream = streams.get(id)?;
        // A way that was not taken yet, or is at rest.
        if books.expected == 0 {
            return None;
        }
        Some(way(
            stream,
            (*to, paths.get(to).copied()),
            books,
            hosts,
            board.at,
        ))
    });
    sources.chain(sent).collect()
}

fn source(stream: &StreamOut, books: &SourceBooks, at: Time) -> Value {
    json!({
        "name": stream.name.as_str(),
        "hop": "store to stream",
        "contract": stream.route.contract.to_string(),
        "interval_ns": stream.route.contract.interval_ns(),
        "at_ns": at.0,
        "expected": books.expected,
        "delivered": books.delivered,
        "rate_limited": books.rate_limited,
        "overwritten": books.overwritten,
        "expired": books.expired,
        "too_large": books.too_large,
        "bytes": books.bytes,
    })
}

fn way(
    stream: &StreamOut,
    (to, path): (SocketAddr, Option<&PathStatus>),
    books: &SentBooks,
    hosts: &[HostStatus],
    at: Time,
) -> Value {
    let readers = stream.route.readers.iter();
    let served = readers.filter(|reader| reader.addr == to || reader.via.group() == Some(to));
    let peers: Vec<String> = served.map(|reader| name_of(reader.tag, hosts)).collect();
    json!({
        "name": stream.name.as_str(),
        "hop": "store to link",
        "peers": peers,
        "via": if to.ip().is_multicast() { "multicast" } else { "unicast" },
        "addr": to,
        "contract": stream.route.contract.to_string(),
        "at_ns": at.0,
        "expected": books.expected,
        "delivered": books.delivered,
        "filtered": books.filtered,
        "queue_dropped": books.queue_dropped,
        "overwritten": books.overwritten,
        "expired": books.expired,
        "bytes": books.bytes,
        "waiting": books.waiting,
        "link": path.map(|path| json!({
            "bytes_per_second": path.bytes_per_second,
            "queue_us": path.queue.as_micros(),
            "loss_percent": f64::from(path.loss_permille) / 10.0,
            "datagram_bytes": path.datagram_bytes,
            "streams_waiting": path.waiting,
        })),
    })
}

fn inward(network: &Network, hosts: &[HostStatus]) -> Vec<Value> {
    let board = network.board().inward();
    let streams = network.catalog().streams_in();
    let names: BTreeMap<_, _> = streams
        .iter()
        .filter_map(|stream| Some(((stream.tag?, stream.stream?), stream)))
        .collect();
    let rows = board
        .streams
        .iter()
        .filter_map(|(tag, id, books, mirrored)| {
            let stream = names.get(&(*tag, *id))?;
            let from = name_of(*tag, hosts);
            let contract = stream.contract.to_string();
            Some(arrived(
                stream.name.as_str(),
                &from,
                &contract,
                (books, mirrored),
                board.at,
            ))
        });
    rows.collect()
}

fn arrived(
    name: &str,
    from: &str,
    contract: &str,
    (books, mirrored): (&Books, &Mirrored),
    at: Time,
) -> Value {
    json!({
        "name": name,
        "hop": "link to mirror",
        "peers": [from],
        "contract": contract,
        "at_ns": at.0,
        "expected": books.expected,
        "delivered": books.delivered,
        "written": mirrored.written,
        "stale": mirrored.stale,
        "refused": mirrored.refused,
        "filtered": books.filtered,
        "overwritten": books.overwritten,
        "lost": books.link_lost,
        "late": books.late,
        "expired": books.expired,
        "over_budget": books.over_budget,
        "undecodable": books.undecodable,
        "duplicates": books.duplicates,
        "bytes": mirrored.bytes,
    })
}
