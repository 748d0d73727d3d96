//! The thread on which everything is exported, with a runtime of its own.

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

/// Ending takes no longer, whatever the receiver does.
const ENDING: Duration = Duration::from_secs(2);

/// The running thread.
pub struct Exporter {
    thread: JoinHandle<()>,
    stop: CancellationToken,
    ended: oneshot::Receiver<()>,
}

/// Why there is none.
#[derive(Debug, thiserror::Error)]
pub enum StartError {
    /// What is asked for cannot be done.
    #[error(transparent)]
    Settings(#[from] SettingsError),
    /// The system has no thread for it.
    #[error("cannot start the export thread")]
    Runtime(#[source] std::io::Error),
    /// Likewise, or it has privileges that it should not have.
    #[error("cannot start the export thread")]
    Thread(#[from] SpawnError),
}

impl Exporter {
    /// Exports from now on, in a thread that may make connections; the caller
    /// need not keep that.
    ///
    /// # Errors
    /// When a connection cannot be set up; that the receiver is not there is no error.
    pub fn start(
        settings: Settings,
        sources: &MetricSources,
        spans: Arc<SpanQueue>,
    ) -> Result<Self, StartError> {
        // Threads that block look names up, one for each signal at most.
        let mut runtime = Builder::new_current_thread();
        let runtime = runtime.max_blocking_threads(3).enable_all().build();
        let runtime = runtime.map_err(StartError::Runtime)?;
        let stop = CancellationToken::new();
        let jobs = Jobs::new(settings, sources, spans, &stop, &runtime)?;
        let (tell, ended) = oneshot::channel();
        let thread = std::thread::Builder::new().name("otlp".to_owned());
        let thread = privilege::spawn(Role::Export, thread, move || {
            runtime.block_on(jobs.run());
            // A name that is being looked up must not hold the end up.
            runtime.shutdown_background();
            let _ = tell.send(());
        })?;
        Ok(Self {
            thread,
            stop,
            ended,
        })
    }

    /// Exports what there is a last time and ends, within two seconds.
    pub async fn finish(self) {
        self.stop.cancel();
        if timeout(ENDING, self.ended).await.is_err() {
            tracing::warn!("the last export did not end in time");
        } else if self.thread.join().is_err() {
            tracing::error!("the exporting thread panicked");
        }
    }
}

/// What the thread does.
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
        // Connections belong to the runtime from their beginning.
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
