//! The agent's one working thread: takes packets from the source, feeds the model, pins a snapshot
//! once a second and when a scrape asks for one. Surfaces never reach in here; they read snapshots.

mod capture_time;
pub mod replay;
mod source;

use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::{Duration, Instant};

use ros2probe_wire::{GuidPrefix, Timestamp};
use tokio_util::sync::CancellationToken;

use crate::events::DropMonitor;
use crate::events::EventLog;
use crate::limit_facts::LimitFigures;
use crate::snapshot_cell::SnapshotCell;
use crate::state::StateWriter;
use crate::subscriptions::Subscriptions;
use crate::surface::otlp::SpanSink;
use crate::watches::Watches;
pub use capture_time::CaptureTime;
use ros2probe_capture::live::{CaptureError, LiveSource};
use ros2probe_capture::pcap::PcapError;
use ros2probe_capture::system::give_back_memory;
use ros2probe_model::history::History;
use ros2probe_model::input::Input;
use ros2probe_model::observer::Observer;
use ros2probe_model::selection::SampleRequest;
use ros2probe_model::snapshot::Snapshot;
pub use source::{Source, probe};

/// Longest time without looking at commands and the clock. Captured frames and a record ring that
/// is half full end it earlier; each round costs a wake-up, and on a quiet host nothing else does.
const SLICE: Duration = Duration::from_millis(250);
/// How often surfaces get a new snapshot unasked, and how often at most when they ask.
const PUBLISH: Duration = Duration::from_secs(1);
const PUBLISH_ASKED: Duration = Duration::from_millis(50);
/// Subscribers learn at least this often that nothing came.
const SLICE_SUBSCRIBED: Duration = Duration::from_millis(90);
const CLOCK_NANOSECONDS: u64 = 100_000_000;
/// A clock that is so far behind what was told was set back.
const SET_BACK: u64 = 1_000_000_000;

/// Why the working thread ended by itself.
#[derive(Debug, thiserror::Error)]
pub enum RunError {
    /// The host's interfaces can no longer be captured.
    #[error("capturing ended")]
    Capture(#[from] CaptureError),
    /// The rest of a capture cannot be read; what came before it is published.
    #[error("the capture was replayed up to a fault")]
    Replay(#[source] PcapError),
}

/// Source, model and outputs, for one thread.
pub struct Run {
    source: Source,
    observer: Observer,
    /// Participants whose last message the kernel filter notes.
    followed: BTreeSet<GuidPrefix>,
    outputs: Outputs,
    drops: DropMonitor,
    watches: Arc<Watches>,
    subscriptions: Arc<Subscriptions>,
    /// Those that subscriptions wait for to be in force.
    sample_requests: Option<Arc<Vec<SampleRequest>>>,
    /// The time that subscriptions were last told.
    published_until: Timestamp,
    stop: CancellationToken,
    keeper: Option<StateWriter>,
    history: Option<History>,
}

/// Where the loop leaves what it finds.
#[derive(Debug)]
pub struct Outputs {
    /// Takes snapshots.
    pub latest: Arc<SnapshotCell>,
    /// Takes events.
    pub events: Arc<EventLog>,
    /// Notes which limits a snapshot reaches.
    pub limits: Arc<LimitFigures>,
    /// Takes spans of sampled messages.
    pub spans: SpanSink,
}

impl Run {
    /// Ready to run.
    #[must_use]
    pub fn new(
        source: Source,
        observer: Observer,
        outputs: Outputs,
        watches: Arc<Watches>,
        subscriptions: Arc<Subscriptions>,
        stop: CancellationToken,
    ) -> Self {
        Self {
            source,
            observer,
            followed: BTreeSet::new(),
            outputs,
            drops: DropMonitor::default(),
            watches,
            subscriptions,
            sample_requests: None,
            published_until: Timestamp::default(),
            stop,
            keeper: None,
            history: None,
        }
    }

    /// Keeps what discovery knows for the next start.
    #[must_use]
    pub fn keeping(self, keeper: Option<StateWriter>) -> Self {
        Self { keeper, ..self }
    }

    /// Remembers what was measured in the last seconds.
    #[must_use]
    pub fn remembering(self, history: Option<History>) -> Self {
        Self { history, ..self }
    }

    /// Works until told to stop or until the capture ends; the last state stays published.
    ///
    /// # Errors
    /// When the source fails for good.
    pub fn run(mut self) -> Result<(), RunError> {
        let ended = self.work();
        self.subscriptions.end(match &ended {
            Ok(()) if self.source.is_finished() => "end of capture",
            Ok(()) => "agent ends",
            Err(_) => "the capture failed",
        });
        if let Some(keeper) = self.keeper.take() {
            keeper.finish(self.observer.memory());
        }
        ended
    }

    fn work(&mut self) -> Result<(), RunError> {
        let has_applied_lists = self.take_watches();
        self.hand_over();
        if has_applied_lists {
            self.confirm_wishes();
        }
        self.publish();
        let mut published = Instant::now();
        while !self.stop.is_cancelled() {
            let subscribed = self.subscriptions.is_open();
            let slice = if !self.observer.has_applied_lists() {
                Duration::ZERO
            } else if self.outputs.latest.is_asked() {
                PUBLISH_ASKED
            } else if subscribed {
                SLICE_SUBSCRIBED
            } else {
                SLICE
            };
            let step = self.step(subscribed);
            let bell = self.outputs.latest.bell().descriptor();
            let polled = self.source.poll(slice, step, bell, &mut self.observer);
            self.outputs.latest.bell().silence();
            let has_applied_lists = self.take_watches();
            let finished = self.source.is_finished();
            if finished {
                if let Some(end) = self.source.cut() {
                    self.observer.input(Input::Time(end));
                }
                self.observer.input(Input::End);
            } else {
                self.observer.input(Input::Time(self.source.clock()));
            }
            self.remember();
            self.hand_over();
            if has_applied_lists {
                self.confirm_wishes();
            }
            let age = published.elapsed();
            let due = age >= PUBLISH || (age >= PUBLISH_ASKED && self.outputs.latest.is_asked());
            let held = self.source.reached_pause();
            if finished || held || polled.is_err() || due {
                self.publish();
                published = Instant::now();
            }
            if held {
                self.source.report_pause();
            }
            if finished {
                self.outputs.events.settle();
            }
            polled?;
            if finished {
                return Ok(());
            }
        }
        if let Source::Live(live) = &mut self.source {
            live.drain(&mut self.observer);
        }
        self.hand_over();
        self.publish();
        Ok(())
    }

    /// Where a replay has to stop for a moment: where subscriptions receive the time, or where a
    /// second ends.
    fn step(&self, subscribed: bool) -> Option<Timestamp> {
        let published_until =
            subscribed.then(|| Timestamp(self.published_until.0.saturating_add(CLOCK_NANOSECONDS)));
        let second = self.history.as_ref().map(History::due);
        // Before the first packet nothing is known of the capture's time.
        let second = second.filter(|second| second.0 > 0);
        match (published_until, second) {
            (Some(published_until), Some(second)) => Some(published_until.min(second)),
            (published_until, second) => published_until.or(second),
        }
    }

    /// Takes the second that has just ended.
    fn remember(&mut self) {
        let now = self.source.clock();
        let Some(history) = self.history.as_mut().filter(|history| history.is_due(now)) else {
            return;
        };
        history.take(now, self.observer.measured(now));
        self.outputs.latest.publish_past(history.past());
    }

    /// Gives away what has come up since the last time. No reader makes this wait.
    fn hand_over(&mut self) {
        let now = self.source.clock();
        let output = self.observer.drain();
        if let Source::Live(live) = &mut self.source {
            live.apply(&output.interest);
        }
        self.outputs.events.add(output.events, now);
        self.outputs.spans.add(output.spans);
        let clock = self.observer.dispatched_until(now);
        if clock.0.saturating_add(SET_BACK) < self.published_until.0 {
            self.published_until = clock;
        }
        let news = (clock > self.published_until).then_some(clock);
        self.published_until = self.published_until.max(clock);
        self.subscriptions.deliver(output.samples, news);
    }

    /// Gives the model changed lists of watches and wishes. Returns whether every topic was matched
    /// against them. Where many topics meet many globs, packets are taken in between, and lists that
    /// change meanwhile wait.
    fn take_watches(&mut self) -> bool {
        if self.apply_lists() {
            if let Some(watchlist) = self.watches.take_changed() {
                self.subscriptions.retain(watchlist.watches());
                self.observer.input(Input::Watchlist(watchlist));
            }
            if let Some(sample_requests) = self.subscriptions.take_changed() {
                self.observer
                    .input(Input::SampleRequests(Arc::clone(&sample_requests)));
                self.sample_requests = Some(sample_requests);
            }
        }
        self.apply_lists()
    }

    /// Confirms wishes whose verdicts the kernel has, before the next packets.
    fn confirm_wishes(&mut self) {
        if let Some(sample_requests) = self.sample_requests.take() {
            self.subscriptions.in_force(&sample_requests);
            if sample_requests.is_empty() {
                // Buffers of large messages are free now, and the next subscription may be far off.
                give_back_memory();
            }
        }
    }

    /// Applies new lists of watches and subscriptions to further topics; returns whether all are done.
    /// A replay waits for it.
    fn apply_lists(&mut self) -> bool {
        while !self.observer.apply_more_lists() {
            if let Source::Live(_) = self.source {
                return false;
            }
        }
        true
    }

    fn publish(&mut self) {
        if let Source::Live(live) = &mut self.source {
            for (prefix, at) in live.last_seen() {
                self.observer.input(Input::ParticipantAlive(prefix, at));
            }
        }
        let mut snapshot = self.observer.snapshot(self.source.clock());
        if let Some(history) = &self.history {
            snapshot.tables.push(history.table());
        }
        if let Source::Live(live) = &mut self.source {
            follow(live, &mut self.followed, &snapshot);
        }
        let mut facts = self.source.facts();
        facts.subscriptions = self.subscriptions.facts();
        if let Some(keeper) = &mut self.keeper {
            let (revision, now) = (self.observer.memory_revision(), Instant::now());
            if keeper.wants(revision, now) {
                keeper.keep(self.observer.memory(), revision, now);
            }
            facts.state = Some(keeper.facts());
        }
        for drop in self.drops.check(&facts, Instant::now()) {
            self.outputs.events.record(drop);
        }
        let state = self.outputs.latest.publish(snapshot, facts);
        self.outputs.limits.note(&state);
    }
}

/// Keeps the kernel filter's list of participants the model's.
fn follow(live: &mut LiveSource, followed: &mut BTreeSet<GuidPrefix>, snapshot: &Snapshot) {
    let present: BTreeSet<_> = snapshot
        .participants
        .iter()
        .map(|participant| participant.guid.prefix)
        .collect();
    for gone in followed.difference(&present) {
        live.follow(*gone, false);
    }
    for new in present.difference(followed) {
        live.follow(*new, true);
    }
    *followed = present;
}
