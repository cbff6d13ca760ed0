//! The program itself: it obeys orders.

use std::collections::BTreeMap;
use std::io::{BufRead as _, Write as _};
use std::thread;
use std::time::{Duration, Instant};

use ddx_store::{ReaderOptions, Schema, Store, WaitKey, WaitSet, Writer, WriterOptions};
use ddx_wire::{Delivery, Time};

use super::{ANSWER, Answer, Asked, Book, Done, NAME, Order, READY, Spread, VALUE_BYTES};

/// What the program holds.
struct Worker {
    store: Store,
    writers: Vec<Writer<Vec<u8>>>,
    set: WaitSet,
    readers: BTreeMap<WaitKey, Account>,
}

/// What one reader has read.
#[derive(Debug, Default)]
struct Account {
    book: Book,
    ages: Vec<Duration>,
}

#[test]
#[ignore = "the program that the scenarios start in their hosts"]
fn run() {
    let store = Store::options().program(NAME).open().unwrap();
    let mut worker = Worker {
        set: WaitSet::new(&store),
        store,
        writers: Vec::new(),
        readers: BTreeMap::new(),
    };
    // The harness may have begun a line.
    say(&format!("\n{READY}"));
    for line in std::io::stdin().lock().lines() {
        let order = serde_json::from_str(&line.unwrap()).unwrap();
        let answer: Answer = worker.obey(order).map_err(|error| error.to_string());
        say(&format!(
            "{ANSWER}{}",
            serde_json::to_string(&answer).unwrap()
        ));
    }
}

/// Writes past the harness, which would keep it.
fn say(line: &str) {
    let mut out = std::io::stdout().lock();
    writeln!(out, "{line}").and_then(|()| out.flush()).unwrap();
}

impl Worker {
    fn obey(&mut self, order: Order) -> Result<Done, ddx_store::Error> {
        let mut writes = Spread::default();
        match order {
            Order::OpenWriters {
                prefix,
                count,
                capacity_bytes,
            } => {
                for name in names(&prefix, count) {
                    let options = WriterOptions {
                        capacity_bytes: Some(capacity_bytes),
                        ..WriterOptions::default()
                    };
                    self.writers.push(self.store.writer_with(&name, options)?);
                }
            }
            Order::Write {
                first,
                count,
                period_us,
                bytes,
            } => writes = self.write(first, count, period_us, bytes)?,
            Order::OpenReaders {
                prefix,
                count,
                asked,
            } => self.open_readers(&prefix, count, asked)?,
            Order::WriteAged {
                first,
                count,
                period_us,
                age_ms,
            } => {
                for value in first..first + count {
                    thread::sleep(Duration::from_micros(period_us));
                    let capture = Time(ddx_store::now().0 - age_ms * 1_000_000);
                    for writer in &mut self.writers {
                        writer.write_at(&value.to_le_bytes().to_vec(), capture)?;
                    }
                }
            }
            Order::ReadSlowly { count, period_us } => self.read_slowly(count, period_us)?,
            Order::Read { value, within_ms } => {
                return self.read(value, Duration::from_millis(within_ms));
            }
            Order::Forget => {
                for account in self.readers.values_mut() {
                    account.ages.clear();
                }
            }
            Order::CloseReaders => {
                for (key, _) in std::mem::take(&mut self.readers) {
                    self.set.remove(key);
                }
            }
        }
        Ok(Done {
            at_ns: Some(ddx_store::now().0),
            books: Vec::new(),
            writes,
        })
    }

    fn open_readers(
        &mut self,
        prefix: &str,
        count: usize,
        asked: Asked,
    ) -> Result<(), ddx_store::Error> {
        let options = ReaderOptions {
            rate: asked.rate_hz,
            max_age: asked.max_age_ms.map(Duration::from_millis),
            delivery: match asked.every {
                true => Delivery::Every,
                false => Delivery::Latest,
            },
            priority: asked.priority,
            ..ReaderOptions::default()
        };
        for name in names(prefix, count) {
            let bytes = Some(Schema::bytes());
            let reader = self.store.raw_reader(&name, bytes.as_ref(), options)?;
            self.readers
                .insert(self.set.add(reader), Account::default());
        }
        Ok(())
    }

    fn write(
        &mut self,
        first: u64,
        count: u64,
        period_us: u64,
        bytes: usize,
    ) -> Result<Spread, ddx_store::Error> {
        let mut payload = vec![0; bytes.max(VALUE_BYTES)];
        let mut next = Instant::now();
        let mut writes = Vec::new();
        for value in first..first + count {
            fill(&mut payload, value);
            // The pace of a sensor: what is not due yet is not written.
            thread::sleep(next.saturating_duration_since(Instant::now()));
            next += Duration::from_micros(period_us);
            for writer in &mut self.writers {
                stamp(&mut payload);
                let start = Instant::now();
                writer.write(&payload)?;
                writes.push(start.elapsed());
            }
        }
        Ok(Spread::of(&writes))
    }

    fn read_slowly(&mut self, count: u64, period_us: u64) -> Result<(), ddx_store::Error> {
        let mut payload = Vec::new();
        let mut next = Instant::now();
        for _ in 0..count {
            thread::sleep(next.saturating_duration_since(Instant::now()));
            next += Duration::from_micros(period_us);
            for key in self.readers.keys() {
                if let Some(reader) = self.set.reader(*key) {
                    reader.next_into(&mut payload, Duration::ZERO)?;
                }
            }
        }
        Ok(())
    }

    fn read(&mut self, value: u64, within: Duration) -> Result<Done, ddx_store::Error> {
        let deadline = Instant::now() + within;
        let mut rung: Vec<WaitKey> = self.readers.keys().copied().collect();
        let mut at_ns = None;
        let mut payload = Vec::new();
        loop {
            for key in rung.drain(..) {
                let (Some(reader), Some(account)) =
                    (self.set.reader(key), self.readers.get_mut(&key))
                else {
                    continue;
                };
                while reader.next_into(&mut payload, Duration::ZERO)?.is_some() {
                    account.enter(&payload);
                }
                let (missed, book) = (reader.missed(), &mut account.book);
                (book.overwritten, book.filtered, book.lost) =
                    (missed.overwritten, missed.filtered, missed.lost);
            }
            let mut newest = self.readers.values().map(|account| account.book.newest);
            if newest.all(|newest| newest >= Some(value)) {
                at_ns = Some(ddx_store::now().0);
            }
            let left = deadline.saturating_duration_since(Instant::now());
            if at_ns.is_some() || left.is_zero() {
                return Ok(Done {
                    at_ns,
                    books: self.readers.values().map(Account::book).collect(),
                    writes: Spread::default(),
                });
            }
            self.set.wait(left, &mut rung);
        }
    }
}

impl Account {
    fn enter(&mut self, payload: &[u8]) {
        if let Some(stamp) = payload.get(VALUE_BYTES..).and_then(<[u8]>::first_chunk) {
            let age = ddx_store::now()
                .0
                .saturating_sub(u64::from_le_bytes(*stamp));
            self.ages.push(Duration::from_nanos(age));
        }
        let book = &mut self.book;
        book.delivered += 1;
        let value = payload
            .first_chunk()
            .map(|bytes| u64::from_le_bytes(*bytes));
        if value < book.newest {
            book.backwards += 1;
        }
        book.newest = value;
        book.damaged += u64::from(!is_whole(payload));
    }

    fn book(&self) -> Book {
        Book {
            ages: Spread::of(&self.ages),
            ..self.book
        }
    }
}

/// Makes a payload that differs in every word from that of any other value: the value, a place for the time, and noise.
fn fill(payload: &mut [u8], value: u64) {
    let (words, rest) = payload.as_chunks_mut();
    for (word, noise) in words.iter_mut().zip(noise(value)) {
        *word = noise.to_le_bytes();
    }
    rest.fill(NOISE_LAST);
    if let Some(first) = words.first_mut() {
        *first = value.to_le_bytes();
    }
}

fn stamp(payload: &mut [u8]) {
    if let Some(place) = payload.as_chunks_mut().0.get_mut(1) {
        *place = ddx_store::now().0.to_le_bytes();
    }
}

/// Whether a payload is as [`fill`] made it for its value.
fn is_whole(payload: &[u8]) -> bool {
    let (words, rest) = payload.as_chunks();
    let Some(first) = words.first() else {
        return false;
    };
    let noise = noise(u64::from_le_bytes(*first));
    let mut words = words.iter().zip(noise).skip(2);
    words.all(|(word, noise)| *word == noise.to_le_bytes())
        && rest.iter().all(|byte| *byte == NOISE_LAST)
}

/// Steps of splitmix64.
fn noise(value: u64) -> impl Iterator<Item = u64> {
    (1_u64..).map(move |step| {
        let mixed = value.wrapping_add(step.wrapping_mul(0x9e37_79b9_7f4a_7c15));
        let mixed = (mixed ^ (mixed >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        mixed ^ (mixed >> 31)
    })
}

fn names(prefix: &str, count: usize) -> impl Iterator<Item = String> {
    (0..count).map(move |index| format!("{prefix}/{index}"))
}

const NOISE_LAST: u8 = 0x5a;
