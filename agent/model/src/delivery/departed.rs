//! Samples that left this host for a receiver on it: whether they arrive, or count as lost.

use ros2probe_wire::{SequenceNumber, Timestamp};

use super::{Delivery, DeliveryContext, FIRST_MOMENTS, SILENCE, UNDER_WAY};

impl Delivery {
    /// Samples up to `newest` have left this host for here, `left_by` tells which by when. What
    /// does not arrive at a receiver that was `alive` afterwards is lost.
    pub fn expect(
        &mut self,
        newest: SequenceNumber,
        alive: Option<Timestamp>,
        left_by: impl Fn(Timestamp) -> Option<SequenceNumber>,
        context: &mut DeliveryContext<'_>,
    ) {
        if !self.reception.sequence().started() || newest < self.next() {
            (self.waiting, self.presumed_lost) = (None, false);
            return;
        }
        let since = self.waiting.get_or_insert(context.now).0;
        let mut until = alive.map_or(0, |alive| {
            alive.0.min(context.now.0.saturating_sub(UNDER_WAY))
        });
        if !self.presumed_lost && since.saturating_add(SILENCE) <= context.now.0 {
            self.presumed_lost = true;
            until = until.max(since.saturating_add(FIRST_MOMENTS));
        }
        let lost = left_by(Timestamp(until)).filter(|number| *number >= self.next());
        if let Some(number) = lost.filter(|_| until >= since) {
            self.exists(number, context);
        }
    }

    /// Nothing more will come of what has left for here.
    pub fn expect_no_more(&mut self, newest: SequenceNumber, context: &mut DeliveryContext<'_>) {
        if self.reception.sequence().started() && !self.presumed_lost {
            self.exists(newest, context);
        }
    }

    /// What was written until its reader appeared is for no reader here: `next` and when it last
    /// rose are those before the record that is taken in.
    pub(super) fn excuse_unheard(&mut self, (next, advanced): (SequenceNumber, Timestamp)) {
        let sequence = self.reception.sequence_mut();
        if next > SequenceNumber::ZERO && advanced < self.opened && sequence.next() > next {
            sequence.excuse(next, sequence.next());
        }
    }
}
