//! Identities on the wire: GUIDs of participants and endpoints.
//!
//! RTPS 2.5, 9.3.1: a GUID is a 12-byte participant prefix and a 4-byte entity id, both in wire
//! order regardless of the submessage's endianness.

use core::fmt;

use zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout, Unaligned};

use crate::rtps::VendorId;

/// The 12 bytes that all entities of one participant share.
#[derive(
    Clone,
    Copy,
    Default,
    PartialEq,
    Eq,
    PartialOrd,
    Ord,
    Hash,
    FromBytes,
    IntoBytes,
    Immutable,
    KnownLayout,
    Unaligned,
)]
#[repr(transparent)]
pub struct GuidPrefix(pub [u8; 12]);

impl GuidPrefix {
    /// All zero: "any participant" in INFO_DST (RTPS 2.5, 8.3.8.7).
    pub const UNKNOWN: Self = Self([0; 12]);

    /// Returns the vendor in the first two bytes (RTPS 2.5, 9.3.1.5).
    #[must_use]
    pub const fn vendor(self) -> VendorId {
        let [first, second, ..] = self.0;
        VendorId([first, second])
    }

    /// Returns whether the prefix stands for a Zenoh session rather than a DDS participant.
    #[must_use]
    pub const fn is_zenoh(self) -> bool {
        let ([first, second], [z, e]) = (self.vendor().0, VendorId::ZENOH.0);
        first == z && second == e
    }
}

/// Id of an entity within its participant; the last byte is the entity's kind.
#[derive(
    Clone,
    Copy,
    Default,
    PartialEq,
    Eq,
    PartialOrd,
    Ord,
    Hash,
    FromBytes,
    IntoBytes,
    Immutable,
    KnownLayout,
    Unaligned,
)]
#[repr(transparent)]
pub struct EntityId(pub [u8; 4]);

impl EntityId {
    /// No entity, or every matched reader.
    pub const UNKNOWN: Self = Self([0; 4]);
    /// The participant itself.
    pub const PARTICIPANT: Self = Self([0x00, 0x00, 0x01, 0xc1]);
    /// Writer of SPDP participant announcements.
    pub const SPDP_WRITER: Self = Self([0x00, 0x01, 0x00, 0xc2]);
    /// Writer of SEDP publication announcements.
    pub const SEDP_PUBLICATIONS_WRITER: Self = Self([0x00, 0x00, 0x03, 0xc2]);
    /// Writer of SEDP subscription announcements.
    pub const SEDP_SUBSCRIPTIONS_WRITER: Self = Self([0x00, 0x00, 0x04, 0xc2]);
    /// Writer of participant messages (liveliness).
    pub const PARTICIPANT_MESSAGE_WRITER: Self = Self([0x00, 0x02, 0x00, 0xc2]);
    /// Writer of replies of the TypeLookup service (DDS-XTypes 1.3, 7.6.3.3.3).
    pub const TYPE_LOOKUP_REPLY_WRITER: Self = Self([0x00, 0x03, 0x01, 0xc3]);
    /// Secure variant of [`Self::SPDP_WRITER`].
    pub const SPDP_SECURE_WRITER: Self = Self([0xff, 0x01, 0x01, 0xc2]);
    /// Secure variant of [`Self::SEDP_PUBLICATIONS_WRITER`].
    pub const SEDP_PUBLICATIONS_SECURE_WRITER: Self = Self([0xff, 0x00, 0x03, 0xc2]);
    /// Secure variant of [`Self::SEDP_SUBSCRIPTIONS_WRITER`].
    pub const SEDP_SUBSCRIPTIONS_SECURE_WRITER: Self = Self([0xff, 0x00, 0x04, 0xc2]);

    /// Returns whether the entity is builtin (discovery, liveliness, security) or vendor-specific,
    /// not user-defined.
    #[must_use]
    pub const fn is_builtin(self) -> bool {
        self.0[3] & 0xc0 != 0
    }

    /// Returns whether the entity is a writer, with or without key: user-defined, builtin or
    /// vendor-specific.
    #[must_use]
    pub const fn is_writer(self) -> bool {
        matches!(self.0[3] & 0x3f, 0x02 | 0x03)
    }

    /// Returns whether the entity is a reader, with or without key: user-defined, builtin or
    /// vendor-specific.
    #[must_use]
    pub const fn is_reader(self) -> bool {
        matches!(self.0[3] & 0x3f, 0x04 | 0x07)
    }
}

/// Identity of a participant or endpoint; ROS calls it GID.
#[derive(
    Clone,
    Copy,
    Default,
    PartialEq,
    Eq,
    PartialOrd,
    Ord,
    Hash,
    FromBytes,
    IntoBytes,
    Immutable,
    KnownLayout,
    Unaligned,
)]
#[repr(C)]
pub struct Guid {
    /// The participant's prefix.
    pub prefix: GuidPrefix,
    /// The entity within the participant.
    pub entity: EntityId,
}

impl Guid {
    /// Combines a prefix and an entity id.
    #[must_use]
    pub const fn new(prefix: GuidPrefix, entity: EntityId) -> Self {
        Self { prefix, entity }
    }

    /// Converts from 16 bytes in wire order, as in a parameter or a key hash.
    #[must_use]
    pub fn from_bytes(bytes: [u8; 16]) -> Self {
        zerocopy::transmute!(bytes)
    }

    /// Parses 32 hexadecimal digits in wire order.
    #[must_use]
    pub fn of_digits(digits: &str) -> Option<Self> {
        let is_guid = digits.len() == 32 && !digits.starts_with('+');
        let value = u128::from_str_radix(digits, 16).ok().filter(|_| is_guid)?;
        Some(Self::from_bytes(value.to_be_bytes()))
    }

    /// Returns the 16 bytes in wire order.
    #[must_use]
    pub fn to_bytes(self) -> [u8; 16] {
        zerocopy::transmute!(self)
    }
}

impl fmt::Display for GuidPrefix {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.iter().try_for_each(|byte| write!(f, "{byte:02x}"))
    }
}

impl fmt::Display for EntityId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.iter().try_for_each(|byte| write!(f, "{byte:02x}"))
    }
}

/// Formats prefix and entity id in hex, joined by a dot.
impl fmt::Display for Guid {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}.{}", self.prefix, self.entity)
    }
}

impl fmt::Debug for GuidPrefix {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

impl fmt::Debug for EntityId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

impl fmt::Debug for Guid {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}
