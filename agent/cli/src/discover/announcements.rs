//! Announcements that a participant repeated on request.

use ros2probe_model::facts::naming::Naming;
use ros2probe_wire::discovery::Role;
use ros2probe_wire::entities::NodeEntities;

use super::session::Session;

/// The endpoints and nodes of one participant.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Announcements {
    /// Its writers, by GUID.
    pub writers: Vec<AnnouncedEndpoint>,
    /// Its readers, by GUID.
    pub readers: Vec<AnnouncedEndpoint>,
    /// Fully qualified names of its nodes. `None` if the list did not arrive.
    pub nodes: Option<Vec<String>>,
}

/// A writer or reader.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct AnnouncedEndpoint {
    /// ROS name, or the DDS name if it does not follow the ROS convention.
    pub topic: String,
    /// ROS type.
    pub message_type: String,
}

impl Announcements {
    /// Returns the announcements that the session received.
    #[must_use]
    pub fn of(session: &Session) -> Self {
        let with = |role| {
            let endpoints = session.endpoints().values();
            let endpoints = endpoints.filter(move |endpoint| endpoint.role == role);
            let endpoints = endpoints.map(|endpoint| AnnouncedEndpoint {
                topic: Naming::of(&endpoint.topic).name.to_string(),
                message_type: endpoint.type_name.message().to_string(),
            });
            endpoints.collect()
        };
        let names = |nodes: &[NodeEntities]| {
            nodes
                .iter()
                .map(NodeEntities::fully_qualified_name)
                .collect()
        };
        Self {
            writers: with(Role::Writer),
            readers: with(Role::Reader),
            nodes: session.nodes().map(names),
        }
    }
}
