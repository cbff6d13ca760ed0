//! One host of a lab: where programs run, and its link to the switch.

use std::ffi::OsString;
use std::net::Ipv4Addr;
use std::path::Path;
use std::process::{Command, Stdio};

use super::error::Error;
use super::process::{Output, Process};
use super::shell::{Rights, search_path};
use super::switch::Loss;
use super::{Lab, address_of};
use crate::link::{Books, Profile};

/// A host of a [`Lab`].
#[derive(Clone, Copy, Debug)]
pub struct Host<'lab> {
    lab: &'lab Lab,
    index: usize,
}

impl<'lab> Host<'lab> {
    pub(crate) fn new(lab: &'lab Lab, index: usize) -> Self {
        Self { lab, index }
    }

    /// Returns the name, which is also the host name that its programs see.
    #[must_use]
    pub fn name(&self) -> &'lab str {
        &self.lab.hosts[self.index]
    }

    /// Returns the address on `eth0`.
    #[must_use]
    pub fn address(&self) -> Ipv4Addr {
        address_of(self.index)
    }

    /// Starts a program in this host with its input, output and errors piped.
    ///
    /// Taken from `command` are program, arguments and environment; the rest of the environment is the test's,
    /// without what names a place outside of the host (`XDG_RUNTIME_DIR`, `DDX_…`). The working directory is
    /// the root.
    ///
    /// # Errors
    /// [`Error::Io`] if `nsenter` cannot be started. A program that cannot be started ends at once with status
    /// 127, and says why in [`Process::errors`].
    pub fn spawn(&self, command: &Command) -> Result<Process, Error> {
        Process::start(
            &mut self.enter(command)?,
            format!("{} on {}", describe(command), self.name()),
        )
    }

    /// Runs a program in this host to its end and returns its output; blocks without a deadline.
    ///
    /// # Errors
    /// [`Error::Io`] if `nsenter` cannot be started; how the program ended is in the output.
    pub fn exec(&self, command: &Command) -> Result<Output, Error> {
        let output = self
            .enter(command)?
            .stdin(Stdio::null())
            .output()
            .map_err(Error::io(format!(
                "run {} on {}",
                describe(command),
                self.name()
            )))?;
        Ok(Output {
            status: output.status,
            stdout: String::from_utf8_lossy(&output.stdout).into_owned(),
            stderr: String::from_utf8_lossy(&output.stderr).into_owned(),
        })
    }

    /// Runs a shell script in this host and returns what it wrote to standard output.
    ///
    /// # Errors
    /// [`Error::Step`] with its errors unless it ends with status 0.
    pub fn shell(&self, script: &str) -> Result<String, Error> {
        let output = self.exec(Command::new("sh").args(["-ec", script]))?;
        if output.status.success() {
            Ok(output.stdout)
        } else {
            Err(Error::step(
                format!("`{script}` on {}", self.name()),
                output.stderr,
            ))
        }
    }

    /// Gives the host a further link, to another switch, which is made with the first of its links.
    ///
    /// The interface is down and has no address; the other end is `SWITCHpN` in the switch's namespace, N counting hosts
    /// from 1. The links of such a switch are neither counted nor cut by the methods here, and it floods multicast.
    ///
    /// # Errors
    /// [`Error::Step`] if the names do not suit the kernel or are in use.
    pub fn plug(&self, interface: &str, switch: &str) -> Result<(), Error> {
        let (port, holder) = (self.index + 1, self.lab.holders[self.index]);
        let script = format!(
            "ip link show {switch} >/dev/null 2>&1 || ip link add {switch} up type bridge mcast_snooping 0\n\
             ip link add {switch}p{port} type veth peer name {interface} netns {holder}\n\
             ip link set {switch}p{port} master {switch} up\n"
        );
        self.lab.switch(&script)?;
        Ok(())
    }

    /// Cuts the link: nothing passes either way, and the host is not told.
    ///
    /// # Errors
    /// [`Error::Step`] if the lab no longer answers, here and in the next two.
    pub fn cut(&self) -> Result<(), Error> {
        self.lab.set_fault(self.index, |fault| fault.is_cut = true)
    }

    /// Heals a cut link; a loss that was set stays.
    ///
    /// # Errors
    /// See [`Host::cut`].
    pub fn heal(&self) -> Result<(), Error> {
        self.lab.set_fault(self.index, |fault| fault.is_cut = false)
    }

    /// Sets the chance with which the link drops packets, each way on its own.
    ///
    /// # Errors
    /// See [`Host::cut`].
    pub fn set_loss(&self, loss: Loss) -> Result<(), Error> {
        self.lab.set_fault(self.index, |fault| fault.loss = loss)
    }

    /// Emulates the link by this profile from now on, also in the midst of traffic.
    ///
    /// The first call puts a wire into the link, which takes some tens of milliseconds and may lose a frame then;
    /// memberships of groups stay. Each call begins the profile's sequence of chances anew, so that the same
    /// frames after it are lost in each run. What is on its way keeps its time. Cuts and [`Host::set_loss`] work
    /// at the switch's end, on what the wire has let through and on what it is to carry.
    ///
    /// # Errors
    /// [`Error::Io`] and [`Error::Step`] if the machine or the lab refuses the wire.
    pub fn set_link(&self, profile: &Profile) -> Result<(), Error> {
        self.lab.set_link(self.index, Some(profile))
    }

    /// Lets the link pass all that comes, at once. A wire that is there stays.
    ///
    /// # Errors
    /// See [`Host::set_link`].
    pub fn clear_link(&self) -> Result<(), Error> {
        self.lab.set_link(self.index, None)
    }

    /// Returns what became of frames on an emulated link since it was first set.
    #[must_use]
    pub fn books(&self) -> Books {
        self.lab.books(self.index).0
    }

    /// Returns how many frames were lost because the wire did not keep up, which no profile asks for.
    #[must_use]
    pub fn overruns(&self) -> u64 {
        self.lab.books(self.index).1
    }

    /// Returns the command that runs `command` in this host's namespaces.
    fn enter(&self, command: &Command) -> Result<Command, Error> {
        let mut entered = Command::new("nsenter");
        entered
            .env("PATH", search_path())
            .env_remove("XDG_RUNTIME_DIR");
        for (name, _) in
            std::env::vars_os().filter(|(name, _)| name.as_encoded_bytes().starts_with(b"DDX_"))
        {
            entered.env_remove(name);
        }
        entered.arg("--target").arg(self.lab.init_pid.to_string());
        if self.lab.rights == Rights::UserNamespace {
            entered.args(["--user", "--preserve-credentials"]);
        }
        // Two steps: the holder's id means something only inside of the lab.
        entered.args(["--pid", "--mount", "nsenter", "--target"]);
        entered
            .arg(self.lab.holders[self.index].to_string())
            .args(["--net", "--mount", "--uts", "--"]);
        entered.arg(absolute(command)?).args(command.get_args());
        for (name, value) in command.get_envs() {
            match value {
                Some(value) => entered.env(name, value),
                None => entered.env_remove(name),
            };
        }
        Ok(entered)
    }
}

/// Makes a program's path independent of the working directory, which a host does not share.
fn absolute(command: &Command) -> Result<OsString, Error> {
    let program = command.get_program();
    if Path::new(program).components().count() < 2 {
        return Ok(program.to_owned());
    }
    let path =
        std::path::absolute(program).map_err(Error::io(format!("find {}", describe(command))))?;
    for hidden in ["/run", "/tmp", "/dev/shm", "/var/lib"] {
        if path.starts_with(hidden) {
            return Err(Error::Invalid(format!(
                "{} lies below {hidden}, which a host does not see",
                path.display()
            )));
        }
    }
    Ok(path.into_os_string())
}

fn describe(command: &Command) -> String {
    let program = Path::new(command.get_program());
    let mut text = format!(
        "`{}",
        program
            .file_name()
            .unwrap_or(command.get_program())
            .to_string_lossy()
    );
    for argument in command.get_args() {
        text.push(' ');
        text.push_str(&argument.to_string_lossy());
    }
    text.push('`');
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_program_that_the_host_cannot_see_is_refused_by_name() {
        let error = absolute(&Command::new("/tmp/x/ddx"))
            .unwrap_err()
            .to_string();

        assert_eq!(
            error,
            "/tmp/x/ddx lies below /tmp, which a host does not see"
        );
        assert_eq!(absolute(&Command::new("ip")).unwrap(), "ip");
    }

    #[test]
    fn a_command_is_described_without_its_directory() {
        assert_eq!(
            describe(Command::new("/usr/bin/ddx").args(["up", "--host", "a"])),
            "`ddx up --host a`"
        );
    }
}
