//! A bounded queue between the control loop and a data thread, with a descriptor that tells when something is in it.
//!
//! The data threads sleep in `poll` and the control loop in tokio, so what both can wait for is a descriptor.

use std::collections::VecDeque;
use std::io::{self, Read as _, Write as _};
use std::os::fd::{AsFd, BorrowedFd};
use std::os::unix::net::UnixStream;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

/// The end that puts in. Cloned freely.
pub(crate) struct Sender<T>(Arc<Shared<T>>);

/// The one end that takes out.
pub(crate) struct Receiver<T> {
    shared: Arc<Shared<T>>,
    signal: UnixStream,
}

struct Shared<T> {
    queue: Mutex<VecDeque<T>>,
    capacity: usize,
    room: Condvar,
    /// One byte travels for each time that the queue stops being empty.
    signal: UnixStream,
}

/// Makes a queue of at most `capacity` entries.
pub(crate) fn mailbox<T>(capacity: usize) -> io::Result<(Sender<T>, Receiver<T>)> {
    let (theirs, signal) = UnixStream::pair()?;
    theirs.set_nonblocking(true)?;
    signal.set_nonblocking(true)?;
    let shared = Arc::new(Shared {
        queue: Mutex::default(),
        capacity,
        room: Condvar::new(),
        signal: theirs,
    });
    Ok((Sender(Arc::clone(&shared)), Receiver { shared, signal }))
}

impl<T> Shared<T> {
    fn lock(&self) -> MutexGuard<'_, VecDeque<T>> {
        // Entries are pushed and popped whole, so a panic elsewhere leaves the queue sound.
        self.queue.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn push(&self, queue: &mut VecDeque<T>, entry: T) {
        queue.push_back(entry);
        if queue.len() == 1 {
            // Fails only when the other end is gone.
            (&self.signal).write_all(&[1]).ok();
        }
    }
}

impl<T> Sender<T> {
    /// Puts `entry` in, or gives it back when the queue is full. Never waits.
    pub(crate) fn send(&self, entry: T) -> Result<(), T> {
        let mut queue = self.0.lock();
        if queue.len() >= self.0.capacity {
            return Err(entry);
        }
        self.0.push(&mut queue, entry);
        Ok(())
    }

    /// Puts `entry` in. Blocks while the queue is full, at most `patience`; then gives it back.
    pub(crate) fn send_within(&self, entry: T, patience: Duration) -> Result<(), T> {
        let full = |queue: &mut VecDeque<T>| queue.len() >= self.0.capacity;
        let waited = self
            .0
            .room
            .wait_timeout_while(self.0.lock(), patience, full);
        let (mut queue, _) = waited.unwrap_or_else(PoisonError::into_inner);
        if full(&mut queue) {
            return Err(entry);
        }
        self.0.push(&mut queue, entry);
        Ok(())
    }
}

impl<T> Receiver<T> {
    /// Takes everything out, in order. Never waits, and enters the kernel only when something was in.
    pub(crate) fn drain(&self) -> VecDeque<T> {
        let mut queue = self.shared.lock();
        if !queue.is_empty() {
            // One byte is there: the lock keeps the queue and the descriptor in step.
            (&self.signal).read_exact(&mut [0]).ok();
            self.shared.room.notify_all();
        }
        std::mem::take(&mut *queue)
    }

    /// A second descriptor that is readable while something is in, for a runtime that wants to own one.
    pub(crate) fn signal(&self) -> io::Result<UnixStream> {
        self.signal.try_clone()
    }
}

impl<T> Clone for Sender<T> {
    fn clone(&self) -> Self {
        Self(Arc::clone(&self.0))
    }
}

impl<T> AsFd for Receiver<T> {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.signal.as_fd()
    }
}

#[cfg(test)]
mod tests {
    use rustix::event::{PollFd, PollFlags, Timespec, poll};

    use super::*;

    fn readable<T>(receiver: &Receiver<T>) -> bool {
        let at_once = Timespec {
            tv_sec: 0,
            tv_nsec: 0,
        };
        poll(&mut [PollFd::new(receiver, PollFlags::IN)], Some(&at_once)).unwrap() == 1
    }

    #[test]
    fn the_descriptor_is_readable_while_something_is_in() {
        let (sender, receiver) = mailbox(4).unwrap();
        assert!(!readable(&receiver));
        sender.send(1).unwrap();
        sender.send(2).unwrap();
        assert!(readable(&receiver));
        assert_eq!(receiver.drain(), [1, 2]);
        assert!(!readable(&receiver));
        sender.send(3).unwrap();
        assert!(readable(&receiver));
    }

    #[test]
    fn a_full_queue_gives_the_entry_back() {
        let (sender, receiver) = mailbox(1).unwrap();
        sender.send("first").unwrap();
        assert_eq!(sender.send("second"), Err("second"));
        assert_eq!(receiver.drain(), ["first"]);
    }

    #[test]
    fn a_full_queue_can_be_waited_for() {
        let (sender, receiver) = mailbox(1).unwrap();
        sender.send(1).unwrap();
        let impatient = sender.send_within(2, Duration::ZERO);
        assert_eq!(impatient, Err(2));
        std::thread::scope(|scope| {
            let waiting = scope.spawn(|| sender.send_within(3, Duration::from_secs(60)));
            assert_eq!(receiver.drain(), [1]);
            assert_eq!(waiting.join().unwrap(), Ok(()));
        });
        assert_eq!(receiver.drain(), [3]);
    }
}
