//! The thread of all exports, with its own runtime.

use std::io;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use opentelemetry::Context;
use opentelemetry_sdk::logs::LogExporter as _;
use opentelemetry_sdk::trace::SpanExporter as _;
use tokio::runtime::{Builder, Runtime};
use tokio_util::sync::CancellationToken;

use super::delivery::{Delivery, Export, Persist};
use super::events::{self, LogExport, Reporter};
use super::exports::{Exports, Signal};
use super::metrics::{Collector, MetricExport};
use super::node_logs::{self, NodeLogQueue, NodeLogs};
use super::own_log::{self, LogQueue};
use super::points::scope;
use super::queued::QueuedDelivery;
use super::reports::Reports;
use super::settings::{Settings, SettingsError, Target};
use super::traces::{self, SpanExport, SpanQueue, Tracing};
use super::transport::Transport;
use crate::event::EventSource;
use crate::export_thread::{ExportThread, Spawn};
use crate::metric_source::MetricSource;

/// Data to export, and the counters of exports.
#[derive(Debug)]
pub struct Inputs {
    /// Metrics.
    pub metrics: Arc<dyn MetricSource>,
    /// Events.
    pub events: Arc<dyn EventSource>,
    /// Spans.
    pub spans: Arc<SpanQueue>,
    /// Lines of the agent's own log, if they are exported.
    pub log: Option<Arc<LogQueue>>,
    /// Messages of the logs of nodes.
    pub node_logs: Arc<NodeLogQueue>,
    /// Counters of exports.
    pub exports: Arc<Exports>,
    /// Directory of the queues on disk, if there is one.
    pub directory: Option<PathBuf>,
}

/// Why the exporter cannot start.
#[derive(Debug, thiserror::Error)]
pub enum StartError {
    /// The settings cannot be applied.
    #[error(transparent)]
    Settings(#[from] SettingsError),
    /// The runtime cannot be created.
    #[error("cannot start the export thread")]
    Runtime(#[source] io::Error),
    /// The thread cannot be created, or it could not drop its privileges.
    #[error("cannot start the export thread")]
    Thread(#[source] io::Error),
}

/// Starts exporting in a thread that may open connections, so the caller can drop that
/// permission.
///
/// # Errors
/// Fails if a connection cannot be configured. An unavailable receiver is not an error.
pub fn start(settings: Settings, inputs: Inputs, spawn: Spawn) -> Result<ExportThread, StartError> {
    // Blocking threads resolve names, at most one per signal.
    let mut runtime = Builder::new_current_thread();
    let runtime = runtime
        .max_blocking_threads(Signal::ALL.len())
        .enable_all()
        .build();
    let runtime = runtime.map_err(StartError::Runtime)?;
    let stop = CancellationToken::new();
    let reports = Reports::dispatch();
    let jobs = tracing::dispatcher::with_default(&reports, || {
        Jobs::new(settings, inputs, &stop, &runtime)
    })?;
    let work = move || {
        // Log lines of this thread are not exported: each could cause the next one.
        let _suppressed = Context::enter_telemetry_suppressed_scope();
        tracing::dispatcher::with_default(&reports, || runtime.block_on(jobs.run()));
        // A pending name resolution must not delay the end.
        runtime.shutdown_background();
    };
    ExportThread::start("otlp", stop, spawn, work).map_err(StartError::Thread)
}

/// Work of the thread.
struct Jobs {
    metrics: Option<(Collector, Delivery<MetricExport>, Duration)>,
    events: Option<(Reporter, QueuedDelivery<LogExport>)>,
    traces: Option<(Tracing, QueuedDelivery<SpanExport>)>,
    log: Option<(Arc<LogQueue>, QueuedDelivery<LogExport>)>,
    node_logs: Option<(NodeLogs, QueuedDelivery<LogExport>)>,
}

impl Jobs {
    fn new(
        settings: Settings,
        inputs: Inputs,
        stop: &CancellationToken,
        runtime: &Runtime,
    ) -> Result<Self, SettingsError> {
        // The runtime must be entered before connections are created.
        let _inside = runtime.enter();
        let resource = &settings.resource;
        let exports = &inputs.exports;
        let metrics = delivery(
            Signal::Metrics,
            settings.metrics,
            exports,
            stop,
            |transport| {
                Ok(MetricExport {
                    exporter: transport.metrics()?,
                    encoded: transport.encoded(),
                })
            },
        )?;
        let queues = Queues {
            directory: inputs.directory.filter(|_| settings.queue_bytes > 0),
            limit: settings.queue_bytes,
        };
        let logs = |transport: &Transport| {
            let mut exporter = transport.logs()?;
            exporter.set_resource(resource);
            Ok(LogExport {
                exporter,
                scope: scope(),
                resource: resource.into(),
                encoded: transport.encoded(),
            })
        };
        let events = delivery(Signal::Events, settings.events, exports, stop, logs)?;
        let log = delivery(Signal::Log, settings.log, exports, stop, logs)?;
        let node_logs = delivery(Signal::NodeLogs, settings.node_logs, exports, stop, logs)?;
        let traces = delivery(
            Signal::Traces,
            settings.traces,
            exports,
            stop,
            |transport| {
                let mut exporter = transport.spans()?;
                exporter.set_resource(resource);
                Ok(SpanExport {
                    exporter,
                    resource: resource.into(),
                    encoded: transport.encoded(),
                })
            },
        )?;
        let collector = || Collector::new(inputs.metrics, resource, SystemTime::now());
        let tracing = Tracing::new(settings.host, inputs.spans);
        let reporter = || Reporter::new(inputs.events);
        Ok(Self {
            metrics: metrics.map(|delivery| (collector(), delivery, settings.interval)),
            events: queues.with(reporter(), events),
            traces: queues.with(tracing, traces),
            log: inputs.log.and_then(|lines| queues.with(lines, log)),
            node_logs: queues.with(NodeLogs::new(inputs.node_logs), node_logs),
        })
    }

    async fn run(self) {
        let metrics = async {
            if let Some((collector, delivery, interval)) = self.metrics {
                collector.run(delivery, interval).await;
            }
        };
        let events = async {
            if let Some((reporter, delivery)) = self.events {
                delivery.run(reporter, events::BATCH_DELAY).await;
            }
        };
        let traces = async {
            if let Some((tracing, delivery)) = self.traces {
                delivery.run(tracing, traces::BATCH_DELAY).await;
            }
        };
        let log = async {
            if let Some((queue, delivery)) = self.log {
                delivery.run(&*queue, own_log::BATCH_DELAY).await;
            }
        };
        let node_logs = async {
            if let Some((logs, delivery)) = self.node_logs {
                delivery.run(logs, node_logs::BATCH_DELAY).await;
            }
        };
        tokio::join!(metrics, events, traces, log, node_logs);
    }
}

/// Where queues on disk are.
struct Queues {
    directory: Option<PathBuf>,
    limit: u64,
}

impl Queues {
    /// Adds a queue on disk to a delivery. Returns it with its input.
    fn with<I, E: Persist>(
        &self,
        input: I,
        delivery: Option<Delivery<E>>,
    ) -> Option<(I, QueuedDelivery<E>)> {
        let delivery = delivery?;
        let directory = self.directory.as_deref();
        let kept = directory.and_then(|directory| delivery.open_queue(directory, self.limit));
        Some((input, QueuedDelivery::new(delivery, kept)))
    }
}

/// Returns the delivery of a signal, if it has a target.
fn delivery<E: Export>(
    signal: Signal,
    target: Option<Target>,
    exports: &Arc<Exports>,
    stop: &CancellationToken,
    exporter: impl FnOnce(&Transport) -> Result<E, SettingsError>,
) -> Result<Option<Delivery<E>>, SettingsError> {
    let Some(target) = target else {
        return Ok(None);
    };
    let transport = Transport::new(target)?;
    let exporter = exporter(&transport)?;
    Ok(Some(Delivery::new(
        exporter,
        signal,
        transport.endpoint(),
        Arc::clone(exports),
        stop.clone(),
    )))
}
