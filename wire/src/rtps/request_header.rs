//! Header of service requests and replies in the payload, as rmw_cyclonedds writes it.
//!
//! rmw_fastrtps puts the identity of a request into the inline QoS instead: see
//! [`super::SampleIdentity`].

use super::SequenceNumber;
use crate::cursor::{Cursor, Endianness, Reason, WireError};

/// `cdds_request_header_t` of rmw_cyclonedds: the first 16 bytes after the encapsulation of each
/// request and of its reply.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub struct RequestHeader {
    /// Id that the client chose for itself; its USER_DATA contains the same id as `clientid`.
    pub client_id: [u8; 8],
    /// Number of the request, counted by the client from 1.
    pub sequence_number: SequenceNumber,
}

impl RequestHeader {
    /// Length of the encapsulation header (RTPS 2.5, 10.2) and of this header together, in bytes.
    pub const END: usize = 4 + Self::LENGTH;

    /// Length of this header, in bytes.
    pub const LENGTH: usize = 16;

    /// Parses the start of a serialized payload, encapsulation included.
    ///
    /// # Errors
    /// Fails if the payload is shorter than [`Self::END`], or its encapsulation is not plain CDR.
    pub fn parse(payload: &[u8]) -> Result<Self, WireError> {
        let mut cursor = Cursor::new(payload, Endianness::Big);
        let encapsulation = cursor.array::<4>("request header")?;
        // 0000 and 0001 are CDR, 0006 and 0007 are CDR2. An odd number means little-endian.
        let endianness = match encapsulation {
            [0, 0 | 6, ..] => Endianness::Big,
            [0, 1 | 7, ..] => Endianness::Little,
            _ => return Err(cursor.error("request header", Reason::BadMarker)),
        };
        // The id is a number: the octets of a little-endian id are reversed, so that both byte
        // orders yield the same id.
        let mut client_id = cursor.array::<8>("request header")?;
        let number = cursor.array::<8>("request header")?;
        let number = match endianness {
            Endianness::Big => u64::from_be_bytes(number),
            Endianness::Little => {
                client_id.reverse();
                u64::from_le_bytes(number)
            }
        };
        Ok(Self {
            client_id,
            sequence_number: SequenceNumber(number),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LITTLE: [u8; 20] = [0, 1, 0, 0, 8, 7, 6, 5, 4, 3, 2, 1, 42, 0, 0, 0, 0, 0, 0, 0];
    const BIG: [u8; 20] = [0, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 0, 0, 0, 0, 0, 0, 0, 42];

    #[test]
    fn both_byte_orders_yield_the_same_identity() {
        let parsed = RequestHeader::parse(&LITTLE).unwrap();
        assert_eq!(parsed.client_id, [1, 2, 3, 4, 5, 6, 7, 8]);
        assert_eq!(parsed.sequence_number, SequenceNumber(42));
        assert_eq!(RequestHeader::parse(&BIG), Ok(parsed));
    }

    #[test]
    fn a_short_payload_and_a_parameter_list_are_refused() {
        for length in 0..RequestHeader::END {
            assert!(RequestHeader::parse(&LITTLE[..length]).is_err(), "{length}");
        }
        let list = [&[0, 3, 0, 0][..], &LITTLE[4..]].concat();
        assert!(RequestHeader::parse(&list).is_err());
    }
}
