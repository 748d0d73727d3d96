//! Identities and times of Zenoh: session ids, entities, timestamps of hybrid logical clocks.

use core::fmt;
use core::num::NonZeroU128;

use crate::cursor::{Reason, WireError};
use crate::guid::GuidPrefix;
use crate::rtps::VendorId;
use crate::time::{RtpsTime, Timestamp};

use super::reader::Reader;

/// Id of a session (a process, with rmw_zenoh) or router: 1 to 16 bytes on the wire.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct ZenohId(NonZeroU128);

impl ZenohId {
    /// Converts the bytes of the wire, least significant first; `None` for an id of zero or for a
    /// length other than 1 to 16.
    #[must_use]
    pub fn from_le_bytes(bytes: &[u8]) -> Option<Self> {
        let mut all = [0; 16];
        all.get_mut(..bytes.len())?.copy_from_slice(bytes);
        NonZeroU128::new(u128::from_le_bytes(all)).map(Self)
    }

    /// Parses the printed form: lower-case hexadecimal digits without leading zeros.
    #[must_use]
    pub fn parse(text: &str) -> Option<Self> {
        let is_digit = |c: u8| c.is_ascii_digit() || (b'a'..=b'f').contains(&c);
        if text.starts_with('0') || !text.bytes().all(is_digit) {
            return None;
        }
        let value = u128::from_str_radix(text, 16).ok()?;
        NonZeroU128::new(value).map(Self)
    }

    /// Returns the GUID prefix that stands for the session: [`VendorId::ZENOH`] and 20 of the id's
    /// 32 digits: the first ones, or the last ones if the first 12 are zero.
    #[must_use]
    pub fn guid_prefix(self) -> GuidPrefix {
        let bytes = self.0.get().to_be_bytes();
        let [a, b, c, d, e, f, ..] = bytes;
        let skipped = if [a, b, c, d, e, f] == [0; 6] { 6 } else { 0 };
        let mut prefix = [0; 12];
        let from = VendorId::ZENOH
            .0
            .into_iter()
            .chain(bytes.into_iter().skip(skipped));
        for (into, from) in prefix.iter_mut().zip(from) {
            *into = from;
        }
        GuidPrefix(prefix)
    }

    /// Reads an id of a known length.
    pub(super) fn read(reader: &mut Reader<'_>, length: usize) -> Result<Self, WireError> {
        let start = *reader;
        let bytes = reader.take("Zenoh id", length)?;
        Self::from_le_bytes(bytes).ok_or(start.error("Zenoh id", Reason::BadValue))
    }

    /// Reads an id. The upper four bits of `flags` are its length minus 1.
    pub(super) fn behind(flags: u8, reader: &mut Reader<'_>) -> Result<Self, WireError> {
        Self::read(reader, usize::from(flags >> 4) + 1)
    }
}

/// Formats as Zenoh does: hexadecimal, most significant digit first, no leading zeros.
impl fmt::Display for ZenohId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::LowerHex::fmt(&self.0, f)
    }
}

impl fmt::Debug for ZenohId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

/// An entity of a session.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
pub struct EntityGlobalId {
    /// The session.
    pub session: ZenohId,
    /// Number of the entity in the session.
    pub entity: u32,
}

impl EntityGlobalId {
    pub(super) fn read(reader: &mut Reader<'_>) -> Result<Self, WireError> {
        let flags = reader.u8("entity id")?;
        Ok(Self {
            session: ZenohId::behind(flags, reader)?,
            entity: reader.number("entity id")?,
        })
    }

    /// Reads an extension that contains nothing else.
    pub(super) fn extension(mut value: Reader<'_>) -> Result<Self, WireError> {
        let id = Self::read(&mut value)?;
        value.finish("entity id")?;
        Ok(id)
    }
}

/// Source of a sample as an AdvancedPublisher announces it (extension SourceInfo).
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub struct SourceInfo {
    /// The publisher.
    pub publisher: EntityGlobalId,
    /// Number of the sample, from 0.
    pub sequence_number: u32,
}

impl SourceInfo {
    pub(super) fn extension(mut value: Reader<'_>) -> Result<Self, WireError> {
        let info = Self {
            publisher: EntityGlobalId::read(&mut value)?,
            sequence_number: value.number("sequence number of SourceInfo")?,
        };
        value.finish("SourceInfo")?;
        Ok(info)
    }
}

/// Time of a hybrid logical clock with the clock's id.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct HlcTimestamp {
    /// Seconds and 2^-32 fractions since the Unix epoch, as RTPS has them. Zenoh keeps a counter in
    /// the lowest bits.
    pub time: RtpsTime,
    /// The clock: the session of the source.
    pub clock: ZenohId,
}

impl HlcTimestamp {
    /// Returns nanoseconds since the Unix epoch; `None` for zero.
    #[must_use]
    pub const fn timestamp(self) -> Option<Timestamp> {
        self.time.timestamp()
    }

    pub(super) fn read(reader: &mut Reader<'_>) -> Result<Self, WireError> {
        let time = RtpsTime(reader.z64("timestamp")?);
        let start = *reader;
        let bytes = reader.sized("clock of a timestamp", 16)?;
        let bad = start.error("clock of a timestamp", Reason::BadValue);
        Ok(Self {
            time,
            clock: ZenohId::from_le_bytes(bytes).ok_or(bad)?,
        })
    }

    /// Reads an extension that contains nothing else.
    pub(super) fn extension(mut value: Reader<'_>) -> Result<Self, WireError> {
        let timestamp = Self::read(&mut value)?;
        value.finish("timestamp")?;
        Ok(timestamp)
    }
}

#[cfg(test)]
mod tests {
    use std::string::ToString;

    use super::*;

    #[test]
    fn an_id_is_printed_and_parsed_without_leading_zeros() {
        let id = ZenohId::from_le_bytes(&[0x34, 0x12, 0x0a, 0x00]).unwrap();
        assert_eq!(id.to_string(), "a1234");
        assert_eq!(ZenohId::parse("a1234"), Some(id));
        for bad in ["", "0", "0a1234", "A1234", "+1", &"f".repeat(33)] {
            assert_eq!(ZenohId::parse(bad), None, "{bad}");
        }
        let prefix = |text| ZenohId::parse(text).unwrap().guid_prefix();
        let random = prefix("d10ca1632cc62c55cbbda90ef78373e8");
        assert_eq!(random.to_string(), "5a65d10ca1632cc62c55cbbd");
        assert_eq!(prefix("a1234").to_string(), "5a65000000000000000a1234");
        assert!(random.is_zenoh() && !GuidPrefix::UNKNOWN.is_zenoh());
        assert_eq!(ZenohId::from_le_bytes(&[]), None);
        assert_eq!(ZenohId::from_le_bytes(&[0; 16]), None);
        assert_eq!(ZenohId::from_le_bytes(&[1; 17]), None);
    }
}
