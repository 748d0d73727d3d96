//! Diagnostics, encoded by hand after `diagnostic_msgs/msg/DiagnosticArray`, as XCDR1 in
//! little-endian order.

use crate::robot_log::align;

/// DDS name of the type.
pub const DDS_TYPE: &str = "diagnostic_msgs::msg::dds_::DiagnosticArray_";

/// A status to encode.
#[derive(Clone, Copy, Debug)]
pub struct Status<'a> {
    /// Number of the level.
    pub level: u8,
    /// Name of the part.
    pub name: &'a str,
    /// Message.
    pub message: &'a str,
    /// Values with their keys.
    pub values: &'a [(&'a str, &'a str)],
}

/// Returns a message, encapsulation header included. Each status has the hardware id `hw`.
#[must_use]
pub fn diagnostics(statuses: &[Status<'_>]) -> Vec<u8> {
    let mut bytes = vec![0, 1, 0, 0];
    bytes.extend([0; 8]);
    text(&mut bytes, "");
    number(&mut bytes, statuses.len());
    for status in statuses {
        bytes.push(status.level);
        for each in [status.name, status.message, "hw"] {
            text(&mut bytes, each);
        }
        number(&mut bytes, status.values.len());
        for (key, value) in status.values {
            text(&mut bytes, key);
            text(&mut bytes, value);
        }
    }
    bytes
}

/// Writes a string after its padding.
pub(crate) fn text(bytes: &mut Vec<u8>, text: &str) {
    number(bytes, text.len() + 1);
    bytes.extend(text.as_bytes());
    bytes.push(0);
}

/// Writes a number of 32 bits after its padding.
pub(crate) fn number(bytes: &mut Vec<u8>, number: usize) {
    align(bytes);
    bytes.extend(u32::try_from(number).unwrap_or(u32::MAX).to_le_bytes());
}

/// Appends a number of double precision.
pub(crate) fn double(bytes: &mut Vec<u8>, number: f64) {
    bytes.resize(bytes.len().next_multiple_of(8), 0);
    bytes.extend(number.to_le_bytes());
}
