//! Configuration: a TOML file, then the environment (`DDX_…`), then flags; the later wins.
//!
//! [`KEYS`] is the one list of keys; the file `deploy/ddx.toml` documents it and a test holds the two equal.

use std::path::{Path, PathBuf};

use ddx_store::Quotas;
use ddx_wire::{Contract, HostName};
use toml::Value;

use crate::error::{Failure, Hint as _};
use crate::units;

/// Everything that `ddx up` can be told.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Config {
    /// Name of this host: the prefix of its items.
    pub host: HostName,
    /// Hosts of different domains do not see each other.
    pub domain: u16,
    /// File with the domain key; without one nothing is sent or listened to on any network.
    pub key: Option<PathBuf>,
    /// Path of the daemon's socket; by default below the run directory.
    pub socket: Option<PathBuf>,
    /// Interfaces to use, by name or address; empty is each that is up.
    pub iface: Vec<String>,
    /// Hosts to ask at the start, as `udp/host:port`.
    pub join: Vec<String>,
    /// Whether to look for hosts by multicast.
    pub beacon: bool,
    /// Whether samples may travel by multicast.
    pub multicast: bool,
    /// UDP port of the control socket; 0 lets the system choose. Hosts that others name in `join` want a fixed one.
    pub control_port: u16,
    /// UDP port for samples; 0 lets the system choose.
    pub data_port: u16,
    /// Whether the threads that carry samples poll instead of sleeping.
    pub spin: bool,
    /// What each program may take.
    pub quotas: Quotas,
}

/// One key of the configuration.
#[derive(Debug)]
pub struct Key {
    /// Name in the file; the environment has it as `DDX_` and capitals.
    pub name: &'static str,
    /// What a value must look like.
    kind: Kind,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Kind {
    Text,
    Count,
    Flag,
    List,
    Rate,
    Size,
}

/// All keys, in the order of `deploy/ddx.toml`.
pub const KEYS: &[Key] = &[
    Key {
        name: "host",
        kind: Kind::Text,
    },
    Key {
        name: "domain",
        kind: Kind::Count,
    },
    Key {
        name: "key",
        kind: Kind::Text,
    },
    Key {
        name: "socket",
        kind: Kind::Text,
    },
    Key {
        name: "iface",
        kind: Kind::List,
    },
    Key {
        name: "join",
        kind: Kind::List,
    },
    Key {
        name: "beacon",
        kind: Kind::Flag,
    },
    Key {
        name: "multicast",
        kind: Kind::Flag,
    },
    Key {
        name: "control_port",
        kind: Kind::Count,
    },
    Key {
        name: "data_port",
        kind: Kind::Count,
    },
    Key {
        name: "spin",
        kind: Kind::Flag,
    },
    Key {
        name: "clients",
        kind: Kind::Count,
    },
    Key {
        name: "client_items",
        kind: Kind::Count,
    },
    Key {
        name: "client_memory",
        kind: Kind::Size,
    },
    Key {
        name: "client_readers",
        kind: Kind::Count,
    },
    Key {
        name: "client_files",
        kind: Kind::Count,
    },
    Key {
        name: "client_requests",
        kind: Kind::Rate,
    },
    Key {
        name: "client_replies",
        kind: Kind::Count,
    },
];

impl Default for Config {
    fn default() -> Self {
        Self {
            host: system_host(),
            domain: 0,
            key: None,
            socket: None,
            iface: Vec::new(),
            join: Vec::new(),
            beacon: true,
            multicast: true,
            control_port: 0,
            data_port: 0,
            spin: false,
            quotas: Quotas::default(),
        }
    }
}

impl Config {
    /// Reads the file, if one is named or lies at the usual place, and then the environment.
    ///
    /// # Errors
    /// Names the file or variable, the key, and the nearest known key when it is unknown.
    pub fn load(file: Option<&Path>) -> Result<Self, Failure> {
        let mut config = Self::default();
        let usual = Path::new(USUAL_FILE);
        if let Some(path) = file.or_else(|| usual.exists().then_some(usual)) {
            let text = std::fs::read_to_string(path).map_err(|e| {
                Failure::arguments(format!("cannot read `{}`: {e}", path.display()))
            })?;
            config.apply_toml(&text, &format!("`{}`", path.display()))?;
        }
        config.apply_environment(std::env::vars_os().filter_map(|(name, value)| {
            Some((name.into_string().ok()?, value.into_string().ok()?))
        }))?;
        Ok(config)
    }

    /// Sets each key of a TOML text; `origin` names it in errors.
    ///
    /// # Errors
    /// Fails at the first fault; keys before it are set.
    pub fn apply_toml(&mut self, text: &str, origin: &str) -> Result<(), Failure> {
        let table: toml::Table = text
            .parse()
            .map_err(|e: toml::de::Error| Failure::arguments(format!("{origin}: {e}")))?;
        for (name, value) in &table {
            let key = find(name, origin)?;
            self.apply(key, value)
                .map_err(|fault| Failure::arguments(format!("{origin}: `{name}`: {fault}")))?;
        }
        Ok(())
    }

    /// Sets each key that a variable `DDX_<KEY>` names. Other `DDX_` variables are for other readers and left alone.
    ///
    /// # Errors
    /// Names the variable whose value makes no sense.
    pub fn apply_environment(
        &mut self,
        variables: impl Iterator<Item = (String, String)>,
    ) -> Result<(), Failure> {
        for (variable, text) in variables {
            let Some(key) = KEYS.iter().find(|key| key.variable() == variable) else {
                continue;
            };
            if text.is_empty() {
                continue;
            }
            key.value(&text)
                .and_then(|value| self.apply(key, &value))
                .map_err(|fault| Failure::arguments(format!("{variable}: {fault}")))?;
        }
        Ok(())
    }

    fn apply(&mut self, key: &Key, value: &Value) -> Result<(), String> {
        match key.name {
            "host" => {
                let name = text(value)?;
                self.host = if name.is_empty() {
                    system_host()
                } else {
                    HostName::parse(name).map_err(|e| e.to_string())?
                };
            }
            "domain" => self.domain = count(value)?,
            "key" => self.key = path(value)?,
            "socket" => self.socket = path(value)?,
            "iface" => self.iface = list(value)?,
            "join" => self.join = list(value)?,
            "beacon" => self.beacon = flag(value)?,
            "multicast" => self.multicast = flag(value)?,
            "control_port" => self.control_port = count(value)?,
            "data_port" => self.data_port = count(value)?,
            "spin" => self.spin = flag(value)?,
            "clients" => self.quotas.clients = count(value)?,
            "client_items" => self.quotas.items = count(value)?,
            "client_memory" => self.quotas.bytes = size(value)?,
            "client_readers" => self.quotas.cells = count(value)?,
            "client_files" => self.quotas.fds = count(value)?,
            "client_requests" => self.quotas.messages_per_second = per_second(value)?,
            "client_replies" => self.quotas.queued_replies = count(value)?,
            other => return Err(format!("key `{other}` is not handled")),
        }
        Ok(())
    }
}

impl Key {
    /// The environment variable of the key.
    pub fn variable(&self) -> String {
        format!("DDX_{}", self.name.to_uppercase())
    }

    /// Reads the text of a variable as the value that the file would have.
    fn value(&self, text: &str) -> Result<Value, String> {
        Ok(match self.kind {
            Kind::Text | Kind::Rate | Kind::Size => Value::String(text.to_owned()),
            Kind::Count => Value::Integer(
                text.parse()
                    .map_err(|_not| format!("`{text}` is not a whole number"))?,
            ),
            Kind::Flag => match text {
                "true" | "1" => Value::Boolean(true),
                "false" | "0" => Value::Boolean(false),
                other => return Err(format!("`{other}` is neither true nor false")),
            },
            Kind::List => Value::Array(
                text.split(',')
                    .map(|entry| Value::String(entry.trim().to_owned()))
                    .collect(),
            ),
        })
    }
}

/// The candidate that is fewest edits away from `word`, when that is close enough to be meant.
pub fn nearest<'a>(word: &str, candidates: impl Iterator<Item = &'a str>) -> Option<&'a str> {
    candidates
        .map(|candidate| (edits(word, candidate), candidate))
        .min()
        .filter(|(distance, candidate)| *distance <= candidate.len().max(word.len()) / 2)
        .map(|(_, candidate)| candidate)
}

/// The system's host name, made a host name of ours.
fn system_host() -> HostName {
    let name = std::fs::read_to_string("/proc/sys/kernel/hostname").unwrap_or_default();
    HostName::sanitised(name.trim())
}

fn find(name: &str, origin: &str) -> Result<&'static Key, Failure> {
    KEYS.iter().find(|key| key.name == name).map_or_else(
        || {
            let known = nearest(name, KEYS.iter().map(|key| key.name));
            Err(Failure::new(format!("{origin}: unknown key `{name}`")))
                .hint(|| match known {
                    Some(known) => format!("did you mean `{known}`?"),
                    None => format!("known keys: {}", names().join(", ")),
                })
                .arguments()
        },
        Ok,
    )
}

fn names() -> Vec<&'static str> {
    KEYS.iter().map(|key| key.name).collect()
}

fn text(value: &Value) -> Result<&str, String> {
    value.as_str().ok_or_else(|| expected("a text", value))
}

fn path(value: &Value) -> Result<Option<PathBuf>, String> {
    let text = text(value)?;
    Ok((!text.is_empty()).then(|| PathBuf::from(text)))
}

fn list(value: &Value) -> Result<Vec<String>, String> {
    value
        .as_array()
        .and_then(|entries| {
            entries
                .iter()
                .map(|e| e.as_str().map(str::to_owned))
                .collect()
        })
        .ok_or_else(|| expected("a list of texts", value))
}

fn count<T: TryFrom<i64>>(value: &Value) -> Result<T, String> {
    let number = value
        .as_integer()
        .ok_or_else(|| expected("a whole number", value))?;
    T::try_from(number).map_err(|_range| format!("{number} is out of range"))
}

fn flag(value: &Value) -> Result<bool, String> {
    value
        .as_bool()
        .ok_or_else(|| expected("true or false", value))
}

fn size(value: &Value) -> Result<u64, String> {
    units::size(with_unit(value, "a size", "64 KiB")?)
}

fn per_second(value: &Value) -> Result<u32, String> {
    let text = with_unit(value, "a rate", "20 kHz")?;
    let mhz = Contract::at_most_hz(units::rate(text)?).and_then(|rate| rate.max_rate_mhz);
    Ok(mhz.map_or(1, |mhz| mhz.div_ceil(1_000)))
}

/// The text of a value that has a unit, whose parser knows which.
fn with_unit<'a>(value: &'a Value, what: &str, example: &str) -> Result<&'a str, String> {
    let bare = value.is_integer()
        || value.is_float()
        || value
            .as_str()
            .is_some_and(|text| text.parse::<f64>().is_ok());
    if bare {
        return Err(format!(
            "{value} has no unit: write {what} as \"{example}\""
        ));
    }
    value.as_str().ok_or_else(|| expected(what, value))
}

fn expected(what: &str, value: &Value) -> String {
    format!("{what} expected, {} found", value.type_str())
}

/// Levenshtein distance, characters.
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

/// Read when `--config` names no other.
const USUAL_FILE: &str = "/etc/ddx/ddx.toml";

#[cfg(test)]
mod tests {
    use super::*;

    const SHIPPED: &str = include_str!("../deploy/ddx.toml");

    #[test]
    fn the_shipped_file_states_each_key_once_with_its_default() {
        let mut config = Config {
            domain: 9,
            beacon: false,
            multicast: false,
            control_port: 9,
            data_port: 9,
            spin: true,
            quotas: Quotas {
                clients: 9,
                items: 9,
                bytes: 9,
                cells: 9,
                fds: 9,
                messages_per_second: 9,
                queued_replies: 9,
            },
            iface: vec!["x".to_owned()],
            join: vec!["x".to_owned()],
            key: Some(PathBuf::from("x")),
            socket: Some(PathBuf::from("x")),
            host: HostName::sanitised("x"),
        };
        let stated: Vec<_> = SHIPPED
            .lines()
            .filter_map(|line| line.split_once(" = "))
            .filter(|(key, _)| !key.starts_with('#'))
            .map(|(key, _)| key)
            .collect();

        config.apply_toml(SHIPPED, "ddx.toml").unwrap();

        assert_eq!(stated, names());
        assert_eq!(config, Config::default());
    }

    #[test]
    fn an_unknown_key_is_refused_with_the_nearest_known_one() {
        let refused = Config::default()
            .apply_toml("domian = 3", "`a.toml`")
            .unwrap_err();

        assert_eq!(
            refused.to_string(),
            "error: `a.toml`: unknown key `domian`\nhint: did you mean `domain`?"
        );
    }

    #[test]
    fn a_bare_size_is_refused_with_an_example() {
        let refused = Config::default()
            .apply_toml("client_memory = 4096", "`a.toml`")
            .unwrap_err();

        assert_eq!(
            refused.to_string(),
            "error: `a.toml`: `client_memory`: 4096 has no unit: write a size as \"64 KiB\""
        );
    }

    #[test]
    fn the_environment_wins_over_the_file_and_ignores_what_is_not_a_key() {
        let mut config = Config::default();
        config
            .apply_toml("domain = 3\njoin = ['udp/a:1']", "file")
            .unwrap();
        let variables = [
            ("DDX_DOMAIN", "7"),
            ("DDX_IFACE", "eth0, wlan0"),
            ("DDX_NOTES", "x"),
        ];

        config
            .apply_environment(
                variables
                    .into_iter()
                    .map(|(n, v)| (n.to_owned(), v.to_owned())),
            )
            .unwrap();

        assert_eq!(config.domain, 7);
        assert_eq!(config.iface, ["eth0", "wlan0"]);
        assert_eq!(config.join, ["udp/a:1"]);
    }

    #[test]
    fn a_bad_variable_is_named() {
        let variables = [("DDX_DOMAIN".to_owned(), "70000".to_owned())];

        let refused = Config::default()
            .apply_environment(variables.into_iter())
            .unwrap_err();

        assert_eq!(
            refused.to_string(),
            "error: DDX_DOMAIN: 70000 is out of range"
        );
    }
}
