//! One host's daemon: the store's server, the control plane, the two data threads, and the loop that joins them.
//!
//! The loop is the one place that owns the [`Catalog`](ddx_catalog::Catalog). It makes one mutation, drains all effects, then makes the next.
//! Without a key there is no catalog, no data thread and no socket on any network: the host serves itself.

mod books;
mod keeper;
mod network;
mod state;

use std::net::SocketAddr;
use std::path::PathBuf;
use std::pin::Pin;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, mpsc};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use anyhow::Context;
use ddx_store::Quotas;
use ddx_store::server::{self, Event as StoreEvent, Orphan, Server, socket_path};
use ddx_wire::seal::DomainKey;
use ddx_wire::{DomainId, HostName};
use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
use tokio::time::{MissedTickBehavior, interval};

use self::keeper::Keeper;
use self::network::Network;
use self::state::Publisher;
use crate::identity::Identity;
use crate::manager::Manager;

/// How often the daemon's own state is looked at, and written when it changed.
const STATE_PERIOD: Duration = Duration::from_secs(1);
/// News of the store that wait for the control loop, beside as many in the store's own channel: 65 MiB at worst, each with
/// the text of a schema.
const NEWS_MAX: usize = 1_024;

/// What a daemon is started with.
#[derive(Clone)]
pub struct Config {
    /// Name of this host and prefix of its items.
    pub host: HostName,
    /// Number of the domain.
    pub domain: DomainId,
    /// Key of the domain; `None` keeps the host to itself.
    pub key: Option<DomainKey>,
    /// Path of the socket that programs open; `None` takes `<run>/ddx/<domain>/<host>.sock`.
    pub socket: Option<PathBuf>,
    /// Interfaces to use, by name or address; empty takes all that are up.
    pub interfaces: Vec<String>,
    /// Control endpoints of other hosts (`udp/host:port`) to greet.
    pub join: Vec<String>,
    /// UDP port of the control socket, 0 for an ephemeral one. A seed that others name in `join` wants a fixed one.
    pub control_port: u16,
    /// UDP port of unicast samples, 0 for an ephemeral one.
    pub data_port: u16,
    /// Whether to find others by multicast beacons.
    pub beacon: bool,
    /// Whether samples may travel by multicast.
    pub multicast: bool,
    /// Whether the data threads poll instead of sleeping: lower latency for two cores.
    pub spin: bool,
    /// What each program may take.
    pub quotas: Quotas,
}

/// What a daemon says once it serves.
#[derive(Clone, Debug)]
pub struct Ready {
    /// Name of this host.
    pub host: HostName,
    /// Number of the domain.
    pub domain: DomainId,
    /// Path of the socket that programs open.
    pub socket: PathBuf,
    /// Addresses of the control socket; empty without a key.
    pub control: Vec<SocketAddr>,
    /// Port on which samples arrive, with a key.
    pub data_port: Option<u16>,
}

/// Serves one host until `shutdown` completes.
///
/// Calls `ready` once programs can open the store. Starts a thread for the store's server and, with a key, the two data
/// threads; all have ended when this returns.
///
/// # Errors
/// Fails when the socket, the key's network or a thread cannot be had; the message names it.
pub async fn run(
    config: Config,
    ready: impl FnOnce(&Ready),
    shutdown: impl Future<Output = ()>,
) -> anyhow::Result<()> {
    raise_descriptor_limit();
    let mut shutdown = std::pin::pin!(shutdown);
    let mut ready = Some(ready);
    let mut ordinal_min = 0;
    let mut left = Left::by_the_former_process()?;
    loop {
        let identity = Identity::take(&config.host, config.domain.0, ordinal_min)?;
        let mut daemon = Daemon::start(&config, identity, left)?;
        if let Some(ready) = ready.take() {
            ready(&daemon.ready);
        }
        let ended = daemon.serve(shutdown.as_mut()).await;
        left = daemon.stop();
        match ended? {
            Ended::Shutdown => return Ok(()),
            // Programs notice a restarted daemon and hand their segments over, so a new life costs them nothing.
            Ended::Reincarnate { ordinal } => ordinal_min = ordinal.saturating_add(1),
        }
    }
}

/// The store holds two descriptors for each item, and the usual soft limit is 1,024.
fn raise_descriptor_limit() {
    let limit = getrlimit(Resource::Nofile);
    let raised = Rlimit {
        current: limit.maximum,
        ..limit
    };
    if let Err(error) = setrlimit(Resource::Nofile, raised) {
        tracing::warn!(%error, current = ?limit.current, "the limit on open files stays as it is");
    }
}

/// Why a life of the daemon ended.
enum Ended {
    Shutdown,
    Reincarnate { ordinal: u32 },
}

/// What one life of the daemon leaves to the next.
struct Left {
    /// Items that no program writes.
    orphans: Vec<Orphan>,
    /// Who keeps them beyond this process; none without a service manager.
    keeper: Option<Keeper>,
}

impl Left {
    fn by_the_former_process() -> anyhow::Result<Self> {
        let mut keeper = Manager::from_env()?.map(Keeper::new);
        Ok(Self {
            orphans: keeper.as_mut().map(Keeper::inherit).unwrap_or_default(),
            keeper,
        })
    }
}

struct Daemon {
    ready: Ready,
    handle: server::Handle,
    stopping: Arc<AtomicBool>,
    server: JoinHandle<Vec<Orphan>>,
    keeper: Option<JoinHandle<Keeper>>,
    /// Hands the store's news to the control loop. While that is behind, programs wait; its own calls are answered.
    forwarder: JoinHandle<bool>,
    events: tokio::sync::mpsc::Receiver<StoreEvent>,
    network: Option<Network>,
    publisher: Publisher,
}

impl Daemon {
    fn start(config: &Config, identity: Identity, left: Left) -> anyhow::Result<Self> {
        let socket = config
            .socket
            .clone()
            .unwrap_or_else(|| socket_path(&config.host, config.domain.0));
        let mut server = Server::bind(server::Config {
            socket: Some(socket.clone()),
            domain: config.domain.0,
            ordinal: identity.incarnation.ordinal,
            quotas: config.quotas,
            ..server::Config::new(config.host.clone())
        })?;
        let refused = keeper::restore(&mut server, left.orphans);
        let keeper = match left.keeper {
            Some(mut keeper) => {
                refused.into_iter().for_each(|epoch| keeper.forget(epoch));
                let (sender, changes) = mpsc::sync_channel(keeper::CHANGES_MAX);
                server.keep_orphans(sender);
                let thread = thread::Builder::new()
                    .name("ddx-keeper".to_owned())
                    .spawn(move || keeper.run(changes))
                    .context("starting the thread that keeps items")?;
                Some(thread)
            }
            None => None,
        };
        let handle = server.handle();
        // Asked for before anything happens: the first events are of the items that were restored.
        let news = handle.events()?;
        let stopping = Arc::new(AtomicBool::new(false));
        let stop = Arc::clone(&stopping);
        let server = thread::Builder::new()
            .name("ddx-store".to_owned())
            .spawn(move || {
                if let Err(error) = server.run(&stop) {
                    tracing::error!(%error, "the store's thread failed");
                }
                server.orphans()
            })
            .context("starting the store's thread")?;
        let (sender, events) = tokio::sync::mpsc::channel(NEWS_MAX);
        let forwarder = thread::Builder::new()
            .name("ddx-events".to_owned())
            .spawn(move || {
                let mut news = news.into_iter();
                news.all(|event| sender.blocking_send(event).is_ok())
            })
            .context("starting the thread that forwards the store's news")?;
        let network = match &config.key {
            Some(key) => Some(Network::start(config, identity, key, &handle)?),
            None => None,
        };
        let ready = Ready {
            host: config.host.clone(),
            domain: config.domain,
            socket,
            control: network
                .as_ref()
                .map(|n| n.control_addrs().to_vec())
                .unwrap_or_default(),
            data_port: network.as_ref().map(Network::data_port),
        };
        let publisher = Publisher::new(&handle, identity, &ready, config, network.as_ref())?;
        Ok(Self {
            ready,
            handle,
            stopping,
            server,
            keeper,
            forwarder,
            events,
            network,
            publisher,
        })
    }

    async fn serve(
        &mut self,
        mut shutdown: Pin<&mut impl Future<Output = ()>>,
    ) -> anyhow::Result<Ended> {
        let mut tick = interval(STATE_PERIOD);
        tick.set_missed_tick_behavior(MissedTickBehavior::Skip);
        loop {
            tokio::select! {
                () = &mut shutdown => return Ok(Ended::Shutdown),
                _ = tick.tick() => self.publisher.publish(self.network.as_ref()),
                Some(event) = self.events.recv() => {
                    if let Some(network) = &mut self.network {
                        network.handle_store(event)?;
                    }
                }
                ended = turn(self.network.as_mut()) => {
                    if let Some(ordinal) = ended? {
                        return Ok(Ended::Reincarnate { ordinal });
                    }
                }
            }
        }
    }

    fn stop(mut self) -> Left {
        if let Some(network) = self.network.take() {
            network.stop();
        }
        drop(self.publisher);
        // Whoever forwards them may be waiting for room.
        drop(self.events);
        self.stopping.store(true, Ordering::Relaxed);
        self.handle.wake();
        drop(self.handle);
        let orphans = self.server.join().unwrap_or_else(|_panic| {
            tracing::error!("the store's thread panicked");
            Vec::new()
        });
        if self.forwarder.join().is_err() {
            tracing::error!("the thread that forwards the store's news panicked");
        }
        let keeper = self.keeper.and_then(|keeper| match keeper.join() {
            Ok(keeper) => Some(keeper),
            Err(_panic) => {
                tracing::error!("the thread that keeps items panicked");
                None
            }
        });
        Left { orphans, keeper }
    }
}

async fn turn(network: Option<&mut Network>) -> anyhow::Result<Option<u32>> {
    match network {
        Some(network) => network.turn().await,
        None => std::future::pending().await,
    }
}
