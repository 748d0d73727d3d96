//! Thread of one snapshot: keeps the last samples, and begins and completes its bags.

use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::Receiver;
use std::time::{Duration, Instant};

use ros2probe_bag::Error;
use ros2probe_wire::Timestamp;

use super::bag::{Cause, Failed, SnapshotBag};
use super::{Answer, Unwritten, WrittenBag};
use crate::config::SnapshotSettings;
use crate::events::{AgentEvent, Record};
use crate::recording::SnapshotFigures;
use crate::recording::sample_ring::SampleRing;
use crate::recording::service::{Recordings, causes};
use crate::subscriptions::{Item, Missed, Subscription};

/// Maximum delay of commands and events.
const POLL_INTERVAL: Duration = Duration::from_millis(100);
/// Maximum time between an incident and its event. The memory reaches further back by this time.
const EVENT_DELAY: Duration = Duration::from_secs(2);
/// Maximum time to wait for messages after an event, beyond the configured time, if the source
/// stops.
const SOURCE_DELAY: Duration = Duration::from_secs(5);

/// Minimum step back of the source's clock which means that it was set. Items up to the time of the
/// clock may follow it by some seconds.
const SET_BACK: Duration = Duration::from_secs(10);
/// Maximum number of reports of missing messages before an incident.
const MAX_MISSED_BEFORE: usize = 1024;

/// State of a snapshot's thread.
pub(super) struct SnapshotTask {
    settings: SnapshotSettings,
    recordings: Arc<Recordings>,
    ring: SampleRing,
    /// Reports of missing messages in the time of the ring, with the clock of each.
    missed: VecDeque<(Timestamp, Missed)>,
    /// Missing messages whose report was evicted for lack of a place.
    unnamed: u64,
    figures: SnapshotFigures,
    /// Time of the source.
    clock: Timestamp,
    /// Number of the last examined event.
    event: u64,
    /// Time of the last trigger that began a bag.
    triggered: Option<Timestamp>,
    /// The bag that receives the messages after its trigger.
    open: Option<OpenBag>,
    /// Whether a replay has ended. It may go back.
    has_ended: bool,
}

struct OpenBag {
    bag: SnapshotBag,
    /// First and last time of its messages. In a replay, both times may be later than the current
    /// message.
    since: Timestamp,
    end: Timestamp,
    deadline: Instant,
}

impl SnapshotTask {
    pub(super) fn new(settings: SnapshotSettings, recordings: Arc<Recordings>) -> Self {
        let span = settings.before + EVENT_DELAY;
        Self {
            ring: SampleRing::new(settings.max_bytes, Some(span)),
            missed: VecDeque::new(),
            unnamed: 0,
            figures: SnapshotFigures::default(),
            clock: Timestamp(0),
            event: recordings.events.last(),
            triggered: None,
            open: None,
            has_ended: false,
            settings,
            recordings,
        }
    }

    /// Runs until `stop`, then completes the open bag. A replay that goes back from its end is
    /// followed again.
    pub(super) fn run(
        mut self,
        mut subscription: Subscription,
        clients: &Receiver<Answer>,
        signalled: &AtomicBool,
        stop: &AtomicBool,
    ) {
        subscription.outlive_end();
        let mut looked = Instant::now();
        while !stop.load(Ordering::Relaxed) {
            let asked = Instant::now();
            let item = subscription.next_blocking(POLL_INTERVAL);
            let is_clock = matches!(item, Some(Item::Clock(_)));
            match item {
                Some(item) => self.take(item),
                // After the end of the source, the call returns at once.
                None => std::thread::sleep(POLL_INTERVAL.saturating_sub(asked.elapsed())),
            }
            if is_clock {
                // A replay may skip many seconds between two polls.
                self.read_events();
            }
            if looked.elapsed() < POLL_INTERVAL {
                continue;
            }
            looked = Instant::now();
            self.read_events();
            self.publish_figures();
            if let Ok(client) = clients.try_recv() {
                // If the client no longer waits, the bag exists nevertheless.
                let _ = client.send(self.write_memory(Cause::Request));
            }
            if signalled.swap(false, Ordering::Relaxed) {
                // The event log records the result.
                let _ = self.write_memory(Cause::Signal);
            }
        }
        self.complete(None);
    }

    pub(super) fn take(&mut self, item: Item) {
        let is_end = matches!(item, Item::End(_));
        if std::mem::replace(&mut self.has_ended, is_end) && !is_end {
            self.forget();
        }
        let now = match &item {
            Item::Sample(sample) => Some(sample.time),
            Item::Clock(now) => Some(*now),
            Item::Missed(_) | Item::End(_) => None,
        };
        self.clock = match item {
            Item::Clock(now) if now + SET_BACK < self.clock => now,
            _ => self.clock.max(now.unwrap_or_default()),
        };
        if let Some(open) = &mut self.open {
            let is_late = now.is_some_and(|now| now > open.end);
            let is_early = now.is_some_and(|now| now < open.since);
            let taken = if is_early || is_late {
                Ok(())
            } else {
                open.bag.take(&item, &self.recordings)
            };
            if is_late || is_end || taken.is_err() || Instant::now() > open.deadline {
                self.complete(taken.err());
            }
        }
        match item {
            Item::Sample(sample) => self.ring.push(sample),
            Item::Clock(now) => {
                self.ring.advance(now);
                let span = self.settings.before + EVENT_DELAY;
                self.missed.retain(|(at, _)| now.distance(*at) <= span);
            }
            Item::Missed(missed) => self.note_missed(missed),
            Item::End(_) => {}
        }
    }

    /// Forgets what was read before a replay that has ended began again.
    fn forget(&mut self) {
        self.ring.clear();
        self.missed.clear();
        self.unnamed = 0;
        self.clock = Timestamp(0);
        self.triggered = None;
    }

    /// Keeps a report of missing messages for the bag of an incident that follows.
    fn note_missed(&mut self, missed: Missed) {
        if self.missed.len() >= MAX_MISSED_BEFORE
            && let Some((_, evicted)) = self.missed.pop_front()
        {
            self.unnamed += evicted.samples;
        }
        self.missed.push_back((self.clock, missed));
    }

    /// Compares new events with the triggers.
    pub(super) fn read_events(&mut self) {
        let events = Arc::clone(&self.recordings.events);
        while events.last() > self.event {
            let batch = events.read(self.event, 256);
            self.event = batch.last;
            for record in batch.records {
                let domain_id = self.settings.domain_id;
                let mut triggers = self.settings.triggers.iter();
                let trigger = triggers.find(|trigger| trigger.matches(&record, domain_id));
                if let Some(name) = trigger.map(|trigger| trigger.name()) {
                    self.trigger(name, record);
                }
            }
        }
    }

    /// Begins a bag, unless one is open or the last trigger is too recent.
    fn trigger(&mut self, name: &'static str, record: Record) {
        // Events of the agent have the time of this host, which differs in a replay.
        let is_of_agent = record.definition.name.starts_with("ros2probe.");
        let at = if is_of_agent { self.clock } else { record.at };
        let min_interval = self.settings.min_interval;
        let is_recent = |last: Timestamp| at.distance(last) < min_interval;
        if self.open.is_some() || self.triggered.is_some_and(is_recent) {
            self.figures.suppressed += 1;
            return;
        }
        // A bag without messages would be useless.
        if self.ring.is_empty() && self.settings.after.is_zero() {
            return;
        }
        self.triggered = Some(at);
        let cause = Cause::Event {
            trigger: name,
            id: self.recordings.events.id(record.number),
            record: Box::new(record),
        };
        let since = at - self.settings.before;
        // The event log records a failure.
        let Ok(bag) = self.create(cause, since) else {
            return;
        };
        self.open = Some(OpenBag {
            bag,
            since,
            end: at + self.settings.after,
            deadline: Instant::now() + self.settings.after + SOURCE_DELAY,
        });
        if self.settings.after.is_zero() && self.clock >= at {
            self.complete(None);
        }
    }

    /// Writes the messages in memory into a bag, and completes it.
    pub(super) fn write_memory(&mut self, cause: Cause) -> Result<WrittenBag, Unwritten> {
        let since = self.clock - self.settings.before;
        let bag = self.create(cause, since)?;
        self.finish(bag, None)
    }

    /// Creates a bag with the messages in memory that are not older than `since`.
    fn create(&mut self, cause: Cause, since: Timestamp) -> Result<SnapshotBag, Unwritten> {
        let samples = self.ring.iter().filter(|sample| sample.time >= since);
        let samples: Vec<_> = samples.map(Arc::clone).collect();
        let payloads = samples.iter().filter_map(|sample| sample.payload.as_ref());
        let needed = payloads.map(|payload| payload.len() as u64).sum();
        let missed = self.missed.iter().filter(|(at, _)| *at >= since);
        let missed: Vec<_> = missed.map(|(_, missed)| missed.clone()).collect();
        let mut bag = SnapshotBag::create(&self.recordings, &self.settings, cause, needed)
            .map_err(|failed| self.fail(failed))?;
        let samples = samples.into_iter().map(Item::Sample);
        for item in samples.chain(missed.into_iter().map(Item::Missed)) {
            if let Err(error) = bag.take(&item, &self.recordings) {
                return Err(self.fail(bag.discard(&error)));
            }
        }
        Ok(bag)
    }

    /// Reports a bag that could not be created. Returns the reason.
    fn fail(&mut self, failed: Failed) -> Unwritten {
        self.figures.failed += 1;
        self.figures.removed += failed.removed;
        let reason = Some(failed.reason.clone());
        self.report(&failed.cause, failed.name, 0, reason);
        Unwritten::Storage(failed.reason)
    }

    /// Completes the open bag. `error` is the storage error that ended it, if any.
    pub(super) fn complete(&mut self, error: Option<Error>) {
        if let Some(open) = self.open.take() {
            // The event log records the result.
            let _ = self.finish(open.bag, error);
        }
    }

    fn finish(&mut self, bag: SnapshotBag, error: Option<Error>) -> Result<WrittenBag, Unwritten> {
        let ended = bag.finish(error);
        let reason = ended.error.as_ref().map(causes);
        match reason {
            None => self.figures.written += 1,
            Some(_) => self.figures.failed += 1,
        }
        self.figures.removed += ended.removed;
        let WrittenBag { name, messages, .. } = ended.bag.clone();
        self.report(&ended.cause, name, messages, reason.clone());
        reason.map_or(Ok(ended.bag), |reason| Err(Unwritten::Storage(reason)))
    }

    fn report(&mut self, cause: &Cause, name: String, messages: u64, reason: Option<String>) {
        // A client of the API receives the reason in the response.
        let unasked = !matches!(cause, Cause::Request);
        if let Some(reason) = reason.as_ref().filter(|_| unasked) {
            let snapshot = self.settings.name.as_str();
            tracing::warn!(
                snapshot,
                reason,
                "failed to write a whole bag of a snapshot"
            );
        }
        self.recordings.events.record(AgentEvent::SnapshotTaken {
            snapshot: self.settings.name.clone(),
            trigger: cause.name(),
            trigger_event_id: cause.event_id().map(str::to_owned),
            recording: name,
            messages,
            reason,
        });
        self.publish_figures();
    }

    pub(super) fn publish_figures(&mut self) {
        self.figures.messages = self.ring.len() as u64;
        self.figures.bytes = self.ring.bytes() as u64;
        self.figures.evicted = self.ring.evicted() + self.unnamed;
        let figures = &self.recordings.figures;
        figures.snapshot(&self.settings.name, self.figures);
    }
}
