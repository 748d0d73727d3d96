//! The latest messages, so that a message in several ports counts once.

use std::collections::{HashSet, VecDeque};

/// Messages remembered, so that none is read again at another port.
pub(super) const REMEMBERED: usize = 8192;

/// The latest messages by position.
#[derive(Default)]
pub(super) struct RecentMessages {
    pub(super) set: HashSet<Identity>,
    pub(super) order: VecDeque<Identity>,
}

/// One use of one buffer.
#[derive(Clone, Copy, PartialEq, Eq, Hash)]
pub(super) struct Identity {
    pub(super) serial: u64,
    pub(super) node: u32,
    pub(super) validity: u32,
}

impl RecentMessages {
    pub(super) fn add(&mut self, identity: Identity) {
        if self.order.len() >= REMEMBERED
            && let Some(oldest) = self.order.pop_front()
        {
            self.set.remove(&oldest);
        }
        if self.set.insert(identity) {
            self.order.push_back(identity);
        }
    }
}
