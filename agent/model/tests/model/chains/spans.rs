//! Spans of chains: their times, their parents, and which of them are exported.

mod callbacks;
mod hosts;

use std::collections::{BTreeMap, BTreeSet};

use ros2probe_model::derive::chain::spans::{ChainSpan, ChainSpans, SpanId};
use ros2probe_model::derive::trace::Message;
use ros2probe_model::facts::tables::FinishedChainSpans;

use super::*;

/// Returns the spans of each trace.
fn by_trace(spans: &[ChainSpan]) -> BTreeMap<u128, Vec<&ChainSpan>> {
    let mut traces: BTreeMap<u128, Vec<&ChainSpan>> = BTreeMap::new();
    for span in spans {
        traces.entry(span.trace_id).or_default().push(span);
    }
    traces
}

/// Returns the spans of one trace as a tree: indented by their parents, with their durations in
/// microseconds, sorted by their start.
fn tree(trace: &[&ChainSpan]) -> Vec<String> {
    let mut lines = Vec::new();
    let ids: BTreeSet<SpanId> = trace.iter().map(|span| span.id).collect();
    assert_eq!(ids.len(), trace.len(), "ids are unique: {trace:#?}");
    let has_parent = |span: &&ChainSpan| span.parent.is_some_and(|parent| ids.contains(&parent));
    let mut roots: Vec<_> = trace.to_vec();
    roots.retain(|span| !has_parent(span));
    roots.sort_by_key(|span| (span.begin, span.stage));
    for root in roots {
        grow(root, 0, trace, &mut lines);
    }
    assert_eq!(lines.len(), trace.len(), "no span is its own ancestor");
    lines
}

fn grow(span: &ChainSpan, depth: usize, trace: &[&ChainSpan], lines: &mut Vec<String>) {
    let node = span.node.as_deref().unwrap_or("?");
    let output = span.output.as_deref();
    let output = output.map_or_else(String::new, |output| format!(" -> {output}"));
    let duration = (span.end.0 - span.begin.0) as f64 / 1e3;
    lines.push(format!(
        "{}{} {}{output} ({node}) {duration}",
        "  ".repeat(depth),
        span.stage.label(),
        span.topic,
    ));
    let mut children: Vec<_> = trace.to_vec();
    children.retain(|child| child.parent == Some(span.id));
    children.sort_by_key(|child| (child.begin, child.stage));
    for child in children {
        grow(child, depth + 1, trace, lines);
    }
}

fn taken(robot: &mut Robot) -> Vec<ChainSpan> {
    let ChainSpans { spans, lost } = robot.observer.drain().chain_spans;
    assert_eq!(lost, 0);
    spans.to_vec()
}

const WHOLE: [&str; 7] = [
    "publish /points (/sensor) 100",
    "  transit /points (/filter) 100",
    "  node /points -> /filtered (/filter) 11900",
    "    publish /filtered (/filter) 100",
    "      transit /filtered (/controller) 100",
    "      node /filtered -> /cmd (/controller) 2900",
    "        publish /cmd (/controller) 100",
];

#[test]
fn a_measurement_becomes_one_trace_with_the_times_of_each_hop() {
    let mut robot = pipeline_of(Robot::tracing(&[("/**", 1.0)]), 100);
    robot.play();
    let spans = taken(&mut robot);
    let chains = robot.chains();
    let traces = by_trace(&spans);
    let whole: Vec<_> = traces.values().filter(|trace| trace.len() == 7).collect();
    assert_eq!(whole.len() as u64, chains[0].count);
    for trace in &whole {
        assert_eq!(tree(trace), WHOLE);
    }
    // Before the second hop was accepted, the chain had only one hop.
    assert!(traces.len() <= whole.len() + 4, "{}", traces.len());

    // The spans begin and end at the points of the chain.
    let begins: BTreeSet<u64> = spans.iter().map(|span| span.begin.0).collect();
    for points in chains[0].traces.iter() {
        for point in points {
            let arrived = point.arrived.map_or(point.published, |at| at);
            assert!(begins.contains(&point.published.0) && begins.contains(&arrived.0));
        }
    }
    let first = whole[0].iter().find(|span| span.parent.is_none()).unwrap();
    let message = first.message.as_ref().unwrap();
    assert_eq!(&*message.message_type, "sensor_msgs/msg/PointCloud2");
    assert_eq!(message.size, 20);
    let (seconds, nanoseconds) = message.stamp;
    let stamp = u64::try_from(seconds).unwrap() * 1_000_000_000 + u64::from(nanoseconds);
    assert_eq!(first.begin.0 - stamp, 400 * MICROSECOND);
    let own = Message::identity(message.writer, message.sequence_number);
    assert_eq!(message.own_trace, Some(own), "its own trace is exported");
}

#[test]
fn a_share_of_the_first_topic_selects_the_same_whole_traces_each_time() {
    let traces = |share: f64| {
        let shares = [("/points", share), ("/filtered", 0.0), ("/cmd", 1.0)];
        let mut robot = pipeline_of(Robot::tracing(&shares), 200);
        robot.play();
        let spans = taken(&mut robot);
        let traces = by_trace(&spans);
        let whole = traces.into_iter().filter(|(_, trace)| trace.len() == 7);
        whole.map(|(id, _)| id).collect::<BTreeSet<_>>()
    };
    let (all, half, none) = (traces(1.0), traces(0.5), traces(0.0));
    assert!(all.len() > 190 && none.is_empty());
    assert!((60..140).contains(&half.len()), "{}", half.len());
    assert!(half.is_subset(&all));
    assert_eq!(half, traces(0.5));
}

#[test]
fn branches_share_one_trace_in_which_each_span_occurs_once() {
    let shares = [("/image", 1.0), ("/objects", 0.0), ("/thumbnail", 0.0)];
    let others = [("/debug", 0.0), ("/plan", 0.0)];
    let mut robot = Robot::tracing(&[&shares[..], &others].concat());
    robot.node("/camera", &[], &["/image"]);
    robot.node("/detector", &["/image"], &["/objects", "/debug"]);
    robot.node("/recorder", &["/image"], &["/thumbnail"]);
    robot.node("/planner", &["/objects"], &["/plan"]);
    robot.start();
    for index in 0..50 {
        let at = robot.after(index * 33 * MILLISECOND + 7 * index);
        robot.publish("/image", at, at);
        robot.publish("/thumbnail", at + 5 * MILLISECOND, at);
        robot.publish("/debug", at + 10 * MILLISECOND, at);
        robot.publish("/objects", at + 20 * MILLISECOND, at);
        robot.publish("/plan", at + 25 * MILLISECOND, at);
    }
    robot.play();
    let spans = taken(&mut robot);
    let traces = by_trace(&spans);
    let last = traces.values().max_by_key(|trace| trace[0].begin).unwrap();
    let expected = [
        "publish /image (/camera) 100",
        "  transit /image (/detector) 100",
        "  transit /image (/recorder) 100",
        "  node /image -> /thumbnail (/recorder) 4900",
        "    publish /thumbnail (/recorder) 100",
        "  node /image -> /debug (/detector) 9900",
        "    publish /debug (/detector) 100",
        "  node /image -> /objects (/detector) 19900",
        "    publish /objects (/detector) 100",
        "      transit /objects (/planner) 100",
        "      node /objects -> /plan (/planner) 4900",
        "        publish /plan (/planner) 100",
    ];
    assert_eq!(
        sorted(tree(last)),
        sorted(expected.map(str::to_owned).into())
    );
}

fn sorted(mut lines: Vec<String>) -> Vec<String> {
    lines.sort();
    lines
}

/// Returns the traces of a sensor and a filter whose measurements have these stamps, the first
/// publication at `begin`.
fn traces_with(begin: u64, stamp: impl Fn(u64, u64) -> u64) -> BTreeSet<u128> {
    let mut robot = Robot::tracing(&[("/**", 1.0)]);
    robot.node("/sensor", &[], &["/points"]);
    robot.node("/filter", &["/points"], &["/filtered"]);
    robot.start();
    for index in 0..60 {
        let at = robot.after(begin + index * 50 * MILLISECOND);
        let stamp = stamp(index, at);
        robot.publish("/points", at, stamp);
        robot.publish("/filtered", at + MILLISECOND, stamp);
    }
    robot.play();
    let spans = taken(&mut robot);
    let traces = by_trace(&spans);
    assert!(traces.len() > 30 && traces.values().all(|trace| trace.len() == 4));
    traces.into_keys().collect()
}

#[test]
fn repeated_stamps_do_not_join_the_traces_of_two_measurements() {
    // Writer and numbers are the same in both runs, but each stamp has another number.
    for coarse in [50 * MILLISECOND, 1000] {
        let first = |index, _| (1 + index) * coarse;
        let other = |index, _| (2 + index) * coarse;
        let (one, two) = (traces_with(0, first), traces_with(0, other));
        assert!(one.is_disjoint(&two), "the stamp is not the whole identity");
    }
    // A stamp of the present with nanoseconds identifies a measurement.
    let fine = |_, at| at - 777;
    let later = 3 * 50 * MILLISECOND;
    let (one, two) = (traces_with(0, fine), traces_with(later, fine));
    assert!(
        one.intersection(&two).count() > 40,
        "they have other numbers"
    );
}

#[test]
fn without_a_traced_watch_no_span_is_exported() {
    let mut robot = pipeline(100);
    robot.play();
    assert!(!robot.chains().is_empty());
    assert!(taken(&mut robot).is_empty());
}

#[test]
fn spans_beyond_the_cap_are_counted() {
    let count = 800;
    let mut robot = pipeline_of(Robot::tracing(&[("/**", 1.0)]), count);
    robot.play();
    let whole = robot.chains()[0].count;
    let ChainSpans { spans, lost } = robot.observer.drain().chain_spans;
    assert_eq!(spans.len(), FinishedChainSpans::CAP);
    let all = spans.len() as u64 + lost;
    assert!(all >= 7 * whole && all <= 7 * count, "{all} of {whole}");
    assert!(robot.observer.drain().chain_spans.spans.is_empty());
}
