//! The few RTPS messages that `rp discover` sends, byte for byte (RTPS 2.5, 8.3 and 9.4).
//!
//! They announce a bare participant and one reader of `ros_discovery_info`, request samples, and
//! say goodbye. All messages carry the identity of that participant.

use std::net::SocketAddrV4;

pub use ros2probe_wire::encode::VENDOR;
use ros2probe_wire::encode::{
    self, NO_FLAGS, PL_CDR_LE, Parameters, data_head, sequence_number, text,
};
use ros2probe_wire::parameters::ParameterId;
use ros2probe_wire::qos::{Durability, Reliability};
use ros2probe_wire::rtps::{LocatorKind, SubmessageFlags, SubmessageId};
use ros2probe_wire::{DomainId, EntityId, Guid, GuidPrefix, SequenceNumber};

/// Entity id of the reader of `ros_discovery_info`: user-defined, without key.
pub const NODES_READER: EntityId = EntityId([0x00, 0x00, 0x0a, 0x04]);
/// Reader of SEDP publication announcements.
pub const PUBLICATIONS_READER: EntityId = EntityId([0x00, 0x00, 0x03, 0xc7]);
/// Reader of SEDP subscription announcements.
pub const SUBSCRIPTIONS_READER: EntityId = EntityId([0x00, 0x00, 0x04, 0xc7]);
const SPDP_READER: EntityId = EntityId([0x00, 0x01, 0x00, 0xc7]);

/// Multicast address of discovery in all domains (RTPS 2.5, 9.6.2.4).
const MULTICAST_ADDRESS: [u8; 4] = [239, 255, 0, 1];
/// SPDP writer, SEDP publications reader, SEDP subscriptions writer and reader. Fast DDS accepts a
/// goodbye only from participants with an SPDP writer.
const BUILTIN_ENDPOINTS: u32 = 0x39;
/// Lease of the participant, in case the goodbye is lost.
const LEASE_SECONDS: u32 = 3;
/// Maximum number of sequence numbers in one ACKNACK (RTPS 2.5, 9.4.2.6).
pub const MAX_NUMBERS: u64 = 256;

/// Disposed and unregistered; STATUS_INFO is always big-endian (RTPS 2.5, 9.6.4.9).
const DISPOSED_UNREGISTERED: [u8; 4] = [0, 0, 0, 3];

/// The participant of this process.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LocalParticipant {
    /// Its GUID prefix.
    pub prefix: GuidPrefix,
    /// Address of its only socket.
    pub address: SocketAddrV4,
    /// Its domain.
    pub domain_id: u16,
}

/// A message under construction.
#[derive(Debug)]
pub struct Message(encode::Message);

impl Message {
    /// Begins a message from the local participant to one participant.
    #[must_use]
    pub fn new(local: LocalParticipant, target: GuidPrefix) -> Self {
        let message = Self(encode::Message::new(local.prefix));
        message.submessage(SubmessageId::INFO_DST, NO_FLAGS, &[&target.0])
    }

    /// Adds the SPDP announcement.
    ///
    /// The announcement has no user data, so the participant does not belong to ROS and no node
    /// list or graph shows it. Cyclone DDS forgets the address after the goodbye only if there is a
    /// multicast locator.
    #[must_use]
    pub fn announce(self, local: LocalParticipant) -> Self {
        let own = Guid::new(local.prefix, EntityId::PARTICIPANT);
        let unicast = locator(*local.address.ip(), local.address.port());
        // No ports exist beyond domain 232.
        let port = local.domain_id.saturating_mul(DomainId::PORT_GAIN);
        let port = port.saturating_add(DomainId::PORT_BASE);
        let multicast = locator(MULTICAST_ADDRESS.into(), port);
        let payload = Parameters::default()
            .add(ParameterId::PROTOCOL_VERSION, &[2, 3, 0, 0])
            .add(ParameterId::VENDORID, &[VENDOR.0[0], VENDOR.0[1], 0, 0])
            .add(ParameterId::PARTICIPANT_GUID, &own.to_bytes())
            .add(
                ParameterId::PARTICIPANT_LEASE_DURATION,
                &[LEASE_SECONDS.to_le_bytes(), [0; 4]].concat(),
            )
            .add(ParameterId::METATRAFFIC_UNICAST_LOCATOR, &unicast)
            .add(ParameterId::DEFAULT_UNICAST_LOCATOR, &unicast)
            .add(ParameterId::METATRAFFIC_MULTICAST_LOCATOR, &multicast)
            .add(
                ParameterId::BUILTIN_ENDPOINT_SET,
                &BUILTIN_ENDPOINTS.to_le_bytes(),
            )
            .end();
        self.data(SPDP_READER, EntityId::SPDP_WRITER, 1, &payload)
    }

    /// Adds the SPDP goodbye.
    #[must_use]
    pub fn goodbye(self, local: LocalParticipant) -> Self {
        let own = Guid::new(local.prefix, EntityId::PARTICIPANT);
        let inline_qos = Parameters::default()
            .add(ParameterId::KEY_HASH, &own.to_bytes())
            .add(ParameterId::STATUS_INFO, &DISPOSED_UNREGISTERED)
            .end();
        let head = data_head(SPDP_READER, EntityId::SPDP_WRITER, SequenceNumber(2));
        self.submessage(
            SubmessageId::DATA,
            SubmessageFlags::INLINE_QOS,
            &[&head, &inline_qos],
        )
    }

    /// Adds the SEDP announcement of the reader of `ros_discovery_info`, the only endpoint.
    #[must_use]
    pub fn read_nodes(self, local: LocalParticipant) -> Self {
        let own = Guid::new(local.prefix, EntityId::PARTICIPANT);
        let reader = Guid::new(local.prefix, NODES_READER);
        let payload = Parameters::default()
            .add(ParameterId::ENDPOINT_GUID, &reader.to_bytes())
            .add(ParameterId::PARTICIPANT_GUID, &own.to_bytes())
            .add(ParameterId::TOPIC_NAME, &text(b"ros_discovery_info"))
            .add(
                ParameterId::TYPE_NAME,
                &text(b"rmw_dds_common::msg::dds_::ParticipantEntitiesInfo_"),
            )
            .add(
                ParameterId::RELIABILITY,
                &[Reliability::RELIABLE.0.to_le_bytes(), [0; 4], [0; 4]].concat(),
            )
            .add(
                ParameterId::DURABILITY,
                &Durability::TRANSIENT_LOCAL.0.to_le_bytes(),
            )
            .end();
        let (reader, writer) = (SUBSCRIPTIONS_READER, EntityId::SEDP_SUBSCRIPTIONS_WRITER);
        let numbers = [sequence_number(SequenceNumber::FIRST); 2].concat();
        let heartbeat = [&reader.0[..], &writer.0, &numbers, &1u32.to_le_bytes()];
        self.data(reader, writer, 1, &payload).submessage(
            SubmessageId::HEARTBEAT,
            SubmessageFlags::FINAL,
            &heartbeat,
        )
    }

    /// Adds an ACKNACK: all samples of this writer before `base` are received, and these numbers
    /// are missing. Numbers beyond [`MAX_NUMBERS`] from `base` are left out.
    #[must_use]
    pub fn acknack(
        self,
        reader: EntityId,
        writer: EntityId,
        base: SequenceNumber,
        missing: impl IntoIterator<Item = SequenceNumber>,
        count: u32,
    ) -> Self {
        let set = bitmap(base.0, missing.into_iter().map(|number| number.0));
        let count = count.to_le_bytes();
        let body = [
            &reader.0[..],
            &writer.0,
            &sequence_number(base),
            &set,
            &count,
        ];
        self.submessage(SubmessageId::ACKNACK, SubmessageFlags::FINAL, &body)
    }

    /// Adds a NACK_FRAG: these fragments of this sample are missing (RTPS 2.5, 9.4.5.14). Cyclone
    /// DDS repeats only the first fragment of a requested sample, and waits for a NACK_FRAG.
    #[must_use]
    pub fn nack_frag(
        self,
        reader: EntityId,
        writer: EntityId,
        sample: SequenceNumber,
        missing: impl IntoIterator<Item = u32>,
        count: u32,
    ) -> Self {
        let mut missing = missing.into_iter().map(u64::from).peekable();
        let base = missing.peek().copied().unwrap_or(1);
        let set = bitmap(base, missing);
        let base = u32::try_from(base).unwrap_or(1).to_le_bytes();
        let count = count.to_le_bytes();
        let body = [
            &reader.0[..],
            &writer.0,
            &sequence_number(sample),
            &base,
            &set,
            &count,
        ];
        self.submessage(SubmessageId::NACK_FRAG, NO_FLAGS, &body)
    }

    /// Returns the bytes of the message.
    #[must_use]
    pub fn bytes(self) -> Vec<u8> {
        self.0.bytes()
    }

    fn data(self, reader: EntityId, writer: EntityId, number: u32, payload: &[u8]) -> Self {
        let number = SequenceNumber(number.into());
        Self(
            self.0
                .data((reader, writer), number, &[&PL_CDR_LE, payload]),
        )
    }

    fn submessage(self, id: SubmessageId, flags: SubmessageFlags, body: &[&[u8]]) -> Self {
        Self(self.0.submessage(id, flags, body))
    }
}

/// Returns numBits and bitmap of a set of sequence numbers that begins at `base` (RTPS 2.5,
/// 9.4.2.6).
fn bitmap(base: u64, numbers: impl IntoIterator<Item = u64>) -> Vec<u8> {
    let mut words = [0u32; 8];
    let mut bits = 0u32;
    for number in numbers {
        let offset = number.checked_sub(base);
        let Some(offset) = offset.and_then(|offset| u32::try_from(offset).ok()) else {
            continue;
        };
        if let Some(word) = words.get_mut((offset / 32) as usize) {
            *word |= 1 << (31 - offset % 32);
            bits = bits.max(offset + 1);
        }
    }
    let used = words.iter().take(bits.div_ceil(32) as usize);
    let words = std::iter::once(&bits).chain(used);
    words.flat_map(|word| word.to_le_bytes()).collect()
}

fn locator(address: std::net::Ipv4Addr, port: u16) -> Vec<u8> {
    let kind = LocatorKind::UDP_V4.0.to_le_bytes();
    let port = u32::from(port).to_le_bytes();
    [&kind[..], &port, &[0; 12], &address.octets()].concat()
}

#[cfg(test)]
mod tests {
    use std::net::Ipv4Addr;
    use std::time::Duration;

    use ros2probe_wire::discovery::{self, Discovery, Role};
    use ros2probe_wire::record;
    use ros2probe_wire::rtps::{InlineQos, Payload};
    use ros2probe_wire::walk::{self, Envelope, Found, Outcome};
    use ros2probe_wire::{Record, RtpsDuration};

    use super::*;

    const TARGET: GuidPrefix = GuidPrefix([9; 12]);
    const LOCAL: LocalParticipant = LocalParticipant {
        prefix: GuidPrefix(*b"\x01\x7fabcdefghij"),
        address: SocketAddrV4::new(Ipv4Addr::new(10, 0, 0, 7), 40_123),
        domain_id: 3,
    };

    fn message() -> Message {
        Message::new(LOCAL, TARGET)
    }

    fn walked(bytes: &[u8]) -> Vec<Found<'_>> {
        let mut found = Vec::new();
        let outcome = walk::datagram(bytes, &Envelope::default(), None, |it| found.push(it));
        assert_eq!(outcome, Outcome::Complete);
        found
    }

    #[test]
    fn the_announcement_has_the_measured_size_and_can_be_parsed() {
        let bytes = message().announce(LOCAL).bytes();
        assert_eq!(bytes.len(), 208);
        let found = walked(&bytes);
        let record = found[0].record;
        assert_eq!(
            record.writer(),
            Guid::new(LOCAL.prefix, EntityId::SPDP_WRITER)
        );
        assert_eq!(record.reader(), Guid::new(TARGET, SPDP_READER));
        assert_eq!((found.len(), record.sequence_number), (1, 1));
        let payload = Payload::Data(found[0].payload);
        let announced = discovery::participant(VENDOR, payload, &InlineQos::default()).unwrap();
        let Discovery::Alive(announced) = announced else {
            panic!("{announced:?}")
        };
        assert_eq!(
            announced.guid,
            Guid::new(LOCAL.prefix, EntityId::PARTICIPANT)
        );
        assert_eq!(
            (announced.vendor, announced.lease),
            (VENDOR, RtpsDuration::Finite(Duration::from_secs(3)))
        );
        assert_eq!(
            (announced.enclave, announced.builtin_endpoints.0),
            (None, 0x39)
        );
        let udp = |locators: &[ros2probe_wire::rtps::Locator]| {
            let all = locators.iter().map(|it| it.udp().unwrap().to_string());
            all.collect::<Vec<_>>()
        };
        assert_eq!(udp(&announced.metatraffic_unicast), ["10.0.0.7:40123"]);
        assert_eq!(udp(&announced.default_unicast), ["10.0.0.7:40123"]);
        assert_eq!(udp(&announced.metatraffic_multicast), ["239.255.0.1:8150"]);
        assert!(announced.default_multicast.is_empty());
    }

    #[test]
    fn the_goodbye_names_the_participant_by_its_key_hash() {
        let bytes = message().goodbye(LOCAL).bytes();
        let found = walked(&bytes);
        assert_eq!(found[0].record.sequence_number, 2);
        assert_eq!(
            (found[0].record.status_info, found[0].payload.len()),
            (3, 0)
        );
        let own = Guid::new(LOCAL.prefix, EntityId::PARTICIPANT).to_bytes();
        assert!(bytes.windows(16).any(|window| window == own));
    }

    #[test]
    fn the_announced_reader_matches_the_writer_of_the_node_list() {
        let bytes = message().read_nodes(LOCAL).bytes();
        let found = walked(&bytes);
        let payload = Payload::Data(found[0].payload);
        let announced = discovery::endpoint(Role::Reader, VENDOR, payload, &InlineQos::default());
        let Discovery::Alive(announced) = announced.unwrap() else {
            panic!("not alive")
        };
        assert_eq!(announced.guid, Guid::new(LOCAL.prefix, NODES_READER));
        assert_eq!(announced.topic.as_str(), "ros_discovery_info");
        assert_eq!(
            announced.type_name.message().as_str(),
            "rmw_dds_common/msg/ParticipantEntitiesInfo"
        );
        assert_eq!(announced.qos.reliability, Reliability::RELIABLE);
        assert_eq!(announced.qos.durability, Durability::TRANSIENT_LOCAL);
        let heartbeat = found[1].record;
        let record::Body::Heartbeat(heartbeat) = heartbeat.body() else {
            panic!("{heartbeat:?}")
        };
        assert_eq!((heartbeat.first().0, heartbeat.last().0), (1, 1));
    }

    fn missing_of(record: &Record) -> record::SequenceNumberSet {
        let record::Body::AckNack(acknack) = record.body() else {
            panic!("{record:?}")
        };
        acknack.missing()
    }

    #[test]
    fn a_request_contains_exactly_the_missing_sequence_numbers() {
        let asked = |base: u64, missing: &[u64]| -> (Record, Vec<u64>) {
            let writer = EntityId::SEDP_PUBLICATIONS_WRITER;
            let numbers = missing.iter().copied().map(SequenceNumber);
            let bytes = message()
                .acknack(
                    PUBLICATIONS_READER,
                    writer,
                    SequenceNumber(base),
                    numbers,
                    7,
                )
                .bytes();
            let record = walked(&bytes)[0].record;
            (
                record,
                missing_of(&record).iter().map(|number| number.0).collect(),
            )
        };
        for missing in [vec![1], vec![1, 2, 3, 33, 64, 65, 150], vec![(1 << 32) + 5]] {
            let (record, numbers) = asked(missing[0], &missing);
            assert_eq!(
                (numbers, missing_of(&record).base.0),
                (missing.clone(), missing[0])
            );
            assert_eq!(
                record.writer(),
                Guid::new(TARGET, EntityId::SEDP_PUBLICATIONS_WRITER)
            );
            assert_eq!(
                record.reader(),
                Guid::new(LOCAL.prefix, PUBLICATIONS_READER)
            );
        }
        let bytes = message()
            .nack_frag(
                NODES_READER,
                NODES_READER,
                SequenceNumber(48),
                [2, 4, 33],
                1,
            )
            .bytes();
        // After the header and INFO_DST (RTPS 2.5, 9.4.5.14).
        let nack_frag = [
            &[0x12, 0x01, 32, 0][..],
            &NODES_READER.0,
            &NODES_READER.0,
            &[0, 0, 0, 0, 48, 0, 0, 0],
            // FragmentNumberSet: base, numBits, one word.
            &[2, 0, 0, 0, 32, 0, 0, 0, 0x01, 0, 0, 0xa0],
            &[1, 0, 0, 0],
        ];
        assert_eq!(bytes[36..], nack_frag.concat());
        let (record, _) = asked(10, &(1..1000).collect::<Vec<_>>());
        let set = missing_of(&record);
        assert_eq!(set.num_bits, 256, "what does not fit is left out");
    }
}
