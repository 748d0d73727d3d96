//! Sequence number and fragment number sets (RTPS 2.5, 9.4.2.6 and 9.4.2.8): a base and a window
//! of at most 256 bits.

use super::SequenceNumber;
use crate::cursor::{Cursor, Reason, WireError};

/// Bits, most significant first within each 32-bit word, words in the submessage's byte order.
#[derive(Clone, Copy, Debug)]
struct Bitmap<'a> {
    words: Cursor<'a>,
    bits: u32,
}

impl<'a> Bitmap<'a> {
    const MAX_BITS: u32 = 256;

    fn read(cursor: &mut Cursor<'a>) -> Result<Self, WireError> {
        let error = cursor.error("set numBits", Reason::BadValue);
        let bits = cursor.u32("set numBits")?;
        if bits > Self::MAX_BITS {
            return Err(error);
        }
        let length = usize::try_from(bits.div_ceil(32)).map_err(|_| error)? * 4;
        Ok(Self {
            words: cursor.sub("set bitmap", length)?,
            bits,
        })
    }

    /// Positions of the set bits, ascending.
    fn ones(self) -> impl Iterator<Item = u32> {
        let mut words = self.words;
        let words = core::iter::from_fn(move || words.u32("set bitmap").ok());
        words
            .zip((0..).step_by(32))
            .flat_map(|(word, first)| {
                (0..32)
                    .filter(move |bit| word & (1 << 31 >> bit) != 0)
                    .map(move |bit| first + bit)
            })
            .take_while(move |bit| *bit < self.bits)
    }
}

/// Sequence numbers from a base on: in ACKNACK the missing ones, in GAP the irrelevant ones.
#[derive(Clone, Copy, Debug)]
pub struct SequenceNumberSet<'a> {
    /// What bit 0 stands for.
    pub base: SequenceNumber,
    bitmap: Bitmap<'a>,
}

impl<'a> SequenceNumberSet<'a> {
    pub(crate) fn read(cursor: &mut Cursor<'a>) -> Result<Self, WireError> {
        // Fast DDS asks for everything with base 0, so that one is let through.
        let base = SequenceNumber::read_from(cursor, "set base", 0)?;
        Ok(Self {
            base,
            bitmap: Bitmap::read(cursor)?,
        })
    }

    /// Length of the window.
    #[must_use]
    pub const fn num_bits(&self) -> u32 {
        self.bitmap.bits
    }

    /// The members, ascending; those that do not fit a sequence number are left out.
    pub fn iter(&self) -> impl Iterator<Item = SequenceNumber> + use<'a> {
        let base = self.base.0;
        self.bitmap
            .ones()
            .filter_map(move |bit| Some(SequenceNumber(base.checked_add(bit.into())?)))
    }
}

/// Fragment numbers from a base on: in NACK_FRAG the missing ones.
#[derive(Clone, Copy, Debug)]
pub struct FragmentNumberSet<'a> {
    /// What bit 0 stands for.
    pub base: u32,
    bitmap: Bitmap<'a>,
}

impl<'a> FragmentNumberSet<'a> {
    pub(crate) fn read(cursor: &mut Cursor<'a>) -> Result<Self, WireError> {
        Ok(Self {
            base: cursor.u32("set base")?,
            bitmap: Bitmap::read(cursor)?,
        })
    }

    /// The members, ascending; those that do not fit a fragment number are left out.
    pub fn iter(&self) -> impl Iterator<Item = u32> + use<'a> {
        let base = self.base;
        self.bitmap
            .ones()
            .filter_map(move |bit| base.checked_add(bit))
    }
}

#[cfg(test)]
mod tests {
    use std::vec::Vec;

    use super::*;
    use crate::cursor::Endianness;

    fn sequence_numbers(bytes: &[u8], endianness: Endianness) -> Result<Vec<i64>, WireError> {
        let mut cursor = Cursor::new(bytes, endianness);
        Ok(SequenceNumberSet::read(&mut cursor)?
            .iter()
            .map(|number| number.0)
            .collect())
    }

    /// RTPS 2.5, 9.4.2.6: `1234:/12:00110` is 1236 and 1237; here with the example's 30 bits.
    const EXAMPLE: [u8; 16] = [
        0,
        0,
        0,
        0,
        0,
        0,
        0x04,
        0xd2,
        0,
        0,
        0,
        30,
        0b0011_0000,
        0,
        0,
        0,
    ];

    #[test]
    fn bits_count_from_the_most_significant() {
        assert_eq!(
            sequence_numbers(&EXAMPLE, Endianness::Big),
            Ok([1236, 1237].into())
        );
        let mut little = EXAMPLE;
        for word in little.chunks_exact_mut(4) {
            word.reverse();
        }
        assert_eq!(
            sequence_numbers(&little, Endianness::Little),
            Ok([1236, 1237].into())
        );
    }

    #[test]
    fn bits_behind_num_bits_do_not_count() {
        let mut bytes = EXAMPLE;
        bytes[11] = 3;
        assert_eq!(sequence_numbers(&bytes, Endianness::Big), Ok([1236].into()));
        bytes[11] = 0;
        assert_eq!(sequence_numbers(&bytes, Endianness::Big), Ok([].into()));
    }

    #[test]
    fn a_window_of_more_than_256_is_refused() {
        let mut bytes = [0xff; 12 + 36];
        bytes[..12].copy_from_slice(&[0, 0, 0, 0, 0, 0, 0, 1, 0, 0, 1, 0]);
        let all = sequence_numbers(&bytes, Endianness::Big).unwrap();
        assert_eq!((all.len(), all[0], all[255]), (256, 1, 256));
        bytes[11] = 1;
        assert_eq!(
            sequence_numbers(&bytes, Endianness::Big).map_err(|error| error.reason),
            Err(Reason::BadValue)
        );
    }

    #[test]
    fn members_beyond_the_last_number_are_left_out() {
        let mut bytes = EXAMPLE;
        bytes[..8].copy_from_slice(&i64::MAX.to_be_bytes());
        bytes[12] = 0xff;
        assert_eq!(
            sequence_numbers(&bytes, Endianness::Big),
            Ok([i64::MAX].into())
        );
    }

    #[test]
    fn cut_off_anywhere_is_an_error() {
        for length in 0..EXAMPLE.len() {
            assert!(
                sequence_numbers(&EXAMPLE[..length], Endianness::Big).is_err(),
                "{length}"
            );
        }
    }
}
