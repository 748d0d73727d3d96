//! Time and size of the answers that the page requests again and again, about a large robot, in the
//! present and in the past.
#![expect(clippy::unwrap_used, reason = "a benchmark may panic")]

use std::path::Path;
use std::time::{Duration, Instant, SystemTime};

use criterion::{Criterion, criterion_group, criterion_main};
use ros2probe_api::doctor::{Report, Severity};
use ros2probe_capture::reassembly::Limits;
use ros2probe_daemon::agent::{Components, Expansion, Speed};
use ros2probe_daemon::agent_facts::{AgentFacts, SourceKind};
use ros2probe_daemon::config::Config;
use ros2probe_daemon::run::replay::Replay;
use ros2probe_daemon::settings_cell::Settings;
use ros2probe_daemon::surface::MetricSources;
use ros2probe_daemon::surface::api::{Context, Doctor, HistoryWriter, serve_in_process};
use ros2probe_model::facts::topic_kind::TopicKind;
use ros2probe_model::report::snapshot::{NodeFacts, Snapshot, TopicFacts};
use ros2probe_testing::{repository, sample_robot};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _, DuplexStream, duplex};
use tokio::runtime::{Builder, Runtime};
use tokio::sync::mpsc::{UnboundedSender, unbounded_channel};

const TOPICS: usize = 600;
const NODES: usize = 200;
/// Services of each node.
const SERVICES: [&str; 6] = [
    "describe_parameters",
    "get_parameter_types",
    "get_parameters",
    "list_parameters",
    "set_parameters",
    "set_parameters_atomically",
];
/// Number of messages of logs that the agent keeps.
const LOGS: usize = 1000;
/// Bytes that a pipe holds.
const PIPE_BYTES: usize = 1 << 16;
/// Pause after a request: the agent refuses more than 500 a second.
const PAUSE: Duration = Duration::from_millis(3);
/// Requests that views repeat every 2 s or 5 s, and `/topics` for comparison.
const PRESENT: [&str; 15] = [
    "/topics/robot/sensor_0300",
    "/nodes/robot/node_100",
    "/services",
    "/services?hidden=true",
    "/actions",
    "/logs?limit=1000",
    "/diagnostics",
    "/transforms",
    "/parameters",
    "/clocks",
    "/chains",
    "/health",
    "/participants",
    "/graph",
    "/topics",
];

/// An agent that serves its API in this process.
struct Agent {
    runtime: Runtime,
    pipes: UnboundedSender<DuplexStream>,
}

impl Agent {
    fn serve(context: Context) -> Self {
        let runtime = Builder::new_multi_thread()
            .worker_threads(1)
            .enable_all()
            .build()
            .unwrap();
        let (pipes, opened) = unbounded_channel();
        runtime.spawn(serve_in_process(opened, context));
        Self { runtime, pipes }
    }

    /// Returns the length of an answer, with its head.
    fn ask(&self, path: &str) -> usize {
        let (mut client, server) = duplex(PIPE_BYTES);
        self.pipes.send(server).unwrap();
        let request = format!("GET {path} HTTP/1.1\r\nhost: rp\r\nconnection: close\r\n\r\n");
        let mut answer = Vec::new();
        self.runtime.block_on(async {
            client.write_all(request.as_bytes()).await.unwrap();
            client.read_to_end(&mut answer).await.unwrap();
        });
        assert!(answer.starts_with(b"HTTP/1.1 200 "), "{path}");
        answer.len()
    }

    /// Returns the time that an answer takes.
    fn time(&self, path: &str) -> Duration {
        let begin = Instant::now();
        self.ask(path);
        let time = begin.elapsed();
        std::thread::sleep(PAUSE);
        time
    }
}

/// Adds nodes with the services of their parameters, and as many logs as the agent keeps.
fn add_nodes(snapshot: &mut Snapshot) {
    let node = snapshot.nodes.first().cloned().unwrap();
    snapshot.nodes.extend((0..NODES).map(|number| NodeFacts {
        name: format!("/robot/node_{number:03}").into(),
        ..node.clone()
    }));
    for number in 0..NODES {
        for service in SERVICES {
            let name = format!("/robot/node_{number:03}/{service}");
            for (kind, dds_name) in [
                (TopicKind::ServiceRequest, format!("rq{name}Request")),
                (TopicKind::ServiceReply, format!("rr{name}Reply")),
            ] {
                snapshot.topics.push(TopicFacts {
                    kind,
                    dds_name: dds_name.into(),
                    message_types: vec!["rcl_interfaces/srv/GetParameters".into()],
                    measurement: None,
                    received: None,
                    sent: None,
                    breakdown: None,
                    deliveries: Vec::new(),
                    acknowledgements: Vec::new(),
                    inside: None,
                    ..sample_robot::topic(&name)
                });
            }
        }
    }
    let key = |topic: &TopicFacts| (topic.domain_id, topic.dds_name.to_string());
    snapshot.topics.sort_by_key(key);
    let message = snapshot.logs.latest.first().cloned().unwrap();
    snapshot.logs.latest = vec![message; LOGS];
}

/// Returns the context of an agent that knows a large robot and keeps a history.
fn context(state_directory: &Path) -> Context {
    let config = Config::default();
    let capture = repository("wire/tests/data/cyclonedds-samehost-any.pcap.gz");
    let replay = Replay::open(&capture, Expansion::Limited, Speed::Max, Limits::default());
    let sources = MetricSources::new(SourceKind::Wire, Settings::new(&config));
    sources.disk_history.keep_in(state_directory, 256 << 20);
    let names = (0..TOPICS).map(|index| format!("/robot/sensor_{index:04}"));
    let names: Vec<String> = names.collect();
    let mut snapshot = sample_robot::snapshot(names.iter().map(String::as_str));
    add_nodes(&mut snapshot);
    let agent = AgentFacts {
        // No capture runs that would publish a newer state.
        finished: true,
        ..sample_robot::agent()
    };
    sources.latest.publish(snapshot, agent);
    let watches = sources.watches(Vec::new(), Vec::new()).unwrap();
    let doctor = Doctor::new(|_| Report {
        version: "".into(),
        subject: String::new(),
        severity: Severity::Ok,
        findings: Vec::new(),
    });
    let components = Components::of_replay(&config, replay.unwrap(), sources, watches, doctor);
    components.assemble().unwrap().context
}

fn answers(criterion: &mut Criterion) {
    let directory = tempfile::tempdir().unwrap();
    let context = context(directory.path());
    let history = HistoryWriter::start(context.clone()).unwrap();
    history.unwrap().finish();
    let now = SystemTime::UNIX_EPOCH.elapsed().unwrap().as_secs() + 1;
    let past = [
        format!("/history/moment?at={now}"),
        format!("/history/moment/topics?at={now}"),
        format!("/history/moment/topics?at={now}&name=/robot/sensor_0300"),
    ];
    let agent = Agent::serve(context);
    let mut group = criterion.benchmark_group(format!("answers_{TOPICS}_topics"));
    group.sample_size(20);
    for path in PRESENT.into_iter().chain(past.iter().map(String::as_str)) {
        println!("{path}: {} bytes", agent.ask(path));
        let name = path.replace(&format!("at={now}"), "at=");
        group.bench_function(name, |bencher| {
            bencher.iter_custom(|count| (0..count).map(|_| agent.time(path)).sum());
        });
    }
    group.finish();
}

criterion_group!(benches, answers);
criterion_main!(benches);
