//! Conversion of an endpoint's token to the terms of DDS: its announcements and GUIDs.

use ros2probe_wire::discovery::{EndpointAnnouncement, Role};
use ros2probe_wire::names::{DdsTopic, DdsType};
use ros2probe_wire::rtps::VendorId;
use ros2probe_wire::zenoh::{EndpointKind, EndpointToken, Gid};
use ros2probe_wire::{EntityId, Guid};

/// Kind octet of a user-defined writer without key (RTPS 2.5, 9.3.1.2).
const WRITER_KIND: u8 = 0x03;
/// Kind octet of a user-defined reader without key.
const READER_KIND: u8 = 0x04;

/// Returns the announcements that DDS would make for an endpoint: two for a server or client.
pub(super) fn announcements(token: &EndpointToken) -> Vec<EndpointAnnouncement> {
    let name = token.name.as_str();
    let service = token.type_name.as_str().trim_end_matches('_');
    let request = || (format!("rq{name}Request"), format!("{service}_Request_"));
    let reply = || (format!("rr{name}Reply"), format!("{service}_Response_"));
    let topic = || (format!("rt{name}"), token.type_name.as_str().to_owned());
    let endpoints = match token.kind {
        EndpointKind::Publisher => vec![(Role::Writer, topic())],
        EndpointKind::Subscription => vec![(Role::Reader, topic())],
        EndpointKind::Server => vec![(Role::Reader, request()), (Role::Writer, reply())],
        EndpointKind::Client => vec![(Role::Writer, request()), (Role::Reader, reply())],
    };
    let endpoints = endpoints.into_iter();
    let announcements = endpoints.filter_map(|(role, (topic, type_name))| {
        let guid = endpoint_guid(token, role);
        let topic = DdsTopic::parse(&topic).ok()?;
        let type_name = DdsType::parse(&type_name).ok()?;
        let announced = EndpointAnnouncement::new(guid, role, VendorId::ZENOH, topic, type_name);
        Some(EndpointAnnouncement {
            gid: token.gid.0,
            qos: token.qos.clone().unwrap_or_else(|| announced.qos.clone()),
            type_hash: token.type_hash,
            backends: token.backends.clone(),
            ..announced
        })
    });
    announcements.collect()
}

/// Returns the GUID that represents an endpoint. It contains the endpoint's number in the session,
/// or a part of its hash if that number is too large.
fn endpoint_guid(token: &EndpointToken, role: Role) -> Guid {
    let [a, b, c, ..] = token.gid.0;
    let [.., x, y, z] = token.entity.to_be_bytes();
    let [x, y, z] = match token.entity < 1 << 24 {
        true => [x, y, z],
        false => [a, b, c],
    };
    Guid::new(
        token.node.session.guid_prefix(),
        EntityId([x, y, z, kind(role)]),
    )
}

/// Returns the GUID that represents a writer whose token is unknown.
pub fn unknown_guid(gid: Gid) -> Guid {
    let mut bytes = [0; 16];
    let from = VendorId::ZENOH.0.into_iter().chain(gid.0);
    for (into, from) in bytes.iter_mut().zip(from) {
        *into = from;
    }
    let [.., last] = &mut bytes;
    *last = kind(Role::Writer);
    Guid::from_bytes(bytes)
}

const fn kind(role: Role) -> u8 {
    match role {
        Role::Writer => WRITER_KIND,
        Role::Reader => READER_KIND,
    }
}
