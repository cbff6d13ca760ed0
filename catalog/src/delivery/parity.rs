//! Forward error correction of a sample in fragments: parities, each of which stands in for any one fragment that is lost.
//!
//! A [Cauchy code](super::cauchy) in blocks: what follows one another in a sample lies in different blocks, so that a burst of
//! losses is shared among them.

use std::time::Duration;

use super::cauchy::{self, SHARDS_MAX};

/// What decides whether parities pay.
#[derive(Clone, Copy, Debug)]
pub(super) struct Link {
    /// Share of datagrams lost, thousandths.
    pub(super) loss_permille: u16,
    /// Bytes per second.
    pub(super) rate: u64,
    /// From a request of a receiver to its answer.
    pub(super) round_trip: Duration,
}

impl Link {
    /// How many parities to add to a sample of `count` fragments of `step` bytes: 0 where repair on request is quick enough.
    ///
    /// They are as many as will probably be lost, parities included, a standard deviation of bursts, and one in each block: of
    /// what is lost by chance, one sample in some hundred is asked for. They pay when what they take beyond the repairs that
    /// they save is less than a third of the time that these would take.
    pub(super) fn parities(&self, count: usize, step: usize) -> u8 {
        if self.loss_permille == 0 || !(2..=DATA_MAX).contains(&count) {
            return 0;
        }
        let blocks = count.div_ceil(BLOCK);
        #[expect(
            clippy::cast_precision_loss,
            reason = "far below the precision of a float"
        )]
        let (count, step, rate, blocks) = (
            count as f64,
            step as f64,
            self.rate.max(1) as f64,
            blocks as f64,
        );
        let loss = (f64::from(self.loss_permille) / 1000.0).min(LOSS_MAX);
        let mut parities = 0.0;
        // The parities of parities soon add up to less than one.
        for _ in 0..8 {
            let lost = loss * (count + parities);
            let spread = (2.0 * lost * blocks).sqrt();
            parities = (lost + spread + blocks).ceil();
        }
        // Requests until all is there: the first is made with the probability that anything is lost.
        let (mut missing, mut requests) = (count * loss, 0.0);
        while missing > 0.01 {
            requests += f64::min(missing, 1.0);
            missing *= loss;
        }
        // Requests are lost as well.
        let repair = requests * (self.round_trip + REQUEST).as_secs_f64() / (1.0 - loss);
        let cost = (parities - count * loss / (1.0 - loss)) * step / rate;
        if 3.0 * cost > repair || parities > f64::from(u8::MAX) {
            return 0;
        }
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "it was compared with the greatest"
        )]
        let parities = parities as u8;
        parities
    }
}

/// Makes the parities of a sample, back to back, `step` bytes each; `None` for a sample that can have none.
pub(super) fn encode(payload: &[u8], step: usize, parities: u8) -> Option<Vec<u8>> {
    let parities = usize::from(parities);
    let blocks = Blocks::new(payload.len().div_ceil(step.max(1)), parities)?;
    let mut encoded = vec![0; parities * step];
    for block in 0..blocks.blocks {
        let shards = blocks.fragments(block);
        let shards = shards.filter_map(|index| payload.chunks(step).nth(index));
        let parity = encoded.chunks_exact_mut(step).skip(block);
        let mut parity: Vec<_> = parity.step_by(blocks.blocks).collect();
        cauchy::encode(shards, &mut parity);
    }
    Some(encoded)
}

/// Fills in what is missing of a sample. `has` tells whether a fragment is there, by its number, and `parity` gives one that
/// came, by its own, out of `parities`. `false` if that is not enough.
pub(super) fn restore<'a>(
    payload: &mut [u8],
    step: usize,
    has: impl Fn(usize) -> bool,
    parity: impl Fn(usize) -> Option<&'a [u8]>,
    parities: u8,
) -> bool {
    let count = payload.len().div_ceil(step.max(1));
    let Some(blocks) = Blocks::new(count, parities.into()) else {
        return false;
    };
    for block in 0..blocks.blocks {
        if blocks.fragments(block).all(&has) {
            continue;
        }
        let of = blocks.fragments(block).enumerate();
        let (there, missing): (Vec<_>, Vec<_>) = of.partition(|(_, index)| has(*index));
        let shards = there
            .iter()
            .filter_map(|(i, index)| Some((*i, payload.chunks(step).nth(*index)?)));
        let parities = blocks
            .parities(block)
            .enumerate()
            .filter_map(|(j, index)| Some((j, parity(index)?)));
        let numbers: Vec<usize> = missing.iter().map(|(i, _)| *i).collect();
        let (shards, parities): (Vec<_>, Vec<_>) = (shards.collect(), parities.collect());
        let Some(restored) = cauchy::restore(&numbers, &shards, &parities) else {
            return false;
        };
        for ((_, index), shard) in missing.iter().zip(restored) {
            if let Some(to) = payload.chunks_mut(step).nth(*index)
                && let Some(from) = shard.get(..to.len())
            {
                to.copy_from_slice(from);
            }
        }
    }
    true
}

/// How many more fragments or parities it takes to restore a sample, block by block; `None` if it can have no parities.
pub(super) fn lacking(
    count: usize,
    parities: u8,
    has: impl Fn(usize) -> bool,
    has_parity: impl Fn(usize) -> bool,
) -> Option<usize> {
    let blocks = Blocks::new(count, parities.into())?;
    let lacking = (0..blocks.blocks).map(|block| {
        let lost = blocks.fragments(block).filter(|index| !has(*index)).count();
        lost.saturating_sub(
            blocks
                .parities(block)
                .filter(|index| has_parity(*index))
                .count(),
        )
    });
    Some(lacking.sum())
}

/// The fragments, by their numbers, with which a sample can be restored: of each block as many of those that are missing as its
/// parities do not make up for. `None` if it can have no parities.
pub(super) fn wanted(
    count: usize,
    parities: u8,
    has: impl Fn(usize) -> bool,
    has_parity: impl Fn(usize) -> bool,
) -> Option<Vec<usize>> {
    let blocks = Blocks::new(count, parities.into())?;
    let mut wanted = Vec::new();
    for block in 0..blocks.blocks {
        let made_up = blocks.parities(block).filter(|index| has_parity(*index));
        let missing = blocks.fragments(block).filter(|index| !has(*index));
        let lacking = missing.clone().count().saturating_sub(made_up.count());
        wanted.extend(missing.take(lacking));
    }
    wanted.sort_unstable();
    Some(wanted)
}

/// How fragments and parities are shared among blocks.
#[derive(Clone, Copy, Debug)]
struct Blocks {
    count: usize,
    parities: usize,
    blocks: usize,
}

impl Blocks {
    /// `None` for what no codec takes.
    fn new(count: usize, parities: usize) -> Option<Self> {
        let blocks = count.div_ceil(BLOCK);
        let fits = (1..=DATA_MAX).contains(&count) && parities >= blocks;
        let largest = count.div_ceil(blocks.max(1)) + parities.div_ceil(blocks.max(1));
        (fits && largest <= SHARDS_MAX).then_some(Self {
            count,
            parities,
            blocks,
        })
    }

    fn fragments(self, block: usize) -> impl Iterator<Item = usize> + Clone {
        (block..self.count).step_by(self.blocks)
    }

    fn parities(self, block: usize) -> impl Iterator<Item = usize> + Clone {
        (block..self.parities).step_by(self.blocks)
    }
}

/// `PROTOCOL.md#parities`: fragments of a sample that may have parities.
const DATA_MAX: usize = 1_024;
/// `PROTOCOL.md#parities`: fragments of a block at most. The time that each parity takes grows with them.
const BLOCK: usize = 64;
/// More than this share cannot be made up for.
const LOSS_MAX: f64 = 0.5;
/// What a receiver waits before it makes a request, and what the answer waits before it leaves.
const REQUEST: Duration = Duration::from_millis(25);

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use ddx_wire::sample::{Record, SampleMeta};
    use ddx_wire::{Seq, StreamId, Tag, Time};

    use super::super::reassembly::{Due, PARTIAL_BYTES, RANGE_BYTES, Reassembly, Rules, Step};
    use super::super::transfer::{Flight, Transfer};
    use super::*;

    const RTT: Duration = Duration::from_millis(100);
    /// What a sample in one range takes beside its bytes.
    const BESIDE: usize = PARTIAL_BYTES + RANGE_BYTES;
    const FLIGHT: Flight = Flight {
        time: RTT,
        seen: None,
    };

    fn meta() -> SampleMeta {
        SampleMeta {
            seq: Seq(1),
            ..SampleMeta::default()
        }
    }

    fn sample() -> Vec<u8> {
        (0..995_u32).map(|at| (at * 7).to_le_bytes()[0]).collect()
    }

    /// Sends all of a transfer's fragments of 100 bytes, of which those that `is_lost` does not come.
    fn carry(
        transfer: &mut Transfer<Vec<u8>>,
        reassembly: &mut Reassembly,
        is_lost: impl Fn(u32) -> bool,
    ) -> (Vec<u32>, Option<Step>) {
        let (mut sent, mut whole) = (Vec::new(), None);
        while let Some((fragment, payload)) = transfer.next_fragment(Time(0)) {
            sent.push(fragment.offset);
            if is_lost(fragment.offset) {
                continue;
            }
            let record = Record {
                stream: StreamId(1),
                repeat: false,
                gone: false,
                meta: meta(),
                fragment: Some(fragment),
                payload,
            };
            let rules = Rules {
                depth: 2,
                in_order: false,
                round_trip: RTT,
                patience: Duration::ZERO,
            };
            let step = reassembly.insert(Tag(1), &record, fragment, rules, Time(0));
            if whole.is_none() && step != Step::default() {
                whole = Some(step);
            }
        }
        (sent, whole)
    }

    #[test]
    fn parities_stand_in_for_what_is_lost() {
        let transfer = Transfer::new(meta(), sample(), 100, Time(0));
        let (mut transfer, mut reassembly) = (transfer.protect(3), Reassembly::new(10_000));
        // The last fragment, which is short, is among the lost, and a parity.
        let lost = [200, 900, 1_100];
        let (sent, step) = carry(&mut transfer, &mut reassembly, |at| lost.contains(&at));
        let all: Vec<u32> = (0..13).map(|at| at * 100).collect();
        assert_eq!(sent, all);
        let whole = step.and_then(|step| step.whole).unwrap();
        assert_eq!(whole, (meta(), sample()));
        assert_eq!(reassembly.held_bytes(), 0);
    }

    #[test]
    fn a_short_end_that_comes_first_does_not_hide_the_length_of_parities() {
        let payload = vec![7; 150];
        let transfer = Transfer::new(meta(), payload.clone(), 100, Time(0));
        let (mut transfer, mut reassembly) = (transfer.protect(1), Reassembly::new(10_000));
        let (_, step) = carry(&mut transfer, &mut reassembly, |at| at == 0);
        let whole = step.and_then(|step| step.whole);
        assert_eq!(whole, Some((meta(), payload)));
    }

    #[test]
    fn what_parities_do_not_make_up_for_is_asked_for_late_and_answered_later() {
        let transfer = Transfer::new(meta(), sample(), 100, Time(0));
        let (mut transfer, mut reassembly) = (transfer.protect(2), Reassembly::new(10_000));
        let lost = [200, 300, 700, 1_000];
        let (_, step) = carry(&mut transfer, &mut reassembly, |at| lost.contains(&at));
        assert_eq!(step, None);
        // Three are missing and one parity is here, the last: what comes later took another way.
        let at = reassembly.deadline().unwrap();
        assert_eq!(at, Time(0) + Duration::from_millis(5));
        let (_, due) = reassembly.due(at).unwrap();
        assert_eq!(due, Due::Ask(vec![(200, 200)]));
        transfer.ask(200, 200, FLIGHT, at);
        assert!(!transfer.repairs());
        transfer.ask(200, 200, FLIGHT, Time(0) + RTT);
        assert!(transfer.repairs());
    }

    #[test]
    fn nothing_is_asked_for_while_parities_may_come() {
        let transfer = Transfer::new(meta(), sample(), 100, Time(0));
        let (mut transfer, mut reassembly) = (transfer.protect(2), Reassembly::new(10_000));
        let (_, step) = carry(&mut transfer, &mut reassembly, |at| {
            at == 200 || at >= 1_000
        });
        assert_eq!(step, None);
        let at = reassembly.deadline().unwrap();
        assert_eq!(at, Time(0) + RTT / 2);
    }

    #[test]
    fn what_is_asked_for_is_of_the_blocks_that_lack_it() {
        // Two blocks of 50, of which one has lost more than its parity makes up for, behind what the other has lost.
        let has = |index: usize| ![0, 1, 3].contains(&index);
        assert_eq!(wanted(100, 2, has, |_| true), Some(vec![1]));
        assert_eq!(wanted(100, 2, has, |index| index == 1), Some(vec![0, 1]));
    }

    #[test]
    fn requests_wait_while_parities_may_make_up_for_them() {
        let transfer = Transfer::new(meta(), sample(), 100, Time(0));
        let mut transfer = transfer.protect(1);
        for _ in 0..10 {
            transfer.next_fragment(Time(0));
        }
        // The fragments left long ago; the parity, at the pace of others, not yet.
        let late = Time(0) + 3 * RTT;
        transfer.ask(200, 100, FLIGHT, late);
        assert!(!transfer.repairs());
        transfer.next_fragment(late);
        transfer.ask(200, 100, FLIGHT, late + RTT / 2);
        assert!(!transfer.repairs());
        transfer.ask(200, 100, FLIGHT, late + RTT);
        assert!(transfer.repairs());
    }

    #[test]
    fn parities_are_kept_within_the_budget() {
        let transfer = Transfer::new(meta(), sample(), 100, Time(0));
        let (mut transfer, mut reassembly) =
            (transfer.protect(9), Reassembly::new(BESIDE + 995 + 250));
        let (_, step) = carry(&mut transfer, &mut reassembly, |at| at < 300);
        assert_eq!(step, None);
        assert_eq!(reassembly.held_bytes(), BESIDE + 995 + 200);
    }

    fn parities(loss_permille: u16, mbit: u64, rtt_ms: u64, bytes: usize) -> u8 {
        let link = Link {
            loss_permille,
            rate: mbit * 125_000,
            round_trip: Duration::from_millis(rtt_ms),
        };
        link.parities(bytes.div_ceil(1_380), 1_380)
    }

    #[test]
    fn parities_are_added_where_repair_is_slow() {
        // Nothing is lost, or a request is answered before a parity is sent.
        assert_eq!(parities(0, 1_000, 600, 64_000), 0);
        assert_eq!(parities(1, 10, 1, 8_000), 0);
        assert_eq!(parities(5, 50, 6, 8_000), 0);
        // A satellite, bursts, a third lost.
        assert_eq!(parities(10, 2, 600, 8_000), 2);
        assert!((8..14).contains(&parities(80, 10, 30, 64_000)));
        assert!((30..50).contains(&parities(330, 5, 20, 64_000)));
        // So much takes longer to protect than to repair.
        assert_eq!(parities(330, 5, 20, 1_000_000), 0);
        assert_eq!(parities(330, 5, 20, 6 << 20), 0);
    }

    proptest! {
        #[test]
        fn any_fragments_are_restored(
            len in 2_usize..9_000,
            step in 1_usize..600,
            count in 1_u8..40,
            burst in any::<prop::sample::Index>(),
            start in any::<prop::sample::Index>(),
            byte in any::<u8>(),
        ) {
            let data = len.div_ceil(step);
            let blocks = data.div_ceil(BLOCK);
            prop_assume!(Blocks::new(data, count.into()).is_some());
            let payload: Vec<u8> = (0..len).map(|at| at.to_le_bytes()[0].wrapping_mul(byte | 1)).collect();
            let parities = encode(&payload, step, count).unwrap();
            prop_assert_eq!(parities.len(), step * usize::from(count));
            // A burst that each block survives, round the end.
            let most = (usize::from(count) / blocks * blocks).min(data / blocks * blocks);
            let burst = 1 + burst.index(most);
            let start = start.index(data);
            let lost = |index: usize| index >= start && index < start + burst;
            let mut holed = payload.clone();
            for (index, part) in holed.chunks_mut(step).enumerate() {
                if lost(index) {
                    part.fill(0xEE);
                }
            }
            let has = |index: usize| !lost(index);
            let parity = |index: usize| parities.chunks(step).nth(index);
            prop_assert_eq!(lacking(data, count, has, |_| true), Some(0));
            let gone = (0..data).filter(|index| lost(*index)).count();
            prop_assert_eq!(lacking(data, count, has, |_| false), Some(gone));
            // Any parities will do, and what is wanted beside them is all that it takes.
            let here = |index: usize| !(usize::from(byte) + index).is_multiple_of(3);
            let asked = wanted(data, count, has, here).unwrap();
            prop_assert_eq!(Some(asked.len()), lacking(data, count, has, here));
            prop_assert!(asked.iter().all(|index| !has(*index)));
            let answered = |index: usize| has(index) || asked.contains(&index);
            prop_assert_eq!(lacking(data, count, answered, here), Some(0));
            let mut short = holed.clone();
            prop_assert!(!restore(&mut short, step, has, |_| None, count));
            prop_assert!(restore(&mut holed, step, has, parity, count));
            prop_assert_eq!(&holed, &payload);
        }
    }
}
