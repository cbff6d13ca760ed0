//! Writers and readers of the registry: grant, hand-over, release, and who is told.

use std::os::fd::OwnedFd;

use ddx_wire::{ItemDescription, ItemName, WriterState};

use super::item::{Item, Lease, Reader, Segment, Tenure};
use super::{ClientId, Event, Handle, Registry, parse_schema, stranger};
use crate::control::{HeldCell, Notice, Purpose, Refusal, Reply};
use crate::layout::{BASE_PINS, MAX_PINS};
use crate::notify::Bell;
use crate::quota::Limit;
use crate::segment::{Seat, State};

const SUPERSEDED: State = State {
    superseded: true,
    orphaned: false,
    removed: false,
};
const ORPHANED: State = State {
    superseded: false,
    orphaned: true,
    removed: false,
};
const REMOVED: State = State {
    superseded: false,
    orphaned: false,
    removed: true,
};

impl Registry {
    pub(super) fn open_writer(
        &mut self,
        client: ClientId,
        serial: u32,
        handle: u32,
        name: &str,
        schema: &str,
        purpose: Purpose,
    ) -> Result<(), Refusal> {
        let name = self.may_write(client, handle, name)?;
        let schema = parse_schema(schema)?;
        let epoch = self.next_epoch();
        let item = self.items.entry(name.clone()).or_default();
        let same = item.tenure.as_ref().filter(|last| last.schema == schema);
        let fds = same.map_or_else(Vec::new, |last| last.segment.fds());
        item.lease = Some(Lease {
            client,
            handle,
            purpose,
            epoch,
            schema,
            bytes: 0,
        });
        self.hold(client, handle, Handle::Writer(name.clone()));
        self.reply(client, serial, Reply::Writer { name, epoch }, fds);
        Ok(())
    }

    /// Installs the segment that the lease's holder has made and filled, and moves all readers over.
    pub(super) fn commit(
        &mut self,
        client: ClientId,
        handle: u32,
        fds: Vec<OwnedFd>,
    ) -> Result<Reply, Refusal> {
        let name = self.written_by(client, handle)?;
        let segment = Segment::accept(fds)?;
        self.charge(client, segment.bytes())?;
        let Some(lease) = self
            .items
            .get_mut(&name)
            .and_then(|item| item.lease.as_mut())
        else {
            return Err(Refusal::Absent(name));
        };
        if segment.control.epoch() != lease.epoch {
            return Err(Refusal::Segment(format!(
                "epoch {} instead of {}",
                segment.control.epoch().0,
                lease.epoch.0
            )));
        }
        let former = std::mem::replace(&mut lease.bytes, segment.bytes());
        self.refund(client, former);
        self.install(&name, client, segment);
        Ok(Reply::Done)
    }

    /// Takes a living writer's segment back after this daemon was started anew.
    pub(super) fn resume(
        &mut self,
        client: ClientId,
        handle: u32,
        name: &str,
        schema: &str,
        fds: Vec<OwnedFd>,
    ) -> Result<Reply, Refusal> {
        let name = self.may_write(client, handle, name)?;
        let schema = parse_schema(schema)?;
        let mut segment = Segment::accept(fds)?;
        let epoch = segment.control.epoch();
        let known = self.items.get(&name).and_then(|item| item.tenure.as_ref());
        if known.is_some_and(|tenure| tenure.segment.control.epoch() >= epoch) {
            // Another program has taken over, and is gone again: its value is the newer one.
            return Err(Refusal::Segment("a later writer has taken over".to_owned()));
        }
        self.charge(client, segment.bytes())?;
        segment.reserved = segment.control.open_cells();
        let item = self.items.entry(name.clone()).or_default();
        item.lease = Some(Lease {
            client,
            handle,
            purpose: Purpose::Write,
            epoch,
            schema,
            bytes: segment.bytes(),
        });
        self.hold(client, handle, Handle::Writer(name.clone()));
        self.install(&name, client, segment);
        Ok(Reply::Done)
    }

    pub(super) fn end_lease(&mut self, name: &ItemName, client: ClientId, handle: u32) {
        let is_own = name.is_under(&self.identity.host) || name.is_admin();
        let Some(item) = self.items.get_mut(name) else {
            return;
        };
        let Some(lease) = item
            .lease
            .take_if(|lease| lease.client == client && lease.handle == handle)
        else {
            return;
        };
        let mut changed = false;
        if lease.bytes > 0
            && let Some(tenure) = &mut item.tenure
        {
            tenure.state = match lease.purpose {
                Purpose::Write => WriterState::Orphaned,
                Purpose::Put => WriterState::Daemon,
            };
            if lease.purpose == Purpose::Write {
                tenure.segment.control.set_state(ORPHANED, &self.bells);
            }
            changed = true;
        }
        if !is_own && item.readers.is_empty() {
            // A mirror is nobody's last value: its owner has it.
            item.tenure = None;
        }
        self.refund(client, lease.bytes);
        if changed && is_own {
            if lease.purpose == Purpose::Write {
                self.keep(name, WriterState::Orphaned);
            }
            self.tell_changed(name);
        }
        self.forget_if_empty(name);
    }

    pub(super) fn open_reader(
        &mut self,
        serial: u32,
        name: &str,
        mut reader: Reader,
        held: Option<HeldCell>,
    ) -> Result<(), Refusal> {
        let name = self.parse_name(name)?;
        let (client, handle) = (reader.client, reader.handle);
        let bell = self.check_new(client, handle)?;
        let quotas = self.identity.quotas;
        let known = self.clients.get(&client).ok_or_else(stranger)?;
        known.allow(
            Limit::Cells,
            known.reader_count() + 1,
            u64::from(quotas.cells),
        )?;
        if reader.extra_pins > MAX_PINS - BASE_PINS {
            return Err(Refusal::Quota {
                limit: Limit::Pins,
                wanted: u64::from(reader.extra_pins),
                max: u64::from(MAX_PINS - BASE_PINS),
            });
        }
        self.check_remote_schema(&name, &reader)?;
        let item = self.items.entry(name.clone()).or_default();
        let bell = reader.bell(bell);
        let seated = match &mut item.tenure {
            Some(tenure) => reclaim(tenure, held, &reader, bell),
            None => None,
        };
        let placed = match (&item.tenure, seated) {
            (Some(_), Some(seat)) => Ok(Some(seat)),
            (Some(tenure), None) => seat(&name, item, tenure, &reader, bell).map(Some),
            (None, _) => Ok(None),
        };
        let mut binding = None;
        let mut fds = Vec::new();
        match placed {
            Ok(Some(seat)) => {
                reader.seat = Some(seat);
                if let Some(tenure) = &item.tenure {
                    binding = Some(tenure.binding(seat));
                    fds = tenure.segment.fds();
                }
            }
            Ok(None) => {}
            Err(refusal) => {
                self.forget_if_empty(&name);
                return Err(refusal);
            }
        }
        item.readers.push(reader);
        self.hold(client, handle, Handle::Reader(name.clone()));
        self.tell_wanted(&name);
        self.reply(client, serial, Reply::Reader { name, binding }, fds);
        Ok(())
    }

    pub(super) fn close_reader(&mut self, name: &ItemName, client: ClientId, handle: u32) {
        let Some(item) = self.items.get_mut(name) else {
            return;
        };
        let at = item
            .readers
            .iter()
            .position(|reader| reader.client == client && reader.handle == handle);
        let Some(at) = at else {
            return;
        };
        let reader = item.readers.swap_remove(at);
        if let (Some(seat), Some(tenure)) = (reader.seat, &item.tenure) {
            tenure.segment.control.clear_cell(seat.cell);
        }
        let is_mirror = !name.is_under(&self.identity.host) && !name.is_admin();
        if is_mirror && item.readers.is_empty() && item.lease.is_none() {
            item.tenure = None;
        }
        self.tell_wanted(name);
        self.forget_if_empty(name);
    }

    /// Removes an item that no program writes; its readers are told and wait for the next one of the name.
    pub(super) fn remove(&mut self, name: &str) -> Result<Reply, Refusal> {
        let name = self.parse_name(name)?;
        if !name.is_under(&self.identity.host) && !name.is_admin() {
            return Err(self.foreign(name));
        }
        self.check_free(&name)?;
        let Some(item) = self.items.get_mut(&name) else {
            return Err(Refusal::Absent(name));
        };
        let Some(tenure) = item.tenure.take() else {
            return Err(Refusal::Absent(name));
        };
        tenure.segment.control.set_state(REMOVED, &self.bells);
        let mut told = Vec::new();
        for reader in &mut item.readers {
            reader.seat = None;
            told.push((reader.client, reader.handle));
        }
        for (client, handle) in told {
            self.notify(client, handle, Notice::Removed, Vec::new());
        }
        self.release_former(&name, &tenure);
        if !name.is_admin() {
            self.event(Event::Withdrawn { name: name.clone() });
        }
        self.forget_if_empty(&name);
        Ok(Reply::Done)
    }

    /// Puts a checked segment in the place of the item's former one.
    fn install(&mut self, name: &ItemName, client: ClientId, segment: Segment) {
        let Some(known) = self.clients.get(&client) else {
            return;
        };
        let (program, pid) = (known.program.clone(), known.pid);
        let Some(item) = self.items.get_mut(name) else {
            return;
        };
        let Some(lease) = &item.lease else {
            return;
        };
        let is_put = lease.purpose == Purpose::Put;
        let spec = segment.control.spec();
        let tenure = Tenure {
            segment,
            schema: lease.schema.clone(),
            state: WriterState::Live,
            program,
            pid,
        };
        let former = item.tenure.take();
        let is_same_kind = former.as_ref().is_some_and(|former| {
            former.schema == tenure.schema
                && former.segment.control.spec().capacity_bytes == spec.capacity_bytes
                && former.segment.control.spec().depth == spec.depth
        });
        let mut told = Vec::new();
        for at in 0..item.readers.len() {
            let Some(reader) = item.readers.get_mut(at) else {
                continue;
            };
            reader.seat = None;
            let (client, handle) = (reader.client, reader.handle);
            let Some(known) = self.clients.get(&client) else {
                continue;
            };
            let Some(reader) = item.readers.get(at) else {
                continue;
            };
            let bell = reader.bell(known.bell);
            let placed = seat(name, item, &tenure, reader, bell);
            let Some(reader) = item.readers.get_mut(at) else {
                continue;
            };
            reader.refused = placed.as_ref().err().map(ToString::to_string);
            reader.seat = placed.as_ref().ok().copied();
            match placed {
                Ok(seat) => {
                    let notice = Notice::Bound(tenure.binding(seat));
                    told.push((client, handle, notice, tenure.segment.fds()));
                }
                Err(refusal) => told.push((client, handle, Notice::Refused(refusal), Vec::new())),
            }
        }
        item.tenure = Some(tenure);
        for (client, handle, notice, fds) in told {
            self.notify(client, handle, notice, fds);
        }
        crate::crash::point("handover.told");
        // Last, so that whoever sees the mark finds the notice in its socket.
        if let Some(former) = &former {
            former.segment.control.set_state(SUPERSEDED, &self.bells);
        }
        // The value is there already, and the daemon is its writer of record.
        if is_put {
            self.keep(name, WriterState::Daemon);
        }
        if let Some(former) = &former {
            self.release_former(name, former);
        }
        if is_same_kind {
            self.tell_changed(name);
        } else {
            self.tell_announced(name);
        }
    }

    /// Checks that `client` may write the name it spelt, and that nobody else does.
    fn may_write(&self, client: ClientId, handle: u32, name: &str) -> Result<ItemName, Refusal> {
        let name = self.parse_name(name)?;
        self.check_new(client, handle)?;
        let known = self.clients.get(&client).ok_or_else(stranger)?;
        if !known.privileged {
            if name.is_admin() {
                return Err(Refusal::Administrative(name));
            }
            if !name.is_under(&self.identity.host) {
                return Err(self.foreign(name));
            }
        }
        self.check_free(&name)?;
        let quotas = &self.identity.quotas;
        let items = known.writer_count() + 1;
        known.allow(Limit::Items, items, u64::from(quotas.items))?;
        known.allow(Limit::Fds, items * 2, u64::from(quotas.fds))?;
        Ok(name)
    }

    fn check_new(&self, client: ClientId, handle: u32) -> Result<u16, Refusal> {
        let known = self.clients.get(&client).ok_or_else(stranger)?;
        if known.handles.contains_key(&handle) {
            return Err(Refusal::Message(format!("handle {handle} is open")));
        }
        Ok(known.bell)
    }

    fn check_free(&self, name: &ItemName) -> Result<(), Refusal> {
        let lease = self.items.get(name).and_then(|item| item.lease.as_ref());
        let Some(lease) = lease else {
            return Ok(());
        };
        let holder = self.clients.get(&lease.client);
        Err(Refusal::Held {
            name: name.clone(),
            program: holder.map_or_else(String::new, |holder| holder.program.clone()),
            pid: holder.map_or(0, |holder| holder.pid),
        })
    }

    fn check_remote_schema(&self, name: &ItemName, reader: &Reader) -> Result<(), Refusal> {
        let Some(wanted) = &reader.schema else {
            return Ok(());
        };
        let Some(remote) = self.remote.get(name) else {
            return Ok(());
        };
        let Ok(schema) = parse_schema(&remote.schema) else {
            return Ok(());
        };
        match wanted.difference(&schema) {
            None => Ok(()),
            Some(difference) => Err(Refusal::Schema {
                name: name.clone(),
                difference,
            }),
        }
    }

    pub(super) fn foreign(&self, name: ItemName) -> Refusal {
        Refusal::ForeignPrefix {
            hint: name.to_string(),
            host: self.identity.host.clone(),
            name,
        }
    }

    fn written_by(&self, client: ClientId, handle: u32) -> Result<ItemName, Refusal> {
        let known = self.clients.get(&client).ok_or_else(stranger)?;
        match known.handles.get(&handle) {
            Some(Handle::Writer(name)) => Ok(name.clone()),
            Some(Handle::Reader(_)) | None => {
                Err(Refusal::Message(format!("handle {handle} is no writer")))
            }
        }
    }

    fn hold(&mut self, client: ClientId, number: u32, handle: Handle) {
        if let Some(known) = self.clients.get_mut(&client) {
            known.handles.insert(number, handle);
        }
    }

    fn charge(&mut self, client: ClientId, bytes: u64) -> Result<(), Refusal> {
        let max = self.identity.quotas.bytes;
        let known = self.clients.get_mut(&client).ok_or_else(stranger)?;
        let wanted = known.bytes.saturating_add(bytes);
        known.allow(Limit::Bytes, wanted, max)?;
        known.bytes = wanted;
        Ok(())
    }

    fn refund(&mut self, client: ClientId, bytes: u64) {
        if let Some(known) = self.clients.get_mut(&client) {
            known.bytes = known.bytes.saturating_sub(bytes);
        }
    }

    fn forget_if_empty(&mut self, name: &ItemName) {
        if self.items.get(name).is_some_and(Item::is_empty) {
            self.items.remove(name);
        }
    }

    pub(super) fn tell_announced(&mut self, name: &ItemName) {
        let Some(description) = self.own_description(name) else {
            return;
        };
        let tenure = self.items.get(name).and_then(|item| item.tenure.as_ref());
        let schema = tenure.map_or_else(String::new, |tenure| tenure.schema.text().to_owned());
        self.event(Event::Announced {
            description,
            schema,
        });
    }

    fn tell_changed(&mut self, name: &ItemName) {
        if let Some(description) = self.own_description(name) {
            self.event(Event::Changed { description });
        }
    }

    /// What other hosts are told of an item; nothing about mirrors and administrative items.
    fn own_description(&self, name: &ItemName) -> Option<ItemDescription> {
        if name.is_admin() || !name.is_under(&self.identity.host) {
            return None;
        }
        let tenure = self.items.get(name)?.tenure.as_ref()?;
        let spec = tenure.segment.control.spec();
        Some(ItemDescription {
            name: name.clone(),
            schema_hash: tenure.schema.hash(),
            capacity_bytes: spec.capacity_bytes,
            depth: spec.depth,
            epoch: tenure.segment.control.epoch(),
            writer: tenure.state,
            program: tenure.program.clone(),
        })
    }

    /// Tells the daemon when what this host wants of another host's item has changed.
    fn tell_wanted(&mut self, name: &ItemName) {
        if name.is_admin() || name.is_under(&self.identity.host) {
            return;
        }
        let Some(item) = self.items.get_mut(name) else {
            return;
        };
        let wanted = item.contract();
        if wanted == item.wanted {
            return;
        }
        item.wanted = wanted;
        let name = name.clone();
        self.event(match wanted {
            Some(contract) => Event::Wanted { name, contract },
            None => Event::Unwanted { name },
        });
    }
}

/// A place for a reader in a segment, when it can read it at all.
fn seat(
    name: &ItemName,
    item: &Item,
    tenure: &Tenure,
    reader: &Reader,
    bell: Bell,
) -> Result<Seat, Refusal> {
    if let Some(wanted) = &reader.schema
        && let Some(difference) = wanted.difference(&tenure.schema)
    {
        return Err(Refusal::Schema {
            name: name.clone(),
            difference,
        });
    }
    item.find_seat(tenure, reader.extra_pins, bell)
}

/// The place that a reader kept while the daemon was away, if it is the same segment.
fn reclaim(
    tenure: &mut Tenure,
    held: Option<HeldCell>,
    reader: &Reader,
    bell: Bell,
) -> Option<Seat> {
    let held = held?;
    let segment = &mut tenure.segment;
    let bit = 1_u64.checked_shl(held.cell)?;
    let is_readable = reader
        .schema
        .as_ref()
        .is_none_or(|wanted| wanted.difference(&tenure.schema).is_none());
    if !is_readable
        || segment.control.epoch() != held.epoch
        || segment.reserved & bit == 0
        || held.cell >= segment.control.spec().cells
        || !(BASE_PINS..=MAX_PINS).contains(&held.pins)
    {
        return None;
    }
    segment.reserved &= !bit;
    Some(Seat {
        cell: held.cell,
        pins: held.pins,
        bell,
    })
}
