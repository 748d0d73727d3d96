//! What is measured of one writer: samples, bytes, losses, intervals, latencies.
//!
//! Fed with records, wherever they come from. A sample counts once, at the record that completes
//! it. An idle writer takes under 2 KiB; what grows with traffic (bitmaps) is bounded in
//! [`super::sequence`] and [`super::samples`].

use ros2probe_wire::record::kind;
use ros2probe_wire::{Guid, Record, RtpsTime, Timestamp};

use super::header::stamp_time;
use super::histogram::Histogram;
use super::journal::{Journal, Loss};
use super::rate::{SECONDS, Slot, Window};
use super::samples::{Budget, Progress, Samples};
use super::sequence::{Arrival, Delivery, Sequence, Settled};
use super::snapshot::Measurement;

/// How long a gap of a best-effort writer may fill by reordering.
pub const BEST_EFFORT_WINDOW: u64 = 1_000_000_000;
/// How long a reliable writer may take to retransmit: three of Fast DDS's HEARTBEAT periods.
pub const RELIABLE_WINDOW: u64 = 10_000_000_000;
/// A fragment that completes its sample this late after the sample's last one was retransmitted.
const REPAIR: i64 = 5_000_000;
/// A first sample older than this is history that a late joiner asked for.
const HISTORY: u64 = 10_000_000_000;
const DATA_FLAG: u8 = 0x04;
const FRAGMENT_KEY_FLAG: u8 = 0x04;

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
pub struct Scene<'a> {
    /// The time of the record, or of the look at the clock.
    pub now: Timestamp,
    /// Memory for fragmented samples.
    pub budget: &'a mut Budget,
    /// Where losses are told.
    pub journal: &'a mut Journal,
}

/// One measured writer.
#[derive(Debug)]
pub struct Writer {
    guid: Guid,
    traits: Traits,
    sequence: Sequence,
    samples: Samples,
    tally: Tally,
    interarrival: Histogram,
    source_latency: Histogram,
    header_latency: Histogram,
    last_message: Option<Timestamp>,
    negative_latency: u64,
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
            sequence: Sequence::default(),
            samples: Samples::default(),
            tally: Tally::default(),
            interarrival: Histogram::default(),
            source_latency: Histogram::default(),
            header_latency: Histogram::default(),
            last_message: None,
            negative_latency: 0,
        }
    }

    /// Discovery says more.
    pub const fn learn(&mut self, traits: Traits) {
        self.traits = traits;
    }

    /// Moves what its unfinished samples take from one budget to another.
    pub fn transfer(&self, from: &mut Budget, to: &mut Budget) {
        self.samples.transfer(from, to);
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

    /// Takes in a record of this writer. `opened` is when last a way for its samples was opened
    /// that this host sees: what is missing before it went elsewhere.
    pub fn record(&mut self, record: &Record, opened: Timestamp, scene: &mut Scene<'_>) {
        let before = (self.sequence.next(), self.sequence.last_advance());
        match record.kind {
            kind::DATA => self.data(record, scene),
            kind::DATA_FRAG => self.fragment(record, scene),
            kind::HEARTBEAT => {
                self.traits.reliable = true;
                let (first, last) = (record.sequence_number, record.second_sequence_number());
                let (sequence, mut settling) = self.parts(scene);
                sequence.heartbeat(first, last, record_time(record), &mut |settled| {
                    settling.take(settled);
                });
            }
            kind::GAP => {
                let (start, base) = (record.sequence_number, record.second_sequence_number());
                let set = record.bitmap().map(|bit| base.saturating_add(bit.into()));
                let (sequence, mut settling) = self.parts(scene);
                sequence.gap(start, base, set, record_time(record), &mut |settled| {
                    settling.take(settled);
                });
            }
            kind::ACKNACK => {
                let base = record.sequence_number;
                let set = record.bitmap().map(|bit| base.saturating_add(bit.into()));
                self.sequence.requested(set);
            }
            _ => {}
        }
        let (next, advanced) = before;
        if next > 0 && advanced < opened && self.sequence.next() > next {
            // The newest one is excused too, which means nothing once it is received.
            self.sequence.excuse(next, self.sequence.next());
        }
    }

    /// Settles what has waited long enough.
    pub fn advance(&mut self, scene: &mut Scene<'_>) {
        let window = self.settle_window();
        let hold = self.samples.growing(scene.now, window);
        let now = scene.now;
        let (sequence, mut settling) = self.parts(scene);
        sequence.advance(now, window, hold, &mut |settled| settling.take(settled));
        self.samples.expire(now, 2 * window, scene.budget);
    }

    /// Settles everything: nothing more will come.
    pub fn settle(&mut self, scene: &mut Scene<'_>) {
        let (sequence, mut settling) = self.parts(scene);
        sequence.settle_all(&mut |settled| settling.take(settled));
        self.samples.clear(scene.budget);
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
        }
    }

    /// Counts of the last whole seconds, and how many those are.
    #[must_use]
    pub fn recent(&self, now: Timestamp, seconds: u64) -> (Slot, u64) {
        self.tally.window.sum(now, seconds)
    }

    /// The sequence, and what its verdicts change.
    const fn parts<'a>(&'a mut self, scene: &'a mut Scene<'_>) -> (&'a mut Sequence, Settling<'a>) {
        let settling = Settling {
            tally: &mut self.tally,
            samples: &mut self.samples,
            budget: scene.budget,
            journal: scene.journal,
            writer: self.guid,
            at: scene.now,
        };
        (&mut self.sequence, settling)
    }

    const fn settle_window(&self) -> u64 {
        if self.traits.reliable {
            RELIABLE_WINDOW
        } else {
            BEST_EFFORT_WINDOW
        }
    }

    fn data(&mut self, record: &Record, scene: &mut Scene<'_>) {
        let number = record.sequence_number;
        self.sequence
            .recognise(number, record.source_timestamp().timestamp());
        let delivery = if self.traits.reliable {
            Delivery::Reliable
        } else {
            Delivery::BestEffort
        };
        let now = record_time(record);
        let (sequence, mut settling) = self.parts(scene);
        let arrival =
            sequence.receive(number, delivery, now, &mut |settled| settling.take(settled));
        self.samples.forget(number, scene.budget);
        match arrival {
            Arrival::Duplicate => self.tally.duplicates += 1,
            Arrival::New { recovered, newest } => {
                // A key alone is a disposal, and it takes a sequence number like any sample.
                if record.submessage_flags & DATA_FLAG == 0 || record.status_info != 0 {
                    return;
                }
                self.count(now, record.payload_len.into(), recovered);
                let stamp = record.header_stamp();
                self.delays(number, newest, record.source_timestamp(), stamp, now);
            }
        }
    }

    fn fragment(&mut self, record: &Record, scene: &mut Scene<'_>) {
        let number = record.sequence_number;
        let now = record_time(record);
        self.sequence
            .recognise(number, record.source_timestamp().timestamp());
        if self.sequence.has(number) {
            self.tally.duplicates += 1;
            return;
        }
        match self.samples.fragment(record, now, scene.budget) {
            Progress::Rejected => {}
            Progress::TooMany => {
                self.sequence.begin(number);
                let (sequence, mut settling) = self.parts(scene);
                sequence.exists(number, now, &mut |settled| settling.take(settled));
                sequence.excuse(number, number.saturating_add(1));
            }
            Progress::Duplicate => self.tally.duplicates += 1,
            progress => {
                // A sample that is joined in the middle does not count as one that was sent; the
                // writer's first one cannot be.
                let joined = u64::from(record.fragment_start != 1 && number > 1);
                self.sequence.begin(number.saturating_add(joined));
                let reliable = self.traits.reliable;
                let (sequence, mut settling) = self.parts(scene);
                sequence.exists(number, now, &mut |settled| settling.take(settled));
                let Progress::Complete(facts) = progress else {
                    return;
                };
                let delivery = if reliable {
                    Delivery::ReliableFragments
                } else {
                    Delivery::BestEffort
                };
                let arrival =
                    sequence.receive(number, delivery, now, &mut |settled| settling.take(settled));
                let Arrival::New { recovered, .. } = arrival else {
                    return;
                };
                let is_key = record.submessage_flags & FRAGMENT_KEY_FLAG != 0;
                if is_key || record.status_info != 0 {
                    return;
                }
                let repaired = reliable && facts.repaired_after >= REPAIR;
                self.count(now, facts.size.into(), recovered || repaired);
                self.delays(number, true, facts.source, facts.stamp, now);
            }
        }
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

    fn delays(
        &mut self,
        number: u64,
        newest: bool,
        source: RtpsTime,
        stamp: Option<(i32, u32)>,
        now: Timestamp,
    ) {
        let source = source.timestamp();
        if self.traits.keeps_history {
            let old = source.is_none_or(|source| source.0.saturating_add(HISTORY) < now.0);
            if !newest || number < self.sequence.first() || number == self.sequence.first() && old {
                return;
            }
        }
        let stamp = stamp
            .filter(|_| self.traits.has_header)
            .and_then(|stamp| stamp_time(stamp, now));
        let mut negative = false;
        if let Some(source) = source {
            let delay = now.nanoseconds_since(source);
            negative |= delay < 0;
            if delay >= 0 {
                self.source_latency.observe(seconds(delay));
                let slot = self.tally.window.current(now);
                slot.delayed += 1;
                slot.delay += seconds(delay);
            }
        }
        if let Some(stamp) = stamp {
            let delay = now.nanoseconds_since(stamp);
            negative |= delay < 0;
            if delay >= 0 {
                self.header_latency.observe(seconds(delay));
            }
        }
        self.negative_latency += u64::from(negative);
    }
}

/// What settling does to the counters.
struct Settling<'a> {
    tally: &'a mut Tally,
    samples: &'a mut Samples,
    budget: &'a mut Budget,
    journal: &'a mut Journal,
    writer: Guid,
    at: Timestamp,
}

impl Settling<'_> {
    fn take(&mut self, settled: Settled) {
        let (first, last) = match settled {
            Settled::Lost(number) => (number, number),
            Settled::LostRun(start, end) => (start, end.saturating_sub(1)),
            // A sample of which fragments came was sent: no excuse holds.
            Settled::Irrelevant(number) if self.samples.is_partial(number) => (number, number),
            Settled::Irrelevant(_) => {
                self.tally.irrelevant += 1;
                return;
            }
        };
        self.tally.incomplete += u64::from(self.samples.forget(first, self.budget));
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
