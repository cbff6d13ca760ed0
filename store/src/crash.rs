//! Named steps at which a test may kill the process or see where it was killed. Nothing without `crash-points`.
//!
//! `DDX_CRASH_AT=step` or `step:n` kills the process by SIGKILL at the n-th time it reaches that step.
//! `DDX_CRASH_TRACE=path` keeps the last step reached, padded to 32 bytes, at the start of that file.

/// Reaches a step: `step` names what has just been done, as `publish.head`.
#[cfg(not(feature = "crash-points"))]
#[inline(always)]
pub(crate) fn point(_step: &'static str) {}

#[cfg(feature = "crash-points")]
pub(crate) use traced::point;

#[cfg(feature = "crash-points")]
mod traced {
    use std::fs::File;
    use std::os::unix::fs::FileExt;
    use std::sync::OnceLock;
    use std::sync::atomic::{AtomicU64, Ordering};

    use rustix::process::{Signal, getpid, kill_process};

    /// Length of a step's name in the trace, bytes.
    const NAME_BYTES: usize = 32;

    struct Plan {
        step: String,
        left: AtomicU64,
        trace: Option<File>,
    }

    /// Reaches a step: `step` names what has just been done, as `publish.head`.
    pub(crate) fn point(step: &'static str) {
        static PLAN: OnceLock<Plan> = OnceLock::new();
        let plan = PLAN.get_or_init(Plan::from_env);
        if let Some(trace) = &plan.trace {
            let mut name = [0; NAME_BYTES];
            for (to, from) in name.iter_mut().zip(step.bytes()) {
                *to = from;
            }
            let _written = trace.write_all_at(&name, 0);
        }
        if plan.step == step && plan.left.fetch_sub(1, Ordering::Relaxed) == 1 {
            let _killed = kill_process(getpid(), Signal::KILL);
            loop {
                std::thread::park();
            }
        }
    }

    impl Plan {
        fn from_env() -> Self {
            let text = std::env::var("DDX_CRASH_AT").unwrap_or_default();
            let (step, count) = text.split_once(':').unwrap_or((&text, "1"));
            Self {
                step: step.to_owned(),
                left: AtomicU64::new(count.parse().unwrap_or(1)),
                trace: std::env::var_os("DDX_CRASH_TRACE")
                    .and_then(|path| File::options().write(true).open(path).ok()),
            }
        }
    }
}
