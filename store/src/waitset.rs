//! Waiting for many readers by one bell, at a cost that does not grow with their number.
//!
//! [`wait_any`](crate::wait_any) looks at each of its readers; a set looks only at those whose bell bit was rung. Bits are
//! hints: every 100 ms it looks at all, so that a lost hint costs that much at most.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::{Duration, Instant};

use ddx_wire::Epoch;

use crate::connection::Connection;
use crate::notify::{Bell, Bells, MAX_SLICE};
use crate::reader::RawReader;
use crate::store::Store;
use crate::sync::{Site, fence};
use crate::wait::Readiness;

/// Names a reader in its set; never used twice.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct WaitKey(u64);

/// Readers of one store that one thread waits for.
#[derive(Debug)]
pub struct WaitSet {
    connection: Arc<Connection>,
    members: BTreeMap<WaitKey, Member>,
    by_bit: BTreeMap<u16, Vec<WaitKey>>,
    marked: BTreeSet<WaitKey>,
    /// Readers that were handed out since the last wait: a read may have bound them to a segment.
    lent: BTreeSet<WaitKey>,
    looked: Instant,
    last: u64,
}

/// Ends the sleep of a set from another thread.
#[derive(Clone, Debug)]
pub struct Waker {
    connection: Arc<Connection>,
}

#[derive(Debug)]
struct Member {
    reader: RawReader,
    bell: Option<(u16, Epoch)>,
}

/// Rung by wakers: shared with readers, which it costs a needless look.
const WAKER_BIT: u16 = 0;

impl WaitSet {
    /// Makes an empty set. Only one set or blocking reader at a time may sleep on the bell of `store`.
    pub fn new(store: &Store) -> Self {
        Self {
            connection: store.connection(),
            members: BTreeMap::new(),
            by_bit: BTreeMap::new(),
            marked: BTreeSet::new(),
            lent: BTreeSet::new(),
            looked: Instant::now(),
            last: 0,
        }
    }

    /// Puts a reader of the same store in.
    pub fn add(&mut self, reader: RawReader) -> WaitKey {
        self.last += 1;
        let key = WaitKey(self.last);
        self.members.insert(key, Member { reader, bell: None });
        self.listen(key);
        key
    }

    /// The reader of that key.
    pub fn reader(&mut self, key: WaitKey) -> Option<&mut RawReader> {
        let member = self.members.get_mut(&key)?;
        self.lent.insert(key);
        Some(&mut member.reader)
    }

    /// Takes a reader out.
    pub fn remove(&mut self, key: WaitKey) -> Option<RawReader> {
        let member = self.members.remove(&key)?;
        member.reader.set_waiting(false);
        self.marked.remove(&key);
        self.lent.remove(&key);
        if let Some((bit, _)) = member.bell {
            self.unlist(bit, key);
        }
        Some(member.reader)
    }

    /// Makes the next [`WaitSet::wait`] return this reader at once: it was left before it was drained.
    pub fn mark(&mut self, key: WaitKey) {
        self.marked.insert(key);
    }

    /// Lets the writer of this reader's item ring no bell: who has no use for news is not woken by it.
    pub fn mute(&mut self, key: WaitKey) {
        if let Some(reader) = self.reader(key) {
            reader.set_waiting(false);
        }
    }

    /// Has the bell rung again, to be followed by a look at what came meanwhile.
    pub fn unmute(&mut self, key: WaitKey) {
        if let Some(reader) = self.reader(key) {
            reader.set_waiting(true);
            // SeqCst: pairs with the fence in `RingWriter::publish`.
            fence(Site::ArmFence);
        }
    }

    /// A handle that ends the sleep.
    pub fn waker(&self) -> Waker {
        Waker {
            connection: Arc::clone(&self.connection),
        }
    }

    /// Blocks until some reader may have something new, at most `timeout`, or until woken, and puts those into `rung`. Never
    /// enters the kernel for a `timeout` of zero or while readers are marked. May return nothing before the time.
    pub fn wait(&mut self, timeout: Duration, rung: &mut Vec<WaitKey>) {
        rung.clear();
        for key in std::mem::take(&mut self.lent) {
            self.listen(key);
        }
        let (bells, client) = self.connection.bell();
        // Before the bell is armed: writers that ring a busy thread have no need to enter the kernel.
        let woken = self.take(&bells, client, rung);
        if !woken && rung.is_empty() && !timeout.is_zero() {
            let seen = bells.arm(client);
            // Whoever called the waker before the bell was armed must be heard now: the bell does not ring again for it.
            if !self.take(&bells, client, rung) && rung.is_empty() {
                bells.wait(client, seen, timeout.min(MAX_SLICE));
                self.take(&bells, client, rung);
            }
        }
        for &key in rung.iter() {
            self.listen(key);
        }
        if self.looked.elapsed() >= MAX_SLICE {
            self.look(rung);
        }
    }

    /// Collects what was rung. Whether the waker was among it.
    fn take(&mut self, bells: &Bells, client: u16, rung: &mut Vec<WaitKey>) -> bool {
        rung.extend(std::mem::take(&mut self.marked));
        let mut woken = false;
        for (word, mut bits) in (0_u16..).zip(bells.take_dirty(client)) {
            while bits != 0 {
                let low = u16::try_from(bits.trailing_zeros()).unwrap_or_default();
                bits &= bits - 1;
                let bit = word * 64 + low;
                woken |= bit == WAKER_BIT;
                rung.extend(self.by_bit.get(&bit).into_iter().flatten());
            }
        }
        woken
    }

    /// Looks at all readers and at the daemon's news.
    fn look(&mut self, rung: &mut Vec<WaitKey>) {
        self.looked = Instant::now();
        // A forked child has nothing to wait for; its readers say so when they are read.
        self.connection.tend().ok();
        let keys: Vec<WaitKey> = self.members.keys().copied().collect();
        for key in keys {
            self.listen(key);
            let ready = self
                .members
                .get_mut(&key)
                .is_some_and(|m| !matches!(m.reader.readiness(), Ok(Readiness::Waiting)));
            if ready && !rung.contains(&key) {
                rung.push(key);
            }
        }
    }

    /// Has the bell rung for the segment that the reader is bound to now, which a hand-over changes.
    fn listen(&mut self, key: WaitKey) {
        let Some(member) = self.members.get_mut(&key) else {
            return;
        };
        let bell = member.reader.bell_bit();
        if bell == member.bell {
            return;
        }
        member.reader.set_waiting(true);
        let before = std::mem::replace(&mut member.bell, bell);
        if let Some((bit, _)) = before {
            self.unlist(bit, key);
        }
        if let Some((bit, _)) = bell {
            self.by_bit.entry(bit).or_default().push(key);
        }
        // What was published before the bell was set rings nothing.
        self.marked.insert(key);
    }

    fn unlist(&mut self, bit: u16, key: WaitKey) {
        if let Some(keys) = self.by_bit.get_mut(&bit) {
            keys.retain(|listed| *listed != key);
            if keys.is_empty() {
                self.by_bit.remove(&bit);
            }
        }
    }
}

impl Waker {
    /// Ends the present or the next sleep.
    pub fn wake(&self) {
        let (bells, client) = self.connection.bell();
        bells.ring(Bell {
            client,
            bit: WAKER_BIT,
        });
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicBool, Ordering};
    use std::thread;

    use ddx_wire::HostName;

    use super::*;
    use crate::ReaderOptions;
    use crate::server::Config;

    #[test]
    fn a_reader_that_was_opened_before_its_item_is_heard_from_the_first_sample_on() {
        let config = Config::new(HostName::parse("robot1").unwrap());
        let (store, mut server) = Store::embedded(config).unwrap();
        let (stop, handle) = (AtomicBool::new(false), server.handle());
        let took = thread::scope(|scope| {
            scope.spawn(|| server.run(&stop));
            let took: Duration = (0..10)
                .map(|round| hear(&store, &format!("item{round}")))
                .sum();
            stop.store(true, Ordering::Relaxed);
            handle.wake();
            took
        });
        // Unheard, each would be found by the look at all, a slice later.
        assert!(took < 5 * MAX_SLICE, "{took:?}");
    }

    /// How long a sample takes to a reader that has just become bound to its item by a read.
    fn hear(store: &Store, name: &str) -> Duration {
        let options = ReaderOptions::default();
        let reader = store.raw_reader(name, None, options).unwrap();
        let mut set = WaitSet::new(store);
        let key = set.add(reader);
        let mut writer = store.writer::<u64>(name).unwrap();
        let mut payload = Vec::new();
        let mut read = |set: &mut WaitSet| {
            let reader = set.reader(key).unwrap();
            reader.next_into(&mut payload, Duration::ZERO).unwrap()
        };
        writer.write(&1).unwrap();
        while read(&mut set).is_none() {}
        let mut rung = Vec::new();
        // What is left of the opening is out of the way.
        set.wait(Duration::from_millis(1), &mut rung);
        let start = Instant::now();
        thread::scope(|scope| {
            scope.spawn(|| writer.write(&2).unwrap());
            while read(&mut set).is_none() {
                set.wait(Duration::from_secs(60), &mut rung);
            }
        });
        start.elapsed()
    }

    #[test]
    fn a_waker_that_comes_before_the_sleep_ends_it() {
        let config = Config::new(HostName::parse("robot1").unwrap());
        let (store, _server) = Store::embedded(config).unwrap();
        let mut set = WaitSet::new(&store);
        let waker = set.waker();
        let mut rung = Vec::new();
        let start = Instant::now();
        for _ in 0..100 {
            waker.wake();
            set.wait(Duration::from_secs(60), &mut rung);
        }
        // Slept through, each would take a slice.
        assert!(start.elapsed() < 50 * MAX_SLICE, "{:?}", start.elapsed());
    }
}
