//! Metric families and samples, written from facts in the catalogue's order. The destination is a
//! page, an export over OTLP, or remote write; the code that writes them does not depend on it.
//!
//! No state is kept between two pages: series vanish with their facts.

use std::collections::hash_map::DefaultHasher;
use std::fmt::{self, Write as _};
use std::hash::{Hash as _, Hasher as _};
use std::net::SocketAddr;
use std::sync::Arc;

use prometheus_client::encoding::{
    DescriptorEncoder, EncodeLabelSet, LabelSetEncoder, MetricEncoder, NoLabelSet,
};
use prometheus_client::metrics::MetricType;
use prometheus_client::metrics::exemplar::Exemplar;
use prometheus_client::registry::Unit;
use ros2probe_model::derive::chain::exemplar::Exemplars;
use ros2probe_model::report::snapshot::Subscriber;
use ros2probe_wire::Guid;
use ros2probe_wire::rtps::VendorId;

use crate::catalogue::{Kind, Metric};
use crate::exemplar_lines::Waiting;
use crate::otlp::points::Points;
use crate::remote_write::samples::Samples;
use ros2probe_model::facts::histogram::{BOUNDS, Histogram};

/// Maximum length of a label value in bytes. ROS allows 255 characters, so longer values are
/// hostile.
const MAX_LABEL_BYTES: usize = 256;

/// A label value.
#[derive(Clone, Copy, Debug)]
pub enum Label<'a> {
    /// A name or another text; long texts are shortened.
    Text(&'a str),
    /// A whole number.
    Number(u64),
    /// A participant or an endpoint.
    Guid(Guid),
    /// An address of a socket.
    Address(SocketAddr),
    /// A vendor of DDS.
    Vendor(VendorId),
    /// A subscriber of a topic.
    Subscriber(Subscriber),
}

/// A sample value.
#[derive(Clone, Copy, Debug)]
pub enum Number {
    /// A whole number.
    Count(u64),
    /// A real number.
    Real(f64),
}

/// A scrape or export in progress.
pub struct MetricSink<'a>(Out<'a>);

enum Out<'a> {
    Page(DescriptorEncoder<'a>, Option<Arc<Waiting>>),
    Points(&'a mut Points),
    Samples(&'a mut Samples),
}

/// A family in progress; its samples are contiguous.
pub struct Family<'a> {
    metric: &'static Metric,
    out: FamilyOut<'a>,
}

enum FamilyOut<'a> {
    Page(MetricEncoder<'a>, Option<&'a Waiting>),
    Points(&'a mut Points),
    Samples(&'a mut Samples),
}

impl<'a> MetricSink<'a> {
    /// Creates the sink of a page; `exemplars` accepts the exemplars of its histograms, if the page
    /// shows them.
    pub(crate) const fn page(
        encoder: DescriptorEncoder<'a>,
        exemplars: Option<Arc<Waiting>>,
    ) -> Self {
        Self(Out::Page(encoder, exemplars))
    }

    /// Creates the sink of an export.
    pub(crate) const fn points(points: &'a mut Points) -> Self {
        Self(Out::Points(points))
    }

    /// Creates the sink of remote write.
    pub(crate) const fn samples(samples: &'a mut Samples) -> Self {
        Self(Out::Samples(samples))
    }

    /// Begins a family; `samples` writes its samples.
    ///
    /// # Errors
    /// Fails if the page does.
    pub fn family(
        &mut self,
        metric: &'static Metric,
        samples: impl FnOnce(&mut Family<'_>) -> fmt::Result,
    ) -> fmt::Result {
        match &mut self.0 {
            Out::Page(encoder, waiting) => {
                // The encoder appends the unit to the name, and for some types a suffix.
                let (name, unit) = (metric.stem(), metric.unit.map(unit));
                let kind = metric_type(metric.kind);
                let family = encoder.encode_descriptor(name, metric.help, unit.as_ref(), kind)?;
                let out = FamilyOut::Page(family, waiting.as_deref());
                samples(&mut Family { metric, out })
            }
            Out::Points(points) => {
                points.open(metric);
                let out = FamilyOut::Points(points);
                samples(&mut Family { metric, out })
            }
            Out::Samples(collected) => {
                collected.open(metric);
                let out = FamilyOut::Samples(collected);
                samples(&mut Family { metric, out })
            }
        }
    }

    /// Writes a family with one sample and no labels.
    ///
    /// # Errors
    /// Fails like [`Self::family`].
    pub fn single(&mut self, metric: &'static Metric, value: impl Into<Number>) -> fmt::Result {
        self.family(metric, |family| family.sample(&[], value))
    }
}

impl Family<'_> {
    /// Writes a sample of a counter, gauge or info; the value of an info is ignored.
    ///
    /// # Errors
    /// Fails if the page does.
    pub fn sample(&mut self, labels: &[Label<'_>], value: impl Into<Number>) -> fmt::Result {
        let family = match &mut self.out {
            FamilyOut::Page(family, _) => family,
            FamilyOut::Points(points) => {
                points.number(labels, value.into());
                return Ok(());
            }
            FamilyOut::Samples(samples) => {
                samples.number(labels, value.into());
                return Ok(());
            }
        };
        let labels = LabelSet::new(self.metric, labels);
        if self.metric.kind == Kind::Info {
            return family.encode_info(&labels);
        }
        let mut sample = family.encode_family(&labels)?;
        match (self.metric.kind, value.into()) {
            (Kind::Counter, Number::Count(count)) => sample.encode_counter(&count, NO_EXEMPLAR),
            (Kind::Counter, Number::Real(real)) => sample.encode_counter(&real, NO_EXEMPLAR),
            (_, Number::Count(count)) => sample.encode_gauge(&count),
            (_, Number::Real(real)) => sample.encode_gauge(&real),
        }
    }

    /// Writes an info sample.
    ///
    /// # Errors
    /// Fails like [`Self::sample`].
    pub fn info(&mut self, labels: &[Label<'_>]) -> fmt::Result {
        self.sample(labels, 1_u64)
    }

    /// Writes a histogram.
    ///
    /// # Errors
    /// Fails like [`Self::sample`].
    pub fn histogram(&mut self, labels: &[Label<'_>], values: &Histogram) -> fmt::Result {
        self.traced_histogram(labels, values, None)
    }

    /// Writes a histogram, with its exemplars if it has any.
    ///
    /// # Errors
    /// Fails like [`Self::sample`].
    pub fn traced_histogram(
        &mut self,
        labels: &[Label<'_>],
        values: &Histogram,
        exemplars: Option<&Exemplars>,
    ) -> fmt::Result {
        match &mut self.out {
            FamilyOut::Page(family, waiting) => {
                if let Some((waiting, exemplars)) = waiting.zip(exemplars) {
                    waiting.add(exemplars, BOUNDS.len() + 1);
                }
                let mut buckets = [(0.0, 0); BOUNDS.len() + 1];
                for (bucket, filled) in buckets.iter_mut().zip(values.buckets()) {
                    *bucket = filled;
                }
                let labels = LabelSet::new(self.metric, labels);
                family
                    .encode_family(&labels)?
                    .encode_histogram::<NoLabelSet>(values.sum(), values.count(), &buckets, None)
            }
            FamilyOut::Points(points) => {
                points.histogram(labels, values, exemplars);
                Ok(())
            }
            FamilyOut::Samples(samples) => {
                samples.histogram(labels, values);
                Ok(())
            }
        }
    }
}

const NO_EXEMPLAR: Option<&Exemplar<NoLabelSet, f64>> = None;

fn metric_type(kind: Kind) -> MetricType {
    match kind {
        Kind::Counter => MetricType::Counter,
        Kind::Gauge => MetricType::Gauge,
        Kind::Histogram => MetricType::Histogram,
        Kind::Info => MetricType::Info,
    }
}

fn unit(unit: &str) -> Unit {
    match unit {
        "bytes" => Unit::Bytes,
        "seconds" => Unit::Seconds,
        other => Unit::Other(other.to_owned()),
    }
}

/// The labels of a sample with their names.
#[derive(Clone, Copy, Debug)]
struct LabelSet<'a> {
    names: &'static [&'static str],
    values: &'a [Label<'a>],
}

impl<'a> LabelSet<'a> {
    fn new(metric: &'static Metric, values: &'a [Label<'a>]) -> Self {
        let names = metric.labels;
        debug_assert_eq!(names.len(), values.len(), "{}", metric.name);
        Self { names, values }
    }
}

impl EncodeLabelSet for LabelSet<'_> {
    fn encode(&self, encoder: &mut LabelSetEncoder<'_>) -> fmt::Result {
        for (name, label) in self.names.iter().zip(self.values) {
            let mut encoder = encoder.encode_label();
            let mut key = encoder.encode_label_key()?;
            key.write_str(name)?;
            let mut value = key.encode_label_value()?;
            label.write(&mut value)?;
            value.finish()?;
        }
        Ok(())
    }
}

impl Label<'_> {
    /// Writes the value as text.
    pub(crate) fn write(&self, out: &mut impl fmt::Write) -> fmt::Result {
        match self {
            Self::Text(text) => write_capped(out, text),
            Self::Number(number) => write!(out, "{number}"),
            Self::Guid(guid) => write!(out, "{guid}"),
            Self::Address(address) => write!(out, "{address}"),
            Self::Vendor(vendor) => write!(out, "{vendor}"),
            Self::Subscriber(subscriber) => write!(out, "{subscriber}"),
        }
    }
}

/// Writes text up to the cap. A longer text is replaced by its beginning and a hash of the whole,
/// so that two long names remain two series.
pub(crate) fn write_capped(out: &mut impl fmt::Write, text: &str) -> fmt::Result {
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
    fn long_label_values_are_shortened_but_stay_distinct() {
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
