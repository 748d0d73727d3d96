//! Latencies of a writer's samples since INFO_TS and since their header's stamp. Both come from the
//! clock of the writer's host.

use ros2probe_wire::{RtpsTime, SequenceNumber, Timestamp};

use super::MIN_HISTORY_AGE;
use super::Writer;
use super::seconds;
use crate::facts::header::{MAX_PLAUSIBLE_OFFSET, stamp_time};
use crate::facts::model_time::ModelTime;

impl Writer {
    pub(super) fn delays(
        &mut self,
        number: SequenceNumber,
        newest: bool,
        (source, stamp): (RtpsTime, Option<(i32, u32)>),
        (now, wall_clock): (ModelTime, Timestamp),
    ) {
        let ahead = self.clock_ahead;
        let here =
            |stamp: Timestamp| Timestamp(stamp.0.saturating_add_signed(ahead.saturating_neg()));
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
