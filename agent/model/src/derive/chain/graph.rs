//! The measured topics with a header that each node reads and writes.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use foldhash::{HashMap, HashMapExt as _};
use ros2probe_wire::{DomainId, Guid, GuidPrefix};

use crate::derive::trace::share::Share;
use crate::facts::diagnosis::TopicKey;
use crate::facts::header::begins_with_header;
use crate::facts::names::{NodeName, TopicName, TypeName};
use crate::facts::topic_kind::TopicKind;
use crate::graph::discovery::Discovery;
use crate::measure::topic::{Topic, TopicId, Topics, Watched};

/// Topics that every node has and that cause no message with a header.
pub(super) const INFRASTRUCTURE: [&str; 3] = ["/clock", "/parameter_events", "/rosout"];

/// A node with its inputs.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct NodeView {
    pub(super) domain_id: DomainId,
    pub(super) prefix: GuidPrefix,
    /// Its name; `None` for a participant without announced nodes.
    pub(super) name: Option<NodeName>,
    /// Measured topics with a header that it reads.
    pub(super) inputs: BTreeMap<TopicId, TopicName>,
    /// Whether it reads no other topics, so that all its inputs are known.
    pub(super) is_complete: bool,
}

/// A topic that a node publishes.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct Output {
    pub(super) node: Arc<NodeView>,
    pub(super) topic: TopicId,
    pub(super) key: TopicKey,
    pub(super) message_type: TypeName,
    /// Traced share of the chains that begin with this topic.
    pub(super) share: Option<Share>,
    /// Whether a node that has outputs reads it.
    pub(super) is_read: bool,
    /// Whether such a node runs on another host, as far as known.
    pub(super) is_read_elsewhere: bool,
}

/// The writers of measured topics with a header.
#[derive(Debug, Default)]
pub(super) struct Graph {
    pub(super) outputs: HashMap<Guid, Arc<Output>>,
}

/// The inputs of a node while the graph is built.
#[derive(Default)]
struct Inputs {
    topics: BTreeMap<TopicId, TopicName>,
    has_others: bool,
}

impl NodeView {
    /// Returns whether both views are of the same node.
    pub(super) fn is_same(&self, other: &Self) -> bool {
        match (&self.name, &other.name) {
            (Some(name), Some(other)) => name == other,
            (None, None) => self.prefix == other.prefix,
            _ => false,
        }
    }
}

impl Graph {
    /// Builds the graph from discovery and the measured topics. `share` returns the traced share of
    /// a topic, `is_local` whether a participant runs on this host.
    pub(super) fn of(
        discovery: &Discovery,
        topics: &Topics,
        share: impl Fn(&Topic) -> Option<Share>,
        is_local: impl Fn(&GuidPrefix) -> bool,
    ) -> Self {
        let owners = owners(discovery);
        let mut nodes: HashMap<(GuidPrefix, Option<&NodeName>), Inputs> = HashMap::new();
        let mut domains = HashMap::new();
        let mut writers = Vec::new();
        for (id, topic) in topics.iter() {
            let is_input = is_stamped(topic, discovery) && topic.watched == Watched::Yes;
            for reader in &topic.readers {
                let owner = (reader.prefix, owners.get(reader).copied());
                let inputs = nodes.entry(owner).or_default();
                if is_input {
                    inputs.topics.insert(id, topic.naming.name.clone());
                } else if matches!(topic.naming.kind, TopicKind::Topic | TopicKind::Dds) {
                    let name: &str = &topic.naming.name;
                    inputs.has_others |= !INFRASTRUCTURE.contains(&name);
                }
            }
            if is_input {
                let own = topic.writers.iter().map(|writer| (*writer, *writer));
                let buffers = topic.buffers(discovery);
                let buffers = buffers.filter(|(buffer, _)| buffer.entity.is_writer());
                for (writer, publisher) in own.chain(buffers) {
                    let owner = (writer.prefix, owners.get(&publisher).copied());
                    domains.insert(owner, topic.domain_id);
                    writers.push((writer, owner, id));
                }
            }
        }
        let mut views = HashMap::new();
        let (mut read, mut read_elsewhere) = (BTreeSet::new(), BTreeSet::new());
        for (owner, domain_id) in domains {
            let inputs = nodes.remove(&owner).unwrap_or_default();
            let (prefix, name) = owner;
            let view = NodeView {
                domain_id,
                prefix,
                name: name.cloned(),
                is_complete: !inputs.has_others && name.is_some(),
                inputs: if name.is_some() {
                    inputs.topics
                } else {
                    BTreeMap::new()
                },
            };
            read.extend(view.inputs.keys().copied());
            if !is_local(&prefix) {
                read_elsewhere.extend(view.inputs.keys().copied());
            }
            views.insert(owner, Arc::new(view));
        }
        let mut outputs = HashMap::with_capacity(writers.len());
        for (writer, owner, id) in writers {
            let (Some(view), Some(topic)) = (views.get(&owner), topics.get(id)) else {
                continue;
            };
            let endpoint = discovery.endpoints().get(&writer);
            let output = Output {
                node: Arc::clone(view),
                topic: id,
                key: key(topic),
                message_type: endpoint
                    .map(|writer| writer.message_type.clone())
                    .unwrap_or_default(),
                share: share(topic),
                is_read: read.contains(&id),
                is_read_elsewhere: read_elsewhere.contains(&id),
            };
            outputs.insert(writer, Arc::new(output));
        }
        Self { outputs }
    }
}

/// Returns the node of each endpoint.
pub(super) fn owners(discovery: &Discovery) -> HashMap<Guid, &NodeName> {
    let mut owners = HashMap::new();
    for participant in discovery.participants().values() {
        for node in &participant.nodes {
            for guid in node.writers.iter().chain(&node.readers) {
                owners.insert(*guid, &node.name);
            }
        }
    }
    owners
}

/// Returns the node that publishes a topic. Of several nodes, `is_meant` selects one. Returns
/// `None` if that leaves no node or several, or if the only node is unknown.
pub(crate) fn publisher(
    discovery: &Discovery,
    topic: &Topic,
    is_meant: impl Fn(&NodeName) -> bool,
) -> Option<NodeName> {
    let node = |writer: &Guid| Some(discovery.node_of(*writer)?.name.clone());
    let nodes: BTreeSet<Option<NodeName>> = topic.writers.iter().map(node).collect();
    let nodes: Vec<Option<NodeName>> = match nodes.len() {
        0 | 1 => nodes.into_iter().collect(),
        _ => nodes
            .into_iter()
            .filter(|node| node.as_ref().is_some_and(&is_meant))
            .collect(),
    };
    match <[_; 1]>::try_from(nodes) {
        Ok([node]) => node,
        Err(_) => None,
    }
}

/// Returns whether it is a ROS topic whose messages begin with a header.
pub(super) fn is_stamped(topic: &Topic, discovery: &Discovery) -> bool {
    let endpoint = |guid| discovery.endpoints().get(guid);
    let mut writers = topic.writers.iter().filter_map(endpoint);
    topic.naming.kind == TopicKind::Topic
        && writers.any(|writer| begins_with_header(&writer.message_type))
}

/// Returns the identity of a topic.
pub(super) fn key(topic: &Topic) -> TopicKey {
    TopicKey::of(topic.domain_id, &topic.naming)
}
