//! Nodes that give their outputs new stamps.

use ros2probe_model::facts::diagnosis::Diagnosis;

use super::*;

/// Plays a sensor at 20 Hz and a filter that takes 12 ms. `stamp` returns the stamp of the filter's
/// output from the times of measurement and publication.
fn robot(every: u64, stamp: impl Fn(u64, u64) -> u64) -> Robot {
    let mut robot = Robot::new();
    robot.node("/sensor", &[], &["/points"]);
    robot.node("/filter", &["/points", "/plain"], &["/filtered"]);
    robot.node("/controller", &["/filtered"], &["/cmd"]);
    robot.start();
    play(&mut robot, every, stamp);
    robot
}

fn play(robot: &mut Robot, every: u64, stamp: impl Fn(u64, u64) -> u64) {
    let begin = robot.elapsed();
    for index in 0..300 {
        let at = robot.after(begin + index * 50 * MILLISECOND + 77 * index);
        robot.publish("/points", at, at - MILLISECOND);
        if index % every == 0 {
            let out = at + 12 * MILLISECOND;
            robot.publish("/filtered", out, stamp(at - MILLISECOND, out));
            let stamp = stamp(at - MILLISECOND, out);
            robot.publish("/cmd", out + 2 * MILLISECOND, stamp);
        }
    }
    robot.play_only();
    robot.wait(3_000 * MILLISECOND);
}

#[test]
fn a_restamping_node_is_a_finding_and_ends_the_chain() {
    let robot = robot(1, |_, out| out - 50 * MICROSECOND);
    let findings = robot.findings();
    let [Diagnosis::RestampingNode { topic, node, input }] = &findings[..] else {
        panic!("{findings:?}")
    };
    assert_eq!(
        (&*topic.name, &**node, &**input),
        ("/filtered", "/filter", "/points")
    );
    assert_eq!(robot.shown(), ["/filtered -[/controller]-> /cmd"]);
}

#[test]
fn a_restamping_node_is_found_again_after_the_robot_was_off() {
    let stamp = |_, out: u64| out - 50 * MICROSECOND;
    let mut robot = robot(1, stamp);
    assert_eq!(robot.findings().len(), 1);
    robot.stop();
    robot.wait(601_000 * MILLISECOND);
    assert_eq!(robot.findings(), []);
    robot.start();
    play(&mut robot, 1, stamp);
    assert_eq!(robot.findings().len(), 1);
}

#[test]
fn a_node_that_keeps_the_stamp_is_not_a_finding() {
    assert_eq!(robot(1, |measured, _| measured).findings(), []);
}

#[test]
fn a_node_with_its_own_output_rate_is_not_a_finding() {
    assert_eq!(robot(2, |_, out| out - 50 * MICROSECOND).findings(), []);
}

#[test]
fn a_node_whose_stamps_precede_its_publications_is_not_a_finding() {
    let robot = robot(1, |_, out| out - 8 * MILLISECOND);
    assert_eq!(robot.findings(), []);
}
