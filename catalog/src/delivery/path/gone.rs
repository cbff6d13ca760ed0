//! What a path tells of samples that do not come, where each is wanted.

use ddx_wire::sample::{Record, SampleMeta};
use ddx_wire::{Seq, StreamId};

use super::super::flow::Flow;
use super::{Path, REPEATS};

impl<P: AsRef<[u8]> + Clone> Path<P> {
    /// Tells that the contract keeps a sample back, of a stream of which each is wanted.
    pub(in crate::delivery) fn leave_out(&mut self, stream: StreamId, meta: &SampleMeta) {
        if let Some(flow) = self.flows.get_mut(&stream)
            && flow.leave_out(meta)
        {
            self.push_left_out(stream, meta);
        }
    }

    /// Where each sample is wanted, tells what the ring let go before this one.
    pub(super) fn tell_gap(&mut self, stream: StreamId, meta: &SampleMeta) {
        let flow = self.flows.get(&stream).filter(|flow| flow.is_every());
        if let Some((epoch, Seq(last))) = flow.and_then(Flow::sent)
            && epoch == meta.epoch
            && meta.seq.0 > last + 1
        {
            let gone = SampleMeta {
                epoch,
                seq: Seq(meta.seq.0 - 1),
                ..SampleMeta::default()
            };
            self.push_gone(stream, &gone, meta.seq.0 - last - 1);
        }
    }

    pub(super) fn push_left_out(&mut self, stream: StreamId, meta: &SampleMeta) {
        let left_out = SampleMeta {
            filtered: 1,
            ..*meta
        };
        self.push_gone(stream, &left_out, 1);
    }

    pub(super) fn push_gone(&mut self, stream: StreamId, meta: &SampleMeta, count: u64) {
        let others = count.saturating_sub(1).to_le_bytes();
        let record = Record {
            stream,
            repeat: true,
            gone: true,
            meta: *meta,
            fragment: None,
            payload: &others,
        };
        self.lanes[REPEATS].push(&record, self.datagram_bytes);
    }
}
