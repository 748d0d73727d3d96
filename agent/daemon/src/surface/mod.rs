//! What people and machines read and write: metrics, health and the control API over HTTP, from
//! immutable snapshots. Nothing here ever makes the capture wait.

mod agent;
pub mod agent_facts;
pub mod api;
mod authority;
mod basic_auth;
pub mod board;
mod bounded;
pub mod catalogue;
mod deliveries;
mod diagnoses;
pub mod events;
pub mod exposition;
pub mod http;
mod large;
pub mod limit_facts;
mod listen;
pub mod otlp;
mod pace;
mod packed;
mod page;
mod process;
pub mod recording_facts;
mod robot;
mod serving;
mod text;
#[cfg(feature = "tls")]
mod tls;
mod walk;
pub mod web_config;

pub use agent_facts::{
    Ability, AgentFacts, ExactFacts, InterfaceFacts, SharedMemoryFacts, SourceKind,
};
pub use board::{Board, Settings, State};
pub use events::{AgentEvent, EventLog};
pub use exposition::{Exposition, Format};
pub use limit_facts::{LimitFacts, LimitFigures, Place, Places};
pub use recording_facts::{RecordingFigures, SnapshotFigures};
