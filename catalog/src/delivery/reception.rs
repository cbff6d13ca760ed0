//! How datagrams arrive, path by path: what their senders are told.

use std::collections::BTreeMap;
use std::time::Duration;

use ddx_wire::message::ReportEntry;
use ddx_wire::sample::Preamble;
use ddx_wire::{Tag, Time};

use super::deadlines::Deadlines;
use super::shares::Shares;

/// Counts and times of all paths that end here.
#[derive(Debug)]
pub(super) struct Reception {
    paths: BTreeMap<(Tag, u16), Path>,
    due: Deadlines<(Tag, u16)>,
    shares: Shares<Tag>,
}

#[derive(Debug)]
struct Path {
    report: ReportEntry,
    /// Least time on the way since the last report, of long datagrams and of others.
    least: Option<u32>,
    least_short: Option<u32>,
    /// Length of long ones, and when one last came: on a slow link the length takes time, so that only like is compared.
    long: usize,
    long_at: Time,
    reported: Time,
    last: Time,
    /// Since the last report.
    datagrams: u32,
    bytes: usize,
}

impl Reception {
    pub(super) fn new() -> Self {
        Self {
            paths: BTreeMap::new(),
            due: Deadlines::new(),
            shares: Shares::new(Time(0)),
        }
    }

    /// Notes a datagram. Those of a sender's paths beyond the limit are not reported: then it is false.
    pub(super) fn note(&mut self, tag: Tag, preamble: &Preamble, len: usize, now: Time) -> bool {
        self.shares.note(tag, len, preamble.is_limited, now);
        let at = (tag, preamble.path);
        if !self.paths.contains_key(&at) && self.of(tag).count() >= PATHS {
            return false;
        }
        let path = self.paths.entry(at).or_insert_with(|| Path {
            report: ReportEntry {
                path: preamble.path,
                highest: preamble.number,
                received: 0,
                bytes: 0,
                delay_us: 0,
                at_us: 0,
                longest: 0,
                share: 0,
            },
            least: None,
            least_short: None,
            long: len,
            long_at: now,
            reported: now,
            last: now,
            datagrams: 0,
            bytes: 0,
        });
        // Also the first after a pause: the sender may have taken the path for cut.
        let is_first = path.report.received == 0 || now.since(path.last) >= SILENCE;
        path.last = now;
        let report = &mut path.report;
        if preamble.number.wrapping_sub(report.highest) < 1 << 31 {
            report.highest = preamble.number;
        }
        report.received = report.received.wrapping_add(1);
        let bytes = u32::try_from(len).unwrap_or(u32::MAX);
        report.bytes = report.bytes.wrapping_add(bytes);
        report.longest = report.longest.max(u16::try_from(len).unwrap_or(u16::MAX));
        let delay = micros(now).wrapping_sub(preamble.sent_us);
        if 8 * path.long < 7 * len {
            // Those until now were short ones.
            path.least = None;
        }
        if len >= path.long || now.since(path.long_at) >= LONG {
            path.long = len;
        }
        let is_long = len >= LONG_BYTES || 8 * len >= 7 * path.long;
        if is_long {
            path.long_at = now;
        }
        let least = if is_long {
            &mut path.least
        } else {
            &mut path.least_short
        };
        let least = least.get_or_insert(delay);
        if delay.wrapping_sub(*least).cast_signed() < 0 {
            *least = delay;
        }
        path.datagrams += 1;
        path.bytes += len;
        if path.bytes >= WORTH_BYTES || is_first {
            let pause = match path.datagrams {
                _ if is_first => Duration::ZERO,
                0..MANY => PAUSE,
                _ => PAUSE_MANY,
            };
            self.due.set_earlier(at, (path.reported + pause).max(now));
        }
        true
    }

    pub(super) fn deadline(&self) -> Option<Time> {
        self.due.first()
    }

    /// The next report that is due.
    pub(super) fn report(&mut self, now: Time) -> Option<(Tag, ReportEntry)> {
        let at = self.due.pop(now)?;
        let path = self.paths.get_mut(&at)?;
        path.reported = now;
        (path.datagrams, path.bytes) = (0, 0);
        let before = path.report.delay_us;
        let short = path.least_short.take();
        // What takes a short one longer than a long one before waited.
        let grown = short.filter(|delay| delay.wrapping_sub(before).cast_signed() > 0);
        path.report.delay_us = path.least.take().or(grown).unwrap_or(before);
        path.report.at_us = micros(now);
        path.report.share = self.shares.of(at.0, now);
        Some((at.0, path.report))
    }

    /// Forgets the paths of a life that ended.
    pub(super) fn forget(&mut self, tag: Tag) {
        let paths: Vec<_> = self.of(tag).collect();
        for path in paths {
            self.paths.remove(&path);
            self.due.clear(path);
        }
        self.shares.forget(tag);
    }

    fn of(&self, tag: Tag) -> impl Iterator<Item = (Tag, u16)> {
        let paths = self.paths.range((tag, 0)..=(tag, u16::MAX));
        paths.map(|(at, _)| *at)
    }
}

fn micros(now: Time) -> u32 {
    let micros = now.0 / 1_000;
    u32::try_from(micros & u64::from(u32::MAX)).unwrap_or_default()
}

/// Paths of one sender: its groups, and a unicast one for each address that this host had. One takes 200 B at most.
const PATHS: usize = 64;
/// `PROTOCOL.md#reports`: bytes that are worth a report.
const WORTH_BYTES: usize = 2_048;
/// `PROTOCOL.md#reports`: least time between two reports of a path.
const PAUSE: Duration = Duration::from_millis(50);
/// The same while much arrives.
const PAUSE_MANY: Duration = Duration::from_millis(5);
/// A pause that is reported as over.
const SILENCE: Duration = Duration::from_millis(400);
/// What is long in any case: one that only tries a length must not hide those of the length in use.
const LONG_BYTES: usize = 1_000;
/// How long the length of long datagrams is remembered.
const LONG: Duration = Duration::from_secs(10);
/// Datagrams that are much.
const MANY: u32 = 16;

#[cfg(test)]
mod tests {
    use super::*;

    const TAG: Tag = Tag(1);

    fn note(reception: &mut Reception, number: u32, sent_us: u32, len: usize, at_us: u64) {
        let preamble = Preamble {
            path: 7,
            number,
            sent_us,
            is_probe: false,
            is_limited: false,
        };
        reception.note(TAG, &preamble, len, Time(at_us * 1_000));
    }

    #[test]
    fn a_report_counts_what_came_and_the_least_delay() {
        let mut reception = Reception::new();
        note(&mut reception, 5, u32::MAX - 99, 1_000, 900);
        let (_, first) = reception.report(Time(900_000)).unwrap();
        assert_eq!(
            (first.highest, first.received, first.delay_us),
            (5, 1, 1_000)
        );
        for (number, delay) in [(6, 400), (9, 300), (7, 500)] {
            note(&mut reception, number, 1_000, 1_000, 1_000 + delay);
        }
        // Not before the pause is over.
        assert_eq!(reception.report(Time(2_000_000)), None);
        let at = reception.deadline().unwrap();
        assert_eq!(at, Time(900_000) + PAUSE);
        let (tag, report) = reception.report(at).unwrap();
        assert_eq!((tag, report.highest, report.received), (TAG, 9, 4));
        assert_eq!((report.bytes, report.delay_us), (4_000, 300));
        assert_eq!(report.longest, 1_000);
    }

    #[test]
    fn a_longer_one_that_came_once_does_not_hide_the_others() {
        let mut reception = Reception::new();
        note(&mut reception, 1, 0, 1_472, 900);
        assert_eq!(reception.report(Time(900_000)).unwrap().1.delay_us, 900);
        note(&mut reception, 2, 1_000, 1_200, 1_500);
        note(&mut reception, 3, 1_000, 1_200, 1_600);
        let at = reception.deadline().unwrap();
        assert_eq!(reception.report(at).unwrap().1.delay_us, 500);
    }

    #[test]
    fn paths_of_one_sender_are_few_and_more_are_said_to_be_too_many() {
        let mut reception = Reception::new();
        let mut note = |tag, path| {
            let preamble = Preamble {
                path,
                number: 1,
                sent_us: 0,
                is_probe: false,
                is_limited: false,
            };
            reception.note(tag, &preamble, 1_000, Time(1_000))
        };
        let reported = (0..1_000).filter(|path| note(TAG, *path)).count();
        assert_eq!(reported, PATHS);
        assert!(note(TAG, 3) && note(Tag(2), 1));
    }

    #[test]
    fn little_is_not_reported_and_a_life_is_forgotten() {
        let mut reception = Reception::new();
        note(&mut reception, 1, 0, 100, 10);
        reception.report(Time(10_000)).unwrap();
        for number in 2..20 {
            note(&mut reception, number, 0, 100, 20);
        }
        assert_eq!(reception.deadline(), None);
        note(&mut reception, 20, 0, 1_000, 20);
        assert!(reception.deadline().is_some());
        reception.forget(TAG);
        assert_eq!(reception.deadline(), None);
        assert!(reception.paths.is_empty());
    }
}
