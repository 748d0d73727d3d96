//! What is wrong with the graph.

use std::borrow::Cow;

use serde::{Deserialize, Serialize};

use crate::Open;
use crate::attributes::{Attributes, Value};

/// One finding.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum Diagnosis<'a> {
    /// Writer and reader do not talk: the one offers less than the other requests.
    QosIncompatible {
        /// Who offers.
        writer: String,
        /// Who requests.
        reader: String,
        /// In which policies.
        #[cfg_attr(feature = "openapi", schema(example = json!(["reliability"])))]
        policies: Vec<Cow<'static, str>>,
    },
    /// Endpoints of different types do not talk.
    TypeConflict {
        /// ROS types.
        types: Vec<Cow<'a, str>>,
    },
    /// Endpoints with different definitions of a type misread each other.
    TypeHashConflict {
        /// ROS type.
        message_type: Cow<'a, str>,
        /// RIHS01 hashes.
        hashes: Vec<String>,
    },
    /// Several nodes of one name in one domain.
    DuplicateNode {
        /// The participant of each.
        participants: Vec<String>,
    },
    /// A writer without a matching reader.
    UnheardPublisher {
        /// Who.
        writer: String,
        /// The nearest candidate: an endpoint with other QoS (`qos`), of another `type`, in another
        /// `partition`, or `nobody` where there is no endpoint.
        reason: Cow<'static, str>,
    },
    /// A reader without a matching writer.
    UnfedSubscriber {
        /// Who.
        reader: String,
        /// As for a writer.
        reason: Cow<'static, str>,
    },
    /// One node in several domains on one machine.
    NodeInSeveralDomains {
        /// Domains.
        domains: Cow<'a, [u32]>,
    },
}

/// A finding, also of a kind that a newer agent has.
pub type Finding<'a> = Open<Diagnosis<'a>, Attributes<'a>>;

impl Diagnosis<'_> {
    /// Its `kind`.
    #[must_use]
    pub const fn kind(&self) -> &'static str {
        match self {
            Self::QosIncompatible { .. } => "qos_incompatible",
            Self::TypeConflict { .. } => "type_conflict",
            Self::TypeHashConflict { .. } => "type_hash_conflict",
            Self::DuplicateNode { .. } => "duplicate_node",
            Self::UnheardPublisher { .. } => "unheard_publisher",
            Self::UnfedSubscriber { .. } => "unfed_subscriber",
            Self::NodeInSeveralDomains { .. } => "node_in_several_domains",
        }
    }
}

impl Finding<'_> {
    /// Its `kind`; empty where it has none.
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
