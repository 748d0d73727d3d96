//! SEDP: a participant announces its writers and readers (RTPS 2.5, 8.5.4 and 9.6.3.2).

use alloc::vec::Vec;

use super::{EquivalenceHash, TypeHash, UserData, guid, push_locator, vendor};
use crate::backends::Backends;
use crate::cursor::{Cursor, Reason, WireError};
use crate::guid::{EntityId, Guid};
use crate::names::{DdsTopic, DdsType};
use crate::parameters::{ParameterId, ParameterList};
use crate::qos::{Qos, Role};
use crate::rtps::{Locator, VendorId};
use crate::text;

/// Mark in user data before the GUID of the publisher whose buffers a writer carries, as 32 digits
/// (`rmw_fastrtps` of Lyrical, `rmw_publish.cpp`).
const PUBLISHER: &str = "PGID:";

/// The announcement of one endpoint.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct EndpointAnnouncement {
    /// GUID of the endpoint.
    pub guid: Guid,
    /// GUID of its participant.
    pub participant: Guid,
    /// Identity that ROS prints: the GUID, or with Zenoh the hash of the liveliness token.
    pub gid: [u8; 16],
    /// Writer or reader.
    pub role: Role,
    /// Vendor of its DDS implementation.
    pub vendor: VendorId,
    /// Its topic.
    pub topic: DdsTopic,
    /// Its topic's type.
    pub type_name: DdsType,
    /// Its quality of service.
    pub qos: Qos,
    /// Hash of its ROS type; `None` from Humble, which announces no hash.
    pub type_hash: Option<TypeHash>,
    /// Hash of its complete type in XTypes, if announced.
    pub equivalence_hash: Option<EquivalenceHash>,
    /// Why the announced XTypes hash could not be read. The announcement is usable without it.
    pub type_information_error: Option<WireError>,
    /// Hash of the service type, for a service's endpoint in Lyrical and later.
    pub service_type_hash: Option<TypeHash>,
    /// Backends of buffers; `None` if it has none.
    pub backends: Option<Backends>,
    /// The endpoint of the base topic for which it carries buffers, if it announces one.
    pub base: Option<Guid>,
    /// Unicast locators, if they differ from its participant's default ones.
    pub unicast: Vec<Locator>,
    /// Multicast locators, if they differ from its participant's default ones.
    pub multicast: Vec<Locator>,
    /// Fast DDS: whether it can share its history in memory with endpoints on its host.
    pub datasharing: bool,
    /// Whether the reader uses a content filter: then a gap in its samples is not a loss.
    pub content_filter: bool,
    /// Whether DDS Security protects it.
    pub is_secured: bool,
    /// Whether it announced more locators than are kept.
    pub is_truncated: bool,
}

impl EndpointAnnouncement {
    /// Creates an announcement with this identity, topic and type, and the default of every other
    /// field.
    #[must_use]
    pub fn new(
        guid: Guid,
        role: Role,
        vendor: VendorId,
        topic: DdsTopic,
        type_name: DdsType,
    ) -> Self {
        Self {
            guid,
            participant: Guid::new(guid.prefix, EntityId::PARTICIPANT),
            gid: guid.to_bytes(),
            role,
            vendor,
            topic,
            type_name,
            qos: Qos::defaults(role, vendor),
            type_hash: None,
            equivalence_hash: None,
            type_information_error: None,
            service_type_hash: None,
            backends: None,
            base: None,
            unicast: Vec::new(),
            multicast: Vec::new(),
            datasharing: false,
            content_filter: false,
            is_secured: false,
            is_truncated: false,
        }
    }

    /// Parses a payload of the SEDP writer for `role`.
    ///
    /// # Errors
    /// Fails if the list is malformed, lacks the GUID, topic or type, or contradicts itself.
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
        // Cyclone DDS omits PID_PARTICIPANT_GUID. A different GUID would assign the endpoint to
        // another participant.
        if let Some(mut value) = parameters.find(ParameterId::PARTICIPANT_GUID)?
            && Guid::from_bytes(value.array("PID_PARTICIPANT_GUID")?)
                != Guid::new(guid.prefix, EntityId::PARTICIPANT)
        {
            return Err(bad("PID_PARTICIPANT_GUID"));
        }
        let vendor = vendor(parameters, sender)?;
        let topic = DdsTopic::read(&mut required(ParameterId::TOPIC_NAME, "PID_TOPIC_NAME")?)?;
        let type_name = DdsType::read(&mut required(ParameterId::TYPE_NAME, "PID_TYPE_NAME")?)?;
        let subscriber = topic.buffer_subscriber();
        let mut endpoint = Self::new(guid, role, vendor, topic, type_name);
        endpoint.base = subscriber.filter(|_| role == Role::Reader);
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
                self.backends = Backends::of_user_data(user_data);
                if self.role == Role::Writer {
                    let digits = user_data.after(PUBLISHER).and_then(|rest| rest.get(..32));
                    self.base = digits.and_then(Guid::of_digits);
                }
            }
            ParameterId::TYPE_INFORMATION => match EquivalenceHash::read(value) {
                Ok(hash) => self.equivalence_hash = hash,
                Err(error) => self.type_information_error = Some(error),
            },
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
