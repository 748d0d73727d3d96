//! Triggers: conditions on events, which configurations name.

use ros2probe_model::facts::diagnosis::Diagnosis;

use super::table::{self, EVENTS};
use ros2probe_metrics::event::{Definition, Record, Severity, Value};

/// Short names of triggers, with the event that reports each problem.
const TRIGGER_NAMES: [(&str, &Definition); 5] = [
    ("expectation", &table::EXPECTATION_CHANGED),
    ("message_lost", &table::MESSAGE_LOST),
    ("participant_lost", &table::PARTICIPANT_LOST),
    ("qos_incompatible", &table::QOS_INCOMPATIBLE),
    ("hanging_call", &table::CALL_HANGING),
];

/// A condition on events.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Trigger {
    name: &'static str,
    condition: Condition,
}

#[derive(Clone, Debug, PartialEq, Eq)]
enum Condition {
    /// An event of this name that reports a problem, not the end of one.
    Problem(&'static str),
    /// A new finding of this kind.
    Finding(&'static str),
    /// Every event of this name.
    Event(&'static str),
}

impl Trigger {
    /// Parses a short name, a kind of finding, or the name of an event. `None` if it is unknown, or
    /// an event about snapshots, which would trigger itself.
    #[must_use]
    pub fn parse(name: &str) -> Option<Self> {
        if let Some((name, event)) = TRIGGER_NAMES.iter().find(|(known, _)| *known == name) {
            let condition = Condition::Problem(event.name);
            return Some(Self { name, condition });
        }
        if let Some(kind) = Diagnosis::KINDS.iter().find(|kind| **kind == name) {
            let condition = Condition::Finding(kind);
            return Some(Self {
                name: kind,
                condition,
            });
        }
        let event = EVENTS.iter().find(|event| event.name == name)?;
        (*event != table::SNAPSHOT_TAKEN).then_some(Self {
            name: event.name,
            condition: Condition::Event(event.name),
        })
    }

    /// Returns the names of all triggers: short names, kinds of findings, events.
    pub fn names() -> impl Iterator<Item = &'static str> {
        let problems = TRIGGER_NAMES.iter().map(|(name, _)| *name);
        let is_short = |kind: &&str| !TRIGGER_NAMES.iter().any(|(name, _)| name == kind);
        let findings = Diagnosis::KINDS.into_iter().filter(is_short);
        let events = EVENTS.iter().map(|event| event.name);
        let events = events.filter(|name| *name != table::SNAPSHOT_TAKEN.name);
        problems.chain(findings).chain(events)
    }

    /// Returns the name, as in the configuration.
    #[must_use]
    pub const fn name(&self) -> &'static str {
        self.name
    }

    /// Returns whether the event meets the condition in this domain. Events without a domain belong
    /// to every domain.
    #[must_use]
    pub fn matches(&self, record: &Record, domain_id: u32) -> bool {
        let event = record.definition.name;
        let is_met = match self.condition {
            Condition::Problem(name) => name == event && record.severity > Severity::Info,
            Condition::Finding(kind) => {
                let is_kind = |value: &Value| matches!(value, Value::Text(text) if text == kind);
                event == table::GRAPH_DIAGNOSED.name
                    && record.attribute("diagnosis").is_some_and(is_kind)
            }
            Condition::Event(name) => name == event,
        };
        let is_here = match record.attribute("domain_id") {
            Some(Value::Number(domain)) => *domain == u64::from(domain_id),
            _ => true,
        };
        is_met && is_here
    }
}
