//! The source of all metrics. Pages and exports both use it, so they show the same values.

use std::fmt;
use std::pin::Pin;
use std::time::Duration;

use crate::metric_sink::MetricSink;

/// The figures of an agent.
pub trait MetricSource: fmt::Debug + Send + Sync {
    /// Writes all metrics in the catalogue's order. `previous` is the duration of the last
    /// collection.
    ///
    /// # Errors
    /// Fails if `sink` does.
    fn collect(&self, sink: &mut MetricSink<'_>, previous: Duration) -> fmt::Result;

    /// Returns whether a page shows exemplars.
    fn has_exemplars(&self) -> bool;

    /// Completes once the figures are fresh, or after the timeout.
    fn refresh(&self, timeout: Duration) -> Pin<Box<dyn Future<Output = ()> + '_>>;
}
