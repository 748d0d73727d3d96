//! Servers and clients of services and actions, derived from the endpoints of their topics.

use std::borrow::Cow;
use std::collections::BTreeMap;

use ros2probe_wire::names::{ActionPart, RosName};
use ros2probe_wire::{EntityId, Guid};

use super::endpoint::printed;
use ros2probe_api::services::Party;
use ros2probe_model::facts::topic_kind::TopicKind;
use ros2probe_model::report::snapshot::TopicFacts;

/// A side of a service or action.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Side {
    /// The server.
    Server,
    /// The client.
    Client,
}

/// Servers and clients, without duplicates.
#[derive(Debug, Default)]
pub(super) struct Parties<'a> {
    pub(super) servers: Endpoints<'a>,
    pub(super) clients: Endpoints<'a>,
}

/// Endpoints by node and participant.
type Endpoints<'a> = BTreeMap<(Option<&'a str>, Guid), Vec<Guid>>;

impl Side {
    /// Returns the side of a writer or reader of this topic. A server reads requests and writes all
    /// other topics. Returns `None` if the side cannot be determined.
    pub(super) fn of(topic: &TopicFacts, is_writer: bool) -> Option<Self> {
        match (topic.kind, is_writer) {
            (TopicKind::ServiceRequest, false) | (TopicKind::ServiceReply, true) => {
                Some(Self::Server)
            }
            (TopicKind::ServiceRequest, true) | (TopicKind::ServiceReply, false) => {
                Some(Self::Client)
            }
            // A reader of feedback may be a client or a tool.
            (TopicKind::ActionFeedback | TopicKind::ActionStatus, true) => Some(Self::Server),
            _ => None,
        }
    }
}

impl<'a> Parties<'a> {
    /// Adds the endpoints of a topic.
    pub(super) fn add(&mut self, topic: &'a TopicFacts) {
        for (endpoints, is_writer) in [(&topic.publishers, true), (&topic.subscriptions, false)] {
            let parties = match Side::of(topic, is_writer) {
                Some(Side::Server) => &mut self.servers,
                Some(Side::Client) => &mut self.clients,
                None => continue,
            };
            for endpoint in endpoints {
                let participant = Guid::new(endpoint.guid.prefix, EntityId::PARTICIPANT);
                let party = parties.entry((endpoint.node.as_deref(), participant));
                party.or_default().push(endpoint.guid);
            }
        }
    }

    pub(super) fn is_empty(&self) -> bool {
        self.servers.is_empty() && self.clients.is_empty()
    }

    /// Returns servers and clients, sorted by node and participant.
    pub(super) fn views(self) -> [Vec<Party<'a>>; 2] {
        [self.servers, self.clients].map(|parties| {
            let views = parties
                .into_iter()
                .map(|((node, participant), mut endpoints)| {
                    endpoints.sort_unstable();
                    Party {
                        node: node.map(Cow::Borrowed),
                        participant: participant.to_string(),
                        endpoints: printed(&endpoints),
                    }
                });
            views.collect()
        })
    }
}

/// Returns the service type for a topic's type: `pkg/srv/Add` for `pkg/srv/Add_Request`.
pub(super) fn service_type(message_type: &str) -> &str {
    let ends = ["_Request", "_Response"];
    let mut stems = ends.iter().filter_map(|end| message_type.strip_suffix(end));
    stems.next().unwrap_or(message_type)
}

/// Returns the action that a topic or service belongs to, if any.
pub(super) fn action(topic: &TopicFacts) -> Option<(RosName, ActionPart)> {
    match topic.kind {
        TopicKind::Topic | TopicKind::ServiceEvent | TopicKind::Discovery | TopicKind::Dds => None,
        _ => RosName::parse(&topic.name).ok()?.action(),
    }
}

/// Returns the action type for the type of one of its topics, or `None` if the topic's type does
/// not contain it.
pub(super) fn action_type(message_type: &str) -> Option<&str> {
    const ACTION_ENDS: [&str; 5] = [
        "_FeedbackMessage",
        "_SendGoal_Request",
        "_SendGoal_Response",
        "_GetResult_Request",
        "_GetResult_Response",
    ];
    ACTION_ENDS
        .iter()
        .find_map(|end| message_type.strip_suffix(end))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_service_or_action_type_is_a_topic_type_without_its_suffix() {
        assert_eq!(service_type("a/srv/Add_Request"), "a/srv/Add");
        assert_eq!(service_type("a/srv/Add_Response"), "a/srv/Add");
        assert_eq!(service_type("Square"), "Square");
        assert_eq!(
            action_type("a/action/Fib_FeedbackMessage"),
            Some("a/action/Fib")
        );
        assert_eq!(
            action_type("a/action/Fib_SendGoal_Request"),
            Some("a/action/Fib")
        );
        assert_eq!(action_type("action_msgs/msg/GoalStatusArray"), None);
    }
}
