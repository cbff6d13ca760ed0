//! What is measured.

use std::time::Duration;

/// Sizes of samples, bytes.
pub(crate) const SIZES: [usize; 5] = [64, 1_400, 8_192, 65_536, 1_048_576];

/// One condition under which samples are sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct Cell {
    /// Subscribers, each on a host of its own.
    pub(crate) subscribers: usize,
    /// Of a hundred packets to and from each subscriber's host.
    pub(crate) loss_percent: u8,
    /// Bytes of a sample.
    pub(crate) size: usize,
    /// How fast.
    pub(crate) pace: Pace,
}

/// How fast samples are written.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Pace {
    /// A thousand a second, large ones a hundred: for latency.
    Steady,
    /// Without pause.
    Max,
}

/// All cells of a run, and how long each takes.
pub(crate) struct Plan {
    /// In the order in which they are measured: loss only grows, so that what a lossy link has done to a connection does
    /// not spoil the next cell.
    pub(crate) cells: Vec<Cell>,
    /// Sizes among the cells.
    pub(crate) sizes: Vec<usize>,
    /// Samples are sent so long before they count.
    pub(crate) warm: Duration,
    /// And so long they count; twice as long where much is lost and connections wait for their timers.
    pub(crate) span: Duration,
    /// How long after its last sample a cell waits for it.
    pub(crate) grace: Duration,
    /// Until hosts that have nothing to say are quiet, and how long they are watched.
    pub(crate) settle: Duration,
    pub(crate) idle: Duration,
    /// How long a link is cut; none if that is not measured.
    pub(crate) cut: Option<Duration>,
}

impl Cell {
    /// Samples a second; none is without pause.
    pub(crate) fn rate(&self) -> Option<f64> {
        match self.pace {
            Pace::Steady if self.size > LARGE => Some(100.0),
            Pace::Steady => Some(1_000.0),
            Pace::Max => None,
        }
    }
}

impl Plan {
    /// Everything, within about a minute for each contender and round.
    pub(crate) fn full(sizes: &[usize]) -> Self {
        Self {
            cells: cells(&[(1, &[0, 1, 10, 33]), (4, &[0, 10])], sizes),
            sizes: sizes.to_vec(),
            warm: Duration::from_millis(80),
            span: Duration::from_millis(240),
            grace: Duration::from_millis(120),
            settle: Duration::from_secs(4),
            // Some speak each 8 s.
            idle: Duration::from_secs(10),
            cut: Some(Duration::from_secs(5)),
        }
    }

    /// Enough to see that all gives figures.
    pub(crate) fn smoke() -> Self {
        let sizes = [64, 8_192];
        Self {
            cells: cells(&[(1, &[0, 10]), (4, &[0])], &sizes),
            sizes: sizes.to_vec(),
            settle: Duration::from_secs(1),
            idle: Duration::from_secs(1),
            cut: None,
            ..Self::full(&sizes)
        }
    }

    /// How long the samples of a cell count.
    pub(crate) fn span_of(&self, cell: &Cell) -> Duration {
        self.span * if cell.loss_percent < 10 { 1 } else { 2 }
    }

    /// How many subscribers there are in some cell.
    pub(crate) fn fans(&self) -> Vec<usize> {
        let mut fans: Vec<usize> = self.cells.iter().map(|cell| cell.subscribers).collect();
        fans.dedup();
        fans
    }
}

fn cells(fans: &[(usize, &[u8])], sizes: &[usize]) -> Vec<Cell> {
    let mut cells = Vec::new();
    for &(subscribers, losses) in fans {
        for &loss_percent in losses {
            for &size in sizes {
                for pace in [Pace::Steady, Pace::Max] {
                    cells.push(Cell {
                        subscribers,
                        loss_percent,
                        size,
                        pace,
                    });
                }
            }
        }
    }
    cells
}

/// Samples above this are a hundred a second, which is 100 MB/s at 1 MiB.
const LARGE: usize = 256 << 10;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn loss_only_grows_while_the_subscribers_stay() {
        let plan = Plan::full(&SIZES);

        assert_eq!(plan.fans(), [1, 4]);
        for pair in plan.cells.windows(2) {
            let same = pair[0].subscribers == pair[1].subscribers;
            assert!(!same || pair[0].loss_percent <= pair[1].loss_percent);
        }
    }
}
