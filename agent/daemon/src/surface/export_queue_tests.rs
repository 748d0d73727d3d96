//! Tests of events that wait on disk, with a receiver that comes late, refuses or fails.

use std::collections::VecDeque;
use std::net::SocketAddr;
use std::path::Path;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use opentelemetry_proto::tonic::collector::logs::v1::logs_service_server::{
    LogsService, LogsServiceServer,
};
use opentelemetry_proto::tonic::collector::logs::v1::{
    ExportLogsServiceRequest, ExportLogsServiceResponse,
};
use opentelemetry_proto::tonic::common::v1::any_value::Value;
use ros2probe_metrics::export_thread::ExportThread;
use ros2probe_metrics::otlp::{Exports, Outcome, Reason, Signal};
use tokio::net::TcpListener;
use tonic::transport::server::{Server, TcpIncoming};
use tonic::{Code, Status};

use crate::agent_facts::SourceKind;
use crate::events::{AgentEvent, EventLog};
use crate::surface::MetricSources;
use crate::surface::export_tests::start_with;

/// Header that each request must have, also the first one after a start.
const TOKEN: &str = "x-robot-token";

/// A receiver of logs, which gives these answers before it accepts requests.
#[derive(Clone, Default)]
struct Receiver {
    /// Failures; `None` accepts a request.
    answers: Arc<Mutex<VecDeque<Option<Status>>>>,
    /// Numbers in the events that it accepted.
    numbers: Arc<Mutex<Vec<i64>>>,
}

#[tonic::async_trait]
impl LogsService for Receiver {
    async fn export(
        &self,
        request: tonic::Request<ExportLogsServiceRequest>,
    ) -> Result<tonic::Response<ExportLogsServiceResponse>, Status> {
        let token = request.metadata().get(TOKEN);
        if token.is_none_or(|token| token != "secret") {
            return Err(Status::unauthenticated("no token"));
        }
        let numbers = numbers(request.get_ref());
        if !numbers.is_empty()
            && let Some(Some(failure)) = self.answers.lock().unwrap().pop_front()
        {
            return Err(failure);
        }
        self.numbers.lock().unwrap().extend(numbers);
        Ok(tonic::Response::new(ExportLogsServiceResponse::default()))
    }
}

impl Receiver {
    async fn serve(self, address: SocketAddr) {
        self.serve_up_to(usize::MAX, address).await;
    }

    /// Accepts requests up to a size in bytes.
    async fn serve_up_to(self, size: usize, address: SocketAddr) {
        let listener = TcpListener::bind(address).await.unwrap();
        let service = LogsServiceServer::new(self).max_decoding_message_size(size);
        let server = Server::builder().add_service(service);
        tokio::spawn(server.serve_with_incoming(TcpIncoming::from(listener)));
    }

    fn numbers(&self) -> Vec<i64> {
        self.numbers.lock().unwrap().clone()
    }
}

fn numbers(request: &ExportLogsServiceRequest) -> Vec<i64> {
    let scopes = request.resource_logs.iter().flat_map(|it| &it.scope_logs);
    let records = scopes.flat_map(|scope| &scope.log_records);
    let attributes = records.flat_map(|record| &record.attributes);
    let counts = attributes.filter(|attribute| attribute.key == "count");
    let values = counts.map(|count| count.value.as_ref().unwrap().value.as_ref().unwrap());
    let numbers = values.map(|value| match value {
        Value::IntValue(number) => *number,
        other => panic!("{other:?}"),
    });
    numbers.collect()
}

/// An agent's event log and its exporter.
struct Exporting {
    events: Arc<EventLog>,
    exports: Arc<Exports>,
    thread: ExportThread,
}

impl Exporting {
    fn start(address: SocketAddr, directory: &Path) -> Self {
        let yaml = format!(
            "otlp: {{endpoint: 'http://{address}', metrics: false, traces: false, \
             timeout_s: 1, headers: {{{TOKEN}: secret}}}}"
        );
        let sources = MetricSources::new(
            SourceKind::Replay,
            crate::settings_cell::Settings::default(),
        );
        let thread = start_with(&yaml, &sources, Some(directory));
        Self {
            events: sources.events,
            exports: sources.exports,
            thread,
        }
    }

    /// Records events with these numbers.
    fn record(&self, numbers: std::ops::RangeInclusive<u64>) {
        for count in numbers {
            let what = "packets";
            self.events.record(AgentEvent::Dropped { what, count });
        }
    }

    async fn until(&self, what: &str, holds: impl Fn(&Exports) -> bool) {
        let deadline = Instant::now() + Duration::from_secs(60);
        while !holds(&self.exports) {
            assert!(Instant::now() < deadline, "{what}");
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
    }

    fn dropped(&self) -> u64 {
        let reasons = Reason::ALL.into_iter();
        let dropped = reasons.map(|reason| self.exports.dropped(Signal::Events, reason));
        dropped.sum()
    }
}

/// Returns an address at which nothing listens. Each test has a host address of its own, so that no
/// other test takes the port.
async fn silent(host: &str) -> SocketAddr {
    let listener = TcpListener::bind((host, 0)).await.unwrap();
    listener.local_addr().unwrap()
}

fn bytes(exports: &Exports) -> u64 {
    exports.queue_bytes(Signal::Events)
}

#[tokio::test]
async fn events_of_an_outage_survive_ends_of_the_agent_and_arrive_once_in_order() {
    let directory = tempfile::tempdir().unwrap();
    let address = silent("127.17.41.1").await;
    let first = Exporting::start(address, directory.path());
    first.record(1..=10);
    first.until("a queue", |exports| bytes(exports) > 0).await;
    first.record(11..=20);
    first.thread.finish().await;

    let second = Exporting::start(address, directory.path());
    second.record(21..=30);
    second.thread.finish().await;

    let receiver = Receiver::default();
    let details = "when to try again".into();
    receiver.answers.lock().unwrap().extend([
        Some(Status::unavailable("so said the test")),
        Some(Status::with_details(
            Code::ResourceExhausted,
            "busy",
            details,
        )),
    ]);
    receiver.clone().serve(address).await;
    let third = Exporting::start(address, directory.path());
    assert!(bytes(&third.exports) > 0);
    third.record(31..=40);
    third
        .until("all events", |_| receiver.numbers().len() >= 40)
        .await;
    third.until("no queue", |exports| bytes(exports) == 0).await;
    third.record(41..=50);
    third
        .until("later events", |_| receiver.numbers().len() >= 50)
        .await;
    assert_eq!(receiver.numbers(), (1..=50).collect::<Vec<_>>());
    let third_dropped = third.dropped();
    assert_eq!(bytes(&third.exports), 0);
    third.thread.finish().await;
    assert_eq!(third_dropped, 0);
}

#[tokio::test]
async fn a_refused_request_leaves_the_queue_and_is_counted_and_later_ones_follow() {
    let directory = tempfile::tempdir().unwrap();
    let address = silent("127.17.41.2").await;
    let agent = Exporting::start(address, directory.path());
    agent.record(1..=10);
    agent.until("a queue", |exports| bytes(exports) > 0).await;
    let refused = agent.events.last();
    let receiver = Receiver::default();
    let refusal = Status::invalid_argument("so said the test");
    receiver.answers.lock().unwrap().push_back(Some(refusal));
    receiver.clone().serve(address).await;
    agent.until("no queue", |exports| bytes(exports) == 0).await;
    agent.record(11..=20);
    agent
        .until("later events", |_| receiver.numbers().len() >= 10)
        .await;
    assert_eq!(receiver.numbers(), (11..=20).collect::<Vec<_>>());
    let dropped = agent.exports.dropped(Signal::Events, Reason::Refused);
    assert_eq!((dropped, agent.dropped()), (refused, refused));
    assert_eq!(agent.exports.requests(Signal::Events, Outcome::Failed), 1);
    agent.thread.finish().await;
}

#[tokio::test]
async fn events_wait_in_memory_where_they_cannot_be_written() {
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("file");
    std::fs::write(&file, "").unwrap();
    let address = silent("127.17.41.3").await;
    let agent = Exporting::start(address, &file);
    agent.record(1..=10);
    agent
        .until("a second attempt", |exports| {
            exports.requests(Signal::Events, Outcome::Retried) > 1
        })
        .await;
    let receiver = Receiver::default();
    receiver.clone().serve(address).await;
    agent
        .until("all events", |_| receiver.numbers().len() >= 10)
        .await;
    assert_eq!(receiver.numbers(), (1..=10).collect::<Vec<_>>());
    assert_eq!((agent.dropped(), bytes(&agent.exports)), (0, 0));
    agent.thread.finish().await;
}

/// Size of a request with a few events, in bytes.
const SIZE: usize = 450;

#[tokio::test]
async fn parts_of_a_request_on_disk_are_delivered_once_also_across_a_restart() {
    let directory = tempfile::tempdir().unwrap();
    let address = silent("127.17.41.5").await;
    let first = Exporting::start(address, directory.path());
    first.record(1..=30);
    first.until("a queue", |exports| bytes(exports) > 0).await;
    let receiver = Receiver::default();
    // The link breaks after three parts.
    let broken = || Some(Status::unavailable("so said the test"));
    let answers = [None, None, None].into_iter();
    let answers = answers.chain((0..100).map(|_| broken()));
    receiver.answers.lock().unwrap().extend(answers);
    receiver.clone().serve_up_to(SIZE, address).await;
    first
        .until("a broken link", |_| {
            receiver.answers.lock().unwrap().len() < 100
        })
        .await;
    let parts = receiver.numbers().len();
    assert!((3..30).contains(&parts), "{parts}");
    first.thread.finish().await;

    receiver.answers.lock().unwrap().clear();
    let second = Exporting::start(address, directory.path());
    second.record(31..=40);
    second
        .until("all events", |_| receiver.numbers().len() >= 40)
        .await;
    second
        .until("no queue", |exports| bytes(exports) == 0)
        .await;
    assert_eq!(receiver.numbers(), (1..=40).collect::<Vec<_>>());
    assert_eq!(second.dropped(), 0);
    second.thread.finish().await;
}

#[tokio::test]
async fn an_event_that_fits_no_request_leaves_the_queue_and_is_counted_and_later_ones_follow() {
    let directory = tempfile::tempdir().unwrap();
    let address = silent("127.17.41.6").await;
    let agent = Exporting::start(address, directory.path());
    agent.record(1..=10);
    let (what, count) = ("x".repeat(SIZE).leak(), 11);
    agent.events.record(AgentEvent::Dropped { what, count });
    agent.record(12..=20);
    agent.until("a queue", |exports| bytes(exports) > 0).await;
    let receiver = Receiver::default();
    receiver.clone().serve_up_to(SIZE, address).await;
    agent.until("no queue", |exports| bytes(exports) == 0).await;
    let expected: Vec<_> = (1..=20).filter(|number| *number != 11).collect();
    assert_eq!(receiver.numbers(), expected);
    let too_large = agent.exports.dropped(Signal::Events, Reason::TooLarge);
    assert_eq!((too_large, agent.dropped()), (1, 1));
    agent.thread.finish().await;
}
