//! The share of traces that are exported, decided by their ids as OpenTelemetry's samplers do.

/// The bits of a trace id that decide whether the trace is exported.
const RANDOM_BITS: u64 = (1 << 56) - 1;

/// A share above 0. A larger share contains all traces of a smaller one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Share {
    threshold: u64,
}

impl Share {
    /// Returns the share with this ratio, or `None` if the ratio is at most 0 or not a number.
    #[must_use]
    pub fn of(ratio: f64) -> Option<Self> {
        if ratio.is_nan() || ratio <= 0.0 {
            return None;
        }
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            clippy::cast_precision_loss,
            reason = "a part of 2^56"
        )]
        let threshold = ((1.0 - ratio.min(1.0)) * RANDOM_BITS as f64) as u64;
        Some(Self { threshold })
    }

    /// Returns whether the share contains this trace.
    #[must_use]
    pub const fn takes(self, trace_id: u128) -> bool {
        trace_id as u64 & RANDOM_BITS >= self.threshold
    }
}
