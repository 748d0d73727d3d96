//! Channels of the viewers: one for the messages of each topic and type, one for the statistics of
//! each measured topic. They are updated from the snapshots once a second while a viewer is
//! connected.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use ros2probe_message::Library;
use ros2probe_model::facts::bounded::Bounded;
use ros2probe_model::facts::names::{DdsName, TypeName};
use ros2probe_model::report::snapshot::{EndpointFacts, Snapshot, TopicFacts};
use ros2probe_wire::DomainId;
use tokio::task::spawn_blocking;

use super::graph::Graph;
use super::names::DomainNames;
use super::protocol::Advertised;
use super::statistics;
use crate::subscriptions::{Topic, TopicKey};
use crate::tables::ViewerChannels;

/// Maximum total size of definitions, in bytes. Channels beyond it have no schema.
const SCHEMA_BYTES: usize = 2 << 20;

/// Channels by id.
pub(super) type Channels = Bounded<ViewerChannels, BTreeMap<u32, Arc<Channel>>>;
/// Topics that have a channel, in the order of their contents.
type Wanted<'a> = Bounded<ViewerChannels, BTreeMap<Content, &'a TopicFacts>>;

/// Content of a channel, which identifies it.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Content {
    /// Messages of a topic, of one type.
    Messages {
        domain_id: DomainId,
        dds_name: DdsName,
        message_type: TypeName,
    },
    /// Statistics of a topic.
    Statistics {
        domain_id: DomainId,
        dds_name: DdsName,
    },
}

impl Content {
    /// Returns the content of the channel that shows messages of this topic and type.
    pub(super) fn of(topic: &Topic) -> Self {
        Self::Messages {
            domain_id: topic.domain_id,
            dds_name: topic.dds_name.clone(),
            message_type: topic.message_type.clone(),
        }
    }

    /// Returns the topic whose messages the channel shows, or `None` for statistics.
    pub(super) fn messages_of(&self) -> Option<TopicKey> {
        match self {
            Self::Messages {
                domain_id,
                dds_name,
                ..
            } => Some((*domain_id, dds_name.clone())),
            Self::Statistics { .. } => None,
        }
    }
}

/// A channel, which never changes. Another type of the same topic has another channel.
#[derive(Debug)]
pub(super) struct Channel {
    id: u32,
    topic: String,
    pub(super) content: Content,
    schema: Option<Schema>,
}

/// Encoding and text of a definition.
#[derive(Clone, Debug)]
struct Schema {
    encoding: &'static str,
    text: Arc<str>,
}

/// The channels and the graph at one moment.
#[derive(Debug)]
pub(super) struct Table {
    pub(super) channels: Arc<Channels>,
    /// The graph, while a viewer shows it.
    pub(super) graph: Option<Arc<Graph>>,
}

/// Updates the channels and the graph from the snapshots.
#[derive(Debug)]
pub(super) struct Registry {
    library: Arc<Library>,
    channels: Arc<Channels>,
    ids: Bounded<ViewerChannels, BTreeMap<Content, u32>>,
    /// Number of channels so far, which is the last id. No id is used twice.
    count: u32,
    names: DomainNames,
    schemas: Schemas,
}

/// Type and announced hash.
type Definition = (TypeName, Option<String>);

/// Definitions of the channels' types; `None` if no definition was found.
#[derive(Debug)]
struct Schemas {
    known: BTreeMap<Definition, Option<Schema>>,
    bytes: usize,
    limit: usize,
}

impl Channel {
    /// Returns the id of the channel.
    pub(super) const fn id(&self) -> u32 {
        self.id
    }

    /// Returns the name of the topic that viewers show.
    pub(super) fn topic(&self) -> &str {
        &self.topic
    }

    /// Returns the channel as an `advertise` message describes it.
    pub(super) fn advertised(&self) -> Advertised<'_> {
        let (encoding, schema_name) = match &self.content {
            Content::Messages { message_type, .. } => ("cdr", message_type.as_str()),
            Content::Statistics { .. } => ("json", statistics::SCHEMA_NAME),
        };
        Advertised {
            id: self.id,
            topic: &self.topic,
            encoding,
            schema_name,
            schema: self.schema.as_ref().map_or("", |schema| &schema.text),
            schema_encoding: self.schema.as_ref().map(|schema| schema.encoding),
        }
    }

    /// Returns the approximate size of the channel in an `advertise` message, in bytes.
    pub(super) fn size(&self) -> usize {
        let schema = self.schema.as_ref().map_or(0, |schema| schema.text.len());
        256 + self.topic.len() + schema
    }
}

impl Registry {
    /// Creates a registry without channels.
    pub(super) fn new(library: Arc<Library>) -> Self {
        Self {
            library,
            channels: Arc::default(),
            ids: Bounded::default(),
            count: 0,
            names: DomainNames::default(),
            schemas: Schemas::new(SCHEMA_BYTES),
        }
    }

    /// Forgets all channels. Their ids are not used again.
    pub(super) fn clear(&mut self) {
        self.channels = Arc::default();
        self.ids.clear();
        self.schemas.forget_unused();
    }

    /// Updates the channels to a snapshot. Returns them, with the graph if `with_graph`.
    pub(super) async fn update(&mut self, snapshot: &Snapshot, with_graph: bool) -> Table {
        self.names.update(snapshot);
        let wanted = wanted(snapshot);
        if wanted.len() != self.ids.len() || !wanted.keys().eq(self.ids.keys()) {
            self.look_up(&wanted).await;
            self.change(&wanted);
        }
        let graph = with_graph.then(|| Arc::new(Graph::of(snapshot, &self.names)));
        Table {
            channels: Arc::clone(&self.channels),
            graph,
        }
    }

    /// Finds the definitions of new types. Files are read on another thread.
    async fn look_up(&mut self, wanted: &Wanted<'_>) {
        let new = wanted
            .iter()
            .filter(|(content, _)| !self.ids.contains_key(*content));
        let definitions = new.filter_map(|(content, topic)| definition(content, topic));
        let unknown: BTreeSet<_> = definitions
            .filter(|definition| !self.schemas.known.contains_key(definition))
            .collect();
        if unknown.is_empty() {
            return;
        }
        let library = Arc::clone(&self.library);
        let found = spawn_blocking(move || {
            let found = unknown.into_iter().map(|definition| {
                let schema = library.find(&definition.0, definition.1.as_deref());
                let schema = schema.ok().map(|found| {
                    let (encoding, text) = found.schema_text();
                    Schema {
                        encoding,
                        text: text.into(),
                    }
                });
                (definition, schema)
            });
            found.collect::<Vec<_>>()
        });
        // If no thread can be started, the new channels have no schema.
        for (definition, schema) in found.await.unwrap_or_default() {
            self.schemas.keep(definition, schema);
        }
    }

    /// Replaces the channels. Channels that stay keep their ids.
    fn change(&mut self, wanted: &Wanted<'_>) {
        let mut channels = Channels::default();
        let mut ids = Bounded::<_, BTreeMap<_, _>>::default();
        for (content, topic) in wanted {
            let known = self.ids.get(content);
            let known = known.and_then(|id| self.channels.get(id).map(Arc::clone));
            let channel = known.unwrap_or_else(|| {
                self.count = self.count.wrapping_add(1);
                Arc::new(self.channel(self.count, content, topic))
            });
            ids.insert(content.clone(), channel.id);
            channels.insert(channel.id, channel);
        }
        self.ids = ids;
        self.channels = Arc::new(channels);
        self.schemas.forget_unused();
    }

    fn channel(&self, id: u32, content: &Content, topic: &TopicFacts) -> Channel {
        let name = self.names.display_name(topic.domain_id, &topic.name);
        let (topic, schema) = match content {
            Content::Messages { .. } => {
                let definition = definition(content, topic);
                let known = definition.and_then(|definition| self.schemas.known.get(&definition));
                (name, known.cloned().flatten())
            }
            Content::Statistics { .. } => {
                let schema = Schema {
                    encoding: "jsonschema",
                    text: statistics::schema(),
                };
                (format!("{}{name}", statistics::TOPIC_PREFIX), Some(schema))
            }
        };
        Channel {
            id,
            topic,
            content: content.clone(),
            schema,
        }
    }
}

impl Schemas {
    const fn new(limit: usize) -> Self {
        Self {
            known: BTreeMap::new(),
            bytes: 0,
            limit,
        }
    }

    /// Keeps a definition if it does not exceed the limit.
    fn keep(&mut self, definition: Definition, schema: Option<Schema>) {
        let size = |schema: &Schema| schema.text.len();
        let schema = schema.filter(|schema| self.bytes + size(schema) <= self.limit);
        self.bytes += schema.as_ref().map_or(0, size);
        self.known.insert(definition, schema);
    }

    /// Drops definitions without a channel.
    fn forget_unused(&mut self) {
        self.known.retain(|_, schema| {
            let text = schema.as_ref().map(|schema| &schema.text);
            text.is_some_and(|text| Arc::strong_count(text) > 1)
        });
        let schemas = self.known.values().flatten();
        self.bytes = schemas.map(|schema| schema.text.len()).sum();
    }
}

/// Returns the channels for a snapshot: first the channels of messages, then the channels of
/// statistics.
fn wanted(snapshot: &Snapshot) -> Wanted<'_> {
    let topics = snapshot.topics.iter();
    let topics =
        topics.filter(|topic| topic.kind.is_ros_topic() && !topic.hidden && !topic.vanished);
    let messages = topics.clone().flat_map(|topic| {
        let types = topic.message_types.iter();
        types.map(move |message_type| {
            let content = Content::Messages {
                domain_id: topic.domain_id,
                dds_name: topic.dds_name.clone(),
                message_type: message_type.clone(),
            };
            (content, topic)
        })
    });
    let measured = topics.filter(|topic| topic.measurement.is_some());
    let statistics = measured.map(|topic| {
        let content = Content::Statistics {
            domain_id: topic.domain_id,
            dds_name: topic.dds_name.clone(),
        };
        (content, topic)
    });
    messages.chain(statistics).collect()
}

/// Returns the type and the hash of a channel's messages, as the first endpoint of that type
/// announces them.
fn definition(content: &Content, topic: &TopicFacts) -> Option<Definition> {
    let Content::Messages { message_type, .. } = content else {
        return None;
    };
    let mut endpoints = topic.publishers.iter().chain(&topic.subscriptions);
    let of_type = endpoints.find(|endpoint| endpoint.message_type == *message_type);
    let hash = of_type.and_then(EndpointFacts::definition_hash);
    Some((message_type.clone(), hash))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn definitions_beyond_the_size_limit_are_left_out_until_others_are_unused() {
        let mut schemas = Schemas::new(10);
        let definition = |name: &str| (TypeName::from(name), None);
        let schema = |size: usize| {
            Some(Schema {
                encoding: "ros2msg",
                text: "x".repeat(size).into(),
            })
        };
        schemas.keep(definition("a/msg/A"), schema(6));
        schemas.keep(definition("a/msg/B"), schema(6));
        schemas.keep(definition("a/msg/C"), schema(4));
        let is_kept = |schemas: &Schemas, name| schemas.known[&definition(name)].is_some();
        assert!(is_kept(&schemas, "a/msg/A") && is_kept(&schemas, "a/msg/C"));
        assert!(!is_kept(&schemas, "a/msg/B"));
        assert_eq!(schemas.bytes, 10);
        let used = schemas.known[&definition("a/msg/C")].clone();
        schemas.forget_unused();
        assert_eq!((schemas.bytes, schemas.known.len()), (4, 1));
        schemas.keep(definition("a/msg/B"), schema(6));
        assert!(is_kept(&schemas, "a/msg/B"));
        drop(used);
        assert_eq!(SCHEMA_BYTES, Registry::new(library()).schemas.limit);
    }

    fn library() -> Arc<Library> {
        Arc::new(Library::new(ros2probe_message::Sources::default()))
    }
}
