//! `rp bag record`: this process writes a bag in its own directory and with its own rights, from an
//! agent's stream. The messages on stderr are those of `ros2 bag record`.

mod graph_cache;
mod keys;
mod output;
mod read_ahead;
mod shortfalls;
mod signals;

use std::collections::BTreeMap;
use std::io::{self, IsTerminal as _};
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::mpsc::channel;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use anyhow::{Context as _, Result, bail};
use clap::Args;
use ros2probe::client::{Agent, Samples, Target};
use ros2probe::ros2::Dialect;
use ros2probe::ros2::name::full_name;
use ros2probe_api::recordings::FilterOptions;
use ros2probe_bag::{self, Form, Options, Storage, Writer};
use ros2probe_daemon::recording::{
    Activity, Filter, FilterError, Recorder, SampleRing, Sources, default_name, record, schema,
};
use ros2probe_message::{Library, Sources as Places};

use super::UserError;
use graph_cache::{GraphCache, locked};
use keys::{Keys, read_keys};
use output::{RecordingOutput, log, report};
use read_ahead::ReadAhead;
use signals::{Phase, listen};

/// Default size of messages that wait for the storage, in bytes, as in `ros2 bag record`.
const DEFAULT_CACHE_BYTES: u64 = 100 << 20;

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
    /// Record all topics; since Jazzy also all services
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
    /// Bytes of messages that may wait for the storage in this process. Further messages wait in
    /// the agent, and those that do not fit there are dropped, counted and reported
    #[arg(long, value_name = "BYTES", default_value_t = DEFAULT_CACHE_BYTES)]
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
    /// Set for `rp bag convert`, which ends by itself and reads no keys.
    #[arg(skip)]
    is_batch: bool,
}

/// Options of `ros2 bag record` without effect.
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

impl Record {
    /// Sets the options of `rp bag convert`: writes `capture` into `bag`, with all topics unless
    /// some are selected.
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

    pub(crate) fn run(self) -> Result<ExitCode> {
        let phase = Phase::starting();
        let (give, commands) = channel();
        listen(give.clone(), phase.clone())?;
        let dialect = self.target.dialect();
        let filter = Filter::new(self.options_from(dialect)?).map_err(|error| refused(&error))?;
        let options = self.options()?;
        let domain_id = self.target.domain()?;
        let directory = self.directory()?;
        let agent = Agent::reach_stream_measured(&self.target)?;
        let query = filter.query(domain_id, self.max_cache_size);
        let graph_cache = Arc::new(Mutex::new(GraphCache::new(&agent, domain_id)));
        // The replay continues when the stream is opened.
        let before = locked(&graph_cache).latest_snapshot();
        let mut samples = Samples::open(&agent, &query)?;
        let filter = if self.no_discovery {
            let opened = samples.opened().topics.iter();
            let there: Vec<_> = opened.map(|topic| topic.topic.clone()).collect();
            filter.restricted_to(&there)
        } else {
            filter
        };
        let sources = self.sources(&graph_cache);
        phase.begin();
        let writer = Writer::create(&directory, options)?;
        let recorder = Recorder::new(writer, filter, domain_id, before, sources);
        let mut recorder = self.begun(recorder);
        let is_live = self.target.replay.is_none();
        let live = is_live.then(|| (&agent, Arc::clone(&graph_cache)));
        let mut output = RecordingOutput::new(live);
        output.sampled(&recorder, &locked(&graph_cache).graph);
        let opened = samples.opened().topics.iter();
        recorder.declare(opened.map(|topic| (topic.topic.as_str(), topic.types.as_slice())))?;
        let keys = if self.is_batch { None } else { Keys::take() };
        match &keys {
            Some(_) => {
                log("INFO", "Press SPACE for pausing/resuming");
                read_keys(give);
            }
            None if self.is_batch => {}
            None if io::stdin().is_terminal() => {
                eprintln!("rp runs in the background. Keyboard handling disabled.");
            }
            None => eprintln!("stdin is not a terminal device. Keyboard handling disabled."),
        }
        log("INFO", "Listening for topics...");
        let state = match self.start_paused {
            true => "Waiting for recording: Press SPACE to start.",
            false => "Recording...",
        };
        log("INFO", state);
        let activity = |activity: Activity<'_>| output.update(activity);
        let (ended, broke) = if is_live {
            let most = usize::try_from(self.max_cache_size).unwrap_or(usize::MAX);
            let ahead = ReadAhead::new(most);
            std::thread::scope(|scope| {
                scope.spawn(|| ahead.read(&mut samples));
                let next = |timeout: Duration| ahead.next(timeout);
                let recorded = record(recorder, next, || !ahead.is_empty(), &commands, activity);
                ahead.close();
                recorded
            })
        } else {
            // The replay waits for the storage.
            let next = |timeout: Duration| samples.next_within(timeout);
            record(recorder, next, || false, &commands, activity)
        };
        drop(keys);
        output.finish();
        let outcome = agent.outcome().unwrap_or_default();
        let code = report(&ended, &outcome, self.target.replay.is_some());
        match broke {
            Some(error) => Err(error.into()),
            None => Ok(code),
        }
    }

    /// Returns the directory of the bag, which must not exist yet.
    fn directory(&self) -> Result<PathBuf> {
        let directory = self.output.clone().unwrap_or_else(|| default_name().into());
        if directory.exists() {
            let text = format!(
                "[ERROR] [ros2bag]: Output folder '{}' already exists.",
                directory.display()
            );
            return Err(UserError(text).into());
        }
        Ok(directory)
    }

    /// Returns the sources of facts that samples do not contain.
    fn sources<'a>(&self, graph_cache: &Arc<Mutex<GraphCache<'a>>>) -> Sources<'a> {
        let places = Places::new(
            self.definitions.clone(),
            std::env::var_os("AMENT_PREFIX_PATH").as_deref(),
            self.target.dialect(),
        );
        let library = Library::new(places);
        let (announced, graph) = (Arc::clone(graph_cache), Arc::clone(graph_cache));
        Sources {
            announced: Box::new(move |names| locked(&announced).of(names)),
            graph: Box::new(move || locked(&graph).latest_snapshot()),
            schema: Box::new(move |name, hash| schema(&library, name, hash)),
        }
    }

    /// Returns the recorder in its initial state: recording, paused, or with a ring in memory.
    fn begun<'a>(&self, mut recorder: Recorder<'a>) -> Recorder<'a> {
        if self.snapshot_mode {
            let room = usize::try_from(self.max_cache_size).unwrap_or(usize::MAX);
            recorder = recorder.with_ring(SampleRing::new(room, None));
        }
        recorder.pause(self.start_paused);
        recorder
    }

    fn options_from(&self, dialect: Dialect) -> Result<FilterOptions> {
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
            bail!("unsupported storage `{}`: use mcap", self.storage);
        }
        let format = self.unused.serialization_format.as_deref();
        if let Some(format) = format.filter(|format| !matches!(*format, "" | "cdr")) {
            bail!("unsupported serialization format `{format}`: use cdr");
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

fn refused(error: &FilterError) -> anyhow::Error {
    UserError(format!("{error}")).into()
}

/// Returns the ROS distribution of the environment; empty if it is not set.
fn installed() -> String {
    std::env::var("ROS_DISTRO").unwrap_or_default()
}

fn pair(text: &str) -> Result<(String, String), UserError> {
    let pair = text.split_once('=');
    let (key, value) = pair.ok_or_else(|| UserError("must be KEY=VALUE".to_owned()))?;
    Ok((key.to_owned(), value.to_owned()))
}
