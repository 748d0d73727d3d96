//! Which sequence numbers of one writer came, and which never will.
//!
//! A gap is not a loss yet: it stays open for the settle window, so that reordering and
//! retransmission can fill it. What GAP, an ACKNACK or the moment of first sight excuses is never a
//! loss. HEARTBEAT's firstSN excuses nothing: a sample that never came and that the writer no
//! longer has is lost (RTPS 2.5, 8.4.10.4, `lost_changes_update`). Memory is two bitmaps that grow
//! with the number of undecided sequence numbers, up to [`MAX_WINDOW`]. It knows no payloads and no
//! time but the one it is given.

mod bitmap;
mod runs;
mod submessages;
mod unconfirmed;

use std::collections::VecDeque;

use ros2probe_wire::time::MILLISECOND;
use ros2probe_wire::{SequenceNumber, Timestamp};

use super::size::Size;
use bitmap::Bitmap;
pub use unconfirmed::Run;
use unconfirmed::{CONFIRMATIONS, UnconfirmedRun};

/// Undecided and recently decided sequence numbers remembered at the start.
const MIN_WINDOW: u64 = 512;
/// And at most: 8 KiB of bitmaps; about 3000 messages a second over the reliable settle window.
pub const MAX_WINDOW: u64 = 32_768;
/// A jump beyond this is a new incarnation or a forgery, not a million losses.
const MAX_JUMP: u64 = 1 << 20;
/// HEARTBEAT and GAP may run ahead of the data by at most this, also when two agree.
pub const FAR: u64 = 4096;
/// A number that is further ahead is unconfirmed, and so is what a single HEARTBEAT or GAP says of
/// it.
pub const REACH: u64 = 64;
/// A gap that fills this soon, unasked, was reordering. Retransmissions that no ACKNACK was seen
/// for take longer: readers wait 5 ms (Fast DDS) to 100 ms (Cyclone DDS) before they answer a
/// HEARTBEAT.
const REORDERING: i64 = 5_000_000;
/// Gaps remembered for telling reordering from retransmission.
const GAPS: usize = 32;
/// A lower sequence number with a source time newer by this is a new incarnation of the writer.
const INCARNATION: u64 = 100 * MILLISECOND;
/// So many consecutive samples below the window are one too, whatever their source time says.
const STALE: u32 = 1024;
/// Settling advances in this many steps per window.
const STEPS: u64 = 16;
/// So many checkpoints at most: two windows of different lengths, and one that is held.
const CHECKPOINTS: usize = 3 * STEPS as usize;
/// Words of a bitmap.
const WORDS: usize = MAX_WINDOW as usize / 64;

/// State of one writer's sequence numbers.
#[derive(Debug, Default)]
pub struct Sequence {
    /// The first one seen; what lies before does not count. 0 = none seen yet.
    first: SequenceNumber,
    /// All below are decided.
    settled: SequenceNumber,
    /// All that are known to exist are below this.
    next: SequenceNumber,
    /// The writer has none below this any more: the highest firstSN of its HEARTBEATs.
    available: SequenceNumber,
    /// A value that `available` had, and since when.
    withdrawn: Option<(Timestamp, SequenceNumber)>,
    /// All readers that acknowledge have all below this, or will not get them.
    acknowledged: SequenceNumber,
    /// All below came, or no reader waits for them; as far as was looked.
    complete: SequenceNumber,
    /// How often it began.
    incarnation: u32,
    received: Bitmap,
    excused: Bitmap,
    /// `next` at some moments, oldest first.
    checkpoints: VecDeque<(Timestamp, SequenceNumber)>,
    gaps: VecDeque<Gap>,
    newest_source: Timestamp,
    /// The sample of that time.
    newest: SequenceNumber,
    /// Consecutive samples after it that are older.
    older: u8,
    stale: u32,
    /// When the last one that moved `next` came.
    last_advance: Timestamp,
    /// Samples that continued this incarnation, up to a handful.
    followed: u8,
    unconfirmed: Option<Box<UnconfirmedRun>>,
    /// Runs, HEARTBEATs, GAPs and ACKNACKs that were unconfirmed.
    jumps: u64,
}

/// Whether a sample's number is its writer's.
#[derive(Debug)]
pub enum RunMembership {
    /// It belongs to the live run.
    Live,
    /// It counts as a message and moves no other number.
    Unconfirmed {
        /// Nothing of this sample was seen before.
        new: bool,
    },
    /// It continues a run that is believed from here on, with the samples that came before it.
    Confirmed(Run),
}

/// One run of missing numbers, for telling reordering from retransmission.
#[derive(Clone, Copy, Debug)]
struct Gap {
    start: SequenceNumber,
    end: SequenceNumber,
    noticed: Timestamp,
    requested: bool,
}

/// How a sample's number relates to those before.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Arrival {
    /// Not seen before.
    New {
        /// It filled a gap by retransmission.
        recovered: bool,
        /// It is the newest so far, so its delay is a delivery delay and not a repetition's.
        newest: bool,
    },
    /// Seen before, or too old to tell.
    Duplicate,
}

/// How a sample was delivered, for telling a retransmission.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum RepairMode {
    /// The writer never retransmits.
    BestEffort,
    /// The writer retransmits what a reader misses.
    Reliable,
    /// It does, but the sample came in fragments: that it is late need not mean that it was lost.
    ReliableFragments,
}

/// One or several numbers that were decided.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Settled {
    /// Never came.
    Lost(SequenceNumber),
    /// Excused by the writer.
    Irrelevant(SequenceNumber),
    /// So many in one go, beyond what the window holds.
    LostRun(SequenceNumber, SequenceNumber),
}

impl Sequence {
    /// Entries, or bytes, and cap of every list.
    #[must_use]
    pub fn sizes(&self) -> [Size; 5] {
        // A new list does not compile before it has a place here.
        let Self {
            first: _,
            settled: _,
            next: _,
            available: _,
            withdrawn: _,
            acknowledged: _,
            complete: _,
            incarnation: _,
            received,
            excused,
            checkpoints,
            gaps,
            newest_source: _,
            newest: _,
            older: _,
            stale: _,
            last_advance: _,
            followed: _,
            unconfirmed,
            jumps: _,
        } = self;
        let length = |Bitmap { words }: &Bitmap| words.len();
        let unconfirmed = unconfirmed
            .as_ref()
            .map_or(0, |unconfirmed| unconfirmed.len());
        [
            Size::new("sequence.received", length(received), WORDS),
            Size::new("sequence.excused", length(excused), WORDS),
            Size::new("sequence.checkpoints", checkpoints.len(), CHECKPOINTS),
            Size::new("sequence.gaps", gaps.len(), GAPS),
            Size::new("sequence.unconfirmed", unconfirmed, UnconfirmedRun::CAP),
        ]
    }

    /// Whether any sample was seen.
    #[must_use]
    pub const fn started(&self) -> bool {
        self.first.0 != 0
    }

    /// One past the highest number known to exist.
    #[must_use]
    pub const fn next(&self) -> SequenceNumber {
        self.next
    }

    /// When the highest number last rose.
    #[must_use]
    pub const fn last_advance(&self) -> Timestamp {
        self.last_advance
    }

    /// Whether this sample was received whole before.
    #[must_use]
    pub fn has(&self, number: SequenceNumber) -> bool {
        self.started() && (number < self.floor() || number < self.next && self.received.get(number))
    }

    /// Takes in one whole sample, after [`Self::recognise`].
    pub fn receive(
        &mut self,
        number: SequenceNumber,
        repair_mode: RepairMode,
        now: Timestamp,
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

    /// How often something was unconfirmed.
    #[must_use]
    pub const fn jumps(&self) -> u64 {
        self.jumps
    }

    /// Takes in a sample's source time.
    pub fn sourced(&mut self, number: SequenceNumber, source: Timestamp) {
        if number <= self.newest {
            return;
        }
        self.older += 1;
        // Many that are older: the newest was forged, or the writer's clock was set back.
        if source >= self.newest_source || self.older >= CONFIRMATIONS {
            (self.newest_source, self.newest, self.older) = (source, number, 0);
        }
    }

    /// A sample of this number exists, for some of its fragments came.
    pub fn exists(
        &mut self,
        number: SequenceNumber,
        now: Timestamp,
        settled: &mut impl FnMut(Settled),
    ) {
        let is_ahead = number >= self.next && number - self.next <= MAX_JUMP;
        if self.started() && is_ahead && number.is_valid() {
            self.extend(number, number + 1, now, settled);
        }
    }

    /// Numbers count from here on; does nothing once begun.
    pub fn begin(&mut self, number: SequenceNumber) {
        if !self.started() && number > SequenceNumber::ZERO && number < SequenceNumber::MAX {
            self.restart(number);
        }
    }

    /// All below are decided.
    #[must_use]
    pub const fn settled(&self) -> SequenceNumber {
        self.settled
    }

    /// When it was noticed that this one was missing, as far as that is remembered.
    #[must_use]
    pub fn missed_since(&self, number: SequenceNumber) -> Option<Timestamp> {
        let mut gaps = self.gaps.iter().rev();
        let gap = gaps.find(|gap| gap.start <= number && number < gap.end);
        gap.map(|gap| gap.noticed)
    }

    /// This one came another way: it is no loss here, and no sample either.
    pub fn know(&mut self, number: SequenceNumber) {
        if self.started() && number >= self.floor() && number < self.next {
            self.received.set(number);
        }
    }

    /// Takes over what `other` received of the same writer's numbers; where both go, this one's
    /// beginning counts.
    pub fn absorb(&mut self, other: &Self, now: Timestamp, settled: &mut impl FnMut(Settled)) {
        if !self.started() || !other.started() {
            return;
        }
        if other.next > self.next && other.next - self.next <= FAR {
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
        }
    }

    /// Lowest number that counts.
    #[must_use]
    pub const fn first(&self) -> SequenceNumber {
        self.first
    }

    /// All below came, or no reader waits for them: the writer left them out or has them no longer,
    /// readers acknowledged them, or they are settled.
    pub fn complete(&mut self) -> SequenceNumber {
        let decided = self.settled.max(self.available).max(self.floor());
        self.complete = self.complete.max(decided);
        while self.complete < self.next
            && (self.received.get(self.complete) || self.excused.get(self.complete))
        {
            self.complete += 1;
        }
        self.complete
    }

    /// Nothing below `number` is waited for any more.
    pub fn skip(&mut self, number: SequenceNumber) {
        self.complete = self.complete.max(number.min(self.next));
    }

    /// The writer will send none below this again.
    #[must_use]
    pub fn awaited(&self) -> SequenceNumber {
        self.available.max(self.acknowledged)
    }

    /// How often the numbers began anew.
    #[must_use]
    pub const fn incarnation(&self) -> u32 {
        self.incarnation
    }

    /// Decides what has been open for `window`, and what the writer withdrew `grace` ago, but
    /// nothing from `hold` on.
    pub fn advance(
        &mut self,
        now: Timestamp,
        (window, grace): (u64, u64),
        hold: Option<SequenceNumber>,
        settled: &mut impl FnMut(Settled),
    ) {
        if !self.started() {
            return;
        }
        let mut limit = None;
        if let Some((at, available)) = self.withdrawn
            && at.0.saturating_add(grace) <= now.0
        {
            limit = Some(available);
            let later = self.available > available;
            self.withdrawn = later.then_some((now, self.available));
        }
        while let Some((at, next)) = self.checkpoints.front().copied()
            && at.0.saturating_add(window) <= now.0
        {
            limit = limit.max(Some(next));
            let later = self.checkpoints.get(1);
            let is_last = later.is_none_or(|(at, _)| at.0.saturating_add(window) > now.0);
            if is_last && hold.is_some_and(|hold| hold < next) {
                break;
            }
            self.checkpoints.pop_front();
        }
        if let Some(limit) = limit {
            self.settle(hold.map_or(limit, |hold| hold.min(limit)), settled);
        }
        let due = self.checkpoints.back().is_none_or(|(at, next)| {
            *next < self.next && at.0.saturating_add(window / STEPS) <= now.0
        });
        if due && self.settled < self.next {
            self.checkpoints.push_back((now, self.next));
        }
    }

    /// Decides everything that is open.
    pub fn settle_all(&mut self, settled: &mut impl FnMut(Settled)) {
        self.settle(self.next, settled);
        self.checkpoints.clear();
    }

    /// Numbers below this are not remembered.
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
            excused: Bitmap::with_len(MIN_WINDOW),
            ..Self::default()
        };
    }

    /// Raises `next` to `end`; `start..end` came, what lies before it is a gap.
    fn extend(
        &mut self,
        start: SequenceNumber,
        end: SequenceNumber,
        now: Timestamp,
        settled: &mut impl FnMut(Settled),
    ) {
        if start > self.next {
            self.note_gap(self.next, start, now);
        }
        let undecided = end - self.settled;
        if undecided > self.received.len() && self.received.len() < MAX_WINDOW {
            let len = undecided.next_power_of_two().min(MAX_WINDOW);
            self.received.grow(len, self.floor(), self.next);
            self.excused.grow(len, self.floor(), self.next);
        }
        let keep = end.saturating_sub(self.received.len());
        if keep > self.settled {
            // Too many to keep open: decided now.
            self.settle(keep.min(self.next), settled);
            if keep > self.settled {
                settled(Settled::LostRun(self.settled, keep));
                self.settled = keep;
            }
        }
        self.received.clear(self.next, end);
        self.excused.clear(self.next, end);
        self.next = end;
        self.last_advance = now;
    }

    fn note_gap(&mut self, start: SequenceNumber, end: SequenceNumber, now: Timestamp) {
        if self.gaps.len() >= GAPS {
            self.gaps.pop_front();
        }
        self.gaps.push_back(Gap {
            start,
            end,
            noticed: now,
            requested: false,
        });
    }

    fn was_retransmitted(
        &self,
        number: SequenceNumber,
        repair_mode: RepairMode,
        now: Timestamp,
    ) -> bool {
        let gap = self
            .gaps
            .iter()
            .rev()
            .find(|gap| gap.start <= number && number < gap.end);
        let late = |gap: &Gap| gap.requested || now.nanoseconds_since(gap.noticed) >= REORDERING;
        match repair_mode {
            RepairMode::BestEffort => false,
            // A gap that was forgotten is an old one.
            RepairMode::Reliable => gap.is_none_or(late),
            RepairMode::ReliableFragments => gap.is_some_and(late),
        }
    }

    fn settle(&mut self, limit: SequenceNumber, settled: &mut impl FnMut(Settled)) {
        for number in self.settled.until(limit.min(self.next)) {
            if !self.received.get(number) {
                let excused = self.excused.get(number);
                settled(if excused {
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
