//! Frames that one program publishes at a rate and another looks at, and what one of them costs each program. Peers share it.

use std::thread;
use std::time::{Duration, Instant};

use anyhow::Result;
use rustix::time::{ClockId, clock_gettime};

/// Frames before the first that counts.
const WARM_UP: u32 = 10;

/// Publishes at `rate` frames a second. Prints the processor time that this program took for each of `count` frames, nanoseconds,
/// and goes on until it is killed.
pub(crate) fn feed(rate: u32, count: u32, mut publish: impl FnMut() -> Result<()>) -> Result<()> {
    let period = Duration::from_secs(1) / rate.max(1);
    let mut due = Instant::now();
    let mut turn = || {
        due += period;
        thread::sleep(due.saturating_duration_since(Instant::now()));
        publish()
    };
    for _ in 0..WARM_UP {
        turn()?;
    }
    let before = cpu_ns();
    for _ in 0..count {
        turn()?;
    }
    println!("{}", each(before, count));
    loop {
        turn()?;
    }
}

/// Looks at frames. Prints a line once some have come, and the processor time that this program took for each of `count` more,
/// nanoseconds.
pub(crate) fn view(count: u32, mut take: impl FnMut() -> Result<()>) -> Result<()> {
    for _ in 0..WARM_UP {
        take()?;
    }
    println!("ready");
    let before = cpu_ns();
    for _ in 0..count {
        take()?;
    }
    println!("{}", each(before, count));
    Ok(())
}

fn each(before: u64, count: u32) -> u64 {
    cpu_ns().saturating_sub(before) / u64::from(count.max(1))
}

/// Of all threads of this program.
fn cpu_ns() -> u64 {
    let at = clock_gettime(ClockId::ProcessCPUTime);
    let seconds = u64::try_from(at.tv_sec).unwrap_or(0);
    seconds * 1_000_000_000 + u64::try_from(at.tv_nsec).unwrap_or(0)
}
