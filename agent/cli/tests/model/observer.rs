//! The core under forged traffic and virtual time: what discovery, interest and measurement must
//! do, each named after what went wrong in observers before.

use ros2probe_daemon::config::{Expectations, Watch, Watchlist};
use ros2probe_model::churn;
use ros2probe_model::event::EventKind;
use ros2probe_model::input::Input;
use ros2probe_model::observer::{Observer, Settings};
use ros2probe_model::snapshot::{Measurement, Snapshot, SocketFacts, TopicFacts, WatchState};
use ros2probe_testing::model::forge::{self, Message, SEDP_READERS, SEDP_WRITERS, SPDP};
use ros2probe_wire::record::Verdict;
use ros2probe_wire::time::MILLISECOND;
use ros2probe_wire::time::SECOND;
use ros2probe_wire::walk::Envelope;
use ros2probe_wire::{DomainId, EntityId, Guid, GuidPrefix, Timestamp};
use std::sync::Arc;

const START: u64 = 1_795_143_000 * SECOND;
const STRING: &str = "std_msgs::msg::dds_::String_";
const WRITER: EntityId = EntityId([0, 0, 0x11, 0x03]);
const OTHER: EntityId = EntityId([0, 0, 0x12, 0x03]);
const READER: EntityId = EntityId([0, 0, 0x13, 0x04]);
const NODES: EntityId = EntityId([0, 0, 0x04, 0x03]);
const ALICE: GuidPrefix = GuidPrefix(*b"\x01\x10alice-host");
const BOB: GuidPrefix = GuidPrefix(*b"\x01\x10bobby-host");

/// An observer with virtual time.
struct World {
    observer: Observer,
    now: u64,
    /// Domain whose multicast port everything goes to.
    domain_id: u16,
}

impl World {
    fn new(patterns: &[&str]) -> Self {
        Self::with(patterns, Settings::default())
    }

    fn with(patterns: &[&str], settings: Settings) -> Self {
        let mut observer = Observer::new(settings);
        observer.input(Input::Watchlist(Arc::new(watchlist(patterns))));
        observer.input(Input::Time(Timestamp(START)));
        Self {
            observer,
            now: START,
            domain_id: 0,
        }
    }

    fn put(&mut self, message: Message) {
        let envelope = forge::multicast(self.now, self.domain_id);
        self.observer.input(Input::Datagram {
            envelope: &envelope,
            payload: &message.bytes(),
            handover: None,
        });
    }

    fn wait(&mut self, milliseconds: u64) {
        self.now += milliseconds * MILLISECOND;
        self.observer.input(Input::Time(Timestamp(self.now)));
    }

    fn spdp(&mut self, prefix: GuidPrefix, lease_seconds: u32) {
        let payload = forge::participant(prefix, lease_seconds, None);
        self.put(Message::from(prefix).data(SPDP, 1, &payload));
    }

    fn sedp(&mut self, guid: Guid, topic: &str) {
        let (sedp, number) = match guid.entity.is_writer() {
            true => (SEDP_WRITERS, u64::from(guid.entity.0[2])),
            false => (SEDP_READERS, u64::from(guid.entity.0[2])),
        };
        let payload = forge::endpoint(guid, topic, STRING, true);
        self.put(Message::from(guid.prefix).data(sedp, number, &payload));
    }

    fn nodes(&mut self, prefix: GuidPrefix, number: u64, nodes: &[(&str, &str, Guid)]) {
        let payload = forge::entities(prefix, 24, nodes);
        self.put(Message::from(prefix).data(NODES, number, &payload));
    }

    fn sample(&mut self, guid: Guid, number: u64) {
        let message = Message::from(guid.prefix).info_ts(self.now);
        self.put(message.data(guid.entity, number, &[0, 1, 0, 0, 9, 9, 9, 9]));
    }

    /// 100 samples a second.
    fn stream(&mut self, guid: Guid, numbers: std::ops::RangeInclusive<u64>) {
        for number in numbers {
            self.sample(guid, number);
            self.wait(10);
        }
    }

    fn snapshot(&self) -> Snapshot {
        self.observer.snapshot(Timestamp(self.now))
    }

    fn topic(&self, domain_id: u32, name: &str) -> Option<TopicFacts> {
        let mut topics = self.snapshot().topics.into_iter();
        topics.find(|topic| topic.domain_id == DomainId(domain_id) && topic.name == name)
    }

    fn measurement(&self, name: &str) -> Measurement {
        self.topic(0, name)
            .and_then(|topic| topic.measurement)
            .map(|measurement| *measurement)
            .unwrap_or_default()
    }

    fn churn(&self, entity: &str, event: &str) -> u64 {
        let churn = self.snapshot().churn;
        let counts = churn
            .iter()
            .filter(|count| (count.entity, count.event) == (entity, event));
        counts.map(|count| count.count).sum()
    }

    /// What was noticed since the last call, and when, counted from the start.
    fn events(&mut self) -> Vec<(u64, EventKind)> {
        let events = self.observer.drain().events.events.into_iter();
        let told = events.map(|event| ((event.at.0 - START) / MILLISECOND, event.kind));
        told.collect()
    }

    fn node_names(&self) -> Vec<String> {
        self.snapshot()
            .nodes
            .into_iter()
            .map(|node| node.name)
            .collect()
    }
}

fn watchlist(patterns: &[&str]) -> Watchlist {
    let watch = |pattern: &&str| Watch {
        pattern: (*pattern).to_owned(),
        domain_id: None,
        expectations: Expectations::default(),
        per_subscriber: false,
        trace: 0.0,
        retain: ros2probe_daemon::config::Retain::None,
    };
    Watchlist::new(patterns.iter().map(watch).collect()).unwrap()
}

fn alice(entity: EntityId) -> Guid {
    Guid::new(ALICE, entity)
}

fn bob(entity: EntityId) -> Guid {
    Guid::new(BOB, entity)
}

#[test]
fn domains_are_not_mixed() {
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

#[test]
fn a_domain_told_by_a_better_port_moves_everything_along() {
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
fn disposals_of_both_forms_are_seen_at_once() {
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
fn a_deleted_writer_does_not_stay_because_its_participant_is_announced_again() {
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
fn a_killed_participant_goes_with_all_it_had_when_its_lease_ends() {
    for lease in [10, 20] {
        let mut world = World::new(&["/**"]);
        world.spdp(ALICE, lease);
        world.sedp(alice(WRITER), "rt/chatter");
        world.nodes(ALICE, 1, &[("/", "talker", alice(WRITER))]);
        world.wait(5000);
        // Any sign of life renews the lease.
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
        assert_eq!(expired.at.0, last + u64::from(lease) * SECOND);
        let cascaded: Vec<_> = events
            .iter()
            .filter(|event| event.event == "cascaded")
            .map(|event| event.entity)
            .collect();
        assert_eq!(cascaded, ["writer", "node"]);
    }
}

#[test]
fn who_comes_and_goes_is_told_with_what_was_known_of_it() {
    let mut world = World::new(&[]);
    world.spdp(ALICE, 10);
    world.sedp(alice(WRITER), "rt/chatter");
    world.nodes(ALICE, 1, &[("/", "talker", alice(WRITER))]);
    let told = world.events();
    let changes = |told: &[(u64, EventKind)], wanted: churn::Event| {
        let kinds = told.iter().map(|(_, kind)| match kind {
            EventKind::Participant { change, guid, .. } => {
                assert_eq!(guid.prefix, ALICE);
                ("participant", *change)
            }
            EventKind::Endpoint {
                change,
                guid,
                topic,
                message_type,
                ..
            } => {
                assert_eq!((*guid, &**topic), (alice(WRITER), "rt/chatter"));
                assert_eq!(&**message_type, "std_msgs/msg/String");
                ("endpoint", *change)
            }
            EventKind::Node { change, name, .. } => {
                assert_eq!(&**name, "/talker");
                ("node", *change)
            }
            other => panic!("{other:?}"),
        });
        let kinds: Vec<_> = kinds.collect();
        kinds.iter().filter(|(_, change)| *change == wanted).count()
    };
    assert_eq!((told.len(), changes(&told, churn::Event::Appeared)), (3, 3));
    assert!(world.events().is_empty());
    world.wait(11_000);
    let mut told = world.events();
    // And that nobody heard it, for as long as it was there.
    told.retain(|(_, kind)| !matches!(kind, EventKind::Diagnosis { .. }));
    assert_eq!(told.len(), 3);
    assert_eq!(changes(&told, churn::Event::Expired), 1);
    assert_eq!(changes(&told, churn::Event::Cascaded), 2);
    assert!(told.iter().all(|(at, _)| *at == 10_000));
}

#[test]
fn losses_are_told_once_a_second_with_topic_and_node_also_of_a_writer_that_has_gone() {
    let mut world = World::new(&["/**"]);
    world.spdp(ALICE, 100);
    world.sedp(alice(WRITER), "rt/chatter");
    world.nodes(ALICE, 1, &[("/", "talker", alice(WRITER))]);
    world.sample(alice(WRITER), 1);
    world.events();
    // Three gaps within a second: 2, 4 to 5, 7.
    for number in [3, 6, 8] {
        world.wait(100);
        world.sample(alice(WRITER), number);
    }
    let losses = |world: &mut World| -> Vec<_> {
        let told = world.events().into_iter();
        let losses = told.filter_map(|(_, kind)| match kind {
            EventKind::Loss(burst) => Some(burst),
            _ => None,
        });
        losses.collect()
    };
    // The writer is reliable: it may retransmit for ten seconds.
    world.wait(9_000);
    assert_eq!(losses(&mut world), []);
    world.wait(4_000);
    let told = losses(&mut world);
    assert!((1..=2).contains(&told.len()), "{told:?}");
    assert_eq!(told.iter().map(|burst| burst.count).sum::<u64>(), 4);
    assert_eq!((told[0].first, told.last().unwrap().last), (2, 7));
    for burst in &told {
        assert_eq!(burst.writer, alice(WRITER));
        assert_eq!(burst.topic, Some((DomainId(0), "rt/chatter".into())));
        assert_eq!(burst.node.as_deref(), Some("/talker"));
    }

    world.sample(alice(WRITER), 10);
    let dispose = Message::from(ALICE).dispose_by_hash(SEDP_WRITERS, 200, alice(WRITER));
    world.put(dispose);
    world.wait(1_000);
    let told = losses(&mut world);
    assert_eq!(told.len(), 1);
    assert_eq!((told[0].first, told[0].last, told[0].count), (9, 9, 1));
    assert_eq!(told[0].topic, Some((DomainId(0), "rt/chatter".into())));
}

#[test]
fn a_changed_expectation_is_told_once_and_another_watch_changes_nothing() {
    let expects = |pattern: &str, max_silence_s| Watch {
        expectations: Expectations {
            max_silence_s,
            ..Expectations::default()
        },
        ..Watch::named(pattern).unwrap()
    };
    let chatter = expects("/chatter", Some(2.0));
    let mut world = World::new(&[]);
    let watch = |world: &mut World, watches: Vec<Watch>| {
        let watchlist = Watchlist::new(watches).unwrap();
        world.observer.input(Input::Watchlist(Arc::new(watchlist)));
    };
    watch(&mut world, vec![chatter.clone()]);
    world.spdp(ALICE, 100);
    world.sedp(alice(WRITER), "rt/chatter");
    world.spdp(BOB, 100);
    world.sedp(bob(READER), "rt/chatter");
    world.stream(alice(WRITER), 1..=150);
    let states = |world: &mut World| -> Vec<_> {
        let told = world.events().into_iter();
        let states = told.filter_map(|(_, kind)| match kind {
            EventKind::Expectation {
                from,
                to,
                violations,
                ..
            } => Some((from, to, violations)),
            EventKind::Silence { last_message, .. } => {
                assert!(last_message.is_some());
                Some((None, WatchState::Silent, vec!["silence"]))
            }
            _ => None,
        });
        states.collect()
    };
    assert_eq!(states(&mut world), []);
    world.wait(5_000);
    let silent = (
        Some(WatchState::Ok),
        WatchState::Silent,
        vec!["max_silence_s"],
    );
    let silence = (None, WatchState::Silent, vec!["silence"]);
    assert_eq!(states(&mut world), [silent, silence]);

    // In front of it, so that its place in the list is another.
    watch(&mut world, vec![expects("/other", None), chatter.clone()]);
    world.wait(2_000);
    assert_eq!(states(&mut world), []);
    world.stream(alice(WRITER), 151..=300);
    let good = (Some(WatchState::Silent), WatchState::Ok, Vec::new());
    assert_eq!(states(&mut world), [good]);
    let dispose = Message::from(ALICE).dispose_by_hash(SEDP_WRITERS, 200, alice(WRITER));
    world.put(dispose);
    world.wait(2_000);
    let gone = (Some(WatchState::Ok), WatchState::NotPublished, Vec::new());
    assert_eq!(states(&mut world), [gone]);
}

#[test]
fn the_kernel_can_vouch_for_a_participant() {
    let mut world = World::new(&[]);
    world.spdp(ALICE, 10);
    for _ in 0..5 {
        world.wait(8000);
        for prefix in [ALICE, BOB] {
            world
                .observer
                .input(Input::ParticipantAlive(prefix, Timestamp(world.now)));
        }
    }
    assert_eq!(world.snapshot().participants.len(), 1);
}

#[test]
fn a_participant_comes_back_under_the_same_guid() {
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
fn a_copy_that_a_disposal_overtook_raises_nobody_from_the_dead() {
    let mut world = World::new(&["/**"]);
    world.spdp(ALICE, 10);
    world.sedp(alice(WRITER), "rt/chatter");
    world.wait(1000);
    world.put(Message::from(ALICE).dispose_by_hash(SEDP_WRITERS, 99, alice(WRITER)));
    world.wait(1);
    world.sedp(alice(WRITER), "rt/chatter");
    assert!(world.topic(0, "/chatter").unwrap().vanished);
}

#[test]
fn repeated_announcements_are_no_events_and_changed_ones_are() {
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
        world.topic(0, "/chatter").unwrap().publishers[0].reliability,
        "BEST_EFFORT"
    );
}

#[test]
fn the_only_sample_of_ros_discovery_info_is_kept_although_it_comes_first() {
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
fn the_newest_node_list_wins_and_only_a_participants_own_counts() {
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
fn a_discovery_servers_relays_speak_for_others() {
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
fn one_malformed_datagram_costs_one_counter() {
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

#[test]
fn interest_follows_discovery() {
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
fn the_cap_on_watched_topics_rejects_and_counts() {
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
    // A place that is given back is used.
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
fn lists_of_costly_globs_are_asked_a_part_at_a_time() {
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
    // It goes on being counted.
    world.sample(alice(WRITER), 1);
    let mut rounds = 0;
    while !world.observer.apply_more_lists() {
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
fn what_was_counted_survives_writers_and_watchlists() {
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
fn a_writer_whose_announcement_was_missed_is_shown_and_moves_to_its_topic() {
    let mut world = World::new(&["/chatter"]);
    world.stream(alice(WRITER), 1..=250);
    assert!(world.snapshot().unknown_writers.is_empty());
    world.stream(alice(WRITER), 251..=400);
    let snapshot = world.snapshot();
    let unknown = &snapshot.unknown_writers[0];
    assert_eq!(
        (unknown.guid, unknown.measurement.messages),
        (alice(WRITER), 400)
    );
    assert!((unknown.measurement.rate_hz - 100.0).abs() < 1.0);
    let changes = world.observer.drain().interest;
    assert_eq!(changes, [(alice(WRITER), Some(Verdict::Meter))]);
    world.spdp(ALICE, 10);
    world.sedp(alice(WRITER), "rt/chatter");
    assert!(world.snapshot().unknown_writers.is_empty());
    world.stream(alice(WRITER), 401..=500);
    assert_eq!(world.measurement("/chatter").messages, 500);
    assert!(world.observer.drain().interest.is_empty());
}

#[test]
fn an_unknown_writer_is_told_by_the_holder_of_its_socket_by_its_guid_and_by_its_participant() {
    const FAST: GuidPrefix = GuidPrefix(*b"\x01\x0fsome-robot");
    let mut world = World::new(&[]);
    let holder = SocketFacts {
        cookie: 77,
        process_id: Some(4242),
        process: Some("lidar_driver".to_owned()),
        cgroup: Some("/robot.slice".to_owned()),
        ..SocketFacts::default()
    };
    world.observer.input(Input::Socket(holder));
    let send = |world: &mut World, number| {
        for (prefix, socket) in [(FAST, 77), (ALICE, 78), (BOB, 77)] {
            let envelope = Envelope {
                host: true,
                outgoing: true,
                socket,
                ..forge::multicast(world.now, 0)
            };
            let sample = Message::from(prefix).data(WRITER, number, &[0, 1, 0, 0]);
            world.observer.input(Input::Datagram {
                envelope: &envelope,
                payload: &sample.bytes(),
                handover: None,
            });
        }
        world.wait(10);
    };
    (1..=400).for_each(|number| send(&mut world, number));
    world.spdp(BOB, 10);
    send(&mut world, 401);
    let told = |prefix: GuidPrefix| {
        let snapshot = world.snapshot();
        let writers = snapshot.unknown_writers.into_iter();
        let mut writers = writers.filter(|writer| writer.guid == Guid::new(prefix, WRITER));
        let writer = writers.next().unwrap();
        (writer.vendor, writer.process.id, writer.process.name)
    };
    let lidar = Some("lidar_driver".to_owned());
    assert_eq!(
        told(FAST),
        ("eProsima Fast DDS".to_owned(), Some(4242), lidar.clone())
    );
    assert_eq!(told(BOB).0, "Eclipse Cyclone DDS");
    assert_eq!((told(BOB).1, told(BOB).2), (Some(4242), lidar));
    assert_eq!((told(ALICE).1, told(ALICE).2), (None, None));
    let participant = world.snapshot().participants.remove(0);
    assert_eq!(participant.guid.prefix, BOB);
    assert_eq!(participant.process.id, Some(4242));
    assert_eq!(participant.process.cgroup.as_deref(), Some("/robot.slice"));
}

#[test]
fn what_the_kernels_budget_for_strangers_leaves_out_is_not_lost() {
    let mut world = World::new(&["/chatter"]);
    for number in [1, 2, 3, 40, 90, 91, 200] {
        world.sample(alice(WRITER), number);
        world.wait(400);
    }
    world.wait(1000);
    world.stream(alice(WRITER), 500..=700);
    world.stream(alice(WRITER), 711..=900);
    let unknown = world.snapshot().unknown_writers.remove(0).measurement;
    assert_eq!((unknown.messages, unknown.lost), (7 + 201 + 190, 10));
}

#[test]
fn a_sample_on_its_way_while_its_writer_says_goodbye_makes_no_stranger() {
    let mut world = World::new(&["/**"]);
    world.spdp(ALICE, 10);
    world.sedp(alice(WRITER), "rt/chatter");
    world.stream(alice(WRITER), 1..=10);
    world.put(Message::from(ALICE).dispose_by_hash(SEDP_WRITERS, 99, alice(WRITER)));
    world.sample(alice(WRITER), 11);
    world.wait(10_000);
    assert!(world.snapshot().unknown_writers.is_empty());
}

#[test]
fn expectations_are_judged_in_the_sources_time() {
    let mut world = World::new(&[]);
    let expectations = Expectations {
        min_rate_hz: Some(50.0),
        max_silence_s: Some(3.0),
        ..Expectations::default()
    };
    let watch = Watch {
        pattern: "/chatter".to_owned(),
        domain_id: None,
        expectations,
        per_subscriber: false,
        trace: 0.0,
        retain: ros2probe_daemon::config::Retain::None,
    };
    world.observer.input(Input::Watchlist(Arc::new(
        Watchlist::new(vec![watch]).unwrap(),
    )));
    let state = |world: &World| {
        let facts = world.snapshot().watches.remove(0);
        (facts.topics[0].topic.clone(), facts.topics[0].state)
    };
    let at = |state| ("/chatter".to_owned(), state);
    assert_eq!(state(&world), at(WatchState::NotPublished));
    world.spdp(ALICE, 100);
    world.sedp(alice(WRITER), "rt/chatter");
    world.wait(1000);
    assert_eq!(state(&world), at(WatchState::NoSubscriber));
    world.sedp(alice(READER), "rt/chatter");
    world.stream(alice(WRITER), 1..=500);
    assert_eq!(state(&world), at(WatchState::Ok));
    for number in 501..=540 {
        world.sample(alice(WRITER), number);
        world.wait(100);
    }
    assert_eq!(state(&world), at(WatchState::Violated));
    world.wait(5000);
    assert_eq!(state(&world), at(WatchState::Silent));
    world.stream(alice(WRITER), 541..=1040);
    assert_eq!(state(&world), at(WatchState::Ok));
}

/// Random bytes that are the same every time.
struct Dice(u64);

impl Dice {
    fn roll(&mut self) -> u64 {
        self.0 = self
            .0
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        self.0 ^ self.0 >> 29
    }

    fn prefix(&mut self) -> GuidPrefix {
        let mut bytes = [0; 12];
        bytes[..8].copy_from_slice(&self.roll().to_le_bytes());
        bytes[8..].copy_from_slice(&self.roll().to_le_bytes()[..4]);
        GuidPrefix(bytes)
    }
}

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
fn forgeries_with_endless_leases_that_repeated_themselves_do_not_fill_the_table_for_ever() {
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
fn a_storm_of_endpoints_of_one_participant_leaves_room_for_others() {
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

#[test]
fn a_topic_kept_out_by_a_crowd_is_measured_once_the_crowd_has_gone() {
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

#[test]
fn a_clock_that_is_set_an_hour_forward_or_back_ends_no_lease_and_delays_none() {
    const HOUR: u64 = 3600 * SECOND;
    for (forward, step) in [(true, HOUR.cast_signed()), (false, -HOUR.cast_signed())] {
        let mut world = World::new(&["/chatter"]);
        world.spdp(ALICE, 10);
        world.sedp(alice(WRITER), "rt/chatter");
        world.nodes(ALICE, 1, &[("/", "talker", alice(WRITER))]);
        world.stream(alice(WRITER), 1..=500);
        world.observer.drain();
        let before = world.now;

        // The writer's clock is the same one.
        world.now = world.now.saturating_add_signed(step);
        world.observer.input(Input::ClockSet(step));
        world.stream(alice(WRITER), 501..=700);
        // A gap that is settled ten seconds later, as without the step.
        world.stream(alice(WRITER), 702..=1000);
        let snapshot = world.snapshot();
        assert_eq!(snapshot.at.0, world.now);
        let seen = &snapshot.participants[0];
        let age = |time: Timestamp| Timestamp(world.now).nanoseconds_since(time);
        assert_eq!(age(seen.first_seen), 9_990 * MILLISECOND.cast_signed());
        assert_eq!(age(seen.last_seen), 10 * MILLISECOND.cast_signed());
        let chatter = world.measurement("/chatter");
        assert_eq!(age(chatter.last_message.unwrap()), age(seen.last_seen));
        assert_eq!(chatter.messages, 999, "{forward}");
        assert!((chatter.rate_hz - 100.0).abs() < 2.0, "{}", chatter.rate_hz);
        assert_eq!(chatter.negative_latency, 0);
        assert!(chatter.source_latency.sum() < 1e-6, "{forward}");
        assert!(chatter.interarrival.sum() < 10.0, "{forward}");
        assert_eq!(world.churn("participant", "expired"), 0);
        assert_eq!(world.node_names(), ["/talker"]);
        for event in world.observer.drain().events.events {
            assert!(world.now.abs_diff(event.at.0) < 10 * SECOND, "{event:?}");
        }

        // And a lease that runs out does so after as long as ever.
        assert_eq!(world.measurement("/chatter").lost, 0);
        world.wait(9_900);
        assert_eq!(world.snapshot().participants.len(), 1, "{forward}");
        assert_eq!(world.measurement("/chatter").lost, 1, "{forward}");
        world.wait(200);
        assert_eq!(world.snapshot().participants.len(), 0, "{forward}");
        let events = world.observer.drain().events.events;
        let expired = events.iter().find(|event| {
            let EventKind::Participant { change, .. } = &event.kind else {
                return false;
            };
            *change == churn::Event::Expired
        });
        assert_eq!(expired.unwrap().at.0 + 110 * MILLISECOND, world.now);
        assert!(world.now.abs_diff(before) > HOUR / 2);
    }
}

#[test]
fn a_clock_that_jumps_is_followed() {
    let mut world = World::new(&["/**"]);
    world.spdp(ALICE, 10);
    world.wait(1000 * 3600 * 24 * 365);
    assert!(world.snapshot().participants.is_empty());
    world.observer.input(Input::Time(Timestamp(START)));
    world.observer.input(Input::Time(Timestamp(u64::MAX)));
}

#[test]
fn the_same_input_gives_the_same_facts() {
    let replay = || {
        let mut world = World::new(&["/**"]);
        let mut dice = Dice(3);
        for _ in 0..50 {
            let prefix = dice.prefix();
            world.spdp(prefix, 10);
            world.sedp(
                Guid::new(prefix, WRITER),
                &format!("rt/t{}", dice.roll() % 20),
            );
            (1..50).for_each(|number| world.sample(Guid::new(prefix, WRITER), number));
            world.wait(dice.roll() % 2000);
        }
        format!(
            "{:?} {:?}",
            world.snapshot(),
            world.observer.drain().interest
        )
    };
    assert_eq!(replay(), replay());
}
