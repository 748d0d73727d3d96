//! A count over the judged part of a run. The end of that part is known only at the end of the run,
//! so the latest entries keep their times.

use std::collections::VecDeque;

use super::Rules;

/// Seconds by which the state of the agent may be late.
pub(super) const MAX_STATE_DELAY: f64 = 1.5;

/// A count over time.
#[derive(Clone, Debug, Default)]
pub struct Tally {
    /// Count before the entries of `recent`.
    settled: u64,
    recent: VecDeque<(f64, u64)>,
    /// Count over the whole run.
    total: u64,
    /// Time of the first entry that is not in the time to settle.
    first: Option<f64>,
}

impl Tally {
    /// A count of nothing.
    pub(super) const EMPTY: Self = Self {
        settled: 0,
        recent: VecDeque::new(),
        total: 0,
        first: None,
    };

    /// Adds `count` at the time `now`, in seconds from the start of the command.
    pub(super) fn add(&mut self, now: f64, count: u64, rules: &Rules) {
        self.total += count;
        if now < rules.settle || count == 0 {
            return;
        }
        self.first.get_or_insert(now);
        self.recent.push_back((now, count));
        let certain = now - rules.shutdown - 2.0 * MAX_STATE_DELAY;
        while let Some((_, count)) = self.recent.pop_front_if(|(time, _)| *time < certain) {
            self.settled += count;
        }
    }

    /// Returns the count of the judged part, which ends at `until`.
    #[must_use]
    pub fn judged(&self, until: f64) -> u64 {
        let recent = self.recent.iter().filter(|(time, _)| *time <= until);
        self.settled + recent.map(|(_, count)| count).sum::<u64>()
    }

    /// Returns the count of the whole run.
    #[must_use]
    pub const fn total(&self) -> u64 {
        self.total
    }

    /// Returns the time of the first entry that may be judged.
    #[must_use]
    pub const fn first(&self) -> Option<f64> {
        self.first
    }
}

#[cfg(test)]
mod tests {
    use super::super::FailOn;
    use super::*;

    const RULES: Rules = Rules {
        settle: 5.0,
        shutdown: 10.0,
        fail_on: FailOn::Error,
        max_lost: Some(0),
        is_strict: false,
    };

    #[test]
    fn entries_between_settling_and_shutdown_are_counted() {
        let mut tally = Tally::default();
        for second in 0..40 {
            tally.add(f64::from(second), 1, &RULES);
        }
        assert_eq!((tally.total(), tally.first()), (40, Some(5.0)));
        assert_eq!(tally.judged(39.0), 35);
        assert_eq!(tally.judged(30.5), 26);
        assert!(tally.recent.len() < 20, "{}", tally.recent.len());
    }
}
