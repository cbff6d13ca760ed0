//! This machine's load, memory and network counters, from `/proc`.

use std::fs;

use anyhow::Context as _;
use ddx_store::{Item, Store, Writer};

use super::item_name;
use crate::error::Failure;

/// How busy the processors are.
#[derive(Clone, Copy, Debug, Item, PartialEq)]
#[repr(C)]
pub(crate) struct Load {
    /// Tasks that wanted to run, mean of one minute.
    #[ddx(unit = "1")]
    pub(crate) one: f32,
    /// The same of five minutes.
    #[ddx(unit = "1")]
    pub(crate) five: f32,
    /// The same of fifteen minutes.
    #[ddx(unit = "1")]
    pub(crate) fifteen: f32,
    /// Share of time in which the processors worked since the last sample.
    #[ddx(unit = "1", range = "0..1")]
    pub(crate) busy: f32,
}

/// Main memory.
#[derive(Clone, Copy, Debug, Item, PartialEq)]
#[repr(C)]
pub(crate) struct Memory {
    #[ddx(unit = "B")]
    pub(crate) total: u64,
    /// What programs can still have without swapping.
    #[ddx(unit = "B")]
    pub(crate) available: u64,
}

/// Counters of all interfaces but the loopback, since they came up.
#[derive(Clone, Copy, Debug, Default, Item, PartialEq)]
#[repr(C)]
pub(crate) struct Network {
    #[ddx(unit = "B")]
    pub(crate) received: u64,
    #[ddx(unit = "B")]
    pub(crate) sent: u64,
    pub(crate) packets_received: u64,
    pub(crate) packets_sent: u64,
    /// Packets that were dropped or broken, in both directions.
    pub(crate) lost: u64,
}

/// The writers of the three items.
#[derive(Debug)]
pub(crate) struct Gauge {
    load: Writer<Load>,
    memory: Writer<Memory>,
    network: Writer<Network>,
    ticks: Ticks,
}

/// Processor time since the start of the machine, in the kernel's ticks.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Ticks {
    idle: u64,
    all: u64,
}

impl Gauge {
    /// Takes the leases of the items.
    pub(crate) fn open(store: &Store, name: &str) -> Result<Self, Failure> {
        Ok(Self {
            load: store.writer(&item_name(name, "load"))?,
            memory: store.writer(&item_name(name, "memory"))?,
            network: store.writer(&item_name(name, "network"))?,
            ticks: Ticks::default(),
        })
    }

    /// Reads the counters and publishes one sample of each item.
    pub(crate) fn publish(&mut self) -> Result<(), Failure> {
        let ticks = read("/proc/stat", ticks)?;
        let busy = ticks.busy_since(self.ticks);
        self.ticks = ticks;
        self.load
            .write(&read("/proc/loadavg", |text| load(text, busy))?)?;
        self.memory.write(&read("/proc/meminfo", memory)?)?;
        self.network.write(&read("/proc/net/dev", network)?)?;
        Ok(())
    }
}

impl Ticks {
    fn busy_since(self, before: Self) -> f32 {
        let all = self.all.saturating_sub(before.all);
        let idle = self.idle.saturating_sub(before.idle).min(all);
        if all == 0 {
            return 0.0;
        }
        #[expect(
            clippy::cast_precision_loss,
            reason = "a share needs no more digits than a float has"
        )]
        let share = (all - idle) as f32 / all as f32;
        share
    }
}

fn read<T>(path: &str, parse: impl FnOnce(&str) -> Option<T>) -> anyhow::Result<T> {
    let text = fs::read_to_string(path).with_context(|| format!("cannot read `{path}`"))?;
    parse(&text).with_context(|| format!("`{path}` is not laid out as expected"))
}

fn load(text: &str, busy: f32) -> Option<Load> {
    let mut means = text.split_whitespace().map(|word| word.parse().ok());
    Some(Load {
        one: means.next()??,
        five: means.next()??,
        fifteen: means.next()??,
        busy,
    })
}

fn ticks(text: &str) -> Option<Ticks> {
    let fields: Vec<u64> = text
        .lines()
        .next()?
        .strip_prefix("cpu ")?
        .split_whitespace()
        .map_while(|word| word.parse().ok())
        .collect();
    // user nice system idle iowait irq softirq steal; guest time is part of user.
    let (idle, waiting) = (fields.get(3)?, fields.get(4)?);
    Some(Ticks {
        idle: idle + waiting,
        all: fields.iter().take(8).sum(),
    })
}

fn memory(text: &str) -> Option<Memory> {
    let field = |name: &str| {
        let line = text.lines().find_map(|line| line.strip_prefix(name))?;
        let kib: u64 = line.trim().strip_suffix(" kB")?.parse().ok()?;
        Some(kib * 1_024)
    };
    Some(Memory {
        total: field("MemTotal:")?,
        available: field("MemAvailable:")?,
    })
}

fn network(text: &str) -> Option<Network> {
    let mut sum = Network::default();
    for line in text.lines().skip(2) {
        let (name, counters) = line.split_once(':')?;
        if name.trim() == "lo" {
            continue;
        }
        let counters: Vec<u64> = counters
            .split_whitespace()
            .map_while(|word| word.parse().ok())
            .collect();
        // Received: bytes packets errs drop fifo frame compressed multicast; then sent, likewise.
        let at = |index: usize| counters.get(index).copied();
        sum.received += at(0)?;
        sum.packets_received += at(1)?;
        sum.sent += at(8)?;
        sum.packets_sent += at(9)?;
        sum.lost += at(2)? + at(3)? + at(10)? + at(11)?;
    }
    Some(sum)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counters_of_all_interfaces_but_the_loopback_are_summed() {
        let text = "Inter-|   Receive  |  Transmit\n face |bytes ...\n\
            \x20   lo:  99 9 0 0 0 0 0 0  99 9 0 0 0 0 0 0\n\
            \x20 eth0: 100 1 2 3 0 0 0 0 200 2 4 5 0 0 0 0\n\
            \x20 wlan0: 10 1 0 0 0 0 0 0  20 2 0 0 0 0 0 0\n";

        assert_eq!(
            network(text),
            Some(Network {
                received: 110,
                sent: 220,
                packets_received: 2,
                packets_sent: 4,
                lost: 14,
            })
        );
    }

    #[test]
    fn busy_is_the_share_since_the_last_sample() {
        let before = ticks("cpu  10 0 10 70 10 0 0 0 5 5\ncpu0 1").unwrap();
        let after = ticks("cpu  40 0 10 130 20 0 0 0 5 5\ncpu0 1").unwrap();

        assert_eq!(before, Ticks { idle: 80, all: 100 });
        assert!((after.busy_since(before) - 0.3).abs() < 1e-6);
        assert_eq!(after.busy_since(after), 0.0);
    }

    #[test]
    fn this_machine_can_be_read_and_nonsense_cannot() {
        let here = read("/proc/meminfo", memory).unwrap();

        assert!(here.available > 0 && here.available <= here.total);
        assert!(read("/proc/loadavg", |text| load(text, 0.0)).is_ok());
        assert!(read("/proc/net/dev", network).is_ok());
        assert_eq!(memory("MemTotal: much"), None);
        assert_eq!(ticks("cpu  1 2"), None);
    }
}
