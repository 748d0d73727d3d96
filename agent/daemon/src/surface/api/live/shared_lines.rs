//! Lines of one state, formatted once for all streams. Each part stores the round in which it last
//! changed, and a stream takes the parts that changed since its own last round.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Instant;

use bytes::Bytes;

use super::super::body_stream::write_line;
use super::super::index::Index;
use super::findings::{FindingInputs, dropped, findings};
use super::structure::Ids;
use super::values::{Figures, recent_losses, totals};
use crate::agent_facts::Ability as Able;
use crate::agent_facts::SourceKind;
use crate::snapshot_cell::State;
use crate::watches::ActiveWatches;
use ros2probe_api::live::{Ability, Agent, Graph, Line, Progress, Row, Totals, Values};
use ros2probe_model::measure::history::Past;
use ros2probe_model::report::snapshot::Snapshot;

/// The lines of the current state, with the rounds of their last changes.
#[derive(Debug, Default)]
pub(super) struct SharedLines {
    /// The run of the agent that they describe.
    run: String,
    /// Number of the current round.
    round: u64,
    state: Option<Arc<State>>,
    past: Option<Arc<Past>>,
    in_force: Option<Arc<ActiveWatches>>,
    pub(super) ids: Ids,
    structure: Part,
    agent: Part,
    findings: Part,
    rows: BTreeMap<u32, (u64, Row)>,
    at: f64,
    totals: Totals,
    progress: Option<Progress>,
}

/// A line that is sent again after each change.
#[derive(Debug, Default)]
struct Part {
    changed: u64,
    text: Bytes,
}

impl Part {
    fn set(&mut self, line: &Line<'_>, round: u64) {
        let mut text = Vec::with_capacity(self.text.len());
        write_line(&mut text, line);
        if self.text != text {
            (self.changed, self.text) = (round, text.into());
        }
    }
}

impl SharedLines {
    /// Forgets all lines if they are of another run of the agent.
    pub(super) fn begin_run(&mut self, run: String) {
        if self.run != run {
            *self = Self {
                run,
                ..Self::default()
            };
        }
    }

    /// Updates the lines to a new state; does nothing if the state is the current one.
    pub(super) fn update(
        &mut self,
        state: &Arc<State>,
        past: &Arc<Past>,
        in_force: &Arc<ActiveWatches>,
    ) {
        let is_same = self
            .state
            .as_ref()
            .is_some_and(|own| Arc::ptr_eq(own, state))
            && self.past.as_ref().is_some_and(|own| Arc::ptr_eq(own, past))
            && self
                .in_force
                .as_ref()
                .is_some_and(|own| Arc::ptr_eq(own, in_force));
        if is_same {
            return;
        }
        self.round += 1;
        let snapshot = state.known();
        let index = Index::new(snapshot);
        self.update_structure(snapshot, &index, in_force);
        self.update_agent(state, past, in_force);
        let figures = Figures {
            snapshot,
            index: &index,
            past,
            watchlist: in_force.watchlist(),
            observes_shared_memory: state.agent.shared_memory.is_some(),
            lost: recent_losses(past),
        };
        self.update_rows(figures.rows(&self.ids));
        self.at = snapshot.time().seconds();
        self.totals = totals(snapshot, past);
        let agent = &state.agent;
        self.progress = (agent.source == SourceKind::Replay).then(|| {
            let pace = &agent.replay_pace;
            Progress(
                agent.replayed,
                agent.finished.into(),
                pace.is_paused().into(),
                pace.times(agent.replay_speed),
            )
        });
        self.state = Some(Arc::clone(state));
        self.past = Some(Arc::clone(past));
        self.in_force = Some(Arc::clone(in_force));
    }

    /// Updates the line of the graph.
    fn update_structure<'a>(
        &mut self,
        snapshot: &'a Snapshot,
        index: &Index<'a>,
        in_force: &ActiveWatches,
    ) {
        let round = self.round;
        let version = self.structure.changed;
        let graph = self.ids.structure(snapshot, index, in_force, round);
        let mut line = Line::Graph(Graph { version, ..graph });
        self.structure.set(&line, round);
        if self.structure.changed == round {
            // The version is the round, so a changed graph has a new version.
            if let Line::Graph(graph) = &mut line {
                graph.version = round;
            }
            self.structure.set(&line, round);
        }
    }

    /// Updates the lines of the agent and of the findings.
    fn update_agent(&mut self, state: &State, past: &Past, in_force: &ActiveWatches) {
        let (snapshot, agent, round) = (state.known(), &state.agent, self.round);
        let unready = state.ready(Instant::now()).err();
        let unready = unready.map(|reason| reason.to_string());
        let abilities = Able::ALL.iter().map(|ability| {
            let reason = agent
                .missing_abilities
                .iter()
                .find(|(blind, _)| blind == ability);
            Ability(
                ability.label().into(),
                agent.abilities.contains(ability).into(),
                reason.map(|(_, reason)| reason.into()),
            )
        });
        let line = Line::Agent(Agent {
            ready: unready.is_none(),
            reason: unready.clone(),
            finished: agent.finished,
            dropped: dropped(agent),
            unknown_writers: snapshot.unknown_writers.len(),
            topics_rejected: snapshot.topics_rejected,
            abilities: abilities.collect(),
            watches: in_force.entries().len(),
        });
        self.agent.set(&line, round);
        let list = findings(&FindingInputs {
            snapshot,
            agent,
            past,
            ids: &self.ids,
            unready: unready.as_deref(),
        });
        self.findings.set(&Line::Findings(list), round);
    }

    /// Updates the rows of topics. A topic that is no longer measured gets an empty row once, which
    /// clears it on the page.
    fn update_rows(&mut self, rows: BTreeMap<u32, Row>) {
        let round = self.round;
        let emptied = self.rows.keys().filter(|id| !rows.contains_key(id));
        let emptied = emptied.map(|id| (*id, Row::empty(*id)));
        let emptied: Vec<_> = emptied.collect();
        for (id, row) in rows.into_iter().chain(emptied) {
            let (changed, own) = self.rows.entry(id).or_insert((round, row));
            if *own != row {
                (*changed, *own) = (round, row);
            }
        }
        let topics = self.ids.topics();
        self.rows.retain(|id, _| topics.contains(id));
    }

    /// Returns the lines of the graph, the agent and the findings that changed since the round
    /// `seen`.
    pub(super) fn parts(&self, seen: u64) -> impl Iterator<Item = &Bytes> {
        let parts = [&self.structure, &self.agent, &self.findings];
        let newer = parts.into_iter().filter(move |part| part.changed > seen);
        newer.map(|part| &part.text)
    }

    /// Returns the values that changed since the round `seen`.
    pub(super) fn values(&self, seen: u64) -> Values {
        let newer = self.rows.values().filter(|(changed, _)| *changed > seen);
        Values {
            t: self.at,
            topics: newer.map(|(_, row)| *row).collect(),
            totals: self.totals,
            replay: self.progress,
        }
    }

    /// Returns the number of the current round.
    pub(super) const fn round(&self) -> u64 {
        self.round
    }
}
