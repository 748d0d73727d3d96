//! Agent within this process that replays a capture. Clients send requests over pipes in memory
//! instead of sockets. The same code thus describes a capture and a robot.

use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant};

use ros2probe_capture::pcap::{PcapError, Speed, link_name};
use ros2probe_capture::reassembly::Limits;
use ros2probe_daemon::agent::{AssembledAgent, Components};
use ros2probe_daemon::agent_facts::{AgentFacts, SourceKind};
use ros2probe_daemon::config::{Config, RetainChoice, Watch};
use ros2probe_daemon::run::replay::{self, BagError, Replay, ReplayControl, pause_at};
use ros2probe_daemon::run::{CaptureTime, Run, RunError};
use ros2probe_daemon::settings_cell::Settings;
use ros2probe_daemon::snapshot_cell::SnapshotCell;
use ros2probe_daemon::surface::MetricSources;
use ros2probe_daemon::surface::api;
use ros2probe_model::observe::observer::{self, Observer};
use ros2probe_wire::Expansion;
use ros2probe_wire::frame::Link;
use tokio::io::{DuplexStream, duplex};
use tokio::sync::{mpsc, oneshot};
use tokio_util::sync::CancellationToken;

/// Capacity of a pipe in bytes; most answers are smaller.
const PIPE_BYTES: usize = 1 << 20;
/// Cap on topics. A capture is read offline, so the limit of a live agent does not apply.
const MAX_TOPICS: usize = 16_384;
/// Maximum wait for the end of a replay whose streams have ended.
const END_TIMEOUT: Duration = Duration::from_millis(500);

/// Range and pace of a replay.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct ReplayOptions {
    /// Time at which [`Pace::Pause`] pauses. `None` means the beginning of the capture.
    pub(super) from: Option<CaptureTime>,
    /// Time at which the replay ends. `None` means the end of the capture.
    pub(super) until: Option<CaptureTime>,
    /// Whether every topic is measured.
    pub(super) measured: bool,
    /// Pace of the replay during requests.
    pub(super) pace: Pace,
    /// How far a gzipped capture may expand.
    pub(super) expansion: Expansion,
}

/// Pace of a replay during requests.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Pace {
    /// The replay ends before the first request.
    ToEnd,
    /// The replay pauses until [`ReplayAgent::resume`].
    Pause,
    /// The replay pauses until [`ReplayAgent::advance`], which names the next pause, and reports no
    /// progress.
    Steps,
    /// The replay continues at this speed.
    Live(Speed),
}

/// A capture with its own agent. Dropping it ends the agent.
#[derive(Debug)]
pub(super) struct ReplayAgent {
    capture: PathBuf,
    pipes: mpsc::UnboundedSender<DuplexStream>,
    control: Option<ReplayControl>,
    stop: CancellationToken,
    outcome: Arc<OnceLock<Outcome>>,
}

/// Result of a replay.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Outcome {
    /// Reason why the rest of the capture was not read.
    pub fault: Option<String>,
    /// Number of packets of unsupported link layers.
    pub unsupported_packets: u64,
}

/// A capture cannot be replayed.
#[derive(Debug, thiserror::Error)]
pub(super) enum ReplayError {
    /// The file is neither a capture nor a bag, or cannot be read.
    #[error(transparent)]
    Capture(replay::ReplayError),
    /// The agent could not be started.
    #[error(transparent)]
    Start(io::Error),
}

impl ReplayAgent {
    /// Replays `capture` on its own thread. `report` receives a line for each unreadable part of
    /// the capture, except with [`Pace::Live`]. Packets before such a part are processed. Call it
    /// within a tokio runtime, which serves the requests.
    ///
    /// # Errors
    ///
    /// Returns [`ReplayError`] if the capture has an unsupported link layer or cannot be opened.
    pub(super) async fn start(
        capture: &Path,
        options: ReplayOptions,
        report: fn(&str),
    ) -> Result<Self, ReplayError> {
        let mut config = Config::default();
        config.limits.topics = MAX_TOPICS;
        let (replay, mut control) = open(capture, options, &config)?;
        let stop = CancellationToken::new();
        let agent = assemble(replay, options.measured, &config, stop.clone());
        let agent = agent.map_err(ReplayError::Start)?;
        let is_live = matches!(options.pace, Pace::Live(_));
        // With `Pace::Live` the client uses the terminal.
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
                if let Ok(Some(RunError::Replay(error))) = ended.await
                    && is_unusable(&error)
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

    /// Returns the result of the replay; `None` until its end.
    #[must_use]
    pub(super) fn outcome(&self) -> Option<Outcome> {
        let deadline = Instant::now() + END_TIMEOUT;
        while self.outcome.get().is_none() && Instant::now() < deadline {
            std::thread::sleep(END_TIMEOUT / 50);
        }
        self.outcome.get().cloned()
    }

    /// Opens a pipe to the API of the agent.
    #[must_use]
    pub(super) fn connect(&self) -> DuplexStream {
        let (client, server) = duplex(PIPE_BYTES);
        // Without an agent the pipe is broken, which the client reports.
        let _ = self.pipes.send(server);
        client
    }

    /// Replays the rest after a pause.
    pub(super) fn resume(&self) {
        if let Some(control) = &self.control {
            control.resume();
        }
    }

    /// Replays to this time after a pause of [`Pace::Steps`], and pauses again. Returns `false` if
    /// the replay has ended.
    pub(super) async fn advance(&self, to: CaptureTime) -> bool {
        match &self.control {
            Some(control) => control.advance(to).await,
            None => false,
        }
    }

    /// Returns the path of the capture.
    #[must_use]
    pub(super) fn capture(&self) -> &Path {
        &self.capture
    }
}

impl Drop for ReplayAgent {
    fn drop(&mut self) {
        self.stop.cancel();
    }
}

/// Opens the capture, and the control of its pauses if it has any.
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
        Pace::ToEnd | Pace::Pause | Pace::Steps => Speed::Max,
    };
    let replay =
        Replay::open(capture, options.expansion, speed, limits).map_err(ReplayError::Capture)?;
    let replay = replay.ending_at(options.until);
    Ok(match options.pace {
        Pace::ToEnd => (replay, None),
        Pace::Live(_) => (replay.without_progress(), None),
        Pace::Pause => {
            let (pause, control) = pause_at(options.from);
            (replay.pausing_at(pause), Some(control))
        }
        Pace::Steps => {
            let (pause, control) = pause_at(options.from);
            (replay.without_progress().pausing_at(pause), Some(control))
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
    let sources = MetricSources::new(SourceKind::Replay, Settings::new(config));
    let everything = measured.then(Watch::everything).into_iter().collect();
    let watches = sources.watches(Vec::new(), everything);
    let watches = watches.map_err(io::Error::other)?;
    let settings = observer::Settings {
        // No kernel filter has to be updated first.
        payload_delay: Duration::ZERO,
        keeps_latched: config.retain == RetainChoice::Latched,
        directed: false,
        ..observer::Settings::default().with_limits(&config.limits)
    };
    // `rp bag record` records a capture, not the agent that replays it.
    let components = Components {
        observer: Observer::new(settings),
        stop,
        ..Components::of_replay(config, replay, sources, watches, crate::doctor::of_agent())
    };
    components.assemble().map_err(io::Error::other)
}

/// Prints the unreadable parts of a file.
struct Report {
    file: PathBuf,
    print: fn(&str),
}

/// The thread of a replay.
struct Running {
    /// Result of the replay.
    outcome: Arc<OnceLock<Outcome>>,
    /// Receives the error of the thread, if any, at its end.
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
        let state = latest.state();
        if let Some(Report { file, print }) = report {
            let lines = capture_faults(&file, &result, &state.agent);
            lines.iter().for_each(|line| print(line));
        }
        let unsupported = state.agent.unsupported_packets.iter();
        let _ = stored.set(Outcome {
            fault: result.as_ref().err().map(ToString::to_string),
            unsupported_packets: unsupported.map(|(_, packets)| packets).sum(),
        });
        let _ = sender.send(result.err());
    };
    let thread = std::thread::Builder::new().name("replay".to_owned());
    thread.spawn(work).map_err(ReplayError::Start)?;
    Ok(Running { outcome, ended })
}

/// Returns whether nothing of a capture or bag can be read. The command's own error then covers it.
const fn is_unusable(error: &replay::ReplayError) -> bool {
    use replay::ReplayError;
    matches!(
        error,
        ReplayError::Capture(PcapError::UnsupportedLink { .. })
            | ReplayError::Bag(BagError::Messages(_))
    )
}

/// Returns the unreadable parts of a capture or bag with their remedies, one per line.
fn capture_faults(
    capture: &Path,
    result: &Result<(), RunError>,
    facts: &AgentFacts,
) -> Vec<String> {
    let (unsupported, bag_faults) = (&facts.unsupported_packets, &facts.replay_faults);
    let capture = capture.display();
    let mut lines = Vec::new();
    match result {
        Err(RunError::Replay(error)) if is_unusable(error) => return lines,
        Err(RunError::Replay(replay::ReplayError::Capture(
            error @ (PcapError::Truncated { .. } | PcapError::Read { .. }),
        ))) => {
            lines.push(format!(
                "{capture} is incomplete: {error}; the rest is missing. Copy it again, or let \
                 tcpdump end by itself"
            ));
        }
        Err(RunError::Replay(error)) => lines.push(format!(
            "{capture} cannot be read further: {error}; the rest is missing"
        )),
        Err(error) => lines.push(error.to_string()),
        Ok(()) => {}
    }
    lines.extend(bag_faults.iter().cloned());
    for (link, packets) in unsupported {
        let link = link_name(Link(*link));
        lines.push(format!(
            "{packets} packets of {capture} have link type {link}, which is not supported"
        ));
    }
    lines
}
