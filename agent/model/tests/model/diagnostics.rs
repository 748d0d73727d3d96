//! What the robot itself says: its diagnostics.

use ros2probe_model::derive::robot::Parts;
use ros2probe_model::facts::diagnosis::Diagnosis;
use ros2probe_model::facts::event::EventKind;
use ros2probe_model::observe::input::Input;
use ros2probe_model::observe::observer::Settings;
use ros2probe_model::report::snapshot::DiagnosticStatus;
use ros2probe_testing::model::domain::VirtualDomain;
use ros2probe_testing::model::forge::{self, Message, SEDP_READERS, SEDP_WRITERS, SPDP};
use ros2probe_testing::robot_diagnostics::{DDS_TYPE, Status, diagnostics};
use ros2probe_testing::{robot_log, robot_transforms};
use ros2probe_wire::diagnostics::DiagnosticLevel::{self, Error, Ok, Stale, Warn};
use ros2probe_wire::{EntityId, Guid, GuidPrefix};

const PREFIX: GuidPrefix = GuidPrefix([3; 12]);
const WRITER: Guid = Guid::new(PREFIX, EntityId([0, 0, 1, 3]));
/// The writer of another node on the same topic.
const OTHER: Guid = Guid::new(GuidPrefix([4; 12]), EntityId([0, 0, 1, 3]));
const LIDAR: &str = "lidar: connection";

/// A robot that publishes diagnostics. No watch covers them.
struct Robot {
    domain: VirtualDomain,
    number: u64,
}

impl Robot {
    fn with(settings: Settings, topic: &str) -> Self {
        Self::within(VirtualDomain::new(&[], settings), topic)
    }

    fn within(mut domain: VirtualDomain, topic: &str) -> Self {
        domain.participant(PREFIX, 100_000);
        let payload = forge::endpoint(WRITER, topic, DDS_TYPE, true);
        domain.put(Message::from(PREFIX).data(SEDP_WRITERS, 1, &payload));
        domain.nodes(PREFIX, 1, &[("/", "driver", WRITER)]);
        Self { domain, number: 0 }
    }

    fn new() -> Self {
        Self::with(Settings::default(), "rt/diagnostics")
    }

    fn send(&mut self, statuses: &[Status<'_>]) {
        self.number += 1;
        let payload = diagnostics(statuses);
        let message = Message::from(PREFIX).data(WRITER.entity, self.number, &payload);
        self.domain.put(message);
    }

    fn say(&mut self, level: u8, message: &str) {
        self.send(&[Status {
            level,
            name: LIDAR,
            message,
            values: &[("rate", "9.5")],
        }]);
    }

    /// Sends this level once a second.
    fn publish_for(&mut self, level: u8, seconds: u64) {
        for second in 0..seconds {
            self.say(level, &format!("message {second}"));
            self.domain.wait(1000);
        }
    }

    /// Sends this level of each part once a second: of the lidar, and of another node's arm.
    fn publish_both_for(&mut self, lidar: u8, arm: u8, seconds: u64) {
        for _ in 0..seconds {
            self.say(lidar, "text");
            let arm = Status {
                level: arm,
                name: "arm",
                message: "text",
                values: &[],
            };
            let payload = diagnostics(&[arm]);
            let message = Message::from(OTHER.prefix).data(OTHER.entity, self.number, &payload);
            self.domain.put(message);
            self.domain.wait(1000);
        }
    }

    /// Returns the parts whose findings appeared or ended since the last call.
    fn reported(&mut self) -> Vec<(String, bool)> {
        let events = self.domain.observer.drain().events.events;
        let reported = events.into_iter().filter_map(|event| match event.kind {
            EventKind::Diagnosis {
                finding: Diagnosis::DiagnosticError { name, .. },
                resolved,
            } => Some((name.to_string(), resolved)),
            _ => None,
        });
        reported.collect()
    }

    fn only(&self) -> DiagnosticStatus {
        let statuses = self.domain.snapshot().diagnostics.statuses;
        let [status] = &statuses[..] else {
            panic!("{statuses:?}")
        };
        DiagnosticStatus::clone(status)
    }

    /// Returns level and message of the findings.
    fn findings(&self) -> Vec<(DiagnosticLevel, String)> {
        let diagnoses = &self.domain.snapshot().diagnoses;
        let errors = diagnoses.list.iter().filter_map(|each| match each {
            Diagnosis::DiagnosticError { level, message, .. } => {
                Some((*level, message.to_string()))
            }
            _ => None,
        });
        errors.collect()
    }

    /// Returns the changes of levels since the last call.
    fn changes(&mut self) -> Vec<(Option<DiagnosticLevel>, DiagnosticLevel)> {
        let events = self.domain.observer.drain().events.events;
        let changes = events.iter().filter_map(|event| match &event.kind {
            EventKind::Diagnostic { before, status } => {
                assert!(status.values.is_empty(), "values have a cap of their own");
                Some((*before, status.level))
            }
            _ => None,
        });
        changes.collect()
    }
}

#[test]
fn the_last_status_of_each_part_is_kept_with_its_values_and_node() {
    let mut robot = Robot::new();
    robot.say(1, "old");
    robot.send(&[
        Status {
            level: 2,
            name: LIDAR,
            message: "no data",
            values: &[("rate", "0"), ("port", "/dev/ttyUSB0")],
        },
        Status {
            level: 0,
            name: "battery",
            message: "full",
            values: &[],
        },
    ]);
    let statuses = robot.domain.snapshot().diagnostics.statuses;
    let [battery, lidar] = &statuses[..] else {
        panic!("{statuses:?}")
    };
    assert_eq!((&*battery.name, battery.level), ("battery", Ok));
    assert_eq!((&*lidar.name, lidar.level), (LIDAR, Error));
    assert_eq!((&*lidar.message, &*lidar.hardware_id), ("no data", "hw"));
    assert_eq!(lidar.node.as_deref(), Some("/driver"));
    assert_eq!(lidar.values[1], ("port".into(), "/dev/ttyUSB0".into()));
}

#[test]
fn a_change_of_level_is_one_event_and_the_first_ok_is_no_event() {
    let mut robot = Robot::new();
    for level in [0, 0, 1, 1, 2, 3, 0] {
        robot.say(level, "text");
    }
    let levels = [(Ok, Warn), (Warn, Error), (Error, Stale), (Stale, Ok)];
    assert_eq!(robot.changes(), levels.map(|(from, to)| (Some(from), to)));
    let mut robot = Robot::new();
    robot.say(2, "from the start");
    assert_eq!(robot.changes(), [(None, Error)]);
}

#[test]
fn an_error_of_five_seconds_is_a_finding_until_it_ends() {
    let mut robot = Robot::new();
    robot.publish_for(2, 4);
    assert_eq!(robot.findings(), []);
    robot.publish_for(2, 5);
    // The message is that of the report, so that the finding does not change each second.
    let reported = robot.findings();
    assert_eq!(reported.len(), 1);
    robot.publish_for(2, 5);
    assert_eq!(robot.findings(), reported);
    robot.publish_for(0, 2);
    assert_eq!(robot.findings(), []);
}

#[test]
fn the_error_of_one_node_that_ends_leaves_that_of_another_node() {
    let mut robot = Robot::new();
    robot.domain.participant(OTHER.prefix, 100_000);
    let payload = forge::endpoint(OTHER, "rt/diagnostics", DDS_TYPE, true);
    let message = Message::from(OTHER.prefix).data(SEDP_WRITERS, 1, &payload);
    robot.domain.put(message);
    let node = [("/", "gripper", OTHER)];
    robot.domain.nodes(OTHER.prefix, 1, &node);
    robot.publish_both_for(0, 2, 7);
    assert_eq!(robot.reported(), [("arm".to_owned(), false)]);
    robot.publish_both_for(2, 2, 7);
    assert_eq!(robot.reported(), [(LIDAR.to_owned(), false)]);
    robot.publish_both_for(0, 2, 2);
    assert_eq!(robot.reported(), [(LIDAR.to_owned(), true)]);
}

#[test]
fn errors_during_start_up_and_warnings_are_not_findings() {
    let mut robot = Robot::new();
    robot.publish_for(2, 4);
    robot.publish_for(1, 60);
    assert_eq!(robot.findings(), []);
}

#[test]
fn a_silent_diagnostic_part_becomes_stale_and_then_a_finding() {
    let mut robot = Robot::new();
    robot.publish_for(0, 10);
    (0..4).for_each(|_| robot.domain.wait(1000));
    assert_eq!(robot.only().level, Ok);
    (0..3).for_each(|_| robot.domain.wait(1000));
    assert_eq!(
        (robot.only().level, robot.changes()),
        (Stale, vec![(Some(Ok), Stale)])
    );
    (0..5).for_each(|_| robot.domain.wait(1000));
    assert_eq!(robot.findings(), [(Stale, "message 9".to_owned())]);
    robot.say(0, "back");
    robot.domain.wait(1000);
    assert_eq!((robot.only().level, robot.findings()), (Ok, vec![]));
}

#[test]
fn a_part_that_publishes_every_forty_seconds_is_never_stale() {
    let mut robot = Robot::new();
    for _ in 0..5 {
        robot.say(0, "alive");
        (0..40).for_each(|_| robot.domain.wait(1000));
        assert_eq!(robot.only().level, Ok);
    }
    (0..90).for_each(|_| robot.domain.wait(1000));
    assert_eq!(robot.only().level, Stale);
}

#[test]
fn a_part_of_which_polling_sees_few_messages_is_not_stale() {
    let mut robot = Robot::new();
    let status = Status {
        level: 0,
        name: LIDAR,
        message: "text",
        values: &[],
    };
    let message = |number: u64| {
        let payload = diagnostics(&[status]);
        Message::from(PREFIX).data(WRITER.entity, number, &payload)
    };
    for number in 1..=100 {
        // Processes start, and a probe sees each message.
        match number {
            ..=10 => robot.domain.put_exact(message(number)),
            11 => robot.domain.observer.input(Input::ProbesDetached),
            _ if number % 8 == 0 => robot.domain.put_polled(message(number)),
            _ => {}
        }
        robot.domain.wait(1000);
    }
    assert_eq!((robot.changes(), robot.findings()), (vec![], vec![]));
}

/// Returns the level of a part whose ten messages were passed with `put`, half a minute after
/// `end`. Its only reader shares memory with the publisher.
fn level_in_shared_memory(
    put: impl Fn(&mut VirtualDomain, Message),
    end: impl Fn(&mut VirtualDomain),
) -> DiagnosticLevel {
    let mut domain = VirtualDomain::new(&[], Settings::default());
    let [writer, reader] = [(8, 3), (9, 4)].map(|(process, kind)| {
        let prefix = GuidPrefix([1, 15, 3, 3, process, 0, 0, 0, 0, 0, 0, 1]);
        Guid::new(prefix, EntityId([0, 0, 1, kind]))
    });
    for (guid, sedp) in [(writer, SEDP_WRITERS), (reader, SEDP_READERS)] {
        let participant = forge::participant_on(guid.prefix, "machine", [10, 0, 0, 1]);
        domain.put(Message::from_fast(guid.prefix).data(SPDP, 1, &participant));
        let endpoint = forge::endpoint(guid, "rt/diagnostics", DDS_TYPE, true);
        domain.put(Message::from_fast(guid.prefix).data(sedp, 1, &endpoint));
    }
    for number in 1..=10 {
        let status = Status {
            level: 0,
            name: LIDAR,
            message: "text",
            values: &[],
        };
        let message = Message::from_fast(writer.prefix);
        let message = message.data(writer.entity, number, &diagnostics(&[status]));
        put(&mut domain, message);
        domain.wait(1000);
    }
    end(&mut domain);
    (0..30).for_each(|_| domain.wait(1000));
    domain.snapshot().diagnostics.statuses[0].level
}

#[test]
fn a_part_whose_messages_may_pass_unseen_in_shared_memory_is_not_stale() {
    let nothing = |_: &mut VirtualDomain| {};
    let detach = |domain: &mut VirtualDomain| domain.observer.input(Input::ProbesDetached);
    assert_eq!(
        level_in_shared_memory(VirtualDomain::put_polled, nothing),
        Ok
    );
    assert_eq!(level_in_shared_memory(VirtualDomain::put_exact, detach), Ok);
    // The subscription on the network that received these is gone.
    assert_eq!(level_in_shared_memory(VirtualDomain::put, nothing), Ok);
    // A probe would see further messages.
    assert_eq!(
        level_in_shared_memory(VirtualDomain::put_exact, nothing),
        Stale
    );
}

#[test]
fn the_diagnostics_of_a_removed_node_are_removed() {
    let mut robot = Robot::new();
    robot.publish_for(2, 8);
    assert_eq!(robot.findings().len(), 1);
    robot
        .domain
        .put(Message::from(PREFIX).dispose_by_hash(SEDP_WRITERS, 2, WRITER));
    robot.domain.wait(1000);
    assert!(robot.domain.snapshot().diagnostics.statuses.is_empty());
    assert_eq!(robot.findings(), []);
}

#[test]
fn repeated_statuses_of_an_aggregator_are_kept_without_a_finding() {
    let mut robot = Robot::with(Settings::default(), "rt/diagnostics_agg");
    robot.publish_for(2, 20);
    assert_eq!(robot.only().level, Error);
    assert_eq!((robot.findings(), robot.changes()), (vec![], vec![]));
}

#[test]
fn diagnostics_are_not_read_if_they_are_switched_off() {
    let settings = Settings {
        robot: Parts::default(),
        ..Settings::default()
    };
    let mut robot = Robot::with(settings, "rt/diagnostics");
    robot.say(2, "text");
    let facts = robot.domain.snapshot().diagnostics;
    assert!(!facts.are_read && facts.statuses.is_empty());
}

#[test]
fn malformed_messages_count_and_keep_what_precedes_the_error() {
    let mut robot = Robot::new();
    let statuses = [LIDAR, "battery"].map(|name| Status {
        level: 1,
        name,
        message: "text",
        values: &[],
    });
    let whole = diagnostics(&statuses);
    let message = Message::from(PREFIX).data(WRITER.entity, 1, &whole[..whole.len() - 8]);
    robot.domain.put(message);
    assert_eq!(&*robot.only().name, LIDAR);
    let errors = robot.domain.snapshot().decode_errors;
    assert!(
        errors
            .iter()
            .any(|each| each.stage == "diagnostics" && each.count == 1)
    );
}

#[test]
fn a_diagnostic_part_beyond_the_cap_displaces_the_part_with_the_longest_silence() {
    let mut robot = Robot::new();
    for number in 0..1100 {
        let name = format!("part {number}");
        robot.send(&[Status {
            level: 0,
            name: &name,
            message: "",
            values: &[("key", "value")],
        }]);
        robot.domain.wait(20);
    }
    let statuses = robot.domain.snapshot().diagnostics.statuses;
    assert_eq!(statuses.len(), 1024);
    assert!(statuses.iter().all(|status| &*status.name != "part 0"));
    assert!(statuses.iter().any(|status| &*status.name == "part 1099"));
}

#[test]
fn writers_beyond_the_cap_are_read_once_others_have_departed() {
    let mut domain = VirtualDomain::new(&[], Settings::default());
    let crowd = GuidPrefix([5; 12]);
    domain.participant(crowd, 100_000);
    let log = |number: u16| {
        let [high, low] = number.to_be_bytes();
        Guid::new(crowd, EntityId([1, high, low, 3]))
    };
    for number in 0..1024 {
        let payload = forge::endpoint(log(number), "rt/rosout", robot_log::DDS_TYPE, true);
        domain.put(Message::from(crowd).data(SEDP_WRITERS, u64::from(number) + 1, &payload));
    }
    let mut robot = Robot::within(domain, "rt/diagnostics");
    let fixed = Guid::new(PREFIX, EntityId([0, 0, 2, 3]));
    let payload = forge::endpoint(fixed, "rt/tf_static", robot_transforms::DDS_TYPE, true);
    let message = Message::from(PREFIX).data(SEDP_WRITERS, 2, &payload);
    robot.domain.put(message);
    robot.say(2, "not read");
    robot.domain.wait(1000);
    let snapshot = robot.domain.snapshot();
    assert!(snapshot.diagnostics.statuses.is_empty());
    assert_eq!(snapshot.transforms.trees[0].unread_static, 1);
    let message = Message::from(PREFIX).dispose_by_hash(SEDP_WRITERS, 3, fixed);
    robot.domain.put(message);
    assert!(robot.domain.snapshot().transforms.trees.is_empty());

    let message = Message::from(crowd).dispose_by_hash(SEDP_WRITERS, 2000, log(0));
    robot.domain.put(message);
    robot.domain.wait(1000);
    robot.say(2, "read");
    assert_eq!(&*robot.only().message, "read");
}
