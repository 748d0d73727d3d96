//! Participants and endpoints appear, renew, are disposed, expire and return.

use ros2probe_model::observe::input::Input;
use ros2probe_testing::model::forge::{self, Message, SEDP_WRITERS, SPDP};
use ros2probe_wire::time::SECOND;
use ros2probe_wire::walk::Envelope;
use ros2probe_wire::{DomainId, EntityId, GuidPrefix, Timestamp};

use super::{ALICE, BOB, OTHER, READER, WRITER, World, alice, bob};

#[test]
fn topics_of_two_domains_are_counted_separately() {
    let mut world = World::new(&["/**"]);
    world.spdp(ALICE, 10);
    world.sedp(alice(WRITER), "rt/chatter");
    world.domain_id = 5;
    world.spdp(BOB, 10);
    world.sedp(bob(WRITER), "rt/chatter");
    for number in 1..=100 {
        world.sample(alice(WRITER), number);
        (0..5).for_each(|more| world.sample(bob(WRITER), 5 * number + more));
        world.wait(10);
    }
    let messages = |domain_id| {
        world
            .topic(domain_id, "/chatter")
            .unwrap()
            .measurement
            .unwrap()
    };
    assert_eq!((messages(0).messages, messages(5).messages), (100, 500));
}

/// Returns the SPDP payload of a participant that does not announce its domain, with this unicast
/// port of its discovery endpoints.
fn with_discovery_port(prefix: GuidPrefix, port: u16) -> Vec<u8> {
    let mut payload = forge::participant(prefix, 10, None);
    // Before the sentinel.
    payload.truncate(payload.len() - 4);
    let locator = [
        &[0x32, 0, 24, 0, 1, 0, 0, 0][..],
        &u32::from(port).to_le_bytes(),
        &[0; 12],
        &[10, 0, 0, 1],
    ]
    .concat();
    payload.extend(locator);
    payload.extend([1, 0, 0, 0]);
    payload
}

/// Returns the domains of the participants after this announcement arrived at a unicast port.
fn domains(prefix: GuidPrefix, payload: &[u8], destination_port: u16) -> Vec<u32> {
    let mut world = World::new(&[]);
    let envelope = Envelope {
        destination: [0; 16],
        destination_port,
        ..forge::multicast(world.now, 0)
    };
    world.observer.input(Input::Datagram {
        envelope: &envelope,
        payload: &Message::from(prefix).data(SPDP, 1, payload).bytes(),
        handover: None,
    });
    let participants = world.snapshot().participants.into_iter();
    participants.map(|each| each.domain_id.0).collect()
}

#[test]
fn the_port_of_a_discovery_server_does_not_decide_the_domain_of_its_clients() {
    // Port 11888 is that of a participant in domain 17.
    let client = |port| domains(ALICE, &with_discovery_port(ALICE, port), 11_888);
    assert_eq!(client(7410), [0]);
    assert_eq!(client(7410 + 42 * 250), [42]);
    // A port of its own that is in no domain's range shows no domain.
    assert_eq!(client(45_000), [0]);
    // Without one, the destination decides.
    let silent = forge::participant(ALICE, 10, None);
    assert_eq!(domains(ALICE, &silent, 7412 + 5 * 250), [5]);
    // The server announces itself to a client.
    let server = GuidPrefix(*b"DS\x00_EPROSIMA");
    let payload = with_discovery_port(server, 11_888);
    assert_eq!(domains(server, &payload, 7412 + 42 * 250), [42]);
}

#[test]
fn a_domain_from_a_more_reliable_port_moves_endpoints_and_topics() {
    let mut world = World::new(&["/**"]);
    let payload = forge::participant(ALICE, 10, None);
    let unicast = Envelope {
        destination_port: 11_811,
        ..forge::multicast(world.now, 0)
    };
    let unicast = Envelope {
        destination: [0; 16],
        ..unicast
    };
    world.observer.input(Input::Datagram {
        envelope: &unicast,
        payload: &Message::from(ALICE).data(SPDP, 1, &payload).bytes(),
        handover: None,
    });
    world.sedp(alice(WRITER), "rt/chatter");
    assert!(
        world
            .topic(0, "/chatter")
            .is_some_and(|topic| !topic.vanished)
    );
    world.domain_id = 3;
    world.spdp(ALICE, 10);
    assert!(
        world
            .topic(0, "/chatter")
            .is_some_and(|topic| topic.vanished)
    );
    assert_eq!(world.topic(3, "/chatter").unwrap().publishers.len(), 1);
    assert_eq!(world.snapshot().participants[0].domain_id, DomainId(3));
    assert_eq!(world.churn("writer", "appeared"), 1);
}

#[test]
fn disposals_by_key_and_by_hash_take_effect_immediately() {
    for by_key in [true, false] {
        let mut world = World::new(&["/**"]);
        world.spdp(ALICE, 10);
        world.sedp(alice(WRITER), "rt/chatter");
        world.sedp(alice(READER), "rt/other");
        world.wait(1000);
        let gone = |writer, pid, guid| {
            let message = Message::from(ALICE);
            match by_key {
                true => message.dispose_by_key(writer, 99, pid, guid),
                false => message.dispose_by_hash(writer, 99, guid),
            }
        };
        world.put(gone(SEDP_WRITERS, 0x5a, alice(WRITER)));
        assert!(world.topic(0, "/chatter").unwrap().vanished);
        assert!(!world.topic(0, "/other").unwrap().vanished);
        world.put(gone(SPDP, 0x50, alice(EntityId::PARTICIPANT)));
        assert!(world.snapshot().participants.is_empty());
        assert!(world.topic(0, "/other").unwrap().vanished, "no cascade");
        let disposed = ["participant", "writer", "reader"].map(|who| world.churn(who, "disposed"));
        assert_eq!(
            (disposed, world.churn("reader", "cascaded")),
            ([1, 1, 0], 1)
        );
    }
}

#[test]
fn a_disposed_writer_does_not_return_with_its_participants_announcements() {
    let mut world = World::new(&["/**"]);
    world.spdp(ALICE, 10);
    world.sedp(alice(WRITER), "rt/chatter");
    world.sedp(alice(OTHER), "rt/other");
    world.wait(1000);
    world.put(Message::from(ALICE).dispose_by_hash(SEDP_WRITERS, 99, alice(WRITER)));
    for _ in 0..20 {
        world.spdp(ALICE, 10);
        world.wait(1000);
    }
    assert!(world.topic(0, "/chatter").unwrap().publishers.is_empty());
    assert_eq!(world.topic(0, "/other").unwrap().publishers.len(), 1);
}

#[test]
fn a_killed_participant_is_removed_with_its_endpoints_when_its_lease_ends() {
    for lease in [10, 20] {
        let mut world = World::new(&["/**"]);
        world.spdp(ALICE, lease);
        world.sedp(alice(WRITER), "rt/chatter");
        world.nodes(ALICE, 1, &[("/", "talker", alice(WRITER))]);
        world.wait(5000);
        // Any packet renews the lease.
        world.sample(alice(WRITER), 1);
        let last = world.now;
        world.wait(u64::from(lease) * 1000 - 200);
        assert_eq!(
            (
                world.snapshot().participants.len(),
                world.node_names().len()
            ),
            (1, 1)
        );
        world.wait(1000);
        assert!(world.snapshot().participants.is_empty() && world.node_names().is_empty());
        assert!(world.topic(0, "/chatter").unwrap().vanished);
        let events: Vec<_> = world.observer.journal().discovery().cloned().collect();
        let expired = events
            .iter()
            .find(|event| event.event == "expired")
            .unwrap();
        assert_eq!(expired.at.nanoseconds(), last + u64::from(lease) * SECOND);
        let cascaded: Vec<_> = events
            .iter()
            .filter(|event| event.event == "cascaded")
            .map(|event| event.entity)
            .collect();
        assert_eq!(cascaded, ["writer", "node"]);
    }
}

#[test]
fn a_sign_of_life_from_the_kernel_renews_the_lease() {
    let mut world = World::new(&[]);
    world.spdp(ALICE, 10);
    for _ in 0..5 {
        world.wait(8000);
        for prefix in [ALICE, BOB] {
            let alive = Input::ParticipantAlive(prefix, Timestamp(world.now));
            world.observer.input(alive);
        }
    }
    assert_eq!(world.snapshot().participants.len(), 1);
}

#[test]
fn a_participant_that_returns_with_the_same_guid_continues_its_counts() {
    let mut world = World::new(&["/**"]);
    for round in 1..=3 {
        world.spdp(ALICE, 10);
        world.sedp(alice(WRITER), "rt/chatter");
        world.nodes(ALICE, 1, &[("/", "talker", alice(WRITER))]);
        world.stream(alice(WRITER), 1..=100);
        assert_eq!(world.node_names(), ["/talker"]);
        assert_eq!(world.measurement("/chatter").messages, 100 * round);
        let me = alice(EntityId::PARTICIPANT);
        world.put(Message::from(ALICE).dispose_by_key(SPDP, 2, 0x50, me));
        world.wait(3000);
    }
    let facts = world.measurement("/chatter");
    assert_eq!((facts.lost, facts.duplicates), (0, 0));
    assert_eq!(world.churn("participant", "appeared"), 3);
}

#[test]
fn an_announcement_overtaken_by_a_disposal_restores_no_endpoint() {
    let mut world = World::new(&["/**"]);
    world.spdp(ALICE, 10);
    world.sedp(alice(WRITER), "rt/chatter");
    world.wait(1000);
    world.put(Message::from(ALICE).dispose_by_hash(SEDP_WRITERS, 99, alice(WRITER)));
    world.wait(1);
    world.sedp(alice(WRITER), "rt/chatter");
    assert!(world.topic(0, "/chatter").unwrap().vanished);
}
