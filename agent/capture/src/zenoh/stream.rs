//! One direction of a connection: bytes in their order, and the batches in them.

use std::collections::VecDeque;
use std::time::Duration;

use ros2probe_model::facts::bounded::{Bounded, Sum};
use ros2probe_model::graph::zenoh::StreamEvent;
use ros2probe_wire::Timestamp;

use super::search::{Looks, Search};
use super::{Before, Chunk, Counters};
use crate::tables::{SegmentsAhead, SegmentsAheadBytes};

/// Maximum distance of a segment from the next expected byte: the largest TCP window.
const WINDOW: u32 = 1 << 30;
/// Time after which missing bytes are given up. TCP sends them again earlier, but late if the
/// receiver does not read.
const WAIT: Duration = Duration::from_secs(10);
/// Size of the length field before each batch, in bytes.
const PREFIX: usize = 2;
/// Maximum number of consecutive batches without a message. Zenoh sends one when it drops the rest
/// of a message. More of them are zeros of other data.
const MAX_EMPTY: usize = 64;

/// Result of taking a chunk.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Took {
    /// The chunk was read, or waits for earlier bytes.
    Chunk,
    /// The connection does not appear to be one of Zenoh.
    NotZenoh,
    /// The connection begins as TLS on a port of Zenoh.
    Tls,
}

/// Position of the next byte.
#[derive(Debug)]
enum Position {
    /// Inside the connection, with no boundary found yet.
    Searching(Search),
    /// At the beginning of the connection.
    Beginning(Search),
    /// In a batch, or before one.
    Batch(Partial),
    /// In a connection of another protocol.
    Other,
}

/// A batch of which some bytes have arrived.
#[derive(Debug, Default)]
struct Partial {
    /// Captured bytes, beginning with the length prefix.
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
    is_boundary: bool,
    before: Before,
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
    /// Whether batches were read in the stream, or it uses TLS on a port of Zenoh.
    was_zenoh: bool,
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
            was_zenoh: false,
            is_zenoh_port,
        }
    }

    /// Returns whether this SYN is a retransmission of the one that began the stream.
    pub const fn began_with(&self, chunk: &Chunk<'_>) -> bool {
        self.first == chunk.sequence_number
    }

    /// Returns whether batches were read in the stream, or it uses TLS on a port of Zenoh.
    pub const fn is_zenoh(&self) -> bool {
        self.was_zenoh
    }

    /// Returns the number of held bytes.
    pub fn held(&self) -> usize {
        let partial = match &self.position {
            Position::Searching(search) | Position::Beginning(search) => search.held(),
            Position::Batch(partial) => partial.captured.capacity(),
            Position::Other => 0,
        };
        partial + self.ahead_bytes.used()
    }

    /// Returns whether segments wait for missing ones.
    pub fn waits(&self) -> bool {
        !self.ahead.is_empty()
    }

    /// Returns whether segments have waited too long.
    pub fn has_waited(&self, now: Timestamp) -> bool {
        !self.ahead.is_empty() && now > self.waiting_since + WAIT
    }

    /// Reads a chunk, or keeps it until the bytes before it have arrived.
    pub fn take(
        &mut self,
        chunk: &Chunk<'_>,
        counters: &mut Counters,
        report: &mut impl FnMut(StreamEvent<'_>),
    ) -> Took {
        let start = chunk.sequence_number.wrapping_add(u32::from(chunk.syn));
        if chunk.syn {
            report(StreamEvent::Begin);
        }
        if matches!(self.position, Position::Other) && !chunk.is_boundary {
            self.next = start.wrapping_add(chunk.length);
            return Took::NotZenoh;
        }
        match chunk.before {
            Before::Lost => self.lost(start, counters, report),
            Before::Skipped if self.ahead.is_empty() => self.skip_to(start),
            Before::Skipped | Before::Unknown => {}
        }
        let distance = start.wrapping_sub(self.next);
        if distance != 0 && distance < WINDOW {
            if self.ahead.is_empty() {
                self.waiting_since = chunk.time;
            }
            self.keep(start, chunk);
            let is_full = self.ahead.is_full() || self.ahead_bytes.is_exceeded();
            if is_full || self.has_waited(chunk.time) {
                self.give_up(counters, report);
            }
            return Took::Chunk;
        }
        let took = self.read(
            start,
            chunk.bytes,
            chunk.length,
            chunk.is_boundary,
            counters,
            report,
        );
        if took == Took::Chunk {
            self.catch_up(counters, report);
        }
        took
    }

    /// Gives up the missing bytes and continues with the segments that wait.
    pub fn give_up(&mut self, counters: &mut Counters, report: &mut impl FnMut(StreamEvent<'_>)) {
        let Some(first) = self.ahead.front() else {
            return;
        };
        counters.gaps += 1;
        self.next = first.sequence_number;
        self.position = Position::Searching(Search::default());
        if self.was_zenoh {
            report(StreamEvent::Gap);
        }
        self.catch_up(counters, report);
    }

    /// Continues at a later byte, because the bytes before it will not arrive.
    fn lost(
        &mut self,
        start: u32,
        counters: &mut Counters,
        report: &mut impl FnMut(StreamEvent<'_>),
    ) {
        self.ahead.clear();
        self.ahead_bytes.clear();
        self.next = start;
        self.position = Position::Searching(Search::default());
        if self.was_zenoh {
            counters.gaps += 1;
            report(StreamEvent::Gap);
        }
    }

    /// Continues at a later byte, because whole batches before it are not needed.
    fn skip_to(&mut self, start: u32) {
        if start.wrapping_sub(self.next) < WINDOW {
            self.next = start;
        }
    }

    fn keep(&mut self, start: u32, chunk: &Chunk<'_>) {
        let distance = start.wrapping_sub(self.next);
        let next = self.next;
        let position = self
            .ahead
            .partition_point(|other| other.sequence_number.wrapping_sub(next) <= distance);
        let ahead = Ahead {
            sequence_number: start,
            length: chunk.length,
            is_boundary: chunk.is_boundary,
            before: chunk.before,
            bytes: chunk.bytes.into(),
        };
        self.ahead_bytes.add(ahead.held());
        self.ahead.insert(position, ahead);
    }

    /// Reads the waiting segments that continue the bytes read so far.
    fn catch_up(&mut self, counters: &mut Counters, report: &mut impl FnMut(StreamEvent<'_>)) {
        while let Some(first) = self.ahead.front() {
            let (start, before) = (first.sequence_number, first.before);
            if before == Before::Skipped {
                self.skip_to(start);
            }
            let distance = start.wrapping_sub(self.next);
            if distance != 0 && distance < WINDOW {
                break;
            }
            let Some(first) = self.ahead.pop_front() else {
                break;
            };
            self.ahead_bytes.sub(first.held());
            let length = first.length;
            self.read(
                start,
                &first.bytes,
                length,
                first.is_boundary,
                counters,
                report,
            );
        }
    }

    /// Reads the part of a segment that is new.
    fn read(
        &mut self,
        start: u32,
        bytes: &[u8],
        length: u32,
        is_boundary: bool,
        counters: &mut Counters,
        report: &mut impl FnMut(StreamEvent<'_>),
    ) -> Took {
        let repeated = self.next.wrapping_sub(start).min(length);
        counters.retransmitted_bytes += u64::from(repeated);
        if repeated == length {
            return Took::Chunk;
        }
        self.next = start.wrapping_add(length);
        let skipped = usize::try_from(repeated).unwrap_or(usize::MAX);
        let new = bytes.get(skipped..).unwrap_or_default();
        let length = usize::try_from(length - repeated).unwrap_or(usize::MAX);
        if is_boundary && repeated == 0 {
            if matches!(&self.position, Position::Batch(partial) if partial.arrived > 0) {
                // The source knows that a batch begins here, so the previous one is incomplete.
                counters.gaps += 1;
                report(StreamEvent::Gap);
            }
            if !matches!(&self.position, Position::Batch(partial) if partial.arrived == 0) {
                self.position = Position::Batch(Partial::default());
            }
            self.was_zenoh = true;
        }
        self.new_bytes(new, length, counters, report)
    }

    fn new_bytes(
        &mut self,
        bytes: &[u8],
        length: usize,
        counters: &mut Counters,
        report: &mut impl FnMut(StreamEvent<'_>),
    ) -> Took {
        match &mut self.position {
            Position::Batch(partial) => {
                if !partial.read(bytes, length, counters, report) {
                    // A prefix was not captured, or is 0.
                    counters.gaps += 1;
                    report(StreamEvent::Gap);
                    self.position = Position::Searching(Search::default());
                }
                Took::Chunk
            }
            Position::Beginning(search) => {
                match search.add(bytes, length, true, self.is_zenoh_port) {
                    Looks::Zenoh(held) => self.found(&held, counters, report),
                    Looks::Undecided => {}
                    Looks::Tls => {
                        self.position = Position::Other;
                        self.was_zenoh = true;
                        return Took::Tls;
                    }
                    Looks::Other => {
                        self.position = Position::Other;
                        return Took::NotZenoh;
                    }
                }
                Took::Chunk
            }
            Position::Searching(search) => {
                counters.unsynchronized_bytes += length as u64;
                if let Looks::Zenoh(held) = search.add(bytes, length, false, self.is_zenoh_port) {
                    counters.unsynchronized_bytes = counters
                        .unsynchronized_bytes
                        .saturating_sub(held.len() as u64);
                    self.found(&held, counters, report);
                }
                Took::Chunk
            }
            Position::Other => Took::NotZenoh,
        }
    }

    /// Reads the bytes that the search held, which begin with a batch.
    fn found(
        &mut self,
        held: &[u8],
        counters: &mut Counters,
        report: &mut impl FnMut(StreamEvent<'_>),
    ) {
        self.was_zenoh = true;
        let mut partial = Partial::default();
        let is_read = partial.read(held, held.len(), counters, report);
        self.position = match is_read {
            true => Position::Batch(partial),
            false => Position::Searching(Search::default()),
        };
    }
}

impl Partial {
    /// Reads `length` bytes, of which the first ones were captured. Returns whether the boundaries
    /// are known.
    fn read(
        &mut self,
        mut bytes: &[u8],
        mut length: usize,
        counters: &mut Counters,
        report: &mut impl FnMut(StreamEvent<'_>),
    ) -> bool {
        while length > 0 {
            let wanted = match self.prefix() {
                Some(batch) => PREFIX + usize::from(batch) - self.arrived,
                None => PREFIX - self.arrived,
            };
            let count = wanted.min(length);
            let captured = count.min(bytes.len());
            let (now, rest) = bytes.split_at(captured);
            // Bytes after uncaptured ones cannot be used.
            if self.captured.len() == self.arrived {
                self.captured.extend_from_slice(now);
            }
            self.arrived += count;
            (bytes, length) = (rest, length - count);
            let Some(batch) = self.prefix() else {
                if self.arrived < PREFIX {
                    continue;
                }
                return false;
            };
            if self.arrived == PREFIX + usize::from(batch) {
                if batch == 0 {
                    self.empty += 1;
                } else {
                    self.empty = 0;
                    counters.batches += 1;
                    report(StreamEvent::Batch {
                        bytes: self.captured.get(PREFIX..).unwrap_or_default(),
                        length: batch,
                    });
                }
                if self.empty > MAX_EMPTY {
                    return false;
                }
                self.captured.clear();
                self.arrived = 0;
                if self.captured.capacity() > 4096 {
                    self.captured.shrink_to(4096);
                }
            }
        }
        true
    }

    /// Returns the length of the batch; `None` until both of its bytes are captured.
    fn prefix(&self) -> Option<u16> {
        let prefix = self.captured.first_chunk()?;
        Some(u16::from_le_bytes(*prefix))
    }
}
