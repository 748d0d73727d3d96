//! Stamps in the headers of messages that cannot be right.

use ros2probe_model::derive::robot::Parts;
use ros2probe_model::facts::bounded::ledger;
use ros2probe_model::facts::diagnosis::{Diagnosis, StampFault};
use ros2probe_model::observe::observer::Settings;
use ros2probe_testing::model::domain::VirtualDomain;
use ros2probe_testing::model::forge::{self, Message, SEDP_WRITERS};
use ros2probe_wire::time::{MILLISECOND, SECOND};
use ros2probe_wire::{EntityId, Guid, GuidPrefix};

const PREFIX: GuidPrefix = GuidPrefix([3; 12]);
const IMU: &str = "sensor_msgs::msg::dds_::Imu_";

fn writer(number: u16) -> Guid {
    let [high, low] = number.to_be_bytes();
    Guid::new(PREFIX, EntityId([1, high, low, 3]))
}

/// A publisher of `/imu` at 10 Hz, which a watch measures.
struct Sensor {
    domain: VirtualDomain,
    number: u64,
}

impl Sensor {
    fn with(settings: Settings) -> Self {
        let mut domain = VirtualDomain::new(&["/imu"], settings);
        domain.participant(PREFIX, 1_000_000);
        let payload = forge::endpoint(writer(1), "rt/imu", IMU, true);
        domain.put(Message::from(PREFIX).data(SEDP_WRITERS, 1, &payload));
        Self { domain, number: 0 }
    }

    fn new() -> Self {
        Self::with(Settings::default())
    }

    /// Publishes a message whose stamp is this number of nanoseconds old.
    fn publish(&mut self, age: i64) {
        self.number += 1;
        let message = message(&self.domain, writer(1), self.number, age);
        self.domain.put(message);
        self.domain.wait(100);
    }

    fn publish_for(&mut self, seconds: u64, age: impl Fn(u64) -> i64) {
        for step in 0..seconds * 10 {
            self.publish(age(step));
        }
    }

    /// Returns fault and milliseconds of the findings.
    fn faults(&mut self) -> Vec<(StampFault, i64)> {
        self.domain.wait(1000);
        let diagnoses = self.domain.snapshot().diagnoses;
        let found = diagnoses.list.iter().filter_map(|found| match found {
            Diagnosis::WrongStamps {
                topic,
                writer: found,
                fault,
                nanoseconds,
            } => {
                assert_eq!((&*topic.name, *found), ("/imu", writer(1)));
                Some((*fault, nanoseconds / 1_000_000))
            }
            _ => None,
        });
        found.collect()
    }
}

fn message(domain: &VirtualDomain, writer: Guid, number: u64, age: i64) -> Message {
    let stamp = domain.now.checked_add_signed(-age).unwrap();
    let number_of = |number: u64| u32::try_from(number).unwrap().to_le_bytes();
    let payload = [
        &[0, 1, 0, 0][..],
        &number_of(stamp / SECOND),
        &number_of(stamp % SECOND),
        &[1, 0, 0, 0, 0, 0, 0, 0],
    ]
    .concat();
    let message = Message::from(PREFIX).info_ts(domain.now);
    message.data(writer.entity, number, &payload)
}

const MS: i64 = MILLISECOND as i64;

#[test]
fn stamps_shortly_before_their_publication_are_right() {
    let mut sensor = Sensor::new();
    sensor.publish_for(300, |step| MS * (step % 7).cast_signed());
    assert_eq!(sensor.faults(), []);
    // A backlog comes and goes.
    sensor.publish_for(90, |step| MS * step.cast_signed());
    sensor.publish_for(90, |_| 5 * MS);
    assert_eq!(sensor.faults(), []);
}

#[test]
fn stamps_in_the_future_are_a_fault_from_the_third_message_on_until_three_are_right() {
    let mut sensor = Sensor::new();
    sensor.publish(-80 * MS);
    sensor.publish(-80 * MS);
    sensor.publish(5 * MS);
    assert_eq!(sensor.faults(), []);
    sensor.publish_for(1, |_| -80 * MS);
    assert_eq!(sensor.faults(), [(StampFault::Future, 80)]);
    sensor.publish_for(1, |_| -95 * MS);
    assert_eq!(sensor.faults(), [(StampFault::Future, 80)], "as it began");
    sensor.publish(0);
    sensor.publish(0);
    assert_eq!(sensor.faults(), [(StampFault::Future, 80)]);
    sensor.publish(0);
    assert_eq!(sensor.faults(), []);
}

#[test]
fn a_stamp_before_the_last_one_is_a_fault_for_a_minute() {
    let mut sensor = Sensor::new();
    sensor.publish_for(2, |_| 10 * MS);
    sensor.publish(510 * MS);
    assert_eq!(sensor.faults(), [(StampFault::WentBack, 400)]);
    sensor.publish_for(57, |_| 10 * MS);
    assert_eq!(sensor.faults().len(), 1);
    sensor.publish_for(3, |_| 10 * MS);
    assert_eq!(sensor.faults(), []);
}

#[test]
fn a_drift_of_40_ppm_is_found_within_three_minutes_in_either_direction() {
    for sign in [1, -1] {
        let mut sensor = Sensor::new();
        // 40 µs a second, and each message up to 9 ms late.
        let age = |step: u64| {
            let step = step.cast_signed();
            20 * MS + sign * step * 4_000 + MS * (step % 10)
        };
        sensor.publish_for(100, age);
        assert_eq!(sensor.faults(), []);
        let later = |step: u64| age(step + 1010);
        sensor.publish_for(80, later);
        let faults = sensor.faults();
        assert!(
            matches!(faults[..], [(StampFault::Drifting, by)] if by == 4 * sign),
            "{faults:?}"
        );
    }
}

#[test]
fn stamps_of_another_clock_are_a_fault_unless_a_clock_is_published() {
    let mut sensor = Sensor::new();
    let days = 86_400 * SECOND as i64;
    sensor.publish_for(1, |_| days);
    let expected = (StampFault::OtherClock, 86_400_000);
    assert_eq!(sensor.faults(), [expected]);
    let clock = forge::endpoint(
        writer(9),
        "rt/clock",
        "rosgraph_msgs::msg::dds_::Clock_",
        true,
    );
    let sedp = Message::from(PREFIX).data(SEDP_WRITERS, 2, &clock);
    sensor.domain.put(sedp);
    assert_eq!(sensor.faults(), []);
}

#[test]
fn a_departed_publisher_has_no_fault_and_the_part_can_be_switched_off() {
    let mut sensor = Sensor::new();
    sensor.publish_for(1, |_| -80 * MS);
    assert_eq!(sensor.faults().len(), 1);
    let disposal = Message::from(PREFIX).dispose_by_hash(SEDP_WRITERS, 3, writer(1));
    sensor.domain.put(disposal);
    assert_eq!(sensor.faults(), []);
    let settings = Settings {
        robot: Parts::default(),
        ..Settings::default()
    };
    let mut sensor = Sensor::with(settings);
    sensor.publish_for(1, |_| -80 * MS);
    assert_eq!(sensor.faults(), []);
}

#[test]
fn stamps_of_publishers_beyond_the_cap_are_not_evaluated() {
    let mut domain = VirtualDomain::new(&["/imu"], Settings::default());
    domain.participant(PREFIX, 1_000_000);
    for number in 1..=518 {
        let payload = forge::endpoint(writer(number), "rt/imu", IMU, true);
        domain.put(Message::from(PREFIX).data(SEDP_WRITERS, number.into(), &payload));
        let message = message(&domain, writer(number), 1, 0);
        domain.put(message);
    }
    let tables = domain.snapshot().tables;
    let own = tables.iter().find(|table| table.table == "stamp_writers");
    let own = own.unwrap();
    assert_eq!((own.size, own.evictions), (512, 6));
    assert!(ledger()["stamp_writers"].is_driven());
}
