//! A collection as OTLP data points, encoded as it is written: a large robot's is never in memory
//! as objects. Requests stay well below the 4 MiB that receivers take by default.
//!
//! OTLP's own types and encoding are used here without the SDK: the SDK aggregates measurements
//! itself and has no way in for histograms and sums that already are.

use opentelemetry_proto::tonic::collector::metrics::v1::ExportMetricsServiceRequest;
use opentelemetry_proto::tonic::common::v1::any_value::Value;
use opentelemetry_proto::tonic::common::v1::{AnyValue, InstrumentationScope, KeyValue};
use opentelemetry_proto::tonic::metrics::v1::{
    AggregationTemporality, Gauge, Histogram as HistogramFamily, HistogramDataPoint,
    Metric as Family, NumberDataPoint, ResourceMetrics, ScopeMetrics, Sum, metric::Data,
    number_data_point,
};
use opentelemetry_proto::tonic::resource::v1::Resource;
use prost::Message as _;

use super::client::Request;
use super::starts::Starts;
use crate::surface::catalogue::{Kind, Metric};
use crate::surface::metric_sink::{Label, Number, write_capped};
use ros2probe_model::histogram::Histogram;

/// Where a request ends and the next one begins, in encoded bytes.
const REQUEST_BYTES: usize = 1 << 20;
/// Further points of one collection are dropped and counted.
const COLLECTION_BYTES: usize = 16 << 20;

/// One collection after the other.
#[derive(Debug)]
pub(in crate::surface) struct Points {
    resource: Resource,
    starts: Starts,
    now: u64,
    /// The metric whose samples come now.
    metric: Option<&'static Metric>,
    families: Vec<Family>,
    /// Encoded length and number of the points in `families`.
    bytes: usize,
    items: u64,
    requests: Vec<Request>,
    total: usize,
    dropped: u64,
}

/// What a collection came to.
#[derive(Debug, Default)]
pub(super) struct Collection {
    pub(super) requests: Vec<Request>,
    /// Points for which there was no room.
    pub(super) dropped: u64,
}

impl Points {
    /// Of an agent that started then, in Unix nanoseconds.
    pub(super) fn new(resource: Resource, started: u64) -> Self {
        Self {
            resource,
            starts: Starts::new(started),
            now: started,
            metric: None,
            families: Vec::new(),
            bytes: 0,
            items: 0,
            requests: Vec::new(),
            total: 0,
            dropped: 0,
        }
    }

    /// A collection begins.
    pub(super) fn begin(&mut self, now: u64) {
        self.now = now;
        self.starts.begin(now);
    }

    /// It ends.
    pub(super) fn end(&mut self) -> Collection {
        self.encode();
        self.starts.end();
        (self.metric, self.total) = (None, 0);
        Collection {
            requests: std::mem::take(&mut self.requests),
            dropped: std::mem::take(&mut self.dropped),
        }
    }

    /// A family begins.
    pub(in crate::surface) fn open(&mut self, metric: &'static Metric) {
        if self.families.last().is_some_and(is_empty) {
            self.families.pop();
        }
        self.metric = Some(metric);
        self.families.push(family(metric));
    }

    /// One sample; an info's value is ignored.
    pub(in crate::surface) fn number(&mut self, labels: &[Label<'_>], value: Number) {
        let Some(metric) = self.metric else { return };
        let value = if metric.kind == Kind::Info {
            Number::Count(1)
        } else {
            value
        };
        let (value, real) = match value {
            Number::Count(count) => {
                let exact = i64::try_from(count).unwrap_or(i64::MAX);
                #[expect(clippy::cast_precision_loss, reason = "only compared with itself")]
                (number_data_point::Value::AsInt(exact), count as f64)
            }
            Number::Real(real) => (number_data_point::Value::AsDouble(real), real),
        };
        let cumulative = metric.kind == Kind::Counter;
        let point = NumberDataPoint {
            attributes: attributes(metric, labels),
            start_time_unix_nano: if cumulative {
                self.starts.start(metric, labels, real)
            } else {
                0
            },
            time_unix_nano: self.now,
            value: Some(value),
            ..NumberDataPoint::default()
        };
        if !self.fits(point.encoded_len()) {
            return;
        }
        match self.families.last_mut().and_then(|last| last.data.as_mut()) {
            Some(Data::Sum(sum)) => sum.data_points.push(point),
            Some(Data::Gauge(gauge)) => gauge.data_points.push(point),
            _ => {}
        }
    }

    /// One histogram.
    pub(in crate::surface) fn histogram(&mut self, labels: &[Label<'_>], values: &Histogram) {
        let Some(metric) = self.metric else { return };
        let (bounds, counts): (Vec<f64>, Vec<u64>) = values.buckets().unzip();
        #[expect(clippy::cast_precision_loss, reason = "only compared with itself")]
        let start = self.starts.start(metric, labels, values.count() as f64);
        let point = HistogramDataPoint {
            attributes: attributes(metric, labels),
            start_time_unix_nano: start,
            time_unix_nano: self.now,
            count: values.count(),
            sum: Some(values.sum()),
            bucket_counts: counts,
            // The last bucket has no bound.
            explicit_bounds: bounds
                .into_iter()
                .filter(|bound| bound.is_finite())
                .collect(),
            ..HistogramDataPoint::default()
        };
        if !self.fits(point.encoded_len()) {
            return;
        }
        if let Some(Data::Histogram(family)) =
            self.families.last_mut().and_then(|last| last.data.as_mut())
        {
            family.data_points.push(point);
        }
    }

    /// Makes room for a point; `false`: there is none left.
    fn fits(&mut self, length: usize) -> bool {
        if self.total + length > COLLECTION_BYTES {
            self.dropped += 1;
            return false;
        }
        if self.bytes + length > REQUEST_BYTES {
            self.encode();
            self.families.extend(self.metric.map(family));
        }
        // Its key and length come on top.
        self.bytes += length + 4;
        self.total += length + 4;
        self.items += 1;
        true
    }

    /// Ends a request.
    fn encode(&mut self) {
        let mut metrics = std::mem::take(&mut self.families);
        metrics.retain(|family| !is_empty(family));
        self.bytes = 0;
        let items = std::mem::take(&mut self.items);
        if metrics.is_empty() {
            return;
        }
        let scope_metrics = vec![ScopeMetrics {
            scope: Some(scope()),
            metrics,
            schema_url: String::new(),
        }];
        let request = ExportMetricsServiceRequest {
            resource_metrics: vec![ResourceMetrics {
                resource: Some(self.resource.clone()),
                scope_metrics,
                schema_url: String::new(),
            }],
        };
        self.requests.push(Request {
            body: request.encode_to_vec().into(),
            items,
        });
    }
}

/// What all of this comes from.
pub(super) fn scope() -> InstrumentationScope {
    InstrumentationScope {
        name: env!("CARGO_PKG_NAME").to_owned(),
        version: env!("CARGO_PKG_VERSION").to_owned(),
        ..InstrumentationScope::default()
    }
}

/// An attribute of text.
pub(super) fn attribute(key: &str, value: impl Into<String>) -> KeyValue {
    key_value(key, Value::StringValue(value.into()))
}

/// An attribute of any kind.
pub(super) fn key_value(key: &str, value: Value) -> KeyValue {
    KeyValue {
        key: key.to_owned(),
        value: Some(AnyValue { value: Some(value) }),
        ..KeyValue::default()
    }
}

fn family(metric: &Metric) -> Family {
    let temporality = AggregationTemporality::Cumulative.into();
    let data = match metric.kind {
        Kind::Counter => Data::Sum(Sum {
            data_points: Vec::new(),
            aggregation_temporality: temporality,
            is_monotonic: true,
        }),
        Kind::Gauge | Kind::Info => Data::Gauge(Gauge::default()),
        Kind::Histogram => Data::Histogram(HistogramFamily {
            data_points: Vec::new(),
            aggregation_temporality: temporality,
        }),
    };
    Family {
        name: metric.otlp_name(),
        description: metric.help.to_owned(),
        unit: metric.ucum().to_owned(),
        metadata: Vec::new(),
        data: Some(data),
    }
}

fn is_empty(family: &Family) -> bool {
    match &family.data {
        Some(Data::Sum(sum)) => sum.data_points.is_empty(),
        Some(Data::Gauge(gauge)) => gauge.data_points.is_empty(),
        Some(Data::Histogram(histogram)) => histogram.data_points.is_empty(),
        _ => true,
    }
}

/// As labels; an empty one is none, in Prometheus too.
fn attributes(metric: &Metric, labels: &[Label<'_>]) -> Vec<KeyValue> {
    let named = metric.labels.iter().zip(labels);
    named
        .filter(|(_, label)| !matches!(label, Label::Text("")))
        .map(|(name, label)| key_value(name, value(label)))
        .collect()
}

fn value(label: &Label<'_>) -> Value {
    match label {
        Label::Text(label) => {
            let mut text = String::new();
            // As on the page: no text of the network decides how large a request is. Writing to
            // memory does not fail.
            let _ = write_capped(&mut text, label);
            Value::StringValue(text)
        }
        Label::Number(number) => match i64::try_from(*number) {
            Ok(number) => Value::IntValue(number),
            Err(_) => Value::StringValue(number.to_string()),
        },
        Label::Guid(guid) => Value::StringValue(guid.to_string()),
        Label::Address(address) => Value::StringValue(address.to_string()),
        Label::Vendor(vendor) => Value::StringValue(vendor.to_string()),
        Label::Subscriber(subscriber) => Value::StringValue(subscriber.to_string()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surface::catalogue::CATALOGUE;

    fn metric(name: &str) -> &'static Metric {
        CATALOGUE.iter().find(|metric| metric.name == name).unwrap()
    }

    fn families(collection: &Collection) -> Vec<Family> {
        let requests = collection
            .requests
            .iter()
            .map(|request| ExportMetricsServiceRequest::decode(request.body.clone()).unwrap());
        requests
            .flat_map(|request| request.resource_metrics)
            .flat_map(|resource| resource.scope_metrics)
            .flat_map(|scope| scope.metrics)
            .collect()
    }

    #[test]
    fn each_kind_becomes_what_maps_back_to_it() {
        let mut points = Points::new(Resource::default(), 7);
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
        points.histogram(&topic, &histogram);
        let collection = points.end();
        assert_eq!(collection.requests.first().unwrap().items, 4);

        let families = families(&collection);
        let [messages, publishers, build, latency] = families.as_slice() else {
            panic!("a family without points is left out: {families:?}")
        };
        let Some(Data::Sum(sum)) = &messages.data else {
            panic!("{messages:?}")
        };
        assert!(sum.is_monotonic && sum.aggregation_temporality == 2);
        let point = sum.data_points.first().unwrap();
        assert_eq!((point.start_time_unix_nano, point.time_unix_nano), (7, 9));
        assert_eq!(point.value, Some(number_data_point::Value::AsInt(3)));
        assert_eq!(
            point.attributes,
            [
                key_value("domain_id", Value::IntValue(5)),
                attribute("topic", "/points")
            ]
        );
        let Some(Data::Gauge(gauge)) = &publishers.data else {
            panic!("{publishers:?}")
        };
        assert_eq!(gauge.data_points.first().unwrap().start_time_unix_nano, 0);
        let Some(Data::Gauge(info)) = &build.data else {
            panic!("{build:?}")
        };
        let info = info.data_points.first().unwrap();
        assert_eq!(info.value, Some(number_data_point::Value::AsInt(1)));
        assert_eq!(info.attributes, [attribute("version", "1")]);
        let Some(Data::Histogram(latency)) = &latency.data else {
            panic!("{latency:?}")
        };
        let latency = latency.data_points.first().unwrap();
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
    fn a_large_robot_comes_in_several_requests_and_no_point_twice_or_never() {
        const POINTS: u64 = 60_000;
        let mut points = Points::new(Resource::default(), 0);
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
        assert!(collection.requests.len() > 2 && collection.dropped == 0);
        for request in &collection.requests {
            assert!(
                request.body.len() < 2 * REQUEST_BYTES,
                "{}",
                request.body.len()
            );
        }
        let items: u64 = collection
            .requests
            .iter()
            .map(|request| request.items)
            .sum();
        let found: usize = families(&collection)
            .iter()
            .map(|family| match &family.data {
                Some(Data::Sum(sum)) => sum.data_points.len(),
                other => panic!("{other:?}"),
            })
            .sum();
        assert_eq!((items, found as u64), (POINTS, POINTS));
    }

    #[test]
    fn what_has_no_room_is_counted() {
        let mut points = Points::new(Resource::default(), 0);
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
        let kept: u64 = collection
            .requests
            .iter()
            .map(|request| request.items)
            .sum();
        assert!(collection.dropped > 0);
        assert_eq!(kept + collection.dropped, 100_000);
        let bytes: usize = collection
            .requests
            .iter()
            .map(|request| request.body.len())
            .sum();
        assert!(bytes < COLLECTION_BYTES + (1 << 20), "{bytes}");

        points.begin(2);
        points.open(metric("ros2_topic_publishers"));
        points.number(&[Label::Number(0), Label::Text("/p")], Number::Count(1));
        assert_eq!(points.end().dropped, 0, "the next collection begins anew");
    }
}
