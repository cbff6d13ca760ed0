//! The laboratory: hosts as namespaces of the real kernel on one switch, with real programs in them.
//!
//! A [`Lab`] is a network namespace with a bridge that snoops IGMP and is the querier, and for each host a
//! network, mount and host-name namespace of its own: own `/run`, `/tmp`, `/dev/shm` and `/var/lib/ddx`,
//! address 10.77.0.1 and up on `eth0`. Programs are started in a host, their links are cut, healed and made
//! lossy, and the switch counts each packet.
//!
//! ```no_run
//! use std::process::Command;
//! use std::time::Duration;
//! use ddx_rig::lab::{Lab, Loss};
//!
//! let lab = Lab::new(&["robot1", "base"])?;
//! let daemon = lab.host("robot1").spawn(Command::new("ddx").arg("up"))?;
//! daemon.wait_line(|line| line.contains("ready"), Duration::from_secs(5))?;
//! lab.watch_udp("samples", &[7450])?;
//! let before = lab.counters()?;
//! lab.host("base").set_loss(Loss { from_percent: 0, to_percent: 33 })?;
//! assert_eq!(lab.counters()?.since(&before).udp_total("samples").from.packets, 0);
//! # Ok::<(), ddx_rig::lab::Error>(())
//! ```
//!
//! **Nothing is left behind**, not even by `kill -9` of the test: all of a lab lives in one PID namespace whose
//! first process ends with the test, and its namespaces have no name.
//!
//! **Links**: at first each host's link does nothing but pass frames. [`Host::set_link`] gives it a
//! [`Profile`] (rate, delay, loss with a seed and so on, see [`crate::link`]), and another later. That puts a wire
//! between the host and the switch: a thread of the test process that takes each frame from one device and
//! hands it to another (AF_PACKET, for a plain user as for root). From then on checksum and segmentation offload
//! are off on that host's devices (GSO, TSO, GRO too), so that frames are real ones and complete. By itself the wire
//! takes less than 0.1 ms each way, and on two cores it carries some 30,000 to 70,000 packets a second, 350 to 850
//! Mbit/s of full frames: the `lan` profile's 1 Gbit/s is what it asks, not what it gets. What the wire is too slow
//! for is counted, see [`Host::overruns`]. A kernel with netem is told of and not used: one emulator, whose drops
//! are those of the simulation.
//!
//! **What it does not model**: [`Host::set_loss`] has no seed (it is the kernel's chance) and no bursts; all
//! hosts share one kernel, one clock and one set of CPUs. For those there is the simulation. A host sees the files of this machine except below `/run`, `/tmp`, `/dev/shm` and `/var/lib`, so
//! a program must not live there.

mod error;
mod frame;
mod host;
#[expect(
    unsafe_code,
    reason = "a socket in another namespace, its address and its device's offload have no safe call"
)]
mod packet;
mod process;
mod shell;
mod splice;
mod switch;
mod wire;

use std::collections::BTreeMap;
use std::net::Ipv4Addr;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use shell::Shell;
use switch::Fault;
use wire::Wire;

use crate::link::{Books, Profile};

pub use error::Error;
pub use host::Host;
pub use process::{Output, Process};
pub use shell::Rights;
pub use switch::{Count, Counters, Loss, Traffic};

/// A switch and its hosts; dropped, it takes every process and namespace of its own along.
#[derive(Debug)]
pub struct Lab {
    hosts: Vec<String>,
    /// The process, by its id inside the lab, that holds each host's namespaces.
    holders: Vec<u32>,
    init_pid: u32,
    rights: Rights,
    state: Mutex<State>,
}

/// What changes in a lab's life, behind one lock so that hosts may be driven from several threads.
#[derive(Debug)]
struct State {
    /// Once a host's link is emulated. Dropped before the devices go.
    wire: Option<Wire>,
    shell: Shell,
    faults: Vec<Fault>,
    labels: Vec<(String, Vec<u16>)>,
}

impl Lab {
    /// Builds a lab with these hosts, as root or else in a user namespace.
    ///
    /// Takes a tenth of a second for three hosts. The switch prunes multicast from the start.
    ///
    /// # Errors
    /// [`Error::Missing`] says exactly what this machine lacks; [`Error::Invalid`] what is wrong with the names.
    pub fn new(hosts: &[&str]) -> Result<Self, Error> {
        check_names(hosts)?;
        let mut shell = Shell::start()?;
        let holders = hold_namespaces(&mut shell, hosts)?;
        shell.run(&cables_script(hosts.len()))?;
        cut_up_runs(&shell, hosts.len())?;
        shell.run(&wiring_script(&holders))?;
        shell.run(&nft(&switch::base_rules(hosts.len())))?;
        Ok(Self {
            hosts: hosts.iter().map(|&host| host.to_owned()).collect(),
            holders,
            init_pid: shell.init_pid(),
            rights: shell.rights(),
            state: Mutex::new(State {
                wire: None,
                shell,
                faults: vec![Fault::default(); hosts.len()],
                labels: Vec::new(),
            }),
        })
    }

    /// Returns one host.
    ///
    /// # Panics
    /// If the lab has no host of this name, which is a mistake in the test.
    #[must_use]
    #[track_caller]
    pub fn host(&self, name: &str) -> Host<'_> {
        let Some(index) = self.hosts.iter().position(|host| host == name) else {
            panic!(
                "no host `{name}` in this lab; it has {}",
                self.hosts.join(", ")
            );
        };
        Host::new(self, index)
    }

    /// Returns the hosts in the order in which they were given, which is that of their addresses.
    pub fn hosts(&self) -> impl Iterator<Item = Host<'_>> {
        (0..self.hosts.len()).map(|index| Host::new(self, index))
    }

    /// Counts, from now on and under this label, datagrams whose source or destination port is one of these.
    ///
    /// A label is letters and digits; further calls with it add ports.
    ///
    /// # Errors
    /// [`Error::Invalid`] for another label, [`Error::Step`] if the switch refuses.
    pub fn watch_udp(&self, label: &str, ports: &[u16]) -> Result<(), Error> {
        if label.is_empty() || !label.bytes().all(|byte| byte.is_ascii_alphanumeric()) {
            return Err(Error::Invalid(format!(
                "`{label}` is no label (hint: letters and digits)"
            )));
        }
        let mut state = self.state();
        let mut rules = String::new();
        let known = state.labels.iter().position(|(known, _)| known == label);
        if known.is_none() {
            rules.push_str(&switch::watch_rules(label, self.hosts.len()));
        }
        rules.push_str(&switch::port_rules(label, ports));
        state.shell.run(&nft(&rules))?;
        let index = known.unwrap_or(state.labels.len());
        if known.is_none() {
            state.labels.push((label.to_owned(), Vec::new()));
        }
        state.labels[index].1.extend(ports);
        if let Some(wire) = &state.wire {
            wire.watch(index, ports);
        }
        Ok(())
    }

    /// Reads all counters of the switch, in a few milliseconds.
    ///
    /// # Errors
    /// [`Error::Step`] if the lab no longer answers.
    pub fn counters(&self) -> Result<Counters, Error> {
        let mut state = self.state();
        let listing = state
            .shell
            .run(&format!("nft list counters table {}", switch::TABLE))?;
        let mut counters = Counters::parse(&listing, &self.hosts);
        // A host with a wire is no longer counted by the switch, but at its own end of the wire.
        for (host, traffic) in state.wire.iter().flat_map(Wire::traffic) {
            let labels = state.labels.iter().map(|(label, _)| label.as_str());
            for (label, traffic) in std::iter::once("").chain(labels).zip(traffic) {
                counters.add(&self.hosts[host], label, traffic);
            }
        }
        Ok(counters)
    }

    /// Polls the counters until `until` holds for what was counted since `before`, and returns that.
    ///
    /// # Errors
    /// [`Error::TimedOut`] with `what` and the last counters at the deadline.
    pub fn wait_counters(
        &self,
        what: &str,
        before: &Counters,
        deadline: Duration,
        until: impl Fn(&Counters) -> bool,
    ) -> Result<Counters, Error> {
        let end = Instant::now() + deadline;
        loop {
            let counted = self.counters()?.since(before);
            if until(&counted) {
                return Ok(counted);
            }
            if Instant::now() >= end {
                let output = format!("{counted:#?}");
                return Err(Error::TimedOut {
                    what: what.to_owned(),
                    waited: deadline,
                    output,
                });
            }
        }
    }

    /// Runs a shell script in the switch's namespace (its ports are `p1` and up) and returns its output.
    ///
    /// # Errors
    /// [`Error::Step`] with the output and status of the first command that fails.
    pub fn switch(&self, script: &str) -> Result<String, Error> {
        self.state().shell.run(script)
    }

    /// Returns the id, on this machine, of the lab's first process; with it the whole lab ends.
    #[must_use]
    pub fn init_pid(&self) -> u32 {
        self.init_pid
    }

    /// Returns whose rights the lab was built with.
    #[must_use]
    pub fn rights(&self) -> Rights {
        self.rights
    }

    fn set_fault(&self, index: usize, change: impl FnOnce(&mut Fault)) -> Result<(), Error> {
        let mut state = self.state();
        let mut fault = state.faults[index];
        change(&mut fault);
        state
            .shell
            .run(&nft(&switch::fault_rules(index + 1, fault)))?;
        state.faults[index] = fault;
        Ok(())
    }

    /// Emulates a host's link by this profile, or by none, from now on.
    fn set_link(&self, index: usize, profile: Option<&Profile>) -> Result<(), Error> {
        let mut state = self.state();
        let State {
            wire,
            shell,
            labels,
            ..
        } = &mut *state;
        if wire.is_none() {
            let started = Wire::start()?;
            for (index, (_, ports)) in labels.iter().enumerate() {
                started.watch(index, ports);
            }
            say_which(shell);
            *wire = Some(started);
        }
        if let Some(wire) = wire {
            if !wire.has(index) {
                splice::splice(shell, wire, index, self.holders[index])?;
            }
            wire.set(index, profile);
        }
        Ok(())
    }

    fn books(&self, index: usize) -> (Books, u64) {
        let state = self.state();
        let books = state.wire.as_ref().and_then(|wire| wire.books(index));
        books.unwrap_or_default()
    }

    fn state(&self) -> MutexGuard<'_, State> {
        // A test that panicked in between left at most one unread answer, which the next marker skips.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Builds a lab, or says loudly that this test proves nothing here.
///
/// # Panics
/// If no lab can be built and the environment has `CI`: there a missing lab is a failure.
#[must_use]
#[expect(
    clippy::print_stderr,
    reason = "a test that proves nothing must say so where people look"
)]
pub fn require(hosts: &[&str]) -> Option<Lab> {
    match Lab::new(hosts) {
        Ok(lab) => Some(lab),
        Err(error @ Error::Missing(_)) => {
            assert!(std::env::var_os("CI").is_none(), "{error}");
            eprintln!("!!!! SKIPPED, NOTHING PROVEN: {error}");
            None
        }
        Err(error) => panic!("{error}"),
    }
}

/// Says once for each lab what emulates its links.
#[expect(
    clippy::print_stderr,
    reason = "figures that were measured over an emulated link mean little without its kind"
)]
fn say_which(shell: &mut Shell) {
    let netem = if splice::has_netem(shell) {
        "this kernel has netem, which is not used"
    } else {
        "this kernel has no netem"
    };
    eprintln!("lab: links are emulated by a user-space wire over AF_PACKET; {netem}");
}

fn check_names(hosts: &[&str]) -> Result<(), Error> {
    if hosts.is_empty() || hosts.len() > MAX_HOSTS {
        return Err(Error::Invalid(format!(
            "a lab has 1 to {MAX_HOSTS} hosts, not {}",
            hosts.len()
        )));
    }
    let mut seen = BTreeMap::new();
    for host in hosts {
        let is_plain = host
            .bytes()
            .all(|byte| byte.is_ascii_alphanumeric() || byte == b'-');
        if host.is_empty() || host.len() > 60 || !is_plain || host.starts_with('-') {
            return Err(Error::Invalid(format!(
                "`{host}` is no host name (hint: letters, digits, hyphens)"
            )));
        }
        if seen.insert(host, ()).is_some() {
            return Err(Error::Invalid(format!("host `{host}` is there twice")));
        }
    }
    Ok(())
}

/// Starts one process per host that makes the host's namespaces and sleeps in them; returns their ids inside
/// the lab.
fn hold_namespaces(shell: &mut Shell, hosts: &[&str]) -> Result<Vec<u32>, Error> {
    for host in hosts {
        shell.send(&format!(
            "( unshare --net --mount --uts sh -ec '{HOLDER}' {host} </dev/null || echo 'lost {host}' ) &\n"
        ))?;
    }
    let mut holders = BTreeMap::new();
    let mut said = String::new();
    let until = Instant::now() + HOLD_DEADLINE;
    while holders.len() < hosts.len() {
        let Some(line) = shell.next_line(until)? else {
            return Err(Error::TimedOut {
                what: "the hosts' namespaces".to_owned(),
                waited: HOLD_DEADLINE,
                output: said,
            });
        };
        match line.split_whitespace().collect::<Vec<_>>().as_slice() {
            ["held", host, pid] => {
                let pid = pid
                    .parse()
                    .map_err(|_| Error::step("make a host", line.as_str()))?;
                holders.insert((*host).to_owned(), pid);
            }
            ["lost", host] => return Err(Error::step(format!("make host `{host}`"), said)),
            _ => {
                said.push_str(&line);
                said.push('\n');
            }
        }
    }
    Ok(hosts
        .iter()
        .filter_map(|&host| holders.get(host).copied())
        .collect())
}

/// Returns the script that makes the bridge and each host's cable, of which the host's end is still here, as `e1` and up.
fn cables_script(hosts: usize) -> String {
    // Bridged packets would otherwise pass the machine's IP firewall hooks as well.
    let mut script = "for knob in /proc/sys/net/bridge/bridge-nf-call-*; do\n\
                      [ ! -e \"$knob\" ] || echo 0 >\"$knob\"\n\
                      done\n"
        .to_owned();
    let mut batch = switch::bridge_batch();
    for port in 1..=hosts {
        batch.push_str(&format!(
            "link add p{port} type veth peer name e{port}\nlink set p{port} master br0 up\n"
        ));
    }
    script.push_str(NO_IPV6);
    script.push_str(&format!("ip -batch - <<'END'\n{batch}END\n"));
    script
}

/// A batch of datagrams, or a run of TCP segments, reaches the switch as packets, so that each is counted and lost on its own.
fn cut_up_runs(shell: &Shell, hosts: usize) -> Result<(), Error> {
    let switch = splice::open(shell, &format!("/proc/{}/ns/net", shell.init_pid()))?;
    for port in 1..=hosts {
        let device = format!("e{port}");
        let refused = Error::io(format!("turn segmentation of {device} off"));
        switch.turn_segmentation_off(&device).map_err(refused)?;
    }
    Ok(())
}

/// Returns the script that gives each host its end of the cable and its address.
fn wiring_script(holders: &[u32]) -> String {
    let mut script = String::new();
    for (index, holder) in holders.iter().enumerate() {
        let (port, address) = (index + 1, address_of(index));
        script.push_str(&format!(
            "ip link set e{port} netns {holder} name eth0\n\
             nsenter --target {holder} --net ip -batch - <<'END'\n\
             link set lo up\n\
             address add {address}/24 dev eth0\n\
             link set eth0 up\n\
             route add 224.0.0.0/4 dev eth0\n\
             END\n"
        ));
    }
    script
}

fn nft(rules: &str) -> String {
    format!("nft -f - <<'END'\n{rules}END")
}

fn address_of(index: usize) -> Ipv4Addr {
    let last = u8::try_from(index + 1).unwrap_or(u8::MAX);
    Ipv4Addr::new(10, 77, 0, last)
}

/// What makes a host: its directories, its name, no IPv6 (whose own traffic would blur the counters); then it
/// sleeps as their holder.
const HOLDER: &str = "for d in /run /tmp /dev/shm /var/lib; do mount -t tmpfs -o mode=1777 tmpfs $d; done; \
                      mkdir /var/lib/ddx; hostname $0; \
                      for d in all default; do knob=/proc/sys/net/ipv6/conf/$d/disable_ipv6; \
                      [ ! -e $knob ] || echo 1 >$knob; done; \
                      echo held $0 $$; exec sleep infinity >/dev/null 2>&1";

const NO_IPV6: &str = "for d in all default; do\nknob=/proc/sys/net/ipv6/conf/$d/disable_ipv6\n\
                       [ ! -e $knob ] || echo 1 >$knob\ndone\n";

/// A bridge serves far more; the addresses of one /24 do not.
const MAX_HOSTS: usize = 200;

/// The namespaces of a host take some ten milliseconds; a loaded machine may need much longer.
const HOLD_DEADLINE: Duration = Duration::from_secs(20);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_that_would_break_a_script_are_refused() {
        for hosts in [&["a;b"][..], &["-a"], &[""], &["a b"], &["a", "a"], &[]] {
            assert!(
                matches!(check_names(hosts), Err(Error::Invalid(_))),
                "{hosts:?}"
            );
        }
        assert!(check_names(&["robot1", "base-2"]).is_ok());
    }

    #[test]
    fn addresses_follow_the_order_of_the_hosts() {
        assert_eq!(address_of(0), Ipv4Addr::new(10, 77, 0, 1));
        assert_eq!(address_of(MAX_HOSTS - 1), Ipv4Addr::new(10, 77, 0, 200));
    }
}
