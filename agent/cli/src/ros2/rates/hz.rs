//! Intervals between messages of one topic, as `ros2 topic hz` reports them.
//!
//! A message arrives when it is captured, not when it is read.

use super::window::Window;
use super::{NANOSECOND, SECOND};

/// Arrivals of one topic.
#[derive(Debug)]
pub struct Intervals {
    between: Window,
    first: Option<i64>,
    newest: i64,
    printed: Option<i64>,
}

/// Values of one report, as text.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Rate {
    /// Messages per second.
    pub rate: String,
    /// Minimum interval, in seconds.
    pub min: String,
    /// Maximum interval, in seconds.
    pub max: String,
    /// Standard deviation of the intervals, in seconds.
    pub standard_deviation: String,
    /// Number of intervals in the window.
    pub window: String,
}

impl Intervals {
    /// Creates an empty window of `window` intervals.
    #[must_use]
    pub fn new(window: usize) -> Self {
        Self {
            between: Window::new(window),
            first: None,
            newest: 0,
            printed: None,
        }
    }

    /// Returns the time at which a message counts if messages up to `settled` were counted. A
    /// message in shared memory may be seen after a later one of another writer: it then counts at
    /// the time of that one. If the newest message is later than `settled`, the clock was set back.
    #[must_use]
    pub fn time_in_order(&self, time: i64, settled: i64) -> i64 {
        if self.first.is_some() && self.newest <= settled {
            time.max(self.newest)
        } else {
            time
        }
    }

    /// Adds a message. The first message begins the measurement. A message earlier than the first
    /// restarts it, since the clock was set back.
    pub fn add_message(&mut self, time: i64) {
        if self.first.is_none_or(|first| first > time) {
            self.first = Some(time);
            self.between.clear();
        } else {
            self.between.push(time.saturating_sub(self.newest));
        }
        self.newest = time;
    }

    /// Returns the report that a message causes (Humble, Jazzy) a second or more after the message
    /// of the last report. The first interval only starts the count. Returns `None` if no report is
    /// due.
    pub fn report_at_message(&mut self) -> Option<Rate> {
        if self.between.is_empty() {
            return None;
        }
        let Some(printed) = self.printed else {
            self.printed = Some(self.newest);
            return None;
        };
        // After the clock was set back, the newest message is earlier than the one of the last
        // report. Reports resume a second after the latter.
        if self.newest < printed.saturating_add(SECOND) {
            return None;
        }
        self.report()
    }

    /// Returns a periodic report (Kilted and later); `None` without a message since the last
    /// report.
    pub fn report_at_second(&mut self) -> Option<Rate> {
        if self.printed == Some(self.newest) {
            return None;
        }
        self.report()
    }

    fn report(&mut self) -> Option<Rate> {
        let found = self.between.statistics()?;
        self.printed = Some(self.newest);
        let rate = if found.mean > 0.0 {
            1.0 / found.mean
        } else {
            0.0
        };
        Some(Rate {
            rate: format!("{:.3}", rate * 1e9),
            min: format!("{:.3}", found.min as f64 * NANOSECOND),
            max: format!("{:.3}", found.max as f64 * NANOSECOND),
            standard_deviation: format!("{:.5}", found.standard_deviation * NANOSECOND),
            window: found.count.to_string(),
        })
    }
}

impl Rate {
    /// Returns the two lines of a single topic.
    #[must_use]
    pub fn lines(&self) -> String {
        format!(
            "average rate: {}\n\tmin: {}s max: {}s std dev: {}s window: {}\n",
            self.rate, self.min, self.max, self.standard_deviation, self.window
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const START: i64 = 1_795_142_000_000_000_000;

    fn at(intervals: &mut Intervals, milliseconds: i64) -> Option<String> {
        intervals.add_message(START + milliseconds * 1_000_000);
        intervals.report_at_message().map(|rate| rate.lines())
    }

    #[test]
    fn a_message_a_second_after_the_last_report_causes_the_next_one() {
        let mut intervals = Intervals::new(10_000);
        // Messages every 100 ms: the second one starts the count of seconds.
        for step in 0..=10 {
            assert_eq!(at(&mut intervals, step * 100), None, "{step}");
        }
        let first =
            "average rate: 10.000\n\tmin: 0.100s max: 0.100s std dev: 0.00000s window: 11\n";
        assert_eq!(at(&mut intervals, 1100).as_deref(), Some(first));
        // 13 intervals in 2.1 s.
        assert_eq!(at(&mut intervals, 1999), None);
        let second =
            "average rate: 6.190\n\tmin: 0.100s max: 0.899s std dev: 0.21289s window: 13\n";
        assert_eq!(at(&mut intervals, 2100).as_deref(), Some(second));
    }

    #[test]
    fn each_message_of_a_slow_topic_after_the_second_causes_a_report() {
        let mut intervals = Intervals::new(10_000);
        assert_eq!(at(&mut intervals, 0), None);
        assert_eq!(at(&mut intervals, 5000), None);
        for step in 2..5 {
            assert!(at(&mut intervals, step * 5000).is_some(), "{step}");
        }
    }

    #[test]
    fn the_window_counts_intervals() {
        let mut intervals = Intervals::new(2);
        for time in [0, 900, 1000, 1010] {
            at(&mut intervals, time);
        }
        let text = at(&mut intervals, 1910).unwrap();
        assert!(text.contains("min: 0.010s max: 0.900s"), "{text}");
        assert!(text.ends_with("window: 2\n"), "{text}");
    }

    #[test]
    fn a_clock_set_back_restarts_the_intervals() {
        let mut intervals = Intervals::new(100);
        at(&mut intervals, 10_000);
        at(&mut intervals, 10_100);
        assert_eq!(at(&mut intervals, 5_000), None);
        intervals.add_message(START + 5_500 * 1_000_000);
        let rate = intervals.report_at_second().unwrap();
        assert_eq!((rate.rate.as_str(), rate.window.as_str()), ("2.000", "1"));
    }

    #[test]
    fn messages_at_the_same_instant_have_a_rate_of_zero() {
        let mut intervals = Intervals::new(100);
        intervals.add_message(START);
        intervals.add_message(START);
        let rate = intervals.report_at_second().unwrap();
        assert_eq!(rate.rate, "0.000");
    }

    #[test]
    fn a_second_without_a_message_leads_to_no_report() {
        let mut intervals = Intervals::new(100);
        intervals.add_message(START);
        assert_eq!(intervals.report_at_second(), None);
        intervals.add_message(START + 1);
        assert!(intervals.report_at_second().is_some());
        assert_eq!(intervals.report_at_second(), None);
    }
}
