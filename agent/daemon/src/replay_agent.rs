//! An agent within this process that replays a capture. Clients ask it over pipes in memory, as they
//! ask another agent over sockets: the same code describes a capture and a robot.

use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant};

use ros2probe_capture::pcap::{PcapError, Speed, link_name};
use ros2probe_capture::reassembly::Limits;
use ros2probe_message::{Library, Sources};
use ros2probe_model::observer::{self, Observer};
use ros2probe_wire::frame::Link;
use tokio::io::{DuplexStream, duplex};
use tokio::sync::{mpsc, oneshot};
use tokio_util::sync::CancellationToken;

use crate::agent::{AssembledAgent, Components};
use crate::config::{Config, Watch};
use crate::run::replay::{Replay, ReplayControl, pause_at};
use crate::run::{CaptureTime, Run, RunError, Source};
use crate::settings_cell::Settings;
use crate::snapshot_cell::SnapshotCell;
use crate::surface::MetricSources;
use crate::surface::api;
use crate::watches::Watches;

/// Bytes that a pipe holds: more than most answers.
const PIPE_BYTES: usize = 1 << 20;
/// A capture is read offline: the limit of a live agent does not apply.
const TOPICS: usize = 16_384;
/// The longest wait for the end of a replay whose streams have ended.
const TIMEOUT: Duration = Duration::from_millis(500);

/// What of a capture is replayed, and how.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ReplayOptions {
    /// Where [`Pace::Pause`] pauses; `None` = at the beginning of the capture.
    pub from: Option<CaptureTime>,
    /// Where the replay ends; `None` = at the end of the capture.
    pub until: Option<CaptureTime>,
    /// Whether every topic is measured.
    pub measured: bool,
    /// How the replay goes on while clients ask.
    pub pace: Pace,
}

/// How a replay goes on while clients ask.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Pace {
    /// It has ended before the first request.
    ToEnd,
    /// It pauses until [`ReplayAgent::resume`].
    Pause,
    /// It goes on at this speed.
    Live(Speed),
}

/// A capture with an agent of its own, which ends with this value.
#[derive(Debug)]
pub struct ReplayAgent {
    capture: PathBuf,
    pipes: mpsc::UnboundedSender<DuplexStream>,
    control: Option<ReplayControl>,
    stop: CancellationToken,
    outcome: Arc<OnceLock<Outcome>>,
}

/// How a replay ended.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Outcome {
    /// Why the rest of the capture was not read.
    pub fault: Option<String>,
    /// Packets of link layers that are not supported.
    pub unsupported_packets: u64,
}

/// Why a capture is not replayed.
#[derive(Debug, thiserror::Error)]
pub enum ReplayError {
    /// The file is no capture, or cannot be read.
    #[error(transparent)]
    Capture(PcapError),
    /// The agent could not be started.
    #[error(transparent)]
    Start(io::Error),
}

impl ReplayAgent {
    /// Replays `capture` on a thread of its own. `report` receives a line for each part of the
    /// capture that cannot be read, except with [`Pace::Live`]; what came before counts. Runs within
    /// a tokio runtime, which serves the requests.
    ///
    /// # Errors
    /// Returns [`ReplayError`] if the capture has a link layer that is not supported, or cannot be
    /// opened.
    pub async fn start(
        capture: &Path,
        options: ReplayOptions,
        report: fn(&str),
    ) -> Result<Self, ReplayError> {
        let mut config = Config::default();
        config.limits.topics = TOPICS;
        let (replay, mut control) = open(capture, options, &config)?;
        let stop = CancellationToken::new();
        let agent = assemble(replay, options.measured, &config, stop.clone());
        let agent = agent.map_err(ReplayError::Start)?;
        let is_live = matches!(options.pace, Pace::Live(_));
        // With `Pace::Live` the terminal belongs to the client.
        let report = (!is_live).then(|| Report {
            file: capture.to_path_buf(),
            print: report,
        });
        let Running { outcome, ended } =
            spawn(agent.run, Arc::clone(&agent.context.latest), report)?;
        let (pipes, opened) = mpsc::unbounded_channel();
        tokio::spawn(api::serve_in_process(opened, agent.context));
        match &mut control {
            None if is_live => {}
            None => {
                if let Ok(Some(RunError::Replay(error @ PcapError::UnsupportedLink { .. }))) =
                    ended.await
                {
                    return Err(ReplayError::Capture(error));
                }
            }
            Some(control) => control.paused().await,
        }
        Ok(Self {
            capture: capture.to_path_buf(),
            pipes,
            control,
            stop,
            outcome,
        })
    }

    /// How the replay ended; `None` while it goes on.
    #[must_use]
    pub fn outcome(&self) -> Option<Outcome> {
        let deadline = Instant::now() + TIMEOUT;
        while self.outcome.get().is_none() && Instant::now() < deadline {
            std::thread::sleep(TIMEOUT / 50);
        }
        self.outcome.get().cloned()
    }

    /// Opens a pipe to the API of the agent.
    #[must_use]
    pub fn connect(&self) -> DuplexStream {
        let (client, server) = duplex(PIPE_BYTES);
        // Without an agent the pipe is broken, which the client reports.
        let _ = self.pipes.send(server);
        client
    }

    /// Replays the rest.
    pub fn resume(&self) {
        if let Some(control) = &self.control {
            control.resume();
        }
    }

    /// The file.
    #[must_use]
    pub fn capture(&self) -> &Path {
        &self.capture
    }
}

impl Drop for ReplayAgent {
    fn drop(&mut self) {
        self.stop.cancel();
    }
}

/// Opens the capture, and the control of its pause if there is one.
fn open(
    capture: &Path,
    options: ReplayOptions,
    config: &Config,
) -> Result<(Replay, Option<ReplayControl>), ReplayError> {
    let limits = Limits {
        bytes: config.limits.reassembly_bytes,
        ..Limits::default()
    };
    let speed = match options.pace {
        Pace::Live(speed) => speed,
        Pace::ToEnd | Pace::Pause => Speed::Max,
    };
    let replay = Replay::open(capture, speed, limits).map_err(ReplayError::Capture)?;
    let replay = replay.until(options.until);
    Ok(match options.pace {
        Pace::ToEnd => (replay, None),
        Pace::Live(_) => (replay.quiet(), None),
        Pace::Pause => {
            let (pause, control) = pause_at(options.from);
            (replay.pausing_at(pause), Some(control))
        }
    })
}

/// Composes the agent of a replay.
fn assemble(
    replay: Replay,
    measured: bool,
    config: &Config,
    stop: CancellationToken,
) -> io::Result<AssembledAgent> {
    let source = Source::Replay(Box::new(replay));
    let sources = MetricSources::new(source.kind(), Settings::new(config));
    let everything = measured.then(|| Watch::named("/**").ok()).flatten();
    let watches = Watches::new(
        Arc::clone(&sources.limits),
        Arc::clone(&sources.events),
        Arc::clone(&sources.settings),
        Arc::clone(sources.latest.bell()),
        Vec::new(),
        everything.into_iter().collect(),
    );
    let settings = observer::Settings {
        // No kernel has to follow first.
        payload_delay: 0,
        ..observer::Settings::default().with_limits(&config.limits)
    };
    let components = Components {
        config,
        source,
        observer: Observer::new(settings),
        sources,
        spans: Arc::default(),
        watches: Arc::new(watches.map_err(io::Error::other)?),
        keeper: None,
        // `rp bag record` records a capture, not the agent that replays it.
        recordings: None,
        library: Library::new(Sources::default()),
        history: Duration::ZERO,
        addresses: Vec::new(),
        stop,
    };
    components.assemble().map_err(io::Error::other)
}

/// Prints what was not read of a file.
struct Report {
    file: PathBuf,
    print: fn(&str),
}

/// The thread of a replay.
struct Running {
    /// How it ended.
    outcome: Arc<OnceLock<Outcome>>,
    /// Receives its error at the end.
    ended: oneshot::Receiver<Option<RunError>>,
}

/// Runs the agent on a thread.
fn spawn(
    run: Run,
    latest: Arc<SnapshotCell>,
    report: Option<Report>,
) -> Result<Running, ReplayError> {
    let (sender, ended) = oneshot::channel();
    let outcome = Arc::new(OnceLock::new());
    let stored = Arc::clone(&outcome);
    let work = move || {
        let result = run.run();
        let unsupported = latest.state().agent.unsupported_packets.clone();
        if let Some(Report { file, print }) = report {
            let lines = faults(&file, &result, &unsupported);
            lines.iter().for_each(|line| print(line));
        }
        let _ = stored.set(Outcome {
            fault: result.as_ref().err().map(ToString::to_string),
            unsupported_packets: unsupported.iter().map(|(_, packets)| packets).sum(),
        });
        let _ = sender.send(result.err());
    };
    let thread = std::thread::Builder::new().name("replay".to_owned());
    thread.spawn(work).map_err(ReplayError::Start)?;
    Ok(Running { outcome, ended })
}

/// What of a capture was not read, and what to do: a line each.
fn faults(
    capture: &Path,
    result: &Result<(), RunError>,
    unsupported: &[(u16, u64)],
) -> Vec<String> {
    let capture = capture.display();
    let mut lines = Vec::new();
    match result {
        // The error of the whole command says so.
        Err(RunError::Replay(PcapError::UnsupportedLink { .. })) => return lines,
        Err(RunError::Replay(error @ (PcapError::Truncated { .. } | PcapError::Read { .. }))) => {
            lines.push(format!(
                "{capture} is incomplete: {error}; what follows is missing. Copy it again, or let \
                 tcpdump end by itself"
            ));
        }
        Err(RunError::Replay(error)) => lines.push(format!(
            "{capture} cannot be read further: {error}; what follows is missing"
        )),
        Err(error) => lines.push(error.to_string()),
        Ok(()) => {}
    }
    for (link, packets) in unsupported {
        let link = link_name(Link(*link));
        lines.push(format!(
            "{packets} packets of {capture} have link type {link}, which is not supported"
        ));
    }
    lines
}
