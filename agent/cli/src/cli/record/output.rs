//! Messages of a recording on stderr, in rosbag2's format: its state, its files and its end.

use std::collections::{BTreeSet, HashMap};
use std::io::{self, IsTerminal as _};
use std::process::ExitCode;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use anyhow::anyhow;
use ros2probe::client::{Agent, Outcome};
use ros2probe_api::participants::UnknownWriter;
use ros2probe_api::recordings::FilterOptions;
use ros2probe_daemon::escape::visible;
use ros2probe_daemon::missed_announcements::{explanation, remedy_for, sentence};
use ros2probe_daemon::recording::{Activity, Finished, GraphSnapshot, Recorder};

use super::super::notes::{SILENCE_TIMEOUT, Sampling, is_sampled};
use super::graph_cache::{GraphCache, locked};
use super::shortfalls::{shortfalls, unobserved_lines};

/// Interval of requests for writers without a known topic, and of reports about them while they
/// send.
const REQUEST_INTERVAL: Duration = Duration::from_secs(2);
const REPORT_INTERVAL: Duration = Duration::from_secs(10);

/// Exit code of a conversion whose bag lacks messages of the capture.
const EXIT_INCOMPLETE: u8 = 3;

/// Prints the messages, and keeps what was printed.
pub(super) struct RecordingOutput<'a> {
    /// Source of reasons for silent topics, if available.
    graph_cache: Option<Arc<Mutex<GraphCache<'a>>>>,
    /// The agent of a live recording.
    agent: Option<&'a Agent>,
    sampling: Sampling,
    begun: Instant,
    sampled: BTreeSet<String>,
    topics: usize,
    files: usize,
    paused: Option<bool>,
    progress: bool,
    /// Compression progress of a file, in tenths.
    compressing: u64,
    unknown_writers: UnknownWriters<'a>,
}

/// Writers whose messages a recording lacks because their topics are unknown.
struct UnknownWriters<'a> {
    /// Source of the writers, if available.
    graph_cache: Option<Arc<Mutex<GraphCache<'a>>>>,
    looked: Option<Instant>,
    reported: Option<Instant>,
    /// Number of messages of each writer at the last report.
    messages: HashMap<String, u64>,
}

impl<'a> UnknownWriters<'a> {
    fn new(graph_cache: Option<Arc<Mutex<GraphCache<'a>>>>) -> Self {
        Self {
            graph_cache,
            looked: None,
            reported: None,
            messages: HashMap::new(),
        }
    }

    /// Returns the warning if it is due: first immediately, then at intervals while such writers
    /// send.
    fn warning(&mut self, options: &FilterOptions, now: Instant) -> Option<String> {
        let is_due = |at: Option<Instant>, after| at.is_none_or(|at| now - at >= after);
        if !is_due(self.looked, REQUEST_INTERVAL) {
            return None;
        }
        let graph_cache = locked(self.graph_cache.as_ref()?);
        self.looked = Some(now);
        if !may_record_more(options, |name| graph_cache.knows(name)) {
            return None;
        }
        let list = graph_cache.participants();
        drop(graph_cache);
        let writers = &list.unknown_writers;
        let is_first = self.reported.is_none();
        let count = |writer: &UnknownWriter<'_>| writer.measurement.messages;
        let sends = |writer: &&UnknownWriter<'_>| {
            let before = self.messages.get(&writer.guid);
            is_first || before.is_none_or(|before| *before < count(writer))
        };
        let sending: Vec<_> = writers.iter().filter(sends).cloned().collect();
        if sending.is_empty() || !is_due(self.reported, REPORT_INTERVAL) {
            return None;
        }
        self.reported = Some(now);
        let counts = writers
            .iter()
            .map(|writer| (writer.guid.clone(), count(writer)));
        self.messages = counts.collect();
        let remedy = explanation(remedy_for(&sending, &list.participants)?);
        Some(format!(
            "not recorded: {}: {remedy}",
            sentence(sending.len())
        ))
    }
}

/// Returns whether the recording may include topics that are not known yet.
fn may_record_more(options: &FilterOptions, is_known: impl Fn(&str) -> bool) -> bool {
    options.all_topics
        || options.all_services
        || options.regex.is_some()
        || !options.topic_types.is_empty()
        || !options.services.is_empty()
        || options.topics.iter().any(|name| !is_known(name))
}

impl<'a> RecordingOutput<'a> {
    /// Creates the output. `live` is the agent of a live recording, and the cache of its facts.
    pub(super) fn new(live: Option<(&'a Agent, Arc<Mutex<GraphCache<'a>>>)>) -> Self {
        let (agent, graph_cache) = live.unzip();
        Self {
            unknown_writers: UnknownWriters::new(graph_cache.clone()),
            graph_cache,
            agent,
            sampling: agent.map_or(Sampling::Nothing, Sampling::at),
            begun: Instant::now(),
            sampled: BTreeSet::new(),
            topics: 0,
            files: 1,
            paused: None,
            progress: io::stderr().is_terminal(),
            compressing: u64::MAX,
        }
    }

    pub(super) fn update(&mut self, going: Activity<'_>) {
        match going {
            Activity::Recording(recorder) => self.recording(recorder),
            Activity::Completing => {
                self.clear();
                log(
                    "INFO",
                    "Completing the bag; Ctrl-C again to skip slow steps",
                );
            }
            Activity::Compressing { done, of } => {
                self.clear();
                let percent = (100 * done).checked_div(of).unwrap_or(100);
                let text = format!("compressing a file of {} MB: {percent} %", of / 1_000_000);
                if self.progress {
                    eprint!("{text}");
                } else if self.compressing != percent / 10 {
                    self.compressing = percent / 10;
                    log("INFO", &text);
                }
            }
        }
    }

    /// Reports topics that are sampled from the start.
    pub(super) fn sampled(&mut self, recorder: &Recorder<'_>, graph: &GraphSnapshot) {
        let topics = graph.topics.iter();
        let topics = topics.filter(|topic| is_sampled(topic) && recorder.is_selected(topic));
        if matches!(self.sampling, Sampling::Sampled(_)) {
            self.print_sampled(topics.map(|topic| topic.name.clone()).collect());
        }
    }

    fn print_sampled(&mut self, topics: Vec<String>) {
        let consequence = "not every message will be in the bag";
        if let Some(text) = self.sampling.text(&topics, consequence) {
            self.clear();
            log("WARN", &text);
        }
        self.sampled.extend(topics);
    }

    /// Reports once, after some time, why topics are silent.
    fn print_silence_reasons(&mut self, recorder: &Recorder<'_>) {
        if self.begun.elapsed() < SILENCE_TIMEOUT {
            return;
        }
        let Some(graph_cache) = self.graph_cache.take() else {
            return;
        };
        let graph = locked(&graph_cache).latest_snapshot();
        let mut lines = unobserved_lines(&recorder.unobserved_topics(&graph));
        let is_known = |name: &&String| graph.topics.iter().any(|topic| topic.name == **name);
        let unknown = recorder
            .options()
            .topics
            .iter()
            .filter(|name| !is_known(name));
        lines.extend(unknown.map(|name| {
            format!("{name} has no known publisher; it is recorded from its first message on")
        }));
        for line in lines {
            self.clear();
            log("WARN", &line);
        }
    }

    fn recording(&mut self, recorder: &Recorder<'_>) {
        self.print_silence_reasons(recorder);
        if let Some(text) = self
            .unknown_writers
            .warning(recorder.options(), Instant::now())
        {
            self.clear();
            log("WARN", &text);
        }
        let new: Vec<_> = recorder
            .sampled()
            .difference(&self.sampled)
            .cloned()
            .collect();
        let is_known = |agent| self.sampling.is_known(agent, self.begun);
        if !new.is_empty() && self.agent.is_none_or(is_known) {
            self.print_sampled(new);
        }
        let report = recorder.report();
        if report.topics.len() > self.topics {
            self.clear();
            for name in recorder.topics().skip(self.topics) {
                log("INFO", &format!("Subscribed to topic '{name}'"));
            }
            self.topics = report.topics.len();
        }
        let (paused, files) = (recorder.is_paused(), recorder.writer().files());
        if self.paused.is_some_and(|before| before != paused) {
            self.clear();
            let text = if paused {
                "Pausing recording."
            } else {
                "Resuming recording."
            };
            log("INFO", text);
        }
        self.paused = Some(paused);
        if files > self.files {
            self.clear();
            log("INFO", &format!("Recording into file {}", files - 1));
            self.files = files;
        }
        if self.progress {
            let missing = match report.missing {
                0 => String::new(),
                missing => format!(", {missing} missing"),
            };
            let megabytes = report.bytes / 1_000_000;
            eprint!(
                "\r{} messages, {megabytes} MB{missing}\x1b[K",
                report.messages
            );
        }
    }

    fn clear(&self) {
        if self.progress {
            eprint!("\r\x1b[K");
        }
    }

    pub(super) fn finish(&self) {
        self.clear();
    }
}

/// Reports the messages in the bag and the missing ones. Returns exit code 1 if the storage failed
/// or nothing of a capture was readable, and [`EXIT_INCOMPLETE`] if messages of a capture are
/// missing.
pub(super) fn report(ended: &Finished, outcome: &Outcome, is_replay: bool) -> ExitCode {
    for line in shortfalls(&ended.report) {
        log("WARN", &line);
    }
    if let Some(error) = &ended.error {
        // This format includes the causes.
        let error = format!("{:#}", anyhow!(error.to_string()));
        log(
            "ERROR",
            &format!("{error}: the recording ends here; earlier messages are complete"),
        );
    }
    if let Some(summary) = &ended.summary {
        let (messages, directory) = (summary.messages, summary.directory.display());
        log("INFO", &format!("{messages} messages in {directory}"));
    }
    let is_whole = outcome.fault.is_none() && outcome.unsupported_packets == 0;
    let is_complete = ended.report.is_complete() && is_whole && ended.error.is_none();
    if is_complete {
        log("INFO", "Recording stopped");
    } else {
        let text = "Recording stopped; some sent messages are not in the bag, see above";
        log("WARN", text);
    }
    let is_unreadable = outcome.fault.is_some() && ended.report.messages == 0;
    if ended.error.is_some() || is_unreadable {
        ExitCode::FAILURE
    } else if is_replay && !is_complete {
        ExitCode::from(EXIT_INCOMPLETE)
    } else {
        ExitCode::SUCCESS
    }
}

/// Prints a line in rosbag2's log format.
pub(super) fn log(level: &str, text: &str) {
    let now = SystemTime::now().duration_since(UNIX_EPOCH);
    let now = now.unwrap_or_default();
    let (seconds, nanoseconds) = (now.as_secs(), now.subsec_nanos());
    let text = visible(text);
    eprintln!("[{level}] [{seconds}.{nanoseconds:09}] [rosbag2_recorder]: {text}");
}
