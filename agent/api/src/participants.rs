//! `/participants` and `/processes`.

use std::borrow::Cow;
use std::net::SocketAddr;

use serde::{Deserialize, Serialize};

use crate::endpoints::Process;
use crate::measurement::Measurement;

/// Participants.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct ParticipantList<'a> {
    /// Unix time of the facts.
    pub timestamp_seconds: f64,
    /// By domain and GUID.
    pub participants: Vec<Participant<'a>>,
    /// Writers that send although their announcement was not seen; of no known domain.
    pub unknown_writers: Vec<UnknownWriter<'a>>,
}

/// One participant.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct Participant<'a> {
    /// GUID, as the metrics show it.
    pub guid: String,
    /// Domain.
    pub domain_id: u32,
    /// Implementation.
    #[cfg_attr(feature = "openapi", schema(example = "eProsima Fast DDS"))]
    pub vendor: Cow<'a, str>,
    /// ROS enclave; null means it is no ROS participant.
    pub enclave: Option<Cow<'a, str>>,
    /// Where it lives.
    #[serde(flatten)]
    pub process: Process<'a>,
    /// Its nodes.
    pub nodes: Vec<Cow<'a, str>>,
    /// How many writers it has.
    pub writers: usize,
    /// How many readers it has.
    pub readers: usize,
    /// Where its discovery endpoints are reached over UDP.
    #[cfg_attr(feature = "openapi", schema(value_type = Vec<String>))]
    pub metatraffic_addresses: Cow<'a, [SocketAddr]>,
    /// Where its other endpoints are reached over UDP.
    #[cfg_attr(feature = "openapi", schema(value_type = Vec<String>))]
    pub default_addresses: Cow<'a, [SocketAddr]>,
    /// Lease; null is infinite.
    pub lease_seconds: Option<f64>,
    /// Unix time of its first announcement.
    pub first_seen_timestamp_seconds: f64,
    /// Unix time of its last sign of life.
    pub last_seen_timestamp_seconds: f64,
    /// It announces DDS security: its messages may be encrypted.
    pub secured: bool,
    /// Known from before the agent's start and not heard since.
    pub restored: bool,
}

/// A writer whose announcement was not seen.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct UnknownWriter<'a> {
    /// GUID.
    pub guid: String,
    /// DDS implementation; empty when unknown.
    pub vendor: Cow<'a, str>,
    /// Where it lives.
    #[serde(flatten)]
    pub process: Process<'a>,
    /// Unix time of its first message.
    pub first_seen_timestamp_seconds: f64,
    /// What was counted of it.
    pub measurement: Measurement,
}

/// Processes of participants on this host.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct ProcessList {
    /// Unix time of the reading, by this host's clock.
    pub timestamp_seconds: f64,
    /// By process id.
    pub processes: Vec<ProcessUsage>,
    /// Processes of which the kernel shows the agent nothing: see `ProtectProc=` of its unit.
    pub unreadable: usize,
}

/// What a process has used.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(default)]
pub struct ProcessUsage {
    /// Its id, in the agent's process namespace.
    pub process_id: u32,
    /// Its name.
    pub process: String,
    /// CPU time so far; what two readings differ by, over the time between them, is its share.
    pub cpu_seconds: f64,
    /// Resident memory.
    pub memory_bytes: u64,
    /// Threads.
    pub threads: u32,
    /// Unix time of its start.
    pub started_timestamp_seconds: Option<f64>,
}
