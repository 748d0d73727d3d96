//! What people and machines read and write: metrics, health and the control API over HTTP, from
//! immutable snapshots. Nothing here ever makes the capture wait.

pub mod agent_facts;
mod agent_metrics;
pub mod api;
mod authority;
mod basic_auth;
pub mod catalogue;
mod collect;
mod compressed_text;
mod connection;
mod delivery_metrics;
mod diagnosis_metrics;
pub mod events;
pub mod exposition;
pub mod http;
mod large_responses;
pub mod limit_facts;
mod limited_listener;
mod listen;
mod metric_sink;
pub mod otlp;
mod process;
pub mod recording_facts;
mod ros2_metrics;
mod serving;
pub mod settings_cell;
pub mod snapshot_cell;
mod text;
#[cfg(feature = "tls")]
mod tls;
pub mod web_config;

pub use agent_facts::{
    Ability, AgentFacts, ExactFacts, InterfaceFacts, SharedMemoryFacts, SourceKind,
};
pub use collect::MetricSources;
pub use events::{AgentEvent, EventLog};
pub use exposition::{Exposition, Format};
pub use limit_facts::{LimitFacts, LimitFigures, Slot, Slots};
pub use recording_facts::{RecordingFigures, SnapshotFigures};
pub use settings_cell::{Settings, SettingsCell};
pub use snapshot_cell::{CaptureBell, SnapshotCell, State};
