//! What is measured of one writer: samples, bytes, losses, intervals, latencies.
//!
//! Fed with records, wherever they come from. A sample counts once, at the record that completes
//! it. An idle writer takes under 2 KiB; what grows with traffic (bitmaps) is bounded in
//! [`super::sequence`] and [`super::samples`].

mod latency;
mod sampled_view;

use ros2probe_wire::record::{AckNack, Body, Sample, flag};
use ros2probe_wire::time::SECOND;
use ros2probe_wire::{Guid, Record, RtpsTime, SequenceNumber, Timestamp};

use super::dispatch::MissedReason;
use super::histogram::Histogram;
use super::in_order::Progress;
use super::journal::{Journal, Missing};
use super::loss::Loss;
use super::measurement::Measurement;
use super::rate::{SECONDS, Slot, Window};
use super::reception::{Decision, Outcome, Reception};
use super::sampled::Sampled;
use super::samples::Budget;
use super::sequence::{FAR, REACH};
use super::size::Size;
use super::wall_clock::WallClock;

/// How long a gap of a best-effort writer may fill by reordering.
pub const BEST_EFFORT_WINDOW: u64 = SECOND;
/// How long a reliable writer may take to retransmit: three of Fast DDS's HEARTBEAT periods.
pub const RELIABLE_WINDOW: u64 = 10 * SECOND;
/// A first sample older than this is history that a late joiner asked for.
const HISTORY: u64 = 10 * SECOND;

/// A writer that was seen in its own process is so for this long after its last record: what else
/// is read in shared memory in that time has been seen.
const EXACT_FOR: u64 = 10 * SECOND;

/// What discovery says about the writer; all false while it is unknown.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Traits {
    /// It retransmits. Also concluded from its HEARTBEATs.
    pub reliable: bool,
    /// It sends old samples to late joiners.
    pub keeps_history: bool,
    /// Its messages begin with a `std_msgs/Header`.
    pub has_header: bool,
}

/// What one record changes besides the writer itself.
#[derive(Debug)]
pub struct MeasurementContext<'a> {
    /// The time of the record, or of the look at the clock.
    pub now: Timestamp,
    /// Memory for fragmented samples.
    pub budget: &'a mut Budget,
    /// Where losses are told.
    pub journal: &'a mut Journal,
    /// What the writer's clock is held against.
    pub wall_clock: WallClock,
}

/// A message as it was counted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Counted {
    /// Its sequence number.
    pub number: SequenceNumber,
    /// Payload bytes, encapsulation included.
    pub bytes: u64,
    /// INFO_TS.
    pub source: RtpsTime,
    /// Its header's stamp, where the type begins with a header.
    pub stamp: Option<(i32, u32)>,
    /// Time of the datagram that completed it.
    pub at: Timestamp,
    /// Time of its first one.
    pub began: Timestamp,
    /// It was seen where not every message is seen.
    pub sampled: bool,
    /// Its number is not believed to be the writer's: it has no place in an order.
    pub unconfirmed: bool,
}

/// One measured writer.
#[derive(Debug)]
pub struct Writer {
    guid: Guid,
    traits: Traits,
    reception: Reception,
    tally: Tally,
    interarrival: Histogram,
    source_latency: Histogram,
    header_latency: Histogram,
    last_message: Option<Timestamp>,
    negative_latency: u64,
    implausible_latency: u64,
    /// Of a writer that was seen in shared memory.
    sampled: Option<Box<Sampled>>,
    /// Of a writer that was seen in the process that it belongs to: its last record from there.
    exact: Option<Timestamp>,
}

/// The counters that settling changes.
#[derive(Debug, Default)]
struct Tally {
    messages: u64,
    bytes: u64,
    lost: u64,
    recovered: u64,
    duplicates: u64,
    incomplete: u64,
    irrelevant: u64,
    window: Window,
}

impl Writer {
    /// Nothing measured yet.
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
            sampled: None,
            exact: None,
        }
    }

    /// Entries, or bytes, and cap of every list.
    pub fn sizes(&self) -> impl Iterator<Item = Size> {
        // A new list does not compile before it has a place here.
        let Self {
            guid: _,
            traits: _,
            reception,
            tally: _,
            interarrival: _,
            source_latency: _,
            header_latency: _,
            last_message: _,
            negative_latency: _,
            implausible_latency: _,
            sampled,
            exact: _,
        } = self;
        let sampled = sampled.iter().flat_map(|sampled| sampled.sizes());
        reception.sizes().chain(sampled)
    }

    /// Discovery says more.
    pub const fn learn(&mut self, traits: Traits) {
        self.traits = traits;
    }

    /// Moves what its unfinished samples take from one budget to another.
    pub fn transfer(&self, from: &mut Budget, to: &mut Budget) {
        self.reception.transfer(from, to);
    }

    /// Samples in fragments that begin before this may lack some that nobody lost.
    pub const fn allow_incomplete(&mut self, until: Timestamp) {
        self.reception.allow_incomplete(until);
    }

    /// What discovery and its HEARTBEATs said.
    #[must_use]
    pub const fn traits(&self) -> Traits {
        self.traits
    }

    /// One past the highest number known to exist.
    #[must_use]
    pub const fn next(&self) -> SequenceNumber {
        self.reception.sequence().next()
    }

    /// A sample or fragment came again the way it had come before.
    pub const fn came_again(&mut self) {
        self.tally.duplicates += 1;
    }

    /// Whether this sample needs nothing more: it was counted, or is settled.
    #[must_use]
    pub fn has(&self, sample: Sample<'_>) -> bool {
        let record = sample.record();
        let (number, at) = (sample.sequence_number(), record_time(record));
        let sequence = self.reception.sequence();
        if self.is_under_way(sample) {
            return false;
        }
        if is_polled(record) && self.is_exact(at) {
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

    /// Whether this ACKNACK acknowledges samples that are not known to exist.
    pub const fn refuses(&mut self, acknack: AckNack<'_>) -> bool {
        let sequence = self.reception.sequence_mut();
        sequence.refuses(acknack.base())
    }

    /// Messages counted.
    #[must_use]
    pub const fn messages(&self) -> u64 {
        self.tally.messages
    }

    /// Time of the last one.
    #[must_use]
    pub const fn last_message(&self) -> Option<Timestamp> {
        self.last_message
    }

    /// The tap on shared memory cannot tell what passed before `now`.
    pub fn uncertain(&mut self, now: Timestamp) {
        if let Some(sampled) = self.sampled.as_mut().filter(|each| each.is_current(now)) {
            sampled.uncertain();
        }
    }

    /// It is no longer seen in the process that it belongs to.
    pub const fn end_exact_view(&mut self) {
        self.exact = None;
    }

    /// Takes in a record of this writer; gives the message that it completed. `opened` is when last
    /// a way for its samples was opened that this host sees: what is missing before it went
    /// elsewhere.
    pub fn record(
        &mut self,
        record: &Record,
        opened: Timestamp,
        context: &mut MeasurementContext<'_>,
    ) -> Option<Counted> {
        let at = record_time(record);
        let is_exact = record.flags & flag::EXACT != 0;
        let is_sampled = is_polled(record);
        if is_exact {
            self.exact = self.exact.max(Some(at));
        }
        let body = record.body();
        if let Body::Sample(sample) = body
            && self.is_under_way(sample)
        {
            return self.catch_up(sample, context);
        }
        if is_sampled && self.is_exact(at) {
            // It has been seen already, or is on its way.
            return None;
        }
        let takes = self.sampled.as_mut().is_some_and(|sampled| match body {
            Body::Sample(_) | Body::Heartbeat(_) => sampled.takes(at),
            _ => sampled.is_current(at),
        });
        if is_sampled || takes {
            let counted = self.sampled_record(record, is_sampled, context);
            self.leave_unseen(context.journal);
            if let Some(sampled) = self.sampled.as_mut().filter(|_| is_exact) {
                // From here on every message is seen.
                sampled.end();
            }
            return counted;
        }
        let sequence = self.reception.sequence();
        let before = (sequence.next(), sequence.last_advance());
        let mut counted = None;
        match body {
            Body::Sample(sample) => counted = self.sample(sample, context),
            Body::Heartbeat(heartbeat) => {
                self.traits.reliable = true;
                let (reception, mut settling) = self.parts(context.journal, context.now);
                reception.heartbeat(heartbeat, context.budget, &mut |decision| {
                    settling.take(decision);
                });
            }
            Body::Gap(gap) => {
                let (reception, mut settling) = self.parts(context.journal, context.now);
                reception.gap(gap, context.budget, &mut |decision| {
                    settling.take(decision);
                });
            }
            Body::AckNack(acknack) => {
                let sequence = self.reception.sequence_mut();
                sequence.requested(acknack.missing().iter());
            }
            Body::Complete | Body::Handover | Body::Undelivered | Body::Unknown => {}
        }
        let (next, advanced) = before;
        let sequence = self.reception.sequence_mut();
        if next > SequenceNumber::ZERO && advanced < opened && sequence.next() > next {
            // The newest one is excused too, which means nothing once it is received.
            sequence.excuse(next, sequence.next());
        }
        counted
    }

    /// Its readers have all below `base`.
    pub fn acknowledged(&mut self, base: SequenceNumber) {
        self.reception.sequence_mut().acknowledged(base);
    }

    /// How far its samples are decided; `acknowledged` = by readers that acknowledge.
    pub fn progress(&mut self, acknowledged: bool, now: Timestamp) -> Progress {
        let waits = self.traits.reliable && acknowledged;
        let reliable = self.traits.reliable && !self.is_sampled(now);
        // A repair may pass by shared memory, too, as long as a sample is looked for there.
        let unseen = self.sampled.as_ref().and_then(|sampled| sampled.unseen());
        let unseen = unseen.filter(|_| waits).unwrap_or(SequenceNumber(u64::MAX));
        let sequence = self.reception.sequence_mut();
        if !waits {
            sequence.skip(sequence.next());
        }
        Progress {
            incarnation: sequence.incarnation(),
            complete: sequence.complete().min(unseen),
            awaited: sequence.awaited(),
            reliable,
            acknowledged,
        }
    }

    /// Nothing below `number` is waited for any more.
    pub fn skip(&mut self, number: SequenceNumber) {
        self.reception.sequence_mut().skip(number);
    }

    /// Since when a sample is waited for that was sent and not seen.
    #[must_use]
    pub fn unseen_since(&self) -> Option<Timestamp> {
        self.sampled.as_ref()?.unseen_since()
    }

    /// Settles what has waited long enough.
    pub fn advance(&mut self, context: &mut MeasurementContext<'_>) {
        if let Some(sampled) = &mut self.sampled {
            sampled.tick(context.now);
            self.leave_unseen(context.journal);
        }
        let (now, window) = (context.now, settle_window(self.traits.reliable));
        let (reception, mut settling) = self.parts(context.journal, context.now);
        let windows = (window, BEST_EFFORT_WINDOW);
        reception.advance(now, windows, context.budget, &mut |decision| {
            settling.take(decision);
        });
    }

    /// Settles everything: nothing more will come.
    pub fn settle(&mut self, context: &mut MeasurementContext<'_>) {
        if let Some(sampled) = &mut self.sampled {
            sampled.settle_all();
            self.leave_unseen(context.journal);
        }
        let (reception, mut settling) = self.parts(context.journal, context.now);
        reception.settle(context.budget, &mut |decision| settling.take(decision));
    }

    /// Everything counted so far.
    #[must_use]
    #[expect(
        clippy::cast_precision_loss,
        reason = "counts of ten seconds are far below 2^52"
    )]
    pub fn measurement(&self, now: Timestamp) -> Measurement {
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
            sampled: self.sampled.as_ref().map(|sampled| sampled.facts()),
        }
    }

    /// Counts of the last whole seconds, and how many those are.
    #[must_use]
    pub fn recent(&self, now: Timestamp, seconds: u64) -> (Slot, u64) {
        self.tally.window.sum(now, seconds)
    }

    /// The reception, and what its decisions change.
    const fn parts<'a>(
        &'a mut self,
        journal: &'a mut Journal,
        at: Timestamp,
    ) -> (&'a mut Reception, Settling<'a>) {
        let settling = Settling {
            tally: &mut self.tally,
            journal,
            writer: self.guid,
            at,
        };
        (&mut self.reception, settling)
    }

    fn sample(
        &mut self,
        sample: Sample<'_>,
        context: &mut MeasurementContext<'_>,
    ) -> Option<Counted> {
        let record = sample.record();
        let now = record_time(record);
        let reliable = self.traits.reliable;
        let (reception, mut settling) = self.parts(context.journal, context.now);
        let outcome = reception.sample(sample, reliable, context.budget, &mut |decision| {
            settling.take(decision);
        });
        match outcome {
            Outcome::Open => {}
            // Seen at several sockets is not sent again: there the caller knows.
            Outcome::Duplicate => {
                self.tally.duplicates += u64::from(record.flags & (flag::HOST | flag::SHM) == 0);
            }
            Outcome::Whole(whole) if whole.is_message => {
                self.count(now, whole.bytes, whole.recovered);
                let wall_clock = context.wall_clock.wall_time(now);
                let (source, stamp) = (whole.source, whole.stamp);
                if !whole.unconfirmed {
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
            Outcome::Whole(_) => {}
        }
        None
    }

    /// Whether the number of this DATA or DATA_FRAG is away from those that the writer uses.
    fn is_unconfirmed(&self, sample: Sample<'_>) -> bool {
        let source = sample.source_timestamp().timestamp();
        let sequence = self.reception.sequence();
        sequence.is_unconfirmed(sample.sequence_number(), source, reach(sample.record()))
    }

    fn is_exact(&self, now: Timestamp) -> bool {
        let last = self.exact;
        last.is_some_and(|last| last.0.saturating_add(EXACT_FOR) > now.0)
    }

    fn count(&mut self, now: Timestamp, bytes: u64, recovered: bool) {
        self.tally.messages += 1;
        self.tally.bytes += bytes;
        self.tally.recovered += u64::from(recovered);
        let slot = self.tally.window.current(now);
        slot.messages += 1;
        slot.bytes += bytes;
        if let Some(previous) = self.last_message {
            self.interarrival
                .observe(seconds(now.nanoseconds_since(previous).max(0)));
        }
        self.last_message = self.last_message.max(Some(now));
    }
}

/// How long the gap of a writer may fill that retransmits, or does not.
#[must_use]
pub const fn settle_window(reliable: bool) -> u64 {
    if reliable {
        RELIABLE_WINDOW
    } else {
        BEST_EFFORT_WINDOW
    }
}

/// What settling does to the counters.
struct Settling<'a> {
    tally: &'a mut Tally,
    journal: &'a mut Journal,
    writer: Guid,
    at: Timestamp,
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
        self.tally.incomplete += u64::from(incomplete);
        self.journal.leave_missing(Missing {
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
        self.tally.window.current(self.at).lost += count;
        self.journal.lose(Loss {
            at: self.at,
            writer: self.writer,
            first,
            last,
        });
    }
}

/// How far ahead of those that came the numbers of a record may be: looks at shared memory miss
/// more.
const fn reach(record: &Record) -> u64 {
    if is_polled(record) { FAR } else { REACH }
}

/// Whether it was read in shared memory, where others may have been missed.
const fn is_polled(record: &Record) -> bool {
    record.flags & (flag::SHM | flag::EXACT) == flag::SHM
}

const fn record_time(record: &Record) -> Timestamp {
    Timestamp(record.time)
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
