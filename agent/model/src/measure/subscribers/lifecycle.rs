//! Effects of time and discovery on deliveries: gaps settle, sockets get owners, receivers appear
//! and vanish.

use std::time::Duration;

use ros2probe_wire::time::SECOND;
use ros2probe_wire::{GuidPrefix, SequenceNumber};

use super::Subscribers;
use super::WriterContext;
use super::addressee;
use super::delivery_context;
use super::is_best_effort;
use super::is_reader;
use super::is_unknown;
use crate::facts::loss_share::LossShare;
use crate::facts::model_time::ModelTime;
use crate::facts::route::Receiver;
use crate::facts::route::Route;
use crate::measure::delivery::{Delivery, Totals};
use crate::measure::receivers::Matched;

/// A route is dropped after this long without an observation, unless it leads to a known reader.
const ROUTE_TIMEOUT: Duration = Duration::from_secs(60);

impl Subscribers {
    /// Settles the samples for which the settle window is over, and drops routes after a long
    /// silence.
    pub fn advance(&mut self, context: &mut WriterContext<'_>) {
        self.refresh(context);
        let now = context.now;
        for delivery in &mut self.deliveries {
            delivery.advance(&mut delivery_context(
                &mut self.totals,
                self.reassembled,
                context,
            ));
        }
        self.expect(context, false);
        if now.nanoseconds().is_multiple_of(SECOND) {
            self.deliveries.iter_mut().for_each(Delivery::end_second);
            self.routes.retain(|known| {
                known.matched == Matched::Yes || known.last_seen + ROUTE_TIMEOUT > now
            });
            self.drop_routeless(context);
        }
    }

    /// Returns the time from which [`Self::advance`] has an effect without an observation, after a
    /// call at `now`; [`ModelTime::MAX`] if never. `reliable` is that of the context.
    #[must_use]
    pub fn next_due(&self, reliable: bool, now: ModelTime) -> ModelTime {
        let own = self.deliveries.iter().map(|each| each.next_due(reliable));
        let marks = self.deliveries.iter().filter_map(|delivery| {
            let known = self.routes.get(self.routes.find(&delivery.main_route())?)?;
            let is_marked = delivery.main_route().is_sent() && self.totals.seen == [true, true];
            is_marked.then(|| known.next_mark(delivery.next().previous()))
        });
        let times = own.chain(marks).chain([self.next_second(now)]);
        times.min().unwrap_or(ModelTime::MAX)
    }

    /// Returns the next whole second whose end has an effect. Between two whole seconds it is the
    /// next one, because an observation in between may have changed anything.
    fn next_second(&self, now: ModelTime) -> ModelTime {
        let second = ModelTime::of_second(now.whole_seconds() + 1);
        let is_open = !now.nanoseconds().is_multiple_of(SECOND);
        if is_open || !self.deliveries.iter().all(Delivery::is_quiet) {
            return second;
        }
        let unmatched = self
            .routes
            .iter()
            .filter(|known| known.matched != Matched::Yes);
        let oldest = unmatched.map(|known| known.last_seen).min();
        oldest.map_or(ModelTime::MAX, |oldest| oldest + ROUTE_TIMEOUT)
    }

    /// Settles all samples at the end of the input.
    pub fn settle(&mut self, context: &mut WriterContext<'_>) {
        self.expect(context, true);
        for delivery in &mut self.deliveries {
            delivery.settle(&mut delivery_context(
                &mut self.totals,
                self.reassembled,
                context,
            ));
        }
    }

    /// Ends the last second of the recent losses at the end of the input.
    pub fn end_second(&mut self) {
        self.deliveries.iter_mut().for_each(Delivery::end_second);
    }

    /// Settles all samples and releases the quota. Returns the counts, and the losses of the worst
    /// receiver in this second.
    pub fn stop(mut self, context: &mut WriterContext<'_>) -> (Totals, LossShare) {
        self.settle(context);
        for delivery in &mut self.deliveries {
            if delivery.is_withheld() {
                delivery.discard(context.budget, &mut self.totals);
            }
        }
        context.quota.used = context.quota.used.saturating_sub(self.deliveries.len());
        let shares = self.received().map(Delivery::last_share);
        let worst = shares.chain([self.departed]).max_by_key(|share| share.lost);
        (self.totals, worst.unwrap_or_default())
    }

    /// Returns the time of the last observation of each delivery.
    pub fn last_seen_times(&self) -> impl Iterator<Item = ModelTime> + '_ {
        self.deliveries.iter().map(|delivery| delivery.seen().1)
    }

    /// Drops at most `count` deliveries whose last observation is not after `until`. Returns the
    /// number of dropped deliveries.
    pub fn drop_oldest(
        &mut self,
        until: ModelTime,
        count: usize,
        context: &mut WriterContext<'_>,
    ) -> usize {
        let mut left = count;
        self.remove(context, |delivery| {
            let goes = left > 0 && delivery.seen().1 <= until;
            left -= usize::from(goes);
            goes
        });
        context.quota.evictions += (count - left) as u64;
        count - left
    }

    /// Checks whether samples that left this host for a local receiver have arrived.
    fn expect(&mut self, context: &mut WriterContext<'_>, no_more: bool) {
        if !self.totals.seen[1] || !self.totals.seen[0] {
            return;
        }
        for index in 0..self.deliveries.len() {
            let Some(delivery) = self.deliveries.get(index) else {
                return;
            };
            let (main, next) = (delivery.main_route(), delivery.next());
            let Some(at) = self.routes.find(&main) else {
                continue;
            };
            if main.is_sent() {
                if let Some(known) = self
                    .routes
                    .get_mut(at)
                    .filter(|_| next > SequenceNumber::ZERO)
                {
                    known.note_departure(next.previous(), context.now);
                }
                continue;
            }
            let known = self.routes.get(at);
            let is_wire = main.socket == 0 && !self.has_readers;
            if is_wire || known.is_none_or(|known| known.matched == Matched::No) {
                continue;
            }
            let Some(leaving) = self.routes.outgoing(main.destination) else {
                continue;
            };
            let left = self.find(Receiver::Route(leaving.route));
            let Some(left) = left.and_then(|left| self.deliveries.get(left)) else {
                continue;
            };
            if left.next() == SequenceNumber::ZERO {
                continue;
            }
            let newest = left.next().previous();
            let alive = match delivery.receiver() {
                Receiver::Participant(prefix) => {
                    let participant = context.graph.discovery.participants().get(&prefix);
                    participant.map(|participant| participant.last_seen)
                }
                Receiver::Route(_) => None,
            };
            let mut context = delivery_context(&mut self.totals, self.reassembled, context);
            let Some(delivery) = self.deliveries.get_mut(index) else {
                return;
            };
            if no_more {
                delivery.settle_departed(newest, &mut context);
            } else {
                delivery.expect(newest, alive, |at| leaving.departed_by(at), &mut context);
            }
        }
    }

    /// Drops the routes of this destination that were observed on a wire, because it is now
    /// observed at a socket.
    pub(super) fn drop_wire_routes(&mut self, route: Route, context: &mut WriterContext<'_>) {
        self.at_socket = true;
        let destination = route.destination;
        let before = self.routes.iter().count();
        self.routes
            .retain(|known| known.at_socket || known.route.destination != destination);
        if self.routes.iter().count() < before {
            self.drop_routeless(context);
        }
    }

    /// Updates the receivers of all routes if the facts have changed.
    pub(super) fn refresh(&mut self, context: &mut WriterContext<'_>) {
        let (graph, topic, readers) = (context.graph, context.topic(), context.readers());
        if self.generation == graph.receivers.generation() {
            return;
        }
        self.generation = graph.receivers.generation();
        self.has_readers = readers.any();
        let before = self.routes.iter().count();
        self.routes
            .retain(|known| !graph.receivers.is_closed(known.route.socket));
        let closed = before > self.routes.iter().count();
        for known in self.routes.iter_mut() {
            known.resolve(readers);
        }
        self.identify(context);
        if closed {
            self.drop_routeless(context);
        }
        for delivery in &mut self.deliveries {
            let is_left = match delivery.receiver() {
                Receiver::Participant(prefix) => readers.matched(prefix) != Matched::Yes,
                Receiver::Route(route) => !route.is_sent() && !self.has_readers,
            };
            if is_left {
                delivery.close(context.budget);
            }
            let receiver = delivery.receiver();
            let known = self.routes.find(&delivery.main_route());
            let owner = known.and_then(|at| self.routes.get(at)?.owner);
            let is_filtered = readers.are_filtered(addressee(receiver, owner));
            delivery.learn(is_best_effort(receiver, readers), is_filtered);
            let appeared = match delivery.receiver() {
                Receiver::Participant(prefix) => readers.since(prefix),
                Receiver::Route(_) => topic.map(|topic| topic.reader_appeared),
            };
            if let Some(at) = appeared.filter(|at| *at > delivery.seen().1) {
                delivery.open(at);
            }
        }
        self.note_filters();
        self.acknowledgements
            .retain(|guid| topic.is_some_and(|topic| is_reader(topic, guid)));
    }

    /// Assigns deliveries to the participants to which their routes lead, and merges deliveries of
    /// one participant. Samples from before the announcement of its reader do not belong to it.
    fn identify(&mut self, context: &mut WriterContext<'_>) {
        let readers = context.readers();
        let mut index = 0;
        while let Some(delivery) = self.deliveries.get_mut(index) {
            index += 1;
            let Receiver::Route(route) = delivery.receiver() else {
                continue;
            };
            let known = self.routes.find(&route).and_then(|at| self.routes.get(at));
            let Some(known) = known.filter(|_| !route.is_sent()) else {
                continue;
            };
            let Some(owner) = known.owner else {
                if known.is_shared {
                    delivery.publish(context.journal, &mut self.totals);
                }
                continue;
            };
            let place = index - 1;
            if is_unknown(delivery.receiver()) {
                let since = readers.since(owner);
                if since.is_none_or(|since| since > delivery.seen().0) {
                    self.discard(place, context);
                    index = 0;
                    continue;
                }
            }
            if self.identify_delivery(place, owner, context) {
                index = 0;
            }
        }
        self.count_open();
    }

    /// Records the participant of a delivery, merges it with another one of that participant, and
    /// publishes its counts. Returns whether they were merged.
    fn identify_delivery(
        &mut self,
        place: usize,
        owner: GuidPrefix,
        context: &mut WriterContext<'_>,
    ) -> bool {
        let Some(other) = self.find(Receiver::Participant(owner)) else {
            if let Some(delivery) = self.deliveries.get_mut(place) {
                delivery.identify(owner);
                delivery.publish(context.journal, &mut self.totals);
            }
            return false;
        };
        // Before both were known as one receiver, a sample may have arrived by either route.
        let of_both = self.deliveries.get(place).zip(self.deliveries.get(other));
        let common = of_both.map_or(0, |(one, other)| one.count_common(other));
        if let Some(delivery) = self.deliveries.get_mut(place) {
            delivery.count_common_as_duplicates(
                common,
                &mut delivery_context(&mut self.totals, self.reassembled, context),
            );
            delivery.publish(context.journal, &mut self.totals);
        }
        let messages = |place: usize| {
            let delivery = self.deliveries.get(place);
            delivery.map_or(0, |delivery| delivery.tally().messages)
        };
        let (keeps, goes) = if messages(place) > messages(other) {
            (place, other)
        } else {
            (other, place)
        };
        let gone = self.deliveries.remove(goes);
        let keeps = keeps - usize::from(goes < keeps);
        context.quota.used = context.quota.used.saturating_sub(1);
        if let Some(delivery) = self.deliveries.get_mut(keeps) {
            delivery.identify(owner);
            delivery.absorb(
                gone,
                &mut delivery_context(&mut self.totals, self.reassembled, context),
            );
        }
        true
    }

    /// Continues the delivery at an unknown socket as the delivery of this route, which has the
    /// same destination. The receiving socket of a Zenoh connection is known once its session is
    /// known.
    pub(super) fn learn_socket(&mut self, route: Route, context: &mut WriterContext<'_>) {
        let Some(unknown) = self.routes.learn_socket(route, context.readers()) else {
            return;
        };
        self.routes
            .iter_mut()
            .for_each(|known| known.delivery = None);
        let owner = self.routes.find(&route).and_then(|at| self.routes.get(at));
        let owner = owner.and_then(|known| known.owner);
        for delivery in &mut self.deliveries {
            if delivery.main_route() == unknown {
                delivery.move_to(route);
            }
        }
        let Some(place) = self.find(Receiver::Route(unknown)) else {
            return;
        };
        match owner {
            Some(owner) => {
                self.identify_delivery(place, owner, context);
            }
            None => {
                if let Some(delivery) = self.deliveries.get_mut(place) {
                    delivery.set_route(route);
                }
            }
        }
        self.count_open();
    }

    /// Drops a delivery that turned out to belong to a participant without a reader.
    fn discard(&mut self, place: usize, context: &mut WriterContext<'_>) {
        let mut delivery = self.deliveries.remove(place);
        delivery.discard(context.budget, &mut self.totals);
        context.quota.used = context.quota.used.saturating_sub(1);
        self.routes
            .iter_mut()
            .for_each(|known| known.delivery = None);
    }

    /// Drops deliveries without a route.
    fn drop_routeless(&mut self, context: &mut WriterContext<'_>) {
        let led_to: Vec<_> = self
            .with_routes()
            .map(|(_, routes)| !routes.is_empty())
            .collect();
        for (delivery, is_led_to) in self.deliveries.iter_mut().zip(&led_to) {
            if !is_led_to {
                delivery.close(context.budget);
            }
        }
        let mut led_to = led_to.into_iter();
        self.remove(context, |_| !led_to.next().unwrap_or(false));
    }

    fn remove(&mut self, context: &mut WriterContext<'_>, mut goes: impl FnMut(&Delivery) -> bool) {
        let before = self.deliveries.len();
        let (totals, reassembled) = (&mut self.totals, self.reassembled);
        let departed = &mut self.departed;
        self.deliveries.retain_mut(|delivery| {
            let goes = goes(delivery);
            if goes && delivery.is_withheld() {
                delivery.discard(context.budget, totals);
            } else if goes {
                delivery.settle(&mut delivery_context(totals, reassembled, context));
                let share = delivery.last_share();
                if !delivery.main_route().is_sent() && share.lost > departed.lost {
                    *departed = share;
                }
            }
            !goes
        });
        let gone = before - self.deliveries.len();
        if gone > 0 {
            context.quota.used = context.quota.used.saturating_sub(gone);
            self.routes
                .iter_mut()
                .for_each(|known| known.delivery = None);
            self.count_open();
            self.note_filters();
        }
    }
}
