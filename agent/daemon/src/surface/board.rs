//! The board on which the capture thread pins what it knows and from which surfaces read.
//!
//! A reader takes the latest state, the writer replaces it; neither holds the other up. A reader
//! may ask for a newer state and wait for it, as long as it has patience.

use std::os::fd::BorrowedFd;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, LazyLock};
use std::time::{Duration, Instant, SystemTime};

use arc_swap::ArcSwap;
use tokio::sync::Notify;

use super::agent_facts::{AgentFacts, SourceKind};
use super::events::{AgentEvent, EventLog};
use super::limit_facts::LimitFigures;
use super::otlp::{Exports, Reason, Signal, SpanQueue};
use super::recording_facts::RecordingFigures;
use crate::config::{Config, Limits, Watch};
use ros2probe_capture::bell::Bell;
use ros2probe_model::history::Past;
use ros2probe_model::snapshot::Snapshot;
use ros2probe_model::trace::Spans;

/// Older than this, the state no longer describes the robot.
const FRESH: Duration = Duration::from_secs(5);

/// Everything surfaces read, replaced piece by piece.
#[derive(Debug)]
pub struct Board {
    state: ArcSwap<State>,
    past: ArcSwap<Past>,
    settings: ArcSwap<Settings>,
    reload: ArcSwap<Reload>,
    events: Arc<EventLog>,
    exports: Exports,
    spans: SpanQueue,
    recordings: RecordingFigures,
    lost_lines: Arc<AtomicU64>,
    limits: LimitFigures,
    /// Somebody waits for a newer state.
    asked: AtomicBool,
    /// Wakes the capture thread while it waits for packets.
    bell: Option<Bell>,
    news: Notify,
}

/// What the capture thread found out.
#[derive(Clone, Debug)]
pub struct State {
    /// The robot; `None` until the first snapshot.
    pub snapshot: Option<Snapshot>,
    /// The agent.
    pub agent: AgentFacts,
}

/// The part of the configuration that decides what is shown.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Settings {
    /// Expectations are shown as configured.
    pub watches: Vec<Arc<Watch>>,
    /// Histograms of watched topics.
    pub histograms: bool,
    /// Series per writer.
    pub per_writer: bool,
    /// Caps; those of the start stay in force.
    pub limits: Limits,
}

/// How the last reload of the configuration went.
#[derive(Clone, Copy, Debug)]
pub struct Reload {
    /// It was taken over.
    pub successful: bool,
    /// When one was last taken over.
    pub last_success: SystemTime,
}

impl Settings {
    /// What `config` wants to be shown, with the watches that are in force.
    #[must_use]
    pub fn new(config: &Config) -> Self {
        Self {
            watches: config.watches.iter().cloned().map(Arc::new).collect(),
            histograms: config.metrics.histograms,
            per_writer: config.metrics.per_writer,
            limits: config.limits,
        }
    }
}

impl Board {
    /// An empty board of an agent that was configured just now.
    #[must_use]
    pub fn new(source: SourceKind, settings: Settings) -> Self {
        let agent = AgentFacts::new(source, Instant::now());
        let events = EventLog::new();
        events.record(AgentEvent::Started { source });
        let reload = Reload {
            successful: true,
            last_success: SystemTime::now(),
        };
        let limits = LimitFigures::new(settings.limits);
        Self {
            state: ArcSwap::from_pointee(State {
                snapshot: None,
                agent,
            }),
            past: ArcSwap::default(),
            settings: ArcSwap::from_pointee(settings),
            reload: ArcSwap::from_pointee(reload),
            events: Arc::new(events),
            exports: Exports::default(),
            spans: SpanQueue::default(),
            recordings: RecordingFigures::default(),
            lost_lines: Arc::default(),
            limits,
            asked: AtomicBool::new(false),
            // Without one, askers wait until the capture thread looks by itself.
            bell: Bell::new().ok(),
            news: Notify::new(),
        }
    }

    /// The same, showing what the log counts.
    #[must_use]
    pub fn counting_lost_lines(self, lost_lines: Arc<AtomicU64>) -> Self {
        Self { lost_lines, ..self }
    }

    /// Lines of the log that standard error did not take.
    #[must_use]
    pub fn lost_lines(&self) -> u64 {
        self.lost_lines.load(Ordering::Relaxed)
    }

    /// Pins a new state.
    pub fn publish(&self, snapshot: Snapshot, agent: AgentFacts) {
        let state = State {
            snapshot: Some(snapshot),
            agent,
        };
        self.limits.note(&state);
        self.state.store(Arc::new(state));
        self.asked.store(false, Ordering::Relaxed);
        self.news.notify_waiters();
    }

    /// Pins what was measured in the last seconds.
    pub fn remember(&self, past: Past) {
        self.past.store(Arc::new(past));
    }

    /// What was measured in the last seconds.
    #[must_use]
    pub fn past(&self) -> Arc<Past> {
        self.past.load_full()
    }

    /// Whether somebody waits for a newer state.
    #[must_use]
    pub fn is_asked(&self) -> bool {
        self.asked.load(Ordering::Relaxed)
    }

    /// Readable when somebody has asked since [`Self::hear`].
    #[must_use]
    pub fn bell(&self) -> Option<BorrowedFd<'_>> {
        Some(self.bell.as_ref()?.descriptor())
    }

    /// Silences the bell. Whether somebody waits is still told by [`Self::is_asked`].
    pub fn hear(&self) {
        if let Some(bell) = &self.bell {
            bell.silence();
        }
    }

    /// Wakes the capture thread.
    pub fn ring(&self) {
        if let Some(bell) = &self.bell {
            bell.ring();
        }
    }

    /// Asks for a newer state and waits for it, but no longer than `patience`: counters that a
    /// scrape reads should be those of its moment, or rates over short windows would be off.
    pub async fn refresh(&self, patience: Duration) {
        let news = self.news.notified();
        if self.state.load().agent.finished {
            return;
        }
        self.asked.store(true, Ordering::Relaxed);
        self.ring();
        // Late or not: what is on the board is shown, with its age.
        let _ = tokio::time::timeout(patience, news).await;
    }

    /// Returns when a newer state is pinned, without asking for one.
    pub async fn published(&self) {
        self.news.notified().await;
    }

    /// Other watches are in force from now on.
    pub fn watch(&self, watches: &[Arc<Watch>]) {
        self.settings.rcu(|settings| Settings {
            watches: watches.to_vec(),
            ..(**settings).clone()
        });
    }

    /// Pins new settings after a reload that worked.
    pub fn reloaded(&self, settings: Settings) {
        let watches = settings.watches.len();
        self.events.record(AgentEvent::Reloaded { watches });
        self.settings.store(Arc::new(settings));
        let reload = Reload {
            successful: true,
            last_success: SystemTime::now(),
        };
        self.reload.store(Arc::new(reload));
    }

    /// Notes that a reload was refused, and why.
    pub fn reload_failed(&self, error: &str) {
        let error = error.to_owned();
        self.events.record(AgentEvent::ReloadFailed { error });
        let last_success = self.reload.load().last_success;
        self.reload.store(Arc::new(Reload {
            successful: false,
            last_success,
        }));
    }

    /// The latest state.
    #[must_use]
    pub fn state(&self) -> Arc<State> {
        self.state.load_full()
    }

    /// The settings in force.
    #[must_use]
    pub fn settings(&self) -> Arc<Settings> {
        self.settings.load_full()
    }

    /// What happened lately.
    #[must_use]
    pub const fn events(&self) -> &Arc<EventLog> {
        &self.events
    }

    /// Hands over spans, where they are exported.
    pub fn add_spans(&self, spans: Spans) {
        let Spans { spans, lost } = spans;
        if self
            .exports
            .signals()
            .any(|signal| signal == Signal::Traces)
        {
            let refused = self.spans.put(spans);
            self.exports
                .count_dropped(Signal::Traces, Reason::Overflow, refused + lost);
        }
    }

    /// What recordings have done.
    #[must_use]
    pub const fn recordings(&self) -> &RecordingFigures {
        &self.recordings
    }

    /// The caps, and what reached them.
    #[must_use]
    pub const fn limits(&self) -> &LimitFigures {
        &self.limits
    }

    /// Spans that wait for being exported.
    #[must_use]
    pub const fn spans(&self) -> &SpanQueue {
        &self.spans
    }

    /// What became of what was to be exported.
    #[must_use]
    pub const fn exports(&self) -> &Exports {
        &self.exports
    }

    /// How the last reload went.
    #[must_use]
    pub fn reload(&self) -> Reload {
        **self.reload.load()
    }
}

impl State {
    /// The robot; nothing at all until the first snapshot.
    #[must_use]
    pub fn known(&self) -> &Snapshot {
        static NOTHING: LazyLock<Snapshot> = LazyLock::new(Snapshot::default);
        self.snapshot.as_ref().unwrap_or(&NOTHING)
    }

    /// Whether what is shown describes the robot at `now`.
    ///
    /// # Errors
    /// The reason why it does not.
    pub fn ready(&self, now: Instant) -> Result<(), String> {
        self.progresses(now)?;
        self.agent.gone.clone().map_or(Ok(()), Err)
    }

    /// Whether the capture works, also while what it looks at is gone.
    ///
    /// # Errors
    /// The reason why it does not.
    pub fn progresses(&self, now: Instant) -> Result<(), String> {
        if self.snapshot.is_none() {
            return Err("starting: nothing captured yet".to_owned());
        }
        if self.agent.finished {
            return Ok(());
        }
        let stuck = now.saturating_duration_since(self.agent.capture_progress);
        if stuck > FRESH {
            return Err(format!(
                "the capture has made no progress for {} s",
                stuck.as_secs()
            ));
        }
        let age = now.saturating_duration_since(self.agent.at);
        if age > FRESH {
            return Err(format!("the last snapshot is {} s old", age.as_secs()));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ros2probe_capture::system::wait;

    #[test]
    fn an_agent_is_ready_only_while_it_sees() {
        let board = Board::new(SourceKind::Wire, Settings::default());
        let start = Instant::now();
        assert!(
            board
                .state()
                .ready(start)
                .unwrap_err()
                .starts_with("starting")
        );

        board.publish(
            Snapshot::default(),
            AgentFacts::new(SourceKind::Wire, start),
        );
        assert_eq!(board.state().ready(start + Duration::from_secs(4)), Ok(()));
        let reason = board
            .state()
            .ready(start + Duration::from_secs(7))
            .unwrap_err();
        assert_eq!(reason, "the capture has made no progress for 7 s");

        let later = start + Duration::from_secs(60);
        let agent = AgentFacts {
            capture_progress: later,
            ..AgentFacts::new(SourceKind::Wire, start)
        };
        board.publish(Snapshot::default(), agent);
        assert_eq!(
            board.state().ready(later).unwrap_err(),
            "the last snapshot is 60 s old"
        );
    }

    #[test]
    fn an_agent_whose_cgroup_is_gone_works_and_is_not_ready() {
        let start = Instant::now();
        let gone = "the cgroup /robot was removed".to_owned();
        let mut state = State {
            snapshot: Some(Snapshot::default()),
            agent: AgentFacts {
                gone: Some(gone.clone()),
                ..AgentFacts::new(SourceKind::Host, start)
            },
        };
        assert_eq!(state.ready(start), Err(gone));
        assert_eq!(state.progresses(start), Ok(()));
        let later = start + Duration::from_hours(1);
        assert!(state.progresses(later).is_err());
        state.agent.gone = None;
        assert_eq!(state.ready(start), Ok(()));
    }

    #[test]
    fn a_finished_replay_stays_ready() {
        let start = Instant::now();
        let agent = AgentFacts {
            finished: true,
            ..AgentFacts::new(SourceKind::Replay, start)
        };
        let state = State {
            snapshot: Some(Snapshot::default()),
            agent,
        };
        assert_eq!(state.ready(start + Duration::from_hours(1)), Ok(()));
    }

    #[tokio::test]
    async fn who_asks_gets_the_next_state_and_waits_for_a_stuck_writer_only_so_long() {
        let board = Board::new(SourceKind::Wire, Settings::default());
        let writer = async {
            while !board.is_asked() {
                tokio::task::yield_now().await;
            }
            board.publish(
                Snapshot::default(),
                AgentFacts::new(SourceKind::Wire, Instant::now()),
            );
        };
        tokio::join!(board.refresh(Duration::from_secs(3600)), writer);
        assert!(board.state().snapshot.is_some() && !board.is_asked());
        board.refresh(Duration::from_millis(1)).await;
    }

    #[tokio::test]
    async fn asking_rings_the_bell_until_it_is_heard() {
        let board = Board::new(SourceKind::Wire, Settings::default());
        let rings = || {
            let listener = board.bell().unwrap();
            wait(&[listener], Duration::ZERO).unwrap() == Some(0)
        };
        assert!(!rings());
        for _ in 0..3 {
            board.refresh(Duration::ZERO).await;
        }
        assert!(rings());
        board.hear();
        assert!(!rings() && board.is_asked());
    }

    #[test]
    fn a_refused_reload_keeps_the_settings() {
        let settings = Settings {
            per_writer: true,
            ..Settings::default()
        };
        let board = Board::new(SourceKind::Wire, settings.clone());
        let first = board.reload().last_success;
        board.reload_failed("no such file");
        assert_eq!(*board.settings(), settings);
        assert!(!board.reload().successful);
        assert_eq!(board.reload().last_success, first);
    }
}
