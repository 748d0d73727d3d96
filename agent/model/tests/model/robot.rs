//! What the robot itself says: its logs.

use ros2probe_model::derive::robot::Parts;
use ros2probe_model::facts::bounded::ledger;
use ros2probe_model::facts::diagnosis::Diagnosis;
use ros2probe_model::facts::event::EventKind;
use ros2probe_model::observe::observer::Settings;
use ros2probe_model::report::snapshot::LogFacts;
use ros2probe_testing::model::domain::VirtualDomain;
use ros2probe_testing::model::forge::{self, Message, SEDP_WRITERS};
use ros2probe_testing::robot_log::{DDS_TYPE, log};
use ros2probe_wire::log::LogLevel;
use ros2probe_wire::{EntityId, Guid, GuidPrefix};

const PREFIX: GuidPrefix = GuidPrefix([3; 12]);
const WRITER: Guid = Guid::new(PREFIX, EntityId([0, 0, 1, 3]));
const ERROR: u8 = 40;

/// A node with a log. No watch covers it.
struct Node {
    domain: VirtualDomain,
    number: u64,
}

impl Node {
    fn with(settings: Settings) -> Self {
        let mut domain = VirtualDomain::new(&[], settings);
        domain.participant(PREFIX, 100_000);
        let payload = forge::endpoint(WRITER, "rt/rosout", DDS_TYPE, true);
        domain.put(Message::from(PREFIX).data(SEDP_WRITERS, 1, &payload));
        domain.nodes(PREFIX, 1, &[("/robot1", "lidar", WRITER)]);
        Self { domain, number: 0 }
    }

    fn new() -> Self {
        Self::with(Settings::default())
    }

    fn send(&mut self, payload: &[u8]) {
        self.number += 1;
        let message = Message::from(PREFIX).data(WRITER.entity, self.number, payload);
        self.domain.put(message);
    }

    fn log(&mut self, level: u8, text: &str) {
        self.send(&log(level, "robot1.lidar.driver", text.as_bytes()));
    }

    fn facts(&self) -> LogFacts {
        self.domain.snapshot().logs
    }

    /// Returns the numbers of messages by level, of the only node.
    fn counts(&self) -> [u64; 5] {
        let facts = self.facts();
        let [node] = &facts.nodes[..] else {
            panic!("{facts:?}")
        };
        assert_eq!((&*node.node, node.domain_id.0), ("/robot1/lidar", 0));
        node.levels.each_ref().map(|(messages, _)| *messages)
    }

    fn has_burst(&self) -> bool {
        let diagnoses = &self.domain.snapshot().diagnoses;
        let is_burst = |each: &Diagnosis| matches!(each, Diagnosis::LogErrors { .. });
        diagnoses.list.iter().any(is_burst)
    }
}

#[test]
fn messages_count_by_level_for_the_node_that_has_the_writer() {
    let mut node = Node::new();
    for level in [10, 20, 20, 30, 40, 50] {
        node.log(level, "text");
    }
    assert_eq!(node.counts(), [1, 2, 1, 1, 1]);
    let facts = node.facts();
    let last = facts.latest.last().unwrap();
    assert_eq!(
        (&*last.logger, &*last.text),
        ("robot1.lidar.driver", "text")
    );
    assert_eq!(
        (&*last.file, &*last.function, last.line),
        ("src/lidar.cpp", "read", 81)
    );
    assert_eq!((last.level, last.stamp.1), (LogLevel::Fatal, 500_000_000));
    assert_eq!(facts.nodes[0].levels[4].1.as_ref(), Some(last));
}

#[test]
fn a_repeated_message_counts_once_and_one_in_fragments_counts() {
    let mut node = Node::new();
    node.log(20, "once");
    node.number = 0;
    node.log(20, "once");
    let long = log(20, "robot1.lidar", "long ".repeat(400).as_bytes());
    for start in 1..=3 {
        let message = Message::from(PREFIX);
        node.domain
            .put(message.fragment(WRITER.entity, 2, start, 1000, &long));
    }
    assert_eq!(node.counts(), [0, 2, 0, 0, 0]);
    assert_eq!(node.facts().latest[1].text.len(), 512, "truncated");
}

#[test]
fn a_logger_names_the_node_that_is_not_announced() {
    let mut node = Node::new();
    node.domain.nodes(PREFIX, 2, &[]);
    node.log(20, "hello");
    assert_eq!(&*node.facts().nodes[0].node, "/robot1/lidar/driver");
}

#[test]
fn malformed_messages_and_text_of_other_encodings_are_counted_or_replaced() {
    let mut node = Node::new();
    node.send(&log(20, "robot1.lidar", b"a\xe9b \x1b[31m"));
    assert_eq!(&*node.facts().latest[0].text, "a\u{fffd}b \x1b[31m");
    let whole = log(20, "robot1.lidar", b"text");
    (4..whole.len() - 4).for_each(|end| node.send(&whole[..end]));
    assert_eq!(node.counts(), [0, 1, 0, 0, 0]);
    let errors = node.domain.snapshot().decode_errors;
    let errors: u64 = errors
        .iter()
        .filter(|each| each.stage == "log")
        .map(|each| each.count)
        .sum();
    assert_eq!(errors, whole.len() as u64 - 8);
}

#[test]
fn ten_errors_in_a_minute_are_a_burst_until_a_minute_passes_without_one() {
    let mut node = Node::new();
    for number in 0..9 {
        node.log(ERROR, &format!("error {number}"));
        node.domain.wait(6000);
    }
    assert!(!node.has_burst());
    node.log(ERROR, "the tenth");
    node.domain.wait(1000);
    assert!(node.has_burst());
    let events = node.domain.observer.drain().events.events;
    let finding = events.iter().find_map(|event| match &event.kind {
        EventKind::Diagnosis {
            resolved: false,
            finding,
        } => Some(finding.clone()),
        _ => None,
    });
    let Some(Diagnosis::LogErrors { errors, text, .. }) = finding else {
        panic!("{events:?}")
    };
    assert_eq!((errors, &*text), (10, "the tenth"));
    (0..58).for_each(|_| node.domain.wait(1000));
    assert!(node.has_burst());
    (0..3).for_each(|_| node.domain.wait(1000));
    assert!(!node.has_burst());
}

#[test]
fn a_fatal_error_is_a_burst_and_a_few_errors_or_warnings_are_not() {
    let mut node = Node::new();
    for _ in 0..200 {
        node.log(30, "warning");
        node.domain.wait(100);
    }
    node.log(ERROR, "start-up");
    node.domain.wait(1000);
    assert!(!node.has_burst());
    node.log(50, "fatal");
    node.domain.wait(1000);
    assert!(node.has_burst());
}

#[test]
fn a_writer_beyond_its_allowance_is_paused_and_read_again_later() {
    let mut node = Node::new();
    let text = "x".repeat(400);
    for _ in 0..10_000 {
        node.log(20, &text);
    }
    let [_, counted, ..] = node.counts();
    assert!((1_000..5_000).contains(&counted), "{counted}");
    (0..20).for_each(|_| node.domain.wait(1000));
    node.log(20, "later");
    assert_eq!(node.counts()[1], counted + 1);
}

#[test]
fn logs_are_not_read_if_they_are_switched_off() {
    let mut node = Node::with(Settings {
        robot: Parts::default(),
        ..Settings::default()
    });
    node.log(20, "text");
    assert_eq!(node.facts(), LogFacts::default());
}

#[test]
fn a_node_beyond_the_cap_displaces_the_node_with_the_longest_silence() {
    let mut node = Node::new();
    for number in 0..600 {
        let name = format!("n{number}");
        node.domain
            .nodes(PREFIX, 2 + number, &[("/", &name, WRITER)]);
        node.log(20, "text");
        node.domain.wait(10);
    }
    let facts = node.facts();
    assert_eq!((facts.nodes.len(), facts.latest.len()), (512, 600));
    assert!(facts.nodes.iter().all(|log| &*log.node != "/n0"));
    assert!(facts.nodes.iter().any(|log| &*log.node == "/n599"));
    assert!(ledger()["log_nodes"].is_driven());
}

#[test]
fn messages_that_are_not_taken_in_time_are_counted() {
    let mut node = Node::new();
    for number in 0..1005 {
        node.log(20, &format!("message {number}"));
        node.domain.wait(5);
    }
    let output = node.domain.observer.drain();
    assert_eq!((output.logs.len(), output.lost_logs), (1000, 5));
    assert_eq!(&*output.logs[0].message.text, "message 0");
    node.log(20, "later");
    let output = node.domain.observer.drain();
    assert_eq!((output.logs.len(), output.lost_logs), (1, 0));
}
