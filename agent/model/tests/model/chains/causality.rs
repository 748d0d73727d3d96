//! Chains of publications within callbacks.

use ros2probe_model::derive::chain::causality::CausalPublication;
use ros2probe_model::observe::input::Input;
use ros2probe_wire::{DomainId, Timestamp};

use super::*;

fn hop(node: &str, ends: (&str, &str), source: u64, taken: u64, done: u64) -> CausalPublication {
    CausalPublication {
        domain_id: DomainId(0),
        process: 1,
        node: Some(node.into()),
        input: ends.0.into(),
        input_source: Timestamp(source),
        taken: Timestamp(taken),
        started: Timestamp(taken + 200 * MICROSECOND),
        output: ends.1.into(),
        published: Timestamp(done),
    }
}

#[test]
fn publications_within_callbacks_are_joined_by_their_messages() {
    let mut robot = Robot::new();
    robot.start();
    for index in 0..50 {
        let at = robot.after(index * 50 * MILLISECOND);
        let out = at + 13 * MILLISECOND;
        let filter = hop(
            "/filter",
            ("/points", "/filtered"),
            at,
            at + MILLISECOND,
            out,
        );
        // The source timestamp follows the publication by 30 µs.
        let (source, taken) = (out + 30 * MICROSECOND, out + 500 * MICROSECOND);
        let drive = hop(
            "/drive",
            ("/filtered", "/cmd"),
            source,
            taken,
            taken + MILLISECOND,
        );
        for publication in [&filter, &drive] {
            robot.observer.input(Input::CausalPublication(publication));
        }
        robot.wait(50 * MILLISECOND);
    }
    robot.wait(3_000 * MILLISECOND);
    let [chain] = &robot.chains()[..] else {
        panic!("{:?}", robot.chains())
    };
    assert_eq!(chain.path.method, Method::Causality);
    assert_eq!(
        shown(chain),
        "/points -[/filter]-> /filtered -[/drive]-> /cmd"
    );
    assert_eq!(chain.count, 50);
    let first = chain.hop(0);
    near(first.whole.p50, 0.013);
    near(first.transit.unwrap().p50, 0.001);
    near(first.wait.unwrap().p50, 0.0002);
    near(first.callback.unwrap().p50, 0.0118);
    near(chain.hop(1).transit.unwrap().p50, 0.0005);
    near(chain.between(0, 2).p50, 0.0145);
}

#[test]
fn a_chain_from_a_message_without_a_source_timestamp_begins_when_it_is_taken() {
    let mut robot = Robot::new();
    robot.start();
    for index in 0..10 {
        let at = robot.after(index * 50 * MILLISECOND);
        let way = ("/points", "/filtered");
        let publication = hop("/filter", way, 0, at, at + 3 * MILLISECOND);
        robot.observer.input(Input::CausalPublication(&publication));
        robot.wait(50 * MILLISECOND);
    }
    robot.wait(3_000 * MILLISECOND);
    let [chain] = &robot.chains()[..] else {
        panic!("{:?}", robot.chains())
    };
    let hop = chain.hop(0);
    near(hop.whole.max, 0.003);
    near(hop.callback.unwrap().max, 0.0028);
    assert_eq!((hop.transit, hop.wait), (None, None));
}

#[test]
fn a_publication_of_another_time_or_topic_begins_its_own_chain() {
    let mut robot = Robot::new();
    robot.start();
    for index in 0..20 {
        let at = robot.after(index * 50 * MILLISECOND);
        let out = at + MILLISECOND;
        let filter = hop("/filter", ("/points", "/filtered"), at, at + 500, out);
        // 20 ms after the publication, the source timestamp belongs to another message.
        let source = out + 20 * MILLISECOND;
        let drive = hop(
            "/drive",
            ("/filtered", "/cmd"),
            source,
            source + 500,
            source + MILLISECOND,
        );
        for publication in [&filter, &drive] {
            robot.observer.input(Input::CausalPublication(publication));
        }
        robot.wait(50 * MILLISECOND);
    }
    robot.wait(3_000 * MILLISECOND);
    let expected = [
        "/filtered -[/drive]-> /cmd",
        "/points -[/filter]-> /filtered",
    ];
    assert_eq!(robot.shown(), expected);
}

/// Before the fix, the chain had no source node. A process older than the agent had no node,
/// although discovery names both.
#[test]
fn nodes_of_a_process_older_than_the_agent_are_found_by_discovery() {
    let mut robot = Robot::new();
    robot.node("/sensor", &[], &["/points"]);
    robot.node("/filter", &["/points"], &["/filtered"]);
    let play = |robot: &mut Robot, from: u64| {
        for index in from..from + 20 {
            let at = robot.after(index * 50 * MILLISECOND);
            let way = ("/points", "/filtered");
            let mut filter = hop("/filter", way, at, at + 500, at + MILLISECOND);
            filter.node = None;
            robot.observer.input(Input::CausalPublication(&filter));
            robot.wait(50 * MILLISECOND);
        }
        robot.wait(3_000 * MILLISECOND);
    };
    // Before the announcement of the nodes, none is named.
    play(&mut robot, 0);
    let [chain] = &robot.chains()[..] else {
        panic!("{:?}", robot.chains())
    };
    assert_eq!(shown(chain), "/points -[?]-> /filtered");
    robot.start();
    play(&mut robot, 200);
    let [chain] = &robot.chains()[..] else {
        panic!("{:?}", robot.chains())
    };
    assert_eq!(shown(chain), "/points -[/filter]-> /filtered");
    assert_eq!(chain.path.topics[0].1.as_deref(), Some("/sensor"));
    assert_eq!(chain.count, 40);
}
