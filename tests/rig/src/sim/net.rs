//! The simulated networks: a line from each host to each and one back, and who is cut off from whom.

use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::time::Duration;

use crate::link::{Books, Class, Config, Line, Loss, Profile};
use crate::random::Random;

/// Port of every host's control socket.
pub(super) const CONTROL_PORT: u16 = 7000;
/// Port on which every host receives unicast samples.
pub(super) const DATA_PORT: u16 = 7001;

/// What a network does to a datagram on its way to a host: a [`Config`] in four words.
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

/// To whom a datagram is sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Target {
    /// To this socket of one host.
    Host(usize, Way),
    /// To every host's control socket.
    Beacon,
    /// To this group of samples.
    Group(SocketAddr),
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
    /// By host, then by network.
    ends: Vec<Vec<End>>,
    /// Hosts hear each other only within one group.
    groups: Vec<usize>,
}

/// A host's end of one network.
struct End {
    /// From the host, where that does anything at all.
    up: Option<Line>,
    /// To the host, from all others: its own state, also for what is sent to a group.
    down: Line,
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

impl From<Link> for Config {
    fn from(link: Link) -> Self {
        Self {
            loss: Loss::random(link.loss),
            duplicate: link.duplicates,
            delay: link.delay + link.jitter / 2,
            jitter: link.jitter / 2,
            reorder: 1.0,
            ..Self::default()
        }
    }
}

impl Net {
    pub(super) fn new(link: Link, mut random: Random, hosts: usize, networks: usize) -> Self {
        let mut end = || End {
            up: None,
            down: Line::new(link.into(), random.next()),
        };
        Self {
            ends: (0..hosts)
                .map(|_| (0..networks.max(1)).map(|_| end()).collect())
                .collect(),
            groups: vec![0; hosts],
        }
    }

    pub(super) fn set_all(&mut self, link: Link) {
        for end in self.ends.iter_mut().flatten() {
            end.up = None;
            end.down.configure(link.into());
        }
    }

    pub(super) fn set(&mut self, index: usize, network: usize, profile: &Profile) {
        let (up, down) = profile.seeds(index);
        let end = &mut self.ends[index][network];
        let idle = end.up.take().unwrap_or(Line::new(profile.up, up));
        end.up.insert(idle).restart(profile.up, up);
        end.down.restart(profile.down, down);
    }

    pub(super) fn books(&self, index: usize, network: usize) -> Books {
        let End { up, down } = &self.ends[index][network];
        Books {
            up: up.as_ref().map(Line::counters).unwrap_or_default(),
            down: down.counters(),
        }
    }

    pub(super) fn backlog(&self, index: usize, network: usize, now: Duration) -> Duration {
        self.ends[index][network].down.backlog(now)
    }

    pub(super) fn cut(&mut self, group_of: impl Fn(usize) -> usize) {
        for (index, group) in self.groups.iter_mut().enumerate() {
            *group = group_of(index);
        }
    }

    pub(super) fn reaches(&self, from: usize, to: usize) -> bool {
        self.groups[from] == self.groups[to]
    }

    /// Returns the line from a host, if it has one.
    pub(super) fn up(&mut self, from: usize, network: usize) -> Option<&mut Line> {
        self.ends[from][network].up.as_mut()
    }

    /// Returns the line to a host.
    pub(super) fn down(&mut self, to: usize, network: usize) -> &mut Line {
        &mut self.ends[to][network].down
    }
}

impl Target {
    pub(super) fn class(self) -> Class {
        match self {
            Self::Host(..) => Class::Unicast,
            Self::Beacon | Self::Group(_) => Class::Multicast,
        }
    }
}

/// Returns the length of a datagram's IP packet.
pub(super) fn packet_bytes(datagram: &[u8]) -> usize {
    datagram.len() + 28
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
