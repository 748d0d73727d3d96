//! State of participants, endpoints and nodes, and how a participant's domain is determined.

use std::collections::BTreeSet;
use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;

use ros2probe_wire::backends::Backends;
use ros2probe_wire::discovery::{EquivalenceHash, ParticipantAnnouncement, Role, TypeHash};
use ros2probe_wire::entities::NodeEntities;
use ros2probe_wire::names::DdsTopic;
use ros2probe_wire::qos::Qos;
use ros2probe_wire::rtps::{Locator, VendorId};
use ros2probe_wire::{DomainId, Guid, GuidPrefix, RtpsDuration, SequenceNumber};
use serde::{Deserialize, Serialize};

use super::eviction::MAX_SILENCE;
use super::priority::Priority;
use crate::facts::bounded::Bounded;
use crate::facts::model_time::ModelTime;
use crate::facts::names::{DdsName, NodeName, TypeName};
use crate::facts::naming::Naming;
use crate::facts::tables::ParticipantEndpoints;

/// Maximum number of addresses kept per participant and kind.
pub(super) const MAX_ADDRESSES: usize = 16;

/// Source of a participant's domain, from the least to the most reliable.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DomainSource {
    /// No source; domain 0 is assumed.
    Assumed,
    /// A unicast port in the range of discovery ports.
    UnicastPort,
    /// The multicast port of its announcements.
    MulticastPort,
    /// The announcement itself.
    Announced,
}

/// Origin of an announcement.
#[derive(Clone, Copy, Debug)]
pub struct Origin {
    /// Time of capture.
    pub at: ModelTime,
    /// GUID prefix of the sender, which may relay another participant's announcement.
    pub sender: GuidPrefix,
    /// Sequence number, assigned by the sender's writer.
    pub sequence_number: SequenceNumber,
    /// Destination address, IPv4-mapped for IPv4.
    pub destination: [u8; 16],
    /// Destination port.
    pub port: u16,
}

/// Properties that a participant announces.
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
    /// Lease duration.
    pub lease: RtpsDuration,
    /// Whether it announces DDS security.
    pub secured: bool,
    /// Whether its endpoints accept shared memory, unless they announce otherwise.
    pub shared_memory: bool,
    /// Whether its endpoints receive by TCP and not by UDP, unless they announce otherwise.
    pub tcp: bool,
    /// Whether it announces its endpoints by TCP and not by UDP.
    pub announces_by_tcp: bool,
    /// Whether it is a Discovery Server.
    pub discovery_server: bool,
    /// Version of its implementation, if announced.
    pub product_version: Option<Arc<str>>,
}

/// Unicast addresses of a participant.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Addresses {
    /// UDP addresses of its discovery endpoints.
    pub metatraffic: Box<[SocketAddr]>,
    /// UDP addresses of its other endpoints.
    pub default: Box<[SocketAddr]>,
    /// Addresses at which it accepts TCP connections.
    #[serde(default)]
    pub tcp: Box<[SocketAddr]>,
}

impl Addresses {
    /// Returns the first one that other hosts can reach.
    #[must_use]
    pub fn reachable(&self) -> Option<IpAddr> {
        self.hosts().next()
    }

    /// Returns whether the participant accepts TCP connections at this address. Fast DDS uses the
    /// loopback address for participants of its host, which announce other ones.
    #[must_use]
    pub fn accepts_tcp(&self, at: SocketAddr) -> bool {
        let is_own = |address: &SocketAddr| {
            let is_same = address.ip() == at.ip() || at.ip().is_loopback();
            address.port() == at.port() && is_same
        };
        self.tcp.iter().any(is_own)
    }

    /// Returns whether both have addresses that other hosts can reach, and none in common.
    #[must_use]
    pub fn are_apart(&self, other: &Self) -> bool {
        let has_both = self.reachable().is_some() && other.reachable().is_some();
        let is_common = |address: IpAddr| other.hosts().any(|each| each == address);
        has_both && !self.hosts().any(is_common)
    }

    /// Returns the addresses that other hosts can reach.
    fn hosts(&self) -> impl Iterator<Item = IpAddr> + '_ {
        let all = self.metatraffic.iter().chain(&self.default);
        let all = all.map(SocketAddr::ip);
        all.filter(|address| !address.is_loopback())
    }
}

/// A participant.
#[derive(Debug)]
pub struct Participant {
    /// Announced properties.
    pub proxy: ParticipantProxy,
    /// Unicast addresses.
    pub addresses: Addresses,
    /// Time of restoration from saved state, until its first packet.
    pub restored: Option<ModelTime>,
    /// Its domain.
    pub domain_id: DomainId,
    /// Time of the first announcement.
    pub first_seen: ModelTime,
    /// Time of its last packet.
    pub last_seen: ModelTime,
    /// Its endpoints.
    pub endpoints: Bounded<ParticipantEndpoints, BTreeSet<Guid>>,
    /// Its nodes.
    pub nodes: Vec<Node>,
    /// Number of its endpoints whose topics are watched by exact name.
    pub(super) watched: usize,
    /// Whether a socket on this host sends for it.
    pub(crate) local: bool,
    /// Whether one of its messages came by TCP.
    pub(super) came_by_tcp: bool,
    /// Participants that have announced it, if it did not announce itself.
    pub(super) relayers: Option<Relayers>,
    /// Whether it has sent user data.
    pub(super) sends: bool,
    pub(super) domain_source: DomainSource,
    /// Writer and number of the `ros_discovery_info` sample that announced the nodes.
    pub(super) nodes_from: Option<(Guid, SequenceNumber)>,
}

/// A node.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Node {
    /// Fully qualified name.
    pub name: NodeName,
    /// Its writers.
    pub writers: Vec<Guid>,
    /// Its readers.
    pub readers: Vec<Guid>,
}

/// A writer or reader.
#[derive(Clone, Debug)]
pub struct Endpoint {
    /// Identity that ROS prints: the GUID, or with Zenoh the hash of the liveliness token.
    pub gid: [u8; 16],
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
    /// Hash of its complete type in XTypes.
    pub equivalence_hash: Option<EquivalenceHash>,
    /// Quality of service.
    pub qos: Arc<Qos>,
    /// Time of the first announcement.
    pub first_seen: ModelTime,
    /// Whether it accepts shared memory. `None` if it announces nothing; its participant's value
    /// then applies.
    pub shared_memory: Option<bool>,
    /// Whether it receives by TCP and not by UDP. `None` as above.
    pub tcp: Option<bool>,
    /// Whether it supports data sharing with endpoints on its host.
    pub data_sharing: bool,
    /// Whether it is a reader that announces a content filter.
    pub content_filter: bool,
    /// Backends of buffers; `None` if it has none.
    pub backends: Option<Arc<Backends>>,
    /// The endpoint of the base topic for which it carries buffers, if it announces one.
    pub base: Option<Guid>,
    /// Whether its topic is watched by exact name.
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
            tcp: Locator::are_tcp(&announcement.default_unicast),
            announces_by_tcp: Locator::are_tcp(&announcement.metatraffic_unicast),
            discovery_server: announcement.is_discovery_server()
                || is_discovery_server(announcement.guid.prefix),
            product_version: announcement.product_version.as_deref().map(Into::into),
        }
    }
}

/// Participants that relayed the announcement of another one: Discovery Servers. The first four are
/// known.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct Relayers {
    prefixes: [Option<GuidPrefix>; 4],
    /// When one was removed last. The others may keep the participant.
    ended: Option<ModelTime>,
}

impl Relayers {
    pub(super) fn of(prefixes: impl IntoIterator<Item = GuidPrefix>) -> Self {
        let mut relayers = Self::default();
        for prefix in prefixes {
            relayers.add(prefix);
        }
        relayers
    }

    /// Adds a relayer, and returns whether it is new.
    pub(super) fn add(&mut self, prefix: GuidPrefix) -> bool {
        self.ended = None;
        let is_known = self.iter().any(|known| known == prefix);
        let place = self.prefixes.iter_mut().find(|place| place.is_none());
        match place.filter(|_| !is_known) {
            Some(place) => {
                *place = Some(prefix);
                true
            }
            None => false,
        }
    }

    /// Forgets a relayer that was removed at this time.
    pub(super) fn remove(&mut self, prefix: GuidPrefix, at: ModelTime) {
        let place = self.prefixes.iter_mut().find(|it| **it == Some(prefix));
        if place.is_some_and(|place| place.take().is_some()) {
            self.ended = Some(at);
        }
    }

    pub(super) fn iter(&self) -> impl Iterator<Item = GuidPrefix> {
        self.prefixes.iter().copied().flatten()
    }
}

impl Addresses {
    pub(super) fn of(announcement: &ParticipantAnnouncement) -> Self {
        let udp = |locators: &[Locator]| {
            let addresses = locators.iter().filter_map(Locator::udp);
            addresses.take(MAX_ADDRESSES).collect()
        };
        let unicast =
            (announcement.metatraffic_unicast.iter()).chain(&announcement.default_unicast);
        let tcp: BTreeSet<_> = unicast.flat_map(Locator::tcp).collect();
        Self {
            metatraffic: udp(&announcement.metatraffic_unicast),
            default: udp(&announcement.default_unicast),
            tcp: tcp.into_iter().take(MAX_ADDRESSES).collect(),
        }
    }
}

impl Participant {
    /// Returns whether it announces its endpoints by TCP, and no message of it came by TCP.
    #[must_use]
    pub const fn announces_unseen(&self) -> bool {
        self.proxy.announces_by_tcp && !self.came_by_tcp
    }

    /// Records a packet of this participant.
    pub(super) fn seen(&mut self, at: ModelTime) {
        if self.restored.is_some_and(|restored| at > restored) {
            self.restored = None;
        }
        self.last_seen = self.last_seen.max(at);
    }

    /// Returns the end of its lease if no further packet arrives; `None` means never. A Discovery
    /// Server relays an announcement once, and disposes of the participant when its lease ends: the
    /// lease does not count while the server exists (`is_kept`).
    pub(super) fn lease_end(&self, is_kept: bool) -> Option<ModelTime> {
        let orphaned = self.relayers.as_ref().and_then(|relayers| relayers.ended);
        let orphaned = orphaned.filter(|_| !is_kept);
        let lease = match self.proxy.lease {
            RtpsDuration::Finite(lease) if !is_kept => lease,
            // The participant may have stopped while no agent ran, or no server will dispose of it.
            // So a lease without an end is limited.
            _ => self.restored.or(orphaned).map(|_| MAX_SILENCE)?,
        };
        Some(self.last_seen.max(orphaned.unwrap_or_default()) + lease)
    }

    /// Returns its priority in a full table.
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

    /// Truncates its writers and readers to `left` entries; returns whether any were removed.
    pub(super) fn cut(&mut self, left: &mut usize) -> bool {
        let mut is_cut = false;
        for list in [&mut self.writers, &mut self.readers] {
            is_cut |= list.len() > *left;
            list.truncate(*left);
            *left -= list.len();
        }
        is_cut
    }

    /// Returns its size in bytes.
    pub(super) fn bytes(&self) -> usize {
        let guids = self.writers.len() + self.readers.len();
        size_of::<Self>() + self.name.len() + guids * size_of::<Guid>()
    }
}

/// Returns the number of writers and readers that these nodes list.
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

/// Returns the participant's domain and its source. Without an announced domain, it follows from
/// the ports of discovery (RTPS 2.5, 9.6.2.3). The destination may be another participant: a client
/// of a Discovery Server announces itself at the server's port, which users choose. So the
/// participant's own unicast ports come first. A server itself has none that follows from a domain.
pub(super) fn domain(
    announcement: &ParticipantAnnouncement,
    origin: &Origin,
) -> (DomainId, DomainSource) {
    let announced = announcement.domain_id;
    if let Some(domain_id) = announced.filter(|domain_id| *domain_id <= DomainId::MAX) {
        return (domain_id, DomainSource::Announced);
    }
    let [first, .., a, _, _, _] = origin.destination;
    let is_multicast = first == 0xff || first == 0 && a & 0xf0 == 0xe0;
    if let Some(domain_id) = of_multicast(origin.port).filter(|_| is_multicast) {
        return (domain_id, DomainSource::MulticastPort);
    }
    let own = || {
        let locators = announcement.metatraffic_unicast.iter();
        locators.filter_map(Locator::udp)
    };
    let domain_id = match own().next() {
        Some(_) if !is_discovery_server(announcement.guid.prefix) => {
            own().find_map(|address| of_unicast(address.port()))
        }
        _ => of_unicast(origin.port),
    };
    match domain_id {
        Some(domain_id) => (domain_id, DomainSource::UnicastPort),
        None => (DomainId(0), DomainSource::Assumed),
    }
}

/// Returns the domain of a multicast port of discovery, which is 7400 + 250 d for domain d.
fn of_multicast(port: u16) -> Option<DomainId> {
    let offset = port.checked_sub(DomainId::PORT_BASE)?;
    let domain_id = DomainId(u32::from(offset / DomainId::PORT_GAIN));
    let is_base = offset.is_multiple_of(DomainId::PORT_GAIN);
    (is_base && domain_id <= DomainId::MAX).then_some(domain_id)
}

/// Returns the domain of a unicast port of discovery, which is 7410 + 250 d + 2 p for domain d and
/// participant p. Ports of 32768 and above are mostly ephemeral.
fn of_unicast(port: u16) -> Option<DomainId> {
    const FIRST_EPHEMERAL_PORT: u16 = 32_768;
    let offset = port.checked_sub(DomainId::PORT_BASE)?;
    let rest = offset % DomainId::PORT_GAIN;
    let is_discovery = rest >= 10 && rest.is_multiple_of(2) && port < FIRST_EPHEMERAL_PORT;
    is_discovery.then(|| DomainId(u32::from(offset / DomainId::PORT_GAIN)))
}

/// Returns whether this is the prefix of a Discovery Server of Fast DDS 2.x, which users choose by
/// number: `44.53.NN.5f.45.50.52.4f.53.49.4d.41`.
fn is_discovery_server(prefix: GuidPrefix) -> bool {
    matches!(&prefix.0, [b'D', b'S', _, name @ ..] if name == b"_EPROSIMA")
}

impl Endpoint {
    /// Returns the names of its topic; `None` if the name is invalid.
    #[must_use]
    pub fn naming(&self) -> Option<Naming> {
        let topic = DdsTopic::parse(&self.topic).ok()?;
        Some(Naming::of(&topic))
    }
}
