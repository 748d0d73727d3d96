//! The agent's facts about topics, requested for all topics together and cached for a second.

use std::collections::HashMap;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use ros2probe::client::Agent;
use ros2probe_api::participants::ParticipantList;
use ros2probe_api::topics::TopicList;
use ros2probe_daemon::recording::{DiscoveredTopic, GraphSnapshot, by_name};

/// Maximum wait for an answer about the graph, and maximum age of the answer.
const GRAPH_TIMEOUT: Duration = Duration::from_secs(2);
const GRAPH_AGE: Duration = Duration::from_secs(1);

/// Cached facts about topics.
pub(super) struct GraphCache<'a> {
    agent: &'a Agent,
    domain_id: u32,
    known: HashMap<String, DiscoveredTopic>,
    pub(super) graph: GraphSnapshot,
    at: Option<Instant>,
}

impl<'a> GraphCache<'a> {
    pub(super) fn new(agent: &'a Agent, domain_id: u32) -> Self {
        Self {
            agent,
            domain_id,
            known: HashMap::new(),
            graph: GraphSnapshot::default(),
            at: None,
        }
    }

    /// Returns facts about these topics; the last known facts if the agent no longer answers.
    pub(super) fn of(&mut self, names: &[String]) -> Vec<DiscoveredTopic> {
        let is_old = self.at.is_none_or(|at| at.elapsed() > GRAPH_AGE);
        if is_old || names.iter().any(|name| !self.known.contains_key(name)) {
            self.refresh();
        }
        let known = names.iter().map(|name| self.known.get(name).cloned());
        known.map(Option::unwrap_or_default).collect()
    }

    pub(super) fn latest_snapshot(&mut self) -> GraphSnapshot {
        self.refresh();
        self.graph.clone()
    }

    /// Returns the participants, with writers whose announcement the agent missed; empty if the agent
    /// no longer answers.
    pub(super) fn participants(&self) -> ParticipantList<'static> {
        let participants = self
            .agent
            .get_within::<ParticipantList<'_>>("/participants", GRAPH_TIMEOUT);
        participants.unwrap_or_default()
    }

    /// Returns whether a topic of this name is known in the domain.
    pub(super) fn knows(&self, name: &str) -> bool {
        self.known.contains_key(name)
    }

    fn refresh(&mut self) {
        let graph = self
            .agent
            .get_within::<TopicList<'_>>("/topics?hidden=true", GRAPH_TIMEOUT);
        let participants = self
            .agent
            .get_within::<ParticipantList<'_>>("/participants", GRAPH_TIMEOUT);
        let (Ok(graph), Ok(participants)) = (graph, participants) else {
            return;
        };
        self.known = by_name(&graph.topics, self.domain_id);
        self.graph = GraphSnapshot::answered(&graph.topics, participants.unknown_writers);
        self.at = Some(Instant::now());
    }
}

/// Locks the cache. A poisoned lock is usable, since the content is always consistent.
pub(super) fn locked<'l, 'a>(
    graph_cache: &'l Mutex<GraphCache<'a>>,
) -> MutexGuard<'l, GraphCache<'a>> {
    graph_cache.lock().unwrap_or_else(PoisonError::into_inner)
}
