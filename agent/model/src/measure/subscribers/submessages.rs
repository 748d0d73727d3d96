//! HEARTBEAT, GAP and ACKNACK handling, and datagrams that failed IP reassembly.

use super::Subscribers;
use super::WriterContext;
use super::delivery_context;
use super::is_open;
use crate::facts::observation::{AckNack, Gap, Heartbeat, Sample};
use crate::facts::route::Receiver;
use crate::measure::receivers::Matched;
use crate::measure::routes::KnownRoute;

impl Subscribers {
    /// Processes a HEARTBEAT on this route.
    pub(super) fn heartbeat(
        &mut self,
        index: usize,
        (receiver, matched): (Receiver, Matched),
        heartbeat: &Heartbeat,
        context: &mut WriterContext<'_>,
    ) {
        let Some(known) = self.routes.get(index) else {
            return;
        };
        let is_known = matched == Matched::Yes && matches!(receiver, Receiver::Participant(_));
        // Without a known receiver, the route must have carried samples.
        let holds = known.has_data || is_known;
        let is_meant = heartbeat.head.directed_at().is_some();
        let opens = is_known && (is_meant || !known.route.destination.is_multicast());
        let place = match self.find(receiver) {
            None if opens => self.delivery(index, receiver, context),
            found => found,
        };
        let Some(delivery) = place.and_then(|place| self.deliveries.get_mut(place)) else {
            return;
        };
        if is_meant || holds {
            let mut context = delivery_context(&mut self.totals, self.reassembled, context);
            delivery.heartbeat(heartbeat, &mut context);
        }
    }

    /// Processes a GAP on this route.
    pub(super) fn gap(
        &mut self,
        index: usize,
        receiver: Receiver,
        gap: &Gap,
        context: &mut WriterContext<'_>,
    ) {
        let Some(known) = self.routes.get(index) else {
            return;
        };
        if !known.route.destination.is_multicast() && self.open > 0 {
            for delivery in self.deliveries.iter_mut().filter(|each| is_open(each)) {
                let mut context = delivery_context(&mut self.totals, self.reassembled, context);
                delivery.gap(gap, &mut context);
            }
        }
        let place = self.find(receiver);
        if let Some(delivery) = place.and_then(|place| self.deliveries.get_mut(place)) {
            let mut context = delivery_context(&mut self.totals, self.reassembled, context);
            delivery.gap(gap, &mut context);
        }
    }

    /// Processes a request of a reader: samples that fill its gaps afterwards are retransmissions.
    pub(super) fn requested(&mut self, acknack: &AckNack) {
        let reader = acknack.head.reader.prefix;
        for delivery in &mut self.deliveries {
            if is_open(delivery) || delivery.receiver() == Receiver::Participant(reader) {
                delivery.requested(acknack);
            }
        }
    }

    /// Processes an acknowledgement. Samples that all readers of a participant acknowledge have
    /// arrived, even if they were not observed.
    pub(super) fn acknowledged(&mut self, acknack: &AckNack) {
        let prefix = acknack.head.reader.prefix;
        let below = self.acknowledgements.floor(|guid| guid.prefix == prefix);
        for delivery in &mut self.deliveries {
            let below = match delivery.receiver() {
                Receiver::Participant(receiver) if receiver == prefix => below,
                Receiver::Route(route) if route.is_open() => self.acknowledgements.floor(|_| true),
                _ => None,
            };
            if let Some(below) = below {
                delivery.acknowledged(below);
            }
        }
    }

    /// Processes a sample in a datagram that failed IP reassembly.
    pub(super) fn not_reassembled(&mut self, sample: &Sample, context: &mut WriterContext<'_>) {
        self.reassembled = true;
        let destination = sample.head.destination;
        let directed = sample.head.directed_at();
        let has_readers = self.has_readers;
        for delivery in &mut self.deliveries {
            let leads_there = |known: &KnownRoute| {
                !known.route.is_sent()
                    && known.route.destination == destination
                    && match delivery.receiver() {
                        Receiver::Route(route) => {
                            known.route == route && (route.socket != 0 || has_readers)
                        }
                        Receiver::Participant(prefix) => {
                            known.owner == Some(prefix)
                                && known.matched == Matched::Yes
                                && directed.is_none_or(|to| to == prefix)
                        }
                    }
            };
            if self.routes.iter().any(leads_there) {
                let number = sample.sequence_number;
                delivery.not_reassembled(
                    number,
                    &mut delivery_context(&mut self.totals, self.reassembled, context),
                );
            }
        }
    }
}
