//! `/services` and `/actions`.

use std::borrow::Cow;

use serde::{Deserialize, Serialize};

use crate::diagnosis::{Diagnosis, Finding};
use crate::measurement::Measurement;

/// All services.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct ServiceList<'a> {
    /// Unix time of the state that this answer describes.
    pub timestamp_seconds: f64,
    /// Services, sorted by domain and name.
    pub services: Vec<Service<'a>>,
}

/// A service.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Service<'a> {
    /// Domain id.
    pub domain_id: u32,
    /// ROS name.
    #[cfg_attr(feature = "openapi", schema(example = "/add_two_ints"))]
    pub name: Cow<'a, str>,
    /// Hidden by ROS convention, such as the services of actions.
    pub hidden: bool,
    /// ROS types; more than one is a fault.
    #[cfg_attr(feature = "openapi", schema(example = json!(["example_interfaces/srv/AddTwoInts"])))]
    pub types: Vec<Cow<'a, str>>,
    /// Nodes that offer the service.
    pub servers: Vec<Party<'a>>,
    /// Nodes that call the service.
    pub clients: Vec<Party<'a>>,
    /// Counts and times of requests; null if their DDS topic is not watched.
    pub requests: Option<Measurement>,
    /// Counts and times of replies; null if their DDS topic is not watched.
    pub replies: Option<Measurement>,
    /// Problems of the service's topics.
    #[cfg_attr(feature = "openapi", schema(value_type = Vec<Diagnosis<'static>>))]
    pub diagnoses: Vec<Finding<'a>>,
}

/// All actions.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct ActionList<'a> {
    /// Unix time of the state that this answer describes.
    pub timestamp_seconds: f64,
    /// Actions, sorted by domain and name.
    pub actions: Vec<Action<'a>>,
}

/// An action.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Action<'a> {
    /// Domain id.
    pub domain_id: u32,
    /// ROS name.
    #[cfg_attr(feature = "openapi", schema(example = "/fibonacci"))]
    pub name: String,
    /// ROS types; more than one is a fault.
    #[cfg_attr(feature = "openapi", schema(example = json!(["example_interfaces/action/Fibonacci"])))]
    pub types: Vec<Cow<'a, str>>,
    /// Nodes that offer the action.
    pub servers: Vec<Party<'a>>,
    /// Nodes that call the action. A node that only reads the feedback is not a client.
    pub clients: Vec<Party<'a>>,
    /// DDS names of the action's topics and services.
    pub parts: Vec<Cow<'a, str>>,
    /// Problems of these topics.
    #[cfg_attr(feature = "openapi", schema(value_type = Vec<Diagnosis<'static>>))]
    pub diagnoses: Vec<Finding<'a>>,
}

/// A node at one end of a service or action, or a participant if the node is unknown.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Party<'a> {
    /// Name of the node, from `ros_discovery_info`; null when unknown.
    pub node: Option<Cow<'a, str>>,
    /// GUID of the participant.
    pub participant: String,
    /// GUIDs of the writers and readers that it uses there.
    pub endpoints: Vec<String>,
}
