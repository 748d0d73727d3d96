//! PID_TYPE_INFORMATION: the hashes of an endpoint's type (DDS-XTypes 1.3, 7.6.3.2.2).
//!
//! Only the hash of the complete type is read. The fields of the type are in its TypeObject, which
//! the TypeLookup service sends on request.

use core::fmt;

use super::user_data::hexadecimal;
use crate::cursor::{Cursor, WireError};
use crate::xcdr2::{self, Members};

/// Member `complete` of TypeInformation.
const COMPLETE: u32 = 0x1002;
/// Discriminator of a TypeIdentifier that is the hash of a complete type.
const EK_COMPLETE: u8 = 0xf2;

/// Identity of a complete type in XTypes: the first 14 bytes of the MD5 of its TypeObject (7.3.1.2).
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct EquivalenceHash(pub [u8; 14]);

impl EquivalenceHash {
    /// Prefix of the text form.
    pub const PREFIX: &str = "XTYPES_";

    /// Parses `XTYPES_` and 28 hexadecimal digits.
    #[must_use]
    pub fn parse(text: &str) -> Option<Self> {
        hexadecimal(text.strip_prefix(Self::PREFIX)?).map(Self)
    }

    /// Reads the hash in PID_TYPE_INFORMATION. Returns `None` if the endpoint announces only the
    /// hash of its minimal type, which has no names.
    ///
    /// # Errors
    /// Fails if the bytes are no TypeInformation.
    pub fn read(mut value: Cursor<'_>) -> Result<Option<Self>, WireError> {
        let members = Members::read(&mut value, "TypeInformation")?;
        let Some(mut complete) = members.find(COMPLETE)? else {
            return Ok(None);
        };
        let mut type_and_dependencies = xcdr2::delimited(&mut complete, "complete")?;
        let mut sized = xcdr2::delimited(&mut type_and_dependencies, "typeid_with_size")?;
        match sized.u8("type_id")? {
            EK_COMPLETE => Ok(Some(Self(sized.array("equivalence_hash")?))),
            _ => Ok(None),
        }
    }
}

impl fmt::Display for EquivalenceHash {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(Self::PREFIX)?;
        self.0.iter().try_for_each(|byte| write!(f, "{byte:02x}"))
    }
}

impl fmt::Debug for EquivalenceHash {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

#[cfg(test)]
mod tests {
    use std::string::ToString;
    use std::vec::Vec;

    use super::*;
    use crate::cursor::{Endianness, Reason};
    use crate::testing::hurt;

    /// The value of PID_TYPE_INFORMATION from Cyclone DDS 11.0.1, for a structure with one nested
    /// structure.
    const CAPTURED: &str = "9000000001100040400000003c00000014000000f180bd35dcc6833bf74e945138da1c\
        0000000000010000001c0000000100000014000000f10d6786d4c10a7869aee1f07a6ce1003c000000021000404\
        00000003c00000014000000f2c6e4e345af3a7e027f9fca8991330000000000010000001c000000010000001400\
        0000f22ee1e675799c78e4add2352497610071000000";

    fn captured() -> Vec<u8> {
        let digits: Vec<_> = CAPTURED.chars().filter_map(|c| c.to_digit(16)).collect();
        let bytes = digits.chunks(2).map(|two| (two[0] << 4 | two[1]) as u8);
        bytes.collect()
    }

    fn read(bytes: &[u8]) -> Result<Option<EquivalenceHash>, WireError> {
        EquivalenceHash::read(Cursor::new(bytes, Endianness::Little))
    }

    #[test]
    fn the_hash_of_the_complete_type_is_read() {
        let hash = read(&captured()).unwrap().unwrap();
        assert_eq!(hash.to_string(), "XTYPES_c6e4e345af3a7e027f9fca899133");
        assert_eq!(EquivalenceHash::parse(&hash.to_string()), Some(hash));
    }

    #[test]
    fn a_type_without_a_complete_hash_has_none() {
        let mut minimal = captured();
        // Another member.
        minimal[4 + 4 + 4 + 64] = 3;
        assert_eq!(read(&minimal), Ok(None));
        let mut other = captured();
        let at = other.iter().position(|byte| *byte == 0xf2).unwrap();
        other[at] = 0xf1;
        assert_eq!(read(&other), Ok(None));
    }

    #[test]
    fn damaged_bytes_are_refused_with_field_and_offset() {
        let bytes = captured();
        let error = read(&bytes[..40]).unwrap_err();
        assert_eq!(
            (error.what, error.offset, error.reason),
            ("TypeInformation", 4, Reason::Truncated)
        );
        hurt(&bytes, |bytes| {
            let _ = read(bytes);
        });
    }

    #[test]
    fn other_text_is_no_hash() {
        for text in ["", "XTYPES_", "XTYPES_c6e4", "c6e4e345af3a7e027f9fca899133"] {
            assert_eq!(EquivalenceHash::parse(text), None, "{text}");
        }
    }
}
