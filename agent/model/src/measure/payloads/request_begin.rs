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
    /// The lowest number that arrived for it or was reported as missing.
    first: Option<SequenceNumber>,
    /// Number of the sample from before the request that its reader received first.
    pub(super) before: Option<SequenceNumber>,
    /// Whether the request is older than the writer, so that it concerns all of its samples.
    pub(super) is_older: bool,
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
            is_older: false,
        }
    }

    /// Returns whether this sample arrived for it or was reported as missing.
    pub(super) fn has(&self, number: SequenceNumber) -> bool {
        self.first.is_some_and(|first| first <= number)
    }

    /// Records that the request is older than its writer, which was announced at `now`.
    pub(super) fn precedes_writer(&mut self, now: ModelTime) {
        self.is_older |= self.since == now;
    }

    /// Begins again with the numbers of a writer that was started anew.
    pub(super) fn restart(&mut self) {
        (self.number, self.first, self.before) = (SequenceNumber::ZERO, None, None);
    }

    /// Returns whether its first sample so far has a higher number.
    pub(super) fn starts_after(&self, number: SequenceNumber) -> bool {
        self.first.is_some_and(|first| first > number)
    }

    /// Records a sample that arrived for the requests `to`, or was reported to them as missing. Later
    /// samples concern these requests, too.
    pub(super) fn concerns(&mut self, to: &[u64], number: SequenceNumber) {
        if self.first.is_none_or(|first| number < first) && to.contains(&self.id) {
            self.first = Some(number);
        }
    }

    /// Returns the first number that the request can miss for this reason; `None` if it can miss no
    /// sample yet.
    ///
    /// Polling shared memory notices numbers late, perhaps those of samples that were sent before
    /// the request. Numbers that polling missed therefore count from the first sample that arrives or
    /// is reported. If no sample does in time, they count from the start of the request.
    pub(super) fn first_missed(
        &self,
        reason: MissedReason,
        now: ModelTime,
        payload_delay: Duration,
    ) -> Option<SequenceNumber> {
        if reason != MissedReason::NotCaptured || self.is_older {
            return Some(self.number);
        }
        match self.first {
            Some(first) => Some(self.number.max(first)),
            None => (self.since + payload_delay + UNSEEN_DELAY <= now).then_some(self.number),
        }
    }
}
