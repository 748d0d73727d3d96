//! Metrics of services and actions.

use std::fmt;

use crate::settings_cell::Settings;
use ros2probe_metrics::catalogue::{self as metric, Metric};
use ros2probe_metrics::metric_sink::{Label, MetricSink};
use ros2probe_model::report::snapshot::{ActionFacts, LatencyFacts, ServiceFacts, Snapshot};

/// Reads a number of a service.
type Count = fn(&ServiceFacts) -> u64;
/// Reads a quantile, in seconds.
type Quantile = fn(&LatencyFacts) -> Option<f64>;

/// Writes the metrics of services with calls, and of actions with goals.
pub(super) fn services(
    sink: &mut MetricSink<'_>,
    snapshot: &Snapshot,
    settings: &Settings,
) -> fmt::Result {
    let counts: [(&'static Metric, Count); 4] = [
        (&metric::SERVICE_REQUESTS, |service| service.requests),
        (&metric::SERVICE_ANSWERED, |service| service.answered),
        (&metric::SERVICE_UNANSWERED, |service| service.unanswered),
        (&metric::SERVICE_HANGING, |service| service.hanging as u64),
    ];
    for (metric, count) in counts {
        sink.family(metric, |family| {
            let mut services = snapshot.services.iter();
            services.try_for_each(|service| family.sample(&labels(service), count(service)))
        })?;
    }
    sink.family(&metric::SERVICE_LATENCY, |family| {
        let services = snapshot.services.iter().filter(|_| settings.histograms);
        let mut measured = services.filter(|service| service.answered > 0);
        measured
            .try_for_each(|service| family.histogram(&labels(service), &service.latency.histogram))
    })?;
    let quantiles: [(&'static Metric, Quantile); 2] = [
        (&metric::SERVICE_P50, |latency| latency.p50),
        (&metric::SERVICE_P99, |latency| latency.p99),
    ];
    for (metric, quantile) in quantiles {
        sink.family(metric, |family| {
            let services = snapshot.services.iter();
            let mut known = services.filter_map(|it| Some((it, quantile(&it.latency)?)));
            known.try_for_each(|(service, seconds)| family.sample(&labels(service), seconds))
        })?;
    }
    sink.family(&metric::SERVICE_SUSPENDED, |family| {
        let mut services = snapshot.services.iter();
        services
            .try_for_each(|service| family.sample(&labels(service), u64::from(service.suspended)))
    })?;
    actions(sink, &snapshot.actions)
}

fn actions(sink: &mut MetricSink<'_>, actions: &[ActionFacts]) -> fmt::Result {
    sink.family(&metric::ACTION_GOALS, |family| {
        for action in actions {
            let [domain_id, name] = action_labels(action);
            let goals = action.goals;
            let states = [
                ("accepted", goals.accepted),
                ("rejected", goals.rejected),
                ("succeeded", goals.succeeded),
                ("canceled", goals.canceled),
                ("aborted", goals.aborted),
            ];
            for (state, count) in states {
                family.sample(&[domain_id, name, Label::Text(state)], count)?;
            }
        }
        Ok(())
    })?;
    sink.family(&metric::ACTION_OPEN, |family| {
        let mut actions = actions.iter();
        actions.try_for_each(|action| family.sample(&action_labels(action), action.open))
    })?;
    let quantiles: [(&'static Metric, Quantile); 2] = [
        (&metric::ACTION_P50, |duration| duration.p50),
        (&metric::ACTION_P99, |duration| duration.p99),
    ];
    for (metric, quantile) in quantiles {
        sink.family(metric, |family| {
            let actions = actions.iter();
            let mut known = actions.filter_map(|it| Some((it, quantile(&it.duration)?)));
            known.try_for_each(|(action, seconds)| family.sample(&action_labels(action), seconds))
        })?;
    }
    Ok(())
}

fn labels(service: &ServiceFacts) -> [Label<'_>; 2] {
    [
        Label::Number(service.domain_id.into()),
        Label::Text(&service.name),
    ]
}

fn action_labels(action: &ActionFacts) -> [Label<'_>; 2] {
    [
        Label::Number(action.domain_id.into()),
        Label::Text(&action.name),
    ]
}
