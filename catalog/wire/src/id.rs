//! Who and what: the identifiers that appear on the wire.

use std::fmt;

use serde::{Deserialize, Serialize};

/// Number of a domain: hosts of different domains never hear one another. Shifts the beacon's port, so it stays small.
#[derive(
    Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize,
)]
pub struct DomainId(pub u16);

/// Identity of a host: random, kept on disk, independent of names and addresses.
#[derive(Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct HostId(pub [u8; 16]);

/// One life of a host's daemon. Only a change of this changes epochs.
#[derive(
    Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize,
)]
pub struct Incarnation {
    /// Highest ordinal ever seen for this host plus one: orders the lives of one host.
    pub ordinal: u32,
    /// Tells two lives apart that took the same ordinal without hearing of one another.
    pub random: u64,
}

/// Short name of one incarnation of one host, in the clear at the head of each datagram.
#[derive(Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct Tag(pub u64);

/// One writer's tenure of an item on one incarnation of a host: `ordinal << 32 | count`. A later one is larger.
#[derive(
    Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize,
)]
pub struct Epoch(pub u64);

/// Count of samples of one item in one epoch, from 1.
#[derive(
    Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize,
)]
pub struct Seq(pub u64);

/// One flow of samples from a host: one item under one contract. Allocated by the host that sends.
#[derive(
    Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize,
)]
pub struct StreamId(pub u32);

impl Tag {
    /// The tag of one incarnation of one host: the first eight bytes of a SHA-256 over both.
    ///
    /// Tags only sort datagrams to keys; what proves the sender is the seal.
    pub fn of(host: HostId, incarnation: Incarnation) -> Self {
        let mut context = ring::digest::Context::new(&ring::digest::SHA256);
        context.update(b"ddx tag");
        context.update(&host.0);
        context.update(&incarnation.ordinal.to_le_bytes());
        context.update(&incarnation.random.to_le_bytes());
        let digest = context.finish();
        let first = digest.as_ref().first_chunk().copied().unwrap_or_default();
        Self(u64::from_le_bytes(first))
    }
}

impl Epoch {
    /// The `count`-th epoch that a host gives in the life numbered `ordinal`.
    pub fn new(ordinal: u32, count: u32) -> Self {
        Self((u64::from(ordinal) << 32) | u64::from(count))
    }
}

impl HostId {
    /// First four hexadecimal digits, which tell two hosts of one name apart on a screen.
    pub fn short(&self) -> String {
        let [a, b, ..] = self.0;
        format!("{a:02x}{b:02x}")
    }

    /// Reads the 32 hexadecimal digits that [`fmt::Display`] prints.
    pub fn parse(text: &str) -> Option<Self> {
        if text.len() != 32 || !text.bytes().all(|b| b.is_ascii_hexdigit()) {
            return None;
        }
        u128::from_str_radix(text, 16)
            .ok()
            .map(|n| Self(n.to_be_bytes()))
    }
}

impl fmt::Display for HostId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.iter().try_for_each(|b| write!(f, "{b:02x}"))
    }
}

impl fmt::Debug for HostId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "HostId({self})")
    }
}

impl fmt::Debug for Tag {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Tag({:016x})", self.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tag_depends_on_host_ordinal_and_random() {
        let host = HostId([7; 16]);
        let life = Incarnation {
            ordinal: 1,
            random: 2,
        };
        let tag = Tag::of(host, life);
        assert_eq!(tag, Tag::of(host, life));
        assert_ne!(tag, Tag::of(HostId([8; 16]), life));
        assert_ne!(tag, Tag::of(host, Incarnation { ordinal: 2, ..life }));
        assert_ne!(tag, Tag::of(host, Incarnation { random: 3, ..life }));
    }

    #[test]
    fn host_id_reads_what_it_prints() {
        let id = HostId(std::array::from_fn(|i| u8::try_from(i * 17).unwrap()));
        assert_eq!(HostId::parse(&id.to_string()), Some(id));
        assert_eq!(HostId::parse("0011"), None);
        assert_eq!(HostId::parse("+0112233445566778899aabbccddeeff"), None);
    }

    #[test]
    fn later_life_has_larger_epochs() {
        assert!(Epoch::new(2, 0) > Epoch::new(1, u32::MAX));
    }
}
