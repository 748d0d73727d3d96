//! Messages that arrived at a process and that its subscription never took: the middleware dropped
//! them from the subscription's queue, because the process takes messages too slowly.
//!
//! Deliveries count the arrivals, and calls count the takes. All subscriptions of a process to the
//! same topic count as one queue, because a delivery belongs to a participant. A message that was
//! not taken may still wait, so a loss needs one of these proofs:
//!
//! - More messages wait than the queues hold, if their depth is announced.
//! - A message that was published later has been taken. Queues keep the order, and the latency of a
//!   take shows when its message was published.
//! - A take followed the last arrival, and neither takes nor arrivals were seen for a while.
//!
//! Arrivals are compared with the takes of the next report, so a message in transit never counts as
//! lost. Messages within the process cannot be compared, and are not evaluated.

use std::collections::VecDeque;
use std::time::Duration;

use ros2probe_wire::Guid;

use super::findings::{Alarm, STARTUP_GRACE, is_many};
use super::tracked::HALF_WINDOW;
use crate::facts::bounded::Bounded;
use crate::facts::model_time::ModelTime;
use crate::facts::tables::QueueTotals;

/// Maximum number of writers of one queue. A queue with more writers is not evaluated.
const MAX_WRITERS: usize = 256;
/// Time without arrivals and takes after which no message waits.
const IDLE_TIMEOUT: Duration = Duration::from_secs(10);
/// Maximum time by which arrivals are counted before the clock reaches their time.
const MAX_AHEAD: Duration = Duration::from_millis(100);

/// Messages that have arrived at the subscriptions of a process.
#[derive(Clone, Debug, Default)]
pub struct Arrivals {
    /// The readers of the topic in that process, sorted.
    pub readers: Vec<Guid>,
    /// The writers that these readers match, sorted.
    pub writers: Vec<ArrivalsOf>,
    /// Number of messages that all readers together keep; `None` if it is not announced or
    /// unbounded.
    pub depth: Option<u64>,
    /// Time of the last arrival, or later.
    pub last: Option<ModelTime>,
    /// Whether timestamps of a writer are ahead of this host's clock.
    pub is_ahead: bool,
}

/// Messages that have arrived from one writer.
#[derive(Clone, Copy, Debug)]
pub struct ArrivalsOf {
    /// The writer.
    pub writer: Guid,
    /// Time when the complete count of arrivals began; `None` if earlier arrivals may be missing.
    pub since: Option<ModelTime>,
    /// Number of messages, each counted once per matched reader.
    pub messages: u64,
}

/// Messages that the subscriptions of a process have taken.
#[derive(Clone, Debug)]
pub(super) struct Takes {
    /// The subscriptions, sorted.
    pub(super) handles: Vec<u64>,
    /// Number of messages that they have taken.
    pub(super) taken: u64,
    /// Time when the complete count of takes began; `None` if earlier takes may be missing.
    pub(super) since: Option<ModelTime>,
    /// Time at or before the publication of the last message that each subscription has taken.
    pub(super) published: Option<ModelTime>,
    /// The earliest of the times at which each subscription last took a message.
    pub(super) last: ModelTime,
}

/// The subscriptions of one process to one topic.
#[derive(Debug)]
pub(super) struct ReaderQueue {
    handles: Vec<u64>,
    readers: Vec<Guid>,
    writers: Vec<ArrivalsOf>,
    depth: Option<u64>,
    /// Number of takes, and of those that do not count, because the arrival of their message is not
    /// counted.
    taken: u64,
    excluded: u64,
    /// Number of messages that have arrived, now and at earlier reports.
    arrived: u64,
    past: Bounded<QueueTotals, VecDeque<(ModelTime, u64)>>,
    lost: u64,
    /// Whether the count of arrivals has begun, which is one report after that of takes.
    has_begun: bool,
    /// Times of the last change and of the last take, and the longest time between takes.
    changed: ModelTime,
    took: ModelTime,
    longest_gap: Duration,
    since: ModelTime,
    /// The earlier and the later start of a window: time, arrivals and losses.
    marks: [(ModelTime, u64, u64); 2],
    pub(super) alarm: Alarm,
}

impl ReaderQueue {
    /// Begins the comparison.
    pub(super) fn new(arrivals: &Arrivals, takes: &Takes, now: ModelTime) -> Self {
        // If the whole life of the queue is known, all takes and all arrivals count.
        let is_whole = takes.since.is_some_and(|observed| {
            let mut begins = arrivals.writers.iter().map(|each| each.since);
            begins.all(|since| since.is_some_and(|since| since >= observed))
        });
        let arrived = match is_whole {
            true => sum(&arrivals.writers),
            false => 0,
        };
        Self {
            handles: takes.handles.clone(),
            readers: arrivals.readers.clone(),
            writers: arrivals.writers.clone(),
            depth: arrivals.depth,
            taken: takes.taken,
            excluded: if is_whole { 0 } else { takes.taken },
            arrived,
            past: [(now + MAX_AHEAD, arrived)].into_iter().collect(),
            lost: 0,
            has_begun: is_whole,
            changed: now,
            took: now,
            longest_gap: Duration::ZERO,
            since: now,
            marks: [(now, arrived, 0); 2],
            alarm: Alarm::default(),
        }
    }

    /// Returns whether the subscriptions are still the same.
    pub(super) fn is_of(&self, arrivals: &Arrivals, takes: &Takes) -> bool {
        self.handles == takes.handles
            && self.readers == arrivals.readers
            && self.taken <= takes.taken
    }

    /// Compares arrivals with takes. Returns the number of messages lost since the last comparison.
    pub(super) fn compare(&mut self, arrivals: &Arrivals, takes: &Takes, now: ModelTime) -> u64 {
        let before = (self.arrived, self.taken);
        self.arrive(arrivals);
        // All these takes are older than the arrivals counted now. Takes in excess of the arrivals
        // are of messages whose arrival is not counted.
        let counted = self.taken.saturating_sub(self.excluded);
        self.excluded += counted.saturating_sub(self.arrived);
        if takes.taken > self.taken {
            self.longest_gap = self.longest_gap.max(now - self.took);
            (self.taken, self.took) = (takes.taken, now);
        }
        if before != (self.arrived, self.taken) {
            self.changed = now;
        }
        let taken = self.taken.saturating_sub(self.excluded);
        let mut gone = match self.depth {
            Some(depth) => before.0.saturating_sub(depth),
            None => 0,
        };
        if let Some(published) = takes.published.filter(|_| !arrivals.is_ahead) {
            let is_before = |(at, _): &&(ModelTime, u64)| *at <= published;
            let known = self.past.iter().rev().find(is_before);
            gone = gone.max(known.map_or(0, |(_, arrived)| *arrived));
        }
        let quiet = IDLE_TIMEOUT.max(self.longest_gap.saturating_mul(3));
        let is_after = arrivals.last.is_some_and(|arrival| takes.last > arrival);
        if is_after && now - self.changed >= quiet {
            gone = self.arrived;
        }
        let lost = gone.saturating_sub(taken).saturating_sub(self.lost);
        self.lost += lost;
        self.past.push_back((now + MAX_AHEAD, self.arrived));
        lost
    }

    /// Evaluates the rule of the finding. Returns whether the finding appeared, ended or changed.
    pub(super) fn judge(&mut self, now: ModelTime) -> bool {
        let [(_, arrived, lost), (middle, ..)] = self.marks;
        let (arrived, lost) = (self.arrived - arrived, self.lost - lost);
        let found = (arrived > 0 && is_many(lost, arrived) && now - self.since >= STARTUP_GRACE)
            .then(|| (lost.saturating_mul(1000) / arrived.max(1), arrived));
        if now - middle >= HALF_WINDOW {
            self.marks = [self.marks[1], (now, self.arrived, self.lost)];
        }
        let found = found.map(|(permille, arrived)| (permille.min(1000), arrived));
        self.alarm.judge(found)
    }

    /// Returns the numbers of messages that arrived, were taken, and were lost.
    pub(super) fn counts(&self) -> (u64, u64, u64) {
        let taken = self.taken.saturating_sub(self.excluded);
        (self.arrived, taken, self.lost)
    }

    /// Returns the number of messages that all subscriptions together keep, if it is announced.
    pub(super) const fn depth(&self) -> Option<u64> {
        self.depth
    }

    /// Returns the subscriptions.
    pub(super) fn handles(&self) -> &[u64] {
        &self.handles
    }

    /// Returns the only writer, or `None` if there are several.
    pub(super) const fn writer(&self) -> Option<Guid> {
        match self.writers.as_slice() {
            [only] => Some(only.writer),
            _ => None,
        }
    }

    /// Adds the new arrivals. Messages of a new writer count only if all of them arrived since the
    /// comparison began.
    fn arrive(&mut self, arrivals: &Arrivals) {
        let has_begun = std::mem::replace(&mut self.has_begun, true);
        for each in &arrivals.writers {
            let known = self
                .writers
                .iter()
                .find(|known| known.writer == each.writer);
            let before = match known {
                Some(known) if has_begun => known.messages,
                None if each.since.is_some_and(|since| since >= self.since) => 0,
                _ => each.messages,
            };
            self.arrived += each.messages.saturating_sub(before);
        }
        self.writers.clone_from(&arrivals.writers);
        self.depth = arrivals.depth;
    }
}

impl Arrivals {
    /// Returns whether the arrivals at this number of subscriptions can be compared.
    pub(super) fn is_comparable(&self, subscriptions: usize) -> bool {
        self.readers.len() == subscriptions && self.writers.len() <= MAX_WRITERS
    }
}

fn sum(writers: &[ArrivalsOf]) -> u64 {
    writers.iter().map(|each| each.messages).sum()
}
