//! Every metric of the agent, declared once: name, type, unit, labels, help, stability. The
//! renderer, the tables of `docs/metrics-*.md` and the tests derive from it; no other code spells a
//! metric name.
//!
//! Names follow the Prometheus naming practices. Series of topics have only the labels `domain_id`
//! and `topic`; details are in one info series.

#![expect(missing_docs, reason = "the help of a metric describes it")]

mod agent;
mod chain;
mod delivery;
mod diagnosis;
mod inside;
mod link;
mod robot;
mod service;
mod zenoh;

use crate::stability::Stability;
pub use agent::*;
pub use chain::*;
pub use delivery::*;
pub use diagnosis::*;
pub use inside::*;
pub use link::*;
pub use robot::*;
pub use service::*;
pub use zenoh::*;

/// A metric family.
#[derive(Debug, PartialEq, Eq)]
pub struct Metric {
    /// Name in queries, with `_total` or `_info`; histograms without `_bucket`.
    pub name: &'static str,
    /// Type.
    pub kind: Kind,
    /// Base unit, which the name contains.
    pub unit: Option<&'static str>,
    /// Label names, in order.
    pub labels: &'static [&'static str],
    /// Help text, one sentence.
    pub help: &'static str,
    /// Whether name and meaning may still change.
    pub stability: Stability,
}

/// Metric types.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// Only increases while its series exists.
    Counter,
    /// Increases and decreases.
    Gauge,
    /// Buckets, sum and count.
    Histogram,
    /// Always 1; the labels contain the information.
    Info,
}

impl Metric {
    const fn counter(
        name: &'static str,
        labels: &'static [&'static str],
        help: &'static str,
    ) -> Self {
        let (kind, stability) = (Kind::Counter, Stability::Stable);
        Self {
            name,
            kind,
            unit: None,
            labels,
            help,
            stability,
        }
    }

    const fn gauge(
        name: &'static str,
        labels: &'static [&'static str],
        help: &'static str,
    ) -> Self {
        Self {
            kind: Kind::Gauge,
            ..Self::counter(name, labels, help)
        }
    }

    const fn info(name: &'static str, labels: &'static [&'static str], help: &'static str) -> Self {
        Self {
            kind: Kind::Info,
            ..Self::counter(name, labels, help)
        }
    }

    const fn histogram(
        name: &'static str,
        labels: &'static [&'static str],
        help: &'static str,
    ) -> Self {
        Self {
            kind: Kind::Histogram,
            ..Self::counter(name, labels, help)
        }
    }

    const fn unit(self, unit: &'static str) -> Self {
        Self {
            unit: Some(unit),
            ..self
        }
    }

    const fn experimental(self) -> Self {
        Self {
            stability: Stability::Experimental,
            ..self
        }
    }

    /// Returns the name of the family in OpenMetrics, without the suffix of its samples.
    #[must_use]
    pub fn family(&self) -> &'static str {
        match self.kind {
            Kind::Counter => self.name.strip_suffix("_total"),
            Kind::Info => self.name.strip_suffix("_info"),
            Kind::Gauge | Kind::Histogram => None,
        }
        .unwrap_or(self.name)
    }

    /// Returns the name of the family without its unit.
    pub(crate) fn stem(&self) -> &'static str {
        let unit = self.unit.unwrap_or_default();
        let stem = self.family().strip_suffix(unit);
        stem.and_then(|stem| stem.strip_suffix('_'))
            .unwrap_or_else(|| self.family())
    }
}

impl Kind {
    /// Returns the type as text.
    #[must_use]
    pub const fn label(self) -> &'static str {
        match self {
            Self::Counter => "counter",
            Self::Gauge => "gauge",
            Self::Histogram => "histogram",
            Self::Info => "info",
        }
    }
}

const DOMAIN: &[&str] = &["domain_id"];
const TOPIC: &[&str] = &["domain_id", "topic"];
const WRITER: &[&str] = &["domain_id", "topic", "writer", "ros_node"];
const UNKNOWN: &[&str] = &["writer", "vendor"];

// Graph.
pub const PARTICIPANTS: Metric = Metric::gauge(
    "ros2_participants",
    DOMAIN,
    "DDS participants that are alive.",
);
pub const SECURED_PARTICIPANTS: Metric = Metric::gauge(
    "ros2_secured_participants",
    DOMAIN,
    "Participants with DDS security: their messages may be encrypted and invisible.",
);
pub const NODES: Metric = Metric::gauge("ros2_nodes", DOMAIN, "ROS nodes that are alive.");
pub const NODE_INFO: Metric = Metric::info(
    "ros2_node_info",
    &["domain_id", "ros_node", "participant", "vendor", "host"],
    "ROS nodes and where they run.",
);
pub const PARTICIPANT_INFO: Metric = Metric::info(
    "ros2_participant_info",
    &[
        "domain_id",
        "participant",
        "vendor",
        "host",
        "process",
        "pid",
        "cgroup",
    ],
    "Participants and their processes, as announced or from the owner of the sending socket.",
);
pub const TOPICS: Metric = Metric::gauge(
    "ros2_topics",
    &["domain_id", "kind"],
    "DDS topics with at least one endpoint, by their role in ROS.",
);
pub const DISCOVERY_EVENTS: Metric = Metric::counter(
    "ros2_discovery_events_total",
    &["domain_id", "entity", "event"],
    "Participants, writers, readers and nodes that appeared, changed or left, by event.",
);
pub const UNKNOWN_WRITERS: Metric = Metric::gauge(
    "ros2_unknown_writers",
    &[],
    "Active writers whose announcement was not seen.",
);
pub const UNKNOWN_WRITER_MESSAGES: Metric = Metric::counter(
    "ros2_unknown_writer_messages_total",
    UNKNOWN,
    "Messages of unknown writers, for the first 32 of them.",
)
.experimental();
pub const UNKNOWN_WRITER_RATE: Metric = Metric::gauge(
    "ros2_unknown_writer_rate_hertz",
    UNKNOWN,
    "Messages per second of unknown writers in the agent's last window; for display.",
)
.unit("hertz")
.experimental();
pub const UNKNOWN_WRITER_INFO: Metric = Metric::info(
    "ros2_unknown_writer_info",
    &["writer", "vendor", "host", "process", "pid", "cgroup"],
    "Unknown writers: their participants' announcements and the owners of their sending sockets.",
)
.experimental();

// Topics.
pub const TOPIC_INFO: Metric = Metric::info(
    "ros2_topic_info",
    &[
        "domain_id",
        "topic",
        "kind",
        "message_type",
        "reliability",
        "durability",
    ],
    "Type and quality of service as its publishers announce them; several values are joined by commas.",
);
pub const TOPIC_PUBLISHERS: Metric = Metric::gauge(
    "ros2_topic_publishers",
    TOPIC,
    "Writers of the topic; 0 once it has vanished.",
);
pub const TOPIC_SUBSCRIPTIONS: Metric =
    Metric::gauge("ros2_topic_subscriptions", TOPIC, "Readers of the topic.");
pub const TOPIC_MESSAGES: Metric = Metric::counter(
    "ros2_topic_messages_total",
    TOPIC,
    "Messages seen whole, each counted once regardless of copies; publications inside processes \
     where ros2_topic_source_info says so.",
);
pub const TOPIC_BYTES: Metric = Metric::counter(
    "ros2_topic_bytes_total",
    TOPIC,
    "Payload bytes of those messages, encapsulation included, as `ros2 topic bw` counts.",
)
.unit("bytes");
pub const TOPIC_LOST: Metric = Metric::counter(
    "ros2_topic_lost_messages_total",
    TOPIC,
    "Messages that were sent but never seen whole on this host: sequence gaps that the \
     writer neither declared irrelevant nor repaired. A subscriber may lose more.",
);
pub const TOPIC_SUBSCRIBER_EXPECTED: Metric = Metric::counter(
    "ros2_topic_subscriber_expected_messages_total",
    TOPIC,
    "Messages that the topic's worst subscriber expected: those that it received or lost; where no \
     delivery is observed, those that were sent.",
);
pub const TOPIC_SUBSCRIBER_LOST: Metric = Metric::counter(
    "ros2_topic_subscriber_lost_messages_total",
    TOPIC,
    "Messages among them that it lost, anywhere on the way to its socket; max_loss_ratio limits \
     their share.",
);
pub const TOPIC_RECOVERED: Metric = Metric::counter(
    "ros2_topic_recovered_messages_total",
    TOPIC,
    "Messages that filled a sequence gap later, by retransmission or reordering.",
);
pub const TOPIC_DUPLICATES: Metric = Metric::counter(
    "ros2_topic_duplicate_messages_total",
    TOPIC,
    "Duplicate messages and fragments, not counted elsewhere.",
);
pub const TOPIC_INCOMPLETE: Metric = Metric::counter(
    "ros2_topic_incomplete_messages_total",
    TOPIC,
    "Fragmented messages with a missing part; also counted as lost.",
);
pub const TOPIC_LAST_MESSAGE: Metric = Metric::gauge(
    "ros2_topic_last_message_timestamp_seconds",
    TOPIC,
    "Unix time of the last message.",
)
.unit("seconds");
pub const TOPIC_RATE: Metric = Metric::gauge(
    "ros2_topic_rate_hertz",
    TOPIC,
    "Messages per second in the agent's last window; for display. Rules should use rate() of the \
     counter.",
)
.unit("hertz");
pub const TOPIC_BANDWIDTH: Metric = Metric::gauge(
    "ros2_topic_bandwidth_bytes_per_second",
    TOPIC,
    "Payload bytes per second in the same window; for display.",
);
pub const TOPIC_INTERARRIVAL: Metric = Metric::histogram(
    "ros2_topic_interarrival_seconds",
    TOPIC,
    "Time between consecutive messages of one writer, at capture.",
)
.unit("seconds");
pub const TOPIC_LATENCY: Metric = Metric::histogram(
    "ros2_topic_latency_seconds",
    TOPIC,
    "Time from the writer's timestamp to the capture, corrected by the known offset between the \
     clocks of both hosts.",
)
.unit("seconds");
pub const TOPIC_LATENCY_UNCERTAINTY: Metric = Metric::gauge(
    "ros2_topic_latency_uncertainty_seconds",
    TOPIC,
    "Greatest error of latencies of publishers on other hosts; infinite while the offset of a \
     clock is unknown, absent for publishers of this host.",
)
.unit("seconds")
.experimental();
pub const TOPIC_HEADER_LATENCY: Metric = Metric::histogram(
    "ros2_topic_header_latency_seconds",
    TOPIC,
    "Time from the message's Header.stamp to the capture, corrected like \
     ros2_topic_latency_seconds.",
)
.unit("seconds");
pub const TOPIC_NEGATIVE_LATENCY: Metric = Metric::counter(
    "ros2_topic_negative_latency_messages_total",
    TOPIC,
    "Messages stamped after their capture because clocks differ; not in latency histograms.",
);
pub const TOPIC_IMPLAUSIBLE_LATENCY: Metric = Metric::counter(
    "ros2_topic_implausible_latency_messages_total",
    TOPIC,
    "Messages stamped more than an hour before or after their capture: the sender's clock is not \
     set, or the timestamp is forged. Not in latency histograms.",
);
pub const TOPIC_DOUBTED_JUMPS: Metric = Metric::counter(
    "ros2_topic_doubted_sequence_jumps_total",
    TOPIC,
    "Jumps of a writer's sequence numbers, backwards or by more than 64, that a single datagram \
     cannot confirm: the writer restarted, the agent missed messages, or the datagram is forged.",
);

pub const TOPIC_SAMPLED: Metric = Metric::counter(
    "ros2_topic_sampled_messages_total",
    TOPIC,
    "Messages counted from sequence numbers because the topic is sampled in shared memory; \
     unseen messages are not reported as lost.",
);
pub const TOPIC_SAMPLED_SEEN: Metric = Metric::counter(
    "ros2_topic_sampled_seen_messages_total",
    TOPIC,
    "Sampled messages that were seen; intervals and latencies cover only these.",
);
pub const TOPIC_SAMPLED_UNCERTAIN: Metric = Metric::counter(
    "ros2_topic_sampled_uncertain_total",
    TOPIC,
    "Polls of shared memory so late that the ring may have been overwritten; loss in between is \
     unknown.",
);
pub const TOPIC_COVERAGE: Metric = Metric::gauge(
    "ros2_topic_sampled_coverage_ratio",
    TOPIC,
    "Fraction of sampled messages that were seen since the start; for display. Rules should \
     divide the counters.",
)
.unit("ratio");
pub const TOPIC_PAIRS: Metric = Metric::gauge(
    "ros2_topic_pairs",
    &["domain_id", "topic", "passage"],
    "Pairs of writer and reader by the path of their messages, as both announce it: network, \
     tcp, shared_memory (sampled), data_sharing, same_process, iceoryx (the last three are \
     visible only with capture.inside).",
);

// Writers, on request.
pub const WRITER_MESSAGES: Metric = Metric::counter(
    "ros2_writer_messages_total",
    WRITER,
    "Messages of one writer seen whole.",
)
.experimental();
pub const WRITER_BYTES: Metric = Metric::counter(
    "ros2_writer_bytes_total",
    WRITER,
    "Payload bytes of those messages.",
)
.unit("bytes")
.experimental();
pub const WRITER_LOST: Metric = Metric::counter(
    "ros2_writer_lost_messages_total",
    WRITER,
    "Messages of one writer that were sent but never seen whole.",
)
.experimental();

// Watchlist.
pub const WATCH_STATE: Metric = Metric::gauge(
    "ros2_watch_state",
    &["domain_id", "topic", "watch", "state"],
    "1 for the current state of a watched topic: ok, violated, silent, not_published or \
     no_subscriber.",
);
pub const WATCH_VIOLATED: Metric = Metric::gauge(
    "ros2_watch_expectation_violated",
    &["domain_id", "topic", "watch", "expectation"],
    "1 while a configured expectation is violated, after hysteresis.",
);

/// All metrics, in the order of the page.
pub const CATALOGUE: &[Metric] = &[
    PARTICIPANTS,
    SECURED_PARTICIPANTS,
    NODES,
    NODE_INFO,
    PARTICIPANT_INFO,
    TOPICS,
    DISCOVERY_EVENTS,
    UNKNOWN_WRITERS,
    UNKNOWN_WRITER_MESSAGES,
    UNKNOWN_WRITER_RATE,
    UNKNOWN_WRITER_INFO,
    DIAGNOSES,
    QOS_INCOMPATIBLE_PAIRS,
    TOPIC_CONFLICTING_TYPES,
    TOPIC_CONFLICTING_TYPE_HASHES,
    UNHEARD_PUBLISHERS,
    UNFED_SUBSCRIPTIONS,
    DUPLICATE_NODES,
    NODE_DOMAINS,
    SERVICE_REQUESTS,
    SERVICE_ANSWERED,
    SERVICE_UNANSWERED,
    SERVICE_HANGING,
    SERVICE_LATENCY,
    SERVICE_P50,
    SERVICE_P99,
    SERVICE_SUSPENDED,
    ACTION_GOALS,
    ACTION_OPEN,
    ACTION_P50,
    ACTION_P99,
    CHAIN_LATENCY,
    CHAIN_P50,
    CHAIN_P99,
    HOP_LATENCY,
    HOP_P50,
    HOP_P99,
    CHAIN_STATE,
    TOPIC_INFO,
    TOPIC_PUBLISHERS,
    TOPIC_SUBSCRIPTIONS,
    TOPIC_MESSAGES,
    TOPIC_BYTES,
    TOPIC_LOST,
    TOPIC_SUBSCRIBER_EXPECTED,
    TOPIC_SUBSCRIBER_LOST,
    TOPIC_RECOVERED,
    TOPIC_DUPLICATES,
    TOPIC_INCOMPLETE,
    TOPIC_LAST_MESSAGE,
    TOPIC_RATE,
    TOPIC_BANDWIDTH,
    TOPIC_LATENCY_UNCERTAINTY,
    TOPIC_NEGATIVE_LATENCY,
    TOPIC_IMPLAUSIBLE_LATENCY,
    TOPIC_DOUBTED_JUMPS,
    TOPIC_SAMPLED,
    TOPIC_SAMPLED_SEEN,
    TOPIC_SAMPLED_UNCERTAIN,
    TOPIC_COVERAGE,
    TOPIC_PAIRS,
    TOPIC_INTERARRIVAL,
    TOPIC_LATENCY,
    TOPIC_HEADER_LATENCY,
    TOPIC_SENT,
    TOPIC_SENT_BYTES,
    TOPIC_DELIVERED,
    TOPIC_DELIVERED_BYTES,
    TOPIC_DELIVERY_LOST,
    TOPIC_DELIVERY_PENDING,
    TOPIC_DELIVERY_RECOVERED,
    TOPIC_DELIVERY_IRRELEVANT,
    TOPIC_DELIVERY_UNMATCHED,
    TOPIC_LAG,
    TOPIC_LAG_SECONDS,
    TOPIC_SEND_DELAY,
    TOPIC_TRANSIT,
    TOPIC_TRANSFER,
    TOPIC_RETRANSMISSION,
    TOPIC_SOURCE,
    INSIDE_PUBLISHED,
    INSIDE_TAKEN,
    INSIDE_FAILED,
    INTRA_RECEIVED,
    INTRA_ENQUEUED,
    INTRA_OVERWRITTEN,
    INTRA_DEQUEUED,
    INTRA_DEPTH,
    INSIDE_LATENCY,
    INTRA_WAITING,
    CALLBACK_DURATION,
    CALLBACK_WAIT,
    CALLBACK_P99,
    CALLBACK_MAX,
    CALLBACK_WAIT_P99,
    CALLBACK_BUSY,
    CALLBACK_TIME,
    TIMER_SKIPPED,
    LATE_TIME,
    LATE_CALLS,
    NODE_BUSY,
    NODE_LIFECYCLE,
    WRITER_MESSAGES,
    WRITER_BYTES,
    WRITER_LOST,
    WRITER_SENT,
    WRITER_SENT_BYTES,
    SUBSCRIBER_INFO,
    SUBSCRIBER_RECEIVED,
    SUBSCRIBER_RECEIVED_BYTES,
    SUBSCRIBER_LOST,
    SUBSCRIBER_PENDING,
    SUBSCRIBER_RECOVERED,
    SUBSCRIBER_RECOVERY_SECONDS,
    SUBSCRIBER_IRRELEVANT,
    SUBSCRIBER_UNMATCHED,
    READER_LAG,
    READER_LAG_SECONDS,
    READER_MISSING,
    READER_REQUESTED,
    SOCKET_DROPS,
    LINK_CONNECTIONS,
    LINK_SENT,
    LINK_RETRANSMITTED,
    LINK_UNACKNOWLEDGED,
    LINK_UNSENT,
    LINK_ROUND_TRIP,
    CLOCK_OFFSET,
    CLOCK_UNCERTAINTY,
    CLOCK_STEPS,
    LOG_MESSAGES,
    DIAGNOSTICS_LEVEL,
    DIAGNOSTICS_VALUE,
    PARAMETER_CHANGES,
    TRANSFORM_MESSAGES,
    TRANSFORM_AGE,
    TRANSFORM_BROADCASTERS,
    TRANSFORM_JUMPS,
    BATTERY_CHARGE,
    BATTERY_VOLTAGE,
    BATTERY_CURRENT,
    BATTERY_TEMPERATURE,
    FIELD_UNREADABLE,
    WATCH_STATE,
    WATCH_VIOLATED,
    BUILD_INFO,
    SOURCE_INFO,
    WIRE_INFO,
    SANDBOX_INFO,
    ABILITY,
    READY,
    CAPTURE_PACKETS,
    CAPTURE_DROPPED,
    CAPTURE_COPIED,
    FILTER_EVENTS,
    FILTER_REFUSED,
    RECORDS_DROPPED,
    PIECES_DROPPED,
    CONTENDED,
    INCOMPLETE_DATAGRAMS,
    REASSEMBLY,
    SHM_OPEN,
    SHM_EVENTS,
    SHM_LOOKS,
    SHM_CPU,
    SHM_EXACT_INFO,
    INSIDE_INFO,
    INSIDE_LIBRARY,
    INSIDE_EVENTS,
    INSIDE_PROCESSES,
    CALLBACKS_NOT_SHOWN,
    ZENOH_CONNECTIONS,
    ZENOH_ROUTERS,
    ZENOH_BATCHES,
    ZENOH_GAPS,
    ZENOH_FOREIGN,
    ZENOH_INCOMPLETE,
    ZENOH_UNSEEN,
    DATAGRAMS,
    TLS_CONNECTIONS,
    RECORDS,
    DECODE_ERRORS,
    TABLE_ENTRIES,
    TABLE_LIMIT,
    TABLE_BYTES,
    TABLE_BYTES_LIMIT,
    TABLE_EVICTIONS,
    LIMIT,
    LIMIT_USED,
    LIMIT_REACHED,
    AT_LIMIT,
    TRACKED_TOPICS,
    TOPICS_REJECTED,
    TOPICS_HIDDEN,
    DELIVERIES_HIDDEN,
    SNAPSHOT_AGE,
    SCRAPE_DURATION,
    RELOAD_SUCCESSFUL,
    RELOAD_TIMESTAMP,
    STATE_WRITES,
    RESTORED,
    HISTORY_WRITES,
    HISTORY_BYTES,
    SUBSCRIPTIONS,
    SUBSCRIPTIONS_REFUSED,
    SAMPLES_GIVEN,
    SAMPLES_MISSED,
    SAMPLES_QUEUED,
    SAMPLES_RETAINED,
    FOXGLOVE_CLIENTS,
    FOXGLOVE_SUBSCRIPTIONS,
    FOXGLOVE_REFUSED,
    FOXGLOVE_SENT,
    FOXGLOVE_SENT_BYTES,
    FOXGLOVE_DROPPED,
    ROS2_DAEMON_PORTS,
    ROS2_DAEMON_CLIENTS,
    ROS2_DAEMON_REQUESTS,
    ROS2_DAEMON_REFUSED,
    EVENTS,
    EVENTS_DROPPED,
    LOG_LINES_LOST,
    RECORDINGS,
    RECORDED_MESSAGES,
    RECORDED_BYTES,
    RECORDINGS_MISSING,
    SNAPSHOT_MESSAGES,
    SNAPSHOT_BYTES,
    SNAPSHOT_CROWDED_OUT,
    SNAPSHOTS_WRITTEN,
    SNAPSHOTS_FAILED,
    SNAPSHOTS_SUPPRESSED,
    SNAPSHOTS_REMOVED,
    OTLP_EXPORTS,
    OTLP_DROPPED,
    OTLP_QUEUE,
    REMOTE_WRITE_REQUESTS,
    REMOTE_WRITE_SAMPLES,
    REMOTE_WRITE_SENT,
    REMOTE_WRITE_QUEUE,
    REMOTE_WRITE_BEHIND,
    PROCESS_CPU,
    PROCESS_RESIDENT,
    PROCESS_UNRECLAIMABLE,
    PROCESS_VIRTUAL,
    PROCESS_OPEN_FDS,
    PROCESS_MAX_FDS,
    PROCESS_START_TIME,
];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn metric_names_are_unique_and_contain_type_and_unit() {
        let mut names: Vec<&str> = CATALOGUE.iter().map(|metric| metric.name).collect();
        names.sort_unstable();
        names.dedup();
        assert_eq!(names.len(), CATALOGUE.len());
        for metric in CATALOGUE {
            let Metric {
                name,
                kind,
                unit,
                labels,
                help,
                ..
            } = metric;
            assert_eq!(name.ends_with("_total"), *kind == Kind::Counter, "{name}");
            assert_eq!(name.ends_with("_info"), *kind == Kind::Info, "{name}");
            let of_stem = unit.map(|unit| format!("{}_{unit}", metric.stem()));
            assert!(
                of_stem.is_none_or(|of_stem| of_stem == metric.family()),
                "{name}"
            );
            assert!(
                help.ends_with('.') && !help.contains(['\n', '\\', '|']),
                "{name}"
            );
            for taken in ["type", "service", "env", "instance", "job", "node", "le"] {
                assert!(!labels.contains(&taken), "{name} has the label {taken}");
            }
        }
    }

    #[test]
    fn a_family_name_omits_the_suffix_of_its_samples() {
        assert_eq!(TOPIC_BYTES.family(), "ros2_topic_bytes");
        assert_eq!(TOPIC_MESSAGES.family(), "ros2_topic_messages");
        assert_eq!(
            TOPIC_INTERARRIVAL.family(),
            "ros2_topic_interarrival_seconds"
        );
        assert_eq!(NODE_INFO.family(), "ros2_node");
    }
}
