//! Queue between the capture thread and one reader, bounded in bytes.
//!
//! Each end holds the lock only for one push or pop. The queue does not select topics.

use std::collections::BTreeSet;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use ros2probe_wire::{DomainId, Timestamp};
use tokio::sync::Notify;
use tokio_util::sync::CancellationToken;

use super::backlog::Backlog;
use super::{Choice, Depth, Item, Overflow, Request, Selection, TopicKey};
use crate::tables::QueueLosses;
use ros2probe_model::facts::bounded::Bounded;
use ros2probe_model::facts::dispatch::{Missed, MissedReason, Sample};
use ros2probe_model::facts::selection::SampleRequest;

/// Memory of a queued entry besides its payload, in bytes.
const ENTRY_OVERHEAD: usize = 256;
/// Interval at which a source that waits for a reader checks for the end of the agent.
const STOP_CHECK_INTERVAL: Duration = Duration::from_millis(50);

/// One subscription, shared by both ends.
#[derive(Debug)]
pub(super) struct Channel {
    id: u64,
    wanted: Mutex<Wanted>,
    request: ChannelOptions,
    queue: Mutex<Queue>,
    /// Bytes in the queue, readable without the lock.
    bytes: AtomicUsize,
    /// Notification of asynchronous and of blocking readers.
    readable: Notify,
    changed: Condvar,
    is_applied: AtomicBool,
    known: Notify,
    /// Whether the stream continues when a replay that has ended begins again.
    outlives_end: AtomicBool,
}

/// Topics of the reader.
#[derive(Debug)]
struct Wanted {
    selection: Arc<Selection>,
    /// Topics whose retained samples are due once the selection is in force.
    fresh: Option<Arc<Selection>>,
}

#[derive(Debug)]
struct ChannelOptions {
    domain_id: Option<DomainId>,
    depth: Depth,
    queue_bytes: usize,
    overflow: Overflow,
    is_clock_complete: bool,
    label: String,
}

#[derive(Debug, Default)]
struct Queue {
    waiting: Backlog,
    /// Samples dropped since the last report to the reader.
    dropped: Bounded<QueueLosses, Vec<Missed>>,
    /// Number of dropped samples that are not counted yet.
    uncounted: u64,
    end: Option<&'static str>,
    /// Whether the stream was closed by the reader, or after its end.
    closed: bool,
    /// Whether the reader does not know yet that a replay went back.
    begins_again: bool,
}

/// Bytes that count towards the sum of all queues until this value is dropped.
#[derive(Debug)]
pub(super) struct QueuedBytes {
    queued: Arc<AtomicUsize>,
    bytes: usize,
}

impl QueuedBytes {
    /// Counts the bytes of one payload, which may be in several queues.
    pub(super) fn new(queued: &Arc<AtomicUsize>, bytes: usize) -> Arc<Self> {
        queued.fetch_add(bytes, Ordering::Relaxed);
        Arc::new(Self {
            queued: Arc::clone(queued),
            bytes,
        })
    }
}

impl Drop for QueuedBytes {
    fn drop(&mut self) {
        self.queued.fetch_sub(self.bytes, Ordering::Relaxed);
    }
}

impl Channel {
    pub(super) fn new(id: u64, request: Request) -> Self {
        let selection = Arc::new(request.topics);
        Self {
            id,
            wanted: Mutex::new(Wanted {
                fresh: request.latched.then(|| Arc::clone(&selection)),
                selection,
            }),
            request: ChannelOptions {
                domain_id: request.domain_id,
                depth: request.depth,
                queue_bytes: request.queue_bytes,
                overflow: request.overflow,
                is_clock_complete: request.is_clock_complete,
                label: request.label,
            },
            queue: Mutex::default(),
            bytes: AtomicUsize::new(0),
            readable: Notify::new(),
            changed: Condvar::new(),
            is_applied: AtomicBool::new(false),
            known: Notify::new(),
            outlives_end: AtomicBool::new(false),
        }
    }

    pub(super) const fn id(&self) -> u64 {
        self.id
    }

    pub(super) fn label(&self) -> &str {
        &self.request.label
    }

    pub(super) const fn depth(&self) -> Depth {
        self.request.depth
    }

    pub(super) fn selection(&self) -> Arc<Selection> {
        Arc::clone(&self.wanted().selection)
    }

    /// Replaces the selection by `topics`. The retained samples of the topics in `fresh` are due.
    pub(super) fn select(&self, topics: BTreeSet<TopicKey>, mut fresh: BTreeSet<TopicKey>) {
        let mut wanted = self.wanted();
        let due = wanted.fresh.take();
        for choice in due.iter().flat_map(|due| &due.include) {
            if let Choice::Topics(due) = choice {
                fresh.extend(due.intersection(&topics).cloned());
            }
        }
        wanted.fresh = Some(Arc::new(Selection::of_topics(fresh)));
        wanted.selection = Arc::new(Selection::of_topics(topics));
    }

    pub(super) const fn is_clock_complete(&self) -> bool {
        self.request.is_clock_complete
    }

    pub(super) fn request(&self) -> SampleRequest {
        SampleRequest {
            id: self.id,
            selection: self.selection(),
            domain_id: self.request.domain_id,
            depth: self.request.depth,
        }
    }

    /// Removes and returns the topics whose retained samples are due, if `wait_applied` is the
    /// latest selection.
    pub(super) fn take_newly_selected(&self, in_force: &Arc<Selection>) -> Option<Arc<Selection>> {
        let mut wanted = self.wanted();
        let is_latest = Arc::ptr_eq(&wanted.selection, in_force);
        is_latest.then(|| wanted.fresh.take()).flatten()
    }

    pub(super) fn set_in_force(&self) {
        if !self.is_applied.swap(true, Ordering::Release) {
            self.known.notify_one();
        }
    }

    pub(super) async fn wait_applied(&self) {
        if !self.is_applied.load(Ordering::Acquire) {
            self.known.notified().await;
        }
    }

    /// Queues a sample. During a replay, every method that queues an item waits for space until the
    /// reader closes or the agent ends.
    pub(super) fn sample(
        &self,
        sample: &Arc<Sample>,
        charge: Option<&Arc<QueuedBytes>>,
        stop: &CancellationToken,
    ) {
        let bytes = ENTRY_OVERHEAD + sample.payload.as_ref().map_or(0, bytes::Bytes::len);
        let mut queue = self.wait_for_room(bytes, stop);
        let item = Item::Sample(Arc::clone(sample));
        self.push(&mut queue, item, bytes, charge.map(Arc::clone));
    }

    /// Reports samples that will not be delivered.
    pub(super) fn miss(&self, missed: Missed, stop: &CancellationToken) {
        let mut queue = self.wait_for_room(ENTRY_OVERHEAD, stop);
        if let Some(Item::Missed(last)) = queue.waiting.last_mut()
            && follows(last, &missed)
        {
            last.last = missed.last;
            last.samples += missed.samples;
            return;
        }
        self.push(&mut queue, Item::Missed(missed), ENTRY_OVERHEAD, None);
    }

    /// Reports that all items up to `now` are in the queue.
    pub(super) fn clock(&self, now: Timestamp, stop: &CancellationToken) {
        let mut queue = self.wait_for_room(ENTRY_OVERHEAD, stop);
        if let Some(Item::Clock(last)) = queue.waiting.last_mut()
            && self.request.overflow == Overflow::DropOldest
        {
            *last = now.max(*last);
            return;
        }
        self.push(&mut queue, Item::Clock(now), ENTRY_OVERHEAD, None);
    }

    /// Reports the end of the stream.
    pub(super) fn end(&self, reason: &'static str) {
        self.lock().end.get_or_insert(reason);
        self.wake();
    }

    /// Makes the stream continue when a replay that has ended begins again.
    pub(super) fn outlive_end(&self) {
        self.outlives_end.store(true, Ordering::Relaxed);
    }

    /// Continues the stream if it outlives its end. Its reader first gets an end, and none of the
    /// items that wait.
    pub(super) fn begin_again(&self) {
        if self.outlives_end.load(Ordering::Relaxed) {
            let mut queue = self.lock();
            (queue.end, queue.closed) = (None, false);
            queue.waiting = Backlog::default();
            queue.begins_again = true;
            self.bytes.store(0, Ordering::Relaxed);
            drop(queue);
            self.wake();
        }
    }

    /// Closes the stream for its reader.
    pub(super) fn close(&self) {
        let mut queue = self.lock();
        queue.closed = true;
        queue.waiting = Backlog::default();
        // The capture thread may still have this channel in its list of those to evict from.
        self.bytes.store(0, Ordering::Relaxed);
        drop(queue);
        self.changed.notify_all();
    }

    /// Wakes the reader.
    pub(super) fn wake(&self) {
        self.readable.notify_one();
        self.changed.notify_all();
    }

    /// Returns the number of bytes that could be evicted.
    pub(super) fn droppable(&self) -> usize {
        match self.request.overflow {
            Overflow::DropOldest => self.bytes.load(Ordering::Relaxed),
            Overflow::Wait => 0,
        }
    }

    /// Evicts the least important entry.
    pub(super) fn drop_oldest(&self) {
        let mut queue = self.lock();
        self.drop_one(&mut queue);
    }

    /// Returns the number of samples dropped since the last call.
    pub(super) fn take_dropped(&self) -> u64 {
        std::mem::take(&mut self.lock().uncounted)
    }

    /// Removes the next item for the reader; returns `None` if the queue is empty.
    pub(super) fn take(&self) -> Option<Item> {
        let mut queue = self.lock();
        self.pop(&mut queue)
    }

    pub(super) async fn next(&self) -> Option<Item> {
        loop {
            let readable = self.readable.notified();
            {
                let mut queue = self.lock();
                if let Some(item) = self.pop(&mut queue) {
                    return Some(item);
                }
                if queue.closed {
                    return None;
                }
            }
            readable.await;
        }
    }

    pub(super) fn next_blocking(&self, timeout: Duration) -> Option<Item> {
        let end = Instant::now() + timeout;
        let mut queue = self.lock();
        loop {
            if let Some(item) = self.pop(&mut queue) {
                return Some(item);
            }
            let left = end.saturating_duration_since(Instant::now());
            if queue.closed || left.is_zero() {
                return None;
            }
            let waited = self.changed.wait_timeout(queue, left);
            (queue, _) = waited.unwrap_or_else(PoisonError::into_inner);
        }
    }

    fn pop(&self, queue: &mut Queue) -> Option<Item> {
        if std::mem::take(&mut queue.begins_again) {
            return Some(Item::End("the replay goes back"));
        }
        if let Some(missed) = queue.dropped.pop() {
            return Some(Item::Missed(missed));
        }
        if let Some(item) = queue.waiting.pop() {
            self.bytes.store(queue.waiting.bytes(), Ordering::Relaxed);
            if self.request.overflow == Overflow::Wait {
                self.changed.notify_all();
            }
            return Some(item);
        }
        let reason = queue.end.filter(|_| !queue.closed)?;
        queue.closed = true;
        Some(Item::End(reason))
    }

    /// Locks the queue; during a replay, waits before that until `bytes` fit.
    fn wait_for_room(&self, bytes: usize, stop: &CancellationToken) -> MutexGuard<'_, Queue> {
        let mut queue = self.lock();
        while self.request.overflow == Overflow::Wait
            && queue.waiting.bytes() > 0
            && queue.waiting.bytes() + bytes > self.request.queue_bytes
            && !queue.closed
            && !stop.is_cancelled()
        {
            self.wake();
            let waited = self.changed.wait_timeout(queue, STOP_CHECK_INTERVAL);
            (queue, _) = waited.unwrap_or_else(PoisonError::into_inner);
        }
        queue
    }

    fn push(&self, queue: &mut Queue, item: Item, bytes: usize, charge: Option<Arc<QueuedBytes>>) {
        if queue.closed {
            return;
        }
        queue.waiting.push(item, bytes, charge);
        self.bytes.store(queue.waiting.bytes(), Ordering::Relaxed);
        while self.request.overflow == Overflow::DropOldest
            && queue.waiting.bytes() > self.request.queue_bytes
            && self.drop_one(queue)
        {}
    }

    /// Evicts an entry. Returns `false` if the queue is empty.
    fn drop_one(&self, queue: &mut Queue) -> bool {
        let evicted = queue.waiting.evict_least_important();
        // Also without an entry, so that no caller evicts from an empty queue twice.
        self.bytes.store(queue.waiting.bytes(), Ordering::Relaxed);
        let Some(item) = evicted else {
            return false;
        };
        match item {
            Item::Sample(sample) => {
                queue.uncounted += 1;
                queue.note_dropped(Missed {
                    topic: Arc::clone(&sample.topic),
                    writer: sample.writer,
                    first: sample.sequence_number,
                    last: sample.sequence_number,
                    samples: 1,
                    reason: MissedReason::QueueFull,
                });
            }
            Item::Missed(missed) => queue.note_dropped(missed),
            Item::Clock(_) | Item::End(_) => {}
        }
        true
    }

    fn wanted(&self) -> MutexGuard<'_, Wanted> {
        self.wanted.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn lock(&self) -> MutexGuard<'_, Queue> {
        self.queue.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Queue {
    fn note_dropped(&mut self, missed: Missed) {
        let mut known = self.dropped.iter_mut();
        let same = known.find(|known| {
            (known.writer, known.reason) == (missed.writer, missed.reason)
                && known.topic == missed.topic
        });
        if let Some(known) = same {
            known.first = known.first.min(missed.first);
            known.last = known.last.max(missed.last);
            known.samples += missed.samples;
        } else if let Some(missed) = self.dropped.push(missed)
            && let Some(last) = self.dropped.last_mut()
        {
            // For further writers, only the number of losses is reported.
            last.samples += missed.samples;
        }
    }
}

fn follows(last: &Missed, next: &Missed) -> bool {
    (last.writer, last.reason) == (next.writer, next.reason)
        && last.topic == next.topic
        && next.first == last.last + 1
}
