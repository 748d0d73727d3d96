//! Calls of real nodes in captures, compared with the log of the client.

use std::path::Path;

use ros2probe_capture::frame_decoder::FrameDecoder;
use ros2probe_capture::pcap::PcapReader;
use ros2probe_capture::reassembly::Limits;
use ros2probe_wire::Expansion;

use super::*;

/// Label of the capture, and the client's times from request to response and from goal to result,
/// in seconds. They were measured in Python, which adds up to a few milliseconds.
const LOGGED: [(&str, [f64; 5], f64); 3] = [
    (
        "cyclonedds",
        [0.001749, 0.001342, 0.001756, 0.001932, 0.002354],
        0.810598,
    ),
    (
        "fastrtps-udp",
        [0.003509, 0.001273, 0.001311, 0.003845, 0.001592],
        0.808330,
    ),
    (
        "jazzy-cyclonedds",
        [0.006694, 0.004592, 0.004145, 0.002624, 0.002917],
        0.820060,
    ),
];

#[test]
fn calls_and_goals_of_real_nodes_have_the_logged_durations() {
    let data = Path::new(env!("CARGO_MANIFEST_DIR")).join("../testing/data");
    for (label, calls, goal) in LOGGED {
        let mut observer = Observer::new(Settings {
            directed: false,
            ..Settings::default()
        });
        let capture = data.join(label).join("lifecycle-2ns/capture.pcap.gz");
        let mut reader = PcapReader::open(&capture, Expansion::Limited).unwrap();
        let mut feed = FrameDecoder::new(Limits::default());
        while let Some(captured) = reader.next_packet().unwrap() {
            feed.packet(&captured, &mut observer);
        }
        let snapshot = observer.snapshot(feed.last());
        println!("{label}: {:#?}", snapshot.services);
        let service = |name: &str| {
            let mut services = snapshot.services.iter();
            services.find(|service| service.name == name).unwrap()
        };
        let add = service("/robot1/add_two_ints");
        assert_eq!((add.requests, add.answered, add.unanswered), (5, 5, 0));
        let sum: f64 = calls.iter().sum();
        let own = sum - add.latency.histogram.sum();
        assert!((0.0..5.0 * 0.003).contains(&own), "{label}: {own}");
        let [action] = &snapshot.actions[..] else {
            panic!("{label}: {:#?}", snapshot.actions)
        };
        assert_eq!(action.name, "/robot1/fibonacci");
        let expected = GoalCounts {
            accepted: 1,
            succeeded: 1,
            ..GoalCounts::default()
        };
        assert_eq!((action.goals, action.open), (expected, 0));
        let own = goal - action.duration.p50.unwrap();
        assert!((0.0..0.005).contains(&own), "{label}: {own}");
        assert!(snapshot.services.iter().all(|service| service.hanging == 0));
    }
}
