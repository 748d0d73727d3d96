//! How the interfaces of a namespace are observed: by programs at tcx, which write captured packets
//! to a ring in pieces, or by a packet socket with a ring of frames.

use std::collections::VecDeque;
use std::os::fd::{AsFd as _, BorrowedFd};
use std::path::Path;
use std::time::Duration;

use ros2probe_model::facts::bounded::Bounded;
use ros2probe_wire::filter::Counter;
use ros2probe_wire::frame::PacketType;
use ros2probe_wire::host::Piece;
use ros2probe_wire::record::flag;

use super::{WireTapError, WireTapSettings};
use crate::error_chain::in_words;
use crate::filter::{Filter, FilterError, FilterSettings, ports};
use crate::filter_reader::FRESH_NANOSECONDS;
use crate::interfaces::Interfaces;
use crate::piece_assembler::PieceAssembler;
use crate::ring::{self, Ring, RingFrame};
use crate::settings::WireChoice;
use crate::system::Clocks;
use crate::tables::FreshDatagrams;
use crate::tcx::{self, FollowError, Tcx, TcxError};
use crate::threads::Spawn;

/// Maximum number of pieces that are read before records are read again.
const PIECES_BETWEEN: usize = 256;
/// Number of times that this happens in a round, so that a flood does not starve other work.
const TURNS_PER_ROUND: usize = 128;
const ETHER_TYPE_IPV4: u16 = 0x0800;
const ETHER_TYPE_IPV6: u16 = 0x86dd;

/// The hook of one tap.
pub(super) enum Hook {
    Packet {
        ring: Ring,
        /// Why tcx is not used although the configuration permits it.
        without_tcx: Option<String>,
    },
    Tcx {
        tcx: Tcx,
        reader: Box<PacketReader>,
    },
}

/// Packets that programs at tcx have captured, and that wait.
#[derive(Default)]
pub(super) struct PacketReader {
    pieces: PieceAssembler,
    /// Packets that wait for older records.
    fresh: Bounded<FreshDatagrams, VecDeque<(Piece, Vec<u8>)>>,
}

/// An event while frames are read.
pub(super) enum Taken<'a> {
    /// Frames follow; older records have to be read before.
    Begin(&'a mut Filter),
    Frame(&'a RingFrame<'a>),
    /// The kernel's output contradicts itself.
    Damaged,
}

/// Loads the filter, and observes the accepted ones of `interfaces`.
pub(super) fn open(
    settings: &WireTapSettings,
    interfaces: &Interfaces,
) -> Result<(Filter, Hook), WireTapError> {
    let without_tcx = match settings.wire {
        WireChoice::Packet => None,
        choice => match open_tcx(settings, interfaces) {
            Ok(opened) => return Ok(opened),
            Err(error) if choice == WireChoice::Tcx => return Err(error.into()),
            Err(error) => Some(in_words(&error)),
        },
    };
    let mut filter = Filter::load(&filter_settings(settings))?;
    for interface in interfaces.iter() {
        let accept = settings.selection.accepts(&interface.name);
        filter.accept_interface(interface.index, accept)?;
    }
    let size = ring::Settings::with_memory(settings.ring_bytes);
    let ring = Ring::open(size, Some(filter.program()))?;
    Ok((filter, Hook::Packet { ring, without_tcx }))
}

fn open_tcx(
    settings: &WireTapSettings,
    interfaces: &Interfaces,
) -> Result<(Filter, Hook), TcxError> {
    tcx::check()?;
    let filter = Filter::load_tcx(&filter_settings(settings))?;
    let programs = filter.tcx_programs();
    let programs = programs.ok_or(FilterError::Missing("tcx programs"))?;
    let mut tcx = Tcx::new(programs).map_err(FilterError::Attach)?;
    for interface in interfaces.iter() {
        if settings.selection.accepts(&interface.name) {
            tcx.attach(interface.index)?;
        }
    }
    let reader = Box::default();
    Ok((filter, Hook::Tcx { tcx, reader }))
}

fn filter_settings(settings: &WireTapSettings) -> FilterSettings {
    let size = |bytes| u32::try_from(bytes).unwrap_or(u32::MAX >> 1);
    FilterSettings {
        record_ring_bytes: size(settings.record_ring_bytes),
        piece_ring_bytes: size(settings.ring_bytes),
        accept_new_interfaces: settings.selection.accepts_unknown(),
        zenoh_ports: ports(&settings.zenoh_ports),
        ..FilterSettings::default()
    }
}

impl Hook {
    pub(super) const fn kind(&self) -> WireChoice {
        match self {
            Self::Packet { .. } => WireChoice::Packet,
            Self::Tcx { .. } => WireChoice::Tcx,
        }
    }

    pub(super) fn without_tcx(&self) -> Option<&str> {
        match self {
            Self::Packet { without_tcx, .. } => without_tcx.as_deref(),
            Self::Tcx { .. } => None,
        }
    }

    /// Starts the thread that attaches programs in the namespace at `path`.
    pub(super) fn start(&mut self, path: Option<&Path>, spawn: Spawn) -> Result<(), FollowError> {
        match self {
            Self::Packet { .. } => Ok(()),
            Self::Tcx { tcx, .. } => tcx.start(path, spawn),
        }
    }

    /// Returns the descriptor of the packet socket, if there is one.
    pub(super) fn descriptor(&self) -> Option<BorrowedFd<'_>> {
        match self {
            Self::Packet { ring, .. } => Some(ring.as_fd()),
            Self::Tcx { .. } => None,
        }
    }

    /// Includes or excludes an interface.
    pub(super) fn accept(
        &mut self,
        filter: &mut Filter,
        index: u32,
        accept: bool,
    ) -> Result<(), WireTapError> {
        match self {
            Self::Packet { .. } => filter.accept_interface(index, accept)?,
            Self::Tcx { tcx, .. } if accept => tcx.attach(index)?,
            Self::Tcx { tcx, .. } => tcx.detach(index),
        }
        Ok(())
    }

    /// Forgets an interface that is gone.
    pub(super) fn forget(&mut self, filter: &mut Filter, index: u32) -> Result<(), WireTapError> {
        match self {
            Self::Packet { .. } => filter.forget_interface(index)?,
            Self::Tcx { tcx, .. } => tcx.detach(index),
        }
        Ok(())
    }

    /// Returns the number of frames that did not fit the ring.
    pub(super) fn drops(&mut self, filter: &Filter) -> Result<u64, WireTapError> {
        match self {
            Self::Packet { ring, .. } => Ok(ring.statistics()?.drops),
            Self::Tcx { .. } => {
                let counters = filter.counters()?;
                let lost = counters.iter().find(|(it, _)| *it == Counter::PiecesLost);
                Ok(lost.map_or(0, |(_, lost)| *lost))
            }
        }
    }

    /// Returns the number of packets of which pieces are missing.
    pub(super) const fn incomplete_frames(&self) -> u64 {
        match self {
            Self::Packet { .. } => 0,
            Self::Tcx { reader, .. } => reader.pieces.discarded(),
        }
    }

    /// Returns the number of interfaces to which the programs could not be attached.
    pub(super) fn refused_interfaces(&self) -> u64 {
        match self {
            Self::Packet { .. } => 0,
            Self::Tcx { tcx, .. } => tcx.refused(),
        }
    }

    /// Reads the frames that wait.
    pub(super) fn take_frames(
        &mut self,
        filter: &mut Filter,
        clocks: &Clocks,
        mut each: impl FnMut(Taken<'_>),
    ) -> Result<(), WireTapError> {
        match self {
            Self::Packet { ring, .. } => {
                // Clears the error that the socket reports when a link goes down; otherwise every
                // wait would return immediately.
                ring.wait(Duration::ZERO)?;
                // At most one full ring is read, so that a flood does not starve other work.
                for _ in 0..ring.blocks() {
                    let Some(block) = ring.block() else {
                        break;
                    };
                    each(Taken::Begin(filter));
                    let mut frames = block.frames();
                    frames.by_ref().for_each(|frame| each(Taken::Frame(&frame)));
                    if frames.damaged() {
                        each(Taken::Damaged);
                    }
                }
            }
            Self::Tcx { reader, .. } => reader.take(filter, clocks, each),
        }
        Ok(())
    }
}

impl PacketReader {
    fn take(&mut self, filter: &mut Filter, clocks: &Clocks, mut each: impl FnMut(Taken<'_>)) {
        // Every record up to this time is in the ring of records when it is read below.
        let before = clocks.monotonic.saturating_sub(FRESH_NANOSECONDS);
        for _ in 0..TURNS_PER_ROUND {
            each(Taken::Begin(filter));
            if !self.take_some(filter, clocks, before, &mut each) {
                break;
            }
        }
        self.pieces.advance(clocks.monotonic);
    }

    /// Reads packets up to `before` in the kernel's clock. Returns whether more may wait.
    fn take_some(
        &mut self,
        filter: &mut Filter,
        clocks: &Clocks,
        before: u64,
        each: &mut impl FnMut(Taken<'_>),
    ) -> bool {
        let is_settled = |(piece, _): &mut (Piece, _)| piece.time <= before;
        while let Some((piece, bytes)) = self.fresh.pop_front_if(is_settled) {
            pass_on(&piece, &bytes, clocks, each);
            self.pieces.recycle(bytes);
        }
        for _ in 0..PIECES_BETWEEN {
            // Every remaining packet is newer than those in the queue.
            if self.fresh.is_full() {
                return false;
            }
            let Some(captured) = filter.next_piece() else {
                return false;
            };
            let Some((piece, bytes)) = captured.read() else {
                each(Taken::Damaged);
                continue;
            };
            let Some((piece, bytes)) = self.pieces.piece(&piece, bytes) else {
                continue;
            };
            if piece.time <= before && self.fresh.is_empty() {
                pass_on(&piece, &bytes, clocks, each);
                if let std::borrow::Cow::Owned(bytes) = bytes {
                    self.pieces.recycle(bytes);
                }
            } else {
                self.fresh.push_back((piece, bytes.into_owned()));
            }
        }
        true
    }
}

/// Passes on a packet that begins at its IP header.
fn pass_on(piece: &Piece, bytes: &[u8], clocks: &Clocks, each: &mut impl FnMut(Taken<'_>)) {
    let version = bytes.first().map_or(0, |first| first >> 4);
    each(Taken::Frame(&RingFrame {
        time: clocks.wall_time_of(piece.time),
        bytes,
        length: piece.datagram_len,
        interface: piece.interface,
        packet_type: match piece.flags & flag::OUTGOING {
            0 => PacketType::HOST,
            _ => PacketType::OUTGOING,
        },
        protocol: match version {
            6 => ETHER_TYPE_IPV6,
            _ => ETHER_TYPE_IPV4,
        },
        vlan: None,
    }));
}
