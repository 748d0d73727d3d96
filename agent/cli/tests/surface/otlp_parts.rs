//! Requests of OTLP that are too large for a receiver or for a slow link arrive in parts. Those with
//! an expired token arrive after its replacement. A replay has no queue on disk.

use std::collections::VecDeque;
use std::convert::Infallible;
use std::net::SocketAddr;
use std::path::Path;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use http_body_util::{BodyExt as _, Full};
use hyper::body::{Bytes, Incoming};
use hyper::service::service_fn;
use hyper_util::rt::{TokioExecutor, TokioIo};
use opentelemetry_proto::tonic::collector::logs::v1::logs_service_server::{
    LogsService, LogsServiceServer,
};
use opentelemetry_proto::tonic::collector::logs::v1::{
    ExportLogsServiceRequest, ExportLogsServiceResponse,
};
use opentelemetry_proto::tonic::common::v1::any_value::Value;
use prost::Message as _;
use ros2probe_testing::local_agent::LocalAgent;
use ros2probe_testing::robot_log;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::{TcpListener, TcpStream};
use tonic::codegen::Service as _;

use crate::rp;

const PATIENCE: Duration = Duration::from_secs(150);
/// Number of messages to a receiver with a limit of size.
const MESSAGES: usize = 20;
/// Number of messages over a slow link.
const SLOW_MESSAGES: usize = 8;
/// Number of the message that is longer than all others.
const LONG: usize = 5;
/// Size of a request between that of a short and that of the long message, in bytes.
const LIMIT: usize = 900;

/// Texts of the records that arrived, in their order.
#[derive(Clone, Debug, Default)]
struct Received(Arc<Mutex<Vec<String>>>);

impl Received {
    fn take(&self, request: ExportLogsServiceRequest) {
        let scopes = request
            .resource_logs
            .into_iter()
            .flat_map(|group| group.scope_logs);
        let records = scopes.flat_map(|scope| scope.log_records);
        let bodies = records.filter_map(|record| record.body?.value);
        let texts = bodies.filter_map(|body| match body {
            Value::StringValue(text) => Some(text),
            _ => None,
        });
        self.0.lock().unwrap().extend(texts);
    }

    /// Returns the numbers of the messages that arrived.
    fn numbers(&self) -> Vec<usize> {
        let texts = self.0.lock().unwrap();
        let numbers = texts
            .iter()
            .map(|text| text.split(' ').nth(1).unwrap().parse().unwrap());
        numbers.collect()
    }

    /// Waits until the last of `count` messages has arrived.
    fn wait(&self, count: usize) {
        let begun = Instant::now();
        while self.numbers().last() != Some(&(count - 1)) {
            assert!(begun.elapsed() < PATIENCE, "{:?}", self.numbers());
            std::thread::sleep(Duration::from_millis(50));
        }
    }
}

#[tonic::async_trait]
impl LogsService for Received {
    async fn export(
        &self,
        request: tonic::Request<ExportLogsServiceRequest>,
    ) -> Result<tonic::Response<ExportLogsServiceResponse>, tonic::Status> {
        self.take(request.into_inner());
        Ok(tonic::Response::new(ExportLogsServiceResponse::default()))
    }
}

/// Starts a receiver over gRPC that accepts messages up to a size.
async fn grpc(limit: usize) -> (SocketAddr, Received) {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap();
    let received = Received::default();
    let service = LogsServiceServer::new(received.clone()).max_decoding_message_size(limit);
    let server = tonic::transport::Server::builder().add_service(service);
    let incoming = tonic::transport::server::TcpIncoming::from(listener);
    tokio::spawn(server.serve_with_incoming(incoming));
    (address, received)
}

/// Starts a receiver over gRPC behind a proxy, which answers longer bodies with 413 of HTTP.
async fn grpc_behind_a_proxy(limit: usize) -> (SocketAddr, Received) {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap();
    let received = Received::default();
    let service = LogsServiceServer::new(received.clone());
    tokio::spawn(async move {
        loop {
            let (stream, _) = listener.accept().await.unwrap();
            let service = service.clone();
            let answer = service_fn(move |request: hyper::Request<Incoming>| {
                let mut service = service.clone();
                async move {
                    let (head, body) = request.into_parts();
                    let mut refused = hyper::Response::new(tonic::body::Body::empty());
                    *refused.status_mut() = hyper::StatusCode::PAYLOAD_TOO_LARGE;
                    // The agent ended the request.
                    let Ok(body) = body.collect().await else {
                        return Ok(refused);
                    };
                    let body = body.to_bytes();
                    if body.len() > limit {
                        return Ok(refused);
                    }
                    let body = tonic::body::Body::new(Full::new(body));
                    service.call(hyper::Request::from_parts(head, body)).await
                }
            });
            let server = hyper::server::conn::http2::Builder::new(TokioExecutor::new());
            tokio::spawn(server.serve_connection(TokioIo::new(stream), answer));
        }
    });
    (address, received)
}

/// Starts a receiver over HTTP that accepts bodies up to a size.
async fn http(limit: usize) -> (SocketAddr, Received) {
    serve_http(move |request, received| async move { http_answer(request, limit, &received).await })
        .await
}

/// Starts a receiver over HTTP with these answers.
async fn serve_http<F>(
    answer: impl Fn(hyper::Request<Incoming>, Received) -> F + Clone + Send + 'static,
) -> (SocketAddr, Received)
where
    F: Future<Output = hyper::Response<Full<Bytes>>> + Send + 'static,
{
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap();
    let received = Received::default();
    let taken = received.clone();
    tokio::spawn(async move {
        loop {
            let (stream, _) = listener.accept().await.unwrap();
            let (answer, received) = (answer.clone(), taken.clone());
            let service = service_fn(move |request: hyper::Request<Incoming>| {
                let answered = answer(request, received.clone());
                async move { Ok::<_, Infallible>(answered.await) }
            });
            let server = hyper::server::conn::http1::Builder::new();
            tokio::spawn(server.serve_connection(TokioIo::new(stream), service));
        }
    });
    (address, received)
}

async fn http_answer(
    request: hyper::Request<Incoming>,
    limit: usize,
    received: &Received,
) -> hyper::Response<Full<Bytes>> {
    // The agent closed the connection.
    let Ok(body) = request.into_body().collect().await else {
        return hyper::Response::default();
    };
    let body = body.to_bytes();
    if body.len() > limit {
        let mut refused = hyper::Response::default();
        *refused.status_mut() = hyper::StatusCode::PAYLOAD_TOO_LARGE;
        return refused;
    }
    received.take(ExportLogsServiceRequest::decode(body).unwrap());
    let answer = ExportLogsServiceResponse::default().encode_to_vec();
    hyper::Response::new(Full::new(answer.into()))
}

/// Starts a relay to `target` that passes on this many bytes a second of each connection.
async fn slow(target: SocketAddr, bytes_per_s: usize) -> SocketAddr {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap();
    tokio::spawn(async move {
        loop {
            let (stream, _) = listener.accept().await.unwrap();
            tokio::spawn(relay(stream, target, bytes_per_s));
        }
    });
    address
}

/// Relays a connection until one of its ends closes it. That loses the bytes that wait.
async fn relay(near: TcpStream, target: SocketAddr, bytes_per_s: usize) {
    const TICKS_PER_S: usize = 20;
    let far = TcpStream::connect(target).await.unwrap();
    let ((mut requests, mut answers), (mut from_far, mut to_far)) =
        (near.into_split(), far.into_split());
    let waiting = Mutex::new(VecDeque::new());
    let come = async {
        let mut bytes = [0; 4096];
        while let Ok(length @ 1..) = requests.read(&mut bytes).await {
            waiting.lock().unwrap().extend(&bytes[..length]);
        }
    };
    let go = async {
        let mut tick = tokio::time::interval(Duration::from_secs(1) / TICKS_PER_S as u32);
        loop {
            tick.tick().await;
            let next: Vec<u8> = {
                let mut waiting = waiting.lock().unwrap();
                let length = waiting.len().min(bytes_per_s / TICKS_PER_S);
                waiting.drain(..length).collect()
            };
            if to_far.write_all(&next).await.is_err() {
                return;
            }
        }
    };
    tokio::select! {
        () = come => {}
        () = go => {}
        _ = tokio::io::copy(&mut from_far, &mut answers) => {}
    }
}

/// Writes a capture with this number of log messages of a node. One has a long text.
fn capture(path: &Path, count: usize) {
    let messages = (0..count).map(|number| {
        // Names and texts of logs are kept up to 128 and 512 bytes.
        let (name, length) = if number == LONG { (110, 490) } else { (5, 0) };
        let text = format!("message {number} {}", "x".repeat(length));
        (40, format!("robot1.{}", "l".repeat(name)), text)
    });
    robot_log::write_capture(path, messages);
}

fn agent(directory: &Path, address: SocketAddr, options: &str, capture: &Path) -> LocalAgent {
    let configuration = directory.join("ros2probe.yaml");
    let yaml = format!(
        "watch: [/rosout]\n\
         otlp: {{endpoint: 'http://{address}', node_logs: info, metrics: false, events: false, \
         traces: false, {options}}}\n"
    );
    std::fs::write(&configuration, yaml).unwrap();
    let configuration = configuration.to_str().unwrap();
    LocalAgent::replay(
        &mut rp(),
        capture,
        &["--config", configuration, "--speed", "max"],
    )
}

fn dropped(reason: &str) -> String {
    format!("ros2probe_otlp_dropped_total{{signal=\"node_logs\",reason=\"{reason}\"}}")
}

/// Returns the numbers without those that came before. A request whose answer is late may arrive
/// twice.
fn without_repeated(numbers: Vec<usize>) -> Vec<usize> {
    let mut first = Vec::new();
    for number in numbers {
        if !first.contains(&number) {
            first.push(number);
        }
    }
    first
}

/// Asserts that all messages arrive in order, without the one that is too large for any request.
/// Returns their numbers.
fn all_but_the_long_one_arrive(
    address: SocketAddr,
    options: &str,
    received: &Received,
    messages: usize,
) -> Vec<usize> {
    let directory = tempfile::tempdir().unwrap();
    let pcap = directory.path().join("robot.pcap");
    capture(&pcap, messages);
    let mut agent = agent(directory.path(), address, options, &pcap);
    received.wait(messages);
    agent.wait_for_metric(&dropped("too_large"), |count| (count - 1.0).abs() < 0.5);
    let expected: Vec<_> = (0..messages).filter(|number| *number != LONG).collect();
    assert_eq!(without_repeated(received.numbers()), expected);
    for reason in ["refused", "overflow"] {
        agent.wait_for_metric(&dropped(reason), |count| count < 0.5);
    }
    agent.signal("-TERM");
    assert!(agent.wait().success());
    let lines = "an item is too large for the OTLP receiver or the link";
    assert_eq!(agent.log().matches(lines).count(), 1, "{}", agent.log());
    received.numbers()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_receiver_with_a_limit_of_size_gets_all_that_fits_over_grpc() {
    let (address, received) = grpc(LIMIT).await;
    let numbers = all_but_the_long_one_arrive(address, "", &received, MESSAGES);
    assert_eq!(numbers.len(), MESSAGES - 1, "{numbers:?}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_proxy_with_a_limit_of_size_passes_all_that_fits_over_grpc() {
    let (address, received) = grpc_behind_a_proxy(LIMIT).await;
    let numbers = all_but_the_long_one_arrive(address, "", &received, MESSAGES);
    assert_eq!(numbers.len(), MESSAGES - 1, "{numbers:?}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_receiver_with_a_limit_of_size_gets_all_that_fits_over_http() {
    let (address, received) = http(LIMIT).await;
    let options = "protocol: http/protobuf";
    let numbers = all_but_the_long_one_arrive(address, options, &received, MESSAGES);
    assert_eq!(numbers.len(), MESSAGES - 1, "{numbers:?}");
}

/// A short message needs about 2.8 s, and the long one 5.2 s.
#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_slow_link_carries_all_that_fits_its_timeout() {
    let (receiver, received) = http(usize::MAX).await;
    let options = "protocol: http/protobuf, timeout_s: 4";
    let address = slow(receiver, 300).await;
    all_but_the_long_one_arrive(address, options, &received, SLOW_MESSAGES);
}

/// Over gRPC, a request that timed out may arrive later: the end of its stream waits behind it.
#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_slow_link_loses_nothing_over_grpc() {
    const MANY: usize = 200;
    let (receiver, received) = grpc(usize::MAX).await;
    let directory = tempfile::tempdir().unwrap();
    let pcap = directory.path().join("robot.pcap");
    capture(&pcap, MANY);
    let address = slow(receiver, 6_000).await;
    let agent = agent(directory.path(), address, "timeout_s: 1", &pcap);
    received.wait(MANY);
    let expected: Vec<_> = (0..MANY).collect();
    assert_eq!(without_repeated(received.numbers()), expected);
    for reason in ["too_large", "refused", "overflow"] {
        agent.wait_for_metric(&dropped(reason), |count| count < 0.5);
    }
}

/// A receiver that accepts only requests with this value of `authorization`.
#[derive(Clone)]
struct Guarded(Received);

const ACCEPTED: &str = "Bearer second";

#[tonic::async_trait]
impl LogsService for Guarded {
    async fn export(
        &self,
        request: tonic::Request<ExportLogsServiceRequest>,
    ) -> Result<tonic::Response<ExportLogsServiceResponse>, tonic::Status> {
        let token = request.metadata().get("authorization");
        if token.and_then(|token| token.to_str().ok()) != Some(ACCEPTED) {
            return Err(tonic::Status::unauthenticated("unknown token"));
        }
        self.0.export(request).await
    }
}

async fn guarded_grpc() -> (SocketAddr, Received) {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap();
    let received = Received::default();
    let service = LogsServiceServer::new(Guarded(received.clone()));
    let server = tonic::transport::Server::builder().add_service(service);
    let incoming = tonic::transport::server::TcpIncoming::from(listener);
    tokio::spawn(server.serve_with_incoming(incoming));
    (address, received)
}

/// Starts a receiver over HTTP. It answers requests with another token with this status.
async fn guarded_http(status: u16) -> (SocketAddr, Received) {
    serve_http(move |request, received| async move {
        let token = request.headers().get("authorization");
        if token.is_some_and(|token| token.as_bytes() == ACCEPTED.as_bytes()) {
            return http_answer(request, usize::MAX, &received).await;
        }
        let mut refused = hyper::Response::default();
        *refused.status_mut() = hyper::StatusCode::from_u16(status).unwrap();
        refused
    })
    .await
}

/// Earlier, the agent read the token only at its start, and a refusal of it cost the items.
fn all_arrive_after_a_replacement(address: SocketAddr, options: &str, received: &Received) {
    let directory = tempfile::tempdir().unwrap();
    let pcap = directory.path().join("robot.pcap");
    capture(&pcap, MESSAGES);
    let file = directory.path().join("headers");
    std::fs::write(&file, "authorization: Bearer first\n").unwrap();
    let options = format!("{options}headers_file: {}", file.display());
    let mut agent = agent(directory.path(), address, &options, &pcap);
    agent.wait_for_log("the OTLP receiver refuses the export");
    std::fs::write(&file, "no header\n").unwrap();
    agent.wait_for_log("a replaced file of OTLP headers cannot be used");
    assert_eq!(received.numbers().len(), 0);
    std::fs::write(&file, format!("authorization: {ACCEPTED}\n")).unwrap();
    received.wait(MESSAGES);
    let expected: Vec<_> = (0..MESSAGES).collect();
    assert_eq!(without_repeated(received.numbers()), expected);
    for reason in ["too_large", "refused", "overflow"] {
        agent.wait_for_metric(&dropped(reason), |count| count < 0.5);
    }
    let log = agent.log();
    assert_eq!(log.matches("cannot be used").count(), 1, "{log}");
    assert!(!log.contains("Bearer"), "{log}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn an_expired_token_loses_nothing_and_its_successor_needs_no_restart_over_grpc() {
    let (address, received) = guarded_grpc().await;
    all_arrive_after_a_replacement(address, "", &received);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn an_expired_token_loses_nothing_and_its_successor_needs_no_restart_over_http() {
    let (address, received) = guarded_http(401).await;
    all_arrive_after_a_replacement(address, "protocol: http/protobuf, ", &received);
}

/// The portal of a network redirects requests, and a receiver that fails answers 500.
#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_redirection_and_a_failure_of_the_receiver_lose_nothing() {
    for status in [302, 500] {
        let (address, received) = guarded_http(status).await;
        all_arrive_after_a_replacement(address, "protocol: http/protobuf, ", &received);
    }
}
