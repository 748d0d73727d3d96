//! Metrics of what the robot itself says.

use std::fmt;

use ros2probe_metrics::catalogue as metric;
use ros2probe_metrics::metric_sink::{Label, MetricSink};
use ros2probe_model::derive::clocks::{THIS_HOST, seconds};
use ros2probe_model::facts::glob::covers_text;
use ros2probe_model::facts::robot::TransformJump;
use ros2probe_model::report::snapshot::{
    ClockOffset, DiagnosticStatus, EdgeFacts, Jumps, Snapshot, TreeFacts,
};
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
        for status in statuses.iter().filter(|_| !wanted.is_empty()) {
            for (place, (key, value)) in status.values.iter().enumerate() {
                let text = format!("{}/{key}", status.name);
                let number = number_of(value).filter(|_| is_wanted(&text));
                let Some(number) = number else {
                    continue;
                };
                // A key may be repeated, but a page has each series once.
                let mut earlier = status.values.iter().take(place);
                if earlier.any(|(other, value)| other == key && number_of(value).is_some()) {
                    continue;
                }
                let [domain_id, topic, name, hardware_id] = part(status);
                let labels = [domain_id, topic, name, hardware_id, Label::Text(key)];
                family.sample(&labels, number)?;
            }
        }
        Ok(())
    })
}

fn number_of(value: &str) -> Option<f64> {
    value.trim().parse().ok()
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

/// Writes counts, ages, broadcasters and jumps of transforms.
pub(super) fn transforms(sink: &mut MetricSink<'_>, snapshot: &Snapshot) -> fmt::Result {
    let edges = || {
        let trees = snapshot.transforms.trees.iter();
        trees.flat_map(|tree| {
            tree.edges
                .iter()
                .map(move |edge| (labels(tree, edge), edge))
        })
    };
    sink.family(&metric::TRANSFORM_MESSAGES, |family| {
        edges().try_for_each(|(labels, edge)| family.sample(&labels, edge.count))
    })?;
    sink.family(&metric::TRANSFORM_AGE, |family| {
        let mut moving = edges().filter(|(_, edge)| !edge.is_static);
        moving.try_for_each(|(labels, edge)| {
            let age = snapshot.at - edge.at;
            family.sample(&labels, age.as_secs_f64())
        })
    })?;
    sink.family(&metric::TRANSFORM_BROADCASTERS, |family| {
        edges()
            .try_for_each(|(labels, edge)| family.sample(&labels, edge.broadcasters.len() as u64))
    })?;
    sink.family(&metric::TRANSFORM_JUMPS, |family| {
        for ([domain_id, namespace, parent, child], edge) in edges() {
            let Jumps {
                translation,
                rotation,
                time,
            } = edge.jumps;
            let kinds = [
                (TransformJump::Translation, translation),
                (TransformJump::Rotation, rotation),
                (TransformJump::Time, time),
            ];
            for (kind, jumps) in kinds.into_iter().filter(|(_, jumps)| *jumps > 0) {
                let kind = Label::Text(kind.label());
                family.sample(&[domain_id, namespace, parent, child, kind], jumps)?;
            }
        }
        Ok(())
    })
}

fn labels<'a>(tree: &'a TreeFacts, edge: &'a EdgeFacts) -> [Label<'a>; 4] {
    [
        Label::Number(tree.domain_id.0.into()),
        Label::Text(&tree.namespace),
        Label::Text(&edge.parent),
        Label::Text(&edge.child),
    ]
}

/// Writes the offsets between clocks, and the steps of each peer's clock.
pub(super) fn clocks(sink: &mut MetricSink<'_>, snapshot: &Snapshot) -> fmt::Result {
    let clocks = &snapshot.clocks;
    sink.family(&metric::CLOCK_OFFSET, |family| {
        let mut offsets = clocks.offsets.iter();
        offsets.try_for_each(|clock| family.sample(&hosts(clock), seconds(clock.offset)))
    })?;
    sink.family(&metric::CLOCK_UNCERTAINTY, |family| {
        let mut offsets = clocks.offsets.iter();
        offsets.try_for_each(|clock| family.sample(&hosts(clock), seconds(clock.uncertainty)))
    })?;
    sink.family(&metric::CLOCK_STEPS, |family| {
        let mut peers = clocks.peers.iter();
        peers.try_for_each(|clock| family.sample(&[Label::Text(&clock.peer)], clock.steps))
    })
}

fn hosts(clock: &ClockOffset) -> [Label<'_>; 2] {
    let host = clock.host.as_deref().unwrap_or(THIS_HOST);
    [Label::Text(host), Label::Text(&clock.peer)]
}
