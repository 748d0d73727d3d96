//! Events with their attributes. A record is built from the facts when it is read, so unread events
//! cost no formatting.

mod finding;

use std::borrow::Cow;
use std::fmt::Display;

use ros2probe_wire::diagnostics::DiagnosticLevel;
use ros2probe_wire::discovery::Role;
use ros2probe_wire::names::DdsTopic;
use ros2probe_wire::{DomainId, Timestamp};

use super::table;
use crate::agent_facts::SourceKind;
use ros2probe_metrics::event::{Definition, Severity, Value};
use ros2probe_metrics::series_name::series_name;
use ros2probe_model::facts::churn;
use ros2probe_model::facts::diagnosis::Diagnosis;
use ros2probe_model::facts::event::{EventKind, LossBurst, truncated};
use ros2probe_model::facts::naming::Naming;
use ros2probe_model::report::snapshot::WatchState;

/// State of a managed node that handles an error (`lifecycle_msgs/msg/State`).
const ERROR_PROCESSING: &str = "errorprocessing";

/// An event of the robot or of the agent.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Occurrence {
    Robot(EventKind),
    Agent(AgentEvent),
}

/// An event of the agent.
#[derive(Clone, Debug, PartialEq)]
pub enum AgentEvent {
    /// The agent started.
    Started {
        /// Kind of the packet source.
        source: SourceKind,
    },
    /// Packets or records were lost before they reached the model.
    Dropped {
        /// `packets`, `records`, `datagrams` or `contended`.
        what: &'static str,
        /// Number lost since the last such event.
        count: u64,
    },
    /// The agent stopped observing.
    Blind {
        /// Reason of the failure.
        reason: String,
    },
    /// The agent observes again.
    Seeing {
        /// Duration of the failure in seconds.
        blind_seconds: f64,
    },
    /// A configuration was applied.
    Reloaded {
        /// Number of entries in the watchlist.
        watches: usize,
    },
    /// A configuration was rejected.
    ReloadFailed {
        /// Error of the configuration.
        error: String,
    },
    /// A client of the API added a watch.
    WatchAdded {
        /// Pattern of the watch.
        watch: String,
        /// Domain of the watch; `None` for all.
        domain_id: Option<u32>,
    },
    /// A client of the API removed a watch.
    WatchRemoved {
        /// Pattern of the watch.
        watch: String,
        /// Domain of the watch; `None` for all.
        domain_id: Option<u32>,
    },
    /// A recording began.
    RecordingStarted {
        /// Name of the recording.
        recording: String,
    },
    /// A recording ended.
    RecordingEnded {
        /// Name of the recording.
        recording: String,
        /// Messages in the bag.
        messages: u64,
        /// Messages that were sent and are not in the bag.
        missing: u64,
        /// Reason of the end, unless a client ended it.
        reason: Option<String>,
    },
    /// A snapshot was written, or writing it failed.
    SnapshotTaken {
        /// Name of the snapshot in the configuration.
        snapshot: String,
        /// Name of the trigger, `request` or `signal`.
        trigger: &'static str,
        /// Id of the event that met the trigger, if an event did.
        trigger_event_id: Option<String>,
        /// Name of the bag.
        recording: String,
        /// Messages in the bag.
        messages: u64,
        /// Reason of the failure.
        reason: Option<String>,
    },
    /// Events were suppressed because too many of one kind occurred in a second.
    Suppressed {
        /// Name of the events, or their common prefix and `*`.
        event: &'static str,
        /// Number of suppressed events.
        count: u64,
    },
}

impl Occurrence {
    /// Returns the definition of the event.
    pub(super) const fn definition(&self) -> &'static Definition {
        use churn::Event::{Appeared, Cascaded, Changed, Disposed, Expired};
        match self {
            Self::Robot(EventKind::Participant { change, .. }) => match change {
                Appeared => &table::PARTICIPANT_DISCOVERED,
                Changed => &table::PARTICIPANT_CHANGED,
                Disposed | Expired | Cascaded => &table::PARTICIPANT_LOST,
            },
            Self::Robot(EventKind::Endpoint { change, .. }) => match change {
                Appeared => &table::ENDPOINT_DISCOVERED,
                Changed => &table::ENDPOINT_CHANGED,
                Disposed | Expired | Cascaded => &table::ENDPOINT_LOST,
            },
            Self::Robot(EventKind::Node { change, .. }) => match change {
                Appeared | Changed => &table::NODE_DISCOVERED,
                Disposed | Expired | Cascaded => &table::NODE_LOST,
            },
            Self::Robot(EventKind::Lifecycle { .. }) => &table::LIFECYCLE_TRANSITION,
            Self::Robot(EventKind::Diagnostic { .. }) => &table::DIAGNOSTIC_CHANGED,
            Self::Robot(EventKind::Parameter(_)) => &table::PARAMETER_CHANGED,
            Self::Robot(EventKind::TransformJump { .. }) => &table::TRANSFORM_JUMPED,
            Self::Robot(EventKind::Loss(_)) => &table::MESSAGE_LOST,
            Self::Robot(EventKind::Expectation { .. }) => &table::EXPECTATION_CHANGED,
            Self::Robot(EventKind::Silence { .. }) => &table::TOPIC_SILENT,
            Self::Robot(EventKind::Diagnosis { resolved, finding }) => match (finding, resolved) {
                (Diagnosis::QosIncompatible { .. }, false) => &table::QOS_INCOMPATIBLE,
                (Diagnosis::QosIncompatible { .. }, true) => &table::QOS_RESOLVED,
                (Diagnosis::HangingCall { .. }, false) => &table::CALL_HANGING,
                (Diagnosis::HangingCall { .. }, true) => &table::CALL_RESOLVED,
                (_, false) => &table::GRAPH_DIAGNOSED,
                (_, true) => &table::GRAPH_RESOLVED,
            },
            Self::Agent(event) => match event {
                AgentEvent::Started { .. } => &table::STARTED,
                AgentEvent::Dropped { .. } => &table::CAPTURE_DROPPED,
                AgentEvent::Blind { .. } => &table::CAPTURE_BLIND,
                AgentEvent::Seeing { .. } => &table::CAPTURE_SEEING,
                AgentEvent::Reloaded { .. } => &table::CONFIG_RELOADED,
                AgentEvent::ReloadFailed { .. } => &table::CONFIG_REFUSED,
                AgentEvent::RecordingStarted { .. } => &table::RECORDING_STARTED,
                AgentEvent::RecordingEnded { .. } => &table::RECORDING_ENDED,
                AgentEvent::SnapshotTaken { .. } => &table::SNAPSHOT_TAKEN,
                AgentEvent::WatchAdded { .. } => &table::WATCH_ADDED,
                AgentEvent::WatchRemoved { .. } => &table::WATCH_REMOVED,
                AgentEvent::Suppressed { .. } => &table::SUPPRESSED,
            },
        }
    }

    pub(super) fn severity(&self) -> Severity {
        let definition = self.definition();
        let relieves = match self {
            Self::Robot(EventKind::Participant { change, .. }) => *change == churn::Event::Disposed,
            Self::Robot(EventKind::Lifecycle { to, .. }) => **to != *ERROR_PROCESSING,
            // Without a subscriber, most publishers send nothing.
            Self::Robot(EventKind::Expectation { to, .. }) => {
                matches!(to, WatchState::Ok | WatchState::NoSubscriber)
            }
            Self::Robot(EventKind::Diagnostic { status, .. }) => {
                status.level == DiagnosticLevel::Ok
            }
            // These findings are common while nodes start, and with tools that publish without a
            // subscriber.
            Self::Robot(EventKind::Diagnosis { finding, .. }) => matches!(
                finding,
                Diagnosis::UnmatchedPublisher { .. }
                    | Diagnosis::UnmatchedSubscription { .. }
                    | Diagnosis::RestampingNode { .. }
                    | Diagnosis::BuffersByCpu { .. }
            ),
            Self::Agent(
                AgentEvent::RecordingEnded { reason, .. }
                | AgentEvent::SnapshotTaken { reason, .. },
            ) => reason.is_none(),
            _ => false,
        };
        if relieves {
            definition.resolved_severity
        } else {
            definition.severity
        }
    }

    /// Returns the attributes by name, in any order; the value of an unknown attribute is `None`.
    fn values(&self, at: Timestamp) -> Values {
        match self {
            Self::Robot(kind) => robot(kind, at),
            Self::Agent(event) => agent(event),
        }
    }

    /// Returns the known attributes in the table's order.
    pub(super) fn attributes(&self, at: Timestamp) -> Vec<(&'static str, Value)> {
        let mut values = self.values(at);
        let names = self.definition().attributes.iter();
        let attributes = names.filter_map(|name| {
            let place = values.iter().position(|(key, _)| key == name)?;
            Some((*name, values.swap_remove(place).1?))
        });
        let attributes = attributes.collect();
        debug_assert!(
            values.iter().all(|(_, value)| value.is_none()),
            "{values:?}"
        );
        attributes
    }
}

type Values = Vec<(&'static str, Option<Value>)>;

fn robot(kind: &EventKind, at: Timestamp) -> Values {
    let ago = |last| Value::Real(seconds(at, last));
    match kind {
        EventKind::Participant {
            change,
            domain_id,
            guid,
            vendor,
            host,
            process,
        } => vec![
            domain(*domain_id),
            ("participant", written(guid)),
            ("vendor", written(vendor)),
            ("host", host.as_deref().map(text)),
            ("process", process.as_deref().map(text)),
            cause(change),
        ],
        EventKind::Endpoint {
            change,
            domain_id,
            guid,
            role,
            topic,
            message_type,
        } => {
            let naming = naming(topic);
            let kind = naming.as_ref().map(|naming| text(naming.kind.label()));
            vec![
                domain(*domain_id),
                ("topic", Some(text(&series(naming.as_ref(), topic)))),
                ("kind", kind),
                ("role", Some(text(self::role(*role)))),
                ("endpoint", written(guid)),
                ("message_type", Some(text(message_type))),
                cause(change),
            ]
        }
        EventKind::Node {
            change,
            domain_id,
            participant,
            name,
        } => vec![
            domain(*domain_id),
            ("ros_node", Some(text(name))),
            ("participant", written(participant)),
            cause(change),
        ],
        EventKind::Lifecycle {
            domain_id,
            node,
            process,
            from,
            to,
        } => vec![
            domain(*domain_id),
            ("ros_node", node.as_deref().map(text)),
            ("process_id", process.and_then(number)),
            ("from", Some(text(from))),
            ("to", Some(text(to))),
        ],
        EventKind::Diagnostic { before, status } => vec![
            domain(status.domain_id),
            ("topic", Some(text(&status.topic))),
            ("name", Some(text(&status.name))),
            ("hardware_id", Some(text(&status.hardware_id))),
            ("ros_node", status.node.as_deref().map(text)),
            ("from", before.map(|level| text(level.label()))),
            ("to", Some(text(status.level.label()))),
            ("message", Some(text(&status.message))),
        ],
        EventKind::TransformJump {
            domain_id,
            namespace,
            parent,
            child,
            node,
            jump,
        } => vec![
            domain(*domain_id),
            ("namespace", Some(text(namespace))),
            ("parent", Some(text(parent))),
            ("child", Some(text(child))),
            ("ros_node", node.as_deref().map(text)),
            ("kind", Some(text(jump.label()))),
        ],
        EventKind::Parameter(change) => {
            let client = change.requested_by.as_ref();
            let client = client.and_then(|client| client.node.as_deref());
            vec![
                domain(change.domain_id),
                ("ros_node", Some(text(&change.node))),
                ("parameter", Some(text(&change.name))),
                ("from", change.before.as_deref().map(text)),
                ("to", change.value.as_deref().map(text)),
                ("requested_by", client.map(text)),
            ]
        }
        EventKind::Loss(loss) => self::loss(loss),
        EventKind::Expectation {
            domain_id,
            topic,
            watch,
            from,
            to,
            violations,
        } => vec![
            domain(*domain_id),
            ("topic", Some(text(topic))),
            ("watch", Some(text(watch))),
            ("from", from.map(|from| text(from.label()))),
            ("to", Some(text(to.label()))),
            ("violations", list(violations)),
        ],
        EventKind::Silence {
            domain_id,
            topic,
            watch,
            last_message,
        } => vec![
            domain(*domain_id),
            ("topic", Some(text(topic))),
            ("watch", Some(text(watch))),
            ("last_message_seconds_ago", last_message.map(ago)),
        ],
        EventKind::Diagnosis { finding, .. } => finding::finding(finding),
    }
}

fn domain(domain_id: DomainId) -> (&'static str, Option<Value>) {
    ("domain_id", number(domain_id.0))
}

/// Returns the attribute `cause`, which has a value if the entity left.
fn cause(change: &churn::Event) -> (&'static str, Option<Value>) {
    use churn::Event::{Cascaded, Disposed, Expired};
    let went = matches!(change, Disposed | Expired | Cascaded);
    ("cause", went.then(|| text(change.label())))
}

const fn role(role: Role) -> &'static str {
    match role {
        Role::Writer => "writer",
        Role::Reader => "reader",
    }
}

fn loss(loss: &LossBurst) -> Values {
    let name = |topic: &str| text(&series(naming(topic).as_ref(), topic));
    let topic = loss.topic.as_ref();
    vec![
        (
            "domain_id",
            topic.and_then(|(domain_id, _)| number(*domain_id)),
        ),
        ("topic", topic.map(|(_, topic)| name(topic))),
        ("writer", written(&loss.writer)),
        ("ros_node", loss.node.as_deref().map(text)),
        ("count", number(loss.count)),
        ("first_sequence_number", number(loss.first.0)),
        ("last_sequence_number", number(loss.last.0)),
    ]
}

fn agent(event: &AgentEvent) -> Values {
    match event {
        AgentEvent::Started { source } => vec![
            ("version", Some(text(env!("CARGO_PKG_VERSION")))),
            ("source", Some(text(source.label()))),
        ],
        AgentEvent::Dropped { what, count } => {
            vec![("what", Some(text(what))), ("count", number(*count))]
        }
        AgentEvent::Blind { reason } => vec![("reason", Some(text(reason)))],
        AgentEvent::Seeing { blind_seconds } => {
            vec![("blind_seconds", Some(Value::Real(*blind_seconds)))]
        }
        AgentEvent::Reloaded { watches } => vec![("watches", number(*watches as u64))],
        AgentEvent::ReloadFailed { error } => vec![("error", Some(text(error)))],
        AgentEvent::WatchAdded { watch, domain_id }
        | AgentEvent::WatchRemoved { watch, domain_id } => vec![
            ("watch", Some(text(watch))),
            ("watch_domain_id", domain_id.and_then(number)),
        ],
        AgentEvent::RecordingStarted { recording } => vec![("recording", Some(text(recording)))],
        AgentEvent::RecordingEnded {
            recording,
            messages,
            missing,
            reason,
        } => vec![
            ("recording", Some(text(recording))),
            ("messages", number(*messages)),
            ("missing", number(*missing)),
            ("reason", reason.as_deref().map(text)),
        ],
        AgentEvent::SnapshotTaken {
            snapshot,
            trigger,
            trigger_event_id,
            recording,
            messages,
            reason,
        } => vec![
            ("snapshot", Some(text(snapshot))),
            ("trigger", Some(text(trigger))),
            ("trigger_event_id", trigger_event_id.as_deref().map(text)),
            ("recording", Some(text(recording))),
            ("messages", number(*messages)),
            ("reason", reason.as_deref().map(text)),
        ],
        AgentEvent::Suppressed { event, count } => {
            vec![("event", Some(text(event))), ("count", number(*count))]
        }
    }
}

fn naming(topic: &str) -> Option<Naming> {
    DdsTopic::parse(topic).ok().map(|topic| Naming::of(&topic))
}

/// Returns the topic name as in the metrics.
fn series<'a>(naming: Option<&'a Naming>, topic: &'a str) -> Cow<'a, str> {
    naming.map_or(Cow::Borrowed(topic), |naming| {
        series_name(naming.kind, &naming.name, &naming.dds_name)
    })
}

fn list<T: Display>(items: impl IntoIterator<Item = T>) -> Option<Value> {
    let items = items.into_iter();
    let texts = items.map(|item| truncated(&item.to_string()).to_owned());
    Some(Value::List(texts.collect()))
}

fn text(text: &str) -> Value {
    Value::Text(truncated(text).to_owned())
}

fn written(value: &impl Display) -> Option<Value> {
    Some(Value::Text(value.to_string()))
}

fn number(number: impl Into<u64>) -> Option<Value> {
    Some(Value::Number(number.into()))
}

#[expect(
    clippy::cast_precision_loss,
    reason = "nanoseconds of a silence stay exact to 104 days"
)]
fn seconds(at: Timestamp, last: Timestamp) -> f64 {
    at.nanoseconds_since(last) as f64 / 1e9
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_disposed_participant_is_reported_as_info_and_an_expired_one_as_warning() {
        let lost = |change| {
            Occurrence::Robot(EventKind::Participant {
                change,
                domain_id: DomainId(0),
                guid: ros2probe_wire::Guid::from_bytes([1; 16]),
                vendor: ros2probe_wire::rtps::VendorId([1, 0x0f]),
                host: None,
                process: None,
            })
        };
        assert_eq!(lost(churn::Event::Disposed).severity(), Severity::Info);
        assert_eq!(lost(churn::Event::Expired).severity(), Severity::Warn);
    }
}
