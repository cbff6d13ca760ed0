//! iceoryx2 in the same measurements as ddx: the two share the code that measures.
//!
//! `write COUNT` and `read COUNT` print the processor time of one, nanoseconds; `wake`, `poll` and `large` with `COUNT CORES`
//! print the latencies of a conversation, nanoseconds, one a line. `frames-out NAME BYTES RATE COUNT` publishes frames, and `frames-in NAME
//! BYTES COUNT` looks at them; both print the processor time of one.

use std::sync::Barrier;

use anyhow::{Context, Result, bail};
use iceoryx2::port::listener::Listener;
use iceoryx2::port::notifier::Notifier;
use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::reader::EntryHandle;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::port::writer::EntryHandleMut;
use iceoryx2::prelude::*;

use crate::pair::{Cores, Send64, Side, Take64, cpu_ns_each, ping_pong};

#[path = "../../src/frames.rs"]
mod frames;
#[path = "../../src/pair.rs"]
mod pair;

const WORDS: usize = 8;
const LARGE_WORDS: usize = 6 * 1024 * 1024 / 8;
/// The only entry of a blackboard.
const KEY: u64 = 0;

fn main() -> Result<()> {
    set_log_level(LogLevel::Error);
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let words: Vec<&str> = arguments.iter().map(String::as_str).collect();
    match words.as_slice() {
        ["write", count] => println!("{}", write(count.parse()?)?),
        ["read", count] => println!("{}", read(count.parse()?)?),
        ["wake", count, on] => print(published::<WORDS>(count.parse()?, cores(on))?),
        ["large", count, on] => print(published::<LARGE_WORDS>(count.parse()?, cores(on))?),
        ["poll", count, on] => print(polled(count.parse()?, cores(on))?),
        ["frames-out", name, bytes, rate, count] => {
            feed(name, bytes.parse()?, rate.parse()?, count.parse()?)?;
        }
        ["frames-in", name, bytes, count] => view(name, bytes.parse()?, count.parse()?)?,
        _ => bail!(
            "usage: ddx-bench-peers write|read COUNT | wake|large|poll COUNT CORES | frames-out NAME BYTES RATE COUNT | \
             frames-in NAME BYTES COUNT"
        ),
    }
    Ok(())
}

fn cores(on: &str) -> Cores {
    if on == "1" { Cores::One } else { Cores::Two }
}

fn print(latencies: Vec<u64>) {
    for latency in latencies {
        println!("{latency}");
    }
}

/// A blackboard with one value, which lives as long as its factory.
struct Board {
    factory: iceoryx2::service::port_factory::blackboard::PortFactory<ipc::Service, u64>,
}

impl Board {
    fn create(name: &str) -> Result<Self> {
        let node = NodeBuilder::new().create::<ipc::Service>()?;
        let factory = node
            .service_builder(&service_name(name)?)
            .blackboard_creator::<u64>()
            .add::<[u64; WORDS]>(KEY, [0; WORDS])
            .create()?;
        Ok(Self { factory })
    }

    fn open(name: &str) -> Result<Self> {
        let node = NodeBuilder::new().create::<ipc::Service>()?;
        let factory = node
            .service_builder(&service_name(name)?)
            .blackboard_opener::<u64>()
            .open()?;
        Ok(Self { factory })
    }

    fn writer(&self) -> Result<BoardWriter> {
        Ok(BoardWriter(
            self.factory.writer_builder().create()?.entry(&KEY)?,
        ))
    }

    fn reader(&self) -> Result<BoardReader> {
        let entry: EntryHandle<ipc::Service, u64, [u64; WORDS]> =
            self.factory.reader_builder().create()?.entry(&KEY)?;
        Ok(BoardReader { entry, seen: 0 })
    }
}

struct BoardWriter(EntryHandleMut<ipc::Service, u64, [u64; WORDS]>);

struct BoardReader {
    entry: EntryHandle<ipc::Service, u64, [u64; WORDS]>,
    seen: u64,
}

impl Send64 for BoardWriter {
    fn send(&mut self, stamp: u64) -> Result<()> {
        self.0.update_with_copy([stamp; WORDS]);
        Ok(())
    }
}

impl Take64 for BoardReader {
    fn take(&mut self) -> Result<u64> {
        loop {
            let stamp = self.entry.get()[0];
            if stamp != self.seen {
                self.seen = stamp;
                return Ok(stamp);
            }
            std::hint::spin_loop();
        }
    }
}

fn write(count: u32) -> Result<f64> {
    let board = Board::create("write")?;
    let mut writer = board.writer()?;
    cpu_ns_each(count, |turn| writer.send(turn))
}

fn read(count: u32) -> Result<f64> {
    let board = Board::create("read")?;
    let mut writer = board.writer()?;
    writer.send(1)?;
    let reader = board.reader()?;
    cpu_ns_each(count, |_| {
        std::hint::black_box(*reader.entry.get());
        Ok(())
    })
}

fn polled(count: usize, cores: Cores) -> Result<Vec<u64>> {
    let made = Barrier::new(2);
    let side = |own: &'static str, other: &'static str| {
        let made = &made;
        move || {
            let board = Board::create(own)?;
            let to = board.writer()?;
            made.wait();
            let from = Board::open(other)?.reader()?;
            // Nobody speaks before both listen.
            made.wait();
            Ok(Side { to, from })
        }
    };
    ping_pong(count, cores, side("there", "back"), side("back", "there"))
}

/// Publishes a value and notifies who sleeps.
struct Voice<const N: usize> {
    publisher: Publisher<ipc::Service, [u64; N], ()>,
    notifier: Notifier<ipc::Service>,
}

/// Sleeps until notified and takes a value.
struct Ear<const N: usize> {
    subscriber: Subscriber<ipc::Service, [u64; N], ()>,
    listener: Listener<ipc::Service>,
}

impl<const N: usize> Voice<N> {
    fn open(name: &str) -> Result<Self> {
        let node = NodeBuilder::new().create::<ipc::Service>()?;
        let name = service_name(name)?;
        let service = node
            .service_builder(&name)
            .publish_subscribe::<[u64; N]>()
            .open_or_create()?;
        let event = node.service_builder(&name).event().open_or_create()?;
        let publisher = service.publisher_builder().create()?;
        Ok(Self {
            publisher,
            notifier: event.notifier_builder().create()?,
        })
    }
}

impl<const N: usize> Ear<N> {
    fn open(name: &str) -> Result<Self> {
        let node = NodeBuilder::new().create::<ipc::Service>()?;
        let name = service_name(name)?;
        let service = node
            .service_builder(&name)
            .publish_subscribe::<[u64; N]>()
            .open_or_create()?;
        let event = node.service_builder(&name).event().open_or_create()?;
        let subscriber = service.subscriber_builder().create()?;
        Ok(Self {
            subscriber,
            listener: event.listener_builder().create()?,
        })
    }
}

impl<const N: usize> Send64 for Voice<N> {
    fn send(&mut self, stamp: u64) -> Result<()> {
        let mut sample = self.publisher.loan_uninit()?;
        let first = sample.payload_mut().as_mut_ptr().cast::<u64>();
        // SAFETY: the payload begins with a word, and nobody else has it while it is on loan.
        unsafe { first.write(stamp) };
        // SAFETY: shared memory begins as zeros, and words are valid under every bit pattern.
        let sample = unsafe { sample.assume_init() };
        sample.send()?;
        self.notifier.notify()?;
        Ok(())
    }
}

impl<const N: usize> Take64 for Ear<N> {
    fn take(&mut self) -> Result<u64> {
        loop {
            if let Some(sample) = self.subscriber.receive()? {
                return Ok(sample.payload()[0]);
            }
            self.listener.blocking_wait(|_| {})?;
        }
    }
}

fn published<const N: usize>(count: usize, cores: Cores) -> Result<Vec<u64>> {
    let made = Barrier::new(2);
    let side = |own: &'static str, other: &'static str| {
        let made = &made;
        move || {
            let side = Side {
                to: Voice::<N>::open(own)?,
                from: Ear::<N>::open(other)?,
            };
            made.wait();
            Ok(side)
        }
    };
    ping_pong(count, cores, side("there", "back"), side("back", "there"))
}

/// Who may listen to a stream of frames.
const VIEWERS: usize = 16;

fn feed(name: &str, bytes: usize, rate: u32, count: u32) -> Result<()> {
    let node = NodeBuilder::new().create::<ipc::Service>()?;
    let name: ServiceName = name.try_into().ok().context("naming a service")?;
    let service = node
        .service_builder(&name)
        .publish_subscribe::<[u8]>()
        .max_subscribers(VIEWERS)
        .open_or_create()?;
    let event = node
        .service_builder(&name)
        .event()
        .max_listeners(VIEWERS)
        .open_or_create()?;
    let publisher = service
        .publisher_builder()
        .initial_max_slice_len(bytes)
        .create()?;
    let notifier = event.notifier_builder().create()?;
    let frame = vec![128; bytes];
    frames::feed(rate, count, || {
        let loan = publisher.loan_slice_uninit(bytes)?;
        loan.write_from_slice(&frame).send()?;
        notifier.notify()?;
        Ok(())
    })
}

fn view(name: &str, bytes: usize, count: u32) -> Result<()> {
    let node = NodeBuilder::new().create::<ipc::Service>()?;
    let name: ServiceName = name.try_into().ok().context("naming a service")?;
    let service = node
        .service_builder(&name)
        .publish_subscribe::<[u8]>()
        .max_subscribers(VIEWERS)
        .open_or_create()?;
    let event = node
        .service_builder(&name)
        .event()
        .max_listeners(VIEWERS)
        .open_or_create()?;
    let subscriber = service.subscriber_builder().create()?;
    let listener = event.listener_builder().create()?;
    frames::view(count, || {
        loop {
            if let Some(sample) = subscriber.receive()? {
                if sample.payload().len() != bytes {
                    bail!("a frame of another size");
                }
                return Ok(());
            }
            listener.blocking_wait(|_| {})?;
        }
    })
}

/// Names of this process only: what another run has left behind does not matter.
fn service_name(name: &str) -> Result<ServiceName> {
    let name = format!("ddx-bench/{}/{name}", std::process::id());
    name.as_str().try_into().ok().context("naming a service")
}
