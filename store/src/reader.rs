//! Readers of an item: typed and by schema, copies and pinned guards.

use std::marker::PhantomData;
use std::ops::Deref;
use std::sync::Arc;
use std::time::Duration;

use ddx_wire::{Contract, Delivery, Epoch, ItemName, Priority, Seq, Time};

use crate::clock;
use crate::connection::{Connection, Mail, Mailbox, segment_fds};
use crate::control::{Binding, Refusal, Reply, Request};
use crate::crash;
use crate::error::Error;
use crate::item::{Item, Plain, plain};
use crate::notify::Bell;
use crate::recovery::Registration;
use crate::sample::{After, Cursor, Meta, Missed, Sample};
use crate::schema::Schema;
use crate::segment::{Copier, Pin, PinError, ReaderBooks, Seat, SegmentFds, SegmentReader, Stamp};
use crate::store::unexpected;
use crate::wait::{Condition, Patience, Readiness, Wait, sleep};
use crate::writer::segment_error;

/// Where a reader begins.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum From {
    /// With the newest sample that is there when it opens.
    #[default]
    Now,
    /// With the oldest sample that is still in the ring.
    Ring,
}

/// How an item is read.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ReaderOptions {
    /// Samples to hold in place at one time, beyond the two that every reader may.
    pub pins: u32,
    /// Greatest rate, hertz: `next` then gives the newest sample at each turn, and what it passes over counts as
    /// filtered. From another host no more than this is sent.
    pub rate: Option<f64>,
    /// Greatest age, since capture, at which a sample of another host is still sent; whole milliseconds.
    pub max_age: Option<Duration>,
    /// Whether samples of another host that are lost on the way are sent again. On one host each sample is in the ring.
    pub delivery: Delivery,
    /// Which items come first where a link between hosts cannot carry all.
    pub priority: Priority,
    /// Where `next` begins.
    pub from: From,
}

/// Reads the samples of an item of type `T`.
#[derive(Debug)]
pub struct Reader<T> {
    raw: RawReader,
    payload: Vec<u8>,
    item: PhantomData<fn() -> T>,
}

/// Reads the samples of an item as bytes.
#[derive(Debug)]
pub struct RawReader {
    bound: Option<Bound>,
    /// A daemon that was started anew does not know what is mapped: ask at each call whether it does by now.
    detached: bool,
    refused: Option<Refusal>,
    seen: Cursor,
    missed: Missed,
    /// What `next` read, in all; shown to the daemon in each seat.
    books: ReaderBooks,
    from: From,
    interval: Duration,
    due: Time,
    mailbox: Arc<Mailbox>,
    seat: Arc<Registered>,
}

/// A sample held in place; the writer leaves it alone until this is dropped.
#[derive(Debug)]
pub struct Guard<T> {
    raw: RawGuard,
    item: PhantomData<fn() -> T>,
}

/// A sample's bytes held in place; the writer leaves them alone until this is dropped.
#[derive(Debug)]
pub struct RawGuard {
    pin: Pin,
    meta: Meta,
    // Dropped after the pin: the daemon gives the cell to somebody else when the last of these is gone.
    _seat: Arc<Registered>,
}

/// A sample taken in the cheaper way: a few bytes copied, more of them held in place.
#[derive(Debug)]
pub enum Taken {
    /// Its bytes are in the payload that was passed.
    Copied(Meta),
    /// Its bytes are in the guard.
    Held(RawGuard),
}

/// A reader's place in the present segment.
#[derive(Debug)]
struct Bound {
    segment: SegmentReader,
    schema: Schema,
    cell: u32,
    /// Position up to which the ring held nothing more to read.
    passed: u64,
    bit: u16,
}

/// The daemon's knowledge of this reader, taken back on drop.
#[derive(Debug)]
struct Registered {
    connection: Arc<Connection>,
    handle: u32,
    name: ItemName,
}

impl ReaderOptions {
    /// What these options ask of the source.
    fn contract(&self) -> Result<Contract, Error> {
        let limited = match self.rate {
            None => Contract::default(),
            Some(rate) if self.delivery == Delivery::Latest => Contract::at_most_hz(rate)
                .ok_or_else(|| {
                    Error::Argument(format!("rate of {rate} Hz; hint: at least 0.001 Hz"))
                })?,
            Some(rate) => {
                return Err(Error::Argument(format!(
                    "rate of {rate} Hz beside delivery of every sample; hint: leave one of them out"
                )));
            }
        };
        let max_age_ms = match self.max_age {
            None => None,
            Some(age) => match u32::try_from(age.as_millis()) {
                Ok(ms) if ms > 0 => Some(ms),
                Ok(_) | Err(_) => {
                    return Err(Error::Argument(format!(
                        "greatest age of {age:?}; hint: between 1 ms and 49 days"
                    )));
                }
            },
        };
        let delivery = match (self.delivery, self.from) {
            (Delivery::Every, From::Ring) => Delivery::EveryFromRing,
            (delivery, _) => delivery,
        };
        Ok(Contract {
            max_age_ms,
            delivery,
            priority: self.priority,
            ..limited
        })
    }
}

impl<T: Item> Reader<T> {
    pub(crate) fn new(raw: RawReader) -> Self {
        Self {
            raw,
            payload: Vec::new(),
            item: PhantomData,
        }
    }

    /// The newest sample, at once; none before the first.
    #[inline]
    pub fn current(&mut self) -> Result<Option<Sample<T>>, Error> {
        let mut copier = Copier::new(&mut self.payload);
        if !self.raw.copy_newest(&mut copier)? {
            return Ok(None);
        }
        let meta = self.raw.see(&copier.stamp());
        let value = T::decode(copier.payload())?;
        Ok(Some(Sample { value, meta }))
    }

    /// The next sample that was not seen yet and is still there. Blocks until there is one, at most `timeout`; then none.
    pub fn next(&mut self, timeout: Duration) -> Result<Option<Sample<T>>, Error> {
        let meta = self.raw.next_into(&mut self.payload, timeout)?;
        self.decode(meta)
    }

    /// The oldest sample after `cursor` that is still there, at once, and what was missed between.
    pub fn after(&mut self, cursor: &Cursor) -> Result<After<T>, Error> {
        let (meta, missed) = self.raw.after_into(cursor, &mut self.payload)?;
        let sample = self.decode(meta)?;
        Ok(After { sample, missed })
    }

    /// The item's name.
    pub fn name(&self) -> &ItemName {
        self.raw.name()
    }

    /// What `next` passed over so far.
    pub fn missed(&self) -> Missed {
        self.raw.missed()
    }

    fn decode(&self, meta: Option<Meta>) -> Result<Option<Sample<T>>, Error> {
        let Some(meta) = meta else {
            return Ok(None);
        };
        let value = T::decode(&self.payload)?;
        Ok(Some(Sample { value, meta }))
    }
}

impl<T: Plain> Reader<T> {
    /// The newest sample in place, at once; none before the first.
    pub fn current_pinned(&mut self) -> Result<Option<Guard<T>>, Error> {
        self.raw.current_pinned()?.map(Guard::new).transpose()
    }

    /// Like [`Reader::next`], in place.
    pub fn next_pinned(&mut self, timeout: Duration) -> Result<Option<Guard<T>>, Error> {
        self.raw.next_pinned(timeout)?.map(Guard::new).transpose()
    }
}

impl RawReader {
    pub(crate) fn open(
        connection: &Arc<Connection>,
        name: &str,
        schema: Option<&Schema>,
        options: ReaderOptions,
    ) -> Result<Self, Error> {
        let contract = options.contract()?;
        let handle = connection.new_handle();
        let schema = schema.map(|schema| schema.text().to_owned());
        let request = Request::OpenReader {
            handle,
            name: name.to_owned(),
            schema: schema.clone(),
            pins: options.pins,
            contract,
            held: None,
        };
        let mailbox = Arc::<Mailbox>::default();
        let asked = connection.request(request, &[]);
        if let Err(Error::Timeout(_)) = &asked {
            connection.close(handle);
        }
        let (name, binding, fds) = match asked? {
            (Reply::Reader { name, binding }, fds) => (name, binding, segment_fds(fds)),
            (other, _) => return Err(unexpected(&other)),
        };
        crash::point("register.reader");
        let mut registration = Registration::Reader {
            name: name.to_string(),
            schema,
            pins: options.pins,
            contract,
            held: None,
            mailbox: Arc::clone(&mailbox),
        };
        if let Some(binding) = &binding {
            registration.note_binding(binding);
        }
        connection.register(handle, registration);
        let seat = Registered {
            connection: Arc::clone(connection),
            handle,
            name,
        };
        let mut reader = Self {
            bound: None,
            detached: false,
            refused: None,
            seen: Cursor::default(),
            missed: Missed::default(),
            books: ReaderBooks::default(),
            from: options.from,
            interval: Duration::from_nanos(contract.interval_ns()),
            due: Time(0),
            mailbox,
            seat: Arc::new(seat),
        };
        if let Some((binding, fds)) = binding.zip(fds) {
            reader.bind(&binding, &fds)?;
        }
        crash::point("register.bound");
        Ok(reader)
    }

    /// Copies the newest sample, at once; none before the first.
    #[inline]
    pub fn read_into(&mut self, payload: &mut Vec<u8>) -> Result<Option<Meta>, Error> {
        let mut copier = Copier::new(payload);
        if self.copy_newest(&mut copier)? {
            Ok(Some(self.see(&copier.stamp())))
        } else {
            Ok(None)
        }
    }

    /// False before the first sample.
    fn copy_newest(&mut self, copier: &mut Copier<'_>) -> Result<bool, Error> {
        self.look()?;
        let Some(Bound { segment, .. }) = &self.bound else {
            return Ok(false);
        };
        match copier.copy_newest(segment) {
            Ok(()) => Ok(true),
            Err(PinError::NotYet) => Ok(false),
            Err(error) => Err(pin_error(error, segment)),
        }
    }

    /// The newest sample in place, at once; none before the first.
    pub fn current_pinned(&mut self) -> Result<Option<RawGuard>, Error> {
        self.look()?;
        let Some(Bound { segment, .. }) = &self.bound else {
            return Ok(None);
        };
        match segment.pin_newest() {
            Ok(pin) => {
                let meta = self.see(pin.stamp());
                Ok(Some(self.guard(pin, meta)))
            }
            Err(PinError::NotYet) => Ok(None),
            Err(error) => Err(pin_error(error, segment)),
        }
    }

    /// Copies the next sample that was not seen yet and is still there. Blocks until there is one, at most `timeout`; then
    /// none.
    pub fn next_into(
        &mut self,
        payload: &mut Vec<u8>,
        timeout: Duration,
    ) -> Result<Option<Meta>, Error> {
        let mut copier = Copier::new(payload);
        let read = |segment: &SegmentReader, pos| {
            copier.copy(segment, pos)?;
            Ok(copier.stamp())
        };
        let read = self.next_with(timeout, read, |stamp| *stamp)?;
        Ok(read.map(|(_, meta)| meta))
    }

    /// Like [`RawReader::next_into`], in place.
    pub fn next_pinned(&mut self, timeout: Duration) -> Result<Option<RawGuard>, Error> {
        let read = self.next_with(timeout, SegmentReader::pin, |pin: &Pin| *pin.stamp())?;
        Ok(read.map(|(pin, meta)| self.guard(pin, meta)))
    }

    /// Copies the oldest sample after `cursor` that is still there, at once, and says what was missed between.
    pub fn after_into(
        &mut self,
        cursor: &Cursor,
        payload: &mut Vec<u8>,
    ) -> Result<(Option<Meta>, Missed), Error> {
        let mut copier = Copier::new(payload);
        let read = |segment: &SegmentReader, pos| {
            copier.copy(segment, pos)?;
            Ok(copier.stamp())
        };
        Ok(match self.after_with(cursor, read, |stamp| *stamp)? {
            Some((_, meta)) => (Some(meta), cursor.missed_until(&meta)),
            None => (None, Missed::default()),
        })
    }

    /// The oldest sample after `cursor` that is still there, in place, at once.
    pub fn after_pinned(&mut self, cursor: &Cursor) -> Result<Option<RawGuard>, Error> {
        let read = self.after_with(cursor, SegmentReader::pin, |pin: &Pin| *pin.stamp())?;
        Ok(read.map(|(pin, meta)| self.guard(pin, meta)))
    }

    /// Takes the newest sample like [`RawReader::take_next`], at once; none before the first.
    pub fn take_current(&mut self, payload: &mut Vec<u8>) -> Result<Option<Taken>, Error> {
        self.look()?;
        let Some(Bound { segment, .. }) = &self.bound else {
            return Ok(None);
        };
        let mut copier = Copier::new(payload);
        match segment.newest(|pos| take(&mut copier, segment, pos)) {
            Ok(taken) => {
                let meta = self.see(taken_stamp(&taken));
                Ok(Some(self.taken(taken, meta)))
            }
            Err(PinError::NotYet) => Ok(None),
            Err(error) => Err(pin_error(error, segment)),
        }
    }

    /// Like [`RawReader::next_into`] for small samples, which it copies into `payload`, and [`RawReader::next_pinned`] for
    /// others: for who takes many and keeps few.
    pub fn take_next(
        &mut self,
        payload: &mut Vec<u8>,
        timeout: Duration,
    ) -> Result<Option<Taken>, Error> {
        let mut copier = Copier::new(payload);
        let read = |segment: &SegmentReader, pos| take(&mut copier, segment, pos);
        let read = self.next_with(timeout, read, |taken| *taken_stamp(taken))?;
        Ok(read.map(|(taken, meta)| self.taken(taken, meta)))
    }

    /// Takes the oldest sample after `cursor` that is still there like [`RawReader::take_next`], at once.
    pub fn take_after(
        &mut self,
        cursor: &Cursor,
        payload: &mut Vec<u8>,
    ) -> Result<Option<Taken>, Error> {
        let mut copier = Copier::new(payload);
        let read = |segment: &SegmentReader, pos| take(&mut copier, segment, pos);
        let read = self.after_with(cursor, read, |taken| *taken_stamp(taken))?;
        Ok(read.map(|(taken, meta)| self.taken(taken, meta)))
    }

    /// The item's name.
    pub fn name(&self) -> &ItemName {
        &self.seat.name
    }

    /// The item's schema, once the item is there.
    pub fn schema(&self) -> Option<&Schema> {
        self.bound.as_ref().map(|bound| &bound.schema)
    }

    /// How far this reader has got.
    pub fn cursor(&self) -> Cursor {
        self.seen
    }

    /// What `next` passed over so far.
    pub fn missed(&self) -> Missed {
        self.missed
    }

    /// Moves on to the newest sample of the present segment, unless it was seen before.
    #[inline]
    fn see(&mut self, stamp: &Stamp) -> Meta {
        let (segment, state) = self.bound.as_ref().map_or_else(Default::default, |bound| {
            (bound.segment.epoch(), bound.segment.state())
        });
        let meta = Meta::new(stamp, segment, state.orphaned);
        if self.seen.is_before(meta.epoch, meta.seq) || self.seen.segment != meta.segment {
            self.seen = meta.cursor();
        }
        meta
    }

    fn after_with<R>(
        &mut self,
        cursor: &Cursor,
        mut read: impl FnMut(&SegmentReader, u64) -> Result<R, PinError>,
        stamp: impl Fn(&R) -> Stamp,
    ) -> Result<Option<(R, Meta)>, Error> {
        self.look()?;
        let Some(Bound { segment, .. }) = &self.bound else {
            return Ok(None);
        };
        let head = segment.head_pos();
        let mut pos = match segment.epoch() == cursor.segment {
            true => cursor.pos.saturating_add(1),
            false => 1,
        };
        pos = pos.max(oldest(segment, head));
        while pos <= head {
            match read(segment, pos) {
                Ok(found) => {
                    let meta = meta(&stamp(&found), segment);
                    if cursor.is_before(meta.epoch, meta.seq) {
                        return Ok(Some((found, meta)));
                    }
                    pos += 1;
                }
                Err(PinError::Overwritten) => {
                    pos = (pos + 1).max(oldest(segment, segment.head_pos()));
                }
                Err(PinError::NotYet) => break,
                Err(error) => return Err(pin_error(error, segment)),
            }
        }
        Ok(None)
    }

    fn next_with<R>(
        &mut self,
        timeout: Duration,
        mut read: impl FnMut(&SegmentReader, u64) -> Result<R, PinError>,
        stamp: impl Fn(&R) -> Stamp,
    ) -> Result<Option<(R, Meta)>, Error> {
        let mut patience = Patience::new(timeout);
        for attempt in 0_u32.. {
            if self.readiness()? != Readiness::Ready {
                if timeout.is_zero() {
                    break;
                }
                let connection = self.connection();
                if !sleep(&connection, &mut Unseen(self), &mut patience)? {
                    break;
                }
            } else if attempt > ATTEMPTS && patience.left().is_zero() {
                // A segment whose words contradict one another may look ready for ever.
                break;
            }
            let from = self.first_unread();
            let Some(bound) = &mut self.bound else {
                continue;
            };
            let segment = &bound.segment;
            let head = segment.head_pos();
            let pos = match self.interval.is_zero() {
                true => from.max(oldest(segment, head)),
                false => head,
            };
            match read_or_next(segment, pos, head, &mut read) {
                Ok(read) => {
                    let meta = meta(&stamp(&read), segment);
                    if self.pass(&meta) {
                        return Ok(Some((read, meta)));
                    }
                }
                // The writer was faster, or died between two words: what was there is gone for good.
                Err(PinError::Overwritten) => bound.passed = pos,
                Err(PinError::NotYet) => bound.passed = head,
                Err(error) => return Err(pin_error(error, segment)),
            }
        }
        Ok(None)
    }

    /// Moves on to a sample that was read, and counts what lay between; false when it was seen before, as the value that a
    /// new writer found.
    fn pass(&mut self, meta: &Meta) -> bool {
        if !self.seen.is_before(meta.epoch, meta.seq) {
            self.seen.segment = meta.segment;
            self.seen.pos = meta.pos;
            return false;
        }
        if self.seen.seq == Seq(0) {
            self.books.expected = 1;
        } else {
            let mut missed = self.seen.missed_until(meta);
            if !self.interval.is_zero() {
                // What was passed over on purpose was still to be had.
                missed.filtered += std::mem::take(&mut missed.overwritten);
            }
            self.missed.add(missed);
            let before = match self.seen.epoch == meta.epoch {
                true => self.seen.seq.0,
                false => 0,
            };
            self.books.expected = self.books.expected.saturating_add(meta.seq.0 - before);
        }
        self.seen = meta.cursor();
        self.books.delivered += 1;
        self.books.pos = meta.pos;
        self.show_books();
        if !self.interval.is_zero() {
            self.due = clock::now() + self.interval;
        }
        true
    }

    #[inline]
    fn show_books(&self) {
        let Missed {
            overwritten,
            filtered,
            lost,
        } = self.missed;
        if let Some(bound) = &self.bound {
            bound.segment.set_books(&ReaderBooks {
                overwritten,
                filtered,
                lost,
                ..self.books
            });
        }
    }

    fn taken(&self, taken: Result<Stamp, Pin>, meta: Meta) -> Taken {
        match taken {
            Ok(_copied) => Taken::Copied(meta),
            Err(pin) => Taken::Held(self.guard(pin, meta)),
        }
    }

    fn guard(&self, pin: Pin, meta: Meta) -> RawGuard {
        crash::point("pin.held");
        RawGuard {
            pin,
            meta,
            _seat: Arc::clone(&self.seat),
        }
    }

    /// First position of the present segment that was neither read nor found to be gone.
    fn first_unread(&self) -> u64 {
        let Some(bound) = &self.bound else {
            return 1;
        };
        let seen = match self.seen.segment == bound.segment.epoch() {
            true => self.seen.pos,
            false => 0,
        };
        seen.max(bound.passed).saturating_add(1)
    }

    fn has_unseen(&self) -> bool {
        let head = self.bound.as_ref().map(|bound| bound.segment.head_pos());
        head.is_some_and(|head| head >= self.first_unread())
    }

    /// Learns of a new segment. Looks at the daemon's socket only when the present one says that there is news, or when
    /// there is none.
    #[inline(always)]
    fn look(&mut self) -> Result<(), Error> {
        let is_current = self.bound.as_ref().is_some_and(|bound| {
            let state = bound.segment.state();
            !state.superseded && !state.removed
        });
        if is_current && !self.detached {
            self.seat.connection.follow()?;
        } else {
            self.seat.connection.drain()?;
        }
        if self.mailbox.has_mail() || self.refused.is_some() {
            self.take_mail()?;
        }
        Ok(())
    }

    #[cold]
    fn take_mail(&mut self) -> Result<(), Error> {
        match self.mailbox.take() {
            Some(Mail::Bound(binding, fds)) => self.bind(&binding, &fds)?,
            Some(Mail::Removed) => self.bound = None,
            Some(Mail::Detached) => self.detached = self.bound.is_some(),
            Some(Mail::Refused(refusal)) => self.refused = Some(refusal),
            None => {}
        }
        match &self.refused {
            Some(refusal) => Err(refusal.clone().into()),
            None => Ok(()),
        }
    }

    fn bind(&mut self, binding: &Binding, fds: &SegmentFds) -> Result<(), Error> {
        self.detached = false;
        self.refused = None;
        let bell = Bell {
            client: self.seat.connection.bell().1,
            bit: binding.bit,
        };
        if let Some(bound) = &mut self.bound
            && bound.segment.epoch() == binding.epoch
            && bound.cell == binding.cell
        {
            // The same place as before the daemon was started anew.
            bound.segment.set_bell(bell);
            bound.bit = binding.bit;
            return Ok(());
        }
        let seat = Seat {
            cell: binding.cell,
            pins: binding.pins,
            bell,
        };
        let segment = SegmentReader::map(fds, seat).map_err(segment_error)?;
        crash::point("register.seated");
        let schema = Schema::parse(&binding.schema)?;
        let is_first = self.seen.seq == Seq(0);
        if is_first && self.from == From::Now {
            self.seen.segment = segment.epoch();
            self.seen.pos = segment.head_pos().saturating_sub(1);
        }
        self.bound = Some(Bound {
            segment,
            schema,
            cell: binding.cell,
            passed: 0,
            bit: binding.bit,
        });
        // Positions are those of the new segment from now on.
        self.books.pos = 0;
        self.show_books();
        Ok(())
    }

    /// Whether `next` would find something.
    pub(crate) fn readiness(&mut self) -> Result<Readiness, Error> {
        // What is left in a superseded ring comes first: nothing is passed over by the hand-over.
        if !self.has_unseen() {
            self.look()?;
        }
        if !self.has_unseen() {
            return Ok(Readiness::Waiting);
        }
        if self.interval.is_zero() {
            return Ok(Readiness::Ready);
        }
        match self.due.since(clock::now()) {
            Duration::ZERO => Ok(Readiness::Ready),
            left => Ok(Readiness::In(left)),
        }
    }

    /// Which bit of its client's bell is rung for this reader, and for which segment; none before the item exists.
    pub(crate) fn bell_bit(&self) -> Option<(u16, Epoch)> {
        self.bound
            .as_ref()
            .map(|bound| (bound.bit, bound.segment.epoch()))
    }

    /// The connection whose bell is rung.
    pub(crate) fn connection(&self) -> Arc<Connection> {
        Arc::clone(&self.seat.connection)
    }

    /// Shows the writer that somebody sleeps for this reader, or no longer.
    pub(crate) fn set_waiting(&self, waiting: bool) {
        if let Some(bound) = &self.bound {
            bound.segment.set_waiting(waiting);
        }
    }
}

impl<T: Plain> Guard<T> {
    fn new(raw: RawGuard) -> Result<Self, Error> {
        if plain::view::<T>(raw.bytes()).is_none() {
            return Err(Error::Segment(format!(
                "sample of {} bytes for a type of {}",
                raw.bytes().len(),
                size_of::<T>()
            )));
        }
        Ok(Self {
            raw,
            item: PhantomData,
        })
    }

    /// Where the sample comes from.
    pub fn meta(&self) -> &Meta {
        &self.raw.meta
    }

    /// Whether the value is still that of its sample; false only after somebody broke the rules of shared memory.
    pub fn is_intact(&self) -> bool {
        self.raw.is_intact()
    }
}

impl<T: Plain> Deref for Guard<T> {
    type Target = T;

    fn deref(&self) -> &T {
        plain::view(self.raw.bytes())
            .expect("the length was checked, and a guard does not outlive a fork")
    }
}

impl RawGuard {
    /// The payload. Empty after a fork.
    pub fn bytes(&self) -> &[u8] {
        self.pin.bytes()
    }

    /// Where the sample comes from.
    pub fn meta(&self) -> &Meta {
        &self.meta
    }

    /// Whether the bytes are still those of the sample; false only after somebody broke the rules of shared memory.
    pub fn is_intact(&self) -> bool {
        self.pin.is_intact()
    }
}

impl Taken {
    /// Where the sample comes from.
    pub fn meta(&self) -> &Meta {
        match self {
            Self::Copied(meta) => meta,
            Self::Held(guard) => guard.meta(),
        }
    }
}

impl Drop for Registered {
    fn drop(&mut self) {
        self.connection.close(self.handle);
    }
}

struct Unseen<'a>(&'a mut RawReader);

impl Condition for Unseen<'_> {
    fn readiness(&mut self) -> Result<Readiness, Error> {
        self.0.readiness()
    }

    fn set_waiting(&mut self, waiting: bool) {
        self.0.set_waiting(waiting);
    }
}

impl Wait for RawReader {
    fn raw(&mut self) -> &mut Self {
        self
    }
}

impl<T> Wait for Reader<T> {
    fn raw(&mut self) -> &mut RawReader {
        &mut self.raw
    }
}

/// Copies the sample at `pos` if it is small, and pins it otherwise.
fn take(
    copier: &mut Copier<'_>,
    segment: &SegmentReader,
    pos: u64,
) -> Result<Result<Stamp, Pin>, PinError> {
    match copier.copy_small(segment, pos)? {
        true => Ok(Ok(copier.stamp())),
        false => segment.pin(pos).map(Err),
    }
}

fn taken_stamp(taken: &Result<Stamp, Pin>) -> &Stamp {
    match taken {
        Ok(stamp) => stamp,
        Err(pin) => pin.stamp(),
    }
}

/// Reads `pos`. When that is the newest and has given way, its successor is in the ring already: a writer that was killed
/// there leaves it so.
fn read_or_next<R>(
    segment: &SegmentReader,
    pos: u64,
    head: u64,
    read: &mut impl FnMut(&SegmentReader, u64) -> Result<R, PinError>,
) -> Result<R, PinError> {
    match read(segment, pos) {
        Err(PinError::Overwritten) if pos == head => read(segment, head.saturating_add(1)),
        other => other,
    }
}

/// First position that may still be in the ring when `head` is the newest.
fn oldest(segment: &SegmentReader, head: u64) -> u64 {
    head.saturating_sub(segment.depth()).saturating_add(1)
}

#[inline]
fn meta(stamp: &Stamp, segment: &SegmentReader) -> Meta {
    Meta::new(stamp, segment.epoch(), segment.state().orphaned)
}

#[cold]
fn pin_error(error: PinError, segment: &SegmentReader) -> Error {
    match error {
        PinError::NoPin => Error::NoPin(segment.pins()),
        PinError::Forked => Error::Forked,
        PinError::Corrupt | PinError::Overwritten | PinError::NotYet => {
            Error::Segment(error.to_string())
        }
    }
}

/// Looks at a ring that changes under the reader, before its deadline counts.
const ATTEMPTS: u32 = 100;
