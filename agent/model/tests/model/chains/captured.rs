//! The chain of real nodes in a capture, compared with the log of the nodes.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use ros2probe_capture::frame_decoder::FrameDecoder;
use ros2probe_capture::pcap::PcapReader;
use ros2probe_capture::reassembly::Limits;
use ros2probe_model::derive::chain::spans::ChainSpan;
use ros2probe_model::facts::diagnosis::Diagnosis;
use ros2probe_model::facts::event::EventKind;
use ros2probe_model::facts::watch::{Watch, Watchlist};
use ros2probe_model::observe::input::Input;
use ros2probe_model::observe::observer::{Observer, Settings};
use ros2probe_wire::Expansion;

use super::*;

/// Maximum difference between a median and that of the logs, in seconds.
const CLOSE: f64 = 0.000_2;
/// Columns of `truth.csv`.
const SENSOR: usize = 1;
const FILTER: [usize; 2] = [2, 3];
const CONTROLLER: [usize; 2] = [4, 5];

/// Results of the model for the capture.
struct Found {
    chains: Vec<ChainFacts>,
    restamping: Vec<String>,
    spans: Vec<ChainSpan>,
}

fn data() -> PathBuf {
    let data = Path::new(env!("CARGO_MANIFEST_DIR"));
    data.join("../testing/data/fastrtps-udp/chain-1ns")
}

/// Returns the rows of the nodes' log.
fn logged() -> Vec<Vec<u64>> {
    let text = std::fs::read_to_string(data().join("truth.csv")).unwrap();
    let rows = text.lines().skip(1).map(|line| {
        let numbers = line.split(',').map(|number| number.parse().unwrap());
        numbers.collect::<Vec<u64>>()
    });
    rows.collect()
}

/// Replays the capture with this traced share of all topics.
fn replay(trace: f64) -> Found {
    let mut observer = Observer::new(Settings {
        directed: false,
        ..Settings::default()
    });
    let watch = Watch {
        trace,
        ..Watch::named("/**").unwrap()
    };
    let watchlist = Watchlist::new(vec![watch]).unwrap();
    observer.input(Input::Watchlist(Arc::new(watchlist)));
    let mut reader = PcapReader::open(&data().join("capture.pcap.gz"), Expansion::Limited).unwrap();
    let mut feed = FrameDecoder::new(Limits::default());
    let (mut restamping, mut spans) = (Vec::new(), Vec::new());
    while let Some(captured) = reader.next_packet().unwrap() {
        feed.packet(&captured, &mut observer);
        let output = observer.drain();
        spans.extend(output.chain_spans.spans);
        for event in output.events.events {
            if let EventKind::Diagnosis {
                resolved: false,
                finding: Diagnosis::RestampingNode { node, topic, input },
            } = event.kind
            {
                restamping.push(format!("{node}: {input} -> {}", topic.name));
            }
        }
    }
    observer.input(Input::End);
    spans.extend(observer.drain().chain_spans.spans);
    Found {
        chains: observer.snapshot(feed.last()).chains.chains,
        restamping,
        spans,
    }
}

#[test]
fn hops_of_real_nodes_in_a_capture_take_as_long_as_the_nodes_logged() {
    let Found {
        chains, restamping, ..
    } = replay(0.0);
    assert_eq!(restamping, ["/restamper: /points -> /fresh"]);
    let [chain] = &chains[..] else {
        panic!("{chains:?}")
    };
    assert_eq!(
        shown(chain),
        "/points -[/filter]-> /filtered -[/controller]-> /cmd"
    );
    let rows = logged();
    assert!(rows.len() > 150 && chain.count + 10 > rows.len() as u64);
    let median = |from: usize, to: usize| {
        let mut times: Vec<_> = rows.iter().map(|row| row[to] - row[from]).collect();
        times.sort_unstable();
        times[times.len() / 2] as f64 / 1e9
    };
    let [filter_started, filtered] = FILTER;
    let [controller_started, commanded] = CONTROLLER;
    let compared = [
        (chain.hop(0).whole.p50, median(SENSOR, filtered)),
        (chain.hop(1).whole.p50, median(filtered, commanded)),
        (chain.between(0, 2).p50, median(SENSOR, commanded)),
    ];
    for (seen, logged) in compared {
        println!("{seen:.6} s, logged {logged:.6} s");
        assert!((seen - logged).abs() < CLOSE, "{seen} {logged}");
    }
    // The node's part begins at the arrival, before the callback.
    for (hop, callback) in [
        (0, median(filter_started, filtered)),
        (1, median(controller_started, commanded)),
    ] {
        let node = chain.hop(hop).node.unwrap().p50;
        assert!(
            node > callback && node < callback + 0.002,
            "{node} {callback}"
        );
    }
}

/// Returns the stamp and the spans of each trace, by stage and topic.
fn by_stamp(spans: &[ChainSpan]) -> BTreeMap<u64, BTreeMap<String, &ChainSpan>> {
    let mut traces: BTreeMap<u64, BTreeMap<String, &ChainSpan>> = BTreeMap::new();
    for span in spans {
        let (seconds, nanoseconds) = span.message.as_ref().unwrap().stamp;
        let stamp = u64::try_from(seconds).unwrap() * 1_000_000_000 + u64::from(nanoseconds);
        let name = format!("{} {}", span.stage.label(), span.topic);
        let trace = traces.entry(stamp).or_default();
        assert!(trace.insert(name, span).is_none(), "{stamp} {span:?}");
    }
    traces
}

/// The names of a whole trace's spans, each after its parent.
const NAMES: [&str; 7] = [
    "publish /points",
    "transit /points",
    "node /points",
    "publish /filtered",
    "transit /filtered",
    "node /filtered",
    "publish /cmd",
];

#[test]
fn spans_of_real_nodes_have_captured_times_and_contain_the_logged_times() {
    let Found { chains, spans, .. } = replay(1.0);
    let traces = by_stamp(&spans);
    let times = |stamp: u64| {
        let trace = &traces[&stamp];
        let times = |name: &str| {
            let span = trace[name];
            (span.begin.0 % 1_000_000_000, span.end.0 % 1_000_000_000)
        };
        NAMES.map(times)
    };
    // The publications are the source timestamps of row 59, the others the times of the frames.
    let (points, filtered, cmd) = (923_584_190, 937_812_440, 941_997_806);
    let (sensed, reached, done) = (924_331_000, 937_933_000, 942_119_000);
    let expected = [
        (points, sensed),
        (points, sensed),
        (sensed, filtered),
        (filtered, reached),
        (filtered, reached),
        (reached, cmd),
        (cmd, done),
    ];
    assert_eq!(times(1_795_377_573_923_474_116), expected);

    let rows = logged();
    let whole = traces.values().filter(|trace| trace.len() == NAMES.len());
    assert_eq!(whole.count() as u64, chains[0].count);
    let mut compared = 0;
    for row in rows {
        let (stamp, published) = (row[0], row[SENSOR]);
        let Some(trace) = traces
            .get(&stamp)
            .filter(|trace| trace.len() == NAMES.len())
        else {
            continue;
        };
        compared += 1;
        let ids: BTreeSet<u128> = trace.values().map(|span| span.trace_id).collect();
        assert_eq!(ids.len(), 1, "one trace");
        let parents = NAMES.map(|name| trace[name].parent);
        let id = |index: usize| Some(trace[NAMES[index]].id);
        assert_eq!(parents, [None, id(0), id(0), id(2), id(3), id(3), id(5)]);
        // A node logs the time before it publishes, and when its callback begins.
        assert!(published <= trace["publish /points"].begin.0);
        for (name, [started, published]) in
            [("node /points", FILTER), ("node /filtered", CONTROLLER)]
        {
            let (begin, end) = (trace[name].begin.0, trace[name].end.0);
            let (started, published) = (row[started], row[published]);
            assert!(begin <= started && published <= end, "{name} {stamp}");
            assert!(end - published < 5 * MILLISECOND, "{name} {stamp}");
        }
    }
    assert!(compared > 150, "{compared}");
}

#[test]
fn a_traced_share_selects_the_same_traces_in_each_replay() {
    let (all, tenth) = (replay(1.0).spans, replay(0.1).spans);
    assert_eq!(replay(0.1).spans, tenth);
    let ids = |spans: &[ChainSpan]| spans.iter().map(|span| span.trace_id).collect();
    let (all, tenth): (BTreeSet<u128>, BTreeSet<u128>) = (ids(&all), ids(&tenth));
    assert!(tenth.is_subset(&all));
    assert!(
        (8..60).contains(&tenth.len()),
        "{} of {}",
        tenth.len(),
        all.len()
    );
}
