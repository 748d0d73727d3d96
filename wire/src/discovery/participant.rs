//! SPDP: a participant announces itself (RTPS 2.5, 8.5.3.2 and 9.6.3.2).

use alloc::boxed::Box;
use alloc::format;
use alloc::string::String;
use alloc::vec::Vec;
use core::time::Duration;

use super::{UserData, guid, push_locator, vendor};
use crate::cursor::{Cursor, Endianness, Reason, WireError};
use crate::domain::DomainId;
use crate::guid::{EntityId, Guid};
use crate::parameters::{ParameterId, ParameterList};
use crate::qos;
use crate::rtps::{Locator, ProtocolVersion, VendorId};
use crate::text;
use crate::time::RtpsDuration;

/// Lease of a participant that announces none (RTPS 2.5, 9.6.3.2).
const DEFAULT_LEASE: RtpsDuration = RtpsDuration::Finite(Duration::from_secs(100));
/// Maximum number of properties kept per participant, and maximum length of a name or value in
/// bytes.
const MAX_PROPERTIES: usize = 32;
const MAX_PROPERTY_LEN: usize = 256;
/// Maximum length of an entity name, enclave or domain tag, in bytes.
const MAX_NAME_LEN: usize = 256;

/// Maximum length of the version of Cyclone DDS, in bytes.
const MAX_VERSION_LEN: usize = 32;

/// Bit set of a participant's builtin endpoints (RTPS 2.5, 9.3.2.12).
#[derive(Clone, Copy, Default, PartialEq, Eq, Hash, Debug)]
pub struct BuiltinEndpoints(pub u32);

/// One pair of a property list.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct Property {
    /// Name of the property.
    pub name: Box<str>,
    /// Value of the property.
    pub value: Box<str>,
}

/// The announcement of one participant.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct ParticipantAnnouncement {
    /// GUID of the participant.
    pub guid: Guid,
    /// Vendor of its DDS implementation.
    pub vendor: VendorId,
    /// Its protocol version; zero if not announced.
    pub protocol_version: ProtocolVersion,
    /// Lease duration: time without a message after which the participant is gone.
    pub lease: RtpsDuration,
    /// Its domain; `None` from Fast DDS 2.x, where the port implies it.
    pub domain_id: Option<DomainId>,
    /// Its domain's tag; empty is the default.
    pub domain_tag: String,
    /// Its entity name if it is plain text; Fast DDS puts the enclave here.
    pub entity_name: String,
    /// The ROS enclave; `None` if the participant is not one of ROS.
    pub enclave: Option<String>,
    /// Its properties, in announced order.
    pub properties: Vec<Property>,
    /// Unicast locators of its discovery endpoints.
    pub metatraffic_unicast: Vec<Locator>,
    /// Multicast locators of its discovery endpoints.
    pub metatraffic_multicast: Vec<Locator>,
    /// Unicast locators of its user endpoints, unless an endpoint announces others.
    pub default_unicast: Vec<Locator>,
    /// Multicast locators of its user endpoints, unless an endpoint announces others.
    pub default_multicast: Vec<Locator>,
    /// Its builtin endpoints.
    pub builtin_endpoints: BuiltinEndpoints,
    /// Version of its implementation, such as `0.10.2`: Cyclone DDS, Fast DDS 3.0 and later, and
    /// RTI Connext announce it.
    pub product_version: Option<Box<str>>,
    /// Whether it authenticates its peers (DDS Security); its further discovery data may be
    /// encrypted.
    pub is_secured: bool,
    /// Whether it announced more locators or properties than are kept, or unreadable ones.
    pub is_truncated: bool,
}

/// Returns a version without its last octet if that is zero.
fn dotted([major, minor, release, revision]: [u8; 4]) -> Box<str> {
    match revision {
        0 => format!("{major}.{minor}.{release}"),
        _ => format!("{major}.{minor}.{release}.{revision}"),
    }
    .into()
}

/// Returns the version in the text of Cyclone DDS, such as `host/0.10.2/Linux/Linux`, which follows
/// five words (`wire/tests/data/datagrams/cyclone-spdp.bin`); `None` if it is not readable.
fn version_info(mut value: Cursor<'_>) -> Option<&str> {
    let what = "PID_ADLINK_PARTICIPANT_VERSION_INFO";
    value.take(what, 20).ok()?;
    let text = text::name(&mut value, what, MAX_NAME_LEN).ok()?;
    let version = text.split('/').nth(1)?;
    (1..=MAX_VERSION_LEN)
        .contains(&version.len())
        .then_some(version)
}

impl ParticipantAnnouncement {
    /// Creates an announcement with this identity and the default of every other field.
    #[must_use]
    pub fn new(guid: Guid, vendor: VendorId) -> Self {
        Self {
            guid,
            vendor,
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
            product_version: None,
            is_secured: false,
            is_truncated: false,
        }
    }

    /// Parses an SPDP payload.
    ///
    /// # Errors
    /// Fails if the list is malformed or lacks the participant's GUID.
    pub fn parse(payload: &[u8], sender: VendorId) -> Result<Self, WireError> {
        let parameters = ParameterList::encapsulated(payload)?;
        let invalid = WireError {
            what: "PID_PARTICIPANT_GUID",
            offset: 4,
            reason: Reason::BadValue,
        };
        let guid = guid(parameters, ParameterId::PARTICIPANT_GUID)?
            .filter(|guid| guid.entity == EntityId::PARTICIPANT)
            .ok_or(invalid)?;
        let mut participant = Self::new(guid, vendor(parameters, sender)?);
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
                // The name is not an identity, and is free text unless ROS set it.
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
            ParameterId::PRODUCT_VERSION
                if [VendorId::EPROSIMA, VendorId::RTI_CONNEXT].contains(&self.vendor) =>
            {
                let version = value.array("PID_PRODUCT_VERSION").ok();
                self.product_version = version.map(dotted);
            }
            ParameterId::CYCLONE_VERSION_INFO if self.vendor == VendorId::CYCLONE => {
                self.product_version = version_info(value).map(Into::into);
            }
            ParameterId::IDENTITY_TOKEN
            | ParameterId::PERMISSIONS_TOKEN
            | ParameterId::PARTICIPANT_SECURITY_INFO => self.is_secured = true,
            _ => {}
        }
        Ok(())
    }

    /// Returns whether ROS created the participant.
    #[must_use]
    pub const fn is_ros(&self) -> bool {
        self.enclave.is_some()
    }

    /// Returns the value of a property.
    #[must_use]
    pub fn property(&self, name: &str) -> Option<&str> {
        self.properties
            .iter()
            .find(|property| &*property.name == name)
            .map(|found| &*found.value)
    }

    /// Returns whether it is a Discovery Server of Fast DDS, which passes on what others announce.
    #[must_use]
    pub fn is_discovery_server(&self) -> bool {
        matches!(self.property("PARTICIPANT_TYPE"), Some("SERVER" | "BACKUP"))
    }

    /// Returns its host's name, which Cyclone DDS always and Fast DDS sometimes announces.
    #[must_use]
    pub fn host_name(&self) -> Option<&str> {
        self.property("__Hostname")
            .or_else(|| self.property("fastdds.physical_data.host"))
    }

    /// Returns its process's name, which Cyclone DDS announces.
    #[must_use]
    pub fn process_name(&self) -> Option<&str> {
        self.property("__ProcessName")
    }

    /// Returns its process id in its own PID namespace, which Cyclone DDS announces.
    #[must_use]
    pub fn process_id(&self) -> Option<u32> {
        self.property("__Pid")?.parse().ok()
    }

    /// Returns the low 16 bits of its process id, which Fast DDS puts into its GUIDs.
    #[must_use]
    pub fn process_id_low_bits(&self) -> Option<u16> {
        let prefix = Cursor::new(&self.guid.prefix.0, Endianness::Little);
        let mut rest = prefix;
        let vendor = VendorId(rest.array("guid prefix").ok()?);
        rest.take("guid prefix", 2).ok()?;
        (vendor == VendorId::EPROSIMA).then(|| rest.u16("guid prefix").ok())?
    }
}

/// Parses the properties and keeps the readable ones that fit. Properties are optional information,
/// so the others set the truncation flag only.
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
