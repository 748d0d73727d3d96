//! An agent within this process that looks at a capture, asked over pipes in memory as any other is
//! over sockets: what is true of a capture and of a robot is said by the same code.

use std::path::{Path, PathBuf};
use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant};

use ros2probe_wire::frame::Link;
use tokio::io::{DuplexStream, duplex};
use tokio::sync::{mpsc, oneshot};
use tokio_util::sync::CancellationToken;

use super::{ClientError, Target};
use ros2probe_capture::pcap::{PcapError, Speed, link_name};
use ros2probe_capture::reassembly::Limits;
use ros2probe_daemon::agent::{AssembledAgent, Components};
use ros2probe_daemon::config::{Config, Watch};
use ros2probe_daemon::run::replay::{Replay, ReplayControl, pause_at};
use ros2probe_daemon::run::{RunError, Source};
use ros2probe_daemon::settings_cell::Settings;
use ros2probe_daemon::surface::MetricSources;
use ros2probe_daemon::surface::api;
use ros2probe_daemon::watches::Watches;
use ros2probe_message::{Library, Sources};
use ros2probe_model::observer::{self, Observer};

/// What a pipe holds: more than most answers.
const PIPE: usize = 1 << 20;
/// A capture is read offline: what a live agent measures at once is no measure for it.
const TOPICS: usize = 16_384;
/// How long the end of a replay whose streams have ended is waited for.
const TIMEOUT: Duration = Duration::from_millis(500);

/// How far a capture is replayed before anything is asked.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Stop {
    /// To the end.
    AtEnd,
    /// To the end, with every topic measured.
    AtEndMeasured,
    /// To where messages are wanted from.
    AtBeginning,
    /// To where messages are wanted from, with every topic measured.
    AtBeginningMeasured,
    /// Not at all: it goes on while it is asked, with every topic measured.
    Never(Speed),
}

/// A capture with an agent of its own.
#[derive(Debug)]
pub(super) struct ReplayAgent {
    capture: PathBuf,
    pipes: mpsc::UnboundedSender<DuplexStream>,
    waiter: Option<ReplayControl>,
    stop: CancellationToken,
    outcome: Arc<OnceLock<Outcome>>,
}

/// How a replay ended.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Outcome {
    /// Why the rest of the capture was not read.
    pub fault: Option<String>,
    /// Packets of link layers that cannot be read.
    pub unsupported_packets: u64,
}

impl ReplayAgent {
    /// Replays `capture` as far as is asked for. What cannot be read of it is said on stderr; what
    /// came before counts.
    pub(super) async fn start(
        capture: &Path,
        target: &Target,
        stop: Stop,
    ) -> Result<Self, ClientError> {
        let mut config = Config::default();
        config.limits.topics = TOPICS;
        let limits = Limits {
            bytes: config.limits.reassembly_bytes,
            ..Limits::default()
        };
        let failed = |source| ClientError::Capture {
            path: capture.to_path_buf(),
            source,
        };
        let speed = match stop {
            Stop::Never(speed) => speed,
            _ => Speed::Max,
        };
        let replay = Replay::open(capture, speed, limits).map_err(failed)?;
        let mut replay = replay.until(target.until);
        let mut waiter = None;
        let is_live = matches!(stop, Stop::Never(_));
        if is_live {
            replay = replay.quiet();
        }
        if matches!(stop, Stop::AtBeginning | Stop::AtBeginningMeasured) {
            let (rest, other) = pause_at(target.from);
            replay = replay.pausing_at(rest);
            waiter = Some(other);
        }
        let source = Source::Replay(Box::new(replay));
        let sources = MetricSources::new(source.kind(), Settings::new(&config));
        let watched = match stop {
            Stop::AtEndMeasured | Stop::AtBeginningMeasured | Stop::Never(_) => {
                Watch::named("/**").into_iter().collect()
            }
            Stop::AtEnd | Stop::AtBeginning => Vec::new(),
        };
        let watches = Watches::new(
            Arc::clone(&sources.limits),
            Arc::clone(&sources.events),
            Arc::clone(&sources.settings),
            Arc::clone(sources.latest.bell()),
            Vec::new(),
            watched,
        );
        let watches = watches.map_err(|error| ClientError::Runtime {
            source: std::io::Error::other(error),
        })?;
        let watches = Arc::new(watches);
        let settings = observer::Settings {
            // No kernel has to be told first.
            payload_delay: 0,
            ..observer::Settings::default().with_limits(&config.limits)
        };
        let token = CancellationToken::new();
        let parts = Components {
            config: &config,
            source,
            observer: Observer::new(settings),
            sources: sources.clone(),
            spans: Arc::default(),
            watches,
            keeper: None,
            // A capture is recorded by `rp bag record`, not by the agent that replays it.
            recordings: None,
            library: Library::new(Sources::default()),
            history: Duration::ZERO,
            addresses: Vec::new(),
            stop: token.clone(),
        };
        let parts = parts.assemble().map_err(|error| ClientError::Runtime {
            source: std::io::Error::other(error),
        })?;
        let AssembledAgent { run, context, .. } = parts;
        let (tell, ended) = oneshot::channel();
        let outcome = Arc::new(OnceLock::new());
        let (how, seen, file) = (
            Arc::clone(&outcome),
            Arc::clone(&sources.latest),
            capture.to_path_buf(),
        );
        let work = move || {
            let ended = run.run();
            let left_out = seen.state().agent.unsupported_packets.clone();
            // Where it is live, the screen is somebody else's, who sees that nothing comes any more.
            if !is_live {
                explain(&file, &ended, &left_out);
            }
            let _ = how.set(Outcome {
                fault: ended.as_ref().err().map(ToString::to_string),
                unsupported_packets: left_out.iter().map(|(_, packets)| packets).sum(),
            });
            let _ = tell.send(ended.err());
        };
        let thread = std::thread::Builder::new().name("replay".to_owned());
        let thread = thread.spawn(work);
        thread.map_err(|source| ClientError::Runtime { source })?;
        let (pipes, opened) = mpsc::unbounded_channel();
        tokio::spawn(api::serve_in_process(opened, context));
        match &mut waiter {
            None if is_live => {}
            // A link layer that cannot be read is no capture for this program.
            None => {
                if let Ok(Some(RunError::Replay(error @ PcapError::UnsupportedLink { .. }))) =
                    ended.await
                {
                    return Err(failed(error));
                }
            }
            Some(waiter) => waiter.paused().await,
        }
        Ok(Self {
            capture: capture.to_path_buf(),
            pipes,
            waiter,
            stop: token,
            outcome,
        })
    }

    /// How it ended; nothing while it goes on.
    pub(super) fn outcome(&self) -> Option<Outcome> {
        let deadline = Instant::now() + TIMEOUT;
        while self.outcome.get().is_none() && Instant::now() < deadline {
            std::thread::sleep(TIMEOUT / 50);
        }
        self.outcome.get().cloned()
    }

    /// A pipe to the agent.
    pub(super) fn connect(&self) -> DuplexStream {
        let (ours, theirs) = duplex(PIPE);
        // The agent lives as long as this; else the pipe is broken, which is said.
        let _ = self.pipes.send(theirs);
        ours
    }

    /// Replays the rest.
    pub(super) fn resume(&self) {
        if let Some(waiter) = &self.waiter {
            waiter.resume();
        }
    }

    /// The file.
    pub(super) fn capture(&self) -> &Path {
        &self.capture
    }
}

impl Drop for ReplayAgent {
    fn drop(&mut self) {
        self.stop.cancel();
    }
}

/// Says on stderr what of a capture was not read, and what to do.
fn explain(capture: &Path, ended: &Result<(), RunError>, left_out: &[(u16, u64)]) {
    let capture = capture.display();
    let unreadable =
        |error: &RunError| matches!(error, RunError::Replay(PcapError::UnsupportedLink { .. }));
    match ended {
        // The error of the whole command says so.
        Err(error) if unreadable(error) => return,
        Err(RunError::Replay(error @ (PcapError::Truncated { .. } | PcapError::Read { .. }))) => {
            eprintln!(
                "rp: {capture} is incomplete: {error}; what follows is missing. Copy it again, or let \
                 tcpdump end by itself"
            );
        }
        Err(RunError::Replay(error)) => {
            eprintln!("rp: {capture} cannot be read further: {error}; what follows is missing");
        }
        Err(error) => eprintln!("rp: {error}"),
        Ok(()) => {}
    }
    for (link, packets) in left_out {
        let link = link_name(Link(*link));
        eprintln!(
            "rp: {packets} packets of {capture} have link type {link}, which is not supported"
        );
    }
}
