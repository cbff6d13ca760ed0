//! NMEA 0183: the log of a GPS receiver, played at its own pace.
//!
//! | item | from | when |
//! |---|---|---|
//! | `NAME/fix` | GGA, else RMC | each fix, also when it is lost (quality 0, position NaN) |
//! | `NAME/satellites` | GSV, GGA | with each fix |
//! | `NAME/speed`, `NAME/course` | RMC, else VTG | when the receiver knows them |
//!
//! The pace is that of the times in the log. A sample's capture time is the moment of its place in the log; the receiver's
//! own time stays in the fix.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::Read as _;
use std::path::Path;
use std::time::Duration;

use anyhow::Context as _;
use chrono::{NaiveDate, NaiveTime};
use ddx_store::{Item, Store, Writer};
use ddx_wire::Time;
use nmea::ParseResult;
use nmea::sentences::{FixType, GgaData, RmcData};

use super::item_name;
use crate::error::Failure;

/// A position, or the loss of it.
#[derive(Clone, Copy, Debug, Item, PartialEq)]
#[repr(C)]
pub(crate) struct Fix {
    /// Receiver's time, since 1970; 0 while it does not know the date.
    #[ddx(unit = "ns")]
    pub(crate) time_ns: u64,
    #[ddx(unit = "deg", range = "-90..90")]
    pub(crate) latitude: f64,
    #[ddx(unit = "deg", range = "-180..180")]
    pub(crate) longitude: f64,
    /// Above mean sea level.
    #[ddx(unit = "m")]
    pub(crate) altitude: f32,
    /// Horizontal dilution of precision.
    #[ddx(unit = "1")]
    pub(crate) hdop: f32,
    /// Satellites used.
    pub(crate) satellites: u32,
    /// As NMEA 0183 counts: 0 none, 1 GPS, 2 differential, 4 and 5 RTK.
    pub(crate) quality: u32,
}

/// What the receiver hears.
#[derive(Clone, Copy, Debug, Item, PartialEq)]
#[repr(C)]
pub(crate) struct Satellites {
    /// Above the horizon, all systems together.
    pub(crate) in_view: u32,
    /// Used for the fix.
    pub(crate) used: u32,
    /// Best carrier to noise ratio.
    #[ddx(unit = "dBHz")]
    pub(crate) strongest: f32,
}

/// Speed over ground.
#[derive(Clone, Copy, Debug, Item, PartialEq)]
#[repr(C)]
pub(crate) struct Speed {
    #[ddx(unit = "m/s")]
    pub(crate) speed: f32,
}

/// Course over ground, from true north.
#[derive(Clone, Copy, Debug, Item, PartialEq)]
#[repr(C)]
pub(crate) struct Course {
    #[ddx(unit = "deg", range = "0..360")]
    pub(crate) course: f32,
}

/// One sample of one of the items.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Sample {
    Fix(Fix),
    Satellites(Satellites),
    Speed(Speed),
    Course(Course),
}

/// A log that has been read.
#[derive(Debug)]
pub(crate) struct Log {
    /// Samples with their times from the start of the log.
    samples: Vec<(Duration, Sample)>,
    /// How long one pass takes.
    length: Duration,
    /// Lines that are no valid sentence.
    pub(crate) bad_lines: usize,
}

/// The writers of the four items.
#[derive(Debug)]
pub(crate) struct Player {
    fix: Writer<Fix>,
    satellites: Writer<Satellites>,
    speed: Writer<Speed>,
    course: Writer<Course>,
}

/// Turns sentences into samples.
#[derive(Debug, Default)]
struct Assembler {
    has_gga: bool,
    has_rmc: bool,
    date: Option<NaiveDate>,
    last: Option<NaiveTime>,
    elapsed: Duration,
    in_view: BTreeMap<String, u32>,
    strongest: f32,
    samples: Vec<(Duration, Sample)>,
}

impl Log {
    /// Reads a whole log.
    ///
    /// # Errors
    /// Names the file that is missing, too large, empty or no log.
    pub(crate) fn read(path: &Path) -> Result<Self, Failure> {
        let mut bytes = Vec::new();
        File::open(path)
            .and_then(|file| file.take(MAX_BYTES + 1).read_to_end(&mut bytes))
            .with_context(|| format!("cannot read `{}`", path.display()))?;
        if u64::try_from(bytes.len()).is_ok_and(|len| len > MAX_BYTES) {
            return Err(
                Failure::new(format!("`{}` is larger than 256 MiB", path.display()))
                    .with_hint("split it: the whole log is held in memory"),
            );
        }
        Self::parse(&bytes).map_err(|fault| {
            Failure::new(format!("`{}` {fault}", path.display()))
                .with_hint("a log has lines such as `$GPGGA,110242,5505.793781,N,03856.742339,E,2,08,0.9,2177.0,M,14.0,M,,*74`")
        })
    }

    fn parse(bytes: &[u8]) -> Result<Self, String> {
        let mut sentences = Vec::new();
        let (mut lines, mut bad_lines) = (0, 0);
        for line in bytes.split(|byte| *byte == b'\n').map(<[u8]>::trim_ascii) {
            if line.is_empty() {
                continue;
            }
            lines += 1;
            match nmea::parse_bytes(line) {
                Ok(sentence) => sentences.push(sentence),
                Err(fault) if is_foreign_sentence(&fault) => {}
                Err(_) => bad_lines += 1,
            }
        }
        if lines == 0 {
            return Err("is empty".to_owned());
        }
        if sentences.is_empty() {
            return Err(format!(
                "is no NMEA 0183 log: none of its {lines} lines is a valid sentence"
            ));
        }
        let (samples, length) = Assembler::assemble(sentences);
        if samples.is_empty() {
            return Err("has valid sentences, but no fix, satellites, speed or course".to_owned());
        }
        Ok(Self {
            samples,
            length,
            bad_lines,
        })
    }

    /// How many samples one pass publishes.
    pub(crate) fn len(&self) -> usize {
        self.samples.len()
    }
}

impl Player {
    /// Takes the leases of the items.
    pub(crate) fn open(store: &Store, name: &str) -> Result<Self, Failure> {
        Ok(Self {
            fix: store.writer(&item_name(name, "fix"))?,
            satellites: store.writer(&item_name(name, "satellites"))?,
            speed: store.writer(&item_name(name, "speed"))?,
            course: store.writer(&item_name(name, "course"))?,
        })
    }

    /// Publishes the log once, `speedup` times as fast as it was recorded. `wait` blocks until an instant and says whether
    /// to go on. Returns when the next pass should start; `None` when `wait` said stop.
    pub(crate) fn play(
        &mut self,
        log: &Log,
        start: Time,
        speedup: f64,
        mut wait: impl FnMut(Time) -> bool,
    ) -> Result<Option<Time>, Failure> {
        for (at, sample) in &log.samples {
            let due = start + at.div_f64(speedup);
            if !wait(due) {
                return Ok(None);
            }
            match sample {
                Sample::Fix(fix) => self.fix.write_at(fix, due)?,
                Sample::Satellites(satellites) => self.satellites.write_at(satellites, due)?,
                Sample::Speed(speed) => self.speed.write_at(speed, due)?,
                Sample::Course(course) => self.course.write_at(course, due)?,
            };
        }
        let next = start + log.length.div_f64(speedup);
        Ok(wait(next).then_some(next))
    }
}

impl Assembler {
    fn assemble(sentences: Vec<ParseResult>) -> (Vec<(Duration, Sample)>, Duration) {
        let mut assembler = Self {
            has_gga: sentences.iter().any(|s| matches!(s, ParseResult::GGA(_))),
            has_rmc: sentences.iter().any(|s| matches!(s, ParseResult::RMC(_))),
            ..Self::default()
        };
        for sentence in sentences {
            assembler.take(sentence);
        }
        // The last fix lasts as long as a usual one, so that a loop does not stumble.
        let fixes = assembler
            .samples
            .iter()
            .filter(|(_, sample)| matches!(sample, Sample::Fix(_)))
            .count();
        let intervals = u32::try_from(fixes.saturating_sub(1)).unwrap_or(u32::MAX);
        let interval = assembler
            .elapsed
            .checked_div(intervals)
            .filter(|i| !i.is_zero());
        (
            assembler.samples,
            assembler.elapsed + interval.unwrap_or(USUAL_INTERVAL),
        )
    }

    #[expect(
        clippy::wildcard_enum_match_arm,
        reason = "a receiver says much that is no item here"
    )]
    fn take(&mut self, sentence: ParseResult) {
        match sentence {
            ParseResult::GGA(gga) => {
                self.advance(gga.fix_time);
                let used = gga.fix_satellites.unwrap_or(0);
                self.push(Sample::Fix(fix_of_gga(&gga, self.unix_ns(gga.fix_time))));
                self.satellites(used);
            }
            ParseResult::RMC(rmc) => {
                self.date = rmc.fix_date.or(self.date);
                self.advance(rmc.fix_time);
                if !self.has_gga {
                    self.push(Sample::Fix(fix_of_rmc(&rmc, self.unix_ns(rmc.fix_time))));
                    self.satellites(0);
                }
                self.motion(rmc.speed_over_ground, rmc.true_course);
            }
            ParseResult::VTG(vtg) if !self.has_rmc => {
                self.motion(vtg.speed_over_ground, vtg.true_course);
            }
            ParseResult::GSV(gsv) => {
                self.in_view
                    .insert(gsv.gnss_type.to_string(), u32::from(gsv.sats_in_view));
                let heard = gsv
                    .sats_info
                    .iter()
                    .flatten()
                    .filter_map(nmea::Satellite::snr);
                self.strongest = heard.fold(self.strongest, f32::max);
            }
            _ => {}
        }
    }

    fn push(&mut self, sample: Sample) {
        self.samples.push((self.elapsed, sample));
    }

    fn satellites(&mut self, used: u32) {
        let in_view = self.in_view.values().sum();
        let strongest = std::mem::take(&mut self.strongest);
        self.push(Sample::Satellites(Satellites {
            in_view,
            used,
            strongest,
        }));
    }

    fn motion(&mut self, knots: Option<f32>, course: Option<f32>) {
        if let Some(knots) = knots {
            self.push(Sample::Speed(Speed {
                speed: knots * METRES_PER_SECOND_IN_A_KNOT,
            }));
        }
        if let Some(course) = course {
            self.push(Sample::Course(Course { course }));
        }
    }

    /// Moves the log's clock to the time of day `time`; a day may end in between, and a receiver that finds its time
    /// anew may go back, which costs no time.
    fn advance(&mut self, time: Option<NaiveTime>) {
        let Some(time) = time else { return };
        if let Some(last) = self.last.replace(time) {
            let passed_ms = time.signed_duration_since(last).num_milliseconds();
            let passed_ms = if passed_ms < -HALF_DAY_MS {
                passed_ms + 2 * HALF_DAY_MS
            } else {
                passed_ms
            };
            self.elapsed += Duration::from_millis(u64::try_from(passed_ms).unwrap_or(0));
        }
    }

    fn unix_ns(&self, time: Option<NaiveTime>) -> u64 {
        self.date
            .zip(time)
            .and_then(|(date, time)| date.and_time(time).and_utc().timestamp_nanos_opt())
            .and_then(|ns| u64::try_from(ns).ok())
            .unwrap_or(0)
    }
}

fn fix_of_gga(gga: &GgaData, time_ns: u64) -> Fix {
    Fix {
        time_ns,
        latitude: gga.latitude.unwrap_or(f64::NAN),
        longitude: gga.longitude.unwrap_or(f64::NAN),
        altitude: gga.altitude.unwrap_or(f32::NAN),
        hdop: gga.hdop.unwrap_or(f32::NAN),
        satellites: gga.fix_satellites.unwrap_or(0),
        quality: quality(gga.fix_type),
    }
}

fn fix_of_rmc(rmc: &RmcData, time_ns: u64) -> Fix {
    Fix {
        time_ns,
        latitude: rmc.lat.unwrap_or(f64::NAN),
        longitude: rmc.lon.unwrap_or(f64::NAN),
        altitude: f32::NAN,
        hdop: f32::NAN,
        satellites: 0,
        quality: u32::from(rmc.lat.is_some()),
    }
}

fn quality(fix: Option<FixType>) -> u32 {
    match fix {
        None | Some(FixType::Invalid) => 0,
        Some(FixType::Gps) => 1,
        Some(FixType::DGps) => 2,
        Some(FixType::Pps) => 3,
        Some(FixType::Rtk) => 4,
        Some(FixType::FloatRtk) => 5,
        Some(FixType::Estimated) => 6,
        Some(FixType::Manual) => 7,
        Some(FixType::Simulation) => 8,
    }
}

/// Whether the line is a sentence, but of a kind that the parser does not know.
fn is_foreign_sentence(fault: &nmea::Error<'_>) -> bool {
    matches!(
        fault,
        nmea::Error::Unsupported(_)
            | nmea::Error::Unknown(_)
            | nmea::Error::UnknownGnssType(_)
            | nmea::Error::UnknownTalkerId { .. }
            | nmea::Error::DisabledSentence
    )
}

/// Largest log, which is held in memory.
const MAX_BYTES: u64 = 256 << 20;
const USUAL_INTERVAL: Duration = Duration::from_secs(1);
const HALF_DAY_MS: i64 = 12 * 3_600 * 1_000;
const METRES_PER_SECOND_IN_A_KNOT: f32 = 1_852.0 / 3_600.0;

#[cfg(test)]
mod tests {
    use super::*;

    const SHIPPED: &[u8] = include_bytes!("../../deploy/data/gps.nmea");

    #[test]
    fn the_shipped_log_is_three_minutes_of_fixes_at_one_hertz() {
        let log = Log::parse(SHIPPED).unwrap();

        let fixes: Vec<_> = log
            .samples
            .iter()
            .filter_map(|(at, sample)| match sample {
                Sample::Fix(fix) => Some((at.as_secs(), *fix)),
                Sample::Satellites(_) | Sample::Speed(_) | Sample::Course(_) => None,
            })
            .collect();
        assert_eq!(log.bad_lines, 0);
        assert_eq!(fixes.len(), 181);
        assert_eq!(log.length, Duration::from_secs(181));
        let (at, first) = fixes[0];
        assert_eq!(at, 0);
        assert_eq!(first.quality, 2);
        assert_eq!(first.satellites, 8);
        assert_eq!(first.altitude, 2177.0);
        assert!((first.latitude - 55.096_563).abs() < 1e-6, "{first:?}");
        assert_eq!(first.time_ns / 1_000_000_000, 1_490_958_162);
    }

    #[test]
    fn bad_lines_are_counted_and_the_rest_is_used() {
        let mut log = b"garbage\r\n$GPGGA,110242,5505.793781,N,03856.742339,E,2,08,0.9,2177.0,M,14.0,M,,*00\r\n".to_vec();
        log.extend_from_slice(
            b"$GPGGA,110242,5505.793781,N,03856.742339,E,2,08,0.9,2177.0,M,14.0,M,,*74\r\n",
        );
        let log = Log::parse(&log).unwrap();

        assert_eq!(log.bad_lines, 2);
        assert_eq!(log.len(), 2);
    }

    #[test]
    fn empty_and_foreign_files_are_refused_by_name() {
        assert_eq!(Log::parse(b"\r\n \n").unwrap_err(), "is empty");
        assert_eq!(
            Log::parse(b"\x7fELF\nmore\n").unwrap_err(),
            "is no NMEA 0183 log: none of its 2 lines is a valid sentence"
        );
        let missing = Log::read(Path::new("/nonexistent/a.log")).unwrap_err();
        assert!(
            missing.to_string().contains("`/nonexistent/a.log`"),
            "{missing}"
        );
    }

    #[test]
    fn the_day_may_end_and_the_clock_may_jump_back() {
        let mut assembler = Assembler::default();
        for (hour, minute, second) in [(23, 59, 59), (0, 0, 1), (0, 0, 0), (0, 0, 1)] {
            assembler.advance(NaiveTime::from_hms_opt(hour, minute, second));
        }

        assert_eq!(assembler.elapsed, Duration::from_secs(3));
    }
}
