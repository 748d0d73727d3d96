//! Metrics of problems in the graph.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::fmt;

use ros2probe_metrics::catalogue::{self as metric, Metric};
use ros2probe_metrics::metric_sink::{Label, MetricSink};
use ros2probe_metrics::series_name::series_name;
use ros2probe_model::facts::diagnosis::{Diagnosis, TopicKey};
use ros2probe_model::report::snapshot::Snapshot;
use ros2probe_wire::DomainId;

/// Returns the number that one finding adds to a family.
type Count = fn(&Diagnosis) -> usize;
/// Counts by topic.
type PerTopic<'a> = BTreeMap<(DomainId, Cow<'a, str>), usize>;

/// Writes the number of findings per kind, and further families for some kinds.
pub(super) fn diagnoses(sink: &mut MetricSink<'_>, snapshot: &Snapshot) -> fmt::Result {
    let found = &*snapshot.diagnoses;
    sink.family(&metric::DIAGNOSES, |family| {
        Diagnosis::KINDS.iter().try_for_each(|kind| {
            let own = found.list.iter().filter(|each| each.kind() == *kind);
            family.sample(&[Label::Text(kind)], own.count())
        })
    })?;
    sink.family(&metric::QOS_INCOMPATIBLE_PAIRS, |family| {
        let mut pairs = BTreeMap::new();
        for each in &found.qos_pairs {
            let (domain_id, topic) = series(&each.topic);
            *pairs.entry((domain_id, topic, each.policy)).or_default() += each.pairs;
        }
        let mut pairs: std::collections::btree_map::Iter<'_, _, u64> = pairs.iter();
        pairs.try_for_each(|((domain_id, topic, policy), count)| {
            let labels = [
                Label::Number((*domain_id).into()),
                Label::Text(topic),
                Label::Text(policy.label()),
            ];
            family.sample(&labels, *count)
        })
    })?;
    per_topic(sink, &found.list)?;
    sink.family(&metric::DUPLICATE_NODES, |family| {
        found.list.iter().try_for_each(|each| match each {
            Diagnosis::DuplicateNode {
                domain_id,
                node,
                participants,
            } => {
                let labels = [Label::Number((*domain_id).into()), Label::Text(node)];
                family.sample(&labels, participants.len())
            }
            _ => Ok(()),
        })
    })?;
    sink.family(&metric::NODE_DOMAINS, |family| {
        found.list.iter().try_for_each(|each| match each {
            Diagnosis::NodeInSeveralDomains {
                node,
                participant,
                domains,
            } => {
                let labels = [Label::Text(node), Label::Guid(*participant)];
                family.sample(&labels, domains.len())
            }
            _ => Ok(()),
        })
    })
}

/// Writes the counts per topic.
fn per_topic(sink: &mut MetricSink<'_>, list: &[Diagnosis]) -> fmt::Result {
    let metrics: [(&'static Metric, Count); 4] = [
        (&metric::TOPIC_CONFLICTING_TYPES, |each| match each {
            Diagnosis::TypeConflict { types, .. } => types.len(),
            _ => 0,
        }),
        (&metric::TOPIC_CONFLICTING_TYPE_HASHES, |each| match each {
            Diagnosis::TypeHashConflict { hashes, .. } => hashes.len(),
            _ => 0,
        }),
        (&metric::UNHEARD_PUBLISHERS, |each| {
            usize::from(matches!(each, Diagnosis::UnmatchedPublisher { .. }))
        }),
        (&metric::UNFED_SUBSCRIPTIONS, |each| {
            usize::from(matches!(each, Diagnosis::UnmatchedSubscription { .. }))
        }),
    ];
    for (metric, count) in metrics {
        let mut counts = PerTopic::new();
        for each in list {
            if let (Some(topic), count @ 1..) = (each.topic(), count(each)) {
                *counts.entry(series(topic)).or_default() += count;
            }
        }
        sink.family(metric, |family| {
            counts.iter().try_for_each(|((domain_id, topic), count)| {
                let labels = [Label::Number((*domain_id).into()), Label::Text(topic)];
                family.sample(&labels, *count)
            })
        })?;
    }
    Ok(())
}

fn series(topic: &TopicKey) -> (DomainId, Cow<'_, str>) {
    let name = series_name(topic.kind, &topic.name, &topic.dds_name);
    (topic.domain_id, name)
}
