//! The books of items, hop by hop: what the daemon counts under `@/books`, what its store knows of writers, and what
//! local readers say of themselves.
//!
//! Each row is of one moment. So it balances however much is on its way, and rows of one item need not be of the same moment.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use ddx_store::{Description, ReaderBooks, ReaderOptions, Store};
use ddx_wire::{ItemName, Pattern};
use serde::{Deserialize, Serialize};

use super::state;
use super::subscription::Subscription;

/// What became of the samples of one item on one hop. `expected` is what their numbers say; all counts of fates add up to it.
#[derive(Clone, Debug, Default, Deserialize, PartialEq, Serialize)]
#[serde(default)]
pub(crate) struct Row {
    pub(crate) name: String,
    /// `writer to store`, `store to stream`, `store to link`, `link to mirror`, `store to reader` or `mirror to reader`.
    pub(crate) hop: String,
    /// Hosts or programs at the other end.
    pub(crate) peers: Vec<String>,
    /// `unicast` or `multicast`, of a way out.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) via: Option<String>,
    /// Where a way out leads to.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) addr: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) contract: Option<String>,
    /// Least time between two samples that the contract asks for, nanoseconds.
    #[serde(skip_serializing_if = "is_zero")]
    pub(crate) interval_ns: u64,
    /// The moment, nanoseconds on this host's clock; of counts at rest it is when they last moved.
    pub(crate) at_ns: u64,
    pub(crate) expected: u64,
    #[serde(flatten)]
    pub(crate) fates: Fates,
    /// Of what a link delivered: written to the mirror, older than what that held, not taken by it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) written: Option<u64>,
    #[serde(skip_serializing_if = "is_zero")]
    pub(crate) stale: u64,
    #[serde(skip_serializing_if = "is_zero")]
    pub(crate) refused: u64,
    /// Payload bytes of what was delivered; of a way out with repeats.
    pub(crate) bytes: u64,
    /// Whether something waits until the way out has room.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub(crate) waiting: bool,
    /// What is known of the way out.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) link: Option<Link>,
}

/// How samples ended, one count for each way to end.
#[derive(Clone, Copy, Debug, Default, Deserialize, PartialEq, Serialize)]
#[serde(default)]
pub(crate) struct Fates {
    pub(crate) delivered: u64,
    /// Gave way to newer ones in a ring.
    pub(crate) overwritten: u64,
    /// Left out at the source, for whatever reason.
    pub(crate) filtered: u64,
    /// Left out because the contract asks for fewer.
    pub(crate) rate_limited: u64,
    /// Left out because the link is slower than the item.
    pub(crate) queue_dropped: u64,
    /// Lost on the link for good.
    pub(crate) lost: u64,
    /// Came after a newer one.
    pub(crate) late: u64,
    /// Older than the contract allows, or given up in part.
    pub(crate) expired: u64,
    /// No room for them.
    pub(crate) over_budget: u64,
    pub(crate) undecodable: u64,
    pub(crate) too_large: u64,
}

/// What is known of a way out.
#[derive(Clone, Copy, Debug, Default, Deserialize, PartialEq, Serialize)]
#[serde(default)]
pub(crate) struct Link {
    pub(crate) bytes_per_second: u64,
    pub(crate) queue_us: u64,
    pub(crate) loss_percent: f64,
    pub(crate) datagram_bytes: u64,
    pub(crate) streams_waiting: u64,
}

/// `@/books`.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(default)]
struct Item {
    rows: Vec<Row>,
    left_off: u64,
}

/// The books at one time.
#[derive(Clone, Debug, Default)]
pub(crate) struct Snapshot {
    pub(crate) rows: Vec<Row>,
    /// Rows that the daemon had no room to show.
    pub(crate) left_off: u64,
}

/// Where snapshots come from.
pub(crate) struct Books<'a> {
    store: &'a Store,
    travelling: Subscription,
    /// The daemon's process, which reads what other hosts read.
    daemon: u32,
}

/// How fast a row moves, a second.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Rates {
    pub(crate) expected: f64,
    pub(crate) delivered: f64,
    pub(crate) overwritten: f64,
    pub(crate) filtered: f64,
    pub(crate) queue_dropped: f64,
    pub(crate) lost: f64,
    pub(crate) bytes: f64,
}

impl Fates {
    /// Each count with its name, in the order in which they are shown.
    pub(crate) fn named(&self) -> [(&'static str, u64); 11] {
        [
            ("delivered", self.delivered),
            ("overwritten", self.overwritten),
            ("filtered", self.filtered),
            ("rate-limited", self.rate_limited),
            ("queue-dropped", self.queue_dropped),
            ("lost", self.lost),
            ("late", self.late),
            ("expired", self.expired),
            ("over-budget", self.over_budget),
            ("undecodable", self.undecodable),
            ("too-large", self.too_large),
        ]
    }

    fn sum(&self) -> u64 {
        let counts = self.named().map(|(_, count)| count);
        counts.into_iter().fold(0, u64::saturating_add)
    }
}

impl Row {
    /// Samples that are accounted for.
    pub(crate) fn accounted(&self) -> u64 {
        self.fates.sum()
    }

    /// What is wrong with the row: what the sums are about, and both of them.
    pub(crate) fn imbalance(&self) -> Option<(&'static str, u64, u64)> {
        let accounted = self.accounted();
        if accounted != self.expected {
            return Some(("samples by their numbers", self.expected, accounted));
        }
        let taken = self.written?.saturating_add(self.stale);
        let taken = taken.saturating_add(self.refused);
        (taken != self.fates.delivered).then_some((
            "samples delivered by the link",
            self.fates.delivered,
            taken,
        ))
    }

    /// What tells this row from the others.
    fn key(&self) -> impl Ord + use<> {
        (
            self.name.clone(),
            self.hop.clone(),
            self.peers.clone(),
            self.addr.clone(),
            self.contract.clone(),
        )
    }

    /// How fast it moved since `before`; none if it did not.
    pub(crate) fn rates(&self, before: &Self) -> Option<Rates> {
        let ns = self.at_ns.checked_sub(before.at_ns).filter(|ns| *ns > 0)?;
        // Counts that were at rest moved within the last period, whenever they had moved before.
        let seconds = Duration::from_nanos(ns).min(STEP_MAX).as_secs_f64();
        let rate = |now: u64, then: u64| number(now.saturating_sub(then)) / seconds;
        let (now, then) = (&self.fates, &before.fates);
        Some(Rates {
            expected: rate(self.expected, before.expected),
            delivered: rate(now.delivered, then.delivered),
            overwritten: rate(now.overwritten, then.overwritten),
            filtered: rate(
                now.filtered + now.rate_limited,
                then.filtered + then.rate_limited,
            ),
            queue_dropped: rate(now.queue_dropped, then.queue_dropped),
            lost: rate(now.lost + now.late, then.lost + then.late),
            bytes: rate(self.bytes, before.bytes),
        })
    }
}

impl Snapshot {
    /// How fast each row moved since `before`, in the order of the rows.
    pub(crate) fn rates(&self, before: &Self) -> Vec<Rates> {
        let before: BTreeMap<_, _> = before.rows.iter().map(|row| (row.key(), row)).collect();
        let moved = self.rows.iter().map(|row| {
            let before = before.get(&row.key());
            before.and_then(|before| row.rates(before))
        });
        moved.map(Option::unwrap_or_default).collect()
    }
}

impl<'a> Books<'a> {
    pub(crate) fn open(store: &'a Store) -> anyhow::Result<Self> {
        Ok(Self {
            store,
            daemon: state::own(store)?.pid,
            travelling: Subscription::open(store, "@/books", ReaderOptions::default())?,
        })
    }

    /// The books of the items that match, as the daemon last showed them.
    pub(crate) fn take(&mut self, pattern: &Pattern) -> anyhow::Result<Snapshot> {
        let seen = self.travelling.first(PATIENCE)?;
        let value = seen.map(|seen| seen.value.clone()).unwrap_or_default();
        let item: Item = serde_json::from_value(value).unwrap_or_default();
        let matches = |name: &str| {
            ItemName::parse(name, self.store.host()).is_ok_and(|name| pattern.matches(&name))
        };
        let mut rows: Vec<Row> = item.rows;
        rows.retain(|row| matches(&row.name));
        for entry in self.store.list(pattern)? {
            if entry.name.is_admin() && pattern.literal().is_none() {
                continue;
            }
            // It may be gone by now.
            let mut described = self.store.describe(entry.name.as_str()).ok();
            let reads =
                |item: &Description| item.readers.iter().any(|r| r.bound && r.books.is_none());
            for _ in 1..TRIES {
                if described.as_ref().is_some_and(reads) {
                    described = self.store.describe(entry.name.as_str()).ok();
                }
            }
            if let Some(item) = described {
                let own = entry.name.is_under(self.store.host());
                rows.extend(here(&item, own, self.daemon));
            }
        }
        rows.sort_by(|a, b| (&a.name, order(&a.hop)).cmp(&(&b.name, order(&b.hop))));
        Ok(Snapshot {
            rows,
            left_off: item.left_off,
        })
    }

    /// Waits until the daemon shows other books, for a little longer than it takes to.
    pub(crate) fn wait(&mut self) -> anyhow::Result<()> {
        let began = Instant::now();
        // What it shows next may have been counted before this began.
        for _ in 0..2 {
            let left = SHOWN_EVERY.saturating_sub(began.elapsed());
            self.travelling.next(left)?;
        }
        Ok(())
    }
}

/// What this host's store knows of an item.
fn here(item: &Description, own: bool, daemon: u32) -> Vec<Row> {
    let at_ns = ddx_store::now().0;
    let mut rows = Vec::new();
    if own && let Some(newest) = item.newest {
        // The value that a new writer found comes first in its segment, with the number that it had.
        let (written, found) = match newest.epoch == item.epoch {
            true => (newest.seq.0, u64::from(newest.pos > newest.seq.0)),
            false => (0, 1),
        };
        rows.push(Row {
            hop: "writer to store".to_owned(),
            peers: vec![item.entry.program.clone()],
            expected: written,
            fates: Fates {
                delivered: newest.pos - found,
                ..Fates::default()
            },
            bytes: newest.bytes.saturating_mul(written),
            ..Row::default()
        });
    }
    let hop = if own {
        "store to reader"
    } else {
        "mirror to reader"
    };
    for reader in &item.readers {
        // One that only ever takes the present value has nothing to count, and one that was reading at each look comes
        // the next time.
        let Some(books) = reader.books.filter(|books| books.expected > 0) else {
            continue;
        };
        let ReaderBooks {
            expected,
            delivered,
            overwritten,
            filtered,
            lost,
            ..
        } = books;
        rows.push(Row {
            hop: hop.to_owned(),
            peers: vec![match reader.pid == daemon {
                true => DAEMON.to_owned(),
                false => format!("{} ({})", reader.program, reader.pid),
            }],
            contract: Some(reader.contract.to_string()),
            expected,
            fates: Fates {
                delivered,
                overwritten,
                filtered,
                lost,
                ..Fates::default()
            },
            ..Row::default()
        });
    }
    for row in &mut rows {
        row.name = item.entry.name.to_string();
        row.at_ns = at_ns;
    }
    rows
}

/// The order in which a sample takes the hops.
fn order(hop: &str) -> usize {
    HOPS.iter()
        .position(|known| *known == hop)
        .unwrap_or(HOPS.len())
}

fn number(count: u64) -> f64 {
    #[expect(
        clippy::cast_precision_loss,
        reason = "a rate is shown with a few digits"
    )]
    let number = count as f64;
    number
}

#[expect(
    clippy::trivially_copy_pass_by_ref,
    reason = "the signature that serde calls"
)]
fn is_zero(count: &u64) -> bool {
    *count == 0
}

/// Who reads what other hosts read.
pub(crate) const DAEMON: &str = "daemon";
const HOPS: [&str; 6] = [
    "writer to store",
    "store to reader",
    "store to stream",
    "store to link",
    "link to mirror",
    "mirror to reader",
];
/// How long to wait for an item that a running daemon has from its start.
const PATIENCE: Duration = Duration::from_millis(500);
/// The daemon looks each second, its threads count up each half.
const SHOWN_EVERY: Duration = Duration::from_millis(1_200);
/// Counts that move are shown at least so often.
const STEP_MAX: Duration = Duration::from_millis(2_500);
/// Looks at an item whose readers are just reading.
const TRIES: u32 = 10;
