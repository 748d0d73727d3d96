use std::format;
use std::string::{String, ToString};
use std::vec::Vec;

use proptest::prelude::*;

use super::*;
use crate::cursor::Endianness;
use crate::domain::DomainId;
use crate::guid::{EntityId, GuidPrefix};
use crate::names::MAX_LEN;
use crate::qos::{Durability, HistoryKind, Liveliness, Qos, Reliability};
use crate::rtps::ProtocolVersion;
use crate::testing::{self, Encoder, hurt};
use core::time::Duration;

use crate::time::RtpsDuration;

const PREFIX: GuidPrefix = GuidPrefix([1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12]);
const NO_INLINE_QOS: InlineQos = InlineQos {
    key_hash: None,
    status_info: StatusInfo(0),
    related_sample_identity: None,
};

fn alive<T>(discovery: Discovery<T>) -> T {
    match discovery {
        Discovery::Alive(alive) => alive,
        Discovery::Gone { guid, .. } => panic!("{guid} is gone"),
    }
}

fn captured_participant(datagram: &[u8]) -> Discovery<ParticipantAnnouncement> {
    let (vendor, inline_qos, data) = testing::data(datagram)[0];
    participant(vendor, data.payload, &inline_qos).unwrap()
}

fn captured_endpoints(datagram: &[u8]) -> Vec<Discovery<EndpointAnnouncement>> {
    testing::data(datagram)
        .into_iter()
        .map(|(vendor, inline_qos, data)| {
            let role = match data.writer.entity {
                EntityId::SEDP_PUBLICATIONS_WRITER => Role::Writer,
                _ => Role::Reader,
            };
            endpoint(role, vendor, data.payload, &inline_qos).unwrap()
        })
        .collect()
}

fn udp(locators: &[Locator]) -> Vec<String> {
    locators.iter().map(ToString::to_string).collect()
}

/// Returns the start of a payload with a parameter list, which has no sentinel yet.
fn list(endianness: Endianness) -> Encoder {
    let mut list = Encoder::new(endianness);
    list.raw(&[0, if endianness == Endianness::Big { 2 } else { 3 }, 0, 0]);
    list
}

fn guid_of(entity: [u8; 4]) -> Guid {
    Guid::new(PREFIX, EntityId(entity))
}

/// Returns a writer's announcement with these names.
fn endpoint_list(topic: &str, type_name: &str) -> Encoder {
    let endianness = Endianness::Little;
    let mut text = Encoder::new(endianness);
    let mut payload = list(endianness);
    payload.parameter(0x0005, &text.string(topic).bytes);
    payload.parameter(0x0007, &Encoder::new(endianness).string(type_name).bytes);
    payload.parameter(0x005a, &guid_of([0, 0, 1, 3]).to_bytes());
    payload
}

fn writer(payload: &[u8], vendor: VendorId) -> Result<EndpointAnnouncement, WireError> {
    endpoint(Role::Writer, vendor, Payload::Data(payload), &NO_INLINE_QOS).map(alive)
}

fn announced(payload: &[u8]) -> Result<ParticipantAnnouncement, WireError> {
    participant(VendorId::CYCLONE, Payload::Data(payload), &NO_INLINE_QOS).map(alive)
}

fn participant_list() -> Encoder {
    let mut payload = list(Endianness::Little);
    payload.parameter(0x0050, &guid_of(EntityId::PARTICIPANT.0).to_bytes());
    payload
}

#[test]
fn a_participant_of_cyclone_dds_is_parsed() {
    let participant = alive(captured_participant(testing::CYCLONE_SPDP));
    assert_eq!(
        participant.guid.to_string(),
        "0110b65a7faf6e18fb1cb0e3.000001c1"
    );
    assert_eq!(participant.vendor, VendorId::CYCLONE);
    assert_eq!(
        participant.protocol_version,
        ProtocolVersion { major: 2, minor: 1 }
    );
    assert_eq!(
        participant.lease,
        RtpsDuration::Finite(Duration::from_secs(10))
    );
    assert_eq!(participant.domain_id, Some(DomainId(0)));
    assert_eq!(participant.enclave.as_deref(), Some("/"));
    assert!(participant.is_ros() && !participant.is_secured && !participant.is_truncated);
    assert_eq!(participant.process_name(), Some("python"));
    assert_eq!(
        (participant.process_id(), participant.host_name()),
        (Some(16972), Some("vm"))
    );
    assert_eq!(participant.process_id_low_bits(), None);
    assert_eq!(udp(&participant.default_unicast), ["udp:10.99.0.2:50595"]);
    assert_eq!(
        udp(&participant.default_multicast),
        ["udp:239.255.0.1:7401"]
    );
    assert_eq!(
        udp(&participant.metatraffic_unicast),
        ["udp:10.99.0.2:50595"]
    );
    assert_eq!(
        udp(&participant.metatraffic_multicast),
        ["udp:239.255.0.1:7400"]
    );
    assert_eq!(participant.builtin_endpoints, BuiltinEndpoints(0xfc3f));
    assert_eq!(participant.product_version.as_deref(), Some("0.10.2"));
}

#[test]
fn the_version_of_an_implementation_depends_on_its_vendor_and_may_be_unreadable() {
    let text = |text: &str| {
        let mut value = Encoder::new(Endianness::Little);
        for _ in 0..5 {
            value.u32(0);
        }
        value.string(text).bytes.clone()
    };
    let version = |vendor: VendorId, id: u16, value: &[u8]| {
        let mut payload = participant_list();
        payload.parameter(0x0016, &[vendor.0[0], vendor.0[1], 0, 0]);
        payload.parameter(id, value);
        let announced = announced(&payload.bytes).unwrap();
        announced.product_version.map(String::from)
    };
    let (cyclone, fast, rti) = (VendorId::CYCLONE, VendorId::EPROSIMA, VendorId::RTI_CONNEXT);
    assert_eq!(
        version(fast, 0x8000, &[3, 2, 5, 0]).as_deref(),
        Some("3.2.5")
    );
    assert_eq!(
        version(rti, 0x8000, &[7, 3, 0, 5]).as_deref(),
        Some("7.3.0.5")
    );
    let own = version(cyclone, 0x8007, &text("robot/11.0.1/Linux/Linux"));
    assert_eq!(own.as_deref(), Some("11.0.1"));
    // Numbers have another meaning for another vendor, and no value prevents an announcement.
    assert_eq!(version(cyclone, 0x8000, &[63, 12, 0, 0]), None);
    assert_eq!(version(fast, 0x8007, &text("robot/11.0.1/Linux")), None);
    assert_eq!(version(cyclone, 0x8007, &[0; 8]), None);
    assert_eq!(version(cyclone, 0x8007, &text("robot")), None);
    assert_eq!(version(cyclone, 0x8007, &text("robot//Linux")), None);
    let long = format!("robot/{}/Linux", "1".repeat(40));
    assert_eq!(version(cyclone, 0x8007, &text(&long)), None);
}

#[test]
fn a_participant_of_fast_dds_is_parsed() {
    let participant = alive(captured_participant(testing::FAST_SPDP));
    assert_eq!(
        participant.guid.to_string(),
        "010f0d043f4752ad00000000.000001c1"
    );
    assert_eq!(participant.vendor, VendorId::EPROSIMA);
    assert_eq!(
        participant.lease,
        RtpsDuration::Finite(Duration::from_secs(20))
    );
    assert_eq!(participant.domain_id, None);
    assert_eq!(participant.entity_name, "/");
    // The NUL that Fast DDS counts into the user data is not part of the enclave.
    assert_eq!(participant.enclave.as_deref(), Some("/"));
    assert_eq!(participant.property("PARTICIPANT_TYPE"), Some("SIMPLE"));
    assert_eq!(
        (participant.process_id(), participant.host_name()),
        (None, None)
    );
    assert_eq!(participant.process_id_low_bits(), Some(0x473f));
    assert_eq!(
        udp(&participant.metatraffic_unicast),
        ["udp:10.99.0.1:7410"]
    );
    assert!(participant.metatraffic_multicast.is_empty());
}

#[test]
fn a_discovery_server_is_known_by_the_announced_type_of_participant() {
    let is_server = |name: &str, value: &str| {
        let mut properties = Encoder::new(Endianness::Little);
        properties.u32(1).string(name).string(value);
        let mut payload = participant_list();
        payload.parameter(0x0059, &properties.bytes);
        announced(&payload.bytes).unwrap().is_discovery_server()
    };
    for (kind, expected) in [
        ("SERVER", true),
        ("BACKUP", true),
        ("SIMPLE", false),
        ("CLIENT", false),
        ("SUPER_CLIENT", false),
    ] {
        assert_eq!(is_server("PARTICIPANT_TYPE", kind), expected, "{kind}");
    }
    assert!(!is_server("kind", "SERVER"));
}

#[test]
fn endpoints_of_fast_dds_are_parsed() {
    let [writer] = captured_endpoints(testing::FAST_SEDP_WRITER)
        .try_into()
        .unwrap();
    let writer = alive(writer);
    assert_eq!(writer.guid.to_string(), "010f2b7d6a474f3300000000.00000103");
    assert_eq!(
        writer.participant.to_string(),
        "010f2b7d6a474f3300000000.000001c1"
    );
    assert_eq!(writer.topic.as_str(), "ros_discovery_info");
    assert_eq!(
        writer.type_name.message().as_str(),
        "rmw_dds_common/msg/ParticipantEntitiesInfo"
    );
    assert_eq!(writer.qos.reliability, Reliability::RELIABLE);
    assert_eq!(writer.qos.durability, Durability::TRANSIENT_LOCAL);
    assert_eq!(writer.qos.deadline, RtpsDuration::Infinite);
    assert_eq!(writer.qos.liveliness, Liveliness::AUTOMATIC);
    // Neither announced nor set to a default.
    assert_eq!(writer.qos.history, None);
    assert_eq!(writer.type_hash, None);
    assert_eq!(udp(&writer.unicast), ["udp:10.99.0.2:7411"]);
    let [reader] = captured_endpoints(testing::FAST_SEDP_READER)
        .try_into()
        .unwrap();
    let reader = alive(reader);
    assert_eq!(
        (reader.role, reader.guid.entity),
        (Role::Reader, EntityId([0, 0, 2, 4]))
    );
}

#[test]
fn endpoints_of_cyclone_dds_are_parsed() {
    let [writer, reader, rosout] = captured_endpoints(testing::CYCLONE_SEDP)
        .into_iter()
        .map(alive)
        .collect::<Vec<_>>()
        .try_into()
        .unwrap();
    assert_eq!((writer.role, reader.role), (Role::Writer, Role::Reader));
    // Cyclone DDS does not name the participant.
    assert_eq!(
        writer.participant,
        Guid::new(writer.guid.prefix, EntityId::PARTICIPANT)
    );
    assert_eq!(writer.qos.history.unwrap().depth, 1);
    assert_eq!(reader.qos.history.unwrap().kind, HistoryKind::KEEP_ALL);
    assert_eq!(rosout.topic.as_str(), "rt/rosout");
    assert_eq!(rosout.qos.history.unwrap().depth, 1000);
    assert_eq!(
        rosout.qos.lifespan,
        RtpsDuration::Finite(Duration::from_secs(10))
    );
    let readers = captured_endpoints(testing::CYCLONE_SEDP_READERS);
    assert_eq!(readers.len(), 5);
}

#[test]
fn participants_and_endpoints_of_rustdds_are_parsed() {
    let participant = alive(captured_participant(testing::RUSTDDS_SPDP));
    assert_eq!(
        participant.guid.to_string(),
        "0112fa8840171addfe777b8f.000001c1"
    );
    assert_eq!(participant.vendor, VendorId::RUSTDDS);
    assert_eq!(
        participant.lease,
        RtpsDuration::Finite(Duration::from_secs(50))
    );
    // A ROS participant that announces neither its enclave nor its domain.
    assert!(!participant.is_ros() && participant.domain_id.is_none());
    let [writer, events, _] = captured_endpoints(testing::RUSTDDS_SEDP)
        .into_iter()
        .map(alive)
        .collect::<Vec<_>>()
        .try_into()
        .unwrap();
    // The vendor is the sender's, the history is not announced, and the entity key 0 is in use.
    assert_eq!(
        (writer.vendor, writer.qos.history),
        (VendorId::RUSTDDS, None)
    );
    assert_eq!(writer.guid.entity, EntityId([0, 0, 0, 3]));
    assert_eq!(events.topic.as_str(), "rt/parameter_events");
    // The participant disposes of its builtin readers too.
    let gone = captured_endpoints(testing::RUSTDDS_SEDP_DISPOSE);
    let builtin = gone.iter().filter(|discovery| match discovery {
        Discovery::Gone { guid, .. } => guid.entity.is_builtin(),
        Discovery::Alive(alive) => panic!("{alive:?}"),
    });
    assert_eq!((builtin.count(), gone.len()), (5, 8));
    assert!(matches!(
        captured_participant(testing::RUSTDDS_SPDP_DISPOSE),
        Discovery::Gone { guid, .. } if guid == participant.guid
    ));
}

#[test]
fn the_type_hash_of_iron_and_later_is_parsed() {
    let [first, ..] = &captured_endpoints(testing::JAZZY_SEDP)[..] else {
        panic!()
    };
    let first = alive(first.clone());
    assert_eq!(
        first.type_hash.unwrap().to_string(),
        "RIHS01_91a0593bacdcc50ea9bdcf849a938b128412cc1ea821245c663bcd26f83c295e"
    );
    assert_eq!(first.service_type_hash, None);
}

#[test]
fn all_four_forms_of_disposal_identify_the_participant_or_endpoint() {
    let gone = |text: &str, entity: [u8; 4]| {
        let prefix: Vec<u8> = (0..12)
            .map(|i| u8::from_str_radix(&text[2 * i..2 * i + 2], 16).unwrap())
            .collect();
        let guid = Guid::new(GuidPrefix(prefix.try_into().unwrap()), EntityId(entity));
        (guid, StatusInfo(3))
    };
    let participant = |datagram| match captured_participant(datagram) {
        Discovery::Gone { guid, status } => (guid, status),
        Discovery::Alive(alive) => panic!("{alive:?}"),
    };
    let endpoint = |datagram| match &captured_endpoints(datagram)[..] {
        [Discovery::Gone { guid, status }] => (*guid, *status),
        other => panic!("{other:?}"),
    };
    // The payload has the key only.
    assert_eq!(
        participant(testing::CYCLONE_SPDP_DISPOSE),
        gone("01101843e6f7a0a9745a36cc", [0, 0, 1, 0xc1])
    );
    assert_eq!(
        endpoint(testing::CYCLONE_SEDP_DISPOSE),
        gone("01101843e6f7a0a9745a36cc", [0, 0, 7, 3])
    );
    // There is no payload; the key hash is in the inline QoS.
    assert_eq!(
        participant(testing::FAST_SPDP_DISPOSE),
        gone("010f2b7d6a474f3300000000", [0, 0, 1, 0xc1])
    );
    assert_eq!(
        endpoint(testing::FAST_SEDP_DISPOSE),
        gone("010f0d043f4752ad00000000", [0, 0, 0x31, 3])
    );
}

#[test]
fn a_disposal_without_a_guid_is_an_error() {
    let status = InlineQos {
        status_info: StatusInfo(1),
        ..NO_INLINE_QOS
    };
    for payload in [
        Payload::None,
        Payload::Key(&[0, 3, 0, 0]),
        Payload::Data(&[0, 3, 0, 0]),
    ] {
        let error = participant(VendorId::EPROSIMA, payload, &status).unwrap_err();
        assert_eq!(error.reason, Reason::BadValue);
        assert!(endpoint(Role::Reader, VendorId::EPROSIMA, payload, &status).is_err());
    }
    // Neither alive nor disposed: no payload and no status.
    assert!(participant(VendorId::EPROSIMA, Payload::None, &NO_INLINE_QOS).is_err());
}

#[test]
fn an_announcement_without_a_consistent_guid_is_refused() {
    let reason = |result: Result<EndpointAnnouncement, WireError>| result.unwrap_err().reason;
    let mut nobody = list(Endianness::Little);
    nobody
        .parameter(0x0005, b"\x02\0\0\0a\0\0\0")
        .parameter(0x0007, b"\x02\0\0\0a\0\0\0");
    assert_eq!(
        reason(writer(&nobody.bytes, VendorId::EPROSIMA)),
        Reason::BadValue
    );
    let mut somebody_elses = endpoint_list("rt/a", "A");
    somebody_elses.parameter(0x0050, &[9; 16]);
    assert_eq!(
        reason(writer(&somebody_elses.bytes, VendorId::EPROSIMA)),
        Reason::BadValue
    );
    let payload = endpoint_list("rt/a", "A");
    let reader = endpoint(
        Role::Reader,
        VendorId::EPROSIMA,
        Payload::Data(&payload.bytes),
        &NO_INLINE_QOS,
    );
    assert_eq!(reader.unwrap_err().what, "PID_ENDPOINT_GUID");
    assert!(writer(&payload.bytes, VendorId::EPROSIMA).is_ok());

    assert_eq!(
        announced(&list(Endianness::Little).bytes).unwrap_err().what,
        "PID_PARTICIPANT_GUID"
    );
    let mut not_a_participant = list(Endianness::Little);
    not_a_participant.parameter(0x0050, &guid_of([0, 0, 1, 3]).to_bytes());
    assert!(announced(&not_a_participant.bytes).is_err());
}

#[test]
fn a_missing_parameter_has_the_default_of_the_specification() {
    let participant = announced(&participant_list().bytes).unwrap();
    assert_eq!(
        participant.lease,
        RtpsDuration::Finite(Duration::from_secs(100))
    );
    assert_eq!(
        (participant.domain_id, participant.domain_tag.as_str()),
        (None, "")
    );
    assert!(!participant.is_ros());
    let endpoint = writer(&endpoint_list("rt/a", "A").bytes, VendorId::CYCLONE).unwrap();
    assert_eq!(endpoint.qos, Qos::defaults(Role::Writer, VendorId::CYCLONE));
}

#[test]
fn the_vendor_of_the_payload_decides_the_meaning_of_vendor_parameters() {
    let mut payload = endpoint_list("rt/a", "A");
    payload.parameter(0x8006, &[1, 0, 0, 0]);
    assert!(
        writer(&payload.bytes, VendorId::EPROSIMA)
            .unwrap()
            .datasharing
    );
    assert!(
        !writer(&payload.bytes, VendorId::CYCLONE)
            .unwrap()
            .datasharing
    );
    // The payload's vendor overrides the sender's, at any position in the list.
    payload.parameter(0x0016, &[1, 0x10, 0, 0]);
    let endpoint = writer(&payload.bytes, VendorId::EPROSIMA).unwrap();
    assert_eq!(
        (endpoint.datasharing, endpoint.vendor),
        (false, VendorId::CYCLONE)
    );
}

// Coverage: DDS security | - | - | named
#[test]
fn security_content_filters_and_domain_tags_are_recognized() {
    let mut payload = participant_list();
    payload.parameter(0x1001, &[0; 8]);
    payload.parameter(0x4014, b"\x05\0\0\0tag1\0\0\0\0");
    payload.parameter(0x000f, &[42, 0, 0, 0]);
    let participant = announced(&payload.bytes).unwrap();
    assert!(participant.is_secured);
    assert_eq!(
        (participant.domain_id, participant.domain_tag.as_str()),
        (Some(DomainId(42)), "tag1")
    );
    let mut payload = endpoint_list("rt/a", "A");
    payload
        .parameter(0x0035, &[0; 4])
        .parameter(0x1004, &[0; 8]);
    payload.parameter(0x0004, &[1, 0, 0, 0, 0, 0, 0, 0]);
    let endpoint = writer(&payload.bytes, VendorId::EPROSIMA).unwrap();
    assert!(endpoint.content_filter && endpoint.is_secured);
    assert_eq!(
        endpoint.qos.minimum_separation,
        RtpsDuration::Finite(Duration::from_secs(1))
    );
}

#[test]
fn hostile_names_are_refused_with_their_reason() {
    let reason = |topic: &str, type_name: &str| {
        writer(&endpoint_list(topic, type_name).bytes, VendorId::EPROSIMA)
            .unwrap_err()
            .reason
    };
    assert_eq!(reason("rt/a\"} 1\n", "A"), Reason::BadText);
    assert_eq!(reason("rt/a", "A\r\nB"), Reason::BadText);
    assert_eq!(reason(&"a".repeat(10_240), "A"), Reason::OverLimit);
    assert_eq!(reason("rt/a", &"a".repeat(MAX_LEN + 1)), Reason::OverLimit);
    assert_eq!(reason("", "A"), Reason::BadValue);
    let mut payload = list(Endianness::Little);
    payload.parameter(0x005a, &guid_of([0, 0, 1, 3]).to_bytes());
    payload
        .parameter(0x0005, b"\x03\0\0\0\xc3\x28\0\0")
        .parameter(0x0007, b"\x02\0\0\0a\0\0\0");
    let error = writer(&payload.bytes, VendorId::EPROSIMA).unwrap_err();
    assert_eq!(
        (error.what, error.offset, error.reason),
        ("PID_TOPIC_NAME", 28, Reason::BadText)
    );
}

#[test]
fn long_lists_are_cut_and_marked_as_truncated() {
    let mut payload = participant_list();
    for _ in 0..200 {
        payload.parameter(0x0032, &[1; 24]);
    }
    let participant = announced(&payload.bytes).unwrap();
    assert_eq!(participant.metatraffic_unicast.len(), MAX_LOCATORS);
    assert!(participant.is_truncated);

    let mut properties = Encoder::new(Endianness::Little);
    properties.u32(40);
    for _ in 0..40 {
        properties.string("name").string("value");
    }
    let mut payload = participant_list();
    payload.parameter(0x0059, &properties.bytes);
    let participant = announced(&payload.bytes).unwrap();
    assert_eq!(
        (participant.properties.len(), participant.is_truncated),
        (32, true)
    );

    // A count that is larger than the bytes allow.
    let mut payload = participant_list();
    payload.parameter(0x0059, &[0xff; 4]);
    assert_eq!(
        announced(&payload.bytes).unwrap_err().reason,
        Reason::Truncated
    );
}

#[test]
fn an_unreadable_property_does_not_hide_the_others() {
    let mut properties = Encoder::new(Endianness::Little);
    properties
        .u32(2)
        .u32(2)
        .raw(b"\xff\0")
        .string("value")
        .string("__Pid")
        .string("7");
    let mut payload = participant_list();
    payload.parameter(0x0059, &properties.bytes);
    let participant = announced(&payload.bytes).unwrap();
    assert_eq!(
        (participant.process_id(), participant.is_truncated),
        (Some(7), true)
    );
}

#[test]
fn an_entity_name_with_a_quote_does_not_hide_the_participant() {
    let mut payload = participant_list();
    payload.parameter(0x0062, b"\x05\0\0\0it's\0\0\0\0");
    let participant = announced(&payload.bytes).unwrap();
    assert_eq!(
        (participant.entity_name.as_str(), participant.is_truncated),
        ("", true)
    );
}

#[test]
fn a_list_that_breaks_off_is_reported_as_truncated() {
    let payload = endpoint_list("rt/a", "A").bytes;
    let error = writer(&payload[..payload.len() - 10], VendorId::EPROSIMA).unwrap_err();
    assert_eq!(error.reason, Reason::Truncated);
}

#[test]
fn damaged_announcements_never_make_the_parser_panic() {
    for datagram in testing::CAPTURED {
        for (vendor, inline_qos, data) in testing::data(datagram) {
            hurt(data.payload.bytes(), |bytes| {
                for payload in [Payload::Data(bytes), Payload::Key(bytes)] {
                    let _ = participant(vendor, payload, &inline_qos);
                    let _ = endpoint(Role::Writer, vendor, payload, &inline_qos);
                    let _ = endpoint(Role::Reader, vendor, payload, &inline_qos);
                }
            });
        }
    }
}

proptest! {
    #[test]
    fn encoded_endpoints_survive_a_round_trip(
        little in any::<bool>(),
        topic in "rt(/[a-z_]{1,8}){1,3}",
        type_name in "[a-z_]{1,8}::msg::dds_::[A-Z][a-z]{0,8}_",
        entity in any::<[u8; 3]>(),
        reliability in 0..4_u32,
        durability in 0..9_u32,
        depth in any::<i32>(),
        lifespan in (0..i32::MAX, any::<u32>()),
        partitions in prop::collection::vec("[a-z]{0,5}", 0..4),
    ) {
        let endianness = if little { Endianness::Little } else { Endianness::Big };
        let value = || Encoder::new(endianness);
        let [a, b, c] = entity;
        let guid = guid_of([a, b, c, 0x03]);
        let mut payload = list(endianness);
        payload.parameter(0x0005, &value().string(&topic).bytes);
        payload.parameter(0x005a, &guid.to_bytes());
        payload.parameter(0x0007, &value().string(&type_name).bytes);
        payload.parameter(0x001a, &value().u32(reliability).u32(0).u32(0).bytes);
        payload.parameter(0x001d, &value().u32(durability).bytes);
        payload.parameter(0x0040, &value().u32(1).u32(depth.cast_unsigned()).bytes);
        payload.parameter(0x002b, &value().u32(lifespan.0.cast_unsigned()).u32(lifespan.1).bytes);
        let mut names = value();
        names.u32(u32::try_from(partitions.len()).unwrap());
        for partition in &partitions {
            names.string(partition);
        }
        payload.parameter(0x0029, &names.bytes).u16(1).u16(0);
        let endpoint = writer(&payload.bytes, VendorId::EPROSIMA).unwrap();
        prop_assert_eq!(endpoint.guid, guid);
        prop_assert_eq!(endpoint.topic.as_str(), &topic);
        prop_assert_eq!(endpoint.type_name.as_str(), &type_name);
        let expected = if reliability == 3 { 2 } else { reliability };
        prop_assert_eq!(endpoint.qos.reliability, Reliability(expected));
        prop_assert_eq!(endpoint.qos.durability, Durability(durability));
        prop_assert_eq!(endpoint.qos.history.unwrap().depth, depth);
        prop_assert_eq!(endpoint.qos.lifespan, RtpsDuration::from_wire(lifespan.0, lifespan.1));
        let ours: Vec<_> = endpoint.qos.partitions.iter().map(ToString::to_string).collect();
        prop_assert_eq!(ours, partitions);
    }
}
