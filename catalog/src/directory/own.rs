//! This host's entries: numbered changes, and what others asked for, served at a steady pace.

use std::collections::BTreeMap;
use std::ops::Bound;
use std::sync::Arc;
use std::time::Duration;

use ddx_wire::message::{
    BODY_MAX_BYTES, Change, DESCRIPTION_MAX_BYTES, Delta, ItemState, Message, Range,
    SCHEMA_MAX_BYTES, SCHEMA_PART_BYTES, SchemaPart,
};
use ddx_wire::{ItemDescription, ItemName, SchemaHash, Tag, Time, codec};

use crate::error::Error;
use crate::outbox::Outbox;

/// Names that this host can announce in one life; withdrawn ones count, because their tombstones must reach everybody.
pub(super) const ITEMS_MAX: usize = 65_536;
/// Bytes of a delta beside its changes, at most.
const DELTA_HEAD_BYTES: usize = 40;
/// Two thousand datagrams a second: 2.4 MB/s, which leaves a small link usable.
const SERVE_PERIOD: Duration = Duration::from_millis(4);
const SERVE_BATCH: usize = 8;
const RANGES_MAX: usize = 32;
/// Schema texts that one host may be owed at a time: it asks for eight. With the ranges that makes 4 KiB for each host.
const ORDERED_SCHEMAS_MAX: usize = 64;
/// Bytes of the schema texts of this host's items.
const SCHEMAS_BYTES_MAX: usize = 64 << 20;

/// What this host announces.
#[derive(Default)]
pub(super) struct Own {
    version: u64,
    items: BTreeMap<ItemName, Announced>,
    by_version: BTreeMap<u64, ItemName>,
    schemas: BTreeMap<SchemaHash, Schema>,
    schemas_bytes: usize,
    /// What others asked for and cannot be owed now.
    pub(super) dropped: u64,
    orders: BTreeMap<Tag, Order>,
    next_serve: Option<Time>,
    /// The host that was served last: they take turns.
    turn: Option<Tag>,
}

struct Announced {
    version: u64,
    description: Option<ItemDescription>,
    bytes: usize,
}

struct Schema {
    text: Arc<str>,
    /// How many items have it.
    items: usize,
}

/// What one host is owed.
#[derive(Default)]
struct Order {
    ranges: Vec<Range>,
    schemas: BTreeMap<SchemaHash, u64>,
}

impl Own {
    pub(super) fn version(&self) -> u64 {
        self.version
    }

    pub(super) fn get(&self, name: &ItemName) -> Option<&ItemDescription> {
        self.items.get(name)?.description.as_ref()
    }

    /// Adds or changes an item. `false` when nothing changed.
    pub(super) fn announce(
        &mut self,
        description: ItemDescription,
        schema_text: &str,
    ) -> Result<bool, Error> {
        let name = description.name.clone();
        let known = self.items.get(&name);
        if known.is_some_and(|known| known.description.as_ref() == Some(&description)) {
            return Ok(false);
        }
        if known.is_none() && self.items.len() >= ITEMS_MAX {
            return Err(Error::DirectoryFull {
                name,
                limit: ITEMS_MAX,
            });
        }
        if schema_text.len() > SCHEMA_MAX_BYTES {
            let bytes = schema_text.len();
            return Err(Error::SchemaTooLong {
                name,
                bytes,
                limit: SCHEMA_MAX_BYTES,
            });
        }
        let mut encoded = Vec::new();
        // A description that cannot be encoded is one that cannot travel.
        let bytes =
            codec::encode(&description, &mut encoded).map_or(usize::MAX, |()| encoded.len());
        let limit = DESCRIPTION_MAX_BYTES;
        if bytes > limit {
            return Err(Error::DescriptionTooLong { name, bytes, limit });
        }
        let hash = description.schema_hash;
        if !self.schemas.contains_key(&hash) {
            if self.schemas_bytes + schema_text.len() > SCHEMAS_BYTES_MAX {
                let limit = SCHEMAS_BYTES_MAX;
                return Err(Error::SchemasFull { name, limit });
            }
            self.schemas_bytes += schema_text.len();
            let text = Arc::from(schema_text);
            self.schemas.insert(hash, Schema { text, items: 0 });
        }
        self.record(name, Some(description), bytes);
        Ok(true)
    }

    /// Removes an item, leaving a tombstone. `false` when there was none.
    pub(super) fn withdraw(&mut self, name: &ItemName) -> bool {
        if self.get(name).is_none() {
            return false;
        }
        self.record(name.clone(), None, name.as_str().len() + 4);
        true
    }

    /// Takes an order for changes. What that host was owed before is forgotten when it asks anew.
    pub(super) fn order(&mut self, to: Tag, ranges: Vec<Range>, anew: bool, now: Time) {
        let order = self.orders.entry(to).or_default();
        if anew {
            order.ranges.clear();
        }
        for range in ranges {
            let to = range.to.min(self.version);
            if range.from >= to {
                continue;
            }
            if order.ranges.len() >= RANGES_MAX {
                self.dropped = self.dropped.saturating_add(1);
                continue;
            }
            order.ranges.push(Range {
                from: range.from,
                to,
            });
        }
        self.next_serve.get_or_insert(now);
    }

    /// Takes an order for parts of a schema text.
    pub(super) fn order_schema(&mut self, to: Tag, hash: SchemaHash, missing: u64, now: Time) {
        if !self.schemas.contains_key(&hash) {
            return;
        }
        let ordered = &mut self.orders.entry(to).or_default().schemas;
        if ordered.len() < ORDERED_SCHEMAS_MAX || ordered.contains_key(&hash) {
            ordered.insert(hash, missing);
        } else {
            self.dropped = self.dropped.saturating_add(1);
        }
        self.next_serve.get_or_insert(now);
    }

    pub(super) fn cancel(&mut self, to: Tag) {
        self.orders.remove(&to);
    }

    pub(super) fn poll_timeout(&self) -> Option<Time> {
        self.next_serve
    }

    /// Sends a batch of what is owed.
    pub(super) fn handle_timeout(&mut self, now: Time, out: &mut Outbox) {
        if self.next_serve.is_none_or(|at| at > now) {
            return;
        }
        for _ in 0..SERVE_BATCH {
            let after = self.turn.map_or(Bound::Unbounded, Bound::Excluded);
            let next = self.orders.range((after, Bound::Unbounded)).next();
            let Some(to) = next
                .or_else(|| self.orders.iter().next())
                .map(|(tag, _)| *tag)
            else {
                break;
            };
            self.turn = Some(to);
            if let Some(message) = self.next_for(to) {
                out.send(to, &message);
            } else {
                self.orders.remove(&to);
            }
        }
        self.next_serve = (!self.orders.is_empty()).then_some(now + SERVE_PERIOD);
    }

    fn next_for(&mut self, to: Tag) -> Option<Message> {
        let order = self.orders.get_mut(&to)?;
        if let Some(range) = order.ranges.first_mut() {
            let delta = cut(&self.items, &self.by_version, *range, self.version);
            range.from = delta.range.to;
            if range.from >= range.to {
                order.ranges.remove(0);
            }
            return Some(Message::Delta(delta));
        }
        while let Some(mut wanted) = order.schemas.first_entry() {
            let hash = *wanted.key();
            let missing = *wanted.get();
            let index = missing.trailing_zeros();
            let part = self
                .schemas
                .get(&hash)
                .and_then(|schema| part(hash, &schema.text, index));
            let Some(part) = part else {
                wanted.remove();
                continue;
            };
            *wanted.get_mut() = missing & missing.wrapping_sub(1);
            return Some(Message::SchemaPart(part));
        }
        None
    }

    fn record(&mut self, name: ItemName, description: Option<ItemDescription>, bytes: usize) {
        self.version += 1;
        let version = self.version;
        if let Some(used) = &description
            && let Some(schema) = self.schemas.get_mut(&used.schema_hash)
        {
            schema.items += 1;
        }
        let announced = Announced {
            version,
            description,
            bytes,
        };
        if let Some(before) = self.items.insert(name.clone(), announced) {
            self.by_version.remove(&before.version);
            if let Some(description) = before.description {
                self.release_schema(description.schema_hash);
            }
        }
        self.by_version.insert(version, name);
    }
}

impl Own {
    /// An item has a schema no longer: the last one takes the text with it.
    fn release_schema(&mut self, hash: SchemaHash) {
        let Some(schema) = self.schemas.get_mut(&hash) else {
            return;
        };
        schema.items = schema.items.saturating_sub(1);
        if schema.items == 0 {
            self.schemas_bytes -= schema.text.len();
            self.schemas.remove(&hash);
        }
    }
}

/// As much of a range as one datagram holds.
fn cut(
    items: &BTreeMap<ItemName, Announced>,
    by_version: &BTreeMap<u64, ItemName>,
    range: Range,
    version: u64,
) -> Delta {
    let mut room = BODY_MAX_BYTES - DELTA_HEAD_BYTES;
    let mut changes = Vec::new();
    let mut to = range.to;
    let mut reached = range.from;
    let span = (Bound::Excluded(range.from), Bound::Included(range.to));
    for (change, name) in by_version.range(span) {
        let Some(item) = items.get(name) else {
            continue;
        };
        // A version takes at most nine bytes, the kind of the change one.
        let bytes = item.bytes + 10;
        if bytes > room {
            to = reached;
            break;
        }
        room -= bytes;
        reached = *change;
        let item = match &item.description {
            Some(description) => ItemState::Announced(description.clone()),
            None => ItemState::Withdrawn(name.clone()),
        };
        changes.push(Change {
            version: *change,
            item,
        });
    }
    let range = Range {
        from: range.from,
        to,
    };
    Delta {
        range,
        version,
        changes,
    }
}

fn part(hash: SchemaHash, text: &str, index: u32) -> Option<SchemaPart> {
    let parts = text.len().div_ceil(SCHEMA_PART_BYTES).max(1);
    let at = usize::try_from(index).ok()?;
    if at >= parts {
        return None;
    }
    let bytes = text
        .as_bytes()
        .chunks(SCHEMA_PART_BYTES)
        .nth(at)
        .unwrap_or_default();
    Some(SchemaPart {
        hash,
        index: u8::try_from(index).ok()?,
        count: u8::try_from(parts).ok()?,
        bytes: bytes.to_vec(),
    })
}
