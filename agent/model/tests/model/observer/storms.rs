//! Floods of forgeries: tables stay within their caps, and real topics are counted.

use ros2probe_model::observe::observer::Settings;
use ros2probe_testing::model::forge::Message;
use ros2probe_wire::{EntityId, Guid};

use super::{ALICE, BOB, Dice, OTHER, WRITER, World, alice, bob};

#[test]
fn a_storm_of_forgeries_leaves_memory_bounded_and_real_topics_counted() {
    let settings = Settings {
        participants: 64,
        endpoints: 512,
        ..Settings::default()
    };
    let mut world = World::with(&["/**"], settings);
    world.spdp(ALICE, 10);
    world.sedp(alice(WRITER), "rt/chatter");
    world.nodes(ALICE, 1, &[("/", "talker", alice(WRITER))]);
    world.stream(alice(WRITER), 1..=300);
    let mut dice = Dice(7);
    for number in 301..=1300 {
        for _ in 0..20 {
            let prefix = dice.prefix();
            let writer = Guid::new(prefix, WRITER);
            let topic = format!("rt/storm_{:x}{}", dice.roll(), "x".repeat(200));
            let fragment = vec![0; 60_000];
            world.spdp(prefix, 1_000_000);
            world.sedp(writer, &topic);
            world.sedp(writer, &format!("rt/'\"{}\n", "y".repeat(10_000)));
            world.nodes(prefix, 1, &[("/", "storm", writer)]);
            world.sample(Guid::new(dice.prefix(), OTHER), dice.roll());
            let stranger = Message::from(dice.prefix());
            world.put(stranger.fragment(OTHER, dice.roll(), 40, 1344, &fragment));
        }
        world.sample(alice(WRITER), number);
        world.wait(10);
    }
    let facts = world.measurement("/chatter");
    assert_eq!((facts.messages, facts.lost, facts.duplicates), (1300, 0, 0));
    let snapshot = world.snapshot();
    for table in &snapshot.tables {
        assert!(table.size <= table.limit, "{table:?}");
    }
    let talker = snapshot.nodes.iter().find(|node| node.name == "/talker");
    assert!(talker.is_some(), "the real node went under");
    let evictions = |name| {
        snapshot
            .tables
            .iter()
            .find(|table| table.table == name)
            .unwrap()
            .evictions
    };
    assert!(evictions("participants") > 0 && evictions("unknown_writers") > 0);
    assert!(
        snapshot
            .decode_errors
            .iter()
            .any(|error| error.stage == "sedp")
    );
}

#[test]
fn repeated_forgeries_with_endless_leases_do_not_fill_the_table_permanently() {
    let settings = Settings {
        participants: 64,
        ..Settings::default()
    };
    let mut world = World::with(&["/**"], settings);
    let mut dice = Dice(5);
    let forged: Vec<_> = (0..64).map(|_| dice.prefix()).collect();
    for _ in 0..3 {
        for prefix in &forged {
            world.spdp(*prefix, u32::MAX >> 1);
        }
        world.wait(1500);
    }
    let is_there = |world: &World| {
        let participants = world.snapshot().participants;
        participants.iter().any(|each| each.guid.prefix == ALICE)
    };
    world.spdp(ALICE, 10);
    assert!(!is_there(&world));
    world.wait(90_000);
    world.spdp(ALICE, 10);
    assert!(is_there(&world));
    assert_eq!(world.snapshot().participants.len(), 64);
}

#[test]
fn a_storm_of_endpoints_of_one_participant_does_not_exclude_others() {
    let settings = Settings {
        endpoints: 10_000,
        ..Settings::default()
    };
    let mut world = World::with(&["/**"], settings);
    world.spdp(BOB, 10);
    for index in 0..20_000_u16 {
        let [high, low] = index.to_be_bytes();
        world.sedp(
            bob(EntityId([0, high, low, 3])),
            &format!("rt/storm_{index}"),
        );
    }
    world.spdp(ALICE, 10);
    world.sedp(alice(WRITER), "rt/chatter");
    world.stream(alice(WRITER), 1..=10);
    assert!(world.topic(0, "/chatter").is_some());
    let endpoints = world
        .snapshot()
        .tables
        .into_iter()
        .find(|table| table.table == "endpoints");
    assert!(endpoints.is_some_and(|table| table.size <= 4097 && table.evictions >= 15_000));
}
