//! Erasure codes over the field of 256 elements: parities that are sums of shards, each times an element of a Cauchy matrix,
//! of which every square part can be inverted (Blömer and others, "An XOR-Based Erasure-Resilient Coding Scheme", 1995).
//!
//! Nothing is prepared: the matrix is a formula, and what is inverted is as large as what is missing. A product with a whole
//! shard is a sum of its doubles, as the bits of the factor say; the compiler makes vectors of that.

/// Shards and parities of one code at most.
pub(super) const SHARDS_MAX: usize = 256;

/// `x^8 + x^4 + x^3 + x^2 + 1`, without its first term.
const POLYNOMIAL: u8 = 0x1d;

/// Doubles of a shard: it times 1, 2, 4, and so on.
#[derive(Default)]
struct Doubles([Vec<u8>; 8]);

/// Adds to the parities, which begin as zeros, what shards make of them: `parity(j)` is the sum of all `shards(i)` times
/// [`factor`]`(i, j)`. A shard that is shorter than a parity is as if it were filled with zeros.
pub(super) fn encode<'a>(shards: impl Iterator<Item = &'a [u8]>, parities: &mut [&mut [u8]]) {
    let mut doubles = Doubles::default();
    for (i, shard) in shards.enumerate() {
        doubles.of(shard);
        for (j, parity) in parities.iter_mut().enumerate() {
            doubles.add(factor(i, j), parity);
        }
    }
}

/// Makes the shards that are missing, each as long as a parity, of those that are there and as many parities as are missing:
/// `there` gives both with their numbers. `None` if there are fewer.
pub(super) fn restore(
    missing: &[usize],
    shards: &[(usize, &[u8])],
    parities: &[(usize, &[u8])],
) -> Option<Vec<Vec<u8>>> {
    let parities = parities.get(..missing.len())?;
    // What the parities are without the shards that are there.
    let mut sums: Vec<Vec<u8>> = parities.iter().map(|(_, p)| p.to_vec()).collect();
    let mut doubles = Doubles::default();
    for (i, shard) in shards {
        doubles.of(shard);
        for (sum, (j, _)) in sums.iter_mut().zip(parities) {
            doubles.add(factor(*i, *j), sum);
        }
    }
    let matrix = parities
        .iter()
        .map(|(j, _)| missing.iter().map(|i| factor(*i, *j)).collect());
    let inverse = invert(matrix.collect())?;
    let mut restored: Vec<Vec<u8>> = sums.iter().map(|sum| vec![0; sum.len()]).collect();
    for (column, sum) in sums.iter().enumerate() {
        doubles.of(sum);
        for (row, shard) in inverse.iter().zip(&mut restored) {
            doubles.add(row[column], shard);
        }
    }
    Some(restored)
}

/// The element of shard `i` and parity `j`: one over their difference, where shards are numbered from 0 up and parities from
/// 255 down.
fn factor(i: usize, j: usize) -> u8 {
    let (i, j) = (i.to_le_bytes()[0], j.to_le_bytes()[0]);
    INVERSES[usize::from(i ^ (255 - j))]
}

impl Doubles {
    fn of(&mut self, shard: &[u8]) {
        let [first, rest @ ..] = &mut self.0;
        first.clear();
        first.extend_from_slice(shard);
        let mut before: &[u8] = first;
        for next in rest {
            next.clear();
            next.extend(before.iter().map(|byte| double(*byte)));
            before = next;
        }
    }

    /// Adds the shard times an element.
    fn add(&self, element: u8, to: &mut [u8]) {
        for (bit, double) in self.0.iter().enumerate() {
            if element >> bit & 1 == 1 {
                for (to, byte) in to.iter_mut().zip(double) {
                    *to ^= byte;
                }
            }
        }
    }
}

const fn double(byte: u8) -> u8 {
    (byte << 1) ^ (POLYNOMIAL & 0_u8.wrapping_sub(byte >> 7))
}

const fn product(a: u8, mut b: u8) -> u8 {
    let (mut sum, mut bit) = (0, 0);
    while bit < 8 {
        if a >> bit & 1 == 1 {
            sum ^= b;
        }
        b = double(b);
        bit += 1;
    }
    sum
}

/// One over each element; of 0 it is 0.
static INVERSES: [u8; 256] = {
    let mut inverses = [0; 256];
    // Each power of 2 is one over the one that makes 255 with it, which is one.
    let mut powers = [1_u8; 256];
    let mut at = 1;
    while at < 256 {
        powers[at] = double(powers[at - 1]);
        at += 1;
    }
    let mut at = 0;
    while at < 256 {
        #[expect(clippy::as_conversions, reason = "an index in a constant")]
        let element = powers[at] as usize;
        inverses[element] = powers[255 - at];
        at += 1;
    }
    inverses
};

/// By elimination; rows are exchanged for none, as each part of a Cauchy matrix has an inverse of its own.
fn invert(mut matrix: Vec<Vec<u8>>) -> Option<Vec<Vec<u8>>> {
    let size = matrix.len();
    for (at, row) in matrix.iter_mut().enumerate() {
        row.extend((0..size).map(|column| u8::from(column == at)));
    }
    for at in 0..size {
        let one_over = INVERSES[usize::from(matrix[at][at])];
        if one_over == 0 {
            return None;
        }
        let pivot: Vec<u8> = matrix[at].iter().map(|e| product(*e, one_over)).collect();
        for (other, row) in matrix.iter_mut().enumerate() {
            let times = row[at];
            if other != at && times != 0 {
                for (element, of) in row.iter_mut().zip(&pivot) {
                    *element ^= product(times, *of);
                }
            }
        }
        matrix[at] = pivot;
    }
    for row in &mut matrix {
        row.drain(..size);
    }
    Some(matrix)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_element_has_an_inverse() {
        let inverse = |element: u8| INVERSES[usize::from(element)];
        for element in 1..=255 {
            assert_eq!(product(element, inverse(element)), 1, "{element}");
        }
        assert_eq!(inverse(0), 0);
        assert_eq!(product(0x80, 2), POLYNOMIAL);
        assert_eq!(product(0x53, 0xca), product(0xca, 0x53));
    }

    /// What `PROTOCOL.md` says, by hand.
    #[test]
    fn a_parity_is_what_the_protocol_says() {
        let mut parity = [0; 2];
        encode([&[1, 2][..], &[3]].into_iter(), &mut [&mut parity]);
        // One over 255, and one over 254.
        let (a, b) = (INVERSES[255], INVERSES[254]);
        assert_eq!(parity, [a ^ product(3, b), product(2, a)]);
        assert_eq!((a, b), (253, 126));
    }

    #[test]
    fn any_that_are_missing_are_restored_from_any_parities() {
        let mut state = 7_u32;
        let mut random = |below: usize| {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            usize::try_from(state >> 8).unwrap() % below
        };
        for round in 0..300 {
            let (count, made) = match round {
                0 => (1, 255),
                1 => (255, 1),
                2 => (64, 192),
                _ => (1 + random(64), 1 + random(40)),
            };
            let len = 1 + random(40);
            let shards: Vec<Vec<u8>> = (0..count)
                .map(|_| (0..len).map(|_| random(256).to_le_bytes()[0]).collect())
                .collect();
            let mut parities = vec![vec![0; len]; made];
            let mut into: Vec<&mut [u8]> = parities.iter_mut().map(Vec::as_mut_slice).collect();
            encode(shards.iter().map(Vec::as_slice), &mut into);
            let lost = random(count.min(made) + 1);
            let mut order: Vec<usize> = (0..count).collect();
            for at in 0..count {
                order.swap(at, at + random(count - at));
            }
            let missing = &order[..lost];
            let there: Vec<(usize, &[u8])> = order[lost..]
                .iter()
                .map(|at| (*at, shards[*at].as_slice()))
                .collect();
            let skipped = random(made - lost + 1);
            let given: Vec<(usize, &[u8])> = (skipped..made)
                .map(|at| (at, parities[at].as_slice()))
                .collect();
            let restored = restore(missing, &there, &given).unwrap();
            for (at, shard) in missing.iter().zip(&restored) {
                assert_eq!(shard, &shards[*at], "{count}+{made}");
            }
            assert!(lost == 0 || restore(missing, &there, &given[..lost - 1]).is_none());
        }
    }
}
