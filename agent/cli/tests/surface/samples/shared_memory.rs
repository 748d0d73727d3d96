//! Samples that are read from shared memory.

use super::*;

#[test]
fn a_sample_in_several_messages_of_shared_memory_is_delivered_complete() {
    let mut robot = Robot::new(Settings::default());
    robot.subscribe(&["/points"], Depth::Payloads);
    robot.at += SECOND;
    let large = payload(3000);
    for start in [1, 2, 3] {
        robot.receive(Message::from(ALICE).fragment(WRITER, 1, start, 1000, &large));
    }
    // Polling two ports may find the messages in another order, and twice.
    for (number, start) in [(3, 1), (2, 1), (2, 3), (3, 2), (2, 1), (2, 2), (3, 3)] {
        robot.receive(Message::from(ALICE).fragment(WRITER, number, start, 1000, &large));
    }
    let expected = [1, 2, 3].map(|number| (ALICE, number, Ok(large.clone())));
    let given = robot.payloads_of();
    let (whole, missed): (Vec<_>, Vec<_>) = given.into_iter().partition(|each| each.2.is_ok());
    // The last fragment of sample 2 was read while another one was missing, so the sample was given
    // up.
    assert_eq!(whole, [expected[0].clone(), expected[2].clone()]);
    assert_eq!(missed, [(ALICE, 2, Err(MissedReason::NotCaptured))]);
    robot.receive(Message::from(ALICE).data(WRITER, 4, &payload(24)));
    // A fragment was overwritten before it was read.
    for start in [1, 3] {
        robot.receive(Message::from(ALICE).fragment(WRITER, 5, start, 1000, &large));
    }
    let expected = [
        (ALICE, 4, Ok(payload(24))),
        (ALICE, 5, Err(MissedReason::NotCaptured)),
    ];
    assert_eq!(robot.payloads_of(), expected);
}

#[test]
fn missing_samples_of_shared_memory_delay_the_clock_and_are_then_reported() {
    let mut robot = Robot::new(Settings::default());
    robot.subscribe(&["/points"], Depth::Payloads);
    let small = payload(24);
    let look = |robot: &mut Robot, number| {
        robot.receive(Message::from(ALICE).data(WRITER, number, &small));
    };
    for number in [1, 2, 5] {
        look(&mut robot, number);
    }
    let given = |number| (ALICE, number, Ok(small.clone()));
    assert_eq!(robot.payloads_of(), [given(1), given(2), given(5)]);
    let sent = robot.at;
    let now = Timestamp(sent + SECOND / 20);
    robot.observer.input(Input::Time(now));
    assert!(robot.observer.dispatched_until(now).0 < sent);
    // One of the missing samples arrives late.
    look(&mut robot, 3);
    assert_eq!(robot.payloads_of(), [given(3)]);
    let now = Timestamp(sent + SECOND);
    robot.observer.input(Input::Time(now));
    assert_eq!(robot.observer.dispatched_until(now), now);
    let not_captured = (ALICE, 4, Err(MissedReason::NotCaptured));
    assert_eq!(robot.payloads_of(), [not_captured]);
    // At the end of a capture, the agent does not wait for missing samples.
    look(&mut robot, 8);
    robot.observer.input(Input::End);
    assert_eq!(
        robot.payloads_of(),
        [given(8), (ALICE, 6, Err(MissedReason::NotCaptured))]
    );
}

#[test]
fn a_repair_in_shared_memory_is_delivered_before_the_samples_that_waited_for_it() {
    let mut robot = Robot::new(Settings::default());
    let reader = Guid::new(BOB, EntityId([0, 0, 0x12, 0x04]));
    let subscription = forge::endpoint(reader, "rt/points", "a::msg::dds_::B_", true);
    robot.put(Message::from(BOB).data(SEDP_READERS, 1, &subscription));
    robot.subscribe(&["/points"], Depth::Payloads);
    let small = payload(24);
    let mut times = BTreeMap::new();
    // Sample 3 is sent again, and sample 5 was not read.
    for number in [1, 2, 4, 6, 3, 7] {
        robot.receive(Message::from(ALICE).data(WRITER, number, &small));
        times.insert(number, robot.at);
    }
    let now = Timestamp(robot.at + SECOND / 20);
    robot.observer.input(Input::Time(now));
    let end = Timestamp(robot.at + SECOND);
    let mut given = Vec::new();
    for now in [now, end] {
        robot.observer.input(Input::Time(now));
        for each in robot.observer.drain().samples {
            match each.outcome {
                SampleOutcome::Sample(sample) => {
                    given.push((sample.sequence_number.0, Some(sample.time.0)));
                }
                SampleOutcome::Missed(missed) => given.push((missed.first.0, None)),
            }
        }
    }
    // A reader delivers 4 after 3, and 6 on its arrival, because it may have received 5.
    let repaired = times[&3];
    let expected = [
        (1, Some(times[&1])),
        (2, Some(times[&2])),
        (3, Some(repaired)),
        (4, Some(repaired + 1)),
        (5, None),
        (6, Some(repaired + 2)),
        (7, Some(times[&7])),
    ];
    assert_eq!(given, expected);
}

#[test]
fn missing_last_samples_of_shared_memory_are_detected_by_an_acknowledgement() {
    let mut robot = Robot::new(Settings::default());
    robot.subscribe(&["/points"], Depth::Payloads);
    let small = payload(24);
    robot.receive(Message::from(ALICE).data(WRITER, 1, &small));
    // INFO_DST, and an ACKNACK of all sequence numbers below 4.
    let body = [
        &[0, 0, 0x12, 0x04][..],
        &WRITER.0,
        &[0, 0, 0, 0, 4, 0, 0, 0],
        &[0; 8],
    ];
    let acknowledgement = Message::from(BOB).submessage(0x0e, 0x01, &ALICE.0);
    robot.receive(acknowledgement.submessage(0x06, 0x03, &body.concat()));
    robot
        .observer
        .input(Input::Time(Timestamp(robot.at + SECOND / 20)));
    robot
        .observer
        .input(Input::Time(Timestamp(robot.at + SECOND)));
    let mut missed = 0;
    for each in robot.observer.drain().samples {
        if let SampleOutcome::Missed(each) = each.outcome {
            assert_eq!(each.reason, MissedReason::NotCaptured);
            missed += each.samples;
        }
    }
    assert_eq!(missed, 2);
}
