//! What the robot itself says: its transforms.

use std::time::Duration;

use ros2probe_model::derive::robot::Parts;
use ros2probe_model::facts::diagnosis::Diagnosis;
use ros2probe_model::facts::event::EventKind;
use ros2probe_model::facts::robot::TransformFaultKind::{
    self, Apart, Jumps, SeveralBroadcasters, Silent, TimeWentBack,
};
use ros2probe_model::facts::robot::TransformJump;
use ros2probe_model::observe::input::Input;
use ros2probe_model::observe::observer::Settings;
use ros2probe_model::report::snapshot::{EdgeFacts, TreeFacts};
use ros2probe_testing::model::domain::VirtualDomain;
use ros2probe_testing::model::forge::{self, Message, SEDP_WRITERS};
use ros2probe_testing::robot_transforms::{DDS_TYPE, Transform, transforms};
use ros2probe_wire::{EntityId, Guid, GuidPrefix};

const FIRST: Guid = Guid::new(GuidPrefix([3; 12]), EntityId([0, 0, 1, 3]));
const SECOND: Guid = Guid::new(GuidPrefix([4; 12]), EntityId([0, 0, 1, 3]));

/// A robot with up to two broadcasters. No watch covers them.
struct Robot {
    domain: VirtualDomain,
    numbers: [u64; 2],
    /// Milliseconds since the start.
    now: u64,
}

impl Robot {
    fn with(settings: Settings, topics: [&str; 2]) -> Self {
        let mut domain = VirtualDomain::new(&[], settings);
        for (guid, topic) in [FIRST, SECOND].into_iter().zip(topics) {
            let prefix = guid.prefix;
            domain.participant(prefix, 100_000);
            let payload = forge::endpoint(guid, topic, DDS_TYPE, true);
            domain.put(Message::from(prefix).data(SEDP_WRITERS, 1, &payload));
            let name = if guid == FIRST { "ekf" } else { "amcl" };
            domain.nodes(prefix, 1, &[("/", name, guid)]);
        }
        Self {
            domain,
            numbers: [0; 2],
            now: 0,
        }
    }

    fn new() -> Self {
        Self::with(Settings::default(), ["rt/tf"; 2])
    }

    fn send(&mut self, guid: Guid, all: &[Transform<'_>]) {
        let number = &mut self.numbers[usize::from(guid == SECOND)];
        *number += 1;
        let message = Message::from(guid.prefix).data(guid.entity, *number, &transforms(all));
        self.domain.put(message);
    }

    fn broadcast(&mut self, guid: Guid, parent: &str, child: &str, x: f64) {
        let transform = Transform {
            parent,
            child,
            stamp: self.now + 1000,
            x,
            yaw: 0.0,
        };
        self.send(guid, &[transform]);
    }

    fn wait(&mut self, milliseconds: u64) {
        self.now += milliseconds;
        self.domain.wait(milliseconds);
    }

    /// Broadcasts odom -> base_link of this guid at 10 Hz.
    fn broadcast_for(&mut self, guid: Guid, seconds: u64) {
        for _ in 0..seconds * 10 {
            self.broadcast(guid, "odom", "base_link", 1.0);
            self.wait(100);
        }
    }

    fn trees(&self) -> Vec<TreeFacts> {
        self.domain.snapshot().transforms.trees
    }

    fn edge(&self, child: &str) -> EdgeFacts {
        let trees = self.trees();
        let mut edges = trees.iter().flat_map(|tree| &tree.edges);
        edges.find(|edge| &*edge.child == child).unwrap().clone()
    }

    fn faults(&self) -> Vec<(TransformFaultKind, String, Vec<String>)> {
        let diagnoses = &self.domain.snapshot().diagnoses;
        let faults = diagnoses.list.iter().filter_map(|each| match each {
            Diagnosis::TransformFault { fault, .. } => {
                let names = fault.names.iter().map(|name| name.to_string());
                Some((fault.kind, fault.child.to_string(), names.collect()))
            }
            _ => None,
        });
        faults.collect()
    }

    fn jumps(&mut self) -> Vec<TransformJump> {
        let events = self.domain.observer.drain().events.events;
        let jumps = events.iter().filter_map(|event| match &event.kind {
            EventKind::TransformJump { jump, .. } => Some(*jump),
            _ => None,
        });
        jumps.collect()
    }
}

/// Returns the longest of the latest intervals of `base_link`, in milliseconds.
fn interval(robot: &Robot) -> Option<u128> {
    let interval = robot.edge("base_link").longest_interval;
    interval.map(|interval| interval.as_millis())
}

fn names<const N: usize>(names: [&str; N]) -> Vec<String> {
    names.map(str::to_owned).to_vec()
}

#[test]
fn an_edge_has_its_last_transform_its_rate_and_its_broadcaster() {
    let mut robot = Robot::new();
    robot.broadcast_for(FIRST, 12);
    robot.broadcast(FIRST, "/odom", "/base_link", 7.0);
    let edge = robot.edge("base_link");
    assert_eq!(
        (&*edge.parent, edge.is_static, edge.count),
        ("odom", false, 121)
    );
    assert_eq!(edge.pose.translation, [7.0, 0.0, 0.0]);
    assert_eq!(edge.stamp, (13, 0));
    assert_eq!(edge.broadcasters[0].node.as_deref(), Some("/ekf"));
    assert!((edge.rate.unwrap() - 10.0).abs() < 0.2, "{edge:?}");
    assert_eq!(edge.longest_interval, Some(Duration::from_millis(100)));
    assert_eq!(robot.faults(), []);
    // A gap counts less with each transform after it.
    robot.wait(800);
    robot.broadcast(FIRST, "odom", "base_link", 7.0);
    assert_eq!(interval(&robot), Some(800));
    robot.wait(100);
    robot.broadcast(FIRST, "odom", "base_link", 7.0);
    assert_eq!(interval(&robot), Some(700));
    robot.broadcast_for(FIRST, 3);
    assert_eq!(interval(&robot), Some(100));
}

#[test]
fn static_and_moving_transforms_of_each_namespace_are_separate() {
    let mut robot = Robot::with(Settings::default(), ["rt/robot1/tf_static", "rt/tf"]);
    let trees = robot.trees();
    assert_eq!(
        (&*trees[0].namespace, trees[0].unread_static),
        ("/robot1", 1)
    );
    robot.broadcast(FIRST, "base_link", "lidar", 1.0);
    robot.broadcast(SECOND, "odom", "base_link", 1.0);
    let trees = robot.trees();
    let [root, robot1] = &trees[..] else {
        panic!("{trees:?}")
    };
    assert_eq!((&*root.namespace, &*robot1.namespace), ("", "/robot1"));
    assert!(robot1.edges[0].is_static && !root.edges[0].is_static);
    assert_eq!(robot1.unread_static, 0);
    assert_eq!(robot1.edges[0].rate, None);
    assert_eq!(robot1.edges[0].longest_interval, None);
}

#[test]
fn transforms_on_other_topics_do_not_belong_to_the_robot() {
    let mut robot = Robot::with(Settings::default(), ["rt/tf", "rt/tf_old"]);
    for _ in 0..100 {
        robot.broadcast(FIRST, "odom", "base_link", 1.0);
        let old = Transform {
            parent: "odom",
            child: "base_link",
            stamp: robot.now,
            x: 50.0,
            yaw: 0.0,
        };
        robot.send(SECOND, &[old]);
        robot.wait(100);
    }
    assert_eq!((robot.faults(), robot.jumps()), (vec![], vec![]));
    assert_eq!(robot.trees().len(), 1);
    assert_eq!(robot.edge("base_link").count, 100);
}

#[test]
fn a_silent_broadcaster_is_a_fault_and_a_removed_broadcaster_is_not() {
    let mut robot = Robot::new();
    robot.broadcast_for(FIRST, 5);
    (0..5).for_each(|_| robot.wait(1000));
    assert_eq!(
        robot.faults(),
        [(Silent, "base_link".to_owned(), names(["/ekf"]))]
    );
    robot.broadcast_for(FIRST, 2);
    assert_eq!(robot.faults(), []);
    (0..5).for_each(|_| robot.wait(1000));
    let gone = Message::from(FIRST.prefix).dispose_by_hash(SEDP_WRITERS, 2, FIRST);
    robot.domain.put(gone);
    robot.wait(1000);
    assert_eq!((robot.faults(), robot.trees().len()), (vec![], 0));
}

#[test]
fn an_edge_of_which_polling_sees_few_transforms_is_not_silent() {
    let mut robot = Robot::new();
    for number in 1..=300 {
        let transform = Transform {
            parent: "odom",
            child: "base_link",
            stamp: robot.now + 1000,
            x: 1.0,
            yaw: 0.0,
        };
        let message = Message::from(FIRST.prefix);
        let message = message.data(FIRST.entity, number, &transforms(&[transform]));
        match number {
            ..=50 => robot.domain.put_exact(message),
            51 => robot.domain.observer.input(Input::ProbesDetached),
            _ if number % 90 == 0 => robot.domain.put_polled(message),
            _ => {}
        }
        robot.wait(100);
        assert_eq!(robot.faults(), [], "{number}");
    }
    assert_eq!(robot.edge("base_link").count, 53);
}

#[test]
fn an_edge_at_one_fortieth_hertz_is_not_silent_between_two_transforms() {
    let mut robot = Robot::new();
    for _ in 0..4 {
        robot.broadcast(FIRST, "map", "odom", 1.0);
        (0..40).for_each(|_| robot.wait(1000));
        assert_eq!(robot.faults(), []);
    }
}

#[test]
fn two_simultaneous_broadcasters_are_a_fault_and_a_successor_is_not() {
    let mut robot = Robot::new();
    robot.broadcast_for(FIRST, 8);
    robot.broadcast_for(SECOND, 8);
    assert!(
        robot
            .faults()
            .iter()
            .all(|(kind, ..)| *kind != SeveralBroadcasters)
    );
    for _ in 0..80 {
        robot.broadcast(FIRST, "odom", "base_link", 1.0);
        robot.broadcast(SECOND, "odom", "base_link", 1.0);
        robot.wait(100);
    }
    let fault = (
        SeveralBroadcasters,
        "base_link".to_owned(),
        names(["/ekf", "/amcl"]),
    );
    assert_eq!(robot.faults(), [fault]);
}

#[test]
fn two_static_broadcasters_of_one_frame_are_a_fault_once_a_lease_would_have_ended() {
    let mut robot = Robot::with(Settings::default(), ["rt/tf_static"; 2]);
    robot.broadcast(FIRST, "base_link", "lidar", 1.0);
    robot.broadcast(SECOND, "map", "lidar", 2.0);
    (0..40).for_each(|_| robot.wait(1000));
    assert_eq!(robot.faults(), []);
    (0..10).for_each(|_| robot.wait(1000));
    assert_eq!(robot.faults()[0].0, SeveralBroadcasters);
}

#[test]
fn unconnected_trees_are_a_fault_unless_static_transforms_are_unread() {
    let mut robot = Robot::with(Settings::default(), ["rt/tf", "rt/tf_static"]);
    let both = |robot: &mut Robot| {
        robot.broadcast(FIRST, "map", "odom", 1.0);
        robot.broadcast(FIRST, "base_link", "arm", 1.0);
        robot.wait(500);
    };
    (0..40).for_each(|_| both(&mut robot));
    assert_eq!(
        robot.faults(),
        [],
        "/amcl may have broadcast the rest before"
    );
    robot.broadcast(SECOND, "base_link", "lidar", 1.0);
    (0..18).for_each(|_| both(&mut robot));
    assert_eq!(robot.faults(), []);
    (0..6).for_each(|_| both(&mut robot));
    assert_eq!(
        robot.faults(),
        [(Apart, String::new(), names(["base_link", "map"]))]
    );
    robot.broadcast(SECOND, "odom", "base_link", 1.0);
    both(&mut robot);
    both(&mut robot);
    assert_eq!(robot.faults(), []);
}

#[test]
fn a_jump_is_an_event_if_it_is_far_longer_than_the_steps_before() {
    let mut robot = Robot::new();
    for step in 0..50 {
        robot.broadcast(FIRST, "odom", "base_link", f64::from(step) * 0.02);
        robot.wait(20);
    }
    assert_eq!(robot.jumps(), []);
    robot.broadcast(FIRST, "odom", "base_link", 3.0);
    assert_eq!(robot.jumps(), [TransformJump::Translation]);
    let turned = Transform {
        parent: "odom",
        child: "base_link",
        stamp: robot.now + 1000,
        x: 3.0,
        yaw: 1.5,
    };
    robot.send(FIRST, &[turned]);
    assert_eq!(robot.jumps(), [TransformJump::Rotation]);
    assert_eq!(
        (robot.edge("base_link").jumps.translation, robot.faults()),
        (1, vec![])
    );
}

#[test]
fn three_jumps_within_a_minute_are_a_fault_until_a_minute_after_the_first_one() {
    let mut robot = Robot::new();
    let mut drive = |seconds: u64, x: f64| {
        for _ in 0..seconds * 50 {
            robot.broadcast(FIRST, "odom", "base_link", x);
            robot.wait(20);
        }
        robot.faults()
    };
    assert_eq!(drive(10, 0.0), []);
    assert_eq!(drive(10, 2.0), []);
    assert_eq!(drive(10, 0.0), [], "a localisation corrects itself");
    let fault = [(Jumps, "base_link".to_owned(), names(["/ekf"]))];
    assert_eq!(drive(10, 2.0), fault);
    assert_eq!(drive(28, 2.0), fault);
    assert_eq!(drive(4, 2.0), []);
}

#[test]
fn a_backward_stamp_is_an_event_and_a_fault_for_a_minute() {
    let mut robot = Robot::new();
    robot.now = 100_000;
    robot.broadcast_for(FIRST, 3);
    robot.now -= 50_000;
    robot.broadcast_for(FIRST, 2);
    assert_eq!(robot.jumps(), [TransformJump::Time]);
    assert_eq!(
        robot.faults(),
        [(TimeWentBack, "base_link".to_owned(), names(["/ekf"]))]
    );
    robot.broadcast_for(FIRST, 60);
    assert_eq!(robot.faults(), []);
}

#[test]
fn nan_infinite_and_huge_coordinates_cause_no_fault() {
    let mut robot = Robot::new();
    for x in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, f64::MAX, 0.0] {
        (0..20).for_each(|_| robot.broadcast(FIRST, "odom", "base_link", x));
    }
    assert_eq!(robot.edge("base_link").count, 100);
}

#[test]
fn transforms_are_not_read_if_they_are_switched_off() {
    let settings = Settings {
        robot: Parts::default(),
        ..Settings::default()
    };
    let mut robot = Robot::with(settings, ["rt/tf"; 2]);
    robot.broadcast_for(FIRST, 1);
    let facts = robot.domain.snapshot().transforms;
    assert!(!facts.are_read && facts.trees.is_empty());
}

#[test]
fn thirty_joints_at_100_hz_are_within_the_allowance() {
    let mut robot = Robot::new();
    let names: Vec<_> = (0..30)
        .map(|joint| format!("robot_arm_joint_{joint}"))
        .collect();
    for _ in 0..3000 {
        let all: Vec<_> = (names.iter())
            .map(|child| Transform {
                parent: "base_link",
                child,
                stamp: robot.now + 1000,
                x: 0.1,
                yaw: 0.0,
            })
            .collect();
        robot.send(FIRST, &all);
        robot.wait(10);
    }
    assert_eq!(robot.edge("robot_arm_joint_29").count, 3000);
    (0..5).for_each(|_| robot.wait(1000));
    assert_eq!(robot.faults().len(), 1, "one broadcaster ceased");
}

#[test]
fn frames_and_namespaces_beyond_the_caps_are_left_out() {
    let mut robot = Robot::new();
    for number in 0..2200 {
        robot.broadcast(FIRST, "map", &format!("frame{number}"), 1.0);
        robot.wait(10);
    }
    let edges: usize = robot.trees().iter().map(|tree| tree.edges.len()).sum();
    assert_eq!(edges, 2048);
    let mut domain = VirtualDomain::new(&[], Settings::default());
    domain.participant(FIRST.prefix, 100_000);
    let payload = transforms(&[Transform {
        parent: "map",
        child: "odom",
        stamp: 1,
        x: 0.0,
        yaw: 0.0,
    }]);
    for number in 0..80_u8 {
        let entity = EntityId([0, 1, number, 3]);
        let guid = Guid::new(FIRST.prefix, entity);
        let topic = format!("rt/robot{number}/tf");
        let endpoint = forge::endpoint(guid, &topic, DDS_TYPE, true);
        let number = u64::from(number) + 1;
        domain.put(Message::from(FIRST.prefix).data(SEDP_WRITERS, number, &endpoint));
        domain.put(Message::from(FIRST.prefix).data(entity, 1, &payload));
    }
    assert_eq!(domain.snapshot().transforms.trees.len(), 64);
}

#[test]
fn static_broadcasters_beyond_the_cap_count_as_read() {
    let mut domain = VirtualDomain::new(&[], Settings::default());
    domain.participant(FIRST.prefix, 100_000);
    for number in 0..1100_u16 {
        let [high, low] = number.to_be_bytes();
        let guid = Guid::new(FIRST.prefix, EntityId([1, high, low, 3]));
        let endpoint = forge::endpoint(guid, "rt/tf_static", DDS_TYPE, true);
        let number = u64::from(number) + 1;
        domain.put(Message::from(FIRST.prefix).data(SEDP_WRITERS, number, &endpoint));
    }
    assert_eq!(domain.snapshot().transforms.trees[0].unread_static, 1024);
}

#[test]
fn a_retransmitted_transform_is_counted_and_neither_the_last_one_nor_a_step_back() {
    let mut robot = Robot::new();
    robot.broadcast_for(FIRST, 1);
    let lost = Transform {
        parent: "odom",
        child: "base_link",
        stamp: robot.now + 1000,
        x: 1.0,
        yaw: 0.0,
    };
    robot.numbers[0] += 1;
    robot.wait(100);
    robot.broadcast(FIRST, "odom", "base_link", 1.5);
    let last = robot.edge("base_link").stamp;
    let message = transforms(&[lost]);
    let message = Message::from(FIRST.prefix).data(FIRST.entity, 11, &message);
    robot.domain.put(message);
    let edge = robot.edge("base_link");
    assert_eq!((edge.count, edge.stamp), (12, last));
    assert_eq!(edge.pose.translation[0], 1.5);
    assert!(robot.jumps().is_empty());
    robot.wait(1_000);
    assert!(robot.faults().is_empty());
}

#[test]
fn transforms_of_a_broadcaster_that_restarted_its_numbers_are_read() {
    let mut robot = Robot::new();
    robot.broadcast_for(FIRST, 10);
    robot.numbers[0] = 0;
    robot.wait(1_000);
    let transform = Transform {
        parent: "odom",
        child: "base_link",
        stamp: robot.now + 1000,
        x: 2.0,
        yaw: 0.0,
    };
    let source = robot.domain.now;
    let message = Message::from(FIRST.prefix).info_ts(source);
    let message = message.data(FIRST.entity, 1, &transforms(&[transform]));
    robot.domain.put(message);
    assert_eq!(
        robot.edge("base_link").pose.translation[0],
        1.0,
        "no source time before"
    );
    for number in [200, 1] {
        robot.wait(1_000);
        let transform = Transform {
            parent: "odom",
            child: "base_link",
            stamp: robot.now + 1000,
            x: number as f64,
            yaw: 0.0,
        };
        let message = Message::from(FIRST.prefix).info_ts(robot.domain.now);
        let message = message.data(FIRST.entity, number, &transforms(&[transform]));
        robot.domain.put(message);
        assert_eq!(robot.edge("base_link").pose.translation[0], number as f64);
    }
}
