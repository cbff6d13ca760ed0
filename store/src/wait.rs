//! Blocking until something is there: one loop for one reader and for many.

use std::sync::Arc;
use std::time::{Duration, Instant};

use crate::connection::Connection;
use crate::error::Error;
use crate::notify::MAX_SLICE;
use crate::reader::RawReader;

/// A reader that can be waited for, typed or not.
pub trait Wait {
    /// The reader beneath.
    #[doc(hidden)]
    fn raw(&mut self) -> &mut RawReader;
}

/// Whether a reader has something to read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Readiness {
    /// It has.
    Ready,
    /// It has not: its bell will be rung.
    Waiting,
    /// It will have after this span, without a bell.
    In(Duration),
}

/// Blocks until one of the readers has something newer than it has seen, at most `deadline`, and says which; none when the
/// time has passed. All readers belong to one store.
pub fn wait_any(readers: &mut [&mut dyn Wait], deadline: Duration) -> Result<Option<usize>, Error> {
    let mut connections = readers.iter_mut().map(|reader| reader.raw().connection());
    let Some(connection) = connections.next() else {
        return Err(Error::Argument("no readers to wait for".to_owned()));
    };
    if connections.any(|other| !Arc::ptr_eq(&other, &connection)) {
        return Err(Error::Argument(
            "the readers belong to different stores".to_owned(),
        ));
    }
    let mut set = Set {
        readers,
        found: None,
    };
    if set.readiness()? != Readiness::Ready && !deadline.is_zero() {
        sleep(&connection, &mut set, &mut Patience::new(deadline))?;
    }
    Ok(set.found)
}

/// What the loop waits for.
pub(crate) trait Condition {
    fn readiness(&mut self) -> Result<Readiness, Error>;
    fn set_waiting(&mut self, waiting: bool);
}

/// How long a call may still block. The clock is first read when that is first asked, so that a call which need not block
/// reads none, and one that does reads it once before it sleeps.
#[derive(Debug)]
pub(crate) struct Patience {
    timeout: Duration,
    start: Option<Instant>,
}

impl Patience {
    pub(crate) fn new(timeout: Duration) -> Self {
        Self {
            timeout,
            start: None,
        }
    }

    /// What is left of the time since this was first asked.
    pub(crate) fn left(&mut self) -> Duration {
        match self.start {
            Some(start) => self.timeout.saturating_sub(start.elapsed()),
            None => {
                self.start = Some(Instant::now());
                self.timeout
            }
        }
    }
}

/// Blocks until a condition that was not ready is, as long as there is patience; false when there is none left. Between two
/// slices of at most 100 ms it looks at the daemon's socket.
pub(crate) fn sleep(
    connection: &Connection,
    condition: &mut impl Condition,
    patience: &mut Patience,
) -> Result<bool, Error> {
    let waited = sleep_until_ready(connection, condition, patience);
    condition.set_waiting(false);
    waited
}

fn sleep_until_ready(
    connection: &Connection,
    condition: &mut impl Condition,
    patience: &mut Patience,
) -> Result<bool, Error> {
    loop {
        let (bells, client) = connection.bell();
        condition.set_waiting(true);
        let seen = bells.arm(client);
        let slice = match condition.readiness() {
            Ok(Readiness::Waiting) => MAX_SLICE,
            Ok(Readiness::In(span)) => span.min(MAX_SLICE),
            ready => return ready.map(|_| true),
        };
        let left = patience.left();
        if left.is_zero() {
            return Ok(false);
        }
        bells.wait(client, seen, slice.min(left));
        // What the daemon has to say rings no bell, or marks the segment that it is about: it costs a system call, so a sample
        // that came goes first.
        if condition.readiness()? == Readiness::Ready {
            return Ok(true);
        }
        connection.tend()?;
    }
}

struct Set<'a, 'b> {
    readers: &'a mut [&'b mut dyn Wait],
    found: Option<usize>,
}

impl Condition for Set<'_, '_> {
    fn readiness(&mut self) -> Result<Readiness, Error> {
        let mut soonest = Readiness::Waiting;
        for (at, reader) in self.readers.iter_mut().enumerate() {
            match (reader.raw().readiness()?, soonest) {
                (Readiness::Ready, _) => {
                    self.found = Some(at);
                    return Ok(Readiness::Ready);
                }
                (Readiness::In(span), Readiness::In(other)) => {
                    soonest = Readiness::In(span.min(other));
                }
                (other @ Readiness::In(_), _) => soonest = other,
                (Readiness::Waiting, _) => {}
            }
        }
        Ok(soonest)
    }

    fn set_waiting(&mut self, waiting: bool) {
        for reader in self.readers.iter_mut() {
            reader.raw().set_waiting(waiting);
        }
    }
}
