//! Effects of decisions about a delivery's samples: counters, causes, journal entries.

use std::collections::VecDeque;

use ros2probe_wire::{Guid, SequenceNumber};

use crate::facts::bounded::Bounded;
use crate::facts::journal::Journal;
use crate::facts::loss::DeliveryLoss;
use crate::facts::loss::LossCause;
use crate::facts::measurement::{Breakdown, Delivered};
use crate::facts::model_time::ModelTime;
use crate::facts::route::Direction;
use crate::facts::route::Receiver;
use crate::facts::route::Route;
use crate::facts::tables::WithheldLosses;
use crate::measure::loss_causes::LossCauses;
use crate::measure::reception::Decision;

/// Sums over all deliveries of a writer.
#[derive(Clone, Debug, Default)]
pub struct Totals {
    /// Samples that arrived at receivers.
    pub received: Delivered,
    /// Samples that left this host.
    pub sent: Delivered,
    /// Time spent in each stage.
    pub breakdown: Option<Box<Breakdown>>,
    /// Whether samples arrived, and whether samples left.
    pub seen: [bool; 2],
}

impl Totals {
    /// Returns the counts of one direction.
    pub const fn of(&mut self, direction: Direction) -> &mut Delivered {
        match direction {
            Direction::Sent => &mut self.sent,
            Direction::Received => &mut self.received,
        }
    }

    /// Adds all counts of `other`.
    pub fn add(&mut self, other: &Self) {
        self.received.add(&other.received);
        self.sent.add(&other.sent);
        for (seen, also) in self.seen.iter_mut().zip(other.seen) {
            *seen |= also;
        }
        if let Some(breakdown) = &other.breakdown {
            self.breakdown.get_or_insert_default().add(breakdown);
        }
    }
}

/// Counts and events that change when a sample is decided.
pub(super) struct Accounting<'a> {
    pub(super) tally: &'a mut Delivered,
    pub(super) loss_causes: &'a mut LossCauses,
    pub(super) totals: &'a mut Delivered,
    pub(super) journal: &'a mut Journal,
    /// The losses of a withheld delivery, which changes neither totals nor journal.
    pub(super) withheld: Option<&'a mut Bounded<WithheldLosses, VecDeque<DeliveryLoss>>>,
    pub(super) writer: Guid,
    pub(super) receiver: Receiver,
    pub(super) main: Route,
    /// Whether samples without a known cause of loss may have been rejected by a content filter.
    pub(super) is_filtered: bool,
    pub(super) at: ModelTime,
    /// End of the time for which a new loss stays pending.
    pub(super) until: Option<ModelTime>,
    /// Samples from this number on have one TCP connection; [`SequenceNumber::MAX`] without one.
    pub(super) in_order_from: SequenceNumber,
}

impl Accounting<'_> {
    pub(super) fn take(&mut self, decision: Decision) {
        if self.main.direction == Direction::Sent {
            return;
        }
        let (first, last) = match decision {
            Decision::Lost { first, last, .. } => (first, last),
            Decision::Irrelevant(number) => {
                self.loss_causes.forget(number);
                self.count(|tally| tally.irrelevant += 1);
                return;
            }
        };
        let mut runs = Vec::new();
        self.loss_causes.explain(first, last, |first, last, cause| {
            runs.push((first, last, cause));
        });
        for (first, last, cause) in runs {
            if cause.is_none() && self.is_filtered {
                self.count(|tally| tally.irrelevant += last - first + 1);
                continue;
            }
            if self.withheld.is_none() {
                let events = &mut self.journal.events;
                events.add_delivery_loss(self.writer, self.receiver, self.at, (first, last));
            }
            match cause {
                Some(cause) => self.add_loss(cause, first, last),
                None => self.locate(first, last),
            }
        }
    }

    /// Counts samples without a known cause. A gap within one TCP connection was left by the
    /// sender.
    fn locate(&mut self, first: SequenceNumber, last: SequenceNumber) {
        let from = self.in_order_from.max(first);
        if from > first {
            self.wait(first, last.min(from.previous()));
        }
        if from <= last {
            self.add_loss(LossCause::Sender, from, last);
        }
    }

    /// Marks samples as pending: their cause is not known yet.
    pub(super) fn wait(&mut self, first: SequenceNumber, last: SequenceNumber) {
        let Some(until) = self.until else {
            self.add_loss(LossCause::BeforeHost, first, last);
            return;
        };
        self.count(|tally| tally.pending += last - first + 1);
        if let Some((first, last)) = self.loss_causes.wait(first, last, until) {
            self.conclude(first, last);
        }
    }

    /// Settles pending samples as lost before this host.
    pub(super) fn conclude(&mut self, first: SequenceNumber, last: SequenceNumber) {
        let count = last - first + 1;
        self.count(|tally| tally.pending = tally.pending.saturating_sub(count));
        self.add_loss(LossCause::BeforeHost, first, last);
    }

    /// Settles a pending sample as lost by this cause.
    pub(super) fn set_cause(&mut self, cause: LossCause, number: SequenceNumber) {
        self.count(|tally| tally.pending = tally.pending.saturating_sub(1));
        self.add_loss(cause, number, number);
    }

    pub(super) fn add_loss(
        &mut self,
        cause: LossCause,
        first: SequenceNumber,
        last: SequenceNumber,
    ) {
        let count = last - first + 1;
        self.count(|tally| tally.add_lost(cause, count));
        let loss = DeliveryLoss {
            at: self.at,
            writer: self.writer,
            participant: match self.receiver {
                Receiver::Participant(prefix) => Some(prefix),
                Receiver::Route(_) => None,
            },
            socket: self.main.socket,
            destination: self.main.destination.socket_address(),
            cause,
            first,
            last,
        };
        let Some(withheld) = &mut self.withheld else {
            self.journal.add_delivery_loss(loss);
            return;
        };
        withheld.push_back(loss);
    }

    fn count(&mut self, change: impl Fn(&mut Delivered)) {
        change(self.tally);
        if self.withheld.is_none() {
            change(self.totals);
        }
    }
}
