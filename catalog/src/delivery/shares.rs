//! What part of a link is whose: several senders that fill one cannot see each other, but their receiver sees them all, and
//! a sender sees all of its paths.

use std::collections::BTreeMap;
use std::time::Duration;

use ddx_wire::Time;

/// What each had in the last half to whole second: a sender of what arrives, or a path of what leaves.
#[derive(Debug)]
pub(super) struct Shares<K> {
    holders: BTreeMap<K, Recent>,
    /// When the present half began.
    since: Time,
}

#[derive(Debug, Default)]
struct Recent {
    present: u64,
    former: u64,
    /// When it last had not enough.
    limited_at: Option<Time>,
}

impl<K: Ord + Copy> Shares<K> {
    pub(super) fn new(now: Time) -> Self {
        Self {
            holders: BTreeMap::new(),
            since: now,
        }
    }

    /// Notes what one had, and whether it could use more.
    pub(super) fn note(&mut self, key: K, len: usize, is_limited: bool, now: Time) {
        let halves = now.since(self.since).as_nanos() / HALF.as_nanos();
        if halves > 0 {
            self.since = now;
            for recent in self.holders.values_mut() {
                recent.former = if halves == 1 { recent.present } else { 0 };
                recent.present = 0;
            }
            self.holders.retain(|_, recent| recent.bytes() > 0);
        }
        let recent = self.holders.entry(key).or_default();
        recent.present += len as u64;
        if is_limited {
            recent.limited_at = Some(now);
        }
    }

    /// The share of one in thousandths of the mean of those that could use more; 1,000 for one that could not.
    pub(super) fn of(&self, key: K, now: Time) -> u16 {
        let limited = |recent: &&Recent| {
            recent
                .limited_at
                .is_some_and(|at| now.since(at) < LIMITED_LASTS)
        };
        let Some(own) = self.holders.get(&key).filter(limited) else {
            return EVEN;
        };
        let all = self.holders.values().filter(limited).map(Recent::bytes);
        let (count, sum) = all.fold((0, 0), |(count, sum), bytes| (count + 1, sum + bytes));
        let share = (own.bytes() * count * u64::from(EVEN)).checked_div(sum);
        share.map_or(EVEN, |share| u16::try_from(share).unwrap_or(u16::MAX))
    }

    pub(super) fn forget(&mut self, key: K) {
        self.holders.remove(&key);
    }
}

impl Recent {
    fn bytes(&self) -> u64 {
        self.present + self.former
    }
}

/// As much as the mean, thousandths.
pub(super) const EVEN: u16 = 1_000;
/// At most this is counted twice: then it is the former half.
const HALF: Duration = Duration::from_millis(500);
/// A slow sender has a datagram under way for so long.
const LIMITED_LASTS: Duration = Duration::from_millis(500);

#[cfg(test)]
mod tests {
    use ddx_wire::Tag;

    use super::*;

    #[test]
    fn who_is_held_back_learns_its_share_and_others_do_not_count() {
        let mut shares = Shares::new(Time(0));
        let mut now = Time(1_000_000_000);
        for _ in 0..300 {
            now = now + Duration::from_millis(5);
            shares.note(Tag(1), 900, true, now);
            shares.note(Tag(2), 300, true, now);
            shares.note(Tag(3), 100, false, now);
        }
        let of = |shares: &Shares<Tag>, now| [1, 2, 3, 4].map(|tag| shares.of(Tag(tag), now));
        assert_eq!(of(&shares, now), [1_500, 500, 1_000, 1_000]);
        // One that is held back no more leaves the other alone.
        for _ in 0..300 {
            now = now + Duration::from_millis(5);
            shares.note(Tag(1), 900, false, now);
            shares.note(Tag(2), 300, true, now);
        }
        assert_eq!(of(&shares, now), [1_000; 4]);
        shares.note(Tag(3), 1, false, now + 4 * HALF);
        assert_eq!(shares.holders.len(), 1);
    }
}
