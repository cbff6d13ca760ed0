//! The door for applications: one connection to the daemon of one host and domain, and what can be asked of it.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use ddx_wire::{HostName, Pattern};

use crate::connection::{Connection, TIMEOUT, program_name};
use crate::control::{Description, ItemEntry, Purpose, Reply, Request};
use crate::error::Error;
use crate::item::Item;
use crate::reader::{RawReader, Reader, ReaderOptions};
use crate::schema::Schema;
use crate::server::{Config, Server, run_dir};
use crate::socket;
use crate::writer::{RawWriter, Writer, WriterOptions};

/// A connection to the daemon of one host and domain. Clones share it.
///
/// Opening anything asks the daemon. Reading and writing through an opened handle does not: it goes on when the daemon is
/// gone, and when a new one comes, calls that block find it and register their program's handles there.
#[derive(Clone, Debug)]
pub struct Store {
    connection: Arc<Connection>,
}

/// How to open a [`Store`].
#[derive(Clone, Debug)]
pub struct Options {
    socket: Option<PathBuf>,
    timeout: Duration,
    program: String,
}

impl Store {
    /// Opens the store at `DDX_SOCKET`, else at the only daemon of this machine. Blocks until that answers, at most 5 s.
    pub fn open() -> Result<Self, Error> {
        Self::options().open()
    }

    /// Says which daemon to open, and how.
    pub fn options() -> Options {
        Options {
            socket: None,
            timeout: TIMEOUT,
            program: program_name(),
        }
    }

    /// A daemon inside this process, for tests and single programs: the caller runs the server on a thread of its own,
    /// and nothing is answered before.
    pub fn embedded(config: Config) -> Result<(Self, Server), Error> {
        let mut server = Server::bind(config)?;
        let connection = server.adopt_own()?;
        Ok((Self::over(connection), server))
    }

    pub(crate) fn connection(&self) -> Arc<Connection> {
        Arc::clone(&self.connection)
    }

    pub(crate) fn over(connection: Connection) -> Self {
        Self {
            connection: Arc::new(connection),
        }
    }

    /// Name of the daemon's host: the prefix of its items.
    pub fn host(&self) -> &HostName {
        self.connection.host()
    }

    /// Number of the daemon's domain.
    pub fn domain(&self) -> u16 {
        self.connection.domain()
    }

    /// The daemon's socket; none inside its process.
    pub fn socket(&self) -> Option<&Path> {
        self.connection.path()
    }

    /// Opens the writer of an item of type `T`. Fails when another program writes it, and names that program.
    pub fn writer<T: Item>(&self, name: &str) -> Result<Writer<T>, Error> {
        self.writer_with(name, WriterOptions::default())
    }

    /// The same with options.
    pub fn writer_with<T: Item>(
        &self,
        name: &str,
        options: WriterOptions,
    ) -> Result<Writer<T>, Error> {
        let raw = self.raw_writer(name, &T::schema(), options)?;
        Ok(Writer::new(raw))
    }

    /// Opens a reader of an item of type `T`, which need not exist yet. Fails when it exists with another schema, and
    /// names the first field that differs.
    pub fn reader<T: Item>(&self, name: &str) -> Result<Reader<T>, Error> {
        self.reader_with(name, ReaderOptions::default())
    }

    /// The same with options.
    pub fn reader_with<T: Item>(
        &self,
        name: &str,
        options: ReaderOptions,
    ) -> Result<Reader<T>, Error> {
        let raw = self.raw_reader(name, Some(&T::schema()), options)?;
        Ok(Reader::new(raw))
    }

    /// Opens the writer of an item by its schema, for payloads of bytes.
    pub fn raw_writer(
        &self,
        name: &str,
        schema: &Schema,
        options: WriterOptions,
    ) -> Result<RawWriter, Error> {
        RawWriter::open(&self.connection, name, schema, options, Purpose::Write)
    }

    /// Opens a reader for payloads of bytes. Without a schema it takes any.
    pub fn raw_reader(
        &self,
        name: &str,
        schema: Option<&Schema>,
        options: ReaderOptions,
    ) -> Result<RawReader, Error> {
        RawReader::open(&self.connection, name, schema, options)
    }

    /// The items that match, of this host and of others, by name. Blocks until the daemon answers.
    pub fn list(&self, pattern: &Pattern) -> Result<Vec<ItemEntry>, Error> {
        let mut all = Vec::new();
        let mut after = String::new();
        loop {
            let request = Request::List { after };
            let (entries, more) = match self.connection.request(request, &[])? {
                (Reply::Entries { entries, more }, _) => (entries, more),
                (other, _) => return Err(unexpected(&other)),
            };
            let Some(last) = entries.last() else {
                return Ok(all);
            };
            after = last.name.to_string();
            all.extend(
                entries
                    .into_iter()
                    .filter(|entry| pattern.matches(&entry.name)),
            );
            if !more {
                return Ok(all);
            }
        }
    }

    /// One item in full. Fails when there is none of this name. Blocks until the daemon answers.
    pub fn describe(&self, name: &str) -> Result<Description, Error> {
        let name = name.to_owned();
        match self.connection.request(Request::Describe { name }, &[])? {
            (Reply::Description(description), _) => Ok(*description),
            (other, _) => Err(unexpected(&other)),
        }
    }

    /// Leaves one value with the daemon, which is its writer of record until a program takes over. Fails while a program
    /// writes the item. Blocks until the daemon answers.
    pub fn put(&self, name: &str, schema: &Schema, payload: &[u8]) -> Result<(), Error> {
        let options = WriterOptions {
            capacity_bytes: Some(u32::try_from(payload.len()).unwrap_or(u32::MAX)),
            ..WriterOptions::default()
        };
        RawWriter::put(&self.connection, name, schema, options, payload)
    }

    /// Removes an item that no program writes. Its readers are told, and wait for the next one of this name. Blocks until
    /// the daemon answers.
    pub fn remove(&self, name: &str) -> Result<(), Error> {
        let name = name.to_owned();
        match self.connection.request(Request::Remove { name }, &[])? {
            (Reply::Done, _) => Ok(()),
            (other, _) => Err(unexpected(&other)),
        }
    }
}

impl Options {
    /// The daemon's socket, in place of `DDX_SOCKET` and of looking for it.
    #[must_use]
    pub fn socket(mut self, path: impl Into<PathBuf>) -> Self {
        self.socket = Some(path.into());
        self
    }

    /// How long to wait for a daemon; 5 s unless said.
    #[must_use]
    pub fn timeout(mut self, timeout: Duration) -> Self {
        self.timeout = timeout;
        self
    }

    /// Name by which others see this program; by default that of its file.
    #[must_use]
    pub fn program(mut self, name: &str) -> Self {
        name.clone_into(&mut self.program);
        self
    }

    /// Opens the store. Blocks until its daemon answers, at most the timeout.
    pub fn open(self) -> Result<Store, Error> {
        let deadline = Instant::now() + self.timeout;
        let path = self
            .socket
            .or_else(|| std::env::var_os("DDX_SOCKET").map(PathBuf::from));
        loop {
            let attempt = match &path {
                Some(path) => Connection::open(path, &self.program),
                None => only_socket().and_then(|path| Connection::open(&path, &self.program)),
            };
            match attempt {
                Ok(connection) => return Ok(Store::over(connection)),
                Err(Error::NoDaemon { .. } | Error::NoSocket { .. } | Error::Gone)
                    if Instant::now() < deadline =>
                {
                    std::thread::sleep(RETRY);
                }
                Err(error) => return Err(error),
            }
        }
    }
}

/// The socket of the only daemon that runs here. Sockets that dead ones have left do not count.
fn only_socket() -> Result<PathBuf, Error> {
    let dir = run_dir();
    let domains = std::fs::read_dir(&dir).into_iter().flatten().flatten();
    let files = domains.flat_map(|domain| {
        std::fs::read_dir(domain.path())
            .into_iter()
            .flatten()
            .flatten()
    });
    let mut sockets: Vec<_> = files
        .map(|file| file.path())
        .filter(|path| path.extension().is_some_and(|end| end == "sock"))
        .filter(|path| socket::connect(path).is_ok())
        .collect();
    sockets.sort();
    match sockets.as_slice() {
        [] => Err(Error::NoSocket { dir }),
        [only] => Ok(only.clone()),
        [_, _, ..] => Err(Error::ManySockets { sockets }),
    }
}

pub(crate) fn unexpected(reply: &Reply) -> Error {
    Error::Protocol(format!("{reply:?}"))
}

const RETRY: Duration = Duration::from_millis(20);
