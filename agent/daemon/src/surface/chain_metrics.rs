//! Metrics of chains.

use std::collections::BTreeSet;
use std::fmt;

use ros2probe_model::derive::chain::exemplar::Exemplars;
use ros2probe_model::derive::chain::expected::{ChainState, ExpectedFacts};
use ros2probe_model::derive::chain::path::Quantiles;
use ros2probe_model::facts::histogram::Histogram;
use ros2probe_model::report::snapshot::{ChainFacts, Snapshot};

use crate::settings_cell::Settings;
use ros2probe_metrics::catalogue::{self as metric, Metric};
use ros2probe_metrics::metric_sink::{Label, MetricSink};

/// The figures of a series.
struct Figures<'a, const LABELS: usize> {
    labels: [Label<'a>; LABELS],
    histogram: &'a Histogram,
    exemplars: &'a Exemplars,
    latest: Quantiles,
}

/// Writes the metrics of chains, with exemplars if traces are exported.
pub(super) fn chains(
    sink: &mut MetricSink<'_>,
    snapshot: &Snapshot,
    settings: &Settings,
    has_traces: bool,
) -> fmt::Result {
    let chains = busiest_per_ends(&snapshot.chains.chains);
    let whole = chain_figures(snapshot, &chains);
    let of_chains = [
        &metric::CHAIN_LATENCY,
        &metric::CHAIN_P50,
        &metric::CHAIN_P99,
    ];
    let show = (settings.histograms, has_traces);
    write(sink, of_chains, &whole, show)?;
    let hops: Vec<_> = chains.iter().flat_map(|chain| hops(chain)).collect();
    let of_hops = [&metric::HOP_LATENCY, &metric::HOP_P50, &metric::HOP_P99];
    write(sink, of_hops, &hops, show)?;
    sink.family(&metric::CHAIN_STATE, |family| {
        let mut seen = BTreeSet::new();
        for facts in &snapshot.chains.expected {
            let Some(domain_id) = facts.domain_id else {
                continue;
            };
            // A chain has one state. Causality takes precedence over stamps.
            let ends = (domain_id, &*facts.chain.from, &*facts.chain.to);
            if !seen.insert(ends) {
                continue;
            }
            for state in ChainState::ALL {
                let labels = [
                    Label::Number(domain_id.into()),
                    Label::Text(&facts.chain.from),
                    Label::Text(&facts.chain.to),
                    Label::Text(state.label()),
                ];
                family.sample(&labels, u64::from(state == facts.state))?;
            }
        }
        Ok(())
    })
}

fn write<const LABELS: usize>(
    sink: &mut MetricSink<'_>,
    [histogram, p50, p99]: [&'static Metric; 3],
    all: &[Figures<'_, LABELS>],
    (has_histograms, has_traces): (bool, bool),
) -> fmt::Result {
    sink.family(histogram, |family| {
        let mut wanted = all.iter().filter(|_| has_histograms);
        wanted.try_for_each(|each| {
            let exemplars = Some(each.exemplars).filter(|_| has_traces);
            family.traced_histogram(&each.labels, each.histogram, exemplars)
        })
    })?;
    sink.family(p50, |family| {
        let mut all = all.iter();
        all.try_for_each(|each| family.sample(&each.labels, each.latest.p50))
    })?;
    sink.family(p99, |family| {
        let mut all = all.iter();
        all.try_for_each(|each| family.sample(&each.labels, each.latest.p99))
    })
}

/// Returns one chain for each pair of ends: the chain with the most messages.
fn busiest_per_ends(chains: &[ChainFacts]) -> Vec<&ChainFacts> {
    let mut sorted: Vec<_> = chains.iter().collect();
    sorted.sort_by_key(|chain| (ends(chain), std::cmp::Reverse(chain.count)));
    sorted.dedup_by_key(|chain| ends(chain));
    sorted
}

fn ends(chain: &ChainFacts) -> impl Ord + '_ {
    let path = &chain.path;
    let name = |end: Option<&'_ (ros2probe_model::facts::names::TopicName, _)>| {
        end.map(|(topic, _)| topic.clone())
    };
    let (first, last) = (path.topics.first(), path.topics.last());
    (path.domain_id, path.method, name(first), name(last))
}

/// Returns the figures of configured chains and of all other chains.
fn chain_figures<'a>(snapshot: &'a Snapshot, chains: &[&'a ChainFacts]) -> Vec<Figures<'a, 4>> {
    let configured = snapshot.chains.expected.iter().filter_map(of_expected);
    let mut all: Vec<_> = configured.collect();
    let is_configured = |chain: &ChainFacts| {
        let section = |each: &ExpectedFacts| {
            let path = &chain.path;
            let is_meant =
                each.domain_id == Some(path.domain_id) && each.method == Some(path.method);
            is_meant
                && path.section(&each.chain.from, &each.chain.to)
                    == Some((0, path.topics.len() - 1))
        };
        snapshot.chains.expected.iter().any(section)
    };
    let others = chains.iter().filter(|chain| !is_configured(chain));
    all.extend(others.filter_map(|chain| {
        Some(Figures {
            labels: labels(chain)?,
            histogram: &chain.whole,
            exemplars: &chain.exemplars,
            latest: chain.between(0, chain.path.topics.len().checked_sub(1)?),
        })
    }));
    all
}

fn of_expected(facts: &ExpectedFacts) -> Option<Figures<'_, 4>> {
    Some(Figures {
        labels: [
            Label::Number(facts.domain_id?.into()),
            Label::Text(&facts.chain.from),
            Label::Text(&facts.chain.to),
            Label::Text(facts.method?.label()),
        ],
        histogram: &facts.histogram,
        exemplars: &facts.exemplars,
        latest: facts.latency?,
    })
}

fn labels(chain: &ChainFacts) -> Option<[Label<'_>; 4]> {
    let path = &chain.path;
    Some([
        Label::Number(path.domain_id.into()),
        Label::Text(&path.topics.first()?.0),
        Label::Text(&path.topics.last()?.0),
        Label::Text(path.method.label()),
    ])
}

fn hops(chain: &ChainFacts) -> impl Iterator<Item = Figures<'_, 6>> {
    let outputs = chain.path.topics.iter().skip(1);
    let outputs = outputs.zip(&chain.hops).enumerate();
    outputs.filter_map(|(position, ((topic, node), histograms))| {
        let [domain_id, from, to, method] = labels(chain)?;
        let node = node.as_deref().unwrap_or_default();
        Some(Figures {
            labels: [
                domain_id,
                from,
                to,
                method,
                Label::Text(topic),
                Label::Text(node),
            ],
            histogram: &histograms.whole,
            exemplars: &histograms.exemplars,
            latest: chain.hop(position).whole,
        })
    })
}
