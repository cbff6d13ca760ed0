//! Keeps the items that no program writes while there is no daemon: with the service manager, in its store of files.
//!
//! Each item is one entry of three files, named by its epoch. What comes back is judged like a stranger's segment; what is
//! refused is said once, by its name, and released.

use std::collections::{BTreeMap, BTreeSet};
use std::os::fd::OwnedFd;
use std::sync::mpsc::Receiver;

use ddx_store::server::{Keep, Orphan, Server, passed_files};
use ddx_wire::Epoch;

use crate::manager::{FILES, Manager};

/// Items that are kept. `FileDescriptorStoreMax=` of the unit is three times this.
const ITEMS_MAX: usize = 1024;
/// Changes that may wait for the service manager.
pub(super) const CHANGES_MAX: usize = 2 * ITEMS_MAX;

/// What the service manager holds for this daemon.
pub(super) struct Keeper {
    manager: Manager,
    held: BTreeSet<Epoch>,
}

impl Keeper {
    /// Nothing is held yet.
    pub(super) fn new(manager: Manager) -> Self {
        Self {
            manager,
            held: BTreeSet::new(),
        }
    }

    /// Takes what the manager held for the former daemon.
    pub(super) fn inherit(&mut self) -> Vec<Orphan> {
        let mut entries: BTreeMap<String, Vec<OwnedFd>> = BTreeMap::new();
        for (name, file) in passed_files() {
            entries.entry(name).or_default().push(file);
        }
        let read = |(name, files): (String, Vec<OwnedFd>)| {
            let epoch = u64::from_str_radix(&name, 16).map(Epoch);
            let orphan = match epoch {
                Ok(epoch) if entry(epoch) == name => {
                    Orphan::from_files(epoch, files).map_err(|refusal| refusal.to_string())
                }
                Ok(_) | Err(_) => Err("not named as an entry of ours".to_owned()),
            };
            match orphan {
                Ok(orphan) => {
                    self.held.insert(orphan.epoch());
                    Some(orphan)
                }
                Err(error) => {
                    tracing::warn!(entry = name, error, "dropped what the service manager held");
                    self.release(&name);
                    None
                }
            }
        };
        entries.into_iter().filter_map(read).collect()
    }

    /// Does what the store's server says, until that is gone.
    pub(super) fn run(mut self, changes: Receiver<Keep>) -> Self {
        for change in changes {
            match change {
                Keep::Hold(orphan) => self.hold(&orphan),
                Keep::Release(epoch) => self.forget(epoch),
            }
        }
        self
    }

    /// Lets go of an item.
    pub(super) fn forget(&mut self, epoch: Epoch) {
        if self.held.remove(&epoch) {
            self.release(&entry(epoch));
        }
    }

    fn hold(&mut self, orphan: &Orphan) {
        let item = orphan.name();
        // A program that has handed over twice in one epoch: the later files count.
        self.forget(orphan.epoch());
        if self.held.len() >= ITEMS_MAX {
            tracing::warn!(%item, ITEMS_MAX, "too many are kept: this one will not outlive the daemon");
            return;
        }
        let told = orphan
            .files()
            .map_err(anyhow::Error::from)
            .and_then(|files| Ok(self.manager.hold(&entry(orphan.epoch()), &files)?));
        match told {
            Ok(()) => {
                self.held.insert(orphan.epoch());
            }
            Err(error) => tracing::warn!(%item, %error, "this will not outlive the daemon"),
        }
    }

    fn release(&self, entry: &str) {
        if let Err(error) = self.manager.release(entry) {
            tracing::warn!(entry, %error, "the service manager holds what is no longer wanted");
        }
    }
}

/// Gives a new server what the former one left; returns what it did not take.
pub(super) fn restore(server: &mut Server, orphans: Vec<Orphan>) -> Vec<Epoch> {
    let mut refused = Vec::new();
    for orphan in orphans {
        let (epoch, item) = (orphan.epoch(), orphan.name().clone());
        match server.restore(orphan) {
            Ok(()) => tracing::info!(%item, "taken over from the former daemon, without a writer"),
            Err(error) => {
                tracing::warn!(%item, %error, "dropped what was kept of the former daemon");
                refused.push(epoch);
            }
        }
    }
    refused
}

/// The name of an item's files with the manager: short, since all names together come in one variable of the environment,
/// and that may have 128 KiB.
fn entry(epoch: Epoch) -> String {
    format!("{:x}", epoch.0)
}

const _: () = assert!(ITEMS_MAX * FILES * 17 < 128 * 1024, "the names fit");
