//! A real OpenTelemetry receiver gets the values of the metrics page, and the agent continues when
//! the receiver stops.

use std::collections::BTreeMap;
use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};

use crate::rp;
use opentelemetry_proto::tonic::collector::metrics::v1::metrics_service_server::{
    MetricsService, MetricsServiceServer,
};
use opentelemetry_proto::tonic::collector::metrics::v1::{
    ExportMetricsServiceRequest, ExportMetricsServiceResponse,
};
use ros2probe_metrics::catalogue::{CATALOGUE, Kind};
use ros2probe_model::derive::trace::Message as TraceMessage;
use ros2probe_testing::local_agent::{self, LocalAgent, metric};
use ros2probe_testing::ports::free_address;
use ros2probe_testing::repository;
use ros2probe_testing::robot_log;
use ros2probe_testing::rotel::{Export, Item, Rotel, exports};
use ros2probe_wire::SequenceNumber;

/// Returns whether the value of a metric changes between two readings.
pub(crate) fn changes(name: &str) -> bool {
    name.starts_with("process_")
        || name.starts_with("ros2probe_otlp_")
        || matches!(
            name,
            "ros2probe_snapshot_age_seconds"
                | "ros2probe_scrape_duration_seconds"
                // A scrape counts as a client.
                | "ros2probe_limit_used"
        )
}

/// Returns the series of the page, without buckets of histograms and without changing values.
fn page_series(page: &str) -> BTreeMap<String, f64> {
    let lines = page.lines().filter(|line| !line.starts_with('#'));
    let series = lines.filter_map(|line| {
        let (series, value) = line.rsplit_once(' ')?;
        Some((series.to_owned(), value.parse().ok()?))
    });
    series
        .filter(|(series, _)| !changes(series.split('{').next().unwrap()))
        .filter(|(series, _)| !series.contains("_bucket{"))
        .collect()
}

/// Returns the same series of an export.
fn exported_series(export: &[Export]) -> BTreeMap<String, f64> {
    let names: BTreeMap<String, _> = CATALOGUE
        .iter()
        .map(|metric| (metric.otlp_name(), metric))
        .collect();
    let mut series = BTreeMap::new();
    for item in export.iter().flat_map(|export| &export.items) {
        let name = &item.fields["Name"];
        let metric = names
            .get(name)
            .unwrap_or_else(|| panic!("{name} is in no catalogue"));
        assert_eq!(
            item.fields.get("Unit").map_or("", String::as_str),
            metric.ucum(),
            "{name}"
        );
        let kind = match metric.kind {
            Kind::Counter => "Sum",
            Kind::Gauge | Kind::Info => "Gauge",
            Kind::Histogram => "Histogram",
        };
        assert_eq!(item.fields["DataType"], kind, "{name}");
        if changes(metric.name) {
            continue;
        }
        let label = |label: &&str| {
            let value = item.attributes.get(*label).map_or("", String::as_str);
            format!("{label}=\"{value}\"")
        };
        let labels: Vec<String> = metric.labels.iter().map(label).collect();
        let labels = match labels.as_slice() {
            [] => String::new(),
            labels => format!("{{{}}}", labels.join(",")),
        };
        let mut add = |suffix: &str, field: &str| {
            let value = item.fields[field].parse().unwrap();
            series.insert(format!("{}{suffix}{labels}", metric.name), value);
        };
        if metric.kind == Kind::Histogram {
            add("_count", "Count");
            add("_sum", "Sum");
            let count: u64 = item.fields["Count"].parse().unwrap();
            assert_eq!(item.buckets.iter().sum::<u64>(), count, "{name}");
        } else {
            add("", "Value");
        }
    }
    series
}

#[test]
fn a_real_receiver_gets_the_series_of_the_page_also_after_a_restart() {
    let directory = tempfile::tempdir().unwrap();
    let mut receiver = Rotel::start(&mut Command::new(Rotel::binary()), directory.path(), None);
    let configuration = directory.path().join("ros2probe.yaml");
    let yaml = format!(
        "watch: [{{topic: /**, per_subscriber: true}}]\nmetrics: {{per_writer: true}}\n\
         otlp: {{endpoint: 'http://{}', interval_s: 1, robot: marvin, attributes: {{site: hall 2}}}}\n",
        receiver.address
    );
    std::fs::write(&configuration, yaml).unwrap();
    let mut agent = LocalAgent::start(
        &mut rp(),
        &[
            "--config",
            configuration.to_str().unwrap(),
            "--speed",
            "max",
        ],
    );
    agent.wait_for_log("the capture has ended");
    let page = page_series(&agent.get("/metrics").body);
    assert!(page.len() > 200, "{}", page.len());

    let text = wait_for_page(&mut receiver, &page);
    assert_exported(&text, &page);

    let counter = |name: &str, outcome: &str| {
        format!("ros2probe_otlp_{name}{{signal=\"metrics\",{outcome}}}")
    };
    agent.wait_for_metric(
        &counter("exports_total", "outcome=\"delivered\""),
        |count| count > 2.0,
    );
    let resident = || metric(&agent.get("/metrics").body, "process_resident_memory_bytes").unwrap();
    let before = resident();
    let address = receiver.address;
    drop(receiver);
    let dropped = counter("dropped_total", "reason=\"superseded\"");
    agent.wait_for_metric(&dropped, |points| points > 3.0 * page.len() as f64 / 2.0);
    let mut receiver = Rotel::start(
        &mut Command::new(Rotel::binary()),
        directory.path(),
        Some(address),
    );
    receiver.wait_for("it gets all again", |text| exports_in(text) >= 1);
    let grown = resident() - before;
    assert!(grown < 4e6, "{grown} bytes more");
    assert_eq!(
        page_series(&agent.get("/metrics").body),
        page,
        "the capture noticed nothing"
    );

    drop(receiver);
    agent.signal("-TERM");
    let begun = Instant::now();
    assert!(agent.wait().success());
    assert!(
        begun.elapsed() < Duration::from_secs(30),
        "{:?}",
        begun.elapsed()
    );
}

/// Returns the number of complete exports.
fn exports_in(text: &str) -> usize {
    text.matches("-> Name: process.start_time").count()
}

/// Waits until the last complete export has the series of the page. Returns the text of the
/// receiver, which may print earlier exports late on a busy machine.
fn wait_for_page(receiver: &mut Rotel, page: &BTreeMap<String, f64>) -> String {
    let mut seen = exports_in(&receiver.text());
    let begun = Instant::now();
    loop {
        seen += 2;
        let text = receiver.wait_for("another export", |text| exports_in(text) >= seen);
        if is_exported(&text, page) || begun.elapsed() > Duration::from_secs(60) {
            return text;
        }
    }
}

/// Returns whether the last complete export has the series of the page.
fn is_exported(text: &str, page: &BTreeMap<String, f64>) -> bool {
    exported_series(&last_export(text)) == *page
}

/// Returns the requests of the last complete export.
fn last_export(text: &str) -> Vec<Export> {
    // Log records and spans have a trace ID, and are sent as they occur.
    let is_metric = |item: &Item| !item.fields.contains_key("Trace ID");
    let metrics = exports(text).into_iter();
    let metrics = metrics.filter(|export| export.items.iter().all(is_metric));
    let all: Vec<_> = metrics.collect();
    // The first request of an export has the counters.
    let first = |export: &Export| {
        let mut items = export.items.iter();
        items.any(|item| item.fields["Name"] == "process.cpu")
    };
    let ends: Vec<usize> = (0..all.len()).filter(|index| first(&all[*index])).collect();
    let [.., begin, end] = ends[..] else {
        panic!("{} exports", all.len())
    };
    all.into_iter().skip(begin).take(end - begin).collect()
}

/// Asserts that the last complete export has each series of the page, and the name of the robot.
fn assert_exported(text: &str, page: &BTreeMap<String, f64>) {
    let last = last_export(text);
    let exported = exported_series(&last);
    let (missing, more): (Vec<_>, Vec<_>) = (
        page.iter()
            .filter(|each| exported.get(each.0) != Some(each.1))
            .collect(),
        exported
            .iter()
            .filter(|each| page.get(each.0) != Some(each.1))
            .collect(),
    );
    assert!(
        missing.is_empty() && more.is_empty(),
        "page: {missing:#?}\nexported: {more:#?}"
    );
    let resource = &last[0].resource;
    for (key, value) in [
        ("service.name", "ros2probe"),
        ("service.version", env!("CARGO_PKG_VERSION")),
        ("robot.name", "marvin"),
        ("site", "hall 2"),
    ] {
        assert_eq!(
            resource.get(key).map(String::as_str),
            Some(value),
            "{resource:?}"
        );
    }
    assert!(resource.contains_key("service.instance.id") && resource.contains_key("host.name"));
}

#[test]
fn a_real_receiver_gets_the_series_of_the_page_over_http() {
    let directory = tempfile::tempdir().unwrap();
    let mut receiver = Rotel::start(&mut Command::new(Rotel::binary()), directory.path(), None);
    let configuration = directory.path().join("ros2probe.yaml");
    let yaml = format!(
        "watch: [{{topic: /**, per_subscriber: true}}, {{topic: /chatter, trace: 1}}]\n\
         metrics: {{per_writer: true}}\n\
         otlp: {{endpoint: 'http://{}', protocol: http/protobuf, compression: gzip, interval_s: 1, \
         robot: marvin, attributes: {{site: hall 2}}}}\n",
        receiver.http
    );
    std::fs::write(&configuration, yaml).unwrap();
    let configuration = configuration.to_str().unwrap();
    let mut agent = LocalAgent::start(&mut rp(), &["--config", configuration, "--speed", "max"]);
    agent.wait_for_log("the capture has ended");
    let page = page_series(&agent.get("/metrics").body);
    receiver.wait_for("events and spans", |text| {
        text.contains("EventName: ") && text.contains("Span ID")
    });
    let text = wait_for_page(&mut receiver, &page);
    assert_exported(&text, &page);
    agent.signal("-TERM");
    assert!(agent.wait().success());
}

#[test]
fn the_log_of_the_agent_is_exported_if_enabled_and_exports_add_no_lines_to_it() {
    let directory = tempfile::tempdir().unwrap();
    let mut receiver = Rotel::start(&mut Command::new(Rotel::binary()), directory.path(), None);
    let configuration = directory.path().join("ros2probe.yaml");
    let yaml = format!(
        "otlp: {{endpoint: 'http://{}', interval_s: 1, log: info, events: false}}\n",
        receiver.address
    );
    std::fs::write(&configuration, yaml).unwrap();
    let configuration = configuration.to_str().unwrap();
    let mut agent = LocalAgent::start(&mut rp(), &["--config", configuration, "--speed", "max"]);
    receiver.wait_for("the end of the capture is logged", |text| {
        text.contains("the capture has ended")
    });
    let delivered = |signal: &str| {
        format!("ros2probe_otlp_exports_total{{signal=\"{signal}\",outcome=\"delivered\"}}")
    };
    let requests = |signal: &str| metric(&agent.get("/metrics").body, &delivered(signal)).unwrap();
    let (lines, metrics) = (requests("log"), requests("metrics"));
    // The export thread logs the first success of each signal.
    agent.wait_for_metric(&delivered("metrics"), |count| count > metrics + 5.0);
    assert!(
        requests("log") <= lines + 1.0,
        "{} requests",
        requests("log")
    );
    assert!(!receiver.text().contains("exporting to the OTLP receiver"));
    agent.signal("-TERM");
    assert!(agent.wait().success());
}

#[test]
fn logs_of_nodes_are_exported_from_a_level_on_with_location_and_trace() {
    let directory = tempfile::tempdir().unwrap();
    let pcap = directory.path().join("robot.pcap");
    let messages = [20, 30, 40].map(|level| {
        let text = format!("message {level}");
        (level, "robot1.lidar".to_owned(), text)
    });
    let writer = robot_log::write_capture(&pcap, messages);
    let mut receiver = Rotel::start(&mut Command::new(Rotel::binary()), directory.path(), None);
    let configuration = directory.path().join("ros2probe.yaml");
    let yaml = format!(
        "watch: [{{topic: /rosout, trace: 1}}]\n\
         otlp: {{endpoint: 'http://{}', node_logs: warn, events: false}}\n",
        receiver.address
    );
    std::fs::write(&configuration, yaml).unwrap();
    let arguments = [
        "--config",
        configuration.to_str().unwrap(),
        "--speed",
        "max",
    ];
    let mut agent = LocalAgent::replay(&mut rp(), &pcap, &arguments);
    let text = receiver.wait_for("the last message", |text| text.contains("message 40"));
    let items: Vec<_> = exports(&text)
        .into_iter()
        .flat_map(|export| export.items)
        .collect();
    let logged: Vec<_> = items
        .iter()
        .filter(|item| item.attributes.contains_key("logger"))
        .collect();
    let levels: Vec<_> = logged
        .iter()
        .map(|item| &*item.fields["SeverityText"])
        .collect();
    assert_eq!(levels, ["WARN", "ERROR"], "{text}");
    for (item, number) in logged.iter().zip([2, 3]) {
        let trace = TraceMessage::identity(writer, SequenceNumber(number));
        assert_eq!(item.fields["Trace ID"], format!("{trace:032x}"), "{text}");
        assert!(item.attributes["code.line.number"].contains("81"), "{text}");
        assert!(
            item.attributes["ros_node"].contains("/robot1/lidar"),
            "{text}"
        );
    }
    agent.signal("-TERM");
    assert!(agent.wait().success());
}

/// A receiver that checks the headers of each request.
struct HeaderReceiver;

#[tonic::async_trait]
impl MetricsService for HeaderReceiver {
    async fn export(
        &self,
        request: tonic::Request<ExportMetricsServiceRequest>,
    ) -> Result<tonic::Response<ExportMetricsServiceResponse>, tonic::Status> {
        let header = |name| request.metadata().get(name).map(|value| value.to_str());
        for (name, value) in [("authorization", "Bearer file"), ("x-scope", "hall 2")] {
            if header(name).and_then(Result::ok) != Some(value) {
                return Err(tonic::Status::unauthenticated(name));
            }
        }
        Ok(tonic::Response::new(ExportMetricsServiceResponse::default()))
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn headers_of_the_file_take_precedence_over_those_of_the_environment() {
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap();
    let service = MetricsServiceServer::new(HeaderReceiver)
        .accept_compressed(tonic::codec::CompressionEncoding::Gzip);
    let server = tonic::transport::Server::builder().add_service(service);
    let incoming = tonic::transport::server::TcpIncoming::from(listener);
    tokio::spawn(server.serve_with_incoming(incoming));

    let directory = tempfile::tempdir().unwrap();
    let configuration = directory.path().join("ros2probe.yaml");
    let yaml = "otlp: {interval_s: 1, events: false, headers: {authorization: Bearer file}}\n";
    std::fs::write(&configuration, yaml).unwrap();
    let configuration = configuration.to_str().unwrap();
    let mut command = rp();
    command
        .env("OTEL_EXPORTER_OTLP_ENDPOINT", format!("http://{address}"))
        .env("OTEL_EXPORTER_OTLP_COMPRESSION", "gzip")
        .env(
            "OTEL_EXPORTER_OTLP_HEADERS",
            "x-scope=hall%202,authorization=other",
        );
    let agent = LocalAgent::start(&mut command, &["--config", configuration, "--speed", "max"]);
    let requests = |outcome: &str| {
        format!("ros2probe_otlp_exports_total{{signal=\"metrics\",outcome=\"{outcome}\"}}")
    };
    // Each export has three requests. The last request has the histograms.
    agent.wait_for_metric(&requests("delivered"), |count| count > 8.0);
    agent.wait_for_metric(&requests("failed"), |count| count < 0.5);
}

/// Name and attributes of an event.
type LoggedEvent = (String, BTreeMap<String, String>);

/// Returns the events of the agent's event log.
fn logged_events(agent: &LocalAgent) -> Vec<LoggedEvent> {
    let kept = "/events?after=0&follow=false";
    let body = local_agent::request(agent.api, "GET", kept, "").body;
    let data = body.lines().filter_map(|line| line.strip_prefix("data: "));
    let logged_events = data.map(|data| {
        let event: serde_json::Value = serde_json::from_str(data).unwrap();
        let attributes = event["attributes"].as_object().unwrap().iter();
        let plain = attributes.filter_map(|(key, value)| match value {
            serde_json::Value::String(text) => Some((key.clone(), text.clone())),
            serde_json::Value::Number(number) => Some((key.clone(), number.to_string())),
            _ => None,
        });
        (event["name"].as_str().unwrap().to_owned(), plain.collect())
    });
    logged_events.collect()
}

#[test]
fn a_late_receiver_gets_all_events_as_log_records_in_order() {
    let directory = tempfile::tempdir().unwrap();
    let address = free_address();
    let configuration = directory.path().join("ros2probe.yaml");
    let yaml = format!("otlp: {{endpoint: 'http://{address}', metrics: false, robot: marvin}}\n");
    std::fs::write(&configuration, yaml).unwrap();
    let configuration = configuration.to_str().unwrap();
    let mut agent = LocalAgent::start(&mut rp(), &["--config", configuration, "--speed", "max"]);
    agent.wait_for_log("the capture has ended");
    let retried = "ros2probe_otlp_exports_total{signal=\"events\",outcome=\"retried\"}";
    agent.wait_for_metric(retried, |count| count > 0.0);

    let logged_events = logged_events(&agent);
    assert!(logged_events.len() > 50, "{}", logged_events.len());
    let mut receiver = Rotel::start(
        &mut Command::new(Rotel::binary()),
        directory.path(),
        Some(address),
    );
    let text = receiver.wait_for("it has all events", |text| {
        text.matches("\nFlags: ").count() >= logged_events.len()
    });
    let exports = exports(&text);
    let received: Vec<LoggedEvent> = exports
        .iter()
        .flat_map(|export| &export.items)
        .map(|record| {
            assert_eq!(record.fields["SeverityText"], "INFO");
            let time = |field: &str| record.fields[field].parse::<u64>().unwrap();
            assert!(time("ObservedTimestamp") >= time("Timestamp"));
            (
                record.fields["EventName"].clone(),
                record.attributes.clone(),
            )
        })
        .collect();
    assert_eq!(received, logged_events);
    assert_eq!(exports[0].resource["robot.name"], "marvin");
    assert_eq!(exports[0].resource["service.name"], "ros2probe");

    // Later events follow, and the last events are sent before the agent ends.
    let added = local_agent::request(agent.api, "POST", "/watch/imu", "");
    assert_eq!(added.status, 201);
    receiver.wait_for("it has one more", |text| text.contains("watch: Str(/imu)"));
    let removed = local_agent::request(agent.api, "DELETE", "/watch/imu", "");
    assert_eq!(removed.status, 204);
    agent.signal("-TERM");
    assert!(agent.wait().success());
    receiver.wait_for("it has the last one", |text| {
        text.contains("EventName: ros2probe.watch.removed")
    });
    assert_eq!(
        receiver.text().matches("\nEventName: ").count(),
        logged_events.len() + 2
    );
}

/// Replays a capture with these watches, and waits until `is_whole` accepts the output of the
/// receiver. Returns the spans that the receiver printed, and the metrics page.
fn traced(
    directory: &Path,
    capture: &Path,
    watches: &str,
    is_whole: impl Fn(&str) -> bool,
) -> (Vec<Item>, String) {
    let mut receiver = Rotel::start(&mut Command::new(Rotel::binary()), directory, None);
    let configuration = directory.join("traced.yaml");
    let yaml = format!(
        "watch: [{watches}]\n\
         otlp: {{endpoint: 'http://{}', metrics: false, events: false}}\n",
        receiver.address
    );
    std::fs::write(&configuration, yaml).unwrap();
    let arguments = [
        "--config",
        configuration.to_str().unwrap(),
        "--speed",
        "max",
    ];
    let mut agent = LocalAgent::replay(&mut rp(), capture, &arguments);
    agent.wait_for_log("the capture has ended");
    let page = agent.request("GET", "/metrics", OPENMETRICS).body;
    agent.signal("-TERM");
    assert!(agent.wait().success());
    let text = receiver.wait_for("spans have come", is_whole);
    let exports = exports(&text);
    let services = exports
        .iter()
        .map(|export| export.resource["service.name"].as_str());
    assert!(services.into_iter().all(|name| name == "ros2probe"));
    let items = exports.into_iter().flat_map(|export| export.items);
    (items.collect(), page)
}

#[test]
fn each_replay_exports_the_same_traces_and_they_agree_with_the_capture() {
    let directory = tempfile::tempdir().unwrap();
    let watch = "{topic: /chatter, trace: 1}";
    let capture = local_agent::capture();
    let is_whole = |text: &str| text.contains("settle /chatter");
    let traced = || traced(directory.path(), &capture, watch, is_whole).0;
    let (spans, again) = (traced(), traced());
    let identity = |span: &Item| {
        let field = |name: &str| span.fields[name].clone();
        (
            field("Trace ID"),
            field("ID"),
            field("Parent ID"),
            field("Start time"),
            field("End time"),
        )
    };
    let identities = |spans: &[Item]| spans.iter().map(identity).collect::<Vec<_>>();
    assert_eq!(identities(&spans), identities(&again));

    let named = |name: &str| {
        let named = spans.iter().filter(|span| span.fields["Name"] == name);
        named.collect::<Vec<_>>()
    };
    let (sent, settled) = (named("send /chatter"), named("settle /chatter"));
    assert_eq!(sent.len(), 30, "the talker's messages");
    assert!(!settled.is_empty() && sent.len() + settled.len() == spans.len());
    for child in settled {
        let parent = sent
            .iter()
            .find(|span| span.fields["ID"] == child.fields["Parent ID"]);
        let parent = parent.unwrap_or_else(|| panic!("{child:#?} has no parent"));
        assert_eq!(parent.fields["Trace ID"], child.fields["Trace ID"]);
        assert_eq!(
            parent.attributes["messaging.message.id"],
            child.attributes["messaging.message.id"]
        );
        assert!(child.attributes.contains_key("reader"));
    }
    let attributes = &sent[0].attributes;
    for (key, value) in [
        ("messaging.system", "dds"),
        ("messaging.destination.name", "/chatter"),
        ("message_type", "std_msgs/msg/String"),
        ("domain_id", "0"),
    ] {
        assert_eq!(attributes[key], value, "{attributes:?}");
    }
    assert!(attributes.contains_key("source_timestamp_unix_nano"));
}

/// A header that accepts only OpenMetrics.
const OPENMETRICS: &str = "Accept: application/openmetrics-text\r\n";
/// Number of commands in the capture whose whole chain is in `GET /chains`.
const COMMANDS: usize = 259;

#[test]
fn a_chain_is_one_trace_with_the_spans_of_its_messages_and_nodes() {
    let directory = tempfile::tempdir().unwrap();
    let capture = repository("agent/testing/data/fastrtps-udp/chain-1ns/capture.pcap.gz");
    let watches = "{topic: /points, trace: 1}, {topic: /filtered}, {topic: /cmd}";
    // The last span is the publication of the last command. Its last attribute is the stamp.
    let is_whole = |text: &str| {
        let published: Vec<_> = text.split(" : publish /cmd\n").skip(1).collect();
        let last = published.last().copied().unwrap_or_default();
        published.len() >= COMMANDS && last.contains("-> stamp: Str(") && last.ends_with('\n')
    };
    let traced = || traced(directory.path(), &capture, watches, is_whole);
    let ((spans, page), (again, _)) = (traced(), traced());
    let is_of_chain = |span: &&Item| span.attributes.contains_key("method");
    let of_chains: Vec<_> = spans.iter().filter(is_of_chain).collect();
    let again: Vec<_> = again.iter().filter(is_of_chain).collect();
    let field = |span: &Item, name: &str| span.fields[name].clone();
    let identity = |span: &&Item| (field(span, "Trace ID"), field(span, "ID"));
    let identities = |spans: &[&Item]| spans.iter().map(identity).collect::<Vec<_>>();
    assert!(identities(&of_chains) == identities(&again), "ids differ");

    let mut traces: BTreeMap<String, BTreeMap<String, &Item>> = BTreeMap::new();
    for span in of_chains {
        let trace = traces.entry(field(span, "Trace ID")).or_default();
        assert!(trace.insert(field(span, "Name"), span).is_none());
    }
    let whole = traces
        .values()
        .filter(|trace| trace.contains_key("publish /cmd"));
    let whole: Vec<_> = whole.collect();
    assert_eq!(whole.len(), COMMANDS);
    let parents = [
        ("publish /points", None, "/sensor"),
        ("transit /points", Some("publish /points"), "/filter"),
        ("node /points", Some("publish /points"), "/filter"),
        ("publish /filtered", Some("node /points"), "/filter"),
        (
            "transit /filtered",
            Some("publish /filtered"),
            "/controller",
        ),
        ("node /filtered", Some("publish /filtered"), "/controller"),
        ("publish /cmd", Some("node /filtered"), "/controller"),
    ];
    for trace in whole {
        assert_eq!(trace.len(), parents.len(), "{trace:#?}");
        for (name, parent, node) in parents {
            let span = trace[name];
            let parent = parent.map_or_else(String::new, |parent| field(trace[parent], "ID"));
            assert_eq!(field(span, "Parent ID"), parent, "{name}");
            assert_eq!(span.attributes["ros_node"], node, "{name}");
            assert_eq!(span.attributes["method"], "stamps");
        }
        let time = |name: &str, end: &str| field(trace[name], end).parse::<u64>().unwrap();
        assert_eq!(
            time("transit /points", "End time"),
            time("node /points", "Start time")
        );
        let took = time("node /points", "End time") - time("node /points", "Start time");
        assert!(took > 12_000_000, "the filter sleeps 12 ms: {took}");
    }

    // Each exemplar is the id of one of these traces.
    for family in ["ros2_chain_latency", "ros2_chain_hop_latency"] {
        let bucket = format!("{family}_seconds_bucket{{");
        let lines = page.lines().filter(|line| line.starts_with(&bucket));
        let ids = lines.filter_map(|line| {
            let (_, exemplar) = line.split_once(" # {trace_id=\"")?;
            Some(exemplar.split_once("\"} ").unwrap().0)
        });
        let ids: Vec<_> = ids.collect();
        assert!(!ids.is_empty(), "{family}");
        assert!(ids.iter().all(|id| traces.contains_key(*id)), "{ids:?}");
    }

    // Messages have their own traces. A publication on the traced topic links to its message.
    let sent = spans
        .iter()
        .filter(|span| span.fields["Name"] == "send /points");
    let sent: BTreeMap<_, _> = sent.map(|span| (field(span, "Trace ID"), span)).collect();
    assert!(sent.len() > 250);
    assert!(sent.keys().all(|trace| !traces.contains_key(trace)));
    for trace in traces.values() {
        for (name, span) in trace {
            let [link] = &span.links[..] else {
                assert!(span.links.is_empty() && name != "publish /points");
                continue;
            };
            assert_eq!(name, "publish /points");
            let message = sent[&link["Trace ID"]];
            assert_eq!(link["ID"], message.fields["ID"]);
            let number = |span: &Item| span.attributes["sequence_number"].clone();
            assert_eq!(number(message), number(span));
        }
    }
}
