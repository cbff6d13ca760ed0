//! The one door to atomics: every ordering and fence that the protocols rely on is named here, so that a model can
//! weaken one of them and be seen to fail.
//!
//! The shared words themselves are reached through [`crate::ring::Words`]; only the fences differ under `cfg(loom)`.

pub use std::sync::atomic::Ordering;

/// A place where the protocols need more than a relaxed access. Each names the place it pairs with.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Site {
    /// Writer: the ring word that names a filled slot. Pairs with [`Site::PinFence`] and [`Site::PeekFence`]: the
    /// slot's contents are visible to who has read the word and passed the fence.
    RingStore,
    /// Reader without a pin: acquire fence after the ring word. Pairs with [`Site::RingStore`].
    PeekFence,
    /// Writer: the newest position. Pairs with [`Site::HeadLoad`].
    HeadStore,
    /// Reader: the newest position. Pairs with [`Site::HeadStore`]: the ring word of that position is visible.
    HeadLoad,
    /// Reader: a pin word, set or cleared. Pairs with [`Site::PinScan`]: what was read through the pin's word before
    /// this store happens before the slot is written again. Setting needs it as much as clearing does, because a
    /// scan may see only the later of the two.
    PinStore,
    /// Writer: the scan of pin words. Pairs with [`Site::PinStore`].
    PinScan,
    /// Writer: full fence after the ring and head stores. Pairs with [`Site::PinFence`] (either the reader sees the
    /// slot unlinked or a later scan sees the pin) and with [`Site::ArmFence`] (either the waiter sees the new head
    /// or the writer sees it waiting).
    PublishFence,
    /// Reader: full fence between the pin and the second look at the ring word. Pairs with [`Site::PublishFence`],
    /// and, as an acquire fence, with [`Site::RingStore`].
    PinFence,
    /// Writer: release fence after a slot's position is voided, before its payload is written. Pairs with
    /// [`Site::IntactFence`].
    VoidFence,
    /// Reader: acquire fence between its last look at a payload and its second look at the slot's position. Pairs
    /// with [`Site::VoidFence`]: whoever has read a byte of the next sample sees the position changed.
    IntactFence,
    /// Waiter: full fence after it showed itself waiting and armed, before its last look at what it waits for. Pairs
    /// with [`Site::PublishFence`], [`Site::StateFence`] and [`Site::RingFence`].
    ArmFence,
    /// Daemon: full fence between a change of the state and its look at who waits. Pairs with [`Site::ArmFence`].
    StateFence,
    /// Waker: full fence between what it changed and its look at the dirty bit, and again before that at the armed word.
    /// Pairs with [`Site::TakeFence`] and [`Site::ArmFence`].
    RingFence,
    /// Waiter: full fence between its taking of dirty bits and its look at what they stand for. Pairs with
    /// [`Site::RingFence`] and [`Site::PublishFence`].
    TakeFence,
    /// Waiter: the armed word, after the count of wake-ups was read. Pairs with [`Site::ArmSwap`]. No model fails without
    /// these two: loom lets no load see a later store.
    ArmStore,
    /// Waker: the armed word, before the count is raised. Pairs with [`Site::ArmStore`].
    ArmSwap,
}

impl Site {
    /// The ordering this site needs.
    pub const fn ordering(self) -> Ordering {
        match self {
            Self::RingStore
            | Self::HeadStore
            | Self::PinStore
            | Self::VoidFence
            | Self::ArmStore => Ordering::Release,
            Self::HeadLoad
            | Self::PinScan
            | Self::PeekFence
            | Self::IntactFence
            | Self::ArmSwap => Ordering::Acquire,
            // SeqCst fences, never SeqCst accesses: loom models only the former.
            Self::PublishFence
            | Self::PinFence
            | Self::ArmFence
            | Self::StateFence
            | Self::RingFence
            | Self::TakeFence => Ordering::SeqCst,
        }
    }
}

/// The ordering of an access at `site`.
#[cfg(not(loom))]
#[inline]
pub const fn order(site: Site) -> Ordering {
    site.ordering()
}

/// The fence at `site`.
#[cfg(not(loom))]
#[inline]
pub fn fence(site: Site) {
    std::sync::atomic::fence(site.ordering());
}

#[cfg(loom)]
pub use model::{fence, order, weaken};

/// The same two functions for loom, with one site weakened at will.
#[cfg(loom)]
mod model {
    use std::cell::Cell;

    use super::{Ordering, Site};

    thread_local! {
        // loom runs all threads of one model as coroutines of the thread that started it.
        static WEAKENED: Cell<Option<Site>> = const { Cell::new(None) };
    }

    /// Weakens `site` for models that this thread runs from now on: an access becomes relaxed, a full fence an
    /// acquire and release fence, any other fence nothing.
    pub fn weaken(site: Option<Site>) {
        WEAKENED.set(site);
    }

    /// The ordering of an access at `site`, relaxed when that is weakened.
    pub fn order(site: Site) -> Ordering {
        if WEAKENED.get() == Some(site) {
            Ordering::Relaxed
        } else {
            site.ordering()
        }
    }

    /// The fence at `site`, or the next weaker one.
    pub fn fence(site: Site) {
        match (WEAKENED.get() == Some(site), site.ordering()) {
            (false, ordering) => loom::sync::atomic::fence(ordering),
            (true, Ordering::SeqCst) => loom::sync::atomic::fence(Ordering::AcqRel),
            (true, _) => {}
        }
    }
}
