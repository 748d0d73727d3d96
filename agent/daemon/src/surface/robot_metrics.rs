//! Metrics of what the robot itself says.

use std::fmt;

use ros2probe_metrics::catalogue as metric;
use ros2probe_metrics::metric_sink::{Label, MetricSink};
use ros2probe_model::facts::glob::covers_text;
use ros2probe_model::report::snapshot::{DiagnosticStatus, Snapshot};
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

/// Writes the level of each part of the robot, and the values that the configuration selects.
pub(super) fn diagnostics(
    sink: &mut MetricSink<'_>,
    snapshot: &Snapshot,
    wanted: &[String],
) -> fmt::Result {
    let statuses = &snapshot.diagnostics.statuses;
    let is_wanted = |text: &str| wanted.iter().any(|pattern| covers_text(pattern, text));
    sink.family(&metric::DIAGNOSTICS_LEVEL, |family| {
        for status in statuses {
            family.sample(&part(status), status.level as u64)?;
        }
        Ok(())
    })?;
    sink.family(&metric::DIAGNOSTICS_VALUE, |family| {
        for status in statuses {
            for (key, value) in status.values.iter().filter(|_| !wanted.is_empty()) {
                let text = format!("{}/{key}", status.name);
                let number = value.trim().parse::<f64>();
                let number = number.ok().filter(|_| is_wanted(&text));
                if let Some(number) = number {
                    let [domain_id, topic, name, hardware_id] = part(status);
                    let labels = [domain_id, topic, name, hardware_id, Label::Text(key)];
                    family.sample(&labels, number)?;
                }
            }
        }
        Ok(())
    })
}

fn part(status: &DiagnosticStatus) -> [Label<'_>; 4] {
    [
        Label::Number(status.domain_id.0.into()),
        Label::Text(&status.topic),
        Label::Text(&status.name),
        Label::Text(&status.hardware_id),
    ]
}

/// Writes the number of changes of each node's parameters.
pub(super) fn parameters(sink: &mut MetricSink<'_>, snapshot: &Snapshot) -> fmt::Result {
    sink.family(&metric::PARAMETER_CHANGES, |family| {
        for (domain_id, node, changes) in &snapshot.parameters.counts {
            let labels = [Label::Number(domain_id.0.into()), Label::Text(node)];
            family.sample(&labels, *changes)?;
        }
        Ok(())
    })
}
