//! The robots of a fleet: which is in trouble, and what differs from the others.
//!
//! The figures come from an engine with the query API of Prometheus, to which the robots' agents
//! deliver. The incidents come from the store to which `rp ship` delivers bags. Nothing is stored
//! here, and no robot is contacted. `rp fleet` renders them as text, and the agent as an answer of
//! its API, which its page shows.

mod differences;
mod engine;
mod incidents;
mod link;
mod reader;
mod robot;

use ros2probe_metrics::export_thread::{ExportThread, Spawn};
use std::io;
use std::sync::Arc;

use ros2probe_ship::SettingsError;

use crate::config::FleetSettings;
pub use engine::{Engine, EngineError, InvalidAddress, MAX_BYTES, is_engine};
pub use incidents::IncidentReader;
pub use link::{InvalidLink, Link};
pub use reader::{Known, POLL_INTERVAL, Reader, Sources};
pub use robot::{Question, read};

/// Maximum size of the file with a token, in bytes.
const TOKEN_BYTES: u64 = 64 << 10;
/// Maximum length of an answer of an engine to an agent, in bytes. While clients ask, memory holds
/// the labels of eleven of them, and of each series what it means. The engine bounds their number.
const AGENT_ANSWER_BYTES: usize = 4 << 20;

/// Why the view of a fleet cannot start.
#[derive(Debug, thiserror::Error)]
pub enum StartError {
    /// The file with the token cannot be read.
    #[error("cannot use `fleet.token_file`")]
    Token(#[source] EngineError),
    /// The engine's address or the certificate authorities are unusable.
    #[error(transparent)]
    Engine(EngineError),
    /// The store's address is none.
    #[error("fleet.store")]
    Store(#[from] SettingsError),
    /// No runtime or thread starts.
    #[error("cannot start the thread that queries the engine")]
    Thread(#[source] io::Error),
}

impl From<EngineError> for StartError {
    fn from(error: EngineError) -> Self {
        match error {
            EngineError::TokenFile { .. } | EngineError::Token => Self::Token(error),
            error => Self::Engine(error),
        }
    }
}

/// Starts the thread that queries the configured engine on demand, with the privileges of exports.
/// Returns `None` without an engine.
///
/// # Errors
///
/// Fails if the token cannot be read, or if no thread starts. An unavailable engine is no error.
pub fn start(
    settings: &FleetSettings,
    spawn: Spawn,
) -> Result<Option<(ExportThread, Arc<Reader>)>, StartError> {
    let Some(url) = &settings.engine else {
        return Ok(None);
    };
    let engine = Engine::new(url, settings.token_file.as_deref(), AGENT_ANSWER_BYTES)?;
    let incidents = settings.store.clone().map(IncidentReader::new);
    let sources = Sources {
        engine,
        question: settings.question.clone(),
        incidents: incidents.transpose()?,
    };
    let reader = Arc::new(Reader::new(settings.link.clone(), &sources));
    let polled = Arc::clone(&reader);
    let thread = reader::start(polled, sources, spawn).map_err(StartError::Thread)?;
    Ok(Some((thread, reader)))
}
