//! Discovery data: what SPDP says about participants and SEDP about endpoints (RTPS 2.5, 8.5).
//!
//! One sample in, one statement out: this is alive with these properties, or it is gone. Identity
//! is taken from the payload (or its key hash), never from the message's header: a Discovery
//! Server relays what others say. Nothing is remembered here and no default is invented for what
//! identifies; lists are bounded, and what is cut is said.

mod endpoint;
mod participant;
mod user_data;

use alloc::vec::Vec;

use crate::cursor::{Cursor, Reason, WireError};
use crate::guid::Guid;
use crate::parameters::{ParameterId, ParameterList};
use crate::rtps::{InlineQos, Locator, Payload, StatusInfo, VendorId};

pub use crate::qos::Role;
pub use endpoint::EndpointAnnouncement;
pub use participant::{BuiltinEndpoints, ParticipantAnnouncement, Property};
pub use user_data::{TypeHash, UserData};

/// What one discovery sample says.
#[derive(Clone, PartialEq, Eq, Debug)]
pub enum Discovery<T> {
    /// It is there, and this is what it is like now.
    Alive(T),
    /// It was disposed or unregistered.
    Gone {
        /// What is gone.
        guid: Guid,
        /// Which of the two, or both.
        status: StatusInfo,
    },
}

/// Reads a sample of the SPDP writer. `vendor` is the sender's, for the case that the payload does
/// not say.
///
/// # Errors
/// The payload is malformed or does not say whom it is about.
pub fn participant(
    vendor: VendorId,
    payload: Payload<'_>,
    inline_qos: &InlineQos,
) -> Result<Discovery<ParticipantAnnouncement>, WireError> {
    Ok(
        match gone(payload, inline_qos, ParameterId::PARTICIPANT_GUID)? {
            Some(guid) => Discovery::Gone {
                guid,
                status: inline_qos.status_info,
            },
            None => Discovery::Alive(ParticipantAnnouncement::parse(payload.bytes(), vendor)?),
        },
    )
}

/// Reads a sample of the SEDP publications (`role` writer) or subscriptions (`role` reader) writer.
/// `vendor` is the sender's, for the case that the payload does not say.
///
/// # Errors
/// The payload is malformed or does not say which endpoint it is about.
pub fn endpoint(
    role: Role,
    vendor: VendorId,
    payload: Payload<'_>,
    inline_qos: &InlineQos,
) -> Result<Discovery<EndpointAnnouncement>, WireError> {
    Ok(
        match gone(payload, inline_qos, ParameterId::ENDPOINT_GUID)? {
            Some(guid) => Discovery::Gone {
                guid,
                status: inline_qos.status_info,
            },
            None => Discovery::Alive(EndpointAnnouncement::parse(role, payload.bytes(), vendor)?),
        },
    )
}

/// Who is gone, when the sample says that somebody is. Cyclone DDS sends the key as a payload,
/// Fast DDS no payload and the key hash, which for discovery data is the GUID, in the inline QoS.
fn gone(
    payload: Payload<'_>,
    inline_qos: &InlineQos,
    key: ParameterId,
) -> Result<Option<Guid>, WireError> {
    let status = inline_qos.status_info;
    let missing = WireError {
        what: "key of a disposed instance",
        offset: 0,
        reason: Reason::BadValue,
    };
    if let Payload::Data(_) = payload
        && !status.is_disposed()
        && !status.is_unregistered()
    {
        return Ok(None);
    }
    let in_payload = match payload {
        Payload::None => None,
        Payload::Data(bytes) | Payload::Key(bytes) => {
            guid(ParameterList::encapsulated(bytes)?, key)?
        }
    };
    in_payload
        .or(inline_qos.key_hash.map(Guid::from_bytes))
        .map(Some)
        .ok_or(missing)
}

/// The instance's GUID, from its own parameter or from the key hash beside it.
fn guid(parameters: ParameterList<'_>, key: ParameterId) -> Result<Option<Guid>, WireError> {
    for id in [key, ParameterId::KEY_HASH] {
        if let Some(mut value) = parameters.find(id)? {
            return Ok(Some(Guid::from_bytes(value.array("GUID")?)));
        }
    }
    Ok(None)
}

/// Whose vendor-specific parameters these are.
fn vendor(parameters: ParameterList<'_>, sender: VendorId) -> Result<VendorId, WireError> {
    match parameters.find(ParameterId::VENDORID)? {
        Some(mut value) => Ok(VendorId(value.array("PID_VENDORID")?)),
        None => Ok(sender),
    }
}

/// Most locators kept of one kind of one participant or endpoint. A host with many container
/// bridges announces one or two for each.
const MAX_LOCATORS: usize = 64;

/// Takes one more locator over, or says that the list is full.
fn push_locator(
    locators: &mut Vec<Locator>,
    mut value: Cursor<'_>,
    is_truncated: &mut bool,
) -> Result<(), WireError> {
    let locator = Locator::read(&mut value)?;
    if locators.len() < MAX_LOCATORS {
        locators.push(locator);
    } else {
        *is_truncated = true;
    }
    Ok(())
}

#[cfg(test)]
mod tests;
