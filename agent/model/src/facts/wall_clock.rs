//! Steps of the wall clock while the agent runs: by a time server on a robot without a
//! battery-backed clock, by hand, or after suspend.
//!
//! Steps do not affect the model's time: leases, windows and gaps use it. Only comparisons with
//! other clocks and displayed times use wall time. This module reads no clock.

use ros2probe_wire::Timestamp;

use crate::facts::model_time::ModelTime;

/// Nanoseconds by which the wall clock was set forward since the model's time began.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct WallClock(i64);

impl WallClock {
    /// Records that the clock was set forward by this many nanoseconds (backward if negative).
    pub const fn set(&mut self, step: i64) {
        self.0 = self.0.saturating_add(step);
    }

    /// Converts wall time to model time.
    #[inline]
    #[must_use]
    pub const fn model_time(self, wall_time: Timestamp) -> ModelTime {
        ModelTime::from_nanoseconds(wall_time.0.saturating_add_signed(self.0.saturating_neg()))
    }

    /// Converts model time to wall time.
    #[inline]
    #[must_use]
    pub const fn wall_time(self, model_time: ModelTime) -> Timestamp {
        Timestamp(model_time.nanoseconds().saturating_add_signed(self.0))
    }
}
