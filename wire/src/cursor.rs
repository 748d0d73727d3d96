//! The bounded cursor with which the parsers read untrusted bytes.
//!
//! Every length field opens a sub-cursor, so an inner length cannot escape the outer one. Every
//! error names the field, its offset and the reason. Offsets are relative to the slice of the
//! outermost cursor.

/// Byte order of the bytes that follow.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Endianness {
    /// Most significant byte first.
    Big,
    /// Least significant byte first.
    Little,
}

/// Why a parse failed.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Reason {
    /// The bytes end before the field does.
    Truncated,
    /// A length or count that its container cannot hold.
    BadLength,
    /// A fixed marker (magic, version, encapsulation) with an unexpected value.
    BadMarker,
    /// Text that is not UTF-8, lacks its terminator, or has characters that a name cannot have.
    BadText,
    /// A value outside the field's range.
    BadValue,
    /// More elements than the parser accepts.
    OverLimit,
}

impl Reason {
    /// Returns the label value for metrics: one of a bounded set of words.
    #[must_use]
    pub const fn label(self) -> &'static str {
        match self {
            Self::Truncated => "truncated",
            Self::BadLength => "bad_length",
            Self::BadMarker => "bad_marker",
            Self::BadText => "bad_text",
            Self::BadValue => "bad_value",
            Self::OverLimit => "over_limit",
        }
    }
}

/// One failed read.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct WireError {
    /// The field that was being read, as the specification names it.
    pub what: &'static str,
    /// Byte offset at which the field begins.
    pub offset: usize,
    /// Why the read failed.
    pub reason: Reason,
}

impl core::fmt::Display for WireError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        write!(
            f,
            "{} at offset {}: {}",
            self.what,
            self.offset,
            self.reason.label()
        )
    }
}

impl core::error::Error for WireError {}

/// A bounded position in borrowed bytes.
#[derive(Clone, Copy, Debug)]
pub struct Cursor<'a> {
    rest: &'a [u8],
    offset: usize,
    endianness: Endianness,
}

impl<'a> Cursor<'a> {
    /// Creates a cursor at the start of `bytes`.
    #[must_use]
    pub const fn new(bytes: &'a [u8], endianness: Endianness) -> Self {
        Self {
            rest: bytes,
            offset: 0,
            endianness,
        }
    }

    /// Returns the bytes that are not read yet.
    #[must_use]
    pub const fn rest(&self) -> &'a [u8] {
        self.rest
    }

    /// Returns the number of bytes left.
    #[must_use]
    pub const fn remaining(&self) -> usize {
        self.rest.len()
    }

    /// Returns the position relative to the outermost cursor's start.
    #[must_use]
    pub const fn offset(&self) -> usize {
        self.offset
    }

    /// Returns the byte order of multi-byte reads.
    #[must_use]
    pub const fn endianness(&self) -> Endianness {
        self.endianness
    }

    /// Returns the same position with another byte order.
    #[must_use]
    pub const fn with_endianness(self, endianness: Endianness) -> Self {
        Self { endianness, ..self }
    }

    /// Returns an error for the field at the current position.
    #[must_use]
    pub const fn error(&self, what: &'static str, reason: Reason) -> WireError {
        WireError {
            what,
            offset: self.offset,
            reason,
        }
    }

    /// Reads the next `len` bytes.
    ///
    /// # Errors
    /// Returns [`Reason::Truncated`] if fewer bytes remain.
    pub fn take(&mut self, what: &'static str, len: usize) -> Result<&'a [u8], WireError> {
        let (head, rest) = self
            .rest
            .split_at_checked(len)
            .ok_or(self.error(what, Reason::Truncated))?;
        self.rest = rest;
        self.offset += len;
        Ok(head)
    }

    /// Reads the next `N` bytes as an array.
    ///
    /// # Errors
    /// Returns [`Reason::Truncated`] if fewer bytes remain.
    pub fn array<const N: usize>(&mut self, what: &'static str) -> Result<[u8; N], WireError> {
        let (head, rest) = self
            .rest
            .split_first_chunk::<N>()
            .ok_or(self.error(what, Reason::Truncated))?;
        self.rest = rest;
        self.offset += N;
        Ok(*head)
    }

    /// Returns a cursor over the next `len` bytes, and moves this one past them.
    ///
    /// # Errors
    /// Returns [`Reason::Truncated`] if fewer bytes remain.
    pub fn sub(&mut self, what: &'static str, len: usize) -> Result<Self, WireError> {
        let offset = self.offset;
        Ok(Self {
            rest: self.take(what, len)?,
            offset,
            endianness: self.endianness,
        })
    }

    /// Reads one octet.
    ///
    /// # Errors
    /// Returns [`Reason::Truncated`] if no byte remains.
    pub fn u8(&mut self, what: &'static str) -> Result<u8, WireError> {
        Ok(u8::from_ne_bytes(self.array(what)?))
    }

    /// Reads two octets in the cursor's byte order.
    ///
    /// # Errors
    /// Returns [`Reason::Truncated`] if fewer bytes remain.
    pub fn u16(&mut self, what: &'static str) -> Result<u16, WireError> {
        let bytes = self.array(what)?;
        Ok(match self.endianness {
            Endianness::Big => u16::from_be_bytes(bytes),
            Endianness::Little => u16::from_le_bytes(bytes),
        })
    }

    /// Reads four octets in the cursor's byte order.
    ///
    /// # Errors
    /// Returns [`Reason::Truncated`] if fewer bytes remain.
    pub fn u32(&mut self, what: &'static str) -> Result<u32, WireError> {
        let bytes = self.array(what)?;
        Ok(match self.endianness {
            Endianness::Big => u32::from_be_bytes(bytes),
            Endianness::Little => u32::from_le_bytes(bytes),
        })
    }

    /// Reads four octets as a signed number.
    ///
    /// # Errors
    /// Returns [`Reason::Truncated`] if fewer bytes remain.
    pub fn i32(&mut self, what: &'static str) -> Result<i32, WireError> {
        Ok(self.u32(what)?.cast_signed())
    }

    /// Reads eight octets in the cursor's byte order.
    ///
    /// # Errors
    /// Returns [`Reason::Truncated`] if fewer bytes remain.
    pub fn u64(&mut self, what: &'static str) -> Result<u64, WireError> {
        let bytes = self.array(what)?;
        Ok(match self.endianness {
            Endianness::Big => u64::from_be_bytes(bytes),
            Endianness::Little => u64::from_le_bytes(bytes),
        })
    }

    /// Skips to the next multiple of `alignment`, counted from the start of the outermost cursor.
    /// Skips to the end if fewer bytes remain, because trailing padding may be missing.
    pub fn align(&mut self, alignment: usize) {
        let padding = self.offset.wrapping_neg() & (alignment - 1);
        let padding = padding.min(self.rest.len());
        self.rest = self
            .rest
            .split_at_checked(padding)
            .map_or(&[], |(_, rest)| rest);
        self.offset += padding;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sub_cursor_cannot_escape_its_length() {
        let mut outer = Cursor::new(&[1, 2, 3, 4, 5, 6], Endianness::Little);
        outer.u8("skip").unwrap();
        let mut inner = outer.sub("inner", 3).unwrap();
        assert_eq!(inner.u16("value"), Ok(0x0302));
        assert_eq!(
            inner.u16("value"),
            Err(WireError {
                what: "value",
                offset: 3,
                reason: Reason::Truncated
            })
        );
        assert_eq!(outer.rest(), &[5, 6]);
    }

    #[test]
    fn alignment_counts_from_the_start_of_the_outermost_cursor() {
        let mut cursor = Cursor::new(&[0; 7], Endianness::Big);
        cursor.u8("x").unwrap();
        cursor.align(4);
        assert_eq!(cursor.offset(), 4);
        cursor.u8("x").unwrap();
        cursor.align(4);
        assert_eq!((cursor.offset(), cursor.remaining()), (7, 0));
    }
}
