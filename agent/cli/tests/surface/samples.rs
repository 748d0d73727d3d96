//! Single samples: from the model over replayed captures, and from the real binary through `GET
//! /samples`.

mod shared_memory;

use std::collections::{BTreeMap, BTreeSet};
use std::io::{Read as _, Write as _};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use crate::replay::change;
use crate::rp;
use bytes::Bytes;
use ros2probe_api::samples::Line;
use ros2probe_capture::frame_decoder::FrameDecoder;
use ros2probe_capture::pcap::PcapReader;
use ros2probe_capture::reassembly::Limits;
use ros2probe_daemon::config::{Watch, Watchlist};
use ros2probe_model::facts::dispatch::{MissedReason, SampleOutcome};
use ros2probe_model::facts::selection::{Depth, SampleRequest, Selection};
use ros2probe_model::observe::input::Input;
use ros2probe_model::observe::observer::{Observer, Settings};
use ros2probe_model::report::snapshot::Snapshot;
use ros2probe_testing::local_agent;
use ros2probe_testing::local_agent::{LocalAgent, PATIENCE};
use ros2probe_testing::model::forge::{self, Message, SEDP_READERS, SEDP_WRITERS, SPDP};
use ros2probe_wire::record::Verdict;
use ros2probe_wire::time::SECOND;
use ros2probe_wire::{DomainId, EntityId, Expansion, Guid, GuidPrefix, SequenceNumber, Timestamp};

const START: u64 = 1_795_143_000 * SECOND;
const WRITER: EntityId = EntityId([0, 0, 0x11, 0x03]);
const ALICE: GuidPrefix = GuidPrefix(*b"\x01\x10alice-host");
const BOB: GuidPrefix = GuidPrefix(*b"\x01\x10bobby-host");

/// Returns the captures of the repository, and further captures of large messages if they exist.
fn captures() -> Vec<PathBuf> {
    let here = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut captures = Vec::new();
    find(&here.join("../../wire/tests/data"), &mut captures);
    find(&here.join("../testing/data"), &mut captures);
    let own = captures.len();
    find(&here.join("../../../shared/fixtures"), &mut captures);
    let mut others = captures.split_off(own);
    others.retain(|path| path.to_string_lossy().contains("/points-"));
    captures.extend(others);
    assert!(own >= 10, "{captures:?}");
    captures
}

fn find(folder: &Path, captures: &mut Vec<PathBuf>) {
    for file in std::fs::read_dir(folder).into_iter().flatten() {
        let path = file.unwrap().path();
        if path.is_dir() {
            find(&path, captures);
        } else if path.to_string_lossy().ends_with(".pcap.gz") {
            captures.push(path);
        }
    }
}

fn request(id: u64, depth: Depth) -> SampleRequest {
    SampleRequest {
        id,
        selection: Arc::new(Selection::all()),
        domain_id: None,
        depth,
    }
}

/// Replays a capture with a watch for all topics and, with a depth, a request for all samples.
pub(crate) fn replayed(capture: &Path, depth: Option<Depth>) -> (Snapshot, Vec<SampleOutcome>) {
    let mut observer = Observer::new(Settings::default());
    let everything = vec![Watch::named("/**").unwrap()];
    observer.input(Input::Watchlist(Arc::new(
        Watchlist::new(everything).unwrap(),
    )));
    if let Some(depth) = depth {
        observer.input(Input::SampleRequests(Arc::new(vec![request(1, depth)])));
    }
    let mut reader = PcapReader::open(capture, Expansion::Limited).unwrap();
    let mut feed = FrameDecoder::new(Limits::default());
    let mut outcomes = Vec::new();
    let mut take = |observer: &mut Observer| {
        for given in observer.drain().samples {
            assert_eq!(*given.to, [1]);
            outcomes.push(given.outcome);
        }
    };
    while let Some(captured) = reader.next_packet().unwrap() {
        feed.packet(&captured, &mut observer);
        take(&mut observer);
    }
    observer.input(Input::End);
    take(&mut observer);
    let mut snapshot = observer.snapshot(feed.last());
    snapshot.tables.retain(|table| table.table != "payloads");
    // This flag shows that samples are requested, and is not a count.
    for topic in &mut snapshot.topics {
        topic.is_read = false;
    }
    (snapshot, outcomes)
}

/// Returns the numbers of samples and bytes by topic. Each sample must be unique, and the times
/// must not decrease, except by some nanoseconds.
fn counts(outcomes: &[SampleOutcome], depth: Depth) -> BTreeMap<(DomainId, String), (u64, u64)> {
    let mut counts: BTreeMap<_, (u64, u64)> = BTreeMap::new();
    let mut seen = BTreeSet::new();
    let mut last = 0;
    for outcome in outcomes {
        let SampleOutcome::Sample(sample) = outcome else {
            continue;
        };
        assert!(seen.insert((sample.writer, sample.sequence_number)));
        // Samples of one writer that arrive at the same time are a nanosecond apart.
        assert!(sample.time.0 + 64 >= last, "{last} {sample:?}");
        last = sample.time.0;
        let len = sample.payload.as_ref().map(Bytes::len);
        let expected = (depth == Depth::Payloads).then_some(sample.size as usize);
        assert_eq!(len, expected, "{sample:?}");
        let key = (sample.topic.domain_id, sample.topic.dds_name.to_string());
        let count = counts.entry(key).or_default();
        count.0 += 1;
        count.1 += u64::from(sample.size);
    }
    counts
}

fn unannounced(outcomes: &[SampleOutcome], dds_name: &str) -> u64 {
    let missed = outcomes.iter().filter_map(|outcome| match outcome {
        SampleOutcome::Missed(missed) if missed.reason == MissedReason::Unannounced => Some(missed),
        _ => None,
    });
    let of_topic = missed.filter(|missed| &*missed.topic.dds_name == dds_name);
    of_topic.map(|missed| missed.samples).sum()
}

#[test]
fn a_sample_request_changes_no_count_and_gets_each_counted_sample_once() {
    let mut messages = 0;
    for capture in captures() {
        let (alone, none) = replayed(&capture, None);
        assert!(none.is_empty());
        let is_cut = |snapshot: &Snapshot| {
            let mut errors = snapshot.decode_errors.iter();
            errors.any(|error| error.stage == "frame")
        };
        for depth in [Depth::Arrivals, Depth::Payloads] {
            if depth == Depth::Payloads && is_cut(&alone) {
                continue;
            }
            let (with, outcomes) = replayed(&capture, Some(depth));
            let name = capture.display();
            assert_eq!(format!("{alone:?}"), format!("{with:?}"), "{name}");
            let mut counts = counts(&outcomes, depth);
            let (mut incomplete, mut lost) = (0, 0);
            for topic in &with.topics {
                let Some(measured) = &topic.measurement else {
                    continue;
                };
                let key = (topic.domain_id, topic.dds_name.to_string());
                let given = counts.remove(&key).unwrap_or_default();
                // Earlier samples of an unknown writer count for its topic after its announcement.
                let unannounced = unannounced(&outcomes, &key.1);
                assert_eq!(given.0 + unannounced, measured.messages, "{name}: {key:?}");
                if unannounced == 0 {
                    assert_eq!(given.1, measured.bytes, "{name}: {key:?}");
                }
                messages += given.0;
                incomplete += measured.incomplete;
                lost += measured.lost;
            }
            assert!(counts.is_empty(), "{name}: {counts:?}");
            let missed = outcomes.iter().filter_map(|outcome| match outcome {
                SampleOutcome::Missed(missed) => Some((missed.reason, missed.samples)),
                SampleOutcome::Sample(_) => None,
            });
            let mut reported: BTreeMap<_, u64> = BTreeMap::new();
            for (reason, samples) in missed {
                *reported.entry(reason).or_default() += samples;
            }
            reported.remove(&MissedReason::Unannounced);
            let mut expected = BTreeMap::from([
                (MissedReason::Incomplete, incomplete),
                (MissedReason::Lost, lost - incomplete),
            ]);
            expected.retain(|_, samples| *samples > 0);
            assert_eq!(reported, expected, "{name}");
        }
    }
    assert!(messages >= 64, "{messages}");
}

/// The log of a subscriber of a capture.
#[derive(serde::Deserialize)]
struct Logged {
    lost_between: Vec<u64>,
    /// The times at which the messages reached their callback.
    t: Vec<u64>,
}

#[derive(serde::Deserialize)]
struct GroundTruth {
    received: Vec<Logged>,
}

#[test]
fn a_subscription_gets_the_messages_of_a_reliable_subscriber_in_order_and_on_time() {
    for (label, unannounced) in [
        ("fastrtps-udp/keep-last-lossy-2ns", 0),
        ("cyclonedds/keep-last-lossy-2ns", 0),
        ("fastrtps-udp/announced-late-2ns", 50),
    ] {
        let data = Path::new(env!("CARGO_MANIFEST_DIR")).join("../testing/data");
        let directory = data.join(label);
        let truth = std::fs::read(directory.join("groundtruth.json")).unwrap();
        let truth: GroundTruth = serde_json::from_slice(&truth).unwrap();
        let logged = truth.received.first().unwrap();
        let capture = directory.join("capture.pcap.gz");
        for depth in [Depth::Arrivals, Depth::Payloads] {
            let (mut given, mut lost, mut early) = (Vec::new(), BTreeSet::new(), 0);
            for outcome in replayed(&capture, Some(depth)).1 {
                match outcome {
                    SampleOutcome::Sample(sample) if &*sample.topic.name == "/chatter" => {
                        given.push((sample.sequence_number - SequenceNumber(1), sample.time.0));
                    }
                    SampleOutcome::Missed(missed) if &*missed.topic.name == "/chatter" => {
                        match missed.reason {
                            MissedReason::Lost => {
                                lost.extend(missed.first - SequenceNumber(1)..missed.last.0);
                            }
                            MissedReason::Unannounced => early += missed.samples,
                            reason => panic!("{label}: {reason:?}"),
                        }
                    }
                    _ => {}
                }
            }
            let lacking = logged.lost_between.iter().copied();
            assert_eq!(lost, lacking.collect(), "{label} {depth:?}");
            assert_eq!(early, unannounced, "{label} {depth:?}");
            let numbers = given.iter().map(|(number, _)| *number);
            assert!(numbers.is_sorted(), "{label}");
            assert_eq!(given.len(), logged.t.len(), "{label}");
            // A callback runs some time after the arrival of the datagram that completed its
            // message.
            let late = given.iter().zip(&logged.t);
            let late = late.filter(|((_, at), t)| !(0..20_000_000).contains(&t.wrapping_sub(*at)));
            let late: Vec<_> = late.collect();
            assert!(late.len() * 50 <= given.len(), "{label}: {late:?}");
        }
    }
}

/// A domain in which two participants each announce a writer of a topic.
struct Robot {
    observer: Observer,
    at: u64,
}

impl Robot {
    fn new(settings: Settings) -> Self {
        let mut robot = Self {
            observer: Observer::new(settings),
            at: START,
        };
        robot.observer.input(Input::Time(Timestamp(START)));
        for (prefix, topic) in [(ALICE, "rt/points"), (BOB, "rt/add/_service_event")] {
            let payload = forge::participant(prefix, 100, None);
            robot.put(Message::from(prefix).data(SPDP, 1, &payload));
            let guid = Guid::new(prefix, WRITER);
            let payload = forge::endpoint(guid, topic, "a::msg::dds_::B_", true);
            robot.put(Message::from(prefix).data(SEDP_WRITERS, 1, &payload));
        }
        robot
    }

    fn put(&mut self, message: Message) {
        self.at += 1_000_000;
        let envelope = forge::multicast(self.at, 0);
        self.observer.input(Input::Datagram {
            envelope: &envelope,
            payload: &message.bytes(),
            handover: None,
        });
    }

    /// Adds a message that was read from shared memory, where others may have been missed.
    fn receive(&mut self, message: Message) {
        self.at += 1_000_000;
        let envelope = forge::multicast(self.at, 0);
        self.observer.input(Input::SharedMemory {
            envelope: &envelope,
            payload: &message.bytes(),
        });
    }

    fn fragment(&mut self, prefix: GuidPrefix, number: u64, start: u32, payload: &[u8]) {
        self.put(Message::from(prefix).fragment(WRITER, number, start, 1000, payload));
    }

    fn subscribe(&mut self, topics: &[&str], depth: Depth) {
        let selection = Selection::named(topics.iter().copied()).unwrap();
        let sample_requests = vec![SampleRequest {
            selection: Arc::new(selection),
            ..request(3, depth)
        }];
        self.observer
            .input(Input::SampleRequests(Arc::new(sample_requests)));
    }

    /// Returns writer, number and payload of each sample, or the reason for a missed sample.
    fn payloads_of(&mut self) -> Vec<(GuidPrefix, u64, Result<Vec<u8>, MissedReason>)> {
        let given = self.observer.drain().samples.into_iter();
        given
            .map(|given| match given.outcome {
                SampleOutcome::Sample(sample) => {
                    let payload = sample.payload.as_ref().map(|bytes| bytes.to_vec());
                    let payload = payload.unwrap_or_default();
                    (sample.writer.prefix, sample.sequence_number.0, Ok(payload))
                }
                SampleOutcome::Missed(missed) => {
                    (missed.writer.prefix, missed.first.0, Err(missed.reason))
                }
            })
            .collect()
    }
}

/// Returns a payload whose bytes differ by position.
fn payload(size: usize) -> Vec<u8> {
    (0..size).map(|place| (place * 7 % 251) as u8).collect()
}

#[test]
fn fragments_are_assembled_and_samples_are_delivered_in_the_order_of_completion() {
    let mut robot = Robot::new(Settings::default());
    robot.subscribe(&["/points", "/add/_service_event"], Depth::Payloads);
    let (large, small) = (payload(4321), payload(1234));
    for start in [1, 3, 3, 2] {
        robot.fragment(ALICE, 1, start, &large);
        robot.fragment(BOB, 1, start.min(2), &small);
    }
    assert_eq!(robot.payloads_of(), [(BOB, 1, Ok(small.clone()))]);
    for start in [5, 1, 4] {
        robot.fragment(ALICE, 1, start, &large);
    }
    robot.fragment(ALICE, 1, 2, &large);
    robot.put(Message::from(BOB).data(WRITER, 2, &small[..400]));
    robot.put(Message::from(BOB).data(WRITER, 2, &small[..400]));
    let guid = Guid::new(BOB, WRITER);
    robot.put(Message::from(BOB).dispose_by_key(WRITER, 3, 0x70, guid));
    let expected = [(ALICE, 1, Ok(large)), (BOB, 2, Ok(small[..400].to_vec()))];
    assert_eq!(robot.payloads_of(), expected);
}

#[test]
fn a_sample_that_stays_incomplete_is_reported_and_not_delivered() {
    let mut robot = Robot::new(Settings::default());
    robot.subscribe(&["/points"], Depth::Payloads);
    robot.at += SECOND;
    robot.put(Message::from(ALICE).data(WRITER, 1, &payload(20)));
    robot.fragment(ALICE, 2, 1, &payload(3000));
    robot.fragment(ALICE, 2, 3, &payload(3000));
    robot.put(Message::from(ALICE).data(WRITER, 3, &payload(24)));
    robot
        .observer
        .input(Input::Time(Timestamp(robot.at + 30 * SECOND)));
    let given: Vec<_> = robot.payloads_of();
    let expected = [
        (ALICE, 1, Ok(payload(20))),
        (ALICE, 3, Ok(payload(24))),
        (ALICE, 2, Err(MissedReason::Incomplete)),
    ];
    assert_eq!(given, expected);
}

#[test]
fn each_subscription_gets_the_losses_since_it_began() {
    let mut robot = Robot::new(Settings::default());
    let data = |robot: &mut Robot, number| {
        robot.put(Message::from(ALICE).data(WRITER, number, b"\0\x01\0\0anything"));
    };
    let sample_requests = |robot: &mut Robot, ids: &[u64]| {
        let sample_requests = ids.iter().map(|id| request(*id, Depth::Arrivals));
        robot
            .observer
            .input(Input::SampleRequests(Arc::new(sample_requests.collect())));
    };
    sample_requests(&mut robot, &[3]);
    data(&mut robot, 1);
    data(&mut robot, 4);
    sample_requests(&mut robot, &[3, 5]);
    data(&mut robot, 8);
    robot.at += 12 * SECOND;
    robot.observer.input(Input::Time(Timestamp(robot.at)));
    let given = robot.observer.drain().samples.into_iter();
    let mut missed: Vec<_> = given
        .filter_map(|given| match given.outcome {
            SampleOutcome::Missed(missed) => {
                assert_eq!(missed.reason, MissedReason::Lost);
                assert_eq!(missed.samples, missed.last - missed.first + 1);
                Some((given.to.to_vec(), missed.first.0, missed.last.0))
            }
            SampleOutcome::Sample(_) => None,
        })
        .collect();
    missed.sort();
    assert_eq!(missed, [(vec![3], 2, 3), (vec![3, 5], 5, 7)]);
}

#[test]
fn sample_requests_measure_unwatched_topics_until_the_last_request_ends() {
    let mut robot = Robot::new(Settings::default());
    let guid = Guid::new(ALICE, WRITER);
    let verdict = |robot: &mut Robot| {
        let changes = robot.observer.drain().interest.into_iter();
        let mut of_it = changes.filter(|(endpoint, _)| *endpoint == guid);
        of_it.next().and_then(|(_, verdict)| verdict)
    };
    assert_eq!(verdict(&mut robot), Some(Verdict::Ignore));
    robot.put(Message::from(ALICE).data(WRITER, 1, &payload(20)));
    robot.subscribe(&["/points"], Depth::Arrivals);
    assert_eq!(verdict(&mut robot), Some(Verdict::Meter));
    robot.put(Message::from(ALICE).data(WRITER, 2, &payload(20)));
    assert_eq!(robot.payloads_of(), [(ALICE, 2, Ok(Vec::new()))]);
    robot.subscribe(&["/points"], Depth::Payloads);
    assert_eq!(verdict(&mut robot), Some(Verdict::Capture));
    robot.put(Message::from(ALICE).data(WRITER, 3, &payload(20)));
    assert_eq!(robot.payloads_of(), [(ALICE, 3, Ok(payload(20)))]);
    robot.observer.input(Input::SampleRequests(Arc::default()));
    assert_eq!(verdict(&mut robot), Some(Verdict::Ignore));
    robot.put(Message::from(ALICE).data(WRITER, 4, &payload(20)));
    assert!(robot.payloads_of().is_empty());
    let snapshot = robot.observer.snapshot(Timestamp(robot.at));
    assert!(snapshot.watches.is_empty());
    let points = snapshot.topics.iter().find(|topic| topic.name == "/points");
    assert_eq!(points.unwrap().measurement.as_ref().unwrap().messages, 2);
}

#[test]
fn samples_beyond_the_cap_in_bytes_are_reported_and_memory_is_bounded() {
    let mut robot = Robot::new(Settings {
        payload_bytes: 100_000,
        ..Settings::default()
    });
    robot.subscribe(&["/points"], Depth::Payloads);
    robot.at += SECOND;
    let held = |robot: &Robot| {
        let snapshot = robot.observer.snapshot(Timestamp(robot.at));
        let table = snapshot
            .tables
            .iter()
            .find(|table| table.table == "payloads");
        table.unwrap().size
    };
    // No client reads the samples.
    for number in 1..=20 {
        robot.put(Message::from(ALICE).data(WRITER, number, &payload(10_000)));
        assert!(held(&robot) <= 100_000);
    }
    let given = robot.payloads_of();
    let (whole, missed): (Vec<_>, Vec<_>) = given.iter().partition(|given| given.2.is_ok());
    assert_eq!(given.len(), 20);
    assert!(
        whole.len() >= 8 && missed.len() >= 8,
        "{} {}",
        whole.len(),
        missed.len()
    );
    assert!(
        missed
            .iter()
            .all(|given| given.2 == Err(MissedReason::NotCaptured))
    );
    // Samples that never become complete are evicted for one that does.
    for number in 30..60 {
        robot.fragment(ALICE, number, 1, &payload(50_000));
        assert!(held(&robot) <= 100_000);
    }
    let large = payload(30_000);
    for start in 1..=30 {
        robot.fragment(ALICE, 60, start, &large);
    }
    assert!(robot.payloads_of().contains(&(ALICE, 60, Ok(large))));
}

#[test]
fn a_stream_has_the_samples_and_the_time_up_to_which_it_is_complete() {
    // The replay stays near its begin until the stream is open.
    let agent = LocalAgent::start(&mut rp(), &["--speed", "0.02"]);
    let mut stream = TcpStream::connect(agent.api).unwrap();
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    let path = "/samples?all=true";
    let request = format!("GET {path} HTTP/1.1\r\nHost: {}\r\n", agent.api);
    write!(stream, "{request}Connection: close\r\n\r\n").unwrap();
    let mut answer = Vec::new();
    while !String::from_utf8_lossy(&answer).contains("\"open\"") {
        let mut bytes = [0; 4096];
        let count = stream.read(&mut bytes).unwrap();
        assert!(count > 0, "{}", String::from_utf8_lossy(&answer));
        answer.extend_from_slice(&bytes[..count]);
    }
    change(&agent, &serde_json::json!({"speed": 4}));
    stream.read_to_end(&mut answer).unwrap();
    let answer = String::from_utf8(answer).unwrap();
    let (head, body) = answer.split_once("\r\n\r\n").unwrap();
    let head = head.to_lowercase();
    assert!(head.starts_with("http/1.1 200 "), "{answer}");
    assert!(
        head.contains("content-type: application/x-ndjson"),
        "{head}"
    );
    let lines = body.lines().filter(|line| line.starts_with('{'));
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
fn an_invalid_query_is_refused() {
    let agent = LocalAgent::start(&mut rp(), &["--speed", "max"]);
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
