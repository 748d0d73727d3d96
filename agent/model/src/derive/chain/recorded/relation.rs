//! Whether the second of three topics is on the path from the first to the third, by delays.
//!
//! Let `second` and `third` be the delays of two topics after the first, for each stamp. If the
//! third derives from the second, its delay contains that of the second: the slope of `third` over
//! `second` is 1. If both derive from the first independently, the slope is 0. The slope has a
//! standard error. If that leaves both cases possible, the relation is unclear.

/// Minimum number of stamps for the computation of a relation.
const MIN_STAMPS: usize = 20;
/// One in this many delays is left out at each end, because stalls delay all nodes together.
const TRIMMED_DIVISOR: usize = 20;

/// The relation of three topics.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Relation {
    /// The third derives from the second.
    Through,
    /// The third derives from the first without the second.
    Beside,
    /// The delays do not decide.
    Unclear,
}

/// Returns the relation by the delays of the second and third topic after the first, in seconds.
pub(super) fn relation(delays: &[(f64, f64)]) -> Relation {
    let Some((second, third)) = bounds(delays, |pair| pair.0).zip(bounds(delays, |pair| pair.1))
    else {
        return Relation::Unclear;
    };
    let inner: Vec<_> = delays
        .iter()
        .filter(|(one, other)| {
            (second.0..=second.1).contains(one) && (third.0..=third.1).contains(other)
        })
        .collect();
    if inner.len() < MIN_STAMPS {
        return Relation::Unclear;
    }
    #[expect(
        clippy::cast_precision_loss,
        reason = "numbers of stamps are far below 2^52"
    )]
    let count = inner.len() as f64;
    let mean =
        |value: fn(&(f64, f64)) -> f64| inner.iter().map(|pair| value(pair)).sum::<f64>() / count;
    let (mean_second, mean_third) = (mean(|pair| pair.0), mean(|pair| pair.1));
    let (mut spread, mut common, mut rest) = (0.0, 0.0, 0.0);
    for (second, third) in &inner {
        let (second, third) = (second - mean_second, third - mean_third);
        spread += second * second;
        common += second * third;
        rest += third * third;
    }
    // Delays of the second topic that differ by less than a microsecond show nothing.
    if spread <= count * 1e-12 {
        return Relation::Unclear;
    }
    let slope = common / spread;
    let residual = slope.mul_add(-common, rest).max(0.0) / (count - 2.0);
    let error = 2.0 * (residual / spread).sqrt();
    if slope - error > 0.5 {
        Relation::Through
    } else if slope + error < 0.5 {
        Relation::Beside
    } else {
        Relation::Unclear
    }
}

/// Returns the range of the delays without the outer ones.
fn bounds(delays: &[(f64, f64)], value: fn(&(f64, f64)) -> f64) -> Option<(f64, f64)> {
    let mut sorted: Vec<f64> = delays.iter().map(value).collect();
    sorted.sort_by(f64::total_cmp);
    let outer = sorted.len() / TRIMMED_DIVISOR;
    Some((*sorted.get(outer)?, *sorted.iter().rev().nth(outer)?))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns pseudo-random delays from 10 to 12 ms, in seconds.
    fn delays(seed: u64) -> impl Iterator<Item = f64> {
        let mut state = seed;
        std::iter::repeat_with(move || {
            state = state
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1);
            let part = u32::try_from(state >> 33).unwrap_or(0);
            f64::from(part).mul_add(0.002 / f64::from(u32::MAX / 2), 0.01)
        })
    }

    #[test]
    fn a_third_topic_that_adds_its_delay_to_the_second_derives_from_it() {
        let pairs = delays(1).zip(delays(2)).take(100);
        let through: Vec<_> = pairs.map(|(one, other)| (one, one + other)).collect();
        assert_eq!(relation(&through), Relation::Through);
        assert_eq!(relation(&through[..19]), Relation::Unclear);
    }

    #[test]
    fn a_third_topic_with_an_independent_delay_does_not_derive_from_the_second() {
        let pairs = delays(1).zip(delays(2)).take(100);
        let beside: Vec<_> = pairs.map(|(one, other)| (one, other + 0.02)).collect();
        assert_eq!(relation(&beside), Relation::Beside);
    }

    #[test]
    fn constant_delays_are_unclear_and_stalls_of_all_nodes_are_ignored() {
        assert_eq!(relation(&[(0.01, 0.02); 100]), Relation::Unclear);
        assert_eq!(relation(&[]), Relation::Unclear);
        // Both topics are late in some rounds, and independent in the others.
        let pairs = delays(1).zip(delays(2)).take(100).enumerate();
        let stalls: Vec<_> = pairs
            .map(|(round, (one, other))| {
                let stall = if round % 25 == 0 { 0.5 } else { 0.0 };
                (one + stall, other + stall + 0.02)
            })
            .collect();
        assert_eq!(relation(&stalls), Relation::Beside);
    }
}
