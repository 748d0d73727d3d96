//! `/services` and `/actions`.

use std::borrow::Cow;

use serde::{Deserialize, Serialize};

use crate::diagnosis::{Diagnosis, Finding};
use crate::measurement::Measurement;

/// Services.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct ServiceList<'a> {
    /// Unix time of the facts.
    pub timestamp_seconds: f64,
    /// By domain and name.
    pub services: Vec<Service<'a>>,
}

/// One service.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Service<'a> {
    /// Domain.
    pub domain_id: u32,
    /// ROS name.
    #[cfg_attr(feature = "openapi", schema(example = "/add_two_ints"))]
    pub name: Cow<'a, str>,
    /// Hidden by ROS convention: those of actions are.
    pub hidden: bool,
    /// ROS types; more than one is a fault.
    #[cfg_attr(feature = "openapi", schema(example = json!(["example_interfaces/srv/AddTwoInts"])))]
    pub types: Vec<Cow<'a, str>>,
    /// Who serves.
    pub servers: Vec<Party<'a>>,
    /// Who calls.
    pub clients: Vec<Party<'a>>,
    /// What was counted of its requests, where their DDS topic is watched.
    pub requests: Option<Measurement>,
    /// Likewise of its replies.
    pub replies: Option<Measurement>,
    /// What is wrong with its topics.
    #[cfg_attr(feature = "openapi", schema(value_type = Vec<Diagnosis<'static>>))]
    pub diagnoses: Vec<Finding<'a>>,
}

/// Actions.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct ActionList<'a> {
    /// Unix time of the facts.
    pub timestamp_seconds: f64,
    /// By domain and name.
    pub actions: Vec<Action<'a>>,
}

/// One action.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Action<'a> {
    /// Domain.
    pub domain_id: u32,
    /// ROS name.
    #[cfg_attr(feature = "openapi", schema(example = "/fibonacci"))]
    pub name: String,
    /// ROS types; more than one is a fault.
    #[cfg_attr(feature = "openapi", schema(example = json!(["example_interfaces/action/Fibonacci"])))]
    pub types: Vec<Cow<'a, str>>,
    /// Who serves.
    pub servers: Vec<Party<'a>>,
    /// Who calls: whoever only reads the feedback is not among them.
    pub clients: Vec<Party<'a>>,
    /// Its topics and services, by their DDS names.
    pub parts: Vec<Cow<'a, str>>,
    /// What is wrong with them.
    #[cfg_attr(feature = "openapi", schema(value_type = Vec<Diagnosis<'static>>))]
    pub diagnoses: Vec<Finding<'a>>,
}

/// A node, or a participant without one, at one end of a service or action.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Party<'a> {
    /// The node, as `ros_discovery_info` announces it; null when unknown.
    pub node: Option<Cow<'a, str>>,
    /// Its participant.
    pub participant: String,
    /// Its writers and readers there.
    pub endpoints: Vec<String>,
}
