//! An hour of a healthy robot, from its start to its end, has no finding. Its faults are found
//! within ten seconds.

use std::sync::Arc;

use ros2probe_model::derive::robot::RobotExpectations;
use ros2probe_model::derive::robot::parameters::ExpectedParameter;
use ros2probe_model::facts::shared_memory::MemoryUse;
use ros2probe_model::observe::input::Input;
use ros2probe_model::observe::observer::Settings;
use ros2probe_testing::model::domain::VirtualDomain;
use ros2probe_testing::model::forge::{self, Message, SEDP_READERS, SEDP_WRITERS};
use ros2probe_testing::robot_diagnostics::{self, Status, diagnostics};
use ros2probe_testing::robot_log::{self, log};
use ros2probe_testing::robot_parameters::{self, boolean, event};
use ros2probe_testing::robot_states::{self, battery, transition, with_header};
use ros2probe_testing::robot_transforms::{self, Transform, transforms};
use ros2probe_wire::{EntityId, Guid, GuidPrefix};

const SCAN: &str = "sensor_msgs::msg::dds_::LaserScan_";
/// Time of one step, in milliseconds.
const STEP: u64 = 100;

/// The writers of the robot, by node.
const LOG: Guid = guid(1, 1);
const DIAGNOSTICS: Guid = guid(1, 2);
const BATTERY: Guid = guid(1, 3);
const LIDAR: Guid = guid(2, 4);
const STATES: Guid = guid(2, 5);
const PARAMETERS: Guid = guid(2, 6);
const EKF: Guid = guid(3, 7);
const MODEL: Guid = guid(4, 8);
/// A writer that begins with a fault.
const SECOND: Guid = guid(5, 9);
const WRITERS: [(Guid, &str, &str, &str); 8] = [
    (LOG, "rt/rosout", robot_log::DDS_TYPE, "driver"),
    (
        DIAGNOSTICS,
        "rt/diagnostics",
        robot_diagnostics::DDS_TYPE,
        "driver",
    ),
    (BATTERY, "rt/battery", robot_states::BATTERY, "driver"),
    (LIDAR, "rt/scan", SCAN, "lidar"),
    (
        STATES,
        "rt/lidar/transition_event",
        robot_states::TRANSITION,
        "lidar",
    ),
    (
        PARAMETERS,
        "rt/parameter_events",
        robot_parameters::EVENT,
        "lidar",
    ),
    (EKF, "rt/tf", robot_transforms::DDS_TYPE, "ekf"),
    (
        MODEL,
        "rt/tf_static",
        robot_transforms::DDS_TYPE,
        "robot_state_publisher",
    ),
];
/// What the planner subscribes to.
const READ: [(&str, &str); 4] = [
    ("rt/scan", SCAN),
    ("rt/battery", robot_states::BATTERY),
    ("rt/diagnostics", robot_diagnostics::DDS_TYPE),
    ("rt/tf", robot_transforms::DDS_TYPE),
];

const fn guid(node: u8, number: u8) -> Guid {
    Guid::new(GuidPrefix([node; 12]), EntityId([0, 0, number, 3]))
}

/// What is wrong with the robot.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Fault {
    SilentBroadcaster,
    SecondBroadcaster,
    TimeWentBack,
    UnknownFrame,
    Typo,
    ErrorsInTheLog,
    PartInError,
    NodeInactive,
    FailedTransition,
    ParameterChanged,
    SimulatedTime,
    FullMemory,
}

struct Robot {
    domain: VirtualDomain,
    numbers: [u64; 16],
    announced: u64,
    step: u64,
    fault: Option<Fault>,
}

impl Robot {
    fn new() -> Self {
        let mut domain = VirtualDomain::new(&["/scan"], Settings::default());
        let parameter = ExpectedParameter {
            node: "/lidar".into(),
            name: "rate".into(),
            value: "10".into(),
        };
        let expectations = RobotExpectations {
            active: Arc::new(vec!["/lidar".into()]),
            parameters: Arc::new(vec![parameter]),
            ..RobotExpectations::default()
        };
        let observer = &mut domain.observer;
        observer.input(Input::RobotExpectations(expectations));
        Self {
            domain,
            numbers: [0; 16],
            announced: 0,
            step: 0,
            fault: None,
        }
    }

    fn send(&mut self, writer: Guid, payload: &[u8]) {
        let number = &mut self.numbers[usize::from(writer.entity.0[2])];
        *number += 1;
        let now = self.domain.now;
        let message = Message::from(writer.prefix).info_ts(now);
        let message = message.data(writer.entity, *number, payload);
        self.domain.put(message);
    }

    fn announce(&mut self, guid: Guid, topic: &str, type_name: &str) {
        self.announced += 1;
        let payload = forge::endpoint(guid, topic, type_name, true);
        let sedp = match guid.entity.is_writer() {
            true => SEDP_WRITERS,
            false => SEDP_READERS,
        };
        let message = Message::from(guid.prefix).data(sedp, self.announced, &payload);
        self.domain.put(message);
    }

    /// Starts one node after the other, a second apart.
    fn start(&mut self) {
        for node in 1..=4 {
            let own = WRITERS.iter().filter(|(guid, ..)| guid.prefix.0[0] == node);
            let own: Vec<_> = own.collect();
            self.domain.participant(GuidPrefix([node; 12]), 100_000);
            for (guid, topic, type_name, _) in &own {
                self.announce(*guid, topic, type_name);
            }
            let (guid, .., name) = own[0];
            self.domain.nodes(guid.prefix, 1, &[("/", name, *guid)]);
            self.steps(10);
        }
        let planner = GuidPrefix([9; 12]);
        self.domain.participant(planner, 100_000);
        for (number, (topic, type_name)) in (1_u8..).zip(READ) {
            let reader = Guid::new(planner, EntityId([0, 0, number, 4]));
            self.announce(reader, topic, type_name);
        }
        for node in ["/lidar", "/ekf"] {
            self.send(PARAMETERS, &boolean(node, "use_sim_time", false));
        }
        self.send(PARAMETERS, &event("/lidar", &[("rate", 10)], &[], &[]));
        self.send(STATES, &transition(1, 10));
        self.send(STATES, &transition(10, 2));
        self.steps(20);
        self.send(STATES, &transition(2, 13));
        self.send(STATES, &transition(13, 3));
    }

    /// One tenth of a second, with what the robot says in it.
    fn tenth(&mut self) {
        let (fault, second) = (self.fault, self.step.is_multiple_of(10));
        let now = self.step;
        let stamp = match fault {
            Some(Fault::TimeWentBack) => self.step * STEP / 2,
            _ => 10_000 + now * STEP,
        };
        let edge = |parent: &'static str, child: &'static str| Transform {
            parent,
            child,
            stamp,
            x: (now % 100) as f64 * 0.01,
            yaw: 0.0,
        };
        if now >= 30 && fault != Some(Fault::SilentBroadcaster) {
            let payload = transforms(&[edge("map", "odom"), edge("odom", "base_link")]);
            self.send(EKF, &payload);
        }
        if fault == Some(Fault::SecondBroadcaster) {
            self.send(SECOND, &transforms(&[edge("map", "odom")]));
        }
        if self.step == 35 {
            self.send(MODEL, &transforms(&[edge("base_link", "lidar_link")]));
        }
        if now >= 20 {
            self.send(LIDAR, &with_header("lidar_link", 400));
        }
        if second {
            let level = if fault == Some(Fault::PartInError) {
                2
            } else {
                0
            };
            let status = Status {
                level,
                name: "lidar: connection",
                message: "state",
                values: &[],
            };
            self.send(DIAGNOSTICS, &diagnostics(&[status]));
            self.send(BATTERY, &battery("base_link", 24.0, 30.0, 0.5));
            self.send(LOG, &log(20, "driver", b"alive"));
        }
        if self.step.is_multiple_of(600) {
            self.send(LOG, &log(40, "driver", b"one error a minute"));
        }
        if fault == Some(Fault::ErrorsInTheLog) {
            self.send(LOG, &log(40, "driver", b"read failed"));
        }
        self.domain.wait(STEP);
        self.step += 1;
    }

    fn steps(&mut self, steps: u64) {
        for _ in 0..steps {
            self.tenth();
        }
    }

    /// Begins a fault.
    fn begin(&mut self, fault: Fault) {
        self.fault = Some(fault);
        match fault {
            Fault::SecondBroadcaster => {
                self.domain.participant(SECOND.prefix, 100_000);
                self.announce(SECOND, "rt/tf", robot_transforms::DDS_TYPE);
            }
            Fault::UnknownFrame => {
                self.domain.participant(SECOND.prefix, 100_000);
                self.announce(SECOND, "rt/image", "sensor_msgs::msg::dds_::Image_");
                self.send(SECOND, &with_header("camera_link", 9));
            }
            Fault::Typo => {
                let planner = GuidPrefix([9; 12]);
                let goal = "geometry_msgs::msg::dds_::Twist_";
                let reader = Guid::new(planner, EntityId([0, 0, 9, 4]));
                self.announce(reader, "rt/cmd_vel", goal);
                self.announce(guid(4, 10), "rt/cmd_val", goal);
            }
            Fault::NodeInactive => {
                self.send(STATES, &transition(3, 14));
                self.send(STATES, &transition(14, 2));
            }
            Fault::FailedTransition => self.send(STATES, &transition(3, 15)),
            Fault::ParameterChanged => {
                self.send(PARAMETERS, &event("/lidar", &[], &[("rate", 5)], &[]));
            }
            Fault::SimulatedTime => {
                self.send(PARAMETERS, &boolean("/ekf", "use_sim_time", true));
            }
            Fault::FullMemory => {
                let observer = &mut self.domain.observer;
                observer.input(Input::SharedMemoryUsed(MemoryUse {
                    used_permille: 950,
                    ..MemoryUse::default()
                }));
            }
            _ => {}
        }
    }

    fn kinds(&self) -> Vec<String> {
        let diagnoses = self.domain.snapshot().diagnoses;
        let kinds = diagnoses.list.iter().map(|found| format!("{found:?}"));
        // Only the topics of interest have a subscription here.
        kinds
            .filter(|kind| !kind.starts_with("Unmatched"))
            .collect()
    }
}

#[test]
fn an_hour_of_a_healthy_robot_with_start_and_end_has_no_finding() {
    let mut robot = Robot::new();
    robot.start();
    for _ in 0..360 {
        robot.steps(100);
        assert_eq!(robot.kinds(), [""; 0], "step {}", robot.step);
    }
    robot.send(STATES, &transition(3, 12));
    robot.send(STATES, &transition(12, 4));
    for (index, (guid, ..)) in (1000..).zip(WRITERS) {
        let disposal = Message::from(guid.prefix).dispose_by_hash(SEDP_WRITERS, index, guid);
        robot.domain.put(disposal);
        robot.domain.wait(100);
        assert_eq!(robot.kinds(), [""; 0]);
    }
    for _ in 0..60 {
        robot.domain.wait(1000);
        assert_eq!(robot.kinds(), [""; 0]);
    }
}

#[test]
fn each_of_twelve_faults_is_the_only_finding_within_ten_seconds() {
    for (fault, expected) in [
        (Fault::SilentBroadcaster, "kind: Silent"),
        (Fault::SecondBroadcaster, "kind: SeveralBroadcasters"),
        (Fault::TimeWentBack, "kind: TimeWentBack"),
        (Fault::UnknownFrame, "kind: UnknownFrame"),
        (Fault::Typo, "NearMiss"),
        (Fault::ErrorsInTheLog, "LogErrors"),
        (Fault::PartInError, "DiagnosticError"),
        (Fault::NodeInactive, "NodeInactive"),
        (Fault::FailedTransition, "has_failed: true"),
        (Fault::ParameterChanged, "ParameterDrift"),
        (Fault::SimulatedTime, "MixedTime"),
        (Fault::FullMemory, "SharedMemoryFault"),
    ] {
        let mut robot = Robot::new();
        robot.start();
        robot.steps(300);
        assert_eq!(robot.kinds(), [""; 0], "{fault:?}");
        robot.begin(fault);
        robot.steps(101);
        let kinds = robot.kinds();
        assert_eq!(kinds.len(), 1, "{fault:?}: {kinds:#?}");
        assert!(kinds[0].contains(expected), "{fault:?}: {kinds:#?}");
    }
}
