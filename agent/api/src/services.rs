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
    /// Counts and times of calls; null if no call was seen.
    pub calls: Option<Calls>,
    /// Transports between clients and servers on which the agent does not see calls:
    /// `shared_memory`, `data_sharing`, `same_process`, `iceoryx`.
    pub unseen: Vec<Cow<'static, str>>,
    /// Problems of the service's topics.
    #[cfg_attr(feature = "openapi", schema(value_type = Vec<Diagnosis<'static>>))]
    pub diagnoses: Vec<Finding<'a>>,
}

/// The calls of a service.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Calls {
    /// Requests. Each request is counted once, regardless of copies and servers.
    pub requests: u64,
    /// Requests whose reply reached the client, as far as the capture source shows it.
    pub answered: u64,
    /// Requests without a reply within `service_timeout_s`; some may have been answered later.
    pub unanswered: u64,
    /// Requests that still wait for a reply after `service_timeout_s`.
    pub hanging: u64,
    /// Requests that wait for a reply, including hanging requests.
    pub open: u64,
    /// Median of the latest 1024 times from a request to its reply; null before the first reply.
    pub latency_p50_seconds: Option<f64>,
    /// 99th percentile of the same times.
    pub latency_p99_seconds: Option<f64>,
    /// Whether calls are not measured at present because the service's messages exceed 4 MiB/s.
    pub suspended: bool,
}

/// The goals of an action.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Goals {
    /// Goals that the server accepted.
    pub accepted: u64,
    /// Goals that the server rejected.
    pub rejected: u64,
    /// Succeeded goals whose result a client received.
    pub succeeded: u64,
    /// Canceled goals whose result a client received.
    pub canceled: u64,
    /// Aborted goals whose result a client received.
    pub aborted: u64,
    /// Accepted goals whose result no client has received so far.
    pub open: u64,
    /// Median of the latest 1024 times from a goal's request to its result; null before the first
    /// result.
    pub duration_p50_seconds: Option<f64>,
    /// 99th percentile of the same times.
    pub duration_p99_seconds: Option<f64>,
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
    /// Counts and times of goals; null if no goal was seen.
    pub goals: Option<Goals>,
    /// DDS names of the action's topics and services.
    pub parts: Vec<Cow<'a, str>>,
    /// Problems of the action's topics.
    #[cfg_attr(feature = "openapi", schema(value_type = Vec<Diagnosis<'static>>))]
    pub diagnoses: Vec<Finding<'a>>,
}

/// A server or client of a service or action: a node, or a participant if the node is unknown.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Party<'a> {
    /// Name of the node, from `ros_discovery_info`; null when unknown.
    pub node: Option<Cow<'a, str>>,
    /// GUID of the participant.
    pub participant: String,
    /// GUIDs of the writers and readers that it uses for the service or action.
    pub endpoints: Vec<String>,
}
