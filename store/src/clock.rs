//! The host's clock as samples use it.

use ddx_wire::Time;

/// Reads CLOCK_BOOTTIME, which counts through suspend and never steps. Makes no system call where the kernel offers
/// the clock to user space, as it does on all common platforms.
#[inline]
#[expect(unsafe_code, reason = "std has no boot-time clock")]
pub fn now() -> Time {
    let mut read = libc::timespec {
        tv_sec: 0,
        tv_nsec: 0,
    };
    // SAFETY: `read` is a valid timespec that lives through the call.
    unsafe { libc::clock_gettime(libc::CLOCK_BOOTTIME, &raw mut read) };
    // The kernel never reports a negative time since boot, and the call cannot fail for a clock of every kernel.
    let seconds = u64::try_from(read.tv_sec).unwrap_or(0);
    let nanoseconds = u64::try_from(read.tv_nsec).unwrap_or(0);
    Time(
        seconds
            .saturating_mul(1_000_000_000)
            .saturating_add(nanoseconds),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn advances_and_is_not_zero() {
        let first = now();
        let second = now();
        assert!(first > Time(0));
        assert!(second >= first);
    }
}
