//! What growth of the daemon's counters means. Only those that mean trouble are here: strangers at a start, own datagrams
//! that multicast returns, and streams of a shared group that nobody here reads are as it should be.

use super::Finding;
use super::facts::Daemon;
use super::multicast::firewall;

/// One warning for each counter that means trouble.
pub(super) fn judge(daemon: &Daemon) -> Vec<Finding> {
    let counted = daemon.counters.iter().filter(|(_, count)| **count > 0);
    counted
        .filter_map(|(name, count)| {
            let (_, what) = name.split_once('_')?;
            let (meaning, hint) = meaning(what, daemon.domain)?;
            let text = format!("{count} since the daemon started: {meaning}");
            Some(Finding::warn("counter", text, hint).of(name))
        })
        .collect()
}

/// By the counter's name without `control_` or `data_`.
fn meaning(what: &str, domain: u16) -> Option<(&'static str, String)> {
    let (meaning, hint) = match what {
        "unsent_datagrams" => (
            "datagrams that the kernel did not take, because its queue was full or there was no route",
            "`ip route get 239.255.0.0` and `ip -brief address`; if both are well: more is sent than the link takes",
        ),
        "stale_samples" => (
            "samples that came when a newer one was held already",
            "two hosts may write one name: `ddx ls`",
        ),
        "refused_samples" => (
            "samples that do not fit their item",
            "`ddx info NAME` shows its capacity and schema; restart its writer",
        ),
        "untold_notices" => (
            "acknowledgements and requests that were dropped because the daemon was far behind",
            "`top -H` shows what takes the cores; fewer or slower items relieve the daemon",
        ),
        "refused_streams" => (
            "streams of other hosts that were not taken in, because there are too many",
            "catalog/PROTOCOL.md has the limit; `ddx ls` shows what is read here",
        ),
        "unsent_streams" => (
            "streams to other hosts that were not opened, because there are too many: their readers get nothing",
            "catalog/PROTOCOL.md has the limit; `ddx stat` shows what is sent",
        ),
        "unsent_readers" => (
            "reading hosts that a stream left out, because it has too many: they get nothing",
            "catalog/PROTOCOL.md has the limit; `ddx stat` shows the streams",
        ),
        "dropped_nacks" | "dropped_requests" => (
            "requests for lost samples that found no room and were made again later: very much is lost",
            "`ddx stat` shows which link loses; `ddx host ls` its loss",
        ),
        "dropped_gone" | "dropped_records" => (
            "news of samples that a reader will not get that found no room and are told again later",
            "`ddx stat` shows where samples are overwritten or too old; a lower rate or a deeper ring relieves the link",
        ),
        "overflows" => (
            "programs that were cut off because they did not collect the daemon's answers",
            "such a program is stopped or hangs; `quotas` in deploy/ddx.toml has the limit",
        ),
        "quota_refusals" | "turned_away" => (
            "requests or connections of programs beyond what one program, or all, may take",
            "the program was told which limit; `quotas` in deploy/ddx.toml sets them",
        ),
        "unkept" => (
            "items without a writer that may not outlive this daemon, because too many changed at once",
            "`ddx ls` shows them; write them again after a restart",
        ),
        "bad_messages" | "bad_segments" => (
            "messages or memory of programs that are not as they must be",
            "build that program with this version: `ddx --version`",
        ),
        "stale_lives" => (
            "greetings of an earlier life of a host",
            "two machines with a copied disk share one identity: remove /var/lib/ddx on one of them and restart it",
        ),
        "over_limit" => (
            "what was dropped because a limit was reached: hosts, handshakes, items, subscriptions, leases or the queue to send",
            "`ddx host ls` and `ddx ls` show how many there are; catalog/PROTOCOL.md has the limits",
        ),
        "membership_refused" => (
            "messages about membership that made no sense",
            "all hosts should run one version: `ddx --version`",
        ),
        "directory_full" => (
            "items of other hosts, or parts of their schemas, that had no room",
            "`ddx ls` shows who has so many items",
        ),
        "refused_other_protocol_version" => (
            "datagrams of another version of the protocol",
            "all hosts should run one version: `ddx --version`",
        ),
        "refused_foreign_domain" => {
            return Some((
                "datagrams sealed with another key: another fleet, or a host with an old key, uses this domain's number",
                format!(
                    "compare the key files (`sha256sum`), or take another number than {domain}: `ddx up --domain N`"
                ),
            ));
        }
        "refused_forged" => (
            "datagrams whose seal is not of this key: damage on the way, or an attack",
            "`sudo tcpdump -ni any udp` shows where they come from",
        ),
        "refused_replayed" => (
            "datagrams that came twice: a network that doubles them, two hosts with one identity, or an attack",
            "a few after a change of network are harmless; if it grows: a bridge with a loop, or a copied /var/lib/ddx",
        ),
        "refused_truncated" | "refused_wrong_lane" => {
            return Some((
                "datagrams that are not of ddx",
                format!(
                    "another program uses its ports: `sudo ss -ulpn`, `sudo tcpdump -ni any udp`; those of domain {domain} are in `{}`",
                    firewall(domain)
                ),
            ));
        }
        "refused_malformed" => (
            "datagrams of a member whose content breaks the protocol",
            "all hosts should run one version: `ddx --version`",
        ),
        _ => return None,
    };
    Some((meaning, hint.to_owned()))
}
