//! Tables that forgeries fill: a real participant of higher priority is admitted, existing entries
//! stay, and no flood makes the processing of packets slow.

use std::ops::{Deref, DerefMut};
use std::sync::Arc;
use std::time::Duration;

use ros2probe_capture::border::observe;
use ros2probe_model::facts::limits::Limits;
use ros2probe_model::observe::input::Input;
use ros2probe_model::observe::observer::Settings;
use ros2probe_model::report::snapshot::{SocketFacts, TopicFacts};
use ros2probe_testing::model::domain::{VirtualDomain, watchlist};
use ros2probe_testing::model::forge::{Message, SEDP_WRITERS, SPDP};
use ros2probe_wire::record::{flag, guid_words, kind};
use ros2probe_wire::{EntityId, Guid, GuidPrefix, Record};

const WRITER: EntityId = EntityId([0, 0, 0x11, 0x03]);
const READER: EntityId = EntityId([0, 0, 0x13, 0x04]);
const ALICE: GuidPrefix = GuidPrefix(*b"\x01\x10alice-host");
const BOB: GuidPrefix = GuidPrefix(*b"\x01\x10bobby-host");
const CAROL: GuidPrefix = GuidPrefix(*b"\x01\x10carol-host");
/// Lease of each participant's announcement.
const LEASE: u32 = 10_000;

struct World {
    domain: VirtualDomain,
}

impl Deref for World {
    type Target = VirtualDomain;

    fn deref(&self) -> &VirtualDomain {
        &self.domain
    }
}

impl DerefMut for World {
    fn deref_mut(&mut self) -> &mut VirtualDomain {
        &mut self.domain
    }
}

impl World {
    fn new(patterns: &[&str], limits: &Limits) -> Self {
        let settings = Settings::default().with_limits(limits);
        Self {
            domain: VirtualDomain::new(patterns, settings),
        }
    }

    fn spdp(&mut self, prefix: GuidPrefix) {
        self.participant(prefix, LEASE);
    }

    fn sedp(&mut self, guid: Guid, topic: &str) {
        self.endpoint(guid, 1, topic);
    }

    fn name_nodes(&mut self, prefix: GuidPrefix, names: &[String]) {
        let writer = Guid::new(prefix, WRITER);
        let nodes: Vec<_> = names
            .iter()
            .map(|name| ("/", name.as_str(), writer))
            .collect();
        self.nodes(prefix, 1, &nodes);
    }

    /// Sends a packet of this participant from its socket on this host.
    fn send_from(&mut self, prefix: GuidPrefix, socket: u64) {
        self.observer.input(Input::Socket(SocketFacts {
            cookie: socket,
            process_id: Some(4711),
            ..SocketFacts::default()
        }));
        let record = Record {
            kind: kind::HEARTBEAT,
            writer: guid_words(Guid::new(prefix, SEDP_WRITERS)),
            flags: flag::HOST | flag::OUTGOING,
            socket,
            sequence_number: 1,
            time: self.now,
            ..Record::default()
        };
        observe(&mut self.observer, &record);
    }

    /// Announces forged participants repeatedly until they count as established.
    fn crowd(&mut self, count: u32) {
        for _ in 0..4 {
            (0..count).for_each(|number| self.spdp(forged(number)));
            self.wait(1000);
        }
        assert!(self.table("participants").0 >= u64::from(count));
    }

    fn knows(&self, prefix: GuidPrefix) -> bool {
        let known = self.snapshot().participants;
        known.iter().any(|known| known.guid.prefix == prefix)
    }

    fn topic(&self, name: &str) -> Option<TopicFacts> {
        let mut topics = self.snapshot().topics.into_iter();
        topics.find(|topic| topic.name == name)
    }

    fn messages(&self, name: &str) -> Option<u64> {
        Some(self.topic(name)?.measurement?.messages)
    }

    /// Returns the entries and evictions of a table.
    fn table(&self, name: &str) -> (u64, u64) {
        let mut tables = self.snapshot().tables.into_iter();
        let table = tables.find(|table| table.table == name).unwrap();
        (table.size, table.evictions)
    }
}

fn forged(number: u32) -> GuidPrefix {
    let [a, b, c, d] = number.to_be_bytes();
    GuidPrefix([1, 0x10, 7, 7, 7, 7, 7, 7, a, b, c, d])
}

fn writer(prefix: GuidPrefix) -> Guid {
    Guid::new(prefix, WRITER)
}

fn entity(number: u32, kind: u8) -> EntityId {
    let [_, a, b, c] = (number + 0x100).to_be_bytes();
    EntityId([a, b, c, kind])
}

#[test]
fn a_publisher_of_a_topic_watched_by_name_is_admitted_to_a_full_table() {
    let mut world = World::new(&["/**", "/points"], &Limits::default());
    world.crowd(1000);
    world.spdp(ALICE);
    assert!(!world.knows(ALICE));
    world.sedp(writer(ALICE), "rt/points");
    assert!(world.knows(ALICE));
    (1..=20).for_each(|number| world.sample(writer(ALICE), number));
    assert_eq!(world.messages("/points"), Some(20));
    let (size, evictions) = world.table("participants");
    // The newcomer is refused at first, then replaces another entry.
    assert_eq!((size, evictions), (1000, 2));
}

#[test]
fn a_participant_dropped_in_a_flood_is_admitted_at_its_next_announcement() {
    let mut world = World::new(&["/points"], &Limits::default());
    world.crowd(1000);
    world.spdp(ALICE);
    // The forged participants are more than the table of refused participants holds.
    (5000..9000).for_each(|number| world.spdp(forged(number)));
    world.sedp(writer(ALICE), "rt/points");
    assert!(!world.knows(ALICE));
    for number in 5000..9000 {
        world.sedp(writer(forged(number)), "rt/forged");
    }
    world.wait(30_000);
    world.spdp(ALICE);
    world.sample(writer(ALICE), 1);
    assert_eq!(world.messages("/points"), Some(1));
}

#[test]
fn a_participant_with_a_socket_on_this_host_is_admitted_to_a_full_table() {
    let mut world = World::new(&["/**"], &Limits::default());
    world.crowd(1000);
    world.spdp(ALICE);
    assert!(!world.knows(ALICE));
    world.send_from(ALICE, 77);
    assert!(world.knows(ALICE));
    // The packet of a participant may precede its announcement.
    world.send_from(BOB, 78);
    world.spdp(BOB);
    assert!(world.knows(BOB));
    world.sedp(writer(BOB), "rt/chatter");
    world.sample(writer(BOB), 1);
    assert_eq!(world.messages("/chatter"), Some(1));
}

#[test]
fn a_socket_of_this_host_is_evidence_for_at_most_eight_participants() {
    let mut world = World::new(&["/points"], &Limits::default());
    world.crowd(1000);
    for number in 0..500 {
        world.spdp(forged(5000 + number));
        world.send_from(forged(5000 + number), 77);
        world.wait(10);
    }
    let known = |world: &World| {
        (0..500)
            .filter(|number| world.knows(forged(5000 + number)))
            .count()
    };
    assert_eq!(known(&world), 8);
    // After that, the socket is not evidence for any participant, but another socket is.
    world.send_from(ALICE, 78);
    world.spdp(ALICE);
    assert!(world.knows(ALICE));
}

#[test]
fn a_participant_that_sends_user_data_is_admitted_to_a_full_table() {
    let mut world = World::new(&["/**"], &Limits::default());
    world.crowd(1000);
    world.spdp(ALICE);
    world.sedp(writer(ALICE), "rt/chatter");
    assert!(!world.knows(ALICE));
    (1..=3).for_each(|number| world.sample(writer(ALICE), number));
    assert!(world.knows(ALICE));
    assert!(world.messages("/chatter") >= Some(2));
    // A participant may send before its announcement.
    world.sample(writer(BOB), 1);
    world.spdp(BOB);
    assert!(world.knows(BOB));
}

#[test]
fn an_endpoint_of_a_topic_watched_by_name_is_admitted_to_a_full_table() {
    let limits = Limits {
        endpoints: 1200,
        ..Limits::default()
    };
    let mut world = World::new(&["/**", "/points"], &limits);
    for _ in 0..4 {
        world.spdp(ALICE);
        (0..12).for_each(|number| world.spdp(forged(number)));
        world.wait(1000);
    }
    for number in 0..1200 {
        let guid = Guid::new(forged(number % 12), entity(number, 3));
        world.sedp(guid, &format!("rt/forged_{number}"));
    }
    assert_eq!(world.table("endpoints"), (1200, 0));
    world.sedp(writer(ALICE), "rt/points");
    (1..=20).for_each(|number| world.sample(writer(ALICE), number));
    assert_eq!(world.messages("/points"), Some(20));
    assert_eq!(world.table("endpoints"), (1200, 1));
    // A newcomer of equal priority waits, and is admitted once it sends user data.
    world.sedp(Guid::new(ALICE, entity(9, 3)), "rt/other");
    assert!(world.topic("/other").is_some(), "its participant sends");
    world.spdp(BOB);
    world.sedp(Guid::new(BOB, entity(9, 3)), "rt/bob");
    assert!(world.topic("/bob").is_none());
    world.sample(Guid::new(BOB, entity(9, 3)), 1);
    assert!(world.topic("/bob").is_some());
}

#[test]
fn a_waiting_endpoint_is_admitted_at_its_participants_next_announcement() {
    let limits = Limits {
        endpoints: 10,
        ..Limits::default()
    };
    let mut world = World::new(&["/**"], &limits);
    for _ in 0..4 {
        [ALICE, BOB]
            .into_iter()
            .for_each(|prefix| world.spdp(prefix));
        world.wait(1000);
    }
    for number in 0..10 {
        world.sedp(
            Guid::new(BOB, entity(number, 3)),
            &format!("rt/bob_{number}"),
        );
    }
    world.sedp(writer(ALICE), "rt/chatter");
    assert_eq!(world.table("endpoints"), (10, 1));
    for minute in 0..30 {
        world.spdp(ALICE);
        world.spdp(BOB);
        assert!(world.topic("/chatter").is_none(), "minute {minute}");
        world.wait(30_000);
    }
    assert_eq!(world.table("endpoints"), (10, 1));
    let goodbye = Guid::new(BOB, EntityId::PARTICIPANT);
    world.put(Message::from(BOB).dispose_by_hash(SPDP, 2, goodbye));
    world.spdp(ALICE);
    assert!(world.topic("/chatter").is_some());
}

#[test]
fn a_topic_watched_by_name_is_measured_at_the_cap_of_topics() {
    let limits = Limits {
        topics: 4,
        ..Limits::default()
    };
    let mut world = World::new(&["/**", "/points"], &limits);
    world.spdp(BOB);
    for number in 0..9 {
        world.sedp(
            Guid::new(BOB, entity(number, 3)),
            &format!("rt/crowd_{number}"),
        );
    }
    world.sample(Guid::new(BOB, entity(3, 3)), 1);
    assert_eq!(world.messages("/crowd_3"), Some(1));
    world.spdp(ALICE);
    world.sedp(writer(ALICE), "rt/points");
    (1..=5).for_each(|number| world.sample(writer(ALICE), number));
    assert_eq!(world.messages("/points"), Some(5));
    // The latest topic is displaced, so topics from before a flood stay.
    let measured = |world: &World| {
        let names = ["/crowd_0", "/crowd_1", "/crowd_2", "/crowd_3", "/crowd_4"];
        let topics = names.map(|name| world.topic(name).unwrap());
        topics.map(|topic| topic.measurement.is_some())
    };
    assert_eq!(measured(&world), [true, true, true, false, false]);
    assert_eq!(world.snapshot().topics_measured, 4);
    // A topic that is watched by name later displaces another one, and no topic displaces it.
    world.observer.input(Input::Watchlist(Arc::new(watchlist(&[
        "/**", "/points", "/crowd_8",
    ]))));
    world.sample(Guid::new(BOB, entity(8, 3)), 1);
    assert_eq!(world.messages("/crowd_8"), Some(1));
    world.sedp(Guid::new(BOB, entity(20, 3)), "rt/late");
    world.wait(2000);
    assert_eq!(measured(&world), [true, true, false, false, false]);
    assert_eq!(
        (world.messages("/points"), world.messages("/crowd_8")),
        (Some(5), Some(1))
    );
}

#[test]
fn a_vanished_topic_watched_by_name_stays_measured_in_a_flood_of_topics() {
    let limits = Limits {
        topics: 4,
        ..Limits::default()
    };
    let mut world = World::new(&["/**", "/points"], &limits);
    world.spdp(ALICE);
    world.sedp(writer(ALICE), "rt/points");
    (1..=5).for_each(|number| world.sample(writer(ALICE), number));
    world.put(Message::from(ALICE).dispose_by_hash(SEDP_WRITERS, 9, writer(ALICE)));
    world.spdp(BOB);
    for number in 0..9 {
        let name = format!("rt/crowd_{number}");
        world.sedp(Guid::new(BOB, entity(number, 3)), &name);
    }
    world.wait(2000);
    assert_eq!(world.messages("/points"), Some(5));
    assert_eq!(world.snapshot().topics_measured, 4);
}

/// Sends a flood that names watched topics, each packet with another GUID.
fn flood(world: &mut World, rounds: std::ops::Range<u32>, with_data: bool) {
    for number in rounds {
        let prefix = forged(1_000_000 + number);
        world.spdp(prefix);
        world.sedp(writer(prefix), "rt/points");
        if with_data {
            world.sample(writer(prefix), 1);
        }
        if number % 10 == 0 {
            world.wait(1);
        }
    }
}

#[test]
fn a_flood_of_watched_names_displaces_neither_local_nor_sending_participants() {
    let mut world = World::new(&["/points"], &Limits::default());
    // Alice publishes a watched topic, Bob runs on this host, Carol sends, Dave is silent.
    let dave = GuidPrefix(*b"\x01\x10daves-host");
    let robot = [ALICE, BOB, CAROL, dave];
    for turn in 1..=4 {
        robot.into_iter().for_each(|prefix| world.spdp(prefix));
        world.sample(writer(CAROL), turn);
        world.send_from(BOB, 77);
        world.wait(1000);
    }
    world.sedp(writer(ALICE), "rt/points");
    world.sedp(writer(CAROL), "rt/other");
    world.sedp(Guid::new(dave, READER), "rt/points_of_interest");
    for second in 0..20 {
        flood(
            &mut world,
            second * 1000..(second + 1) * 1000,
            second % 2 == 0,
        );
        world.sample(writer(ALICE), u64::from(second) + 1);
        if second % 8 == 0 {
            robot.into_iter().for_each(|prefix| world.spdp(prefix));
            world.send_from(BOB, 77);
        }
    }
    let known = robot.map(|prefix| world.knows(prefix));
    assert_eq!(known, [true; 4]);
    let own = world.topic("/points").unwrap();
    let own = own.publishers.iter().find(|it| it.guid.prefix == ALICE);
    assert_eq!(own.unwrap().measurement.as_ref().unwrap().messages, 20);
    assert!(world.topic("/other").is_some() && world.topic("/points_of_interest").is_some());
    assert_eq!(world.table("participants").0, 1000);
    // A participant with a socket on this host is admitted, too.
    let erin = GuidPrefix(*b"\x01\x10erins-host");
    world.spdp(erin);
    world.sedp(writer(erin), "rt/points");
    world.send_from(erin, 80);
    world.wait(1500);
    world.spdp(erin);
    assert!(world.knows(erin));
}

#[test]
fn silent_forgeries_are_displaced_by_new_participants() {
    let mut world = World::new(&["/points"], &Limits::default());
    (0..1000).for_each(|number| world.spdp(forged(number)));
    world.spdp(ALICE);
    assert!(!world.knows(ALICE));
    world.wait(6000);
    world.spdp(ALICE);
    assert!(world.knows(ALICE));
    // A participant with a socket on this host stays, however long it is silent.
    let mut world = World::new(
        &["/points"],
        &Limits {
            participants: 1,
            ..Limits::default()
        },
    );
    world.spdp(BOB);
    world.send_from(BOB, 77);
    world.wait(100_000);
    world.spdp(ALICE);
    assert!(world.knows(BOB));
    world.observer.input(Input::SocketClosed(77));
    world.wait(2000);
    world.spdp(ALICE);
    assert!(world.knows(ALICE));
}

#[test]
fn a_new_watch_admits_a_participant_that_a_full_table_had_refused() {
    let mut world = World::new(&["/other"], &Limits::default());
    world.crowd(1000);
    world.spdp(ALICE);
    world.sedp(writer(ALICE), "rt/points");
    assert!(!world.knows(ALICE));
    world
        .observer
        .input(Input::Watchlist(Arc::new(watchlist(&["/points"]))));
    world.spdp(ALICE);
    world.sample(writer(ALICE), 1);
    assert_eq!(world.messages("/points"), Some(1));
}

#[test]
fn nodes_of_a_participant_with_a_higher_priority_displace_forged_ones() {
    let mut world = World::new(&["/points"], &Limits::default());
    let names: Vec<_> = (0..600).map(|number| format!("forged_{number}")).collect();
    for number in 0..8 {
        world.spdp(forged(number));
        world.name_nodes(forged(number), &names);
    }
    assert_eq!(world.table("nodes").0, 4096);
    world.spdp(ALICE);
    world.sedp(writer(ALICE), "rt/points");
    world.name_nodes(ALICE, &["driver".to_owned()]);
    let nodes = world.snapshot().nodes;
    assert!(nodes.iter().any(|node| node.name == "/driver"));
    assert!(world.table("nodes").0 <= 4096);
}

/// Returns the CPU time of this thread, which a busy machine does not change.
fn thread_cpu() -> Duration {
    let counted = std::fs::read_to_string("/proc/thread-self/schedstat").unwrap();
    let nanoseconds = counted.split(' ').next().unwrap();
    Duration::from_nanos(nanoseconds.parse().unwrap())
}

#[test]
fn a_flood_into_full_tables_takes_as_long_as_into_empty_tables() {
    const FLOOD: u32 = 20_000;
    let run = |crowd: u32| {
        let mut world = World::new(&["/points"], &Limits::default());
        for number in 0..crowd {
            world.spdp(forged(number));
            for endpoint in 0..8 {
                let guid = Guid::new(forged(number), entity(endpoint, 3));
                world.sedp(guid, "rt/forged");
            }
        }
        let before = thread_cpu();
        flood(&mut world, 0..FLOOD, true);
        thread_cpu() - before
    };
    let (empty, full) = (run(0), run(1024));
    println!("{FLOOD} forged participants: {empty:?} into empty tables, {full:?} into full ones");
    assert!(
        full < empty * 3 + Duration::from_secs(1),
        "{full:?}, {empty:?}"
    );
}
