//! What the control plane counted.

use ddx_wire::seal::RefusedCounts;

/// Counts since the start of the host's control plane.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct Counters {
    /// Control datagrams received, dropped ones included.
    pub received: u64,
    /// Bytes of them.
    pub received_bytes: u64,
    /// Control datagrams sent.
    pub sent: u64,
    /// Bytes of them.
    pub sent_bytes: u64,
    /// Datagrams dropped, by reason. Growth of `forged` or `replayed` is an attack or a second host with this identity.
    pub refused: RefusedCounts,
    /// Datagrams of senders without a session; they are greeted. Some at each start are normal.
    pub strangers: u64,
    /// Responses to challenges that were never made or have lapsed.
    pub stale_responses: u64,
    /// Greetings of earlier lives of known hosts.
    pub stale_lives: u64,
    /// What was dropped because a limit was reached: hosts, handshakes, items and subscriptions of this host, leases, probes,
    /// orders, goodbyes, or what waits to be sent or told.
    pub over_limit: u64,
    /// Datagrams of the membership protocol that it refused.
    pub membership_refused: u64,
    /// Items of other hosts, and parts of their schemas, that were dropped because the directory is full.
    pub directory_full: u64,
}
