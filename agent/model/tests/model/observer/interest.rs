//! Watches, the resulting interest, and the topics that are measured.

use std::sync::Arc;

use ros2probe_model::observe::input::Input;
use ros2probe_model::observe::observer::Settings;
use ros2probe_model::report::snapshot::TopicFacts;
use ros2probe_testing::model::forge::{Message, SEDP_WRITERS};
use ros2probe_wire::EntityId;
use ros2probe_wire::record::Verdict;

use super::{ALICE, BOB, NODES, OTHER, READER, WRITER, World, alice, bob, watchlist};

#[test]
fn changes_of_discovery_and_of_watches_change_the_interest() {
    let mut world = World::new(&["/chatter"]);
    world.spdp(ALICE, 10);
    world.sedp(alice(WRITER), "rt/chatter");
    world.sedp(alice(OTHER), "rt/other");
    world.sedp(alice(NODES), "ros_discovery_info");
    world.spdp(BOB, 10);
    world.sedp(bob(READER), "rt/chatter");
    let changes = world.observer.drain().interest;
    let mut expected = vec![
        (alice(NODES), Some(Verdict::Capture)),
        (alice(WRITER), Some(Verdict::Meter)),
        (alice(OTHER), Some(Verdict::Ignore)),
        (bob(READER), Some(Verdict::Meter)),
    ];
    expected.sort_unstable();
    assert_eq!(changes, expected);

    world
        .observer
        .input(Input::Watchlist(Arc::new(watchlist(&["/other"]))));
    let changes = world.observer.drain().interest;
    let mut expected = vec![
        (alice(WRITER), Some(Verdict::Ignore)),
        (alice(OTHER), Some(Verdict::Meter)),
        (bob(READER), None),
    ];
    expected.sort_unstable_by_key(|(guid, verdict)| (verdict.is_some(), *guid));
    assert_eq!(changes, expected);

    world.wait(11_000);
    let gone = world.observer.drain().interest;
    assert_eq!(gone.len(), 3);
    assert!(gone.iter().all(|(_, verdict)| verdict.is_none()));
}

#[test]
fn topics_above_the_cap_are_rejected_and_counted() {
    let mut world = World::with(
        &["/**"],
        Settings {
            topics: 2,
            ..Settings::default()
        },
    );
    world.spdp(ALICE, 10);
    for (index, topic) in ["rt/a", "rt/b", "rt/c"].into_iter().enumerate() {
        let entity = EntityId([0, 0, 0x20 + u8::try_from(index).unwrap(), 3]);
        world.sedp(alice(entity), topic);
    }
    let rejected = alice(EntityId([0, 0, 0x22, 3]));
    assert!(
        world
            .observer
            .drain()
            .interest
            .contains(&(rejected, Some(Verdict::Ignore)))
    );
    assert_eq!(world.snapshot().topics_rejected, 1);
    // A freed slot is used.
    world.put(Message::from(ALICE).dispose_by_hash(
        SEDP_WRITERS,
        99,
        alice(EntityId([0, 0, 0x20, 3])),
    ));
    world.spdp(ALICE, 10);
    world
        .observer
        .input(Input::Watchlist(Arc::new(watchlist(&["/**"]))));
    assert!(
        world
            .observer
            .drain()
            .interest
            .contains(&(rejected, Some(Verdict::Meter)))
    );
}

#[test]
fn lists_of_costly_globs_are_matched_in_parts() {
    const TOPICS: u16 = 400;
    let mut world = World::new(&["/chatter"]);
    world.spdp(ALICE, 100);
    world.sedp(alice(WRITER), "rt/chatter");
    for number in 0..TOPICS {
        let [high, low] = number.to_be_bytes();
        let entity = EntityId([1 + high, low, 0x21, 3]);
        world.sedp(alice(entity), &format!("rt/topic_{number}"));
    }
    let globs = (0..250).map(|number| format!("/{}{number}", "*a".repeat(15)));
    let mut patterns: Vec<_> = globs.collect();
    patterns.push("/topic_*".to_owned());
    let patterns: Vec<&str> = patterns.iter().map(String::as_str).collect();
    world
        .observer
        .input(Input::Watchlist(Arc::new(watchlist(&patterns))));
    assert!(!world.observer.has_applied_lists());
    let is_measured = |topic: &TopicFacts| topic.measurement.is_some();
    let some = world
        .snapshot()
        .topics
        .iter()
        .filter(|it| is_measured(it))
        .count();
    assert!(some < usize::from(TOPICS) / 2, "{some}");
    // The topic is still counted.
    world.sample(alice(WRITER), 1);
    let mut rounds = 0;
    while !world.observer.has_applied_lists() {
        world.observer.input(Input::MoreLists);
        rounds += 1;
    }
    assert!((2..10).contains(&rounds), "{rounds}");
    let snapshot = world.snapshot();
    let topics = snapshot
        .topics
        .iter()
        .filter(|it| it.name.starts_with("/topic_"));
    assert_eq!(
        topics.filter(|it| is_measured(it)).count(),
        usize::from(TOPICS)
    );
}

#[test]
fn counts_of_a_topic_survive_its_writer_and_its_watch() {
    let mut world = World::new(&["/chatter"]);
    world.spdp(ALICE, 100);
    world.sedp(alice(WRITER), "rt/chatter");
    world.stream(alice(WRITER), 1..=50);
    world
        .observer
        .input(Input::Watchlist(Arc::new(watchlist(&[]))));
    world.stream(alice(WRITER), 51..=70);
    world
        .observer
        .input(Input::Watchlist(Arc::new(watchlist(&["/chatter"]))));
    world.stream(alice(WRITER), 71..=100);
    world.wait(15_000);
    let facts = world.measurement("/chatter");
    assert_eq!((facts.messages, facts.lost), (80, 0));
    world.put(Message::from(ALICE).dispose_by_hash(SEDP_WRITERS, 99, alice(WRITER)));
    let topic = world.topic(0, "/chatter").unwrap();
    assert!(topic.vanished && topic.message_types == ["std_msgs/msg/String"]);
    assert_eq!(topic.measurement.unwrap().messages, 80);
    world.wait(601_000);
    assert!(world.topic(0, "/chatter").is_none());
}

#[test]
fn a_rejected_topic_is_measured_once_other_topics_have_vanished() {
    let settings = Settings {
        topics: 4,
        ..Settings::default()
    };
    let mut world = World::with(&["/**"], settings);
    world.spdp(BOB, 10);
    for index in 0..9_u8 {
        let writer = bob(EntityId([0, 1, index, 3]));
        world.sedp(writer, &format!("rt/crowd_{index}"));
    }
    world.spdp(ALICE, 100);
    world.sedp(alice(WRITER), "rt/chatter");
    world.stream(alice(WRITER), 1..=10);
    assert!(world.topic(0, "/chatter").unwrap().measurement.is_none());
    world.wait(12_000);
    world.stream(alice(WRITER), 11..=20);
    assert_eq!(world.measurement("/chatter").messages, 10);
}
