//! Families and samples, straight from facts, in the catalogue's order, as text or as OTLP data
//! points: who writes them cannot tell which.
//!
//! Nothing is kept between two pages: what is gone from the facts is gone from the page.

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

/// Longer label values are cut. ROS allows 255 characters; what is longer is hostile.
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

/// One scrape or one export being written.
pub(super) enum MetricSink<'a> {
    Text(Text<'a>),
    Points(&'a mut Points),
}

/// One family being written; its samples follow one another.
pub(super) struct Family<'a, 'b> {
    metric: &'static Metric,
    sink: &'a mut MetricSink<'b>,
}

impl<'b> MetricSink<'b> {
    /// Begins a family; `samples` writes what it holds.
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

    /// A family with one sample and no labels.
    pub(super) fn single(
        &mut self,
        metric: &'static Metric,
        value: impl Into<Number>,
    ) -> fmt::Result {
        self.family(metric, |family| family.sample(&[], value))
    }
}

impl Family<'_, '_> {
    /// One counter, gauge or info sample; an info's value is ignored.
    pub(super) fn sample(&mut self, labels: &[Label<'_>], value: impl Into<Number>) -> fmt::Result {
        match self.sink {
            MetricSink::Text(text) => text.sample(self.metric, labels, value.into()),
            MetricSink::Points(points) => {
                points.number(labels, value.into());
                Ok(())
            }
        }
    }

    /// One info sample.
    pub(super) fn info(&mut self, labels: &[Label<'_>]) -> fmt::Result {
        self.sample(labels, 1_u64)
    }

    /// One histogram.
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

/// Text up to the cap. What is longer keeps its beginning and a hash of the whole, so that two long
/// names do not become one series.
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
