//! Examines one topic: which of its writers and readers match, and which have no counterpart.

use std::collections::hash_map::Entry;
use std::collections::{BTreeMap, BTreeSet};

use foldhash::{HashMap, HashMapExt as _};
use ros2probe_wire::discovery::{Role, TypeHash};
use ros2probe_wire::qos::Durability;
use ros2probe_wire::rtps::VendorId;
use ros2probe_wire::{DomainId, Guid};

use super::Findings;
use super::partly_known_domains;
use crate::facts::diagnosis::{
    self, Diagnosis, Offer, Policies, Policy, QosPairs, TopicKey, Unmatched, Verdict,
};
use crate::facts::names::TypeName;
use crate::facts::topic_kind::TopicKind;
use crate::graph::discovery::{Discovery, Endpoint};
use crate::measure::topic::Topic;

/// Maximum number of incompatible pairs listed per topic.
const PAIRS_PER_TOPIC: usize = 32;
/// Maximum number of types and hashes listed in one finding.
const MAX_NAMED: usize = 16;

/// Examines topics, and holds the context of the examination.
#[derive(Debug)]
pub(super) struct EndpointExaminer<'a> {
    discovery: &'a Discovery,
    half_known: BTreeSet<DomainId>,
}

/// An endpoint without a counterpart. It becomes a finding if it stays without one.
#[derive(Debug)]
pub(super) struct UnmatchedEndpoint {
    pub(super) guid: Guid,
    pub(super) diagnosis: Diagnosis,
}

/// Which endpoints a participant can reach.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
enum Reach {
    /// It is on this host and announces loopback addresses only.
    Loopback,
    /// It is on another host.
    OtherHost,
    /// Another one on this host, or the host is unknown.
    Any,
}

/// Endpoints of one role with the same type, QoS, vendor and reach: their verdict against any
/// endpoint is the same.
#[derive(Debug)]
struct Group<'a> {
    message_type: &'a TypeName,
    offer: Offer<'a>,
    reach: Reach,
    members: Vec<Guid>,
    /// Why the group has no counterpart; `None` if it has one or may have one.
    unmatched: Option<Unmatched>,
}

impl Reach {
    const fn is_unreachable(self, other: Self) -> bool {
        matches!(
            (self, other),
            (Self::Loopback, Self::OtherHost) | (Self::OtherHost, Self::Loopback)
        )
    }
}

impl<'a> EndpointExaminer<'a> {
    pub(super) fn new(discovery: &'a Discovery) -> Self {
        let half_known = partly_known_domains(discovery);
        Self {
            discovery,
            half_known,
        }
    }

    /// Adds findings and returns the endpoints without a counterpart.
    pub(super) fn examine(&self, topic: &Topic, findings: &mut Findings) -> Vec<UnmatchedEndpoint> {
        let key = || TopicKey::of(topic.domain_id, &topic.naming);
        let mut writers = self.groups(&topic.writers);
        let mut readers = self.groups(&topic.readers);
        self.types(topic, &key, findings);
        compare(&mut writers, &mut readers, &key, findings);
        self.buffers(topic, &key, findings);
        if !needs_counterpart(topic) || self.half_known.contains(&topic.domain_id) {
            return Vec::new();
        }
        let groups = writers.iter().map(|group| (Role::Writer, group));
        let groups = groups.chain(readers.iter().map(|group| (Role::Reader, group)));
        let mut unmatched = Vec::new();
        for (role, group) in groups {
            let Some(reason) = group.unmatched else {
                continue;
            };
            for guid in &group.members {
                let topic = key();
                let diagnosis = match role {
                    Role::Writer => Diagnosis::UnmatchedPublisher {
                        topic,
                        writer: *guid,
                        reason,
                    },
                    Role::Reader => Diagnosis::UnmatchedSubscription {
                        topic,
                        reader: *guid,
                        reason,
                    },
                };
                unmatched.push(UnmatchedEndpoint {
                    guid: *guid,
                    diagnosis,
                });
            }
        }
        unmatched
    }

    /// Adds publishers that could send references to buffers, but send messages as a whole.
    fn buffers(&self, topic: &Topic, key: &impl Fn() -> TopicKey, findings: &mut Findings) {
        for writer in &topic.writers {
            let Some((of_writer, vendor)) = self.endpoint(*writer) else {
                continue;
            };
            let Some(own) = of_writer.backends.as_deref() else {
                continue;
            };
            let offer = Offer {
                qos: &of_writer.qos,
                vendor,
            };
            let (mut plain, mut shared) = (None, BTreeSet::new());
            for reader in &topic.readers {
                let Some((of_reader, vendor)) = self.endpoint(*reader) else {
                    continue;
                };
                let request = Offer {
                    qos: &of_reader.qos,
                    vendor,
                };
                if !findings.spend_steps(diagnosis::effort(offer.qos, request.qos)) {
                    findings.unexamined += 1;
                    return;
                }
                let is_matched = of_writer.message_type == of_reader.message_type
                    && offer.shares_protocol(request)
                    && diagnosis::verdict(offer, request) == Verdict::Match;
                match of_reader.backends.as_deref().filter(|_| is_matched) {
                    Some(other) => shared.extend(own.shared(other)),
                    None if is_matched => plain = plain.or(Some(*reader)),
                    None => {}
                }
            }
            let is_latched = of_writer.qos.durability != Durability::VOLATILE;
            if !shared.is_empty() && (is_latched || plain.is_some()) {
                findings.add(Diagnosis::BuffersByCpu {
                    topic: key(),
                    writer: *writer,
                    reader: plain,
                    backends: shared.into_iter().map(Into::into).collect(),
                });
            }
        }
    }

    /// Returns which endpoints a participant can reach. Where no participant is known to be on this
    /// host, as in a capture, each may reach all. So may one that was restored and has sent nothing
    /// since.
    fn reach(&self, guid: Guid) -> Reach {
        let Some(participant) = self.discovery.participants().get(&guid.prefix) else {
            return Reach::Any;
        };
        let addresses = &participant.addresses;
        let has_addresses = !addresses.metatraffic.is_empty() || !addresses.default.is_empty();
        if participant.restored.is_some() {
            return Reach::Any;
        }
        match (participant.local, addresses.reachable()) {
            (true, None) if has_addresses => Reach::Loopback,
            (false, Some(_)) => Reach::OtherHost,
            _ => Reach::Any,
        }
    }

    fn endpoint(&self, guid: Guid) -> Option<(&'a Endpoint, VendorId)> {
        let endpoint = self.discovery.endpoints().get(&guid)?;
        let participant = self.discovery.participants().get(&guid.prefix)?;
        Some((endpoint, participant.proxy.vendor))
    }

    fn groups(&self, guids: &[Guid]) -> Vec<Group<'a>> {
        let mut groups: Vec<Group<'a>> = Vec::new();
        let mut places: HashMap<_, usize> = HashMap::new();
        for guid in guids {
            let Some((endpoint, vendor)) = self.endpoint(*guid) else {
                continue;
            };
            let qos = &endpoint.qos;
            let (message_type, offer) = (&endpoint.message_type, Offer { qos, vendor });
            let reach = self.reach(*guid);
            match places.entry((message_type, offer, reach)) {
                Entry::Occupied(place) => {
                    if let Some(group) = groups.get_mut(*place.get()) {
                        group.members.push(*guid);
                    }
                }
                Entry::Vacant(place) => {
                    place.insert(groups.len());
                    groups.push(Group {
                        message_type,
                        offer,
                        reach,
                        members: vec![*guid],
                        unmatched: Some(Unmatched::NoEndpoint),
                    });
                }
            }
        }
        groups
    }

    /// Adds findings for several types, or several definitions of one type.
    fn types(&self, topic: &Topic, key: &impl Fn() -> TopicKey, findings: &mut Findings) {
        let mut types: BTreeMap<&TypeName, BTreeSet<TypeHash>> = BTreeMap::new();
        for guid in topic.writers.iter().chain(&topic.readers) {
            if let Some((endpoint, _)) = self.endpoint(*guid) {
                let hashes = types.entry(&endpoint.message_type).or_default();
                hashes.extend(endpoint.type_hash);
            }
        }
        if types.len() > 1 {
            findings.add(Diagnosis::TypeConflict {
                topic: key(),
                types: types.keys().take(MAX_NAMED).copied().cloned().collect(),
            });
        }
        for (message_type, hashes) in types.into_iter().filter(|(_, hashes)| hashes.len() > 1) {
            findings.add(Diagnosis::TypeHashConflict {
                topic: key(),
                message_type: message_type.clone(),
                hashes: hashes.into_iter().take(MAX_NAMED).collect(),
            });
        }
    }
}

/// Compares each group of writers with each group of readers.
fn compare<'a>(
    writers: &mut [Group<'a>],
    readers: &mut [Group<'a>],
    key: &impl Fn() -> TopicKey,
    findings: &mut Findings,
) {
    findings.start_topic();
    let mut counts = [0_u64; Policy::ALL.len()];
    let mut listed = 0;
    let mut open = writers.len() as u64 * readers.len() as u64;
    'all: for writer in &mut *writers {
        for reader in &mut *readers {
            if !findings.spend_steps(diagnosis::effort(writer.offer.qos, reader.offer.qos)) {
                break 'all;
            }
            open -= 1;
            if !writer.offer.shares_protocol(reader.offer) {
                continue;
            }
            let hindrance = if writer.message_type != reader.message_type {
                Some(Unmatched::Type)
            } else {
                match diagnosis::verdict(writer.offer, reader.offer) {
                    Verdict::Match => {
                        let is_apart = writer.reach.is_unreachable(reader.reach);
                        is_apart.then_some(Unmatched::Unreachable)
                    }
                    Verdict::Partition => Some(Unmatched::Partition),
                    Verdict::Incompatible(policies) => {
                        let pairs = writer.members.len() as u64 * reader.members.len() as u64;
                        for (count, policy) in counts.iter_mut().zip(Policy::ALL) {
                            *count += pairs * u64::from(policies.contains(policy));
                        }
                        let room = PAIRS_PER_TOPIC - listed;
                        let new = list(writer, reader, policies, room, key, findings);
                        findings.note_omitted(pairs - new as u64);
                        listed += new;
                        Some(Unmatched::Qos)
                    }
                }
            };
            for unmatched in [&mut writer.unmatched, &mut reader.unmatched] {
                *unmatched = unmatched.and_then(|before| Some(before.min(hindrance?)));
            }
        }
    }
    if open > 0 {
        // Groups that were not compared may have a counterpart.
        let groups = writers.iter_mut().chain(readers);
        groups.for_each(|group| group.unmatched = None);
        findings.unexamined += open;
    }
    for (policy, pairs) in Policy::ALL.into_iter().zip(counts) {
        if pairs > 0 {
            findings.qos_pairs.push(QosPairs {
                topic: key(),
                policy,
                pairs,
            });
        }
    }
}

/// Lists at most `room` pairs of these two groups. Returns the number of listed pairs.
fn list(
    writers: &Group<'_>,
    readers: &Group<'_>,
    policies: Policies,
    room: usize,
    key: &impl Fn() -> TopicKey,
    findings: &mut Findings,
) -> usize {
    let pairs = writers.members.iter().flat_map(|writer| {
        let readers = readers.members.iter();
        readers.map(move |reader| (*writer, *reader))
    });
    let mut count = 0;
    for (writer, reader) in pairs.take(room) {
        count += 1;
        findings.add(Diagnosis::QosIncompatible {
            topic: key(),
            writer,
            reader,
            policies,
        });
    }
    count
}

/// Returns whether an endpoint without a counterpart is a problem on this topic. It is not a
/// problem on topics that every node has anyway: `/rosout`, `/parameter_events`, a lifecycle node's
/// `transition_event`, hidden topics, and topics of services and actions.
fn needs_counterpart(topic: &Topic) -> bool {
    let naming = &topic.naming;
    naming.kind == TopicKind::Topic
        && !naming.hidden
        && !matches!(&*naming.name, "/rosout" | "/parameter_events")
        && !naming.name.ends_with("/transition_event")
}
