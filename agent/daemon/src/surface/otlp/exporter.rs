//! The thread of all exports, with its own runtime.

use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::{Duration, SystemTime};

use tokio::runtime::{Builder, Runtime};
use tokio::sync::oneshot;
use tokio::time::timeout;
use tokio_util::sync::CancellationToken;

use super::client::Client;
use super::events::Reporter;
use super::exports::Signal;
use super::metrics::Collector;
use super::settings::{Settings, SettingsError, Target};
use super::signal_sender::SignalSender;
use super::traces::{SpanQueue, Tracing};
use crate::privilege::{self, Role, SpawnError};
use crate::surface::collect::MetricSources;

/// Longest time to stop, whatever the receiver does.
const ENDING: Duration = Duration::from_secs(2);

/// The running thread.
pub struct Exporter {
    thread: JoinHandle<()>,
    stop: CancellationToken,
    ended: oneshot::Receiver<()>,
}

/// Why the exporter cannot start.
#[derive(Debug, thiserror::Error)]
pub enum StartError {
    /// The settings cannot be applied.
    #[error(transparent)]
    Settings(#[from] SettingsError),
    /// The runtime cannot be created.
    #[error("cannot start the export thread")]
    Runtime(#[source] std::io::Error),
    /// The thread cannot be created, or it could not drop its privileges.
    #[error("cannot start the export thread")]
    Thread(#[from] SpawnError),
}

impl Exporter {
    /// Starts exporting in a thread that may open connections, so the caller can drop that
    /// permission.
    ///
    /// # Errors
    /// Fails if a connection cannot be configured. An unavailable receiver is no error.
    pub fn start(
        settings: Settings,
        sources: &MetricSources,
        spans: Arc<SpanQueue>,
    ) -> Result<Self, StartError> {
        // Blocking threads resolve names, at most one per signal.
        let mut runtime = Builder::new_current_thread();
        let runtime = runtime.max_blocking_threads(3).enable_all().build();
        let runtime = runtime.map_err(StartError::Runtime)?;
        let stop = CancellationToken::new();
        let jobs = Jobs::new(settings, sources, spans, &stop, &runtime)?;
        let (tell, ended) = oneshot::channel();
        let thread = std::thread::Builder::new().name("otlp".to_owned());
        let thread = privilege::spawn(Role::Export, thread, move || {
            runtime.block_on(jobs.run());
            // A pending name resolution must not delay the end.
            runtime.shutdown_background();
            let _ = tell.send(());
        })?;
        Ok(Self {
            thread,
            stop,
            ended,
        })
    }

    /// Exports a last time and stops, within two seconds.
    pub async fn finish(self) {
        self.stop.cancel();
        if timeout(ENDING, self.ended).await.is_err() {
            tracing::warn!("the last export did not end in time");
        } else if self.thread.join().is_err() {
            tracing::error!("the exporting thread panicked");
        }
    }
}

/// Work of the thread.
struct Jobs {
    spans: Arc<SpanQueue>,
    metrics: Option<(Collector, SignalSender, Duration)>,
    events: Option<(Reporter, SignalSender)>,
    traces: Option<(Tracing, SignalSender)>,
}

impl Jobs {
    fn new(
        settings: Settings,
        sources: &MetricSources,
        spans: Arc<SpanQueue>,
        stop: &CancellationToken,
        runtime: &Runtime,
    ) -> Result<Self, SettingsError> {
        // Connections need the runtime from their creation on.
        let _inside = runtime.enter();
        let sender = |signal: Signal, target: Option<Target>| {
            let client =
                target.map(|target| Client::new(signal, target, Arc::clone(&sources.exports)));
            Ok(client
                .transpose()?
                .map(|client| SignalSender::new(client, stop.clone())))
        };
        let metrics = sender(Signal::Metrics, settings.metrics)?;
        let events = sender(Signal::Events, settings.events)?;
        let collector = || {
            Collector::new(
                sources.clone(),
                settings.resource.clone(),
                SystemTime::now(),
            )
        };
        let traces = sender(Signal::Traces, settings.traces)?;
        let tracing = || Tracing::new(settings.resource.clone(), settings.host);
        Ok(Self {
            spans,
            traces: traces.map(|sender| (tracing(), sender)),
            metrics: metrics.map(|sender| (collector(), sender, settings.interval)),
            events: events.map(|sender| {
                (
                    Reporter::new(Arc::clone(&sources.events), settings.resource.clone()),
                    sender,
                )
            }),
        })
    }

    async fn run(self) {
        let metrics = async {
            if let Some((collector, sender, interval)) = self.metrics {
                collector.run(sender, interval).await;
            }
        };
        let events = async {
            if let Some((reporter, sender)) = self.events {
                reporter.run(sender).await;
            }
        };
        let traces = async {
            if let Some((tracing, sender)) = self.traces {
                tracing.run(sender, &self.spans).await;
            }
        };
        tokio::join!(metrics, events, traces);
    }
}
