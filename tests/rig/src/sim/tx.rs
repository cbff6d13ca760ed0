//! The sending half of a simulated host: drives a [`Sender`] from the model store as the daemon's thread does.

use std::collections::BTreeMap;
use std::net::SocketAddr;

use ddx_catalog::delivery::{Due, Route, Sender, SenderConfig, SenderEvent};
use ddx_wire::sample::SampleMeta;
use ddx_wire::seal::Sealer;
use ddx_wire::{Epoch, ItemName, Seq, StreamId, Time};

use super::store::Store;

pub(super) struct Tx {
    pub(super) sender: Sender,
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

struct Stream {
    item: ItemName,
    limited: bool,
    newest: (Epoch, Seq),
    filtered: u64,
    due: Option<Time>,
    /// Position of the last sample that was read.
    seen: u64,
}

impl Tx {
    pub(super) fn new(sealer: Sealer, now: Time) -> Self {
        Self {
            sender: Sender::new(SenderConfig::default(), sealer, now),
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
        route: Route,
        seen: u64,
        now: Time,
    ) {
        let stream = Stream {
            item,
            limited: route.contract.max_rate_mhz.is_some(),
            newest: Default::default(),
            filtered: 0,
            due: None,
            seen,
        };
        self.sender.open(id, route, now);
        self.streams.insert(id, stream);
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
        self.repeat(store, now);
        self.sender.flush(now);
        let mut bytes = Vec::new();
        while let Some(transmit) = self.sender.poll_transmit(&mut bytes) {
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
        let Some(stream) = self.streams.get_mut(&id) else {
            return;
        };
        let Some(item) = store.get(&stream.item) else {
            stream.due = None;
            return;
        };
        loop {
            if stream.limited {
                if let Due::At(at) = self.sender.due(id, now) {
                    stream.due = Some(at);
                    return;
                }
                stream.due = None;
            }
            let sample = if stream.limited {
                item.current()
            } else {
                item.next(stream.seen)
            };
            let Some(sample) = sample else {
                return;
            };
            stream.seen = sample.pos;
            if stream.is_new(&sample.meta) {
                let meta = stream.meta(&sample.meta);
                stream.newest = (meta.epoch, meta.seq);
                stream.filtered = meta.filtered;
                self.sender.write(id, &meta, &sample.payload, now);
                self.counts.writes += 1;
                self.sent.push(stream.item.clone());
            } else if stream.limited {
                return;
            }
        }
    }

    fn repeat(&mut self, store: &Store, now: Time) {
        while let Some(SenderEvent::Repeat { stream: id, to }) = self.sender.poll_event() {
            let Some(stream) = self.streams.get(&id) else {
                continue;
            };
            if let Some(sample) = store.get(&stream.item).and_then(|item| item.current()) {
                let meta = stream.meta(&sample.meta);
                self.sender.repeat(id, to, &meta, &sample.payload, now);
                self.counts.repeats += 1;
                self.sent.push(stream.item.clone());
            }
        }
    }
}

impl Stream {
    fn is_new(&self, meta: &SampleMeta) -> bool {
        (meta.epoch, meta.seq) > self.newest
    }

    /// What is told about a sample: all that lies between it and the last one sent was left out here.
    fn meta(&self, meta: &SampleMeta) -> SampleMeta {
        let (epoch, Seq(last)) = self.newest;
        let filtered = if meta.epoch == epoch {
            self.filtered
                .saturating_add(meta.seq.0.saturating_sub(last).saturating_sub(1))
        } else {
            meta.seq.0.saturating_sub(1)
        };
        SampleMeta { filtered, ..*meta }
    }
}
