//! What the robot itself says: messages whose fields have metrics.

use std::sync::Arc;

use ros2probe_model::derive::robot::{Parts, RobotExpectations};
use ros2probe_model::observe::input::Input;
use ros2probe_model::observe::observer::Settings;
use ros2probe_model::report::snapshot::FieldMessage;
use ros2probe_testing::model::domain::VirtualDomain;
use ros2probe_testing::model::forge::{self, Message, SEDP_WRITERS};
use ros2probe_testing::robot_states::{BATTERY, battery};
use ros2probe_wire::{EntityId, Guid, GuidPrefix};

const PREFIX: GuidPrefix = GuidPrefix([3; 12]);
const IMU: &str = "sensor_msgs::msg::dds_::Imu_";

fn writer(number: u8) -> Guid {
    Guid::new(PREFIX, EntityId([0, 0, number, 3]))
}

fn robot(settings: Settings) -> VirtualDomain {
    let mut domain = VirtualDomain::new(&[], settings);
    let expectations = RobotExpectations {
        fields: Arc::new(vec!["/imu".into()]),
        ..RobotExpectations::default()
    };
    let observer = &mut domain.observer;
    observer.input(Input::RobotExpectations(expectations));
    domain.participant(PREFIX, 100_000);
    for (number, topic, type_name) in [
        (1, "rt/battery", BATTERY),
        (2, "rt/imu", IMU),
        (3, "rt/imu_raw", IMU),
    ] {
        let payload = forge::endpoint(writer(number), topic, type_name, true);
        domain.put(Message::from(PREFIX).data(SEDP_WRITERS, number.into(), &payload));
    }
    domain
}

fn topics(messages: &[FieldMessage]) -> Vec<(&str, &str, usize)> {
    let shown = messages.iter().map(|message| {
        let (topic, message_type) = (&*message.topic, &*message.message_type);
        (topic, message_type, message.payload.len())
    });
    shown.collect()
}

#[test]
fn the_last_message_of_batteries_and_of_configured_topics_is_kept() {
    let mut domain = robot(Settings::default());
    for (number, size) in [(1, 40), (2, 60), (3, 80)] {
        let entity = writer(number).entity;
        let short = Message::from(PREFIX).data(entity, 1, &[0, 1, 0, 0]);
        domain.put(short);
        domain.put(Message::from(PREFIX).data(entity, 2, &vec![1; size]));
    }
    let expected = [
        ("/battery", "sensor_msgs/msg/BatteryState", 40),
        ("/imu", "sensor_msgs/msg/Imu", 60),
    ];
    assert_eq!(topics(&domain.snapshot().fields), expected);
    domain.put(Message::from(PREFIX).dispose_by_hash(SEDP_WRITERS, 9, writer(1)));
    assert_eq!(topics(&domain.snapshot().fields), expected[1..]);
}

#[test]
fn the_part_can_be_switched_off() {
    let settings = Settings {
        robot: Parts::default(),
        ..Settings::default()
    };
    let mut domain = robot(settings);
    let payload = battery("base_link", 24.0, 20.0, 0.5);
    domain.put(Message::from(PREFIX).data(writer(1).entity, 1, &payload));
    assert_eq!(domain.snapshot().fields, []);
}
