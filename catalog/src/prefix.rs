//! Two hosts with one prefix: who keeps it.
//!
//! The host that has held it longer on its own boot clock keeps it, then the one with the lower id; the other is shown as
//! `robot1~4f2a`. What a host calls its own is never changed: it shows every other holder of its prefix by the longer form.

use std::collections::BTreeMap;

use ddx_wire::{HostId, HostName};

/// Spans that differ by less count as equal: they are measured across the network, and all hosts must agree.
const SAME_NS: i128 = 1_000_000_000;

/// One holder of a prefix.
#[derive(Clone, Debug)]
pub(crate) struct Holder {
    pub(crate) id: HostId,
    pub(crate) name: HostName,
    /// Since when, on this host's clock.
    pub(crate) since_ns: i128,
}

/// The prefixes under which hosts appear here that must not appear under their own, and the one under which others see `me`.
pub(crate) fn resolve(
    me: &Holder,
    others: &[Holder],
) -> (BTreeMap<HostId, String>, Option<String>) {
    let mut by_name: BTreeMap<&HostName, Vec<&Holder>> = BTreeMap::new();
    for holder in others.iter().chain([me]) {
        by_name.entry(&holder.name).or_default().push(holder);
    }
    let mut shown = BTreeMap::new();
    let mut lost = None;
    for (name, mut holders) in by_name {
        holders.sort_by_key(|holder| holder.id);
        let winner = holders.iter().copied().reduce(|best, next| {
            if next.since_ns + SAME_NS <= best.since_ns {
                next
            } else {
                best
            }
        });
        let here = *name == me.name;
        for holder in &holders {
            let long = || format!("{name}~{}", holder.id.short());
            let wins = winner.is_some_and(|winner| winner.id == holder.id);
            if holder.id == me.id {
                lost = (!wins).then(long);
            } else if here || !wins {
                shown.insert(holder.id, long());
            }
        }
    }
    (shown, lost)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn holder(id: u8, name: &str, since_s: i128) -> Holder {
        Holder {
            id: HostId([id; 16]),
            name: HostName::parse(name).unwrap(),
            since_ns: since_s * SAME_NS,
        }
    }

    #[test]
    fn longer_held_wins_then_lower_id() {
        let others = [holder(3, "r", 50), holder(2, "r", 10), holder(1, "s", 0)];
        let (shown, lost) = resolve(&holder(9, "base", 0), &others);
        assert_eq!(
            shown,
            BTreeMap::from([(HostId([3; 16]), "r~0303".to_owned())])
        );
        assert_eq!(lost, None);

        let others = [holder(3, "r", 10), holder(2, "r", 10)];
        let (shown, _) = resolve(&holder(9, "base", 0), &others);
        assert!(shown.contains_key(&HostId([3; 16])));
    }

    #[test]
    fn the_loser_keeps_its_own_names_and_learns_how_it_is_seen() {
        let (shown, lost) = resolve(&holder(5, "r", 60), &[holder(7, "r", 10)]);
        assert_eq!(
            shown,
            BTreeMap::from([(HostId([7; 16]), "r~0707".to_owned())])
        );
        assert_eq!(lost.as_deref(), Some("r~0505"));
    }
}
