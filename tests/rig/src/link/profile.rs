//! Links by name: both directions of what joins one host to the rest, each with its table row and overrides.

use std::error;
use std::fmt;
use std::time::Duration;

use super::{BitsPerSecond, Config, Loss, units};
use crate::random::Random;

/// Both directions of one host's link.
///
/// The two ends of a path have a link each, so that between two hosts with one profile every figure counts twice;
/// give it to one of them for a path with the figures of the table.
///
/// | profile | rate | delay ± jitter, ms one way | loss |
/// |---|---|---|---|
/// | `lan` | 1 Gbit/s (the laboratory's wire carries less, see [`crate::lab`]) | 0.2 | 0 |
/// | `wifi-good` | 50 Mbit/s | 3 ± 2 | 0.5 % |
/// | `wifi-bad` | 10 Mbit/s | 15 ± 15 | 8 %, in bursts of mean 4 |
/// | `wifi-multicast-broken` | 50 Mbit/s; multicast down at 1 Mbit/s | 3 ± 2 | 0.5 %; multicast down 60 % |
/// | `lte` | 10 Mbit/s down, 3 Mbit/s up | 35 ± 15 | 0.5 % |
/// | `802.11b-200k` | 200 kbit/s | 10 ± 10 | 2 % |
/// | `lossy-33` | 5 Mbit/s | 10 | 33 % |
/// | `satellite` | 2 Mbit/s | 300 | 1 % |
///
/// Each has a queue of 100 ms. What a station sends to a group goes to its access point as unicast does, so that
/// only the way down treats multicast apart.
///
/// An override is a key and a value with its unit, in text `--key value`: `rate`, `delay`, `jitter`, `loss`,
/// `burst` (mean), `duplicate`, `reorder` (which needs jitter), `mtu`, `queue` (a time or a size),
/// `multicast-rate`, `multicast-loss` (both down only), all but the last two for both directions unless `up-` or
/// `down-` is put before the key; and `seed`, a number, 0 unless said. `rate none` lifts the limit.
#[derive(Clone, Debug, PartialEq)]
pub struct Profile {
    /// From the host.
    pub up: Config,
    /// To the host.
    pub down: Config,
    /// Decides what chance does.
    pub seed: u64,
    text: String,
}

/// Why a text is no profile.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Error {
    /// No profile has this name.
    UnknownName(String),
    /// No figure of a link has this key.
    UnknownKey(String),
    /// A value that is none of its key, or that contradicts another.
    Value {
        /// The key.
        key: String,
        /// Its value.
        value: String,
        /// What it should be.
        expected: &'static str,
    },
}

impl Profile {
    /// Reads a name and overrides, such as `lossy-33 --rate "200 kbit/s" --seed 7`; quotes may be left out.
    ///
    /// # Errors
    /// [`Error`] names what it does not know, and the nearest that it does.
    pub fn parse(text: &str) -> Result<Self, Error> {
        let mut parts = text.split("--").map(str::trim);
        let name = parts.next().unwrap_or_default();
        let overrides: Vec<(&str, &str)> = parts
            .map(|part| {
                let (key, value) = part.split_once([' ', '=']).unwrap_or((part, ""));
                (key, value.trim().trim_matches(['"', '\'']))
            })
            .collect();
        Self::new(name, &overrides)
    }

    /// Makes the profile of this name with overrides as keys (without the two hyphens) and values.
    ///
    /// # Errors
    /// As [`Profile::parse`].
    pub fn new(name: &str, overrides: &[(&str, &str)]) -> Result<Self, Error> {
        let (up, down) = named(name).ok_or_else(|| Error::UnknownName(name.to_owned()))?;
        let mut profile = Self {
            up,
            down,
            seed: 0,
            text: name.to_owned(),
        };
        for (key, value) in overrides {
            profile.set(key, value)?;
            profile.text.push_str(&format!(" --{key} \"{value}\""));
        }
        for (key, value) in overrides {
            profile.check(key, value)?;
        }
        Ok(profile)
    }

    /// Returns the names of all profiles.
    #[must_use]
    pub fn names() -> &'static [&'static str] {
        NAMES
    }

    /// Returns the seeds of both lines, up and down, of the host with this index.
    #[must_use]
    pub fn seeds(&self, host: usize) -> (u64, u64) {
        let host = u64::try_from(host).unwrap_or(u64::MAX);
        let mut seeds = Random::new(self.seed ^ Random::new(host).next());
        (seeds.next(), seeds.next())
    }

    fn set(&mut self, key: &str, value: &str) -> Result<(), Error> {
        let refuse = |expected| refusal(key, value, expected);
        if key == "seed" {
            self.seed = units::seed(value).map_err(refuse)?;
            return Ok(());
        }
        let (is_up, is_down, bare) = if let Some(bare) = key.strip_prefix("up-") {
            (true, false, bare)
        } else if let Some(bare) = key.strip_prefix("down-") {
            (false, true, bare)
        } else {
            (!key.starts_with("multicast-"), true, key)
        };
        if !KEYS.contains(&bare) {
            return Err(Error::UnknownKey(key.to_owned()));
        }
        if is_up {
            set(&mut self.up, bare, value).map_err(refuse)?;
        }
        if is_down {
            set(&mut self.down, bare, value).map_err(refuse)?;
        }
        Ok(())
    }

    /// Refuses an override that the others leave without meaning.
    fn check(&self, key: &str, value: &str) -> Result<(), Error> {
        for config in [&self.up, &self.down] {
            if key.ends_with("reorder") && config.reorder > 0.0 && config.jitter.is_zero() {
                return Err(refusal(
                    key,
                    value,
                    "with `--jitter`, which is what reorders",
                ));
            }
            let losses = [Some(config.loss), config.multicast_loss];
            let is_possible = |loss: &Loss| {
                loss.burst <= 1.0 || loss.share * (1.0 + loss.burst) <= loss.burst + EPSILON
            };
            let is_of_loss = key.ends_with("loss") || key.ends_with("burst");
            if is_of_loss && !losses.iter().flatten().all(is_possible) {
                let expected = "a loss of at most burst / (burst + 1)";
                return Err(refusal(key, value, expected));
            }
        }
        Ok(())
    }
}

/// The name and the overrides, as [`Profile::parse`] reads them.
impl fmt::Display for Profile {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.text)
    }
}

impl fmt::Display for Error {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::UnknownName(name) => {
                write!(f, "`{name}` is no link profile{}", hint(name, NAMES))
            }
            Self::UnknownKey(key) => write!(f, "`{key}` is no figure of a link{}", hint(key, KEYS)),
            Self::Value {
                key,
                value,
                expected,
            } => write!(f, "`--{key} {value}` should be {expected}"),
        }
    }
}

impl error::Error for Error {}

fn named(name: &str) -> Option<(Config, Config)> {
    let both = |config| Some((config, config));
    let wifi = link(50_000, 3_000, 2_000, Loss::random(0.005));
    match name {
        "lan" => both(link(1_000_000, 200, 0, Loss::NONE)),
        "wifi-good" => both(wifi),
        "wifi-bad" => {
            let loss = Loss {
                share: 0.08,
                burst: 4.0,
            };
            both(link(10_000, 15_000, 15_000, loss))
        }
        "wifi-multicast-broken" => {
            let down = Config {
                multicast_rate: Some(BitsPerSecond(1_000_000)),
                multicast_loss: Some(Loss::random(0.6)),
                ..wifi
            };
            Some((wifi, down))
        }
        "lte" => {
            let down = link(10_000, 35_000, 15_000, Loss::random(0.005));
            let rate = Some(BitsPerSecond(3_000_000));
            Some((Config { rate, ..down }, down))
        }
        "802.11b-200k" => both(link(200, 10_000, 10_000, Loss::random(0.02))),
        "lossy-33" => both(link(5_000, 10_000, 0, Loss::random(0.33))),
        "satellite" => both(link(2_000, 300_000, 0, Loss::random(0.01))),
        _ => None,
    }
}

fn link(rate_kbit: u64, delay_us: u64, jitter_us: u64, loss: Loss) -> Config {
    Config {
        rate: Some(BitsPerSecond(rate_kbit * 1_000)),
        delay: Duration::from_micros(delay_us),
        jitter: Duration::from_micros(jitter_us),
        loss,
        ..Config::default()
    }
}

fn set(config: &mut Config, key: &str, value: &str) -> Result<(), units::Expected> {
    match key {
        "rate" => config.rate = units::rate(value)?,
        "delay" => config.delay = units::time(value)?,
        "jitter" => config.jitter = units::time(value)?,
        "loss" => config.loss.share = units::share(value)?,
        "burst" => config.loss.burst = units::burst(value)?,
        "duplicate" => config.duplicate = units::share(value)?,
        "reorder" => config.reorder = units::share(value)?,
        "mtu" => config.mtu = Some(units::size(value)?),
        "queue" => config.queue = units::queue(value)?,
        "multicast-rate" => config.multicast_rate = units::rate(value)?,
        "multicast-loss" => config.multicast_loss = Some(Loss::random(units::share(value)?)),
        _ => return Err("a known key"),
    }
    Ok(())
}

fn refusal(key: &str, value: &str, expected: &'static str) -> Error {
    Error::Value {
        key: key.to_owned(),
        value: value.to_owned(),
        expected,
    }
}

/// Names the nearest of `known`, or all when none is near.
fn hint(word: &str, known: &[&str]) -> String {
    let nearest = known
        .iter()
        .map(|candidate| (edits(word, candidate), candidate))
        .min()
        .filter(|(edits, candidate)| *edits <= candidate.len().max(word.len()) / 2);
    match nearest {
        Some((_, nearest)) => format!(" (hint: did you mean `{nearest}`?)"),
        None => format!(" (hint: known are {})", known.join(", ")),
    }
}

/// Levenshtein distance.
fn edits(a: &str, b: &str) -> usize {
    let b: Vec<char> = b.chars().collect();
    let mut row: Vec<usize> = (0..=b.len()).collect();
    for (i, from) in a.chars().enumerate() {
        let mut next = vec![i + 1];
        for (j, to) in b.iter().enumerate() {
            let swap = row[j] + usize::from(from != *to);
            next.push(swap.min(row[j + 1] + 1).min(next[j] + 1));
        }
        row = next;
    }
    row.last().copied().unwrap_or_default()
}

const NAMES: &[&str] = &[
    "lan",
    "wifi-good",
    "wifi-bad",
    "wifi-multicast-broken",
    "lte",
    "802.11b-200k",
    "lossy-33",
    "satellite",
];

const KEYS: &[&str] = &[
    "rate",
    "delay",
    "jitter",
    "loss",
    "burst",
    "duplicate",
    "reorder",
    "mtu",
    "queue",
    "multicast-rate",
    "multicast-loss",
    "seed",
];

/// Two decimal fractions may miss each other by the last bit.
const EPSILON: f64 = 1e-9;
