//! Effects of time and discovery on deliveries: gaps settle, sockets get owners, receivers appear
//! and vanish.

use std::time::Duration;

use ros2probe_wire::qos::Reliability;
use ros2probe_wire::time::SECOND;
use ros2probe_wire::{SequenceNumber, Timestamp};

use super::{Subscribers, WriterContext, delivery_context, is_reader};
use crate::delivery::{Delivery, Receiver, Totals};
use crate::receivers::{Matched, readers};
use crate::route::Route;

/// A route is dropped after this long without a record, unless it leads to a known reader.
const ROUTE_TIMEOUT: Duration = Duration::from_secs(60);

impl Subscribers {
    /// Settles samples whose waiting time is over, and drops routes that have been silent for long.
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
        if now.0.is_multiple_of(SECOND) {
            self.routes.retain(|known| {
                known.matched == Matched::Yes || known.last_seen + ROUTE_TIMEOUT > now
            });
            self.drop_orphans(context);
        }
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

    /// Settles all samples, returns the quota, and returns the counts.
    pub fn stop(mut self, context: &mut WriterContext<'_>) -> Totals {
        self.settle(context);
        context.quota.used = context.quota.used.saturating_sub(self.deliveries.len());
        self.totals
    }

    /// Returns the time of the last record of each delivery that can be dropped for a new one.
    pub fn silent_since(&self) -> impl Iterator<Item = Timestamp> + '_ {
        self.deliveries.iter().map(|delivery| delivery.seen().1)
    }

    /// Drops at most `count` deliveries whose last record is not after this time; returns how many.
    pub fn give_up(
        &mut self,
        until: Timestamp,
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
            let (main, next) = (delivery.main(), delivery.next());
            let Some(at) = self.routes.find(&main) else {
                continue;
            };
            if main.is_sent() {
                if let Some(known) = self
                    .routes
                    .get_mut(at)
                    .filter(|_| next > SequenceNumber::ZERO)
                {
                    known.mark(next.previous(), context.now);
                }
                continue;
            }
            if self
                .routes
                .get(at)
                .is_none_or(|known| known.matched == Matched::No)
            {
                continue;
            }
            let Some(leaving) = self.routes.leaving(main.destination) else {
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
                delivery.expect_no_more(newest, &mut context);
            } else {
                delivery.expect(newest, alive, |at| leaving.left_by(at), &mut context);
            }
        }
    }

    /// Begins to observe a route at a socket that was observed on a wire so far.
    pub(super) fn uncover(&mut self, route: Route, context: &mut WriterContext<'_>) {
        self.at_socket = true;
        let destination = route.destination;
        let before = self.routes.iter().count();
        self.routes
            .retain(|known| known.at_socket || known.route.destination != destination);
        if self.routes.iter().count() < before {
            self.drop_orphans(context);
        }
    }

    /// Updates the receivers of all routes if the facts have changed.
    pub(super) fn refresh(&mut self, context: &mut WriterContext<'_>) {
        let (graph, topic) = (context.graph, context.topic());
        if self.generation == graph.receivers.generation() {
            return;
        }
        self.generation = graph.receivers.generation();
        let before = self.routes.iter().count();
        self.routes
            .retain(|known| !graph.receivers.is_closed(known.route.socket));
        let closed = before > self.routes.iter().count();
        for known in self.routes.iter_mut() {
            known.resolve(&graph, topic);
        }
        self.identify(context);
        if closed {
            self.drop_orphans(context);
        }
        for delivery in &mut self.deliveries {
            if let Receiver::Participant(prefix) = delivery.receiver()
                && graph.matched(topic, prefix) == Matched::No
            {
                delivery.close(context.budget);
            }
            delivery.learn(is_best_effort(delivery.receiver(), context));
            let appeared = match delivery.receiver() {
                Receiver::Participant(prefix) => topic.and_then(|topic| {
                    let known = |guid| graph.discovery.endpoints().get(&guid);
                    readers(topic, prefix)
                        .filter_map(|guid| Some(known(guid)?.first_seen))
                        .min()
                }),
                Receiver::Route(_) => topic.map(|topic| topic.reader_appeared),
            };
            if let Some(at) = appeared.filter(|at| *at > delivery.seen().1) {
                delivery.open(at);
            }
        }
        self.acknowledgements
            .retain(|guid| topic.is_some_and(|topic| is_reader(topic, guid)));
    }

    /// Merges the deliveries of routes that lead to the same participant.
    fn identify(&mut self, context: &mut WriterContext<'_>) {
        let mut index = 0;
        while let Some(delivery) = self.deliveries.get(index) {
            index += 1;
            let Receiver::Route(route) = delivery.receiver() else {
                continue;
            };
            let known = self.routes.find(&route).and_then(|at| self.routes.get(at));
            let owner = known
                .filter(|_| !route.is_sent())
                .and_then(|known| known.owner);
            let Some(owner) = owner else { continue };
            let place = index - 1;
            if let Some(other) = self.find(Receiver::Participant(owner)) {
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
                index = 0;
            } else if let Some(delivery) = self.deliveries.get_mut(place) {
                delivery.identify(owner);
            }
        }
        self.count_open();
    }

    /// Drops deliveries without a route.
    fn drop_orphans(&mut self, context: &mut WriterContext<'_>) {
        let led_to: Vec<_> = self
            .deliveries()
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
        self.deliveries.retain_mut(|delivery| {
            let goes = goes(delivery);
            if goes {
                delivery.settle(&mut delivery_context(totals, reassembled, context));
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
        }
    }
}

/// Returns whether the receiver has known readers, all of them best effort.
pub(super) fn is_best_effort(receiver: Receiver, context: &WriterContext<'_>) -> bool {
    let (Receiver::Participant(prefix), Some(topic)) = (receiver, context.topic()) else {
        return false;
    };
    let endpoints = context.graph.discovery.endpoints();
    let known = readers(topic, prefix).filter_map(|guid| endpoints.get(&guid));
    let mut known = known.map(|endpoint| endpoint.qos.reliability == Reliability::RELIABLE);
    known.next() == Some(false) && !known.any(|is_reliable| is_reliable)
}
