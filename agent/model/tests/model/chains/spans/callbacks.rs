//! Spans of publications within callbacks.

use ros2probe_model::derive::chain::causality::CausalPublication;
use ros2probe_model::observe::input::Input;
use ros2probe_wire::{DomainId, Timestamp};

use super::*;

const PROCESS: u32 = 7;

/// A publication within a callback that begins 200 µs after the take.
fn publication(
    (node, input, output): (&str, &str, &str),
    source: u64,
    taken: u64,
    published: u64,
) -> CausalPublication {
    CausalPublication {
        domain_id: DomainId(0),
        process: PROCESS,
        node: Some(node.into()),
        input: input.into(),
        input_source: Timestamp(source),
        taken: Timestamp(taken),
        started: Timestamp(taken + 200 * MICROSECOND),
        output: output.into(),
        published: Timestamp(published),
    }
}

/// A robot whose sensor's messages cause two messages of a filter, one of which causes a command.
fn play(robot: &mut Robot) {
    robot.node("/sensor", &[], &["/points"]);
    robot.start();
    for index in 0..20 {
        let at = robot.after(index * 50 * MILLISECOND);
        let taken = at + MILLISECOND;
        let (debug, filtered) = (at + 5 * MILLISECOND, at + 13 * MILLISECOND);
        let way = ("/filter", "/points", "/debug");
        let first = publication(way, at, taken, debug);
        let way = ("/filter", "/points", "/filtered");
        let second = publication(way, at, taken, filtered);
        // The source timestamp follows the publication by 30 µs.
        let (source, taken) = (filtered + 30 * MICROSECOND, filtered + 500 * MICROSECOND);
        let way = ("/drive", "/filtered", "/cmd");
        let third = publication(way, source, taken, taken + MILLISECOND);
        for each in [&first, &second, &third] {
            robot.observer.input(Input::CausalPublication(each));
        }
        robot.wait(50 * MILLISECOND);
    }
}

#[test]
fn callbacks_become_spans_between_publications() {
    let mut robot = Robot::tracing(&[("/points", 1.0)]);
    play(&mut robot);
    let spans = taken(&mut robot);
    let traces = by_trace(&spans);
    assert_eq!(traces.len(), 20);
    let expected = [
        "publish /points (/sensor) 0",
        "  transit /points (/filter) 1000",
        "  wait /points (/filter) 200",
        "  callback /points -> /debug (/filter) 3800",
        "    publish /debug (/filter) 0",
        "  callback /points -> /filtered (/filter) 11800",
        "    publish /filtered (/filter) 0",
        "      transit /filtered (/drive) 500",
        "      wait /filtered (/drive) 200",
        "      callback /filtered -> /cmd (/drive) 800",
        "        publish /cmd (/drive) 0",
    ];
    for trace in traces.values() {
        assert_eq!(tree(trace), expected);
        assert!(trace.iter().all(|span| span.id.is_of_host));
    }
    assert!(spans.iter().all(|span| span.method == Method::Causality));
    // The ids follow from the message.
    let mut again = Robot::tracing(&[("/points", 1.0)]);
    play(&mut again);
    assert_eq!(taken(&mut again), spans);
}

#[test]
fn the_share_of_the_first_input_selects_the_traces() {
    let mut robot = Robot::tracing(&[("/filtered", 1.0), ("/points", 0.5)]);
    play(&mut robot);
    let spans = taken(&mut robot);
    let traces = by_trace(&spans);
    assert!((3..18).contains(&traces.len()), "{}", traces.len());
    assert!(traces.values().all(|trace| trace.len() == 11));
    let mut robot = Robot::tracing(&[("/points", 1.0)]);
    let way = ("/filter", "/points", "/filtered");
    let at = robot.after(0);
    let unknown = publication(way, 0, at, at + MILLISECOND);
    robot.observer.input(Input::CausalPublication(&unknown));
    assert!(taken(&mut robot).is_empty(), "nothing identifies the input");
    let mut robot = Robot::tracing(&[("/filtered", 1.0), ("/points", 0.0)]);
    play(&mut robot);
    assert!(taken(&mut robot).is_empty());
}
