//! Names of items and hosts, and patterns over them: parsed once, then they cannot be wrong.
//!
//! A name is slash-separated UTF-8 chunks, at most 255 bytes: `robot1/front/cam`. By syntax alone, a name of one chunk
//! and one that begins with `./` lie under this host's prefix; any other name is absolute. A leading slash is stripped.
//! Chunks that begin with `@` are administrative. `* ? # $ ~ = &` are reserved.

use std::borrow::Cow;
use std::fmt;

use serde::{Deserialize, Serialize};
use thiserror::Error;

/// Longest name or pattern, bytes.
const NAME_MAX_BYTES: usize = 255;
/// Longest host name, bytes: leaves room for a path below it and equals the limit of a DNS label.
const HOST_MAX_BYTES: usize = 63;
const RESERVED: &[char] = &['*', '?', '#', '$', '~', '=', '&'];

/// Why a text is not a name.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[non_exhaustive]
pub enum NameError {
    /// Nothing is left of it.
    #[error("name is empty")]
    Empty,
    /// Two slashes in a row, or one at the end.
    #[error("name `{0}` has an empty chunk")]
    EmptyChunk(String),
    /// Longer than the limit; the length in bytes and the limit.
    #[error("name of {0} bytes is longer than {1}")]
    TooLong(usize, usize),
    /// A reserved or control character.
    #[error("name `{0}` contains {1:?}, which is reserved")]
    Reserved(String, char),
    /// `.` or `..` as a chunk elsewhere than a leading `./`.
    #[error("name `{0}` has a chunk of dots: only a leading `./` is known")]
    Dots(String),
    /// A host's name is one chunk.
    #[error("host name `{0}` has more than one chunk")]
    ManyChunks(String),
    /// A host's name is not administrative.
    #[error("host name `{0}` begins with `@`")]
    Admin(String),
}

/// Why a text is not a pattern.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[non_exhaustive]
pub enum PatternError {
    /// A chunk that is neither a wildcard nor fit for a name.
    #[error(transparent)]
    Name(#[from] NameError),
    /// A wildcard is a whole chunk.
    #[error("pattern `{0}` mixes `*` with other characters in one chunk")]
    PartialWildcard(String),
}

/// The full, canonical name of an item: host prefix first, except for administrative names, which are each host's own.
#[derive(Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct ItemName(String);

/// The one-chunk name of a host, which is the prefix of its items.
#[derive(Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct HostName(String);

/// A name in which `*` stands for one chunk and `**` for any number, including none.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Pattern {
    chunks: Vec<Chunk>,
}

#[derive(Clone, Debug, PartialEq, Eq)]
enum Chunk {
    One,
    Any,
    Exact(String),
}

impl ItemName {
    /// Parses what a person or program wrote on the host called `host`.
    pub fn parse(text: &str, host: &HostName) -> Result<Self, NameError> {
        let absolute = to_absolute(text, host);
        check_item(&absolute)?;
        Ok(Self(absolute.into_owned()))
    }

    /// The canonical text.
    pub fn as_str(&self) -> &str {
        &self.0
    }

    /// The first chunk: the host's prefix, or `@` for an administrative name.
    pub fn prefix(&self) -> &str {
        self.0.split_once('/').map_or(&self.0, |(first, _)| first)
    }

    /// Whether the name lies under `host`'s prefix.
    pub fn is_under(&self, host: &HostName) -> bool {
        self.prefix() == host.as_str()
    }

    /// Whether some chunk is administrative.
    pub fn is_admin(&self) -> bool {
        self.0.split('/').any(|chunk| chunk.starts_with('@'))
    }

    /// The same item seen under another prefix, as when two hosts hold one prefix.
    pub fn with_prefix(&self, prefix: &str) -> Result<Self, NameError> {
        let rest = self.0.split_once('/').map_or("", |(_, rest)| rest);
        let text = format!("{prefix}/{rest}");
        if text.len() > NAME_MAX_BYTES {
            return Err(NameError::TooLong(text.len(), NAME_MAX_BYTES));
        }
        Ok(Self(text))
    }
}

impl HostName {
    /// Parses the name of a host.
    pub fn parse(text: &str) -> Result<Self, NameError> {
        if text.len() > HOST_MAX_BYTES {
            return Err(NameError::TooLong(text.len(), HOST_MAX_BYTES));
        }
        if text.contains('/') {
            return Err(NameError::ManyChunks(text.to_owned()));
        }
        if text.starts_with('@') {
            return Err(NameError::Admin(text.to_owned()));
        }
        check(text)?;
        Ok(Self(text.to_owned()))
    }

    /// Makes a host name of any text, such as the system's host name: what is not allowed becomes `-`.
    pub fn sanitised(text: &str) -> Self {
        let mut name: String = text
            .trim_start_matches(['@', '.'])
            .chars()
            .map(|c| {
                if c == '/'
                    || c == '.'
                    || RESERVED.contains(&c)
                    || c.is_control()
                    || c.is_whitespace()
                {
                    '-'
                } else {
                    c
                }
            })
            .collect();
        while name.len() > HOST_MAX_BYTES {
            name.pop();
        }
        Self::parse(&name).unwrap_or_else(|_| Self("host".to_owned()))
    }

    /// The text.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl Pattern {
    /// Parses a pattern as written on the host called `host`; the rules for prefixes are those of names, except that
    /// a pattern which begins with a wildcard is absolute.
    pub fn parse(text: &str, host: &HostName) -> Result<Self, PatternError> {
        let absolute = if text.starts_with('*') {
            Cow::Borrowed(text)
        } else {
            to_absolute(text, host)
        };
        if absolute.len() > NAME_MAX_BYTES {
            return Err(NameError::TooLong(absolute.len(), NAME_MAX_BYTES).into());
        }
        let chunks = absolute
            .split('/')
            .map(|chunk| match chunk {
                "*" => Ok(Chunk::One),
                "**" => Ok(Chunk::Any),
                _ if chunk.contains('*') => Err(PatternError::PartialWildcard(text.to_owned())),
                _ => check(chunk)
                    .map(|()| Chunk::Exact(chunk.to_owned()))
                    .map_err(PatternError::Name),
            })
            .collect::<Result<_, _>>()?;
        Ok(Self { chunks })
    }

    /// The pattern that matches each name without administrative chunks.
    pub fn everything() -> Self {
        Self {
            chunks: vec![Chunk::Any],
        }
    }

    /// The one name that it can match, when there is no wildcard in it.
    pub fn literal(&self) -> Option<ItemName> {
        let chunks: Option<Vec<&str>> = self
            .chunks
            .iter()
            .map(|chunk| match chunk {
                Chunk::Exact(text) => Some(text.as_str()),
                Chunk::One | Chunk::Any => None,
            })
            .collect();
        chunks.map(|chunks| ItemName(chunks.join("/")))
    }

    /// Whether `name` fits. Administrative chunks fit only themselves and `*` never stands for them.
    pub fn matches(&self, name: &ItemName) -> bool {
        let name: Vec<&str> = name.as_str().split('/').collect();
        // Iterative, with one point of return: the classic two-pointer match, linear times the last `**`.
        let (mut p, mut n) = (0_usize, 0_usize);
        let mut back: Option<(usize, usize)> = None;
        while let Some(&chunk) = name.get(n) {
            let admin = chunk.starts_with('@');
            let step = match self.chunks.get(p) {
                Some(Chunk::Any) => {
                    back = Some((p, n));
                    p = p.saturating_add(1);
                    continue;
                }
                Some(Chunk::One) => !admin,
                Some(Chunk::Exact(text)) => text == chunk,
                None => false,
            };
            if step {
                p = p.saturating_add(1);
                n = n.saturating_add(1);
                continue;
            }
            let Some((any, from)) = back else {
                return false;
            };
            if name.get(from).is_some_and(|eaten| eaten.starts_with('@')) {
                return false;
            }
            p = any.saturating_add(1);
            n = from.saturating_add(1);
            back = Some((any, n));
        }
        self.chunks.iter().skip(p).all(|chunk| *chunk == Chunk::Any)
    }
}

fn to_absolute<'a>(text: &'a str, host: &HostName) -> Cow<'a, str> {
    let text = text.strip_prefix('/').unwrap_or(text);
    if let Some(rest) = text.strip_prefix("./") {
        return Cow::Owned(format!("{}/{rest}", host.as_str()));
    }
    if text.is_empty() || text.contains('/') {
        return Cow::Borrowed(text);
    }
    Cow::Owned(format!("{}/{text}", host.as_str()))
}

/// Checks a full item name. `~` is allowed in its first chunk alone: it marks a host that lost its prefix to another.
fn check_item(text: &str) -> Result<(), NameError> {
    match text.split_once('/') {
        Some((first, _)) if first.contains('~') => check(&text.replacen('~', "-", 1)),
        _ => check(text),
    }
}

fn check(text: &str) -> Result<(), NameError> {
    if text.is_empty() {
        return Err(NameError::Empty);
    }
    if text.len() > NAME_MAX_BYTES {
        return Err(NameError::TooLong(text.len(), NAME_MAX_BYTES));
    }
    if let Some(bad) = text
        .chars()
        .find(|c| RESERVED.contains(c) || c.is_control())
    {
        return Err(NameError::Reserved(text.to_owned(), bad));
    }
    for chunk in text.split('/') {
        match chunk {
            "" => return Err(NameError::EmptyChunk(text.to_owned())),
            "." | ".." => return Err(NameError::Dots(text.to_owned())),
            _ => {}
        }
    }
    Ok(())
}

impl TryFrom<String> for ItemName {
    type Error = NameError;

    /// Accepts a canonical name only: what travels was parsed before.
    fn try_from(text: String) -> Result<Self, NameError> {
        check_item(&text)?;
        Ok(Self(text))
    }
}

impl From<ItemName> for String {
    fn from(name: ItemName) -> Self {
        name.0
    }
}

impl TryFrom<String> for HostName {
    type Error = NameError;

    fn try_from(text: String) -> Result<Self, NameError> {
        Self::parse(&text)
    }
}

impl From<HostName> for String {
    fn from(name: HostName) -> Self {
        name.0
    }
}

impl fmt::Display for ItemName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl fmt::Debug for ItemName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "ItemName({})", self.0)
    }
}

impl fmt::Display for HostName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl fmt::Debug for HostName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "HostName({})", self.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn host() -> HostName {
        HostName::parse("robot1").unwrap()
    }

    fn name(text: &str) -> ItemName {
        ItemName::parse(text, &host()).unwrap()
    }

    #[test]
    fn syntax_alone_decides_the_prefix() {
        for (text, full) in [
            ("gps", "robot1/gps"),
            ("/gps", "robot1/gps"),
            ("./front/cam", "robot1/front/cam"),
            ("front/cam", "front/cam"),
            ("/base/x", "base/x"),
            ("@/hosts", "@/hosts"),
        ] {
            assert_eq!(name(text).as_str(), full, "{text}");
        }
    }

    #[test]
    fn bad_names_say_why() {
        let parse = |text: &str| ItemName::parse(text, &host()).unwrap_err();
        assert_eq!(parse(""), NameError::Empty);
        assert!(matches!(parse("a//b"), NameError::EmptyChunk(_)));
        assert!(matches!(parse("a/b/"), NameError::EmptyChunk(_)));
        assert!(matches!(parse("a/../b"), NameError::Dots(_)));
        assert!(matches!(parse("a/b*"), NameError::Reserved(_, '*')));
        assert!(matches!(parse("a/b\n"), NameError::Reserved(_, '\n')));
        assert!(matches!(
            parse(&"x/".repeat(200)),
            NameError::TooLong(400, 255)
        ));
    }

    #[test]
    fn patterns_match_as_the_field_expects() {
        let cases = [
            ("**", "robot1/gps", true),
            ("**", "a/b/c/d", true),
            ("**", "@/hosts", false),
            ("@/**", "@/hosts", true),
            ("robot1/*", "robot1/gps", true),
            ("robot1/*", "robot1/front/cam", false),
            ("robot1/*", "robot1/@x", false),
            ("robot1/**", "robot1/front/cam", true),
            ("*/gps", "robot2/gps", true),
            ("**/cam", "robot1/front/cam", true),
            ("**/cam", "robot1/front/cam/info", false),
            ("robot1/**/x", "robot1/x", true),
            ("**/x/**/y", "a/x/b/x/c/y", true),
            ("gps", "robot1/gps", true),
            ("gps", "robot2/gps", false),
            ("**", "a/@b/c", false),
        ];
        for (pattern, text, fits) in cases {
            let pattern = Pattern::parse(pattern, &host()).unwrap();
            assert_eq!(pattern.matches(&name(text)), fits, "{pattern:?} on {text}");
        }
    }

    #[test]
    fn half_a_wildcard_is_refused() {
        assert!(matches!(
            Pattern::parse("a/b*", &host()),
            Err(PatternError::PartialWildcard(_))
        ));
    }

    #[test]
    fn host_names_are_one_clean_chunk() {
        assert!(matches!(
            HostName::parse("a/b"),
            Err(NameError::ManyChunks(_))
        ));
        assert_eq!(
            HostName::sanitised("My Robot.local").as_str(),
            "My-Robot-local"
        );
        assert_eq!(HostName::sanitised("").as_str(), "host");
        assert!(HostName::sanitised(&"ü".repeat(80)).as_str().len() <= 63);
    }

    #[test]
    fn a_travelling_name_is_checked_again() {
        assert!(ItemName::try_from("robot1~4f2a/gps".to_owned()).is_ok());
        assert_eq!(name("robot1~4f2a/gps").prefix(), "robot1~4f2a");
        assert!(ItemName::try_from("robot1/g~ps".to_owned()).is_err());
        assert!(ItemName::try_from("a~b~c/gps".to_owned()).is_err());
        assert!(ItemName::try_from("a//b".to_owned()).is_err());
        assert!(ItemName::try_from("x".repeat(256)).is_err());
    }
}
