//! Who has what: this host's entries, and those of every other host as far as they are known.
//!
//! Each host is the only writer of its own entries and numbers its changes, so knowledge about it is one number and a few
//! ranges beyond a gap. Changes are pushed at once; a digest to one random host each second finds what was lost; who is
//! behind asks the owner for exactly the ranges that it lacks. Everything is idempotent.

mod own;
mod schemas;

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

use ddx_wire::message::{Delta, DigestEntry, ItemState, Message, Range, SchemaPart};
use ddx_wire::{HostId, HostName, ItemDescription, ItemName, Pattern, SchemaHash, Tag, Time};

use self::own::{ITEMS_MAX, Own};
use self::schemas::Schemas;
use crate::error::Error;
use crate::event::Event;
use crate::outbox::Outbox;
use crate::rng::Rng;

/// With a beacon now and then it is all that an idle host says.
const DIGEST_PERIOD: Duration = Duration::from_millis(1_600);
/// Entries of the periodic digest: few, so that idle traffic does not grow with the domain.
const DIGEST_SLICE: usize = 8;
/// Entries that are read of a digest: an entry takes at most 18 bytes, so these fit one datagram.
const DIGEST_ENTRIES: usize = 58;
/// Changes made within this time travel together.
const PUSH_AFTER: Duration = Duration::from_millis(2);
/// Hosts to which a change is pushed; beyond, digests spread the news.
const PUSH_MAX: usize = 32;
const DIGEST_FAN: usize = 8;
/// A pushed change may be lost, so the news of it is repeated, cheaply, to a few.
const REMINDERS: [Duration; 2] = [Duration::from_millis(120), Duration::from_millis(300)];
/// Pause after the last part of an answer, after which the rest is asked for again.
const PULL_QUIET: Duration = Duration::from_millis(60);
/// Pause after a request that may be lost. It grows after some tries only: most are answered or lost, not refused.
const PULL_RETRY: Duration = Duration::from_millis(120);
const PULL_STEADY: u32 = 6;
const PULL_RETRY_MAX: Duration = Duration::from_millis(400);
/// Ranges beyond a gap that are remembered, and gaps that are asked for at one time.
const RANGES_MAX: usize = 32;
/// What the items of all other hosts take, as [`cost`] has it: some 400,000 of usual names. The daemon and its store hold
/// each description once more.
const REMOTE_BYTES_MAX: usize = 256 << 20;
/// What one item takes beside its name and its program.
const ITEM_BYTES: usize = 512;

pub(crate) struct Directory {
    own: Own,
    remotes: BTreeMap<HostId, Remote>,
    schemas: Schemas,
    shown: BTreeMap<ItemName, (HostId, ItemName)>,
    changed: BTreeSet<ItemName>,
    /// First version that was not pushed yet, and when it will be.
    push: Option<(u64, Time)>,
    reminders: Vec<Time>,
    next_digest: Option<Time>,
    /// Who got the last digest: hosts take turns.
    digested: Option<Tag>,
    remote_bytes: usize,
    dropped: u64,
}

struct Remote {
    tag: Tag,
    name: HostName,
    /// Prefix under which it is shown, when that is not its own.
    prefix: Option<String>,
    items: BTreeMap<ItemName, Item>,
    have: u64,
    target: u64,
    beyond: Vec<Range>,
    pull: Option<Pull>,
    /// Whether items of an earlier life may be left.
    renewed: bool,
}

struct Item {
    life: Tag,
    version: u64,
    description: Option<ItemDescription>,
    shown: Option<ItemName>,
    bytes: usize,
}

struct Pull {
    next: Time,
    tries: u32,
}

/// One item of another host, for listings.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RemoteItem {
    /// Its owner.
    pub host: HostId,
    /// Name under which this host shows it.
    pub name: ItemName,
    /// What its owner says about it.
    pub description: ItemDescription,
    /// Text of its schema.
    pub schema_text: Arc<str>,
}

impl Directory {
    pub(crate) fn new() -> Self {
        Self {
            own: Own::default(),
            remotes: BTreeMap::new(),
            schemas: Schemas::default(),
            shown: BTreeMap::new(),
            changed: BTreeSet::new(),
            push: None,
            reminders: Vec::new(),
            next_digest: None,
            digested: None,
            remote_bytes: 0,
            dropped: 0,
        }
    }

    /// Number of this host's newest change.
    pub(crate) fn version(&self) -> u64 {
        self.own.version()
    }

    /// One of this host's items.
    pub(crate) fn own(&self, name: &ItemName) -> Option<&ItemDescription> {
        self.own.get(name)
    }

    pub(crate) fn announce(
        &mut self,
        description: ItemDescription,
        schema_text: &str,
        now: Time,
    ) -> Result<(), Error> {
        if self.own.announce(description, schema_text)? {
            self.schedule_push(now);
        }
        Ok(())
    }

    pub(crate) fn withdraw(&mut self, name: &ItemName, now: Time) -> bool {
        let known = self.own.withdraw(name);
        if known {
            self.schedule_push(now);
        }
        known
    }

    /// The owner, the owner's name and the description of an item of another host.
    pub(crate) fn find(&self, shown: &ItemName) -> Option<(HostId, &ItemDescription)> {
        let (host, name) = self.shown.get(shown)?;
        let item = self.remotes.get(host)?.items.get(name)?;
        Some((*host, item.description.as_ref()?))
    }

    /// Items of other hosts, and parts of their schemas, for which there was no room.
    pub(crate) fn dropped(&self) -> u64 {
        self.dropped.saturating_add(self.schemas.dropped)
    }

    /// Orders of other hosts that found no room: they are given again.
    pub(crate) fn unanswered(&self) -> u64 {
        self.own.dropped
    }

    /// A name whose item appeared, changed, moved or went since it was last asked.
    pub(crate) fn poll_changed(&mut self) -> Option<ItemName> {
        self.changed.pop_first()
    }

    /// Items of other hosts whose names fit.
    pub(crate) fn items<'a>(
        &'a self,
        pattern: &'a Pattern,
    ) -> impl Iterator<Item = RemoteItem> + 'a {
        self.shown
            .keys()
            .filter(|name| pattern.matches(name))
            .filter_map(|name| {
                let (host, description) = self.find(name)?;
                Some(RemoteItem {
                    host,
                    name: name.clone(),
                    description: description.clone(),
                    schema_text: Arc::clone(self.schemas.text(description.schema_hash)?),
                })
            })
    }

    /// Begins or goes on to follow a life of a host, whose newest change is `version`.
    pub(crate) fn follow(
        &mut self,
        host: HostId,
        tag: Tag,
        name: &HostName,
        version: u64,
        now: Time,
        out: &mut Outbox,
    ) {
        let remote = self.remotes.entry(host).or_insert_with(|| Remote {
            tag,
            name: name.clone(),
            prefix: None,
            items: BTreeMap::new(),
            have: 0,
            target: 0,
            beyond: Vec::new(),
            pull: None,
            renewed: false,
        });
        if remote.tag != tag {
            self.own.cancel(remote.tag);
            remote.tag = tag;
            remote.name = name.clone();
            (remote.have, remote.target) = (0, 0);
            remote.beyond.clear();
            remote.pull = None;
            remote.renewed = true;
        }
        self.next_digest.get_or_insert(now + DIGEST_PERIOD);
        self.note_version(host, tag, version, now, out);
    }

    /// Forgets the items of a host that said goodbye.
    pub(crate) fn forget(&mut self, host: HostId, out: &mut Outbox) {
        let Some(remote) = self.remotes.remove(&host) else {
            return;
        };
        self.own.cancel(remote.tag);
        self.remote_bytes -= remote.items.values().map(|i| i.bytes).sum::<usize>();
        for item in remote.items.into_values() {
            hide(&mut self.shown, &mut self.changed, host, item.shown, out);
        }
    }

    /// Changes the prefixes under which hosts are shown; those left out are shown under their own. The hosts that moved.
    pub(crate) fn set_prefixes(
        &mut self,
        prefixes: &BTreeMap<HostId, String>,
        out: &mut Outbox,
    ) -> Vec<HostId> {
        let mut moved = Vec::new();
        for (host, remote) in &mut self.remotes {
            let prefix = prefixes.get(host);
            if remote.prefix.as_ref() == prefix {
                continue;
            }
            remote.prefix = prefix.cloned();
            for item in remote.items.values_mut() {
                hide(
                    &mut self.shown,
                    &mut self.changed,
                    *host,
                    item.shown.take(),
                    out,
                );
            }
            moved.push(*host);
        }
        for host in &moved {
            self.show_all(*host, None, out);
        }
        moved
    }

    /// Learns that a host's newest change is at least `version`, and asks for what is missing.
    pub(crate) fn note_version(
        &mut self,
        host: HostId,
        tag: Tag,
        version: u64,
        now: Time,
        out: &mut Outbox,
    ) {
        let Some(remote) = self
            .remotes
            .get_mut(&host)
            .filter(|remote| remote.tag == tag)
        else {
            return;
        };
        remote.target = remote.target.max(version);
        if remote.have < remote.target && remote.pull.is_none() {
            remote.ask(now, out);
        }
        self.settle(host, out);
    }

    pub(crate) fn handle_digest(
        &mut self,
        from: Tag,
        me: Tag,
        entries: &[DigestEntry],
        now: Time,
        out: &mut Outbox,
    ) -> Vec<Tag> {
        let hosts: BTreeMap<Tag, HostId> =
            self.remotes.iter().map(|(id, r)| (r.tag, *id)).collect();
        let mut newer = Vec::new();
        let mut strangers = Vec::new();
        for entry in entries.iter().take(DIGEST_ENTRIES) {
            let known = if entry.tag == me {
                Some(self.own.version())
            } else if let Some(host) = hosts.get(&entry.tag) {
                self.note_version(*host, entry.tag, entry.version, now, out);
                self.remotes.get(host).map(|remote| remote.have)
            } else {
                strangers.push(entry.tag);
                None
            };
            if let Some(version) = known.filter(|version| *version > entry.version) {
                newer.push(DigestEntry {
                    tag: entry.tag,
                    version,
                });
            }
        }
        if !newer.is_empty() {
            out.send(from, &self.news(None, newer));
        }
        strangers
    }

    pub(crate) fn handle_pull(&mut self, from: Tag, ranges: Vec<Range>, now: Time) {
        self.own.order(from, ranges, true, now);
    }

    pub(crate) fn handle_schema_request(
        &mut self,
        from: Tag,
        hash: SchemaHash,
        missing: u64,
        now: Time,
    ) {
        self.own.order_schema(from, hash, missing, now);
    }

    pub(crate) fn handle_schema_part(&mut self, part: SchemaPart, now: Time, out: &mut Outbox) {
        let hash = part.hash;
        if self.schemas.handle_part(part, now) {
            let hosts: Vec<_> = self.remotes.keys().copied().collect();
            for host in hosts {
                self.show_all(host, Some(hash), out);
            }
        }
    }

    /// Takes in changes from their owner. `false` when they break the rules.
    pub(crate) fn handle_delta(
        &mut self,
        host: HostId,
        tag: Tag,
        delta: Delta,
        now: Time,
        out: &mut Outbox,
    ) -> bool {
        let Some(remote) = self
            .remotes
            .get_mut(&host)
            .filter(|remote| remote.tag == tag)
        else {
            return false;
        };
        let range = delta.range;
        let inside = delta.changes.iter().all(|change| {
            let name = match &change.item {
                ItemState::Announced(description) => &description.name,
                ItemState::Withdrawn(name) => name,
            };
            (range.from < change.version && change.version <= range.to)
                && name.is_under(&remote.name)
        });
        if !inside || range.from > range.to || range.to > delta.version {
            return false;
        }
        let mut names = Vec::new();
        for change in delta.changes {
            let (name, description) = match change.item {
                ItemState::Announced(description) => (description.name.clone(), Some(description)),
                ItemState::Withdrawn(name) => (name, None),
            };
            let known = remote.items.get(&name);
            if known.is_some_and(|item| item.life == tag && item.version >= change.version) {
                continue;
            }
            let bytes = cost(&name, description.as_ref());
            let before = known.map_or(0, |item| item.bytes);
            let is_full = remote.items.len() >= ITEMS_MAX
                || self.remote_bytes - before + bytes > REMOTE_BYTES_MAX;
            if known.is_none() && is_full {
                self.dropped = self.dropped.saturating_add(1);
                continue;
            }
            self.remote_bytes = self.remote_bytes - before + bytes;
            let shown = known.and_then(|item| item.shown.clone());
            let item = Item {
                life: tag,
                version: change.version,
                description,
                shown,
                bytes,
            };
            remote.items.insert(name.clone(), item);
            names.push(name);
        }
        remote.target = remote.target.max(delta.version);
        remote.merge(range);
        if remote.have >= remote.target {
            remote.pull = None;
        } else if let Some(pull) = &mut remote.pull {
            *pull = Pull {
                next: now + PULL_QUIET,
                tries: 0,
            };
        } else {
            remote.pull = Some(Pull {
                next: now + PULL_QUIET,
                tries: 0,
            });
        }
        for name in names {
            self.show(host, &name, now, out);
        }
        self.settle(host, out);
        true
    }

    pub(crate) fn poll_timeout(&self) -> Option<Time> {
        let pulls = self
            .remotes
            .values()
            .filter_map(|remote| Some(remote.pull.as_ref()?.next));
        let own = [
            self.own.poll_timeout(),
            self.schemas.poll_timeout(),
            self.push.map(|(_, at)| at),
            self.reminders.first().copied(),
            self.next_digest,
        ];
        pulls.chain(own.into_iter().flatten()).min()
    }

    /// Does what is due. `up` are the hosts that answer now.
    pub(crate) fn handle_timeout(
        &mut self,
        now: Time,
        up: &[Tag],
        beacon_age_s: impl Fn(Tag) -> Option<u8>,
        rng: &mut Rng,
        out: &mut Outbox,
    ) {
        if let Some((first, _)) = self.push.filter(|(_, at)| *at <= now) {
            self.push = None;
            if up.len() <= PUSH_MAX {
                let range = Range {
                    from: first - 1,
                    to: self.own.version(),
                };
                for tag in up {
                    self.own.order(*tag, vec![range], false, now);
                }
            }
            self.reminders = REMINDERS.iter().map(|after| now + *after).collect();
        }
        if self.reminders.first().is_some_and(|at| *at <= now) {
            self.reminders.remove(0);
            let start = rng.below(up.len());
            for tag in up.iter().cycle().skip(start).take(up.len().min(DIGEST_FAN)) {
                out.send(*tag, &self.news(beacon_age_s(*tag), Vec::new()));
            }
        }
        if self.next_digest.is_some_and(|at| at <= now) {
            self.next_digest = Some(now + DIGEST_PERIOD);
            // The first is drawn, or all hosts would begin with the same one.
            let last = self.digested.or_else(|| rng.pick(up));
            let next = up.iter().filter(|tag| Some(**tag) > last).min();
            self.digested = next.or_else(|| up.iter().min()).copied();
            if let Some(to) = self.digested {
                let others = self.slice(to, DIGEST_SLICE, rng);
                out.send(to, &self.news(beacon_age_s(to), others));
            }
        }
        for remote in self.remotes.values_mut() {
            if remote.pull.as_ref().is_some_and(|pull| pull.next <= now) {
                remote.ask(now, out);
            }
        }
        self.own.handle_timeout(now, out);
        self.schemas.handle_timeout(now, out);
    }

    /// What is known of all hosts, as far as one datagram holds it: for a host that comes back, which may have missed
    /// anything, and may know what this one has missed of hosts that were cut off with it.
    pub(crate) fn summary(&self, to: Tag, rng: &mut Rng) -> Message {
        self.news(None, self.slice(to, DIGEST_ENTRIES, rng))
    }

    fn news(&self, beacon_age_s: Option<u8>, others: Vec<DigestEntry>) -> Message {
        Message::Digest {
            version: self.own.version(),
            beacon_age_s,
            others,
        }
    }

    /// What is known of some hosts, for one of them that knows itself best.
    fn slice(&self, to: Tag, most: usize, rng: &mut Rng) -> Vec<DigestEntry> {
        let start = rng.below(self.remotes.len());
        let known = self.remotes.values().map(|r| DigestEntry {
            tag: r.tag,
            version: r.have,
        });
        let known = known.clone().skip(start).chain(known.take(start));
        known.filter(|entry| entry.tag != to).take(most).collect()
    }

    fn schedule_push(&mut self, now: Time) {
        let version = self.own.version();
        self.push.get_or_insert((version, now + PUSH_AFTER));
    }

    /// Once a life is known in full, drops what only an earlier one had.
    fn settle(&mut self, host: HostId, out: &mut Outbox) {
        let Some(remote) = self.remotes.get_mut(&host) else {
            return;
        };
        if !remote.renewed || remote.have < remote.target {
            return;
        }
        remote.renewed = false;
        let tag = remote.tag;
        remote.items.retain(|_, item| {
            let stays = item.life == tag;
            if !stays {
                self.remote_bytes -= item.bytes;
                hide(
                    &mut self.shown,
                    &mut self.changed,
                    host,
                    item.shown.take(),
                    out,
                );
            }
            stays
        });
    }

    /// Shows what is known of a host, or only the items with one schema, whose text just arrived.
    fn show_all(&mut self, host: HostId, only: Option<SchemaHash>, out: &mut Outbox) {
        let Some(remote) = self.remotes.get(&host) else {
            return;
        };
        let fits = |item: &Item| {
            let hash = item.description.as_ref().map(|d| d.schema_hash);
            hash.is_some() && (only.is_none() || only == hash)
        };
        let names = remote
            .items
            .iter()
            .filter(|(_, item)| fits(item))
            .map(|(name, _)| name.clone());
        for name in names.collect::<Vec<_>>() {
            self.present(host, &name, out);
        }
    }

    /// Shows an item that changed, once its schema text is there.
    fn show(&mut self, host: HostId, name: &ItemName, now: Time, out: &mut Outbox) {
        let Some(remote) = self.remotes.get_mut(&host) else {
            return;
        };
        let Some(item) = remote.items.get_mut(name) else {
            return;
        };
        let Some(description) = &item.description else {
            hide(
                &mut self.shown,
                &mut self.changed,
                host,
                item.shown.take(),
                out,
            );
            return;
        };
        if self.schemas.text(description.schema_hash).is_some() {
            self.present(host, name, out);
        } else if !self.schemas.want(description.schema_hash, remote.tag, now) {
            self.dropped = self.dropped.saturating_add(1);
        }
    }

    fn present(&mut self, host: HostId, name: &ItemName, out: &mut Outbox) {
        let Some(remote) = self.remotes.get_mut(&host) else {
            return;
        };
        let Some(item) = remote.items.get_mut(name) else {
            return;
        };
        let Some(description) = item.description.clone() else {
            return;
        };
        let Some(schema_text) = self.schemas.text(description.schema_hash) else {
            return;
        };
        let shown = match &remote.prefix {
            None => name.clone(),
            Some(prefix) => match name.with_prefix(prefix) {
                Ok(shown) => shown,
                // The name is too long with the longer prefix: it is counted, and comes back with the short one.
                Err(_) => {
                    self.dropped = self.dropped.saturating_add(1);
                    return;
                }
            },
        };
        item.shown = Some(shown.clone());
        self.shown.insert(shown.clone(), (host, name.clone()));
        self.changed.insert(shown.clone());
        let schema_text = Arc::clone(schema_text);
        out.event(Event::ItemKnown {
            host,
            name: shown,
            description,
            schema_text,
        });
    }
}

impl Remote {
    /// Asks the owner for what is missing.
    fn ask(&mut self, now: Time, out: &mut Outbox) {
        let mut gaps = Vec::new();
        let mut from = self.have;
        for known in &self.beyond {
            gaps.push(Range {
                from,
                to: known.from,
            });
            from = known.to;
        }
        if from < self.target {
            gaps.push(Range {
                from,
                to: self.target,
            });
        }
        gaps.truncate(RANGES_MAX);
        out.send(self.tag, &Message::Pull(gaps));
        let tries = self.pull.as_ref().map_or(0, |pull| pull.tries);
        let pause =
            (PULL_RETRY * 2_u32.pow(tries.saturating_sub(PULL_STEADY).min(4))).min(PULL_RETRY_MAX);
        self.pull = Some(Pull {
            next: now + pause,
            tries: tries.saturating_add(1),
        });
    }

    /// Notes that all changes within `range` are known.
    fn merge(&mut self, range: Range) {
        self.beyond.push(range);
        self.beyond.sort_by_key(|known| known.from);
        let mut rest: Vec<Range> = Vec::new();
        for known in self.beyond.drain(..) {
            if known.from <= self.have {
                self.have = self.have.max(known.to);
                continue;
            }
            match rest.last_mut() {
                Some(last) if known.from <= last.to => last.to = last.to.max(known.to),
                _ => rest.push(known),
            }
        }
        // What does not fit is asked for again.
        rest.truncate(RANGES_MAX);
        self.beyond = rest;
    }
}

/// What an item takes: its name is held in four tables.
fn cost(name: &ItemName, description: Option<&ItemDescription>) -> usize {
    let program = description.map_or(0, |description| description.program.len());
    ITEM_BYTES + 4 * name.as_str().len() + program
}

fn hide(
    all: &mut BTreeMap<ItemName, (HostId, ItemName)>,
    changed: &mut BTreeSet<ItemName>,
    host: HostId,
    shown: Option<ItemName>,
    out: &mut Outbox,
) {
    let Some(name) = shown else {
        return;
    };
    // Another host may hold the name by now.
    if all.get(&name).is_some_and(|(owner, _)| *owner == host) {
        all.remove(&name);
        changed.insert(name.clone());
    }
    out.event(Event::ItemGone { host, name });
}

#[cfg(test)]
mod tests;
