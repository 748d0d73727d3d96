//! Declarations of the bounded tables of exports, which robots can fill.

ros2probe_model::tables! {
    /// Spans that wait for export
    WaitingSpans {
        name: "otlp.spans", entries: 4096, effect: "dropped", reported: "`ros2probe_otlp_dropped_total`",
    }
    /// Messages of nodes' logs that wait for export, at most 1 KiB each
    WaitingNodeLogs {
        name: "otlp.node_logs", entries: 1024, effect: "dropped", reported: "`ros2probe_otlp_dropped_total`",
    }
    /// Series with a start time
    SeriesStarts { name: "otlp.starts", entries: 200_000, effect: "further ones start with the agent" }
}

#[cfg(test)]
pub(crate) mod tests {
    use ros2probe_model::facts::bounded::{Declared, ledger};

    /// Asserts that this test filled a table to its cap, and not beyond.
    pub(crate) fn assert_driven<D: Declared>() {
        let used = ledger()[D::TABLE.name];
        assert!(used.is_driven(), "{}: {used:?}", D::TABLE.name);
    }
}
