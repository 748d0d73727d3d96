//! Subscriptions to single samples, for streams of the API and recordings. The topics of a
//! subscription are captured until it is dropped.
//!
//! A queue connects the capture thread with each reader; bytes are bounded per queue and in total.
//! A slow reader loses the oldest samples of the topics that hold most of its queue, and receives
//! their number. A replay waits for readers instead; live capture never does.

mod backlog;
mod channel;
pub mod line;
mod retained;

use std::collections::BTreeSet;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use arc_swap::{ArcSwap, ArcSwapOption};
use ros2probe_wire::{DomainId, Timestamp};
use tokio_util::sync::CancellationToken;

use crate::agent_facts::SubscriptionFacts;
use crate::config::watch::{MAX_GLOB_BYTES, MAX_GLOBS};
use crate::config::{Watch, check_globs};
use crate::snapshot_cell::SnapshotCell;
use channel::Channel;
use ros2probe_model::facts::dispatch::{Dispatch, Sample, SampleOutcome};
use ros2probe_model::facts::selection::SampleRequest;

pub use ros2probe_model::facts::dispatch::{Missed, MissedReason, Topic};
pub use ros2probe_model::facts::header::begins_with_header;
pub use ros2probe_model::facts::selection::{
    Candidate, Choice, ChoiceError, Depth, Selection, TopicKey,
};

/// Maximum number of regular expressions in all subscriptions together.
const MAX_REGEXES: usize = 16;

/// Caps on subscriptions.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Caps {
    /// Maximum number of open subscriptions.
    pub subscriptions: usize,
    /// Maximum number of bytes in all queues.
    pub bytes: usize,
}

/// Treatment of samples that do not fit into a queue.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Overflow {
    /// Evict the oldest samples of the topic with most bytes; the reader receives their number.
    DropOldest,
    /// The source waits for the reader. This is only for replays.
    Wait,
}

/// Options of a subscription.
#[derive(Clone, Debug)]
pub struct Request {
    /// Selection of topics, including those that appear later.
    pub topics: Selection,
    /// Domain of the topics; `None` for every domain.
    pub domain_id: Option<DomainId>,
    /// Whether payloads are included.
    pub depth: Depth,
    /// Capacity of the queue in bytes.
    pub queue_bytes: usize,
    /// Treatment of samples that do not fit.
    pub overflow: Overflow,
    /// Whether [`Item::Clock`] comes only after samples that wait for lower numbers: by some seconds
    /// later while a reliable writer repeats a sample. The kept last messages then have the time of
    /// their delivery, so that a recording does not begin before itself.
    pub is_clock_complete: bool,
    /// Whether a reader with payloads first receives the kept last messages of its topics.
    pub latched: bool,
    /// Name of the client, for logs.
    pub label: String,
}

/// Why a subscription was refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Refused {
    /// The number of open subscriptions is at its limit.
    #[error("{0} subscriptions are open, which is the limit (limits.subscriptions)")]
    TooMany(usize),
    /// Matching its patterns, and those of the open subscriptions, against every topic would take
    /// too long.
    #[error(
        "the open subscriptions have too many patterns together: at most {MAX_GLOBS} globs of \
         {MAX_GLOB_BYTES} bytes and {MAX_REGEXES} regular expressions; name topics instead"
    )]
    Patterns,
}

/// Item for a reader.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Item {
    /// A message. Each message arrives once, and messages of a reliable writer arrive in order.
    Sample(Arc<Sample>),
    /// All items up to this time have been delivered. This item is sent at least ten times a
    /// second.
    Clock(Timestamp),
    /// Messages that will not be delivered.
    Missed(Missed),
    /// The end of the stream, with its reason.
    End(&'static str),
}

/// Result of a wait with a timeout.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum NextItem {
    /// An item.
    Item(Item),
    /// No item within the timeout.
    Pending,
    /// The agent closed the stream.
    Closed,
}

/// All subscriptions.
#[derive(Debug)]
pub struct Subscriptions {
    channels: ArcSwap<Vec<Arc<Channel>>>,
    /// Locked while `channels` changes.
    channels_lock: Mutex<Opened>,
    /// Requests of watches for the last messages of their topics.
    retained: ArcSwap<Vec<SampleRequest>>,
    /// Latest requests that the capture thread has not read yet.
    unread: ArcSwapOption<Vec<SampleRequest>>,
    latest: Arc<SnapshotCell>,
    caps: Caps,
    /// Ends waits for readers when the agent ends.
    stop: CancellationToken,
    /// Bytes in all queues; each sample counts once.
    queued: Arc<AtomicUsize>,
    enqueued: AtomicU64,
    missed: [AtomicU64; MissedReason::ALL.len()],
    refused: AtomicU64,
    crowded_out: AtomicU64,
}

#[derive(Debug, Default)]
struct Opened {
    /// Number of subscriptions so far, which is the last id.
    count: u64,
    /// Reason of the end, after which no samples follow.
    ended: Option<&'static str>,
}

/// Reader's end of a subscription.
#[derive(Debug)]
pub struct Subscription {
    channel: Arc<Channel>,
    all: Arc<Subscriptions>,
}

impl Subscriptions {
    /// Creates the registry. Waits for readers end at `stop`.
    #[must_use]
    pub fn new(latest: Arc<SnapshotCell>, caps: Caps, stop: CancellationToken) -> Self {
        Self {
            channels: ArcSwap::default(),
            channels_lock: Mutex::default(),
            retained: ArcSwap::default(),
            unread: ArcSwapOption::default(),
            latest,
            caps,
            stop,
            queued: Arc::default(),
            enqueued: AtomicU64::new(0),
            missed: Default::default(),
            refused: AtomicU64::new(0),
            crowded_out: AtomicU64::new(0),
        }
    }

    /// Opens a subscription; see [`Subscription::wait_applied`].
    ///
    /// # Errors
    ///
    /// Fails if there are too many subscriptions or too many patterns.
    pub fn open(self: &Arc<Self>, request: Request) -> Result<Subscription, Refused> {
        let mut opened = self.lock_channels();
        let channels = self.channels.load();
        if channels.len() >= self.caps.subscriptions {
            self.refused.fetch_add(1, Ordering::Relaxed);
            return Err(Refused::TooMany(self.caps.subscriptions));
        }
        let selections: Vec<_> = channels.iter().map(|channel| channel.selection()).collect();
        let selections = || {
            selections
                .iter()
                .map(AsRef::as_ref)
                .chain([&request.topics])
        };
        let regexes: usize = selections().map(Selection::regexes).sum();
        if regexes > MAX_REGEXES || check_globs(selections().flat_map(Selection::globs)).is_err() {
            self.refused.fetch_add(1, Ordering::Relaxed);
            return Err(Refused::Patterns);
        }
        opened.count += 1;
        let channel = Arc::new(Channel::new(opened.count, request));
        tracing::debug!(id = channel.id(), label = channel.label(), "subscribed");
        if let Some(reason) = opened.ended {
            channel.end(reason);
        }
        let mut channels = channels.to_vec();
        channels.push(Arc::clone(&channel));
        self.change(channels);
        drop(opened);
        self.latest.bell().ring();
        Ok(Subscription {
            channel,
            all: Arc::clone(self),
        })
    }

    /// Returns the figures of all subscriptions.
    #[must_use]
    pub fn facts(&self) -> SubscriptionFacts {
        let missed = self.missed.each_ref();
        SubscriptionFacts {
            open: self.channels.load().len(),
            refused: self.refused.load(Ordering::Relaxed),
            enqueued: self.enqueued.load(Ordering::Relaxed),
            missed: missed.map(|count| count.load(Ordering::Relaxed)),
            crowded_out: self.crowded_out.load(Ordering::Relaxed),
            queued_bytes: self.queued.load(Ordering::Relaxed),
            retained_bytes: 0,
        }
    }

    /// Returns whether any subscription is open.
    #[must_use]
    pub fn is_open(&self) -> bool {
        !self.channels.load().is_empty()
    }

    /// For the capture thread: returns all requests, if they changed since the last call.
    #[must_use]
    pub fn take_changed(&self) -> Option<Arc<Vec<SampleRequest>>> {
        self.unread.swap(None)
    }

    /// For the capture thread: requests the messages that watches with `retain: last` need.
    pub fn retain(&self, watches: &[Arc<Watch>]) {
        let changing = self.lock_channels();
        let retained = Arc::new(retained::sample_requests(watches));
        let is_idle = retained.is_empty();
        let before = self.retained.swap(retained);
        if !is_idle || !before.is_empty() {
            self.change(self.channels.load().to_vec());
        }
        drop(changing);
    }

    /// For the capture thread: handles requests that are now in force in the model and the kernel.
    /// Readers first receive the last messages of topics that are new to them, which `latched`
    /// returns. `now` is the clock of the source.
    pub fn confirm_applied(
        &self,
        sample_requests: &[SampleRequest],
        now: Timestamp,
        mut latched: impl FnMut(&SampleRequest) -> Vec<Arc<Sample>>,
    ) {
        for channel in self.channels.load().iter() {
            let mut requests = sample_requests.iter();
            let Some(request) = requests.find(|request| request.id == channel.id()) else {
                continue;
            };
            let Some(fresh) = channel.take_newly_selected(&request.selection) else {
                continue;
            };
            if channel.depth() == Depth::Payloads {
                let fresh = SampleRequest {
                    selection: fresh,
                    ..request.clone()
                };
                for mut sample in latched(&fresh) {
                    if channel.is_clock_complete() && sample.time < now {
                        Arc::make_mut(&mut sample).time = now;
                    }
                    self.enqueued.fetch_add(1, Ordering::Relaxed);
                    channel.sample(&sample, None, &self.stop);
                }
                channel.wake();
            }
        }
    }

    /// Marks these requests as in force. The capture thread calls this once it captures every
    /// message for them.
    pub fn confirm(&self, sample_requests: &[SampleRequest]) {
        for channel in self.channels.load().iter() {
            if sample_requests
                .iter()
                .any(|request| request.id == channel.id())
            {
                channel.set_in_force();
            }
        }
    }

    /// For the capture thread: queues samples from the model, then the clock if it has advanced.
    pub fn deliver(&self, dispatches: Vec<Dispatch>, clock: Option<Timestamp>) {
        let channels = self.channels.load();
        if channels.is_empty() {
            return;
        }
        for Dispatch { to, outcome } in dispatches {
            match outcome {
                SampleOutcome::Sample(sample) => self.sample(&channels, &to, &sample),
                SampleOutcome::Missed(missed) => {
                    for channel in recipients(&channels, &to) {
                        self.count_missed(missed.reason, missed.samples);
                        channel.miss(missed.clone(), &self.stop);
                    }
                }
            }
        }
        for channel in channels.iter() {
            if let Some(clock) = clock.filter(|_| !channel.is_clock_complete()) {
                channel.clock(clock, &self.stop);
            }
            channel.wake();
        }
    }

    /// For the capture thread: returns whether [`Self::complete`] has an effect.
    #[must_use]
    pub fn need_complete_clock(&self) -> bool {
        let channels = self.channels.load();
        channels.iter().any(|channel| channel.is_clock_complete())
    }

    /// For the capture thread: queues the clock for subscriptions that need a complete one.
    pub fn complete(&self, clock: Timestamp) {
        for channel in self.channels.load().iter() {
            if channel.is_clock_complete() {
                channel.clock(clock, &self.stop);
                channel.wake();
            }
        }
    }

    /// For the capture thread: ends all subscriptions.
    pub fn end(&self, reason: &'static str) {
        let mut opened = self.lock_channels();
        opened.ended = Some(reason);
        for channel in self.channels.load().iter() {
            channel.end(reason);
        }
    }

    /// For the capture thread: a replay begins again. All requests count as changed. New
    /// subscriptions, and those that outlive their end, receive samples again.
    pub fn begin_again(&self) {
        let mut opened = self.lock_channels();
        opened.ended = None;
        let channels = self.channels.load().to_vec();
        channels.iter().for_each(|channel| channel.begin_again());
        self.change(channels);
    }

    fn sample(&self, channels: &[Arc<Channel>], to: &[u64], sample: &Arc<Sample>) {
        let mut arrival = None;
        let mut charge = None;
        for channel in recipients(channels, to) {
            self.enqueued.fetch_add(1, Ordering::Relaxed);
            let wants_payload = channel.depth() == Depth::Payloads;
            let sample = match &sample.payload {
                Some(_) if !wants_payload => arrival.get_or_insert_with(|| {
                    Arc::new(Sample {
                        payload: None,
                        ..Sample::clone(sample)
                    })
                }),
                _ => sample,
            };
            if let Some(payload) = &sample.payload {
                let charge = charge
                    .get_or_insert_with(|| channel::QueuedBytes::new(&self.queued, payload.len()));
                channel.sample(sample, Some(charge), &self.stop);
            } else {
                channel.sample(sample, None, &self.stop);
            }
            self.count_missed(MissedReason::QueueFull, channel.take_dropped());
        }
        drop(charge);
        self.make_room(channels);
    }

    /// Evicts samples from the longest queues until the total is within its cap.
    fn make_room(&self, channels: &[Arc<Channel>]) {
        while self.queued.load(Ordering::Relaxed) > self.caps.bytes {
            let longest = channels.iter().max_by_key(|channel| channel.droppable());
            let Some(longest) = longest.filter(|channel| channel.droppable() > 0) else {
                return;
            };
            longest.drop_oldest();
            let dropped = longest.take_dropped();
            self.crowded_out.fetch_add(dropped, Ordering::Relaxed);
            self.count_missed(MissedReason::QueueFull, dropped);
        }
    }

    fn count_missed(&self, reason: MissedReason, samples: u64) {
        if let Some(count) = self.missed.get(reason as usize) {
            count.fetch_add(samples, Ordering::Relaxed);
        }
    }

    fn close(&self, id: u64) {
        let changing = self.lock_channels();
        let mut channels = self.channels.load().to_vec();
        channels.retain(|channel| channel.id() != id);
        self.change(channels);
        drop(changing);
        self.latest.bell().ring();
    }

    /// Replaces the open channels. The caller holds `lock_channels`.
    fn change(&self, channels: Vec<Arc<Channel>>) {
        let sample_requests = channels.iter().map(|channel| channel.request());
        let retained = self.retained.load();
        let sample_requests = sample_requests.chain(retained.iter().cloned()).collect();
        self.channels.store(Arc::new(channels));
        self.unread.store(Some(Arc::new(sample_requests)));
    }

    fn lock_channels(&self) -> std::sync::MutexGuard<'_, Opened> {
        self.channels_lock
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
    }
}

/// Handle to wait until a subscription is in force.
#[derive(Clone, Debug)]
pub struct Begin(Arc<Channel>);

impl Begin {
    /// Waits like [`Subscription::wait_applied`]. Only one task may wait at a time.
    pub async fn in_force(&self, timeout: Duration) -> bool {
        let known = self.0.wait_applied();
        tokio::time::timeout(timeout, known).await.is_ok()
    }
}

impl Subscription {
    /// Waits for the next item; returns `None` after [`Item::End`].
    pub async fn next(&mut self) -> Option<Item> {
        self.channel.next().await
    }

    /// Returns the next item, if one is queued.
    pub fn try_next(&mut self) -> Option<Item> {
        self.channel.take()
    }

    /// Waits for the next item for at most `timeout`; also returns `None` after [`Item::End`].
    pub fn next_blocking(&mut self, timeout: Duration) -> Option<Item> {
        self.channel.next_blocking(timeout)
    }

    /// Waits for at most `timeout` until the request is in force, and returns whether it is. All
    /// messages sent after that are delivered.
    pub async fn in_force(&self, timeout: Duration) -> bool {
        self.begin().in_force(timeout).await
    }

    /// Returns a handle that waits for the request to be in force.
    #[must_use]
    pub fn begin(&self) -> Begin {
        Begin(Arc::clone(&self.channel))
    }

    /// Makes the subscription continue when a replay that has ended begins again, even after
    /// [`Item::End`]. Use it only with [`Overflow::DropOldest`].
    pub fn outlive_end(&self) {
        self.channel.outlive_end();
    }

    /// Returns the selection of topics.
    #[must_use]
    pub fn selection(&self) -> Arc<Selection> {
        self.channel.selection()
    }

    /// Replaces the selection by `topics`. The retained samples of the topics in `fresh` follow.
    pub fn select(&self, topics: BTreeSet<TopicKey>, fresh: BTreeSet<TopicKey>) {
        let changing = self.all.lock_channels();
        self.channel.select(topics, fresh);
        self.all.change(self.all.channels.load().to_vec());
        drop(changing);
        self.all.latest.bell().ring();
    }
}

impl Drop for Subscription {
    fn drop(&mut self) {
        // The channel is closed first, so that a source that waits for this reader continues.
        self.channel.close();
        self.all.close(self.channel.id());
    }
}

fn recipients<'a>(
    channels: &'a [Arc<Channel>],
    to: &'a [u64],
) -> impl Iterator<Item = &'a Arc<Channel>> {
    channels.iter().filter(|channel| to.contains(&channel.id()))
}

#[cfg(test)]
mod tests;
