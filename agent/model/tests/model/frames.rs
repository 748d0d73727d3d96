//! What the robot itself says: frames that messages name and no transform has.

use ros2probe_model::facts::diagnosis::Diagnosis;
use ros2probe_model::facts::robot::TransformFaultKind;
use ros2probe_model::observe::observer::Settings;
use ros2probe_testing::model::domain::VirtualDomain;
use ros2probe_testing::model::forge::{self, Message, SEDP_WRITERS};
use ros2probe_testing::robot_states::with_header;
use ros2probe_testing::robot_transforms::{DDS_TYPE, Transform, transforms};
use ros2probe_wire::record::Verdict;
use ros2probe_wire::{EntityId, Guid, GuidPrefix};

const PREFIX: GuidPrefix = GuidPrefix([3; 12]);
const IMAGE: &str = "sensor_msgs::msg::dds_::Image_";

fn writer(number: u8) -> Guid {
    Guid::new(PREFIX, EntityId([0, 0, number, 3]))
}

/// A robot with a broadcaster of `odom` -> `base_link`, and publishers of images. No watch covers
/// them.
struct Robot {
    domain: VirtualDomain,
    number: u64,
}

impl Robot {
    fn new() -> Self {
        let mut domain = VirtualDomain::new(&[], Settings::default());
        domain.participant(PREFIX, 100_000);
        for (number, topic, type_name) in [
            (1, "rt/tf", DDS_TYPE),
            (2, "rt/front", IMAGE),
            (3, "rt/rear", IMAGE),
            (4, "rt/text", "std_msgs::msg::dds_::String_"),
            (5, "rt/joy", "sensor_msgs::msg::dds_::Joy_"),
            (6, "rt/can", "can_msgs::msg::dds_::Frame_"),
        ] {
            let payload = forge::endpoint(writer(number), topic, type_name, true);
            domain.put(Message::from(PREFIX).data(SEDP_WRITERS, number.into(), &payload));
        }
        Self { domain, number: 0 }
    }

    fn send(&mut self, writer: Guid, payload: &[u8]) {
        self.number += 1;
        let message = Message::from(PREFIX).data(writer.entity, self.number, payload);
        self.domain.put(message);
    }

    fn broadcast(&mut self, child: &str) {
        let transform = Transform {
            parent: "odom",
            child,
            stamp: 1000,
            x: 0.0,
            yaw: 0.0,
        };
        self.send(writer(1), &transforms(&[transform]));
    }

    /// Returns the unknown frames with the topics that name them, after some time.
    fn unknown(&mut self, milliseconds: u64) -> Vec<(String, String)> {
        self.domain.wait(milliseconds);
        let diagnoses = self.domain.snapshot().diagnoses;
        let found = diagnoses.list.iter().filter_map(|found| match found {
            Diagnosis::TransformFault { fault, .. }
                if fault.kind == TransformFaultKind::UnknownFrame =>
            {
                Some((fault.child.to_string(), fault.names.join(" ")))
            }
            _ => None,
        });
        found.collect()
    }

    /// Returns the last verdict about each writer in these changes.
    fn verdict(&mut self, of: Guid) -> Option<Verdict> {
        let interest = self.domain.observer.drain().interest;
        let mut changes = interest.iter().rev();
        changes
            .find(|(guid, _)| *guid == of)
            .and_then(|(_, verdict)| *verdict)
    }
}

#[test]
fn a_frame_that_no_transform_has_is_a_finding_with_its_topics() {
    let mut robot = Robot::new();
    let frame = |frame: &str| with_header(frame, 100);
    robot.send(writer(2), &frame("camera"));
    robot.send(writer(3), &frame("/camera"));
    robot.send(writer(4), &frame("ignored"));
    assert_eq!(robot.unknown(30_000), [], "the robot has no transforms");
    robot.broadcast("base_link");
    assert_eq!(robot.unknown(7_000), []);
    let expected = ("camera".to_owned(), "/front /rear".to_owned());
    assert_eq!(robot.unknown(4_000), [expected]);
    robot.broadcast("camera");
    assert_eq!(robot.unknown(1_000), []);
}

#[test]
fn the_names_of_devices_are_no_frames() {
    let mut robot = Robot::new();
    assert_eq!(robot.verdict(writer(5)), Some(Verdict::Ignore));
    robot.broadcast("base_link");
    robot.send(writer(5), &with_header("joy", 100));
    robot.send(writer(6), &with_header("can", 100));
    assert_eq!(robot.unknown(20_000), []);
}

#[test]
fn one_message_of_a_writer_is_captured_for_its_frame() {
    let mut robot = Robot::new();
    assert_eq!(robot.verdict(writer(2)), Some(Verdict::Capture));
    robot.send(writer(2), &with_header("odom", 100));
    assert_eq!(robot.verdict(writer(2)), Some(Verdict::Ignore));
    robot.send(writer(2), &with_header("odom", 100));
    assert_eq!(robot.verdict(writer(2)), None);
    // A message without a header is read once, too.
    robot.send(writer(3), &[9; 9]);
    assert_eq!(robot.verdict(writer(3)), Some(Verdict::Ignore));
}

#[test]
fn frames_are_not_evaluated_before_the_static_transforms_are_known() {
    let mut robot = Robot::new();
    let payload = forge::endpoint(writer(9), "rt/tf_static", DDS_TYPE, true);
    let sedp = Message::from(PREFIX).data(SEDP_WRITERS, 9, &payload);
    robot.domain.put(sedp);
    robot.broadcast("base_link");
    robot.send(writer(2), &with_header("camera", 100));
    assert_eq!(robot.unknown(30_000), []);
    let transform = Transform {
        parent: "base_link",
        child: "lidar",
        stamp: 1000,
        x: 0.0,
        yaw: 0.0,
    };
    robot.send(writer(9), &transforms(&[transform]));
    let expected = ("camera".to_owned(), "/front".to_owned());
    assert_eq!(robot.unknown(12_000), [expected]);
}
