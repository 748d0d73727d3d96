//! The flags octet of a submessage header (RTPS 2.5, 9.4.5.1.2).

use crate::cursor::Endianness;

/// The flags of one submessage. The meaning of a bit depends on the submessage's kind, except for
/// E.
#[derive(Clone, Copy, Default, PartialEq, Eq, Hash, Debug)]
pub struct SubmessageFlags(pub u8);

impl SubmessageFlags {
    /// E, in every kind: the submessage is little-endian.
    pub const ENDIANNESS: Self = Self(0x01);
    /// Q of DATA and DATA_FRAG (RTPS 2.5, 9.4.5.4 and 9.4.5.5): inline QoS precede the payload.
    pub const INLINE_QOS: Self = Self(0x02);
    /// D of DATA (RTPS 2.5, 9.4.5.4): the payload is a value.
    pub const DATA: Self = Self(0x04);
    /// K of DATA (RTPS 2.5, 9.4.5.4): the payload is a key.
    pub const KEY: Self = Self(0x08);
    /// K of DATA_FRAG, where DATA has D (RTPS 2.5, 9.4.5.5): the assembled payload is a key.
    pub const FRAGMENT_KEY: Self = Self(0x04);
    /// F of ACKNACK and HEARTBEAT (RTPS 2.5, 9.4.5.3 and 9.4.5.7): no answer is required.
    pub const FINAL: Self = Self(0x02);
    /// L of HEARTBEAT (RTPS 2.5, 9.4.5.7): it asserts the writer's liveliness.
    pub const LIVELINESS: Self = Self(0x04);
    /// I of INFO_TS (RTPS 2.5, 9.4.5.12): no timestamp follows, and none remains in force.
    pub const INVALIDATE: Self = Self(0x02);
    /// M of INFO_REPLY and INFO_REPLY_IP4 (RTPS 2.5, 9.4.5.10 and 9.4.5.15): multicast locators
    /// follow.
    pub const MULTICAST: Self = Self(0x02);

    /// Returns whether all bits of `flags` are set.
    #[inline(always)]
    #[must_use]
    pub const fn contains(self, flags: Self) -> bool {
        self.0 & flags.0 == flags.0
    }

    /// Returns the union of these flags and `other`.
    #[must_use]
    pub const fn with(self, other: Self) -> Self {
        Self(self.0 | other.0)
    }

    /// Returns the byte order of the submessage's fields.
    #[must_use]
    pub const fn endianness(self) -> Endianness {
        if self.contains(Self::ENDIANNESS) {
            Endianness::Little
        } else {
            Endianness::Big
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_lowest_bit_selects_the_byte_order() {
        assert_eq!(SubmessageFlags(0xfe).endianness(), Endianness::Big);
        assert_eq!(SubmessageFlags(0x01).endianness(), Endianness::Little);
    }

    #[test]
    fn flags_contain_others_only_if_all_their_bits_are_set() {
        let (data, key) = (SubmessageFlags::DATA, SubmessageFlags::KEY);
        assert!(data.with(key).contains(data) && data.with(key).contains(data.with(key)));
        assert!(!data.contains(data.with(key)) && !data.contains(key));
    }
}
