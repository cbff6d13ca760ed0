//! Samples that overtook the grant of their stream.
//!
//! The owner of an item sends its present value as it grants the stream. The grant goes through the reader's control
//! loop and the value does not, so the value is often there first. It is kept for a moment instead of being asked for
//! again.

use std::collections::VecDeque;
use std::time::Duration;

use ddx_wire::sample::{Place, Record};
use ddx_wire::{StreamId, Tag, Time};

/// Records of streams that are not expected yet, oldest first.
#[derive(Debug, Default)]
pub(super) struct Early {
    records: VecDeque<Entry>,
    held_bytes: usize,
}

#[derive(Debug)]
struct Entry {
    tag: Tag,
    stream: StreamId,
    at: Time,
    bytes: Vec<u8>,
}

impl Early {
    /// Keeps a record, and drops older ones for which there is no room or no hope. How many were dropped.
    pub(super) fn keep(&mut self, tag: Tag, record: &Record<'_>, now: Time) -> u64 {
        let mut bytes = Vec::with_capacity(record.encoded_len(Place::First));
        if record.encode(Place::First, &mut bytes).is_err() {
            return 1;
        }
        self.held_bytes += bytes.len();
        self.records.push_back(Entry {
            tag,
            stream: record.stream,
            at: now,
            bytes,
        });
        let mut dropped = 0;
        while let Some(oldest) = self.records.front()
            && (self.held_bytes > BYTES
                || self.records.len() > RECORDS
                || now.since(oldest.at) > AGE)
        {
            self.held_bytes -= oldest.bytes.len();
            self.records.pop_front();
            dropped += 1;
        }
        dropped
    }

    /// Takes out what came of a stream lately, encoded, in order of arrival.
    pub(super) fn take(&mut self, tag: Tag, stream: StreamId, now: Time) -> Vec<Vec<u8>> {
        let mut taken = Vec::new();
        let held_bytes = &mut self.held_bytes;
        self.records.retain_mut(|entry| {
            let belongs = (entry.tag, entry.stream) == (tag, stream);
            if belongs {
                *held_bytes -= entry.bytes.len();
                if now.since(entry.at) <= AGE {
                    taken.push(std::mem::take(&mut entry.bytes));
                }
            }
            !belongs
        });
        taken
    }
}

/// `PROTOCOL.md#sample-datagrams`: "kept for 1 s".
const AGE: Duration = Duration::from_secs(1);
/// Several thousand first values, or the fragments of some large ones; what does not fit is repeated by its sender.
const BYTES: usize = 1 << 20;
const RECORDS: usize = 4_096;

#[cfg(test)]
mod tests {
    use ddx_wire::Seq;
    use ddx_wire::sample::SampleMeta;

    use super::*;

    const TAG: Tag = Tag(1);

    fn keep(early: &mut Early, stream: u32, payload: &[u8], now: Time) -> u64 {
        let record = Record {
            stream: StreamId(stream),
            repeat: false,
            gone: false,
            meta: SampleMeta {
                seq: Seq(1),
                ..SampleMeta::default()
            },
            fragment: None,
            payload,
        };
        early.keep(TAG, &record, now)
    }

    #[test]
    fn a_stream_takes_its_own_records_once() {
        let mut early = Early::default();
        keep(&mut early, 1, b"a", Time(0));
        keep(&mut early, 2, b"b", Time(0));
        keep(&mut early, 1, b"cc", Time(0));
        let taken = early.take(TAG, StreamId(1), Time(1));
        assert_eq!(taken.len(), 2);
        assert!(taken[0].ends_with(b"a") && taken[1].ends_with(b"cc"));
        assert!(early.take(TAG, StreamId(1), Time(1)).is_empty());
        assert!(early.take(Tag(2), StreamId(2), Time(1)).is_empty());
        assert_eq!(early.take(TAG, StreamId(2), Time(1)).len(), 1);
        assert_eq!(early.held_bytes, 0);
    }

    #[test]
    fn what_is_old_or_too_much_goes() {
        let mut early = Early::default();
        assert_eq!(keep(&mut early, 1, b"a", Time(0)), 0);
        let late = Time(0) + AGE + Duration::from_nanos(1);
        assert!(early.take(TAG, StreamId(1), late).is_empty());
        keep(&mut early, 1, b"a", Time(0));
        assert_eq!(keep(&mut early, 1, b"b", late), 1);
        let large = vec![0; 60_000];
        let dropped: u64 = (0..100).map(|_| keep(&mut early, 1, &large, late)).sum();
        assert!(dropped > 80 && early.held_bytes <= BYTES, "{dropped}");
    }
}
