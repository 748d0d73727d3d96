//! Tests of the exporter with a receiver that answers as each test requires.

use std::collections::VecDeque;
use std::net::SocketAddr;
use std::path::Path;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant, SystemTime};

use opentelemetry_proto::tonic::collector::metrics::v1::metrics_service_server::{
    MetricsService, MetricsServiceServer,
};
use opentelemetry_proto::tonic::collector::metrics::v1::{
    ExportMetricsPartialSuccess, ExportMetricsServiceRequest, ExportMetricsServiceResponse,
};
use tokio::net::TcpListener;
use tonic::transport::server::{Server, TcpIncoming};
use tonic::{Code, Status};

use crate::agent_facts::{AgentFacts, InsideSourceFacts, SourceKind};
use crate::config::{Config, Watch, Watchlist};
use crate::events::EventLog;
use crate::surface::{Exposition, Format, MetricSources};
use opentelemetry_proto::tonic::common::v1::any_value::Value;
use opentelemetry_proto::tonic::metrics::v1::metric::Data;
use opentelemetry_proto::tonic::metrics::v1::number_data_point;
use ros2probe_metrics::catalogue::CATALOGUE;
use ros2probe_metrics::export_thread::ExportThread;
use ros2probe_metrics::otlp::{self, Exports, Host, Inputs, Outcome, Reason, Settings, Signal};
use ros2probe_model::facts::calls::report::{
    CallbackReport, Durations, ProcessReport, PublisherReport, Report, ThreadStates, Transition,
    Trigger,
};
use ros2probe_model::facts::model_time::ModelTime;
use ros2probe_model::observe::input::Input;
use ros2probe_model::observe::observer::{self, Observer};
use ros2probe_model::report::snapshot::{DiagnosticStatus, Snapshot};
use ros2probe_wire::diagnostics::DiagnosticLevel;
use ros2probe_wire::time::SECOND;
use ros2probe_wire::{DomainId, EntityId, Guid, GuidPrefix, Timestamp};

/// Reaction of the receiver to a request.
#[derive(Clone, Copy)]
enum Answer {
    Taken,
    Rejects(i64),
    Says(Code),
    Sleeps,
}

#[derive(Clone, Default)]
struct Receiver {
    script: Arc<Mutex<VecDeque<Answer>>>,
    got: Arc<Mutex<Vec<ExportMetricsServiceRequest>>>,
}

#[tonic::async_trait]
impl MetricsService for Receiver {
    async fn export(
        &self,
        request: tonic::Request<ExportMetricsServiceRequest>,
    ) -> Result<tonic::Response<ExportMetricsServiceResponse>, Status> {
        let answer = self.script.lock().unwrap().pop_front();
        let partial_success = match answer.unwrap_or(Answer::Taken) {
            Answer::Taken => None,
            Answer::Rejects(rejected_data_points) => Some(ExportMetricsPartialSuccess {
                rejected_data_points,
                error_message: "too old".to_owned(),
            }),
            Answer::Says(code) => return Err(Status::new(code, "so said the test")),
            Answer::Sleeps => {
                tokio::time::sleep(Duration::from_secs(60)).await;
                None
            }
        };
        self.got.lock().unwrap().push(request.into_inner());
        Ok(tonic::Response::new(ExportMetricsServiceResponse {
            partial_success,
        }))
    }
}

impl Receiver {
    async fn listening(script: impl IntoIterator<Item = Answer>) -> (Self, SocketAddr) {
        let receiver = Self::default();
        receiver.script.lock().unwrap().extend(script);
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
        receiver.clone().serve(listener);
        (receiver, address)
    }

    fn serve(self, listener: TcpListener) {
        let service = MetricsServiceServer::new(self)
            .accept_compressed(tonic::codec::CompressionEncoding::Gzip);
        let server = Server::builder().add_service(service);
        tokio::spawn(server.serve_with_incoming(TcpIncoming::from(listener)));
    }

    fn requests(&self) -> usize {
        self.got.lock().unwrap().len()
    }
}

/// Starts an agent of a quiet robot that exports at this interval in seconds.
fn exporting(address: SocketAddr, interval: u32, more: &str) -> (Arc<Exports>, ExportThread) {
    let sources = MetricSources::new(
        SourceKind::Replay,
        crate::settings_cell::Settings::default(),
    );
    let agent = AgentFacts {
        finished: true,
        ..AgentFacts::new(SourceKind::Replay, Instant::now())
    };
    sources.latest.publish(Snapshot::default(), agent);
    let exporter = start(address, interval, more, &sources);
    (sources.exports, exporter)
}

fn start(address: SocketAddr, interval: u32, more: &str, sources: &MetricSources) -> ExportThread {
    let yaml = format!("otlp: {{endpoint: 'http://{address}', interval_s: {interval}, {more}}}");
    start_with(&yaml, sources, None)
}

/// Starts the exporter of a configuration, with its queues in this directory.
pub(super) fn start_with(
    yaml: &str,
    sources: &MetricSources,
    directory: Option<&Path>,
) -> ExportThread {
    let config = Config::parse(yaml.as_bytes()).unwrap();
    let host = Host::default();
    let read = crate::file::read_text;
    let settings = Settings::resolve(&config.otlp, &|_| None, read, &host).unwrap();
    let inputs = Inputs {
        metrics: Arc::new(sources.clone()),
        events: Arc::<EventLog>::clone(&sources.events),
        spans: Arc::default(),
        log: None,
        node_logs: Arc::default(),
        exports: Arc::clone(&sources.exports),
        directory: directory.map(Path::to_owned),
    };
    otlp::start(settings.unwrap(), inputs, crate::privilege::spawn_export).unwrap()
}

/// Returns a snapshot of a managed node, observed from inside its process, whose timer publishes
/// `/scan` at 20 Hz and takes 4 ms.
fn inside_snapshot() -> Snapshot {
    let start = 1_795_143_000 * SECOND;
    let mut observer = Observer::new(observer::Settings::default());
    observer.input(Input::Time(Timestamp(start)));
    let watches = Watchlist::new(vec![Watch::named("/**").unwrap()]).unwrap();
    observer.input(Input::Watchlist(Arc::new(watches)));
    for second in 1..=10 {
        let at = Timestamp(start + second * SECOND - SECOND / 2);
        let mut durations = Durations::default();
        (0..20 * second).for_each(|_| durations.observe(Duration::from_millis(4)));
        let process = ProcessReport {
            id: 70,
            name: Some("lidar".into()),
            domain_id: DomainId(3),
            nodes: vec!["/lidar".into()],
            shows_intra_process: true,
            publishers: vec![PublisherReport {
                handle: 1,
                node: None,
                topic: "/scan".into(),
                middleware: Some("rmw_zenoh_cpp".into()),
                published: 20 * second,
                within_process: 5 * second,
                last: at,
                intervals: Durations::default(),
            }],
            callbacks: vec![CallbackReport {
                handle: 3,
                node: None,
                trigger: Trigger::Timer(Some(Duration::from_millis(50))),
                thread: 71,
                calls: 20 * second,
                last: at,
                durations,
                waits: Durations::default(),
                skipped: 2,
                states: ThreadStates::default(),
            }],
            ..ProcessReport::default()
        };
        let transition = Transition {
            process: 70,
            node: None,
            start: "activating".into(),
            goal: "active".into(),
            at,
        };
        observer.input(Input::Inside(Report {
            at,
            has_callbacks: true,
            processes: vec![process],
            transitions: vec![transition],
            late: Vec::new(),
        }));
        observer.input(Input::Time(Timestamp(start + second * SECOND)));
    }
    observer.snapshot(Timestamp(start + 10 * SECOND))
}

/// Returns the points of a request as lines `name{key="value",…} value`; the value of a histogram
/// is its count.
fn lines(request: &ExportMetricsServiceRequest) -> Vec<String> {
    let scopes = request
        .resource_metrics
        .iter()
        .flat_map(|each| &each.scope_metrics);
    let mut lines = Vec::new();
    for metric in scopes.flat_map(|scope| &scope.metrics) {
        let mut line = |attributes: &[opentelemetry_proto::tonic::common::v1::KeyValue],
                        value: f64| {
            let labels = attributes.iter().map(|each| {
                let value = each.value.as_ref().and_then(|value| value.value.as_ref());
                match value.unwrap() {
                    Value::StringValue(text) => format!("{}=\"{text}\"", each.key),
                    Value::IntValue(number) => format!("{}=\"{number}\"", each.key),
                    other => panic!("{other:?}"),
                }
            });
            let mut labels: Vec<String> = labels.collect();
            labels.sort();
            lines.push(format!("{}{{{}}} {value}", metric.name, labels.join(",")));
        };
        let numbers = match metric.data.as_ref().unwrap() {
            Data::Sum(sum) => &sum.data_points,
            Data::Gauge(gauge) => &gauge.data_points,
            Data::Histogram(histogram) => {
                for point in &histogram.data_points {
                    #[expect(clippy::cast_precision_loss, reason = "small counts")]
                    line(&point.attributes, point.count as f64);
                }
                continue;
            }
            other => panic!("{other:?}"),
        };
        for point in numbers {
            let value = match point.value.unwrap() {
                number_data_point::Value::AsDouble(value) => value,
                #[expect(clippy::cast_precision_loss, reason = "small counts")]
                number_data_point::Value::AsInt(value) => value as f64,
            };
            line(&point.attributes, value);
        }
    }
    lines
}

#[tokio::test]
async fn metrics_of_calls_inside_processes_are_exported_as_on_the_page() {
    let (receiver, address) = Receiver::listening([]).await;
    let sources = MetricSources::new(
        SourceKind::Host,
        crate::settings_cell::Settings {
            histograms: true,
            ..crate::settings_cell::Settings::default()
        },
    );
    let agent = AgentFacts {
        inside: Some(InsideSourceFacts {
            mode: "full",
            counters: vec![("hits", 777)],
            ..InsideSourceFacts::default()
        }),
        ..AgentFacts::new(SourceKind::Host, Instant::now())
    };
    sources.latest.publish(inside_snapshot(), agent);
    let page = Exposition::new(sources.clone()).render(Format::Classic);
    let page = page.unwrap();
    let exporter = start(address, 1, "", &sources);
    until("an export", || receiver.requests() > 0).await;
    exporter.finish().await;
    let got = receiver.got.lock().unwrap();
    let exported: Vec<String> = got.iter().flat_map(lines).collect();
    let known = |expected: &str| exported.iter().any(|line| line == expected);
    let callback = "domain_id=\"3\",name=\"50ms\",ros_node=\"/lidar\",trigger=\"timer\"";
    for expected in [
        "ros2.topic.inside_published_messages{domain_id=\"3\",topic=\"/scan\"} 200".to_owned(),
        "ros2.topic.source_info{domain_id=\"3\",source=\"inside\",topic=\"/scan\"} 1".to_owned(),
        format!("ros2.callback_duration{{{callback}}} 200"),
        format!("ros2.callback_duration_max{{{callback}}} 0.004"),
        format!("ros2.timer_skipped_periods{{{callback}}} 2"),
        "ros2.node.lifecycle_state{domain_id=\"3\",ros_node=\"/lidar\",state=\"active\"} 1"
            .to_owned(),
        "ros2probe.inside_events{event=\"hits\"} 777".to_owned(),
        "ros2probe.inside_processes{state=\"counted\"} 1".to_owned(),
    ] {
        assert!(known(&expected), "{expected}\n{exported:#?}");
    }
    // Every metric of the page about calls inside processes is exported under its name.
    let of_inside = CATALOGUE.iter().filter(|metric| {
        let name = metric.name;
        ["inside", "callback", "intra_process", "lifecycle", "timer"]
            .iter()
            .any(|part| name.contains(part))
            && page.lines().any(|line| line.starts_with(name))
    });
    let mut count = 0;
    for metric in of_inside {
        count += 1;
        let name = metric.otlp_name() + "{";
        let is_exported = exported.iter().any(|line| line.starts_with(&name));
        assert!(is_exported, "{name}\n{exported:#?}");
    }
    assert!(count > 15, "{count}");
}

#[test]
fn a_repeated_key_of_a_diagnostic_status_is_one_series() {
    let settings = crate::settings_cell::Settings {
        diagnostic_values: vec!["battery/*".to_owned()],
        ..crate::settings_cell::Settings::default()
    };
    let sources = MetricSources::new(SourceKind::Host, settings);
    let value = |key: &str, value: &str| -> (Box<str>, Box<str>) { (key.into(), value.into()) };
    let status = DiagnosticStatus {
        domain_id: DomainId(3),
        topic: "/diagnostics".into(),
        name: "battery".into(),
        hardware_id: "".into(),
        node: None,
        writer: Guid::new(GuidPrefix([1; 12]), EntityId([0, 0, 1, 3])),
        level: DiagnosticLevel::Ok,
        message: "".into(),
        values: vec![
            value("Cell", "unknown"),
            value("Cell", "3.5"),
            value("Cell", "3.25"),
            value("Charge", "80"),
        ],
        at: ModelTime::default(),
        since: ModelTime::default(),
    };
    let mut snapshot = Snapshot::default();
    snapshot.diagnostics.statuses = vec![Arc::new(status)];
    let agent = AgentFacts::new(SourceKind::Host, Instant::now());
    sources.latest.publish(snapshot, agent);
    let page = Exposition::new(sources).render(Format::Classic).unwrap();
    let series = page
        .lines()
        .filter(|line| line.starts_with("ros2_diagnostics_value{"));
    let values: Vec<f64> = series
        .map(|line| line.rsplit_once(' ').unwrap().1.parse().unwrap())
        .collect();
    assert_eq!(values, [3.5, 80.0], "{page}");
}

async fn until(what: &str, mut holds: impl FnMut() -> bool) {
    let deadline = Instant::now() + Duration::from_secs(30);
    while !holds() {
        assert!(Instant::now() < deadline, "{what}");
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
}

fn requests(exports: &Exports) -> [u64; 4] {
    Outcome::ALL.map(|outcome| exports.requests(Signal::Metrics, outcome))
}

#[tokio::test]
async fn a_transient_failure_is_retried_and_a_refusal_is_not() {
    let script = [
        Answer::Says(Code::Unavailable),
        Answer::Taken,
        Answer::Says(Code::InvalidArgument),
        Answer::Rejects(7),
    ];
    let (receiver, address) = Receiver::listening(script).await;
    // The pause before a retry is at most a second. The export interval is longer, so that the next
    // export does not overtake the retry.
    let (exports, exporter) = exporting(address, 3, "compression: gzip");
    let exports = exports.as_ref();
    until("a part is rejected", || {
        exports.requests(Signal::Metrics, Outcome::Partial) == 1
    })
    .await;
    let [delivered, partial, retried, failed] = requests(exports);
    assert_eq!((partial, retried, failed), (1, 1, 1));
    assert!(delivered >= 1);
    assert_eq!(exports.dropped(Signal::Metrics, Reason::Rejected), 7);
    assert!(exports.dropped(Signal::Metrics, Reason::Refused) > 20);
    assert_eq!(exports.dropped(Signal::Metrics, Reason::Superseded), 0);
    let before = receiver.requests();
    exporter.finish().await;
    assert!(receiver.requests() > before, "the last export");
}

#[tokio::test]
async fn newer_points_supersede_points_that_a_slow_receiver_does_not_accept() {
    let (receiver, address) = Receiver::listening([Answer::Sleeps, Answer::Sleeps]).await;
    let (exports, exporter) = exporting(address, 1, "timeout_s: 30");
    let exports = exports.as_ref();
    until("it takes some in the end", || receiver.requests() > 0).await;
    let [_, _, retried, failed] = requests(exports);
    assert_eq!((retried, failed), (0, 2));
    assert!(exports.dropped(Signal::Metrics, Reason::Superseded) > 40);
    exporter.finish().await;
}

#[tokio::test]
async fn a_late_receiver_gets_recent_points_and_a_missing_one_does_not_delay_the_end() {
    // The test uses an address of its own. On another address, a different test could take the port
    // first.
    let listener = TcpListener::bind("127.17.40.1:0").await.unwrap();
    let address = listener.local_addr().unwrap();
    drop(listener);
    let (exports, exporter) = exporting(address, 1, "");
    let exports = exports.as_ref();
    until("a batch is given up", || {
        exports.dropped(Signal::Metrics, Reason::Superseded) > 0
    })
    .await;
    let receiver = Receiver::default();
    let started = SystemTime::now();
    receiver
        .clone()
        .serve(TcpListener::bind(address).await.unwrap());
    until("it is found", || receiver.requests() > 0).await;
    let now = started.duration_since(SystemTime::UNIX_EPOCH).unwrap();
    let first = receiver.got.lock().unwrap().remove(0);
    let times = format!("{first:?}");
    let time = times.split("time_unix_nano: ").nth(2).unwrap();
    let time: u64 = time.split(',').next().unwrap().parse().unwrap();
    let age = now.as_secs_f64() - time as f64 / 1e9;
    assert!(age < 2.5, "{age} s old");
    exporter.finish().await;

    // The first receiver accepts connections without answering, then no receiver exists.
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap();
    let mut mute = Some(listener);
    for _ in 0..2 {
        let (exports, exporter) = exporting(address, 1, "timeout_s: 30");
        tokio::time::sleep(Duration::from_millis(400)).await;
        let begun = Instant::now();
        exporter.finish().await;
        // The last export has 2 s, and not the timeout of a request.
        assert!(begun.elapsed() < Duration::from_secs(20));
        assert!(exports.dropped(Signal::Metrics, Reason::Shutdown) > 0);
        mute = None;
    }
    assert!(mute.is_none());
}
