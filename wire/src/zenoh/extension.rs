//! Extensions: optional fields that a decoder may skip by their encoding (`zenoh-protocol`,
//! `common/extension.rs`).
//!
//! Zenoh compares the id together with the encoding and the flag M, so the same id in another
//! encoding is another extension. An unknown extension with M is an error in Zenoh and here.

use crate::cursor::{Reason, WireError};

use super::reader::Reader;

/// Flag of a message or of an extension: an extension follows.
const MORE: u8 = 0x80;
/// Flag of an extension that a receiver must know.
const MANDATORY: u8 = 0x10;

/// Names of unknown mandatory extensions by id.
const UNKNOWN: [&str; 16] = [
    "unknown mandatory extension 0x0",
    "unknown mandatory extension 0x1",
    "unknown mandatory extension 0x2",
    "unknown mandatory extension 0x3",
    "unknown mandatory extension 0x4",
    "unknown mandatory extension 0x5",
    "unknown mandatory extension 0x6",
    "unknown mandatory extension 0x7",
    "unknown mandatory extension 0x8",
    "unknown mandatory extension 0x9",
    "unknown mandatory extension 0xa",
    "unknown mandatory extension 0xb",
    "unknown mandatory extension 0xc",
    "unknown mandatory extension 0xd",
    "unknown mandatory extension 0xe",
    "unknown mandatory extension 0xf",
];

/// One extension of a message.
#[derive(Clone, Copy, Debug)]
pub(super) struct Extension<'a> {
    /// The header without the flag Z: id, flag M and encoding.
    pub id: u8,
    /// The value with encoding z64; zero with others.
    pub number: u64,
    /// The value with encoding zbuf; empty with others.
    pub value: Reader<'a>,
    start: Reader<'a>,
}

impl Extension<'_> {
    /// Ignores an extension that the caller does not know.
    ///
    /// # Errors
    /// Fails if the extension is mandatory.
    pub(super) fn skip(&self) -> Result<(), WireError> {
        if self.id & MANDATORY == 0 {
            return Ok(());
        }
        let name = UNKNOWN.get(usize::from(self.id & 0x0f));
        let name = name.copied().unwrap_or("unknown mandatory extension");
        Err(self.start.error(name, Reason::BadMarker))
    }
}

/// The extensions of one message, read one after another.
pub(super) struct Extensions {
    more: bool,
}

impl Extensions {
    /// Returns the extensions of a message with this header.
    pub(super) const fn of(header: u8) -> Self {
        Self {
            more: header & MORE != 0,
        }
    }

    /// Reads the next extension; `None` after the last one.
    pub(super) fn next<'a>(
        &mut self,
        reader: &mut Reader<'a>,
    ) -> Result<Option<Extension<'a>>, WireError> {
        if !self.more {
            return Ok(None);
        }
        let start = *reader;
        let header = reader.u8("extension")?;
        self.more = header & MORE != 0;
        let mut extension = Extension {
            id: header & !MORE,
            number: 0,
            value: Reader::whole(&[]),
            start,
        };
        match header & 0x60 {
            0x00 => {}
            0x20 => extension.number = reader.z64("extension")?,
            0x40 => extension.value = reader.nested("extension")?,
            _ => return Err(start.error("encoding of an extension", Reason::BadMarker)),
        }
        Ok(Some(extension))
    }

    /// Skips all extensions of a message for which none is defined.
    pub(super) fn skip_all(mut self, reader: &mut Reader<'_>) -> Result<(), WireError> {
        while let Some(extension) = self.next(reader)? {
            extension.skip()?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unknown_extensions_are_skipped_by_their_encoding() {
        // unit 9, z64 10 = 300, zbuf 11 of two bytes.
        let bytes = [0x89, 0xaa, 0xac, 0x02, 0x4b, 2, 7, 8, 0x55];
        let mut reader = Reader::whole(&bytes);
        let mut extensions = Extensions::of(0x80);
        let mut read = || extensions.next(&mut reader).unwrap();
        assert_eq!(read().unwrap().id, 0x09);
        let number = read().unwrap();
        assert_eq!((number.id, number.number), (0x2a, 300));
        assert_eq!(read().unwrap().value.rest().whole(), Some(&[7, 8][..]));
        assert!(read().is_none());
        assert_eq!(reader.offset(), 8);
    }

    #[test]
    fn an_unknown_mandatory_extension_is_an_error_with_its_id() {
        let mut reader = Reader::whole(&[0x35, 1]);
        let error = Extensions::of(0x80).skip_all(&mut reader).unwrap_err();
        assert_eq!(error.what, "unknown mandatory extension 0x5");
        assert_eq!((error.offset, error.reason), (0, Reason::BadMarker));
    }

    #[test]
    fn an_extension_with_the_reserved_encoding_is_refused() {
        let mut reader = Reader::whole(&[0x60, 1]);
        assert!(Extensions::of(0x80).skip_all(&mut reader).is_err());
    }
}
