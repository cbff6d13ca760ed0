//! The receiving half of a simulated host: drives a [`Receiver`] as the daemon's thread does, and judges each sample.

use std::borrow::Cow;
use std::collections::BTreeMap;

use ddx_catalog::delivery::{Books, Held, Passed, Received, Receiver, ReceiverConfig};
use ddx_wire::seal::KeyId;
use ddx_wire::{ClockOffset, Contract, Epoch, ItemName, Seq, StreamId, Tag, Time};

use super::HostClock;
use super::store::Payload;

/// Number of a mirror.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct MirrorId(pub(super) u64);

pub(super) struct Rx {
    pub(super) receiver: Receiver,
    pub(super) mirrors: BTreeMap<MirrorId, Mirror>,
    streams: BTreeMap<(Tag, StreamId), Stream>,
    clocks: BTreeMap<Tag, (ClockOffset, Time)>,
    /// The newest that was ever shown of an item of each host, while a reader stays.
    shown: BTreeMap<(ItemName, u64), (Epoch, Seq)>,
    clock: HostClock,
    /// Promises that were broken.
    pub(super) broken: Vec<String>,
    /// Samples shown to readers.
    pub(super) shown_samples: u64,
    /// Of these, samples whose age was known.
    pub(super) known_ages: u64,
}

pub(super) struct Mirror {
    pub(super) name: ItemName,
    pub(super) newest: (Epoch, Seq),
    /// Who sent that.
    from: Option<Tag>,
    /// Samples of the epoch that the source did not send, as the mirror's stamps say.
    passed: Passed,
    pub(super) told: Told,
    /// The books of its streams that are over.
    former: Books,
}

/// What a reader of a mirror is told that reads each sample at once. `expected` is the sum of those from `delivered` to
/// `lost`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Told {
    /// Samples from the first to the newest, by their numbers, over all epochs.
    pub expected: u64,
    /// Shown.
    pub delivered: u64,
    /// Overwritten at their source.
    pub overwritten: u64,
    /// Left out by their source.
    pub filtered: u64,
    /// Lost on the way.
    pub lost: u64,
    /// Further copies that were not shown.
    pub stale: u64,
    /// Lives of hosts from which it came.
    pub lives: u32,
    /// The first one.
    pub first: (Epoch, Seq),
}

/// A second, plainer account of what came by a stream.
struct Stream {
    mirror: MirrorId,
    newest: Option<(Epoch, Seq)>,
    expected: u64,
    delivered: u64,
}

impl Rx {
    pub(super) fn new(own: Tag, key: KeyId, clock: HostClock) -> Self {
        Self {
            receiver: Receiver::new(ReceiverConfig::new(own, key)),
            mirrors: BTreeMap::new(),
            streams: BTreeMap::new(),
            clocks: BTreeMap::new(),
            shown: BTreeMap::new(),
            clock,
            broken: Vec::new(),
            shown_samples: 0,
            known_ages: 0,
        }
    }

    pub(super) fn expect(
        &mut self,
        (tag, stream): (Tag, StreamId),
        contract: &Contract,
        mirror: MirrorId,
        now: Time,
    ) {
        let held = self.mirrors.get(&mirror);
        let held = held.and_then(Mirror::held);
        let after = self.receiver.resume(tag, stream, contract, held, now);
        let fresh = Stream {
            mirror,
            newest: after,
            expected: 0,
            delivered: 0,
        };
        self.streams.entry((tag, stream)).or_insert(fresh).mirror = mirror;
        self.take_arrived(now);
    }

    pub(super) fn forget(&mut self, tag: Tag, stream: StreamId) {
        self.check_books(tag, stream);
        let books = self.receiver.books(tag, stream);
        let over = self.streams.remove(&(tag, stream));
        let mirror = over.and_then(|over| self.mirrors.get_mut(&over.mirror));
        if let (Some(mirror), Some(books)) = (mirror, books) {
            mirror.former = sum(mirror.former, books);
        }
        self.receiver.forget(tag, stream);
    }

    pub(super) fn set_clock(&mut self, tag: Tag, offset: ClockOffset, now: Time) {
        self.clocks.insert(tag, (offset, now));
    }

    pub(super) fn drop_session(&mut self, tag: Tag) {
        self.receiver.drop_session(tag);
        self.clocks.remove(&tag);
        self.streams.retain(|(sender, _), _| *sender != tag);
    }

    pub(super) fn drop_mirror(&mut self, mirror: MirrorId) {
        self.mirrors.remove(&mirror);
        self.streams.retain(|_, stream| stream.mirror != mirror);
    }

    /// The last reader of an item closed: a later one may begin anywhere.
    pub(super) fn reader_closed(&mut self, name: &ItemName) {
        self.shown.retain(|(shown, _), _| shown != name);
    }

    pub(super) fn handle_datagram(&mut self, datagram: &mut [u8], by_group: bool, now: Time) {
        self.receiver.handle_datagram(datagram, by_group, now);
        self.take_arrived(now);
    }

    pub(super) fn handle_timeout(&mut self, now: Time) {
        self.receiver.handle_timeout(now);
        self.take_arrived(now);
    }

    fn take_arrived(&mut self, now: Time) {
        let mut arrived = Vec::new();
        while let Some(sample) = self.receiver.poll_sample() {
            let payload = Cow::Owned(sample.payload.into_owned());
            arrived.push(Received { payload, ..sample });
        }
        for sample in &arrived {
            self.take(sample, now);
        }
        for sample in &arrived {
            self.check_books(sample.tag, sample.stream);
        }
    }

    /// The books of a stream, when it is expected.
    pub(super) fn books(&self) -> impl Iterator<Item = Books> {
        self.streams
            .keys()
            .filter_map(|(tag, stream)| self.receiver.books(*tag, *stream))
    }

    /// What the streams of a mirror have counted, former and present.
    pub(super) fn books_of(&self, mirror: MirrorId) -> Option<Books> {
        let streams = self
            .streams
            .iter()
            .filter(|(_, stream)| stream.mirror == mirror);
        let books = streams.filter_map(|((tag, id), _)| self.receiver.books(*tag, *id));
        Some(books.fold(self.mirrors.get(&mirror)?.former, sum))
    }

    fn take(&mut self, sample: &Received<'_>, now: Time) {
        let Some(stream) = self.streams.get_mut(&(sample.tag, sample.stream)) else {
            return;
        };
        if !stream.account(sample) {
            let text = format!("stream {:?} went back to {:?}", sample.stream, sample.meta);
            self.broken.push(text);
        }
        let Some(mirror) = self.mirrors.get_mut(&stream.mirror) else {
            return;
        };
        let newest = (sample.meta.epoch, sample.meta.seq);
        let Some(told) = Payload::read(&mirror.name, &sample.payload) else {
            self.broken.push(format!("`{}` is torn", mirror.name));
            return;
        };
        if (told.epoch, told.seq) != newest {
            let text = format!("`{}` claims {newest:?}, is {told:?}", mirror.name);
            self.broken.push(text);
        }
        if newest <= mirror.newest {
            mirror.told.stale += 1;
            return;
        }
        if !mirror.show(sample) {
            let text = format!(
                "`{}` is told of more than lies before it: {sample:?}",
                mirror.name
            );
            self.broken.push(text);
        }
        self.shown_samples += 1;
        let before = self.shown.insert((mirror.name.clone(), told.owner), newest);
        if before > Some(newest) {
            let text = format!("`{}` went back from {before:?} to {newest:?}", mirror.name);
            self.broken.push(text);
        }
        if let Some((clock, since)) = self.clocks.get(&sample.tag) {
            let clock = clock.aged(now.since(*since));
            self.known_ages += 1;
            let published = clock.to_local(sample.meta.publish).min(now);
            let truth = self.clock.at(told.truth);
            let error = published.0.abs_diff(truth.0);
            if error > clock.bound_ns {
                let text = format!(
                    "age of `{}` is off by {error} ns, bound {} ns",
                    mirror.name, clock.bound_ns
                );
                self.broken.push(text);
            }
        }
    }

    fn check_books(&mut self, tag: Tag, id: StreamId) {
        let (Some(stream), Some(books)) =
            (self.streams.get(&(tag, id)), self.receiver.books(tag, id))
        else {
            return;
        };
        let delivered = books.delivered == stream.delivered;
        if !books.balanced() || !delivered || books.expected != stream.expected {
            self.broken.push(format!(
                "books of {id:?}: {books:?}, of {} delivered and {} expected",
                stream.delivered, stream.expected
            ));
        }
    }
}

impl Mirror {
    pub(super) fn new(name: ItemName) -> Self {
        Self {
            name,
            newest: Default::default(),
            from: None,
            passed: Passed::default(),
            told: Told::default(),
            former: Books::default(),
        }
    }

    /// What another stream of the item goes on from.
    fn held(&self) -> Option<Held> {
        let newest = self.newest;
        self.from.map(|from| Held { from, newest })
    }

    /// Writes a sample, as the daemon does, and reads it, as the store does. `false` when the source claims more than there
    /// is.
    fn show(&mut self, sample: &Received<'_>) -> bool {
        let (meta, more) = (&sample.meta, sample.passed);
        let before = match self.newest {
            (Epoch(0), _) => None,
            newest => Some(newest),
        };
        let is_same = before.is_some_and(|(epoch, _)| epoch == meta.epoch);
        let told = &mut self.told;
        told.lives += u32::from(self.from != Some(sample.tag));
        told.delivered += 1;
        self.from = Some(sample.tag);
        self.newest = (meta.epoch, meta.seq);
        let Some((_, Seq(last))) = before else {
            // Nobody here asked for what was before.
            (told.first, told.expected) = (self.newest, 1);
            self.passed = Passed {
                filtered: meta.seq.0.saturating_sub(1),
                overwritten: 0,
            };
            return true;
        };
        let (last, passed) = match is_same {
            true => (last, self.passed),
            false => (0, Passed::default()),
        };
        self.passed = Passed {
            filtered: passed.filtered + more.filtered,
            overwritten: passed.overwritten + more.overwritten,
        };
        let gap = meta.seq.0 - last - 1;
        told.expected += gap + 1;
        told.filtered += more.filtered;
        told.overwritten += more.overwritten;
        let lost = gap.checked_sub(more.filtered + more.overwritten);
        told.lost += lost.unwrap_or_default();
        lost.is_some()
    }
}

fn sum(a: Books, b: Books) -> Books {
    Books {
        expected: a.expected + b.expected,
        delivered: a.delivered + b.delivered,
        late: a.late + b.late,
        link_lost: a.link_lost + b.link_lost,
        expired: a.expired + b.expired,
        over_budget: a.over_budget + b.over_budget,
        undecodable: a.undecodable + b.undecodable,
        filtered: a.filtered + b.filtered,
        overwritten: a.overwritten + b.overwritten,
        duplicates: a.duplicates + b.duplicates,
        old_epoch: a.old_epoch + b.old_epoch,
    }
}

impl Stream {
    /// Takes in what the receiver handed out. `false` unless it is newer than all before.
    fn account(&mut self, sample: &Received<'_>) -> bool {
        let (epoch, Seq(seq)) = (sample.meta.epoch, sample.meta.seq);
        let newer = Some((epoch, Seq(seq))) > self.newest;
        self.expected += match self.newest {
            None => 1,
            Some((last, Seq(from))) if last == epoch => seq.saturating_sub(from),
            Some(_) => seq,
        };
        self.newest = Some((epoch, Seq(seq)));
        self.delivered += 1;
        newer
    }
}
