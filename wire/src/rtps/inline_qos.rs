//! Inline QoS of one change: its instance, the instance's state, and the request that it answers.

use super::{SequenceNumber, VendorId};
use crate::cursor::{Cursor, WireError};
use crate::guid::Guid;
use crate::parameters::{ParameterId, ParameterList};

/// State of the instance (RTPS 2.5, 9.6.4.9).
#[derive(Clone, Copy, Default, PartialEq, Eq, Hash, Debug)]
pub struct StatusInfo(pub u32);

impl StatusInfo {
    /// Neither disposed nor unregistered: the default of a change without a status.
    pub const ALIVE: Self = Self(0);

    /// Returns whether the instance was deleted.
    #[must_use]
    pub const fn is_disposed(self) -> bool {
        self.0 & 1 != 0
    }

    /// Returns whether the writer unregistered the instance.
    #[must_use]
    pub const fn is_unregistered(self) -> bool {
        self.0 & 2 != 0
    }

    /// Returns whether the change was filtered out for its reader.
    #[must_use]
    pub const fn is_filtered(self) -> bool {
        self.0 & 4 != 0
    }
}

/// Identity of the change that this change answers (RTPS 2.5 with DDS-RPC 1.0, 7.8.2).
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub struct SampleIdentity {
    /// Writer of the answered change; rmw_fastrtps puts the client's response reader here.
    pub writer: Guid,
    /// Sequence number of the answered change.
    pub sequence_number: SequenceNumber,
}

/// The inline QoS parameters that an observer needs.
#[derive(Clone, Copy, Default, PartialEq, Eq, Debug)]
pub struct InlineQos {
    /// Key hash of the instance; the GUID itself for discovery data.
    pub key_hash: Option<[u8; 16]>,
    /// State of the instance; zero if absent.
    pub status_info: StatusInfo,
    /// Correlation of a request and its reply.
    pub related_sample_identity: Option<SampleIdentity>,
}

impl InlineQos {
    /// Parses a parameter list; `vendor` decides the meaning of the vendor-specific identifiers.
    ///
    /// # Errors
    /// Fails if the list is malformed or the value of one of these parameters is too short.
    pub fn parse(parameters: ParameterList<'_>, vendor: VendorId) -> Result<Self, WireError> {
        let mut inline_qos = Self::default();
        for parameter in parameters {
            let parameter = parameter?;
            let mut value = parameter.value;
            match parameter.id.known() {
                ParameterId::KEY_HASH => inline_qos.key_hash = Some(value.array("PID_KEY_HASH")?),
                ParameterId::STATUS_INFO => {
                    // Octets, not a number: big-endian regardless of the submessage's E flag.
                    let octets = value.array("PID_STATUS_INFO")?;
                    inline_qos.status_info = StatusInfo(u32::from_be_bytes(octets));
                }
                ParameterId::RELATED_SAMPLE_IDENTITY => {
                    inline_qos.related_sample_identity = Some(sample_identity(&mut value)?);
                }
                // Fast DDS used this id before the standard one, and RTI Connext reads it too. In
                // Cyclone DDS the same id means subscription keys.
                ParameterId::FAST_RELATED_SAMPLE_IDENTITY
                    if matches!(vendor, VendorId::EPROSIMA | VendorId::RTI_CONNEXT)
                        && inline_qos.related_sample_identity.is_none() =>
                {
                    inline_qos.related_sample_identity = Some(sample_identity(&mut value)?);
                }
                _ => {}
            }
        }
        Ok(inline_qos)
    }
}

fn sample_identity(value: &mut Cursor<'_>) -> Result<SampleIdentity, WireError> {
    Ok(SampleIdentity {
        writer: Guid::from_bytes(value.array("PID_RELATED_SAMPLE_IDENTITY")?),
        sequence_number: SequenceNumber::read(value, "PID_RELATED_SAMPLE_IDENTITY")?,
    })
}
