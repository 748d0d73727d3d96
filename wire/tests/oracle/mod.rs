//! A complete reader of RTPS messages (RTPS 2.5, 8.3 and 9.4): the oracle of the differential
//! tests.
//!
//! No production code uses it. The walk reads the parts of a message that the product needs, in the
//! style of the kernel. The oracle reads every field of every submessage, in the style of the
//! specification, and rejects numbers that the specification does not allow. The fuzz targets and
//! the tests over captures compare the walk with the oracle, and the oracle with an independent
//! decoder. Therefore the oracle must not use the walk.
//!
//! Parsing borrows the datagram. Unknown submessages are skipped by their length. A malformed one
//! ends the message (8.3.4.1); the submessages before it remain valid.

#![allow(dead_code, reason = "each of those that include it uses a part")]

pub mod sets;
pub mod submessage;

use ros2probe_wire::rtps::{ProtocolVersion, SubmessageFlags, SubmessageId, VendorId};
use ros2probe_wire::{Cursor, Endianness, GuidPrefix, Reason, RtpsTime, WireError};

pub use submessage::Body;

/// The first 20 bytes of every RTPS message (RTPS 2.5, 9.4.4).
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Header {
    /// The sender's protocol version.
    pub version: ProtocolVersion,
    /// The sender's implementation.
    pub vendor: VendorId,
    /// The sending participant; not necessarily the origin of the message.
    pub prefix: GuidPrefix,
}

impl Header {
    /// Length on the wire, in bytes.
    pub const LEN: usize = 20;

    /// Parses the first bytes of a datagram.
    ///
    /// # Errors
    /// Returns [`Reason::Truncated`] if bytes are missing. Returns [`Reason::BadMarker`] if the
    /// bytes do not begin with `RTPS` or the major version is not 2.
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

/// State of a receiver while it reads a message (RTPS 2.5, 8.3.4).
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Receiver {
    /// Source of the submessages: the header's prefix until an INFO_SRC.
    pub source: GuidPrefix,
    /// The source's protocol version.
    pub version: ProtocolVersion,
    /// The source's implementation.
    pub vendor: VendorId,
    /// Destination of the submessages; [`GuidPrefix::UNKNOWN`] is any participant that receives
    /// them.
    pub destination: GuidPrefix,
    /// INFO_TS in force; zero if no timestamp is in force.
    pub timestamp: RtpsTime,
}

/// One submessage with the receiver state that applies to it.
#[derive(Clone, Copy, Debug)]
pub struct Submessage<'a> {
    /// State after this submessage if it is an INFO_*, otherwise the state that applies to it.
    pub receiver: Receiver,
    /// Kind of the submessage.
    pub id: SubmessageId,
    /// The flags octet.
    pub flags: SubmessageFlags,
    /// Offset of its header in the message.
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
    /// Parses the header of a whole datagram.
    ///
    /// # Errors
    /// Fails as [`Header::parse`] does.
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

    /// Returns the message's header.
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
        // RTPS 2.5, 9.4.5.1.3: zero reaches to the end of the message, except for kinds whose body
        // may be empty. Fast DDS writes zero if the length does not fit the field.
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
            // Offsets after a malformed submessage cannot be trusted.
            self.rest = Cursor::new(&[], Endianness::Big);
        }
        Some(result)
    }
}
