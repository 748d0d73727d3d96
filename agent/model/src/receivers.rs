//! Which participant receives at which socket and address.
//!
//! A socket belongs to the participant that sends by it, or whose process holds it, or for which
//! something directed (INFO_DST) came to it. Which processes participants live in is learned from
//! the sockets they send by, for announced process ids are those of a container, if any. What is
//! directed tells least: RustDDS announces loopback addresses to other hosts, so what their
//! participants send there for one of this host they send to themselves. An address
//! belongs to the participant that announces it, unless several do. A multicast group belongs to
//! nobody: what is directed at one member reaches all. Where nothing tells, or two participants
//! share a socket, the answer is "unknown", never a guess.

mod places;

use std::collections::{HashMap, HashSet, VecDeque};

use ros2probe_wire::record::flag;
use ros2probe_wire::{Guid, GuidPrefix, Record};

use places::Places;

use super::calendar::Calendar;
use super::discovery::Discovery;
use super::size::Size;
use super::snapshot::SocketFacts;
use super::sockets::Sockets;
use super::topic::{Topic, Topics};
use super::way::{Place, Way};

/// Participants remembered of one socket or process.
const OWNERS: usize = 8;
/// Closed sockets remembered, for those who still hold something of them.
const CLOSED: usize = 1024;
/// Addresses kept of one participant.
const PLACES: usize = 16;

/// All that is known of receivers.
#[derive(Debug)]
pub struct Receivers {
    sockets: Sockets,
    learned: HashMap<u64, Learned>,
    processes: HashMap<u32, Owners>,
    /// Participants for which a socket of this host sends, since the last [`Self::tidy`] at most.
    local: HashSet<GuidPrefix>,
    places: Places,
    closed: HashSet<u64>,
    closings: VecDeque<u64>,
    limit: usize,
    generation: u64,
}

/// What the samples of a writer are seen in front of.
#[derive(Clone, Copy, Debug)]
pub struct Around<'a> {
    /// Who receives where.
    pub receivers: &'a Receivers,
    /// Who is there.
    pub discovery: &'a Discovery,
    /// Who reads what.
    pub topics: &'a Topics,
    /// What the clocks of writers are held against.
    pub calendar: Calendar,
}

/// Whether a receiver has a reader of the topic.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Matched {
    /// It has.
    Yes,
    /// Its announcements were seen from the first on, and there is none.
    No,
    /// Not all of its announcements were seen, or the receiver is not known.
    Unknown,
}

/// To whom a socket may belong.
#[derive(Debug, Default)]
struct Learned {
    /// They send by it.
    senders: Owners,
    /// Something directed to them came to it.
    addressed: Owners,
    /// It sent for more participants than are remembered: who forges does that.
    is_crowded: bool,
}

#[derive(Debug, Default)]
struct Owners(Vec<GuidPrefix>);

impl Receivers {
    /// Nothing known; at most `limit` sockets, and the addresses of so many participants.
    #[must_use]
    pub fn new(limit: usize, participants: usize) -> Self {
        Self {
            sockets: Sockets::new(limit),
            learned: HashMap::new(),
            processes: HashMap::new(),
            local: HashSet::new(),
            places: Places::new(participants.saturating_mul(PLACES / 2), PLACES),
            closed: HashSet::new(),
            closings: VecDeque::new(),
            limit,
            generation: 1,
        }
    }

    /// Rises with every change; who compares need not ask again.
    #[must_use]
    pub const fn generation(&self) -> u64 {
        self.generation
    }

    /// Something else changed that answers depend on.
    pub const fn changed(&mut self) {
        self.generation += 1;
    }

    /// The sockets as they were told.
    #[must_use]
    pub const fn sockets(&self) -> &Sockets {
        &self.sockets
    }

    /// Who holds the socket by which each participant sends, as far as that is known.
    #[must_use]
    pub fn holders(&self) -> HashMap<GuidPrefix, &SocketFacts> {
        let mut holders: HashMap<GuidPrefix, &SocketFacts> = HashMap::new();
        for (cookie, learned) in &self.learned {
            let Some(facts) = self.sockets.get(*cookie) else {
                continue;
            };
            for sender in &learned.senders.0 {
                // Of several sockets always the same one.
                let holder = holders.entry(*sender).or_insert(facts);
                let better = |facts: &SocketFacts| (facts.process_id.is_none(), facts.cookie);
                if better(facts) < better(holder) {
                    *holder = facts;
                }
            }
        }
        holders
    }

    /// Whether this socket was closed a while ago.
    #[must_use]
    pub fn is_closed(&self, socket: u64) -> bool {
        self.closed.contains(&socket)
    }

    /// Takes in what is known of a socket.
    pub fn socket(&mut self, facts: SocketFacts) {
        let (cookie, process) = (facts.cookie, facts.process_id);
        let before = self.sockets.get(cookie).and_then(|known| known.process_id);
        self.closed.remove(&cookie);
        let is_new = self.sockets.put(facts);
        if !is_new || process == before {
            return;
        }
        if let (Some(process), Some(learned)) = (process, self.learned.get(&cookie))
            && (self.processes.len() < self.limit || self.processes.contains_key(&process))
        {
            let known = self.processes.entry(process).or_default();
            let senders = learned.senders.0.iter();
            senders.for_each(|owner| known.add(*owner));
        }
        self.generation += 1;
    }

    /// This socket may be open, but the kernel remembers others in its place.
    pub fn socket_forgotten(&mut self, cookie: u64) {
        self.sockets.forget(cookie);
        self.socket_closed(cookie);
    }

    /// This socket is no more.
    pub fn socket_closed(&mut self, cookie: u64) {
        self.sockets.remove(cookie);
        self.learned.remove(&cookie);
        if self.closings.len() >= CLOSED
            && let Some(oldest) = self.closings.pop_front()
        {
            self.closed.remove(&oldest);
        }
        self.closings.push_back(cookie);
        self.closed.insert(cookie);
        self.generation += 1;
    }

    /// Whether a socket of this host sends for this participant.
    #[must_use]
    pub fn is_local(&self, prefix: &GuidPrefix) -> bool {
        self.local.contains(prefix)
    }

    /// Learns from a record whose socket it is. Returns whether a socket of this host sent it that
    /// sends for few participants.
    pub fn learn(&mut self, record: &Record) -> bool {
        if record.flags & flag::HOST == 0 || record.socket == 0 {
            return false;
        }
        // Who told that it was closed may have lost sight of it only.
        if !self.closed.is_empty() {
            self.closed.remove(&record.socket);
        }
        let (sender, directed) = (record.sender(), record.addressee());
        let is_sent = record.flags & flag::OUTGOING != 0;
        if !is_sent && (directed == GuidPrefix::UNKNOWN || Place::of(record).is_multicast()) {
            return false;
        }
        let owner = if is_sent { sender } else { directed };
        let known = self.learned.get(&record.socket);
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
        if known.is_none() && self.learned.len() >= self.limit {
            return false;
        }
        let known = self.learned.entry(record.socket).or_default();
        let mut is_local = false;
        if is_sent {
            known.is_crowded |= known.senders.0.len() >= OWNERS;
            known.senders.add(owner);
            is_local = !known.is_crowded && self.local.len() < self.limit * OWNERS;
            if is_local {
                self.local.insert(owner);
            }
            let facts = self.sockets.get(record.socket);
            if let Some(process) = facts.and_then(|facts| facts.process_id)
                && (self.processes.len() < self.limit || self.processes.contains_key(&process))
            {
                self.processes.entry(process).or_default().add(owner);
            }
        } else {
            known.addressed.add(owner);
        }
        self.generation += 1;
        is_local
    }

    /// A participant announces where it is reached by unicast.
    pub fn announce(&mut self, prefix: GuidPrefix, places: impl Iterator<Item = Place>) {
        for place in places.take(PLACES) {
            self.generation += u64::from(self.places.put(prefix, place));
        }
    }

    /// Addresses, their cap, and those given up because of it.
    #[must_use]
    pub fn addresses(&self) -> (usize, usize, u64) {
        self.places.size()
    }

    /// Entries and cap of every table.
    #[must_use]
    pub fn sizes(&self) -> Vec<Size> {
        // A new table does not compile before it has a place here.
        let Self {
            sockets,
            learned,
            processes,
            local,
            places,
            closed,
            closings,
            limit,
            generation: _,
        } = self;
        let owners = |Owners(owners): &Owners| owners.len();
        let learned_owners = learned.values().map(|learned| {
            let Learned {
                senders,
                addressed,
                is_crowded: _,
            } = learned;
            owners(senders).max(owners(addressed))
        });
        let of_one = learned_owners.chain(processes.values().map(owners)).max();
        let mut sizes = Vec::from(sockets.sizes());
        sizes.extend(places.sizes());
        sizes.extend([
            Size::new("receivers.learned", learned.len(), *limit),
            Size::new("receivers.processes", processes.len(), *limit),
            Size::new("receivers.local", local.len(), *limit * OWNERS),
            Size::new("receivers.owners", of_one.unwrap_or(0), OWNERS),
            Size::new("receivers.closed", closed.len(), CLOSED),
            Size::new("receivers.closings", closings.len(), CLOSED),
        ]);
        sizes
    }

    /// Forgets what participants said that are no more and do not wait for room.
    pub fn tidy(&mut self, discovery: &Discovery) {
        let is_there = |prefix: &GuidPrefix| discovery.knows(*prefix);
        self.places.retain(is_there);
        for learned in self.learned.values_mut() {
            learned.senders.0.retain(is_there);
            learned.addressed.0.retain(is_there);
        }
        self.learned
            .retain(|_, learned| !learned.senders.0.is_empty() || !learned.addressed.0.is_empty());
        for owners in self.processes.values_mut() {
            owners.0.retain(is_there);
        }
        self.processes.retain(|_, owners| !owners.0.is_empty());
        let sockets = self.learned.values().filter(|learned| !learned.is_crowded);
        self.local = sockets
            .flat_map(|learned| learned.senders.0.iter().copied())
            .collect();
    }

    /// The participant that receives what comes this way.
    #[must_use]
    pub fn owner(&self, way: &Way, discovery: &Discovery) -> Option<GuidPrefix> {
        if way.socket != 0 {
            let learned = self.learned.get(&way.socket);
            let facts = self.sockets.get(way.socket);
            let process = facts.and_then(|facts| facts.process_id);
            let lists = [
                learned.map(|learned| &learned.senders),
                process.and_then(|process| self.processes.get(&process)),
                learned.map(|learned| &learned.addressed),
            ];
            // Each list is asked only about those that the ones before leave open.
            let mut open: Vec<GuidPrefix> = Vec::new();
            for owners in lists.into_iter().flatten() {
                let alive = |owner: &&GuidPrefix| discovery.participants().contains_key(*owner);
                let alive: Vec<_> = owners.0.iter().filter(alive).copied().collect();
                let is_open = |owner: &GuidPrefix| open.is_empty() || open.contains(owner);
                let left: Vec<_> = alive.into_iter().filter(is_open).collect();
                if !left.is_empty() {
                    open = left;
                }
                if let [owner] = open[..] {
                    return Some(owner);
                }
            }
            if !open.is_empty() {
                return None;
            }
            let announced = facts.and_then(|facts| facts.own_process_id);
            if let Some(owner) = announced.and_then(|process| announced_in(process, discovery)) {
                return Some(owner);
            }
        }
        let prefix = self.places.owner(&way.place)?;
        let is_known = discovery.participants().contains_key(&prefix);
        (is_known && !way.place.is_multicast()).then_some(prefix)
    }
}

impl Around<'_> {
    /// Whether this participant reads the topic.
    #[must_use]
    pub fn matched(&self, topic: Option<&Topic>, prefix: GuidPrefix) -> Matched {
        let Some(topic) = topic else {
            return Matched::Unknown;
        };
        if readers(topic, prefix).next().is_some() {
            return Matched::Yes;
        }
        match self.discovery.participants().get(&prefix) {
            Some(participant) if participant.readers_told => Matched::No,
            _ => Matched::Unknown,
        }
    }
}

/// This participant's readers of the topic, sorted but for those beside it.
pub fn readers(topic: &Topic, prefix: GuidPrefix) -> impl Iterator<Item = Guid> + '_ {
    [&topic.readers, &topic.beside]
        .into_iter()
        .flat_map(move |list| {
            let start = list.partition_point(|guid| guid.prefix < prefix);
            let own = list.get(start..).unwrap_or_default().iter().copied();
            own.take_while(move |guid| guid.prefix == prefix)
                .filter(|guid| !guid.entity.is_writer())
        })
}

/// The only participant that announces to live in this process, by its own number. Fast DDS says no more than the low
/// 16 bits.
fn announced_in(process: u32, discovery: &Discovery) -> Option<GuidPrefix> {
    let mut announced = discovery.participants().iter().filter(|(_, participant)| {
        participant
            .portrait
            .process_id
            .is_some_and(|id| id == process || id == process & 0xffff)
    });
    let (prefix, _) = announced.next()?;
    announced.next().is_none().then_some(*prefix)
}

impl Owners {
    fn add(&mut self, owner: GuidPrefix) {
        if self.0.contains(&owner) {
            return;
        }
        if self.0.len() >= OWNERS {
            self.0.remove(0);
        }
        self.0.push(owner);
    }
}
