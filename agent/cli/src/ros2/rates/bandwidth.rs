//! Bandwidth of one topic, as `ros2 topic bw` reports it.
//!
//! The interval reaches from the oldest message of the window to now, so the value decays during
//! silence. A size is that of the serialized payload with its encapsulation, without headers of
//! RTPS and UDP.

use super::NANOSECOND;
use super::window::Window;

/// Sizes and arrivals of one topic.
#[derive(Debug)]
pub struct Sizes {
    sizes: Window,
    times: Window,
    newest: i64,
    printed: Option<i64>,
}

/// Values of one report, as text in one unit.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Bandwidth {
    /// Bytes per second, with `/s`.
    pub bandwidth: String,
    /// Number of messages in the window.
    pub window: String,
    /// Mean size.
    pub mean: String,
    /// Minimum size.
    pub min: String,
    /// Maximum size.
    pub max: String,
}

/// The time is not after the oldest message, because the clock was set back. The window is now
/// empty.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TimeReset;

impl Sizes {
    /// Creates an empty window of `window` messages.
    #[must_use]
    pub fn new(window: usize) -> Self {
        Self {
            sizes: Window::new(window),
            times: Window::new(window),
            newest: 0,
            printed: None,
        }
    }

    /// Adds a message that arrived at `time`, in nanoseconds.
    pub fn add_message(&mut self, time: i64, size: u32) {
        self.sizes.push(i64::from(size));
        self.times.push(time);
        self.newest = time;
    }

    /// Returns the report at `now`; `None` with fewer than two messages.
    ///
    /// # Errors
    ///
    /// Returns [`TimeReset`] if the clock was set back.
    pub fn report(&mut self, now: i64) -> Result<Option<Bandwidth>, TimeReset> {
        let (Some(oldest), Some(found)) = (self.times.oldest(), self.sizes.statistics()) else {
            return Ok(None);
        };
        if found.count < 2 {
            return Ok(None);
        }
        if now <= oldest {
            self.sizes.clear();
            self.times.clear();
            return Err(TimeReset);
        }
        self.printed = Some(self.newest);
        let elapsed = now.saturating_sub(oldest) as f64 * NANOSECOND;
        let bytes_per_second = self.sizes.sum() as f64 / elapsed;
        let unit = Unit::of(bytes_per_second);
        Ok(Some(Bandwidth {
            bandwidth: unit.text(bytes_per_second) + "/s",
            window: found.count.to_string(),
            mean: unit.text(found.mean),
            min: unit.text(found.min as f64),
            max: unit.text(found.max as f64),
        }))
    }

    /// Returns the report at `now` if a message arrived since the last one (Lyrical and later).
    ///
    /// # Errors
    ///
    /// Returns [`TimeReset`] if the clock was set back.
    pub fn report_of_new(&mut self, now: i64) -> Result<Option<Bandwidth>, TimeReset> {
        if self.printed == Some(self.newest) {
            return Ok(None);
        }
        self.report(now)
    }
}

impl Bandwidth {
    /// Returns the two lines of a single topic.
    #[must_use]
    pub fn lines(&self) -> String {
        format!(
            "{} from {} messages\n\tMessage size mean: {} min: {} max: {}\n",
            self.bandwidth, self.window, self.mean, self.min, self.max
        )
    }
}

/// Decimal unit of all values in a report; the largest is mega.
#[derive(Clone, Copy)]
enum Unit {
    Bytes,
    Kilobytes,
    Megabytes,
}

impl Unit {
    fn of(bytes_per_second: f64) -> Self {
        if bytes_per_second < 1000.0 {
            Self::Bytes
        } else if bytes_per_second < 1_000_000.0 {
            Self::Kilobytes
        } else {
            Self::Megabytes
        }
    }

    fn text(self, bytes: f64) -> String {
        match self {
            Self::Bytes => format!("{bytes:.0} B"),
            Self::Kilobytes => format!("{:.2} KB", bytes / 1000.0),
            // Two divisions, as in ros2cli: one division by a million can round differently.
            Self::Megabytes => format!("{:.2} MB", bytes / 1000.0 / 1000.0),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    use super::super::SECOND;

    #[test]
    fn the_interval_of_a_bandwidth_reaches_to_the_present() {
        let mut sizes = Sizes::new(100);
        sizes.add_message(10 * SECOND, 28);
        assert_eq!(sizes.report(11 * SECOND), Ok(None));
        sizes.add_message(10 * SECOND + SECOND / 2, 32);
        let text = |sizes: &mut Sizes, now| sizes.report(now).unwrap().unwrap().lines();
        assert_eq!(
            text(&mut sizes, 11 * SECOND),
            "60 B/s from 2 messages\n\tMessage size mean: 30 B min: 28 B max: 32 B\n"
        );
        // No further message: 60 bytes in 4 s.
        assert!(text(&mut sizes, 14 * SECOND).starts_with("15 B/s from 2"));
        assert_eq!(sizes.report_of_new(14 * SECOND), Ok(None));
    }

    #[test]
    fn all_numbers_of_a_report_have_one_unit() {
        let mut sizes = Sizes::new(100);
        for _ in 0..3 {
            sizes.add_message(SECOND, 644_148);
        }
        let text = |sizes: &mut Sizes, now| sizes.report(now).unwrap().unwrap().lines();
        assert_eq!(
            text(&mut sizes, 2 * SECOND),
            "1.93 MB/s from 3 messages\n\tMessage size mean: 0.64 MB min: 0.64 MB max: 0.64 MB\n"
        );
        assert!(text(&mut sizes, 3 * SECOND).starts_with("966.22 KB/s from 3"));
    }

    #[test]
    fn a_clock_set_back_empties_the_window() {
        let mut sizes = Sizes::new(100);
        sizes.add_message(10 * SECOND, 1);
        sizes.add_message(11 * SECOND, 1);
        assert_eq!(sizes.report(10 * SECOND), Err(TimeReset));
        assert_eq!(sizes.report(12 * SECOND), Ok(None));
    }
}
