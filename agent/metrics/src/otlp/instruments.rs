//! The catalogue as observable instruments of the SDK.
//!
//! Counters have one provider for the lifetime of the agent: the SDK starts the series of an
//! instrument when the instrument is created. All points of a metric have one start (`data::Sum`,
//! opentelemetry_sdk 0.33; issue 2472). A series that begins later or again thus has the agent's
//! start, too. Gauges get a new provider in each collection: the SDK keeps the memory of their
//! series, and reserves it for the largest number of series.
//!
//! Observable instruments report only the series that their callback observes, so series vanish
//! with their facts. The limit on series exceeds the number in one request, so that no series is
//! merged into `otel.metric.overflow`.

use std::collections::HashMap;
use std::ops::Range;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, Weak};
use std::time::Duration;

use opentelemetry::metrics::{AsyncInstrument, Meter, MeterProvider as _};
use opentelemetry::{InstrumentationScope, KeyValue};
use opentelemetry_sdk::Resource;
use opentelemetry_sdk::error::OTelSdkResult;
use opentelemetry_sdk::metrics::data::ResourceMetrics;
use opentelemetry_sdk::metrics::reader::MetricReader;
use opentelemetry_sdk::metrics::{
    Instrument, InstrumentKind, ManualReader, Pipeline, SdkMeterProvider, Stream, Temporality,
};

use crate::catalogue::{CATALOGUE, Kind, Metric};
use crate::metric_sink::Number;

/// Maximum number of points in one request.
pub(super) const REQUEST_POINTS: usize = 8192;

/// Instruments of all metrics.
pub(super) struct Instruments {
    resource: Resource,
    scope: InstrumentationScope,
    counted: Observed,
    counters: Readable,
}

/// The points that the callbacks observe.
#[derive(Clone, Default)]
struct Observed(Arc<Mutex<Points>>);

/// Points of one request.
#[derive(Default)]
pub(super) struct Points {
    families: Vec<(&'static Metric, Range<usize>)>,
    points: Vec<Point>,
    attributes: Vec<KeyValue>,
}

struct Point {
    value: Number,
    attributes: Range<usize>,
}

impl Points {
    /// Returns the number of points.
    pub(super) const fn len(&self) -> usize {
        self.points.len()
    }

    /// Adds a point; the points of a metric must follow each other.
    pub(super) fn push(&mut self, metric: &'static Metric, labels: &[KeyValue], value: Number) {
        let begin = self.attributes.len();
        self.attributes.extend_from_slice(labels);
        let attributes = begin..self.attributes.len();
        self.points.push(Point { value, attributes });
        let end = self.points.len();
        match self.families.last_mut() {
            Some((last, points)) if last.name == metric.name => points.end = end,
            _ => self.families.push((metric, end - 1..end)),
        }
    }

    /// Returns whether the metric has whole values, and whether it has real values.
    fn kinds(&self, metric: &Metric) -> [bool; 2] {
        let is_whole = |(value, _): (Number, _)| matches!(value, Number::Count(_));
        let whole = self.of(metric).any(is_whole);
        [whole, self.of(metric).any(|point| !is_whole(point))]
    }

    fn of(&self, metric: &Metric) -> impl Iterator<Item = (Number, &[KeyValue])> {
        let family = self.families.iter();
        let family = family.filter(|(known, _)| known.name == metric.name);
        let points = family.flat_map(|(_, points)| self.points.get(points.clone()));
        points.flatten().map(|point| {
            let attributes = self.attributes.get(point.attributes.clone());
            (point.value, attributes.unwrap_or_default())
        })
    }
}

impl Observed {
    fn points(&self) -> MutexGuard<'_, Points> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn add_integers(self, metric: &'static Metric) -> impl Fn(&dyn AsyncInstrument<u64>) {
        move |observer| {
            for (value, attributes) in self.points().of(metric) {
                if let Number::Count(count) = value {
                    // OTLP's whole numbers are signed.
                    observer.observe(count.min(i64::MAX.cast_unsigned()), attributes);
                }
            }
        }
    }

    fn add_floats(self, metric: &'static Metric) -> impl Fn(&dyn AsyncInstrument<f64>) {
        move |observer| {
            for (value, attributes) in self.points().of(metric) {
                if let Number::Real(real) = value {
                    observer.observe(real, attributes);
                }
            }
        }
    }
}

impl Instruments {
    /// Creates the instruments. The series of counters start now.
    pub(super) fn new(resource: Resource, scope: InstrumentationScope) -> Self {
        let counted = Observed::default();
        let limit = |_: &Instrument| stream(REQUEST_POINTS);
        let counters = Readable::new(resource.clone(), limit);
        let meter = counters.provider.meter_with_scope(scope.clone());
        for metric in CATALOGUE {
            if metric.kind == Kind::Counter {
                counter(&meter, metric, counted.clone());
            }
        }
        // Frees the memory that the SDK reserves for series.
        counters.collect();
        Self {
            resource,
            scope,
            counted,
            counters,
        }
    }

    /// Returns the points of counters in the SDK's form.
    pub(super) fn counters(&self, points: Points) -> ResourceMetrics {
        *self.counted.points() = points;
        let collected = self.counters.collect();
        *self.counted.points() = Points::default();
        collected
    }

    /// Returns the points of gauges in the SDK's form.
    pub(super) fn gauges(&self, points: Points) -> ResourceMetrics {
        let families = points.families.iter();
        let limits: HashMap<String, usize> = families
            .map(|(metric, points)| (metric.otlp_name(), points.len()))
            .collect();
        let limit = move |metric: &Instrument| stream(*limits.get(metric.name())?);
        let gauges = Readable::new(self.resource.clone(), limit);
        let meter = gauges.provider.meter_with_scope(self.scope.clone());
        let metrics: Vec<_> = points.families.iter().map(|(metric, _)| *metric).collect();
        let observed = Observed(Arc::new(Mutex::new(points)));
        for metric in metrics {
            gauge(&meter, metric, &observed);
        }
        gauges.collect()
    }
}

fn stream(limit: usize) -> Option<Stream> {
    Stream::builder().with_cardinality_limit(limit).build().ok()
}

/// Returns whether a counter has real values: only seconds are not whole numbers.
pub(super) fn is_real(counter: &Metric) -> bool {
    counter.unit == Some("seconds")
}

fn counter(meter: &Meter, metric: &'static Metric, observed: Observed) {
    let (name, help, unit) = (metric.otlp_name(), metric.help, metric.ucum());
    if is_real(metric) {
        let counter = meter.f64_observable_counter(name);
        let counter = counter.with_description(help).with_unit(unit);
        counter.with_callback(observed.add_floats(metric)).build();
    } else {
        let counter = meter.u64_observable_counter(name);
        let counter = counter.with_description(help).with_unit(unit);
        counter.with_callback(observed.add_integers(metric)).build();
    }
}

fn gauge(meter: &Meter, metric: &'static Metric, observed: &Observed) {
    let (name, help, unit) = (metric.otlp_name(), metric.help, metric.ucum());
    let [whole, real] = observed.points().kinds(metric);
    if whole {
        let gauge = meter.u64_observable_gauge(name.clone());
        let gauge = gauge.with_description(help).with_unit(unit);
        gauge
            .with_callback(observed.clone().add_integers(metric))
            .build();
    }
    if real {
        let gauge = meter.f64_observable_gauge(name);
        let gauge = gauge.with_description(help).with_unit(unit);
        gauge
            .with_callback(observed.clone().add_floats(metric))
            .build();
    }
}

/// A provider whose metrics are read on demand, on the thread that reads.
struct Readable {
    provider: SdkMeterProvider,
    reader: Reader,
}

impl Readable {
    fn new(
        resource: Resource,
        limit: impl Fn(&Instrument) -> Option<Stream> + Send + Sync + 'static,
    ) -> Self {
        let reader = Reader::default();
        let provider = SdkMeterProvider::builder()
            .with_resource(resource)
            .with_reader(reader.clone())
            .with_view(limit)
            .build();
        Self { provider, reader }
    }

    fn collect(&self) -> ResourceMetrics {
        let mut collected = ResourceMetrics::default();
        // Fails only after the provider has shut down.
        let _ = self.reader.collect(&mut collected);
        collected
    }
}

/// The SDK's reader, shared with its provider.
#[derive(Clone, Debug, Default)]
struct Reader(Arc<ManualReader>);

impl MetricReader for Reader {
    fn register_pipeline(&self, pipeline: Weak<Pipeline>) {
        self.0.register_pipeline(pipeline);
    }

    fn collect(&self, metrics: &mut ResourceMetrics) -> OTelSdkResult {
        self.0.collect(metrics)
    }

    fn force_flush(&self) -> OTelSdkResult {
        self.0.force_flush()
    }

    fn shutdown_with_timeout(&self, timeout: Duration) -> OTelSdkResult {
        self.0.shutdown_with_timeout(timeout)
    }

    fn temporality(&self, kind: InstrumentKind) -> Temporality {
        self.0.temporality(kind)
    }
}
