//! What time and discovery do to deliveries: gaps settle, sockets get owners, receivers come and go.

use ros2probe_wire::Timestamp;
use ros2probe_wire::qos::Reliability;
use ros2probe_wire::time::SECOND;

use super::{Stage, Subscribers, is_reader, scene};
use crate::delivery::{Delivery, Receiver, Totals};
use crate::receivers::{Matched, readers};
use crate::way::Way;

/// A way by which nothing came for so long is forgotten, unless a reader is known at its end.
const FORGET: u64 = 60 * SECOND;

impl Subscribers {
    /// Settles what has waited long enough and forgets what has been silent for long.
    pub fn advance(&mut self, stage: &mut Stage<'_>) {
        self.refresh(stage);
        let now = stage.now;
        for delivery in &mut self.deliveries {
            delivery.advance(&mut scene(&mut self.totals, self.reassembled, stage));
        }
        self.expect(stage, false);
        if now.0.is_multiple_of(SECOND) {
            self.ways.retain(|known| {
                known.matched == Matched::Yes || known.last_seen.0.saturating_add(FORGET) > now.0
            });
            self.drop_orphans(stage);
        }
    }

    /// Settles everything: nothing more will come.
    pub fn settle(&mut self, stage: &mut Stage<'_>) {
        self.expect(stage, true);
        for delivery in &mut self.deliveries {
            delivery.settle(&mut scene(&mut self.totals, self.reassembled, stage));
        }
    }

    /// Settles everything, gives back the room and tells what was counted.
    pub fn stop(mut self, stage: &mut Stage<'_>) -> Totals {
        self.settle(stage);
        stage.room.used = stage.room.used.saturating_sub(self.deliveries.len());
        self.totals
    }

    /// When each delivery was last heard of that nobody would miss, for making room.
    pub fn silent_since(&self) -> impl Iterator<Item = Timestamp> + '_ {
        self.deliveries.iter().map(|delivery| delivery.seen().1)
    }

    /// Gives up the deliveries that were last heard of by then, at most `count`; how many.
    pub fn give_up(&mut self, until: Timestamp, count: usize, stage: &mut Stage<'_>) -> usize {
        let mut left = count;
        self.remove(stage, |delivery| {
            let goes = left > 0 && delivery.seen().1 <= until;
            left -= usize::from(goes);
            goes
        });
        stage.room.evictions += (count - left) as u64;
        count - left
    }

    /// Looks whether what left this host for a receiver on it has arrived.
    fn expect(&mut self, stage: &mut Stage<'_>, no_more: bool) {
        if !self.totals.seen[1] || !self.totals.seen[0] {
            return;
        }
        for index in 0..self.deliveries.len() {
            let Some(delivery) = self.deliveries.get(index) else {
                return;
            };
            let (main, next) = (delivery.main(), delivery.next());
            let Some(at) = self.ways.find(&main) else {
                continue;
            };
            if main.is_sent() {
                if let Some(known) = self.ways.get_mut(at).filter(|_| next > 0) {
                    known.mark(next - 1, stage.now);
                }
                continue;
            }
            if self
                .ways
                .get(at)
                .is_none_or(|known| known.matched == Matched::No)
            {
                continue;
            }
            let Some(leaving) = self.ways.leaving(main.place) else {
                continue;
            };
            let left = self.find(Receiver::Way(leaving.way));
            let Some(left) = left.and_then(|left| self.deliveries.get(left)) else {
                continue;
            };
            let Some(newest) = left.next().checked_sub(1) else {
                continue;
            };
            let alive = match delivery.receiver() {
                Receiver::Participant(prefix) => {
                    let participant = stage.around.discovery.participants().get(&prefix);
                    participant.map(|participant| participant.last_seen)
                }
                Receiver::Way(_) => None,
            };
            let mut scene = scene(&mut self.totals, self.reassembled, stage);
            let Some(delivery) = self.deliveries.get_mut(index) else {
                return;
            };
            if no_more {
                delivery.expect_no_more(newest, &mut scene);
            } else {
                delivery.expect(newest, alive, |at| leaving.left_by(at), &mut scene);
            }
        }
    }

    /// What came this way so far was seen on a wire; from now on it is seen at a socket.
    pub(super) fn uncover(&mut self, way: Way, stage: &mut Stage<'_>) {
        self.at_socket = true;
        let place = way.place;
        let before = self.ways.iter().count();
        self.ways
            .retain(|known| known.at_socket || known.way.place != place);
        if self.ways.iter().count() < before {
            self.drop_orphans(stage);
        }
    }

    /// Finds out anew who is where, if anything changed.
    pub(super) fn refresh(&mut self, stage: &mut Stage<'_>) {
        let (around, topic) = (stage.around, stage.topic());
        if self.generation == around.receivers.generation() {
            return;
        }
        self.generation = around.receivers.generation();
        let before = self.ways.iter().count();
        self.ways
            .retain(|known| !around.receivers.is_closed(known.way.socket));
        let closed = before > self.ways.iter().count();
        for known in self.ways.iter_mut() {
            known.resolve(&around, topic);
        }
        self.identify(stage);
        if closed {
            self.drop_orphans(stage);
        }
        for delivery in &mut self.deliveries {
            if let Receiver::Participant(prefix) = delivery.receiver()
                && around.matched(topic, prefix) == Matched::No
            {
                delivery.close(stage.budget);
            }
            delivery.learn(is_best_effort(delivery.receiver(), stage));
            let appeared = match delivery.receiver() {
                Receiver::Participant(prefix) => topic.and_then(|topic| {
                    let known = |guid| around.discovery.endpoints().get(&guid);
                    readers(topic, prefix)
                        .filter_map(|guid| Some(known(guid)?.first_seen))
                        .min()
                }),
                Receiver::Way(_) => topic.map(|topic| topic.reader_appeared),
            };
            if let Some(at) = appeared.filter(|at| *at > delivery.seen().1) {
                delivery.open(at);
            }
        }
        self.acknowledgements
            .retain(|guid| topic.is_some_and(|topic| is_reader(topic, guid)));
    }

    /// Puts ways together that turned out to lead to one participant.
    fn identify(&mut self, stage: &mut Stage<'_>) {
        let mut index = 0;
        while let Some(delivery) = self.deliveries.get(index) {
            index += 1;
            let Receiver::Way(way) = delivery.receiver() else {
                continue;
            };
            let known = self.ways.find(&way).and_then(|at| self.ways.get(at));
            let owner = known
                .filter(|_| !way.is_sent())
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
                stage.room.used = stage.room.used.saturating_sub(1);
                if let Some(delivery) = self.deliveries.get_mut(keeps) {
                    delivery.identify(owner);
                    delivery.absorb(gone, &mut scene(&mut self.totals, self.reassembled, stage));
                }
                index = 0;
            } else if let Some(delivery) = self.deliveries.get_mut(place) {
                delivery.identify(owner);
            }
        }
        self.count_open();
    }

    /// Gives up deliveries to which no way leads any more.
    fn drop_orphans(&mut self, stage: &mut Stage<'_>) {
        let led_to: Vec<_> = self
            .deliveries()
            .map(|(_, ways)| !ways.is_empty())
            .collect();
        for (delivery, is_led_to) in self.deliveries.iter_mut().zip(&led_to) {
            if !is_led_to {
                delivery.close(stage.budget);
            }
        }
        let mut led_to = led_to.into_iter();
        self.remove(stage, |_| !led_to.next().unwrap_or(false));
    }

    fn remove(&mut self, stage: &mut Stage<'_>, mut goes: impl FnMut(&Delivery) -> bool) {
        let before = self.deliveries.len();
        let (totals, reassembled) = (&mut self.totals, self.reassembled);
        self.deliveries.retain_mut(|delivery| {
            let goes = goes(delivery);
            if goes {
                delivery.settle(&mut scene(totals, reassembled, stage));
            }
            !goes
        });
        let gone = before - self.deliveries.len();
        if gone > 0 {
            stage.room.used = stage.room.used.saturating_sub(gone);
            self.ways.iter_mut().for_each(|known| known.delivery = None);
            self.count_open();
        }
    }
}

/// Whether readers are known there and none of them is reliable.
pub(super) fn is_best_effort(receiver: Receiver, stage: &Stage<'_>) -> bool {
    let (Receiver::Participant(prefix), Some(topic)) = (receiver, stage.topic()) else {
        return false;
    };
    let endpoints = stage.around.discovery.endpoints();
    let known = readers(topic, prefix).filter_map(|guid| endpoints.get(&guid));
    let mut known = known.map(|endpoint| endpoint.qos.reliability == Reliability::RELIABLE);
    known.next() == Some(false) && !known.any(|is_reliable| is_reliable)
}
