//! What a host says about itself when its control plane starts.

use std::net::{Ipv4Addr, SocketAddr, SocketAddrV4};

use ddx_wire::seal::DomainKey;
use ddx_wire::{DomainId, HostId, HostName, Incarnation, Time};

/// First UDP port of the beacons; a domain's port is this plus its number.
pub const BEACON_PORT_BASE: u16 = 7400;
/// Multicast groups of a domain that carry samples.
pub const SAMPLE_GROUPS: u8 = 16;
/// UDP port of every sample group, apart from the beacons' so that captures can count samples.
pub const SAMPLE_GROUP_PORT_BASE: u16 = 7900;

/// Everything that a [`Catalog`](crate::Catalog) needs to know about its own host.
#[derive(Clone)]
pub struct Config {
    /// Number of the domain.
    pub domain: DomainId,
    /// Name of this host, which is the prefix of its items.
    pub host: HostName,
    /// Identity of this host.
    pub id: HostId,
    /// This life of its daemon. [`Event::Reincarnate`](crate::Event::Reincarnate) asks for another.
    pub incarnation: Incarnation,
    /// Key of the domain.
    pub key: DomainKey,
    /// Addresses of the control socket, the best first; those who hear of this host by gossip use the first.
    pub control_addrs: Vec<SocketAddr>,
    /// Port on which unicast samples arrive.
    pub data_port: u16,
    /// Control addresses that are greeted until they answer.
    pub seeds: Vec<SocketAddr>,
    /// Whether to send multicast beacons.
    pub beacon: bool,
    /// Whether samples may travel by multicast.
    pub multicast: bool,
    /// Since when this host has held its prefix, on its own boot clock; earlier wins a conflict.
    pub prefix_since: Time,
}

/// Where the beacons of a domain go. Ports run out above domain 499, where they wrap.
pub fn beacon_group(domain: DomainId) -> SocketAddr {
    let [high, low] = domain.0.to_be_bytes();
    let port = BEACON_PORT_BASE.saturating_add(domain.0 % 500);
    // 239.255/16 is the IPv4 local scope of RFC 2365; the third byte keeps clear of the sample groups.
    let address = Ipv4Addr::new(239, 255, high & 0x7f, low);
    SocketAddr::V4(SocketAddrV4::new(address, port))
}

/// The group of a domain that carries the items whose names hash to `index`.
pub fn sample_group(domain: DomainId, index: u8) -> SocketAddr {
    // 239.192/14 is the organisation-local scope; 4,096 domains have groups of their own, ports tell the rest apart.
    let low = domain.0.wrapping_mul(u16::from(SAMPLE_GROUPS));
    let [third, fourth] = low
        .wrapping_add(u16::from(index % SAMPLE_GROUPS))
        .to_be_bytes();
    let port = SAMPLE_GROUP_PORT_BASE.saturating_add(domain.0 % 500);
    SocketAddr::V4(SocketAddrV4::new(
        Ipv4Addr::new(239, 194, third, fourth),
        port,
    ))
}
