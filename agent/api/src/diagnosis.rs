//! Problems of the ROS graph, found by comparing its endpoints and nodes.

use std::borrow::Cow;

use serde::{Deserialize, Serialize};

use crate::Open;
use crate::attributes::{Attributes, Value};

/// A problem of the graph.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum Diagnosis<'a> {
    /// A writer and a reader do not match: the writer offers less than the reader requests.
    QosIncompatible {
        /// GUID of the writer.
        writer: String,
        /// GUID of the reader.
        reader: String,
        /// Names of the incompatible QoS policies.
        #[cfg_attr(feature = "openapi", schema(example = json!(["reliability"])))]
        policies: Vec<Cow<'static, str>>,
    },
    /// Endpoints of one topic have different types, so they do not match.
    TypeConflict {
        /// ROS types in use.
        types: Vec<Cow<'a, str>>,
    },
    /// Endpoints have different definitions of one type and misread each other's messages.
    TypeHashConflict {
        /// ROS type.
        message_type: Cow<'a, str>,
        /// RIHS01 hashes in use.
        hashes: Vec<String>,
    },
    /// Several nodes of one domain have the same name.
    DuplicateNode {
        /// GUID of each node's participant.
        participants: Vec<String>,
    },
    /// A writer without a matching reader.
    UnheardPublisher {
        /// GUID of the writer.
        writer: String,
        /// The nearest mismatch: an endpoint with other QoS (`qos`), of another `type`, or in
        /// another `partition`; `nobody` if the topic has no reader.
        reason: Cow<'static, str>,
    },
    /// A reader without a matching writer.
    UnfedSubscriber {
        /// GUID of the reader.
        reader: String,
        /// The nearest mismatch: `qos`, `type` or `partition`; `nobody` if the topic
        /// has no writer.
        reason: Cow<'static, str>,
    },
    /// A client has called a service and received no reply within `service_timeout_s`.
    HangingCall {
        /// GUID of the client's writer.
        writer: String,
    },
    /// One node appears in several domains on one machine.
    NodeInSeveralDomains {
        /// Domain ids in which the node appears.
        domains: Cow<'a, [u32]>,
    },
}

/// A problem of the graph; `Unknown` keeps a kind that only a newer agent reports.
pub type Finding<'a> = Open<Diagnosis<'a>, Attributes<'a>>;

impl Diagnosis<'_> {
    /// Returns the value of `kind`.
    #[must_use]
    pub const fn kind(&self) -> &'static str {
        match self {
            Self::QosIncompatible { .. } => "qos_incompatible",
            Self::TypeConflict { .. } => "type_conflict",
            Self::TypeHashConflict { .. } => "type_hash_conflict",
            Self::DuplicateNode { .. } => "duplicate_node",
            Self::UnheardPublisher { .. } => "unheard_publisher",
            Self::UnfedSubscriber { .. } => "unfed_subscriber",
            Self::HangingCall { .. } => "hanging_call",
            Self::NodeInSeveralDomains { .. } => "node_in_several_domains",
        }
    }
}

impl Finding<'_> {
    /// Returns the value of `kind`, or an empty string if it is missing.
    #[must_use]
    pub fn kind(&self) -> &str {
        match self {
            Self::Known(diagnosis) => diagnosis.kind(),
            Self::Unknown(attributes) => match attributes.get("kind") {
                Some(Value::Text(kind)) => kind,
                _ => "",
            },
        }
    }
}
