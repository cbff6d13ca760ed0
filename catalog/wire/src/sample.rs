//! What a data datagram holds: a preamble, then records, each a whole small sample or one fragment of a larger one.
//!
//! Laid out by hand and read without a copy. Layout: `PROTOCOL.md`, "Sample datagrams" and "Fragments".

use crate::{Epoch, Seq, StreamId, Time};

/// Length of the preamble at the head of each plaintext, bytes.
pub const PREAMBLE_BYTES: usize = 11;

/// What a record of a whole sample usually takes beside its payload, bytes; one that follows its like takes a quarter.
pub const RECORD_BYTES: usize = 24;

/// Most that a record of a fragment takes beside its payload, bytes. Senders leave so much room in each, whatever it takes:
/// the parts of a sample that comes by two ways, on which unlike numbers were left out, must not overlap in part.
pub const FRAGMENT_RECORD_BYTES: usize = HEAD_MAX;

/// Stands where a record could begin: whatever is left of the datagram only makes it as long as others.
pub const PADDING: u8 = 128;

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
    /// The sender has more for the destination than its rate lets through.
    pub is_limited: bool,
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

/// Where a record stands in its datagram, which decides what it need not say.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Place {
    /// It says all.
    First,
    /// Behind this one.
    After(Last),
    /// It and no other is in its datagram, whose header names the stream: it says neither that nor its length.
    Alone,
}

/// What a record tells of the one behind it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Last {
    stream: StreamId,
    meta: SampleMeta,
}

/// Reads the records of a plaintext, one by one.
#[derive(Clone, Debug)]
pub struct Records<'a> {
    rest: &'a [u8],
    /// The one stream inside, if the header names it.
    stream: Option<StreamId>,
    last: Option<Last>,
}

/// The bytes before a payload.
struct Head {
    bytes: [u8; HEAD_MAX],
    len: usize,
}

/// A plaintext that is no sequence of records.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("malformed sample record")]
pub struct Malformed;

impl Preamble {
    /// The bytes on the wire.
    pub fn to_bytes(self) -> [u8; PREAMBLE_BYTES] {
        let probe = if self.is_probe { PROBE } else { 0 };
        let limited = if self.is_limited { LIMITED } else { 0 };
        let flags = probe | limited;
        let [p0, p1] = self.path.to_le_bytes();
        let [n0, n1, n2, n3] = self.number.to_le_bytes();
        let [s0, s1, s2, s3] = self.sent_us.to_le_bytes();
        [p0, p1, flags, n0, n1, n2, n3, s0, s1, s2, s3]
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
    /// Length of the record on the wire at its place, bytes.
    pub fn encoded_len(&self, place: Place) -> usize {
        self.head(place).len.saturating_add(self.payload.len())
    }

    /// What this record tells of the one behind it.
    pub fn last(&self) -> Last {
        Last {
            stream: self.stream,
            meta: self.meta,
        }
    }

    /// Appends the record. Allocates only if `out` has no capacity for it.
    ///
    /// # Errors
    /// `Malformed` if [`Records`] would refuse it; `out` is then as it was.
    pub fn encode(&self, place: Place, out: &mut Vec<u8>) -> Result<(), Malformed> {
        if !self.is_valid() || self.payload.len() > usize::from(u16::MAX) {
            return Err(Malformed);
        }
        let head = self.head(place);
        out.extend_from_slice(head.bytes.get(..head.len).unwrap_or_default());
        out.extend_from_slice(self.payload);
        Ok(())
    }

    fn head(&self, place: Place) -> Head {
        let mut head = Head {
            bytes: [0; HEAD_MAX],
            len: 0,
        };
        let meta = &self.meta;
        let before = match place {
            Place::After(last) if self.follows(&last) => Some(last.meta.publish),
            Place::First | Place::After(_) | Place::Alone => None,
        };
        let alone = place == Place::Alone;
        let flag = |is_set: bool, flag: u8| if is_set { flag } else { 0 };
        head.push(
            flag(self.fragment.is_some(), FRAGMENT)
                | flag(self.repeat, REPEAT)
                | flag(self.gone, GONE)
                | flag(before.is_some(), NEXT)
                | flag(alone, ALONE)
                | flag(meta.capture != meta.publish, CAPTURE)
                | flag(meta.filtered != 0, FILTERED),
        );
        if !alone {
            head.varint(u64::try_from(self.payload.len()).unwrap_or(u64::MAX));
        }
        if let Some(before) = before {
            head.varint(meta.publish.0.wrapping_sub(before.0));
        } else {
            if !alone {
                head.varint(self.stream.0.into());
            }
            head.varint(meta.epoch.0 >> 32);
            head.varint(meta.epoch.0 & u64::from(u32::MAX));
            head.varint(meta.seq.0);
            head.varint(meta.publish.0);
        }
        if meta.capture != meta.publish {
            head.varint(zigzag(meta.publish.0.wrapping_sub(meta.capture.0)));
        }
        if meta.filtered != 0 && before.is_none() {
            head.varint(meta.filtered);
        }
        if let Some(fragment) = self.fragment {
            for byte in fragment.total.to_le_bytes() {
                head.push(byte);
            }
            for byte in fragment.offset.to_le_bytes() {
                head.push(byte);
            }
            head.push(fragment.parities);
        }
        head
    }

    /// Whether the sample is the next one of the same stream, and nothing was left out between.
    fn follows(&self, last: &Last) -> bool {
        let (meta, before) = (&self.meta, &last.meta);
        self.stream == last.stream
            && self.fragment.is_none()
            && meta.epoch == before.epoch
            && Some(meta.seq.0) == before.seq.0.checked_add(1)
            && meta.filtered == before.filtered
            && meta.publish >= before.publish
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
    /// Reads the head of an opened datagram, and starts at its first record. `stream` is the one that its header names, if
    /// it names one. `None` if the head is not one.
    pub fn open(plaintext: &'a [u8], stream: Option<StreamId>) -> Option<(Preamble, Self)> {
        let (&[p0, p1, flags], rest) = plaintext.split_first_chunk()?;
        let (number, rest) = rest.split_first_chunk()?;
        let (sent_us, rest) = rest.split_first_chunk()?;
        if flags & !(PROBE | LIMITED) != 0 {
            return None;
        }
        let preamble = Preamble {
            path: u16::from_le_bytes([p0, p1]),
            number: u32::from_le_bytes(*number),
            sent_us: u32::from_le_bytes(*sent_us),
            is_probe: flags & PROBE != 0,
            is_limited: flags & LIMITED != 0,
        };
        let rest = if preamble.is_probe { &[] } else { rest };
        let records = Self {
            stream,
            ..Self::new(rest)
        };
        Some((preamble, records))
    }

    /// Starts at a record.
    pub fn new(records: &'a [u8]) -> Self {
        Self {
            rest: records,
            stream: None,
            last: None,
        }
    }

    fn read(&self) -> Option<(Record<'a>, &'a [u8])> {
        let (&flags, rest) = self.rest.split_first()?;
        let is = |flag: u8| flags & flag != 0;
        if flags & !FLAGS != 0 || (is(NEXT) && flags & (FRAGMENT | ALONE) != 0) {
            return None;
        }
        let (len, rest) = match is(ALONE) {
            true => (None, rest),
            false => {
                let (len, rest) = varint(rest)?;
                (Some(u16::try_from(len).ok()?), rest)
            }
        };
        let (stream, mut meta, rest) = if is(NEXT) {
            let last = self.last?;
            let (ahead, rest) = varint(rest)?;
            let meta = SampleMeta {
                seq: Seq(last.meta.seq.0.checked_add(1)?),
                publish: Time(last.meta.publish.0.checked_add(ahead)?),
                ..last.meta
            };
            if is(FILTERED) != (meta.filtered != 0) {
                return None;
            }
            (last.stream, meta, rest)
        } else {
            let (stream, rest) = match is(ALONE) {
                true if self.last.is_some() => return None,
                true => (self.stream?, rest),
                false => {
                    let (stream, rest) = varint(rest)?;
                    (StreamId(u32::try_from(stream).ok()?), rest)
                }
            };
            let (ordinal, rest) = varint(rest)?;
            let (count, rest) = varint(rest)?;
            let epoch = u64::from(u32::try_from(ordinal).ok()?) << 32;
            let epoch = epoch | u64::from(u32::try_from(count).ok()?);
            let (seq, rest) = varint(rest)?;
            let (publish, rest) = varint(rest)?;
            let meta = SampleMeta {
                epoch: Epoch(epoch),
                seq: Seq(seq),
                filtered: 0,
                capture: Time(0),
                publish: Time(publish),
            };
            (stream, meta, rest)
        };
        let (earlier, rest) = match is(CAPTURE) {
            true => varint(rest)?,
            false => (0, rest),
        };
        meta.capture = Time(meta.publish.0.wrapping_sub(unzigzag(earlier)));
        let rest = if is(FILTERED) && !is(NEXT) {
            let (filtered, rest) = varint(rest)?;
            meta.filtered = filtered;
            rest
        } else {
            rest
        };
        let (fragment, rest) = if is(FRAGMENT) {
            let (total, rest) = rest.split_first_chunk()?;
            let (offset, rest) = rest.split_first_chunk()?;
            let (&parities, rest) = rest.split_first()?;
            let total = u32::from_le_bytes(*total);
            let offset = u32::from_le_bytes(*offset);
            let fragment = Fragment {
                total,
                offset,
                parities,
            };
            (Some(fragment), rest)
        } else {
            (None, rest)
        };
        let len = len.map_or(rest.len(), usize::from);
        let (payload, rest) = rest.split_at_checked(len)?;
        let record = Record {
            stream,
            repeat: is(REPEAT),
            gone: is(GONE),
            meta,
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
        if self.rest.first().is_none_or(|first| *first == PADDING) {
            return None;
        }
        let Some((record, rest)) = self.read() else {
            self.rest = &[];
            return Some(Err(Malformed));
        };
        self.rest = rest;
        self.last = Some(record.last());
        Some(Ok(record))
    }
}

impl Head {
    fn push(&mut self, byte: u8) {
        if let Some(place) = self.bytes.get_mut(self.len) {
            *place = byte;
            self.len = self.len.saturating_add(1);
        }
    }

    /// Seven bits a byte, the lowest first; the highest bit says that more follow.
    fn varint(&mut self, value: u64) {
        let mut rest = value;
        while rest > u64::from(MORE - 1) {
            let [low, ..] = rest.to_le_bytes();
            self.push(low | MORE);
            rest >>= 7;
        }
        let [low, ..] = rest.to_le_bytes();
        self.push(low);
    }
}

fn varint(bytes: &[u8]) -> Option<(u64, &[u8])> {
    let mut value = 0_u64;
    let mut rest = bytes;
    for shift in (0_u32..64).step_by(7) {
        let (&byte, after) = rest.split_first()?;
        rest = after;
        let bits = u64::from(byte & !MORE);
        // Nothing is shifted out at the top.
        value |= bits.checked_shl(shift).filter(|v| v >> shift == bits)?;
        if byte & MORE == 0 {
            return Some((value, rest));
        }
    }
    None
}

/// A difference that may be negative, as a number that is small if that is near 0.
fn zigzag(difference: u64) -> u64 {
    let signed = difference.cast_signed();
    ((signed << 1) ^ (signed >> 63)).cast_unsigned()
}

fn unzigzag(value: u64) -> u64 {
    (value >> 1) ^ (value & 1).wrapping_neg()
}

/// Flag: the record holds a part of a sample.
const FRAGMENT: u8 = 1;
/// Flag: the sample may have been sent before.
const REPEAT: u8 = 2;
/// Flag: the sample cannot be had any more.
const GONE: u8 = 4;
/// Flag: the next sample of the record before.
const NEXT: u8 = 8;
/// Flag: neither stream nor length is given.
const ALONE: u8 = 16;
/// Flag: captured at another time than published.
const CAPTURE: u8 = 32;
/// Flag: some samples were left out.
const FILTERED: u8 = 64;
/// All flags that there are.
const FLAGS: u8 = 127;
/// In a byte of a number: more follow.
const MORE: u8 = 128;
/// Flags, the length, the number of the stream, two of 32 bits, four of 64 bits, and what a fragment says of itself.
const HEAD_MAX: usize = 1 + 3 + 5 + 2 * 5 + 4 * 10 + 9;
/// Flag of the preamble: padding follows.
const PROBE: u8 = 1;
/// Flag of the preamble: the rate holds the sender back.
const LIMITED: u8 = 2;

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
                epoch: Epoch(0x11_0000_0010),
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
        record.encode(Place::First, &mut bytes).unwrap();
        assert_eq!(bytes.len(), record.encoded_len(Place::First));
        bytes
    }

    /// The same stream's next sample.
    fn next<'a>(record: &Record<'_>, payload: &'a [u8]) -> Record<'a> {
        Record {
            stream: record.stream,
            repeat: false,
            gone: false,
            meta: SampleMeta {
                seq: Seq(record.meta.seq.0 + 1),
                capture: Time(record.meta.publish.0 + 300),
                publish: Time(record.meta.publish.0 + 300),
                ..record.meta
            },
            fragment: None,
            payload,
        }
    }

    #[test]
    fn whole_sample_is_golden() {
        let golden = [
            2 + 32 + 64,
            2,
            0x81,
            0x84,
            0x8c,
            0x20,
            0x11,
            0x10,
            0x20,
            0x50,
            0x20,
            0x30,
            b'a',
            b'b',
        ];
        assert_eq!(encoded(record(b"ab")), golden);
    }

    #[test]
    fn what_follows_is_golden() {
        let first = record(b"ab");
        let second = next(&first, b"c");
        let mut bytes = encoded(first);
        let start = bytes.len();
        second
            .encode(Place::After(first.last()), &mut bytes)
            .unwrap();
        assert_eq!(bytes[start..], [8 + 64, 1, 0xac, 0x02, b'c']);
        let read: Vec<_> = Records::new(&bytes).collect();
        assert_eq!(read, [Ok(first), Ok(second)]);
        // Alone it follows nothing.
        assert_eq!(Records::new(&bytes[start..]).next(), Some(Err(Malformed)));
    }

    #[test]
    fn one_that_is_alone_is_golden_and_needs_the_stream_of_its_header() {
        let mut bytes = vec![0; PREAMBLE_BYTES];
        let alone = Record {
            repeat: false,
            meta: SampleMeta {
                filtered: 0,
                capture: Time(0x50),
                ..record(b"").meta
            },
            ..record(b"ab")
        };
        alone.encode(Place::Alone, &mut bytes).unwrap();
        assert_eq!(
            bytes[PREAMBLE_BYTES..],
            [16, 0x11, 0x10, 0x20, 0x50, b'a', b'b']
        );
        let (_, records) = Records::open(&bytes, Some(alone.stream)).unwrap();
        assert_eq!(records.collect::<Vec<_>>(), [Ok(alone)]);
        let (_, mut records) = Records::open(&bytes, None).unwrap();
        assert_eq!(records.next(), Some(Err(Malformed)));
        let mut behind = encoded(record(b"ab"));
        alone.encode(Place::Alone, &mut behind).unwrap();
        let mut records = Records::new(&behind);
        records.stream = Some(alone.stream);
        assert_eq!(records.nth(1), Some(Err(Malformed)));
    }

    #[test]
    fn one_of_1400_bytes_fits_an_ethernet_frame_however_old_its_stream_is() {
        let payload = [0; 1_400];
        let old = Record {
            stream: StreamId(u32::MAX),
            meta: SampleMeta {
                epoch: Epoch(100 << 32 | 100),
                seq: Seq((1 << 35) - 1),
                filtered: (1 << 35) - 1,
                // After two years.
                capture: Time((1 << 56) - 1),
                publish: Time((1 << 56) - 1),
            },
            ..record(&payload)
        };
        let datagram = crate::seal::OVERHEAD_BYTES + PREAMBLE_BYTES + old.encoded_len(Place::Alone);
        assert!(datagram <= 1_472, "{datagram}");
    }

    #[test]
    fn fragment_is_golden() {
        let bytes = encoded(fragment(0x102, 0x100, b"ab"));
        assert_eq!(bytes[..2], [1 + 2 + 32 + 64, 2]);
        assert_eq!(bytes[12..], [2, 1, 0, 0, 0, 1, 0, 0, 0, b'a', b'b']);
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
        assert_eq!(bytes[..2], [1 + 2 + 32 + 64, 2]);
        assert_eq!(bytes[12..], [3, 1, 0, 0, 6, 1, 0, 0, 2, b'p', b'q']);
        assert_eq!(Records::new(&bytes).next(), Some(Ok(good)));
        assert_eq!(good.fragment.unwrap().parity(2), Some(1));
        assert_eq!(parity(0x104, 1, b"pq").fragment.unwrap().parity(2), Some(0));
        for bad in [
            parity(0x106, 1, b"pq"),
            parity(0x105, 2, b"pq"),
            parity(0x105, 2, b"p"),
            parity(0x103, 0, b"pq"),
        ] {
            let refused = bad.encode(Place::First, &mut Vec::new());
            assert_eq!(refused, Err(Malformed), "{bad:?}");
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
            let refused = bad.encode(Place::First, &mut Vec::new());
            assert_eq!(refused, Err(Malformed), "{bad:?}");
        }
        let good = encoded(record(b"ab"));
        for (at, value) in [(0, 129), (0, 8), (0, 16), (0, 2 + 4), (1, 3), (8, 0)] {
            let mut bad = good.clone();
            bad[at] = value;
            assert_eq!(Records::new(&bad).next(), Some(Err(Malformed)), "{at}");
        }
        for len in 1..good.len() {
            let mut records = Records::new(&good[..len]);
            assert_eq!(records.next(), Some(Err(Malformed)));
            assert_eq!(records.next(), None);
        }
        let mut padded = good;
        padded.extend([PADDING, 1, 2]);
        assert_eq!(Records::new(&padded).count(), 1);
        // A number of more than 64 bits.
        let mut long = vec![0xff; 12];
        long[0] = 0;
        assert_eq!(Records::new(&long).next(), Some(Err(Malformed)));
    }

    #[test]
    fn a_preamble_reads_back_and_a_probe_has_no_records() {
        for flags in 0..4 {
            let (is_probe, is_limited) = (flags & 1 != 0, flags & 2 != 0);
            let preamble = Preamble {
                path: 0x0102,
                number: 0x0304_0506,
                sent_us: 0x0708_090a,
                is_probe,
                is_limited,
            };
            let mut bytes = preamble.to_bytes().to_vec();
            assert_eq!(bytes[..4], [2, 1, flags, 6]);
            bytes.extend([9; 3]);
            let (read, records) = Records::open(&bytes, None).unwrap();
            assert_eq!(read, preamble);
            assert_eq!(records.count(), usize::from(!is_probe));
        }
        assert!(Records::open(&[0, 0, 4, 0, 0, 0, 0, 0, 0, 0, 0], None).is_none());
        assert!(Records::open(&[0; 10], None).is_none());
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
        assert_eq!(bad.encode(Place::First, &mut Vec::new()), Err(Malformed));
    }

    proptest! {
        #[test]
        fn arbitrary_bytes_end_and_reencode(bytes in prop::collection::vec(any::<u8>(), 0..300)) {
            let read: Vec<_> = Records::new(&bytes).map_while(Result::ok).collect();
            let mut again = Vec::new();
            let mut place = Place::First;
            for record in &read {
                record.encode(place, &mut again).unwrap();
                place = Place::After(record.last());
            }
            let reread: Vec<_> = Records::new(&again).map_while(Result::ok).collect();
            prop_assert_eq!(read, reread);
        }

        #[test]
        fn whatever_is_written_is_read(
            metas in prop::collection::vec((any::<u64>(), 1_u64.., any::<[u64; 3]>(), any::<bool>()), 1..20),
        ) {
            let mut bytes = Vec::new();
            let mut place = Place::First;
            let mut written: Vec<Record<'_>> = Vec::new();
            for (epoch, seq, [filtered, capture, publish], follows) in metas {
                let meta = SampleMeta {
                    epoch: Epoch(epoch),
                    seq: Seq(seq),
                    filtered,
                    capture: Time(capture),
                    publish: Time(publish),
                };
                let new = Record { meta, ..record(b"x") };
                let record = match written.last() {
                    Some(last) if follows && last.meta.seq.0 < u64::MAX && last.meta.publish.0 < u64::MAX - 300 => next(last, b"y"),
                    Some(_) | None => new,
                };
                record.encode(place, &mut bytes).unwrap();
                place = Place::After(record.last());
                written.push(record);
            }
            let read: Vec<_> = Records::new(&bytes).map_while(Result::ok).collect();
            prop_assert_eq!(read, written);
        }
    }
}
