//! Samples one by one: from the model over replayed captures, and from the real binary by
//! `GET /samples`.
#![expect(clippy::unwrap_used, clippy::panic, reason = "a test may panic")]

mod local_agent;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use local_agent::LocalAgent;
use ros2probe::capture::feed::Feed;
use ros2probe::capture::pcap::PcapReader;
use ros2probe::config::{Watch, Watchlist};
use ros2probe::model::observer::{Observer, Settings};
use ros2probe::model::payloads::{News, Sample};
use ros2probe::model::reassembly::Limits;
use ros2probe::model::selection::{Depth, Selection, Wish};
use ros2probe::model::snapshot::Snapshot;
use ros2probe::subscriptions::line::Line;

/// The captures of the repository.
fn captures() -> Vec<PathBuf> {
    let data = Path::new(env!("CARGO_MANIFEST_DIR")).join("../wire/tests/data");
    let files = std::fs::read_dir(data).unwrap();
    let files = files.map(|file| file.unwrap().path());
    let mut captures: Vec<_> = files
        .filter(|path| path.to_string_lossy().ends_with(".pcap.gz"))
        .collect();
    captures.sort();
    assert!(!captures.is_empty());
    captures
}

/// What a capture says when everything is watched and, with a depth, everything wished for.
fn replayed(capture: &Path, depth: Option<Depth>) -> (Snapshot, Vec<Arc<Sample>>) {
    let mut observer = Observer::new(Settings::default());
    let everything = vec![Watch::named("/**").unwrap()];
    observer.set_watchlist(Watchlist::new(everything).unwrap());
    if let Some(depth) = depth {
        let wish = Wish {
            id: 1,
            selection: Arc::new(Selection::all()),
            domain_id: None,
            depth,
        };
        observer.set_wishes(Arc::new(vec![wish]));
    }
    let mut reader = PcapReader::open(capture).unwrap();
    let mut feed = Feed::new(Limits::default());
    let mut samples = Vec::new();
    while let Some(captured) = reader.next_packet().unwrap() {
        feed.packet(&captured, &mut observer);
        for given in observer.take_given() {
            assert_eq!(*given.to, [1]);
            if let News::Sample(sample) = given.news {
                samples.push(sample);
            }
        }
    }
    observer.settle();
    (observer.snapshot(feed.last()), samples)
}

#[test]
fn who_wants_samples_changes_no_number_and_gets_each_that_is_counted_once() {
    let mut messages = 0;
    for capture in captures() {
        let (alone, none) = replayed(&capture, None);
        assert!(none.is_empty());
        let (with, samples) = replayed(&capture, Some(Depth::Arrivals));
        let name = capture.display();
        assert_eq!(format!("{alone:?}"), format!("{with:?}"), "{name}");
        let mut counts: BTreeMap<_, (u64, u64)> = BTreeMap::new();
        let mut seen = BTreeSet::new();
        let mut last = 0;
        for sample in samples {
            assert!(seen.insert((sample.writer, sample.sequence_number)));
            assert!(sample.time.0 >= last && sample.payload.is_none());
            last = sample.time.0;
            let key = (sample.topic.domain_id, sample.topic.dds_name.to_string());
            let count = counts.entry(key).or_default();
            count.0 += 1;
            count.1 += u64::from(sample.size);
        }
        for topic in &with.topics {
            let Some(measured) = &topic.measurement else {
                continue;
            };
            let key = (topic.domain_id, topic.dds_name.clone());
            let given = counts.remove(&key).unwrap_or_default();
            let measured = (measured.messages, measured.bytes);
            assert_eq!(given, measured, "{name}: {key:?}");
            messages += given.0;
        }
        assert!(counts.is_empty(), "{name}: {counts:?}");
    }
    assert!(messages >= 64, "{messages}");
}

#[test]
fn a_stream_tells_what_comes_and_when_that_was_all() {
    let agent = LocalAgent::start(&["--speed", "4"]);
    let answer = local_agent::request(agent.api, "GET", "/samples?all=true", "");
    assert_eq!(answer.status, 200, "{}", answer.body);
    assert!(
        answer
            .headers
            .contains("content-type: application/x-ndjson")
    );
    let lines = answer.body.lines().filter(|line| line.starts_with('{'));
    let lines: Vec<Line> = lines
        .map(|line| serde_json::from_str(line).unwrap_or_else(|error| panic!("{line}: {error}")))
        .collect();
    assert!(matches!(lines[0], Line::Open(_)), "{:?}", lines[0]);
    assert!(matches!(lines.last(), Some(Line::End(end)) if end.reason == "end of capture"));
    let mut clock = 0;
    let mut samples = 0;
    for line in &lines[1..lines.len() - 1] {
        match line {
            Line::Clock(now) => {
                let is_in_steps = clock == 0 || now.time_ns - clock <= 110_000_000;
                assert!(now.time_ns > clock && is_in_steps, "{clock} {now:?}");
                clock = now.time_ns;
            }
            Line::Sample(sample) => {
                assert!(sample.time_ns >= clock, "{clock} {sample:?}");
                assert!(sample.payload_bytes.is_none() && sample.size > 4);
                samples += 1;
            }
            other => panic!("{other:?}"),
        }
    }
    assert!(samples > 10 && clock > 0, "{samples} samples until {clock}");
}

#[test]
fn what_no_topic_can_be_called_is_refused() {
    let agent = LocalAgent::start(&["--speed", "max"]);
    for query in [
        "",
        "?topic=",
        "?topic=/a//b",
        "?all=true&domain_id=233",
        "?regex=(",
        "?x=1",
    ] {
        let answer = local_agent::request(agent.api, "GET", &format!("/samples{query}"), "");
        assert!(
            matches!(answer.status, 400 | 422),
            "{query}: {}",
            answer.body
        );
    }
}
