//! Transforms, encoded by hand after `tf2_msgs/msg/TFMessage`, as XCDR1 in little-endian order.

use crate::robot_diagnostics::{double, number, text};

/// DDS name of the type.
pub const DDS_TYPE: &str = "tf2_msgs::msg::dds_::TFMessage_";

/// A transform to encode. Its translation is along x, and its rotation about z.
#[derive(Clone, Copy, Debug)]
pub struct Transform<'a> {
    /// Parent frame.
    pub parent: &'a str,
    /// Child frame.
    pub child: &'a str,
    /// Stamp in milliseconds.
    pub stamp: u64,
    /// Translation in metres.
    pub x: f64,
    /// Rotation in radians.
    pub yaw: f64,
}

/// Returns a message, encapsulation header included.
#[must_use]
pub fn transforms(transforms: &[Transform<'_>]) -> Vec<u8> {
    let mut body = Vec::new();
    number(&mut body, transforms.len());
    for transform in transforms {
        let milliseconds = usize::try_from(transform.stamp).unwrap_or(usize::MAX);
        number(&mut body, milliseconds / 1000);
        number(&mut body, milliseconds % 1000 * 1_000_000);
        text(&mut body, transform.parent);
        text(&mut body, transform.child);
        let (sine, cosine) = (transform.yaw / 2.0).sin_cos();
        for value in [transform.x, 0.0, 0.0, 0.0, 0.0, sine, cosine] {
            double(&mut body, value);
        }
    }
    [&[0, 1, 0, 0], &body[..]].concat()
}
