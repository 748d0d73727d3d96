//! What is said of samples without bringing any: HEARTBEAT, GAP, ACKNACK, and what the kernel gave up.

use ros2probe_wire::record::kind;
use ros2probe_wire::{GuidPrefix, Record};

use super::{Stage, Subscribers, is_open, scene};
use crate::delivery::Receiver;
use crate::receivers::Matched;
use crate::way::Place;
use crate::ways::Known;

impl Subscribers {
    /// A HEARTBEAT or GAP came this way.
    pub(super) fn told(
        &mut self,
        index: usize,
        (receiver, matched): (Receiver, Matched),
        record: &Record,
        stage: &mut Stage<'_>,
    ) {
        let Some(known) = self.ways.get(index) else {
            return;
        };
        let is_heartbeat = record.kind == kind::HEARTBEAT;
        // It goes where data goes, unless a reader is known to be there.
        let holds = known.has_data || matched == Matched::Yes;
        let is_meant = record.reader().prefix != GuidPrefix::UNKNOWN;
        let opens = is_heartbeat
            && matched == Matched::Yes
            && (is_meant || !known.way.place.is_multicast());
        if !is_heartbeat && !known.way.place.is_multicast() && self.open > 0 {
            for delivery in self.deliveries.iter_mut().filter(|each| is_open(each)) {
                delivery.gap(
                    record,
                    &mut scene(&mut self.totals, self.reassembled, stage),
                );
            }
        }
        let place = match self.find(receiver) {
            None if opens => self.delivery(index, receiver, stage),
            found => found,
        };
        let Some(delivery) = place.and_then(|place| self.deliveries.get_mut(place)) else {
            return;
        };
        let mut scene = scene(&mut self.totals, self.reassembled, stage);
        if !is_heartbeat {
            delivery.gap(record, &mut scene);
        } else if is_meant || holds {
            delivery.heartbeat(record, &mut scene);
        }
    }

    /// A reader asks for samples again: what fills its gaps from now on is a retransmission.
    pub(super) fn requested(&mut self, record: &Record) {
        let reader = record.reader().prefix;
        for delivery in &mut self.deliveries {
            if is_open(delivery) || delivery.receiver() == Receiver::Participant(reader) {
                delivery.requested(record);
            }
        }
    }

    /// A reader has all below the base of this ACKNACK. A delivery is its participant's: what all of
    /// its readers have came there, whether it was seen or not.
    pub(super) fn acknowledged(&mut self, record: &Record) {
        let prefix = record.reader().prefix;
        let below = self.acknowledgements.floor(|guid| guid.prefix == prefix);
        for delivery in &mut self.deliveries {
            let below = match delivery.receiver() {
                Receiver::Participant(receiver) if receiver == prefix => below,
                Receiver::Way(way) if way.is_open() => self.acknowledgements.floor(|_| true),
                _ => None,
            };
            if let Some(below) = below {
                delivery.acknowledged(below);
            }
        }
    }

    pub(super) fn not_reassembled(&mut self, record: &Record, stage: &mut Stage<'_>) {
        self.reassembled = true;
        let place = Place::of(record);
        let directed = Some(record.reader().prefix).filter(|to| *to != GuidPrefix::UNKNOWN);
        for delivery in &mut self.deliveries {
            let leads_there = |known: &Known| {
                !known.way.is_sent()
                    && known.way.place == place
                    && match delivery.receiver() {
                        Receiver::Way(way) => known.way == way,
                        Receiver::Participant(prefix) => {
                            known.owner == Some(prefix) && directed.is_none_or(|to| to == prefix)
                        }
                    }
            };
            if self.ways.iter().any(leads_there) {
                let number = record.sequence_number;
                delivery.not_reassembled(
                    number,
                    &mut scene(&mut self.totals, self.reassembled, stage),
                );
            }
        }
    }
}
