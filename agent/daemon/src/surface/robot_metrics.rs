//! Metrics of what the robot itself says.

use std::fmt;

use ros2probe_metrics::catalogue::{self as metric, Metric};
use ros2probe_metrics::metric_sink::{Label, MetricSink};
use ros2probe_model::derive::clocks::{THIS_HOST, seconds};
use ros2probe_model::report::snapshot::{ClockOffset, Snapshot};
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

/// Writes the offsets between clocks, and the steps of each peer's clock.
pub(super) fn clocks(sink: &mut MetricSink<'_>, snapshot: &Snapshot) -> fmt::Result {
    let clocks = &snapshot.clocks;
    let figures: [(&Metric, fn(&ClockOffset) -> i64); 2] = [
        (&metric::CLOCK_OFFSET, |clock| clock.offset),
        (&metric::CLOCK_UNCERTAINTY, |clock| clock.uncertainty),
    ];
    for (metric, figure) in figures {
        sink.family(metric, |family| {
            clocks.offsets.iter().try_for_each(|clock| {
                let host = clock.host.as_deref().unwrap_or(THIS_HOST);
                let labels = [Label::Text(host), Label::Text(&clock.peer)];
                family.sample(&labels, seconds(figure(clock)))
            })
        })?;
    }
    sink.family(&metric::CLOCK_STEPS, |family| {
        let mut peers = clocks.peers.iter();
        peers.try_for_each(|clock| family.sample(&[Label::Text(&clock.peer)], clock.steps))
    })
}
