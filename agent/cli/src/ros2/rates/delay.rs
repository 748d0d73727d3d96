//! Age of one topic's messages by the stamp in their header, as `ros2 topic delay` reports it.
//!
//! The age is the one at capture; time spent in a subscriber's process is not included.

use super::NANOSECOND;
use super::window::Window;

/// Ages of one topic's messages.
#[derive(Debug)]
pub struct Ages {
    ages: Window,
    first: Option<i64>,
    newest: i64,
    printed: Option<i64>,
}

/// Values of one report, as text.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Age {
    /// Mean age in seconds.
    pub delay: String,
    /// Minimum age, in seconds.
    pub min: String,
    /// Maximum age, in seconds.
    pub max: String,
    /// Standard deviation, in seconds.
    pub standard_deviation: String,
    /// Number of messages in the window.
    pub window: String,
}

impl Ages {
    /// Creates an empty window of `window` messages.
    #[must_use]
    pub fn new(window: usize) -> Self {
        Self {
            ages: Window::new(window),
            first: None,
            newest: 0,
            printed: None,
        }
    }

    /// Adds a message. The first message is not counted. A message earlier than the first restarts
    /// the measurement, since the clock was set back.
    pub fn add_message(&mut self, time: i64, stamp: i64) {
        if self.first.is_none_or(|first| first > time) {
            self.first = Some(time);
            self.ages.clear();
        } else {
            self.ages.push(time.saturating_sub(stamp));
        }
        self.newest = time;
    }

    /// Records a message whose stamp was not seen. The known ages are then reported again.
    pub fn add_unstamped(&mut self, time: i64) {
        self.newest = self.newest.max(time);
    }

    /// Returns the lines of a periodic report; `None` before the second message.
    pub fn lines(&mut self) -> Option<String> {
        if self.ages.is_empty() {
            return None;
        }
        let text = match self.report() {
            Some(age) => age.lines(),
            None => "no new messages\n".to_owned(),
        };
        Some(text)
    }

    /// Returns a periodic report; `None` without a message since the last report.
    pub fn report(&mut self) -> Option<Age> {
        if self.printed == Some(self.newest) {
            return None;
        }
        let found = self.ages.statistics()?;
        self.printed = Some(self.newest);
        Some(Age {
            delay: format!("{:.3}", found.mean * NANOSECOND),
            min: format!("{:.3}", found.min as f64 * NANOSECOND),
            max: format!("{:.3}", found.max as f64 * NANOSECOND),
            standard_deviation: format!("{:.5}", found.standard_deviation * NANOSECOND),
            window: found.count.to_string(),
        })
    }
}

impl Age {
    fn lines(&self) -> String {
        format!(
            "average delay: {}\n\tmin: {}s max: {}s std dev: {}s window: {}\n",
            self.delay, self.min, self.max, self.standard_deviation, self.window
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MILLISECOND: i64 = 1_000_000;

    #[test]
    fn the_first_message_is_not_counted() {
        let mut ages = Ages::new(10);
        ages.add_message(1000 * MILLISECOND, 500 * MILLISECOND);
        assert_eq!(ages.lines(), None);
        ages.add_message(1100 * MILLISECOND, 1099 * MILLISECOND);
        ages.add_message(1200 * MILLISECOND, 1197 * MILLISECOND);
        // 1 ms and 3 ms: the mean is 2 ms, and each differs from it by 1 ms.
        let text = "average delay: 0.002\n\tmin: 0.001s max: 0.003s std dev: 0.00100s window: 2\n";
        assert_eq!(ages.lines().as_deref(), Some(text));
        assert_eq!(ages.lines().as_deref(), Some("no new messages\n"));
        ages.add_message(1300 * MILLISECOND, 1300 * MILLISECOND);
        assert!(ages.lines().unwrap().ends_with("window: 3\n"));
    }

    #[test]
    fn messages_with_an_unseen_stamp_count_as_new_messages() {
        let mut ages = Ages::new(10);
        ages.add_unstamped(900 * MILLISECOND);
        assert_eq!(ages.lines(), None);
        for at in [1000, 1100] {
            ages.add_message(at * MILLISECOND, (at - 2) * MILLISECOND);
        }
        let text = ages.lines().unwrap();
        ages.add_unstamped(1200 * MILLISECOND);
        assert_eq!(ages.lines(), Some(text));
        assert_eq!(ages.lines().as_deref(), Some("no new messages\n"));
    }

    #[test]
    fn a_stamp_in_the_future_leads_to_a_negative_delay() {
        let mut ages = Ages::new(10);
        ages.add_message(1000 * MILLISECOND, 0);
        ages.add_message(1000 * MILLISECOND, 1000 * MILLISECOND + 400_000);
        // Half a millisecond and less rounds to a zero that keeps its sign, as in ros2cli.
        let text =
            "average delay: -0.000\n\tmin: -0.000s max: -0.000s std dev: 0.00000s window: 1\n";
        assert_eq!(ages.lines().as_deref(), Some(text));
    }
}
