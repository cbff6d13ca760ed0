//! What every line works with.

use anyhow::Result;

use crate::programs::Programs;
use crate::table::Table;
use crate::{cost, fallover, local, network, video};

/// A run of the bench.
pub(crate) struct Bench {
    /// Whether it only shows that each line gives figures.
    pub(crate) smoke: bool,
    /// What it starts.
    pub(crate) programs: Programs,
    /// What it found.
    pub(crate) table: Table,
}

/// A line of the bench: its name, and what measures it.
pub(crate) type Line = (&'static str, fn(&mut Bench) -> Result<()>);

/// All lines, in the order of the table.
pub(crate) const LINES: &[Line] = &[
    ("write", local::write),
    ("wake", local::wake),
    ("poll", local::poll),
    ("large", local::large),
    ("readers", cost::readers),
    ("memory", cost::memory),
    ("hosts", network::hosts),
    ("spin", network::spin),
    ("idle", network::idle),
    ("cold", network::cold),
    ("fallover", fallover::fallover),
    ("video", video::video),
    ("raw", video::raw),
    ("replay", video::replay),
];

impl Bench {
    /// The count for a smoke run, or for one that measures.
    pub(crate) fn scale<T>(&self, smoke: T, full: T) -> T {
        if self.smoke { smoke } else { full }
    }

    /// How often the contenders of a line take turns.
    pub(crate) fn rounds(&self) -> usize {
        self.scale(1, 9)
    }
}
