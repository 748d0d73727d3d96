//! Topics whose messages have buffers (rmw_fastrtps of Lyrical, `publisher.cpp` and
//! `rmw_publish.cpp`): a second writer and reader carry the messages, and nodes announce only the
//! first ones.

use ros2probe_model::report::snapshot::{EndpointFacts, TopicFacts};
use ros2probe_testing::model::forge::{self, AnnouncedNode, Message, SEDP_READERS, SEDP_WRITERS};
use ros2probe_testing::model::host::{ALICE, BOB, CapturePoint, Host, READER, WRITER};
use ros2probe_wire::record::{guid_words, kind};
use ros2probe_wire::{EntityId, Guid, GuidPrefix, Record};

const IMAGE: &str = "sensor_msgs::msg::dds_::Image_";
const CPU: &str = "typehash=x;bufbe.cpu=;";
const CUDA: &str = "typehash=x;bufbe.cuda=0;bufbe.cpu=;";

const fn writer(number: u8) -> Guid {
    Guid::new(ALICE, EntityId([0, 0, number, 0x03]))
}

const fn reader(prefix: GuidPrefix, number: u8) -> Guid {
    Guid::new(prefix, EntityId([0, 0, number, 0x04]))
}

fn digits(guid: Guid) -> String {
    guid.to_bytes()
        .iter()
        .map(|byte| format!("{byte:02x}"))
        .collect()
}

/// Announces an endpoint of `/image`, or of the topic with this suffix.
fn announce(host: &mut Host, number: u64, guid: Guid, suffix: &str, user_data: &str) {
    let mut value = u32::try_from(user_data.len())
        .unwrap()
        .to_le_bytes()
        .to_vec();
    value.extend(user_data.as_bytes());
    let reliability = [2u32.to_le_bytes(), [0; 4], [0; 4]].concat();
    let topic = format!("rt/image{suffix}");
    let others: [(u16, &[u8]); 2] = [(0x1a, &reliability), (0x2c, &value)];
    let payload = forge::endpoint_with(guid, &topic, IMAGE, &others);
    let announcer = if guid.entity.is_writer() {
        SEDP_WRITERS
    } else {
        SEDP_READERS
    };
    host.announce(Message::from_fast(guid.prefix).data(announcer, number, &payload));
}

/// Announces the node of a participant with these endpoints.
fn node(host: &mut Host, prefix: GuidPrefix, name: &str, writers: &[Guid], readers: &[Guid]) {
    let discovery = Guid::new(prefix, EntityId([0, 0, 2, 0x03]));
    let payload = forge::endpoint(discovery, "ros_discovery_info", ENTITIES, true);
    host.announce(Message::from_fast(prefix).data(SEDP_WRITERS, 90, &payload));
    let nodes = [AnnouncedNode {
        namespace: "/",
        name,
        readers: readers.to_vec(),
        writers: writers.to_vec(),
    }];
    let payload = forge::entities_of(prefix, 16, &nodes);
    host.announce(Message::from_fast(prefix).data(discovery.entity, 1, &payload));
}

const ENTITIES: &str = "rmw_dds_common::msg::dds_::ParticipantEntitiesInfo_";

/// Alice's node `/camera` publishes `/image`; Bob's node `/detector` has a subscription of these
/// backends.
fn robot(of_bob: &str) -> (Host, CapturePoint) {
    let mut host = Host::new();
    let bob = host.bystander(BOB, 7411);
    let base = reader(BOB, 0x21);
    announce(&mut host, 10, writer(0x21), "", CUDA);
    announce(&mut host, 11, writer(0x22), "/_buf_cpu", CUDA);
    announce(&mut host, 10, base, "", of_bob);
    match of_bob {
        CPU => announce(&mut host, 11, reader(BOB, 0x22), "/_buf_cpu", CPU),
        _ => {
            let suffix = format!("/_buf/{}", digits(base));
            announce(&mut host, 11, reader(BOB, 0x23), &suffix, of_bob);
            let with_publisher = format!("{CUDA}PGID:{}", digits(writer(0x21)));
            announce(&mut host, 12, writer(0x33), &suffix, &with_publisher);
        }
    }
    node(&mut host, ALICE, "camera", &[writer(0x21)], &[]);
    node(&mut host, BOB, "detector", &[], &[base]);
    (host, bob)
}

fn publish(
    host: &mut Host,
    bob: CapturePoint,
    writer: Guid,
    numbers: std::ops::RangeInclusive<u64>,
) {
    for number in numbers {
        for seen in [bob.leaving(), bob] {
            let sample = host.record(seen, kind::DATA, number);
            host.put(Record {
                writer: guid_words(writer),
                ..sample
            });
        }
        host.wait(100);
    }
}

fn image(host: &Host) -> TopicFacts {
    let mut topics = host.snapshot().topics.into_iter();
    topics.find(|topic| topic.name == "/image").unwrap()
}

fn messages(endpoint: &EndpointFacts) -> u64 {
    endpoint.measurement.as_ref().map_or(0, |own| own.messages)
}

#[test]
fn a_publisher_has_the_messages_of_its_cpu_topic() {
    let (mut host, bob) = robot(CPU);
    publish(&mut host, bob, writer(0x22), 1..=10);
    let topic = image(&host);
    let ([publisher], [subscription]) = (&topic.publishers[..], &topic.subscriptions[..]) else {
        panic!("{topic:?}");
    };
    assert_eq!(topic.measurement.as_ref().unwrap().messages, 10);
    assert_eq!(
        (messages(publisher), &*publisher.buffers),
        (10, &[writer(0x22)][..])
    );
    assert_eq!(publisher.node.as_deref(), Some("/camera"));
    assert_eq!(&*subscription.buffers, [reader(BOB, 0x22)]);
    let names: Vec<_> = publisher.backends.as_deref().unwrap().names().collect();
    assert_eq!(names, ["cpu", "cuda"]);
}

#[test]
fn a_delivery_on_a_cpu_topic_has_the_node_of_its_subscription() {
    let (mut host, bob) = robot(CPU);
    publish(&mut host, bob, writer(0x22), 1..=10);
    let topic = image(&host);
    let received = topic
        .deliveries
        .iter()
        .find(|each| each.participant.is_some());
    let received = received.unwrap();
    assert_eq!(received.readers, [reader(BOB, 0x22)]);
    assert_eq!(received.nodes, ["/detector"]);
    assert_eq!(received.delivered.messages, 10);
}

#[test]
fn each_of_two_publishers_in_a_process_has_its_own_cpu_topic() {
    let (mut host, bob) = robot(CPU);
    announce(&mut host, 13, writer(0x41), "", CPU);
    announce(&mut host, 14, writer(0x42), "/_buf_cpu", CPU);
    publish(&mut host, bob, writer(0x22), 1..=10);
    publish(&mut host, bob, writer(0x42), 1..=3);
    let topic = image(&host);
    let counts: Vec<_> = topic.publishers.iter().map(messages).collect();
    assert_eq!(counts, [10, 3]);
}

#[test]
fn a_change_from_the_cpu_topic_to_the_base_topic_loses_no_message() {
    let (mut host, bob) = robot(CPU);
    publish(&mut host, bob, writer(0x22), 1..=10);
    publish(&mut host, bob, writer(0x21), 1..=5);
    host.wait(3000);
    let topic = image(&host);
    assert_eq!(messages(&topic.publishers[0]), 15);
    assert_eq!(topic.measurement.as_ref().unwrap().loss.lost, 0);
    assert_eq!(topic.received.as_ref().map(|sum| sum.lost()), Some(0));
}

#[test]
fn references_count_only_while_no_subscription_gets_messages() {
    let (mut host, bob) = robot(CUDA);
    publish(&mut host, bob, writer(0x33), 1..=10);
    assert_eq!(messages(&image(&host).publishers[0]), 10);
    // Another subscription gets each message as a whole.
    announce(&mut host, 12, reader(BOB, 0x51), "", CPU);
    announce(&mut host, 13, reader(BOB, 0x52), "/_buf_cpu", CPU);
    publish(&mut host, bob, writer(0x22), 1..=10);
    publish(&mut host, bob, writer(0x33), 11..=20);
    let topic = image(&host);
    assert_eq!(topic.measurement.as_ref().unwrap().messages, 20);
    assert_eq!(messages(&topic.publishers[0]), 20);
    assert_eq!(topic.measurement.as_ref().unwrap().loss.lost, 0);
}

/// Real nodes of Fast DDS 3.2.2 and 2.14 behave so: the host in a GUID decides, and not the id of
/// the machine, and shared memory of 2 and 3 has different formats.
#[test]
fn participants_of_one_host_and_generation_share_memory_whatever_their_machine_ids() {
    let machine = |host: &mut Host, prefix: GuidPrefix, id: &str, version| {
        let list = forge::participant_of_version(prefix, id, [10, 0, 0, 1], version);
        host.announce(Message::from_fast(prefix).data(forge::SPDP, 1, &list));
    };
    let (new, old) = (Some([3, 2, 2, 0]), None);
    for (of_bob, host_of_bob, version, passage) in [
        ("a", 1, new, "shared_memory"),
        ("b", 1, new, "shared_memory"),
        ("a", 2, new, "network"),
        ("a", 1, old, "network"),
    ] {
        let mut host = Host::new();
        let (alice, bob) = (
            GuidPrefix([1, 15, 1, 1, 1, 0, 1, 0, 0, 0, 0, 0]),
            GuidPrefix([1, 15, host_of_bob, 1, 2, 0, 2, 0, 0, 0, 0, 0]),
        );
        machine(&mut host, alice, "a", new);
        machine(&mut host, bob, of_bob, version);
        announce(&mut host, 2, Guid::new(alice, WRITER), "", CPU);
        announce(&mut host, 2, Guid::new(bob, READER), "", CPU);
        let topic = image(&host);
        let labels: Vec<_> = topic
            .transports
            .iter()
            .map(|each| each.transport.label())
            .collect();
        assert_eq!(labels, [passage]);
    }
}

/// A subscription in the publisher's process gets its references there, so that only those to
/// another one are visible.
#[test]
fn references_count_whichever_subscription_gets_them_and_once() {
    let (mut host, bob) = robot(CUDA);
    let others = [0x34, 0x35].map(writer);
    for (place, other) in others.into_iter().enumerate() {
        let suffix = format!("/_buf/{}", digits(reader(BOB, 0x61 + place as u8)));
        let with_publisher = format!("{CUDA}PGID:{}", digits(writer(0x21)));
        announce(
            &mut host,
            20 + place as u64,
            other,
            &suffix,
            &with_publisher,
        );
    }
    let [second, third] = others;
    // Nothing of the first writer is seen.
    publish(&mut host, bob, second, 1..=10);
    assert_eq!(messages(&image(&host).publishers[0]), 10);
    host.wait(1000);
    for number in 11..=20 {
        for other in [third, second] {
            let sample = host.record(bob, kind::DATA, number);
            host.put(Record {
                writer: guid_words(other),
                ..sample
            });
        }
        host.wait(100);
    }
    host.wait(3000);
    let topic = image(&host);
    assert_eq!(messages(&topic.publishers[0]), 20);
    assert_eq!(topic.measurement.as_ref().unwrap().loss.lost, 0);
}

#[test]
fn references_of_publishers_beyond_the_cap_do_not_count() {
    const CAP: usize = 64;
    let (mut host, bob) = robot(CUDA);
    let suffix = format!("/_buf/{}", digits(reader(BOB, 0x21)));
    let of_references = |number| Guid::new(ALICE, EntityId([0, 1, number, 0x03]));
    // One publisher exists already.
    let others = 100..100 + CAP as u8 + 5;
    for number in others.clone() {
        announce(&mut host, number.into(), writer(number), "", CUDA);
        let with_publisher = format!("{CUDA}PGID:{}", digits(writer(number)));
        let sender = of_references(number);
        announce(
            &mut host,
            100 + u64::from(number),
            sender,
            &suffix,
            &with_publisher,
        );
    }
    publish(&mut host, bob, writer(0x33), 1..=2);
    for number in others {
        publish(&mut host, bob, of_references(number), 1..=2);
    }
    let topic = image(&host);
    assert_eq!(topic.publishers.len(), CAP + 6);
    let counted = topic.publishers.iter().filter(|each| messages(each) > 0);
    assert_eq!(counted.count(), CAP);
}
