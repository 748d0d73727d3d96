//! What a sampled view tells of one writer: how many samples there were, and how many of them were
//! seen.
//!
//! Shared memory is looked at now and then; what was overwritten meanwhile is not seen. The
//! sequence numbers still tell how many samples there were, so messages are counted by their span,
//! and no number that was not seen is a loss. While a writer is seen this way, what comes of it by
//! the network counts here too: it adds to what was seen.

use ros2probe_wire::time::{MILLISECOND, SECOND};
use ros2probe_wire::{SequenceNumber, Timestamp};

use super::measurement::SampledFacts;
use super::sequence::{MAX_WINDOW, Run, RunMembership, Sequence};
use super::size::Size;

/// A writer that was not seen in shared memory for so long is not sampled any more.
const HOLD: u64 = 10 * SECOND;
/// How long a sample that was not seen may still come by another way before it is left out.
const PATIENCE: u64 = 200 * MILLISECOND;
/// Numbers below the next one of which it is known one by one whether they were seen.
const WINDOW: u64 = u128::BITS as u64;

/// State of one writer's sampled view.
#[derive(Debug)]
pub struct Sampled {
    /// Last record from shared memory.
    last: Timestamp,
    /// Something came by the network since shared memory fell silent.
    left: bool,
    span: u64,
    seen: u64,
    uncertain: u64,
    /// Messages that a HEARTBEAT or an ACKNACK told of, and whose size nothing has told yet.
    unmeasured: u64,
    /// Bit `i`: the number `i + 1` below the next one was seen, or needs not be.
    sighted: u128,
    /// Likewise: all of it was seen, or its last fragment while others were not.
    finished: u128,
    /// The number to which these bits belong.
    next: SequenceNumber,
    /// Nothing below this is waited for.
    settled: SequenceNumber,
    /// When [`Self::tick`] last settled, and the next number at that time.
    last_settled: (Timestamp, SequenceNumber),
    /// Runs of numbers that were settled without being seen.
    unseen: Vec<(SequenceNumber, SequenceNumber)>,
    /// The latest number that arrived whole as far as can be told, and when.
    arrived: Option<(SequenceNumber, Timestamp)>,
    /// Where its payload begins with a header: the stamp that came with the first fragment.
    head: Option<(SequenceNumber, (i32, u32))>,
}

/// What a record changed.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub struct SampledUpdate {
    /// Numbers that are now known to be used, the record's own included.
    pub samples: u64,
    /// Samples that may be taken for as large as this one: those, and others that were told of.
    pub alike: u64,
    /// Time since the number before it arrived, when that was seen.
    pub interval: Option<i64>,
    /// It is the newest one and has arrived: its delay is a delivery delay.
    pub arrived: bool,
    /// Nothing more of it is waited for, for the first time.
    pub finished: bool,
    /// Its number is not believed to be the writer's.
    pub unconfirmed: bool,
}

/// What was seen of a sample, its latest record included.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Seen {
    /// A part of it, of which more follows.
    Part,
    /// Its last fragment, while others are missing.
    Tail,
    /// All of it.
    Whole,
}

impl Sampled {
    /// From now on.
    #[must_use]
    pub const fn new(now: Timestamp) -> Self {
        Self {
            last: now,
            left: false,
            span: 0,
            seen: 0,
            uncertain: 0,
            unmeasured: 0,
            sighted: u128::MAX,
            finished: u128::MAX,
            next: SequenceNumber::ZERO,
            settled: SequenceNumber::ZERO,
            last_settled: (now, SequenceNumber::ZERO),
            unseen: Vec::new(),
            arrived: None,
            head: None,
        }
    }

    /// Entries and cap; it is taken after each record.
    #[must_use]
    pub fn sizes(&self) -> [Size; 1] {
        // A new list does not compile before it has a place here.
        let Self {
            last: _,
            left: _,
            span: _,
            seen: _,
            uncertain: _,
            unmeasured: _,
            sighted: _,
            finished: _,
            next: _,
            settled: _,
            last_settled: _,
            unseen,
            arrived: _,
            head: _,
        } = self;
        [Size::new("sampled.unseen", unseen.len(), 0)]
    }

    /// A record came from shared memory.
    pub fn touch(&mut self, now: Timestamp) {
        self.last = self.last.max(now);
        self.left = false;
    }

    /// Whether it still is seen that way.
    #[must_use]
    pub const fn is_current(&self, now: Timestamp) -> bool {
        self.last.0.saturating_add(HOLD) > now.0
    }

    /// Whether a record at `now` still belongs here: while it is seen that way, and the first one
    /// after that, for what is missing before it may have gone through shared memory.
    pub const fn takes(&mut self, now: Timestamp) -> bool {
        let takes = self.is_current(now) || !self.left;
        self.left |= !self.is_current(now);
        takes
    }

    /// It is seen otherwise from now on. Samples under way may still come, until [`Self::tick`]
    /// settles them.
    pub const fn end(&mut self) {
        (self.last, self.left) = (Timestamp(0), true);
    }

    /// Whether this sample is sent and still waited for.
    #[must_use]
    pub fn awaits(&self, number: SequenceNumber) -> bool {
        let bit = self.bit(number, self.next);
        number >= self.settled && bit.is_some_and(|bit| self.finished & bit == 0)
    }

    /// Takes in a sample that [`Self::awaits`], or a fragment of one, after [`Self::end`].
    pub fn catch_up(&mut self, number: SequenceNumber, seen: Seen) -> SampledUpdate {
        SampledUpdate {
            finished: self.sight(number, seen),
            ..SampledUpdate::default()
        }
    }

    /// Takes over these samples, counted already, of which another view saw a part. `next` is the
    /// number after the newest.
    pub fn take_over(&mut self, partial: &[SequenceNumber], next: SequenceNumber, now: Timestamp) {
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

    /// Waits no longer for what was missing at the last look and is still.
    pub fn tick(&mut self, now: Timestamp) {
        let (then, next) = self.last_settled;
        if now.0.saturating_sub(then.0) >= PATIENCE {
            self.settle(next.min(self.next));
            self.last_settled = (now, self.next);
        }
    }

    /// Waits for nothing any longer.
    pub fn settle_all(&mut self) {
        self.settle(self.next);
    }

    /// Since when a sample is waited for.
    #[must_use]
    pub fn unseen_since(&self) -> Option<Timestamp> {
        self.unseen().map(|_| self.last_settled.0)
    }

    /// The lowest number of a sample that is waited for.
    #[must_use]
    pub fn unseen(&self) -> Option<SequenceNumber> {
        let open = self.next.steps_since(self.settled);
        let open = u32::try_from(open).unwrap_or(u32::MAX);
        let open = 1_u128.checked_shl(open).map_or(u128::MAX, |bit| bit - 1);
        let highest = (!self.finished & open).checked_ilog2()?;
        let below = u64::from(highest) + 1;
        self.next.0.checked_sub(below).map(SequenceNumber)
    }

    /// Runs of numbers that were sent and not seen, first and last, each once.
    pub fn take_unseen(&mut self) -> Vec<(SequenceNumber, SequenceNumber)> {
        std::mem::take(&mut self.unseen)
    }

    /// The tap cannot tell what passed before `now`.
    pub const fn uncertain(&mut self) {
        self.uncertain += 1;
    }

    /// So far.
    #[must_use]
    pub const fn facts(&self) -> SampledFacts {
        SampledFacts {
            seen: self.seen,
            span: self.span,
            uncertain: self.uncertain,
        }
    }

    /// Whether nothing more is waited for of this sample, where `next` is the number after the
    /// newest.
    #[must_use]
    pub fn has(&self, number: SequenceNumber, next: SequenceNumber) -> bool {
        number < next
            && self
                .bit(number, next)
                .is_none_or(|bit| self.finished & bit != 0)
    }

    /// Takes in a sample or a fragment of one: its number, how much of it, its source time. Up to
    /// `reach` numbers before it may have been missed.
    pub fn sample(
        &mut self,
        (number, seen, source): (SequenceNumber, Seen, Option<Timestamp>),
        reach: u64,
        now: Timestamp,
        sequence: &mut Sequence,
    ) -> SampledUpdate {
        if !number.is_valid() {
            return SampledUpdate::default();
        }
        let before = sequence.next();
        self.follow(before, now);
        let is_told_only = self
            .bit(number, before)
            .is_some_and(|bit| self.sighted & bit == 0);
        let belief = match source {
            // It is late and not of a writer that begins anew.
            Some(source) if is_told_only => {
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
            // It begins, perhaps anew.
            self.settle_all();
            self.begin(sequence.next(), now);
            self.arrived = None;
        }
        let end = run.numbers.iter().map(|(number, _)| *number).max();
        let end = end.unwrap_or_default().max(number).next();
        let samples = self.advance(end, true, now, sequence);
        let samples = self.confirm(&run, samples);
        self.span += samples;
        let below = sequence.next().steps_since(number.next());
        let finished = self.sight(number, seen);
        let mut update = SampledUpdate {
            samples,
            alike: samples.saturating_add(std::mem::take(&mut self.unmeasured)),
            finished,
            ..SampledUpdate::default()
        };
        let is_later = self.arrived.is_none_or(|(arrived, _)| arrived < number);
        if seen != Seen::Part && below == 0 && is_later {
            update.arrived = true;
            update.interval = self
                .arrived
                .filter(|(arrived, _)| arrived.next() == number)
                .map(|(_, at)| now.nanoseconds_since(at).max(0));
            self.arrived = Some((number, now));
        }
        update
    }

    /// Samples up to `last` exist, as a HEARTBEAT or an ACKNACK says. How many that was not known
    /// of.
    pub fn exist(
        &mut self,
        last: SequenceNumber,
        reach: u64,
        now: Timestamp,
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

    /// The numbers `start..end` were never sent, as a GAP says. How many before them were that was
    /// not known of.
    pub fn skip(
        &mut self,
        (start, end): (SequenceNumber, SequenceNumber),
        reach: u64,
        now: Timestamp,
        sequence: &mut Sequence,
    ) -> u64 {
        if start == SequenceNumber::ZERO {
            return 0;
        }
        let samples = self.exist(start.previous(), reach, now, sequence);
        let ahead = end.steps_since(sequence.next());
        if sequence.started() && start <= sequence.next() && ahead <= reach {
            let skipped = self.advance(end, false, now, sequence);
            let bits = u32::try_from(skipped).unwrap_or(u32::MAX);
            let skipped = 1_u128.checked_shl(bits).map_or(u128::MAX, |bit| bit - 1);
            self.sighted |= skipped;
            self.finished |= skipped;
        }
        samples
    }

    /// Keeps the stamp of a sample that began, or gives that of one that did.
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

    /// Takes in a sample whose number is not believed.
    fn unconfirmed(
        &mut self,
        (number, seen): (SequenceNumber, Seen),
        new: bool,
        sequence: &mut Sequence,
    ) -> SampledUpdate {
        let samples = u64::from(new);
        self.span += samples;
        self.seen += samples;
        SampledUpdate {
            samples,
            alike: samples,
            finished: seen != Seen::Part && sequence.complete_unconfirmed(number),
            unconfirmed: true,
            ..SampledUpdate::default()
        }
    }

    /// Marks the samples of a run that is believed as seen. Returns how many of `samples` new
    /// numbers were not counted while it was unconfirmed.
    fn confirm(&mut self, run: &Run, samples: u64) -> u64 {
        for &(number, is_whole) in &run.numbers {
            let bit = self.bit(number, self.next).unwrap_or(0);
            self.sighted |= bit;
            if is_whole {
                self.finished |= bit;
            }
        }
        samples.saturating_sub(run.numbers.len() as u64)
    }

    /// Marks a sample as seen: whether nothing more of it is waited for, for the first time.
    fn sight(&mut self, number: SequenceNumber, seen: Seen) -> bool {
        let bit = self.bit(number, self.next).unwrap_or(0);
        if self.sighted & bit != bit {
            self.sighted |= bit;
            self.seen += 1;
        }
        let finished = seen != Seen::Part && self.awaits(number);
        if finished {
            self.finished |= bit;
        }
        finished
    }

    /// The bit of a number among those below `next`.
    fn bit(&self, number: SequenceNumber, next: SequenceNumber) -> Option<u128> {
        let below = next.0.checked_sub(number.0)?.checked_sub(1)?;
        1_u128.checked_shl(u32::try_from(below).ok()?)
    }

    /// Everything below `end` is used, and none of it is a loss. How many numbers that is more.
    /// `sent` = samples have them.
    fn advance(
        &mut self,
        end: SequenceNumber,
        sent: bool,
        now: Timestamp,
        sequence: &mut Sequence,
    ) -> u64 {
        let next = sequence.next();
        if end <= next {
            return 0;
        }
        let oldest = end.saturating_sub(WINDOW);
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
        self.sighted = self.sighted.checked_shl(bits).unwrap_or(0);
        self.finished = self.finished.checked_shl(bits).unwrap_or(0);
        self.next = end;
        samples
    }

    /// What was counted meanwhile was seen otherwise.
    fn follow(&mut self, next: SequenceNumber, now: Timestamp) {
        if self.next != next {
            self.settle_all();
            self.begin(next, now);
        }
    }

    /// All below `next` was seen, or needs not be.
    const fn begin(&mut self, next: SequenceNumber, now: Timestamp) {
        (self.sighted, self.finished) = (u128::MAX, u128::MAX);
        (self.next, self.settled, self.last_settled) = (next, next, (now, next));
    }

    /// Nothing below `end` is waited for any longer: what was not seen of it is left out.
    fn settle(&mut self, end: SequenceNumber) {
        let known = self.next.saturating_sub(WINDOW).max(self.settled);
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
