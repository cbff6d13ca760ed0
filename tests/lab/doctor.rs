//! `ddx doctor` tells by direction where multicast does not pass.

use std::process::Command;

use serde_json::{Value, json};

use crate::site::{Site, wait};

#[test]
fn the_doctor_tells_in_which_direction_multicast_is_blocked() {
    let Some(mut site) = Site::bare(&["robot1", "base"]) else {
        return;
    };
    // A firewall on base lets no beacon in; all else passes.
    let block = format!(
        "nft -f - <<'END'\ntable ip firewall {{ chain input {{ type filter hook input priority 0; \
         ip daddr 239.255.0.0/16 udp dport {} drop; }}; }}\nEND",
        ddx_catalog::BEACON_PORT_BASE
    );
    site.lab.host("base").shell(&block).unwrap();
    for host in ["robot1", "base"] {
        site.up(host, KEY);
    }
    site.wait_state("robot1", "base", "up");
    site.wait_state("base", "robot1", "up");

    for host in ["robot1", "base"] {
        let (code, ways) = doctor(&site, host, &["doctor", "multicast", "--seconds", "30"]);
        assert_eq!(code, Some(1), "{ways:?}");
        let passes = |from: &str, to: &str| {
            let way = ways
                .iter()
                .find(|way| way["from"] == from && way["to"] == to);
            way.map(|way| way["multicast"].clone())
        };
        assert_eq!(
            passes("base", "robot1"),
            Some(json!("yes")),
            "{host}: {ways:?}"
        );
        assert_eq!(
            passes("robot1", "base"),
            Some(json!("no")),
            "{host}: {ways:?}"
        );
    }
    let (code, found) = doctor(&site, "base", &["doctor"]);
    assert_eq!(code, Some(1), "{found:?}");
    let found = found.iter().find(|found| found["check"] == "multicast");
    let text = found.map(|found| found["text"].clone());
    assert_eq!(text, Some(json!("does not pass from robot1 to base")));

    let open = "nft delete table ip firewall";
    site.lab.host("base").shell(open).unwrap();
    for host in ["robot1", "base"] {
        let what = format!("multicast in both directions, by {host}");
        wait(&what, BEACONS, || {
            match doctor(&site, host, &["doctor", "multicast", "--seconds", "0"]) {
                (Some(0), _) => Ok(()),
                (_, ways) => Err(format!("{ways:?}")),
            }
        });
    }
}

/// The exit code of `ddx --json` in a host, and the objects that it prints.
fn doctor(site: &Site, host: &str, arguments: &[&str]) -> (Option<i32>, Vec<Value>) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_ddx"));
    command.arg("--json").args(arguments);
    let output = site.lab.host(host).exec(&command).unwrap();
    let lines = output.stdout.lines();
    let objects = lines.map(|line| serde_json::from_str(line).unwrap());
    (output.status.code(), objects.collect())
}

const KEY: &[&str] = &["--key", "/run/key"];
/// Two beacons, the digest that tells of them, and the second in which the daemon shows them.
const BEACONS: std::time::Duration = std::time::Duration::from_secs(20);
