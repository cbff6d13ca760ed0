//! The init process of a lab: one shell in fresh namespaces, fed through a pipe.
//!
//! Everything in a lab hangs on this pipe. Its write end is held by the test process alone, so when that
//! process ends in whatever way, the shell reads the end of its input and exits; it is the first process of its
//! PID namespace, so the kernel then kills all others in it, and the network and mount namespaces, which have
//! no name, go with them.

use std::fs;
use std::io::{BufRead, BufReader, Read, Write};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, Command, Stdio};
use std::sync::mpsc::{self, Receiver, RecvTimeoutError};
use std::thread;
use std::time::{Duration, Instant};

use super::error::Error;

/// Whose rights the lab is built with.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Rights {
    /// Those of root, as it is.
    Root,
    /// Those of root in a user namespace of its own, which any user may have where the machine allows it.
    UserNamespace,
}

/// The shell in the lab's namespaces: a command goes in, its output and status come out.
#[derive(Debug)]
pub(crate) struct Shell {
    child: Child,
    stdin: Option<ChildStdin>,
    lines: Receiver<String>,
    init_pid: u32,
    rights: Rights,
    commands: u64,
}

impl Shell {
    /// Starts the shell as root if this process is, else (or if root may not) in a user namespace.
    ///
    /// # Errors
    /// [`Error::Missing`] names each tool or permission that is absent.
    pub(crate) fn start() -> Result<Self, Error> {
        let missing: Vec<String> = TOOLS
            .iter()
            .filter(|(tool, _)| find(tool).is_none())
            .map(|(tool, package)| {
                format!("the command `{tool}` is missing (hint: apt-get install {package})")
            })
            .collect();
        if !missing.is_empty() {
            return Err(Error::Missing(missing));
        }
        let mut refusals = Vec::new();
        let is_root = fs::metadata("/proc/self").is_ok_and(|metadata| metadata.uid() == 0);
        if is_root {
            match Self::start_with(Rights::Root) {
                Ok(shell) => return Ok(shell),
                Err(error) => refusals.push(format!("as root: {error}")),
            }
        }
        match Self::start_with(Rights::UserNamespace) {
            Ok(shell) => Ok(shell),
            Err(error) => {
                refusals.push(format!("in a user namespace: {error}"));
                refusals.extend(user_namespace_hints());
                Err(Error::Missing(refusals))
            }
        }
    }

    fn start_with(rights: Rights) -> Result<Self, Error> {
        let mut command = Command::new("unshare");
        command.env("PATH", search_path());
        if rights == Rights::UserNamespace {
            command.args(["--user", "--map-root-user"]);
        }
        command.args([
            "--pid",
            "--fork",
            "--kill-child=SIGKILL",
            "--mount-proc",
            "--net",
            "--mount",
            "sh",
        ]);
        let mut child = command
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .map_err(Error::io("start unshare"))?;
        let stdin = child.stdin.take();
        let (Some(stdout), Some(mut stderr)) = (child.stdout.take(), child.stderr.take()) else {
            return Err(Error::step("start unshare", "its output is not a pipe"));
        };
        let lines = read_lines(stdout);
        let mut shell = Self {
            child,
            stdin,
            lines,
            init_pid: 0,
            rights,
            commands: 0,
        };
        // The shell's own errors join its output; after that the separate pipe belongs to unshare alone.
        if let Err(error) = shell.send("exec 2>&1\n").and_then(|()| shell.run("true")) {
            let mut said = String::new();
            shell.stop();
            let _ignored = stderr.read_to_string(&mut said);
            return Err(if said.trim().is_empty() {
                error
            } else {
                Error::step("unshare", said)
            });
        }
        // The shell has answered, so it is there.
        shell.init_pid = only_child_of(shell.child.id())?
            .ok_or_else(|| Error::step("find the lab's shell", "unshare has no child"))?;
        Ok(shell)
    }

    /// Returns the id of the lab's init process as this process sees it.
    pub(crate) fn init_pid(&self) -> u32 {
        self.init_pid
    }

    pub(crate) fn rights(&self) -> Rights {
        self.rights
    }

    /// Writes raw text to the shell and waits for nothing.
    pub(crate) fn send(&mut self, text: &str) -> Result<(), Error> {
        let Some(stdin) = self.stdin.as_mut() else {
            return Err(Error::step("write to the lab's shell", "the lab is gone"));
        };
        stdin
            .write_all(text.as_bytes())
            .map_err(Error::io("write to the lab's shell"))
    }

    /// Returns the next line that anything in the lab's shell wrote, or `None` at the deadline.
    pub(crate) fn next_line(&mut self, until: Instant) -> Result<Option<String>, Error> {
        match self
            .lines
            .recv_timeout(until.saturating_duration_since(Instant::now()))
        {
            Ok(line) => Ok(Some(line)),
            Err(RecvTimeoutError::Timeout) => Ok(None),
            Err(RecvTimeoutError::Disconnected) => {
                Err(Error::step("read from the lab's shell", "it has ended"))
            }
        }
    }

    /// Runs a script in the switch namespace, stopping at the first command that fails, and returns its output.
    ///
    /// Blocks for at most ten seconds.
    pub(crate) fn run(&mut self, script: &str) -> Result<String, Error> {
        self.commands += 1;
        let marker = format!("#lab {} ", self.commands);
        self.send(&format!(
            "( set -e\n{script}\n) </dev/null\necho \"{marker}$?\"\n"
        ))?;
        let until = Instant::now() + ANSWER_DEADLINE;
        let mut output = String::new();
        while let Some(line) = self.next_line(until)? {
            match line.strip_prefix(&marker) {
                Some("0") => return Ok(output),
                Some(status) => {
                    return Err(Error::step(script, format!("{output}exit status {status}")));
                }
                None => {
                    output.push_str(&line);
                    output.push('\n');
                }
            }
        }
        Err(Error::TimedOut {
            what: format!("the lab's shell to run `{script}`"),
            waited: ANSWER_DEADLINE,
            output,
        })
    }

    /// Ends the lab and waits until nothing of it is left.
    pub(crate) fn stop(&mut self) {
        self.stdin = None;
        let until = Instant::now() + STOP_DEADLINE;
        loop {
            match self.next_line(until) {
                Ok(Some(_)) => {}
                Ok(None) => {
                    // The shell hangs in a command: killing unshare takes it along by --kill-child.
                    let _already_gone = self.child.kill();
                    break;
                }
                Err(_) => break,
            }
        }
        let _status = self.child.wait();
    }
}

impl Drop for Shell {
    fn drop(&mut self) {
        self.stop();
    }
}

/// Reads a pipe line by line on a thread that ends with the pipe.
pub(crate) fn read_lines(pipe: impl Read + Send + 'static) -> Receiver<String> {
    let (sender, receiver) = mpsc::channel();
    thread::spawn(move || {
        let mut reader = BufReader::new(pipe);
        let mut line = Vec::new();
        while reader
            .read_until(b'\n', &mut line)
            .is_ok_and(|read| read > 0)
        {
            let text = String::from_utf8_lossy(&line)
                .trim_end_matches(['\n', '\r'])
                .to_owned();
            line.clear();
            if sender.send(text).is_err() {
                break;
            }
        }
    });
    receiver
}

/// Returns the only child of a process that forks once, as `unshare --fork` and `nsenter --pid` do; `None`
/// before that.
pub(crate) fn only_child_of(pid: u32) -> Result<Option<u32>, Error> {
    let path = format!("/proc/{pid}/task/{pid}/children");
    let children = fs::read_to_string(&path).map_err(Error::io(format!("read {path}")))?;
    Ok(children
        .split_whitespace()
        .next()
        .and_then(|word| word.parse().ok()))
}

/// Returns the search path with the system directories, which a plain user's often lacks.
pub(crate) fn search_path() -> String {
    let own = std::env::var("PATH").unwrap_or_default();
    format!("{own}:/usr/sbin:/sbin:/usr/bin:/bin")
}

fn find(tool: &str) -> Option<PathBuf> {
    search_path()
        .split(':')
        .map(|directory| Path::new(directory).join(tool))
        .find(|path| path.is_file())
}

fn user_namespace_hints() -> Vec<String> {
    let switches = [
        ("/proc/sys/user/max_user_namespaces", "0"),
        ("/proc/sys/kernel/unprivileged_userns_clone", "0"),
        (
            "/proc/sys/kernel/apparmor_restrict_unprivileged_userns",
            "1",
        ),
    ];
    switches
        .iter()
        .filter(|(path, forbids)| {
            fs::read_to_string(path).is_ok_and(|value| value.trim() == *forbids)
        })
        .map(|(path, forbids)| {
            format!("user namespaces are off for plain users: {path} is {forbids}")
        })
        .collect()
}

/// What a lab is made of, and the Debian package that has it.
const TOOLS: [(&str, &str); 5] = [
    ("hostname", "hostname"),
    ("ip", "iproute2"),
    ("nft", "nftables"),
    ("nsenter", "util-linux"),
    ("unshare", "util-linux"),
];

/// Far more than any command of the lab takes, so that only a hang reaches it.
const ANSWER_DEADLINE: Duration = Duration::from_secs(10);

/// The kernel tears a lab down in some tens of milliseconds.
const STOP_DEADLINE: Duration = Duration::from_secs(5);
