//! Names and relations of the handles in one process.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use ros2probe_model::facts::bounded::Bounded;
use ros2probe_model::facts::calls::report::Trigger;
use ros2probe_model::facts::names::{NodeName, TopicName};
use ros2probe_wire::inside::{Announcement, Figures, Handle, announced, kind};

use crate::tables::InsideNames;

/// Maximum length of a chain of relations.
const MAX_DEPTH: usize = 8;

/// Names that a process has announced.
#[derive(Debug, Default)]
pub struct Names {
    known: Bounded<InsideNames, HashMap<(ObjectKind, u64), ObjectFact>>,
}

/// Kinds of objects. Objects of two kinds may have the same address, because one contains the
/// other.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
enum ObjectKind {
    Node,
    Publisher,
    Subscription,
    /// `rcl_subscription_t`.
    SubscriptionHandle,
    /// Subscription of rclcpp.
    SubscriptionObject,
    Callback,
    Timer,
    TimerNode,
    Service,
    StateMachine,
    Buffer,
    /// Intra-process buffer that owns a ring buffer, by the address of the ring buffer.
    Owner,
    /// Subscription of rclcpp, by the address of its intra-process buffer.
    Owned,
}

/// What is known about an object.
#[derive(Clone, Debug)]
enum ObjectFact {
    Node(NodeName),
    /// A publisher, subscription or service.
    Endpoint {
        node: u64,
        name: Arc<str>,
        middleware: Option<Arc<str>>,
    },
    /// A relation to another object.
    Relation(ObjectKind, u64),
    Period(Duration),
    Capacity(u32),
}

/// Topic, node and middleware of an endpoint.
#[derive(Clone, Debug)]
pub struct Endpoint {
    /// ROS name of the topic or service.
    pub name: Arc<str>,
    /// Its node, if announced.
    pub node: Option<NodeName>,
    /// Identifier of its middleware.
    pub middleware: Option<Arc<str>>,
}

impl Names {
    /// Iterates over the names of all nodes.
    pub fn nodes(&self) -> impl Iterator<Item = &NodeName> {
        self.known.values().filter_map(|named| match named {
            ObjectFact::Node(name) => Some(name),
            _ => None,
        })
    }

    /// Adds the content of an announcement. Returns the name of a new node.
    pub fn announce(&mut self, announcement: &Announcement) -> Option<NodeName> {
        let (address, parent) = (announcement.address, announcement.parent);
        let endpoint = || {
            let middleware = text(&announcement.second);
            ObjectFact::Endpoint {
                node: parent,
                name: text(&announcement.text).into(),
                middleware: (!middleware.is_empty()).then(|| middleware.into()),
            }
        };
        let (of, named) = match announcement.kind {
            announced::NODE => {
                let name = NodeName::from(full_name(
                    &text(&announcement.second),
                    &text(&announcement.text),
                ));
                self.known
                    .insert((ObjectKind::Node, address), ObjectFact::Node(name.clone()));
                return Some(name);
            }
            announced::PUBLISHER => (ObjectKind::Publisher, endpoint()),
            announced::SUBSCRIPTION => {
                if announcement.value != 0 {
                    let is = ObjectFact::Relation(ObjectKind::Subscription, address);
                    self.known
                        .insert((ObjectKind::SubscriptionHandle, announcement.value), is);
                }
                (ObjectKind::Subscription, endpoint())
            }
            announced::SUBSCRIPTION_OBJECT => (
                ObjectKind::SubscriptionObject,
                ObjectFact::Relation(ObjectKind::SubscriptionHandle, parent),
            ),
            announced::SUBSCRIPTION_CALLBACK => (
                ObjectKind::Callback,
                ObjectFact::Relation(ObjectKind::SubscriptionObject, parent),
            ),
            announced::TIMER => (
                ObjectKind::Timer,
                ObjectFact::Period(Duration::from_nanos(announcement.value)),
            ),
            announced::TIMER_NODE => (
                ObjectKind::TimerNode,
                ObjectFact::Relation(ObjectKind::Node, parent),
            ),
            announced::TIMER_CALLBACK => (
                ObjectKind::Callback,
                ObjectFact::Relation(ObjectKind::Timer, parent),
            ),
            announced::SERVICE => (ObjectKind::Service, endpoint()),
            announced::SERVICE_CALLBACK => (
                ObjectKind::Callback,
                ObjectFact::Relation(ObjectKind::Service, parent),
            ),
            announced::STATE_MACHINE => (
                ObjectKind::StateMachine,
                ObjectFact::Relation(ObjectKind::Node, parent),
            ),
            announced::BUFFER => {
                let capacity = u32::try_from(announcement.value).unwrap_or(u32::MAX);
                (ObjectKind::Buffer, ObjectFact::Capacity(capacity))
            }
            announced::BUFFER_OWNER => {
                self.known.insert(
                    (ObjectKind::Owner, parent),
                    ObjectFact::Relation(ObjectKind::Owned, address),
                );
                return None;
            }
            announced::BUFFER_SUBSCRIPTION => (
                ObjectKind::Owned,
                ObjectFact::Relation(ObjectKind::SubscriptionObject, parent),
            ),
            _ => return None,
        };
        self.known.insert((of, address), named);
        None
    }

    /// Follows relations to an object that is not itself a relation.
    fn resolve(&self, of: ObjectKind, address: u64) -> Option<(ObjectKind, u64, &ObjectFact)> {
        let mut at = (of, address);
        for _ in 0..MAX_DEPTH {
            match self.known.get(&at)? {
                ObjectFact::Relation(of, address) => at = (*of, *address),
                named => return Some((at.0, at.1, named)),
            }
        }
        None
    }

    fn node(&self, address: u64) -> Option<NodeName> {
        match self.known.get(&(ObjectKind::Node, address))? {
            ObjectFact::Node(name) => Some(name.clone()),
            _ => None,
        }
    }

    fn endpoint(&self, of: ObjectKind, address: u64) -> Option<Endpoint> {
        match self.resolve(of, address)?.2 {
            ObjectFact::Endpoint {
                node,
                name,
                middleware,
            } => Some(Endpoint {
                name: Arc::clone(name),
                node: self.node(*node),
                middleware: middleware.clone(),
            }),
            _ => None,
        }
    }

    /// Returns the topic of a publisher.
    #[must_use]
    pub fn publisher(&self, address: u64) -> Option<Endpoint> {
        self.endpoint(ObjectKind::Publisher, address)
    }

    /// Returns the topic of a subscription.
    #[must_use]
    pub fn subscription(&self, address: u64) -> Option<Endpoint> {
        self.endpoint(ObjectKind::Subscription, address)
    }

    /// Returns the topic and node of a ring buffer's subscription, else the topic of its publisher.
    #[must_use]
    pub fn buffer(&self, address: u64, publisher: Handle) -> Option<Endpoint> {
        let subscription = self.endpoint(ObjectKind::Owner, address);
        subscription.or_else(|| {
            let publisher = self.publisher(publisher.address)?;
            // The node is the publisher's, not the subscription's.
            Some(Endpoint {
                node: None,
                ..publisher
            })
        })
    }

    /// Returns the capacity of a ring buffer.
    #[must_use]
    pub fn capacity(&self, address: u64) -> Option<u32> {
        match self.known.get(&(ObjectKind::Buffer, address))? {
            ObjectFact::Capacity(capacity) => Some(*capacity),
            _ => None,
        }
    }

    /// Returns the node of a state machine.
    #[must_use]
    pub fn machine(&self, address: u64) -> Option<NodeName> {
        match self.resolve(ObjectKind::StateMachine, address)?.2 {
            ObjectFact::Node(name) => Some(name.clone()),
            _ => None,
        }
    }

    /// Returns the trigger of a callback, and its node. `topic_of` returns the endpoint of a ring
    /// buffer.
    #[must_use]
    pub fn trigger(
        &self,
        callback: u64,
        figures: &Figures,
        topic_of: impl Fn(u64) -> Option<Endpoint>,
    ) -> (Trigger, Option<NodeName>) {
        let created = self.known.get(&(ObjectKind::Callback, callback));
        if let Some(ObjectFact::Relation(ObjectKind::Service, service)) = created {
            let service = self.endpoint(ObjectKind::Service, *service);
            let name = service.as_ref().map(|of| Arc::clone(&of.name));
            return (Trigger::Service(name), service.and_then(|of| of.node));
        }
        let trigger = figures.trigger;
        match trigger.kind {
            kind::SUBSCRIPTION => match self.subscription(trigger.address) {
                Some(endpoint) => (
                    Trigger::Subscription(TopicName::from(&*endpoint.name)),
                    endpoint.node,
                ),
                None => (Trigger::Service(None), None),
            },
            kind::BUFFER => {
                let of_buffer = (trigger.address != 0).then(|| topic_of(trigger.address));
                let of_callback = || self.endpoint(ObjectKind::Callback, callback);
                let endpoint = of_buffer.flatten().or_else(of_callback);
                let topic = endpoint.as_ref().map(|of| TopicName::from(&*of.name));
                (
                    Trigger::IntraProcess(topic),
                    endpoint.and_then(|of| of.node),
                )
            }
            kind::TIMER => {
                let announced = match self.known.get(&(ObjectKind::Timer, trigger.address)) {
                    Some(ObjectFact::Period(period)) => Some(*period),
                    _ => None,
                };
                let read = (figures.period != 0).then(|| Duration::from_nanos(figures.period));
                let node = match self.resolve(ObjectKind::TimerNode, trigger.address) {
                    Some((_, _, ObjectFact::Node(name))) => Some(name.clone()),
                    _ => None,
                };
                (Trigger::Timer(read.or(announced)), node)
            }
            _ => (Trigger::Service(None), None),
        }
    }
}

/// Returns a node's full name.
fn full_name(namespace: &str, name: &str) -> String {
    let namespace = namespace.trim_end_matches('/');
    let slash = if namespace.starts_with('/') || namespace.is_empty() {
        ""
    } else {
        "/"
    };
    format!("{slash}{namespace}/{name}")
}

/// Returns the text before the first zero byte.
#[must_use]
pub fn text(bytes: &[u8]) -> String {
    let end = bytes.iter().position(|byte| *byte == 0);
    let bytes = bytes.get(..end.unwrap_or(bytes.len())).unwrap_or_default();
    String::from_utf8_lossy(bytes).into_owned()
}

#[cfg(test)]
mod tests {
    use ros2probe_wire::inside::NAME_BYTES;
    use zerocopy::FromZeros as _;

    use super::*;
    use crate::tables::tests::assert_driven;

    fn announcement(kind: u32, address: u64, parent: u64, value: u64, text: &str) -> Announcement {
        let mut announcement = Announcement::new_zeroed();
        (
            announcement.kind,
            announcement.address,
            announcement.parent,
            announcement.value,
        ) = (kind, address, parent, value);
        announcement.text[..text.len()].copy_from_slice(text.as_bytes());
        announcement
    }

    #[test]
    fn a_callback_resolves_to_the_topic_and_node_of_its_subscription() {
        let mut names = Names::default();
        let mut node = announcement(announced::NODE, 1, 0, 0, "lidar");
        node.second[..7].copy_from_slice(b"/robot1");
        assert_eq!(names.announce(&node).unwrap(), "/robot1/lidar");
        for each in [
            announcement(announced::SUBSCRIPTION, 20, 1, 21, "/points"),
            announcement(announced::SUBSCRIPTION_OBJECT, 22, 21, 0, ""),
            announcement(announced::SUBSCRIPTION_CALLBACK, 23, 22, 0, ""),
        ] {
            names.announce(&each);
        }
        let mut figures = Figures::new_zeroed();
        figures.trigger.kind = kind::BUFFER;
        let (trigger, node) = names.trigger(23, &figures, |_| None);
        assert_eq!(trigger, Trigger::IntraProcess(Some("/points".into())));
        assert_eq!(node.unwrap(), "/robot1/lidar");
        let (unknown, _) = names.trigger(24, &figures, |_| None);
        assert_eq!(unknown, Trigger::IntraProcess(None));
    }

    #[test]
    fn a_cycle_of_relations_ends_the_search() {
        let mut names = Names::default();
        names.announce(&announcement(announced::SUBSCRIPTION_OBJECT, 1, 2, 0, ""));
        names.known.insert(
            (ObjectKind::SubscriptionHandle, 2),
            ObjectFact::Relation(ObjectKind::SubscriptionObject, 1),
        );
        assert!(names.endpoint(ObjectKind::SubscriptionObject, 1).is_none());
    }

    #[test]
    fn names_beyond_the_cap_are_left_out() {
        let mut names = Names::default();
        for address in 0..=InsideNames::CAP as u64 {
            names.announce(&announcement(announced::PUBLISHER, address, 0, 0, "/topic"));
        }
        assert_driven::<InsideNames>();
        assert!(names.publisher(0).is_some());
        assert!(names.publisher(InsideNames::CAP as u64).is_none());
    }

    #[test]
    fn node_names_are_joined_and_text_ends_at_the_first_zero() {
        assert_eq!(full_name("/", "talker"), "/talker");
        assert_eq!(full_name("/robot1", "talker"), "/robot1/talker");
        assert_eq!(full_name("robot1", "talker"), "/robot1/talker");
        assert_eq!(text(b"abc\0def"), "abc");
        assert_eq!(text(&[b'a'; NAME_BYTES]).len(), NAME_BYTES);
    }
}
