//! Captured datagrams, an encoder, and damaged bytes, which the tests of the parsers share.

use std::string::ToString;
use std::vec::Vec;

use crate::cursor::Endianness;
use crate::rtps::{InlineQos, VendorId};
use oracle::submessage::Data;
use oracle::{Body, Message};

#[path = "../tests/oracle/mod.rs"]
pub(crate) mod oracle;
mod oracle_tests;

macro_rules! captured {
    ($($name:ident = $file:literal;)+) => {
        $(pub(crate) const $name: &[u8] =
            include_bytes!(concat!("../tests/data/datagrams/", $file, ".bin"));)+
        /// Every captured datagram.
        pub(crate) const CAPTURED: &[&[u8]] = &[$($name),+];
    };
}

captured! {
    CYCLONE_SPDP = "cyclone-spdp";
    CYCLONE_SPDP_DISPOSE = "cyclone-spdp-dispose";
    CYCLONE_SEDP = "cyclone-sedp";
    CYCLONE_SEDP_READERS = "cyclone-sedp-readers";
    CYCLONE_SEDP_DISPOSE = "cyclone-sedp-dispose";
    CYCLONE_ENTITIES = "cyclone-entities";
    CYCLONE_DATA_FRAG = "cyclone-data-frag";
    FAST_SPDP = "fast-spdp";
    FAST_SPDP_DISPOSE = "fast-spdp-dispose";
    FAST_SEDP_WRITER = "fast-sedp-writer";
    FAST_SEDP_READER = "fast-sedp-reader";
    FAST_SEDP_DISPOSE = "fast-sedp-dispose";
    FAST_ENTITIES = "fast-entities";
    FAST_GAP = "fast-gap";
    FAST_NACK_FRAG = "fast-nack-frag";
    RUSTDDS_SPDP = "rustdds-spdp";
    RUSTDDS_SPDP_DISPOSE = "rustdds-spdp-dispose";
    RUSTDDS_SEDP = "rustdds-sedp";
    RUSTDDS_SEDP_DISPOSE = "rustdds-sedp-dispose";
    RUSTDDS_ENTITIES = "rustdds-entities";
    JAZZY_SPDP = "jazzy-spdp";
    JAZZY_ACKNACK = "jazzy-acknack";
    JAZZY_SEDP = "jazzy-sedp";
    JAZZY_ENTITIES = "jazzy-entities";
}

/// Returns the DATA submessages of a datagram.
pub(crate) fn data(datagram: &[u8]) -> Vec<(VendorId, InlineQos, Data<'_>)> {
    Message::parse(datagram)
        .unwrap()
        .filter_map(|submessage| {
            let submessage = submessage.unwrap();
            let Body::Data(data) = submessage.body else {
                return None;
            };
            let vendor = submessage.receiver.vendor;
            let inline_qos = data
                .inline_qos
                .map(|list| InlineQos::parse(list, vendor).unwrap());
            Some((vendor, inline_qos.unwrap_or_default(), data))
        })
        .collect()
}

/// Calls `read` with every prefix of `bytes` and with every byte changed in several ways.
pub(crate) fn hurt(bytes: &[u8], mut read: impl FnMut(&[u8])) {
    for length in 0..bytes.len() {
        read(&bytes[..length]);
    }
    let mut changed = bytes.to_vec();
    for position in 0..bytes.len() {
        for byte in [
            0x00,
            0x01,
            0x7f,
            0x80,
            0xff,
            bytes[position] ^ 1,
            bytes[position] ^ 0x80,
        ] {
            changed[position] = byte;
            read(&changed);
        }
        changed[position] = bytes[position];
    }
}

/// Encodes the formats that the parsers read. Alignment counts from the first byte written.
#[derive(Clone)]
pub(crate) struct Encoder {
    pub(crate) bytes: Vec<u8>,
    pub(crate) endianness: Endianness,
}

impl Encoder {
    pub(crate) const fn new(endianness: Endianness) -> Self {
        Self {
            bytes: Vec::new(),
            endianness,
        }
    }

    pub(crate) fn raw(&mut self, bytes: &[u8]) -> &mut Self {
        self.bytes.extend_from_slice(bytes);
        self
    }

    pub(crate) fn align(&mut self) -> &mut Self {
        self.bytes.resize(self.bytes.len().next_multiple_of(4), 0);
        self
    }

    pub(crate) fn u16(&mut self, value: u16) -> &mut Self {
        match self.endianness {
            Endianness::Big => self.raw(&value.to_be_bytes()),
            Endianness::Little => self.raw(&value.to_le_bytes()),
        }
    }

    pub(crate) fn u32(&mut self, value: u32) -> &mut Self {
        self.align();
        match self.endianness {
            Endianness::Big => self.raw(&value.to_be_bytes()),
            Endianness::Little => self.raw(&value.to_le_bytes()),
        }
    }

    /// Writes eight bytes with this alignment.
    pub(crate) fn wide(&mut self, value: u64, alignment: usize) -> &mut Self {
        let length = self.bytes.len().next_multiple_of(alignment);
        self.bytes.resize(length, 0);
        match self.endianness {
            Endianness::Big => self.raw(&value.to_be_bytes()),
            Endianness::Little => self.raw(&value.to_le_bytes()),
        }
    }

    pub(crate) fn sequence_number(&mut self, value: i64) -> &mut Self {
        self.u32((value.cast_unsigned() >> 32) as u32)
            .u32(value as u32)
    }

    pub(crate) fn string(&mut self, text: &str) -> &mut Self {
        self.unpadded(text).align()
    }

    /// Writes a string without the padding before the next field.
    pub(crate) fn unpadded(&mut self, text: &str) -> &mut Self {
        self.u32(u32::try_from(text.len() + 1).unwrap());
        self.raw((text.to_string() + "\0").as_bytes())
    }

    /// Writes one parameter and pads its value.
    pub(crate) fn parameter(&mut self, id: u16, value: &[u8]) -> &mut Self {
        let length = u16::try_from(value.len().next_multiple_of(4)).unwrap();
        self.u16(id).u16(length).raw(value).align()
    }

    /// Writes a submessage around the output of `body`.
    pub(crate) fn submessage(
        &mut self,
        id: u8,
        flags: u8,
        body: impl FnOnce(&mut Self),
    ) -> &mut Self {
        let endian_flag = u8::from(self.endianness == Endianness::Little);
        let mut inner = Self::new(self.endianness);
        body(&mut inner);
        self.raw(&[id, flags | endian_flag]);
        self.u16(u16::try_from(inner.bytes.len()).unwrap())
            .raw(&inner.bytes)
    }

    /// Writes a message header with prefix `01 02 .. 0c`.
    pub(crate) fn header(&mut self, vendor: [u8; 2]) -> &mut Self {
        self.raw(b"RTPS\x02\x03")
            .raw(&vendor)
            .raw(&[1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12])
    }
}
