//! Pairs whose messages are not on the network.

use ros2probe_model::report::snapshot::{TopicFacts, Transport};
use ros2probe_testing::model::forge::{self, Message, SEDP_READERS, SEDP_WRITERS};
use ros2probe_testing::model::host::{ALICE, BOB, Host, READER, STRING, WRITER};
use ros2probe_wire::Guid;

const IMAGE: &str = "sensor_msgs::msg::dds_::Image_";

/// Announces a writer of Alice, and a reader of Bob at this address, both of Cyclone DDS. Kind 16
/// of a locator is iceoryx in version 0.10, and a PSMX plugin such as `psmx_iox2` in version 11.
fn image(kinds: [u32; 2], bob: &str) -> TopicFacts {
    let mut host = Host::new();
    host.participant(BOB, bob.parse().unwrap());
    let ends = [
        (Guid::new(ALICE, WRITER), SEDP_WRITERS),
        (Guid::new(BOB, READER), SEDP_READERS),
    ];
    for ((guid, announcer), kind) in ends.into_iter().zip(kinds) {
        let locator = [&kind.to_le_bytes()[..], &7411u32.to_le_bytes(), &[0; 16]].concat();
        let reliability = [2u32.to_le_bytes(), [0; 4], [0; 4]].concat();
        let others: [(u16, &[u8]); 2] = [(0x1a, &reliability), (0x2f, &locator)];
        let payload = forge::endpoint_with(guid, "rt/image", IMAGE, &others);
        host.announce(Message::from(guid.prefix).data(announcer, 20, &payload));
    }
    host.wait(5000);
    let mut topics = host.snapshot().topics.into_iter();
    topics.find(|topic| topic.name == "/image").unwrap()
}

// Coverage: iceoryx | Cyclone DDS 0.10 | - | named
// Coverage: PSMX, such as `psmx_iox2` | Cyclone DDS 11.0 | - | named
#[test]
fn a_pair_of_cyclone_dds_in_shared_memory_is_named_and_has_no_rate() {
    let topic = image([16, 16], "10.0.0.1:7413");
    let [pairs] = &topic.transports[..] else {
        panic!("{:?}", topic.transports)
    };
    assert_eq!((pairs.transport, pairs.pairs), (Transport::Iceoryx, 1));
    assert_eq!(topic.rate_hz(), None);
    // One end without it uses the network.
    let topic = image([16, 1], "10.0.0.1:7413");
    assert_eq!(topic.transports[0].transport, Transport::Network);
    assert_eq!(topic.rate_hz(), Some(0.0));
}

#[test]
fn a_pair_of_cyclone_dds_with_shared_memory_on_two_hosts_uses_the_network() {
    let topic = image([16, 16], "10.0.0.2:7411");
    let [pairs] = &topic.transports[..] else {
        panic!("{:?}", topic.transports)
    };
    assert_eq!((pairs.transport, pairs.pairs), (Transport::Network, 1));
    assert_eq!(topic.rate_hz(), Some(0.0));
    // An address that other hosts cannot reach shows no host.
    let topic = image([16, 16], "127.0.0.1:7411");
    assert_eq!(topic.transports[0].transport, Transport::Iceoryx);
}

/// Announces a reader of a participant whose locators have this kind: 4 and 8 are TCP over IPv4 and
/// IPv6. `own` are the kinds of locators that the reader itself announces.
fn by_tcp(kind: u32, own: &[u32]) -> (Transport, bool) {
    let locator = |kind: u32, port: u32| {
        let address = [0xfd, 0x99, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 10, 0, 0, 2];
        [&kind.to_le_bytes()[..], &port.to_le_bytes(), &address].concat()
    };
    let mut host = Host::new();
    let tcp = locator(kind, 7411 << 16 | 5100);
    let payload = forge::participant_with(BOB, &[(0x32, &tcp), (0x31, &tcp)]);
    host.announce(Message::from_fast(BOB).data(forge::SPDP, 1, &payload));
    let locators: Vec<_> = own.iter().map(|kind| locator(*kind, 7413)).collect();
    let others: Vec<(u16, &[u8])> = locators.iter().map(|each| (0x2f, &each[..])).collect();
    let guid = Guid::new(BOB, READER);
    let payload = forge::endpoint_with(guid, "rt/chatter", STRING, &others);
    host.announce(Message::from_fast(BOB).data(SEDP_READERS, 20, &payload));
    host.wait(1000);
    let snapshot = host.snapshot();
    let mut participants = snapshot.participants.iter();
    let bob = participants.find(|each| each.guid.prefix == BOB).unwrap();
    let mut topics = snapshot.topics.iter();
    let topic = topics.find(|topic| topic.name == "/chatter").unwrap();
    assert_eq!(topic.transports.len(), 1, "{:?}", topic.transports);
    (topic.transports[0].transport, bob.announces_by_tcp)
}

#[test]
fn a_subscription_that_receives_by_tcp_has_that_passage_with_either_version_of_ip() {
    for kind in [4, 8] {
        assert_eq!(by_tcp(kind, &[]), (Transport::Tcp, true), "{kind}");
        // The locators of a reader precede those of its participant.
        assert_eq!(by_tcp(kind, &[1]), (Transport::Network, true), "{kind}");
        // UDP is among them, so the sender need not use TCP.
        assert_eq!(
            by_tcp(kind, &[kind, 1]),
            (Transport::Network, true),
            "{kind}"
        );
    }
    assert_eq!(by_tcp(1, &[]), (Transport::Network, false));
    assert_eq!(by_tcp(1, &[8]), (Transport::Tcp, false));
}
