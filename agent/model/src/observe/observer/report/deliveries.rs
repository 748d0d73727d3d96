//! Deliveries, acknowledgements and sockets of a snapshot.

use std::collections::BTreeSet;

use foldhash::HashMap;
use ros2probe_wire::{EntityId, Guid};

use crate::facts::model_time::ModelTime;
use crate::facts::names::NodeName;
use crate::facts::route::Direction;
use crate::facts::route::Receiver;
use crate::graph::sockets::SocketFacts;
use crate::measure::delivery::{Delivery, Totals};
use crate::measure::receivers::MatchedReaders;
use crate::measure::routes::KnownRoute;
use crate::measure::topic::Topic;
use crate::observe::observer::Observer;
use crate::report::snapshot::{AcknowledgementFacts, DeliveryFacts, Subscriber};

/// Node names by endpoint.
type Nodes<'a> = HashMap<Guid, &'a NodeName>;

/// Returns the sums over a topic's live and vanished writers.
pub(super) fn totals(observer: &Observer, topic: &Topic) -> Totals {
    let mut sum = topic.retired_totals.as_deref().cloned().unwrap_or_default();
    for writer in topic.writers.iter().chain(&topic.buffer_endpoints) {
        let measured = observer.measure.profiler.get(*writer);
        if let Some(subscribers) = measured.and_then(|measured| measured.subscribers.as_ref()) {
            sum.add(subscribers.totals());
            sum.received.awaited += subscribers.awaited();
        }
    }
    sum
}

/// Returns every receiver and destination of the topic's live writers.
pub(super) fn deliveries(
    observer: &Observer,
    topic: &Topic,
    nodes: &Nodes<'_>,
) -> Vec<DeliveryFacts> {
    let mut facts = Vec::new();
    for writer in topic.writers.iter().chain(&topic.buffer_endpoints) {
        let measured = observer.measure.profiler.get(*writer);
        let Some(subscribers) = measured.and_then(|measured| measured.subscribers.as_ref()) else {
            continue;
        };
        let deliveries = subscribers.deliveries();
        facts.extend(deliveries.map(|(delivery, routes)| {
            delivery_facts(observer, topic, nodes, *writer, (delivery, &routes))
        }));
    }
    facts.sort_by(|one, other| {
        (one.writer, one.direction, one.destination, one.subscriber).cmp(&(
            other.writer,
            other.direction,
            other.destination,
            other.subscriber,
        ))
    });
    facts
}

fn delivery_facts(
    observer: &Observer,
    topic: &Topic,
    nodes: &Nodes<'_>,
    writer: Guid,
    (delivery, routes): (&Delivery, &[&KnownRoute]),
) -> DeliveryFacts {
    let main = delivery.main_route();
    let matched = MatchedReaders::new(&observer.graph, Some(topic), writer);
    let owner = match delivery.receiver() {
        Receiver::Participant(prefix) => Some(prefix),
        Receiver::Route(_) => routes.first().and_then(|known| known.owner),
    };
    let mut readers: Vec<_> = owner
        .map(|prefix| matched.of(prefix).collect())
        .unwrap_or_default();
    readers.sort_unstable();
    let nodes: BTreeSet<_> = readers
        .iter()
        .filter_map(|reader| nodes.get(reader).copied())
        .collect();
    let mut sockets: Vec<_> = routes.iter().map(|known| known.route.socket).collect();
    sockets.retain(|socket| *socket != 0);
    sockets.sort_unstable();
    sockets.dedup();
    let known = observer.graph.receivers.sockets();
    let socket = sockets
        .iter()
        .filter_map(|socket| known.get(*socket))
        .max_by_key(|facts| (facts.process_id.is_some(), facts.cgroup.is_some()));
    let process_id = socket.and_then(|socket| socket.process_id);
    let (first_seen, last_seen) = delivery.seen();
    let participant = owner.map(|prefix| Guid::new(prefix, EntityId::PARTICIPANT));
    let subscriber = match (participant, process_id, main.socket) {
        (Some(participant), ..) => Subscriber::Participant(participant),
        (None, Some(process_id), _) => Subscriber::Process(process_id),
        (None, None, 0) => Subscriber::Unknown,
        (None, None, socket) => Subscriber::Socket(socket),
    };
    DeliveryFacts {
        writer,
        direction: delivery.direction(),
        destination: main.destination.socket_address(),
        subscriber,
        participant,
        readers,
        nodes: nodes.into_iter().cloned().collect(),
        sockets,
        process_id,
        process: socket.and_then(|socket| socket.process.clone()),
        cgroup: socket.and_then(|socket| socket.cgroup.clone()),
        first_seen,
        last_seen,
        delivered: delivery.facts(),
        lost_in_reader_queue: participant
            .filter(|_| delivery.direction() == Direction::Received)
            .and_then(|guid| {
                let key = (topic.domain_id, &topic.naming);
                observer
                    .derive
                    .inside
                    .lost_in_queue(guid.prefix, key, writer)
            }),
    }
}

/// Returns every reliable reader that acknowledges to one of the topic's live writers.
pub(super) fn acknowledgements(
    observer: &Observer,
    topic: &Topic,
    nodes: &Nodes<'_>,
    now: ModelTime,
) -> Vec<AcknowledgementFacts> {
    let mut facts = Vec::new();
    for writer in topic.writers.iter().chain(&topic.buffer_endpoints) {
        let Some(measured) = observer.measure.profiler.get(*writer) else {
            continue;
        };
        let Some(subscribers) = &measured.subscribers else {
            continue;
        };
        let next = measured.writer.next();
        let acknowledged = subscribers.acknowledgements(*writer, next, now);
        facts.extend(acknowledged.map(|fact| AcknowledgementFacts {
            node: nodes.get(&fact.reader).copied().cloned(),
            ..fact
        }));
    }
    facts
}

/// Returns the sockets that receive samples of measured topics.
pub(super) fn sockets(observer: &Observer) -> Vec<SocketFacts> {
    let mut cookies = BTreeSet::new();
    for (_, measured) in observer.measure.profiler.iter() {
        let Some(subscribers) = &measured.subscribers else {
            continue;
        };
        for (delivery, routes) in subscribers.deliveries() {
            if delivery.direction() == Direction::Received {
                cookies.extend(routes.iter().map(|known| known.route.socket));
            }
        }
    }
    let known = observer.graph.receivers.sockets();
    cookies
        .into_iter()
        .filter_map(|cookie| known.get(cookie).cloned())
        .collect()
}
