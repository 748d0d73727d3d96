//! The graph of one domain as rclpy's functions return it, from a snapshot.
//!
//! Names and types are sorted, and endpoints are sorted by GUID. A service is counted and listed by
//! the same endpoints as in rmw: a server reads requests and writes replies.

use std::collections::{BTreeMap, BTreeSet, HashSet};

use ros2probe_message::Dialect;
use ros2probe_model::facts::topic_kind::TopicKind;
use ros2probe_model::report::snapshot::{EndpointFacts, NodeFacts, Snapshot, TopicFacts};
use ros2probe_wire::{DomainId, Guid, GuidPrefix};

/// Suffixes of an action's feedback topic and of its type.
const FEEDBACK_TOPIC_SUFFIX: &str = "/_action/feedback";
const FEEDBACK_TYPE_SUFFIX: &str = "_FeedbackMessage";

/// Names with their types. Names and types are sorted.
pub(super) type Names<'a> = BTreeMap<&'a str, BTreeSet<&'a str>>;

/// The graph of a domain.
#[derive(Clone, Copy, Debug)]
pub(super) struct Graph<'a> {
    snapshot: &'a Snapshot,
    domain_id: DomainId,
}

/// Endpoints of all nodes with one name.
#[derive(Debug)]
pub(super) struct NodeEnds<'a> {
    graph: Graph<'a>,
    writers: HashSet<Guid>,
    readers: HashSet<Guid>,
}

/// A side of a service or action.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Side {
    Server,
    Client,
}

/// The endpoints of one server or client of a service.
#[derive(Clone, Copy, Debug)]
pub(super) struct ServiceEnds<'a> {
    pub(super) reader: &'a EndpointFacts,
    pub(super) writer: &'a EndpointFacts,
}

/// The endpoints of one server or client of an action.
#[derive(Clone, Copy, Debug)]
pub(super) struct ActionEnds<'a> {
    pub(super) goal: ServiceEnds<'a>,
    pub(super) cancel: ServiceEnds<'a>,
    pub(super) result: ServiceEnds<'a>,
    pub(super) feedback: &'a EndpointFacts,
    pub(super) status: &'a EndpointFacts,
}

impl<'a> Graph<'a> {
    /// Returns the graph of a domain.
    pub(super) const fn new(snapshot: &'a Snapshot, domain_id: DomainId) -> Self {
        Self {
            snapshot,
            domain_id,
        }
    }

    /// Returns the nodes. Several nodes may have the same name.
    pub(super) fn nodes(self) -> impl Iterator<Item = &'a NodeFacts> {
        let nodes = self.snapshot.nodes.iter();
        nodes.filter(move |node| node.domain_id == self.domain_id)
    }

    /// Returns the enclave of an entity's participant; `None` if the participant does not use ROS.
    pub(super) fn enclave(self, prefix: GuidPrefix) -> Option<&'a str> {
        let mut participants = self.snapshot.participants.iter();
        let participant = participants.find(|each| each.guid.prefix == prefix);
        participant?.enclave.as_deref()
    }

    /// Returns the endpoints of the nodes with this name; `None` if no node has it.
    pub(super) fn node(self, name: &str, namespace: &str) -> Option<NodeEnds<'a>> {
        let mut found = self
            .nodes()
            .filter(|node| parts(&node.name) == (namespace, name));
        let first = found.next()?;
        let mut ends = NodeEnds {
            graph: self,
            writers: first.writers.iter().copied().collect(),
            readers: first.readers.iter().copied().collect(),
        };
        for node in found {
            ends.writers.extend(&node.writers);
            ends.readers.extend(&node.readers);
        }
        Some(ends)
    }

    /// Returns the topics that have endpoints, without the topics of services.
    pub(super) fn topics(self) -> Names<'a> {
        let mut names = Names::new();
        for topic in self.ros_topics() {
            for endpoint in topic.publishers.iter().chain(&topic.subscriptions) {
                add(&mut names, &topic.name, endpoint);
            }
        }
        names
    }

    /// Returns services with an endpoint of a server or client.
    pub(super) fn services(self) -> Names<'a> {
        let mut names = Names::new();
        for topic in self.all().filter(|topic| topic.kind.is_service()) {
            for endpoint in topic.publishers.iter().chain(&topic.subscriptions) {
                let types = names.entry(&*topic.name).or_default();
                types.insert(service_type(&endpoint.message_type));
            }
        }
        names
    }

    /// Returns the actions, derived from their feedback topics.
    pub(super) fn actions(self) -> Names<'a> {
        actions(self.topics())
    }

    /// Returns the writers or readers of a topic, sorted by GUID.
    pub(super) fn endpoints(self, name: &str, side: Endpoints) -> Vec<&'a EndpointFacts> {
        let topics = self.ros_topics().filter(|topic| *topic.name == *name);
        sorted(topics.flat_map(|topic| side.of(topic)))
    }

    /// Returns the number of servers of a service: until Kilted the writers of replies, later the
    /// readers of requests.
    pub(super) fn count_servers(self, name: &str, dialect: Dialect) -> usize {
        let [readers, writers] = self.service_ends(name, Side::Server);
        if dialect < Dialect::Rolling {
            writers.len()
        } else {
            readers.len()
        }
    }

    /// Returns the number of clients of a service: the readers of replies.
    pub(super) fn count_clients(self, name: &str) -> usize {
        let [readers, _] = self.service_ends(name, Side::Client);
        readers.len()
    }

    /// Returns the servers or clients of a service. A reader and a writer are paired by their
    /// participant, their node and their order.
    pub(super) fn service(self, name: &str, side: Side) -> Vec<ServiceEnds<'a>> {
        let [readers, writers] = self.service_ends(name, side);
        let mut free: Vec<Option<&EndpointFacts>> = writers.into_iter().map(Some).collect();
        let mut ends = Vec::new();
        for reader in readers {
            let is_mate = |writer: &EndpointFacts| {
                writer.guid.prefix == reader.guid.prefix && writer.node == reader.node
            };
            let mut mates = free.iter_mut();
            let mate = mates.find(|writer| writer.is_some_and(is_mate));
            if let Some(writer) = mate.and_then(Option::take) {
                ends.push(ServiceEnds { reader, writer });
            }
        }
        ends
    }

    /// Returns the servers or clients of an action that have all of its endpoints.
    pub(super) fn action(self, name: &str, side: Side) -> Vec<ActionEnds<'a>> {
        let service = |part: &str| self.service(&format!("{name}/_action/{part}"), side);
        let (cancels, results) = (service("cancel_goal"), service("get_result"));
        let topics = match side {
            Side::Server => Endpoints::Writers,
            Side::Client => Endpoints::Readers,
        };
        let topic = |part: &str| self.endpoints(&format!("{name}/_action/{part}"), topics);
        let (feedback, status) = (topic("feedback"), topic("status"));
        let ends = service("send_goal").into_iter().filter_map(|goal| {
            let is_mate = |endpoint: &EndpointFacts| {
                endpoint.guid.prefix == goal.reader.guid.prefix && endpoint.node == goal.reader.node
            };
            let pair =
                |ends: &[ServiceEnds<'a>]| ends.iter().find(|ends| is_mate(ends.reader)).copied();
            let single = |ends: &[&'a EndpointFacts]| {
                ends.iter().find(|endpoint| is_mate(endpoint)).copied()
            };
            Some(ActionEnds {
                goal,
                cancel: pair(&cancels)?,
                result: pair(&results)?,
                feedback: single(&feedback)?,
                status: single(&status)?,
            })
        });
        ends.collect()
    }

    /// Returns the readers and writers of a service's servers or clients, sorted by GUID.
    fn service_ends(self, name: &str, side: Side) -> [Vec<&'a EndpointFacts>; 2] {
        let (read, written) = side.kinds();
        let of_kind = move |kind| {
            let topics = self.all();
            topics.filter(move |topic| topic.kind == kind && *topic.name == *name)
        };
        [
            sorted(of_kind(read).flat_map(|topic| &topic.subscriptions)),
            sorted(of_kind(written).flat_map(|topic| &topic.publishers)),
        ]
    }

    fn ros_topics(self) -> impl Iterator<Item = &'a TopicFacts> {
        self.all().filter(|topic| topic.kind.is_ros_topic())
    }

    fn all(self) -> impl Iterator<Item = &'a TopicFacts> {
        let topics = self.snapshot.topics.iter();
        topics.filter(move |topic| topic.domain_id == self.domain_id)
    }
}

impl<'a> NodeEnds<'a> {
    /// Returns the topics that the nodes publish or subscribe to.
    pub(super) fn topics(&self, side: Endpoints) -> Names<'a> {
        let mut names = Names::new();
        for topic in self.graph.ros_topics() {
            for endpoint in side.of(topic) {
                if self.has(endpoint.guid, side) {
                    add(&mut names, &topic.name, endpoint);
                }
            }
        }
        names
    }

    /// Returns the services that the nodes offer or call.
    pub(super) fn services(&self, side: Side) -> Names<'a> {
        let (read, _) = side.kinds();
        let mut names = Names::new();
        for topic in self.graph.all().filter(|topic| topic.kind == read) {
            for endpoint in &topic.subscriptions {
                if self.readers.contains(&endpoint.guid) {
                    let types = names.entry(&*topic.name).or_default();
                    types.insert(service_type(&endpoint.message_type));
                }
            }
        }
        names
    }

    /// Returns the actions that the nodes offer or call.
    pub(super) fn actions(&self, side: Side) -> Names<'a> {
        actions(self.topics(match side {
            Side::Server => Endpoints::Writers,
            Side::Client => Endpoints::Readers,
        }))
    }

    fn has(&self, guid: Guid, side: Endpoints) -> bool {
        match side {
            Endpoints::Writers => self.writers.contains(&guid),
            Endpoints::Readers => self.readers.contains(&guid),
        }
    }
}

/// The writers or the readers of a topic.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Endpoints {
    Writers,
    Readers,
}

impl Endpoints {
    fn of(self, topic: &TopicFacts) -> &[EndpointFacts] {
        match self {
            Self::Writers => &topic.publishers,
            Self::Readers => &topic.subscriptions,
        }
    }
}

impl Side {
    /// Returns the kinds of the topics that the side reads and writes.
    const fn kinds(self) -> (TopicKind, TopicKind) {
        match self {
            Self::Server => (TopicKind::ServiceRequest, TopicKind::ServiceReply),
            Self::Client => (TopicKind::ServiceReply, TopicKind::ServiceRequest),
        }
    }
}

/// Returns the namespace and the name in a node's full name.
pub(super) fn parts(full: &str) -> (&str, &str) {
    match full.rsplit_once('/') {
        Some(("", name)) => ("/", name),
        Some(parts) => parts,
        None => ("/", full),
    }
}

/// Returns the service type for the type of its requests or replies.
pub(super) fn service_type(message_type: &str) -> &str {
    let ends = ["_Request", "_Response"];
    let mut stems = ends.iter().filter_map(|end| message_type.strip_suffix(end));
    stems.next().unwrap_or(message_type)
}

fn add<'a>(names: &mut Names<'a>, topic: &'a str, endpoint: &'a EndpointFacts) {
    names
        .entry(topic)
        .or_default()
        .insert(&endpoint.message_type);
}

fn actions(topics: Names<'_>) -> Names<'_> {
    let feedback = topics.into_iter().filter_map(|(name, types)| {
        let name = name.strip_suffix(FEEDBACK_TOPIC_SUFFIX)?;
        let types: BTreeSet<_> = types
            .into_iter()
            .filter_map(|each| each.strip_suffix(FEEDBACK_TYPE_SUFFIX))
            .collect();
        (!types.is_empty()).then_some((name, types))
    });
    feedback.collect()
}

fn sorted<'a>(endpoints: impl Iterator<Item = &'a EndpointFacts>) -> Vec<&'a EndpointFacts> {
    let mut endpoints: Vec<_> = endpoints.collect();
    endpoints.sort_unstable_by_key(|endpoint| endpoint.guid);
    endpoints
}
