//! Everything that the doctor looks at, gathered in one place. What cannot be found out is `None`.

use std::collections::BTreeMap;
use std::fs;
use std::io;
use std::net::{IpAddr, Ipv4Addr, SocketAddr, UdpSocket};
use std::path::{Path, PathBuf};
use std::thread;
use std::time::Duration;

use ddx_store::Store;
use ddx_store::server::run_dir;
use if_addrs::{IfAddr, get_if_addrs};
use rustix::fs::{Access, MemfdFlags, SealFlags, access, fcntl_add_seals, ftruncate, memfd_create};
use rustix::net::{AddressFamily, SocketAddrUnix, SocketFlags, SocketType};
use rustix::process::{Resource, getrlimit};
use serde::Deserialize;
use serde::de::DeserializeOwned;

use crate::cli::state;
use crate::error::Failure;
use crate::net::Channel;

/// What all judgements rest on.
#[derive(Clone, Debug)]
pub(super) struct Facts {
    pub(super) daemon: Result<Daemon, Silence>,
    /// Where sockets lie unless one is named.
    pub(super) directory: PathBuf,
    /// Whether a daemon of this user could make its socket there.
    pub(super) directory_writable: bool,
    /// Sockets there at which a daemon answers.
    pub(super) sockets: Vec<PathBuf>,
    pub(super) system: System,
    /// IPv4 addresses of this host.
    pub(super) interfaces: Vec<Interface>,
    /// Datagrams that the kernel dropped because the buffer of a socket was full, by UDP port.
    pub(super) drops: BTreeMap<u16, u64>,
}

/// Why no daemon answers.
#[derive(Clone, Debug)]
pub(super) struct Silence {
    pub(super) reason: String,
    pub(super) hint: Option<String>,
}

/// What the daemon says.
#[derive(Clone, Debug)]
pub(super) struct Daemon {
    pub(super) host: String,
    pub(super) domain: u16,
    pub(super) socket: PathBuf,
    pub(super) own: Own,
    pub(super) hosts: Vec<Host>,
    /// By the name of the host, as `hosts` has it.
    pub(super) clocks: BTreeMap<String, Clock>,
    pub(super) counters: BTreeMap<String, u64>,
    /// When all this was read: nanoseconds on this host's clock.
    pub(super) now_ns: u64,
}

/// `@/self`.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(default)]
pub(super) struct Own {
    pub(super) key: bool,
    pub(super) control: Vec<SocketAddr>,
    pub(super) data_port: Option<u16>,
    /// Whether it looks for others by multicast.
    pub(super) beacon: bool,
    pub(super) receive_buffer_bytes: Option<u64>,
    /// Files that it may have open; `None` is no limit.
    pub(super) files_max: Option<u64>,
    pub(super) pid: Option<u32>,
    pub(super) version: String,
}

/// One entry of `@/hosts`. Instants are nanoseconds on this host's clock.
#[derive(Clone, Debug, Deserialize)]
pub(super) struct Host {
    pub(super) host: String,
    pub(super) state: String,
    #[serde(default)]
    pub(super) addr: Option<SocketAddr>,
    #[serde(default)]
    pub(super) rtt_us: Option<u64>,
    #[serde(default)]
    pub(super) since: u64,
    /// When its beacon last came here by multicast.
    #[serde(default)]
    pub(super) multicast_in: Option<u64>,
    /// When this host's beacon was last said to have come there.
    #[serde(default)]
    pub(super) multicast_out: Option<u64>,
}

/// One entry of `@/clock`.
#[derive(Clone, Debug, Deserialize)]
pub(super) struct Clock {
    pub(super) host: String,
    pub(super) offset_ns: i64,
    pub(super) bound_ns: u64,
}

/// What the kernel grants.
#[derive(Clone, Debug)]
pub(super) struct System {
    pub(super) release: String,
    pub(super) cores: usize,
    /// Whether memory can be shared and sealed.
    pub(super) memory: Result<(), String>,
    pub(super) offload: Result<Offload, String>,
    pub(super) rmem_max: Option<u64>,
    pub(super) wmem_max: Option<u64>,
    pub(super) memberships_max: Option<u64>,
    /// Files that this process may have open, and may raise that to; `None` is no limit.
    pub(super) files: (Option<u64>, Option<u64>),
}

/// Most datagrams in one system call.
#[derive(Clone, Copy, Debug)]
pub(super) struct Offload {
    pub(super) sent: usize,
    pub(super) received: usize,
}

/// One IPv4 address of this host.
#[derive(Clone, Debug)]
pub(super) struct Interface {
    pub(super) name: String,
    pub(super) address: Ipv4Addr,
    pub(super) loopback: bool,
    pub(super) up: bool,
    pub(super) multicast: Option<bool>,
    pub(super) mtu: Option<u64>,
}

impl Facts {
    /// Looks at everything. Waits a second at most for a daemon.
    pub(super) fn gather(socket: Option<&Path>) -> Self {
        let directory = run_dir();
        let nearest = directory.ancestors().find(|dir| dir.is_dir());
        Self {
            daemon: open(socket)
                .and_then(|store| Ok(Daemon::ask(&store)?))
                .map_err(|failure| Silence::from(&failure)),
            directory_writable: nearest.is_some_and(|dir| access(dir, Access::WRITE_OK).is_ok()),
            sockets: sockets(&directory),
            directory,
            system: System::look(),
            interfaces: interfaces().unwrap_or_default(),
            drops: read("/proc/net/udp")
                .map(|text| drops(&text))
                .unwrap_or_default(),
        }
    }

    /// The interfaces that the daemon uses; without one, those that it would. None without a key.
    pub(super) fn used(&self) -> Vec<&Interface> {
        let is_used = |interface: &&Interface| match &self.daemon {
            Ok(daemon) => daemon.own.uses(interface.address),
            Err(_) => !interface.loopback,
        };
        self.interfaces.iter().filter(is_used).collect()
    }

    /// Whether what concerns the network matters: not where a daemon has no key.
    pub(super) fn is_networked(&self) -> bool {
        self.daemon.as_ref().map_or(true, |daemon| daemon.own.key)
    }
}

/// Connects to the daemon of this host, which has a second to answer.
pub(super) fn open(socket: Option<&Path>) -> Result<Store, Failure> {
    let options = Store::options().program("ddx doctor").timeout(PATIENCE);
    let options = match socket {
        Some(path) => options.socket(path),
        None => options,
    };
    Ok(options.open()?)
}

impl Daemon {
    /// Reads what the daemon says of itself and of the others.
    pub(super) fn ask(store: &Store) -> anyhow::Result<Self> {
        let clocks: Vec<Clock> = item(store, "@/clock")?;
        Ok(Self {
            host: store.host().to_string(),
            domain: store.domain(),
            socket: store.socket().map(Path::to_owned).unwrap_or_default(),
            own: item(store, "@/self")?,
            hosts: item(store, "@/hosts")?,
            clocks: clocks
                .into_iter()
                .map(|clock| (clock.host.clone(), clock))
                .collect(),
            counters: item(store, "@/counters")?,
            now_ns: ddx_store::now().0,
        })
    }
}

impl Own {
    fn uses(&self, address: Ipv4Addr) -> bool {
        self.control.iter().any(|at| at.ip() == IpAddr::V4(address))
    }
}

fn item<T: DeserializeOwned + Default>(store: &Store, name: &str) -> anyhow::Result<T> {
    let value = state::read(store, name)?.unwrap_or_default();
    Ok(serde_json::from_value(value).unwrap_or_default())
}

impl From<&Failure> for Silence {
    fn from(failure: &Failure) -> Self {
        let text = failure.to_string();
        let text = text.strip_prefix("error: ").unwrap_or(&text);
        let (reason, hint) = match text.split_once("\nhint: ") {
            Some((reason, hint)) => (reason, Some(hint.to_owned())),
            None => (text, None),
        };
        Self {
            reason: reason.to_owned(),
            hint,
        }
    }
}

impl System {
    fn look() -> Self {
        let files = getrlimit(Resource::Nofile);
        Self {
            release: read("/proc/sys/kernel/osrelease").unwrap_or_else(|| "?".to_owned()),
            cores: thread::available_parallelism().map_or(1, usize::from),
            memory: memory().map_err(|error| error.to_string()),
            offload: offload().map_err(|error| error.to_string()),
            rmem_max: number("/proc/sys/net/core/rmem_max"),
            wmem_max: number("/proc/sys/net/core/wmem_max"),
            memberships_max: number("/proc/sys/net/ipv4/igmp_max_memberships"),
            files: (files.current, files.maximum),
        }
    }
}

/// Makes and seals a file in memory as the store does.
fn memory() -> io::Result<()> {
    let file = memfd_create(
        "ddx-doctor",
        MemfdFlags::CLOEXEC | MemfdFlags::ALLOW_SEALING,
    )?;
    ftruncate(&file, 4096)?;
    fcntl_add_seals(
        &file,
        SealFlags::SHRINK | SealFlags::GROW | SealFlags::FUTURE_WRITE | SealFlags::SEAL,
    )?;
    Ok(())
}

fn offload() -> io::Result<Offload> {
    let channel = Channel::new(UdpSocket::bind((Ipv4Addr::LOCALHOST, 0))?)?;
    Ok(Offload {
        sent: channel.max_segments(),
        received: channel.max_received_segments(),
    })
}

fn interfaces() -> io::Result<Vec<Interface>> {
    let all = get_if_addrs()?.into_iter().filter_map(|entry| {
        let (loopback, up) = (entry.is_loopback(), entry.is_oper_up());
        let IfAddr::V4(address) = entry.addr else {
            return None;
        };
        // In a network namespace that has no /sys of its own, the names there are those of other interfaces.
        let dir = Path::new("/sys/class/net").join(&entry.name);
        let is_it = number(dir.join("ifindex")) == entry.index.map(u64::from);
        let flags = read(dir.join("flags")).filter(|_| is_it);
        let flags = flags.and_then(|text| u32::from_str_radix(text.strip_prefix("0x")?, 16).ok());
        Some(Interface {
            name: entry.name,
            address: address.ip,
            loopback,
            up,
            multicast: flags.map(|flags| flags & IFF_MULTICAST != 0),
            mtu: number(dir.join("mtu")).filter(|_| is_it),
        })
    });
    Ok(all.collect())
}

/// Sockets below `directory`, in the directory of their domain each, at which somebody answers.
fn sockets(directory: &Path) -> Vec<PathBuf> {
    let list = |dir: &Path| fs::read_dir(dir).into_iter().flatten().flatten();
    let mut found: Vec<PathBuf> = list(directory)
        .flat_map(|domain| list(&domain.path()))
        .map(|file| file.path())
        .filter(|path| path.extension().is_some_and(|end| end == "sock"))
        .filter(|path| answers(path).is_ok())
        .collect();
    found.sort();
    found
}

fn answers(path: &Path) -> io::Result<()> {
    let flags = SocketFlags::CLOEXEC | SocketFlags::NONBLOCK;
    let socket = rustix::net::socket_with(AddressFamily::UNIX, SocketType::SEQPACKET, flags, None)?;
    rustix::net::connect(&socket, &SocketAddrUnix::new(path)?)?;
    Ok(())
}

/// The last column of each line of `/proc/net/udp` is what its socket dropped, the second its address and port.
fn drops(text: &str) -> BTreeMap<u16, u64> {
    let mut drops = BTreeMap::new();
    for line in text.lines().skip(1) {
        let words: Vec<&str> = line.split_whitespace().collect();
        let port = words
            .get(1)
            .and_then(|at| at.split_once(':'))
            .and_then(|(_, port)| u16::from_str_radix(port, 16).ok());
        if let (Some(port), Some(Ok(count))) = (port, words.last().map(|word| word.parse::<u64>()))
        {
            *drops.entry(port).or_default() += count;
        }
    }
    drops
}

fn read(path: impl AsRef<Path>) -> Option<String> {
    Some(fs::read_to_string(path).ok()?.trim_end().to_owned())
}

fn number(path: impl AsRef<Path>) -> Option<u64> {
    read(path)?.parse().ok()
}

const IFF_MULTICAST: u32 = 0x1000;
/// How long a daemon that starts just now may take.
const PATIENCE: Duration = Duration::from_secs(1);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn drops_are_summed_by_port() {
        let text = "\
   sl  local_address rem_address   st tx_queue rx_queue tr tm->when retrnsmt   uid  timeout inode ref pointer drops
  512: 00000000:1CE8 00000000:0000 07 00000000:00000000 00:00000000 00000000     0        0 4242 2 0000000000000000 7
  512: 00000000:1CE8 00000000:0000 07 00000000:00000000 00:00000000 00000000     0        0 4243 2 0000000000000000 5
  900: 0100007F:0035 00000000:0000 07 00000000:00000000 00:00000000 00000000     0        0 4244 2 0000000000000000 0
";
        assert_eq!(drops(text), BTreeMap::from([(7400, 12), (53, 0)]));
        assert_eq!(drops("nonsense\nmore\n"), BTreeMap::new());
    }

    #[test]
    fn this_machine_can_be_looked_at() {
        let facts = Facts::gather(Some(Path::new("/nonexistent/ddx.sock")));

        assert_eq!(facts.system.memory, Ok(()));
        assert!(facts.system.offload.is_ok());
        assert!(facts.interfaces.iter().any(|i| i.loopback));
        let silence = facts.daemon.unwrap_err();
        assert!(
            silence.reason.contains("/nonexistent/ddx.sock"),
            "{silence:?}"
        );
        assert_eq!(silence.hint.as_deref(), Some("start one with `ddx up`"));
    }
}
