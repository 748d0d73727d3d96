//! Parameters, encoded by hand after `rcl_interfaces/msg/ParameterEvent`,
//! `rcl_interfaces/srv/SetParameters` and `rcl_interfaces/srv/GetParameters`, as XCDR1 in
//! little-endian order.

use crate::robot_diagnostics::{number, text};

/// DDS name of the type of events.
pub const EVENT: &str = "rcl_interfaces::msg::dds_::ParameterEvent_";
/// DDS name of the type of requests.
pub const REQUEST: &str = "rcl_interfaces::srv::dds_::SetParameters_Request_";

/// DDS names of the types of requests for values, and of replies.
pub const GET_REQUEST: &str = "rcl_interfaces::srv::dds_::GetParameters_Request_";
/// See [`GET_REQUEST`].
pub const GET_REPLY: &str = "rcl_interfaces::srv::dds_::GetParameters_Response_";

/// Names and values of integer parameters.
pub type Integers<'a> = &'a [(&'a str, i64)];

/// Returns an event, encapsulation header included, with new, changed and deleted parameters.
#[must_use]
pub fn event(node: &str, new: Integers<'_>, changed: Integers<'_>, deleted: &[&str]) -> Vec<u8> {
    let mut body = vec![0; 8];
    text(&mut body, node);
    parameters(&mut body, new);
    parameters(&mut body, changed);
    number(&mut body, deleted.len());
    for name in deleted {
        parameter(&mut body, name, 0, 0);
    }
    [&[0, 1, 0, 0], &body[..]].concat()
}

/// Returns an event with one new parameter, a boolean.
#[must_use]
pub fn boolean(node: &str, name: &str, value: bool) -> Vec<u8> {
    let mut body = vec![0; 8];
    text(&mut body, node);
    number(&mut body, 1);
    text(&mut body, name);
    body.extend([1, u8::from(value)]);
    body.resize(body.len().next_multiple_of(8) + 16, 0);
    text(&mut body, "");
    for _ in 0..7 {
        number(&mut body, 0);
    }
    [&[0, 1, 0, 0], &body[..]].concat()
}

/// Returns a request to set parameters, with a request header of rmw_cyclonedds if wanted.
#[must_use]
pub fn request(integers: Integers<'_>, has_header: bool) -> Vec<u8> {
    let mut body = if has_header { vec![7; 16] } else { Vec::new() };
    parameters(&mut body, integers);
    [&[0, 1, 0, 0], &body[..]].concat()
}

/// Returns a request for the values of parameters. `call` is the header of rmw_cyclonedds, or empty.
#[must_use]
pub fn names(names: &[&str], call: &[u8]) -> Vec<u8> {
    let mut body = call.to_vec();
    number(&mut body, names.len());
    for name in names {
        text(&mut body, name);
    }
    [&[0, 1, 0, 0], &body[..]].concat()
}

/// Returns a reply with integers, or "not set". `call` is the header of rmw_cyclonedds, or empty.
#[must_use]
pub fn values(values: &[Option<i64>], call: &[u8]) -> Vec<u8> {
    let mut body = call.to_vec();
    number(&mut body, values.len());
    for integer in values {
        value(
            &mut body,
            integer.map_or(0, |_| 2),
            integer.unwrap_or_default(),
        );
    }
    [&[0, 1, 0, 0], &body[..]].concat()
}

fn parameters(body: &mut Vec<u8>, integers: Integers<'_>) {
    number(body, integers.len());
    for (name, value) in integers {
        parameter(body, name, 2, *value);
    }
}

fn parameter(body: &mut Vec<u8>, name: &str, kind: u8, integer: i64) {
    text(body, name);
    value(body, kind, integer);
}

fn value(body: &mut Vec<u8>, kind: u8, integer: i64) {
    body.extend([kind, 0]);
    body.resize(body.len().next_multiple_of(8), 0);
    body.extend(integer.to_le_bytes());
    body.extend([0; 8]);
    text(body, "");
    for _ in 0..5 {
        number(body, 0);
    }
}
