//! The paths to other hosts: the addresses of each, how well they answer, and which one is in use.
//!
//! The address of a host is where it was last heard, authentically. A host with several has each of them probed, and the
//! best is used: the one with the shortest round trip for its loss, with some reluctance to change; at once another that
//! answers, when the one in use does not. A host with one address costs no probe.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::time::Duration;

use ddx_wire::message::{CONTROL_ADDRS_MAX, Message};
use ddx_wire::{Tag, Time};

use crate::outbox::Outbox;

/// Pause between two probes of each path to a host that reads here, or is read. What dies right after a probe was answered
/// is noticed half a second later, and confirmed by two unanswered questions: well within a second.
const ROUND: Duration = Duration::from_millis(500);
/// Of the hosts that exchange no samples, one in turn is probed each so many rounds, whatever their number.
const ROUNDS_PER_IDLE: u64 = 2;
/// A host that exchanges no samples is not probed more often than this.
const IDLE_PAUSE: Duration = Duration::from_secs(5);
/// A path that does not answer is probed each so many rounds only.
const ROUNDS_PER_SILENT: u64 = 10;
/// So many unanswered probes in a row, and a path in use is left for one that answers.
const LOST: u32 = 2;
/// So many, and a path is silent: if its host does not name it either, it is forgotten.
const SILENT: u32 = 4;
/// Least time to wait for an answer; else twice the round trip and some.
const PATIENCE_LEAST: Duration = Duration::from_millis(100);
const PATIENCE_SLACK: Duration = Duration::from_millis(50);
/// Most, and for a path without a measurement.
const PATIENCE_MOST: Duration = Duration::from_secs(1);
/// Answers that a path must have given before it is preferred for being better.
const TRUSTED_ANSWERS: u32 = 4;
/// Time between two changes for the better.
const SETTLED: Duration = Duration::from_secs(3);
/// Added to each round trip: what lies far below it makes no difference to samples.
const NOISE: Duration = Duration::from_millis(1);
/// Whole of a loss; it is averaged over some sixteen probes.
const LOSS_WHOLE: u32 = 1_024;
const LOSS_WEIGHT: u32 = 16;
/// Probes whose time is not up, of 150 B each with their place in two tables: 2.4 MiB. As many as there are paths.
const PROBES_MAX: usize = 16_384;
/// Hosts that are probed in one go when this host's own addresses change.
const REFRESH_MAX: usize = 256;

/// How one address of a host answers, for listings.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PathStatus {
    /// Its control address.
    pub addr: SocketAddr,
    /// Whether this host sends to it now.
    pub used: bool,
    /// Smoothed round trip; `None` until a probe was answered. The only address of a host is not probed.
    pub rtt: Option<Duration>,
    /// Share of the recent probes that were not answered, in thousandths.
    pub loss_permille: u16,
}

/// The paths to all hosts with a session.
#[derive(Default)]
pub(crate) struct Paths {
    peers: BTreeMap<Tag, Peer>,
    /// Those with more than one path.
    many: BTreeSet<Tag>,
    waiting: BTreeMap<u64, Waiting>,
    deadlines: BTreeSet<(Time, u64)>,
    last_nonce: u64,
    next_round: Option<Time>,
    rounds: u64,
    /// The idle host that was probed last: they take turns.
    turn: Option<Tag>,
    moved: VecDeque<Tag>,
    /// Probes that were not sent because so many wait for their answers.
    pub(crate) dropped: u64,
}

struct Peer {
    /// Never empty.
    paths: Vec<Path>,
    used: SocketAddr,
    /// Number of the announcement that was last taken in.
    revision: u64,
    changed: Time,
    probed: Time,
    heard: Time,
}

struct Path {
    addr: SocketAddr,
    /// Whether its host names it.
    announced: bool,
    heard: Time,
    rtt: Option<Duration>,
    loss: u32,
    answers: u32,
    /// Probes in a row that were not answered, and when the first of them was sent.
    missed: u32,
    missed_since: Time,
    /// When the last probe that was answered was sent.
    answered: Time,
    /// The probe that waits for its answer.
    asked: Option<u64>,
    /// The last one whose time was up, and when it was sent: a late answer still tells how late.
    late: Option<(u64, Time)>,
}

struct Waiting {
    tag: Tag,
    addr: SocketAddr,
    sent: Time,
}

impl Paths {
    /// Begins with a host that proved itself from `addr` and names these addresses.
    pub(crate) fn met(
        &mut self,
        tag: Tag,
        addr: SocketAddr,
        named: &[SocketAddr],
        now: Time,
        out: &mut Outbox,
    ) {
        self.forget(tag);
        let mut peer = Peer {
            paths: vec![Path::new(addr, now)],
            used: addr,
            revision: 0,
            changed: now,
            probed: now,
            heard: now,
        };
        peer.name(addr, named, now);
        self.peers.insert(tag, peer);
        self.regroup(tag, now, out);
    }

    /// Ends with a life of a host.
    pub(crate) fn forget(&mut self, tag: Tag) {
        self.peers.remove(&tag);
        self.many.remove(&tag);
    }

    /// Notes that something authentic and fresh came from an address of a host.
    pub(crate) fn heard(&mut self, tag: Tag, from: SocketAddr, now: Time, out: &mut Outbox) {
        let Some(peer) = self.peers.get_mut(&tag) else {
            return;
        };
        peer.heard = now;
        let fresh = match peer.paths.iter_mut().find(|path| path.addr == from) {
            Some(path) => {
                path.heard = now;
                false
            }
            None => {
                peer.add(Path::new(from, now));
                true
            }
        };
        // Without a measurement, where it was last heard is all that is known.
        if from != peer.used && peer.path(peer.used).is_none_or(|used| used.rtt.is_none()) {
            self.switch(tag, from, now);
        }
        if fresh {
            self.regroup(tag, now, out);
        }
    }

    /// Takes in what a host says of its addresses, which came from one of them.
    pub(crate) fn announced(
        &mut self,
        tag: Tag,
        from: SocketAddr,
        (revision, named): (u64, &[SocketAddr]),
        now: Time,
        out: &mut Outbox,
    ) {
        let Some(peer) = self.peers.get_mut(&tag) else {
            return;
        };
        if revision <= peer.revision {
            return;
        }
        peer.revision = revision;
        peer.name(from, named, now);
        if peer.path(peer.used).is_none() {
            self.switch(tag, from, now);
        }
        self.regroup(tag, now, out);
    }

    /// Takes in an answer to a probe.
    pub(crate) fn answered(&mut self, tag: Tag, nonce: u64, now: Time) {
        let Some(peer) = self.peers.get_mut(&tag) else {
            return;
        };
        let late = |path: &Path| path.late.is_some_and(|(late, _)| late == nonce);
        let asked = |path: &&mut Path| path.asked == Some(nonce) || late(path);
        let Some(path) = peer.paths.iter_mut().find(asked) else {
            return;
        };
        let sent = match self.waiting.remove(&nonce) {
            Some(probe) => {
                path.asked = None;
                path.loss -= path.loss / LOSS_WEIGHT;
                Some(probe.sent)
            }
            None => path.late.take().map(|(_, sent)| sent),
        };
        if let Some(sent) = sent {
            let rtt = now.since(sent);
            path.rtt = Some(path.rtt.map_or(rtt, |smooth| (smooth * 7 + rtt) / 8));
            path.answers = path.answers.saturating_add(1);
            path.answered = path.answered.max(sent);
            path.missed = 0;
        }
        self.choose(tag, now);
    }

    /// Asks at once whether the paths to a host answer, if there are several.
    pub(crate) fn ask(&mut self, tag: Tag, now: Time, out: &mut Outbox) {
        if self.many.contains(&tag) {
            self.probe(tag, now, out, |_path| true);
        }
    }

    /// Asks on all paths, because this host's own addresses changed.
    pub(crate) fn refresh(&mut self, now: Time, out: &mut Outbox) {
        let all: Vec<Tag> = self.many.iter().take(REFRESH_MAX).copied().collect();
        for tag in all {
            self.probe(tag, now, out, |_path| true);
        }
    }

    pub(crate) fn poll_timeout(&self) -> Option<Time> {
        let deadline = self.deadlines.first().map(|(at, _)| *at);
        [self.next_round, deadline].into_iter().flatten().min()
    }

    /// Counts what was not answered and asks anew. `busy` says whether samples go to a host or come from it.
    pub(crate) fn handle_timeout(
        &mut self,
        now: Time,
        busy: impl Fn(Tag) -> bool,
        out: &mut Outbox,
    ) {
        while let Some((_, nonce)) = self.deadlines.first().copied().filter(|(at, _)| *at <= now) {
            self.deadlines.pop_first();
            self.missed(nonce, now, out);
        }
        if self.next_round.is_none_or(|at| at > now) {
            return;
        }
        self.next_round = (!self.many.is_empty()).then(|| now + ROUND);
        self.rounds += 1;
        let (busy, idle): (Vec<Tag>, Vec<Tag>) = self.many.iter().partition(|tag| busy(**tag));
        let all = self.rounds.is_multiple_of(ROUNDS_PER_SILENT);
        for tag in busy {
            self.probe(tag, now, out, |path| all || path.missed < SILENT);
        }
        if self.rounds.is_multiple_of(ROUNDS_PER_IDLE) {
            let after = idle.iter().find(|tag| Some(**tag) > self.turn);
            let Some(tag) = after.or(idle.first()).copied() else {
                return;
            };
            self.turn = Some(tag);
            let rested = |peer: &Peer| now.since(peer.probed) >= IDLE_PAUSE;
            if self.peers.get(&tag).is_some_and(rested) {
                self.probe(tag, now, out, |_path| true);
            }
        }
    }

    /// A host whose address in use is another now.
    pub(crate) fn poll_moved(&mut self) -> Option<Tag> {
        self.moved.pop_front()
    }

    /// The address in use.
    pub(crate) fn addr(&self, tag: Tag) -> Option<SocketAddr> {
        self.peers.get(&tag).map(|peer| peer.used)
    }

    /// All addresses of a host.
    pub(crate) fn addrs(&self, tag: Tag) -> impl Iterator<Item = SocketAddr> {
        let peer = self.peers.get(&tag);
        peer.into_iter()
            .flat_map(|peer| peer.paths.iter().map(|path| path.addr))
    }

    /// Whether an address is one of some host.
    pub(crate) fn knows(&self, addr: SocketAddr) -> bool {
        self.peers.values().any(|peer| peer.path(addr).is_some())
    }

    /// Whether a host that has a session may have moved to this address: it is not one of its own, and there is room for
    /// it, or nothing came from the others for a while.
    pub(crate) fn is_strange(&self, tag: Tag, addr: SocketAddr, now: Time) -> bool {
        self.peers.get(&tag).is_some_and(|peer| {
            let room = peer.paths.len() < CONTROL_ADDRS_MAX;
            peer.path(addr).is_none() && (room || now.since(peer.heard) >= PATIENCE_MOST)
        })
    }

    /// For listings.
    pub(crate) fn status(&self, tag: Tag) -> Vec<PathStatus> {
        let Some(peer) = self.peers.get(&tag) else {
            return Vec::new();
        };
        let status = |path: &Path| PathStatus {
            addr: path.addr,
            used: path.addr == peer.used,
            rtt: path.rtt,
            loss_permille: u16::try_from(path.loss * 1_000 / LOSS_WHOLE).unwrap_or(1_000),
        };
        peer.paths.iter().map(status).collect()
    }

    /// Begins or ends to probe a host whose set of paths changed.
    fn regroup(&mut self, tag: Tag, now: Time, out: &mut Outbox) {
        if self
            .peers
            .get(&tag)
            .is_some_and(|peer| peer.paths.len() > 1)
        {
            self.many.insert(tag);
            self.next_round.get_or_insert(now + ROUND);
            self.probe(tag, now, out, |_path| true);
        } else {
            self.many.remove(&tag);
        }
    }

    fn probe(&mut self, tag: Tag, now: Time, out: &mut Outbox, which: impl Fn(&Path) -> bool) {
        let Some(peer) = self.peers.get_mut(&tag) else {
            return;
        };
        peer.probed = now;
        for path in peer.paths.iter_mut().filter(|path| which(path)) {
            if path.asked.is_some() {
                continue;
            }
            if self.deadlines.len() >= PROBES_MAX {
                self.dropped = self.dropped.saturating_add(1);
                continue;
            }
            self.last_nonce += 1;
            let nonce = self.last_nonce;
            path.asked = Some(nonce);
            let probe = Waiting {
                tag,
                addr: path.addr,
                sent: now,
            };
            self.waiting.insert(nonce, probe);
            self.deadlines.insert((now + path.patience(), nonce));
            out.send_by(tag, path.addr, &Message::Probe { nonce });
        }
    }

    /// Counts a probe that was not answered in time; on the path in use, asks again at once, everywhere.
    fn missed(&mut self, nonce: u64, now: Time, out: &mut Outbox) {
        let Some(Waiting { tag, addr, sent }) = self.waiting.remove(&nonce) else {
            return;
        };
        let Some(peer) = self.peers.get_mut(&tag) else {
            return;
        };
        let used = peer.used == addr;
        let mut paths = peer.paths.iter_mut();
        let Some(path) = paths.find(|path| path.asked == Some(nonce)) else {
            return;
        };
        if path.missed == 0 {
            path.missed_since = sent;
        }
        path.asked = None;
        path.late = Some((nonce, sent));
        path.missed = path.missed.saturating_add(1);
        path.loss += (LOSS_WHOLE - path.loss).div_ceil(LOSS_WEIGHT);
        let silent = path.missed >= SILENT;
        if silent && !used && !path.announced {
            peer.paths.retain(|path| path.addr != addr);
            if peer.paths.len() == 1 {
                self.many.remove(&tag);
            }
            return;
        }
        self.choose(tag, now);
        if used && !silent {
            self.probe(tag, now, out, |_path| true);
        }
    }

    /// Changes to a better path, if there is one.
    fn choose(&mut self, tag: Tag, now: Time) {
        let Some(peer) = self.peers.get(&tag) else {
            return;
        };
        let Some(used) = peer.path(peer.used) else {
            return;
        };
        let others = peer.paths.iter().filter(|path| path.addr != peer.used);
        let alive = others.filter(|path| path.missed == 0);
        let to = if used.missed >= LOST {
            alive
                .filter(|path| path.rtt.is_some() && path.answered >= used.missed_since)
                .min_by_key(|path| path.cost())
        } else if used.rtt.is_some() && now.since(peer.changed) >= SETTLED {
            alive
                .filter(|path| path.answers >= TRUSTED_ANSWERS)
                .min_by_key(|path| path.cost())
                // Better by a fifth.
                .filter(|path| path.cost() + path.cost() / 5 < used.cost())
        } else {
            None
        };
        if let Some(addr) = to.map(|path| path.addr) {
            self.switch(tag, addr, now);
        }
    }

    fn switch(&mut self, tag: Tag, to: SocketAddr, now: Time) {
        if let Some(peer) = self.peers.get_mut(&tag) {
            tracing::debug!(peer = tag.0, from = %peer.used, %to, "another path");
            peer.used = to;
            peer.changed = now;
            self.moved.push_back(tag);
        }
    }
}

impl Peer {
    fn path(&self, addr: SocketAddr) -> Option<&Path> {
        self.paths.iter().find(|path| path.addr == addr)
    }

    /// Keeps what the host names, as far as that can be its address, and the address from which it said so.
    fn name(&mut self, from: SocketAddr, named: &[SocketAddr], now: Time) {
        for path in &mut self.paths {
            path.announced = named.contains(&path.addr);
        }
        self.paths
            .retain(|path| path.announced || path.addr == from);
        for addr in named.iter().take(CONTROL_ADDRS_MAX) {
            if self.paths.len() < CONTROL_ADDRS_MAX
                && self.path(*addr).is_none()
                && is_usable(*addr, from)
            {
                self.paths.push(Path {
                    announced: true,
                    ..Path::new(*addr, now)
                });
            }
        }
    }

    /// Adds a path, in place of the one that was heard longest ago if there are too many.
    fn add(&mut self, path: Path) {
        if self.paths.len() >= CONTROL_ADDRS_MAX {
            let used = self.used;
            let spare = self.paths.iter().enumerate();
            let spare = spare.filter(|(_, path)| path.addr != used);
            let spare = spare.min_by_key(|(_, path)| (path.announced, path.heard));
            if let Some(index) = spare.map(|(index, _)| index) {
                self.paths.remove(index);
            }
        }
        self.paths.push(path);
    }
}

impl Path {
    fn new(addr: SocketAddr, now: Time) -> Self {
        Self {
            addr,
            announced: false,
            heard: now,
            rtt: None,
            loss: 0,
            answers: 0,
            missed: 0,
            missed_since: now,
            answered: Time(0),
            asked: None,
            late: None,
        }
    }

    fn patience(&self) -> Duration {
        self.rtt.map_or(PATIENCE_MOST, |rtt| {
            (rtt * 2 + PATIENCE_SLACK).clamp(PATIENCE_LEAST, PATIENCE_MOST)
        })
    }

    /// What a sample costs on it: the round trip, for each that arrives with its answer.
    fn cost(&self) -> u64 {
        let rtt = self.rtt.unwrap_or(PATIENCE_MOST) + NOISE;
        let rtt = u64::try_from(rtt.as_micros()).unwrap_or(u64::MAX);
        let (whole, loss) = (u64::from(LOSS_WHOLE), u64::from(self.loss));
        rtt.saturating_mul(whole) / (whole + 1).saturating_sub(loss).max(1)
    }
}

/// Whether a host that speaks from `from` can be reached at an address that it names.
fn is_usable(addr: SocketAddr, from: SocketAddr) -> bool {
    let ip = addr.ip();
    let nobody = ip.is_unspecified()
        || ip.is_multicast()
        || ip == IpAddr::V4(Ipv4Addr::BROADCAST)
        || addr.port() == 0;
    !nobody && (!ip.is_loopback() || from.ip().is_loopback())
}

#[cfg(test)]
mod tests {
    use ddx_wire::codec;
    use ddx_wire::seal::HEADER_BYTES;

    use super::*;
    use crate::outbox::Target;

    const TAG: Tag = Tag(1);
    const STEP: Duration = Duration::from_millis(1);

    /// Answers the probes of one host by a table of round trips, milliseconds; a path that is not in it is silent.
    struct Rig {
        paths: Paths,
        out: Outbox,
        now: Time,
        rtt_ms: BTreeMap<SocketAddr, u64>,
        answers: Vec<(Time, u64)>,
        probes: usize,
    }

    impl Rig {
        fn new(named: &[SocketAddr], rtt_ms: &[(SocketAddr, u64)]) -> Self {
            let mut rig = Self {
                paths: Paths::default(),
                out: Outbox::default(),
                now: Time(1_000_000_000),
                rtt_ms: rtt_ms.iter().copied().collect(),
                answers: Vec::new(),
                probes: 0,
            };
            rig.paths.met(TAG, addr(1), named, rig.now, &mut rig.out);
            rig
        }

        fn run(&mut self, span: Duration, busy: bool) {
            let end = self.now + span;
            while self.now < end {
                while let Some(outgoing) = self.out.pop() {
                    let Target::Path(TAG, to) = outgoing.target else {
                        panic!("{:?}", outgoing.target);
                    };
                    let bytes = &outgoing.bytes[HEADER_BYTES..];
                    let Message::Probe { nonce } = codec::decode(bytes).unwrap() else {
                        panic!("{bytes:?}");
                    };
                    self.probes += 1;
                    if let Some(rtt) = self.rtt_ms.get(&to) {
                        let at = self.now + Duration::from_millis(*rtt);
                        self.answers.push((at, nonce));
                    }
                }
                let due = self.answers.iter().filter(|(at, _)| *at <= self.now);
                let due: Vec<u64> = due.map(|(_, nonce)| *nonce).collect();
                self.answers.retain(|(at, _)| *at > self.now);
                for nonce in due {
                    self.paths.answered(TAG, nonce, self.now);
                }
                if self.paths.poll_timeout().is_some_and(|at| at <= self.now) {
                    self.paths.handle_timeout(self.now, |_| busy, &mut self.out);
                }
                self.now = self.now + STEP;
            }
        }

        fn used(&self) -> SocketAddr {
            self.paths.addr(TAG).unwrap()
        }

        fn addrs(&self) -> Vec<SocketAddr> {
            self.paths.addrs(TAG).collect()
        }
    }

    fn addr(last: u8) -> SocketAddr {
        SocketAddr::from(([10, 0, 0, last], 7))
    }

    fn secs(s: u64) -> Duration {
        Duration::from_secs(s)
    }

    #[test]
    fn the_only_address_of_a_host_is_not_probed() {
        let mut rig = Rig::new(&[addr(1)], &[(addr(1), 1)]);
        rig.paths.ask(TAG, rig.now, &mut rig.out);
        rig.paths.refresh(rig.now, &mut rig.out);
        assert_eq!(rig.paths.poll_timeout(), None);
        rig.run(secs(10), true);
        assert_eq!(rig.probes, 0);
    }

    #[test]
    fn the_better_path_is_used_and_one_that_is_hardly_better_is_not() {
        for (rtt, used) in [(8, 1), (2, 2)] {
            let mut rig = Rig::new(&[addr(1), addr(2)], &[(addr(1), 9), (addr(2), rtt)]);
            rig.run(secs(8), true);
            assert_eq!(rig.used(), addr(used), "9 ms against {rtt} ms");
            let status = rig.paths.status(TAG);
            let other = status.iter().find(|path| path.addr == addr(2)).unwrap();
            let measured = other.rtt.unwrap().as_millis();
            assert!(measured.abs_diff(u128::from(rtt)) <= 1, "{measured} ms");
            assert_eq!(other.loss_permille, 0);
        }
    }

    #[test]
    fn a_path_that_falls_silent_is_left_within_a_second_and_one_that_heals_is_found_again() {
        for phase_ms in (0..500).step_by(50) {
            let mut rig = Rig::new(&[addr(1), addr(2)], &[(addr(1), 1), (addr(2), 20)]);
            rig.run(secs(5) + Duration::from_millis(phase_ms), true);
            assert_eq!(rig.used(), addr(1));
            rig.rtt_ms.remove(&addr(1));
            rig.run(Duration::from_millis(750), true);
            assert_eq!(rig.used(), addr(2), "phase {phase_ms} ms");
            assert_eq!(rig.paths.poll_moved(), Some(TAG));
            rig.run(secs(10), true);
            rig.rtt_ms.insert(addr(1), 1);
            // Its loss is forgotten slowly.
            rig.run(secs(30), true);
            assert_eq!(rig.used(), addr(1), "phase {phase_ms} ms");
        }
    }

    #[test]
    fn nothing_changes_while_no_path_answers() {
        let mut rig = Rig::new(&[addr(1), addr(2)], &[(addr(1), 1), (addr(2), 1)]);
        rig.run(secs(2), true);
        rig.rtt_ms.clear();
        let used = rig.used();
        rig.probes = 0;
        rig.run(secs(60), true);
        assert_eq!(rig.used(), used);
        assert!(rig.probes <= 2 * (60 / 5 + 6), "{} probes", rig.probes);
        rig.rtt_ms.insert(addr(2), 1);
        rig.run(secs(6), true);
        assert_eq!(rig.used(), addr(2));
    }

    #[test]
    fn a_host_that_exchanges_no_samples_is_probed_rarely() {
        let mut rig = Rig::new(&[addr(1), addr(2)], &[(addr(1), 1), (addr(2), 1)]);
        rig.run(secs(60), false);
        assert!((20..=26).contains(&rig.probes), "{} probes", rig.probes);
    }

    #[test]
    fn a_host_is_followed_to_where_it_was_last_heard() {
        let mut rig = Rig::new(&[addr(1)], &[(addr(2), 1)]);
        rig.paths.heard(TAG, addr(2), rig.now, &mut rig.out);
        assert_eq!(rig.used(), addr(2));
        // The address that it had is forgotten once it says so.
        rig.run(secs(1), true);
        let news = (1, &[addr(2)][..]);
        rig.paths
            .announced(TAG, addr(2), news, rig.now, &mut rig.out);
        assert_eq!(rig.addrs(), [addr(2)]);
        rig.probes = 0;
        rig.run(secs(5), true);
        assert_eq!(rig.probes, 0);
    }

    #[test]
    fn an_address_that_its_host_does_not_name_is_forgotten_when_it_falls_silent() {
        let mut rig = Rig::new(&[addr(1)], &[(addr(1), 1), (addr(9), 1)]);
        rig.run(secs(1), true);
        rig.paths.heard(TAG, addr(9), rig.now, &mut rig.out);
        rig.paths.heard(TAG, addr(1), rig.now, &mut rig.out);
        rig.run(secs(2), true);
        assert_eq!(rig.addrs().len(), 2);
        rig.rtt_ms.remove(&addr(9));
        rig.run(secs(10), true);
        assert_eq!((rig.addrs(), rig.used()), (vec![addr(1)], addr(1)));
    }

    #[test]
    fn named_addresses_are_few_possible_and_the_newest() {
        let named = [
            "0.0.0.0:7",
            "239.1.1.1:7",
            "127.0.0.1:7",
            "10.0.0.2:0",
            "10.0.0.2:7",
        ];
        let named = named.map(|text| text.parse().unwrap());
        let mut rig = Rig::new(&named[..4], &[]);
        assert_eq!(rig.addrs(), [addr(1)]);
        for (revision, named) in [(2, addr(2)), (1, addr(3))] {
            let news = (revision, &[named][..]);
            rig.paths
                .announced(TAG, addr(1), news, rig.now, &mut rig.out);
        }
        assert_eq!(rig.addrs(), [addr(1), addr(2)], "older news is no news");
        for last in 3..30 {
            rig.paths.heard(TAG, addr(last), rig.now, &mut rig.out);
        }
        assert_eq!(rig.addrs().len(), CONTROL_ADDRS_MAX);
        assert!(rig.addrs().contains(&rig.used()));
    }

    #[test]
    fn a_host_that_speaks_from_ever_more_addresses_is_probed_up_to_a_limit() {
        let mut rig = Rig::new(&[addr(1)], &[]);
        let flood = u16::try_from(PROBES_MAX + 1_000).unwrap();
        for port in 0..flood {
            let from = SocketAddr::from(([10, 0, 0, 9], 100 + port));
            rig.paths.heard(TAG, from, rig.now, &mut rig.out);
        }
        assert_eq!(rig.paths.deadlines.len(), PROBES_MAX);
        assert!(rig.paths.dropped >= 1_000, "{}", rig.paths.dropped);
        // They make room when their time is up.
        let later = rig.now + PATIENCE_MOST;
        rig.paths.handle_timeout(later, |_| false, &mut rig.out);
        assert!(rig.paths.deadlines.len() < 10);
    }

    #[test]
    fn an_answer_counts_once_only_from_its_host_and_also_late() {
        let mut rig = Rig::new(&[addr(1), addr(2)], &[(addr(1), 1), (addr(2), 1_500)]);
        rig.paths.answered(Tag(2), 1, rig.now);
        rig.paths.answered(TAG, 77, rig.now);
        assert!(rig.paths.status(TAG).iter().all(|path| path.rtt.is_none()));
        rig.run(secs(2), false);
        let late = rig.paths.status(TAG)[1];
        assert_eq!(late.rtt.unwrap().as_millis(), 1_500);
        assert!(late.loss_permille > 0);
    }
}
