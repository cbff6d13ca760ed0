//! What chance does to a frame: a function of the seed, the frame's class and its number in it.

use super::{Class, Config, Loss, nanos};
use crate::random::Random;

/// What is decided of a frame before it meets the queue.
#[derive(Clone, Copy, Debug)]
pub(super) struct Fate {
    pub(super) is_lost: bool,
    pub(super) is_doubled: bool,
}

/// The chances of one line.
#[derive(Clone, Debug)]
pub(super) struct Dice {
    sequences: [Sequence; 3],
    /// Chances of the present frame, and then of its copy.
    present: Random,
}

/// The chances of one class of frames.
#[derive(Clone, Debug)]
struct Sequence {
    seed: u64,
    /// Number of the next frame.
    next: u64,
    /// Whether the frame before fell into a burst of losses.
    is_bad: Option<bool>,
}

impl Dice {
    pub(super) fn new(seed: u64) -> Self {
        let mut seeds = Random::new(seed);
        let mut sequence = || Sequence {
            seed: seeds.next(),
            next: 0,
            is_bad: None,
        };
        Self {
            sequences: [sequence(), sequence(), sequence()],
            present: Random::new(0),
        }
    }

    /// Takes the next frame of a class.
    ///
    /// Each frame has a generator of its own, so that what one draws moves no other's chances.
    pub(super) fn throw(&mut self, config: &Config, class: Class) -> Fate {
        let sequence = match class {
            Class::Unicast => &mut self.sequences[0],
            Class::Multicast => &mut self.sequences[1],
            Class::Spared => &mut self.sequences[2],
        };
        let number = sequence.next;
        sequence.next += 1;
        let mut random = Random::new(sequence.seed ^ Random::new(number).next());
        let loss = match class {
            Class::Unicast => config.loss,
            Class::Multicast => config.multicast_loss.unwrap_or(config.loss),
            Class::Spared => Loss::NONE,
        };
        let is_lost = sequence.is_lost(loss, &mut random);
        let is_doubled = random.chance(config.duplicate) && class != Class::Spared && !is_lost;
        self.present = random;
        Fate {
            is_lost,
            is_doubled,
        }
    }

    /// Goes from a frame to its copy.
    pub(super) fn next_copy(&mut self) {
        self.present = Random::new(self.present.next());
    }

    /// Returns whether the present frame keeps order, and how many nanoseconds it is on the way.
    pub(super) fn travel(&self, config: &Config) -> (bool, u64) {
        let mut random = self.present.clone();
        let keeps_order = !random.chance(config.reorder);
        let (delay, jitter) = (nanos(config.delay), nanos(config.jitter));
        let least = delay.saturating_sub(jitter);
        let span = delay.saturating_add(jitter) - least;
        (keeps_order, least + random.below(span.saturating_add(1)))
    }
}

impl Sequence {
    fn is_lost(&mut self, loss: Loss, random: &mut Random) -> bool {
        if loss.burst <= 1.0 {
            self.is_bad = None;
            return random.chance(loss.share);
        }
        let to_bad = match self.is_bad {
            // The first frame meets the link in either state, as often as the link is in it.
            None => loss.share,
            Some(true) => 1.0 - 1.0 / loss.burst,
            // So that the bad state has its share: share / (1 - share) = to_bad * burst.
            Some(false) => loss.share / (1.0 - loss.share).max(f64::MIN_POSITIVE) / loss.burst,
        };
        let is_bad = random.chance(to_bad);
        self.is_bad = Some(is_bad);
        is_bad
    }
}
