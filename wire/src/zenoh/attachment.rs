//! Attachments of rmw_zenoh: sequence number, source time and gid of each sample (rmw_zenoh,
//! `attachment_helpers.cpp` and `liveliness_utils.cpp`).

use core::fmt;

use crate::cursor::{Cursor, Endianness, Reason, WireError};
use crate::rtps::SequenceNumber;
use crate::time::Timestamp;

/// Identity of a publisher or client: the XXH3-128 hash of its liveliness token.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Gid(pub [u8; 16]);

impl Gid {
    /// Returns the gid of the endpoint that declares a token.
    #[must_use]
    pub fn of_token(token: &str) -> Self {
        // The low 64 bits come first. Each half begins with the least significant byte.
        Self(twox_hash::XxHash3_128::oneshot(token.as_bytes()).to_le_bytes())
    }
}

/// Formats 32 hexadecimal digits in the order of the wire.
impl fmt::Display for Gid {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.iter().try_for_each(|byte| write!(f, "{byte:02x}"))
    }
}

impl fmt::Debug for Gid {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

/// The data that rmw_zenoh attaches to each sample, request and reply.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub struct Attachment {
    /// Number of the sample, from 1 for each publisher and client. A reply has the number of its
    /// request.
    pub sequence_number: SequenceNumber,
    /// Time at which the sample was published, by the realtime clock of the source; `None` if
    /// before 1970.
    pub source_timestamp: Option<Timestamp>,
    /// Identity of the publisher or client. A reply has the identity of the client.
    pub gid: Gid,
}

impl Attachment {
    /// Length in bytes since rmw_zenoh 0.1.2 (Humble) and 0.2.4 (Jazzy), and in Kilted and later.
    pub const PLAIN: usize = 33;
    /// Length in bytes in earlier versions, in which a name precedes each value.
    pub const LABELLED: usize = 77;

    /// Parses an attachment of either form. Zenoh applications other than ROS may attach anything.
    ///
    /// # Errors
    /// Fails if the length, a name or the length of the gid is wrong.
    pub fn parse(bytes: &[u8]) -> Result<Self, WireError> {
        let mut cursor = Cursor::new(bytes, Endianness::Little);
        let is_labelled = match bytes.len() {
            Self::PLAIN => false,
            Self::LABELLED => true,
            _ => return Err(cursor.error("attachment", Reason::BadLength)),
        };
        let label = |cursor: &mut Cursor<'_>, name| {
            if is_labelled {
                string(cursor, name)
            } else {
                Ok(())
            }
        };
        label(&mut cursor, "sequence_number")?;
        let sequence_number = SequenceNumber(cursor.u64("sequence_number")?);
        label(&mut cursor, "source_timestamp")?;
        let nanoseconds = cursor.u64("source_timestamp")?.cast_signed();
        label(&mut cursor, "source_gid")?;
        let start = cursor;
        if cursor.u8("length of source_gid")? != 16 {
            return Err(start.error("length of source_gid", Reason::BadLength));
        }
        Ok(Self {
            sequence_number,
            source_timestamp: u64::try_from(nanoseconds).ok().map(Timestamp),
            gid: Gid(cursor.array("source_gid")?),
        })
    }
}

/// Reads a string, which must equal `name`.
fn string(cursor: &mut Cursor<'_>, name: &'static str) -> Result<(), WireError> {
    let start = *cursor;
    let length = cursor.u8(name)?;
    if cursor.take(name, usize::from(length))? == name.as_bytes() {
        Ok(())
    } else {
        Err(start.error(name, Reason::BadMarker))
    }
}

#[cfg(test)]
mod tests {
    use std::string::ToString;
    use std::vec::Vec;

    use super::*;

    fn labelled() -> Vec<u8> {
        let mut bytes = Vec::new();
        bytes.extend(b"\x0fsequence_number\x2a\0\0\0\0\0\0\0");
        bytes.extend(b"\x10source_timestamp\x01\x02\0\0\0\0\0\0");
        bytes.extend(b"\x0asource_gid\x10abcdefghijklmnop");
        bytes
    }

    #[test]
    fn a_gid_is_the_hash_of_the_token() {
        let token = "@ros2_lv/0/d10ca1632cc62c55cbbda90ef78373e8/0/10/MP/%/%/talker/%chatter/\
                     std_msgs::msg::dds_::String_/\
                     RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18/\
                     ::,7:,:,:,,";
        assert_eq!(
            Gid::of_token(token).to_string(),
            "0859edc6de1dc09e0e8ac6bec5bf6e19"
        );
    }

    #[test]
    fn both_forms_of_an_attachment_yield_the_same_values() {
        let labelled = labelled();
        assert_eq!(labelled.len(), Attachment::LABELLED);
        let attachment = Attachment::parse(&labelled).unwrap();
        assert_eq!(attachment.sequence_number, SequenceNumber(42));
        assert_eq!(attachment.source_timestamp, Some(Timestamp(0x0201)));
        assert_eq!(attachment.gid, Gid(*b"abcdefghijklmnop"));
        let plain = [&labelled[16..24], &labelled[41..49], &labelled[60..]].concat();
        assert_eq!(plain.len(), Attachment::PLAIN);
        assert_eq!(Attachment::parse(&plain), Ok(attachment));
    }

    #[test]
    fn attachments_of_another_form_are_refused() {
        let labelled = labelled();
        for length in 0..labelled.len() {
            assert!(Attachment::parse(&labelled[..length]).is_err(), "{length}");
        }
        for position in [0, 3, 24, 30, 49, 52, 60] {
            let mut bytes = labelled.clone();
            bytes[position] ^= 1;
            assert!(Attachment::parse(&bytes).is_err(), "{position}");
        }
        let mut plain = [0; Attachment::PLAIN];
        assert!(Attachment::parse(&plain).is_err());
        plain[16] = 16;
        plain[15] = 0x80;
        assert_eq!(Attachment::parse(&plain).unwrap().source_timestamp, None);
    }
}
