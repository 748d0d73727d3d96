//! Replay at the pace of the capture, a multiple of it, or without pauses.
//!
//! The pacer only computes the wait. The caller waits, and decides what interrupts the wait.

use std::str::FromStr;
use std::time::{Duration, Instant};

use ros2probe_wire::Timestamp;

/// Speed of a replay.
#[derive(Clone, Copy, PartialEq, Debug)]
pub enum Speed {
    /// Without waiting.
    Max,
    /// Multiple of the speed of the capture.
    Times(f64),
}

/// Computes the pause before each packet.
#[derive(Clone, Debug)]
pub struct Pacer {
    speed: Speed,
    anchor: Option<(Timestamp, Instant)>,
}

/// The text is not a speed.
#[derive(Clone, Copy, PartialEq, Eq, Debug, thiserror::Error)]
#[error("a speed is a number above zero (1 is the capture's own pace) or \"max\"")]
pub struct SpeedError;

impl FromStr for Speed {
    type Err = SpeedError;

    fn from_str(text: &str) -> Result<Self, SpeedError> {
        if text == "max" {
            return Ok(Self::Max);
        }
        match text.parse::<f64>() {
            Ok(factor) if factor.is_finite() && factor > 0.0 => Ok(Self::Times(factor)),
            _ => Err(SpeedError),
        }
    }
}

impl Pacer {
    /// Creates a pacer before the first packet.
    #[must_use]
    pub const fn new(speed: Speed) -> Self {
        Self {
            speed,
            anchor: None,
        }
    }

    /// Creates a pacer in the middle of a capture, of which `time` is due at `now`.
    #[must_use]
    pub const fn from(speed: Speed, time: Timestamp, now: Instant) -> Self {
        Self {
            speed,
            anchor: Some((time, now)),
        }
    }

    /// Returns the time from `now` until the packet captured at `time` is due. The first packet is
    /// due immediately and sets the pace. A late packet, or one older than the first, is also due
    /// immediately.
    pub fn delay(&mut self, time: Timestamp, now: Instant) -> Duration {
        let Speed::Times(factor) = self.speed else {
            return Duration::ZERO;
        };
        let (first, started) = *self.anchor.get_or_insert((time, now));
        let since_first = Duration::from_nanos(time.0.saturating_sub(first.0));
        // A capture of centuries at a very low speed overflows: the wait is then unlimited.
        let due = Duration::try_from_secs_f64(since_first.as_secs_f64() / factor)
            .unwrap_or(Duration::MAX);
        due.saturating_sub(now.saturating_duration_since(started))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn packets_keep_their_intervals_divided_by_the_speed() {
        let start = Instant::now();
        let mut pacer = Pacer::new("2".parse().unwrap());
        assert_eq!(pacer.delay(Timestamp(5_000_000_000), start), Duration::ZERO);
        assert_eq!(
            pacer.delay(Timestamp(6_000_000_000), start),
            Duration::from_millis(500)
        );
        let later = start + Duration::from_millis(400);
        assert_eq!(
            pacer.delay(Timestamp(6_000_000_000), later),
            Duration::from_millis(100)
        );
        let late = start + Duration::from_secs(9);
        assert_eq!(pacer.delay(Timestamp(6_000_000_000), late), Duration::ZERO);
        assert_eq!(pacer.delay(Timestamp(1), start), Duration::ZERO);
    }

    #[test]
    fn an_extreme_interval_does_not_overflow() {
        let start = Instant::now();
        let mut pacer = Pacer::new(Speed::Times(f64::MIN_POSITIVE));
        pacer.delay(Timestamp(0), start);
        assert_eq!(pacer.delay(Timestamp(u64::MAX), start), Duration::MAX);
    }

    #[test]
    fn a_speed_is_a_positive_number_or_max() {
        assert_eq!("max".parse(), Ok(Speed::Max));
        assert_eq!("0.5".parse(), Ok(Speed::Times(0.5)));
        for wrong in ["0", "-1", "inf", "NaN", "fast", ""] {
            assert_eq!(wrong.parse::<Speed>(), Err(SpeedError), "{wrong}");
        }
    }
}
