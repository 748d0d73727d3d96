//! RTPS messages: the header, every submessage, and the receiver state that gives them meaning.
//!
//! RTPS 2.5, 8.3 and 9.4. Parsing borrows the datagram and keeps nothing. Unknown submessages are
//! stepped over by their length; a malformed one ends the message (8.3.4.1), what came before it
//! stands. Nothing here decides what is worth keeping: that is `walk`'s and the model's matter.

mod flags;
mod inline_qos;
mod locator;
mod sets;
mod submessage;

use core::fmt;

use crate::cursor::{Cursor, Endianness, Reason, WireError};
use crate::guid::GuidPrefix;
use crate::time::RtpsTime;

pub use flags::SubmessageFlags;
pub use inline_qos::{InlineQos, SampleIdentity, StatusInfo};
pub use locator::{Locator, LocatorKind, LocatorList};
pub use sets::{FragmentNumberSet, SequenceNumberSet};
pub use submessage::{
    AckNack, Body, Data, DataFrag, Gap, Heartbeat, HeartbeatFrag, InfoReply, NackFrag, Payload,
};

/// Who made the implementation (RTPS 2.5, 9.3.2; numbers assigned by the OMG).
#[derive(Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct VendorId(pub [u8; 2]);

impl VendorId {
    /// Not said.
    pub const UNKNOWN: Self = Self([0x00, 0x00]);
    /// RTI Connext.
    pub const RTI_CONNEXT: Self = Self([0x01, 0x01]);
    /// eProsima Fast DDS.
    pub const EPROSIMA: Self = Self([0x01, 0x0f]);
    /// Eclipse Cyclone DDS.
    pub const CYCLONE: Self = Self([0x01, 0x10]);
    /// Atostek RustDDS.
    pub const RUSTDDS: Self = Self([0x01, 0x12]);

    /// Name of the product, for people and for labels; `None` when the number is not known here.
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
            [0x01, 0x15] => "SafeDDS",
            [0x01, 0x20] => "ADLINK Cloud",
            _ => return None,
        })
    }
}

/// The product's name, or the two bytes in hex.
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

/// Protocol version; the minor one never decides whether a message is read.
#[derive(Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
pub struct ProtocolVersion {
    /// 2 for everything DDS speaks today.
    pub major: u8,
    /// Fast DDS writes 2 or 3, Cyclone DDS 1 or 5.
    pub minor: u8,
}

impl fmt::Display for ProtocolVersion {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}.{}", self.major, self.minor)
    }
}

/// Number of a change of one writer; the first is 1 (RTPS 2.5, 8.3.5.4).
#[derive(Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
pub struct SequenceNumber(pub i64);

impl SequenceNumber {
    /// `SEQUENCENUMBER_UNKNOWN`: high −1, low 0.
    pub const UNKNOWN: Self = Self(-(1 << 32));

    /// `i32` high, then `u32` low, each in the cursor's byte order.
    pub(crate) fn read(cursor: &mut Cursor<'_>, what: &'static str) -> Result<Self, WireError> {
        let high = cursor.i32(what)?;
        let low = cursor.u32(what)?;
        Ok(Self(i64::from(high) << 32 | i64::from(low)))
    }

    /// [`Self::read`] where the specification allows only numbers from `least` on.
    pub(crate) fn read_from(
        cursor: &mut Cursor<'_>,
        what: &'static str,
        least: i64,
    ) -> Result<Self, WireError> {
        let error = cursor.error(what, Reason::BadValue);
        let number = Self::read(cursor, what)?;
        if number.0 < least {
            Err(error)
        } else {
            Ok(number)
        }
    }
}

impl fmt::Display for SequenceNumber {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(&self.0, f)
    }
}

/// The 20 bytes every RTPS message begins with (RTPS 2.5, 9.4.4).
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Header {
    /// The sender's protocol version.
    pub version: ProtocolVersion,
    /// The sender's implementation.
    pub vendor: VendorId,
    /// The sending participant; not necessarily the origin of what it sends.
    pub prefix: GuidPrefix,
}

impl Header {
    /// Length on the wire.
    pub const LEN: usize = 20;

    /// From the first bytes of a datagram.
    ///
    /// # Errors
    /// [`Reason::Truncated`]; [`Reason::BadMarker`] when it does not begin with `RTPS` or has
    /// another major version than 2.
    pub fn parse(bytes: &[u8]) -> Result<Self, WireError> {
        Self::read(&mut Cursor::new(bytes, Endianness::Big))
    }

    fn read(cursor: &mut Cursor<'_>) -> Result<Self, WireError> {
        let error = cursor.error("RTPS magic", Reason::BadMarker);
        if cursor.array::<4>("RTPS magic")? != *b"RTPS" {
            return Err(error);
        }
        let error = cursor.error("protocol version", Reason::BadMarker);
        let [major, minor] = cursor.array("protocol version")?;
        if major != 2 {
            return Err(error);
        }
        Ok(Self {
            version: ProtocolVersion { major, minor },
            vendor: VendorId(cursor.array("vendor id")?),
            prefix: GuidPrefix(cursor.array("guid prefix")?),
        })
    }
}

/// Kind of a submessage (RTPS 2.5, 9.4.5.1.1); 80..ff are the vendors'.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct SubmessageId(pub u8);

impl SubmessageId {
    /// Header extension of RTPS 2.5; nobody is known to send it.
    pub const HEADER_EXTENSION: Self = Self(0x00);
    /// Filler.
    pub const PAD: Self = Self(0x01);
    /// Reader acknowledges and asks again.
    pub const ACKNACK: Self = Self(0x06);
    /// Writer says what it has.
    pub const HEARTBEAT: Self = Self(0x07);
    /// Writer says what will never come.
    pub const GAP: Self = Self(0x08);
    /// Time of the changes that follow.
    pub const INFO_TS: Self = Self(0x09);
    /// Whose the following submessages are.
    pub const INFO_SRC: Self = Self(0x0c);
    /// Where to answer, IPv4 only.
    pub const INFO_REPLY_IP4: Self = Self(0x0d);
    /// For whom the following submessages are.
    pub const INFO_DST: Self = Self(0x0e);
    /// Where to answer.
    pub const INFO_REPLY: Self = Self(0x0f);
    /// Reader asks for fragments.
    pub const NACK_FRAG: Self = Self(0x12);
    /// Writer says which fragments it has.
    pub const HEARTBEAT_FRAG: Self = Self(0x13);
    /// One change.
    pub const DATA: Self = Self(0x15);
    /// Fragments of one change.
    pub const DATA_FRAG: Self = Self(0x16);
    /// Encrypted submessage.
    pub const SEC_BODY: Self = Self(0x30);
    /// Before a protected submessage.
    pub const SEC_PREFIX: Self = Self(0x31);
    /// After a protected submessage.
    pub const SEC_POSTFIX: Self = Self(0x32);
    /// Before a protected message.
    pub const SRTPS_PREFIX: Self = Self(0x33);
    /// After a protected message.
    pub const SRTPS_POSTFIX: Self = Self(0x34);

    /// Name from the specification; `None` for an unknown one.
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

/// What a receiver knows while it reads a message (RTPS 2.5, 8.3.4): whose, for whom, when.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Receiver {
    /// Whose the submessages are: the header's prefix until an INFO_SRC.
    pub source: GuidPrefix,
    /// The source's protocol version.
    pub version: ProtocolVersion,
    /// The source's implementation.
    pub vendor: VendorId,
    /// For whom they are; [`GuidPrefix::UNKNOWN`] is any participant that receives them.
    pub destination: GuidPrefix,
    /// INFO_TS in force; zero when none is.
    pub timestamp: RtpsTime,
}

/// One submessage with the receiver state it is to be read under.
#[derive(Clone, Copy, Debug)]
pub struct Submessage<'a> {
    /// State after this submessage when it is an INFO_*, otherwise the state it stands under.
    pub receiver: Receiver,
    /// Its kind.
    pub id: SubmessageId,
    /// The flags octet.
    pub flags: SubmessageFlags,
    /// Where its header begins in the message.
    pub offset: usize,
    /// Its content.
    pub body: Body<'a>,
}

/// One RTPS message; iterates over its submessages and ends after the first malformed one.
#[derive(Clone, Debug)]
pub struct Message<'a> {
    header: Header,
    receiver: Receiver,
    rest: Cursor<'a>,
}

impl<'a> Message<'a> {
    /// Over a whole datagram.
    ///
    /// # Errors
    /// Those of [`Header::parse`].
    pub fn parse(datagram: &'a [u8]) -> Result<Self, WireError> {
        let mut rest = Cursor::new(datagram, Endianness::Big);
        let header = Header::read(&mut rest)?;
        let receiver = Receiver {
            source: header.prefix,
            version: header.version,
            vendor: header.vendor,
            destination: GuidPrefix::UNKNOWN,
            timestamp: RtpsTime::default(),
        };
        Ok(Self {
            header,
            receiver,
            rest,
        })
    }

    /// The message's header.
    #[must_use]
    pub const fn header(&self) -> Header {
        self.header
    }

    fn submessage(&mut self) -> Result<Submessage<'a>, WireError> {
        let offset = self.rest.offset();
        let id = SubmessageId(self.rest.u8("submessage id")?);
        let flags = SubmessageFlags(self.rest.u8("submessage flags")?);
        let endianness = flags.endianness();
        let length: [u8; 2] = self.rest.array("octetsToNextHeader")?;
        let length = match endianness {
            Endianness::Big => u16::from_be_bytes(length),
            Endianness::Little => u16::from_le_bytes(length),
        };
        // RTPS 2.5, 9.4.5.1.3: zero reaches to the end of the message, except where an empty body
        // is a body. Fast DDS writes zero for submessages that do not fit the field.
        let to_the_end = length == 0 && !matches!(id, SubmessageId::PAD | SubmessageId::INFO_TS);
        let length = if to_the_end {
            self.rest.remaining()
        } else {
            usize::from(length)
        };
        let body = self
            .rest
            .sub("submessage body", length)?
            .with_endianness(endianness);
        let body = submessage::read(id, flags, body, &mut self.receiver)?;
        Ok(Submessage {
            receiver: self.receiver,
            id,
            flags,
            offset,
            body,
        })
    }
}

impl<'a> Iterator for Message<'a> {
    type Item = Result<Submessage<'a>, WireError>;

    fn next(&mut self) -> Option<Self::Item> {
        // A tail shorter than a submessage header is padding.
        if self.rest.remaining() < 4 {
            return None;
        }
        let result = self.submessage();
        if result.is_err() {
            // Nothing after a malformed submessage can be trusted to be where it seems to be.
            self.rest = Cursor::new(&[], Endianness::Big);
        }
        Some(result)
    }
}

#[cfg(test)]
mod tests;
