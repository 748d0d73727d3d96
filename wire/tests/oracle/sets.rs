//! Sequence number and fragment number sets (RTPS 2.5, 9.4.2.6 and 9.4.2.8): a base and a window
//! of at most 256 bits.

use ros2probe_wire::rtps::SequenceNumber;
use ros2probe_wire::{Cursor, Reason, WireError};

/// A sequence number, `i32` high and `u32` low, of those from `least` on (RTPS 2.5, 9.4.2.5).
pub fn sequence_number(
    cursor: &mut Cursor<'_>,
    what: &'static str,
    least: i64,
) -> Result<SequenceNumber, WireError> {
    let error = cursor.error(what, Reason::BadValue);
    let high = cursor.i32(what)?;
    let low = cursor.u32(what)?;
    let number = SequenceNumber(i64::from(high) << 32 | i64::from(low));
    if number.0 < least {
        Err(error)
    } else {
        Ok(number)
    }
}

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
    pub fn read(cursor: &mut Cursor<'a>) -> Result<Self, WireError> {
        // Fast DDS asks for everything with base 0, so that one is let through.
        let base = sequence_number(cursor, "set base", 0)?;
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
    pub fn read(cursor: &mut Cursor<'a>) -> Result<Self, WireError> {
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
