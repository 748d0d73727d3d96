//! Activity of a node, summed over its callbacks, and its lifecycle state.

use std::collections::BTreeMap;

use ros2probe_model::report::snapshot::Snapshot;
use ros2probe_wire::DomainId;

/// Activity of one node.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct NodeActivity<'a> {
    /// Share of the last window in which the node's callbacks ran; `None` without a callback.
    pub(super) busy: Option<f64>,
    /// Last lifecycle state, if known.
    pub(super) state: Option<&'a str>,
}

impl<'a> NodeActivity<'a> {
    /// Returns the activity of each node, by domain and name. A state that calls inside its process
    /// show precedes one that it published.
    pub(super) fn all(snapshot: &'a Snapshot) -> BTreeMap<(DomainId, &'a str), Self> {
        let mut all: BTreeMap<_, Self> = BTreeMap::new();
        for managed in &snapshot.lifecycle.nodes {
            let key = (managed.domain_id, managed.node.as_str());
            all.entry(key).or_default().state = Some(managed.state.label());
        }
        let Some(known) = snapshot.inside.as_deref() else {
            return all;
        };
        for callback in &known.callbacks {
            if let (Some(node), Some(busy)) = (&callback.owner.node, callback.busy) {
                let key = (callback.owner.domain_id, node.as_str());
                let activity = all.entry(key).or_default();
                *activity.busy.get_or_insert_default() += busy;
            }
        }
        for state in &known.states {
            if let Some(node) = &state.node {
                let key = (state.domain_id, node.as_str());
                all.entry(key).or_default().state = Some(&state.state);
            }
        }
        all
    }
}
