//! States of managed nodes and of batteries, encoded by hand after
//! `lifecycle_msgs/msg/TransitionEvent`, `lifecycle_msgs/srv/GetState` and
//! `sensor_msgs/msg/BatteryState`, as XCDR1 in little-endian order.

use crate::robot_diagnostics::{number, text};
use crate::robot_log::align;

/// DDS name of the type of transitions.
pub const TRANSITION: &str = "lifecycle_msgs::msg::dds_::TransitionEvent_";
/// DDS name of the type of replies.
pub const STATE_REPLY: &str = "lifecycle_msgs::srv::dds_::GetState_Response_";
/// DDS name of the type of batteries.
pub const BATTERY: &str = "sensor_msgs::msg::dds_::BatteryState_";

/// Returns a transition between states of these numbers, encapsulation header included.
#[must_use]
pub fn transition(from: u8, to: u8) -> Vec<u8> {
    let mut body = vec![0; 8];
    for (id, label) in [(9, "transition"), (from, "start"), (to, "goal")] {
        body.push(id);
        text(&mut body, label);
    }
    [&[0, 1, 0, 0], &body[..]].concat()
}

/// Returns a reply with a state of this number, with a header of rmw_cyclonedds if wanted.
#[must_use]
pub fn state_reply(state: u8, has_header: bool) -> Vec<u8> {
    let mut body = if has_header { vec![7; 16] } else { Vec::new() };
    body.push(state);
    text(&mut body, "label");
    [&[0, 1, 0, 0], &body[..]].concat()
}

/// Returns the state of a battery with this voltage, temperature and charge.
#[must_use]
pub fn battery(frame: &str, voltage: f32, temperature: f32, percentage: f32) -> Vec<u8> {
    let mut body = header(frame);
    align(&mut body);
    let floats = [voltage, temperature, -1.5, 2.0, 4.0, 5.0, percentage];
    for float in floats {
        body.extend(float.to_le_bytes());
    }
    body.extend([2, 1, 3, 1]);
    number(&mut body, 2);
    for cell in [3.7_f32, 3.8] {
        body.extend(cell.to_le_bytes());
    }
    number(&mut body, 0);
    text(&mut body, "slot");
    text(&mut body, "4711");
    [&[0, 1, 0, 0], &body[..]].concat()
}

/// Returns the beginning of a message with a header, and `size` further bytes.
#[must_use]
pub fn with_header(frame: &str, size: usize) -> Vec<u8> {
    let mut body = header(frame);
    body.resize(body.len() + size, 7);
    [&[0, 1, 0, 0], &body[..]].concat()
}

fn header(frame: &str) -> Vec<u8> {
    let mut body = vec![0; 8];
    text(&mut body, frame);
    body
}
