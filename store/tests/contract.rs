//! What a segment promises, asked of both its kinds: sealed memfds and the heap.
#![cfg(not(loom))]
#![expect(clippy::unwrap_used, reason = "helpers of tests fail as tests do")]

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::thread;
use std::time::Duration;

use ddx_store::layout::{BASE_PINS, MAX_PINS};
use ddx_store::notify::Bells;
use ddx_store::segment::{
    Bell, Copier, HeapSegment, LoanError, Origin, Pin, PinError, Seat, SegmentControl,
    SegmentError, SegmentFds, SegmentReader, SegmentWriter, Spec, State,
};
use ddx_wire::{Epoch, Seq, Time};

const SPEC: Spec = Spec {
    capacity_bytes: 4096,
    depth: 4,
    cells: 4,
    pool: 2,
};

/// A segment as it is handed over.
enum Shared {
    Memfd(SegmentFds),
    Heap(HeapSegment),
}

impl Shared {
    fn seat(&self, seat: Seat) -> Result<SegmentReader, SegmentError> {
        match self {
            Self::Memfd(fds) => SegmentReader::map(fds, seat),
            Self::Heap(segment) => SegmentReader::heap(segment, seat),
        }
    }

    fn reader(&self, cell: u32) -> SegmentReader {
        self.seat(seat(cell)).unwrap()
    }

    fn control(&self) -> SegmentControl {
        match self {
            Self::Memfd(fds) => SegmentControl::map(&fds.data, &fds.ctl).unwrap(),
            Self::Heap(segment) => SegmentControl::heap(segment).unwrap(),
        }
    }
}

/// Runs a test over both kinds.
fn both(spec: Spec, test: impl Fn(SegmentWriter, Shared)) {
    let (writer, segment) = SegmentWriter::heap(spec, Epoch(3)).unwrap();
    test(writer, Shared::Heap(segment));
    if !cfg!(miri) {
        let (writer, fds) = SegmentWriter::create(spec, Epoch(3)).unwrap();
        test(writer, Shared::Memfd(fds));
    }
}

fn seat(cell: u32) -> Seat {
    Seat {
        cell,
        pins: BASE_PINS,
        bell: Bell {
            client: 0,
            bit: u16::try_from(cell).unwrap(),
        },
    }
}

fn origin(pos: u64) -> Origin {
    Origin {
        epoch: Epoch(3),
        seq: Seq(pos),
        capture: Time(pos * 10),
        publish: Time(pos * 10 + 1),
        ..Origin::default()
    }
}

/// Publishes the next sample with a content that follows from its position.
fn publish(writer: &mut SegmentWriter, len: usize) -> u64 {
    let pos = writer.published() + 1;
    let mut slot = writer.loan(len).unwrap();
    fill(pos, writer.slot_bytes_mut(&mut slot));
    assert_eq!(writer.publish(slot, &origin(pos)), pos);
    pos
}

fn fill(pos: u64, payload: &mut [u8]) {
    for (at, byte) in payload.iter_mut().enumerate() {
        *byte = expected(pos, at);
    }
}

fn expected(pos: u64, at: usize) -> u8 {
    let mixed = (pos.wrapping_mul(31) ^ u64::try_from(at).unwrap()).wrapping_mul(0x9e37_79b9);
    mixed.to_le_bytes()[2]
}

fn assert_is_sample(pos: u64, payload: &[u8]) {
    let torn = (0..payload.len()).find(|at| payload[*at] != expected(pos, *at));
    assert_eq!(torn, None, "sample {pos} is torn");
}

#[test]
fn what_was_published_is_read() {
    both(SPEC, |mut writer, shared| {
        let reader = shared.reader(0);
        let mut payload = Vec::new();
        assert_eq!(reader.head_pos(), 0);
        assert_eq!(reader.copy_newest(&mut payload), Err(PinError::NotYet));

        publish(&mut writer, 4096);
        publish(&mut writer, 64);

        let stamp = reader.copy_newest(&mut payload).unwrap();
        assert_eq!((stamp.pos, stamp.len, stamp.origin), (2, 64, origin(2)));
        assert_is_sample(2, &payload);
        let first = reader.pin(1).unwrap();
        assert_eq!(first.bytes().len(), 4096);
        assert_is_sample(1, first.bytes());
        assert_eq!(first.as_ptr().align_offset(128), 0);
        assert_eq!((reader.epoch(), reader.spec()), (Epoch(3), SPEC));
    });
}

#[test]
fn positions_account_for_what_was_overwritten() {
    both(SPEC, |mut writer, shared| {
        let reader = shared.reader(0);
        for _ in 0..10 {
            publish(&mut writer, 8);
        }

        let mut payload = Vec::new();
        let outcomes: Vec<_> = (1..=11)
            .map(|pos| reader.copy(pos, &mut payload).map(|stamp| stamp.pos))
            .collect();

        let mut expected = vec![Err(PinError::Overwritten); 6];
        expected.extend((7..=10).map(Ok));
        expected.push(Err(PinError::NotYet));
        assert_eq!(outcomes, expected);
        assert_eq!(reader.copy(0, &mut payload), Err(PinError::NotYet));
    });
}

#[test]
fn a_pinned_sample_stays_while_it_is_held() {
    both(SPEC, |mut writer, shared| {
        let reader = shared.reader(0);
        let held = publish(&mut writer, 4096);
        let pin = reader.pin_newest().unwrap();

        for _ in 0..200 {
            publish(&mut writer, 4096);
        }

        assert!(reader.still_intact(&pin));
        assert_is_sample(held, pin.bytes());
        assert_eq!(reader.pin(held).unwrap_err(), PinError::Overwritten);
        assert_eq!(writer.forced(), 0);
    });
}

#[test]
fn a_reader_that_holds_its_quota_is_refused_and_the_writer_is_not() {
    both(SPEC, |mut writer, shared| {
        let readers: Vec<_> = (0..SPEC.cells).map(|cell| shared.reader(cell)).collect();
        let mut pins: Vec<(u64, Pin)> = Vec::new();
        for _ in 0..BASE_PINS {
            for reader in &readers {
                let pos = publish(&mut writer, 16);
                pins.push((pos, reader.pin(pos).unwrap()));
            }
        }
        assert_eq!(readers[0].pin_newest().unwrap_err(), PinError::NoPin);

        for _ in 0..100 {
            publish(&mut writer, 16);
        }

        assert_eq!(writer.forced(), 0);
        for (pos, pin) in &pins {
            assert!(pin.is_intact());
            assert_is_sample(*pos, pin.bytes());
        }
        pins.clear();
        assert!(readers[0].pin_newest().is_ok());
    });
}

#[test]
fn copies_of_every_length_are_whole() {
    let spec = Spec {
        capacity_bytes: 1200,
        ..SPEC
    };
    both(spec, |mut writer, shared| {
        let reader = shared.reader(0);
        let mut payload = vec![0xff; 7];
        let step = if cfg!(miri) { 149 } else { 1 };
        for len in (0..=1200).step_by(step) {
            let pos = publish(&mut writer, len);
            assert_eq!(reader.copy_newest(&mut payload).unwrap().pos, pos);
            assert_eq!(payload.len(), len);
            assert_is_sample(pos, &payload);
        }
    });
}

#[test]
fn a_small_copy_needs_no_pin() {
    let (mut writer, fds) = SegmentWriter::create(SPEC, Epoch(3)).unwrap();
    let reader = SegmentReader::map(&fds, seat(0)).unwrap();
    publish(&mut writer, 4096);
    publish(&mut writer, 64);
    let _held: Vec<_> = (0..BASE_PINS).map(|_| reader.pin(1).unwrap()).collect();
    let mut payload = Vec::new();

    assert_eq!(reader.copy(2, &mut payload).unwrap().pos, 2);
    assert_is_sample(2, &payload);
    assert_eq!(reader.copy(1, &mut payload), Err(PinError::NoPin));
    // Neither is it refused when it would rather have one, after misses.
    for _ in 0..4 {
        publish(&mut writer, 32);
    }
    let mut copier = Copier::new(&mut payload);
    for _ in 0..10 {
        assert_eq!(copier.copy(&reader, 1), Err(PinError::Overwritten));
    }
    copier.copy(&reader, 6).unwrap();
    assert_eq!(copier.stamp().pos, 6);
    assert_is_sample(6, copier.payload());
}

#[test]
fn a_starved_writer_takes_the_oldest_and_the_guard_can_tell() {
    let spec = Spec {
        cells: 1,
        pool: 0,
        ..SPEC
    };
    both(spec, |mut writer, shared| {
        // More pins than the item has slots for: what a lying reader gives itself.
        let liar = shared
            .seat(Seat {
                pins: MAX_PINS,
                ..seat(0)
            })
            .unwrap();
        let mut pins = Vec::new();
        for _ in 0..9 {
            let pos = publish(&mut writer, 16);
            pins.push(liar.pin(pos).unwrap());
        }
        assert_eq!(
            writer.forced(),
            1,
            "the ninth sample found all 8 slots held"
        );

        let first = &pins[0];
        assert!(
            !liar.still_intact(first),
            "the oldest held sample was overwritten"
        );
        let mut payload = Vec::new();
        assert!(!first.copy_to(&mut payload));
        assert!(pins[1..].iter().all(Pin::is_intact));
    });
}

#[test]
fn lies_in_ctl_do_not_harm_the_writer() {
    use ddx_store::layout::{LINE_WORDS, WAITING};
    use ddx_store::ring::Words;
    use ddx_store::shm::memfd::{Access, CTL_SEALS, map};

    let (mut writer, fds) = SegmentWriter::create(SPEC, Epoch(3)).unwrap();
    writer.set_bells(Some(Arc::new(Bells::heap().unwrap())));
    let ctl = map(&fds.ctl, "ctl", CTL_SEALS, Access::ReadWrite).unwrap();
    let honest = SegmentReader::map(&fds, seat(0)).unwrap();
    let mut payload = Vec::new();

    for lie in [u64::MAX, 1, 17, 1 << 32, 0x0101_0101_0101_0101, 0] {
        for at in 0..ctl.len() / 8 {
            ctl.store(
                at,
                lie.wrapping_add(u64::try_from(at / LINE_WORDS).unwrap()),
                Relaxed,
            );
        }
        ctl.store(WAITING, lie, Relaxed);
        for _ in 0..50 {
            let pos = publish(&mut writer, 100);
            assert_eq!(honest.copy_newest(&mut payload).unwrap().pos, pos);
            assert_is_sample(pos, &payload);
        }
    }
    assert_eq!(writer.published(), 300);
}

#[test]
fn no_sample_is_torn_under_load() {
    let rounds = if cfg!(miri) { 50 } else { 30_000 };
    let spec = Spec {
        capacity_bytes: 256,
        depth: 2,
        ..SPEC
    };
    both(spec, |mut writer, shared| {
        let done = AtomicBool::new(false);
        thread::scope(|scope| {
            let readers: Vec<_> = (0..3)
                .map(|cell| {
                    let reader = shared.reader(cell);
                    let done = &done;
                    scope.spawn(move || read_until_done(&reader, done, cell == 0))
                })
                .collect();
            for _ in 0..rounds {
                publish(&mut writer, 256);
            }
            done.store(true, Relaxed);
            for reader in readers {
                assert_eq!(
                    reader.join().unwrap(),
                    rounds,
                    "the last value did not arrive"
                );
            }
        });
        assert_eq!(writer.forced(), 0);
    });
}

/// Reads the newest sample again and again, in place or as a copy; returns the last position.
fn read_until_done(reader: &SegmentReader, done: &AtomicBool, in_place: bool) -> u64 {
    let mut payload = Vec::new();
    let mut last = 0;
    loop {
        let was_done = done.load(Relaxed);
        let pos = if in_place {
            reader.pin_newest().map(|pin| {
                assert_is_sample(pin.stamp().pos, pin.bytes());
                assert!(pin.is_intact());
                pin.stamp().pos
            })
        } else {
            reader.copy_newest(&mut payload).map(|stamp| {
                assert_eq!(stamp.origin, origin(stamp.pos));
                assert_is_sample(stamp.pos, &payload);
                stamp.pos
            })
        };
        match pos {
            Ok(pos) => {
                assert!(pos >= last, "time ran backwards");
                last = pos;
            }
            Err(PinError::NotYet | PinError::Overwritten) => {}
            Err(error) => panic!("{error}"),
        }
        if was_done {
            return last;
        }
    }
}

#[test]
fn a_waiting_reader_is_woken() {
    both(SPEC, |mut writer, shared| {
        let rounds = if cfg!(miri) { 5 } else { 2_000 };
        let bells = Arc::new(Bells::heap().unwrap());
        writer.set_bells(Some(Arc::clone(&bells)));
        let there = shared.reader(0);
        let seen_pos = std::sync::atomic::AtomicU64::new(0);
        thread::scope(|scope| {
            scope.spawn(|| {
                let mut last = 0;
                while last < rounds {
                    there.set_waiting(true);
                    let seen = bells.arm(0);
                    if there.head_pos() == last {
                        bells.wait(0, seen, Duration::from_secs(60));
                    }
                    last = there.head_pos();
                    seen_pos.store(last, Relaxed);
                }
                there.set_waiting(false);
            });
            for _ in 0..rounds {
                let pos = publish(&mut writer, 8);
                while seen_pos.load(Relaxed) < pos {
                    thread::yield_now();
                }
            }
        });
        assert_eq!(bells.take_dirty(0)[0], 1, "the bit of cell 0");
        assert_eq!(bells.take_dirty(0)[0], 0);
    });
}

#[test]
fn states_are_told_and_cells_are_cleared() {
    both(SPEC, |mut writer, shared| {
        let control = shared.control();
        let bells = Bells::heap().unwrap();
        let reader = shared.reader(2);
        reader.set_waiting(true);
        let pos = publish(&mut writer, 16);
        let pin = reader.pin(pos).unwrap();

        let superseded = State {
            superseded: true,
            ..State::default()
        };
        control.set_state(superseded, &bells);

        assert_eq!((reader.state(), writer.state()), (superseded, superseded));
        assert_eq!(bells.take_dirty(0)[0], 1 << 2);
        assert_eq!(control.open_cells(), 1 << 2);

        control.clear_cell(2);
        control.clear_cell(SPEC.cells);
        assert_eq!(control.open_cells(), 0);
        for _ in 0..20 {
            publish(&mut writer, 16);
        }
        assert!(!pin.is_intact(), "the cleared pin protects nothing");

        let mut payload = Vec::new();
        let newest = control.copy_newest(&mut payload).unwrap();
        assert_eq!((newest.pos, control.newest()), (21, Some(newest)));
        assert_is_sample(21, &payload);
    });
}

#[test]
fn a_guard_outlives_its_reader_and_writer() {
    both(SPEC, |mut writer, shared| {
        let reader = shared.reader(0);
        let pos = publish(&mut writer, 512);
        let pin = reader.pin(pos).unwrap();
        let control = shared.control();

        drop((reader, writer, shared));

        assert_is_sample(pos, pin.bytes());
        assert_eq!(
            control.open_cells(),
            1,
            "the seat is taken while a guard lives"
        );
        drop(pin);
        assert_eq!(control.open_cells(), 0);
    });
}

#[test]
fn impossible_loans_and_seats_are_refused() {
    both(SPEC, |mut writer, shared| {
        let too_long = LoanError::TooLong {
            len: 4097,
            capacity: 4096,
        };
        assert_eq!(writer.loan(4097).unwrap_err(), too_long);
        let slots: Vec<_> = std::iter::from_fn(|| writer.loan(1).ok()).collect();
        assert_eq!(writer.loan(1).unwrap_err(), LoanError::NoSlot);
        for slot in slots {
            writer.discard(slot);
        }
        assert_eq!(publish(&mut writer, 1), 1);

        for bad in [
            Seat {
                cell: SPEC.cells,
                ..seat(0)
            },
            Seat {
                pins: MAX_PINS + 1,
                ..seat(0)
            },
            Seat { pins: 0, ..seat(0) },
        ] {
            assert!(matches!(shared.seat(bad), Err(SegmentError::Seat { .. })));
        }
    });
}

#[test]
fn files_that_are_not_segments_are_refused() {
    use ddx_store::layout::{LINE, Spec};
    use ddx_store::shm::{ShmError, memfd};

    let (_writer, good) = SegmentWriter::create(SPEC, Epoch(1)).unwrap();
    let refused = |data, ctl| {
        let fds = SegmentFds { data, ctl };
        SegmentReader::map(&fds, seat(0)).unwrap_err()
    };
    let sealed = |len, seals| {
        let (map, fd) = memfd::create(c"test", len).unwrap();
        drop(map);
        memfd::seal(&fd, seals).unwrap();
        fd
    };
    let ctl = || good.ctl.try_clone().unwrap();

    let unsealed = memfd::create(c"test", LINE).unwrap().1;
    let unsealed = refused(unsealed, ctl());
    assert!(
        matches!(unsealed, SegmentError::Shm(ShmError::Seals { .. })),
        "{unsealed}"
    );
    let swapped = refused(ctl(), good.data.try_clone().unwrap());
    assert!(
        matches!(swapped, SegmentError::Shm(ShmError::Seals { .. })),
        "{swapped}"
    );
    let no_file = refused(std::io::pipe().unwrap().0.into(), ctl());
    assert!(
        matches!(no_file, SegmentError::Shm(ShmError::Seals { .. })),
        "{no_file}"
    );
    let odd = refused(sealed(LINE + 1, memfd::DATA_SEALS), ctl());
    assert!(
        matches!(odd, SegmentError::Shm(ShmError::Size { .. })),
        "{odd}"
    );
    let zeros = refused(sealed(1 << 20, memfd::DATA_SEALS), ctl());
    assert!(matches!(zeros, SegmentError::Layout(_)), "{zeros}");
    let other = Spec { cells: 5, ..SPEC };
    let (_other, other) = SegmentWriter::create(other, Epoch(1)).unwrap();
    let mixed = refused(good.data.try_clone().unwrap(), other.ctl);
    assert!(matches!(mixed, SegmentError::Layout(_)), "{mixed}");
}
