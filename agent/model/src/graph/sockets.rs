//! Facts about this host's sockets that packets do not contain: their owners, and drops of
//! unidentified datagrams.
//!
//! The capture side reads these facts from the kernel. The table is bounded: when it is full, a new
//! socket is refused and counted, because existing ones already identify receivers.

use crate::facts::bounded::TableFacts;
use crate::facts::bounded::{Bounded, Counted};
use crate::facts::tables::KnownSockets;
use std::collections::BTreeMap;
use std::sync::Arc;

/// Facts about one socket that packets do not contain.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct SocketFacts {
    /// `SO_COOKIE`.
    pub cookie: u64,
    /// Process that owns it.
    pub process_id: Option<u32>,
    /// Id of the same process in its own namespace. It differs in a container, and it is the id
    /// that participants announce.
    pub own_process_id: Option<u32>,
    /// Name of the process.
    pub process: Option<Arc<str>>,
    /// Control group, as a path below the root.
    pub cgroup: Option<Arc<str>>,
    /// Datagrams dropped because the buffer was full, with unknown content.
    pub unidentified_drops: u64,
}

/// All known sockets.
#[derive(Debug)]
pub struct Sockets {
    sockets: Bounded<Counted<KnownSockets>, BTreeMap<u64, SocketFacts>>,
}

impl Sockets {
    /// Creates an empty table for at most `limit` sockets.
    #[must_use]
    pub fn new(limit: usize) -> Self {
        Self {
            sockets: Bounded::capped(limit),
        }
    }

    /// Records facts about a socket. Returns whether they are new.
    pub fn put(&mut self, facts: SocketFacts) -> bool {
        if self.sockets.get(&facts.cookie) == Some(&facts) {
            return false;
        }
        self.sockets.insert(facts.cookie, facts).is_none()
    }

    /// Removes a closed socket. Returns whether it was known.
    pub fn remove(&mut self, cookie: u64) -> bool {
        self.sockets.remove(&cookie).is_some()
    }

    /// Removes a socket that the kernel's table dropped, although it may be open.
    pub fn forget(&mut self, cookie: u64) {
        self.sockets.refuse();
        self.remove(cookie);
    }

    /// Returns the facts about a socket.
    #[must_use]
    pub fn get(&self, cookie: u64) -> Option<&SocketFacts> {
        self.sockets.get(&cookie)
    }

    /// Iterates over all sockets, by cookie.
    pub fn iter(&self) -> impl Iterator<Item = &SocketFacts> {
        self.sockets.values()
    }

    /// Returns size, cap and evictions for the metrics.
    pub fn table(&self) -> TableFacts {
        self.sockets.facts()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn size(sockets: &Sockets) -> (u64, u64, u64) {
        let facts = sockets.table();
        (facts.size, facts.limit, facts.evictions)
    }

    #[test]
    fn a_full_table_refuses_new_sockets_and_updates_known_ones() {
        let mut sockets = Sockets::new(2);
        let socket = |cookie, drops| SocketFacts {
            cookie,
            unidentified_drops: drops,
            ..SocketFacts::default()
        };
        assert!(sockets.put(socket(1, 0)) && sockets.put(socket(2, 0)));
        assert!(!sockets.put(socket(3, 0)) && !sockets.put(socket(2, 0)));
        assert!(sockets.put(socket(2, 7)));
        assert_eq!(sockets.get(2).map(|each| each.unidentified_drops), Some(7));
        assert_eq!((sockets.get(3), size(&sockets)), (None, (2, 2, 1)));
        assert!(sockets.remove(1) && sockets.put(socket(3, 0)));
        sockets.forget(3);
        assert_eq!((sockets.get(3), size(&sockets)), (None, (1, 2, 2)));
    }
}
