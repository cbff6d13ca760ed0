//! Schema texts of other hosts, fetched once each, by hash, in parts.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use ddx_wire::message::{Message, SCHEMA_PART_BYTES, SchemaPart};
use ddx_wire::{SchemaHash, Tag, Time};

use crate::outbox::Outbox;

/// Bytes of texts and parts that are kept: one text has 64 KiB at most, and a usual one 1 KiB.
const BYTES_MAX: usize = 32 << 20;
/// Schema texts that are kept; more than any domain of programs has, fewer than would hurt.
const TEXTS_MAX: usize = 4_096;
const FETCHES_MAX: usize = 4_096;
/// Fetches that may have parts under way at one time: half a megabyte at most.
const ACTIVE_MAX: usize = 8;
const PARTS_MAX: usize = 64;
/// Pause after a request that may be lost. It grows after some tries only.
const RETRY: Duration = Duration::from_millis(150);
const STEADY: u32 = 6;
const RETRY_MAX: Duration = Duration::from_millis(600);

#[derive(Default)]
pub(super) struct Schemas {
    texts: BTreeMap<SchemaHash, Arc<str>>,
    fetches: BTreeMap<SchemaHash, Fetch>,
    held_bytes: usize,
    /// Parts for which there was no room.
    pub(super) dropped: u64,
}

struct Fetch {
    from: Tag,
    parts: BTreeMap<u8, Vec<u8>>,
    count: Option<u8>,
    next: Time,
    tries: u32,
}

impl Schemas {
    pub(super) fn text(&self, hash: SchemaHash) -> Option<&Arc<str>> {
        self.texts.get(&hash)
    }

    /// Fetches a text from a host that announced an item with it, unless it is known. `false` when too many are.
    pub(super) fn want(&mut self, hash: SchemaHash, from: Tag, now: Time) -> bool {
        if self.texts.contains_key(&hash) {
            return true;
        }
        if let Some(fetch) = self.fetches.get_mut(&hash) {
            // Whoever announced it last is the likeliest to be there, and that the one before did not answer says
            // nothing about it.
            if fetch.from != from {
                fetch.from = from;
                fetch.next = now;
                fetch.tries = 0;
            }
            return true;
        }
        if self.texts.len() >= TEXTS_MAX || self.fetches.len() >= FETCHES_MAX {
            return false;
        }
        let (parts, count) = (BTreeMap::new(), None);
        self.fetches.insert(
            hash,
            Fetch {
                from,
                parts,
                count,
                next: now,
                tries: 0,
            },
        );
        true
    }

    /// Takes in a part. The text is whole when it returns `true`.
    pub(super) fn handle_part(&mut self, part: SchemaPart, now: Time) -> bool {
        let Some(fetch) = self.fetches.get_mut(&part.hash) else {
            return false;
        };
        let last = part.index.checked_add(1) == Some(part.count);
        let fits = usize::from(part.count) <= PARTS_MAX
            && part.index < part.count
            && fetch.count.is_none_or(|count| count == part.count)
            && part.bytes.len() <= SCHEMA_PART_BYTES
            && (last || part.bytes.len() == SCHEMA_PART_BYTES);
        if !fits {
            return false;
        }
        let before = fetch.parts.get(&part.index).map_or(0, Vec::len);
        let held_bytes = self.held_bytes - before + part.bytes.len();
        if held_bytes > BYTES_MAX {
            self.dropped = self.dropped.saturating_add(1);
            return false;
        }
        self.held_bytes = held_bytes;
        fetch.count = Some(part.count);
        fetch.parts.insert(part.index, part.bytes);
        fetch.next = now + RETRY;
        if fetch.parts.len() < usize::from(part.count) {
            return false;
        }
        let bytes: Vec<u8> = fetch.parts.values().flatten().copied().collect();
        let len = bytes.len();
        let Ok(text) = String::from_utf8(bytes) else {
            // Parts of two texts, or a lie: begin anew.
            self.held_bytes -= len;
            fetch.parts.clear();
            fetch.count = None;
            return false;
        };
        self.fetches.remove(&part.hash);
        self.texts.insert(part.hash, Arc::from(text));
        true
    }

    pub(super) fn poll_timeout(&self) -> Option<Time> {
        self.fetches.values().map(|fetch| fetch.next).min()
    }

    pub(super) fn handle_timeout(&mut self, now: Time, out: &mut Outbox) {
        let active = self
            .fetches
            .values()
            .filter(|fetch| fetch.next > now)
            .count();
        let mut room = ACTIVE_MAX.saturating_sub(active);
        for (hash, fetch) in self
            .fetches
            .iter_mut()
            .filter(|(_, fetch)| fetch.next <= now)
        {
            if room == 0 {
                fetch.next = now + RETRY;
                continue;
            }
            room -= 1;
            let held = fetch
                .parts
                .keys()
                .fold(0_u64, |mask, index| mask | 1 << (index & 63));
            out.send(
                fetch.from,
                &Message::SchemaRequest {
                    hash: *hash,
                    missing: !held,
                },
            );
            fetch.next =
                now + (RETRY * 2_u32.pow(fetch.tries.saturating_sub(STEADY).min(4))).min(RETRY_MAX);
            fetch.tries = fetch.tries.saturating_add(1);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const HASH: SchemaHash = SchemaHash([3; 16]);

    fn part(index: u8, count: u8, bytes: Vec<u8>) -> SchemaPart {
        SchemaPart {
            hash: HASH,
            index,
            count,
            bytes,
        }
    }

    #[test]
    fn parts_in_any_order_make_the_text() {
        let mut schemas = Schemas::default();
        assert!(schemas.want(HASH, Tag(1), Time(0)));
        assert!(!schemas.handle_part(part(1, 2, b"end".to_vec()), Time(1)));
        assert!(schemas.handle_part(part(0, 2, vec![b'a'; SCHEMA_PART_BYTES]), Time(2)));
        let text = schemas.text(HASH).unwrap();
        assert!(text.ends_with("aaaend"));
        assert_eq!(schemas.poll_timeout(), None);
    }

    #[test]
    fn whoever_announces_a_text_next_is_asked_at_once() {
        let out = &mut Outbox::default();
        let mut schemas = Schemas::default();
        schemas.want(HASH, Tag(1), Time(0));
        let mut now = Time(0);
        for _ in 0..12 {
            now = schemas.poll_timeout().unwrap();
            schemas.handle_timeout(now, out);
        }
        schemas.want(HASH, Tag(1), now);
        assert_eq!(schemas.poll_timeout(), Some(now + RETRY_MAX));

        schemas.want(HASH, Tag(2), now);
        assert_eq!(schemas.poll_timeout(), Some(now));
        schemas.handle_timeout(now, out);
        assert_eq!(schemas.poll_timeout(), Some(now + RETRY));
    }

    #[test]
    fn texts_are_kept_up_to_a_limit_and_more_is_counted() {
        let mut schemas = Schemas::default();
        let mut texts = 0;
        for number in 0..1_000_u16 {
            let mut hash = [0; 16];
            hash[..2].copy_from_slice(&number.to_le_bytes());
            let hash = SchemaHash(hash);
            assert!(schemas.want(hash, Tag(1), Time(0)));
            for index in 0..64 {
                let part = part(index, 64, vec![b'a'; SCHEMA_PART_BYTES]);
                texts += usize::from(schemas.handle_part(SchemaPart { hash, ..part }, Time(1)));
            }
        }
        assert_eq!(texts, BYTES_MAX >> 16);
        assert_eq!(schemas.dropped, (1_000 - 512) * 64);
        assert_eq!(schemas.held_bytes, BYTES_MAX);
    }

    #[test]
    fn lying_parts_are_dropped() {
        let mut schemas = Schemas::default();
        schemas.want(HASH, Tag(1), Time(0));
        assert!(!schemas.handle_part(part(0, 200, vec![0; SCHEMA_PART_BYTES]), Time(1)));
        assert!(!schemas.handle_part(part(2, 2, Vec::new()), Time(1)));
        assert!(!schemas.handle_part(part(0, 2, vec![0; 3]), Time(1)));
        assert!(
            !schemas.handle_part(part(0, 1, vec![0xff; 3]), Time(1)),
            "not UTF-8"
        );
        assert!(schemas.handle_part(part(0, 1, b"ok".to_vec()), Time(1)));
        assert_eq!(schemas.held_bytes, 2);
    }
}
