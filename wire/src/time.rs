//! Points in time and durations, as RTPS encodes them and as the agent keeps them.

use core::ops::{Add, Sub};
use core::time::Duration;

/// One second in nanoseconds, the unit of [`Timestamp`].
pub const SECOND: u64 = 1_000_000_000;
/// One millisecond in nanoseconds.
pub const MILLISECOND: u64 = 1_000_000;

/// Nanoseconds since the Unix epoch. The caller reads the clock and passes the time in.
///
/// Sums and differences with a [`Duration`] saturate at both ends of the 64 bits.
#[derive(Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
pub struct Timestamp(pub u64);

impl Timestamp {
    /// Returns `self - earlier` in nanoseconds; negative if `earlier` is later.
    #[must_use]
    pub const fn nanoseconds_since(self, earlier: Self) -> i64 {
        self.0.wrapping_sub(earlier.0).cast_signed()
    }

    /// Returns the time in seconds with a fraction, for people and for Prometheus.
    #[must_use]
    #[expect(
        clippy::cast_precision_loss,
        reason = "microseconds survive until the year 2255"
    )]
    pub fn seconds(self) -> f64 {
        self.0 as f64 / 1e9
    }

    /// Returns the whole seconds since the Unix epoch.
    #[inline]
    #[must_use]
    pub const fn whole_seconds(self) -> u64 {
        self.0 / SECOND
    }

    /// Returns the absolute difference between `self` and `other`.
    #[inline]
    #[must_use]
    pub const fn distance(self, other: Self) -> Duration {
        Duration::from_nanos(self.0.abs_diff(other.0))
    }
}

impl Add<Duration> for Timestamp {
    type Output = Self;

    #[inline]
    fn add(self, duration: Duration) -> Self {
        Self(self.0.saturating_add(nanoseconds(duration)))
    }
}

impl Sub<Duration> for Timestamp {
    type Output = Self;

    #[inline]
    fn sub(self, duration: Duration) -> Self {
        Self(self.0.saturating_sub(nanoseconds(duration)))
    }
}

/// The time since `earlier`; zero if `earlier` is later.
impl Sub for Timestamp {
    type Output = Duration;

    #[inline]
    fn sub(self, earlier: Self) -> Duration {
        Duration::from_nanos(self.0.saturating_sub(earlier.0))
    }
}

/// Returns the nanoseconds of a duration, at most [`u64::MAX`] (584 years).
#[inline]
#[must_use]
pub const fn nanoseconds(duration: Duration) -> u64 {
    let seconds = duration.as_secs().saturating_mul(SECOND);
    seconds.saturating_add(duration.subsec_nanos() as u64)
}

/// RTPS `Time_t` and `Duration_t` (RTPS 2.5, 9.3.2): seconds and a fraction of 2^-32 seconds, kept
/// as `seconds << 32 | fraction`. Zero means "no time": INFO_TS is absent or invalid.
#[derive(Clone, Copy, Default, PartialEq, Eq, Debug)]
pub struct RtpsTime(pub u64);

impl RtpsTime {
    /// Converts nanoseconds since the Unix epoch, so that [`Self::timestamp`] returns them again.
    #[must_use]
    pub const fn of(timestamp: Timestamp) -> Self {
        let (seconds, rest) = (timestamp.0 / SECOND, timestamp.0 % SECOND);
        // Rounds to nearest, as [`Self::timestamp`] does.
        Self((seconds << 32) | (((rest << 32) + SECOND / 2) / SECOND))
    }

    /// Returns nanoseconds since the Unix epoch; `None` for "no time".
    #[must_use]
    pub const fn timestamp(self) -> Option<Timestamp> {
        if self.0 == 0 {
            return None;
        }
        let seconds = self.0 >> 32;
        let fraction = self.0 & 0xffff_ffff;
        // Rounds to nearest: 2^-32 s is finer than a nanosecond, so the writer's nanoseconds
        // survive.
        let nanoseconds = (fraction * SECOND + (1 << 31)) >> 32;
        Some(Timestamp(seconds * SECOND + nanoseconds))
    }
}

/// A QoS or lease duration (RTPS 2.5, 9.3.2.3).
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
pub enum RtpsDuration {
    /// Ends after this time.
    Finite(Duration),
    /// Never ends.
    Infinite,
}

impl RtpsDuration {
    /// Converts the wire's `i32` seconds and `u32` fraction. 7fffffff seconds with any fraction of
    /// at least 7fffffff is infinite (Fast DDS and Cyclone DDS both send ffffffff). Negative
    /// durations read as zero.
    #[must_use]
    pub const fn from_wire(seconds: i32, fraction: u32) -> Self {
        if seconds == i32::MAX && fraction >= 0x7fff_ffff {
            return Self::Infinite;
        }
        if seconds < 0 {
            return Self::Finite(Duration::ZERO);
        }
        let fraction_nanoseconds = (fraction as u64 * SECOND + (1 << 31)) >> 32;
        let nanoseconds = seconds.cast_unsigned() as u64 * SECOND + fraction_nanoseconds;
        Self::Finite(Duration::from_nanos(nanoseconds))
    }

    /// Returns the duration; `None` if it is infinite.
    #[must_use]
    pub const fn finite(self) -> Option<Duration> {
        match self {
            Self::Finite(duration) => Some(duration),
            Self::Infinite => None,
        }
    }

    /// Returns the duration in seconds with a fraction; `None` if it is infinite.
    #[must_use]
    #[expect(
        clippy::cast_precision_loss,
        reason = "microseconds survive up to 285 years"
    )]
    pub fn seconds(self) -> Option<f64> {
        self.finite()
            .map(|duration| nanoseconds(duration) as f64 / 1e9)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_fraction_of_a_tenth_of_a_second_reads_as_100_milliseconds() {
        assert_eq!(
            RtpsDuration::from_wire(0, 0x1999_999a),
            RtpsDuration::Finite(Duration::from_millis(100))
        );
    }

    #[test]
    fn both_encodings_of_an_infinite_duration_read_as_infinite() {
        assert_eq!(
            RtpsDuration::from_wire(i32::MAX, u32::MAX),
            RtpsDuration::Infinite
        );
        assert_eq!(
            RtpsDuration::from_wire(i32::MAX, 0x7fff_ffff),
            RtpsDuration::Infinite
        );
    }

    #[test]
    fn a_zero_reads_as_no_time_and_other_times_survive_a_round_trip() {
        assert_eq!(RtpsTime(0).timestamp(), None);
        for nanoseconds in [
            1,
            999_999_999,
            1_795_232_033_832_943_680,
            4_000_000_000_999_999_999,
        ] {
            let time = RtpsTime::of(Timestamp(nanoseconds));
            assert_eq!(time.timestamp(), Some(Timestamp(nanoseconds)));
        }
        assert_eq!(
            RtpsTime(1 << 32 | 1 << 31).timestamp(),
            Some(Timestamp(1_500_000_000))
        );
    }

    #[test]
    fn times_saturate_instead_of_wrapping() {
        let (second, end) = (Duration::from_secs(1), Timestamp(u64::MAX));
        assert_eq!(Timestamp(1) + second, Timestamp(SECOND + 1));
        assert_eq!(Timestamp(SECOND + 1) - second, Timestamp(1));
        assert_eq!((end + second, end + Duration::MAX), (end, end));
        assert_eq!(Timestamp(1) - second, Timestamp(0));
        assert_eq!(Timestamp(SECOND) - Timestamp(0), second);
        assert_eq!(Timestamp(0) - Timestamp(SECOND), Duration::ZERO);
        assert_eq!(Timestamp(0).distance(Timestamp(SECOND)), second);
        assert_eq!(nanoseconds(Duration::from_nanos(u64::MAX)), u64::MAX);
        assert_eq!(nanoseconds(Duration::MAX), u64::MAX);
    }
}
