//! Time in a capture, as typed by a user.

use std::str::FromStr;
use std::time::Duration;

use ros2probe_wire::Timestamp;
use ros2probe_wire::time::SECOND;

/// A time in a capture.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CaptureTime {
    /// Time since the epoch.
    At(Timestamp),
    /// Time since the capture's first packet.
    After(Duration),
}

impl CaptureTime {
    /// Returns the absolute time in a capture that begins at `beginning`.
    #[must_use]
    pub fn in_capture(self, beginning: Timestamp) -> Timestamp {
        match self {
            Self::At(time) => time,
            Self::After(elapsed) => beginning + elapsed,
        }
    }
}

impl FromStr for CaptureTime {
    type Err = &'static str;

    /// Parses Unix seconds, or `+` and seconds from the capture's beginning, with nanosecond
    /// precision.
    fn from_str(text: &str) -> Result<Self, Self::Err> {
        const WRONG: &str =
            "must be Unix seconds, or `+S` for seconds from the capture's beginning";
        let (seconds, is_after) = match text.strip_prefix('+') {
            Some(seconds) => (seconds, true),
            None => (text, false),
        };
        let (whole, fraction) = seconds.split_once('.').unwrap_or((seconds, ""));
        let is_number = |text: &str| text.bytes().all(|byte| byte.is_ascii_digit());
        if whole.is_empty() || fraction.len() > 9 || !is_number(whole) || !is_number(fraction) {
            return Err(WRONG);
        }
        let whole: u64 = whole.parse().map_err(|_| WRONG)?;
        let fraction: u64 = format!("{fraction:0<9}").parse().map_err(|_| WRONG)?;
        let nanoseconds = whole.checked_mul(SECOND);
        let nanoseconds = nanoseconds.and_then(|whole| whole.checked_add(fraction));
        let nanoseconds = nanoseconds.ok_or(WRONG)?;
        Ok(if is_after {
            Self::After(Duration::from_nanos(nanoseconds))
        } else {
            Self::At(Timestamp(nanoseconds))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_capture_time_keeps_its_nanoseconds() {
        let at = |text: &str| text.parse::<CaptureTime>();
        let exact = Timestamp(1_795_142_407_300_015_394);
        assert_eq!(at("1795142407.300015394"), Ok(CaptureTime::At(exact)));
        assert_eq!(
            at("+2.5"),
            Ok(CaptureTime::After(Duration::from_millis(2500)))
        );
        assert_eq!(at("+3"), Ok(CaptureTime::After(Duration::from_secs(3))));
        for wrong in [
            "",
            "+",
            ".5",
            "-1",
            "1.0000000001",
            "1e9",
            "12:00",
            "++1",
            "99999999999999",
        ] {
            assert!(at(wrong).is_err(), "{wrong}");
        }
    }
}
