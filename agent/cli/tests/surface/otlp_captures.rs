//! For each capture, OTLP exports each series of the metrics page: name, labels, type, unit, help
//! and value. The page is read as OpenMetrics, and the exports as the receiver decodes them.

use std::collections::{BTreeMap, VecDeque};
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use crate::otlp::changes;
use crate::rp;
use opentelemetry_proto::tonic::collector::metrics::v1::metrics_service_server::{
    MetricsService, MetricsServiceServer,
};
use opentelemetry_proto::tonic::collector::metrics::v1::{
    ExportMetricsServiceRequest, ExportMetricsServiceResponse,
};
use opentelemetry_proto::tonic::common::v1::{KeyValue, any_value};
use opentelemetry_proto::tonic::metrics::v1::{
    AggregationTemporality, HistogramDataPoint, Metric as Family, NumberDataPoint, metric::Data,
    number_data_point,
};
use ros2probe_metrics::catalogue::{CATALOGUE, Kind, Metric};
use ros2probe_testing::local_agent::{LocalAgent, PATIENCE};
use ros2probe_testing::repository;
use tokio::net::TcpListener;
use tokio::runtime::Runtime;
use tonic::transport::server::{Server, TcpIncoming};

/// Number of simultaneous agents.
const AGENTS: usize = 3;
/// A header that accepts only OpenMetrics.
const OPENMETRICS: &str = "Accept: application/openmetrics-text\r\n";

/// The family of a series, and its labels that are not empty.
type Key = (String, BTreeMap<String, String>);
/// The series of a page or of an export.
type AllSeries = BTreeMap<Key, Series>;

/// A series, with numbers as text, because a number may be NaN.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
struct Series {
    kind: &'static str,
    unit: String,
    help: String,
    /// The value. For a histogram, the buckets by `le`, the sum and the count.
    numbers: BTreeMap<String, String>,
}

#[test]
fn exported_series_of_captures_in_the_repository_equal_those_of_the_page() {
    let mut captures = Vec::new();
    for folder in [
        "agent/testing/data",
        "agent/cli/tests/fixtures",
        "wire/tests/data",
    ] {
        find(&repository(folder), &mut captures);
    }
    assert!(captures.len() > 20, "{captures:?}");
    assert_exported(captures);
}

#[test]
#[ignore = "needs the corpus of captures: make test-corpus"]
fn exported_series_of_the_corpus_equal_those_of_the_page() {
    let mut captures = Vec::new();
    find(&ros2probe_testing::corpus(), &mut captures);
    assert_exported(captures);
}

fn find(folder: &Path, captures: &mut Vec<PathBuf>) {
    for file in std::fs::read_dir(folder).unwrap() {
        let path = file.unwrap().path();
        if path.is_dir() {
            find(&path, captures);
        } else if path.to_string_lossy().ends_with(".pcap.gz") {
            captures.push(path);
        }
    }
}

fn assert_exported(captures: Vec<PathBuf>) {
    let runtime = Runtime::new().unwrap();
    let (left, kinds) = (
        Mutex::new(captures),
        Mutex::new(BTreeMap::<_, usize>::new()),
    );
    std::thread::scope(|scope| {
        for _ in 0..AGENTS {
            scope.spawn(|| {
                let next = || left.lock().unwrap().pop();
                while let Some(capture) = next() {
                    for series in compare(&runtime, &capture).into_values() {
                        *kinds.lock().unwrap().entry(series.kind).or_default() += 1;
                    }
                }
            });
        }
    });
    let kinds = kinds.into_inner().unwrap();
    eprintln!("{kinds:?}");
    let all = ["counter", "gauge", "histogram", "info"];
    assert!(kinds.keys().copied().eq(all), "{kinds:?}");
}

/// Compares the page of a finished replay with a later export, and returns the series of the page.
fn compare(runtime: &Runtime, capture: &Path) -> AllSeries {
    let receiver = Receiver::default();
    let address = runtime.block_on(receiver.clone().listen());
    let directory = tempfile::tempdir().unwrap();
    let configuration = directory.path().join("ros2probe.yaml");
    let yaml = format!(
        "watch: [{{topic: /**, per_subscriber: true}}]\nmetrics: {{per_writer: true}}\n\
         otlp: {{endpoint: 'http://{address}', interval_s: 1, events: false}}\n"
    );
    std::fs::write(&configuration, yaml).unwrap();
    let configuration = configuration.to_str().unwrap();
    let arguments = ["--config", configuration, "--speed", "max"];
    let mut agent = LocalAgent::replay(&mut rp(), capture, &arguments);
    agent.wait_for_log("the capture has ended");
    let page = page_series(&agent.request("GET", "/metrics", OPENMETRICS).body);
    let exported = receiver.next_collection();
    let name = capture.display();
    let only = |all: &AllSeries, other: &AllSeries| -> Vec<String> {
        let differs = all
            .iter()
            .filter(|(key, series)| other.get(*key) != Some(*series));
        differs.map(|series| format!("{series:?}")).collect()
    };
    let (shown, sent) = (only(&page, &exported), only(&exported, &page));
    assert!(
        shown.is_empty() && sent.is_empty(),
        "{name}\npage: {shown:#?}\nexported: {sent:#?}"
    );
    page
}

/// A receiver that collects series. A repeated series begins the next collection.
#[derive(Clone, Default)]
struct Receiver(Arc<Mutex<Received>>);

#[derive(Default)]
struct Received {
    collections: VecDeque<AllSeries>,
    seen: usize,
}

#[tonic::async_trait]
impl MetricsService for Receiver {
    async fn export(
        &self,
        request: tonic::Request<ExportMetricsServiceRequest>,
    ) -> Result<tonic::Response<ExportMetricsServiceResponse>, tonic::Status> {
        self.0.lock().unwrap().add(request.into_inner());
        Ok(tonic::Response::new(ExportMetricsServiceResponse::default()))
    }
}

impl Receiver {
    async fn listen(self) -> SocketAddr {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
        let server = Server::builder().add_service(MetricsServiceServer::new(self));
        tokio::spawn(server.serve_with_incoming(TcpIncoming::from(listener)));
        address
    }

    /// Waits for a complete collection that begins after this call.
    fn next_collection(&self) -> AllSeries {
        // The current collection may have begun before, and the next one may already be on its way.
        let wanted = self.0.lock().unwrap().seen + 2;
        let deadline = Instant::now() + PATIENCE;
        loop {
            let received = self.0.lock().unwrap();
            if received.seen > wanted {
                return received.collections[0].clone();
            }
            drop(received);
            assert!(Instant::now() < deadline, "no whole collection came");
            std::thread::sleep(Duration::from_millis(20));
        }
    }
}

impl Received {
    fn add(&mut self, request: ExportMetricsServiceRequest) {
        let resources = request.resource_metrics.into_iter();
        let scopes = resources.flat_map(|resource| resource.scope_metrics);
        let mut batch = AllSeries::new();
        for family in scopes.flat_map(|scope| scope.metrics) {
            for (key, series) in exported_series(&family) {
                let twice = batch.insert(key, series);
                assert!(twice.is_none(), "twice in one request: {twice:?}");
            }
        }
        let last = self.collections.back();
        if last.is_none_or(|last| batch.keys().any(|key| last.contains_key(key))) {
            self.collections.push_back(AllSeries::new());
            self.seen += 1;
            // Keeps the last collection, and the complete collection before it.
            while self.collections.len() > 2 {
                self.collections.pop_front();
            }
        }
        self.collections.back_mut().unwrap().extend(batch);
    }
}

fn exported_series(family: &Family) -> Vec<(Key, Series)> {
    let mut known = CATALOGUE.iter();
    let metric = known.find(|metric| metric.otlp_name() == family.name);
    let metric = metric.unwrap_or_else(|| panic!("{} is in no catalogue", family.name));
    assert_eq!(family.unit, metric.ucum(), "{}", family.name);
    let series = |kind, attributes: &[KeyValue], numbers: Vec<(String, f64)>| {
        let labels = attributes.iter().map(label).collect();
        let mut series = Series {
            kind,
            unit: metric.unit.unwrap_or_default().to_owned(),
            help: family.description.clone(),
            numbers: BTreeMap::new(),
        };
        for (part, number) in numbers {
            series.add(metric.name, part, number);
        }
        ((metric.family().to_owned(), labels), series)
    };
    let number = |kind| {
        move |point: &NumberDataPoint| {
            series(kind, &point.attributes, vec![(String::new(), value(point))])
        }
    };
    let cumulative = i32::from(AggregationTemporality::Cumulative);
    match family.data.as_ref().unwrap() {
        Data::Sum(sum) => {
            assert!(sum.is_monotonic && sum.aggregation_temporality == cumulative);
            sum.data_points.iter().map(number("counter")).collect()
        }
        Data::Gauge(gauge) => {
            let kind = if metric.kind == Kind::Info {
                "info"
            } else {
                "gauge"
            };
            gauge.data_points.iter().map(number(kind)).collect()
        }
        Data::Histogram(histogram) => {
            assert_eq!(histogram.aggregation_temporality, cumulative);
            let points = histogram.data_points.iter();
            let points = points.map(|point| series("histogram", &point.attributes, buckets(point)));
            points.collect()
        }
        other => panic!("{other:?}"),
    }
}

fn label(attribute: &KeyValue) -> (String, String) {
    let value = attribute.value.as_ref().and_then(|any| any.value.as_ref());
    let value = match value.unwrap() {
        any_value::Value::StringValue(text) => text.clone(),
        any_value::Value::IntValue(number) => number.to_string(),
        other => panic!("{other:?}"),
    };
    (attribute.key.clone(), value)
}

#[expect(
    clippy::cast_precision_loss,
    reason = "the page's numbers are read as such, too"
)]
fn value(point: &NumberDataPoint) -> f64 {
    match point.value.unwrap() {
        number_data_point::Value::AsDouble(value) => value,
        number_data_point::Value::AsInt(value) => value as f64,
    }
}

/// Returns the parts of a histogram as on a page, where each bucket includes the smaller ones.
#[expect(
    clippy::cast_precision_loss,
    reason = "the page's numbers are read as such, too"
)]
fn buckets(point: &HistogramDataPoint) -> Vec<(String, f64)> {
    let bounds = point.explicit_bounds.iter().copied();
    let bounds = bounds.chain([f64::INFINITY]);
    let mut total = 0;
    let mut parts: Vec<_> = bounds
        .zip(&point.bucket_counts)
        .map(|(bound, count)| {
            total += count;
            (format!("{bound:?}"), total as f64)
        })
        .collect();
    parts.push(("_sum".to_owned(), point.sum.unwrap()));
    parts.push(("_count".to_owned(), point.count as f64));
    parts
}

impl Series {
    /// Adds a number. A number that changes between readings is replaced by a fixed text.
    fn add(&mut self, metric: &str, part: String, number: f64) {
        let number = if changes(metric) {
            "changes".to_owned()
        } else {
            format!("{number:?}")
        };
        let twice = self.numbers.insert(part, number);
        assert!(twice.is_none(), "{metric}: twice");
    }
}

/// Returns the series of an OpenMetrics page.
fn page_series(page: &str) -> AllSeries {
    let mut all = AllSeries::new();
    let mut metric: Option<&Metric> = None;
    let mut family = Series::default();
    for line in page.lines() {
        if line == "# EOF" {
            return all;
        }
        if let Some(description) = line.strip_prefix("# ") {
            let mut words = description.splitn(3, ' ');
            let mut word = || words.next().unwrap();
            match (word(), word(), word()) {
                ("HELP", name, help) => {
                    metric = CATALOGUE.iter().find(|metric| metric.family() == name);
                    family = Series {
                        help: help.to_owned(),
                        ..Series::default()
                    };
                }
                ("TYPE", _, kind) => {
                    let mut kinds = ["counter", "gauge", "histogram", "info"].into_iter();
                    family.kind = kinds.find(|known| *known == kind).unwrap();
                }
                ("UNIT", _, unit) => unit.clone_into(&mut family.unit),
                other => panic!("{other:?}"),
            }
            continue;
        }
        let metric = metric.unwrap();
        let (series, number) = line.rsplit_once(' ').unwrap();
        let (name, labels) = series.split_once('{').unwrap_or((series, ""));
        let mut labels = parsed(labels);
        let suffix = name.strip_prefix(metric.family()).unwrap();
        let part = match (family.kind, suffix) {
            ("counter", "_total") | ("gauge", "") | ("info", "_info") => String::new(),
            ("histogram", "_bucket") => {
                format!("{:?}", labels.remove("le").unwrap().parse::<f64>().unwrap())
            }
            ("histogram", "_sum" | "_count") => suffix.to_owned(),
            other => panic!("{line}: {other:?}"),
        };
        let key = (metric.family().to_owned(), labels);
        let series = all.entry(key).or_insert_with(|| family.clone());
        series.add(metric.name, part, number.parse().unwrap());
    }
    panic!("the page is not complete")
}

/// Returns the labels without empty ones, which are equal to missing ones in Prometheus.
fn parsed(mut labels: &str) -> BTreeMap<String, String> {
    let mut all = BTreeMap::new();
    while let Some((name, rest)) = labels.split_once("=\"") {
        let (mut value, mut rest) = (String::new(), rest.chars());
        loop {
            match rest.next().unwrap() {
                '"' => break,
                '\\' => value.push(match rest.next().unwrap() {
                    'n' => '\n',
                    other => other,
                }),
                other => value.push(other),
            }
        }
        labels = rest.as_str().trim_start_matches(',');
        if !value.is_empty() {
            assert!(all.insert(name.to_owned(), value).is_none(), "{name} twice");
        }
    }
    assert!(["", "}"].contains(&labels), "{labels}");
    all
}
