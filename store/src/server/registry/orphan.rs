//! Items that no program writes: what of them is to outlive the daemon, and taking them back.

use ddx_wire::{Epoch, ItemDescription, ItemName, WriterState};

use super::item::{Segment, Tenure};
use super::{Effect, Registry, parse_schema};
use crate::control::Refusal;
use crate::segment::State;
use crate::server::orphan::{Keep, Label, Orphan};

impl Registry {
    /// All items of this host that no program writes.
    pub fn orphans(&self) -> Vec<Orphan> {
        let items = self.items.iter();
        items
            .filter_map(|(name, item)| {
                let tenure = item.tenure.as_ref()?;
                (tenure.state != WriterState::Live)
                    .then(|| self.orphan(name, tenure, tenure.state))?
            })
            .collect()
    }

    /// Takes an item back that a former daemon held. Nothing of it is believed before it is judged.
    pub fn restore(&mut self, orphan: Orphan) -> Result<(), Refusal> {
        let Label {
            name,
            schema,
            mut program,
            writer,
            ..
        } = orphan.label;
        let refused = |fault: &str| Err(Refusal::Segment(fault.to_owned()));
        if !self.is_own(&name) {
            return Err(self.foreign(name));
        }
        if writer == WriterState::Live {
            return refused("its label says that a program writes it");
        }
        let schema = parse_schema(&schema)?;
        let mut segment = Segment::map(orphan.data, orphan.ctl)?;
        let control = &segment.control;
        let epoch = control.epoch();
        if epoch != orphan.epoch {
            return refused("it is of another epoch than it was kept for");
        }
        if epoch >= Epoch::new(self.identity.ordinal, 0) {
            return refused("it is of a later life than this daemon's");
        }
        if control.head_pos() > 0 && control.newest().is_none() {
            return refused("its last sample is not whole");
        }
        let State {
            superseded,
            removed,
            ..
        } = control.state();
        if superseded || removed {
            return refused("it was taken over or removed when the former daemon died");
        }
        let item = self.items.entry(name.clone()).or_default();
        let former = item.tenure.as_ref();
        if former.is_some_and(|former| former.segment.control.epoch() >= epoch) {
            return refused("a later value of the item was kept too");
        }
        segment.reserved = control.open_cells();
        program.truncate(program.floor_char_boundary(ItemDescription::PROGRAM_MAX_BYTES));
        let former = item.tenure.replace(Tenure {
            segment,
            schema,
            state: writer,
            program,
            pid: 0,
        });
        if let Some(former) = former {
            self.release_former(&name, &former);
        }
        self.tell_announced(&name);
        Ok(())
    }

    /// Has the item outlive this daemon, as one without a writer.
    pub(super) fn keep(&mut self, name: &ItemName, writer: WriterState) {
        let item = self.items.get(name);
        let tenure = item.and_then(|item| item.tenure.as_ref());
        if let Some(orphan) = tenure.and_then(|tenure| self.orphan(name, tenure, writer)) {
            self.effects.push_back(Effect::Keep(Keep::Hold(orphan)));
        }
    }

    /// Undoes [`Registry::keep`] for what was in the place of an item.
    pub(super) fn release_former(&mut self, name: &ItemName, former: &Tenure) {
        if former.state != WriterState::Live && self.is_own(name) {
            let epoch = former.segment.control.epoch();
            self.effects.push_back(Effect::Keep(Keep::Release(epoch)));
        }
    }

    fn is_own(&self, name: &ItemName) -> bool {
        name.is_under(&self.identity.host) && !name.is_admin()
    }

    fn orphan(&self, name: &ItemName, tenure: &Tenure, writer: WriterState) -> Option<Orphan> {
        self.is_own(name).then(|| Orphan {
            epoch: tenure.segment.control.epoch(),
            label: Label::new(name.clone(), tenure.schema.text(), &tenure.program, writer),
            data: tenure.segment.data.clone(),
            ctl: tenure.segment.ctl.clone(),
        })
    }
}
