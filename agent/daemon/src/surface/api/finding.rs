//! What is wrong with the graph, as answers show it.

use ros2probe_wire::Guid;
use ros2probe_wire::discovery::TypeHash;
use serde::Serialize;
use utoipa::ToSchema;

use super::endpoint::{text, texts};
use ros2probe_model::diagnosis::{Diagnosis, Policy};

/// One finding.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = Diagnosis)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub(super) enum FindingView<'a> {
    /// Writer and reader do not talk: the one offers less than the other requests.
    QosIncompatible {
        /// Who offers.
        #[serde(serialize_with = "text")]
        #[schema(value_type = String)]
        writer: Guid,
        /// Who requests.
        #[serde(serialize_with = "text")]
        #[schema(value_type = String)]
        reader: Guid,
        /// In which policies.
        #[schema(value_type = Vec<String>, example = json!(["reliability"]))]
        policies: Vec<&'static str>,
    },
    /// Endpoints of different types do not talk.
    TypeConflict {
        /// ROS types.
        #[schema(value_type = Vec<String>)]
        types: Vec<&'a str>,
    },
    /// Endpoints with different definitions of a type misread each other.
    TypeHashConflict {
        /// ROS type.
        message_type: &'a str,
        /// RIHS01 hashes.
        #[serde(serialize_with = "texts")]
        #[schema(value_type = Vec<String>)]
        hashes: &'a [TypeHash],
    },
    /// Several nodes of one name in one domain.
    DuplicateNode {
        /// The participant of each.
        #[serde(serialize_with = "texts")]
        #[schema(value_type = Vec<String>)]
        participants: &'a [Guid],
    },
    /// A writer without a matching reader.
    UnheardPublisher {
        /// Who.
        #[serde(serialize_with = "text")]
        #[schema(value_type = String)]
        writer: Guid,
        /// What is nearest to a match: somebody with other QoS (`qos`), of another `type`, in another
        /// `partition`, or `nobody`.
        #[schema(value_type = String)]
        reason: &'static str,
    },
    /// A reader without a matching writer.
    UnfedSubscriber {
        /// Who.
        #[serde(serialize_with = "text")]
        #[schema(value_type = String)]
        reader: Guid,
        /// As for a writer.
        #[schema(value_type = String)]
        reason: &'static str,
    },
    /// One node in several domains on one machine.
    NodeInSeveralDomains {
        /// Domains.
        domains: Vec<u32>,
    },
}

impl<'a> From<&'a Diagnosis> for FindingView<'a> {
    fn from(finding: &'a Diagnosis) -> Self {
        match finding {
            Diagnosis::QosIncompatible {
                writer,
                reader,
                policies,
                ..
            } => Self::QosIncompatible {
                writer: *writer,
                reader: *reader,
                policies: policies.iter().map(Policy::label).collect(),
            },
            Diagnosis::TypeConflict { types, .. } => Self::TypeConflict {
                types: types.iter().map(AsRef::as_ref).collect(),
            },
            Diagnosis::TypeHashConflict {
                message_type,
                hashes,
                ..
            } => Self::TypeHashConflict {
                message_type,
                hashes,
            },
            Diagnosis::DuplicateNode { participants, .. } => Self::DuplicateNode { participants },
            Diagnosis::UnheardPublisher { writer, reason, .. } => Self::UnheardPublisher {
                writer: *writer,
                reason: reason.label(),
            },
            Diagnosis::UnfedSubscriber { reader, reason, .. } => Self::UnfedSubscriber {
                reader: *reader,
                reason: reason.label(),
            },
            Diagnosis::NodeInSeveralDomains { domains, .. } => Self::NodeInSeveralDomains {
                domains: domains.iter().map(|id| id.0).collect(),
            },
        }
    }
}
