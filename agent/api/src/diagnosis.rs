//! Problems of the ROS graph, found by comparing its endpoints and nodes.

use std::borrow::Cow;
use std::net::IpAddr;

use serde::{Deserialize, Serialize};

use crate::Open;
use crate::attributes::{Attributes, Value};
use crate::inside::Trigger;

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
    UnmatchedPublisher {
        /// GUID of the writer.
        writer: String,
        /// The closest mismatch: a reader with other QoS (`qos`), of another `type`, or in another
        /// `partition`; `no_endpoint` if the topic has no reader. `unreachable`: a reader matches
        /// on another host, but one of the two announces loopback addresses only.
        reason: Cow<'static, str>,
    },
    /// A reader without a matching writer.
    UnmatchedSubscription {
        /// GUID of the reader.
        reader: String,
        /// The closest mismatch: `unreachable`, `qos`, `type` or `partition`; `no_endpoint` if the
        /// topic has no writer.
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
    /// A callback runs longer than the period of its timer, or of a timer in the same thread.
    SlowCallback {
        /// Node of the callback; null when unknown.
        node: Option<Cow<'a, str>>,
        /// Id of the process.
        process_id: u32,
        /// Trigger of the callback.
        trigger: Trigger<'a>,
        /// 99th percentile of the callback's duration when the problem appeared.
        duration_seconds: f64,
        /// Period of the timer.
        period_seconds: f64,
        /// Whether the period is that of the callback's own timer.
        own_period: bool,
    },
    /// A callback waits for the executor longer than its interval and longer than 100 ms.
    ExecutorWait {
        /// Node of the callback; null when unknown.
        node: Option<Cow<'a, str>>,
        /// Id of the process.
        process_id: u32,
        /// Trigger of the callback.
        trigger: Trigger<'a>,
        /// 99th percentile of the callback's wait when the problem appeared.
        wait_seconds: f64,
    },
    /// Calls of a callback are late, at least three in a minute for the same cause.
    LateCallback {
        /// Node of the callback; null when unknown.
        node: Option<Cow<'a, str>>,
        /// Id of the process.
        process_id: u32,
        /// Trigger of the callback.
        trigger: Trigger<'a>,
        /// Late calls in a minute for this cause, when the problem appeared.
        late_calls: u64,
        /// Stage in which they became late: `wait` or `callback`.
        stage: Cow<'a, str>,
        /// What made them late, as in the answer of `/why`.
        cause: Cow<'a, str>,
        /// Name of the thread that ran instead or released the lock; null without one.
        by: Option<Cow<'a, str>>,
        /// Systemd unit, container or control group of that thread, as in the answer of `/why`.
        by_unit: Option<Cow<'a, str>>,
        /// The cause in words.
        words: Cow<'a, str>,
        /// Time from ready to the end of the longest of the last of these calls.
        longest_seconds: f64,
    },
    /// Messages within a process are overwritten before the subscription takes them.
    IntraProcessOverflow {
        /// Node of the subscription; null when unknown.
        node: Option<Cow<'a, str>>,
        /// Id of the process.
        process_id: u32,
        /// Share of messages overwritten when the problem appeared.
        overwritten_ratio: f64,
    },
    /// A process takes its messages too slowly, and the middleware drops some from the queue of its
    /// subscription.
    ReaderQueueOverflow {
        /// Node of the subscription; null when unknown.
        node: Option<Cow<'a, str>>,
        /// Id of the process.
        process_id: u32,
        /// Share of messages lost when the problem appeared.
        lost_ratio: f64,
        /// Maximum number of messages in the queue; null if the reader does not announce it.
        depth: Option<u64>,
    },
    /// A process exceeds its budget of calls, so the agent no longer counts its calls.
    ObservationSuspended {
        /// Id of the process.
        process_id: u32,
        /// Name of the process; null when unknown.
        process: Option<Cow<'a, str>>,
    },
    /// A node publishes at the rate of an input but with new stamps, so chains end at the node.
    RestampingNode {
        /// Name of the node.
        node: Cow<'a, str>,
        /// The input, whose stamps are older.
        input: Cow<'a, str>,
    },
    /// Publisher and subscription accept buffers of one backend, but messages travel as a whole, through
    /// the CPU.
    BuffersByCpu {
        /// GUID of the writer.
        writer: String,
        /// GUID of the reader that takes no buffers, for which the publisher sends messages as a whole
        /// to all; null if it does so because it is transient local.
        reader: Option<String>,
        /// Backends that the publisher shares with a subscription.
        backends: Vec<Cow<'a, str>>,
    },
    /// TCP retransmits many segments on the way to another host.
    LossyLink {
        /// Address of the sender.
        #[cfg_attr(feature = "openapi", schema(value_type = String))]
        source: IpAddr,
        /// Address of the receiver.
        #[cfg_attr(feature = "openapi", schema(value_type = String))]
        destination: IpAddr,
        /// Share of segments retransmitted when the problem appeared.
        retransmitted_ratio: f64,
        /// Bytes that waited to be sent then; null if the kernel does not show them.
        unsent_bytes: Option<u64>,
    },
    /// A node logs errors in a burst: at least ten in a minute, or a fatal one.
    LogErrors {
        /// Errors of the last minute when the burst began.
        errors: u64,
        /// Text of the last one of these.
        text: Cow<'a, str>,
    },
    /// A part of the robot has been in error, or without a new status, for at least 5 s.
    DiagnosticError {
        /// Node that publishes its diagnostics.
        ros_node: Option<Cow<'a, str>>,
        /// Name of the part.
        name: Cow<'a, str>,
        /// Id of its hardware; often empty.
        hardware_id: Cow<'a, str>,
        /// `error` or `stale`.
        level: Cow<'static, str>,
        /// Message when it was reported.
        message: Cow<'a, str>,
    },
    /// Transforms between frames are missing, contradict each other, or are in several trees.
    TransformFault {
        /// Namespace of the topics; empty for `/tf`.
        namespace: Cow<'a, str>,
        /// `silent`, `several_broadcasters`, `time_went_back`, `jumps`, `apart` or `unknown_frame`.
        fault: Cow<'static, str>,
        /// Parent frame of the edge; empty if the fault is `apart`.
        parent: Cow<'a, str>,
        /// Child frame of the edge; empty if the fault is `apart`.
        child: Cow<'a, str>,
        /// Edges with this fault from the same broadcasters.
        edges: u64,
        /// Nodes that broadcast the edge, or the roots of the trees.
        names: Vec<Cow<'a, str>>,
    },
    /// The clock of another host differs much from this host's.
    ClocksApart {
        /// Name or address of the other host.
        peer: Cow<'a, str>,
        /// Seconds by which its clock was ahead when the problem appeared; negative if behind.
        offset_seconds: f64,
        /// The offset was wrong by at most this time.
        uncertainty_seconds: f64,
    },
    /// The topic has a publisher without a subscription, and a similar topic of the same type has a
    /// subscription without a publisher.
    NearMiss {
        /// Topic of the subscription.
        subscription: Cow<'a, str>,
        /// Domain of the subscription.
        subscription_domain_id: u32,
        /// `case`, `slash`, `namespace`, `letter` or `domain`.
        difference: Cow<'static, str>,
    },
    /// A managed node has not been active for at least 5 s, although the configuration expects it or
    /// its last transition failed.
    NodeInactive {
        /// State of the node.
        state: Cow<'static, str>,
        /// Whether a transition failed since it was last active.
        failed: bool,
    },
    /// A parameter of the node has another value than the configuration expects.
    ParameterDrift {
        /// Name of the parameter.
        name: Cow<'a, str>,
        /// Value that the configuration expects, as YAML.
        expected: Cow<'a, str>,
        /// Last known value.
        value: Cow<'a, str>,
    },
    /// Some nodes of the domain use simulated time (`use_sim_time`), and others do not.
    MixedTime {
        /// Nodes with simulated time, at most four.
        simulated: Vec<Cow<'a, str>>,
        /// Nodes without it, at most four.
        system: Vec<Cow<'a, str>>,
    },
    /// Stamps in the headers of the publisher's messages cannot be right.
    WrongStamps {
        /// GUID of the writer.
        writer: String,
        /// `future`, `went_back`, `drifting` or `other_clock`.
        fault: Cow<'static, str>,
        /// Time by which they were wrong when the problem appeared.
        offset_seconds: f64,
    },
    /// Shared memory cannot serve the robot as Fast DDS expects.
    SharedMemoryFault {
        /// `full`: a directory is nearly full. `stale`: files of ended processes take much space.
        /// `split`: nodes of one domain and one network have different directories.
        fault: Cow<'static, str>,
        /// Share of the directory in use when that was noticed (`full`).
        used_ratio: Option<f64>,
        /// Bytes of these files when that was noticed (`stale`).
        stale_bytes: Option<u64>,
        /// Number of these directories when that was noticed (`split`).
        directories: Option<u64>,
    },
    /// A configured chain that ends with the topic exceeds its maximum latency.
    SlowChain {
        /// First topic of the chain.
        from: Cow<'a, str>,
        /// Maximum latency of the chain, in milliseconds.
        max_latency_ms: f64,
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
            Self::UnmatchedPublisher { .. } => "unmatched_publisher",
            Self::UnmatchedSubscription { .. } => "unmatched_subscription",
            Self::HangingCall { .. } => "hanging_call",
            Self::NodeInSeveralDomains { .. } => "node_in_several_domains",
            Self::SlowCallback { .. } => "slow_callback",
            Self::ExecutorWait { .. } => "executor_wait",
            Self::LateCallback { .. } => "late_callback",
            Self::IntraProcessOverflow { .. } => "intra_process_overflow",
            Self::ReaderQueueOverflow { .. } => "reader_queue_overflow",
            Self::ObservationSuspended { .. } => "observation_suspended",
            Self::RestampingNode { .. } => "restamping_node",
            Self::BuffersByCpu { .. } => "buffers_by_cpu",
            Self::LossyLink { .. } => "lossy_link",
            Self::LogErrors { .. } => "log_errors",
            Self::DiagnosticError { .. } => "diagnostic_error",
            Self::TransformFault { .. } => "transform_fault",
            Self::ClocksApart { .. } => "clocks_apart",
            Self::NearMiss { .. } => "near_miss",
            Self::NodeInactive { .. } => "node_inactive",
            Self::ParameterDrift { .. } => "parameter_drift",
            Self::MixedTime { .. } => "mixed_time",
            Self::WrongStamps { .. } => "wrong_stamps",
            Self::SharedMemoryFault { .. } => "shared_memory_fault",
            Self::SlowChain { .. } => "slow_chain",
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
