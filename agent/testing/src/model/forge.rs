//! Builds RTPS messages as real participants send them, and invalid ones.

use std::net::{Ipv4Addr, SocketAddrV4};

use ros2probe_wire::walk::Envelope;
use ros2probe_wire::{EntityId, Guid, GuidPrefix};

pub const SPDP: EntityId = EntityId::SPDP_WRITER;
pub const SEDP_WRITERS: EntityId = EntityId::SEDP_PUBLICATIONS_WRITER;
pub const SEDP_READERS: EntityId = EntityId::SEDP_SUBSCRIPTIONS_WRITER;

/// One RTPS message under construction, little-endian.
pub struct Message(Vec<u8>);

impl Message {
    pub fn from(prefix: GuidPrefix) -> Self {
        let mut bytes = b"RTPS\x02\x01\x01\x10".to_vec();
        bytes.extend_from_slice(&prefix.0);
        Self(bytes)
    }

    /// Returns a message of Fast DDS.
    pub fn from_fast(prefix: GuidPrefix) -> Self {
        let mut bytes = b"RTPS\x02\x01\x01\x0f".to_vec();
        bytes.extend_from_slice(&prefix.0);
        Self(bytes)
    }

    pub fn info_ts(self, nanoseconds: u64) -> Self {
        let seconds = u32::try_from(nanoseconds / 1_000_000_000).unwrap();
        let fraction =
            u32::try_from(((nanoseconds % 1_000_000_000) << 32) / 1_000_000_000).unwrap();
        let body = [seconds.to_le_bytes(), fraction.to_le_bytes()].concat();
        self.submessage(0x09, 0x01, &body)
    }

    /// Adds a DATA with a payload.
    pub fn data(self, writer: EntityId, number: u64, payload: &[u8]) -> Self {
        let body = [&fixed(16, writer, number)[..], payload].concat();
        self.submessage(0x15, 0x05, &body)
    }

    /// Adds a DATA with inline QoS and a payload.
    pub fn data_with(
        self,
        writer: EntityId,
        number: u64,
        inline_qos: &[(u16, Vec<u8>)],
        payload: &[u8],
    ) -> Self {
        let inline_qos = parameters(inline_qos);
        let body = [&fixed(16, writer, number)[..], &inline_qos, payload].concat();
        self.submessage(0x15, 0x01 | 0x02 | 0x04, &body)
    }

    /// Adds a disposal with a key as payload, as Cyclone DDS writes it.
    pub fn dispose_by_key(self, writer: EntityId, number: u64, pid: u16, guid: Guid) -> Self {
        let inline_qos = parameters(&[(0x71, vec![0, 0, 0, 3])]);
        let payload = encapsulated(&[(pid, guid.to_bytes().to_vec())]);
        let body = [&fixed(16, writer, number)[..], &inline_qos, &payload].concat();
        self.submessage(0x15, 0x01 | 0x02 | 0x08, &body)
    }

    /// Adds a disposal with a key hash and no payload, as Fast DDS writes it.
    pub fn dispose_by_hash(self, writer: EntityId, number: u64, guid: Guid) -> Self {
        let inline_qos = parameters(&[(0x70, guid.to_bytes().to_vec()), (0x71, vec![0, 0, 0, 3])]);
        let body = [&fixed(16, writer, number)[..], &inline_qos].concat();
        self.submessage(0x15, 0x01 | 0x02, &body)
    }

    /// Adds a DATA_FRAG of one fragment.
    pub fn fragment(
        self,
        writer: EntityId,
        number: u64,
        start: u32,
        fragment_size: u16,
        payload: &[u8],
    ) -> Self {
        let begin = (start as usize - 1) * usize::from(fragment_size);
        let end = (begin + usize::from(fragment_size)).min(payload.len());
        let mut body = fixed(28, writer, number);
        body.extend_from_slice(&start.to_le_bytes());
        body.extend_from_slice(&1u16.to_le_bytes());
        body.extend_from_slice(&fragment_size.to_le_bytes());
        body.extend_from_slice(&u32::try_from(payload.len()).unwrap().to_le_bytes());
        body.extend_from_slice(payload.get(begin..end).unwrap());
        self.submessage(0x16, 0x01, &body)
    }

    pub fn submessage(mut self, id: u8, flags: u8, body: &[u8]) -> Self {
        let padded = body.len().next_multiple_of(4);
        self.0.extend_from_slice(&[id, flags]);
        self.0
            .extend_from_slice(&u16::try_from(padded).unwrap().to_le_bytes());
        self.0.extend_from_slice(body);
        self.0.resize(self.0.len() + padded - body.len(), 0);
        self
    }

    pub fn bytes(self) -> Vec<u8> {
        self.0
    }
}

/// Returns the fields of DATA and DATA_FRAG up to the sequence number.
fn fixed(to_inline_qos: u16, writer: EntityId, number: u64) -> Vec<u8> {
    let mut body = vec![0, 0];
    body.extend_from_slice(&to_inline_qos.to_le_bytes());
    body.extend_from_slice(&[0; 4]);
    body.extend_from_slice(&writer.0);
    body.extend_from_slice(&u32::try_from(number >> 32).unwrap().to_le_bytes());
    body.extend_from_slice(&(number as u32).to_le_bytes());
    body
}

fn parameters(list: &[(u16, Vec<u8>)]) -> Vec<u8> {
    let mut bytes = Vec::new();
    for (pid, value) in list {
        let len = value.len().next_multiple_of(4);
        bytes.extend_from_slice(&pid.to_le_bytes());
        bytes.extend_from_slice(&u16::try_from(len).unwrap().to_le_bytes());
        bytes.extend_from_slice(value);
        bytes.resize(bytes.len() + len - value.len(), 0);
    }
    bytes.extend_from_slice(&[1, 0, 0, 0]);
    bytes
}

fn encapsulated(list: &[(u16, Vec<u8>)]) -> Vec<u8> {
    [&[0, 3, 0, 0][..], &parameters(list)].concat()
}

fn text(text: &str) -> Vec<u8> {
    let len = u32::try_from(text.len() + 1).unwrap();
    [&len.to_le_bytes()[..], text.as_bytes(), &[0]].concat()
}

/// Returns an SPDP payload. With `None`, it has no domain id, so that the port determines the
/// domain.
pub fn participant(prefix: GuidPrefix, lease_seconds: u32, domain_id: Option<u32>) -> Vec<u8> {
    participant_at(prefix, lease_seconds, domain_id, &[])
}

/// Returns the SPDP payload of a participant with these unicast addresses.
pub fn participant_at(
    prefix: GuidPrefix,
    lease_seconds: u32,
    domain_id: Option<u32>,
    unicast: &[SocketAddrV4],
) -> Vec<u8> {
    let guid = Guid::new(prefix, EntityId::PARTICIPANT);
    let mut list = vec![
        (0x15, vec![2, 1]),
        (0x16, vec![1, 0x10]),
        (0x50, guid.to_bytes().to_vec()),
        (0x02, [lease_seconds.to_le_bytes(), [0; 4]].concat()),
        (0x2c, [&10u32.to_le_bytes()[..], b"enclave=/;"].concat()),
    ];
    if let Some(domain_id) = domain_id {
        list.push((0x0f, domain_id.to_le_bytes().to_vec()));
    }
    for address in unicast {
        list.push((0x31, locator(1, address.port().into(), *address.ip())));
    }
    encapsulated(&list)
}

fn locator(kind: u32, port: u32, address: Ipv4Addr) -> Vec<u8> {
    let mut locator = [kind.to_le_bytes(), port.to_le_bytes()].concat();
    locator.extend([0; 12]);
    locator.extend(address.octets());
    locator
}

/// Returns the SPDP payload of a participant that receives by TCP only.
pub fn participant_by_tcp(prefix: GuidPrefix, address: SocketAddrV4) -> Vec<u8> {
    const LOGICAL_PORT: u32 = 7411;
    let port = LOGICAL_PORT << 16 | u32::from(address.port());
    let locator = locator(4, port, *address.ip());
    participant_with(prefix, &[(0x32, &locator), (0x31, &locator)])
}

/// Returns the SPDP payload of a participant of Fast DDS that announces this type of participant.
pub fn participant_of_type(prefix: GuidPrefix, kind: &str) -> Vec<u8> {
    let mut properties = 1u32.to_le_bytes().to_vec();
    for octets in [text("PARTICIPANT_TYPE"), text(kind)] {
        properties.extend(octets);
        properties.resize(properties.len().next_multiple_of(4), 0);
    }
    participant_with(prefix, &[(0x59, &properties)])
}

/// Returns the SPDP payload of a participant of Fast DDS with these further parameters.
pub fn participant_with(prefix: GuidPrefix, others: &[(u16, &[u8])]) -> Vec<u8> {
    let guid = Guid::new(prefix, EntityId::PARTICIPANT);
    let mut list = vec![
        (0x15, vec![2, 3]),
        (0x16, vec![1, 0x0f]),
        (0x50, guid.to_bytes().to_vec()),
        (0x02, [20u32.to_le_bytes(), [0; 4]].concat()),
    ];
    list.extend(others.iter().map(|(id, value)| (*id, value.to_vec())));
    encapsulated(&list)
}

/// Returns the SPDP payload of a participant of Fast DDS with shared memory on this machine, and with
/// this address.
pub fn participant_on(prefix: GuidPrefix, machine_id: &str, address: [u8; 4]) -> Vec<u8> {
    participant_of_version(prefix, machine_id, address, Some([3, 2, 2, 0]))
}

/// Returns the same payload of this version of Fast DDS; versions before 3.0 announce none.
pub fn participant_of_version(
    prefix: GuidPrefix,
    machine_id: &str,
    address: [u8; 4],
    version: Option<[u8; 4]>,
) -> Vec<u8> {
    let guid = Guid::new(prefix, EntityId::PARTICIPANT);
    let shared_memory = [&16u32.to_le_bytes()[..], &7412u32.to_le_bytes(), &[0; 16]].concat();
    let udp = [
        &1u32.to_le_bytes()[..],
        &7411u32.to_le_bytes(),
        &[0; 12],
        &address,
    ]
    .concat();
    let mut list = vec![
        (0x31, udp),
        (0x15, vec![2, 3]),
        (0x16, vec![1, 0x0f]),
        (0x50, guid.to_bytes().to_vec()),
        (0x02, [1000u32.to_le_bytes(), [0; 4]].concat()),
        (0x0f, 0u32.to_le_bytes().to_vec()),
        (0x31, shared_memory),
        (0x8003, text(machine_id)),
    ];
    list.extend(version.map(|version| (0x8000, version.to_vec())));
    encapsulated(&list)
}

/// Returns an SEDP payload.
pub fn endpoint(guid: Guid, topic: &str, type_name: &str, reliable: bool) -> Vec<u8> {
    let reliability = if reliable { 2u32 } else { 1 };
    let value = [&reliability.to_le_bytes()[..], &[0; 8]].concat();
    endpoint_with(guid, topic, type_name, &[(0x1a, &value)])
}

/// Returns an SEDP payload with these parameters in addition to GUID, topic and type.
pub fn endpoint_with(guid: Guid, topic: &str, type_name: &str, others: &[(u16, &[u8])]) -> Vec<u8> {
    let mut list = vec![
        (0x5a, guid.to_bytes().to_vec()),
        (0x05, text(topic)),
        (0x07, text(type_name)),
    ];
    list.extend(others.iter().map(|(id, value)| (*id, value.to_vec())));
    encapsulated(&list)
}

/// Returns a `ros_discovery_info` payload of nodes with one writer each. Gids have 16 or 24 bytes.
pub fn entities(prefix: GuidPrefix, gid_len: usize, nodes: &[(&str, &str, Guid)]) -> Vec<u8> {
    let nodes = nodes.iter().map(|(namespace, name, writer)| AnnouncedNode {
        namespace,
        name,
        readers: Vec::new(),
        writers: vec![*writer],
    });
    entities_of(prefix, gid_len, &nodes.collect::<Vec<_>>())
}

/// A node in a `ros_discovery_info` payload.
pub struct AnnouncedNode<'a> {
    pub namespace: &'a str,
    pub name: &'a str,
    pub readers: Vec<Guid>,
    pub writers: Vec<Guid>,
}

/// Returns a `ros_discovery_info` payload of these nodes. Gids have 16 or 24 bytes.
pub fn entities_of(prefix: GuidPrefix, gid_len: usize, nodes: &[AnnouncedNode<'_>]) -> Vec<u8> {
    let gid = |guid: Guid| {
        let mut bytes = guid.to_bytes().to_vec();
        bytes.resize(gid_len, 0);
        bytes
    };
    let mut cdr = gid(Guid::new(prefix, EntityId::PARTICIPANT));
    let number = |cdr: &mut Vec<u8>, number: usize| {
        cdr.resize(cdr.len().next_multiple_of(4), 0);
        cdr.extend_from_slice(&u32::try_from(number).unwrap().to_le_bytes());
    };
    number(&mut cdr, nodes.len());
    for node in nodes {
        for part in [node.namespace, node.name] {
            number(&mut cdr, part.len() + 1);
            cdr.extend_from_slice(part.as_bytes());
            cdr.push(0);
        }
        for list in [&node.readers, &node.writers] {
            number(&mut cdr, list.len());
            list.iter()
                .for_each(|guid| cdr.extend_from_slice(&gid(*guid)));
        }
    }
    [&[0, 1, 0, 0][..], &cdr].concat()
}

/// Returns the context of a datagram to the discovery multicast address of a domain.
pub fn multicast(time: u64, domain_id: u16) -> Envelope {
    let mut destination = [0; 16];
    destination[10..].copy_from_slice(&[0xff, 0xff, 239, 255, 0, 1]);
    let destination_port = 7400 + 250 * domain_id;
    Envelope {
        time,
        destination,
        destination_port,
        ..Envelope::default()
    }
}
