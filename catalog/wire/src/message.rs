//! The control messages that hosts exchange: greetings before a session, everything else inside one.
//!
//! One message is one sealed datagram. Both enums travel in the order given here, so variants are only ever appended.
//! `catalog/PROTOCOL.md` says when each is sent and what answers it.

use std::net::SocketAddr;

use serde::{Deserialize, Serialize};

use crate::{
    Contract, Epoch, HostId, HostName, Incarnation, ItemDescription, ItemName, SchemaHash, Seq,
    StreamId, Tag, Time,
};

/// Most entries of one report.
pub const REPORTS_MAX: usize = 32;
/// Most missing parts in one message.
pub const NACK_PARTS_MAX: usize = 100;
/// Greatest length of an encoded message, bytes: a datagram less its header and seal.
pub const BODY_MAX_BYTES: usize = 1_160;
/// Most control addresses of one host.
pub const CONTROL_ADDRS_MAX: usize = 4;
/// Greatest length of a description as encoded, bytes.
pub const DESCRIPTION_MAX_BYTES: usize = 512;
/// Greatest length of a schema text, bytes.
pub const SCHEMA_MAX_BYTES: usize = 64 * 1024;
/// Payload of one [`SchemaPart`], bytes; 64 parts carry the longest text, so that one word masks them.
pub const SCHEMA_PART_BYTES: usize = SCHEMA_MAX_BYTES / 64;

/// What a host says about itself to those who do not know it yet.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Introduction {
    /// Identity of the host.
    pub host: HostId,
    /// This life of its daemon.
    pub incarnation: Incarnation,
    /// Its name and prefix.
    pub name: HostName,
    /// Its control addresses, at most four.
    pub control_addrs: Vec<SocketAddr>,
    /// Port on which it receives unicast samples.
    pub data_port: u16,
    /// How often it re-entered the membership in this life.
    pub rejoin: u32,
    /// How long it has held its prefix on its own boot clock, nanoseconds.
    pub prefix_age_ns: u64,
    /// Number of the newest change in its directory.
    pub version: u64,
    /// Whether it can receive samples by multicast.
    pub multicast: bool,
}

/// Messages between hosts that do not have a session yet.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Greeting {
    /// I am here. Triggers a challenge and nothing else.
    Hello {
        /// Who speaks.
        from: Introduction,
        /// Whether this was sent to one address by somebody without a session there.
        directed: bool,
    },
    /// Prove that you live now.
    Challenge {
        /// Who speaks.
        from: Introduction,
        /// Who is meant.
        to: Tag,
        /// To be repeated in the response.
        nonce: u64,
        /// When this was sent on the speaker's clock.
        sent: Time,
    },
    /// The answer to a challenge.
    Response {
        /// Who speaks.
        from: Introduction,
        /// Who is meant.
        to: Tag,
        /// The nonce of the challenge.
        nonce: u64,
        /// `sent` of the challenge.
        echo: Time,
        /// When the challenge arrived and this was sent, on the speaker's clock.
        at: Time,
        /// A challenge in return, when the speaker has no session yet.
        challenge: Option<u64>,
    },
    /// A later life of you was seen: take a higher ordinal.
    Stale {
        /// Who is meant.
        to: Tag,
        /// Who speaks.
        from: HostId,
        /// That life of the speaker.
        incarnation: Incarnation,
        /// Highest ordinal that was seen.
        ordinal: u32,
    },
}

/// Messages inside a session.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Message {
    /// A datagram of the membership protocol.
    Swim(Vec<u8>),
    /// Are you there?
    Ping {
        /// Newest change in the speaker's directory.
        version: u64,
    },
    /// I am.
    Pong {
        /// Newest change in the speaker's directory.
        version: u64,
    },
    /// How far the speaker's directory has got, and how far it knows those of some other hosts.
    Digest {
        /// Newest change in the speaker's directory.
        version: u64,
        /// How long ago a beacon of the receiver came to the speaker by multicast, seconds; `None` if the speaker does not say.
        beacon_age_s: Option<u8>,
        /// Other hosts.
        others: Vec<DigestEntry>,
    },
    /// Send me these changes of your directory.
    Pull(Vec<Range>),
    /// Changes of the speaker's directory.
    Delta(Delta),
    /// Send me these parts of a schema text.
    SchemaRequest {
        /// The schema.
        hash: SchemaHash,
        /// Bit `i` asks for part `i`.
        missing: u64,
    },
    /// One part of a schema text.
    SchemaPart(SchemaPart),
    /// I want these items of yours.
    Subscribe(Vec<SubscribeEntry>),
    /// You will get them so.
    Grant(Vec<GrantEntry>),
    /// I do not want these any longer.
    Unsubscribe(Vec<u32>),
    /// I still want these, and hold so much of them.
    Renew {
        /// When this was sent on the speaker's clock.
        sent: Time,
        /// What the speaker reads of the other host.
        entries: Vec<RenewEntry>,
    },
    /// Your renewal arrived.
    Renewed {
        /// `sent` of the renewal.
        echo: Time,
        /// When the renewal arrived and this was sent, on the speaker's clock.
        at: Time,
        /// Interests in the renewal that the speaker does not know: subscribe again.
        unknown: Vec<u32>,
    },
    /// I hold so much of these streams of yours.
    Ack(Vec<AckEntry>),
    /// Goodbye: this life of the speaker is over.
    Leave,
    /// Do you hear me at this address?
    Probe {
        /// To be repeated in the answer.
        nonce: u64,
    },
    /// I do. Sent to where the probe came from.
    Probed {
        /// The nonce of the probe.
        nonce: u64,
    },
    /// My control addresses are these now.
    Addresses {
        /// Counts the changes in this life of the speaker: only a higher one is news.
        revision: u64,
        /// All of them, at most four.
        control_addrs: Vec<SocketAddr>,
    },
    /// How your datagrams reach me.
    Report(Vec<ReportEntry>),
    /// I lack these.
    Nack(Vec<NackEntry>),
}

/// How far one life of a host is known.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct DigestEntry {
    /// That life of the host.
    pub tag: Tag,
    /// All changes up to this one are known.
    pub version: u64,
}

/// The changes after `from`, up to and including `to`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Range {
    /// Last change that is not part of the range.
    pub from: u64,
    /// Last change that is part of it.
    pub to: u64,
}

/// What changed within a range of the speaker's directory. Who knows all up to `range.from` now knows all up to `range.to`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Delta {
    /// The changes that this covers; those of them that were overtaken later are left out.
    pub range: Range,
    /// The newest change of all.
    pub version: u64,
    /// The changes.
    pub changes: Vec<Change>,
}

/// One item as one change left it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Change {
    /// Number of the change.
    pub version: u64,
    /// What became of the item.
    pub item: ItemState,
}

/// Whether an item is there.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum ItemState {
    /// It is, with this description.
    Announced(ItemDescription),
    /// It is not: a tombstone.
    Withdrawn(ItemName),
}

/// One part of a schema text.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct SchemaPart {
    /// The schema.
    pub hash: SchemaHash,
    /// Which part, from 0.
    pub index: u8,
    /// How many there are, at most 64.
    pub count: u8,
    /// [`SCHEMA_PART_BYTES`] bytes of text; fewer in the last part.
    pub bytes: Vec<u8>,
}

/// One interest.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct SubscribeEntry {
    /// The reader's number for this interest, never used again in a life of the host.
    pub want: u32,
    /// The item, by its owner's own name.
    pub name: ItemName,
    /// What is asked of the source.
    pub contract: Contract,
    /// Newest sample that is held; zero and zero is none.
    pub epoch: Epoch,
    /// Newest sample that is held.
    pub seq: Seq,
}

/// The answer to one interest.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct GrantEntry {
    /// The reader's number for the interest.
    pub want: u32,
    /// The stream that will carry it; `None` when there is no such item.
    pub stream: Option<StreamId>,
    /// A multicast group to join as well.
    pub group: Option<SocketAddr>,
}

/// One interest that goes on.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct RenewEntry {
    /// The reader's number for the interest.
    pub want: u32,
    /// Newest sample that is held; zero and zero is none.
    pub epoch: Epoch,
    /// Newest sample that is held.
    pub seq: Seq,
    /// Whether the reader joined the group that it was granted.
    pub joined: bool,
    /// Whether samples of this stream arrive by that group.
    pub reception: Reception,
}

/// What a reader can say about a group.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Reception {
    /// No sample arrived by any path since it joined, or too few to tell.
    Unknown,
    /// Samples arrive by it.
    Arrives,
    /// Samples arrive for half a second, but none of them by it.
    Silent,
}

/// What a reading host holds of a stream.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct AckEntry {
    /// The stream.
    pub stream: StreamId,
    /// Newest sample that is held.
    pub epoch: Epoch,
    /// Newest sample that is held.
    pub seq: Seq,
}

/// How the datagrams of one path arrive.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ReportEntry {
    /// The sender's number for the path.
    pub path: u16,
    /// Greatest number of a datagram that arrived.
    pub highest: u32,
    /// Datagrams that arrived since the first, comes round.
    pub received: u32,
    /// Bytes of them, headers and seals included, comes round.
    pub bytes: u32,
    /// Least time on the way since the last report: arrival on this host's clock less `sent_us`, comes round.
    pub delay_us: u32,
    /// When this was written, microseconds of the reporter's clock; comes round.
    pub at_us: u32,
    /// Longest datagram that ever arrived, bytes.
    pub longest: u16,
    /// How much of what arrives at this host is the sender's, in thousandths of the mean of all senders that have more to
    /// send than their rates let through: 1,000 for one that is alone.
    pub share: u16,
}

/// What a reading host lacks of one stream.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct NackEntry {
    /// The stream.
    pub stream: StreamId,
    /// The writer's tenure.
    pub epoch: Epoch,
    /// The sample, or the first of several.
    pub seq: Seq,
    /// What of it.
    pub lacks: Lacks,
}

/// What is missing.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Lacks {
    /// So many samples, from the one named on.
    Samples(u32),
    /// Parts of the sample: offset and length of each, bytes.
    Parts(Vec<(u32, u32)>),
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::codec;

    fn length<T: Serialize>(value: &T) -> usize {
        let mut bytes = Vec::new();
        codec::encode(value, &mut bytes).unwrap();
        bytes.len()
    }

    #[test]
    fn the_longest_of_each_message_fits_a_datagram() {
        let group: SocketAddr = "[ff15:1234:1234:1234:1234:1234:1234:1234]:65535"
            .parse()
            .unwrap();
        let from = Introduction {
            host: HostId([0xff; 16]),
            incarnation: Incarnation {
                ordinal: u32::MAX,
                random: u64::MAX,
            },
            name: HostName::parse(&"n".repeat(63)).unwrap(),
            control_addrs: vec![group; CONTROL_ADDRS_MAX],
            data_port: u16::MAX,
            rejoin: u32::MAX,
            prefix_age_ns: u64::MAX,
            version: u64::MAX,
            multicast: true,
        };
        let response = Greeting::Response {
            from,
            to: Tag(u64::MAX),
            nonce: u64::MAX,
            echo: Time(u64::MAX),
            at: Time(u64::MAX),
            challenge: Some(u64::MAX),
        };
        assert!(length(&response) <= BODY_MAX_BYTES);
        let renewal = RenewEntry {
            want: u32::MAX,
            epoch: Epoch(u64::MAX),
            seq: Seq(u64::MAX),
            joined: true,
            reception: Reception::Silent,
        };
        let sent = Time(u64::MAX);
        let entries = vec![renewal; 40];
        assert!(length(&Message::Renew { sent, entries }) <= BODY_MAX_BYTES);
        let grant = GrantEntry {
            want: u32::MAX,
            stream: Some(StreamId(u32::MAX)),
            group: Some(group),
        };
        assert!(length(&Message::Grant(vec![grant; 32])) <= BODY_MAX_BYTES);
        let entry = DigestEntry {
            tag: Tag(u64::MAX),
            version: u64::MAX,
        };
        let digest = Message::Digest {
            version: u64::MAX,
            beacon_age_s: Some(u8::MAX),
            others: vec![entry; 58],
        };
        assert!(length(&digest) <= BODY_MAX_BYTES);
        let range = Range {
            from: u64::MAX,
            to: u64::MAX,
        };
        assert!(length(&Message::Pull(vec![range; 32])) <= BODY_MAX_BYTES);
        let report = ReportEntry {
            path: u16::MAX,
            highest: u32::MAX,
            received: u32::MAX,
            bytes: u32::MAX,
            delay_us: u32::MAX,
            at_us: u32::MAX,
            longest: u16::MAX,
            share: u16::MAX,
        };
        assert!(length(&Message::Report(vec![report; REPORTS_MAX])) <= BODY_MAX_BYTES);
        let nack = NackEntry {
            stream: StreamId(u32::MAX),
            epoch: Epoch(u64::MAX),
            seq: Seq(u64::MAX),
            lacks: Lacks::Parts(vec![(u32::MAX, u32::MAX); NACK_PARTS_MAX]),
        };
        assert!(length(&Message::Nack(vec![nack])) <= BODY_MAX_BYTES);
        let part = SchemaPart {
            hash: SchemaHash([0xff; 16]),
            index: 63,
            count: 64,
            bytes: vec![0xff; SCHEMA_PART_BYTES],
        };
        assert!(length(&Message::SchemaPart(part)) <= BODY_MAX_BYTES);
    }

    #[test]
    fn the_order_of_messages_is_the_protocol() {
        // Golden bytes: the variant, then the fields, integers below 251 in one byte.
        let mut bytes = Vec::new();
        codec::encode(&Message::Ping { version: 7 }, &mut bytes).unwrap();
        assert_eq!(bytes, [1, 7]);
        bytes.clear();
        codec::encode(&Message::Leave, &mut bytes).unwrap();
        assert_eq!(bytes, [14]);
        bytes.clear();
        codec::encode(&Message::Probe { nonce: 9 }, &mut bytes).unwrap();
        codec::encode(&Message::Probed { nonce: 9 }, &mut bytes).unwrap();
        assert_eq!(bytes, [15, 9, 16, 9]);
        let control_addrs = vec!["10.0.0.1:7".parse().unwrap()];
        let addresses = Message::Addresses {
            revision: 3,
            control_addrs,
        };
        bytes.clear();
        codec::encode(&addresses, &mut bytes).unwrap();
        assert_eq!(bytes, [17, 3, 1, 0, 10, 0, 0, 1, 7]);
        bytes.clear();
        let digest = Message::Digest {
            version: 5,
            beacon_age_s: Some(7),
            others: Vec::new(),
        };
        codec::encode(&digest, &mut bytes).unwrap();
        assert_eq!(bytes, [3, 5, 1, 7, 0]);
        let renewed = Message::Renewed {
            echo: Time(1),
            at: Time(2),
            unknown: vec![3],
        };
        bytes.clear();
        codec::encode(&renewed, &mut bytes).unwrap();
        assert_eq!(bytes, [12, 1, 2, 1, 3]);
        assert_eq!(codec::decode::<Message>(&bytes).unwrap(), renewed);
    }
}
