//! Models of the ring and waking protocols: every interleaving of one writer and two readers over few slots, under
//! the memory model. Each ordering that the protocols rely on is then weakened in turn, and the model must fail.
//!
//! Run with `RUSTFLAGS="--cfg loom" cargo test --release -p ddx-store --test loom`.
#![cfg(loom)]
#![expect(clippy::unwrap_used, reason = "helpers of tests fail as tests do")]
#![expect(
    unsafe_code,
    reason = "loom's cells give pointers, as the store has them"
)]

use std::sync::Arc;

use ddx_store::layout::{HEAD, STATE, Shape, Spec};
use ddx_store::notify::{self, Bell, RUNG};
use ddx_store::ring::{
    Miss, RingReader, RingWriter, STAMP_WORDS, Words, glance, head, peek, waiting_now,
};
use ddx_store::sync::{Ordering, Site, weaken};
use loom::cell::UnsafeCell;
use loom::sync::Mutex;
use loom::sync::atomic::AtomicU64;
use loom::thread;

/// Two switches against a thread's will find every failure below; one more, because it takes only seconds.
const PREEMPTIONS: usize = 3;

/// Words as loom's atomics, made only where the protocol may touch them: each one costs in every interleaving.
struct Memory(Vec<Option<AtomicU64>>);

impl Memory {
    fn new(len: usize, used: impl IntoIterator<Item = usize>) -> Arc<Self> {
        let mut words: Vec<_> = (0..len).map(|_| None).collect();
        for at in used {
            words[at] = Some(AtomicU64::new(0));
        }
        Arc::new(Self(words))
    }

    fn word(&self, at: usize) -> &AtomicU64 {
        self.0[at].as_ref().expect("the model has made this word")
    }
}

impl Words for Memory {
    fn load(&self, at: usize, order: Ordering) -> u64 {
        self.word(at).load(order)
    }
    fn store(&self, at: usize, value: u64, order: Ordering) {
        self.word(at).store(value, order);
    }
    fn fetch_add(&self, at: usize, value: u64, order: Ordering) -> u64 {
        self.word(at).fetch_add(value, order)
    }
    fn fetch_and(&self, at: usize, value: u64, order: Ordering) -> u64 {
        self.word(at).fetch_and(value, order)
    }
    fn fetch_or(&self, at: usize, value: u64, order: Ordering) -> u64 {
        self.word(at).fetch_or(value, order)
    }
}

/// A ring of depth 1 with one spare slot: each publish pushes the other slot out, and the next loan wants it back.
struct Item<P> {
    shape: Shape,
    data: Arc<Memory>,
    ctl: Arc<Memory>,
    payloads: Arc<[P]>,
}

impl<P> Clone for Item<P> {
    fn clone(&self) -> Self {
        Self {
            shape: self.shape,
            data: Arc::clone(&self.data),
            ctl: Arc::clone(&self.ctl),
            payloads: Arc::clone(&self.payloads),
        }
    }
}

impl<P> Item<P> {
    /// The item with `cells` cells, and its writer, whose other slots are on loan for good.
    fn new(cells: u32, payload: impl Fn() -> P) -> (Self, RingWriter<Arc<Memory>>) {
        const USABLE: u16 = 2;
        let spec = Spec {
            capacity_bytes: 0,
            depth: 1,
            cells,
            pool: 0,
        };
        let shape = spec.shape(1).unwrap();
        let unused = shape.slots() - USABLE;
        let headers = (0..shape.slots()).flat_map(|slot| {
            let words = if slot < unused { 1 } else { 1 + STAMP_WORDS };
            shape.slot_word(slot)..shape.slot_word(slot) + words
        });
        let data = Memory::new(
            shape.data_len() / 8,
            headers.chain([HEAD, shape.ring_word(0)]),
        );
        let ctl = Memory::new(shape.ctl_len() / 8, 0..shape.ctl_len() / 8);
        let mut writer = RingWriter::new(Arc::clone(&data), Arc::clone(&ctl), shape);
        for slot in 0..unused {
            assert_eq!(writer.loan(), Some(slot));
        }
        let payloads = (0..shape.slots()).map(|_| payload()).collect();
        let item = Self {
            shape,
            data,
            ctl,
            payloads,
        };
        (item, writer)
    }

    fn reader(&self, cell: u32) -> RingReader<Arc<Memory>> {
        RingReader::new(
            Arc::clone(&self.data),
            Arc::clone(&self.ctl),
            self.shape,
            cell,
            1,
            Bell::default(),
        )
    }

    fn payload(&self, slot: u16) -> &P {
        &self.payloads[usize::from(slot)]
    }
}

type Plain = UnsafeCell<u64>;

impl Item<Plain> {
    /// Publishes one sample; false if that would take a slot that a reader holds.
    fn publish(&self, writer: &mut RingWriter<Arc<Memory>>) -> bool {
        let slot = writer.loan().unwrap();
        if writer.forced() > 0 {
            return false;
        }
        let value = writer.published() + 1;
        // SAFETY: loom reports any access that is not ordered with this one; that is the model's question.
        self.payload(slot)
            .with_mut(|payload| unsafe { *payload = value });
        writer.publish(slot, &stamp(value));
        true
    }

    fn check(&self, slot: u16, pos: u64) {
        // SAFETY: as above.
        let value = self.payload(slot).with(|payload| unsafe { *payload });
        assert_eq!(value, pos, "the payload is of another sample");
    }
}

fn stamp(value: u64) -> [u64; STAMP_WORDS] {
    let mut words = [0; STAMP_WORDS];
    words[1] = value;
    words
}

fn check(weakened: Option<Site>, model: impl Fn() + Sync + Send + 'static) {
    check_with(PREEMPTIONS, weakened, model);
}

fn check_with(
    preemptions: usize,
    weakened: Option<Site>,
    model: impl Fn() + Sync + Send + 'static,
) {
    weaken(weakened);
    let mut builder = loom::model::Builder::new();
    builder.preemption_bound = Some(preemptions);
    builder.max_branches = 20_000;
    builder.check(model);
}

/// Readers pin the newest sample and read it while the writer wants the slots back.
fn pinned_slots_are_left_alone(weakened: Option<Site>, readers: u32) {
    check(weakened, move || {
        let (item, mut writer) = Item::new(readers, || Plain::new(0));
        assert!(item.publish(&mut writer));
        let threads: Vec<_> = (0..readers)
            .map(|cell| {
                let item = item.clone();
                let reader = item.reader(cell);
                thread::spawn(move || {
                    let pos = reader.head();
                    match reader.pin(0, pos) {
                        Ok(slot) => {
                            assert_eq!(
                                reader.stamp(slot)[1],
                                pos,
                                "the stamp is of another sample"
                            );
                            item.check(slot, pos);
                            reader.unpin(0);
                        }
                        Err(Miss::Overwritten) => {}
                        Err(miss) => panic!("the head is ahead of the ring: {miss:?}"),
                    }
                })
            })
            .collect();
        assert!(item.publish(&mut writer));
        item.publish(&mut writer);
        for thread in threads {
            thread.join().unwrap();
        }
    });
}

/// A reader asks for a position that it has not seen at the head.
fn a_named_slot_is_filled(weakened: Option<Site>) {
    check(weakened, || {
        let (item, mut writer) = Item::new(1, || Plain::new(0));
        let reader = item.reader(0);
        let thread = {
            let item = item.clone();
            thread::spawn(move || {
                if let Ok(slot) = reader.pin(0, 1) {
                    // A look at the head makes loom switch between the writer's two stores; its full fence, which
                    // hides a weak store, comes after both.
                    reader.head();
                    item.check(slot, 1);
                    reader.unpin(0);
                }
            })
        };
        assert!(item.publish(&mut writer));
        thread.join().unwrap();
    });
}

/// The same without a pin, as the daemon reads.
fn a_peeked_slot_is_filled(weakened: Option<Site>) {
    check(weakened, || {
        let (item, mut writer) = Item::new(1, || Plain::new(0));
        let thread = {
            let item = item.clone();
            thread::spawn(move || {
                if let Ok(slot) = peek(&item.data, &item.shape, 1) {
                    item.check(slot, 1);
                }
            })
        };
        assert!(item.publish(&mut writer));
        thread.join().unwrap();
    });
}

/// A reader reads twice with one pin while the writer writes.
fn a_pin_is_used_again(weakened: Option<Site>) {
    check(weakened, || {
        let (item, mut writer) = Item::new(1, || Plain::new(0));
        assert!(item.publish(&mut writer));
        let reader = item.reader(0);
        let thread = {
            let item = item.clone();
            thread::spawn(move || {
                for pos in 1..=2 {
                    if let Ok(slot) = reader.pin(0, pos) {
                        item.check(slot, pos);
                        reader.unpin(0);
                    }
                }
            })
        };
        assert!(item.publish(&mut writer));
        item.publish(&mut writer);
        thread.join().unwrap();
    });
}

/// A reader takes its seat, reads, and leaves while the writer writes.
fn a_cell_is_left(weakened: Option<Site>) {
    check(weakened, || {
        let (item, mut writer) = Item::new(1, || Plain::new(0));
        assert!(item.publish(&mut writer));
        let thread = {
            let item = item.clone();
            thread::spawn(move || {
                let reader = item.reader(0);
                if let Ok(slot) = reader.pin(0, 1) {
                    item.check(slot, 1);
                    reader.leave();
                }
            })
        };
        assert!(item.publish(&mut writer));
        item.publish(&mut writer);
        thread.join().unwrap();
    });
}

/// The writer takes a slot although it is pinned: whoever has read the new bytes can tell.
fn a_forced_slot_is_detected(weakened: Option<Site>) {
    check(weakened, || {
        let (item, mut writer) = Item::new(1, || AtomicU64::new(0));
        let publish = |writer: &mut RingWriter<Arc<Memory>>| {
            let slot = writer.loan().unwrap();
            let value = writer.published() + 1;
            item.payload(slot).store(value, Ordering::Relaxed);
            writer.publish(slot, &stamp(value));
        };
        publish(&mut writer);
        let reader = item.reader(0);
        let slot = reader.pin(0, 1).unwrap();
        let thread = {
            let item = item.clone();
            thread::spawn(move || {
                let value = item.payload(slot).load(Ordering::Relaxed);
                if reader.intact(slot, 1) {
                    assert_eq!(value, 1, "a torn sample passed as intact");
                }
            })
        };
        publish(&mut writer);
        publish(&mut writer);
        assert_eq!(writer.forced(), 1);
        thread.join().unwrap();
    });
}

/// Readers copy the newest sample without a pin, word by word, while the writer comes round to its slot; or that at `asked`,
/// which they have not seen at the head.
fn a_glance_is_of_one_sample(weakened: Option<Site>, readers: u32, asked: Option<u64>) {
    // Relaxed loads may see many values each: with two readers the third switch takes a minute.
    let preemptions = if readers > 1 { 2 } else { PREEMPTIONS };
    check_with(preemptions, weakened, move || {
        let (item, mut writer) = Item::new(1, || [AtomicU64::new(0), AtomicU64::new(0)]);
        let publish = |writer: &mut RingWriter<Arc<Memory>>| {
            let slot = writer.loan().unwrap();
            let value = writer.published() + 1;
            for word in item.payload(slot) {
                word.store(value, Ordering::Relaxed);
            }
            writer.publish(slot, &stamp(value));
        };
        publish(&mut writer);
        let threads: Vec<_> = (0..readers)
            .map(|_| {
                let item = item.clone();
                thread::spawn(move || {
                    let pos = asked.unwrap_or_else(|| head(&item.data));
                    let copied = glance(&item.data, &item.shape, pos, |slot| {
                        let seq = item
                            .data
                            .load(item.shape.slot_word(slot) + 2, Ordering::Relaxed);
                        let [first, second] = item.payload(slot);
                        [
                            second.load(Ordering::Relaxed),
                            first.load(Ordering::Relaxed),
                            seq,
                        ]
                    });
                    match copied {
                        Ok(copied) => assert_eq!(copied, [pos; 3], "a torn sample passed as whole"),
                        Err(Miss::Overwritten) => {}
                        Err(Miss::NotYet) if asked.is_some() => {}
                        Err(miss) => panic!("the head is ahead of the ring: {miss:?}"),
                    }
                })
            })
            .collect();
        publish(&mut writer);
        publish(&mut writer);
        for thread in threads {
            thread.join().unwrap();
        }
    });
}

/// A futex as the kernel has it: the comparison and the sleep are one step before any wake.
struct Futex {
    asleep: Mutex<bool>,
}

impl Futex {
    fn wait(&self, bells: &Memory, seen: u32) {
        let mut asleep = self.asleep.lock().unwrap();
        // An addition of nothing, because the kernel reads the present value and loom's loads may be stale.
        *asleep = bells.fetch_add(RUNG, 0, Ordering::Relaxed) == u64::from(seen);
    }

    fn wake(&self) {
        *self.asleep.lock().unwrap() = false;
    }
}

fn bells() -> (Arc<Memory>, Arc<Futex>) {
    let futex = Futex {
        asleep: Mutex::new(false),
    };
    (Memory::new(16, 0..16), Arc::new(futex))
}

fn ring(bells: &Arc<Memory>, futex: &Futex) {
    if notify::ring(bells, 0, 0) {
        futex.wake();
    }
}

/// A reader goes to sleep while the writer publishes what it waits for.
fn no_sample_is_slept_through(weakened: Option<Site>) {
    check(weakened, || {
        let (item, mut writer) = Item::new(1, || Plain::new(0));
        let (bells, futex) = bells();
        let reader = item.reader(0);
        let thread = {
            let (bells, futex) = (Arc::clone(&bells), Arc::clone(&futex));
            thread::spawn(move || {
                reader.set_waiting(true);
                let seen = notify::arm(&bells, 0);
                if reader.head() == 0 {
                    futex.wait(&bells, seen);
                }
            })
        };
        let slot = writer.loan().unwrap();
        if writer.publish(slot, &stamp(1)).waiting != 0 {
            ring(&bells, &futex);
        }
        thread.join().unwrap();
        assert!(!*futex.asleep.lock().unwrap(), "a wake-up was lost");
    });
}

/// A reader goes to sleep while the daemon supersedes the segment.
fn no_state_is_slept_through(weakened: Option<Site>) {
    check(weakened, || {
        let (item, _writer) = Item::new(1, || Plain::new(0));
        let (bells, futex) = bells();
        let reader = item.reader(0);
        let thread = {
            let (bells, futex) = (Arc::clone(&bells), Arc::clone(&futex));
            thread::spawn(move || {
                reader.set_waiting(true);
                let seen = notify::arm(&bells, 0);
                if reader.ctl().load(STATE, Ordering::Relaxed) == 0 {
                    futex.wait(&bells, seen);
                }
            })
        };
        item.ctl.fetch_or(STATE, 1, Ordering::Relaxed);
        if waiting_now(&item.ctl) != 0 {
            ring(&bells, &futex);
        }
        thread.join().unwrap();
        assert!(!*futex.asleep.lock().unwrap(), "a wake-up was lost");
    });
}

/// A client goes to sleep while its bell is rung for something outside any item.
fn no_ring_is_slept_through(weakened: Option<Site>) {
    check(weakened, || {
        let (bells, futex) = bells();
        let news = Arc::new(AtomicU64::new(0));
        let thread = {
            let (bells, futex, news) = (Arc::clone(&bells), Arc::clone(&futex), Arc::clone(&news));
            thread::spawn(move || {
                let seen = notify::arm(&bells, 0);
                if news.load(Ordering::Relaxed) == 0 {
                    futex.wait(&bells, seen);
                }
            })
        };
        news.store(1, Ordering::Relaxed);
        ring(&bells, &futex);
        thread.join().unwrap();
        assert!(!*futex.asleep.lock().unwrap(), "a wake-up was lost");
    });
}

/// A client goes to sleep while two others ring its bell: the second may find it disarmed by the first.
fn no_second_ring_is_slept_through(weakened: Option<Site>) {
    check_with(3, weakened, || {
        let (bells, futex) = bells();
        let news: [_; 2] = std::array::from_fn(|_| Arc::new(AtomicU64::new(0)));
        let first = {
            let (bells, futex, news) = (Arc::clone(&bells), Arc::clone(&futex), news[0].clone());
            thread::spawn(move || {
                news.store(1, Ordering::Relaxed);
                ring(&bells, &futex);
            })
        };
        let second = {
            let (bells, futex, news) = (Arc::clone(&bells), Arc::clone(&futex), news[1].clone());
            thread::spawn(move || {
                news.store(1, Ordering::Relaxed);
                ring(&bells, &futex);
            })
        };
        let seen = notify::arm(&bells, 0);
        // What the first has to say does not end the wait.
        if news[1].load(Ordering::Relaxed) == 0 {
            futex.wait(&bells, seen);
        }
        first.join().unwrap();
        second.join().unwrap();
        assert!(!*futex.asleep.lock().unwrap(), "a wake-up was lost");
    });
}

/// A client takes its dirty bits while a writer finds one of them still set.
fn no_dirty_bit_is_taken_too_soon(weakened: Option<Site>) {
    check(weakened, || {
        let (bells, _futex) = bells();
        let news = Arc::new(AtomicU64::new(0));
        notify::ring(&bells, 0, 0);
        let thread = {
            let (bells, news) = (Arc::clone(&bells), Arc::clone(&news));
            thread::spawn(move || {
                news.store(1, Ordering::Relaxed);
                notify::ring(&bells, 0, 0);
            })
        };
        let taken = notify::take_dirty(&bells, 0)[0] != 0;
        let saw = news.load(Ordering::Relaxed) != 0;
        thread.join().unwrap();
        assert!(taken);
        let left = notify::take_dirty(&bells, 0)[0] != 0;
        assert!(saw || left, "a ring was lost");
    });
}

#[test]
fn two_readers_pin() {
    pinned_slots_are_left_alone(None, 2);
}

#[test]
fn named_slot() {
    a_named_slot_is_filled(None);
}

#[test]
fn peeked_slot() {
    a_peeked_slot_is_filled(None);
}

#[test]
fn reused_pin() {
    a_pin_is_used_again(None);
}

#[test]
fn left_cell() {
    a_cell_is_left(None);
}

#[test]
fn forced_slot() {
    a_forced_slot_is_detected(None);
}

#[test]
fn two_readers_glance() {
    a_glance_is_of_one_sample(None, 2, None);
    a_glance_is_of_one_sample(None, 1, Some(2));
}

#[test]
fn waking_for_samples() {
    no_sample_is_slept_through(None);
}

#[test]
fn waking_for_states() {
    no_state_is_slept_through(None);
}

#[test]
fn waking_for_rings() {
    no_ring_is_slept_through(None);
}

#[test]
fn waking_for_the_second_of_two_rings() {
    no_second_ring_is_slept_through(None);
}

#[test]
fn taking_dirty_bits() {
    no_dirty_bit_is_taken_too_soon(None);
}

#[test]
#[should_panic(expected = "Causality violation")]
fn weak_ring_store() {
    a_named_slot_is_filled(Some(Site::RingStore));
}

#[test]
#[should_panic(expected = "Causality violation")]
fn weak_peek_fence() {
    a_peeked_slot_is_filled(Some(Site::PeekFence));
}

#[test]
#[should_panic(expected = "the head is ahead of the ring")]
fn weak_head_store() {
    pinned_slots_are_left_alone(Some(Site::HeadStore), 1);
}

#[test]
#[should_panic(expected = "the head is ahead of the ring")]
fn weak_head_load() {
    pinned_slots_are_left_alone(Some(Site::HeadLoad), 1);
}

#[test]
#[should_panic(expected = "Causality violation")]
fn weak_pin_store() {
    a_pin_is_used_again(Some(Site::PinStore));
}

#[test]
#[should_panic(expected = "Causality violation")]
fn weak_pin_store_of_a_left_cell() {
    a_cell_is_left(Some(Site::PinStore));
}

#[test]
#[should_panic(expected = "Causality violation")]
fn weak_pin_scan() {
    pinned_slots_are_left_alone(Some(Site::PinScan), 1);
}

#[test]
#[should_panic(expected = "Causality violation")]
fn weak_publish_fence_for_pins() {
    pinned_slots_are_left_alone(Some(Site::PublishFence), 1);
}

#[test]
#[should_panic(expected = "Causality violation")]
fn weak_pin_fence() {
    pinned_slots_are_left_alone(Some(Site::PinFence), 1);
}

#[test]
#[should_panic(expected = "a torn sample passed as intact")]
fn weak_void_fence() {
    a_forced_slot_is_detected(Some(Site::VoidFence));
}

#[test]
#[should_panic(expected = "a torn sample passed as intact")]
fn weak_intact_fence() {
    a_forced_slot_is_detected(Some(Site::IntactFence));
}

#[test]
#[should_panic(expected = "a torn sample passed as whole")]
fn weak_void_fence_for_glances() {
    a_glance_is_of_one_sample(Some(Site::VoidFence), 1, None);
}

#[test]
#[should_panic(expected = "a torn sample passed as whole")]
fn weak_intact_fence_for_glances() {
    a_glance_is_of_one_sample(Some(Site::IntactFence), 1, None);
}

#[test]
#[should_panic(expected = "a torn sample passed as whole")]
fn weak_ring_store_for_glances() {
    a_glance_is_of_one_sample(Some(Site::RingStore), 1, Some(2));
}

#[test]
#[should_panic(expected = "a torn sample passed as whole")]
fn weak_peek_fence_for_glances() {
    a_glance_is_of_one_sample(Some(Site::PeekFence), 1, Some(2));
}

#[test]
#[should_panic(expected = "the head is ahead of the ring")]
fn weak_head_store_for_glances() {
    a_glance_is_of_one_sample(Some(Site::HeadStore), 1, None);
}

#[test]
#[should_panic(expected = "the head is ahead of the ring")]
fn weak_head_load_for_glances() {
    a_glance_is_of_one_sample(Some(Site::HeadLoad), 1, None);
}

#[test]
#[should_panic(expected = "a wake-up was lost")]
fn weak_publish_fence_for_waiters() {
    no_sample_is_slept_through(Some(Site::PublishFence));
}

#[test]
#[should_panic(expected = "a wake-up was lost")]
fn weak_arm_fence() {
    no_sample_is_slept_through(Some(Site::ArmFence));
}

#[test]
#[should_panic(expected = "a wake-up was lost")]
fn weak_state_fence() {
    no_state_is_slept_through(Some(Site::StateFence));
}

#[test]
#[should_panic(expected = "a wake-up was lost")]
fn weak_ring_fence() {
    no_ring_is_slept_through(Some(Site::RingFence));
}

#[test]
#[should_panic(expected = "a ring was lost")]
fn weak_ring_fence_for_dirty_bits() {
    no_dirty_bit_is_taken_too_soon(Some(Site::RingFence));
}

#[test]
#[should_panic(expected = "a ring was lost")]
fn weak_take_fence() {
    no_dirty_bit_is_taken_too_soon(Some(Site::TakeFence));
}
