//! The listener: both formats, health, reload, and scrapes by a real Prometheus.

use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use crate::recordings::long_capture;
use crate::rp;
use ros2probe_testing::local_agent::{LocalAgent, metric, promtool, request};
use ros2probe_testing::ports::free_address;

/// Maximum wait for a value of Prometheus, which starts slowly on a busy machine.
const PATIENCE: Duration = Duration::from_secs(90);
const PROMETHEUS_ACCEPTS: &str = "Accept: application/openmetrics-text;version=1.0.0,\
    application/openmetrics-text;version=0.0.1;q=0.75,text/plain;version=0.0.4;q=0.5,*/*;q=0.1\r\n";

#[test]
fn the_program_has_one_mapping_for_each_segment_and_its_memory_is_reported() {
    let mut agent = LocalAgent::start(&mut rp(), &["--speed", "max"]);
    agent.wait_for_log("ready");
    let page = agent.get("/metrics").body;
    let pid = agent.id();
    let program = std::fs::read_link(format!("/proc/{pid}/exe")).unwrap();
    let maps = std::fs::read_to_string(format!("/proc/{pid}/maps")).unwrap();
    let of_program = maps
        .lines()
        .filter(|line| line.ends_with(program.to_str().unwrap()));
    // Each segment of the file has one mapping.
    let mappings = of_program.count();
    assert!((2..10).contains(&mappings), "{mappings}");
    let own = metric(&page, "process_unreclaimable_memory_bytes").unwrap();
    let resident = metric(&page, "process_resident_memory_bytes").unwrap();
    assert!((1e6..resident).contains(&own), "{own} of {resident}");
}

#[test]
fn each_path_of_the_listener_gets_the_expected_answer() {
    let mut agent = LocalAgent::start(&mut rp(), &["--speed", "max"]);
    agent.wait_for_log("ready");

    let classic = agent.get("/metrics");
    assert_eq!(classic.status, 200);
    assert!(
        classic
            .headers
            .contains("content-type: text/plain; version=0.0.4; charset=utf-8")
    );
    assert_eq!(promtool(&classic.body), "");

    let open = agent.request("GET", "/metrics", PROMETHEUS_ACCEPTS);
    assert!(
        open.headers
            .contains("content-type: application/openmetrics-text; version=1.0.0")
    );
    assert!(open.body.ends_with("# EOF\n"));

    let head = agent.request("HEAD", "/metrics", "");
    assert_eq!((head.status, head.body.as_str()), (200, ""));

    assert!(agent.get("/").body.contains("href=\"/metrics\""));
    for (path, status, body) in [
        ("/healthz", 200, "ok\n"),
        ("/readyz", 200, "ready\n"),
        ("/livez", 200, "alive\n"),
        ("/x", 404, "not found; see /\n"),
    ] {
        let answer = agent.get(path);
        assert_eq!(
            (answer.status, answer.body.as_str()),
            (status, body),
            "{path}"
        );
    }
    for path in ["/metrics", "/readyz", "/"] {
        assert_eq!(
            agent.request("POST", path, "Content-Length: 0\r\n").status,
            405,
            "{path}"
        );
    }
    let endless = format!("X: {}\r\n", "x".repeat(1 << 19));
    assert!(matches!(
        agent.request("GET", "/", &endless).status,
        400..500
    ));
    assert_eq!(agent.get("/healthz").status, 200);
}

#[test]
fn a_reload_applies_a_valid_configuration_and_keeps_the_old_one_otherwise() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("config.yaml");
    let write = |text: &str| std::fs::write(&path, text).unwrap();
    write("watch: [/a]\n");
    let mut agent = LocalAgent::start(&mut rp(), &["--config", path.to_str().unwrap()]);
    let successful = "ros2probe_config_last_reload_successful";
    let time = "ros2probe_config_last_reload_success_timestamp_seconds";
    let first = agent.wait_for_metric(time, |_| true);

    write("watch: [a]\nlogg: 1\n");
    agent.signal("-HUP");
    let line = agent.wait_for_log("the configuration was not reloaded");
    assert!(
        line.contains("config.yaml:1:9: watch[0]: must begin with a slash"),
        "{line}"
    );
    agent.wait_for_log("2:1: logg: unknown key");
    agent.wait_for_metric(successful, |value| value < 0.5);
    assert_eq!(metric(&agent.get("/metrics").body, time), Some(first));

    write("watch: [/a, /b]\nlimits: {topics: 7}\nlog: debug\n");
    agent.signal("-HUP");
    let line = agent.wait_for_log("takes effect after a restart");
    assert!(line.contains("limits"), "{line}");
    agent.wait_for_log("the configuration was reloaded");
    agent.wait_for_metric(successful, |value| value > 0.5);
    agent.wait_for_metric(time, |value| value > first);

    std::fs::remove_file(&path).unwrap();
    agent.signal("-HUP");
    let line = agent.wait_for_log("the configuration was not reloaded");
    assert!(line.contains("No such file"), "{line}");
    for (event, count) in [("reloaded", 1.0), ("reload_failed", 2.0)] {
        let series = format!("ros2probe_events_total{{name=\"ros2probe.config.{event}\"}}");
        agent.wait_for_metric(&series, |reported| reported == count);
    }
    let kept = "/events?after=0&follow=false&name=ros2probe.config.*";
    let reported = request(agent.api, "GET", kept, "").body;
    assert!(
        reported.contains("watch[0]: must begin with a slash"),
        "{reported}"
    );
    agent.signal("-TERM");
    assert!(agent.wait().success());
}

#[test]
fn series_of_deliveries_appear_after_a_reload_that_enables_them() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("config.yaml");
    std::fs::write(&path, "watch: [/chatter]\n").unwrap();
    // 10 Hz for 3 s, replayed at 0.3 times the speed.
    let mut agent = LocalAgent::start(
        &mut rp(),
        &["--config", path.to_str().unwrap(), "--speed", "0.3"],
    );
    let topic = "{domain_id=\"0\",topic=\"/chatter\"}";
    let delivered = format!("ros2_topic_delivered_messages_total{topic}");
    agent.wait_for_metric(&delivered, |count| count > 3.0);
    assert!(
        !agent
            .get("/metrics")
            .body
            .contains("ros2_subscriber_received_messages_total{")
    );

    std::fs::write(&path, "watch: [{topic: /chatter, per_subscriber: true}]\n").unwrap();
    agent.signal("-HUP");
    agent.wait_for_log("the configuration was reloaded");
    let page = agent.get("/metrics").body;
    let sum = metric(&page, &delivered).unwrap();
    let each = page.lines().filter_map(|line| {
        let labels = line.strip_prefix("ros2_subscriber_received_messages_total{")?;
        labels.rsplit_once(' ')?.1.parse::<f64>().ok()
    });
    assert_eq!(each.sum::<f64>(), sum, "{page}");
    assert_eq!(promtool(&page), "");
}

/// A Prometheus, which is killed when its value is dropped.
pub(crate) struct Prometheus {
    child: Child,
    address: std::net::SocketAddr,
}

impl Prometheus {
    pub(crate) fn start(directory: &Path, target: std::net::SocketAddr) -> Self {
        let address = free_address();
        let config = directory.join("prometheus.yml");
        let text = format!(
            "global: {{scrape_interval: 1s}}\n\
             scrape_configs: [{{job_name: robot, static_configs: [{{targets: ['{target}']}}]}}]\n"
        );
        std::fs::write(&config, text).unwrap();
        let child = Command::new("prometheus")
            .arg(format!("--config.file={}", config.display()))
            .arg(format!(
                "--storage.tsdb.path={}",
                directory.join("data").display()
            ))
            .arg(format!("--web.listen-address={address}"))
            .arg("--enable-feature=exemplar-storage")
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .unwrap_or_else(|error| panic!("prometheus: {error}; `apt-get install prometheus`"));
        Self { child, address }
    }

    /// Returns the answer of the API, or null before the server has started.
    pub(crate) fn get(&self, path: &str) -> serde_json::Value {
        if std::net::TcpStream::connect(self.address).is_err() {
            return serde_json::Value::Null;
        }
        let body = request(self.address, "GET", path, "").body;
        serde_json::from_str(&body).unwrap_or_default()
    }

    /// Repeats the query until the first sample of the answer has the wanted value.
    fn wait_for(&self, query: &str, wanted: impl Fn(f64) -> bool) -> f64 {
        let deadline = Instant::now() + PATIENCE;
        let encoded: String = query.bytes().map(|byte| format!("%{byte:02X}")).collect();
        let path = format!("/api/v1/query?query={encoded}");
        loop {
            let answer = self.get(&path);
            let value = answer
                .pointer("/data/result/0/value/1")
                .and_then(|value| value.as_str());
            match value.and_then(|value| value.parse().ok()) {
                Some(value) if wanted(value) => return value,
                _ if Instant::now() > deadline => panic!("{query}: {answer}"),
                _ => std::thread::sleep(Duration::from_millis(200)),
            }
        }
    }
}

impl Drop for Prometheus {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

#[test]
fn a_real_prometheus_computes_the_rate_of_a_replayed_publisher() {
    let arguments = ["--watch", "/chatter", "--speed", "1"];
    let capture = long_capture();
    let mut agent = LocalAgent::replay(&mut rp(), &capture, &arguments);
    agent.wait_for_log("ready");
    let directory = tempfile::tempdir().unwrap();
    let prometheus = Prometheus::start(directory.path(), agent.address);
    prometheus.wait_for("up{job=\"robot\"}", |up| up > 0.5);
    prometheus.wait_for("ros2probe_build_info", |value| value > 0.5);
    let rate = "rate(ros2_topic_messages_total{domain_id=\"0\",topic=\"/chatter\"}[4s])";
    prometheus.wait_for(rate, |rate| (9.0..=11.0).contains(&rate));
    prometheus.wait_for("count(count by (__name__) ({job=\"robot\"}))", |names| {
        names > 20.0
    });
}
