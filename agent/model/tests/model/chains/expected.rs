//! Configured chains.

use std::time::Duration;

use ros2probe_model::derive::chain::expected::{ChainState, ExpectedChain};
use ros2probe_model::facts::diagnosis::Diagnosis;
use ros2probe_model::facts::event::EventKind;

use super::*;

fn expected(from: &str, to: &str, milliseconds: u64) -> ExpectedChain {
    ExpectedChain {
        domain_id: None,
        from: from.into(),
        to: to.into(),
        max_latency: Some(Duration::from_millis(milliseconds)),
    }
}

#[test]
fn a_configured_chain_is_measured_and_is_a_finding_while_it_is_slow() {
    let mut robot = Robot::watching(&["/unrelated"]);
    robot.node("/sensor", &[], &["/points", "/other"]);
    robot.node("/filter", &["/points"], &["/filtered"]);
    robot.node("/controller", &["/filtered", "/other"], &["/cmd"]);
    robot.node("/viewer", &["/cmd"], &["/picture"]);
    robot.expect(vec![
        expected("/points", "/cmd", 14),
        expected("/cmd", "/none", 1),
    ]);
    robot.start();
    let play = |robot: &mut Robot, seconds: u64, slow: u64| {
        for index in seconds * 20..(seconds + 15) * 20 {
            let at = robot.after(index * 50 * MILLISECOND + 7 * index);
            robot.publish("/points", at, at);
            robot.publish("/filtered", at + slow * MILLISECOND, at);
            robot.publish("/cmd", at + (slow + 3) * MILLISECOND, at);
        }
        robot.play_only();
        robot.wait(3_000 * MILLISECOND);
    };
    play(&mut robot, 0, 5);
    let snapshot = robot.snapshot();
    let measured = snapshot
        .topics
        .iter()
        .filter(|topic| topic.measurement.is_some());
    let measured: Vec<_> = measured.map(|topic| topic.name.to_string()).collect();
    assert_eq!(measured, ["/cmd", "/filtered", "/points"]);
    let [ok, idle] = &snapshot.chains.expected[..] else {
        panic!("{:?}", snapshot.chains.expected)
    };
    assert_eq!(
        (ok.state, ok.method),
        (ChainState::Ok, Some(Method::Stamps))
    );
    near(ok.latency.unwrap().p99, 0.008);
    assert_eq!((idle.state, idle.latency), (ChainState::Idle, None));
    assert_eq!(robot.findings(), []);

    play(&mut robot, 20, 20);
    let findings = robot.findings();
    let [
        Diagnosis::SlowChain {
            topic,
            from,
            max_latency,
        },
    ] = &findings[..]
    else {
        panic!("{findings:?}")
    };
    assert_eq!((&*topic.name, &**from), ("/cmd", "/points"));
    assert_eq!(*max_latency, Duration::from_millis(14));
    play(&mut robot, 40, 5);
    assert_eq!(robot.findings(), []);
    let events = robot.observer.drain().events.events;
    let changes = events.iter().filter_map(|event| match &event.kind {
        EventKind::Diagnosis {
            resolved,
            finding: Diagnosis::SlowChain { .. },
        } => Some(*resolved),
        _ => None,
    });
    assert_eq!(changes.collect::<Vec<_>>(), [false, true]);

    robot.expect(Vec::new());
    robot.wait(2_000 * MILLISECOND);
    let snapshot = robot.snapshot();
    assert!(snapshot.chains.expected.is_empty());
    assert_eq!(snapshot.topics_measured, 0);
}
