//! The sending half of a simulated host: drives a [`Sender`] from the model store as the daemon's thread does.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::time::Duration;

use ddx_catalog::delivery::{Due, Route, Sender, SenderConfig, SenderEvent, Want};
use ddx_wire::seal::{MAX_DATAGRAM_BYTES, Sealer};
use ddx_wire::{Delivery, Epoch, ItemName, Seq, StreamId, Time};

use super::store::Store;

pub(super) struct Tx {
    pub(super) sender: Sender<Vec<u8>>,
    streams: BTreeMap<StreamId, Stream>,
    /// Items of which something was sent since this was last emptied.
    pub(super) sent: Vec<ItemName>,
    /// Samples handed to the sender, and repeats, since the start.
    pub(super) counts: Counts,
}

/// What the sending half did since its start.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counts {
    /// Samples sent, each counted once for its stream.
    pub writes: u64,
    /// Repeats to one reader, with the first value of a new one.
    pub repeats: u64,
    /// Data datagrams.
    pub datagrams: u64,
    /// Bytes of them.
    pub bytes: u64,
}

/// A stream that was behind its paths for so long goes on with its newest sample, unless each one is wanted.
const BEHIND_MAX: Duration = Duration::from_millis(20);

struct Stream {
    item: ItemName,
    limited: bool,
    is_every: bool,
    newest: (Epoch, Seq),
    due: Option<Time>,
    /// Since when samples wait in the store that no path had room for.
    behind: Option<Time>,
    /// Whether nothing more is read before a path asks.
    paused: bool,
    /// Position of the last sample that was read.
    seen: u64,
}

impl Tx {
    pub(super) fn new(sealer: Sealer, now: Time) -> Self {
        let config = SenderConfig {
            datagram_bytes_max: MAX_DATAGRAM_BYTES,
            ..SenderConfig::default()
        };
        Self {
            sender: Sender::new(config, sealer, now),
            streams: BTreeMap::new(),
            sent: Vec::new(),
            counts: Counts::default(),
        }
    }

    /// Opens a stream whose reader begins after the sample at position `seen`.
    pub(super) fn open(
        &mut self,
        id: StreamId,
        item: ItemName,
        route: &Route,
        seen: u64,
        now: Time,
    ) {
        let stream = Stream {
            item,
            limited: route.contract.interval_ns() > 0,
            is_every: route.contract.delivery != Delivery::Latest,
            newest: Default::default(),
            due: None,
            behind: None,
            paused: false,
            seen,
        };
        self.sender.open(id, route, now);
        self.streams.insert(id, stream);
    }

    pub(super) fn update(&mut self, id: StreamId, route: &Route, now: Time) {
        self.sender.update(id, route, now);
        if let Some(stream) = self.streams.get_mut(&id) {
            stream.paused = false;
        }
    }

    pub(super) fn close(&mut self, id: StreamId) {
        self.sender.close(id);
        self.streams.remove(&id);
    }

    /// Does all that can be done now, and puts the datagrams into `out`.
    pub(super) fn work(&mut self, store: &Store, now: Time, out: &mut Vec<(SocketAddr, Vec<u8>)>) {
        let ids: Vec<StreamId> = self.streams.keys().copied().collect();
        for id in ids {
            self.pull(id, store, now);
        }
        self.sender.handle_timeout(now);
        self.sender.flush(now);
        let mut bytes = Vec::new();
        loop {
            self.fetch(store, now);
            self.sender.flush(now);

            let Some(transmit) = self.sender.poll_transmit(&mut bytes) else {
                return;
            };
            let segment = transmit.segment.map_or(bytes.len(), usize::from);
            for datagram in bytes.chunks(segment.max(1)) {
                self.counts.datagrams += 1;
                self.counts.bytes += u64::try_from(datagram.len()).unwrap_or(0);
                out.push((transmit.to, datagram.to_vec()));
            }
        }
    }

    pub(super) fn poll_timeout(&self) -> Option<Time> {
        let machine = self.sender.poll_timeout().map(|(at, _)| at);
        let rates = self.streams.values().filter_map(|stream| stream.due);
        rates.chain(machine).min()
    }

    fn pull(&mut self, id: StreamId, store: &Store, now: Time) {
        let Some(stream) = self.streams.get_mut(&id).filter(|stream| !stream.paused) else {
            return;
        };
        let Some(item) = store.get(&stream.item) else {
            stream.due = None;
            return;
        };
        let overdue = stream.behind.is_some_and(|b| now.since(b) > BEHIND_MAX);
        let mut skips = overdue && !stream.is_every;
        loop {
            if stream.limited {
                if let Due::At(at) = self.sender.due(id, now) {
                    stream.due = Some(at);
                    return;
                }
                stream.due = None;
            }
            let sample = if stream.limited || std::mem::take(&mut skips) {
                item.current()
            } else {
                item.next(stream.seen)
            };
            let Some(sample) = sample else {
                stream.behind = None;
                return;
            };
            stream.seen = stream.seen.max(sample.pos);
            let at = (sample.meta.epoch, sample.meta.seq);
            if at > stream.newest {
                stream.newest = at;
                let has_room = self.sender.write(id, &sample.meta, &sample.payload, now);
                self.counts.writes += 1;
                self.sent.push(stream.item.clone());
                if !has_room && !stream.limited {
                    stream.behind.get_or_insert(now);
                    stream.paused = true;
                    return;
                }
            } else if stream.limited {
                return;
            }
        }
    }

    /// Reads on where a stream was left because its paths were full.
    fn resume(&mut self, id: StreamId, store: &Store, now: Time) {
        if let Some(stream) = self.streams.get_mut(&id)
            && std::mem::take(&mut stream.paused)
        {
            self.pull(id, store, now);
        }
    }

    fn fetch(&mut self, store: &Store, now: Time) {
        while let Some(SenderEvent::Fetch(fetch)) = self.sender.poll_event() {
            let Some(stream) = self.streams.get_mut(&fetch.stream) else {
                continue;
            };
            let item = store.get(&stream.item);
            let sample = item.and_then(|item| match fetch.want {
                Want::Newest if stream.is_every && stream.newest.1 > Seq(0) => {
                    item.first_from(stream.newest.0, stream.newest.1)
                }
                Want::Newest => item.current(),
                Want::After(epoch, seq) => item.first_from(epoch, Seq(seq.0 + 1)),
                Want::At(epoch, seq) => item.first_from(epoch, seq),
            });
            let found = sample.map(|sample| (&sample.meta, &sample.payload));
            self.sender.fetched(&fetch, found, now);
            if let Some(sample) = sample {
                self.counts.repeats += u64::from(fetch.again);
                self.sent.push(stream.item.clone());
                let at = (sample.meta.epoch, sample.meta.seq);
                if at > stream.newest && !stream.limited {
                    stream.newest = at;
                    stream.seen = stream.seen.max(sample.pos);
                }
            }
            self.resume(fetch.stream, store, now);
        }
    }
}
