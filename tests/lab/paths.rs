//! Interfaces come, go and change address, several at once: samples flow on, and no reader notices.

use std::time::Duration;

use serde_json::Value;

use crate::program::{Book, Order, Program};
use crate::site::{PATIENCE, Site, report, wait};

#[test]
fn samples_flow_on_when_one_of_two_networks_dies() {
    let Some(mut site) = Site::bare(&["robot1", "base"]) else {
        return;
    };
    for (host, address) in [("robot1", "10.78.0.1"), ("base", "10.78.0.2")] {
        plug(&site, host, address);
    }
    let (mut robot, mut reader) = start(&mut site);
    wait_paths(&site, "robot1", "base", 2);
    wait_paths(&site, "base", "robot1", 2);

    // Falls silent: nobody is told.
    let mut flow = Flow::new(&mut robot, &mut reader);
    let (used, silent) = flow.gap(|| {
        let used = network(&site, "robot1", "base");
        set_silent(&site, used, true);
        used
    });
    report("a network fell silent; samples flowed again after", silent);
    assert!(silent < FLOWS_WITHIN, "{silent:?}");
    assert_ne!(network(&site, "robot1", "base"), used);
    set_silent(&site, used, false);
    wait_paths(&site, "robot1", "base", 2);

    // Goes down at either end.
    for host in ["robot1", "base"] {
        let (used, down) = flow.gap(|| {
            let used = network(&site, "robot1", "base");
            shell(
                &site,
                host,
                &format!("ip link set {} down", interface(used)),
            );
            used
        });
        report(
            &format!("an interface of {host} went down; samples flowed again after"),
            down,
        );
        assert!(down < TOLD_WITHIN, "{down:?}");
        assert_ne!(network(&site, "robot1", "base"), used);
        shell(&site, host, &format!("ip link set {} up", interface(used)));
        wait_paths(&site, "robot1", "base", 2);
        wait_paths(&site, "base", "robot1", 2);
    }
    flow.check();
}

#[test]
fn a_host_is_itself_at_another_address() {
    let Some(mut site) = Site::bare(&["robot1", "base"]) else {
        return;
    };
    let (mut robot, mut reader) = start(&mut site);
    let mut flow = Flow::new(&mut robot, &mut reader);

    for (host, old, new) in [
        ("robot1", "10.77.0.1", "10.77.0.101"),
        ("base", "10.77.0.2", "10.77.0.102"),
    ] {
        let ((), gap) = flow.gap(|| {
            let change =
                format!("ip address del {old}/24 dev eth0; ip address add {new}/24 dev eth0");
            shell(&site, host, &change);
        });
        report(
            &format!("{host} changed its address; samples flowed again after"),
            gap,
        );
        assert!(gap < FLOWS_WITHIN, "{gap:?}");
        let other = if host == "base" { "robot1" } else { "base" };
        let what = format!("{other} to show {host} at {new}");
        wait(&what, PATIENCE, || match entry(&site, other, host) {
            Some(entry) if entry["addr"].to_string().contains(new) => Ok(()),
            entry => Err(format!("{entry:?}")),
        });
    }
    flow.check();
}

#[test]
fn a_daemon_that_starts_before_its_interface_waits_for_it() {
    let Some(mut site) = Site::bare(&["robot1", "base"]) else {
        return;
    };
    site.up("base", KEY);
    shell(
        &site,
        "robot1",
        "ip link set eth0 down; ip address flush dev eth0",
    );

    let ready = site.up("robot1", &["--key", "/run/key", "--iface", "eth0"]);

    assert_eq!(ready["control"], serde_json::json!([]), "{ready}");
    let (mut robot, mut reader) = (site.program("robot1"), site.program("base"));
    robot.open_writers("robot1/imu", 1);
    reader.open_readers("robot1/imu", 1);
    robot.write(1);
    let up = ddx_store::now().0;
    shell(
        &site,
        "robot1",
        "ip link set eth0 up; ip address add 10.77.0.1/24 dev eth0",
    );
    let (read, _) = reader.read(1, PATIENCE);
    report(
        "an interface came up; its host was met and read after",
        Duration::from_nanos(read.saturating_sub(up)),
    );

    // The same for an interface that did not even exist.
    plug(&site, "base", "10.78.0.2");
    shell(&site, "robot1", "ip link set eth0 down");
    site.terminate("robot1");
    site.up("robot1", KEY);
    plug(&site, "robot1", "10.78.0.1");
    site.wait_state("base", "robot1", "up");
    assert_eq!(network(&site, "base", "robot1"), 78);
}

#[test]
fn readers_on_several_networks_are_served_by_multicast_on_each() {
    let Some(mut site) = Site::bare(&["robot1", "base1", "base2"]) else {
        return;
    };
    site.up("robot1", KEY);
    site.up("base1", KEY);
    shell(&site, "base2", "ip link set eth0 down");
    site.up("base2", KEY);
    let mut robot = site.program("robot1");
    robot.open_writers("robot1/imu", 1);
    let mut readers = ["base1", "base2"].map(|host| {
        let mut reader = site.program(host);
        reader.open_readers("robot1/imu", 1);
        reader
    });
    // The second network comes to both of its hosts while they run.
    for (host, address) in [("robot1", "10.78.0.1"), ("base2", "10.78.0.3")] {
        plug(&site, host, address);
    }
    site.wait_state("robot1", "base1", "up");
    site.wait_state("robot1", "base2", "up");

    let order = Order::Write {
        first: 1,
        count: 300,
        period_us: 10_000,
        bytes: 1_000,
    };
    robot.ask(&order);
    site.wait_path("robot1", "robot1/imu", "multicast", 2);
    robot.write(400);
    for reader in &mut readers {
        let (_, books) = reader.read(400, PATIENCE);
        assert_eq!((books[0].backwards, books[0].lost), (0, 0), "{books:?}");
    }
}

/// A stream of samples whose interruptions are measured.
struct Flow<'a> {
    robot: &'a mut Program,
    reader: &'a mut Program,
    next: u64,
    books: Vec<Book>,
}

impl<'a> Flow<'a> {
    fn new(robot: &'a mut Program, reader: &'a mut Program) -> Self {
        Self {
            robot,
            reader,
            next: 1_000,
            books: Vec::new(),
        }
    }

    /// Lets samples flow for two seconds, after which all is measured and shown; does something, and tells how long after
    /// it one that was written later arrived.
    fn gap<T>(&mut self, act: impl FnOnce() -> T) -> (T, Duration) {
        self.write();
        let (_, _) = self.reader.read(self.next - 1, PATIENCE);
        self.robot.answer(PATIENCE);
        let acted = ddx_store::now().0;
        let done = act();
        let first = self.next;
        self.write();
        let (read, books) = self.reader.read(first, PATIENCE);
        self.robot.answer(PATIENCE);
        let (_, last) = self.reader.read(self.next - 1, PATIENCE);
        assert_eq!(last.len(), books.len());
        self.books = last;
        (done, Duration::from_nanos(read.saturating_sub(acted)))
    }

    fn write(&mut self) {
        let order = Order::Write {
            first: self.next,
            count: FLOW_COUNT,
            period_us: 10_000,
            bytes: 64,
        };
        self.next += FLOW_COUNT;
        self.robot.tell(&order);
    }

    /// Whether the reader saw one epoch, in order.
    fn check(&self) {
        let book = &self.books[0];
        assert_eq!(book.backwards, 0, "{book:?}");
    }
}

/// Starts both daemons, a writer on `robot1` and a reader of its item on `base`.
fn start(site: &mut Site) -> (Program, Program) {
    for host in ["robot1", "base"] {
        site.up(host, KEY);
    }
    site.wait_state("base", "robot1", "up");
    let (mut robot, mut reader) = (site.program("robot1"), site.program("base"));
    robot.open_writers("robot1/imu", 1);
    reader.open_readers("robot1/imu", 1);
    robot.write(1);
    reader.read(1, PATIENCE);
    (robot, reader)
}

/// Gives a host an interface `eth1` on a second network.
fn plug(site: &Site, host: &str, address: &str) {
    site.lab.host(host).plug("eth1", "second").unwrap();
    let script = format!("ip address add {address}/24 dev eth1; ip link set eth1 up");
    shell(site, host, &script);
}

/// Lets nothing pass on a network, while every interface stays up.
fn set_silent(site: &Site, network: u8, silent: bool) {
    let robot = site.lab.host("robot1");
    match (network, silent) {
        (77, true) => robot.cut().unwrap(),
        (77, false) => robot.heal().unwrap(),
        (_, true) => drop(site.lab.switch("ip link set secondp1 nomaster").unwrap()),
        (_, false) => drop(
            site.lab
                .switch("ip link set secondp1 master second")
                .unwrap(),
        ),
    }
}

fn interface(network: u8) -> &'static str {
    if network == 77 { "eth0" } else { "eth1" }
}

/// The network by which one host sends to another: the second byte of the address.
fn network(site: &Site, from: &str, to: &str) -> u8 {
    let entry = entry(site, from, to).unwrap();
    let addr = entry["addr"].as_str().unwrap();
    addr.split('.').nth(1).unwrap().parse().unwrap()
}

fn entry(site: &Site, host: &str, other: &str) -> Option<Value> {
    let hosts = site.ddx(host, &["host", "ls"]);
    hosts.into_iter().find(|entry| entry["host"] == other)
}

/// Waits until `host` has measured so many paths to `other`, all of which answer.
fn wait_paths(site: &Site, host: &str, other: &str, count: usize) {
    let what = format!("{host} to have {count} paths to {other}");
    wait(&what, PATIENCE, || {
        let entry = entry(site, host, other).unwrap_or_default();
        let paths = entry["paths"].as_array().cloned().unwrap_or_default();
        let measured = paths.iter().filter(|path| path["rtt_us"].is_u64());
        if (measured.count(), paths.len()) == (count, count) {
            Ok(())
        } else {
            Err(entry.to_string())
        }
    });
}

fn shell(site: &Site, host: &str, script: &str) {
    site.lab.host(host).shell(script).unwrap();
}

const KEY: &[&str] = &["--key", "/run/key"];
const FLOW_COUNT: u64 = 200;
/// As promised.
const FLOWS_WITHIN: Duration = Duration::from_secs(1);
/// What the kernel tells need not be found out; the rest is for a busy machine.
const TOLD_WITHIN: Duration = Duration::from_millis(500);
