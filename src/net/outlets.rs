//! By which interfaces a sample goes to its group: those by which the group's readers are reached, each once.
//!
//! A host with a modem beside its local network does not send there what only the local network reads.

use std::collections::{BTreeMap, BTreeSet};
use std::net::{IpAddr, Ipv4Addr, SocketAddr, UdpSocket};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use ddx_wire::StreamId;

use super::Interface;

/// What the control loop knows and the sending thread asks.
#[derive(Clone, Debug, Default)]
pub(crate) struct Outlets(Arc<Mutex<Table>>);

#[derive(Debug, Default)]
struct Table {
    /// How many streams need an interface, by group and by the interface's address.
    needed: BTreeMap<IpAddr, BTreeMap<Ipv4Addr, usize>>,
    streams: BTreeMap<StreamId, Stream>,
    interfaces: Vec<Ipv4Addr>,
}

#[derive(Debug)]
struct Stream {
    group: IpAddr,
    readers: Vec<SocketAddr>,
    sources: BTreeSet<Ipv4Addr>,
}

impl Outlets {
    /// The addresses from which to send to a group: none leaves it to the kernel.
    pub(crate) fn sources(&self, group: IpAddr) -> Vec<Ipv4Addr> {
        let table = self.lock();
        let needed = table.needed.get(&group);
        needed.map_or_else(Vec::new, |needed| needed.keys().copied().collect())
    }

    /// Follows the route of a stream: its group, if it has one, and where its readers are.
    pub(crate) fn route(
        &self,
        stream: StreamId,
        group: Option<SocketAddr>,
        readers: impl Iterator<Item = SocketAddr>,
    ) {
        let mut table = self.lock();
        table.remove(stream);
        if let Some(group) = group {
            table.insert(stream, group.ip(), readers.collect());
        }
    }

    /// Goes on with these interfaces.
    pub(crate) fn follow(&self, interfaces: &[Interface]) {
        let mut table = self.lock();
        table.interfaces = interfaces.iter().map(|i| i.address).collect();
        table.needed.clear();
        for (id, stream) in std::mem::take(&mut table.streams) {
            table.insert(id, stream.group, stream.readers);
        }
    }

    fn lock(&self) -> MutexGuard<'_, Table> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Table {
    fn insert(&mut self, id: StreamId, group: IpAddr, readers: Vec<SocketAddr>) {
        let mut sources = BTreeSet::new();
        for reader in &readers {
            match source(*reader).filter(|source| self.interfaces.contains(source)) {
                Some(source) => {
                    sources.insert(source);
                }
                // The kernel knows no way there, or one that this host is not to use.
                None => sources.extend(&self.interfaces),
            }
        }
        let needed = self.needed.entry(group).or_default();
        for source in &sources {
            *needed.entry(*source).or_default() += 1;
        }
        let stream = Stream {
            group,
            readers,
            sources,
        };
        self.streams.insert(id, stream);
    }

    fn remove(&mut self, id: StreamId) {
        let Some(stream) = self.streams.remove(&id) else {
            return;
        };
        let Some(needed) = self.needed.get_mut(&stream.group) else {
            return;
        };
        for source in stream.sources {
            if let Some(count) = needed.get_mut(&source) {
                *count -= 1;
                if *count == 0 {
                    needed.remove(&source);
                }
            }
        }
        if needed.is_empty() {
            self.needed.remove(&stream.group);
        }
    }
}

/// The address from which the kernel would send to another. Nothing is sent.
fn source(to: SocketAddr) -> Option<Ipv4Addr> {
    let socket = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0)).ok()?;
    socket.connect(to).ok()?;
    match socket.local_addr().ok()? {
        SocketAddr::V4(source) => Some(*source.ip()),
        SocketAddr::V6(_) => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn interface(address: Ipv4Addr) -> Interface {
        Interface {
            name: "lo".to_owned(),
            index: 1,
            address,
        }
    }

    #[test]
    fn a_group_leaves_where_its_readers_are_and_nowhere_else() {
        let group: SocketAddr = "239.194.0.1:7900".parse().unwrap();
        let (here, elsewhere) = (Ipv4Addr::LOCALHOST, Ipv4Addr::new(192, 0, 2, 1));
        let reader = || ["127.0.0.1:5".parse().unwrap()].into_iter();
        let outlets = Outlets::default();
        outlets.follow(&[interface(here), interface(elsewhere)]);
        assert!(outlets.sources(group.ip()).is_empty());

        outlets.route(StreamId(1), Some(group), reader());
        outlets.route(StreamId(2), Some(group), reader());
        assert_eq!(outlets.sources(group.ip()), [here]);

        outlets.route(StreamId(1), None, reader());
        assert_eq!(outlets.sources(group.ip()), [here], "the second still does");
        outlets.follow(&[interface(elsewhere)]);
        assert_eq!(outlets.sources(group.ip()), [elsewhere], "all that is left");
        outlets.route(StreamId(2), None, reader());
        assert!(outlets.sources(group.ip()).is_empty());
    }
}
