//! Who writes what and who reads it: the daemon's state, without its sockets.
//!
//! A pure machine but for the shared memory that it is given: [`Registry::handle`] takes one message of one client and
//! queues [`Effect`]s, which [`Registry::poll_effect`] hands out in order. Nothing a client says makes it panic, wait or
//! hold more than the [`Quotas`] allow.

mod item;
mod lease;
mod listing;
mod orphan;

use std::collections::{BTreeMap, VecDeque};
use std::os::fd::OwnedFd;
use std::sync::Arc;

use ddx_wire::{Contract, Epoch, HostName, ItemDescription, ItemName, Time};

use self::item::{Item, Reader};
use super::orphan::Keep;
use crate::control::{
    Notice, Refusal, Reply, Request, SCHEMA_MAX_BYTES, ToClient, ToDaemon, VERSION,
};
use crate::notify::{Bell, Bells, MAX_CLIENTS};
use crate::quota::{Bucket, Limit, Quotas};
use crate::schema::Schema;

/// Number of one connection, never used twice.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct ClientId(pub u64);

/// Whom the registry serves.
#[derive(Clone, Debug)]
pub struct Identity {
    /// Name of this host: the prefix of its items.
    pub host: HostName,
    /// Number of the domain.
    pub domain: u16,
    /// Number of this life of the daemon: the upper half of its epochs.
    pub ordinal: u32,
    /// Limits on each client.
    pub quotas: Quotas,
}

/// What is to be done about the outside.
#[derive(Debug)]
pub enum Effect {
    /// Send a message to a client.
    Send {
        /// To whom.
        client: ClientId,
        /// What.
        message: ToClient,
        /// What goes beside it.
        fds: Vec<Arc<OwnedFd>>,
    },
    /// Close a client's connection once what was sent to it is out; it is forgotten here already.
    Disconnect {
        /// Whose.
        client: ClientId,
    },
    /// Tell the daemon.
    Event(Event),
    /// Tell whoever keeps what outlives the daemon.
    Keep(Keep),
}

/// What happens among the items of a host, as far as other hosts are concerned.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Event {
    /// An item of this host is there, or has another schema or capacity than before.
    Announced {
        /// The item.
        description: ItemDescription,
        /// Text of its schema.
        schema: String,
    },
    /// An item of this host has another epoch or writer.
    Changed {
        /// The item as it is now.
        description: ItemDescription,
    },
    /// An item of this host is gone.
    Withdrawn {
        /// The item.
        name: ItemName,
    },
    /// Programs of this host read an item of another one, under this contract in all.
    Wanted {
        /// The item.
        name: ItemName,
        /// Union of the readers' contracts.
        contract: Contract,
    },
    /// Nobody on this host reads that item any more.
    Unwanted {
        /// The item.
        name: ItemName,
    },
}

/// What the daemon knows of an item of another host.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RemoteItem {
    /// The host that owns it.
    pub host: HostName,
    /// What that host says of it.
    pub description: ItemDescription,
    /// Text of its schema, which many items may share; empty while unknown.
    pub schema: Arc<str>,
}

/// Clients that were cut off, by reason.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counters {
    /// Sent something that is no message, or none at that time.
    pub bad_messages: u64,
    /// Did not collect their answers.
    pub overflows: u64,
    /// Requests refused because a limit was exhausted.
    pub quota_refusals: u64,
    /// Segments refused because they were not as they must be.
    pub bad_segments: u64,
    /// Connections closed at once because there were too many.
    pub turned_away: u64,
    /// Changes of items without a writer that whoever keeps them was not told, because too many wait: such an item may not
    /// outlive the daemon, or be kept for nothing.
    pub unkept: u64,
}

/// The daemon's state.
#[derive(Debug)]
pub struct Registry {
    identity: Identity,
    bells: Arc<Bells>,
    bells_fd: Arc<OwnedFd>,
    clients: BTreeMap<ClientId, Client>,
    items: BTreeMap<ItemName, Item>,
    remote: BTreeMap<ItemName, RemoteItem>,
    notes: BTreeMap<ItemName, String>,
    effects: VecDeque<Effect>,
    counters: Counters,
    last_client: u64,
    last_epoch: u32,
}

#[derive(Debug)]
struct Client {
    program: String,
    pid: u32,
    privileged: bool,
    greeted: bool,
    bell: u16,
    bucket: Bucket,
    handles: BTreeMap<u32, Handle>,
    bytes: u64,
}

#[derive(Clone, Debug, PartialEq, Eq)]
enum Handle {
    Writer(ItemName),
    Reader(ItemName),
}

impl Registry {
    /// A registry without clients. `bells` is what it rings, `bells_fd` the same for clients to map.
    pub fn new(identity: Identity, bells: Arc<Bells>, bells_fd: Arc<OwnedFd>) -> Self {
        Self {
            identity,
            bells,
            bells_fd,
            clients: BTreeMap::new(),
            items: BTreeMap::new(),
            remote: BTreeMap::new(),
            notes: BTreeMap::new(),
            effects: VecDeque::new(),
            counters: Counters::default(),
            last_client: 0,
            last_epoch: 0,
        }
    }

    /// Takes in a new connection of process `pid`; an error says that there are too many.
    pub fn connect(&mut self, pid: u32, privileged: bool, now: Time) -> Result<ClientId, Refusal> {
        let quotas = &self.identity.quotas;
        let most = u32::from(MAX_CLIENTS).min(quotas.clients);
        let Some(bell) = (0..u16::try_from(most).unwrap_or(MAX_CLIENTS))
            .find(|bell| self.clients.values().all(|client| client.bell != *bell))
        else {
            self.counters.turned_away += 1;
            return Err(Refusal::Quota {
                limit: Limit::Clients,
                wanted: u64::from(most) + 1,
                max: u64::from(most),
            });
        };
        self.last_client += 1;
        let id = ClientId(self.last_client);
        let client = Client {
            program: String::new(),
            pid,
            privileged,
            greeted: false,
            bell,
            bucket: Bucket::new(quotas.messages_per_second, now),
            handles: BTreeMap::new(),
            bytes: 0,
        };
        self.clients.insert(id, client);
        Ok(id)
    }

    /// Takes one message of a client, with the descriptors that were beside it. Bad ones end the connection.
    pub fn handle(&mut self, client: ClientId, bytes: &[u8], fds: Vec<OwnedFd>, now: Time) {
        let Some(known) = self.clients.get_mut(&client) else {
            return;
        };
        let message = match ToDaemon::decode(bytes) {
            Ok(message) => message,
            Err(e) => return self.refuse_and_close(client, e.to_string()),
        };
        let serial = message.serial;
        if !known.privileged && !known.bucket.take(now) {
            let max = u64::from(self.identity.quotas.messages_per_second);
            let refusal = Refusal::Quota {
                limit: Limit::MessageRate,
                wanted: max + 1,
                max,
            };
            return self.refuse(client, serial, refusal);
        }
        if known.greeted == matches!(message.request, Request::Hello { .. }) {
            let fault = if known.greeted {
                "a second greeting"
            } else {
                "no greeting yet"
            };
            return self.refuse_and_close(client, fault.to_owned());
        }
        if let Err(refusal) = self.request(client, serial, message.request, fds) {
            self.refuse(client, serial, refusal);
        }
    }

    /// Ends a connection that said something too long to read.
    pub fn handle_oversized(&mut self, client: ClientId) {
        self.refuse_and_close(client, "longer than any message".to_owned());
    }

    /// Forgets a client that is gone: its leases and cells are free at once.
    pub fn disconnect(&mut self, client: ClientId) {
        let Some(known) = self.clients.get_mut(&client) else {
            return;
        };
        for (number, handle) in std::mem::take(&mut known.handles) {
            self.release(client, number, handle);
        }
        self.clients.remove(&client);
    }

    /// Forgets a client that does not collect its answers.
    pub fn disconnect_overflowed(&mut self, client: ClientId) {
        self.counters.overflows += 1;
        self.disconnect(client);
    }

    /// Replaces what is known of other hosts' items.
    pub fn set_remote(&mut self, items: Vec<RemoteItem>) {
        self.remote = items
            .into_iter()
            .map(|item| (item.description.name.clone(), item))
            .collect();
    }

    /// Replaces what is said of each item's way here.
    pub fn set_notes(&mut self, notes: BTreeMap<ItemName, String>) {
        self.notes = notes;
    }

    /// The next thing to do.
    pub fn poll_effect(&mut self) -> Option<Effect> {
        self.effects.pop_front()
    }

    /// Counts a change of an item without a writer that nobody was told.
    pub(super) fn count_unkept(&mut self) {
        self.counters.unkept += 1;
    }

    /// What went wrong so far.
    pub fn counters(&self) -> Counters {
        self.counters
    }

    /// Messages that may wait for one client.
    pub fn queue_limit(&self) -> usize {
        usize::try_from(self.identity.quotas.queued_replies).unwrap_or(usize::MAX)
    }

    /// Clients connected now.
    pub fn client_count(&self) -> usize {
        self.clients.len()
    }

    fn request(
        &mut self,
        client: ClientId,
        serial: u32,
        request: Request,
        fds: Vec<OwnedFd>,
    ) -> Result<(), Refusal> {
        let reply = match request {
            Request::Hello { version, program } => {
                return self.hello(client, serial, version, program);
            }
            Request::OpenWriter {
                handle,
                name,
                schema,
                purpose,
            } => {
                return self.open_writer(client, serial, handle, &name, &schema, purpose);
            }
            Request::Commit { handle } => self.commit(client, handle, fds)?,
            Request::Resume {
                handle,
                name,
                schema,
            } => self.resume(client, handle, &name, &schema, fds)?,
            Request::OpenReader {
                handle,
                name,
                schema,
                pins,
                contract,
                held,
            } => {
                let reader = Reader {
                    client,
                    handle,
                    schema: schema.map(|text| parse_schema(&text)).transpose()?,
                    extra_pins: pins,
                    contract,
                    seat: None,
                    refused: None,
                };
                return self.open_reader(serial, &name, reader, held);
            }
            Request::Close { handle } => {
                let known = self.clients.get_mut(&client);
                if let Some(kind) = known.and_then(|known| known.handles.remove(&handle)) {
                    self.release(client, handle, kind);
                }
                Reply::Done
            }
            Request::List { after } => self.list(&after),
            Request::Describe { name } => {
                let name = self.parse_name(&name)?;
                Reply::Description(Box::new(self.describe(&name).ok_or(Refusal::Absent(name))?))
            }
            Request::Remove { name } => self.remove(&name)?,
        };
        self.reply(client, serial, reply, Vec::new());
        Ok(())
    }

    fn hello(
        &mut self,
        client: ClientId,
        serial: u32,
        version: u32,
        program: String,
    ) -> Result<(), Refusal> {
        if version != VERSION {
            return Err(Refusal::Message(format!(
                "version {version}, and this daemon speaks only {VERSION}"
            )));
        }
        let known = self.clients.get_mut(&client).ok_or_else(stranger)?;
        known.greeted = true;
        known.program = program;
        let mut end = known.program.len().min(ItemDescription::PROGRAM_MAX_BYTES);
        while !known.program.is_char_boundary(end) {
            end -= 1;
        }
        known.program.truncate(end);
        let reply = Reply::Hello {
            host: self.identity.host.clone(),
            domain: self.identity.domain,
            bell: known.bell,
        };
        let fds = vec![Arc::clone(&self.bells_fd)];
        self.reply(client, serial, reply, fds);
        Ok(())
    }

    /// Gives back what a handle holds.
    fn release(&mut self, client: ClientId, number: u32, handle: Handle) {
        match handle {
            Handle::Writer(name) => self.end_lease(&name, client, number),
            Handle::Reader(name) => self.close_reader(&name, client, number),
        }
    }

    fn parse_name(&self, text: &str) -> Result<ItemName, Refusal> {
        ItemName::parse(text, &self.identity.host).map_err(|e| Refusal::Name(e.to_string()))
    }

    fn next_epoch(&mut self) -> Epoch {
        self.last_epoch += 1;
        Epoch::new(self.identity.ordinal, self.last_epoch)
    }

    fn reply(&mut self, client: ClientId, serial: u32, reply: Reply, fds: Vec<Arc<OwnedFd>>) {
        let message = ToClient::Reply { serial, reply };
        self.effects.push_back(Effect::Send {
            client,
            message,
            fds,
        });
    }

    fn notify(&mut self, client: ClientId, handle: u32, notice: Notice, fds: Vec<Arc<OwnedFd>>) {
        let message = ToClient::Notice { handle, notice };
        self.effects.push_back(Effect::Send {
            client,
            message,
            fds,
        });
        if let Some(known) = self.clients.get(&client) {
            let bell = Bell {
                client: known.bell,
                bit: 0,
            };
            self.bells.ring(bell);
        }
    }

    fn event(&mut self, event: Event) {
        self.effects.push_back(Effect::Event(event));
    }

    fn refuse(&mut self, client: ClientId, serial: u32, refusal: Refusal) {
        match refusal {
            Refusal::Quota { .. } => self.counters.quota_refusals += 1,
            Refusal::Segment(_) => self.counters.bad_segments += 1,
            Refusal::Held { .. }
            | Refusal::ForeignPrefix { .. }
            | Refusal::Administrative(_)
            | Refusal::Schema { .. }
            | Refusal::Name(_)
            | Refusal::BadSchema(_)
            | Refusal::Absent(_)
            | Refusal::Message(_) => {}
        }
        self.reply(client, serial, Reply::Refused(refusal), Vec::new());
    }

    fn refuse_and_close(&mut self, client: ClientId, fault: String) {
        if !self.clients.contains_key(&client) {
            return;
        }
        self.counters.bad_messages += 1;
        let notice = Notice::Closing(Refusal::Message(fault));
        self.notify(client, 0, notice, Vec::new());
        self.effects.push_back(Effect::Disconnect { client });
        self.disconnect(client);
    }
}

impl Client {
    /// Checks that one more of what is counted by `held` may be had.
    fn allow(&self, limit: Limit, wanted: u64, max: u64) -> Result<(), Refusal> {
        if self.privileged || wanted <= max {
            return Ok(());
        }
        Err(Refusal::Quota { limit, wanted, max })
    }

    fn writer_count(&self) -> u64 {
        self.count(|handle| matches!(handle, Handle::Writer(_)))
    }

    fn reader_count(&self) -> u64 {
        self.count(|handle| matches!(handle, Handle::Reader(_)))
    }

    fn count(&self, which: impl Fn(&Handle) -> bool) -> u64 {
        let held = self.handles.values().filter(|handle| which(handle));
        u64::try_from(held.count()).unwrap_or(u64::MAX)
    }
}

fn parse_schema(text: &str) -> Result<Schema, Refusal> {
    if text.len() > SCHEMA_MAX_BYTES {
        return Err(Refusal::BadSchema(format!(
            "schema of {} bytes is longer than {SCHEMA_MAX_BYTES}",
            text.len()
        )));
    }
    Schema::parse(text).map_err(|e| Refusal::BadSchema(e.to_string()))
}

fn stranger() -> Refusal {
    Refusal::Message("from a client that is not connected".to_owned())
}

#[cfg(test)]
mod tests;
