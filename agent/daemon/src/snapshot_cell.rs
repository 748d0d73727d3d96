//! Latest snapshot, published by the capture thread and read by surfaces.
//!
//! Readers and the writer never wait for each other, except for the copy of a few questions about
//! late calls. A reader may request a newer state and wait
//! for it within its timeout.

use std::os::fd::BorrowedFd;
use std::sync::atomic::{AtomicBool, AtomicU8, Ordering};
use std::sync::{Arc, LazyLock, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use arc_swap::{ArcSwap, ArcSwapOption};
use tokio::sync::Notify;

use super::agent_facts::{AgentFacts, SourceKind};
use super::replay_pace::{Pace, ReplayPace};
use ros2probe_capture::bell::Bell;
use ros2probe_capture::inside::late::{LateDemand, RequestedBound};
use ros2probe_model::measure::history::Past;
use ros2probe_model::report::snapshot::Snapshot;

/// Maximum age of a state that still describes the robot.
const MAX_FRESH_AGE: Duration = Duration::from_secs(5);
/// Number of further seconds that are published after a client has read the last seconds.
const PAST_SECONDS: u8 = 5;

/// Time for which calls inside processes are observed after the last request for them.
const REQUEST_LIFETIME: Duration = Duration::from_secs(10);
/// Maximum number of topics and nodes about whose late calls clients ask at once.
const MAX_LATE_QUESTIONS: usize = 16;

/// The latest state and the last seconds.
#[derive(Debug)]
pub struct SnapshotCell {
    state: ArcSwap<State>,
    past: ArcSwap<Past>,
    /// Number of further seconds that are published for a reader of the last seconds.
    past_wanted: AtomicU8,
    /// Whether a reader waits for a newer state.
    requested: AtomicBool,
    /// Whether the state was read since [`Self::was_snapshot_read`].
    read: AtomicBool,
    /// Time at which a client last needed calls inside processes.
    calls_wanted: ArcSwapOption<Instant>,
    /// Causes of late calls for which clients asked lately.
    late_wanted: Mutex<Vec<LateQuestion>>,
    replay_pace: ReplayPace,
    bell: Arc<CaptureBell>,
    publication: Notify,
}

/// A client's question for the causes of late calls.
#[derive(Clone, Debug)]
struct LateQuestion {
    at: Instant,
    /// The topic, node or chain of the question; `None` = all.
    key: Option<Arc<str>>,
    bound: Option<RequestedBound>,
}

/// Wakes the capture thread from its wait for packets. Without a socket pair, readers wait until
/// the thread wakes by itself.
#[derive(Debug)]
pub struct CaptureBell(Option<Bell>);

/// State published by the capture thread.
#[derive(Clone, Debug)]
pub struct State {
    /// State of the robot; `None` until the first snapshot. Without readers, it is renewed every
    /// few seconds and when the graph changes, while `agent` is renewed each second.
    pub snapshot: Option<Arc<Snapshot>>,
    /// State of the agent.
    pub agent: AgentFacts,
}

impl CaptureBell {
    fn new() -> Self {
        Self(Bell::new().ok())
    }

    /// Wakes the capture thread.
    pub fn ring(&self) {
        if let Some(bell) = &self.0 {
            bell.ring();
        }
    }

    /// Returns the descriptor that is readable after [`Self::ring`] until [`Self::drain`]; `None`
    /// without a socket pair.
    #[must_use]
    pub fn descriptor(&self) -> Option<BorrowedFd<'_>> {
        Some(self.0.as_ref()?.descriptor())
    }

    /// Discards all rings so far.
    pub fn silence(&self) {
        if let Some(bell) = &self.0 {
            bell.drain();
        }
    }
}

impl SnapshotCell {
    /// Creates the cell of an agent that starts now, without a snapshot.
    #[must_use]
    pub fn new(source: SourceKind) -> Self {
        let agent = AgentFacts::new(source, Instant::now());
        Self {
            state: ArcSwap::from_pointee(State {
                snapshot: None,
                agent,
            }),
            past: ArcSwap::default(),
            past_wanted: AtomicU8::new(0),
            requested: AtomicBool::new(false),
            read: AtomicBool::new(false),
            calls_wanted: ArcSwapOption::empty(),
            late_wanted: Mutex::default(),
            replay_pace: ReplayPace::default(),
            bell: Arc::new(CaptureBell::new()),
            publication: Notify::new(),
        }
    }

    /// Replaces the state, and returns the new one.
    pub fn publish(&self, snapshot: impl Into<Arc<Snapshot>>, agent: AgentFacts) -> Arc<State> {
        let state = Arc::new(State {
            snapshot: Some(snapshot.into()),
            agent,
        });
        self.state.store(Arc::clone(&state));
        self.requested.store(false, Ordering::Relaxed);
        self.publication.notify_waiters();
        state
    }

    /// Replaces the state of the agent alone. Readers that wait for a newer state continue to wait.
    pub fn publish_agent(&self, agent: AgentFacts) {
        let snapshot = self.state.load().snapshot.clone();
        self.state.store(Arc::new(State { snapshot, agent }));
    }

    /// Returns whether the state was read since the last call.
    #[must_use]
    pub fn was_snapshot_read(&self) -> bool {
        self.read.swap(false, Ordering::Relaxed)
    }

    /// Notes that a client needs calls inside processes.
    pub fn request_calls(&self) {
        let before = self.calls_wanted.swap(Some(Arc::new(Instant::now())));
        if before.is_none_or(|before| before.elapsed() > REQUEST_LIFETIME) {
            self.bell.ring();
        }
    }

    /// Returns whether a client needed calls inside processes lately.
    #[must_use]
    pub fn are_calls_requested(&self, now: Instant) -> bool {
        let wanted = self.calls_wanted.load();
        let age = wanted
            .as_deref()
            .map(|at| now.saturating_duration_since(*at));
        age.is_some_and(|age| age <= REQUEST_LIFETIME)
    }

    /// Notes that a client requests the causes of late calls of this topic, node or chain, or of all.
    /// A bound lasts until ten seconds after the last request with it: another client's request
    /// without one does not end it.
    pub fn request_late_calls(&self, key: Option<&str>, bound: Option<RequestedBound>) {
        self.request_calls();
        let mut questions = self.late_questions();
        questions.retain(|question| question.at.elapsed() <= REQUEST_LIFETIME);
        let has_bound = bound.is_some();
        questions.retain(|known| known.key.as_deref() != key || known.bound.is_some() != has_bound);
        let same_kind = questions.iter();
        let same_kind = same_kind.filter(|known| known.bound.is_some() == has_bound);
        if same_kind.count() < MAX_LATE_QUESTIONS {
            questions.push(LateQuestion {
                at: Instant::now(),
                key: key.map(Arc::from),
                bound,
            });
        }
    }

    /// Returns what clients asked lately about late calls.
    #[must_use]
    pub fn late_demand(&self, now: Instant) -> LateDemand {
        let mut questions = self.late_questions();
        questions.retain(|question| now.saturating_duration_since(question.at) <= REQUEST_LIFETIME);
        let bounds = questions.iter();
        let mut bounds: Vec<_> = bounds
            .filter_map(|question| question.bound.clone())
            .collect();
        // The order of requests must not decide. The smallest one that applies counts.
        bounds.sort_by_key(|bound| bound.above);
        LateDemand {
            has_question: !questions.is_empty(),
            bounds,
        }
    }

    fn late_questions(&self) -> MutexGuard<'_, Vec<LateQuestion>> {
        let questions = self.late_wanted.lock();
        questions.unwrap_or_else(PoisonError::into_inner)
    }

    /// Returns how clients want a replay to go on.
    #[must_use]
    pub const fn replay_pace(&self) -> &ReplayPace {
        &self.replay_pace
    }

    /// Changes how a replay goes on, and returns the new pace.
    pub fn pace_replay(&self, change: impl FnOnce(&mut Pace)) -> Pace {
        let pace = self.replay_pace.change(change);
        self.bell.ring();
        pace
    }

    /// Counts one second, and returns whether the last seconds were read lately.
    #[must_use]
    pub fn is_history_requested(&self) -> bool {
        let left = self.past_wanted.load(Ordering::Relaxed);
        // A race with a reader only shifts the end of publishing by a second.
        self.past_wanted
            .store(left.saturating_sub(1), Ordering::Relaxed);
        left > 0
    }

    /// Replaces the measurements of the last seconds.
    pub fn publish_past(&self, past: Past) {
        self.past.store(Arc::new(past));
    }

    /// Returns the measurements of the last seconds. They are at least as new as the last state
    /// that a reader waited for ([`Self::refresh`]). A reader that calls this every second gets
    /// each second.
    #[must_use]
    pub fn past(&self) -> Arc<Past> {
        self.past_wanted.store(PAST_SECONDS, Ordering::Relaxed);
        self.past.load_full()
    }

    /// Returns the latest state. A reader that calls this every second gets a new state each time.
    #[must_use]
    pub fn state(&self) -> Arc<State> {
        self.read.store(true, Ordering::Relaxed);
        self.state.load_full()
    }

    /// Returns the latest state, for a reader that needs the state of the agent alone.
    #[must_use]
    pub fn own_state(&self) -> Arc<State> {
        self.state.load_full()
    }

    /// Returns whether a reader waits for a newer state.
    #[must_use]
    pub fn is_requested(&self) -> bool {
        self.requested.load(Ordering::Relaxed)
    }

    /// Returns the bell of the capture thread.
    #[must_use]
    pub const fn bell(&self) -> &Arc<CaptureBell> {
        &self.bell
    }

    /// Requests a newer state and waits for it for at most `timeout`. Counters in a scrape should
    /// be current, or rates over short windows would be wrong.
    pub async fn refresh(&self, timeout: Duration) {
        let publication = self.publication.notified();
        if self.state.load().agent.finished {
            return;
        }
        self.requested.store(true, Ordering::Relaxed);
        self.bell.ring();
        // After a timeout, the latest state is shown with its age.
        let _ = tokio::time::timeout(timeout, publication).await;
    }

    /// Returns when a newer state is published, without requesting one.
    pub async fn published(&self) {
        self.publication.notified().await;
    }
}

/// Why a state does not describe the robot.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Unready {
    /// No snapshot exists yet.
    #[error("starting: nothing captured yet")]
    Starting,
    /// The capture thread has not finished a round for this many seconds.
    #[error("the capture has made no progress for {0} s")]
    NoProgress(u64),
    /// The last snapshot is this many seconds old.
    #[error("the last snapshot is {0} s old")]
    Outdated(u64),
    /// The source does not observe its target, for this reason.
    #[error("{0}")]
    Unseen(String),
}

impl State {
    /// Returns the state of the robot; empty until the first snapshot.
    #[must_use]
    pub fn known(&self) -> &Snapshot {
        static EMPTY_SNAPSHOT: LazyLock<Snapshot> = LazyLock::new(Snapshot::default);
        self.snapshot.as_deref().unwrap_or(&EMPTY_SNAPSHOT)
    }

    /// Checks whether the state describes the robot at `now`.
    ///
    /// # Errors
    ///
    /// Returns the reason if it does not.
    pub fn ready(&self, now: Instant) -> Result<(), Unready> {
        self.progresses(now)?;
        let missing = self.agent.missing_object.clone();
        missing.map_or_else(
            || self.has_started(now),
            |reason| Err(Unready::Unseen(reason)),
        )
    }

    /// Checks whether every part of the source has started, even if its target does not exist.
    ///
    /// # Errors
    ///
    /// Returns the reason if one has not.
    pub fn has_started(&self, now: Instant) -> Result<(), Unready> {
        self.progresses(now)?;
        let agent = &self.agent;
        let unseen = agent.stalled.as_ref().or(agent.pending.as_ref());
        unseen.map_or(Ok(()), |reason| Err(Unready::Unseen(reason.clone())))
    }

    /// Checks whether the capture works, even if its target no longer exists.
    ///
    /// # Errors
    ///
    /// Returns the reason if it does not.
    pub fn progresses(&self, now: Instant) -> Result<(), Unready> {
        if self.snapshot.is_none() {
            return Err(Unready::Starting);
        }
        if self.agent.finished {
            return Ok(());
        }
        let stuck = now.saturating_duration_since(self.agent.capture_progress);
        if stuck > MAX_FRESH_AGE {
            return Err(Unready::NoProgress(stuck.as_secs()));
        }
        let age = now.saturating_duration_since(self.agent.collected_at);
        if age > MAX_FRESH_AGE {
            return Err(Unready::Outdated(age.as_secs()));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ros2probe_capture::inside::late::BoundScope;
    use ros2probe_capture::system::wait;

    #[test]
    fn an_agent_is_ready_only_while_it_captures() {
        let cell = SnapshotCell::new(SourceKind::Wire);
        let start = Instant::now();
        assert_eq!(cell.state().ready(start), Err(Unready::Starting));

        cell.publish(
            Snapshot::default(),
            AgentFacts::new(SourceKind::Wire, start),
        );
        assert_eq!(cell.state().ready(start + Duration::from_secs(4)), Ok(()));
        let reason = cell
            .state()
            .ready(start + Duration::from_secs(7))
            .unwrap_err();
        assert_eq!(
            reason.to_string(),
            "the capture has made no progress for 7 s"
        );

        let later = start + Duration::from_secs(60);
        let agent = AgentFacts {
            capture_progress: later,
            ..AgentFacts::new(SourceKind::Wire, start)
        };
        cell.publish(Snapshot::default(), agent);
        assert_eq!(
            cell.state().ready(later).unwrap_err().to_string(),
            "the last snapshot is 60 s old"
        );
    }

    #[test]
    fn an_agent_whose_cgroup_was_removed_progresses_but_is_not_ready() {
        let start = Instant::now();
        let gone = "the cgroup /robot was removed".to_owned();
        let mut state = State {
            snapshot: Some(Arc::default()),
            agent: AgentFacts {
                missing_object: Some(gone.clone()),
                ..AgentFacts::new(SourceKind::Host, start)
            },
        };
        assert_eq!(state.ready(start), Err(Unready::Unseen(gone)));
        assert_eq!(state.progresses(start), Ok(()));
        // A service manager must not wait for an interface that may come after it, or never.
        assert_eq!(state.has_started(start), Ok(()));
        let later = start + Duration::from_hours(1);
        assert!(state.progresses(later).is_err());
        state.agent.missing_object = None;
        assert_eq!(state.ready(start), Ok(()));
        // A part that makes no progress has the same effect.
        let stalled = "capture.inside: its thread has made no progress for 5 s".to_owned();
        state.agent.stalled = Some(stalled.clone());
        assert_eq!(state.ready(start), Err(Unready::Unseen(stalled)));
        assert_eq!(state.progresses(start), Ok(()));
        state.agent.stalled = None;
        // Breakpoints that are not set yet have the same effect.
        let pending = "capture.inside: not inspected yet".to_owned();
        state.agent.pending = Some(pending.clone());
        assert_eq!(state.ready(start), Err(Unready::Unseen(pending.clone())));
        assert_eq!(state.has_started(start), Err(Unready::Unseen(pending)));
        assert_eq!(state.progresses(start), Ok(()));
    }

    #[test]
    fn a_finished_replay_stays_ready() {
        let start = Instant::now();
        let agent = AgentFacts {
            finished: true,
            ..AgentFacts::new(SourceKind::Replay, start)
        };
        let state = State {
            snapshot: Some(Arc::default()),
            agent,
        };
        assert_eq!(state.ready(start + Duration::from_hours(1)), Ok(()));
    }

    #[tokio::test]
    async fn new_facts_about_the_agent_alone_do_not_end_the_wait_of_a_reader() {
        let cell = SnapshotCell::new(SourceKind::Wire);
        let start = Instant::now();
        let at = |seconds| AgentFacts::new(SourceKind::Wire, start + Duration::from_secs(seconds));
        let snapshot = Snapshot {
            records: 7,
            ..Snapshot::default()
        };
        cell.publish(snapshot, at(0));
        assert!(!cell.was_snapshot_read());
        let mut publication = Box::pin(cell.published());
        assert!(futures_util::poll!(&mut publication).is_pending());
        cell.refresh(Duration::ZERO).await;
        cell.publish_agent(at(3));
        assert!(futures_util::poll!(&mut publication).is_pending() && cell.is_requested());
        let own = cell.own_state();
        assert_eq!(
            (own.known().records, own.agent.collected_at),
            (7, at(3).collected_at)
        );
        assert!(!cell.was_snapshot_read(), "the snapshot was not read");
        assert_eq!(cell.state().known().records, 7);
        assert!(cell.was_snapshot_read() && !cell.was_snapshot_read());
        cell.publish(Snapshot::default(), at(4));
        publication.await;
    }

    #[tokio::test]
    async fn a_refresh_waits_for_the_next_state_up_to_its_timeout() {
        let cell = SnapshotCell::new(SourceKind::Wire);
        let writer = async {
            while !cell.is_requested() {
                tokio::task::yield_now().await;
            }
            cell.publish(
                Snapshot::default(),
                AgentFacts::new(SourceKind::Wire, Instant::now()),
            );
        };
        tokio::join!(cell.refresh(Duration::from_secs(3600)), writer);
        assert!(cell.state().snapshot.is_some() && !cell.is_requested());
        cell.refresh(Duration::from_millis(1)).await;
    }

    #[test]
    fn the_last_seconds_are_published_for_some_seconds_after_they_were_read() {
        let cell = SnapshotCell::new(SourceKind::Wire);
        assert!(!cell.is_history_requested());
        let _ = cell.past();
        let wanted = (0..100).filter(|_| cell.is_history_requested()).count();
        assert_eq!(wanted, usize::from(PAST_SECONDS));
        let _ = cell.past();
        assert!(cell.is_history_requested());
    }

    #[test]
    fn calls_are_wanted_until_ten_seconds_after_the_last_request() {
        let cell = SnapshotCell::new(SourceKind::Host);
        let after =
            |seconds| cell.are_calls_requested(Instant::now() + Duration::from_secs(seconds));
        assert!(!after(0));
        cell.request_calls();
        let rings = cell.bell().descriptor().unwrap();
        assert_eq!(wait(&[rings], Duration::ZERO).unwrap(), Some(0));
        assert!(after(0) && after(9) && !after(11));
    }

    #[test]
    fn late_calls_are_wanted_until_ten_seconds_after_the_last_question() {
        let cell = SnapshotCell::new(SourceKind::Host);
        let after = |seconds| cell.late_demand(Instant::now() + Duration::from_secs(seconds));
        assert_eq!(after(0), LateDemand::default());
        let above = |milliseconds| {
            Some(RequestedBound {
                of: BoundScope::All,
                above: Duration::from_millis(milliseconds),
            })
        };
        cell.request_late_calls(Some("/scan"), above(5));
        cell.request_late_calls(Some("/scan"), above(7));
        for _ in 0..100 {
            cell.request_late_calls(None, None);
            // The page sends requests without a bound.
            cell.request_late_calls(Some("/scan"), None);
        }
        let demand = after(9);
        assert!(demand.has_question);
        assert_eq!(demand.bounds, [above(7).unwrap()]);
        assert_eq!(after(11), LateDemand::default());
    }

    #[test]
    fn late_call_requests_are_bounded() {
        let cell = SnapshotCell::new(SourceKind::Host);
        for number in 0..1000 {
            let bound = RequestedBound {
                of: BoundScope::All,
                above: Duration::ZERO,
            };
            cell.request_late_calls(Some(&format!("/topic_{number}")), Some(bound));
        }
        let bounds = cell.late_demand(Instant::now()).bounds;
        assert_eq!(bounds.len(), MAX_LATE_QUESTIONS);
    }

    #[tokio::test]
    async fn a_request_rings_the_bell_until_it_is_silenced() {
        let cell = SnapshotCell::new(SourceKind::Wire);
        let rings = || {
            let listener = cell.bell().descriptor().unwrap();
            wait(&[listener], Duration::ZERO).unwrap() == Some(0)
        };
        assert!(!rings());
        for _ in 0..3 {
            cell.refresh(Duration::ZERO).await;
        }
        assert!(rings());
        cell.bell().silence();
        assert!(!rings() && cell.is_requested());
    }
}
