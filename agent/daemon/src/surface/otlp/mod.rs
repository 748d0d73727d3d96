//! OTLP: metrics, events and traces are pushed to a receiver on a separate thread.
//!
//! The receiver may be absent, slow or intermittent. Memory stays bounded, undelivered items are
//! counted, and the capture never waits.

mod client;
mod events;
mod exporter;
mod exports;
mod metrics;
mod naming;
pub(super) mod points;
mod resource;
mod settings;
mod signal_sender;
mod starts;
#[cfg(test)]
mod tests;
mod traces;

pub use exporter::{Exporter, StartError};
pub use exports::{Exports, Outcome, Reason, Signal};
pub use resource::Host;
pub use settings::{Settings, SettingsError};
pub use traces::{QueuedSpan, SpanQueue, SpanSink};
