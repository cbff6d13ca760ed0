//! Sockets: the interfaces that this host uses, and the four sockets that it opens on them.
//!
//! | socket | bound to | carries |
//! |---|---|---|
//! | control | an ephemeral port | the catalog's datagrams |
//! | beacon | a port fixed by the domain, shared | first contact by multicast |
//! | data | an ephemeral port, or `data_port` | samples by unicast, and all samples that this host sends |
//! | group | a port fixed by the domain, shared | samples by multicast |
//!
//! Samples have ports of their own, so that a foreign capture can count them.

mod udp;

use std::io;
use std::net::{Ipv4Addr, SocketAddr, SocketAddrV4, UdpSocket};

use anyhow::{Context, bail};
use if_addrs::{IfAddr, get_if_addrs};
use socket2::{Domain, Protocol, SockRef, Socket, Type};

pub(crate) use self::udp::Channel;

/// Asked of the kernel for each socket that carries samples: the default holds 92 datagrams, one batch of a burst.
const RECEIVE_BUFFER_BYTES: usize = 4 * 1024 * 1024;

/// One IPv4 address of this host on one interface.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Interface {
    pub(crate) name: String,
    pub(crate) address: Ipv4Addr,
}

/// The sockets of one daemon.
#[derive(Debug)]
pub(crate) struct Sockets {
    pub(crate) control: UdpSocket,
    pub(crate) beacon: Option<UdpSocket>,
    pub(crate) data: UdpSocket,
    pub(crate) group: UdpSocket,
    pub(crate) interfaces: Vec<Interface>,
}

/// Finds the interfaces to use: those named (by name or address), else each with an address, else the loopback. One whose
/// cable or radio is not there yet counts: a robot starts before its link does.
pub(crate) fn interfaces(wanted: &[String]) -> anyhow::Result<Vec<Interface>> {
    let all: Vec<(Interface, bool)> = get_if_addrs()
        .context("listing the network interfaces")?
        .into_iter()
        .filter_map(|entry| {
            let loopback = entry.is_loopback();
            let IfAddr::V4(address) = entry.addr else {
                return None;
            };
            Some((
                Interface {
                    name: entry.name,
                    address: address.ip,
                },
                loopback,
            ))
        })
        .collect();
    if all.is_empty() {
        bail!(
            "no network interface is up with an IPv4 address\nhint: bring one up, or start without a key to serve this host alone"
        );
    }
    if wanted.is_empty() {
        let outside: Vec<Interface> = all
            .iter()
            .filter(|(_, loopback)| !loopback)
            .map(|(i, _)| i.clone())
            .collect();
        return Ok(if outside.is_empty() {
            all.into_iter().map(|(i, _)| i).collect()
        } else {
            outside
        });
    }
    wanted
        .iter()
        .map(|want| {
            all.iter()
                .map(|(interface, _)| interface)
                .find(|i| i.name == *want || i.address.to_string() == *want)
                .cloned()
                .with_context(|| {
                    let names: Vec<_> = all
                        .iter()
                        .map(|(i, _)| format!("{} ({})", i.name, i.address))
                        .collect();
                    format!(
                        "no interface `{want}` is up\nhint: there are {}",
                        names.join(", ")
                    )
                })
        })
        .collect()
}

impl Sockets {
    /// Opens all sockets. A port of 0 lets the kernel choose.
    ///
    /// # Errors
    /// Names the port that is taken.
    pub(crate) fn open(
        interfaces: Vec<Interface>,
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
                let socket = bind(beacon.port(), true).with_context(|| {
                    format!("opening the beacon socket on UDP port {}, which something else holds alone", beacon.port())
                })?;
                join(&socket, *beacon.ip(), &interfaces)?;
                anyhow::Ok(socket)
            })
            .transpose()?;
        for socket in [&data, &group] {
            // The kernel cuts this to its limit without an error; `ddx doctor` will show what was granted.
            SockRef::from(socket)
                .set_recv_buffer_size(RECEIVE_BUFFER_BYTES)
                .context("sizing a receive buffer")?;
        }
        if let Some(first) = interfaces.first() {
            for socket in [&control, &data] {
                SockRef::from(socket)
                    .set_multicast_if_v4(&first.address)
                    .context("choosing the multicast interface")?;
            }
        }
        Ok(Self {
            control,
            beacon,
            data,
            group,
            interfaces,
        })
    }

    /// The addresses at which the control socket is reached.
    pub(crate) fn control_addrs(&self) -> io::Result<Vec<SocketAddr>> {
        let port = self.control.local_addr()?.port();
        Ok(self
            .interfaces
            .iter()
            .map(|i| SocketAddr::from((i.address, port)))
            .collect())
    }
}

/// Makes `socket` receive the group on each interface. Being a member already is no error.
pub(crate) fn join(
    socket: &UdpSocket,
    group: Ipv4Addr,
    interfaces: &[Interface],
) -> anyhow::Result<()> {
    for interface in interfaces {
        match socket.join_multicast_v4(&group, &interface.address) {
            Err(e) if e.kind() != io::ErrorKind::AddrInUse => {
                return Err(e).with_context(|| format!("joining {group} on {}", interface.name));
            }
            Ok(()) | Err(_) => {}
        }
    }
    Ok(())
}

/// Undoes [`join`]; an interface that went away has left by itself.
pub(crate) fn leave(socket: &UdpSocket, group: Ipv4Addr, interfaces: &[Interface]) {
    for interface in interfaces {
        if let Err(error) = socket.leave_multicast_v4(&group, &interface.address) {
            tracing::debug!(%group, interface = %interface.name, %error, "group not left");
        }
    }
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
        let error = format!("{:#}", interfaces(&["nosuch0".to_owned()]).unwrap_err());
        assert!(
            error.contains("`nosuch0`") && error.contains("lo (127.0.0.1)"),
            "{error}"
        );
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
        let loopback = interfaces(&["lo".to_owned()]).unwrap();
        let error = format!(
            "{:#}",
            Sockets::open(loopback, 0, port, None, 0).unwrap_err()
        );
        assert!(error.contains(&format!("UDP port {port}")), "{error}");
    }
}
