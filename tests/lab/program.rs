//! The program that the scenarios run in their hosts: it writes and reads through the store as it is told, one line of
//! JSON for each order and one for each answer.
//!
//! It is this test binary again, asked for one ignored test (`worker.rs`). Every host of a lab shares this machine's clock,
//! so that times that two programs tell can be compared.

mod worker;

use std::process::Command;
use std::time::Duration;

use ddx_rig::lab::{Host, Process};
use ddx_wire::Priority;
use serde::{Deserialize, Serialize};

/// What a program can be told.
#[derive(Debug, Deserialize, Serialize)]
pub(crate) enum Order {
    /// Open writers of `count` items of bytes, of at most so many.
    OpenWriters {
        prefix: String,
        count: usize,
        capacity_bytes: u32,
    },
    /// Write each of the values from `first` on to all of them, one value each period.
    Write {
        first: u64,
        count: u64,
        period_us: u64,
        bytes: usize,
    },
    /// Open readers of `count` items.
    OpenReaders {
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
    /// Begin the readers' spreads anew, with what is read from now on.
    Forget,
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
    pub(crate) priority: Priority,
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
    /// How long each write took.
    writes: Spread,
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
    /// Values that were not byte for byte what was written.
    pub(crate) damaged: u64,
    /// From just before the write to the read, of values of at least 16 bytes, since it was told to forget.
    pub(crate) ages: Spread,
}

/// How times are spread.
#[derive(Clone, Copy, Debug, Default, Deserialize, Serialize, PartialEq, Eq)]
pub(crate) struct Spread {
    pub(crate) count: u64,
    pub(crate) p50: Duration,
    pub(crate) p99: Duration,
    pub(crate) max: Duration,
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
        Self::start_by(host, Command::new(std::env::current_exe().unwrap()))
    }

    /// Starts it in `host`, where it gets the cores that no other program wants.
    pub(crate) fn start_last(host: Host<'_>) -> Self {
        let mut nice = Command::new("nice");
        nice.args(["-n", "19"])
            .arg(std::env::current_exe().unwrap());
        Self::start_by(host, nice)
    }

    fn start_by(host: Host<'_>, mut command: Command) -> Self {
        let arguments = [
            "--exact",
            "program::worker::run",
            "--ignored",
            "--nocapture",
            "--test-threads=1",
        ];
        let process = host.spawn(command.args(arguments)).unwrap();
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
        self.open_large_writers(prefix, count, CAPACITY_BYTES);
    }

    /// Opens writers of items that hold at most so many bytes.
    #[track_caller]
    pub(crate) fn open_large_writers(&mut self, prefix: &str, count: usize, capacity_bytes: u32) {
        let prefix = prefix.to_owned();
        self.ask(&Order::OpenWriters {
            prefix,
            count,
            capacity_bytes,
        });
    }

    /// Opens readers of `prefix/0` and up.
    #[track_caller]
    pub(crate) fn open_readers(&mut self, prefix: &str, count: usize) {
        self.open_readers_as(prefix, count, Asked::default());
    }

    /// Opens readers of `prefix/0` and up that ask for something.
    #[track_caller]
    pub(crate) fn open_readers_as(&mut self, prefix: &str, count: usize, asked: Asked) {
        let prefix = prefix.to_owned();
        self.ask(&Order::OpenReaders {
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

    /// Orders to read all that comes for so long, and does not wait. What was read before is in no spread.
    #[track_caller]
    pub(crate) fn tell_read_for(&mut self, span: Duration) {
        self.ask(&Order::Forget);
        self.tell_read(u64::MAX, span);
    }

    /// What each reader has read when the time that was told is up.
    #[track_caller]
    pub(crate) fn read_for_told(&mut self, span: Duration) -> Vec<Book> {
        self.answer(span + PATIENCE).books
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

    /// How long each write took.
    pub(crate) fn writes(&self) -> Spread {
        self.writes
    }
}

impl Book {
    /// All samples that it accounts for.
    pub(crate) fn total(&self) -> u64 {
        self.delivered + self.overwritten + self.filtered + self.lost
    }
}

impl Spread {
    /// The spread of these times.
    pub(crate) fn of(times: &[Duration]) -> Self {
        let mut sorted = times.to_vec();
        sorted.sort_unstable();
        let at = |percent: usize| {
            let place = (sorted.len() * percent / 100).min(sorted.len().saturating_sub(1));
            sorted.get(place).copied().unwrap_or_default()
        };
        Self {
            count: u64::try_from(sorted.len()).unwrap(),
            p50: at(50),
            p99: at(99),
            max: at(100),
        }
    }
}

/// By which name listings show it.
pub(crate) const NAME: &str = "scenario";
const READY: &str = "ready";
const ANSWER: &str = "answer ";
const VALUE_BYTES: usize = 8;
const CAPACITY_BYTES: u32 = 1_024;

/// Beyond this a program that should answer at once hangs.
const PATIENCE: Duration = Duration::from_secs(10);
