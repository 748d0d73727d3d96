//! SPDP: a participant announces itself (RTPS 2.5, 8.5.3.2 and 9.6.2.2).

use alloc::boxed::Box;
use alloc::string::String;
use alloc::vec::Vec;

use super::{UserData, guid, push_locator, vendor};
use crate::cursor::{Cursor, Endianness, Reason, WireError};
use crate::domain::DomainId;
use crate::guid::{EntityId, Guid};
use crate::parameters::{ParameterId, ParameterList};
use crate::qos;
use crate::rtps::{Locator, ProtocolVersion, VendorId};
use crate::text;
use crate::time::Duration;

/// What holds when a participant does not say how long it may be silent (RTPS 2.5, 9.6.2.2.1).
const DEFAULT_LEASE: Duration = Duration::Finite(100_000_000_000);
/// Most properties kept of one participant, and the longest name or value of one.
const MAX_PROPERTIES: usize = 32;
const MAX_PROPERTY_LEN: usize = 256;
/// Longest entity name, enclave or domain tag.
const MAX_NAME_LEN: usize = 256;

/// Which discovery endpoints a participant has (RTPS 2.5, 9.3.2.12).
#[derive(Clone, Copy, Default, PartialEq, Eq, Hash, Debug)]
pub struct BuiltinEndpoints(pub u32);

/// One pair of a property list.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Property {
    /// Its name.
    pub name: Box<str>,
    /// Its value.
    pub value: Box<str>,
}

/// What a participant says about itself.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct ParticipantAnnouncement {
    /// Who.
    pub guid: Guid,
    /// Its implementation.
    pub vendor: VendorId,
    /// The protocol version it speaks; zero when not said.
    pub protocol_version: ProtocolVersion,
    /// Silent for longer than this, it is gone.
    pub lease: Duration,
    /// Its domain; Fast DDS 2.x does not say, there the port tells.
    pub domain_id: Option<DomainId>,
    /// Its domain's tag; empty is the default.
    pub domain_tag: String,
    /// Its entity name, where it is plain text; Fast DDS puts the enclave here.
    pub entity_name: String,
    /// The ROS enclave; only ROS participants have one.
    pub enclave: Option<String>,
    /// Its properties.
    pub properties: Vec<Property>,
    /// Where its discovery endpoints are reached.
    pub metatraffic_unicast: Vec<Locator>,
    /// Where they are reached by multicast.
    pub metatraffic_multicast: Vec<Locator>,
    /// Where its other endpoints are reached.
    pub default_unicast: Vec<Locator>,
    /// Where those are reached by multicast.
    pub default_multicast: Vec<Locator>,
    /// Which discovery endpoints it has.
    pub builtin_endpoints: BuiltinEndpoints,
    /// It authenticates its peers (DDS Security); what it says further may be encrypted.
    pub is_secured: bool,
    /// There were more locators or properties than are kept, or unreadable ones.
    pub is_truncated: bool,
}

impl ParticipantAnnouncement {
    /// From a payload.
    ///
    /// # Errors
    /// The list is malformed or does not say who announces itself.
    pub fn parse(payload: &[u8], sender: VendorId) -> Result<Self, WireError> {
        let parameters = ParameterList::encapsulated(payload)?;
        let nobody = WireError {
            what: "PID_PARTICIPANT_GUID",
            offset: 4,
            reason: Reason::BadValue,
        };
        let guid = guid(parameters, ParameterId::PARTICIPANT_GUID)?
            .filter(|guid| guid.entity == EntityId::PARTICIPANT)
            .ok_or(nobody)?;
        let mut participant = Self {
            guid,
            vendor: vendor(parameters, sender)?,
            protocol_version: ProtocolVersion::default(),
            lease: DEFAULT_LEASE,
            domain_id: None,
            domain_tag: String::new(),
            entity_name: String::new(),
            enclave: None,
            properties: Vec::new(),
            metatraffic_unicast: Vec::new(),
            metatraffic_multicast: Vec::new(),
            default_unicast: Vec::new(),
            default_multicast: Vec::new(),
            builtin_endpoints: BuiltinEndpoints::default(),
            is_secured: false,
            is_truncated: false,
        };
        for parameter in parameters {
            let parameter = parameter?;
            participant.apply(parameter.id.known(), parameter.value)?;
        }
        Ok(participant)
    }

    fn apply(&mut self, id: ParameterId, mut value: Cursor<'_>) -> Result<(), WireError> {
        let truncated = &mut self.is_truncated;
        match id {
            ParameterId::PROTOCOL_VERSION => {
                let [major, minor] = value.array("PID_PROTOCOL_VERSION")?;
                self.protocol_version = ProtocolVersion { major, minor };
            }
            ParameterId::PARTICIPANT_LEASE_DURATION => {
                self.lease = qos::duration(&mut value, "PID_PARTICIPANT_LEASE_DURATION")?;
            }
            ParameterId::DOMAIN_ID => self.domain_id = Some(DomainId(value.u32("PID_DOMAIN_ID")?)),
            ParameterId::DOMAIN_TAG => {
                self.domain_tag = text::name(&mut value, "PID_DOMAIN_TAG", MAX_NAME_LEN)?.into();
            }
            ParameterId::ENTITY_NAME => {
                // Not an identity, and free text where ROS did not set it.
                match text::name(&mut value, "PID_ENTITY_NAME", MAX_NAME_LEN) {
                    Ok(name) => self.entity_name = name.into(),
                    Err(_) => *truncated = true,
                }
            }
            ParameterId::USER_DATA => {
                let user_data = UserData::new(text::octets(&mut value, "PID_USER_DATA")?);
                self.enclave = user_data
                    .find("enclave")
                    .filter(|enclave| enclave.len() <= MAX_NAME_LEN && text::is_plain(enclave))
                    .map(Into::into);
            }
            ParameterId::PROPERTY_LIST => {
                properties(&mut value, &mut self.properties, truncated)?;
            }
            ParameterId::METATRAFFIC_UNICAST_LOCATOR => {
                push_locator(&mut self.metatraffic_unicast, value, truncated)?;
            }
            ParameterId::METATRAFFIC_MULTICAST_LOCATOR => {
                push_locator(&mut self.metatraffic_multicast, value, truncated)?;
            }
            ParameterId::DEFAULT_UNICAST_LOCATOR => {
                push_locator(&mut self.default_unicast, value, truncated)?;
            }
            ParameterId::DEFAULT_MULTICAST_LOCATOR => {
                push_locator(&mut self.default_multicast, value, truncated)?;
            }
            ParameterId::BUILTIN_ENDPOINT_SET => {
                self.builtin_endpoints = BuiltinEndpoints(value.u32("PID_BUILTIN_ENDPOINT_SET")?);
            }
            ParameterId::IDENTITY_TOKEN
            | ParameterId::PERMISSIONS_TOKEN
            | ParameterId::PARTICIPANT_SECURITY_INFO => self.is_secured = true,
            _ => {}
        }
        Ok(())
    }

    /// Whether ROS made it.
    #[must_use]
    pub const fn is_ros(&self) -> bool {
        self.enclave.is_some()
    }

    /// Value of a property.
    #[must_use]
    pub fn property(&self, name: &str) -> Option<&str> {
        self.properties
            .iter()
            .find(|property| &*property.name == name)
            .map(|found| &*found.value)
    }

    /// Its host's name, as Cyclone DDS always and Fast DDS sometimes says.
    #[must_use]
    pub fn host_name(&self) -> Option<&str> {
        self.property("__Hostname")
            .or_else(|| self.property("fastdds.physical_data.host"))
    }

    /// Its process's name, as Cyclone DDS says.
    #[must_use]
    pub fn process_name(&self) -> Option<&str> {
        self.property("__ProcessName")
    }

    /// Its process's number, as Cyclone DDS says, in its own PID namespace.
    #[must_use]
    pub fn process_id(&self) -> Option<u32> {
        self.property("__Pid")?.parse().ok()
    }

    /// The low 16 bits of its process's number, which Fast DDS puts into its GUIDs.
    #[must_use]
    pub fn process_id_low_bits(&self) -> Option<u16> {
        let prefix = Cursor::new(&self.guid.prefix.0, Endianness::Little);
        let mut rest = prefix;
        let vendor = VendorId(rest.array("guid prefix").ok()?);
        rest.take("guid prefix", 2).ok()?;
        (vendor == VendorId::EPROSIMA).then(|| rest.u16("guid prefix").ok())?
    }
}

/// Keeps the readable properties that fit; the others are only missed by whoever asks for them.
fn properties(
    value: &mut Cursor<'_>,
    properties: &mut Vec<Property>,
    is_truncated: &mut bool,
) -> Result<(), WireError> {
    let count = value.u32("PID_PROPERTY_LIST")?;
    for _ in 0..count {
        if properties.len() == MAX_PROPERTIES {
            *is_truncated = true;
            break;
        }
        let name = text::octets(value, "PID_PROPERTY_LIST")?;
        let content = text::octets(value, "PID_PROPERTY_LIST")?;
        match (property_text(name), property_text(content)) {
            (Some(name), Some(value)) => {
                properties.push(Property {
                    name: name.into(),
                    value: value.into(),
                });
            }
            _ => *is_truncated = true,
        }
    }
    Ok(())
}

fn property_text(octets: &[u8]) -> Option<&str> {
    let text = str::from_utf8(octets).ok()?.trim_end_matches('\0');
    (text.len() <= MAX_PROPERTY_LEN && text::is_plain(text)).then_some(text)
}
