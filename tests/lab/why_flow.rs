//! `ddx why` names what holds samples back on their way, each in one sentence with the figure that shows it.

use std::process::Command;

use ddx_rig::lab::Loss;
use ddx_rig::link::Profile;

use crate::program::{Asked, NAME, Order};
use crate::site::{PATIENCE, Site, wait};

/// Samples for longer than any case looks on, at 100 Hz.
fn write_on(bytes: usize) -> Order {
    Order::Write {
        first: 1,
        count: 100_000,
        period_us: 10_000,
        bytes,
    }
}

#[test]
fn why_names_what_a_contract_keeps_back() {
    let Some(site) = Site::new(&["robot1", "base"]) else {
        return;
    };
    let mut robot = site.program("robot1");
    let mut picky = site.program("base");
    let mut seldom = site.program("base");
    robot.open_writers("robot1/imu", 2);
    let fresh_only = Asked {
        max_age_ms: Some(50),
        ..Asked::default()
    };
    picky.open_readers_as("robot1/imu", 1, fresh_only);
    robot.tell(&Order::WriteAged {
        first: 1,
        count: 100_000,
        period_us: 10_000,
        age_ms: 500,
    });
    let kept =
        "the contract of `base` (newest, at most 50 ms old) keeps back all of `robot1/imu/0`";
    let parts = [
        kept,
        "samples a second were older than that when their turn came",
    ];
    site.wait_why("robot1", "robot1/imu/0", "contract", &parts);
    let nothing = format!("nothing of `robot1/imu/0` has come, and `{NAME}`");
    let parts = [nothing.as_str(), "takes only what is at most 50 ms old"];
    site.wait_why("base", "robot1/imu/0", "contract", &parts);

    picky.kill();
    let each_minute = Asked {
        rate_hz: Some(0.016),
        ..Asked::default()
    };
    seldom.open_readers_as("robot1/imu", 1, each_minute);
    seldom.read(1, PATIENCE);
    let parts = [
        "the contract of `base` (newest, at most 0.016 Hz) lets a sample of `robot1/imu/0`",
        "through each 62.5 s, of ",
        "that are written a second",
    ];
    site.wait_why("robot1", "robot1/imu/0", "contract", &parts);
    let parts = [
        "(newest, at most 0.016 Hz) lets a sample of",
        "through each 62.5 s: the last one came",
    ];
    site.wait_why("base", "robot1/imu/0", "contract", &parts);
}

#[test]
fn why_names_a_link_that_is_too_slow_or_loses_and_a_reader_that_is() {
    let Some(site) = Site::new(&["robot1", "base"]) else {
        return;
    };
    let (mut robot, mut reader) = site.imu(1, Asked::default());
    robot.tell(&write_on(1_000));
    reader.tell_read(u64::MAX, PATIENCE * 6);
    let host = site.lab.host("base");

    site.wait_why("base", "robot1/imu/0", "fine", &["all is well"]);
    host.set_link(&Profile::parse("lan --loss 20%").unwrap())
        .unwrap();
    let parts = [
        "% of `robot1/imu/0` is lost on the way from `robot1`",
        "samples a second",
    ];
    site.wait_why("base", "robot1/imu/0", "loss", &parts);
    let parts = ["% of datagrams are lost on the way to `base`, by unicast"];
    site.wait_why("robot1", "robot1/imu/0", "loss", &parts);

    host.set_link(&Profile::parse("802.11b-200k").unwrap())
        .unwrap();
    let parts = [
        "the link to `base` carries",
        "kB/s, and `robot1/imu/0` wants",
        "(newest, normal priority)",
        "are left out",
    ];
    site.wait_why("robot1", "robot1/imu/0", "slow-link", &parts);
    let parts = [
        "the link from `robot1` brings",
        "are written (newest, normal priority)",
        "are left out there",
    ];
    site.wait_why("base", "robot1/imu/0", "slow-link", &parts);

    host.clear_link().unwrap();
    site.wait_why("base", "robot1/imu/0", "fine", &["all is well"]);
    // Killed, it reads no more; the next one reads 5 samples a second of 100, and then none.
    reader.kill();
    let mut slow = site.program("base");
    slow.open_readers("robot1/imu", 1);
    slow.tell(&Order::ReadSlowly {
        count: 20,
        period_us: 200_000,
    });
    let who = format!("{NAME} (");
    let parts = [
        &who,
        "reads `robot1/imu/0` too slowly",
        "samples a second were overwritten in the ring of 8",
    ];
    site.wait_why("base", "robot1/imu/0", "slow-reader", &parts);
    slow.answer(PATIENCE);
    let parts = [
        &who,
        "has stopped reading `robot1/imu/0`",
        "samples a second come, and the ring holds 8",
    ];
    site.wait_why("base", "robot1/imu/0", "slow-reader", &parts);
}

#[test]
fn why_and_info_name_multicast_that_does_not_arrive() {
    let Some(site) = Site::new(&["robot1", "base1", "base2"]) else {
        return;
    };
    // A firewall on base2 lets no group in, as a switch that forgot a membership; all else passes.
    let block = "nft -f - <<'END'\ntable ip firewall { chain input { type filter hook input priority 0; \
                 ip daddr 239.194.0.0/16 drop; }; }\nEND";
    site.lab.host("base2").shell(block).unwrap();
    let mut robot = site.program("robot1");
    robot.open_writers("robot1/imu", 1);
    robot.write(0);
    let _readers = ["base1", "base2"].map(|host| {
        let mut reader = site.program(host);
        reader.open_readers("robot1/imu", 1);
        reader.read(0, PATIENCE);
        reader.tell_read(u64::MAX, PATIENCE * 6);
        reader
    });
    robot.tell(&write_on(200));
    let parts = [
        "`robot1/imu/0` goes to `base2` by unicast for",
        "nothing came by multicast",
    ];
    site.wait_why("robot1", "robot1/imu/0", "no-multicast", &parts);
    let parts = ["to `base2` by unicast for", "nothing came by multicast"];
    site.wait_info("robot1", "robot1/imu/0", &parts);
    // At the other end it is known that its owner gave the group up.
    site.wait_info(
        "base2",
        "robot1/imu/0",
        &[
            "from `robot1` by unicast for",
            "`robot1` gave up multicast 239.194.",
        ],
    );
}

#[test]
fn why_names_multicast_that_loses_more_than_unicast() {
    let Some(site) = Site::new(&["robot1", "base1", "base2"]) else {
        return;
    };
    site.lab
        .host("base2")
        .set_link(&Profile::parse("wifi-multicast-broken").unwrap())
        .unwrap();
    let mut robot = site.program("robot1");
    robot.open_writers("robot1/imu", 1);
    robot.write(0);
    let _readers = ["base1", "base2"].map(|host| {
        let mut reader = site.program(host);
        reader.open_readers("robot1/imu", 1);
        reader.read(0, PATIENCE);
        reader.tell_read(u64::MAX, PATIENCE * 6);
        reader
    });
    robot.tell(&write_on(200));
    let parts = [
        "`robot1/imu/0` goes to `base2` by unicast for",
        "multicast lost",
        "% of datagrams, unicast",
    ];
    site.wait_why("robot1", "robot1/imu/0", "no-multicast", &parts);
    site.wait_info(
        "robot1",
        "robot1/imu/0",
        &["to `base2` by unicast for", "multicast lost"],
    );
}

#[test]
fn why_names_another_key() {
    let Some(mut site) = Site::bare(&["robot1", "base"]) else {
        return;
    };
    site.up("robot1", &["--key", "/run/key"]);
    site.lab
        .host("base")
        .shell("tr 0123 3210 </run/key >/run/other")
        .unwrap();
    site.up("base", &["--key", "/run/other"]);
    let parts = [
        "no host `robot1` is known, and",
        "datagrams came that are sealed with another key",
    ];
    site.wait_why("base", "robot1/imu/0", "other-key", &parts);
}

#[test]
fn why_walks_every_step_when_asked() {
    let Some(site) = Site::new(&["robot1", "base"]) else {
        return;
    };
    let (mut robot, mut reader) = site.imu(1, Asked::default());
    robot.tell(&write_on(100));
    reader.tell_read(u64::MAX, PATIENCE * 6);
    // Loss that only one end sees is named at the other too.
    site.lab
        .host("base")
        .set_loss(Loss {
            from_percent: 0,
            to_percent: 0,
        })
        .unwrap();
    site.wait_why("robot1", "robot1/imu/0", "fine", &["all is well"]);
    let mut command = Command::new(env!("CARGO_BIN_EXE_ddx"));
    command.args(["why", "-v", "robot1/imu/0"]);
    for (host, steps) in [
        (
            "robot1",
            ["writer", "store", "contract", "path", "link"].as_slice(),
        ),
        (
            "base",
            ["writer", "store", "contract", "path", "link", "reader"].as_slice(),
        ),
    ] {
        let output = site.lab.host(host).exec(&command).unwrap();
        for step in steps {
            let found = output
                .stdout
                .lines()
                .any(|line| line.starts_with(&format!("ok  {step} ")));
            assert!(found, "{host}: {step} in {}", output.stdout);
        }
    }
}

impl Site {
    /// Waits until `ddx info` on a host says all of `parts` of an item.
    #[track_caller]
    fn wait_info(&self, host: &str, item: &str, parts: &[&str]) {
        let mut command = Command::new(env!("CARGO_BIN_EXE_ddx"));
        command.args(["info", item]);
        let what = format!("`ddx info {item}` on {host} to say {parts:?}");
        wait(&what, PATIENCE, || {
            let output = self.lab.host(host).exec(&command).unwrap();
            match parts.iter().all(|part| output.stdout.contains(part)) {
                true => Ok(()),
                false => Err(format!("{}{}", output.stdout, output.stderr)),
            }
        });
    }
}
