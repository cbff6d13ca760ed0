//! Rounds in which everything that is compared takes its turn, and what is told of them.

use anyhow::Result;

/// What one turn measured, in the order in which the line's rows show it.
pub(crate) type Turn<'a> = &'a mut dyn FnMut() -> Result<Vec<f64>>;

/// The figures of a line: for each round, for each contender, what its turn measured.
pub(crate) struct Contest {
    rounds: Vec<Vec<Vec<f64>>>,
}

impl Contest {
    /// Lets the contenders take turns, so that a load that comes and goes meets all of them.
    pub(crate) fn run(rounds: usize, contenders: &mut [Turn<'_>]) -> Result<Self> {
        let mut contest = Self { rounds: Vec::new() };
        for _ in 0..rounds {
            let round = contenders
                .iter_mut()
                .map(|turn| turn())
                .collect::<Result<_>>()?;
            contest.rounds.push(round);
        }
        Ok(contest)
    }

    /// What two have measured in turns.
    pub(crate) fn of(rounds: impl Iterator<Item = (Vec<f64>, Vec<f64>)>) -> Self {
        Self {
            rounds: rounds.map(|(ours, theirs)| vec![ours, theirs]).collect(),
        }
    }

    /// Median over the rounds of one contender's figure.
    pub(crate) fn figure(&self, contender: usize, figure: usize) -> f64 {
        median(self.rounds.iter().map(|round| round[contender][figure]))
    }

    /// Median over the rounds of the ratio of the first contender to another, each pair from one round.
    pub(crate) fn ratio(&self, other: usize, figure: usize) -> f64 {
        median(
            self.rounds
                .iter()
                .map(|round| round[0][figure] / round[other][figure]),
        )
    }
}

/// Half and 99 of 100 latencies are at most this, nanoseconds. The first tenth warms caches and is left out.
pub(crate) fn p50_p99(mut latencies: Vec<u64>) -> Vec<f64> {
    latencies.drain(..latencies.len() / 10);
    latencies.sort_unstable();
    [50, 99]
        .map(|percent| {
            latencies
                .get(latencies.len() * percent / 100)
                .map_or(f64::NAN, |&ns| ns as f64)
        })
        .to_vec()
}

/// The middle value; not a number when there is none.
pub(crate) fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.collect();
    values.sort_unstable_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(f64::NAN)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_ratio_is_of_pairs_and_not_of_medians() {
        let (mut ours, mut theirs) = ([10.0, 2.0, 30.0].into_iter(), [5.0, 1.0, 3.0].into_iter());

        let contest = Contest::run(
            3,
            &mut [&mut || Ok(ours.by_ref().take(1).collect()), &mut || {
                Ok(theirs.by_ref().take(1).collect())
            }],
        )
        .unwrap();

        assert_eq!(contest.figure(0, 0), 10.0);
        assert_eq!(contest.figure(1, 0), 3.0);
        assert_eq!(contest.ratio(1, 0), 2.0);
    }

    #[test]
    fn the_warm_up_is_not_counted() {
        let latencies: Vec<u64> = [1_000_000; 10].into_iter().chain(1..=90).collect();

        assert_eq!(p50_p99(latencies), [46.0, 90.0]);
    }
}
