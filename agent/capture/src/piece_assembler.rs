//! Assembles captured datagrams that the host hook delivers in pieces.
//!
//! Pieces of one datagram arrive in order, with pieces of others between them. If later pieces are
//! missing, the ring was full: the datagram is discarded and counted. The number of incomplete
//! datagrams is bounded, and therefore their bytes. Contents are not interpreted.

use std::borrow::Cow;
use std::collections::VecDeque;

use ros2probe_model::facts::bounded::Bounded;
use ros2probe_wire::host::{PIECE_BYTES, Piece};

use crate::tables::{FreshDatagrams, OpenPieces};

/// Lifetime of an incomplete datagram. A program writes all pieces within microseconds, unless it
/// loses its CPU.
const LIFETIME_NANOSECONDS: u64 = 1_000_000_000;
/// Time without a datagram in several pieces after which buffers are freed.
const PIECE_LIFETIME_NANOSECONDS: u64 = 10_000_000_000;

/// Incomplete datagrams, the oldest first: datagrams that several CPUs write at the same time, and
/// datagrams with lost pieces.
#[derive(Debug, Default)]
pub struct PieceAssembler {
    open: Bounded<OpenPieces, VecDeque<Open>>,
    discarded: u64,
    /// Empty buffers for reuse. In a new buffer, the kernel would have to clear each page.
    free_buffers: Vec<Vec<u8>>,
    /// Time of the latest datagram in several pieces, in the kernel's clock.
    used: u64,
}

#[derive(Debug)]
struct Open {
    first: Piece,
    bytes: Vec<u8>,
}

impl PieceAssembler {
    /// Accepts a piece and the bytes that follow it; returns the datagram with its first piece if
    /// it is complete now.
    pub fn piece<'a>(&mut self, piece: &Piece, bytes: &'a [u8]) -> Option<(Piece, Cow<'a, [u8]>)> {
        let bytes = bytes.get(..piece.len as usize).unwrap_or_default();
        let end = piece.offset.checked_add(piece.len);
        let fits = !bytes.is_empty()
            && piece.len <= PIECE_BYTES
            && piece.datagram_len <= u16::MAX.into()
            && end.is_some_and(|end| end <= piece.datagram_len);
        let open = self
            .open
            .iter()
            .position(|open| open.first.datagram == piece.datagram);
        if piece.offset == 0 {
            // The token is reused, so the remaining pieces of the other datagram are lost.
            self.discard(open);
            if !fits {
                self.discarded += 1;
                return None;
            }
            if piece.len == piece.datagram_len {
                return Some((*piece, Cow::Borrowed(bytes)));
            }
            let mut buffer = self.free_buffers.pop().unwrap_or_default();
            buffer.reserve_exact(piece.datagram_len as usize);
            buffer.extend_from_slice(bytes);
            self.used = piece.time;
            let oldest = self.open.push_back(Open {
                first: *piece,
                bytes: buffer,
            });
            self.discarded += u64::from(oldest.is_some());
            return None;
        }
        // The first piece was discarded or never arrived.
        let index = open?;
        let open = self.open.get_mut(index)?;
        if !fits || !open.is_followed_by(piece) {
            self.discard(Some(index));
            return None;
        }
        open.bytes.extend_from_slice(bytes);
        if open.bytes.len() < piece.datagram_len as usize {
            return None;
        }
        let whole = self.open.remove(index)?;
        Some((whole.first, Cow::Owned(whole.bytes)))
    }

    /// Keeps the buffer of a datagram that was read, for reuse.
    pub fn recycle(&mut self, mut buffer: Vec<u8>) {
        if buffer.capacity() > PIECE_BYTES as usize && self.free_buffers.len() < FreshDatagrams::CAP
        {
            buffer.clear();
            self.free_buffers.push(buffer);
        }
    }

    /// Discards datagrams that have waited too long, in the kernel's clock.
    pub fn advance(&mut self, now: u64) {
        if now.saturating_sub(self.used) > PIECE_LIFETIME_NANOSECONDS {
            self.free_buffers = Vec::new();
        }
        let before = self.open.len();
        self.open
            .retain(|open| now.saturating_sub(open.first.time) < LIFETIME_NANOSECONDS);
        self.discarded += (before - self.open.len()) as u64;
    }

    /// Returns the number of datagrams that never became complete.
    #[must_use]
    pub const fn discarded(&self) -> u64 {
        self.discarded
    }

    /// Returns the bytes of incomplete datagrams, and of buffers for reuse.
    #[must_use]
    pub fn bytes(&self) -> usize {
        let open: usize = self.open.iter().map(|open| open.bytes.len()).sum();
        open + self.free_buffers.iter().map(Vec::capacity).sum::<usize>()
    }

    fn discard(&mut self, index: Option<usize>) {
        if index.and_then(|index| self.open.remove(index)).is_some() {
            self.discarded += 1;
        }
    }
}

impl Open {
    /// Returns whether `piece` belongs to the same datagram and begins where this one ends.
    fn is_followed_by(&self, piece: &Piece) -> bool {
        piece.offset as usize == self.bytes.len()
            && piece.datagram_len == self.first.datagram_len
            && piece.socket == self.first.socket
            && piece.time == self.first.time
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::tables::tests::assert_driven;

    fn piece(datagram: u32, offset: u32, len: u32, datagram_len: u32) -> Piece {
        Piece {
            time: 1,
            datagram,
            offset,
            len,
            datagram_len,
            ..Piece::default()
        }
    }

    /// Returns content in which adjacent bytes of a datagram differ.
    fn content(datagram: u32, offset: u32, len: u32) -> Vec<u8> {
        (offset..offset + len)
            .map(|at| (at * 7 + at / 256 + datagram) as u8)
            .collect()
    }

    fn pieces(datagram: u32, datagram_len: u32) -> Vec<(Piece, Vec<u8>)> {
        (0..datagram_len)
            .step_by(PIECE_BYTES as usize)
            .map(|offset| {
                let len = PIECE_BYTES.min(datagram_len - offset);
                let piece = piece(datagram, offset, len, datagram_len);
                (piece, content(datagram, offset, len))
            })
            .collect()
    }

    #[test]
    fn a_datagram_in_one_piece_is_not_copied() {
        let mut wholes = PieceAssembler::default();
        let (piece, bytes) = pieces(1, 1472).remove(0);
        let whole = wholes.piece(&piece, &bytes).unwrap();
        assert!(matches!(whole.1, Cow::Borrowed(same) if same == bytes));
    }

    #[test]
    fn interleaved_pieces_of_two_cpus_yield_both_datagrams_whole() {
        let mut wholes = PieceAssembler::default();
        let (one, two) = (pieces(1, 65_507), pieces(2, 65_507));
        assert_eq!(one.len(), 4);
        let mut complete = Vec::new();
        for (one, two) in one.iter().zip(&two) {
            for (piece, bytes) in [one, two] {
                if let Some((first, whole)) = wholes.piece(piece, bytes) {
                    assert_eq!(whole, content(first.datagram, 0, 65_507));
                    complete.push(first.datagram);
                }
            }
        }
        assert_eq!(complete, [1, 2]);
        assert_eq!((wholes.bytes(), wholes.discarded()), (0, 0));
    }

    #[test]
    fn an_incomplete_datagram_is_given_up_once() {
        let mut wholes = PieceAssembler::default();
        let all = pieces(1, 40_000);
        assert!(wholes.piece(&all[0].0, &all[0].1).is_none());
        // The second piece is lost.
        assert!(wholes.piece(&all[2].0, &all[2].1).is_none());
        assert_eq!((wholes.bytes(), wholes.discarded()), (0, 1));
        assert!(wholes.piece(&all[0].0, &all[0].1).is_none());
        wholes.advance(LIFETIME_NANOSECONDS);
        assert_eq!(wholes.discarded(), 1);
        wholes.advance(LIFETIME_NANOSECONDS + 1);
        assert_eq!((wholes.bytes(), wholes.discarded()), (0, 2));
        // A piece that arrives later is ignored.
        assert!(wholes.piece(&all[1].0, &all[1].1).is_none());
        assert_eq!(wholes.discarded(), 2);
    }

    #[test]
    fn a_reused_token_starts_a_new_datagram() {
        let mut wholes = PieceAssembler::default();
        let (old, new) = (pieces(1, 40_000), pieces(1, 20_000));
        assert!(wholes.piece(&old[0].0, &old[0].1).is_none());
        assert!(wholes.piece(&new[0].0, &new[0].1).is_none());
        let (_, whole) = wholes.piece(&new[1].0, &new[1].1).unwrap();
        assert_eq!(whole, content(1, 0, 20_000));
        assert_eq!(wholes.discarded(), 1);
    }

    #[test]
    fn datagrams_beyond_the_cap_evict_the_oldest_one() {
        let mut wholes = PieceAssembler::default();
        for token in 0..1000 {
            let all = pieces(token, 65_507);
            assert!(wholes.piece(&all[0].0, &all[0].1).is_none());
        }
        assert_driven::<OpenPieces>();
        assert_eq!(wholes.discarded(), 1000 - wholes.open.len() as u64);
    }

    proptest! {
        #[test]
        fn arbitrary_pieces_yield_only_datagrams_with_correct_content(
            sequence in proptest::collection::vec(
                (0_u32..3, 0_u32..5, 0_u32..4, 0_u32..3),
                0..60,
            ),
        ) {
            let lens: [u32; 3] = [20_000, 40_000, 65_507];
            let mut wholes = PieceAssembler::default();
            for (token, step, damage, len) in sequence {
                let datagram_len = lens[len as usize];
                let offset = step * PIECE_BYTES;
                let len = PIECE_BYTES.min(datagram_len.saturating_sub(offset));
                let (piece, bytes) = match damage {
                    0 => (piece(token, offset, u32::MAX, datagram_len), vec![0; 100]),
                    1 => (piece(token, u32::MAX, len, datagram_len), vec![0; 100_000]),
                    _ => (
                        piece(token, offset, len, datagram_len),
                        content(token, offset, len),
                    ),
                };
                if let Some((first, whole)) = wholes.piece(&piece, &bytes) {
                    prop_assert_eq!(whole.len(), first.datagram_len as usize);
                    prop_assert_eq!(&*whole, &*content(first.datagram, 0, first.datagram_len));
                }
                prop_assert!(wholes.bytes() <= OpenPieces::CAP * 65_535);
            }
        }
    }
}
