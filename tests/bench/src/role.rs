//! The parts that this program plays in other processes and in the hosts of a lab.
//!
//! A source writes a stamp at each beat until it is killed; a sink prints the age of each value that it takes, nanoseconds, one a
//! line. Between the two lies what is measured: ddx, bare UDP, or a relay that has the hops of ddx and nothing else.

use std::net::{Ipv4Addr, SocketAddrV4, UdpSocket};
use std::path::PathBuf;
use std::thread;
use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use ddx_store::{Reader, Store};
use ring::aead::{AES_256_GCM, Aad, LessSafeKey, Nonce, UnboundKey};

use crate::contender::{Copies, CopiesReader};
use crate::fallover;
use crate::floor::{FloorReader, FloorWriter, Shared, WORDS};
use crate::pair::{Send64, Take64, now_ns};
use crate::video;

/// Values that a sink takes before it counts.
const WARM_UP: usize = 100;
/// Bytes of a value.
const VALUE: usize = 8 * WORDS;
/// Bytes of the counter before a sealed value, and of the tag after it.
const COUNTER: usize = 8;
const TAG: usize = 16;

/// A part, and what it needs to know.
#[derive(clap::Subcommand)]
pub(crate) enum Role {
    /// Writes an item so often, and no more.
    Writes { socket: PathBuf, count: u64 },
    /// Writes items of 64 bytes, and keeps them.
    Items { count: usize },
    /// Reads an item once, and tells how long after the opening of its reader that was.
    First { name: String },
    /// Reads an item for a while, and tells the longest pause between two of its samples.
    Pause { name: String },
    /// Sends stamps.
    #[command(subcommand)]
    Source(Way),
    /// Tells the ages of stamps.
    Sink {
        count: usize,
        #[command(subcommand)]
        way: Way,
    },
    /// Publishes frames.
    FramesOut {
        #[arg(long)]
        socket: Option<PathBuf>,
        name: String,
        bytes: usize,
        rate: u32,
        count: u32,
    },
    /// Looks at frames.
    FramesIn {
        #[arg(long)]
        socket: Option<PathBuf>,
        name: String,
        bytes: usize,
        count: u32,
    },
    /// From shared memory to sealed datagrams.
    RelayOut { path: PathBuf, to: SocketAddrV4 },
    /// From sealed datagrams to shared memory.
    RelayIn { port: u16, path: PathBuf },
}

/// How stamps travel.
#[derive(clap::Subcommand)]
pub(crate) enum Way {
    /// As an item.
    Ddx { name: String },
    /// As datagrams to or at an address.
    Udp { at: SocketAddrV4 },
    /// By a futex in a file of shared memory, from or to a relay.
    Futex { path: PathBuf },
}

impl Role {
    /// Plays it to its end, or until killed.
    pub(crate) fn play(self) -> Result<()> {
        match self {
            Self::Writes { socket, count } => {
                let store = Store::options().socket(socket).open()?;
                let mut writer = Copies::open(&store, "writes")?;
                (0..count).try_for_each(|turn| writer.write(&[turn; WORDS]))
            }
            Self::Items { count } => items(count),
            Self::First { name } => first(&name),
            Self::Pause { name } => fallover::pause(&name),
            Self::Source(way) => source(way.sender()?),
            Self::Sink { count, way } => sink(count, way.taker()?),
            Self::FramesOut {
                socket,
                name,
                bytes,
                rate,
                count,
            } => video::feed(&store(socket)?, &name, bytes, rate, count),
            Self::FramesIn {
                socket,
                name,
                bytes,
                count,
            } => video::view(&store(socket)?, &name, bytes, count),
            Self::RelayOut { path, to } => relay_out(Shared::open(&path)?, to),
            Self::RelayIn { port, path } => relay_in(port, Shared::open(&path)?),
        }
    }
}

impl Way {
    fn sender(self) -> Result<Box<dyn Send64>> {
        Ok(match self {
            Self::Ddx { name } => Box::new(Copies::open(&Store::open()?, &name)?),
            Self::Udp { at } => {
                let socket = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0))?;
                socket.connect(at)?;
                Box::new(Datagrams(socket))
            }
            Self::Futex { path } => Box::new(FloorWriter(Shared::open(&path)?)),
        })
    }

    fn taker(self) -> Result<Box<dyn Take64>> {
        Ok(match self {
            Self::Ddx { name } => Box::new(CopiesReader::open(&Store::open()?, &name, true)?),
            Self::Udp { at } => Box::new(Datagrams(UdpSocket::bind(at)?)),
            Self::Futex { path } => Box::new(FloorReader::new(Shared::open(&path)?, true)),
        })
    }
}

fn store(socket: Option<PathBuf>) -> Result<Store> {
    let options = Store::options();
    let options = match socket {
        Some(socket) => options.socket(socket),
        None => options,
    };
    Ok(options.open()?)
}

fn source(mut sender: Box<dyn Send64>) -> Result<()> {
    // 1 kHz: often enough to measure, and everybody is asleep again before the next.
    loop {
        sender.send(now_ns())?;
        thread::sleep(Duration::from_millis(1));
    }
}

fn sink(count: usize, mut taker: Box<dyn Take64>) -> Result<()> {
    println!("ready");
    for _ in 0..WARM_UP {
        taker.take()?;
    }
    let mut ages = Vec::with_capacity(count);
    for _ in 0..count {
        let stamp = taker.take()?;
        ages.push(now_ns().saturating_sub(stamp));
    }
    let mut lines: String = ages.iter().map(|age| format!("{age}\n")).collect();
    lines.push_str("end");
    println!("{lines}");
    Ok(())
}

fn items(count: usize) -> Result<()> {
    let store = Store::open()?;
    let mut writers = Vec::new();
    for item in 0..count {
        let mut writer = Copies::open(&store, &format!("item-{item}"))?;
        writer.write(&[0; WORDS])?;
        writers.push(writer);
    }
    println!("ready");
    loop {
        thread::park();
    }
}

fn first(name: &str) -> Result<()> {
    let store = Store::open()?;
    let opened = Instant::now();
    let mut reader: Reader<[u64; WORDS]> = store.reader(name)?;
    reader
        .next(Duration::from_secs(20))?
        .context("no value within 20 s")?;
    println!("{}", opened.elapsed().as_nanos());
    Ok(())
}

struct Datagrams(UdpSocket);

impl Send64 for Datagrams {
    fn send(&mut self, stamp: u64) -> Result<()> {
        let mut value = [0; VALUE];
        value[..COUNTER].copy_from_slice(&stamp.to_le_bytes());
        self.0.send(&value)?;
        Ok(())
    }
}

impl Take64 for Datagrams {
    fn take(&mut self) -> Result<u64> {
        let mut value = [0; VALUE];
        self.0.recv(&mut value)?;
        let stamp = value.first_chunk().context("a value holds a stamp")?;
        Ok(u64::from_le_bytes(*stamp))
    }
}

fn relay_out(shared: Shared, to: SocketAddrV4) -> Result<()> {
    let socket = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0))?;
    socket.connect(to)?;
    let (mut reader, key) = (FloorReader::new(shared, true), key()?);
    for counter in 0_u64.. {
        let value = reader.next()?;
        let mut datagram = counter.to_le_bytes().to_vec();
        datagram.extend(value.iter().flat_map(|word| word.to_le_bytes()));
        let (head, sealed) = datagram.split_at_mut(COUNTER);
        let tag = key.seal_in_place_separate_tag(nonce(counter), Aad::from(&*head), sealed);
        datagram.extend_from_slice(tag.ok().context("sealing")?.as_ref());
        socket.send(&datagram)?;
    }
    Ok(())
}

fn relay_in(port: u16, shared: Shared) -> Result<()> {
    let socket = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, port))?;
    let (mut writer, key) = (FloorWriter(shared), key()?);
    let mut datagram = [0; COUNTER + VALUE + TAG];
    println!("ready");
    loop {
        let len = socket.recv(&mut datagram)?;
        let (head, sealed) = datagram[..len]
            .split_first_chunk_mut::<COUNTER>()
            .context("a counter")?;
        let counter = u64::from_le_bytes(*head);
        let opened = key
            .open_in_place(nonce(counter), Aad::from(&*head), sealed)
            .ok()
            .context("opening")?;
        let mut value = [0; WORDS];
        for (word, bytes) in value.iter_mut().zip(opened.chunks_exact(8)) {
            *word = u64::from_le_bytes(*bytes.first_chunk().context("a word")?);
        }
        writer.write(&value)?;
    }
}

/// Any key will do: the floor is what sealing costs.
fn key() -> Result<LessSafeKey> {
    Ok(LessSafeKey::new(
        UnboundKey::new(&AES_256_GCM, &[7; 32])
            .ok()
            .context("making a key")?,
    ))
}

fn nonce(counter: u64) -> Nonce {
    let mut nonce = [0; 12];
    nonce[..COUNTER].copy_from_slice(&counter.to_le_bytes());
    Nonce::assume_unique_for_key(nonce)
}
