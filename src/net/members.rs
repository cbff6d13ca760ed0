//! The groups that a socket hears, on each interface, while interfaces come and go.

use std::collections::{BTreeMap, BTreeSet};
use std::io;
use std::net::{Ipv4Addr, UdpSocket};

use socket2::{InterfaceIndexOrAddress, SockRef};

use super::Interface;

/// What one socket is a member of.
///
/// A membership belongs to an interface and dies with its last address, so it is made anew when the addresses change.
pub(crate) struct Members {
    socket: UdpSocket,
    groups: BTreeSet<Ipv4Addr>,
    links: BTreeMap<u32, Link>,
}

#[derive(Clone, Debug, PartialEq, Eq)]
struct Link {
    name: String,
    addresses: BTreeSet<Ipv4Addr>,
}

impl Members {
    /// Begins without a group on these interfaces.
    pub(crate) fn new(socket: UdpSocket, interfaces: &[Interface]) -> Self {
        Self {
            socket,
            groups: BTreeSet::new(),
            links: links(interfaces),
        }
    }

    /// Hears a group on each interface, present and future.
    pub(crate) fn join(&mut self, group: Ipv4Addr) {
        self.groups.insert(group);
        for (index, link) in &self.links {
            self.enter(group, *index, link);
        }
    }

    /// Undoes [`Members::join`].
    pub(crate) fn leave(&mut self, group: Ipv4Addr) {
        if self.groups.remove(&group) {
            for index in self.links.keys() {
                self.exit(group, *index);
            }
        }
    }

    /// Goes on with these interfaces.
    pub(crate) fn follow(&mut self, interfaces: &[Interface]) {
        let before = std::mem::replace(&mut self.links, links(interfaces));
        for (index, _) in before
            .iter()
            .filter(|(index, link)| self.links.get(index) != Some(link))
        {
            // One that is gone is left, too: otherwise it would count against the limit for ever.
            for group in &self.groups {
                self.exit(*group, *index);
            }
        }
        for (index, link) in self
            .links
            .iter()
            .filter(|(index, link)| before.get(index) != Some(link))
        {
            for group in &self.groups {
                self.enter(*group, *index, link);
            }
        }
    }

    /// An interface that cannot do multicast, or one too many for the kernel's limit, costs no more than the group there:
    /// what should come by it comes by unicast.
    fn enter(&self, group: Ipv4Addr, index: u32, link: &Link) {
        let interface = InterfaceIndexOrAddress::Index(index);
        let entered = SockRef::from(&self.socket).join_multicast_v4_n(&group, &interface);
        match entered {
            Err(error) if error.kind() != io::ErrorKind::AddrInUse => {
                tracing::warn!(%group, interface = %link.name, %error, "group not joined");
            }
            Ok(()) | Err(_) => {}
        }
    }

    fn exit(&self, group: Ipv4Addr, index: u32) {
        let interface = InterfaceIndexOrAddress::Index(index);
        if let Err(error) = SockRef::from(&self.socket).leave_multicast_v4_n(&group, &interface) {
            tracing::debug!(%group, interface = index, %error, "group not left");
        }
    }
}

fn links(interfaces: &[Interface]) -> BTreeMap<u32, Link> {
    let mut links: BTreeMap<u32, Link> = BTreeMap::new();
    for interface in interfaces {
        let link = links.entry(interface.index).or_insert_with(|| Link {
            name: interface.name.clone(),
            addresses: BTreeSet::new(),
        });
        link.addresses.insert(interface.address);
    }
    links
}

#[cfg(test)]
mod tests {
    use super::*;

    const GROUP: Ipv4Addr = Ipv4Addr::new(239, 255, 77, 77);

    fn hears(members: &Members) -> bool {
        let to = (GROUP, members.socket.local_addr().unwrap().port());
        let speaker = UdpSocket::bind("127.0.0.1:0").unwrap();
        SockRef::from(&speaker)
            .set_multicast_if_v4(&Ipv4Addr::LOCALHOST)
            .unwrap();
        speaker.send_to(b"x", to).unwrap();
        // The loopback delivers before the call returns.
        members.socket.recv(&mut [0; 8]).is_ok()
    }

    #[test]
    fn a_group_is_heard_on_an_interface_from_when_it_appears_until_it_goes() {
        let socket = UdpSocket::bind("0.0.0.0:0").unwrap();
        socket.set_nonblocking(true).unwrap();
        SockRef::from(&socket).set_multicast_all_v4(false).unwrap();
        let loopback = super::super::interfaces(&["lo".to_owned()]).unwrap();
        let mut members = Members::new(socket, &[]);
        members.join(GROUP);
        assert!(!hears(&members), "there is no interface yet");

        members.follow(&loopback);
        assert!(hears(&members), "it appeared");
        members.follow(&[]);
        assert!(!hears(&members), "it went");
        members.follow(&loopback);
        assert!(hears(&members), "it is back");
        members.leave(GROUP);
        assert!(!hears(&members), "the group was left");
    }
}
