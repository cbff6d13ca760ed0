//! The simulated network: what becomes of a datagram on its way.

use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::time::Duration;

use super::nanos;
use crate::random::Random;

/// Port of every host's control socket.
pub(super) const CONTROL_PORT: u16 = 7000;
/// Port on which every host receives unicast samples.
pub(super) const DATA_PORT: u16 = 7001;

/// What the network does to a datagram.
#[derive(Clone, Copy, Debug)]
pub struct Link {
    /// Share of datagrams that are lost.
    pub loss: f64,
    /// Share of datagrams that arrive twice.
    pub duplicates: f64,
    /// Least time on the way.
    pub delay: Duration,
    /// Further time on the way, at most; more than the spacing of datagrams reorders them.
    pub jitter: Duration,
}

/// By which way a datagram comes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Way {
    /// To the control socket or by beacon.
    Control,
    /// To the port of unicast samples.
    Unicast,
    /// By this group of samples.
    Group(SocketAddr),
}

/// All that lies between the hosts.
pub(super) struct Net {
    pub(super) link: Link,
    pub(super) random: Random,
    /// Hosts hear each other only within one group.
    groups: Vec<usize>,
}

impl Link {
    /// A quiet local network that loses this share of datagrams.
    pub fn lan(loss: f64) -> Self {
        Self {
            loss,
            duplicates: 0.01,
            delay: Duration::from_micros(100),
            jitter: Duration::from_micros(400),
        }
    }
}

impl Net {
    pub(super) fn new(link: Link, random: Random, hosts: usize) -> Self {
        Self {
            link,
            random,
            groups: vec![0; hosts],
        }
    }

    pub(super) fn cut(&mut self, group_of: impl Fn(usize) -> usize) {
        for (index, group) in self.groups.iter_mut().enumerate() {
            *group = group_of(index);
        }
    }

    pub(super) fn reaches(&self, from: usize, to: usize) -> bool {
        self.groups[from] == self.groups[to]
    }

    /// How long each copy that arrives is on the way: none when it is lost.
    pub(super) fn copies(&mut self) -> Vec<u64> {
        let count = 1 + usize::from(self.random.chance(self.link.duplicates));
        let mut copies = Vec::with_capacity(count);
        for _ in 0..count {
            if !self.random.chance(self.link.loss) {
                let jitter = self.random.below(nanos(self.link.jitter).max(1));
                copies.push(nanos(self.link.delay) + jitter);
            }
        }
        copies
    }
}

/// The address of a host.
pub(super) fn address(index: usize, port: u16) -> SocketAddr {
    let [.., high, low] = u32::try_from(index).unwrap_or(0).to_be_bytes();
    // From 10.1.0.0 on, so that no host has the address of the network itself.
    SocketAddr::new(IpAddr::V4(Ipv4Addr::new(10, 1, high, low)), port)
}

/// The host that has an address, and the way to its socket.
pub(super) fn socket(to: SocketAddr) -> Option<(usize, Way)> {
    let IpAddr::V4(ip) = to.ip() else {
        return None;
    };
    let [10, 1, high, low] = ip.octets() else {
        return None;
    };
    let way = match to.port() {
        CONTROL_PORT => Way::Control,
        DATA_PORT => Way::Unicast,
        _ => return None,
    };
    Some((usize::from(u16::from_be_bytes([high, low])), way))
}
