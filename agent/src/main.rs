//! `rp`: the agent and its tools.

mod ask;
mod cli;
mod control;
mod logging;
mod memory;
mod supervise;

use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;

use anyhow::{Context as _, Result};
use clap::Parser as _;
use ros2probe::capture::live::LiveSource;
use ros2probe::capture::pcap::Speed;
use ros2probe::capture::system::give_back_memory;
use ros2probe::config::{Config, ConfigError, PageChoice};
use ros2probe::message::{Library, Sources as Places};
use ros2probe::model::history::History;
use ros2probe::model::observer::{self, Observer};
use ros2probe::model::reassembly::Limits;
use ros2probe::privilege::{
    self, ConfineError, Identity, Missing, Powerless, Role, Sandbox, StillPowerful,
};
use ros2probe::recording::{Recordings, Refusal, Snapshots};
use ros2probe::ros2::Dialect;
use ros2probe::run::replay::Replay;
use ros2probe::run::{Run, Source};
use ros2probe::state::{Keeper, StateDirectory};
use ros2probe::subscriptions::{Caps, Subscriptions};
use ros2probe::surface::api::{self, reload};
use ros2probe::surface::http::Server;
use ros2probe::surface::otlp::{self, Exporter, Host, SettingsError};
use ros2probe::surface::{Board, Exposition, Format, Settings};
use ros2probe::visible::visible_lines;
use ros2probe::watches::Watches;
use tokio_util::sync::CancellationToken;

use cli::{Arguments, Command, DEFAULT_CONFIG, Said};
use logging::Log;
use supervise::{Responder, Supervisor, Surfaces, Worker};

/// `EX_NOPERM` and `EX_CONFIG` of sysexits.h.
const NO_PERMISSION: u8 = 77;
const BAD_CONFIG: u8 = 78;
/// What a shell sees of a process that `SIGPIPE` ended.
const BROKEN_PIPE: u8 = 141;

fn main() -> ExitCode {
    let done = |done: Result<()>| done.map(|()| ExitCode::SUCCESS);
    let ended = match Arguments::parse().command {
        None => cli::help(&[]),
        Some(Command::Run(options)) => done(run(options)),
        Some(Command::CheckConfig { file }) => done(check_config(&file)),
        Some(Command::Discover(options)) => done(ask::discover(&options)),
        Some(Command::Completions(completions)) => completions.print(),
        Some(Command::Man(manual)) => manual.print(),
        Some(Command::Ask(question)) => question.ask(),
    };
    ended.unwrap_or_else(|error| {
        if cli::is_broken_pipe(&error) {
            return ExitCode::from(BROKEN_PIPE);
        }
        // Where nobody can be told, the exit code is left.
        // Errors quote files, names and answers.
        let _ = writeln!(std::io::stderr(), "{}", visible_lines(&message(&error)));
        exit_code(&error)
    })
}

/// The agent's life, in order.
fn run(options: cli::Run) -> Result<()> {
    let (mut config, file) = configuration(options.config.as_deref())?;
    let configured = config.clone();
    if let Some(listen) = options.metrics {
        config.metrics.listen = listen.0;
    } else if options.report {
        config.metrics.listen = None;
    }
    control::choose(
        &mut config.api,
        options.api,
        options.api_loopback,
        options.report,
    );
    let log = Log::start(config.log);
    let export = otlp::Settings::resolve(
        &config.otlp,
        &|name| std::env::var(name).ok(),
        &Host::read(),
    )?;
    let mut source = open(&options, &config)?;
    source.announce(&config.capture);
    let board = Board::new(source.kind(), Settings::new(&config));
    let board = Arc::new(board.counting_lost_lines(log.lost_lines()));
    let watches = Watches::new(Arc::clone(&board), config.watches.clone(), options.watch);
    let watches = Arc::new(watches.context("the watchlist is unusable")?);
    let server = config.metrics.listen.map(|address| {
        Server::bind(
            address,
            config.metrics.web_config.as_deref(),
            Arc::clone(&board),
        )
    });
    let server = server.transpose()?;
    let mut control = control::open(&config.api)?;
    // A replay is a person's own command, which reads and writes that person's files.
    if matches!(source, Source::Live(_)) {
        announce(privilege::become_own_user());
    }
    control::open_socket(&mut control, &config.api)?;
    let state = match &source {
        Source::Live(_) => memory::open(&config.state_directory),
        Source::Replay(_) => None,
    };
    let recordings_directory = memory::recordings(&config.recordings.directory, state.as_deref());
    let known = state.as_deref().map(memory::load);
    let (known, keeps_known) = known.unwrap_or_default();
    let keeps_watches = state
        .as_deref()
        .is_some_and(|state| memory::restore_watches(state, &watches));
    let role = match &mut source {
        Source::Live(live) => {
            live.start(privilege::spawn_source);
            Role::capture()
        }
        Source::Replay(_) => Role::Service,
    };
    let worker = Worker::start(role).context("cannot start the working thread")?;
    let responder = Responder::start().context("cannot start the thread that answers requests")?;
    let exporter = export.map(|settings| Exporter::start(settings, &board));
    let exporter = exporter.transpose()?;
    privilege::confine(Role::Service)?;
    let powerless = Powerless::verify()?;
    if let Sandbox::Unfiltered(reason) = privilege::sandbox() {
        tracing::warn!(reason, "system calls are not filtered");
    }
    if let Some(address) = server.as_ref().and_then(|server| server.local_addr().ok()) {
        let watches = watches.in_force().entries().len();
        tracing::info!(%address, watches, "serving metrics");
    }
    for door in control.doors() {
        tracing::info!(address = door, "serving the control API");
    }

    let stop = CancellationToken::new();
    let caps = Caps {
        subscriptions: config.limits.subscriptions,
        // The other half is for what is put together.
        bytes: config.limits.payload_bytes / 2,
    };
    let subscriptions = Subscriptions::new(Arc::clone(&board), caps, stop.clone());
    let subscriptions = Arc::new(subscriptions);
    let grace = u64::try_from(config.topic_grace.as_nanos()).unwrap_or(u64::MAX);
    let settings = observer::Settings {
        topic_grace: grace,
        directed: options.replay.is_none(),
        ..observer::Settings::default().with_limits(&config.limits)
    };
    let mut observer = Observer::new(settings);
    if let (Some(known), Source::Live(live)) = (known, &source) {
        observer.restore(&known, live.clock());
        drop(known);
        // Reading it takes several times what stays of it.
        give_back_memory();
    }
    let keep = |directory: Arc<StateDirectory>| {
        if keeps_watches {
            watches.keep_in(Arc::clone(&directory))?;
        }
        keeps_known.then(|| Keeper::start(directory)).transpose()
    };
    let keeper = state.map_or(Ok(None), keep);
    let keeper = keeper.context("cannot start the threads that keep state")?;
    let library = Arc::new(Library::new(Places::new(
        Vec::new(),
        std::env::var_os("AMENT_PREFIX_PATH").as_deref(),
        Dialect::default(),
    )));
    let recordings = Arc::new(Recordings::new(
        recordings_directory,
        config.recordings.limits,
        caps.bytes / 2,
        Arc::clone(&board),
        Arc::clone(&subscriptions),
        Arc::clone(&library),
    ));
    let snapshots = match Snapshots::start(&config.recordings.snapshots, &recordings, &board) {
        // The disk is not there today: no reason to see nothing.
        Err(refusal @ Refusal::NoDirectory) if config.recordings.is_in(&config.state_directory) => {
            tracing::error!(%refusal, "no snapshots are kept");
            Snapshots::default()
        }
        started => started.context("recordings.snapshots")?,
    };
    let snapshots = Arc::new(snapshots);
    let run = Run::new(
        source,
        observer,
        Arc::clone(&board),
        Arc::clone(&watches),
        Arc::clone(&subscriptions),
        stop.clone(),
    );
    let history = usize::try_from(config.history.as_secs()).unwrap_or(usize::MAX);
    // Without the API nobody can ask for it.
    let history =
        (history > 0 && !control.is_empty()).then(|| History::new(history, config.limits.topics));
    let run = run.keeping(keeper).remembering(history);
    if options.report && server.is_none() && control.is_empty() {
        let ended = worker.finish(run);
        print!("{}", Exposition::new(board).render(Format::Classic)?);
        return ended;
    }
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build();
    let runtime = runtime.context("cannot start the runtime of signals")?;
    let (reloader, reloads) = reload::channel();
    let context = api::Context {
        board: Arc::clone(&board),
        watches: Arc::clone(&watches),
        subscriptions,
        recordings: Arc::clone(&recordings),
        snapshots: Arc::clone(&snapshots),
        live: Arc::new(api::Live::new(config.history)),
        library,
        page: Arc::new(api::Page::new(match config.api.page {
            PageChoice::On => control.addresses().collect(),
            PageChoice::Off => Vec::new(),
        })),
        reloader,
        stop: stop.clone(),
    };
    let supervisor = Supervisor {
        board: Arc::clone(&board),
        config: configured,
        file,
        watches: Arc::clone(&watches),
        reloads,
        stop,
        log,
        exporter,
    };
    let surfaces = Surfaces {
        metrics: server,
        control,
        context,
        powerless,
    };
    let ended = runtime.block_on(supervisor.run(worker, run, responder, surfaces, options.report));
    snapshots.finish();
    recordings.finish();
    watches.finish();
    ended?;
    if options.report {
        print!("{}", Exposition::new(board).render(Format::Classic)?);
    }
    Ok(())
}

/// The configuration and the file it came from. Without `--config` a missing file is no mistake.
pub(crate) fn configuration(file: Option<&Path>) -> Result<(Config, Option<PathBuf>)> {
    let default = Path::new(DEFAULT_CONFIG);
    match file {
        None if !default.exists() => Ok((Config::default(), None)),
        file => {
            let file = file.unwrap_or(default);
            Ok((Config::load(file)?, Some(file.to_path_buf())))
        }
    }
}

fn open(options: &cli::Run, config: &Config) -> Result<Source> {
    let limits = Limits {
        bytes: config.limits.reassembly_bytes,
        ..Limits::default()
    };
    let Some(file) = &options.replay else {
        privilege::check(&config.capture)?;
        let live = LiveSource::open(&config.capture, limits)?;
        return Ok(Source::Live(Box::new(live)));
    };
    let pace = if options.report {
        Speed::Max
    } else {
        Speed::Times(1.0)
    };
    let replay = Replay::open(file, options.speed.unwrap_or(pace), limits)
        .with_context(|| format!("cannot replay {}", file.display()))?;
    Ok(Source::Replay(Box::new(replay)))
}

/// Only root's are worth a line.
fn announce(identity: Identity) {
    match identity {
        Identity::AsStarted => {}
        Identity::Own => tracing::info!("switched from root to user ros2probe"),
        Identity::Root(reason) => {
            tracing::info!("running as root with capabilities dropped ({reason})");
        }
    }
}

fn check_config(file: &Path) -> Result<()> {
    let config = Config::load(file)?;
    println!(
        "{} is good: {} watched",
        file.display(),
        config.watches.len()
    );
    Ok(())
}

/// The error with its causes, once. Mistakes of a configuration are one line each, as they are.
fn message(error: &anyhow::Error) -> String {
    match error.downcast_ref::<ConfigError>() {
        Some(mistakes @ ConfigError::Invalid { .. }) => mistakes.to_string(),
        _ if error.is::<Said>() => error.to_string(),
        _ => format!("rp: {error:#}"),
    }
}

fn exit_code(error: &anyhow::Error) -> ExitCode {
    if error.is::<Missing>() || error.is::<StillPowerful>() || error.is::<ConfineError>() {
        ExitCode::from(NO_PERMISSION)
    } else if error.is::<ConfigError>() || error.is::<SettingsError>() {
        ExitCode::from(BAD_CONFIG)
    } else {
        ExitCode::FAILURE
    }
}
