//! Eviction from full tables: which entry is removed for a new one.
//!
//! Silent entries are evicted first. An entry is silent after 5 s if it existed for less than 2 s,
//! otherwise after 90 s. An entry with a socket on this host is never silent. Other entries are
//! evicted only for a new entry with a higher priority: first the lowest priority, and among equals
//! those that are not established, then the longest silence.
//!
//! Names and user data can be forged, too. New entries without a socket on this host displace
//! established entries only until entries with a priority fill half of the table.
//!
//! A search visits the whole table, and a flood would trigger one per packet. Therefore one search
//! serves many new entries, and the rate of searches is limited.

use std::time::Duration;

use ros2probe_wire::{EntityId, Guid};

use super::Discovery;
use super::facts::{Participant, named};
use super::priority::Priority;
use crate::facts::journal::Journal;
use crate::facts::model_time::ModelTime;

/// A participant seen over at least this span is established.
const MIN_ESTABLISHED_SPAN: Duration = Duration::from_secs(2);
/// A participant that is not established is silent after this time without a packet.
const UNESTABLISHED_SILENCE: Duration = Duration::from_secs(5);
/// Any participant is silent after this time without a packet, whatever its lease: real ones
/// announce themselves at least every 30 seconds (RTPS 2.5, 8.5.3.3.2).
pub(super) const MAX_SILENCE: Duration = Duration::from_secs(90);
/// Minimum time between two searches of a full table; it grows with the number of entries.
const SEARCH_INTERVAL: Duration = Duration::from_millis(100);
const SEARCH_TIME_PER_ENTRY: Duration = Duration::from_micros(10);
/// Maximum number of candidates of each kind per search.
const MAX_CANDIDATES: usize = 64;

/// Candidates that a search of one table found.
#[derive(Debug, Default)]
pub(super) struct Victims {
    /// Silent entries, with the lowest priority last.
    silent: Vec<Victim>,
    /// All other entries, with the lowest priority last.
    others: Vec<Victim>,
    /// Entries with a priority but without a socket on this host.
    claims: usize,
    /// Watched entries among `claims`.
    watched_claims: usize,
    search_after: ModelTime,
}

/// An entry that may be evicted.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
struct Victim {
    priority: Priority,
    is_established: bool,
    last_seen: ModelTime,
    /// GUID of an endpoint, or of a participant that is evicted with all its entries.
    guid: Guid,
}

/// A new entry for a full table.
#[derive(Clone, Copy, Debug)]
pub(super) struct Newcomer {
    pub(super) guid: Guid,
    pub(super) priority: Priority,
}

/// A table that can be full.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Table {
    Participants,
    Endpoints,
    /// Nodes and the endpoints that they list; eviction removes all nodes of a participant.
    Nodes,
}

impl Victims {
    fn search(&mut self, discovery: &Discovery, table: Table, now: ModelTime) {
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
            if list.len() > MAX_CANDIDATES {
                list.select_nth_unstable(MAX_CANDIDATES);
                list.truncate(MAX_CANDIDATES);
            }
            list.sort_unstable_by(|one, other| other.cmp(one));
            list.shrink_to(MAX_CANDIDATES);
        }
        self.search_after =
            now + SEARCH_INTERVAL.max(SEARCH_TIME_PER_ENTRY.saturating_mul(visited));
    }

    /// Returns the entry to evict for the new one; `None` if every entry must stay.
    fn next(&mut self, discovery: &Discovery, table: Table, newcomer: Newcomer) -> Option<Guid> {
        let Newcomer { guid, priority } = newcomer;
        // A packet since the search makes an entry active again.
        let is_silent = |victim: &Victim| {
            let participant = discovery.participants.get(&victim.guid.prefix);
            let last_seen_now = participant.map(|participant| participant.last_seen);
            last_seen_now == Some(victim.last_seen) && victim.guid.prefix != guid.prefix
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
            |victim: &Victim| victim.priority == Priority::NO_EVIDENCE && !victim.is_established;
        let goes =
            |victim: &mut Victim| victim.priority < priority && (is_trusted || is_nothing(victim));
        Some(self.others.pop_if(goes)?.guid)
    }

    fn claim(&mut self, priority: Priority) {
        let is_claim = priority != Priority::NO_EVIDENCE && !priority.local;
        self.claims += usize::from(is_claim);
        self.watched_claims += usize::from(is_claim && priority.watched);
    }
}

impl Victim {
    fn of(participant: &Participant, priority: Priority, guid: Guid) -> Self {
        let last_seen = participant.last_seen;
        Self {
            priority,
            is_established: last_seen - participant.first_seen >= MIN_ESTABLISHED_SPAN,
            last_seen,
            guid,
        }
    }
}

impl Discovery {
    /// Evicts an entry from a full table for the new one. Returns false if no entry may be evicted.
    pub(super) fn evict_for(&mut self, table: Table, newcomer: Newcomer, now: ModelTime) -> bool {
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
                self.node_count.refuse_all(nodes.len() as u64);
                self.node_count.sub(nodes.len());
                self.named = self.named.saturating_sub(named(&nodes));
            }
        } else if victim.entity == EntityId::PARTICIPANT {
            self.participants.refuse();
            self.remove(victim.prefix, now, None, &mut Journal::default());
        } else {
            self.endpoints.refuse();
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
            // Victims are participants, which lose all of their nodes.
            Table::Nodes => self.caps.participants,
        }
    }

    /// Returns the priority of an entry, or `None` if it was removed.
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

/// Returns the priority of this participant if it is silent, otherwise `None`.
fn silence_priority(participant: &Participant, now: ModelTime) -> Option<Priority> {
    let last = participant.last_seen;
    let is_silent_for = |silence: Duration| last + silence <= now;
    let priority = participant.priority();
    if priority.local {
        return None;
    }
    if is_silent_for(MAX_SILENCE) {
        return Some(Priority::NO_EVIDENCE);
    }
    let is_established = last - participant.first_seen >= MIN_ESTABLISHED_SPAN;
    (!is_established && is_silent_for(UNESTABLISHED_SILENCE)).then_some(priority)
}

/// Returns the length that remains without the invalid candidates at the end.
fn last(victims: &[Victim], is_valid: impl Fn(&Victim) -> bool) -> usize {
    victims
        .iter()
        .rposition(is_valid)
        .map_or(0, |place| place + 1)
}
