//! What a recording prints on stderr, as the original does: its state, its files and its end.

use std::collections::BTreeSet;
use std::io::{self, IsTerminal as _};
use std::process::ExitCode;
use std::sync::{Arc, Mutex};
use std::time::{Instant, SystemTime, UNIX_EPOCH};

use anyhow::anyhow;
use ros2probe::client::Outcome;
use ros2probe_daemon::escape::visible;
use ros2probe_daemon::recording::{
    Activity, Finished, GraphSnapshot, Recorder, shortfalls, unobserved_lines,
};

use super::super::notes::{SILENT, is_sampled, sampled};
use super::graph_cache::{GraphCache, locked};

/// What ends a capture's recording that lacks something the capture holds.
const INCOMPLETE: u8 = 3;

/// What was said of a recording so far.
pub(super) struct RecordingOutput<'a> {
    /// Asked why topics are silent, where that can be answered.
    graph_cache: Option<Arc<Mutex<GraphCache<'a>>>>,
    begun: Instant,
    sampled: BTreeSet<String>,
    topics: usize,
    files: usize,
    paused: Option<bool>,
    progress: bool,
    /// Tenths of a file.
    compressing: u64,
}

impl<'a> RecordingOutput<'a> {
    pub(super) fn new(graph_cache: Option<Arc<Mutex<GraphCache<'a>>>>) -> Self {
        Self {
            graph_cache,
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
                    "Completing the bag; Ctrl-C again to skip what takes long",
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

    /// Names the topics that are sampled from the start.
    pub(super) fn sampled(&mut self, recorder: &Recorder<'_>, graph: &GraphSnapshot) {
        let topics = graph.topics.iter();
        let topics = topics.filter(|topic| is_sampled(topic) && recorder.takes(topic));
        self.print_sampled(topics.map(|topic| topic.name.clone()).collect());
    }

    fn print_sampled(&mut self, topics: Vec<String>) {
        if let Some(text) = sampled(&topics, "not every message will be in the bag") {
            self.clear();
            log("WARN", &text);
        }
        self.sampled.extend(topics);
    }

    /// After a while, once: why nothing came of topics.
    fn explain(&mut self, recorder: &Recorder<'_>) {
        if self.begun.elapsed() < SILENT {
            return;
        }
        let Some(graph_cache) = self.graph_cache.take() else {
            return;
        };
        let graph = locked(&graph_cache).latest_snapshot();
        let mut lines = unobserved_lines(&recorder.unobserved(&graph));
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
        self.explain(recorder);
        let new = recorder.sampled().difference(&self.sampled);
        self.print_sampled(new.cloned().collect());
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

/// What is in the bag and what is not. 1 where the storage refused something or nothing of a capture
/// could be read, [`INCOMPLETE`] where something of a capture is not in the bag.
pub(super) fn report(ended: &Finished, outcome: &Outcome, is_replay: bool) -> ExitCode {
    for line in shortfalls(&ended.report) {
        log("WARN", &line);
    }
    if let Some(error) = &ended.error {
        // With its causes.
        let error = format!("{:#}", anyhow!(error.to_string()));
        log(
            "ERROR",
            &format!("{error}: the recording ends here, what came before is whole"),
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
        let text = "Recording stopped; not everything that was sent is in the bag, see above";
        log("WARN", text);
    }
    let is_unreadable = outcome.fault.is_some() && ended.report.messages == 0;
    if ended.error.is_some() || is_unreadable {
        ExitCode::FAILURE
    } else if is_replay && !is_complete {
        ExitCode::from(INCOMPLETE)
    } else {
        ExitCode::SUCCESS
    }
}

/// A line as the original logs it.
pub(super) fn log(level: &str, text: &str) {
    let now = SystemTime::now().duration_since(UNIX_EPOCH);
    let now = now.unwrap_or_default();
    let (seconds, nanoseconds) = (now.as_secs(), now.subsec_nanos());
    let text = visible(text);
    eprintln!("[{level}] [{seconds}.{nanoseconds:09}] [rosbag2_recorder]: {text}");
}
