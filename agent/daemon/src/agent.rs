//! Lifecycle of an agent, and the composition root of live agents and replays.

use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context as _, Result};
use ros2probe_capture::live::LiveSource;
pub use ros2probe_capture::pcap::Speed;
use ros2probe_capture::reassembly::Limits;
use ros2probe_capture::system::{give_back_memory, hide_memory};
use ros2probe_message::{Dialect, Library, Sources};
use ros2probe_model::graph::discovery::Memory;
use ros2probe_model::measure::history::History;
use ros2probe_model::observe::input::Input;
use ros2probe_model::observe::observer::{self, Observer};
pub use ros2probe_wire::Expansion;
use tokio_util::sync::CancellationToken;

use crate::config::{Access, Config, ConfigError, FleetSettings, PageChoice, RetainChoice, Watch};
use crate::container;
use crate::events::EventLog;
use crate::logging::Log;
use crate::private_agent::PrivateAgent;
use crate::privilege::{self, Identity, Role, Sandbox, Unprivileged};
use crate::recording::{self, Recordings, Refusal, Snapshots};
use crate::replay_pace::Jump;
use crate::run::replay::Replay;
use crate::run::{Outputs, Restart, Run, Source};
use crate::settings_cell::Settings;
use crate::state::{StateDirectory, StateWriter};
use crate::subscriptions::{Caps, Subscriptions};
use crate::supervise::{Responder, Supervisor, Surfaces, Worker};
use crate::surface::api::reload::Reloads;
use crate::surface::api::{self, Doctor, HistoryWriter, reload};
use crate::surface::field_metrics::FieldMetrics;
use crate::surface::foxglove;
use crate::surface::http::Server;
use crate::surface::ros2_daemon::Ros2Daemon;
use crate::surface::{Exposition, Format, MetricSources};
use crate::watches::Watches;
use crate::{control, file, fleet, memory};
use ros2probe_metrics::otlp::{
    self, Endpoint, Host, Inputs, NodeLogQueue, NodeLogSink, SpanQueue, SpanSink,
};
use ros2probe_metrics::remote_write;

/// Subdirectory of samples that wait for remote write.
const REMOTE_WRITE_DIRECTORY: &str = "remote_write";

/// Default configuration file.
pub const DEFAULT_CONFIG: &str = "/etc/ros2probe/ros2probe.yaml";

/// Options of the command line.
#[derive(Debug)]
pub struct Options {
    /// Configuration file. `None` means [`DEFAULT_CONFIG`] if it exists.
    pub config: Option<PathBuf>,
    /// Configuration whose section `fleet` applies instead of the configured one.
    pub fleet: Option<PathBuf>,
    /// Capture to replay instead of observing this host.
    pub replay: Option<PathBuf>,
    /// Speed of the replay. `None` means as captured, or as fast as possible for a report.
    pub speed: Option<Speed>,
    /// Limit for the expansion of a gzipped capture.
    pub expansion: Expansion,
    /// Whether to print the metrics on stdout at the end of the capture and exit.
    pub report: bool,
    /// Topics and globs to measure in addition to the configured ones.
    pub watch: Vec<Watch>,
    /// Metrics listener instead of the configured one.
    pub metrics: Option<Listen>,
    /// API listener instead of the configured one.
    pub api: Option<Listen>,
    /// Listener for viewers instead of the configured one.
    pub foxglove: Option<Listen>,
    /// Rights of loopback clients instead of the configured ones.
    pub api_loopback: Option<Access>,
    /// The command that starts the agent for itself, if any.
    pub private: Option<PrivateAgent>,
    /// Examines this host for clients.
    pub doctor: Doctor,
}

/// Address of a listener; `None` = off.
#[derive(Clone, Copy, Debug)]
pub struct Listen(pub Option<SocketAddr>);

/// Parts of an agent.
pub struct Components<'a> {
    /// Configuration of limits, recordings and the page.
    pub config: &'a Config,
    /// Source of datagrams.
    pub source: Source,
    /// The model, with restored state if available.
    pub observer: Observer,
    /// Inputs of the metrics.
    pub sources: MetricSources,
    /// Spans of sampled messages that wait for export.
    pub spans: Arc<SpanQueue>,
    /// Messages of nodes' logs for the exporter.
    pub node_logs: Arc<NodeLogQueue>,
    /// Watched topics.
    pub watches: Arc<Watches>,
    /// Writer of the discovery state.
    pub state_writer: Option<StateWriter>,
    /// Directory of recordings. `None` means that recordings are refused.
    pub recordings: Option<PathBuf>,
    /// State directory with the receipts of delivered bags. `None` means that bags are not
    /// delivered.
    pub receipts: Option<PathBuf>,
    /// Definitions of messages.
    pub library: Arc<Library>,
    /// Time span of the figures kept for topics; zero means none.
    pub history: Duration,
    /// Makes another model for a replay that goes back. `None` means that it ends with its capture.
    pub restart: Option<Box<dyn Fn() -> Observer + Send>>,
    /// Addresses at which the page is served.
    pub addresses: Vec<SocketAddr>,
    /// Examines this host for clients.
    pub doctor: Doctor,
    /// The robots of a fleet.
    pub fleet: Option<Arc<fleet::Reader>>,
    /// Token that stops the working thread and all streams.
    pub stop: CancellationToken,
}

/// An agent that is ready to run.
pub struct AssembledAgent {
    /// Loop of the working thread.
    pub run: Run,
    /// Context of the API.
    pub context: api::Context,
    /// Reloads requested by clients.
    pub reloads: Reloads,
}

impl<'a> Components<'a> {
    /// Returns the parts of an agent that replays a capture once, and that keeps, exports and
    /// records nothing.
    #[must_use]
    pub fn of_replay(
        config: &'a Config,
        replay: Replay,
        sources: MetricSources,
        watches: Arc<Watches>,
        doctor: Doctor,
    ) -> Self {
        Self {
            config,
            source: Source::Replay(Box::new(replay)),
            observer: Observer::new(observer::Settings::default()),
            sources,
            spans: Arc::default(),
            node_logs: Arc::default(),
            watches,
            state_writer: None,
            recordings: None,
            receipts: None,
            library: Arc::new(Library::new(Sources::default())),
            history: Duration::ZERO,
            restart: None,
            addresses: Vec::new(),
            doctor,
            fleet: None,
            stop: CancellationToken::new(),
        }
    }

    /// Connects the parts. Starts only the threads of configured snapshots.
    ///
    /// # Errors
    ///
    /// Returns [`Refusal`] if a snapshot cannot be kept.
    pub fn assemble(self) -> Result<AssembledAgent, Refusal> {
        let Self {
            config, sources, ..
        } = self;
        let caps = Caps {
            subscriptions: config.limits.subscriptions,
            // The other half of `payload_bytes` is for the reassembly of samples.
            bytes: config.limits.payload_bytes / 2,
        };
        let subscriptions =
            Subscriptions::new(Arc::clone(&sources.latest), caps, self.stop.clone());
        let subscriptions = Arc::new(subscriptions);
        let library = self.library;
        let recordings = Arc::new(Recordings::new(recording::Components {
            directory: self.recordings,
            limits: config.recordings.limits,
            queue_bytes: caps.bytes / 2,
            latest: Arc::clone(&sources.latest),
            events: Arc::clone(&sources.events),
            caps: Arc::clone(&sources.limits),
            figures: Arc::clone(&sources.recordings),
            subscriptions: Arc::clone(&subscriptions),
            library: Arc::clone(&library),
            receipts: self.receipts,
        }));
        let snapshots = match Snapshots::start(&config.recordings.snapshots, &recordings) {
            // A missing disk must not prevent observation.
            Err(refusal @ Refusal::NoDirectory)
                if config
                    .recordings
                    .is_in_state_directory(&config.state_directory) =>
            {
                tracing::error!(%refusal, "snapshots are disabled");
                Snapshots::default()
            }
            started => started?,
        };
        let outputs = Outputs {
            latest: Arc::clone(&sources.latest),
            events: Arc::clone(&sources.events),
            limits: Arc::clone(&sources.limits),
            node_logs: NodeLogSink {
                queue: self.node_logs,
                exports: Arc::clone(&sources.exports),
                level: config.otlp.node_logs,
            },
            spans: SpanSink {
                queue: self.spans,
                exports: sources.exports,
                exports_late_calls: config.otlp.late_calls,
            },
            library: Arc::clone(&library),
        };
        let run = Run::new(
            self.source,
            self.observer,
            outputs,
            Arc::clone(&self.watches),
            Arc::clone(&subscriptions),
            self.stop.clone(),
        );
        let (span, topics) = (self.history, config.limits.topics);
        let new_history = move || (!span.is_zero()).then(|| History::new(span, topics));
        let restart = self
            .restart
            .map(|observer| -> Restart { Box::new(move || (observer(), new_history())) });
        let (reloader, reloads) = reload::channel();
        let context = api::Context {
            latest: sources.latest,
            events: sources.events,
            limits: sources.limits,
            recording_figures: sources.recordings,
            watches: self.watches,
            subscriptions,
            recordings,
            snapshots: Arc::new(snapshots),
            live: Arc::new(api::Live::new(config.history)),
            disk_history: sources.disk_history,
            library,
            viewers: sources.viewers,
            ros2_daemon: sources.ros2_daemon,
            page: Arc::new(api::Page::new(self.addresses)),
            doctor: self.doctor,
            fleet: self.fleet,
            reloader,
            stop: self.stop,
        };
        Ok(AssembledAgent {
            run: run
                .with_state_writer(self.state_writer)
                .with_history(new_history())
                .with_restart(restart),
            context,
            reloads,
        })
    }
}

/// Runs an agent until a signal, a failure or the end of a report.
///
/// # Errors
///
/// Returns the reason why the agent could not start or had to stop.
pub fn run(options: Options) -> Result<()> {
    let (configured, file) = match (&options.config, &options.private) {
        // The configuration of the installed agent does not apply.
        (None, Some(_)) => (Config::default(), None),
        (file, _) => configuration(file.as_deref())?,
    };
    let mut config = with_overrides(&configured, &options);
    if let Some(file) = &options.fleet {
        config.fleet = FleetSettings::load(file)?;
    }
    let log = Log::start(config.log, config.otlp.log);
    let export = export(&config)?;
    let remote_write = remote_write(&config)?;
    let mut source = open(&options, &config)?;
    source.announce(&config.capture);
    if matches!(source, Source::Live(_)) {
        for restriction in container::restrictions(&config) {
            tracing::warn!("{restriction}");
        }
    }
    for token in config.readable_tokens() {
        tracing::warn!("{token}");
    }
    let mut sources = MetricSources::new(source.kind(), Settings::new(&config));
    if !options.report {
        pause_at_incident(&source, &sources);
    }
    sources.lost_lines = log.lost_lines();
    let library = Arc::new(library());
    sources.fields = Arc::new(FieldMetrics::new(&config.extractions, Arc::clone(&library)));
    let watches = sources.watches(config.watches.clone(), options.watch);
    let watches = watches.context("the watchlist is unusable")?;
    let (server, mut control) = listeners(&config, &sources)?;
    // A replay runs as the user of the command line and accesses that user's files.
    if matches!(source, Source::Live(_)) {
        announce(privilege::become_own_user());
        // Another process of the same user could read payloads, tokens and the kernel's maps.
        if let Err(error) = hide_memory() {
            tracing::warn!(%error, "processes of the same user can read the agent's memory");
        }
    }
    if let Some(private) = &options.private {
        let ended = private.end_with_parent();
        ended.context("cannot end with the command that started it")?;
    }
    control::open_socket(&mut control, &config.api)?;
    let viewers = foxglove::Server::open(&config.foxglove, &config.api, &sources.viewers)?;
    let mut state = KeptState::open(&source, &config, &watches);
    let recordings = memory::recordings(&config.recordings.directory, state.directory());
    let receipts = state.directory().map(|state| state.path().to_owned());
    let kept = history(&config, &control);
    if let Some(state) = state.directory()
        && !kept.is_zero()
        && config.history_bytes > 0
    {
        sources
            .disk_history
            .keep_in(state.path(), config.history_bytes);
    }
    let worker = worker(&mut source)?;
    let responder = Responder::start().context("cannot start the thread that answers requests")?;
    let spans = Arc::<SpanQueue>::default();
    let node_logs = Arc::<NodeLogQueue>::default();
    let ros2_daemon = ros2_daemon(&config, options.report)?;
    let inputs = Inputs {
        metrics: Arc::new(sources.clone()),
        events: Arc::<EventLog>::clone(&sources.events),
        spans: Arc::clone(&spans),
        log: log.exported_lines(),
        node_logs: Arc::clone(&node_logs),
        exports: Arc::clone(&sources.exports),
        directory: state.directory().map(|state| state.path().to_owned()),
    };
    let mut exporters = Vec::new();
    if let Some(settings) = export {
        exporters.push(otlp::start(settings, inputs, privilege::spawn_export)?);
    }
    if let Some(settings) = remote_write {
        let inputs = remote_write::Inputs {
            metrics: Arc::new(sources.clone()),
            figures: Arc::clone(&sources.remote_write),
            directory: state
                .directory()
                .map(|state| state.path().join(REMOTE_WRITE_DIRECTORY)),
        };
        let started = remote_write::start(settings, inputs, privilege::spawn_export);
        exporters.push(started.context("remote write cannot start")?);
    }
    let fleet = fleet::start(&config.fleet, privilege::spawn_export);
    let (fleet_thread, fleet) = fleet.context("the view of a fleet cannot start")?.unzip();
    exporters.extend(fleet_thread);
    let powerless = drop_privileges()?;
    report_listeners(server.as_ref(), &control, viewers.as_ref(), &watches);

    let new_observer = observers(&config, options.replay.is_none());
    let mut observer = new_observer();
    state.restore(&mut observer, &source);
    let stop = CancellationToken::new();
    let is_replay = matches!(source, Source::Replay(_));
    let components = Components {
        config: &config,
        source,
        observer,
        sources: sources.clone(),
        spans,
        node_logs,
        watches: Arc::clone(&watches),
        state_writer: state
            .start_writers(&watches)
            .context("cannot start the threads that keep state")?,
        recordings,
        receipts: receipts.filter(|_| config.ship.url.is_some()),
        library,
        history: kept,
        restart: (is_replay && !options.report)
            .then(|| -> Box<dyn Fn() -> Observer + Send> { Box::new(new_observer) }),
        addresses: page_addresses(&config, &control),
        doctor: options.doctor,
        fleet,
        stop: stop.clone(),
    };
    let agent = components.assemble().context("recordings.snapshots")?;
    if options.report && server.is_none() && control.is_empty() {
        let ended = worker.finish(agent.run);
        print!("{}", Exposition::new(sources).render(Format::Classic)?);
        return ended;
    }
    let supervisor = Supervisor {
        sources: sources.clone(),
        config: configured,
        file,
        watches,
        reloads: agent.reloads,
        stop,
        log,
        exporters,
        ros2_daemon,
    };
    let surfaces = Surfaces {
        metrics: server,
        control,
        viewers,
        context: agent.context,
        unprivileged: powerless,
    };
    let ended = supervise(
        supervisor,
        surfaces,
        (worker, agent.run),
        responder,
        options.report,
    );
    if let Some(private) = &options.private {
        private.clean_up();
    }
    ended?;
    if options.report {
        print!("{}", Exposition::new(sources).render(Format::Classic)?);
    }
    Ok(())
}

/// Makes the replay of a snapshot's bag go to the event that triggered it, and pause there.
fn pause_at_incident(source: &Source, sources: &MetricSources) {
    if let Source::Replay(replay) = source
        && let Some((time, trigger)) = replay.incident()
    {
        sources.latest.replay_pace().change(|pace| {
            pace.jump = Some(Jump::To(*time));
            pace.is_paused = true;
        });
        let (event, time) = (&trigger.event, &trigger.time);
        tracing::info!(
            event,
            time,
            "the replay pauses at the event that triggered the bag"
        );
    }
}

/// Returns the configuration with the overrides of the command line.
fn with_overrides(configured: &Config, options: &Options) -> Config {
    let mut config = configured.clone();
    if let Some(private) = &options.private {
        private.restrict(&mut config);
    }
    if options.replay.is_some() && options.config.is_none() {
        // The receivers and snapshots of the installed agent are for the robot's present. Events of
        // the past would write bags among those of the robot, and remove older ones.
        config.recordings.snapshots.clear();
        config.remote_write.url = None;
        config.fleet.engine = None;
        if let Endpoint::At(_) = config.otlp.endpoint {
            config.otlp.endpoint = Endpoint::Environment;
        }
    }
    if let Some(listen) = options.metrics {
        config.metrics.listen = listen.0;
    } else if options.report {
        config.metrics.listen = None;
    }
    match options.foxglove {
        Some(listen) => config.foxglove.listen = listen.0,
        // A report ends before a viewer could connect.
        None if options.report => config.foxglove.listen = None,
        None => {}
    }
    control::apply_options(
        &mut config.api,
        options.api,
        options.api_loopback,
        options.report,
    );
    config
}

/// Starts the thread of the ros2 daemon, if it is configured. A report ends before a client could
/// connect.
fn ros2_daemon(config: &Config, is_report: bool) -> Result<Option<Ros2Daemon>> {
    if !config.ros2_daemon.is_on || is_report {
        return Ok(None);
    }
    let daemon = Ros2Daemon::start().context("cannot start the thread of the ros2 daemon")?;
    Ok(Some(daemon))
}

/// Returns the settings of exports, from the configuration and the environment.
fn export(config: &Config) -> Result<Option<otlp::Settings>, otlp::SettingsError> {
    let variable = |name: &str| std::env::var(name).ok();
    otlp::Settings::resolve(&config.otlp, &variable, file::read_text, &Host::read())
}

fn remote_write(config: &Config) -> Result<Option<remote_write::Settings>> {
    let settings = &config.remote_write;
    Ok(remote_write::Settings::resolve(
        settings,
        file::read_text,
        &Host::read(),
    )?)
}

/// Returns the time span of figures. It is zero without an API listener, since only API clients
/// read figures.
fn history(config: &Config, control: &api::Server) -> Duration {
    match control.is_empty() {
        true => Duration::ZERO,
        false => config.history,
    }
}

/// Returns the addresses at which the page is served.
fn page_addresses(config: &Config, control: &api::Server) -> Vec<SocketAddr> {
    match config.api.page {
        PageChoice::On => control.addresses().collect(),
        PageChoice::Off => Vec::new(),
    }
}

/// Starts the threads of the source and the working thread, which keep their privileges.
fn worker(source: &mut Source) -> Result<Worker> {
    let role = match source {
        Source::Live(live) => {
            live.start(privilege::spawn_source);
            Role::capture()
        }
        Source::Replay(_) => Role::Service,
    };
    Worker::start(role).context("cannot start the working thread")
}

/// Runs until a signal, a failure or the end of a report, then completes open files.
fn supervise(
    supervisor: Supervisor,
    surfaces: Surfaces,
    (worker, run): (Worker, Run),
    responder: Responder,
    report: bool,
) -> Result<()> {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build();
    let runtime = runtime.context("cannot start the runtime of signals")?;
    let watches = Arc::clone(&supervisor.watches);
    let history = HistoryWriter::start(surfaces.context.clone());
    let history = history.context("cannot start the thread of the history")?;
    let (recordings, snapshots) = (
        Arc::clone(&surfaces.context.recordings),
        Arc::clone(&surfaces.context.snapshots),
    );
    let ended = supervisor.run(worker, run, responder, surfaces, report);
    let ended = runtime.block_on(ended);
    if let Some(history) = history {
        history.finish();
    }
    snapshots.finish();
    recordings.finish();
    watches.finish();
    ended
}

/// State directory with the state of the previous agent.
struct KeptState {
    directory: Option<Arc<StateDirectory>>,
    known: Option<Memory>,
    /// Whether discovery state and watches may be overwritten.
    may_overwrite_discovery: bool,
    may_overwrite_watches: bool,
}

impl KeptState {
    /// Reads the state that the previous live agent saved, and restores its watches.
    fn open(source: &Source, config: &Config, watches: &Watches) -> Self {
        let directory = match source {
            Source::Live(_) => memory::open(&config.state_directory),
            Source::Replay(_) => None,
        };
        let known = directory.as_deref().map(memory::load);
        let (known, keeps_known) = known.unwrap_or_default();
        let keeps_watches = directory
            .as_deref()
            .is_some_and(|directory| memory::restore_watches(directory, watches));
        Self {
            directory,
            known,
            may_overwrite_discovery: keeps_known,
            may_overwrite_watches: keeps_watches,
        }
    }

    fn directory(&self) -> Option<&StateDirectory> {
        self.directory.as_deref()
    }

    /// Restores the discovery state into the model.
    fn restore(&mut self, observer: &mut Observer, source: &Source) {
        if let (Some(known), Source::Live(live)) = (self.known.take(), source) {
            observer.input(Input::Restored {
                memory: &known,
                now: live.clock(),
            });
            drop(known);
            // Decoding needs several times the memory of the decoded state.
            give_back_memory();
        }
    }

    /// Starts the threads that write watches and discovery state.
    fn start_writers(self, watches: &Watches) -> std::io::Result<Option<StateWriter>> {
        let Some(directory) = self.directory else {
            return Ok(None);
        };
        if self.may_overwrite_watches {
            watches.keep_in(Arc::clone(&directory))?;
        }
        let keeps_known = self.may_overwrite_discovery;
        keeps_known
            .then(|| StateWriter::start(directory))
            .transpose()
    }
}

/// Reads the configuration, and returns it with the path of its file. Without `file` and
/// [`DEFAULT_CONFIG`], returns the defaults.
///
/// # Errors
///
/// Returns [`ConfigError`] if the file cannot be read or has mistakes.
pub fn configuration(file: Option<&Path>) -> Result<(Config, Option<PathBuf>), ConfigError> {
    let default = Path::new(DEFAULT_CONFIG);
    match file {
        None if !default.exists() => Ok((Config::default(), None)),
        file => {
            let file = file.unwrap_or(default);
            Ok((Config::load(file)?, Some(file.to_path_buf())))
        }
    }
}

/// Binds the listeners that need the initial privileges.
fn listeners(config: &Config, sources: &MetricSources) -> Result<(Option<Server>, api::Server)> {
    let web_config = config.metrics.web_config.as_deref();
    let bind = |address| Server::bind(address, web_config, sources.clone());
    let server = config.metrics.listen.map(bind).transpose()?;
    Ok((server, control::open(&config.api)?))
}

/// Drops the privileges of this thread, and verifies that none is left.
fn drop_privileges() -> Result<Unprivileged> {
    privilege::confine(Role::Service)?;
    let powerless = Unprivileged::verify()?;
    if let Sandbox::Unfiltered(reason) = privilege::sandbox() {
        tracing::warn!(reason, "system calls are not filtered");
    }
    Ok(powerless)
}

fn report_listeners(
    server: Option<&Server>,
    control: &api::Server,
    viewers: Option<&foxglove::Server>,
    watches: &Watches,
) {
    if let Some(address) = server.and_then(|server| server.local_addr().ok()) {
        let watches = watches.active().entries().len();
        tracing::info!(%address, watches, "serving metrics");
    }
    for door in control.listener_addresses() {
        tracing::info!(address = door, "serving the control API");
    }
    if let Some(address) = viewers.and_then(foxglove::Server::address) {
        tracing::info!(%address, "serving viewers over the Foxglove protocol");
    }
}

/// Returns a function that makes models with what the configuration expects of chains and robot.
fn observers(config: &Config, is_live: bool) -> impl Fn() -> Observer + Send + use<> {
    let settings = settings(config, is_live);
    let chains = Arc::new(config.chains.clone());
    let expectations = config.expectations();
    move || {
        let mut observer = Observer::new(settings);
        observer.input(Input::ExpectedChains(Arc::clone(&chains)));
        observer.input(Input::RobotExpectations(expectations.clone()));
        observer
    }
}

fn settings(config: &Config, is_live: bool) -> observer::Settings {
    observer::Settings {
        topic_grace: config.topic_grace,
        service_timeout: config.service_timeout,
        keeps_latched: config.retain == RetainChoice::Latched,
        robot: config.robot,
        directed: is_live,
        ..observer::Settings::default().with_limits(&config.limits)
    }
}

fn library() -> Library {
    Library::new(Sources::new(
        Vec::new(),
        std::env::var_os("AMENT_PREFIX_PATH").as_deref(),
        Dialect::default(),
    ))
}

fn open(options: &Options, config: &Config) -> Result<Source> {
    let limits = Limits {
        bytes: config.limits.reassembly_bytes,
        ..Limits::default()
    };
    let Some(file) = &options.replay else {
        privilege::check(&config.capture)?;
        let live = LiveSource::open(&config.capture, limits)?;
        return Ok(Source::Live(Box::new(live)));
    };
    let pace = match options.report {
        true => Speed::Max,
        false => Speed::Times(1.0),
    };
    let speed = options.speed.unwrap_or(pace);
    let replay = Replay::open(file, options.expansion, speed, limits)
        .with_context(|| format!("cannot replay {}", file.display()))?;
    Ok(Source::Replay(Box::new(replay)))
}

/// Logs the user of an agent that root started.
fn announce(identity: Identity) {
    match identity {
        Identity::AsStarted => {}
        Identity::Own => tracing::info!("switched from root to user ros2probe"),
        Identity::Root(reason) => {
            tracing::info!("running as root with capabilities dropped ({reason})");
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_replay_has_receivers_and_snapshots_only_of_a_configuration_for_it() {
        let configured = Config::parse(
            b"remote_write: {url: 'http://prometheus:9090/api/v1/write'}\n\
              otlp: {endpoint: 'http://collector:4317'}\n\
              recordings: {snapshots: [{name: incident, topics: [/a]}]}\n",
        )
        .unwrap();
        for (config, replay, is_applied) in [
            (None, Some("drive.pcap"), false),
            (Some("replay.yaml"), Some("drive.pcap"), true),
            (None, None, true),
        ] {
            let options = Options {
                config: config.map(PathBuf::from),
                fleet: None,
                replay: replay.map(PathBuf::from),
                speed: None,
                expansion: Expansion::Limited,
                report: false,
                watch: Vec::new(),
                metrics: None,
                api: None,
                foxglove: None,
                api_loopback: None,
                private: None,
                doctor: Doctor::new(|_| unreachable!()),
            };
            let config = with_overrides(&configured, &options);
            let is_in_force = [
                !config.recordings.snapshots.is_empty(),
                config.remote_write.url.is_some(),
                matches!(config.otlp.endpoint, Endpoint::At(_)),
            ];
            assert_eq!(is_in_force, [is_applied; 3], "{options:?}");
        }
    }
}
