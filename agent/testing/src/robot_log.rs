//! Messages of a node's log, encoded by hand after `rcl_interfaces/msg/Log`, as XCDR1 in
//! little-endian order.

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

pub(crate) fn align(bytes: &mut Vec<u8>) {
    bytes.resize(bytes.len().next_multiple_of(4), 0);
}
