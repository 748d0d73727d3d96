//! SEDP: a participant announces its writers and readers (RTPS 2.5, 8.5.4 and 9.6.2.2).

use alloc::vec::Vec;

use super::{TypeHash, UserData, guid, push_locator, vendor};
use crate::cursor::{Cursor, Reason, WireError};
use crate::guid::{EntityId, Guid};
use crate::names::{DdsTopic, DdsType};
use crate::parameters::{ParameterId, ParameterList};
use crate::qos::{Qos, Role};
use crate::rtps::{Locator, VendorId};
use crate::text;

/// What is said about one endpoint.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct EndpointAnnouncement {
    /// Which endpoint.
    pub guid: Guid,
    /// Whose.
    pub participant: Guid,
    /// Writer or reader.
    pub role: Role,
    /// Its implementation.
    pub vendor: VendorId,
    /// Its topic.
    pub topic: DdsTopic,
    /// Its topic's type.
    pub type_name: DdsType,
    /// Its quality of service.
    pub qos: Qos,
    /// Its ROS type's hash; Humble says none.
    pub type_hash: Option<TypeHash>,
    /// Of a service's endpoint, the service type's hash; Lyrical and later.
    pub service_type_hash: Option<TypeHash>,
    /// Where it is reached, when elsewhere than its participant's other endpoints.
    pub unicast: Vec<Locator>,
    /// Where it is reached by multicast.
    pub multicast: Vec<Locator>,
    /// Fast DDS: it can share its history in memory with endpoints of its host.
    pub datasharing: bool,
    /// A reader that has the writer leave samples out: a gap for it is not a loss.
    pub content_filter: bool,
    /// DDS Security protects it.
    pub is_secured: bool,
    /// There were more locators than are kept.
    pub is_truncated: bool,
}

impl EndpointAnnouncement {
    /// From a payload of the SEDP writer for `role`.
    ///
    /// # Errors
    /// The list is malformed, does not say which endpoint, topic and type, or contradicts itself.
    pub fn parse(role: Role, payload: &[u8], sender: VendorId) -> Result<Self, WireError> {
        let parameters = ParameterList::encapsulated(payload)?;
        let bad = |what| WireError {
            what,
            offset: 4,
            reason: Reason::BadValue,
        };
        let required = |id, what| parameters.find(id)?.ok_or(bad(what));

        let guid = guid(parameters, ParameterId::ENDPOINT_GUID)?.ok_or(bad("PID_ENDPOINT_GUID"))?;
        let fits = match role {
            Role::Writer => guid.entity.is_writer(),
            Role::Reader => guid.entity.is_reader(),
        };
        if !fits {
            return Err(bad("PID_ENDPOINT_GUID"));
        }
        // Cyclone DDS leaves it out. One that differs would put the endpoint under somebody else.
        let participant = Guid::new(guid.prefix, EntityId::PARTICIPANT);
        if let Some(mut value) = parameters.find(ParameterId::PARTICIPANT_GUID)?
            && Guid::from_bytes(value.array("PID_PARTICIPANT_GUID")?) != participant
        {
            return Err(bad("PID_PARTICIPANT_GUID"));
        }
        let vendor = vendor(parameters, sender)?;
        let mut endpoint = Self {
            guid,
            participant,
            role,
            vendor,
            topic: DdsTopic::read(&mut required(ParameterId::TOPIC_NAME, "PID_TOPIC_NAME")?)?,
            type_name: DdsType::read(&mut required(ParameterId::TYPE_NAME, "PID_TYPE_NAME")?)?,
            qos: Qos::defaults(role, vendor),
            type_hash: None,
            service_type_hash: None,
            unicast: Vec::new(),
            multicast: Vec::new(),
            datasharing: false,
            content_filter: false,
            is_secured: false,
            is_truncated: false,
        };
        for parameter in parameters {
            let parameter = parameter?;
            endpoint.apply(parameter.id.known(), parameter.value)?;
        }
        Ok(endpoint)
    }

    fn apply(&mut self, id: ParameterId, mut value: Cursor<'_>) -> Result<(), WireError> {
        if self.qos.apply(id, value)? {
            return Ok(());
        }
        match id {
            ParameterId::USER_DATA => {
                let user_data = UserData::new(text::octets(&mut value, "PID_USER_DATA")?);
                self.type_hash = user_data.find("typehash").and_then(TypeHash::parse);
                self.service_type_hash = user_data.find("sertypehash").and_then(TypeHash::parse);
            }
            ParameterId::UNICAST_LOCATOR => {
                push_locator(&mut self.unicast, value, &mut self.is_truncated)?;
            }
            ParameterId::MULTICAST_LOCATOR => {
                push_locator(&mut self.multicast, value, &mut self.is_truncated)?;
            }
            ParameterId::CONTENT_FILTER_PROPERTY => self.content_filter = true,
            ParameterId::ENDPOINT_SECURITY_INFO => self.is_secured = true,
            ParameterId::FAST_DATASHARING if self.vendor == VendorId::EPROSIMA => {
                self.datasharing = true;
            }
            _ => {}
        }
        Ok(())
    }
}
