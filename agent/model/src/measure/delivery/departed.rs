//! Samples that left this host for a receiver on the same host: whether they arrive or are lost.

use ros2probe_wire::SequenceNumber;

use super::Delivery;
use super::DeliveryContext;
use super::MAX_TRANSIT_TIME;
use super::SILENCE;
use super::START_GRACE;
use crate::facts::model_time::ModelTime;

impl Delivery {
    /// Records that samples up to `newest` have left for this receiver; `left_by` returns the
    /// highest number that had left by a given time. Samples that do not arrive are lost if the
    /// receiver was `alive` afterwards.
    pub fn expect(
        &mut self,
        newest: SequenceNumber,
        alive: Option<ModelTime>,
        left_by: impl Fn(ModelTime) -> Option<SequenceNumber>,
        context: &mut DeliveryContext<'_>,
    ) {
        if !self.reception.sequence().started() || newest < self.next() {
            (self.waiting, self.presumed_lost, self.overdue) = (None, false, 0);
            return;
        }
        let since = *self.waiting.get_or_insert(context.now);
        let mut until = alive.map_or(ModelTime::ZERO, |alive| {
            alive.min(context.now - MAX_TRANSIT_TIME)
        });
        if !self.presumed_lost && since + SILENCE <= context.now {
            self.presumed_lost = true;
            until = until.max(since + START_GRACE);
        }
        let due = left_by(context.now - MAX_TRANSIT_TIME).filter(|_| !self.presumed_lost);
        let lost = left_by(until).filter(|number| *number >= self.next());
        if let Some(number) = lost.filter(|_| until >= since) {
            self.connection = None;
            self.exists(number, context);
        }
        self.overdue = due.map_or(0, |due| due.next().steps_since(self.next()));
    }

    /// Settles samples up to `newest`, which have left for this receiver and will not arrive.
    pub fn settle_departed(&mut self, newest: SequenceNumber, context: &mut DeliveryContext<'_>) {
        if self.reception.sequence().started() && !self.presumed_lost {
            self.connection = None;
            self.exists(newest, context);
        }
    }

    /// Marks samples irrelevant that were written before the receiver's reader appeared. `next` and
    /// `advanced` describe the sequence before the current observation.
    pub(super) fn mark_unread_irrelevant(&mut self, (next, advanced): (SequenceNumber, ModelTime)) {
        let sequence = self.reception.sequence_mut();
        if next > SequenceNumber::ZERO && advanced < self.opened && sequence.next() > next {
            sequence.mark_irrelevant(next, sequence.next());
        }
    }
}
