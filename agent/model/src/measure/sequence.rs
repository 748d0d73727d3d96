//! Sequence numbers of one writer: which samples arrived, and which never will.
//!
//! A gap does not count as a loss immediately: it stays open for the settle window, so that
//! reordered or retransmitted samples can fill it. Numbers made irrelevant by a GAP, an ACKNACK or
//! the start of observation are never lost. The firstSN of a HEARTBEAT makes no number irrelevant:
//! a missing sample that the writer no longer has is lost (RTPS 2.5, 8.4.10.4,
//! `lost_changes_update`). Memory is two or three bitmaps that grow with the undecided numbers, up
//! to [`MAX_WINDOW`]. The module reads neither payloads nor a clock; callers pass the times in.

mod bitmap;
mod runs;
mod submessages;
mod unconfirmed;

use std::collections::VecDeque;
use std::time::Duration;

use ros2probe_wire::{SequenceNumber, Timestamp};

use crate::facts::bounded::Bounded;
use crate::facts::model_time::ModelTime;
use crate::facts::tables::{Checkpoints, SequenceGaps};
use bitmap::Bitmap;
pub use unconfirmed::{NumberRange, Run};
use unconfirmed::{REQUIRED_CONFIRMATIONS, UnconfirmedRun};

/// Initial size of the window: the undecided and recently decided numbers that are remembered.
const MIN_WINDOW: u64 = 512;
/// Maximum size of the window: 8 KiB of bitmaps (12 KiB with samples of other routes), or about
/// 3000 messages per second over the reliable settle window.
pub const MAX_WINDOW: u64 = 32_768;
/// Maximum jump within an incarnation. A larger one is a restart or a forgery, not a million
/// losses.
const MAX_JUMP: u64 = 1 << 20;
/// Maximum distance by which a HEARTBEAT or GAP may exceed the received numbers, even if two agree.
pub const MAX_ANNOUNCED_JUMP: u64 = 4096;
/// A number further ahead than this is unconfirmed, as is a single HEARTBEAT or GAP that claims it.
pub const MAX_TRUSTED_JUMP: u64 = 64;
/// A gap that fills within this time without a request is attributed to reordering. Retransmissions
/// take longer even if their ACKNACK was not seen: readers wait 5 ms (Fast DDS) to 100 ms (Cyclone
/// DDS) before they answer a HEARTBEAT.
const MAX_REORDERING: Duration = Duration::from_millis(5);
/// A lower number with a source time later by this much begins a new incarnation of the writer.
pub const MIN_INCARNATION_GAP: Duration = Duration::from_millis(100);
/// This many consecutive samples below the window also begin a new incarnation, whatever their
/// source times.
const MAX_STALE: u32 = 1024;
/// Maximum number of samples without a reader that are marked irrelevant. If a run skips more, it
/// restarts the numbers.
pub const MAX_IRRELEVANT_AT_START: u64 = 512;
/// Minimum time between the source times of two samples of one writer.
const MIN_SOURCE_STEP: Duration = Duration::from_micros(1);
/// Number of steps per window in which settling advances.
const SETTLING_STEPS: u32 = 16;

/// State of one writer's sequence numbers.
#[derive(Debug, Default)]
pub struct Sequence {
    /// The first number seen, or 0 before that. Lower numbers do not count.
    first: SequenceNumber,
    /// All numbers below it are decided.
    settled: SequenceNumber,
    /// One more than the highest number known to exist.
    next: SequenceNumber,
    /// The lowest number that the writer still has: the highest firstSN of its HEARTBEATs.
    available: SequenceNumber,
    /// An earlier value of `available`, and its time.
    withdrawn: Option<(ModelTime, SequenceNumber)>,
    /// All readers that send ACKNACKs have every number below it, or will not get it.
    acknowledged: SequenceNumber,
    /// Every number below it has arrived or is not awaited; [`Self::complete`] and [`Self::skip`]
    /// raise it.
    complete: SequenceNumber,
    /// Number of restarts.
    incarnation: u32,
    received: Bitmap,
    irrelevant: Bitmap,
    /// The numbers in `received` that only arrived by another route, if any did.
    elsewhere: Option<Box<Bitmap>>,
    /// Earlier values of `next` with their times, oldest first.
    checkpoints: Bounded<Checkpoints, VecDeque<(ModelTime, SequenceNumber)>>,
    gaps: Bounded<SequenceGaps, VecDeque<Gap>>,
    newest_source: Timestamp,
    /// The number with the newest source time.
    newest: SequenceNumber,
    /// Number of consecutive samples after `newest` with an older source time.
    older: u8,
    stale: u32,
    /// Time of the last increase of `next`.
    last_advance: ModelTime,
    /// Number of samples that continued this incarnation, at most 255.
    followed: u8,
    /// Whether samples became visible after `last_advance`.
    is_reopened: bool,
    unconfirmed: Option<Box<UnconfirmedRun>>,
    /// Number of runs, HEARTBEATs, GAPs and ACKNACKs that were unconfirmed.
    jumps: u64,
}

/// Relation of a sample's number to the writer's live run.
#[derive(Debug)]
pub enum RunMembership {
    /// The number belongs to the live run.
    Live,
    /// The sample counts as a message but affects no other number.
    Unconfirmed {
        /// Whether no part of this sample was seen before.
        new: bool,
    },
    /// The number confirms this run of earlier samples, which is now the live run.
    Confirmed(Run),
}

/// A run of missing numbers, to distinguish reordering from retransmission.
#[derive(Clone, Copy, Debug)]
struct Gap {
    start: SequenceNumber,
    end: SequenceNumber,
    noticed: ModelTime,
    requested: bool,
    /// A time between those of the samples before and after the run; zero if unknown.
    source: Timestamp,
}

/// Relation of a sample's number to earlier ones.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Arrival {
    /// Not seen before.
    New {
        /// Whether it filled a gap by retransmission.
        recovered: bool,
        /// Whether it is the newest so far; otherwise its delay may include a retransmission.
        newest: bool,
    },
    /// Seen before, or too old to decide.
    Duplicate,
}

/// Whether a late sample may be a retransmission.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum RepairMode {
    /// The writer never retransmits.
    BestEffort,
    /// The writer retransmits samples that a reader misses.
    Reliable,
    /// The writer retransmits, but a fragmented sample may be late without a loss.
    ReliableFragments,
}

/// A decision about one or several numbers.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Settled {
    /// The number never arrived.
    Lost(SequenceNumber),
    /// The number is irrelevant.
    Irrelevant(SequenceNumber),
    /// Lost numbers from the first up to, but not including, the second: the window is too small
    /// for them.
    LostRun(SequenceNumber, SequenceNumber),
}

impl Sequence {
    /// Returns whether any sample was seen.
    #[must_use]
    pub const fn started(&self) -> bool {
        self.first.0 != 0
    }

    /// Returns the highest number known to exist, plus one.
    #[must_use]
    pub const fn next(&self) -> SequenceNumber {
        self.next
    }

    /// Returns the newest source time of a sample, or zero.
    #[must_use]
    pub const fn newest_source(&self) -> Timestamp {
        self.newest_source
    }

    /// Returns the time at which the highest number last increased.
    #[must_use]
    pub const fn last_advance(&self) -> ModelTime {
        self.last_advance
    }

    /// Returns whether this sample was received whole before, or is too old to be remembered.
    #[must_use]
    pub fn has(&self, number: SequenceNumber) -> bool {
        self.started() && (number < self.floor() || number < self.next && self.received.get(number))
    }

    /// Processes a whole sample, after [`Self::recognise`].
    pub fn receive(
        &mut self,
        number: SequenceNumber,
        repair_mode: RepairMode,
        now: ModelTime,
        settled: &mut impl FnMut(Settled),
    ) -> Arrival {
        if !number.is_valid() {
            return Arrival::Duplicate;
        }
        if !self.started() {
            self.restart(number);
        }
        if number >= self.next {
            self.stale = 0;
            self.extend(number, number + 1, now, settled);
            self.received.set(number);
            return Arrival::New {
                recovered: false,
                newest: true,
            };
        }
        if number < self.floor() {
            self.stale += 1;
            return Arrival::Duplicate;
        }
        self.stale = 0;
        if self.received.get(number) {
            return Arrival::Duplicate;
        }
        self.received.set(number);
        let recovered = number >= self.first && self.was_retransmitted(number, repair_mode, now);
        Arrival::New {
            recovered,
            newest: false,
        }
    }

    /// Returns the number of runs, HEARTBEATs, GAPs and ACKNACKs that were unconfirmed.
    #[must_use]
    pub const fn jumps(&self) -> u64 {
        self.jumps
    }

    /// Records the source time of a sample.
    pub fn sourced(&mut self, number: SequenceNumber, source: Timestamp) {
        if number <= self.newest {
            return;
        }
        self.older += 1;
        // After many older source times, the newest one was forged or the writer's clock was set
        // back.
        if source >= self.newest_source || self.older >= REQUIRED_CONFIRMATIONS {
            (self.newest_source, self.newest, self.older) = (source, number, 0);
        }
    }

    /// Records that a sample exists, because some of its fragments arrived.
    pub fn exists(
        &mut self,
        number: SequenceNumber,
        now: ModelTime,
        settled: &mut impl FnMut(Settled),
    ) {
        let is_ahead = number >= self.next && number - self.next <= MAX_JUMP;
        if self.started() && is_ahead && number.is_valid() {
            self.extend(number, number + 1, now, settled);
        }
    }

    /// Begins to count at this number. Has no effect once counting has begun.
    pub fn begin(&mut self, number: SequenceNumber) {
        if !self.started() && number > SequenceNumber::ZERO && number < SequenceNumber::MAX {
            self.restart(number);
        }
    }

    /// Returns the number below which everything is decided.
    #[must_use]
    pub const fn settled(&self) -> SequenceNumber {
        self.settled
    }

    /// Returns the number of missing samples that may still arrive.
    #[must_use]
    pub fn undecided(&self) -> u64 {
        let words = self.undecided_in(SequenceNumber::ZERO, self.next);
        words.map(|(_, bits)| u64::from(bits.count_ones())).sum()
    }

    /// Returns a time between those of the samples before and after the lowest number of
    /// `start..end` that may still arrive. Returns `None` without such a number, or if the time is
    /// unknown.
    #[must_use]
    pub fn source_around(&self, start: SequenceNumber, end: SequenceNumber) -> Option<Timestamp> {
        let mut words = self.undecided_in(start, end);
        let (first, bits) = words.find(|(_, bits)| *bits != 0)?;
        let missing = SequenceNumber(first.0 - first.0 % 64 + u64::from(bits.trailing_zeros()));
        let source = self.gap_at(missing)?.source;
        (source.0 > 0).then_some(source)
    }

    /// Returns the time at which this number was detected as missing, if remembered.
    #[must_use]
    pub fn missed_since(&self, number: SequenceNumber) -> Option<ModelTime> {
        self.gap_at(number).map(|gap| gap.noticed)
    }

    /// Records that this number arrived by another route: here it counts neither as lost nor as
    /// received.
    pub fn know(&mut self, number: SequenceNumber) {
        if self.started() && number >= self.floor() && number < self.next && !self.has(number) {
            let len = self.received.len();
            let new = || Box::new(Bitmap::with_len(len));
            self.elsewhere.get_or_insert_with(new).set(number);
            self.received.set(number);
        }
    }

    fn arrived_here(&self, number: SequenceNumber) -> bool {
        let elsewhere = self.elsewhere.as_ref();
        self.received.get(number) && elsewhere.is_none_or(|elsewhere| !elsewhere.get(number))
    }

    /// Returns how many remembered numbers arrived both here and at `other`.
    #[must_use]
    pub fn count_common(&self, other: &Self) -> u64 {
        if !self.started() || !other.started() {
            return 0;
        }
        let first = self.floor().max(other.floor());
        let common = first
            .until(self.next.min(other.next))
            .filter(|number| self.arrived_here(*number) && other.arrived_here(*number));
        common.count() as u64
    }

    /// Merges the numbers of the same writer that `other` received. `self` keeps its first number.
    pub fn absorb(&mut self, other: &Self, now: ModelTime, settled: &mut impl FnMut(Settled)) {
        if !self.started() || !other.started() {
            return;
        }
        if other.next > self.next && other.next - self.next <= MAX_ANNOUNCED_JUMP {
            self.extend(other.next.previous(), other.next, now, settled);
        }
        for number in self
            .floor()
            .max(other.floor())
            .until(self.next.min(other.next))
        {
            if other.received.get(number) {
                self.received.set(number);
            }
            if let Some(elsewhere) = &mut self.elsewhere
                && other.arrived_here(number)
            {
                elsewhere.clear(number, number.next());
            }
        }
    }

    /// Returns the lowest number that counts.
    #[must_use]
    pub const fn first(&self) -> SequenceNumber {
        self.first
    }

    /// Returns the number below which every sample has arrived or is not awaited: the writer
    /// skipped or dropped it, readers acknowledged it, or it is settled.
    pub fn complete(&mut self) -> SequenceNumber {
        let decided = self.settled.max(self.available).max(self.floor());
        self.complete = self.complete.max(decided);
        while self.complete < self.next
            && (self.received.get(self.complete) || self.irrelevant.get(self.complete))
        {
            self.complete += 1;
        }
        self.complete
    }

    /// Stops waiting for numbers below this one.
    pub fn skip(&mut self, number: SequenceNumber) {
        self.complete = self.complete.max(number.min(self.next));
    }

    /// Returns the lowest number that the writer still has; zero before its first HEARTBEAT.
    #[must_use]
    pub const fn available(&self) -> SequenceNumber {
        self.available
    }

    /// Returns the number below which the writer retransmits no sample.
    #[must_use]
    pub fn awaited(&self) -> SequenceNumber {
        self.available.max(self.acknowledged)
    }

    /// Returns the number of restarts.
    #[must_use]
    pub const fn incarnation(&self) -> u32 {
        self.incarnation
    }

    /// Decides numbers that have been open for `window`, and those that the writer withdrew `grace`
    /// ago. The number `hold` and all higher ones stay open.
    pub fn advance(
        &mut self,
        now: ModelTime,
        (window, grace): (Duration, Duration),
        hold: Option<SequenceNumber>,
        settled: &mut impl FnMut(Settled),
    ) {
        if !self.started() {
            return;
        }
        let mut limit = None;
        if let Some((at, available)) = self.withdrawn
            && at + grace <= now
        {
            limit = Some(available);
            let later = self.available > available;
            self.withdrawn = later.then_some((now, self.available));
        }
        while let Some((at, next)) = self.checkpoints.front().copied()
            && at + window <= now
        {
            limit = limit.max(Some(next));
            let later = self.checkpoints.get(1);
            let is_last = later.is_none_or(|(at, _)| *at + window > now);
            if is_last && hold.is_some_and(|hold| hold < next) {
                break;
            }
            self.checkpoints.pop_front();
        }
        if let Some(limit) = limit {
            self.settle(hold.map_or(limit, |hold| hold.min(limit)), settled);
        }
        let due = self
            .checkpoints
            .back()
            .is_none_or(|(at, next)| *next < self.next && *at + window / SETTLING_STEPS <= now);
        if due && self.settled < self.next {
            self.checkpoints.push_back((now, self.next));
        }
    }

    /// Returns the time from which [`Self::advance`] has an effect without an observation;
    /// [`ModelTime::MAX`] if never.
    #[must_use]
    pub fn next_due(&self, (window, grace): (Duration, Duration)) -> ModelTime {
        let withdrawn = self.withdrawn.map(|(at, _)| at + grace);
        let settled = self.checkpoints.front().map(|(at, _)| *at + window);
        let is_open = self.started() && self.settled < self.next;
        let noted = match self.checkpoints.back() {
            Some((_, next)) if *next >= self.next => None,
            Some((at, _)) => Some(*at + window / SETTLING_STEPS),
            None => Some(ModelTime::ZERO),
        };
        let times = [withdrawn, settled, noted.filter(|_| is_open)];
        times.into_iter().flatten().min().unwrap_or(ModelTime::MAX)
    }

    /// Sets whether samples became visible after [`Self::last_advance`]. A run that begins far ahead
    /// then restarts the numbers, because the numbers between may belong to other samples.
    pub const fn reopen(&mut self, is_reopened: bool) {
        self.is_reopened = is_reopened;
    }

    /// Decides all open numbers.
    pub fn settle_all(&mut self, settled: &mut impl FnMut(Settled)) {
        self.settle(self.next, settled);
        self.checkpoints.clear();
    }

    /// Returns the numbers of `start..end` that may still arrive, as bits at `number % 64`. Each
    /// word comes with the lowest number that it covers.
    fn undecided_in(
        &self,
        start: SequenceNumber,
        end: SequenceNumber,
    ) -> impl Iterator<Item = (SequenceNumber, u64)> {
        let mut number = start.max(self.settled).max(self.floor());
        let end = end.min(self.next);
        std::iter::from_fn(move || {
            if number >= end {
                return None;
            }
            let first = number.0 % 64;
            let bits = (end - number).min(64 - first);
            let mask = (u64::MAX >> (64 - bits)) << first;
            let decided = self.received.word(number) | self.irrelevant.word(number);
            let word = (number, !decided & mask);
            number += bits;
            Some(word)
        })
    }

    /// Returns the run of missing numbers that this one was in, if remembered.
    fn gap_at(&self, number: SequenceNumber) -> Option<&Gap> {
        let mut gaps = self.gaps.iter().rev();
        gaps.find(|gap| gap.start <= number && number < gap.end)
    }

    /// Returns the lowest number that is remembered.
    fn floor(&self) -> SequenceNumber {
        self.next.saturating_sub(self.received.len())
    }

    fn restart(&mut self, number: SequenceNumber) {
        *self = Self {
            first: number,
            settled: number,
            next: number,
            newest_source: self.newest_source,
            last_advance: self.last_advance,
            jumps: self.jumps,
            complete: number,
            incarnation: self.incarnation.wrapping_add(1),
            received: Bitmap::with_len(MIN_WINDOW),
            irrelevant: Bitmap::with_len(MIN_WINDOW),
            ..Self::default()
        };
    }

    /// Raises `next` to `end`: `start..end` exists, and the numbers between `next` and `start` are
    /// a gap.
    fn extend(
        &mut self,
        start: SequenceNumber,
        end: SequenceNumber,
        now: ModelTime,
        settled: &mut impl FnMut(Settled),
    ) {
        if start > self.next {
            self.note_gap(self.next, start, now);
        }
        let undecided = end - self.settled;
        if undecided > self.received.len() && self.received.len() < MAX_WINDOW {
            self.widen(undecided);
        }
        let keep = end.saturating_sub(self.received.len());
        if keep > self.settled {
            // The window cannot hold so many open numbers, so the lowest are decided now.
            self.settle(keep.min(self.next), settled);
            if keep > self.settled {
                settled(Settled::LostRun(self.settled, keep));
                self.settled = keep;
            }
        }
        self.received.clear(self.next, end);
        self.irrelevant.clear(self.next, end);
        if let Some(elsewhere) = &mut self.elsewhere {
            elsewhere.clear(self.next, end);
        }
        self.next = end;
        self.last_advance = now;
    }

    /// Enlarges the window to this many numbers, up to [`MAX_WINDOW`].
    fn widen(&mut self, numbers: u64) {
        let len = numbers.min(MAX_WINDOW).next_power_of_two();
        let (floor, next) = (self.floor(), self.next);
        self.received.grow(len, floor, next);
        self.irrelevant.grow(len, floor, next);
        if let Some(elsewhere) = &mut self.elsewhere {
            elsewhere.grow(len, floor, next);
        }
    }

    fn note_gap(&mut self, start: SequenceNumber, end: SequenceNumber, now: ModelTime) {
        // The sample after the run may have revealed it.
        let step = if self.newest >= end {
            MIN_SOURCE_STEP
        } else {
            Duration::ZERO
        };
        self.gaps.push_back(Gap {
            start,
            end,
            noticed: now,
            requested: false,
            source: self.newest_source - step,
        });
    }

    fn was_retransmitted(
        &self,
        number: SequenceNumber,
        repair_mode: RepairMode,
        now: ModelTime,
    ) -> bool {
        let gap = self.gap_at(number);
        let late = |gap: &Gap| gap.requested || now - gap.noticed >= MAX_REORDERING;
        match repair_mode {
            RepairMode::BestEffort => false,
            // A gap that is no longer remembered is an old one.
            RepairMode::Reliable => gap.is_none_or(late),
            RepairMode::ReliableFragments => gap.is_some_and(late),
        }
    }

    fn settle(&mut self, limit: SequenceNumber, settled: &mut impl FnMut(Settled)) {
        for number in self.settled.until(limit.min(self.next)) {
            if !self.received.get(number) {
                let is_irrelevant = self.irrelevant.get(number);
                settled(if is_irrelevant {
                    Settled::Irrelevant(number)
                } else {
                    Settled::Lost(number)
                });
            }
        }
        self.settled = self.settled.max(limit.min(self.next));
    }
}

#[cfg(test)]
mod tests;
