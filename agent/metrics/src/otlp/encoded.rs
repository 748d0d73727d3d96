//! Points that the SDK cannot carry, in OTLP's own types over the metrics' connection: histograms,
//! and gauges that are infinite.
//!
//! The model counts samples in buckets. An instrument of `opentelemetry_sdk` 0.33 only records
//! single values, and the types of aggregated data have no public constructor. In
//! opentelemetry-rust, pull request 3489 (constructors, for issue 3469) and issue 2505
//! (`MetricProducer`) are open, and 0.33.1 is the newest release. Its instruments drop values that
//! are not finite (issue 3656), but an unknown lag is infinite. This module can be removed once the
//! SDK accepts such points.

use opentelemetry_proto::tonic::collector::metrics::v1::ExportMetricsServiceRequest;
use opentelemetry_proto::tonic::common::v1::{InstrumentationScope, KeyValue};
use opentelemetry_proto::tonic::metrics::v1::{
    AggregationTemporality, Exemplar as EncodedExemplar, Gauge, Histogram as HistogramFamily,
    HistogramDataPoint, Metric as Family, NumberDataPoint, ResourceMetrics, ScopeMetrics, exemplar,
    metric::Data, number_data_point,
};
use opentelemetry_proto::tonic::resource::v1::Resource;

use crate::catalogue::Metric;
use ros2probe_model::derive::chain::exemplar::Exemplar;
use ros2probe_model::facts::histogram::Histogram;

/// Families of points that the SDK cannot carry, until they are sent.
#[derive(Debug)]
pub(super) struct Encoded {
    resource: Resource,
    scope: InstrumentationScope,
    families: Vec<Family>,
    items: u64,
}

impl Encoded {
    /// Creates an empty collection.
    pub(super) fn new(
        resource: &opentelemetry_sdk::Resource,
        scope: opentelemetry::InstrumentationScope,
    ) -> Self {
        Self {
            resource: resource.into(),
            scope: (scope, None).into(),
            families: Vec::new(),
            items: 0,
        }
    }

    /// Adds a histogram that counts since `start`, in Unix nanoseconds.
    pub(super) fn histogram<'a>(
        &mut self,
        metric: &Metric,
        attributes: &[opentelemetry::KeyValue],
        (values, exemplars): (&Histogram, impl Iterator<Item = &'a Exemplar>),
        [start, now]: [u64; 2],
    ) {
        let (bounds, counts): (Vec<f64>, Vec<u64>) = values.buckets().unzip();
        let point = HistogramDataPoint {
            attributes: attributes.iter().map(KeyValue::from).collect(),
            start_time_unix_nano: start,
            time_unix_nano: now,
            count: values.count(),
            sum: Some(values.sum()),
            bucket_counts: counts,
            // The last bucket has no bound.
            explicit_bounds: bounds
                .into_iter()
                .filter(|bound| bound.is_finite())
                .collect(),
            exemplars: exemplars.map(encoded).collect(),
            ..HistogramDataPoint::default()
        };
        let empty = || {
            Data::Histogram(HistogramFamily {
                data_points: Vec::new(),
                aggregation_temporality: AggregationTemporality::Cumulative.into(),
            })
        };
        if let Data::Histogram(family) = self.family(metric, empty) {
            family.data_points.push(point);
            self.items += 1;
        }
    }

    /// Adds a point of a gauge.
    pub(super) fn gauge(
        &mut self,
        metric: &Metric,
        attributes: &[opentelemetry::KeyValue],
        value: f64,
        now: u64,
    ) {
        let point = NumberDataPoint {
            attributes: attributes.iter().map(KeyValue::from).collect(),
            time_unix_nano: now,
            value: Some(number_data_point::Value::AsDouble(value)),
            ..NumberDataPoint::default()
        };
        if let Data::Gauge(family) = self.family(metric, || Data::Gauge(Gauge::default())) {
            family.data_points.push(point);
            self.items += 1;
        }
    }

    /// Returns the request, with the number of its points; `None` if there are no points.
    pub(super) fn take(&mut self) -> Option<(ExportMetricsServiceRequest, u64)> {
        let metrics = std::mem::take(&mut self.families);
        let items = std::mem::take(&mut self.items);
        let request = ExportMetricsServiceRequest {
            resource_metrics: vec![ResourceMetrics {
                resource: Some(self.resource.clone()),
                scope_metrics: vec![ScopeMetrics {
                    scope: Some(self.scope.clone()),
                    metrics,
                    schema_url: String::new(),
                }],
                schema_url: String::new(),
            }],
        };
        (items > 0).then_some((request, items))
    }

    /// Returns the data of the metric's family, which is the last one or a new one.
    fn family(&mut self, metric: &Metric, empty: impl FnOnce() -> Data) -> &mut Data {
        let name = metric.otlp_name();
        if self.families.last().is_none_or(|last| last.name != name) {
            self.families.push(Family {
                name,
                description: metric.help.to_owned(),
                unit: metric.ucum().to_owned(),
                ..Family::default()
            });
        }
        let last = self.families.len() - 1;
        // A family of this name was just found or added.
        let data = self.families.get_mut(last).map(|family| &mut family.data);
        data.map_or_else(|| unreachable!(), |data| data.get_or_insert_with(empty))
    }
}

fn encoded(exemplar: &Exemplar) -> EncodedExemplar {
    EncodedExemplar {
        time_unix_nano: exemplar.at.0,
        trace_id: exemplar.trace_id.get().to_be_bytes().to_vec(),
        value: Some(exemplar::Value::AsDouble(exemplar.seconds)),
        ..EncodedExemplar::default()
    }
}
