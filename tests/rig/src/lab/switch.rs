//! The switch of a lab: one bridge, its firewall rules that count and drop, and what they counted.
//!
//! What a host sends is counted before any fault takes it, what a host is sent is counted after: the difference is
//! what the link lost. Bytes are those of the IP packet.

use std::collections::BTreeMap;
use std::fmt::Arguments;

/// How many packets passed, and their bytes from the IP header on.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Count {
    /// Packets; a UDP datagram within the MTU is one.
    pub packets: u64,
    /// Bytes, the IP header included, the Ethernet header not.
    pub bytes: u64,
}

impl Count {
    /// Counts one packet.
    pub(crate) fn add(&mut self, bytes: usize) {
        self.packets += 1;
        self.bytes += u64::try_from(bytes).unwrap_or(u64::MAX);
    }

    fn since(self, earlier: Self) -> Self {
        Self {
            packets: self.packets.saturating_sub(earlier.packets),
            bytes: self.bytes.saturating_sub(earlier.bytes),
        }
    }
}

/// Both directions of one host's link.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Traffic {
    /// What the host put on its link, counted before faults.
    pub from: Count,
    /// What the switch handed to the host, counted after faults.
    pub to: Count,
}

impl Traffic {
    fn add(&mut self, other: Self) {
        self.from.packets += other.from.packets;
        self.from.bytes += other.from.bytes;
        self.to.packets += other.to.packets;
        self.to.bytes += other.to.bytes;
    }
}

/// All counters of a lab at one moment.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Counters {
    /// By host and label; the empty label counts everything.
    traffic: BTreeMap<(String, String), Traffic>,
}

impl Counters {
    /// Returns everything that passed the link of `host`; zero for a host that is not in the lab.
    #[must_use]
    pub fn link(&self, host: &str) -> Traffic {
        self.udp("", host)
    }

    /// Returns the datagrams that passed the link of `host` with a port that is watched under `label`.
    #[must_use]
    pub fn udp(&self, label: &str, host: &str) -> Traffic {
        self.traffic
            .get(&(host.to_owned(), label.to_owned()))
            .copied()
            .unwrap_or_default()
    }

    /// Returns the sum of [`Counters::udp`] over all hosts: `from` is what was sent, once for each transmission.
    #[must_use]
    pub fn udp_total(&self, label: &str) -> Traffic {
        let mut total = Traffic::default();
        for ((_, of), traffic) in &self.traffic {
            if of == label {
                total.add(*traffic);
            }
        }
        total
    }

    /// Adds what was counted elsewhere.
    pub(crate) fn add(&mut self, host: &str, label: &str, traffic: Traffic) {
        let key = (host.to_owned(), label.to_owned());
        self.traffic.entry(key).or_default().add(traffic);
    }

    /// Returns what was counted after `earlier` was taken.
    #[must_use]
    pub fn since(&self, earlier: &Self) -> Self {
        let traffic = self.traffic.iter().map(|(key, now)| {
            let then = earlier.traffic.get(key).copied().unwrap_or_default();
            (
                key.clone(),
                Traffic {
                    from: now.from.since(then.from),
                    to: now.to.since(then.to),
                },
            )
        });
        Self {
            traffic: traffic.collect(),
        }
    }

    /// Reads the text of `nft list counters`; `hosts` are in the order of their ports.
    pub(crate) fn parse(text: &str, hosts: &[String]) -> Self {
        let mut counters = Self::default();
        let mut place: Option<(bool, (String, String))> = None;
        for line in text.lines() {
            let words: Vec<&str> = line.split_whitespace().collect();
            match *words.as_slice() {
                ["counter", name, "{"] => place = place_of(name, hosts),
                ["packets", packets, "bytes", bytes] => {
                    if let (Some((is_from, key)), Ok(packets), Ok(bytes)) =
                        (place.take(), packets.parse(), bytes.parse())
                    {
                        let traffic = counters.traffic.entry(key).or_default();
                        let count = Count { packets, bytes };
                        if is_from {
                            traffic.from = count;
                        } else {
                            traffic.to = count;
                        }
                    }
                }
                _ => {}
            }
        }
        counters
    }
}

/// Splits `from_p2_samples` into its direction, host and label.
fn place_of(name: &str, hosts: &[String]) -> Option<(bool, (String, String))> {
    let mut parts = name.trim_matches('"').splitn(3, '_');
    let is_from = match parts.next()? {
        "from" => true,
        "to" => false,
        _ => return None,
    };
    let port: usize = parts.next()?.strip_prefix('p')?.parse().ok()?;
    let host = hosts.get(port.checked_sub(1)?)?;
    Some((
        is_from,
        (host.clone(), parts.next().unwrap_or_default().to_owned()),
    ))
}

/// The chance with which a link drops an IP packet, each way on its own.
///
/// ARP passes, so that what is measured is the program's repair and not the kernel's retry of an address
/// lookup, which takes a second.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Loss {
    /// Of a hundred packets that the host sends.
    pub from_percent: u8,
    /// Of a hundred packets that are sent to the host.
    pub to_percent: u8,
}

/// What is wrong with one host's link.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Fault {
    pub(crate) is_cut: bool,
    pub(crate) loss: Loss,
}

/// Returns the `ip -batch` text that makes the bridge.
///
/// A bridge that has just become querier floods for one query response interval, to let members report
/// themselves. Nobody is a member yet, so that interval is made short first, and set to one second before the
/// bridge comes up and sends its first query.
pub(crate) fn bridge_batch() -> String {
    "link add br0 type bridge mcast_snooping 1 mcast_query_response_interval 1 mcast_startup_query_interval 100 \
     mcast_query_interval 1000 mcast_membership_interval 2100 mcast_last_member_interval 10\n\
     link set br0 type bridge mcast_querier 1\n\
     link set br0 type bridge mcast_query_response_interval 100\n\
     link set br0 up\n"
        .to_owned()
}

/// Returns the `nft` text of the table that counts and drops, for ports `p1` to `pN`.
///
/// A port with a wire is `w1` to `wN`: the switch drops there, and counts no longer, which the wire does instead.
pub(crate) fn base_rules(ports: usize) -> String {
    let mut rules = format!(
        "add table {TABLE}\n\
         add chain {TABLE} sent {{ type filter hook prerouting priority -300; }}\n\
         add chain {TABLE} faults_from {{ type filter hook prerouting priority -200; }}\n\
         add chain {TABLE} faults_to {{ type filter hook postrouting priority 100; }}\n\
         add chain {TABLE} delivered {{ type filter hook postrouting priority 300; }}\n"
    );
    for port in 1..=ports {
        rules.push_str(&count_rules(port));
        for (direction, key) in DIRECTIONS {
            line(
                &mut rules,
                format_args!("add chain {TABLE} fault_{direction}_p{port}"),
            );
            line(
                &mut rules,
                format_args!(
                    "add rule {TABLE} faults_{direction} {key} {{ p{port}, w{port} }} jump fault_{direction}_p{port}"
                ),
            );
        }
    }
    rules
}

/// Returns the `nft` text that puts the link of `port` into a state, whatever its state was.
pub(crate) fn fault_rules(port: usize, fault: Fault) -> String {
    let mut rules = String::new();
    for (direction, _) in DIRECTIONS {
        let chain = format!("{TABLE} fault_{direction}_p{port}");
        let percent = if direction == "from" {
            fault.loss.from_percent
        } else {
            fault.loss.to_percent
        };
        line(&mut rules, format_args!("flush chain {chain}"));
        if fault.is_cut {
            line(&mut rules, format_args!("add rule {chain} drop"));
        } else if percent > 0 {
            line(
                &mut rules,
                format_args!(
                    "add rule {chain} ether type ip numgen random mod 100 < {percent} drop"
                ),
            );
        }
    }
    rules
}

/// Returns the `nft` text that begins to count datagrams under a label, for ports `p1` to `pN`.
pub(crate) fn watch_rules(label: &str, ports: usize) -> String {
    let mut rules = format!("add set {TABLE} ports_{label} {{ type inet_service; }}\n");
    for port in 1..=ports {
        for (direction, key) in DIRECTIONS {
            let name = format!("{direction}_p{port}_{label}");
            let chain = chain_of(direction);
            line(&mut rules, format_args!("add counter {TABLE} {name}"));
            line(&mut rules, format_args!("add chain {TABLE} {name}"));
            // The return keeps a datagram with both ports in the set from counting twice.
            line(
                &mut rules,
                format_args!(
                    "add rule {TABLE} {name} udp dport @ports_{label} counter name {name} return"
                ),
            );
            line(
                &mut rules,
                format_args!(
                    "add rule {TABLE} {name} udp sport @ports_{label} counter name {name}"
                ),
            );
            line(
                &mut rules,
                format_args!("add rule {TABLE} {chain} {key} p{port} jump {name}"),
            );
        }
    }
    rules
}

/// Returns the `nft` text that adds UDP ports to a label.
pub(crate) fn port_rules(label: &str, udp_ports: &[u16]) -> String {
    let mut rules = String::new();
    for port in udp_ports {
        line(
            &mut rules,
            format_args!("add element {TABLE} ports_{label} {{ {port} }}"),
        );
    }
    rules
}

fn count_rules(port: usize) -> String {
    let mut rules = String::new();
    for (direction, key) in DIRECTIONS {
        let name = format!("{direction}_p{port}");
        let chain = chain_of(direction);
        line(&mut rules, format_args!("add counter {TABLE} {name}"));
        line(
            &mut rules,
            format_args!("add rule {TABLE} {chain} {key} p{port} counter name {name}"),
        );
    }
    rules
}

fn chain_of(direction: &str) -> &'static str {
    if direction == "from" {
        "sent"
    } else {
        "delivered"
    }
}

fn line(rules: &mut String, text: Arguments<'_>) {
    rules.push_str(&text.to_string());
    rules.push('\n');
}

/// The one firewall table of a lab, in the bridge family.
pub(crate) const TABLE: &str = "bridge lab";

/// Each direction, as seen from the host, with the rule key that selects the switch port.
const DIRECTIONS: [(&str, &str); 2] = [("from", "iifname"), ("to", "oifname")];

#[cfg(test)]
mod tests {
    use super::*;

    const LISTING: &str = "table bridge lab {\n\tcounter from_p1 {\n\t\tpackets 7 bytes 700\n\t}\n\
        \tcounter to_p2_samples {\n\t\tpackets 3 bytes 90\n\t}\n\tcounter from_p9 {\n\t\tpackets 1 bytes 1\n\t}\n}\n";

    fn hosts() -> Vec<String> {
        vec!["a".to_owned(), "b".to_owned()]
    }

    #[test]
    fn a_listing_is_read_by_host_direction_and_label() {
        let counters = Counters::parse(LISTING, &hosts());

        assert_eq!(
            counters.link("a").from,
            Count {
                packets: 7,
                bytes: 700
            }
        );
        assert_eq!(counters.link("a").to, Count::default());
        assert_eq!(
            counters.udp("samples", "b").to,
            Count {
                packets: 3,
                bytes: 90
            }
        );
        assert_eq!(counters.udp_total("samples").to.packets, 3);
        assert_eq!(
            counters.traffic.len(),
            2,
            "the counter of a port without a host is left out"
        );
    }

    #[test]
    fn since_subtracts_what_was_there_before() {
        let earlier = Counters::parse(LISTING, &hosts());
        let later = Counters::parse(&LISTING.replace("packets 7", "packets 9"), &hosts());

        assert_eq!(
            later.since(&earlier).link("a").from,
            Count {
                packets: 2,
                bytes: 0
            }
        );
    }

    #[test]
    fn a_cut_hides_the_loss_and_a_healed_link_has_no_rule() {
        let loss = Loss {
            from_percent: 33,
            to_percent: 0,
        };

        let cut = fault_rules(2, Fault { is_cut: true, loss });
        let lossy = fault_rules(
            2,
            Fault {
                is_cut: false,
                loss,
            },
        );
        let healthy = fault_rules(2, Fault::default());

        assert_eq!(cut.matches("drop").count(), 2);
        assert!(!cut.contains("numgen"));
        assert!(lossy.contains(
            "add rule bridge lab fault_from_p2 ether type ip numgen random mod 100 < 33 drop"
        ));
        assert_eq!(lossy.matches("drop").count(), 1);
        assert!(!healthy.contains("add"));
    }
}
