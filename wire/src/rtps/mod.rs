//! The elements of RTPS messages: vendors, versions, submessage kinds and flags, locators, inline
//! QoS (RTPS 2.5, 8.3 and 9.4).
//!
//! [`crate::walk`] reads messages with these types, and `rp discover` writes some. This module does
//! not read a whole message. The tests have a second, complete reader, `tests/oracle`, with which
//! the walk must agree.

mod flags;
mod inline_qos;
mod locator;
mod payload;
mod request_header;

use core::fmt;
use core::ops::{Add, AddAssign, Sub};

use crate::cursor::{Cursor, WireError};

pub use flags::SubmessageFlags;
pub use inline_qos::{InlineQos, SampleIdentity, StatusInfo};
pub use locator::{Locator, LocatorKind};
pub use payload::Payload;
pub use request_header::RequestHeader;

/// Vendor of an implementation (RTPS 2.5, 9.3.2; numbers assigned by the OMG).
#[derive(Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct VendorId(pub [u8; 2]);

impl VendorId {
    /// Not announced.
    pub const UNKNOWN: Self = Self([0x00, 0x00]);
    /// RTI Connext.
    pub const RTI_CONNEXT: Self = Self([0x01, 0x01]);
    /// eProsima Fast DDS.
    pub const EPROSIMA: Self = Self([0x01, 0x0f]);
    /// Eclipse Cyclone DDS.
    pub const CYCLONE: Self = Self([0x01, 0x10]);
    /// Atostek RustDDS.
    pub const RUSTDDS: Self = Self([0x01, 0x12]);
    /// Eclipse Zenoh, which is not DDS and has no number from the OMG: all numbers of the OMG begin
    /// with 1.
    pub const ZENOH: Self = Self(*b"Ze");

    /// Returns the product's name for people and for labels; `None` if the number is unknown.
    #[must_use]
    pub const fn name(self) -> Option<&'static str> {
        Some(match self.0 {
            [0x01, 0x01] => "RTI Connext",
            [0x01, 0x02] => "ADLINK OpenSplice",
            [0x01, 0x03] => "OCI OpenDDS",
            [0x01, 0x04] => "MilSoft",
            [0x01, 0x05] => "Kongsberg",
            [0x01, 0x06] => "TwinOaks CoreDX",
            [0x01, 0x0a] => "RTI Connext Micro",
            [0x01, 0x0f] => "eProsima Fast DDS",
            [0x01, 0x10] => "Eclipse Cyclone DDS",
            [0x01, 0x11] => "GurumDDS",
            [0x01, 0x12] => "Atostek RustDDS",
            [0x01, 0x14] => "S2E Dust DDS",
            [0x01, 0x15] => "SafeDDS",
            [0x01, 0x20] => "ADLINK Cloud",
            // Not assigned by the OMG.
            [0x01, 0xaa] => "HDDS",
            [b'Z', b'e'] => "Eclipse Zenoh",
            _ => return None,
        })
    }
}

/// Formats the product's name, or the two bytes in hex.
impl fmt::Display for VendorId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.name() {
            Some(name) => f.write_str(name),
            None => fmt::Debug::fmt(self, f),
        }
    }
}

impl fmt::Debug for VendorId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [first, second] = self.0;
        write!(f, "{first:02x}.{second:02x}")
    }
}

/// Protocol version; the minor version never decides whether a message is read.
#[derive(Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
pub struct ProtocolVersion {
    /// Major version; 2 in every current DDS implementation.
    pub major: u8,
    /// Minor version; Fast DDS writes 2 or 3, Cyclone DDS 1 or 5.
    pub minor: u8,
}

impl fmt::Display for ProtocolVersion {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}.{}", self.major, self.minor)
    }
}

/// Sequence number of a writer's change; the first is 1 (RTPS 2.5, 8.3.5.4).
///
/// RTPS signs the number. Its 64 bits are unsigned here, so that a negative number is larger than
/// every number that a change can have.
#[derive(Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
pub struct SequenceNumber(pub u64);

impl SequenceNumber {
    /// `SEQUENCENUMBER_UNKNOWN`: high −1, low 0.
    pub const UNKNOWN: Self = Self(u64::MAX << 32);
    /// The number before the first; no change has it.
    pub const ZERO: Self = Self(0);
    /// The number of a writer's first change.
    pub const FIRST: Self = Self(1);
    /// The largest number that a change can have.
    pub const MAX: Self = Self(u64::MAX >> 1);

    /// Returns whether a change can have the number.
    #[inline]
    #[must_use]
    pub const fn is_valid(self) -> bool {
        self.0 > Self::ZERO.0 && self.0 <= Self::MAX.0
    }

    /// Returns the number after this one; the 64 bits saturate.
    #[inline]
    #[must_use]
    pub const fn next(self) -> Self {
        self.saturating_add(1)
    }

    /// Returns the number before this one; zero stays zero.
    #[inline]
    #[must_use]
    pub const fn previous(self) -> Self {
        self.saturating_sub(1)
    }

    /// Returns whether `other` is the number after this one.
    #[inline]
    #[must_use]
    pub const fn precedes(self, other: Self) -> bool {
        self.0 < other.0 && other.0 - self.0 == 1
    }

    /// Returns the number `steps` after this one; the 64 bits saturate.
    #[inline]
    #[must_use]
    pub const fn saturating_add(self, steps: u64) -> Self {
        Self(self.0.saturating_add(steps))
    }

    /// Returns the number `steps` before this one, at least zero.
    #[inline]
    #[must_use]
    pub const fn saturating_sub(self, steps: u64) -> Self {
        Self(self.0.saturating_sub(steps))
    }

    /// Returns the number of steps from `other` to this number; 0 if `other` is higher.
    #[inline]
    #[must_use]
    pub const fn steps_since(self, other: Self) -> u64 {
        self.0.saturating_sub(other.0)
    }

    /// Returns the absolute difference between the numbers.
    #[inline]
    #[must_use]
    pub const fn distance(self, other: Self) -> u64 {
        self.0.abs_diff(other.0)
    }

    /// Iterates over the numbers in `self..end`.
    #[inline]
    pub fn until(self, end: Self) -> impl DoubleEndedIterator<Item = Self> {
        (self.0..end.0).map(Self)
    }

    /// Reads the high half, then the low half, each in the cursor's byte order.
    pub(crate) fn read(cursor: &mut Cursor<'_>, what: &'static str) -> Result<Self, WireError> {
        let high = cursor.u32(what)?;
        let low = cursor.u32(what)?;
        Ok(Self(u64::from(high) << 32 | u64::from(low)))
    }
}

impl Add<u64> for SequenceNumber {
    type Output = Self;

    #[inline]
    fn add(self, steps: u64) -> Self {
        Self(self.0 + steps)
    }
}

impl AddAssign<u64> for SequenceNumber {
    #[inline]
    fn add_assign(&mut self, steps: u64) {
        self.0 += steps;
    }
}

/// The number of steps from `lower`, which must not be higher.
impl Sub for SequenceNumber {
    type Output = u64;

    #[inline]
    fn sub(self, lower: Self) -> u64 {
        self.0 - lower.0
    }
}

impl fmt::Display for SequenceNumber {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(&self.0, f)
    }
}

/// Kind of a submessage (RTPS 2.5, 9.4.5.1.1); vendors define 80..ff.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct SubmessageId(pub u8);

impl SubmessageId {
    /// Header extension of RTPS 2.5; no known implementation sends it.
    pub const HEADER_EXTENSION: Self = Self(0x00);
    /// Padding.
    pub const PAD: Self = Self(0x01);
    /// A reader acknowledges samples and requests missing ones.
    pub const ACKNACK: Self = Self(0x06);
    /// A writer announces the samples that it has.
    pub const HEARTBEAT: Self = Self(0x07);
    /// A writer announces samples that it will not send.
    pub const GAP: Self = Self(0x08);
    /// Source timestamp of the changes that follow.
    pub const INFO_TS: Self = Self(0x09);
    /// Source of the following submessages.
    pub const INFO_SRC: Self = Self(0x0c);
    /// Reply locators, IPv4 only.
    pub const INFO_REPLY_IP4: Self = Self(0x0d);
    /// Destination of the following submessages.
    pub const INFO_DST: Self = Self(0x0e);
    /// Reply locators.
    pub const INFO_REPLY: Self = Self(0x0f);
    /// A reader requests missing fragments.
    pub const NACK_FRAG: Self = Self(0x12);
    /// A writer announces the fragments that it has.
    pub const HEARTBEAT_FRAG: Self = Self(0x13);
    /// One change.
    pub const DATA: Self = Self(0x15);
    /// Fragments of one change.
    pub const DATA_FRAG: Self = Self(0x16);
    /// Several changes of one writer, a submessage of RTI Connext that no specification has.
    pub const DATA_BATCH: Self = Self(0x18);
    /// Encrypted submessage.
    pub const SEC_BODY: Self = Self(0x30);
    /// Precedes a protected submessage.
    pub const SEC_PREFIX: Self = Self(0x31);
    /// Follows a protected submessage.
    pub const SEC_POSTFIX: Self = Self(0x32);
    /// Precedes a protected message.
    pub const SRTPS_PREFIX: Self = Self(0x33);
    /// Follows a protected message.
    pub const SRTPS_POSTFIX: Self = Self(0x34);

    /// Returns the name in the specification; `None` for an unknown kind.
    #[must_use]
    pub const fn name(self) -> Option<&'static str> {
        Some(match self {
            Self::HEADER_EXTENSION => "RTPS_HE",
            Self::PAD => "PAD",
            Self::ACKNACK => "ACKNACK",
            Self::HEARTBEAT => "HEARTBEAT",
            Self::GAP => "GAP",
            Self::INFO_TS => "INFO_TS",
            Self::INFO_SRC => "INFO_SRC",
            Self::INFO_REPLY_IP4 => "INFO_REPLY_IP4",
            Self::INFO_DST => "INFO_DST",
            Self::INFO_REPLY => "INFO_REPLY",
            Self::NACK_FRAG => "NACK_FRAG",
            Self::HEARTBEAT_FRAG => "HEARTBEAT_FRAG",
            Self::DATA => "DATA",
            Self::DATA_FRAG => "DATA_FRAG",
            Self::DATA_BATCH => "DATA_BATCH",
            Self::SEC_BODY => "SEC_BODY",
            Self::SEC_PREFIX => "SEC_PREFIX",
            Self::SEC_POSTFIX => "SEC_POSTFIX",
            Self::SRTPS_PREFIX => "SRTPS_PREFIX",
            Self::SRTPS_POSTFIX => "SRTPS_POSTFIX",
            _ => return None,
        })
    }
}

impl fmt::Debug for SubmessageId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.name() {
            Some(name) => f.write_str(name),
            None => write!(f, "{:#04x}", self.0),
        }
    }
}
