//! Messages of a node's log, encoded by hand after `rcl_interfaces/msg/Log`, as XCDR1 in
//! little-endian order.

use std::path::Path;

use ros2probe_wire::{EntityId, Guid, GuidPrefix};

use crate::model::capture::{Capture, ETHERNET};
use crate::model::forge::{self, Message, SEDP_WRITERS};

/// DDS name of the type.
pub const DDS_TYPE: &str = "rcl_interfaces::msg::dds_::Log_";

/// Returns a message, encapsulation header included. Its stamp is 2023-11-14 22:13:20.5 UTC.
#[must_use]
pub fn log(level: u8, logger: &str, text: &[u8]) -> Vec<u8> {
    let mut bytes = vec![0, 1, 0, 0];
    for word in [1_700_000_000, 500_000_000_u32] {
        bytes.extend(word.to_le_bytes());
    }
    bytes.push(level);
    for text in [logger.as_bytes(), text, b"src/lidar.cpp", b"read"] {
        align(&mut bytes);
        let length = u32::try_from(text.len() + 1).unwrap_or(u32::MAX);
        bytes.extend(length.to_le_bytes());
        bytes.extend(text);
        bytes.push(0);
    }
    align(&mut bytes);
    bytes.extend(81_u32.to_le_bytes());
    bytes
}

/// Writes a capture of a node that logs a message each millisecond: level, name of the logger, and
/// text. Returns its writer of `/rosout`; the messages have the sequence numbers from 1 on.
pub fn write_capture(
    path: &Path,
    messages: impl IntoIterator<Item = (u8, String, String)>,
) -> Guid {
    let writer = Guid::new(GuidPrefix([3; 12]), EntityId([0, 0, 1, 3]));
    let start = 1_700_000_000_000_000_000;
    let mut capture = Capture::new(ETHERNET);
    capture.participant(start, 0, writer.prefix);
    let payload = forge::endpoint(writer, "rt/rosout", DDS_TYPE, true);
    let message = Message::from(writer.prefix).data(SEDP_WRITERS, 1, &payload);
    capture.put(start + 1_000, 0, message);
    for (number, (level, logger, text)) in (1_u64..).zip(messages) {
        let payload = log(level, &logger, text.as_bytes());
        let message = Message::from(writer.prefix).data(writer.entity, number, &payload);
        capture.put(start + 1_000_000 * number, 0, message);
    }
    capture.write(path);
    writer
}

pub(crate) fn align(bytes: &mut Vec<u8>) {
    bytes.resize(bytes.len().next_multiple_of(4), 0);
}
