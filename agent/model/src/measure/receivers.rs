//! Maps sockets and addresses to the participants that receive there.
//!
//! A socket belongs to the participant that sends through it, whose process owns it, or at which a
//! message at the socket is directed (INFO_DST). The process of a participant is learned from the
//! sockets through which it sends, because announced process ids may be those of a container.
//! INFO_DST is the weakest evidence: RustDDS announces loopback addresses to other hosts, so their
//! participants send messages for this host to themselves. An address belongs to the participant
//! that announces it, unless several do. A multicast group belongs to no participant, because
//! directed messages reach all members. Without evidence, or if two participants share a socket,
//! the result is "unknown".

mod addresses;
mod matched;

use std::collections::VecDeque;

use foldhash::{HashMap, HashMapExt as _, HashSet};
use ros2probe_wire::{DomainId, Guid, GuidPrefix};

use addresses::AnnouncedAddresses;
pub use matched::{Matched, MatchedReaders};

use crate::facts::bounded::TableFacts;
use crate::facts::bounded::{Bounded, Counted};
use crate::facts::observation::{Head, Observation, Path};
use crate::facts::route::{Destination, Route};
use crate::facts::tables::{
    ClosedSockets, LocalParticipants, ParticipantsHere, SocketOwners, SocketProcesses, UsedSockets,
};
use crate::facts::wall_clock::WallClock;
use crate::graph::discovery::Discovery;
use crate::graph::sockets::SocketFacts;
use crate::graph::sockets::Sockets;
use crate::measure::topic::Topics;

/// Maximum number of addresses kept per participant.
const MAX_ADDRESSES: usize = 16;

/// All evidence about receivers.
#[derive(Debug)]
pub struct Receivers {
    sockets: Sockets,
    socket_users: Bounded<Counted<UsedSockets>, HashMap<u64, SocketUsers>>,
    processes: Bounded<Counted<SocketProcesses>, HashMap<u32, Candidates>>,
    /// Participants that send through a socket of this host. [`Self::remove_unknown`] rebuilds the
    /// set.
    local: Bounded<Counted<LocalParticipants>, HashSet<GuidPrefix>>,
    /// Participants whose messages left this host through an unobserved socket or shared memory.
    local_by_departure: Bounded<Counted<ParticipantsHere>, HashSet<GuidPrefix>>,
    addresses: AnnouncedAddresses,
    closed: Bounded<ClosedSockets, HashSet<u64>>,
    closed_order: Bounded<ClosedSockets, VecDeque<u64>>,
    generation: u64,
}

/// The graph, which the measurement of each sample consults.
#[derive(Debug)]
pub struct Graph {
    /// Sockets and addresses of receivers.
    pub receivers: Receivers,
    /// Participants and endpoints.
    pub discovery: Discovery,
    /// Readers and writers of each topic.
    pub topics: Topics,
    /// Difference between model time and wall time, for timestamps of writers.
    pub wall_clock: WallClock,
}

impl Graph {
    /// Returns the publisher or subscription of an endpoint: for a buffer endpoint that of its base
    /// topic, otherwise the endpoint itself.
    #[must_use]
    pub fn base_of(&self, guid: Guid) -> Guid {
        let base = || {
            let endpoint = self.discovery.endpoints().get(&guid)?;
            let naming = endpoint.naming().filter(|naming| naming.is_buffer)?;
            let topic = self.topics.find(endpoint.domain_id, &naming)?;
            self.topics.get(topic)?.base_of(guid, endpoint.base)
        };
        base().unwrap_or(guid)
    }
}

/// Participants to which a socket may belong.
#[derive(Debug, Default)]
struct SocketUsers {
    /// Participants that send through it.
    senders: Candidates,
    /// Participants for which a directed message arrived at it.
    addressed: Candidates,
    /// Whether more participants send through it than are remembered, which indicates forgery.
    is_crowded: bool,
}

#[derive(Debug, Default)]
struct Candidates(Bounded<SocketOwners, VecDeque<GuidPrefix>>);

impl Receivers {
    /// Creates an empty state for at most `limit` sockets and the addresses of `participants`
    /// participants.
    #[must_use]
    pub fn new(limit: usize, participants: usize) -> Self {
        Self {
            sockets: Sockets::new(limit),
            socket_users: Bounded::capped(limit),
            processes: Bounded::capped(limit),
            local: Bounded::capped(limit * SocketOwners::CAP),
            local_by_departure: Bounded::capped(limit * SocketOwners::CAP),
            addresses: AnnouncedAddresses::new(
                participants.saturating_mul(MAX_ADDRESSES / 2),
                MAX_ADDRESSES,
            ),
            closed: Bounded::default(),
            closed_order: Bounded::default(),
            generation: 1,
        }
    }

    /// Returns a number that increases with every change, so that callers can cache results.
    #[must_use]
    pub const fn generation(&self) -> u64 {
        self.generation
    }

    /// Records an external change that affects results.
    pub const fn changed(&mut self) {
        self.generation += 1;
    }

    /// Returns the known sockets.
    #[must_use]
    pub const fn sockets(&self) -> &Sockets {
        &self.sockets
    }

    /// Returns, by participant, the facts of a socket through which it sends. If that socket was
    /// closed, another socket of the same process replaces it.
    #[must_use]
    pub fn holders(&self) -> HashMap<GuidPrefix, &SocketFacts> {
        let mut holders: HashMap<GuidPrefix, &SocketFacts> = HashMap::new();
        for (cookie, users) in &self.socket_users {
            let Some(facts) = self.sockets.get(*cookie) else {
                continue;
            };
            for sender in &users.senders.0 {
                // The choice among several sockets is deterministic.
                let holder = holders.entry(*sender).or_insert(facts);
                let better = |facts: &SocketFacts| (facts.process_id.is_none(), facts.cookie);
                if better(facts) < better(holder) {
                    *holder = facts;
                }
            }
        }
        for facts in self.sockets.iter() {
            let candidates = facts.process_id.and_then(|id| self.processes.get(&id));
            for sender in candidates.into_iter().flat_map(|known| &known.0) {
                holders.entry(*sender).or_insert(facts);
            }
        }
        holders
    }

    /// Returns whether this socket was closed recently.
    #[must_use]
    pub fn is_closed(&self, socket: u64) -> bool {
        self.closed.contains(&socket)
    }

    /// Records facts about a socket.
    pub fn socket(&mut self, facts: SocketFacts) {
        let (cookie, process) = (facts.cookie, facts.process_id);
        let before = self.sockets.get(cookie).and_then(|known| known.process_id);
        self.closed.remove(&cookie);
        let is_new = self.sockets.put(facts);
        if !is_new || process == before {
            return;
        }
        if let (Some(process), Some(users)) = (process, self.socket_users.get(&cookie))
            && let Some(known) = self
                .processes
                .get_or_insert_with(process, Candidates::default)
        {
            let senders = users.senders.0.iter();
            senders.for_each(|owner| known.add(*owner));
        }
        self.generation += 1;
    }

    /// Records that the kernel's table dropped this socket, which may still be open.
    pub fn socket_forgotten(&mut self, cookie: u64) {
        self.sockets.forget(cookie);
        self.socket_closed(cookie);
    }

    /// Records that this socket was closed.
    pub fn socket_closed(&mut self, cookie: u64) {
        self.sockets.remove(cookie);
        self.socket_users.remove(&cookie);
        if let Some(oldest) = self.closed_order.push_back(cookie) {
            self.closed.remove(&oldest);
        }
        self.closed.insert(cookie);
        self.generation += 1;
    }

    /// Returns the only Zenoh session of a process, or `None` if there are several.
    #[must_use]
    pub fn session_in(&self, process_id: u32) -> Option<GuidPrefix> {
        let candidates = self.processes.get(&process_id)?;
        let mut sessions = candidates.0.iter().filter(|prefix| prefix.is_zenoh());
        sessions
            .next()
            .filter(|_| sessions.next().is_none())
            .copied()
    }

    /// Returns whether this participant sends from this host.
    #[must_use]
    pub fn is_local(&self, prefix: &GuidPrefix) -> bool {
        self.local.contains(prefix) || self.local_by_departure.contains(prefix)
    }

    /// Records that a message of this participant left this host through an unobserved socket or
    /// shared memory. Returns false if the table is full.
    pub fn note_local(&mut self, prefix: GuidPrefix) -> bool {
        self.local_by_departure.insert(prefix) || self.local_by_departure.contains(&prefix)
    }

    /// Learns the owner of a socket from an observation. Returns whether a socket of this host sent
    /// the message, unless that socket sends for too many participants.
    pub fn learn(&mut self, observation: &Observation) -> bool {
        let Head {
            path: Path::Socket,
            socket: socket @ 1..,
            destination,
            ..
        } = *observation.head()
        else {
            return false;
        };
        // A socket that was reported as closed may still be open if the kernel's table dropped it.
        if !self.closed.is_empty() {
            self.closed.remove(&socket);
        }
        let (sender, directed) = (observation.sender(), observation.addressee());
        let is_sent = observation.head().is_sent();
        if !is_sent && (directed == GuidPrefix::UNKNOWN || destination.is_multicast()) {
            return false;
        }
        let owner = if is_sent { sender } else { directed };
        let known = self.socket_users.get(&socket);
        let list = known.map(|known| {
            if is_sent {
                &known.senders
            } else {
                &known.addressed
            }
        });
        if list.is_some_and(|list| list.0.contains(&owner)) {
            return is_sent && known.is_some_and(|known| !known.is_crowded);
        }
        let Some(known) = self
            .socket_users
            .get_or_insert_with(socket, SocketUsers::default)
        else {
            return false;
        };
        let mut is_local = false;
        if is_sent {
            known.is_crowded |= known.senders.0.is_full();
            known.senders.add(owner);
            is_local = !known.is_crowded && !self.local.is_full();
            if is_local {
                self.local.insert(owner);
            }
            let facts = self.sockets.get(socket);
            if let Some(process) = facts.and_then(|facts| facts.process_id)
                && let Some(known) = self
                    .processes
                    .get_or_insert_with(process, Candidates::default)
            {
                known.add(owner);
            }
        } else {
            known.addressed.add(owner);
        }
        self.generation += 1;
        is_local
    }

    /// Records that this participant owns a socket of this host.
    pub fn add_owner(&mut self, socket: u64, owner: GuidPrefix) {
        let Some(known) = self
            .socket_users
            .get_or_insert_with(socket, SocketUsers::default)
        else {
            return;
        };
        known.senders = Candidates::default();
        known.senders.add(owner);
        self.local.insert(owner);
        let facts = self.sockets.get(socket);
        if let Some(process) = facts.and_then(|facts| facts.process_id)
            && let Some(known) = self
                .processes
                .get_or_insert_with(process, Candidates::default)
        {
            known.add(owner);
        }
        self.generation += 1;
    }

    /// Withdraws a claim of [`Self::add_owner`]: the participant may not own the socket.
    pub fn remove_owner(&mut self, socket: u64, owner: GuidPrefix) {
        let users = self
            .socket_users
            .get_mut(&socket)
            .map(|users| &mut users.senders);
        let process = self.sockets.get(socket).and_then(|facts| facts.process_id);
        let process = process.and_then(|process| self.processes.get_mut(&process));
        for candidates in users.into_iter().chain(process) {
            candidates.0.retain(|known| *known != owner);
        }
        self.generation += 1;
    }

    /// Records the announced unicast addresses of a participant.
    pub fn announce(&mut self, prefix: GuidPrefix, addresses: impl Iterator<Item = Destination>) {
        for destination in addresses.take(MAX_ADDRESSES) {
            self.generation += u64::from(self.addresses.put(prefix, destination));
        }
    }

    /// Returns the sizes and limits of the tables of sockets and addresses.
    #[must_use]
    pub fn tables(&self) -> [TableFacts; 2] {
        [self.sockets.table(), self.addresses.table()]
    }

    /// Removes the evidence of participants that neither exist nor wait for a free entry in
    /// discovery.
    pub fn remove_unknown(&mut self, discovery: &Discovery) {
        let is_there = |prefix: &GuidPrefix| discovery.knows(*prefix);
        self.addresses.retain(is_there);
        self.local_by_departure.retain(is_there);
        for users in self.socket_users.values_mut() {
            users.senders.0.retain(is_there);
            users.addressed.0.retain(is_there);
        }
        self.socket_users
            .retain(|_, users| !users.senders.0.is_empty() || !users.addressed.0.is_empty());
        for candidates in self.processes.values_mut() {
            candidates.0.retain(is_there);
        }
        self.processes
            .retain(|_, candidates| !candidates.0.is_empty());
        let sockets = self.socket_users.values().filter(|users| !users.is_crowded);
        self.local.clear();
        for owner in sockets.flat_map(|users| users.senders.0.iter()) {
            self.local.insert(*owner);
        }
    }

    /// Returns the participant that receives on this route, if there is only one candidate.
    #[must_use]
    pub fn owner(&self, route: &Route, discovery: &Discovery) -> Option<GuidPrefix> {
        match self.owners(route, discovery, None)[..] {
            [owner] => Some(owner),
            _ => None,
        }
    }

    /// Returns the candidates for the participant that receives on this route. `domain_id` is the
    /// domain of the samples' topic, if known.
    #[must_use]
    pub fn owners(
        &self,
        route: &Route,
        discovery: &Discovery,
        domain_id: Option<DomainId>,
    ) -> Vec<GuidPrefix> {
        if route.socket != 0 {
            let users = self.socket_users.get(&route.socket);
            let facts = self.sockets.get(route.socket);
            let process = facts.and_then(|facts| facts.process_id);
            let lists = [
                users.map(|users| &users.senders),
                process.and_then(|process| self.processes.get(&process)),
                users.map(|users| &users.addressed),
            ];
            // Each list narrows the candidates that the previous lists left.
            let mut open: Vec<GuidPrefix> = Vec::new();
            for candidates in lists.into_iter().flatten() {
                let alive = |owner: &&GuidPrefix| discovery.participants().contains_key(*owner);
                let alive: Vec<_> = candidates.0.iter().filter(alive).copied().collect();
                let is_open = |owner: &GuidPrefix| open.is_empty() || open.contains(owner);
                let left: Vec<_> = alive.into_iter().filter(is_open).collect();
                if !left.is_empty() {
                    open = left;
                }
                if open.len() == 1 {
                    return open;
                }
            }
            if !open.is_empty() {
                let is_there = |owner: &GuidPrefix| {
                    let known = discovery.participants().get(owner);
                    known.map(|participant| participant.domain_id) == domain_id
                };
                if open.iter().any(is_there) {
                    open.retain(is_there);
                }
                return open;
            }
            let announced = facts.and_then(|facts| facts.own_process_id);
            if let Some(owner) =
                announced.and_then(|process| participant_of_process(process, discovery))
            {
                return vec![owner];
            }
        }
        let owner = self.addresses.owner(&route.destination);
        let is_known = |prefix: &GuidPrefix| discovery.participants().contains_key(prefix);
        let owner = owner.filter(|_| !route.destination.is_multicast());
        owner.filter(is_known).into_iter().collect()
    }
}

/// Returns the only participant that announces this process id, or `None`. Fast DDS announces only
/// the low 16 bits.
fn participant_of_process(process: u32, discovery: &Discovery) -> Option<GuidPrefix> {
    let mut announced = discovery.participants().iter().filter(|(_, participant)| {
        participant
            .proxy
            .process_id
            .is_some_and(|id| id == process || id == process & 0xffff)
    });
    let (prefix, _) = announced.next()?;
    announced.next().is_none().then_some(*prefix)
}

impl Candidates {
    fn add(&mut self, owner: GuidPrefix) {
        if !self.0.contains(&owner) {
            self.0.push_back(owner);
        }
    }
}
