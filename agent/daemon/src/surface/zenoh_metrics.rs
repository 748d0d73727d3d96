//! Metrics of Zenoh. Without Zenoh they have no series.

use std::fmt;

use ros2probe_model::graph::zenoh::{Unseen, ZenohFacts};
use ros2probe_model::report::snapshot::Snapshot;

use ros2probe_metrics::catalogue::{self as metric, Metric};
use ros2probe_metrics::metric_sink::{Label, MetricSink};

/// Reads a value of Zenoh.
type Figure = fn(&ZenohFacts) -> u64;

/// Writes the metrics of Zenoh.
pub(super) fn zenoh(sink: &mut MetricSink<'_>, snapshot: &Snapshot) -> fmt::Result {
    const ZENOH_FIGURES: [(&Metric, Figure); 6] = [
        (&metric::ZENOH_CONNECTIONS, |zenoh| zenoh.connections),
        (&metric::ZENOH_ROUTERS, |zenoh| zenoh.routers),
        (&metric::ZENOH_BATCHES, |zenoh| zenoh.counters.batches),
        (&metric::ZENOH_GAPS, |zenoh| zenoh.counters.gaps),
        (&metric::ZENOH_FOREIGN, |zenoh| zenoh.counters.foreign),
        (&metric::ZENOH_INCOMPLETE, |zenoh| zenoh.counters.incomplete),
    ];
    let known = snapshot.zenoh.as_ref();
    for (metric, figure) in ZENOH_FIGURES {
        sink.family(metric, |family| {
            known.map_or(Ok(()), |zenoh| family.sample(&[], figure(zenoh)))
        })?;
    }
    sink.family(&metric::ZENOH_UNSEEN, |family| {
        let Some(zenoh) = known else { return Ok(()) };
        let mut unseen = Unseen::ALL.into_iter().zip(zenoh.unseen);
        unseen.try_for_each(|(reason, connections)| {
            family.sample(&[Label::Text(reason.label())], connections)
        })
    })
}
