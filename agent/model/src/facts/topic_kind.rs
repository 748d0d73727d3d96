//! Roles of DDS topics in ROS.

use ros2probe_wire::names::{ActionPart, DdsTopic, Demangled, RosName};

/// Role of a DDS topic in ROS. Ordered by label.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum TopicKind {
    /// Feedback of an action.
    ActionFeedback,
    /// Goal states of an action.
    ActionStatus,
    /// A topic that follows no ROS naming convention.
    Dds,
    /// `ros_discovery_info`.
    Discovery,
    /// Introspection events of a service.
    ServiceEvent,
    /// Replies of a service.
    ServiceReply,
    /// Requests of a service.
    ServiceRequest,
    /// A topic.
    Topic,
}

impl TopicKind {
    /// All kinds.
    pub const ALL: [Self; 8] = [
        Self::ActionFeedback,
        Self::ActionStatus,
        Self::Dds,
        Self::Discovery,
        Self::ServiceEvent,
        Self::ServiceReply,
        Self::ServiceRequest,
        Self::Topic,
    ];

    /// Returns the kind of a DDS topic; a buffer topic has the kind of its base topic.
    #[must_use]
    pub fn of(topic: &DdsTopic) -> Self {
        Self::of_demangled(&topic.demangle())
    }

    pub(crate) fn of_demangled(demangled: &Demangled) -> Self {
        match demangled {
            Demangled::Topic(name) | Demangled::CpuBuffer(name) | Demangled::Buffer(name) => {
                Self::of_name(name)
            }
            Demangled::ServiceRequest(_) => Self::ServiceRequest,
            Demangled::ServiceReply(_) => Self::ServiceReply,
            Demangled::RosDiscovery => Self::Discovery,
            Demangled::NotRos => Self::Dds,
        }
    }

    fn of_name(name: &RosName) -> Self {
        match name.action() {
            Some((_, ActionPart::Feedback)) => Self::ActionFeedback,
            Some((_, ActionPart::Status)) => Self::ActionStatus,
            _ if name.service_of_events().is_some() => Self::ServiceEvent,
            _ => Self::Topic,
        }
    }

    /// Returns the kind with this label.
    #[must_use]
    pub fn parse(label: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|kind| kind.label() == label)
    }

    /// Returns the label value.
    #[must_use]
    pub const fn label(self) -> &'static str {
        match self {
            Self::ActionFeedback => "action_feedback",
            Self::ActionStatus => "action_status",
            Self::Dds => "dds",
            Self::Discovery => "discovery",
            Self::ServiceEvent => "service_event",
            Self::ServiceReply => "service_reply",
            Self::ServiceRequest => "service_request",
            Self::Topic => "topic",
        }
    }

    /// Returns whether it is a request or reply topic of a service. An ordinary topic may have the
    /// same ROS name.
    #[must_use]
    pub const fn is_service(self) -> bool {
        matches!(self, Self::ServiceRequest | Self::ServiceReply)
    }

    /// Returns whether `ros2 topic` lists it by its ROS name: topics, and topics of actions and of
    /// service introspection.
    #[must_use]
    pub const fn is_ros_topic(self) -> bool {
        matches!(
            self,
            Self::Topic | Self::ServiceEvent | Self::ActionFeedback | Self::ActionStatus
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn kinds_are_sorted_by_label_and_found_by_label() {
        assert!(TopicKind::ALL.is_sorted_by_key(|kind| kind.label()));
        assert!(TopicKind::ALL.is_sorted());
        for kind in TopicKind::ALL {
            assert_eq!(TopicKind::parse(kind.label()), Some(kind));
        }
        assert_eq!(TopicKind::parse("Topic"), None);
    }
}
