//! Figures of Zenoh for the snapshot.

use super::stream::Unseen;

/// Figures of Zenoh.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct ZenohFacts {
    /// Current connections of Zenoh, each counted once.
    pub connections: u64,
    /// Current routers.
    pub routers: u64,
    /// Counters since the start.
    pub counters: Counters,
    /// Connections whose messages or payloads cannot be read, in the order of [`Unseen::ALL`].
    pub unseen: [u64; Unseen::ALL.len()],
}

impl ZenohFacts {
    /// Returns each reason for which connections cannot be read, with their number.
    pub fn unseen(&self) -> impl Iterator<Item = (Unseen, u64)> {
        let reasons = Unseen::ALL.into_iter().zip(self.unseen);
        reasons.filter(|(_, connections)| *connections > 0)
    }
}

/// Counters since the start.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counters {
    /// Batches.
    pub batches: u64,
    /// Number of times that bytes of a connection were missing.
    pub gaps: u64,
    /// Messages without an attachment of ROS.
    pub foreign: u64,
    /// Messages of which some FRAGMENTs are missing.
    pub incomplete: u64,
}
