//! Figures of a topic over a run, in a fixed number of points: a long run has longer steps.

/// Maximum number of points of a topic. It is even.
const MAX_POINTS: usize = 600;

/// Figures of one step; a value that is not known is NaN.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Point {
    /// Messages per second.
    pub rate: f32,
    /// Payload bytes per second.
    pub bandwidth: f32,
    /// Median latency in seconds.
    pub median: f32,
    /// 99th percentile of the latency in seconds.
    pub p99: f32,
}

/// Points of equal length.
#[derive(Clone, Debug)]
pub struct Series {
    /// Time of the first point, in seconds from the start of the command.
    start: f64,
    /// Seconds of a point.
    step: usize,
    points: Vec<Point>,
    /// Seconds of the point that is not complete.
    pending: Vec<Point>,
}

/// Means of a part of a run.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Means {
    /// Mean, lowest and highest messages per second.
    pub rate: Option<(f64, f64, f64)>,
    /// Payload bytes per second.
    pub bandwidth: Option<f64>,
    /// Mean of the medians of the latency, in seconds.
    pub median: Option<f64>,
    /// Highest 99th percentile of the latency, in seconds.
    pub p99: Option<f64>,
}

impl Series {
    /// Returns an empty series that begins at `start`.
    pub(super) const fn new(start: f64) -> Self {
        Self {
            start,
            step: 1,
            points: Vec::new(),
            pending: Vec::new(),
        }
    }

    /// Adds the figures of a second.
    pub(super) fn push(&mut self, second: Point) {
        self.pending.push(second);
        if self.pending.len() < self.step {
            return;
        }
        self.points.push(merged(&self.pending));
        self.pending.clear();
        if self.points.len() == MAX_POINTS {
            self.points = self.points.chunks(2).map(merged).collect();
            self.step *= 2;
        }
    }

    /// Returns the time and the rate of each point.
    #[expect(
        clippy::cast_precision_loss,
        reason = "a run has less than 2^52 seconds"
    )]
    pub fn rates(&self) -> impl Iterator<Item = (f64, f32)> {
        let rate =
            |(index, point): (usize, &Point)| (self.start + (index * self.step) as f64, point.rate);
        self.points.iter().enumerate().map(rate)
    }

    /// Returns the means between two times.
    #[must_use]
    pub fn means(&self, from: f64, until: f64) -> Means {
        let times = self.rates().map(|(time, _)| time);
        let judged: Vec<Point> = times
            .zip(&self.points)
            .filter(|(time, _)| (from..=until).contains(time))
            .map(|(_, point)| *point)
            .collect();
        if judged.is_empty() {
            return Means::default();
        }
        let whole = merged(&judged);
        let known = |value: f32| (!value.is_nan()).then_some(f64::from(value));
        let rates = judged.iter().map(|point| point.rate);
        let lowest = rates.clone().fold(f32::NAN, f32::min);
        let highest = rates.fold(f32::NAN, f32::max);
        Means {
            rate: known(whole.rate).map(|mean| (mean, f64::from(lowest), f64::from(highest))),
            bandwidth: known(whole.bandwidth),
            median: known(whole.median),
            p99: known(whole.p99),
        }
    }
}

/// Returns the means of points, and their highest 99th percentile.
#[expect(
    clippy::cast_precision_loss,
    reason = "a step has less than 2^23 seconds"
)]
fn merged(points: &[Point]) -> Point {
    let mean = |value: fn(&Point) -> f32| {
        let known: Vec<f32> = points.iter().map(value).filter(|it| !it.is_nan()).collect();
        known.iter().sum::<f32>() / known.len() as f32
    };
    Point {
        rate: mean(|point| point.rate),
        bandwidth: mean(|point| point.bandwidth),
        median: mean(|point| point.median),
        p99: points.iter().map(|it| it.p99).fold(f32::NAN, f32::max),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn second(rate: f32) -> Point {
        Point {
            rate,
            bandwidth: rate * 10.0,
            median: f32::NAN,
            p99: f32::NAN,
        }
    }

    #[test]
    fn a_long_run_has_longer_steps_with_the_same_means() {
        let mut series = Series::new(2.0);
        for index in 0..4 * MAX_POINTS {
            series.push(second(if index % 2 == 0 { 10.0 } else { 20.0 }));
        }
        assert!(series.points.len() < MAX_POINTS);
        assert_eq!(series.step, 8);
        let means = series.means(0.0, 1e9);
        assert_eq!(means.rate, Some((15.0, 15.0, 15.0)));
        assert_eq!(means.bandwidth, Some(150.0));
        let times: Vec<f64> = series.rates().take(2).map(|(time, _)| time).collect();
        assert_eq!(times, [2.0, 10.0]);
    }

    #[test]
    fn unknown_figures_are_left_out_of_means() {
        let mut series = Series::new(0.0);
        for rate in [f32::NAN, 10.0, 30.0, 1000.0] {
            series.push(second(rate));
        }
        let means = series.means(0.0, 2.0);
        assert_eq!(means.rate, Some((20.0, 10.0, 30.0)));
        assert_eq!((means.median, means.p99), (None, None));
        assert_eq!(series.means(10.0, 20.0), Means::default());
    }
}
