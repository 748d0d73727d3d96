//! Calls that are late because a message was lost, and sent again or given up.

use ros2probe_model::facts::calls::late::{Cause, LateCall, MessageDelivery, Repairs, Stage};
use ros2probe_testing::model::host::{BOB, CAROL, CapturePoint, Host, STRING, WRITER};
use ros2probe_wire::record::{Record, guid_words, kind};

use super::late::{call, states};
use super::*;

/// Bob's process, as [`Host::owner`] names it.
const PROCESS: u32 = BOB.0[2] as u32;

/// Alice publishes ten messages a second, and Bob's callback is observed.
struct Robot {
    host: Host,
    bob: CapturePoint,
    number: u64,
    /// Numbers of messages, and when they arrived.
    arrivals: Vec<(u64, u64)>,
}

impl Robot {
    fn new() -> Self {
        let mut host = Host::new();
        let bob = host.reader(BOB, 7411);
        host.owner(bob, BOB);
        let mut robot = Self {
            host,
            bob,
            number: 0,
            arrivals: Vec::new(),
        };
        for _ in 0..20 {
            let message = robot.publish();
            robot.host.put(message);
        }
        robot.report(Vec::new());
        robot
    }

    /// Publishes the next message, which has not arrived yet.
    fn publish(&mut self) -> Record {
        self.host.wait(100);
        self.number += 1;
        self.host.record(self.bob, kind::DATA, self.number)
    }

    /// The message arrives now.
    fn arrive(&mut self, message: &Record) {
        self.arrivals.push((message.sequence_number, self.host.now));
        self.host.put(Record {
            time: self.host.now,
            ..*message
        });
    }

    fn arrived_before(&self, message: &Record) -> Duration {
        let mut arrivals = self.arrivals.iter();
        let found = arrivals.find(|(number, _)| *number == message.sequence_number);
        Duration::from_nanos(self.host.now - found.unwrap().1)
    }

    /// The callback of a message begins now. Returns its repairs and its main part.
    fn call(&mut self, message: &Record, wait: u64) -> (Repairs, Stage, Cause) {
        let source = ros2probe_wire::RtpsTime(message.source_timestamp).timestamp();
        let late = LateCall {
            process: PROCESS,
            trigger: Trigger::Subscription("/chatter".into()),
            source,
            started: Timestamp(self.host.now),
            duration: Duration::from_millis(1),
            delivery: Some(MessageDelivery {
                sent_before: None,
                arrived_before: self.arrived_before(message),
                received_before: self.arrived_before(message),
                receiver_thread: 9,
                receiver: None,
            }),
            wait: Some(Duration::from_millis(wait)),
            ..call(states(1, 0, 0, 0))
        };
        self.report(vec![late]);
        let inside = self.host.snapshot().inside.unwrap();
        let late = &inside.late[0];
        let last = late.latest.last().unwrap();
        let main = last.main.unwrap();
        (last.call.repairs, main.stage, main.cause)
    }

    fn report(&mut self, late: Vec<LateCall>) {
        let subscriptions = vec![subscription("/chatter", self.number, self.host.now)];
        self.host.observer.input(Input::Inside(Report {
            at: Timestamp(self.host.now),
            has_callbacks: true,
            processes: vec![ProcessReport {
                subscriptions,
                ..process(PROCESS)
            }],
            transitions: Vec::new(),
            late,
        }));
    }
}

#[test]
fn a_lost_message_and_those_behind_it_are_late_for_its_retransmission() {
    let mut robot = Robot::new();
    let lost = robot.publish();
    let behind = robot.publish();
    robot.arrive(&behind);
    robot.host.wait(50);
    robot.arrive(&lost);
    robot.host.wait(2);
    let since = Some(Duration::from_millis(2));
    let (repairs, stage, cause) = robot.call(&lost, 152);
    assert_eq!((repairs.of_message, repairs.of_earlier), (since, None));
    assert_eq!((stage, cause), (Stage::Network, Cause::Repaired));
    let (repairs, stage, cause) = robot.call(&behind, 52);
    assert_eq!((repairs.of_message, repairs.of_earlier), (None, since));
    assert_eq!((stage, cause), (Stage::Receive, Cause::Repaired));
    let (repairs, ..) = robot.call(&behind, 1);
    assert_eq!(repairs, Repairs::default(), "it became ready afterwards");
}

#[test]
fn a_message_behind_one_that_the_publisher_gave_up_is_late_for_the_gap() {
    is_late_until_given_up(|robot, number| robot.host.gap(robot.bob, number));
}

#[test]
fn a_message_behind_one_that_the_publisher_gave_up_is_late_for_the_heartbeat() {
    is_late_until_given_up(|robot, number| {
        let first = number + 1;
        robot.host.heartbeat(robot.bob, first, first);
    });
}

/// Checks what a submessage by which the publisher gives up a message explains.
fn is_late_until_given_up(give_up: impl Fn(&mut Robot, u64)) {
    let mut robot = Robot::new();
    let before = robot.publish();
    robot.arrive(&before);
    let lost = robot.publish();
    let behind = robot.publish();
    robot.arrive(&behind);
    robot.host.wait(50);
    // The publisher still has the lost message.
    robot.host.heartbeat(robot.bob, 1, robot.number);
    robot.host.wait(10);
    give_up(&mut robot, lost.sequence_number);
    robot.host.wait(2);
    let (repairs, stage, cause) = robot.call(&behind, 62);
    let since = Some(Duration::from_millis(2));
    assert_eq!((repairs.of_message, repairs.of_earlier), (None, since));
    assert_eq!((stage, cause), (Stage::Receive, Cause::Repaired));
    let (repairs, ..) = robot.call(&before, 262);
    assert_eq!(repairs, Repairs::default(), "it is older than the lost one");
    // Neither a submessage for messages that arrived nor a repeated one releases any.
    let late = robot.publish();
    robot.arrive(&late);
    robot.host.wait(50);
    give_up(&mut robot, lost.sequence_number);
    give_up(&mut robot, late.sequence_number);
    let (repairs, ..) = robot.call(&late, 50);
    assert_eq!(repairs, Repairs::default(), "nothing was missing");
}

#[test]
fn a_message_that_a_full_buffer_dropped_is_late_for_its_retransmission() {
    let mut robot = Robot::new();
    let dropped = robot.publish();
    robot.host.socket_full(robot.bob, robot.number);
    let behind = robot.publish();
    robot.arrive(&behind);
    robot.host.wait(50);
    robot.arrive(&dropped);
    let (repairs, stage, cause) = robot.call(&dropped, 150);
    assert_eq!(repairs.of_message, Some(Duration::ZERO));
    assert_eq!((stage, cause), (Stage::Network, Cause::Repaired));
}

#[test]
fn a_message_behind_a_lost_one_does_not_wait_for_it_beside_other_writers_or_best_effort_readers() {
    let second_writer = |robot: &mut Robot| {
        let payload = forge::endpoint(Guid::new(CAROL, WRITER), "rt/chatter", STRING, true);
        robot
            .host
            .participant(CAROL, "10.0.0.3:7415".parse().unwrap());
        robot
            .host
            .announce(Message::from(CAROL).data(SEDP_WRITERS, 1, &payload));
        let sample = robot.host.record(robot.bob, kind::DATA, 1);
        let writer = guid_words(Guid::new(CAROL, WRITER));
        robot.host.put(Record { writer, ..sample });
    };
    let best_effort = |robot: &mut Robot| {
        let guid = Guid::new(BOB, EntityId([0, 0, 0x14, 0x04]));
        let payload = forge::endpoint(guid, "rt/chatter", STRING, false);
        robot
            .host
            .announce(Message::from(BOB).data(SEDP_READERS, 2, &payload));
    };
    let cases: [&dyn Fn(&mut Robot); 2] = [&second_writer, &best_effort];
    for (case, prepare) in cases.into_iter().enumerate() {
        let mut robot = Robot::new();
        prepare(&mut robot);
        let lost = robot.publish();
        let behind = robot.publish();
        robot.arrive(&behind);
        robot.host.wait(50);
        robot.arrive(&lost);
        let (repairs, ..) = robot.call(&lost, 150);
        assert_eq!(repairs.of_message, Some(Duration::ZERO), "{case}");
        let (repairs, ..) = robot.call(&behind, 50);
        assert_eq!(repairs, Repairs::default(), "{case}");
    }
}

#[test]
fn messages_in_order_have_no_retransmission() {
    let mut robot = Robot::new();
    let slow = robot.publish();
    robot.host.wait(50);
    robot.arrive(&slow);
    let (repairs, ..) = robot.call(&slow, 50);
    assert_eq!(repairs, Repairs::default());
}
