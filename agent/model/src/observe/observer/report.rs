//! Creates a [`Snapshot`] from the core's state: sorted copies of values that are already settled.

mod deliveries;

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use foldhash::{HashMap, HashMapExt as _};
use ros2probe_wire::rtps::VendorId;
use ros2probe_wire::{DomainId, EntityId, Guid, Timestamp};

use super::Observer;
use crate::derive::robot::Part;
use crate::facts::measurement::Measurement;
use crate::facts::model_time::ModelTime;
use crate::facts::names::{DdsName, NodeName};
use crate::facts::watch::WatchState;
use crate::graph::discovery::{Discovery, ParticipantProxy};
use crate::graph::sockets::SocketFacts;
use crate::measure::receivers::Graph;
use crate::measure::topic::{Topic, Watched};
use crate::report::snapshot::{
    DecodeErrorCount, EndpointFacts, NodeFacts, ParticipantFacts, ProcessFacts, Snapshot,
    TableFacts, TopicFacts, UnknownWriterFacts, WatchFacts, WatchedTopicFacts,
};
use crate::report::transport::transports;

pub(super) fn snapshot(observer: &Observer, wall_time: Timestamp) -> Snapshot {
    let now = observer.graph.wall_clock.model_time(wall_time);
    let nodes = nodes_of_endpoints(&observer.graph);
    Snapshot {
        at: now,
        wall_clock: observer.graph.wall_clock,
        participants: participants(observer),
        nodes: node_facts(&observer.graph.discovery),
        topics: observer
            .graph
            .topics
            .iter()
            .map(|(_, topic)| self::topic(observer, topic, &nodes, now))
            .collect(),
        unknown_writers: unknown_writers(observer, now),
        sockets: deliveries::sockets(observer),
        watches: watches(observer),
        services: observer.derive.services.facts(),
        actions: observer.derive.services.action_facts(),
        inside: observer.derive.inside.facts().map(Arc::new),
        zenoh: observer.zenoh.is_used().then(|| observer.zenoh.facts()),
        chains: observer.derive.chains.facts(wall_time),
        links: observer.measure.links.facts(),
        tls_connections: observer.measure.tls.counted(),
        diagnostics: (observer.derive.robot.diagnostics())
            .facts(observer.settings.robot.has(Part::Diagnostics)),
        transforms: (observer.derive.robot.transforms()).facts(
            observer.settings.robot.has(Part::Transforms),
            observer.clock,
        ),
        lifecycle: (observer.derive.robot.lifecycle())
            .facts(observer.settings.robot.has(Part::Lifecycle)),
        fields: observer
            .derive
            .robot
            .field_messages(&observer.graph.discovery),
        parameters: (observer.derive.robot.parameters())
            .facts(observer.settings.robot.has(Part::Parameters)),
        logs: (observer.derive.robot.logs()).facts(observer.settings.robot.has(Part::Logs)),
        clocks: observer.derive.clocks.facts(
            observer.settings.robot.has(Part::Clocks),
            now,
            observer.graph.wall_clock,
        ),
        diagnoses: Arc::clone(observer.derive.examiner.current()),
        diagnosed: Arc::clone(observer.derive.examiner.since()),
        churn: observer.graph.discovery.churn.facts(),
        decode_errors: decode_errors(observer),
        tables: tables(observer),
        datagrams: observer.counts.datagrams,
        records: observer.counts.records,
        topics_measured: observer.graph.topics.watched() as u64,
        topics_rejected: observer.graph.topics.rejected,
    }
}

fn participants(observer: &Observer) -> Vec<ParticipantFacts> {
    let holders = observer.graph.receivers.holders();
    let mut facts: Vec<_> = observer
        .graph
        .discovery
        .participants()
        .iter()
        .map(|(prefix, participant)| {
            let proxy = &participant.proxy;
            ParticipantFacts {
                guid: Guid::new(*prefix, EntityId::PARTICIPANT),
                domain_id: participant.domain_id,
                vendor: proxy.vendor,
                product_version: proxy.product_version.clone(),
                enclave: proxy.enclave.clone(),
                process: process(Some(proxy), holders.get(prefix).copied()),
                first_seen: participant.first_seen,
                last_seen: participant.last_seen,
                lease: proxy.lease,
                secured: proxy.secured,
                announces_by_tcp: proxy.announces_by_tcp,
                announces_unseen: participant.announces_unseen(),
                discovery_server: proxy.discovery_server,
                restored: participant.restored.is_some(),
                addresses: participant.addresses.clone(),
            }
        })
        .collect();
    facts.sort_unstable_by_key(|fact| (fact.domain_id, fact.guid));
    facts
}

fn node_facts(discovery: &Discovery) -> Vec<NodeFacts> {
    let mut facts = Vec::new();
    for (prefix, participant) in discovery.participants() {
        for node in &participant.nodes {
            facts.push(NodeFacts {
                domain_id: participant.domain_id,
                name: node.name.clone(),
                participant: Guid::new(*prefix, EntityId::PARTICIPANT),
                writers: node.writers.clone(),
                readers: node.readers.clone(),
            });
        }
    }
    facts.sort_by(|one, other| {
        (one.domain_id, &one.name, one.participant).cmp(&(
            other.domain_id,
            &other.name,
            other.participant,
        ))
    });
    facts
}

/// Returns the node of each endpoint.
fn nodes_of_endpoints(graph: &Graph) -> HashMap<Guid, &NodeName> {
    let discovery = &graph.discovery;
    let mut nodes = HashMap::with_capacity(discovery.endpoints().len());
    for participant in discovery.participants().values() {
        for node in &participant.nodes {
            for guid in node.writers.iter().chain(&node.readers) {
                nodes.insert(*guid, &node.name);
            }
        }
    }
    for (_, topic) in graph.topics.iter() {
        for (buffer, base) in topic.buffers(discovery) {
            if let Some(name) = nodes.get(&base).copied() {
                nodes.insert(buffer, name);
            }
        }
    }
    nodes
}

fn topic(
    observer: &Observer,
    topic: &Topic,
    nodes: &HashMap<Guid, &NodeName>,
    now: ModelTime,
) -> TopicFacts {
    let measured = |guid: Guid| {
        let measured = observer.measure.profiler.get(guid);
        let measured = measured.filter(|measured| measured.topic.is_some())?;
        Some(measured.writer.measurement(now))
    };
    let mut buffers: BTreeMap<Guid, Vec<Guid>> = BTreeMap::new();
    let mut owned = BTreeSet::new();
    for (buffer, base) in topic.buffers(&observer.graph.discovery) {
        buffers.entry(base).or_default().push(buffer);
        owned.insert(buffer);
    }
    let endpoint = |guid: &Guid| {
        let endpoint = observer.graph.discovery.endpoints().get(guid)?;
        let buffers = buffers.get(guid).cloned().unwrap_or_default();
        let mut measurement = measured(*guid).map(Box::new);
        for other in buffers.iter().filter_map(|buffer| measured(*buffer)) {
            measurement.get_or_insert_default().add(&other);
        }
        Some(EndpointFacts {
            guid: *guid,
            gid: endpoint.gid,
            node: nodes.get(guid).copied().cloned(),
            qos: Arc::clone(&endpoint.qos),
            message_type: endpoint.message_type.clone(),
            type_hash: endpoint.type_hash,
            equivalence_hash: endpoint.equivalence_hash,
            first_seen: endpoint.first_seen,
            measurement,
            transports: 0,
            latched: observer.measure.latched.facts(*guid),
            backends: endpoint.backends.clone(),
            buffers: buffers.into(),
        })
    };
    let mut publishers = with_exact_capacity(
        topic.writers.len(),
        topic.writers.iter().filter_map(endpoint),
    );
    let mut subscriptions = with_exact_capacity(
        topic.readers.len(),
        topic.readers.iter().filter_map(endpoint),
    );
    let inside = observer.derive.inside.topic(topic.domain_id, &topic.naming);
    let is_observed = |guid: Guid| inside.is_some() && observer.derive.inside.observes(guid.prefix);
    let (transports, observed_pairs) = transports(
        &observer.graph.discovery,
        &mut publishers,
        &mut subscriptions,
        is_observed,
    );
    let all = || publishers.iter().chain(&subscriptions);
    let mut message_types: BTreeSet<_> = all().map(|each| each.message_type.clone()).collect();
    if topic.is_vanished() {
        message_types.extend(topic.last_type.clone());
    }
    let type_hashes: BTreeSet<_> = all().filter_map(|each| each.type_hash).collect();
    let is_apart = |guid: &Guid| !owned.contains(guid);
    let mut measurement = apart(observer, topic, is_apart, now);
    if let Some(sum) = &mut measurement {
        let own = publishers
            .iter()
            .filter_map(|each| each.measurement.as_ref());
        own.for_each(|own| sum.add(own));
        observer
            .derive
            .inside
            .apply(topic.domain_id, &topic.naming, sum);
        sum.loss = topic.loss.total;
    }
    let totals = deliveries::totals(observer, topic);
    TopicFacts {
        domain_id: topic.domain_id,
        name: topic.naming.name.clone(),
        dds_name: topic.naming.dds_name.clone(),
        kind: topic.naming.kind,
        hidden: topic.naming.hidden,
        message_types: message_types.into_iter().collect(),
        type_hashes: type_hashes.into_iter().collect(),
        publishers,
        subscriptions,
        measurement,
        received: totals.seen[0].then(|| Box::new(totals.received)),
        sent: totals.seen[1].then(|| Box::new(totals.sent)),
        breakdown: totals.breakdown,
        deliveries: deliveries::deliveries(observer, topic, nodes),
        acknowledgements: deliveries::acknowledgements(observer, topic, nodes, now),
        vanished: topic.is_vanished(),
        transports,
        is_read: topic.requested.is_some(),
        source: observer
            .derive
            .inside
            .source(topic.domain_id, &topic.naming),
        inside: inside.map(Box::new),
        observed_pairs,
    }
}

/// Returns all counts of each measured topic.
pub(super) fn measured(
    observer: &Observer,
    now: ModelTime,
) -> impl Iterator<Item = (DomainId, &DdsName, Measurement)> {
    let topics = observer.graph.topics.iter().map(|(_, topic)| topic);
    let topics = topics.filter(|topic| topic.watched == Watched::Yes);
    topics.filter_map(move |topic| {
        let mut sum = *apart(observer, topic, |_| true, now)?;
        for guid in &topic.writers {
            let measured = observer.measure.profiler.get(*guid);
            if let Some(own) = measured.filter(|measured| measured.topic.is_some()) {
                sum.add(&own.writer.measurement(now));
            }
        }
        let inside = &observer.derive.inside;
        inside.apply(topic.domain_id, &topic.naming, &mut sum);
        sum.loss = topic.loss.total;
        Some((topic.domain_id, &topic.naming.dds_name, sum))
    })
}

/// Returns the counts of vanished writers, and of those buffer endpoints that are meant; `None` for
/// a topic that is not measured.
fn apart(
    observer: &Observer,
    topic: &Topic,
    is_meant: impl Fn(&Guid) -> bool,
    now: ModelTime,
) -> Option<Box<Measurement>> {
    let mut sum = topic.retired.clone()?;
    for guid in topic.buffer_endpoints.iter().filter(|guid| is_meant(guid)) {
        if let Some(buffer_endpoints) = observer.measure.profiler.get(*guid) {
            sum.add(&buffer_endpoints.writer.measurement(now));
        }
    }
    Some(sum)
}

/// Collects with exact capacity: most topics have one endpoint, and `collect` would allocate four.
fn with_exact_capacity<T>(length: usize, items: impl Iterator<Item = T>) -> Vec<T> {
    let mut list = Vec::with_capacity(length);
    list.extend(items);
    list
}

fn unknown_writers(observer: &Observer, now: ModelTime) -> Vec<UnknownWriterFacts> {
    let unknown_writers = observer
        .measure
        .profiler
        .iter()
        .filter(|(_, measured)| measured.metered && measured.topic.is_none());
    let mut facts: Vec<_> = unknown_writers
        .map(|(guid, measured)| {
            let participant = observer.graph.discovery.participants().get(&guid.prefix);
            let proxy = participant.map(|participant| &participant.proxy);
            let holder = observer.graph.receivers.sockets().get(measured.socket);
            UnknownWriterFacts {
                guid: *guid,
                vendor: vendor(*guid, proxy),
                process: process(proxy, holder),
                first_seen: measured.first_seen,
                measurement: measured.writer.measurement(now),
            }
        })
        .collect();
    facts.sort_unstable_by_key(|fact| fact.guid);
    facts
}

/// Combines the announced facts about a participant's process with those of its socket's owner.
fn process(proxy: Option<&ParticipantProxy>, holder: Option<&SocketFacts>) -> ProcessFacts {
    let announced = |text: fn(&ParticipantProxy) -> &Option<Arc<str>>| {
        proxy.and_then(|proxy| text(proxy).clone())
    };
    let held = |text: fn(&SocketFacts) -> &Option<Arc<str>>| holder.and_then(|it| text(it).clone());
    let id = holder.and_then(|holder| holder.process_id);
    ProcessFacts {
        host: announced(|proxy| &proxy.host),
        id: id.or_else(|| proxy.and_then(|proxy| proxy.process_id)),
        name: announced(|proxy| &proxy.process_name).or_else(|| held(|holder| &holder.process)),
        cgroup: held(|holder| &holder.cgroup),
    }
}

/// Returns the vendor. Without an announcement it follows from the first bytes of the GUID, as RTPS
/// 2.5, 9.3.1.5 requires and Fast DDS and Cyclone DDS 0.10 implement.
fn vendor(guid: Guid, proxy: Option<&ParticipantProxy>) -> Option<VendorId> {
    let [first, second, ..] = guid.prefix.0;
    let marked = VendorId([first, second]);
    match proxy {
        Some(proxy) => Some(proxy.vendor),
        None => marked.name().is_some().then_some(marked),
    }
}

fn watches(observer: &Observer) -> Vec<WatchFacts> {
    let mut facts: Vec<_> = observer
        .requested
        .watchlist
        .watches()
        .iter()
        .map(|watch| WatchFacts {
            watch: Arc::clone(watch),
            topics: Vec::new(),
        })
        .collect();
    for (_, topic) in observer.graph.topics.iter() {
        for (index, judgement) in &topic.judgements {
            let Some(fact) = facts.get_mut(*index) else {
                continue;
            };
            fact.topics.push(WatchedTopicFacts {
                domain_id: topic.domain_id,
                topic: topic.naming.name.clone(),
                state: judgement.state(),
                violations: judgement.violations(),
            });
        }
    }
    let rejected = observer
        .graph
        .topics
        .iter()
        .filter(|(_, topic)| topic.watched == Watched::Rejected);
    let rejected: BTreeSet<_> = rejected.map(|(_, topic)| &*topic.naming.name).collect();
    let is_rejected = |name: &str| rejected.contains(name);
    for (watch, fact) in observer
        .requested
        .watchlist
        .watches()
        .iter()
        .zip(&mut facts)
    {
        if watch.is_literal() && fact.topics.is_empty() && !is_rejected(&watch.pattern) {
            fact.topics.push(WatchedTopicFacts {
                domain_id: watch.domain_id.unwrap_or(DomainId(0)),
                topic: watch.pattern.as_str().into(),
                state: WatchState::NotPublished,
                violations: Vec::new(),
            });
        }
    }
    facts
}

fn decode_errors(observer: &Observer) -> Vec<DecodeErrorCount> {
    let fact = |((stage, reason), count): (&(&'static str, &'static str), &u64)| DecodeErrorCount {
        stage,
        reason,
        count: *count,
    };
    observer.counts.decode_errors.iter().map(fact).collect()
}

fn tables(observer: &Observer) -> Vec<TableFacts> {
    let (settings, profiler) = (&observer.settings, &observer.measure.profiler);
    let (discovery, topics) = (&observer.graph.discovery, &observer.graph.topics);
    let [participants, endpoints, nodes] = discovery.tables();
    let table = |table, size: usize, limit: usize, evictions| TableFacts {
        table,
        size: size as u64,
        limit: limit as u64,
        bytes: None,
        evictions,
    };
    let (writers, unknown_writers) = profiler.size();
    let (interest, interest_limit, interest_evictions) = observer.requested.interest.size();
    let [sockets, addresses] = observer.graph.receivers.tables();
    let (diagnoses, diagnoses_limit, diagnoses_left_out) = observer.derive.examiner.size();
    let (payloads, payloads_limit, payloads_evictions) = observer.measure.payloads.size();
    let [chains, messages] = observer.derive.chains.tables();
    let quota = profiler.quota();
    let refused = profiler.iter().filter_map(|(_, measured)| {
        let subscribers = measured.subscribers.as_ref()?;
        Some(subscribers.refused())
    });
    let refused: u64 = refused.sum();
    let budgets = profiler.budgets();
    let samples: usize = budgets.iter().map(|budget| budget.bytes).sum();
    let samples_limit: usize = budgets.iter().map(|budget| budget.limit).sum();
    let samples_evictions: u64 = budgets
        .iter()
        .map(|budget| budget.evictions + budget.rejected)
        .sum();
    let mut tables = vec![
        participants,
        endpoints,
        nodes,
        table("topics", topics.len(), settings.endpoints, topics.evictions),
        table("writers", writers, settings.endpoints, 0),
        unknown_writers,
        table(
            "samples",
            samples,
            samples_limit,
            samples_evictions + observer.measure.discovery_fragments.evictions(),
        ),
        table("interest", interest, interest_limit, interest_evictions),
        table(
            "deliveries",
            quota.used,
            quota.limit,
            quota.evictions + refused,
        ),
        sockets,
        addresses,
        table("diagnoses", diagnoses, diagnoses_limit, diagnoses_left_out),
        observer.derive.tracer.table(),
        observer.derive.services.table(),
        observer.derive.inside.table(),
        chains,
        messages,
        table("payloads", payloads, payloads_limit, payloads_evictions),
    ];
    tables.extend(observer.measure.latched.tables());
    tables.extend(observer.zenoh.tables());
    tables.push(observer.measure.links.tables());
    tables.push(observer.measure.tls.tables());
    tables.extend(observer.derive.robot.tables());
    tables.push(observer.derive.stamps.table());
    tables.extend(observer.derive.clocks.tables());
    tables
}
