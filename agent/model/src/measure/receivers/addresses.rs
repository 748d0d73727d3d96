//! Addresses that participants announce.
//!
//! Two bounds apply, because a forger may announce a new address each time: one per participant and
//! one in total. The most recently announced addresses are kept.

use std::collections::{BTreeMap, BTreeSet};

use foldhash::HashMap;
use ros2probe_wire::GuidPrefix;

use crate::facts::bounded::TableFacts;
use crate::facts::bounded::{Bounded, Counted};
use crate::facts::route::Destination;
use crate::facts::tables::Addresses;

/// All announced addresses.
#[derive(Debug)]
pub(super) struct AnnouncedAddresses {
    announcers: Bounded<Counted<Addresses>, HashMap<Destination, Announcer>>,
    /// Addresses in the order of their announcements.
    ages: Bounded<Counted<Addresses>, BTreeMap<u64, Destination>>,
    /// The same order, per participant.
    by_participant: Bounded<Counted<Addresses>, BTreeSet<(GuidPrefix, u64)>>,
    age: u64,
    each: usize,
}

#[derive(Clone, Copy, Debug)]
struct Announcer {
    prefix: GuidPrefix,
    previous: Option<GuidPrefix>,
    /// Whether two participants announce the address alternately.
    contested: bool,
    age: u64,
}

impl AnnouncedAddresses {
    /// Creates an empty table of at most `limit` addresses, `each` per participant.
    pub(super) fn new(limit: usize, each: usize) -> Self {
        Self {
            announcers: Bounded::capped(limit),
            ages: Bounded::capped(limit),
            by_participant: Bounded::capped(limit),
            age: 0,
            each,
        }
    }

    /// Records an announced address. Returns whether results may have changed.
    pub(super) fn put(&mut self, prefix: GuidPrefix, destination: Destination) -> bool {
        self.age += 1;
        let before = self.announcers.get(&destination).copied();
        let (previous, contested) = match before {
            Some(before) if before.prefix == prefix => (before.previous, before.contested),
            Some(before) => (
                Some(before.prefix),
                before.contested || before.previous == Some(prefix),
            ),
            None => (None, false),
        };
        if let Some(before) = before {
            self.ages.remove(&before.age);
            self.by_participant.remove(&(before.prefix, before.age));
        }
        let own = || self.by_participant.range((prefix, 0)..=(prefix, u64::MAX));
        let oldest = own().next().filter(|_| own().count() >= self.each);
        if let Some((_, age)) = oldest.copied() {
            self.drop_oldest(age);
        }
        if before.is_none()
            && self.announcers.is_full()
            && let Some((age, _)) = self.ages.first_key_value()
        {
            self.drop_oldest(*age);
        }
        let age = self.age;
        let announcer = Announcer {
            prefix,
            previous,
            contested,
            age,
        };
        self.announcers.insert(destination, announcer);
        self.ages.insert(age, destination);
        self.by_participant.insert((prefix, age));
        before.is_none_or(|before| before.prefix != prefix)
    }

    /// Removes the addresses of participants for which `is_there` returns false.
    pub(super) fn retain(&mut self, is_there: impl Fn(&GuidPrefix) -> bool) {
        self.announcers
            .retain(|_, announcer| is_there(&announcer.prefix));
        self.by_participant.retain(|(prefix, _)| is_there(prefix));
        let announcers = &self.announcers;
        self.ages
            .retain(|_, destination| announcers.contains_key(destination));
    }

    /// Returns the last participant that announced this address, unless two announce it
    /// alternately.
    pub(super) fn owner(&self, destination: &Destination) -> Option<GuidPrefix> {
        let announcer = self.announcers.get(destination)?;
        (!announcer.contested).then_some(announcer.prefix)
    }

    /// Returns the size, limit and evictions of the table.
    pub(super) fn table(&self) -> TableFacts {
        self.announcers.facts()
    }

    fn drop_oldest(&mut self, age: u64) {
        let announcer = self
            .ages
            .remove(&age)
            .and_then(|destination| self.announcers.remove(&destination));
        if let Some(announcer) = announcer {
            self.by_participant.remove(&(announcer.prefix, age));
            self.announcers.refuse();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ALICE: GuidPrefix = GuidPrefix([1; 12]);
    const BOB: GuidPrefix = GuidPrefix([2; 12]);

    fn size(addresses: &AnnouncedAddresses) -> (u64, u64, u64) {
        let facts = addresses.table();
        (facts.size, facts.limit, facts.evictions)
    }

    fn at(port: u16) -> Destination {
        Destination {
            port,
            ..Destination::default()
        }
    }

    #[test]
    fn a_participant_with_ever_new_addresses_displaces_only_its_own() {
        let mut addresses = AnnouncedAddresses::new(100, 16);
        addresses.put(BOB, at(7411));
        (8000..9000).for_each(|port| assert!(addresses.put(ALICE, at(port))));
        assert_eq!(size(&addresses), (17, 100, 1000 - 16));
        assert_eq!(addresses.owner(&at(7411)), Some(BOB));
        assert_eq!(addresses.owner(&at(8999)), Some(ALICE));
        assert_eq!(addresses.owner(&at(8000)), None);
        assert_eq!(
            (addresses.ages.len(), addresses.by_participant.len()),
            (17, 17)
        );
    }

    #[test]
    fn a_full_table_drops_the_oldest_address_of_all_participants() {
        let mut addresses = AnnouncedAddresses::new(4, 2);
        for number in 0..100 {
            let prefix = GuidPrefix([number; 12]);
            addresses.put(prefix, at(number.into()));
            addresses.put(BOB, at(7411));
        }
        assert_eq!(size(&addresses), (4, 4, 97));
        assert_eq!(addresses.owner(&at(7411)), Some(BOB));
        addresses.retain(|prefix| *prefix == BOB);
        assert_eq!(size(&addresses).0, 1);
        assert_eq!(
            (addresses.ages.len(), addresses.by_participant.len()),
            (1, 1)
        );
    }

    #[test]
    fn an_address_that_two_participants_announce_alternately_has_no_owner() {
        let mut addresses = AnnouncedAddresses::new(4, 2);
        addresses.put(ALICE, at(1));
        assert!(addresses.put(BOB, at(1)));
        assert_eq!(addresses.owner(&at(1)), Some(BOB));
        assert!(!addresses.put(BOB, at(1)));
        assert!(addresses.put(ALICE, at(1)));
        assert_eq!(addresses.owner(&at(1)), None);
        assert_eq!(size(&addresses), (1, 4, 0));
    }
}
