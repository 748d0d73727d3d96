//! Metrics of calls inside processes.

use std::collections::BTreeMap;
use std::fmt;
use std::time::Duration;

use super::inside_nodes::NodeActivity;
use super::ros2_metrics::TopicRow;
use crate::agent_facts::InsideSourceFacts;
use crate::settings_cell::Settings;
use ros2probe_metrics::catalogue::{self as metric, Metric};
use ros2probe_metrics::metric_sink::{Label, MetricSink};
use ros2probe_model::facts::calls::facts::{Callback, InsideFacts, Owner, TopicInside};
use ros2probe_model::facts::calls::late::{Cause, Stage};
use ros2probe_model::facts::calls::report::{ThreadStates, Trigger};
use ros2probe_model::facts::histogram::Histogram;
use ros2probe_model::report::snapshot::Snapshot;
use ros2probe_wire::DomainId;

/// Maximum number of callbacks with series of their own.
const MAX_CALLBACKS: usize = 1024;

/// Reads a counter of a topic.
type Count = fn(&TopicInside) -> u64;
/// Reads a histogram of a callback.
type Values = fn(&CallbackSum) -> &Histogram;
/// Reads a gauge of a callback.
type Gauge = fn(&CallbackSum) -> Option<f64>;
/// Domain, node, trigger and name of callbacks that share their series.
type CallbackKey<'a> = (DomainId, &'a str, &'static str, String);

/// Callbacks with series of their own, and the number of other callbacks.
#[derive(Debug, Default)]
pub(super) struct Callbacks<'a> {
    sums: BTreeMap<CallbackKey<'a>, CallbackSum>,
    hidden: usize,
}

/// Figures of the callbacks with the same labels.
#[derive(Debug, Default)]
struct CallbackSum {
    duration: Histogram,
    wait: Histogram,
    p99: Option<Duration>,
    maximum: Option<Duration>,
    wait_p99: Option<Duration>,
    busy: Option<f64>,
    skipped: u64,
    states: ThreadStates,
}

impl<'a> Callbacks<'a> {
    /// Adds up the callbacks with the same labels.
    pub(super) fn new(known: Option<&'a InsideFacts>) -> Self {
        let mut all = Self::default();
        for callback in known.into_iter().flat_map(|known| &known.callbacks) {
            let key = key(callback);
            if all.sums.len() < MAX_CALLBACKS || all.sums.contains_key(&key) {
                all.sums.entry(key).or_default().add(callback);
            } else {
                all.hidden += 1;
            }
        }
        all
    }
}

/// Writes the metrics of topics from inside processes.
pub(super) fn topics(
    sink: &mut MetricSink<'_>,
    snapshot: &Snapshot,
    rows: &[TopicRow<'_>],
    settings: &Settings,
) -> fmt::Result {
    let is_on = snapshot.inside.is_some();
    sink.family(&metric::TOPIC_SOURCE, |family| {
        let measured = rows.iter().filter(|row| row.measurement().is_some());
        for row in measured.filter(|_| is_on) {
            let source = row.facts.map(|facts| facts.source).unwrap_or_default();
            let [domain_id, topic] = row.labels();
            family.info(&[domain_id, topic, Label::Text(source.label())])?;
        }
        Ok(())
    })?;
    let seen = || rows.iter().filter_map(|row| Some((row, inside(row)?)));
    let counters: [(&'static Metric, Count); 7] = [
        (&metric::INSIDE_PUBLISHED, |it| it.counts.published),
        (&metric::INSIDE_TAKEN, |it| it.counts.taken),
        (&metric::INSIDE_FAILED, |it| it.counts.failed),
        (&metric::INTRA_RECEIVED, |it| it.counts.receptions),
        (&metric::INTRA_ENQUEUED, |it| it.counts.enqueued),
        (&metric::INTRA_OVERWRITTEN, |it| it.counts.overwritten),
        (&metric::INTRA_DEQUEUED, |it| it.counts.dequeued),
    ];
    for (metric, count) in counters {
        sink.family(metric, |family| {
            seen().try_for_each(|(row, it)| family.sample(&row.labels(), count(it)))
        })?;
    }
    sink.family(&metric::INTRA_DEPTH, |family| {
        let mut buffered = seen().filter(|(_, it)| it.counts.enqueued > 0);
        buffered.try_for_each(|(row, it)| family.sample(&row.labels(), it.depth))
    })?;
    sink.family(&metric::INSIDE_LATENCY, |family| {
        for (row, it) in seen().filter(|(_, it)| settings.histograms && it.latency.count() > 0) {
            family.histogram(&row.labels(), &it.latency.histogram())?;
        }
        Ok(())
    })?;
    sink.family(&metric::INTRA_WAITING, |family| {
        for (row, it) in seen().filter(|(_, it)| settings.histograms && it.waiting.count() > 0) {
            family.histogram(&row.labels(), &it.waiting.histogram())?;
        }
        Ok(())
    })
}

/// Returns the observations of a topic from inside processes, if any.
fn inside<'a>(row: &TopicRow<'a>) -> Option<&'a TopicInside> {
    row.facts.and_then(|facts| facts.inside.as_deref())
}

/// Writes the metrics of callbacks and nodes.
pub(super) fn callbacks(
    sink: &mut MetricSink<'_>,
    callbacks: &Callbacks<'_>,
    snapshot: &Snapshot,
    settings: &Settings,
) -> fmt::Result {
    let known = snapshot.inside.as_deref();
    let sums = &callbacks.sums;
    let histograms: [(&'static Metric, Values); 2] = [
        (&metric::CALLBACK_DURATION, |sum| &sum.duration),
        (&metric::CALLBACK_WAIT, |sum| &sum.wait),
    ];
    for (metric, values) in histograms {
        sink.family(metric, |family| {
            for (key, sum) in sums.iter().filter(|_| settings.histograms) {
                if values(sum).count() > 0 {
                    family.histogram(&labels(key), values(sum))?;
                }
            }
            Ok(())
        })?;
    }
    let gauges: [(&'static Metric, Gauge); 4] = [
        (&metric::CALLBACK_P99, |sum| Some(sum.p99?.as_secs_f64())),
        (&metric::CALLBACK_MAX, |sum| {
            Some(sum.maximum?.as_secs_f64())
        }),
        (&metric::CALLBACK_WAIT_P99, |sum| {
            Some(sum.wait_p99?.as_secs_f64())
        }),
        (&metric::CALLBACK_BUSY, |sum| sum.busy),
    ];
    for (metric, value) in gauges {
        sink.family(metric, |family| {
            let mut known = sums
                .iter()
                .filter_map(|(key, sum)| Some((key, value(sum)?)));
            known.try_for_each(|(key, value)| family.sample(&labels(key), value))
        })?;
    }
    sink.family(&metric::CALLBACK_TIME, |family| {
        for (key, sum) in sums.iter().filter(|(_, sum)| sum.states.calls > 0) {
            let [domain_id, node, trigger, name] = labels(key);
            for (state, time) in ThreadStates::LABELS.iter().zip(sum.states.nanoseconds()) {
                let labels = [domain_id, node, trigger, name, Label::Text(state)];
                family.sample(&labels, Duration::from_nanos(time).as_secs_f64())?;
            }
        }
        Ok(())
    })?;
    sink.family(&metric::TIMER_SKIPPED, |family| {
        let mut timers = sums
            .iter()
            .filter(|((_, _, trigger, _), _)| *trigger == "timer");
        timers.try_for_each(|(key, sum)| family.sample(&labels(key), sum.skipped))
    })?;
    late(sink, known)?;
    nodes(sink, snapshot)
}

/// Writes the metrics of late calls. Callbacks with the same labels share their series.
fn late(sink: &mut MetricSink<'_>, known: Option<&InsideFacts>) -> fmt::Result {
    let mut times: BTreeMap<(CallbackKey<'_>, Stage, Cause), Duration> = BTreeMap::new();
    let mut calls: BTreeMap<(CallbackKey<'_>, Stage, Cause), u64> = BTreeMap::new();
    for callback in known.into_iter().flat_map(|known| &known.late) {
        let key = || key_of(&callback.owner, &callback.trigger);
        for ((stage, cause), sum) in &callback.sums {
            *times.entry((key(), *stage, *cause)).or_default() += *sum;
        }
        for ((stage, cause), count) in &callback.causes {
            *calls.entry((key(), *stage, *cause)).or_default() += count;
        }
    }
    sink.family(&metric::LATE_TIME, |family| {
        let mut times = times.iter();
        times.try_for_each(|(of, time)| family.sample(&late_labels(of), time.as_secs_f64()))
    })?;
    sink.family(&metric::LATE_CALLS, |family| {
        let mut calls = calls.iter();
        calls.try_for_each(|(of, count)| family.sample(&late_labels(of), *count))
    })
}

fn late_labels<'a>(of: &'a (CallbackKey<'_>, Stage, Cause)) -> [Label<'a>; 6] {
    let (key, stage, cause) = of;
    let [domain_id, node, trigger, name] = labels(key);
    let (stage, cause) = (Label::Text(stage.label()), Label::Text(cause.label()));
    [domain_id, node, trigger, name, stage, cause]
}

fn nodes(sink: &mut MetricSink<'_>, snapshot: &Snapshot) -> fmt::Result {
    let activities = NodeActivity::all(snapshot);
    sink.family(&metric::NODE_BUSY, |family| {
        for ((domain_id, name), activity) in &activities {
            if let Some(busy) = activity.busy {
                let labels = [Label::Number((*domain_id).into()), Label::Text(name)];
                family.sample(&labels, busy)?;
            }
        }
        Ok(())
    })?;
    sink.family(&metric::NODE_LIFECYCLE, |family| {
        for ((domain_id, name), activity) in &activities {
            if let Some(state) = activity.state {
                let labels = [
                    Label::Number((*domain_id).into()),
                    Label::Text(name),
                    Label::Text(state),
                ];
                family.sample(&labels, true)?;
            }
        }
        Ok(())
    })
}

/// Writes the state of the source of calls.
pub(super) fn source(
    sink: &mut MetricSink<'_>,
    source: Option<&InsideSourceFacts>,
    known: Option<&InsideFacts>,
    callbacks: &Callbacks<'_>,
) -> fmt::Result {
    sink.family(&metric::INSIDE_INFO, |family| match source {
        Some(source) => {
            let reason = source.reason_off.as_deref().unwrap_or_default();
            family.info(&[Label::Text(source.mode), Label::Text(reason)])
        }
        None => Ok(()),
    })?;
    sink.family(&metric::INSIDE_LIBRARY, |family| {
        let mut libraries = source.into_iter().flat_map(|source| &source.libraries);
        libraries.try_for_each(|library| {
            let (state, reason) = match &library.refused {
                None => ("attached", ""),
                Some(reason) => ("refused", reason.as_str()),
            };
            family.info(&[
                Label::Text(&library.path),
                Label::Text(state),
                Label::Text(reason),
            ])
        })
    })?;
    sink.family(&metric::INSIDE_EVENTS, |family| {
        let mut counters = source.into_iter().flat_map(|source| &source.counters);
        counters.try_for_each(|(event, count)| family.sample(&[Label::Text(event)], *count))
    })?;
    sink.family(&metric::INSIDE_PROCESSES, |family| {
        let Some(known) = known else {
            return Ok(());
        };
        let processes = known.processes.iter();
        let suspended = processes.filter(|each| each.is_suspended).count();
        let counted = known.processes.len() - suspended;
        family.sample(&[Label::Text("counted")], counted)?;
        family.sample(&[Label::Text("suspended")], suspended)
    })?;
    sink.single(&metric::CALLBACKS_NOT_SHOWN, callbacks.hidden)
}

fn key(callback: &Callback) -> CallbackKey<'_> {
    key_of(&callback.owner, &callback.trigger)
}

fn key_of<'a>(owner: &'a Owner, trigger: &Trigger) -> CallbackKey<'a> {
    let name = match trigger {
        Trigger::Timer(period) => period.map(|period| format!("{period:?}")),
        other => other.name().map(str::to_owned),
    };
    (
        owner.domain_id,
        owner.node.as_deref().unwrap_or_default(),
        trigger.label(),
        name.unwrap_or_default(),
    )
}

fn labels<'a>((domain_id, node, trigger, name): &'a CallbackKey<'_>) -> [Label<'a>; 4] {
    [
        Label::Number((*domain_id).into()),
        Label::Text(node),
        Label::Text(trigger),
        Label::Text(name),
    ]
}

impl CallbackSum {
    fn add(&mut self, callback: &Callback) {
        self.duration.merge(&callback.durations.histogram());
        self.wait.merge(&callback.waits.histogram());
        if callback.duration.count > 0 {
            self.p99 = self.p99.max(Some(callback.duration.p99));
            self.maximum = self.maximum.max(Some(callback.duration.maximum));
        }
        if callback.wait.count > 0 {
            self.wait_p99 = self.wait_p99.max(Some(callback.wait.p99));
        }
        if let Some(busy) = callback.busy {
            *self.busy.get_or_insert_default() += busy;
        }
        self.skipped += callback.skipped;
        self.states.add(callback.states);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ros2probe_model::facts::calls::facts::Quantiles;
    use ros2probe_model::facts::model_time::ModelTime;

    fn callback(number: usize) -> Callback {
        Callback {
            owner: Owner::default(),
            trigger: Trigger::Subscription(format!("/t{number}").into()),
            thread: 1,
            calls: 1,
            skipped: 0,
            rate_hz: None,
            busy: None,
            last: ModelTime::ZERO,
            duration: Quantiles::default(),
            wait: Quantiles::default(),
            durations: std::sync::Arc::default(),
            waits: std::sync::Arc::default(),
            states: ThreadStates::default(),
            recent_states: ThreadStates::default(),
        }
    }

    #[test]
    fn callbacks_beyond_the_cap_are_counted_as_not_shown() {
        let callbacks = (0..MAX_CALLBACKS + 3).chain([0]).map(callback).collect();
        let known = InsideFacts {
            callbacks,
            ..InsideFacts::default()
        };
        let shown = Callbacks::new(Some(&known));
        assert_eq!((shown.sums.len(), shown.hidden), (MAX_CALLBACKS, 3));
    }
}
