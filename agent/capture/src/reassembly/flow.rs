//! The fragments of one datagram: the byte ranges that have arrived, and their bytes.

use std::mem::size_of;

use ros2probe_wire::Timestamp;
use ros2probe_wire::frame::Fragment;
use ros2probe_wire::record::Record;

use super::{FlowKey, UDP_HEADER};

/// An unfinished datagram.
#[derive(Debug)]
pub(super) struct Flow {
    /// Sequence number among all flows.
    pub(super) order: u64,
    pub(super) first_seen: Timestamp,
    pub(super) last_seen: Timestamp,
    pub(super) handover: Option<Record>,
    /// Sorted pieces, which neither overlap nor touch.
    pieces: Vec<Piece>,
    /// Length of the datagram with its UDP header, known after the last fragment.
    total: Option<u32>,
    /// Offset of the first byte that is missing in a truncated capture.
    first_unknown: Option<u32>,
    /// Capacity of all pieces.
    held: usize,
}

/// Consecutive bytes. Fragments that arrive in order form one piece.
#[derive(Debug)]
struct Piece {
    start: u32,
    bytes: Vec<u8>,
}

/// Result of adding a fragment.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(super) enum Placement {
    /// The fragment added missing bytes.
    New,
    /// The fragment added no bytes.
    Duplicate,
    /// The fragment cannot belong to the same datagram. The flow is unchanged.
    Contradiction,
}

impl Piece {
    fn end(&self) -> u32 {
        self.start
            .saturating_add(u32::try_from(self.bytes.len()).unwrap_or(u32::MAX))
    }
}

impl Flow {
    pub(super) const fn new(order: u64, at: Timestamp) -> Self {
        Self {
            order,
            first_seen: at,
            last_seen: at,
            handover: None,
            pieces: Vec::new(),
            total: None,
            first_unknown: None,
            held: 0,
        }
    }

    /// Returns the bytes of this flow, bookkeeping included.
    pub(super) const fn memory(&self) -> usize {
        const ENTRIES: usize = size_of::<Flow>() + 2 * size_of::<FlowKey>();
        ENTRIES + self.held + self.pieces.capacity() * size_of::<Piece>()
    }

    /// Adds a fragment. Where fragments overlap, the earlier bytes are kept.
    pub(super) fn place(&mut self, at: Timestamp, fragment: &Fragment<'_>) -> Placement {
        let (start, end) = (fragment.offset, fragment.end());
        let seen = self.pieces.last().map_or(0, Piece::end);
        let total = self.total();
        let too_long = total.is_some_and(|total| end > total);
        let ends_early = !fragment.more && (seen > end || total.is_some_and(|total| end != total));
        if too_long || ends_early {
            return Placement::Contradiction;
        }
        let mut position = start;
        let mut placed = Placement::Duplicate;
        while let Some((index, from, to)) = self.gap(position, end) {
            self.fill(index, from, to, fragment);
            position = to;
            placed = Placement::New;
        }
        if placed == Placement::Duplicate && self.differs(fragment) {
            return Placement::Contradiction;
        }
        if placed == Placement::New {
            self.last_seen = self.last_seen.max(at);
            let kept = start.saturating_add(u32::try_from(fragment.bytes.len()).unwrap_or(end));
            if kept < end {
                self.first_unknown = Some(self.first_unknown.map_or(kept, |known| known.min(kept)));
            }
        }
        if !fragment.more {
            self.total = Some(end);
        }
        placed
    }

    /// Returns the byte range to deliver, counted from the UDP header, if it is complete.
    pub(super) fn complete(&self) -> Option<(u32, u32)> {
        let to = self.total()?;
        let from = self
            .handover
            .map_or(0, |record| record.handover().offset + UDP_HEADER);
        let piece = self.pieces.get(self.first_ending_after(from))?;
        (piece.start <= from && to <= piece.end()).then_some((from, to))
    }

    /// Returns the bytes up to `to`, or up to the first byte that is missing in the capture. Bytes
    /// before `from` are zeros.
    pub(super) fn take(&mut self, from: u32, to: u32) -> Vec<u8> {
        let index = self.first_ending_after(from);
        let Some(piece) = self.pieces.get_mut(index) else {
            return Vec::new();
        };
        let to = self.first_unknown.map_or(to, |unknown| unknown.min(to));
        let size = |offset: u32| usize::try_from(offset).unwrap_or(usize::MAX);
        if piece.start == 0 && from == 0 {
            let mut bytes = std::mem::take(&mut piece.bytes);
            bytes.truncate(size(to));
            return bytes;
        }
        let head = from.max(piece.start);
        let mut bytes = vec![0; size(head.min(to))];
        let known = size(head - piece.start)..size(to.saturating_sub(piece.start));
        bytes.extend_from_slice(piece.bytes.get(known).unwrap_or_default());
        bytes
    }

    fn total(&self) -> Option<u32> {
        let handed_over = self
            .handover
            .map(|record| u32::from(record.datagram_len) + UDP_HEADER);
        handed_over.or(self.total)
    }

    fn first_ending_after(&self, offset: u32) -> usize {
        self.pieces.partition_point(|piece| piece.end() <= offset)
    }

    /// Returns the first missing range within `from..to`, and the index of the piece after it;
    /// `None` if nothing is missing.
    fn gap(&self, mut from: u32, to: u32) -> Option<(usize, u32, u32)> {
        let mut index = self.first_ending_after(from);
        if let Some(piece) = self.pieces.get(index)
            && piece.start <= from
        {
            from = piece.end();
            index += 1;
        }
        let to = self.pieces.get(index).map_or(to, |next| next.start.min(to));
        (from < to).then_some((index, from, to))
    }

    /// Inserts the fragment's bytes `from..to` before the piece at `index`, joining adjacent
    /// pieces.
    fn fill(&mut self, index: usize, from: u32, to: u32, fragment: &Fragment<'_>) {
        let size = |offset: u32| usize::try_from(offset).unwrap_or(usize::MAX);
        let within = |offset: u32| size(offset.saturating_sub(fragment.offset));
        let kept = fragment.bytes.len();
        let bytes = fragment
            .bytes
            .get(within(from).min(kept)..within(to).min(kept))
            .unwrap_or_default();
        let before = index.checked_sub(1).filter(|&before| {
            self.pieces
                .get(before)
                .is_some_and(|piece| piece.end() == from)
        });
        let target = before.unwrap_or(index);
        if before.is_none() {
            self.pieces.insert(
                index,
                Piece {
                    start: from,
                    bytes: Vec::new(),
                },
            );
        }
        let next = target + 1;
        let touches = self.pieces.get(next).is_some_and(|piece| piece.start == to);
        let joined = if touches {
            self.pieces.remove(next).bytes
        } else {
            Vec::new()
        };
        self.held = self.held.saturating_sub(joined.capacity());
        let Some(piece) = self.pieces.get_mut(target) else {
            return;
        };
        self.held = self.held.saturating_sub(piece.bytes.capacity());
        piece.bytes.extend_from_slice(bytes);
        // Zeros replace bytes of the fragment that are missing in the capture.
        piece.bytes.resize(size(to.saturating_sub(piece.start)), 0);
        piece.bytes.extend_from_slice(&joined);
        self.held += piece.bytes.capacity();
    }

    /// Returns whether a fully covered fragment differs from the bytes that cover it.
    fn differs(&self, fragment: &Fragment<'_>) -> bool {
        if self.first_unknown.is_some() {
            return false;
        }
        let Some(piece) = self.pieces.get(self.first_ending_after(fragment.offset)) else {
            return false;
        };
        let start = fragment.offset.saturating_sub(piece.start);
        let held = usize::try_from(start)
            .ok()
            .and_then(|start| piece.bytes.get(start..));
        !held.is_some_and(|held| held.starts_with(fragment.bytes))
    }
}
