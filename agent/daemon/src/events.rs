//! Log of the latest events, which are numbered, for any number of readers.
//!
//! Writers never wait for readers: they append under a lock that readers hold only to copy
//! references. Each reader keeps its own position; overwritten events are counted and reported to
//! it.
//!
//! Bursts are limited: at most `MAX_EVENTS_PER_SECOND` events of one name are kept per second, and
//! further ones are only counted. The seconds of robot events are those of the source's clock, so a
//! capture yields the same events at any speed.
//!
//! A number belongs to one run of the agent. An event id also names the run, so that a position
//! from before a restart is not mistaken for a new one.

mod record;
mod self_monitor;
mod table;
mod trigger;

use std::collections::{BTreeMap, VecDeque};
use std::fmt;
use std::pin::Pin;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant, SystemTime};

use ros2probe_wire::Timestamp;
use ros2probe_wire::time::SECOND;
use tokio::sync::Notify;

use crate::tables::KeptEvents;
pub use record::AgentEvent;
use record::Occurrence;
use ros2probe_metrics::event::EventSource;
pub use ros2probe_metrics::event::{Batch, Definition, Record, Severity, Value};
use ros2probe_model::facts::bounded::Bounded;
use ros2probe_model::facts::event::{Class, Taken};
pub use self_monitor::{DropMonitor, SourceMonitor};
pub use table::EVENTS;
pub use trigger::Trigger;

/// Maximum number of events of one name per second.
const MAX_EVENTS_PER_SECOND: u32 = 200;

/// Log of the latest events.
#[derive(Debug)]
pub struct EventLog {
    /// The run, in microseconds of its start. A replay that goes back begins another one.
    run: AtomicU64,
    started: Instant,
    log: Mutex<Log>,
    recorded: Notify,
    overwritten_unread: [AtomicU64; Reader::ALL.len()],
}

/// One run of the agent, identified by its start time in microseconds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Run(u64);

/// Reader of events.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Reader {
    /// A stream of the API.
    Stream,
    /// The exporter of log records.
    Otlp,
    /// The history on disk.
    History,
}

/// Position in the events of a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Position {
    /// After the event of this number in this run.
    After(u64),
    /// In another run, or beyond the events of this one.
    Unknown,
}

#[derive(Debug, Default)]
struct Log {
    kept: Bounded<KeptEvents, VecDeque<Arc<Entry>>>,
    /// Number of the latest event.
    last: u64,
    /// Number of the latest event of an earlier run, which no reader misses.
    before: u64,
    recorded: BTreeMap<&'static str, u64>,
    /// Counts of robot events, in seconds of the source's clock.
    robot: RateLimit,
    /// Counts of agent events, in seconds since its start.
    agent: RateLimit,
    suppressed: u64,
}

/// Counts of events within one second.
#[derive(Debug, Default)]
struct RateLimit {
    second: u64,
    recorded: BTreeMap<&'static str, u32>,
    suppressed: BTreeMap<&'static str, u64>,
}

#[derive(Debug)]
struct Entry {
    number: u64,
    time: Timestamp,
    observed: Timestamp,
    occurrence: Occurrence,
}

impl Default for EventLog {
    fn default() -> Self {
        Self::new()
    }
}

impl EventLog {
    /// Creates an empty log for a run that begins now.
    #[must_use]
    pub fn new() -> Self {
        Self {
            run: AtomicU64::new(wall_clock().0 / 1000),
            started: Instant::now(),
            log: Mutex::default(),
            recorded: Notify::new(),
            overwritten_unread: Default::default(),
        }
    }

    /// Records the model's events up to `clock`, the source's time. A call without events records
    /// the end of a burst.
    pub fn add(&self, taken: Taken, clock: Timestamp) {
        let mut log = self.log();
        let before = log.last;
        for event in taken.events {
            log.turn_robot(event.at.whole_seconds());
            log.record(event.at, Occurrence::Robot(event.kind));
        }
        for (class, count) in taken.overflow {
            log.suppress(group(class), count);
        }
        // The model reports an event up to a second after it happened.
        log.turn_robot(clock.whole_seconds().saturating_sub(1));
        let is_recorded = log.last > before;
        drop(log);
        if is_recorded {
            self.recorded.notify_waiters();
        }
    }

    /// Records suppressed events that are still pending, at the end of a source.
    pub fn settle(&self) {
        let mut log = self.log();
        log.record_suppressed();
        drop(log);
        self.recorded.notify_waiters();
    }

    /// Records an event of the agent at the current time.
    pub fn record(&self, event: AgentEvent) {
        self.record_at(event, Instant::now());
    }

    /// Returns at most `most` events after the number `after`, oldest first.
    #[must_use]
    pub fn read(&self, after: u64, most: usize) -> Batch {
        let log = self.log();
        let before_first = log.last - log.kept.len() as u64;
        let after = after.max(log.before);
        let kept_after = after.clamp(before_first, log.last);
        let skip = usize::try_from(kept_after - before_first).unwrap_or(usize::MAX);
        let entries: Vec<_> = log
            .kept
            .iter()
            .skip(skip)
            .take(most)
            .map(Arc::clone)
            .collect();
        drop(log);
        Batch {
            lagged: before_first.saturating_sub(after),
            last: entries.last().map_or(kept_after, |entry| entry.number),
            records: entries.iter().map(|entry| entry.record()).collect(),
        }
    }

    /// Returns the number of the latest event; 0 before the first one.
    #[must_use]
    pub fn last(&self) -> u64 {
        self.log().last
    }

    /// Waits for an event after the number `after`.
    pub async fn wait(&self, after: u64) {
        loop {
            // The waiter is registered before the check, so that no event is missed.
            let recorded = self.recorded.notified();
            if self.last() > after {
                return;
            }
            recorded.await;
        }
    }

    /// Returns the id of the event with this number.
    #[must_use]
    pub fn id(&self, number: u64) -> String {
        format!("{}-{number}", self.number_of_run())
    }

    /// Returns the identifier of this run of the agent.
    #[must_use]
    pub fn run(&self) -> String {
        self.number_of_run().to_string()
    }

    /// Begins another run without events, for a replay that goes back. Numbers of events go on.
    pub fn begin_run(&self) {
        let mut log = self.log();
        let Run(earlier) = self.number_of_run();
        let now = (wall_clock().0 / 1000).max(earlier + 1);
        self.run.store(now, Ordering::Release);
        log.kept.clear();
        log.before = log.last;
        (log.robot, log.agent) = (RateLimit::default(), RateLimit::default());
    }

    fn number_of_run(&self) -> Run {
        Run(self.run.load(Ordering::Acquire))
    }

    /// Returns the position of an id relative to this run; `None` if the text is not an id.
    #[must_use]
    pub fn position(&self, id: &str) -> Option<Position> {
        let (run, number) = id.split_once('-')?;
        let run = Run(u64::from_str_radix(run, 16).ok()?);
        let number = number.parse().ok()?;
        let ours = run == self.number_of_run() && number <= self.last();
        Some(if ours {
            Position::After(number)
        } else {
            Position::Unknown
        })
    }

    /// Counts events that were overwritten before this reader read them.
    pub fn count_overwritten(&self, reader: Reader, count: u64) {
        if let Some(overtaken) = self.overwritten_unread.get(reader as usize) {
            overtaken.fetch_add(count, Ordering::Relaxed);
        }
    }

    /// Returns the number of recorded events by name, including zeros.
    #[must_use]
    pub fn recorded(&self) -> Vec<(&'static str, u64)> {
        let log = self.log();
        let recorded = |name: &str| log.recorded.get(name).copied().unwrap_or(0);
        EVENTS
            .iter()
            .map(|event| (event.name, recorded(event.name)))
            .collect()
    }

    /// Returns the number of events not delivered to all readers, by reason.
    #[must_use]
    pub fn dropped(&self) -> Vec<(&'static str, u64)> {
        let mut dropped = vec![("storm", self.log().suppressed)];
        let readers = Reader::ALL.iter().zip(&self.overwritten_unread);
        dropped.extend(
            readers.map(|(reader, count)| (reader.reason(), count.load(Ordering::Relaxed))),
        );
        dropped
    }

    fn record_at(&self, event: AgentEvent, now: Instant) {
        let second = now.saturating_duration_since(self.started).as_secs();
        let mut log = self.log();
        if second > log.agent.second {
            for (event, count) in log.agent.begin_second(second) {
                let suppressed = AgentEvent::Suppressed { event, count };
                log.append(wall_clock(), Occurrence::Agent(suppressed));
            }
        }
        log.record(wall_clock(), Occurrence::Agent(event));
        drop(log);
        self.recorded.notify_waiters();
    }

    /// Simulates `count` further events, which overwrite all kept ones.
    #[cfg(test)]
    pub(super) fn overwrite(&self, count: u64) {
        let mut log = self.log();
        log.kept.clear();
        log.last += count;
        drop(log);
        self.recorded.notify_waiters();
    }

    /// Locks the log. A poisoned lock is usable, since appended events are complete.
    fn log(&self) -> MutexGuard<'_, Log> {
        self.log.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The exporter of log records reads the log through this trait.
impl EventSource for EventLog {
    fn wait_after(&self, after: u64) -> Pin<Box<dyn Future<Output = ()> + '_>> {
        Box::pin(self.wait(after))
    }

    fn read_after(&self, after: u64, most: usize) -> Batch {
        let batch = self.read(after, most);
        if batch.lagged > 0 {
            self.count_overwritten(Reader::Otlp, batch.lagged);
        }
        batch
    }
}

impl Log {
    /// Advances the source's clock to `second` and records the suppressed events of the previous
    /// second. An event of the previous second counts in the current one. A larger step back means
    /// that the clock was set.
    fn turn_robot(&mut self, second: u64) {
        let current = self.robot.second;
        if second == current || second.checked_add(1) == Some(current) {
            return;
        }
        self.record_suppressed();
        self.robot.begin_second(second);
    }

    fn record_suppressed(&mut self) {
        let end = Timestamp(self.robot.second.saturating_add(1).saturating_mul(SECOND));
        for (event, count) in std::mem::take(&mut self.robot.suppressed) {
            let suppressed = AgentEvent::Suppressed { event, count };
            self.append(end, Occurrence::Agent(suppressed));
        }
    }

    fn record(&mut self, at: Timestamp, occurrence: Occurrence) {
        let name = occurrence.definition().name;
        let storm = match occurrence {
            Occurrence::Robot(_) => &mut self.robot,
            Occurrence::Agent(_) => &mut self.agent,
        };
        if storm.is_allowed(name) {
            self.append(at, occurrence);
        } else {
            self.suppressed += 1;
        }
    }

    fn suppress(&mut self, name: &'static str, count: u64) {
        *self.robot.suppressed.entry(name).or_default() += count;
        self.suppressed += count;
    }

    fn append(&mut self, at: Timestamp, occurrence: Occurrence) {
        self.last += 1;
        *self
            .recorded
            .entry(occurrence.definition().name)
            .or_default() += 1;
        self.kept.push_back(Arc::new(Entry {
            number: self.last,
            time: at,
            observed: wall_clock(),
            occurrence,
        }));
    }
}

impl RateLimit {
    /// Begins a second. Returns the suppressed events of the previous second, by name.
    fn begin_second(&mut self, second: u64) -> BTreeMap<&'static str, u64> {
        self.second = second;
        self.recorded.clear();
        std::mem::take(&mut self.suppressed)
    }

    /// Returns whether another event of this name is allowed; otherwise counts it as suppressed.
    fn is_allowed(&mut self, name: &'static str) -> bool {
        let recorded = self.recorded.entry(name).or_default();
        if *recorded >= MAX_EVENTS_PER_SECOND {
            *self.suppressed.entry(name).or_default() += 1;
            return false;
        }
        *recorded += 1;
        true
    }
}

impl Entry {
    fn record(&self) -> Record {
        Record {
            number: self.number,
            at: self.time,
            observed: self.observed,
            definition: self.occurrence.definition(),
            severity: self.occurrence.severity(),
            attributes: self.occurrence.attributes(self.time),
        }
    }
}

impl Reader {
    const ALL: [Self; 3] = [Self::Stream, Self::Otlp, Self::History];

    /// Returns the label value.
    const fn reason(self) -> &'static str {
        match self {
            Self::Stream => "stream_lagged",
            Self::Otlp => "otlp_lagged",
            Self::History => "history_lagged",
        }
    }
}

impl fmt::Display for Run {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:x}", self.0)
    }
}

/// Returns the common prefix of a class's event names.
const fn group(class: Class) -> &'static str {
    match class {
        Class::Participant => "ros2.participant.*",
        Class::Endpoint => "ros2.endpoint.*",
        Class::Node => "ros2.node.*",
        Class::Loss => "ros2.message.*",
        Class::Expectation => "ros2.topic.*",
        Class::Diagnosis => "ros2.graph.*",
        Class::Robot => "ros2.robot.*",
    }
}

fn wall_clock() -> Timestamp {
    let since = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH);
    let nanoseconds = since.unwrap_or(Duration::ZERO).as_nanos();
    Timestamp(u64::try_from(nanoseconds).unwrap_or(u64::MAX))
}

#[cfg(test)]
mod tests;
