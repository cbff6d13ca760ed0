//! Deadlines by key, earliest first.

use std::collections::{BTreeMap, BTreeSet};

use ddx_wire::Time;

/// At most one deadline for each key. As large as its number of keys, however often they are set.
#[derive(Debug)]
pub(super) struct Deadlines<K> {
    by_key: BTreeMap<K, Time>,
    by_time: BTreeSet<(Time, K)>,
}

impl<K: Ord + Copy> Deadlines<K> {
    pub(super) fn new() -> Self {
        Self {
            by_key: BTreeMap::new(),
            by_time: BTreeSet::new(),
        }
    }

    /// Sets or moves the deadline of a key.
    pub(super) fn set(&mut self, key: K, at: Time) {
        self.clear(key);
        self.by_key.insert(key, at);
        self.by_time.insert((at, key));
    }

    /// Sets a deadline unless the key has one: the cheap call for each sample.
    pub(super) fn set_if_idle(&mut self, key: K, at: Time) {
        if !self.by_key.contains_key(&key) {
            self.set(key, at);
        }
    }

    pub(super) fn clear(&mut self, key: K) {
        if let Some(at) = self.by_key.remove(&key) {
            self.by_time.remove(&(at, key));
        }
    }

    pub(super) fn contains(&self, key: &K) -> bool {
        self.by_key.contains_key(key)
    }

    /// Sets a deadline, unless the key has an earlier one.
    pub(super) fn set_earlier(&mut self, key: K, at: Time) {
        if self.by_key.get(&key).is_none_or(|present| at < *present) {
            self.set(key, at);
        }
    }

    pub(super) fn first(&self) -> Option<Time> {
        self.by_time.first().map(|(at, _)| *at)
    }

    /// Takes a key whose deadline has come.
    pub(super) fn pop(&mut self, now: Time) -> Option<K> {
        let (at, key) = *self.by_time.first()?;
        if at > now {
            return None;
        }
        self.clear(key);
        Some(key)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn earliest_first_and_one_for_each_key() {
        let mut deadlines = Deadlines::new();
        deadlines.set('a', Time(30));
        deadlines.set('b', Time(20));
        deadlines.set('a', Time(10));
        deadlines.set_if_idle('b', Time(1));
        assert_eq!(deadlines.first(), Some(Time(10)));
        assert_eq!(deadlines.pop(Time(9)), None);
        assert_eq!(deadlines.pop(Time(20)), Some('a'));
        assert_eq!(deadlines.pop(Time(20)), Some('b'));
        assert_eq!(deadlines.pop(Time(99)), None);
    }
}
