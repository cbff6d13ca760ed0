//! A link that comes and goes leaves nothing behind.

use std::env;
use std::time::{Duration, Instant};

use crate::program::{Order, Program};
use crate::site::{PATIENCE, Site, row, wait};

/// Fifty times, or as often as `DDX_FLAPS` says.
#[test]
fn a_link_that_flaps_leaves_nothing_behind() {
    let flaps: u64 = env::var("DDX_FLAPS").map_or(FLAPS, |flaps| flaps.parse().unwrap());
    let Some(mut site) = Site::new(&["robot1", "base"]) else {
        return;
    };
    // The kernel looks for a neighbour that it lost once a second, which is no delay of ours.
    for host in site.lab.hosts() {
        host.shell("echo 50 >/proc/sys/net/ipv4/neigh/eth0/retrans_time_ms")
            .unwrap();
    }
    let mut robot = site.program("robot1");
    robot.open_writers("robot1/imu", ITEMS);
    robot.write(0);
    site.wait_listed("base", "robot1/imu/0", true);
    let mut value = 0;
    // What is allocated once and kept, such as room of queues, is there after some flaps.
    flap(&mut site, &mut value, &mut robot, WARM);
    let before = ["robot1", "base"].map(|host| site.footprint(host));
    let start = Instant::now();
    flap(&mut site, &mut value, &mut robot, flaps);
    row(&format!("{flaps} flaps in {:.1?}", start.elapsed()));
    let mut after = Vec::new();
    for (host, before) in ["robot1", "base"].iter().zip(&before) {
        // The daemon sees a moment later that programs have ended, this one's own questions too.
        wait(
            &format!("{host} without files left over"),
            PATIENCE,
            || match site.footprint(host) {
                left if left.files > before.files => Err(format!("{left:?}")),
                left => {
                    after.push(left);
                    Ok(())
                }
            },
        );
    }
    for (host, (before, after)) in ["robot1", "base"].iter().zip(before.iter().zip(&after)) {
        row(&format!("{host}: {before:?} before, {after:?} after"));
        assert!(
            after.private_kb < before.private_kb + KEPT_KB,
            "{host}: {before:?} before, {after:?} after"
        );
        assert_eq!(after.items, before.items, "{host}");
        assert_eq!(after.routes, 0, "{host}");
    }
}

/// Cuts and heals the link of `base` while it reads; then the last value is there, and the readers go.
fn flap(site: &mut Site, value: &mut u64, robot: &mut Program, flaps: u64) {
    let mut reader = site.program("base");
    reader.open_readers("robot1/imu", ITEMS);
    reader.read(*value, PATIENCE);
    for flap in 1..=flaps {
        let is_long = flap % LONG_EACH == 0;
        let cut = if is_long { LONG } else { SHORT };
        // Values are written before, during and after the cut, one each millisecond.
        let count = u64::try_from((cut + 2 * SHORT).as_millis()).unwrap();
        robot.tell(&Order::Write {
            first: *value + 1,
            count,
            period_us: 1_000,
            bytes: 64,
        });
        *value += count;
        site.lab.host("base").cut().unwrap();
        pause(cut);
        site.lab.host("base").heal().unwrap();
        robot.answer(PATIENCE);
        if is_long || flap == flaps {
            let (_, books) = reader.read(*value, PATIENCE);
            assert!(books.iter().all(|book| book.backwards == 0), "{books:?}");
        }
    }
    reader.kill();
    for host in ["robot1", "base"] {
        wait(&format!("{host} without routes"), PATIENCE, || {
            match site.footprint(host) {
                left if left.routes == 0 => Ok(()),
                left => Err(format!("{left:?}")),
            }
        });
    }
}

/// How long a cut lasts is what is tested, so here time is waited for and not a condition.
fn pause(span: Duration) {
    std::thread::sleep(span);
}

/// What a daemon takes.
#[derive(Debug, PartialEq, Eq)]
struct Footprint {
    private_kb: u64,
    files: usize,
    items: usize,
    routes: usize,
}

impl Site {
    fn footprint(&mut self, host: &str) -> Footprint {
        let pid = self.pid(host);
        let rollup = std::fs::read_to_string(format!("/proc/{pid}/smaps_rollup")).unwrap();
        let private = rollup
            .lines()
            .find_map(|line| line.strip_prefix("Private_Dirty:"))
            .and_then(|rest| rest.split_whitespace().next()?.parse().ok());
        let routes = self.ddx(host, &["get", "@/routes"]);
        Footprint {
            private_kb: private.unwrap(),
            files: std::fs::read_dir(format!("/proc/{pid}/fd"))
                .unwrap()
                .count(),
            items: self.ddx(host, &["ls", "**"]).len(),
            routes: routes[0]["value"].as_array().map_or(0, Vec::len),
        }
    }
}

const FLAPS: u64 = 50;
/// What pages may fill up without growing from flap to flap: a thousand take some 250.
const KEPT_KB: u64 = 500;
const WARM: u64 = LONG_EACH;
const ITEMS: usize = 10;
const SHORT: Duration = Duration::from_millis(30);
/// Longer than a lease and than what makes a host unreachable.
const LONG: Duration = Duration::from_millis(3_600);
const LONG_EACH: u64 = 25;
