//! What the two programs of each contender do, whatever carries their samples; the peers in Rust compile this file too, and
//! `peers/peer.h` and `peers/ecal_peer.py` are the same in other languages.
//!
//! ```text
//! PROGRAM pub|sub [--items K] [--sizes N,N] [--own IP] [--publisher IP] [--subscribers IP,IP] [--tls DIR] [--reliable]
//!                 [--size N --rate HZ|max --seconds S]
//! ```
//!
//! It says `{"started_ns":T}` at once and `{"ready_ns":T}` once it is open; a subscriber says `{"first_ns":T}` at the first
//! sample ever. Then each line of its input, `run ID SIZE RATE BEGIN FROM UNTIL REPORT` (a rate of 0 is without pause; times
//! are nanoseconds of the monotonic clock, which all hosts of a lab share), is answered by one line of JSON. Samples are sent
//! from BEGIN to UNTIL; counted is what lies between FROM and UNTIL; the answer is due at REPORT. With `--seconds` there is
//! one such run, and the program ends.
//!
//! A sample begins with a mark, the run, a sequence number from 0 and the time before it was filled.

use std::io::{BufRead, Write};
use std::net::Ipv4Addr;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use anyhow::{Context, Result, bail};
use rustix::thread::clock_nanosleep_absolute;
use rustix::time::{ClockId, Timespec, clock_gettime};

/// Bytes that every sample begins with.
const HEADER: usize = 24;
const MARK: u32 = 0x6278_6464;
/// What each program asks of the kernel for its sockets, where its library lets it.
pub(crate) const SOCKET_BUFFER_BYTES: usize = 4 << 20;

/// How one contender carries samples.
pub(crate) trait Contender {
    /// Opens all items for writing.
    fn publisher(&self, options: &Options) -> Result<Box<dyn Publisher>>;
    /// Opens all items for reading: each sample goes to the sink as long as the program lives.
    fn subscribe(&self, options: &Options, sink: Sink) -> Result<Box<dyn std::any::Any>>;
}

/// Sends samples.
pub(crate) trait Publisher {
    /// Sends one sample of an item, filled by `fill`; an error is a refusal of this size.
    fn publish(&mut self, item: usize, size: usize, fill: &dyn Fn(&mut [u8])) -> Result<()>;
}

/// What a program is told at its start.
pub(crate) struct Options {
    publishes: bool,
    /// Items that are open.
    pub(crate) items: usize,
    /// Sizes of samples that will come.
    pub(crate) sizes: Vec<usize>,
    /// Address of this host.
    pub(crate) own: Ipv4Addr,
    /// Address of the publisher's host.
    pub(crate) publisher: Ipv4Addr,
    /// Addresses of the subscribers' hosts.
    pub(crate) subscribers: Vec<Ipv4Addr>,
    /// Where `ca.pem`, `cert.pem` and `key.pem` are, if the traffic shall be sealed.
    pub(crate) tls: Option<PathBuf>,
    /// Whether every sample shall arrive, and not only the newest.
    pub(crate) reliable: bool,
    size: usize,
    rate: f64,
    seconds: Option<f64>,
}

/// One run, as a line of input asks for it.
#[derive(Clone, Copy)]
struct Run {
    id: u32,
    size: usize,
    rate: f64,
    begin: u64,
    from: u64,
    until: u64,
    report: u64,
}

/// Where a subscriber's samples go.
#[derive(Clone)]
pub(crate) struct Sink(Arc<Mutex<Tally>>);

/// What a subscriber has counted in one run.
#[derive(Default)]
struct Tally {
    run: Option<Run>,
    has_said_first: bool,
    /// One bit for each sequence number that came.
    seen: Vec<u64>,
    arrived: u64,
    delivered: u64,
    duplicates: u64,
    stale: u64,
    last_ns: u64,
    gap_ns: u64,
    gap_end_ns: u64,
    latencies: Histogram,
}

/// Counts of values, by value to within one percent.
#[derive(Default)]
struct Histogram {
    counts: Vec<u64>,
    total: u64,
}

/// Plays the program that these words ask for, to the end of its input.
pub(crate) fn play(
    words: impl IntoIterator<Item = String>,
    contender: &dyn Contender,
) -> Result<()> {
    let options = Options::parse(words)?;
    say(&format!("{{\"started_ns\":{}}}", now_ns()));
    if options.publishes {
        let mut publisher = contender.publisher(&options)?;
        say(&format!("{{\"ready_ns\":{}}}", now_ns()));
        options.runs(|run| publish(publisher.as_mut(), options.items, run))
    } else {
        let sink = Sink(Arc::default());
        let _subscription = contender.subscribe(&options, sink.clone())?;
        say(&format!("{{\"ready_ns\":{}}}", now_ns()));
        options.runs(|run| sink.count(run))
    }
}

impl Options {
    fn parse(words: impl IntoIterator<Item = String>) -> Result<Self> {
        let mut words = words.into_iter();
        let publishes = match words.next().as_deref() {
            Some("pub") => true,
            Some("sub") => false,
            other => bail!("`pub` or `sub` was expected, not {other:?}"),
        };
        let mut options = Self {
            publishes,
            items: 1,
            sizes: vec![64],
            own: Ipv4Addr::LOCALHOST,
            publisher: Ipv4Addr::LOCALHOST,
            subscribers: vec![Ipv4Addr::LOCALHOST],
            tls: None,
            reliable: false,
            size: 64,
            rate: 1_000.0,
            seconds: None,
        };
        while let Some(flag) = words.next() {
            if flag == "--reliable" {
                options.reliable = true;
                continue;
            }
            let value = words
                .next()
                .with_context(|| format!("`{flag}` needs a value"))?;
            match flag.as_str() {
                "--items" => options.items = value.parse()?,
                "--sizes" => options.sizes = list(&value)?,
                "--own" => options.own = value.parse()?,
                "--publisher" => options.publisher = value.parse()?,
                "--subscribers" => options.subscribers = list(&value)?,
                "--tls" => options.tls = Some(PathBuf::from(value)),
                "--size" => {
                    options.size = value.parse()?;
                    options.sizes = vec![options.size];
                }
                "--rate" if value == "max" => options.rate = 0.0,
                "--rate" => options.rate = value.parse()?,
                "--seconds" => options.seconds = Some(value.parse()?),
                _ => bail!("no option `{flag}`"),
            }
        }
        Ok(options)
    }

    /// Answers each run that is asked for.
    fn runs(&self, mut answer: impl FnMut(Run) -> String) -> Result<()> {
        if let Some(seconds) = self.seconds {
            let begin = now_ns();
            let until = begin + nanos(Duration::from_secs_f64(seconds));
            say(&answer(Run {
                id: 1,
                size: self.size,
                rate: self.rate,
                begin,
                from: begin,
                until,
                report: until + nanos(GRACE),
            }));
            return Ok(());
        }
        for line in std::io::stdin().lock().lines() {
            let line = line.context("reading what to do")?;
            let run = Run::parse(&line).with_context(|| format!("`{line}` is no run"))?;
            say(&answer(run));
        }
        Ok(())
    }
}

impl Run {
    fn parse(line: &str) -> Result<Self> {
        let words: Vec<&str> = line.split_whitespace().collect();
        let ["run", id, size, rate, begin, from, until, report] = words.as_slice() else {
            bail!("eight words were expected");
        };
        Ok(Self {
            id: id.parse()?,
            size: size.parse::<usize>()?.max(HEADER),
            rate: rate.parse()?,
            begin: begin.parse()?,
            from: from.parse()?,
            until: until.parse()?,
            report: report.parse()?,
        })
    }

    fn covers(&self, at: u64) -> bool {
        (self.from..self.until).contains(&at)
    }
}

/// Sends the samples of a run and returns the answer.
fn publish(publisher: &mut dyn Publisher, items: usize, run: Run) -> String {
    let (mut seq, mut sent) = (0_u64, 0_u64);
    let mut cpu_from = None;
    // Nothing is caught up with: a sample that could not be sent in time is late, and the next is one period after it.
    let period = (run.rate > 0.0).then(|| nanos(Duration::from_secs_f64(run.rate.recip())));
    let mut due = run.begin.max(now_ns());
    sleep_until(due);
    loop {
        let stamp = now_ns();
        if stamp >= run.until {
            break;
        }
        if stamp >= run.from && cpu_from.is_none() {
            cpu_from = Some(cpu_ns());
        }
        let item = usize::try_from(seq).unwrap_or(0) % items.max(1);
        let fill = |sample: &mut [u8]| fill(sample, run.id, seq, stamp);
        if let Err(error) = publisher.publish(item, run.size, &fill) {
            let error = format!("{error:#}").replace(['"', '\\', '\n'], "'");
            return format!("{{\"run\":{},\"refused\":\"{error}\"}}", run.id);
        }
        seq += 1;
        sent += u64::from(run.covers(stamp));
        if let Some(period) = period {
            due += period;
            let now = now_ns();
            if due > now {
                sleep_until(due.min(run.until));
            } else if now - due > nanos(LATE) {
                due = now;
            }
        }
    }
    let cpu = cpu_ns();
    format!(
        "{{\"run\":{},\"sent\":{sent},\"sent_in_all\":{seq},\"cpu_ns\":{}}}",
        run.id,
        cpu - cpu_from.unwrap_or(cpu),
    )
}

/// Makes a sample: every byte of it is written.
fn fill(sample: &mut [u8], run: u32, seq: u64, stamp: u64) {
    let [low, ..] = seq.to_le_bytes();
    let Some((header, rest)) = sample.split_first_chunk_mut::<HEADER>() else {
        return;
    };
    header[..4].copy_from_slice(&MARK.to_le_bytes());
    header[4..8].copy_from_slice(&run.to_le_bytes());
    header[8..16].copy_from_slice(&seq.to_le_bytes());
    header[16..].copy_from_slice(&stamp.to_le_bytes());
    rest.fill(low);
}

impl Sink {
    /// Takes a sample that has just come.
    pub(crate) fn take(&self, sample: &[u8]) {
        let now = now_ns();
        let Some((mark, run, seq, stamp)) = header(sample) else {
            return;
        };
        if mark == MARK {
            let mut tally = self.0.lock().unwrap_or_else(PoisonError::into_inner);
            tally.take(now, run, seq, stamp);
        }
    }

    /// Begins to count for a run, or ends, and returns what was counted before.
    fn begin(&self, run: Option<Run>) -> Tally {
        let mut tally = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let next = Tally {
            run,
            has_said_first: tally.has_said_first,
            ..Tally::default()
        };
        std::mem::replace(&mut tally, next)
    }

    /// Counts what comes in a run and returns the answer.
    fn count(&self, run: Run) -> String {
        self.begin(Some(run));
        sleep_until(run.from);
        let cpu_from = cpu_ns();
        sleep_until(run.until);
        let cpu = cpu_ns() - cpu_from;
        sleep_until(run.report);
        let tally = self.begin(None);
        let quantile = |share: f64| tally.latencies.quantile(share);
        format!(
            "{{\"run\":{},\"arrived\":{},\"delivered\":{},\"duplicates\":{},\"stale\":{},\"cpu_ns\":{cpu},\
             \"p50_ns\":{},\"p90_ns\":{},\"p99_ns\":{},\"max_ns\":{},\"gap_ns\":{},\"gap_end_ns\":{}}}",
            run.id,
            tally.arrived,
            tally.delivered,
            tally.duplicates,
            tally.stale,
            quantile(0.5),
            quantile(0.9),
            quantile(0.99),
            quantile(1.0),
            tally.gap_ns,
            tally.gap_end_ns,
        )
    }
}

impl Tally {
    fn take(&mut self, now: u64, id: u32, seq: u64, stamp: u64) {
        if !self.has_said_first {
            self.has_said_first = true;
            say(&format!("{{\"first_ns\":{now}}}"));
        }
        let Some(run) = self.run.filter(|run| run.id == id) else {
            self.stale += 1;
            return;
        };
        let (word, bit) = (usize::try_from(seq / 64).unwrap_or(0), 1 << (seq % 64));
        if word >= SEQS_MAX / 64 {
            return;
        }
        if word >= self.seen.len() {
            self.seen.resize(word + 1, 0);
        }
        if self.seen[word] & bit != 0 {
            self.duplicates += 1;
            return;
        }
        self.seen[word] |= bit;
        self.arrived += u64::from(run.covers(now));
        if run.covers(stamp) {
            self.delivered += 1;
            self.latencies.add(now.saturating_sub(stamp));
        }
        let gap = now.saturating_sub(self.last_ns);
        if self.last_ns != 0 && gap > self.gap_ns {
            (self.gap_ns, self.gap_end_ns) = (gap, now);
        }
        self.last_ns = now;
    }
}

impl Histogram {
    fn add(&mut self, value: u64) {
        // Values below 128 have a bucket each; above, 128 buckets each time the value doubles.
        let shift = (u64::BITS - value.leading_zeros()).saturating_sub(8);
        let bucket = usize::try_from(u64::from(shift) * 128 + (value >> shift)).unwrap_or(0);
        if bucket >= self.counts.len() {
            self.counts.resize(bucket + 1, 0);
        }
        self.counts[bucket] += 1;
        self.total += 1;
    }

    /// The value that this share of all values does not exceed; 0 when there is none.
    fn quantile(&self, share: f64) -> u64 {
        let mut below = 0;
        for (bucket, count) in self.counts.iter().enumerate() {
            below += count;
            if below > 0 && below as f64 >= share * self.total as f64 {
                let bucket = u64::try_from(bucket).unwrap_or(0);
                let shift = (bucket / 128).saturating_sub(1);
                return (bucket - shift * 128) << shift;
            }
        }
        0
    }
}

/// Splits a sample's header; none when it is too short.
fn header(sample: &[u8]) -> Option<(u32, u32, u64, u64)> {
    let (mark, rest) = sample.split_first_chunk()?;
    let (run, rest) = rest.split_first_chunk()?;
    let (seq, rest) = rest.split_first_chunk()?;
    let stamp = rest.first_chunk()?;
    Some((
        u32::from_le_bytes(*mark),
        u32::from_le_bytes(*run),
        u64::from_le_bytes(*seq),
        u64::from_le_bytes(*stamp),
    ))
}

fn list<T: std::str::FromStr>(words: &str) -> Result<Vec<T>>
where
    T::Err: std::error::Error + Send + Sync + 'static,
{
    words
        .split(',')
        .map(|word| word.parse().with_context(|| format!("parsing `{word}`")))
        .collect()
}

/// The clock of all times here, the same in all programs and hosts of one lab.
pub(crate) fn now_ns() -> u64 {
    nanos(span(clock_gettime(ClockId::Monotonic)))
}

/// Sleeps until then; not at all when that is past.
pub(crate) fn sleep_until(ns: u64) {
    let at = Duration::from_nanos(ns);
    let Ok(tv_sec) = i64::try_from(at.as_secs()) else {
        return;
    };
    let request = Timespec {
        tv_sec,
        tv_nsec: at.subsec_nanos().into(),
    };
    while clock_nanosleep_absolute(ClockId::Monotonic, &request).is_err() {}
}

/// What all threads of this process have had of the processors.
fn cpu_ns() -> u64 {
    nanos(span(clock_gettime(ClockId::ProcessCPUTime)))
}

fn span(at: Timespec) -> Duration {
    Duration::new(
        u64::try_from(at.tv_sec).unwrap_or(0),
        u32::try_from(at.tv_nsec).unwrap_or(0),
    )
}

pub(crate) fn nanos(span: Duration) -> u64 {
    u64::try_from(span.as_nanos()).unwrap_or(u64::MAX)
}

/// Prints a line at once.
fn say(line: &str) {
    let mut out = std::io::stdout().lock();
    // Whoever started this program may be gone, and then nobody misses the line.
    writeln!(out, "{line}").and_then(|()| out.flush()).ok();
}

/// How long after the last sample a run by hand waits for it.
const GRACE: Duration = Duration::from_millis(300);
/// A publisher that is later than this starts its beat anew.
const LATE: Duration = Duration::from_millis(100);
/// Sequence numbers that are kept apart; no run comes near.
const SEQS_MAX: usize = 1 << 30;

#[cfg(test)]
mod tests {
    use super::*;

    fn run() -> Run {
        Run::parse("run 7 64 0 0 100 200 300").unwrap()
    }

    #[test]
    fn a_quantile_is_within_a_percent_and_never_above_the_value() {
        for value in [0, 1, 127, 128, 129, 1_000, 123_456, 10_u64.pow(10)] {
            let mut histogram = Histogram::default();
            histogram.add(value);

            let told = histogram.quantile(0.5);

            assert!(
                told <= value && value - told <= value / 100,
                "{value}: {told}"
            );
        }
        assert_eq!(Histogram::default().quantile(0.5), 0);
    }

    #[test]
    fn quantiles_follow_the_order_of_values() {
        let mut histogram = Histogram::default();
        for value in (1..=100).rev() {
            histogram.add(value);
        }

        assert_eq!(
            [0.5, 0.99, 1.0].map(|q| histogram.quantile(q)),
            [50, 99, 100]
        );
    }

    #[test]
    fn what_counts_is_new_of_this_run_and_within_its_time() {
        let mut tally = Tally {
            run: Some(run()),
            has_said_first: true,
            ..Tally::default()
        };

        tally.take(90, 7, 0, 80); // before
        tally.take(110, 7, 1, 95); // arrives within, was sent before
        tally.take(150, 7, 2, 140);
        tally.take(151, 7, 2, 140); // twice
        tally.take(152, 6, 3, 140); // of another run
        tally.take(250, 7, 3, 199); // was sent within, arrives late

        assert_eq!((tally.arrived, tally.delivered), (2, 2));
        assert_eq!((tally.duplicates, tally.stale), (1, 1));
        assert_eq!((tally.gap_ns, tally.gap_end_ns), (100, 250));
    }

    #[test]
    fn a_filled_sample_tells_its_header() {
        let mut sample = [0; 64];

        fill(&mut sample, 7, 300, 5);

        assert_eq!(header(&sample), Some((MARK, 7, 300, 5)));
        assert_eq!(sample[63], 44);
        assert_eq!(header(&sample[..20]), None);
    }
}
