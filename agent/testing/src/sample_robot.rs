//! A robot of any size as the model describes it, with a value for every fact.

pub mod inside;
mod robot;

use std::net::Ipv4Addr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use ros2probe_daemon::agent_facts::{
    AgentFacts, ExactFacts, InterfaceFacts, SharedMemoryFacts, SourceKind, WireFacts,
};
use ros2probe_daemon::state::StateFacts;
use ros2probe_model::derive::chain::exemplar::Exemplars;
use ros2probe_model::derive::chain::expected::{ChainState, ExpectedChain, ExpectedFacts};
use ros2probe_model::derive::chain::path::{ChainFacts, ChainsFacts, HopHistograms, Quantiles};
use ros2probe_model::derive::chain::trace::{HopTimes, Method, Path, Point};
use ros2probe_model::derive::services::latency::Latencies;
use ros2probe_model::facts::diagnosis::{
    Diagnoses, Diagnosis, Difference, Policies, Policy, QosPairs, StampFault, TopicKey, Unmatched,
};
use ros2probe_model::facts::histogram::Histogram;
use ros2probe_model::facts::link::{LinkKey, LinkProtocol};
use ros2probe_model::facts::loss_share::LossShare;
use ros2probe_model::facts::model_time::ModelTime;
use ros2probe_model::facts::robot::{TransformFault, TransformFaultKind};
use ros2probe_model::facts::shared_memory::MemoryFault;
use ros2probe_model::facts::topic_kind::TopicKind;
use ros2probe_model::facts::wall_clock::WallClock;
use ros2probe_model::facts::watch::Watch;
use ros2probe_model::graph::discovery::Addresses;
use ros2probe_model::graph::zenoh::{Counters, ZenohFacts};
use ros2probe_model::measure::links::LinkFacts;
use ros2probe_model::report::snapshot::{
    AcknowledgementFacts, ActionFacts, Breakdown, ChurnCount, DecodeErrorCount, Delivered,
    DeliveryFacts, Direction, EarlierCounts, EndpointFacts, GoalCounts, LatencyFacts, Measurement,
    NodeFacts, ParticipantFacts, ProcessFacts, SampledFacts, ServiceFacts, Snapshot, SocketFacts,
    Source, Subscriber, TableFacts, TopicFacts, Transport, TransportCount, UnknownWriterFacts,
    WatchFacts, WatchState, WatchedTopicFacts,
};
use ros2probe_wire::diagnostics::DiagnosticLevel;
use ros2probe_wire::discovery::TypeHash;
use ros2probe_wire::lifecycle::LifecycleState;
use ros2probe_wire::qos::{History, HistoryKind, Qos, Reliability, Role};
use ros2probe_wire::rtps::VendorId;
use ros2probe_wire::{DomainId, EntityId, Guid, GuidPrefix, SequenceNumber, Timestamp};

/// Returns a chain of 100 messages from /points to /cmd_vel, configured with a limit of 15 ms.
fn chains() -> ChainsFacts {
    let topic = |name: &str, node: &str| (name.into(), Some(node.into()));
    let path = Arc::new(Path {
        domain_id: DomainId(0),
        method: Method::Stamps,
        topics: vec![
            topic("/points", "/lidar"),
            topic("/filtered", "/filter"),
            topic("/cmd_vel", "/controller"),
        ],
    });
    let trace = |number: u64| {
        let begin = Timestamp(1_699_999_990_000_000_000 + number * 50_000_000);
        let point = |published: u64, arrived: Option<u64>| Point {
            published: begin + Duration::from_micros(published),
            arrived: arrived.map(|at| begin + Duration::from_micros(at)),
            started: None,
        };
        vec![
            point(0, Some(300)),
            point(12_000 + number, Some(12_200 + number)),
            point(16_000 + number, None),
        ]
    };
    let traces: Vec<_> = (0..100).map(trace).collect();
    let mut histogram = Histogram::default();
    let mut exemplars = Exemplars::default();
    let mut hops = vec![HopHistograms::default(); 2];
    for (trace_id, points) in (1..).zip(&traces) {
        let seconds =
            |input: &Point, output: &Point| HopTimes::between(input, output).whole.as_secs_f64();
        let (whole, at) = (seconds(&points[0], &points[2]), points[2].published);
        exemplars.observe(&mut histogram, whole, Some(trace_id), at);
        for (hop, ends) in hops.iter_mut().zip(points.windows(2)) {
            let times = HopTimes::between(&ends[0], &ends[1]);
            hop.whole.observe(times.whole.as_secs_f64());
            hop.transit.observe(times.transit.unwrap().as_secs_f64());
            hop.node.observe(times.node.unwrap().as_secs_f64());
        }
    }
    let ends = traces
        .iter()
        .map(|points| HopTimes::between(&points[0], &points[2]).whole);
    ChainsFacts {
        expected: vec![ExpectedFacts {
            chain: ExpectedChain {
                domain_id: None,
                from: "/points".into(),
                to: "/cmd_vel".into(),
                max_latency: Some(Duration::from_millis(15)),
            },
            domain_id: Some(DomainId(0)),
            method: Some(Method::Stamps),
            state: ChainState::Slow,
            histogram,
            exemplars: exemplars.clone(),
            latency: Quantiles::of(ends),
        }],
        chains: vec![ChainFacts {
            path,
            count: 100,
            last: traces[99][2].published,
            traces: Arc::new(traces.into_iter().collect()),
            whole: histogram,
            exemplars,
            hops,
        }],
    }
}

/// Returns the participant of the robot's node.
#[must_use]
pub fn participant() -> ParticipantFacts {
    ParticipantFacts {
        guid: Guid::new(GuidPrefix([1; 12]), EntityId([0, 0, 1, 0xc1])),
        domain_id: DomainId(0),
        vendor: VendorId::EPROSIMA,
        product_version: Some("3.2.5".into()),
        enclave: Some("/".into()),
        process: process(),
        first_seen: ModelTime::from_nanoseconds(1),
        last_seen: ModelTime::from_nanoseconds(2),
        lease: ros2probe_wire::RtpsDuration::Finite(Duration::from_secs(20)),
        secured: false,
        announces_by_tcp: false,
        announces_unseen: false,
        discovery_server: false,
        restored: false,
        addresses: Addresses {
            metatraffic: Box::default(),
            default: Box::new([([10, 0, 0, 2], 7411).into()]),
            tcp: Box::default(),
        },
    }
}

/// Returns an agent's full state for a robot with topics of these names, all watched by `/**`.
pub fn snapshot<'a>(names: impl IntoIterator<Item = &'a str>) -> Snapshot {
    let participant = participant();
    let guid = participant.guid;
    let topics: Vec<TopicFacts> = names.into_iter().map(topic).collect();
    let watched = |topic: &TopicFacts| WatchedTopicFacts {
        domain_id: topic.domain_id,
        topic: topic.name.clone(),
        state: WatchState::Violated,
        violations: vec!["min_rate_hz"],
    };
    Snapshot {
        at: ModelTime::from_nanoseconds(1_700_000_000_000_000_000),
        wall_clock: WallClock::default(),
        participants: vec![participant],
        sockets: vec![SocketFacts {
            cookie: 77,
            process_id: Some(42),
            own_process_id: Some(7),
            process: Some("mapper".into()),
            cgroup: Some("/robot.slice".into()),
            unidentified_drops: 5,
        }],
        nodes: vec![NodeFacts {
            domain_id: DomainId(0),
            name: "/lidar".into(),
            participant: guid,
            writers: Vec::new(),
            readers: Vec::new(),
        }],
        watches: vec![WatchFacts {
            watch: Arc::new(Watch::named("/**").unwrap()),
            topics: topics.iter().map(watched).collect(),
        }],
        topics,
        unknown_writers: vec![UnknownWriterFacts {
            guid,
            vendor: None,
            process: process(),
            first_seen: ModelTime::from_nanoseconds(3),
            measurement: measurement(),
        }],
        logs: robot::logs(guid),
        diagnostics: robot::diagnostics(guid),
        parameters: robot::parameters(guid),
        lifecycle: robot::lifecycle(),
        fields: robot::fields(),
        transforms: robot::transforms(guid),
        clocks: robot::clocks(),
        services: vec![service()],
        actions: vec![action()],
        inside: Some(Arc::new(inside::inside())),
        zenoh: Some(ZenohFacts {
            connections: 3,
            routers: 1,
            counters: Counters {
                batches: 7000,
                gaps: 2,
                foreign: 4,
                incomplete: 1,
            },
            unseen: [1, 0, 0, 0, 0, 0],
        }),
        chains: chains(),
        tls_connections: 2,
        links: vec![LinkFacts {
            key: LinkKey {
                protocol: LinkProtocol::Zenoh,
                source: [10, 0, 0, 1].into(),
                destination: [10, 0, 0, 2].into(),
            },
            connections: 2,
            sent: 1000,
            retransmitted: 40,
            round_trip: Some(Duration::from_micros(2500)),
            unacknowledged: 1448,
            unsent: Some(20_000),
        }],
        diagnosed: Arc::new(vec![ModelTime::from_nanoseconds(5); diagnoses().list.len()]),
        diagnoses: Arc::new(diagnoses()),
        churn: vec![ChurnCount {
            domain_id: DomainId(0),
            entity: "writer",
            event: "appeared",
            count: 12,
        }],
        decode_errors: vec![DecodeErrorCount {
            stage: "rtps",
            reason: "truncated",
            count: 1,
        }],
        tables: vec![TableFacts {
            table: "topics",
            size: 3,
            limit: 1_000,
            bytes: Some((500, 8_000)),
            evictions: 0,
        }],
        datagrams: 100,
        records: 1_000,
        topics_measured: 1,
        topics_rejected: 0,
    }
}

/// Returns the calls of one service.
fn service() -> ServiceFacts {
    ServiceFacts {
        domain_id: DomainId(0),
        name: "/add_two_ints".into(),
        requests: 9,
        answered: 7,
        unanswered: 2,
        open: 2,
        hanging: 1,
        latency: latencies(&[0.0012, 0.004]),
        suspended: false,
        exact: false,
    }
}

fn action() -> ActionFacts {
    ActionFacts {
        domain_id: DomainId(0),
        name: "/fibonacci".into(),
        goals: GoalCounts {
            accepted: 5,
            rejected: 1,
            succeeded: 2,
            canceled: 1,
            aborted: 1,
        },
        open: 1,
        duration: latencies(&[3.5, 12.0]),
    }
}

fn latencies(values: &[f64]) -> LatencyFacts {
    let mut latencies = Latencies::default();
    for value in values {
        latencies.observe(Duration::from_secs_f64(*value));
    }
    latencies.facts()
}

/// Returns one finding of each kind.
fn diagnoses() -> Diagnoses {
    let guid = |entity: [u8; 4]| Guid::new(GuidPrefix([1; 12]), EntityId(entity));
    let (writer, reader) = (guid([0, 0, 1, 3]), guid([0, 0, 2, 4]));
    let participant = guid([0, 0, 1, 0xc1]);
    let topic = TopicKey {
        domain_id: DomainId(0),
        dds_name: "rt/points".into(),
        name: "/points".into(),
        kind: TopicKind::Topic,
    };
    let mut policies = Policies::default();
    policies.insert(Policy::Reliability);
    let mut list = vec![
        Diagnosis::QosIncompatible {
            topic: topic.clone(),
            writer,
            reader,
            policies,
        },
        Diagnosis::TypeConflict {
            topic: topic.clone(),
            types: vec!["a/msg/A".into(), "b/msg/B".into()],
        },
        Diagnosis::TypeHashConflict {
            topic: topic.clone(),
            message_type: "a/msg/A".into(),
            hashes: vec![TypeHash([1; 32]), TypeHash([2; 32])],
        },
        Diagnosis::DuplicateNode {
            domain_id: DomainId(0),
            node: "/lidar".into(),
            participants: vec![participant; 3],
        },
        Diagnosis::UnmatchedPublisher {
            topic: topic.clone(),
            writer,
            reason: Unmatched::Qos,
        },
        Diagnosis::UnmatchedSubscription {
            topic: topic.clone(),
            reader,
            reason: Unmatched::Type,
        },
        Diagnosis::HangingCall {
            topic: TopicKey {
                domain_id: DomainId(0),
                dds_name: "rq/add_two_intsRequest".into(),
                name: "/add_two_ints".into(),
                kind: TopicKind::ServiceRequest,
            },
            writer,
        },
        Diagnosis::NodeInSeveralDomains {
            node: "/lidar".into(),
            participant,
            domains: vec![DomainId(0), DomainId(5)],
        },
        Diagnosis::RestampingNode {
            topic: topic.clone(),
            node: "/lidar".into(),
            input: "/scan".into(),
        },
        Diagnosis::BuffersByCpu {
            topic: topic.clone(),
            writer,
            reader: Some(reader),
            backends: vec!["cuda".into()],
        },
        Diagnosis::LossyLink {
            link: LinkKey {
                protocol: LinkProtocol::Zenoh,
                source: [10, 0, 0, 1].into(),
                destination: [10, 0, 0, 2].into(),
            },
            retransmitted_permille: 40,
            unsent: Some(20_000),
        },
        Diagnosis::LogErrors {
            domain_id: DomainId(0),
            node: "/lidar".into(),
            errors: 10,
            text: "no data".into(),
        },
        Diagnosis::DiagnosticError {
            domain_id: DomainId(0),
            topic: "/diagnostics".into(),
            node: Some("/lidar".into()),
            name: "lidar: connection".into(),
            hardware_id: "vlp16".into(),
            level: DiagnosticLevel::Error,
            message: "no data".into(),
        },
        Diagnosis::TransformFault {
            domain_id: DomainId(0),
            namespace: "".into(),
            fault: TransformFault {
                child: "base_link".into(),
                parent: "odom".into(),
                kind: TransformFaultKind::Silent,
                edges: 3,
                names: vec!["/ekf".into()],
            },
        },
        Diagnosis::ClocksApart {
            peer: "camera-pc".into(),
            offset: -20_000_000,
            uncertainty: 300_000,
        },
        Diagnosis::NearMiss {
            topic: TopicKey {
                domain_id: DomainId(0),
                dds_name: "rt/Scan".into(),
                name: "/Scan".into(),
                kind: TopicKind::Topic,
            },
            subscription: topic.clone(),
            difference: Difference::Case,
        },
        Diagnosis::NodeInactive {
            domain_id: DomainId(0),
            node: "/lidar".into(),
            state: LifecycleState::Inactive,
            has_failed: true,
        },
        Diagnosis::ParameterDrift {
            domain_id: DomainId(0),
            node: "/lidar".into(),
            name: "frame_rate".into(),
            expected: "20.0".into(),
            value: "10.0".into(),
        },
        Diagnosis::MixedTime {
            domain_id: DomainId(0),
            simulated: vec!["/planner".into()],
            system: vec!["/lidar".into()],
        },
        Diagnosis::WrongStamps {
            topic: topic.clone(),
            writer,
            fault: StampFault::Future,
            nanoseconds: 80_000_000,
        },
        Diagnosis::SharedMemoryFault {
            fault: MemoryFault::Stale,
            figure: 96 << 20,
        },
        Diagnosis::SlowChain {
            topic: topic.clone(),
            from: "/scan".into(),
            max_latency: Duration::from_millis(15),
        },
    ];
    list.extend(inside::findings(&topic));
    let qos_pairs = vec![QosPairs {
        topic,
        policy: Policy::Reliability,
        pairs: 12,
    }];
    Diagnoses {
        list,
        qos_pairs,
        ..Diagnoses::default()
    }
}

fn process() -> ProcessFacts {
    ProcessFacts {
        host: Some("robot".into()),
        id: Some(42),
        name: Some("mapper".into()),
        cgroup: Some("/robot.slice".into()),
    }
}

/// Returns the facts of a running agent.
pub fn agent() -> AgentFacts {
    AgentFacts {
        interfaces: vec![InterfaceFacts {
            name: "eth0".to_owned(),
            packets: Some(5),
            dropped: Some(0),
        }],
        filter_events: vec![("ignore", 7), ("meter", 8), ("capture", 9)],
        wire: Some(WireFacts {
            hook: "packet",
            reason: Some("the kernel has no tcx (Linux 6.6)".to_owned()),
        }),
        copied_bytes: 12_345,
        state: Some(StateFacts {
            writes: 3,
            failures: 0,
            stalled: None,
        }),
        inside: Some(inside::source()),
        exact: vec![ExactFacts {
            library: "/opt/ros/humble/lib/libfastrtps.so.2.6".to_owned(),
            refused: None,
        }],
        shared_memory: Some(SharedMemoryFacts {
            open: vec![("port", 4)],
            events: vec![("read", 7)],
            cpu_seconds: 1.5,
            polls: 1_000,
        }),
        ..AgentFacts::new(SourceKind::Wire, Instant::now())
    }
}

/// Returns a measured topic with one publisher and one subscription.
pub fn topic(name: &str) -> TopicFacts {
    let guid = |entity: u8| Guid::new(GuidPrefix([1; 12]), EntityId([0, 0, entity, 3]));
    let endpoint = |guid: Guid| EndpointFacts {
        guid,
        gid: guid.to_bytes(),
        node: Some("/lidar".into()),
        qos: Arc::new(Qos {
            reliability: Reliability::RELIABLE,
            history: Some(History {
                kind: HistoryKind::KEEP_LAST,
                depth: 10,
            }),
            ..Qos::defaults(Role::Writer, VendorId::EPROSIMA)
        }),
        message_type: "sensor_msgs/msg/PointCloud2".into(),
        type_hash: None,
        equivalence_hash: None,
        first_seen: ModelTime::from_nanoseconds(4),
        measurement: Some(Box::new(measurement())),
        transports: 1,
        latched: None,
        backends: None,
        buffers: Box::default(),
    };
    TopicFacts {
        domain_id: DomainId(0),
        name: name.into(),
        dds_name: format!("rt{name}").into(),
        kind: TopicKind::Topic,
        hidden: false,
        message_types: vec!["sensor_msgs/msg/PointCloud2".into()],
        type_hashes: Vec::new(),
        publishers: vec![endpoint(guid(1))],
        subscriptions: vec![endpoint(guid(2))],
        measurement: Some(Box::new(measurement())),
        received: Some(Box::new(delivered())),
        sent: Some(Box::new(sent())),
        breakdown: Some(Box::new(breakdown())),
        deliveries: vec![delivery(Direction::Sent), delivery(Direction::Received)],
        acknowledgements: vec![AcknowledgementFacts {
            writer: guid(1),
            reader: guid(2),
            node: Some("/mapper".into()),
            acknowledged: SequenceNumber(123_400),
            missing: 2,
            requested: 9,
            acknacks: 1_000,
            lag_samples: 56,
            lag_seconds: Some(2.75),
            last_seen: ModelTime::from_nanoseconds(1_700_000_000_000_000_000),
        }],
        vanished: false,
        transports: vec![TransportCount {
            transport: Transport::SharedMemory,
            pairs: 1,
        }],
        is_read: false,
        source: Source::Wire,
        inside: Some(Box::new(inside::topic())),
        observed_pairs: Vec::new(),
    }
}

/// Returns the samples that one writer sends to a subscriber's destination, or that the subscriber
/// received.
pub fn delivery(direction: Direction) -> DeliveryFacts {
    let guid = |entity: [u8; 4]| Guid::new(GuidPrefix([1; 12]), EntityId(entity));
    let received = direction == Direction::Received;
    let participant = guid([0, 0, 1, 0xc1]);
    DeliveryFacts {
        writer: guid([0, 0, 1, 3]),
        direction,
        destination: (Ipv4Addr::new(10, 0, 0, 2), 7411).into(),
        subscriber: if received {
            Subscriber::Participant(participant)
        } else {
            Subscriber::Unknown
        },
        participant: received.then_some(participant),
        readers: vec![guid([0, 0, 2, 4])],
        nodes: vec!["/mapper".into()],
        sockets: vec![77],
        process_id: Some(42),
        process: Some("mapper".into()),
        cgroup: Some("/robot.slice".into()),
        first_seen: ModelTime::from_nanoseconds(5),
        last_seen: ModelTime::from_nanoseconds(6),
        delivered: if received { delivered() } else { sent() },
        lost_in_reader_queue: received.then_some(7),
    }
}

fn delivered() -> Delivered {
    Delivered {
        messages: 900,
        bytes: 580_000_000,
        recovered: 3,
        recovery_seconds: 0.25,
        unmatched: 4,
        irrelevant: 5,
        lost_at_sender: 25,
        lost_before_host: 60,
        lost_in_reassembly: 20,
        lost_in_socket_buffer: 15,
        pending: 1,
        ..Delivered::default()
    }
}

fn sent() -> Delivered {
    Delivered {
        messages: 1_000,
        bytes: 644_000_000,
        ..Delivered::default()
    }
}

fn breakdown() -> Breakdown {
    let mut breakdown = Breakdown::default();
    for step in 1..=1_000 {
        let seconds = Duration::from_micros(step * 7).as_secs_f64();
        breakdown.send_delay.observe(seconds);
        breakdown.transit.observe(seconds);
        breakdown.transfer.observe(seconds);
        breakdown.retransmission.observe(seconds);
    }
    breakdown
}

fn measurement() -> Measurement {
    let mut histogram = Histogram::default();
    for step in 1..=1_000 {
        histogram.observe(Duration::from_micros(step * 37).as_secs_f64());
    }
    Measurement {
        messages: 123_456,
        bytes: 79_504_384_000,
        lost: 12,
        loss: LossShare {
            lost: 96,
            expected: 996,
        },
        recovered: 3,
        duplicates: 4,
        incomplete: 1,
        irrelevant: 0,
        last_message: Some(ModelTime::from_nanoseconds(1_700_000_000_123_456_789)),
        rate_hz: 19.98,
        bandwidth: 12_867_120.5,
        interarrival: histogram,
        source_latency: histogram,
        header_latency: histogram,
        negative_latency: 0,
        implausible_latency: 0,
        sequence_jumps: 0,
        earlier: EarlierCounts::default(),
        sampled: Some(SampledFacts {
            seen: 123_000,
            span: 123_456,
            uncertain: 1,
        }),
    }
}
