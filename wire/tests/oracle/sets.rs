//! Sequence number and fragment number sets (RTPS 2.5, 9.4.2.6 and 9.4.2.8): a base and a window
//! of at most 256 bits.

use ros2probe_wire::rtps::SequenceNumber;
use ros2probe_wire::{Cursor, Reason, WireError};

/// Reads a sequence number, `i32` high and `u32` low, that must be at least `least` (RTPS 2.5,
/// 9.4.2.5).
pub fn sequence_number(
    cursor: &mut Cursor<'_>,
    what: &'static str,
    least: i64,
) -> Result<SequenceNumber, WireError> {
    let error = cursor.error(what, Reason::BadValue);
    let high = cursor.i32(what)?;
    let low = cursor.u32(what)?;
    let number = i64::from(high) << 32 | i64::from(low);
    if number < least {
        Err(error)
    } else {
        Ok(SequenceNumber(number.cast_unsigned()))
    }
}

/// A bitmap, most significant bit first within each 32-bit word, words in the submessage's byte
/// order.
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

    /// Iterates over the positions of the set bits, ascending.
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

/// A set of sequence numbers from a base: the missing ones in ACKNACK, the irrelevant ones in GAP.
#[derive(Clone, Copy, Debug)]
pub struct SequenceNumberSet<'a> {
    /// The number of bit 0.
    pub base: SequenceNumber,
    bitmap: Bitmap<'a>,
}

impl<'a> SequenceNumberSet<'a> {
    pub fn read(cursor: &mut Cursor<'a>) -> Result<Self, WireError> {
        // Fast DDS requests everything with base 0, so 0 is accepted.
        let base = sequence_number(cursor, "set base", 0)?;
        Ok(Self {
            base,
            bitmap: Bitmap::read(cursor)?,
        })
    }

    /// Returns the length of the bitmap in bits.
    #[must_use]
    pub const fn num_bits(&self) -> u32 {
        self.bitmap.bits
    }

    /// Iterates over the members, ascending. Members beyond the largest sequence number are
    /// omitted.
    pub fn iter(&self) -> impl Iterator<Item = SequenceNumber> + use<'a> {
        let base = self.base.0;
        self.bitmap
            .ones()
            .map(move |bit| SequenceNumber(base + u64::from(bit)))
            .take_while(|number| *number <= SequenceNumber::MAX)
    }
}

/// A set of fragment numbers from a base: the missing ones in NACK_FRAG.
#[derive(Clone, Copy, Debug)]
pub struct FragmentNumberSet<'a> {
    /// The number of bit 0.
    pub base: u32,
    bitmap: Bitmap<'a>,
}

impl<'a> FragmentNumberSet<'a> {
    pub fn read(cursor: &mut Cursor<'a>) -> Result<Self, WireError> {
        Ok(Self {
            base: cursor.u32("set base")?,
            bitmap: Bitmap::read(cursor)?,
        })
    }

    /// Iterates over the members, ascending. Members beyond the largest fragment number are
    /// omitted.
    pub fn iter(&self) -> impl Iterator<Item = u32> + use<'a> {
        let base = self.base;
        self.bitmap
            .ones()
            .filter_map(move |bit| base.checked_add(bit))
    }
}
