//! Managed nodes: their states, failed transitions, and nodes that should be active.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use ros2probe_wire::lifecycle::{LifecycleState, Transition};
use ros2probe_wire::{DomainId, Guid};

use super::Origin;
use crate::facts::bounded::{Bounded, Counted, TableFacts};
use crate::facts::diagnosis::Diagnosis;
use crate::facts::glob::covers_text;
use crate::facts::model_time::ModelTime;
use crate::facts::names::NodeName;
use crate::facts::tables::ManagedNodes;

/// Time for which a node may be in another state than active.
const INACTIVE_GRACE: Duration = Duration::from_secs(5);

/// The managed nodes of all robots.
#[derive(Debug, Default)]
pub struct Lifecycle {
    nodes: Bounded<Counted<ManagedNodes>, BTreeMap<(DomainId, NodeName), Managed>>,
    /// Patterns of the names of nodes that should be active.
    active: Arc<Vec<Box<str>>>,
    revision: u64,
}

/// A managed node.
#[derive(Debug)]
struct Managed {
    state: LifecycleState,
    at: ModelTime,
    /// Writer of the last message about it.
    writer: Guid,
    /// Whether a transition failed since it was last active.
    has_failed: bool,
    /// The fault that is reported.
    reported: Option<Diagnosis>,
}

/// The last known state of a managed node.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ManagedNode {
    /// Domain.
    pub domain_id: DomainId,
    /// Its fully qualified name.
    pub node: NodeName,
    /// State.
    pub state: LifecycleState,
    /// Time of the message that reported it.
    pub at: ModelTime,
}

/// Facts about managed nodes.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct LifecycleFacts {
    /// Whether states are read.
    pub are_read: bool,
    /// Nodes with a known state, sorted by domain and name.
    pub nodes: Vec<ManagedNode>,
}

impl Lifecycle {
    /// Sets the patterns of the names of nodes that should be active.
    pub(super) fn expect(&mut self, active: Arc<Vec<Box<str>>>) {
        self.active = active;
    }

    /// Adds a transition. Returns the node, and the state that changed.
    pub(super) fn transit(
        &mut self,
        origin: &Origin<'_>,
        transition: Transition,
    ) -> Option<ManagedNode> {
        let Transition { from, to } = transition;
        let managed = self.set(origin, to)?;
        managed.has_failed = match (from, to) {
            (_, LifecycleState::Active) | (LifecycleState::ShuttingDown, _) => false,
            (LifecycleState::ErrorProcessing, _)
            | (_, LifecycleState::ErrorProcessing)
            | (LifecycleState::Configuring, LifecycleState::Unconfigured)
            | (LifecycleState::Activating, LifecycleState::Inactive) => true,
            (LifecycleState::Configuring, LifecycleState::Inactive) => false,
            _ => managed.has_failed,
        };
        Some(ManagedNode {
            domain_id: origin.domain_id,
            node: node(origin)?,
            state: to,
            at: origin.at,
        })
    }

    /// Adds a state that a node replied to a client.
    pub(super) fn replied(&mut self, origin: &Origin<'_>, state: LifecycleState) {
        self.set(origin, state);
    }

    /// Sets the state of the node to which a topic belongs. Returns `None` if the name has no node,
    /// or the table is full.
    fn set(&mut self, origin: &Origin<'_>, state: LifecycleState) -> Option<&mut Managed> {
        let new = || Managed {
            state,
            at: origin.at,
            writer: origin.writer,
            has_failed: false,
            reported: None,
        };
        let key = (origin.domain_id, node(origin)?);
        let managed = self.nodes.get_or_insert_with(key, new)?;
        if managed.state != state {
            (managed.state, managed.at) = (state, origin.at);
        }
        managed.writer = origin.writer;
        Some(managed)
    }

    /// Removes the nodes of a departed writer.
    pub(super) fn forget(&mut self, writer: Guid) {
        let before = self.nodes.len();
        self.nodes.retain(|_, managed| managed.writer != writer);
        self.revision += u64::from(before != self.nodes.len());
    }

    /// Reports nodes that have not been active for some seconds although they should be.
    pub(super) fn end_second(&mut self, now: ModelTime) {
        for ((domain_id, name), managed) in self.nodes.iter_mut() {
            let is_expected = self.active.iter().any(|pattern| covers_text(pattern, name));
            let is_fault = managed.state != LifecycleState::Active
                && (is_expected || managed.has_failed)
                && now - managed.at >= INACTIVE_GRACE;
            let fault = is_fault.then(|| Diagnosis::NodeInactive {
                domain_id: *domain_id,
                node: name.clone(),
                state: managed.state,
                has_failed: managed.has_failed,
            });
            if managed.reported != fault {
                managed.reported = fault;
                self.revision += 1;
            }
        }
    }

    /// Returns the nodes that are not active although they should be.
    pub(super) fn findings(&self) -> impl Iterator<Item = Diagnosis> {
        let nodes = self.nodes.values();
        nodes.filter_map(|managed| managed.reported.clone())
    }

    /// Returns the number of changes of the findings.
    pub(super) const fn revision(&self) -> u64 {
        self.revision
    }

    /// Returns the facts.
    #[must_use]
    pub fn facts(&self, are_read: bool) -> LifecycleFacts {
        let nodes = self.nodes.iter();
        let nodes = nodes.map(|((domain_id, node), managed)| ManagedNode {
            domain_id: *domain_id,
            node: node.clone(),
            state: managed.state,
            at: managed.at,
        });
        LifecycleFacts {
            are_read,
            nodes: nodes.collect(),
        }
    }

    pub(super) fn table(&self) -> TableFacts {
        self.nodes.facts()
    }
}

/// Returns the node whose topic or service this is: its name is that of the namespace.
fn node(origin: &Origin<'_>) -> Option<NodeName> {
    let (node, _) = origin.topic.rsplit_once('/')?;
    (!node.is_empty()).then(|| NodeName::from(node))
}
