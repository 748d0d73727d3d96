//! The four Zenoh messages that `rp discover --router` sends, byte for byte (`zenoh-protocol` 1.10,
//! `transport/` and `network/interest.rs`).
//!
//! The messages declare nothing, so the session has no node, topic or service. Each message is a
//! batch after its length, as in a stream.

use ros2probe_wire::zenoh::{VERSION, vle};

/// Sequence number of the only FRAME.
const SEQUENCE_NUMBER: u8 = 0;
/// Id of the only INTEREST.
pub const INTEREST: u8 = 1;
/// Seconds without a message after which the router ends the session, as in rmw_zenoh. A closed
/// connection ends the session earlier.
const LEASE_SECONDS: u8 = 60;

/// INIT with extensions. It contains no sizes, so sequence numbers have 32 bits and batches 65,535
/// bytes, the defaults.
const INIT: u8 = 0x01 | 0x80;
/// Length of the id, 16 bytes, and the role of a client.
const ID_LEN_AND_ROLE: u8 = 0xf2;
/// Lanes with priorities, and patch level 1, as in each session of ROS. An agent that reads the
/// answer then finds the declarations on the same lane.
const INIT_EXTENSIONS: [u8; 3] = [0x81, 0x27, 1];
/// OPEN, with the lease in seconds.
const OPEN: u8 = 0x02 | 0x40;
/// CLOSE of the whole session, without a particular reason.
const CLOSE: [u8; 2] = [0x03 | 0x20, 0];
/// Reliable FRAME.
const FRAME: [u8; 2] = [0x05 | 0x20, SEQUENCE_NUMBER];
/// Reliable FRAME with an extension: priority CONTROL, the lane of declarations.
const CONTROL_FRAME: [u8; 4] = [0x05 | 0x20 | 0x80, SEQUENCE_NUMBER, 0x31, 0];
/// INTEREST for current declarations, with an extension.
const INTEREST_CURRENT: u8 = 0x19 | 0x20 | 0x80;
/// Aliases and tokens, restricted to a key that is written in full.
const INTEREST_OPTIONS: u8 = 0x01 | 0x08 | 0x10 | 0x20;
/// Priority CONTROL. The message blocks instead of being dropped.
const INTEREST_EXTENSIONS: [u8; 2] = [0x21, 0x08];

/// Returns the introduction of a client with this id.
#[must_use]
pub fn introduction(id: [u8; 16]) -> Vec<u8> {
    batch(&[&[INIT, VERSION, ID_LEN_AND_ROLE], &id, &INIT_EXTENSIONS])
}

/// Returns the opening, which repeats the router's cookie.
#[must_use]
pub fn opening(cookie: &[u8]) -> Vec<u8> {
    let head = [OPEN, LEASE_SECONDS, SEQUENCE_NUMBER];
    batch(&[&head, &vle(cookie.len() as u64), cookie])
}

/// Returns the request for the liveliness tokens that match a key expression. A router without
/// lanes of priorities accepts only a FRAME without a priority.
#[must_use]
pub fn request(key: &str, has_priorities: bool) -> Vec<u8> {
    let frame: &[u8] = if has_priorities {
        &CONTROL_FRAME
    } else {
        &FRAME
    };
    let interest = [INTEREST_CURRENT, INTEREST, INTEREST_OPTIONS];
    let (scope, length) = ([0], vle(key.len() as u64));
    let key = [&scope[..], &length, key.as_bytes()].concat();
    batch(&[frame, &interest, &key, &INTEREST_EXTENSIONS])
}

/// Returns the end of the session.
#[must_use]
pub fn goodbye() -> Vec<u8> {
    batch(&[&CLOSE])
}

/// Returns the batch after its length.
fn batch(parts: &[&[u8]]) -> Vec<u8> {
    let body = parts.concat();
    // Longer cookies have been refused before.
    let length = u16::try_from(body.len()).unwrap_or(0);
    [&length.to_le_bytes()[..], &body].concat()
}
