//! Learns how fast a path may be used: the rate at which nothing piles up on the way.
//!
//! What piles up shows as growth of the time on the way over its recent least value. Loss alone does not slow a path
//! down, because radio loses without being full; only loss that comes on top of what the path always loses does. The
//! rate follows what arrives when the path is full, and grows while the sender has more to send than it lets through:
//! at most once in the time that its effect takes to be seen, fast up to what the path was last seen to carry, slowly
//! there, and fast again where nothing piles up far beyond.

use std::collections::VecDeque;
use std::time::Duration;

use ddx_wire::Time;
use ddx_wire::message::ReportEntry;

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
    /// The newest reports, enough to tell a rate, and whether what they say is lost was lost on a path that was not full.
    arrived: VecDeque<(Progress, bool)>,
    /// What the path carried when it was last full; none before, when the rate is a guess.
    ceiling: Option<f64>,
    /// Steps in a row beyond the ceiling without a sign of a full path.
    beyond: u32,
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
}

/// What one report adds to the one before.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Progress {
    /// Time between the two, by the reporter's clock.
    pub(super) span: Duration,
    /// Datagrams that arrived.
    pub(crate) received: u32,
    /// Datagrams that did not.
    pub(crate) missing: u32,
    /// Bytes that arrived.
    pub(super) bytes: u32,
    /// Number of the newest datagram of the report before.
    pub(super) from: u32,
}

/// One host that reports about a path, and what it said.
#[derive(Debug)]
pub(super) struct Reporter {
    last: ReportEntry,
    /// How long the fastest datagram of the newest report and the report took together, without what the report waited.
    round_trip: Option<Duration>,
    /// What left before this has come, or never will.
    pub(super) seen: Option<Time>,
    /// The first time on the way that it told: others are compared with it, since its clock has a zero of its own.
    zero: u32,
    least: Least,
    /// What its newest report came to, and when.
    strain: Option<(Strain, Time)>,
}

/// How hard a path is for one reporter.
#[derive(Clone, Copy, Debug)]
pub(super) struct Strain {
    queue: Duration,
    loss: f64,
}

/// Least value of the last ten to twenty seconds.
#[derive(Debug, Default)]
struct Least {
    present: Option<i64>,
    former: Option<i64>,
    since: Time,
}

impl Congestion {
    pub(super) fn new(now: Time) -> Self {
        Self {
            bytes_per_second: RATE_FIRST,
            loss: 0.0,
            loss_now: 0.0,
            loss_mean: 0.0,
            queue: Duration::ZERO,
            arrived: VecDeque::new(),
            ceiling: None,
            beyond: 0,
            limited: false,
            slowed_at: now,
            slowed_until: now,
            slowed_number: 0,
            slowed_queue: Duration::ZERO,
            grown_at: now,
            before_silence: None,
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

    /// Takes in a report. `limited` tells whether the rate held the sender back since the one before, and `round_trip` how
    /// long it takes now until what is sent is reported, with what has piled up; `sent` is the number of the newest datagram.
    pub(super) fn handle_report(
        &mut self,
        progress: &Progress,
        queue: Duration,
        limited: bool,
        round_trip: Duration,
        sent: u32,
        now: Time,
    ) {
        if let Some(rate) = self.before_silence.take() {
            // The link is back, perhaps as it was.
            self.bytes_per_second = (rate / 2.0).max(self.bytes_per_second);
        }
        self.queue = queue;
        let all = f64::from(progress.received) + f64::from(progress.missing);
        if all > 0.0 {
            self.loss_now = progress.loss();
        }
        if self.tells_loss(progress) {
            self.loss_mean += (self.loss_now - self.loss_mean) * all / (all + MEAN_DATAGRAMS);
        }
        let (arrived, lost, datagrams) = self.of_late(progress);
        let capacity = arrived / (1.0 - self.loss.min(0.7));
        self.limited |= limited;

        let chance = (self.loss * (1.0 - self.loss) / datagrams).sqrt();
        let enough = datagrams >= f64::from(ARRIVED_DATAGRAMS);
        let drops = enough && lost > self.loss + LOSS_STEP + chance;
        let seen_after = (progress.span / 2).max(round_trip);
        if self.queue >= QUEUE_FULL {
            self.beyond = 0;
            if now >= self.slowed_until && self.was_sent_since(progress) {
                self.slow_down(capacity);
                self.slowed(sent, seen_after, now);
            }
        } else if drops {
            self.beyond = 0;
            // A full path with a short queue, or one that has begun to lose: if slowing down does not help, it is the
            // latter.
            self.loss += (lost - self.loss) / 2.0;
            self.bytes_per_second *= 0.85;
            self.slowed(sent, seen_after, now);
        } else {
            if self.queue > QUEUE_LOW * 3 / 2
                && let Some(ceiling) = self.ceiling
            {
                // Something may pile up: no more than arrives, unless that is little because little was sent.
                let most = capacity.max(0.98 * ceiling);
                self.bytes_per_second = self.bytes_per_second.min(most);
            }
            let weight = (datagrams / f64::from(ARRIVED_DATAGRAMS)).min(1.0);
            self.loss += (lost - self.loss) * weight / 8.0;
            let since = self.grown_at.max(self.slowed_at);
            if self.queue <= QUEUE_LOW && self.limited && now >= since + seen_after {
                (self.grown_at, self.limited) = (now, false);
                self.grow(capacity, round_trip);
            }
        }
        self.bytes_per_second = self.bytes_per_second.clamp(RATE_MIN, RATE_MAX);
    }

    fn slowed(&mut self, sent: u32, seen_after: Duration, now: Time) {
        self.slowed_number = sent;
        (self.slowed_at, self.slowed_queue) = (now, self.queue);
        self.slowed_until = now + seen_after;
        for (_, counts) in &mut self.arrived {
            *counts = false;
        }
    }

    /// The path is full, and carries this.
    fn slow_down(&mut self, capacity: f64) {
        // So that what has piled up is gone in a third of a second; what drains already needs time, not less.
        let share = 1.0 - self.queue.as_secs_f64() / DRAIN.as_secs_f64();
        let share = share.max(0.6);
        let least = if self.queue < self.slowed_queue {
            1.0
        } else {
            0.95
        };
        if self.ceiling.is_none() {
            // What was lost before the first sign of a full path was lost because it was full.
            (self.loss, self.loss_mean) = (0.0, 0.0);
        }
        // One measurement is a rough one.
        self.ceiling = Some(match self.ceiling {
            Some(ceiling) if (0.5..2.0).contains(&(capacity / ceiling)) => {
                (ceiling + capacity) / 2.0
            }
            _ => capacity,
        });
        self.bytes_per_second = (capacity * share).min(self.bytes_per_second * least);
    }

    /// Nothing piles up, and more could be sent.
    fn grow(&mut self, capacity: f64, round_trip: Duration) {
        let rate = self.bytes_per_second;
        // What was never tried is not known to fit.
        let tried = rate.max(4.0 * capacity).max(RATE_FIRST / 8.0);
        let grown = match self.ceiling {
            None => rate * 2.0,
            Some(ceiling) if rate < 0.9 * ceiling => (rate * 1.5).min(0.95 * ceiling),
            Some(ceiling) if rate < BEYOND * ceiling => {
                // What piles up before that is seen stays small.
                let round_trip = round_trip.as_secs_f64().max(0.001);
                let share = (STEP.as_secs_f64() / round_trip).clamp(0.02, 0.05);
                // So that of several paths that share a link the slow ones catch up.
                (rate * (1.0 + share)).max(rate + STEP_BYTES / round_trip)
            }
            Some(_) => {
                self.beyond = self.beyond.saturating_add(1);
                rate * if self.beyond > 2 { 1.5 } else { 1.15 }
            }
        };
        self.bytes_per_second = grown.min(tried);
    }

    /// Whether what a report says is lost was lost on a path that was not full: what a full queue dropped shows when a later
    /// datagram has passed it.
    fn tells_loss(&self, progress: &Progress) -> bool {
        self.queue <= QUEUE_LOW && self.was_sent_since(progress)
    }

    /// Whether a report is about datagrams that left after the rate was last lowered.
    fn was_sent_since(&self, progress: &Progress) -> bool {
        progress.from.wrapping_sub(self.slowed_number) < 1 << 31
    }

    /// Bytes per second that arrived of late, over enough datagrams that the jitter of one does not count; and the share
    /// of datagrams that were lost while the path was not full, and of how many.
    fn of_late(&mut self, progress: &Progress) -> (f64, f64, f64) {
        let counts = self.tells_loss(progress);
        self.arrived.push_back((*progress, counts));
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

impl Progress {
    /// Share of datagrams that did not arrive.
    fn loss(&self) -> f64 {
        let all = f64::from(self.received) + f64::from(self.missing);
        f64::from(self.missing) / all.max(1.0)
    }

    /// What `next` adds to `last`, two reports of one reporter; `None` if it adds nothing.
    pub(crate) fn between(last: &ReportEntry, next: &ReportEntry) -> Option<Self> {
        let span = next.at_us.wrapping_sub(last.at_us);
        let received = next.received.wrapping_sub(last.received);
        let passed = next.highest.wrapping_sub(last.highest);
        // Half of the range: the later of two is less than that ahead.
        let is_later = |step: u32| step < 1 << 31;
        if received == 0 || !is_later(received) || !is_later(passed) || !is_later(span) {
            return None;
        }
        Some(Self {
            span: Duration::from_micros(span.into()),
            received,
            missing: passed.saturating_sub(received),
            bytes: next.bytes.wrapping_sub(last.bytes),
            from: last.highest,
        })
    }
}

impl Reporter {
    pub(super) fn new(first: ReportEntry, now: Time) -> Self {
        let mut least = Least::default();
        least.update(0, now);
        Self {
            zero: first.delay_us,
            round_trip: round_trip(&first, now),
            seen: None,
            last: first,
            least,
            strain: None,
        }
    }

    /// How long it takes until a datagram is reported, with what has piled up on the way.
    pub(super) fn round_trip(&self) -> Option<Duration> {
        self.round_trip
    }

    /// Takes in a report: what it adds to the one before, and how much longer datagrams took than the fastest of late.
    pub(super) fn handle_report(
        &mut self,
        report: &ReportEntry,
        now: Time,
    ) -> Option<(Progress, Duration)> {
        let progress = Progress::between(&self.last, report);
        self.last = *report;
        self.round_trip = round_trip(report, now);
        let delay = i64::from(report.delay_us.wrapping_sub(self.zero).cast_signed());
        let least = self.least.update(delay, now);
        let queue = u64::try_from(delay.saturating_sub(least)).unwrap_or(0);
        let (progress, queue) = (progress?, Duration::from_micros(queue));
        let loss = progress.loss();
        self.strain = Some((Strain { queue, loss }, now));
        Some((progress, queue))
    }

    /// How hard the path is for it, if it said so of late.
    pub(super) fn strain(&self, now: Time) -> Option<Strain> {
        let (strain, at) = self.strain?;
        (now.since(at) < STRAIN_LASTS).then_some(strain)
    }
}

impl Strain {
    /// Whether what slows the path down for one reporter is not seen by this other one: it lies behind the group.
    pub(super) fn is_not_shared_by(&self, other: &Self) -> bool {
        let is_strained = self.queue >= QUEUE_FULL || self.loss > other.loss + LOSS_STEP;
        is_strained && other.queue <= QUEUE_LOW && other.loss <= self.loss
    }
}

/// The receiver's clock is in both times of a report, and falls out.
fn round_trip(report: &ReportEntry, now: Time) -> Option<Duration> {
    let now_us = u32::try_from((now.0 / 1_000) & u64::from(u32::MAX)).unwrap_or_default();
    let micros = now_us
        .wrapping_sub(report.at_us)
        .wrapping_add(report.delay_us);
    let round_trip = Duration::from_micros(micros.into());
    (round_trip <= ROUND_TRIP_MAX).then_some(round_trip)
}

impl Least {
    /// Takes in a value; the least one of late.
    fn update(&mut self, value: i64, now: Time) -> i64 {
        if now.since(self.since) >= WINDOW {
            self.former = self.present.take();
            self.since = now;
        }
        let present = self.present.map_or(value, |least| least.min(value));
        self.present = Some(present);
        self.former.map_or(present, |former| former.min(present))
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
/// Growth of the time on the way that means a full path: above what jitter does to the least of several datagrams, and
/// a third of what queues on the way should hold.
const QUEUE_FULL: Duration = Duration::from_millis(30);
/// Growth below which the rate may grow.
const QUEUE_LOW: Duration = Duration::from_millis(15);
/// How long what has piled up may take to drain.
const DRAIN: Duration = Duration::from_millis(300);
/// Loss beyond the usual that means a full path whose queue is too short to show.
const LOSS_STEP: f64 = 0.15;
/// Least growth in a round trip: a part of a datagram.
const STEP_BYTES: f64 = 60.0;
/// What the growth of a round trip lets pile up in the next.
const STEP: Duration = Duration::from_micros(2_500);
/// Multiple of what the path carried when it was full, above which it is another path.
const BEYOND: f64 = 1.25;
/// Datagrams that tell a rate, whatever the jitter of each.
const ARRIVED_DATAGRAMS: u32 = 8;
/// Least time that tells a rate.
const ARRIVED_SPAN: Duration = Duration::from_millis(40);
/// Reports that are remembered for it at most.
const ARRIVED_REPORTS: usize = 16;
/// What takes longer is an error of a peer.
const ROUND_TRIP_MAX: Duration = Duration::from_secs(10);
/// How long the least time on the way is remembered, once or twice: clocks drift, and routes change.
const WINDOW: Duration = Duration::from_secs(10);
/// Reports come every 50 ms while there is enough to report.
const STRAIN_LASTS: Duration = Duration::from_millis(500);
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
            let packets = |bytes: f64| whole((bytes / 1200.0).ceil());
            let progress = Progress {
                span: step,
                received: packets(arrived).max(1),
                missing: packets(sent * link.loss + full),
                bytes: whole(arrived),
                from: u32::MAX / 4,
            };
            let queue = Duration::from_secs_f64(delay);
            let round_trip = Duration::from_millis(20) + queue;
            congestion.handle_report(&progress, queue, true, round_trip, 0, now);
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
        congestion.handle_report(&progress, Duration::ZERO, false, Duration::ZERO, 0, now);
        assert_eq!(congestion.rate(), 6_250_000);
    }

    #[test]
    fn reports_come_round() {
        let last = ReportEntry {
            path: 1,
            highest: u32::MAX,
            received: u32::MAX - 1,
            bytes: u32::MAX,
            delay_us: 7,
            at_us: u32::MAX - 999,
            longest: 1200,
        };
        let next = ReportEntry {
            highest: 9,
            received: 3,
            bytes: 99,
            delay_us: u32::MAX,
            at_us: 0,
            ..last
        };
        let progress = Progress::between(&last, &next).unwrap();
        assert_eq!((progress.received, progress.missing), (5, 5));
        assert_eq!(
            (progress.bytes, progress.span),
            (100, Duration::from_millis(1))
        );
        assert_eq!(Progress::between(&next, &last), None);
    }

    #[test]
    fn the_queue_is_what_is_longer_than_the_least_of_late() {
        let report = |number: u32, delay_us: u32| ReportEntry {
            path: 1,
            highest: number,
            received: number,
            bytes: number * 1_000,
            delay_us,
            at_us: number * 1_000,
            longest: 1_000,
        };
        let mut reporter = Reporter::new(report(1, 1_000), Time(0));
        let mut queue = |number, delay_us, s: u64| {
            let at = Time(s * 1_000_000_000);
            let heard = reporter.handle_report(&report(number, delay_us), at);
            heard.unwrap().1.as_micros()
        };
        assert_eq!(queue(2, 1_400, 1), 400);
        assert_eq!(queue(3, 800, 2), 0);
        assert_eq!(queue(4, u32::MAX - 99, 3), 0, "below zero");
        assert_eq!(queue(5, 900, 4), 1_000);
        // Forgotten after twenty seconds.
        assert_eq!(queue(6, 900, 30), 1_000);
        assert_eq!(queue(7, 900, 60), 0);
    }
}
