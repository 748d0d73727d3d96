//! Encodes RTPS messages in little-endian byte order (RTPS 2.5, 8.3 and 9.4).
//!
//! The product makes few messages: those that `rp discover` sends, and those as which it replays a
//! bag. Both have the vendor id [`VENDOR`].

use alloc::vec::Vec;

use crate::guid::{EntityId, GuidPrefix};
use crate::parameters::ParameterId;
use crate::rtps::{SubmessageFlags, SubmessageId, VendorId};
use crate::time::{RtpsDuration, RtpsTime};
use crate::{SequenceNumber, Timestamp};

/// Vendor id, believed to be unassigned. Fast DDS and Cyclone DDS treat it as foreign and use no
/// extensions.
pub const VENDOR: VendorId = VendorId([0x01, 0x7f]);
/// Encapsulation header of a parameter list (RTPS 2.5, 10.2).
pub const PL_CDR_LE: [u8; 4] = [0x00, 0x03, 0x00, 0x00];
/// Encapsulation header of plain CDR.
pub const CDR_LE: [u8; 4] = [0x00, 0x01, 0x00, 0x00];

/// No flags but E, which each submessage has.
pub const NO_FLAGS: SubmessageFlags = SubmessageFlags(0);

/// A message under construction.
#[derive(Debug)]
pub struct Message(Vec<u8>);

impl Message {
    /// Begins a message of this participant, of protocol version 2.3.
    #[must_use]
    pub fn new(prefix: GuidPrefix) -> Self {
        Self::in_memory(Vec::new(), prefix)
    }

    /// Does the same as [`Self::new`], in the memory of `bytes`, whose content is dropped.
    #[must_use]
    pub fn in_memory(mut bytes: Vec<u8>, prefix: GuidPrefix) -> Self {
        bytes.clear();
        bytes.extend_from_slice(b"RTPS\x02\x03");
        bytes.extend_from_slice(&VENDOR.0);
        bytes.extend_from_slice(&prefix.0);
        Self(bytes)
    }

    /// Adds a submessage with this body. A body beyond 65,535 bytes has the length 0, which means
    /// "to the end of the message": it can only be the last one (RTPS 2.5, 9.4.5.1.3).
    #[must_use]
    pub fn submessage(mut self, id: SubmessageId, flags: SubmessageFlags, body: &[&[u8]]) -> Self {
        let length = body.iter().map(|part| part.len()).sum::<usize>();
        let length = u16::try_from(length).unwrap_or(0);
        let flags = flags.with(SubmessageFlags::ENDIANNESS);
        self.0.extend_from_slice(&[id.0, flags.0]);
        self.0.extend_from_slice(&length.to_le_bytes());
        for part in body {
            self.0.extend_from_slice(part);
        }
        self
    }

    /// Adds INFO_TS: the time at which the writer wrote the following samples.
    #[must_use]
    pub fn timestamp(self, written: Timestamp) -> Self {
        let time = RtpsTime::of(written).0.rotate_left(32).to_le_bytes();
        self.submessage(SubmessageId::INFO_TS, NO_FLAGS, &[&time])
    }

    /// Adds a DATA submessage with a payload, which begins with its encapsulation header.
    #[must_use]
    pub fn data(
        self,
        (reader, writer): (EntityId, EntityId),
        number: SequenceNumber,
        payload: &[&[u8]],
    ) -> Self {
        let head = data_head(reader, writer, number);
        let mut body = Vec::with_capacity(1 + payload.len());
        body.push(&head[..]);
        body.extend_from_slice(payload);
        self.submessage(SubmessageId::DATA, SubmessageFlags::DATA, &body)
    }

    /// Returns the bytes of the message.
    #[must_use]
    pub fn bytes(self) -> Vec<u8> {
        self.0
    }
}

/// Returns the fixed first part of a DATA submessage (RTPS 2.5, 9.4.5.4).
#[must_use]
pub fn data_head(reader: EntityId, writer: EntityId, number: SequenceNumber) -> Vec<u8> {
    // extraFlags, octetsToInlineQos.
    let fixed = [0, 0, 16, 0];
    [&fixed[..], &reader.0, &writer.0, &sequence_number(number)].concat()
}

/// Encodes a sequence number: high word, low word (RTPS 2.5, 9.3.2.5).
#[must_use]
pub const fn sequence_number(number: SequenceNumber) -> [u8; 8] {
    number.0.rotate_left(32).to_le_bytes()
}

/// Encodes a duration (RTPS 2.5, 9.3.2.3).
#[must_use]
pub fn duration(duration: RtpsDuration) -> [u8; 8] {
    const INFINITE: u64 = 0x7fff_ffff << 32 | 0xffff_ffff;
    let wire = match duration.finite() {
        Some(finite) => RtpsTime::of(Timestamp(crate::time::nanoseconds(finite))).0,
        None => INFINITE,
    };
    wire.min(INFINITE).rotate_left(32).to_le_bytes()
}

/// Encodes a CDR string, without padding.
#[must_use]
pub fn text(text: &[u8]) -> Vec<u8> {
    let length = u32::try_from(text.len() + 1).unwrap_or(0);
    [&length.to_le_bytes()[..], text, &[0]].concat()
}

/// Encodes a CDR sequence of octets, without padding.
#[must_use]
pub fn octets(octets: &[u8]) -> Vec<u8> {
    let length = u32::try_from(octets.len()).unwrap_or(0);
    [&length.to_le_bytes()[..], octets].concat()
}

/// A parameter list under construction (RTPS 2.5, 9.4.2.11).
#[derive(Debug, Default)]
pub struct Parameters(Vec<u8>);

impl Parameters {
    /// Adds a parameter, and pads its value to four bytes.
    #[must_use]
    pub fn add(mut self, id: ParameterId, value: &[u8]) -> Self {
        let padded = value.len().next_multiple_of(4);
        let length = u16::try_from(padded).unwrap_or(0);
        self.0.extend_from_slice(&id.0.to_le_bytes());
        self.0.extend_from_slice(&length.to_le_bytes());
        self.0.extend_from_slice(value);
        self.0.resize(self.0.len() + padded - value.len(), 0);
        self
    }

    /// Ends the list, and returns its bytes.
    #[must_use]
    pub fn end(self) -> Vec<u8> {
        self.add(ParameterId::SENTINEL, &[]).0
    }
}

#[cfg(test)]
mod tests {
    use core::time::Duration;
    use std::vec;

    use super::*;
    use crate::walk::{self, Envelope, Outcome};

    const PREFIX: GuidPrefix = GuidPrefix([7; 12]);
    const WRITER: EntityId = EntityId([0, 0, 1, 0x03]);

    #[test]
    fn a_sample_of_any_size_is_walked_with_its_number_and_its_time() {
        for length in [0, 4, 65_515, 65_516, 3_000_000] {
            let payload = vec![5; length];
            let written = Timestamp(1_700_000_000_123_456_789);
            let bytes = Message::new(PREFIX)
                .timestamp(written)
                .data(
                    (EntityId::UNKNOWN, WRITER),
                    SequenceNumber(1 << 40),
                    &[&CDR_LE, &payload],
                )
                .bytes();
            let mut found = vec![];
            let outcome = walk::datagram(&bytes, &Envelope::default(), None, |it| found.push(it));
            assert_eq!((outcome, found.len()), (Outcome::Complete, 1));
            let record = found[0].record;
            assert_eq!(record.sequence_number, 1 << 40);
            assert_eq!(found[0].payload.len(), length + 4);
            assert_eq!(record.source_timestamp().timestamp(), Some(written));
        }
    }

    #[test]
    fn an_encoded_duration_is_read_again() {
        for each in [
            RtpsDuration::Infinite,
            RtpsDuration::Finite(Duration::ZERO),
            RtpsDuration::Finite(Duration::from_millis(1_500)),
        ] {
            let bytes = duration(each);
            let seconds = i32::from_le_bytes(bytes[..4].try_into().unwrap());
            let fraction = u32::from_le_bytes(bytes[4..].try_into().unwrap());
            assert_eq!(RtpsDuration::from_wire(seconds, fraction), each);
        }
    }
}
