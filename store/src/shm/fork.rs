//! Telling a forked child from its parent.
//!
//! Mappings are not inherited (MADV_DONTFORK), and a child must not use its parent's seat. So every handle remembers
//! the generation in which it was made.

use std::sync::Once;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

static GENERATION: AtomicU64 = AtomicU64::new(0);
static HOOKED: Once = Once::new();

/// Forks between the process that first asked and this one: what a handle remembers.
pub fn generation() -> u64 {
    HOOKED.call_once(|| {
        // SAFETY: `count` is a function of the right type that lives as long as the program and does only what a
        // child of a process with threads may do: one atomic addition.
        let refused = unsafe { libc::pthread_atfork(None, None, Some(count)) };
        // Only a lack of memory can refuse; a child then would not be told, so better stop here.
        assert_eq!(refused, 0, "pthread_atfork has no memory");
    });
    GENERATION.load(Relaxed)
}

/// True in a child forked since [`generation`] gave this. Costs one load.
#[inline]
pub fn is_past(generation: u64) -> bool {
    GENERATION.load(Relaxed) != generation
}

unsafe extern "C" fn count() {
    GENERATION.fetch_add(1, Relaxed);
}

#[cfg(all(test, not(miri)))]
mod tests {
    use super::*;

    #[test]
    fn a_child_is_of_another_generation() {
        let before = generation();
        // SAFETY: the child makes no call but `_exit`.
        let pid = unsafe { libc::fork() };
        if pid == 0 {
            let code = i32::from(!is_past(before));
            // SAFETY: ends the child at once, without destructors of the parent's threads.
            unsafe { libc::_exit(code) };
        }
        let mut status = -1;
        // SAFETY: `status` is valid for the call, and `pid` is a child of this process.
        let waited = unsafe { libc::waitpid(pid, &raw mut status, 0) };

        assert_eq!(waited, pid);
        assert_eq!(status, 0, "the child saw its parent's generation");
        assert!(!is_past(before));
    }
}
