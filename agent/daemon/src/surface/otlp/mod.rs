//! OTLP: metrics, events, traces and the log are pushed to a receiver on a separate thread.
//!
//! The receiver may be absent, slow or intermittent. Memory stays bounded, undelivered items are
//! counted, and the capture never waits.

mod delivery;
mod encoded;
mod events;
mod exporter;
mod exports;
mod instruments;
mod metrics;
mod naming;
mod own_log;
pub(super) mod points;
mod reports;
mod resource;
mod settings;
mod starts;
#[cfg(test)]
mod tests;
mod traces;
mod transport;

pub use exporter::{Exporter, Queues, StartError};
pub use exports::{Exports, Outcome, Reason, Signal};
pub use own_log::LogQueue;
pub use resource::Host;
pub use settings::{Settings, SettingsError};
pub use traces::{QueuedSpan, SpanQueue, SpanSink};
