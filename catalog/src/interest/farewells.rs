//! Goodbyes, said again in case they were lost.

use std::collections::BTreeMap;
use std::time::Duration;

use ddx_wire::message::Message;
use ddx_wire::{Tag, Time};

use super::ENTRIES_MAX;
use crate::outbox::Outbox;

/// When a goodbye is said again, in case it was lost.
pub(super) const FAREWELLS: [Duration; 2] = [Duration::from_millis(50), Duration::from_millis(200)];
/// Goodbyes that wait to be said again, of 24 B each: 768 KiB. A lease ends without them, too.
const WAITING_MAX: usize = 32_768;

/// What is to be said again, and to whom.
#[derive(Default)]
pub(super) struct Farewells {
    waiting: Vec<Farewell>,
    /// Those that had no room.
    pub(super) dropped: u64,
}

struct Farewell {
    at: Time,
    to: Tag,
    number: u32,
}

impl Farewells {
    /// Says goodbye once more to an owner, a few times.
    pub(super) fn repeat(&mut self, to: Tag, number: u32, now: Time) {
        for after in FAREWELLS {
            if self.waiting.len() >= WAITING_MAX {
                self.dropped = self.dropped.saturating_add(1);
                continue;
            }
            let at = now + after;
            self.waiting.push(Farewell { at, to, number });
        }
    }

    /// Forgets a life that ended.
    pub(super) fn drop_owner(&mut self, owner: Tag) {
        self.waiting.retain(|farewell| farewell.to != owner);
    }

    pub(super) fn poll_timeout(&self) -> Option<Time> {
        self.waiting.iter().map(|farewell| farewell.at).min()
    }

    pub(super) fn handle_timeout(&mut self, now: Time, out: &mut Outbox) {
        let mut due: BTreeMap<Tag, Vec<u32>> = BTreeMap::new();
        self.waiting.retain(|farewell| {
            if farewell.at <= now {
                due.entry(farewell.to).or_default().push(farewell.number);
            }
            farewell.at > now
        });
        for (to, numbers) in due {
            for numbers in numbers.chunks(ENTRIES_MAX) {
                out.send(to, &Message::Unsubscribe(numbers.to_vec()));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn goodbyes_that_wait_are_few_and_the_others_are_counted() {
        let out = &mut Outbox::default();
        let mut farewells = Farewells::default();
        for number in 0..40_000 {
            farewells.repeat(Tag(1), number, Time(0));
        }
        assert_eq!(farewells.waiting.len(), WAITING_MAX);
        assert_eq!(farewells.dropped, 80_000 - 32_768);
        farewells.handle_timeout(Time(0) + FAREWELLS[1], out);
        assert_eq!(farewells.poll_timeout(), None);
    }
}
