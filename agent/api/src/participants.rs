//! `/participants` and `/processes`.

use std::borrow::Cow;
use std::net::SocketAddr;

use serde::{Deserialize, Serialize};

use crate::endpoints::Process;
use crate::measurement::Measurement;

/// All participants.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct ParticipantList<'a> {
    /// Unix time of the state that this answer describes.
    pub timestamp_seconds: f64,
    /// Participants, sorted by domain and GUID.
    pub participants: Vec<Participant<'a>>,
    /// Active writers whose announcement was missed; their domain is unknown.
    pub unknown_writers: Vec<UnknownWriter<'a>>,
    /// TCP connections that carry RTPS or Zenoh to other hosts, by pair of addresses.
    pub links: Vec<Link<'a>>,
    /// TCP connections of RTPS that were encrypted with TLS, since the agent started. Their messages
    /// cannot be read.
    pub tls_connections: u64,
}

/// The TCP connections of one protocol from an address of this host to another host.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Link<'a> {
    /// `rtps` or `zenoh`.
    #[cfg_attr(feature = "openapi", schema(example = "zenoh"))]
    pub protocol: Cow<'a, str>,
    /// Address of this host.
    #[cfg_attr(feature = "openapi", schema(example = "10.0.0.1"))]
    pub source: String,
    /// Address of the other host.
    #[cfg_attr(feature = "openapi", schema(example = "10.0.0.2"))]
    pub destination: String,
    /// Number of current connections.
    pub connections: u64,
    /// Smoothed round trip time, the longest of the connections; null without one.
    pub round_trip_seconds: Option<f64>,
    /// Segments with data that this host sent while the agent ran, retransmitted ones included.
    pub sent_segments: u64,
    /// Segments that this host sent again.
    pub retransmitted_segments: u64,
    /// Bytes that were sent and are not acknowledged.
    pub unacknowledged_bytes: u64,
    /// Bytes that applications of this host wrote and that its kernel has not sent yet; null if the
    /// kernel does not show them.
    pub unsent_bytes: Option<u64>,
}

/// A DDS participant or a Zenoh session.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Participant<'a> {
    /// GUID in the form that the metrics use.
    pub guid: String,
    /// Domain id.
    pub domain_id: u32,
    /// Middleware: the DDS implementation, or `Eclipse Zenoh`.
    #[cfg_attr(feature = "openapi", schema(example = "eProsima Fast DDS"))]
    pub vendor: Cow<'a, str>,
    /// Version of the middleware; null if the participant announces none. Cyclone DDS, Fast DDS 3.0
    /// and later, and RTI Connext announce it.
    #[cfg_attr(feature = "openapi", schema(example = "0.10.2"))]
    pub product_version: Option<Cow<'a, str>>,
    /// ROS enclave; null if the participant does not use ROS.
    pub enclave: Option<Cow<'a, str>>,
    /// Host and process of the participant.
    #[serde(flatten)]
    pub process: Process<'a>,
    /// Names of the participant's nodes.
    pub nodes: Vec<Cow<'a, str>>,
    /// Number of writers.
    pub writers: usize,
    /// Number of readers.
    pub readers: usize,
    /// UDP addresses of the discovery endpoints.
    #[cfg_attr(feature = "openapi", schema(value_type = Vec<String>))]
    pub metatraffic_addresses: Cow<'a, [SocketAddr]>,
    /// UDP addresses of the other endpoints.
    #[cfg_attr(feature = "openapi", schema(value_type = Vec<String>))]
    pub default_addresses: Cow<'a, [SocketAddr]>,
    /// Lease duration in seconds; null is infinite.
    pub lease_seconds: Option<f64>,
    /// Unix time of the participant's first announcement.
    pub first_seen_timestamp_seconds: f64,
    /// Unix time of the last packet that proves the participant alive.
    pub last_seen_timestamp_seconds: f64,
    /// The participant announces DDS security: its messages may be encrypted.
    pub secured: bool,
    /// It announces its endpoints by TCP and not by UDP (Fast DDS with `LARGE_DATA`, or with TCP
    /// transports). `rp discover` cannot request them.
    pub announces_by_tcp: bool,
    /// It does so, and none of its messages by TCP was seen: it has no peer, the connections are
    /// encrypted, or they do not pass this host.
    pub announces_unseen: bool,
    /// Discovery Server of Fast DDS: it passes on what other participants announce.
    pub discovery_server: bool,
    /// Restored from saved state; no announcement has confirmed it since the agent started.
    pub restored: bool,
}

/// An active writer whose announcement was missed.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct UnknownWriter<'a> {
    /// GUID of the writer.
    pub guid: String,
    /// Middleware: the DDS implementation, or `Eclipse Zenoh`; empty when unknown.
    pub vendor: Cow<'a, str>,
    /// Host and process of the writer.
    #[serde(flatten)]
    pub process: Process<'a>,
    /// Unix time of the writer's first message.
    pub first_seen_timestamp_seconds: f64,
    /// Counts and times of the writer.
    pub measurement: Measurement,
}

/// Processes of ROS participants on this host.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct ProcessList {
    /// Unix time of the readings, by this host's clock.
    pub timestamp_seconds: f64,
    /// Processes, sorted by id.
    pub processes: Vec<ProcessUsage>,
    /// Number of processes whose usage the agent cannot read; see `ProtectProc=` in its systemd
    /// unit.
    pub unreadable: usize,
}

/// Resource usage of a process.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct ProcessUsage {
    /// Process id, in the agent's PID namespace.
    pub process_id: u32,
    /// Name of the process.
    pub process: String,
    /// File or module that an interpreter runs (`robot.py`); null for another program.
    pub script: Option<String>,
    /// CPU time since the process started, in seconds. The CPU share is the difference of two
    /// readings, divided by the time between them.
    pub cpu_seconds: f64,
    /// Resident memory, in bytes.
    pub memory_bytes: u64,
    /// Number of threads.
    pub threads: u32,
    /// Unix time of the process's start; null when unknown.
    pub started_timestamp_seconds: Option<f64>,
}
