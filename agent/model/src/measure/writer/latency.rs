//! Latencies of a writer's samples since INFO_TS and since their header's stamp. Both come from the
//! clock of the writer's host.

use std::time::Duration;

use ros2probe_wire::{RtpsTime, SequenceNumber, Timestamp};

use super::HISTORY_TIME;
use super::MIN_HISTORY_AGE;
use super::MeasurementContext;
use super::Writer;
use super::seconds;
use crate::facts::header::{MAX_PLAUSIBLE_OFFSET, stamp_time};
use crate::facts::model_time::ModelTime;
use crate::facts::observation::Observation;

impl Writer {
    /// Returns whether the observation is a sample from before `opened`, when a reader appeared that
    /// may have requested it. The clock of the writer's host may be behind. Samples that arrive at
    /// the pace of their timestamps are therefore live after a while.
    pub(super) fn is_history(
        &self,
        opened: ModelTime,
        observation: &Observation,
        context: &MeasurementContext<'_>,
    ) -> bool {
        let sample = observation.sample();
        let Some(source) = sample.and_then(|sample| sample.source_timestamp.timestamp()) else {
            return false;
        };
        if on_this_clock(source, self.clock_ahead) >= context.wall_clock.wall_time(opened) {
            return false;
        }
        let Some(last) = self.last_message else {
            return true;
        };
        let before = self.reception.sequence().newest_source();
        let sent_apart = Duration::from_nanos(source.0.saturating_sub(before.0));
        opened + HISTORY_TIME > context.now || sent_apart > 2 * (context.now - last)
    }

    pub(super) fn delays(
        &mut self,
        number: SequenceNumber,
        newest: bool,
        (source, stamp): (RtpsTime, Option<(i32, u32)>),
        (now, wall_clock): (ModelTime, Timestamp),
    ) {
        let ahead = self.clock_ahead;
        let here = |stamp| on_this_clock(stamp, ahead);
        let source = source.timestamp().map(here);
        if self.traits.keeps_history {
            let old = source.is_none_or(|source| source + MIN_HISTORY_AGE < wall_clock);
            let first = self.reception.sequence().first();
            if !newest || number < first || number == first && old {
                return;
            }
        }
        let stamp = stamp
            .filter(|_| self.traits.has_header)
            .and_then(|stamp| stamp_time(stamp, wall_clock))
            .map(here);
        let mut negative = false;
        if let Some(source) = source {
            let delay = wall_clock.nanoseconds_since(source);
            let is_plausible = source.distance(wall_clock) <= MAX_PLAUSIBLE_OFFSET;
            self.implausible_latency += u64::from(!is_plausible);
            negative |= delay < 0;
            if delay >= 0 && is_plausible {
                self.source_latency.observe(seconds(delay));
                let slot = self.tally.window.second(now);
                slot.delayed += 1;
                slot.delay += seconds(delay);
            }
        }
        if let Some(stamp) = stamp {
            let delay = wall_clock.nanoseconds_since(stamp);
            negative |= delay < 0;
            if delay >= 0 {
                self.header_latency.observe(seconds(delay));
            }
        }
        self.negative_latency += u64::from(negative);
    }
}

/// Converts a timestamp of a clock that is ahead by this many nanoseconds.
const fn on_this_clock(stamp: Timestamp, ahead: i64) -> Timestamp {
    Timestamp(stamp.0.saturating_add_signed(ahead.saturating_neg()))
}
