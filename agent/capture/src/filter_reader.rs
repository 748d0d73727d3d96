//! Reads the kernel programs' output at sockets and in processes for the model: records, and
//! captured datagrams in pieces.
//!
//! Each loaded filter has one reader. It assembles pieces and restores the order; it decides
//! nothing.

use std::borrow::Cow;
use std::collections::VecDeque;
use std::os::fd::BorrowedFd;

use ros2probe_wire::host::{self, Piece, chunk};
use ros2probe_wire::record::flag;
use ros2probe_wire::walk::Envelope;
use ros2probe_wire::{Reason, Record, Timestamp};

use super::border::observe;
use super::filter::Filter;
use super::piece_assembler::PieceAssembler;
use super::reorder_buffer::{Next, ReorderBuffer, Segment};
use super::streams::{Chunk, Streams};
use super::system::Clocks;
use crate::tables::FreshDatagrams;
use ros2probe_model::facts::bounded::Bounded;
use ros2probe_model::facts::link::LinkProtocol;
use ros2probe_model::measure::links::LinkReport;
use ros2probe_model::observe::input::Input;
use ros2probe_model::observe::observer::Observer;
use zerocopy::FromBytes as _;

/// Records younger than this wait for records held back in a run of fragments.
pub const SETTLE_NANOSECONDS: u64 = 50_000_000;
/// Fragments of one sample follow each other within microseconds; a longer pause ends the run.
const STALLED_NANOSECONDS: u64 = 30_000_000;
/// Datagrams younger than this wait for older records that may still be in the ring.
pub(crate) const FRESH_NANOSECONDS: u64 = 2_000_000;
/// Maximum number of pieces read per round.
const PIECES_PER_ROUND: usize = 32_768;
/// The ring is emptied again after this many records passed to the model: a burst fills it while
/// earlier records are counted.
const RECORDS_BETWEEN: usize = 1024;

/// The maps of one filter and their waiting contents.
pub struct FilterReader {
    filter: Filter,
    order: ReorderBuffer,
    pieces: PieceAssembler,
    /// Captured datagrams that wait for older records.
    fresh: Bounded<FreshDatagrams, VecDeque<(Piece, Vec<u8>)>>,
    streams: Streams,
    datagrams: u64,
    copied_bytes: u64,
}

impl FilterReader {
    /// Creates a reader without data; `zenoh_ports` are the TCP ports of Zenoh.
    #[must_use]
    pub fn new(filter: Filter, zenoh_ports: &[u16]) -> Self {
        Self {
            filter,
            order: ReorderBuffer::default(),
            pieces: PieceAssembler::default(),
            fresh: Bounded::default(),
            streams: Streams::new(zenoh_ports.to_vec()),
            datagrams: 0,
            copied_bytes: 0,
        }
    }

    /// Returns descriptors that are readable when a ring is half full.
    pub fn descriptors(&self) -> impl Iterator<Item = BorrowedFd<'_>> {
        self.filter
            .piece_ring()
            .into_iter()
            .chain([self.filter.record_ring()])
    }

    /// Reads the rings and passes everything older than [`SETTLE_NANOSECONDS`] to the model.
    /// Announcements in datagrams are passed immediately, all other data in order of time. Older
    /// data precedes a datagram, so a writer's last samples count before its disposal is read. If a
    /// flood leaves records in one ring, the other ring waits for it. Otherwise a writer's records
    /// and captured datagrams would be out of order and look like losses.
    pub fn poll(&mut self, clocks: &Clocks, observer: &mut Observer) {
        let recorded = self.take_records();
        let fresh = clocks.monotonic.saturating_sub(FRESH_NANOSECONDS);
        let captured = self.take_datagrams(clocks, fresh.min(recorded), observer);
        let stalled = clocks.monotonic.saturating_sub(STALLED_NANOSECONDS);
        self.take_stalled(stalled);
        let settled = clocks.monotonic.saturating_sub(SETTLE_NANOSECONDS);
        let settled = settled.min(recorded).min(captured);
        loop {
            let waiting = (&mut self.order, &mut self.streams);
            if deliver(waiting, clocks, settled, observer, RECORDS_BETWEEN) {
                break;
            }
            self.take_records();
        }
        self.pieces.advance(clocks.monotonic);
        let now = Timestamp(clocks.now.0.saturating_sub(SETTLE_NANOSECONDS));
        self.streams
            .advance(now, |streamed| streamed.pass_to(observer));
    }

    /// Passes all buffered data to the model at the end.
    pub fn drain(&mut self, clocks: &Clocks, observer: &mut Observer) {
        self.take_records();
        self.take_datagrams(clocks, u64::MAX, observer);
        self.take_stalled(clocks.monotonic);
        let waiting = (&mut self.order, &mut self.streams);
        deliver(waiting, clocks, u64::MAX, observer, usize::MAX);
    }

    /// Returns the kernel programs' maps.
    #[must_use]
    pub const fn filter(&self) -> &Filter {
        &self.filter
    }

    /// Returns the kernel programs' maps, for setting interests.
    pub const fn filter_mut(&mut self) -> &mut Filter {
        &mut self.filter
    }

    /// Returns the buffer that restores the order of records.
    pub const fn order_mut(&mut self) -> &mut ReorderBuffer {
        &mut self.order
    }

    /// Returns the connections of Zenoh.
    #[must_use]
    pub const fn streams(&self) -> &Streams {
        &self.streams
    }

    /// Returns the number of captured datagrams.
    #[must_use]
    pub const fn datagrams(&self) -> u64 {
        self.datagrams
    }

    /// Returns the bytes read from the kernel: pieces and records.
    #[must_use]
    pub const fn copied_bytes(&self) -> u64 {
        self.copied_bytes
    }

    /// Returns the number of captured datagrams that never became complete.
    #[must_use]
    pub const fn incomplete_datagrams(&self) -> u64 {
        self.pieces.discarded()
    }

    /// Returns the bytes held for datagrams that are incomplete or wait.
    #[must_use]
    pub fn waiting_bytes(&self) -> usize {
        let fresh: usize = self.fresh.iter().map(|(_, bytes)| bytes.len()).sum();
        fresh + self.pieces.bytes()
    }

    /// Reads one round of records. Returns the time of the latest one if the ring may have more,
    /// else `u64::MAX`.
    fn take_records(&mut self) -> u64 {
        self.order
            .take_records(&mut self.filter, &mut self.copied_bytes)
    }

    /// Takes runs of fragments that have not grown since `before` in the kernel's clock.
    fn take_stalled(&mut self, before: u64) {
        for record in self.filter.stalled_runs(before) {
            self.copied_bytes += size_of::<Record>() as u64;
            self.order.kernel(record);
        }
    }

    /// Reads datagrams up to `before` in the kernel's clock. Returns the time of the newest piece
    /// read if the ring may have more, else `u64::MAX`.
    fn take_datagrams(&mut self, clocks: &Clocks, before: u64, observer: &mut Observer) -> u64 {
        while let Some((piece, bytes)) = self.fresh.pop_front_if(|(piece, _)| piece.time <= before)
        {
            let waiting = (&mut self.order, &mut self.streams);
            decode_datagram(&piece, &bytes, clocks, waiting, observer);
            self.pieces.recycle(bytes);
        }
        let mut newest = 0;
        for _ in 0..PIECES_PER_ROUND {
            // Every remaining datagram is newer than those in the queue.
            if self.fresh.is_full() {
                return u64::MAX;
            }
            let Some(captured) = self.filter.next_piece() else {
                return u64::MAX;
            };
            let Some((piece, bytes)) = captured.read() else {
                observer.input(Input::DecodeError {
                    stage: "piece",
                    reason: Reason::BadLength,
                });
                continue;
            };
            self.copied_bytes += (size_of::<Piece>() + bytes.len()) as u64;
            newest = piece.time;
            if piece.flags & flag::STREAM != 0 && piece.chunk & chunk::LINK != 0 {
                match link_report(&piece, bytes) {
                    Some(report) => observer.input(Input::Link(&report)),
                    None => observer.input(Input::DecodeError {
                        stage: "piece",
                        reason: Reason::BadLength,
                    }),
                }
                continue;
            }
            if piece.flags & flag::STREAM != 0 && piece.chunk & chunk::CLIENT_HELLO != 0 {
                let chunk = Chunk::of_piece(&piece, &[], Timestamp(0));
                observer.input(Input::ClientHello(chunk.stream.flow));
                continue;
            }
            if piece.flags & flag::STREAM != 0 {
                let chunk = Chunk::of_piece(&piece, bytes, clocks.wall_time_of(piece.time));
                if piece.chunk & chunk::QUIC != 0 {
                    let seen = (chunk.time, chunk.stream);
                    self.streams
                        .datagram(seen, bytes, chunk.length, |streamed| {
                            streamed.pass_to(observer);
                        });
                    continue;
                }
                self.order.segment(piece.time, &chunk);
                while let Some(oldest) = self.order.take_excess_segment() {
                    read_segment(&mut self.streams, &oldest, observer);
                }
                continue;
            }
            let Some((piece, bytes)) = self.pieces.piece(&piece, bytes) else {
                continue;
            };
            self.datagrams += 1;
            if piece.time <= before && self.fresh.is_empty() {
                let waiting = (&mut self.order, &mut self.streams);
                decode_datagram(&piece, &bytes, clocks, waiting, observer);
                if let Cow::Owned(bytes) = bytes {
                    self.pieces.recycle(bytes);
                }
                continue;
            }
            // This datagram waits behind the queued ones. Overtaking them would let a sample count
            // by duplicate fragments whose bytes are still in the ring.
            self.fresh.push_back((piece, bytes.into_owned()));
        }
        newest
    }
}

/// Passes at most `most` records and segments up to time `until` to the model. Returns whether none
/// is left.
fn deliver(
    (order, streams): (&mut ReorderBuffer, &mut Streams),
    clocks: &Clocks,
    until: u64,
    observer: &mut Observer,
    most: usize,
) -> bool {
    for _ in 0..most {
        match order.next(clocks, until) {
            Some(Next::Kernel(record) | Next::Walked(record) | Next::Polled(record)) => {
                observe(observer, &record);
            }
            Some(Next::Segment(segment)) => read_segment(streams, &segment, observer),
            None => return true,
        }
    }
    false
}

/// Reads what TCP knows of a connection.
fn link_report(piece: &Piece, bytes: &[u8]) -> Option<LinkReport> {
    let (state, _) = host::Link::read_from_prefix(bytes).ok()?;
    Some(LinkReport {
        socket: piece.socket,
        flow: Chunk::of_piece(piece, &[], Timestamp(0)).stream.flow,
        protocol: match piece.chunk & chunk::RTPS {
            0 => LinkProtocol::Zenoh,
            _ => LinkProtocol::Rtps,
        },
        state,
    })
}

/// Reads a segment of Zenoh, and passes the messages that it completes to the model.
fn read_segment(streams: &mut Streams, segment: &Segment, observer: &mut Observer) {
    streams.chunk(&segment.chunk(), |streamed| streamed.pass_to(observer));
}

fn decode_datagram(
    piece: &Piece,
    bytes: &[u8],
    clocks: &Clocks,
    (order, streams): (&mut ReorderBuffer, &mut Streams),
    observer: &mut Observer,
) {
    let waiting = (&mut *order, streams);
    deliver(waiting, clocks, piece.time, observer, usize::MAX);
    let envelope = Envelope {
        time: clocks.wall_time_of(piece.time).0,
        destination: zerocopy::transmute!(piece.destination),
        destination_port: piece.destination_port,
        interface: piece.interface,
        outgoing: piece.flags & flag::OUTGOING != 0,
        source_port: piece.source_port,
        socket: piece.socket,
        host: piece.flags & flag::HOST != 0,
        ..Envelope::default()
    };
    let complete = |record: &mut Record| {
        record.datagram = piece.datagram;
        record.flags |= piece.flags & (flag::SHM | flag::EXACT);
    };
    order.datagram(piece.time, &envelope, bytes, complete, observer);
}
