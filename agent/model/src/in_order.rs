//! One writer's samples in the order in which a reliable subscriber gets them.
//!
//! A reader delivers a sample once all lower ones have come, or will not come (RTPS 2.5, 8.4.12).
//! So a sample that was counted waits here behind a hole until its repair comes, the writer leaves
//! it out or withdraws it, the readers acknowledge it, or it counts as lost; its time is then the
//! time of that moment. What waits is bounded in number, bytes and time: beyond, order is given up
//! and a late repair is given late. A stream without holes never waits, nor does one without a
//! reliable reader, or whose readers are elsewhere: no ACKNACK is seen while a hole is waited for.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use ros2probe_wire::time::SECOND;
use ros2probe_wire::{SequenceNumber, Timestamp};

use super::dispatch::{Dispatch, Sample};
use super::size::Size;

/// How long one hole is waited for: Fast DDS asks for repairs after a HEARTBEAT, every three
/// seconds at the latest.
const PATIENCE: u64 = 4 * SECOND;
/// Samples that wait at once.
const WAITING: usize = 4096;
/// Numbers of one unannounced writer that are remembered.
pub(super) const MAX_UNANNOUNCED: usize = 1024;
/// Samples from before the announcement come again within this time, or not at all.
const AGAIN: u64 = 10 * SECOND;
/// What keeping a sample costs besides its payload.
const OVERHEAD: usize = size_of::<Due>() + 64;
/// How long the first ACKNACK may take after the announcement.
const MATCHING: u64 = SECOND;

/// How far a writer's samples are decided.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub struct Progress {
    /// Rises when the writer begins anew under its GUID, and its numbers with it.
    pub incarnation: u32,
    /// All below came, or no reader waits for them.
    pub complete: SequenceNumber,
    /// No reader waits for any below this.
    pub awaited: SequenceNumber,
    /// The writer retransmits.
    pub reliable: bool,
    /// And has readers that acknowledge, or may begin to.
    pub acknowledged: bool,
}

/// A sample and those who get it.
#[derive(Debug)]
pub struct Due {
    /// Ids of the requests.
    pub to: Arc<[u64]>,
    /// The sample.
    pub sample: Sample,
    /// What those are given who miss its bytes.
    pub missed: Option<Dispatch>,
}

/// The samples that wait for lower numbers.
#[derive(Debug, Default)]
pub struct InOrder {
    waiting: BTreeMap<SequenceNumber, Due>,
    bytes: usize,
    incarnation: Option<u32>,
    /// The number that is waited for, and since when.
    hole: (SequenceNumber, Timestamp),
    /// Of the latest sample that was given.
    last: Timestamp,
    /// Numbers that were counted before the writer was announced, and were not given.
    earlier: BTreeSet<SequenceNumber>,
    announced: Timestamp,
}

impl Due {
    /// Bytes of its payload.
    pub fn bytes(&self) -> usize {
        self.sample.payload.as_ref().map_or(0, bytes::Bytes::len)
    }

    /// Bytes that it takes while it waits.
    pub fn cost(&self) -> usize {
        OVERHEAD + self.bytes()
    }
}

impl InOrder {
    /// Entries and cap of every table.
    #[must_use]
    pub fn sizes(&self) -> [Size; 2] {
        // A new table does not compile before it has a place here.
        let Self {
            waiting,
            bytes: _,
            incarnation: _,
            hole: _,
            last: _,
            earlier,
            announced: _,
        } = self;
        [
            Size::new("in_order.waiting", waiting.len(), WAITING),
            Size::new("in_order.earlier", earlier.len(), MAX_UNANNOUNCED),
        ]
    }

    /// Whether anything waits, or may come again.
    #[must_use]
    pub fn is_idle(&self) -> bool {
        self.waiting.is_empty() && self.earlier.is_empty()
    }

    /// Bytes that wait.
    #[must_use]
    pub const fn bytes(&self) -> usize {
        self.bytes
    }

    /// These were counted before the writer was announced, which it was at `now`.
    pub fn announced(&mut self, earlier: BTreeSet<SequenceNumber>, now: Timestamp) {
        (self.earlier, self.announced) = (earlier, now);
    }

    /// Whether this sample was counted before the announcement and has not been given.
    #[must_use]
    pub fn lacks(&self, number: SequenceNumber) -> bool {
        self.earlier.contains(&number)
    }

    /// The numbers that follow are of this incarnation: those of the one before were first.
    pub fn begin(&mut self, incarnation: u32, now: Timestamp, give: &mut impl FnMut(Due)) {
        if self.incarnation.replace(incarnation) != Some(incarnation) {
            self.give_all(now, give);
        }
    }

    /// A sample that is to be given now: no other waits.
    pub fn pass(&mut self, mut due: Due, now: Timestamp) -> Due {
        due.sample.time = now.max(self.last);
        self.last = due.sample.time;
        due
    }

    /// A sample is to be given, when it is its turn.
    pub fn put(&mut self, due: Due) {
        let number = due.sample.sequence_number;
        self.earlier.remove(&number);
        self.bytes += due.cost();
        if let Some(before) = self.waiting.insert(number, due) {
            self.bytes -= before.cost();
        }
    }

    /// Samples from before the announcement that will not come again.
    pub fn forgone(&mut self, progress: &Progress, now: Timestamp) -> Vec<SequenceNumber> {
        if self.earlier.is_empty() {
            return Vec::new();
        }
        let is_late = self.announced.0.saturating_add(AGAIN) <= now.0;
        if is_late || !progress.reliable {
            return std::mem::take(&mut self.earlier).into_iter().collect();
        }
        let kept = self.earlier.split_off(&progress.awaited);
        let gone = std::mem::replace(&mut self.earlier, kept);
        gone.into_iter().collect()
    }

    /// Gives those whose turn it is at `now`; at most `room` bytes may go on waiting. Returns the
    /// number below which nothing is waited for any more, if the order was given up.
    pub fn turn(
        &mut self,
        progress: &Progress,
        now: Timestamp,
        room: usize,
        give: &mut impl FnMut(Due),
    ) -> Option<SequenceNumber> {
        self.begin(progress.incarnation, now, give);
        let first = self
            .earlier
            .first()
            .filter(|_| progress.acknowledged || self.announced.0.saturating_add(MATCHING) > now.0);
        let complete = first.map_or(progress.complete, |first| progress.complete.min(*first));
        while let Some(entry) = self.waiting.first_entry()
            && *entry.key() < complete
        {
            let due = entry.remove();
            self.give(due, now, give);
        }
        if self.waiting.is_empty() {
            return None;
        }
        if self.hole.0 != complete {
            self.hole = (complete, now);
        }
        let is_late = self.hole.1.0.saturating_add(PATIENCE) <= now.0;
        if is_late || self.waiting.len() > WAITING || self.bytes > room {
            let last = self.waiting.last_key_value().map(|(number, _)| *number);
            self.give_all(now, give);
            return last.map(|last| last.next());
        }
        None
    }

    /// Gives all that wait: nothing more will come.
    pub fn give_all(&mut self, now: Timestamp, give: &mut impl FnMut(Due)) {
        while let Some((_, due)) = self.waiting.pop_first() {
            self.give(due, now, give);
        }
    }

    fn give(&mut self, due: Due, now: Timestamp, give: &mut impl FnMut(Due)) {
        self.bytes -= due.cost();
        let came = due.sample.time;
        // Its reader may have the lower one that was not seen in shared memory: then it did not
        // wait.
        let now = if due.sample.sampled { came } else { now };
        // Players order by time: those that waited for the same repair are a nanosecond apart.
        let after = match came < now.max(self.last) {
            true => Timestamp(self.last.0.saturating_add(1)),
            false => came,
        };
        give(self.pass(due, now.max(after)));
    }
}
