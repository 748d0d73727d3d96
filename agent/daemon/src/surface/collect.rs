//! The one collection of what is pinned to the board, family by family in the catalogue's order. Scrapes
//! and exports both use it, so they show the same.

use std::fmt;
use std::time::{Duration, Instant};

use super::agent_metrics;
use super::board::Board;
use super::delivery_metrics::{self, Deliveries};
use super::diagnosis_metrics;
use super::metric_sink::MetricSink;
use super::ros2_metrics::{self, TopicRows};
use ros2probe_model::snapshot::Snapshot;

/// Writes everything to `sink`; `previous` is how long that took the last time.
pub(super) fn collect(sink: &mut MetricSink<'_>, board: &Board, previous: Duration) -> fmt::Result {
    let (state, settings) = (board.state(), board.settings());
    let nothing = Snapshot::default();
    let snapshot = state.snapshot.as_ref().unwrap_or(&nothing);
    let rows = TopicRows::new(snapshot, &settings);
    let now = Instant::now();

    ros2_metrics::graph(sink, snapshot)?;
    diagnosis_metrics::diagnoses(sink, snapshot)?;
    let deliveries = Deliveries::new(&rows.shown);
    ros2_metrics::topics(sink, &rows.shown, &settings)?;
    delivery_metrics::sums(sink, &rows.shown, &settings)?;
    ros2_metrics::writers(sink, &rows.shown, &settings)?;
    deliveries.write(sink)?;
    delivery_metrics::sockets(sink, &snapshot.sockets)?;
    ros2_metrics::watches(sink, snapshot, &settings.watches)?;
    agent_metrics::identity(sink, &state, now)?;
    agent_metrics::capture(sink, &state)?;
    agent_metrics::model(sink, &state, &rows, deliveries.hidden, board.limits())?;
    agent_metrics::surface(sink, &state, board.reload(), previous, now)?;
    agent_metrics::kept(sink, &state)?;
    agent_metrics::subscriptions(sink, &state)?;
    agent_metrics::events(sink, board.events(), board.lost_lines())?;
    agent_metrics::recordings(sink, board.recordings())?;
    agent_metrics::exports(sink, board.exports())?;
    agent_metrics::process(sink)
}
