//! The newest values of a quantity, with their mean, extremes and deviation.
//!
//! A window is a number of values, not a duration: an old pause stays in it until enough newer
//! values have arrived. This matches ros2cli.

use std::collections::VecDeque;

/// A bounded number of the newest values.
#[derive(Clone, Debug)]
pub struct Window {
    values: VecDeque<i64>,
    size: usize,
}

/// Statistics of a window, in the unit of its values.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Statistics {
    /// Arithmetic mean.
    pub mean: f64,
    /// Minimum value.
    pub min: i64,
    /// Maximum value.
    pub max: i64,
    /// Standard deviation of the population: the sum of squares is divided by the number of values.
    pub standard_deviation: f64,
    /// Number of values.
    pub count: usize,
}

impl Window {
    /// Creates an empty window for `size` values.
    #[must_use]
    pub fn new(size: usize) -> Self {
        let values = VecDeque::new();
        Self { values, size }
    }

    /// Adds a value, and removes the oldest one if the window is full.
    pub fn push(&mut self, value: i64) {
        self.values.push_back(value);
        if self.values.len() > self.size {
            self.values.pop_front();
        }
    }

    /// Removes all values.
    pub fn clear(&mut self) {
        self.values.clear();
    }

    /// Returns whether the window is empty.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.values.is_empty()
    }

    /// Returns the oldest value; `None` if the window is empty.
    #[must_use]
    pub fn oldest(&self) -> Option<i64> {
        self.values.front().copied()
    }

    /// Returns the number of values.
    #[must_use]
    pub fn count(&self) -> usize {
        self.values.len()
    }

    /// Returns the sum of all values.
    #[must_use]
    pub fn sum(&self) -> i128 {
        self.values.iter().map(|value| i128::from(*value)).sum()
    }

    /// Returns the statistics of the window; `None` if it is empty.
    #[must_use]
    pub fn statistics(&self) -> Option<Statistics> {
        let (min, max) = (self.values.iter().min()?, self.values.iter().max()?);
        let count = self.values.len() as f64;
        let mean = self.sum() as f64 / count;
        let mut squares = 0.0;
        for value in &self.values {
            let distance = *value as f64 - mean;
            squares += distance * distance;
        }
        Some(Statistics {
            mean,
            min: *min,
            max: *max,
            standard_deviation: (squares / count).sqrt(),
            count: self.values.len(),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn window(size: usize, values: &[i64]) -> Window {
        let mut window = Window::new(size);
        for value in values {
            window.push(*value);
        }
        window
    }

    #[test]
    fn the_deviation_is_that_of_the_population() {
        // Mean 5, squares 9 + 1 + 1 + 1 + 0 + 0 + 4 + 16 = 32, variance 32 / 8 = 4.
        let found = window(100, &[2, 4, 4, 4, 5, 5, 7, 9]).statistics();
        let expected = Statistics {
            mean: 5.0,
            min: 2,
            max: 9,
            standard_deviation: 2.0,
            count: 8,
        };
        assert_eq!(found, Some(expected));
        assert_eq!(Window::new(3).statistics(), None);
    }

    #[test]
    fn a_full_window_drops_the_oldest_value() {
        let window = window(2, &[100, 1, 3]);
        assert_eq!(window.oldest(), Some(1));
        let found = window.statistics().unwrap();
        assert_eq!((found.mean, found.max, found.count), (2.0, 3, 2));
    }

    #[test]
    fn negative_values_and_values_of_any_size_are_summed() {
        let window = window(4, &[i64::MAX, i64::MAX, -1]);
        assert_eq!(window.sum(), 2 * i128::from(i64::MAX) - 1);
        assert_eq!(window.statistics().map(|found| found.min), Some(-1));
    }
}
