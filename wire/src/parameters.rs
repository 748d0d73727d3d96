//! Parameter lists (RTPS 2.5, 9.4.2.11 and 9.6.4): the form of inline QoS and of discovery data.
//!
//! [`ParameterList`] iterates over borrowed bytes. It yields unknown parameters, too; the caller
//! decides whether they matter. "Must understand" is exposed but never a reason to reject a list:
//! an observer prefers a partial participant to none.

use core::fmt;

use crate::cursor::{Cursor, Endianness, Reason, WireError};

/// Identifier of a parameter, flag bits included.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct ParameterId(pub u16);

#[expect(
    missing_docs,
    reason = "the names are those of RTPS 2.5, table 9.14, and of the vendors"
)]
impl ParameterId {
    pub const PAD: Self = Self(0x0000);
    pub const SENTINEL: Self = Self(0x0001);
    pub const PARTICIPANT_LEASE_DURATION: Self = Self(0x0002);
    pub const TIME_BASED_FILTER: Self = Self(0x0004);
    pub const TOPIC_NAME: Self = Self(0x0005);
    pub const TYPE_NAME: Self = Self(0x0007);
    pub const DOMAIN_ID: Self = Self(0x000f);
    pub const DOMAIN_TAG: Self = Self(0x0014);
    pub const PROTOCOL_VERSION: Self = Self(0x0015);
    pub const VENDORID: Self = Self(0x0016);
    pub const RELIABILITY: Self = Self(0x001a);
    pub const LIVELINESS: Self = Self(0x001b);
    pub const DURABILITY: Self = Self(0x001d);
    pub const OWNERSHIP: Self = Self(0x001f);
    pub const PRESENTATION: Self = Self(0x0021);
    pub const DEADLINE: Self = Self(0x0023);
    pub const DESTINATION_ORDER: Self = Self(0x0025);
    pub const LATENCY_BUDGET: Self = Self(0x0027);
    pub const PARTITION: Self = Self(0x0029);
    pub const LIFESPAN: Self = Self(0x002b);
    pub const USER_DATA: Self = Self(0x002c);
    pub const UNICAST_LOCATOR: Self = Self(0x002f);
    pub const MULTICAST_LOCATOR: Self = Self(0x0030);
    pub const DEFAULT_UNICAST_LOCATOR: Self = Self(0x0031);
    pub const METATRAFFIC_UNICAST_LOCATOR: Self = Self(0x0032);
    pub const METATRAFFIC_MULTICAST_LOCATOR: Self = Self(0x0033);
    pub const CONTENT_FILTER_PROPERTY: Self = Self(0x0035);
    pub const HISTORY: Self = Self(0x0040);
    pub const DEFAULT_MULTICAST_LOCATOR: Self = Self(0x0048);
    pub const PARTICIPANT_GUID: Self = Self(0x0050);
    pub const BUILTIN_ENDPOINT_SET: Self = Self(0x0058);
    pub const PROPERTY_LIST: Self = Self(0x0059);
    pub const ENDPOINT_GUID: Self = Self(0x005a);
    pub const ENTITY_NAME: Self = Self(0x0062);
    pub const KEY_HASH: Self = Self(0x0070);
    pub const STATUS_INFO: Self = Self(0x0071);
    pub const DATA_REPRESENTATION: Self = Self(0x0073);
    pub const TYPE_INFORMATION: Self = Self(0x0075);
    pub const RELATED_SAMPLE_IDENTITY: Self = Self(0x0083);
    pub const IDENTITY_TOKEN: Self = Self(0x1001);
    pub const PERMISSIONS_TOKEN: Self = Self(0x1002);
    pub const ENDPOINT_SECURITY_INFO: Self = Self(0x1004);
    pub const PARTICIPANT_SECURITY_INFO: Self = Self(0x1005);

    /// Version of Fast DDS 3.0 and later, or of RTI Connext, in four octets. Cyclone DDS uses the
    /// same number for its builtin endpoints.
    pub const PRODUCT_VERSION: Self = Self(0x8000);
    /// Version of Cyclone DDS, host and system, as text.
    pub const CYCLONE_VERSION_INFO: Self = Self(0x8007);
    /// Data sharing of Fast DDS. Neither Cyclone DDS nor ADLINK's stack uses this number.
    pub const FAST_DATASHARING: Self = Self(0x8006);
    /// Related sample identity of Fast DDS. Cyclone DDS uses the same number for subscription keys.
    pub const FAST_RELATED_SAMPLE_IDENTITY: Self = Self(0x800f);
}

impl ParameterId {
    /// Returns whether the meaning depends on the vendor.
    #[must_use]
    pub const fn is_vendor_specific(self) -> bool {
        self.0 & 0x8000 != 0
    }

    /// Returns whether the must-understand bit is set: a reader that does not know the parameter
    /// should ignore the list.
    #[must_use]
    pub const fn must_understand(self) -> bool {
        self.0 & 0x4000 != 0
    }

    /// Returns the identifier without the must-understand bit, for comparison with the constants.
    #[must_use]
    pub const fn known(self) -> Self {
        Self(self.0 & !0x4000)
    }
}

impl fmt::Debug for ParameterId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:#06x}", self.0)
    }
}

/// One parameter.
#[derive(Clone, Copy, Debug)]
pub struct Parameter<'a> {
    /// Identifier of the parameter.
    pub id: ParameterId,
    /// Its value, limited to the length in the list.
    pub value: Cursor<'a>,
}

/// A list of parameters; iterates over all but PAD and SENTINEL, and ends after the first error.
#[derive(Clone, Copy, Debug)]
pub struct ParameterList<'a> {
    rest: Cursor<'a>,
    needs_sentinel: bool,
    ended: bool,
}

impl<'a> ParameterList<'a> {
    /// Wraps bytes without encapsulation, as in inline QoS. The sentinel is required.
    #[must_use]
    pub const fn inline(rest: Cursor<'a>) -> Self {
        Self {
            rest,
            needs_sentinel: true,
            ended: false,
        }
    }

    /// Wraps a serialized payload and checks its encapsulation (RTPS 2.5, 10.5). A list that ends
    /// exactly at the payload's end needs no sentinel.
    ///
    /// # Errors
    /// Returns [`Reason::BadMarker`] if the payload is not a parameter list.
    pub fn encapsulated(payload: &'a [u8]) -> Result<Self, WireError> {
        let mut cursor = Cursor::new(payload, Endianness::Big);
        let error = cursor.error("encapsulation", Reason::BadMarker);
        let endianness = match cursor.u16("encapsulation")? {
            // PL_CDR. PL_CDR2 is accepted too: builtin topics have the same form in both.
            0x0002 | 0x000a => Endianness::Big,
            0x0003 | 0x000b => Endianness::Little,
            _ => return Err(error),
        };
        cursor.u16("encapsulation options")?;
        let rest = cursor.with_endianness(endianness);
        Ok(Self {
            rest,
            needs_sentinel: false,
            ended: false,
        })
    }

    /// Returns the value of the first parameter with this identifier.
    ///
    /// # Errors
    /// Fails if the list is malformed before that parameter.
    pub fn find(self, id: ParameterId) -> Result<Option<Cursor<'a>>, WireError> {
        for parameter in self {
            let parameter = parameter?;
            if parameter.id.known() == id {
                return Ok(Some(parameter.value));
            }
        }
        Ok(None)
    }

    fn parameter(&mut self) -> Result<Option<Parameter<'a>>, WireError> {
        loop {
            if self.rest.remaining() < 4 && !self.needs_sentinel {
                return Ok(None);
            }
            let id = ParameterId(self.rest.u16("parameter id")?);
            let length = usize::from(self.rest.u16("parameter length")?);
            if id == ParameterId::SENTINEL {
                return Ok(None);
            }
            let value = self.rest.sub("parameter", length)?;
            // Lengths are multiples of four. After another length, the writer pads the value.
            self.rest
                .take("parameter padding", length.wrapping_neg() & 3)?;
            if id.known() != ParameterId::PAD {
                return Ok(Some(Parameter { id, value }));
            }
        }
    }
}

impl<'a> Iterator for ParameterList<'a> {
    type Item = Result<Parameter<'a>, WireError>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.ended {
            return None;
        }
        let parameter = self.parameter().transpose();
        self.ended = !matches!(parameter, Some(Ok(_)));
        parameter
    }
}

#[cfg(test)]
mod tests {
    use std::vec::Vec;

    use super::*;

    fn ids(list: ParameterList<'_>) -> Result<Vec<(u16, usize)>, WireError> {
        list.map(|parameter| parameter.map(|p| (p.id.0, p.value.remaining())))
            .collect()
    }

    fn inline(bytes: &[u8]) -> Result<Vec<(u16, usize)>, Reason> {
        let list = ParameterList::inline(Cursor::new(bytes, Endianness::Little));
        ids(list).map_err(|error| error.reason)
    }

    const TWO: [u8; 20] = [
        0x05, 0, 4, 0, 1, 2, 3, 4, 0x00, 0, 0, 0, 0x0f, 0x80, 0, 0, 0x01, 0, 0xff, 0xff,
    ];

    #[test]
    fn pads_are_skipped_and_the_length_of_the_sentinel_is_ignored() {
        assert_eq!(inline(&TWO), Ok([(0x0005, 4), (0x800f, 0)].into()));
    }

    #[test]
    fn inline_qos_requires_the_sentinel_and_a_payload_does_not() {
        for length in 0..TWO.len() {
            assert_eq!(inline(&TWO[..length]), Err(Reason::Truncated), "{length}");
        }
        let payload = [&[0, 3, 0, 0], &TWO[..16]].concat();
        assert_eq!(
            ids(ParameterList::encapsulated(&payload).unwrap())
                .unwrap()
                .len(),
            2
        );
        let cut = ids(ParameterList::encapsulated(&payload[..10]).unwrap());
        assert_eq!(cut.map_err(|error| error.offset), Err(8));
    }

    #[test]
    fn an_unpadded_length_does_not_shift_the_next_parameter() {
        let bytes = [0x62, 0, 2, 0, b'a', 0, 0, 0, 0x05, 0, 0, 0, 1, 0, 0, 0];
        assert_eq!(inline(&bytes), Ok([(0x0062, 2), (0x0005, 0)].into()));
    }

    #[test]
    fn a_list_stays_ended_after_its_end_or_an_error() {
        let mut list = ParameterList::inline(Cursor::new(&TWO, Endianness::Little));
        assert_eq!(list.by_ref().count(), 2);
        assert!(list.next().is_none());
        let mut list = ParameterList::inline(Cursor::new(&TWO[..6], Endianness::Little));
        assert!(list.next().is_some_and(|parameter| parameter.is_err()));
        assert!(list.next().is_none());
    }

    #[test]
    fn payloads_with_another_encapsulation_are_refused() {
        assert!(ParameterList::encapsulated(&[0, 2, 0, 0]).is_ok());
        for kind in [0x00, 0x01, 0x06, 0x07, 0xff] {
            let error = ParameterList::encapsulated(&[0, kind, 0, 0])
                .map(|_| ())
                .unwrap_err();
            assert_eq!(error.reason, Reason::BadMarker);
        }
        assert!(ParameterList::encapsulated(&[0, 3, 0]).is_err());
    }

    #[test]
    fn the_must_understand_bit_is_not_part_of_the_known_id() {
        let tag = ParameterId(0x4014);
        assert!(tag.must_understand() && !tag.is_vendor_specific());
        assert_eq!(tag.known(), ParameterId::DOMAIN_TAG);
        assert!(ParameterId(0x8006).is_vendor_specific());
    }
}
