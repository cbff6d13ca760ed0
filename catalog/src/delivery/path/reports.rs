//! What a path learns from how its datagrams arrive, and what it had no room for.

use std::collections::BTreeSet;
use std::time::Duration;

use ddx_wire::message::ReportEntry;
use ddx_wire::{StreamId, Tag, Time};

use super::super::flow::Flow;
use super::super::queue::Queue;
use super::super::reporter::Reporter;
use super::super::transfer::Flight;
use super::Path;

impl<P: AsRef<[u8]> + Clone> Path<P> {
    /// What may still be on its way: it left less than until it is reported ago, with the time that its own and one more
    /// datagram take, and no later one was reported by all.
    pub(super) fn flight(&self) -> Flight {
        let bytes = u64::try_from(2 * self.datagram_bytes).unwrap_or(u64::MAX);
        let micros = bytes.saturating_mul(1_000_000) / self.congestion.rate().max(1);
        let reported = self.reporters.values().filter_map(Reporter::round_trip);
        let reported = reported.max().unwrap_or(self.round_trip);
        let seen = self.reporters.values().map(|reporter| reporter.seen).min();
        Flight {
            // What piled up may have doubled since.
            time: reported + self.congestion.queue() + Duration::from_micros(micros),
            seen: seen.flatten().map(|seen| seen - REORDERING),
        }
    }

    /// Notes when a batch leaves.
    pub(super) fn note_departure(&mut self, now: Time) {
        if self
            .departures
            .back()
            .is_some_and(|(_, at)| now < *at + DEPARTURES_PAUSE)
        {
            return;
        }
        if self.departures.len() == DEPARTURES {
            self.departures.pop_front();
        }
        self.departures.push_back((self.datagrams, now));
    }

    /// When the last of the noted datagrams left that is not later than this one.
    fn departed(&self, number: u32) -> Option<Time> {
        let departures = self.departures.iter().rev();
        let mut earlier = departures.skip_while(|(at, _)| number.wrapping_sub(*at) >= 1 << 31);
        earlier.next().map(|(_, at)| *at)
    }

    /// Takes in how datagrams arrive. `own_share` is what the path has of this host's link, in thousandths of the mean of its
    /// paths.
    pub(in crate::delivery) fn handle_report(
        &mut self,
        from: Tag,
        report: &ReportEntry,
        own_share: u16,
        now: Time,
    ) {
        self.unreported_bytes = 0;
        let departed = self.departed(report.highest);
        let Some(reporter) = self.reporters.get_mut(&from) else {
            self.reporters.insert(from, Reporter::new(*report, now));
            if self.is_group() {
                // Perhaps it is behind a link for shorter ones.
                self.datagram_bytes = self.datagram_bytes.min(self.datagram_bytes_safe);
                (self.probe_at, self.probes) = (now, 0);
            }
            self.lengthen();
            return;
        };
        reporter.seen = reporter.seen.max(departed);
        let told = reporter.handle_report(report, own_share, now);
        let round_trip = reporter.round_trip();
        self.lengthen();
        if let Some((progress, way)) = told {
            let round_trip = round_trip.unwrap_or(self.round_trip + way.queue);
            if self.is_slow_for_one(from, now) {
                return;
            }
            let used = self.pace.take_used(now);
            let sent = self.datagrams;
            self.congestion
                .set_watchful(self.flows.values().any(Flow::is_command));
            self.congestion
                .handle_report(&progress, way, used, round_trip, sent, now);
        }
    }

    /// Uses datagrams as long as all who report have got.
    fn lengthen(&mut self) {
        let longest = self.reporters.values().map(Reporter::longest).min();
        let longest = longest.unwrap_or_default().min(self.datagram_bytes_max);
        self.datagram_bytes = self.datagram_bytes.max(longest);
    }

    /// Whether one member of a group is behind a slower link than another: it is to leave the group, which loses too much for
    /// it, and not to slow the others down.
    fn is_slow_for_one(&self, one: Tag, now: Time) -> bool {
        let strain = self.reporters.get(&one).and_then(|r| r.strain(now));
        let others = self.reporters.iter().filter(|(tag, _)| **tag != one);
        let mut others = others.filter_map(|(_, reporter)| reporter.strain(now));
        strain.is_some_and(|strain| others.any(|other| strain.is_not_shared_by(&other)))
    }

    /// Records that found no room in their lane.
    pub(in crate::delivery) fn dropped_records(&self) -> u64 {
        self.lanes.iter().map(Queue::dropped).sum()
    }

    /// Requests for repair of a stream that found no room.
    pub(in crate::delivery) fn dropped_requests(&self, stream: StreamId) -> u64 {
        self.flows.get(&stream).map_or(0, Flow::dropped_gaps)
    }

    /// Forgets the reports of readers that are gone.
    pub(in crate::delivery) fn keep_readers(&mut self, keep: &BTreeSet<Tag>) {
        self.reporters.retain(|reader, _| keep.contains(reader));
    }
}

/// Least time between two noted departures, and how many are remembered: the longest round trip lies between.
const DEPARTURES_PAUSE: Duration = Duration::from_millis(1);
const DEPARTURES: usize = 1_024;
/// What left later may come so much earlier.
const REORDERING: Duration = Duration::from_millis(5);
