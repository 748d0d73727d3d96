//! What kernel programs find at sockets and in processes, on its way to the model: records, and
//! captured datagrams in pieces.
//!
//! One for each loaded filter. It puts pieces together and everything in order; it decides nothing.

use std::collections::VecDeque;
use std::os::fd::BorrowedFd;

use ros2probe_wire::host::Piece;
use ros2probe_wire::record::flag;
use ros2probe_wire::walk::Envelope;
use ros2probe_wire::{Reason, Record};

use super::filter::Filter;
use super::piece_assembler::PieceAssembler;
use super::reorder_buffer::{Next, ReorderBuffer};
use super::system::Clocks;
use ros2probe_model::input::Input;
use ros2probe_model::observer::Observer;

/// Records younger than this wait for those that a run of fragments keeps back.
pub const SETTLE_NANOSECONDS: u64 = 50_000_000;
/// Fragments of one sample follow each other within microseconds; after this they do not.
const STALLED_NANOSECONDS: u64 = 30_000_000;
/// Datagrams younger than this wait: records that are older than they may still be on their way.
const FRESH_NANOSECONDS: u64 = 2_000_000;
/// How many of those: 4 MB at most.
const MAX_FRESH: usize = 64;
/// Records taken in at a time: several rings of the built-in size.
const RECORDS_PER_ROUND: usize = 32_768;
/// Pieces likewise.
const PIECES_PER_ROUND: usize = 32_768;
/// After so many records given to the model the ring is emptied again: a burst fills it while the
/// records before are counted.
const RECORDS_BETWEEN: usize = 1024;
/// Records that wait at most, 18 MB; more stay in the ring, and are lost where they find no room.
pub const MAX_WAITING: usize = 131_072;

/// One filter's maps and what they held.
pub struct FilterReader {
    filter: Filter,
    order: ReorderBuffer,
    pieces: PieceAssembler,
    /// Captured datagrams that wait.
    fresh: VecDeque<(Piece, Vec<u8>)>,
    datagrams: u64,
    copied_bytes: u64,
    /// When the latest record was written, in the kernel's clock.
    recorded: u64,
}

impl FilterReader {
    /// Nothing taken in yet.
    #[must_use]
    pub fn new(filter: Filter) -> Self {
        Self {
            filter,
            order: ReorderBuffer::default(),
            pieces: PieceAssembler::default(),
            fresh: VecDeque::new(),
            datagrams: 0,
            copied_bytes: 0,
            recorded: 0,
        }
    }

    /// Readable when a ring is half full.
    pub fn descriptors(&self) -> impl Iterator<Item = BorrowedFd<'_>> {
        self.filter
            .piece_ring()
            .into_iter()
            .chain([self.filter.record_ring()])
    }

    /// Takes in all there is, and gives the model what is [`SETTLE_NANOSECONDS`] old. What datagrams
    /// announce it gets at once, what they count for in its turn. Before each datagram it gets what
    /// is older: a writer's last samples count before its farewell is read. Where a flood leaves
    /// one ring behind, the other waits for it: what a writer's records and its captured datagrams
    /// say would otherwise come out of order, as losses that are none.
    pub fn poll(&mut self, clocks: &Clocks, observer: &mut Observer) {
        let recorded = self.take_records();
        let fresh = clocks.monotonic.saturating_sub(FRESH_NANOSECONDS);
        let captured = self.take_datagrams(clocks, fresh.min(recorded), observer);
        let stalled = clocks.monotonic.saturating_sub(STALLED_NANOSECONDS);
        self.take_stalled(stalled);
        let settled = clocks.monotonic.saturating_sub(SETTLE_NANOSECONDS);
        let settled = settled.min(recorded).min(captured);
        while !deliver(&mut self.order, clocks, settled, observer, RECORDS_BETWEEN) {
            self.take_records();
        }
        self.pieces.advance(clocks.monotonic);
    }

    /// Gives the model what still waits, at the end.
    pub fn drain(&mut self, clocks: &Clocks, observer: &mut Observer) {
        self.take_records();
        self.take_datagrams(clocks, u64::MAX, observer);
        self.take_stalled(clocks.monotonic);
        deliver(&mut self.order, clocks, u64::MAX, observer, usize::MAX);
    }

    /// The kernel programs' maps.
    #[must_use]
    pub const fn filter(&self) -> &Filter {
        &self.filter
    }

    /// The kernel programs' maps, to tell them what is of interest.
    pub const fn filter_mut(&mut self) -> &mut Filter {
        &mut self.filter
    }

    /// Captured datagrams.
    #[must_use]
    pub const fn datagrams(&self) -> u64 {
        self.datagrams
    }

    /// Bytes that came from the kernel: pieces and records.
    #[must_use]
    pub const fn copied_bytes(&self) -> u64 {
        self.copied_bytes
    }

    /// Captured datagrams that never became whole.
    #[must_use]
    pub const fn incomplete_datagrams(&self) -> u64 {
        self.pieces.given_up()
    }

    /// Bytes held for them.
    #[must_use]
    pub fn waiting_bytes(&self) -> usize {
        let fresh: usize = self.fresh.iter().map(|(_, bytes)| bytes.len()).sum();
        fresh + self.pieces.bytes()
    }

    /// A flood may fill the ring as fast as it is emptied: what is left is taken the next time.
    /// Returns up to which time all were taken, `u64::MAX` where none is left.
    fn take_records(&mut self) -> u64 {
        for _ in 0..RECORDS_PER_ROUND {
            if self.order.waiting() >= MAX_WAITING {
                return self.recorded;
            }
            let Some(record) = self.filter.next_record() else {
                return u64::MAX;
            };
            self.copied_bytes += size_of::<Record>() as u64;
            self.recorded = record.time;
            self.order.kernel(record);
        }
        self.recorded
    }

    /// Takes runs of fragments that nobody has continued since `before` in the kernel's clock.
    fn take_stalled(&mut self, before: u64) {
        for record in self.filter.stalled_runs(before) {
            self.copied_bytes += size_of::<Record>() as u64;
            self.order.kernel(record);
        }
    }

    /// Those up to `before` in the kernel's clock. Returns up to which time all were taken, if not
    /// up to `before`; else `u64::MAX`.
    fn take_datagrams(&mut self, clocks: &Clocks, before: u64, observer: &mut Observer) -> u64 {
        while let Some((piece, bytes)) = self.fresh.pop_front_if(|(piece, _)| piece.time <= before)
        {
            decode_datagram(&piece, &bytes, clocks, &mut self.order, observer);
        }
        let mut newest = 0;
        for _ in 0..PIECES_PER_ROUND {
            // What is left is younger still.
            if self.fresh.len() >= MAX_FRESH {
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
            let Some((piece, bytes)) = self.pieces.piece(&piece, bytes) else {
                continue;
            };
            self.datagrams += 1;
            if piece.time <= before && self.fresh.is_empty() {
                decode_datagram(&piece, &bytes, clocks, &mut self.order, observer);
                continue;
            }
            // Behind those that wait: one that overtook them would let a sample count by the copies
            // of fragments whose bytes are still there.
            self.fresh.push_back((piece, bytes.into_owned()));
        }
        newest
    }
}

/// Gives the model what is not younger than `until`, but not more than so many; whether that was
/// all.
fn deliver(
    order: &mut ReorderBuffer,
    clocks: &Clocks,
    until: u64,
    observer: &mut Observer,
    most: usize,
) -> bool {
    for _ in 0..most {
        let Some(Next::Kernel(record) | Next::Walked(record)) = order.next(clocks, until) else {
            return true;
        };
        observer.input(Input::Record(&record));
    }
    false
}

fn decode_datagram(
    piece: &Piece,
    bytes: &[u8],
    clocks: &Clocks,
    order: &mut ReorderBuffer,
    observer: &mut Observer,
) {
    deliver(order, clocks, piece.time, observer, usize::MAX);
    let envelope = Envelope {
        time: clocks.calendar(piece.time).0,
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
