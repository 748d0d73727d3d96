//! Builds messages of Zenoh as rmw_zenoh does, for tests.

use ros2probe_model::facts::route::Destination;
use ros2probe_model::graph::zenoh::{Flow, StreamEvent, StreamId, StreamReport};
use ros2probe_model::observe::input::Input;
use ros2probe_model::observe::observer::Observer;
use ros2probe_wire::Timestamp;
use ros2probe_wire::zenoh::vle;

/// Role of a session in INIT.
#[derive(Clone, Copy, Debug)]
pub enum Role {
    Router = 0,
    Peer = 1,
}

/// Returns bytes preceded by their length.
pub fn sized(bytes: &[u8]) -> Vec<u8> {
    [vle(bytes.len() as u64), bytes.to_vec()].concat()
}

/// Returns INIT, or its acknowledgement with these extensions.
pub fn init(zid: [u8; 16], role: Role, ack: Option<&[u8]>) -> Vec<u8> {
    let mut bytes = vec![0x41, 0x09, 0xf0 | role as u8];
    bytes.extend(zid);
    bytes.extend([0x0a, 0x00, 0xc0]);
    if let Some(extensions) = ack {
        bytes[0] |= 0x20;
        bytes.extend(sized(b"cookie"));
        if !extensions.is_empty() {
            bytes[0] |= 0x80;
            bytes.extend(extensions);
        }
    }
    bytes
}

/// Returns OPEN with a lease in seconds.
pub fn open(lease: u8) -> Vec<u8> {
    [vec![0x62, lease], vle(7)].concat()
}

/// Returns a FRAME of the reliable lane with these messages.
pub fn frame(number: u32, messages: &[Vec<u8>]) -> Vec<u8> {
    [vec![0x25], vle(number.into()), messages.concat()].concat()
}

/// Returns a FRAGMENT of the reliable lane.
pub fn fragment(number: u32, is_first: bool, has_more: bool, bytes: &[u8]) -> Vec<u8> {
    let header = 0x26 | if has_more { 0x40 } else { 0 } | if is_first { 0x80 } else { 0 };
    let first: &[u8] = if is_first { &[0x02] } else { &[] };
    [&[header], &vle(number.into())[..], first, bytes].concat()
}

/// Returns D_KEYEXPR: an alias for a key.
pub fn declare_key(id: u16, key: &str) -> Vec<u8> {
    [
        vec![0x1e, 0x20],
        vle(id.into()),
        vec![0],
        sized(key.as_bytes()),
    ]
    .concat()
}

/// Returns D_TOKEN with the whole key.
pub fn declare_token(id: u32, key: &str) -> Vec<u8> {
    [
        vec![0x1e, 0x26],
        vle(id.into()),
        vec![0],
        sized(key.as_bytes()),
    ]
    .concat()
}

/// Returns U_TOKEN without a key.
pub fn undeclare_token(id: u32) -> Vec<u8> {
    [vec![0x1e, 0x07], vle(id.into())].concat()
}

/// Returns INTEREST in all present and future aliases and tokens of a key.
pub fn interest(id: u32, key: &str) -> Vec<u8> {
    [
        vec![0x79],
        vle(id.into()),
        vec![0x39, 0],
        sized(key.as_bytes()),
    ]
    .concat()
}

/// Returns D_FINAL: the end of the answer to an INTEREST.
pub fn answer_end(interest: u32) -> Vec<u8> {
    [vec![0x3e], vle(interest.into()), vec![0x1a]].concat()
}

/// Returns a RESPONSE with a key, as the server of a service sends it.
pub fn response(key: &str, gid: [u8; 16], number: u64, payload: &[u8]) -> Vec<u8> {
    let head = [vec![0x3b, 1, 0], sized(key.as_bytes()), vec![0x04]].concat();
    [head, put(gid, number, payload)].concat()
}

/// Returns the PUSH of a PUT to the sender's alias, with an attachment of rmw_zenoh.
pub fn push(scope: u16, gid: [u8; 16], number: u64, payload: &[u8]) -> Vec<u8> {
    [vec![0x5d], vle(scope.into()), put(gid, number, payload)].concat()
}

fn put(gid: [u8; 16], number: u64, payload: &[u8]) -> Vec<u8> {
    let mut attachment = number.to_le_bytes().to_vec();
    attachment.extend(number.wrapping_mul(1000).to_le_bytes());
    attachment.push(16);
    attachment.extend(gid);
    let extension = [vec![0x43], sized(&attachment)].concat();
    [vec![0x81], extension, sized(payload)].concat()
}

/// Returns the key of a publisher's token.
pub fn publisher(zid: [u8; 16], entity: u32, topic: &str) -> String {
    let digits: String = zid.iter().rev().map(|byte| format!("{byte:02x}")).collect();
    let digits = digits.trim_start_matches('0');
    let topic = topic.replace('/', "%");
    format!(
        "@ros2_lv/0/{digits}/0/{entity}/MP/%/%/talker/{topic}/std_msgs::msg::dds_::String_/\
         TypeHashNotSupported/::,7:,:,:,,"
    )
}

/// Returns both directions of a connection on an interface, by the port of its initiator.
pub fn connection(port: u16) -> [StreamId; 2] {
    let place = |port| Destination {
        address: [0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0xff, 0xff, 127, 0, 0, 1],
        port,
    };
    let flow = Flow {
        source: place(port),
        destination: place(7447),
    };
    let one = StreamId {
        flow,
        ..StreamId::default()
    };
    [one, one.reversed()]
}

/// Passes a batch to the model.
pub fn send(observer: &mut Observer, stream: &StreamId, time: u64, batch: &[u8]) {
    let length = u16::try_from(batch.len()).unwrap();
    let event = StreamEvent::Batch {
        bytes: batch,
        length,
    };
    report(observer, stream, time, event);
}

/// Passes a report to the model.
pub fn report(observer: &mut Observer, stream: &StreamId, time: u64, event: StreamEvent<'_>) {
    let time = Timestamp(time);
    observer.input(Input::Time(time));
    observer.input(Input::Zenoh(&StreamReport {
        time,
        stream,
        event,
    }));
}
