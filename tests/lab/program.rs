//! The program that the scenarios run in their hosts: it writes and reads through the store as it is told, one line of
//! JSON for each order and one for each answer.
//!
//! It is this test binary again, asked for one ignored test. Every host of a lab shares this machine's clock, so that
//! times that two programs tell can be compared.

use std::collections::BTreeMap;
use std::io::{BufRead as _, Write as _};
use std::process::Command;
use std::thread;
use std::time::{Duration, Instant};

use ddx_rig::lab::{Host, Process};
use ddx_store::{ReaderOptions, Schema, Store, WaitKey, WaitSet, Writer, WriterOptions};
use ddx_wire::{Delivery, Time};
use serde::{Deserialize, Serialize};

/// What a program can be told.
#[derive(Debug, Deserialize, Serialize)]
pub(crate) enum Order {
    /// Open writers of `count` items of bytes.
    OpenWriters { prefix: String, count: usize },
    /// Write each of the values from `first` on to all of them, one value each period.
    Write {
        first: u64,
        count: u64,
        period_us: u64,
        bytes: usize,
    },
    /// Open readers of `count` items.
    OpenReaders { prefix: String, count: usize },
    /// Open readers of `count` items that ask for something.
    OpenReadersAs {
        prefix: String,
        count: usize,
        asked: Asked,
    },
    /// Write values whose content was true `age_ms` ago.
    WriteAged {
        first: u64,
        count: u64,
        period_us: u64,
        age_ms: u64,
    },
    /// Read one sample of every reader each period, so often.
    ReadSlowly { count: u64, period_us: u64 },
    /// Read until every reader has `value` or a higher one.
    Read { value: u64, within_ms: u64 },
    /// Close all readers.
    CloseReaders,
}

/// What readers ask of the source.
#[derive(Clone, Copy, Debug, Default, Deserialize, Serialize)]
#[serde(default)]
pub(crate) struct Asked {
    pub(crate) every: bool,
    pub(crate) rate_hz: Option<f64>,
    pub(crate) max_age_ms: Option<u64>,
}

/// What it answers, or why it failed.
type Answer = Result<Done, String>;

/// What was done.
#[derive(Debug, Deserialize, Serialize)]
pub(crate) struct Done {
    /// When; none if the time was up before the value was there.
    at_ns: Option<u64>,
    /// What each reader has read so far.
    books: Vec<Book>,
}

/// What one reader got and missed since it was opened.
#[derive(Clone, Copy, Debug, Default, Deserialize, Serialize, PartialEq, Eq)]
pub(crate) struct Book {
    pub(crate) delivered: u64,
    pub(crate) overwritten: u64,
    pub(crate) filtered: u64,
    pub(crate) lost: u64,
    /// The value read last.
    pub(crate) newest: Option<u64>,
    /// Values that were lower than one read before: an old one that showed as new.
    pub(crate) backwards: u64,
}

/// The running program, seen from the test. Dropped, it is killed.
#[derive(Debug)]
pub(crate) struct Program {
    process: Process,
    told: usize,
}

impl Program {
    /// Starts it in `host`; it opens the store of that host's daemon.
    pub(crate) fn start(host: Host<'_>) -> Self {
        let binary = std::env::current_exe().unwrap();
        let arguments = [
            "--exact",
            "program::run",
            "--ignored",
            "--nocapture",
            "--test-threads=1",
        ];
        let process = host.spawn(Command::new(binary).args(arguments)).unwrap();
        process.wait_line(|line| line == READY, PATIENCE).unwrap();
        Self { process, told: 0 }
    }

    /// Gives an order and waits until it is done.
    #[track_caller]
    pub(crate) fn ask(&mut self, order: &Order) -> Done {
        self.tell(order);
        self.answer(PATIENCE)
    }

    /// Gives an order and does not wait.
    pub(crate) fn tell(&mut self, order: &Order) {
        let line = serde_json::to_string(order).unwrap();
        self.process.write_line(&line).unwrap();
        self.told += 1;
    }

    /// Waits for the answer to an order that was told.
    #[track_caller]
    pub(crate) fn answer(&mut self, deadline: Duration) -> Done {
        let line = self
            .process
            .wait_line(|line| line.starts_with(ANSWER), deadline)
            .unwrap();
        let answer: Answer = serde_json::from_str(&line[ANSWER.len()..]).unwrap();
        answer.unwrap()
    }

    /// Whether the answer to an order that was told is still to come.
    pub(crate) fn is_busy(&self) -> bool {
        let output = self.process.output();
        output
            .lines()
            .filter(|line| line.starts_with(ANSWER))
            .count()
            < self.told
    }

    /// Opens writers of `prefix/0` and up.
    #[track_caller]
    pub(crate) fn open_writers(&mut self, prefix: &str, count: usize) {
        let prefix = prefix.to_owned();
        self.ask(&Order::OpenWriters { prefix, count });
    }

    /// Opens readers of `prefix/0` and up.
    #[track_caller]
    pub(crate) fn open_readers(&mut self, prefix: &str, count: usize) {
        let prefix = prefix.to_owned();
        self.ask(&Order::OpenReaders { prefix, count });
    }

    /// Opens readers of `prefix/0` and up that ask for something.
    #[track_caller]
    pub(crate) fn open_readers_as(&mut self, prefix: &str, count: usize, asked: Asked) {
        let prefix = prefix.to_owned();
        self.ask(&Order::OpenReadersAs {
            prefix,
            count,
            asked,
        });
    }

    /// Writes one value to every item; returns when.
    #[track_caller]
    pub(crate) fn write(&mut self, value: u64) -> u64 {
        let order = Order::Write {
            first: value,
            count: 1,
            period_us: 0,
            bytes: VALUE_BYTES,
        };
        self.ask(&order).at_ns()
    }

    /// Reads until every reader has `value`; returns when the last had it, and what each has read so far.
    #[track_caller]
    pub(crate) fn read(&mut self, value: u64, within: Duration) -> (u64, Vec<Book>) {
        self.tell_read(value, within);
        self.read_told(within + PATIENCE)
    }

    /// Orders to read as [`Program::read`] does, and does not wait: several programs then read at the same time.
    pub(crate) fn tell_read(&mut self, value: u64, within: Duration) {
        let within_ms = u64::try_from(within.as_millis()).unwrap();
        self.tell(&Order::Read { value, within_ms });
    }

    /// Waits for the answer to an order to read that was told.
    #[track_caller]
    pub(crate) fn read_told(&mut self, deadline: Duration) -> (u64, Vec<Book>) {
        let done = self.answer(deadline);
        let Some(at_ns) = done.at_ns else {
            panic!("not every reader had the value in time: {:?}", done.books);
        };
        (at_ns, done.books)
    }

    /// Ends it with `SIGKILL`.
    pub(crate) fn kill(mut self) {
        self.process.kill().unwrap();
    }
}

impl Done {
    /// When it was done.
    #[track_caller]
    pub(crate) fn at_ns(&self) -> u64 {
        self.at_ns.unwrap()
    }
}

impl Book {
    /// All samples that it accounts for.
    pub(crate) fn total(&self) -> u64 {
        self.delivered + self.overwritten + self.filtered + self.lost
    }
}

/// What the program holds.
struct Worker {
    store: Store,
    writers: Vec<Writer<Vec<u8>>>,
    set: WaitSet,
    readers: BTreeMap<WaitKey, Book>,
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
        match order {
            Order::OpenWriters { prefix, count } => {
                for name in names(&prefix, count) {
                    let options = WriterOptions {
                        capacity_bytes: Some(CAPACITY_BYTES),
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
            } => self.write(first, count, period_us, bytes)?,
            Order::OpenReaders { prefix, count } => {
                self.open_readers(&prefix, count, Asked::default())?;
            }
            Order::OpenReadersAs {
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
            Order::ReadSlowly { count, period_us } => {
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
            }
            Order::Read { value, within_ms } => {
                return self.read(value, Duration::from_millis(within_ms));
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
            ..ReaderOptions::default()
        };
        for name in names(prefix, count) {
            let reader = self
                .store
                .raw_reader(&name, Some(&Schema::bytes()), options)?;
            let key = self.set.add(reader);
            self.readers.insert(key, Book::default());
        }
        Ok(())
    }

    fn write(
        &mut self,
        first: u64,
        count: u64,
        period_us: u64,
        bytes: usize,
    ) -> Result<(), ddx_store::Error> {
        let mut payload = vec![0; bytes.max(VALUE_BYTES)];
        let mut next = Instant::now();
        for value in first..first + count {
            // The pace of a sensor: what is not due yet is not written.
            thread::sleep(next.saturating_duration_since(Instant::now()));
            next += Duration::from_micros(period_us);
            payload[..VALUE_BYTES].copy_from_slice(&value.to_le_bytes());
            for writer in &mut self.writers {
                writer.write(&payload)?;
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
                let (Some(reader), Some(book)) = (self.set.reader(key), self.readers.get_mut(&key))
                else {
                    continue;
                };
                while reader.next_into(&mut payload, Duration::ZERO)?.is_some() {
                    book.enter(&payload);
                }
                let missed = reader.missed();
                (book.overwritten, book.filtered, book.lost) =
                    (missed.overwritten, missed.filtered, missed.lost);
            }
            if self.readers.values().all(|book| book.newest >= Some(value)) {
                at_ns = Some(ddx_store::now().0);
            }
            let left = deadline.saturating_duration_since(Instant::now());
            if at_ns.is_some() || left.is_zero() {
                let books = self.readers.values().copied().collect();
                return Ok(Done { at_ns, books });
            }
            self.set.wait(left, &mut rung);
        }
    }
}

impl Book {
    fn enter(&mut self, payload: &[u8]) {
        self.delivered += 1;
        let value = payload
            .first_chunk()
            .map(|bytes| u64::from_le_bytes(*bytes));
        if value < self.newest {
            self.backwards += 1;
        }
        self.newest = value;
    }
}

fn names(prefix: &str, count: usize) -> impl Iterator<Item = String> {
    (0..count).map(move |index| format!("{prefix}/{index}"))
}

/// By which name listings show it.
pub(crate) const NAME: &str = "scenario";
const READY: &str = "ready";
const ANSWER: &str = "answer ";
const VALUE_BYTES: usize = 8;
const CAPACITY_BYTES: u32 = 1_024;

/// Beyond this a program that should answer at once hangs.
const PATIENCE: Duration = Duration::from_secs(10);
