//! A program that runs in a host of a lab.

use std::io::Write;
use std::process::{Child, ChildStdin, Command, ExitStatus, Stdio};
use std::sync::mpsc::{Receiver, RecvTimeoutError};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use super::error::Error;
use super::shell::{only_child_of, read_lines};

/// How a program ended, and what it wrote.
#[derive(Clone, Debug)]
pub struct Output {
    /// How it ended.
    pub status: ExitStatus,
    /// Its standard output.
    pub stdout: String,
    /// Its standard errors.
    pub stderr: String,
}

/// A running program; dropped, it is killed.
///
/// What it writes is read at once, so it never blocks on a full pipe, and is kept for the test.
#[derive(Debug)]
pub struct Process {
    what: String,
    /// `nsenter`, which waits for the program outside of the lab and ends as it ends.
    child: Child,
    stdin: Option<ChildStdin>,
    output: Mutex<Lines>,
    errors: Mutex<Lines>,
}

/// The lines of one pipe: those that were looked at, and those that were not.
#[derive(Debug)]
struct Lines {
    pipe: Receiver<String>,
    seen: Vec<String>,
}

impl Process {
    pub(crate) fn start(command: &mut Command, what: String) -> Result<Self, Error> {
        let mut child = command
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .map_err(Error::io(format!("start {what}")))?;
        let stdin = child.stdin.take();
        let (Some(stdout), Some(stderr)) = (child.stdout.take(), child.stderr.take()) else {
            return Err(Error::step(
                format!("start {what}"),
                "its output is not a pipe",
            ));
        };
        let output = Mutex::new(Lines {
            pipe: read_lines(stdout),
            seen: Vec::new(),
        });
        let errors = Mutex::new(Lines {
            pipe: read_lines(stderr),
            seen: Vec::new(),
        });
        Ok(Self {
            what,
            child,
            stdin,
            output,
            errors,
        })
    }

    /// Waits for the next line of standard output that `is_it` accepts, and returns it; lines before it are
    /// passed over.
    ///
    /// # Errors
    /// [`Error::TimedOut`] at the deadline, [`Error::Step`] if the program ends before; both tell what it wrote.
    pub fn wait_line(
        &self,
        is_it: impl Fn(&str) -> bool,
        deadline: Duration,
    ) -> Result<String, Error> {
        let until = Instant::now() + deadline;
        let mut output = lock(&self.output);
        loop {
            match output
                .pipe
                .recv_timeout(until.saturating_duration_since(Instant::now()))
            {
                Ok(line) => {
                    output.seen.push(line.clone());
                    if is_it(&line) {
                        return Ok(line);
                    }
                }
                Err(RecvTimeoutError::Timeout) => {
                    let what = format!("a line of {}", self.what);
                    let output = self.report(&mut output);
                    return Err(Error::TimedOut {
                        what,
                        waited: deadline,
                        output,
                    });
                }
                Err(RecvTimeoutError::Disconnected) => {
                    let report = self.report(&mut output);
                    return Err(Error::step(
                        format!("wait for a line of {}", self.what),
                        format!("it ended\n{report}"),
                    ));
                }
            }
        }
    }

    /// Returns all of standard output so far, including what [`Process::wait_line`] passed over.
    #[must_use]
    pub fn output(&self) -> String {
        lock(&self.output).all()
    }

    /// Returns all of standard errors so far.
    #[must_use]
    pub fn errors(&self) -> String {
        lock(&self.errors).all()
    }

    /// Writes one line to the program's standard input.
    ///
    /// # Errors
    /// [`Error::Io`] if the program no longer reads.
    pub fn write_line(&mut self, line: &str) -> Result<(), Error> {
        let Some(stdin) = self.stdin.as_mut() else {
            return Err(Error::step(
                format!("write to {}", self.what),
                "its input was closed",
            ));
        };
        writeln!(stdin, "{line}").map_err(Error::io(format!("write to {}", self.what)))
    }

    /// Closes the program's standard input.
    pub fn close_input(&mut self) {
        self.stdin = None;
    }

    /// Returns the program's process id on this machine.
    ///
    /// # Errors
    /// [`Error::Step`] if it has ended, [`Error::TimedOut`] if it has not been started within seconds.
    pub fn pid(&mut self) -> Result<u32, Error> {
        let until = Instant::now() + START_DEADLINE;
        loop {
            // While `nsenter` has not been waited for, its child's id cannot belong to another process.
            if self
                .child
                .try_wait()
                .map_err(Error::io(format!("find {}", self.what)))?
                .is_some()
            {
                return Err(Error::step(format!("find {}", self.what), "it has ended"));
            }
            if let Some(pid) = only_child_of(self.child.id())? {
                return Ok(pid);
            }
            if Instant::now() >= until {
                let output = self.report(&mut lock(&self.output));
                let what = format!("{} to start", self.what);
                return Err(Error::TimedOut {
                    what,
                    waited: START_DEADLINE,
                    output,
                });
            }
            thread::sleep(POLL_INTERVAL);
        }
    }

    /// Sends a signal by name (`TERM`, `STOP`, `CONT`) to the program alone.
    ///
    /// # Errors
    /// As [`Process::pid`], and [`Error::Step`] if the signal cannot be sent.
    pub fn signal(&mut self, name: &str) -> Result<(), Error> {
        let pid = self.pid()?;
        let step = || format!("send {name} to {}", self.what);
        let output = Command::new("sh")
            .args(["-c", "kill -s \"$0\" \"$1\"", name, &pid.to_string()])
            .output()
            .map_err(Error::io(step()))?;
        if output.status.success() {
            Ok(())
        } else {
            Err(Error::step(step(), String::from_utf8_lossy(&output.stderr)))
        }
    }

    /// Kills the program with `SIGKILL` and waits until it is gone.
    ///
    /// # Errors
    /// As [`Process::signal`] and [`Process::wait`].
    pub fn kill(&mut self) -> Result<ExitStatus, Error> {
        self.signal("KILL")?;
        self.wait(STOP_DEADLINE)
    }

    /// Sends `SIGTERM` and waits until the program has ended.
    ///
    /// # Errors
    /// As [`Process::signal`] and [`Process::wait`].
    pub fn terminate(&mut self, deadline: Duration) -> Result<ExitStatus, Error> {
        self.signal("TERM")?;
        self.wait(deadline)
    }

    /// Waits until the program has ended, and returns how; a signal shows as a signal.
    ///
    /// # Errors
    /// [`Error::TimedOut`] at the deadline, with what it wrote.
    pub fn wait(&mut self, deadline: Duration) -> Result<ExitStatus, Error> {
        let until = Instant::now() + deadline;
        loop {
            if let Some(status) = self
                .child
                .try_wait()
                .map_err(Error::io(format!("wait for {}", self.what)))?
            {
                return Ok(status);
            }
            if Instant::now() >= until {
                let output = self.report(&mut lock(&self.output));
                return Err(Error::TimedOut {
                    what: format!("{} to end", self.what),
                    waited: deadline,
                    output,
                });
            }
            thread::sleep(POLL_INTERVAL);
        }
    }

    /// Tells whether the program still runs.
    pub fn is_running(&mut self) -> bool {
        matches!(self.child.try_wait(), Ok(None))
    }

    fn report(&self, output: &mut Lines) -> String {
        format!(
            "standard output:\n{}standard errors:\n{}",
            output.all(),
            self.errors()
        )
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        if self.is_running() && self.kill().is_err() {
            // Either the program has just ended by itself, or the end of the lab takes it.
            let _already_gone = self.child.kill();
            let _status = self.child.wait();
        }
    }
}

impl Lines {
    fn all(&mut self) -> String {
        self.seen.extend(self.pipe.try_iter());
        self.seen
            .iter()
            .flat_map(|line| [line.as_str(), "\n"])
            .collect()
    }
}

fn lock(lines: &Mutex<Lines>) -> MutexGuard<'_, Lines> {
    lines.lock().unwrap_or_else(PoisonError::into_inner)
}

/// `nsenter` forks in a millisecond; only a stalled machine needs longer.
const START_DEADLINE: Duration = Duration::from_secs(5);

/// A killed process ends at once, unless the kernel hangs.
const STOP_DEADLINE: Duration = Duration::from_secs(5);

/// Short beside all that a lab measures; waiting with a deadline needs either this or a thread.
const POLL_INTERVAL: Duration = Duration::from_millis(2);
