//! What the wire needs to know of an Ethernet frame.

use std::collections::BTreeSet;

use crate::link::Class;

/// An Ethernet frame without its checksum.
#[derive(Clone, Copy, Debug)]
pub(super) struct Frame<'a>(pub(super) &'a [u8]);

impl Frame<'_> {
    /// Returns the length from the IP header on, as the switch counts it.
    pub(super) fn packet_bytes(self) -> usize {
        self.0.len().saturating_sub(HEADER)
    }

    /// Returns how chance treats it: ARP, IGMP and whatever is not IP are spared.
    pub(super) fn class(self) -> Class {
        let is_spared = match self.ether_type() {
            Some(IPV4) => self.protocol() == Some(IGMP),
            Some(IPV6) => false,
            _ => true,
        };
        if is_spared {
            Class::Spared
        } else if self.0.first().is_some_and(|first| first & 1 == 1) {
            Class::Multicast
        } else {
            Class::Unicast
        }
    }

    /// Returns whether it is to be counted in all, which it is, and then under each label with these UDP ports.
    pub(super) fn counts_in(self, labels: &[BTreeSet<u16>]) -> impl Iterator<Item = bool> {
        let ports = self.udp_ports();
        let under = move |label: &BTreeSet<u16>| {
            ports.is_some_and(|ports| ports.iter().any(|port| label.contains(port)))
        };
        std::iter::once(true).chain(labels.iter().map(under))
    }

    /// Returns source and destination port, if it is the first or only fragment of a UDP datagram over IPv4.
    fn udp_ports(self) -> Option<[u16; 2]> {
        if self.ether_type()? != IPV4 || self.protocol()? != UDP {
            return None;
        }
        let packet = self.0.get(HEADER..)?;
        let [first, second] = [packet.get(6)?, packet.get(7)?];
        if (first & 0x1f) != 0 || *second != 0 {
            return None;
        }
        let header = usize::from(packet.first()? & 0x0f) * 4;
        Some([
            word(packet.get(header..)?)?,
            word(packet.get(header + 2..)?)?,
        ])
    }

    fn ether_type(self) -> Option<u16> {
        word(self.0.get(12..)?)
    }

    fn protocol(self) -> Option<u8> {
        self.0.get(HEADER + 9).copied()
    }
}

fn word(bytes: &[u8]) -> Option<u16> {
    bytes.first_chunk().map(|word| u16::from_be_bytes(*word))
}

/// Bytes of an Ethernet header.
const HEADER: usize = 14;
const IPV4: u16 = 0x0800;
const IPV6: u16 = 0x86dd;
const IGMP: u8 = 2;
const UDP: u8 = 17;

#[cfg(test)]
mod tests {
    use super::*;

    fn frame(first: u8, ether_type: u16, protocol: u8, fragment: u16) -> Vec<u8> {
        let mut bytes = vec![0; HEADER + 28];
        bytes[0] = first;
        bytes[12..14].copy_from_slice(&ether_type.to_be_bytes());
        bytes[HEADER] = 0x45;
        bytes[HEADER + 6..HEADER + 8].copy_from_slice(&fragment.to_be_bytes());
        bytes[HEADER + 9] = protocol;
        bytes[HEADER + 20..HEADER + 22].copy_from_slice(&7_000_u16.to_be_bytes());
        bytes[HEADER + 22..HEADER + 24].copy_from_slice(&7_001_u16.to_be_bytes());
        bytes
    }

    #[test]
    fn a_frame_is_classed_by_whom_it_is_for_and_what_it_does() {
        let class =
            |first, ether_type, protocol| Frame(&frame(first, ether_type, protocol, 0)).class();

        assert_eq!(class(0x02, IPV4, UDP), Class::Unicast);
        assert_eq!(class(0x01, IPV4, UDP), Class::Multicast);
        assert_eq!(class(0xff, IPV4, UDP), Class::Multicast);
        assert_eq!(class(0x01, IPV4, IGMP), Class::Spared);
        assert_eq!(class(0xff, 0x0806, 0), Class::Spared);
        assert_eq!(Frame(&[]).class(), Class::Spared);
    }

    #[test]
    fn a_datagram_counts_once_under_each_label_that_has_a_port_of_it() {
        let labels = [[7_000, 7_001].into(), [7_001].into(), [7_002].into()];
        let counts = |protocol, fragment| -> Vec<bool> {
            Frame(&frame(2, IPV4, protocol, fragment))
                .counts_in(&labels)
                .collect()
        };

        assert_eq!(counts(UDP, 0x4000), [true, true, true, false]);
        assert_eq!(counts(UDP, 185), [true, false, false, false]);
        assert_eq!(counts(6, 0), [true, false, false, false]);
        assert_eq!(Frame(&frame(2, IPV4, UDP, 0)).packet_bytes(), 28);
    }
}
