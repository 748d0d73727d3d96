//! Who gets one writer's samples, and by which routes.
//!
//! **A delivery is a participant's.** A multicast sample and its repair by unicast come to two
//! sockets of one participant, so losses can only be told where both are put together: all routes
//! that are known to lead to a participant feed one delivery. A route that leads to nobody known is
//! a delivery of its own, until more is known.
//!
//! Of such routes a multicast one may belong to any receiver (on a wire it belongs to all). There
//! the rule is not to invent losses: what comes by unicast fills its gaps, what it brought is not
//! missing at a unicast delivery, and what it knows already opens no delivery when it comes again
//! by unicast.
//!
//! What is directed (INFO_DST) at a participant is for nobody else at the same socket. Where the
//! participant is known and reads nothing of the topic, samples are unmatched and nothing is kept.

mod lifecycle;
mod submessages;

use ros2probe_wire::record::{Body, Sample, flag};
use ros2probe_wire::{Guid, GuidPrefix, Record, SequenceNumber, Timestamp};

use super::acknowledgement::Acknowledgements;
use super::delivery::{Delivery, DeliveryContext, Receiver, Totals, seconds};
use super::departures::Departures;
use super::header::PLAUSIBLE;
use super::journal::Journal;
use super::measurement::Breakdown;
use super::receivers::{GraphView, Matched};
use super::reception::Whole;
use super::route::Direction;
use super::route::Route;
use super::routes::{KnownRoute, Routes};
use super::samples::Budget;
use super::size::Size;
use super::snapshot::AcknowledgementFacts;
use super::topic::{Topic, TopicId};
use lifecycle::is_best_effort;

/// Numbers looked up in a sibling at once.
const LOOK_BACK: u64 = 4096;
/// Largest UDP payload that fits one Ethernet frame over IPv4: a larger datagram may die in IP
/// reassembly.
const ONE_FRAME: u16 = 1472;

/// All receivers and destinations of one writer.
#[derive(Debug, Default)]
pub struct Subscribers {
    routes: Routes,
    deliveries: Vec<Delivery>,
    /// Deliveries of multicast routes that lead to nobody known.
    open: usize,
    totals: Totals,
    departures: Departures,
    acknowledgements: Acknowledgements,
    /// Its datagrams may need IP reassembly on this host.
    reassembled: bool,
    /// Some routes are seen at sockets.
    at_socket: bool,
    /// Of the answers in `routes`.
    generation: u64,
    /// See [`Delivery::allow_incomplete`].
    sure_from: Timestamp,
}

/// What a record was to the deliveries.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum RecordNovelty {
    /// It may have brought something.
    New,
    /// It brought nothing that had not come to the same receiver before, or left for the same
    /// destination.
    Duplicate,
    /// On a wire, of what is seen at sockets anyway.
    SeenAtSocket,
}

/// Room for the deliveries of all writers.
#[derive(Clone, Copy, Debug)]
pub struct DeliveryQuota {
    /// Deliveries.
    pub used: usize,
    /// Cap.
    pub limit: usize,
    /// Deliveries refused or given up because of it.
    pub evictions: u64,
    /// Somebody was refused.
    pub wanted: bool,
}

/// What a record changes besides the deliveries of its writer, and what it is seen against.
#[derive(Debug)]
pub struct WriterContext<'a> {
    /// The time of the record, or of the look at the clock.
    pub now: Timestamp,
    /// The writer.
    pub writer: Guid,
    /// It retransmits.
    pub reliable: bool,
    /// Its topic.
    pub topic: Option<TopicId>,
    /// Memory for fragmented samples.
    pub budget: &'a mut Budget,
    /// Where losses are told.
    pub journal: &'a mut Journal,
    /// Room for deliveries.
    pub quota: &'a mut DeliveryQuota,
    /// Who is there.
    pub graph: GraphView<'a>,
}

impl Subscribers {
    /// Entries, or bytes, and cap of every list; of what deliveries have each, one after the other.
    /// How many deliveries there may be is in [`DeliveryQuota`].
    pub fn sizes(&self) -> impl Iterator<Item = Size> {
        // A new list does not compile before it has a place here.
        let Self {
            routes,
            deliveries,
            open: _,
            totals: _,
            departures,
            acknowledgements,
            reassembled: _,
            at_socket: _,
            generation: _,
            sure_from: _,
        } = self;
        let own = routes.sizes().into_iter().chain(departures.sizes());
        let own = own.chain(acknowledgements.sizes());
        own.chain(deliveries.iter().flat_map(Delivery::sizes))
    }

    /// None yet, of a writer that the kernel meters from `sure_from` on.
    #[must_use]
    pub fn new(sure_from: Timestamp) -> Self {
        Self {
            sure_from,
            ..Self::default()
        }
    }

    /// Every delivery with the routes that lead to it.
    pub fn deliveries(&self) -> impl Iterator<Item = (&Delivery, Vec<&KnownRoute>)> {
        self.deliveries.iter().map(|delivery| {
            let leads_there = |known: &&KnownRoute| match delivery.receiver() {
                Receiver::Route(route) => known.route == route,
                Receiver::Participant(prefix) => {
                    known.route.direction == Direction::Received && known.owner == Some(prefix)
                }
            };
            (delivery, self.routes.iter().filter(leads_there).collect())
        })
    }

    /// Sums over all deliveries, also those that are no more.
    #[must_use]
    pub const fn totals(&self) -> &Totals {
        &self.totals
    }

    /// Routes and readers for which there was no room.
    #[must_use]
    pub const fn refused(&self) -> u64 {
        self.routes.evictions() + self.acknowledgements.refused
    }

    /// What the readers acknowledged of `writer`, whose next sample will be `next`.
    pub fn acknowledgements(
        &self,
        writer: Guid,
        next: SequenceNumber,
        now: Timestamp,
    ) -> impl Iterator<Item = AcknowledgementFacts> + '_ {
        self.acknowledgements.facts(writer, next, now)
    }

    /// Takes in a record of the writer, or an ACKNACK for it.
    pub fn record(&mut self, record: &Record, context: &mut WriterContext<'_>) -> RecordNovelty {
        self.refresh(context);
        let body = record.body();
        if let Body::AckNack(acknack) = body {
            self.requested(acknack);
            let is_reader = |topic: &Topic| is_reader(topic, record.reader());
            if context.topic().is_some_and(is_reader) {
                self.acknowledgements.acknack(acknack);
                self.acknowledged(acknack);
            }
            return RecordNovelty::New;
        }
        if record.flags & flag::NOT_REASSEMBLED != 0 {
            if let Body::Sample(sample) = body {
                self.not_reassembled(sample, context);
            }
            return RecordNovelty::New;
        }
        self.reassembled |= record.flags & flag::HOST != 0 && record.datagram_len > ONE_FRAME;
        let route = Route::of(record);
        match body {
            Body::Sample(_) => {}
            Body::Heartbeat(_) | Body::Gap(_) if !route.is_sent() => {}
            _ => return RecordNovelty::New,
        }
        let is_host = record.flags & flag::HOST != 0;
        if !is_host && self.at_socket && self.routes.is_at_socket(route.destination) {
            return RecordNovelty::SeenAtSocket;
        }
        let topic = context.topic();
        let mut index = self
            .routes
            .find_or_insert(route, context.now, &context.graph, topic);
        if let Some(known) = self.routes.get_mut(index) {
            known.last_seen = known.last_seen.max(context.now);
            if is_host && !known.at_socket {
                known.at_socket = true;
                self.uncover(route, context);
                index = self.routes.find(&route).unwrap_or(index);
            }
        }
        let came_again = match body {
            Body::Sample(sample) if route.is_sent() => self.leave(index, sample, context),
            _ => self.arrive(index, record, body, context),
        };
        if came_again {
            RecordNovelty::Duplicate
        } else {
            RecordNovelty::New
        }
    }

    /// All readers that acknowledge have all samples below this number; `None` if none does.
    #[must_use]
    pub fn acknowledged_below(&self) -> Option<SequenceNumber> {
        self.acknowledgements.floor(|_| true)
    }

    /// The writer's newest sample is this one.
    pub fn wrote(&mut self, number: SequenceNumber, at: Timestamp) {
        self.acknowledgements.wrote(number, at);
    }

    /// A sample on its way out.
    fn leave(&mut self, index: usize, sample: Sample<'_>, context: &mut WriterContext<'_>) -> bool {
        let Some(route) = self.routes.get(index).map(|known| known.route) else {
            return false;
        };
        self.totals.seen[1] = true;
        let source = sample.source_timestamp().timestamp();
        let began = context.graph.wall_clock.wall_time(sample.record().began());
        // One clock: what leaves before its timestamp, or hours after, is no matter of sending.
        if let Some(source) = source.filter(|_| sample.is_start())
            && let Ok(delay) = u64::try_from(began.nanoseconds_since(source))
            && delay <= PLAUSIBLE
            && self.departures.is_first(source)
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
        record: &Record,
        body: Body<'_>,
        context: &mut WriterContext<'_>,
    ) -> bool {
        self.totals.seen[0] = true;
        let Some((receiver, matched)) = self.receiver(index, record, context) else {
            return false;
        };
        if matched == Matched::No {
            if let Body::Sample(sample) = body
                && sample.is_message()
                && sample.is_end()
                && record.flags & flag::NO_ROOM == 0
            {
                let place = self.find(receiver);
                match place.and_then(|place| self.deliveries.get_mut(place)) {
                    Some(delivery) => delivery.ignore(&mut self.totals),
                    None => self.totals.received.unmatched += 1,
                }
            }
            return false;
        }
        match body {
            Body::Sample(sample) => return self.sample(index, receiver, sample, context),
            Body::Heartbeat(heartbeat) => {
                self.heartbeat(index, (receiver, matched), heartbeat, context);
            }
            Body::Gap(gap) => self.gap(index, receiver, gap, context),
            _ => {}
        }
        false
    }

    /// Who gets what came by this route, and whether it reads the topic.
    fn receiver(
        &mut self,
        index: usize,
        record: &Record,
        context: &mut WriterContext<'_>,
    ) -> Option<(Receiver, Matched)> {
        let directed = Some(record.reader().prefix).filter(|to| *to != GuidPrefix::UNKNOWN);
        let (graph, topic) = (context.graph, context.topic());
        let known = self.routes.get_mut(index)?;
        let is_multicast = known.route.destination.is_multicast();
        if let Some(prefix) = directed.filter(|_| !is_multicast) {
            if known.route.socket != 0 && known.owner.is_some_and(|owner| owner != prefix) {
                // Whoever lives here passes it over.
                return None;
            }
            known.note_directed(prefix, &graph, topic);
            let matched = if known.owner == Some(prefix) {
                known.matched
            } else {
                graph.matched(topic, prefix)
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
                if let Some(sample) = record.sample() {
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
        sample: Sample<'_>,
        context: &mut WriterContext<'_>,
    ) -> bool {
        let no_room = sample.record().flags & flag::NO_ROOM != 0;
        let route = self.routes.get(index).map(|known| known.route);
        if route.is_some_and(|route| self.is_repair_elsewhere(route, receiver, sample)) {
            return false;
        }
        let is_open = |receiver| matches!(receiver, Receiver::Route(route) if route.is_open());
        if self.open > 0 && !is_open(receiver) {
            let is_known = !no_room && self.repair(sample, context);
            if (is_known || no_room) && self.find(receiver).is_none() {
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
        if no_room {
            delivery.no_room(
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
            self.came(index, place, &whole, context.now);
        }
        again
    }

    /// A sample came whole this route.
    fn came(&mut self, index: usize, place: usize, whole: &Whole, now: Timestamp) {
        self.transfer(whole, now);
        let Some(known) = self.routes.get_mut(index).filter(|_| !whole.recovered) else {
            return;
        };
        let route = known.route;
        known.brought += u64::from(whole.newest);
        let brought = known.brought;
        if let Some(left) = self.departures.find(whole.number, route.destination)
            && now >= left
        {
            let transit = now.nanoseconds_since(left);
            self.breakdown().transit.observe(seconds(transit));
        }
        let Some(delivery) = self.deliveries.get_mut(place) else {
            return;
        };
        if delivery.main() != route {
            let main = self.routes.find(&delivery.main());
            let main = main.and_then(|index| self.routes.get(index));
            if main.is_none_or(|main| main.brought < brought) {
                delivery.move_to(route);
            }
        }
    }

    /// Fills gaps of those that may be the receiver; whether any of them knows of the sample.
    fn repair(&mut self, sample: Sample<'_>, context: &mut WriterContext<'_>) -> bool {
        let number = sample.sequence_number();
        let mut is_known = false;
        for delivery in self.deliveries.iter_mut().filter(|each| is_open(each)) {
            is_known |= delivery.next() > number;
            if delivery.misses(number) {
                delivery.sample(
                    sample,
                    &mut delivery_context(&mut self.totals, self.reassembled, context),
                );
            }
        }
        is_known
    }

    /// On a wire, by unicast, to somebody of whom nothing else is known, of a sample that has come
    /// to a socket of this host as multicast: a repair for another host that got the multicast too.
    fn is_repair_elsewhere(&self, route: Route, receiver: Receiver, sample: Sample<'_>) -> bool {
        let is_at_socket = |route: Route| route.is_open() && route.socket != 0;
        route.socket == 0
            && self.at_socket
            && !route.destination.is_multicast()
            && self.find(receiver).is_none()
            && self.deliveries.iter().any(|delivery| {
                is_at_socket(delivery.main()) && delivery.next() > sample.sequence_number()
            })
    }

    /// Lets deliveries that may be the same receiver's know of each other's samples.
    fn share(&mut self, place: usize, next: SequenceNumber, whole: Option<SequenceNumber>) {
        let Some(delivery) = self.deliveries.get(place) else {
            return;
        };
        if is_open(delivery) {
            let Some(number) = whole.filter(|_| self.open < self.deliveries.len()) else {
                return;
            };
            for other in &mut self.deliveries {
                if !other.main().is_sent() && !is_open(other) && other.misses(number) {
                    other.know(number, &mut self.totals);
                }
            }
            return;
        }
        let end = delivery.next().min(next.saturating_add(LOOK_BACK));
        if next == SequenceNumber::ZERO || end <= next + 1 {
            return;
        }
        let missing = next.until(end).filter(|number| delivery.misses(*number));
        let has = |number: &SequenceNumber| {
            let mut others = self.deliveries.iter().filter(|each| is_open(each));
            others.any(|other| other.misses(*number) || other.has(*number))
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

    /// The delivery of this receiver, begun if there is none and there is room.
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
        let route = known.route;
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
                delivery.learn(is_best_effort(receiver, context));
                delivery.allow_incomplete(self.sure_from);
                self.deliveries.push(delivery);
                self.count_open();
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

    fn breakdown(&mut self) -> &mut Breakdown {
        self.totals.breakdown.get_or_insert_default()
    }

    fn transfer(&mut self, whole: &Whole, now: Timestamp) {
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
}

fn is_open(delivery: &Delivery) -> bool {
    matches!(delivery.receiver(), Receiver::Route(route) if route.is_open())
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
