//! Messages that arrived at the readers of a process, for comparison with its calls.

use std::collections::BTreeSet;

use ros2probe_wire::qos::{HistoryKind, Reliability};
use ros2probe_wire::{DomainId, Guid, GuidPrefix};

use super::Observer;
use crate::derive::inside::reader_queue::{Arrivals, ArrivalsOf};
use crate::facts::calls::late::Repairs;
use crate::facts::diagnosis::{Offer, Verdict, verdict};
use crate::facts::model_time::ModelTime;
use crate::facts::naming::Naming;
use crate::facts::repairs::{Awaited, RepairLog};
use crate::facts::route::Direction;
use crate::facts::route::Receiver;
use crate::graph::discovery::Discovery;
use crate::measure::profiler::{Measured, Profiler};
use crate::measure::receivers::Graph;
use crate::measure::topic::Watched;
use crate::report::snapshot::Transport;
use crate::report::transport::{transport, vendor};

impl Observer {
    /// Compares arrivals with the calls that take them.
    pub(super) fn compare_queues(&mut self, at: ModelTime) {
        let now = at.max(self.clock);
        let (graph, profiler) = (&self.graph, &self.measure.profiler);
        self.derive
            .inside
            .compare_queues(now, |participants, domain_id, naming| {
                arrivals((graph, profiler), participants, (domain_id, naming), now)
            });
    }
}

/// Returns the messages that arrived at the readers of a topic in these participants. Returns
/// `None` if some of them are not counted, because they stay in the process or use an unobserved
/// transport.
fn arrivals(
    (graph, profiler): (&Graph, &Profiler),
    participants: &BTreeSet<GuidPrefix>,
    (domain_id, naming): (DomainId, &Naming),
    now: ModelTime,
) -> Option<Arrivals> {
    let (discovery, topics) = (&graph.discovery, &graph.topics);
    let topic = topics.get(topics.find(domain_id, naming)?)?;
    // `rmw_fastrtps_cpp` takes messages of buffer topics without `rmw_take`.
    if topic.watched != Watched::Yes || !topic.buffer_endpoints.is_empty() {
        return None;
    }
    let own = participants.iter();
    let readers: Vec<Guid> = own.flat_map(|prefix| topic.readers_of(*prefix)).collect();
    let mut found = Arrivals {
        readers,
        depth: Some(0),
        ..Arrivals::default()
    };
    for reader in &found.readers {
        let history = discovery.endpoints().get(reader)?.qos.history;
        let depth = history.filter(|history| history.kind == HistoryKind::KEEP_LAST);
        let depth = depth.and_then(|history| u64::try_from(history.depth).ok());
        found.depth = found.depth.zip(depth).map(|(sum, depth)| sum + depth);
    }
    for writer in &topic.writers {
        let mut messages = 0;
        let mut since = None;
        for reader in &found.readers {
            if !are_matched(discovery, *writer, *reader)? {
                continue;
            }
            let measured = profiler.get(*writer)?;
            let transport = transport(discovery, *writer, *reader)?;
            let (begin, count) = arrived(measured, transport, reader.prefix, now)?;
            messages += count;
            since = begin;
            let facts = measured.writer.measurement(now);
            found.last = found.last.max(facts.last_message);
            found.is_ahead |= facts.negative_latency > 0;
        }
        if messages > 0 {
            found.writers.push(ArrivalsOf {
                writer: *writer,
                since,
                messages,
            });
        }
    }
    Some(found)
}

/// Returns the retransmissions for which a call of one of these participants waited.
pub(super) fn repairs(
    (graph, profiler, log): (&Graph, &Profiler, &RepairLog),
    participants: &BTreeSet<GuidPrefix>,
    (domain_id, naming): (DomainId, &Naming),
    awaited: Awaited,
) -> Repairs {
    let topics = &graph.topics;
    let topic = topics.find(domain_id, naming).and_then(|id| topics.get(id));
    let Some(topic) = topic else {
        return Repairs::default();
    };
    let concerns = |writer: Guid, receiver: GuidPrefix| {
        participants.contains(&receiver) && topic.writers.contains(&writer)
    };
    let found = log.of(awaited, concerns);
    if found.of_earlier.is_none() {
        return found;
    }
    // The writer of a message that was not lost is not known, and a best-effort reader does not wait.
    let measured = topic.writers.iter().filter_map(|id| profiler.get(*id));
    let subscribers = measured.filter_map(|measured| measured.subscribers.as_ref());
    let deliveries = subscribers.flat_map(|subscribers| subscribers.deliveries());
    let received = deliveries.filter(|(delivery, _)| match delivery.receiver() {
        Receiver::Participant(prefix) => {
            delivery.direction() == Direction::Received && participants.contains(&prefix)
        }
        Receiver::Route(_) => false,
    });
    let endpoints = graph.discovery.endpoints();
    let mut readers = participants
        .iter()
        .flat_map(|prefix| topic.readers_of(*prefix));
    let are_reliable = readers.all(|reader| {
        let reader = endpoints.get(&reader);
        reader.is_some_and(|reader| reader.qos.reliability == Reliability::RELIABLE)
    });
    match are_reliable && received.count() == 1 {
        true => found,
        false => Repairs {
            of_earlier: None,
            ..found
        },
    }
}

/// Returns whether both endpoints have the same type and compatible quality of service; `None` if
/// one is unknown.
fn are_matched(discovery: &Discovery, writer: Guid, reader: Guid) -> Option<bool> {
    let endpoints = discovery.endpoints();
    let (of_writer, of_reader) = (endpoints.get(&writer)?, endpoints.get(&reader)?);
    let offered = Offer {
        qos: &of_writer.qos,
        vendor: vendor(discovery, writer.prefix),
    };
    let requested = Offer {
        qos: &of_reader.qos,
        vendor: vendor(discovery, reader.prefix),
    };
    let is_one_type = of_writer.message_type == of_reader.message_type;
    Some(is_one_type && verdict(offered, requested) == Verdict::Match)
}

/// Returns when the count of a writer's messages at a participant began, and the count. The
/// beginning is `None` if messages may have been sent before.
fn arrived(
    measured: &Measured,
    transport: Transport,
    participant: GuidPrefix,
    now: ModelTime,
) -> Option<(Option<ModelTime>, u64)> {
    if !transport.is_network() && transport != Transport::SharedMemory {
        return None;
    }
    let is_shared = transport == Transport::SharedMemory;
    if is_shared && measured.writer.measurement(now).sampled.is_some() {
        // Earlier messages may have been written before this reader existed.
        return Some((None, measured.writer.messages()));
    }
    let Some(subscribers) = &measured.subscribers else {
        return Some((None, 0));
    };
    let mut deliveries = subscribers.deliveries().filter(|(delivery, _)| {
        delivery.direction() == Direction::Received
            && delivery.receiver() == Receiver::Participant(participant)
    });
    Some(deliveries.next().map_or((None, 0), |(delivery, _)| {
        (Some(delivery.seen().0), delivery.tally().messages)
    }))
}
