//! Discovery data: SPDP announcements of participants and SEDP announcements of endpoints (RTPS
//! 2.5, 8.5).
//!
//! Each sample states that one entity is alive with certain properties, or that it is gone. The
//! identity comes from the payload (or its key hash), never from the message's header, because a
//! Discovery Server relays announcements of other participants. This module keeps no state and
//! invents no default for an identity. Lists are bounded, and a flag marks truncated ones.

mod endpoint;
mod participant;
mod type_information;
mod user_data;

use alloc::vec::Vec;

use crate::cursor::{Cursor, Reason, WireError};
use crate::guid::Guid;
use crate::parameters::{ParameterId, ParameterList};
use crate::rtps::{InlineQos, Locator, Payload, StatusInfo, VendorId};

pub use crate::qos::Role;
pub use endpoint::EndpointAnnouncement;
pub use participant::{BuiltinEndpoints, ParticipantAnnouncement, Property};
pub use type_information::EquivalenceHash;
pub use user_data::{TypeHash, UserData};

/// Content of one discovery sample.
#[derive(Clone, PartialEq, Eq, Debug)]
pub enum Discovery<T> {
    /// The entity is alive, with its current properties.
    Alive(T),
    /// The entity was disposed or unregistered.
    Gone {
        /// GUID of the entity.
        guid: Guid,
        /// Disposed, unregistered, or both.
        status: StatusInfo,
    },
}

/// Parses a sample of the SPDP writer. `vendor` is the sender's vendor, which applies if the
/// payload names none.
///
/// # Errors
/// Fails if the payload is malformed or does not identify the participant.
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

/// Parses a sample of the SEDP writer for publications ([`Role::Writer`]) or subscriptions
/// ([`Role::Reader`]). `vendor` is the sender's vendor, which applies if the payload names none.
///
/// # Errors
/// Fails if the payload is malformed or does not identify the endpoint.
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

/// Returns the entity that the sample disposes or unregisters; `None` if the entity is alive.
/// Cyclone DDS sends the key as a payload. Fast DDS sends no payload and puts the key hash, which
/// for discovery data is the GUID, into the inline QoS.
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

/// Returns the instance's GUID, from the parameter `key` or from the key hash in the list.
fn guid(parameters: ParameterList<'_>, key: ParameterId) -> Result<Option<Guid>, WireError> {
    for id in [key, ParameterId::KEY_HASH] {
        if let Some(mut value) = parameters.find(id)? {
            return Ok(Some(Guid::from_bytes(value.array("GUID")?)));
        }
    }
    Ok(None)
}

/// Returns the vendor that defines the vendor-specific parameters of the list.
fn vendor(parameters: ParameterList<'_>, sender: VendorId) -> Result<VendorId, WireError> {
    match parameters.find(ParameterId::VENDORID)? {
        Some(mut value) => Ok(VendorId(value.array("PID_VENDORID")?)),
        None => Ok(sender),
    }
}

/// Maximum number of locators of one kind that are kept per participant or endpoint. A host with
/// many container bridges announces one or two per bridge.
const MAX_LOCATORS: usize = 64;

/// Adds a locator, or sets the truncation flag if the list is full.
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
