//! Follows the TCP connections of Zenoh and of RTPS: segments in, batches and messages out.
//!
//! A connection is one of Zenoh if it begins with an INIT. A connection that is older than the
//! agent is recognized by consecutive batches that fit together. A connection of RTPS is recognized
//! by the header of a frame anywhere in it. Retransmissions are dropped, and segments out of order
//! wait for the missing ones. After a gap, the next boundary is searched for. For other
//! connections, only the addresses are kept.
//!
//! A connection of RTPS links two participants, in both directions. So the participant that sends
//! in one direction receives in the other one.

mod chunks;
mod search;
mod stream;

use std::collections::hash_map::Entry;
use std::collections::{HashMap, VecDeque};
use std::time::Duration;

use crate::tables::{ZenohOrder, ZenohStreamBytes, ZenohStreams};
use ros2probe_model::facts::bounded::{Bounded, Counted, Sum};
use ros2probe_model::facts::route::Destination;
use ros2probe_model::graph::zenoh::{Flow, StreamEvent, StreamId, StreamReport, Unseen};
use ros2probe_model::observe::input::Input;
use ros2probe_model::observe::observer::Observer;
use ros2probe_model::report::snapshot::TableFacts;
use ros2probe_wire::quic;
use ros2probe_wire::walk::Envelope;
use ros2probe_wire::zenoh::PORT;
use ros2probe_wire::{GuidPrefix, Timestamp};

pub use chunks::{flow, flow_of};
use stream::{Event, Stream, TakeResult};

/// Interval at which segments that wait are examined.
const EXAMINATION_INTERVAL: Duration = Duration::from_millis(100);

/// A piece of one direction of a connection: a TCP segment, or a part of one.
#[derive(Clone, Copy, Debug)]
pub struct Chunk<'a> {
    /// Time of the segment.
    pub time: Timestamp,
    /// Direction of the connection.
    pub stream: StreamId,
    /// TCP sequence number of its first byte, or of the SYN.
    pub sequence_number: u32,
    /// Whether the connection begins with this chunk.
    pub syn: bool,
    /// Whether the sender sends nothing after this chunk, or aborts the connection.
    pub end: bool,
    /// The protocol, if the source knows that a batch or frame begins here.
    pub boundary: Option<Protocol>,
    /// What is known about missing bytes before the chunk.
    pub before: MissingBefore,
    /// The captured bytes, which are the first ones of the chunk.
    pub bytes: &'a [u8],
    /// Length of the chunk in bytes.
    pub length: u32,
}

impl Chunk<'_> {
    /// Returns the chunk without its bytes, which the caller keeps.
    #[must_use]
    pub const fn without_bytes(&self) -> Chunk<'static> {
        Chunk {
            time: self.time,
            stream: self.stream,
            sequence_number: self.sequence_number,
            syn: self.syn,
            end: self.end,
            boundary: self.boundary,
            before: self.before,
            bytes: &[],
            length: self.length,
        }
    }
}

/// A protocol over TCP that is read.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Protocol {
    /// Batches of Zenoh.
    Zenoh,
    /// Frames of RTPS, as Fast DDS sends them.
    Rtps,
}

/// What the bytes of connections contain.
#[derive(Debug)]
pub enum Streamed<'a> {
    /// A report about a direction of a Zenoh connection.
    Zenoh(&'a StreamReport<'a>),
    /// An RTPS message on a TCP connection.
    Message {
        /// Its addresses and time.
        envelope: &'a Envelope,
        /// The captured bytes, which are the first ones of the message.
        bytes: &'a [u8],
        /// Length of the message in bytes.
        length: u32,
    },
    /// Bytes of a connection of RTPS to this destination are missing before this time.
    Gap(Destination, Timestamp),
    /// A client begins a handshake of TLS on a port that is not of Zenoh.
    ClientHello(Flow),
}

impl Streamed<'_> {
    /// Passes this to the model.
    pub fn pass_to(&self, observer: &mut Observer) {
        match *self {
            Self::Zenoh(report) => observer.input(Input::Zenoh(report)),
            Self::ClientHello(flow) => observer.input(Input::ClientHello(flow)),
            Self::Gap(destination, time) => observer.input(Input::StreamGap(destination, time)),
            Self::Message {
                envelope,
                bytes: payload,
                length,
            } => observer.input(match u32::try_from(payload.len()) == Ok(length) {
                true => Input::Datagram {
                    envelope,
                    payload,
                    handover: None,
                },
                false => Input::MessageBeginning {
                    envelope,
                    payload,
                    length,
                },
            }),
        }
    }
}

/// What is known about missing bytes before a chunk.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum MissingBefore {
    /// Nothing is known: the bytes may arrive later.
    #[default]
    Unknown,
    /// The bytes were left out because they are not needed.
    Skipped,
    /// The bytes were left out because the budget of unknown publishers was spent. They are whole
    /// batches, whose samples may be needed.
    OverBudget,
    /// The bytes will not arrive.
    Lost,
}

/// Counters of segments, batches and frames. The last two count connections of RTPS, the others all
/// other ones.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counters {
    /// Number of batches.
    pub batches: u64,
    /// Number of bytes that repeat earlier ones.
    pub retransmitted_bytes: u64,
    /// Number of gaps, where bytes were missing.
    pub gaps: u64,
    /// Number of bytes before a boundary was found.
    pub unsynchronized_bytes: u64,
    /// Number of frames.
    pub frames: u64,
    /// Number of gaps between frames.
    pub frame_gaps: u64,
}

/// All followed connections.
#[derive(Debug)]
pub struct Streams {
    /// TCP ports of Zenoh.
    ports: Vec<u16>,
    streams: Bounded<Counted<ZenohStreams>, HashMap<StreamId, Box<Stream>>>,
    /// Streams of each flow.
    flows: HashMap<Flow, Streaming>,
    /// Streams in the order of eviction, including some that have ended.
    order: Bounded<ZenohOrder, VecDeque<StreamId>>,
    bytes: Sum<Counted<ZenohStreamBytes>>,
    /// Time of the last examination for segments that wait too long.
    examined: Timestamp,
    counters: Counters,
}

/// What is known about the streams of one flow.
#[derive(Debug, Default)]
struct Streaming {
    /// Number of streams: two if both sockets are on this host.
    count: usize,
    /// The participant that sends, of a connection of RTPS.
    sender: Option<GuidPrefix>,
}

impl Default for Streams {
    fn default() -> Self {
        Self::new(vec![PORT])
    }
}

impl Streams {
    /// Creates a table without connections. TLS on one of `ports` is reported.
    #[must_use]
    pub fn new(ports: Vec<u16>) -> Self {
        Self {
            ports,
            streams: Bounded::default(),
            flows: HashMap::new(),
            order: Bounded::default(),
            bytes: Sum::default(),
            examined: Timestamp(0),
            counters: Counters::default(),
        }
    }

    /// Adds a chunk and reports the events that result.
    pub fn chunk(&mut self, chunk: &Chunk<'_>, mut report: impl FnMut(&Streamed<'_>)) {
        let id = chunk.stream;
        if chunk.syn {
            let known = self.streams.get(&id);
            if known.is_some_and(|stream| stream.began_with(chunk)) {
                return;
            }
            self.forget(&id);
        } else if chunk.length == 0 && !chunk.end {
            return;
        }
        if !self.streams.contains_key(&id) {
            if chunk.end && !chunk.syn {
                return;
            }
            self.make_room();
            self.order.push_back(id);
            let (one, other) = (id.flow.source.port, id.flow.destination.port);
            let is_zenoh_port = self.ports.contains(&one) || self.ports.contains(&other);
            let stream = Box::new(Stream::new(chunk, is_zenoh_port));
            self.streams.insert(id, stream);
            self.flows.entry(id.flow).or_default().count += 1;
        }
        let Some(stream) = self.streams.get_mut(&id) else {
            return;
        };
        let before = stream.held();
        let is_zenoh = |stream: &Stream| stream.protocol() == Some(Protocol::Zenoh);
        let was_zenoh = is_zenoh(stream);
        let (counters, flows) = (&mut self.counters, &mut self.flows);
        let mut pass = |event: Event<'_>| pass_on(flows, &id, chunk.time, &event, &mut report);
        let took = stream.take(chunk, counters, &mut pass);
        while chunk.end && stream.is_waiting() {
            stream.skip_missing(counters, &mut pass);
        }
        self.bytes.sub(before);
        self.bytes.add(stream.held());
        if chunk.end && (was_zenoh || is_zenoh(stream)) {
            pass(Event::Zenoh(StreamEvent::End));
        }
        if took == TakeResult::Tls {
            pass(Event::Zenoh(StreamEvent::Unseen(Unseen::Tls)));
        }
        if took == TakeResult::ClientHello {
            report(&Streamed::ClientHello(id.flow));
        }
        if chunk.end {
            self.forget(&id);
        }
        while self.bytes.is_exceeded() {
            if !self.shorten_longest() {
                self.evict();
            }
        }
    }

    /// Reports a UDP datagram of `length` bytes with which a QUIC connection of Zenoh begins.
    /// Returns whether the datagram is one: a QUIC Initial packet on a port of Zenoh.
    pub fn datagram(
        &self,
        (time, mut stream): (Timestamp, StreamId),
        bytes: &[u8],
        length: u32,
        mut report: impl FnMut(&Streamed<'_>),
    ) -> bool {
        let Flow {
            source,
            destination,
        } = &mut stream.flow;
        let is_to_zenoh = self.ports.contains(&destination.port);
        if !is_to_zenoh && !self.ports.contains(&source.port) {
            return false;
        }
        let head = bytes.first_chunk();
        if !head.is_some_and(|head| quic::is_initial(*head, length)) {
            return false;
        }
        // The client's port is omitted: it differs for each connection, whose end is not visible.
        match is_to_zenoh {
            true => source.port = 0,
            false => destination.port = 0,
        }
        report(&Streamed::Zenoh(&StreamReport {
            time,
            stream: &stream,
            event: StreamEvent::Unseen(Unseen::Quic),
        }));
        true
    }

    /// Gives up missing bytes for which segments have waited too long. The interval between calls
    /// does not matter.
    pub fn advance(&mut self, now: Timestamp, mut report: impl FnMut(&Streamed<'_>)) {
        if now.distance(self.examined) < EXAMINATION_INTERVAL {
            return;
        }
        self.examined = now;
        let (counters, flows) = (&mut self.counters, &mut self.flows);
        for (id, stream) in self.streams.iter_mut() {
            if !stream.has_waited(now) {
                continue;
            }
            let before = stream.held();
            stream.skip_missing(counters, &mut |event| {
                pass_on(flows, id, now, &event, &mut report);
            });
            self.bytes.sub(before);
            self.bytes.add(stream.held());
        }
    }

    /// Returns whether a direction is followed at any socket.
    #[must_use]
    pub fn follows_flow(&self, flow: &Flow) -> bool {
        self.flows.contains_key(flow)
    }

    /// Returns the counters of segments and batches.
    #[must_use]
    pub const fn counters(&self) -> Counters {
        self.counters
    }

    /// Returns the number of held bytes.
    #[must_use]
    pub const fn bytes(&self) -> usize {
        self.bytes.used()
    }

    /// Returns the facts of both tables for metrics. A connection that a cap removes leaves both
    /// tables.
    #[must_use]
    pub fn tables(&self) -> [TableFacts; 2] {
        [self.streams.facts(), self.bytes.facts()]
    }

    fn forget(&mut self, id: &StreamId) {
        if let Some(stream) = self.streams.remove(id) {
            self.bytes.sub(stream.held());
            if let Entry::Occupied(mut count) = self.flows.entry(id.flow) {
                let streaming = count.get_mut();
                streaming.count -= 1;
                if streaming.count == 0 {
                    count.remove();
                }
            }
        }
    }

    fn make_room(&mut self) {
        while self.streams.is_full() {
            self.evict();
        }
        if self.order.is_full() {
            // A connection that began anew is several times in the order. Its last place counts.
            let mut places: HashMap<StreamId, usize> = HashMap::new();
            for id in self.order.iter() {
                *places.entry(*id).or_default() += 1;
            }
            let streams = &self.streams;
            self.order.retain(|id| {
                let is_last = places.get_mut(id).is_some_and(|left| {
                    *left -= 1;
                    *left == 0
                });
                is_last && streams.contains_key(id)
            });
        }
    }

    /// Shortens the direction that holds most. Returns whether many bytes were dropped.
    fn shorten_longest(&mut self) -> bool {
        let streams = self.streams.values_mut();
        let Some(longest) = streams.max_by_key(|stream| stream.held()) else {
            return false;
        };
        let before = longest.held();
        let is_shorter = longest.shorten();
        if is_shorter {
            self.bytes.sub(before - longest.held());
            self.bytes.refuse();
        }
        is_shorter
    }

    /// Drops a connection: the oldest one whose protocol is not known, otherwise the oldest one of
    /// all.
    fn evict(&mut self) {
        let known = |id: &StreamId| Some(self.streams.get(id)?.protocol().is_some());
        let stranger = self.order.iter().position(|id| known(id) == Some(false));
        let oldest = stranger.or_else(|| self.order.iter().position(|id| known(id).is_some()));
        match oldest.and_then(|position| self.order.remove(position)) {
            Some(id) => {
                self.streams.refuse();
                self.bytes.refuse();
                self.forget(&id);
            }
            None => {
                self.streams.clear();
                self.flows.clear();
                self.bytes.clear();
            }
        }
    }
}

/// Reports an event of a direction. A message of RTPS also shows which participant sends in the
/// direction, and thus who receives in the opposite one.
fn pass_on(
    flows: &mut HashMap<Flow, Streaming>,
    id: &StreamId,
    time: Timestamp,
    event: &Event<'_>,
    report: &mut impl FnMut(&Streamed<'_>),
) {
    match *event {
        Event::Zenoh(event) => report(&Streamed::Zenoh(&StreamReport {
            time,
            stream: id,
            event,
        })),
        Event::Gap => report(&Streamed::Gap(id.flow.destination, time)),
        Event::Message {
            bytes,
            length,
            sender,
            logical_port,
        } => {
            let Flow {
                source,
                destination,
            } = id.flow;
            if let Some(streaming) = flows.get_mut(&id.flow) {
                streaming.sender = Some(sender);
            }
            let opposite = flows.get(&id.flow.reversed());
            let receiver = opposite.and_then(|streaming| streaming.sender);
            let envelope = Envelope {
                time: time.0,
                destination: destination.address,
                destination_port: destination.port,
                source_port: source.port,
                interface: id.interface,
                outgoing: id.outgoing,
                socket: id.socket,
                host: id.socket != 0,
                receiver: receiver.unwrap_or(GuidPrefix::UNKNOWN),
                logical_port,
                ..Envelope::default()
            };
            report(&Streamed::Message {
                envelope: &envelope,
                bytes,
                length,
            });
        }
    }
}

#[cfg(test)]
mod tests;
