//! Runs a scenario over seeds, on two threads, and says how a failing one is replayed.

use std::env;
use std::ops::Range;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};
use std::thread;

/// As many as the cores of a small CI machine.
const THREADS: usize = 2;
/// Failures after which a scenario stops.
const FAILURES_MAX: usize = 8;

/// Runs `scenario` for each seed, or for `DDX_SEED` alone, and fails with all that failed.
pub(crate) fn run(
    test: &str,
    seeds: Range<u64>,
    scenario: impl Fn(u64) -> Result<(), String> + Sync,
) {
    let seeds = number("DDX_SEED").map_or(seeds, |seed| seed..seed + 1);
    let next = AtomicU64::new(seeds.start);
    let failures = Mutex::new(Vec::new());
    thread::scope(|scope| {
        for _ in 0..THREADS {
            scope.spawn(|| {
                loop {
                    let seed = next.fetch_add(1, Ordering::Relaxed);
                    if seed >= seeds.end || failures.lock().unwrap().len() >= FAILURES_MAX {
                        return;
                    }
                    let result = catch_unwind(AssertUnwindSafe(|| scenario(seed)));
                    let result = result.unwrap_or_else(|_| Err("panicked".to_owned()));
                    if let Err(text) = result {
                        failures.lock().unwrap().push((seed, text));
                    }
                }
            });
        }
    });
    let mut failures = failures.into_inner().unwrap();
    failures.sort();
    let lines: Vec<String> = failures
        .iter()
        .map(|(seed, text)| {
            let module = test.replace("::", "/");
            let replay = format!("DDX_SEED={seed} cargo test --release --test sim {test}");
            format!("{module}, seed {seed}: {text}\n    replay: {replay}")
        })
        .collect();
    assert!(lines.is_empty(), "\n{}", lines.join("\n"));
}

/// How many seeds to run, unless `DDX_SEEDS` says otherwise.
pub(crate) fn count(usual: u64) -> u64 {
    number("DDX_SEEDS").unwrap_or(usual)
}

/// The number in an environment variable.
pub(crate) fn number(variable: &str) -> Option<u64> {
    let text = env::var(variable).ok()?;
    Some(
        text.parse()
            .unwrap_or_else(|_| panic!("{variable} is `{text}`, which is no number")),
    )
}
