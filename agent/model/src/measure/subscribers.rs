//! Receivers of one writer's samples, and the routes to them.
//!
//! **A delivery belongs to a participant.** A multicast sample and its unicast retransmission
//! arrive at two sockets of one participant, so losses only show when both are combined. All routes
//! that lead to a participant feed one delivery. A route to an unknown receiver has its own
//! delivery until the receiver is known.
//!
//! A multicast route to an unknown receiver may lead to any receiver (on a wire, to all). Its
//! delivery must not invent losses. Unicast samples fill its gaps, and its samples are not missing
//! at unicast deliveries. A sample that it already has opens no delivery when it arrives again by
//! unicast.
//!
//! A sample directed (INFO_DST) at a participant concerns no other participant at the same socket.
//!
//! **Only a reader makes a subscriber.** A sample that reaches a participant without a known reader
//! that matches the writer counts as unmatched. Samples at a socket whose participant is unknown
//! are withheld until it is known.

mod lifecycle;
mod receivers;
mod submessages;

use ros2probe_wire::{Guid, GuidPrefix, SequenceNumber};

use crate::facts::header::MAX_PLAUSIBLE_OFFSET;
use crate::facts::journal::Journal;
use crate::facts::loss_share::LossShare;
use crate::facts::measurement::Breakdown;
use crate::facts::model_time::ModelTime;
use crate::facts::observation::{DatagramFate, Observation, Sample};
use crate::facts::route::Receiver;
use crate::facts::route::{Destination, Route};
use crate::measure::acknowledgement::{AcknowledgementFacts, Acknowledgements};
use crate::measure::delivery::{Delivery, DeliveryContext, Totals, seconds};
use crate::measure::departures::Departures;
use crate::measure::receivers::{Graph, Matched, MatchedReaders};
use crate::measure::reception::CompleteSample;
use crate::measure::routes::Routes;
use crate::measure::samples::Budget;
use crate::measure::topic::{Topic, TopicId};

/// Maximum number of samples that one call compares with other deliveries.
const MAX_COMPARED_SAMPLES: u64 = 4096;
/// Maximum UDP payload of one Ethernet frame over IPv4. Larger datagrams need IP reassembly.
const FRAME_BYTES: u16 = 1472;

/// All receivers and destinations of one writer.
#[derive(Debug, Default)]
pub struct Subscribers {
    routes: Routes,
    deliveries: Vec<Delivery>,
    /// Number of deliveries of multicast routes to unknown receivers.
    open: usize,
    totals: Totals,
    departures: Departures,
    acknowledgements: Acknowledgements,
    /// Whether the writer's datagrams may need IP reassembly on this host.
    reassembled: bool,
    /// Whether some routes are observed at sockets.
    at_socket: bool,
    /// Whether any participant has a reader that matches the writer.
    has_readers: bool,
    /// Whether the writer applies a content filter for each reader that is seen to receive its
    /// samples.
    is_filtered: bool,
    /// Losses in this second of the worst receiver that is gone.
    departed: LossShare,
    /// Generation of the results in `routes`.
    generation: u64,
    /// See [`Delivery::allow_incomplete`].
    sure_from: ModelTime,
}

/// Result of an observation for the deliveries.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Novelty {
    /// It may contain new data.
    New,
    /// The same receiver already had all of it, or all of it had left for the same destination.
    Duplicate,
    /// It was seen on a wire, but the route is observed at sockets.
    SeenAtSocket,
}

/// The quota for deliveries of all writers.
#[derive(Clone, Copy, Debug)]
pub struct DeliveryQuota {
    /// Number of deliveries.
    pub used: usize,
    /// Maximum number of deliveries.
    pub limit: usize,
    /// Number of deliveries refused or dropped because of the cap.
    pub evictions: u64,
    /// Whether a delivery was refused.
    pub wanted: bool,
}

/// State outside the deliveries that an observation changes, and its context.
#[derive(Debug)]
pub struct WriterContext<'a> {
    /// Time of the observation, or of the tick.
    pub now: ModelTime,
    /// The writer.
    pub writer: Guid,
    /// Whether the writer retransmits.
    pub reliable: bool,
    /// Its topic.
    pub topic: Option<TopicId>,
    /// Memory budget for fragmented samples.
    pub budget: &'a mut Budget,
    /// Journal that receives the losses.
    pub journal: &'a mut Journal,
    /// Quota for deliveries.
    pub quota: &'a mut DeliveryQuota,
    /// Participants, topics and receivers.
    pub graph: &'a Graph,
}

impl Subscribers {
    /// Creates an empty state for a writer that the kernel knows since `sure_from`.
    #[must_use]
    pub fn new(sure_from: ModelTime) -> Self {
        Self {
            sure_from,
            ..Self::default()
        }
    }

    /// Records that bytes for this destination were not captured: samples missing before `at` may
    /// have arrived. Returns whether a delivery is affected.
    pub fn missed(&mut self, destination: Destination, at: ModelTime) -> bool {
        let mut is_affected = false;
        for delivery in &mut self.deliveries {
            if delivery.main_route().destination == destination {
                delivery.interrupt(at);
                is_affected = true;
            }
        }
        is_affected
    }

    /// Records that the writer's numbers before its next sample may belong to other samples.
    pub fn skip_numbers(&mut self, at: ModelTime) {
        for delivery in &mut self.deliveries {
            delivery.open(at);
        }
    }

    /// Returns the sums over all deliveries, including former ones.
    #[must_use]
    pub const fn totals(&self) -> &Totals {
        &self.totals
    }

    /// Returns whether the writer applies a content filter for each reader that is seen to receive
    /// its samples.
    #[must_use]
    pub const fn is_filtered(&self) -> bool {
        self.is_filtered
    }

    /// Returns the number of routes and readers that were refused.
    #[must_use]
    pub const fn refused(&self) -> u64 {
        self.routes.evictions() + self.acknowledgements.refused
    }

    /// Returns the readers' acknowledgements of `writer`, whose next sample has the number `next`.
    pub fn acknowledgements(
        &self,
        writer: Guid,
        next: SequenceNumber,
        now: ModelTime,
    ) -> impl Iterator<Item = AcknowledgementFacts> + '_ {
        self.acknowledgements.facts(writer, next, now)
    }

    /// Processes an observation of the writer, or an ACKNACK for it.
    pub fn observe(
        &mut self,
        observation: &Observation,
        context: &mut WriterContext<'_>,
    ) -> Novelty {
        self.refresh(context);
        if let Observation::AckNack(acknack) = observation {
            self.requested(acknack);
            let is_reader = |topic: &Topic| is_reader(topic, acknack.head.reader);
            if context.topic().is_some_and(is_reader) {
                self.acknowledgements.acknack(acknack);
                self.acknowledged(acknack);
            }
            return Novelty::New;
        }
        if let Observation::Sample(sample) = observation
            && sample.fate == DatagramFate::NotReassembled
        {
            self.not_reassembled(sample, context);
            return Novelty::New;
        }
        let head = observation.head();
        let is_host = head.is_at_socket();
        self.reassembled |= is_host && head.datagram_len > FRAME_BYTES;
        let route = head.route();
        match observation {
            Observation::Sample(_) => {}
            Observation::Heartbeat(_) | Observation::Gap(_) if !route.is_sent() => {}
            _ => return Novelty::New,
        }
        if !is_host && self.at_socket && self.routes.is_at_socket(route.destination) {
            return Novelty::SeenAtSocket;
        }
        if is_host && route.socket != 0 && self.routes.find(&route).is_none() {
            self.learn_socket(route, context);
        }
        let readers = context.readers();
        let mut index = self.routes.find_or_insert(route, context.now, readers);
        if let Some(known) = self.routes.get_mut(index) {
            known.last_seen = known.last_seen.max(context.now);
            if is_host && !known.at_socket {
                known.at_socket = true;
                self.drop_wire_routes(route, context);
                index = self.routes.find(&route).unwrap_or(index);
            }
        }
        let came_again = match observation {
            Observation::Sample(sample) if route.is_sent() => self.leave(index, sample, context),
            _ => self.arrive(index, observation, context),
        };
        if came_again {
            Novelty::Duplicate
        } else {
            Novelty::New
        }
    }

    /// Returns the number below which all acknowledging readers have every sample; `None` without
    /// such readers.
    #[must_use]
    pub fn acknowledged_below(&self) -> Option<SequenceNumber> {
        self.acknowledgements.floor(|_| true)
    }

    /// Records the writer's newest sample and its time.
    pub fn wrote(&mut self, number: SequenceNumber, at: ModelTime) {
        self.acknowledgements.wrote(number, at);
    }

    /// Processes an outgoing sample. Returns whether it had left for this unicast destination
    /// before.
    fn leave(&mut self, index: usize, sample: &Sample, context: &mut WriterContext<'_>) -> bool {
        let Some(route) = self.routes.get(index).map(|known| known.route) else {
            return false;
        };
        self.totals.seen[1] = true;
        let source = sample.source_timestamp.timestamp();
        let wall_clock = context.graph.wall_clock;
        let began = wall_clock.wall_time(sample.head.began());
        // Both times are from one clock. A sample that leaves before its timestamp, or hours after
        // it, is not a measure of the send delay.
        if let Some(source) = source.filter(|_| sample.is_start())
            && (source..=source + MAX_PLAUSIBLE_OFFSET).contains(&began)
            && self.departures.is_first(wall_clock.model_time(source))
        {
            let delay = began.nanoseconds_since(source);
            self.breakdown().send_delay.observe(seconds(delay));
        }
        let Some(place) = self.delivery(index, Receiver::Route(route), context) else {
            return false;
        };
        let Some(delivery) = self.deliveries.get_mut(place) else {
            return false;
        };
        let (again, whole) = delivery.sample(
            sample,
            &mut delivery_context(&mut self.totals, self.reassembled, context),
        );
        if let Some(whole) = whole {
            self.departures
                .note(whole.number, route.destination, context.now);
            if !self.totals.seen[0] {
                self.transfer(&whole, context.now);
            }
        }
        again && !route.destination.is_multicast()
    }

    fn arrive(
        &mut self,
        index: usize,
        observation: &Observation,
        context: &mut WriterContext<'_>,
    ) -> bool {
        self.totals.seen[0] = true;
        let Some((receiver, matched)) = self.receiver(index, observation, context) else {
            return false;
        };
        let is_elsewhere = match receiver {
            Receiver::Participant(_) => matched != Matched::Yes,
            Receiver::Route(route) => route.socket == 0 && !self.has_readers,
        };
        if is_elsewhere {
            if let Observation::Sample(sample) = observation
                && sample.is_message()
                && sample.is_end()
                && sample.is_delivered()
            {
                let place = self.find(receiver);
                match place.and_then(|place| self.deliveries.get_mut(place)) {
                    Some(delivery) => delivery.ignore(&mut self.totals),
                    None => self.totals.received.unmatched += 1,
                }
            }
            return false;
        }
        match observation {
            Observation::Sample(sample) => return self.sample(index, receiver, sample, context),
            Observation::Heartbeat(heartbeat) => {
                self.heartbeat(index, (receiver, matched), heartbeat, context);
            }
            Observation::Gap(gap) => self.gap(index, receiver, gap, context),
            _ => {}
        }
        false
    }

    /// Returns the receiver on this route, and whether it has a matching reader.
    fn receiver(
        &mut self,
        index: usize,
        observation: &Observation,
        context: &mut WriterContext<'_>,
    ) -> Option<(Receiver, Matched)> {
        let directed = observation.head().directed_at();
        let readers = context.readers();
        let known = self.routes.get_mut(index)?;
        let is_multicast = known.route.destination.is_multicast();
        if let Some(prefix) = directed.filter(|_| !is_multicast) {
            if known.route.socket != 0 && known.owner.is_some_and(|owner| owner != prefix) {
                // The owner ignores a message that is directed at another participant.
                return None;
            }
            known.note_directed(prefix, readers);
            let matched = if known.owner == Some(prefix) {
                known.matched
            } else {
                readers.matched(prefix)
            };
            return Some((Receiver::Participant(prefix), matched));
        }
        match (known.owner, directed) {
            (Some(owner), None) => Some((Receiver::Participant(owner), known.matched)),
            (Some(owner), Some(prefix)) => {
                (owner == prefix).then_some((Receiver::Participant(owner), known.matched))
            }
            (None, None) => Some((Receiver::Route(known.route), Matched::Unknown)),
            (None, Some(_)) => {
                if let Observation::Sample(sample) = observation {
                    self.repair(sample, context);
                }
                None
            }
        }
    }

    fn sample(
        &mut self,
        index: usize,
        receiver: Receiver,
        sample: &Sample,
        context: &mut WriterContext<'_>,
    ) -> bool {
        let socket_full = sample.fate == DatagramFate::SocketFull;
        let route = self.routes.get(index).map(|known| known.route);
        if route.is_some_and(|route| self.is_repair_elsewhere(route, receiver, sample)) {
            return false;
        }
        let is_open = |receiver| matches!(receiver, Receiver::Route(route) if route.is_open());
        if self.open > 0 && !is_open(receiver) {
            let is_known = !socket_full && self.repair(sample, context);
            // Another multicast socket of the host has a receiver of its own.
            let is_unicast = route.is_some_and(|route| !route.destination.is_multicast());
            if is_unicast && (is_known || socket_full) && self.find(receiver).is_none() {
                return false;
            }
        }
        let Some(place) = self.delivery(index, receiver, context) else {
            return false;
        };
        let Some(delivery) = self.deliveries.get_mut(place) else {
            return false;
        };
        let next = delivery.next();
        if socket_full {
            delivery.socket_full(
                sample,
                &mut delivery_context(&mut self.totals, self.reassembled, context),
            );
            return false;
        }
        let (again, whole) = delivery.sample(
            sample,
            &mut delivery_context(&mut self.totals, self.reassembled, context),
        );
        if self.open > 0 {
            self.share(place, next, whole.map(|whole| whole.number));
        }
        if let Some(known) = self.routes.get_mut(index) {
            known.has_data = true;
        }
        if let Some(whole) = whole {
            self.note_arrival(index, place, &whole, context.now);
        }
        again
    }

    /// Processes a sample that arrived whole on this route.
    fn note_arrival(&mut self, index: usize, place: usize, whole: &CompleteSample, now: ModelTime) {
        let withheld = self.deliveries.get(place).map(Delivery::is_withheld);
        let is_counted = withheld == Some(false);
        if is_counted {
            self.transfer(whole, now);
        }
        let Some(known) = self.routes.get_mut(index).filter(|_| !whole.recovered) else {
            return;
        };
        let route = known.route;
        known.new_samples += u64::from(whole.newest);
        let brought = known.new_samples;
        if let Some(left) = self.departures.find(whole.number, route.destination)
            && now >= left
            && is_counted
        {
            let transit = now.nanoseconds_since(left);
            self.breakdown().transit.observe(seconds(transit));
        }
        let Some(delivery) = self.deliveries.get_mut(place) else {
            return;
        };
        if delivery.main_route() != route {
            let main = self.routes.find(&delivery.main_route());
            let main = main.and_then(|index| self.routes.get(index));
            if main.is_none_or(|main| main.new_samples < brought) {
                delivery.move_to(route);
            }
        }
    }

    /// Fills the gaps of deliveries that may have the same receiver. Returns whether any of these
    /// deliveries knows the sample.
    fn repair(&mut self, sample: &Sample, context: &mut WriterContext<'_>) -> bool {
        let number = sample.sequence_number;
        let mut is_known = false;
        for delivery in self.deliveries.iter_mut().filter(|each| is_open(each)) {
            is_known |= delivery.next() > number;
            if delivery.is_missing(number) {
                delivery.sample(
                    sample,
                    &mut delivery_context(&mut self.totals, self.reassembled, context),
                );
            }
        }
        is_known
    }

    /// Returns whether a unicast sample on a wire is a retransmission to another host: its receiver
    /// is unknown, and a socket of this host received the sample by multicast.
    fn is_repair_elsewhere(&self, route: Route, receiver: Receiver, sample: &Sample) -> bool {
        let is_at_socket = |route: Route| route.is_open() && route.socket != 0;
        route.socket == 0
            && self.at_socket
            && !route.destination.is_multicast()
            && self.find(receiver).is_none()
            && self.deliveries.iter().any(|delivery| {
                is_at_socket(delivery.main_route()) && delivery.next() > sample.sequence_number
            })
    }

    /// Shares the samples of deliveries that may have the same receiver.
    fn share(&mut self, place: usize, next: SequenceNumber, whole: Option<SequenceNumber>) {
        let Some(delivery) = self.deliveries.get(place) else {
            return;
        };
        if is_open(delivery) {
            let Some(number) = whole.filter(|_| self.open < self.deliveries.len()) else {
                return;
            };
            for other in &mut self.deliveries {
                if !other.main_route().is_sent() && !is_open(other) && other.is_missing(number) {
                    other.know(number, &mut self.totals);
                }
            }
            return;
        }
        let end = delivery
            .next()
            .min(next.saturating_add(MAX_COMPARED_SAMPLES));
        if next == SequenceNumber::ZERO || end <= next + 1 {
            return;
        }
        let missing = next
            .until(end)
            .filter(|number| delivery.is_missing(*number));
        let has = |number: &SequenceNumber| {
            let mut others = self.deliveries.iter().filter(|each| is_open(each));
            others.any(|other| other.is_missing(*number) || other.has(*number))
        };
        let known: Vec<_> = missing.filter(has).collect();
        if let Some(delivery) = self.deliveries.get_mut(place) {
            let totals = &mut self.totals;
            known
                .into_iter()
                .for_each(|number| delivery.know(number, totals));
        }
    }

    fn find(&self, receiver: Receiver) -> Option<usize> {
        self.deliveries
            .iter()
            .position(|delivery| delivery.receiver() == receiver)
    }

    /// Returns the delivery of this receiver, creating it if the quota allows.
    fn delivery(
        &mut self,
        index: usize,
        receiver: Receiver,
        context: &mut WriterContext<'_>,
    ) -> Option<usize> {
        let known = self.routes.get(index)?;
        let cached = known.delivery.filter(|place| {
            let delivery = self.deliveries.get(*place);
            delivery.is_some_and(|delivery| delivery.receiver() == receiver)
        });
        if cached.is_some() {
            return cached;
        }
        let (route, is_shared, owner) = (known.route, known.is_shared, known.owner);
        let place = match self.find(receiver) {
            Some(place) => place,
            None if context.quota.used >= context.quota.limit => {
                context.quota.evictions += 1;
                context.quota.wanted = true;
                return None;
            }
            None => {
                context.quota.used += 1;
                let mut delivery = Delivery::new(receiver, route, context.now);
                let readers = context.readers();
                let is_filtered = readers.are_filtered(addressee(receiver, owner));
                delivery.learn(is_best_effort(receiver, readers), is_filtered);
                delivery.allow_incomplete(self.sure_from);
                if is_unknown(receiver) && !is_shared {
                    delivery.withhold();
                }
                self.deliveries.push(delivery);
                self.count_open();
                self.note_filters();
                self.deliveries.len() - 1
            }
        };
        if let Some(known) = self.routes.get_mut(index) {
            known.delivery = Some(place);
        }
        Some(place)
    }

    fn count_open(&mut self) {
        self.open = self.deliveries.iter().filter(|each| is_open(each)).count();
    }

    fn note_filters(&mut self) {
        let mut deliveries = self.deliveries.iter();
        self.is_filtered = !self.deliveries.is_empty() && deliveries.all(Delivery::is_filtered);
    }

    fn breakdown(&mut self) -> &mut Breakdown {
        self.totals.breakdown.get_or_insert_default()
    }

    fn transfer(&mut self, whole: &CompleteSample, now: ModelTime) {
        if now > whole.began {
            let transfer = now.nanoseconds_since(whole.began);
            self.breakdown().transfer.observe(seconds(transfer));
        }
    }
}

impl<'a> WriterContext<'a> {
    fn topic(&self) -> Option<&'a Topic> {
        self.graph.topics.get(self.topic?)
    }

    fn readers(&self) -> MatchedReaders<'a> {
        MatchedReaders::new(self.graph, self.topic(), self.writer)
    }
}

fn is_open(delivery: &Delivery) -> bool {
    matches!(delivery.receiver(), Receiver::Route(route) if route.is_open())
}

/// Returns whether the receiver is a socket of an unknown participant.
const fn is_unknown(receiver: Receiver) -> bool {
    matches!(receiver, Receiver::Route(route) if route.socket != 0)
}

/// Returns whether the receiver has matching readers, all of them best effort.
fn is_best_effort(receiver: Receiver, readers: MatchedReaders<'_>) -> bool {
    matches!(receiver, Receiver::Participant(prefix) if readers.are_best_effort(prefix))
}

/// Returns the participant of the receiver; that of its route is `owner`, if known.
const fn addressee(receiver: Receiver, owner: Option<GuidPrefix>) -> Option<GuidPrefix> {
    match receiver {
        Receiver::Participant(prefix) => Some(prefix),
        Receiver::Route(_) => owner,
    }
}

fn is_reader(topic: &Topic, guid: Guid) -> bool {
    [&topic.readers, &topic.buffer_endpoints]
        .iter()
        .any(|list| list.binary_search(&guid).is_ok())
}

fn delivery_context<'a>(
    totals: &'a mut Totals,
    reassembled: bool,
    context: &'a mut WriterContext<'_>,
) -> DeliveryContext<'a> {
    DeliveryContext {
        now: context.now,
        writer: context.writer,
        reliable: context.reliable,
        reassembled,
        budget: context.budget,
        journal: context.journal,
        totals,
    }
}
