//! Writers whose announcement was missed: their cap and eviction.

use std::ops::RangeInclusive;
use std::time::Duration;

use ros2probe_wire::Guid;

use super::ESTABLISHED_MESSAGES;
use super::EVICTABLE_AFTER;
use super::Measured;
use super::ObservationOutcome;
use super::Profiler;
use super::UNKNOWN_AFTER;
use crate::facts::journal::Journal;
use crate::facts::model_time::ModelTime;
use crate::facts::observation::Observation;
use crate::measure::receivers::Graph;
use crate::measure::subscribers::Subscribers;
use crate::measure::writer::{Traits, Writer};

/// Minimum time between two searches for writers to evict.
const SEARCH_INTERVAL: Duration = Duration::from_millis(100);

/// Changes of unknown writers.
#[derive(Debug, Default)]
pub struct UnknownWriters {
    /// Writers that are metered from now on.
    pub metered: Vec<Guid>,
    /// Writers that were dropped.
    pub forgotten: Vec<Guid>,
}

impl UnknownWriters {
    /// Notes an unknown writer that is metered from now on, or was silent for too long.
    pub(super) fn advance(&mut self, (guid, measured): (Guid, &mut Measured), now: ModelTime) {
        if measured.last_seen + measured.silence_timeout() <= now {
            self.forgotten.push(guid);
        } else if !measured.metered && measured.first_seen + UNKNOWN_AFTER <= now {
            (measured.metered, measured.opened) = (true, now);
            self.metered.push(guid);
        }
    }
}

impl Profiler {
    /// Returns whether one of these writers sends without an announcement.
    #[must_use]
    pub fn has_unknown_writer(&self, writers: RangeInclusive<Guid>) -> bool {
        self.unknown_writers.range(writers).next().is_some()
    }

    /// Processes an observation of a writer without an announcement.
    pub fn unknown_writer(
        &mut self,
        observation: &Observation,
        journal: &mut Journal,
        graph: &Graph,
    ) -> ObservationOutcome {
        let Some(sample) = observation.sample().filter(|sample| sample.is_delivered()) else {
            return ObservationOutcome::Unmeasured;
        };
        let (guid, now) = (sample.head.writer, sample.head.at);
        if self.unknown_writers.is_full() && !self.evict_unknown_writer(now, graph) {
            self.unknown_writers.refuse();
            return ObservationOutcome::Unmeasured;
        }
        self.unknown_writers.insert(guid);
        let mut measured = Measured::new(Writer::new(guid, Traits::default()), None, now);
        let participants = graph.discovery.participants();
        measured.has_participant = participants.contains_key(&guid.prefix);
        self.writers.insert(guid, measured);
        self.observe(observation, journal, graph)
    }

    /// Counts for its subscribers what a writer sent shortly before its announcement at `now`, as
    /// far as they were known. HDDS announces a writer to a new participant while it already sends
    /// its history there.
    pub fn deliver_earlier(
        &mut self,
        guid: Guid,
        now: ModelTime,
        journal: &mut Journal,
        graph: &Graph,
    ) {
        let Some(measured) = self.writers.get_mut(&guid) else {
            return;
        };
        let topic = measured.topic.and_then(|topic| graph.topics.get(topic));
        let Some(topic) = topic.filter(|topic| !topic.readers.is_empty()) else {
            return;
        };
        let since = topic.reader_appeared.max(now - UNKNOWN_AFTER);
        let writer_ref = measured.writer_ref(guid);
        for observation in self.latest_unknown.take() {
            let head = observation.head();
            if head.writer != guid {
                self.latest_unknown.add(observation);
            } else if head.at >= since {
                let subscribers = measured
                    .subscribers
                    .get_or_insert_with(|| Box::new(Subscribers::new(measured.complete_from)));
                let context = &mut self
                    .shared
                    .writer_context(writer_ref, head.at, journal, graph);
                subscribers.observe(&observation, context);
            }
        }
        // The kernel filter may have omitted some of it.
        if let Some(subscribers) = &mut measured.subscribers {
            subscribers.skip_numbers(now);
        }
    }

    /// Replaces the GUID of an unknown writer in its latest observations, so that
    /// [`Self::deliver_earlier`] finds them. Only writers of Zenoh are renamed, and these only send
    /// samples.
    pub(super) fn rename_latest(&mut self, before: Guid, guid: Guid) {
        for observation in &mut self.latest_unknown {
            if let Observation::Sample(sample) = observation
                && sample.head.writer == before
            {
                sample.head.writer = guid;
            }
        }
    }

    /// Drops the unknown writer with the longest silence that is not established. Returns whether
    /// there was one.
    fn evict_unknown_writer(&mut self, now: ModelTime, graph: &Graph) -> bool {
        if now < self.search_after {
            return false;
        }
        let evictable = self.writers.iter().filter(|(_, measured)| {
            measured.topic.is_none()
                && measured.writer.messages() < ESTABLISHED_MESSAGES
                && measured.last_seen + EVICTABLE_AFTER <= now
        });
        let oldest = evictable.min_by_key(|(guid, measured)| (measured.last_seen, **guid));
        let Some(guid) = oldest.map(|(guid, _)| *guid) else {
            self.search_after = now + SEARCH_INTERVAL;
            return false;
        };
        self.unknown_writers.refuse();
        self.stop(guid, now, &mut Journal::default(), graph);
        true
    }
}
