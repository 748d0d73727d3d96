//! Plain CDR with values of eight bytes, whose alignment depends on its version.

use crate::cursor::{Cursor, WireError};
use crate::text;

/// Length of the encapsulation header (RTPS 2.5, 10.2).
const ENCAPSULATION: usize = 4;

/// A cursor that begins after the encapsulation header, as alignment does.
#[derive(Clone, Copy, Debug)]
pub(crate) struct PlainCursor<'a> {
    pub(crate) cursor: Cursor<'a>,
    /// Alignment of values of eight bytes: 8 in CDR, 4 in CDR2.
    pub(crate) wide: usize,
}

impl<'a> PlainCursor<'a> {
    /// Begins to read a payload.
    pub(crate) fn of(payload: &'a [u8]) -> Result<Self, WireError> {
        let endianness = text::plain_cdr(payload)?.endianness();
        let body = payload.get(ENCAPSULATION..).unwrap_or_default();
        let is_cdr2 = payload.get(1).is_some_and(|kind| *kind >= 6);
        Ok(Self {
            cursor: Cursor::new(body, endianness),
            wide: if is_cdr2 { 4 } else { 8 },
        })
    }

    /// Reads the length of a sequence, or another number of four bytes.
    pub(crate) fn count(&mut self, what: &'static str) -> Result<u32, WireError> {
        self.cursor.align(4);
        self.cursor.u32(what)
    }

    /// Reads a string without its terminator.
    pub(crate) fn text(&mut self, what: &'static str) -> Result<&'a [u8], WireError> {
        text::unterminated(&mut self.cursor, what)
    }

    /// Reads a number of eight bytes.
    pub(crate) fn wide(&mut self, what: &'static str) -> Result<u64, WireError> {
        self.cursor.align(self.wide);
        self.cursor.u64(what)
    }

    /// Reads a number of double precision.
    pub(crate) fn double(&mut self, what: &'static str) -> Result<f64, WireError> {
        self.wide(what).map(f64::from_bits)
    }
}

/// A sequence whose elements are read one after the other. It ends at the first malformed one.
#[derive(Clone, Debug)]
pub(crate) struct Sequence<'a> {
    cursor: PlainCursor<'a>,
    left: u32,
}

impl<'a> Sequence<'a> {
    /// Reads the number of elements at this cursor.
    pub(crate) fn at(mut cursor: PlainCursor<'a>, what: &'static str) -> Result<Self, WireError> {
        let left = cursor.count(what)?;
        Ok(Self { cursor, left })
    }

    /// Reads the next element.
    pub(crate) fn next<T>(
        &mut self,
        read: impl FnOnce(&mut PlainCursor<'a>) -> Result<T, WireError>,
    ) -> Option<Result<T, WireError>> {
        self.left = self.left.checked_sub(1)?;
        let element = read(&mut self.cursor);
        if element.is_err() {
            self.left = 0;
        }
        Some(element)
    }

    /// Returns the cursor after the elements that were read.
    pub(crate) const fn cursor(&self) -> PlainCursor<'a> {
        self.cursor
    }
}
