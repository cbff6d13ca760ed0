//! How well samples reach one host, by unicast and by each group, from its reports.

use std::collections::BTreeMap;
use std::time::Duration;

use ddx_wire::Time;
use ddx_wire::message::ReportEntry;

use crate::delivery::Progress;

/// What a host's reports say.
#[derive(Debug, Default)]
pub(super) struct Quality {
    paths: BTreeMap<u16, Loss>,
    /// Groups that do not reach it well, and until when that is believed.
    shunned: BTreeMap<u16, Shunned>,
}

#[derive(Debug)]
struct Loss {
    last: ReportEntry,
    /// Share of datagrams lost, of late.
    share: f64,
    /// Datagrams that the share is known from, up to a bound.
    weight: f64,
}

#[derive(Debug)]
struct Shunned {
    until: Time,
    pause: Duration,
    /// Shares of datagrams lost by the group and by unicast when it was given up.
    losses: (f64, f64),
}

impl Quality {
    /// Takes in a report; whether it turned the host away from a group.
    pub(super) fn handle_report(&mut self, report: &ReportEntry, now: Time) -> bool {
        let path = report.path;
        if self.paths.len() >= PATHS && !self.paths.contains_key(&path) {
            return false;
        }
        if !self.admits(path, now) {
            // What was still on its way when the group was given up says nothing about the next trial.
            self.paths.remove(&path);
            return false;
        }
        let loss = self.paths.entry(path).or_insert_with(|| Loss {
            last: *report,
            share: 0.0,
            weight: 0.0,
        });
        let progress = Progress::between(&loss.last, report);
        loss.last = *report;
        let Some(progress) = progress else {
            return false;
        };
        let all = f64::from(progress.received) + f64::from(progress.missing);
        let share = f64::from(progress.missing) / all.max(1.0);
        loss.weight = (loss.weight + all).min(WEIGHT);
        loss.share += (share - loss.share) * (all / loss.weight).min(1.0);
        let (share, weight) = (loss.share, loss.weight);
        let unicast = self.unicast_loss();
        if path > GROUPS || weight < WEIGHT_MIN || !self.is_worse(share, weight) {
            return false;
        }
        let shunned = self.shunned.entry(path).or_insert(Shunned {
            until: now,
            pause: PAUSE_FIRST / 2,
            losses: (0.0, 0.0),
        });
        // Each trial that fails makes the next one wait longer.
        let is_new = now.since(shunned.until) > 4 * shunned.pause + PAUSE_FIRST;
        shunned.pause = if is_new {
            PAUSE_FIRST
        } else {
            (shunned.pause * 2).min(PAUSE_MAX)
        };
        shunned.until = now + shunned.pause;
        shunned.losses = (share, unicast);
        // The next trial begins without a memory.
        self.paths.remove(&path);
        true
    }

    /// Whether a group is to be tried, or used.
    pub(super) fn admits(&self, path: u16, now: Time) -> bool {
        self.shunned.get(&path).is_none_or(|s| s.until <= now)
    }

    /// Whether a group that loses this share of so many datagrams loses more than unicast, and not by chance.
    fn is_worse(&self, share: f64, weight: f64) -> bool {
        let chance = (LOSS_HOPELESS * (1.0 - LOSS_HOPELESS) / weight).sqrt();
        if share > LOSS_HOPELESS + DEVIATIONS * chance {
            // Perhaps it fills the way of this host, which then loses by unicast too, but would not without it.
            return true;
        }
        let unicast = self.paths.iter().filter(|(path, _)| **path > GROUPS);
        let known = unicast.map(|(_, loss)| (loss.share, loss.weight));
        let best = known.max_by(|a, b| a.1.total_cmp(&b.1)).unwrap_or_default();
        // Of what is not known the best is believed, on little evidence.
        let (other, others) = (best.0, best.1.max(WEIGHT_MIN));
        let both = (share * weight + other * others) / (weight + others);
        let deviation = (both * (1.0 - both) * (1.0 / weight + 1.0 / others)).sqrt();
        share > other + LOSS_MORE + DEVIATIONS * deviation
    }

    /// Of a group that is left alone, or was: the shares of datagrams lost by it and by unicast when it was given up.
    pub(super) fn shunned(&self, path: u16) -> Option<(f64, f64)> {
        self.shunned.get(&path).map(|shunned| shunned.losses)
    }

    /// Share of datagrams lost on the way by unicast.
    pub(super) fn unicast_loss(&self) -> f64 {
        let unicast = self.paths.iter().filter(|(path, _)| **path > GROUPS);
        unicast.map(|(_, loss)| loss.share).fold(0.0, f64::max)
    }

    /// Share of datagrams of a group lost, if it is known.
    pub(super) fn group_loss(&self, path: u16) -> Option<f64> {
        self.paths.get(&path).map(|loss| loss.share)
    }
}

/// Numbers of groups end here.
const GROUPS: u16 = 16;
/// Paths of one host that are remembered.
const PATHS: usize = 64;
/// Datagrams that a share is known from at most: what was before fades.
const WEIGHT: f64 = 100.0;
/// Datagrams below which a share says nothing.
const WEIGHT_MIN: f64 = 12.0;
/// A group that loses so much more than unicast is not used: what unicast costs more is less than what repairs would.
const LOSS_MORE: f64 = 0.05;
/// A group that loses so much is not used, whatever unicast loses: that finds the rate which this one host can take.
const LOSS_HOPELESS: f64 = 0.5;
/// Standard deviations beyond which a difference is not taken for chance.
const DEVIATIONS: f64 = 3.0;
/// How long a group that failed is left alone at first.
const PAUSE_FIRST: Duration = Duration::from_secs(5);
/// How long it is left alone at most.
const PAUSE_MAX: Duration = Duration::from_secs(60);

#[cfg(test)]
mod tests {
    use super::*;

    fn report(path: u16, highest: u32, received: u32) -> ReportEntry {
        ReportEntry {
            path,
            highest,
            received,
            bytes: received * 100,
            delay_us: 0,
            at_us: highest * 1_000,
            longest: 100,
            share: 1_000,
        }
    }

    #[test]
    fn a_group_that_loses_is_left_alone_for_a_while() {
        let mut quality = Quality::default();
        let mut now = Time(1_000_000_000);
        let mut pauses = Vec::new();
        for round in 0..3_u32 {
            let from = round * 1_000;
            quality.handle_report(&report(3, from + 1, from + 1), now);
            assert!(quality.admits(3, now));
            assert!(quality.handle_report(&report(3, from + 201, from + 81), now));
            assert!(!quality.admits(3, now));
            let before = now;
            while !quality.admits(3, now) {
                now = now + Duration::from_millis(100);
            }
            pauses.push(now.since(before).as_secs());
        }
        assert_eq!(pauses, [5, 10, 20]);
    }

    #[test]
    fn what_was_under_way_when_a_group_was_given_up_is_not_held_against_it() {
        let mut quality = Quality::default();
        let mut now = Time(1_000_000_000);
        quality.handle_report(&report(3, 1, 1), now);
        assert!(quality.handle_report(&report(3, 101, 41), now));
        // Much of what was sent before that is lost too, and told late.
        now = now + Duration::from_millis(50);
        assert!(!quality.handle_report(&report(3, 120, 45), now));
        now = now + PAUSE_FIRST;
        assert!(quality.admits(3, now));
        assert!(!quality.handle_report(&report(3, 301, 46), now));
        assert!(!quality.handle_report(&report(3, 401, 145), now));
        assert!(quality.admits(3, now));
    }

    #[test]
    fn chance_does_not_end_a_group_that_loses_one_in_three_as_unicast_does_or_may() {
        let mut rng = crate::rng::Rng::new(5);
        for paths in [vec![3, 100], vec![3]] {
            let mut quality = Quality::default();
            let mut counts = vec![(1, 1); paths.len()];
            for step in 0..100_000 {
                for (path, (highest, received)) in paths.iter().zip(&mut counts) {
                    *highest += 5;
                    *received += (0..5).map(|_| u32::from(rng.below(3) > 0)).sum::<u32>();
                    let report = report(*path, *highest, *received);
                    let is_worse = quality.handle_report(&report, Time(step));
                    assert!(!is_worse, "{paths:?} after {step} reports");
                }
            }
        }
    }

    #[test]
    fn a_radio_that_loses_by_unicast_too_keeps_its_group() {
        let mut quality = Quality::default();
        let now = Time(1_000_000_000);
        for path in [40, 3] {
            quality.handle_report(&report(path, 1, 1), now);
            assert!(
                !quality.handle_report(&report(path, 101, 68), now),
                "{path}"
            );
        }
        assert!(quality.admits(3, now));
    }
}
