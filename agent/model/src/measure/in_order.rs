//! Puts one writer's samples into the order in which a reliable subscriber receives them.
//!
//! A reader delivers a sample once all lower numbers have arrived or will not arrive (RTPS 2.5,
//! 8.4.12). A counted sample that follows a gap therefore waits until the gap closes. A
//! retransmission, a GAP or HEARTBEAT of the writer, ACKNACKs of the readers, or the decision about
//! a loss closes it. The time of the sample is then the time at which the gap closed. The waiting
//! samples are bounded in number, bytes and time. Beyond these bounds they are dispatched, and a
//! late retransmission follows out of order. Otherwise samples wait only after a gap, for a
//! reliable reader on this host: ACKNACKs of readers on other hosts are not seen.
//!
//! Samples of every writer also wait while uprobes take over from polling: the last message that
//! both views may have seen can arrive after later ones. The readers do not wait for it, so these
//! samples keep their own times.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

use ros2probe_wire::SequenceNumber;

use crate::facts::bounded::Bounded;
use crate::facts::dispatch::{QueuedDispatch, Sample};
use crate::facts::model_time::ModelTime;
use crate::facts::tables::{self, OrderedSamples};

/// Maximum time to wait for a gap. Fast DDS requests retransmissions after a HEARTBEAT, which
/// follows within three seconds.
const GAP_TIMEOUT: Duration = Duration::from_secs(4);
/// Samples from before the announcement are retransmitted within this time, or not at all.
const RETRANSMISSION_TIMEOUT: Duration = Duration::from_secs(10);
/// Memory per sample in addition to its payload, in bytes.
const SAMPLE_OVERHEAD: usize = size_of::<QueuedSample>() + 64;
/// Maximum time from the announcement to the first ACKNACK.
const FIRST_ACKNACK_TIMEOUT: Duration = Duration::from_secs(1);

/// Which samples of a writer are decided.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub struct Progress {
    /// Increases when the writer restarts its sequence numbers under the same GUID.
    pub incarnation: u32,
    /// All samples below this number arrived, or no reader waits for them.
    pub complete: SequenceNumber,
    /// No reader waits for any sample below this number.
    pub awaited: SequenceNumber,
    /// Whether the writer retransmits.
    pub reliable: bool,
    /// Whether the writer has readers that send ACKNACKs, or new readers that may.
    pub acknowledged: bool,
    /// Whether the first missing sample was not observed but may have reached the readers.
    pub unseen: bool,
}

/// A sample and the subscriptions that receive it.
#[derive(Debug)]
pub struct QueuedSample {
    /// Ids of the requests.
    pub to: Arc<[u64]>,
    /// The sample.
    pub sample: Sample<ModelTime>,
    /// The outcome for subscriptions that miss its bytes.
    pub missed: Option<QueuedDispatch>,
}

/// Numbers of a writer that is not announced yet.
pub(crate) type UnannouncedNumbers = Bounded<tables::UnannouncedNumbers, BTreeSet<SequenceNumber>>;

/// Samples that wait for lower numbers.
#[derive(Debug, Default)]
pub struct InOrder {
    waiting: Bounded<OrderedSamples, BTreeMap<SequenceNumber, QueuedSample>>,
    bytes: usize,
    incarnation: Option<u32>,
    /// The missing number, and the time when the wait for it began.
    hole: (SequenceNumber, ModelTime),
    /// Whether readers may have the missing sample.
    is_hole_unseen: bool,
    /// Time of the last dispatched sample.
    last: ModelTime,
    /// Numbers that were counted before the writer's announcement but not dispatched.
    earlier: UnannouncedNumbers,
    announced: ModelTime,
}

impl QueuedSample {
    /// Returns the size of its payload in bytes.
    pub fn bytes(&self) -> usize {
        self.sample.payload.as_ref().map_or(0, bytes::Bytes::len)
    }

    /// Returns the memory that it needs while it waits.
    pub fn cost(&self) -> usize {
        SAMPLE_OVERHEAD + self.bytes()
    }
}

impl InOrder {
    /// Returns whether no sample waits or may still be retransmitted.
    #[must_use]
    pub fn is_idle(&self) -> bool {
        self.waiting.is_empty() && self.earlier.is_empty()
    }

    /// Returns the earliest time of a sample that waits for lower numbers; `None` if none waits.
    #[must_use]
    pub fn waiting_since(&self) -> Option<ModelTime> {
        let waiting = self.waiting.values();
        waiting.map(|queued| queued.sample.time).min()
    }

    /// Returns the bytes of the waiting samples.
    #[must_use]
    pub const fn bytes(&self) -> usize {
        self.bytes
    }

    /// Sets the numbers that were counted before the writer's announcement at `now`.
    pub fn announced(&mut self, earlier: UnannouncedNumbers, now: ModelTime) {
        (self.earlier, self.announced) = (earlier, now);
    }

    /// Returns whether this sample was counted before the announcement and is not dispatched yet.
    #[must_use]
    pub fn is_undispatched(&self, number: SequenceNumber) -> bool {
        self.earlier.contains(&number)
    }

    /// Begins a new incarnation after all samples of the previous one are dispatched. Returns whether
    /// there was a previous one. Call it before [`Self::put`] and [`Self::turn`].
    pub fn begin(
        &mut self,
        incarnation: u32,
        now: ModelTime,
        give: &mut impl FnMut(QueuedSample),
    ) -> bool {
        let previous = self.incarnation.replace(incarnation);
        if previous == Some(incarnation) {
            return false;
        }
        self.dispatch_all(now, give);
        previous.is_some()
    }

    /// Returns the sample for immediate dispatch; no other sample waits.
    pub fn pass(&mut self, mut queued: QueuedSample, now: ModelTime) -> QueuedSample {
        queued.sample.time = now.max(self.last);
        self.last = queued.sample.time;
        queued
    }

    /// Adds a sample that is dispatched in the order of the numbers.
    pub fn put(&mut self, queued: QueuedSample) {
        let number = queued.sample.sequence_number;
        self.earlier.remove(&number);
        self.bytes += queued.cost();
        if let Some(before) = self.waiting.remove(&number) {
            self.bytes -= before.cost();
        }
        self.waiting.insert(number, queued);
    }

    /// Removes and returns the samples from before the announcement that will not be retransmitted.
    pub fn take_expired(&mut self, progress: &Progress, now: ModelTime) -> Vec<SequenceNumber> {
        if self.earlier.is_empty() {
            return Vec::new();
        }
        let is_late = self.announced + RETRANSMISSION_TIMEOUT <= now;
        if is_late || !progress.reliable {
            return self.earlier.take().into_iter().collect();
        }
        let gone = self.earlier.take_below(&progress.awaited);
        gone.into_iter().collect()
    }

    /// Dispatches the samples that need not wait at `now`; at most `room` bytes may continue to
    /// wait. If a bound ended the wait, returns the number below which no sample is awaited.
    pub fn turn(
        &mut self,
        progress: &Progress,
        now: ModelTime,
        room: usize,
        give: &mut impl FnMut(QueuedSample),
    ) -> Option<SequenceNumber> {
        let first = self
            .earlier
            .first()
            .filter(|_| progress.acknowledged || self.announced + FIRST_ACKNACK_TIMEOUT > now);
        let complete = first.map_or(progress.complete, |first| progress.complete.min(*first));
        while let Some(entry) = self.waiting.first_entry()
            && *entry.key() < complete
        {
            let queued = entry.remove();
            self.dispatch(queued, now, give);
        }
        if self.waiting.is_empty() {
            return None;
        }
        if self.hole.0 != complete {
            self.hole = (complete, now);
        }
        self.is_hole_unseen = progress.unseen;
        let is_late = self.hole.1 + GAP_TIMEOUT <= now;
        if is_late || self.waiting.is_full() || self.bytes > room {
            let last = self.waiting.last_key_value().map(|(number, _)| *number);
            self.dispatch_all(now, give);
            return last.map(|last| last.next());
        }
        None
    }

    /// Dispatches all waiting samples.
    pub fn dispatch_all(&mut self, now: ModelTime, give: &mut impl FnMut(QueuedSample)) {
        while let Some((_, queued)) = self.waiting.pop_first() {
            self.dispatch(queued, now, give);
        }
    }

    fn dispatch(
        &mut self,
        queued: QueuedSample,
        now: ModelTime,
        give: &mut impl FnMut(QueuedSample),
    ) {
        self.bytes -= queued.cost();
        let came = queued.sample.time;
        // The reader may have received the lower number through unobserved shared memory. This
        // sample then did not wait.
        let is_own = queued.sample.sampled || self.is_hole_unseen;
        let now = if is_own { came } else { now };
        // Players sort by time, so samples that waited for the same retransmission are one
        // nanosecond apart.
        let after = match came < now.max(self.last) {
            true => self.last + Duration::from_nanos(1),
            false => came,
        };
        give(self.pass(queued, now.max(after)));
    }
}
