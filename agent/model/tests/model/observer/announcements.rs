//! Discovery data: repeated, fragmented, relayed, malformed; names of nodes.

use ros2probe_model::graph::discovery::Memory;
use ros2probe_model::observe::input::Input;
use ros2probe_testing::model::forge::{self, Message, SEDP_WRITERS, SPDP};
use ros2probe_wire::qos::Reliability;
use ros2probe_wire::{EntityId, GuidPrefix, Timestamp};

use super::{ALICE, BOB, NODES, OTHER, STRING, WRITER, World, alice, bob};

#[test]
fn repeated_announcements_raise_no_event_and_changed_ones_do() {
    let mut world = World::new(&["/**"]);
    for _ in 0..10 {
        world.spdp(ALICE, 10);
        world.sedp(alice(WRITER), "rt/chatter");
        world.nodes(ALICE, 1, &[("/", "talker", alice(WRITER))]);
        world.wait(1000);
    }
    let best_effort = forge::endpoint(alice(WRITER), "rt/chatter", STRING, false);
    world.put(Message::from(ALICE).data(SEDP_WRITERS, 50, &best_effort));
    let counts = |event| ["participant", "writer", "node"].map(|who| world.churn(who, event));
    assert_eq!(counts("appeared"), [1, 1, 1]);
    assert_eq!(counts("changed"), [0, 1, 0]);
    assert_eq!(
        world.topic(0, "/chatter").unwrap().publishers[0]
            .qos
            .reliability,
        Reliability::BEST_EFFORT
    );
}

#[test]
fn the_only_sample_of_ros_discovery_info_is_kept_if_it_arrives_first() {
    for gid_len in [16, 24] {
        let mut world = World::new(&[]);
        let nodes = [
            ("/robot1", "lidar", alice(WRITER)),
            ("/", "talker", alice(OTHER)),
        ];
        let payload = forge::entities(ALICE, gid_len, &nodes);
        world.put(Message::from(ALICE).data(NODES, 7, &payload));
        world.wait(50);
        world.sedp(alice(NODES), "ros_discovery_info");
        world.sedp(alice(WRITER), "rt/points");
        world.wait(50);
        assert!(world.node_names().is_empty());
        world.spdp(ALICE, 10);
        assert_eq!(world.node_names(), ["/robot1/lidar", "/talker"]);
        let publisher = &world.topic(0, "/points").unwrap().publishers[0];
        assert_eq!(publisher.node.as_deref(), Some("/robot1/lidar"));
    }
}

#[test]
fn ros_discovery_info_in_fragments_is_read() {
    let mut world = World::new(&[]);
    world.spdp(ALICE, 10);
    let names: Vec<_> = (0..60).map(|index| format!("node_{index:02}")).collect();
    let nodes: Vec<_> = names
        .iter()
        .map(|name| ("/fleet", name.as_str(), alice(WRITER)))
        .collect();
    let payload = forge::entities(ALICE, 24, &nodes);
    assert!(payload.len() > 2 * 1344);
    for start in 1..=u32::try_from(payload.len().div_ceil(1344)).unwrap() {
        world.put(Message::from(ALICE).fragment(NODES, 3, start, 1344, &payload));
    }
    assert_eq!(world.node_names().len(), 60);
}

#[test]
fn only_the_newest_node_list_of_the_participant_applies() {
    let mut world = World::new(&[]);
    world.spdp(ALICE, 10);
    world.spdp(BOB, 10);
    world.nodes(
        ALICE,
        5,
        &[("/", "one", alice(WRITER)), ("/", "two", alice(OTHER))],
    );
    world.nodes(ALICE, 4, &[("/", "old", alice(WRITER))]);
    let forged = forge::entities(ALICE, 24, &[("/", "forged", alice(WRITER))]);
    world.put(Message::from(BOB).data(NODES, 9, &forged));
    assert_eq!(world.node_names(), ["/one", "/two"]);
    world.nodes(ALICE, 6, &[("/", "two", alice(OTHER))]);
    assert_eq!(world.node_names(), ["/two"]);
    assert_eq!(
        (
            world.churn("node", "appeared"),
            world.churn("node", "disposed")
        ),
        (2, 1)
    );
}

#[test]
fn announcements_relayed_by_a_discovery_server_apply_to_their_participant() {
    let server = GuidPrefix(*b"DS\x00_EPROSIMA");
    let mut world = World::new(&["/**"]);
    let relay = |writer, payload: &[u8]| Message::from(server).data(writer, 1, payload);
    world.put(relay(SPDP, &forge::participant(ALICE, 20, None)));
    world.put(relay(
        SEDP_WRITERS,
        &forge::endpoint(alice(WRITER), "rt/chatter", STRING, true),
    ));
    world.stream(alice(WRITER), 1..=10);
    let snapshot = world.snapshot();
    assert_eq!(snapshot.participants[0].guid, alice(EntityId::PARTICIPANT));
    assert_eq!(world.measurement("/chatter").messages, 10);
    world.put(Message::from(server).dispose_by_hash(SPDP, 2, alice(EntityId::PARTICIPANT)));
    assert!(world.snapshot().participants.is_empty());
}

#[test]
fn a_discovery_server_is_known_by_its_type_or_prefix_also_after_a_restart() {
    let mut world = World::new(&[]);
    let kinds = ["SERVER", "BACKUP", "CLIENT", "SIMPLE"];
    for (number, kind) in (1..).zip(kinds) {
        let prefix = GuidPrefix([number; 12]);
        let payload = forge::participant_of_type(prefix, kind);
        world.put(Message::from(prefix).data(SPDP, 1, &payload));
    }
    world.spdp(GuidPrefix(*b"DS\x00_EPROSIMA"), 20);
    let servers = |world: &mut World| -> Vec<bool> {
        let participants = world.snapshot().participants;
        participants.iter().map(|it| it.discovery_server).collect()
    };
    let expected = [true, true, false, false, true];
    assert_eq!(servers(&mut world), expected);
    let memory = world.observer.memory();
    let mut restarted = World::new(&[]);
    restarted.now = world.now;
    restarted.observer.input(Input::Restored {
        memory: &memory,
        now: Timestamp(world.now),
    });
    assert_eq!(servers(&mut restarted), expected);
}

#[test]
fn a_participant_that_a_discovery_server_announced_once_stays_until_it_is_disposed() {
    let server = GuidPrefix(*b"DS\x00_EPROSIMA");
    let mut world = World::new(&["/**"]);
    let relayed = |message: Message| message.data(SPDP, 1, &forge::participant(ALICE, 20, None));
    // The server repeats its own announcement.
    let wait = |world: &mut World, seconds: u64| {
        for _ in 0..seconds {
            world.spdp(server, 3);
            world.wait(1000);
        }
    };
    wait(&mut world, 1);
    world.put(relayed(Message::from(server)));
    world.sedp(alice(WRITER), "rt/chatter");
    wait(&mut world, 60);
    assert_eq!(world.snapshot().participants.len(), 2);
    let memory = serde_json::to_string(&world.observer.memory()).unwrap();
    world.put(Message::from(server).dispose_by_hash(SPDP, 2, alice(EntityId::PARTICIPANT)));
    assert_eq!(world.snapshot().participants.len(), 1);

    // Without its server, the lease of a participant counts from the server's end.
    wait(&mut world, 1);
    let again = forge::participant(ALICE, 20, None);
    world.put(Message::from(server).data(SPDP, 3, &again));
    wait(&mut world, 60);
    world.wait(21_000);
    let left = world.snapshot().participants;
    assert_eq!((left.len(), left[0].guid.prefix), (1, ALICE));
    world.wait(2000);
    assert!(world.snapshot().participants.is_empty());

    // A server that comes back has never heard of the participant, unless it relays it again.
    let mut back = World::new(&["/**"]);
    wait(&mut back, 1);
    back.put(relayed(Message::from(server)));
    back.wait(10_000);
    wait(&mut back, 20);
    let left = back.snapshot().participants;
    assert_eq!((left.len(), left[0].guid.prefix), (1, server));

    // One of two servers ends, and the other one keeps the participant.
    let second = GuidPrefix(*b"DS\x01_EPROSIMA");
    let mut two = World::new(&["/**"]);
    for server in [server, second] {
        two.spdp(server, 3);
        two.put(relayed(Message::from(server)));
    }
    wait(&mut two, 60);
    assert_eq!(two.snapshot().participants.len(), 2);

    // A restarted agent cannot know that the server disposed of a participant in the meantime.
    let memory: Memory = serde_json::from_str(&memory).unwrap();
    let mut restarted = World::new(&["/**"]);
    restarted.now = world.now;
    let now = Timestamp(restarted.now);
    restarted.observer.input(Input::Restored {
        memory: &memory,
        now,
    });
    wait(&mut restarted, 60);
    assert_eq!(restarted.snapshot().participants.len(), 2);
    wait(&mut restarted, 31);
    assert_eq!(restarted.snapshot().participants.len(), 1);

    // The last announcement counts: a direct one brings the lease back.
    let mut world = World::new(&["/**"]);
    for sender in [server, ALICE, server] {
        world.put(relayed(Message::from(sender)));
    }
    world.wait(19_000);
    assert_eq!(world.snapshot().participants.len(), 1);
    world.wait(2000);
    assert!(world.snapshot().participants.is_empty());
}

#[test]
fn the_strength_of_a_publisher_is_known_also_after_a_restart() {
    let mut world = World::new(&["/**"]);
    world.spdp(ALICE, 10);
    let parameters: [(u16, &[u8]); 2] = [(0x1f, &[1, 0, 0, 0]), (0x06, &[8, 0, 0, 0])];
    let payload = forge::endpoint_with(alice(WRITER), "rt/chatter", STRING, &parameters);
    world.put(Message::from(ALICE).data(SEDP_WRITERS, 1, &payload));
    let strength = |world: &World| {
        let topic = world.topic(0, "/chatter").unwrap();
        topic.publishers[0].qos.ownership_strength
    };
    assert_eq!(strength(&world), 8);
    let memory = world.observer.memory();
    let mut restarted = World::new(&["/**"]);
    restarted.now = world.now;
    restarted.observer.input(Input::Restored {
        memory: &memory,
        now: Timestamp(world.now),
    });
    assert_eq!(strength(&restarted), 8);
}

#[test]
fn several_samples_of_several_writers_in_one_datagram_all_count() {
    let mut world = World::new(&["/**"]);
    world.spdp(ALICE, 10);
    world.sedp(alice(WRITER), "rt/one");
    world.sedp(alice(OTHER), "rt/two");
    let sample = [0, 1, 0, 0, 1, 2, 3, 4];
    let message = Message::from(ALICE).info_ts(world.now);
    let message = message
        .data(WRITER, 1, &sample)
        .data(OTHER, 1, &sample)
        .data(WRITER, 2, &sample);
    world.put(message.data(OTHER, 2, &sample).data(OTHER, 3, &sample));
    assert_eq!(world.measurement("/one").messages, 2);
    assert_eq!(world.measurement("/two").messages, 3);
}

#[test]
fn a_malformed_datagram_increments_one_counter() {
    let mut world = World::new(&["/**"]);
    world.spdp(ALICE, 10);
    world.sedp(alice(WRITER), "rt/chatter");
    let good = [
        Message::from(BOB)
            .data(SPDP, 1, &forge::participant(BOB, 10, Some(0)))
            .bytes(),
        Message::from(BOB)
            .data(
                SEDP_WRITERS,
                1,
                &forge::endpoint(bob(WRITER), "rt/chatter", STRING, true),
            )
            .bytes(),
        Message::from(BOB)
            .data(
                NODES,
                1,
                &forge::entities(BOB, 16, &[("/", "bob", bob(WRITER))]),
            )
            .bytes(),
        Message::from(BOB)
            .dispose_by_key(SEDP_WRITERS, 9, 0x5a, bob(WRITER))
            .bytes(),
    ];
    for good in &good {
        let envelope = forge::multicast(world.now, 0);
        for len in 0..good.len() {
            world.observer.input(Input::Datagram {
                envelope: &envelope,
                payload: &good[..len],
                handover: None,
            });
        }
        for place in 20..good.len() {
            for value in [0x00, 0x7f, 0xff] {
                let mut bad = good.clone();
                bad[place] = value;
                world.observer.input(Input::Datagram {
                    envelope: &envelope,
                    payload: &bad,
                    handover: None,
                });
            }
        }
    }
    let before: u64 = world
        .snapshot()
        .decode_errors
        .iter()
        .map(|error| error.count)
        .sum();
    let text = forge::endpoint(bob(OTHER), "rt/\"\n\\", STRING, true);
    world.put(Message::from(BOB).data(SEDP_WRITERS, 77, &text));
    let after: u64 = world
        .snapshot()
        .decode_errors
        .iter()
        .map(|error| error.count)
        .sum();
    assert_eq!(after, before + 1);
    world.stream(alice(WRITER), 1..=100);
    let publishers = world.topic(0, "/chatter").unwrap().publishers;
    let alice = publishers
        .iter()
        .find(|each| each.guid == alice(WRITER))
        .unwrap();
    assert_eq!(alice.measurement.as_ref().unwrap().messages, 100);
}
