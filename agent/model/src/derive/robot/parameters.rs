//! Parameters of nodes: last known values, changes, and who requested them.

use std::collections::{BTreeMap, VecDeque};
use std::fmt::Write as _;
use std::sync::Arc;
use std::time::Duration;

use ros2probe_wire::ros_parameters::{
    self as wire, ChangeKind, ParameterEvent, ParameterValue, RepliedValues, RequestedNames,
};
use ros2probe_wire::{DomainId, Guid, SequenceNumber, WireError};

use super::Origin;
use super::text::truncated_text;
use crate::derive::services::service::CallId;
use crate::facts::bounded::{Bounded, Counted, TableFacts};
use crate::facts::diagnosis::Diagnosis;
use crate::facts::event::{EventKind, Events};
use crate::facts::model_time::ModelTime;
use crate::facts::names::NodeName;
use crate::facts::robot::{ParameterChange, Requester};
use crate::facts::tables::{
    AskedParameters, ChangedNodes, KnownParameters, ParameterChanges, ParameterRequests,
};

/// Maximum length of a name, in bytes.
const MAX_NAME: usize = 128;
/// Maximum length of a value, in bytes.
const MAX_VALUE: usize = 256;
/// Time after a request in which a change counts as its effect.
const MAX_EFFECT_DELAY: Duration = Duration::from_secs(5);

/// Parameter with which a node uses simulated time.
const SIMULATED_TIME: &str = "use_sim_time";
/// Time for which nodes may have different clocks.
const MIXED_TIME_GRACE: Duration = Duration::from_secs(5);
/// Maximum number of nodes that a finding names.
const MAX_NAMED_NODES: usize = 4;

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
    /// Parameters in the latest requests for values, oldest first.
    requested_values: Bounded<Counted<AskedParameters>, VecDeque<RequestedParameter>>,
    /// Changes of each node since the agent started.
    counts: Bounded<Counted<ChangedNodes>, BTreeMap<(DomainId, NodeName), u64>>,
    /// What the configuration expects.
    expected: BTreeMap<(NodeName, Arc<str>), Arc<str>>,
    /// Domains whose nodes use different clocks, and the time since which they do.
    mixed: BTreeMap<DomainId, ModelTime>,
    findings: Vec<Diagnosis>,
    revision: u64,
    /// Whether a value has changed since the findings were computed.
    has_changed: bool,
}

/// A parameter that should have a value.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ExpectedParameter {
    /// Fully qualified name of the node, in any domain.
    pub node: NodeName,
    /// Name.
    pub name: Arc<str>,
    /// Value, as YAML.
    pub value: Arc<str>,
}

/// A parameter and its last known value.
#[derive(Clone, Debug)]
struct Known {
    value: Arc<str>,
    at: ModelTime,
    /// Writer and number of the event.
    writer: Guid,
    number: SequenceNumber,
}

/// A request to set a parameter.
#[derive(Clone, Debug)]
struct Request {
    key: Key,
    value: Arc<str>,
    at: ModelTime,
    by: Requester,
}

/// A parameter in a request for values.
#[derive(Clone, Debug)]
struct RequestedParameter {
    call: CallId,
    /// Its place in the request and in the reply.
    index: usize,
    name: Arc<str>,
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
    /// Sets what the configuration expects.
    pub(super) fn expect(&mut self, expected: &[ExpectedParameter]) {
        self.expected.clear();
        for each in expected {
            let parameter = (each.node.clone(), Arc::clone(&each.name));
            let value = || Arc::clone(&each.value);
            self.expected.entry(parameter).or_insert_with(value);
        }
        self.has_changed = true;
    }

    /// Updates the findings: other values than expected, and different clocks in one domain.
    pub(super) fn end_second(&mut self, now: ModelTime) {
        if !self.has_changed && self.mixed.is_empty() {
            return;
        }
        self.has_changed = false;
        let mut findings: Vec<_> = self.drifts().collect();
        let clocks = self.clocks();
        self.mixed
            .retain(|domain_id, _| clocks.contains_key(domain_id));
        for (domain_id, [simulated, system]) in clocks {
            let since = *self.mixed.entry(domain_id).or_insert(now);
            if now - since >= MIXED_TIME_GRACE {
                findings.push(Diagnosis::MixedTime {
                    domain_id,
                    simulated,
                    system,
                });
            }
        }
        if findings != self.findings {
            self.findings = findings;
            self.revision += 1;
        }
    }

    fn drifts(&self) -> impl Iterator<Item = Diagnosis> {
        let known = self.known.iter().filter(|_| !self.expected.is_empty());
        known.filter_map(|((domain_id, node, name), known)| {
            let parameter = (node.clone(), Arc::clone(name));
            let expected = self.expected.get(&parameter)?;
            (*expected != known.value).then(|| Diagnosis::ParameterDrift {
                domain_id: *domain_id,
                node: node.clone(),
                name: Arc::clone(name),
                expected: Arc::clone(expected),
                value: Arc::clone(&known.value),
            })
        })
    }

    /// Returns the domains with several clocks, each with nodes of simulated time and others.
    fn clocks(&self) -> BTreeMap<DomainId, [Vec<NodeName>; 2]> {
        let mut clocks: BTreeMap<DomainId, [Vec<NodeName>; 2]> = BTreeMap::new();
        for ((domain_id, node, name), known) in &*self.known {
            if **name == *SIMULATED_TIME {
                let [simulated, system] = clocks.entry(*domain_id).or_default();
                let nodes = if &*known.value == "true" {
                    simulated
                } else {
                    system
                };
                if nodes.len() < MAX_NAMED_NODES {
                    nodes.push(node.clone());
                }
            }
        }
        clocks.retain(|_, nodes| nodes.iter().all(|nodes| !nodes.is_empty()));
        clocks
    }

    /// Returns the present problems.
    pub(super) fn findings(&self) -> impl Iterator<Item = Diagnosis> {
        self.findings.iter().cloned()
    }

    /// Returns the number of changes of the findings.
    pub(super) const fn revision(&self) -> u64 {
        self.revision
    }

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
        let node = NodeName::from(&*truncated_text(event.node, MAX_NAME));
        for change in event.changes {
            let change = change?;
            let name = truncated_text(change.parameter.name, MAX_NAME).into();
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
        let known = self.known.get(&key);
        if known.is_some_and(|known| origin.precedes(known.writer, known.number)) {
            return;
        }
        let before = known.map(|known| Arc::clone(&known.value));
        self.has_changed = true;
        let value = (kind != ChangeKind::Deleted).then(|| text(&change.parameter.value));
        match &value {
            Some(value) => self.set_value(origin, key.clone(), Arc::clone(value)),
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

    /// Records the last known value of a parameter.
    fn set_value(&mut self, origin: &Origin<'_>, key: Key, value: Arc<str>) {
        let known = Known {
            value,
            at: origin.at,
            writer: origin.writer,
            number: origin.number,
        };
        self.has_changed = true;
        self.known.make_room(&key, |known| known.at);
        self.known.insert(key, known);
    }

    /// Adds a request for values of parameters.
    ///
    /// # Errors
    /// Fails if the request is malformed. The names before the error are added.
    pub fn add_get_request(
        &mut self,
        call: Option<CallId>,
        names: RequestedNames<'_>,
    ) -> Result<(), WireError> {
        let Some(call) = call else {
            return Ok(());
        };
        for (index, name) in names.enumerate() {
            let name = truncated_text(name?, MAX_NAME).into();
            self.requested_values
                .push_back(RequestedParameter { call, index, name });
        }
        Ok(())
    }

    /// Adds the values of a reply, if its request was seen. They are no changes: the agent came
    /// after the node.
    ///
    /// # Errors
    /// Fails if the reply is malformed. The values before the error are added.
    pub fn replied(
        &mut self,
        origin: &Origin<'_>,
        call: Option<CallId>,
        values: RepliedValues<'_>,
    ) -> Result<(), WireError> {
        let (Some(call), Some((node, _service))) = (call, origin.topic.rsplit_once('/')) else {
            return Ok(());
        };
        let mut names = BTreeMap::new();
        self.requested_values.retain(|asked| {
            if asked.call == call {
                names.insert(asked.index, Arc::clone(&asked.name));
            }
            asked.call != call
        });
        let node = NodeName::from(node);
        for (index, value) in values.enumerate() {
            let value = value?;
            // A node replies "not set" about a parameter that it does not have.
            if let (Some(name), false) = (
                names.remove(&index),
                matches!(value, ParameterValue::NotSet),
            ) {
                let key = (origin.domain_id, node.clone(), name);
                self.set_value(origin, key, text(&value));
            }
        }
        Ok(())
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
            let name = truncated_text(parameter.name, MAX_NAME).into();
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
        let mut recent =
            latest.filter(|request| request.at <= at && at - request.at <= MAX_EFFECT_DELAY);
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
            self.has_changed = true;
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

    pub(super) fn tables(&self) -> [TableFacts; 5] {
        [
            self.known.facts(),
            self.changes.facts(),
            self.requests.facts(),
            self.requested_values.facts(),
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
        let room = MAX_VALUE - self.0.len().min(MAX_VALUE);
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
