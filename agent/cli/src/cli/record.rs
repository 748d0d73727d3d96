//! `rp bag record`: a bag written by this process, with its rights and where it was started, out of
//! what an agent gives. Says on stderr what the original says there.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::io::{self, IsTerminal as _, Read as _};
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::atomic::{AtomicU8, Ordering};
use std::sync::mpsc::{Sender, channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use anyhow::{Context as _, Result, anyhow, bail};
use clap::Args;
use ros2probe::client::{Agent, Outcome, Samples, Target};
use ros2probe::ros2::Dialect;
use ros2probe::ros2::name::full_name;
use ros2probe_api::participants::ParticipantList;
use ros2probe_api::topics::TopicList;
use ros2probe_bag::{self, Form, Options, Storage, Writer};
use ros2probe_daemon::escape::visible;
use ros2probe_daemon::recording::{
    Activity, Command, DiscoveredTopic, Filter, FilterOptions, Finished, GraphSnapshot, Recorder,
    SampleRing, Sources, by_name, default_name, record, schema, unobserved_lines,
};
use ros2probe_message::{Library, Sources as Places};
use rustix::termios::{LocalModes, OptionalActions, Termios, tcgetattr, tcsetattr};
use tokio::signal::unix::{SignalKind, signal};

use super::UserError;
use super::interrupt::INTERRUPTED;
use super::notes::{SILENT, is_sampled, sampled, samples_shared_memory};

/// Room for messages that wait for the storage, as the original's cache.
const CACHE: u64 = 100 << 20;
const SPACE: u8 = b' ';
/// What ends a capture's recording that lacks something the capture holds.
const INCOMPLETE: u8 = 3;
/// How long an answer about announcements is waited for, and how old it may be.
const GRAPH_TIMEOUT: Duration = Duration::from_secs(2);
const GRAPH_AGE: Duration = Duration::from_secs(1);

/// `rp bag record`.
#[derive(Args, Debug)]
#[command(after_help = "\
A recording is invisible on the network: messages are copied, not subscribed to. Messages that were
incomplete on the wire are missing in the bag; they are reported at the end and in its metadata.
Space pauses and resumes. With --snapshot-mode, SIGUSR1 writes the messages in memory. Ctrl-C ends the
recording; a second one skips slow steps (messages in transit, compression), a third one ends at once.
Exit code: 0; 1 if the storage fails or is full; with --replay, 3 if something is missing in the bag.

Examples:
  rp bag record -a                                      every topic
  rp bag record /tf /tf_static -e '^/camera/' -o drive  some topics
  rp bag record -a --replay robot.pcap -o drive         from a capture")]
pub(crate) struct Record {
    /// Topics to record
    #[arg(value_name = "TOPIC")]
    positional: Vec<String>,
    /// Topics to record
    #[arg(long, value_name = "TOPIC", num_args = 1..)]
    topics: Vec<String>,
    /// Services whose events to record
    #[arg(long, value_name = "SERVICE", num_args = 1..)]
    services: Vec<String>,
    /// Record all topics of these types
    #[arg(long, value_name = "TYPE", num_args = 1..)]
    topic_types: Vec<String>,
    /// Record all topics; from Jazzy on all services, too
    #[arg(long, short = 'a')]
    all: bool,
    /// Record all topics
    #[arg(long)]
    all_topics: bool,
    /// Record the events of all services
    #[arg(long)]
    all_services: bool,
    /// Record topics and services whose name matches this regular expression
    #[arg(long, short = 'e')]
    regex: Option<String>,
    /// Exclude topics and services whose name matches this regular expression
    #[arg(long, short = 'x', visible_alias = "exclude", value_name = "REGEX")]
    exclude_regex: Option<String>,
    /// Exclude these topics
    #[arg(long, value_name = "TOPIC", num_args = 1..)]
    exclude_topics: Vec<String>,
    /// Exclude topics of these types
    #[arg(long, value_name = "TYPE", num_args = 1..)]
    exclude_topic_types: Vec<String>,
    /// Exclude the events of these services
    #[arg(long, value_name = "SERVICE", num_args = 1..)]
    exclude_services: Vec<String>,
    /// Declare topics without publishers in the bag
    #[arg(long)]
    include_unpublished_topics: bool,
    /// Record hidden topics as well
    #[arg(long)]
    include_hidden_topics: bool,
    /// Exclude topics without subscriptions
    #[arg(long)]
    ignore_leaf_topics: bool,
    /// Record only topics that exist at the start
    #[arg(long)]
    no_discovery: bool,
    /// Directory to create [default: ./rosbag2_TIME]
    #[arg(long, short = 'o', value_name = "DIR")]
    output: Option<PathBuf>,
    /// Storage of the bag: mcap
    #[arg(long, short = 's', default_value = "mcap")]
    storage: String,
    /// Split when a file reaches this many bytes; 0 = never
    #[arg(long, short = 'b', value_name = "BYTES", default_value_t = 0)]
    max_bag_size: u64,
    /// Split when a file reaches this many seconds; 0 = never
    #[arg(long, short = 'd', value_name = "SECONDS", default_value_t = 0)]
    max_bag_duration: u64,
    /// Bytes of messages that may wait for the storage, limited by the agent; messages that do not
    /// fit are dropped, counted and reported
    #[arg(long, value_name = "BYTES", default_value_t = CACHE)]
    max_cache_size: u64,
    /// Compress files after they are complete: file
    #[arg(long, value_name = "none|file", default_value = "none")]
    compression_mode: String,
    /// Format of the compression: zstd or lz4
    #[arg(long, value_name = "FORMAT", default_value = "")]
    compression_format: String,
    /// Preset for MCAP files: none, fastwrite, zstd_fast or zstd_small
    #[arg(long, value_name = "PRESET", default_value = "")]
    storage_preset_profile: String,
    /// YAML file with storage settings, which override the preset
    #[arg(long, value_name = "FILE")]
    storage_config_file: Option<PathBuf>,
    /// Entry to add to metadata.yaml
    #[arg(long, value_name = "KEY=VALUE", num_args = 1.., value_parser = pair)]
    custom_data: Vec<(String, String)>,
    /// Keep the last messages in memory, up to --max-cache-size, and write them on SIGUSR1
    #[arg(long)]
    snapshot_mode: bool,
    /// Start paused
    #[arg(long)]
    start_paused: bool,
    /// Directory with message definitions; may be repeated
    #[arg(long, value_name = "DIR")]
    definitions: Vec<PathBuf>,
    #[command(flatten)]
    unused: Unused,
    #[command(flatten)]
    target: Target,
    /// Set for `rp bag convert`, which ends by itself and needs no keys.
    #[arg(skip)]
    is_batch: bool,
}

/// Options of the original that change nothing here.
#[derive(Args, Debug)]
struct Unused {
    /// Accepted without effect, as are other options of subscriptions and threads
    #[arg(long, short = 'p', value_name = "MS")]
    polling_interval: Option<String>,
    #[arg(long, hide = true)]
    qos_profile_overrides_path: Option<String>,
    #[arg(long, short = 'f', hide = true)]
    serialization_format: Option<String>,
    #[arg(long, hide = true)]
    use_sim_time: bool,
    #[arg(long, hide = true)]
    node_name: Option<String>,
    #[arg(long, hide = true)]
    log_level: Option<String>,
    #[arg(long, hide = true)]
    compression_queue_size: Option<String>,
    #[arg(long, hide = true)]
    compression_threads: Option<String>,
    #[arg(long, hide = true)]
    compression_threads_priority: Option<String>,
}

/// Standard input without lines and echo, until it is dropped.
struct Keys(Termios);

/// How far a recording is, for the thread that hears signals.
#[derive(Clone)]
struct Phase(Arc<AtomicU8>);

/// What an agent says of topics, asked for all of them at once.
struct GraphCache<'a> {
    agent: &'a Agent,
    domain_id: u32,
    known: HashMap<String, DiscoveredTopic>,
    graph: GraphSnapshot,
    at: Option<Instant>,
}

impl Record {
    /// As `rp bag convert` means it: this capture into this bag, all topics unless some are chosen.
    pub(crate) fn of_capture(mut self, capture: PathBuf, bag: PathBuf) -> Self {
        self.all |= self.positional.is_empty()
            && self.topics.is_empty()
            && self.services.is_empty()
            && self.topic_types.is_empty()
            && self.regex.is_none()
            && !self.all_topics
            && !self.all_services;
        (self.target.host, self.target.socket) = (None, None);
        self.target.replay = Some(capture);
        self.output = Some(bag);
        self.is_batch = true;
        self
    }

    pub(crate) fn ask(self) -> Result<ExitCode> {
        let phase = Phase::starting();
        let (give, commands) = channel();
        listen(give.clone(), phase.clone())?;
        let dialect = self.target.dialect();
        let filter = Filter::new(self.asked(dialect)?).map_err(|error| refused(&error))?;
        let options = self.options()?;
        let domain_id = self.target.domain()?;
        let directory = self.output.clone().unwrap_or_else(|| default_name().into());
        if directory.exists() {
            return Err(UserError(format!(
                "[ERROR] [ros2bag]: Output folder '{}' already exists.",
                directory.display()
            ))
            .into());
        }
        let agent = Agent::reach_stream_measured(&self.target)?;
        let query = filter.query(domain_id, self.max_cache_size);
        let graph_cache = Arc::new(Mutex::new(GraphCache::new(&agent, domain_id)));
        // A replay goes on with the stream.
        let before = locked(&graph_cache).latest_snapshot();
        let mut samples = Samples::open(&agent, &query)?;
        let filter = if self.no_discovery {
            let opened = samples.opened().topics.iter();
            let there: Vec<_> = opened.map(|topic| topic.topic.clone()).collect();
            filter.only(&there)
        } else {
            filter
        };
        let places = Places::new(
            self.definitions.clone(),
            std::env::var_os("AMENT_PREFIX_PATH").as_deref(),
            dialect,
        );
        let library = Library::new(places);
        let (asked, seen) = (Arc::clone(&graph_cache), Arc::clone(&graph_cache));
        let sources = Sources {
            announced: Box::new(move |names| locked(&asked).of(names)),
            graph: Box::new(move || locked(&seen).latest_snapshot()),
            schema: Box::new(move |name, hash| schema(&library, name, hash)),
        };
        phase.begin();
        let writer = Writer::create(&directory, options)?;
        let mut recorder = Recorder::new(writer, filter, domain_id, before, sources);
        if self.snapshot_mode {
            let room = usize::try_from(self.max_cache_size).unwrap_or(usize::MAX);
            recorder = recorder.waiting_in(SampleRing::new(room, None));
        }
        recorder.pause(self.start_paused);
        let is_live = self.target.replay.is_none();
        let mut output = RecordingOutput::new(is_live.then(|| Arc::clone(&graph_cache)));
        if is_live && samples_shared_memory(&agent) {
            output.sampled(&recorder, &locked(&graph_cache).graph);
        }
        let opened = samples.opened().topics.iter();
        recorder.declare(opened.filter_map(|topic| {
            let message_type = topic.types.first()?;
            Some((topic.topic.as_str(), message_type.as_str()))
        }))?;
        let keys = if self.is_batch { None } else { Keys::take() };
        match &keys {
            Some(_) => {
                log("INFO", "Press SPACE for pausing/resuming");
                read_keys(give);
            }
            None if self.is_batch => {}
            None => eprintln!("stdin is not a terminal device. Keyboard handling disabled."),
        }
        log("INFO", "Listening for topics...");
        let paused = "Waiting for recording: Press SPACE to start.";
        log(
            "INFO",
            if self.start_paused {
                paused
            } else {
                "Recording..."
            },
        );
        let next = |timeout: Duration| samples.next_within(timeout);
        let (ended, broke) = record(recorder, next, &commands, |going| output.update(going));
        drop(keys);
        output.finish();
        let outcome = agent.outcome().unwrap_or_default();
        let code = report(&ended, &outcome, self.target.replay.is_some());
        match broke {
            Some(error) => Err(error.into()),
            None => Ok(code),
        }
    }

    fn asked(&self, dialect: Dialect) -> Result<FilterOptions> {
        let full = |names: &[String]| -> Result<Vec<String>> {
            let names = names.iter().map(|name| full_name(name));
            let names: Result<_, _> = names.collect();
            names.map_err(|refused| UserError(refused.0).into())
        };
        let mut topics = full(&self.positional)?;
        topics.extend(full(&self.topics)?);
        Ok(FilterOptions {
            topics,
            all_topics: self.all || self.all_topics,
            topic_types: self.topic_types.clone(),
            services: full(&self.services)?,
            all_services: self.all_services || (self.all && dialect > Dialect::Humble),
            regex: self.regex.clone(),
            exclude_regex: self.exclude_regex.clone(),
            exclude_topics: full(&self.exclude_topics)?,
            exclude_topic_types: self.exclude_topic_types.clone(),
            exclude_services: full(&self.exclude_services)?,
            include_hidden_topics: self.include_hidden_topics,
            include_unpublished_topics: self.include_unpublished_topics,
            ignore_leaf_topics: self.ignore_leaf_topics,
        })
    }

    fn options(&self) -> Result<Options> {
        if self.storage != "mcap" {
            bail!(
                "the storage `{}` is not written here: mcap is",
                self.storage
            );
        }
        let format = self.unused.serialization_format.as_deref();
        if let Some(format) = format.filter(|format| !matches!(*format, "" | "cdr")) {
            bail!("the serialization format `{format}` is not written here: cdr is");
        }
        let mut storage = Storage::preset(&self.storage_preset_profile)?;
        if let Some(path) = &self.storage_config_file {
            let text = ros2probe_daemon::file::read_text(path, 1 << 20);
            let text = text.with_context(|| format!("cannot read {}", path.display()))?;
            storage = storage.overlaid(&text)?;
        }
        let distro = self.target.distro.map(Dialect::name);
        let seconds = Some(self.max_bag_duration).filter(|seconds| *seconds > 0);
        let (mode, format) = (&self.compression_mode, &self.compression_format);
        Ok(Options {
            form: distro.map_or_else(Form::default, Form::of),
            ros_distro: distro.map_or_else(installed, str::to_owned),
            storage,
            file_compression: ros2probe_bag::options::file_compression(mode, format)?,
            max_file_bytes: ros2probe_bag::options::max_file_bytes(self.max_bag_size)?,
            max_index_bytes: None,
            max_file_duration: seconds.map(Duration::from_secs),
            custom_data: self.custom_data.iter().cloned().collect::<BTreeMap<_, _>>(),
        })
    }
}

impl Keys {
    fn take() -> Option<Self> {
        let stdin = io::stdin();
        if !stdin.is_terminal() {
            return None;
        }
        let before = tcgetattr(&stdin).ok()?;
        let mut now = before.clone();
        now.local_modes
            .remove(LocalModes::ICANON | LocalModes::ECHO);
        tcsetattr(&stdin, OptionalActions::Now, &now).ok()?;
        Some(Self(before))
    }
}

impl Drop for Keys {
    fn drop(&mut self) {
        // Nobody could be told that it failed.
        let _ = tcsetattr(io::stdin(), OptionalActions::Now, &self.0);
    }
}

/// What was said of a recording so far.
struct RecordingOutput<'a> {
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
    fn new(graph_cache: Option<Arc<Mutex<GraphCache<'a>>>>) -> Self {
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

    fn update(&mut self, going: Activity<'_>) {
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
    fn sampled(&mut self, recorder: &Recorder<'_>, graph: &GraphSnapshot) {
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

    fn finish(&self) {
        self.clear();
    }
}

/// What is in the bag and what is not. 1 where the storage refused something or nothing of a capture
/// could be read, [`INCOMPLETE`] where something of a capture is not in the bag.
fn report(ended: &Finished, outcome: &Outcome, is_replay: bool) -> ExitCode {
    for line in ended.report.shortfalls() {
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

fn refused(error: &ros2probe_daemon::recording::FilterError) -> anyhow::Error {
    UserError(format!("{error}")).into()
}

impl Phase {
    const STARTING: u8 = 0;
    const BEGUN: u8 = 1;
    const CANCELLED: u8 = 2;

    fn starting() -> Self {
        Self(Arc::new(AtomicU8::new(Self::STARTING)))
    }

    /// From now on there is a bag, which a signal completes.
    fn begin(&self) {
        if !self.turn(Self::BEGUN) {
            // The process is about to end.
            loop {
                std::thread::park();
            }
        }
    }

    /// Whether nothing was begun yet, and now never will be.
    fn cancel(&self) -> bool {
        self.turn(Self::CANCELLED)
    }

    fn turn(&self, into: u8) -> bool {
        let turned =
            self.0
                .compare_exchange(Self::STARTING, into, Ordering::AcqRel, Ordering::Acquire);
        turned.is_ok()
    }
}

impl<'a> GraphCache<'a> {
    fn new(agent: &'a Agent, domain_id: u32) -> Self {
        Self {
            agent,
            domain_id,
            known: HashMap::new(),
            graph: GraphSnapshot::default(),
            at: None,
        }
    }

    /// What was known last, where the agent does not answer any more.
    fn of(&mut self, names: &[String]) -> Vec<DiscoveredTopic> {
        let is_old = self.at.is_none_or(|at| at.elapsed() > GRAPH_AGE);
        if is_old || names.iter().any(|name| !self.known.contains_key(name)) {
            self.ask();
        }
        let known = names.iter().map(|name| self.known.get(name).cloned());
        known.map(Option::unwrap_or_default).collect()
    }

    fn latest_snapshot(&mut self) -> GraphSnapshot {
        self.ask();
        self.graph.clone()
    }

    fn ask(&mut self) {
        let graph = self
            .agent
            .get_within::<TopicList<'_>>("/topics?hidden=true", GRAPH_TIMEOUT);
        let participants = self
            .agent
            .get_within::<ParticipantList<'_>>("/participants", GRAPH_TIMEOUT);
        let (Ok(graph), Ok(participants)) = (graph, participants) else {
            return;
        };
        self.known = by_name(&graph.topics, self.domain_id);
        self.graph = GraphSnapshot::answered(&graph.topics, participants.unknown_writers);
        self.at = Some(Instant::now());
    }
}

/// What is behind the lock is whole at any moment.
fn locked<'l, 'a>(
    graph_cache: &'l Mutex<GraphCache<'a>>,
) -> std::sync::MutexGuard<'l, GraphCache<'a>> {
    graph_cache.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Whose distribution this is, as far as the shell says.
fn installed() -> String {
    std::env::var("ROS_DISTRO").unwrap_or_default()
}

/// A line as the original logs it.
fn log(level: &str, text: &str) {
    let now = SystemTime::now().duration_since(UNIX_EPOCH);
    let now = now.unwrap_or_default();
    let (seconds, nanoseconds) = (now.as_secs(), now.subsec_nanos());
    let text = visible(text);
    eprintln!("[{level}] [{seconds}.{nanoseconds:09}] [rosbag2_recorder]: {text}");
}

fn pair(text: &str) -> Result<(String, String), String> {
    let (key, value) = text.split_once('=').ok_or("must be KEY=VALUE")?;
    Ok((key.to_owned(), value.to_owned()))
}

/// Ctrl-C and SIGTERM end the recording: the first one in order, the second one without what takes
/// long, the third one at once. SIGUSR1 writes what waits.
fn listen(give: Sender<Command>, phase: Phase) -> io::Result<()> {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_io()
        .build()?;
    let mut signals = {
        let _entered = runtime.enter();
        let kinds = [
            SignalKind::interrupt(),
            SignalKind::terminate(),
            SignalKind::user_defined1(),
        ];
        let [interrupt, terminate, user] = kinds.map(signal);
        (interrupt?, terminate?, user?)
    };
    let wait = async move {
        let mut stops = 0_u8;
        loop {
            let is_stop = tokio::select! {
                _ = signals.0.recv() => true,
                _ = signals.1.recv() => true,
                _ = signals.2.recv() => false,
            };
            stops = stops.saturating_add(u8::from(is_stop));
            let order = match stops {
                _ if !is_stop => Command::Snapshot,
                1 if phase.cancel() => {
                    log(
                        "INFO",
                        "Interrupted before the recording began; no bag was made",
                    );
                    std::process::exit(INTERRUPTED.into());
                }
                1 => Command::Stop,
                2 => Command::Hurry,
                _ => {
                    let text = "Interrupted; `rp bag reindex` makes the bag whole";
                    log("ERROR", text);
                    std::process::exit(INTERRUPTED.into());
                }
            };
            // Nobody takes orders any more when it has ended by itself.
            let _ = give.send(order);
        }
    };
    let thread = std::thread::Builder::new().name("signals".to_owned());
    thread.spawn(move || runtime.block_on(wait)).map(drop)
}

fn read_keys(give: Sender<Command>) {
    let read = move || {
        for byte in io::stdin().lock().bytes() {
            match byte {
                Ok(SPACE) => {
                    let _ = give.send(Command::Toggle);
                }
                Ok(_) => {}
                Err(_) => return,
            }
        }
    };
    let thread = std::thread::Builder::new().name("keys".to_owned());
    // Without it there are no keys, which costs a convenience.
    let _ = thread.spawn(read);
}
