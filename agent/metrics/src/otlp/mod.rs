//! OTLP: metrics, events, traces and the log are pushed to a receiver on a separate thread.
//!
//! The receiver may be absent, slow or intermittent. Events, logs and spans wait on disk. Memory
//! stays bounded, undelivered items are counted, and the capture never waits. The caller starts the
//! thread, with the privileges of exports.

mod delivery;
mod encoded;
mod encoded_sender;
mod endpoint;
mod events;
mod exporter;
mod exports;
mod hardware;
mod headers;
mod instruments;
mod kept;
mod metrics;
mod naming;
mod node_logs;
mod own_log;
mod parts;
pub(crate) mod points;
mod queued;
mod reports;
mod resource;
mod settings;
mod starts;
mod traces;
mod transport;
mod waiting;

pub use endpoint::otlp_endpoint;
pub use exporter::{Inputs, StartError, start};
pub use exports::{Exports, Outcome, Reason, Signal};
pub use hardware::NoHardware;
pub use node_logs::{NodeLogQueue, NodeLogSink};
pub use own_log::LogQueue;
pub use resource::Host;
pub use settings::{
    Compression, Endpoint, OtlpProtocol, OtlpSettings, ReadText, Settings, SettingsError,
};
pub use traces::{SpanQueue, SpanSink};
