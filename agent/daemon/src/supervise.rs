//! Supervises the working thread: signals, reloads, the metrics listener, the service manager with
//! its watchdog, and an orderly end.

use std::borrow::Cow;
use std::path::PathBuf;
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use crate::config::{Config, ConfigError};
use crate::events::SourceMonitor;
use crate::events::{AgentEvent, EventLog};
use crate::privilege::{self, Role, SpawnError, Unprivileged};
use crate::run::{Run, RunError};
use crate::settings_cell::Settings;
use crate::snapshot_cell::SnapshotCell;
use crate::surface::MetricSources;
use crate::surface::api;
use crate::surface::api::reload::{NotReloaded, Reloads};
use crate::surface::foxglove;
use crate::surface::http::Server;
use crate::surface::ros2_daemon::{Ros2Daemon, Task};
use crate::watches::Watches;
use anyhow::{Context as _, Result, anyhow};
use ros2probe_api::health::Reloaded;
use ros2probe_metrics::export_thread::ExportThread;
use sd_notify::NotifyState;
use tokio::signal::unix::{Signal, SignalKind, signal};
use tokio::sync::{Notify, oneshot};
use tokio::task::JoinSet;
use tokio::time::{Interval, MissedTickBehavior, interval, timeout};
use tokio_util::sync::CancellationToken;

use crate::logging::Log;

/// Polling intervals of readiness until the agent is ready, and of the watchdog afterwards.
const STARTUP_TICK_INTERVAL: Duration = Duration::from_millis(100);
const TICK_INTERVAL: Duration = Duration::from_secs(2);
/// Maximum time for answers in progress and for the working thread's last round.
const DRAIN_TIMEOUT: Duration = Duration::from_secs(3);

/// Supervisor of an agent.
pub(crate) struct Supervisor {
    pub(crate) sources: MetricSources,
    /// Configuration at the start, before overrides of the command line.
    pub(crate) config: Config,
    /// File of the configuration, which SIGHUP and clients reload.
    pub(crate) file: Option<PathBuf>,
    pub(crate) watches: Arc<Watches>,
    pub(crate) reloads: Reloads,
    pub(crate) stop: CancellationToken,
    pub(crate) log: Log,
    /// Exporter of metrics, if one is configured.
    pub(crate) exporters: Vec<ExportThread>,
    /// Thread of the ros2 daemon, if it is configured.
    pub(crate) ros2_daemon: Option<Ros2Daemon>,
}

/// Bound listeners that do not answer requests yet.
pub(crate) struct Surfaces {
    pub(crate) metrics: Option<Server>,
    pub(crate) control: api::Server,
    pub(crate) viewers: Option<foxglove::Server>,
    pub(crate) context: api::Context,
    /// Proof that the serving thread has no privilege.
    pub(crate) unprivileged: Unprivileged,
}

/// End of a thread; an error if it panicked.
type Ended = Result<Result<()>, oneshot::error::RecvError>;

/// Signals, registered before the working thread starts.
struct Signals {
    terminate: Signal,
    interrupt: Signal,
    hangup: Signal,
    /// SIGUSR1, which writes all snapshots.
    snapshot: Signal,
}

/// Thread that answers requests, waiting for its listeners. The watchdog runs on another thread, so
/// that a slow answer cannot delay it.
pub(crate) struct Responder {
    begin: oneshot::Sender<Surfaces>,
    ended: oneshot::Receiver<Result<()>>,
}

/// Working thread that waits for its task, and the notification of its end.
pub(crate) struct Worker {
    thread: JoinHandle<()>,
    begin: oneshot::Sender<Run>,
    ended: oneshot::Receiver<Result<(), RunError>>,
}

/// Working thread in operation.
struct Working {
    thread: JoinHandle<()>,
    ended: oneshot::Receiver<Result<(), RunError>>,
}

impl Supervisor {
    /// Runs until a signal or a failure, or with `once` until the capture ends, and logs the end.
    pub(crate) async fn run(
        mut self,
        worker: Worker,
        run: Run,
        responder: Responder,
        surfaces: Surfaces,
        once: bool,
    ) -> Result<()> {
        let mut signals = Signals::listen().context("cannot listen to signals")?;
        let mut worker = worker.begin(run);
        let snapshots = Arc::clone(&surfaces.context.snapshots);
        let mut serving = responder.begin(surfaces);
        let (mut ros2_daemon, reloaded) = self.begin_ros2_daemon();
        let mut watchdog = Watchdog::new();
        let mut tick = ticks(STARTUP_TICK_INTERVAL);
        let (mut working, mut answering) = (true, true);

        let outcome = loop {
            tokio::select! {
                _ = signals.terminate.recv() => break Ok("SIGTERM"),
                _ = signals.interrupt.recv() => break Ok("SIGINT"),
                _ = signals.hangup.recv() => {
                    if self.reload().is_ok() {
                        reloaded.notify_one();
                    }
                }
                _ = signals.snapshot.recv() => snapshots.write_all(),
                Some(answer) = self.reloads.next() => {
                    let outcome = self.reload();
                    if outcome.is_ok() {
                        reloaded.notify_one();
                    }
                    // The client may have disconnected.
                    let _ = answer.send(outcome);
                }
                ended = &mut ros2_daemon => {
                    let died = |_| Err(anyhow!("the thread of the ros2 daemon died"));
                    let ended = ended.unwrap_or_else(died);
                    break Err(ended.err().unwrap_or_else(|| anyhow!("the ros2 daemon ended unexpectedly")));
                }
                ended = &mut serving => {
                    answering = false;
                    let died = |_| Err(anyhow!("the thread that answers requests died"));
                    let ended = ended.unwrap_or_else(died);
                    break Err(ended.err().unwrap_or_else(|| anyhow!("a listener ended unexpectedly")));
                }
                ended = &mut worker.ended, if working => {
                    working = false;
                    match ended {
                        Ok(Ok(())) if once => break Ok("end of capture"),
                        Ok(Ok(())) => {
                            tracing::info!("the capture has ended; its final state remains");
                        }
                        Ok(Err(error)) => break Err(error.into()),
                        // The sender was dropped without a result: the panic is in the log.
                        Err(_) => break Err(anyhow!("the working thread panicked")),
                    }
                }
                _ = tick.tick() => {
                    if watchdog.check(&self.sources.latest, &self.sources.events) {
                        tick = ticks(watchdog.period.map_or(TICK_INTERVAL, |period| period.min(TICK_INTERVAL)));
                    }
                }
            }
        };

        let _ = sd_notify::notify(&[NotifyState::Stopping]);
        self.stop.cancel();
        self.sources.latest.bell().ring();
        let drained = timeout(DRAIN_TIMEOUT, async {
            if working {
                let _ = (&mut worker.ended).await;
            }
            if answering {
                let _ = (&mut serving).await;
            }
        });
        let drained = drained.await.is_ok();
        if drained && worker.thread.join().is_err() {
            tracing::error!("the working thread panicked while shutting down");
        }
        // Exports end after the working thread, whose last state is exported.
        self.exporters.iter().for_each(ExportThread::stop);
        for exporter in self.exporters.drain(..) {
            exporter.finish().await;
        }
        match outcome {
            Ok(reason) => {
                tracing::info!(reason, drained, "ended");
                Ok(())
            }
            Err(error) => Err(error),
        }
    }

    /// Lets the ros2 daemon answer, if it is configured. Returns a future that resolves if its
    /// thread ends, and the notification of reloads.
    fn begin_ros2_daemon(&mut self) -> (impl Future<Output = Ended> + Unpin + use<>, Arc<Notify>) {
        let reloaded = Arc::<Notify>::default();
        let ended = self.ros2_daemon.take().map(|daemon| {
            daemon.begin(Task {
                latest: Arc::clone(&self.sources.latest),
                watches: Arc::clone(&self.watches),
                figures: Arc::clone(&self.sources.ros2_daemon),
                distro: self.config.ros2_daemon.distro,
                reloaded: Arc::clone(&reloaded),
                stop: self.stop.clone(),
            })
        });
        let ended = async move {
            match ended {
                Some(ended) => ended.await,
                None => std::future::pending().await,
            }
        };
        (Box::pin(ended), reloaded)
    }

    /// Reloads the configuration. A mistake leaves everything unchanged.
    fn reload(&mut self) -> Result<Reloaded, NotReloaded> {
        let Some(file) = &self.file else {
            tracing::warn!("nothing to reload: the agent was started without a configuration file");
            return Err(NotReloaded::NoFile);
        };
        if let Ok(now) = NotifyState::monotonic_usec_now() {
            let _ = sd_notify::notify(&[NotifyState::Reloading, now]);
        }
        let done = Config::load(file)
            .map_err(|error| mistakes(&error))
            .and_then(|config| self.apply_reload(&config));
        let _ = sd_notify::notify(&[NotifyState::Ready]);
        done.map_err(|mistakes| {
            let error = mistakes.join("\n");
            self.sources
                .events
                .record(AgentEvent::ReloadFailed { error });
            self.sources.settings.reload_failed();
            for line in &mistakes {
                tracing::error!(error = line, "the configuration was not reloaded");
            }
            NotReloaded::Mistakes(mistakes)
        })
    }

    fn apply_reload(&mut self, config: &Config) -> Result<Reloaded, Vec<String>> {
        let configured = self.watches.configure(config.watches.clone());
        configured.map_err(|error| vec![error.to_string()])?;
        let needs_restart = self.config.needs_restart(config);
        for key in &needs_restart {
            tracing::warn!(key, "the change takes effect after a restart");
        }
        self.log.set(config.log);
        let in_force = self.watches.active();
        let watches = in_force.watchlist().watches().len();
        self.sources.events.record(AgentEvent::Reloaded { watches });
        self.sources.settings.reloaded(&Settings {
            // The caps of the start stay in force.
            limits: *self.sources.limits.caps(),
            ..Settings::new(config)
        });
        let watches = in_force.entries().len();
        tracing::info!(watches, "the configuration was reloaded");
        Ok(Reloaded {
            watches,
            needs_restart: needs_restart.into_iter().map(Cow::Borrowed).collect(),
        })
    }
}

fn ticks(period: Duration) -> Interval {
    let mut ticks = interval(period);
    ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    ticks
}

/// Returns the mistakes, one per line.
fn mistakes(error: &ConfigError) -> Vec<String> {
    let mut text = error.to_string();
    let mut cause = std::error::Error::source(error);
    while let Some(error) = cause {
        text = format!("{text}: {error}");
        cause = error.source();
    }
    text.lines().map(str::to_owned).collect()
}

impl Signals {
    fn listen() -> std::io::Result<Self> {
        Ok(Self {
            terminate: signal(SignalKind::terminate())?,
            interrupt: signal(SignalKind::interrupt())?,
            hangup: signal(SignalKind::hangup())?,
            snapshot: signal(SignalKind::user_defined1())?,
        })
    }
}

impl Responder {
    /// Starts the thread, already confined to its role.
    pub(crate) fn start() -> Result<Self, SpawnError> {
        let (begin, begins) = oneshot::channel::<Surfaces>();
        let (report, ended) = oneshot::channel();
        let thread = std::thread::Builder::new().name("http".to_owned());
        privilege::spawn(Role::Serve, thread, move || {
            // An agent that fails to start, or prints a report, answers no requests.
            if let Ok(surfaces) = begins.blocking_recv() {
                let _ = report.send(surfaces.answer());
            }
        })?;
        Ok(Self { begin, ended })
    }

    fn begin(self, surfaces: Surfaces) -> oneshot::Receiver<Result<()>> {
        // If the thread has died, the next wait reports it.
        let _ = self.begin.send(surfaces);
        self.ended
    }
}

impl Surfaces {
    /// Answers requests until the agent stops.
    fn answer(self) -> Result<()> {
        // Capabilities belong to threads, so those of this thread are verified, too.
        let _: (Unprivileged, Unprivileged) = (self.unprivileged, Unprivileged::verify()?);
        // Blocking threads create bags for clients; the unit allows 32 threads in total.
        let runtime = tokio::runtime::Builder::new_current_thread()
            .max_blocking_threads(4)
            .enable_all()
            .build()
            .context("cannot start the runtime of the listeners")?;
        let stop = self.context.stop.clone();
        let served = runtime.block_on(async {
            let mut serving = JoinSet::new();
            if let Some(metrics) = self.metrics {
                serving.spawn(metrics.serve(stop.clone()));
            }
            self.control.serve(&self.context, &mut serving)?;
            match self.viewers {
                Some(viewers) => {
                    serving.spawn(viewers.serve(self.context));
                }
                None => drop(self.context),
            }
            tokio::select! {
                () = stop.cancelled() => {}
                Some(ended) = serving.join_next() => {
                    ended??;
                    return Err(anyhow!("a listener ended unexpectedly"));
                }
            }
            while serving.join_next().await.is_some() {}
            Ok(())
        });
        // The recording service waits for unfinished bags.
        runtime.shutdown_background();
        served
    }
}

impl Worker {
    /// Starts the thread, already confined to its role, so that the caller can drop its own
    /// privileges.
    pub(crate) fn start(role: Role) -> Result<Self, SpawnError> {
        let (begin, begins) = oneshot::channel::<Run>();
        let (report, ended) = oneshot::channel();
        let thread = std::thread::Builder::new().name("capture".to_owned());
        let thread = privilege::spawn(role, thread, move || {
            // An agent that fails to start has no work.
            if let Ok(run) = begins.blocking_recv() {
                let _ = report.send(run.run());
            }
        })?;
        Ok(Self {
            thread,
            begin,
            ended,
        })
    }

    /// Runs until the capture ends.
    pub(crate) fn finish(self, run: Run) -> Result<()> {
        let ended = self.begin(run).ended.blocking_recv();
        Ok(ended.map_err(|_| anyhow!("the working thread panicked"))??)
    }

    fn begin(self, run: Run) -> Working {
        // If the thread has died, the next wait reports it.
        let _ = self.begin.send(run);
        Working {
            thread: self.thread,
            ended: self.ended,
        }
    }
}

/// Notifies the service manager while the agent observes.
struct Watchdog {
    period: Option<Duration>,
    last_notification: Option<Instant>,
    ready: bool,
    last_state: SourceMonitor,
}

impl Watchdog {
    fn new() -> Self {
        // A third of the allowed time, so that one late round is tolerated.
        let period = sd_notify::watchdog_enabled().map(|allowed| allowed / 3);
        Self {
            period,
            last_notification: None,
            ready: false,
            last_state: SourceMonitor::default(),
        }
    }

    /// Feeds the watchdog if the capture has progressed. Returns whether the agent has just
    /// started.
    fn check(&mut self, latest: &SnapshotCell, events: &EventLog) -> bool {
        let now = Instant::now();
        let state = latest.own_state();
        let ready = state.ready(now);
        for event in self
            .last_state
            .check(&ready, state.agent.reattachments, now)
        {
            events.record(event);
        }
        // A missing target delays neither the start nor the watchdog, since a restart cannot
        // restore it, and it may wait for this service.
        if state.progresses(now).is_err() || (!self.ready && state.has_started(now).is_err()) {
            return false;
        }
        let first = !self.ready;
        if first {
            self.ready = true;
            match &ready {
                Ok(()) => tracing::info!("ready"),
                Err(reason) => tracing::warn!(%reason, "started, but not ready"),
            }
            let _ = sd_notify::notify(&[NotifyState::Ready]);
        }
        let Some(period) = self.period else {
            return first;
        };
        if self
            .last_notification
            .is_none_or(|fed| now.saturating_duration_since(fed) >= period)
        {
            self.last_notification = Some(now);
            let _ = sd_notify::notify(&[NotifyState::Watchdog]);
        }
        first
    }
}
