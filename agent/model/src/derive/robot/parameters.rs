//! Parameters of nodes: last known values, changes, and who requested them.

use std::collections::{BTreeMap, VecDeque};
use std::fmt::Write as _;
use std::sync::Arc;
use std::time::Duration;

use ros2probe_wire::ros_parameters::{self as wire, ChangeKind, ParameterEvent, ParameterValue};
use ros2probe_wire::{DomainId, Guid, WireError};

use super::Origin;
use super::text::bounded;
use crate::facts::bounded::{Bounded, Counted, TableFacts};
use crate::facts::event::{EventKind, Events};
use crate::facts::model_time::ModelTime;
use crate::facts::names::NodeName;
use crate::facts::robot::{ParameterChange, Requester};
use crate::facts::tables::{ChangedNodes, KnownParameters, ParameterChanges, ParameterRequests};

/// Maximum length of a name, in bytes.
const NAME: usize = 128;
/// Maximum length of a value, in bytes.
const VALUE: usize = 256;
/// Time after a request in which a change counts as its effect.
const EFFECT: Duration = Duration::from_secs(5);

/// Domain, node and name.
type Key = (DomainId, NodeName, Arc<str>);

/// The parameters of all nodes.
#[derive(Debug, Default)]
pub struct Parameters {
    known: Bounded<Counted<KnownParameters>, BTreeMap<Key, Known>>,
    /// The latest changes, oldest first.
    changes: Bounded<Counted<ParameterChanges>, VecDeque<Arc<ParameterChange>>>,
    /// The latest requests, oldest first.
    requests: Bounded<Counted<ParameterRequests>, VecDeque<Request>>,
    /// Changes of each node since the agent started.
    counts: Bounded<Counted<ChangedNodes>, BTreeMap<(DomainId, NodeName), u64>>,
}

/// A parameter and its last known value.
#[derive(Clone, Debug)]
struct Known {
    value: Arc<str>,
    at: ModelTime,
    /// Writer of the event.
    writer: Guid,
}

/// A request to set a parameter.
#[derive(Clone, Debug)]
struct Request {
    key: Key,
    value: Arc<str>,
    at: ModelTime,
    by: Requester,
}

/// A parameter that a node has, with its last known value.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ParameterFacts {
    /// Domain.
    pub domain_id: DomainId,
    /// The node.
    pub node: NodeName,
    /// Name.
    pub name: Arc<str>,
    /// Last known value, as YAML, at most 256 bytes.
    pub value: Arc<str>,
    /// Time of that value.
    pub at: ModelTime,
}

/// Facts about parameters.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct ParametersFacts {
    /// Whether parameters are read.
    pub are_read: bool,
    /// Parameters, sorted by domain, node and name.
    pub known: Vec<ParameterFacts>,
    /// The latest changes, oldest first.
    pub changes: Vec<Arc<ParameterChange>>,
    /// Nodes with the number of their changes, sorted by domain and name.
    pub counts: Vec<(DomainId, NodeName, u64)>,
}

impl Parameters {
    /// Adds an event of a node. A declaration is no change.
    ///
    /// # Errors
    /// Fails if the message is malformed. The changes before the error are added.
    pub fn add(
        &mut self,
        origin: &Origin<'_>,
        event: ParameterEvent<'_>,
        events: &mut Events,
    ) -> Result<(), WireError> {
        let node = NodeName::from(&*bounded(event.node, NAME));
        for change in event.changes {
            let change = change?;
            let name = bounded(change.parameter.name, NAME).into();
            let key = (origin.domain_id, node.clone(), name);
            self.change(origin, key, &change, events);
        }
        Ok(())
    }

    fn change(
        &mut self,
        origin: &Origin<'_>,
        key: Key,
        change: &wire::ParameterChange<'_>,
        events: &mut Events,
    ) {
        let (at, kind) = (origin.at, change.kind);
        let before = self.known.get(&key).map(|known| Arc::clone(&known.value));
        let value = (kind != ChangeKind::Deleted).then(|| text(&change.parameter.value));
        match &value {
            Some(value) => {
                let known = Known {
                    value: Arc::clone(value),
                    at,
                    writer: origin.writer,
                };
                self.learn(key.clone(), known);
            }
            None => {
                self.known.remove(&key);
            }
        }
        let requested_by = self.requester(&key, value.as_ref(), at);
        let is_declared = kind == ChangeKind::New && requested_by.is_none();
        if is_declared || (before.is_some() && before == value) {
            return;
        }
        let change = Arc::new(ParameterChange {
            at,
            domain_id: key.0,
            node: key.1,
            name: key.2,
            before,
            value,
            requested_by,
        });
        self.changes.push_back(Arc::clone(&change));
        let node = (change.domain_id, change.node.clone());
        if let Some(count) = self.counts.get_or_insert_with(node, || 0) {
            *count += 1;
        }
        events.push(at, EventKind::Parameter(change));
    }

    /// Keeps the last known value; the one with the oldest value makes room.
    fn learn(&mut self, key: Key, known: Known) {
        if self.known.is_full() && !self.known.contains_key(&key) {
            self.known.refuse();
            let oldest = self.known.iter().min_by_key(|(_, known)| known.at);
            if let Some(key) = oldest.map(|(key, _)| key.clone()) {
                self.known.remove(&key);
            }
        }
        self.known.insert(key, known);
    }

    /// Adds a request to set parameters of a node.
    ///
    /// # Errors
    /// Fails if the request is malformed. The parameters before the error are added.
    pub fn request(
        &mut self,
        origin: &Origin<'_>,
        parameters: wire::Parameters<'_>,
    ) -> Result<(), WireError> {
        let Some((node, _service)) = origin.topic.rsplit_once('/') else {
            return Ok(());
        };
        let node = NodeName::from(node);
        for parameter in parameters {
            let parameter = parameter?;
            let name = bounded(parameter.name, NAME).into();
            self.requests.push_back(Request {
                key: (origin.domain_id, node.clone(), name),
                value: text(&parameter.value),
                at: origin.at,
                by: Requester {
                    node: origin.node.cloned(),
                    writer: origin.writer,
                },
            });
        }
        Ok(())
    }

    /// Returns who requested a change to this value.
    fn requester(&self, key: &Key, value: Option<&Arc<str>>, at: ModelTime) -> Option<Requester> {
        let latest = self.requests.iter().rev();
        let mut recent = latest.filter(|request| request.at <= at && at - request.at <= EFFECT);
        let removal = text(&ParameterValue::NotSet);
        let cause = recent
            .find(|request| request.key == *key && request.value == *value.unwrap_or(&removal));
        cause.map(|request| request.by.clone())
    }

    /// Removes the parameters that a departed writer announced.
    pub(super) fn forget(&mut self, writer: Guid) {
        let of_writer = self
            .known
            .iter()
            .filter(|(_, known)| known.writer == writer);
        let keys: Vec<_> = of_writer.map(|(key, _)| key.clone()).collect();
        for key in keys {
            self.known.remove(&key);
        }
    }

    /// Returns the facts.
    #[must_use]
    pub fn facts(&self, are_read: bool) -> ParametersFacts {
        let known = self.known.iter().map(|(key, known)| ParameterFacts {
            domain_id: key.0,
            node: key.1.clone(),
            name: Arc::clone(&key.2),
            value: Arc::clone(&known.value),
            at: known.at,
        });
        let counts = self.counts.iter();
        let counts = counts.map(|((domain_id, node), count)| (*domain_id, node.clone(), *count));
        ParametersFacts {
            are_read,
            known: known.collect(),
            changes: self.changes.iter().cloned().collect(),
            counts: counts.collect(),
        }
    }

    pub(super) fn tables(&self) -> [TableFacts; 4] {
        [
            self.known.facts(),
            self.changes.facts(),
            self.requests.facts(),
            self.counts.facts(),
        ]
    }
}

/// Returns the text of a value, truncated.
fn text(value: &ParameterValue<'_>) -> Arc<str> {
    let mut text = Truncated(String::new());
    // The only error is that of a full text.
    let _ = write!(text, "{value}");
    text.0.into()
}

/// A text that refuses more than its maximum.
struct Truncated(String);

impl std::fmt::Write for Truncated {
    fn write_str(&mut self, more: &str) -> std::fmt::Result {
        let room = VALUE - self.0.len().min(VALUE);
        let fitting = more
            .get(..more.floor_char_boundary(room))
            .unwrap_or_default();
        self.0.push_str(fitting);
        match fitting.len() == more.len() {
            true => Ok(()),
            false => Err(std::fmt::Error),
        }
    }
}
