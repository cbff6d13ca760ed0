//! The wish that this program end: SIGINT, SIGTERM, or, for a tethered child, the end of standard input.

use std::io::Read as _;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::Duration;

use anyhow::Context as _;
use ddx_wire::Time;
use tokio::signal::unix::{SignalKind, signal};
use tokio::sync::Notify;

/// Tells verbs that they should come to an end.
#[derive(Clone, Debug, Default)]
pub(crate) struct Interrupt {
    shared: Arc<Shared>,
}

#[derive(Debug, Default)]
struct Shared {
    raised: AtomicBool,
    wake: Notify,
}

impl Interrupt {
    /// Starts to listen, on threads of its own.
    pub(crate) fn listen(tethered: bool) -> anyhow::Result<Self> {
        let interrupt = Self::default();
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_io()
            .build()
            .context("start the signal thread")?;
        // Registered before this returns, so that no signal finds the default action.
        let (mut interrupted, mut terminated) = {
            let _entered = runtime.enter();
            (
                signal(SignalKind::interrupt())?,
                signal(SignalKind::terminate())?,
            )
        };
        let raised = interrupt.clone();
        thread::Builder::new()
            .name("signals".to_owned())
            .spawn(move || {
                runtime.block_on(async {
                    tokio::select! {
                        _ = interrupted.recv() => {}
                        _ = terminated.recv() => {}
                    }
                });
                raised.raise();
            })?;
        if tethered {
            let raised = interrupt.clone();
            thread::Builder::new()
                .name("tether".to_owned())
                .spawn(move || {
                    let mut byte = [0];
                    while matches!(std::io::stdin().read(&mut byte), Ok(1..)) {}
                    raised.raise();
                })?;
        }
        Ok(interrupt)
    }

    /// Whether the program should end.
    pub(crate) fn is_raised(&self) -> bool {
        self.shared.raised.load(Ordering::Relaxed)
    }

    /// Sleeps until `due`; false when the program should end first.
    pub(crate) fn sleep_until(&self, due: Time) -> bool {
        loop {
            if self.is_raised() {
                return false;
            }
            let left = due.since(ddx_store::now());
            if left.is_zero() {
                return true;
            }
            thread::sleep(left.min(SLICE));
        }
    }

    /// Completes when the program should end.
    pub(crate) async fn raised(self) {
        while !self.is_raised() {
            self.shared.wake.notified().await;
        }
    }

    fn raise(&self) {
        self.shared.raised.store(true, Ordering::Relaxed);
        // Keeps the permit for a waiter that is about to wait.
        self.shared.wake.notify_one();
    }
}

/// Longest sleep: how late an interrupt may be heard.
pub(super) const SLICE: Duration = Duration::from_millis(50);
