//! The programs of a random scenario: what writes on which host, through restarts of their hosts.

use std::time::Duration;

use ddx_rig::sim::{Random, Sim};
use ddx_wire::ItemName;

/// One item, who writes it and how.
pub(crate) struct Source {
    pub(crate) host: usize,
    pub(crate) rest: String,
    pub(crate) name: ItemName,
    pub(crate) period: Duration,
    /// Lengths that its samples have, bytes.
    pub(crate) lens: Vec<usize>,
    pub(crate) next: Duration,
}

pub(crate) struct Fleet {
    pub(crate) sim: Sim,
    pub(crate) sources: Vec<Source>,
    pub(crate) on: Vec<bool>,
    /// The lives that each host has had.
    ordinals: Vec<u32>,
}

impl Fleet {
    pub(crate) fn new(sim: Sim, hosts: usize) -> Self {
        Self {
            sim,
            sources: Vec::new(),
            on: vec![true; hosts],
            ordinals: vec![1; hosts],
        }
    }

    /// Lets time pass until some source has its next sample to write, which is returned, or until `end`.
    pub(crate) fn next_write(&mut self, end: Duration) -> Option<usize> {
        let now = self.sim.now();
        let all = self.sources.iter_mut().enumerate();
        let next = all.min_by_key(|(_, source)| source.next);
        let Some((index, source)) = next.filter(|(_, source)| source.next < end) else {
            self.sim.run_for(end.saturating_sub(now));
            return None;
        };
        self.sim.run_for(source.next.saturating_sub(now));
        source.next = source.next.max(now) + source.period;
        Some(index)
    }

    pub(crate) fn kill(&mut self, host: usize) {
        self.on[host] = false;
        self.sim.kill(host);
    }

    /// Ends a life of a host, if it has one, and begins the next: its programs come back with it.
    pub(crate) fn restart(&mut self, host: usize) {
        self.on[host] = true;
        self.ordinals[host] += 1;
        self.sim.start(host, self.ordinals[host]);
        for source in self.sources.iter().filter(|source| source.host == host) {
            self.sim.announce(host, &source.rest);
        }
    }

    /// Another writer takes the place of a source's, if its host is on.
    pub(crate) fn replace_writer(&mut self, source: usize) {
        let Source { host, rest, .. } = &self.sources[source];
        if self.on[*host] {
            self.sim.announce(*host, rest);
        }
    }

    /// Cuts the hosts into two sides.
    pub(crate) fn cut(&mut self, random: &mut Random) {
        let sides: Vec<usize> = self.on.iter().map(|_| random.index(2)).collect();
        self.sim.cut(|host| sides[host]);
    }

    /// Heals all cuts, and starts the hosts that are off.
    pub(crate) fn repair(&mut self) {
        self.sim.heal();
        for host in 0..self.on.len() {
            if !self.on[host] {
                self.restart(host);
            }
        }
    }
}
