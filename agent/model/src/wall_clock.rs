//! The calendar clock may be set while the agent looks: by a time server on a robot without a clock
//! of its own, by hand, by waking from suspend.
//!
//! The model's time goes on evenly all the while: leases, windows and gaps know nothing of it. Only
//! what is held against the clocks of others, and what is shown, is calendar time. It reads no
//! clock.

use ros2probe_wire::{Record, Timestamp};

/// By how many nanoseconds the calendar has been set forward since the model's time began.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct WallClock(i64);

impl WallClock {
    /// It was set forward by so many nanoseconds, or back.
    pub const fn set(&mut self, step: i64) {
        self.0 = self.0.saturating_add(step);
    }

    /// The model's time at this time of the calendar.
    #[must_use]
    pub const fn model_time(self, wall_clock: Timestamp) -> Timestamp {
        Timestamp(wall_clock.0.saturating_add_signed(self.0.saturating_neg()))
    }

    /// The calendar's time at this time of the model.
    #[must_use]
    pub const fn wall_time(self, model_time: Timestamp) -> Timestamp {
        Timestamp(model_time.0.saturating_add_signed(self.0))
    }

    /// It was set since the model's time began.
    #[must_use]
    pub const fn is_set(self) -> bool {
        self.0 != 0
    }

    /// A record in the model's time; `None` = as it is.
    #[must_use]
    pub fn model_record(self, record: &Record) -> Option<Record> {
        let time = self.model_time(Timestamp(record.time)).0;
        (self.0 != 0).then_some(Record { time, ..*record })
    }
}
