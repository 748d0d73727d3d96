//! What the agent's API says, as far as `rp top` shows it. What an older agent does not say is
//! empty, what a newer one says besides is ignored.

use serde::Deserialize;
use serde_json::{Map, Value};

/// `GET /topics`.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(default)]
pub struct Topics {
    /// All of them.
    pub topics: Vec<Topic>,
}

/// One topic; deliveries, acknowledgements and buckets only from `GET /topics/{topic}`.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(default)]
pub struct Topic {
    pub domain_id: u32,
    pub name: String,
    pub dds_name: String,
    pub kind: String,
    pub vanished: bool,
    pub message_types: Vec<String>,
    pub publishers: Vec<Endpoint>,
    pub subscriptions: Vec<Endpoint>,
    pub watches: Vec<Watching>,
    pub measurement: Option<Measurement>,
    pub received: Option<Delivered>,
    pub passages: Vec<Passage>,
    pub diagnoses: Vec<Map<String, Value>>,
    pub reasons: Vec<Reason>,
    pub interarrival_buckets: Vec<Bucket>,
    pub latency_buckets: Vec<Bucket>,
    pub deliveries: Vec<Delivery>,
    pub acknowledgements: Vec<Acknowledgement>,
}

#[derive(Clone, Debug, Default, Deserialize)]
#[serde(default)]
pub struct Endpoint {
    pub guid: String,
    pub node: Option<String>,
    pub message_type: String,
    pub vendor: Option<String>,
    pub qos: Qos,
    pub measurement: Option<Measurement>,
}

#[derive(Clone, Debug, Default, Deserialize)]
#[serde(default)]
pub struct Qos {
    pub reliability: String,
    pub durability: String,
    pub history: String,
    pub deadline_seconds: Option<f64>,
}

#[derive(Clone, Debug, Default, Deserialize)]
#[serde(default)]
pub struct Watching {
    pub watch: String,
    pub origin: Option<String>,
    pub state: String,
    pub violations: Vec<String>,
    pub min_rate_hz: Option<f64>,
    pub max_rate_hz: Option<f64>,
    pub max_loss_ratio: Option<f64>,
    pub max_latency_ms: Option<f64>,
    pub max_silence_s: Option<f64>,
}

#[derive(Clone, Debug, Default, Deserialize)]
#[serde(default)]
pub struct Measurement {
    pub messages: u64,
    pub bytes: u64,
    pub lost_messages: u64,
    pub recovered_messages: u64,
    pub duplicate_messages: u64,
    pub incomplete_messages: u64,
    pub rate_hertz: f64,
    pub bandwidth_bytes_per_second: f64,
    pub interarrival: Option<Distribution>,
    pub latency: Option<Distribution>,
    pub header_latency: Option<Distribution>,
    pub negative_latency_messages: u64,
    pub implausible_latency_messages: u64,
    pub doubted_sequence_jumps: u64,
    pub sampled: Option<Sampled>,
}

#[derive(Clone, Copy, Debug, Default, Deserialize)]
#[serde(default)]
pub struct Sampled {
    pub seen_messages: u64,
    pub existing_messages: u64,
}

#[derive(Clone, Copy, Debug, Default, Deserialize)]
#[serde(default)]
pub struct Distribution {
    pub count: u64,
    pub mean_seconds: f64,
    pub minimum_seconds: f64,
    pub p50_seconds: f64,
    pub p99_seconds: f64,
    pub maximum_seconds: f64,
}

#[derive(Clone, Copy, Debug, Default, Deserialize)]
#[serde(default)]
pub struct Bucket {
    pub upper_seconds: Option<f64>,
    pub count: u64,
}

#[derive(Clone, Copy, Debug, Default, Deserialize)]
#[serde(default)]
pub struct Delivered {
    pub messages: u64,
    pub lost_messages: u64,
    pub lost_before_host_messages: u64,
    pub lost_in_reassembly_messages: u64,
    pub lost_in_socket_buffer_messages: u64,
    pub recovered_messages: u64,
    pub pending_messages: u64,
}

#[derive(Clone, Debug, Default, Deserialize)]
#[serde(default)]
pub struct Delivery {
    pub writer: String,
    pub direction: String,
    pub destination: String,
    pub subscriber: String,
    pub readers: Vec<String>,
    pub process: Option<String>,
    pub process_id: Option<u32>,
    pub delivered: Delivered,
}

#[derive(Clone, Debug, Default, Deserialize)]
#[serde(default)]
pub struct Acknowledgement {
    pub reader: String,
    pub missing_messages: u64,
    pub lag_messages: u64,
}

#[derive(Clone, Debug, Default, Deserialize)]
#[serde(default)]
pub struct Passage {
    pub passage: String,
    pub pairs: u64,
}

#[derive(Clone, Debug, Default, Deserialize)]
#[serde(default)]
pub struct Reason {
    pub code: String,
    pub detail: String,
}

/// `GET /health`.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(default)]
pub struct Health {
    pub ready: bool,
    pub reason: Option<String>,
    pub host: Option<String>,
    pub version: String,
    pub source: String,
    pub source_reason: Option<String>,
    pub finished: bool,
    pub age_seconds: Option<f64>,
    pub dropped_packets: u64,
    pub dropped_records: u64,
    pub dropped_datagrams: u64,
    pub contended_datagrams: u64,
    pub unknown_writers: u64,
    pub topics_rejected: u64,
    pub tables: Vec<Table>,
    pub abilities: Vec<Ability>,
}

#[derive(Clone, Debug, Default, Deserialize)]
#[serde(default)]
pub struct Table {
    pub table: String,
    pub evictions: u64,
}

#[derive(Clone, Debug, Default, Deserialize)]
#[serde(default)]
pub struct Ability {
    pub ability: String,
    pub able: bool,
    pub reason: Option<String>,
}

impl Health {
    /// Everything that was not looked at.
    #[must_use]
    pub const fn dropped(&self) -> u64 {
        self.dropped_packets
            .saturating_add(self.dropped_records)
            .saturating_add(self.dropped_datagrams)
            .saturating_add(self.contended_datagrams)
    }
}

/// One message of `GET /events`.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(default)]
pub struct Event {
    pub time: String,
    pub name: String,
    pub severity: String,
    pub attributes: Map<String, Value>,
}

/// The `data` of a message `lagged`.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(default)]
pub struct Lagged {
    pub missed: Option<u64>,
    pub reason: String,
}
