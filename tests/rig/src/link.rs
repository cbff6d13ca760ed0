//! The link emulator: what becomes of frames on one direction of one link, as a function of a seed.
//!
//! It has no clock, socket or thread: the simulation drives it in virtual time, the laboratory's wire in real
//! time. A frame passes the parts of a link in this order:
//!
//! 1. larger than the MTU, it is dropped;
//! 2. it waits in the queue, or is dropped at its tail;
//! 3. it takes its time at the rate (a frame that will be lost does so too, as on the air);
//! 4. it is lost, or
//! 5. spends delay and jitter on the way, behind those before it unless reordering is configured.
//!
//! Lengths are those of the IP packet. The rates of multicast and of all else share one transmitter and one queue,
//! as they share the air.
//!
//! **Same seed, same drops**: what chance does to a frame depends on the seed and on how many of its [`Class`]
//! went before it, and not on time. Only the queue depends on time.
//!
//! ```
//! use std::time::Duration;
//! use ddx_rig::link::{Class, Link, Profile};
//!
//! let profile = Profile::parse("satellite --loss 0% --rate \"200 kbit/s\"")?;
//! let mut link = Link::new(profile.down, 7);
//! link.push("a frame", 1_000, Class::Unicast, Duration::ZERO);
//! // 40 ms at the rate, 300 ms on the way.
//! assert_eq!(link.poll_timeout(), Some(Duration::from_millis(340)));
//! assert_eq!(link.pop(Duration::from_millis(339)), None);
//! assert_eq!(link.pop(Duration::from_millis(340)), Some("a frame"));
//! # Ok::<(), ddx_rig::link::Error>(())
//! ```

mod chance;
mod profile;
mod units;

use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

use chance::{Dice, Fate};

pub use profile::{Error, Profile};

/// Bits of IP packets in a second.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct BitsPerSecond(pub u64);

/// How much may wait for the transmitter; what comes on top is dropped.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Queue {
    /// A frame waits at most this long.
    Time(Duration),
    /// At most so many bytes wait, the frame in transmission included; a frame that finds nothing waiting passes.
    Bytes(usize),
}

/// What chance takes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Loss {
    /// Share of frames, from 0 to 1.
    pub share: f64,
    /// Mean number of frames in a burst of losses (Gilbert's model: all are lost in the bad state, none in the
    /// good one); 1 is loss without memory.
    pub burst: f64,
}

/// One direction of a link. The default changes nothing.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Config {
    /// How fast frames leave; `None` is at once.
    pub rate: Option<BitsPerSecond>,
    /// What may wait for that.
    pub queue: Queue,
    /// Mean time on the way.
    pub delay: Duration,
    /// Greatest deviation from it, evenly spread; it stretches and squeezes the gaps, and reorders nothing.
    pub jitter: Duration,
    /// What is lost on the way.
    pub loss: Loss,
    /// Share of frames that come twice, from 0 to 1. The copy takes its place in the queue as the frame does.
    pub duplicate: f64,
    /// Share of frames, from 0 to 1, that keep no order: jitter alone says when they come. Without jitter nothing
    /// is reordered.
    pub reorder: f64,
    /// Largest frame; `None` is any.
    pub mtu: Option<usize>,
    /// The rate of multicast where it differs.
    pub multicast_rate: Option<BitsPerSecond>,
    /// The loss of multicast where it differs.
    pub multicast_loss: Option<Loss>,
}

/// What kind of frame it is. Each has its own sequence of chances.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Class {
    /// To one host.
    Unicast,
    /// To a group or to all.
    Multicast,
    /// What keeps a network alive and a test does not mean to test (ARP, IGMP): it takes its time as unicast does
    /// and is neither lost by chance nor doubled.
    Spared,
}

/// What became of frames.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counters {
    /// Frames that were pushed.
    pub offered: u64,
    /// Their bytes.
    pub offered_bytes: u64,
    /// Frames and copies that arrived or will: `offered + copies - lost - queue_full - too_large`.
    pub carried: u64,
    /// Their bytes.
    pub carried_bytes: u64,
    /// Copies that were made of frames; grows with [`Config::duplicate`].
    pub copies: u64,
    /// Frames that chance took; grows with [`Config::loss`].
    pub lost: u64,
    /// Frames that found the queue full; grows when more is offered than the rate carries.
    pub queue_full: u64,
    /// Frames above the MTU.
    pub too_large: u64,
}

/// What became of frames in both directions of a host's link.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Books {
    /// From the host.
    pub up: Counters,
    /// To the host.
    pub down: Counters,
}

/// The arithmetic of one direction: when what is pushed now will arrive.
///
/// For callers with a calendar of their own; [`Link`] is one with a calendar.
#[derive(Clone, Debug)]
pub struct Line {
    config: Config,
    dice: Dice,
    /// When the transmitter is free, nanoseconds as all times here.
    free_at: u64,
    /// Latest arrival of a frame that keeps order.
    latest: u64,
    /// End of transmission and bytes of what waits, kept only for a queue in bytes.
    waiting: VecDeque<(u64, usize)>,
    waiting_bytes: usize,
    counters: Counters,
}

/// One direction of a link with the frames on it.
#[derive(Clone, Debug)]
pub struct Link<F> {
    line: Line,
    /// By arrival, then by order of pushing.
    on_the_way: BTreeMap<(u64, u64), F>,
    pushed: u64,
}

impl Default for Config {
    fn default() -> Self {
        Self {
            rate: None,
            queue: Queue::Time(QUEUE),
            delay: Duration::ZERO,
            jitter: Duration::ZERO,
            loss: Loss::NONE,
            duplicate: 0.0,
            reorder: 0.0,
            mtu: None,
            multicast_rate: None,
            multicast_loss: None,
        }
    }
}

impl Loss {
    /// None at all.
    pub const NONE: Self = Self::random(0.0);

    /// Loss without memory.
    #[must_use]
    pub const fn random(share: f64) -> Self {
        Self { share, burst: 1.0 }
    }
}

impl Line {
    /// Makes an idle line.
    #[must_use]
    pub fn new(config: Config, seed: u64) -> Self {
        Self {
            config,
            dice: Dice::new(seed),
            free_at: 0,
            latest: 0,
            waiting: VecDeque::new(),
            waiting_bytes: 0,
            counters: Counters::default(),
        }
    }

    /// Returns what it does.
    #[must_use]
    pub fn config(&self) -> &Config {
        &self.config
    }

    /// Returns what became of frames so far.
    #[must_use]
    pub fn counters(&self) -> Counters {
        self.counters
    }

    /// Returns how long a frame that is pushed now waits for the transmitter.
    #[must_use]
    pub fn backlog(&self, now: Duration) -> Duration {
        Duration::from_nanos(self.free_at.saturating_sub(nanos(now)))
    }

    /// Changes what it does to frames from now on; the sequence of chances goes on.
    pub fn configure(&mut self, config: Config) {
        self.config = config;
    }

    /// Becomes an idle line with this seed's first chances, whatever was before. Only the counters go on.
    pub fn restart(&mut self, config: Config, seed: u64) {
        *self = Self {
            counters: self.counters,
            ..Self::new(config, seed)
        };
    }

    /// Puts a frame on the line: says when it arrives, nothing when it is dropped, twice when it is doubled.
    ///
    /// `now` is time since any start and never goes back.
    pub fn carry(
        &mut self,
        bytes: usize,
        class: Class,
        now: Duration,
    ) -> impl Iterator<Item = Duration> + use<> {
        let now = nanos(now);
        let length = u64::try_from(bytes).unwrap_or(u64::MAX);
        let fate = self.dice.throw(&self.config, class);
        self.counters.offered += 1;
        self.counters.offered_bytes += length;
        self.counters.copies += u64::from(fate.is_doubled);
        let mut arrivals = [None, None];
        let copies = 1 + usize::from(fate.is_doubled);
        for arrival in &mut arrivals[..copies] {
            *arrival = self.pass(bytes, class, now, &fate);
            if arrival.is_some() {
                self.counters.carried += 1;
                self.counters.carried_bytes += length;
            }
            self.dice.next_copy();
        }
        arrivals.into_iter().flatten().map(Duration::from_nanos)
    }

    fn pass(&mut self, bytes: usize, class: Class, now: u64, fate: &Fate) -> Option<u64> {
        if self.config.mtu.is_some_and(|mtu| bytes > mtu) {
            self.counters.too_large += 1;
            return None;
        }
        let Some(sent) = self.transmit(bytes, class, now) else {
            self.counters.queue_full += 1;
            return None;
        };
        if fate.is_lost {
            self.counters.lost += 1;
            return None;
        }
        let (keeps_order, travel) = self.dice.travel(&self.config);
        let arrival = sent.saturating_add(travel);
        if !keeps_order {
            return Some(arrival);
        }
        self.latest = self.latest.max(arrival);
        Some(self.latest)
    }

    /// Returns when the last bit leaves, or `None` when the queue is full.
    fn transmit(&mut self, bytes: usize, class: Class, now: u64) -> Option<u64> {
        while let Some((_, sent)) = self.waiting.pop_front_if(|(end, _)| *end <= now) {
            self.waiting_bytes -= sent;
        }
        let start = self.free_at.max(now);
        let has_room = match self.config.queue {
            Queue::Time(longest) => start - now <= nanos(longest),
            Queue::Bytes(most) => {
                self.waiting_bytes == 0 || self.waiting_bytes.saturating_add(bytes) <= most
            }
        };
        if !has_room {
            return None;
        }
        let rate = match class {
            Class::Multicast => self.config.multicast_rate.or(self.config.rate),
            Class::Unicast | Class::Spared => self.config.rate,
        };
        self.free_at = start.saturating_add(rate.map_or(0, |rate| rate.time_of(bytes)));
        if matches!(self.config.queue, Queue::Bytes(_)) && self.free_at > now {
            self.waiting.push_back((self.free_at, bytes));
            self.waiting_bytes += bytes;
        }
        Some(self.free_at)
    }
}

impl BitsPerSecond {
    /// Returns how long so many bytes take, rounded up, in nanoseconds.
    fn time_of(self, bytes: usize) -> u64 {
        let bits = u128::try_from(bytes).unwrap_or(u128::MAX / 8_000_000_000) * 8;
        let time = (bits * 1_000_000_000).div_ceil(u128::from(self.0.max(1)));
        u64::try_from(time).unwrap_or(u64::MAX)
    }
}

impl<F> Link<F> {
    /// Makes an idle link.
    #[must_use]
    pub fn new(config: Config, seed: u64) -> Self {
        Self {
            line: Line::new(config, seed),
            on_the_way: BTreeMap::new(),
            pushed: 0,
        }
    }

    /// Puts a frame of so many bytes on the link; see [`Line::carry`].
    pub fn push(&mut self, frame: F, bytes: usize, class: Class, now: Duration)
    where
        F: Clone,
    {
        let mut arrivals = self.line.carry(bytes, class, now);
        let (first, second) = (arrivals.next(), arrivals.next());
        if let Some(second) = second {
            self.insert(second, frame.clone());
        }
        if let Some(first) = first {
            self.insert(first, frame);
        }
    }

    /// Takes the next frame that has arrived.
    pub fn pop(&mut self, now: Duration) -> Option<F> {
        let next = self.on_the_way.first_entry()?;
        (next.key().0 <= nanos(now)).then(|| next.remove())
    }

    /// Returns when the next frame arrives.
    #[must_use]
    pub fn poll_timeout(&self) -> Option<Duration> {
        let ((at, _), _) = self.on_the_way.first_key_value()?;
        Some(Duration::from_nanos(*at))
    }

    /// Returns the line, to look at.
    #[must_use]
    pub fn line(&self) -> &Line {
        &self.line
    }

    /// Returns the line, to change it. What is on the way stays so, and what is pushed later may overtake it.
    pub fn line_mut(&mut self) -> &mut Line {
        &mut self.line
    }

    fn insert(&mut self, arrival: Duration, frame: F) {
        self.pushed += 1;
        self.on_the_way.insert((nanos(arrival), self.pushed), frame);
    }
}

fn nanos(span: Duration) -> u64 {
    u64::try_from(span.as_nanos()).unwrap_or(u64::MAX)
}

/// What every profile's queue holds.
const QUEUE: Duration = Duration::from_millis(100);

#[cfg(test)]
mod tests;
