//! Measurement of a writer in shared memory, where polling misses messages.

use ros2probe_wire::Timestamp;

use super::Counted;
use super::MeasurementContext;
use super::Writer;
use super::reach;
use super::seconds;
use crate::facts::dispatch::MissedReason;
use crate::facts::journal::{Journal, Missing};
use crate::facts::model_time::ModelTime;
use crate::facts::observation::{Content, Observation, Sample};
use crate::facts::rate::Sum;
use crate::measure::sampled::{Completeness, Sampled, SampledUpdate};
use crate::measure::samples::Budget;

impl Writer {
    /// Reports samples to the journal that were sent but not seen.
    pub(super) fn report_unseen(&mut self, journal: &mut Journal) {
        let unseen = self.sampled.as_mut().map(|sampled| sampled.take_unseen());
        for (first, last) in unseen.into_iter().flatten() {
            journal.add_missing(Missing {
                writer: self.guid,
                first,
                last,
                reason: MissedReason::NotCaptured,
            });
        }
    }

    /// Returns whether the sample was pending when the sampled view ended.
    pub(super) fn is_pending(&self, sample: &Sample) -> bool {
        let (at, number) = (sample.head.at, sample.sequence_number);
        self.sampled
            .as_ref()
            .is_some_and(|sampled| !sampled.is_current(at) && sampled.awaits(number))
    }

    pub(super) fn is_sampled(&self, now: ModelTime) -> bool {
        let sampled = self.sampled.as_ref();
        sampled.is_some_and(|sampled| sampled.is_current(now))
    }

    /// Processes an observation of a view in which missing samples may still have been sent.
    pub(super) fn sampled_observation(
        &mut self,
        observation: &Observation,
        (is_sampled, is_history): (bool, bool),
        context: &mut MeasurementContext<'_>,
    ) -> Option<Counted> {
        let now = context.now;
        let abandoned = match self.is_sampled(now) {
            true => Vec::new(),
            false => self.reception.abandon(),
        };
        self.tally.messages += abandoned.len() as u64;
        let sampled = self
            .sampled
            .get_or_insert_with(|| Box::new(Sampled::new(now)));
        sampled.add_partial(&abandoned, self.reception.sequence().next(), now);
        if is_sampled {
            sampled.touch(now);
        }
        let reach = reach(observation.head());
        let since = self.reception.sequence().last_advance();
        let sequence = self.reception.sequence_mut();
        let announced = match observation {
            Observation::Sample(sample) => {
                let update = self.sampled_update(sample, reach, context.budget)?;
                self.count_span(sample, &update, (since, now));
                return self.sampled_sample(
                    sample,
                    &update,
                    is_history,
                    (now, context.wall_clock.wall_time(now)),
                );
            }
            Observation::Heartbeat(heartbeat) => {
                self.traits.reliable = true;
                sampled.note_existing(heartbeat.last, reach, now, sequence)
            }
            Observation::Gap(gap) => sampled.skip((gap.start, gap.list.base), reach, now, sequence),
            // The reader has all samples below this number.
            Observation::AckNack(acknack) => {
                sampled.note_existing(acknack.base().previous(), reach, now, sequence)
            }
            Observation::Presence(_) => 0,
        };
        sampled.note_interval(announced, since, now);
        if announced > 0 {
            self.last_message = self.last_message.max(Some(now));
        }
        let announced = Sum {
            messages: announced,
            bytes: 0,
        };
        self.spread(announced, since, now);
        None
    }

    /// Counts the samples up to a seen one. Unseen samples are assumed to have the same size.
    fn count_span(
        &mut self,
        sample: &Sample,
        update: &SampledUpdate,
        (since, now): (ModelTime, ModelTime),
    ) {
        if let Some(sampled) = &mut self.sampled {
            sampled.note_interval(update.samples, since, now);
        }
        let disposals = u64::from(!sample.is_message() && update.samples > 0);
        let messages = update.samples - disposals;
        let size = u64::from(sample.size());
        let bytes = (update.alike - disposals).saturating_mul(size);
        self.spread(Sum { messages, bytes }, since, now);
        if messages > 0 {
            self.last_message = self.last_message.max(Some(now));
        }
    }

    /// Counts the messages that were sent after `since`, each in the second of its presumed time.
    fn spread(&mut self, sent: Sum, since: ModelTime, now: ModelTime) {
        let tally = &mut self.tally;
        tally.messages += sent.messages;
        tally.bytes = tally.bytes.saturating_add(sent.bytes);
        let earlier = tally.window.spread(sent, since, now);
        tally.earlier.messages += earlier.messages;
        tally.earlier.bytes = tally.earlier.bytes.saturating_add(earlier.bytes);
    }

    /// Applies a sample, or a part of one, to the sampled view.
    fn sampled_update(
        &mut self,
        sample: &Sample,
        reach: u64,
        budget: &mut Budget,
    ) -> Option<SampledUpdate> {
        let sampled = self.sampled.as_mut()?;
        let (now, number) = (sample.head.at, sample.sequence_number);
        let source = sample.source_timestamp.timestamp();
        let sequence = self.reception.sequence();
        let unconfirmed = sequence.is_unconfirmed(number, source, reach);
        let has = !unconfirmed && sampled.has(number, sequence.next());
        let is_whole = match sample.content {
            Content::DataFrag(fragments) => {
                !has && (self.reception).assemble(sample, fragments, unconfirmed, budget)
            }
            Content::Data { .. } => true,
        };
        let seen = match is_whole {
            true => Completeness::Complete,
            // Polling shared memory may yield a sample after the uprobe has reported it.
            false if sample.is_end() && !sample.head.is_exact() => Completeness::LastFragment,
            false => Completeness::Partial,
        };
        let sequence = self.reception.sequence_mut();
        Some(sampled.sample((number, seen, source), reach, now, sequence))
    }

    /// Processes a part of a sample that was pending when the sampled view ended, from any source.
    pub(super) fn catch_up(
        &mut self,
        sample: &Sample,
        is_history: bool,
        context: &mut MeasurementContext<'_>,
    ) -> Option<Counted> {
        let now = context.now;
        let is_whole = match sample.content {
            Content::Data { .. } => true,
            Content::DataFrag(fragments) => {
                (self.reception).assemble(sample, fragments, false, context.budget)
            }
        };
        let seen = if is_whole {
            Completeness::Complete
        } else {
            Completeness::Partial
        };
        let number = sample.sequence_number;
        let update = self.sampled.as_mut()?.add_late(number, seen);
        let times = (now, context.wall_clock.wall_time(now));
        self.sampled_sample(sample, &update, is_history, times)
    }

    fn sampled_sample(
        &mut self,
        sample: &Sample,
        update: &SampledUpdate,
        is_history: bool,
        (now, wall_clock): (ModelTime, Timestamp),
    ) -> Option<Counted> {
        let (number, is_message) = (sample.sequence_number, sample.is_message());
        let bytes = u64::from(sample.size());
        let sampled = self.sampled.as_mut()?;
        let stamp = sampled.stamp(number, sample.header_stamp);
        if let Some(interval) = update.interval {
            self.interarrival.observe(seconds(interval));
        }
        let source = sample.source_timestamp;
        if update.arrived && is_message && !is_history {
            self.delays(number, true, (source, stamp), (now, wall_clock));
        }
        if update.finished && is_message {
            return Some(Counted {
                number,
                bytes,
                source,
                stamp: stamp.filter(|_| self.traits.has_header),
                at: now,
                began: now,
                sampled: true,
                unconfirmed: update.unconfirmed,
            });
        }
        None
    }
}
