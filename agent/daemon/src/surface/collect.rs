//! The collection of all metrics, family by family in the catalogue's order. Scrapes and exports
//! use this collection, so they show the same values.

use std::fmt;
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use super::agent_metrics;
use super::chain_metrics;
use super::delivery_metrics::{self, Deliveries};
use super::diagnosis_metrics;
use super::field_metrics::FieldMetrics;
use super::foxglove::Viewers;
use super::inside_metrics::{self, Callbacks};
use super::ros2_daemon::Ros2DaemonFigures;
use super::ros2_metrics::{self, TopicRows};
use super::service_metrics;
use super::{link_metrics, robot_metrics, zenoh_metrics};
use crate::agent_facts::SourceKind;
use crate::config::Watch;
use crate::disk_history::DiskHistory;
use crate::events::{AgentEvent, EventLog};
use crate::limit_facts::LimitFigures;
use crate::recording::RecordingFigures;
use crate::settings_cell::{Settings, SettingsCell};
use crate::snapshot_cell::SnapshotCell;
use crate::watches::{Refused, Watches};
use ros2probe_metrics::metric_sink::MetricSink;
use ros2probe_metrics::metric_source::MetricSource;
use ros2probe_metrics::otlp::{Exports, Signal};
use ros2probe_metrics::remote_write;

/// Input of a collection. Each part has its own writer; only the agent's setup and the collection
/// of metrics have all parts.
#[derive(Clone, Debug)]
pub struct MetricSources {
    /// Latest snapshot of the robot and the agent.
    pub latest: Arc<SnapshotCell>,
    /// Display settings and the result of the last reload.
    pub settings: Arc<SettingsCell>,
    /// The event log.
    pub events: Arc<EventLog>,
    /// The limits and their use.
    pub limits: Arc<LimitFigures>,
    /// Counters of recordings.
    pub recordings: Arc<RecordingFigures>,
    /// Counters of exports.
    pub exports: Arc<Exports>,
    /// Counters of remote write.
    pub remote_write: Arc<remote_write::Figures>,
    /// Viewers.
    pub viewers: Arc<Viewers>,
    /// Ports and requests of the ros2 daemon.
    pub ros2_daemon: Arc<Ros2DaemonFigures>,
    /// Metrics of fields of messages.
    pub fields: Arc<FieldMetrics>,
    /// History on disk.
    pub disk_history: Arc<DiskHistory>,
    /// Lines of the log that standard error did not accept.
    pub lost_lines: Arc<AtomicU64>,
}

impl MetricSources {
    /// Creates the sources of an agent that was just configured, and records its start as the first
    /// event.
    #[must_use]
    pub fn new(source: SourceKind, settings: Settings) -> Self {
        let events = EventLog::new();
        events.record(AgentEvent::Started { source });
        Self {
            latest: Arc::new(SnapshotCell::new(source)),
            events: Arc::new(events),
            limits: Arc::new(LimitFigures::new(settings.limits)),
            settings: Arc::new(SettingsCell::new(settings)),
            recordings: Arc::default(),
            exports: Arc::default(),
            remote_write: Arc::default(),
            viewers: Arc::default(),
            ros2_daemon: Arc::default(),
            fields: Arc::default(),
            disk_history: Arc::default(),
            lost_lines: Arc::default(),
        }
    }

    /// Creates the watches of the configuration and of the command line, which report to these
    /// sources.
    ///
    /// # Errors
    ///
    /// Fails if there are too many watches or globs.
    pub fn watches(
        &self,
        configured: Vec<Watch>,
        command_line: Vec<Watch>,
    ) -> Result<Arc<Watches>, Refused> {
        let watches = Watches::new(
            Arc::clone(&self.limits),
            Arc::clone(&self.events),
            Arc::clone(&self.settings),
            Arc::clone(self.latest.bell()),
            configured,
            command_line,
        );
        watches.map(Arc::new)
    }

    /// Returns whether traces are exported. Exemplars refer to exported traces.
    fn has_traces(&self) -> bool {
        let mut signals = self.exports.signals();
        signals.any(|signal| signal == Signal::Traces)
    }
}

impl MetricSource for MetricSources {
    fn collect(&self, sink: &mut MetricSink<'_>, previous: Duration) -> fmt::Result {
        let (state, settings) = (self.latest.state(), self.settings.settings());
        let snapshot = state.known();
        let rows = TopicRows::new(snapshot, &settings);
        let known = snapshot.inside.as_deref();
        let callbacks = Callbacks::new(known);
        let now = Instant::now();

        ros2_metrics::graph(sink, snapshot)?;
        diagnosis_metrics::diagnoses(sink, snapshot)?;
        service_metrics::services(sink, snapshot, &settings)?;
        let has_traces = self.has_traces();
        chain_metrics::chains(sink, snapshot, &settings, has_traces)?;
        let deliveries = Deliveries::new(&rows.shown);
        ros2_metrics::topics(sink, snapshot, &rows.shown, &settings)?;
        delivery_metrics::sums(sink, &rows.shown, &settings)?;
        inside_metrics::topics(sink, snapshot, &rows.shown, &settings)?;
        inside_metrics::callbacks(sink, &callbacks, snapshot, &settings)?;
        ros2_metrics::writers(sink, &rows.shown, &settings)?;
        deliveries.write(sink)?;
        delivery_metrics::sockets(sink, &snapshot.sockets)?;
        link_metrics::links(sink, snapshot)?;
        robot_metrics::clocks(sink, snapshot)?;
        robot_metrics::logs(sink, snapshot)?;
        robot_metrics::diagnostics(sink, snapshot, &settings.diagnostic_values)?;
        robot_metrics::parameters(sink, snapshot)?;
        robot_metrics::transforms(sink, snapshot)?;
        self.fields.write(sink, snapshot)?;
        ros2_metrics::watches(sink, snapshot, &settings.watches)?;
        agent_metrics::identity(sink, &state, now)?;
        agent_metrics::capture(sink, &state)?;
        let inside = state.agent.inside.as_ref();
        inside_metrics::source(sink, inside, known, &callbacks)?;
        zenoh_metrics::zenoh(sink, snapshot)?;
        agent_metrics::model(sink, &state, &rows, deliveries.hidden, &self.limits)?;
        agent_metrics::surface(sink, &state, self.settings.reload(), previous, now)?;
        agent_metrics::kept(sink, &state)?;
        agent_metrics::history(sink, &self.disk_history)?;
        agent_metrics::subscriptions(sink, &state)?;
        agent_metrics::viewers(sink, &self.viewers)?;
        agent_metrics::ros2_daemon(sink, &self.ros2_daemon)?;
        agent_metrics::events(sink, &self.events, self.lost_lines.load(Ordering::Relaxed))?;
        agent_metrics::recordings(sink, &self.recordings)?;
        agent_metrics::exports(sink, &self.exports)?;
        agent_metrics::remote_write(sink, &self.remote_write)?;
        agent_metrics::process(sink)
    }

    fn has_exemplars(&self) -> bool {
        let state = self.latest.state();
        let chains = &state.known().chains;
        let mut of_chains = chains.chains.iter().map(|chain| &chain.exemplars);
        let mut expected = chains.expected.iter().map(|chain| &chain.exemplars);
        self.has_traces()
            && (of_chains.any(|all| !all.is_empty()) || expected.any(|all| !all.is_empty()))
    }

    fn refresh(&self, timeout: Duration) -> Pin<Box<dyn Future<Output = ()> + '_>> {
        Box::pin(self.latest.refresh(timeout))
    }
}
