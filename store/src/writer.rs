//! An item's only writer: typed and by schema.

use std::marker::PhantomData;
use std::ops::{Deref, DerefMut};
use std::os::fd::AsFd;
use std::sync::Arc;

use ddx_wire::{ItemName, Seq, Time};

use crate::clock;
use crate::connection::{Connection, Mail, Mailbox, segment_fds};
use crate::control::{Purpose, Reply, Request};
use crate::crash;
use crate::error::Error;
use crate::item::{Item, Plain, plain};
use crate::recovery::Registration;
use crate::schema::Schema;
use crate::segment::{LoanError, Origin, SegmentControl, SegmentError, SegmentWriter, Slot, Spec};
use crate::store::unexpected;

/// How an item is laid out by its writer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct WriterOptions {
    /// Samples that the ring holds.
    pub depth: u32,
    /// Pins that readers may ask for beyond the two that each has, in all.
    pub pins: u32,
    /// Readers on this host, at most 64.
    pub max_readers: u32,
    /// Largest payload, bytes. By default the size of a plain type, 64 KiB for all else.
    pub capacity_bytes: Option<u32>,
}

/// Writes the samples of an item of type `T`. The item is free for another writer once this is dropped; its last value
/// stays.
#[derive(Debug)]
pub struct Writer<T> {
    raw: RawWriter,
    payload: Vec<u8>,
    item: PhantomData<fn(T)>,
}

/// Writes the samples of an item as bytes.
#[derive(Debug)]
pub struct RawWriter {
    segment: SegmentWriter,
    schema: Schema,
    seq: Seq,
    life: u64,
    mailbox: Arc<Mailbox>,
    begun: Option<Slot>,
    // Dropped last: the daemon hears of the end when nothing is written any more.
    lease: Lease,
}

/// The memory of the next sample of a plain type, to be filled in place. Dropping it publishes nothing.
#[derive(Debug)]
pub struct Loan<'a, T> {
    raw: RawLoan<'a>,
    item: PhantomData<fn(T)>,
}

/// The memory of the next sample. Dropping it publishes nothing.
#[derive(Debug)]
pub struct RawLoan<'a> {
    writer: &'a mut RawWriter,
    slot: Option<Slot>,
}

/// The right to write, given back on drop.
#[derive(Debug)]
struct Lease {
    connection: Arc<Connection>,
    handle: u32,
    name: ItemName,
}

impl Default for WriterOptions {
    fn default() -> Self {
        Self {
            depth: 8,
            pins: 8,
            max_readers: 64,
            capacity_bytes: None,
        }
    }
}

impl<T: Item> Writer<T> {
    pub(crate) fn new(raw: RawWriter) -> Self {
        Self {
            raw,
            payload: Vec::new(),
            item: PhantomData,
        }
    }

    /// Publishes `value` as captured now. Never blocks, and makes no system call while no reader waits. Fails when the
    /// value is longer than the item's capacity.
    pub fn write(&mut self, value: &T) -> Result<Seq, Error> {
        match value.as_payload() {
            Some(payload) => self.raw.write(payload),
            None => self.raw.write(encoded(value, &mut self.payload)?),
        }
    }

    /// Publishes `value`, whose content was true at `capture`.
    pub fn write_at(&mut self, value: &T, capture: Time) -> Result<Seq, Error> {
        let payload = match value.as_payload() {
            Some(payload) => payload,
            None => encoded(value, &mut self.payload)?,
        };
        let mut loan = self.raw.loan(payload.len())?;
        loan.as_mut_slice().copy_from_slice(payload);
        loan.publish_at(capture)
    }

    /// The item's name.
    pub fn name(&self) -> &ItemName {
        self.raw.name()
    }

    /// Samples that were overwritten while a reader held them beyond its pins.
    pub fn forced(&self) -> u64 {
        self.raw.forced()
    }
}

impl<T: Plain> Writer<T> {
    /// Memory for the next sample, with unspecified content. Never blocks.
    pub fn loan(&mut self) -> Result<Loan<'_, T>, Error> {
        let raw = self.raw.loan(size_of::<T>())?;
        Ok(Loan {
            raw,
            item: PhantomData,
        })
    }
}

impl RawWriter {
    pub(crate) fn open(
        connection: &Arc<Connection>,
        name: &str,
        schema: &Schema,
        options: WriterOptions,
        purpose: Purpose,
    ) -> Result<Self, Error> {
        let mut writer = Self::prepare(connection, name, schema, options, purpose)?;
        writer.0.commit(&writer.1)?;
        writer.0.keep(writer.1);
        Ok(writer.0)
    }

    /// Leaves one value and lets go: readers never see the item without it.
    pub(crate) fn put(
        connection: &Arc<Connection>,
        name: &str,
        schema: &Schema,
        options: WriterOptions,
        payload: &[u8],
    ) -> Result<(), Error> {
        let (mut writer, fds) = Self::prepare(connection, name, schema, options, Purpose::Put)?;
        writer.write(payload)?;
        writer.commit(&fds)
    }

    /// Takes the lease and makes a segment that begins with the item's last value.
    fn prepare(
        connection: &Arc<Connection>,
        name: &str,
        schema: &Schema,
        options: WriterOptions,
        purpose: Purpose,
    ) -> Result<(Self, crate::segment::SegmentFds), Error> {
        let handle = connection.new_handle();
        let request = Request::OpenWriter {
            handle,
            name: name.to_owned(),
            schema: schema.text().to_owned(),
            purpose,
        };
        let life = connection.life();
        let asked = connection.request(request, &[]);
        if let Err(Error::Timeout(_)) = &asked {
            // The daemon may yet grant it: nobody would ever give it back.
            connection.close(handle);
        }
        let (name, epoch, last) = match asked? {
            (Reply::Writer { name, epoch }, fds) => (name, epoch, segment_fds(fds)),
            (other, _) => return Err(unexpected(&other)),
        };
        let lease = Lease {
            connection: Arc::clone(connection),
            handle,
            name,
        };
        crash::point("register.granted");
        let spec = Spec {
            capacity_bytes: options
                .capacity_bytes
                .or(schema.size_bytes())
                .unwrap_or(DEFAULT_CAPACITY_BYTES),
            depth: options.depth,
            cells: options.max_readers,
            pool: options.pins,
        };
        let (mut segment, fds) = SegmentWriter::create(spec, epoch).map_err(segment_error)?;
        crash::point("register.made");
        if let (Some(last), Purpose::Write) = (last, purpose) {
            seed(&mut segment, &last)?;
        }
        crash::point("register.seeded");
        let writer = Self {
            segment,
            schema: schema.clone(),
            seq: Seq(0),
            life,
            mailbox: Arc::default(),
            begun: None,
            lease,
        };
        Ok((writer, fds))
    }

    /// Hands the segment over, after which readers see it.
    fn commit(&mut self, fds: &crate::segment::SegmentFds) -> Result<(), Error> {
        let Lease {
            connection, handle, ..
        } = &self.lease;
        let request = Request::Commit { handle: *handle };
        let beside = [fds.data.as_fd(), fds.ctl.as_fd()];
        match connection.request(request, &beside)? {
            (Reply::Done, _) => {}
            (other, _) => return Err(unexpected(&other)),
        }
        crash::point("register.committed");
        self.segment.set_bells(Some(connection.bell().0));
        Ok(())
    }

    /// Keeps what a daemon that is started anew must be told.
    fn keep(&self, fds: crate::segment::SegmentFds) {
        let registration = Registration::Writer {
            name: self.lease.name.to_string(),
            schema: self.schema.text().to_owned(),
            fds,
            mailbox: Arc::clone(&self.mailbox),
        };
        self.lease
            .connection
            .register(self.lease.handle, registration);
        crash::point("register.kept");
    }

    /// Publishes a payload as captured now. Never blocks, and makes no system call while no reader waits.
    pub fn write(&mut self, payload: &[u8]) -> Result<Seq, Error> {
        let mut loan = self.loan(payload.len())?;
        loan.as_mut_slice().copy_from_slice(payload);
        loan.publish()
    }

    /// Publishes a payload that was made elsewhere.
    pub fn write_with(&mut self, payload: &[u8], origin: &Origin) -> Result<Seq, Error> {
        let mut loan = self.loan(payload.len())?;
        loan.as_mut_slice().copy_from_slice(payload);
        Ok(loan.publish_with(origin))
    }

    /// Begins a sample of `len` bytes that is filled piece by piece, with [`RawWriter::fill`]; it shows when it is published by
    /// [`RawWriter::finish`]. One that was begun before is given up. Fails as [`RawWriter::loan`] does.
    pub fn begin(&mut self, len: usize) -> Result<(), Error> {
        if let Some(given_up) = self.begun.take() {
            self.segment.discard(given_up);
        }
        self.take_news()?;
        self.begun = Some(self.segment.loan(len).map_err(loan_error)?);
        Ok(())
    }

    /// Fills a piece of the sample that was begun, from byte `at` on. What lies beyond its end is left out.
    pub fn fill(&mut self, at: usize, piece: &[u8]) {
        if let Some(slot) = &mut self.begun
            && let Some(room) = self.segment.slot_bytes_mut(slot).get_mut(at..)
        {
            let len = piece.len().min(room.len());
            room[..len].copy_from_slice(&piece[..len]);
        }
    }

    /// Publishes the sample that was begun, if one was.
    pub fn finish(&mut self, origin: &Origin) {
        if let Some(slot) = self.begun.take() {
            self.segment.publish(slot, origin);
        }
    }

    /// Memory for a payload of `len` bytes, with unspecified content. Never blocks. Fails when `len` is more than the
    /// item's capacity, and when a daemon that was started anew has given the item to another writer.
    #[inline(always)]
    pub fn loan(&mut self, len: usize) -> Result<RawLoan<'_>, Error> {
        self.take_news()?;
        let slot = self.segment.loan(len).map_err(loan_error)?;
        crash::point("publish.loaned");
        Ok(RawLoan {
            writer: self,
            slot: Some(slot),
        })
    }

    /// The item's name.
    pub fn name(&self) -> &ItemName {
        &self.lease.name
    }

    /// The item's schema.
    pub fn schema(&self) -> &Schema {
        &self.schema
    }

    /// Largest payload, bytes.
    pub fn capacity_bytes(&self) -> u32 {
        self.segment.spec().capacity_bytes
    }

    /// Samples that were overwritten while a reader held them beyond its pins.
    pub fn forced(&self) -> u64 {
        self.segment.forced()
    }

    /// Readers on this host; one of them may stand for all of other hosts.
    pub fn readers(&self) -> u32 {
        self.segment.readers()
    }

    /// Whether each reader has taken the newest sample, by its own word.
    pub fn is_consumed(&self) -> bool {
        self.segment.is_consumed()
    }

    #[inline]
    fn take_news(&mut self) -> Result<(), Error> {
        self.lease.connection.follow()?;
        if self.lease.connection.life() != self.life || self.mailbox.has_mail() {
            self.take_mail()?;
        }
        Ok(())
    }

    #[cold]
    fn take_mail(&mut self) -> Result<(), Error> {
        let connection = &self.lease.connection;
        let life = connection.life();
        if life != self.life {
            self.segment.set_bells(Some(connection.bell().0));
            self.life = life;
        }
        match self.mailbox.take() {
            Some(Mail::Refused(refusal)) => {
                // Said again at each call: the lease does not come back.
                self.mailbox.put(Mail::Refused(refusal.clone()));
                Err(refusal.into())
            }
            Some(Mail::Bound(..) | Mail::Removed | Mail::Detached) | None => Ok(()),
        }
    }

    #[inline]
    fn next_origin(&mut self, capture: Time, publish: Time) -> Origin {
        self.seq = Seq(self.seq.0 + 1);
        Origin {
            epoch: self.segment.epoch(),
            seq: self.seq,
            filtered: 0,
            overwritten: 0,
            capture,
            publish,
            receive: None,
            bound_ns: None,
        }
    }
}

impl<T: Plain> Loan<'_, T> {
    /// Publishes the sample as captured now.
    pub fn publish(self) -> Result<Seq, Error> {
        self.raw.publish()
    }
}

impl<T: Plain> Deref for Loan<'_, T> {
    type Target = T;

    fn deref(&self) -> &T {
        plain::view(self.raw.as_slice()).expect("a loan has its type's size and a line's alignment")
    }
}

impl<T: Plain> DerefMut for Loan<'_, T> {
    fn deref_mut(&mut self) -> &mut T {
        plain::view_mut(self.raw.as_mut_slice())
            .expect("a loan has its type's size and a line's alignment")
    }
}

impl RawLoan<'_> {
    /// The memory.
    pub fn as_slice(&self) -> &[u8] {
        match &self.slot {
            Some(slot) => self.writer.segment.slot_bytes(slot),
            None => &[],
        }
    }

    /// The memory, to be filled.
    #[inline]
    pub fn as_mut_slice(&mut self) -> &mut [u8] {
        match &mut self.slot {
            Some(slot) => self.writer.segment.slot_bytes_mut(slot),
            None => &mut [],
        }
    }

    /// Publishes the sample as captured now.
    #[inline(always)]
    pub fn publish(self) -> Result<Seq, Error> {
        // Read once: the clock is half of what a write of a few bytes costs.
        let now = clock::now();
        self.publish_between(now, now)
    }

    /// Publishes the sample, whose content was true at `capture`.
    pub fn publish_at(self, capture: Time) -> Result<Seq, Error> {
        self.publish_between(capture, clock::now())
    }

    #[inline(always)]
    fn publish_between(self, capture: Time, publish: Time) -> Result<Seq, Error> {
        self.writer.lease.connection.check_fork()?;
        let origin = self.writer.next_origin(capture, publish);
        Ok(self.publish_with(&origin))
    }

    /// Publishes a sample that was made elsewhere.
    #[inline(always)]
    pub fn publish_with(mut self, origin: &Origin) -> Seq {
        crash::point("publish.filled");
        if let Some(slot) = self.slot.take() {
            self.writer.segment.publish(slot, origin);
        }
        crash::point("publish.done");
        origin.seq
    }
}

impl Drop for RawLoan<'_> {
    fn drop(&mut self) {
        if let Some(slot) = self.slot.take() {
            self.writer.segment.discard(slot);
        }
    }
}

impl Drop for Lease {
    fn drop(&mut self) {
        self.connection.close(self.handle);
    }
}

/// Copies the item's last value into a new segment, with its old origin.
fn seed(segment: &mut SegmentWriter, last: &crate::segment::SegmentFds) -> Result<(), Error> {
    let control = SegmentControl::map(&last.data, &last.ctl).map_err(segment_error)?;
    let mut payload = Vec::new();
    let Some(stamp) = control.copy_newest(&mut payload) else {
        return Ok(());
    };
    // A value that is too long for the new capacity stays behind.
    let Ok(mut slot) = segment.loan(payload.len()) else {
        return Ok(());
    };
    segment.slot_bytes_mut(&mut slot).copy_from_slice(&payload);
    segment.publish(slot, &stamp.origin);
    Ok(())
}

fn encoded<'a, T: Item>(value: &T, payload: &'a mut Vec<u8>) -> Result<&'a [u8], Error> {
    payload.clear();
    value.encode(payload)?;
    Ok(payload)
}

#[cold]
fn loan_error(error: LoanError) -> Error {
    match error {
        LoanError::TooLong { len, capacity } => Error::TooLong { len, capacity },
        LoanError::Forked => Error::Forked,
        LoanError::NoSlot => Error::Segment(error.to_string()),
    }
}

#[expect(clippy::needless_pass_by_value, reason = "for map_err")]
pub(crate) fn segment_error(error: SegmentError) -> Error {
    Error::Segment(error.to_string())
}

/// Largest payload of an item whose schema fixes none and whose writer says none: what one network sample may have.
const DEFAULT_CAPACITY_BYTES: u32 = 64 * 1024;
