//! Exemplars of chains as two other programs read them: a real Prometheus from a scrape in
//! OpenMetrics, and an OTLP receiver. Both get the trace, the duration and its time.

use std::collections::{BTreeMap, BTreeSet};
use std::net::SocketAddr;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use crate::http::Prometheus;
use crate::rp;
use opentelemetry_proto::tonic::collector::metrics::v1::metrics_service_server::{
    MetricsService, MetricsServiceServer,
};
use opentelemetry_proto::tonic::collector::metrics::v1::{
    ExportMetricsServiceRequest, ExportMetricsServiceResponse,
};
use opentelemetry_proto::tonic::metrics::v1::exemplar::Value;
use opentelemetry_proto::tonic::metrics::v1::{HistogramDataPoint, metric::Data};
use ros2probe_testing::local_agent::{LocalAgent, PATIENCE};
use ros2probe_testing::repository;
use tokio::net::TcpListener;
use tonic::transport::server::{Server, TcpIncoming};

const FAMILIES: [&str; 2] = ["ros2_chain_latency", "ros2_chain_hop_latency"];

/// Trace, duration in seconds as text, and time in Unix milliseconds, as Prometheus stores it.
type Exemplar = (String, String, u64);
/// The newest exemplars of each family.
type Exemplars = BTreeMap<String, BTreeSet<Exemplar>>;

/// A receiver that keeps the exemplars of the last request with histograms of chains.
#[derive(Clone, Default)]
struct Receiver(Arc<Mutex<Exemplars>>);

#[tonic::async_trait]
impl MetricsService for Receiver {
    async fn export(
        &self,
        request: tonic::Request<ExportMetricsServiceRequest>,
    ) -> Result<tonic::Response<ExportMetricsServiceResponse>, tonic::Status> {
        let resources = request.into_inner().resource_metrics.into_iter();
        let scopes = resources.flat_map(|resource| resource.scope_metrics);
        for family in scopes.flat_map(|scope| scope.metrics) {
            if let Some(Data::Histogram(histogram)) = &family.data {
                let exemplars = histogram.data_points.iter().flat_map(exported).collect();
                let name = family.name.replace('.', "_");
                self.0.lock().unwrap().insert(name, exemplars);
            }
        }
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
}

fn exported(point: &HistogramDataPoint) -> impl Iterator<Item = Exemplar> {
    point.exemplars.iter().map(|exemplar| {
        let trace_id = exemplar.trace_id.iter().map(|byte| format!("{byte:02x}"));
        let Some(Value::AsDouble(seconds)) = exemplar.value else {
            panic!("{exemplar:?}")
        };
        let at = exemplar.time_unix_nano / 1_000_000;
        (trace_id.collect(), seconds.to_string(), at)
    })
}

/// Returns the exemplars that Prometheus has stored for a family.
fn stored(prometheus: &Prometheus, family: &str) -> BTreeSet<Exemplar> {
    let query = format!("query={family}_seconds_bucket&start=0&end=9999999999");
    let answer = prometheus.get(&format!("/api/v1/query_exemplars?{query}"));
    let series = answer.pointer("/data").and_then(|data| data.as_array());
    let series = series.into_iter().flatten();
    let exemplars = series.flat_map(|series| series["exemplars"].as_array().unwrap().clone());
    let exemplars = exemplars.map(|exemplar| {
        let text = |value: &serde_json::Value| value.as_str().unwrap().to_owned();
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "milliseconds of the calendar"
        )]
        let at = (exemplar["timestamp"].as_f64().unwrap() * 1e3).round() as u64;
        let trace_id = text(&exemplar["labels"]["trace_id"]);
        (trace_id, text(&exemplar["value"]), at)
    });
    exemplars.collect()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn prometheus_and_an_otlp_receiver_get_the_same_exemplars_of_a_chain() {
    let receiver = Receiver::default();
    let address = receiver.clone().listen().await;
    let directory = tempfile::tempdir().unwrap();
    let configuration = directory.path().join("ros2probe.yaml");
    let yaml = format!(
        "watch: [{{topic: /points, trace: 1}}, /filtered, /cmd]\n\
         otlp: {{endpoint: 'http://{address}', interval_s: 1, events: false}}\n"
    );
    std::fs::write(&configuration, yaml).unwrap();
    let arguments = [
        "--config",
        configuration.to_str().unwrap(),
        "--speed",
        "max",
    ];
    let capture = repository("agent/testing/data/fastrtps-udp/chain-1ns/capture.pcap.gz");
    let mut agent = LocalAgent::replay(&mut rp(), &capture, &arguments);
    agent.wait_for_log("the capture has ended");
    // The exemplars do not change after this point.
    let prometheus = Prometheus::start(directory.path(), agent.address);
    for family in FAMILIES {
        let deadline = Instant::now() + PATIENCE;
        let both = loop {
            let exported = receiver.0.lock().unwrap().get(family).cloned();
            let both = (stored(&prometheus, family), exported.unwrap_or_default());
            if !both.0.is_empty() && both.0 == both.1 {
                break both.0;
            }
            assert!(Instant::now() < deadline, "{family}: {both:#?}");
            std::thread::sleep(Duration::from_millis(200));
        };
        let is_plausible = |(trace_id, seconds, at): &Exemplar| {
            let seconds: f64 = seconds.parse().unwrap();
            trace_id.len() == 32 && seconds > 1e-6 && seconds < 1.0 && *at > 1_700_000_000_000
        };
        assert!(both.iter().all(is_plausible), "{family}: {both:#?}");
    }
}
