//! Hosts on several networks at once: the address of each on each, and which of these links carry anything.
//!
//! What happens on a network is [`super::net`]'s business; here is only which of them a datagram takes.

use std::net::{IpAddr, Ipv4Addr, SocketAddr};

use super::net;

/// All links between hosts and networks.
pub(super) struct Networks {
    links: Vec<Vec<Link>>,
}

/// One host's link to one network.
#[derive(Clone, Copy)]
struct Link {
    /// Whether the host has an address there; it knows.
    plugged: bool,
    /// Whether nothing passes, of which it is not told.
    silent: bool,
    /// How often its address there changed.
    moves: u8,
}

/// The addresses of a network, of which a host uses another after each move: 10.1, 10.2 and so on for the first.
const MOVES_MAX: u8 = 16;

impl Networks {
    pub(super) fn new(hosts: usize, networks: usize) -> Self {
        let link = Link {
            plugged: true,
            silent: false,
            moves: 0,
        };
        Self {
            links: vec![vec![link; networks.max(1)]; hosts],
        }
    }

    pub(super) fn count(&self) -> usize {
        self.links.first().map_or(0, Vec::len)
    }

    /// Whether a host's link to a network carries anything.
    pub(super) fn carries(&self, host: usize, network: usize) -> bool {
        let link = self.links[host][network];
        link.plugged && !link.silent
    }

    pub(super) fn silence(&mut self, host: usize, network: usize, silent: bool) {
        self.links[host][network].silent = silent;
    }

    pub(super) fn plug(&mut self, host: usize, network: usize, plugged: bool) {
        self.links[host][network].plugged = plugged;
    }

    pub(super) fn readdress(&mut self, host: usize, network: usize) {
        let link = &mut self.links[host][network];
        link.moves = (link.moves + 1) % MOVES_MAX;
    }

    /// The addresses of a host on all networks that it is plugged into.
    pub(super) fn addresses(&self, host: usize, port: u16) -> Vec<SocketAddr> {
        let plugged = (0..self.count()).filter(|network| self.links[host][*network].plugged);
        plugged
            .map(|network| self.address(host, network, port))
            .collect()
    }

    /// The address of a host on a network.
    pub(super) fn address(&self, host: usize, network: usize, port: u16) -> SocketAddr {
        let first = net::address(host, port);
        let IpAddr::V4(ip) = first.ip() else {
            return first;
        };
        let [a, _, c, d] = ip.octets();
        let prefix = self.prefix(host, network);
        SocketAddr::new(IpAddr::V4(Ipv4Addr::new(a, prefix, c, d)), port)
    }

    /// The network of an address, and what it would be on the first; `None` when nobody has it any longer.
    pub(super) fn resolve(&self, to: SocketAddr) -> Option<(SocketAddr, usize)> {
        let IpAddr::V4(ip) = to.ip() else {
            return None;
        };
        let [a, prefix, c, d] = ip.octets();
        let first = SocketAddr::new(IpAddr::V4(Ipv4Addr::new(a, 1, c, d)), to.port());
        let (host, _) = net::socket(first)?;
        let host = (host < self.links.len()).then_some(host)?;
        let network = (0..self.count()).find(|network| self.prefix(host, *network) == prefix)?;
        Some((first, network))
    }

    fn prefix(&self, host: usize, network: usize) -> u8 {
        let network = u8::try_from(network).unwrap_or(0);
        1 + network * MOVES_MAX + self.links[host][usize::from(network)].moves
    }
}
