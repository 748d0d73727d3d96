//! Exemplars of a histogram: for each bucket the newest duration whose trace is exported.
//!
//! Only the sampling decision matters. An exemplar stays even if its spans are dropped later, which
//! is counted.

use std::num::NonZero;
use std::sync::Arc;

use ros2probe_wire::Timestamp;

use crate::facts::histogram::{BOUNDS, Histogram};

/// Number of buckets of a histogram.
const BUCKETS: usize = BOUNDS.len() + 1;

/// A duration and its trace.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Exemplar {
    /// The duration in seconds.
    pub seconds: f64,
    /// Id of the trace; OpenTelemetry forbids an id of zeros.
    pub trace_id: NonZero<u128>,
    /// End of the duration, by the wall clock.
    pub at: Timestamp,
}

/// One slot for each bucket of a histogram. Without exemplars, only a pointer is stored; the slots
/// need [`Exemplars::BYTES`] bytes. Snapshots share the slots.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Exemplars {
    slots: Option<Arc<[Option<Exemplar>; BUCKETS]>>,
}

impl Exemplars {
    /// Size of the slots in bytes.
    pub const BYTES: usize = size_of::<[Option<Exemplar>; BUCKETS]>();

    /// Observes a duration in the histogram, and keeps it as an exemplar if its trace is exported.
    pub fn observe(
        &mut self,
        histogram: &mut Histogram,
        seconds: f64,
        trace_id: Option<u128>,
        at: Timestamp,
    ) {
        histogram.observe(seconds);
        let trace_id = trace_id.and_then(NonZero::new);
        if let (Some(trace_id), Some(bucket)) = (trace_id, histogram.bucket(seconds)) {
            let slots = self.slots.get_or_insert_with(|| Arc::new([None; BUCKETS]));
            if let Some(slot) = Arc::make_mut(slots).get_mut(bucket) {
                *slot = Some(Exemplar {
                    seconds,
                    trace_id,
                    at,
                });
            }
        }
    }

    /// Returns the exemplar of the bucket at this position.
    #[must_use]
    pub fn get(&self, bucket: usize) -> Option<&Exemplar> {
        self.slots.as_ref()?.get(bucket)?.as_ref()
    }

    /// Returns all exemplars, in the order of their buckets.
    pub fn iter(&self) -> impl Iterator<Item = &Exemplar> {
        self.slots.iter().flat_map(|slots| slots.iter().flatten())
    }

    /// Returns whether no bucket has an exemplar.
    #[must_use]
    pub const fn is_empty(&self) -> bool {
        self.slots.is_none()
    }
}

const _: () = assert!(Exemplars::BYTES == 544);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_bucket_keeps_its_newest_traced_duration() {
        let (mut exemplars, mut histogram) = (Exemplars::default(), Histogram::default());
        let mut observe = |seconds, trace_id, at| {
            exemplars.observe(&mut histogram, seconds, trace_id, Timestamp(at));
            exemplars.clone()
        };
        assert!(observe(0.0015, None, 1).is_empty());
        assert!(observe(0.0015, Some(0), 2).is_empty());
        assert!(observe(f64::NAN, Some(7), 3).is_empty());
        observe(0.0015, Some(7), 4);
        observe(99.0, Some(8), 5);
        observe(0.0012, Some(9), 6);
        let kept = observe(0.0018, None, 7);
        let exemplar = |seconds, trace_id, at| Exemplar {
            seconds,
            trace_id: NonZero::new(trace_id).unwrap(),
            at: Timestamp(at),
        };
        let kept: Vec<_> = (0..BUCKETS)
            .filter_map(|bucket| Some((bucket, *kept.get(bucket)?)))
            .collect();
        let expected = [(4, exemplar(0.0012, 9, 6)), (16, exemplar(99.0, 8, 5))];
        assert_eq!(kept, expected);
        assert_eq!(histogram.count(), 6, "untraced durations count as before");
    }

    #[test]
    fn each_bucket_has_at_most_one_exemplar_within_its_bounds() {
        let (mut exemplars, mut histogram) = (Exemplars::default(), Histogram::default());
        let bounds: Vec<_> = histogram.buckets().map(|(bound, _)| bound).collect();
        for step in 1..2_000_u32 {
            let seconds = f64::from(step) * f64::from(step) * 1e-5;
            let at = Timestamp(step.into());
            exemplars.observe(&mut histogram, seconds, Some(step.into()), at);
        }
        assert!(exemplars.iter().count() <= BUCKETS);
        let mut below = f64::NEG_INFINITY;
        for (bucket, bound) in bounds.into_iter().enumerate() {
            if let Some(exemplar) = exemplars.get(bucket) {
                let seconds = exemplar.seconds;
                assert!(below < seconds && seconds <= bound, "{bucket}: {seconds}");
            }
            below = bound;
        }
    }
}
