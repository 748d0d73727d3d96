//! Divides a collection into requests: points are gathered until a request is full, and then
//! converted to the SDK's form. Requests stay well below the 4 MiB that receivers accept by
//! default.
//!
//! Texts are shared between the points of a collection, so a large robot's names are in memory
//! once.

use std::collections::HashSet;
use std::sync::Arc;

use opentelemetry::{InstrumentationScope, Key, KeyValue, StringValue, Value};
use opentelemetry_proto::tonic::collector::metrics::v1::ExportMetricsServiceRequest;
use opentelemetry_sdk::Resource;
use opentelemetry_sdk::metrics::data::ResourceMetrics;

use super::encoded::Encoded;
use super::instruments::{self, Instruments, REQUEST_POINTS, is_real};
use super::starts::Starts;
use crate::catalogue::{Kind, Metric};
use crate::metric_sink::{Label, Number, write_capped};
use ros2probe_model::derive::chain::exemplar::Exemplars;
use ros2probe_model::facts::histogram::Histogram;

/// Estimated size in bytes at which a request ends.
const REQUEST_BYTES: usize = 1 << 20;
/// Maximum estimated size of a collection; further points are dropped and counted.
const COLLECTION_BYTES: usize = 16 << 20;
/// Estimated size of a point without attributes, of a bucket, of an exemplar, and of an attribute
/// without its texts.
const POINT_BYTES: usize = 30;
const BUCKET_BYTES: usize = 17;
const EXEMPLAR_BYTES: usize = 38;
const ATTRIBUTE_BYTES: usize = 8;
/// Name of the instrumentation scope. Queries use it, so it does not follow the name of this crate.
const SCOPE_NAME: &str = "ros2probe-daemon";

/// Gathers one collection after the other.
pub struct Points {
    instruments: Instruments,
    starts: Starts,
    now: u64,
    /// The metric of the current samples.
    metric: Option<&'static Metric>,
    counters: Gathered<instruments::Points>,
    gauges: Gathered<instruments::Points>,
    encoded: Gathered<Encoded>,
    names: Names,
    /// Attributes of the current point.
    attributes: Vec<KeyValue>,
    batches: Vec<Batch>,
    total: usize,
    dropped: u64,
}

/// Points of a request, and their estimated size.
struct Gathered<P> {
    points: P,
    bytes: usize,
}

/// A request.
pub(super) enum Batch {
    /// Points in the SDK's form, and their number.
    Metrics(ResourceMetrics, u64),
    /// Points that the SDK cannot carry, and their number.
    Encoded(ExportMetricsServiceRequest, u64),
}

/// The result of a collection.
#[derive(Default)]
pub(super) struct Collection {
    pub(super) batches: Vec<Batch>,
    /// Points dropped because the collection was too large.
    pub(super) dropped: u64,
}

impl Batch {
    /// Returns the number of points.
    pub(super) const fn items(&self) -> u64 {
        match self {
            Self::Metrics(_, items) | Self::Encoded(_, items) => *items,
        }
    }
}

impl Points {
    /// Creates a collection for an agent that started at this time, in Unix nanoseconds.
    pub(super) fn new(resource: &Resource, started: u64) -> Self {
        let gathered = || Gathered {
            points: instruments::Points::default(),
            bytes: 0,
        };
        Self {
            instruments: Instruments::new(resource.clone(), scope()),
            starts: Starts::new(started),
            now: started,
            metric: None,
            counters: gathered(),
            gauges: gathered(),
            encoded: Gathered {
                points: Encoded::new(resource, scope()),
                bytes: 0,
            },
            names: Names::default(),
            attributes: Vec::new(),
            batches: Vec::new(),
            total: 0,
            dropped: 0,
        }
    }

    /// Begins a collection.
    pub(super) fn begin(&mut self, now: u64) {
        self.now = now;
        self.starts.begin(now);
    }

    /// Ends the collection.
    pub(super) fn end(&mut self) -> Collection {
        self.end_counters();
        self.end_gauges();
        self.end_encoded();
        self.starts.end();
        self.names = Names::default();
        (self.metric, self.total) = (None, 0);
        Collection {
            batches: std::mem::take(&mut self.batches),
            dropped: std::mem::take(&mut self.dropped),
        }
    }

    /// Begins a family.
    pub const fn open(&mut self, metric: &'static Metric) {
        self.metric = Some(metric);
    }

    /// Adds a sample; the value of an info is ignored.
    pub fn number(&mut self, labels: &[Label<'_>], value: Number) {
        let Some(metric) = self.metric else { return };
        let Some(bytes) = self.attributes(metric, labels, POINT_BYTES) else {
            return;
        };
        let value = match (metric.kind, value) {
            (Kind::Info, _) => Number::Count(1),
            #[expect(clippy::cast_precision_loss, reason = "seconds below 2^53")]
            (Kind::Counter, Number::Count(count)) if is_real(metric) => Number::Real(count as f64),
            (Kind::Gauge, Number::Real(real)) if !real.is_finite() => {
                self.encoded_has_room(bytes);
                let encoded = &mut self.encoded.points;
                return encoded.gauge(metric, &self.attributes, real, self.now);
            }
            (_, value) => value,
        };
        let (points, is_counter) = match metric.kind {
            Kind::Counter => (&mut self.counters, true),
            _ => (&mut self.gauges, false),
        };
        points.bytes += bytes;
        points.points.push(metric, &self.attributes, value);
        if points.bytes < REQUEST_BYTES && points.points.len() < REQUEST_POINTS {
            return;
        }
        if is_counter {
            self.end_counters();
        } else {
            self.end_gauges();
        }
    }

    /// Adds a histogram, with its exemplars if it has any.
    pub fn histogram(
        &mut self,
        labels: &[Label<'_>],
        values: &Histogram,
        exemplars: Option<&Exemplars>,
    ) {
        let Some(metric) = self.metric else { return };
        let exemplars = || exemplars.into_iter().flat_map(Exemplars::iter);
        let bytes = POINT_BYTES
            + BUCKET_BYTES * values.buckets().count()
            + EXEMPLAR_BYTES * exemplars().count();
        let Some(bytes) = self.attributes(metric, labels, bytes) else {
            return;
        };
        #[expect(clippy::cast_precision_loss, reason = "only compared with itself")]
        let start = self.starts.start(metric, labels, values.count() as f64);
        self.encoded_has_room(bytes);
        let encoded = &mut self.encoded.points;
        let values = (values, exemplars());
        encoded.histogram(metric, &self.attributes, values, [start, self.now]);
    }

    /// Converts labels to attributes of the next point. Returns the estimated size of the point;
    /// `None` if the collection is full. Empty labels are omitted, as Prometheus treats them as
    /// missing.
    fn attributes(
        &mut self,
        metric: &Metric,
        labels: &[Label<'_>],
        mut bytes: usize,
    ) -> Option<usize> {
        self.attributes.clear();
        for (name, label) in metric.labels.iter().copied().zip(labels) {
            let value = value(label, &mut self.names);
            let text = match &value {
                Value::String(text) if text.as_str().is_empty() => continue,
                Value::String(text) => text.as_str().len(),
                _ => 0,
            };
            bytes += ATTRIBUTE_BYTES + name.len() + text;
            self.attributes
                .push(KeyValue::new(Key::from_static_str(name), value));
        }
        if self.total + bytes > COLLECTION_BYTES {
            self.dropped += 1;
            return None;
        }
        self.total += bytes;
        Some(bytes)
    }

    fn end_counters(&mut self) {
        let points = self.counters.take();
        if points.len() > 0 {
            let items = points.len() as u64;
            let metrics = self.instruments.counters(points);
            self.batches.push(Batch::Metrics(metrics, items));
        }
    }

    fn end_gauges(&mut self) {
        let points = self.gauges.take();
        if points.len() > 0 {
            let items = points.len() as u64;
            let metrics = self.instruments.gauges(points);
            self.batches.push(Batch::Metrics(metrics, items));
        }
    }

    fn encoded_has_room(&mut self, bytes: usize) {
        if self.encoded.bytes + bytes > REQUEST_BYTES {
            self.end_encoded();
        }
        self.encoded.bytes += bytes;
    }

    fn end_encoded(&mut self) {
        self.encoded.bytes = 0;
        if let Some((request, items)) = self.encoded.points.take() {
            self.batches.push(Batch::Encoded(request, items));
        }
    }
}

impl Gathered<instruments::Points> {
    fn take(&mut self) -> instruments::Points {
        self.bytes = 0;
        std::mem::take(&mut self.points)
    }
}

/// Returns the instrumentation scope of all signals.
pub(super) fn scope() -> InstrumentationScope {
    InstrumentationScope::builder(SCOPE_NAME)
        .with_version(env!("CARGO_PKG_VERSION"))
        .build()
}

/// Texts of a collection.
#[derive(Default)]
struct Names {
    known: HashSet<Arc<str>>,
    capped: String,
}

impl Names {
    fn shared(&mut self, text: &str) -> Arc<str> {
        self.capped.clear();
        // As on the page, the cap prevents text from the network from determining the size of a
        // request. Writing to memory cannot fail.
        let _ = write_capped(&mut self.capped, text);
        if let Some(known) = self.known.get(self.capped.as_str()) {
            return Arc::clone(known);
        }
        let shared = Arc::<str>::from(self.capped.as_str());
        self.known.insert(Arc::clone(&shared));
        shared
    }
}

fn value(label: &Label<'_>, names: &mut Names) -> Value {
    match label {
        Label::Text(text) => Value::String(StringValue::from(names.shared(text))),
        Label::Number(number) => match i64::try_from(*number) {
            Ok(number) => Value::I64(number),
            Err(_) => number.to_string().into(),
        },
        Label::Guid(guid) => guid.to_string().into(),
        Label::Address(address) => address.to_string().into(),
        Label::Vendor(vendor) => vendor.to_string().into(),
        Label::Subscriber(subscriber) => subscriber.to_string().into(),
    }
}

#[cfg(test)]
mod tests {
    use opentelemetry_proto::tonic::common::v1::{self as proto, any_value};
    use opentelemetry_proto::tonic::metrics::v1::metric::Data;
    use opentelemetry_proto::tonic::metrics::v1::{Metric as Family, number_data_point};
    use prost::Message as _;

    use super::*;
    use crate::catalogue::CATALOGUE;
    use ros2probe_model::report::snapshot::Subscriber;

    fn metric(name: &str) -> &'static Metric {
        CATALOGUE.iter().find(|metric| metric.name == name).unwrap()
    }

    fn requests(collection: &Collection) -> Vec<ExportMetricsServiceRequest> {
        let batches = collection.batches.iter();
        let requests = batches.map(|batch| match batch {
            Batch::Metrics(metrics, _) => metrics.into(),
            Batch::Encoded(request, _) => request.clone(),
        });
        requests.collect()
    }

    fn families(collection: &Collection) -> Vec<Family> {
        requests(collection)
            .into_iter()
            .flat_map(|request| request.resource_metrics)
            .flat_map(|resource| resource.scope_metrics)
            .flat_map(|scope| scope.metrics)
            .collect()
    }

    fn attribute(key: &str, value: any_value::Value) -> proto::KeyValue {
        proto::KeyValue {
            key: key.to_owned(),
            value: Some(proto::AnyValue { value: Some(value) }),
            ..proto::KeyValue::default()
        }
    }

    fn text(text: &str) -> any_value::Value {
        any_value::Value::StringValue(text.to_owned())
    }

    fn empty() -> Points {
        Points::new(&Resource::builder_empty().build(), 7)
    }

    fn items(collection: &Collection) -> u64 {
        collection.batches.iter().map(Batch::items).sum()
    }

    #[test]
    fn each_kind_of_metric_becomes_the_matching_kind_of_otlp_data() {
        let mut points = empty();
        let topic = [Label::Number(5), Label::Text("/points")];
        let mut histogram = Histogram::default();
        histogram.observe(0.001);
        histogram.observe(99.0);
        points.begin(9);
        points.open(metric("ros2_topic_messages_total"));
        points.number(&topic, Number::Count(3));
        points.open(metric("ros2_topic_rate_hertz"));
        points.open(metric("ros2_topic_publishers"));
        points.number(&topic, Number::Count(2));
        points.open(metric("ros2probe_build_info"));
        points.number(&[Label::Text("1"), Label::Text("")], Number::Count(44));
        points.open(metric("ros2_topic_latency_seconds"));
        points.histogram(&topic, &histogram, None);
        let collection = points.end();
        assert_eq!((items(&collection), collection.batches.len()), (4, 3));

        let families = families(&collection);
        let [messages, publishers, build, latency] = families.as_slice() else {
            panic!("a family without points is left out: {families:?}")
        };
        let Some(Data::Sum(sum)) = &messages.data else {
            panic!("{messages:?}")
        };
        assert!(sum.is_monotonic && sum.aggregation_temporality == 2);
        let point = sum.data_points.first().unwrap();
        assert!(point.start_time_unix_nano < point.time_unix_nano);
        assert_eq!(point.value, Some(number_data_point::Value::AsInt(3)));
        assert_eq!(
            point.attributes,
            [
                attribute("domain_id", any_value::Value::IntValue(5)),
                attribute("topic", text("/points"))
            ]
        );
        let Some(Data::Gauge(gauge)) = &publishers.data else {
            panic!("{publishers:?}")
        };
        let gauge = gauge.data_points.first().unwrap();
        assert_eq!(gauge.value, Some(number_data_point::Value::AsInt(2)));
        assert_eq!(gauge.attributes, point.attributes);
        let Some(Data::Gauge(info)) = &build.data else {
            panic!("{build:?}")
        };
        let info = info.data_points.first().unwrap();
        assert_eq!(info.value, Some(number_data_point::Value::AsInt(1)));
        assert_eq!(info.attributes, [attribute("version", text("1"))]);
        let Some(Data::Histogram(latency)) = &latency.data else {
            panic!("{latency:?}")
        };
        let latency = latency.data_points.first().unwrap();
        assert_eq!(
            (latency.start_time_unix_nano, latency.time_unix_nano),
            (7, 9)
        );
        assert_eq!(
            latency.explicit_bounds.len() + 1,
            latency.bucket_counts.len()
        );
        assert_eq!(
            (latency.count, latency.bucket_counts.iter().sum()),
            (2, 2_u64)
        );
    }

    #[test]
    fn an_empty_label_does_not_become_an_attribute() {
        let mut points = empty();
        points.begin(1);
        let subscriber = metric("ros2_subscriber_received_messages_total");
        points.open(subscriber);
        let labels = subscriber.labels.iter().map(|label| match *label {
            "subscriber" => Label::Subscriber(Subscriber::Unknown),
            "topic" => Label::Text("/points"),
            _ => Label::Text(""),
        });
        points.number(&labels.collect::<Vec<_>>(), Number::Count(1));
        let [family] = &families(&points.end())[..] else {
            panic!("one family")
        };
        let Some(Data::Sum(sum)) = &family.data else {
            panic!("{family:?}")
        };
        let [point] = &sum.data_points[..] else {
            panic!("{sum:?}")
        };
        assert_eq!(point.attributes, [attribute("topic", text("/points"))]);
    }

    #[test]
    fn points_of_a_large_robot_are_in_several_requests_each_point_once() {
        const POINTS: u64 = 60_000;
        let mut points = empty();
        points.begin(1);
        for name in [
            "ros2_topic_messages_total",
            "ros2_topic_lost_messages_total",
        ] {
            points.open(metric(name));
            for domain_id in 0..POINTS / 2 {
                points.number(
                    &[Label::Number(domain_id), Label::Text("/p")],
                    Number::Count(1),
                );
            }
        }
        let collection = points.end();
        assert!(collection.batches.len() > 2 && collection.dropped == 0);
        for request in requests(&collection) {
            let bytes = request.encoded_len();
            assert!(bytes < 2 * REQUEST_BYTES, "{bytes}");
        }
        let found: usize = families(&collection)
            .iter()
            .map(|family| match &family.data {
                Some(Data::Sum(sum)) => sum.data_points.len(),
                other => panic!("{other:?}"),
            })
            .sum();
        assert_eq!((items(&collection), found as u64), (POINTS, POINTS));
    }

    #[test]
    fn points_beyond_the_size_of_a_collection_are_counted_as_dropped() {
        let mut points = empty();
        let name = "x".repeat(250);
        points.begin(1);
        points.open(metric("ros2_topic_publishers"));
        for domain_id in 0..100_000 {
            points.number(
                &[Label::Number(domain_id), Label::Text(&name)],
                Number::Count(1),
            );
        }
        let collection = points.end();
        let kept = items(&collection);
        assert!(collection.dropped > 0);
        assert_eq!(kept + collection.dropped, 100_000);
        let bytes: usize = requests(&collection)
            .iter()
            .map(|it| it.encoded_len())
            .sum();
        assert!(bytes < COLLECTION_BYTES + (1 << 20), "{bytes}");

        points.begin(2);
        points.open(metric("ros2_topic_publishers"));
        points.number(&[Label::Number(0), Label::Text("/p")], Number::Count(1));
        assert_eq!(points.end().dropped, 0, "the next collection begins anew");
    }

    #[test]
    fn a_series_that_ended_is_in_no_later_collection() {
        let mut points = empty();
        for (now, topics) in [(1, &["/imu", "/points"][..]), (2, &["/points"]), (3, &[])] {
            points.begin(now);
            for name in ["ros2_topic_messages_total", "ros2_topic_publishers"] {
                points.open(metric(name));
                for topic in topics {
                    let labels = [Label::Number(0), Label::Text(topic)];
                    points.number(&labels, Number::Count(now));
                }
            }
            let collection = points.end();
            let found: Vec<usize> = families(&collection)
                .iter()
                .map(|family| match &family.data {
                    Some(Data::Sum(sum)) => sum.data_points.len(),
                    Some(Data::Gauge(gauge)) => gauge.data_points.len(),
                    other => panic!("{other:?}"),
                })
                .collect();
            let wanted = vec![topics.len(); if topics.is_empty() { 0 } else { 2 }];
            assert_eq!(found, wanted, "at {now}");
        }
    }

    #[test]
    fn floats_stay_floats_and_an_unknown_lag_stays_infinite() {
        let mut points = empty();
        points.begin(1);
        points.open(metric("process_cpu_seconds_total"));
        points.number(&[], Number::Real(1.5));
        points.open(metric("ros2_topic_rate_hertz"));
        let topic = |name| [Label::Number(0), Label::Text(name)];
        points.number(&topic("/points"), Number::Real(0.5));
        points.number(&topic("/imu"), Number::Real(f64::INFINITY));
        let values: Vec<_> = families(&points.end())
            .iter()
            .flat_map(|family| match family.data.clone() {
                Some(Data::Sum(sum)) => sum.data_points,
                Some(Data::Gauge(gauge)) => gauge.data_points,
                other => panic!("{other:?}"),
            })
            .map(|point| point.value.unwrap())
            .collect();
        let real = number_data_point::Value::AsDouble;
        assert_eq!(values, [real(1.5), real(0.5), real(f64::INFINITY)]);
    }
}
