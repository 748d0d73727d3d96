//! Points in time and durations, as RTPS encodes them and as the agent keeps them.

/// One second in nanoseconds, the unit of [`Timestamp`].
pub const SECOND: u64 = 1_000_000_000;
/// One millisecond in nanoseconds.
pub const MILLISECOND: u64 = 1_000_000;

/// Nanoseconds since the Unix epoch. The only clock reading of the agent, always passed in.
#[derive(Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
pub struct Timestamp(pub u64);

impl Timestamp {
    /// Returns `self - earlier` in nanoseconds; negative if `earlier` is later.
    #[must_use]
    pub const fn nanoseconds_since(self, earlier: Self) -> i64 {
        self.0.wrapping_sub(earlier.0).cast_signed()
    }

    /// Returns seconds with a fraction, for people and for Prometheus.
    #[must_use]
    #[expect(
        clippy::cast_precision_loss,
        reason = "microseconds survive until the year 2255"
    )]
    pub fn seconds(self) -> f64 {
        self.0 as f64 / 1e9
    }
}

/// RTPS `Time_t` and `Duration_t` (RTPS 2.5, 9.3.2): seconds and a fraction of 2^-32 seconds, kept
/// as `seconds << 32 | fraction`. Zero means "no time": INFO_TS is absent or invalid.
#[derive(Clone, Copy, Default, PartialEq, Eq, Debug)]
pub struct RtpsTime(pub u64);

impl RtpsTime {
    /// Returns nanoseconds since the Unix epoch; `None` for "no time".
    #[must_use]
    pub const fn timestamp(self) -> Option<Timestamp> {
        if self.0 == 0 {
            return None;
        }
        let seconds = self.0 >> 32;
        let fraction = self.0 & 0xffff_ffff;
        // Rounds to nearest: 2^-32 s is finer than a nanosecond, so writers' values survive.
        let nanoseconds = (fraction * 1_000_000_000 + (1 << 31)) >> 32;
        Some(Timestamp(seconds * 1_000_000_000 + nanoseconds))
    }
}

/// A QoS or lease duration.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
pub enum Duration {
    /// Nanoseconds.
    Finite(u64),
    /// Never ends.
    Infinite,
}

impl Duration {
    /// Converts the wire's `i32` seconds and `u32` fraction. 7fffffff seconds with any fraction of
    /// at least 7fffffff is infinite (Fast DDS and Cyclone DDS both send ffffffff). Negative
    /// durations read as zero.
    #[must_use]
    pub const fn from_wire(seconds: i32, fraction: u32) -> Self {
        if seconds == i32::MAX && fraction >= 0x7fff_ffff {
            return Self::Infinite;
        }
        if seconds < 0 {
            return Self::Finite(0);
        }
        let fraction_nanoseconds = (fraction as u64 * 1_000_000_000 + (1 << 31)) >> 32;
        Self::Finite(seconds.cast_unsigned() as u64 * 1_000_000_000 + fraction_nanoseconds)
    }

    /// Returns the nanoseconds; `None` if the duration is infinite.
    #[must_use]
    pub const fn nanoseconds(self) -> Option<u64> {
        match self {
            Self::Finite(nanoseconds) => Some(nanoseconds),
            Self::Infinite => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_tenth_of_a_second_is_not_429_milliseconds() {
        assert_eq!(
            Duration::from_wire(0, 0x1999_999a),
            Duration::Finite(100_000_000)
        );
    }

    #[test]
    fn infinite_in_both_spellings() {
        assert_eq!(Duration::from_wire(i32::MAX, u32::MAX), Duration::Infinite);
        assert_eq!(
            Duration::from_wire(i32::MAX, 0x7fff_ffff),
            Duration::Infinite
        );
    }

    #[test]
    fn no_time_is_not_the_epoch() {
        assert_eq!(RtpsTime(0).timestamp(), None);
        assert_eq!(
            RtpsTime(1 << 32 | 1 << 31).timestamp(),
            Some(Timestamp(1_500_000_000))
        );
    }
}
