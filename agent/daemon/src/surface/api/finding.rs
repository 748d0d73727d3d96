//! Problems of the graph in answers.

use std::borrow::Cow;

use super::endpoint::{printed, texts};
use ros2probe_api::diagnosis::{Diagnosis, Finding};
use ros2probe_model::diagnosis;

/// Returns the answer's form of a problem.
pub(super) fn diagnosis(finding: &diagnosis::Diagnosis) -> Finding<'_> {
    let known = match finding {
        diagnosis::Diagnosis::QosIncompatible {
            writer,
            reader,
            policies,
            ..
        } => Diagnosis::QosIncompatible {
            writer: writer.to_string(),
            reader: reader.to_string(),
            policies: policies
                .iter()
                .map(|policy| policy.label().into())
                .collect(),
        },
        diagnosis::Diagnosis::TypeConflict { types, .. } => Diagnosis::TypeConflict {
            types: texts(types),
        },
        diagnosis::Diagnosis::TypeHashConflict {
            message_type,
            hashes,
            ..
        } => Diagnosis::TypeHashConflict {
            message_type: Cow::Borrowed(message_type),
            hashes: printed(hashes),
        },
        diagnosis::Diagnosis::DuplicateNode { participants, .. } => Diagnosis::DuplicateNode {
            participants: printed(participants),
        },
        diagnosis::Diagnosis::UnheardPublisher { writer, reason, .. } => {
            Diagnosis::UnheardPublisher {
                writer: writer.to_string(),
                reason: reason.label().into(),
            }
        }
        diagnosis::Diagnosis::UnfedSubscriber { reader, reason, .. } => {
            Diagnosis::UnfedSubscriber {
                reader: reader.to_string(),
                reason: reason.label().into(),
            }
        }
        diagnosis::Diagnosis::HangingCall { writer, .. } => Diagnosis::HangingCall {
            writer: writer.to_string(),
        },
        diagnosis::Diagnosis::NodeInSeveralDomains { domains, .. } => {
            Diagnosis::NodeInSeveralDomains {
                domains: domains.iter().map(|id| id.0).collect(),
            }
        }
    };
    Finding::Known(known)
}
