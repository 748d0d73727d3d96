//! The framing of XCDR2 for appendable and mutable types, as TypeObjects and announced types use it
//! (DDS-XTypes 1.3, 7.4.3.4 and 7.4.3.5).
//!
//! An appendable structure and a collection begin with their size (DHEADER). A member of a mutable
//! structure begins with its id and its size (EMHEADER). Each size opens a bounded cursor.

use crate::cursor::{Cursor, Reason, WireError};
use crate::text;

/// Reads the size before a structure or collection (DHEADER), and returns its content.
///
/// # Errors
/// Fails if fewer bytes remain than the size.
pub fn delimited<'a>(cursor: &mut Cursor<'a>, what: &'static str) -> Result<Cursor<'a>, WireError> {
    cursor.align(4);
    let error = cursor.error(what, Reason::BadLength);
    let size = usize::try_from(cursor.u32(what)?).map_err(|_| error)?;
    cursor.sub(what, size)
}

/// Reads a string of at most `limit` bytes.
///
/// # Errors
/// Fails if the bytes end before the string, or if it is too long, not UTF-8 or not terminated.
pub fn string<'a>(
    cursor: &mut Cursor<'a>,
    what: &'static str,
    limit: usize,
) -> Result<&'a str, WireError> {
    text::string(cursor, what, limit)
}

/// The members of a mutable structure; iterates over identifiers and values, and ends after the
/// first error.
#[derive(Clone, Copy, Debug)]
pub struct Members<'a> {
    rest: Cursor<'a>,
    ended: bool,
}

impl<'a> Members<'a> {
    /// Reads the size of a mutable structure.
    ///
    /// # Errors
    /// Fails if fewer bytes remain than the size.
    pub fn read(cursor: &mut Cursor<'a>, what: &'static str) -> Result<Self, WireError> {
        let rest = delimited(cursor, what)?;
        Ok(Self { rest, ended: false })
    }

    /// Returns the value of the first member with this identifier.
    ///
    /// # Errors
    /// Fails if the structure is malformed before that member.
    pub fn find(self, id: u32) -> Result<Option<Cursor<'a>>, WireError> {
        for member in self {
            let (found, value) = member?;
            if found == id {
                return Ok(Some(value));
            }
        }
        Ok(None)
    }

    fn member(&mut self) -> Result<Option<(u32, Cursor<'a>)>, WireError> {
        self.rest.align(4);
        if self.rest.remaining() == 0 {
            return Ok(None);
        }
        let header = self.rest.u32("EMHEADER")?;
        let after = self.rest;
        let error = after.error("NEXTINT", Reason::BadLength);
        let next = || {
            let mut cursor = after;
            usize::try_from(cursor.u32("NEXTINT")?).map_err(|_| error)
        };
        // From length code 5 on, NEXTINT is also the value's own size or length.
        let length = match header >> 28 & 7 {
            code @ 0..=3 => 1 << code,
            4 => {
                let length = next()?;
                self.rest.u32("NEXTINT")?;
                length
            }
            code => {
                let unit = match code {
                    5 => 1,
                    6 => 4,
                    _ => 8,
                };
                let length = next()?.checked_mul(unit);
                let length = length.and_then(|length| length.checked_add(4));
                length.ok_or(error)?
            }
        };
        let value = self.rest.sub("member", length)?;
        Ok(Some((header & 0x0fff_ffff, value)))
    }
}

impl<'a> Iterator for Members<'a> {
    type Item = Result<(u32, Cursor<'a>), WireError>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.ended {
            return None;
        }
        let member = self.member().transpose();
        self.ended = !matches!(member, Some(Ok(_)));
        member
    }
}

#[cfg(test)]
mod tests {
    use std::vec::Vec;

    use super::*;
    use crate::cursor::Endianness;

    fn members(bytes: &[u8]) -> Result<Vec<(u32, Vec<u8>)>, WireError> {
        let mut cursor = Cursor::new(bytes, Endianness::Little);
        Members::read(&mut cursor, "structure")?
            .map(|member| member.map(|(id, value)| (id, value.rest().to_vec())))
            .collect()
    }

    #[test]
    fn each_length_code_has_its_length() {
        let bytes = [
            &[52, 0, 0, 0][..],
            // One octet and its padding, two octets and theirs, then four.
            &[1, 0, 0, 0x00, 0xaa, 0, 0, 0],
            &[2, 0, 0, 0x90, 0xbb, 0xbb, 0, 0],
            &[3, 0, 0, 0x20, 1, 2, 3, 4],
            // A length before the value, and a length within it.
            &[4, 0, 0, 0x40, 2, 0, 0, 0, 7, 8, 0, 0],
            &[5, 0, 0, 0x60, 2, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8],
        ]
        .concat();
        let expected = [
            (1, Vec::from([0xaa])),
            (2, Vec::from([0xbb, 0xbb])),
            (3, Vec::from([1, 2, 3, 4])),
            (4, Vec::from([7, 8])),
            (5, Vec::from([2, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8])),
        ];
        assert_eq!(members(&bytes).unwrap(), expected);
    }

    #[test]
    fn lengths_beyond_the_structure_are_refused() {
        for (code, length) in [(0x40, 1_u32), (0x50, u32::MAX), (0x60, 1), (0x70, u32::MAX)] {
            let bytes = [
                &[8, 0, 0, 0, 9, 0, 0, code][..],
                &length.to_le_bytes(),
                &[0; 64],
            ];
            let error = members(&bytes.concat()).unwrap_err();
            assert_eq!((error.what, error.offset > 4), ("member", true), "{error}");
        }
        let error = members(&[9, 0, 0, 0, 1]).unwrap_err();
        assert_eq!((error.what, error.reason), ("structure", Reason::Truncated));
        let error = members(&[2, 0, 0, 0, 1, 2]).unwrap_err();
        assert_eq!((error.what, error.offset), ("EMHEADER", 4));
    }
}
