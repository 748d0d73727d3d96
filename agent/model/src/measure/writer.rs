//! Measurement of one writer: samples, bytes, losses, intervals, latencies.
//!
//! Its input is observations from any source. A sample counts once, with the observation that
//! completes it. An idle writer needs less than 2 KiB; bitmaps, which grow with traffic, are
//! bounded in [`crate::measure::sequence`] and [`crate::measure::samples`].

mod latency;
mod sampled_view;

use std::time::Duration;

use ros2probe_wire::{Guid, RtpsTime, SequenceNumber};

use crate::facts::dispatch::MissedReason;
use crate::facts::histogram::Histogram;
use crate::facts::journal::{Journal, Missing};
use crate::facts::loss::Loss;
use crate::facts::loss_share::LossShare;
use crate::facts::measurement::{EarlierCounts, Measurement};
use crate::facts::model_time::ModelTime;
use crate::facts::observation::{AckNack, Head, Observation, Path, Sample};
use crate::facts::rate::{SECONDS, Slot, Window};
use crate::facts::wall_clock::WallClock;
use crate::measure::in_order::Progress;
use crate::measure::reception::{Decision, Outcome, Reception};
use crate::measure::sampled::Sampled;
use crate::measure::samples::Budget;
use crate::measure::sequence::{MAX_ANNOUNCED_JUMP, MAX_IRRELEVANT_AT_START, MAX_TRUSTED_JUMP};

/// Time in which reordering may fill a gap of a best-effort writer.
pub const BEST_EFFORT_WINDOW: Duration = Duration::from_secs(1);
/// Time in which a reliable writer may retransmit: three HEARTBEAT periods of Fast DDS.
pub const RELIABLE_WINDOW: Duration = Duration::from_secs(10);
/// A first sample older than this is history that a late joiner requested.
const MIN_HISTORY_AGE: Duration = Duration::from_secs(10);
/// A sample from before its reader appeared is history if it arrives within this time.
const HISTORY_TIME: Duration = Duration::from_secs(1);

/// A uprobe's view of a writer stays exact for this long after its last observation: samples read
/// from shared memory in that time were seen already.
const EXACT_FOR: Duration = Duration::from_secs(10);

/// Properties of the writer from discovery; all false if it is unknown.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Traits {
    /// Whether it retransmits; also concluded from its HEARTBEATs.
    pub reliable: bool,
    /// Whether it sends old samples to late joiners.
    pub keeps_history: bool,
    /// Whether its messages begin with a `std_msgs/Header`.
    pub has_header: bool,
}

/// State outside the writer that an observation changes.
#[derive(Debug)]
pub struct MeasurementContext<'a> {
    /// Time of the observation, or of the tick.
    pub now: ModelTime,
    /// Memory budget for fragmented samples.
    pub budget: &'a mut Budget,
    /// Journal that receives the losses.
    pub journal: &'a mut Journal,
    /// Difference between model time and wall time, for the writer's timestamps.
    pub wall_clock: WallClock,
    /// Whether the samples of any receiver are counted, so that losses are reported per receiver.
    pub has_receivers: bool,
}

/// A counted message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Counted {
    /// Its sequence number.
    pub number: SequenceNumber,
    /// Payload bytes, including encapsulation.
    pub bytes: u64,
    /// INFO_TS of the message.
    pub source: RtpsTime,
    /// Stamp of its header, if the type begins with one.
    pub stamp: Option<(i32, u32)>,
    /// Time of the datagram that completed it.
    pub at: ModelTime,
    /// Time of its first datagram.
    pub began: ModelTime,
    /// Whether it was sampled, so that others may have been missed.
    pub sampled: bool,
    /// Whether its number is not confirmed as the writer's; the message then has no order among
    /// others.
    pub unconfirmed: bool,
}

/// A measured writer.
#[derive(Debug)]
pub struct Writer {
    guid: Guid,
    traits: Traits,
    reception: Reception,
    tally: Tally,
    interarrival: Histogram,
    source_latency: Histogram,
    header_latency: Histogram,
    last_message: Option<ModelTime>,
    negative_latency: u64,
    implausible_latency: u64,
    /// Nanoseconds by which the clock of its host is ahead.
    clock_ahead: i64,
    /// State of a writer that was sampled in shared memory.
    sampled: Option<Box<Sampled>>,
    /// Time of the last observation from a uprobe in the writer's own process.
    exact: Option<ModelTime>,
    /// Whether the uprobe's view has ended, and no other view has shown a sample since.
    has_lost_view: bool,
    /// Whether it applies a content filter for each reader that is seen to receive its samples.
    is_filtered: bool,
}

/// Counters that settling changes.
#[derive(Debug, Default)]
struct Tally {
    messages: u64,
    bytes: u64,
    lost: u64,
    recovered: u64,
    duplicates: u64,
    incomplete: u64,
    irrelevant: u64,
    earlier: EarlierCounts,
    window: Window,
}

impl Writer {
    /// Creates a writer without measurements.
    #[must_use]
    pub fn new(guid: Guid, traits: Traits) -> Self {
        Self {
            guid,
            traits,
            reception: Reception::default(),
            tally: Tally::default(),
            interarrival: Histogram::default(),
            source_latency: Histogram::default(),
            header_latency: Histogram::default(),
            last_message: None,
            negative_latency: 0,
            implausible_latency: 0,
            clock_ahead: 0,
            sampled: None,
            exact: None,
            has_lost_view: false,
            is_filtered: false,
        }
    }

    /// Sets whether it applies a content filter for each reader that is seen to receive its
    /// samples. Missing samples are then irrelevant, because the filters may have rejected them.
    pub const fn filter(&mut self, is_filtered: bool) {
        self.is_filtered = is_filtered;
    }

    /// Updates the properties from discovery.
    pub const fn learn(&mut self, traits: Traits) {
        self.traits = traits;
    }

    /// Sets the nanoseconds by which the clock of its host is ahead of this host's.
    pub const fn set_clock(&mut self, ahead: i64) {
        self.clock_ahead = ahead;
    }

    /// Begins the counts per second at `now`, when the kernel begins to capture all samples of the
    /// writer. Earlier counts stay in the totals.
    pub fn begin_window(&mut self, now: ModelTime) {
        let tally = &mut self.tally;
        tally.earlier = EarlierCounts {
            messages: tally.messages,
            bytes: tally.bytes,
            lost: tally.lost,
        };
        tally.window.begin(now);
    }

    /// Moves the memory of unfinished samples from one budget to another.
    pub fn transfer(&self, from: &mut Budget, to: &mut Budget) {
        self.reception.transfer(from, to);
    }

    /// Allows fragmented samples that begin before `until` to be incomplete without a loss.
    pub const fn allow_incomplete(&mut self, until: ModelTime) {
        self.reception.allow_incomplete(until);
    }

    /// Sets the announced GUID of the writer.
    pub const fn rename(&mut self, guid: Guid) {
        self.guid = guid;
    }

    /// Returns the properties from discovery and HEARTBEATs.
    #[must_use]
    pub const fn traits(&self) -> Traits {
        self.traits
    }

    /// Returns the highest sequence number known to exist, plus one.
    #[must_use]
    pub const fn next(&self) -> SequenceNumber {
        self.reception.sequence().next()
    }

    /// Counts a sample or fragment that arrived again on the same route.
    pub const fn note_retransmission(&mut self) {
        self.tally.duplicates += 1;
    }

    /// Returns whether this sample is counted or settled.
    #[must_use]
    pub fn has(&self, sample: &Sample) -> bool {
        let (at, number) = (sample.head.at, sample.sequence_number);
        let sequence = self.reception.sequence();
        if self.is_pending(sample) {
            return false;
        }
        if sample.head.is_polled() && self.is_exact(at) {
            return true;
        }
        if self.is_unconfirmed(sample) {
            return sequence.has_unconfirmed(number);
        }
        match &self.sampled {
            Some(sampled) if sampled.is_current(at) => sampled.has(number, sequence.next()),
            _ => sequence.has(number),
        }
    }

    /// Returns whether this ACKNACK is refused because it acknowledges numbers far above the known
    /// ones.
    pub const fn refuses(&mut self, acknack: &AckNack) -> bool {
        let sequence = self.reception.sequence_mut();
        sequence.is_too_far_ahead(acknack.base())
    }

    /// Returns the number of messages counted.
    #[must_use]
    pub const fn messages(&self) -> u64 {
        self.tally.messages
    }

    /// Returns the number of samples that did not reach this host, and of all expected samples.
    #[must_use]
    pub const fn share(&self) -> LossShare {
        LossShare {
            lost: self.tally.lost,
            expected: self.tally.messages + self.tally.lost,
        }
    }

    /// Returns the time of the last message.
    #[must_use]
    pub const fn last_message(&self) -> Option<ModelTime> {
        self.last_message
    }

    /// Returns how long the writer may seem silent while it sends, because polling misses messages.
    /// `slowest` is the assumed interval of its messages if it is not known.
    #[must_use]
    pub fn max_unseen_time(&self, slowest: Duration) -> Duration {
        let sampled = self.sampled.as_ref();
        sampled.map_or(Duration::ZERO, |sampled| sampled.max_unseen_time(slowest))
    }

    /// Returns whether no view has shown any of its samples, or none since the uprobe's view ended.
    #[must_use]
    pub const fn is_unseen(&self) -> bool {
        let is_new = self.last_message.is_none() && self.sampled.is_none();
        self.exact.is_none() && (is_new || self.has_lost_view)
    }

    /// Records that bytes between fragments were not captured.
    pub fn interrupt(&mut self) {
        self.reception.interrupt();
    }

    /// Records that samples in shared memory before `now` may have been missed.
    pub fn uncertain(&mut self, now: ModelTime) {
        if let Some(sampled) = self.sampled.as_mut().filter(|each| each.is_current(now)) {
            sampled.uncertain();
        }
    }

    /// Ends the exact view of the writer by uprobes.
    pub fn end_exact_view(&mut self) {
        self.has_lost_view |= self.exact.take().is_some();
    }

    /// Processes an observation of this writer and returns the message that it completed. `opened`
    /// is the time at which this host last began to see its samples; samples missing before that
    /// are irrelevant.
    pub fn observe(
        &mut self,
        observation: &Observation,
        opened: ModelTime,
        context: &mut MeasurementContext<'_>,
    ) -> Option<Counted> {
        let at = context.now;
        let head = observation.head();
        let (is_exact, is_sampled) = (head.is_exact(), head.is_polled());
        let is_history = self.traits.keeps_history && self.is_history(opened, observation, context);
        if is_exact {
            self.exact = self.exact.max(Some(at));
        }
        if let Observation::Sample(sample) = observation
            && self.is_pending(sample)
        {
            return self.catch_up(sample, is_history, context);
        }
        if is_sampled && self.is_exact(at) {
            // The uprobe has reported the sample already, or will report it.
            return None;
        }
        self.has_lost_view &= !matches!(observation, Observation::Sample(_));
        let takes = self
            .sampled
            .as_mut()
            .is_some_and(|sampled| match observation {
                Observation::Sample(_) | Observation::Heartbeat(_) => sampled.takes(at),
                _ => sampled.is_current(at),
            });
        if is_sampled || takes {
            let seen = (is_sampled, is_history);
            let counted = self.sampled_observation(observation, seen, context);
            self.report_unseen(context.journal);
            if let Some(sampled) = self.sampled.as_mut().filter(|_| is_exact) {
                // From now on, the uprobe sees every message.
                sampled.end();
            }
            return counted;
        }
        let sequence = self.reception.sequence_mut();
        let next = sequence.next();
        let is_reopened = sequence.last_advance() < opened;
        sequence.reopen(is_reopened);
        if is_reopened && let Observation::Sample(sample) = observation {
            self.settle_before(sample.sequence_number, context);
        }
        let mut counted = None;
        match observation {
            Observation::Sample(sample) => counted = self.sample(sample, is_history, context),
            Observation::Heartbeat(heartbeat) => {
                self.traits.reliable = true;
                let (reception, mut settling) =
                    self.parts(context.journal, (context.now, context.has_receivers));
                reception.heartbeat(heartbeat, context.budget, &mut |decision| {
                    settling.take(decision);
                });
            }
            Observation::Gap(gap) => {
                let (reception, mut settling) =
                    self.parts(context.journal, (context.now, context.has_receivers));
                reception.gap(gap, context.budget, &mut |decision| {
                    settling.take(decision);
                });
            }
            Observation::AckNack(acknack) => {
                let sequence = self.reception.sequence_mut();
                sequence.requested(acknack.missing.iter());
            }
            Observation::Presence(_) => {}
        }
        let sequence = self.reception.sequence_mut();
        if next > SequenceNumber::ZERO && is_reopened && sequence.next() > next {
            // The newest sample is marked irrelevant too, which has no effect once it is received.
            sequence.mark_irrelevant(next, sequence.next());
        }
        counted
    }

    /// Records that all readers have every sample below `base`.
    pub fn acknowledged(&mut self, base: SequenceNumber) {
        self.reception.sequence_mut().acknowledged(base);
    }

    /// Returns which samples are decided. `acknowledged` states whether readers send ACKNACKs.
    pub fn progress(&mut self, acknowledged: bool, now: ModelTime) -> Progress {
        let waits = self.traits.reliable && acknowledged;
        let is_sampled = self.is_sampled(now);
        let reliable = self.traits.reliable && !is_sampled;
        // While the view waits for a sample in shared memory, the retransmission may use shared
        // memory, too. After the sampled view ended, samples of any writer may arrive after later
        // ones.
        let unseen = self.sampled.as_ref().and_then(|sampled| sampled.unseen());
        let unseen = unseen.filter(|_| waits || !is_sampled);
        let unseen = unseen.unwrap_or(SequenceNumber(u64::MAX));
        let sequence = self.reception.sequence_mut();
        if !waits {
            sequence.skip(sequence.next());
        }
        let complete = sequence.complete();
        Progress {
            incarnation: sequence.incarnation(),
            complete: complete.min(unseen),
            awaited: sequence.awaited(),
            reliable,
            acknowledged,
            unseen: unseen < complete,
        }
    }

    /// Stops waiting for samples below `number`.
    pub fn skip(&mut self, number: SequenceNumber) {
        self.reception.sequence_mut().skip(number);
    }

    /// Returns the time when the wait for a sent but unseen sample began, if there is such a
    /// sample.
    #[must_use]
    pub fn unseen_since(&self) -> Option<ModelTime> {
        self.sampled.as_ref()?.unseen_since()
    }

    /// Settles the samples for which the settle window is over.
    pub fn advance(&mut self, context: &mut MeasurementContext<'_>) {
        if let Some(sampled) = &mut self.sampled {
            sampled.tick(context.now);
            self.report_unseen(context.journal);
        }
        let (now, window) = (context.now, settle_window(self.traits.reliable));
        let (reception, mut settling) =
            self.parts(context.journal, (context.now, context.has_receivers));
        let windows = (window, BEST_EFFORT_WINDOW);
        reception.advance(now, windows, context.budget, &mut |decision| {
            settling.take(decision);
        });
    }

    /// Returns the time from which [`Self::advance`] has an effect without an observation;
    /// [`ModelTime::MAX`] if never.
    #[must_use]
    pub fn next_due(&self) -> ModelTime {
        if self.sampled.is_some() {
            // The steps in which a sampled view stops waiting begin at any tick.
            return ModelTime::ZERO;
        }
        let window = settle_window(self.traits.reliable);
        self.reception.next_due((window, BEST_EFFORT_WINDOW))
    }

    /// Stops waiting for samples in shared memory.
    pub fn settle_sampled(&mut self, context: &mut MeasurementContext<'_>) {
        if let Some(sampled) = &mut self.sampled {
            sampled.settle_all();
            self.report_unseen(context.journal);
        }
    }

    /// Settles all samples at the end of the input.
    pub fn settle(&mut self, context: &mut MeasurementContext<'_>) {
        self.settle_sampled(context);
        let (reception, mut settling) =
            self.parts(context.journal, (context.now, context.has_receivers));
        reception.settle(context.budget, &mut |decision| settling.take(decision));
    }

    /// Returns all counts so far.
    #[must_use]
    #[expect(
        clippy::cast_precision_loss,
        reason = "counts of ten seconds are far below 2^52"
    )]
    pub fn measurement(&self, now: ModelTime) -> Measurement {
        let (slot, seconds) = self.recent(now, SECONDS);
        let per_second = |count: u64| {
            if seconds == 0 {
                0.0
            } else {
                count as f64 / seconds as f64
            }
        };
        Measurement {
            messages: self.tally.messages,
            bytes: self.tally.bytes,
            lost: self.tally.lost,
            loss: self.share(),
            recovered: self.tally.recovered,
            duplicates: self.tally.duplicates,
            incomplete: self.tally.incomplete,
            irrelevant: self.tally.irrelevant,
            last_message: self.last_message,
            rate_hz: per_second(slot.messages),
            bandwidth: per_second(slot.bytes),
            interarrival: self.interarrival,
            source_latency: self.source_latency,
            header_latency: self.header_latency,
            negative_latency: self.negative_latency,
            implausible_latency: self.implausible_latency,
            sequence_jumps: self.reception.sequence().jumps(),
            earlier: self.tally.earlier,
            sampled: self.sampled.as_ref().map(|sampled| sampled.facts()),
        }
    }

    /// Returns the counts of the last whole seconds, and the number of these seconds.
    #[must_use]
    pub fn recent(&self, now: ModelTime, seconds: u64) -> (Slot, u64) {
        self.tally.window.sum(now, seconds)
    }

    /// Splits the borrow into the reception and the accounting of its decisions.
    const fn parts<'a>(
        &'a mut self,
        journal: &'a mut Journal,
        (at, has_receivers): (ModelTime, bool),
    ) -> (&'a mut Reception, Settling<'a>) {
        let settling = Settling {
            tally: &mut self.tally,
            journal,
            writer: self.guid,
            at,
            has_receivers,
            is_filtered: self.is_filtered,
        };
        (&mut self.reception, settling)
    }

    fn sample(
        &mut self,
        sample: &Sample,
        is_history: bool,
        context: &mut MeasurementContext<'_>,
    ) -> Option<Counted> {
        let now = context.now;
        let reliable = self.traits.reliable;
        let (reception, mut settling) =
            self.parts(context.journal, (context.now, context.has_receivers));
        let outcome = reception.sample(sample, reliable, context.budget, &mut |decision| {
            settling.take(decision);
        });
        match outcome {
            Outcome::Open => {}
            // A copy at another socket is not a retransmission; the caller can distinguish them.
            Outcome::Duplicate => {
                self.tally.duplicates += u64::from(sample.head.path == Path::Wire);
            }
            Outcome::Complete(whole) if whole.is_message => {
                self.count(now, whole.bytes, whole.recovered, is_history);
                let wall_clock = context.wall_clock.wall_time(now);
                let (source, stamp) = (whole.source, whole.stamp);
                if !whole.unconfirmed && !is_history {
                    self.delays(
                        whole.number,
                        whole.newest,
                        (source, stamp),
                        (now, wall_clock),
                    );
                }
                return Some(Counted {
                    number: whole.number,
                    bytes: whole.bytes,
                    source: whole.source,
                    stamp: whole.stamp.filter(|_| self.traits.has_header),
                    at: now,
                    began: whole.began,
                    sampled: false,
                    unconfirmed: whole.unconfirmed,
                });
            }
            Outcome::Complete(_) => {}
        }
        None
    }

    /// Decides all known samples if the numbers may restart at `number`, far ahead of them.
    fn settle_before(&mut self, number: SequenceNumber, context: &mut MeasurementContext<'_>) {
        let next = self.reception.sequence().next();
        if number.steps_since(next) > MAX_IRRELEVANT_AT_START {
            let (reception, mut settling) =
                self.parts(context.journal, (context.now, context.has_receivers));
            reception.settle_known(context.budget, &mut |decision| settling.take(decision));
        }
    }

    /// Returns whether the number of this DATA or DATA_FRAG is outside the writer's live run.
    fn is_unconfirmed(&self, sample: &Sample) -> bool {
        let source = sample.source_timestamp.timestamp();
        let sequence = self.reception.sequence();
        sequence.is_unconfirmed(sample.sequence_number, source, reach(&sample.head))
    }

    fn is_exact(&self, now: ModelTime) -> bool {
        let last = self.exact;
        last.is_some_and(|last| last + EXACT_FOR > now)
    }

    /// Counts a message. History for a new reader is left out of the rate.
    fn count(&mut self, now: ModelTime, bytes: u64, recovered: bool, is_history: bool) {
        self.tally.messages += 1;
        self.tally.bytes += bytes;
        self.tally.recovered += u64::from(recovered);
        let slot = self.tally.window.second(now);
        if !is_history {
            slot.messages += 1;
            slot.bytes += bytes;
        }
        if let Some(previous) = self.last_message {
            let interval = seconds(now.nanoseconds_since(previous).max(0));
            if !is_history {
                slot.longest_interval = slot.longest_interval.max(interval as f32);
            }
            self.interarrival.observe(interval);
        }
        self.last_message = self.last_message.max(Some(now));
    }
}

/// Returns the time in which a gap may fill, for a writer that is `reliable` or not.
#[must_use]
pub const fn settle_window(reliable: bool) -> Duration {
    if reliable {
        RELIABLE_WINDOW
    } else {
        BEST_EFFORT_WINDOW
    }
}

/// Effects of settling on the counters.
struct Settling<'a> {
    tally: &'a mut Tally,
    journal: &'a mut Journal,
    writer: Guid,
    at: ModelTime,
    has_receivers: bool,
    is_filtered: bool,
}

impl Settling<'_> {
    fn take(&mut self, decision: Decision) {
        let Decision::Lost {
            first,
            last,
            incomplete,
        } = decision
        else {
            self.tally.irrelevant += 1;
            return;
        };
        if self.is_filtered && !incomplete {
            self.tally.irrelevant += last - first + 1;
            return;
        }
        self.tally.incomplete += u64::from(incomplete);
        self.journal.add_missing(Missing {
            writer: self.writer,
            first,
            last,
            reason: match incomplete {
                true => MissedReason::Incomplete,
                false => MissedReason::Lost,
            },
        });
        let count = last - first + 1;
        self.tally.lost += count;
        self.tally.window.second(self.at).lost += count;
        let loss = Loss {
            at: self.at,
            writer: self.writer,
            first,
            last,
        };
        self.journal.add_loss(loss, self.has_receivers);
    }
}

/// Returns how far ahead the numbers of an observation may be. Polling shared memory misses more
/// numbers.
fn reach(head: &Head) -> u64 {
    if head.is_polled() {
        MAX_ANNOUNCED_JUMP
    } else {
        MAX_TRUSTED_JUMP
    }
}

#[expect(
    clippy::cast_precision_loss,
    reason = "nanoseconds of a delay stay exact to 104 days"
)]
fn seconds(nanoseconds: i64) -> f64 {
    nanoseconds as f64 / 1e9
}

#[cfg(test)]
mod tests;
