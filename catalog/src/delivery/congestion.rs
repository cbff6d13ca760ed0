//! Learns how fast a path may be used: the rate at which nothing piles up on the way.
//!
//! What piles up shows as growth of the time on the way over its recent least value. Loss alone does not slow a path
//! down, because radio loses without being full; only loss that comes on top of what the path always loses does. The
//! rate follows what arrives when the path is full, and grows while the sender has more to send than it lets through:
//! at most once in the time that its effect takes to be seen, fast up to a little less than the path was last seen to
//! carry. There it stays, so that nothing piles up, and tries now and then whether more goes: in small steps at first,
//! and fast where nothing piles up far beyond.

use std::collections::VecDeque;
use std::time::Duration;

use ddx_wire::Time;

use super::pace::Used;
use super::reporter::{Progress, Way};

/// The rate of one path.
#[derive(Debug)]
pub(super) struct Congestion {
    bytes_per_second: f64,
    /// Share of datagrams that the path loses without being full.
    loss: f64,
    /// Newest share of datagrams lost.
    loss_now: f64,
    /// Share of some hundred datagrams lost while the path was not full.
    loss_mean: f64,
    /// Newest growth of the time on the way.
    queue: Duration,
    /// How much that differs from report to report, of few datagrams and of many, whose fastest is rarely held up.
    jitter: [Duration; 2],
    /// Whether commands go by this path: a short queue is worth some of what it carries then.
    watchful: bool,
    /// Whether the newest report is one of many, and its fastest datagram tells what has piled up.
    dense: bool,
    /// The newest reports, enough to tell a rate, and whether what they say is lost was lost on a path that was not full.
    arrived: VecDeque<(Progress, bool)>,
    /// What the path carried when it was last full; none before, when the rate is a guess.
    ceiling: Option<f64>,
    /// The share of others that it had then.
    ceiling_share: f64,
    /// Steps in a row beyond the ceiling without a sign of a full path.
    beyond: u32,
    /// When it may be tried next whether the path carries more, and how long after the last time.
    try_at: Time,
    try_pause: Duration,
    /// Whether the rate held the sender back since it last grew.
    limited: bool,
    slowed_at: Time,
    /// When that has taken effect.
    slowed_until: Time,
    /// Number of the newest datagram that had been sent then.
    slowed_number: u32,
    /// What had piled up then.
    slowed_queue: Duration,
    grown_at: Time,
    /// The rate before nothing was heard any more.
    before_silence: Option<f64>,
    /// What arrives of this sender, as a multiple of the mean of all that share the path.
    share: f64,
    /// What was known, and when, as another path was tried in place of this one.
    left: Option<(Known, Time)>,
}

/// What is known of a path.
#[derive(Clone, Copy, Debug)]
struct Known {
    bytes_per_second: f64,
    ceiling: Option<f64>,
    ceiling_share: f64,
}

impl Congestion {
    pub(super) fn new(now: Time) -> Self {
        Self {
            bytes_per_second: RATE_FIRST,
            loss: 0.0,
            loss_now: 0.0,
            loss_mean: 0.0,
            queue: Duration::ZERO,
            jitter: [JITTER_FIRST; 2],
            watchful: false,
            dense: false,
            arrived: VecDeque::new(),
            ceiling: None,
            ceiling_share: 1.0,
            beyond: 0,
            try_at: now,
            try_pause: TRY_PAUSE_MIN,
            limited: false,
            slowed_at: now,
            slowed_until: now,
            slowed_number: 0,
            slowed_queue: Duration::ZERO,
            grown_at: now,
            before_silence: None,
            share: 1.0,
            left: None,
        }
    }

    /// Notes that another path is tried, which may fill this one.
    pub(super) fn leave(&mut self, now: Time) {
        let known = Known {
            bytes_per_second: self.bytes_per_second,
            ceiling: self.ceiling,
            ceiling_share: self.ceiling_share,
        };
        self.left.get_or_insert((known, now));
    }

    /// Notes that the other path was given up. What it did to this one is no news of what this one carries.
    pub(super) fn come_back(&mut self, now: Time) {
        if let Some((known, since)) = self.left.take()
            && now.since(since) < TRIAL_MAX
        {
            self.bytes_per_second = known.bytes_per_second;
            (self.ceiling, self.ceiling_share) = (known.ceiling, known.ceiling_share);
            (self.slowed_at, self.grown_at) = (now, now);
            // What has piled up is to drain first.
            self.slowed_until = now + DRAIN_MAX;
            self.arrived.clear();
        }
    }

    /// The rate now, bytes per second.
    pub(super) fn rate(&self) -> u64 {
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "it lies between two positive constants that fit"
        )]
        let rate = self.bytes_per_second as u64;
        rate
    }

    /// Newest growth of the time on the way.
    pub(super) fn queue(&self) -> Duration {
        self.queue
    }

    /// Newest share of datagrams lost, thousandths.
    pub(super) fn loss_permille(&self) -> u16 {
        permille(self.loss_now)
    }

    /// Share of some hundred datagrams that were lost, thousandths.
    pub(super) fn mean_loss_permille(&self) -> u16 {
        permille(self.loss_mean)
    }

    /// Says whether commands go by this path.
    pub(super) fn set_watchful(&mut self, watchful: bool) {
        self.watchful = watchful;
    }

    /// Takes in a report. `used` tells how the path was used since the one before, and `round_trip` how
    /// long it takes now until what is sent is reported, with what has piled up; `sent` is the number of the newest datagram.
    pub(super) fn handle_report(
        &mut self,
        progress: &Progress,
        way: Way,
        used: Used,
        round_trip: Duration,
        sent: u32,
        now: Time,
    ) {
        if let Some(rate) = self.before_silence.take() {
            // The link is back, perhaps as it was.
            self.bytes_per_second = (rate / 2.0).max(self.bytes_per_second);
            // What did not arrive while it was cut says nothing of what it carries.
            self.arrived.clear();
            self.queue = way.queue;
            return;
        }
        let Way {
            queue,
            shorter,
            share,
        } = way;
        self.share = share.clamp(SHARE_MIN, SHARE_MAX);
        // On a link with much jitter the fastest of many differs slowly, and by more than it seems; where cores and not the
        // link are the limit, threads that are kept waiting look like a queue, and short batches cost more.
        self.dense = self.watchful
            && progress.received >= DENSE_DATAGRAMS
            && progress.span < DENSE_SPAN
            && self.jitter[0] < DENSE_JITTER;
        let queue_before = std::mem::replace(&mut self.queue, queue);
        if queue_before <= self.queue_low() && !self.is_trying(used) {
            self.note_jitter(queue.saturating_sub(queue_before));
        }
        let all = f64::from(progress.received) + f64::from(progress.missing);
        if all > 0.0 {
            self.loss_now = progress.loss();
        }
        if self.tells_loss(progress) {
            self.loss_mean += (self.loss_now - self.loss_mean) * all / (all + MEAN_DATAGRAMS);
        }
        // The link works on what has piled up when nothing more is sent, and is idle then.
        let busy = progress.span.saturating_sub(used.idle) + queue;
        let least = f64::from(progress.bytes) / self.bytes_per_second;
        let busy = busy.max(Duration::from_secs_f64(least)).min(progress.span);
        let (arrived, lost, datagrams) = self.of_late(progress, busy);
        let capacity = arrived / (1.0 - self.loss.min(0.7));
        self.limited |= used.limited;
        if let Some(ceiling) = self.ceiling
            && !used.limited
            && self.bytes_per_second < BEYOND * ceiling
        {
            // What was tried as there was nothing more to send was not tried.
            self.bytes_per_second = self.bytes_per_second.min(STAY * ceiling);
            self.beyond = 0;
        }
        if shorter >= SHORTER_MIN.max(self.datagram_time() / 2) {
            // No link got faster by waiting: this is another one.
            (self.ceiling, self.beyond) = (None, 0);
        }

        let both = f64::midpoint(self.loss, lost);
        let chance = (both * (1.0 - both) / datagrams).sqrt();
        let enough = datagrams >= f64::from(ARRIVED_DATAGRAMS);
        let drops = enough && lost > self.loss + LOSS_STEP + 2.0 * chance;
        // In the report after the one that is on its way now.
        let seen_after = progress.span + round_trip;
        let low = self.queue_low();
        let full = match self.ceiling {
            // What piles up although the sender had little to send is not its own.
            _ if !self.limited && self.share < SHARE_MUCH => 2 * QUEUE_LOW_MAX,
            _ if self.share >= SHARE_MUCH => low,
            // The steps are large.
            None => low,
            // One report may be late for reasons of its own.
            Some(_) if queue_before <= low => 2 * QUEUE_LOW_MAX,
            Some(_) => (2 * low).max(FULL_MIN),
        };
        if self.queue >= full {
            if now >= self.slowed_until && self.was_sent_since(progress) {
                self.slow_down(capacity, seen_after);
                self.slowed(sent, seen_after, now);
            }
        } else if drops {
            // A full path with a short queue, or one that has begun to lose: if slowing down does not help, it is the
            // latter.
            self.loss += (lost - self.loss) / 2.0;
            self.bytes_per_second *= self.yielding(0.85);
            self.slowed(sent, seen_after, now);
        } else {
            let weight = (datagrams / f64::from(ARRIVED_DATAGRAMS)).min(1.0);
            self.loss += (lost - self.loss) * weight / 8.0;
            if let Some(ceiling) = self.ceiling
                && self.share > 1.5 * self.ceiling_share
            {
                // Those who had more are gone, or have less now: there is room for so much at least.
                self.ceiling = Some(ceiling * self.share / self.ceiling_share);
                self.ceiling_share = self.share;
            }
            if self.queue > low && now >= self.slowed_until {
                self.draw_back(capacity, seen_after, now);
            } else if self.dense && self.queue > self.datagram_time().max(QUEUE_LOW_MIN) + low / 4 {
                self.drain(seen_after, now);
            } else if self.limited && now >= self.grown_at.max(self.slowed_at) + seen_after {
                self.grow(capacity, seen_after, now);
            }
        }
        self.bytes_per_second = self.bytes_per_second.clamp(RATE_MIN, RATE_MAX);
    }

    /// Whether the rate may be more than the path carries.
    fn is_trying(&self, used: Used) -> bool {
        self.ceiling.map_or(used.limited, |carries| {
            self.bytes_per_second > 0.96 * carries
        })
    }

    fn note_jitter(&mut self, differs: Duration) {
        let differs = differs.min(QUEUE_LOW_MAX);
        let jitter = &mut self.jitter[usize::from(self.dense)];
        let lasts = if self.dense { 16 } else { 64 };
        // What is seldom counts for long.
        *jitter = if differs > *jitter {
            (3 * *jitter + differs) / 4
        } else {
            ((lasts - 1) * *jitter + differs) / lasts
        };
    }

    fn datagram_time(&self) -> Duration {
        Duration::from_secs_f64(DATAGRAM / self.bytes_per_second)
    }

    /// Growth of the time on the way up to which nothing piles up, as far as one can tell.
    fn queue_low(&self) -> Duration {
        // What else passes in between takes its time.
        let jitter = self.jitter[usize::from(self.dense)];
        (4 * jitter + self.datagram_time().max(QUEUE_LOW_MIN)).min(QUEUE_LOW_MAX)
    }

    fn slowed(&mut self, sent: u32, seen_after: Duration, now: Time) {
        self.slowed_number = sent;
        (self.slowed_at, self.slowed_queue) = (now, self.queue);
        self.slowed_until = now + seen_after;
        self.beyond = 0;
        // Alarms that come often do not put it off for ever.
        if self.try_at <= now {
            self.try_at = now + self.try_pause;
        }
        for (_, counts) in &mut self.arrived {
            *counts = false;
        }
    }

    /// The path is full, and carries this.
    fn slow_down(&mut self, capacity: f64, seen_after: Duration) {
        // What drains already needs time, not less.
        let share = self.share_to_drain(seen_after);
        let least = if self.queue < self.slowed_queue {
            1.0
        } else {
            0.95
        };
        if self.ceiling.is_none() {
            // What was lost before the first sign of a full path was lost because it was full.
            (self.loss, self.loss_mean) = (0.0, 0.0);
        }
        let carries = match self.ceiling {
            // All that was sent arrives: something else held it up, or there is a little too much of it.
            Some(ceiling) if capacity >= KEPT_UP * self.bytes_per_second => {
                ((ceiling + capacity) / 2.0).clamp(0.99 * ceiling, 2.0 * ceiling)
            }
            // One measurement is a rough one.
            Some(ceiling) if (0.5..2.0).contains(&(capacity / ceiling)) => {
                (ceiling + capacity) / 2.0
            }
            _ => capacity,
        };
        (self.ceiling, self.ceiling_share) = (Some(self.yielding(1.0) * carries), self.share);
        let lowered = (capacity.min(carries) * share).min(self.bytes_per_second * least);
        self.bytes_per_second *= self.yielding(lowered / self.bytes_per_second);
    }

    /// What is left of the rate when it falls: of several senders on one path those with more than others give it up.
    fn yielding(&self, left: f64) -> f64 {
        if self.share < 1.0 {
            1.0 - (1.0 - left) * self.share
        } else {
            left / self.share.cbrt()
        }
    }

    /// Share of what the path carries at which what has piled up is gone soon.
    fn share_to_drain(&self, seen_after: Duration) -> f64 {
        let drain = match self.dense {
            true => 2 * seen_after,
            false => (4 * seen_after).clamp(DRAIN_MIN, DRAIN_MAX),
        };
        let share = 1.0 - self.queue.as_secs_f64() / drain.as_secs_f64();
        share.clamp(0.6, STAY)
    }

    /// Something begins to pile up: what was tried is too much.
    fn draw_back(&mut self, capacity: f64, seen_after: Duration, now: Time) {
        let Some(ceiling) = self.ceiling else {
            return;
        };
        if self.bytes_per_second <= STAY * ceiling {
            return;
        }
        let ceiling = match capacity / ceiling {
            ..1.0 => ceiling,
            ..2.0 => (ceiling + capacity) / 2.0,
            _ => capacity,
        };
        (self.ceiling, self.ceiling_share) = (Some(self.yielding(1.0) * ceiling), self.share);
        let lowered = self.share_to_drain(seen_after) * ceiling;
        self.bytes_per_second *= self.yielding((lowered / self.bytes_per_second).min(1.0));
        self.try_pause = if self.beyond > 0 {
            TRY_PAUSE_MIN
        } else {
            (2 * self.try_pause).min(TRY_PAUSE_MAX)
        };
        (self.beyond, self.try_at) = (0, now + self.try_pause);
    }

    /// Something has piled up for a moment, for whatever reason: it is let go soon.
    fn drain(&mut self, seen_after: Duration, now: Time) {
        let Some(ceiling) = self.ceiling else {
            return;
        };
        let lowered = self.share_to_drain(seen_after) * ceiling;
        if lowered < self.bytes_per_second && self.bytes_per_second <= STAY * ceiling {
            self.bytes_per_second = lowered;
            self.grown_at = now;
        }
    }

    /// Nothing piles up, and more could be sent.
    fn grow(&mut self, capacity: f64, seen_after: Duration, now: Time) {
        let rate = self.bytes_per_second;
        // What was never tried is not known to fit.
        let tried = rate.max(4.0 * capacity).max(RATE_FIRST / 8.0);
        let grown = match self.ceiling {
            None => rate * 1.5,
            Some(ceiling) if rate < STAY * ceiling => (rate * 1.5).min(STAY * ceiling),
            Some(_) if now < self.try_at => return,
            Some(ceiling) => {
                // What piles up before it is seen stays small.
                let time = seen_after.as_secs_f64().max(0.001);
                let low = self.queue_low().as_secs_f64() / time;
                let mut share = (low / 3.0).clamp(0.0025, 0.025) / self.share;
                if rate > ceiling * (1.0 + low / 2.0).clamp(1.03, BEYOND) {
                    self.beyond += 1;
                    share = (share * f64::from(1_u32 << self.beyond.min(7))).min(0.5);
                }
                // So that of several paths that share a link the slow ones catch up.
                (rate * (1.0 + share)).max(rate + STEP_BYTES / self.share / time)
            }
        };
        (self.grown_at, self.limited) = (now, false);
        self.bytes_per_second = grown.min(tried);
    }

    /// Whether what a report says is lost was lost on a path that was not full: what a full queue dropped shows when a later
    /// datagram has passed it.
    fn tells_loss(&self, progress: &Progress) -> bool {
        self.queue <= self.queue_low() && self.was_sent_since(progress)
    }

    /// Whether a report is about datagrams that left after the rate was last lowered.
    fn was_sent_since(&self, progress: &Progress) -> bool {
        progress.from.wrapping_sub(self.slowed_number) < 1 << 31
    }

    /// Bytes per second that arrived of late while the link was `busy`, over enough datagrams that the jitter of one does not count; and the share
    /// of datagrams that were lost while the path was not full, and of how many.
    fn of_late(&mut self, progress: &Progress, busy: Duration) -> (f64, f64, f64) {
        let counts = self.tells_loss(progress);
        let span = busy;
        self.arrived
            .push_back((Progress { span, ..*progress }, counts));
        let enough = |arrived: &VecDeque<(Progress, bool)>| {
            let later = || arrived.iter().skip(1).map(|(progress, _)| progress);
            later().map(|p| p.received).sum::<u32>() >= ARRIVED_DATAGRAMS
                && later().map(|p| p.span).sum::<Duration>() >= ARRIVED_SPAN
        };
        while self.arrived.len() > 1
            && (enough(&self.arrived) || self.arrived.len() > ARRIVED_REPORTS)
        {
            self.arrived.pop_front();
        }
        let bytes: f64 = self.arrived.iter().map(|(p, _)| f64::from(p.bytes)).sum();
        let span: Duration = self.arrived.iter().map(|(p, _)| p.span).sum();
        let counted = || self.arrived.iter().filter(|(_, counts)| *counts);
        let received: f64 = counted().map(|(p, _)| f64::from(p.received)).sum();
        let missing: f64 = counted().map(|(p, _)| f64::from(p.missing)).sum();
        let datagrams = (received + missing).max(1.0);
        let rate = bytes / span.as_secs_f64().max(0.001);
        (rate, missing / datagrams, datagrams)
    }

    /// Notes that much was sent and nothing was heard for a while: the path may be cut, or hopelessly full.
    /// `since` is when the first of it was sent. Whether the rate was cut.
    pub(super) fn handle_silence(&mut self, since: Time, round_trip: Duration, now: Time) -> bool {
        let silent = now >= since.max(self.slowed_at) + SILENCE.max(3 * round_trip);
        if silent {
            self.before_silence.get_or_insert(self.bytes_per_second);
            (self.slowed_at, self.slowed_until) = (now, now);
            self.beyond = 0;
            let least = RATE_SILENT.min(self.bytes_per_second);
            self.bytes_per_second = (self.bytes_per_second / 2.0).max(least);
        }
        silent
    }
}

fn permille(share: f64) -> u16 {
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "a share is between 0 and 1"
    )]
    let permille = (share * 1000.0) as u16;
    permille
}

/// Datagrams over which loss is averaged: a burst of four is 4 % of them.
const MEAN_DATAGRAMS: f64 = 100.0;
/// A guess for a path that was never used: what a LAN carries many times, and a radio link tells at once.
const RATE_FIRST: f64 = 12_500_000.0;
/// One datagram each 120 ms, so that there is something to hear of.
const RATE_MIN: f64 = 10_000.0;
/// Nothing heard says nothing of a path that was faster before: what comes back is to be seen soon.
const RATE_SILENT: f64 = 60_000.0;
/// More than a core can seal.
const RATE_MAX: f64 = 5e9;
/// What no jitter takes from the least time on the way of late.
const SHORTER_MIN: Duration = Duration::from_millis(10);
/// Bytes of a datagram on most links.
const DATAGRAM: f64 = 1_500.0;
/// Growth of the time on the way that says nothing, whatever the jitter: what a paced batch takes.
const QUEUE_LOW_MIN: Duration = Duration::from_micros(200);
/// Growth that says something, whatever the jitter: twice as much is a third of what queues on the way should hold.
pub(super) const QUEUE_LOW_MAX: Duration = Duration::from_millis(15);
/// Growth that is no cause to think less of a path, whatever the jitter: what a thread that is kept waiting makes.
const FULL_MIN: Duration = Duration::from_millis(1);
/// A guess for a path that was never used.
const JITTER_FIRST: Duration = Duration::from_millis(1);
/// How long what has piled up may take to drain: some of the times that it takes to see that.
const DRAIN_MIN: Duration = Duration::from_millis(50);
const DRAIN_MAX: Duration = Duration::from_millis(300);
/// How long another path may be tried: what was known before is too old then.
const TRIAL_MAX: Duration = Duration::from_secs(5);
/// Share of what the path carries at which the rate stays.
const STAY: f64 = 0.95;
/// Share of what is sent that arrives where the path carries all of it.
const KEPT_UP: f64 = 0.9;
/// How long it stays there before more is tried: at first, and after tries that failed.
const TRY_PAUSE_MIN: Duration = Duration::from_millis(250);
const TRY_PAUSE_MAX: Duration = Duration::from_millis(500);
/// Loss beyond the usual that means a full path whose queue is too short to show.
pub(super) const LOSS_STEP: f64 = 0.15;
/// Least growth in the time until it is seen: a part of a datagram.
const STEP_BYTES: f64 = 60.0;
/// Multiple of what the path carried when it was full, above which it is another path.
const BEYOND: f64 = 1.15;
/// Who has so much of what others share makes room for them as soon as something piles up.
const SHARE_MUCH: f64 = 1.2;
/// Bounds of the share that a sender believes.
const SHARE_MIN: f64 = 0.25;
const SHARE_MAX: f64 = 3.0;
/// Datagrams in a report of many, its span, and the jitter up to which the fastest of them tells what has piled up.
const DENSE_DATAGRAMS: u32 = 16;
const DENSE_SPAN: Duration = Duration::from_millis(10);
const DENSE_JITTER: Duration = Duration::from_millis(2);
/// Datagrams that tell a rate, whatever the jitter of each.
const ARRIVED_DATAGRAMS: u32 = 8;
/// Least time that tells a rate.
const ARRIVED_SPAN: Duration = Duration::from_millis(100);
/// Reports that are remembered for it at most.
const ARRIVED_REPORTS: usize = 32;
/// Nothing heard for so long, though much was sent.
const SILENCE: Duration = Duration::from_millis(500);

#[cfg(test)]
mod tests {
    use super::*;

    /// A link of a fixed rate with a queue of 100 ms, used by a sender that always has more to send.
    struct Bottleneck {
        rate: f64,
        loss: f64,
        queue_bytes: f64,
        worst: Duration,
        dropped: f64,
        /// Bytes lost that are not a whole datagram yet.
        owed: f64,
    }

    fn run(link: &mut Bottleneck, congestion: &mut Congestion, from: Time, span: Duration) -> f64 {
        let step = Duration::from_millis(50);
        let mut now = from;
        let mut delivered = 0.0;
        while now < from + span {
            now = now + step;
            let sent = congestion.bytes_per_second * step.as_secs_f64();
            let surviving = sent * (1.0 - link.loss);
            let out = link.rate * step.as_secs_f64();
            let arrived = (link.queue_bytes + surviving).min(out);
            link.queue_bytes = (link.queue_bytes + surviving - arrived).max(0.0);
            let full = (link.queue_bytes - link.rate * 0.1).max(0.0);
            link.queue_bytes = (link.queue_bytes - full).max(0.0);
            link.dropped += full;
            delivered += arrived;
            let delay = link.queue_bytes / link.rate;
            link.worst = link.worst.max(Duration::from_secs_f64(delay));
            link.owed += sent * link.loss + full;
            let missing = whole(link.owed / 1200.0);
            link.owed -= f64::from(missing) * 1200.0;
            let progress = Progress {
                span: step,
                received: whole((arrived / 1200.0).ceil()).max(1),
                missing,
                bytes: whole(arrived),
                from: u32::MAX / 4,
            };
            let queue = Duration::from_secs_f64(delay);
            let round_trip = Duration::from_millis(20) + queue;
            let used = Used {
                limited: true,
                idle: Duration::ZERO,
            };
            let way = Way {
                queue,
                share: 1.0,
                ..Way::default()
            };
            congestion.handle_report(&progress, way, used, round_trip, 0, now);
        }
        delivered / span.as_secs_f64()
    }

    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "counts of one test are small and positive"
    )]
    fn whole(figure: f64) -> u32 {
        figure as u32
    }

    fn link(rate: f64, loss: f64) -> Bottleneck {
        Bottleneck {
            rate,
            loss,
            queue_bytes: 0.0,
            worst: Duration::ZERO,
            dropped: 0.0,
            owed: 0.0,
        }
    }

    #[test]
    fn a_full_link_is_used_well_and_not_filled() {
        for rate in [25_000.0, 625_000.0, 12_500_000.0] {
            for loss in [0.0, 0.02, 0.33] {
                let mut congestion = Congestion::new(Time(0));
                let mut link = link(rate, loss);
                run(&mut link, &mut congestion, Time(0), Duration::from_secs(5));
                link.worst = Duration::ZERO;
                let later = Time(0) + Duration::from_secs(5);
                let used = run(&mut link, &mut congestion, later, Duration::from_secs(20));
                assert!(used > 0.8 * rate, "{used} of {rate} at {loss}");
                assert!(
                    link.worst < Duration::from_millis(90),
                    "{:?} at {rate}, {loss}",
                    link.worst
                );
            }
        }
    }

    #[test]
    fn a_link_that_recovers_is_used_within_two_seconds() {
        let mut congestion = Congestion::new(Time(0));
        let mut slow = link(25_000.0, 0.02);
        run(&mut slow, &mut congestion, Time(0), Duration::from_secs(10));
        let mut fast = link(625_000.0, 0.02);
        let later = Time(0) + Duration::from_secs(10);
        run(&mut fast, &mut congestion, later, Duration::from_secs(2));
        assert!(congestion.bytes_per_second > 400_000.0, "{congestion:?}");
    }

    #[test]
    fn random_loss_does_not_stop_the_path() {
        let mut congestion = Congestion::new(Time(0));
        let mut radio = link(625_000.0, 0.0);
        run(&mut radio, &mut congestion, Time(0), Duration::from_secs(5));
        radio.loss = 0.33;
        let later = Time(0) + Duration::from_secs(5);
        run(&mut radio, &mut congestion, later, Duration::from_secs(3));
        let at = later + Duration::from_secs(3);
        let used = run(&mut radio, &mut congestion, at, Duration::from_secs(5));
        assert!(used > 0.6 * 625_000.0, "{used}");
    }

    #[test]
    fn silence_slows_down_and_a_report_restores() {
        let mut congestion = Congestion::new(Time(0));
        for ms in (0..10_000).step_by(100) {
            congestion.handle_silence(Time(0), Duration::from_millis(20), Time(ms * 1_000_000));
        }
        assert_eq!(congestion.rate(), 60_000);
        let progress = Progress {
            span: Duration::from_millis(50),
            received: 4,
            missing: 0,
            bytes: 4_000,
            from: 0,
        };
        let now = Time(10_000_000_000);
        let (way, used) = (Way::default(), Used::default());
        congestion.handle_report(&progress, way, used, Duration::ZERO, 0, now);
        assert_eq!(congestion.rate(), 6_250_000);
    }
}
