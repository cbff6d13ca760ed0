//! One item of the registry: its segment, its lease, its readers and their places.

use std::os::fd::OwnedFd;
use std::sync::Arc;

use ddx_wire::{Contract, Epoch, WriterState};

use super::ClientId;
use crate::control::{Binding, Purpose, Refusal};
use crate::layout::{BASE_PINS, MAX_PINS};
use crate::notify::{Bell, DIRTY_BITS};
use crate::quota::Limit;
use crate::schema::Schema;
use crate::segment::{Seat, SegmentControl};

/// A name that is written, was written, or is waited for.
#[derive(Debug, Default)]
pub(super) struct Item {
    pub(super) tenure: Option<Tenure>,
    pub(super) lease: Option<Lease>,
    pub(super) readers: Vec<Reader>,
    /// The union of contracts that was told last, for an item of another host.
    pub(super) wanted: Option<Contract>,
}

/// What the present or last writer left: it stays until the next one has handed over.
#[derive(Debug)]
pub(super) struct Tenure {
    pub(super) segment: Segment,
    pub(super) schema: Schema,
    pub(super) state: WriterState,
    pub(super) program: String,
    pub(super) pid: u32,
}

/// A segment as the daemon keeps it.
#[derive(Debug)]
pub(super) struct Segment {
    pub(super) data: Arc<OwnedFd>,
    pub(super) ctl: Arc<OwnedFd>,
    pub(super) control: SegmentControl,
    /// Cells in use when a former daemon's writer handed this over, whose readers have not shown up yet.
    pub(super) reserved: u64,
}

/// The right to write an item.
#[derive(Debug)]
pub(super) struct Lease {
    pub(super) client: ClientId,
    pub(super) handle: u32,
    pub(super) purpose: Purpose,
    pub(super) epoch: Epoch,
    pub(super) schema: Schema,
    /// Bytes counted for this lease once its segment is handed over.
    pub(super) bytes: u64,
}

/// An open reader.
#[derive(Debug)]
pub(super) struct Reader {
    pub(super) client: ClientId,
    pub(super) handle: u32,
    pub(super) schema: Option<Schema>,
    pub(super) extra_pins: u32,
    pub(super) contract: Contract,
    pub(super) seat: Option<Seat>,
    pub(super) refused: Option<String>,
}

impl Item {
    pub(super) fn is_empty(&self) -> bool {
        self.tenure.is_none() && self.lease.is_none() && self.readers.is_empty()
    }

    pub(super) fn contract(&self) -> Option<Contract> {
        let contracts = self.readers.iter().map(|reader| reader.contract);
        contracts.reduce(Contract::union)
    }

    /// A free cell and pins for one more reader of client `client`.
    pub(super) fn find_seat(
        &self,
        tenure: &Tenure,
        extra_pins: u32,
        bell: Bell,
    ) -> Result<Seat, Refusal> {
        let spec = tenure.segment.control.spec();
        let taken = self.seats().fold(tenure.segment.reserved, |mask, seat| {
            mask | 1_u64.checked_shl(seat.cell).unwrap_or(0)
        });
        let cell = taken.trailing_ones();
        if cell >= spec.cells {
            return Err(Refusal::Quota {
                limit: Limit::Readers,
                wanted: u64::from(spec.cells) + 1,
                max: u64::from(spec.cells),
            });
        }
        let granted: u32 = self.seats().map(|seat| seat.pins - BASE_PINS).sum();
        let left = spec.pool.saturating_sub(granted).min(MAX_PINS - BASE_PINS);
        if extra_pins > left {
            return Err(Refusal::Quota {
                limit: Limit::Pins,
                wanted: u64::from(extra_pins),
                max: u64::from(left),
            });
        }
        Ok(Seat {
            cell,
            pins: BASE_PINS + extra_pins,
            bell,
        })
    }

    fn seats(&self) -> impl Iterator<Item = Seat> {
        self.readers.iter().filter_map(|reader| reader.seat)
    }
}

impl Tenure {
    pub(super) fn binding(&self, seat: Seat) -> Binding {
        Binding {
            cell: seat.cell,
            pins: seat.pins,
            bit: seat.bell.bit,
            epoch: self.segment.control.epoch(),
            schema: self.schema.text().to_owned(),
        }
    }
}

impl Segment {
    /// Checks and maps what a writer handed over.
    pub(super) fn accept(fds: Vec<OwnedFd>) -> Result<Self, Refusal> {
        let Ok([data, ctl]) = <[OwnedFd; 2]>::try_from(fds) else {
            return Err(Refusal::Segment("two descriptors expected".to_owned()));
        };
        Self::map(Arc::new(data), Arc::new(ctl))
    }

    /// The same for files that somebody else holds too.
    pub(super) fn map(data: Arc<OwnedFd>, ctl: Arc<OwnedFd>) -> Result<Self, Refusal> {
        let control =
            SegmentControl::map(&data, &ctl).map_err(|e| Refusal::Segment(e.to_string()))?;
        Ok(Self {
            data,
            ctl,
            control,
            reserved: 0,
        })
    }

    pub(super) fn fds(&self) -> Vec<Arc<OwnedFd>> {
        vec![Arc::clone(&self.data), Arc::clone(&self.ctl)]
    }

    pub(super) fn bytes(&self) -> u64 {
        u64::try_from(self.control.size_bytes()).unwrap_or(u64::MAX)
    }
}

impl Reader {
    /// What the writer rings when this reader waits.
    pub(super) fn bell(&self, client_bell: u16) -> Bell {
        Bell {
            client: client_bell,
            bit: u16::try_from(self.handle % u32::from(DIRTY_BITS)).unwrap_or_default(),
        }
    }
}
