//! Discovery state as plain data that outlives the agent.
//!
//! Most announcements are sent once, so an agent that restarts on a running robot would know GUIDs
//! without names. Restored entries are valid for one lease. A participant that sends a packet
//! within that time stays, with all its entries. Encoding and files are the caller's task. Restored
//! data is validated like any other external input.

use std::sync::Arc;
use std::time::Duration;

use ros2probe_wire::backends::Backends;
use ros2probe_wire::discovery::{EquivalenceHash, Role, TypeHash};
use ros2probe_wire::names::{DdsTopic, RosType};
use ros2probe_wire::qos::{
    AccessScope, DataRepresentation, DestinationOrder, Durability, History, HistoryKind,
    Liveliness, Ownership, Presentation, Qos, Reliability,
};
use ros2probe_wire::rtps::VendorId;
use ros2probe_wire::{DomainId, EntityId, Guid, GuidPrefix, RtpsDuration, SequenceNumber, time};
use serde::{Deserialize, Serialize};

use super::Change;
use super::Discovery;
use super::MAX_NAME_LEN;
use super::facts::{
    Addresses, DomainSource, Endpoint, Node, Participant, ParticipantProxy, Relayers, named,
};
use crate::facts::bounded::Bounded;
use crate::facts::model_time::ModelTime;
use crate::facts::tables::ParticipantEndpoints;
use crate::graph::zenoh::ZenohMemory;

/// All participants with their endpoints and nodes.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Memory {
    /// Participants, sorted by GUID prefix.
    pub participants: Vec<Remembered>,
    /// Connections of Zenoh; older agents did not save them.
    #[serde(default)]
    pub zenoh: ZenohMemory,
}

/// A participant with its endpoints and nodes. GUIDs and vendors are hexadecimal.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Remembered {
    prefix: String,
    vendor: String,
    domain_id: u32,
    domain_source: DomainSource,
    enclave: Option<String>,
    host: Option<String>,
    process_name: Option<String>,
    process_id: Option<u32>,
    /// Lease in nanoseconds; here and below, `None` is infinite.
    lease: Option<u64>,
    secured: bool,
    #[serde(default)]
    shared_memory: bool,
    #[serde(default)]
    tcp: bool,
    #[serde(default)]
    announces_by_tcp: bool,
    #[serde(default)]
    discovery_server: bool,
    /// GUID prefixes of the participants that relayed it; older agents did not save them.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    relayers: Option<Vec<String>>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    product_version: Option<String>,
    addresses: Addresses,
    nodes: Vec<RememberedNode>,
    /// Writer and number of the sample that announced the nodes.
    nodes_from: Option<(String, u64)>,
    endpoints: Vec<RememberedEndpoint>,
}

#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
struct RememberedNode {
    name: String,
    writers: Vec<String>,
    readers: Vec<String>,
}

#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
struct RememberedEndpoint {
    guid: String,
    /// With Zenoh, the hash of the liveliness token.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    gid: Option<String>,
    topic: String,
    message_type: String,
    type_hash: Option<String>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    equivalence_hash: Option<String>,
    reliability: u32,
    durability: u32,
    history: Option<(u32, i32)>,
    deadline: Option<u64>,
    lifespan: Option<u64>,
    liveliness: u32,
    liveliness_lease: Option<u64>,
    ownership: u32,
    /// Older agents did not save it.
    #[serde(default)]
    ownership_strength: i32,
    minimum_separation: Option<u64>,
    partitions: Vec<String>,
    /// Properties that only matching needs; older agents did not save them.
    #[serde(default)]
    matching: Matching,
    #[serde(default)]
    shared_memory: Option<bool>,
    #[serde(default)]
    tcp: Option<bool>,
    #[serde(default)]
    data_sharing: bool,
    #[serde(default)]
    content_filter: bool,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    backends: Option<Vec<String>>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    base: Option<String>,
}

#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
struct Matching {
    latency_budget: Option<u64>,
    destination_order: u32,
    access_scope: u32,
    coherent: bool,
    ordered: bool,
    representations: Vec<i16>,
}

/// Maximum number of data representations restored per endpoint.
const MAX_REPRESENTATIONS: usize = 8;

impl Discovery {
    /// Returns the state to save.
    #[must_use]
    pub fn memory(&self) -> Memory {
        let mut participants: Vec<_> = self.participants.iter().collect();
        participants.sort_unstable_by_key(|(prefix, _)| **prefix);
        let remembered = participants.into_iter().map(|(prefix, participant)| {
            let endpoints = participant.endpoints.iter();
            let endpoints = endpoints.filter_map(|guid| {
                let endpoint = self.endpoints.get(guid)?;
                Some(RememberedEndpoint::of(*guid, endpoint))
            });
            Remembered::of(*prefix, participant, endpoints.collect())
        });
        Memory {
            participants: remembered.collect(),
            zenoh: ZenohMemory::default(),
        }
    }

    /// Restores saved state for one lease. Invalid entries and entries that discovery already knows
    /// are skipped. Restoring records no discovery events.
    pub fn restore(&mut self, memory: &Memory, now: ModelTime) {
        for remembered in &memory.participants {
            let Some((prefix, mut participant)) = remembered.participant(now) else {
                continue;
            };
            if self.participants.contains_key(&prefix) {
                continue;
            }
            if self.participants.is_full() {
                self.participants.refuse();
                continue;
            }
            let room = self.node_count.remaining();
            let cut = participant.nodes.len().saturating_sub(room) as u64;
            self.node_count.refuse_all(cut);
            participant.nodes.truncate(room);
            self.node_count.add(participant.nodes.len());
            let mut names = self.caps.endpoints.saturating_sub(self.named);
            names = names.min(ParticipantEndpoints::CAP);
            for node in &mut participant.nodes {
                self.node_count.refuse_all(node.cut(&mut names).into());
            }
            self.named += named(&participant.nodes);
            for endpoint in remembered.endpoints.iter().take(ParticipantEndpoints::CAP) {
                let domain_id = participant.domain_id;
                let Some((guid, endpoint)) = endpoint.endpoint(prefix, domain_id, now) else {
                    continue;
                };
                if self.endpoints.is_full() {
                    self.endpoints.refuse();
                    continue;
                }
                if participant.endpoints.insert(guid) {
                    self.endpoints.insert(guid, Box::new(endpoint));
                    self.changes.push(Change::Appeared(guid));
                }
            }
            self.participants.insert(prefix, Box::new(participant));
            self.rate(prefix);
        }
    }
}

impl Remembered {
    fn of(
        prefix: GuidPrefix,
        participant: &Participant,
        endpoints: Vec<RememberedEndpoint>,
    ) -> Self {
        let proxy = &participant.proxy;
        let text = |text: &Option<Arc<str>>| text.as_deref().map(str::to_owned);
        let [first, second] = proxy.vendor.0;
        Self {
            prefix: prefix.to_string(),
            vendor: format!("{first:02x}{second:02x}"),
            domain_id: participant.domain_id.0,
            domain_source: participant.domain_source,
            enclave: text(&proxy.enclave),
            host: text(&proxy.host),
            process_name: text(&proxy.process_name),
            process_id: proxy.process_id,
            lease: nanoseconds(proxy.lease),
            secured: proxy.secured,
            shared_memory: proxy.shared_memory,
            tcp: proxy.tcp,
            announces_by_tcp: proxy.announces_by_tcp,
            discovery_server: proxy.discovery_server,
            relayers: participant.relayers.as_ref().map(|relayers| {
                let prefixes = relayers.iter().map(|prefix| prefix.to_string());
                prefixes.collect()
            }),
            product_version: text(&proxy.product_version),
            addresses: participant.addresses.clone(),
            nodes: participant.nodes.iter().map(RememberedNode::of).collect(),
            nodes_from: participant
                .nodes_from
                .map(|(writer, number)| (digits(writer), number.0)),
            endpoints,
        }
    }

    fn participant(&self, now: ModelTime) -> Option<(GuidPrefix, Participant)> {
        let prefix = GuidPrefix(hexadecimal(&self.prefix)?);
        let texts = [
            &self.enclave,
            &self.host,
            &self.process_name,
            &self.product_version,
        ];
        let all_plain = texts.into_iter().flatten().all(|text| is_plain(text));
        let domain_id = DomainId::try_from(self.domain_id).ok()?;
        if !all_plain {
            return None;
        }
        let text = |text: &Option<String>| text.as_deref().map(Into::into);
        let nodes_from = self.nodes_from.as_ref();
        let participant = Participant {
            proxy: ParticipantProxy {
                vendor: VendorId(hexadecimal(&self.vendor)?),
                enclave: text(&self.enclave),
                host: text(&self.host),
                process_name: text(&self.process_name),
                process_id: self.process_id,
                lease: duration(self.lease),
                secured: self.secured,
                shared_memory: self.shared_memory,
                tcp: self.tcp,
                announces_by_tcp: self.announces_by_tcp,
                discovery_server: self.discovery_server,
                product_version: text(&self.product_version),
            },
            addresses: self.addresses.clone(),
            restored: Some(now),
            domain_id,
            first_seen: now,
            last_seen: now,
            endpoints: Bounded::default(),
            nodes: self.nodes.iter().filter_map(RememberedNode::node).collect(),
            watched: 0,
            local: false,
            came_by_tcp: false,
            relayers: self.relayers.as_ref().map(|prefixes| {
                let prefixes = prefixes.iter().filter_map(|prefix| hexadecimal(prefix));
                Relayers::of(prefixes.map(GuidPrefix))
            }),
            sends: false,
            domain_source: self.domain_source,
            nodes_from: nodes_from.and_then(|(writer, number)| {
                Some((guid(writer, prefix)?, SequenceNumber(*number)))
            }),
        };
        Some((prefix, participant))
    }
}

impl RememberedNode {
    fn of(node: &Node) -> Self {
        let all = |guids: &[Guid]| guids.iter().map(|guid| digits(*guid)).collect();
        Self {
            name: node.name.to_string(),
            writers: all(&node.writers),
            readers: all(&node.readers),
        }
    }

    fn node(&self) -> Option<Node> {
        let all = |texts: &[String]| -> Option<Vec<Guid>> {
            let guids = texts
                .iter()
                .map(|text| hexadecimal(text).map(Guid::from_bytes));
            guids.collect()
        };
        is_plain(&self.name).then_some(())?;
        Some(Node {
            name: self.name.as_str().into(),
            writers: all(&self.writers)?,
            readers: all(&self.readers)?,
        })
    }
}

impl RememberedEndpoint {
    fn of(guid: Guid, endpoint: &Endpoint) -> Self {
        let qos = &endpoint.qos;
        Self {
            guid: digits(guid),
            gid: (endpoint.gid != guid.to_bytes()).then(|| digits(Guid::from_bytes(endpoint.gid))),
            topic: endpoint.topic.to_string(),
            message_type: endpoint.message_type.to_string(),
            type_hash: endpoint.type_hash.as_ref().map(TypeHash::to_string),
            equivalence_hash: endpoint.equivalence_hash.map(|hash| hash.to_string()),
            reliability: qos.reliability.0,
            durability: qos.durability.0,
            history: qos.history.map(|history| (history.kind.0, history.depth)),
            deadline: nanoseconds(qos.deadline),
            lifespan: nanoseconds(qos.lifespan),
            liveliness: qos.liveliness.0,
            liveliness_lease: nanoseconds(qos.liveliness_lease),
            ownership: qos.ownership.0,
            ownership_strength: qos.ownership_strength,
            minimum_separation: nanoseconds(qos.minimum_separation),
            partitions: qos.partitions.iter().map(ToString::to_string).collect(),
            matching: Matching::of(qos),
            shared_memory: endpoint.shared_memory,
            tcp: endpoint.tcp,
            data_sharing: endpoint.data_sharing,
            content_filter: endpoint.content_filter,
            backends: endpoint
                .backends
                .as_deref()
                .map(|backends| backends.names().map(str::to_owned).collect()),
            base: endpoint.base.map(digits),
        }
    }

    fn endpoint(
        &self,
        prefix: GuidPrefix,
        domain_id: DomainId,
        now: ModelTime,
    ) -> Option<(Guid, Endpoint)> {
        let guid = guid(&self.guid, prefix)?;
        let role = match guid.entity {
            entity if entity.is_writer() => Role::Writer,
            entity if entity.is_reader() => Role::Reader,
            _ => return None,
        };
        let topic = DdsTopic::parse(&self.topic).ok()?;
        let message_type = RosType::parse(&self.message_type).ok()?;
        let names = [topic.as_str(), message_type.as_str()];
        let fits = names.iter().all(|name| name.len() <= MAX_NAME_LEN);
        if !fits || !self.partitions.iter().all(|name| is_plain(name)) {
            return None;
        }
        let history = |(kind, depth)| History {
            kind: HistoryKind(kind),
            depth,
        };
        let gid = match &self.gid {
            Some(gid) => hexadecimal(gid)?,
            None => guid.to_bytes(),
        };
        let endpoint = Endpoint {
            gid,
            role,
            domain_id,
            topic: topic.as_str().into(),
            message_type: message_type.as_str().into(),
            type_hash: self.type_hash.as_deref().and_then(TypeHash::parse),
            equivalence_hash: self
                .equivalence_hash
                .as_deref()
                .and_then(EquivalenceHash::parse),
            qos: Arc::new(Qos {
                reliability: Reliability(self.reliability),
                durability: Durability(self.durability),
                history: self.history.map(history),
                deadline: duration(self.deadline),
                lifespan: duration(self.lifespan),
                liveliness: Liveliness(self.liveliness),
                liveliness_lease: duration(self.liveliness_lease),
                ownership: Ownership(self.ownership),
                ownership_strength: self.ownership_strength,
                minimum_separation: duration(self.minimum_separation),
                partitions: self
                    .partitions
                    .iter()
                    .map(|name| name.as_str().into())
                    .collect(),
                latency_budget: duration(self.matching.latency_budget),
                destination_order: DestinationOrder(self.matching.destination_order),
                presentation: self.matching.presentation(),
                representations: self.matching.representations(),
            }),
            first_seen: now,
            shared_memory: self.shared_memory,
            tcp: self.tcp,
            data_sharing: self.data_sharing,
            content_filter: self.content_filter,
            backends: self
                .backends
                .as_ref()
                .map(|names| Arc::new(Backends::of(names.iter().map(String::as_str)))),
            base: self.base.as_deref().and_then(Guid::of_digits),
            watched: false,
        };
        Some((guid, endpoint))
    }
}

impl Matching {
    fn of(qos: &Qos) -> Self {
        let Presentation {
            access_scope,
            is_coherent: coherent,
            is_ordered: ordered,
        } = qos.presentation;
        Self {
            latency_budget: nanoseconds(qos.latency_budget),
            destination_order: qos.destination_order.0,
            access_scope: access_scope.0,
            coherent,
            ordered,
            representations: qos.representations.iter().map(|each| each.0).collect(),
        }
    }

    fn presentation(&self) -> Presentation {
        Presentation {
            access_scope: AccessScope(self.access_scope),
            is_coherent: self.coherent,
            is_ordered: self.ordered,
        }
    }

    fn representations(&self) -> Vec<DataRepresentation> {
        let kept = self.representations.iter().take(MAX_REPRESENTATIONS);
        kept.copied().map(DataRepresentation).collect()
    }
}

impl Default for Matching {
    /// Returns the properties that nearly all endpoints have.
    fn default() -> Self {
        Self::of(&Qos::defaults(Role::Writer, VendorId::EPROSIMA))
    }
}

fn digits(guid: Guid) -> String {
    format!("{}{}", guid.prefix, guid.entity)
}

/// Parses a GUID of this participant.
fn guid(text: &str, prefix: GuidPrefix) -> Option<Guid> {
    let guid = Guid::from_bytes(hexadecimal(text)?);
    (guid.prefix == prefix && guid.entity != EntityId::PARTICIPANT).then_some(guid)
}

/// Parses `N` bytes from exactly `2 * N` hexadecimal digits.
#[must_use]
pub fn hexadecimal<const N: usize>(text: &str) -> Option<[u8; N]> {
    let (pairs, []) = text.as_bytes().as_chunks::<2>() else {
        return None;
    };
    let pairs: &[[u8; 2]; N] = pairs.try_into().ok()?;
    let digit = |digit: u8| {
        char::from(digit)
            .to_digit(16)
            .and_then(|it| u8::try_from(it).ok())
    };
    let mut bytes = [0; N];
    for (byte, [high, low]) in bytes.iter_mut().zip(pairs) {
        *byte = digit(*high)? << 4 | digit(*low)?;
    }
    Some(bytes)
}

/// Returns whether the text satisfies the rules for names on the wire. Some releases announce the
/// root enclave as an empty string.
fn is_plain(text: &str) -> bool {
    text.is_empty() || text.len() <= MAX_NAME_LEN && DdsTopic::parse(text).is_ok()
}

fn nanoseconds(duration: RtpsDuration) -> Option<u64> {
    duration.finite().map(time::nanoseconds)
}

fn duration(nanoseconds: Option<u64>) -> RtpsDuration {
    nanoseconds.map_or(RtpsDuration::Infinite, |nanoseconds| {
        RtpsDuration::Finite(Duration::from_nanos(nanoseconds))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hash_and_qos_for_matching_are_restored_and_may_be_missing_in_older_files() {
        let prefix = GuidPrefix([1; 12]);
        let guid = Guid::new(prefix, EntityId([0, 0, 1, 3]));
        let defaults = Qos::defaults(Role::Writer, VendorId::CYCLONE);
        let mut qos = defaults.clone();
        qos.latency_budget = RtpsDuration::Finite(Duration::from_nanos(7));
        qos.destination_order = DestinationOrder::BY_SOURCE_TIMESTAMP;
        qos.presentation.is_ordered = true;
        qos.representations = vec![DataRepresentation::XCDR2];
        let endpoint = Endpoint {
            gid: guid.to_bytes(),
            role: Role::Writer,
            domain_id: DomainId(0),
            topic: "rt/points".into(),
            message_type: "std_msgs/msg/String".into(),
            type_hash: None,
            equivalence_hash: Some(EquivalenceHash([7; 14])),
            qos: Arc::new(qos.clone()),
            first_seen: ModelTime::from_nanoseconds(1),
            shared_memory: None,
            tcp: None,
            data_sharing: false,
            content_filter: true,
            backends: None,
            base: None,
            watched: false,
        };
        let back = |kept: &serde_json::Value| {
            let kept: RememberedEndpoint = serde_json::from_value(kept.clone()).unwrap();
            kept.endpoint(prefix, DomainId(0), ModelTime::from_nanoseconds(2))
                .unwrap()
                .1
        };
        let mut kept = serde_json::to_value(RememberedEndpoint::of(guid, &endpoint)).unwrap();
        let restored = back(&kept);
        assert_eq!(*restored.qos, qos);
        assert_eq!(restored.equivalence_hash, endpoint.equivalence_hash);
        assert!(restored.content_filter);
        for key in ["matching", "equivalence_hash", "content_filter"] {
            kept.as_object_mut().unwrap().remove(key).unwrap();
        }
        let restored = back(&kept);
        assert_eq!(
            (&*restored.qos, restored.equivalence_hash),
            (&defaults, None)
        );
        assert!(!restored.content_filter);
    }

    #[test]
    fn hexadecimal_text_without_two_digits_per_byte_is_refused() {
        assert_eq!(hexadecimal("010f"), Some([1, 15]));
        assert_eq!(hexadecimal("FFa0"), Some([255, 160]));
        for wrong in ["", "01", "010", "010f00", "01g0", "+1+1", "01 f"] {
            assert_eq!(hexadecimal::<2>(wrong), None, "{wrong:?}");
        }
    }
}
