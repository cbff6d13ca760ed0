//! Whether multicast passes between two hosts, in both directions: who hears whose beacons.
//!
//! Beacons are the only datagrams that all hosts send by multicast, whether or not anybody reads, so they show what a
//! stream would meet. Nothing is decided by it: a replayed beacon misleads those who look, and nobody else.

use std::time::Duration;

use ddx_wire::{HostId, Tag, Time};

use super::Catalog;
use crate::hosts::Host;

impl Catalog {
    /// Notes a beacon that came by multicast; its host is told with the next digest. Nothing is noted of a stranger.
    pub(super) fn note_beacon(&mut self, sender: Tag, now: Time) {
        let host = self.sessions.get(sender).map(|session| session.host);
        if let Some(host) = host.and_then(|host| self.hosts.get_mut(host)) {
            host.beacon_heard = Some(now);
        }
    }

    /// Notes that a host says how long ago a beacon of this one came there.
    pub(super) fn note_answer(&mut self, from: HostId, beacon_age_s: Option<u8>, now: Time) {
        if let Some(age) = beacon_age_s
            && let Some(host) = self.hosts.get_mut(from)
        {
            let at = now - Duration::from_secs(age.into());
            host.beacon_answered = host.beacon_answered.max(Some(at));
        }
    }
}

/// How long ago a beacon of a host came, seconds; `None` if that is more than four minutes.
pub(super) fn age_s(host: &Host, now: Time) -> Option<u8> {
    u8::try_from(now.since(host.beacon_heard?).as_secs()).ok()
}

#[cfg(test)]
mod tests {
    use std::net::SocketAddr;

    use ddx_wire::seal::DomainKey;
    use ddx_wire::{DomainId, HostName, Incarnation};

    use super::*;
    use crate::config::Config;
    use crate::outbox::Dest;

    const ADDRS: [&str; 2] = ["10.0.0.1:7000", "10.0.0.2:7000"];

    /// Two hosts whose beacons arrive only where `reaches` says, by the sender's index.
    struct Pair {
        hosts: [Catalog; 2],
        now: Time,
        reaches: [bool; 2],
    }

    impl Pair {
        fn new(reaches: [bool; 2]) -> Self {
            let host = |index: usize| {
                let number = u8::try_from(index + 1).unwrap();
                let config = Config {
                    domain: DomainId(0),
                    host: HostName::parse(["robot1", "base"][index]).unwrap(),
                    id: HostId([number; 16]),
                    incarnation: Incarnation {
                        ordinal: 1,
                        random: u64::from(number),
                    },
                    key: DomainKey::from_bytes([7; 32]),
                    control_addrs: vec![addr(index)],
                    data_port: 7001,
                    seeds: vec![addr(1 - index)],
                    beacon: true,
                    multicast: true,
                    prefix_since: Time(0),
                };
                Catalog::new(config, u64::from(number), Time(1))
            };
            Self {
                hosts: [host(0), host(1)],
                now: Time(1),
                reaches,
            }
        }

        /// Carries everything at once, by its way, for `span`.
        fn run(&mut self, span: Duration) {
            let end = self.now + span;
            while self.now <= end {
                let mut idle = true;
                for index in 0..2 {
                    let (mut datagram, now) = (Vec::new(), self.now);
                    while let Some(transmit) = self.hosts[index].poll_transmit(&mut datagram) {
                        let other = &mut self.hosts[1 - index];
                        match transmit.to {
                            Dest::Beacon if self.reaches[index] => {
                                other.handle_beacon(addr(index), &mut datagram, now);
                            }
                            Dest::Beacon => {}
                            Dest::Addr(_) => {
                                other.handle_datagram(addr(index), &mut datagram, now);
                            }
                        }
                        datagram.clear();
                        idle = false;
                    }
                }
                if idle {
                    let next = self.hosts.iter().filter_map(|host| host.poll_timeout());
                    let (next, _) = next.min().unwrap();
                    self.now = self.now.max(next);
                    let now = self.now;
                    self.hosts
                        .iter_mut()
                        .for_each(|host| host.handle_timeout(now));
                }
            }
        }

        /// What a host knows of the other's beacons, and of its own.
        fn known(&self, index: usize) -> (Option<Time>, Option<Time>) {
            let hosts = self.hosts[index].hosts();
            assert_eq!(hosts.len(), 1, "they met by their seeds");
            (hosts[0].beacon_heard, hosts[0].beacon_answered)
        }
    }

    fn addr(index: usize) -> SocketAddr {
        ADDRS[index].parse().unwrap()
    }

    #[test]
    fn each_host_knows_whether_beacons_pass_in_either_direction() {
        for reaches in [[true, true], [true, false], [false, true], [false, false]] {
            let mut pair = Pair::new(reaches);

            pair.run(Duration::from_secs(30));

            for index in 0..2 {
                let (heard, answered) = pair.known(index);
                assert_eq!(heard.is_some(), reaches[1 - index], "{reaches:?}");
                assert_eq!(answered.is_some(), reaches[index], "{reaches:?}");
                for at in [heard, answered].into_iter().flatten() {
                    let ago = pair.now.since(at);
                    assert!(ago <= Duration::from_secs(11), "{reaches:?}: {ago:?}");
                }
            }
        }
    }

    #[test]
    fn a_hello_by_unicast_proves_nothing_of_multicast() {
        let mut pair = Pair::new([false, false]);
        pair.run(Duration::from_secs(5));
        let mut hello = Vec::new();
        pair.hosts[0].handle_timeout(pair.now + Duration::from_secs(9));
        while let Some(transmit) = pair.hosts[0].poll_transmit(&mut hello) {
            if transmit.to == Dest::Beacon {
                break;
            }
            hello.clear();
        }
        assert!(!hello.is_empty(), "a beacon was due");
        let later = pair.now + Duration::from_secs(9);

        pair.hosts[1].handle_datagram(addr(0), &mut hello.clone(), later);
        assert_eq!(pair.known(1).0, None);
        pair.hosts[1].handle_beacon(addr(0), &mut hello, later);
        assert_eq!(pair.known(1).0, Some(later));
    }
}
