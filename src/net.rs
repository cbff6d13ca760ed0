//! Sockets: the interfaces that this host uses, and the four sockets that it opens, which outlive any of them.
//!
//! | socket | bound to | carries |
//! |---|---|---|
//! | control | an ephemeral port | the catalog's datagrams |
//! | beacon | a port fixed by the domain, shared | first contact by multicast |
//! | data | an ephemeral port, or `data_port` | samples by unicast, and all samples that this host sends |
//! | group | a port fixed by the domain, shared | samples by multicast |
//!
//! Samples have ports of their own, so that a foreign capture can count them.

mod members;
mod outlets;
mod udp;
mod watch;

use std::io;
use std::net::{Ipv4Addr, SocketAddr, SocketAddrV4, UdpSocket};

use anyhow::{Context, bail};
use if_addrs::{IfAddr, get_if_addrs};
use rustix::net::netdevice::name_to_index;
use socket2::{Domain, Protocol, SockRef, Socket, Type};

pub(crate) use self::members::Members;
pub(crate) use self::outlets::Outlets;
pub(crate) use self::udp::Channel;
pub(crate) use self::watch::Watch;

/// Asked of the kernel for each socket that carries samples: the default holds 92 datagrams, one batch of a burst.
pub(crate) const RECEIVE_BUFFER_BYTES: usize = 4 * 1024 * 1024;

/// One IPv4 address of this host on one interface.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Interface {
    pub(crate) name: String,
    pub(crate) index: u32,
    pub(crate) address: Ipv4Addr,
}

/// The sockets of one daemon.
#[derive(Debug)]
pub(crate) struct Sockets {
    pub(crate) control: UdpSocket,
    pub(crate) beacon: Option<UdpSocket>,
    pub(crate) data: UdpSocket,
    pub(crate) group: UdpSocket,
}

/// Finds the interfaces to use now: of those named (by name or address), else of all, the ones that are up, connected and
/// have an address; if none is named, the loopback where there is no other. There may be none yet: a robot starts before
/// its link does.
pub(crate) fn interfaces(wanted: &[String]) -> io::Result<Vec<Interface>> {
    let mut loopback = Vec::new();
    let mut found = Vec::new();
    for entry in get_if_addrs()? {
        let (is_loopback, is_up) = (entry.is_loopback(), entry.is_oper_up());
        let (IfAddr::V4(address), Some(index)) = (entry.addr, entry.index) else {
            continue;
        };
        let interface = Interface {
            name: entry.name,
            index,
            address: address.ip,
        };
        if !is_up {
            continue;
        }
        if !wanted.is_empty() {
            if wanted.iter().any(|want| interface.is(want)) {
                found.push(interface);
            }
        } else if is_loopback {
            loopback.push(interface);
        } else {
            found.push(interface);
        }
    }
    Ok(if found.is_empty() { loopback } else { found })
}

/// Refuses a name that no interface has, be it up or not. An address may still come.
pub(crate) fn check(wanted: &[String]) -> anyhow::Result<()> {
    let socket = bind(0, false).context("opening a socket")?;
    for want in wanted {
        if want.parse::<Ipv4Addr>().is_ok() || name_to_index(&socket, want).is_ok() {
            continue;
        }
        let all = get_if_addrs().context("listing the network interfaces")?;
        let names: Vec<String> = all
            .into_iter()
            .filter_map(|entry| match entry.addr {
                IfAddr::V4(address) => Some(format!("{} ({})", entry.name, address.ip)),
                IfAddr::V6(_) => None,
            })
            .collect();
        let there = if names.is_empty() {
            "none has an IPv4 address yet".to_owned()
        } else {
            format!("there are {}", names.join(", "))
        };
        bail!(
            "there is no interface `{want}`\nhint: {there}; one that is there but not up would be waited for"
        );
    }
    Ok(())
}

impl Interface {
    fn is(&self, want: &str) -> bool {
        self.name == want || self.address.to_string() == want
    }
}

impl Sockets {
    /// Opens all sockets. A port of 0 lets the kernel choose.
    ///
    /// # Errors
    /// Names the port that is taken.
    pub(crate) fn open(
        control_port: u16,
        data_port: u16,
        beacon: Option<SocketAddrV4>,
        group_port: u16,
    ) -> anyhow::Result<Self> {
        let control = bind(control_port, false).with_context(|| {
            format!("opening the control socket on UDP port {control_port}\nhint: `control_port = 0` lets the system choose")
        })?;
        let data = bind(data_port, false).with_context(|| {
            format!("opening the data socket on UDP port {data_port}\nhint: `data_port = 0` lets the system choose")
        })?;
        let group = bind(group_port, true)
            .with_context(|| format!("opening the multicast socket on UDP port {group_port}, which something else holds alone"))?;
        let beacon = beacon
            .map(|beacon| {
                bind(beacon.port(), true).with_context(|| {
                    format!("opening the beacon socket on UDP port {}, which something else holds alone", beacon.port())
                })
            })
            .transpose()?;
        for socket in [&data, &group] {
            // The kernel cuts this to its limit without an error; `ddx doctor` shows what was granted.
            SockRef::from(socket)
                .set_recv_buffer_size(RECEIVE_BUFFER_BYTES)
                .context("sizing a receive buffer")?;
        }
        Ok(Self {
            control,
            beacon,
            data,
            group,
        })
    }
}

/// How many bytes may wait in a socket, as they are asked for: the kernel says twice that, for its own books.
pub(crate) fn receive_buffer_bytes(socket: &UdpSocket) -> io::Result<usize> {
    Ok(SockRef::from(socket).recv_buffer_size()? / 2)
}

fn bind(port: u16, shared: bool) -> io::Result<UdpSocket> {
    let socket = Socket::new(Domain::IPV4, Type::DGRAM, Some(Protocol::UDP))?;
    socket.set_nonblocking(true)?;
    if shared {
        socket.set_reuse_address(true)?;
        // Otherwise the socket hears each group that any program on this host joined.
        socket.set_multicast_all_v4(false)?;
    }
    socket.bind(&SocketAddr::from((Ipv4Addr::UNSPECIFIED, port)).into())?;
    Ok(socket.into())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_unknown_interface_is_named_with_those_that_exist() {
        let error = format!("{:#}", check(&["nosuch0".to_owned()]).unwrap_err());
        assert!(
            error.contains("`nosuch0`") && error.contains("lo (127.0.0.1)"),
            "{error}"
        );
    }

    #[test]
    fn an_address_that_is_not_there_yet_is_waited_for() {
        let wanted = ["lo".to_owned(), "192.0.2.1".to_owned()];

        check(&wanted).unwrap();

        let found = interfaces(&wanted[1..]).unwrap();
        assert!(found.is_empty(), "{found:?}");
    }

    #[test]
    fn loopback_can_be_named_by_address() {
        let found = interfaces(&["127.0.0.1".to_owned()]).unwrap();
        assert_eq!(found.len(), 1);
        assert_eq!(found[0].name, "lo");
    }

    #[test]
    fn a_taken_data_port_is_named() {
        let taken = bind(0, false).unwrap();
        let port = taken.local_addr().unwrap().port();
        let error = format!("{:#}", Sockets::open(0, port, None, 0).unwrap_err());
        assert!(error.contains(&format!("UDP port {port}")), "{error}");
    }
}
