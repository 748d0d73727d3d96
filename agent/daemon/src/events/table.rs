//! Table of all events: name, severity, attributes and help. Streams, log records of OpenTelemetry,
//! the table of `docs/events.md` and the tests derive from it; names are spelled only here.
//!
//! Attributes have the names of the metrics' labels, so that events and series can be joined.

use ros2probe_metrics::event::{Definition, Severity};

const PARTICIPANT: &[&str] = &["domain_id", "participant", "vendor", "host", "process"];
const PARTICIPANT_GONE: &[&str] = &[
    "domain_id",
    "participant",
    "vendor",
    "host",
    "process",
    "cause",
];
const ENDPOINT: &[&str] = &[
    "domain_id",
    "topic",
    "kind",
    "role",
    "endpoint",
    "message_type",
];
const ENDPOINT_GONE: &[&str] = &[
    "domain_id",
    "topic",
    "kind",
    "role",
    "endpoint",
    "message_type",
    "cause",
];
const QOS: &[&str] = &["domain_id", "topic", "writer", "reader", "policies"];
const CALL: &[&str] = &["domain_id", "ros_service", "writer"];
const FINDING: &[&str] = &[
    "diagnosis",
    "domain_id",
    "topic",
    "message_types",
    "type_hashes",
    "writer",
    "reader",
    "reason",
    "ros_node",
    "participants",
    "domains",
    "process_id",
    "trigger",
    "duration_seconds",
    "period_seconds",
    "wait_seconds",
    "late_calls",
    "stage",
    "cause",
    "by",
    "by_unit",
    "longest_seconds",
    "overwritten_ratio",
    "lost_ratio",
    "source",
    "destination",
    "retransmitted_ratio",
    "unsent_bytes",
    "log_errors",
    "log_text",
    "name",
    "hardware_id",
    "level",
    "message",
    "namespace",
    "fault",
    "parent",
    "child",
    "edges",
    "names",
    "peer",
    "offset_seconds",
    "uncertainty_seconds",
    "subscription",
    "difference",
    "state",
    "expected",
    "value",
    "simulated",
    "system",
    "used_ratio",
    "from",
    "max_latency_ms",
];

pub(super) const PARTICIPANT_DISCOVERED: Definition = Definition::new(
    "ros2.participant.discovered",
    Severity::Info,
    PARTICIPANT,
    "A participant announced itself for the first time, or again after leaving.",
);
pub(super) const PARTICIPANT_CHANGED: Definition = Definition::new(
    "ros2.participant.changed",
    Severity::Info,
    PARTICIPANT,
    "A participant announced itself with other properties.",
);
pub(super) const PARTICIPANT_LOST: Definition = Definition::new(
    "ros2.participant.lost",
    Severity::Warn,
    PARTICIPANT_GONE,
    "A participant left: its lease expired, or (INFO) it disposed of itself.",
)
.resolved_severity(Severity::Info);
pub(super) const ENDPOINT_DISCOVERED: Definition = Definition::new(
    "ros2.endpoint.discovered",
    Severity::Info,
    ENDPOINT,
    "A writer or reader was announced.",
);
pub(super) const ENDPOINT_CHANGED: Definition = Definition::new(
    "ros2.endpoint.changed",
    Severity::Info,
    ENDPOINT,
    "A writer or reader was announced with another type or quality of service.",
);
pub(super) const ENDPOINT_LOST: Definition = Definition::new(
    "ros2.endpoint.lost",
    Severity::Info,
    ENDPOINT_GONE,
    "A writer or reader left: it was disposed of, or its participant left.",
);
pub(super) const NODE_DISCOVERED: Definition = Definition::new(
    "ros2.node.discovered",
    Severity::Info,
    &["domain_id", "ros_node", "participant"],
    "A ROS node appeared.",
);
pub(super) const NODE_LOST: Definition = Definition::new(
    "ros2.node.lost",
    Severity::Info,
    &["domain_id", "ros_node", "participant", "cause"],
    "A ROS node left: it was disposed of, or its participant left.",
);
pub(super) const LIFECYCLE_TRANSITION: Definition = Definition::new(
    "ros2.node.lifecycle_transition",
    Severity::Warn,
    &["domain_id", "ros_node", "process_id", "from", "to"],
    "A managed node changed its lifecycle state; WARN if it is errorprocessing now. The process is \
     known with capture.inside.",
)
.resolved_severity(Severity::Info);
pub(super) const DIAGNOSTIC_CHANGED: Definition = Definition::new(
    "ros2.robot.diagnostic_changed",
    Severity::Warn,
    &[
        "domain_id",
        "topic",
        "name",
        "hardware_id",
        "ros_node",
        "from",
        "to",
        "message",
    ],
    "A part of the robot has another level in its diagnostics, or ceased to publish them (`stale`); \
     INFO if it is `ok` now.",
)
.resolved_severity(Severity::Info);
pub(super) const TRANSFORM_JUMPED: Definition = Definition::new(
    "ros2.robot.transform_jumped",
    Severity::Warn,
    &[
        "domain_id",
        "namespace",
        "parent",
        "child",
        "ros_node",
        "kind",
    ],
    "A transform differs suddenly from the last one of its edge: its translation, its rotation, or its \
     time, which went back.",
);
pub(super) const PARAMETER_CHANGED: Definition = Definition::new(
    "ros2.robot.parameter_changed",
    Severity::Info,
    &[
        "domain_id",
        "ros_node",
        "parameter",
        "from",
        "to",
        "requested_by",
    ],
    "A parameter of a node has another value; `requested_by` is the node of the client, if its \
     request was seen.",
);
pub(super) const MESSAGE_LOST: Definition = Definition::new(
    "ros2.message.lost",
    Severity::Warn,
    &[
        "domain_id",
        "topic",
        "writer",
        "ros_node",
        "count",
        "first_sequence_number",
        "last_sequence_number",
    ],
    "A subscriber lost messages of a measured writer; one event per second, with the count of the \
     subscriber that lost most.",
);
pub(super) const EXPECTATION_CHANGED: Definition = Definition::new(
    "ros2.topic.expectation_changed",
    Severity::Warn,
    &["domain_id", "topic", "watch", "from", "to", "violations"],
    "The state of a watched topic changed; INFO if it is ok, or without a subscriber, now.",
)
.resolved_severity(Severity::Info);
pub(super) const TOPIC_SILENT: Definition = Definition::new(
    "ros2.topic.silent",
    Severity::Warn,
    &["domain_id", "topic", "watch", "last_message_seconds_ago"],
    "A watched topic has publishers, but no message for longer than max_silence_s.",
);
pub(super) const QOS_INCOMPATIBLE: Definition = Definition::new(
    "ros2.qos.incompatible",
    Severity::Warn,
    QOS,
    "A publisher and a subscriber of one topic cannot communicate because of these policies.",
);
pub(super) const QOS_RESOLVED: Definition = Definition::new(
    "ros2.qos.resolved",
    Severity::Info,
    QOS,
    "Publisher and subscriber match now, or one of them left.",
);
pub(super) const GRAPH_DIAGNOSED: Definition = Definition::new(
    "ros2.graph.diagnosed",
    Severity::Warn,
    FINDING,
    "Another fault of the graph, named by `diagnosis`: type_conflict, type_hash_conflict, \
     duplicate_node, node_in_several_domains, slow_callback, executor_wait, \
     late_callback, intra_process_overflow, reader_queue_overflow, observation_suspended, \
     lossy_link, log_errors, diagnostic_error, transform_fault, clocks_apart, slow_chain, or (INFO) unmatched_publisher, unmatched_subscription, \
     restamping_node, buffers_by_cpu.",
)
.resolved_severity(Severity::Info);
pub(super) const GRAPH_RESOLVED: Definition = Definition::new(
    "ros2.graph.resolved",
    Severity::Info,
    FINDING,
    "The fault is gone; the attributes describe it.",
);
pub(super) const CALL_HANGING: Definition = Definition::new(
    "ros2.service.call_hanging",
    Severity::Warn,
    CALL,
    "A client called a service and received no reply within service_timeout_s.",
);
pub(super) const CALL_RESOLVED: Definition = Definition::new(
    "ros2.service.call_resolved",
    Severity::Info,
    CALL,
    "The client's calls are answered now, the client left, or ten minutes have passed.",
);

pub(super) const STARTED: Definition = Definition::new(
    "ros2probe.agent.started",
    Severity::Info,
    &["version", "source"],
    "The agent started; event ids start again.",
);
pub(super) const CAPTURE_DROPPED: Definition = Definition::new(
    "ros2probe.capture.dropped",
    Severity::Error,
    &["what", "count"],
    "The agent lost packets, records or datagrams because a buffer was full, or could not parse \
     them; its figures are lower bounds.",
);
pub(super) const CAPTURE_BLIND: Definition = Definition::new(
    "ros2probe.capture.blind",
    Severity::Error,
    &["reason"],
    "The agent no longer sees the robot: /readyz answers 503.",
);
pub(super) const CAPTURE_SEEING: Definition = Definition::new(
    "ros2probe.capture.seeing",
    Severity::Info,
    &["blind_seconds"],
    "The agent sees the robot again.",
);
pub(super) const CONFIG_RELOADED: Definition = Definition::new(
    "ros2probe.config.reloaded",
    Severity::Info,
    &["watches"],
    "The agent applied a new configuration.",
);
pub(super) const CONFIG_REFUSED: Definition = Definition::new(
    "ros2probe.config.reload_failed",
    Severity::Error,
    &["error"],
    "The agent rejected a new configuration; the previous one stays active.",
);
pub(super) const RECORDING_STARTED: Definition = Definition::new(
    "ros2probe.recording.started",
    Severity::Info,
    &["recording"],
    "The agent records topics into a bag.",
);
pub(super) const RECORDING_ENDED: Definition = Definition::new(
    "ros2probe.recording.ended",
    Severity::Error,
    &["recording", "messages", "missing", "reason"],
    "A bag is complete; with a reason if the storage failed.",
)
.resolved_severity(Severity::Info);
pub(super) const SNAPSHOT_TAKEN: Definition = Definition::new(
    "ros2probe.snapshot.taken",
    Severity::Error,
    &[
        "snapshot",
        "trigger",
        "trigger_event_id",
        "recording",
        "messages",
        "reason",
    ],
    "The messages around an incident are in a bag; with a reason if writing failed. `trigger` is \
     that of the configuration, `request` or `signal`.",
)
.resolved_severity(Severity::Info);
pub(super) const WATCH_ADDED: Definition = Definition::new(
    "ros2probe.watch.added",
    Severity::Info,
    &["watch", "watch_domain_id"],
    "A client added or changed a watch through the API.",
);
pub(super) const WATCH_REMOVED: Definition = Definition::new(
    "ros2probe.watch.removed",
    Severity::Info,
    &["watch", "watch_domain_id"],
    "A client removed a watch through the API.",
);
pub(super) const SUPPRESSED: Definition = Definition::new(
    "ros2probe.events.suppressed",
    Severity::Warn,
    &["event", "count"],
    "Too many events of one name or group in a second; the others are only counted.",
);

/// All events.
pub const EVENTS: &[Definition] = &[
    PARTICIPANT_DISCOVERED,
    PARTICIPANT_CHANGED,
    PARTICIPANT_LOST,
    ENDPOINT_DISCOVERED,
    ENDPOINT_CHANGED,
    ENDPOINT_LOST,
    NODE_DISCOVERED,
    NODE_LOST,
    LIFECYCLE_TRANSITION,
    DIAGNOSTIC_CHANGED,
    PARAMETER_CHANGED,
    TRANSFORM_JUMPED,
    MESSAGE_LOST,
    EXPECTATION_CHANGED,
    TOPIC_SILENT,
    QOS_INCOMPATIBLE,
    QOS_RESOLVED,
    GRAPH_DIAGNOSED,
    GRAPH_RESOLVED,
    CALL_HANGING,
    CALL_RESOLVED,
    STARTED,
    CAPTURE_DROPPED,
    CAPTURE_BLIND,
    CAPTURE_SEEING,
    CONFIG_RELOADED,
    CONFIG_REFUSED,
    WATCH_ADDED,
    WATCH_REMOVED,
    RECORDING_STARTED,
    RECORDING_ENDED,
    SNAPSHOT_TAKEN,
    SUPPRESSED,
];

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;

    #[test]
    fn event_names_are_unique_and_dotted_in_a_namespace_of_the_project() {
        let names: BTreeSet<&str> = EVENTS.iter().map(|event| event.name).collect();
        assert_eq!(names.len(), EVENTS.len());
        for event in EVENTS {
            let mut parts = event.name.split('.');
            assert!(matches!(parts.next(), Some("ros2" | "ros2probe")));
            assert_eq!(parts.clone().count(), 2, "{}", event.name);
            let plain = |c: char| c.is_ascii_lowercase() || c == '_';
            assert!(parts.all(|part| !part.is_empty() && part.chars().all(plain)));
            assert!(event.help.ends_with('.') && !event.help.contains(['\n', '|']));
            let attributes: BTreeSet<_> = event.attributes.iter().collect();
            assert_eq!(attributes.len(), event.attributes.len(), "{}", event.name);
        }
    }
}
