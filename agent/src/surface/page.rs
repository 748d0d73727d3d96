//! Families and samples, straight from facts, in the catalogue's order, as text through
//! prometheus-client or as OTLP data points: who writes them cannot tell which.
//!
//! Nothing is kept between two pages: what is gone from the facts is gone from the page.

use std::collections::hash_map::DefaultHasher;
use std::fmt::{self, Write as _};
use std::hash::{Hash as _, Hasher as _};
use std::net::SocketAddr;

use prometheus_client::encoding::{
    CounterValueEncoder, DescriptorEncoder, EncodeCounterValue, EncodeGaugeValue, EncodeLabelSet,
    GaugeValueEncoder, LabelEncoder, LabelSetEncoder, MetricEncoder, NoLabelSet,
};
use prometheus_client::metrics::MetricType;
use prometheus_client::registry::Unit;
use ros2probe_wire::Guid;

use super::catalogue::{Kind, Metric};
use super::otlp::points::Points;
use crate::model::histogram::Histogram;

/// Longer label values are cut. ROS allows 255 characters; what is longer is hostile.
const MAX_LABEL_BYTES: usize = 256;

/// A label value.
#[derive(Clone, Copy, Debug)]
pub(super) enum Label<'a> {
    Text(&'a str),
    Number(u64),
    Guid(Guid),
    Address(SocketAddr),
}

/// A sample value.
#[derive(Clone, Copy, Debug)]
pub(super) enum Number {
    Count(u64),
    Real(f64),
}

/// One scrape or one export being written.
pub(super) enum Page<'a> {
    Text(DescriptorEncoder<'a>),
    Points(&'a mut Points),
}

/// One family being written; its samples follow one another.
pub(super) struct Family<'a> {
    metric: &'static Metric,
    sink: Sink<'a>,
}

/// Where a family's samples go.
enum Sink<'a> {
    Text(MetricEncoder<'a>),
    Points(&'a mut Points),
}

impl Page<'_> {
    /// Begins a family; `samples` writes what it holds.
    pub(super) fn family(
        &mut self,
        metric: &'static Metric,
        samples: impl FnOnce(&mut Family<'_>) -> fmt::Result,
    ) -> fmt::Result {
        let encoder = match self {
            Self::Text(encoder) => encoder,
            Self::Points(points) => {
                points.open(metric);
                let sink = Sink::Points(points);
                return samples(&mut Family { metric, sink });
            }
        };
        let kind = match metric.kind {
            Kind::Counter => MetricType::Counter,
            Kind::Gauge => MetricType::Gauge,
            Kind::Histogram => MetricType::Histogram,
            Kind::Info => MetricType::Info,
        };
        // prometheus-client appends the unit only where it ends the name.
        let stem = metric.stem();
        let unit = metric.unit.map(|unit| Unit::Other(unit.to_owned()));
        let sink = encoder.encode_descriptor(stem, metric.help, unit.as_ref(), kind)?;
        samples(&mut Family {
            metric,
            sink: Sink::Text(sink),
        })
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

impl Family<'_> {
    /// One counter, gauge or info sample; an info's value is ignored.
    pub(super) fn sample(&mut self, labels: &[Label<'_>], value: impl Into<Number>) -> fmt::Result {
        let (metric, value) = (self.metric, value.into());
        let encoder = match &mut self.sink {
            Sink::Text(encoder) => encoder,
            Sink::Points(points) => {
                points.number(labels, value);
                return Ok(());
            }
        };
        let labels = Labels::new(metric, labels);
        if metric.kind == Kind::Info {
            return encoder.encode_info(&labels);
        }
        let write = |encoder: &mut MetricEncoder<'_>| match metric.kind {
            Kind::Counter => encoder.encode_counter::<NoLabelSet, _, f64>(&value, None),
            _ => encoder.encode_gauge(&value),
        };
        if labels.names.is_empty() {
            return write(encoder);
        }
        write(&mut encoder.encode_family(&labels)?)
    }

    /// One info sample.
    pub(super) fn info(&mut self, labels: &[Label<'_>]) -> fmt::Result {
        self.sample(labels, 1_u64)
    }

    /// One histogram.
    pub(super) fn histogram(&mut self, labels: &[Label<'_>], values: &Histogram) -> fmt::Result {
        let encoder = match &mut self.sink {
            Sink::Text(encoder) => encoder,
            Sink::Points(points) => {
                points.histogram(labels, values);
                return Ok(());
            }
        };
        let buckets: Vec<(f64, u64)> = values.buckets().collect();
        let labels = Labels::new(self.metric, labels);
        let mut encoder = encoder.encode_family(&labels)?;
        encoder.encode_histogram::<NoLabelSet>(values.sum(), values.count(), &buckets, None)
    }
}

/// The catalogue's label names with one sample's values.
#[derive(Debug)]
struct Labels<'a> {
    names: &'static [&'static str],
    values: &'a [Label<'a>],
}

impl<'a> Labels<'a> {
    fn new(metric: &'static Metric, values: &'a [Label<'a>]) -> Self {
        let names = metric.labels;
        debug_assert_eq!(names.len(), values.len(), "{}", metric.name);
        Self { names, values }
    }
}

impl EncodeLabelSet for Labels<'_> {
    fn encode(&self, encoder: &mut LabelSetEncoder<'_>) -> fmt::Result {
        for (name, value) in self.names.iter().zip(self.values) {
            value.encode(name, encoder.encode_label())?;
        }
        Ok(())
    }
}

impl Label<'_> {
    fn encode(self, name: &str, mut encoder: LabelEncoder<'_>) -> fmt::Result {
        let mut key = encoder.encode_label_key()?;
        key.write_str(name)?;
        let mut value = key.encode_label_value()?;
        match self {
            Self::Text(text) => write_capped(&mut value, text)?,
            Self::Number(number) => write!(value, "{number}")?,
            Self::Guid(guid) => write!(value, "{guid}")?,
            Self::Address(address) => write!(value, "{address}")?,
        }
        value.finish()
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

impl EncodeCounterValue for Number {
    fn encode(&self, encoder: &mut CounterValueEncoder<'_>) -> fmt::Result {
        match self {
            Self::Count(count) => EncodeCounterValue::encode(count, encoder),
            Self::Real(value) => EncodeCounterValue::encode(value, encoder),
        }
    }
}

impl EncodeGaugeValue for Number {
    fn encode(&self, encoder: &mut GaugeValueEncoder<'_>) -> fmt::Result {
        match self {
            Self::Count(count) => EncodeGaugeValue::encode(count, encoder),
            Self::Real(value) => EncodeGaugeValue::encode(value, encoder),
        }
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
