//! Steps of the calendar clock while the agent runs: by a time server on a robot without a
//! battery-backed clock, by hand, or after suspend.
//!
//! The model's time is not affected by steps: leases, windows and gaps use it. Only comparisons
//! with other clocks and displayed times use the calendar. This module reads no clock.

use ros2probe_wire::{Record, Timestamp};

/// Nanoseconds by which the calendar was set forward since the model's time began.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct WallClock(i64);

impl WallClock {
    /// Records that the clock was set forward by this many nanoseconds (backward if negative).
    pub const fn set(&mut self, step: i64) {
        self.0 = self.0.saturating_add(step);
    }

    /// Converts calendar time to model time.
    #[must_use]
    pub const fn model_time(self, wall_clock: Timestamp) -> Timestamp {
        Timestamp(wall_clock.0.saturating_add_signed(self.0.saturating_neg()))
    }

    /// Converts model time to calendar time.
    #[must_use]
    pub const fn wall_time(self, model_time: Timestamp) -> Timestamp {
        Timestamp(model_time.0.saturating_add_signed(self.0))
    }

    /// Returns whether the clock was set since the model's time began.
    #[must_use]
    pub const fn is_set(self) -> bool {
        self.0 != 0
    }

    /// Returns the record in model time, or `None` if it needs no conversion.
    #[must_use]
    pub fn model_record(self, record: &Record) -> Option<Record> {
        let time = self.model_time(Timestamp(record.time)).0;
        (self.0 != 0).then_some(Record { time, ..*record })
    }
}
