//! Writes the history on disk: each minute the rows of topics and processes, the state of the
//! robot as the page shows it, and the events.
//!
//! A thread of its own writes, so that a slow storage delays nothing else.

use std::collections::{BTreeMap, HashMap};
use std::io;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::thread::JoinHandle;
use std::time::{Duration, Instant, SystemTime};

use ros2probe_history::{
    Block, Kind, ProcessName, ProcessRow, Series, Store, Tier, TopicName, TopicRow,
};
use ros2probe_model::facts::model_time::ModelTime;
use ros2probe_model::measure::history::{Past, Row, Second};
use serde::Serialize;

use super::super::body_stream::write_line;
use super::super::events::event;
use super::super::processes::{MAX_PROCESSES, local};
use super::super::{Context, live};
use super::answers;
use crate::events::Reader;
use crate::state::{END_TIMEOUT, join_until};
use crate::surface::process::{Usage, script};

/// Time between two readings of the processes.
const PROCESS_READ_INTERVAL: Duration = Duration::from_secs(1);
/// Number of readings after which the events are read, and after which everything is written.
const PROCESS_READS_PER_EVENT_WRITE: u32 = 10;
const PROCESS_READS_PER_WRITE: u32 = 60;
/// Time within which the working thread publishes a requested state, unless the machine is busy.
const PUBLICATION_TIMEOUT: Duration = Duration::from_secs(2);
/// Number of these times after which an old state is written.
const MAX_PUBLICATION_TIMEOUTS: u32 = 10;
/// Gap between two seconds that is a step of the clock.
const CLOCK_STEP_SECONDS: u32 = 600;
/// Number of events read at once.
const EVENT_BATCH: usize = 512;
/// Maximum length of the events of a minute, in bytes.
const MAX_EVENT_BYTES: usize = 4 << 20;

/// The writing thread. It ends when this is dropped.
#[derive(Debug)]
pub struct HistoryWriter {
    end: Sender<()>,
    thread: JoinHandle<()>,
}

/// What one minute brings.
struct Minute {
    context: Context,
    /// Unix time up to which rows are written.
    written: u32,
    /// The same as model time, which steps of the clock do not change.
    written_end: ModelTime,
    /// Usage of each process at the last reading.
    usage: HashMap<u32, LastUsage>,
    processes: BTreeMap<ProcessName, Vec<ProcessRow>>,
    events: EventLines,
    /// Number of the last event.
    place: u64,
    is_failing: bool,
}

/// Events as lines of JSON.
#[derive(Debug, Default)]
struct EventLines(Vec<u8>);

/// Usage of a process at the last reading.
struct LastUsage {
    name: ProcessName,
    start_ticks: Option<u64>,
    cpu_seconds: f64,
    at: Instant,
}

impl HistoryWriter {
    /// Starts the thread. Returns `None` if no history is kept on disk.
    ///
    /// # Errors
    ///
    /// Fails if the thread cannot be started.
    pub fn start(context: Context) -> io::Result<Option<Self>> {
        if !context.disk_history.is_kept() {
            return Ok(None);
        }
        let (end, ended) = channel();
        let thread = std::thread::Builder::new().name("history".to_owned());
        let thread = thread.spawn(move || Minute::new(context).write_until(&ended))?;
        Ok(Some(Self { end, thread }))
    }

    /// Writes the rest, and waits until it is written.
    pub fn finish(self) {
        let Self { end, thread } = self;
        drop(end);
        if !join_until(thread, Instant::now() + END_TIMEOUT) {
            tracing::error!(
                "the file system does not answer: the last minute is not in the history"
            );
        }
    }
}

impl Minute {
    fn new(context: Context) -> Self {
        Self {
            context,
            written: 0,
            written_end: ModelTime::ZERO,
            usage: HashMap::new(),
            processes: BTreeMap::new(),
            events: EventLines::default(),
            place: 0,
            is_failing: false,
        }
    }

    fn write_until(mut self, ended: &Receiver<()>) {
        if !self.context.disk_history.open() {
            return;
        }
        let mut readings = 0;
        while let Err(RecvTimeoutError::Timeout) = ended.recv_timeout(PROCESS_READ_INTERVAL) {
            readings += 1;
            self.read_processes();
            if readings % PROCESS_READS_PER_EVENT_WRITE == 0 {
                self.read_events();
            }
            if readings % PROCESS_READS_PER_WRITE == 0 {
                if !self.wait_for_publication(ended) {
                    break;
                }
                self.write();
            }
        }
        self.read_processes();
        self.read_events();
        self.write();
    }

    /// Waits until the working thread has published, which it does for readers only. Returns false
    /// if the agent ends.
    fn wait_for_publication(&self, ended: &Receiver<()>) -> bool {
        let latest = &self.context.latest;
        let before = latest.past();
        for _ in 0..MAX_PUBLICATION_TIMEOUTS {
            let _ = latest.state();
            if ended.recv_timeout(PUBLICATION_TIMEOUT) != Err(RecvTimeoutError::Timeout) {
                return false;
            }
            if !Arc::ptr_eq(&before, &latest.past()) {
                break;
            }
        }
        true
    }

    /// Reads the new events.
    fn read_events(&mut self) {
        let log = &self.context.events;
        loop {
            let batch = log.read(self.place, EVENT_BATCH);
            let mut lagged = batch.lagged;
            let is_last = batch.records.is_empty();
            for record in &batch.records {
                let is_kept = self.events.add(&event(log, record));
                lagged += u64::from(!is_kept);
            }
            log.count_overwritten(Reader::History, lagged);
            self.place = batch.last;
            if is_last {
                return;
            }
        }
    }

    fn read_processes(&mut self) {
        let state = self.context.latest.own_state();
        let (now, at) = (Instant::now(), unix_time());
        let mut left = std::mem::take(&mut self.usage);
        for (id, name) in local(state.known()).into_iter().take(MAX_PROCESSES) {
            let Some(usage) = Usage::read(id) else {
                continue;
            };
            let before = left.remove(&id);
            let before = before.filter(|before| before.start_ticks == usage.start_ticks);
            let name = match &before {
                Some(before) => before.name.clone(),
                None => ProcessName {
                    id,
                    name: script(id)
                        .or_else(|| name.map(|name| name.to_string()))
                        .unwrap_or(usage.name),
                },
            };
            if let Some(before) = before {
                let cpu = Duration::try_from_secs_f64(usage.cpu_seconds - before.cpu_seconds);
                let row = ProcessRow {
                    at,
                    seconds: saturated(now.duration_since(before.at).as_secs_f64().round() as u64),
                    cpu_ms: saturated(cpu.unwrap_or_default().as_millis() as u64),
                    memory_kib: usage.resident_bytes >> 10,
                };
                self.processes.entry(name.clone()).or_default().push(row);
            }
            let last = LastUsage {
                name,
                start_ticks: usage.start_ticks,
                cpu_seconds: usage.cpu_seconds,
                at: now,
            };
            self.usage.insert(id, last);
        }
    }

    /// Writes everything since the last time. After a failure it is dropped and counted.
    fn write(&mut self) {
        let history = Arc::clone(&self.context.disk_history);
        let Some(store) = history.store() else {
            return;
        };
        let (past, state) = (self.context.latest.past(), self.context.latest.state());
        let last = past.seconds().last();
        let now = last.map_or_else(unix_time, |last| seconds(last.at));
        // A source that went back has begun again.
        let is_later = last.is_some_and(|last| last.end >= self.written_end);
        let fresh = past.since(match is_later {
            true => self.written_end,
            false => ModelTime::ZERO,
        });
        let begin = self.begin(fresh, now);
        let mut blocks = vec![Block::of_topics(begin, now, &topics(&past, fresh))];
        let processes = std::mem::take(&mut self.processes).into_iter();
        let processes: Vec<_> = processes.map(|(of, rows)| Series { of, rows }).collect();
        if !processes.is_empty() {
            blocks.push(Block::of_processes(begin, now, &processes));
        }
        let text = |kind, content| Block {
            kind,
            begin,
            end: now,
            content,
        };
        blocks.push(text(Kind::State, live::initial_lines(&self.context)));
        let EventLines(events) = std::mem::take(&mut self.events);
        if !events.is_empty() {
            blocks.push(text(Kind::Events, events));
        }
        // Without a published second, those until now are written next time.
        if let Some(last) = last {
            (self.written, self.written_end) = (now, last.end);
        }
        let written = append(store, blocks, now).and_then(|()| {
            let answers = answers::of_state(&self.context, &state, store.document_room());
            store.append_documents(begin, now, answers)
        });
        history.count(&written);
        let failed_before = std::mem::replace(&mut self.is_failing, written.is_err());
        match written {
            Ok(()) if failed_before => tracing::info!("the history is written again"),
            Err(error) if !failed_before => {
                tracing::warn!(%error, "cannot write the history: a part of this minute is missing in it");
            }
            Ok(()) | Err(_) => {}
        }
    }

    /// Returns the time after which rows are not written yet: the `fresh` ones.
    fn begin(&self, fresh: &[Arc<Second>], now: u32) -> u32 {
        let first = fresh.first();
        let first = first.map_or(now, |first| seconds(first.at).saturating_sub(1));
        // After a step back of the clock, rows of later times are written already.
        let last = Some(self.written).filter(|written| *written <= now);
        let begin = last.unwrap_or(0).max(first);
        let all = fresh.iter().map(|second| seconds(second.at));
        after_gap(begin, all.filter(|at| *at > begin))
    }
}

impl EventLines {
    /// Adds an event. Returns whether it had room.
    fn add(&mut self, event: &impl Serialize) -> bool {
        let before = self.0.len();
        write_line(&mut self.0, event);
        let has_room = self.0.len() <= MAX_EVENT_BYTES;
        if !has_room {
            self.0.truncate(before);
        }
        has_room
    }
}

fn append(store: &Store, blocks: Vec<Block>, now: u32) -> io::Result<()> {
    store.append(Tier::Seconds, &blocks)?;
    // A merge and documents need memory, too.
    drop(blocks);
    store.condense(now)
}

/// Returns the time after which new seconds follow each other. A block across a step of the clock
/// would cover the years in between.
fn after_gap(begin: u32, new: impl Iterator<Item = u32>) -> u32 {
    let (mut begin, mut last) = (begin, begin);
    for at in new {
        if at.saturating_sub(last) > CLOCK_STEP_SECONDS {
            begin = at.saturating_sub(1);
        }
        last = at;
    }
    begin
}

/// Returns the rows of each topic in these seconds.
fn topics(past: &Past, fresh: &[Arc<Second>]) -> Vec<Series<TopicName, TopicRow>> {
    let mut rows: HashMap<u32, Vec<TopicRow>> = HashMap::new();
    for second in fresh {
        for row in second.rows() {
            let rows = rows.entry(row.topic()).or_default();
            rows.push(topic_row(seconds(second.at), row));
        }
    }
    let series = past.topics().filter_map(|(domain_id, name, id)| {
        let of = TopicName {
            domain_id: domain_id.0,
            dds_name: name.to_string(),
        };
        Some(Series {
            of,
            rows: rows.remove(&id)?,
        })
    });
    series.collect()
}

/// Returns a row of one second as it is stored.
pub(super) fn topic_row(at: u32, row: &Row) -> TopicRow {
    TopicRow {
        at,
        seconds: 1,
        messages: row.messages,
        lost: row.lost,
        bytes: row.bytes as u64,
        latency: row.latency(),
        interarrival: row.interarrival(),
    }
}

/// Returns a time in whole seconds.
pub(super) fn seconds(time: ros2probe_wire::Timestamp) -> u32 {
    saturated(time.whole_seconds())
}

fn unix_time() -> u32 {
    let since = SystemTime::UNIX_EPOCH.elapsed().unwrap_or_default();
    saturated(since.as_secs())
}

fn saturated(value: u64) -> u32 {
    value.try_into().unwrap_or(u32::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_block_begins_after_the_last_step_of_the_clock() {
        let year = 1_790_000_000;
        assert_eq!(after_gap(100, 101..=160), 100);
        assert_eq!(after_gap(100, [103, 700].into_iter()), 100);
        assert_eq!(after_gap(100, year..year + 60), year - 1);
        assert_eq!(after_gap(100, (101..130).chain(year..year + 30)), year - 1);
        assert_eq!(after_gap(100, std::iter::empty()), 100);
    }

    #[test]
    fn events_beyond_the_cap_of_a_minute_are_left_out() {
        let mut lines = EventLines::default();
        let event = "e".repeat(60_000);
        let kept = (0..100).filter(|_| lines.add(&event)).count();
        assert!(lines.0.len() <= MAX_EVENT_BYTES && kept * 60_003 == lines.0.len());
        // A shorter one still has room.
        assert!(kept < 100 && lines.add(&"short"));
    }
}
