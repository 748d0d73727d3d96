//! Rows of topics with their values and flags, and the rates of the preceding minutes.

use std::collections::{BTreeMap, HashMap};

use super::super::history::{stored_precision, thousandths};
use super::super::index::Index;
use super::rate_steps::{MAX_STEPS, Part, RateSteps, STEP_SECONDS};
use super::structure::{Ids, is_measured, is_shown};
use crate::config::Watchlist;
use ros2probe_api::live::{History, Row, Totals};
use ros2probe_model::facts::diagnosis::Diagnosis;
use ros2probe_model::measure::history::{Past, Second};
use ros2probe_model::report::snapshot::{Snapshot, TopicFacts, Transport, WatchState};

/// Time for which a loss is flagged, in seconds.
pub(super) const LOSS_FLAG_SECONDS: usize = 60;

/// Meaning of a topic's flags, starting with the lowest bit.
pub(super) const FLAG_MEANINGS: [&str; 12] = [
    "qos",
    "type",
    "definition",
    "unmatched_publisher",
    "unmatched_subscription",
    "silent",
    "violated",
    "loss",
    "unseen",
    "sampled",
    "encrypted",
    "rejected",
];

/// A flag, by its index in [`FLAG_MEANINGS`].
#[derive(Clone, Copy)]
enum Flag {
    Qos,
    Type,
    Definition,
    UnmatchedPublisher,
    UnmatchedSubscription,
    Silent,
    Violated,
    Loss,
    Unseen,
    Sampled,
    Encrypted,
    Rejected,
}

/// Input of the rows.
pub(super) struct Figures<'a> {
    pub(super) snapshot: &'a Snapshot,
    pub(super) index: &'a Index<'a>,
    pub(super) past: &'a Past,
    pub(super) watchlist: &'a Watchlist,
    /// Whether messages in shared memory are observed.
    pub(super) observes_shared_memory: bool,
    /// Messages lost in the last [`LOSS_FLAG_SECONDS`] seconds, by the topic's id in the history.
    pub(super) lost: HashMap<u32, u32>,
}

impl Figures<'_> {
    /// Returns the row of every topic that has a rate or a flag.
    pub(super) fn rows(&self, ids: &Ids) -> BTreeMap<u32, Row> {
        let last = self.past.seconds().last();
        let topics = self.snapshot.topics.iter().filter(|topic| is_shown(topic));
        let rows = topics.filter_map(|topic| {
            let id = ids.topic(topic.domain_id, &topic.dds_name)?;
            let row = self.row(id, topic, last.map(AsRef::as_ref));
            (row.1.is_some() || row.8 != 0).then_some((id, row))
        });
        rows.collect()
    }

    fn row(&self, id: u32, topic: &TopicFacts, last: Option<&Second>) -> Row {
        let known = self.past.id(topic.domain_id, &topic.dds_name);
        let flags = self.flags(topic, known);
        let Some(measured) = topic.measurement.as_deref() else {
            return Row(
                id, None, None, None, None, None, None, None, flags, None, None,
            );
        };
        let second = known.and_then(|known| last?.row(known));
        let latency = second.and_then(|second| second.latency());
        let part = |place: usize| {
            latency
                .and_then(|it| it.get(place).copied())
                .map(stored_precision)
        };
        let at = measured.last_message;
        Row(
            id,
            topic.rate_hz().map(thousandths),
            topic.bandwidth().map(f64::round),
            Some(measured.messages),
            Some(measured.loss.lost),
            Some(second.map_or(0, |second| second.lost)),
            part(0),
            part(1),
            flags,
            at.map(|at| thousandths(self.snapshot.wall_time(at).seconds())),
            Some(measured.loss.expected),
        )
    }

    fn flags(&self, topic: &TopicFacts, known: Option<u32>) -> u32 {
        let mut flags = 0;
        let mut mark = |flag: Flag, holds: bool| flags |= u32::from(holds) << flag as u32;
        let mut unmatched = 0;
        for finding in self.index.findings(topic) {
            match finding {
                Diagnosis::QosIncompatible { .. } => mark(Flag::Qos, true),
                Diagnosis::TypeConflict { .. } => mark(Flag::Type, true),
                Diagnosis::TypeHashConflict { .. } => mark(Flag::Definition, true),
                Diagnosis::UnmatchedPublisher { .. } => {
                    unmatched += 1;
                    mark(Flag::UnmatchedPublisher, true);
                }
                Diagnosis::UnmatchedSubscription { .. } => mark(Flag::UnmatchedSubscription, true),
                Diagnosis::DuplicateNode { .. }
                | Diagnosis::NodeInSeveralDomains { .. }
                | Diagnosis::HangingCall { .. }
                | Diagnosis::SlowCallback { .. }
                | Diagnosis::ExecutorWait { .. }
                | Diagnosis::LateCallback { .. }
                | Diagnosis::IntraProcessOverflow { .. }
                | Diagnosis::ReaderQueueOverflow { .. }
                | Diagnosis::ObservationSuspended { .. }
                | Diagnosis::RestampingNode { .. }
                | Diagnosis::BuffersByCpu { .. }
                | Diagnosis::LossyLink { .. }
                | Diagnosis::LogErrors { .. }
                | Diagnosis::DiagnosticError { .. }
                | Diagnosis::TransformFault { .. }
                | Diagnosis::ClocksApart { .. }
                | Diagnosis::NearMiss { .. }
                | Diagnosis::NodeInactive { .. }
                | Diagnosis::ParameterDrift { .. }
                | Diagnosis::MixedTime { .. }
                | Diagnosis::WrongStamps { .. }
                | Diagnosis::SharedMemoryFault { .. }
                | Diagnosis::SlowChain { .. } => {}
            }
        }
        let measured = topic.measurement.as_deref();
        let is_measured = is_measured(topic, self.index);
        let is_connected = unmatched < topic.publishers.len() && !topic.subscriptions.is_empty();
        let is_quiet = topic.is_silent(self.snapshot.at);
        let watches = self.index.watches(topic);
        let stands = |state| watches.iter().any(|(_, watch)| watch.state == state);
        mark(
            Flag::Silent,
            is_measured && is_connected && is_quiet || stands(WatchState::Silent),
        );
        mark(Flag::Violated, stands(WatchState::Violated));
        let lost = known.and_then(|known| self.lost.get(&known));
        mark(Flag::Loss, lost.is_some_and(|lost| *lost > 0));
        let is_unseen = |passage| match passage {
            Transport::Network | Transport::Tcp => false,
            Transport::SharedMemory => !self.observes_shared_memory,
            Transport::DataSharing | Transport::SameProcess | Transport::Iceoryx => true,
        };
        let mut transports = topic.transports.iter();
        mark(
            Flag::Unseen,
            transports.any(|each| {
                let observed = topic.observed_pairs(each.transport);
                is_unseen(each.transport) && observed < each.pairs
            }),
        );
        let is_sampled = measured.is_some_and(|measured| measured.sampled.is_some());
        mark(Flag::Sampled, is_sampled);
        let mut participants = topic
            .publishers
            .iter()
            .map(|each| self.index.participant(each.guid));
        let is_secured = participants.any(|each| each.is_some_and(|each| each.secured));
        mark(Flag::Encrypted, is_secured);
        let is_rejected = self.snapshot.topics_rejected > 0
            && !is_measured
            && !topic.hidden
            && !self
                .watchlist
                .matching(topic.domain_id, &topic.name)
                .is_empty();
        mark(Flag::Rejected, is_rejected);
        flags
    }
}

/// Returns the totals of all topics in the last second.
pub(super) fn totals(snapshot: &Snapshot, past: &Past) -> Totals {
    let rows = past
        .seconds()
        .last()
        .map_or(&[][..], |second| second.rows());
    let mut totals = Totals(0, 0, 0, snapshot.topics_measured);
    let mut bytes = 0.0;
    for row in rows {
        totals.0 += u64::from(row.messages);
        bytes += f64::from(row.bytes);
        totals.2 += u64::from(row.lost);
    }
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "a sum of bytes of one second"
    )]
    let bytes = bytes as u64;
    totals.1 = bytes;
    totals
}

/// Returns the recently lost messages, by the topic's id in the history.
pub(super) fn recent_losses(past: &Past) -> HashMap<u32, u32> {
    let seconds = past.seconds();
    let first = seconds.len().saturating_sub(LOSS_FLAG_SECONDS);
    let mut lost = HashMap::new();
    for second in seconds.get(first..).unwrap_or_default() {
        for row in second.rows().iter().filter(|row| row.lost > 0) {
            let sum: &mut u32 = lost.entry(row.topic()).or_default();
            *sum = sum.saturating_add(row.lost);
        }
    }
    lost
}

/// Returns the rates of the last minutes for measured topics.
pub(super) fn history(snapshot: &Snapshot, past: &Past, ids: &Ids) -> History {
    let seconds = past.seconds();
    let first = seconds
        .len()
        .saturating_sub((STEP_SECONDS * MAX_STEPS) as usize);
    let steps = seconds.get(first..).unwrap_or_default();
    let steps = steps.chunks(STEP_SECONDS as usize);
    let topics = snapshot.topics.iter().filter_map(|topic| {
        let known = past.id(topic.domain_id, &topic.dds_name)?;
        Some((known, ids.topic(topic.domain_id, &topic.dds_name)?))
    });
    let topics: HashMap<u32, u32> = topics.collect();
    let mut sums = RateSteps::new(steps.len());
    for (place, step) in steps.clone().enumerate() {
        for row in step.iter().flat_map(|second| second.rows()) {
            let part = Part {
                messages: row.messages,
                bytes: row.bytes.into(),
                lost: row.lost,
                seconds: 1,
            };
            sums.add(place, topics.get(&row.topic()).copied(), part);
        }
    }
    sums.history(steps.filter_map(|step| {
        let length = u32::try_from(step.len()).unwrap_or(u32::MAX);
        Some((step.last()?.at.seconds(), length.into()))
    }))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_flag_has_its_name() {
        let named = |flag: Flag| FLAG_MEANINGS[flag as usize];
        assert_eq!(named(Flag::Qos), "qos");
        assert_eq!(named(Flag::Silent), "silent");
        assert_eq!(named(Flag::Loss), "loss");
        assert_eq!(named(Flag::Rejected), "rejected");
        assert_eq!(Flag::Rejected as usize + 1, FLAG_MEANINGS.len());
    }
}
