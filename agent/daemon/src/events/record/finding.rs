//! Attributes of findings.

use std::time::Duration;

use super::{Values, domain, list, number, text, written};
use ros2probe_metrics::event::Value;
use ros2probe_metrics::series_name::series_name;
use ros2probe_model::derive::clocks;
use ros2probe_model::facts::diagnosis::{Diagnosis, Policy};
use ros2probe_model::facts::shared_memory::MemoryFault;

/// Returns the attributes of a finding.
pub(super) fn finding(finding: &Diagnosis) -> Values {
    let mut values = Vec::new();
    if let Diagnosis::HangingCall { topic, writer } = finding {
        return vec![
            domain(topic.domain_id),
            ("ros_service", Some(text(&topic.name))),
            ("writer", written(writer)),
        ];
    }
    if !matches!(finding, Diagnosis::QosIncompatible { .. }) {
        values.push(("diagnosis", Some(text(finding.kind()))));
    }
    if let Some(topic) = finding.topic() {
        let name = series_name(topic.kind, &topic.name, &topic.dds_name);
        values.push(("domain_id", number(topic.domain_id)));
        values.push(("topic", Some(text(&name))));
    }
    values.extend(match finding {
        Diagnosis::QosIncompatible {
            writer,
            reader,
            policies,
            ..
        } => vec![
            ("writer", written(writer)),
            ("reader", written(reader)),
            ("policies", list(policies.iter().map(Policy::label))),
        ],
        Diagnosis::TypeConflict { types, .. } => vec![("message_types", list(types))],
        Diagnosis::TypeHashConflict {
            message_type,
            hashes,
            ..
        } => vec![
            ("message_types", list([message_type])),
            ("type_hashes", list(hashes)),
        ],
        Diagnosis::DuplicateNode {
            domain_id,
            node,
            participants,
        } => vec![
            ("domain_id", number(*domain_id)),
            ("ros_node", Some(text(node))),
            ("participants", list(participants)),
        ],
        Diagnosis::UnmatchedPublisher { writer, reason, .. } => vec![
            ("writer", written(writer)),
            ("reason", Some(text(reason.label()))),
        ],
        Diagnosis::UnmatchedSubscription { reader, reason, .. } => vec![
            ("reader", written(reader)),
            ("reason", Some(text(reason.label()))),
        ],
        // The start of this function handles this case.
        Diagnosis::HangingCall { .. } => Vec::new(),
        Diagnosis::NodeInSeveralDomains {
            node,
            participant,
            domains,
        } => vec![
            ("ros_node", Some(text(node))),
            ("participants", list([participant])),
            ("domains", list(domains)),
        ],
        Diagnosis::SlowCallback { .. }
        | Diagnosis::ExecutorWait { .. }
        | Diagnosis::LateCallback { .. }
        | Diagnosis::IntraProcessOverflow { .. }
        | Diagnosis::ReaderQueueOverflow { .. }
        | Diagnosis::ObservationSuspended { .. } => inside(finding),
        Diagnosis::RestampingNode { node, input, .. } => {
            vec![("ros_node", Some(text(node))), ("from", Some(text(input)))]
        }
        Diagnosis::BuffersByCpu { writer, reader, .. } => {
            let reason = match reader {
                Some(_) => "no_buffers",
                None => "transient_local",
            };
            vec![
                ("writer", written(writer)),
                ("reader", reader.as_ref().and_then(written)),
                ("reason", Some(text(reason))),
            ]
        }
        Diagnosis::LogErrors {
            domain_id,
            node,
            errors,
            text: log_text,
        } => vec![
            ("domain_id", number(*domain_id)),
            ("ros_node", Some(text(node))),
            ("log_errors", number(*errors)),
            ("log_text", Some(text(log_text))),
        ],
        Diagnosis::DiagnosticError {
            domain_id,
            topic,
            node,
            name,
            hardware_id,
            level,
            message,
        } => vec![
            domain(*domain_id),
            ("topic", Some(text(topic))),
            ("ros_node", node.as_deref().map(text)),
            ("name", Some(text(name))),
            ("hardware_id", Some(text(hardware_id))),
            ("level", Some(text(level.label()))),
            ("message", Some(text(message))),
        ],
        Diagnosis::TransformFault {
            domain_id,
            namespace,
            fault,
        } => vec![
            ("domain_id", number(*domain_id)),
            ("namespace", Some(text(namespace))),
            ("fault", Some(text(fault.kind.label()))),
            ("parent", Some(text(&fault.parent))),
            ("child", Some(text(&fault.child))),
            ("edges", number(fault.edges as u64)),
            ("names", list(&fault.names)),
        ],
        Diagnosis::ClocksApart {
            peer,
            offset,
            uncertainty,
        } => vec![
            ("peer", Some(text(peer))),
            (
                "offset_seconds",
                Some(Value::Real(clocks::seconds(*offset))),
            ),
            (
                "uncertainty_seconds",
                Some(Value::Real(clocks::seconds(*uncertainty))),
            ),
        ],
        Diagnosis::NearMiss {
            subscription,
            difference,
            ..
        } => vec![
            ("subscription", Some(text(&subscription.name))),
            ("domains", list([subscription.domain_id])),
            ("difference", Some(text(difference.label()))),
        ],
        Diagnosis::NodeInactive {
            domain_id,
            node,
            state,
            has_failed,
        } => vec![
            domain(*domain_id),
            ("ros_node", Some(text(node))),
            ("state", Some(text(state.label()))),
            (
                "reason",
                Some(text(if *has_failed { "failed" } else { "expected" })),
            ),
        ],
        Diagnosis::ParameterDrift {
            domain_id,
            node,
            name,
            expected,
            value,
        } => vec![
            domain(*domain_id),
            ("ros_node", Some(text(node))),
            ("name", Some(text(name))),
            ("expected", Some(text(expected))),
            ("value", Some(text(value))),
        ],
        Diagnosis::MixedTime {
            domain_id,
            simulated,
            system,
        } => vec![
            domain(*domain_id),
            ("simulated", list(simulated)),
            ("system", list(system)),
        ],
        Diagnosis::WrongStamps {
            writer,
            fault,
            nanoseconds,
            ..
        } => vec![
            ("writer", written(writer)),
            ("fault", Some(text(fault.label()))),
            (
                "offset_seconds",
                Some(Value::Real(clocks::seconds(*nanoseconds))),
            ),
        ],
        Diagnosis::SharedMemoryFault { fault, figure } => vec![
            ("fault", Some(text(fault.label()))),
            match fault {
                MemoryFault::Full => ("used_ratio", Some(Value::Real(*figure as f64 / 1e3))),
                MemoryFault::Stale => ("stale_bytes", number(*figure)),
                MemoryFault::Split => ("directories", number(*figure)),
            },
        ],
        Diagnosis::LossyLink {
            link,
            retransmitted_permille,
            unsent,
        } => vec![
            ("source", written(&link.source)),
            ("destination", written(&link.destination)),
            (
                "retransmitted_ratio",
                Some(Value::Real(*retransmitted_permille as f64 / 1e3)),
            ),
            ("unsent_bytes", unsent.map(Value::Number)),
        ],
        Diagnosis::SlowChain {
            from, max_latency, ..
        } => vec![
            ("from", Some(text(from))),
            (
                "max_latency_ms",
                Some(Value::Real(max_latency.as_secs_f64() * 1e3)),
            ),
        ],
    });
    values
}

/// Returns the details of a finding from inside a process.
fn inside(finding: &Diagnosis) -> Values {
    let seconds = |duration: &Duration| Some(Value::Real(duration.as_secs_f64()));
    let mut values = Vec::new();
    if let Some(owner) = finding.owner() {
        if finding.topic().is_none() {
            values.push(domain(owner.domain_id));
        }
        values.push(("ros_node", owner.node.as_deref().map(text)));
        values.push(("process_id", number(owner.process)));
    }
    match finding {
        Diagnosis::SlowCallback {
            trigger,
            duration,
            period,
            ..
        } => values.extend([
            ("trigger", Some(text(trigger.label()))),
            ("duration_seconds", seconds(duration)),
            ("period_seconds", seconds(period)),
        ]),
        Diagnosis::ExecutorWait { trigger, wait, .. } => values.extend([
            ("trigger", Some(text(trigger.label()))),
            ("wait_seconds", seconds(wait)),
        ]),
        Diagnosis::LateCallback {
            trigger,
            calls,
            stage,
            cause,
            by,
            longest,
            ..
        } => values.extend([
            ("trigger", Some(text(trigger.label()))),
            ("late_calls", number(*calls)),
            ("stage", Some(text(stage.label()))),
            ("cause", Some(text(cause.label()))),
            ("by", by.as_ref().map(|by| text(&by.name))),
            (
                "by_unit",
                by.as_ref().and_then(|by| by.unit.as_deref().map(text)),
            ),
            ("longest_seconds", seconds(longest)),
        ]),
        Diagnosis::IntraProcessOverflow {
            overwritten_permille,
            ..
        } => {
            let ratio = Duration::from_millis(*overwritten_permille);
            values.push(("overwritten_ratio", seconds(&ratio)));
        }
        Diagnosis::ReaderQueueOverflow { lost_permille, .. } => {
            let ratio = Duration::from_millis(*lost_permille);
            values.push(("lost_ratio", seconds(&ratio)));
        }
        Diagnosis::ObservationSuspended {
            domain_id, process, ..
        } => values.extend([domain(*domain_id), ("process_id", number(*process))]),
        _ => {}
    }
    values
}
