//! Which counters of a lane were seen: a sliding window of the last 2,048.

/// Remembers the newest counter and, below it, each of the last [`WINDOW`].
#[derive(Clone, Copy, Debug)]
pub(crate) struct ReplayWindow {
    /// One above the newest counter seen; 0 before the first.
    next: u64,
    /// Bit `counter % WINDOW` tells whether that counter of the window was seen.
    seen: [u64; WORDS],
}

impl ReplayWindow {
    /// Tells whether a counter was seen, or is too old to tell, which counts as seen.
    pub(crate) fn seen(&self, counter: u64) -> bool {
        if counter >= self.next {
            return false;
        }
        let too_old = counter < self.next.saturating_sub(WINDOW);
        too_old || self.word(counter) & bit(counter) != 0
    }

    /// Notes a counter that is not [`ReplayWindow::seen`].
    pub(crate) fn mark(&mut self, counter: u64) {
        if counter >= self.next {
            if counter.saturating_sub(self.next) >= WINDOW {
                self.seen = [0; WORDS];
            } else {
                (self.next..counter).for_each(|skipped| self.set(skipped, false));
            }
            self.next = counter.saturating_add(1);
        }
        self.set(counter, true);
    }

    fn word(&self, counter: u64) -> u64 {
        self.seen.get(word_index(counter)).copied().unwrap_or(0)
    }

    fn set(&mut self, counter: u64, seen: bool) {
        if let Some(word) = self.seen.get_mut(word_index(counter)) {
            *word = if seen {
                *word | bit(counter)
            } else {
                *word & !bit(counter)
            };
        }
    }
}

impl Default for ReplayWindow {
    fn default() -> Self {
        Self {
            next: 0,
            seen: [0; WORDS],
        }
    }
}

fn word_index(counter: u64) -> usize {
    usize::try_from((counter % WINDOW) / 64).unwrap_or(0)
}

fn bit(counter: u64) -> u64 {
    1 << (counter % 64)
}

/// Counters that may arrive out of order: some 2.4 MB of full datagrams.
const WINDOW: u64 = 2_048;
const WORDS: usize = 32;

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use proptest::prelude::*;

    use super::*;

    #[test]
    fn edge_of_the_window() {
        let mut window = ReplayWindow::default();
        window.mark(WINDOW);
        assert!(window.seen(0));
        assert!(!window.seen(1));
        window.mark(1);
        assert!(window.seen(1));
        assert!(window.seen(WINDOW));
        assert!(!window.seen(WINDOW + 1));
    }

    #[test]
    fn greatest_counter_is_safe() {
        let mut window = ReplayWindow::default();
        window.mark(u64::MAX - 1);
        assert!(window.seen(u64::MAX - 1));
        assert!(!window.seen(u64::MAX - 2));
        assert!(window.seen(5));
    }

    proptest! {
        #[test]
        fn agrees_with_a_plain_set(steps in prop::collection::vec((0..4_u64, 0..6_000_u64), 1..400)) {
            let mut window = ReplayWindow::default();
            let mut model = BTreeSet::new();
            let mut base = 0;
            for (advance, offset) in steps {
                base += advance * 300;
                let counter = base.saturating_sub(offset % 3_000);
                let newest = model.last().copied();
                let expected = model.contains(&counter)
                    || newest.is_some_and(|newest: u64| counter + WINDOW <= newest);
                prop_assert_eq!(window.seen(counter), expected);
                if !expected {
                    window.mark(counter);
                    model.insert(counter);
                }
            }
        }
    }
}
