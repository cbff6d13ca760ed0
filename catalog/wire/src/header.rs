//! The 24 bytes at the head of each datagram, in the clear and authenticated.
//!
//! They are enough to drop what is not for this host before any cryptography: another domain's datagrams by key id,
//! this host's own and unknown senders' by tag, unread streams by stream id. Layout: `PROTOCOL.md`, "Datagram header".

use crate::{StreamId, Tag};

/// Length of the header at the head of each datagram, bytes.
pub const HEADER_BYTES: usize = 24;

/// Length of the authentication tag at the end of each datagram, bytes.
pub const SEAL_BYTES: usize = 16;

/// What sealing adds to a plaintext, bytes.
pub const OVERHEAD_BYTES: usize = 40;

/// Greatest datagram that this protocol sends, header and seal included, bytes: fits every link without IP fragments.
pub const MAX_DATAGRAM_BYTES: usize = 1_200;

/// Version of the protocol, the first byte of each datagram. Others are dropped and counted.
pub const PROTOCOL_VERSION: u8 = 4;

/// The stream id of a datagram that carries several streams, or none.
pub const MIXED_STREAMS: StreamId = StreamId(0);

/// Which queue a datagram came from. Each lane has its own counter and replay window.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[repr(u8)]
pub enum Lane {
    /// Membership, directory, interest, clocks.
    Control = 0,
    /// First contact, before any challenge was answered.
    Hello = 1,
    /// Commands and repairs: samples that must not queue behind others.
    Commands = 2,
    /// Samples that fit one datagram.
    Values = 3,
    /// Fragments of larger samples.
    Bulk = 4,
}

/// What a key is for. Lanes of one purpose share a key, and differ in the nonce.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Purpose {
    /// The control lane.
    Control,
    /// The hello lane, whose key depends on the sender's tag alone, so that strangers can be read.
    Hello,
    /// The commands, values and bulk lanes.
    Data,
}

/// Short public name of a domain key: tells another domain's datagrams apart without decrypting.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct KeyId(pub u16);

/// The clear part of a datagram.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Header {
    /// Queue that the datagram came from.
    pub lane: Lane,
    /// Which domain key sealed it.
    pub key: KeyId,
    /// The one stream inside, or [`MIXED_STREAMS`].
    pub stream: StreamId,
    /// Who sealed it.
    pub sender: Tag,
    /// Count of datagrams of this sender in this lane, from 0.
    pub counter: u64,
}

/// Why a datagram was dropped. Each is counted; none is an error of this host.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, thiserror::Error)]
pub enum Refused {
    /// Shorter than a header and a seal.
    #[error("truncated")]
    Truncated,
    /// Of another version of the protocol.
    #[error("other protocol version")]
    Version,
    /// Sealed with another domain's key.
    #[error("foreign domain")]
    Foreign,
    /// Sent by this host itself, looped back by multicast.
    #[error("own datagram")]
    Own,
    /// From a sender that has not answered a challenge.
    #[error("unknown sender")]
    UnknownSender,
    /// Of a lane that does not exist or has no business at this socket.
    #[error("wrong lane")]
    Lane,
    /// Of a stream that nobody here reads.
    #[error("unwanted stream")]
    Unwanted,
    /// Seen before, or older than the replay window.
    #[error("replayed")]
    Replayed,
    /// The seal does not fit: damaged, or made without the key.
    #[error("forged")]
    Forged,
    /// Sealed properly, but its content breaks the protocol.
    #[error("malformed")]
    Malformed,
}

/// How many datagrams were dropped, by reason.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct RefusedCounts([u64; Refused::ALL.len()]);

impl Lane {
    /// The lane with this number, if there is one.
    pub fn from_byte(byte: u8) -> Option<Self> {
        match byte {
            0 => Some(Self::Control),
            1 => Some(Self::Hello),
            2 => Some(Self::Commands),
            3 => Some(Self::Values),
            4 => Some(Self::Bulk),
            _ => None,
        }
    }

    /// The number on the wire.
    pub fn to_byte(self) -> u8 {
        match self {
            Self::Control => 0,
            Self::Hello => 1,
            Self::Commands => 2,
            Self::Values => 3,
            Self::Bulk => 4,
        }
    }

    /// The key that seals this lane.
    pub fn purpose(self) -> Purpose {
        match self {
            Self::Control => Purpose::Control,
            Self::Hello => Purpose::Hello,
            Self::Commands | Self::Values | Self::Bulk => Purpose::Data,
        }
    }
}

impl Header {
    /// Reads the head of a datagram that still has its seal.
    ///
    /// # Errors
    /// `Truncated`, `Version` or `Lane`; the rest is for the caller to judge.
    pub fn parse(datagram: &[u8]) -> Result<Self, Refused> {
        if datagram.len() < OVERHEAD_BYTES {
            return Err(Refused::Truncated);
        }
        let (&[version, lane], rest) = datagram.split_first_chunk().ok_or(Refused::Truncated)?;
        if version != PROTOCOL_VERSION {
            return Err(Refused::Version);
        }
        let lane = Lane::from_byte(lane).ok_or(Refused::Lane)?;
        let (key, rest) = rest.split_first_chunk().ok_or(Refused::Truncated)?;
        let (stream, rest) = rest.split_first_chunk().ok_or(Refused::Truncated)?;
        let (sender, rest) = rest.split_first_chunk().ok_or(Refused::Truncated)?;
        let counter = rest.first_chunk().ok_or(Refused::Truncated)?;
        Ok(Self {
            lane,
            key: KeyId(u16::from_le_bytes(*key)),
            stream: StreamId(u32::from_le_bytes(*stream)),
            sender: Tag(u64::from_le_bytes(*sender)),
            counter: u64::from_le_bytes(*counter),
        })
    }

    /// The bytes that [`Header::parse`] reads.
    pub fn to_bytes(self) -> [u8; HEADER_BYTES] {
        let [k0, k1] = self.key.0.to_le_bytes();
        let [s0, s1, s2, s3] = self.stream.0.to_le_bytes();
        let [t0, t1, t2, t3, t4, t5, t6, t7] = self.sender.0.to_le_bytes();
        let [c0, c1, c2, c3, c4, c5, c6, c7] = self.counter.to_le_bytes();
        [
            PROTOCOL_VERSION,
            self.lane.to_byte(),
            k0,
            k1,
            s0,
            s1,
            s2,
            s3,
            t0,
            t1,
            t2,
            t3,
            t4,
            t5,
            t6,
            t7,
            c0,
            c1,
            c2,
            c3,
            c4,
            c5,
            c6,
            c7,
        ]
    }
}

impl Refused {
    /// Every reason, in the order in which its counter is shown.
    pub const ALL: [Self; 10] = [
        Self::Truncated,
        Self::Version,
        Self::Foreign,
        Self::Own,
        Self::UnknownSender,
        Self::Lane,
        Self::Unwanted,
        Self::Replayed,
        Self::Forged,
        Self::Malformed,
    ];
}

impl RefusedCounts {
    /// Counts one drop.
    pub fn count(&mut self, reason: Refused) {
        for (slot, each) in self.0.iter_mut().zip(Refused::ALL) {
            if each == reason {
                *slot = slot.saturating_add(1);
            }
        }
    }

    /// How many were dropped for this reason.
    pub fn of(&self, reason: Refused) -> u64 {
        self.iter()
            .find(|(each, _)| *each == reason)
            .map_or(0, |(_, count)| count)
    }

    /// Every reason with its count.
    pub fn iter(&self) -> impl Iterator<Item = (Refused, u64)> + '_ {
        Refused::ALL.into_iter().zip(self.0.iter().copied())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn header() -> Header {
        Header {
            lane: Lane::Values,
            key: KeyId(0x0201),
            stream: StreamId(0x0605_0403),
            sender: Tag(0x0e0d_0c0b_0a09_0807),
            counter: 0x1615_1413_1211_100f,
        }
    }

    fn datagram(header: Header) -> Vec<u8> {
        let mut bytes = header.to_bytes().to_vec();
        bytes.resize(OVERHEAD_BYTES, 0);
        bytes
    }

    #[test]
    fn layout_is_golden() {
        let golden = [
            4, 3, 0x01, 0x02, 0x03, 0x04, 0x05, 0x06, 0x07, 0x08, 0x09, 0x0a, 0x0b, 0x0c, 0x0d,
            0x0e, 0x0f, 0x10, 0x11, 0x12, 0x13, 0x14, 0x15, 0x16,
        ];
        assert_eq!(header().to_bytes(), golden);
        assert_eq!(Header::parse(&datagram(header())), Ok(header()));
    }

    #[test]
    fn lanes_keep_their_numbers() {
        for byte in 0..=u8::MAX {
            let lane = Lane::from_byte(byte);
            assert_eq!(lane.map_or(byte, Lane::to_byte), byte);
            assert_eq!(lane.is_some(), byte < 5);
        }
    }

    #[test]
    fn what_cannot_be_a_header_is_refused_by_name() {
        let good = datagram(header());
        for len in 0..OVERHEAD_BYTES {
            assert_eq!(Header::parse(&good[..len]), Err(Refused::Truncated));
        }
        let mut other = good.clone();
        other[0] = PROTOCOL_VERSION + 1;
        assert_eq!(Header::parse(&other), Err(Refused::Version));
        let mut other = good;
        other[1] = 5;
        assert_eq!(Header::parse(&other), Err(Refused::Lane));
    }

    #[test]
    fn drops_are_counted_apart() {
        let mut counts = RefusedCounts::default();
        counts.count(Refused::Forged);
        counts.count(Refused::Forged);
        counts.count(Refused::Own);
        assert_eq!(counts.of(Refused::Forged), 2);
        assert_eq!(counts.of(Refused::Own), 1);
        assert_eq!(counts.iter().map(|(_, n)| n).sum::<u64>(), 3);
    }
}
