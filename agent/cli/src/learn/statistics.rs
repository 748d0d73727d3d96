//! Robust statistics: medians, quantiles and deviations that a few outliers do not move.

/// Factor from the median absolute deviation (MAD) to the standard deviation of a normal
/// distribution.
const MAD_TO_DEVIATION: f64 = 1.4826;
/// Significant digits of a threshold.
const SIGNIFICANT_DIGITS: i32 = 3;

/// Summary statistics of a set of values.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Summary {
    /// Minimum value.
    pub minimum: f64,
    /// Median.
    pub median: f64,
    /// 95th percentile.
    pub p95: f64,
    /// Maximum value.
    pub maximum: f64,
    /// Median absolute deviation, scaled to the standard deviation of a normal distribution.
    pub deviation: f64,
}

impl Summary {
    /// Summarizes finite values; others are ignored. Returns `None` without any.
    #[must_use]
    pub fn of(values: impl IntoIterator<Item = f64>) -> Option<Self> {
        let mut values: Vec<f64> = values.into_iter().filter(|it| it.is_finite()).collect();
        values.sort_by(f64::total_cmp);
        let (minimum, maximum) = (*values.first()?, *values.last()?);
        let median = quantile(&values, 0.5)?;
        let mut deviations: Vec<f64> = values.iter().map(|it| (it - median).abs()).collect();
        deviations.sort_by(f64::total_cmp);
        Some(Self {
            minimum,
            median,
            p95: quantile(&values, 0.95)?,
            maximum,
            deviation: MAD_TO_DEVIATION * quantile(&deviations, 0.5)?,
        })
    }
}

/// Returns the quantile of sorted values, interpolated between neighbours. `None` without values.
#[must_use]
#[expect(
    clippy::cast_precision_loss,
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "a place in a list in memory, from 0 to its length"
)]
pub fn quantile(sorted: &[f64], part: f64) -> Option<f64> {
    let last = sorted.len().checked_sub(1)?;
    let place = part.clamp(0.0, 1.0) * last as f64;
    let below = place.floor() as usize;
    let low = *sorted.get(below)?;
    let high = sorted.get(below + 1).copied().unwrap_or(low);
    Some(low + (high - low) * place.fract())
}

/// Rounds a positive value down to three significant digits.
#[must_use]
pub fn rounded_down(value: f64) -> f64 {
    rounded(value, f64::floor)
}

/// Rounds a positive value up to three significant digits.
#[must_use]
pub fn rounded_up(value: f64) -> f64 {
    rounded(value, f64::ceil)
}

#[expect(
    clippy::cast_possible_truncation,
    reason = "the logarithm of a finite number is below 309"
)]
fn rounded(value: f64, round: fn(f64) -> f64) -> f64 {
    if !(value.is_finite() && value > 0.0) {
        return 0.0;
    }
    let shift = SIGNIFICANT_DIGITS - 1 - value.log10().floor() as i32;
    let scale = 10_f64.powi(shift.abs());
    // The quotient of integers is the float nearest to the decimal number, so it prints with few
    // digits.
    if shift >= 0 {
        // Noise of the multiplication, as in 0.07 * 10_000, changes no digit.
        let scaled = value * scale;
        let nearest = scaled.round();
        let is_noise = (scaled - nearest).abs() < nearest.abs() * 1e-12;
        (if is_noise { nearest } else { round(scaled) }) / scale
    } else {
        round(value / scale) * scale
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn outliers_move_neither_median_nor_deviation() {
        let mut values = vec![10.0; 97];
        values.extend([0.0, 1000.0, f64::NAN]);
        let summary = Summary::of(values).unwrap();
        assert_eq!((summary.median, summary.deviation), (10.0, 0.0));
        assert_eq!((summary.minimum, summary.maximum), (0.0, 1000.0));
        assert_eq!(summary.p95, 10.0);
        assert_eq!(Summary::of([f64::NAN]), None);
    }

    #[test]
    fn the_deviation_of_a_uniform_spread_is_scaled() {
        let summary = Summary::of((0..=100).map(f64::from)).unwrap();
        assert_eq!((summary.median, summary.p95), (50.0, 95.0));
        assert!((summary.deviation - 25.0 * MAD_TO_DEVIATION).abs() < 1e-9);
    }

    #[test]
    fn thresholds_print_with_three_digits() {
        for (value, down, up) in [
            (0.07, "0.07", "0.07"),
            (12.345, "12.3", "12.4"),
            (1999.9, "1990", "2000"),
            (0.000_123_45, "0.000123", "0.000124"),
            (80.0, "80", "80"),
            (7.92, "7.92", "7.92"),
        ] {
            assert_eq!(rounded_down(value).to_string(), down, "{value}");
            assert_eq!(rounded_up(value).to_string(), up, "{value}");
        }
        assert_eq!((rounded_down(0.0), rounded_up(-1.0)), (0.0, 0.0));
    }

    proptest! {
        #[test]
        fn quantiles_stay_between_neighbours(mut values in prop::collection::vec(-1e9..1e9, 1..50),
            part in 0.0..=1.0) {
            values.sort_by(f64::total_cmp);
            let found = quantile(&values, part).unwrap();
            prop_assert!(values[0] <= found && found <= values[values.len() - 1]);
            let below = values.iter().filter(|it| **it < found).count() as f64;
            prop_assert!(below <= part * (values.len() - 1) as f64 + 1.0);
        }

        #[test]
        fn summary_values_are_ordered(values in prop::collection::vec(0.0..1e6, 1..50)) {
            let it = Summary::of(values).unwrap();
            prop_assert!(it.minimum <= it.median && it.median <= it.p95 && it.p95 <= it.maximum);
            prop_assert!(it.deviation >= 0.0);
        }

        #[test]
        fn rounding_loses_less_than_a_hundredth(value in 1e-6..1e9) {
            let (down, up) = (rounded_down(value), rounded_up(value));
            prop_assert!(down <= value * (1.0 + 1e-11) && value <= up * (1.0 + 1e-11));
            prop_assert!(down >= value * 0.99 && up <= value * 1.011);
        }
    }
}
