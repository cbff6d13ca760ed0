//! When the frames of a source are due, and how well that was kept.

use std::time::Duration;

use ddx_wire::Time;

/// Tells when each frame is due, by deadlines that follow from the start alone: lateness of one is not handed on to the next.
#[derive(Clone, Debug)]
pub(crate) struct Schedule {
    start: Time,
    /// The time of a frame, in the recording's, at `start`.
    from: Duration,
    late_ns: Vec<u64>,
}

/// How late frames were, from the least to the most.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Lateness {
    pub(crate) p50: Duration,
    pub(crate) p99: Duration,
    pub(crate) max: Duration,
}

impl Schedule {
    /// Begins now with a frame of this time.
    pub(crate) fn new(start: Time, from: Duration) -> Self {
        Self {
            start,
            from,
            late_ns: Vec::new(),
        }
    }

    /// When a frame of this time is due.
    pub(crate) fn due(&self, at: Duration) -> Time {
        self.start + at.saturating_sub(self.from)
    }

    /// Notes when a frame that was due was published.
    pub(crate) fn note(&mut self, due: Time, published: Time) {
        let late = published.since(due);
        self.late_ns
            .push(u64::try_from(late.as_nanos()).unwrap_or(u64::MAX));
    }

    /// How late the frames were.
    pub(crate) fn lateness(mut self) -> Lateness {
        self.late_ns.sort_unstable();
        let at = |percent: usize| {
            let last = self.late_ns.len().saturating_sub(1);
            let ns = self.late_ns.get(last * percent / 100);
            Duration::from_nanos(ns.copied().unwrap_or_default())
        };
        Lateness {
            p50: at(50),
            p99: at(99),
            max: at(100),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_late_frame_does_not_make_the_next_one_late() {
        let second = Duration::from_secs(1);
        let mut schedule = Schedule::new(Time(1_000), second);
        assert_eq!(schedule.due(second), Time(1_000));
        assert_eq!(schedule.due(3 * second), Time(1_000) + 2 * second);
        for late in [0, 5, 1] {
            let due = schedule.due(2 * second);
            schedule.note(due, due + Duration::from_millis(late));
        }
        let lateness = schedule.lateness();
        assert_eq!(lateness.p50, Duration::from_millis(1));
        assert_eq!(lateness.max, Duration::from_millis(5));
    }
}
