//! Equal stamps that are not evidence of a hop.

use super::*;

/// A generator of numbers that look random (xorshift).
struct Random(u64);

impl Random {
    fn below(&mut self, limit: u64) -> u64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        self.0 % limit
    }
}

/// Fifty nodes, each with a topic of its own and five inputs, published at 10 Hz for a minute.
/// `stamp` derives the stamp from the time of publication, `phase` the node's phase in a period.
fn crowd(stamp: impl Fn(u64) -> u64, mut phase: impl FnMut(&mut Random, u64) -> u64) -> Robot {
    let mut random = Random(0x9e37_79b9_7f4a_7c15);
    let mut robot = Robot::new();
    let name = |number: u64| format!("/topic{number}");
    for number in 0..50 {
        let mut inputs = Vec::new();
        while inputs.len() < 5 {
            let input = name(random.below(50));
            if input != name(number) && !inputs.contains(&input) {
                inputs.push(input);
            }
        }
        let inputs: Vec<_> = inputs.iter().map(String::as_str).collect();
        robot.node(&format!("/node{number}"), &inputs, &[&name(number)]);
    }
    robot.start();
    for period in 0..600 {
        for number in 0..50 {
            let offset = phase(&mut random, number);
            let at = robot.after(period * 100 * MILLISECOND + offset);
            robot.publish(&name(number), at, stamp(at));
        }
    }
    robot.play();
    robot
}

#[test]
fn exact_stamps_of_fifty_unrelated_nodes_yield_no_hop() {
    let robot = crowd(
        |at| at,
        |random, number| number * MILLISECOND + random.below(50 * MICROSECOND),
    );
    assert_eq!(hops(&robot.chains()), [""; 0]);
}

#[test]
fn rounded_stamps_of_timers_yield_no_hop_at_any_phase() {
    let rounded = |at: u64| at - at % (100 * MILLISECOND);
    let fixed = crowd(rounded, |_, number| (number + 1) * MILLISECOND);
    assert_eq!(hops(&fixed.chains()), [""; 0]);
    let jittered = crowd(rounded, |random, _| random.below(90 * MILLISECOND));
    assert_eq!(hops(&jittered.chains()), [""; 0]);
}

#[test]
fn stamps_of_all_nodes_in_simulated_time_yield_no_hop() {
    // Simulated time in steps of 1/60 s, which are not round in nanoseconds.
    let step = 16_666_666;
    let simulated = |at: u64| 7_000_000_000 + (at / step) * step;
    let robot = crowd(simulated, |random, number| {
        number * MILLISECOND + random.below(MILLISECOND)
    });
    assert_eq!(hops(&robot.chains()), [""; 0]);
}

#[test]
fn true_hops_are_found_among_fifty_nodes_with_five_inputs() {
    let mut random = Random(0x1234_5678_9abc_def1);
    let mut robot = Robot::new();
    // Ten pipelines of five nodes, where each node also reads four topics of other pipelines.
    let name = |line: u64, place: u64| format!("/line{line}/topic{place}");
    let mut expected = Vec::new();
    for line in 0..10 {
        for place in 0..5 {
            let mut inputs = Vec::new();
            if place > 0 {
                inputs.push(name(line, place - 1));
                expected.push(format!(
                    "{} -[/node{line}_{place}]-> {}",
                    name(line, place - 1),
                    name(line, place)
                ));
            }
            while inputs.len() < 5 {
                let input = name((line + 1 + random.below(9)) % 10, random.below(5));
                if !inputs.contains(&input) {
                    inputs.push(input);
                }
            }
            let inputs: Vec<_> = inputs.iter().map(String::as_str).collect();
            robot.node(
                &format!("/node{line}_{place}"),
                &inputs,
                &[&name(line, place)],
            );
        }
    }
    expected.sort();
    robot.start();
    for period in 0..100 {
        for line in 0..10 {
            let at = robot.after(period * 100 * MILLISECOND + line * 371 * MICROSECOND);
            let mut end = at;
            for place in 0..5 {
                robot.publish(&name(line, place), end, at);
                end += MILLISECOND + random.below(8 * MILLISECOND);
            }
        }
    }
    robot.play();
    assert_eq!(hops(&robot.chains()), expected);
}

#[test]
fn two_independent_inputs_with_one_stamp_yield_no_hop() {
    let mut robot = Robot::new();
    robot.node("/camera", &[], &["/left", "/right"]);
    robot.node("/stereo", &["/left", "/right"], &["/depth"]);
    robot.start();
    for index in 0..100 {
        let at = robot.after(index * 50 * MILLISECOND + 77 * index);
        robot.publish("/left", at, at);
        robot.publish("/right", at + 100, at);
        robot.publish("/depth", at + 5 * MILLISECOND, at);
    }
    robot.play();
    assert_eq!(hops(&robot.chains()), [""; 0]);
}

#[test]
fn an_input_after_the_output_is_not_its_cause() {
    let mut robot = Robot::new();
    robot.node("/camera", &[], &["/left", "/right"]);
    robot.node("/filter", &["/left", "/right"], &["/edges"]);
    robot.start();
    for index in 0..100 {
        let at = robot.after(index * 50 * MILLISECOND + 77 * index);
        robot.publish("/left", at, at);
        robot.publish("/edges", at + 5 * MILLISECOND, at);
        robot.publish("/right", at + 9 * MILLISECOND, at);
    }
    robot.play();
    assert_eq!(hops(&robot.chains()), ["/left -[/filter]-> /edges"]);
}

#[test]
fn a_feedback_loop_yields_a_finite_chain() {
    let mut robot = Robot::new();
    robot.node("/sensor", &[], &["/state"]);
    robot.node("/controller", &["/state", "/response"], &["/cmd"]);
    robot.node("/drive", &["/cmd"], &["/response"]);
    robot.start();
    for index in 0..100 {
        let at = robot.after(index * 50 * MILLISECOND + 77 * index);
        robot.publish("/state", at, at);
        robot.publish("/cmd", at + 2 * MILLISECOND, at);
        robot.publish("/response", at + 4 * MILLISECOND, at);
    }
    robot.play();
    let expected = ["/state -[/controller]-> /cmd -[/drive]-> /response"];
    assert_eq!(robot.shown(), expected);
}

#[test]
fn unset_and_repeated_stamps_yield_no_hop() {
    let mut robot = Robot::new();
    robot.node("/sensor", &[], &["/points"]);
    robot.node("/filter", &["/points"], &["/filtered"]);
    robot.start();
    let constant = robot.after(0);
    for index in 0..200 {
        let at = robot.after(index * 50 * MILLISECOND);
        let stamp = if index % 2 == 0 { 0 } else { constant };
        robot.publish("/points", at, stamp);
        robot.publish("/filtered", at + MILLISECOND, stamp);
    }
    robot.play();
    assert_eq!(hops(&robot.chains()), [""; 0]);
}

#[test]
fn a_stamp_that_too_many_messages_carry_yields_no_hop() {
    for (count, expected) in [(20, vec!["/points -[/filter]-> /filtered"]), (80, vec![])] {
        let mut robot = Robot::new();
        let others: Vec<_> = (0..count).map(|number| format!("/other{number}")).collect();
        let mut outputs: Vec<_> = others.iter().map(String::as_str).collect();
        outputs.push("/points");
        robot.node("/sensor", &[], &outputs);
        robot.node("/filter", &["/points"], &["/filtered"]);
        robot.start();
        for index in 0..20 {
            let at = robot.after(index * 50 * MILLISECOND + 77 * index);
            outputs
                .iter()
                .for_each(|topic| robot.publish(topic, at, at));
            robot.publish("/filtered", at + MILLISECOND, at);
        }
        robot.play();
        assert_eq!(hops(&robot.chains()), expected);
    }
}

#[test]
fn a_flood_of_stamps_stays_within_the_caps() {
    let mut robot = Robot::new();
    robot.node("/sensor", &[], &["/points"]);
    robot.node("/filter", &["/points"], &["/filtered"]);
    robot.start();
    for index in 0..60_000 {
        let at = robot.after(index * 10 * MICROSECOND);
        robot.publish("/points", at, at + index);
    }
    robot.play_only();
    let tables = robot.snapshot().tables;
    let messages = tables.iter().find(|table| table.table == "chain_messages");
    assert!(messages.unwrap().evictions > 20_000, "{messages:?}");
    robot.wait(20_000 * MILLISECOND);
    let tables = robot.snapshot().tables;
    let messages = tables.iter().find(|table| table.table == "chain_messages");
    assert_eq!(messages.unwrap().size, 0);
}
