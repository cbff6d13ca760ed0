//! ddx itself, as the lines measure it: through its public API only.

use std::time::Duration;

use anyhow::{Context, Result, bail};
use ddx_store::{Reader, ReaderOptions, Store, Writer, WriterOptions};

use crate::floor::WORDS;
use crate::pair::{Send64, Side, Take64};

/// Longer than any hand-over takes: a value that has not come by then is lost.
const PATIENCE: Duration = Duration::from_secs(10);

/// Writes and reads copies of 64 bytes.
pub(crate) struct Copies {
    writer: Writer<[u64; WORDS]>,
}

/// The reader of [`Copies`]: sleeps for news, or polls.
pub(crate) struct CopiesReader {
    reader: Reader<[u64; WORDS]>,
    blocks: bool,
}

/// Fills values of any size in place.
pub(crate) struct Loans<const N: usize> {
    writer: Writer<[u64; N]>,
}

/// Reads values of any size in place.
pub(crate) struct Pins<const N: usize> {
    reader: Reader<[u64; N]>,
}

impl Copies {
    /// Opens the writer of `name`.
    pub(crate) fn open(store: &Store, name: &str) -> Result<Self> {
        let writer = store
            .writer(name)
            .with_context(|| format!("opening the writer of `{name}`"))?;
        Ok(Self { writer })
    }

    /// Writes a value.
    pub(crate) fn write(&mut self, value: &[u64; WORDS]) -> Result<()> {
        self.writer.write(value)?;
        Ok(())
    }
}

impl CopiesReader {
    /// Opens a reader of `name`.
    pub(crate) fn open(store: &Store, name: &str, blocks: bool) -> Result<Self> {
        let reader = store
            .reader(name)
            .with_context(|| format!("opening a reader of `{name}`"))?;
        Ok(Self { reader, blocks })
    }

    /// The value, new or not.
    pub(crate) fn value(&mut self) -> Result<[u64; WORDS]> {
        let sample = self.reader.current()?.context("the item has no value")?;
        Ok(sample.value)
    }
}

/// Both sides of a conversation by copies, each with a connection of its own as two programs would have.
pub(crate) fn copies(
    stores: &[Store; 2],
    name: &str,
    blocks: bool,
) -> Result<[Side<Copies, CopiesReader>; 2]> {
    let [near, far] = stores;
    let (there, back) = (format!("{name}-there"), format!("{name}-back"));
    let (to_far, to_near) = (Copies::open(near, &there)?, Copies::open(far, &back)?);
    Ok([
        Side {
            to: to_far,
            from: CopiesReader::open(near, &back, blocks)?,
        },
        Side {
            to: to_near,
            from: CopiesReader::open(far, &there, blocks)?,
        },
    ])
}

/// Both sides of a conversation by values that stay where they are.
pub(crate) fn loans<const N: usize>(
    stores: &[Store; 2],
    name: &str,
) -> Result<[Side<Loans<N>, Pins<N>>; 2]> {
    // Slots are reserved for each possible reader: two for large values, so that the item stays within the quota.
    let options = WriterOptions {
        depth: 4,
        pins: 0,
        max_readers: 2,
        capacity_bytes: None,
    };
    let [near, far] = stores;
    let (there, back) = (format!("{name}-there"), format!("{name}-back"));
    let to_far = Loans {
        writer: near.writer_with(&there, options)?,
    };
    let to_near = Loans {
        writer: far.writer_with(&back, options)?,
    };
    Ok([
        Side {
            to: to_far,
            from: Pins {
                reader: near.reader_with(&back, ReaderOptions::default())?,
            },
        },
        Side {
            to: to_near,
            from: Pins {
                reader: far.reader_with(&there, ReaderOptions::default())?,
            },
        },
    ])
}

impl<S, T> Side<S, T> {
    /// The same, lent for a while.
    pub(crate) fn lend(&mut self) -> Side<&mut S, &mut T> {
        Side {
            to: &mut self.to,
            from: &mut self.from,
        }
    }
}

impl<S: Send64> Send64 for &mut S {
    fn send(&mut self, stamp: u64) -> Result<()> {
        (**self).send(stamp)
    }
}

impl<T: Take64> Take64 for &mut T {
    fn take(&mut self) -> Result<u64> {
        (**self).take()
    }
}

impl Send64 for Copies {
    fn send(&mut self, stamp: u64) -> Result<()> {
        self.write(&[stamp; WORDS])
    }
}

impl Take64 for CopiesReader {
    fn take(&mut self) -> Result<u64> {
        loop {
            let timeout = if self.blocks {
                PATIENCE
            } else {
                Duration::ZERO
            };
            match self.reader.next(timeout)? {
                Some(sample) => return Ok(sample.value[0]),
                None if self.blocks => bail!("no value within {PATIENCE:?}"),
                None => std::hint::spin_loop(),
            }
        }
    }
}

impl<const N: usize> Send64 for Loans<N> {
    fn send(&mut self, stamp: u64) -> Result<()> {
        let mut loan = self.writer.loan()?;
        loan[0] = stamp;
        loan.publish()?;
        Ok(())
    }
}

impl<const N: usize> Take64 for Pins<N> {
    fn take(&mut self) -> Result<u64> {
        let guard = self
            .reader
            .next_pinned(PATIENCE)?
            .context("no value in time")?;
        Ok(guard[0])
    }
}
