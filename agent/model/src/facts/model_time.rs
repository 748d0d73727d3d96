//! The monotonic time of the model.

use std::ops::{Add, Sub};
use std::time::Duration;

use ros2probe_wire::time::{SECOND, nanoseconds};

/// Nanoseconds of model time, which steps of the wall clock do not affect. Only
/// [`WallClock`](crate::facts::wall_clock::WallClock) converts from and to wall time.
///
/// Sums and differences with a [`Duration`] saturate at both ends of the 64 bits.
#[derive(Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
pub struct ModelTime(u64);

impl ModelTime {
    /// The earliest time, before any observation.
    pub const ZERO: Self = Self(0);
    /// The latest time.
    pub const MAX: Self = Self(u64::MAX);

    /// Creates a time from nanoseconds of model time, not of the wall clock.
    #[must_use]
    pub const fn from_nanoseconds(nanoseconds: u64) -> Self {
        Self(nanoseconds)
    }

    /// Returns the nanoseconds.
    #[inline]
    #[must_use]
    pub const fn nanoseconds(self) -> u64 {
        self.0
    }

    /// Returns `self - earlier` in nanoseconds; negative if `earlier` is later.
    #[must_use]
    pub const fn nanoseconds_since(self, earlier: Self) -> i64 {
        self.0.wrapping_sub(earlier.0).cast_signed()
    }

    /// Returns the start of the second with this number.
    #[must_use]
    pub const fn of_second(second: u64) -> Self {
        Self(second.saturating_mul(SECOND))
    }

    /// Returns the number of the second that contains the time.
    #[inline]
    #[must_use]
    pub const fn whole_seconds(self) -> u64 {
        self.0 / SECOND
    }

    /// Returns the last multiple of `interval` that is not later; the time itself if the interval
    /// is zero.
    #[must_use]
    pub const fn round_down(self, interval: Duration) -> Self {
        let Some(rest) = self.0.checked_rem(nanoseconds(interval)) else {
            return self;
        };
        Self(self.0 - rest)
    }

    /// Returns the first multiple of `interval` that is not earlier; the time itself if the
    /// interval is zero.
    #[must_use]
    pub fn round_up(self, interval: Duration) -> Self {
        let begin = self.round_down(interval);
        match begin == self {
            true => self,
            false => begin + interval,
        }
    }
}

impl Add<Duration> for ModelTime {
    type Output = Self;

    #[inline]
    fn add(self, duration: Duration) -> Self {
        Self(self.0.saturating_add(nanoseconds(duration)))
    }
}

impl Sub<Duration> for ModelTime {
    type Output = Self;

    #[inline]
    fn sub(self, duration: Duration) -> Self {
        Self(self.0.saturating_sub(nanoseconds(duration)))
    }
}

/// The time since an earlier one; zero if it is later.
impl Sub for ModelTime {
    type Output = Duration;

    #[inline]
    fn sub(self, earlier: Self) -> Duration {
        Duration::from_nanos(self.0.saturating_sub(earlier.0))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_saturate_and_round_to_intervals() {
        let (at, second) = (ModelTime::from_nanoseconds, Duration::from_secs(1));
        assert_eq!(ModelTime::MAX + second, ModelTime::MAX);
        assert_eq!(at(1) - second, ModelTime::ZERO);
        assert_eq!(at(1) - at(SECOND), Duration::ZERO);
        assert_eq!(at(1).nanoseconds_since(at(3)), -2);
        for (time, down, up) in [(0, 0, 0), (1, 0, 1), (SECOND, 1, 1), (SECOND + 1, 1, 2)] {
            assert_eq!(at(time).round_down(second), ModelTime::of_second(down));
            assert_eq!(at(time).round_up(second), ModelTime::of_second(up));
        }
        assert_eq!(at(7).round_up(Duration::ZERO), at(7));
        assert_eq!(ModelTime::MAX.round_up(second), ModelTime::MAX);
    }
}
