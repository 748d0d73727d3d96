//! Chains by stamps and by causality, in virtual time, and traps that must not yield a hop.

mod captured;
mod causality;
mod expected;
mod fixtures;
mod restamping;
mod spans;
mod traps;

use ros2probe_model::derive::chain::path::ChainFacts;
use ros2probe_model::derive::chain::trace::Method;

use fixtures::{MICROSECOND, Robot, hops, near, shown};

const MILLISECOND: u64 = 1000 * MICROSECOND;

/// Returns a robot with `count` planned measurements of a sensor at 20 Hz. Its filter takes 12 ms,
/// its controller 3 ms.
fn pipeline(count: u64) -> Robot {
    pipeline_of(Robot::new(), count)
}

fn pipeline_of(mut robot: Robot, count: u64) -> Robot {
    robot.node("/sensor", &[], &["/points"]);
    robot.node("/filter", &["/points"], &["/filtered"]);
    robot.node("/controller", &["/filtered"], &["/cmd"]);
    robot.start();
    for index in 0..count {
        let at = robot.after(index * 50 * MILLISECOND + 137 * index);
        robot.publish("/points", at, at - 400 * MICROSECOND);
        robot.publish("/filtered", at + 12 * MILLISECOND, at - 400 * MICROSECOND);
        robot.publish("/cmd", at + 15 * MILLISECOND, at - 400 * MICROSECOND);
    }
    robot
}

#[test]
fn a_pipeline_becomes_one_chain_with_the_time_of_each_hop() {
    let mut robot = pipeline(100);
    robot.play();
    let [chain] = &robot.chains()[..] else {
        panic!("{:?}", robot.chains())
    };
    assert_eq!(
        shown(chain),
        "/points -[/filter]-> /filtered -[/controller]-> /cmd"
    );
    assert_eq!(chain.path.method, Method::Stamps);
    assert_eq!(chain.path.topics[0].1.as_deref(), Some("/sensor"));
    // Each of the two hops in turn needs four messages as evidence.
    assert!((90..=96).contains(&chain.count), "{}", chain.count);
    let filter = chain.hop(0);
    near(filter.whole.p50, 0.012);
    near(filter.whole.p99, 0.012);
    near(filter.transit.unwrap().p50, 0.000_1);
    near(filter.node.unwrap().p50, 0.0119);
    assert_eq!((filter.wait, filter.callback), (None, None));
    near(chain.hop(1).whole.max, 0.003);
    near(chain.between(0, 2).p50, 0.015);
    near(chain.whole.sum() / chain.whole.count() as f64, 0.015);
}

#[test]
fn quantiles_cover_only_the_latest_messages() {
    let mut robot = pipeline(300);
    robot.play();
    let chains = robot.chains();
    assert!(chains[0].count > 290, "{}", chains[0].count);
    assert_eq!(chains[0].traces.len(), 256);
    assert_eq!(chains[0].hop(1).whole.count, 256);
}

#[test]
fn branches_and_dropped_messages_yield_only_whole_chains() {
    let mut robot = Robot::new();
    robot.node("/camera", &[], &["/image", "/camera_info"]);
    robot.node("/detector", &["/image"], &["/objects"]);
    robot.node("/recorder", &["/image", "/objects"], &["/thumbnail"]);
    robot.node("/planner", &["/objects"], &["/plan"]);
    robot.start();
    for index in 0..200 {
        let at = robot.after(index * 33 * MILLISECOND + 7 * index);
        robot.publish("/image", at, at);
        robot.publish("/camera_info", at + 10, at);
        robot.publish("/objects", at + 20 * MILLISECOND, at);
        robot.publish("/thumbnail", at + 5 * MILLISECOND, at);
        if index % 3 == 0 {
            robot.publish("/plan", at + 25 * MILLISECOND, at);
        }
    }
    robot.play();
    let expected = [
        "/image -[/detector]-> /objects -[/planner]-> /plan",
        "/image -[/recorder]-> /thumbnail",
    ];
    assert_eq!(robot.shown(), expected);
}

#[test]
fn a_fusion_node_continues_only_the_longest_path() {
    let mut robot = Robot::new();
    robot.node("/lidar", &[], &["/scan"]);
    robot.node("/filter", &["/scan"], &["/clean"]);
    robot.node("/fusion", &["/scan", "/clean"], &["/map"]);
    robot.start();
    for index in 0..50 {
        let at = robot.after(index * 100 * MILLISECOND + 991 * index);
        robot.publish("/scan", at, at);
        robot.publish("/clean", at + 10 * MILLISECOND, at);
        robot.publish("/map", at + 30 * MILLISECOND, at);
    }
    robot.play();
    assert_eq!(
        robot.shown(),
        ["/scan -[/filter]-> /clean -[/fusion]-> /map"]
    );
}

#[test]
fn a_multiplexer_continues_each_of_its_inputs() {
    let mut robot = Robot::new();
    robot.node("/joystick", &[], &["/manual"]);
    robot.node("/planner", &[], &["/automatic"]);
    robot.node("/mux", &["/manual", "/automatic"], &["/cmd"]);
    robot.start();
    for index in 0..120 {
        let at = robot.after(index * 50 * MILLISECOND + 77 * index);
        let other = at + 9 * MILLISECOND;
        robot.publish("/manual", at, at);
        robot.publish("/automatic", other, other);
        let chosen = if index / 20 % 2 == 0 { at } else { other };
        robot.publish("/cmd", chosen + MILLISECOND, chosen);
    }
    robot.play();
    let expected = ["/automatic -[/mux]-> /cmd", "/manual -[/mux]-> /cmd"];
    assert_eq!(robot.shown(), expected);
}

#[test]
fn stamps_in_simulated_time_from_one_origin_yield_a_chain() {
    let mut robot = Robot::new();
    robot.node("/sensor", &[], &["/points"]);
    robot.node("/filter", &["/points"], &["/filtered"]);
    robot.start();
    for index in 0..100 {
        let at = robot.after(index * 50 * MILLISECOND);
        let simulated = (5 + index) * 50 * MILLISECOND;
        robot.publish("/points", at, simulated);
        robot.publish("/filtered", at + 2 * MILLISECOND, simulated);
    }
    robot.play();
    assert_eq!(robot.shown(), ["/points -[/filter]-> /filtered"]);
}

#[test]
fn the_end_of_the_input_completes_chains() {
    let mut robot = pipeline(9);
    robot.play_only();
    assert_eq!(hops(&robot.chains()).len(), 0);
    robot.end();
    // The evidence for a hop is complete at the fifth message.
    let count = |chain: &ChainFacts| chain.count;
    let counts: Vec<_> = robot.chains().iter().map(count).collect();
    assert_eq!(counts, [5]);
}
