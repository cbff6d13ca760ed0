//! The measurements themselves, the same code for everything that is measured: the peers compile this file too.

use std::time::Duration;

use anyhow::{Result, anyhow};
use rustix::thread::{CpuSet, sched_setaffinity};
use rustix::time::{ClockId, Timespec, clock_gettime};

/// Sends values of 64 bytes, or longer ones, of which the first eight are a stamp.
pub(crate) trait Send64 {
    /// Sends a value.
    fn send(&mut self, stamp: u64) -> Result<()>;
}

/// Takes what a [`Send64`] sends.
pub(crate) trait Take64 {
    /// Blocks or polls until a value is there that was not taken yet, and returns its stamp.
    fn take(&mut self) -> Result<u64>;
}

/// Both directions of one side.
pub(crate) struct Side<S, T> {
    /// Towards the other side.
    pub(crate) to: S,
    /// From the other side.
    pub(crate) from: T,
}

/// Where the two sides run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Cores {
    /// Both on one: every hand-over is a switch of threads, and all that either side does counts.
    One,
    /// Each on its own.
    Two,
}

/// Sends a value to and fro `count` times and returns the latencies of one direction: from before the value is made until it
/// is in the taker's hands, nanoseconds. Each side is made on the thread that uses it.
pub(crate) fn ping_pong<S: Send64, T: Take64>(
    count: usize,
    cores: Cores,
    near: impl FnOnce() -> Result<Side<S, T>> + Send,
    far: impl FnOnce() -> Result<Side<S, T>> + Send,
) -> Result<Vec<u64>> {
    std::thread::scope(|scope| {
        let answering = scope.spawn(move || {
            pin(usize::from(cores == Cores::Two))?;
            let mut far = far()?;
            let mut latencies = Vec::with_capacity(count);
            for _ in 0..count {
                let stamp = far.from.take()?;
                latencies.push(now_ns().saturating_sub(stamp));
                far.to.send(stamp)?;
            }
            anyhow::Ok(latencies)
        });
        let asking = scope.spawn(move || {
            pin(0)?;
            let mut near = near()?;
            for _ in 0..count {
                near.to.send(now_ns())?;
                near.from.take()?;
            }
            anyhow::Ok(())
        });
        asking
            .join()
            .map_err(|_panic| anyhow!("the asking thread panicked"))??;
        answering
            .join()
            .map_err(|_panic| anyhow!("the answering thread panicked"))?
    })
}

/// Runs `each` `count` times and returns the processor time of one, nanoseconds.
pub(crate) fn cpu_ns_each(count: u32, mut each: impl FnMut(u64) -> Result<()>) -> Result<f64> {
    let start = clock_gettime(ClockId::ThreadCPUTime);
    for turn in 0..u64::from(count) {
        each(turn)?;
    }
    let end = clock_gettime(ClockId::ThreadCPUTime);
    let spent = span(end).saturating_sub(span(start));
    Ok(spent.as_secs_f64() * 1e9 / f64::from(count))
}

/// The clock of stamps, the same in all processes and network namespaces of one machine.
pub(crate) fn now_ns() -> u64 {
    u64::try_from(span(clock_gettime(ClockId::Monotonic)).as_nanos()).unwrap_or(u64::MAX)
}

fn span(at: Timespec) -> Duration {
    Duration::new(
        u64::try_from(at.tv_sec).unwrap_or(0),
        u32::try_from(at.tv_nsec).unwrap_or(0),
    )
}

fn pin(core: usize) -> Result<()> {
    let available = std::thread::available_parallelism().map_or(1, usize::from);
    let mut cores = CpuSet::new();
    cores.set(core % available);
    sched_setaffinity(None, &cores)?;
    Ok(())
}
