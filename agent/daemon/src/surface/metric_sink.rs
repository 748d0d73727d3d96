//! Metric families and samples, written from facts in the catalogue's order, as text or as OTLP
//! data points. Writers need not know which.
//!
//! No state is kept between two pages: series vanish with their facts.

use std::collections::hash_map::DefaultHasher;
use std::fmt;
use std::hash::{Hash as _, Hasher as _};
use std::net::SocketAddr;

use ros2probe_model::snapshot::Subscriber;
use ros2probe_wire::Guid;
use ros2probe_wire::rtps::VendorId;

use super::catalogue::Metric;
use super::otlp::points::Points;
use super::text::Text;
use ros2probe_model::histogram::Histogram;

/// Longest label value in bytes; ROS allows 255 characters, so longer ones are hostile.
const MAX_LABEL_BYTES: usize = 256;

/// A label value.
#[derive(Clone, Copy, Debug)]
pub(super) enum Label<'a> {
    Text(&'a str),
    Number(u64),
    Guid(Guid),
    Address(SocketAddr),
    Vendor(VendorId),
    Subscriber(Subscriber),
}

/// A sample value.
#[derive(Clone, Copy, Debug)]
pub(super) enum Number {
    Count(u64),
    Real(f64),
}

/// A scrape or export in progress.
pub(super) enum MetricSink<'a> {
    Text(Text<'a>),
    Points(&'a mut Points),
}

/// A family in progress; its samples are contiguous.
pub(super) struct Family<'a, 'b> {
    metric: &'static Metric,
    sink: &'a mut MetricSink<'b>,
}

impl<'b> MetricSink<'b> {
    /// Begins a family; `samples` writes its samples.
    pub(super) fn family(
        &mut self,
        metric: &'static Metric,
        samples: impl FnOnce(&mut Family<'_, 'b>) -> fmt::Result,
    ) -> fmt::Result {
        match self {
            Self::Text(text) => text.begin(metric)?,
            Self::Points(points) => points.open(metric),
        }
        samples(&mut Family { metric, sink: self })
    }

    /// Writes a family with one sample and no labels.
    pub(super) fn single(
        &mut self,
        metric: &'static Metric,
        value: impl Into<Number>,
    ) -> fmt::Result {
        self.family(metric, |family| family.sample(&[], value))
    }
}

impl Family<'_, '_> {
    /// Writes a sample of a counter, gauge or info; the value of an info is ignored.
    pub(super) fn sample(&mut self, labels: &[Label<'_>], value: impl Into<Number>) -> fmt::Result {
        match self.sink {
            MetricSink::Text(text) => text.sample(self.metric, labels, value.into()),
            MetricSink::Points(points) => {
                points.number(labels, value.into());
                Ok(())
            }
        }
    }

    /// Writes an info sample.
    pub(super) fn info(&mut self, labels: &[Label<'_>]) -> fmt::Result {
        self.sample(labels, 1_u64)
    }

    /// Writes a histogram.
    pub(super) fn histogram(&mut self, labels: &[Label<'_>], values: &Histogram) -> fmt::Result {
        match self.sink {
            MetricSink::Text(text) => text.histogram(self.metric, labels, values),
            MetricSink::Points(points) => {
                points.histogram(labels, values);
                Ok(())
            }
        }
    }
}

/// Writes text up to the cap. A longer text is replaced by its beginning and a hash of the whole,
/// so that two long names remain two series.
pub(super) fn write_capped(out: &mut impl fmt::Write, text: &str) -> fmt::Result {
    if text.len() <= MAX_LABEL_BYTES {
        return out.write_str(text);
    }
    let mut hasher = DefaultHasher::new();
    text.hash(&mut hasher);
    let end = text.floor_char_boundary(MAX_LABEL_BYTES - 20);
    write!(
        out,
        "{}...{:016x}",
        text.get(..end).unwrap_or_default(),
        hasher.finish()
    )
}

impl From<u64> for Number {
    fn from(count: u64) -> Self {
        Self::Count(count)
    }
}

impl From<usize> for Number {
    fn from(count: usize) -> Self {
        Self::Count(count as u64)
    }
}

impl From<bool> for Number {
    fn from(holds: bool) -> Self {
        Self::Count(u64::from(holds))
    }
}

impl From<f64> for Number {
    fn from(value: f64) -> Self {
        Self::Real(value)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn long_values_are_cut_but_stay_apart() {
        let capped = |text: &str| {
            let mut out = String::new();
            write_capped(&mut out, text).unwrap();
            out
        };
        let (one, two) = ("ü".repeat(5_000), "ü".repeat(5_001));
        assert!(capped(&one).len() <= MAX_LABEL_BYTES);
        assert_ne!(capped(&one), capped(&two));
        assert_eq!(capped("/points"), "/points");
    }
}
