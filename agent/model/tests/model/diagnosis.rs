//! Diagnosis of broken graphs, from forged announcements in virtual time.

use std::net::{Ipv4Addr, SocketAddrV4};
use std::sync::Arc;
use std::time::Instant;

use ros2probe_model::facts::diagnosis::{Diagnoses, Diagnosis, Difference, Policy, Unmatched};
use ros2probe_model::observe::input::Input;
use ros2probe_model::observe::observer::{Observer, Settings};
use ros2probe_testing::model::forge::{self, Message, SEDP_READERS, SEDP_WRITERS, SPDP};
use ros2probe_testing::zenoh;
use ros2probe_wire::time::MILLISECOND;
use ros2probe_wire::time::SECOND;
use ros2probe_wire::walk::Envelope;
use ros2probe_wire::{DomainId, EntityId, Guid, GuidPrefix, Timestamp};

const START: u64 = 1_795_143_000 * SECOND;
const STRING: &str = "std_msgs::msg::dds_::String_";
const IMAGE: &str = "sensor_msgs::msg::dds_::Image_";
const NODES: EntityId = EntityId([0, 0, 0x04, 0x03]);

/// Parameters in addition to GUID, topic and type.
type Qos<'a> = &'a [(u16, &'a [u8])];

const RELIABLE: (u16, &[u8]) = (0x1a, &[2, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0]);
const BEST_EFFORT: (u16, &[u8]) = (0x1a, &[1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0]);
const TRANSIENT_LOCAL: (u16, &[u8]) = (0x1d, &[1, 0, 0, 0]);
const TEN_MILLISECONDS: (u16, &[u8]) = (0x23, &[0, 0, 0, 0, 0x5c, 0x8f, 0xc2, 0x02]);
const PARTITION_A: (u16, &[u8]) = (0x29, b"\x01\0\0\0\x02\0\0\0a\0\0\0");

/// An observer in virtual time.
struct World {
    observer: Observer,
    now: u64,
    domain_id: u16,
    announced: u64,
    /// Whether sockets of this host send the announcements.
    is_local: bool,
}

impl World {
    fn new() -> Self {
        let mut observer = Observer::new(Settings::default());
        observer.input(Input::Time(Timestamp(START)));
        Self {
            observer,
            now: START,
            domain_id: 0,
            announced: 0,
            is_local: false,
        }
    }

    /// Returns a world with participants 1 to `count`, each with one endpoint, as in ROS.
    fn with(count: u8) -> Self {
        let mut world = Self::new();
        for number in 1..=count {
            world.participant(number, &[]);
        }
        world
    }

    fn put(&mut self, message: Message) {
        let envelope = Envelope {
            outgoing: self.is_local,
            host: self.is_local,
            socket: u64::from(self.is_local) * 7,
            ..forge::multicast(self.now, self.domain_id)
        };
        self.observer.input(Input::Datagram {
            envelope: &envelope,
            payload: &message.bytes(),
            handover: None,
        });
    }

    fn participant(&mut self, number: u8, addresses: &[SocketAddrV4]) {
        // The leases are long, because the announcements are not repeated here.
        let payload = forge::participant_at(prefix(number), 1_000_000, None, addresses);
        self.put(Message::from(prefix(number)).data(SPDP, 1, &payload));
        let info = Guid::new(prefix(number), NODES);
        let qos: Qos<'_> = &[RELIABLE, TRANSIENT_LOCAL];
        let type_name = "rmw_dds_common::msg::dds_::ParticipantEntitiesInfo_";
        self.announce(info, "ros_discovery_info", type_name, qos);
    }

    fn announce(&mut self, guid: Guid, topic: &str, type_name: &str, qos: Qos<'_>) {
        self.announced += 1;
        let sedp = match guid.entity.is_writer() {
            true => SEDP_WRITERS,
            false => SEDP_READERS,
        };
        let payload = forge::endpoint_with(guid, topic, type_name, qos);
        self.put(Message::from(guid.prefix).data(sedp, self.announced, &payload));
    }

    fn dispose(&mut self, guid: Guid) {
        self.announced += 1;
        let sedp = match guid.entity.is_writer() {
            true => SEDP_WRITERS,
            false => SEDP_READERS,
        };
        let message = Message::from(guid.prefix);
        self.put(message.dispose_by_hash(sedp, self.announced, guid));
    }

    fn nodes(&mut self, number: u8, sequence_number: u64, nodes: &[(&str, &str, Guid)]) {
        let payload = forge::entities(prefix(number), 24, nodes);
        let message = Message::from(prefix(number));
        self.put(message.data(NODES, sequence_number, &payload));
    }

    fn wait(&mut self, milliseconds: u64) {
        self.now += milliseconds * MILLISECOND;
        self.observer.input(Input::Time(Timestamp(self.now)));
    }

    fn diagnoses(&self) -> Arc<Diagnoses> {
        self.observer.snapshot(Timestamp(self.now)).diagnoses
    }

    /// Returns all findings of a kind after some seconds.
    fn found(&mut self, kind: &str) -> Vec<Diagnosis> {
        self.wait(7000);
        let found = self.diagnoses();
        let own = found.list.iter().filter(|each| each.kind() == kind);
        own.cloned().collect()
    }

    fn pairs(&self, policy: Policy) -> Option<u64> {
        let found = self.diagnoses();
        let own = found.qos_pairs.iter().find(|each| each.policy == policy);
        own.map(|each| each.pairs)
    }
}

fn prefix(number: u8) -> GuidPrefix {
    GuidPrefix([1, 0x10, number, 0, 0, 0, 0, 0, 0, 0, 0, 0])
}

fn writer(participant: u8, number: u8) -> Guid {
    Guid::new(prefix(participant), EntityId([0, 1, number, 3]))
}

fn reader(participant: u8, number: u8) -> Guid {
    Guid::new(prefix(participant), EntityId([0, 1, number, 4]))
}

#[test]
fn an_incompatible_pair_is_found_with_every_policy_until_it_is_compatible() {
    let mut world = World::with(2);
    world.announce(writer(1, 1), "rt/points", STRING, &[BEST_EFFORT]);
    let demanding: Qos<'_> = &[RELIABLE, TRANSIENT_LOCAL, TEN_MILLISECONDS];
    world.announce(reader(2, 1), "rt/points", STRING, demanding);
    world.announce(reader(2, 2), "rt/points", STRING, &[BEST_EFFORT]);
    let found = world.found("qos_incompatible");
    let [
        Diagnosis::QosIncompatible {
            topic,
            writer: offers,
            reader: requests,
            policies,
        },
    ] = &found[..]
    else {
        panic!("{found:?}");
    };
    assert_eq!((&*topic.name, topic.domain_id), ("/points", DomainId(0)));
    assert_eq!((*offers, *requests), (writer(1, 1), reader(2, 1)));
    let expected = [Policy::Reliability, Policy::Durability, Policy::Deadline];
    assert_eq!(policies.iter().collect::<Vec<_>>(), expected);
    for policy in Policy::ALL {
        let pairs = expected.contains(&policy).then_some(1);
        assert_eq!(world.pairs(policy), pairs, "{policy:?}");
    }
    let subscriptions = world.found("unmatched_subscription");
    assert!(
        matches!(
            &subscriptions[..],
            [Diagnosis::UnmatchedSubscription {
                reason: Unmatched::Qos,
                ..
            }]
        ),
        "{subscriptions:?}"
    );
    assert_eq!(world.found("unmatched_publisher"), []);

    // The subscriber requests less.
    world.announce(reader(2, 1), "rt/points", STRING, &[BEST_EFFORT]);
    assert_eq!(world.found("qos_incompatible"), []);
    assert_eq!(world.diagnoses().qos_pairs, []);
    assert_eq!(world.found("unmatched_subscription"), []);
}

#[test]
fn endpoints_of_two_domains_are_not_compared() {
    let mut world = World::with(1);
    world.announce(writer(1, 1), "rt/points", STRING, &[BEST_EFFORT]);
    world.domain_id = 5;
    world.participant(2, &[]);
    world.announce(reader(2, 1), "rt/points", STRING, &[RELIABLE]);
    assert_eq!(world.found("qos_incompatible"), []);
    let subscriptions = world.found("unmatched_subscription");
    assert!(
        matches!(
            &subscriptions[..],
            [Diagnosis::UnmatchedSubscription {
                topic,
                reason: Unmatched::NoEndpoint,
                ..
            }] if topic.domain_id == DomainId(5)
        ),
        "{subscriptions:?}"
    );
}

#[test]
fn endpoints_of_dds_and_zenoh_are_not_compared() {
    let mut world = World::with(1);
    world.announce(reader(1, 1), "rt/chatter", STRING, &[TRANSIENT_LOCAL]);
    let [there, back] = zenoh::connection(1000);
    let observer = &mut world.observer;
    let (peer, router) = ([0x11; 16], [0x22; 16]);
    let init = zenoh::init(peer, zenoh::Role::Peer, None);
    let ack = zenoh::init(router, zenoh::Role::Router, Some(&[]));
    let token = zenoh::publisher(peer, 10, "/chatter");
    let declared = zenoh::frame(7, &[zenoh::declare_token(1, &token)]);
    for (stream, batch) in [(&there, init), (&back, ack), (&there, declared)] {
        zenoh::send(observer, stream, START, &batch);
    }
    assert_eq!(world.found("qos_incompatible"), []);
    let subscriptions = world.found("unmatched_subscription");
    assert!(
        matches!(
            &subscriptions[..],
            [Diagnosis::UnmatchedSubscription {
                reason: Unmatched::NoEndpoint,
                ..
            }]
        ),
        "{subscriptions:?}"
    );
    let snapshot = world.observer.snapshot(Timestamp(world.now));
    let topic = snapshot
        .topics
        .iter()
        .find(|topic| *topic.name == *"/chatter");
    assert_eq!(topic.unwrap().transports, []);
}

#[test]
fn endpoints_in_different_partitions_are_not_incompatible() {
    let mut world = World::with(2);
    world.announce(writer(1, 1), "rt/points", STRING, &[BEST_EFFORT]);
    world.announce(reader(2, 1), "rt/points", STRING, &[RELIABLE, PARTITION_A]);
    assert_eq!(world.found("qos_incompatible"), []);
    let publishers = world.found("unmatched_publisher");
    assert!(
        matches!(
            &publishers[..],
            [Diagnosis::UnmatchedPublisher {
                reason: Unmatched::Partition,
                ..
            }]
        ),
        "{publishers:?}"
    );
}

#[test]
fn an_endpoint_at_127_0_0_1_does_not_match_one_on_another_host() {
    let at = |address: Ipv4Addr| [SocketAddrV4::new(address, 7411)];
    let reasons = |is_local, other: Ipv4Addr| {
        let mut world = World::new();
        world.is_local = is_local;
        world.participant(1, &at(Ipv4Addr::LOCALHOST));
        world.announce(writer(1, 1), "rt/points", STRING, &[]);
        world.is_local = false;
        world.participant(2, &at(other));
        world.announce(reader(2, 1), "rt/points", STRING, &[]);
        let publishers = world.found("unmatched_publisher");
        let subscriptions = world.found("unmatched_subscription");
        let reason = |diagnosis: &Diagnosis| match diagnosis {
            Diagnosis::UnmatchedPublisher { reason, .. }
            | Diagnosis::UnmatchedSubscription { reason, .. } => Some(*reason),
            _ => None,
        };
        let all = publishers.iter().chain(&subscriptions);
        all.filter_map(reason).collect::<Vec<_>>()
    };
    let other = Ipv4Addr::new(10, 0, 0, 2);
    assert_eq!(reasons(true, other), [Unmatched::Unreachable; 2]);
    // A capture may be of the other host, and both may be on one.
    assert_eq!(reasons(false, other), []);
    assert_eq!(reasons(true, Ipv4Addr::LOCALHOST), []);
}

#[test]
fn a_restored_participant_that_has_sent_nothing_yet_may_be_on_this_host() {
    let at = |address: Ipv4Addr| [SocketAddrV4::new(address, 7411)];
    let mut before = World::new();
    before.is_local = true;
    before.participant(2, &at(Ipv4Addr::new(10, 0, 0, 2)));
    before.announce(reader(2, 1), "rt/points", STRING, &[]);
    let mut world = World::new();
    world.observer.input(Input::Restored {
        memory: &before.observer.memory(),
        now: Timestamp(START),
    });
    world.is_local = true;
    world.participant(1, &at(Ipv4Addr::LOCALHOST));
    world.announce(writer(1, 1), "rt/points", STRING, &[]);
    assert_eq!(world.found("unmatched_publisher"), []);
    assert_eq!(world.found("unmatched_subscription"), []);
}

#[test]
fn two_types_and_two_definitions_of_one_type_are_found() {
    let mut world = World::with(3);
    let hash = |digit: &str| {
        let text = format!("typehash=RIHS01_{};", digit.repeat(64));
        let mut value = u32::try_from(text.len()).unwrap().to_le_bytes().to_vec();
        value.extend_from_slice(text.as_bytes());
        value
    };
    let (one, two) = (hash("1"), hash("2"));
    world.announce(writer(1, 1), "rt/a", STRING, &[(0x2c, &one)]);
    world.announce(reader(2, 1), "rt/a", STRING, &[(0x2c, &two)]);
    world.announce(writer(1, 2), "rt/b", STRING, &[(0x2c, &one)]);
    world.announce(reader(2, 2), "rt/b", IMAGE, &[(0x2c, &two)]);
    world.announce(reader(3, 1), "rt/c", IMAGE, &[]);
    world.announce(writer(1, 3), "rt/c", IMAGE, &[(0x2c, &two)]);
    let hashes = world.found("type_hash_conflict");
    let [
        Diagnosis::TypeHashConflict {
            topic,
            message_type,
            hashes,
        },
    ] = &hashes[..]
    else {
        panic!("{hashes:?}");
    };
    assert_eq!((&*topic.name, hashes.len()), ("/a", 2));
    assert_eq!(&**message_type, "std_msgs/msg/String");
    let types = world.found("type_conflict");
    let [Diagnosis::TypeConflict { topic, types }] = &types[..] else {
        panic!("{types:?}");
    };
    assert_eq!(&*topic.name, "/b");
    let types: Vec<_> = types.iter().map(|each| &**each).collect();
    assert_eq!(types, ["sensor_msgs/msg/Image", "std_msgs/msg/String"]);
    let publishers = world.found("unmatched_publisher");
    assert!(
        matches!(
            &publishers[..],
            [Diagnosis::UnmatchedPublisher {
                topic,
                reason: Unmatched::Type,
                ..
            }] if &*topic.name == "/b"
        ),
        "{publishers:?}"
    );
}

#[test]
fn an_unmatched_endpoint_is_found_later_except_where_that_is_normal() {
    let mut world = World::with(2);
    world.announce(writer(1, 1), "rt/points", STRING, &[]);
    world.announce(reader(2, 1), "rt/cmd_vel", STRING, &[]);
    for (number, quiet) in [
        (2, "rt/rosout"),
        (3, "rt/parameter_events"),
        (4, "rt/lidar/transition_event"),
        (5, "rt/fib/_action/status"),
        (6, "rr/addReply"),
        (7, "Square"),
    ] {
        world.announce(writer(1, number), quiet, STRING, &[]);
    }
    world.wait(4000);
    assert_eq!(world.diagnoses().list, []);
    world.wait(3000);
    let names = |found: &Diagnoses| -> Vec<(&'static str, String)> {
        let named = |each: &Diagnosis| (each.kind(), each.topic().unwrap().name.to_string());
        found.list.iter().map(named).collect()
    };
    let expected = [
        ("unmatched_publisher", "/points".to_owned()),
        ("unmatched_subscription", "/cmd_vel".to_owned()),
    ];
    assert_eq!(names(&world.diagnoses()), expected);

    // A reader appears and vanishes again.
    world.announce(reader(2, 2), "rt/points", STRING, &[]);
    world.wait(1000);
    assert_eq!(names(&world.diagnoses()), expected[1..]);
    world.dispose(reader(2, 2));
    world.wait(4000);
    assert_eq!(names(&world.diagnoses()), expected[1..]);
    world.wait(2000);
    assert_eq!(names(&world.diagnoses()), expected);
}

#[test]
fn a_lonely_publisher_and_a_lonely_subscription_with_similar_names_are_a_near_miss() {
    let mut world = World::with(2);
    let misses = |found: Vec<Diagnosis>| -> Vec<(String, String, Difference)> {
        let pairs = found.into_iter().filter_map(|found| match found {
            Diagnosis::NearMiss {
                topic,
                subscription,
                difference,
            } => Some((
                topic.name.to_string(),
                subscription.name.to_string(),
                difference,
            )),
            _ => None,
        });
        pairs.collect()
    };
    world.announce(writer(1, 1), "rt/robot/cmd_vel", STRING, &[]);
    world.announce(reader(2, 1), "rt/robot/cmd_val", STRING, &[]);
    world.announce(reader(2, 2), "rt/cmd_vel", STRING, &[]);
    // Another type, another domain on another host, and a publisher that is not lonely.
    world.announce(reader(2, 3), "rt/robot/Cmd_vel", IMAGE, &[]);
    world.announce(writer(1, 4), "rt/image", IMAGE, &[]);
    world.announce(reader(1, 5), "rt/image", IMAGE, &[]);
    world.announce(reader(1, 6), "rt/images", IMAGE, &[]);
    let name = |name: &str| name.to_owned();
    let expected = [
        (
            name("/robot/cmd_vel"),
            name("/cmd_vel"),
            Difference::Namespace,
        ),
        (
            name("/robot/cmd_vel"),
            name("/robot/cmd_val"),
            Difference::Letter,
        ),
    ];
    world.wait(4000);
    assert_eq!(world.diagnoses().list, []);
    assert_eq!(misses(world.found("near_miss")), expected);
    // The subscription begins where the publisher is.
    world.announce(reader(2, 9), "rt/robot/cmd_vel", STRING, &[]);
    assert_eq!(misses(world.found("near_miss")), []);
}

#[test]
fn one_topic_in_two_domains_is_a_near_miss_on_one_host_but_not_in_a_fleet() {
    let at = |last: u8| [SocketAddrV4::new(Ipv4Addr::new(10, 0, 0, last), 7411)];
    let mut world = World::new();
    world.participant(1, &at(1));
    world.announce(writer(1, 1), "rt/points", STRING, &[]);
    world.domain_id = 5;
    world.participant(2, &at(2));
    world.announce(reader(2, 1), "rt/points", STRING, &[]);
    assert_eq!(world.found("near_miss"), []);
    world.domain_id = 7;
    world.participant(3, &at(1));
    world.announce(reader(3, 1), "rt/points", STRING, &[]);
    let found = world.found("near_miss");
    assert!(
        matches!(
            &found[..],
            [Diagnosis::NearMiss { topic, subscription, difference: Difference::Domain }]
                if topic.domain_id == DomainId(0) && subscription.domain_id == DomainId(7)
        ),
        "{found:?}"
    );
}

#[test]
fn no_endpoint_is_unmatched_while_a_participants_endpoints_are_unknown() {
    let mut world = World::with(2);
    world.announce(writer(1, 1), "rt/points", STRING, &[]);
    // The participant announced itself before the agent started to capture its endpoints.
    let payload = forge::participant(prefix(3), 1_000_000, None);
    world.put(Message::from(prefix(3)).data(SPDP, 1, &payload));
    assert_eq!(world.found("unmatched_publisher"), []);
    // Once its endpoints are known, the missing subscriber is a finding.
    world.announce(reader(3, 1), "rt/other", STRING, &[]);
    assert_eq!(world.found("unmatched_publisher").len(), 1);
}

#[test]
fn two_nodes_with_one_name_are_found_only_in_the_same_domain() {
    let mut world = World::with(2);
    world.nodes(
        1,
        1,
        &[
            ("/", "lidar", writer(1, 1)),
            ("/", "_ros2cli", writer(1, 1)),
        ],
    );
    world.nodes(2, 1, &[("/", "_ros2cli", writer(2, 1))]);
    world.domain_id = 5;
    world.participant(3, &[]);
    world.nodes(3, 1, &[("/", "lidar", writer(3, 1))]);
    assert_eq!(world.found("duplicate_node"), []);
    world.nodes(
        2,
        2,
        &[("/", "lidar", writer(2, 1)), ("/", "lidar", writer(2, 2))],
    );
    let found = world.found("duplicate_node");
    let participant = |number| Guid::new(prefix(number), EntityId::PARTICIPANT);
    let expected = Diagnosis::DuplicateNode {
        domain_id: DomainId(0),
        node: "/lidar".into(),
        participants: vec![participant(1), participant(2), participant(2)],
    };
    assert_eq!(found, [expected]);
}

#[test]
fn a_node_in_two_domains_is_found_on_one_host_but_not_in_a_fleet() {
    let at = |last: u8| [SocketAddrV4::new(Ipv4Addr::new(10, 0, 0, last), 7411)];
    let mut world = World::new();
    world.participant(1, &at(1));
    world.nodes(1, 1, &[("/", "lidar", writer(1, 1))]);
    world.domain_id = 5;
    world.participant(2, &at(2));
    world.nodes(2, 1, &[("/", "lidar", writer(2, 1))]);
    assert_eq!(world.found("node_in_several_domains"), []);
    world.domain_id = 7;
    world.participant(3, &at(1));
    world.nodes(3, 1, &[("/", "lidar", writer(3, 1))]);
    let found = world.found("node_in_several_domains");
    let expected = Diagnosis::NodeInSeveralDomains {
        node: "/lidar".into(),
        participant: Guid::new(prefix(1), EntityId::PARTICIPANT),
        domains: vec![DomainId(0), DomainId(7)],
    };
    assert_eq!(found, [expected]);
}

#[test]
fn findings_are_not_recomputed_while_discovery_does_not_change() {
    let mut world = World::with(1);
    world.announce(writer(1, 1), "rt/points", STRING, &[]);
    world.wait(7000);
    let before = world.diagnoses();
    assert_eq!(before.list.len(), 1);
    world.wait(60_000);
    assert!(Arc::ptr_eq(&before, &world.diagnoses()));
}

#[test]
fn a_flood_of_incompatible_pairs_is_counted_and_bounded() {
    let mut world = World::with(200);
    for participant in 1..=100 {
        for number in 1..=40 {
            // Every reader requests different values, all above those that the writers offer.
            let deadline = [number, participant, 0, 0, 0, 0, 0, 0];
            let qos: Qos<'_> = &[RELIABLE, (0x23, &deadline)];
            world.announce(reader(participant, number), "rt/flood", STRING, qos);
        }
    }
    for participant in 101..=200 {
        for number in 1..=40 {
            let budget = [number, participant, 0, 0, 0, 0, 0, 0];
            let qos: Qos<'_> = &[BEST_EFFORT, (0x27, &budget)];
            world.announce(writer(participant, number), "rt/flood", STRING, qos);
        }
    }
    let began = Instant::now();
    world.wait(1000);
    println!("{:?} for 4000 x 4000 kinds", began.elapsed());
    let found = world.diagnoses();
    assert_eq!(found.list.len(), 32);
    let pairs = world.pairs(Policy::Reliability).unwrap();
    assert_eq!(pairs + found.unexamined, 4000 * 4000);
    assert_eq!(found.left_out, pairs - 32);
    let tables = world.observer.snapshot(Timestamp(world.now)).tables;
    let table = tables.iter().find(|table| table.table == "diagnoses");
    assert_eq!(table.unwrap().evictions, found.left_out);
}
