//! Metrics of links.

use std::fmt;

use ros2probe_metrics::catalogue::{self as metric, Metric};
use ros2probe_metrics::metric_sink::{Label, MetricSink};
use ros2probe_model::measure::links::LinkFacts;
use ros2probe_model::report::snapshot::Snapshot;

/// Reads a figure of a link.
type Figure = fn(&LinkFacts) -> u64;

const LINK_FIGURES: [(&Metric, Figure); 4] = [
    (&metric::LINK_CONNECTIONS, |link| link.connections),
    (&metric::LINK_SENT, |link| link.sent),
    (&metric::LINK_RETRANSMITTED, |link| link.retransmitted),
    (&metric::LINK_UNACKNOWLEDGED, |link| link.unacknowledged),
];

/// Writes the figures of each link.
pub(super) fn links(sink: &mut MetricSink<'_>, snapshot: &Snapshot) -> fmt::Result {
    let links: Vec<_> = snapshot
        .links
        .iter()
        .map(|facts| {
            let (source, destination) = (facts.key.source, facts.key.destination);
            (facts, source.to_string(), destination.to_string())
        })
        .collect();
    let labels = |protocol: &'static str, source, destination| {
        [
            Label::Text(protocol),
            Label::Text(source),
            Label::Text(destination),
        ]
    };
    for (metric, figure) in LINK_FIGURES {
        sink.family(metric, |family| {
            links.iter().try_for_each(|(facts, source, destination)| {
                let labels = labels(facts.key.protocol.label(), source, destination);
                family.sample(&labels, figure(facts))
            })
        })?;
    }
    sink.family(&metric::LINK_UNSENT, |family| {
        links.iter().try_for_each(|(facts, source, destination)| {
            let labels = labels(facts.key.protocol.label(), source, destination);
            match facts.unsent {
                Some(bytes) => family.sample(&labels, bytes),
                None => Ok(()),
            }
        })
    })?;
    sink.family(&metric::LINK_ROUND_TRIP, |family| {
        links.iter().try_for_each(|(facts, source, destination)| {
            let labels = labels(facts.key.protocol.label(), source, destination);
            match facts.round_trip {
                Some(time) => family.sample(&labels, time.as_secs_f64()),
                None => Ok(()),
            }
        })
    })
}
