//! Counters of exports, shown with the agent's own metrics: an exporter that delivers nothing must
//! not look like an idle robot.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

/// An exported signal.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Signal {
    /// Data points.
    Metrics,
    /// Log records.
    Events,
    /// Spans.
    Traces,
    /// Lines of the agent's own log.
    Log,
    /// Messages of the logs of nodes.
    NodeLogs,
}

/// Result of a request.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// The receiver accepted all items.
    Delivered,
    /// The receiver rejected some items.
    Partial,
    /// The request failed and is sent again.
    Retried,
    /// The request failed and is dropped.
    Failed,
}

/// Why items were not delivered.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Reason {
    /// The local queue or budget was full.
    Overflow,
    /// Newer points arrived while the receiver was unavailable.
    Superseded,
    /// The receiver refuses the signal.
    Refused,
    /// The receiver rejected these items and accepted the others.
    Rejected,
    /// The receiver or the link does not take a single item of this size.
    TooLarge,
    /// The agent stopped first.
    Shutdown,
}

/// Counters of all signals.
#[derive(Debug, Default)]
pub struct Exports {
    enabled: [AtomicBool; Signal::ALL.len()],
    requests: [[AtomicU64; Outcome::ALL.len()]; Signal::ALL.len()],
    dropped: [[AtomicU64; Reason::ALL.len()]; Signal::ALL.len()],
    queue_bytes: [AtomicU64; Signal::ALL.len()],
}

impl Signal {
    /// All signals.
    pub const ALL: [Self; 5] = [
        Self::Metrics,
        Self::Events,
        Self::Traces,
        Self::Log,
        Self::NodeLogs,
    ];

    /// Returns the label value.
    #[must_use]
    pub const fn label(self) -> &'static str {
        match self {
            Self::Metrics => "metrics",
            Self::Events => "events",
            Self::Traces => "traces",
            Self::Log => "log",
            Self::NodeLogs => "node_logs",
        }
    }
}

impl Outcome {
    /// All outcomes.
    pub const ALL: [Self; 4] = [Self::Delivered, Self::Partial, Self::Retried, Self::Failed];

    /// Returns the label value.
    #[must_use]
    pub const fn label(self) -> &'static str {
        match self {
            Self::Delivered => "delivered",
            Self::Partial => "partial",
            Self::Retried => "retried",
            Self::Failed => "failed",
        }
    }
}

impl Reason {
    /// All reasons.
    pub const ALL: [Self; 6] = [
        Self::Overflow,
        Self::Superseded,
        Self::Refused,
        Self::Rejected,
        Self::TooLarge,
        Self::Shutdown,
    ];

    /// Returns the label value.
    #[must_use]
    pub const fn label(self) -> &'static str {
        match self {
            Self::Overflow => "overflow",
            Self::Superseded => "superseded",
            Self::Refused => "refused",
            Self::Rejected => "rejected",
            Self::TooLarge => "too_large",
            Self::Shutdown => "shutdown",
        }
    }
}

impl Exports {
    /// Marks the signal as exported, so that its counters are shown.
    pub fn enable(&self, signal: Signal) {
        for (each, enabled) in Signal::ALL.into_iter().zip(&self.enabled) {
            if each == signal {
                enabled.store(true, Ordering::Relaxed);
            }
        }
    }

    /// Returns the exported signals.
    pub fn signals(&self) -> impl Iterator<Item = Signal> + '_ {
        let all = Signal::ALL.into_iter().zip(&self.enabled);
        all.filter_map(|(signal, enabled)| enabled.load(Ordering::Relaxed).then_some(signal))
    }

    /// Counts a request.
    pub(super) fn count_request(&self, signal: Signal, outcome: Outcome) {
        if let Some(count) = find(&self.requests, signal, outcome as usize) {
            count.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// Counts items that were not delivered.
    pub(super) fn count_dropped(&self, signal: Signal, reason: Reason, items: u64) {
        if let Some(count) = find(&self.dropped, signal, reason as usize) {
            count.fetch_add(items, Ordering::Relaxed);
        }
    }

    /// Sets the size of a signal's queue on disk.
    pub(super) fn set_queue_bytes(&self, signal: Signal, bytes: u64) {
        if let Some(size) = self.queue_bytes.get(signal as usize) {
            size.store(bytes, Ordering::Relaxed);
        }
    }

    /// Returns the size of a signal's queue on disk, in bytes.
    #[must_use]
    pub fn queue_bytes(&self, signal: Signal) -> u64 {
        self.queue_bytes
            .get(signal as usize)
            .map_or(0, |size| size.load(Ordering::Relaxed))
    }

    /// Returns the number of requests with this outcome.
    #[must_use]
    pub fn requests(&self, signal: Signal, outcome: Outcome) -> u64 {
        find(&self.requests, signal, outcome as usize)
            .map_or(0, |count| count.load(Ordering::Relaxed))
    }

    /// Returns the number of items that were not delivered for this reason.
    #[must_use]
    pub fn dropped(&self, signal: Signal, reason: Reason) -> u64 {
        find(&self.dropped, signal, reason as usize)
            .map_or(0, |count| count.load(Ordering::Relaxed))
    }
}

fn find<const N: usize>(
    counts: &[[AtomicU64; N]; Signal::ALL.len()],
    signal: Signal,
    column: usize,
) -> Option<&AtomicU64> {
    counts.get(signal as usize)?.get(column)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn signals_are_counted_separately_and_only_enabled_ones_are_exported() {
        let exports = Exports::default();
        assert_eq!(exports.signals().count(), 0);
        exports.enable(Signal::Traces);
        assert_eq!(exports.signals().collect::<Vec<_>>(), [Signal::Traces]);
        for (index, signal) in Signal::ALL.into_iter().enumerate() {
            for (row, reason) in Reason::ALL.into_iter().enumerate() {
                exports.count_dropped(signal, reason, (index * 10 + row) as u64);
            }
            for _ in 0..=index {
                exports.count_request(signal, Outcome::Failed);
            }
        }
        for (index, signal) in Signal::ALL.into_iter().enumerate() {
            for (row, reason) in Reason::ALL.into_iter().enumerate() {
                assert_eq!(exports.dropped(signal, reason), (index * 10 + row) as u64);
            }
            assert_eq!(exports.requests(signal, Outcome::Failed), index as u64 + 1);
            assert_eq!(exports.requests(signal, Outcome::Delivered), 0);
        }
    }
}
