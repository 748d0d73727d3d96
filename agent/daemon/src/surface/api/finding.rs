//! Problems of the graph in answers.

use std::borrow::Cow;

use super::endpoint::{printed, texts};
use super::inside::trigger;
use ros2probe_api::diagnosis::{Diagnosis, Finding};
use ros2probe_model::derive::clocks::seconds;
use ros2probe_model::facts::diagnosis;
use ros2probe_model::facts::shared_memory::MemoryFault;

/// Returns the API representation of a problem.
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
        diagnosis::Diagnosis::UnmatchedPublisher { writer, reason, .. } => {
            Diagnosis::UnmatchedPublisher {
                writer: writer.to_string(),
                reason: reason.label().into(),
            }
        }
        diagnosis::Diagnosis::UnmatchedSubscription { reader, reason, .. } => {
            Diagnosis::UnmatchedSubscription {
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
        diagnosis::Diagnosis::SlowCallback {
            callback,
            trigger: triggered,
            duration,
            period,
            is_own_period,
            ..
        } => Diagnosis::SlowCallback {
            node: callback.node.as_deref().map(Cow::Borrowed),
            process_id: callback.process,
            trigger: trigger(triggered),
            duration_seconds: duration.as_secs_f64(),
            period_seconds: period.as_secs_f64(),
            own_period: *is_own_period,
        },
        diagnosis::Diagnosis::ExecutorWait {
            callback,
            trigger: triggered,
            wait,
            ..
        } => Diagnosis::ExecutorWait {
            node: callback.node.as_deref().map(Cow::Borrowed),
            process_id: callback.process,
            trigger: trigger(triggered),
            wait_seconds: wait.as_secs_f64(),
        },
        diagnosis::Diagnosis::LateCallback {
            callback,
            trigger: triggered,
            calls,
            stage,
            cause,
            by,
            longest,
            ..
        } => Diagnosis::LateCallback {
            node: callback.node.as_deref().map(Cow::Borrowed),
            process_id: callback.process,
            trigger: trigger(triggered),
            late_calls: *calls,
            stage: stage.label().into(),
            cause: cause.label().into(),
            by: by.as_ref().map(|by| Cow::Borrowed(&*by.name)),
            by_unit: by
                .as_ref()
                .and_then(|by| Some(Cow::Borrowed(by.unit.as_deref()?))),
            words: cause.in_words(by.as_ref().map(|by| by as _)).into(),
            longest_seconds: longest.as_secs_f64(),
        },
        diagnosis::Diagnosis::IntraProcessOverflow {
            queue,
            overwritten_permille,
            ..
        } => Diagnosis::IntraProcessOverflow {
            node: queue.node.as_deref().map(Cow::Borrowed),
            process_id: queue.process,
            overwritten_ratio: thousandths(*overwritten_permille),
        },
        diagnosis::Diagnosis::ReaderQueueOverflow {
            queue,
            lost_permille,
            depth,
            ..
        } => Diagnosis::ReaderQueueOverflow {
            node: queue.node.as_deref().map(Cow::Borrowed),
            process_id: queue.process,
            lost_ratio: thousandths(*lost_permille),
            depth: *depth,
        },
        diagnosis::Diagnosis::ObservationSuspended { process, name, .. } => {
            Diagnosis::ObservationSuspended {
                process_id: *process,
                process: name.as_deref().map(Cow::Borrowed),
            }
        }
        diagnosis::Diagnosis::RestampingNode { node, input, .. } => Diagnosis::RestampingNode {
            node: Cow::Borrowed(node),
            input: Cow::Borrowed(input),
        },
        diagnosis::Diagnosis::BuffersByCpu {
            writer,
            reader,
            backends,
            ..
        } => Diagnosis::BuffersByCpu {
            writer: writer.to_string(),
            reader: reader.map(|reader| reader.to_string()),
            backends: texts(backends),
        },
        diagnosis::Diagnosis::LossyLink {
            link,
            retransmitted_permille,
            unsent,
        } => Diagnosis::LossyLink {
            source: link.source,
            destination: link.destination,
            retransmitted_ratio: thousandths(*retransmitted_permille),
            unsent_bytes: *unsent,
        },
        diagnosis::Diagnosis::LogErrors { errors, text, .. } => Diagnosis::LogErrors {
            errors: *errors,
            text: Cow::Borrowed(text),
        },
        diagnosis::Diagnosis::DiagnosticError {
            node,
            name,
            hardware_id,
            level,
            message,
            ..
        } => Diagnosis::DiagnosticError {
            ros_node: node.as_deref().map(Cow::Borrowed),
            name: Cow::Borrowed(name),
            hardware_id: Cow::Borrowed(hardware_id),
            level: level.label().into(),
            message: Cow::Borrowed(message),
        },
        diagnosis::Diagnosis::TransformFault {
            namespace, fault, ..
        } => Diagnosis::TransformFault {
            namespace: Cow::Borrowed(namespace),
            fault: fault.kind.label().into(),
            parent: Cow::Borrowed(&fault.parent),
            child: Cow::Borrowed(&fault.child),
            edges: fault.edges as u64,
            names: fault
                .names
                .iter()
                .map(|name| Cow::Borrowed(&**name))
                .collect(),
        },
        diagnosis::Diagnosis::ClocksApart {
            peer,
            offset,
            uncertainty,
        } => Diagnosis::ClocksApart {
            peer: Cow::Borrowed(peer),
            offset_seconds: seconds(*offset),
            uncertainty_seconds: seconds(*uncertainty),
        },
        diagnosis::Diagnosis::NearMiss {
            subscription,
            difference,
            ..
        } => Diagnosis::NearMiss {
            subscription: Cow::Borrowed(&subscription.name),
            subscription_domain_id: subscription.domain_id.0,
            difference: difference.label().into(),
        },
        diagnosis::Diagnosis::NodeInactive {
            state, has_failed, ..
        } => Diagnosis::NodeInactive {
            state: state.label().into(),
            failed: *has_failed,
        },
        diagnosis::Diagnosis::ParameterDrift {
            name,
            expected,
            value,
            ..
        } => Diagnosis::ParameterDrift {
            name: Cow::Borrowed(name),
            expected: Cow::Borrowed(expected),
            value: Cow::Borrowed(value),
        },
        diagnosis::Diagnosis::MixedTime {
            simulated, system, ..
        } => Diagnosis::MixedTime {
            simulated: texts(simulated),
            system: texts(system),
        },
        diagnosis::Diagnosis::WrongStamps {
            writer,
            fault,
            nanoseconds,
            ..
        } => Diagnosis::WrongStamps {
            writer: writer.to_string(),
            fault: fault.label().into(),
            offset_seconds: seconds(*nanoseconds),
        },
        diagnosis::Diagnosis::SharedMemoryFault { fault, figure } => {
            let figure_of = |of| (*fault == of).then_some(*figure);
            Diagnosis::SharedMemoryFault {
                fault: fault.label().into(),
                used_ratio: figure_of(MemoryFault::Full).map(thousandths),
                stale_bytes: figure_of(MemoryFault::Stale),
                directories: figure_of(MemoryFault::Split),
            }
        }
        diagnosis::Diagnosis::SlowChain {
            from, max_latency, ..
        } => Diagnosis::SlowChain {
            from: Cow::Borrowed(from),
            max_latency_ms: max_latency.as_secs_f64() * 1e3,
        },
    };
    Finding::Known(known)
}

#[expect(clippy::cast_precision_loss, reason = "at most 1000")]
fn thousandths(permille: u64) -> f64 {
    permille as f64 / 1e3
}
