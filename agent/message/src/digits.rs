//! The shortest decimal digits of floats, chosen as Python and numpy choose them.
//!
//! Python and Rust agree on the number of digits that a float needs. If two candidates of that
//! length are equally near, Python takes the even one and Rust the larger one. This module does not
//! decide the layout.

use std::fmt::LowerExp;
use std::str::FromStr;

/// Returns digits with an exponent: `5.25e-7`. Infinities and NaN are written as Rust writes them.
pub(super) fn scientific<T: LowerExp + FromStr + PartialEq + Copy>(value: T) -> String {
    let shortest = format!("{value:e}");
    let mantissa = shortest.split('e').next().unwrap_or_default();
    let precision = mantissa.split_once('.').map_or(0, |(_, part)| part.len());
    // Rust rounds correctly here, with ties to even. Just above a power of two, the result may be
    // another float.
    let nearest = format!("{value:.precision$e}");
    match nearest.parse::<T>() {
        Ok(read) if read == value => nearest,
        _ => shortest,
    }
}

/// Returns the same digits without an exponent: `0.000000525`, and `12` without a point.
pub(super) fn positional<T: LowerExp + FromStr + PartialEq + Copy>(value: T) -> String {
    let text = scientific(value);
    let Some((mantissa, exponent)) = text.split_once('e') else {
        return text;
    };
    let (sign, mantissa) = match mantissa.strip_prefix('-') {
        Some(rest) => ("-", rest),
        None => ("", mantissa),
    };
    let digits = mantissa.replace('.', "");
    let exponent: i32 = exponent.parse().unwrap_or_default();
    let places = usize::try_from(exponent.unsigned_abs()).unwrap_or_default();
    if exponent < 0 {
        return format!("{sign}0.{}{digits}", "0".repeat(places - 1));
    }
    match digits.split_at_checked(places + 1) {
        Some((whole, "")) => format!("{sign}{whole}"),
        Some((whole, fraction)) => format!("{sign}{whole}.{fraction}"),
        None => format!("{sign}{digits:0<width$}", width = places + 1),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// `ros2 topic echo` prints a float32 as the double of the same value.
    #[test]
    fn the_even_one_of_two_equally_near_candidates_is_used() {
        for (value, digits) in [
            (540.926_086_425_781_2, "540.9260864257812"),
            (-540.926_086_425_781_2, "-540.9260864257812"),
            (0.1, "0.1"),
            (12.0, "12"),
            (1200.0, "1200"),
            (0.0, "0"),
            (-0.0, "-0"),
            (1e-7, "0.0000001"),
            (5.25e-7, "0.000000525"),
        ] {
            assert_eq!(positional(value), digits);
        }
        assert_eq!(scientific(f64::INFINITY), "inf");
        assert_eq!(positional(f64::NAN), "NaN");
    }

    #[test]
    fn a_nearer_candidate_that_reads_back_as_another_float_is_not_used() {
        assert_eq!(scientific(2_f64.powi(-44)), "5.684341886080802e-14");
        assert_eq!(scientific(2_f32.powi(-96)), "1.2621775e-29");
        assert_eq!(scientific(5e-324), "5e-324");
        assert_eq!(scientific(9_007_199_254_740_992.0), "9.007199254740992e15");
    }
}
