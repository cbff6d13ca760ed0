//! What the registry shows: pages of a listing, one item in full.

use std::collections::BTreeSet;
use std::ops::Bound;

use ddx_wire::{Epoch, HostName, ItemName, SchemaHash};

use super::item::{Item, Tenure};
use super::{Registry, RemoteItem, parse_schema};
use crate::control::{Description, ItemEntry, Newest, ReaderEntry, Reply, SCHEMA_MAX_BYTES};

/// Items of one page: with the longest names, programs and schema names a page still fits one message.
const PAGE: usize = 64;
/// Longest note on an item's way here. It names the reading hosts, which may be a thousand.
const NOTE_MAX_BYTES: usize = 4096;
/// Longest reason for which a reader was refused: with as many readers as are shown it still fits one message.
const REFUSED_MAX_BYTES: usize = 256;

impl Registry {
    pub(super) fn list(&self, after: &str) -> Reply {
        let start =
            ItemName::parse(after, &self.identity.host).map_or(Bound::Unbounded, Bound::Excluded);
        let range = (start, Bound::Unbounded);
        let names: BTreeSet<_> = self
            .items
            .range(range.clone())
            .map(|(name, _)| name)
            .take(PAGE + 1)
            .chain(
                self.remote
                    .range(range)
                    .map(|(name, _)| name)
                    .take(PAGE + 1),
            )
            .collect();
        let entries = names.iter().take(PAGE).filter_map(|name| self.entry(name));
        Reply::Entries {
            entries: entries.collect(),
            more: names.len() > PAGE,
        }
    }

    pub(super) fn describe(&self, name: &ItemName) -> Option<Description> {
        let entry = self.entry(name)?;
        let item = self.items.get(name);
        let tenure = item.and_then(|item| item.tenure.as_ref());
        let remote = self.remote.get(name);
        let readers = item.map_or_else(Vec::new, |item| self.readers(item));
        Some(Description {
            schema: match (tenure, remote) {
                (Some(tenure), _) => tenure.schema.text().to_owned(),
                // A longer one fits no answer, and no program here could read the item.
                (None, Some(remote)) if remote.schema.len() <= SCHEMA_MAX_BYTES => {
                    remote.schema.as_ref().to_owned()
                }
                (None, Some(_) | None) => String::new(),
            },
            epoch: match (tenure, remote) {
                (Some(tenure), _) => tenure.segment.control.epoch(),
                (None, Some(remote)) => remote.description.epoch,
                (None, None) => Epoch::default(),
            },
            published: tenure.map_or(0, |tenure| tenure.segment.control.head_pos()),
            newest: tenure.and_then(newest),
            depth: tenure.map_or(0, |tenure| tenure.segment.control.spec().depth),
            note: self
                .notes
                .get(name)
                .map_or_else(String::new, |note| cut(note, NOTE_MAX_BYTES)),
            readers,
            entry,
        })
    }

    fn readers(&self, item: &Item) -> Vec<ReaderEntry> {
        let known = item.readers.iter().take(PAGE);
        known
            .filter_map(|reader| {
                let client = self.clients.get(&reader.client)?;
                Some(ReaderEntry {
                    program: client.program.clone(),
                    pid: client.pid,
                    contract: reader.contract,
                    bound: reader.seat.is_some(),
                    refused: reader
                        .refused
                        .as_deref()
                        .map(|refused| cut(refused, REFUSED_MAX_BYTES)),
                    books: reader.seat.and_then(|seat| {
                        let tenure = item.tenure.as_ref()?;
                        tenure.segment.control.reader_books(seat.cell)
                    }),
                })
            })
            .collect()
    }

    fn entry(&self, name: &ItemName) -> Option<ItemEntry> {
        match (self.items.get(name), self.remote.get(name)) {
            (Some(item), remote) => Some(self.local_entry(name, item, remote)),
            (None, Some(remote)) => Some(remote_entry(name, remote)),
            (None, None) => None,
        }
    }

    fn local_entry(&self, name: &ItemName, item: &Item, remote: Option<&RemoteItem>) -> ItemEntry {
        let readers = u32::try_from(item.readers.len()).unwrap_or(u32::MAX);
        let mut entry = match remote {
            Some(remote) => remote_entry(name, remote),
            None => ItemEntry {
                name: name.clone(),
                host: HostName::parse(name.prefix()).unwrap_or_else(|_| self.identity.host.clone()),
                schema_name: String::new(),
                schema_hash: SchemaHash::default(),
                writer: None,
                program: String::new(),
                pid: None,
                readers,
                last_publish: None,
                capacity_bytes: 0,
            },
        };
        entry.readers = readers;
        let Some(tenure) = &item.tenure else {
            return entry;
        };
        let control = &tenure.segment.control;
        entry.last_publish = control.newest().map(|stamp| stamp.origin.publish);
        entry.schema_name = tenure.schema.name().to_owned();
        entry.schema_hash = tenure.schema.hash();
        entry.capacity_bytes = control.spec().capacity_bytes;
        if remote.is_none() {
            entry.writer = Some(tenure.state);
            entry.program = tenure.program.clone();
            entry.pid = item.lease.as_ref().map(|_| tenure.pid);
        }
        entry
    }
}

fn remote_entry(name: &ItemName, remote: &RemoteItem) -> ItemEntry {
    let description = &remote.description;
    let schema_name = parse_schema(&remote.schema)
        .map_or_else(|_| String::new(), |schema| schema.name().to_owned());
    ItemEntry {
        name: name.clone(),
        host: remote.host.clone(),
        schema_name,
        schema_hash: description.schema_hash,
        writer: Some(description.writer),
        program: description.program.clone(),
        pid: None,
        readers: 0,
        last_publish: None,
        capacity_bytes: description.capacity_bytes,
    }
}

fn newest(tenure: &Tenure) -> Option<Newest> {
    let stamp = tenure.segment.control.newest()?;
    Some(Newest {
        pos: stamp.pos,
        epoch: stamp.origin.epoch,
        seq: stamp.origin.seq,
        bytes: u64::try_from(stamp.len).unwrap_or(u64::MAX),
    })
}

/// As much of a text as may be shown.
fn cut(text: &str, max_bytes: usize) -> String {
    let (shown, _) = text.split_at(text.floor_char_boundary(max_bytes));
    shown.to_owned()
}
