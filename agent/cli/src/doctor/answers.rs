//! What a running agent answers, as far as checks need it. A field that an older agent does not have
//! has its default.

use serde::Deserialize;

use crate::client::{Agent, ClientError};

/// All answers of one agent.
#[derive(Clone, Debug, Default)]
pub struct Answers {
    /// `GET /health`.
    pub health: Health,
    /// `GET /participants`.
    pub participants: Participants,
    /// `GET /topics`.
    pub topics: Topics,
    /// `GET /watch`.
    pub watches: Watches,
}

impl Answers {
    /// Asks an agent, about one domain or all of them.
    ///
    /// # Errors
    /// It is gone, or does not answer what an agent answers.
    pub fn ask(agent: &Agent, domain_id: Option<u32>) -> Result<Self, ClientError> {
        let within = domain_id.map_or_else(String::new, |domain| format!("?domain_id={domain}"));
        Ok(Self {
            health: agent.get("/health")?,
            participants: agent.get(&format!("/participants{within}"))?,
            topics: agent.get(&format!("/topics{within}"))?,
            watches: agent.get("/watch")?,
        })
    }
}

/// How the agent is.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(default)]
pub struct Health {
    /// It sees.
    pub ready: bool,
    /// Why it does not.
    pub reason: Option<String>,
    /// Its version.
    pub version: String,
    /// `host`, `wire` or `replay`.
    pub source: String,
    /// Watches that clients add outlive it.
    pub watches_kept: bool,
    /// Packets lost in a ring.
    pub dropped_packets: u64,
    /// Records lost in a ring.
    pub dropped_records: u64,
    /// Captured datagrams lost in a ring.
    pub dropped_datagrams: u64,
    /// Watched topics beyond the cap.
    pub topics_rejected: u64,
    /// Why it does not look where it would see more.
    pub source_reason: Option<String>,
    /// What it can see.
    pub abilities: Vec<AbilityState>,
    /// Where packets come from.
    pub interfaces: Vec<Interface>,
    /// Bounded tables.
    pub tables: Vec<Table>,
    /// Caps of its configuration.
    pub limits: Vec<Limit>,
    /// Capabilities it kept.
    pub capabilities: Vec<String>,
    /// Why its system calls are not filtered.
    pub unfiltered_reason: Option<String>,
    /// Its process.
    pub process_id: u32,
    /// Since its start.
    pub uptime_seconds: Option<f64>,
}

/// One thing that it may see.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(default)]
pub struct AbilityState {
    /// Which.
    pub ability: String,
    /// Whether.
    pub able: bool,
    /// Why not.
    pub reason: Option<String>,
}

/// Where packets come from.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(default)]
pub struct Interface {
    /// Its name.
    pub interface: String,
    /// How many came.
    pub packets: Option<u64>,
}

/// A bounded table.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(default)]
pub struct Table {
    /// Its name.
    pub table: String,
    /// Its cap.
    pub limit: u64,
    /// Given up because of it.
    pub evictions: u64,
}

/// A cap of the configuration.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(default)]
pub struct Limit {
    /// Its key.
    pub limit: String,
    /// What may be.
    pub cap: u64,
    /// What is.
    pub used: u64,
    /// Refused or given up because of it.
    pub reached: u64,
    /// There is no room, or was none a moment ago.
    pub at_limit: bool,
}

/// All participants.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(default)]
pub struct Participants {
    /// Those announced.
    pub participants: Vec<Participant>,
    /// Writers that were not.
    pub unknown_writers: Vec<UnknownWriter>,
}

/// One participant.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(default)]
pub struct Participant {
    /// Domain.
    pub domain_id: u32,
    /// Implementation.
    pub vendor: String,
    /// ROS enclave, of ROS participants.
    pub enclave: Option<String>,
    /// Its process.
    pub process_id: Option<u32>,
    /// Its name.
    pub process: Option<String>,
    /// Its control group: it has a socket on the agent's host.
    pub cgroup: Option<String>,
    /// Its nodes.
    pub nodes: Vec<String>,
    /// Writers it has.
    pub writers: u64,
    /// Readers it has.
    pub readers: u64,
    /// It uses DDS security.
    pub secured: bool,
    /// From before the agent's start.
    pub restored: bool,
}

/// A writer that was never announced.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(default)]
pub struct UnknownWriter {
    /// GUID.
    pub guid: String,
}

/// All topics.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(default)]
pub struct Topics {
    /// By domain and name.
    pub topics: Vec<Topic>,
}

/// One topic.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(default)]
pub struct Topic {
    /// Domain.
    pub domain_id: u32,
    /// Name.
    pub name: String,
    /// Its last endpoint has gone.
    pub vanished: bool,
    /// Its writers.
    pub publishers: Vec<Publisher>,
    /// What was counted.
    pub measurement: Option<Measurement>,
    /// What reached receivers on the agent's host.
    pub received: Option<Received>,
    /// How messages pass between its endpoints.
    pub passages: Vec<Passage>,
    /// What is wrong with it.
    pub diagnoses: Vec<Diagnosis>,
}

/// A writer.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(default)]
pub struct Publisher {
    /// What was counted of it.
    pub measurement: Option<Measurement>,
}

/// What was counted.
#[derive(Clone, Copy, Debug, Default, Deserialize)]
#[serde(default)]
pub struct Measurement {
    /// Messages.
    pub messages: u64,
    /// Their bytes.
    pub bytes: u64,
    /// A second.
    pub rate_hertz: f64,
    /// Stamped after their capture.
    pub negative_latency_messages: u64,
}

/// What reached receivers.
#[derive(Clone, Copy, Debug, Default, Deserialize)]
#[serde(default)]
pub struct Received {
    /// Messages.
    pub messages: u64,
    /// Died in reassembly.
    pub lost_in_reassembly_messages: u64,
    /// Died in a socket's buffer.
    pub lost_in_socket_buffer_messages: u64,
}

/// Pairs of endpoints by how messages pass.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(default)]
pub struct Passage {
    /// `network`, `shared_memory`, ...
    pub passage: String,
    /// How many pairs.
    pub pairs: u64,
}

/// One finding about the graph.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(default)]
pub struct Diagnosis {
    /// Which.
    pub kind: String,
}

/// All watches.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(default)]
pub struct Watches {
    /// Of every origin.
    pub watches: Vec<Watch>,
}

/// One watch.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(default)]
pub struct Watch {
    /// Name or glob.
    pub topic: String,
    /// `starting`, `waiting`, `measuring` or `rejected`.
    pub state: String,
}
