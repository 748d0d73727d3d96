//! `/topics`, `/topics/{topic}` and `/topics/{topic}/history`.

use std::borrow::Cow;

use serde::{Deserialize, Serialize};

use crate::Open;
use crate::diagnosis::{Diagnosis, Finding};
use crate::endpoints::{Endpoint, PastFigures};
use crate::inside::TopicInside;
use crate::measurement::{Breakdown, Bucket, Delivered, Measurement};
use crate::watches::Expectations;

/// All topics.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct TopicList<'a> {
    /// Unix time of the state that this answer describes.
    pub timestamp_seconds: f64,
    /// Topics, sorted by domain and DDS name.
    pub topics: Vec<Topic<'a>>,
}

/// A topic.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Topic<'a> {
    /// Domain id.
    pub domain_id: u32,
    /// ROS name; the DDS name if it follows no ROS convention.
    #[cfg_attr(feature = "openapi", schema(example = "/points"))]
    pub name: Cow<'a, str>,
    /// DDS name.
    #[cfg_attr(feature = "openapi", schema(example = "rt/points"))]
    pub dds_name: Cow<'a, str>,
    /// Role of the topic in ROS: `topic`, `service_request`, `service_reply`, `service_event`,
    /// `action_feedback`, `action_status`, `discovery` or `dds`.
    pub kind: Cow<'a, str>,
    /// Hidden by ROS convention.
    pub hidden: bool,
    /// The topic's last endpoint is gone; the topic stays listed for some minutes.
    pub vanished: bool,
    /// ROS types that its endpoints announce; more than one is a fault.
    pub message_types: Vec<Cow<'a, str>>,
    /// RIHS01 hashes that its endpoints announce.
    pub type_hashes: Vec<Cow<'a, str>>,
    /// Writers of the topic.
    pub publishers: Vec<Endpoint<'a>>,
    /// Readers of the topic.
    pub subscriptions: Vec<Endpoint<'a>>,
    /// Watches that cover the topic, with the state of their expectations.
    pub watches: Vec<Watching<'a>>,
    /// Counts and times, summed over its writers; null if the topic is not watched.
    pub measurement: Option<Measurement>,
    /// Messages that arrived at receivers on this host, counted per receiver.
    pub received: Option<Delivered>,
    /// Messages that left this host, counted once per destination.
    pub sent: Option<Delivered>,
    /// Time that messages spent in each stage on this host.
    pub breakdown: Option<Breakdown>,
    /// Publisher and subscriber pairs, counted per transport.
    pub passages: Vec<Passage>,
    /// Problems of the topic.
    #[cfg_attr(feature = "openapi", schema(value_type = Vec<Diagnosis<'static>>))]
    pub diagnoses: Vec<Finding<'a>>,
    /// Why the topic is silent or not measured; empty if messages are counted.
    pub reasons: Vec<Reason>,
    /// Source of the message count, of the rate and of the time of the last message. `wire`:
    /// datagrams and shared memory. `inside`: calls inside processes, which show no sizes.
    pub source: Cow<'static, str>,
    /// Data about the topic from inside processes; null without `capture.inside`.
    pub inside: Option<TopicInside<'a>>,
}

/// A topic with its histograms, deliveries and acknowledgements.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
#[expect(
    missing_docs,
    reason = "the document describes the topic where it is declared"
)]
pub struct TopicDetails<'a> {
    #[serde(flatten)]
    pub topic: Topic<'a>,
    /// Histogram of the time between consecutive messages of one writer.
    pub interarrival_buckets: Vec<Bucket>,
    /// Histogram of the time from the writer's timestamp to the capture.
    pub latency_buckets: Vec<Bucket>,
    /// Deliveries from each writer to each receiver and destination.
    pub deliveries: Vec<Delivery<'a>>,
    /// State of acknowledgement of each reliable reader.
    pub acknowledgements: Vec<Acknowledgement<'a>>,
}

/// Topics with their details, as the history has them.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct TopicDetailsList<'a> {
    /// Unix time of the state that this answer describes.
    pub timestamp_seconds: f64,
    /// Topics, sorted by domain and DDS name.
    pub topics: Vec<TopicDetails<'a>>,
}

impl TopicDetailsList<'_> {
    /// Removes the figures of all writers. Returns false if no writer had any.
    pub fn remove_past_figures(&mut self) -> bool {
        let topics = self.topics.iter_mut().map(|each| &mut each.topic);
        let endpoints = topics.flat_map(|topic| topic.publishers.iter_mut());
        let figures = endpoints.filter_map(|endpoint| endpoint.past_figures.take());
        figures.count() > 0
    }
}

impl TopicDetails<'_> {
    /// Returns the details without what changes with each message: measurements, histograms, and
    /// acknowledgements of readers that do not lag. Of each writer, rounded figures stay.
    #[must_use]
    pub fn without_figures(mut self) -> Self {
        let topic = &mut self.topic;
        (topic.measurement, topic.received, topic.sent) = (None, None, None);
        topic.breakdown = None;
        for endpoint in topic.publishers.iter_mut().chain(&mut topic.subscriptions) {
            let measured = endpoint.measurement.take();
            endpoint.past_figures = measured.as_ref().map(PastFigures::of);
        }
        self.acknowledgements.retain(|each| each.lag_messages > 0);
        Self {
            interarrival_buckets: Vec::new(),
            latency_buckets: Vec::new(),
            ..self
        }
    }
}

/// Publisher and subscriber pairs that use the same transport.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Passage {
    /// The transport. `network` and `tcp` are captured in full, `shared_memory` is sampled; `data_sharing`,
    /// `same_process` and `iceoryx` can be observed only inside the processes.
    pub passage: Cow<'static, str>,
    /// Number of pairs.
    pub pairs: usize,
    /// Number of pairs whose publisher and subscriber are both in observed processes.
    pub observed_pairs: usize,
    /// Current coverage of `shared_memory`. `exact`: the agent observes every message in the
    /// sending process. `close`: it samples as often as `capture.shm.reading_cpu_percent` allows,
    /// because a client reads the messages. `sampled`: it samples less often. `none`: it observes
    /// no messages.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "openapi", schema(nullable = false))]
    pub view: Option<Cow<'static, str>>,
}

/// A watch that covers the topic.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Watching<'a> {
    /// Name or glob of the watch.
    pub watch: Cow<'a, str>,
    /// Domain id of the watch; null for every domain.
    pub watch_domain_id: Option<u32>,
    /// Origin of the watch: `config`, `command_line` or `api`; null if it was just removed.
    pub origin: Option<Cow<'static, str>>,
    /// State of the topic: `ok`, `violated`, `silent`, `not_published` or `no_subscriber`.
    pub state: Cow<'static, str>,
    /// Expectations that the topic violates.
    pub violations: Vec<Cow<'a, str>>,
    /// Expectations of the watch.
    #[serde(flatten)]
    pub expectations: Expectations,
}

/// Messages from one writer to one receiver, or to one destination outside this host.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Delivery<'a> {
    /// GUID of the writer.
    pub writer: String,
    /// `sent` or `received`.
    pub direction: Cow<'static, str>,
    /// Destination address and port.
    #[cfg_attr(feature = "openapi", schema(example = "10.0.0.2:7411"))]
    pub destination: String,
    /// The receiver: participant, process or socket; empty if receivers cannot be distinguished.
    pub subscriber: Cow<'a, str>,
    /// GUIDs of the topic's readers in that participant.
    pub readers: Vec<String>,
    /// Nodes of the readers.
    pub nodes: Vec<Cow<'a, str>>,
    /// Id of the process that owns the socket.
    pub process_id: Option<u32>,
    /// Name of the process that owns the socket.
    pub process: Option<Cow<'a, str>>,
    /// Control group of the process that owns the socket.
    pub cgroup: Option<Cow<'a, str>>,
    /// Counts of delivered, lost and pending messages.
    pub delivered: Delivered,
    /// Delivered messages that the process never took from the queue of its subscription. Null if
    /// its calls are not observed, or if other writers fill the same queue.
    pub lost_in_reader_queue_messages: Option<u64>,
}

/// State of acknowledgement between a reliable reader and a writer.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Acknowledgement<'a> {
    /// GUID of the writer.
    pub writer: String,
    /// GUID of the reader.
    pub reader: String,
    /// Node of the reader; null when unknown.
    pub node: Option<Cow<'a, str>>,
    /// The reader has acknowledged all messages up to this sequence number.
    pub acknowledged_sequence_number: u64,
    /// Messages that the reader requested in its last ACKNACK.
    pub missing_messages: u64,
    /// Messages that the reader requested again, counted per request.
    pub requested_messages: u64,
    /// Messages that the writer has sent and the reader has not acknowledged.
    pub lag_messages: u64,
    /// Age in seconds of the oldest unacknowledged message; null if it is no longer known.
    pub lag_seconds: Option<f64>,
}

/// A reason why a topic is silent or not measured.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Reason {
    /// Code of the reason.
    #[cfg_attr(feature = "openapi", schema(value_type = ReasonCode))]
    pub code: Open<ReasonCode>,
    /// The reason, in words.
    pub detail: String,
}

/// Why a published topic without a subscriber is silent, in words. Each surface on which a client
/// waits for messages shows this text.
pub const UNSUBSCRIBED: &str = "no subscriber exists, so nothing is sent";

/// Why some or all messages of a topic are not observed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(rename_all = "snake_case")]
pub enum ReasonCode {
    /// The agent does not capture the robot's traffic at the moment.
    AgentNotReady,
    /// The topic has no publisher.
    NoPublisher,
    /// The topic has no subscriber; most writers then send nothing.
    NoSubscriber,
    /// The topic has subscribers, but none matches a publisher.
    NoMatchedSubscriber,
    /// A publisher's participant uses DDS security: messages may be encrypted.
    Encrypted,
    /// No watch covers the topic.
    NotWatched,
    /// A watch covers the topic, but `limits.topics` is reached.
    WatchRejected,
    /// All endpoints are on other hosts, and the agent captures at this host's sockets only.
    OutsideView,
    /// Messages use Fast DDS's shared memory, and the agent has not read any of them.
    SharedMemory,
    /// Subscribers read the publisher's history in shared memory, which cannot be observed.
    DataSharing,
    /// Publishers and subscribers share a process, which cannot be observed.
    SameProcess,
    /// Messages use Cyclone DDS's iceoryx, which cannot be observed.
    Iceoryx,
    /// No problem is known, but no message was ever seen, or none recently.
    Quiet,
}

/// Measurements of a topic over some time. All columns have the same length. A null value means
/// that the topic was not measured in that second, or that no value exists. If a row covers
/// several seconds (`interval_seconds`), counts are sums, rates and medians are means, and the
/// highest of the 99th percentiles is shown.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct History {
    /// ROS name.
    #[cfg_attr(feature = "openapi", schema(example = "/points"))]
    pub topic: String,
    /// Domain id.
    pub domain_id: u32,
    /// Seconds between two rows.
    pub interval_seconds: u32,
    /// Unix time of the state that this answer describes.
    pub timestamp_seconds: f64,
    /// Unix time at which each second ended, by the source's clock.
    pub times: Vec<f64>,
    /// Messages received whole in each second.
    pub messages: Vec<Option<u32>>,
    /// Messages confirmed as lost in each second.
    pub lost_messages: Vec<Option<u32>>,
    /// Messages per second over the preceding 10 s.
    pub rate_hertz: Vec<Option<f64>>,
    /// Payload bytes per second over the preceding 10 s.
    pub bandwidth_bytes_per_second: Vec<Option<f64>>,
    /// Median time from the writer's timestamp to the capture.
    pub latency_p50_seconds: Vec<Option<f64>>,
    /// 99th percentile of the same time.
    pub latency_p99_seconds: Vec<Option<f64>>,
    /// Median time between messages of one writer.
    pub interarrival_p50_seconds: Vec<Option<f64>>,
    /// 99th percentile of the same time.
    pub interarrival_p99_seconds: Vec<Option<f64>>,
}
