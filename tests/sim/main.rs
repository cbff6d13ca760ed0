//! What the pure machines promise, proven in virtual time over seeds: control plane, sender, receiver, all of each host.
//!
//! | file | what must hold |
//! |---|---|
//! | `directory.rs` | everybody learns everything, soon, also after a partition; nobody alive is declared dead; idling is cheap |
//! | `delivery.rs` | the last value arrives; nothing is sent twice, too often, to nobody or too large |
//! | `links.rs` | the same over each link profile, and a profile does what it says |
//! | `paths.rs` | samples flow on when an address, a link or a network of several goes |
//! | `matrix.rs` | samples of all sizes over each link profile, in a time that the link explains, with exact books |
//! | `share.rs` | what shares a link: unlike priorities, commands beside bulk, unlike viewers, a group that loses |
//! | `books.rs` | the fates of samples add up on each hop, the hops agree, and readers are told |
//! | `chance.rs` | the same under whatever a seed thinks up, with each sample judged |
//!
//! A failure prints its seed and the line that replays it. `DDX_SEED=n` runs that seed alone, `DDX_SEEDS=n` runs as many
//! of the scenarios left to chance; see [`seeds`].

#![expect(
    clippy::unwrap_used,
    reason = "a helper of a test fails the test, as the test itself would"
)]

mod books;
mod chance;
mod delivery;
mod directory;
mod fleet;
mod links;
mod matrix;
mod paths;
mod seeds;
mod share;
mod video;

use std::time::Duration;

use ddx_rig::sim::Sim;

fn secs(s: u64) -> Duration {
    Duration::from_secs(s)
}

fn millis(ms: u64) -> Duration {
    Duration::from_millis(ms)
}

/// Fails with the first promises that were broken.
fn check(sim: &Sim) -> Result<(), String> {
    if sim.clock_errors > 0 {
        return Err(format!("{} clock estimates are wrong", sim.clock_errors));
    }
    match sim.broken.as_slice() {
        [] => Ok(()),
        broken => {
            let first: Vec<String> = broken.iter().take(4).map(|b| format!("{b:?}")).collect();
            Err(format!("{} broken: {}", broken.len(), first.join("; ")))
        }
    }
}

/// `Err` with a text, unless something holds.
fn ensure(holds: bool, text: impl FnOnce() -> String) -> Result<(), String> {
    if holds { Ok(()) } else { Err(text()) }
}
