//! What is known of this host's sockets from outside the packets: who holds them, and what died
//! there without a name.
//!
//! Told by whoever reads the kernel's tables; nothing here looks anywhere. Bounded: when full, a
//! new socket is refused and counted, for the ones at hand have been told apart already.

use std::collections::BTreeMap;
use std::sync::Arc;

use super::size::Size;

/// What is known of one socket from outside the packets.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct SocketFacts {
    /// `SO_COOKIE`.
    pub cookie: u64,
    /// Process that holds it.
    pub process_id: Option<u32>,
    /// The same process as it knows itself: in a container another number, which is the one that
    /// participants announce.
    pub own_process_id: Option<u32>,
    /// Its name.
    pub process: Option<Arc<str>>,
    /// Control group, as a path below the root.
    pub cgroup: Option<Arc<str>>,
    /// Datagrams that the socket had no room for and of which it is not known what they held.
    pub unidentified_drops: u64,
}

/// All known sockets.
#[derive(Debug)]
pub struct Sockets {
    sockets: BTreeMap<u64, SocketFacts>,
    limit: usize,
    evictions: u64,
}

impl Sockets {
    /// None known, at most `limit`.
    #[must_use]
    pub const fn new(limit: usize) -> Self {
        Self {
            sockets: BTreeMap::new(),
            limit,
            evictions: 0,
        }
    }

    /// Entries and cap.
    #[must_use]
    pub fn sizes(&self) -> [Size; 1] {
        // A new table does not compile before it has a place here.
        let Self {
            sockets,
            limit,
            evictions: _,
        } = self;
        [Size::new("receivers.sockets", sockets.len(), *limit)]
    }

    /// Takes in what is known of one; whether that is new.
    pub fn put(&mut self, facts: SocketFacts) -> bool {
        let known = self.sockets.get(&facts.cookie);
        if known == Some(&facts) {
            return false;
        }
        if known.is_none() && self.sockets.len() >= self.limit {
            self.evictions += 1;
            return false;
        }
        self.sockets.insert(facts.cookie, facts);
        true
    }

    /// One was closed; whether it was known.
    pub fn remove(&mut self, cookie: u64) -> bool {
        self.sockets.remove(&cookie).is_some()
    }

    /// One that is open was forgotten where sockets are told from: others took its place.
    pub fn forget(&mut self, cookie: u64) {
        self.evictions += 1;
        self.remove(cookie);
    }

    /// One of them.
    #[must_use]
    pub fn get(&self, cookie: u64) -> Option<&SocketFacts> {
        self.sockets.get(&cookie)
    }

    /// Entries, cap, and sockets refused or forgotten because of one.
    #[must_use]
    pub fn size(&self) -> (usize, usize, u64) {
        (self.sockets.len(), self.limit, self.evictions)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_full_table_keeps_whom_it_knows() {
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
        assert_eq!((sockets.get(3), sockets.size()), (None, (2, 2, 1)));
        assert!(sockets.remove(1) && sockets.put(socket(3, 0)));
        sockets.forget(3);
        assert_eq!((sockets.get(3), sockets.size()), (None, (1, 2, 2)));
    }
}
