//! Tests of the exporter with a receiver that answers as each test requires.

use std::collections::VecDeque;
use std::net::SocketAddr;
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

use super::exports::{Exports, Outcome, Reason, Signal};
use super::{Exporter, Host, Settings};
use crate::agent_facts::{AgentFacts, SourceKind};
use crate::config::Config;
use crate::surface::MetricSources;
use ros2probe_model::snapshot::Snapshot;

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
fn exporting(address: SocketAddr, interval: u32, more: &str) -> (Arc<Exports>, Exporter) {
    let yaml = format!("otlp: {{endpoint: 'http://{address}', interval_s: {interval}, {more}}}");
    let config = Config::parse(yaml.as_bytes()).unwrap();
    let host = Host::default();
    let settings = Settings::resolve(&config.otlp, &|_| None, &host).unwrap();
    let sources = MetricSources::new(
        SourceKind::Replay,
        crate::settings_cell::Settings::default(),
    );
    let agent = AgentFacts {
        finished: true,
        ..AgentFacts::new(SourceKind::Replay, Instant::now())
    };
    sources.latest.publish(Snapshot::default(), agent);
    let exporter = Exporter::start(settings.unwrap(), &sources, Arc::default()).unwrap();
    (sources.exports, exporter)
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
async fn what_fails_in_passing_is_sent_again_and_what_is_refused_is_not() {
    let script = [
        Answer::Says(Code::Unavailable),
        Answer::Taken,
        Answer::Says(Code::InvalidArgument),
        Answer::Rejects(7),
    ];
    let (receiver, address) = Receiver::listening(script).await;
    // The pause before a retry is at most a second, so the next export must not overtake it.
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
async fn newer_points_take_the_place_of_those_a_slow_receiver_does_not_take() {
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
async fn a_receiver_that_comes_later_gets_the_latest_and_one_that_never_comes_delays_no_end() {
    // An address of its own: another test could get its port before it listens there.
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
        let (exports, exporter) = exporting(address, 1, "");
        tokio::time::sleep(Duration::from_millis(400)).await;
        let begun = Instant::now();
        exporter.finish().await;
        assert!(begun.elapsed() < Duration::from_millis(2_300));
        assert!(exports.dropped(Signal::Metrics, Reason::Shutdown) > 0);
        mute = None;
    }
    assert!(mute.is_none());
}
