//! Metrics of the robot: graph, topics, watchlist (`ros2_*`).

use std::borrow::Cow;
use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::fmt;
use std::sync::Arc;

use crate::config::Watch;
use crate::settings_cell::Settings;
use ros2probe_metrics::catalogue::{self as metric, Metric};
use ros2probe_metrics::metric_sink::{Family, Label, MetricSink, Number};
use ros2probe_metrics::series_name::series_name;
use ros2probe_model::derive::clocks::seconds;
use ros2probe_model::facts::histogram::Histogram;
use ros2probe_model::facts::names::TypeName;
use ros2probe_model::facts::topic_kind::TopicKind;
use ros2probe_model::report::snapshot::UnknownWriterFacts;
use ros2probe_model::report::snapshot::{
    EndpointFacts, Measurement, PeerClock, ProcessFacts, SampledFacts, Snapshot, TopicFacts,
    WatchFacts, WatchState,
};
use ros2probe_wire::{DomainId, GuidPrefix};

/// Maximum number of unknown writers with their own series.
const MAX_UNKNOWN_WRITERS: usize = 32;
/// Maximum number of types or policies in one label.
const MAX_JOINED: usize = 4;

/// Reads a counter.
type Count = fn(&Measurement) -> u64;
/// Reads a counter of a sampled topic.
type SampledCount = fn(&SampledFacts) -> u64;
/// Reads a histogram.
type Values = fn(&Measurement) -> &Histogram;

/// A topic with its own series.
pub(super) struct TopicRow<'a> {
    domain_id: u32,
    name: Cow<'a, str>,
    /// Facts about the topic; `None` if it is watched by name but not announced.
    pub(super) facts: Option<&'a TopicFacts>,
    watched: bool,
    /// Whether a watch requests series per delivery.
    pub(super) per_subscriber: bool,
}

/// The topics to show, sorted, and the number of omitted topics.
pub(super) struct TopicRows<'a> {
    pub(super) shown: Vec<TopicRow<'a>>,
    pub(super) hidden: usize,
}

impl<'a> TopicRows<'a> {
    /// Selects the topics to show, with measured topics first. Service and other internal topics
    /// are shown only if they are measured.
    pub(super) fn new(snapshot: &'a Snapshot, settings: &Settings) -> Self {
        let max_topics = settings.limits.topics;
        let mut rows: BTreeMap<(DomainId, Cow<'a, str>), TopicRow<'a>> = BTreeMap::new();
        let mut hidden = 0;
        let shown = |facts: &&TopicFacts| {
            facts.measurement.is_some() || matches!(facts.kind, TopicKind::Topic | TopicKind::Dds)
        };
        let (measured, others): (Vec<&TopicFacts>, Vec<&TopicFacts>) = snapshot
            .topics
            .iter()
            .filter(shown)
            .partition(|facts| facts.measurement.is_some());
        for facts in measured.into_iter().chain(others) {
            let name = series_name(facts.kind, &facts.name, &facts.dds_name);
            let domain_id = facts.domain_id;
            let key = (domain_id, name.clone());
            if rows.contains_key(&key) || rows.len() >= max_topics {
                hidden += 1;
            } else {
                rows.insert(
                    key,
                    TopicRow {
                        domain_id: domain_id.0,
                        name,
                        facts: Some(facts),
                        watched: false,
                        per_subscriber: false,
                    },
                );
            }
        }
        let watched = snapshot.watches.iter().enumerate();
        let watched = watched.flat_map(|(place, watch)| {
            let configured = configured(place, watch, &settings.watches);
            let per_subscriber = configured.is_some_and(|watch| watch.per_subscriber);
            watch
                .topics
                .iter()
                .map(move |topic| (topic, per_subscriber))
        });
        for (topic, per_subscriber) in watched {
            let (domain_id, name) = (topic.domain_id, Cow::Borrowed(topic.topic.as_str()));
            let key = (domain_id, name.clone());
            if let Some(row) = rows.get_mut(&key) {
                row.watched = true;
                row.per_subscriber |= per_subscriber;
            } else if rows.len() < max_topics {
                rows.insert(
                    key,
                    TopicRow {
                        domain_id: domain_id.0,
                        name,
                        facts: None,
                        watched: true,
                        per_subscriber: false,
                    },
                );
            }
        }
        Self {
            shown: rows.into_values().collect(),
            hidden,
        }
    }
}

impl<'a> TopicRow<'a> {
    pub(super) fn labels(&self) -> [Label<'_>; 2] {
        [
            Label::Number(self.domain_id.into()),
            Label::Text(&self.name),
        ]
    }

    pub(super) fn measurement(&self) -> Option<&'a Measurement> {
        self.facts.and_then(|facts| facts.measurement.as_deref())
    }
}

/// Writes the metrics of the graph.
pub(super) fn graph(sink: &mut MetricSink<'_>, snapshot: &Snapshot) -> fmt::Result {
    let mut domains: BTreeMap<DomainId, (usize, usize, usize)> = BTreeMap::new();
    for participant in &snapshot.participants {
        let counts = domains.entry(participant.domain_id).or_default();
        counts.0 += 1;
        counts.1 += usize::from(participant.secured);
    }
    for node in &snapshot.nodes {
        domains.entry(node.domain_id).or_default().2 += 1;
    }
    if domains.is_empty() {
        domains.insert(DomainId(0), (0, 0, 0));
    }
    sink.family(&metric::PARTICIPANTS, |family| {
        per_domain(family, &domains, |counts| counts.0)
    })?;
    sink.family(&metric::SECURED_PARTICIPANTS, |family| {
        per_domain(family, &domains, |counts| counts.1)
    })?;
    sink.family(&metric::NODES, |family| {
        per_domain(family, &domains, |counts| counts.2)
    })?;
    sink.family(&metric::NODE_INFO, |family| nodes(family, snapshot))?;
    sink.family(&metric::PARTICIPANT_INFO, |family| {
        snapshot.participants.iter().try_for_each(|participant| {
            let [host, process, pid, cgroup] = place(&participant.process);
            family.info(&[
                Label::Number(participant.domain_id.into()),
                Label::Guid(participant.guid),
                Label::Vendor(participant.vendor),
                host,
                process,
                pid,
                cgroup,
            ])
        })
    })?;
    sink.family(&metric::TOPICS, |family| {
        let mut kinds: BTreeMap<(DomainId, TopicKind), usize> = BTreeMap::new();
        for topic in snapshot.topics.iter().filter(|topic| !topic.vanished) {
            *kinds.entry((topic.domain_id, topic.kind)).or_default() += 1;
        }
        kinds.iter().try_for_each(|((domain_id, kind), count)| {
            family.sample(
                &[
                    Label::Number((*domain_id).into()),
                    Label::Text(kind.label()),
                ],
                *count,
            )
        })
    })?;
    sink.family(&metric::DISCOVERY_EVENTS, |family| {
        snapshot.churn.iter().try_for_each(|churn| {
            let labels = [
                Label::Number(churn.domain_id.into()),
                Label::Text(churn.entity),
                Label::Text(churn.event),
            ];
            family.sample(&labels, churn.count)
        })
    })?;
    unknown_writers(sink, snapshot)
}

/// Writes the metrics of writers whose announcement was missed.
fn unknown_writers(sink: &mut MetricSink<'_>, snapshot: &Snapshot) -> fmt::Result {
    sink.single(&metric::UNKNOWN_WRITERS, snapshot.unknown_writers.len())?;
    let unknown = || snapshot.unknown_writers.iter().take(MAX_UNKNOWN_WRITERS);
    sink.family(&metric::UNKNOWN_WRITER_MESSAGES, |family| {
        unknown().try_for_each(|writer| {
            let labels = [Label::Guid(writer.guid), unknown_vendor(writer)];
            family.sample(&labels, writer.measurement.messages)
        })
    })?;
    sink.family(&metric::UNKNOWN_WRITER_RATE, |family| {
        unknown().try_for_each(|writer| {
            let labels = [Label::Guid(writer.guid), unknown_vendor(writer)];
            family.sample(&labels, writer.measurement.rate_hz)
        })
    })?;
    sink.family(&metric::UNKNOWN_WRITER_INFO, |family| {
        unknown().try_for_each(|writer| {
            let [host, process, pid, cgroup] = place(&writer.process);
            let (guid, vendor) = (Label::Guid(writer.guid), unknown_vendor(writer));
            family.info(&[guid, vendor, host, process, pid, cgroup])
        })
    })
}

/// Returns the labels host, process, process id and control group. Unknown labels are empty.
fn place(process: &ProcessFacts) -> [Label<'_>; 4] {
    [
        Label::Text(process.host.as_deref().unwrap_or_default()),
        Label::Text(process.name.as_deref().unwrap_or_default()),
        process
            .id
            .map_or(Label::Text(""), |id| Label::Number(id.into())),
        Label::Text(process.cgroup.as_deref().unwrap_or_default()),
    ]
}

fn per_domain(
    family: &mut Family<'_>,
    domains: &BTreeMap<DomainId, (usize, usize, usize)>,
    count: fn(&(usize, usize, usize)) -> usize,
) -> fmt::Result {
    domains.iter().try_for_each(|(domain_id, counts)| {
        family.sample(&[Label::Number((*domain_id).into())], count(counts))
    })
}

fn nodes(family: &mut Family<'_>, snapshot: &Snapshot) -> fmt::Result {
    let participants: BTreeMap<_, _> = snapshot
        .participants
        .iter()
        .map(|participant| (participant.guid, participant))
        .collect();
    let mut seen = BTreeSet::new();
    for node in &snapshot.nodes {
        // Two nodes of a participant with the same name are a fault, but have only one series.
        if !seen.insert((node.participant, node.name.as_str())) {
            continue;
        }
        let participant = participants.get(&node.participant);
        let vendor = participant.map(|participant| participant.vendor);
        let host = participant.and_then(|participant| participant.process.host.as_deref());
        family.info(&[
            Label::Number(node.domain_id.into()),
            Label::Text(&node.name),
            Label::Guid(node.participant),
            vendor.map_or(Label::Text(""), Label::Vendor),
            Label::Text(host.unwrap_or_default()),
        ])?;
    }
    Ok(())
}

/// Writes the metrics of topics.
pub(super) fn topics(
    sink: &mut MetricSink<'_>,
    snapshot: &Snapshot,
    rows: &[TopicRow<'_>],
    settings: &Settings,
) -> fmt::Result {
    sink.family(&metric::TOPIC_INFO, |family| {
        rows.iter().try_for_each(|row| topic_info(family, row))
    })?;
    sink.family(&metric::TOPIC_PUBLISHERS, |family| {
        rows.iter().try_for_each(|row| {
            family.sample(
                &row.labels(),
                row.facts.map_or(0, |facts| facts.publishers.len()),
            )
        })
    })?;
    sink.family(&metric::TOPIC_SUBSCRIPTIONS, |family| {
        rows.iter().try_for_each(|row| {
            family.sample(
                &row.labels(),
                row.facts.map_or(0, |facts| facts.subscriptions.len()),
            )
        })
    })?;
    let counters: [(&Metric, Count); 8] = [
        (&metric::TOPIC_MESSAGES, |measured| measured.messages),
        (&metric::TOPIC_BYTES, |measured| measured.bytes),
        (&metric::TOPIC_LOST, |measured| measured.lost),
        (&metric::TOPIC_SUBSCRIBER_EXPECTED, |measured| {
            measured.loss.expected
        }),
        (&metric::TOPIC_SUBSCRIBER_LOST, |measured| {
            measured.loss.lost
        }),
        (&metric::TOPIC_RECOVERED, |measured| measured.recovered),
        (&metric::TOPIC_DUPLICATES, |measured| measured.duplicates),
        (&metric::TOPIC_INCOMPLETE, |measured| measured.incomplete),
    ];
    for (metric, value) in counters {
        let is_size = *metric == metric::TOPIC_BYTES;
        sink.family(metric, |family| {
            measured(family, rows, |facts| {
                let is_known = !is_size || has_size(facts);
                is_known.then(|| value(facts).into())
            })
        })?;
    }
    sink.family(&metric::TOPIC_LAST_MESSAGE, |family| {
        rows.iter().try_for_each(|row| {
            match row.measurement().and_then(|measured| measured.last_message) {
                Some(at) => family.sample(&row.labels(), snapshot.wall_time(at).seconds()),
                None => Ok(()),
            }
        })
    })?;
    sink.family(&metric::TOPIC_RATE, |family| {
        per_second(family, rows, TopicFacts::rate_hz)
    })?;
    sink.family(&metric::TOPIC_BANDWIDTH, |family| {
        per_second(family, rows, TopicFacts::bandwidth)
    })?;
    let clocks = snapshot.peer_clocks();
    sink.family(&metric::TOPIC_LATENCY_UNCERTAINTY, |family| {
        rows.iter().try_for_each(|row| {
            let uncertainty = row.facts.and_then(|it| latency_uncertainty(it, &clocks));
            uncertainty.map_or(Ok(()), |value| family.sample(&row.labels(), value))
        })
    })?;
    let doubts: [(&Metric, Count); 3] = [
        (&metric::TOPIC_NEGATIVE_LATENCY, |measured| {
            measured.negative_latency
        }),
        (&metric::TOPIC_IMPLAUSIBLE_LATENCY, |measured| {
            measured.implausible_latency
        }),
        (&metric::TOPIC_DOUBTED_JUMPS, |measured| {
            measured.sequence_jumps
        }),
    ];
    for (metric, value) in doubts {
        sink.family(metric, |family| {
            measured(family, rows, |facts| Some(value(facts).into()))
        })?;
    }
    sampled(sink, rows)?;
    histograms(sink, rows, settings)
}

/// Returns the greatest error of latencies of a measured topic's publishers on other hosts, in
/// seconds.
fn latency_uncertainty(
    facts: &TopicFacts,
    clocks: &HashMap<GuidPrefix, &PeerClock>,
) -> Option<f64> {
    facts.measurement.as_ref()?;
    let publishers = facts.publishers.iter();
    let clocks = publishers.filter_map(|publisher| clocks.get(&publisher.guid.prefix));
    let errors = clocks.map(|clock| clock.correction().map_or(f64::INFINITY, |it| seconds(it.1)));
    errors.max_by(f64::total_cmp)
}

/// Returns whether the size of the messages is known: calls inside processes do not show it.
const fn has_size(measured: &Measurement) -> bool {
    measured.bytes > 0 || measured.messages == 0
}

/// Writes the histograms of intervals and latencies.
fn histograms(
    sink: &mut MetricSink<'_>,
    rows: &[TopicRow<'_>],
    settings: &Settings,
) -> fmt::Result {
    let histograms: [(&Metric, Values); 3] = [
        (&metric::TOPIC_INTERARRIVAL, |measured| {
            &measured.interarrival
        }),
        (&metric::TOPIC_LATENCY, |measured| &measured.source_latency),
        (&metric::TOPIC_HEADER_LATENCY, |measured| {
            &measured.header_latency
        }),
    ];
    for (metric, values) in histograms {
        sink.family(metric, |family| {
            let measured = rows
                .iter()
                .filter_map(|row| Some((row, row.measurement()?)));
            for (row, measured) in measured.filter(|_| settings.histograms) {
                let values = values(measured);
                if values.count() > 0 {
                    family.histogram(&row.labels(), values)?;
                }
            }
            Ok(())
        })?;
    }
    Ok(())
}

/// Writes the metrics of sampled topics and of transports.
fn sampled(sink: &mut MetricSink<'_>, rows: &[TopicRow<'_>]) -> fmt::Result {
    let counters: [(&Metric, SampledCount); 3] = [
        (&metric::TOPIC_SAMPLED, |sampled| sampled.span),
        (&metric::TOPIC_SAMPLED_SEEN, |sampled| sampled.seen),
        (&metric::TOPIC_SAMPLED_UNCERTAIN, |sampled| {
            sampled.uncertain
        }),
    ];
    let of_rows = || {
        let sampled =
            |row: &'_ TopicRow<'_>| row.measurement().and_then(|measured| measured.sampled);
        rows.iter()
            .filter_map(move |row| Some((row, sampled(row)?)))
    };
    for (metric, value) in counters {
        sink.family(metric, |family| {
            of_rows().try_for_each(|(row, sampled)| family.sample(&row.labels(), value(&sampled)))
        })?;
    }
    sink.family(&metric::TOPIC_COVERAGE, |family| {
        let with_any = of_rows().filter_map(|(row, sampled)| Some((row, sampled.coverage()?)));
        let mut with_any = with_any;
        with_any.try_for_each(|(row, coverage)| family.sample(&row.labels(), coverage))
    })?;
    sink.family(&metric::TOPIC_PAIRS, |family| {
        for row in rows {
            for count in row.facts.iter().flat_map(|facts| &facts.transports) {
                let [domain_id, topic] = row.labels();
                let passage = Label::Text(count.transport.label());
                family.sample(&[domain_id, topic, passage], count.pairs)?;
            }
        }
        Ok(())
    })
}

/// Writes the metrics of writers if `settings` request them.
pub(super) fn writers(
    sink: &mut MetricSink<'_>,
    rows: &[TopicRow<'_>],
    settings: &Settings,
) -> fmt::Result {
    let per_writer: [(&Metric, Count); 3] = [
        (&metric::WRITER_MESSAGES, |measured| measured.messages),
        (&metric::WRITER_BYTES, |measured| measured.bytes),
        (&metric::WRITER_LOST, |measured| measured.lost),
    ];
    for (metric, value) in per_writer {
        sink.family(metric, |family| {
            rows.iter()
                .filter(|_| settings.per_writer)
                .try_for_each(|row| for_each_writer(family, row, value))
        })?;
    }
    Ok(())
}

/// Writes a sample for each topic that is measured or watched; a watched topic begins with 0.
fn measured(
    family: &mut Family<'_>,
    rows: &[TopicRow<'_>],
    value: impl Fn(&Measurement) -> Option<Number>,
) -> fmt::Result {
    let nothing = Measurement::default();
    for row in rows {
        let facts = row
            .measurement()
            .or_else(|| row.watched.then_some(&nothing));
        if let Some(value) = facts.and_then(&value) {
            family.sample(&row.labels(), value)?;
        }
    }
    Ok(())
}

/// Writes the value per second of each measured topic if it is known. The value of a watched topic
/// without a measurement is 0.
fn per_second(
    family: &mut Family<'_>,
    rows: &[TopicRow<'_>],
    value: impl Fn(&TopicFacts) -> Option<f64>,
) -> fmt::Result {
    for row in rows {
        let value = match (row.facts, row.measurement()) {
            (Some(facts), Some(_)) => value(facts),
            _ => row.watched.then_some(0.0),
        };
        if let Some(value) = value {
            family.sample(&row.labels(), value)?;
        }
    }
    Ok(())
}

fn topic_info(family: &mut Family<'_>, row: &TopicRow<'_>) -> fmt::Result {
    let Some(facts) = row.facts else {
        return Ok(());
    };
    let [domain_id, topic] = row.labels();
    // Subscriptions describe the topic only if it has no publisher.
    let endpoints = if facts.publishers.is_empty() {
        &facts.subscriptions
    } else {
        &facts.publishers
    };
    let policies =
        |policy: fn(&EndpointFacts) -> &'static str| join_values(endpoints.iter().map(policy));
    let message_types = join_values(facts.message_types.iter().map(TypeName::as_str));
    let reliability = policies(|endpoint| endpoint.qos.reliability.label());
    let durability = policies(|endpoint| endpoint.qos.durability.label());
    family.info(&[
        domain_id,
        topic,
        Label::Text(facts.kind.label()),
        Label::Text(&message_types),
        Label::Text(&reliability),
        Label::Text(&durability),
    ])
}

/// Joins the different values, sorted, up to [`MAX_JOINED`].
fn join_values<'a>(values: impl Iterator<Item = &'a str>) -> String {
    let different: BTreeSet<&str> = values.collect();
    let mut text = String::new();
    for value in different.iter().take(MAX_JOINED) {
        if !text.is_empty() {
            text.push(',');
        }
        text.push_str(value);
    }
    if different.len() > MAX_JOINED {
        text.push_str(",...");
    }
    text
}

fn for_each_writer(family: &mut Family<'_>, row: &TopicRow<'_>, value: Count) -> fmt::Result {
    let mut seen = BTreeSet::new();
    for writer in row.facts.iter().flat_map(|facts| &facts.publishers) {
        let Some(measured) = &writer.measurement else {
            continue;
        };
        if !seen.insert(writer.guid) {
            continue;
        }
        let [domain_id, topic] = row.labels();
        let node = writer.node.as_deref().unwrap_or_default();
        let labels = [
            domain_id,
            topic,
            Label::Guid(writer.guid),
            Label::Text(node),
        ];
        family.sample(&labels, value(measured))?;
    }
    Ok(())
}

/// Writes the states and violated expectations of the watchlist.
pub(super) fn watches(
    sink: &mut MetricSink<'_>,
    snapshot: &Snapshot,
    configured: &[Arc<Watch>],
) -> fmt::Result {
    sink.family(&metric::WATCH_STATE, |family| {
        for watch in &snapshot.watches {
            let name = watch_name(watch);
            for topic in &watch.topics {
                for state in WatchState::ALL {
                    let labels = [
                        Label::Number(topic.domain_id.into()),
                        Label::Text(&topic.topic),
                        Label::Text(&name),
                        Label::Text(state.label()),
                    ];
                    family.sample(&labels, topic.state == state)?;
                }
            }
        }
        Ok(())
    })?;
    sink.family(&metric::WATCH_VIOLATED, |family| {
        for (place, watch) in snapshot.watches.iter().enumerate() {
            let Some(configured) = self::configured(place, watch, configured) else {
                continue;
            };
            let expectations = configured.expectations.keys();
            let name = watch_name(watch);
            for topic in &watch.topics {
                for (expectation, _) in expectations.iter().filter(|(_, set)| *set) {
                    let labels = [
                        Label::Number(topic.domain_id.into()),
                        Label::Text(&topic.topic),
                        Label::Text(&name),
                        Label::Text(expectation),
                    ];
                    family.sample(&labels, topic.violations.contains(expectation))?;
                }
            }
        }
        Ok(())
    })
}

/// Returns the configured entry of `watch`, which usually has the same index, unless the list has
/// just changed. Returns `None` if the entry was removed.
fn configured<'c>(
    place: usize,
    watch: &WatchFacts,
    configured: &'c [Arc<Watch>],
) -> Option<&'c Watch> {
    let same = |other: &&Watch| {
        (&other.pattern, other.domain_id) == (&watch.watch.pattern, watch.watch.domain_id)
    };
    let there = configured.get(place).map(|watch| &**watch).filter(same);
    there.or_else(|| configured.iter().map(|watch| &**watch).find(same))
}

/// Returns the vendor of a writer, or an empty label if it is unknown.
fn unknown_vendor(writer: &UnknownWriterFacts) -> Label<'static> {
    writer.vendor.map_or(Label::Text(""), Label::Vendor)
}

/// Returns the label of a watch: `/points`, or `/points@5` for a single domain. ROS names contain
/// no `@`.
fn watch_name(facts: &WatchFacts) -> Cow<'_, str> {
    let watch = &facts.watch;
    match watch.domain_id {
        None => Cow::Borrowed(&watch.pattern),
        Some(domain_id) => Cow::Owned(format!("{}@{domain_id}", watch.pattern)),
    }
}
