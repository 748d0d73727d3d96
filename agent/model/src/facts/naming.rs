//! Names of a topic in DDS and ROS, and the watches that cover it.

use ros2probe_wire::DomainId;
use ros2probe_wire::names::{DdsTopic, Demangled, RosName};

use crate::facts::names::{DdsName, TopicName};
use crate::facts::topic_kind::TopicKind;
use crate::facts::watch::Watchlist;

/// Names and properties of a topic.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Naming {
    /// DDS name; for a CPU buffer topic, that of its base topic.
    pub dds_name: DdsName,
    /// ROS name, or the DDS name.
    pub name: TopicName,
    /// Role of the topic in ROS.
    pub kind: TopicKind,
    /// Whether the topic is hidden by ROS convention.
    pub hidden: bool,
    /// Whether the endpoint belongs to a buffer topic and is not a publisher of the base topic.
    pub is_buffer: bool,
    /// Whether its samples count as messages.
    pub counts: bool,
}

impl Naming {
    /// Returns the names of a DDS topic.
    #[must_use]
    pub fn of(topic: &DdsTopic) -> Self {
        let demangled = topic.demangle();
        let kind = TopicKind::of_demangled(&demangled);
        let (is_buffer, counts) = match demangled {
            Demangled::CpuBuffer(_) => (true, true),
            Demangled::Buffer(_) => (true, false),
            _ => (false, true),
        };
        let named = |name: &RosName, dds_name: &DdsTopic| Self {
            dds_name: dds_name.as_str().into(),
            name: name.as_str().into(),
            kind,
            hidden: name.is_hidden(),
            is_buffer,
            counts,
        };
        match &demangled {
            Demangled::CpuBuffer(name) | Demangled::Buffer(name) => {
                named(name, &DdsTopic::of_topic(name))
            }
            Demangled::Topic(name)
            | Demangled::ServiceRequest(name)
            | Demangled::ServiceReply(name) => named(name, topic),
            Demangled::RosDiscovery | Demangled::NotRos => Self::verbatim(topic, kind),
        }
    }

    fn verbatim(topic: &DdsTopic, kind: TopicKind) -> Self {
        let dds_name = DdsName::from(topic.as_str());
        Self {
            name: TopicName::of_dds(&dds_name),
            dds_name,
            kind,
            hidden: false,
            is_buffer: false,
            counts: true,
        }
    }

    /// Returns the watchlist entries that cover the topic. Entries name ROS topics; services are
    /// covered only by their DDS names. A hidden topic is covered if an entry names a hidden token
    /// itself, so `/**` covers the topics of `ros2 topic list`.
    pub(crate) fn covered_by(&self, domain_id: DomainId, watchlist: &Watchlist) -> Vec<usize> {
        let mut covering = watchlist.matching(domain_id, self.watched_as());
        if self.hidden && !self.kind.is_service() {
            let names_hidden = |index: &usize| {
                watchlist
                    .watches()
                    .get(*index)
                    .is_some_and(|watch| watch.pattern.contains("/_"))
            };
            covering.retain(names_hidden);
        }
        covering
    }

    /// Returns whether the topic is watched by exact name, in this domain or, with `None`, in any.
    pub(crate) fn is_named_by(&self, domain_id: Option<DomainId>, watchlist: &Watchlist) -> bool {
        watchlist.names(domain_id, self.watched_as())
    }

    /// Returns the name that watches refer to.
    fn watched_as(&self) -> &str {
        if self.kind.is_service() {
            &self.dds_name
        } else {
            &self.name
        }
    }
}
