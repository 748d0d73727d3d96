//! What is kept of participants, endpoints and nodes, and where a participant's domain is read
//! from.

use std::collections::BTreeSet;
use std::net::SocketAddr;
use std::sync::Arc;

use ros2probe_wire::discovery::{ParticipantAnnouncement, Role, TypeHash};
use ros2probe_wire::entities::NodeEntities;
use ros2probe_wire::qos::Qos;
use ros2probe_wire::rtps::{Locator, VendorId};
use ros2probe_wire::{DomainId, Duration, Guid, GuidPrefix, SequenceNumber, Timestamp};
use serde::{Deserialize, Serialize};

use super::priority::Priority;
use crate::names::{DdsName, NodeName, TypeName};

/// Addresses kept of one participant and kind.
pub(super) const ADDRESSES: usize = 16;

/// How sure a participant's domain is, least first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DomainSource {
    /// Nothing told.
    Assumed,
    /// A unicast port that has the form of a discovery port.
    UnicastPort,
    /// The multicast port it announces itself on.
    MulticastPort,
    /// It said so.
    Announced,
}

/// Where an announcement came from.
#[derive(Clone, Copy, Debug)]
pub struct Origin {
    /// When.
    pub at: Timestamp,
    /// Who sent it, perhaps on somebody else's behalf.
    pub sender: GuidPrefix,
    /// Its number among those of its writer.
    pub sequence_number: SequenceNumber,
    /// Destination address, IPv4-mapped for IPv4.
    pub destination: [u8; 16],
    /// Destination port.
    pub port: u16,
}

/// What a participant says about itself, as far as it is shown.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ParticipantProxy {
    /// Implementation.
    pub vendor: VendorId,
    /// ROS enclave.
    pub enclave: Option<Arc<str>>,
    /// Host name.
    pub host: Option<Arc<str>>,
    /// Process name.
    pub process_name: Option<Arc<str>>,
    /// Process id, or its low 16 bits.
    pub process_id: Option<u32>,
    /// Lease.
    pub lease: Duration,
    /// Announces security.
    pub secured: bool,
    /// Its endpoints can be reached through shared memory, unless they say otherwise.
    pub shared_memory: bool,
}

/// Where a participant is reached over UDP by unicast.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Addresses {
    /// Its discovery endpoints.
    pub metatraffic: Box<[SocketAddr]>,
    /// Its other endpoints.
    pub default: Box<[SocketAddr]>,
}

/// One participant.
#[derive(Debug)]
pub struct Participant {
    /// What it says.
    pub proxy: ParticipantProxy,
    /// Where it is reached.
    pub addresses: Addresses,
    /// Known from before the agent's start, restored then, and not heard since.
    pub restored: Option<Timestamp>,
    /// Its domain.
    pub domain_id: DomainId,
    /// First announcement.
    pub first_seen: Timestamp,
    /// Last sign of life.
    pub last_seen: Timestamp,
    /// Its endpoints.
    pub endpoints: BTreeSet<Guid>,
    /// Its nodes.
    pub nodes: Vec<Node>,
    /// Its announcements of readers were seen from the first on.
    pub all_readers_announced: bool,
    /// Its endpoints whose topics are watched by their exact names.
    pub(super) watched: usize,
    /// A socket of this host sends for it.
    pub(super) local: bool,
    /// It has sent user data.
    pub(super) sends: bool,
    pub(super) domain_source: DomainSource,
    /// The `ros_discovery_info` sample that told the nodes.
    pub(super) nodes_from: Option<(Guid, SequenceNumber)>,
}

/// One node.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Node {
    /// Fully qualified name.
    pub name: NodeName,
    /// Its writers.
    pub writers: Vec<Guid>,
    /// Its readers.
    pub readers: Vec<Guid>,
}

/// One writer or reader.
#[derive(Clone, Debug)]
pub struct Endpoint {
    /// Writer or reader.
    pub role: Role,
    /// Domain of its participant.
    pub domain_id: DomainId,
    /// DDS topic.
    pub topic: DdsName,
    /// ROS type.
    pub message_type: TypeName,
    /// RIHS01 hash.
    pub type_hash: Option<TypeHash>,
    /// Quality of service.
    pub qos: Arc<Qos>,
    /// First announcement.
    pub first_seen: Timestamp,
    /// Whether it can be reached through shared memory; `None` = as its participant.
    pub shared_memory: Option<bool>,
    /// It can share its history in memory with endpoints of its host.
    pub data_sharing: bool,
    /// Its topic is watched by its exact name.
    pub(super) watched: bool,
}

impl ParticipantProxy {
    pub(super) fn of(announcement: &ParticipantAnnouncement) -> Self {
        let low_bits = || announcement.process_id_low_bits().map(u32::from);
        Self {
            vendor: announcement.vendor,
            enclave: announcement.enclave.as_deref().map(Into::into),
            host: announcement.host_name().map(Into::into),
            process_name: announcement.process_name().map(Into::into),
            process_id: announcement.process_id().or_else(low_bits),
            lease: announcement.lease,
            secured: announcement.is_secured,
            shared_memory: announcement
                .default_unicast
                .iter()
                .any(Locator::is_shared_memory),
        }
    }
}

impl Addresses {
    pub(super) fn of(announcement: &ParticipantAnnouncement) -> Self {
        let udp = |locators: &[Locator]| {
            let addresses = locators.iter().filter_map(Locator::udp);
            addresses.take(ADDRESSES).collect()
        };
        Self {
            metatraffic: udp(&announcement.metatraffic_unicast),
            default: udp(&announcement.default_unicast),
        }
    }
}

impl Participant {
    /// A sign of life.
    pub(super) fn seen(&mut self, at: Timestamp) {
        if self.restored.is_some_and(|restored| at > restored) {
            self.restored = None;
        }
        self.last_seen = self.last_seen.max(at);
    }

    /// What it is worth when there is no room.
    pub(super) const fn priority(&self) -> Priority {
        Priority {
            watched: self.watched > 0,
            local: self.local,
            sends: self.sends,
        }
    }
}

impl Node {
    pub(super) fn of(node: &NodeEntities) -> Self {
        Self {
            name: node.fully_qualified_name().into(),
            writers: node.writers.clone(),
            readers: node.readers.clone(),
        }
    }

    /// Leaves it so many of its writers and readers at most; whether some had to go.
    pub(super) fn cut(&mut self, left: &mut usize) -> bool {
        let mut is_cut = false;
        for list in [&mut self.writers, &mut self.readers] {
            is_cut |= list.len() > *left;
            list.truncate(*left);
            *left -= list.len();
        }
        is_cut
    }

    /// What it takes.
    pub(super) fn bytes(&self) -> usize {
        let guids = self.writers.len() + self.readers.len();
        size_of::<Self>() + self.name.len() + guids * size_of::<Guid>()
    }
}

/// Writers and readers that these nodes name.
pub(super) fn named(nodes: &[Node]) -> usize {
    let named = |node: &Node| {
        let Node {
            name: _,
            writers,
            readers,
        } = node;
        writers.len() + readers.len()
    };
    nodes.iter().map(named).sum()
}

/// Lengths of a participant's lists.
pub(super) struct Lists {
    pub(super) endpoints: usize,
    pub(super) nodes: usize,
    pub(super) named: usize,
    /// Of the longer list.
    pub(super) addresses: usize,
}

impl Participant {
    pub(super) fn lists(&self) -> Lists {
        // A new list does not compile before it has a place here.
        let Self {
            proxy: _,
            addresses,
            restored: _,
            domain_id: _,
            first_seen: _,
            last_seen: _,
            endpoints,
            nodes,
            all_readers_announced: _,
            domain_source: _,
            nodes_from: _,
            watched: _,
            local: _,
            sends: _,
        } = self;
        let Addresses {
            metatraffic,
            default,
        } = addresses;
        Lists {
            endpoints: endpoints.len(),
            nodes: nodes.len(),
            named: named(nodes),
            addresses: metatraffic.len().max(default.len()),
        }
    }
}

/// The participant's domain: as announced, else by the port its announcement went to (RTPS 2.5,
/// 9.6.1.1: 7400 + 250 d, multicast + 0, unicast + 10 + 2 p), else 0. Ports from 32768 on are
/// mostly ephemeral ones and tell nothing.
pub(super) fn domain(announced: Option<DomainId>, origin: &Origin) -> (DomainId, DomainSource) {
    const EPHEMERAL: u16 = 32_768;
    if let Some(domain_id) = announced.filter(|domain_id| *domain_id <= DomainId::MAX) {
        return (domain_id, DomainSource::Announced);
    }
    let Some(offset) = origin.port.checked_sub(7400) else {
        return (DomainId(0), DomainSource::Assumed);
    };
    let (domain_id, rest) = (DomainId(u32::from(offset / 250)), offset % 250);
    let [first, .., a, _, _, _] = origin.destination;
    let is_multicast = first == 0xff || first == 0 && a & 0xf0 == 0xe0;
    if is_multicast && rest == 0 && domain_id <= DomainId::MAX {
        return (domain_id, DomainSource::MulticastPort);
    }
    if rest >= 10 && rest % 2 == 0 && origin.port < EPHEMERAL {
        return (domain_id, DomainSource::UnicastPort);
    }
    (DomainId(0), DomainSource::Assumed)
}
