//! Offsets between the clocks of hosts, with bounds, from traffic alone.
//!
//! A message that a peer stamps at `s` arrives at `a`. The peer's clock was at least `s` then, so
//! it is ahead of this host's clock by at least `s - a`. Most messages are late, so the greatest of
//! these values counts. The other bound needs a message of this host that reached the peer:
//!
//! - A reply follows its request. A request that left at `d` and a reply stamped `s` show that the
//!   peer is ahead by at most `s - d`. This holds whatever the network does.
//! - An ACKNACK has no stamp, but it follows the message that it acknowledges, and the HEARTBEAT that
//!   requested it. The time from the later one is a round trip. The peer is ahead by at most the
//!   lower bound and the fastest round trip. This assumes that the fastest of many messages took no
//!   longer than that.
//!
//! Each bound widens with its age, because clocks drift. Without the second bound the offset is
//! unknown. All values refer to model time, so a step of this host's clock changes none of them.

mod bounds;

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::net::IpAddr;
use std::sync::Arc;
use std::time::Duration;

use ros2probe_wire::{Guid, SequenceNumber, Timestamp};

use crate::facts::bounded::{Bounded, Counted, TableFacts};
use crate::facts::diagnosis::Diagnosis;
use crate::facts::model_time::ModelTime;
use crate::facts::tables::{ClockPeers, ClockWriters};
use crate::facts::wall_clock::WallClock;
use bounds::Evidence;
pub use bounds::{Range, Source};

/// Name of the agent's host in answers if no participant announces it.
pub const THIS_HOST: &str = "localhost";
/// Latest messages of one writer whose acknowledgement gives a round trip.
const MAX_SENT_PER_WRITER: usize = 16;
/// An ACKNACK answers no HEARTBEAT that left longer before it.
const MAX_RESPONSE_DELAY: Duration = Duration::from_millis(500);
/// Latest messages of writers that no peer has acknowledged so far.
const MAX_UNACKNOWLEDGED_WRITERS: usize = 32;
/// Nanoseconds between two clocks, beyond the uncertainty: an offset becomes a finding at the first
/// number, and the finding ends below the second.
const MIN_OFFSET_OF_FINDING: i64 = 10_000_000;
const MAX_OFFSET_OF_RESOLUTION: i64 = 5_000_000;

/// The clocks of all hosts whose messages arrive here.
#[derive(Debug, Default)]
pub struct Clocks {
    /// Peers by their first announced address.
    peers: Bounded<Counted<ClockPeers>, BTreeMap<IpAddr, Peer>>,
    /// Writers of this host with readers on a peer that acknowledge.
    writers: Bounded<Counted<ClockWriters>, HashMap<Guid, Sent>>,
    /// The latest messages of all other writers.
    unacknowledged: UnacknowledgedMessages,
    /// Name that participants of this host announce.
    name: Option<Arc<str>>,
    /// Whether latencies of a peer's messages are corrected.
    is_corrected: bool,
    revision: u64,
}

#[derive(Debug, Default)]
struct Peer {
    name: Option<Arc<str>>,
    evidence: Evidence,
    /// The finding, as it began.
    offset_finding: Option<Range>,
    /// Whether its clock was set in the last second.
    has_stepped: bool,
    /// Nanoseconds that are added to latencies of its messages.
    correction: i64,
}

/// Latest messages of a writer and the times at which they first left.
#[derive(Debug, Default)]
struct Sent {
    newest: SequenceNumber,
    times: [(SequenceNumber, ModelTime); MAX_SENT_PER_WRITER],
    /// HEARTBEATs that follow each other by less than `MAX_RESPONSE_DELAY`.
    announced: Option<Announced>,
    /// The greatest number that a reader acknowledged.
    acknowledged: SequenceNumber,
}

/// HEARTBEATs that may have requested an ACKNACK.
#[derive(Clone, Copy, Debug)]
struct Announced {
    /// Time of the first one.
    first: ModelTime,
    /// Time of the last one.
    last: ModelTime,
    /// Its lastSN.
    number: SequenceNumber,
}

/// The latest messages of writers that no peer has acknowledged, and the times at which they left.
#[derive(Debug, Default)]
struct UnacknowledgedMessages {
    messages: [(Guid, SequenceNumber, ModelTime); MAX_UNACKNOWLEDGED_WRITERS],
    /// Place of the oldest message.
    oldest: usize,
}

/// Offset between two clocks.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ClockOffset {
    /// The host whose clock is compared with: its name, or its address. `None` stands for this host
    /// if no participant announces its name.
    pub host: Option<Arc<str>>,
    /// The other host.
    pub peer: Arc<str>,
    /// Nanoseconds by which the peer's clock is ahead; negative if it is behind.
    pub offset: i64,
    /// The offset is wrong by at most this number of nanoseconds.
    pub uncertainty: i64,
}

/// What is known of the clock of one peer.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PeerClock {
    /// Name of the peer, or its address.
    pub peer: Arc<str>,
    /// Its first announced address.
    pub address: IpAddr,
    /// Nanoseconds by which it is ahead at least and at most; negative values mean that it is
    /// behind. A bound without evidence is `None`.
    pub ahead: (Option<i64>, Option<i64>),
    /// Evidence for the upper bound.
    pub source: Option<Source>,
    /// Steps of its clock that were noticed.
    pub steps: u64,
}

impl PeerClock {
    /// Returns nanoseconds that are added to latencies of its messages, and the greatest error that
    /// remains; `None` while the offset is unknown.
    #[must_use]
    pub fn correction(&self) -> Option<(i64, i64)> {
        let (least, most) = (self.ahead.0?, self.ahead.1?);
        Some(Range { least, most }.correction())
    }
}

/// Clocks as a snapshot shows them.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct ClockFacts {
    /// Whether clocks are compared.
    pub are_compared: bool,
    /// Peers, sorted by address.
    pub peers: Vec<PeerClock>,
    /// Pairs of hosts with both bounds: first those of this host.
    pub offsets: Vec<ClockOffset>,
}

impl Clocks {
    /// Records that a message of a peer, stamped by its clock, arrived.
    pub fn arrived(
        &mut self,
        (peer, name): (IpAddr, Option<&Arc<str>>),
        stamp: Timestamp,
        at: ModelTime,
    ) {
        if let Some(peer) = self.peer(peer, name) {
            peer.evidence.arrived(ahead(stamp, at), at);
        }
    }

    /// Records that a peer stamped a reply to a request that left this host at `sent`.
    pub fn note_reply(&mut self, peer: IpAddr, stamp: Timestamp, sent: ModelTime, now: ModelTime) {
        if let Some(peer) = self.peers.get_mut(&peer) {
            peer.evidence.replied(ahead(stamp, sent), now);
        }
    }

    /// Records that a message of this host left for the first time or again.
    pub fn note_sent(&mut self, writer: Guid, number: SequenceNumber, at: ModelTime) {
        match self.writers.get_mut(&writer) {
            Some(sent) => sent.put(number, at),
            // A writer may request one acknowledgement only, of its first messages.
            None => self.unacknowledged.put((writer, number, at)),
        }
    }

    /// Records that a HEARTBEAT of a writer of this host left.
    pub fn announced(&mut self, writer: Guid, number: SequenceNumber, at: ModelTime) {
        if let Some(sent) = self.writers.get_mut(&writer) {
            sent.announce(number, at);
        }
    }

    /// Records that a reader on a peer acknowledged all messages up to this number.
    pub fn acknowledged(
        &mut self,
        peer: IpAddr,
        writer: Guid,
        number: SequenceNumber,
        at: ModelTime,
    ) {
        let left = match self.writers.get_mut(&writer) {
            Some(sent) => sent.requested(number).max(sent.time(number)),
            None => {
                self.writers.get_or_insert_with(writer, Sent::default);
                self.unacknowledged.time(writer, number)
            }
        };
        if let Some(left) = left
            && let Some(peer) = self.peer(peer, None)
        {
            peer.evidence.round_trip(at - left, at);
        }
    }

    /// Records the name of this host.
    pub fn name(&mut self, name: Option<&Arc<str>>) {
        if self.name.as_ref() != name {
            self.name = name.cloned();
        }
    }

    /// Returns whether a message of a peer has arrived.
    #[must_use]
    pub fn is_used(&self) -> bool {
        !self.peers.is_empty()
    }

    /// Forgets a writer.
    pub fn forget(&mut self, writer: Guid) {
        self.writers.remove(&writer);
    }

    /// Ends a second: old evidence expires, steps of clocks are noticed, findings come and go.
    pub fn end_second(&mut self, now: ModelTime, clock: WallClock) {
        let before = self.peers.len();
        self.peers.retain(|_, peer| peer.end_second(now));
        let mut changes = u64::from(self.peers.len() < before);
        for peer in self.peers.values_mut() {
            let range = peer.evidence.range(now, clock);
            let found = peer.finding(range);
            if found != peer.offset_finding {
                peer.offset_finding = found;
                changes += 1;
            }
        }
        self.revision += changes;
    }

    /// Updates the corrections of latencies. Returns whether a peer has one, or had one before.
    pub fn correct(&mut self, now: ModelTime, clock: WallClock) -> bool {
        let was_corrected = std::mem::take(&mut self.is_corrected);
        for peer in self.peers.values_mut() {
            let range = peer.evidence.range(now, clock);
            peer.correction = range.map_or(0, |range| range.correction().0);
            self.is_corrected |= peer.correction != 0;
        }
        was_corrected || self.is_corrected
    }

    /// Returns nanoseconds to add to latencies of a peer's messages.
    #[must_use]
    pub fn correction(&self, peer: IpAddr) -> i64 {
        self.peers.get(&peer).map_or(0, |peer| peer.correction)
    }

    /// Returns the number of changes of [`Self::findings`].
    #[must_use]
    pub const fn revision(&self) -> u64 {
        self.revision
    }

    /// Returns the peers whose clocks differ much from this host's.
    pub fn findings(&self) -> impl Iterator<Item = Diagnosis> {
        let labels = self.labels();
        self.peers.iter().filter_map(move |(address, peer)| {
            let range = peer.offset_finding?;
            Some(Diagnosis::ClocksApart {
                peer: labels.get(address).cloned()?,
                offset: range.middle(),
                uncertainty: range.uncertainty(),
            })
        })
    }

    /// Returns what is known at `now`.
    #[must_use]
    pub fn facts(&self, are_compared: bool, now: ModelTime, clock: WallClock) -> ClockFacts {
        let labels = self.labels();
        let label = |address| labels.get(address).cloned().unwrap_or_else(|| "".into());
        let peers = self.peers.iter().map(|(address, peer)| PeerClock {
            peer: label(address),
            address: *address,
            ahead: peer.evidence.bounds(now, clock),
            source: peer.evidence.source(now),
            steps: peer.evidence.steps(),
        });
        // A round trip alone gives no bound.
        let peers = peers.filter(|peer| peer.ahead != (None, None) || peer.steps > 0);
        let ranges = self
            .peers
            .iter()
            .filter_map(|(address, peer)| Some((label(address), peer.evidence.range(now, clock)?)));
        let known: Vec<_> = ranges.collect();
        let offset = |host: Option<&Arc<str>>, peer: &Arc<str>, range: Range| ClockOffset {
            host: host.cloned(),
            peer: Arc::clone(peer),
            offset: range.middle(),
            uncertainty: range.uncertainty(),
        };
        let own = known.iter();
        let own = own.map(|(peer, range)| offset(self.name.as_ref(), peer, *range));
        let mut offsets: Vec<_> = own.collect();
        for (index, (host, from)) in known.iter().enumerate() {
            for (peer, to) in known.iter().skip(index + 1) {
                offsets.push(offset(Some(host), peer, to.since(*from)));
            }
        }
        ClockFacts {
            are_compared,
            peers: peers.collect(),
            offsets,
        }
    }

    /// Returns the sizes and limits of the tables.
    #[must_use]
    pub fn tables(&self) -> [TableFacts; 2] {
        [self.peers.facts(), self.writers.facts()]
    }

    fn peer(&mut self, address: IpAddr, name: Option<&Arc<str>>) -> Option<&mut Peer> {
        let peer = self.peers.get_or_insert_with(address, Peer::default)?;
        if let Some(name) = name.filter(|name| peer.name.as_ref() != Some(*name)) {
            peer.name = Some(Arc::clone(name));
        }
        Some(peer)
    }

    /// Returns the label of each peer: its name, or its address if another host has the same name.
    fn labels(&self) -> BTreeMap<IpAddr, Arc<str>> {
        let mut names: BTreeSet<&str> = self.name.as_deref().into_iter().collect();
        let named = self.peers.values().filter_map(|peer| peer.name.as_deref());
        let twice: BTreeSet<&str> = named.filter(|name| !names.insert(name)).collect();
        let label = |(address, peer): (&IpAddr, &Peer)| {
            let name = peer.name.clone();
            let name = name.filter(|name| !name.is_empty() && !twice.contains(&**name));
            (*address, name.unwrap_or_else(|| address.to_string().into()))
        };
        self.peers.iter().map(label).collect()
    }
}

impl Peer {
    /// Ends a second of the evidence. Returns false once all evidence has expired.
    fn end_second(&mut self, now: ModelTime) -> bool {
        let steps = self.evidence.steps();
        let lives = self.evidence.end_second(now);
        self.has_stepped = self.evidence.steps() > steps;
        lives
    }

    /// Returns the finding, as it began. It stays while the offset is unknown, because evidence
    /// expires and the clock does not change. It ends if the clock was set.
    fn finding(&self, range: Option<Range>) -> Option<Range> {
        let Some(range) = range else {
            return self.offset_finding.filter(|_| !self.has_stepped);
        };
        let least = range.least_distance();
        match self.offset_finding {
            Some(begun) => (least > MAX_OFFSET_OF_RESOLUTION).then_some(begun),
            None => (least > MIN_OFFSET_OF_FINDING).then_some(range),
        }
    }
}

impl Sent {
    fn put(&mut self, number: SequenceNumber, at: ModelTime) {
        // An acknowledgement may be for the first transmission, so a repetition gives no time.
        if number > self.newest {
            self.newest = number;
            if let Some(slot) = self.times.get_mut(slot(number)) {
                *slot = (number, at);
            }
        }
    }

    fn announce(&mut self, number: SequenceNumber, at: ModelTime) {
        let before = self
            .announced
            .filter(|before| at - before.last < MAX_RESPONSE_DELAY);
        self.announced = Some(Announced {
            first: before.map_or(at, |before| before.first),
            last: at,
            number,
        });
    }

    /// Returns the time of the first HEARTBEAT that may have requested the acknowledgement of a
    /// number. Only the first acknowledgement of a number gives one: a reader may repeat it.
    fn requested(&mut self, number: SequenceNumber) -> Option<ModelTime> {
        let is_first = number > self.acknowledged;
        self.acknowledged = self.acknowledged.max(number);
        let announced = self
            .announced
            .filter(|announced| announced.number == number);
        announced
            .filter(|_| is_first)
            .map(|announced| announced.first)
    }

    fn time(&self, number: SequenceNumber) -> Option<ModelTime> {
        let known = self.times.get(slot(number));
        let known = known.filter(|(known, _)| *known == number && number != SequenceNumber::ZERO);
        known.map(|(_, at)| *at)
    }
}

impl UnacknowledgedMessages {
    fn put(&mut self, message: (Guid, SequenceNumber, ModelTime)) {
        if let Some(oldest) = self.messages.get_mut(self.oldest) {
            *oldest = message;
        }
        self.oldest = (self.oldest + 1) % MAX_UNACKNOWLEDGED_WRITERS;
    }

    /// Returns the first time at which a message left: an acknowledgement may be for the first
    /// transmission.
    fn time(&self, writer: Guid, number: SequenceNumber) -> Option<ModelTime> {
        let messages = self.messages.iter();
        let of_message =
            messages.filter(|(of, of_number, _)| (*of, *of_number) == (writer, number));
        of_message.map(|(_, _, at)| *at).min()
    }
}

/// Returns nanoseconds as seconds.
#[expect(
    clippy::cast_precision_loss,
    reason = "nanoseconds of an offset stay exact to 104 days"
)]
#[must_use]
pub fn seconds(nanoseconds: i64) -> f64 {
    nanoseconds as f64 / 1e9
}

/// Returns the slot of a number.
fn slot(number: SequenceNumber) -> usize {
    usize::try_from(number.0 % MAX_SENT_PER_WRITER as u64).unwrap_or(0)
}

/// Returns by how many nanoseconds a stamp is ahead of a time.
const fn ahead(stamp: Timestamp, at: ModelTime) -> i64 {
    stamp.0.wrapping_sub(at.nanoseconds()).cast_signed()
}
