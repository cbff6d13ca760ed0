//! What a data datagram holds: a preamble, then records, each a whole small sample or one fragment of a larger one.
//!
//! Laid out by hand and read without a copy. Layout: `PROTOCOL.md`, "Sample datagrams" and "Fragments".

use crate::{Epoch, Seq, StreamId, Time};

/// Length of the preamble at the head of each plaintext, bytes.
pub const PREAMBLE_BYTES: usize = 12;

/// Length of a record before its payload, bytes.
pub const RECORD_BYTES: usize = 48;

/// Length of a fragment's record before its payload, bytes.
pub const FRAGMENT_RECORD_BYTES: usize = 56;

/// Greatest sample, bytes: 64 MiB.
pub const MAX_SAMPLE_BYTES: usize = 64 << 20;

/// What is known of a sample beside its payload. Times are of the origin's clock.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SampleMeta {
    /// The writer's tenure.
    pub epoch: Epoch,
    /// Number in the epoch, from 1.
    pub seq: Seq,
    /// How many earlier samples of the epoch the source left out on purpose for this stream.
    pub filtered: u64,
    /// When the value was true.
    pub capture: Time,
    /// When it was written.
    pub publish: Time,
}

/// What lets a receiver tell how a path does: it counts what is missing, and sees the time on the way change.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Preamble {
    /// The sender's number for the destination.
    pub path: u16,
    /// How many datagrams went there, this one included; comes round.
    pub number: u32,
    /// When it left, microseconds of the sender's clock; comes round each 71 minutes.
    pub sent_us: u32,
    /// What follows is padding: the datagram only tries whether its length gets through.
    pub is_probe: bool,
}

/// Place of a fragment in its sample.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Fragment {
    /// Length of the whole sample, bytes.
    pub total: u32,
    /// Payload bytes of the sample before this fragment. From the sample's end on, rounded up to whole fragments, come
    /// its parities.
    pub offset: u32,
    /// How many parities protect the sample: fragments of its own, as long as those of the sample, of which each stands
    /// in for any one that is lost.
    pub parities: u8,
}

/// One record of a data datagram.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Record<'a> {
    /// The stream that it belongs to.
    pub stream: StreamId,
    /// Whether the sample may have been sent before: a repair.
    pub repeat: bool,
    /// The sample cannot be had any more, nor `payload` others before it: the ring let them go. Its payload is that
    /// number, 8 bytes.
    pub gone: bool,
    /// Which sample.
    pub meta: SampleMeta,
    /// Which part of the sample; `None` is all of it.
    pub fragment: Option<Fragment>,
    /// The sample's bytes, or the fragment's.
    pub payload: &'a [u8],
}

/// Reads the records of a plaintext, one by one.
#[derive(Clone, Debug)]
pub struct Records<'a> {
    rest: &'a [u8],
}

/// A plaintext that is no sequence of records.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("malformed sample record")]
pub struct Malformed;

impl Preamble {
    /// The bytes on the wire.
    pub fn to_bytes(self) -> [u8; PREAMBLE_BYTES] {
        let flags = if self.is_probe { PROBE } else { 0 };
        let [p0, p1] = self.path.to_le_bytes();
        let [f0, f1] = flags.to_le_bytes();
        let [n0, n1, n2, n3] = self.number.to_le_bytes();
        let [s0, s1, s2, s3] = self.sent_us.to_le_bytes();
        [p0, p1, f0, f1, n0, n1, n2, n3, s0, s1, s2, s3]
    }
}

impl Fragment {
    /// Which parity of its sample a fragment of `len` bytes is, from 0; `None` for a part of the sample itself, and for
    /// one that lies nowhere.
    pub fn parity(&self, len: usize) -> Option<u8> {
        let len = u32::try_from(len).ok().filter(|len| *len > 0)?;
        let index = self.offset.checked_div(len)?;
        let parity = index.checked_sub(self.total.div_ceil(len))?;
        let parity = u8::try_from(parity).ok()?;
        let is_aligned = self.offset.is_multiple_of(len);
        (is_aligned && parity < self.parities).then_some(parity)
    }
}

impl<'a> Record<'a> {
    /// Length of the record on the wire, bytes.
    pub fn encoded_len(&self) -> usize {
        let head = match self.fragment {
            None => RECORD_BYTES,
            Some(_) => FRAGMENT_RECORD_BYTES,
        };
        head.saturating_add(self.payload.len())
    }

    /// Appends the record. Allocates only if `out` has no capacity for it.
    ///
    /// # Errors
    /// `Malformed` if [`Records`] would refuse it; `out` is then as it was.
    pub fn encode(&self, out: &mut Vec<u8>) -> Result<(), Malformed> {
        if !self.is_valid() {
            return Err(Malformed);
        }
        let len = u16::try_from(self.payload.len()).map_err(|_| Malformed)?;
        let fragment = if self.fragment.is_some() { FRAGMENT } else { 0 };
        let repeat = if self.repeat { REPEAT } else { 0 };
        let gone = if self.gone { GONE } else { 0 };
        // One growth of the vector for the head keeps the encoder at memcpy speed.
        let mut head = [0; RECORD_BYTES];
        let parities = self.fragment.map_or(0, |fragment| fragment.parities);
        let words = [
            (u64::from(self.stream.0))
                | (u64::from(len) << 32)
                | (u64::from(fragment | repeat | gone) << 48)
                | (u64::from(parities) << 56),
            self.meta.epoch.0,
            self.meta.seq.0,
            self.meta.filtered,
            self.meta.capture.0,
            self.meta.publish.0,
        ];
        for (slot, word) in head.chunks_exact_mut(8).zip(words) {
            slot.copy_from_slice(&word.to_le_bytes());
        }
        out.extend_from_slice(&head);
        if let Some(fragment) = self.fragment {
            out.extend_from_slice(&fragment.total.to_le_bytes());
            out.extend_from_slice(&fragment.offset.to_le_bytes());
        }
        out.extend_from_slice(self.payload);
        Ok(())
    }

    fn is_valid(&self) -> bool {
        let whole = self.fragment.is_none_or(|fragment| {
            let end = u32::try_from(self.payload.len())
                .ok()
                .and_then(|len| fragment.offset.checked_add(len));
            let limit = u32::try_from(MAX_SAMPLE_BYTES).unwrap_or(u32::MAX);
            !self.payload.is_empty()
                && fragment.total <= limit
                && (end.is_some_and(|end| end <= fragment.total)
                    || fragment.parity(self.payload.len()).is_some())
        });
        let gone = !self.gone || (self.fragment.is_none() && self.payload.len() == 8);
        whole && gone && self.meta.seq.0 != 0
    }

    /// How many samples a record about lost ones is about: those that end with its own.
    pub fn gone_count(&self) -> Option<u64> {
        let count = u64::from_le_bytes(*self.payload.first_chunk()?);
        self.gone
            .then_some(count.saturating_add(1).min(self.meta.seq.0))
    }
}

impl<'a> Records<'a> {
    /// Reads the head of an opened datagram, and starts at its first record. `None` if the head is not one.
    pub fn open(plaintext: &'a [u8]) -> Option<(Preamble, Self)> {
        let (&[p0, p1, f0, f1], rest) = plaintext.split_first_chunk()?;
        let (number, rest) = rest.split_first_chunk()?;
        let (sent_us, rest) = rest.split_first_chunk()?;
        let flags = u16::from_le_bytes([f0, f1]);
        if flags & !PROBE != 0 {
            return None;
        }
        let preamble = Preamble {
            path: u16::from_le_bytes([p0, p1]),
            number: u32::from_le_bytes(*number),
            sent_us: u32::from_le_bytes(*sent_us),
            is_probe: flags & PROBE != 0,
        };
        let rest = if preamble.is_probe { &[] } else { rest };
        Some((preamble, Self { rest }))
    }

    /// Starts at a record.
    pub fn new(records: &'a [u8]) -> Self {
        Self { rest: records }
    }

    fn read(bytes: &'a [u8]) -> Option<(Record<'a>, &'a [u8])> {
        let (&[s0, s1, s2, s3, l0, l1, flags, parities], rest) = bytes.split_first_chunk()?;
        if flags & !(FRAGMENT | REPEAT | GONE) != 0 || (parities != 0 && flags & FRAGMENT == 0) {
            return None;
        }
        let (epoch, rest) = split_u64(rest)?;
        let (seq, rest) = split_u64(rest)?;
        let (filtered, rest) = split_u64(rest)?;
        let (capture, rest) = split_u64(rest)?;
        let (publish, rest) = split_u64(rest)?;
        let (fragment, rest) = if flags & FRAGMENT == 0 {
            (None, rest)
        } else {
            let (total, rest) = rest.split_first_chunk()?;
            let (offset, rest) = rest.split_first_chunk()?;
            let total = u32::from_le_bytes(*total);
            let offset = u32::from_le_bytes(*offset);
            let fragment = Fragment {
                total,
                offset,
                parities,
            };
            (Some(fragment), rest)
        };
        let len = usize::from(u16::from_le_bytes([l0, l1]));
        let (payload, rest) = rest.split_at_checked(len)?;
        let record = Record {
            stream: StreamId(u32::from_le_bytes([s0, s1, s2, s3])),
            repeat: flags & REPEAT != 0,
            gone: flags & GONE != 0,
            meta: SampleMeta {
                epoch: Epoch(epoch),
                seq: Seq(seq),
                filtered,
                capture: Time(capture),
                publish: Time(publish),
            },
            fragment,
            payload,
        };
        record.is_valid().then_some((record, rest))
    }
}

impl<'a> Iterator for Records<'a> {
    type Item = Result<Record<'a>, Malformed>;

    /// The next record; after an error nothing more, since the place of the next record is then unknown.
    fn next(&mut self) -> Option<Self::Item> {
        if self.rest.is_empty() {
            return None;
        }
        let Some((record, rest)) = Self::read(self.rest) else {
            self.rest = &[];
            return Some(Err(Malformed));
        };
        self.rest = rest;
        Some(Ok(record))
    }
}

fn split_u64(bytes: &[u8]) -> Option<(u64, &[u8])> {
    let (word, rest) = bytes.split_first_chunk()?;
    Some((u64::from_le_bytes(*word), rest))
}

/// Flag: the record holds a part of a sample.
const FRAGMENT: u8 = 1;
/// Flag: the sample may have been sent before.
const REPEAT: u8 = 2;
/// Flag: the sample cannot be had any more.
const GONE: u8 = 4;
/// Flag of the preamble: padding follows.
const PROBE: u16 = 1;

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn record(payload: &[u8]) -> Record<'_> {
        Record {
            stream: StreamId(0x0403_0201),
            repeat: true,
            gone: false,
            meta: SampleMeta {
                epoch: Epoch(0x10),
                seq: Seq(0x20),
                filtered: 0x30,
                capture: Time(0x40),
                publish: Time(0x50),
            },
            fragment: None,
            payload,
        }
    }

    fn fragment(total: u32, offset: u32, payload: &[u8]) -> Record<'_> {
        Record {
            fragment: Some(Fragment {
                total,
                offset,
                parities: 0,
            }),
            ..record(payload)
        }
    }

    fn encoded(record: Record<'_>) -> Vec<u8> {
        let mut bytes = Vec::new();
        record.encode(&mut bytes).unwrap();
        assert_eq!(bytes.len(), record.encoded_len());
        bytes
    }

    #[test]
    fn whole_sample_is_golden() {
        let mut golden = vec![1, 2, 3, 4, 2, 0, 2, 0];
        for byte in [0x10, 0x20, 0x30, 0x40, 0x50] {
            golden.extend([byte, 0, 0, 0, 0, 0, 0, 0]);
        }
        golden.extend(*b"ab");
        assert_eq!(encoded(record(b"ab")), golden);
    }

    #[test]
    fn fragment_is_golden() {
        let bytes = encoded(fragment(0x102, 0x100, b"ab"));
        assert_eq!(bytes[4..8], [2, 0, 3, 0]);
        assert_eq!(bytes[48..], [2, 1, 0, 0, 0, 1, 0, 0, b'a', b'b']);
    }

    #[test]
    fn parities_come_after_the_end_of_their_sample() {
        let parity = |offset, parities, payload| Record {
            fragment: Some(Fragment {
                total: 0x103,
                offset,
                parities,
            }),
            ..record(payload)
        };
        // The sample takes 130 fragments of 2 bytes, the last of them short.
        let good = parity(0x106, 2, b"pq");
        let bytes = encoded(good);
        assert_eq!(bytes[4..8], [2, 0, 3, 2]);
        assert_eq!(bytes[48..], [3, 1, 0, 0, 6, 1, 0, 0, b'p', b'q']);
        assert_eq!(Records::new(&bytes).next(), Some(Ok(good)));
        assert_eq!(good.fragment.unwrap().parity(2), Some(1));
        assert_eq!(parity(0x104, 1, b"pq").fragment.unwrap().parity(2), Some(0));
        for bad in [
            parity(0x106, 1, b"pq"),
            parity(0x105, 2, b"pq"),
            parity(0x105, 2, b"p"),
            parity(0x103, 0, b"pq"),
        ] {
            assert_eq!(bad.encode(&mut Vec::new()), Err(Malformed), "{bad:?}");
        }
    }

    #[test]
    fn several_records_read_back_in_order() {
        let mut bytes = encoded(record(b"first"));
        bytes.extend(encoded(record(b"")));
        bytes.extend(encoded(fragment(9, 4, b"third")));
        let records: Vec<_> = Records::new(&bytes).collect();
        assert_eq!(
            records,
            [
                Ok(record(b"first")),
                Ok(record(b"")),
                Ok(fragment(9, 4, b"third"))
            ]
        );
    }

    #[test]
    fn lies_are_malformed() {
        let limit = u32::try_from(MAX_SAMPLE_BYTES).unwrap();
        for bad in [
            fragment(3, 1, b"abc"),
            fragment(9, 9, b""),
            fragment(limit + 1, 0, b"a"),
            fragment(u32::MAX, u32::MAX, b"a"),
        ] {
            assert_eq!(bad.encode(&mut Vec::new()), Err(Malformed), "{bad:?}");
        }
        let good = encoded(record(b"ab"));
        for (at, value) in [(4, 3), (6, 4), (6, 8), (7, 1), (16, 0)] {
            let mut bad = good.clone();
            bad[at] = value;
            assert_eq!(Records::new(&bad).next(), Some(Err(Malformed)), "{at}");
        }
        for len in 1..good.len() {
            let mut records = Records::new(&good[..len]);
            assert_eq!(records.next(), Some(Err(Malformed)));
            assert_eq!(records.next(), None);
        }
    }

    #[test]
    fn a_preamble_reads_back_and_a_probe_has_no_records() {
        for is_probe in [false, true] {
            let preamble = Preamble {
                path: 0x0102,
                number: 0x0304_0506,
                sent_us: 0x0708_090a,
                is_probe,
            };
            let mut bytes = preamble.to_bytes().to_vec();
            assert_eq!(bytes[..4], [2, 1, u8::from(is_probe), 0]);
            bytes.extend([9; 3]);
            let (read, records) = Records::open(&bytes).unwrap();
            assert_eq!(read, preamble);
            assert_eq!(records.count(), usize::from(!is_probe));
        }
        assert!(Records::open(&[0, 0, 2, 0, 0, 0, 0, 0, 0, 0, 0, 0]).is_none());
        assert!(Records::open(&[0; 11]).is_none());
    }

    #[test]
    fn lost_samples_are_told_by_number() {
        let count = 4_u64.to_le_bytes();
        let gone = Record {
            gone: true,
            ..record(&count)
        };
        let bytes = encoded(gone);
        assert_eq!(Records::new(&bytes).next(), Some(Ok(gone)));
        assert_eq!(gone.gone_count(), Some(5));
        let bad = Record {
            gone: true,
            ..record(b"short")
        };
        assert_eq!(bad.encode(&mut Vec::new()), Err(Malformed));
    }

    proptest! {
        #[test]
        fn arbitrary_bytes_end_and_reencode(bytes in prop::collection::vec(any::<u8>(), 0..300)) {
            let mut again = Vec::new();
            for record in Records::new(&bytes).map_while(Result::ok) {
                record.encode(&mut again).unwrap();
            }
            prop_assert!(bytes.starts_with(&again));
        }
    }
}
