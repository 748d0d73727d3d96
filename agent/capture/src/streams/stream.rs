//! One direction of a connection: bytes in their order, and the batches or frames in them.

use std::collections::VecDeque;
use std::time::Duration;

use ros2probe_model::facts::bounded::{Bounded, Sum};
use ros2probe_model::graph::zenoh::StreamEvent;
use ros2probe_wire::rtps_tcp::{self, FrameHeader};
use ros2probe_wire::{GuidPrefix, Timestamp};

use super::search::{self, Assessment, Search};
use super::{Chunk, Counters, MissingBefore, Protocol};
use crate::tables::{SegmentsAhead, SegmentsAheadBytes};

/// Maximum distance of a segment from the next expected byte: the largest TCP window.
const MAX_SEGMENT_DISTANCE: u32 = 1 << 30;
/// Time after which missing bytes are given up. TCP sends them again earlier, but late if the
/// receiver does not read.
const MISSING_BYTES_TIMEOUT: Duration = Duration::from_secs(10);
/// Size of the length field before each batch of Zenoh, in bytes.
const LENGTH_PREFIX: usize = 2;
/// Maximum number of bytes kept of a frame of RTPS. Payloads of a longer one are not read.
pub const MAX_FRAME: usize = 4 << 20;
/// Number of held bytes from which a frame may be shortened, and number of bytes that then remain.
const MIN_SHORTENED_BYTES: usize = 256 << 10;
const KEPT_FRAME_BYTES: usize = 4 << 10;
/// Maximum number of consecutive batches without a message. Zenoh sends one when it drops the rest
/// of a message. More of them are zeros of other data.
const MAX_EMPTY: usize = 64;

/// Result of taking a chunk.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum TakeResult {
    /// The chunk was read, or waits for earlier bytes.
    Chunk,
    /// The connection appears to be one of another protocol.
    Other,
    /// The connection begins as TLS on a port of Zenoh.
    Tls,
    /// The connection begins as TLS on another port.
    ClientHello,
}

/// What the bytes of a direction contain.
#[derive(Debug)]
pub enum Event<'a> {
    /// An event of a connection of Zenoh.
    Zenoh(StreamEvent<'a>),
    /// An RTPS message.
    Message {
        /// The captured bytes, which are the first ones of the message.
        bytes: &'a [u8],
        /// Length of the message in bytes.
        length: u32,
        /// The participant that sent it, according to its header.
        sender: GuidPrefix,
        /// The logical port of its frame.
        logical_port: u16,
    },
    /// Bytes of a connection of RTPS are missing. TCP delivers all bytes, so only the agent misses
    /// them.
    Gap,
}

/// Position of the next byte.
#[derive(Debug)]
enum Position {
    /// Inside the connection, with no boundary found yet.
    Searching(Search),
    /// At the beginning of the connection.
    Beginning(Search),
    /// In a batch or frame, or before one.
    Batch(Partial),
    /// In a connection of another protocol.
    Other,
}

/// A batch or frame of which some bytes have arrived.
#[derive(Debug)]
struct Partial {
    protocol: Protocol,
    /// Captured bytes, beginning with the length prefix or the header.
    captured: Vec<u8>,
    /// Bytes that have arrived, captured or not.
    arrived: usize,
    /// Number of consecutive batches without a message before this one.
    empty: usize,
}

/// A segment that waits for missing bytes before it.
#[derive(Debug)]
struct Ahead {
    sequence_number: u32,
    length: u32,
    boundary: Option<Protocol>,
    before: MissingBefore,
    bytes: Box<[u8]>,
}

impl Ahead {
    /// Returns the memory of the segment in bytes, including the overhead of an allocation.
    const fn held(&self) -> usize {
        size_of::<Self>() + 32 + self.bytes.len()
    }
}

/// One direction of a connection.
#[derive(Debug)]
pub struct Stream {
    /// TCP sequence number of the first byte, or of the SYN.
    first: u32,
    /// TCP sequence number of the next byte.
    next: u32,
    position: Position,
    ahead: Bounded<SegmentsAhead, VecDeque<Ahead>>,
    ahead_bytes: Sum<SegmentsAheadBytes>,
    /// When the first segment began to wait.
    waiting_since: Timestamp,
    /// The protocol whose batches or frames were read in the stream. TLS on a port of Zenoh counts
    /// as Zenoh.
    protocol: Option<Protocol>,
    is_zenoh_port: bool,
}

impl Stream {
    /// Creates a stream that begins with this chunk.
    pub fn new(chunk: &Chunk<'_>, is_zenoh_port: bool) -> Self {
        let position = match chunk.syn {
            true => Position::Beginning(Search::default()),
            false => Position::Searching(Search::default()),
        };
        Self {
            first: chunk.sequence_number,
            next: chunk.sequence_number.wrapping_add(u32::from(chunk.syn)),
            position,
            ahead: Bounded::default(),
            ahead_bytes: Sum::default(),
            waiting_since: Timestamp(0),
            protocol: None,
            is_zenoh_port,
        }
    }

    /// Returns whether this SYN is a retransmission of the one that began the stream.
    pub const fn began_with(&self, chunk: &Chunk<'_>) -> bool {
        self.first == chunk.sequence_number
    }

    /// Returns the protocol, if the stream was recognized.
    pub const fn protocol(&self) -> Option<Protocol> {
        self.protocol
    }

    /// Returns the number of held bytes.
    pub fn held(&self) -> usize {
        let partial = match &self.position {
            Position::Searching(search) | Position::Beginning(search) => search.held_bytes(),
            Position::Batch(partial) => partial.captured.capacity(),
            Position::Other => 0,
        };
        partial + self.ahead_bytes.used()
    }

    /// Drops most of the held bytes of an unfinished batch or frame. Its boundary stays known, so
    /// only its payload is not read. Returns whether many bytes were dropped.
    pub fn shorten(&mut self) -> bool {
        match &mut self.position {
            Position::Batch(partial) if partial.captured.capacity() > MIN_SHORTENED_BYTES => {
                partial.captured.truncate(KEPT_FRAME_BYTES);
                partial.captured.shrink_to_fit();
                true
            }
            _ => false,
        }
    }

    /// Returns whether segments wait for missing ones.
    pub fn is_waiting(&self) -> bool {
        !self.ahead.is_empty()
    }

    /// Returns whether segments have waited too long. The clock may have been set back.
    pub fn has_waited(&self, now: Timestamp) -> bool {
        !self.ahead.is_empty() && now.distance(self.waiting_since) > MISSING_BYTES_TIMEOUT
    }

    /// Reads a chunk, or keeps it until the bytes before it have arrived.
    pub fn take(
        &mut self,
        chunk: &Chunk<'_>,
        counters: &mut Counters,
        report: &mut impl FnMut(Event<'_>),
    ) -> TakeResult {
        let start = chunk.sequence_number.wrapping_add(u32::from(chunk.syn));
        if chunk.syn {
            report(Event::Zenoh(StreamEvent::Begin));
        }
        if matches!(self.position, Position::Other) && chunk.boundary.is_none() {
            self.next = start.wrapping_add(chunk.length);
            return TakeResult::Other;
        }
        // Flags are about the bytes before a later byte.
        let is_old = start.wrapping_sub(self.next) >= MAX_SEGMENT_DISTANCE;
        match chunk.before {
            _ if is_old => {}
            MissingBefore::Lost => self.lost(start, counters, report),
            before if self.ahead.is_empty() => self.skip(before, start, counters, report),
            _ => {}
        }
        let distance = start.wrapping_sub(self.next);
        if distance != 0 && distance < MAX_SEGMENT_DISTANCE {
            if self.ahead.is_empty() {
                self.waiting_since = chunk.time;
            }
            self.hold(start, chunk);
            let is_full = self.ahead.is_full() || self.ahead_bytes.is_exceeded();
            if is_full || self.has_waited(chunk.time) {
                self.skip_missing(counters, report);
            } else if chunk.before != MissingBefore::Unknown {
                self.catch_up(counters, report);
            }
            return TakeResult::Chunk;
        }
        let took = self.read(
            start,
            chunk.bytes,
            chunk.length,
            chunk.boundary,
            counters,
            report,
        );
        if took == TakeResult::Chunk {
            self.catch_up(counters, report);
        }
        took
    }

    /// Gives up the missing bytes and continues with the segments that wait.
    pub fn skip_missing(&mut self, counters: &mut Counters, report: &mut impl FnMut(Event<'_>)) {
        let Some(first) = self.ahead.front() else {
            return;
        };
        self.next = first.sequence_number;
        self.position = Position::Searching(Search::default());
        self.gap(counters, report);
        self.catch_up(counters, report);
    }

    /// Continues at a later byte, because the bytes before it will not arrive.
    fn lost(&mut self, start: u32, counters: &mut Counters, report: &mut impl FnMut(Event<'_>)) {
        self.ahead.clear();
        self.ahead_bytes.clear();
        self.next = start;
        self.position = Position::Searching(Search::default());
        if self.protocol.is_some() {
            self.gap(counters, report);
        }
    }

    /// Counts missing bytes.
    fn gap(&self, counters: &mut Counters, report: &mut impl FnMut(Event<'_>)) {
        match self.protocol {
            Some(Protocol::Rtps) => {
                counters.frame_gaps += 1;
                report(Event::Gap);
            }
            Some(Protocol::Zenoh) => {
                counters.gaps += 1;
                report(Event::Zenoh(StreamEvent::Gap));
            }
            None => counters.gaps += 1,
        }
    }

    /// Continues at a later byte, if whole batches before it were left out on purpose.
    fn skip(
        &mut self,
        before: MissingBefore,
        start: u32,
        counters: &mut Counters,
        report: &mut impl FnMut(Event<'_>),
    ) {
        if before == MissingBefore::OverBudget {
            self.gap(counters, report);
        }
        let is_left_out = matches!(before, MissingBefore::Skipped | MissingBefore::OverBudget);
        if is_left_out && start.wrapping_sub(self.next) < MAX_SEGMENT_DISTANCE {
            self.next = start;
        }
    }

    fn hold(&mut self, start: u32, chunk: &Chunk<'_>) {
        let distance = start.wrapping_sub(self.next);
        let next = self.next;
        let position = self
            .ahead
            .partition_point(|other| other.sequence_number.wrapping_sub(next) <= distance);
        let ahead = Ahead {
            sequence_number: start,
            length: chunk.length,
            boundary: chunk.boundary,
            before: chunk.before,
            bytes: chunk.bytes.into(),
        };
        self.ahead_bytes.add(ahead.held());
        self.ahead.insert(position, ahead);
    }

    /// Reads the waiting segments that continue the bytes read so far.
    fn catch_up(&mut self, counters: &mut Counters, report: &mut impl FnMut(Event<'_>)) {
        while let Some(first) = self.ahead.front() {
            let (start, before) = (first.sequence_number, first.before);
            self.skip(before, start, counters, report);
            let distance = start.wrapping_sub(self.next);
            if distance != 0 && distance < MAX_SEGMENT_DISTANCE {
                break;
            }
            let Some(first) = self.ahead.pop_front() else {
                break;
            };
            self.ahead_bytes.sub(first.held());
            let length = first.length;
            let boundary = first.boundary;
            self.read(start, &first.bytes, length, boundary, counters, report);
        }
    }

    /// Reads the part of a segment that is new.
    fn read(
        &mut self,
        start: u32,
        bytes: &[u8],
        length: u32,
        boundary: Option<Protocol>,
        counters: &mut Counters,
        report: &mut impl FnMut(Event<'_>),
    ) -> TakeResult {
        let repeated = self.next.wrapping_sub(start).min(length);
        counters.retransmitted_bytes += u64::from(repeated);
        if repeated == length {
            return TakeResult::Chunk;
        }
        self.next = start.wrapping_add(length);
        let skipped = usize::try_from(repeated).unwrap_or(usize::MAX);
        let new = bytes.get(skipped..).unwrap_or_default();
        let length = usize::try_from(length - repeated).unwrap_or(usize::MAX);
        if let Some(protocol) = boundary.filter(|_| repeated == 0) {
            if matches!(&self.position, Position::Batch(partial) if partial.arrived > 0) {
                // The source knows that a batch begins here, so the previous one is incomplete.
                self.gap(counters, report);
            }
            if !matches!(&self.position, Position::Batch(partial) if partial.arrived == 0) {
                self.position = Position::Batch(Partial::of(protocol));
            }
            self.protocol = Some(protocol);
        }
        self.new_bytes(new, length, counters, report)
    }

    fn new_bytes(
        &mut self,
        bytes: &[u8],
        length: usize,
        counters: &mut Counters,
        report: &mut impl FnMut(Event<'_>),
    ) -> TakeResult {
        match &mut self.position {
            Position::Batch(partial) => {
                if !partial.read(bytes, length, counters, report) {
                    // A prefix was not captured, or is not one.
                    self.position = Position::Searching(Search::default());
                    self.gap(counters, report);
                }
                TakeResult::Chunk
            }
            Position::Beginning(search) => {
                match search.add(bytes, length, true, self.is_zenoh_port) {
                    Assessment::Zenoh(held) => {
                        self.read_found(Protocol::Zenoh, &held, held.len(), counters, report);
                    }
                    Assessment::Rtps(held) => {
                        self.read_found(Protocol::Rtps, &held, held.len(), counters, report);
                    }
                    Assessment::Undecided => {}
                    Assessment::Tls => {
                        self.position = Position::Other;
                        self.protocol = Some(Protocol::Zenoh);
                        return TakeResult::Tls;
                    }
                    Assessment::ClientHello => {
                        self.position = Position::Other;
                        return TakeResult::ClientHello;
                    }
                    Assessment::Other => {
                        self.position = Position::Other;
                        return TakeResult::Other;
                    }
                }
                TakeResult::Chunk
            }
            Position::Searching(search) => {
                if let Some(at) = search::frame(bytes) {
                    let rest = bytes.get(at..).unwrap_or_default();
                    self.read_found(Protocol::Rtps, rest, length - at, counters, report);
                    return TakeResult::Chunk;
                }
                if self.protocol == Some(Protocol::Rtps) {
                    return TakeResult::Chunk;
                }
                counters.unsynchronized_bytes += length as u64;
                if let Assessment::Zenoh(held) =
                    search.add(bytes, length, false, self.is_zenoh_port)
                {
                    let held_bytes = held.len();
                    counters.unsynchronized_bytes = counters
                        .unsynchronized_bytes
                        .saturating_sub(held_bytes as u64);
                    self.read_found(Protocol::Zenoh, &held, held_bytes, counters, report);
                }
                TakeResult::Chunk
            }
            Position::Other => TakeResult::Other,
        }
    }

    /// Reads `length` bytes, of which the first ones were captured. They begin with a batch or
    /// frame.
    fn read_found(
        &mut self,
        protocol: Protocol,
        bytes: &[u8],
        length: usize,
        counters: &mut Counters,
        report: &mut impl FnMut(Event<'_>),
    ) {
        self.protocol = Some(protocol);
        let mut partial = Partial::of(protocol);
        let is_read = partial.read(bytes, length, counters, report);
        self.position = match is_read {
            true => Position::Batch(partial),
            false => Position::Searching(Search::default()),
        };
    }
}

/// What the captured bytes of a batch or frame show of its length.
enum Prefix {
    /// More bytes are needed.
    Incomplete,
    /// The length in bytes, prefix or header included.
    Length(usize),
    /// The bytes are no prefix, or they were not captured.
    Wrong,
}

impl Partial {
    const fn of(protocol: Protocol) -> Self {
        Self {
            protocol,
            captured: Vec::new(),
            arrived: 0,
            empty: 0,
        }
    }

    /// Reads `length` bytes, of which the first ones were captured. Returns whether the boundaries
    /// are known.
    fn read(
        &mut self,
        mut bytes: &[u8],
        mut length: usize,
        counters: &mut Counters,
        report: &mut impl FnMut(Event<'_>),
    ) -> bool {
        while length > 0 {
            let wanted = match self.prefix() {
                Prefix::Length(total) => total - self.arrived,
                Prefix::Incomplete => self.prefix_len() - self.arrived,
                Prefix::Wrong => return false,
            };
            let count = wanted.min(length);
            let captured = count.min(bytes.len());
            let (now, rest) = bytes.split_at(captured);
            // Bytes after uncaptured ones cannot be used.
            if self.captured.len() == self.arrived {
                let room = MAX_FRAME.saturating_sub(self.arrived);
                let kept = now.get(..room).unwrap_or(now);
                self.captured.extend_from_slice(kept);
            }
            self.arrived += count;
            (bytes, length) = (rest, length - count);
            match self.prefix() {
                Prefix::Length(total) if self.arrived == total => {
                    self.report_batch(total, counters, report);
                    if self.empty > MAX_EMPTY {
                        return false;
                    }
                    self.captured.clear();
                    self.arrived = 0;
                    if self.captured.capacity() > 4096 {
                        self.captured.shrink_to(4096);
                    }
                }
                Prefix::Length(_) | Prefix::Incomplete => {}
                Prefix::Wrong => return false,
            }
        }
        true
    }

    /// Reports a complete batch or frame of `total` bytes.
    fn report_batch(
        &mut self,
        total: usize,
        counters: &mut Counters,
        report: &mut impl FnMut(Event<'_>),
    ) {
        let length = total - self.prefix_len();
        let bytes = self.captured.get(self.prefix_len()..).unwrap_or_default();
        match self.protocol {
            Protocol::Zenoh if length == 0 => self.empty += 1,
            Protocol::Zenoh => {
                self.empty = 0;
                counters.batches += 1;
                let length = u16::try_from(length).unwrap_or(u16::MAX);
                report(Event::Zenoh(StreamEvent::Batch { bytes, length }));
            }
            Protocol::Rtps => {
                counters.frames += 1;
                // The header of a message has magic, version and vendor before the prefix (RTPS
                // 2.5, 9.4.4). A control message has none.
                let is_message = bytes.starts_with(b"RTPS");
                let header = self.captured.first_chunk();
                let header = header.and_then(|header| FrameHeader::read(*header));
                let logical_port = header.map_or(0, |header| header.logical_port);
                if let Some(sender) = bytes.get(8..20).filter(|_| is_message)
                    && let Ok(sender) = sender.try_into()
                {
                    report(Event::Message {
                        bytes,
                        length: u32::try_from(length).unwrap_or(u32::MAX),
                        sender: GuidPrefix(sender),
                        logical_port,
                    });
                }
            }
        }
    }

    const fn prefix_len(&self) -> usize {
        match self.protocol {
            Protocol::Zenoh => LENGTH_PREFIX,
            Protocol::Rtps => rtps_tcp::HEADER_LEN,
        }
    }

    fn prefix(&self) -> Prefix {
        let length = match self.protocol {
            Protocol::Zenoh => {
                let prefix = self.captured.first_chunk();
                prefix.map(|prefix| Some(LENGTH_PREFIX + usize::from(u16::from_le_bytes(*prefix))))
            }
            Protocol::Rtps => {
                let header = self.captured.first_chunk();
                let header = header.map(|header| FrameHeader::read(*header));
                header.map(|header| usize::try_from(header?.length).ok())
            }
        };
        match length {
            Some(Some(total)) => Prefix::Length(total),
            None if self.arrived < self.prefix_len() => Prefix::Incomplete,
            None | Some(None) => Prefix::Wrong,
        }
    }
}
