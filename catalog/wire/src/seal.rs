//! Sealing: AES-256-GCM under keys derived for each (host, incarnation, purpose), with a replay window for each lane.
//!
//! A [`Sealer`] is the only place that counts nonces, so there is exactly one for each purpose of an incarnation. An
//! [`Opener`] belongs to one incarnation of one peer. Derivation and layout: `PROTOCOL.md`, "Sealing".

use std::fmt;

use ring::aead::{Aad, LessSafeKey, Nonce};

pub use crate::header::{
    HEADER_BYTES, Header, KeyId, Lane, MAX_DATAGRAM_BYTES, MIXED_STREAMS, OVERHEAD_BYTES,
    PROTOCOL_VERSION, Purpose, Refused, RefusedCounts, SEAL_BYTES,
};
pub use crate::key::{DomainKey, KeyError};
use crate::replay::ReplayWindow;
use crate::{HostId, Incarnation, StreamId, Tag};

/// Seals the datagrams of one purpose of this host's present incarnation.
///
/// There must be one for each (incarnation, purpose) and never a second: two would use the same nonces. It is therefore
/// not `Clone`.
pub struct Sealer {
    key: LessSafeKey,
    key_id: KeyId,
    sender: Tag,
    purpose: Purpose,
    /// Next counter of each lane of this purpose, indexed by lane number.
    counters: [u64; LANES],
}

/// Opens the datagrams of one purpose of one peer's incarnation, each once.
pub struct Opener {
    key: LessSafeKey,
    key_id: KeyId,
    sender: Tag,
    purpose: Purpose,
    windows: Box<[ReplayWindow; LANES]>,
}

/// An opened datagram.
#[derive(Debug, PartialEq, Eq)]
pub struct Opened<'a> {
    /// The header, now authenticated.
    pub header: Header,
    /// What was sealed.
    pub plaintext: &'a mut [u8],
}

/// Why a datagram could not be sealed: a mistake of the caller, or an incarnation worn out.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SealError {
    /// There is no room for the header.
    #[error("a datagram begins with 24 bytes of room for its header")]
    NoHeadroom,
    /// The lane belongs to another purpose.
    #[error("lane {lane:?} is not sealed by a key for {purpose:?}")]
    Lane {
        /// Lane asked for.
        lane: Lane,
        /// Purpose of this sealer.
        purpose: Purpose,
    },
    /// All counters of the lane are used: only a new incarnation can send.
    #[error("the counter of lane {lane:?} is used up")]
    Exhausted {
        /// The lane.
        lane: Lane,
    },
}

impl Sealer {
    /// Makes the one sealer of this host's incarnation for `purpose`.
    pub fn new(key: &DomainKey, host: HostId, incarnation: Incarnation, purpose: Purpose) -> Self {
        Self {
            key: key.derive(host, incarnation, purpose),
            key_id: key.id(),
            sender: Tag::of(host, incarnation),
            purpose,
            counters: [0; LANES],
        }
    }

    /// The tag that its datagrams carry.
    pub fn sender(&self) -> Tag {
        self.sender
    }

    /// Seals in place the datagram that begins at `start` of `buffer` and reaches to its end.
    ///
    /// Its first [`HEADER_BYTES`] are room for the header, which is written here; the rest is the plaintext, and
    /// [`SEAL_BYTES`] are appended. Allocates only if `buffer` has no capacity for those.
    ///
    /// # Errors
    /// [`SealError`]; `buffer` is then as it was.
    pub fn seal(
        &mut self,
        lane: Lane,
        stream: StreamId,
        buffer: &mut Vec<u8>,
        start: usize,
    ) -> Result<(), SealError> {
        if lane.purpose() != self.purpose {
            let purpose = self.purpose;
            return Err(SealError::Lane { lane, purpose });
        }
        let (room, plaintext) = buffer
            .get_mut(start..)
            .and_then(<[u8]>::split_first_chunk_mut::<HEADER_BYTES>)
            .ok_or(SealError::NoHeadroom)?;
        let next = self
            .counters
            .get_mut(usize::from(lane.to_byte()))
            .ok_or(SealError::Exhausted { lane })?;
        let counter = *next;
        *next = counter
            .checked_add(1)
            .ok_or(SealError::Exhausted { lane })?;
        let header = Header {
            lane,
            key: self.key_id,
            stream,
            sender: self.sender,
            counter,
        }
        .to_bytes();
        let seal = self
            .key
            .seal_in_place_separate_tag(nonce(lane, counter), Aad::from(header), plaintext)
            .map_err(|_| SealError::Exhausted { lane })?;
        *room = header;
        buffer.extend_from_slice(seal.as_ref());
        Ok(())
    }
}

impl Opener {
    /// Opens what the [`Sealer`] of the same four arguments seals. No datagram counts as seen yet.
    pub fn new(key: &DomainKey, host: HostId, incarnation: Incarnation, purpose: Purpose) -> Self {
        Self {
            key: key.derive(host, incarnation, purpose),
            key_id: key.id(),
            sender: Tag::of(host, incarnation),
            purpose,
            windows: Box::new([ReplayWindow::default(); LANES]),
        }
    }

    /// The tag of the sender whose datagrams it opens.
    pub fn sender(&self) -> Tag {
        self.sender
    }

    /// Opens a datagram in place, once.
    ///
    /// # Errors
    /// The reason for which the datagram is to be dropped; its bytes are then undefined.
    pub fn open<'a>(&mut self, datagram: &'a mut [u8]) -> Result<Opened<'a>, Refused> {
        let header = Header::parse(datagram)?;
        if header.key != self.key_id {
            return Err(Refused::Foreign);
        }
        if header.sender != self.sender {
            return Err(Refused::UnknownSender);
        }
        if header.lane.purpose() != self.purpose {
            return Err(Refused::Lane);
        }
        let window = self
            .windows
            .get_mut(usize::from(header.lane.to_byte()))
            .ok_or(Refused::Lane)?;
        if window.seen(header.counter) {
            return Err(Refused::Replayed);
        }
        let plaintext = open_in_place(&self.key, header, datagram)?;
        // Only what is authentic may move the window, else a forger could close it.
        window.mark(header.counter);
        Ok(Opened { header, plaintext })
    }
}

/// Opens a datagram of the hello lane from any member of the domain, however often.
///
/// # Errors
/// The reason for which the datagram is to be dropped; its bytes are then undefined.
pub fn open_hello<'a>(key: &DomainKey, datagram: &'a mut [u8]) -> Result<Opened<'a>, Refused> {
    let header = Header::parse(datagram)?;
    if header.key != key.id() {
        return Err(Refused::Foreign);
    }
    if header.lane != Lane::Hello {
        return Err(Refused::Lane);
    }
    let plaintext = open_in_place(&key.derive_hello(header.sender), header, datagram)?;
    Ok(Opened { header, plaintext })
}

fn open_in_place<'a>(
    key: &LessSafeKey,
    header: Header,
    datagram: &'a mut [u8],
) -> Result<&'a mut [u8], Refused> {
    let (clear, sealed) = datagram
        .split_first_chunk_mut::<HEADER_BYTES>()
        .ok_or(Refused::Truncated)?;
    let nonce = nonce(header.lane, header.counter);
    key.open_in_place(nonce, Aad::from(*clear), sealed)
        .map_err(|_| Refused::Forged)
}

/// `PROTOCOL.md#sealing`: the nonce is the lane, 4 bytes, and the counter, 8 bytes, both little-endian.
fn nonce(lane: Lane, counter: u64) -> Nonce {
    let [c0, c1, c2, c3, c4, c5, c6, c7] = counter.to_le_bytes();
    let lane = lane.to_byte();
    Nonce::assume_unique_for_key([lane, 0, 0, 0, c0, c1, c2, c3, c4, c5, c6, c7])
}

impl fmt::Debug for Sealer {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Sealer({:?}, {:?})", self.sender, self.purpose)
    }
}

impl fmt::Debug for Opener {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Opener({:?}, {:?})", self.sender, self.purpose)
    }
}

/// Number of lanes, so the length of a table indexed by lane number.
const LANES: usize = 5;

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const HOST: HostId = HostId([3; 16]);
    const LIFE: Incarnation = Incarnation {
        ordinal: 4,
        random: 5,
    };

    fn key() -> DomainKey {
        DomainKey::from_bytes([9; 32])
    }

    fn sealer(purpose: Purpose) -> Sealer {
        Sealer::new(&key(), HOST, LIFE, purpose)
    }

    fn opener(purpose: Purpose) -> Opener {
        Opener::new(&key(), HOST, LIFE, purpose)
    }

    fn sealed(sealer: &mut Sealer, lane: Lane, plaintext: &[u8]) -> Vec<u8> {
        let mut buffer = vec![0; HEADER_BYTES];
        buffer.extend_from_slice(plaintext);
        sealer.seal(lane, StreamId(77), &mut buffer, 0).unwrap();
        buffer
    }

    #[test]
    fn datagram_is_golden() {
        let datagram = sealed(&mut sealer(Purpose::Data), Lane::Values, b"abc");
        let shown: String = datagram.iter().map(|b| format!("{b:02x}")).collect();
        assert_eq!(
            shown,
            "0403ba684d0000005b9f930c0e7a414f00000000000000009d84ffb088b79e2dc5d4124663cedb8330dcf5"
        );
    }

    #[test]
    fn what_is_sealed_opens_once() {
        let mut sealer = sealer(Purpose::Data);
        let mut opener = opener(Purpose::Data);
        for lane in [Lane::Commands, Lane::Values, Lane::Bulk] {
            let datagram = sealed(&mut sealer, lane, b"hello");
            let mut copy = datagram.clone();
            let opened = opener.open(&mut copy).unwrap();
            assert_eq!(opened.plaintext, b"hello");
            assert_eq!(opened.header.lane, lane);
            assert_eq!(opened.header.stream, StreamId(77));
            assert_eq!(opener.open(&mut datagram.clone()), Err(Refused::Replayed));
        }
    }

    #[test]
    fn batch_is_sealed_back_to_back() {
        let mut sealer = sealer(Purpose::Control);
        let mut opener = opener(Purpose::Control);
        let mut buffer = Vec::new();
        for byte in 0..3 {
            let start = buffer.len();
            buffer.resize(start + HEADER_BYTES, 0);
            buffer.push(byte);
            sealer
                .seal(Lane::Control, MIXED_STREAMS, &mut buffer, start)
                .unwrap();
        }
        for (byte, datagram) in (0..3).zip(buffer.chunks_mut(OVERHEAD_BYTES + 1)) {
            assert_eq!(opener.open(datagram).unwrap().plaintext, [byte]);
        }
    }

    #[test]
    fn each_refusal_has_its_reason() {
        let good = sealed(&mut sealer(Purpose::Data), Lane::Values, b"x");
        let open = |mut opener: Opener| opener.open(&mut good.clone()).map(|_| ());
        let other_life = Incarnation { ordinal: 5, ..LIFE };
        let foreign = DomainKey::from_bytes([8; 32]);
        assert_eq!(open(opener(Purpose::Data)), Ok(()));
        assert_eq!(open(opener(Purpose::Control)), Err(Refused::Lane));
        assert_eq!(
            open(Opener::new(&key(), HOST, other_life, Purpose::Data)),
            Err(Refused::UnknownSender)
        );
        assert_eq!(
            open(Opener::new(&foreign, HOST, LIFE, Purpose::Data)),
            Err(Refused::Foreign)
        );
        assert_eq!(
            open_hello(&key(), &mut good.clone()).map(|_| ()),
            Err(Refused::Lane)
        );
    }

    #[test]
    fn same_key_id_with_another_key_is_forged() {
        let mut good = sealed(&mut sealer(Purpose::Data), Lane::Values, b"x");
        let other = DomainKey::from_bytes([8; 32]);
        let [a, b] = other.id().0.to_le_bytes();
        good[2] = a;
        good[3] = b;
        let mut opener = Opener::new(&other, HOST, LIFE, Purpose::Data);
        assert_eq!(opener.open(&mut good), Err(Refused::Forged));
    }

    #[test]
    fn strangers_hello_opens_with_the_domain_key_alone() {
        let mut datagram = sealed(&mut sealer(Purpose::Hello), Lane::Hello, b"here");
        let mut copy = datagram.clone();
        let opened = open_hello(&key(), &mut datagram).unwrap();
        assert_eq!(opened.plaintext, b"here");
        assert_eq!(opened.header.sender, Tag::of(HOST, LIFE));
        assert!(open_hello(&key(), &mut copy).is_ok());
    }

    #[test]
    fn misuse_is_an_error_that_leaves_the_buffer() {
        let mut sealer = sealer(Purpose::Data);
        let mut buffer = vec![7; HEADER_BYTES - 1];
        let short = sealer.seal(Lane::Values, StreamId(1), &mut buffer, 0);
        assert_eq!(short, Err(SealError::NoHeadroom));
        let wrong = sealer.seal(Lane::Control, StreamId(1), &mut buffer, 0);
        assert!(matches!(wrong, Err(SealError::Lane { .. })));
        assert_eq!(buffer, vec![7; HEADER_BYTES - 1]);
    }

    #[test]
    fn worn_out_counter_never_repeats_a_nonce() {
        let mut sealer = sealer(Purpose::Data);
        sealer.counters = [u64::MAX; LANES];
        let mut buffer = vec![0; HEADER_BYTES];
        assert_eq!(
            sealer.seal(Lane::Values, StreamId(1), &mut buffer, 0),
            Err(SealError::Exhausted { lane: Lane::Values })
        );
    }

    proptest! {
        #[test]
        fn any_changed_byte_is_refused(
            plaintext in prop::collection::vec(any::<u8>(), 0..200),
            at in any::<prop::sample::Index>(),
            change in 1..=u8::MAX,
        ) {
            let mut datagram = sealed(&mut sealer(Purpose::Data), Lane::Values, &plaintext);
            let mut opener = opener(Purpose::Data);
            let mut changed = datagram.clone();
            let at = at.index(changed.len());
            changed[at] ^= change;
            prop_assert!(opener.open(&mut changed).is_err());
            // The forgery must not use up the true datagram's place in the window.
            prop_assert_eq!(opener.open(&mut datagram).unwrap().plaintext, plaintext);
        }

        #[test]
        fn arbitrary_bytes_never_panic(mut bytes in prop::collection::vec(any::<u8>(), 0..100)) {
            prop_assert!(opener(Purpose::Data).open(&mut bytes.clone()).is_err());
            prop_assert!(open_hello(&key(), &mut bytes).is_err());
        }
    }
}
