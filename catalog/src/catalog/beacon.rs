//! Whether multicast passes between two hosts, in both directions: who hears whose beacons.
//!
//! Beacons are the only datagrams that all hosts send by multicast, whether or not anybody reads, so they show what a
//! stream would meet. Nothing is decided by it: a replayed beacon misleads those who look, and nobody else.

use std::time::Duration;

use ddx_wire::message::Message;
use ddx_wire::{Tag, Time};

use super::Catalog;

/// Beacons of one host within this time count once, so that a flood of replayed ones is not answered.
const BEACON_PAUSE: Duration = Duration::from_millis(50);
/// Beacons answered among those of all hosts: each up to so many hosts, and beyond a share of them, so that the traffic
/// does not grow with the domain.
const ANSWERS: usize = 4;

impl Catalog {
    /// Notes a beacon that came by multicast, and says so to the host that sent it. Nothing is noted of a stranger.
    pub(super) fn note_beacon(&mut self, sender: Tag, now: Time) {
        let Some(session) = self.sessions.get(sender) else {
            return;
        };
        let Some(host) = self.hosts.get_mut(session.host) else {
            return;
        };
        if host
            .beacon_heard
            .is_some_and(|at| now.since(at) < BEACON_PAUSE)
        {
            return;
        }
        host.beacon_heard = Some(now);
        let hosts = self.sessions.iter().count();
        if hosts <= ANSWERS || self.rng.below(hosts) < ANSWERS {
            self.out.send(sender, &Message::BeaconHeard);
        }
    }
}

#[cfg(test)]
mod tests {
    use std::net::SocketAddr;

    use ddx_wire::seal::DomainKey;
    use ddx_wire::{DomainId, HostId, HostName, Incarnation};

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
                    assert!(ago <= Duration::from_secs(5), "{reaches:?}: {ago:?}");
                }
            }
        }
    }

    #[test]
    fn a_hello_by_unicast_proves_nothing_of_multicast_and_a_flood_is_answered_once() {
        let mut pair = Pair::new([false, false]);
        pair.run(Duration::from_secs(5));
        let mut hello = Vec::new();
        pair.hosts[0].handle_timeout(pair.now + Duration::from_secs(6));
        while let Some(transmit) = pair.hosts[0].poll_transmit(&mut hello) {
            if transmit.to == Dest::Beacon {
                break;
            }
            hello.clear();
        }
        assert!(!hello.is_empty(), "a beacon was due");
        let later = pair.now + Duration::from_secs(6);

        pair.hosts[1].handle_datagram(addr(0), &mut hello.clone(), later);
        assert_eq!(pair.known(1).0, None);

        let mut sent = Vec::new();
        while pair.hosts[1].poll_transmit(&mut sent).is_some() {}
        let before = pair.hosts[1].counters().sent;
        for _ in 0..100 {
            pair.hosts[1].handle_beacon(addr(0), &mut hello.clone(), later);
        }
        while pair.hosts[1].poll_transmit(&mut sent).is_some() {}
        assert_eq!(pair.known(1).0, Some(later));
        assert_eq!(pair.hosts[1].counters().sent - before, 1);
    }
}
