//! Metrics of what the robot itself says.

use std::fmt;

use ros2probe_metrics::catalogue as metric;
use ros2probe_metrics::metric_sink::{Label, MetricSink};
use ros2probe_model::report::snapshot::Snapshot;
use ros2probe_wire::log::LogLevel;

/// Writes the counts of log messages by node and level.
pub(super) fn logs(sink: &mut MetricSink<'_>, snapshot: &Snapshot) -> fmt::Result {
    sink.family(&metric::LOG_MESSAGES, |family| {
        for log in &snapshot.logs.nodes {
            for (level, (messages, _)) in LogLevel::ALL.iter().zip(&log.levels) {
                let labels = [
                    Label::Number(log.domain_id.0.into()),
                    Label::Text(&log.node),
                    Label::Text(level.label()),
                ];
                if *messages > 0 {
                    family.sample(&labels, *messages)?;
                }
            }
        }
        Ok(())
    })
}
