//! What a reader has read, as it tells the daemon in its cell: the last hop of an item's books.

use serde::{Deserialize, Serialize};

use crate::ring::BOOK_WORDS;

/// What became of the samples of an item on their way from the ring to one reader, by the reader's own word.
///
/// `expected` is counted by the numbers of the samples, all else as each of them is passed; they balance when it is the sum
/// of the others. A reader that only ever takes the present value counts nothing.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct ReaderBooks {
    /// Position of the sample that was read last.
    pub pos: u64,
    /// Samples from the first one read to the last, over all epochs.
    pub expected: u64,
    /// Read.
    pub delivered: u64,
    /// Gave way to newer ones, here or at their host, before they were read.
    pub overwritten: u64,
    /// Left out because of what was asked for, or because a link is slower than the writer.
    pub filtered: u64,
    /// Never reached this host.
    pub lost: u64,
}

impl ReaderBooks {
    /// Samples that are accounted for.
    pub fn accounted(&self) -> u64 {
        [self.delivered, self.overwritten, self.filtered, self.lost]
            .into_iter()
            .fold(0, u64::saturating_add)
    }

    #[inline]
    pub(super) fn to_words(self) -> [u64; BOOK_WORDS] {
        let words = self.words();
        let [pos, expected, delivered, overwritten, filtered, lost] = words;
        [
            pos,
            expected,
            delivered,
            overwritten,
            filtered,
            lost,
            seal(&words),
        ]
    }

    pub(super) fn from_words(words: &[u64; BOOK_WORDS]) -> Option<Self> {
        let [
            pos,
            expected,
            delivered,
            overwritten,
            filtered,
            lost,
            sealed,
        ] = *words;
        let books = Self {
            pos,
            expected,
            delivered,
            overwritten,
            filtered,
            lost,
        };
        (seal(&books.words()) == sealed).then_some(books)
    }

    #[inline]
    fn words(&self) -> [u64; BOOK_WORDS - 1] {
        [
            self.pos,
            self.expected,
            self.delivered,
            self.overwritten,
            self.filtered,
            self.lost,
        ]
    }
}

/// Tells words of one moment from those of two, without any order between the stores of one process and the loads of
/// another. Counts of neighbouring moments differ in their lowest bits, which are kept apart here. Of zeros it is zero.
#[inline]
fn seal(words: &[u64; BOOK_WORDS - 1]) -> u64 {
    words
        .iter()
        .fold(0_u64, |seal, word| seal.rotate_left(10) ^ word)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn books_of_one_moment_are_told_from_a_mixture_of_two() {
        let before = ReaderBooks {
            pos: 40,
            expected: 40,
            delivered: 33,
            overwritten: 4,
            filtered: 2,
            lost: 1,
        };
        let after = ReaderBooks {
            pos: 45,
            expected: 45,
            delivered: 34,
            overwritten: 8,
            ..before
        };
        assert_eq!(before.accounted(), before.expected);
        let (old, new) = (before.to_words(), after.to_words());
        let changed: Vec<usize> = (0..BOOK_WORDS).filter(|at| old[*at] != new[*at]).collect();
        for mixture in 0..1_u32 << changed.len() {
            let mut words = old;
            for (bit, at) in changed.iter().enumerate() {
                if mixture & 1 << bit != 0 {
                    words[*at] = new[*at];
                }
            }
            let whole = words == old || words == new;
            assert_eq!(
                ReaderBooks::from_words(&words).is_some(),
                whole,
                "{words:?}"
            );
        }
        let nothing = ReaderBooks::from_words(&[0; BOOK_WORDS]);
        assert_eq!(nothing, Some(ReaderBooks::default()));
    }
}
