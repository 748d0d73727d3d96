//! Diagnostics: the states of the robot's parts, and those that are in error or silent.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use ros2probe_wire::diagnostics::{self as wire, DiagnosticLevel, DiagnosticStatuses};
use ros2probe_wire::{DomainId, Guid, SequenceNumber, WireError};

use super::Origin;
use super::text::truncated_text;
use crate::facts::bounded::{Bounded, Counted, Sum, TableFacts};
use crate::facts::diagnosis::Diagnosis;
use crate::facts::event::{EventKind, Events};
use crate::facts::model_time::ModelTime;
use crate::facts::names::TopicName;
use crate::facts::robot::DiagnosticStatus;
use crate::facts::tables::{DiagnosticValueBytes, DiagnosticsTable};

/// Maximum length of a name, a hardware id and a key, in bytes.
const MAX_NAME: usize = 128;
/// Maximum length of a message and a value, in bytes.
const MAX_TEXT: usize = 256;
/// Maximum number of values of one status.
const MAX_STATUS_VALUES: usize = 64;
/// Minimum silence after which a repeated status is stale; otherwise three intervals.
const MIN_STALE_SILENCE: Duration = Duration::from_secs(5);
/// A status that came once is stale after this silence.
const SINGLE_STATUS_SILENCE: Duration = Duration::from_secs(120);
/// A part is reported when it has been in error or stale for this time.
const FAULT_DELAY: Duration = Duration::from_secs(5);

/// Domain, topic, name and hardware id.
type Key = (DomainId, TopicName, Arc<str>, Arc<str>);

/// The diagnostics of all robots.
#[derive(Debug, Default)]
pub struct Diagnostics {
    parts: Bounded<Counted<DiagnosticsTable>, BTreeMap<Key, Part>>,
    /// Bytes of the values of all parts.
    value_bytes: Sum<Counted<DiagnosticValueBytes>>,
    revision: u64,
}

/// One part of the robot.
#[derive(Debug)]
struct Part {
    status: Arc<DiagnosticStatus>,
    /// The longest of the latest intervals between its messages; `None` after the first.
    interval: Option<Duration>,
    fault: Option<Fault>,
    /// Sequence number of its last message.
    number: SequenceNumber,
}

/// The time in which a part is in error or stale.
#[derive(Debug)]
struct Fault {
    since: ModelTime,
    /// The finding, as it began. It holds none of the values, whose bytes have a cap.
    reported: Option<Diagnosis>,
}

/// Facts about diagnostics.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct DiagnosticFacts {
    /// Whether diagnostics are read.
    pub are_read: bool,
    /// The parts, sorted by domain, topic, name and hardware id.
    pub statuses: Vec<Arc<DiagnosticStatus>>,
}

impl Diagnostics {
    /// Adds the statuses of a message.
    ///
    /// # Errors
    /// Fails if the message is malformed. The statuses before the error are added.
    pub fn add(
        &mut self,
        origin: &Origin<'_>,
        statuses: DiagnosticStatuses<'_>,
        events: &mut Events,
    ) -> Result<(), WireError> {
        for status in statuses {
            self.add_one(origin, &status?, events);
        }
        Ok(())
    }

    fn add_one(
        &mut self,
        origin: &Origin<'_>,
        status: &wire::DiagnosticStatus<'_>,
        events: &mut Events,
    ) {
        let name = truncated_text(status.name, MAX_NAME).into();
        let hardware_id = truncated_text(status.hardware_id, MAX_NAME).into();
        let key = (origin.domain_id, origin.topic.clone(), name, hardware_id);
        if let Some((_, silent)) = self.parts.make_room(&key, |part| part.status.at) {
            self.removed(&silent);
        }
        let known = self.parts.get(&key);
        if known.is_some_and(|part| origin.precedes(part.status.writer, part.number)) {
            return;
        }
        let known = self.parts.remove(&key);
        if let Some(part) = &known {
            self.value_bytes.sub(part.status.value_bytes());
        }
        let before = known.as_ref().map(|part| part.status.level);
        let level = status.level;
        let since = match &known {
            Some(part) if part.status.level == level => part.status.since,
            _ => origin.at,
        };
        let status = Arc::new(DiagnosticStatus {
            domain_id: key.0,
            topic: key.1.clone(),
            name: Arc::clone(&key.2),
            hardware_id: Arc::clone(&key.3),
            node: origin.node.cloned(),
            writer: origin.writer,
            level,
            message: truncated_text(status.message, MAX_TEXT).into(),
            values: self.values(status),
            at: origin.at,
            since,
        });
        self.value_bytes.add(status.value_bytes());
        if before.unwrap_or(DiagnosticLevel::Ok) != level {
            note(&status, before, events);
        }
        let mut part = Part {
            interval: known.as_ref().map(|part| part.interval_until(origin.at)),
            fault: known.and_then(|part| part.fault),
            number: origin.number,
            status,
        };
        self.revision += u64::from(part.judge(origin.at));
        self.parts.insert(key, part);
    }

    /// Returns the values of a status, as far as there is room for their bytes.
    fn values(&mut self, status: &wire::DiagnosticStatus<'_>) -> Vec<(Box<str>, Box<str>)> {
        let mut values = Vec::new();
        let mut bytes = 0;
        for (key, value) in status.values.clone().take(MAX_STATUS_VALUES) {
            let (key, value) = (
                truncated_text(key, MAX_NAME),
                truncated_text(value, MAX_TEXT),
            );
            bytes += key.len() + value.len();
            if bytes > self.value_bytes.remaining() {
                self.value_bytes.refuse();
                return Vec::new();
            }
            values.push((key, value));
        }
        values
    }

    /// Notes that a part was removed.
    fn removed(&mut self, part: &Part) {
        self.value_bytes.sub(part.status.value_bytes());
        let is_reported = part
            .fault
            .as_ref()
            .is_some_and(|fault| fault.reported.is_some());
        self.revision += u64::from(is_reported);
    }

    /// Removes the parts of a writer that departed.
    pub(super) fn forget(&mut self, writer: Guid) {
        let parts = self.parts.iter();
        let of_writer = parts.filter(|(_, part)| part.status.writer == writer);
        let keys: Vec<_> = of_writer.map(|(key, _)| key.clone()).collect();
        for key in keys {
            if let Some(part) = self.parts.remove(&key) {
                self.removed(&part);
            }
        }
    }

    /// Ends a second: parts whose messages ceased become stale, and faults that last are reported.
    /// `is_unseen` returns whether messages of a writer may pass unseen.
    pub(super) fn end_second(
        &mut self,
        now: ModelTime,
        is_unseen: impl Fn(Guid) -> bool,
        events: &mut Events,
    ) {
        for part in self.parts.values_mut() {
            let silence = match part.interval {
                Some(interval) => MIN_STALE_SILENCE.max(interval * 3),
                None => SINGLE_STATUS_SILENCE,
            };
            let status = &part.status;
            if status.level != DiagnosticLevel::Stale
                && now - status.at > silence
                && !is_unseen(status.writer)
            {
                let before = status.level;
                part.status = Arc::new(DiagnosticStatus {
                    level: DiagnosticLevel::Stale,
                    since: now,
                    ..DiagnosticStatus::clone(status)
                });
                note(&part.status, Some(before), events);
            }
            self.revision += u64::from(part.judge(now));
        }
    }

    /// Returns the number of changes of [`Self::findings`].
    pub(super) const fn revision(&self) -> u64 {
        self.revision
    }

    /// Returns the parts that are in error or stale.
    pub(super) fn findings(&self) -> impl Iterator<Item = Diagnosis> {
        let faults = self.parts.values().filter_map(|part| part.fault.as_ref());
        faults.filter_map(|fault| fault.reported.clone())
    }

    /// Returns the facts.
    #[must_use]
    pub fn facts(&self, are_read: bool) -> DiagnosticFacts {
        let parts = self.parts.values();
        DiagnosticFacts {
            are_read,
            statuses: parts.map(|part| Arc::clone(&part.status)).collect(),
        }
    }

    pub(super) fn tables(&self) -> [TableFacts; 2] {
        [self.parts.facts(), self.value_bytes.facts()]
    }
}

impl Part {
    /// Returns the longest of the latest intervals, with the one that ends now.
    fn interval_until(&self, now: ModelTime) -> Duration {
        let longest = self.interval.unwrap_or_default();
        (now - self.status.at).max(longest - longest / 8)
    }

    /// Begins or ends the fault, and reports one that lasts. Returns whether the reports change.
    fn judge(&mut self, now: ModelTime) -> bool {
        let status = &self.status;
        if status.level < DiagnosticLevel::Error || status.is_aggregated() {
            return self
                .fault
                .take()
                .is_some_and(|fault| fault.reported.is_some());
        }
        let fault = self.fault.get_or_insert(Fault {
            since: status.since,
            reported: None,
        });
        let is_new = fault.reported.is_none() && now - fault.since >= FAULT_DELAY;
        if is_new {
            fault.reported = Some(Diagnosis::DiagnosticError {
                domain_id: status.domain_id,
                topic: status.topic.clone(),
                node: status.node.clone(),
                name: Arc::clone(&status.name),
                hardware_id: Arc::clone(&status.hardware_id),
                level: status.level,
                message: Arc::clone(&status.message),
            });
        }
        is_new
    }
}

/// Adds an event: the level changed. An aggregator repeats others, so its statuses are no events.
fn note(status: &DiagnosticStatus, before: Option<DiagnosticLevel>, events: &mut Events) {
    if !status.is_aggregated() {
        let status = Arc::new(status.without_values());
        events.push(status.since, EventKind::Diagnostic { before, status });
    }
}
