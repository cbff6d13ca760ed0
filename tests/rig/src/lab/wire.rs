//! The wire of a lab: what joins a host to the switch when its link is emulated.
//!
//! One thread carries the frames of all such hosts between packet sockets on two devices each, through a
//! [`Link`] up and a [`Link`] down. It belongs to the test process and ends with the lab.

use std::collections::BTreeSet;
use std::num::NonZeroU64;
use std::os::fd::{AsFd, OwnedFd};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use rustix::event::{EventfdFlags, PollFd, PollFlags, Timespec, eventfd, poll};

use super::error::Error;
use super::frame::Frame;
use super::packet::PacketSocket;
use super::switch::Traffic;
use crate::link::{Books, Config, Link, Profile};

/// The thread and what it shares; dropped, it carries nothing any more.
#[derive(Debug)]
pub(super) struct Wire {
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
}

/// The two devices of one host's wire.
#[derive(Debug)]
pub(super) struct Ends {
    /// On the device that faces the host.
    pub(super) host: PacketSocket,
    /// On the device that faces the switch.
    pub(super) switch: PacketSocket,
}

#[derive(Debug)]
struct Shared {
    state: Mutex<State>,
    /// Wakes the thread when hosts or links have changed.
    bell: OwnedFd,
    start: Instant,
}

#[derive(Debug, Default)]
struct State {
    joints: Vec<Joint>,
    labels: Vec<BTreeSet<u16>>,
    is_over: bool,
}

/// One host's wire.
#[derive(Debug)]
struct Joint {
    host: usize,
    ends: Arc<Ends>,
    up: Link<Vec<u8>>,
    down: Link<Vec<u8>>,
    /// Everything, then by label.
    traffic: Vec<Traffic>,
    overruns: u64,
}

impl Wire {
    /// Starts the thread.
    pub(super) fn start() -> Result<Self, Error> {
        let bell = eventfd(0, EventfdFlags::CLOEXEC | EventfdFlags::NONBLOCK)
            .map_err(|refused| Error::io("make the wire's bell")(refused.into()))?;
        let shared = Arc::new(Shared {
            state: Mutex::new(State::default()),
            bell,
            start: Instant::now(),
        });
        let of_thread = Arc::clone(&shared);
        let thread = thread::Builder::new()
            .name("lab-wire".to_owned())
            .spawn(move || carry(&of_thread))
            .map_err(Error::io("start the wire"))?;
        Ok(Self {
            shared,
            thread: Some(thread),
        })
    }

    pub(super) fn has(&self, host: usize) -> bool {
        self.state().joints.iter().any(|joint| joint.host == host)
    }

    /// Carries a host's frames from now on, at first without any change.
    pub(super) fn join(&self, host: usize, ends: Ends) {
        let mut state = self.state();
        let traffic = vec![Traffic::default(); 1 + state.labels.len()];
        state.joints.push(Joint {
            host,
            ends: Arc::new(ends),
            up: Link::new(Config::default(), 0),
            down: Link::new(Config::default(), 0),
            traffic,
            overruns: 0,
        });
        drop(state);
        self.ring();
    }

    /// Gives a host's wire a profile, or takes it away.
    pub(super) fn set(&self, host: usize, profile: Option<&Profile>) {
        let (up, down) =
            profile.map_or_else(Default::default, |profile| (profile.up, profile.down));
        let seeds = profile.map_or((0, 0), |profile| profile.seeds(host));
        let mut state = self.state();
        for joint in state.joints.iter_mut().filter(|joint| joint.host == host) {
            joint.up.line_mut().restart(up, seeds.0);
            joint.down.line_mut().restart(down, seeds.1);
        }
        drop(state);
        self.ring();
    }

    /// Counts datagrams of these ports under the label with this index; labels are added in order.
    pub(super) fn watch(&self, label: usize, ports: &[u16]) {
        let mut state = self.state();
        while state.labels.len() <= label {
            state.labels.push(BTreeSet::new());
            for joint in &mut state.joints {
                joint.traffic.push(Traffic::default());
            }
        }
        state.labels[label].extend(ports);
    }

    /// Returns what passed each host's wire: everything, then by label.
    pub(super) fn traffic(&self) -> Vec<(usize, Vec<Traffic>)> {
        let state = self.state();
        let all = state.joints.iter();
        all.map(|joint| (joint.host, joint.traffic.clone()))
            .collect()
    }

    /// Returns what became of a host's frames, and how many frames the wire was too slow for.
    pub(super) fn books(&self, host: usize) -> Option<(Books, u64)> {
        let mut state = self.state();
        let joint = state.joints.iter_mut().find(|joint| joint.host == host)?;
        joint.overruns += joint.ends.host.overruns() + joint.ends.switch.overruns();
        let books = Books {
            up: joint.up.line().counters(),
            down: joint.down.line().counters(),
        };
        Some((books, joint.overruns))
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.shared.state()
    }

    fn ring(&self) {
        // The only refusal is that it rings already.
        let _rings = rustix::io::write(&self.shared.bell, &1_u64.to_ne_bytes());
    }
}

impl Drop for Wire {
    fn drop(&mut self) {
        self.state().is_over = true;
        self.ring();
        if let Some(thread) = self.thread.take() {
            // A panic of the thread has said so itself.
            let _ended = thread.join();
        }
    }
}

impl Shared {
    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn now(&self) -> Duration {
        self.start.elapsed()
    }
}

/// The thread: sleeps until a frame comes or is due.
fn carry(shared: &Shared) {
    // By default the kernel may wake a sleeper 50 us late.
    let _coarser = rustix::thread::set_current_timer_slack(NonZeroU64::new(1));
    // Programs under test that fill the cores should not make their own link slow. A plain user may not ask.
    let _equal = rustix::process::setpriority_process(None, -20);
    let mut buffer = vec![0; BUFFER_BYTES];
    let mut all_ends: Vec<Arc<Ends>> = Vec::new();
    let mut wait = None;
    loop {
        wait_for_frames(shared, &all_ends, wait);
        let mut state = shared.state();
        if state.is_over {
            return;
        }
        if all_ends.len() != state.joints.len() {
            all_ends = state.joints.iter().map(|j| Arc::clone(&j.ends)).collect();
        }
        let State { joints, labels, .. } = &mut *state;
        let mut next: Option<Duration> = None;
        for joint in joints {
            joint.receive(labels, &mut buffer, shared);
            joint.deliver(labels, shared.now());
            next = next.into_iter().chain(joint.next()).min();
        }
        wait = next.map(|at| at.saturating_sub(shared.now()));
    }
}

fn wait_for_frames(shared: &Shared, all_ends: &[Arc<Ends>], wait: Option<Duration>) {
    let timeout = wait.and_then(|wait| Timespec::try_from(wait).ok());
    let mut polled = vec![PollFd::new(&shared.bell, PollFlags::IN)];
    for ends in all_ends {
        polled.push(PollFd::from_borrowed_fd(ends.host.as_fd(), PollFlags::IN));
        polled.push(PollFd::from_borrowed_fd(ends.switch.as_fd(), PollFlags::IN));
    }
    // A signal only makes the round early.
    let _early = poll(&mut polled, timeout.as_ref());
    let _silent = rustix::io::read(&shared.bell, &mut [0; 8]);
}

impl Joint {
    fn receive(&mut self, labels: &[BTreeSet<u16>], buffer: &mut [u8], shared: &Shared) {
        for _ in 0..BATCH {
            let Some(bytes) = self.ends.host.receive(buffer) else {
                break;
            };
            let frame = Frame(bytes);
            for (traffic, counts) in self.traffic.iter_mut().zip(frame.counts_in(labels)) {
                if counts {
                    traffic.from.add(frame.packet_bytes());
                }
            }
            self.up.push(
                bytes.to_vec(),
                frame.packet_bytes(),
                frame.class(),
                shared.now(),
            );
        }
        for _ in 0..BATCH {
            let Some(bytes) = self.ends.switch.receive(buffer) else {
                break;
            };
            let frame = Frame(bytes);
            self.down.push(
                bytes.to_vec(),
                frame.packet_bytes(),
                frame.class(),
                shared.now(),
            );
        }
    }

    fn deliver(&mut self, labels: &[BTreeSet<u16>], now: Duration) {
        while let Some(bytes) = self.up.pop(now) {
            self.overruns += u64::from(!self.ends.switch.send(&bytes));
        }
        while let Some(bytes) = self.down.pop(now) {
            if !self.ends.host.send(&bytes) {
                self.overruns += 1;
                continue;
            }
            // Counted last: what is counted is there.
            let frame = Frame(&bytes);
            for (traffic, counts) in self.traffic.iter_mut().zip(frame.counts_in(labels)) {
                if counts {
                    traffic.to.add(frame.packet_bytes());
                }
            }
        }
    }

    /// When the next frame is due.
    fn next(&self) -> Option<Duration> {
        let both = self.up.poll_timeout().into_iter();
        both.chain(self.down.poll_timeout()).min()
    }
}

/// The largest IP packet with its Ethernet header.
const BUFFER_BYTES: usize = 65_536 + 14;

/// Frames that are taken from one device before what is due elsewhere has its turn.
const BATCH: usize = 64;
