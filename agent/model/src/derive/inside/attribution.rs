//! Finds the domain and the node of a handle in the graph: by the participants of its process.
//!
//! A node is never guessed. A publisher belongs to the only node of its process that publishes its
//! topic, otherwise to the only node of the process. The same holds for subscriptions.

use std::collections::{BTreeMap, BTreeSet};

use foldhash::{HashMap, HashMapExt as _, HashSet};
use ros2probe_wire::discovery::Role;
use ros2probe_wire::{DomainId, GuidPrefix};

use super::tracked::{Kind, Tracked};
use crate::facts::names::{NodeName, TopicName};
use crate::facts::naming::Naming;
use crate::graph::discovery::{Discovery, Participant};
use crate::measure::receivers::Receivers;

/// The graph of the observed processes.
#[derive(Debug, Default)]
pub(super) struct Attribution {
    processes: HashMap<u32, ProcessGraph>,
    /// Participants of all of these processes.
    pub(super) all: HashSet<GuidPrefix>,
}

/// Participants, nodes and endpoints of one process.
#[derive(Debug, Default)]
struct ProcessGraph {
    participants: BTreeSet<GuidPrefix>,
    domain_ids: BTreeSet<DomainId>,
    nodes: BTreeSet<NodeName>,
    writers: Endpoints,
    readers: Endpoints,
}

/// Domains and nodes of the endpoints of each topic.
type Endpoints = BTreeMap<TopicName, BTreeSet<(DomainId, Option<NodeName>)>>;

impl Attribution {
    /// Collects the graph of these processes.
    pub(super) fn of(
        processes: &BTreeSet<u32>,
        discovery: &Discovery,
        receivers: &Receivers,
    ) -> Self {
        let holders = receivers.holders();
        let mut found = Self::default();
        let mut announced: BTreeMap<u32, Vec<GuidPrefix>> = BTreeMap::new();
        for (prefix, participant) in discovery.participants() {
            let holder = holders.get(prefix).and_then(|facts| facts.process_id);
            match (holder, participant.proxy.process_id) {
                (Some(id), _) if processes.contains(&id) => {
                    found.add(id, *prefix, participant, discovery);
                }
                (None, Some(id)) => announced.entry(id).or_default().push(*prefix),
                _ => {}
            }
        }
        // If no socket shows the process, an announced process id must be unique among participants
        // and processes. Fast DDS announces only the low 16 bits.
        for id in processes {
            if found.processes.contains_key(id) {
                continue;
            }
            let low = id & 0xffff;
            let alike = processes.iter().filter(|other| **other & 0xffff == low);
            let mut prefixes = announced.get(id).into_iter().flatten().collect::<Vec<_>>();
            if low != *id && alike.count() == 1 {
                prefixes.extend(announced.get(&low).into_iter().flatten());
            }
            if let [prefix] = prefixes[..]
                && let Some(participant) = discovery.participants().get(prefix)
            {
                found.add(*id, *prefix, participant, discovery);
            }
        }
        found
    }

    fn add(
        &mut self,
        process: u32,
        prefix: GuidPrefix,
        participant: &Participant,
        discovery: &Discovery,
    ) {
        self.all.insert(prefix);
        let graph = self.processes.entry(process).or_default();
        graph.participants.insert(prefix);
        graph.domain_ids.insert(participant.domain_id);
        let mut owners = HashMap::new();
        for node in &participant.nodes {
            graph.nodes.insert(node.name.clone());
            for guid in node.writers.iter().chain(&node.readers) {
                owners.insert(*guid, &node.name);
            }
        }
        for guid in &participant.endpoints {
            let Some(endpoint) = discovery.endpoints().get(guid) else {
                continue;
            };
            // Nodes announce no buffer endpoints.
            let is_named = |naming: &Naming| !naming.kind.is_service() && !naming.is_buffer;
            let Some(naming) = endpoint.naming().filter(is_named) else {
                continue;
            };
            let endpoints = match endpoint.role {
                Role::Writer => &mut graph.writers,
                Role::Reader => &mut graph.readers,
            };
            let node = owners.get(guid).map(|name| (*name).clone());
            let places = endpoints.entry(naming.name).or_default();
            places.insert((endpoint.domain_id, node));
        }
    }

    /// Sets the domain and node of a handle of this process. `reported` are the nodes that the
    /// process created while it was observed, `domain_id` is the domain of its environment.
    pub(super) fn resolve(
        &self,
        process: u32,
        domain_id: DomainId,
        reported: &[NodeName],
        tracked: &mut Tracked,
    ) {
        let graph = self.processes.get(&process);
        let places = graph.zip(tracked.figures.topic.as_ref());
        let places = places.and_then(|(graph, topic)| match tracked.figures.kind {
            Kind::Publisher => graph.writers.get(topic),
            Kind::Subscription | Kind::Buffer | Kind::Callback => graph.readers.get(topic),
        });
        let places = places.into_iter().flatten();
        let own = only(places.clone().map(|(domain_id, _)| domain_id));
        tracked.domain_id = own
            .copied()
            .unwrap_or_else(|| self.domain(process, domain_id));
        if tracked.figures.node.is_some() {
            tracked.node.clone_from(&tracked.figures.node);
            return;
        }
        let mut owners = places.map(|(_, node)| node).collect::<BTreeSet<_>>();
        let is_known = !owners.is_empty() && !owners.remove(&None);
        let node = match is_known {
            true => only(owners.into_iter().flatten()).cloned(),
            false => None,
        };
        tracked.node = node.or_else(|| self.node(process, reported));
    }

    /// Returns the domain of this process, or `otherwise` if its participants are not known or in
    /// several domains.
    pub(super) fn domain(&self, process: u32, otherwise: DomainId) -> DomainId {
        let graph = self.processes.get(&process);
        let own = graph.and_then(|graph| only(graph.domain_ids.iter()));
        own.copied().unwrap_or(otherwise)
    }

    /// Returns the participants of this process.
    pub(super) fn participants(&self, process: u32) -> BTreeSet<GuidPrefix> {
        let graph = self.processes.get(&process);
        graph.map_or_else(BTreeSet::new, |graph| graph.participants.clone())
    }

    /// Returns the only node of this process, or `None` if it has several.
    pub(super) fn node(&self, process: u32, reported: &[NodeName]) -> Option<NodeName> {
        only(self.nodes(process, reported).iter()).cloned()
    }

    /// Returns all known nodes of this process.
    pub(super) fn nodes(&self, process: u32, reported: &[NodeName]) -> BTreeSet<NodeName> {
        let graph = self.processes.get(&process);
        let graph = graph.into_iter().flat_map(|graph| &graph.nodes);
        graph.chain(reported).cloned().collect()
    }
}

/// Returns the value if all values are equal, or `None` if they differ or do not exist.
fn only<'a, T: PartialEq + 'a>(mut values: impl Iterator<Item = &'a T>) -> Option<&'a T> {
    let first = values.next()?;
    values.all(|other| other == first).then_some(first)
}
