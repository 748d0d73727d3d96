//! Start of the samples of one writer for one request.

use std::time::Duration;

use ros2probe_wire::SequenceNumber;

use crate::facts::dispatch::MissedReason;
use crate::facts::model_time::ModelTime;

/// Maximum time until samples that polling missed are reported: they may arrive from another view.
const UNSEEN_DELAY: Duration = Duration::from_millis(400);

/// A request for the samples of one writer.
#[derive(Clone, Copy, Debug)]
pub(super) struct RequestBegin {
    /// Id of the request.
    pub(super) id: u64,
    /// The next number of the writer when the request began.
    number: SequenceNumber,
    since: ModelTime,
    /// The lowest number that arrived for it.
    first: Option<SequenceNumber>,
    /// Number of the sample from before the request that its reader received first.
    pub(super) before: Option<SequenceNumber>,
}

impl RequestBegin {
    /// Creates the start of request `id` at `since`, before the sample `number`.
    pub(super) const fn new(id: u64, number: SequenceNumber, since: ModelTime) -> Self {
        Self {
            id,
            number,
            since,
            first: None,
            before: None,
        }
    }

    /// Returns whether this sample arrived for it.
    pub(super) fn has(&self, number: SequenceNumber) -> bool {
        self.first.is_some_and(|first| first <= number)
    }

    /// Begins again with the numbers of a writer that was started anew.
    pub(super) fn restart(&mut self) {
        (self.number, self.first) = (SequenceNumber::ZERO, None);
    }

    /// Returns whether its first sample so far has a higher number.
    pub(super) fn starts_after(&self, number: SequenceNumber) -> bool {
        self.first.is_some_and(|first| first > number)
    }

    /// Records a sample that arrived for the requests `to`.
    pub(super) fn arrived(&mut self, to: &[u64], number: SequenceNumber) {
        if self.first.is_none_or(|first| number < first) && to.contains(&self.id) {
            self.first = Some(number);
        }
    }

    /// Returns the first number that the request can miss for this reason; `None` if it can miss no
    /// sample yet.
    ///
    /// Polling shared memory notices numbers late, perhaps those of samples that were sent before
    /// the request. Numbers that polling missed therefore count from the first sample that arrives.
    /// If none arrives in time, they count from the start of the request.
    pub(super) fn first_missed(
        &self,
        reason: MissedReason,
        now: ModelTime,
        payload_delay: Duration,
    ) -> Option<SequenceNumber> {
        if reason != MissedReason::NotCaptured {
            return Some(self.number);
        }
        match self.first {
            Some(first) => Some(self.number.max(first)),
            None => (self.since + payload_delay + UNSEEN_DELAY <= now).then_some(self.number),
        }
    }
}
