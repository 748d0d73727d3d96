use ros2probe_wire::qos::Role;
use ros2probe_wire::rtps::VendorId;
use ros2probe_wire::time::SECOND;
use ros2probe_wire::{DomainId, EntityId, GuidPrefix, SequenceNumber};

use super::*;
use crate::recording::graph::DurablePublisher;
use crate::subscriptions::{Missed, MissedReason};
use crate::tables::tests::assert_driven;
use ros2probe_bag::Options;

const KEEPER: &str = r#"{"reliability": "RELIABLE", "durability": "TRANSIENT_LOCAL",
        "history": "KEEP_LAST (1)", "deadline_seconds": null, "lifespan_seconds": null,
        "liveliness": "AUTOMATIC", "liveliness_lease_seconds": null}"#;

fn writer(number: u8) -> Guid {
    Guid {
        prefix: GuidPrefix([number; 12]),
        entity: EntityId([0, 0, number, 3]),
    }
}

fn topic(name: &str, message_type: &str) -> Arc<Topic> {
    Arc::new(Topic {
        domain_id: DomainId(0),
        name: name.into(),
        dds_name: format!("rt{name}").into(),
        message_type: message_type.into(),
        offered: None,
    })
}

fn sample(name: &str, number: u64) -> Item {
    Item::Sample(Arc::new(Sample {
        topic: topic(name, "std_msgs/msg/String"),
        time: Timestamp(1_000 + number),
        writer: writer(1),
        sequence_number: SequenceNumber(number),
        source_timestamp: Some(Timestamp(number)),
        header_stamp: None,
        size: 12,
        sampled: false,
        payload: Some(vec![0, 1, 0, 0, 4, 0, 0, 0, b'a', b'b', b'c', 0].into()),
    }))
}

fn durable_publishers() -> DiscoveredTopic {
    let publishers = format!(r#"[{{"guid": "{}", "qos": {KEEPER}}}]"#, writer(1));
    let json = format!(
        r#"{{"message_types": [], "type_hashes": [], "publishers": {publishers},
                "subscriptions": []}}"#
    );
    let topic: ros2probe_api::topics::Topic<'_> = serde_json::from_str(&json).unwrap();
    DiscoveredTopic::from(&topic)
}

/// Returns a graph with a publisher of `/tf_static` that has stored samples.
fn static_transforms() -> GraphSnapshot {
    GraphSnapshot {
        topics: vec![PublishedTopic {
            name: "/tf_static".to_owned(),
            subscribed: true,
            durable_publishers: vec![DurablePublisher {
                guid: writer(1).to_string(),
                latched: None,
            }],
            ..PublishedTopic::default()
        }],
        ..GraphSnapshot::default()
    }
}

fn recorder(directory: &std::path::Path, options: FilterOptions) -> Recorder<'static> {
    recorder_of(
        directory,
        options,
        GraphSnapshot::default(),
        static_transforms(),
    )
}

/// Creates a recorder with a graph at its start and at its end.
fn recorder_of(
    directory: &std::path::Path,
    options: FilterOptions,
    before: GraphSnapshot,
    after: GraphSnapshot,
) -> Recorder<'static> {
    let sources = Sources {
        graph: Box::new(move || after.clone()),
        announced: Box::new(|names| {
            let announced = names.iter().map(|name| match name.as_str() {
                "/tf_static" => durable_publishers(),
                _ => DiscoveredTopic::default(),
            });
            announced.collect()
        }),
        schema: Box::new(|_, _| None),
    };
    let bag = Writer::create(directory, Options::default()).unwrap();
    Recorder::new(bag, Filter::new(options).unwrap(), 0, before, sources)
}

fn numbers(ended: &Finished) -> Vec<(String, u32)> {
    let mut found = Vec::new();
    for file in &ended.summary.as_ref().unwrap().files {
        let bytes = std::fs::read(file).unwrap();
        for message in mcap::MessageStream::new(&bytes).unwrap() {
            let message = message.unwrap();
            found.push((message.channel.topic.clone(), message.sequence));
        }
    }
    found
}

#[test]
fn selected_messages_are_in_the_bag_and_missing_ones_in_the_report() {
    let directory = tempfile::tempdir().unwrap();
    let options = FilterOptions {
        exclude_topics: vec!["/noise".to_owned()],
        ..FilterOptions::everything()
    };
    let mut recorder = recorder(&directory.path().join("bag"), options);
    for item in [sample("/a", 1), sample("/noise", 1), sample("/a", 2)] {
        recorder.take(&item).unwrap();
    }
    let missed = |name| {
        Item::Missed(Missed {
            topic: topic(name, "std_msgs/msg/String"),
            writer: writer(1),
            first: SequenceNumber(3),
            last: SequenceNumber(4),
            samples: 2,
            reason: MissedReason::QueueFull,
        })
    };
    recorder.take(&missed("/a")).unwrap();
    recorder.take(&missed("/noise")).unwrap();
    let ended = recorder.finish(None);
    assert_eq!(
        numbers(&ended),
        [("/a".to_owned(), 1), ("/a".to_owned(), 2)]
    );
    assert_eq!((ended.report.messages, ended.report.missing), (2, 2));
    assert_eq!(ended.report.topics.keys().collect::<Vec<_>>(), ["/a"]);
    let metadata = ended.summary.unwrap().directory.join("metadata.yaml");
    assert!(
        std::fs::read_to_string(metadata)
            .unwrap()
            .contains("first_sequence_number")
    );
}

#[test]
fn a_recording_ends_at_its_maximum_size_and_reports_the_limit() {
    let directory = tempfile::tempdir().unwrap();
    let limits = crate::config::RecordingLimits {
        max_bytes: Some(10_000),
        ..Default::default()
    };
    let quota = DiskQuota::new(directory.path(), limits);
    let mut recorder =
        recorder(&directory.path().join("bag"), FilterOptions::everything()).with_quota(quota);
    let refused = (1..).find_map(|number| recorder.take(&sample("/a", number)).err());
    let ended = recorder.finish(refused);
    let limit = ended.report.limit_reached.clone().unwrap();
    assert!(limit.contains("recordings.max_bytes"), "{limit}");
    assert_eq!(ended.report.missing, 0);
    assert_eq!(numbers(&ended).len() as u64, ended.report.messages);
    assert!(
        (50..250).contains(&ended.report.messages),
        "{:?}",
        ended.report
    );
}

#[test]
fn samples_during_a_pause_are_not_recorded() {
    let directory = tempfile::tempdir().unwrap();
    let mut recorder = recorder(&directory.path().join("bag"), FilterOptions::everything());
    recorder.take(&sample("/a", 1)).unwrap();
    recorder.pause(true);
    recorder.take(&sample("/a", 2)).unwrap();
    recorder.pause(false);
    recorder.take(&sample("/a", 3)).unwrap();
    let ended = recorder.finish(None);
    assert_eq!(numbers(&ended).len(), 2);
    assert_eq!(
        (ended.report.topics["/a"].paused, ended.report.missing),
        (1, 0)
    );
}

#[test]
fn a_snapshot_during_a_pause_writes_the_messages_before_it() {
    let directory = tempfile::tempdir().unwrap();
    let recorder = recorder(&directory.path().join("bag"), FilterOptions::everything());
    let mut recorder = recorder.with_ring(SampleRing::new(1 << 20, None));
    recorder.take(&sample("/a", 1)).unwrap();
    recorder.pause(true);
    recorder.take(&sample("/a", 2)).unwrap();
    recorder.snapshot().unwrap();
    assert!(recorder.is_paused());
    recorder.take(&sample("/a", 3)).unwrap();
    let ended = recorder.finish(None);
    assert_eq!(numbers(&ended), [("/a".to_owned(), 1)]);
    assert_eq!(ended.report.topics["/a"].paused, 2);
}

#[test]
fn a_topic_of_two_types_is_recorded_with_the_first_and_reported() {
    let directory = tempfile::tempdir().unwrap();
    let mut recorder = recorder(&directory.path().join("bag"), FilterOptions::everything());
    recorder.take(&sample("/a", 1)).unwrap();
    let Item::Sample(other) = sample("/a", 2) else {
        unreachable!()
    };
    let other = Sample {
        topic: topic("/a", "std_msgs/msg/Int32"),
        ..Sample::clone(&other)
    };
    recorder.take(&Item::Sample(Arc::new(other))).unwrap();
    let ended = recorder.finish(None);
    assert_eq!(numbers(&ended).len(), 1);
    assert_eq!(ended.report.left_out, ["/a"]);
}

/// Returns a topic with a publisher of `std_msgs/msg/String` and a subscriber of another type.
fn two_types() -> DiscoveredTopic {
    DiscoveredTopic {
        message_types: ["std_msgs/msg/Int32", "std_msgs/msg/String"]
            .map(str::to_owned)
            .into(),
        subscribed: true,
        ..durable_publishers()
    }
}

/// Earlier, the subscriber's type described the topic, and every message was left out.
#[test]
fn a_subscriber_of_another_type_does_not_keep_messages_out_of_the_bag() {
    let directory = tempfile::tempdir().unwrap();
    let mut recorder = recorder(&directory.path().join("bag"), FilterOptions::everything());
    recorder.sources.announced = Box::new(|names| names.iter().map(|_| two_types()).collect());
    let types = two_types().message_types;
    recorder.declare([("/a", types.as_slice())]).unwrap();
    // A loss before the first message has no type in a client.
    let missed = Missed {
        topic: topic("/a", ""),
        writer: writer(1),
        first: SequenceNumber(1),
        last: SequenceNumber(3),
        samples: 3,
        reason: MissedReason::Lost,
    };
    recorder.take(&Item::Missed(missed)).unwrap();
    recorder.take(&sample("/a", 4)).unwrap();
    let ended = recorder.finish(None);
    assert_eq!(numbers(&ended), [("/a".to_owned(), 4)]);
    assert!(ended.report.left_out.is_empty());
    let [run] = &ended.report.missing_runs[..] else {
        panic!("{:?}", ended.report);
    };
    assert_eq!((run.topic.as_str(), run.samples), ("/a", 3));
    assert_eq!(
        (ended.report.missing, ended.report.topics["/a"].lost),
        (3, 3)
    );
}

#[test]
fn messages_sent_before_the_recording_are_reported_unless_they_are_recorded() {
    for (number, expected) in [(1, 0), (2, 1)] {
        let directory = tempfile::tempdir().unwrap();
        let mut recorder = recorder(&directory.path().join("bag"), FilterOptions::everything());
        recorder.take(&sample("/tf_static", number)).unwrap();
        recorder.take(&sample("/a", 2)).unwrap();
        assert_eq!(recorder.finish(None).report.sent_before.len(), expected);
    }
    // Without any message, the bag still names the topic.
    let directory = tempfile::tempdir().unwrap();
    let mut recorder = recorder(&directory.path().join("bag"), FilterOptions::everything());
    let topics = [
        ("/tf_static", &["tf2_msgs/msg/TFMessage"][..]),
        ("/nobody", &["std_msgs/msg/String"][..]),
    ];
    recorder.declare(topics).unwrap();
    let ended = recorder.finish(None);
    assert_eq!(ended.report.sent_before, ["/tf_static"]);
    assert_eq!(ended.report.topics.len(), 1);
}

#[test]
fn samples_are_written_to_the_file_after_a_second() {
    let directory = tempfile::tempdir().unwrap();
    let bag = directory.path().join("bag");
    let mut recorder = recorder(&bag, FilterOptions::everything());
    recorder.take(&Item::Clock(Timestamp(1))).unwrap();
    recorder.take(&sample("/a", 1)).unwrap();
    let size = || std::fs::metadata(bag.join("bag_0.mcap")).unwrap().len();
    let before = size();
    recorder.take(&Item::Clock(Timestamp(SECOND + 1))).unwrap();
    assert!(size() > before);
}

#[test]
fn unobserved_messages_are_counted_from_the_start_of_the_recording() {
    let topic = |domain_id, name: &str, other_transport: Option<&str>, messages| PublishedTopic {
        domain_id,
        name: name.to_owned(),
        subscribed: name != "/alone",
        other_transport: other_transport.map(str::to_owned),
        is_exact: name == "/map",
        messages,
        ..PublishedTopic::default()
    };
    let graph = |writers: &[(&str, u64)], others: u64| GraphSnapshot {
        topics: vec![
            topic(0, "/alone", None, None),
            topic(0, "/quiet", None, None),
            topic(0, "/a", Some("same_process"), None),
            topic(0, "/imu", Some("same_process"), None),
            topic(0, "/map", Some("shared_memory"), None),
            topic(0, "/tf", Some("shared_memory"), None),
            topic(7, "/imu", None, Some(others)),
            topic(7, "/odom", None, Some(0)),
            topic(8, "/imu", None, None),
        ],
        unknown_writers: writers
            .iter()
            .map(|(writer, messages)| ((*writer).to_owned(), *messages))
            .collect(),
    };
    let directory = tempfile::tempdir().unwrap();
    let before = graph(&[("01", 5), ("02", 7)], 100);
    let after = graph(&[("01", 5), ("02", 10), ("03", 1)], 140);
    let bag = directory.path().join("bag");
    let mut recorder = recorder_of(&bag, FilterOptions::everything(), before, after);
    recorder.take(&sample("/a", 1)).unwrap();
    let report = recorder.finish(None).report;
    let why = |name: &str| report.unobserved.get(name).map(String::as_str);
    assert_eq!(report.unobserved.len(), 3, "nothing was sent on /map");
    assert_eq!(why("/alone"), Some(NO_SUBSCRIBER));
    assert_eq!(why("/imu"), Some("same_process"));
    assert_eq!(why("/tf"), Some("shared_memory"));
    let unknown = report.unknown_writers;
    assert_eq!((unknown.writers, unknown.messages), (2, 4));
    let others = report.other_domains.iter();
    let others: Vec<_> = others
        .map(|each| (each.domain_id, each.topics, each.messages))
        .collect();
    assert_eq!(others, [(7, 2, Some(40)), (8, 1, None)]);
}

/// Returns a sample of the numbered writer with its QoS.
fn sample_of(name: &str, number: u32) -> Item {
    let Item::Sample(sample) = sample(name, 1) else {
        unreachable!()
    };
    let offered = Offered {
        type_hash: None,
        equivalence_hash: None,
        qos: Qos::defaults(Role::Writer, VendorId::CYCLONE).into(),
    };
    let mut sample = Sample::clone(&sample);
    let mut topic = Topic::clone(&sample.topic);
    topic.offered = Some(Arc::new(offered));
    sample.topic = Arc::new(topic);
    sample.writer = Guid::new(GuidPrefix([1; 12]), EntityId(number.to_be_bytes()));
    Item::Sample(Arc::new(sample))
}

/// Returns the resident memory of this process, in bytes.
fn resident_bytes() -> u64 {
    let text = std::fs::read_to_string("/proc/self/statm").unwrap();
    text.split(' ').nth(1).unwrap().parse::<u64>().unwrap() * 4096
}

#[test]
fn topics_and_writers_beyond_the_caps_of_a_recording_are_counted() {
    const MOST_BYTES: u64 = 10 << 20;
    let directory = tempfile::tempdir().unwrap();
    let mut recorder = recorder(&directory.path().join("bag"), FilterOptions::everything());
    // The first samples allocate pages and buffers that are reused.
    (0..9).for_each(|number| recorder.take(&sample_of("/first", number)).unwrap());
    let before = resident_bytes();
    let topics = u32::try_from(RecordedTopics::CAP).unwrap() + 500;
    for number in 0..topics {
        let name = format!("/robot_{number}/camera/image_raw/compressed");
        recorder.take(&sample_of(&name, number)).unwrap();
    }
    for number in 0..500 {
        recorder.take(&sample_of("/first", number)).unwrap();
    }
    let added = resident_bytes().saturating_sub(before);
    println!("{added} bytes for {} topics", RecordedTopics::CAP);
    assert!(added < MOST_BYTES, "{added} bytes");
    assert_driven::<RecordedTopics>();
    assert_driven::<RecordingWriters>();
    recorder.pause(true);
    (0..5_000).for_each(|number| {
        let name = format!("/paused_{number}");
        recorder.take(&sample_of(&name, number)).unwrap();
    });
    let ended = recorder.finish(None);
    assert_eq!((ended.report.no_room, ended.report.missing), (501, 501));
    assert_eq!(ended.report.topics.len(), RecordedTopics::CAP);
    assert!(!ended.report.is_complete());
    assert_eq!(numbers(&ended).len() as u64, ended.report.messages);
}

#[test]
fn long_names_and_many_writers_of_one_topic_stay_within_their_caps() {
    let directory = tempfile::tempdir().unwrap();
    let mut recorder = recorder(&directory.path().join("bag"), FilterOptions::everything());
    for number in 0..2 * u32::try_from(RecordedWriters::CAP).unwrap() {
        recorder.take(&sample_of("/tf", number)).unwrap();
    }
    assert_driven::<RecordedWriters>();
    for number in 0..2_000 {
        let name = format!("/{number:0>255}");
        recorder.take(&sample_of(&name, number)).unwrap();
    }
    assert_driven::<RecordedNames>();
    let ended = recorder.finish(None);
    assert!(ended.report.no_room > 1_000, "{:?}", ended.report.no_room);
    assert_eq!(ended.report.topics["/tf"].messages, 512);
}

#[test]
fn any_number_of_excluded_topics_leaves_space_for_others() {
    let directory = tempfile::tempdir().unwrap();
    let options = FilterOptions {
        exclude_regex: Some("/excluded_.*".to_owned()),
        ..FilterOptions::everything()
    };
    let mut recorder = recorder(&directory.path().join("bag"), options);
    for number in 0..2 * u32::try_from(RecordedTopics::CAP).unwrap() {
        let name = format!("/excluded_{number:0>100}");
        recorder.take(&sample_of(&name, number)).unwrap();
    }
    recorder.take(&sample_of("/scan", 1)).unwrap();
    let ended = recorder.finish(None);
    assert_eq!((ended.report.messages, ended.report.no_room), (1, 0));
}
