//! A model of the store: items with a short ring, epochs, and samples that know what they must look like.

use std::collections::{BTreeMap, VecDeque};

use ddx_wire::sample::SampleMeta;
use ddx_wire::{Epoch, ItemName, Seq, Time};

use crate::random::Random;

/// Samples that an item keeps, as the real one does by default.
const DEPTH: usize = 8;
/// Shortest payload: five words and a checksum.
const PAYLOAD_MIN: usize = 48;

/// The items of one life of a host.
#[derive(Debug, Default)]
pub(super) struct Store {
    items: BTreeMap<ItemName, Item>,
    last_epoch: u32,
}

/// One item.
#[derive(Debug)]
pub(super) struct Item {
    ring: VecDeque<Sample>,
    last_pos: u64,
    epoch: Epoch,
    last_seq: u64,
}

/// A sample in the ring of its item.
#[derive(Clone, Debug)]
pub(super) struct Sample {
    /// Place among all samples of the item.
    pub(super) pos: u64,
    pub(super) meta: SampleMeta,
    pub(super) payload: Vec<u8>,
}

/// What a payload says of itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Payload {
    /// Number of the host that wrote it.
    pub(super) owner: u64,
    pub(super) epoch: Epoch,
    pub(super) seq: Seq,
    /// Virtual time of the write, nanoseconds.
    pub(super) truth: u64,
}

impl Store {
    /// Opens a writer: a new item, or a new epoch of one whose writer was replaced. The last sample stays.
    pub(super) fn open_writer(&mut self, name: &ItemName, ordinal: u32) -> Epoch {
        self.last_epoch += 1;
        let epoch = Epoch::new(ordinal, self.last_epoch);
        let item = self.items.entry(name.clone()).or_insert_with(|| Item {
            ring: VecDeque::new(),
            last_pos: 0,
            epoch,
            last_seq: 0,
        });
        let passed = item.ring.len().saturating_sub(1);
        item.ring.drain(..passed);
        (item.epoch, item.last_seq) = (epoch, 0);
        epoch
    }

    pub(super) fn remove(&mut self, name: &ItemName) {
        self.items.remove(name);
    }

    pub(super) fn get(&self, name: &ItemName) -> Option<&Item> {
        self.items.get(name)
    }

    /// Writes the next sample of an item; its order, or `None` when there is no such item.
    pub(super) fn write(
        &mut self,
        name: &ItemName,
        len: usize,
        owner: u64,
        truth: u64,
        now: Time,
    ) -> Option<(Epoch, Seq)> {
        let item = self.items.get_mut(name)?;
        item.last_pos += 1;
        item.last_seq += 1;
        let told = Payload {
            owner,
            epoch: item.epoch,
            seq: Seq(item.last_seq),
            truth,
        };
        if item.ring.len() == DEPTH {
            item.ring.pop_front();
        }
        item.ring.push_back(Sample {
            pos: item.last_pos,
            meta: SampleMeta {
                epoch: told.epoch,
                seq: told.seq,
                filtered: 0,
                capture: now,
                publish: now,
            },
            payload: told.payload(name, len),
        });
        Some((told.epoch, told.seq))
    }
}

impl Item {
    pub(super) fn current(&self) -> Option<&Sample> {
        self.ring.back()
    }

    /// The oldest sample still there after a position.
    pub(super) fn next(&self, seen: u64) -> Option<&Sample> {
        self.ring.iter().find(|sample| sample.pos > seen)
    }

    /// The oldest sample still there that is not older than this one.
    pub(super) fn first_from(&self, epoch: Epoch, seq: Seq) -> Option<&Sample> {
        let order = |sample: &&Sample| (sample.meta.epoch, sample.meta.seq) >= (epoch, seq);
        self.ring.iter().find(order)
    }

    pub(super) fn last_pos(&self) -> u64 {
        self.last_pos
    }
}

impl Payload {
    /// Bytes that only this sample of this item can have.
    fn payload(self, name: &ItemName, len: usize) -> Vec<u8> {
        let words = [
            self.owner,
            hash(name.as_str().as_bytes()),
            self.epoch.0,
            self.seq.0,
            self.truth,
        ];
        let mut bytes: Vec<u8> = words.into_iter().flat_map(u64::to_le_bytes).collect();
        let mut filler = Random::new(hash(&bytes));
        while bytes.len() + 8 < len.max(PAYLOAD_MIN) {
            bytes.extend_from_slice(&filler.next().to_le_bytes());
        }
        bytes.extend_from_slice(&hash(&bytes).to_le_bytes());
        bytes
    }

    /// Reads a payload; `None` when it is torn or of another item.
    pub(super) fn read(name: &ItemName, bytes: &[u8]) -> Option<Self> {
        let (body, checksum) = bytes.split_last_chunk::<8>()?;
        if u64::from_le_bytes(*checksum) != hash(body) {
            return None;
        }
        let (words, _) = body.as_chunks::<8>();
        let [owner, item, epoch, seq, truth, ..] = words else {
            return None;
        };
        let word = |bytes: &[u8; 8]| u64::from_le_bytes(*bytes);
        (word(item) == hash(name.as_str().as_bytes())).then(|| Self {
            owner: word(owner),
            epoch: Epoch(word(epoch)),
            seq: Seq(word(seq)),
            truth: word(truth),
        })
    }
}

/// FNV-1a.
fn hash(bytes: &[u8]) -> u64 {
    bytes.iter().fold(0xcbf2_9ce4_8422_2325, |hash, byte| {
        (hash ^ u64::from(*byte)).wrapping_mul(0x0000_0100_0000_01b3)
    })
}
