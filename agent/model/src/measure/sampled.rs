//! Counts of one writer in a sampled view: how many samples were written, and how many of them were
//! read.
//!
//! Shared memory is polled, so samples that are overwritten between two polls are not seen.
//! Sequence numbers still show how many were written: messages are counted by the span of their
//! numbers, and unseen numbers are not losses. While a writer is sampled, its samples on the
//! network are counted here, too.

use std::time::Duration;

use ros2probe_wire::{SequenceNumber, Timestamp};

use crate::facts::measurement::SampledFacts;
use crate::facts::model_time::ModelTime;
use crate::measure::sequence::{MAX_WINDOW, NumberRange, Run, RunMembership, Sequence};

/// A writer that was not seen in shared memory for this long is no longer sampled.
const SAMPLED_TIMEOUT: Duration = Duration::from_secs(10);
/// Time that an unseen sample may take to arrive by another transport before it is skipped.
const ARRIVAL_TIMEOUT: Duration = Duration::from_millis(200);
/// Accepted probability of reporting a silence while messages are sent.
const FALSE_SILENCE_PROBABILITY: f64 = 1e-6;
/// Number of messages presumed before the first one is seen, and the share of them that polling
/// missed. On a busy machine, polling misses nine of ten large messages. The same is presumed after
/// a missed message: its cause, such as a large message sent with it, also hides the next ones.
const PRESUMED_MESSAGES: f64 = 2.0;
const PRESUMED_MISSED_SHARE: f64 = 0.9;
/// Maximum time in which polling sees no message of a topic on a busy machine. Measured with Fast
/// DDS: 0.4 s on an idle machine, more than 2 s for point clouds at a load of 10.
const MAX_POLLING_GAP: Duration = Duration::from_secs(10);
/// Factor by which a run of missed messages may exceed the longest run so far.
const MISSED_RUN_FACTOR: f64 = 3.0;
/// Weight of the newest interval in the moving average.
const NEWEST_WEIGHT: f64 = 0.125;
/// Number of sequence numbers below the next one that are tracked individually.
const WINDOW_LEN: u64 = u128::BITS as u64;

/// State of one writer's sampled view.
#[derive(Debug)]
pub struct Sampled {
    /// Time of the last observation from shared memory.
    last: ModelTime,
    /// Whether a network observation arrived after shared memory fell silent.
    left: bool,
    span: u64,
    seen: u64,
    uncertain: u64,
    /// Number of times that one or more unseen messages preceded a seen one.
    unseen_runs: u64,
    /// Maximum number of unseen messages in a row so far.
    longest_unseen_run: u64,
    /// Moving average of the time between messages, in seconds.
    interval: Option<f64>,
    /// Messages known from HEARTBEATs and ACKNACKs whose size is not known yet.
    unmeasured: u64,
    /// Bit `i`: the number `i + 1` below `next` was seen or is not awaited.
    seen_bits: u128,
    /// Bit `i`: that sample was seen completely, or its last fragment was seen without some others.
    finished: u128,
    /// The number to which the bits of `seen_bits` and `finished` are relative.
    next: SequenceNumber,
    /// No sample below this number is awaited.
    settled: SequenceNumber,
    /// Time of the last [`Self::tick`] that settled, and the next number at that time.
    last_settled: (ModelTime, SequenceNumber),
    /// Time of the tick before that.
    settled_before: ModelTime,
    /// Runs of numbers that were settled without being seen.
    unseen: Vec<(SequenceNumber, SequenceNumber)>,
    /// The latest number that arrived, presumably whole, and its time.
    arrived: Option<(SequenceNumber, ModelTime)>,
    /// The stamp from the first fragment of a sample whose payload begins with a header.
    head: Option<(SequenceNumber, (i32, u32))>,
}

/// Changes caused by an observation.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub struct SampledUpdate {
    /// Number of samples that are now known to exist, including the observation's own.
    pub samples: u64,
    /// Number of samples assumed to have the size of this one: `samples`, and earlier announced
    /// ones.
    pub alike: u64,
    /// Nanoseconds since the previous number arrived, if that number was seen.
    pub interval: Option<i64>,
    /// Whether it is the newest sample and has arrived, so that its delay is meaningful.
    pub arrived: bool,
    /// Whether this observation ends the wait for the sample.
    pub finished: bool,
    /// Whether its number is not confirmed as the writer's.
    pub unconfirmed: bool,
}

/// How much of a sample was seen, including its latest observation.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Completeness {
    /// Some fragments, with more to follow.
    Partial,
    /// The last fragment, while others are missing.
    LastFragment,
    /// The whole sample.
    Complete,
}

impl Sampled {
    /// Creates a view that begins at `now`.
    #[must_use]
    pub const fn new(now: ModelTime) -> Self {
        Self {
            last: now,
            left: false,
            span: 0,
            seen: 0,
            uncertain: 0,
            unseen_runs: 0,
            longest_unseen_run: 0,
            interval: None,
            unmeasured: 0,
            seen_bits: u128::MAX,
            finished: u128::MAX,
            next: SequenceNumber::ZERO,
            settled: SequenceNumber::ZERO,
            last_settled: (now, SequenceNumber::ZERO),
            settled_before: now,
            unseen: Vec::new(),
            arrived: None,
            head: None,
        }
    }

    /// Records that the writer was seen in shared memory.
    pub fn touch(&mut self, now: ModelTime) {
        self.last = self.last.max(now);
        self.left = false;
    }

    /// Returns whether the writer is still sampled.
    #[must_use]
    pub fn is_current(&self, now: ModelTime) -> bool {
        self.last + SAMPLED_TIMEOUT > now
    }

    /// Returns whether an observation at `now` belongs to this view: while the writer is sampled,
    /// and for the first observation after that, because samples missing before it may have used
    /// shared memory.
    pub fn takes(&mut self, now: ModelTime) -> bool {
        let takes = self.is_current(now) || !self.left;
        self.left |= !self.is_current(now);
        takes
    }

    /// Ends the sampled view. Pending samples may still arrive until [`Self::tick`] settles them.
    pub const fn end(&mut self) {
        (self.last, self.left) = (ModelTime::ZERO, true);
    }

    /// Returns whether this sample was sent and is still awaited.
    #[must_use]
    pub fn awaits(&self, number: SequenceNumber) -> bool {
        let bit = self.bit(number, self.next);
        number >= self.settled && bit.is_some_and(|bit| self.finished & bit == 0)
    }

    /// Processes a sample that [`Self::awaits`] accepts, or a fragment of one, after [`Self::end`].
    pub fn add_late(&mut self, number: SequenceNumber, seen: Completeness) -> SampledUpdate {
        SampledUpdate {
            finished: self.mark_seen(number, seen),
            ..SampledUpdate::default()
        }
    }

    /// Takes over counted samples that another view saw in part. `next` is the number after the
    /// newest.
    pub fn add_partial(
        &mut self,
        partial: &[SequenceNumber],
        next: SequenceNumber,
        now: ModelTime,
    ) {
        self.follow(next, now);
        for &number in partial {
            match self.bit(number, next) {
                Some(bit) => {
                    self.finished &= !bit;
                    self.settled = self.settled.min(number);
                }
                None => self.leave_out(number, number),
            }
        }
    }

    /// Stops waiting for samples that were already missing at the previous tick.
    pub fn tick(&mut self, now: ModelTime) {
        let (then, next) = self.last_settled;
        if now - then >= ARRIVAL_TIMEOUT {
            self.settle(next.min(self.next));
            self.last_settled = (now, self.next);
            self.settled_before = then;
        }
    }

    /// Stops waiting for all samples.
    pub fn settle_all(&mut self) {
        self.settle(self.next);
    }

    /// Returns a time before which no wait for a sample began; `None` if no sample is awaited.
    #[must_use]
    pub fn unseen_since(&self) -> Option<ModelTime> {
        let (at, next) = self.last_settled;
        Some(match self.unseen()? < next {
            true => self.settled_before,
            false => at,
        })
    }

    /// Returns the lowest awaited number; `None` if no sample is awaited.
    #[must_use]
    pub fn unseen(&self) -> Option<SequenceNumber> {
        let open = self.next.steps_since(self.settled);
        let open = u32::try_from(open).unwrap_or(u32::MAX);
        let open = 1_u128.checked_shl(open).map_or(u128::MAX, |bit| bit - 1);
        let highest = (!self.finished & open).checked_ilog2()?;
        let below = u64::from(highest) + 1;
        self.next.0.checked_sub(below).map(SequenceNumber)
    }

    /// Removes and returns the runs of unseen numbers, as first and last number.
    pub fn take_unseen(&mut self) -> Vec<(SequenceNumber, SequenceNumber)> {
        std::mem::take(&mut self.unseen)
    }

    /// Records a polling gap in which samples may have been missed.
    pub const fn uncertain(&mut self) {
        self.uncertain += 1;
    }

    /// Records that `samples` were sent after `since`.
    #[expect(
        clippy::cast_precision_loss,
        reason = "counts of samples are far below 2^52"
    )]
    pub fn note_interval(&mut self, samples: u64, since: ModelTime, now: ModelTime) {
        if samples > 0 && since != ModelTime::ZERO {
            let newest = (now - since).as_secs_f64() / samples as f64;
            let mean = self.interval.unwrap_or(newest);
            self.interval = Some(mean + NEWEST_WEIGHT * (newest - mean));
        }
    }

    /// Returns how long the writer may seem silent while it sends: the time of as many messages in
    /// a row as polling may plausibly miss. Until two messages are known, their interval is assumed
    /// to be `slowest`. The result is zero after [`Self::end`].
    #[must_use]
    #[expect(
        clippy::cast_precision_loss,
        reason = "counts of samples are far below 2^52"
    )]
    pub fn max_unseen_time(&self, slowest: Duration) -> Duration {
        if self.last == ModelTime::ZERO {
            return Duration::ZERO;
        }
        let interval = self.interval.unwrap_or(slowest.as_secs_f64());
        let unseen = self.span.saturating_sub(self.seen);
        let share = |missed: u64, of: u64| {
            (missed as f64 + PRESUMED_MESSAGES * PRESUMED_MISSED_SHARE)
                / (of as f64 + PRESUMED_MESSAGES)
        };
        let missed = share(unseen, self.span);
        let missed_again = share(unseen.saturating_sub(self.unseen_runs), unseen);
        let messages = 1.0 + (FALSE_SILENCE_PROBABILITY.ln() - missed.ln()) / missed_again.ln();
        let messages = messages.max(MISSED_RUN_FACTOR * self.longest_unseen_run as f64);
        let silence = Duration::try_from_secs_f64(messages * interval).unwrap_or(Duration::MAX);
        silence.max(MAX_POLLING_GAP)
    }

    /// As [`Self::max_unseen_time`], for a writer that polling has not seen yet.
    #[must_use]
    pub fn max_unseen_time_of_new_writer(slowest: Duration) -> Duration {
        Self::new(ModelTime::from_nanoseconds(1)).max_unseen_time(slowest)
    }

    /// Returns the counts so far.
    #[must_use]
    pub const fn facts(&self) -> SampledFacts {
        SampledFacts {
            seen: self.seen,
            span: self.span,
            uncertain: self.uncertain,
        }
    }

    /// Returns whether this sample exists and is no longer awaited; `next` is the number after the
    /// newest.
    #[must_use]
    pub fn has(&self, number: SequenceNumber, next: SequenceNumber) -> bool {
        number < next
            && self
                .bit(number, next)
                .is_none_or(|bit| self.finished & bit != 0)
    }

    /// Processes a sample or fragment: its number, completeness and source time. Up to `reach`
    /// numbers before it may have been missed.
    pub fn sample(
        &mut self,
        (number, seen, source): (SequenceNumber, Completeness, Option<Timestamp>),
        reach: u64,
        now: ModelTime,
        sequence: &mut Sequence,
    ) -> SampledUpdate {
        if !number.is_valid() {
            return SampledUpdate::default();
        }
        let before = sequence.next();
        self.follow(before, now);
        let is_unseen = self
            .bit(number, before)
            .is_some_and(|bit| self.seen_bits & bit == 0);
        let belief = match source {
            // The sample is late, and its writer has not restarted.
            Some(source) if is_unseen => {
                sequence.sourced(number, source);
                RunMembership::Live
            }
            source => sequence.recognise(number, source, reach, now),
        };
        let run = match belief {
            RunMembership::Live => Run::default(),
            RunMembership::Unconfirmed { new } => {
                return self.unconfirmed((number, seen), new, sequence);
            }
            RunMembership::Confirmed(run) => run,
        };
        sequence.begin(number);
        if sequence.next() != before {
            // The writer starts or restarts.
            self.settle_all();
            self.begin(sequence.next(), now);
            self.arrived = None;
        }
        let end = run.ranges.iter().map(|range| range.last).max();
        let end = end.unwrap_or_default().max(number).next();
        let samples = self.advance(end, true, now, sequence);
        let samples = self.confirm(&run, samples);
        self.span += samples;
        let hole = samples.saturating_add(self.unmeasured).saturating_sub(1);
        self.unseen_runs += u64::from(hole > 0);
        self.longest_unseen_run = self.longest_unseen_run.max(hole);
        let below = sequence.next().steps_since(number.next());
        let finished = self.mark_seen(number, seen);
        let mut update = SampledUpdate {
            samples,
            alike: samples.saturating_add(std::mem::take(&mut self.unmeasured)),
            finished,
            ..SampledUpdate::default()
        };
        let is_later = self.arrived.is_none_or(|(arrived, _)| arrived < number);
        if seen != Completeness::Partial && below == 0 && is_later {
            update.arrived = true;
            update.interval = self
                .arrived
                .filter(|(arrived, _)| arrived.next() == number)
                .map(|(_, at)| now.nanoseconds_since(at).max(0));
            self.arrived = Some((number, now));
        }
        update
    }

    /// Records that samples up to `last` exist, from a HEARTBEAT or ACKNACK. Returns how many of
    /// them are new.
    pub fn note_existing(
        &mut self,
        last: SequenceNumber,
        reach: u64,
        now: ModelTime,
        sequence: &mut Sequence,
    ) -> u64 {
        let end = last.next();
        if !sequence.started() {
            return 0;
        }
        let (is_confirmed, run) = sequence.claim(end, reach, now);
        self.follow(sequence.next(), now);
        if !is_confirmed {
            return 0;
        }
        let samples = self.advance(end, true, now, sequence);
        let samples = match run {
            Some(run) => {
                self.arrived = None;
                self.confirm(&run, samples)
            }
            None => samples,
        };
        self.span += samples;
        self.unmeasured += samples;
        samples
    }

    /// Records that the numbers `start..end` were never sent, from a GAP. Returns how many numbers
    /// before them are new.
    pub fn skip(
        &mut self,
        (start, end): (SequenceNumber, SequenceNumber),
        reach: u64,
        now: ModelTime,
        sequence: &mut Sequence,
    ) -> u64 {
        if start == SequenceNumber::ZERO {
            return 0;
        }
        let samples = self.note_existing(start.previous(), reach, now, sequence);
        let ahead = end.steps_since(sequence.next());
        if sequence.started() && start <= sequence.next() && ahead <= reach {
            let skipped = self.advance(end, false, now, sequence);
            let bits = u32::try_from(skipped).unwrap_or(u32::MAX);
            let skipped = 1_u128.checked_shl(bits).map_or(u128::MAX, |bit| bit - 1);
            self.seen_bits |= skipped;
            self.finished |= skipped;
        }
        samples
    }

    /// Stores `stamp` if there is one. Returns the stored stamp of this sample; `None` if it
    /// was not seen.
    pub fn stamp(
        &mut self,
        number: SequenceNumber,
        stamp: Option<(i32, u32)>,
    ) -> Option<(i32, u32)> {
        if let Some(stamp) = stamp {
            self.head = Some((number, stamp));
        }
        self.head
            .filter(|(head, _)| *head == number)
            .map(|(_, stamp)| stamp)
    }

    /// Processes a sample whose number is not confirmed.
    fn unconfirmed(
        &mut self,
        (number, seen): (SequenceNumber, Completeness),
        new: bool,
        sequence: &mut Sequence,
    ) -> SampledUpdate {
        let samples = u64::from(new);
        self.span += samples;
        self.seen += samples;
        SampledUpdate {
            samples,
            alike: samples,
            finished: seen != Completeness::Partial && sequence.complete_unconfirmed(number),
            unconfirmed: true,
            ..SampledUpdate::default()
        }
    }

    /// Marks the samples of a confirmed run as seen. Returns how many of `samples` new numbers were
    /// not counted while the run was unconfirmed.
    fn confirm(&mut self, run: &Run, samples: u64) -> u64 {
        for range in &run.ranges {
            for number in range.first.until(range.last.next()) {
                let bit = self.bit(number, self.next).unwrap_or(0);
                self.seen_bits |= bit;
                if range.is_whole {
                    self.finished |= bit;
                }
            }
        }
        let counted: u64 = run.ranges.iter().map(NumberRange::count).sum();
        samples.saturating_sub(counted)
    }

    /// Marks a sample as seen. Returns whether this ends the wait for the sample.
    fn mark_seen(&mut self, number: SequenceNumber, seen: Completeness) -> bool {
        let bit = self.bit(number, self.next).unwrap_or(0);
        if self.seen_bits & bit != bit {
            self.seen_bits |= bit;
            self.seen += 1;
        }
        let finished = seen != Completeness::Partial && self.awaits(number);
        if finished {
            self.finished |= bit;
        }
        finished
    }

    /// Returns the bit of a number relative to `next`.
    fn bit(&self, number: SequenceNumber, next: SequenceNumber) -> Option<u128> {
        let below = (number < next).then(|| next - number.next())?;
        1_u128.checked_shl(u32::try_from(below).ok()?)
    }

    /// Marks all numbers below `end` as used and not lost, and returns how many are new. `sent` is
    /// false if no samples have these numbers.
    fn advance(
        &mut self,
        end: SequenceNumber,
        sent: bool,
        now: ModelTime,
        sequence: &mut Sequence,
    ) -> u64 {
        let next = sequence.next();
        if end <= next {
            return 0;
        }
        let oldest = end.saturating_sub(WINDOW_LEN);
        self.settle(oldest.min(next));
        if oldest > next {
            if sent {
                self.leave_out(next, oldest.previous());
            }
            self.settled = oldest;
        }
        sequence.exists(end.previous(), now, &mut |_| {});
        for number in next.max(end.saturating_sub(MAX_WINDOW)).until(end) {
            sequence.know(number);
        }
        let samples = end - next;
        let bits = u32::try_from(samples).unwrap_or(u32::MAX);
        self.seen_bits = self.seen_bits.checked_shl(bits).unwrap_or(0);
        self.finished = self.finished.checked_shl(bits).unwrap_or(0);
        self.next = end;
        samples
    }

    /// Takes over the numbers that another view counted.
    fn follow(&mut self, next: SequenceNumber, now: ModelTime) {
        if self.next != next {
            self.settle_all();
            self.begin(next, now);
        }
    }

    /// Marks all numbers below `next` as seen or not awaited.
    const fn begin(&mut self, next: SequenceNumber, now: ModelTime) {
        (self.seen_bits, self.finished) = (u128::MAX, u128::MAX);
        (self.next, self.settled, self.last_settled) = (next, next, (now, next));
        self.settled_before = now;
    }

    /// Stops waiting for numbers below `end`; unseen ones are skipped.
    fn settle(&mut self, end: SequenceNumber) {
        let known = self.next.saturating_sub(WINDOW_LEN).max(self.settled);
        for number in known.until(end.min(self.next)) {
            let bit = self.bit(number, self.next);
            if bit.is_some_and(|bit| self.finished & bit == 0) {
                self.leave_out(number, number);
            }
        }
        self.settled = self.settled.max(end.min(self.next));
    }

    fn leave_out(&mut self, first: SequenceNumber, last: SequenceNumber) {
        match self.unseen.last_mut() {
            Some(run) if run.1.precedes(first) => run.1 = last,
            _ => self.unseen.push((first, last)),
        }
    }
}

#[cfg(test)]
mod tests;
