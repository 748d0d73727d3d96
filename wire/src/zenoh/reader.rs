//! Reads Zenoh's primitives from one batch or message, of which the capture may lack the end
//! (`zenoh-codec`, `core/zint.rs`).
//!
//! A reader knows how long its input was on the wire. A field that ends after the captured bytes
//! but within that length is [`Reason::Truncated`]: the capture is cut. A field that ends after
//! the length is [`Reason::BadLength`]: the message is malformed.

use alloc::vec::Vec;

use crate::cursor::{Cursor, Endianness, Reason, WireError};

/// Bytes of a declared length, of which the capture may lack the end.
#[derive(Clone, Copy, Default, PartialEq, Eq, Hash, Debug)]
pub struct Bytes<'a> {
    /// The captured bytes.
    pub captured: &'a [u8],
    /// Length on the wire, at least that of the captured bytes.
    pub length: usize,
}

impl<'a> Bytes<'a> {
    /// Returns the bytes if all of them were captured.
    #[must_use]
    pub const fn whole(self) -> Option<&'a [u8]> {
        if self.captured.len() == self.length {
            Some(self.captured)
        } else {
            None
        }
    }
}

/// A bounded position in a batch or message.
#[derive(Clone, Copy, Debug)]
pub struct Reader<'a> {
    cursor: Cursor<'a>,
    /// Bytes on the wire after the captured ones.
    missing: usize,
}

impl<'a> Reader<'a> {
    /// Creates a reader at the start of `captured`, which had `length` bytes on the wire. A
    /// `length` below that of the captured bytes counts as equal to it.
    #[must_use]
    pub const fn new(captured: &'a [u8], length: usize) -> Self {
        Self {
            cursor: Cursor::new(captured, Endianness::Little),
            missing: length.saturating_sub(captured.len()),
        }
    }

    /// Creates a reader of input that was captured as a whole.
    #[must_use]
    pub const fn whole(bytes: &'a [u8]) -> Self {
        Self::new(bytes, bytes.len())
    }

    /// Creates a reader of the beginning of a message of unknown length, such as the first FRAGMENT
    /// of a chain.
    #[must_use]
    pub const fn beginning(captured: &'a [u8]) -> Self {
        Self::new(captured, usize::MAX)
    }

    /// Returns the number of captured bytes that are not read yet.
    #[must_use]
    pub const fn remaining(&self) -> usize {
        self.cursor.remaining()
    }

    /// Returns whether nothing follows on the wire.
    #[must_use]
    pub const fn is_at_end(&self) -> bool {
        self.cursor.remaining() == 0 && self.missing == 0
    }

    /// Returns the number of bytes read since the outermost start.
    #[must_use]
    pub const fn offset(&self) -> usize {
        self.cursor.offset()
    }

    /// Returns the next byte without reading it, if it was captured.
    pub(super) const fn peek(&self) -> Option<u8> {
        match self.cursor.rest() {
            [first, ..] => Some(*first),
            [] => None,
        }
    }

    /// Returns an error for the field at the current position.
    pub(super) const fn error(&self, what: &'static str, reason: Reason) -> WireError {
        self.cursor.error(what, reason)
    }

    /// Returns the error for a field that needs `length` bytes, which were not all captured.
    fn absent(&self, what: &'static str, length: usize) -> WireError {
        let on_the_wire = self.remaining().saturating_add(self.missing);
        let is_cut = length <= on_the_wire;
        let reason = if is_cut {
            Reason::Truncated
        } else {
            Reason::BadLength
        };
        self.error(what, reason)
    }

    /// Reads `length` bytes, all of which must have been captured.
    pub(super) fn take(
        &mut self,
        what: &'static str,
        length: usize,
    ) -> Result<&'a [u8], WireError> {
        let absent = self.absent(what, length);
        self.cursor.take(what, length).map_err(|_| absent)
    }

    /// Reads one byte.
    pub(super) fn u8(&mut self, what: &'static str) -> Result<u8, WireError> {
        let absent = self.absent(what, 1);
        self.cursor.u8(what).map_err(|_| absent)
    }

    /// Reads a fixed-size number, least significant byte first.
    pub(super) fn u16(&mut self, what: &'static str) -> Result<u16, WireError> {
        let absent = self.absent(what, 2);
        self.cursor.u16(what).map_err(|_| absent)
    }

    /// Reads a number of variable length: seven bits per byte, least significant first. Bit 0x80
    /// means that a byte follows. A ninth byte has eight bits and is the last.
    pub(super) fn z64(&mut self, what: &'static str) -> Result<u64, WireError> {
        let mut value = 0;
        for shift in (0..56).step_by(7) {
            let byte = self.u8(what)?;
            value |= u64::from(byte & 0x7f) << shift;
            if byte & 0x80 == 0 {
                return Ok(value);
            }
        }
        Ok(value | u64::from(self.u8(what)?) << 56)
    }

    /// Reads a number of variable length that must fit the type.
    pub(super) fn number<T: TryFrom<u64>>(&mut self, what: &'static str) -> Result<T, WireError> {
        let start = *self;
        T::try_from(self.z64(what)?).map_err(|_| start.error(what, Reason::BadValue))
    }

    /// Reads a length of at most `limit`.
    fn length(&mut self, what: &'static str, limit: u64) -> Result<usize, WireError> {
        let start = *self;
        let length = self.z64(what)?;
        if length > limit {
            return Err(start.error(what, Reason::BadLength));
        }
        usize::try_from(length).map_err(|_| start.error(what, Reason::BadLength))
    }

    /// Reads a length of at most 32 bits. Returns a reader of that many bytes, of which the capture
    /// may lack the end.
    pub(super) fn nested(&mut self, what: &'static str) -> Result<Self, WireError> {
        let length = self.length(what, u64::from(u32::MAX))?;
        self.split(what, length)
    }

    /// Returns a reader of the next `length` bytes, of which the capture may lack the end.
    pub(super) fn split(&mut self, what: &'static str, length: usize) -> Result<Self, WireError> {
        let missing = length.saturating_sub(self.remaining());
        if missing > self.missing {
            return Err(self.error(what, Reason::BadLength));
        }
        self.missing -= missing;
        let captured = length - missing;
        Ok(Self {
            cursor: self.cursor.sub(what, captured)?,
            missing,
        })
    }

    /// Reads a length of at most 32 bits and that many bytes, of which the capture may lack the
    /// end.
    pub(super) fn bytes(&mut self, what: &'static str) -> Result<Bytes<'a>, WireError> {
        Ok(self.nested(what)?.rest())
    }

    /// Returns all bytes that follow.
    pub(super) const fn rest(&self) -> Bytes<'a> {
        Bytes {
            captured: self.cursor.rest(),
            length: self.remaining().saturating_add(self.missing),
        }
    }

    /// Reads a length of at most `limit` and that many captured bytes.
    pub(super) fn sized(&mut self, what: &'static str, limit: u64) -> Result<&'a [u8], WireError> {
        let length = self.length(what, limit)?;
        self.take(what, length)
    }

    /// Reads a length of at most `limit` and that many bytes of UTF-8.
    pub(super) fn text(&mut self, what: &'static str, limit: u64) -> Result<&'a str, WireError> {
        let start = *self;
        let bytes = self.sized(what, limit)?;
        str::from_utf8(bytes).map_err(|_| start.error(what, Reason::BadText))
    }

    /// Fails unless everything was read. Some fields have a length that Zenoh does not check; here
    /// the field must fill it.
    pub(super) const fn finish(&self, what: &'static str) -> Result<(), WireError> {
        if self.is_at_end() {
            Ok(())
        } else {
            Err(self.error(what, Reason::BadLength))
        }
    }
}

/// Returns a number in the encoding of variable length: seven bits per byte, least significant
/// first. Bit 0x80 means that a byte follows. A ninth byte has eight bits and is the last.
#[must_use]
pub fn vle(mut value: u64) -> Vec<u8> {
    let mut bytes = Vec::new();
    loop {
        let [low, ..] = value.to_le_bytes();
        if value <= 0x7f || bytes.len() == 8 {
            bytes.push(low);
            return bytes;
        }
        bytes.push(low | 0x80);
        value >>= 7;
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn the_ninth_byte_of_a_number_has_eight_bits() {
        let mut reader = Reader::whole(&[0xff; 10]);
        assert_eq!(reader.z64("n"), Ok(u64::MAX));
        assert_eq!(reader.remaining(), 1);
        // 0x80 alone is an unfinished number.
        let mut reader = Reader::whole(&[0x80]);
        assert_eq!(reader.z64("n").unwrap_err().reason, Reason::BadLength);
        let mut reader = Reader::new(&[0x80], 2);
        assert_eq!(reader.z64("n").unwrap_err().reason, Reason::Truncated);
    }

    #[test]
    fn a_number_too_large_for_its_field_is_refused() {
        let bytes = [0x80, 0x80, 0x04];
        let mut reader = Reader::whole(&bytes);
        assert_eq!(
            reader.number::<u16>("id").unwrap_err().reason,
            Reason::BadValue
        );
        let mut reader = Reader::whole(&bytes);
        assert_eq!(reader.number::<u32>("id"), Ok(1 << 16));
    }

    #[test]
    fn a_cut_field_is_distinguished_from_a_malformed_one() {
        // Five bytes declared, two captured, of eight on the wire.
        let mut reader = Reader::new(&[5, 1, 2], 8);
        let bytes = reader.bytes("payload").unwrap();
        assert_eq!((bytes.captured, bytes.length), (&[1, 2][..], 5));
        assert_eq!(bytes.whole(), None);
        assert_eq!(reader.u8("next").unwrap_err().reason, Reason::Truncated);
        let mut reader = Reader::new(&[5, 1, 2], 6);
        assert_eq!(reader.bytes("payload").unwrap().length, 5);
        assert!(reader.is_at_end());
        assert_eq!(reader.u8("next").unwrap_err().reason, Reason::BadLength);
        let mut reader = Reader::new(&[5, 1, 2], 5);
        assert_eq!(
            reader.bytes("payload").unwrap_err().reason,
            Reason::BadLength
        );
        let mut reader = Reader::beginning(&[0xff, 0xff, 0x7f, 1]);
        assert_eq!(reader.bytes("payload").unwrap().length, 0x1f_ffff);
    }

    proptest! {
        #[test]
        fn numbers_survive_a_round_trip(value: u64, shift in 0_u32..64) {
            let bytes = vle(value >> shift);
            let mut reader = Reader::whole(&bytes);
            prop_assert_eq!(reader.z64("n"), Ok(value >> shift));
            prop_assert!(reader.is_at_end());
        }

        #[test]
        fn numbers_of_any_bytes_take_one_to_nine_bytes(bytes: Vec<u8>) {
            let mut reader = Reader::whole(&bytes);
            while !reader.is_at_end() {
                let before = reader.offset();
                if reader.z64("n").is_err() {
                    break;
                }
                prop_assert!((1..=9).contains(&(reader.offset() - before)));
            }
        }
    }
}
