//! The one walk over what is pinned to the board, family by family in the catalogue's order. Scrapes
//! and exports both take it, so they show the same.

use std::fmt;
use std::time::{Duration, Instant};

use super::agent;
use super::board::Board;
use super::deliveries::{self, Deliveries};
use super::diagnoses;
use super::page::Page;
use super::robot::{self, Rows};
use ros2probe_model::snapshot::Snapshot;

/// Writes everything to `page`; `previous` is how long that took the last time.
pub(super) fn walk(page: &mut Page<'_>, board: &Board, previous: Duration) -> fmt::Result {
    let (state, settings) = (board.state(), board.settings());
    let nothing = Snapshot::default();
    let snapshot = state.snapshot.as_ref().unwrap_or(&nothing);
    let rows = Rows::new(snapshot, &settings);
    let now = Instant::now();

    robot::graph(page, snapshot)?;
    diagnoses::diagnoses(page, snapshot)?;
    let deliveries = Deliveries::new(&rows.shown);
    robot::topics(page, &rows.shown, &settings)?;
    deliveries::sums(page, &rows.shown, &settings)?;
    robot::writers(page, &rows.shown, &settings)?;
    deliveries.write(page)?;
    deliveries::sockets(page, &snapshot.sockets)?;
    robot::watches(page, snapshot, &settings.watches)?;
    agent::identity(page, &state, now)?;
    agent::capture(page, &state)?;
    agent::model(page, &state, &rows, deliveries.hidden, board.limits())?;
    agent::surface(page, &state, board.reload(), previous, now)?;
    agent::kept(page, &state)?;
    agent::subscriptions(page, &state)?;
    agent::events(page, board.events(), board.lost_lines())?;
    agent::recordings(page, board.recordings())?;
    agent::exports(page, board.exports())?;
    agent::process(page)
}
