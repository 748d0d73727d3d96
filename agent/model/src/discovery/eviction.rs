//! Room in a full table: which entry goes for a newcomer.
//!
//! An entry is doubtful that is heard no more: after 5 s where it was there for less than 2 s, else
//! after 90 s; one with a socket on this host never is. Doubtful ones go first. Any other goes only
//! for a newcomer that is worth more, and the least worth of them that has been silent longest goes.
//!
//! Names and user data can be forged, too. So newcomers without a socket on this host displace what
//! is worth something, or was there for 2 s, only until their like fill half of the table.
//!
//! A search visits the whole table, and a flood makes one necessary for every packet: one search
//! serves many newcomers, and searches wait for each other.

use ros2probe_wire::{EntityId, Guid, Timestamp};

use super::facts::{Participant, named};
use super::priority::Priority;
use super::{Discovery, SECOND};
use crate::journal::Journal;

/// A participant that was seen over this span is no forgery of the moment.
const ESTABLISHED: u64 = 2 * SECOND;
/// One that is not established makes room after this long without a word.
const UNESTABLISHED_SILENCE: u64 = 5 * SECOND;
/// Any participant makes room after this long without a word, whatever its lease: real ones repeat
/// themselves at least every 30 seconds (RTPS 2.5, 8.5.3.3.2).
pub(super) const FORSAKEN: u64 = 90 * SECOND;
/// How often a full table is searched for room: at most, and for each of its entries.
const SEARCH: u64 = SECOND / 10;
const SEARCH_EACH: u64 = 10_000;
/// Entries that one search finds, of each kind.
const FOUND: usize = 64;

/// What a search of one table found.
#[derive(Debug, Default)]
pub(super) struct Victims {
    /// Heard no more, the least worth last.
    silent: Vec<Victim>,
    /// All others, likewise.
    others: Vec<Victim>,
    /// Entries that are worth something without a socket on this host.
    claims: usize,
    /// Those of them that are watched.
    watched_claims: usize,
    search_after: Timestamp,
}

/// One entry that may go.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
struct Victim {
    priority: Priority,
    is_established: bool,
    last_seen: Timestamp,
    /// An endpoint, or a participant with all it has.
    guid: Guid,
}

/// An entry for which there is no room.
#[derive(Clone, Copy, Debug)]
pub(super) struct Newcomer {
    pub(super) guid: Guid,
    pub(super) priority: Priority,
}

/// A table that may be full.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Table {
    Participants,
    Endpoints,
    /// Nodes and what they name: a participant gives up all of its own.
    Nodes,
}

impl Victims {
    /// Entries that were found and are still there to go.
    pub(super) fn len(&self) -> usize {
        let Self {
            silent,
            others,
            claims: _,
            watched_claims: _,
            search_after: _,
        } = self;
        silent.len() + others.len()
    }

    /// Most that there may be.
    pub(super) const CAP: usize = 2 * FOUND;

    fn search(&mut self, discovery: &Discovery, table: Table, now: Timestamp) {
        self.silent.clear();
        self.others.clear();
        (self.claims, self.watched_claims) = (0, 0);
        let mut visited = 0;
        for (prefix, participant) in &discovery.participants {
            let own = Guid::new(*prefix, EntityId::PARTICIPANT);
            let priority = participant.priority();
            visited += 1;
            match table {
                Table::Endpoints if participant.endpoints.is_empty() => continue,
                Table::Nodes if participant.nodes.is_empty() => continue,
                Table::Endpoints => {}
                Table::Participants | Table::Nodes => self.claim(priority),
            }
            if let Some(priority) = silence_priority(participant, now) {
                self.silent.push(Victim::of(participant, priority, own));
                continue;
            }
            if table != Table::Endpoints {
                self.others.push(Victim::of(participant, priority, own));
                continue;
            }
            for guid in &participant.endpoints {
                let endpoint = discovery.endpoints.get(guid);
                let watched = endpoint.is_some_and(|endpoint| endpoint.watched);
                let priority = Priority {
                    watched,
                    ..priority
                };
                visited += 1;
                self.claim(priority);
                self.others.push(Victim::of(participant, priority, *guid));
            }
        }
        for list in [&mut self.silent, &mut self.others] {
            if list.len() > FOUND {
                list.select_nth_unstable(FOUND);
                list.truncate(FOUND);
            }
            list.sort_unstable_by(|one, other| other.cmp(one));
            list.shrink_to(FOUND);
        }
        let pause = SEARCH.max(SEARCH_EACH * visited);
        self.search_after = Timestamp(now.0.saturating_add(pause));
    }

    /// The next entry that goes for a newcomer of this worth.
    fn next(&mut self, discovery: &Discovery, table: Table, newcomer: Newcomer) -> Option<Guid> {
        let Newcomer { guid, priority } = newcomer;
        // What was said since the search speaks for an entry.
        let is_silent = |victim: &Victim| {
            let participant = discovery.participants.get(&victim.guid.prefix);
            let heard = participant.map(|participant| participant.last_seen);
            heard == Some(victim.last_seen) && victim.guid.prefix != guid.prefix
        };
        self.silent.truncate(last(&self.silent, is_silent));
        if let Some(victim) = self.silent.pop_if(|victim| victim.priority <= priority) {
            return Some(victim.guid);
        }
        let is_same = |victim: &Victim| discovery.priority(victim.guid) == Some(victim.priority);
        self.others.truncate(last(&self.others, is_same));
        let claims = match priority.watched {
            true => self.watched_claims,
            false => self.claims,
        };
        let is_trusted = priority.local || claims * 2 < discovery.cap(table);
        let is_nothing =
            |victim: &Victim| victim.priority == Priority::NOTHING && !victim.is_established;
        let goes =
            |victim: &mut Victim| victim.priority < priority && (is_trusted || is_nothing(victim));
        Some(self.others.pop_if(goes)?.guid)
    }

    fn claim(&mut self, priority: Priority) {
        let is_claim = priority != Priority::NOTHING && !priority.local;
        self.claims += usize::from(is_claim);
        self.watched_claims += usize::from(is_claim && priority.watched);
    }
}

impl Victim {
    fn of(participant: &Participant, priority: Priority, guid: Guid) -> Self {
        let last_seen = participant.last_seen;
        Self {
            priority,
            is_established: last_seen.0.saturating_sub(participant.first_seen.0) >= ESTABLISHED,
            last_seen,
            guid,
        }
    }
}

impl Discovery {
    /// Gives up an entry of a full table for this newcomer, where one may go.
    pub(super) fn evict_for(&mut self, table: Table, newcomer: Newcomer, now: Timestamp) -> bool {
        let mut victims = std::mem::take(self.victims(table));
        if now >= victims.search_after {
            victims.search(self, table, now);
        }
        let victim = victims.next(self, table, newcomer);
        *self.victims(table) = victims;
        let Some(victim) = victim else {
            return false;
        };
        self.revision += 1;
        if table == Table::Nodes {
            if let Some(participant) = self.participants.get_mut(&victim.prefix) {
                let nodes = std::mem::take(&mut participant.nodes);
                self.evictions.nodes += nodes.len() as u64;
                self.node_count = self.node_count.saturating_sub(nodes.len());
                self.named = self.named.saturating_sub(named(&nodes));
            }
        } else if victim.entity == EntityId::PARTICIPANT {
            self.evictions.participants += 1;
            self.remove(victim.prefix, now, None, &mut Journal::default());
        } else {
            self.evictions.endpoints += 1;
            if let Some(participant) = self.participants.get_mut(&victim.prefix) {
                participant.endpoints.remove(&victim);
            }
            self.drop_endpoint(victim, None, now, &mut Journal::default());
        }
        true
    }

    const fn victims(&mut self, table: Table) -> &mut Victims {
        match table {
            Table::Participants => &mut self.participant_victims,
            Table::Endpoints => &mut self.endpoint_victims,
            Table::Nodes => &mut self.node_victims,
        }
    }

    const fn cap(&self, table: Table) -> usize {
        match table {
            Table::Participants => self.caps.participants,
            Table::Endpoints => self.caps.endpoints,
            // Half of those that may be there.
            Table::Nodes => self.caps.participants,
        }
    }

    /// What an entry is worth that is there.
    fn priority(&self, guid: Guid) -> Option<Priority> {
        let priority = self.participants.get(&guid.prefix)?.priority();
        if guid.entity == EntityId::PARTICIPANT {
            return Some(priority);
        }
        let watched = self.endpoints.get(&guid)?.watched;
        Some(Priority {
            watched,
            ..priority
        })
    }
}

/// As how much this participant counts if it is heard no more.
fn silence_priority(participant: &Participant, now: Timestamp) -> Option<Priority> {
    let last = participant.last_seen.0;
    let is_silent_for = |span: u64| last.saturating_add(span) <= now.0;
    let priority = participant.priority();
    if priority.local {
        return None;
    }
    if is_silent_for(FORSAKEN) {
        return Some(Priority::NOTHING);
    }
    let is_established = last.saturating_sub(participant.first_seen.0) >= ESTABLISHED;
    (!is_established && is_silent_for(UNESTABLISHED_SILENCE)).then_some(priority)
}

/// How many are left when those at the end have gone of which `is_valid` does not hold.
fn last(victims: &[Victim], is_valid: impl Fn(&Victim) -> bool) -> usize {
    victims
        .iter()
        .rposition(is_valid)
        .map_or(0, |place| place + 1)
}
