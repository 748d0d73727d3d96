//! Who gets samples one by one, beside the watches: streams of the API and recordings. A
//! subscription opens interest in topics for as long as it lives; dropping it closes the interest.
//!
//! Between the capture thread and each reader lies a queue, bounded in bytes, all of them together
//! as well. A reader that is slow loses the oldest samples of the topics that hold most of its queue
//! and receives their number. A replay waits for it instead; the capture of a live host never does.

mod backlog;
mod channel;
pub mod line;
pub mod line_reader;
mod retained;

use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use arc_swap::{ArcSwap, ArcSwapOption};
use ros2probe_wire::Timestamp;
use tokio_util::sync::CancellationToken;

use crate::agent_facts::SubscriptionFacts;
use crate::config::watch::{MAX_GLOB_BYTES, MAX_GLOBS};
use crate::config::{Watch, check_globs};
use crate::snapshot_cell::SnapshotCell;
use channel::Channel;
use retained::Retained;
use ros2probe_model::dispatch::{Dispatch, Sample, SampleOutcome};
use ros2probe_model::selection::SampleRequest;

pub use ros2probe_model::dispatch::{Missed, MissedReason, Topic};
pub use ros2probe_model::header::begins_with_header;
pub use ros2probe_model::selection::{Choice, ChoiceError, Depth, Selection};

/// Regular expressions of all subscriptions together.
const MAX_REGEXES: usize = 16;

/// How much there may be of it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Caps {
    /// Subscriptions open at once.
    pub subscriptions: usize,
    /// Bytes that wait in all queues.
    pub bytes: usize,
}

/// What becomes of samples for which a queue has no room.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Overflow {
    /// The oldest of the topic that holds most bytes go; the reader receives their number.
    DropOldest,
    /// The source waits for the reader. For replays alone.
    Wait,
}

/// What a subscription asks for.
#[derive(Clone, Debug)]
pub struct Request {
    /// Which topics; also those that appear later.
    pub topics: Selection,
    /// Only of this domain; `None` = every domain.
    pub domain_id: Option<u32>,
    /// Whether the bytes of the messages are wanted.
    pub depth: Depth,
    /// Room in the queue.
    pub queue_bytes: usize,
    /// What happens when that is not enough.
    pub overflow: Overflow,
    /// On whose behalf, for logs.
    pub label: String,
}

/// Why nothing was opened.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Refused {
    /// As many as may are open.
    #[error("{0} subscriptions are open, which is the limit (limits.subscriptions)")]
    TooMany(usize),
    /// Matching its patterns, and those of the open ones, against every topic takes too long.
    #[error(
        "the open subscriptions have too many patterns together: at most {MAX_GLOBS} globs of \
         {MAX_GLOB_BYTES} bytes and {MAX_REGEXES} regular expressions; name topics instead"
    )]
    Patterns,
}

/// What a reader gets.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Item {
    /// A message, once; those of a reliable writer in its order.
    Sample(Arc<Sample>),
    /// Everything up to this time has been given; at least ten times a second.
    Clock(Timestamp),
    /// Messages that will not be given.
    Missed(Missed),
    /// Nothing will follow; why.
    End(&'static str),
}

/// What came within a time.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum NextItem {
    /// Something.
    Item(Item),
    /// Nothing yet.
    Pending,
    /// The agent hung up.
    Closed,
}

/// All subscriptions.
#[derive(Debug)]
pub struct Subscriptions {
    channels: ArcSwap<Vec<Arc<Channel>>>,
    /// Held while `channels` is changed.
    changing: Mutex<Opened>,
    retained: Mutex<Retained>,
    /// For the capture thread: the latest wishes it has not taken yet.
    news: ArcSwapOption<Vec<SampleRequest>>,
    latest: Arc<SnapshotCell>,
    caps: Caps,
    /// Ends waiting for readers when the agent ends.
    stop: CancellationToken,
    /// Bytes that wait in queues, those of a sample once.
    queued: Arc<AtomicUsize>,
    given: AtomicU64,
    missed: [AtomicU64; MissedReason::ALL.len()],
    refused: AtomicU64,
    crowded_out: AtomicU64,
}

#[derive(Debug, Default)]
struct Opened {
    /// So far; the last one's id.
    count: u64,
    /// No more samples will come.
    ended: Option<&'static str>,
}

/// One reader's end.
#[derive(Debug)]
pub struct Subscription {
    channel: Arc<Channel>,
    all: Arc<Subscriptions>,
}

impl Subscriptions {
    /// None yet. What waits for a reader waits no longer than until `stop`.
    #[must_use]
    pub fn new(latest: Arc<SnapshotCell>, caps: Caps, stop: CancellationToken) -> Self {
        Self {
            channels: ArcSwap::default(),
            changing: Mutex::default(),
            retained: Mutex::default(),
            news: ArcSwapOption::default(),
            latest,
            caps,
            stop,
            queued: Arc::default(),
            given: AtomicU64::new(0),
            missed: Default::default(),
            refused: AtomicU64::new(0),
            crowded_out: AtomicU64::new(0),
        }
    }

    /// Gives what `request` asks for from now on; see [`Subscription::in_force`].
    ///
    /// # Errors
    /// There are too many already, or their patterns are.
    pub fn open(self: &Arc<Self>, request: Request) -> Result<Subscription, Refused> {
        let mut opened = self.changing();
        let channels = self.channels.load();
        if channels.len() >= self.caps.subscriptions {
            self.refused.fetch_add(1, Ordering::Relaxed);
            return Err(Refused::TooMany(self.caps.subscriptions));
        }
        let selections = channels.iter().map(|channel| channel.selection());
        let selections = || selections.clone().chain([&request.topics]);
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

    /// What they cost and lose.
    #[must_use]
    pub fn facts(&self) -> SubscriptionFacts {
        let missed = self.missed.each_ref();
        SubscriptionFacts {
            open: self.channels.load().len(),
            refused: self.refused.load(Ordering::Relaxed),
            given: self.given.load(Ordering::Relaxed),
            missed: missed.map(|count| count.load(Ordering::Relaxed)),
            crowded_out: self.crowded_out.load(Ordering::Relaxed),
            queued_bytes: self.queued.load(Ordering::Relaxed),
            retained_bytes: self.retained().bytes(),
        }
    }

    /// Whether anybody is there.
    #[must_use]
    pub fn is_open(&self) -> bool {
        !self.channels.load().is_empty()
    }

    /// For the capture thread: all wishes, when they have changed since the last call.
    #[must_use]
    pub fn take_changed(&self) -> Option<Arc<Vec<SampleRequest>>> {
        self.news.swap(None)
    }

    /// For the capture thread: retains what these watches ask for.
    pub fn retain(&self, watches: &[Arc<Watch>]) {
        let changing = self.changing();
        let mut retained = self.retained();
        let before = retained.sample_requests().count();
        retained.set(watches.iter().map(|watch| &**watch));
        let is_idle = before == 0 && retained.sample_requests().count() == 0;
        drop(retained);
        if !is_idle {
            self.change(self.channels.load().to_vec());
        }
        drop(changing);
    }

    /// For the capture thread: the model and the kernel know these wishes. Readers that are new
    /// among them get first what is retained for them.
    pub fn in_force(&self, sample_requests: &[SampleRequest]) {
        for channel in self.channels.load().iter() {
            let is_new = !channel.is_in_force();
            if !is_new
                || !sample_requests
                    .iter()
                    .any(|request| request.id == channel.id())
            {
                continue;
            }
            if channel.depth() == Depth::Payloads {
                let known = self.latest.state();
                let topics = || known.known().topics.iter();
                let is_there = |writer| {
                    let mut publishers = topics().flat_map(|topic| &topic.publishers);
                    publishers.any(|publisher| publisher.guid == writer)
                };
                let samples = self.retained().for_reader(&channel.request(), is_there);
                for sample in samples {
                    self.given.fetch_add(1, Ordering::Relaxed);
                    channel.sample(&sample, None, &self.stop);
                }
                channel.wake();
            }
            channel.set_in_force();
        }
    }

    /// For the capture thread: puts what the model gives into the queues, and the time up to which
    /// that is all, if it has gone on.
    pub fn deliver(&self, given: Vec<Dispatch>, clock: Option<Timestamp>) {
        let mut retained = self.retained();
        for Dispatch { to, outcome } in &given {
            if let SampleOutcome::Sample(sample) = outcome {
                retained.keep(to, sample);
            }
        }
        drop(retained);
        let channels = self.channels.load();
        if channels.is_empty() {
            return;
        }
        for Dispatch { to, outcome } in given {
            match outcome {
                SampleOutcome::Sample(sample) => self.sample(&channels, &to, &sample),
                SampleOutcome::Missed(missed) => {
                    for channel in addressed(&channels, &to) {
                        self.count_missed(missed.reason, missed.samples);
                        channel.miss(missed.clone(), &self.stop);
                    }
                }
            }
        }
        for channel in channels.iter() {
            if let Some(clock) = clock {
                channel.clock(clock, &self.stop);
            }
            channel.wake();
        }
    }

    /// For the capture thread: nothing will follow, to whomever.
    pub fn end(&self, reason: &'static str) {
        let mut opened = self.changing();
        opened.ended = Some(reason);
        for channel in self.channels.load().iter() {
            channel.end(reason);
        }
    }

    fn sample(&self, channels: &[Arc<Channel>], to: &[u64], sample: &Arc<Sample>) {
        let mut arrival = None;
        let mut charge = None;
        for channel in addressed(channels, to) {
            self.given.fetch_add(1, Ordering::Relaxed);
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

    /// Takes samples from the longest queues until all together keep their cap.
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
        let changing = self.changing();
        let mut channels = self.channels.load().to_vec();
        channels.retain(|channel| channel.id() != id);
        self.change(channels);
        drop(changing);
        self.latest.bell().ring();
    }

    /// Others are open from now on. Called while `changing` is held.
    fn change(&self, channels: Vec<Arc<Channel>>) {
        let sample_requests = channels.iter().map(|channel| channel.request());
        let retained = self.retained();
        let sample_requests = sample_requests
            .chain(retained.sample_requests().cloned())
            .collect();
        drop(retained);
        self.channels.store(Arc::new(channels));
        self.news.store(Some(Arc::new(sample_requests)));
    }

    fn retained(&self) -> std::sync::MutexGuard<'_, Retained> {
        self.retained.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn changing(&self) -> std::sync::MutexGuard<'_, Opened> {
        self.changing.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Subscription {
    /// What comes next; `None` behind [`Item::End`].
    pub async fn next(&mut self) -> Option<Item> {
        self.channel.next().await
    }

    /// What comes next, if it is there already.
    pub fn try_next(&mut self) -> Option<Item> {
        self.channel.take()
    }

    /// What comes next, within `timeout`; `None` also behind [`Item::End`].
    pub fn next_blocking(&mut self, timeout: Duration) -> Option<Item> {
        self.channel.next_blocking(timeout)
    }

    /// Waits until the capture knows what is wanted, but no longer than `timeout`: what is sent
    /// from then on is given.
    pub async fn in_force(&self, timeout: Duration) -> bool {
        let known = self.channel.in_force();
        tokio::time::timeout(timeout, known).await.is_ok()
    }

    /// What is wanted.
    #[must_use]
    pub fn selection(&self) -> &Selection {
        self.channel.selection()
    }
}

impl Drop for Subscription {
    fn drop(&mut self) {
        // First, so that a source that waits for this reader goes on.
        self.channel.close();
        self.all.close(self.channel.id());
    }
}

fn addressed<'a>(
    channels: &'a [Arc<Channel>],
    to: &'a [u64],
) -> impl Iterator<Item = &'a Arc<Channel>> {
    channels.iter().filter(|channel| to.contains(&channel.id()))
}

#[cfg(test)]
mod tests;
