//! Working thread of the agent: reads packets from the source, feeds the model, and publishes
//! snapshots. Surfaces only read snapshots.

mod capture_time;
mod causes;
pub mod replay;
mod source;

use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::{Duration, Instant};

use ros2probe_wire::{GuidPrefix, Timestamp};
use tokio_util::sync::CancellationToken;

use self::causes::CauseDemand;
use self::replay::ReplayError;
use crate::agent_facts::AgentFacts;
use crate::events::DropMonitor;
use crate::events::EventLog;
use crate::limit_facts::LimitFigures;
use crate::replay_pace::{Jump, Pace};
use crate::snapshot_cell::SnapshotCell;
use crate::state::StateWriter;
use crate::subscriptions::Subscriptions;
use crate::watches::Watches;
pub use capture_time::CaptureTime;
use ros2probe_capture::live::{CaptureError, LiveSource};
use ros2probe_capture::system::give_back_memory;
use ros2probe_message::library::{DescribedFigures, Library};
use ros2probe_metrics::otlp::{NodeLogSink, SpanSink};
use ros2probe_model::derive::type_descriptions::TypeSource;
use ros2probe_model::facts::event::Class;
use ros2probe_model::facts::selection::SampleRequest;
use ros2probe_model::measure::history::History;
use ros2probe_model::observe::input::Input;
use ros2probe_model::observe::observer::Observer;
use ros2probe_model::report::snapshot::{DecodeErrorCount, Snapshot, TableFacts};
pub use source::{Source, probe};

/// Maximum time for which a replay runs without checking commands.
const REPLAY_SLICE: Duration = Duration::from_millis(250);
/// Maximum time for which a live source waits without checking commands and the clock. Captured
/// frames, a half-full record ring and commands end the wait earlier. Each round costs a wake-up,
/// and on a quiet host nothing else wakes the thread.
const LIVE_SLICE: Duration = Duration::from_secs(1);
/// Minimum interval of snapshots without requests. They are due each second, and a wake-up may be
/// early or late.
const PUBLISH_INTERVAL: Duration = Duration::from_millis(900);
/// Minimum interval of snapshots with requests.
const REQUESTED_PUBLISH_INTERVAL: Duration = Duration::from_millis(50);
/// Maximum interval of snapshots without a reader, while the graph does not change.
const UNREAD_PUBLISH_INTERVAL: Duration = Duration::from_secs(5);
/// Maximum interval of clock items to subscribers during silence.
const SUBSCRIBED_SLICE: Duration = Duration::from_millis(90);
/// Maximum time for which readers wait for breakpoints in the processes that send to them.
const ATTACH_TIMEOUT: Duration = Duration::from_secs(5);
const CLOCK_INTERVAL: Duration = Duration::from_millis(100);
/// Interval at which a replay at its end checks whether it has to go back.
const END_POLL: Duration = Duration::from_millis(50);
/// Reason for the end of subscriptions at the end of a replay.
const END_OF_CAPTURE: &str = "end of capture";
/// Minimum step back of the clock which means that the clock was set.
const SET_BACK: Duration = Duration::from_secs(1);

/// The working thread ended with an error.
#[derive(Debug, thiserror::Error)]
pub enum RunError {
    /// Capturing on this host failed.
    #[error("the capture failed")]
    Capture(#[from] CaptureError),
    /// The remaining part of a capture or bag cannot be read; earlier packets are published.
    #[error("the rest of the capture is unreadable")]
    Replay(#[source] ReplayError),
}

/// Source, model and outputs of the working thread.
pub struct Run {
    source: Source,
    observer: Observer,
    /// Participants for which the kernel filter records the time of the last message.
    followed: BTreeSet<GuidPrefix>,
    /// What watches and events require about late calls.
    causes: CauseDemand,
    outputs: Outputs,
    drops: DropMonitor,
    watches: Arc<Watches>,
    subscriptions: Arc<Subscriptions>,
    /// Requests of subscriptions that are not in force yet.
    sample_requests: Option<Arc<Vec<SampleRequest>>>,
    /// Requests in force whose readers wait until every message is captured, and the start of this
    /// wait.
    unconfirmed: Option<(Arc<Vec<SampleRequest>>, Instant)>,
    /// Last clock item sent to subscriptions.
    published_until: Timestamp,
    /// Last clock item sent to subscriptions whose clock waits for the order of samples.
    complete_until: Timestamp,
    /// Time of the latest snapshot, and the revision of the graph in it.
    taken: Option<(Instant, u64)>,
    stop: CancellationToken,
    state_writer: Option<StateWriter>,
    history: Option<History>,
    restart: Option<Restart>,
}

/// Makes model and history as at the beginning, for a replay that goes back.
pub type Restart = Box<dyn Fn() -> (Observer, Option<History>) + Send>;

/// Outputs of the loop.
#[derive(Debug)]
pub struct Outputs {
    /// Receives snapshots.
    pub latest: Arc<SnapshotCell>,
    /// Receives events.
    pub events: Arc<EventLog>,
    /// Records which limits a snapshot reaches.
    pub limits: Arc<LimitFigures>,
    /// Receives spans of sampled messages.
    pub spans: SpanSink,
    /// Messages of nodes' logs, if they are exported.
    pub node_logs: NodeLogSink,
    /// Receives descriptions of types.
    pub library: Arc<Library>,
}

impl Run {
    /// Creates the loop.
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
            causes: CauseDemand::default(),
            outputs,
            drops: DropMonitor::default(),
            watches,
            subscriptions,
            sample_requests: None,
            unconfirmed: None,
            published_until: Timestamp::default(),
            complete_until: Timestamp::default(),
            taken: None,
            stop,
            state_writer: None,
            history: None,
            restart: None,
        }
    }

    /// Saves the discovery state for the next start.
    #[must_use]
    pub fn with_state_writer(self, keeper: Option<StateWriter>) -> Self {
        Self {
            state_writer: keeper,
            ..self
        }
    }

    /// Keeps the measurements of the last seconds.
    #[must_use]
    pub fn with_history(self, history: Option<History>) -> Self {
        Self { history, ..self }
    }

    /// Lets a replay go back, also from its end: it then begins again, and goes on to the requested
    /// time without waiting. Such a loop runs until it is stopped.
    #[must_use]
    pub fn with_restart(self, restart: Option<Restart>) -> Self {
        Self { restart, ..self }
    }

    /// Runs until it is stopped or the capture ends; the last snapshot stays published.
    ///
    /// # Errors
    ///
    /// Fails if the source fails permanently.
    pub fn run(mut self) -> Result<(), RunError> {
        let mut ended = self.run_source();
        while ended.is_ok() && self.source.is_finished() && self.goes_back_later() {
            ended = self.run_source();
        }
        self.subscriptions.end(match &ended {
            Ok(()) if self.source.is_finished() => END_OF_CAPTURE,
            Ok(()) => "agent ends",
            Err(_) => "the capture failed",
        });
        if let Some(keeper) = self.state_writer.take() {
            keeper.finish(self.observer.memory());
        }
        ended
    }

    fn run_source(&mut self) -> Result<(), RunError> {
        let has_applied_lists = self.take_watches();
        self.hand_over();
        if has_applied_lists {
            self.confirm_requests();
        }
        self.confirm_complete();
        self.publish();
        let mut published = Instant::now();
        while !self.stop.is_cancelled() {
            let subscribed = self.subscriptions.is_open();
            let slice = if !self.observer.has_applied_lists() {
                Duration::ZERO
            } else if self.outputs.latest.is_requested() {
                REQUESTED_PUBLISH_INTERVAL
            } else if subscribed {
                SUBSCRIBED_SLICE
            } else {
                self.idle_slice()
            };
            let pace = self.apply_pace();
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
            self.store_history();
            let has_event = self.hand_over();
            if has_applied_lists {
                self.confirm_requests();
            }
            self.confirm_complete();
            let has_arrived = self.end_jump(pace, has_event);
            let age = published.elapsed();
            let is_current = age < REQUESTED_PUBLISH_INTERVAL && !self.source.is_paused();
            let is_asked = !is_current && self.outputs.latest.is_requested();
            let held = self.source.reached_pause();
            let must = finished || held || has_arrived || polled.is_err() || is_asked;
            if must || age >= PUBLISH_INTERVAL {
                if must || self.is_snapshot_due() {
                    self.publish();
                } else {
                    let facts = self.facts();
                    self.outputs.latest.publish_agent(facts);
                }
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
            self.observer.input(Input::Stopping);
        }
        self.hand_over();
        self.publish();
        // The history on disk has the last seconds, too.
        if let Some(history) = &self.history {
            self.outputs.latest.publish_past(history.past());
        }
        Ok(())
    }

    /// Makes a replay go on as clients request it, and returns what they request.
    fn apply_pace(&mut self) -> Pace {
        let pace = self.outputs.latest.replay_pace().get();
        if self.has_passed(&pace) {
            self.go_back();
        }
        if let Source::Replay(replay) = &mut self.source {
            replay.follow(&pace);
        }
        pace
    }

    /// Waits at the end of a replay until it has to go back. Returns `false` if it is stopped, or
    /// never goes back.
    fn goes_back_later(&self) -> bool {
        if self.restart.is_none() {
            return false;
        }
        tracing::info!("the capture has ended; its final state remains");
        self.subscriptions.end(END_OF_CAPTURE);
        while !self.stop.is_cancelled() {
            if self.has_passed(&self.outputs.latest.replay_pace().get()) {
                return true;
            }
            std::thread::sleep(END_POLL);
        }
        false
    }

    /// Returns whether a replay that can go back has passed the time that clients request.
    fn has_passed(&self, pace: &Pace) -> bool {
        match (pace.jump, &self.source) {
            (Some(Jump::To(time)), Source::Replay(replay)) => {
                self.restart.is_some() && time < replay.clock()
            }
            _ => false,
        }
    }

    /// Begins the replay again, with a model that knows nothing. If the file cannot be opened again,
    /// the replay stays where it is.
    fn go_back(&mut self) {
        let (Source::Replay(replay), Some(restart)) = (&mut self.source, &self.restart) else {
            return;
        };
        if let Err(error) = replay.begin_again() {
            tracing::warn!(%error, "the replay cannot go back");
            self.outputs
                .latest
                .replay_pace()
                .change(|pace| pace.jump = None);
            return;
        }
        (self.observer, self.history) = restart();
        self.outputs.events.begin_run();
        (self.published_until, self.complete_until) = <(Timestamp, Timestamp)>::default();
        self.taken = None;
        self.watches.begin_again();
        self.subscriptions.begin_again();
        self.take_watches();
        // Clients of the new run never receive the state of the old one.
        self.publish();
    }

    /// Ends the jump of a replay that has arrived. Returns whether it has.
    fn end_jump(&self, followed: Pace, has_event: bool) -> bool {
        let Source::Replay(replay) = &self.source else {
            return false;
        };
        let has_arrived = match followed.jump {
            Some(Jump::To(_)) => replay.has_reached_target(),
            Some(Jump::NextEvent) => has_event || replay.has_reached_target(),
            None => false,
        };
        if has_arrived {
            self.outputs.latest.replay_pace().change(|pace| {
                if pace.jump == followed.jump {
                    pace.is_paused |= pace.jump == Some(Jump::NextEvent);
                    pace.jump = None;
                }
            });
        }
        has_arrived
    }

    /// Returns the maximum wait without requests: until the next decision of the model, or the end
    /// of a second.
    fn idle_slice(&self) -> Duration {
        if let Source::Replay(_) = self.source {
            return REPLAY_SLICE;
        }
        let decision = self.observer.next_decision();
        let second = self.history.as_ref().map(History::due);
        let next = second.map_or(decision, |second| second.min(decision));
        (next - self.source.clock()).min(LIVE_SLICE)
    }

    /// Returns the next time at which a replay has to return: for a clock item to subscriptions, or
    /// at the end of a second. `None` if neither is needed.
    fn step(&self, subscribed: bool) -> Option<Timestamp> {
        let published_until = subscribed.then(|| self.published_until + CLOCK_INTERVAL);
        let second = self.history.as_ref().map(History::due);
        // Before the first packet, the capture's time is unknown.
        let second = second.filter(|second| second.0 > 0);
        match (published_until, second) {
            (Some(published_until), Some(second)) => Some(published_until.min(second)),
            (published_until, second) => published_until.or(second),
        }
    }

    /// Stores the measurements of the last second.
    fn store_history(&mut self) {
        let now = self.source.clock();
        let Some(history) = self.history.as_mut().filter(|history| history.is_due(now)) else {
            return;
        };
        history.take(now, self.observer.measured(now));
        let latest = &self.outputs.latest;
        // Ten minutes of history are a list of 600 seconds, which may have no reader.
        if latest.is_history_requested() || !matches!(self.source, Source::Live(_)) {
            latest.publish_past(history.past());
        }
    }

    /// Passes new items to the outputs. Slow readers block this thread only during a replay.
    /// Returns whether an event other than of a participant or endpoint is among them.
    fn hand_over(&mut self) -> bool {
        let now = self.source.clock();
        let output = self.observer.drain();
        if let Source::Live(live) = &mut self.source {
            live.apply(&output.interest);
            let now = Instant::now();
            live.request_inside(self.outputs.latest.are_calls_requested(now));
            let mut demand = self.outputs.latest.late_demand(now);
            self.causes.note(&output.events.events, now);
            self.causes.add_to(&mut demand, now);
            live.request_late_calls(&demand);
        }
        let mut events = output.events.events.iter();
        let has_event = events.any(|event| {
            let class = event.kind.class();
            !matches!(class, Class::Participant | Class::Endpoint)
        });
        self.outputs.events.add(output.events, now);
        if let Source::Replay(replay) = &mut self.source {
            for definition in replay.take_definitions() {
                self.outputs.library.add(definition, None);
            }
        }
        for source in output.type_sources {
            match source {
                TypeSource::Description(response) => self.outputs.library.offer(response),
                TypeSource::TypeObjects(reply) => self.outputs.library.offer_objects(reply),
            }
        }
        let spans = &self.outputs.spans;
        spans.add(output.spans, output.chain_spans, &output.late_calls);
        let node_logs = &self.outputs.node_logs;
        node_logs.add(output.logs, output.lost_logs);
        let clock = self.observer.dispatched_until(now);
        if clock + SET_BACK < self.published_until {
            self.published_until = clock;
        }
        let new_clock = (clock > self.published_until).then_some(clock);
        self.published_until = self.published_until.max(clock);
        self.subscriptions.deliver(output.samples, new_clock);
        if self.subscriptions.need_complete_clock() {
            let complete = self.observer.complete_until(clock);
            if complete > self.complete_until || complete + SET_BACK < self.complete_until {
                self.complete_until = complete;
                self.subscriptions.complete(complete);
            }
        }
        has_event
    }

    /// Passes changed watches and requests to the model. Returns whether every topic was matched
    /// against the lists. With many topics and globs, packets are read between the parts of this
    /// work, and further changes wait.
    fn take_watches(&mut self) -> bool {
        if self.apply_lists() {
            if let Some(watchlist) = self.watches.take_changed() {
                self.subscriptions.retain(watchlist.watches());
                if let Source::Live(live) = &self.source {
                    // The expectations of the new list begin now, not at the last round.
                    self.observer.input(Input::Time(live.clock()));
                }
                self.causes.take_watches(watchlist.watches());
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

    /// Delivers the retained samples to readers whose requests are in force in the kernel, before
    /// the next packets.
    fn confirm_requests(&mut self) {
        if let Some(sample_requests) = self.sample_requests.take() {
            let (observer, now) = (&mut self.observer, self.source.clock());
            (self.subscriptions)
                .confirm_applied(&sample_requests, now, |request| observer.latched(request));
            self.unconfirmed = Some((Arc::clone(&sample_requests), Instant::now()));
            if sample_requests.is_empty() {
                // Buffers of large messages are free now, and the next subscription may begin much
                // later.
                give_back_memory();
            }
        }
    }

    /// Confirms requests in force once every message is captured, or after [`ATTACH_TIMEOUT`].
    /// Readers then report why messages may be missing.
    fn confirm_complete(&mut self) {
        let Some((_, since)) = self.unconfirmed else {
            return;
        };
        let is_attaching = match &self.source {
            Source::Live(live) => live.is_attaching(&self.observer),
            Source::Replay(_) => false,
        };
        if is_attaching && since.elapsed() < ATTACH_TIMEOUT {
            return;
        }
        if let Some((sample_requests, _)) = self.unconfirmed.take() {
            self.subscriptions.confirm(&sample_requests);
        }
    }

    /// Applies new lists of watches and subscriptions to further topics. Returns whether all topics
    /// are done; a replay waits until they are.
    fn apply_lists(&mut self) -> bool {
        while !self.observer.has_applied_lists() {
            self.observer.input(Input::MoreLists);
            if let Source::Live(_) = self.source {
                break;
            }
        }
        self.observer.has_applied_lists()
    }

    fn publish(&mut self) {
        if let Source::Live(live) = &mut self.source {
            for (prefix, at) in live.last_seen() {
                self.observer.input(Input::ParticipantAlive(prefix, at));
            }
        }
        let revision = self.observer.memory_revision();
        if let Source::Live(live) = &self.source
            && let Some(shared_memory) = live.shared_memory()
        {
            let used = shared_memory.counters.memory_use;
            self.observer.input(Input::SharedMemoryUsed(used));
        }
        let mut snapshot = self.observer.snapshot(self.source.clock());
        snapshot.tables.extend(self.source.tables());
        let described = self.outputs.library.described_figures();
        snapshot.tables.extend(tables(&described));
        snapshot.decode_errors.extend(decode_errors(&described));
        if let Some(history) = &self.history {
            snapshot.tables.push(history.table());
            // A reader that waits for this state may read the last seconds next.
            if self.outputs.latest.is_requested() {
                self.outputs.latest.publish_past(history.past());
            }
        }
        if let Source::Live(live) = &mut self.source {
            follow(live, &mut self.followed, &snapshot);
        }
        self.taken = Some((Instant::now(), revision));
        let facts = self.facts();
        let state = self.outputs.latest.publish(snapshot, facts);
        self.outputs.limits.note(&state);
    }

    /// Returns whether the latest snapshot was read since the last call, or no longer describes the
    /// graph.
    fn is_snapshot_due(&self) -> bool {
        let was_read = self.outputs.latest.was_snapshot_read();
        let is_current = self.taken.is_some_and(|(at, revision)| {
            at.elapsed() < UNREAD_PUBLISH_INTERVAL && revision == self.observer.memory_revision()
        });
        was_read || !is_current || !matches!(self.source, Source::Live(_))
    }

    /// Returns the facts about the agent. Also saves changed discovery state, and records events
    /// about losses.
    fn facts(&mut self) -> AgentFacts {
        let mut facts = self.source.facts();
        facts.replay_pace = self.outputs.latest.replay_pace().get();
        facts.subscriptions = self.subscriptions.facts();
        facts.subscriptions.retained_bytes = self.observer.latched_bytes();
        if let Some(keeper) = &mut self.state_writer {
            let (revision, now) = (self.observer.memory_revision(), Instant::now());
            if keeper.is_write_due(revision, now) {
                keeper.keep(self.observer.memory(), revision, now);
            }
            let state = keeper.facts();
            facts.state = Some(state);
            let stalled = state.stalled.map(|long| {
                let seconds = long.as_secs();
                format!("state_directory: its file system has not answered for {seconds} s")
            });
            facts.stalled = facts.stalled.or(stalled);
        }
        for drop in self.drops.check(&facts, Instant::now()) {
            self.outputs.events.record(drop);
        }
        facts
    }
}

/// Returns the use of the tables of described types, of what nodes sent about types, and of
/// TypeObjects.
const fn tables(described: &DescribedFigures) -> [TableFacts; 3] {
    let types = TableFacts {
        table: "type_descriptions",
        size: described.types as u64,
        limit: DescribedFigures::MAX_TYPES as u64,
        bytes: Some((described.bytes as u64, DescribedFigures::MAX_BYTES as u64)),
        evictions: described.evicted,
    };
    let max_bytes = DescribedFigures::MAX_WAITING_BYTES as u64;
    let sources = TableFacts {
        table: "type_sources",
        size: described.waiting as u64,
        limit: DescribedFigures::MAX_WAITING as u64,
        bytes: Some((described.waiting_bytes as u64, max_bytes)),
        evictions: described.waiting_evicted,
    };
    let max_bytes = DescribedFigures::MAX_OBJECT_BYTES as u64;
    let objects = TableFacts {
        table: "type_objects",
        size: described.objects as u64,
        limit: DescribedFigures::MAX_OBJECTS as u64,
        bytes: Some((described.object_bytes as u64, max_bytes)),
        evictions: described.objects_evicted,
    };
    [types, sources, objects]
}

/// Returns the number of descriptions that could not be used, by reason.
fn decode_errors(described: &DescribedFigures) -> impl Iterator<Item = DecodeErrorCount> + use<> {
    let counts = [
        ("type_description", "bad_value", described.refused),
        ("type_description", "hash_mismatch", described.mismatched),
        ("type_object", "bad_value", described.objects_refused),
    ];
    let counts = counts.into_iter().filter(|(_, _, count)| *count > 0);
    counts.map(|(stage, reason, count)| DecodeErrorCount {
        stage,
        reason,
        count,
    })
}

/// Copies the model's list of participants to the kernel filter.
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn evictions_are_beside_the_limit_that_was_reached() {
        let evicted = |described: DescribedFigures| {
            let tables = tables(&described).into_iter();
            let full = tables.filter(|table| table.evictions > 0);
            let full = full.map(|table| (table.table, table.limit, table.evictions));
            full.collect::<Vec<_>>()
        };
        let waiting = DescribedFigures {
            waiting_evicted: 7,
            ..DescribedFigures::default()
        };
        let limit = DescribedFigures::MAX_WAITING as u64;
        assert_eq!(evicted(waiting), [("type_sources", limit, 7)]);
        let types = DescribedFigures {
            evicted: 3,
            ..DescribedFigures::default()
        };
        let limit = DescribedFigures::MAX_TYPES as u64;
        assert_eq!(evicted(types), [("type_descriptions", limit, 3)]);
    }
}
