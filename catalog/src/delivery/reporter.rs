//! What the reports of a path's ends say: what arrived, how long it took, and how hard the path is for one of them.

use std::time::Duration;

use ddx_wire::Time;
use ddx_wire::message::ReportEntry;

use super::congestion::{LOSS_STEP, QUEUE_LOW_MAX};
use super::shares::EVEN;

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

/// How the time on the way compares with the least of late.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Way {
    /// What it is longer: what has piled up.
    pub(super) queue: Duration,
    /// What it is shorter.
    pub(super) shorter: Duration,
    /// What it has, as a multiple of the mean of all that share its link, as far as its ends can tell.
    pub(super) share: f64,
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

/// Least value of the last ten to twenty seconds, which rises by what the two clocks may differ in rate.
#[derive(Debug, Default)]
struct Least {
    present: Option<(i64, Time)>,
    former: Option<(i64, Time)>,
    since: Time,
}

impl Progress {
    /// Share of datagrams that did not arrive.
    pub(super) fn loss(&self) -> f64 {
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

    /// Longest datagram that it got, bytes.
    pub(super) fn longest(&self) -> usize {
        self.last.longest.into()
    }

    /// How long it takes until a datagram is reported, with what has piled up on the way.
    pub(super) fn round_trip(&self) -> Option<Duration> {
        self.round_trip
    }

    /// Takes in a report: what it adds to the one before, and how much longer datagrams took than the fastest of late.
    pub(super) fn handle_report(
        &mut self,
        report: &ReportEntry,
        own_share: u16,
        now: Time,
    ) -> Option<(Progress, Way)> {
        let progress = Progress::between(&self.last, report);
        if 8 * u32::from(self.last.longest) < 7 * u32::from(report.longest) {
            // Longer ones take longer: only like is compared.
            self.least = Least::default();
        }
        self.last = *report;
        self.round_trip = round_trip(report, now);
        let delay = i64::from(report.delay_us.wrapping_sub(self.zero).cast_signed());
        let before = self.least.get(now);
        let least = self.least.update(delay, now);
        let micros = |span: i64| Duration::from_micros(u64::try_from(span).unwrap_or(0));
        let queue = micros(delay.saturating_sub(least));
        let shorter = micros(before.unwrap_or(delay).saturating_sub(delay));
        let progress = progress?;
        let loss = progress.loss();
        self.strain = Some((Strain { queue, loss }, now));
        // The link of either end may be the one that is full.
        let share = f64::from(report.share) * f64::from(own_share) / f64::from(EVEN).powi(2);
        Some((
            progress,
            Way {
                queue,
                shorter,
                share,
            },
        ))
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
        let is_strained = self.queue >= 2 * QUEUE_LOW_MAX || self.loss > other.loss + LOSS_STEP;
        is_strained && other.queue <= QUEUE_LOW_MAX && other.loss <= self.loss
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
    fn get(&self, now: Time) -> Option<i64> {
        let both = self.present.into_iter().chain(self.former);
        both.map(|least| risen(least, now)).min()
    }

    /// Takes in a value; the least one of late.
    fn update(&mut self, value: i64, now: Time) -> i64 {
        if now.since(self.since) >= WINDOW {
            self.former = self.present.take();
            self.since = now;
        }
        if self.present.is_none_or(|least| value <= risen(least, now)) {
            self.present = Some((value, now));
        }
        self.get(now).unwrap_or(value)
    }
}

fn risen((value, at): (i64, Time), now: Time) -> i64 {
    let drift = now.since(at).as_micros() * CLOCK_RATES_PPM / 1_000_000;
    value.saturating_add(i64::try_from(drift).unwrap_or(i64::MAX))
}

/// What takes longer is an error of a peer.
const ROUND_TRIP_MAX: Duration = Duration::from_secs(10);
/// How long the least time on the way is remembered, once or twice: clocks drift, and routes change.
const WINDOW: Duration = Duration::from_secs(10);
/// What the rates of two clocks differ by, at most: each is specified within 100 parts of a million.
const CLOCK_RATES_PPM: u128 = 200;
/// Reports come every 50 ms while there is enough to report.
const STRAIN_LASTS: Duration = Duration::from_millis(500);

#[cfg(test)]
mod tests {
    use super::*;

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
            share: 1_000,
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
            share: 1_000,
        };
        let mut reporter = Reporter::new(report(1, 1_000), Time(0));
        let mut queue = |number, delay_us, s: u64| {
            let at = Time(s * 1_000_000_000);
            let heard = reporter.handle_report(&report(number, delay_us), EVEN, at);
            let way = heard.unwrap().1;
            (way.queue.as_micros(), way.shorter.as_micros())
        };
        assert_eq!(queue(2, 1_400, 1), (200, 0), "0.2 ms may be the clocks'");
        assert_eq!(queue(3, 800, 2), (0, 600), "below what it may be by now");
        assert_eq!(queue(4, u32::MAX - 99, 3), (0, 1_100), "below zero");
        assert_eq!(queue(5, 900, 4), (800, 0));
        // Forgotten after twenty seconds.
        assert_eq!(queue(6, 5_100, 15), (2_800, 0));
        assert_eq!(queue(7, 9_300, 26).0, 4_200 - 2_200);
    }
}
