//! The latest messages, so that a message in several ports counts once.

use std::collections::{HashSet, VecDeque};

use ros2probe_model::facts::bounded::Bounded;

use crate::tables::RememberedMessages;

/// Identities of the latest messages.
#[derive(Default)]
pub(super) struct RecentMessages {
    pub(super) set: HashSet<Identity>,
    pub(super) order: Bounded<RememberedMessages, VecDeque<Identity>>,
}

/// One use of one buffer, which holds one message.
#[derive(Clone, Copy, PartialEq, Eq, Hash)]
pub(super) struct Identity {
    pub(super) serial: u64,
    pub(super) node: u32,
    pub(super) validity: u32,
}

impl RecentMessages {
    pub(super) fn add(&mut self, identity: Identity) {
        if self.set.insert(identity)
            && let Some(oldest) = self.order.push_back(identity)
        {
            self.set.remove(&oldest);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tables::tests::assert_driven;

    #[test]
    fn messages_beyond_the_cap_evict_the_oldest_one() {
        let identity = |serial| Identity {
            serial,
            node: 0,
            validity: 0,
        };
        let mut recent = RecentMessages::default();
        for serial in 0..10_000 {
            recent.add(identity(serial));
        }
        assert_driven::<RememberedMessages>();
        assert_eq!(recent.set.len(), RememberedMessages::CAP);
        assert!(!recent.set.contains(&identity(0)) && recent.set.contains(&identity(9_999)));
    }
}
